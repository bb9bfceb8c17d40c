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

from fdi_gym.checks import check_declaration
from fdi_gym.diagnosis import Decisions, Diagnoser, guarded, run
from fdi_gym.drawing import streams
from fdi_gym.engine import Record, no_noise, simulate
from fdi_gym.envs import FDIEnv, FDIVectorEnv
from fdi_gym.faults import Fault, FaultScenario, Incipient, Intermittent, draw
from fdi_gym.plant import Array, Plant, Signal


def check_plant(plant: Plant, seeds: Sequence[int] = range(5)) -> None:
    """The declaration is consistent, and the flights are what it declares: nothing is believed that a flight can show.

    Names are unique, scales positive, bands in order. Scenarios fit the plant, survive JSON and replay to the same
    flight. While modes are active, the estimated quantity is healthy plus a point of each mode's line, within its reach;
    theta, target and observations stay in their ranges; labels, target and theta agree. The healthy plant is what the
    model predicts, and linear, and its disturbance measured, where it says so.

    Args:
        plant: The plant.
        seeds: Of the flights that are drawn from each of its processes.

    Raises:
        AssertionError: A law is broken; the message names it, and where.
        ValueError: The declaration contradicts itself (as when it was made), or a drawn scenario does not fit.
    """
    check_declaration(plant)
    nominal = plant.nominal_theta
    for name, process in plant.processes.items():
        scenarios = [draw(process, seed) for seed in seeds]
        assert scenarios == [draw(process, seed) for seed in seeds], f"{name}: the same seed draws another scenario"
        for scenario in scenarios:
            again = FaultScenario.from_json(scenario.to_json())
            assert again == scenario, f"{name}: a scenario does not survive JSON"
        record = simulate(plant, scenarios)
        _check_record(plant, name, scenarios, record)
        replay = simulate(plant, [FaultScenario.from_json(s.to_json()) for s in scenarios])
        for said, found, again in zip(Record._fields, record, replay, strict=True):
            assert np.array_equal(found, again), f"{name}: a replayed flight differs in {said}"
    standard = plant.processes["standard"]
    for seed in seeds:
        flown = simulate(plant, [draw(standard, seed).without_faults()])
        assert (flown.label == 0).all(), "a flight without faults has a faulty label"
        assert np.array_equal(flown.theta[0], np.tile(nominal, (flown.theta.shape[1], 1))), "healthy theta is nominal"
    _check_model(plant, draw(standard, seeds[0]))
    if plant.linear:
        _check_linear(plant)


def _check_range(what: str, signals: Sequence[Signal], values: Array) -> None:
    """values (N, K + 1, n) are finite and in the range of their signals."""
    for j, signal in enumerate(signals):
        value = values[:, :, j]
        assert np.isfinite(value).all(), f"{what} {signal.name} is not finite: {np.argwhere(~np.isfinite(value))[0]}"
        low, high = value.min(), value.max()
        assert signal.low <= low <= high <= signal.high, (
            f"{what} {signal.name} leaves its declared range [{signal.low:g}, {signal.high:g}]: {low:g} to {high:g}"
        )


