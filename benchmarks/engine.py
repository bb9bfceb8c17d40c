"""Speed, start-up and memory of the environments: ratios within one run, medians of interleaved repeats, resets counted.

    python benchmarks/engine.py [--repeats 5] [--chunks]

CPU time is the process's own, so that what else the machine does matters little; wall time is what two threads gain where
they have two cores. `--chunks` measures the length of the chunks that are flown ahead.
"""

import os

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import argparse
import resource
import statistics
import subprocess
import sys
import time

import gymnasium as gym
import numpy as np

import fdi_gym  # noqa: F401
from fdi_gym import rules
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import draw


class Clock:
    """CPU and wall seconds since it was made."""

    def __init__(self):
        self.cpu, self.wall = time.process_time(), time.perf_counter()

    def read(self):
        return time.process_time() - self.cpu, time.perf_counter() - self.wall


def single(env, steps):
    """Microseconds of CPU per step from Python, whole episodes."""
    env.reset()
    clock = Clock()
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(0)
        if terminated or truncated:
            env.reset()
    return 1e6 * clock.read()[0] / steps


def five(env, episodes=60):
    """Microseconds of CPU per step of episodes that the agent leaves after five steps."""
    clock = Clock()
    for _ in range(episodes):
        env.reset()
        for _ in range(5):
            env.step(0)
    return 1e6 * clock.read()[0] / (5 * episodes)


def amortised(envs, samples):
    """Million steps per second, CPU and wall, over so many steps, from the running state."""
    actions = np.zeros(envs.num_envs, int)
    clock = Clock()
    for _ in range(samples):
        envs.step(actions)
    return [1e-6 * samples * envs.num_envs / seconds for seconds in clock.read()]


def probed(envs, steps):
    """M samples per CPU second of a vector environment, ten an action; actions are drawn, probes with them."""
    envs.action_space.seed(0)
    drawn = [envs.action_space.sample() for _ in range(16)]
    clock = Clock()
    for k in range(steps):
        envs.step(drawn[k % 16])
    return 1e-6 * 10 * steps * envs.num_envs / clock.read()[0]


def stalls(envs, steps):
    """Milliseconds of CPU of a step: the median, the longest, and the longest of those about the ends of flights."""
    actions, spent, begins = np.zeros(envs.num_envs, int), [], []
    for _ in range(steps):
        clock = Clock()
        _, _, terminated, truncated, _ = envs.step(actions)
        spent.append(1e3 * clock.read()[0])
        begins.append(bool((terminated | truncated).any()))
    begins = np.array(begins) | np.roll(begins, 1)  # they begin in the step of the end, or in the next
    return statistics.median(spent), max(spent), max(np.array(spent)[begins], default=0.0)


def bridge(venv, steps):
    """Thousand agent steps per second of CPU through an SB3 environment."""
    actions = np.zeros(venv.num_envs, int)
    clock = Clock()
    for _ in range(steps):
        venv.step(actions)
    return 1e-3 * steps * venv.num_envs / clock.read()[0]


def interleaved(measures, repeats):
    """The median of each measure over rounds in which every one has its turn; each may give several numbers."""
    found = {name: [] for name in measures}
    for number in range(repeats + 1):
        for name, measure in measures.items():
            value = np.atleast_1d(measure())
            if number:  # the first round warms
                found[name].append(value)
    return {name: [statistics.median(column) for column in np.array(rows).T] for name, rows in found.items()}


FIRST_STEP = """
import time, numpy as np, gymnasium as gym, fdi_gym
def peak():  # resource's figure would be that of the process which started this one
    return next(int(line.split()[1]) / 1024 for line in open("/proc/self/status") if line.startswith("VmHWM"))
envs = gym.make_vec("{plant}-Faults-v0", num_envs={n})
small = gym.make_vec("{plant}-Faults-v0", num_envs=2)
small.reset(seed=0), small.step(np.zeros(2, int))
before, start = peak(), time.perf_counter()
cpu = time.process_time()
envs.reset(seed=0)
envs.step(np.zeros({n}, int))
wall, cpu = time.perf_counter() - start, time.process_time() - cpu
for _ in range({more}):
    envs.step(np.zeros({n}, int))
print(wall, cpu, peak(), before)
"""

START = """
import time
start = time.perf_counter()
import gymnasium as gym, fdi_gym
env = gym.make("{plant}-Faults-v0")
env.reset(seed=0), env.step(0)
print(time.perf_counter() - start, time.process_time())
"""


def fresh(code):
    """The numbers that a new process prints."""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return [float(word) for word in run.stdout.split()]


