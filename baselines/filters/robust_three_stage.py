"""The robust three-stage Kalman filter: unbiased whatever the fault and the disturbance do.

Nothing is assumed about b and d: no prior, no random walk. Each is solved for by weighted least squares from the
innovation of the sample after it acted, the disturbance from what the fault leaves unexplained. It is the limit of the
optimal three-stage filter for infinite Qb and Qd, and equals the joint unbiased minimum-variance filter of input and
state for the distribution [B E] (S. Gillijns, B. De Moor, Automatica 43(1), 2007, without feed-through).

It exists where the unknown inputs reach the sensors independently within one sample, rank H[B E] = p + q, and the error
dynamics (I - L H) A are stable: no unstable invariant zero.

After Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021, Table 2, derived anew where it is unreadable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import NotApplicableError
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.estimation.propagation import FaultInputs, Propagated, trim_model
from fdi_gym.plant import Plant

Array = np.ndarray


class RobustThreeStage(NamedTuple):
    """State of the filter, and its estimates of the unknown inputs over the interval that has just ended."""

    x: Array  # (n, n_x)
    P: Array  # (n, n_x, n_x)
    b: Array  # (n, p)
    d: Array  # (n, q)
    cov_b: Array  # (n, p, p)
    cov_d: Array  # (n, q, q)


def start(n: int, x0: Array, P0: Array, p: int, q: int) -> RobustThreeStage:
    """The filter before its first measurement."""
    return RobustThreeStage(
        np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1)), np.zeros((n, p)), np.zeros((n, q)),
        np.zeros((n, p, p)), np.zeros((n, q, q)),
    )  # fmt: skip


def step(f: Propagated, y: Array, H: Array, Q: Array, R: Array) -> RobustThreeStage:
    """One step with the measurement y (n, n_y): the inputs that acted since the last one, and the state now.

    Args:
        f: The propagation of the estimate at b = 0, d = 0.
        y: The measurement.
        H: Output matrix (n_y, n_x).
        Q, R: Covariances per step of process and sensors.
    """
    P_ = f.P + Q
    r = y - times(H, f.x)
    PHt = P_ @ H.T
    C1 = H @ PHt + R
    S2, S3 = H @ f.B, H @ f.E
    n_x, p = P_.shape[-1], S2.shape[-1]
    divided = right_divide(np.concatenate([PHt, T(S2), T(S3)], axis=1), C1)  # one factorisation of C1 for all three
    Kx, S2tC, S3tC = divided[:, :n_x], divided[:, n_x : n_x + p], divided[:, n_x + p :]
    # state stage
    x, Pxb = f.x + times(Kx, r), P_ - Kx @ T(PHt)
    # fault stage: weighted least squares
    Pb = symmetric(np.linalg.inv(S2tC @ S2))
    Kb = Pb @ S2tC
    b = times(Kb, r)
    # disturbance stage: weighted least squares on what the fault leaves, S3' G with G = C1^-1 (I - S2 Kb)
    S3tG = S3tC - S3tC @ S2 @ Kb
    Pd = symmetric(np.linalg.inv(S3tG @ S3))
    d = times(Pd @ S3tG, r)
    # couplings
    V12 = f.B - Kx @ S2
    V23 = -Kb @ S3
    V13 = f.E + V12 @ V23 - Kx @ S3
    x = x + times(V12, b) + times(V13, d)
    P = symmetric(Pxb + V12 @ Pb @ T(V12) + V13 @ Pd @ T(V13))
    return RobustThreeStage(x, P, b + times(V23, d), d, symmetric(Pb + V23 @ Pd @ T(V23)), Pd)


def input_gain(f: Propagated, H: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """Gain L (n, n_x, n_y) and covariance P of the joint unbiased minimum-variance filter with G = [B E]: the same filter.

    L = Kx + (G - Kx F) M, M = (F' C1^-1 F)^-1 F' C1^-1, F = H G; P = (I - L H) P- (I - L H)' + L R L'.
    """
    P_ = f.P + Q
    G = np.concatenate([f.B, f.E], axis=-1)
    F = H @ G
    C1 = H @ P_ @ H.T + R
    Kx = right_divide(P_ @ H.T, C1)
    FtC = right_divide(T(F), C1)
    M = np.linalg.solve(FtC @ F, FtC)
    L = Kx + (G - Kx @ F) @ M
    left = np.eye(P_.shape[-1]) - L @ H
    return L, left @ P_ @ T(left) + L @ R @ T(L)


class Existence(NamedTuple):
    """The existence conditions at trim, and what the filter is worth where they hold."""

    rank: int  # of H[B E] with unit columns
    needed: int  # p + q
    condition: float  # of the same matrix
    radius: float  # largest modulus of (I - L H) A
    std_b: Array  # (p,) steady standard deviation of the fault estimate
    std_d: Array  # (q,)


def existence(
    plant: Plant, inputs: FaultInputs, H: Array, R: Array | None = None, *, smallest: float = 1e-3, samples: int = 5000
) -> Existence:
    """Rank and steady state of the robust filter for the plant linearised at trim.

    Args:
        plant: The plant.
        inputs: The fault channels.
        H: Its output matrix.
        R: Covariance of these sensors. Default: the plant's.
        smallest: Singular values of H[B E] (unit columns) below this share of the largest count as zero: such an input
            moves the sensors within one sample by a thousandth of what the others do.
        samples: Length of the recursion to the steady state; it is left early where that is reached.
    """
    R = plant.R if R is None else R
    at = trim_model(plant, inputs)
    F = H @ np.hstack([at.B, at.E])
    needed = F.shape[1]
    length = np.linalg.norm(F, axis=0)
    if not (length > 0).all():
        missing = [n for n, v in zip((*inputs.names, *(s.name for s in plant.disturbances)), length, strict=True) if not v]
        nothing = np.full(needed, np.nan)
        p = len(inputs.names)
        rank = int(np.linalg.matrix_rank(F)) if F.size and len(missing) < needed else 0
        return Existence(rank, needed, np.inf, np.nan, nothing[:p], nothing[p:])
    values = np.linalg.svd(F / length, compute_uv=False)
    rank = int((values > smallest * values[0]).sum())
    condition = float(values[0] / values[-1]) if len(values) == needed and values[-1] > 0 else np.inf
    p = len(inputs.names)
    if rank < needed:
        nothing = np.full(needed, np.nan)
        return Existence(rank, needed, condition, np.nan, nothing[:p], nothing[p:])
    P, A = np.eye(len(at.A)), at.A
    zero = np.zeros(len(H))
    L = np.zeros((len(A), len(H)))
    found = None
    for _ in range(samples):
        before = P
        f = Propagated(np.zeros((1, len(A))), (A @ P @ A.T)[None], A[None], None, at.B[None], at.E[None])
        L = input_gain(f, H, plant.Q, R)[0][0]
        found = step(f, zero[None], H, plant.Q, R)
        P = found.P[0]
        size = np.abs(P).max()
        if np.abs(P - before).max() <= 1e-11 * size or not size < 1e12:  # steady, or growing without bound
            break
    radius = float(np.abs(np.linalg.eigvals((np.eye(len(A)) - L @ H) @ A)).max()) if np.isfinite(L).all() else np.inf
    assert found is not None
    std = [np.sqrt(np.diagonal(cov[0])) for cov in (found.cov_b, found.cov_d)]
    return Existence(rank, needed, condition, radius, *std)


def check_existence(plant: Plant, inputs: FaultInputs, H: Array, R: Array | None = None) -> Existence:
    """The conditions at trim, if they hold.

    Raises:
        NotApplicableError: They do not; the message says which one and what was found.
    """
    found = existence(plant, inputs, H, R)
    names = ", ".join((*inputs.names, *(s.name for s in plant.disturbances)))
    if found.rank < found.needed:
        raise NotApplicableError(
            f"the robust filter needs rank H[B E] = {found.needed} for the unknown inputs {names}; at the trim of "
            f"{plant.id} it is {found.rank}: they do not reach the sensors independently within one sample"
        )
    if not found.radius < 1.0:
        raise NotApplicableError(
            f"the robust filter needs stable error dynamics (I - L H) A; for the unknown inputs {names} the largest "
            f"modulus at the trim of {plant.id} is {found.radius:.4g}: an unstable invariant zero"
        )
    return found
