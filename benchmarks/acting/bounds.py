"""What could be known about the effectiveness of a satellite at rest, with and without a probe: the Cramer-Rao bound."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines.filters.mekf import first_covariance
from baselines.oracles.cramer_rao_oracle import Q_FLOOR, bound_step, opened
from baselines.probing import never, periodic
from fdi_gym.agents import fly
from fdi_gym.diagnosis import make_diagnoser
from fdi_gym.discovery import load_plant
from fdi_gym.faults import draw
from fdi_gym.plants.cmg_satellite import SIGMA_Q

CHANGE, END = 2000, 4000  # samples: the effectiveness is unknown from 20 s on, and the bound is read at 40 s
PROBERS: dict[str, dict[str, Any]] = {
    "never": {},
    "null": {"on": 1, "every": 1, "probes": ("null",)},
    "common": {"on": 1, "every": 1, "probes": ("common",)},
    "both in turn": {"on": 2, "every": 2, "probes": ("null", "common")},
}


def bounds() -> list[dict[str, Any]]:
    """For each way of probing: the bound on an effectiveness, and on the common loss of all four; the attitude's error."""
    plant = load_plant("CMGSatellite", reference="regulate")
    flight = draw(plant.process("fault-free"), 2_000_000).replace(steps=END)
    nobody, rows = make_diagnoser("null", plant), []
    R, Q = plant.R[:6, :6], np.diag([0.0] * 3 + [max(SIGMA_Q, Q_FLOOR) ** 2] * 3 + [0.0] * 4)
    for name, settings in PROBERS.items():
        prober = periodic.prober(plant, **settings) if settings else never.prober(plant)
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
