"""How fast the satellite's filters are: `python benchmarks/cmg_filters.py`.

Processor time of one core (one thread of BLAS), best of three. FilterPy's unscented filter runs the same model over the
compiled plant and over one written in NumPy; its estimates are checked against ours.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from dataclasses import dataclass

import numpy as np
import tyro
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from baselines.filters.joint_ukf import N_XI
from fdi_gym.diagnosis import make_diagnoser
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.plant import Plant
from fdi_gym.plants import cmg_satellite as cmg


def rates(x, r, f):
    """The plant's equations in NumPy, as one would first write them."""
    q, w, d = x[:4], x[4:7], x[7:]
    A, E = cmg.cluster(d)
    J = np.diag(cmg.JS) - cmg.JW * A @ A.T
    h = cmg.H0 * E @ np.ones(4)
    hdot = cmg.H0 * A @ (f * r)
    wdot = np.linalg.solve(J, -np.cross(w, np.array(cmg.JS) * w + h) - hdot)
    qdot = 0.5 * np.concatenate([q[3] * w + np.cross(q[:3], w), [-q[:3] @ w]])
    return np.concatenate([qdot, wdot, r])


def numpy_step(x, r, f):
    """One Runge-Kutta step and the quaternion's normalisation."""
    h = cmg.DT
    k1 = rates(x, r, f)
    k2 = rates(x + 0.5 * h * k1, r, f)
    k3 = rates(x + 0.5 * h * k2, r, f)
    k4 = rates(x + h * k3, r, f)
    x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    x[:4] /= np.linalg.norm(x[:4])
    return x


def filterpy_filter(plant: Plant, y0: np.ndarray, compiled: bool) -> UnscentedKalmanFilter:
    """FilterPy's filter with the data sheet's model and tuning."""

    def fx(x, dt, sign, r):
        full = np.concatenate([x[:3], [sign * np.sqrt(max(0.0, 1.0 - x[:3] @ x[:3]))], x[3:N_XI]])
        full = plant.propagate(0.0, full, r, x[N_XI:]) if compiled else numpy_step(full, r, x[N_XI:])
        return np.concatenate([full[:3], full[4:], x[N_XI:]])

    points = MerweScaledSigmaPoints(14, alpha=1.0, beta=0.0, kappa=2.0)
    ukf = UnscentedKalmanFilter(14, N_XI, cmg.DT, lambda x: x[:N_XI], fx, points)
    R = plant.R[:N_XI, :N_XI]
    ukf.x = np.concatenate([y0, np.ones(4)])
    ukf.P, ukf.R = np.diag([*np.diag(R), *[1e-4] * 4]), R
    ukf.Q = np.diag([cmg.SIGMA_Q**2] * N_XI + [1e-10] * 4)
    return ukf


def best(function, repeats: int = 3) -> float:
    """Processor seconds of the quickest of some calls."""
    taken = []
    for _ in range(repeats):
        begun = time.process_time()
        function()
        taken.append(time.process_time() - begun)
    return min(taken)


@dataclass
class Arguments:
    """What is measured."""

    batch: int = 64
    """Episodes side by side."""
    samples: int = 2000
    """Length of the batch run; times are given for 20,000 samples (200 s)."""


def main(arguments: Arguments) -> None:
    """Measure and print."""
    plant = load_plant("CMGSatellite")
    scenario = cmg.table4("slew")
    record = simulate(plant, [scenario])

    def filter_run(name: str, obs: np.ndarray):
        def go():
            diagnoser = make_diagnoser(name, plant)
            state = diagnoser.init(len(obs))
            for k in range(obs.shape[1]):
                state, said = diagnoser.update(state, obs[:, k])
            return said.estimate

        return go

    # the batch flies the part of the time line around a change, so that its share of adapted steps is not flattered
    n, length = arguments.batch, arguments.samples
    obs = simulate(plant, [scenario.replace(noise_seed=i) for i in range(n)]).obs[:, : 2000 + length // 2]
    obs = obs[:, -length:].copy()
    print(f"{'diagnoser':<12} {'alone, s per 200 s':>20} {'in a batch of ' + str(n) + ', s per 200 s':>32}")
    for name in ("joint_ukf", "sgaukf", "gaukf", "caukf", "dual_ukf", "mekf"):
        alone = best(filter_run(name, record.obs[:, :4001]), 1) * 5
        batch = best(filter_run(name, obs), 1) / n * 20000 / length
        print(f"{name:<12} {alone:>20.2f} {batch:>32.2f}")

    y, sign, r = record.obs[0, :, :N_XI], record.obs[0, :, N_XI], record.obs[0, :, 11:15]
    ours = {}
    for count in (1, n):
        flight = np.repeat(record.obs[:, :301], count, axis=0)
        ours[count] = best(filter_run("joint_ukf", flight)) / 300 / count
    found = filter_run("joint_ukf", record.obs[:, :101])()
    assert found is not None
    reference = found[0]
    for compiled, steps in ((True, 100), (False, 20)):
        ukf = filterpy_filter(plant, y[0], compiled)
        begun = time.process_time()
        for k in range(1, steps + 1):
            ukf.predict(sign=sign[k - 1], r=r[k])
            ukf.update(y[k])
        taken = (time.process_time() - begun) / steps
        if compiled:
            np.testing.assert_allclose(ukf.x[N_XI:], reference, rtol=1e-8)
        print(
            f"FilterPy over the {'compiled' if compiled else 'NumPy'} plant: {1e6 * taken:.0f} us a step; "
            f"ours {1e6 * ours[1]:.0f} us alone ({taken / ours[1]:.0f} times faster), "
            f"{1e6 * ours[n]:.0f} us in a batch of {n} ({taken / ours[n]:.0f} times)"
        )


if __name__ == "__main__":
    main(tyro.cli(Arguments))
