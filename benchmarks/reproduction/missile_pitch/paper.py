"""The study's own: equation 11 (when a fault is detectable), and states estimated together with faults."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from baselines.filters import approximation_detector as detection
from baselines.filters import missile_model as model
from benchmarks.reproduction.comparison import rms
from benchmarks.reproduction.missile_pitch.measure import DT, STEPS, STUDIED, Q, agreement_plan, fault_function, numbered
from benchmarks.reproduction.pieces import Jobs
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.engine import simulate
from fdi_gym.plant import Array
from fdi_gym.plants import missile_pitch as missile

ESTIMATORS = ("approximation_detector", "gos", "augmented_ekf_bank")
EPISODES = 60


def plan(quick: bool) -> Jobs:
    """What the page needs, the study's own first."""
    jobs: Jobs = {"detectability": (detectability, ())}
    jobs |= {f"states {name}": (states, (name, 6 if quick else EPISODES)) for name in ESTIMATORS}
    return jobs | agreement_plan(quick)


def filtered(s: Array) -> Array:
    """The integral of exp(-g (t - tau)) s(tau), s (K + 1,) linear between samples, as all estimators have it."""
    found = np.zeros(len(s))
    for k in range(1, len(s)):
        found[k] = detection.A * found[k - 1] + detection.B0 * s[k - 1] + detection.B1 * s[k]
    return found


def detectability() -> dict[str, Any]:
    """Equation 11, noise-free: |filtered fault| > 2 thresholds, from the onset on; both sides and the first time [s]."""
    plant = missile.plant(noise_scale=0.0)
    flown = simulate(plant, [missile.study(), missile.study(2)])
    said = run(make_diagnoser("approximation_detector", plant), flown.obs)
    found: dict[str, Any] = {}
    for i, name in enumerate(("study", "mirror")):
        alpha = flown.state[i, :, 0]
        left = np.abs(filtered(flown.theta[i, :, i] * fault_function(flown, i, STUDIED[i])))
        bound = filtered(model.uncertainty_bound(alpha, np.full(len(alpha), missile.MACH))[:, Q])
        right = 2 * (bound + detection.NU_0[Q])  # the threshold with its numerical floor
        met = left > right
        alarm = np.flatnonzero(said.alarm[i])
        found[name] = {
            "T_11": float(met.argmax() * DT) if met.any() else math.nan,
            "T_d": float(alarm[0] * DT) if alarm.size else math.nan,
            "left": [float(f"{v:.4g}") for v in left[::5]], "right": [float(f"{v:.4g}") for v in right[::5]],
        }  # fmt: skip
    return found


def states(name: str, episodes: int) -> dict[str, Any]:
    """RMSE of incidence [deg] and pitch rate [deg/s] per numbered episode, of a method and of the sensors."""
    plant, scenarios, noise = numbered(range(10_000, 10_000 + episodes), 1.0, 1.0)
    flown = simulate(plant, scenarios, noise)
    said = run(make_diagnoser(name, plant), flown.obs)
    y = plant.split(flown.obs)[0]
    if said.state is None:
        return {"states": None, "sensors": None}
    settled = slice(100, STEPS + 1)
    deg = 180 / math.pi
    return {
        "states": (deg * rms((said.state - flown.state)[:, settled, :2], axis=1)).tolist(),
        "sensors": (deg * rms((y[..., :2] - flown.state[..., :2])[:, settled], axis=1)).tolist(),
    }  # fmt: skip
