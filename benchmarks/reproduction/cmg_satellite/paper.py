"""The source's own: computing times (Tables 8 and 10), Figure 3, and its words taken literally."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from baselines.filters.covariance_adaptation import EPS_R, INC_JOINT, Search, binary_grid
from baselines.filters.covariance_adaptive_ukf import EVEN, ODD, UNITS
from baselines.filters.effectiveness import threshold_rule
from baselines.filters.joint_ukf import N_XI, joint_filter
from benchmarks.reproduction.cmg_satellite.blocks import Block, read, scenarios_of, show
from benchmarks.reproduction.cmg_satellite.outcomes import time_line_outcome
from benchmarks.reproduction.numbered import fly
from benchmarks.reproduction.pieces import Jobs
from fdi_gym.diagnosis import Diagnoser, diagnoser_of, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.estimation.decision import Reading
from fdi_gym.plant import Array, Plant
from fdi_gym.plants import cmg_satellite as cmg

GRIDS = ("CAUKF", "GAUKF", "SGAUKF")  # the three filters that the source compares
LEVELS = (45, 55, 75)  # dB
CHANGES = (2000, 4000, 7000, 10000, 15000)  # samples of Table 4 at which f changes
WARM = 2600  # samples that a filter is shown before it is timed: they hold adapted steps
PART, PARTS = 3, 3  # flights of Table 4 in a piece, and pieces
LITERAL = ("odd", "even", "state block")  # readings of SGAUKF, which alternates between odd and even
EVERY, ZOOM, FINE = 20, (-50, 250), 2  # samples between points of Figure 3; the zooms around a change, and their points


def own_plan(quick: bool) -> Jobs:
    """The pieces."""
    jobs: Jobs = {f"time-{s}-{m}": (computing_time, (m, s)) for s in (45, 75, 55) for m in GRIDS}
    for part in range(1 if quick else PARTS):
        for g in ("slew", "regulate"):
            for s in LEVELS:
                jobs |= {f"line-{g}-{s}-{m}-{part}": (line_piece, (g, s, m, part)) for m in (*GRIDS, "UKF")}
        jobs |= {f"literal-{grid}-{part}": (literal, (grid, part)) for grid in LITERAL}
    jobs |= {f"tracking-{g}-{m}": (tracking_piece, (g, m)) for g in ("slew", "regulate") for m in GRIDS}
    return jobs | {f"residual-{g}-{s}": (residual, (g, s)) for g in ("slew", "regulate") for s in (45, 75)}


def flights(profile: str, snr: int, mine: slice) -> tuple[Plant, list[Any], Any]:
    """Flights of Table 4's time line."""
    plant = load_plant(cmg.ID, reference=profile, snr=snr)
    scenarios = scenarios_of(Block("table4", profile, snr, "SGAUKF"))[mine]
    return plant, scenarios, fly(plant, scenarios)


def of_part(part: int) -> slice:
    """The flights of a part."""
    return slice(PART * part, PART * (part + 1))


def line_piece(profile: str, snr: int, method: str, part: int) -> dict[str, Any]:
    """A few flights of Table 4's time line, shown to a method."""
    plant, scenarios, record = flights(profile, snr, of_part(part))
    said = show(plant, scenarios, record, method)
    return {"outcomes": [time_line_outcome(record, said, i) for i in range(len(scenarios))]}


