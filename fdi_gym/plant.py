"""What a plant declares: its data sheet (signals, fault modes, labels), its equations, and its fault processes.

A plant file in `fdi_gym/plants/` has the lines `ID = "..."` and `VERSION = ...` and a function `plant(**options)` that
returns a `Plant`. It is discovered; nothing is listed. A plant outside the package is made known with
`fdi_gym.register_plant`.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.faults import FaultProcess, FaultScenario, ThetaTable, theta_table

Array = np.ndarray


def contiguous(a: Any) -> Array:
    """As the compiled kernels take an array: float64, in C order and writable; a copy only of one that is not."""
    a = np.ascontiguousarray(a, float)
    return a if a.flags.writeable else a.copy()


class Signal(NamedTuple):
    """One entry of a vector: its name, unit and range.

    Args:
        name: What it is, in the field's words.
        unit: SI or the source's unit; "" where it has none.
        low: Lower end of its range; a sensor saturates there.
        high: Upper end.
        scale: Typical size, by which learners divide.
        sigma: Standard deviation of its white noise: per sample of a sensor, per step of a state. 0 for others.
        nominal: Trim value of a command or state, healthy value of a fault parameter.
    """

    name: str
    unit: str
    low: float
    high: float
    scale: float = 1.0
    sigma: float = 0.0
    nominal: float = 0.0


class FaultMode(NamedTuple):
    """A discrete class of fault, of which the labels are made.

    Args:
        name: For example "aileron LOE".
        description: What it does to theta.
        size: Maps theta (..., n_theta) to the fault's size (...), for accuracy by severity.
        bands: Sizes below the first are "small", below the second "medium", else "large".
        offset, direction, reach: The line that the fault spans in the estimated space, as a deviation from healthy:
            offset + m direction with m in reach. A stuck surface has offset -1 in its effectiveness, direction its
            position. Two faults add their deviations.
    """

    name: str
    description: str
    size: Callable[[Array], Array]
    bands: tuple[float, float]
    offset: tuple[float, ...]
    direction: tuple[float, ...]
    reach: tuple[float, float]


class Label(NamedTuple):
    """One answer of the isolation task: the set of fault modes that are active."""

    name: str
    modes: frozenset[str]


class Kernels(NamedTuple):
    """A plant's compiled equations; the roles and signatures are those of `fdi_gym.kernels`."""

    dynamics: Any
    output: Any
    control: Any
    known: Any = None
    project: Any = None
    outside: Any = None


def squared_error(scale: Sequence[float]) -> Callable[[Array], Array]:
    """The usual identification reward: minus the sum of squared errors (..., n), each divided by its scale."""
    weight = 1.0 / np.asarray(scale, float) ** 2

    def reward(error: Array) -> Array:
        return -(error**2 * weight).sum(axis=-1)  # not a matrix product: the same bits for one as for many

    return reward


def _no_rows(scenario: FaultScenario) -> Array:
    return np.zeros((scenario.steps + 1, 0))


def _nothing(state: Array) -> Mapping[str, Array]:
    return {}


def _no_change(physical: Mapping[str, Any]) -> Array:
    if physical:
        raise ValueError(f"this plant has no physical parameters to change, but the scenario sets {', '.join(physical)}")
    return np.zeros(0)


