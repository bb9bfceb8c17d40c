"""What every plant must keep: its declaration, and its flights beside it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_gym.bounds import check_bounds_at
from fdi_gym.checks import check_declaration
from fdi_gym.engine import Record, no_noise, simulate
from fdi_gym.faults import Fault, FaultScenario, Incipient, Intermittent, draw
from fdi_gym.kernels import load
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Kernels, Plant, Signal


def check_plant(plant: Plant, seeds: Sequence[int] = range(5)) -> None:
    """The declaration is consistent, and the flights are what it declares: nothing is believed that a flight can show.

    Names are unique, scales positive, bands in order. Scenarios fit the plant, survive JSON and replay to the same
    flight. While modes are active, the estimated quantity is healthy plus a point of each mode's line, within its reach;
    theta, target and observations stay in their ranges; labels, target and theta agree. The healthy plant is what the
    model predicts, and linear, and its disturbance measured, where it says so. The kernels stay within their arrays, and the
    derivatives that they say are those of its equations.

    Args:
        plant: The plant.
        seeds: Of the flights that are drawn from each of its processes.

    Raises:
        AssertionError: A law is broken; the message names it, and where.
        ValueError: The declaration contradicts itself (as when it was made), a drawn scenario does not fit, or a kernel
            reaches beyond its arrays.
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
        if name == "standard" and plant.kernels is not None and plant.kernels.jacobian is not None:
            _check_jacobian(plant, plant.kernels, record)
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


def _check_bounds(plant: Plant, record: Record) -> None:
    """The kernels stay within their arrays at some samples of each flight."""
    _, u, _ = plant.split(record.obs)
    for i, k in _some(record):
        check_bounds_at(plant, k * plant.dt, record.state[i, k], u[i, k], record.theta[i, k])


def _some(record: Record) -> list[tuple[int, int]]:
    """Flights and samples: some of each flight, over its length."""
    return [(i, k) for i, last in enumerate(record.length.tolist()) for k in range(0, last + 1, max(last // 8, 1))]


def _check_record(plant: Plant, name: str, scenarios: Sequence[FaultScenario], record: Record) -> None:
    _check_bounds(plant, record)
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
    """deviation (K, n) from healthy, in scales, is the sum of a point of each active mode's line or plane, within its reach.

    A fault that is building up may be anywhere between healthy and there, an intermittent one at either.
    """
    modes = [mode for mode in plant.modes if mode.name in {f.mode for f in faults}]
    scale = np.array([s.scale for s in plant.estimated])
    building = {f.mode for f in faults for e in f.effects if isinstance(e, Incipient)}
    blinking = {f.mode for f in faults for e in f.effects if isinstance(e, Intermittent)}
    moving = [mode for mode in modes if any(mode.offset) and mode.name in building | blinking]
    directions = [(mode, *row) for mode in modes for row in zip(mode.directions, mode.reaches.tolist(), strict=True)]
    lines = np.array([d for _, d, _ in directions] + [mode.offset for mode in moving]).reshape(-1, scale.size) / scale
    fixed = np.sum([np.array(m.offset) / scale for m in modes if m not in moving], axis=0) if modes else np.zeros(scale.size)
    rest = deviation - fixed
    at = np.linalg.lstsq(lines.T, rest.T, rcond=None)[0].T  # (K, lines): the magnitudes, then the share of moving offsets
    off = np.abs(rest - at @ lines)
    k, j = np.unravel_index(off.argmax(), off.shape)
    who = " + ".join(mode.name for mode in modes) or "no mode"
    assert off[k, j] <= 1e-9 * max(1.0, np.abs(deviation).max()), (
        f"{name}: at sample {start + 1 + k}, with {who} active, {plant.estimated[j].name} is {off[k, j] * scale[j]:.3g} off "
        f"the declared line"
    )
    if np.linalg.matrix_rank(lines) < len(lines):
        return  # the lines share a direction: the parts can't be told apart
    for i, (mode, _, reach) in enumerate(directions):
        m, share = at[:, i], at[:, len(directions) + moving.index(mode)] if mode in moving else np.ones(len(at))
        low, high = (np.multiply.outer(share, reach)).T
        if not any(mode.offset) and (mode.name in building or name != "standard"):
            low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
        if not any(mode.offset) and mode.name in blinking:
            m = np.where(np.abs(m) < 1e-12, reach[0], m)
        slack = 1e-9 * (1 + np.abs(m))
        outside = (m < low - slack) | (m > high + slack) | (share < -1e-9) | (share > 1 + 1e-9)
        k = int(outside.argmax())
        assert not outside[k], (
            f"{name}: at sample {start + 1 + k}, {mode.name} is at {m[k]:.4g} on its line, whose reach is {tuple(reach)}"
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


def _check_jacobian(plant: Plant, kernels: Kernels, record: Record) -> None:
    """The partial derivatives are what differences of the dynamics say, at some samples of each flight.

    Where a wider difference says something else there is a kink or a jump, and nothing is judged.
    """
    load(kernels.dynamics)
    jacobian, own, n_x = load(kernels.jacobian), plant.theta[: plant.own_theta], len(plant.states)
    rates = np.array([s.scale for s in plant.states]) / (plant.dt if plant.substeps else 1.0)
    sizes = [
        [s.scale for s in plant.states], [s.scale for s in own], [s.scale for s in plant.disturbances],
        np.maximum(np.abs(plant.nominal_p), 1e-3).tolist(),
    ]  # fmt: skip
    _, u, _ = plant.split(record.obs)
    for i, k in _some(record):
        t, command = k * plant.dt, contiguous(u[i, k])
        at = [record.state[i, k], record.theta[i, k, : len(own)], np.zeros(len(sizes[2])), plant.nominal_p]
        at = [contiguous(value) for value in at]
        said = [np.zeros((n_x, len(value))) for value in at]
        jacobian(t, at[0], command, *at[1:], *said)
        for place, j in ((place, j) for place, value in enumerate(at) for j in range(len(value))):
            size = sizes[place][j]
            wide, narrow = (_difference(kernels.dynamics, t, command, at, place, j, step * size) for step in (1e-4, 1e-6))
            smooth = np.abs(wide - narrow) * size / rates < 1e-5
            off = np.where(smooth, np.abs(said[place][:, j] - narrow) * size / rates, 0.0)
            a = int(np.argmax(off))
            assert off[a] < 1e-4, (
                f"the kernel 'jacobian' says that d dx[{a}] / d {('x', 'theta', 'd', 'p')[place]}[{j}] is "
                f"{said[place][a, j]:.6g} at sample {k} of flight {i}; differences of 'dynamics' say {narrow[a]:.6g}"
            )


def _difference(dynamics: Any, t: float, u: Array, at: Sequence[Array], place: int, j: int, step: float) -> Array:
    """Central difference (n_x,) of the dynamics at (x, theta, d, p) along entry j of one of them."""
    ends = np.zeros((2, len(at[0])))
    for end, sign in zip(ends, (1.0, -1.0), strict=True):
        x, theta, d, p = (value.copy() for value in at)
        (x, theta, d, p)[place][j] += sign * step
        dynamics(t, x, u, theta, d, p, end)
    return (ends[0] - ends[1]) / (2 * step)


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
