"""Detection and approximation estimator: an online approximator behind a bound on the model error.

A radial-basis network learns what the nominal model leaves unexplained in the pitch channel; outside a dead zone
only, so that it does not learn the model's own error. The dead zone is the alarm threshold: the filtered bound on the
model error plus a margin for bounded sensor noise. It follows that the estimator never alarms while the bounds hold,
and that it sees only faults which exceed twice the filtered bound.

Where a sensor did not report, the model's own prediction `a` from the last sample takes its place, and what this may be
off, `spread`, is bounded like the residual: by the model error, the steepest slope of the model within the spread, and
the whole reach of the actuators where they are not known. It enters the threshold, which so remains a bound. Such a
sensor is not tested and nothing is learned. After MEMORY samples, when the residual has forgotten what was before, or
where inputs were missing, the estimator starts anew from the first full sample.

[1] A. B. Trunov, M. M. Polycarpou, IEEE Trans. Neural Networks 11(1), 2000.
[2] X. Zhang, M. M. Polycarpou, T. Parisini, IEEE TAC 47(4), 576-593, 2002.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from baselines.filters import missile_model as model
from baselines.filters.missile_model import RANGE, Known
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.automaton import Automaton
from fdi_gym.estimation.calibration import Persistence
from fdi_gym.estimation.decision import Reading, Rule, Verdict, declare, undeclared
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import DEG, DT

G = 5.0  # 1/s: filter gain of every estimator
A = np.exp(-G * DT)
B1 = (1 - (1 - A) / (G * DT)) / G
B0 = (1 - A) / G - B1  # z' = -g z + s with s linear between samples: z+ = A z + B0 s + B1 s+
MEMORY = round(1 / (G * DT))  # samples

CENTRES = np.linspace(-2, 2, 11)
WIDTH = 0.6
SPAN = 10 * DEG  # rad: the network's input is alpha / SPAN
GAMMA = 10.0  # learning rate
W_MAX = 15.0  # bound of every weight
NOISE_FACTOR = 5.0  # standard deviations of the linearised residual noise
NU_0 = np.array([2e-5, 2e-3])  # rad, rad/s: numerical floor


class Estimator(NamedTuple):
    """One estimator, all arrays (n, 2), or a bank of m, (n, m, 2); after a sample."""

    xhat: Array
    s: Array  # right-hand side
    integral: Array  # bound on the state less xhat, noise aside
    bound: Array  # its right-hand side
    a: Array  # the measured state, or what stands for it
    spread: Array  # bound on the state less a, noise included


class Sampled(NamedTuple):
    """What the estimators have in common at a sample."""

    last: Known  # at the sample before
    known: Known
    blind: Array  # (n,) samples since the last full one; MEMORY where an input was missing
    full: Array  # (n,) bool: both sensors and all inputs have reported
    fresh: Array  # (n,) bool: the estimators start anew
    v: Array  # (n, 2) variance of xhat
    w: Array  # (n, 2) its input
    nu: Array  # (n, 2) the noise margin


class Detector(NamedTuple):
    """The detection and approximation estimator after a sample."""

    sampled: Sampled
    estimator: Estimator
    eps: Array  # (n, 2) residual y - xhat [rad, rad/s], 0 where there is none
    threshold: Array  # (n, 2)
    fhat: Array  # (n,) approximation of the fault function [rad/s^2]
    alarm: Array  # (n,) bool, latched
    W: Array  # (n, 11) weights after the update


Rates = Callable[
    [Array, Array | None, Known], tuple[Array, Array]
]  # (a, spread, known) -> rate of a, bound on that of x - a


def basis(alpha: Array) -> Array:
    """The network's nodes phi at the incidence (n,): (n, 11)."""
    return np.exp(-(((alpha / SPAN)[..., None] - CENTRES) ** 2) / WIDTH**2)


def noise_input(alpha: Array, known: Known, variance: Array) -> Array:
    """w_i (n, 2): variance of what noise in y, of this variance (n, 2), adds to the right-hand side."""
    A11, A21 = model.slopes(alpha, known.delta, known.mach)
    of_alpha, of_q = variance[:, 0], variance[:, 1]
    return np.stack([(G + A11) ** 2 * of_alpha + of_q, A21**2 * of_alpha + G**2 * of_q], axis=-1)


def coast(e: Estimator) -> Estimator:
    """The part of an estimator's step that the sample before gives."""
    return e._replace(xhat=A * e.xhat + B0 * e.s, integral=A * e.integral + B0 * e.bound)


def ahead(e: Estimator, sampled: Sampled, rates: Rates) -> tuple[Array, Array]:
    """a one sample later, from the model alone, and its spread: by Heun's rule, within the range of any flight."""
    rate, growth = rates(e.a, e.spread, sampled.last)
    later, growing = rates(e.a + DT * rate, e.spread + DT * growth, sampled.known)
    a = np.clip(e.a + DT * (rate + later) / 2, -RANGE, RANGE)
    return a, np.minimum(e.spread + DT * np.maximum(growth, growing), 2 * RANGE)


def arrive(e: Estimator, sampled: Sampled, y: Array, seen: Array, rates: Rates, size: Array) -> Estimator:
    """The rest of the step, with what was measured. y, seen of the estimator's shape; size (2,) bounds the noise."""
    a, spread, after = y, None, np.broadcast_to(size, y.shape)
    if not seen.all():
        predicted, wide = ahead(e, sampled, rates)
        a, spread, after = (np.where(seen, *of) for of in ((y, predicted), (0.0, wide), (size, wide)))
    rate, bound = rates(a, spread, sampled.known)
    s = G * a + rate
    if spread is not None:
        bound = bound + G * spread
    return Estimator(e.xhat + B1 * s, s, e.integral + B1 * bound, bound, a, after)


