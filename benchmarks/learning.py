"""Training samples per second through the bridge against DummyVecEnv, and inference time, as ratios within one run.

python benchmarks/learning.py [--seconds 5]
"""

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import argparse
import time

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from fdi_gym.diagnosis import NotApplicableError, make_diagnoser, run
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import simulate
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import draw
from fdi_gym.sb3 import FDIVecEnv, make_vec_env
from fdi_gym.wrappers import DelayAwareReward, VectorHistory

DIAGNOSERS = ("sequence_net", "residual_net", "ppo")


def pace(venv, seconds: float) -> float:
    """Agent steps per second over whole flights: flying them is part of it."""
    venv.seed(3_000_000)
    venv.reset()
    actions = np.zeros(venv.num_envs, dtype=int)
    steps, ends, start = 0, 0, time.perf_counter()
    while ends < venv.num_envs or time.perf_counter() - start < seconds:
        _, _, dones, _ = venv.step(actions)
        steps += venv.num_envs
        ends += int(dones.sum())
    return steps / (time.perf_counter() - start)


def wrapped(plant_id: str, n: int) -> FDIVecEnv:
    """What PPO trains on: windows and the delay-aware reward."""
    envs = make_vec_env(f"{plant_id}-Faults-v0", n, units="scaled", decision_period=10).envs
    return FDIVecEnv(VectorHistory(DelayAwareReward(envs), 16))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=3.0)
    seconds = parser.parse_args().seconds
    print(f"{'plant':14s} {'envs':>5s} {'DummyVecEnv':>12s} {'bridge':>12s} {'ratio':>6s}  {'with windows':>12s}  steps/s")
    for plant_id in plant_sources():
        for period in (1, 10):
            arguments = {"units": "scaled", "decision_period": period}
            n = 1024
            dummy = pace(DummyVecEnv([lambda p=plant_id, a=arguments: FDIEnv(p, **a) for _ in range(16)]), seconds)
            bridge = pace(make_vec_env(f"{plant_id}-Faults-v0", n, **arguments), seconds)
            windows = pace(wrapped(plant_id, n), seconds) if period == 10 else float("nan")
            print(f"{plant_id:14s} {n:5d} {dummy:12,.0f} {bridge:12,.0f} {bridge / dummy:6.1f}  {windows:12,.0f}  "
                  f"{period} samples a step", flush=True)  # fmt: skip
    print(f"\n{'plant':14s} {'diagnoser':14s} us/sample in a batch of 50, and alone")
    for plant_id in plant_sources():
        plant = load_plant(plant_id)
        obs = simulate(plant, [draw(plant.process("standard"), 2_000_000 + i) for i in range(50)]).obs[:, :1000]
        for name in DIAGNOSERS:
            try:
                diagnoser = make_diagnoser(name, plant)
            except NotApplicableError:
                continue
            times = []
            for batch in (obs, obs[:1]):
                start = time.perf_counter()
                run(diagnoser, batch)
                times.append(1e6 * (time.perf_counter() - start) / batch[..., 0].size)
            print(f"{plant_id:14s} {name:14s} {times[0]:8.1f} {times[1]:8.1f}", flush=True)


if __name__ == "__main__":
    main()
