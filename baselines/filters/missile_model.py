"""The nominal missile on stacks of points, as its estimators use it: equations, slopes, bounds, fault functions.

Every function takes arrays that broadcast against each other (episodes, or episodes by hypotheses) and returns the
alpha-component and the q-component along a last axis of length 2 where the quantity is a vector. u^ = (delta^, j^) is
the nominal actuator model's output. Equations and constants: `fdi_gym.plants.missile_pitch`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import NotApplicableError
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import (
    A_M,
    A_N,
    ALPHA_J,
    ALPHA_MAX,
    B_M,
    B_N,
    C_M,
    C_N,
    D_M,
    D_N,
    DELTA_MAX,
    DT,
    ID,
    K1,
    K_ALPHA,
    K_Q,
    L2,
    L_J,
    OMEGA_F,
    Q_MAX,
    SUBSTEPS,
    ZETA_F,
)  # fmt: skip

RHO_BOUND = 0.05  # every algorithm assumes the six coefficients known to 5 %
RANGE = np.array([ALPHA_MAX, Q_MAX])  # rad, rad/s: a flight ends where |alpha| or |q| is larger
SENSORS = np.array([True, True, False])  # the estimators use the sensors of alpha and q


class Known(NamedTuple):
    """What is known at a sample, each (n,)."""

    delta: Array  # nominal fin angle delta^ [rad]
    jet: Array  # nominal jet level j^
    mach: Array
    held: Array  # bool: it did not report, these are earlier values
    rate: Array  # nominal fin rate [rad/s]

    def column(self) -> Known:
        """The same as (n, 1), for episodes by hypotheses."""
        return Known(*(a[:, None] for a in self))


def _fin_rate() -> Array:
    """The row of (delta^, its rate, delta_c) -> rate one sample later, by the Runge-Kutta steps of the flight computer."""
    h = DT / SUBSTEPS * np.array([[0, 1, 0], [-(OMEGA_F**2), -2 * ZETA_F * OMEGA_F, OMEGA_F**2], [0, 0, 0]])
    step = np.eye(3) + h @ (np.eye(3) + h / 2 @ (np.eye(3) + h / 3 @ (np.eye(3) + h / 4)))
    return np.linalg.matrix_power(step, SUBSTEPS)[1]


FIN_RATE = _fin_rate()


def unknown(n: int) -> Known:
    """Before the first sample: the actuators are at rest."""
    nothing = np.zeros(n)
    return Known(nothing, nothing, nothing, np.ones(n, bool), nothing)


def known(at: Interval, before: Known) -> Known:
    """What is known at the end of an interval."""
    rate = FIN_RATE[0] * before.delta + FIN_RATE[1] * before.rate + FIN_RATE[2] * at.u[:, 0]
    held = np.zeros(len(rate), bool) if at.held is None else at.held
    return Known(at.known[:, 0], at.known[:, 1], at.known[:, 2], held, rate)


def state(x: Array, known: Known) -> Array:
    """The plant's state (n, 5) from alpha and q (n, 2) and the nominal actuators."""
    return np.column_stack([x, known.delta, known.rate, known.jet])


def require_missile(plant: Plant, method: str, noisy: bool = False) -> None:
    """Raise `NotApplicableError` on any other plant: what the method needs beyond the dynamics exists only here.

    `noisy`: the method divides by the sensors' variance, so it cannot run on a plant without noise either.
    """
    if plant.id != ID:
        raise NotApplicableError(f"{method} needs fault functions and a bound on the model error; {plant.id} has none")
    if noisy and not plant.R.any():
        raise NotApplicableError(f"{method} needs sensor noise; with noise_scale = 0 there is none")


def _pair(first: Any, second: Any) -> Array:
    return np.stack(np.broadcast_arrays(first, second), axis=-1)


def force_terms(alpha: Array, mach: Array) -> tuple[Array, Array, Array]:
    """The three terms of C_n0: a_n, b_n and c_n parts."""
    return A_N * alpha**3, B_N * alpha * np.abs(alpha), C_N * (2 - mach / 3) * alpha


def moment_terms(alpha: Array, mach: Array) -> tuple[Array, Array, Array]:
    """The three terms of C_m0: a_m, b_m and c_m parts."""
    return A_M * alpha**3, B_M * alpha * np.abs(alpha), C_M * (-7 + 8 * mach / 3) * alpha


def xi(alpha: Array, q: Array, delta: Array, jet: Array, mach: Array) -> Array:
    """Nominal right-hand side (alpha_dot, q_dot)."""
    C_n, C_m = sum(force_terms(alpha, mach)) + D_N * delta, sum(moment_terms(alpha, mach)) + D_M * delta
    return _pair(K_ALPHA * mach * np.cos(alpha) * C_n + q, K_Q * mach**2 * C_m + L_J * jet)


def slopes(alpha: Array, delta: Array, mach: Array) -> tuple[Array, Array]:
    """A11 and A21, the derivatives of xi to alpha; those to q are 1 and 0."""
    a = np.abs(alpha)
    dC_n = 3 * A_N * a**2 + 2 * B_N * a + C_N * (2 - mach / 3)
    dC_m = 3 * A_M * a**2 + 2 * B_M * a + C_M * (-7 + 8 * mach / 3)
    C_n = sum(force_terms(alpha, mach)) + D_N * delta
    return K_ALPHA * mach * (np.cos(alpha) * dC_n - np.sin(alpha) * C_n), K_Q * mach**2 * dC_m


