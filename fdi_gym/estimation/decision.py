"""From what a filter reads after a sample to an alarm and a label: one automaton, and the evidence that feeds it.

A rule is a pair of functions, `start(n)` and `step(state, k, reading, informed) -> (state, Verdict)`. The rules here:

- `by_labels`: how badly each label fits, as a distance of the estimate or in the method's own words, against the
  thresholds of a calibration. The alarm may be raised by a statistic of the innovations instead:
  "chi-square": weighted mean of the normalised innovation squared (R. K. Mehra, J. Peschon, Automatica 7, 1971);
  "cusum": Page's cumulative sum of it (E. S. Page, Biometrika 41, 1954);
  "glr": generalised likelihood ratio of a jump in the mean of the whitened innovations at an unknown time within a
  window (M. Basseville, I. V. Nikiforov, Detection of Abrupt Changes, 1993).
  A filter that follows the fault soon explains its innovations again; they raise the alarm, the distance keeps it.
- `by_candidate`: a label for every sample, which must persist.

`fdi_gym.estimation.channels` has one for filters whose estimate has an entry for each fault.

A sample at which no sensor reported says nothing, and no counter moves. After a gap `by_labels` waits until the estimate is
about as sure as before it: what a held command did to it while nothing was measured is no evidence of a fault. It waits in
proportion to the gap, since a fault may have ended what makes the estimate sure.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.estimation import label_kernels
from fdi_gym.estimation.automaton import Automaton, first, step
from fdi_gym.estimation.calibration import LEAST, Calibration, Persistence
from fdi_gym.estimation.kalman import quadratic
from fdi_gym.estimation.labels import Manifolds, manifolds
from fdi_gym.kernels import address
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant


class Reading(NamedTuple):
    """What a filter says after a sample. What it does not have is None."""

    z: Array | None = None  # (n, p) the estimate's deviation from healthy
    P: Array | None = None  # (n, p, p) its covariance
    x: Array | None = None  # (n, n_x) the plant's state
    Px: Array | None = None  # (n, n_x, n_x) its covariance
    nu: Array | None = None  # (n, m) innovation, 0 where a sensor did not report
    S: Array | None = None  # (n, m, m) its covariance, as of `kalman.masked`
    seen: Array | None = None  # (n,) sensors that reported and were used
    cost: Array | None = None  # (n, labels) how badly each label fits, in the method's own words: -2 log of a likelihood
    probs: Array | None = None  # (n, labels)
    signals: dict[str, Array] | None = None  # (n, ...) each
    span: Array | None = None  # (n,) samples over which z is the mean, where that is not 1
    gain: Array | None = None  # (n, labels) by how much labels fit better than healthy for reasons that are no line


class Evidence(NamedTuple):
    """What a rule weighed: what thresholds are found from."""

    cost: Array | None = None  # (n, labels)
    rise: Array | None = None  # (n,) the statistic that raises the alarm in place of the costs
    channels: Array | None = None  # (n, p) smoothed magnitudes


class Verdict(NamedTuple):
    """What a rule says after a sample."""

    alarm: Array  # (n,) bool
    label: Array  # (n,) int
    z: Array | None = None  # (n, p) the deviation that is reported in place of the reading's
    evidence: Evidence = Evidence()
    P: Array | None = None  # (n, p, p) the covariance that is reported in place of the reading's
    signals: dict[str, Array] | None = None  # (n, ...) each, beside the reading's


class Labelling(NamedTuple):
    """What `by_labels` weighs with."""

    excess: Array  # (p, p) what the estimate's covariance lacks
    metric: Array | None  # (1, p, p) that takes its place
    sets: Manifolds
    penalty: Array  # (labels,) what each must gain
    limit: float  # of the statistic that raises the alarm in place of the costs
    lengths: Array  # (5,) rise, switch, release, same, warmup


class Rule(NamedTuple):
    """A pair of functions; see the module's docstring."""

    start: Callable[[int], Any]
    step: Callable[[Any, Array, Reading, Array], tuple[Any, Verdict]]  # (state, k (n,), reading, informed (n,) bool)
    labelling: Labelling | None = None  # of `by_labels`, where it weighs nothing else


# ---------------------------------------------------------------------------------------------------------------
# The automaton


