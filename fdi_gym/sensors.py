"""The sensor layer: what may go wrong with the sensors of any declared plant; its author writes nothing for it.

    plant = load_plant("B747Lateral", sensor_faults=True, dropout=0.1)

`sensor_faults` gives theta an entry for each sensor and each way of failing, a fault mode and a label to each sensor, and
processes that draw them. The effects of a scenario name those entries like any others:

| entry | healthy | what it does at a sample |
|---|---|---|
| gain_S | 0 | relative error of the sensor's gain |
| bias_S | 0 | added to the reading; a `Ramp` of it is a drift, `Samples` are spikes |
| noise_S | 0 | relative increase of the sensor's noise |
| frozen_S | 0 | 1: the last reading stays |
| lag_S | 0 | samples by which the reading is old |
| missing_S | 0 | 1: it reads NaN, and the controller keeps the last reading |

The reading is the range's ends at most. It feeds back: the controller gets what the sensor says, unless
`feedback="healthy"`. The first false reading of a fault is at its onset, sample k, and acts through the command u_k.

Sizes are counted in the sensor's own unit, five standard deviations of its noise or a twentieth of its scale, whichever is
larger; `sensor_severity` (1) multiplies all sizes that the processes draw. `dropout`, `burst`, `periods`, `delays` and
`hold` are no faults: `fdi_gym.faults.Sampling`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fdi_gym.checks import check_sampling
from fdi_gym.data_sheet import FaultMode, Label, Signal, squared_error
from fdi_gym.drawing import random_sign, uniform
from fdi_gym.faults import Abrupt, Fault, FaultProcess, FaultScenario, Ramp, Samples, Sampling
from fdi_gym.model import SENSOR_FAULTS, Array
from fdi_gym.plant import Plant

KINDS = ("bias", "drift", "gain", "freeze", "noise", "spikes")  # what the processes draw, alike often
LONGEST_LAG = 1000.0  # samples
FROM, TO = 0.15, 0.65  # onsets, as shares of the flight
BIAS = (0.5, 2.0)  # units, either sign; a drift ends there after a tenth to three tenths of the flight
GAIN = (0.1, 0.4)  # either sign
NOISE = (2.0, 8.0)
SPIKES, EVERY = (1.0, 4.0), 0.1  # units, either sign; share of the samples
BANDS = (1.0, 1.5)  # units
LEAST_SEVERITY = 0.01


def unit(sensor: Signal) -> float:
    """In which the faults of a sensor are counted."""
    return max(5.0 * sensor.sigma, 0.05 * sensor.scale)


def sensor_mode(sensor: str) -> str:
    """The fault mode, and the label, of a sensor."""
    return f"{sensor} sensor"


def failing(plant: Plant) -> list[Signal]:
    """The sensors that may fail: not the signs of quaternions, which no device measures."""
    signs = {parts[3] for parts in plant.quaternions}
    return [s for i, s in enumerate(plant.outputs) if i not in signs]


# ---------------------------------------------------------------------------------------------------------------
# The declaration


def _entries(outputs: tuple[Signal, ...]) -> tuple[Signal, ...]:
    """The entries of theta, in the columns' order."""
    found = []
    for column in SENSOR_FAULTS:
        for s in outputs:
            width = s.high - s.low
            low, high, scale = {
                "gain": (-1.0, 10.0, 0.5), "bias": (-width, width, unit(s)), "noise": (0.0, 100.0, 5.0),
                "lag": (0.0, LONGEST_LAG, 10.0),
            }.get(column, (0.0, 1.0, 1.0))  # fmt: skip
            found.append(Signal(f"{column}_{s.name}", s.unit if column == "bias" else "", low, high, scale))
    return tuple(found)


class _Size(NamedTuple):
    """How far a sensor is from healthy, in the sizes that the processes draw, the worst of its columns."""

    where: tuple[int, ...]  # of its columns in theta
    typical: tuple[float, ...]

    def __call__(self, theta: Array) -> Array:
        return np.abs(theta[..., self.where] / self.typical).max(axis=-1)


