"""The grid: every method on every plant, on `standard` and `hard`: `python -m benchmarks.grid`.

Runs what has no row yet, measures the consistency of the general filters, and writes leaderboards/grid.md and grid.json.
Rows and finished blocks are kept, so a killed run goes on.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from benchmarks.consistency import FILTERS, measure
from benchmarks.reproduction.pieces import pieces
from fdi_gym.diagnosis import diagnosers
from fdi_gym.evaluation import applicable, evaluate
from fdi_gym.files import pretty, read_json, write_whole
from fdi_gym.leaderboard import read_rows
from fdi_gym.row import Row, row_path, write_rows
from fdi_gym.suite import AnySuite, load_suite, suite_names
from fdi_gym.tables import clairvoyant, markdown, plain

KINDS = ("standard", "hard")
# the filters of the paper that a plant was taken from, by suite family
PAPER = {
    "b747": (
        "two_stage_kf",
        "friedland_kf",
        "augmented_kf",
        "two_stage_kf_exponential",
        "two_stage_kf_exponential_fast",
        "two_stage_kf_directional",
    ),
    "huav": ("three_stage_cdkf", "three_stage_ekf", "robust_three_stage_cdkf", "robust_three_stage_ekf", "ascdkf"),
    "missile": ("approximation_detector", "gos", "gos_strict", "gos_two_class", "gos_two_class_strict"),
    "cmg": ("caukf", "gaukf", "sgaukf", "sgaukf_odd", "dual_gaukf", "dual_sgaukf"),
}
INTRODUCTION = """# The grid

Every method on every plant. Written by `python -m benchmarks.grid` from the rows in `results/`. Balanced
accuracy per sample in percent, with a 95 % interval; "-": not applicable, with the reason
that the code gives, or not run yet, both below. Methods marked * know the truth. General methods need nothing but the
plant's declaration.
"""
CONSISTENCY = """## Consistency

Healthy flights. Mean per dimension (1 where the filter is as sure of itself as it may be), and the share of samples on
which the mean over 40 flights lies within its 95 % bounds. A filter that expects faults to walk in at any time is
conservative on flights that have none: that is the price of seeing them.

"""


def families() -> tuple[str, ...]:
    """The suite families that have all kinds, a paper's first."""
    names = suite_names()
    found = [name.removesuffix(f"-{KINDS[0]}") for name in names if name.endswith(f"-{KINDS[0]}")]
    return tuple(dict.fromkeys([*PAPER, *(f for f in found if all(f"{f}-{kind}" in names for kind in KINDS))]))


@dataclasses.dataclass
class Arguments:
    """What is run."""

    plants: tuple[str, ...] = families()
    """Suite families."""
    page_only: bool = False
    """Run nothing: the page of the rows that are there."""
    jobs: int = -1
    """Worker processes; -1 for one per core."""
    work: Path = Path("runs")
    """Folder of the finished blocks."""
    results: Path = Path("leaderboards/results")
    """Folder of the rows."""
    page: Path = Path("leaderboards/grid.md")
    """The page; the figures of the consistency lie beside it in grid.json."""


def consistency_piece(suite: AnySuite, name: str) -> dict[str, Any]:
    """NIS and NEES of one filter on one suite's plant and process."""
    return measure(suite.build(), suite.process, name)


def reasons_of(suite: AnySuite) -> dict[str, str]:
    """Why the methods that cannot run on a suite's plant cannot, in the code's words."""
    return applicable(suite, suite.build(), list(diagnosers()))[1]


def run(arguments: Arguments, suites: list[AnySuite], reasons: dict[str, dict[str, str]]) -> dict[str, Any]:
    """Fill the grid: the missing rows, then the figures beside them, which are given."""
    for suite in suites:
        for name in diagnosers():  # one after the other: each row is written as soon as it is there
            if name in reasons[suite.name] or row_path(arguments.results, suite.name, name).exists():
                continue
            command = f"fdi-gym evaluate {suite.name} --diagnosers"
            found = evaluate(suite, [name], work=arguments.work, jobs=arguments.jobs, command=command)
            write_rows(arguments.results, suite, found)
    jobs: dict[str, Any] = {f"{s.name}.{name}": (consistency_piece, (s, name))
                            for s in suites for name in FILTERS if name not in reasons[s.name]}  # fmt: skip
    return pieces(arguments.work / "consistency", jobs, arguments.jobs)


def accuracy(row: Row) -> tuple[float, float, float]:
    """Balanced accuracy per sample and its interval, percent."""
    m = row.metrics["per_sample"]
    low, high = m["balanced_accuracy_interval"]
    return 100 * m["balanced_accuracy"], 100 * low, 100 * high


def cell(row: Row | None) -> str:
    """A figure of the grid."""
    if row is None:
        return "-"
    value, low, high = accuracy(row)
    return f"{value:.1f} [{low:.1f}, {high:.1f}]"