@dataclass(frozen=True, kw_only=True)
class Plant:
    """A plant's whole declaration. Built by the plant file's `plant(**options)`; plain data, functions and kernels.

    Args:
        id: The part of the environment id before "-Faults-v".
        version: The number after it; raised by any change that alters a score.
        options: The options it was built with: plain values.
        description: One line for tables.
        dt: Sample time [s].
        substeps: Runge-Kutta steps per sample; 0 for a discrete plant, whose dynamics kernel gives the next state.
        linear: The dynamics are linear in x, and bilinear in (u, theta).
        kernels: The compiled equations.
        states, outputs, commands, known, disturbances: Data sheets of the vectors, in order.
        theta: Data sheet of the fault parameter; `nominal` is the healthy value.
        estimated: Data sheet of what the identification task asks for. Default: theta itself.
        target: Maps theta (..., n_theta) and the command held over the same interval (..., n_u) to the estimated
            quantity (..., n). Default: theta itself.
        modes: The fault modes.
        labels: The answers of the isolation task; the first one is "none".
        processes: Fault processes by name; must hold "standard".
        c0: Initial state of the controller.
        q: Parameters of the controller.
        true_feedback: The controller gets the sensors' values before their noise is added; diagnosers never do.
        physical: Maps a scenario's physical parameters to the vector p; of {} it gives the nominal model.
        perturb: Draws physical parameters at a level of mismatch: perturb(rng, level) -> dict, or None if it has none.
        reference: Maps a scenario to the exogenous reference rows (steps + 1, n_r).
        disturbance: Maps a scenario to the disturbance rows (steps + 1, n_d).
        measured_disturbance: What the known signals say of the disturbance that is held over an interval:
            measured_disturbance(t, before, now) -> (n, n_d), from its start t [s] and the known signals (n, n_known) at
            its two ends. None where nothing is known of it.
        monitor: Maps states (..., n_x) to named quantities (...) that `info` reports beside the truth, such as the distance
            to a singularity; diagnosers never see them.
        tuning: Settings of diagnosers, by name, that suit this plant better than what they find for themselves, such as
            those of its paper; what a caller gives overrides them.
        noise_limit: The white noise of sensors and states is clipped at so many standard deviations. Default: never.
        isolation_reward: (labels, labels): reward of declaring column while row is true. Default: 1 if right, else 0.
        identification_reward: Reward of an error (..., n). Default: minus the squares, scaled.
    """

    id: str
    version: int
    description: str
    dt: float
    substeps: int
    kernels: Kernels
    states: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    commands: tuple[Signal, ...]
    theta: tuple[Signal, ...]
    modes: tuple[FaultMode, ...]
    labels: tuple[Label, ...]
    processes: Mapping[str, FaultProcess]
    options: Mapping[str, Any] = field(default_factory=dict)
    linear: bool = False
    known: tuple[Signal, ...] = ()
    disturbances: tuple[Signal, ...] = ()
    estimated: tuple[Signal, ...] = ()
    target: Callable[[Array, Array], Array] | None = None
    c0: Array = field(default_factory=lambda: np.zeros(0))
    q: Array = field(default_factory=lambda: np.zeros(0))
    true_feedback: bool = False
    physical: Callable[[Mapping[str, Any]], Array] = _no_change
    perturb: Callable[[np.random.Generator, float], Mapping[str, Any]] | None = None
    reference: Callable[[FaultScenario], Array] = _no_rows
    disturbance: Callable[[FaultScenario], Array] | None = None
    measured_disturbance: Callable[[float, Array, Array], Array] | None = None
    monitor: Callable[[Array], Mapping[str, Array]] = _nothing
    tuning: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    noise_limit: float = np.inf
    isolation_reward: Array | None = None
    identification_reward: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        names = {mode.name for mode in self.modes}
        unknown = {name for label in self.labels for name in label.modes} - names
        if unknown or not self.labels or self.labels[0].modes:
            raise ValueError(
                f"labels start with the empty set and use declared modes {sorted(names)}, not {sorted(unknown)}"
            )
        if "standard" not in self.processes:
            raise ValueError(f"a plant needs a 'standard' fault process; {self.id} has {', '.join(self.processes)}")
        if not self.estimated:
            object.__setattr__(self, "estimated", self.theta)
        if self.isolation_reward is None:
            object.__setattr__(self, "isolation_reward", np.eye(len(self.labels)))
        if self.identification_reward is None:
            object.__setattr__(self, "identification_reward", squared_error([s.scale for s in self.estimated]))

    def validate(self, scenario: FaultScenario) -> None:
        """Raise ValueError where the scenario does not belong to this plant."""
        if scenario.plant != self.id:
            raise ValueError(f"the scenario belongs to {scenario.plant}, not to {self.id}")

    def __reduce__(self) -> Any:
        recipe = vars(self).get("_recipe")
        return (_load_again, recipe) if recipe else super().__reduce__()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the addresses of compiled functions, which hold in one process only."""
        return {name: value for name, value in vars(self).items() if name != "addresses"}

    # -- derived facts, computed from the declaration and nothing else

    @property
    def env_id(self) -> str:
        """The Gymnasium id."""
        return f"{self.id}-Faults-v{self.version}"

    @property
    def observed(self) -> tuple[Signal, ...]:
        """The data sheet of an observation: sensors, the command held up to now, what else is known."""
        return self.outputs + self.commands + self.known

    @functools.cached_property
    def nominal_theta(self) -> Array:
        """The healthy fault parameter (n_theta,)."""
        return np.array([s.nominal for s in self.theta])

    @functools.cached_property
    def nominal_p(self) -> Array:
        """The physical parameters of the model that diagnosers get."""
        return contiguous(self.physical({}))

    @functools.cached_property
    def trim_command(self) -> Array:
        """The command before the first sample (n_u,)."""
        return np.array([s.nominal for s in self.commands])

    @functools.cached_property
    def trim_state(self) -> Array:
        """The initial state where a scenario gives none (n_x,)."""
        return np.array([s.nominal for s in self.states])

    def split(self, obs: Array) -> tuple[Array, Array, Array]:
        """An observation (..., n_obs) as (y, u of the interval that has just ended, known)."""
        n_y, n_u = len(self.outputs), len(self.commands)
        return obs[..., :n_y], obs[..., n_y : n_y + n_u], obs[..., n_y + n_u :]

    def estimate_target(self, theta: Array, u: Array) -> Array:
        """What the identification task asks for, from theta (..., n_theta) and the command held with it (..., n_u)."""
        return theta if self.target is None else self.target(theta, u)

    def label_of(self, modes: frozenset[str]) -> int:
        """Index of the label whose modes these are.

        Raises:
            ValueError: No label says so; the message lists those that exist.
        """
        for index, label in enumerate(self.labels):
            if label.modes == modes:
                return index
        raise ValueError(
            f"{self.id} has no label for {sorted(modes)}; it has {', '.join(label.name for label in self.labels)}"
        )

    def label_rows(self, scenario: FaultScenario) -> Array:
        """The true label at the samples 0..K: sample k has that of the fault which acted over [k - 1, k)."""
        rows = np.zeros(scenario.steps + 1, dtype=np.int64)
        for first, label in self.label_changes(scenario):
            rows[first:] = label
        return rows

    def label_changes(self, scenario: FaultScenario) -> list[tuple[int, int]]:
        """The true label as (first sample, label), in order: sample k has that of the fault which acted over [k - 1, k)."""
        steps = scenario.steps
        spans = [(min(f.onset, steps), steps if f.end is None else min(f.end, steps), f.mode) for f in scenario.faults]
        edges = sorted({0, *(edge for start, end, _ in spans for edge in (start, end))} - {steps})
        changes = [(0, 0)]
        for edge in edges:
            label = self.label_of(frozenset(mode for start, end, mode in spans if start <= edge < end))
            if label != changes[-1][1]:
                changes.append((edge + 1, label))
        return changes

    def theta_table(self, scenario: FaultScenario) -> ThetaTable:
        """What the scenario makes of theta (see `fdi_gym.faults.theta_table`)."""
        return theta_table(
            scenario, self.nominal_theta, [s.name for s in self.theta], [s.name for s in self.commands], self.dt
        )

    def process(self, name: str) -> FaultProcess:
        """A fault process by name.

        Raises:
            ValueError: There is none of that name; the message lists those that exist.
        """
        if name not in self.processes:
            raise ValueError(f"unknown scenario {name!r}; {self.id} has {', '.join(self.processes)}")
        return self.processes[name]

    def describe(self) -> str:
        """The data sheet as text: spaces, bounds, units, fault modes, labels, processes."""
        lines = [f"{self.env_id}: {self.description}", f"options: {dict(self.options)}", f"sample time: {self.dt} s"]
        for title, signals in (
            ("observation", self.observed), ("estimated (identification action)", self.estimated),
            ("fault parameter theta", self.theta), ("disturbances", self.disturbances),
        ):  # fmt: skip
            if signals:
                lines.append(f"\n{title}")
            lines += [f"  {s.name:20s} {s.unit:8s} [{s.low:g}, {s.high:g}]  scale {s.scale:g}" for s in signals]
        lines.append("\nlabels (isolation action)")
        lines += [f"  {i:2d} {label.name}" for i, label in enumerate(self.labels)]
        lines.append("\nfault modes")
        lines += [f"  {mode.name:20s} {mode.description}" for mode in self.modes]
        lines.append("\nscenarios")
        lines += [f"  {name:20s} {process.description}" for name, process in self.processes.items()]
        return "\n".join(lines)

    # -- the model, as filters use it: compiled, batched, with the nominal physical parameters

    @functools.cached_property
    def addresses(self) -> tuple[int, ...]:
        """Addresses of the compiled kernels in the order of `Kernels`, with the defaults where the plant has none."""
        from fdi_gym import kernels

        given = zip(Kernels._fields, self.kernels, strict=True)
        return tuple(kernels.address(function or getattr(kernels, role)) for role, function in given)

    def _rows(self, value: Array | None, default: Array) -> Array:
        rows = default if value is None else np.asarray(value, float)
        return contiguous(rows.reshape(math.prod(rows.shape[:-1]), rows.shape[-1]))  # also of zero width

    def _rows_of(self, t: Any, x: Array, u: Array, theta: Any, d: Any, p: Any, width: int) -> tuple[Array, ...]:
        """The arguments of a generic kernel from those of `propagate`, and an array for its output."""
        points = contiguous(x.reshape(-1, x.shape[-1]))
        return (
            contiguous(np.atleast_1d(t)),
            points,
            self._rows(u, self.trim_command),
            self._rows(theta, self.nominal_theta),
            self._rows(d, np.zeros(len(self.disturbances))),
            self._rows(p, self.nominal_p),
            np.empty((points.shape[0], width)),
        )

    def propagate(
        self, t: Any, x: Array, u: Array, theta: Array | None = None, d: Array | None = None, p: Array | None = None
    ) -> Array:
        """The state one sample after x (..., n_x), without noise, u, theta and d held: the model's prediction.

        u, theta, d and p may have fewer rows than x: row i of m then serves M/m consecutive points (sigma points of one
        episode share their command). t [s] is a number or one per such group. theta, d and the physical parameters p
        default to nominal, none and the model's.
        """
        from fdi_gym import integration

        x = np.asarray(x, float)
        rows = self._rows_of(t, x, u, theta, d, p, len(self.states))
        integration.propagate(self.addresses[0], self.addresses[4], self.dt, self.substeps, *rows)
        return rows[-1].reshape(x.shape)

    def measure(
        self, t: Any, x: Array, u: Array, theta: Array | None = None, d: Array | None = None, p: Array | None = None
    ) -> Array:
        """The noise-free sensor values at x (..., n_x); arguments as in `propagate`, u held up to t."""
        from fdi_gym import integration

        x = np.asarray(x, float)
        rows = self._rows_of(t, x, u, theta, d, p, len(self.outputs))
        integration.evaluate(self.addresses[1], *rows)
        return rows[-1].reshape(*x.shape[:-1], len(self.outputs))

    def derivative(self, t: Any, x: Array, u: Array, theta: Array | None = None, d: Array | None = None) -> Array:
        """xdot at x (..., n_x); arguments as in `propagate`. For a discrete plant it is the next state."""
        from fdi_gym import integration

        x = np.asarray(x, float)
        rows = self._rows_of(t, x, u, theta, d, None, len(self.states))
        integration.evaluate(self.addresses[0], *rows)
        return rows[-1].reshape(x.shape)

    @functools.cached_property
    def Q(self) -> Array:
        """Covariance of the process noise per step (n_x, n_x)."""
        return np.diag([s.sigma**2 for s in self.states])

    @functools.cached_property
    def R(self) -> Array:
        """Covariance of the sensor noise (n_y, n_y)."""
        return np.diag([s.sigma**2 for s in self.outputs])


# ---------------------------------------------------------------------------------------------------------------
# Discovery

_FOLDER = Path(__file__).parent / "plants"


class PlantSource(NamedTuple):
    """Where a plant comes from: its builder as "module:function", and the version in its environment id."""

    builder: str
    version: int


_registered: dict[str, PlantSource] = {}


def plant_sources() -> dict[str, PlantSource]:
    """All plants by id, read from the ID and VERSION lines of the plant files: nothing is imported to list them."""
    found = {}
    for path in sorted(_FOLDER.glob("[!_]*.py")):
        text = path.read_text(encoding="utf-8")
        name = re.search(r'^ID = "(\w+)"$', text, re.MULTILINE)
        version = re.search(r"^VERSION = (\d+)$", text, re.MULTILINE)
        if name and version:
            found[name[1]] = PlantSource(f"fdi_gym.plants.{path.stem}:plant", int(version[1]))
    return dict(sorted((found | _registered).items()))


def add_plant_source(plant_id: str, source: PlantSource) -> None:
    """Make a plant outside the package known; users call `fdi_gym.register_plant`, which registers its environment too."""
    _registered[plant_id] = source


def load_plant(plant_id: str, **options: Any) -> Plant:
    """Build a plant by id with the options of its data sheet.

    Raises:
        ValueError: Unknown plant or option; the message lists those that exist.
    """
    sources = plant_sources()
    if plant_id not in sources:
        raise ValueError(f"unknown plant {plant_id!r}; there are {', '.join(sources)}")
    module, function = sources[plant_id].builder.split(":")
    build = getattr(importlib.import_module(module), function)
    allowed = inspect.signature(build).parameters
    for option in options:
        if option not in allowed:
            raise ValueError(f"unknown option {option!r}; {plant_id} has {', '.join(allowed) or 'none'}")
    plant = build(**options)
    object.__setattr__(plant, "_recipe", (plant_id, options))
    return plant


def _load_again(plant_id: str, options: Mapping[str, Any]) -> Plant:
    return load_plant(plant_id, **options)
