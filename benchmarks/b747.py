"""Speed of the 747's environment and filters: ratios side by side in one run.

    python benchmarks/b747.py        (needs the extra "bench")

An environment step counts the simulation of its episode: whole episodes are played, resets included. All times are core
time of one thread, so that what else the machine does matters little.
"""

import os
import time

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import gymnasium as gym
import numpy as np
import scipy.linalg
from filterpy.kalman import KalmanFilter

import fdi_gym  # noqa: F401
from baselines.filters import augmented_kf, two_stage_kf
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.estimation.linear import linear_model
from fdi_gym.faults import draw
from fdi_gym.plants import b747_lateral as b747


class PlainB747(gym.Env):
    """The same plant as one would first write it: NumPy, one step at a time."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (6,), np.float64)
    action_space = gym.spaces.Discrete(5)

    def __init__(self):
        block = np.zeros((6, 6))
        block[:4, :4], block[:4, 4:] = b747.A_PRINTED, b747.B_PRINTED
        M = scipy.linalg.expm(block * b747.DT)
        self.A, self.B = M[:4, :4], M[:4, 4:]
        self.amplitude, self.omega = b747.MULTISINE_AMPLITUDE, b747.MULTISINE_OMEGA

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        rng = self.np_random
        self.x, self.k, self.gamma, self.b = np.zeros(4), 0, np.zeros(2), np.zeros(2)
        self.scale, self.phases = rng.uniform(0.5, 1.5), rng.uniform(0, 2 * np.pi, (2, 3))
        self.onset = int(rng.integers(200, 801)) if rng.random() < 0.8 else 10**9
        self.surface, self.loss = int(rng.integers(2)), rng.uniform(-0.9, -0.3)
        return self._observe(np.zeros(2)), {}

    def _observe(self, u):
        y = self.x + np.array(b747.SIGMA_V) * self.np_random.standard_normal(4)
        return np.concatenate([y, u])

    def step(self, action):
        label = 1 + 2 * self.surface if self.k > self.onset else 0
        u = self.scale * (self.amplitude * np.sin(self.omega * self.k * b747.DT + self.phases)).sum(axis=1)
        u = np.clip(u, [-20, -4], [20, 4])
        if self.k == self.onset:
            self.gamma[self.surface] = self.loss
        self.x = self.A @ self.x + self.B @ ((1 + self.gamma) * u + self.b)
        self.x = self.x + np.array(b747.SIGMA_W) * self.np_random.standard_normal(4)
        self.k += 1
        return self._observe(u), float(action == label), False, self.k == b747.STEPS, {}


def per_step(env, steps=60_000):
    """Microseconds per step of a single environment, whole episodes."""
    env.reset(seed=0)
    start = time.process_time()
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(0)
        if terminated or truncated:
            env.reset()
    return 1e6 * (time.process_time() - start) / steps


def filter_times(n=64, steps=300):
    """Microseconds per filter step and episode: ours in a batch, FilterPy's on the same augmented model."""
    plant = load_plant("B747Lateral")
    obs = simulate(plant, [draw(plant.process("standard"), s) for s in range(n)]).obs
    model, prior = linear_model(plant), two_stage_kf.prior(plant)
    found = {}
    for name, module in (("two-stage", two_stage_kf), ("augmented", augmented_kf)):
        s = module.start(n, 4, *prior)
        start = time.process_time()
        for k in range(1, steps + 1):
            y, u, _ = plant.split(obs[:, k])
            Pz = two_stage_kf.forget(s.Pz, "exponential", 0.99, 0.0, 1.0)
            s = module.step(s, u, y, model, plant.Q, plant.R, Pz)
        found[name] = 1e6 * (time.process_time() - start) / (steps * n)
        last = s.z[0]
    reference = KalmanFilter(dim_x=8, dim_z=4, dim_u=2)
    reference.x, reference.P = np.zeros(8), scipy.linalg.block_diag(*prior)
    reference.H, reference.R = np.hstack([model.C, np.zeros((4, 4))]), plant.R
    reference.B = np.vstack([model.B, np.zeros((4, 2))])
    start = time.process_time()
    for k in range(1, steps + 1):
        y, u, _ = plant.split(obs[0, k])
        F = np.eye(8)
        F[:4, :4], F[:4, 4:] = model.A, model.E(u[None])[0]
        Pz = reference.P[4:, 4:]
        grown = two_stage_kf.forget(Pz[None], "exponential", 0.99, 0.0, 1.0)[0] - Pz
        reference.predict(u=u, F=F, Q=scipy.linalg.block_diag(plant.Q, grown))
        reference.update(y)
    found["FilterPy KalmanFilter, augmented"] = 1e6 * (time.process_time() - start) / steps
    assert np.allclose(np.ravel(reference.x)[4:], last, atol=1e-8), "the two filters are not the same filter"
    return found


def main():
    env = gym.make("B747Lateral-Faults-v0")
    single = {
        "B747Lateral-Faults-v0": env,
        "the same in plain NumPy": gym.wrappers.OrderEnforcing(gym.wrappers.PassiveEnvChecker(PlainB747())),
    }
    for name in single:
        per_step(single[name], 3000)  # warm
    times = {name: per_step(single[name]) for name in single}
    ours = times["B747Lateral-Faults-v0"]
    print("one environment step from Python, us")
    for name, value in times.items():
        print(f"  {name:36s} {value:9.2f}   {value / ours:7.2f} x")
    times = filter_times()
    print("one filter step per episode, us (ours in a batch of 64)")
    for name, value in times.items():
        print(f"  {name:36s} {value:9.2f}   {value / times['two-stage']:7.1f} x")


if __name__ == "__main__":
    main()
