"""Two-stage extended Kalman filter for any plant: linearised anew at every sample, equal to the augmented extended filter.

State and disturbance are estimated as if there were no fault, the fault vector from what that leaves unexplained, and the
sensitivity V couples them: x = xb + V z. Linearised at the full estimate, the two stages carry exactly the augmented
filter's mean and covariance in decoupled form.

J. Y. Keller, M. Darouach, Automatica 33(9), 1997; C.-S. Hsieh, F.-C. Chen, IEEE TAC 44, 1999, made time-varying.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, right_divide, symmetric, times
from fdi_gym.plant import Array, Plant


class TwoStage(NamedTuple):
    """State of the filter."""

    x: Array  # (n, N) bias-free state and disturbance
    Px: Array  # (n, N, N)
    z: Array  # (n, p) fault vector
    Pz: Array  # (n, p, p)
    V: Array  # (n, N, p)
    nu: Array  # (n, m) innovation of the optimal filter
    S: Array  # (n, m, m)
    seen: Array  # (n,) sensors in it

    def state(self) -> Array:
        """The optimal estimate of state and disturbance (n, N)."""
        return self.x + times(self.V, self.z)

    def covariance(self) -> Array:
        """Its covariance (n, N, N)."""
        return self.Px + self.V @ self.Pz @ T(self.V)


def two_stage_filter(model: AugmentedModel, first_sample: bool = True) -> Filter:
    """The two-stage filter of an augmented model."""
    rest, zs, N = model.rest, model.z, len(model.scale)
    Q, Qz, P0 = model.Q[np.ix_(rest, rest)], model.Q[zs, zs], model.P0[np.ix_(rest, rest)]

    def start(n: int) -> TwoStage:
        p, m = zs.stop - zs.start, len(model.R)
        return TwoStage(
            np.tile(model.X0[rest], (n, 1)), np.tile(P0, (n, 1, 1)), np.zeros((n, p)), np.tile(model.P0[zs, zs], (n, 1, 1)),
            np.zeros((n, len(rest), p)), np.zeros((n, m)), np.tile(model.R, (n, 1, 1)), np.zeros(n, np.int64),
        )  # fmt: skip

    def full(s: TwoStage) -> Array:
        X = np.empty((len(s.x), N))
        X[:, rest], X[:, zs] = s.state(), s.z
        return X

    def predict(s: TwoStage, at: Interval) -> TwoStage:
        X, F = model.jacobian_f(full(s), at)
        A, E = F[:, rest][:, :, rest], F[:, rest][:, :, zs]
        U = A @ s.V + E
        UPz = U @ s.Pz
        P = symmetric(A @ s.Px @ T(A) + UPz @ T(U)) + at.noise(Q)
        aged = s.Pz + Qz
        shrink = np.sqrt(np.minimum(1.0, model.limit[zs] / np.maximum(np.einsum("npp->np", aged), 1e-300)))
        Pz = shrink[:, :, None] * aged * shrink[:, None, :]
        cross = UPz * shrink[:, None, :]
        V = right_divide(cross, Pz)
        return s._replace(x=X[:, rest] - times(V, s.z), Px=symmetric(P - V @ T(cross)), Pz=Pz, V=V)

    def update(s: TwoStage, at: Interval, y: Array, seen: Array) -> TwoStage:
        seen = seen[:, model.sensors]
        mean, J = model.jacobian_h(full(s), at)
        H = J[:, :, rest]
        Hz = H @ s.V + J[:, :, zs]
        cross = s.Px @ T(H)
        nu, C, cross, Hzt = masked(seen, y[:, model.sensors] - mean, H @ cross + model.R, cross, T(Hz))
        Kx = right_divide(cross, C)
        Pz_Hz = s.Pz @ Hzt
        S = C + T(Hzt) @ Pz_Hz
        Kz = right_divide(Pz_Hz, S)
        z = s.z + times(Kz, nu)
        x = s.x + times(Kx, nu + times(T(Hzt), s.z))
        return TwoStage(
            x, symmetric(s.Px - Kx @ T(cross)), z, symmetric(s.Pz - Kz @ T(Pz_Hz)), s.V - Kx @ T(Hzt), nu, S,
            seen.sum(axis=1),
        )  # fmt: skip

    def read(s: TwoStage) -> Reading:
        x = model.x
        return Reading(s.z, s.Pz, s.state()[:, x], s.covariance()[:, x, x], s.nu, s.S, s.seen)

    return Filter(start, predict, update, read, first_sample, expect=lambda s, at: model.expect(s.state()[:, model.x], at))


@diagnoser("two_stage_ekf", "Two-stage extended Kalman filter, for any plant")
def two_stage_ekf(
    plant: Plant,
    belief: Belief,
    calibration: Calibration,
    *,
    decision: str = "distance",
    walk: float = 1.0,
    x0_std: Sequence[float] | None = None,
    z0_std: Sequence[float] | None = None,
    z_walk: Sequence[float] | None = None,
    first_sample: bool = True,
) -> Diagnoser:
    """The two-stage filter; arguments and errors as of `augmented_ekf`."""
    model = augmented(plant, belief, walk=walk, x0_std=x0_std, z0_std=z0_std, z_walk=z_walk)
    return diagnoser_of(
        plant, two_stage_filter(model, first_sample), by_labels(plant, calibration, decision, size=belief.z_size)
    )