def rows_of(results: Path, suite: str) -> dict[str, Row]:
    """The rows of a suite."""
    return {row.diagnoser: row for row in read_rows(results / suite)}


def table(found: dict[str, dict[str, Row]]) -> str:
    """One kind of process: methods on plants, those that run everywhere first, by their mean."""
    names = {name for rows in found.values() for name in rows}

    def order(name: str) -> tuple[int, float, str]:
        mine = [accuracy(rows[name])[0] for rows in found.values() if name in rows]
        return -len(mine), -sum(mine) / len(mine), name

    head = ["method", *found]
    body = []
    for name in sorted(names, key=order):
        star = " *" if any(clairvoyant(rows[name]) for rows in found.values() if name in rows) else ""
        body.append([plain(name) + star, *(cell(rows.get(name)) for rows in found.values())])
    return markdown(head, body)


def winners(found: dict[str, dict[str, Row]]) -> str:
    """Which method wins where, and by how much the paper's own filter is beaten on its own plant."""
    body = []
    for suite, rows in found.items():
        honest = {n: accuracy(r) for n, r in rows.items() if not clairvoyant(r)}
        paper = {n: honest[n] for n in PAPER.get(suite.split("-")[0], ()) if n in honest}
        if not paper:
            continue
        oracle = max((accuracy(r)[0] for r in rows.values() if clairvoyant(r)), default=None)
        best, own = max(honest, key=lambda n: honest[n][0]), max(paper, key=lambda n: paper[n][0])
        apart = honest[best][1] > paper[own][2]
        ahead = honest[best][0] - paper[own][0]
        body.append([
            suite, f"{best} {cell(rows[best])}", f"{own} {cell(rows[own])}",
            "its own wins" if best == own else f"{ahead:.1f} points, intervals {'apart' if apart else 'overlap'}",
            "-" if oracle is None else f"{oracle:.1f}",
        ])  # fmt: skip
    return markdown(["suite", "best method", "best filter of the plant's paper", "beaten by", "best oracle"], body)


def reasons_table(found: dict[str, dict[str, str]]) -> str:
    """The pairs without a row, with the code's reason."""
    said: dict[tuple[str, str], set[str]] = {}
    for suite, why in found.items():
        for name, reason in why.items():
            said.setdefault((suite.split("-")[0], plain(reason)), set()).add(name)
    body = [[family, ", ".join(sorted(names)), reason] for (family, reason), names in sorted(said.items())]
    return markdown(["plant", "methods", "reason"], body)


def consistency_table(found: dict[str, Any]) -> str:
    """NIS and NEES of the general filters."""
    body = []
    for key, result in found.items():
        suite, name = key.split(".", 1)
        body.append([suite, name, *(
            f"{result[w]['mean']:.2f}, {100 * result[w]['inside']:.0f} %: {result[w]['verdict']}" for w in ("NIS", "NEES")
        )])  # fmt: skip
    return markdown(["suite", "filter", "NIS", "NEES of the state"], body)


def missing(results: Path, figures: dict[str, Any]) -> dict[str, list[str]]:
    """Per suite, the methods that can run on it and have not."""
    reasons = figures.get("reasons", {})
    found = {s: sorted(set(diagnosers()) - set(rows_of(results, s)) - set(why)) for s, why in sorted(reasons.items())}
    return {suite: names for suite, names in found.items() if names}


def page(results: Path, figures: dict[str, Any]) -> str:
    """The whole page, from the rows and the figures beside them."""
    parts = [INTRODUCTION]
    for kind in KINDS:
        found = {f"{family}-{kind}": rows_of(results, f"{family}-{kind}") for family in families()}
        parts.append(f"## {kind}\n\n{table(found)}\n\n### Who wins\n\n{winners(found)}")
    if absent := missing(results, figures):
        parts.append("## Not run yet\n\n" + "\n".join(f"- {suite}: {', '.join(names)}" for suite, names in absent.items()))
    parts.append("## Not applicable\n\n" + reasons_table(figures.get("reasons", {})))
    if measured := figures.get("consistency"):
        parts.append(CONSISTENCY + consistency_table(measured))
    return "\n\n".join(parts) + "\n"


def main(arguments: Arguments) -> None:
    """Fill the grid and write its page."""
    kept = arguments.page.with_name("grid.json")
    figures = read_json(kept, dict[str, Any], "grid's figures") if kept.exists() else {}
    suites = [load_suite(f"{family}-{kind}") for kind in KINDS for family in arguments.plants]
    reasons = {suite.name: reasons_of(suite) for suite in suites}
    measured = {} if arguments.page_only else run(arguments, suites, reasons)
    for part, found in (("consistency", measured), ("reasons", reasons)):
        figures[part] = {**figures.get(part, {}), **found}
    write_whole(kept, pretty(figures))
    write_whole(arguments.page, page(arguments.results, figures).encode())
    print(arguments.page)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
