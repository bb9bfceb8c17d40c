"""Rows: evaluate, verify."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import tyro

from fdi_gym.commands.arguments import WIDTH, Backend, Cluster, Names, SuiteNames

if TYPE_CHECKING:
    from fdi_gym.plant import Plant
    from fdi_gym.suite import AnySuite


class _Asked(NamedTuple):
    """What is to be evaluated: a suite, as it was named, and the diagnosers that can run on it."""

    name: str
    suite: AnySuite
    plant: Plant
    names: list[str]


def evaluate(
    suites: SuiteNames,
    diagnosers: Names = ("reference",),
    results: Path | None = None,
    work: Path = Path("runs"),
    jobs: int = -1,
    confusion: Literal["best", "all", "none"] = "best",
    columns: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN")] = (),
    csv: Path | None = None,
    episodes: int | None = None,
    replace: bool = False,
    backend: Backend = "loky",
    cluster: Cluster = {},  # noqa: B006 (tyro reads the default)
) -> None:
    """Run diagnosers on suites, and probers on suites of probing, print the tables of each, and write their rows.

    Args:
        suites: Names of suites, or paths of suite files; "all" for every one that is here.
        diagnosers: Names, where the suite is of probing of probers too; "reference" for those that others are compared with
            first, "all" for every one, of which those run that can on the suite's plant; "board" for those that have a row
            in the folder of results; "module:function" for your own; "truth" where diagnoses are allowed for.
        results: Folder for the rows, written as soon as a suite is finished; without it nothing but the tables is made.
        work: Folder of finished blocks. A killed run goes on from there.
        jobs: Worker processes, -1 for one per core.
        confusion: Whose confusion matrices to print.
        columns: One table of these columns in place of the three rankings; a wrong one lists them.
        csv: A file for all figures, comma-separated.
        episodes: A quick look: so many of the flights of each suite, evenly spread. Makes no rows.
        replace: Rows in the folder that other sources, settings or data have made may go.
        backend: Where they run: "loky" is this machine; dask, ray and slurm are clusters that exist.
        cluster: What the cluster is told, as name and value in turn: address HOST:PORT, or parameters of submitit.
    """
    from fdi_gym import evaluation, leaderboard, row, tables
    from fdi_gym.clusters import on
    from fdi_gym.files import make_room, write_whole
    from fdi_gym.names import unknown

    for column in columns:
        if column not in tables.COLUMNS:
            raise unknown("column", column, tables.COLUMNS)
    if episodes is not None and results is not None:
        raise ValueError("rows are made of the whole suite: --results and --episodes don't go together")
    if csv is not None:
        make_room(csv)
    asked = _asked(suites, diagnosers, episodes, results)
    if results is not None:
        for _, suite, plant, names in asked:
            row.check_writable(results, suite, names, partial(evaluation.digests_of, suite, plant), replace)
    lines, every, times = [], [], {}
    for said, suite, plant, names in asked:
        begun = time.monotonic()
        with on(backend, cluster, work):
            found = evaluation.evaluate(suite, names, work=work, jobs=jobs, command=f"fdi-gym evaluate {said} --diagnosers")
        rows = [f.row for f in found.values()]
        mine = {name: f.made.microseconds for name, f in found.items()}
        board = leaderboard.Board(suite, plant, rows, {name: f.outcomes for name, f in found.items()}, mine)
        print(f"\n{suite.name}: {suite.description}\n\n{leaderboard.tables(board, columns, WIDTH)}")
        ranked, best = tables.by_isolation(rows), board.best()
        for shown in {"best": [best] if best else [], "all": ranked, "none": []}[confusion]:
            print(f"\n{tables.confusion_table(shown, [label.name for label in plant.labels], WIDTH)}")
        if csv is not None:
            every += rows
            times |= {(suite.name, name): microseconds for name, microseconds in mine.items()}
            write_whole(csv, tables.comma_separated(every, times).encode())
        if results is not None:
            row.write_rows(results, suite, found)
        place = f" in {results / suite.name}" if results is not None else ""
        lines.append(f"{suite.name}: {len(rows)} rows{place}, {time.monotonic() - begun:.0f} s")
        print(f"\n{lines[-1]}", flush=True)
    if csv is not None:
        print(f"\nall figures in {csv}")
    if len(lines) > 1:
        print("\n" + "\n".join(lines))


BOARD = "board"  # in place of diagnosers: those that have a row


def _asked(suites: Sequence[str], diagnosers: Sequence[str], episodes: int | None, results: Path | None) -> list[_Asked]:
    """What names of suites and of diagnosers stand for; what cannot run is said, before anything runs."""
    from fdi_gym import evaluation
    from fdi_gym.diagnosis import named
    from fdi_gym.diagnosis.registry import GROUPS
    from fdi_gym.entrants import TRUTH
    from fdi_gym.suite import ActingSuite, load_suite, suite_names

    if BOARD in diagnosers and results is None:
        raise ValueError(f"{BOARD!r} are the diagnosers that have a row in a folder: say which, with --results")
    loaded = {name: load_suite(name) for name in (suite_names() if "all" in suites else suites)}
    if not loaded:
        raise ValueError(f"evaluate a suite, or all; there are {', '.join(suite_names())}")
    asked = []
    for said, suite in loaded.items():
        suite = suite if episodes is None else suite.head(episodes)
        plant, acts = suite.build(), suite.acts if isinstance(suite, ActingSuite) else ""
        there = _with_rows(results / suite.name) if results is not None and BOARD in diagnosers else []
        names = named([*(name for name in diagnosers if name != BOARD), *there], acts == "probing")
        names += [TRUTH.name] if acts == "accommodation" and set(diagnosers) & set(GROUPS) else []
        able, reasons = evaluation.applicable(suite, plant, names)
        for name, reason in reasons.items():
            print(f"{suite.name}: {name}: not applicable: {reason}", file=sys.stderr)
        if able:
            asked.append(_Asked(said, suite, plant, able))
    if not asked:
        raise ValueError(
            f"none of these diagnosers can run on {' or '.join(sorted({suite.plant for suite in loaded.values()}))}"
        )
    return asked


def _with_rows(folder: Path) -> list[str]:
    """The diagnosers that have a row in a suite's folder; what a row alone names is not imported."""
    from fdi_gym.leaderboard import read_rows

    return [row.diagnoser for row in read_rows(folder) if ":" not in row.diagnoser]


