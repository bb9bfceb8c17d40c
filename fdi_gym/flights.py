"""Where N flights are, and the tables that they follow: what the compiled loop reads and moves on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym import effects
from fdi_gym.bounds import check_bounds
from fdi_gym.closed_loop import FLYING, OVER, TERMINATED
from fdi_gym.effects import NEVER
from fdi_gym.faults import Abrupt, Effect, FaultScenario, Hold, Incipient, Intermittent, Ramp, Samples, Sampling, Square
from fdi_gym.model import contiguous
from fdi_gym.plant import Plant
from fdi_gym.truth import Inputs

Array = np.ndarray


class Chunk(NamedTuple):
    """Consecutive samples of N flights, in (sample, flight, signal) order. Rows after a flight's end mean nothing."""

    obs: Array  # (m, N, n_obs)
    state: Array  # (m, N, n_x)
    theta: Array  # (m, N, n_theta)
    label: Array  # (m, N) int64


class Prepared(NamedTuple):
    """A flight that can begin: its scenario, tables, the true label's changes, injected noise."""

    scenario: FaultScenario
    inputs: Inputs
    labels: list[tuple[int, int]]
    noise: tuple[Array | None, Array | None]


def _signals(plant: Plant) -> tuple[Any, ...]:
    """What the compiled call needs of the plant's data sheet."""
    boxes = [np.array([[s.low for s in signals], [s.high for s in signals]], float).reshape(2, -1)
             for signals in (plant.outputs, plant.commands)]  # fmt: skip
    sigma = np.array([s.sigma for s in (*plant.outputs, *plant.states)])
    widths = plant.reference_width, len(plant.disturbances), plant.own_theta, plant.healthy_feedback
    return *boxes, sigma, plant.noise_limit, np.array(widths, np.int64)


def effects_lag(plant: Plant, effect: Effect) -> int:
    """By how many samples an effect makes a sensor lag, at most."""
    if plant.bare is None or plant.theta_entries.index(effect.entry) not in plant.lags:
        return 0
    match effect:
        case Samples(values=values):
            return int(max(values))
        case Square(value=value, other=other):
            return int(max(value, other))
        case Hold():
            return 0
        case _:
            return int(effect.value)  # type: ignore[attr-defined]


