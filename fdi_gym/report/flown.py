"""Flights to look at: flown again, shown to methods, and packed into few bytes.

What changes rarely (labels, alarms) is kept whole as runs. All else is thinned to some hundred points over the flight, which
keep the extremes of sensors and residuals, and kept in steps between its smallest and its largest value: 65,534 of them, or,
where flights are many, 254, which are as many as a panel has pixels.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from fdi_gym.declaration import runs
from fdi_gym.diagnosis import Decisions, make_diagnoser, run
from fdi_gym.engine import Record
from fdi_gym.entrants import settings_of
from fdi_gym.estimation.equivalent import nearest
from fdi_gym.leaderboard import Board
from fdi_gym.metrics import DEVIATIONS
from fdi_gym.names import blamed
from fdi_gym.plant import Array, Plant
from fdi_gym.suite import AnySuite, Suite

BLOCK = 20  # flights that are flown and diagnosed together
MOST, LEAST = 600, 24  # points of a line
OWN = 8  # lines of a method's own that are allowed for, beside label probabilities, estimates and residuals
EMPTY = 65535  # where there is no value
FINE, COARSE = (EMPTY - 1, 2.0), (254, 1.3)  # steps, and bytes that a point takes at most, compressed


class Line(NamedTuple):
    """One line of a panel. A signal's components have their number for a unit; a scale of 0 is none."""

    kind: str
    name: str
    unit: str
    values: Array  # (samples,)
    scale: float = 0.0


class Budget:
    """How many points a line may have, and how many steps they are told apart by, so that all of them fit.

    Args:
        size: Bytes of text that there are.
        plant: The plant.
        flights: How many.
        methods: How many.

    Raises:
        ValueError: They don't fit at all.
    """

    def __init__(self, size: float, plant: Plant, flights: int, methods: int):
        entries = len(plant.estimated)
        lines = len(plant.observed) + entries + methods * (len(plant.labels) + 2 * entries + len(plant.outputs) + OWN)
        room = size * 3 / 4 / max(flights * lines, 1)  # bytes for a line, since text holds three in four
        self.steps, bytes_ = FINE if room >= MOST * FINE[1] else COARSE
        self.points = int(min(MOST, room / bytes_))
        if self.points < LEAST:
            fit = int(flights * self.points / LEAST)
            raise ValueError(f"{flights} flights of {methods} methods don't fit into a report: {fit} flights would")


def chosen(board: Board, count: int) -> list[int]:
    """So many flights, label after label: of each, those first about which methods that are told nothing disagree most."""
    rows = board.honest() or board.rows
    right: dict[int, dict[int, float]] = {}  # label -> flight -> share of decisions that are right
    for i in range(board.suite.episodes):
        decisions = [board.outcomes[row.diagnoser][i].decisions for row in rows]
        for at, true in enumerate(d.label for d in decisions[0]):
            share = float(np.mean([said[at].declared == true for said in decisions]))
            right.setdefault(true, {}).setdefault(i, share)
    queues = [sorted(of, key=lambda i, of=of: (abs(of[i] - 0.5), i)) for _, of in sorted(right.items())]
    turns = [queue[turn] for turn in range(max(map(len, queues), default=0)) for queue in queues if turn < len(queue)]
    return sorted(list(dict.fromkeys([*turns, *range(board.suite.episodes)]))[:count])


def flown(board: Board, names: Sequence[str], flights: Sequence[int], budget: Budget, progress: bool) -> dict[str, Any]:
    """The flights with what each method says of them."""
    plant, suite, found = board.plant, board.suite, []
    blocks = [flights[i : i + BLOCK] for i in range(0, len(flights), BLOCK)]
    with tqdm(total=len(blocks) * len(names), desc="flights", unit="run", disable=not progress) as bar:
        for block in blocks:
            scenarios = suite.scenarios(plant, block)
            record = suite.record(plant, block)
            said: dict[str, Decisions] = {}
            for name in names:
                bar.set_postfix_str(name)
                with blamed(name):
                    settings = settings_of(suite, plant, name)
                    diagnoser = make_diagnoser(name, plant, process=suite.process, scenarios=scenarios, **settings)
                    said[name] = run(diagnoser, record.obs, signals=True)
                bar.update()
            for j, flight in enumerate(block):
                seed, healthy = _origin(suite, flight)
                found.append(_flight(plant, record, j, budget) | {
                    "number": flight, "seed": seed, "healthy": healthy,
                    "said": {name: _said(plant, record, of, j, budget) for name, of in said.items()},
                })  # fmt: skip
    return {"flights": found, "methods": list(names), "points": budget.points, "dt": plant.dt, "deviations": DEVIATIONS}