def uncertainty_bound(alpha: Array, mach: Array) -> Array:
    """etabar: what errors of 5 % in a, b, c can add to (alpha_dot, q_dot) at most."""
    force = sum(np.abs(term) for term in force_terms(alpha, mach))
    moment = sum(np.abs(term) for term in moment_terms(alpha, mach))
    return RHO_BOUND * _pair(K_ALPHA * mach * np.abs(np.cos(alpha)) * force, K_Q * mach**2 * moment)


def growth(alpha: Array, spread: Array | None, known: Known) -> Array:
    """What bounds the rate of x - a where a is integrated by the nominal model: |d(x - a)/dt| per component (..., 2).

    The model's error, the slope of the model times `spread`, a bound on |x - a| (None: a is x), and what the
    actuators may do while they are not known. Within 20 deg all terms are largest at an end of the interval.
    """
    delta, jet, mach = known.delta, known.jet, known.mach
    if spread is None:
        found = uncertainty_bound(alpha, mach)
    else:
        low, high = reach(alpha, spread)
        found = uncertainty_bound(high, mach)
        force = np.abs(sum(force_terms(high, mach))) + np.abs(D_N * delta)
        dC_n = np.abs(3 * A_N * high**2 + 2 * B_N * high + C_N * (2 - mach / 3))
        A11 = K_ALPHA * mach * (dC_n + np.sin(high) * force)
        A21 = np.maximum(*(np.abs(slopes(end, delta, mach)[1]) for end in (low, high)))
        found[..., 0] += A11 * spread[..., 0] + spread[..., 1]
        found[..., 1] += A21 * spread[..., 0]
    if known.held.any():
        anywhere = 2 * DELTA_MAX * np.abs(fin(np.zeros_like(alpha), mach)) + _pair(0.0 * jet, 2 * L_J)
        found = found + np.where(known.held[..., None], anywhere, 0.0)
    return found


def reach(alpha: Array, spread: Array) -> tuple[Array, Array]:
    """Smallest and largest |alpha| within the spread, as far as the airframe data go."""
    a = np.abs(alpha)
    return np.maximum(a - spread[..., 0], 0.0), np.maximum(a, np.minimum(a + spread[..., 0], ALPHA_MAX))


def uncertainty_regressors(alpha: Array, mach: Array) -> Array:
    """d(alpha_dot, q_dot)/d rho_1..6, signs included: (..., 2, 6)."""
    force, moment = np.stack(force_terms(alpha, mach), -1), np.stack(moment_terms(alpha, mach), -1)
    B = np.zeros((*np.shape(alpha), 2, 6))
    B[..., 0, :3] = (K_ALPHA * mach * np.cos(alpha))[..., None] * force
    B[..., 1, 3:] = (K_Q * mach**2)[..., None] * moment
    return B


def fin(alpha: Array, mach: Array) -> Array:
    """(fa, fq): what a unit of fin angle adds."""
    return _pair(K_ALPHA * mach * np.cos(alpha) * D_N, K_Q * mach**2 * D_M)


def fault_function(label: int, alpha: Array, delta: Array, jet: Array, mach: Array) -> tuple[Array, Array]:
    """Z and F0 of the affine form f = F0 + theta Z of a label; 0 has none."""
    nothing = np.zeros((*np.shape(alpha), 2))
    if label == 1:
        return _pair(0.0, K1 * K_Q * mach**2 * abs(B_M) * alpha * np.abs(alpha)), nothing
    if label == 2:
        return _pair(0.0, L2 * np.exp(-((alpha / ALPHA_J) ** 2))), nothing
    if label == 3:
        return -fin(alpha, mach) * delta[..., None], nothing
    if label == 4:  # theta is the jam angle
        return fin(alpha, mach), -fin(alpha, mach) * delta[..., None]
    if label == 5:
        return _pair(np.zeros_like(alpha), -L_J * jet), nothing
    return nothing, nothing


def fault_slope(label: int, alpha: Array, mach: Array) -> Array:
    """d Z_q / d alpha of labels 1 and 2; the others' are neglected."""
    if label == 1:
        return 2 * K1 * K_Q * mach**2 * abs(B_M) * np.abs(alpha)
    if label == 2:
        return -2 * L2 * np.exp(-((alpha / ALPHA_J) ** 2)) * alpha / ALPHA_J**2
    return np.zeros_like(alpha)


def fault_growth(label: int, high: Array, size: Array, known: Known) -> Array:
    """What d f / d alpha of a label is at most for |alpha| <= high and |theta| <= size (..., 2)."""
    mach = known.mach
    if label == 1:
        return _pair(0.0, size * fault_slope(1, high, mach))
    if label == 2:
        return _pair(0.0, size * L2 * np.sqrt(2 / np.e) / ALPHA_J + 0.0 * high)
    if label in (3, 4):
        angle = np.abs(known.delta) * (size if label == 3 else 1.0) + (size if label == 4 else 0.0)
        return _pair(K_ALPHA * mach * np.sin(high) * np.abs(D_N) * angle, 0.0)
    return np.zeros((*np.shape(high), 2))