def computing_time(method: str, snr: int) -> dict[str, Any]:
    """Processor time of one flight of 200 s (slew), shown alone: of the whole, of a plain step, and of the adapted ones.

    A filter that has been warmed up. "changes": adapted steps after each change of f, and their time [s].
    """
    plant, _, record = flights("slew", snr, slice(1))
    diagnoser = make_diagnoser(method.lower(), plant)
    state = diagnoser.init(1)
    for k in range(WARM):
        state, _ = diagnoser.update(state, record.obs[:, k])
    state, seconds, adapted = diagnoser.init(1), [], []
    for k in range(record.obs.shape[1]):
        begun = time.thread_time_ns()
        state, said = diagnoser.update(state, record.obs[:, k])
        seconds.append(1e-9 * (time.thread_time_ns() - begun))
        adapted.append(int((said.signals or {})["adapted"][0]))
    spent, raised = np.array(seconds), np.diff(adapted, prepend=0) > 0
    changes = [slice(a, b) for a, b in itertools.pairwise([*CHANGES, len(spent)])]
    return {
        "whole": float(spent.sum()), "plain": np.quantile(spent[~raised], [0.0, 0.5, 0.99]).tolist(),
        "adapted": np.quantile(spent[raised], [0.0, 0.5, 1.0]).tolist(), "steps": int(raised.sum()),
        "changes": [[int(raised[c].sum()), float(spent[c][raised[c]].sum())] for c in changes],
    }  # fmt: skip


def tracking_piece(profile: str, method: str) -> dict[str, Any]:
    """Figure 3: a filter's estimates over Table 4 at 45 dB beside the truth, thinned, and around every change."""
    plant, scenarios, record = flights(profile, 45, slice(1))
    windows = [np.arange(c + ZOOM[0], c + ZOOM[1], FINE) for c in CHANGES]

    def thin(f: Array) -> dict[str, Any]:
        def short(rows: Array) -> list[list[float]]:
            return [[float(f"{v:.4g}") for v in row] for row in rows.tolist()]

        return {"whole": short(f[::EVERY]), "zooms": [short(f[w]) for w in windows]}

    return {"truth": thin(record.theta[0]), "said": thin(show(plant, scenarios, record, method).estimate[0])}


def literal_search(grid: str) -> Search:
    """The source's words taken literally: which diagonal elements of the covariance may be raised."""

    def always(masks: Array) -> Callable[[Array], Array]:
        return lambda count: np.broadcast_to(masks, (len(count), *masks.shape))

    if grid in ("odd", "even"):
        return binary_grid(N_XI + np.arange(UNITS), INC_JOINT, always(ODD if grid == "odd" else EVEN))
    # the attitude's and rate's variances, one of each axis at a time: what "the state covariance" says before theta joins it
    entries = np.arange(6)
    subsets = (np.arange(2**3)[:, None] >> np.arange(3)) % 2 == 1
    return binary_grid(entries, INC_JOINT, always(np.hstack([subsets, subsets])))


def literal(grid: str, part: int) -> dict[str, Any]:
    """The joint filter with that search over Table 4, slew, 45 dB."""
    plant, scenarios, record = flights("slew", 45, of_part(part))
    diagnoser = diagnoser_of(plant, joint_filter(plant, literal_search(grid)), threshold_rule(plant, 0.05))
    said = read(diagnoser, record, f"literal {grid}")
    return {"outcomes": [time_line_outcome(record, said, i) for i in range(len(scenarios))]}


def innovations(plant: Plant) -> Diagnoser:
    """The unadapted joint filter, with its innovations to be seen."""
    filter = joint_filter(plant)

    def shown(s: Any) -> Reading:
        reading = filter.read(s)
        return reading._replace(signals={**(reading.signals or {}), "nu": s.nu})

    return diagnoser_of(plant, filter._replace(read=shown), threshold_rule(plant, 0.05))


def residual(profile: str, snr: int) -> dict[str, Any]:
    """The source's test r'r > eps_r, without weights, on three flights: the largest r'r there is."""
    plant, _, record = flights(profile, snr, slice(3))
    nu = (run(innovations(plant), record.obs, signals=True).signals or {})["nu"][:, 100:]
    squares = (nu**2).sum(axis=2)
    return {
        "largest": squares.max(axis=1).tolist(),
        "eps_r": EPS_R,
        "above": [int(n) for n in (squares > EPS_R).sum(axis=1)],
    }
