"""Pages and pictures: leaderboard, report, plot."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fdi_gym.commands.arguments import Names, SuiteName

RESULTS = Path("leaderboards/results")


def leaderboard(
    results: Path = RESULTS,
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
    from fdi_gym.files import make_room, write_whole

    if not results.is_dir():
        raise ValueError(f"{results} is no folder of rows")
    make_room(pages / "README.md")
    boards = leaderboard.boards(results, suites)
    for name, text in leaderboard.pages(boards).items():
        write_whole(pages / name, text.encode())
        print(pages / name)
    for board in boards if pictures else ():
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
    from fdi_gym.files import make_room, write_whole
    from fdi_gym.leaderboard import read_board
    from fdi_gym.report import report as make
    from fdi_gym.suite import load_suite

    make_room(output)
    frozen = load_suite(suite)
    page = make(read_board(results / frozen.name, {frozen.name: frozen}), methods, flights, sys.stderr.isatty()).encode()
    write_whole(output, page)
    print(f"{output}: {len(page) / 1e6:.1f} MB")


def plot(
    kind: Annotated[
        tyro.conf.Positional[Literal["flight", "signals", "confusion", "delay", "severity", "ranking"]],
        tyro.conf.arg(metavar="PICTURE"),
    ],
    suite: SuiteName,
    methods: Names = (),
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    flight: int = 0,
    sensors: bool = False,
    results: Path = RESULTS,
) -> None:
    """Draw one picture of a suite: a flight with diagnoses or with a method's own signals, or what its rows come to.

    Args:
        kind: What is drawn: flight, signals, confusion, delay, severity or ranking. The first two are flown now, the others
            are of the rows.
        suite: Name of a suite, or path of a suite file.
        methods: Whose; signals and confusion are of one. Default: of the rows the best that is told nothing (up to four).
        output: The file; its suffix says what kind (png, svg, pdf). Default: PICTURE.png.
        flight: Which flight.
        sensors: Show what the sensors say, too.
        results: Folder of the rows.
    """
    from fdi_gym.files import make_room
    from fdi_gym.pictures import picture
    from fdi_gym.suite import load_suite

    output = Path(f"{kind}.png") if output is None else output
    make_room(output)
    figure = picture(kind, load_suite(suite), methods, results, flight=flight, sensors=sensors)
    if output.suffix[1:] not in figure.canvas.get_supported_filetypes():
        raise ValueError(f"a picture is png, svg or pdf, not {output.suffix or output.name!r}")
    figure.savefig(output)
    print(output)
