"""The conformance kit: what every plant, environment and diagnoser must keep. Use it on yours, as our tests do on ours.

Each check raises AssertionError with what was wrong. Scenario processes are drawn with the seeds given.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import msgspec
import numpy as np
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from fdi_gym.diagnosis import Decisions, Diagnoser, guarded, run
from fdi_gym.engine import Record, no_noise, simulate
from fdi_gym.envs import FDIEnv, FDIVectorEnv
from fdi_gym.faults import FaultScenario, draw, streams
from fdi_gym.plant import Array, Plant


def check_plant(plant: Plant, seeds: Sequence[int] = range(5)) -> None:
    """The declaration is consistent, and the flights are what it declares.

    Scenarios survive JSON and replay to the same flight; labels, target and theta agree; the healthy plant is what the
    model predicts; observations stay in their ranges; the model's batched propagation is the flight's own step.
    """
    nominal = plant.nominal_theta
    for name, process in plant.processes.items():
        assert process.name == name, f"the process {name!r} calls itself {process.name!r}"
        scenarios = [draw(process, seed) for seed in seeds]
        assert scenarios == [draw(process, seed) for seed in seeds], f"{name}: the same seed draws another scenario"
        for scenario in scenarios:
            again = FaultScenario.from_json(scenario.to_json())
            assert again == scenario, f"{name}: a scenario does not survive JSON"
        record = simulate(plant, scenarios)
        replay = simulate(plant, [FaultScenario.from_json(s.to_json()) for s in scenarios])
        for said, found, again in zip(Record._fields, record, replay, strict=True):
            assert np.array_equal(found, again), f"{name}: a replayed flight differs in {said}"
        _check_record(plant, name, scenarios, record)
    standard = plant.processes["standard"]
    for seed in seeds:
        flown = simulate(plant, [draw(standard, seed).without_faults()])
        assert (flown.label == 0).all(), "a flight without faults has a faulty label"
        assert np.array_equal(flown.theta[0], np.tile(nominal, (flown.theta.shape[1], 1))), "healthy theta is nominal"
    _check_model(plant, draw(standard, seeds[0]))


def _check_record(plant: Plant, name: str, scenarios: Sequence[FaultScenario], record: Record) -> None:
    low, high = (np.array([getattr(s, end) for s in plant.observed]) for end in ("low", "high"))
    assert np.isfinite(record.obs).all(), f"{name}: an observation is not finite"
    beyond: Array = np.logical_or(record.obs < low, record.obs > high)
    outside = [signal.name for j, signal in enumerate(plant.observed) if beyond[:, :, j].any()]
    assert not outside, f"{name}: observations leave their declared range: {outside}"
    assert (record.label[:, 0] == 0).all(), f"{name}: no interval has ended at sample 0, its label is 'none'"
    _, u, _ = plant.split(record.obs)
    assert np.array_equal(u[:, 0], np.tile(plant.trim_command, (len(u), 1))), f"{name}: u_-1 is the trim command"
    assert np.array_equal(record.target, plant.estimate_target(record.theta, u)), f"{name}: target is not that of theta"
    for quantity, values in plant.monitor(record.state).items():
        assert values.shape == record.label.shape, f"{name}: the monitored {quantity} is not one number per sample"
    for i, scenario in enumerate(scenarios):
        rows = plant.label_rows(scenario)[: record.length[i] + 1]
        assert np.array_equal(record.label[i, : len(rows)], rows), f"{name}: labels of episode {i}"
        moved = (record.theta[i, : len(rows)] != plant.nominal_theta).any(axis=1)
        assert not (moved & (rows == 0)).any(), f"{name}: theta is off nominal while the label says none"
        assert record.terminated[i] or record.length[i] == scenario.steps, f"{name}: episode {i} stops without a reason"


def _check_model(plant: Plant, scenario: FaultScenario) -> None:
    """Without noise, the model's step from x_k under u_k and the true theta is x_{k+1} (piecewise constant profiles)."""
    scenario = scenario.replace(physical={}).without_faults()
    record = simulate(plant, [scenario], [no_noise(plant, scenario.steps)])
    steps = min(50, int(record.length[0]))
    if not np.array_equal(plant.physical(scenario.physical), plant.nominal_p):
        return
    d = plant.disturbance(scenario)[:steps] if plant.disturbance else None
    _, u, _ = plant.split(record.obs[0])
    t = np.arange(steps) * plant.dt
    predicted = plant.propagate(t, record.state[0, :steps], u[1 : steps + 1], None, d)
    error = np.abs(predicted - record.state[0, 1 : steps + 1]).max()
    assert error <= 1e-12 * max(1.0, np.abs(record.state[0]).max()), f"the model is not the plant: off by {error:.3g}"


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


