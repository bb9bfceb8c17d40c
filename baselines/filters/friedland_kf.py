"""Friedland's bias-separated filter (IEEE TAC 14, 1969).

The first two-stage filter: the bias-free state is estimated as if there were no bias at all. Optimal for a constant
bias; for a bias that moves it is not, since the bias-free covariance misses what the moving bias adds.
"""

from __future__ import annotations

import numpy as np
from numba import void

from baselines.filters.two_stage_kernels import M3, inner, product, product_with_transposed, sensitivity, symmetrise
from baselines.filters.two_stage_kf import TwoStage, decision_rule, initial_covariances, read, start
from baselines.filters.two_stage_kf import correct as two_stage_correct
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation.linear import LinearModel, linear_model, stacked
from fdi_gym.kernels import M, compiled, floats
from fdi_gym.plant import Array, Plant


@compiled(void(M, M3, M3, M, M, M, M, M3, M3, M, M3, M3))
def _predict(x, Px, V, u, A, B, E_0, E_u, Q, x1, Px1, V1):
    n, n_x, p = V.shape
    E, APx = floats((n_x, p)), floats((n_x, n_x))
    for k in range(n):
        sensitivity(E_0, E_u, u[k], E)
        product(A, V[k], V1[k])
        product(A, Px[k], APx)
        product_with_transposed(APx, A, Px1[k])
        for i in range(n_x):
            x1[k, i] = inner(A[i], x[k]) + inner(B[i], u[k])
            for j in range(p):
                V1[k, i, j] += E[i, j]
            for j in range(n_x):
                Px1[k, i, j] += Q[k % len(Q), i, j]
        symmetrise(Px1[k])


def predict(s: TwoStage, u: Array, model: LinearModel, Q: Array, Qz: Array) -> TwoStage:
    """Over the interval under the command u (n, n_u): the bias-free state as if there were no bias."""
    x, Px, V = np.empty(s.x.shape), np.empty(s.Px.shape), np.empty(s.V.shape)
    _predict(s.x, s.Px, s.V, u, *model.equations, stacked(Q), x, Px, V)
    return s._replace(x=x, Px=Px, Pz=s.Pz + Qz, V=V)


@diagnoser("friedland_kf", "Friedland's bias-separated filter")
def friedland_kf(plant: Plant, *, q_bias: float = 0.0, threshold: float = 8.0, release_after: int = 50) -> Diagnoser:
    """Friedland's filter with the distance to the labels as its decision.

    Args:
        plant: A linear plant.
        q_bias: Variance that each entry of the fault parameter gains per step; 0 is the case it was made for.
        threshold: Of the distance.
        release_after: Samples in a row with little evidence that give an alarm up.

    Raises:
        NotApplicableError: The plant is nonlinear.
    """
    model, Qz = linear_model(plant), q_bias * np.eye(len(plant.theta))
    P_x, P_z = initial_covariances(plant)
    filter = Filter(
        lambda n: start(n, len(plant.outputs), P_x, P_z),
        lambda s, at: predict(s, at.u, model, at.noise(plant.Q), Qz),
        lambda s, at, y, seen: two_stage_correct(s, y, seen, model.C, plant.R),
        read,
        first_sample=False,
    )
    return diagnoser_of(plant, filter, decision_rule(plant, "distance", threshold, release_after))
