"""Two-stage Kalman filter for bias faults, with and without forgetting.

The state is estimated as if there were no fault, the fault parameter from what that leaves unexplained, and the two are
coupled through the sensitivity V; together they are exactly the Kalman filter of the augmented state [1, 2]. Forgetting
keeps the covariance of the fault parameter from shrinking to nothing, so that later faults are still seen [3, 4].

[1] J. Y. Keller, M. Darouach, Automatica 33(9), 1997. [2] C.-S. Hsieh, F.-C. Chen, IEEE TAC 44, 1999.
[3] N. E. Wu, Y. Zhang, K. Zhou, Int. J. Adaptive Control and Signal Processing 14, 2000.
[4] J. E. Parkum, N. K. Poulsen, J. Holst, Int. J. Control 55, 1992.
Equation numbers: A. Guven, C. Hajiyev, WSEAS Transactions on Signal Processing 19, 2023, as repaired in the data sheet.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, diagnoser
from fdi_gym.estimation.decision import (
    Logic,
    distance_logic,
    penalty_logic,
    persistence_logic,
    surface_candidate,
    with_logic,
)
from fdi_gym.estimation.kalman import T, right_divide, solve, symmetric, times
from fdi_gym.estimation.linear import LinearModel, linear_model
from fdi_gym.plant import Array, Plant

FORGETTING = ("none", "directional", "exponential")


class TwoStage(NamedTuple):
    """State of the filter: the bias-free state and the fault parameter's deviation from healthy, with their coupling."""

    x: Array  # (n, n_x) bias-free state
    Px: Array  # (n, n_x, n_x)
    z: Array  # (n, p) fault parameter
    Pz: Array  # (n, p, p)
    V: Array  # (n, n_x, p) coupling
    nu: Array  # (n, n_y) innovation of the optimal filter
    S: Array  # (n, n_y, n_y) its covariance

    def state(self) -> Array:
        """The optimal state estimate x + V z, eq. 40."""
        return self.x + times(self.V, self.z)

    def covariance(self) -> Array:
        """Its covariance Px + V Pz V', eq. 41."""
        return self.Px + self.V @ self.Pz @ T(self.V)


def start(n: int, n_y: int, P_x: Array, P_z: Array) -> TwoStage:
    """The filter before its first measurement."""
    n_x, p = len(P_x), len(P_z)
    return TwoStage(
        np.zeros((n, n_x)), np.tile(P_x, (n, 1, 1)), np.zeros((n, p)), np.tile(P_z, (n, 1, 1)),
        np.zeros((n, n_x, p)), np.zeros((n, n_y)), np.tile(np.eye(n_y), (n, 1, 1)),
    )  # fmt: skip


def forget(Pz: Array, rule: str, factor: float, a_min: float, a_max: float) -> Array:
    """The time update of the fault parameter's covariance under forgetting, eigenvalue by eigenvalue.

    "directional" (bounded): a -> a_min + a (a_max - a_min) / a_max below a_max. "exponential" (capped): a -> a / factor
    up to a_max. An eigenvalue above a_max stays. "none": nothing happens.

    Below the cap both rules are linear in Pz and need no eigenvalues; the Frobenius norm bounds the largest one.
    """
    if rule == "none":
        return Pz
    if rule == "directional":
        limit, aged = a_max, a_min * np.eye(Pz.shape[-1]) + Pz * ((a_max - a_min) / a_max)
    else:
        limit, aged = factor * a_max, Pz / factor
    capped = (Pz * Pz).sum(axis=(1, 2)) > limit * limit
    if capped.any():
        a, e = np.linalg.eigh(symmetric(Pz[capped]))
        if rule == "directional":
            a = np.where(a <= a_max, a_min + a * (a_max - a_min) / a_max, a)
        else:
            a = np.maximum(a, np.minimum(a / factor, a_max))
        aged[capped] = (e * a[:, None, :]) @ T(e)
    return aged


def aging(
    plant: Plant, q_bias: float, forgetting: str, factor: float, a_min: float, a_max: float
) -> Callable[[Array], Array]:
    """The time update Pz -> Pz- of a filter: forgetting, then a random walk of variance q_bias per step.

    Raises:
        ValueError: Unknown forgetting rule.
    """
    if forgetting not in FORGETTING:
        raise ValueError(f"unknown forgetting {forgetting!r}; there are {', '.join(FORGETTING)}")
    Qz = q_bias * np.eye(len(plant.theta))

    def aged(Pz: Array) -> Array:
        forgotten = forget(Pz, forgetting, factor, a_min, a_max)
        return forgotten + Qz if q_bias else forgotten

    return aged