def verify(
    rows: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="ROW")],
    share: float = 0.1,
    seed: int | None = None,
    suite: Annotated[str, tyro.conf.arg(metavar="SUITE")] = "",
    trust: Names = (),
    renew: bool = False,
    jobs: int = -1,
) -> None:
    """Check all that rows say against their episodes and the code that is here, and run a share of the episodes again.

    Args:
        rows: Row files; their outcomes lie beside them.
        share: Share of each row's episodes to run again, above 0 and up to 1.
        seed: Draws which ones; without it nobody can know beforehand.
        suite: Name of a suite, or path of a suite file. Default: the one that each row names.
        trust: Diagnosers "module:function" that may be imported. Look at their code first.
        renew: Sources have changed, outcomes have not: rows that hold but for the digests of what made them get those of
            what is here. A row that fails, or that the code no longer gives, stays as it is.
        jobs: Worker processes, -1 for one per core.
    """
    from fdi_gym.names import in_a_line
    from fdi_gym.row import MADE
    from fdi_gym.verification import Verified, verify_all

    rows = tuple(path for path in rows if path.name != MADE)  # so that *.json will do
    if not rows:
        raise ValueError("there are no rows to verify")
    refused, renewed = [], 0
    for path, found in verify_all(rows, share, seed=seed, jobs=jobs, suite=suite, trust=trust, renew=renew):
        if isinstance(found, Verified):
            renewed += bool(found.renewed)
            anew = f"; digests made anew: {', '.join(found.renewed)}" if found.renewed else ""
            again = f"{len(found.episodes)} run again, same outcomes: {found.episodes}"
            print(f"{path}: every figure follows from the episodes; {again}{anew}", flush=True)
        elif len(rows) == 1:
            raise found
        else:
            refused.append(path)
            print(f"{path}: refused: {in_a_line(found)}", file=sys.stderr, flush=True)
    if refused:
        raise ValueError(
            f"{len(refused)} of {len(rows)} rows are refused, {renewed} renewed: {', '.join(map(str, refused))}"
        )
    if len(rows) > 1:
        print(f"{len(rows)} rows hold, {renewed} of them renewed")
