"""Tables of rows: isolation, detection and identification, each ranked by its own figure."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import diagnosers
from fdi_gym.metrics import BANDS
from fdi_gym.names import unknown
from fdi_gym.plant import Plant
from fdi_gym.row import Row

_MARKUP = re.compile(r"([\\`*\[\]|])")
FLOOR = ("null", "random")  # frame every table from below


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]], width: int | None = None) -> str:
    """A Markdown table with aligned columns; what is wider than `width` goes on below, behind the first column again."""
    lines = [list(head), *[list(row) for row in rows]]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    fits = len(head)
    while width is not None and fits > 2 and sum(widths[:fits]) + 3 * fits + 1 > width:
        fits -= 1
    if fits < len(head):
        rest = [[line[0], *line[fits:]] for line in lines]
        return f"{markdown(lines[0][:fits], [line[:fits] for line in lines[1:]])}\n\n{markdown(rest[0], rest[1:], width)}"
    text = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + " |" for line in lines]
    text.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(text)


def plain(text: str) -> str:
    """Text from a row, a suite or somebody's code so that Markdown and HTML show it as it is, on one line."""
    line = "".join(c if c.isprintable() else " " for c in " ".join(text.split()))
    line = line.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return _MARKUP.sub(r"\\\1", line)


def knows(row: Row) -> str:
    """What the diagnoser of a row is told of the truth: what its entry says, never what the row says."""
    entry = diagnosers().get(row.diagnoser)
    return entry.knows if entry else ""


def clairvoyant(row: Row) -> bool:
    """Whether the diagnoser of a row knows a part of the truth."""
    return bool(knows(row))


def ceiling(row: Row) -> bool:
    """Whether what the diagnoser of a row knows makes it a ceiling, which frames a table."""
    entry = diagnosers().get(row.diagnoser)
    return entry is not None and entry.ceiling


# ---------------------------------------------------------------------------------------------------------------
# Columns


class Line(NamedTuple):
    """What a line of a table is made of."""

    row: Row
    microseconds: float | None  # per sample
    tied: bool  # cannot be told from the best
    attainable: Sequence[float]  # the scores between which that lies which can be attained; empty: not known


def _percent(value: float | None, interval: Sequence[float] | None = None) -> str:
    if value is None:
        return "-"
    if interval is None:
        return f"{100 * value:.1f}"
    return f"{100 * value:.1f} [{100 * interval[0]:.1f}, {100 * interval[1]:.1f}]"


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _delay(found: Mapping[str, Any], what: str) -> str:
    mean, quartiles = found[f"{what}delay_restricted_mean"], found[f"{what}delay_quartiles"]
    if mean is None:
        return "-"
    low, middle, high = ("never" if q is None else f"{q:.1f}" for q in quartiles)
    return f"{mean:.1f}; " + ("never" if low == "never" else f"{middle} ({low}, {high})")


def _middle(quartiles: Sequence[float] | None) -> str:
    return "-" if quartiles is None else f"{quartiles[1]:.2f} ({quartiles[0]:.2f}, {quartiles[2]:.2f})"


def _score(found: Mapping[str, Any]) -> str:
    return _percent(found["balanced_accuracy"], found["balanced_accuracy_interval"])


def _severity(m: Mapping[str, Any]) -> str:
    bands = [m["accuracy_by_severity"][band]["per_sample"] for band in BANDS]
    return "/".join("-" if b is None else f"{100 * b:.0f}" for b in bands)


def _attained(line: Line) -> str:
    per_sample = line.row.metrics["per_sample"]
    score, chance = per_sample["balanced_accuracy"], 1.0 / len(per_sample["confusion"])
    if score is None or ceiling(line.row) or not line.attainable or min(line.attainable) <= chance:
        return "-"
    low, high = sorted(100 * max(score - chance, 0.0) / (bound - chance) for bound in line.attainable)
    return f"{low:.0f}-{high:.0f}"


def _estimated(figure: str, digits: int, factor: float = 1.0) -> Callable[[Line], str]:
    def text(line: Line) -> str:
        found = line.row.metrics["identification"]
        value = found and found[figure]
        return "-" if value is None else "huge" if value * factor >= 1e4 else f"{factor * value:.{digits}f}"

    return text