class Flights:
    """N flights under way: where each is, and the tables that it follows.

    Args:
        plant: The plant; its physical parameters come from each scenario.
        scenarios: One per flight; they may differ in length.
        noise: (w (K, n_x), v (K + 1, n_y)) per flight. Default: by counter, from each scenario's noise seed.
        longest_lag: Samples that a sensor may lag behind by the table that `advance` takes; scenarios say it themselves.

    Attributes:
        k: (N,) the sample that each flight comes to next; the last one where it is over.
        length: (N,) its last sample: as the scenario says, until it ends early.
        q: (N, n_q) the parameters of each flight's controller: the plant's, until somebody changes them in place.

    Raises:
        ValueError: A scenario that the plant refuses, noise of another shape, or a kernel that reaches beyond its arrays.
    """

    def __init__(
        self,
        plant: Plant,
        scenarios: Sequence[FaultScenario],
        noise: Sequence[tuple[Array, Array]] | None = None,
        longest_lag: int = 0,
    ):
        check_bounds(plant)
        n = len(scenarios)
        n_x, n_y, n_u, n_theta = (len(a) for a in (plant.states, plant.outputs, plant.commands, plant.theta))
        self.plant = plant
        self._entries = {s.name: j for j, s in enumerate(plant.theta)}
        self._commands = {s.name: j for j, s in enumerate(plant.commands)}
        self.k, self.length = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self.seed, self.status = np.zeros(n, np.uint64), np.full(n, OVER, np.int64)
        self.x, self.c, self.u = np.zeros((n, n_x)), np.zeros((n, len(plant.c0))), np.zeros((n, n_u))
        self.theta, self.p = np.zeros((n, n_theta)), np.zeros((n, len(plant.nominal_p)))
        self.q = np.zeros((n, len(plant.q)))
        self.readings, self.history = np.zeros((n, 2, n_y)), np.zeros((n, longest_lag + 1 if longest_lag else 0, n_y))
        self.reporting, self.dropped = np.zeros((0, n_y, effects.REPORTING)), np.zeros((0, n_y))
        self.effects, self.held = np.zeros((n, 1, effects.COLUMNS)), np.zeros((n, 1))
        self.counts, self.labels = np.zeros(n, np.int64), np.full((n, 2, 2), NEVER)
        self.tables: list[tuple[Any, ...]] = [()] * n  # reference, disturbance, w, v and samples of effects: by address
        self.addresses = np.zeros((4, n), np.int64)
        self.steps = np.ones((2, n), np.int64)  # from a sample's row of reference and disturbance to the next; 0: one row
        self.values = np.zeros((n, 1), np.int64)
        self.signals = _signals(plant)
        self.begin(range(n), scenarios, noise)

    def __len__(self) -> int:
        return len(self.k)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("addresses", "values")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.addresses = np.zeros((4, len(self)), np.int64)
        self.values = np.zeros(self.effects.shape[:2], np.int64)
        for i in range(len(self)):
            self._point(i)

    @property
    def over(self) -> Array:
        """(N,) bool: the last sample has been flown."""
        return self.status >= OVER

    @property
    def terminated(self) -> Array:
        """(N,) bool: ended before its scenario's last step."""
        return self.status == TERMINATED

    def begin(
        self,
        slots: Iterable[int],
        scenarios: Sequence[FaultScenario],
        noise: Sequence[tuple[Array, Array]] | None = None,
    ) -> None:
        """Put new flights in these slots; the others go on. What is refused leaves all as they are."""
        made = [self.prepare(s, None if noise is None else noise[number]) for number, s in enumerate(scenarios)]
        self.put(slots, made)

    def prepare(self, scenario: FaultScenario, noise: tuple[Array, Array] | None = None) -> Prepared:
        """A flight that `put` can begin at any time: what takes long is done here.

        Raises:
            ValueError: A scenario that the plant refuses, or noise of another shape.
        """
        labels = self.plant.validate(scenario)
        given = (None, None) if noise is None else self._checked_noise(noise, scenario.steps)
        return Prepared(scenario, self.plant.inputs(scenario), labels, given)

    def put(self, slots: Iterable[int], made: Sequence[Prepared]) -> None:
        """Begin prepared flights in these slots; the others go on."""
        plant, where = self.plant, np.array(list(slots))
        if len(where) != len(made):
            raise ValueError(f"one scenario for each of the {len(where)} slots is needed, not {len(made)}")
        if not made:
            return
        self.k[where], self.status[where], self.x[where], self.c[where] = 0, FLYING, plant.trim_state, plant.c0
        self.u[where], self.theta[where], self.q[where] = plant.trim_command, plant.nominal_theta, plant.q
        self.length[where] = [flight.scenario.steps for flight in made]
        self.seed[where] = np.array([flight.scenario.noise_seed for flight in made], np.uint64)
        self.p[where] = [flight.inputs.physical for flight in made]
        self.steps[:, where] = np.array([(len(f.inputs.reference) > 1, len(f.inputs.disturbance) > 1) for f in made]).T
        for i, (scenario, inputs, labels, given) in zip(where.tolist(), made, strict=True):
            if scenario.x0 is not None:
                self.x[i] = scenario.x0
            samples = self._set_effects(i, scenario)
            self._set_sampling(i, scenario)
            self._set_labels(i, labels)
            self.tables[i] = (inputs.reference, inputs.disturbance, *given, samples)
            self._point(i)

    def _checked_noise(self, noise: tuple[Array, Array], steps: int) -> tuple[Array, Array]:
        w, v = (contiguous(a) for a in noise)
        wanted = (steps, len(self.plant.states)), (steps + 1, len(self.plant.outputs))
        if (w.shape, v.shape) != wanted or not (np.isfinite(w).all() and np.isfinite(v).all()):
            raise ValueError(f"noise is finite and has the shapes {wanted}, not {(w.shape, v.shape)}")
        return w, v

    def _set_effects(self, i: int, scenario: FaultScenario) -> dict[int, Array]:
        """The rows of flight i's effects, in the order of listing; returns the tables of those that have one."""
        plant, rows, samples = self.plant, [], {}
        for fault in scenario.faults:
            end = scenario.steps + 1 if fault.end is None else min(fault.end, scenario.steps + 1)
            for effect in fault.effects:
                match effect:
                    case Abrupt(value=value):
                        what = (effects.ABRUPT, value, 0, 0)
                    case Incipient(value=value, rate=rate):
                        what = (effects.INCIPIENT, value, rate, 0)
                    case Ramp(value=value, duration=duration):
                        what = (effects.RAMP, value, duration, 0)
                    case Intermittent(value=value, period=period, duty=duty):
                        what = (effects.INTERMITTENT, value, period, duty)
                    case Square(value=value, other=other, period=period):
                        what = (effects.SQUARE, value, period, other)
                    case Hold(command=command, lag=lag):
                        what = (effects.HOLD, 0, self._commands[command], lag)
                    case Samples(values=values):
                        what = (effects.SAMPLES, 0, len(values), 0)
                        samples[len(rows)] = np.array(values, float)
                rows.append((self._entries[effect.entry], fault.onset, end, *what))
        if len(rows) > self.effects.shape[1]:
            more = len(rows) - self.effects.shape[1]
            self.effects = np.pad(self.effects, ((0, 0), (0, more), (0, 0)))
            self.held, self.values = (np.pad(a, ((0, 0), (0, more))) for a in (self.held, self.values))
        self.counts[i] = len(rows)
        if rows:
            self.effects[i, : len(rows)] = rows
            for e, row in enumerate(rows):
                if row[3] == effects.HOLD:  # the command before sample 0, until another is caught
                    self.held[i, e] = plant.trim_command[row[5]]
        return samples

    def _set_sampling(self, i: int, scenario: FaultScenario) -> None:
        """How flight i's sensors report, and room for the past that the slowest of them shows."""
        plant, said = self.plant, scenario.sampling
        lags = [effects_lag(plant, effect) for fault in scenario.faults for effect in fault.effects]
        longest = max(lags, default=0) + (max(said.delays.values(), default=0) if isinstance(said, Sampling) else 0)
        if longest >= max(self.history.shape[1], 1):
            self._remember(longest)
        if len(self.reporting):
            self.reporting[i], self.dropped[i] = 0.0, 0.0
        if not isinstance(said, Sampling):
            return
        if not len(self.reporting):
            self.reporting, self.dropped = (np.zeros((len(self), *a.shape[1:])) for a in (self.reporting, self.dropped))
        rows, p = self.reporting[i], said.dropout
        stay = p if said.burst == 1.0 else 1.0 - 1.0 / said.burst
        rows[:, effects.AGAIN] = said.hold
        rows[:, effects.BEGIN], rows[:, effects.STAY] = (1.0 - stay) * p / (1.0 - p), stay
        for column, by_name in ((effects.PERIOD, said.periods), (effects.DELAY, said.delays)):
            for j, output in enumerate(plant.outputs):
                rows[j, column] = by_name.get(output.name, 0)

    def _remember(self, longest: int) -> None:
        """A longer history; that of the flights under way is kept."""
        before = self.history
        self.history = np.zeros((before.shape[0], longest + 1, before.shape[2]))
        for i, k in enumerate(self.k.tolist()):
            past = np.arange(max(k - before.shape[1], 0), k)
            self.history[i, past % (longest + 1)] = before[i, past % max(before.shape[1], 1)]

    def _set_labels(self, i: int, changes: list[tuple[int, int]]) -> None:
        if len(changes) >= self.labels.shape[1]:
            more = len(changes) + 1 - self.labels.shape[1]
            self.labels = np.pad(self.labels, ((0, 0), (0, more), (0, 0)), constant_values=NEVER)
        self.labels[i] = changes + [(NEVER, NEVER)] * (self.labels.shape[1] - len(changes))

    def _point(self, i: int) -> None:
        """Note where flight i's tables lie; they live as long as this does."""
        *tables, samples = self.tables[i]
        self.addresses[:, i] = [0 if table is None else table.__array_interface__["data"][0] for table in tables]
        for e, table in samples.items():
            self.values[i, e] = table.__array_interface__["data"][0]

    def arrays(self) -> tuple[Array, ...]:
        """Tables and state in the order of the compiled call."""
        return (
            self.seed, self.length, *self.addresses, *self.steps,
            self.p, self.q, self.effects, self.counts, self.values, self.labels,
            self.reporting, self.k, self.status, self.x, self.c, self.u, self.theta, self.held, self.readings, self.history,
            self.dropped,
        )  # fmt: skip

    def blank(self, samples: int) -> Chunk:
        """An empty chunk of so many samples."""
        plant, n = self.plant, len(self)
        widths = len(plant.observed), len(plant.states), len(plant.theta)
        obs, state, theta = (np.zeros((samples, n, width)) for width in widths)
        return Chunk(obs, state, theta, np.zeros((samples, n), np.int64))
