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

from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation.decision import Logic, distance_logic
from fdi_gym.estimation.kalman import T, right_divide, symmetric, times
from fdi_gym.estimation.linear import LinearModel, linear_model
from fdi_gym.plant import Array, Plant


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
    """
    if rule == "none":
        return Pz
    a, e = np.linalg.eigh(symmetric(Pz))
    if rule == "directional":
        a = np.where(a <= a_max, a_min + a * (a_max - a_min) / a_max, a)
    else:
        a = np.maximum(a, np.minimum(a / factor, a_max))
    return (e * a[:, None, :]) @ T(e)


def step(s: TwoStage, u: Array, y: Array, model: LinearModel, Q: Array, R: Array, Pz_minus: Array) -> TwoStage:
    """One step with the command u_k (n, n_u) and the measurement y_{k+1} (n, n_y), eqs. 24 to 41."""
    A, B, C = model.A, model.B, model.C
    W = A @ s.V + model.E(u)
    WPz = W @ s.Pz
    V = right_divide(WPz, Pz_minus)
    H = C @ V
    x = times(A, s.x) + times(B, u) + times(W - V, s.z)
    Px = symmetric(A @ s.Px @ A.T + Q + WPz @ T(W) - V @ Pz_minus @ T(V))
    r = y - times(C, x)
    S = C @ Px @ C.T + R
    Kx = right_divide(Px @ C.T, S)
    x = x + times(Kx, r)
    Px = symmetric(Px - Kx @ (C @ Px))
    HPz = H @ Pz_minus
    Sz = HPz @ T(H) + S
    Kz = right_divide(T(HPz), Sz)
    nu = r - times(H, s.z)
    z = s.z + times(Kz, nu)
    Pz = symmetric(Pz_minus - Kz @ HPz)
    return TwoStage(x, Px, z, Pz, V - Kx @ H, nu, Sz)


def with_logic(plant: Plant, first: Any, advance: Any, logic: Logic, structured: bool = False) -> Diagnoser:
    """A diagnoser from a filter and a decision logic.

    Args:
        plant: The plant.
        first: first(n) gives the filter's state.
        advance: advance(state, u, y) gives the next one, with the fields z and Pz.
        logic: The decision logic.
        structured: Report the magnitude along the label's own line in place of the free estimate.
    """
    nominal = plant.nominal_theta

    def init(n: int) -> Any:
        return 0, first(n), logic.start(n)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, s, decided = state
        y, u, _ = plant.split(obs)
        n = len(obs)
        if k > 0:
            s = advance(s, u, y)
            decided, said = logic.step(decided, k, s.z, s.Pz)
        else:  # no interval has ended: the filter starts from its prior
            said = None
        alarm, label = (np.zeros(n, bool), np.zeros(n, np.int64)) if said is None else said[:2]
        z = s.z if said is None or not structured else said.structured
        std = np.sqrt(np.einsum("npp->np", s.Pz))
        return (k + 1, s, decided), Diagnosis(alarm, label, nominal + z, std)

    return Diagnoser(init, update)


@diagnoser("two_stage_kf", "Two-stage Kalman filter, constant bias")
@diagnoser("two_stage_kf_random_walk", "Two-stage Kalman filter, random-walk bias", q_bias=1e-4)
@diagnoser("two_stage_kf_directional", "Two-stage Kalman filter, directional forgetting", forgetting="directional")
@diagnoser("two_stage_kf_exponential", "Two-stage Kalman filter, exponential forgetting", forgetting="exponential")
def two_stage_kf(
    plant: Plant,
    *,
    q_bias: float = 0.0,
    forgetting: str = "none",
    factor: float = 0.99,
    a_min: float = 1e-4,
    a_max: float = 1.0,
    threshold: float = 8.0,
    release_after: int = 50,
    structured: bool = False,
) -> Diagnoser:
    """The two-stage Kalman filter with the distance logic.

    Args:
        plant: A linear plant.
        q_bias: Variance that each entry of the fault parameter gains per step (random walk).
        forgetting: "none", "directional" or "exponential".
        factor: Forgetting factor of the exponential rule.
        a_min, a_max: Floor increment and cap of the forgetting rules.
        threshold: Of the distance logic.
        release_after: Of the distance logic.
        structured: Report the magnitude of the declared fault in place of the free estimate.

    Raises:
        NotApplicableError: The plant is nonlinear.
        ValueError: Unknown forgetting rule.
    """
    if forgetting not in ("none", "directional", "exponential"):
        raise ValueError(f"unknown forgetting {forgetting!r}; there are none, directional, exponential")
    model = linear_model(plant)
    Qz = q_bias * np.eye(len(plant.theta))
    P_x, P_z = prior(plant)

    def advance(s: TwoStage, u: Array, y: Array) -> TwoStage:
        return step(s, u, y, model, plant.Q, plant.R, forget(s.Pz, forgetting, factor, a_min, a_max) + Qz)

    return with_logic(
        plant, lambda n: start(n, len(plant.outputs), P_x, P_z), advance,
        distance_logic(plant, threshold=threshold, release_after=release_after), structured,
    )  # fmt: skip


def prior(plant: Plant) -> tuple[Array, Array]:
    """Initial covariances of state and fault parameter: 0.01 I, and 1 for an effectiveness, 4 for a position."""
    return 0.01 * np.eye(len(plant.states)), np.diag([4.0 if s.unit else 1.0 for s in plant.theta])