def undeclared(shape: int | tuple[int, ...]) -> Automaton:
    """Nothing is declared."""
    return first(*np.atleast_1d(shape))


def declare(s: Automaton, best: Array, over: Array, under: Array, after: Persistence, informed: Array) -> Automaton:
    """The declared value after a sample.

    Args:
        s: Before it.
        best: The value that fits best.
        over: The evidence is enough to raise an alarm.
        under: It is little enough to give one up.
        after: How many samples in a row that takes. A release wins over a switch.
        informed: Where the sample says anything; elsewhere nothing changes.
    """
    return step(
        s, best, over, under, rise=after.rise, switch=after.switch, release=after.release, same=after.same, informed=informed
    )


# ---------------------------------------------------------------------------------------------------------------
# Statistics of the innovations


class Statistic(NamedTuple):
    """start(n, m) and step(state, reading, informed) -> (state, statistic (n,))."""

    start: Callable[[int, int], Any]
    step: Callable[[Any, Reading, Array], tuple[Any, Array]]


def _excess(r: Reading) -> Array:
    """nu' S^-1 nu less its expectation, the number of sensors that reported (n,)."""
    assert r.nu is not None
    assert r.S is not None
    assert r.seen is not None
    return quadratic(r.nu, r.S) - r.seen


def chi_square(memory: int = 20) -> Statistic:
    """Exponentially weighted mean of nu' S^-1 nu, less its expectation."""

    def step(mean: Array, r: Reading, informed: Array) -> tuple[Array, Array]:
        mean = np.where(informed, mean + (_excess(r) - mean) / memory, mean)
        return mean, mean

    return Statistic(lambda n, m: np.zeros(n), step)


def cusum(allowance: float = 0.5) -> Statistic:
    """g+ = max(0, g + nu' S^-1 nu - (1 + allowance) m): grows where the innovations are too large by the allowance."""

    def step(g: Array, r: Reading, informed: Array) -> tuple[Array, Array]:
        g = np.where(informed, np.maximum(0.0, g + _excess(r) - allowance * np.asarray(r.seen)), g)
        return g, g

    return Statistic(lambda n, m: np.zeros(n), step)


def glr(windows: tuple[int, ...] = (2, 5, 10, 20, 40)) -> Statistic:
    """max over windows w of |sum of the last w whitened innovations|^2 / w."""
    longest = max(windows)

    def start(n: int, m: int) -> Any:
        return np.zeros(n, np.int64), np.zeros((n, longest + 1, m))

    def step(state: Any, r: Reading, informed: Array) -> tuple[Any, Array]:
        count, sums = state
        assert r.nu is not None
        assert r.S is not None
        white = np.linalg.solve(np.linalg.cholesky(r.S), r.nu[..., None])[..., 0]
        moved = np.concatenate([sums[:, 1:], sums[:, -1:] + white[:, None]], axis=1)
        sums = np.where(informed[:, None, None], moved, sums)
        count = count + informed
        ratios = [
            np.where(count >= w, ((sums[:, -1] - sums[:, -1 - w]) ** 2).sum(axis=1) / w, 0.0) for w in windows
        ]  # fmt: skip
        return (count, sums), np.max(ratios, axis=0)

    return Statistic(start, step)


STATISTICS: dict[str, Callable[[], Statistic]] = {"chi-square": chi_square, "cusum": cusum, "glr": glr}
DECISIONS = ("distance", "thresholds", *STATISTICS)
QUARTER = 0.25  # of a typical fault: what LEAST is in the fixed metric of "thresholds"


# ---------------------------------------------------------------------------------------------------------------
# Rules


