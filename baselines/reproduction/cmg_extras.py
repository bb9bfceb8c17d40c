"""Pieces of the satellite's page that are not campaigns: the bound over time, one tracked flight, what else was tried."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines.filters.mekf import first_covariance
from baselines.oracles.cramer_rao_oracle import Q_FLOOR, bound_step, opened
from baselines.reproduction.cmg_campaign import Piece, scenarios_of, table4_outcome, watch
from baselines.reproduction.numbered import fly
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate, white_noise
from fdi_gym.faults import FaultScenario
from fdi_gym.plants import cmg_satellite as cmg

AFTER = (100, 300, 1000, 3000)  # samples after the onset at which the bound is read
# other readings of the data sheet's regulation at 75 dB: options of the plant, process noise, tuning of the filter
TRIED: dict[str, tuple[dict[str, Any], float, dict[str, Any]]] = {
    "as the data sheet": ({}, 1.0, {}),
    "pseudo-inverse steering": ({"steering": "pinv"}, 1.0, {}),
    "true-state feedback": ({"feedback": "true"}, 1.0, {}),
    "no process noise": ({}, 0.0, {}),
    "R = (1e-4)^2 I": ({}, 1.0, {"sigma_r": 1e-4}),
}


def bound_piece(reference: str, snr: int, onset: int, count: int, excitation: str = "none") -> list[list[list[float]]]:
    """sd of f along its principal directions (AFTER, count, 4) that the bound leaves after a change in healthy flight."""
    plant = load_plant(cmg.ID, reference=reference, snr=snr, excitation=excitation)
    steps = onset + AFTER[-1]
    scenarios = [
        FaultScenario(plant=cmg.ID, steps=steps, reference={"profile": reference}, noise_seed=900 + i) for i in range(count)
    ]
    record = fly(plant, scenarios)
    x, r, f = record.state, plant.split(record.obs)[1], np.ones((count, 4))
    R = plant.R[:6, :6]
    Q = np.diag([0.0] * 3 + [max(cmg.SIGMA_Q, Q_FLOOR) ** 2] * 3 + [0.0] * 4)
    P, found = first_covariance(x[:, 0, :4], R, 0.0), []
    for k in range(1, steps + 1):
        P = bound_step(P, x[:, k - 1], x[:, k], r[:, k], f, Q, R, wheel=False)
        if k - onset in AFTER:
            found.append(np.sqrt(np.linalg.eigvalsh(P[:, 6:, 6:])).tolist())
        if k == onset:
            P = opened(P, np.ones(count, bool))
    return found


def tracking_piece(reference: str, every: int = 20) -> dict[str, Any]:
    """Estimates over the source's time line at 45 dB, one sample in `every`."""
    plant = load_plant(cmg.ID, reference=reference, snr=45)
    scenarios = scenarios_of(Piece("table4", reference, 45, "SGAUKF", 0))[:1]
    record = fly(plant, scenarios)
    found: dict[str, Any] = {"truth": record.theta[0, ::every].tolist()}
    for method in ("SGAUKF", "MEKF", "CLAIR"):
        found[method] = watch(plant, scenarios, record, method).estimate[0, ::every].tolist()
    return found


def tried_piece(name: str) -> list[dict[str, Any]]:
    """Outcomes of the UKF over the source's time line, regulating at 75 dB, under another reading."""
    options, process_noise, tuning = TRIED[name]
    plant = load_plant(cmg.ID, reference="regulate", snr=75, **options)
    scenarios = scenarios_of(Piece("table4", "regulate", 75, "UKF", 0))
    noise = []
    for scenario in scenarios:
        w, v = white_noise(plant, np.random.default_rng(scenario.noise_seed), scenario.steps)
        noise.append((process_noise * w, v))
    record = simulate(plant, scenarios, noise)
    said = watch(plant, scenarios, record, "UKF", **tuning)
    return [table4_outcome(record, said, i) for i in range(len(scenarios))]