class _Target(NamedTuple):
    """The plant's estimated quantity, and the biases."""

    plant: Plant
    biases: slice

    def __call__(self, theta: Array, u: Array) -> Array:
        own = self.plant.estimate_target(theta[..., : len(self.plant.theta)], u)
        return np.concatenate([own, theta[..., self.biases]], axis=-1)


class _Reward(NamedTuple):
    """The plant's own reward of an error, and that of the biases."""

    plant: Plant
    biases: Callable[[Array], Array]

    def __call__(self, error: Array) -> Array:
        own = len(self.plant.estimated)
        return self.plant.identification_reward(error[..., :own]) + self.biases(error[..., own:])  # type: ignore[misc]


def _modes(plant: Plant, entries: tuple[Signal, ...], severity: float) -> list[FaultMode]:
    """The plant's, and one for each sensor: the line of its bias."""
    own, n_y, n = len(plant.theta), len(plant.outputs), len(plant.estimated)
    zeros = (0.0,) * n_y
    found = []
    for m in plant.modes:
        rows = tuple((*row, *zeros) for row in m.directions.tolist())
        found.append(m._replace(offset=(*m.offset, *zeros), direction=rows if np.ndim(m.direction) == 2 else rows[0]))
    names = [s.name for s in plant.outputs]
    for s in failing(plant):
        i = names.index(s.name)
        typical = {"gain": GAIN[1] / BIAS[1], "bias": unit(s), "noise": NOISE[1] / BIAS[1], "lag": 10.0}
        where = tuple(own + c * n_y + i for c in range(len(SENSOR_FAULTS)))
        size = _Size(where, tuple(typical.get(column, 1.0) for column in SENSOR_FAULTS))
        line = np.zeros(n + n_y)
        line[n + i] = 1.0
        reach = (entries[n_y + i].low, entries[n_y + i].high)
        what = f"{', '.join(SENSOR_FAULTS)} of the sensor {s.name}, in units of {unit(s):.3g} {s.unit}".rstrip()
        bands = (severity * BANDS[0], severity * BANDS[1])
        found.append(FaultMode(sensor_mode(s.name), what, size, bands, (0.0,) * (n + n_y), tuple(line), reach))
    return found


