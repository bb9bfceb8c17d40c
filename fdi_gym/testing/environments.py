"""What the environments of every plant must keep: one for many, no truth shown, streams apart."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from fdi_gym.drawing import streams
from fdi_gym.engine import simulate
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plant import Array, Plant
from fdi_gym.vector_envs import FDIVectorEnv


def _with_short_episodes(plant: Plant, process: str, lengths: Sequence[int]) -> Plant:
    """The plant with a process "short": the named one, squeezed into episodes of these lengths."""
    base = plant.process(process)

    def short(rng: np.random.Generator) -> FaultScenario:
        drawn = base.sample(rng)
        steps = int(rng.choice(lengths))
        faults = [
            msgspec.structs.replace(
                fault,
                onset=fault.onset * steps // drawn.steps,
                end=None if fault.end is None else fault.end * steps // drawn.steps,
            )
            for fault in drawn.faults
        ]
        return drawn.replace(steps=steps, faults=faults)

    squeezed = dataclasses.replace(base, name="short", sample=short)
    return dataclasses.replace(plant, processes={**plant.processes, "short": squeezed})


def check_vector_env(
    plant: Plant,
    n: int = 4,
    steps: int = 300,
    seed: int = 7,
    lengths: Sequence[int] = (40, 65, 90),
    process: str = "standard",
    **kwargs: Any,
) -> None:
    """The vector environment equals n single ones, sample by sample, with episodes that end at different times.

    In each autoreset mode: observations, rewards, ends and infos. Also: the same seeds give the same run; an episode is
    the same whatever its neighbours are; the truth is not in the observation.

    Args:
        plant: The plant.
        n: Environments.
        steps: Steps in each mode.
        seed: Of the first reset and of the actions.
        lengths: Episode lengths that occur, in samples.
        process: The fault process that is squeezed into them.
        kwargs: Further arguments of the environments (task, decision_period, units, mismatch).
    """
    cut = _with_short_episodes(plant, process, lengths)
    kwargs = {**kwargs, "process": "short"}
    rng = np.random.default_rng(seed)
    for mode in AutoresetMode:
        many, again = (FDIVectorEnv(cut, num_envs=n, autoreset_mode=mode, **kwargs) for _ in range(2))
        alone = FDIVectorEnv(cut, num_envs=1, autoreset_mode=mode, **kwargs)
        loop = SyncVectorEnv([lambda: FDIEnv(cut, **kwargs) for _ in range(n)], autoreset_mode=mode)
        _same(mode, -1, many.reset(seed=seed), loop.reset(seed=seed))
        again.reset(seed=seed)
        alone.reset(seed=seed)
        over, ends = np.zeros(n, bool), 0
        for k in range(steps):
            if mode is AutoresetMode.DISABLED and over.any():
                _same(mode, k, many.reset(options={"reset_mask": over}), loop.reset(options={"reset_mask": over}))
                again.reset(options={"reset_mask": over})
                if over[0]:
                    alone.reset(options={"reset_mask": over[:1]})
            action = _action(many, rng)
            left, copy, lonely = many.step(action), again.step(action), alone.step(action[:1])
            _same(mode, k, left, loop.step(action))
            _same(mode, k, left, copy)
            assert np.array_equal(left[0][:1], lonely[0]), f"{mode}: an episode depends on its neighbours"
            over = left[2] | left[3]
            ends += int(over.sum())
        assert ends >= n, f"{mode}: only {ends} episodes ended in {steps} steps: nothing was tested"
    _check_no_truth(plant, plant.process(process).sample(np.random.default_rng(seed)))


def _action(env: FDIVectorEnv, rng: np.random.Generator) -> Array:
    space = env.single_action_space
    if isinstance(space, gym.spaces.Discrete):
        return rng.integers(0, space.n, env.num_envs)
    assert isinstance(space, gym.spaces.Box)
    return rng.uniform(space.low, space.high, (env.num_envs, *space.shape)).astype(space.dtype)


def _same(mode: AutoresetMode, k: int, left: tuple, right: tuple) -> None:
    names = ("observation", "reward", "terminated", "truncated", "info") if len(left) == 5 else ("observation", "info")
    for name, a, b in zip(names, left, right, strict=True):
        assert data_equivalence(a, b, exact=True), f"{mode}, step {k}: {name} differs: {a} against {b}"


def _check_no_truth(plant: Plant, scenario: FaultScenario) -> None:
    """With the same noise, the observations before the first onset are those of the healthy flight."""
    if not scenario.faults:
        return
    onset = min(f.onset for f in scenario.faults)
    faulty, healthy = simulate(plant, [scenario]), simulate(plant, [scenario.without_faults()])
    assert np.array_equal(faulty.obs[0, :onset], healthy.obs[0, :onset]), "a fault shows in the observation before its onset"


def check_streams(plant: Plant, seed: int = 3) -> None:
    """Initial state, scenario, noise and physical parameters are drawn from streams of their own."""
    states = [np.random.default_rng(stream).random() for stream in streams(seed)]
    assert len(set(states)) == len(states), "two streams are the same"
    process = plant.processes["standard"]
    drawn = draw(process, seed)
    if plant.perturb is not None:
        perturb = plant.perturb
        moved = draw(process, seed, lambda rng: perturb(rng, 0.01))
        assert moved.replace(physical={}) == drawn.replace(physical={}), "mismatch changes what else is drawn"
