"""Bank of adaptive isolation estimators with adaptive thresholds, decided by the generalised observer scheme (GOS).

After the detector's alarm, from the first sample on at which both its sensors reported, one estimator per class learns
the parameter of its own fault function. Each has a threshold that its residual cannot cross if its class is the true
one; so a class whose residual does cross is excluded for good, and a class is isolated when all others are excluded.
The scheme is sound and conservative: as strict verdict it often ends with several classes left. The tie-broken form
then names the one with the smallest normalised residual energy. Gaps are bridged as in the detector, by each class with
its own model and bound.

[1] X. Zhang, M. M. Polycarpou, T. Parisini, IEEE TAC 47(4), 576-593, 2002.
[2] The same authors, Annual Reviews in Control 32, 2008.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filters import approximation_detector as detection
from baselines.filters import missile_model as model
from baselines.filters.approximation_detector import NOISE_FACTOR, NU_0, Detector, Estimator, arrive, coast
from baselines.filters.missile_model import Known
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.decision import Reading, Rule, Verdict
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import DEG, DT

GAMMA_LOW = 0.15  # 1/s: known lower bound of the fault's growth rate
CENTRE = np.array([0.0, 0.0, 0.4, np.nan, 0.5])  # o of classes 1..5; that of a jam is delta^ where its estimator starts
RADIUS = np.array([1.5, 1.5, 0.4, 8 * DEG, 0.5])  # r
RATE = np.array([0.5, 2.0, 0.05, 0.002, 0.2])  # Gamma
JAM = 4
NONE, SEVERAL, ALL = 0, -1, -2  # strict verdicts besides the classes: no bank, several left, all excluded


class Isolation(NamedTuple):
    """The estimators of m classes after a sample; what belongs to one that has not started yet counts for nothing."""

    started: Array  # (n,) bool
    since: Array  # (n,) samples since it started
    estimators: Estimator  # (n, m, 2)
    eps: Array  # (n, m, 2) residuals, 0 where there is none
    threshold: Array  # (n, m, 2) lambda
    excluded: Array  # (n, m) bool, latched
    energy: Array  # (n, m) sum of (eps / nu)^2 since the start
    theta: Array  # (n, m) parameters after the update
    used: Array  # (n, m) parameters that made the residuals
    centre: Array  # (n, m) o


def start(n: int, m: int) -> Isolation:
    """The bank before any alarm."""
    vector, matrix = np.zeros((n, m)), np.zeros((n, m, 2))
    return Isolation(np.zeros(n, bool), np.zeros(n), Estimator(*(matrix for _ in Estimator._fields)), matrix, matrix,
                     np.zeros((n, m), bool), vector, vector, vector, vector)  # fmt: skip


def predict(bank: Isolation) -> Isolation:
    """Over an interval: the part of the step that needs no measurement."""
    if not bank.started.any():
        return bank
    return bank._replace(since=bank.since + bank.started, estimators=coast(bank.estimators))


def update(bank: Isolation, detector: Detector, y: Array, seen: Array, size: Array, classes: tuple[int, ...]) -> Isolation:
    """With what was measured, after the detector's update; y, seen (n, 2), size (2,) bounds the noise."""
    sampled = detector.sampled
    first = detector.alarm & ~bank.started & seen.all(axis=1)  # the alarm sample k_d, where both sensors reported
    started = bank.started | first
    if not started.any():
        return bank
    index, jam = np.array(classes) - 1, np.array(classes) == JAM
    delta, since = sampled.known.delta[:, None], np.where(first, 0.0, bank.since)
    centre = np.where(first[:, None], np.where(jam, delta, CENTRE[index]), bank.centre)
    theta = np.where(first[:, None], centre, bank.theta)
    kappa, largest = RADIUS[index] + np.abs(theta - centre), RADIUS[index] + np.abs(centre)
    unfolding = np.where(jam, 0.0, np.exp(-GAMMA_LOW * DT * since)[:, None])  # 1 - beta at most; a jam is abrupt
    weight = (kappa + unfolding * np.abs(theta))[..., None]

    def functions(alpha: Array, known: Known) -> tuple[Array, Array]:
        inputs = (known.delta, known.jet, known.mach)
        parts = [model.fault_function(c, alpha[:, i], *inputs) for i, c in enumerate(classes)]
        Z, F0 = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
        return Z, F0

    def rates(a: Array, spread: Array | None, known: Known) -> tuple[Array, Array]:
        alpha, column = a[..., 0], known.column()
        Z, F0 = functions(alpha, known)
        rate = model.xi(alpha, a[..., 1], column.delta, column.jet, column.mach) + F0 + theta[..., None] * Z
        bound = weight * np.abs(Z) + model.growth(alpha, spread, column)
        if spread is not None:
            high = model.reach(alpha, spread)[1]
            steepest = [model.fault_growth(c, high[:, i], largest[:, i], known) for i, c in enumerate(classes)]
            bound = bound + np.stack(steepest, axis=1) * spread[..., :1]
        return rate, bound

    ys, seens = (np.broadcast_to(v[:, None], bank.eps.shape) for v in (y, seen))
    e = arrive(bank.estimators, sampled, ys, seens, rates, size)
    begin, fresh = first[:, None, None], sampled.fresh[:, None, None]
    xhat = np.where(begin, detector.estimator.xhat[:, None], np.where(fresh, ys, e.xhat))
    integral = np.where(begin, np.abs(detector.eps)[:, None], np.where(fresh, 0.0, e.integral))
    run, tested, nu = started[:, None], seens & started[:, None, None], sampled.nu[:, None]
    eps = np.where(tested, y[:, None] - xhat, 0.0)
    threshold = np.where(started[:, None, None], integral + nu, 0.0)
    excluded = bank.excluded | ((np.abs(eps) > threshold).any(axis=-1) & run)
    energy = bank.energy + ((eps / nu) ** 2).sum(axis=-1)
    Z = functions(e.a[..., 0], sampled.known)[0]
    learned = theta + DT * RATE[index] * (Z * eps).sum(axis=-1) * sampled.full[:, None]
    learned = np.clip(learned, centre - RADIUS[index], centre + RADIUS[index])
    learned, used = np.where(run, learned, 0.0), np.where(run, theta, 0.0)
    return Isolation(started, since, e._replace(xhat=xhat, integral=integral), eps, threshold, excluded, energy, learned,
                     used, centre)  # fmt: skip


