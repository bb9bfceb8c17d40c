"""The optimal three-stage Kalman filter: state, fault and disturbance, decoupled by the U-V transformation.

The joint covariance of state x, fault b and disturbance d is V blkdiag(Px, Pb, Pd) V' with
V = [[I, V12, V13], [0, I, V23], [0, 0, I]]. The three stages carry the decoupled estimates and covariances and the
couplings; together they are exactly the Kalman filter of the augmented state [x; b; d] in which b and d are random
walks. For a nonlinear plant the propagation rule supplies mean, spread and Jacobians, at the full estimates with the
spread of the decoupled state. A prediction is a three-stage state too, with U in place of V.

Letters and order of the lines as in Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021, Table 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from baselines.filters.propagation import Propagated, propagation_of
from baselines.filters.unknown_inputs import Known, decided, known_of
from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, right_divide, symmetric, times
from fdi_gym.plant import Array, Plant


class ThreeStage(NamedTuple):
    """State of the filter: decoupled estimates, their covariances, the couplings, and the optimal filter's innovation."""

    x: Array  # (n, n_x)
    b: Array  # (n, p)
    d: Array  # (n, q)
    Px: Array  # (n, n_x, n_x)
    Pb: Array  # (n, p, p)
    Pd: Array  # (n, q, q)
    V12: Array  # (n, n_x, p)
    V13: Array  # (n, n_x, q)
    V23: Array  # (n, p, q)
    nu: Array  # (n, m)
    S: Array  # (n, m, m)
    seen: Array  # (n,) sensors in it

    def estimates(self) -> tuple[Array, Array, Array]:
        """xhat, bhat, dhat: the optimal estimates."""
        return (
            self.x + times(self.V12, self.b) + times(self.V13, self.d),
            self.b + times(self.V23, self.d),
            self.d,
        )

    def covariances(self) -> tuple[Array, Array]:
        """cov(xhat), cov(bhat)."""
        return (
            self.Px + self.V12 @ self.Pb @ T(self.V12) + self.V13 @ self.Pd @ T(self.V13),
            self.Pb + self.V23 @ self.Pd @ T(self.V23),
        )


def start(n: int, x0: Array, P0x: Array, P0b: Array, P0d: Array, R: Array) -> ThreeStage:
    """The filter before its first measurement: no fault, no disturbance, nothing coupled."""
    n_x, p, q = len(P0x), len(P0b), len(P0d)
    return ThreeStage(
        np.tile(x0, (n, 1)), np.zeros((n, p)), np.zeros((n, q)),
        np.tile(P0x, (n, 1, 1)), np.tile(P0b, (n, 1, 1)), np.tile(P0d, (n, 1, 1)),
        np.zeros((n, n_x, p)), np.zeros((n, n_x, q)), np.zeros((n, p, q)),
        np.zeros((n, len(R))), np.tile(R, (n, 1, 1)), np.zeros(n, np.int64),
    )  # fmt: skip


def predict(
    s: ThreeStage,
    f: Propagated,
    Q: Array,
    Qb: Array,
    Qd: Array,
    *,
    Qxb: Array | float = 0.0,
    Qxd: Array | float = 0.0,
    Qbd: Array | float = 0.0,
) -> ThreeStage:
    """The time update.

    Args:
        s: The filter.
        f: The propagation of its full estimates, with spread Px (the decoupled covariance).
        Q, Qb, Qd: Covariances per step of process, fault walk and disturbance walk.
        Qxb, Qxd, Qbd: Their cross covariances.
    """
    b, d, Pb, Pd = s.b, s.d, s.Pb, s.Pd
    AV = f.carry(np.concatenate([s.V12, s.V13], axis=2))
    W12 = AV[..., : b.shape[1]] + f.B
    W13 = AV[..., b.shape[1] :] + f.B @ s.V23 + f.E
    W23 = s.V23
    Pd_ = Pd + Qd
    W23Pd, W13Pd = W23 @ Pd, W13 @ Pd
    U23 = right_divide(W23Pd + Qbd, Pd_)
    U13 = right_divide(W13Pd + Qxd, Pd_)
    Pb_ = symmetric(Pb + Qb + W23Pd @ T(W23) - U23 @ Pd_ @ T(U23))
    W12Pb, U13Pd_ = W12 @ Pb, U13 @ Pd_
    U12 = right_divide(W12Pb + W13Pd @ T(W23) + Qxb - U13Pd_ @ T(U23), Pb_)
    Px_ = symmetric(f.P + Q + W12Pb @ T(W12) + W13Pd @ T(W13) - U12 @ Pb_ @ T(U12) - U13Pd_ @ T(U13))
    b = b + times(W23 - U23, d)
    x = f.x - times(U12, b) - times(U13, d)
    return s._replace(x=x, b=b, Px=Px_, Pb=Pb_, Pd=Pd_, V12=U12, V13=U13, V23=U23)