def check_diagnoser(
    build: Callable[[Plant, Sequence[FaultScenario]], Diagnoser], plant: Plant, seed: int = 11, samples: int = 300
) -> None:
    """Shapes, determinism, batch independence, no look-ahead, and a NaN in the measurement.

    Args:
        build: Makes the diagnoser from the plant; the scenarios are for clairvoyant ones.
        plant: The plant.
        seed: Of the episodes it is shown.
        samples: How many samples of them.
    """
    scenarios = [draw(plant.processes["standard"], seed + i) for i in range(4)]
    obs = simulate(plant, scenarios).obs[:, :samples].copy()
    obs.setflags(write=False)  # as worker processes get large arrays

    def fresh(which: Sequence[int]) -> Diagnoser:
        raw = build(plant, [scenarios[i] for i in which])
        return guarded(raw, plant)

    everyone = list(range(len(scenarios)))
    said = run(fresh(everyone), obs, signals=True)
    shown = _arrays(said)
    n_labels = len(plant.labels)
    assert ((said.label >= -1) & (said.label < n_labels)).all(), "a mode is no label"
    if said.label_probs is not None:
        probs = said.label_probs
        assert (probs >= -1e-9).all(), "a probability is negative"
        assert np.allclose(probs.sum(axis=2), 1, atol=1e-6), "probabilities do not sum to 1"
    if said.estimate_std is not None:
        assert not (said.estimate_std < 0).any(), "a standard deviation is negative"
    _equal(shown, _arrays(run(fresh(everyone), obs, signals=True)), "a second run differs: not deterministic")
    alone = _arrays(run(fresh([2]), obs[2:3], signals=True))
    _equal(_pick(shown, slice(2, 3)), alone, "an episode depends on its batch", 1e-6)
    # no look-ahead: what is said up to a sample does not change with what comes after it
    half = samples // 2
    changed = obs.copy()
    changed[:, half:] = changed[:, :1]
    other = _arrays(run(fresh(everyone), changed, signals=True))
    _equal(
        _pick(shown, slice(None), slice(half)),
        _pick(other, slice(None), slice(half)),
        "what it says depends on later samples",
    )
    # a dropout in one episode: that one goes on, the others don't notice
    holes = obs.copy()
    holes[1, half, 0] = np.nan
    holes[1, half + 1] = np.nan
    hurt = run(fresh(everyone), holes, signals=True)
    rest = [0, 2, 3]
    _equal(_pick(shown, rest), _pick(_arrays(hurt), rest), "a NaN in one episode reaches another", 1e-6)
    assert (hurt.label[1] >= 0).all(), "a dropout loses the episode"
    assert hurt.estimate is None or np.isfinite(hurt.estimate[1]).all(), "a dropout leaves a NaN in the estimate"


def _arrays(said: Decisions) -> dict[str, Array]:
    """Everything that was said, by name, the method's own signals included."""
    return {name: a for name, a in said._asdict().items() if isinstance(a, np.ndarray)} | (said.signals or {})


def _pick(arrays: dict[str, Array], which: Sequence[int] | slice, samples: slice = slice(None)) -> dict[str, Array]:
    return {name: a[which][:, samples] for name, a in arrays.items()}


def _equal(left: dict[str, Array], right: dict[str, Array], what: str, tolerance: float = 0.0) -> None:
    assert left.keys() == right.keys(), f"{what}: {sorted(left)} against {sorted(right)}"
    for name, a in left.items():
        b = right[name]
        if a.dtype == bool or np.issubdtype(a.dtype, np.integer):
            assert np.array_equal(a, b), f"{what} ({name})"
        else:
            scale = np.nanmax(np.abs(a), initial=1.0)
            assert np.allclose(a, b, rtol=tolerance, atol=tolerance * scale, equal_nan=True), f"{what} ({name})"
