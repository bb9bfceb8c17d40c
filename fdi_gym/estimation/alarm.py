"""From what a method holds against each label to an alarm and a declared label.

A detector says after every sample how badly each label fits (`Evidence.cost`); a label is declared where it fits better
than health by the thresholds of its fault modes. `decide` adds persistence and hysteresis; the thresholds are found in
`fdi_gym.estimation.calibration`.

The statistics of this file serve any filter that estimates the fault vector:

- "distance": gain in fit of the best faulty label, in the metric of the estimate's covariance;
- "thresholds": the same in a fixed metric: thresholds on the estimate, never below a quarter of a typical fault;
- "chi-square": weighted mean of the normalised innovation squared (R. K. Mehra, J. Peschon, Automatica 7, 1971);
- "cusum": Page's cumulative sum of it (E. S. Page, Biometrika 41, 1954);
- "glr": generalised likelihood ratio of a jump in the mean of the whitened innovations at an unknown time within a
  window (M. Basseville, I. V. Nikiforov, Detection of Abrupt Changes, 1993).

The last three look at the innovations, which a filter that follows the fault soon explains away again; they raise the
alarm, and the distance keeps it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Diagnosis
from fdi_gym.estimation.decision import fit, manifolds
from fdi_gym.estimation.kalman import quadratic
from fdi_gym.plant import Array, Plant


class Evidence(NamedTuple):
    """What a detector says after a sample."""

    cost: Array  # (n, labels) how badly each label fits: a squared distance, or -2 log of a probability
    estimate: Array  # (n, n_estimated)
    estimate_std: Array | None = None
    probs: Array | None = None  # (n, labels)
    rise: Array | None = None  # (n,) a statistic of its own that raises the alarm, in place of the costs


class Detector(NamedTuple):
    """A pair of functions, batched over episodes."""

    start: Callable[[int], Any]
    step: Callable[[Any, Array], tuple[Any, Evidence]]  # (state, obs (n, n_obs))


class Persistence(NamedTuple):
    """Consecutive samples until an alarm is raised, its label changes, and it is given up."""

    rise: int = 3
    switch: int = 5
    release: int = 10


PERSISTENCE = Persistence()
LEAST = 3.84  # a threshold is never below the 95 % point of one degree of freedom
QUARTER = 0.25  # of the typical size: what LEAST is in the fixed metric of "thresholds"


class Thresholds(NamedTuple):
    """By how much a fault of each mode must fit better than health, and the threshold of a statistic that raises alarms.

    An alarm is given up where the best label has less than half of its threshold left.
    """

    modes: tuple[float, ...]  # in the order of plant.modes
    rise: float | None = None


class Estimate(NamedTuple):
    """What a filter knows of the fault vector after a sample."""

    z: Array  # (n, p) deviation from healthy
    P: Array  # (n, p, p)
    nu: Array  # (n, m) innovation
    S: Array  # (n, m, m) its covariance


class FaultFilter(NamedTuple):
    """A filter of the fault vector, batched over episodes."""

    start: Callable[[int], Any]
    step: Callable[[Any, Array], Any]  # (state, obs (n, n_obs)) -> state
    read: Callable[[Any], Estimate]


class Test(NamedTuple):
    """A statistic of the innovations: start(n, m) and step(state, estimate) -> (state, statistic (n,))."""

    start: Callable[[int, int], Any]
    step: Callable[[Any, Estimate], tuple[Any, Array]]


def chi_square_test(memory: int = 20) -> Test:
    """Exponentially weighted mean of nu' S^-1 nu, less its expectation."""

    def step(mean: Array, e: Estimate) -> tuple[Array, Array]:
        mean = mean + (quadratic(e.nu, e.S) - e.nu.shape[1] - mean) / memory
        return mean, mean

    return Test(lambda n, m: np.zeros(n), step)


def cusum_test(allowance: float = 0.5) -> Test:
    """g+ = max(0, g + nu' S^-1 nu - (1 + allowance) m): grows where the innovations are too large by the allowance."""

    def step(g: Array, e: Estimate) -> tuple[Array, Array]:
        g = np.maximum(0.0, g + quadratic(e.nu, e.S) - (1 + allowance) * e.nu.shape[1])
        return g, g

    return Test(lambda n, m: np.zeros(n), step)


