"""The pages of the leaderboards: tables of rows, as Markdown."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fdi_gym.diagnosis import diagnosers
from fdi_gym.files import RefusedError
from fdi_gym.metrics import BANDS
from fdi_gym.row import Row, read_made, read_outcomes, read_row, row_files
from fdi_gym.suite import load_suite
from fdi_gym.verification import check_row

_MARKUP = re.compile(r"([\\`*\[\]|])")


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with aligned columns."""
    lines = [list(head), *[list(row) for row in rows]]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    text = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + " |" for line in lines]
    text.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(text)


def plain(text: str) -> str:
    """Text from a row, a suite or somebody's code so that Markdown and HTML show it as it is, on one line."""
    line = "".join(c if c.isprintable() else " " for c in " ".join(text.split()))
    line = line.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return _MARKUP.sub(r"\\\1", line)


def clairvoyant(row: Row) -> bool:
    """Whether the diagnoser of a row knows the truth: what its entry says, never what the row says."""
    entry = diagnosers().get(row.diagnoser)
    return entry is not None and entry.clairvoyant


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
    name = plain(row.diagnoser) + (" (knows the truth)" if clairvoyant(row) else "")
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


def table(rows: Sequence[Row], timing: Mapping[str, float]) -> str:
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


def read_rows(folder: Path) -> list[Row]:
    """The rows in a suite's folder; those that are not rows are refused.

    Raises:
        RefusedError: One is not a row, or of another suite.
    """
    rows = [read_row(path) for path in row_files(folder)] if folder.is_dir() else []
    for row in rows:
        if row.suite != folder.name:
            raise RefusedError(f"{folder} holds a row of {row.diagnoser} on another suite, {row.suite}")
    return rows


def render(results: Path) -> str:
    """The page of all tables.

    Raises:
        RefusedError: A row does not agree with its outcomes or its suite; it is named, and no page is made.
    """
    parts = [INTRODUCTION]
    for folder in sorted(path for path in results.glob("*") if path.is_dir()):
        suite = load_suite(folder.name)
        plant = suite.build()
        rows = read_rows(folder)
        for path, row in zip(row_files(folder), rows, strict=True):
            check_row(row, read_outcomes(path, row, plant), suite, plant)
        times = {name: made.microseconds for name, made in read_made(folder).items()}
        parts.append(
            f"## {suite.name}\n\n{plain(suite.description)}\n\n`{suite.env}`, process `{suite.process}`, "
            f"{suite.episodes} episodes, seeds from {suite.first_seed}, version `{suite.sha256[:12]}`.\n\n"
            f"{table(rows, times) if rows else 'No rows yet.'}\n"
        )
    return "\n".join(parts)
