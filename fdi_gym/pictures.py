"""Single pictures of a suite, by the name of their kind: what `fdi-gym plot` draws."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fdi_gym import plots
from fdi_gym.comparison import cliques
from fdi_gym.curves import delay_curve, severity_curve
from fdi_gym.diagnosis import Decisions, make_diagnoser, run
from fdi_gym.engine import Record
from fdi_gym.entrants import settings_of
from fdi_gym.leaderboard import Board, framing, read_board
from fdi_gym.metrics import BANDS
from fdi_gym.names import blamed, unknown
from fdi_gym.plant import Plant
from fdi_gym.suite import AnySuite
from fdi_gym.tables import by_isolation

BEST = 4  # methods that are shown where none is named
FLOWN, OF_ONE = ("flight", "signals"), ("signals", "confusion")


def picture(
    kind: str, suite: AnySuite, methods: Sequence[str], results: Path, *, flight: int = 0, sensors: bool = False
) -> Any:
    """A figure.

    Args:
        kind: "flight", "signals", "confusion", "delay", "severity" or "ranking".
        suite: The suite.
        methods: Whose. Default: of the rows the best that are told nothing.
        results: Folder of the rows.
        flight: Which flight.
        sensors: Show what the sensors say, too.

    Raises:
        ValueError: There is no such flight, method or row, or more methods than the picture shows.
    """
    if kind in OF_ONE and len(methods) > 1:
        raise ValueError(f"{kind} shows one method, not {len(methods)}")
    most = len(plots.LINES)
    if len(methods) > most:
        raise ValueError(f"a picture tells up to {most} methods apart, not {len(methods)}")
    board = None if kind in FLOWN and methods else read_board(results / suite.name, {suite.name: suite})
    names = list(dict.fromkeys(methods)) if board is None else _names(board, kind, methods)
    if kind in FLOWN:
        plant, record, said = _flown(suite, names, flight)
        if kind == "signals":
            with blamed(names[0]):
                return plots.method_signals(plant, record, said[names[0]])
        return plots.flight(plant, record, said, sensors=sensors)
    assert board is not None
    rows = {row.diagnoser: row for row in board.rows}
    if kind == "confusion":
        return plots.confusions(rows[names[0]], [label.name for label in board.plant.labels])
    if kind == "delay":
        curves = {
            k: {n: delay_curve(board.outcomes[n], k, board.plant.dt) for n in names} for k in ("detection", "isolation")
        }
        return plots.delays(curves)
    if kind == "severity":
        return plots.severities({n: severity_curve(board.outcomes[n], "per_decision") for n in names}, BANDS, "decisions")
    shown = by_isolation([rows[name] for name in names] if methods else board.honest())
    return plots.ranking(shown, framing(board), cliques(board.drawn(shown)), suite.episodes)


def _names(board: Board, kind: str, methods: Sequence[str]) -> list[str]:
    known = [row.diagnoser for row in board.rows]
    for name in methods:
        if name not in known and kind not in FLOWN:
            raise unknown(f"row of {board.suite.name}", name, known)
    best = [row.diagnoser for row in by_isolation(board.honest())]
    found = list(dict.fromkeys(methods)) or best[: 1 if kind in OF_ONE else BEST]
    if not found:
        raise ValueError(f"there is no row of {board.suite.name} to draw: fdi-gym evaluate {board.suite.name} makes some")
    return found


def _flown(suite: AnySuite, names: Sequence[str], flight: int) -> tuple[Plant, Record, dict[str, Decisions]]:
    if not 0 <= flight < suite.episodes:
        raise ValueError(f"{suite.name} has the flights 0 to {suite.episodes - 1}, not {flight}")
    plant = suite.build()
    scenarios = suite.scenarios(plant, [flight])
    record, said = suite.record(plant, [flight]), {}
    for name in names:
        with blamed(name):
            settings = settings_of(suite, plant, name)
            diagnoser = make_diagnoser(name, plant, process=suite.process, scenarios=scenarios, **settings)
            said[name] = run(diagnoser, record.obs, signals=True)
    return plant, record, said