def update(
    s: ThreeStage, y: Array, seen: Array, H: Array, R: Array, *, By: Array | float = 0.0, Ey: Array | float = 0.0
) -> ThreeStage:
    """The measurement update, stage by stage, with the sensors that reported.

    Args:
        s: The prediction.
        y, seen: The measurement (n, m), and which sensors reported.
        H, R: Output matrix (m, n_x) and covariance of the sensors.
        By, Ey: Direct feed-through of fault (m, p) and disturbance (m, q) into the sensors.
    """
    x, b, d, Px_, Pb_, Pd_, U12, U13, U23, *_ = s
    S2, S3 = H @ U12 + By, H @ U13 + Ey + (By @ U23 if np.ndim(By) else 0.0)
    PxHt = Px_ @ H.T
    r1, C1, PxHt, S2t, S3t = masked(seen, y - times(H, x), H @ PxHt + R, PxHt, T(S2), T(S3))
    S2, S3 = T(S2t), T(S3t)
    # state stage
    Kx = right_divide(PxHt, C1)
    x, Px = x + times(Kx, r1), symmetric(Px_ - Kx @ T(PxHt))
    # fault stage
    PbS2t = Pb_ @ S2t
    C2 = C1 + S2 @ PbS2t
    Kb = right_divide(PbS2t, C2)
    r2 = r1 - times(S2, b)
    b, Pb = b + times(Kb, r2), symmetric(Pb_ - Kb @ T(PbS2t))
    # disturbance stage
    PdS3t = Pd_ @ S3t
    C3 = C2 + S3 @ PdS3t
    Kd = right_divide(PdS3t, C3)
    r3 = r2 - times(S3, d)
    d, Pd = d + times(Kd, r3), symmetric(Pd_ - Kd @ T(PdS3t))
    # couplings
    V12 = U12 - Kx @ S2
    V13 = U13 - V12 @ (Kb @ S3) - Kx @ S3
    V23 = U23 - Kb @ S3
    return ThreeStage(x, b, d, Px, Pb, Pd, V12, V13, V23, r3, C3, seen.sum(axis=1))


def three_stage_filter(plant: Plant, known: Known, rule: str) -> Filter:
    """The filter without its decision; rule as of `three_stage`."""
    propagate = propagation_of(rule, plant, known.inputs)

    def begin(n: int) -> ThreeStage:
        return start(n, known.x0, known.P0, known.P0b, known.P0d, known.R)

    def ahead(s: ThreeStage, at: Interval) -> ThreeStage:
        x, b, d = s.estimates()
        return predict(s, propagate((at.k - 1) * plant.dt, x, s.Px, at.u, b, d), at.noise(known.Q), known.Qb, known.Qd)

    def measured(s: ThreeStage, at: Interval, y: Array, seen: Array) -> ThreeStage:
        return update(s, y[:, known.sensors], seen[:, known.sensors], known.H, known.R)

    def read(s: ThreeStage) -> Reading:
        (x, b, d), (Px, Pb) = s.estimates(), s.covariances()
        return Reading(b, Pb, x, Px, s.nu, s.S, s.seen, signals={"disturbance": d})

    return Filter(begin, ahead, measured, read, first_sample=False)


@diagnoser("three_stage_cdkf", "Three-stage central-difference Kalman filter (ThSCDKF)", reference=True)
@diagnoser("three_stage_ekf", "Three-stage extended Kalman filter (ThSEKF)", rule="extended")
def three_stage(
    plant: Plant,
    belief: Belief,
    calibration: Calibration,
    *,
    channels: Sequence[str] | None = None,
    x0_std: Sequence[float] | None = None,
    b0_std: float | Sequence[float] | None = None,
    d0_std: float | Sequence[float] | None = None,
    b_step: float | Sequence[float] | None = None,
    d_step: float | Sequence[float] | None = None,
    alpha: float = 0.2,
    thresholds: Sequence[float] | None = None,
    decision: str | None = None,
    rule: str = "central difference",
) -> Diagnoser:
    """The optimal three-stage filter.

    Args:
        plant: A plant whose fault enters additively, whose sensors are linear, and which has an unknown disturbance.
        belief: What it assumes of the plant where no tuning is given.
        calibration: When it alarms.
        channels: The fault channels, for example ("lon", "lat", "ped"). Default: all.
        x0_std: Standard deviations of the initial state.
        b0_std, d0_std: Of the initial fault and disturbance, in the data sheet's units; one, or one per entry.
        b_step, d_step: Standard deviations of their random walks per step, likewise.
        alpha, thresholds, decision: As in `baselines.filters.unknown_inputs.decided`.
        rule: Propagation, "central difference" or "extended".

    Raises:
        NotApplicableError: The plant is not of that kind, or has no unknown input.
        ValueError: Unknown rule or decision, or a list of the wrong length.
    """
    if not plant.disturbances:
        raise NotApplicableError(f"no unknown input: {plant.id} has no disturbance for the third stage")
    given = {"x0_std": x0_std, "b0_std": b0_std, "d0_std": d0_std, "b_step": b_step, "d_step": d_step}
    known = known_of(plant, belief, channels, given)
    filter = three_stage_filter(plant, known, rule)
    return decided(plant, known.inputs, filter, calibration, decision=decision, alpha=alpha, thresholds=thresholds)
