"""Detection and approximation estimator: an online approximator behind a bound on the model error.

A radial-basis network learns what the nominal model leaves unexplained in the pitch channel; outside a dead zone
only, so that it does not learn the model's own error. The dead zone is the alarm threshold: the filtered bound on the
model error plus a margin for bounded sensor noise. It follows that the estimator never alarms while the bounds hold,
and that it sees only faults which exceed twice the filtered bound.

[1] A. B. Trunov, M. M. Polycarpou, IEEE Trans. Neural Networks 11(1), 2000.
[2] X. Zhang, M. M. Polycarpou, T. Parisini, IEEE TAC 47(4), 576-593, 2002.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from fdi_gym.estimation.missile_model import Sample

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation import missile_model as model
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import DEG, DT

G = 5.0  # 1/s: filter gain of every estimator
A = np.exp(-G * DT)
B1 = (1 - (1 - A) / (G * DT)) / G
B0 = (1 - A) / G - B1  # z' = -g z + s with s linear between samples: z+ = A z + B0 s + B1 s+

CENTRES = np.linspace(-2, 2, 11)
WIDTH = 0.6
SPAN = 10 * DEG  # rad: the network's input is alpha / SPAN
GAMMA = 10.0  # learning rate
W_MAX = 15.0  # bound of every weight
NOISE_FACTOR = 5.0  # standard deviations of the linearised residual noise
NU_0 = np.array([2e-5, 2e-3])  # rad, rad/s: numerical floor


class Detector(NamedTuple):
    """The estimator at sample k, everything from y_k."""

    begun: Array  # (n,) bool: has seen its first sample
    eps: Array  # (n, 2) residual y - xhat [rad, rad/s]
    threshold: Array  # (n, 2)
    nu: Array  # (n, 2) the noise margin in it
    fhat: Array  # (n,) approximation of the fault function [rad/s^2]
    alarm: Array  # (n,) bool, latched
    xhat: Array  # (n, 2)
    s: Array  # (n, 2) right-hand side at k
    bound: Array  # (n, 2) etabar at k
    integral: Array  # (n, 2) filtered bound
    v: Array  # (n, 2) variance of xhat
    w: Array  # (n, 2) its input at k
    W: Array  # (n, 11) weights after the update at k


def basis(alpha: Array) -> Array:
    """The network's nodes phi at the incidence (n,): (n, 11)."""
    return np.exp(-(((alpha / SPAN)[..., None] - CENTRES) ** 2) / WIDTH**2)


def noise_input(sample: Sample, sigma: Array) -> Array:
    """w_i: variance of what noise in y adds to the right-hand side (n, 2)."""
    A11, A21 = model.slopes(sample.alpha, sample.delta, sample.mach)
    variance = sigma**2
    return np.stack([(G + A11) ** 2 * variance[0] + variance[1], A21**2 * variance[0] + G**2 * variance[1]], axis=-1)


def start(n: int) -> Detector:
    """The estimator before its first sample."""
    none, pair = np.zeros(n, bool), np.zeros((n, 2))
    return Detector(none, pair, pair, pair, np.zeros(n), none, pair, pair, pair, pair, pair, pair,
                    np.zeros((n, CENTRES.size)))  # fmt: skip


def advance(before: Detector, sample: Sample, sigma: Array, margin: bool = True) -> Detector:
    """The estimator one sample later. sigma (2,): noise of alpha and q."""
    y, phi, first = sample.y, basis(sample.alpha), ~before.begun[:, None]
    fhat = np.einsum("nj,nj->n", before.W, phi)
    s = G * y + model.xi(*sample)
    s[:, 1] += fhat
    bound = model.uncertainty_bound(sample.alpha, sample.mach)
    xhat = np.where(first, y, A * before.xhat + B0 * before.s + B1 * s)
    integral = np.where(first, 0.0, A * before.integral + B0 * before.bound + B1 * bound)
    v = np.where(first, sigma**2, A**2 * before.v + (B0 + B1) ** 2 * before.w)
    nu = NOISE_FACTOR * np.sqrt(sigma**2 + v) + NU_0 if margin else np.tile(NU_0, (len(y), 1))
    eps, threshold = y - xhat, integral + nu
    dead = np.where(np.abs(eps[:, 1]) <= threshold[:, 1], 0.0, eps[:, 1])
    W = np.clip(before.W + DT * GAMMA * phi * dead[:, None], -W_MAX, W_MAX)
    alarm = before.alarm | (np.abs(eps) > threshold).any(axis=1)
    return Detector(np.ones_like(alarm), eps, threshold, nu, fhat, alarm, xhat, s, bound, integral, v,
                    noise_input(sample, sigma), W)  # fmt: skip


def sensor_sigma(plant: Plant) -> Array:
    """Noise of the two channels that the estimators use (2,)."""
    return np.array([s.sigma for s in plant.outputs[:2]])


def signals(detector: Detector) -> dict[str, Array]:
    """What the estimator has to show: the approximated fault function, and the residuals beside their thresholds."""
    return {"fault function": detector.fhat, "residual": detector.eps, "threshold": detector.threshold}


@diagnoser("approximation_detector", "Online-approximation detector with noise margin")
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
    sigma = sensor_sigma(plant)

    def update(before: Detector, obs: Array) -> tuple[Detector, Diagnosis]:
        detector = advance(before, model.read(plant, obs), sigma, margin)
        return detector, Diagnosis(detector.alarm, np.zeros(len(obs), np.int64), signals=signals(detector))

    return Diagnoser(start, update)
