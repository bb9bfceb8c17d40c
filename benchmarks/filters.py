"""Filters beside FilterPy's: `python benchmarks/filters.py` (needs the extra "bench").

The bare Gaussian step (predict and update, `fdi_gym.estimation.gaussian`) and whole diagnosers, decision included, at 1, 64
and 512 episodes side by side. References are FilterPy's filters on the same models: the Kalman filter on the 747's
augmented model, and the unscented filter with the same sigma points over the satellite's compiled plant, with its
augmented state (15) for the bare step and with the published joint state (14) for the diagnosers. All contestants take
turns, round by round, so that what else the machine does hits all; figures are medians of the rounds' core times on one
thread, per sample and episode. The bare steps are compared with FilterPy's numbers before anything is timed.
"""

import functools
import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import tyro
from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.estimation import gaussian
from fdi_gym.estimation.linear import linear_model
from fdi_gym.faults import draw
from fdi_gym.plant import Plant

KALMAN = ("two_stage_kf", "augmented_kf", "augmented_ekf")  # diagnosers of the 747
UNSCENTED = ("augmented_ukf", "joint_ukf")  # of the satellite
BATCHES = (1, 64, 512)
WORK = 12_800  # samples times episodes of a turn, at most
REFERENCE_SAMPLES = 50  # of a turn of FilterPy


@dataclass
class Arguments:
    """What is measured."""

    rounds: int = 9
    """Turns of each contestant."""
    diagnosers: bool = True
    """Whole diagnosers too, not only the bare step."""


class Filter(NamedTuple):
    """The augmented model of a plant with all of theta estimated, and what its filter believes."""

    plant: Plant
    model: gaussian.Model
    rule: str
    X0: np.ndarray  # (N,)
    P0: np.ndarray  # (N, N)
    Q: np.ndarray  # (N, N)
    R: np.ndarray  # (m, m)


def general(plant: Plant, rule: str, sensors: range, walk: float) -> Filter:
    """Linear sensors are told so, as every filter of the package does."""
    n_x, p, m = len(plant.states), len(plant.theta), len(sensors)
    scale = np.array([s.scale for s in (*plant.states, *plant.theta)])
    points = np.concatenate([np.zeros((1, n_x)), np.eye(n_x)])
    y = plant.measure(0.0, points, plant.trim_command)[:, sensors]
    H = np.hstack([(y[1:] - y[0]).T, np.zeros((m, p))])
    model = gaussian.bind(plant, scale=scale, entries=range(p), sensors=sensors, H=H)
    floor = [(1e-5 * s.scale) ** 2 for s in plant.states]
    Q = np.diag([*np.maximum(np.diag(plant.Q), floor), *[walk**2] * p])
    P0 = np.diag([*(0.01 * scale[:n_x]) ** 2, *[0.01] * p])
    X0 = np.concatenate([plant.trim_state, np.zeros(p)])
    return Filter(plant, model, rule, X0, P0, Q, np.ascontiguousarray(plant.R[:m, :m]))


def bare(flt: Filter, obs: np.ndarray) -> np.ndarray:
    """X (n, N) after the samples of obs (n, K + 1, n_obs)."""
    n, samples, _ = obs.shape
    X, P = np.tile(flt.X0, (n, 1)), np.tile(flt.P0, (n, 1, 1))
    Q, R, seen = flt.Q[None], flt.R[None], np.ones((n, flt.model.m), bool)
    t = np.zeros(1)
    for k in range(1, samples):
        y, u, _ = flt.plant.split(obs[:, k])
        y, u = np.ascontiguousarray(y[:, : flt.model.m]), np.ascontiguousarray(u)
        X, P = gaussian.predict(flt.model, flt.rule, X, P, t, u, None, Q)
        X, P, *_ = gaussian.update(flt.model, flt.rule, X, P, t, u, None, y, seen, R)
    return X


def filterpy_kalman(flt: Filter, obs: np.ndarray) -> np.ndarray:
    """X (N,) of FilterPy's Kalman filter after the samples of obs (K + 1, n_obs)."""
    linear, N, n_u = linear_model(flt.plant), len(flt.X0), len(flt.plant.commands)
    n_x = len(linear.A)
    kf = KalmanFilter(dim_x=N, dim_z=flt.model.m, dim_u=n_u)
    kf.x, kf.P, kf.R, kf.H = flt.X0.copy(), flt.P0.copy(), flt.R, flt.model.H
    kf.B = np.vstack([linear.B, np.zeros((N - n_x, n_u))])
    F = np.eye(N)
    F[:n_x, :n_x] = linear.A
    for k in range(1, len(obs)):
        y, u, _ = flt.plant.split(obs[k])
        F[:n_x, n_x:] = linear.E(u[None])[0]
        kf.predict(u=u, F=F, Q=flt.Q)
        kf.update(y)
    return kf.x


