"""The nominal missile on stacks of points, as its estimators use it: equations, their slopes, bounds, fault functions.

Every function takes arrays that broadcast against each other (episodes, or episodes by hypotheses) and returns the
alpha-component and the q-component along a last axis of length 2 where the quantity is a vector. u^ = (delta^, j^) is
the nominal actuator model's output. Equations and constants: `fdi_gym.plants.missile_pitch`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import NotApplicableError
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import (
    A_M,
    A_N,
    ALPHA_J,
    B_M,
    B_N,
    C_M,
    C_N,
    D_M,
    D_N,
    ID,
    K1,
    K_ALPHA,
    K_Q,
    L2,
    L_J,
)  # fmt: skip

RHO_BOUND = 0.05  # every algorithm assumes the six coefficients known to 5 %


class Sample(NamedTuple):
    """What an observation says, each (n,)."""

    alpha: Array  # measured incidence [rad]
    q: Array  # measured pitch rate [rad/s]
    delta: Array  # nominal fin angle delta^ [rad]
    jet: Array  # nominal jet level j^
    mach: Array

    @property
    def y(self) -> Array:
        """The two measured states (n, 2)."""
        return np.stack([self.alpha, self.q], axis=-1)


def read(plant: Plant, obs: Array) -> Sample:
    """The observation (n, n_obs) as the estimators read it: all of it belongs to sample k."""
    y, _, known = plant.split(obs)
    return Sample(y[:, 0], y[:, 1], known[:, 0], known[:, 1], known[:, 2])


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