def by_labels(
    plant: Plant, calibration: Calibration, decision: str = "distance", *, size: Array | None = None, on_line: bool = False
) -> Rule:
    """Labels by how badly they fit, beyond the thresholds of their modes.

    Args:
        plant: The plant; the entries of the estimate are those of `plant.estimated`.
        calibration: The thresholds, the excess covariance and the persistence.
        decision: "distance": in the metric of the estimate's covariance. "thresholds": in a fixed metric, which makes
            them thresholds on the estimate, never below a quarter of a typical fault. "chi-square", "cusum", "glr":
            the distance, but the alarm is raised by that statistic of the innovations.
        size: Typical fault sizes (p,), the metric of "thresholds".
        on_line: Report the point of the declared label's own set that is closest to the estimate, and healthy where none is
            declared.

    Raises:
        ValueError: Unknown decision, "thresholds" without sizes, or a calibration of another plant.
    """
    if decision not in DECISIONS:
        raise ValueError(f"unknown decision {decision!r}; there are {', '.join(DECISIONS)}")
    if decision == "thresholds" and size is None:
        raise ValueError("the decision 'thresholds' needs the typical fault sizes")
    sets, penalty, after = manifolds(plant), calibration.penalties(plant), calibration.persistence
    statistic = STATISTICS[decision]() if decision in STATISTICS else None
    fixed = np.diag((QUARTER * size) ** 2 / LEAST)[None] if decision == "thresholds" and size is not None else None
    m, p = len(plant.outputs), len(plant.estimated)
    excess = np.zeros((p, p)) if calibration.excess is None or fixed is not None else contiguous(calibration.excess)
    limit = np.inf if calibration.rise is None else calibration.rise
    lengths = np.array([after.rise, after.switch, after.release, after.same, after.warmup], np.int64)
    none, labels, (h, _, f) = np.zeros(0), len(plant.labels), sets.direction.shape

    def start(n: int) -> Any:  # the automata, the statistic, and what is waited for
        return np.zeros((n, 5), np.int64), None, np.tile([0.0, label_kernels.PATIENCE, *[np.inf] * p], (n, 1))

    def costs(r: Reading) -> tuple[Array, Array]:
        assert r.z is not None
        assert r.P is not None or fixed is not None
        cost, at = np.empty((len(r.z), labels)), np.empty((len(r.z), h, f))
        P = contiguous(r.P) if fixed is None else fixed
        label_kernels.distances(address(label_kernels.fit_lanes), contiguous(r.z), P, excess, *sets, cost, at)
        return cost, at

    def step(state: Any, k: Array, r: Reading, informed: Array) -> tuple[Any, Verdict]:
        declared, tested, waiting = state
        n, rise, P = len(k), None, None
        if r.P is not None:
            P, before, waiting, counts = contiguous(r.P), waiting, np.empty((n, 2 + p)), np.empty(n, bool)
            label_kernels.wait(P, informed, before, waiting, counts)
            informed = counts
        if statistic is not None:
            tested = statistic.start(n, r.nu.shape[1] if r.nu is not None else m) if tested is None else tested
            tested, rise = statistic.step(tested, r, informed & (k > after.warmup))
        following, label, alarm = np.empty((n, 5), np.int64), np.empty(n, np.int64), np.empty(n, bool)
        told = (
            penalty, none if rise is None else rise, limit, lengths, k, informed, declared, following, label, alarm,
        )  # fmt: skip
        z = None
        cost, at = (contiguous(r.cost), None) if r.cost is not None else costs(r)
        if r.gain is not None:
            cost = np.where(r.gain > 0, np.minimum(cost, cost[:, :1] - r.gain), cost)
        label_kernels.declare(cost, *told)
        if on_line and at is not None:
            z = (sets.points(at) * (sets.labels == label[:, None])[..., None]).sum(axis=1)
        return (following, tested, waiting), Verdict(alarm, label, z, Evidence(cost, rise))

    plain = statistic is None and not on_line
    return Rule(start, step, Labelling(excess, fixed, sets, penalty, limit, lengths) if plain else None)


def by_candidate(candidate: Callable[[Reading, Array], Array], after: int, warmup: int = 0) -> Rule:
    """The label becomes the candidate at the `after`-th sample in a row on which that is the same.

    Args:
        candidate: Maps a reading and the label declared so far (n,) to a label (n,).
        after: Samples in a row.
        warmup: Samples without a decision and without counting.
    """
    persistence = Persistence(after, after, after, warmup, same=True)

    def step(s: Automaton, k: Array, r: Reading, informed: Array) -> tuple[Automaton, Verdict]:
        now = candidate(r, s.label)
        s = declare(s, now, now > 0, np.zeros(len(now), bool), persistence, informed & (k > warmup))
        return s, Verdict(s.label > 0, s.label)

    return Rule(undeclared, step)
