"""Bank of adaptive isolation estimators with adaptive thresholds, decided by the generalised observer scheme (GOS).

After the detector's alarm one estimator per class learns the parameter of its own fault function. Each has a
threshold that its residual cannot cross if its class is the true one; so a class whose residual does cross is
excluded for good, and a class is isolated when all others are excluded. The scheme is sound and conservative: as
strict verdict it often ends with several classes left. The tie-broken form then names the one with the smallest
normalised residual energy.

[1] X. Zhang, M. M. Polycarpou, T. Parisini, IEEE TAC 47(4), 576-593, 2002.
[2] The same authors, Annual Reviews in Control 32, 2008.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from fdi_gym.estimation.missile_model import Sample

from baselines.filters import approximation_detector as detection
from baselines.filters.approximation_detector import B0, B1, A, Detector, G
from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation import missile_model as model
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import DEG, DT

GAMMA_LOW = 0.15  # 1/s: known lower bound of the fault's growth rate
CENTRE = np.array([0.0, 0.0, 0.4, np.nan, 0.5])  # o of classes 1..5; that of a jam is delta^ at the alarm
RADIUS = np.array([1.5, 1.5, 0.4, 8 * DEG, 0.5])  # r
RATE = np.array([0.5, 2.0, 0.05, 0.002, 0.2])  # Gamma
JAM = 4
NONE, SEVERAL, ALL = 0, -1, -2  # strict verdicts besides the classes: no alarm, several left, all excluded


class Bank(NamedTuple):
    """The estimators of m classes at sample k; what belongs to one that has not started yet is 0."""

    started: Array  # (n,) bool
    since: Array  # (n,) samples since the alarm
    eps: Array  # (n, m, 2) residuals
    threshold: Array  # (n, m, 2) lambda
    excluded: Array  # (n, m) bool, latched
    energy: Array  # (n, m) sum of (eps / nu)^2 since the alarm
    theta: Array  # (n, m) parameters after the update at k
    used: Array  # (n, m) parameters that made the residuals at k
    centre: Array  # (n, m) o
    xhat: Array  # (n, m, 2)
    s: Array  # (n, m, 2) right-hand side at k
    integral: Array  # (n, m, 2) filtered part of lambda
    w: Array  # (n, m, 2) its input at k


def start(n: int, m: int) -> Bank:
    """The bank before any alarm."""
    vector, matrix = np.zeros((n, m)), np.zeros((n, m, 2))
    return Bank(np.zeros(n, bool), np.zeros(n), matrix, matrix, np.zeros((n, m), bool), vector, vector, vector, vector,
                matrix, matrix, matrix, matrix)  # fmt: skip


def advance(bank: Bank, detector: Detector, sample: Sample, classes: tuple[int, ...]) -> Bank:
    """One sample: estimators run from the detector's alarm on."""
    index = np.array(classes) - 1
    jam = np.array(classes) == JAM
    first = detector.alarm & ~bank.started  # the alarm sample k_d
    begin, run = first[:, None], detector.alarm[:, None]
    started, since = detector.alarm, np.where(bank.started, bank.since + 1, 0.0)

    parts = [model.fault_function(c, sample.alpha, sample.delta, sample.jet, sample.mach) for c in classes]
    Z, F0 = (np.stack(part, axis=1) for part in zip(*parts, strict=True))  # (n, m, 2)
    centre = np.where(begin, np.where(jam, sample.delta[:, None], CENTRE[index]), bank.centre)
    theta = np.where(begin, centre, bank.theta)
    y = sample.y[:, None, :]

    s = G * y + model.xi(*sample)[:, None, :] + F0 + theta[..., None] * Z
    kappa = RADIUS[index] + np.abs(theta - centre)
    unfolding = np.where(jam, 0.0, np.exp(-GAMMA_LOW * DT * since)[:, None])  # 1 - beta at most; a jam is abrupt
    w = (kappa + unfolding * np.abs(theta))[..., None] * np.abs(Z) + detector.bound[:, None, :]
    xhat = np.where(begin[..., None], detector.xhat[:, None, :], A * bank.xhat + B0 * bank.s + B1 * s)
    integral = np.where(begin[..., None], np.abs(detector.eps)[:, None, :], A * bank.integral + B0 * bank.w + B1 * w)

    eps, threshold = y - xhat, integral + detector.nu[:, None, :]
    excluded = bank.excluded | ((np.abs(eps) > threshold).any(axis=-1) & run)
    energy = bank.energy + ((eps / detector.nu[:, None, :]) ** 2).sum(axis=-1)
    learned = theta + DT * RATE[index] * (Z * eps).sum(axis=-1)
    learned = np.clip(learned, centre - RADIUS[index], centre + RADIUS[index])

    def live(value: Array) -> Array:
        return np.where(run.reshape(-1, *[1] * (value.ndim - 1)), value, 0)

    return Bank(started, since, live(eps), live(threshold), excluded, live(energy), live(learned), live(theta), centre,
                live(xhat), live(s), live(integral), live(w))  # fmt: skip


def strict_verdict(bank: Bank, classes: tuple[int, ...]) -> Array:
    """(n,): the class that is isolated, else NONE, SEVERAL or ALL."""
    left = (~bank.excluded).sum(axis=1)
    alone = np.array(classes)[np.argmin(bank.excluded, axis=1)]
    verdict = np.where(left == 1, alone, np.where(left == 0, ALL, SEVERAL))
    return np.where(bank.started, verdict, NONE)


def tie_broken(bank: Bank, classes: tuple[int, ...]) -> Array:
    """(n,): among the classes not excluded (all, if none is left) the one with the smallest residual energy."""
    out = bank.excluded & ~bank.excluded.all(axis=1, keepdims=True)
    best = np.array(classes)[np.argmin(np.where(out, np.inf, bank.energy), axis=1)]
    return np.where(bank.started, best, NONE)


@diagnoser("gos", "Adaptive estimator bank, 5 classes, tie-broken")
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
    if not classes or not set(classes) <= {1, 2, 3, 4, 5}:
        raise ValueError(f"classes are labels in 1..5, not {classes}")
    sigma = detection.sensor_sigma(plant)

    def init(n: int) -> tuple[Detector, Bank]:
        return detection.start(n), start(n, len(classes))

    def update(state: tuple[Detector, Bank], obs: Array) -> tuple[tuple[Detector, Bank], Diagnosis]:
        sample = model.read(plant, obs)
        detector = detection.advance(state[0], sample, sigma)
        bank = advance(state[1], detector, sample, classes)
        verdict = strict_verdict(bank, classes) if strict else tie_broken(bank, classes)
        mode = np.maximum(verdict, 0)
        shown = detection.signals(detector) | {"isolation residuals": bank.eps, "isolation thresholds": bank.threshold}
        return (detector, bank), Diagnosis(bank.started, mode, declared_theta(bank, mode, classes), signals=shown)

    return Diagnoser(init, update)


def declared_theta(bank: Bank, mode: Array, classes: tuple[int, ...]) -> Array:
    """The declared class's parameter, as the identification task asks for it (n, 5): a jam counts 1, the rest 0."""
    theta = np.zeros((len(mode), 5))
    for i, label in enumerate(classes):
        theta[:, label - 1] = np.where(mode == label, 1.0 if label == JAM else bank.used[:, i], 0.0)
    return theta