def _check_record(plant: Plant, name: str, scenarios: Sequence[FaultScenario], record: Record) -> None:
    _check_range(f"{name}: the observation", plant.observed, record.obs)
    _check_range(f"{name}: theta's", plant.theta, record.theta)
    _check_range(f"{name}: the estimated", plant.estimated, record.target)
    assert (record.label[:, 0] == 0).all(), f"{name}: no interval has ended at sample 0, its label is 'none'"
    _, u, known = plant.split(record.obs)
    assert np.array_equal(u[:, 0], np.tile(plant.trim_command, (len(u), 1))), f"{name}: u_-1 is the trim command"
    assert np.array_equal(record.target, plant.estimate_target(record.theta, u)), f"{name}: target is not that of theta"
    for quantity, values in plant.monitor(record.state).items():
        assert values.shape == record.label.shape, f"{name}: the monitored {quantity} is not one number per sample"
    for i, scenario in enumerate(scenarios):
        flown = int(record.length[i])
        rows = plant.label_rows(scenario)[: flown + 1]
        assert np.array_equal(record.label[i, : len(rows)], rows), f"{name}: labels of episode {i}"
        moved = (record.theta[i, : len(rows)] != plant.nominal_theta).any(axis=1)
        assert not (moved & (rows == 0)).any(), f"{name}: theta is off nominal while the label says none"
        assert record.terminated[i] or flown == scenario.steps, f"{name}: episode {i} stops without a reason"
        healthy = plant.estimate_target(np.broadcast_to(plant.nominal_theta, record.theta[i].shape), u[i])
        deviation = (record.target[i] - healthy) / [s.scale for s in plant.estimated]
        for start, stop, active in plant.label_intervals(scenario):
            stop = min(stop, flown)
            if start < stop:
                faults = [f for f in scenario.faults if f.onset <= start and (f.end is None or start < f.end)]
                _check_lines(plant, name, faults, deviation[start + 1 : stop + 1], start)
                for mode in (m for m in plant.modes if m.name in active):
                    size = np.asarray(mode.size(record.theta[i, start + 1 : stop + 1]))
                    assert size.shape == (stop - start,), f"{name}: the size of {mode.name} is one number per sample"
                    assert (size >= 0).all(), f"{name}: the size of {mode.name} is negative or no number"
        d = np.broadcast_to(plant.inputs(scenario).disturbance, (scenario.steps + 1, len(plant.disturbances)))[None]
        _check_range(f"{name}: the disturbance", plant.disturbances, d)
        if plant.measured_disturbance is not None and flown:
            t = np.arange(flown)[:, None] * plant.dt
            said = np.array([plant.measured_disturbance(float(s), a[None], b[None])[0]
                             for (s,), a, b in zip(t, known[i, :flown], known[i, 1 : flown + 1], strict=True)])  # fmt: skip
            scale = [s.scale for s in plant.disturbances]
            error = np.abs((said - d[0, :flown]) / scale).max()
            assert error < 1e-6, f"{name}: the measured disturbance is off by {error:.3g} of its scale"


def _check_lines(plant: Plant, name: str, faults: Sequence[Fault], deviation: Array, start: int) -> None:
    """deviation (K, n) from healthy, in scales, is the sum of a point of each active mode's line, within its reach.

    A fault that is building up may be anywhere between healthy and there, an intermittent one at either.
    """
    modes = [mode for mode in plant.modes if mode.name in {f.mode for f in faults}]
    scale = np.array([s.scale for s in plant.estimated])
    building = {f.mode for f in faults for e in f.effects if isinstance(e, Incipient)}
    blinking = {f.mode for f in faults for e in f.effects if isinstance(e, Intermittent)}
    moving = [mode for mode in modes if any(mode.offset) and mode.name in building | blinking]
    lines = np.array([mode.direction for mode in modes] + [mode.offset for mode in moving]).reshape(-1, scale.size) / scale
    fixed = np.sum([np.array(m.offset) / scale for m in modes if m not in moving], axis=0) if modes else np.zeros(scale.size)
    rest = deviation - fixed
    at = np.linalg.lstsq(lines.T, rest.T, rcond=None)[0].T  # (K, lines): m of each mode, then the share of moving offsets
    off = np.abs(rest - at @ lines)
    k, j = np.unravel_index(off.argmax(), off.shape)
    who = " + ".join(mode.name for mode in modes) or "no mode"
    assert off[k, j] <= 1e-9 * max(1.0, np.abs(deviation).max()), (
        f"{name}: at sample {start + 1 + k}, with {who} active, {plant.estimated[j].name} is {off[k, j] * scale[j]:.3g} off "
        f"the declared line"
    )
    if np.linalg.matrix_rank(lines) < len(lines):
        return  # the lines share a direction: the parts can't be told apart
    for i, mode in enumerate(modes):
        m, share = at[:, i], at[:, len(modes) + moving.index(mode)] if mode in moving else np.ones(len(at))
        low, high = (np.multiply.outer(share, mode.reach)).T
        if not any(mode.offset) and (mode.name in building or name != "standard"):
            low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
        if not any(mode.offset) and mode.name in blinking:
            m = np.where(np.abs(m) < 1e-12, mode.reach[0], m)
        slack = 1e-9 * (1 + np.abs(m))
        outside = (m < low - slack) | (m > high + slack) | (share < -1e-9) | (share > 1 + 1e-9)
        k = int(outside.argmax())
        assert not outside[k], (
            f"{name}: at sample {start + 1 + k}, {mode.name} is at {m[k]:.4g} on its line, whose reach is {mode.reach}"
        )