def glr_test(windows: tuple[int, ...] = (2, 5, 10, 20, 40)) -> Test:
    """max over windows w of |sum of the last w whitened innovations|^2 / w."""
    longest = max(windows)

    def start(n: int, m: int) -> Any:
        return 0, np.zeros((n, longest + 1, m))

    def step(state: Any, e: Estimate) -> tuple[Any, Array]:
        k, sums = state
        white = np.linalg.solve(np.linalg.cholesky(e.S), e.nu[..., None])[..., 0]
        sums = np.concatenate([sums[:, 1:], sums[:, -1:] + white[:, None]], axis=1)
        ratios = [((sums[:, -1] - sums[:, -1 - w]) ** 2).sum(axis=1) / w for w in windows if w <= k + 1]
        return (k + 1, sums), np.max(ratios, axis=0) if ratios else np.zeros(len(white))

    return Test(start, step)


TESTS: dict[str, Callable[..., Test]] = {"chi-square": chi_square_test, "cusum": cusum_test, "glr": glr_test}
DECISIONS = ("distance", "thresholds", *TESTS)


def penalties(plant: Plant, thresholds: Thresholds) -> Array:
    """What each label costs beside its distance (labels,): the thresholds of its modes."""
    of = {mode.name: value for mode, value in zip(plant.modes, thresholds.modes, strict=True)}
    return np.array([sum(of[name] for name in label.modes) for label in plant.labels])


def gain(cost: Array, penalty: Array) -> Array:
    """The gain in fit over healthy of the best faulty label, as a share of what it must be (n,)."""
    return ((cost[..., :1] - cost[..., 1:]) / penalty[1:]).max(axis=-1)


def watch(plant: Plant, filter: FaultFilter, decision: str, size: Array, excess: Callable[[], Array]) -> Detector:
    """A detector from a filter of the fault vector.

    Args:
        plant: The plant.
        filter: The filter; the entries of its estimate are those of `plant.estimated`.
        decision: One of DECISIONS.
        size: Typical fault sizes (p,), the metric of "thresholds".
        excess: By how much the estimate's covariance is too small on healthy flights (p, p); asked for when first used.

    Raises:
        ValueError: Unknown decision.
    """
    if decision not in DECISIONS:
        raise ValueError(f"unknown decision {decision!r}; there are {', '.join(DECISIONS)}")
    groups, labels = manifolds(plant), len(plant.labels)
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)
    fixed = np.diag((QUARTER * size) ** 2 / LEAST)[None]
    test = TESTS[decision]() if decision in TESTS else None

    def first(n: int) -> Any:
        s = filter.start(n)
        return s, test.start(n, filter.read(s).nu.shape[1]) if test else np.zeros((n, 0))

    def advance(state: Any, obs: Array) -> tuple[Any, Evidence]:
        s, tested = state
        s = filter.step(s, obs)
        e = filter.read(s)
        fits = fit(e.z, fixed if decision == "thresholds" else e.P + excess(), groups)
        cost = np.empty((len(obs), labels))
        cost[:, 0], cost[:, fits.labels] = fits.J_healthy, fits.J
        rise = None
        if test is not None:
            tested, rise = test.step(tested, e)
        std = np.sqrt(np.einsum("npp->np", e.P))
        return (s, tested), Evidence(cost, healthy + e.z, std, None, rise)

    return Detector(first, advance)


class Declared(NamedTuple):
    """State of the decision: the label, and for how many samples each condition has held (n,)."""

    label: Array
    over: Array
    other: Array
    under: Array


def declare(s: Declared, e: Evidence, penalty: Array, rise: float | None, after: Persistence) -> Declared:
    """The label after the evidence of a sample. A release wins over a switch."""
    best, share = 1 + np.argmin(e.cost[:, 1:] + penalty[1:], axis=1), gain(e.cost, penalty)
    on = s.label > 0
    alarming = share > 1.0 if e.rise is None or rise is None else e.rise > rise
    over = np.where(alarming & ~on, s.over + 1, 0)
    other = np.where((best != s.label) & on, s.other + 1, 0)
    under = np.where((share < 0.5) & on, s.under + 1, 0)
    raised, switched, released = over >= after.rise, other >= after.switch, under >= after.release
    label = np.where(released, 0, np.where(raised | switched, best, s.label))
    return Declared(label, np.where(raised, 0, over), np.where(switched | released, 0, other), np.where(released, 0, under))


def decide(
    plant: Plant, detector: Detector, thresholds: Callable[[], Thresholds], persistence: Persistence = PERSISTENCE
) -> Diagnoser:
    """The diagnoser that declares what a detector's evidence says; it asks for the thresholds when it is first used."""

    def init(n: int) -> Any:
        return detector.start(n), Declared(*(np.zeros(n, np.int64) for _ in Declared._fields))

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        s, declared = state
        at = thresholds()
        s, e = detector.step(s, obs)
        declared = declare(declared, e, penalties(plant, at), at.rise, persistence)
        return (s, declared), Diagnosis(declared.label > 0, declared.label, e.estimate, e.estimate_std, e.probs)

    return Diagnoser(init, update)