def step(s: TwoStage, u: Array, y: Array, model: LinearModel, Q: Array, R: Array, Pz_minus: Array) -> TwoStage:
    """One step with the command u_k (n, n_u) and the measurement y_{k+1} (n, n_y), eqs. 24 to 41."""
    A, B, C = model.A, model.B, model.C
    W = A @ s.V + model.E(u)
    WPz = W @ s.Pz
    V = W if Pz_minus is s.Pz else right_divide(WPz, Pz_minus)
    H = C @ V
    x = times(A, s.x) + times(B, u) + times(W - V, s.z)
    # W Pz W' - V Pz- V', with V Pz- = W Pz
    Px = symmetric(A @ s.Px @ A.T + Q + WPz @ T(W - V))
    r = y - times(C, x)
    CPx = C @ Px
    S = CPx @ C.T + R
    Kx = T(solve(S, CPx))
    x = x + times(Kx, r)
    Px = symmetric(Px - Kx @ CPx)
    HPz = H @ Pz_minus
    Sz = HPz @ T(H) + S
    Kz = T(solve(Sz, HPz))
    nu = r - times(H, s.z)
    z = s.z + times(Kz, nu)
    Pz = symmetric(Pz_minus - Kz @ HPz)
    return TwoStage(x, Px, z, Pz, V - Kx @ H, nu, Sz)


def make_logic(plant: Plant, decision: str, threshold: float, release_after: int) -> Logic:
    """The decision logic by name; for plants with simultaneous-fault labels always the penalty logic.

    Raises:
        ValueError: Unknown name.
    """
    if decision == "thresholds":
        return persistence_logic(plant, surface_candidate(plant, position={"aileron": 1.5, "rudder": 0.5}))
    if decision != "distance":
        raise ValueError(f"unknown decision {decision!r}; there are distance, thresholds")
    if any(len(label.modes) > 1 for label in plant.labels):
        return penalty_logic(plant, penalty=threshold)
    return distance_logic(plant, threshold=threshold, release_after=release_after)


def prior(plant: Plant) -> tuple[Array, Array]:
    """Initial covariances of state and fault parameter: 0.01 I, and 1 for an effectiveness, 4 for a position."""
    return 0.01 * np.eye(len(plant.states)), np.diag([4.0 if s.unit else 1.0 for s in plant.theta])


@diagnoser("two_stage_kf", "Two-stage Kalman filter, constant bias")
@diagnoser("two_stage_kf_random_walk", "Two-stage Kalman filter, random-walk bias", q_bias=1e-4)
@diagnoser("two_stage_kf_directional", "Two-stage Kalman filter, directional forgetting", forgetting="directional")
@diagnoser("two_stage_kf_exponential", "Two-stage Kalman filter, exponential forgetting", forgetting="exponential")
@diagnoser("two_stage_kf_exponential_fast", "The same, forgetting 0.96 and quick decisions: for intermittent faults",
           forgetting="exponential", factor=0.96, threshold=3.0, release_after=10)  # fmt: skip
@diagnoser("two_stage_kf_thresholds", "Two-stage Kalman filter, directional forgetting, fixed thresholds",
           forgetting="directional", decision="thresholds")  # fmt: skip
def two_stage_kf(
    plant: Plant,
    *,
    q_bias: float = 0.0,
    forgetting: str = "none",
    factor: float = 0.99,
    a_min: float = 1e-4,
    a_max: float = 1.0,
    decision: str = "distance",
    threshold: float = 8.0,
    release_after: int = 50,
    structured: bool = False,
) -> Diagnoser:
    """The two-stage Kalman filter with a decision logic.

    Args:
        plant: A linear plant.
        q_bias: Variance that each entry of the fault parameter gains per step (random walk).
        forgetting: "none", "directional" or "exponential".
        factor: Forgetting factor of the exponential rule.
        a_min: Floor increment of the directional rule.
        a_max: Cap of both rules.
        decision: "distance" or "thresholds" (fixed thresholds per surface).
        threshold: Of the distance logic; with simultaneous-fault labels the penalty per fault.
        release_after: Of the distance logic, samples.
        structured: Report the magnitude of the declared fault in place of the free estimate.

    Raises:
        NotApplicableError: The plant is nonlinear.
        ValueError: Unknown forgetting rule or decision.
    """
    aged = aging(plant, q_bias, forgetting, factor, a_min, a_max)
    model = linear_model(plant)
    P_x, P_z = prior(plant)

    def advance(s: TwoStage, u: Array, y: Array) -> TwoStage:
        return step(s, u, y, model, plant.Q, plant.R, aged(s.Pz))

    logic = make_logic(plant, decision, threshold, release_after)
    return with_logic(plant, lambda n: start(n, len(plant.outputs), P_x, P_z), advance, logic, structured)
