"""What could be known with and without probes: of a satellite at rest, and of a 747 and a helicopter in quiet flight.

Of the satellite the Cramer-Rao bound on its effectivenesses. Of the others how well the size of a fault could be
known whose kind and onset are known: a fault moves the innovations of the healthy plant's Kalman filter by nu,
whitened, in proportion to its size as far as it is small, so that the size is known no better than to 1 / |nu| of
itself (for one sample or many).
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from baselines.filters.mekf import first_covariance
from baselines.oracles.cramer_rao_oracle import Q_FLOOR, bound_step, opened
from baselines.probing.doubt import examples, innovations, steady
from baselines.probing.periodic import periodic_probes
from fdi_gym.acts import Acts
from fdi_gym.agents import NEVER, fly
from fdi_gym.diagnosis import make_diagnoser
from fdi_gym.discovery import load_plant
from fdi_gym.engine import advance, no_noise
from fdi_gym.entrants import make_prober
from fdi_gym.faults import draw
from fdi_gym.flights import Flights
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.cmg_satellite import SIGMA_Q
from fdi_gym.suite import ActingSuite, load_suite
from fdi_gym.tables import markdown

CHANGE, END = 2000, 4000  # samples: the effectiveness is unknown from 20 s on, and the bound is read at 40 s
PROBERS: dict[str, dict[str, Any]] = {
    "never": {},
    "null": {"on": 1, "every": 1, "probes": ("null",)},
    "common": {"on": 1, "every": 1, "probes": ("common",)},
    "both in turn": {"on": 2, "every": 2, "probes": ("null", "common")},
}
QUIET = {"b747-active": 40.0, "huav-active": 6.0}  # suites, and seconds after the onset at which the bound is read

PAGE = """# Bounds, with and without probes

Written by `python -m benchmarks.acting --bounds`.

## The satellite at rest

The Cramer-Rao bound (a standard deviation; the prior is 0.5) on the four effectivenesses 20 s after they may have
changed, at 45 dB, and the attitude's error meanwhile. Null motion leaves the attitude alone and is blind to a loss
that all four share; common moves see that one.

{satellite}

## Quiet flight

How well the size of a fault could be known, as a share of itself, whose kind and onset are known: without a probe,
under each probe throughout, and under those that `greedy_probes` chooses. Below 1 it can be told from nothing.

{quiet}
"""


def satellite() -> list[dict[str, Any]]:
    """For each way of probing: the bound on an effectiveness, and on the common loss of all four; the attitude's error."""
    plant = load_plant("CMGSatellite", reference="regulate")
    flight = draw(plant.process("fault-free"), 2_000_000).replace(steps=END)
    nobody, rows = make_diagnoser("null", plant), []
    R, Q = plant.R[:6, :6], np.diag([0.0] * 3 + [max(SIGMA_Q, Q_FLOOR) ** 2] * 3 + [0.0] * 4)
    for name, settings in PROBERS.items():
        prober = periodic_probes(plant, **settings) if settings else NEVER
        record = fly(plant, [flight], nobody, prober, period=100).record
        x, r, f = record.state, plant.split(record.obs)[1], np.ones((1, 4))
        P = first_covariance(x[:, 0, :4], R, 0.0)
        for k in range(1, END + 1):
            P = bound_step(P, x[:, k - 1], x[:, k], r[:, k], f, Q, R, wheel=False)
            P = opened(P, np.array([k == CHANGE]))
        P_ff, ones = P[0, 6:, 6:], np.full(4, 0.5)
        angle = 2.0 * np.degrees(np.arcsin(np.minimum(np.linalg.norm(x[0, CHANGE:, :3], axis=1), 1.0)))
        rows.append({
            "probes": name, "effectiveness": float(np.sqrt(np.trace(P_ff) / 4)),
            "common": float(np.sqrt(ones @ P_ff @ ones)), "attitude": float(np.sqrt((angle**2).mean())),
        })  # fmt: skip
    return rows


def moved(plant: Plant, flights: list[Any], probes: Array, period: int) -> Array:
    """|nu| of each flight but the first, which is healthy: how far its fault moves the innovations, all without noise."""
    filtered, steps = steady(plant), flights[0].steps
    flown = Flights(plant, flights, [no_noise(plant, steps)] * len(flights))
    acts, parts, states = Acts(flown, accommodation=False), [], []
    advance(flown, 1)
    for first in range(1, steps, period):
        acts.choose(probes[:, first].astype(np.int64))
        chunk = acts.advance(min(period, steps - first))
        parts.append(chunk.obs.copy()), states.append(chunk.state.copy())
    obs, x = np.concatenate(parts), np.concatenate(states)
    nu = innovations(plant, filtered, x[0], obs, 1)
    return np.sqrt(np.nansum((nu[:, 1:] - nu[:, :1]) ** 2, axis=(0, 2)))


def quiet(name: str, seconds: float) -> list[list[str]]:
    """The bounds of one suite's plant: a line for each fault of one mode."""
    suite = load_suite(name)
    assert isinstance(suite, ActingSuite)
    plant, period = suite.build(), suite.decision_period
    assert plant.acting is not None
    faults, label, _ = examples(plant, suite.process)
    firsts = [int(np.flatnonzero(label == v)[0]) for v in np.unique(label) if v]
    onset = max(period, round(2.0 / plant.dt))
    steps = onset + round(seconds / plant.dt)
    base = draw(plant.process(suite.process), 2_000_000).without_faults().replace(physical={}, steps=steps)
    begun = [[msgspec.structs.replace(f, onset=onset, end=None) for f in faults[i]] for i in firsts]
    flights = [base, *(base.replace(faults=some) for some in begun)]
    n, found = len(flights), {}
    for number, probe in enumerate(plant.acting.probes):
        found[probe.name] = moved(plant, flights, np.full((n, steps + 1), number), period)
    on_board = make_diagnoser(suite.on_board, plant, process=suite.process)
    prober = make_prober("greedy_probes", plant, process=suite.process, period=period)
    chosen = fly(plant, flights, on_board, prober, period=period).probe
    found["chosen"] = moved(plant, flights, chosen, period)
    lines = []
    for j, i in enumerate(firsts):
        shares = [f"{1.0 / max(far[j], 1e-9):.3g}" if far[j] > 1e-6 else "nothing is known" for far in found.values()]
        lines.append([plant.labels[label[i]].name, *shares, f"{100 * (chosen[j + 1] > 0).mean():.0f}"])
    return [["fault", *found, "chosen: probed %"], *lines]


def page() -> str:
    """The page."""
    rows = [[r["probes"], f"{r['effectiveness']:.3f}", f"{r['common']:.3f}", f"{r['attitude']:.4f}"] for r in satellite()]
    head = ["probes", "bound on an effectiveness", "bound on the common loss", "attitude error, rms deg"]
    parts = []
    for name, seconds in QUIET.items():
        table = quiet(name, seconds)
        parts.append(f"### {name}, {seconds:g} s after the onset\n\n{markdown(table[0], table[1:])}")
    return PAGE.format(satellite=markdown(head, rows), quiet="\n\n".join(parts))
