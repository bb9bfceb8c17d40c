"""What a diagnoser is, and how one is shown a flight.

A diagnoser is a pair of functions, batched over n episodes:

    init(n) -> state
    update(state, obs) -> (state, Diagnosis)      # obs (n, n_obs): the samples k = 0, 1, ... in turn

The state is any nest of tuples, NamedTuples, lists and dicts. Its arrays have the episodes along their first axis; a
plain number in it (a sample counter) is shared by all episodes. NaN in an observation says that this sensor did not report
at this sample. `fdi_gym.diagnosis.filtering` makes a diagnoser of a filter and a decision rule.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.plant import Array, Plant


class Diagnosis(NamedTuple):
    """What a diagnoser says after a sample about the interval that has just ended, for n episodes.

    A method that does not isolate gives label 0 or any guess with its alarm; what a method does not give is None.
    """

    alarm: Array  # (n,) bool: there is a fault
    label: Array  # (n,) int: label index
    estimate: Array | None = None  # (n, n_estimated) estimate of what the identification task asks for
    estimate_std: Array | None = None  # (n, n_estimated) its standard deviation
    label_probs: Array | None = None  # (n, labels) probabilities, where the method has them
    state: Array | None = None  # (n, n_x) estimate of the plant's state
    signals: dict[str, Array] | None = None  # (n, ...) each: residuals, thresholds, an approximated fault function


class Diagnoser(NamedTuple):
    """A pair of functions; see the module's docstring.

    `gaps` says that the method handles samples in which sensors are missing. The others are held: they are not shown
    such a sample, and what they said stands.
    """

    init: Callable[[int], Any]
    update: Callable[[Any, Array], tuple[Any, Diagnosis]]
    gaps: bool = False
    filter: Any = None  # the `filtering.Filter` that it is made of, where it is
    rule: Any = None  # and the `estimation.decision.Rule`
    guarded: bool = False  # whether it is under the guard already
    # as update, over samples (n, K, n_obs) at once, which come second in what it says; None where it needs them one by one
    sweep: Callable[[Any, Array], tuple[Any, Diagnosis] | None] | None = None


def widened(diagnoser: Diagnoser, plant: Plant, shown: Plant) -> Diagnoser:
    """A diagnoser of a plant, on one with more labels and more to estimate behind its own: of those it knows nothing."""
    more, labels = len(shown.estimated) - len(plant.estimated), len(shown.labels) - len(plant.labels)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        state, said = diagnoser.update(state, obs)
        estimate, probs = said.estimate, said.label_probs
        if estimate is not None:
            estimate = np.concatenate([estimate, np.tile(shown.healthy[-more:], (len(estimate), 1))], axis=1)
        if probs is not None:
            probs = np.pad(probs, ((0, 0), (0, labels)))
        return state, said._replace(estimate=estimate, estimate_std=None, label_probs=probs)

    return Diagnoser(diagnoser.init, update, diagnoser.gaps)


class Decisions(NamedTuple):
    """What a diagnoser said over recorded flights: the fields of `Diagnosis` with samples along the second axis."""

    alarm: Array  # (N, K + 1) bool
    label: Array  # (N, K + 1) int16
    estimate: Array | None  # (N, K + 1, n_estimated)
    estimate_std: Array | None
    label_probs: Array | None  # (N, K + 1, labels)
    state: Array | None = None  # (N, K + 1, n_x)
    signals: dict[str, Array] | None = None  # (N, K + 1, ...) each, where they were asked for


class Recording:
    """What a diagnoser says of n flights, put down sample by sample.

    Args:
        n: Flights.
        samples: How many there will be.
        signals: Keep the method's own signals too.
    """

    def __init__(self, n: int, samples: int, signals: bool = False):
        self._shape, self._signals = (n, samples), signals
        self._alarm, self._label = np.zeros((n, samples), bool), np.zeros((n, samples), np.int16)
        self._wide: dict[str, Array | None] = dict.fromkeys(("estimate", "estimate_std", "label_probs", "state"))
        self._own: dict[str, Array] = {}

    def keep(self, k: int | slice, said: Diagnosis) -> None:
        """Put down what was said of sample k, or of several."""
        self._alarm[:, k], self._label[:, k] = said.alarm, said.label
        for name in self._wide:
            value = getattr(said, name)
            if value is not None:
                store = self._wide[name]
                if store is None:
                    store = self._wide[name] = np.full((*self._shape, value.shape[-1]), np.nan)
                store[:, k] = value
        for name, value in (said.signals or {}).items() if self._signals else ():
            if name not in self._own:
                self._own[name] = np.full((*self._shape, *value.shape[1:]), np.nan)
            self._own[name][:, k] = value

    def decisions(self) -> Decisions:
        """All of it."""
        return Decisions(self._alarm, self._label, **self._wide, signals=self._own or None)


def run(diagnoser: Diagnoser, obs: Array, signals: bool = False) -> Decisions:
    """Show recorded observations (N, K + 1, n_obs) to a diagnoser, sample by sample, and record what it says.

    Args:
        diagnoser: The diagnoser.
        obs: The observations.
        signals: Record the method's own signals too.
    """
    n, samples, _ = obs.shape
    state, recording = diagnoser.init(n), Recording(n, samples, signals)
    for k in range(samples):
        swept = diagnoser.sweep(state, obs[:, 1:]) if k == 1 and diagnoser.sweep is not None and not signals else None
        if swept is not None:  # all but the first at once
            recording.keep(slice(1, samples), swept[1])
            break
        state, said = diagnoser.update(state, obs[:, k])
        recording.keep(k, said)
    return recording.decisions()


# ---------------------------------------------------------------------------------------------------------------
# States, as nests of arrays


def map_arrays(function: Callable[..., Any], *nests: Any) -> Any:
    """Apply to the arrays of equal nests; other leaves are those of the first, and None gives way to what is there."""
    if any(nest is None for nest in nests):
        return next((nest for nest in nests if nest is not None), None)
    first = nests[0]
    if isinstance(first, np.ndarray):
        return function(*nests)
    if isinstance(first, dict):
        return {key: map_arrays(function, *(nest[key] for nest in nests)) for key in first}
    if isinstance(first, (tuple, list)):
        parts = [map_arrays(function, *branches) for branches in zip(*nests, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else type(first)(parts)
    return first


def choose(mask: Array, yes: Any, no: Any) -> Any:
    """The nest whose episodes are those of `yes` where the mask is set, else those of `no`."""
    return map_arrays(lambda a, b: np.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), yes, no)


def among(mask: Array, change: Callable[[], Any], nest: Any) -> Any:
    """The nest with its episodes changed where the mask is set; what changes none of them is not called."""
    if mask.all():
        return change()
    return choose(mask, change(), nest) if mask.any() else nest
