"""A decision rule for estimates with an entry for each fault: each is smoothed and compared with a threshold of its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.automaton import Automaton
from fdi_gym.estimation.belief import FaultInputs, noisy_sensors
from fdi_gym.estimation.calibration import Persistence
from fdi_gym.estimation.decision import Evidence, Reading, Rule, Verdict, declare, undeclared
from fdi_gym.estimation.labels import flags_of, label_of_channels
from fdi_gym.plant import Array, Plant

CHANNELS = Persistence(3, 1, 20)
RECOVERED = 1.1  # estimates have got over a gap when their deviations are at most by this factor what they were before it
FORGOTTEN = 10  # or after whole samples for so many time constants of the smoothing: then what they were is history


class Smoothed(NamedTuple):
    """State of `by_channels`: n episodes, p channels."""

    value: Array  # (n, p) smoothed estimates
    std: Array  # (n, p) their standard deviation, smoothed alike: errors of neighbouring samples are nearly the same
    usual: Array  # (n, p) what that was before the gap; 0 before there are estimates
    whole: Array  # (n, 1) whole samples since the last gap; without bound where the estimates have got over it
    declared: Automaton


def by_channels(plant: Plant, inputs: FaultInputs, alpha: float, thresholds: Array, after: Persistence = CHANNELS) -> Rule:
    """Each entry of the fault vector, smoothed: s+ = (1 - alpha) s + alpha z; on above its threshold, off below half of it.

    The label is the set of entries that are on. After a gap the estimates are less certain for a while, by their own
    covariance; the threshold that turns a channel on is higher by the same factor until they are what they were.

    Args:
        plant: The plant.
        inputs: The fault channels; the reading's z is of the whole estimated space.
        alpha: Smoothing factor.
        thresholds: One per channel (p,), in the unit of the estimate.
        after: Samples in a row that switch a channel on and off.

    Raises:
        ValueError: Not one threshold per channel.
    """
    J = np.asarray(thresholds, float)
    if J.shape != (len(inputs.names),):
        raise ValueError(f"one threshold per channel ({', '.join(inputs.names)}) is needed, not {np.asarray(J).tolist()}")
    labels, sets = flags_of(plant, inputs)
    every = len(noisy_sensors(plant))

    def start(n: int) -> Smoothed:
        nothing = np.zeros((n, len(J)))
        return Smoothed(nothing, nothing, nothing, np.full((n, 1), np.inf), undeclared((n, len(J))))

    def step(s: Smoothed, k: Array, r: Reading, informed: Array) -> tuple[Smoothed, Verdict]:
        assert r.z is not None
        assert r.P is not None
        informed = (informed & (k > after.warmup))[:, None]
        kept = 1 - alpha if r.span is None else ((1 - alpha) ** r.span)[:, None]
        std = np.sqrt(np.maximum(np.einsum("npp->np", r.P)[:, inputs.estimated], 0.0))
        value = np.where(informed, kept * s.value + (1 - kept) * r.z[:, inputs.estimated], s.value)
        spread = np.where(informed, np.where(s.std > 0, kept * s.std + (1 - kept) * std, std), s.std)
        missing = ~informed if r.seen is None else ~informed | (r.seen < every)[:, None]
        whole = np.where(missing, 0.0, s.whole + 1.0)
        over = ~missing & (spread <= RECOVERED * s.usual).all(axis=1, keepdims=True) | (whole * alpha > FORGOTTEN)
        whole = np.where(over | (s.usual == 0).all(axis=1, keepdims=True), np.inf, whole)
        usual = np.where(np.isinf(whole), spread, s.usual)
        factor = np.maximum(spread / np.where(usual > 0, usual, 1.0), 1.0)
        size = np.abs(value)
        on = np.ones(size.shape, np.int64)
        declared = declare(s.declared, on, size > factor * J, size < 0.5 * J, after, np.broadcast_to(informed, size.shape))
        flagged = declared.label > 0
        label = label_of_channels(labels, sets, flagged, size / J)
        signals = {"smoothed": value, "channels_on": flagged}
        verdict = Verdict(np.any(flagged, axis=1), label, evidence=Evidence(channels=size), signals=signals)
        return Smoothed(value, spread, usual, whole, declared), verdict

    return Rule(start, step)
