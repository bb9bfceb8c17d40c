"""Rows and their pages: evaluate, verify, leaderboard."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fdi_gym.commands.arguments import WIDTH, Names, SuiteName


def evaluate(
    suite: SuiteName,
    diagnosers: Names = ("all",),
    results: Path | None = None,
    work: Path = Path("runs"),
    jobs: int = -1,
    confusion: Literal["best", "all", "none"] = "best",
    columns: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN")] = (),
    csv: Path | None = None,
    episodes: int | None = None,
    replace: bool = False,
) -> None:
    """Run diagnosers on a suite, print the comparison table, and write one row per diagnoser.

    Args:
        suite: Name of a suite, or path of a suite file.
        diagnosers: Names; "all" for every one that can run on the suite's plant; "module:function" for your own.
        results: Folder for the rows; without it nothing but the table is made.
        work: Folder of finished blocks. A killed run goes on from there.
        jobs: Worker processes, -1 for one per core.
        confusion: Whose confusion matrices to print.
        columns: One table of these columns in place of the three rankings; a wrong one lists them.
        csv: A file for all figures, comma-separated.
        episodes: A quick look: so many of the flights, evenly spread. Makes no rows.
        replace: Rows in the folder that other sources, settings or data have made may go.
    """
    from fdi_gym import evaluation, leaderboard, row, tables
    from fdi_gym.diagnosis import diagnosers as known
    from fdi_gym.files import write_whole
    from fdi_gym.names import unknown
    from fdi_gym.suite import load_suite

    for column in columns:
        if column not in tables.COLUMNS:
            raise unknown("column", column, tables.COLUMNS)
    if episodes is not None and results is not None:
        raise ValueError("rows are made of the whole suite: --results and --episodes don't go together")
    frozen = load_suite(suite)
    frozen = frozen if episodes is None else frozen.head(episodes)
    plant = frozen.build()
    names = list(known()) if diagnosers == ("all",) else list(dict.fromkeys(diagnosers))
    names, reasons = evaluation.applicable(frozen, plant, names)
    for name, reason in reasons.items():
        print(f"{name}: not applicable: {reason}", file=sys.stderr)
    if not names:
        raise ValueError(f"none of these diagnosers can run on {frozen.plant}")
    if results is not None:
        row.check_writable(results, frozen, {name: evaluation.digests_of(frozen, plant, name) for name in names}, replace)
    command = f"fdi-gym evaluate {suite} --diagnosers {' '.join(names)}"
    found = evaluation.evaluate(frozen, names, work=work, jobs=jobs, command=command)
    rows = [f.row for f in found.values()]
    times = {name: f.made.microseconds for name, f in found.items()}
    board = leaderboard.Board(frozen, plant, rows, {name: f.outcomes for name, f in found.items()}, times)
    print(f"\n{frozen.name}: {frozen.description}\n\n{leaderboard.tables(board, columns, WIDTH)}")
    ranked, best = tables.by_isolation(rows), board.best()
    for shown in {"best": [best] if best else [], "all": ranked, "none": []}[confusion]:
        print(f"\n{tables.confusion_table(shown, [label.name for label in plant.labels], WIDTH)}")
    if csv is not None:
        write_whole(csv, tables.comma_separated(rows, times).encode())
        print(f"\nall figures in {csv}")
    if results is not None:
        row.write_rows(results, frozen, found)
        print(f"\n{len(rows)} rows in {results / frozen.name}")


def verify(
    rows: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="ROW")],
    share: float = 0.1,
    seed: int | None = None,
    suite: Annotated[str, tyro.conf.arg(metavar="SUITE")] = "",
    trust: Names = (),
) -> None:
    """Check all that rows say against their episodes and the code that is here, and run a share of the episodes again.

    Args:
        rows: Row files; their outcomes lie beside them.
        share: Share of each row's episodes to run again, above 0 and up to 1.
        seed: Draws which ones; without it nobody can know beforehand.
        suite: Name of a suite, or path of a suite file. Default: the one that the row names.
        trust: Diagnosers "module:function" that may be imported. Look at their code first.
    """
    from fdi_gym.row import MADE
    from fdi_gym.verification import verify as check

    rows = tuple(path for path in rows if path.name != MADE)  # so that *.json will do
    if not rows:
        raise ValueError("there are no rows to verify")
    for path in rows:
        episodes = check(path, share, seed=seed, suite=suite, trust=trust)
        print(f"{path}: every figure follows from the episodes; {len(episodes)} run again, same outcomes: {episodes}")


def render(
    results: Path = Path("leaderboards/results"),
    pages: Path = Path("leaderboards"),
    pictures: bool = True,
    suites: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SUITE")] = (),
) -> None:
    """Render the tables of all rows: README.md, a page for each suite, and their pictures.

    Args:
        results: Folder of the rows.
        pages: Folder of the pages.
        pictures: Draw the pictures, too.
        suites: Paths of suites, or "module:name", that are not installed.
    """
    from fdi_gym import leaderboard
    from fdi_gym.files import write_whole

    for name, text in leaderboard.render(results, suites).items():
        write_whole(pages / name, text.encode())
        print(pages / name)
    for board in leaderboard.boards(results, suites) if pictures else ():
        leaderboard.draw(board, pages / "pictures")
