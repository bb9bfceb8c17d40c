"""Known-onset oracle of the Boeing 747: is told when each fault begins and ends, not what it is.

The Bayes classifier inside known fault windows; label 0 outside. See `baselines.filters.bayes_bank`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from baselines.filters import kalman_filter
from baselines.filters.bayes_bank import LOG_WEIGHT, Sizes, check, label_probabilities, marginals, most_probable
from baselines.filters.kalman_filter import Healthy, sense
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, NotApplicableError, Plant


class Windowed(NamedTuple):
    """State: each episode carries its own windows, so that it can be told apart in any batch."""

    active: Array  # (n, K + 1) bool
    begins: Array  # (n, K + 1) bool
    healthy: Healthy
    M: Array  # (n, 4, 4)
    G: Array  # (n, 4, 4)
    g: Array  # (n, 4)
    u_onset: Array  # (n, 2)
    on: Array  # (n,) a fault acted over the last interval


@diagnoser(
    "known_onset_oracle",
    "Bayes classifier within the known windows of faults",
    knows="when each fault begins and ends",
    ceiling=True,
)
def known_onset_oracle(
    plant: Plant,
    *,
    scenarios: Sequence[FaultScenario],
    gamma: tuple[float, float] = (-0.9, -0.3),
    b_max: tuple[float, float] = (4.0, 2.0),
) -> Diagnoser:
    """The oracle.

    Args:
        plant: The Boeing 747 with single-fault labels.
        scenarios: The truth, one per episode of the batch; when faults begin and end is all that is read of them.
        gamma: Range of the loss of effectiveness.
        b_max: Largest random stuck position of aileron and rudder [deg].

    Raises:
        NotApplicableError: Another plant, or gusts, which its model does not have.
        ValueError (from init): The number of episodes is not that of the scenarios.
    """
    check(plant)
    if any(scenario.disturbance for scenario in scenarios):
        raise NotApplicableError("its model has no gusts; told_events_oracle has")
    f, sizes = kalman_filter.nominal_filter(plant), Sizes((gamma[0], gamma[1]), (b_max[0], b_max[1]))
    steps = max((s.steps for s in scenarios), default=1)
    active, begins = (np.zeros((len(scenarios), steps + 1), bool) for _ in range(2))
    for i, scenario in enumerate(scenarios):
        for fault in scenario.faults:
            active[i, fault.onset : fault.end] = True
            begins[i, fault.onset : fault.onset + 1] = True  # nothing where it lies beyond the flight

    def start(n: int) -> Windowed:
        if n != len(scenarios):
            raise ValueError(f"there are scenarios for {len(scenarios)} episodes, not for {n}")
        square = np.zeros((n, 4, 4))
        return Windowed(
            active, begins, kalman_filter.start(f, plant, n), square, square, np.zeros((n, 4)), np.zeros((n, 2)),
            np.zeros(n, bool),
        )  # fmt: skip

    def predict(s: Windowed, at: Interval) -> Windowed:
        rows, step = np.arange(len(at.k)), np.minimum(at.k - 1, steps)
        on, begin = s.active[rows, step], s.begins[rows, step]
        fresh = begin | ~on
        M, G, g = (np.where(fresh.reshape(-1, *[1] * (a.ndim - 1)), 0.0, a) for a in (s.M, s.G, s.g))
        u_onset = np.where(begin[:, None], at.u, s.u_onset)
        return s._replace(healthy=kalman_filter.predict(f, s.healthy, at), M=M, G=G, g=g, u_onset=u_onset, on=on)

    def update(s: Windowed, at: Interval, y: Array, seen: Array) -> Windowed:
        healthy = kalman_filter.correct(f, s.healthy, y, seen)
        E = f.model.E(at.u) * s.on[:, None, None]
        M, G, g = (a[:, 0] for a in sense(f, healthy, s.M[:, None], s.G[:, None], s.g[:, None], E[:, None]))
        return s._replace(healthy=healthy, M=M, G=G, g=g)

    def read(s: Windowed) -> Reading:
        ratio, size = marginals(s.G, s.g, s.u_onset, sizes)
        log = ratio + LOG_WEIGHT
        w = np.exp(log - logsumexp(log, axis=1, keepdims=True))
        faulty = np.column_stack([np.zeros(len(w)), label_probabilities(w)])
        probs = np.where(s.on[:, None], faulty / faulty.sum(axis=1, keepdims=True), [1.0, 0, 0, 0, 0])
        z = (w[..., None] * size).sum(axis=1) * s.on[:, None]
        return Reading(z, x=s.healthy.x, Px=s.healthy.P, nu=s.healthy.nu, probs=probs)

    return diagnoser_of(plant, Filter(start, predict, update, read, first_sample=False), most_probable())