def _origin(suite: AnySuite, flight: int) -> tuple[int | str, bool]:
    """The (first) seed of a flight, or the file that it was recorded in, and whether it was made healthy."""
    if not isinstance(suite, Suite):
        return list(suite.flights)[flight], False
    return [*suite.seeds, *suite.healthy][flight * suite.windows], flight * suite.windows >= len(suite.seeds)


def _flight(plant: Plant, record: Record, i: int, budget: Budget) -> dict[str, Any]:
    """What the sensors say, and what is true."""
    last = int(record.length[i])
    obs, target = record.obs[i, : last + 1], record.target[i, : last + 1]
    n_y, n_u = len(plant.outputs), len(plant.commands)
    kinds = ["sensor"] * n_y + ["command"] * n_u + ["known"] * len(plant.known)
    lines = [
        Line(kind, s.name, s.unit, obs[:, j], s.scale) for j, (kind, s) in enumerate(zip(kinds, plant.observed, strict=True))
    ]
    lines += [Line("truth", s.name, s.unit, target[:, j], s.scale) for j, s in enumerate(plant.estimated)]
    label = record.label[i, : last + 1]
    return {"samples": last + 1, "label": runs(label), "lines": pack(lines, budget.points, budget.steps)}


def _said(plant: Plant, record: Record, said: Decisions, i: int, budget: Budget) -> dict[str, Any]:
    """What one method says of one flight."""
    last = int(record.length[i])
    flight = slice(last + 1)
    lines: list[Line] = []
    if said.label_probs is not None:
        lines += [Line("probability", s.name, "", said.label_probs[i, flight, j]) for j, s in enumerate(plant.labels)]
    if said.estimate is not None:
        lines += [Line("estimate", s.name, s.unit, said.estimate[i, flight, j]) for j, s in enumerate(plant.estimated)]
        if said.estimate_std is not None:
            lines += [
                Line("deviation", s.name, s.unit, said.estimate_std[i, flight, j]) for j, s in enumerate(plant.estimated)
            ]
    if said.state is not None:
        residual = _residual(plant, record.obs[i, flight], said.state[i, flight],
                             None if said.estimate is None or plant.target else said.estimate[i, flight])  # fmt: skip
        lines += [Line("residual", s.name, s.unit, residual[:, j]) for j, s in enumerate(plant.outputs)]
    for name, values in (said.signals or {}).items():
        values = values[i, flight].reshape(last + 1, -1).astype(float)
        lines += [Line("signal", name, str(j) if values.shape[1] > 1 else "", values[:, j]) for j in range(values.shape[1])]
    both = 2 * (said.label[i, flight].astype(int) + 1) + said.alarm[i, flight]
    return {
        "label": runs(both),
        "lines": pack(lines, budget.points, budget.steps),
        "sigma": [s.sigma for s in plant.outputs],
    }


def _residual(plant: Plant, obs: Array, state: Array, theta: Array | None) -> Array:
    """What the sensors say less what they would at the estimated state (and fault) (K + 1, n_y)."""
    y, u, _ = plant.split(obs)
    with np.errstate(all="ignore"):
        expected = plant.measure(np.arange(len(obs)) * plant.dt, state, u, theta)
    return nearest(plant, y, np.isfinite(y), expected) - expected


def thin(values: Array, points: int) -> Array:
    """Values (samples,) at so many points: of each of points / 2 stretches the smallest and the largest, as they come."""
    if len(values) <= points:
        return values
    edges = np.linspace(0, len(values), points // 2 + 1).astype(int)
    first, k = edges[:-1], np.arange(len(values))
    there = np.isfinite(values)
    low = np.minimum.reduceat(np.where(there, values, np.inf), first)
    high = np.maximum.reduceat(np.where(there, values, -np.inf), first)
    stretch = np.repeat(np.arange(len(first)), np.diff(edges))
    lowest, highest = (np.minimum.reduceat(np.where(values == end[stretch], k, len(k)), first) for end in (low, high))
    found = np.where(lowest <= highest, (low, high), (high, low)).T.ravel()
    return np.where(np.isfinite(found), found, np.nan)


def pack(lines: Sequence[Line], points: int, steps: int = FINE[0]) -> dict[str, Any]:
    """Lines, thinned, as one compressed block with a head for each: (kind, name, unit, smallest, step, points, scale)."""
    heads, block = [], []
    for line in lines:
        values = thin(np.asarray(line.values, float), points)
        there = np.isfinite(values)
        low, high = (float(f(values[there])) if there.any() else 0.0 for f in (np.min, np.max))
        step = (high - low) / steps or 1.0
        block.append(np.where(there, np.round((np.where(there, values, low) - low) / step), EMPTY).astype("<u2"))
        heads.append([*line[:3], float(f"{low:.9g}"), float(f"{step:.9g}"), len(values), line.scale])
    packed = base64.b64encode(zlib.compress(b"".join(b.tobytes() for b in block), 9)).decode() if block else ""
    return {"heads": heads, "packed": packed}
