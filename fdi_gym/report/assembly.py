"""The report of a suite, from its board: see `report`."""

from __future__ import annotations

from collections.abc import Sequence

from fdi_gym import diagnosis
from fdi_gym.leaderboard import Board
from fdi_gym.names import unknown
from fdi_gym.report.figures import figures
from fdi_gym.report.flown import Budget, chosen, flown
from fdi_gym.report.page import LARGEST, html
from fdi_gym.suite import ActingSuite

FLIGHTS, METHODS = 16, 4
OVERHEAD = 0.25  # of the largest size: what is kept for the page and for what does not shrink with the points


def report(board: Board, methods: Sequence[str] = (), flights: int = FLIGHTS, progress: bool = True) -> str:
    """One HTML file: tables, figures, and flights to look at.

    Args:
        board: The suite with its rows.
        methods: Who is shown the flights to look at; rows of theirs are not needed. Default: the best `METHODS` by isolation
            of those that are told nothing, and the best ceiling. "all" is everyone with a row.
        flights: How many flights to look at; 0 for none. They are drawn with fewer points where they are many.
        progress: Show a progress bar while methods run.

    Raises:
        ValueError: The suite's flights are acted on, it has no rows, there are not so many flights, an unknown
            method, one that cannot run on the plant, or more than fits into `LARGEST` bytes.
    """
    suite = board.suite
    if isinstance(suite, ActingSuite):
        raise ValueError(
            f"the flights of {suite.name} answer to who acts on them: its page has the pictures (fdi-gym leaderboard)"
        )
    if not board.rows:
        raise ValueError(f"there are no rows of {suite.name}: fdi-gym evaluate {suite.name} --results FOLDER makes them")
    if not 0 <= flights <= suite.episodes:
        raise ValueError(f"{suite.name} has {suite.episodes} flights, not {flights}")
    found = figures(board)
    names = _names(board, methods) if flights else []
    outside = LARGEST * (1 - OVERHEAD) - len(html(suite.name, found))
    budget = Budget(outside, board.plant, flights, len(names))
    found["flown"] = flown(board, names, chosen(board, flights), budget, progress)
    page = html(suite.name, found)
    if len(page.encode()) > LARGEST:
        raise ValueError(
            f"the report would have {len(page.encode()) / 1e6:.1f} MB, more than {LARGEST / 1e6:.0f}: show fewer"
        )
    return page


def _names(board: Board, methods: Sequence[str]) -> list[str]:
    """Who is shown the flights. What only a row names is never imported: it may be anybody's code."""
    known = diagnosis.diagnosers()
    here = [row.diagnoser for row in _by_score(board) if row.diagnoser in known]
    if tuple(methods) == ("all",):
        return here
    if methods:
        for name in methods:
            if ":" not in name and name not in known:
                raise unknown("diagnoser", name, known)
        return list(dict.fromkeys(methods))
    honest = [row.diagnoser for row in board.honest()]
    told = [name for name in here if known[name].ceiling]
    return [name for name in here if name in honest][:METHODS] + told[:1] or here[:METHODS]


def _by_score(board: Board) -> list:
    return sorted(board.rows, key=lambda row: (-(row.metrics["per_sample"]["balanced_accuracy"] or 0.0), row.diagnoser))
