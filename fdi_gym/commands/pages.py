"""Pages and pictures: leaderboard, report."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from fdi_gym.commands.arguments import Names, SuiteName

RESULTS = Path("leaderboards/results")


def leaderboard(results: Path = RESULTS, pages: Path = Path("leaderboards"), pictures: bool = True) -> None:
    """Render the tables of all rows: README.md, a page for each suite, and their pictures.

    Args:
        results: Folder of the rows.
        pages: Folder of the pages.
        pictures: Draw the pictures, too.
    """
    from fdi_gym import leaderboard
    from fdi_gym.files import write_whole

    for name, text in leaderboard.render(results).items():
        write_whole(pages / name, text.encode())
        print(pages / name)
    for board in leaderboard.boards(results) if pictures else ():
        leaderboard.draw(board, pages / "pictures")


def report(
    suite: SuiteName,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("report.html"),
    results: Path = RESULTS,
    methods: Names = (),
    flights: int = 16,
) -> None:
    """Make one HTML file of a suite's rows: tables, figures, and flights to look at. It needs no network.

    Args:
        suite: Name of a suite, or path of a suite file.
        output: The file.
        results: Folder of the rows.
        methods: Who is shown the flights to look at; "all" for everyone with a row. Default: the best four, and a ceiling.
        flights: How many flights to look at.
    """
    from fdi_gym.files import write_whole
    from fdi_gym.leaderboard import read_board
    from fdi_gym.report import report as make
    from fdi_gym.suite import load_suite

    frozen = load_suite(suite)
    page = make(read_board(results / frozen.name, frozen), methods, flights, sys.stderr.isatty()).encode()
    write_whole(output, page)
    print(f"{output}: {len(page) / 1e6:.1f} MB")
