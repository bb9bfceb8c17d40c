"""Fault scenarios: plain data that says what goes wrong, when and how; any episode can be replayed from one.

All faults act through the plant's fault parameter theta, which has a nominal value, so that a healthy plant is no
special case; those of its sensors too (`fdi_gym.sensors`). A `Fault` is active on the steps `onset <= k < end` (step k is
the interval from sample k to k + 1) and moves the entries of theta that its effects name; outside it they are nominal.
Times are sample indices throughout.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from msgspec import Meta

from fdi_gym.drawing import stream
from fdi_gym.plain import UsualDict, of_numpy, plain, value_at

MAX_STEPS = 1_000_000  # samples of a flight: what is recorded of it takes a gigabyte or less
MAX_JSON = 2**25  # bytes of a scenario as text

DICTS = ("reference", "disturbance", "physical")  # what a plant reads in its own terms

Finite = Annotated[float, Meta(ge=-1e300, le=1e300)]
Rate = Annotated[float, Meta(gt=0.0, le=1e9)]  # 1/s
Period = Annotated[float, Meta(ge=1e-9, le=1e12)]  # s
Duty = Annotated[float, Meta(gt=0.0, le=1.0)]
Step = Annotated[int, Meta(ge=0, le=MAX_STEPS)]
Steps = Annotated[int, Meta(ge=1, le=MAX_STEPS)]
Share = Annotated[float, Meta(ge=0.0, lt=1.0)]
Length = Annotated[float, Meta(ge=1.0, le=1e6)]  # samples
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]


class Effect(msgspec.Struct, frozen=True, tag_field="profile", forbid_unknown_fields=True):
    """What one fault does to one entry of theta. `entry` is the entry's name in the plant's data sheet."""

    entry: str


class Abrupt(Effect, frozen=True, tag="abrupt"):
    """theta = value from the onset on."""

    value: Finite


class Incipient(Effect, frozen=True, tag="incipient"):
    """theta = nominal + (value - nominal) (1 - exp(-rate (t - t_onset))), evaluated inside the integrator.

    `rate` is in 1/s.
    """

    value: Finite
    rate: Rate


class Ramp(Effect, frozen=True, tag="ramp"):
    """theta runs straight from nominal at the onset to value, which it reaches after `duration` seconds, and stays there."""

    value: Finite
    duration: Period


class Intermittent(Effect, frozen=True, tag="intermittent"):
    """theta = value for the first `duty` of every `period` seconds since the onset, nominal for the rest."""

    value: Finite
    period: Period
    duty: Duty = 0.5


class Square(Effect, frozen=True, tag="square"):
    """theta = value in the even and `other` in the odd half periods since the onset; `period` in seconds."""

    value: Finite
    other: Finite
    period: Period


class Hold(Effect, frozen=True, tag="hold"):
    """theta = what the named command was `lag` steps before the onset: an actuator that jams where it stands.

    At most onset + 1, which is the command before the first sample.
    """

    command: str
    lag: Step = 0


class Samples(Effect, frozen=True, tag="samples"):
    """theta = values[k - onset]; the last value stays if the fault outlasts them."""

    values: Annotated[list[Finite], Meta(min_length=1, max_length=MAX_STEPS)]


class Fault(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One fault: its mode (the discrete class the plant's labels are made of), its kind within it, and its effects.

    `end` is None for a fault that stays to the end of the flight; onset and end may lie beyond it.
    """

    mode: str
    kind: str
    onset: Step
    effects: Annotated[list[Abrupt | Incipient | Ramp | Intermittent | Square | Hold | Samples], Meta(min_length=1)]
    end: Step | None = None


