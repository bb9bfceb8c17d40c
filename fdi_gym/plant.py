"""What a plant declares: its data sheet (signals, fault modes, labels), its equations, and its fault processes.

A plant file in `fdi_gym/plants/` has the lines `ID = "..."` and `VERSION = ...` and a function `plant(**options)` that
returns a `Plant`; `fdi_gym/discovery.py` finds it. All that such a file needs to declare it is imported from here.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fdi_gym.acting import Acting
from fdi_gym.checks import check_declaration, check_scenario, twice
from fdi_gym.data_sheet import FaultMode, Kernels, Label, Signal, squared_error
from fdi_gym.faults import FaultProcess, FaultScenario, draw
from fdi_gym.model import Array
from fdi_gym.model import NotApplicableError as NotApplicableError
from fdi_gym.names import unknown
from fdi_gym.shapes import OPEN, Shapes
from fdi_gym.truth import Truth


def _no_rows(scenario: FaultScenario) -> Array:
    return np.zeros((scenario.steps + 1, 0))


def _nothing(state: Array) -> Mapping[str, Array]:
    return {}


def _no_change(physical: Mapping[str, Any]) -> Array:
    if physical:
        raise ValueError(f"this plant has no physical parameters to change, but the scenario sets {', '.join(physical)}")
    return np.zeros(0)


class _ByName:
    """The field `Plant.processes`: given as a sequence or by name, read by name."""

    def __get__(self, plant: Any, owner: type | None = None) -> Mapping[str, FaultProcess]:
        if plant is None:
            raise AttributeError("no default")
        return plant.__dict__["processes"]

    def __set__(self, plant: Any, given: Sequence[FaultProcess] | Mapping[str, FaultProcess]) -> None:
        found = given
        if not isinstance(found, Mapping):
            for wrong in twice("processes", [process.name for process in found]):
                raise ValueError(f"{plant.id}: {wrong}")
            found = {process.name: process for process in found}
        if "standard" in found and "fault-free" not in found:
            found = {**found, "fault-free": found["standard"].without_faults()}
        plant.__dict__["processes"] = found


BROUGHT = {  # processes that an option of every plant brings (`fdi_gym.options`)
    "mixed": "sensor_faults", "sensors": "sensor_faults", "unseen": "unseen", "simultaneous": "simultaneous",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Plant(Truth):
    """A plant's whole declaration. Built by the plant file's `plant(**options)`; plain data, functions and kernels.

    A contradiction in it raises ValueError. A plant that `load_plant` built is pickled as its id and options, equals
    another of the same, and can be sent to any process that can import its builder; any other plant is pickled by value
    and equals itself only.

    Args:
        id: The part of the environment id before "-Faults-v".
        version: The number after it; raised by any change that alters a score.
        options: The options it was built with: plain values.
        description: One line for tables.
        dt: Sample time [s].
        substeps: Runge-Kutta steps per sample; 0 for a discrete plant, whose dynamics kernel gives the next state.
        linear: The dynamics are linear in x, and bilinear in (u, theta).
        kernels: The compiled equations; None where only channels are known: no model-based method runs.
        states, outputs, commands, known, disturbances: Data sheets of the vectors, in order.
        theta: Data sheet of the fault parameter; `nominal` is the healthy value.
        estimated: Data sheet of what the identification task asks for. Default: theta itself.
        target: Maps theta (..., n_theta) and the command held over the same interval (..., n_u) to the estimated
            quantity (..., n). Default: theta itself.
        modes: The fault modes.
        labels: The answers of the isolation task; the first one is "none".
        processes: The fault processes, one of them called "standard". Where none is called "fault-free", there is one
            that draws the standard flights without their faults. Stored by name.
        c0: Initial state of the controller.
        q: Parameters of the controller.
        true_feedback: The controller gets the sensors' values before their noise is added; diagnosers never do.
        healthy_feedback: The controller gets what healthy sensors would say, each at every sample.
        simultaneous: Any of its modes may act at once, in sets for which there is no label (`fdi_gym.simultaneous`).
        bare: Of a plant whose sensors may fail (`fdi_gym.sensors`): the same without.
        unseen: One of its labels is that of faults that no method is told of (`fdi_gym.unseen`).
        regular: Of a plant whose sensors leave samples out: the same with sensors that report at every one.
        physical: Maps a scenario's physical parameters to the vector p; of {} it gives the nominal model.
        perturb: Draws physical parameters at a level of mismatch: perturb(rng, level) -> dict, or None if it has none.
        reference: Maps a scenario to the exogenous reference rows (steps + 1, n_r). Of a row that stays the same,
            `np.broadcast_to(row, (steps + 1, n_r))` is kept once.
        disturbance: Maps a scenario to the disturbance rows (steps + 1, n_d), likewise.
        measured_disturbance: What the known signals say of the disturbance that is held over an interval:
            measured_disturbance(t, before, now) -> (n, n_d), from its start t [s] and the known signals (n, n_known) at
            its two ends. None where nothing is known of it.
        shapes: What the three dicts of a scenario may hold; what does not fit is refused before it flies.
        monitor: Maps states (..., n_x) to named quantities (...) that `info` reports beside the truth, such as the distance
            to a singularity; diagnosers never see them.
        quaternions: Outputs that are a quaternion known up to its sign: the positions of its vector part (3) and of the
            sign of its scalar part, for each.
        noise_limit: The white noise of sensors and states is clipped at so many standard deviations. Default: never.
        acting: How it can be acted on: probes, accommodation, and what they cost. Default: not at all.
        isolation_reward: (labels, labels): reward of declaring column while row is true. Default: 1 if right, else 0.
        identification_reward: Reward of an error (..., n). Default: minus the squares, scaled.
    """

    id: str
    version: int
    description: str
    dt: float
    substeps: int
    kernels: Kernels | None
    states: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    commands: tuple[Signal, ...]
    theta: tuple[Signal, ...]
    modes: tuple[FaultMode, ...]
    labels: tuple[Label, ...]
    processes: _ByName = _ByName()
    options: Mapping[str, Any] = field(default_factory=dict)
    linear: bool = False
    known: tuple[Signal, ...] = ()
    disturbances: tuple[Signal, ...] = ()
    estimated: tuple[Signal, ...] = ()
    target: Callable[[Array, Array], Array] | None = None
    c0: Array = field(default_factory=lambda: np.zeros(0))
    q: Array = field(default_factory=lambda: np.zeros(0))
    true_feedback: bool = False
    healthy_feedback: bool = False
    simultaneous: bool = False
    bare: Plant | None = None
    unseen: bool = False
    regular: Plant | None = None
    physical: Callable[[Mapping[str, Any]], Array] = _no_change
    perturb: Callable[[np.random.Generator, float], Mapping[str, Any]] | None = None
    reference: Callable[[FaultScenario], Array] = _no_rows
    disturbance: Callable[[FaultScenario], Array] | None = None
    measured_disturbance: Callable[[float, Array, Array], Array] | None = None
    monitor: Callable[[Array], Mapping[str, Array]] = _nothing
    shapes: Shapes = OPEN
    quaternions: tuple[tuple[int, int, int, int], ...] = ()
    noise_limit: float = np.inf
    acting: Acting | None = None
    isolation_reward: Array | None = None
    identification_reward: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        if not self.estimated:
            object.__setattr__(self, "estimated", self.theta)
        if self.isolation_reward is None:
            object.__setattr__(self, "isolation_reward", np.eye(len(self.labels)))
        check_declaration(self)
        if self.identification_reward is None:
            object.__setattr__(self, "identification_reward", squared_error([s.scale for s in self.estimated]))

    @property
    def origin(self) -> Any:
        """How `load_plant` built it (`fdi_gym.discovery.Origin`); None for a plant made otherwise."""
        return self.__dict__.get("_origin")

    def __reduce__(self) -> tuple[Any, ...]:
        if self.origin is not None:
            return self.origin.build, ()
        from fdi_gym.kernels import Sent

        state = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        if self.kernels is not None:
            state["kernels"] = Kernels(*(f if f is None else Sent(f) for f in self.kernels))
        return object.__new__, (Plant,), state

    def __eq__(self, other: object) -> bool:
        same = isinstance(other, Plant) and self.origin is not None and self.origin == other.origin
        return self is other or same

    def __hash__(self) -> int:
        return object.__hash__(self) if self.origin is None else hash((self.origin.plant_id, self.origin.source))

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
    def periods(self) -> Array:
        """The turn of each output that is an angle known up to whole turns, 0 for others (n_y,)."""
        return np.array([s.period for s in self.outputs])

    def split(self, obs: Array) -> tuple[Array, Array, Array]:
        """An observation (..., n_obs) as (y, u of the interval that has just ended, known)."""
        n_y, n_u = len(self.outputs), len(self.commands)
        return obs[..., :n_y], obs[..., n_y : n_y + n_u], obs[..., n_y + n_u :]

    @functools.cached_property
    def _scaling(self) -> tuple[Array, Array]:
        """Nominal values and scales of the observations (n_obs,)."""
        return np.array([s.nominal for s in self.observed], float), np.array([s.scale for s in self.observed], float)

    def scale(self, obs: Array) -> Array:
        """Observations (..., n_obs) as `units="scaled"` shows them: how many scales of the data sheet off nominal."""
        nominal, scale = self._scaling
        return (obs - nominal) / scale

    def unscale(self, obs: Array) -> Array:
        """The inverse of `scale`: scaled observations (..., n_obs) in the units of the data sheet."""
        nominal, scale = self._scaling
        return obs * scale + nominal

    def estimate_target(self, theta: Array, u: Array) -> Array:
        """What the identification task asks for, from theta (..., n_theta) and the command held with it (..., n_u)."""
        return theta if self.target is None else self.target(theta, u)

    @functools.cached_property
    def healthy(self) -> Array:
        """The estimated quantity (n,) of the plant without a fault."""
        return self.estimate_target(self.nominal_theta, self.trim_command)

    def magnitudes(self, label: Array, deviation: Array) -> Array:
        """How far along its directions each mode of a label is (..., n_magnitudes); NaN where the label does not have it.

        Where the directions of a label's modes are not independent, the least magnitudes that explain the deviation.

        Args:
            label: Label indices (...); others than the plant's have no modes.
            deviation: Of the estimated quantity from healthy (..., n).
        """
        found = np.full((*label.shape, self.n_magnitudes), np.nan)
        for index, of in enumerate(self.labels):
            active = [i for i, mode in enumerate(self.modes) if mode.name in of.modes]
            mine = label == index
            if active and mine.any():
                offset = np.sum([self.modes[i].offset for i in active], axis=0)
                D = np.concatenate([self.modes[i].directions for i in active]).T
                values = (deviation[mine] - offset) @ np.linalg.pinv(D).T
                for column, i in enumerate(np.concatenate([self.magnitudes_of[i] for i in active]).tolist()):
                    found[mine, i] = values[:, column]
        return found

    @functools.cached_property
    def magnitudes_of(self) -> tuple[Array, ...]:
        """The positions of each mode's magnitudes (f,) among those of all modes, which follow one another."""
        counts = [len(mode.directions) for mode in self.modes]
        return tuple(np.arange(end - count, end) for count, end in zip(counts, itertools.accumulate(counts), strict=True))

    @property
    def n_magnitudes(self) -> int:
        """How many magnitudes all modes have together: one each, more where they are planes."""
        return sum(len(which) for which in self.magnitudes_of)

    @functools.cached_property
    def reaches(self) -> Array:
        """The ends of all magnitudes (n_magnitudes, 2)."""
        return np.concatenate([np.zeros((0, 2)), *(mode.reaches for mode in self.modes)])

    @functools.cached_property
    def theta_entries(self) -> tuple[str, ...]:
        """Names of the entries of theta, in order."""
        return tuple(s.name for s in self.theta)

    @functools.cached_property
    def command_names(self) -> tuple[str, ...]:
        """Names of the commands, in order."""
        return tuple(s.name for s in self.commands)

    @functools.cached_property
    def mode_names(self) -> tuple[str, ...]:
        """Names of the fault modes, in order."""
        return tuple(mode.name for mode in self.modes)

    def validate(self, scenario: FaultScenario) -> list[tuple[int, int]]:
        """Whether a scenario fits this plant, whole: every flight asks before a kernel sees it.

        Returns:
            The changes of its true label, as `label_changes` gives them.

        Raises:
            ValueError: It does not; the message names the field, what was wrong and what is allowed.
            TypeError: It is no scenario.
        """
        return check_scenario(self, scenario)

    def process(self, name: str) -> FaultProcess:
        """A fault process by name.

        Raises:
            ValueError: There is none of that name; the message lists those that exist.
        """
        if name not in self.processes:
            found = unknown("process", name, self.processes, f"{self.id} has")
            option = BROUGHT.get(name)
            raise ValueError(f"{found}; {name} comes with {option}=True") if option else found
        return self.processes[name]

    def draw(self, process: str, seed: int, mismatch: float | None = None) -> FaultScenario:
        """The scenario of one episode, from its seed alone.

        Args:
            process: Name of the fault process.
            seed: The episode's seed, as given to `reset`.
            mismatch: Level at which the truth's physical parameters are drawn; None for what the process prescribes.

        Raises:
            ValueError: There is no such process; `NotApplicableError` for a mismatch where the plant declares none.
        """
        found, perturb = self.process(process), self.perturb
        if mismatch is None:
            return draw(found, seed)
        if perturb is None:
            raise NotApplicableError(f"{self.id} declares no mismatch")
        return draw(found, seed, lambda rng: perturb(rng, mismatch))

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
        if self.acting is not None:
            lines.append("\nprobes (action of the active environment)")
            lines += [f"  {i:2d} {probe.name:17s} {probe.description}" for i, probe in enumerate(self.acting.probes)]
        lines.append("\nscenarios")
        lines += [f"  {name:20s} {process.description}" for name, process in self.processes.items()]
        return "\n".join(lines)
