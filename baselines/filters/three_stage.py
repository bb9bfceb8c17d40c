"""The optimal three-stage Kalman filter: state, fault and disturbance, decoupled by the U-V transformation.

The joint covariance of state x, fault b and disturbance d is V blkdiag(Px, Pb, Pd) V' with
V = [[I, V12, V13], [0, I, V23], [0, 0, I]]. The three stages carry the decoupled estimates and covariances and the
couplings; together they are exactly the Kalman filter of the augmented state [x; b; d] in which b and d are random
walks. For a nonlinear plant the propagation rule supplies mean, spread and Jacobians.

Letters and order of the lines as in Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021, Table 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.estimation.propagation import Propagated

Array = np.ndarray


class ThreeStage(NamedTuple):
    """State of the filter: decoupled estimates, their covariances, and the couplings."""

    x: Array  # (n, n_x)
    b: Array  # (n, p)
    d: Array  # (n, q)
    Px: Array  # (n, n_x, n_x)
    Pb: Array  # (n, p, p)
    Pd: Array  # (n, q, q)
    V12: Array  # (n, n_x, p)
    V13: Array  # (n, n_x, q)
    V23: Array  # (n, p, q)

    def estimates(self) -> tuple[Array, Array, Array]:
        """xhat, bhat, dhat: the optimal estimates."""
        return (
            self.x + times(self.V12, self.b) + times(self.V13, self.d),
            self.b + times(self.V23, self.d),
            self.d,
        )

    def fault_covariance(self) -> Array:
        """cov(bhat)."""
        return self.Pb + self.V23 @ self.Pd @ T(self.V23)

    def covariance(self) -> Array:
        """The joint covariance of [x; b; d] (n, N, N)."""
        n, n_x, p, q = len(self.x), self.x.shape[1], self.b.shape[1], self.d.shape[1]
        V = np.tile(np.eye(n_x + p + q), (n, 1, 1))
        V[:, :n_x, n_x : n_x + p], V[:, :n_x, n_x + p :], V[:, n_x : n_x + p, n_x + p :] = self.V12, self.V13, self.V23
        P = np.zeros_like(V)
        P[:, :n_x, :n_x], P[:, n_x : n_x + p, n_x : n_x + p], P[:, n_x + p :, n_x + p :] = self.Px, self.Pb, self.Pd
        return V @ P @ T(V)


def start(n: int, x0: Array, P0x: Array, P0b: Array, P0d: Array) -> ThreeStage:
    """The filter before its first measurement: no fault, no disturbance, nothing coupled."""
    n_x, p, q = len(P0x), len(P0b), len(P0d)
    return ThreeStage(
        np.tile(x0, (n, 1)), np.zeros((n, p)), np.zeros((n, q)),
        np.tile(P0x, (n, 1, 1)), np.tile(P0b, (n, 1, 1)), np.tile(P0d, (n, 1, 1)),
        np.zeros((n, n_x, p)), np.zeros((n, n_x, q)), np.zeros((n, p, q)),
    )  # fmt: skip


def step(
    s: ThreeStage,
    f: Propagated,
    y: Array,
    H: Array,
    Q: Array,
    R: Array,
    Qb: Array,
    Qd: Array,
    *,
    By: Array | float = 0.0,
    Ey: Array | float = 0.0,
    Qxb: Array | float = 0.0,
    Qxd: Array | float = 0.0,
    Qbd: Array | float = 0.0,
) -> ThreeStage:
    """One step with the measurement y (n, n_y).

    Args:
        s: The filter after the previous measurement.
        f: The propagation of its full estimates, with spread Px (the decoupled covariance).
        y: The measurement.
        H: Output matrix (n_y, n_x).
        Q, R, Qb, Qd: Covariances per step of process, sensors, fault walk and disturbance walk.
        By, Ey: Direct feed-through of fault (n_y, p) and disturbance (n_y, q) into the sensors.
        Qxb, Qxd, Qbd: Cross covariances of the three noises.
    """
    x, b, d, Px, Pb, Pd, V12, V13, V23 = s
    # time update of the couplings
    AV = f.carry(np.concatenate([V12, V13], axis=2))
    W12 = AV[..., : b.shape[1]] + f.B
    W13 = AV[..., b.shape[1] :] + f.B @ V23 + f.E
    W23 = V23
    Pd_ = Pd + Qd
    W23Pd, W13Pd = W23 @ Pd, W13 @ Pd
    U23 = right_divide(W23Pd + Qbd, Pd_)
    U13 = right_divide(W13Pd + Qxd, Pd_)
    Pb_ = symmetric(Pb + Qb + W23Pd @ T(W23) - U23 @ Pd_ @ T(U23))
    W12Pb, U13Pd_ = W12 @ Pb, U13 @ Pd_
    U12 = right_divide(W12Pb + W13Pd @ T(W23) + Qxb - U13Pd_ @ T(U23), Pb_)
    Px_ = symmetric(f.P + Q + W12Pb @ T(W12) + W13Pd @ T(W13) - U12 @ Pb_ @ T(U12) - U13Pd_ @ T(U13))
    # time update of the decoupled estimates
    b = b + times(W23 - U23, d)
    x = f.x - times(U12, b) - times(U13, d)
    S2, S3 = H @ U12 + By, H @ U13 + By @ U23 + Ey if np.ndim(By) else H @ U13 + Ey
    # state stage
    PxHt = Px_ @ H.T
    C1 = H @ PxHt + R
    Kx = right_divide(PxHt, C1)
    r1 = y - times(H, x)
    x, Px = x + times(Kx, r1), symmetric(Px_ - Kx @ T(PxHt))
    # fault stage
    PbS2t = Pb_ @ T(S2)
    C2 = C1 + S2 @ PbS2t
    Kb = right_divide(PbS2t, C2)
    r2 = r1 - times(S2, b)
    b, Pb = b + times(Kb, r2), symmetric(Pb_ - Kb @ T(PbS2t))
    # disturbance stage
    PdS3t = Pd_ @ T(S3)
    C3 = C2 + S3 @ PdS3t
    Kd = right_divide(PdS3t, C3)
    r3 = r2 - times(S3, d)
    d, Pd = d + times(Kd, r3), symmetric(Pd_ - Kd @ T(PdS3t))
    # couplings
    V12 = U12 - Kx @ S2
    V13 = U13 - V12 @ (Kb @ S3) - Kx @ S3
    V23 = U23 - Kb @ S3
    return ThreeStage(x, b, d, Px, Pb, Pd, V12, V13, V23)
