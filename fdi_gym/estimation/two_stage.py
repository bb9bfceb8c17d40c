"""The two-stage filter of a nonlinear plant: linearised anew at every sample, equal to the augmented extended filter.

State and disturbance are estimated as if there were no fault, the fault vector from what that leaves unexplained, and the
sensitivity V couples them: x = xb + V z. Linearised at the full estimate, the two stages carry exactly the augmented
filter's mean and covariance in decoupled form.

J. Y. Keller, M. Darouach, Automatica 33(9), 1997; C.-S. Hsieh, F.-C. Chen, IEEE TAC 44, 1999, made time-varying.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.augmented import Augmented
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.plant import Array


class TwoStage(NamedTuple):
    """State of the filter after sample k - 1."""

    k: int
    x: Array  # (n, N) bias-free state and disturbance
    Px: Array  # (n, N, N)
    z: Array  # (n, p) fault vector
    Pz: Array  # (n, p, p)
    V: Array  # (n, N, p)
    nu: Array  # (n, m) innovation of the optimal filter
    S: Array  # (n, m, m)
    known: Array  # (n, n_known)

    def state(self) -> Array:
        """The optimal estimate of state and disturbance (n, N)."""
        return self.x + times(self.V, self.z)

    def covariance(self) -> Array:
        """Its covariance (n, N, N)."""
        return self.Px + self.V @ self.Pz @ T(self.V)


def others(model: Augmented) -> list[int]:
    """The entries of X that are not the fault vector."""
    return [*range(model.x.start, model.x.stop), *range(model.d.start, model.d.stop)]


def start(model: Augmented, n: int) -> TwoStage:
    """The filter before its first sample."""
    rest, z, m = others(model), model.z, len(model.R)
    p = z.stop - z.start
    return TwoStage(
        0, np.tile(model.X0[rest], (n, 1)), np.tile(model.P0[np.ix_(rest, rest)], (n, 1, 1)), np.zeros((n, p)),
        np.tile(model.P0[z, z], (n, 1, 1)), np.zeros((n, len(rest), p)), np.zeros((n, m)), np.tile(model.R, (n, 1, 1)),
        np.zeros((n, len(model.plant.known))),
    )  # fmt: skip


def advance(model: Augmented, s: TwoStage, obs: Array, first_sample: bool = True) -> TwoStage:
    """One sample: obs (n, n_obs)."""
    at, known = model.read(s.k, obs, s.known)
    if s.k == 0 and not first_sample:
        return s._replace(k=1, known=known)
    rest, zs, n, N = others(model), model.z, len(obs), len(model.scale)
    X = np.empty((n, N))
    X[:, rest], X[:, zs] = s.state(), s.z
    x, Px, z, Pz, V = s.x, s.Px, s.z, s.Pz, s.V
    if s.k > 0:
        X, F = model.jacobian("f", X, at)
        A, E = F[:, rest][:, :, rest], F[:, rest][:, :, zs]
        U = A @ V + E
        UPz = U @ Pz
        full = symmetric(A @ Px @ T(A) + UPz @ T(U)) + model.Q[np.ix_(rest, rest)]
        aged = Pz + model.Q[zs, zs]
        shrink = np.sqrt(np.minimum(1.0, model.limit[zs] / np.maximum(np.einsum("npp->np", aged), 1e-300)))
        Pz = shrink[:, :, None] * aged * shrink[:, None, :]
        cross = UPz * shrink[:, None, :]
        V = right_divide(cross, Pz)
        Px = symmetric(full - V @ T(cross))
    mean, J = model.jacobian("h", X, at)
    H = J[:, :, rest]
    nu, Hz = at.y - mean, H @ V + J[:, :, zs]
    cross = Px @ T(H)
    C1 = H @ cross + model.R
    Kx = right_divide(cross, C1)
    Px = symmetric(Px - Kx @ T(cross))
    Pz_Hz = Pz @ T(Hz)
    S = C1 + Hz @ Pz_Hz
    Kz = right_divide(Pz_Hz, S)
    x = X[:, rest] - times(V, z) + times(Kx, nu + times(Hz, z))
    return TwoStage(
        s.k + 1, x, Px, z + times(Kz, nu), symmetric(Pz - Kz @ T(Pz_Hz)), V - Kx @ Hz, nu, S, known
    )  # fmt: skip