def with_sensor_faults(plant: Plant, severity: float = 1.0) -> Plant:
    """The plant whose sensors may fail.

    Args:
        plant: The plant.
        severity: Factor on the sizes that the processes draw.

    Raises:
        ValueError: The severity is none; they may already; an entry, a mode or a label has a name that they need.
    """
    if plant.bare is not None:
        raise ValueError(f"the sensors of {plant.id} may fail already")
    if not LEAST_SEVERITY <= severity <= 1.0:
        raise ValueError(f"sensor_severity is from {LEAST_SEVERITY} to 1, not {severity:g}")
    entries, n_y, own = _entries(plant.outputs), len(plant.outputs), len(plant.theta)
    biases = entries[n_y : 2 * n_y]
    labels = [Label(sensor_mode(s.name), frozenset({sensor_mode(s.name)})) for s in failing(plant)]
    count = len(plant.labels)
    reward = np.eye(count + len(labels))
    reward[:count, :count] = plant.isolation_reward
    return dataclasses.replace(
        plant, bare=plant, theta=(*plant.theta, *entries), estimated=(*plant.estimated, *biases),
        target=_Target(plant, slice(own + n_y, own + 2 * n_y)), modes=tuple(_modes(plant, entries, severity)),
        labels=(*plant.labels, *labels), isolation_reward=reward,
        identification_reward=_Reward(plant, squared_error([s.scale for s in biases])),
        processes={**plant.processes, **{p.name: p for p in sensor_processes(plant, severity)}},
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------
# What is drawn


def sensor_fault(
    rng: np.random.Generator, sensor: Signal, kind: str, onset: int, end: int, dt: float, severity: float = 1.0
) -> Fault:
    """One fault of a sensor, its size drawn.

    Args:
        rng: Draws it.
        sensor: The sensor.
        kind: One of `KINDS`.
        onset: Its first step.
        end: The step after its last one, or that of the flight.
        dt: Sample time [s].
        severity: Factor on the size; a frozen reading has none.

    Raises:
        ValueError: Unknown kind.
    """
    size, name = severity * unit(sensor), sensor.name
    match kind:
        case "bias":
            effect = Abrupt(f"bias_{name}", random_sign(rng) * size * uniform(rng, *BIAS))
        case "drift":
            value = random_sign(rng) * size * uniform(rng, *BIAS)
            effect = Ramp(f"bias_{name}", value, max(dt, uniform(rng, 0.1, 0.3) * end * dt))
        case "gain":
            effect = Abrupt(f"gain_{name}", severity * random_sign(rng) * uniform(rng, *GAIN))
        case "freeze":
            effect = Abrupt(f"frozen_{name}", 1.0)
        case "noise":
            effect = Abrupt(f"noise_{name}", severity * uniform(rng, *NOISE))
        case "spikes":
            count = max(end - onset, 1)
            values = rng.choice([-1.0, 1.0], count) * size * rng.uniform(*SPIKES, count)
            effect = Samples(f"bias_{name}", np.where(rng.random(count) < EVERY, values, 0.0).tolist())
        case _:
            raise ValueError(f"unknown kind of a sensor's fault {kind!r}; there are {', '.join(KINDS)}")
    return Fault(sensor_mode(name), kind, onset, [effect])


class _Faults(NamedTuple):
    """Draws a standard flight; of the faulty ones a share has a sensor's fault in place of its own."""

    plant: Plant
    share: float
    severity: float
    kinds: tuple[str, ...] = KINDS

    def __call__(self, rng: np.random.Generator) -> FaultScenario:
        scenario, plant = self.plant.processes["standard"].sample(rng), self.plant
        if not scenario.faults or (self.share < 1.0 and rng.random() >= self.share):
            return scenario
        sensors = failing(plant)
        sensor = sensors[int(rng.integers(len(sensors)))]
        kinds = [kind for kind in self.kinds if kind != "noise" or sensor.sigma > 0]
        kind = kinds[int(rng.integers(len(kinds)))]
        steps = scenario.steps
        onset = max(1, int(rng.integers(int(FROM * steps), int(TO * steps) + 1)))
        return scenario.replace(faults=[sensor_fault(rng, sensor, kind, onset, steps, plant.dt, self.severity)])


def sensor_processes(plant: Plant, severity: float = 1.0) -> list[FaultProcess]:
    """What a plant whose sensors may fail draws beside its own processes: "mixed" and "sensors"."""
    standard = plant.processes["standard"]
    return [
        dataclasses.replace(standard, name=name, description=what, sample=_Faults(plant, share, severity))
        for name, share, what in (
            ("mixed", 0.5, "the standard flights, half of the faulty ones with a sensor's fault in place of the plant's"),
            ("sensors", 1.0, "the standard flights, the faulty ones with a sensor's fault in place of the plant's"),
        )
    ]


def of_kind(plant: Plant, kind: str) -> FaultProcess:
    """The process "sensors" with one kind of fault: for tables by kind."""
    bare, severity = plant if plant.bare is None else plant.bare, float(plant.options.get("sensor_severity", 1.0))
    process = sensor_processes(bare)[1]
    return dataclasses.replace(process, name=f"sensors-{kind}", sample=_Faults(bare, 1.0, severity, (kind,)))


# ---------------------------------------------------------------------------------------------------------------
# How sensors report


class _Sampled(NamedTuple):
    """Draws what another draws, with sensors that report so."""

    sample: Callable[[np.random.Generator], FaultScenario]
    sampling: Sampling

    def __call__(self, rng: np.random.Generator) -> FaultScenario:
        return self.sample(rng).replace(sampling=self.sampling)


def with_sampling(plant: Plant, sampling: Sampling) -> Plant:
    """The plant all of whose processes draw flights with sensors that report so.

    Raises:
        ValueError: It has no such sensor, or one lags by more than a standard flight.
    """
    check_sampling(plant, sampling, plant.processes["standard"].sample(np.random.default_rng(0)).steps)
    processes = {
        name: dataclasses.replace(process, sample=_Sampled(process.sample, sampling))
        for name, process in plant.processes.items()
    }
    return dataclasses.replace(plant, processes=processes)
