"""Agents that act: a diagnoser and what is done of its diagnosis, flown on the engine's step and scored as any diagnoser is.

A prober chooses what is added: a pair of functions like a diagnoser, asked once per decision period.

    init(n) -> state
    choose(state, obs, said) -> (state, probe)    # the newest sample (n, n_obs), the diagnosis of it, (n,) numbers of probes
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from fdi_gym.acts import Acts, accommodated, costs
from fdi_gym.diagnosis.contract import Decisions, Diagnoser, Diagnosis, Recording
from fdi_gym.engine import Record, hold_last, recorded
from fdi_gym.faults import FaultScenario
from fdi_gym.flights import Chunk, Flights
from fdi_gym.plant import Array, Plant

ALLOWING = ("nothing", "diagnosis", "truth")


class Prober(NamedTuple):
    """A pair of functions; see the module's docstring."""

    init: Callable[[int], Any]
    choose: Callable[[Any, Array, Diagnosis], tuple[Any, Array]]


class Flown(NamedTuple):
    """N flights that an agent has acted on, sample by sample."""

    record: Record
    decisions: Decisions
    probe: Array  # (N, K + 1) int8: which one was chosen for the command that was held up to the sample
    cost: Array  # (N, K + 1) flight cost; `lost` per sample after the envelope was left
    unusable: Array  # (N,) diagnoses whose estimate was not finite, where they were to be allowed for


NEVER = Prober(lambda n: n, lambda n, obs, said: (n, np.zeros(n, np.int64)))


def fly(
    plant: Plant,
    scenarios: Sequence[FaultScenario],
    diagnoser: Diagnoser,
    prober: Prober = NEVER,
    allow_for: Literal["nothing", "diagnosis", "truth"] = "nothing",
    period: int = 10,
) -> Flown:
    """Fly scenarios with an agent on board.

    Args:
        plant: The plant.
        scenarios: The flights.
        diagnoser: What it says after each sample is recorded; any diagnoser, unchanged.
        prober: Chooses the probe after every `period` samples.
        allow_for: What the controller is reconfigured for after every `period` samples: nothing, the diagnosis, or the true
            label and estimate, which no diagnosis can better on average.
        period: Decision period.

    Raises:
        ValueError: Something that the plant does not declare, or a prober that chooses what there is not.
    """
    if allow_for not in ALLOWING:
        raise ValueError(f"unknown allow_for {allow_for!r}; there are {', '.join(ALLOWING)}")
    n, flights = len(scenarios), Flights(plant, scenarios)
    acts = Acts(flights, prober is not NEVER, allow_for != "nothing")
    longest = int(flights.length.max())
    whole, probe, cost = flights.blank(longest + 1), np.zeros((longest + 1, n), np.int8), np.zeros((longest + 1, n))
    recording = Recording(n, longest + 1)
    seen, chooses, unusable = diagnoser.init(n), prober.init(n), np.zeros(n, np.int64)
    first = 0
    while first <= longest:
        samples = min(period, longest + 1 - first) if first else 1
        over, before = flights.over.copy(), flights.k.copy()
        acts.advance(samples, whole, first)
        rows = slice(first, first + samples)
        hold_last(flights, Chunk(*(a[: first + samples] for a in whole)), first)
        cost[rows] = np.where(over, 0.0, costs(flights, Chunk(*(a[rows] for a in whole)), before))
        probe[rows] = acts.probe
        for k in range(first, first + samples):
            seen, said = diagnoser.update(seen, whole.obs[k])
            recording.keep(k, said)
        first += samples
        chooses, chosen = prober.choose(chooses, whole.obs[first - 1], said)
        chosen = _checked(plant, chosen, n)
        if allow_for != "nothing":
            if allow_for == "truth":
                label, theta = whole.label[first - 1], whole.theta[first - 1]
                estimate: Array | None = plant.estimate_target(theta, plant.split(whole.obs[first - 1])[1])
            else:
                label, estimate = said.label, said.estimate
                if estimate is not None:
                    unusable += ~np.isfinite(estimate).all(axis=1) & ~flights.over
            acts.accommodate(accommodated(plant, label, estimate))
        acts.choose(np.where(flights.over, 0, chosen))
    planned = np.array([s.steps for s in scenarios])
    after = np.arange(longest + 1)[:, None]
    cost[(after > flights.length) & (after <= planned)] = acts.acting.lost
    return Flown(recorded(flights, whole), recording.decisions(), probe.T, cost.T, unusable)


def _checked(plant: Plant, chosen: Any, n: int) -> Array:
    """The probes (n,) that a prober has chosen.

    Raises:
        ValueError: They are not n numbers of probes.
    """
    names = [probe.name for probe in plant.acting.probes] if plant.acting else []
    value = np.asarray(chosen)
    if value.shape != (n,) or value.dtype.kind not in "iu" or not ((value >= 0) & (value < len(names))).all():
        said = ", ".join(f"{i} {name}" for i, name in enumerate(names))
        raise ValueError(f"a prober chooses whole numbers of the shape ({n},), of the probes {said}, not {chosen!r}")
    return value.astype(np.int64)