class Sampling(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the sensors report, which is no fault: a sample that does not come reads NaN, and the controller keeps the last.

    Args:
        dropout: Share of the samples of each sensor that go missing, at random.
        burst: Mean length of a gap [samples], at least dropout / (1 - dropout). 1: whatever independent ones give.
        periods: Samples from one reading of a sensor to the next, by its name. Default: every sample.
        delays: Samples by which a sensor lags, by its name. Default: none.
        hold: A sensor that does not report shows its last reading again, in place of NaN.

    Raises:
        ValueError: Gaps so short cannot take such a share.
    """

    dropout: Share = 0.0
    burst: Length = 1.0
    periods: dict[str, Steps] = {}
    delays: dict[str, Step] = {}
    hold: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"dropout is a share from 0 up to, not including, 1, not {self.dropout!r}")
        least = self.dropout / (1.0 - self.dropout)
        if self.burst != 1.0 and not self.burst >= max(least, 1.0):
            raise ValueError(
                f"burst is a mean gap of at least {max(least, 1.0):g} samples for a dropout of {self.dropout:g}, or 1 for "
                f"independent ones; not {self.burst!r}"
            )


class _Fields(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The fields of a scenario, with their types: what msgspec can check."""

    plant: str
    steps: Steps
    faults: list[Fault] = []
    reference: dict[str, Any] = {}
    disturbance: dict[str, Any] = {}
    physical: dict[str, Any] = {}
    x0: list[Finite] | None = None
    noise_seed: Seed = 0
    sampling: Sampling | msgspec.UnsetType = msgspec.UNSET


class _Usual(_Fields, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The same with dicts no deeper than the usual ones: what msgspec can check and copy in one pass."""

    reference: UsualDict = {}
    disturbance: UsualDict = {}
    physical: UsualDict = {}


def _usual(scenario: _Fields) -> _Fields | None:
    """A checked copy of a scenario that holds Python's own values in the usual depth; None: of another, or a wrong one."""
    try:
        copy = msgspec.convert(msgspec.to_builtins(scenario), _Usual)
        for name in DICTS:
            given = getattr(scenario, name)
            if type(given) is not dict or getattr(copy, name) != given:  # msgspec also makes lists of sets
                return None
    except Exception:  # whatever it is, it is searched and named by those who take longer
        return None
    return copy


class FaultScenario(_Fields, frozen=True, kw_only=True):
    """One realisation: everything that is drawn for an episode. Survives a JSON round trip as an equal object.

    What it is made of is checked, and copied, when it is made: types, signs, finite numbers, windows in order, one fault
    at a time for an entry of theta. NumPy's numbers and arrays become Python's. Whether it fits a plant says
    `Plant.validate`, which every flight asks.

    Args:
        plant: Id of the plant it belongs to.
        steps: Length of the flight in samples (K), 1 to 1,000,000.
        faults: The faults, in any order.
        reference: What the pilot or guidance asks for, in the plant's own terms.
        disturbance: What the world does to the plant, in the plant's own terms (gusts).
        physical: Physical parameters of the truth that differ from the diagnoser's model.
        x0: Initial state, or None for the plant's own.
        noise_seed: Seed of the sensor and process noise stream, 0 to 2^63 - 1.
        sampling: How the sensors report. Default: each at every sample.

    Raises:
        ValueError: A field has a value that it cannot have; the message names it and what is allowed.
    """

    def __post_init__(self) -> None:
        checked = _usual(self) or self._checked()
        for name in self.__struct_fields__:
            msgspec.structs.force_setattr(self, name, getattr(checked, name))
        _check_windows(checked.faults)

    def _checked(self) -> _Fields:
        """A checked copy of any scenario, or the error that says what is wrong with it."""
        given: dict[str, Any] = {name: getattr(self, name) for name in self.__struct_fields__}
        dicts = {name: plain(given[name], name) for name in DICTS}
        unset = {name for name, value in given.items() if value is msgspec.UNSET}
        typed = {name: v for name, v in given.items() if type(dicts.get(name)) is not dict and name not in unset}
        try:
            data = msgspec.to_builtins(typed, enc_hook=of_numpy)
            checked = msgspec.convert(data, _Fields)
        except msgspec.ValidationError as error:
            raise ValueError(f"not a FaultScenario: {error}{value_at(str(error), data)}") from None
        except RecursionError:
            raise ValueError("not a FaultScenario: it contains itself") from None
        for name in DICTS:
            msgspec.structs.force_setattr(checked, name, dicts[name])
        return checked

    def to_json(self) -> str:
        """The scenario as JSON text.

        Raises:
            ValueError: It has become one that could not be made, or has more than MAX_JSON bytes.
        """
        text = msgspec.json.encode(self.replace())  # checked again: its lists may have been written to
        if len(text) > MAX_JSON:
            raise ValueError(f"a scenario has at most {MAX_JSON} bytes as JSON, not {len(text)}")
        return text.decode()

    @staticmethod
    def from_json(text: str | bytes) -> FaultScenario:
        """The scenario that `to_json` wrote.

        Raises:
            ValueError: The text is not a scenario; the message says where.
        """
        if not isinstance(text, (str, bytes)):
            raise TypeError(f"a scenario's JSON is text, not {type(text).__name__}")
        if len(text) > MAX_JSON:
            raise ValueError(f"not a FaultScenario: it has at most {MAX_JSON} bytes as JSON, not {len(text)}")
        try:
            found = msgspec.json.decode(text, type=_Fields)
        except (ValueError, RecursionError) as error:  # of msgspec, or no UTF-8
            raise ValueError(f"not a FaultScenario: {error}") from None
        return FaultScenario(**msgspec.structs.asdict(found))

    def without_faults(self) -> FaultScenario:
        """The same flight, healthy: faults discarded, everything else kept."""
        return msgspec.structs.replace(self, faults=[])

    def replace(self, **changes: Any) -> FaultScenario:
        """A copy with some fields changed."""
        return msgspec.structs.replace(self, **changes)


def _check_windows(faults: list[Fault]) -> None:
    """Each fault begins before it ends, and no two own an entry of theta at once."""
    owned: dict[str, list[tuple[int, int, int]]] = {}
    for i, fault in enumerate(faults):
        end = MAX_STEPS + 1 if fault.end is None else fault.end
        if end < fault.onset:
            raise ValueError(f"faults[{i}]: a fault acts on onset <= k < end, not from {fault.onset} to {end}")
        for effect in fault.effects:
            if isinstance(effect, Hold) and effect.lag > fault.onset + 1:
                raise ValueError(
                    f"faults[{i}]: a hold has a lag of at most onset + 1 = {fault.onset + 1}, there is no earlier command; "
                    f"not {effect.lag}"
                )
            if end > fault.onset:
                owned.setdefault(effect.entry, []).append((fault.onset, end, i))
    for entry, windows in owned.items():
        for (_, end, i), (onset, _, j) in itertools.pairwise(sorted(windows)):
            if onset < end:
                raise ValueError(
                    f"faults[{i}] and faults[{j}] both own the entry {entry!r} at step {onset}; one at a time is allowed"
                )


@dataclass(frozen=True, kw_only=True)
class Scoring:
    """Which samples of a process count, and how the decision about a fault window or a healthy flight is read.

    Args:
        start: First scored sample; sample 0 ends no interval and never counts.
        grace: Samples not scored after each change of the true label, the first sample with the new label included.
        decision: "final" (the label at the last sample of the window, or of the healthy flight) or "second_half" (the most
            frequent label over the second half of it).
    """

    start: int = 1
    grace: int = 0
    decision: str = "final"
    DECISIONS: ClassVar[tuple[str, ...]] = ("final", "second_half")

    def __post_init__(self) -> None:
        whole = all(isinstance(v, (int, np.integer)) and not isinstance(v, bool) for v in (self.start, self.grace))
        if self.decision not in self.DECISIONS or not whole or self.start < 1 or self.grace < 0:
            raise ValueError(
                f"whole numbers start >= 1, grace >= 0 and decision one of {self.DECISIONS} are allowed, not {self}"
            )


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

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name or self.name.lstrip().startswith("{"):
            raise ValueError(f"a fault process has a name that does not begin with a brace, not {self.name!r}")
        if not callable(self.sample) or not (self.initial is None or callable(self.initial)):
            raise TypeError(f"the fault process {self.name!r}: sample and initial are functions of a Generator")
        if not isinstance(self.scoring, Scoring):
            raise TypeError(f"the fault process {self.name!r}: scoring is a Scoring, not {type(self.scoring).__name__}")

    def without_faults(self) -> FaultProcess:
        """The process "fault-free": the same flights without their faults."""
        description, sample = f"the {self.name} flights without their faults", self.sample
        return replace(self, name="fault-free", description=description, sample=lambda rng: sample(rng).without_faults())


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
    scenario = process.sample(np.random.default_rng(stream(seed, "scenario")))
    if not isinstance(scenario, FaultScenario):
        raise TypeError(f"the fault process {process.name!r} draws a FaultScenario, not {type(scenario).__name__}")
    changes: dict[str, Any] = {"noise_seed": int(stream(seed, "noise").generate_state(1, np.uint64)[0] >> np.uint64(1))}
    if process.initial is not None:
        changes["x0"] = [float(v) for v in process.initial(np.random.default_rng(stream(seed, "initial")))]
    if perturb is not None:
        changes["physical"] = dict(perturb(np.random.default_rng(stream(seed, "physical"))))
    return scenario.replace(**changes)