def start(n: int) -> Detector:
    """The detector before its first sample."""
    none, pair, known = np.zeros(n, bool), np.zeros((n, 2)), model.unknown(n)
    sampled = Sampled(known, known, np.full(n, MEMORY), none, none, pair, pair, pair)
    return Detector(sampled, Estimator(*(pair for _ in Estimator._fields)), pair, pair, np.zeros(n), none,
                    np.zeros((n, CENTRES.size)))  # fmt: skip


def predict(d: Detector, at: Interval) -> Detector:
    """Over an interval: the part of the step that needs no measurement."""
    sampled = d.sampled
    v = A**2 * sampled.v + (B0 + B1) ** 2 * sampled.w
    sampled = sampled._replace(last=sampled.known, known=model.known(at, sampled.known), v=v)
    return d._replace(sampled=sampled, estimator=coast(d.estimator))


def update(d: Detector, y: Array, seen: Array, sigma: Array, margin: bool = True) -> Detector:
    """With the measured alpha and q, y (n, 2), that reported, seen (n, 2). sigma (2,): their noise."""
    before, W = d.sampled, d.W
    known = before.known

    def rates(a: Array, spread: Array | None, known: Known) -> tuple[Array, Array]:
        rate = model.xi(a[:, 0], a[:, 1], known.delta, known.jet, known.mach)
        rate[:, 1] += np.einsum("nj,nj->n", W, basis(a[:, 0]))
        return rate, model.growth(a[:, 0], spread, known)

    e = arrive(d.estimator, before, y, seen, rates, NOISE_FACTOR * sigma * margin + NU_0)
    full = seen.all(axis=1) & ~known.held
    fresh = seen.all(axis=1) & (before.blind >= MEMORY)
    blind = np.where(full, 0, np.where(known.held, MEMORY, before.blind + 1))
    e = e._replace(xhat=np.where(fresh[:, None], y, e.xhat), integral=np.where(fresh[:, None], 0.0, e.integral))
    v = np.where(fresh[:, None], sigma**2, before.v)
    nu = NOISE_FACTOR * np.sqrt(sigma**2 + v) + NU_0 if margin else np.tile(NU_0, (len(y), 1))
    w = noise_input(e.a[:, 0], known, sigma**2 * seen)
    eps, threshold, phi = np.where(seen, y - e.xhat, 0.0), e.integral + nu, basis(e.a[:, 0])
    dead = np.where((np.abs(eps[:, 1]) <= threshold[:, 1]) | ~full, 0.0, eps[:, 1])
    learned = np.clip(W + DT * GAMMA * phi * dead[:, None], -W_MAX, W_MAX)
    alarm = d.alarm | (np.abs(eps) > threshold).any(axis=1)
    sampled = Sampled(before.last, known, blind, full, fresh, v, w, nu)
    return Detector(sampled, e, eps, threshold, np.einsum("nj,nj->n", W, phi), alarm, learned)


def sensor_sigma(plant: Plant) -> Array:
    """Noise of the two channels that the estimators use (2,)."""
    return np.array([s.sigma for s in plant.outputs[:2]])


def state(d: Detector) -> Array:
    """The estimator's own estimate of the plant's state (n, 5)."""
    return model.state(d.estimator.xhat, d.sampled.known)


def signals(d: Detector) -> dict[str, Array]:
    """What the detector has to show: the approximated fault function, and the residuals beside their thresholds."""
    return {"fault function": d.fhat, "residual": d.eps, "threshold": d.threshold}


def detector_filter(sigma: Array, margin: bool = True) -> Filter:
    """The detector as a filter. sigma (2,): noise of alpha and q."""

    def step(d: Detector, at: Interval, y: Array, seen: Array) -> Detector:
        return update(d, y[:, :2], seen[:, :2], sigma, margin)

    def begin(d: Detector, at: Interval, y: Array) -> Detector:
        return step(predict(d, at), at, y, np.ones(y.shape, bool))

    def read(d: Detector) -> Reading:
        return Reading(x=state(d), signals=signals(d))

    return Filter(start, predict, step, read, True, begin, model.SENSORS)


def exceeded() -> Rule:
    """An alarm for good once a residual exceeds its threshold; no isolation."""
    latched = Persistence(1, 1, 1)

    def step(s: Automaton, k: Array, r: Reading, informed: Array) -> tuple[Automaton, Verdict]:
        assert r.signals is not None
        over = np.any(np.abs(r.signals["residual"]) > r.signals["threshold"], axis=1)
        s = declare(s, np.ones(len(k), np.int64), over, np.zeros(len(k), bool), latched, informed)
        return s, Verdict(s.label > 0, np.zeros(len(k), np.int64))

    return Rule(undeclared, step)


@diagnoser("approximation_detector", "Online-approximation detector with noise margin", reference=True)
@diagnoser("approximation_detector_no_margin", "The same with the study's threshold, no noise margin", margin=False)
def approximation_detector(plant: Plant, *, margin: bool = True) -> Diagnoser:
    """The detection estimator; it does not isolate, so its alarm comes with label 0.

    Args:
        plant: The missile.
        margin: Enlarge the threshold by the noise margin nu.

    Raises:
        NotApplicableError: Another plant.
    """
    model.require_missile(plant, "the detection and approximation estimator")
    return diagnoser_of(plant, detector_filter(sensor_sigma(plant), margin), exceeded())