COLUMNS: dict[str, tuple[str, Callable[[Line], str]]] = {
    "tied": ("best", lambda a: "=" if a.tied else ""),
    "sample": ("per sample %", lambda a: _score(a.row.metrics["per_sample"])),
    "decision": ("per decision %", lambda a: _score(a.row.metrics["per_decision"])),
    "attained": ("attained %", _attained),
    "raw": ("raw %", lambda a: _percent(a.row.metrics["per_sample"]["accuracy"])),
    "f1": ("F1", lambda a: _number(a.row.metrics["per_sample"]["macro_f1"], 3)),
    "severity": ("S/M/L %", lambda a: _severity(a.row.metrics)),
    "isolated": ("isolated after s", lambda a: _delay(a.row.metrics["detection"], "isolation_")),
    "log": ("log score", lambda a: _number(a.row.metrics["log_score"], 3)),
    "detection": ("detection %", lambda a: _score(a.row.metrics["detection"])),
    "alarms": ("false alarms/h", lambda a: _number(a.row.metrics["detection"]["false_alarms_per_hour"], 1)),
    "under": ("under alarm %", lambda a: _percent(a.row.metrics["detection"]["healthy_share_under_alarm"])),
    "begun": ("begun so %", lambda a: _percent(a.row.metrics["detection"]["begun_under_alarm_rate"])),
    "missed": ("missed %", lambda a: _percent(a.row.metrics["detection"]["missed_rate"])),
    "detected": ("detected after s", lambda a: _delay(a.row.metrics["detection"], "")),
    "error": ("relative error", _estimated("relative_error", 3)),
    "coverage": ("covered %", _estimated("coverage", 1, 100.0)),
    "nees": ("NEES", _estimated("nees", 2)),
    "worth": ("scenario %", lambda a: _percent(a.row.metrics["scenario"]["worth"])),
    "exact": ("right faults %", lambda a: _percent(a.row.metrics["scenario"]["exact"])),
    "onset": ("onset error s", lambda a: _middle(a.row.metrics["scenario"]["onset_error_quartiles"])),
    "overlap": ("overlap %", lambda a: _percent(a.row.metrics["scenario"]["overlap"])),
    "size": ("size error %", lambda a: _percent(a.row.metrics["scenario"]["size_error"])),
    "time": ("us/sample", lambda a: _number(a.microseconds, 1)),
}
ISOLATION = ("tied", "sample", "attained", "decision", "severity", "isolated", "log", "time")
DETECTION = ("detection", "alarms", "under", "begun", "missed", "detected")
IDENTIFICATION = ("error", "coverage", "nees")
SCENARIO = ("worth", "exact", "onset", "overlap", "size")


def isolates(row: Row) -> bool:
    """Whether a method declares more than one label: else there is nothing to rank."""
    return int(np.count_nonzero(np.sum(row.metrics["per_sample"]["confusion"], axis=0))) > 1


def _framed(row: Row) -> bool:
    return row.diagnoser in FLOOR or ceiling(row)


def _ranked(rows: Sequence[Row], figure: Callable[[Row], float]) -> list[Row]:
    return sorted(rows, key=lambda row: (-figure(row), row.diagnoser))


def by_isolation(rows: Sequence[Row]) -> list[Row]:
    """Those that isolate, and what frames them, best balanced accuracy per sample first."""
    shown = [row for row in rows if isolates(row) or _framed(row)]
    return _ranked(shown, lambda row: row.metrics["per_sample"]["balanced_accuracy"] or 0.0)


def by_detection(rows: Sequence[Row]) -> list[Row]:
    """All, best balanced accuracy of their alarms first."""
    return _ranked(rows, lambda row: row.metrics["detection"]["balanced_accuracy"] or 0.0)


def by_identification(rows: Sequence[Row]) -> list[Row]:
    """Those that estimate, smallest relative error while a fault acts first."""
    shown = [row for row in rows if row.metrics["identification"] is not None]
    return _ranked(shown, lambda row: -(row.metrics["identification"]["relative_error"] or 0.0))