def filterpy_unscented(flt: Filter, obs: np.ndarray) -> np.ndarray:
    """X (N,) of FilterPy's unscented filter over the compiled plant."""
    plant, N, n_x = flt.plant, len(flt.X0), len(flt.plant.states)

    def fx(X, dt, u):
        moved = X.copy()
        moved[:n_x] = plant.propagate(0.0, X[:n_x], u, plant.nominal_theta + X[n_x:])
        return moved

    points = MerweScaledSigmaPoints(N, alpha=1.0, beta=0.0, kappa=2.0)
    ukf = UnscentedKalmanFilter(N, flt.model.m, plant.dt, lambda X: flt.model.H @ X, fx, points)
    ukf.x, ukf.P, ukf.Q, ukf.R = flt.X0.copy(), flt.P0.copy(), flt.Q, flt.R
    for k in range(1, len(obs)):
        y, u, _ = plant.split(obs[k])
        ukf.predict(u=u)
        ukf.update(y[: flt.model.m])
    return ukf.x


def filterpy_joint(flt: Filter, obs: np.ndarray) -> np.ndarray:
    """The same with the published state: (q1..q3, w, d, f), the fourth component of q from the sign that is measured."""
    plant = flt.plant

    def fx(X, dt, u, sign):
        full = np.concatenate([X[:3], [sign * np.sqrt(max(0.0, 1.0 - X[:3] @ X[:3]))], X[3:10]])
        full = plant.propagate(0.0, full, u, X[10:])
        return np.concatenate([full[:3], full[4:], X[10:]])

    points = MerweScaledSigmaPoints(14, alpha=1.0, beta=0.0, kappa=2.0)
    ukf = UnscentedKalmanFilter(14, 10, plant.dt, lambda X: X[:10], fx, points)
    keep = [0, 1, 2, *range(4, 15)]
    ukf.x = np.concatenate([obs[0, :10], np.ones(4)])
    ukf.P, ukf.Q, ukf.R = flt.P0[np.ix_(keep, keep)], flt.Q[np.ix_(keep, keep)], flt.R
    for k in range(1, len(obs)):
        y, u, _ = plant.split(obs[k])
        ukf.predict(u=u, sign=obs[k - 1, 10])
        ukf.update(y[:10])
    return ukf.x


class Contestant(NamedTuple):
    """What is timed: a call that takes `samples` samples of `episodes` episodes."""

    name: str
    episodes: int
    samples: int
    call: Callable[[], object]


def medians(contestants: list[Contestant], rounds: int) -> list[float]:
    """Core seconds per sample and episode of each."""
    taken = np.zeros((rounds, len(contestants)))
    for contestant in contestants:
        contestant.call()
    for turn in range(rounds):
        for i, c in enumerate(contestants):
            begun = time.process_time()
            c.call()
            taken[turn, i] = (time.process_time() - begun) / (c.samples * c.episodes)
    return np.median(taken, axis=0).tolist()


def compare(title: str, references: list[Contestant], ours: list[tuple[Contestant, int]], rounds: int) -> None:
    """Time all in turns; ours beside the reference of that index."""
    times = medians([*references, *(c for c, _ in ours)], rounds)
    print(f"\n{title}\n{'':40s} {'episodes':>8s} {'us':>9s} {'times faster':>13s}")
    for c, seconds in zip(references, times, strict=False):
        print(f"{c.name:40s} {c.episodes:8d} {1e6 * seconds:9.2f}")
    for (c, against), seconds in zip(ours, times[len(references) :], strict=True):
        print(f"{c.name:40s} {c.episodes:8d} {1e6 * seconds:9.2f} {times[against] / seconds:13.1f}")


def flown(plant: Plant, samples: int) -> np.ndarray:
    """Observations (512, samples + 1, n_obs) of the standard process."""
    process = plant.process("standard")
    scenarios = [draw(process, seed).replace(steps=samples).without_faults() for seed in range(max(BATCHES))]
    return simulate(plant, scenarios).obs


def main(arguments: Arguments) -> None:
    """Measure and print."""
    kalman = general(load_plant("B747Lateral"), "extended", range(4), 1e-2)
    unscented = general(load_plant("CMGSatellite"), "unscented", range(10), 1e-5)
    for title, flt, forms, names in (
        ("Kalman filter, 747", kalman, {"KalmanFilter": filterpy_kalman}, KALMAN),
        (
            "Unscented Kalman filter, satellite", unscented,
            {"UnscentedKalmanFilter (15)": filterpy_unscented, "UnscentedKalmanFilter (14)": filterpy_joint}, UNSCENTED,
        ),
    ):  # fmt: skip
        obs = flown(flt.plant, WORK // 64)
        short = obs[0, : REFERENCE_SAMPLES + 1]
        std = np.sqrt(np.diag(flt.P0))
        np.testing.assert_allclose(
            bare(flt, short[None])[0] / std, next(iter(forms.values()))(flt, short) / std, rtol=1e-8, atol=1e-8
        )
        references = [
            Contestant(f"FilterPy {name}", 1, REFERENCE_SAMPLES, functools.partial(form, flt, short))
            for name, form in forms.items()
        ]
        ours: list[tuple[Contestant, int]] = []
        for n in BATCHES:
            samples = min(WORK // n, obs.shape[1] - 1)
            seen = np.ascontiguousarray(obs[:n, : samples + 1])
            ours.append((Contestant("bare step", n, samples, functools.partial(bare, flt, seen)), 0))
            for name in names if arguments.diagnosers else ():
                call = make_diagnoser(name, flt.plant)
                against = len(references) - 1
                ours.append((Contestant(name, n, samples, functools.partial(run, call, seen)), against))
        compare(title, references, ours, arguments.rounds)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