def strict_verdict(started: Array, excluded: Array, classes: tuple[int, ...]) -> Array:
    """(n,): the class that is isolated, else NONE, SEVERAL or ALL. started (n,), excluded (n, m)."""
    left = (~excluded).sum(axis=-1)
    alone = np.array(classes)[np.argmin(excluded, axis=-1)]
    return np.where(started, np.where(left == 1, alone, np.where(left == 0, ALL, SEVERAL)), NONE)


def tie_broken(started: Array, excluded: Array, energy: Array, classes: tuple[int, ...]) -> Array:
    """(n,): among the classes not excluded (all, if none is left) the one with the smallest residual energy (n, m)."""
    out = excluded & ~excluded.all(axis=-1, keepdims=True)
    return np.where(started, np.array(classes)[np.argmin(np.where(out, np.inf, energy), axis=-1)], NONE)


def gos_filter(sigma: Array, classes: tuple[int, ...]) -> Filter:
    """Detector and isolation estimators. sigma (2,): noise of alpha and q."""
    detector, size = detection.detector_filter(sigma), NOISE_FACTOR * sigma + NU_0

    def begin(s: tuple[Detector, Isolation], at: Interval, y: Array) -> tuple[Detector, Isolation]:
        assert detector.begin is not None
        return detector.begin(s[0], at, y), s[1]

    def forward(s: tuple[Detector, Isolation], at: Interval) -> tuple[Detector, Isolation]:
        return detection.predict(s[0], at), predict(s[1])

    def step(s: tuple[Detector, Isolation], at: Interval, y: Array, seen: Array) -> tuple[Detector, Isolation]:
        found = detector.update(s[0], at, y, seen)
        return found, update(s[1], found, y[:, :2], seen[:, :2], size, classes)

    def read(s: tuple[Detector, Isolation]) -> Reading:
        found, bank = s
        return Reading(x=detection.state(found), signals=detection.signals(found) | {
            "isolation residuals": bank.eps, "isolation thresholds": bank.threshold, "parameters": bank.used,
            "energy": bank.energy, "excluded": bank.excluded, "isolating": bank.started,
        })  # fmt: skip

    return Filter(lambda n: (detection.start(n), start(n, len(classes))), forward, step, read, True, begin, model.SENSORS)


def elimination(classes: tuple[int, ...], strict: bool) -> Rule:
    """The scheme's verdict, with the parameter of the class that it names: a jam counts 1, the rest 0."""
    detected = detection.exceeded()

    def step(s: object, k: Array, r: Reading, informed: Array) -> tuple[object, Verdict]:
        s, verdict = detected.step(s, k, r, informed)
        assert r.signals is not None
        started, excluded, energy = (r.signals[name] for name in ("isolating", "excluded", "energy"))
        label = strict_verdict(started, excluded, classes) if strict else tie_broken(started, excluded, energy, classes)
        label = np.maximum(label, 0)
        z = np.zeros((len(label), 5))
        for i, c in enumerate(classes):
            z[:, c - 1] = np.where(label == c, 1.0 if c == JAM else r.signals["parameters"][:, i], 0.0)
        return s, verdict._replace(label=label, z=z)

    return Rule(detected.start, step)


@diagnoser("gos", "Adaptive estimator bank, 5 classes, tie-broken", reference=True)
@diagnoser("gos_strict", "Adaptive estimator bank, 5 classes, strict verdict", strict=True)
@diagnoser("gos_two_class", "Adaptive estimator bank of the study, classes 1 and 2, tie-broken", classes=(1, 2))
@diagnoser("gos_two_class_strict", "Adaptive estimator bank of the study, classes 1 and 2, strict verdict",
           classes=(1, 2), strict=True)  # fmt: skip
def gos(plant: Plant, *, classes: tuple[int, ...] = (1, 2, 3, 4, 5), strict: bool = False) -> Diagnoser:
    """Detector, isolation estimators and GOS decision.

    Args:
        plant: The missile.
        classes: Labels in the bank.
        strict: Name a class only where it is isolated; an alarm without isolation then comes with label 0.

    Raises:
        NotApplicableError: Another plant.
        ValueError: A class that does not exist.
    """
    model.require_missile(plant, "the adaptive estimator bank")
    classes = tuple(classes)
    if not classes or not set(classes) <= {1, 2, 3, 4, 5} or len(set(classes)) < len(classes):
        raise ValueError(f"classes are different labels in 1..5, not {classes}")
    return diagnoser_of(plant, gos_filter(detection.sensor_sigma(plant), classes), elimination(classes, strict))
