"""Leaderboards: a folder of rows, checked and rendered. No row is believed that cannot be recomputed."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fdi_gym.evaluation import Row, Suite, diagnose, load_suite, write_whole
from fdi_gym.metrics import BANDS, summarise


class RefusedError(ValueError):
    """A row that does not say what its episodes say; the message names the figure."""


def _differences(said: Any, found: Any, path: str = "", tolerance: float = 1e-9) -> Iterator[str]:
    """Where two nests of figures differ, by name."""
    if isinstance(said, dict) and isinstance(found, dict):
        for key in [*said, *(k for k in found if k not in said)]:
            yield from _differences(
                said.get(key, "nothing"), found.get(key, "nothing"), f"{path}.{key}" if path else key, tolerance
            )
    elif isinstance(said, (list, tuple)) and isinstance(found, (list, tuple)) and len(said) == len(found):
        for i, (a, b) in enumerate(zip(said, found, strict=True)):
            yield from _differences(a, b, f"{path}[{i}]", tolerance)
    elif isinstance(said, float) and isinstance(found, (int, float)):
        if not math.isclose(said, found, rel_tol=tolerance, abs_tol=1e-12):
            yield f"{path}: the row says {said!r}, its episodes give {found!r}"
    elif said != found:
        yield f"{path}: the row says {said!r}, its episodes give {found!r}"


def read_row(path: Path) -> Row:
    """A row from its file.

    Raises:
        RefusedError: It is not a row.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Row)
    except (OSError, msgspec.DecodeError) as error:
        raise RefusedError(f"{path} is not a row: {error}") from error


def check_row(row: Row, suite: Suite) -> None:
    """Compare a row with its suite, its own outcomes and its digest.

    Raises:
        RefusedError: Another suite version, or a figure that does not follow from the outcomes; it is named.
    """
    if row.suite_sha256 != suite.sha256:
        raise RefusedError(
            f"{row.suite}/{row.diagnoser}: made with version {row.suite_sha256[:12]} of the suite; "
            f"here is {suite.sha256[:12]}"
        )
    plant = suite.build()
    if len(row.outcomes) != suite.episodes:
        raise RefusedError(f"{row.suite}/{row.diagnoser}: {len(row.outcomes)} episodes, the suite has {suite.episodes}")
    found = summarise(row.outcomes, len(plant.labels), [s.name for s in plant.estimated], plant.dt)
    differences = list(_differences(row.metrics, msgspec.json.decode(msgspec.json.encode(found)), "metrics"))
    if differences:
        raise RefusedError(f"{row.suite}/{row.diagnoser}: {'; '.join(differences[:5])}")
    if row.sha256 != row.content_sha256():
        raise RefusedError(
            f"{row.suite}/{row.diagnoser}: the figures agree with the outcomes, but the row was edited: "
            f"its digest is {row.content_sha256()[:12]}, it says {row.sha256[:12]}"
        )


def verify(path: Path, share: float = 0.1) -> int:
    """Check a row and run a share of its episodes again; returns how many.

    Raises:
        RefusedError: The row fails `check_row`, or an episode gives another outcome; it is named.
    """
    row = read_row(path)
    suite = load_suite(row.suite)
    check_row(row, suite)
    count = min(suite.episodes, max(1, math.ceil(share * suite.episodes)))
    # which ones follows from the row itself, so that nobody can choose the others to edit
    rng = np.random.default_rng(int(row.sha256[:16], 16))
    episodes = sorted(int(i) for i in rng.choice(suite.episodes, count, replace=False))
    block = diagnose(suite, suite.build(), row.diagnoser, episodes)
    for i, again in zip(episodes, block.outcomes, strict=True):
        said, found = (msgspec.json.decode(msgspec.json.encode(o)) for o in (row.outcomes[i], again))
        differences = list(_differences(said, found, f"outcomes[{i}]", tolerance=1e-6))
        if differences:
            raise RefusedError(f"{row.suite}/{row.diagnoser}: {'; '.join(differences[:5])}")
    return count


def check_writable(results: Path, suite: Suite, names: list[str]) -> None:
    """Make sure, before anything runs, that rows can be written and none of another suite version would be lost.

    Raises:
        ValueError: The folder cannot be written, or holds such a row.
    """
    folder = results / suite.name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".probe-{os.getpid()}"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise ValueError(f"cannot write results to {folder}: {error.strerror or error}") from error
    for name in names:
        path = row_path(results, suite.name, name)
        if path.exists():
            old = read_row(path)
            if old.suite_sha256 != suite.sha256:
                raise ValueError(
                    f"{path} is from another version of {suite.name} "
                    f"({old.suite_sha256[:12]}, here is {suite.sha256[:12]}); move it away first"
                )


def row_path(results: Path, suite: str, diagnoser: str) -> Path:
    """Where a row lies."""
    return results / suite / f"{diagnoser.replace(':', '.')}.json"


