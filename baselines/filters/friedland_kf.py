"""Friedland's bias-separated filter (IEEE TAC 14, 1969).

The first two-stage filter: the bias-free state is estimated as if there were no bias at all. Optimal for a constant
bias; for a bias that moves it is not, since the bias-free covariance misses what the moving bias adds.
"""

from __future__ import annotations

import numpy as np

from baselines.filters.two_stage_kf import TwoStage, make_logic, prior, start
from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.decision import with_logic
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.estimation.linear import LinearModel, linear_model
from fdi_gym.plant import Array, Plant


def step(s: TwoStage, u: Array, y: Array, model: LinearModel, Q: Array, R: Array, Qz: Array) -> TwoStage:
    """One step with the command u_k (n, n_u) and the measurement y_{k+1} (n, n_y)."""
    A, B, C = model.A, model.B, model.C
    U = A @ s.V + model.E(u)
    H = C @ U
    x = times(A, s.x) + times(B, u)
    Px = symmetric(A @ s.Px @ A.T + Q)
    r = y - times(C, x)
    S = C @ Px @ C.T + R
    Kx = right_divide(Px @ C.T, S)
    x, Px = x + times(Kx, r), symmetric(Px - Kx @ (C @ Px))
    Pz = s.Pz + Qz
    HPz = H @ Pz
    Sz = HPz @ T(H) + S
    Kz = right_divide(T(HPz), Sz)
    nu = r - times(H, s.z)
    return TwoStage(x, Px, s.z + times(Kz, nu), symmetric(Pz - Kz @ HPz), U - Kx @ H, nu, Sz)


@diagnoser("friedland_kf", "Friedland's bias-separated filter")
def friedland_kf(plant: Plant, *, q_bias: float = 0.0, threshold: float = 8.0, release_after: int = 50) -> Diagnoser:
    """Friedland's filter with the distance logic.

    Args:
        plant: A linear plant.
        q_bias: Variance that each entry of the fault parameter gains per step; 0 is the case it was made for.
        threshold: Of the distance logic.
        release_after: Of the distance logic, samples.

    Raises:
        NotApplicableError: The plant is nonlinear.
    """
    model = linear_model(plant)
    Qz = q_bias * np.eye(len(plant.theta))
    P_x, P_z = prior(plant)

    def advance(s: TwoStage, u: Array, y: Array) -> TwoStage:
        return step(s, u, y, model, plant.Q, plant.R, Qz)

    logic = make_logic(plant, "distance", threshold, release_after)
    return with_logic(plant, lambda n: start(n, len(plant.outputs), P_x, P_z), advance, logic)
