"""Fault scenarios: plain data that says what goes wrong, when and how; any episode can be replayed from one.

All faults act through the plant's fault parameter theta, which has a nominal value, so that a healthy plant is no
special case. A `Fault` is active on the steps `onset <= k < end` (step k is the interval from sample k to k + 1) and
moves the entries of theta that its effects name; outside it they are nominal. Times are sample indices throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np


class Effect(msgspec.Struct, frozen=True, tag_field="profile"):
    """What one fault does to one entry of theta. `entry` is the entry's name in the plant's data sheet."""

    entry: str


class Abrupt(Effect, frozen=True, tag="abrupt"):
    """theta = value from the onset on."""

    value: float


class Incipient(Effect, frozen=True, tag="incipient"):
    """theta = nominal + (value - nominal) (1 - exp(-rate (t - t_onset))), evaluated inside the integrator.

    `rate` is in 1/s.
    """

    value: float
    rate: float


class Intermittent(Effect, frozen=True, tag="intermittent"):
    """theta = value for the first `duty` of every `period` seconds since the onset, nominal for the rest."""

    value: float
    period: float
    duty: float = 0.5


class Square(Effect, frozen=True, tag="square"):
    """theta = value in the even and `other` in the odd half periods since the onset; `period` in seconds."""

    value: float
    other: float
    period: float


class Hold(Effect, frozen=True, tag="hold"):
    """theta = what the named command was `lag` steps before the onset: an actuator that jams where it stands."""

    command: str
    lag: int = 0


class Samples(Effect, frozen=True, tag="samples"):
    """theta = values[k - onset]; the last value stays if the fault outlasts them."""

    values: list[float]


class Fault(msgspec.Struct, frozen=True):
    """One fault: its mode (the discrete class the plant's labels are made of), its kind within it, and its effects.

    `end` is None for a fault that stays to the end of the flight.
    """

    mode: str
    kind: str
    onset: int
    effects: list[Abrupt | Incipient | Intermittent | Square | Hold | Samples]
    end: int | None = None


class FaultScenario(msgspec.Struct, frozen=True, kw_only=True):
    """One realisation: everything that is drawn for an episode. Survives a JSON round trip as an equal object.

    Args:
        plant: Id of the plant it belongs to.
        steps: Length of the flight in samples (K).
        faults: The faults, in any order.
        reference: What the pilot or guidance asks for, in the plant's own terms.
        disturbance: What the world does to the plant, in the plant's own terms (gusts).
        physical: Physical parameters of the truth that differ from the diagnoser's model.
        x0: Initial state, or None for the plant's own.
        noise_seed: Seed of the sensor and process noise stream.
    """

    plant: str
    steps: int
    faults: list[Fault] = []
    reference: dict[str, Any] = {}
    disturbance: dict[str, Any] = {}
    physical: dict[str, Any] = {}
    x0: list[float] | None = None
    noise_seed: int = 0

    def to_json(self) -> str:
        """The scenario as JSON text."""
        return msgspec.json.encode(self).decode()

    @staticmethod
    def from_json(text: str | bytes) -> FaultScenario:
        """The scenario that `to_json` wrote.

        Raises:
            ValueError: The text is not a scenario; the message says where.
        """
        try:
            return msgspec.json.decode(text, type=FaultScenario)
        except msgspec.DecodeError as error:
            raise ValueError(f"not a FaultScenario: {error}") from error

    def without_faults(self) -> FaultScenario:
        """The same flight, healthy: faults discarded, everything else kept."""
        return msgspec.structs.replace(self, faults=[])

    def replace(self, **changes: Any) -> FaultScenario:
        """A copy with some fields changed."""
        return msgspec.structs.replace(self, **changes)


@dataclass(frozen=True, kw_only=True)
class Scoring:
    """Which samples of a process count, and when the one decision of an episode is read.

    Args:
        start: First scored sample; sample 0 ends no interval and never counts.
        grace: Samples not scored after each change of the true label, the first sample with the new label included.
        decision: "final" (the label at the last sample) or "second_half" (the most frequent label over the second
            half of the fault window; the whole flight where there is no fault).
    """

    start: int = 1
    grace: int = 0
    decision: str = "final"
    DECISIONS: ClassVar[tuple[str, ...]] = ("final", "second_half")

    def __post_init__(self) -> None:
        if self.decision not in self.DECISIONS or self.start < 1 or self.grace < 0:
            raise ValueError(f"start >= 1, grace >= 0 and decision one of {self.DECISIONS} are allowed, not {self}")


@dataclass(frozen=True, kw_only=True)
class FaultProcess:
    """A distribution over scenarios, with the rules by which it is scored.

    Args:
        name: How users ask for it: `gym.make(..., scenario=name)`.
        description: One line for tables.
        sample: Draws a scenario from a Generator, in the order that the plant's source prescribes.
        initial: Draws the initial state from a stream of its own, where it is random.
        scoring: The scoring rules.
    """

    name: str
    description: str
    sample: Callable[[np.random.Generator], FaultScenario]
    initial: Callable[[np.random.Generator], Sequence[float]] | None = None
    scoring: Scoring = field(default_factory=Scoring)


class Streams(NamedTuple):
    """The random streams of one episode. They don't share draws: adding one to a stream leaves the others alone."""

    initial: np.random.SeedSequence
    scenario: np.random.SeedSequence
    noise: np.random.SeedSequence
    physical: np.random.SeedSequence


def streams(seed: int) -> Streams:
    """The random streams that belong to an episode's seed."""
    return Streams(*(_stream(seed, name) for name in Streams._fields))


def _stream(seed: int, name: str) -> np.random.SeedSequence:
    """One of them: what `SeedSequence(seed).spawn(4)` gives in its place."""
    return np.random.SeedSequence(seed, spawn_key=(Streams._fields.index(name),))


def draw(
    process: FaultProcess,
    seed: int,
    perturb: Callable[[np.random.Generator], Mapping[str, Any]] | None = None,
) -> FaultScenario:
    """The scenario of one episode, from its seed alone.

    Args:
        process: The fault process.
        seed: The episode's seed, as given to `reset`.
        perturb: Draws the truth's physical parameters in place of those the process drew.
    """
    scenario = process.sample(np.random.default_rng(_stream(seed, "scenario")))
    changes: dict[str, Any] = {"noise_seed": int(_stream(seed, "noise").generate_state(1, np.uint64)[0] >> np.uint64(1))}
    if process.initial is not None:
        changes["x0"] = [float(v) for v in process.initial(np.random.default_rng(_stream(seed, "initial")))]
    if perturb is not None:
        changes["physical"] = dict(perturb(np.random.default_rng(_stream(seed, "physical"))))
    return scenario.replace(**changes)


class ThetaTable(NamedTuple):
    """theta over a flight: on step k, tau seconds after sample k, entry j is a + b exp(-g tau); holds own theirs.

    a, b, g: (K + 1, n_theta). holds: (n_holds, 5) int64, rows (entry, first step, end step, command index, lag).
    """

    a: np.ndarray
    b: np.ndarray
    g: np.ndarray
    holds: np.ndarray


def theta_table(
    scenario: FaultScenario, nominal: np.ndarray, entries: Sequence[str], commands: Sequence[str], dt: float
) -> ThetaTable:
    """What the scenario's faults make of theta, step by step. Where two faults own an entry, the later-listed wins.

    Raises:
        ValueError: An effect names an entry or a command that the plant does not have, or a fault ends before it begins.
    """
    steps = scenario.steps
    a = np.tile(np.asarray(nominal, float), (steps + 1, 1))
    b, g = np.zeros_like(a), np.zeros_like(a)
    holds: list[tuple[int, int, int, int, int]] = []
    for fault in scenario.faults:
        end = steps + 1 if fault.end is None else min(fault.end, steps + 1)
        if fault.onset < 0 or (fault.end is not None and fault.end < fault.onset):
            raise ValueError(f"a fault acts on 0 <= onset <= k < end, not from {fault.onset} to {fault.end}")
        window = slice(min(fault.onset, steps + 1), max(end, 0))
        since = np.arange(window.start, window.stop) - fault.onset
        for effect in fault.effects:
            if effect.entry not in entries:
                raise ValueError(f"no theta entry {effect.entry!r}; {scenario.plant} has {', '.join(entries)}")
            j = list(entries).index(effect.entry)
            b[window, j] = g[window, j] = 0.0
            match effect:
                case Abrupt(value=value):
                    a[window, j] = value
                case Incipient(value=value, rate=rate):
                    a[window, j] = value
                    b[window, j] = (nominal[j] - value) * np.exp(-rate * since * dt)
                    g[window, j] = rate
                case Intermittent(value=value, period=period, duty=duty):
                    on = (since * dt / period + 1e-9) % 1.0 < duty
                    a[window, j] = np.where(on, value, nominal[j])
                case Square(value=value, other=other, period=period):
                    half = np.floor(since * dt / (period / 2) + 1e-9)
                    a[window, j] = np.where(half % 2 == 0, value, other)
                case Hold(command=command, lag=lag):
                    if command not in commands:
                        raise ValueError(f"no command {command!r}; {scenario.plant} has {', '.join(commands)}")
                    holds.append((j, fault.onset, end, list(commands).index(command), lag))
                case Samples(values=values):
                    a[window, j] = np.asarray(values)[np.minimum(since, len(values) - 1)]
    return ThetaTable(a, b, g, np.array(holds, dtype=np.int64).reshape(-1, 5))