def write_rows(results: Path, suite: Suite, rows: dict[str, Row], timing: dict[str, float]) -> None:
    """Write rows, and their times per sample into timing.json beside them."""
    (results / suite.name).mkdir(parents=True, exist_ok=True)
    for name, row in rows.items():
        write_whole(row_path(results, suite.name, name), msgspec.json.encode(row) + b"\n")
    path = results / suite.name / "timing.json"
    before = msgspec.json.decode(path.read_bytes()) if path.exists() else {}
    merged = {**before, **{name: round(value, 2) for name, value in timing.items()}}
    write_whole(path, msgspec.json.format(msgspec.json.encode(merged, order="sorted"), indent=2) + b"\n")


# ---------------------------------------------------------------------------------------------------------------
# Tables


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with aligned columns."""
    lines = [list(head), *[list(row) for row in rows]]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    text = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + " |" for line in lines]
    text.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(text)


def _percent(value: float, interval: list[float] | None = None) -> str:
    if interval is None:
        return f"{100 * value:.1f}"
    return f"{100 * value:.1f} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _delay(quartiles: list[float | None]) -> str:
    low, middle, high = (_number(q, 1) if q is not None else "never" for q in quartiles)
    return "never" if middle == "never" and low == "never" else f"{middle} ({low}, {high})"


COLUMNS = (
    "method", "per sample %", "per episode %", "raw %", "F1", "small / medium / large %", "false alarms /h", "missed %",
    "detection s", "isolation s", "RMSE during", "log score", "us/sample",
)  # fmt: skip


def cells(row: Row, microseconds: float | None) -> list[str]:
    """One line of the table."""
    m = row.metrics
    bands = [m["accuracy_by_severity"][band]["per_sample"] for band in BANDS]
    during = m["rmse"] and m["rmse"]["during"]
    name = row.diagnoser + (" (knows the truth)" if row.clairvoyant else "")
    lost = f" ({m['lost_episodes']} lost)" if m["lost_episodes"] else ""
    return [
        name + lost,
        _percent(m["per_sample"]["balanced_accuracy"], m["per_sample"]["balanced_accuracy_interval"]),
        _percent(m["per_episode"]["balanced_accuracy"], m["per_episode"]["balanced_accuracy_interval"]),
        _percent(m["per_sample"]["accuracy"]),
        _number(m["per_sample"]["macro_f1"], 3),
        " / ".join("-" if b is None else f"{100 * b:.0f}" for b in bands),
        _number(m["false_alarms_per_hour"]),
        "-" if m["missed_detection_rate"] is None else _percent(m["missed_detection_rate"]),
        _delay(m["detection_delay_quartiles"]),
        _delay(m["isolation_delay_quartiles"]),
        ", ".join(f"{v:.3g}" for v in during.values()) if during else "-",
        _number(m["log_score"], 3),
        _number(microseconds, 1),
    ]


def table(rows: list[Row], timing: dict[str, float]) -> str:
    """The comparison table as Markdown, best per-sample balanced accuracy first."""
    ranked = sorted(rows, key=lambda row: (-row.metrics["per_sample"]["balanced_accuracy"], row.diagnoser))
    return markdown(COLUMNS, [cells(row, timing.get(row.diagnoser)) for row in ranked])


def confusion_table(row: Row, labels: list[str]) -> str:
    """The per-sample confusion matrix as Markdown: rows truth, columns decision, in percent of the row."""
    counts = np.array(row.metrics["per_sample"]["confusion"], float)
    names = [*labels, "lost"] if counts[:, -1].any() else labels
    share = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    body = [[label, *(f"{v:.1f}" for v in share[i, : len(names)])] for i, label in enumerate(labels)]
    return markdown([row.diagnoser, *names], body)


INTRODUCTION = """# Leaderboards

Rendered by `fdi-gym leaderboard` from the rows in `results/`; a test renders it again and compares. Balanced accuracy is
the mean of the diagonal of the row-normalised confusion matrix, in percent, with a 95 % bootstrap interval over
episodes. Per sample, and per episode (one decision). Raw accuracy never ranks: on some processes "always none" is right
most of the time. By severity: share of right samples while the smallest active fault is small, medium, large. Delays in
seconds, median (quartiles), right-censored where never reached. Missed: faults never detected, or already under an
alarm when they began. RMSE of the estimated entries while a fault acts. The log score is the mean log probability of
the true label (higher is better). Times per sample are processor times on the machine of the run, in blocks of 50 episodes.

Check a row with `fdi-gym verify leaderboards/results/<suite>/<row>.json`.
"""


def render(results: Path) -> str:
    """The page of all tables.

    Raises:
        RefusedError: A row fails its check; it is named, and no page is made.
    """
    parts = [INTRODUCTION]
    for folder in sorted(path for path in results.iterdir() if path.is_dir()):
        suite = load_suite(folder.name)
        timing = folder / "timing.json"
        times = msgspec.json.decode(timing.read_bytes()) if timing.exists() else {}
        rows = [read_row(path) for path in sorted(folder.glob("*.json")) if path != timing]
        for row in rows:
            check_row(row, suite)
        parts.append(
            f"## {suite.name}\n\n{suite.description}\n\n`{suite.env}`, scenario `{suite.scenario}`, "
            f"{suite.episodes} episodes, seeds from {suite.first_seed}, version `{suite.sha256[:12]}`.\n\n"
            f"{table(rows, times)}\n"
        )
    return "\n".join(parts)