def chunk_lengths(repeats):
    """CPU nanoseconds per step of a vector environment, and the longest step, for chunks of several lengths."""
    for plant_id in ("B747Lateral", "CMGSatellite"):
        for chunk in (32, 64, 128, 256, 512, 1024):
            rules.CHUNK = chunk
            envs = gym.make_vec(f"{plant_id}-Faults-v0", num_envs=1024)
            envs.reset(seed=0)
            actions, longest = np.zeros(1024, int), 0.0
            rates = [amortised(envs, 600)[0] for _ in range(repeats)]
            for _ in range(600):
                clock = Clock()
                envs.step(actions)
                longest = max(longest, clock.read()[0])
            print(f"{plant_id:14s} chunk {chunk:5d}: {1e3 / statistics.median(rates):6.0f} ns a step, the longest step "
                  f"{1e3 * longest:6.0f} ms of CPU", flush=True)  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--chunks", action="store_true")
    arguments = parser.parse_args()
    if arguments.chunks:
        return chunk_lengths(arguments.repeats)
    print(f"load of the machine before: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; threads of the engine: as many")

    plants = list(plant_sources())
    ids = {plant: f"{plant}-Faults-v0" for plant in plants} | {"CartPole": "CartPole-v1"}
    made = {name: gym.make(env_id) for name, env_id in ids.items()}
    for env in made.values():
        env.reset(seed=0)
    whole = interleaved({name: lambda env=env: single(env, 12_000) for name, env in made.items()}, arguments.repeats)
    short = interleaved({name: lambda env=env: five(env) for name, env in made.items()}, arguments.repeats)
    base = whole["CartPole"][0]
    print(f"\n{'one at a time, CPU us a step':32s} {'whole':>7s} {'/CartPole':>9s} {'of five':>8s} {'/CartPole':>9s}")
    for name in ids:
        print(f"  {name:30s} {whole[name][0]:7.2f} {whole[name][0] / base:9.2f} {short[name][0]:8.1f} "
              f"{short[name][0] / base:9.1f}")  # fmt: skip

    length = {plant: draw(load_plant(plant).process("standard"), 0).steps for plant in plants}
    many = {plant: gym.make_vec(ids[plant], num_envs=1024) for plant in plants}
    many |= {f"{plant} truth=False": gym.make_vec(ids[plant], num_envs=1024, truth=False) for plant in plants}
    many["CartPole"] = gym.make_vec("CartPole-v1", num_envs=1024, vectorization_mode="vector_entry_point")
    for envs in many.values():
        envs.reset(seed=0)
    steps = {name: min(length.get(name.split()[0], 1000), 2500) for name in many}
    rates = interleaved({name: lambda e=envs, s=steps[name]: amortised(e, s) for name, envs in many.items()},
                        max(arguments.repeats // 2, 1))  # fmt: skip
    print(f"\n{'1,024 at once, M steps/s':32s} {'CPU':>7s} {'wall':>7s}   over a flight, or 2,500 steps of a longer one")
    for name, (cpu, wall) in rates.items():
        print(f"  {name:30s} {cpu:7.2f} {wall:7.2f}")
    print(f"{'1,024 at once, CPU ms a step':32s} {'median':>7s} {'longest':>7s} {'at ends':>7s}")
    for plant in (p for p in plants if length[p] <= 2500):
        envs = gym.make_vec(ids[plant], num_envs=1024)
        envs.reset(seed=0)
        median, longest, ends = stalls(envs, length[plant] + 2)
        print(f"  {plant:30s} {median:7.2f} {longest:7.0f} {ends:7.0f}")
    most = gym.make_vec(ids["B747Lateral"], num_envs=8192)
    most.reset(seed=0)
    cpu, wall = interleaved({"": lambda: amortised(most, 1200)}, 1)[""]
    print(f"  {'B747Lateral at 8,192':30s} {cpu:7.2f} {wall:7.2f}")

    print(f"{'1,024 at once, ten samples an action, M samples/s of CPU':56s} {'passive':>8s} {'active':>7s} {'ratio':>6s}")
    for plant in (p for p in plants if load_plant(p).acting is not None):
        pair = {kind: gym.make_vec(f"{plant}-{kind}-v0", num_envs=1024, decision_period=10) for kind in ("Faults", "Active")}
        for envs in pair.values():
            envs.reset(seed=0)
        pace = interleaved({kind: lambda e=envs: probed(e, 60) for kind, envs in pair.items()}, arguments.repeats)
        passive, active = pace["Faults"][0], pace["Active"][0]
        print(f"  {plant:54s} {passive:8.2f} {active:7.2f} {active / passive:6.2f}")

    for plant in plants:
        wall, cpu, _, _ = fresh(FIRST_STEP.format(plant=plant, n=8192, more=0))
        print(f"first step at 8,192, warm: {plant:14s} {wall:6.2f} s, {cpu:.2f} s of CPU")
    for plant in plants:
        _, _, peak, before = fresh(FIRST_STEP.format(plant=plant, n=1024, more=600))
        print(f"peak memory at 1,024: {plant:14s} {peak:6.0f} MiB, of which {before:.0f} before there are environments")
    for plant in plants:
        wall, cpu = fresh(START.format(plant=plant))
        print(f"import to first step, warm: {plant:14s} {wall:5.2f} s, {cpu:.2f} s of CPU")

    from stable_baselines3.common.vec_env import DummyVecEnv

    from fdi_gym.sb3 import make_vec_env

    ours = make_vec_env(ids["B747Lateral"], 256, seed=0)
    dummy = DummyVecEnv([lambda: FDIEnv("B747Lateral") for _ in range(256)])
    ours.reset(), dummy.reset()
    found = interleaved({"bridge": lambda: bridge(ours, 2400), "dummy": lambda: bridge(dummy, 300)}, 3)
    print(f"SB3 bridge / DummyVecEnv at 256: {found['bridge'][0] / found['dummy'][0]:.1f} "
          f"({found['bridge'][0]:.0f} and {found['dummy'][0]:.0f} thousand steps/s of CPU)")  # fmt: skip
    print(f"peak memory of this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB; "
          f"load after: {os.getloadavg()[0]:.1f}")  # fmt: skip
    return None


if __name__ == "__main__":
    main()
