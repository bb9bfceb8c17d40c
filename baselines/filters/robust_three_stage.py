"""The robust three-stage Kalman filter: unbiased whatever the fault and the disturbance do.

Nothing is assumed about b and d: no prior, no random walk. Each is solved for by weighted least squares from the
innovation of the sample after it acted, the disturbance from what the fault leaves unexplained. It is the limit of the
optimal three-stage filter for infinite Qb and Qd, and equals the joint unbiased minimum-variance filter of input and
state for the distribution [B E] (S. Gillijns, B. De Moor, Automatica 43(1), 2007, without feed-through). The estimates
are one sample late and as noisy as a difference of two measurements.

It exists where the unknown inputs reach the sensors independently within one sample, rank H[B E] = p + q, and the error
dynamics (I - L H) A are stable: no unstable invariant zero.

A sample that lacks sensors without which the inputs are not told apart is no sample of this filter: the interval goes on,
and the next whole sample solves for the inputs that acted over all of it, taken as constant. Until then the state is
predicted without unknown inputs, and the inputs' last estimates stand. An interval over which a command did not report
is used like any other, but it is no evidence of a fault: what the command changed is an unknown input, too.

After Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021, Table 2, derived anew where it is unreadable.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from baselines.filters.propagation import Propagated, propagation_of, trim_model
from baselines.filters.unknown_inputs import Known, decided, known_of
from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser
from fdi_gym.diagnosis.contract import choose
from fdi_gym.estimation.belief import Belief, FaultInputs
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, right_divide, solve, symmetric, times
from fdi_gym.plant import Array, Plant

LOSS = 1.1  # sensors may be missing as long as no input's standard deviation grows by more than this factor
LONGEST = 5  # samples for which one estimate counts; over longer intervals it is not the sensors' noise that matters


class RobustThreeStage(NamedTuple):
    """State of the filter, its estimates of the inputs over the last interval, and how they enter the current one."""

    x: Array  # (n, n_x)
    P: Array  # (n, n_x, n_x)
    b: Array  # (n, p)
    d: Array  # (n, q)
    cov_b: Array  # (n, p, p)
    cov_d: Array  # (n, q, q)
    B: Array  # (n, n_x, p) effect on x of the inputs since the last sample that was used
    E: Array  # (n, n_x, q)
    seen: Array  # (n,) sensors that were used at the last sample
    span: Array  # (n,) samples that the current interval spans
    held: Array  # (n,) bool: somewhere in it a command did not report


def start(n: int, x0: Array, P0: Array, cov_b: Array, cov_d: Array) -> RobustThreeStage:
    """The filter before its first measurement; cov_b, cov_d: of estimates that are not there yet."""
    n_x, p, q = len(x0), len(cov_b), len(cov_d)
    return RobustThreeStage(
        np.tile(x0, (n, 1)), np.tile(P0, (n, 1, 1)), np.zeros((n, p)), np.zeros((n, q)),
        np.tile(cov_b, (n, 1, 1)), np.tile(cov_d, (n, 1, 1)), np.zeros((n, n_x, p)), np.zeros((n, n_x, q)),
        np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, bool),
    )  # fmt: skip


def predict(s: RobustThreeStage, f: Propagated, Q: Array) -> RobustThreeStage:
    """The time update; f is the propagation of x at b = 0, d = 0, with spread P."""
    B, E = f.B, f.E
    if s.B.any() or s.E.any():  # the last sample was not used
        carried = f.carry(np.concatenate([s.B, s.E], axis=2))
        B, E = B + carried[..., : B.shape[-1]], E + carried[..., B.shape[-1] :]
    return s._replace(x=f.x, P=f.P + Q, B=B, E=E, span=np.where(s.seen > 0, 1, s.span + 1))


def solved(s: RobustThreeStage, y: Array, seen: Array, H: Array, R: Array) -> RobustThreeStage:
    """The inputs over the interval and the state at its end, from the sensors that reported.

    Args:
        s: The prediction.
        y, seen: The measurement (n, m), and which sensors reported.
        H, R: Output matrix (m, n_x) and covariance of the sensors.
    """
    PHt = s.P @ H.T
    r, C1, PHt, S2t, S3t = masked(seen, y - times(H, s.x), H @ PHt + R, PHt, T(H @ s.B), T(H @ s.E))
    S2, S3 = T(S2t), T(S3t)
    n_x, p, q = s.P.shape[-1], S2.shape[-1], S3.shape[-1]
    divided = right_divide(np.concatenate([PHt, S2t, S3t], axis=1), C1)  # one factorisation of C1 for all three
    Kx, S2tC, S3tC = divided[:, :n_x], divided[:, n_x : n_x + p], divided[:, n_x + p :]
    # state stage
    x, Pxb = s.x + times(Kx, r), s.P - Kx @ T(PHt)
    # fault stage: weighted least squares
    Pb = symmetric(solve(S2tC @ S2, np.eye(p)))
    Kb = Pb @ S2tC
    b = times(Kb, r)
    # disturbance stage: weighted least squares on what the fault leaves, S3' G with G = C1^-1 (I - S2 Kb)
    S3tG = S3tC - S3tC @ S2 @ Kb
    Pd = symmetric(solve(S3tG @ S3, np.eye(q)))
    d = times(Pd @ S3tG, r)
    # couplings
    V12 = s.B - Kx @ S2
    V23 = -Kb @ S3
    V13 = s.E + V12 @ V23 - Kx @ S3
    x = x + times(V12, b) + times(V13, d)
    P = symmetric(Pxb + V12 @ Pb @ T(V12) + V13 @ Pd @ T(V13))
    return RobustThreeStage(
        x, P, b + times(V23, d), d, symmetric(Pb + V23 @ Pd @ T(V23)), Pd, np.zeros_like(s.B), np.zeros_like(s.E),
        seen.sum(axis=1), s.span, s.held,
    )  # fmt: skip


def update(s: RobustThreeStage, y: Array, seen: Array, H: Array, R: Array) -> RobustThreeStage:
    """The measurement update, where the sensors that reported tell the inputs apart; elsewhere the prediction stands."""
    found = solved(s, y, seen, H, R)
    whole = seen.all(axis=1)
    if whole.all():
        return found
    best = solved(s, y, np.ones_like(seen), H, R)
    variance = [np.concatenate([np.einsum("nii->ni", c) for c in (f.cov_b, f.cov_d)], axis=1) for f in (found, best)]
    with np.errstate(invalid="ignore"):
        enough = ((variance[0] > 0) & (variance[0] <= LOSS**2 * variance[1])).all(axis=1)
    return choose(np.logical_or(whole, enough), found, s._replace(seen=np.zeros_like(s.seen)))


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
    zero, all_seen = np.zeros((1, len(H))), np.ones((1, len(H)), bool)
    L = np.zeros((len(A), len(H)))
    found = start(1, np.zeros(len(A)), P, np.eye(p), np.eye(needed - p))
    for _ in range(samples):
        before = P
        f = Propagated(np.zeros((1, len(A))), (A @ P @ A.T)[None], A[None], None, at.B[None], at.E[None])
        L = input_gain(f, H, plant.Q, R)[0][0]
        found = solved(predict(found, f, plant.Q), zero, all_seen, H, R)
        P = found.P[0]
        size = np.abs(P).max()
        if np.abs(P - before).max() <= 1e-11 * size or not size < 1e12:  # steady, or growing without bound
            break
    radius = float(np.abs(np.linalg.eigvals((np.eye(len(A)) - L @ H) @ A)).max()) if np.isfinite(L).all() else np.inf
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


def robust_three_stage_filter(plant: Plant, known: Known, rule: str) -> Filter:
    """The filter without its decision; rule as of `robust_three_stage`."""
    propagate, inputs = propagation_of(rule, plant, known.inputs), known.inputs
    p, q = len(inputs.names), len(plant.disturbances)
    # before there is an estimate: nothing is known beyond the signals' sizes
    cov_b = np.diag([plant.estimated[i].scale ** 2 for i in inputs.estimated])
    cov_d = np.diag([s.scale**2 for s in plant.disturbances]).reshape(q, q)

    def ahead(s: RobustThreeStage, at: Interval) -> RobustThreeStage:
        none = np.zeros((len(s.x), p)), np.zeros((len(s.x), q))
        held = s.held & (s.seen == 0)  # the interval goes on
        if at.stale is not None:
            held = held | (at.stale > 0).any(axis=1)
        return predict(s, propagate((at.k - 1) * plant.dt, s.x, s.P, at.u, *none), at.noise(known.Q))._replace(held=held)

    def measured(s: RobustThreeStage, at: Interval, y: Array, seen: Array) -> RobustThreeStage:
        return update(s, y[:, known.sensors], seen[:, known.sensors], known.H, known.R)

    def read(s: RobustThreeStage) -> Reading:
        seen = np.where(s.held, 0, s.seen)  # the inputs over the interval contain what the command changed
        return Reading(s.b, s.cov_b, s.x, s.P, seen=seen, span=np.minimum(s.span, LONGEST), signals={"disturbance": s.d})

    return Filter(lambda n: start(n, known.x0, known.P0, cov_b, cov_d), ahead, measured, read, first_sample=False)


@diagnoser("robust_three_stage_cdkf", "Robust three-stage central-difference Kalman filter (RThSCDKF)", reference=True)
@diagnoser("robust_three_stage_ekf", "Robust three-stage extended Kalman filter (RThSEKF)", rule="extended")
def robust_three_stage(
    plant: Plant,
    belief: Belief,
    calibration: Calibration,
    *,
    channels: Sequence[str] | None = None,
    x0_std: Sequence[float] | None = None,
    alpha: float = 0.06,
    thresholds: Sequence[float] | None = None,
    decision: str | None = None,
    rule: str = "central difference",
) -> Diagnoser:
    """The robust three-stage filter.

    Args:
        plant: A plant whose fault enters additively and whose sensors are linear.
        belief: What it assumes of the plant where no tuning is given.
        calibration: When it alarms.
        channels: The fault channels, for example ("lon", "lat", "ped"). Default: all.
        x0_std: Standard deviations of the initial state.
        alpha, thresholds, decision: As in `baselines.filters.unknown_inputs.decided`.
        rule: Propagation, "central difference" or "extended".

    Raises:
        NotApplicableError: The existence conditions do not hold at trim (rank of H[B E], stability of (I - L H) A), or
            the plant is not of that kind.
        ValueError: Unknown rule or decision, or a list of the wrong length.
    """
    known = known_of(plant, belief, channels, {"x0_std": x0_std}, ["x0_std"])
    check_existence(plant, known.inputs, known.H, known.R)
    filter = robust_three_stage_filter(plant, known, rule)
    return decided(plant, known.inputs, filter, calibration, decision=decision, alpha=alpha, thresholds=thresholds)