def by_scenario(rows: Sequence[Row]) -> list[Row]:
    """Those that isolate, and what frames them, the worthiest declarations of whole flights first."""
    shown = [row for row in rows if isolates(row) or _framed(row)]
    return _ranked(shown, lambda row: row.metrics["scenario"]["worth"])


RANKINGS: dict[str, tuple[Callable[[Sequence[Row]], list[Row]], tuple[str, ...]]] = {
    "Isolation": (by_isolation, ISOLATION),
    "Detection": (by_detection, DETECTION),
    "Identification": (by_identification, IDENTIFICATION),
    "Scenario": (by_scenario, SCENARIO),
}


def table(
    rows: Sequence[Row],
    timing: Mapping[str, float],
    columns: Sequence[str] = ISOLATION,
    tied: Collection[str] = (),
    plant: Plant | None = None,
    width: int | None = None,
    attainable: Sequence[float] = (),
) -> str:
    """A table as Markdown, in the order of the rows. Methods that know a part of the truth are marked *.

    Args:
        rows: The rows.
        timing: Microseconds per sample by diagnoser.
        columns: Keys of COLUMNS.
        tied: The diagnosers that cannot be told from the best.
        width: What is wider goes on below.
        attainable: The scores per sample between which that lies which can be attained.
        plant: Adds the root mean square error of each estimated entry while a fault acts, with its unit.

    Raises:
        ValueError: There is no such column.
    """
    for column in columns:
        if column not in COLUMNS:
            raise unknown("column", column, COLUMNS)
    entries = list(plant.estimated) if plant else []
    head = ["method", *(COLUMNS[c][0] for c in columns)]
    head += [f"{entry.name}{f' {entry.unit}' if entry.unit else ''}" for entry in entries]
    body = []
    for row in rows:
        line = Line(row, timing.get(row.diagnoser), row.diagnoser in tied, attainable)
        lost = f" ({row.metrics['lost_episodes']} lost)" if row.metrics["lost_episodes"] else ""
        cells = [plain(row.diagnoser) + (" *" if clairvoyant(row) else "") + lost, *(COLUMNS[c][1](line) for c in columns)]
        found = row.metrics["identification"]
        during = found["rmse"]["during"] if found else None
        body.append([*cells, *(f"{during[entry.name]:.3g}" if during else "-" for entry in entries)])
    return markdown(head, body, width)


def told(rows: Sequence[Row]) -> str:
    """What the methods that are marked * know, one item each."""
    lines = [
        f"- {plain(row.diagnoser)} knows {knows(row)}" + ("." if ceiling(row) else "; no ceiling.")
        for row in rows if clairvoyant(row)
    ]  # fmt: skip
    return "\n".join(lines)


def confusion_table(row: Row, labels: Sequence[str], width: int | None = None) -> str:
    """The per-sample confusion matrix as Markdown: rows truth, columns decision, in percent of the row."""
    counts = np.array(row.metrics["per_sample"]["confusion"], float)
    names = [*labels, "lost"] if counts[:, -1].any() else labels
    share = 100 * counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    body = [[label, *(f"{v:.1f}" for v in share[i, : len(names)])] for i, label in enumerate(labels)]
    return markdown([row.diagnoser, *names], body, width)


def _figures(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _figures(part, f"{path}.{key}" if path else key)
    elif isinstance(value, (list, tuple)):
        for i, part in enumerate(value):
            yield from _figures(part, f"{path}.{i}")
    else:
        yield path, value


def comma_separated(rows: Sequence[Row], timing: Mapping[tuple[str, str], float]) -> str:
    """All figures of rows but their confusion matrices, as CSV in full digits; a column is named by the figure's place.

    Times are by suite and diagnoser.
    """
    lines = []
    for row in rows:
        figures = {name: value for name, value in _figures(row.metrics) if ".confusion." not in name}
        known = {"knows": knows(row), "microseconds": timing.get((row.suite, row.diagnoser))}
        lines.append({"suite": row.suite, "diagnoser": row.diagnoser, **known, **figures})
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for line in lines for key in line)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()