def _check_model(plant: Plant, scenario: FaultScenario) -> None:
    """Without noise, the model's step from x_k under u_k and the true theta is x_{k+1} (piecewise constant profiles)."""
    scenario = scenario.replace(physical={}).without_faults()
    record = simulate(plant, [scenario], [no_noise(plant, scenario.steps)])
    steps = min(50, int(record.length[0]))
    d = np.broadcast_to(plant.inputs(scenario).disturbance, (scenario.steps + 1, len(plant.disturbances)))[:steps]
    _, u, _ = plant.split(record.obs[0])
    t = np.arange(steps) * plant.dt
    predicted = plant.propagate(t, record.state[0, :steps], u[1 : steps + 1], None, d)
    error = np.abs(predicted - record.state[0, 1 : steps + 1]).max()
    assert error <= 1e-12 * max(1.0, np.abs(record.state[0]).max()), f"the model is not the plant: off by {error:.3g}"


def _check_linear(plant: Plant) -> None:
    """A plant that calls itself linear adds up in x and in u, and answers to x alike under every u and theta."""
    rng = np.random.default_rng(0)
    x, more_x = rng.standard_normal((2, len(plant.states))) * [s.scale for s in plant.states]
    u, more_u = rng.standard_normal((2, len(plant.commands))) * [s.scale for s in plant.commands]
    healthy, theta = plant.nominal_theta, plant.nominal_theta + 0.5 * np.array([s.scale for s in plant.theta])

    def of_x(x: Array, u: Array = 0.0 * u, theta: Array = healthy) -> Array:
        return plant.propagate(0.0, x, u[None], theta[None]) - plant.propagate(0.0, 0.0 * x, u[None], theta[None])

    def of_u(u: Array) -> Array:
        return plant.propagate(0.0, 0.0 * x, u[None]) - plant.propagate(0.0, 0.0 * x, 0.0 * u[None])

    errors = {
        "x": of_x(x + more_x) - of_x(x) - of_x(more_x),
        "u": of_u(u + more_u) - of_u(u) - of_u(more_u),
        "x under other u and theta": of_x(x, u, theta) - of_x(x),
    }
    for what, error in errors.items():
        worst = np.abs(error).max() / max(1.0, np.abs(of_x(x)).max(), np.abs(of_u(u)).max())
        assert worst <= 1e-9, f"the plant calls itself linear, but is not in {what}: off by {worst:.3g}"


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
    """Shapes, determinism, batch independence, no look-ahead, and gaps in the measurement.

    A method that handles gaps must stay quiet through them and keep its accuracy; the others, which the guard holds, must
    not be lost.

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
    assert ((said.label >= -1) & (said.label < n_labels)).all(), "what is declared is no label"
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
    _check_gaps(fresh(everyone), plant, scenarios, obs, said)


GAPS = (1, 5, 10, 20)  # samples


def with_gaps(obs: Array, plant: Plant) -> Array:
    """Observations (N, K, n_obs) with gaps of 1 to 20 samples, one sensor missing every seventh, and nothing at first."""
    found, k = obs.copy(), obs.shape[1] // 3
    found[:, 0] = np.nan
    for length in GAPS:
        found[:, k : k + length] = np.nan
        k += length + obs.shape[1] // 12
    found[:, ::7, len(plant.outputs) // 2] = np.nan
    return found


def _check_gaps(diagnoser: Diagnoser, plant: Plant, scenarios: Sequence[FaultScenario], obs: Array, said: Decisions) -> None:
    """Through gaps a method stays as quiet as without them, and as right."""
    hurt = run(diagnoser, with_gaps(obs, plant))
    assert (hurt.label >= 0).all() or (said.label < 0).any(), "gaps lose an episode"
    if not diagnoser.gaps:
        return
    truth = np.stack([plant.label_rows(s)[: obs.shape[1]] for s in scenarios])
    right, right_hurt = ((d.label == truth).mean() for d in (said, hurt))
    assert right_hurt >= right - 0.15, f"gaps cost accuracy: {right:.2f} without, {right_hurt:.2f} with"
    alarms, alarms_hurt = ((d.alarm & (truth == 0)).any(axis=1).sum() for d in (said, hurt))
    # at the calibrated rate of 5 %, two of four flights alarm by chance once in 71 times
    assert alarms_hurt <= alarms + 1, f"gaps raise false alarms: in {alarms} flights without, in {alarms_hurt} with"


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
