"""Microseconds per filter step and episode on the hovering helicopter, beside FilterPy's UKF on the same model.

    OMP_NUM_THREADS=1 python benchmarks/huav_filters.py [--batch 64] [--steps 50]

Every diagnoser runs a batch of episodes, decision logic included. FilterPy's UKF runs one episode at a time (it knows no
batches) on the augmented model [x; b; d] with the same statistics: once over this package's compiled plant, and once
over the same equations as plain Python, as its users write them. Each figure is the fastest of several rounds, taken in
turns, so that all see the same machine.
"""

import argparse
import json
import time

import numpy as np
import scipy.linalg
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from fdi_gym.diagnosis import make_diagnoser
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.plants.huav_hover import DT, dynamics, episode

X0_STD = (*[0.1] * 3, *[0.02] * 6, *[0.005] * 2)  # as in baselines/tuning/HUAVHover.json
NAMES = ("ascdkf", "three_stage_cdkf", "three_stage_ekf", "robust_three_stage_cdkf", "robust_three_stage_ekf",
         "hypothesis_bank")  # fmt: skip


def python_step(x, u, theta, d, p):
    """One Runge-Kutta step of the plant's equations, not compiled."""

    def rate(x):
        dx = np.empty(11)
        dynamics.py_func(0.0, x, u, theta, d, p, dx)
        return dx

    k1 = rate(x)
    k2 = rate(x + DT / 2 * k1)
    k3 = rate(x + DT / 2 * k2)
    k4 = rate(x + DT * k3)
    return x + DT / 6 * (k1 + 2 * (k2 + k3) + k4)


def filterpy_ukf(plant, compiled):
    """FilterPy's UKF on [x; b; d]: 17 states."""
    n_x, n = len(plant.states), len(plant.states) + 6
    theta = plant.nominal_theta.copy()

    def fx(xa, dt, u):
        theta[4:] = xa[n_x : n_x + 4]
        after = xa.copy()
        if compiled:
            after[:n_x] = plant.propagate(0.0, xa[:n_x], u, theta, xa[n_x + 4 :])
        else:
            after[:n_x] = python_step(xa[:n_x], u, theta, xa[n_x + 4 :], plant.nominal_p)
        return after

    ukf = UnscentedKalmanFilter(
        n, 9, plant.dt, lambda xa: xa[:9], fx, MerweScaledSigmaPoints(n, alpha=0.1, beta=2.0, kappa=3.0 - n)
    )
    ukf.x = np.concatenate([plant.trim_state, np.zeros(6)])
    ukf.P = np.diag(np.square([*X0_STD, *[2e-3] * 4, 0.5, 0.5]))
    ukf.Q = scipy.linalg.block_diag(plant.Q, 7e-4**2 * np.eye(4), 0.05**2 * np.eye(2))
    ukf.R = plant.R
    return ukf


def measure(batch=64, steps=50, rounds=5):
    """Microseconds per step and episode, by name."""
    plant = load_plant("HUAVHover")
    obs = simulate(plant, [episode(seed) for seed in range(batch)]).obs
    y, u, _ = plant.split(obs)
    states, best = {}, {}
    built = {name: make_diagnoser(name, plant) for name in NAMES}
    for name, diagnoser in built.items():
        states[name] = diagnoser.init(batch)
        for k in range(5):
            states[name], _ = diagnoser.update(states[name], obs[:, k])
    peers = {f"filterpy UKF, {kind} plant": filterpy_ukf(plant, kind == "compiled") for kind in ("compiled", "python")}
    for turn in range(rounds):
        first = 5 + turn * steps
        for name, diagnoser in built.items():
            begin = time.perf_counter()
            for k in range(first, first + steps):
                states[name], _ = diagnoser.update(states[name], obs[:, k])
            best[name] = min(best.get(name, np.inf), (time.perf_counter() - begin) / steps / batch)
        for name, ukf in peers.items():
            begin = time.perf_counter()
            for k in range(first, first + steps):
                ukf.predict(u=u[0, k])
                ukf.update(y[0, k])
            best[name] = min(best.get(name, np.inf), (time.perf_counter() - begin) / steps)
    return {name: 1e6 * seconds for name, seconds in best.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--steps", type=int, default=50, help="steps per round")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = measure(arguments.batch, arguments.steps)
    if arguments.json:
        print(json.dumps({name: round(value, 2) for name, value in found.items()}))
        return
    print(f"batch of {arguments.batch}: microseconds per step and episode, and how much faster than FilterPy's UKF")
    print(f"{'':28s} {'us':>9s} {'compiled':>9s} {'python':>9s}")
    peers = [found[f"filterpy UKF, {kind} plant"] for kind in ("compiled", "python")]
    for name, value in found.items():
        print(f"{name:28s} {value:9.1f} {peers[0] / value:9.1f} {peers[1] / value:9.1f}")


if __name__ == "__main__":
    main()
