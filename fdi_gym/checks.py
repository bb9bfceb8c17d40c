"""What a plant's declaration and a scenario must be before a kernel sees them; the kernels themselves check nothing."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fdi_gym import shapes
from fdi_gym.acting import Acting, Probe
from fdi_gym.data_sheet import Kernels
from fdi_gym.faults import (
    Abrupt,
    Effect,
    FaultProcess,
    FaultScenario,
    Hold,
    Incipient,
    Intermittent,
    Ramp,
    Samples,
    Sampling,
    Square,
)
from fdi_gym.names import unknown

if TYPE_CHECKING:
    from fdi_gym.data_sheet import FaultMode, Signal
    from fdi_gym.plant import Plant

MOST = 128  # states, or signals of a kind, of a plant with equations: kernels keep vectors and matrices of them on the stack
X0_RANGES = 10.0  # an initial state lies within so many times its declared range


def is_whole(value: Any) -> bool:
    """Whether a value is an integer, Python's or NumPy's; a boolean is none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def is_real(value: Any) -> bool:
    """Whether a value is a number, infinite ones included; NaN and booleans are none."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool) and value == value


def is_finite(value: Any) -> bool:
    """Whether a value is a finite number."""
    return is_real(value) and math.isfinite(value)


def number(name: str, value: Any, low: float, high: float) -> float:
    """An option as a float.

    Raises:
        ValueError: It is no number in [low, high].
    """
    if not is_finite(value) or not low <= value <= high:
        raise ValueError(f"{name} is a number from {low:g} to {high:g}, not {value!r}")
    return float(value)


# ---------------------------------------------------------------------------------------------------------------
# Declarations


def check_declaration(plant: Plant) -> None:
    """Raise ValueError where a plant's declaration contradicts itself; the message begins with the plant's id."""
    for wrong in _wrong(plant):
        raise ValueError(f"{plant.id}: {wrong}")


def _wrong(plant: Plant) -> Iterable[str]:
    if not isinstance(plant.id, str) or not re.fullmatch(r"\w+", plant.id):
        yield f"an id is a word of letters, digits and underscores, not {plant.id!r}"
    if not is_whole(plant.version) or plant.version < 0:
        yield f"version is a whole number from 0 on, not {plant.version!r}"
    if not is_finite(plant.dt) or plant.dt <= 0:
        yield f"dt is a positive number of seconds, not {plant.dt!r}"
    if not is_whole(plant.substeps) or plant.substeps < 0:
        yield f"substeps is a whole number from 0 on, not {plant.substeps!r}"
    kernels = plant.kernels
    for role, kernel in kernels._asdict().items() if kernels is not None else ():
        if not hasattr(kernel, "py_func") and not (kernel is None and role in Kernels._field_defaults):
            yield f"the kernel {role!r} is a function marked @kernel, not {kernel!r}"
    for role in ("physical", "reference", "monitor"):
        if not callable(getattr(plant, role)):
            yield f"{role} is a function, not {getattr(plant, role)!r}"
    for role in ("states", "outputs", "commands", "known", "disturbances", "theta", "estimated"):
        yield from _wrong_signals(role, getattr(plant, role))
        if kernels is not None and plant.bare is None and len(getattr(plant, role)) > MOST:
            yield f"a plant with equations has at most {MOST} {role}, not {len(getattr(plant, role))}"
    for parts in plant.quaternions:
        if len(set(parts)) != 4 or len(parts) != 4 or not all(is_whole(i) and 0 <= i < len(plant.outputs) for i in parts):
            yield f"quaternions are four different positions among the {len(plant.outputs)} outputs each, not {parts!r}"
    yield from twice("commands and known signals", [s.name for s in (*plant.commands, *plant.known)])
    yield from twice("modes", [mode.name for mode in plant.modes])
    yield from twice("labels", [label.name for label in plant.labels])
    yield from twice("labels' sets of modes", [sorted(label.modes) for label in plant.labels])
    for mode in plant.modes:
        yield from _wrong_mode(mode, len(plant.estimated))
    names = {mode.name for mode in plant.modes}
    unknown = {name for label in plant.labels for name in label.modes} - names
    if unknown or not plant.labels or plant.labels[0].modes:
        yield f"labels start with the empty set and use declared modes {sorted(names)}, not {sorted(unknown)}"
    for name, process in plant.processes.items():
        if not isinstance(process, FaultProcess) or process.name != name:
            yield f"the process {name!r} is a FaultProcess of that name, not {getattr(process, 'name', process)!r}"
    if "standard" not in plant.processes:
        yield f"a plant needs a 'standard' fault process; there are {', '.join(plant.processes)}"
    for name in ("c0", "q"):
        values = np.asarray(getattr(plant, name))
        if values.ndim != 1 or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
            yield f"{name} is a vector of finite numbers, not {getattr(plant, name)!r}"
    reward, n = np.asarray(plant.isolation_reward), len(plant.labels)
    if reward.shape != (n, n) or reward.dtype.kind not in "iufb" or not np.isfinite(reward).all():
        yield f"isolation_reward holds finite numbers in the shape ({n}, {n}), not {plant.isolation_reward!r}"
    if plant.acting is not None and not isinstance(plant.acting, Acting):
        yield f"acting is an Acting, not {plant.acting!r}"
    elif plant.acting is not None and plant.bare is None and not plant.simultaneous:
        yield from _wrong_acting(plant, plant.acting)


def twice(what: str, names: Sequence[Any]) -> Iterable[str]:
    """Says which names occur more than once."""
    if again := [name for i, name in enumerate(names) if name in names[:i]]:
        yield f"two {what} are called {again[0]!r}"


def _wrong_signals(role: str, signals: Sequence[Signal]) -> Iterable[str]:
    yield from twice(role, [s.name for s in signals])
    for s in signals:
        if not isinstance(s.name, str) or not s.name:
            yield f"{role}: a signal has a name, not {s.name!r}"
        if not is_real(s.low) or not is_real(s.high) or s.low > s.high:
            yield f"{role}: {s.name} has low <= high, not [{s.low}, {s.high}]"
        elif not is_finite(s.nominal) or not s.low <= s.nominal <= s.high:
            yield f"{role}: {s.name} has a nominal value within [{s.low}, {s.high}], not {s.nominal}"
        if not is_finite(s.scale) or s.scale <= 0:
            yield f"{role}: {s.name} has a positive scale, not {s.scale}"
        if not is_finite(s.sigma) or s.sigma < 0:
            yield f"{role}: {s.name} has a standard deviation sigma from 0 on, not {s.sigma}"
        if not is_finite(s.period) or s.period < 0:
            yield f"{role}: {s.name} has a period from 0 on, not {s.period}"


def _wrong_mode(mode: FaultMode, n: int) -> Iterable[str]:
    if not callable(mode.size):
        yield f"the mode {mode.name!r} has a function size, not {mode.size!r}"
    several = any(np.ndim(row) for row in (*mode.direction, *mode.reach))
    for name, length in (("bands", 2), ("offset", n), ("direction", n), ("reach", 2)):
        values = getattr(mode, name)
        rows = values if several and name in ("direction", "reach") else [values]
        if any(np.ndim(row) != 1 or len(row) != length or not all(map(is_finite, row)) for row in rows):
            yield f"the mode {mode.name!r} has {length} finite numbers in {name}, not {values!r}"
            return
    if several and len(mode.direction) != len(mode.reach):
        ranges, directions = len(mode.reach), len(mode.direction)
        yield f"the mode {mode.name!r} has a range in reach for each direction, not {ranges} for {directions}"
        return
    for name, rows in (("bands", [mode.bands]), ("reach", mode.reaches.tolist())):
        for low, high in rows:
            if low > high:
                yield f"the mode {mode.name!r} has {name} in rising order, not {(low, high)}"
    if not mode.moves.any():
        yield f"the mode {mode.name!r} has an offset or a direction that moves something"
    if several and np.linalg.matrix_rank(mode.directions) < len(mode.directions):
        yield f"the mode {mode.name!r} has independent directions, not {mode.direction!r}"


def _wrong_acting(plant: Plant, acting: Acting) -> Iterable[str]:
    if not callable(acting.flight_cost):
        yield f"flight_cost is a function of x, u and r, not {acting.flight_cost!r}"
    if isinstance(acting.lost, bool) or not isinstance(acting.lost, (int, float)) or not 0 < acting.lost < np.inf:
        yield f"lost is a positive number, not {acting.lost!r}"
    yield from twice("probes", [probe.name for probe in acting.probes])
    for probe in acting.probes[1:]:
        yield from _wrong_probe(plant, probe)
    if acting.accommodate is not None:
        q, n = np.asarray(plant.q, float), len(plant.estimated)
        try:
            found = np.asarray(acting.accommodate(np.tile(plant.healthy, (2, 1))), float)
        except Exception as error:  # whatever the plant's author did not think of
            yield f"accommodate fails for the healthy plant's estimate (2, {n}): {type(error).__name__}: {error}"
            return
        if found.shape != (2, q.size) or not (found == q).all():
            yield f"accommodate gives the plant's parameters q (2, {q.size}) for the healthy plant, not {found!r}"


def _wrong_probe(plant: Plant, probe: Probe) -> Iterable[str]:
    n_u, q = len(plant.commands), np.asarray(plant.q, float)
    if probe.command is None and probe.reference is None and probe.parameters is None:
        yield f"the probe {probe.name!r} adds something to the command, the reference or the controller's parameters"
    for name, width in (("command", n_u), ("reference", None)):
        rows = getattr(probe, name)
        if rows is None:
            continue
        rows = np.asarray(rows)
        good = rows.ndim == 2 and len(rows) and rows.dtype.kind in "iuf" and np.isfinite(rows).all()
        if not good or (width is not None and rows.shape[1] != width):
            yield f"the probe {probe.name!r} has finite rows (T, {width or 'n_r'}) as its {name}, not the shape {rows.shape}"
        elif name == "command":
            for signal, column in zip(plant.commands, rows.T, strict=True):
                low, high = signal.nominal + column.min(), signal.nominal + column.max()
                if not signal.low <= low <= high <= signal.high:
                    yield (
                        f"the probe {probe.name!r} would bring {signal.name} from {low:g} to {high:g} {signal.unit}, beyond "
                        f"the actuator's limits [{signal.low:g}, {signal.high:g}]"
                    )
    if probe.parameters is not None:
        given = np.asarray(probe.parameters)
        if given.shape != q.shape or given.dtype.kind not in "iuf" or not np.isfinite(given).all():
            yield f"the probe {probe.name!r} has finite parameters ({q.size},), not {probe.parameters!r}"


# ---------------------------------------------------------------------------------------------------------------
# Scenarios


def check_scenario(plant: Plant, scenario: FaultScenario) -> list[tuple[int, int]]:
    """Raise ValueError where a scenario does not fit its plant; the message names the field and what is allowed.

    Returns the changes of its true label (see `Truth.label_changes`).
    """
    if not isinstance(scenario, FaultScenario):
        raise TypeError(f"a scenario is a FaultScenario, not {type(scenario).__name__}")
    scenario = scenario.replace()  # its own checks once more: lists can be written to
    if scenario.plant != plant.id:
        raise ValueError(f"the scenario belongs to {scenario.plant}, not to {plant.id}")
    if scenario.x0 is not None:
        _check_state(plant, scenario.x0)
    for i, fault in enumerate(scenario.faults):
        if fault.mode not in plant.mode_names:
            raise ValueError(
                f"faults[{i}]: no fault mode {fault.mode!r}; {plant.id} has {', '.join(sorted(plant.mode_names))}"
            )
        for effect in fault.effects:
            _check_effect(plant, f"faults[{i}]", effect, scenario.steps)
    if isinstance(scenario.sampling, Sampling):
        check_sampling(plant, scenario.sampling, scenario.steps)
    changes = plant.label_changes(scenario)  # there is a label for each set of modes that are active at once
    for name in ("reference", "disturbance", "physical"):
        shape = getattr(plant.shapes, name)
        if shape is not None:
            shapes.check(f"{name} of a {plant.id} scenario", getattr(scenario, name), shape)
    return changes


def _check_state(plant: Plant, x0: Sequence[float]) -> None:
    if len(x0) != len(plant.states):
        names = ", ".join(s.name for s in plant.states)
        raise ValueError(f"x0 has one number per state of {plant.id} ({len(plant.states)}: {names}), not {len(x0)}")
    for value, signal in zip(x0, plant.states, strict=True):
        middle, half = (signal.low + signal.high) / 2, (signal.high - signal.low) / 2
        if math.isfinite(half) and not abs(value - middle) <= X0_RANGES * half:
            low, high = middle - X0_RANGES * half, middle + X0_RANGES * half
            raise ValueError(f"x0: {signal.name} begins within [{low:g}, {high:g}], not at {value:g}")


def check_sampling(plant: Plant, sampling: Sampling, steps: int) -> None:
    """Raise ValueError where there is no such sensor, or one lags by more than the flight."""
    names = [s.name for s in plant.outputs]
    for field in ("periods", "delays"):
        for name, value in getattr(sampling, field).items():
            if name not in names:
                raise ValueError(f"{field}: {unknown('sensor', name, names, f'{plant.id} has')}")
            if field == "delays" and value > steps:
                raise ValueError(f"delays: the sensor {name} lags by at most the flight's {steps} samples, not {value}")


def _check_effect(plant: Plant, where: str, effect: Effect, steps: int) -> None:
    entries = plant.theta_entries
    if effect.entry not in entries:
        raise ValueError(f"{where}: no theta entry {effect.entry!r}; {plant.id} has {', '.join(entries)}")
    entry = plant.theta[entries.index(effect.entry)]
    match effect:
        case Abrupt(value=value) | Incipient(value=value) | Ramp(value=value) | Intermittent(value=value):
            low = high = value
        case Square(value=value, other=other):
            low, high = min(value, other), max(value, other)
        case Samples(values=values):
            low, high = min(values), max(values)
        case Hold(command=name):
            if name not in plant.command_names:
                raise ValueError(f"{where}: no command {name!r}; {plant.id} has {', '.join(plant.command_names)}")
            command = plant.commands[plant.command_names.index(name)]
            low, high = command.low, command.high  # the entry may get any command
        case _:
            raise TypeError(f"{where}: an unknown effect {effect!r}")
    if plant.bare is not None and entries.index(effect.entry) in plant.lags and high > steps:
        raise ValueError(f"{where}: a sensor lags by at most the flight's {steps} samples, not {high:g}")
    if not entry.low <= low <= high <= entry.high:
        raise ValueError(
            f"{where}: theta's {entry.name} lies within [{entry.low:g}, {entry.high:g}], where {type(effect).__name__} "
            f"would bring it to {low:g}" + (f" to {high:g}" if high > low else "")
        )
