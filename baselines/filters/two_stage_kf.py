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

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from baselines.filters import two_stage_kernels as kernels
from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation.calibration import Persistence, uniform
from fdi_gym.estimation.decision import Reading, Rule, by_candidate, by_labels
from fdi_gym.estimation.linear import LinearModel, linear_model, stacked
from fdi_gym.estimation.sweep import Age
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant

WARMUP = 150  # samples without a decision: the filter converges
FORGETTING = ("none", "directional", "exponential")  # in the order of the kernels' numbers


class TwoStage(NamedTuple):
    """State of the filter: the bias-free state and the fault parameter's deviation from healthy, with their coupling."""

    x: Array  # (n, n_x) bias-free state
    Px: Array  # (n, n_x, n_x)
    z: Array  # (n, p) fault parameter
    Pz: Array  # (n, p, p)
    V: Array  # (n, n_x, p) coupling
    nu: Array  # (n, n_y) innovation of the optimal filter
    S: Array  # (n, n_y, n_y) its covariance
    seen: Array  # (n,) sensors in it

    def optimal(self) -> tuple[Array, Array]:
        """The optimal state estimate (n, n_x) and its covariance (n, n_x, n_x), eqs. 40 and 41."""
        X, P = np.empty(self.x.shape), np.empty(self.Px.shape)
        kernels.optimal(self.x, self.Px, self.z, self.Pz, self.V, X, P)
        return X, P


def start(n: int, n_y: int, P_x: Array, P_z: Array) -> TwoStage:
    """The filter before its first measurement."""
    n_x, p = len(P_x), len(P_z)
    return TwoStage(
        np.zeros((n, n_x)), np.tile(P_x, (n, 1, 1)), np.zeros((n, p)), np.tile(P_z, (n, 1, 1)),
        np.zeros((n, n_x, p)), np.zeros((n, n_y)), np.tile(np.eye(n_y), (n, 1, 1)), np.zeros(n, np.int64),
    )  # fmt: skip


def forget(Pz: Array, rule: str, factor: float, a_min: float, a_max: float, q_bias: float = 0.0) -> Array:
    """The time update of the fault parameter's covariance (n, p, p): forgetting, then a random walk.

    Eigenvalue by eigenvalue: "directional" (bounded): a -> a_min + a (a_max - a_min) / a_max below a_max. "exponential"
    (capped): a -> a / factor up to a_max. An eigenvalue above a_max stays. "none": nothing happens.

    Below the cap both rules are linear in Pz and need no eigenvalues; the Frobenius norm bounds the largest one.
    """
    if rule == "none" and not q_bias:
        return Pz
    aged = np.empty(Pz.shape)
    kernels.forget(contiguous(Pz), FORGETTING.index(rule), factor, a_min, a_max, q_bias, aged)
    return aged


def aging(q_bias: float, forgetting: str, factor: float, a_min: float, a_max: float) -> Callable[[Array], Array]:
    """The time update Pz -> Pz- of a filter: forgetting, then a random walk of variance q_bias per step.

    Raises:
        ValueError: Unknown forgetting rule.
    """
    if forgetting not in FORGETTING:
        raise ValueError(f"unknown forgetting {forgetting!r}; there are {', '.join(FORGETTING)}")
    return lambda Pz: forget(Pz, forgetting, factor, a_min, a_max, q_bias)


def age(q_bias: float, forgetting: str, factor: float, a_min: float, a_max: float) -> Age | None:
    """The same as a step of a sweep; None where nothing ages."""
    constants = np.array([FORGETTING.index(forgetting), factor, a_min, a_max, q_bias])
    return Age(kernels.forget_lanes, constants) if forgetting != "none" or q_bias else None


def predict(s: TwoStage, u: Array, model: LinearModel, Q: Array, Pz_minus: Array) -> TwoStage:
    """Over the interval under the command u_k (n, n_u), eqs. 24 to 31; Pz_minus (n, p, p) is the aged Pz."""
    x, Px, V = np.empty(s.x.shape), np.empty(s.Px.shape), np.empty(s.V.shape)
    kernels.predict(
        s.x, s.Px, s.z, s.Pz, s.V, Pz_minus, Pz_minus is s.Pz, u, *model.equations, stacked(Q), x, Px, V
    )  # fmt: skip
    return TwoStage(x, Px, s.z, Pz_minus, V, s.nu, s.S, s.seen)


def correct(s: TwoStage, y: Array, seen: Array, C: Array, R: Array) -> TwoStage:
    """With the measurement y_{k+1} of the sensors that reported (n, n_y), eqs. 32 to 41."""
    new = TwoStage(*map(np.empty_like, s))
    kernels.correct(s.x, s.Px, s.z, s.Pz, s.V, y, seen, C, contiguous(R), *new)
    return new


def read(s: TwoStage) -> Reading:
    """What the filter knows."""
    return Reading(s.z, s.Pz, *s.optimal(), s.nu, s.S, s.seen)


def two_stage_filter(plant: Plant, aged: Callable[[Array], Array]) -> Filter:
    """The filter of a linear plant, with the time update `aged` of the fault parameter's covariance."""
    model = linear_model(plant)
    P_x, P_z = initial_covariances(plant)
    return Filter(
        lambda n: start(n, len(plant.outputs), P_x, P_z),
        lambda s, at: predict(s, at.u, model, at.noise(plant.Q), aged(s.Pz)),
        lambda s, at, y, seen: correct(s, y, seen, model.C, plant.R),
        read,
        first_sample=False,
    )


def surface_candidate(
    plant: Plant, position: Mapping[str, float], loss: float = 0.4, total: float = 0.8
) -> Callable[[Reading, Array], Array]:
    """Fixed thresholds on the effectiveness and position of each control surface.

    The surface with the largest max(-gamma / loss, |b| / position) is faulty where that exceeds 1: stuck if
    -gamma > total or |b| exceeds its position limit, else LOE. For plants whose estimate has the entries gamma_<surface>
    and b_<surface> and whose modes are "<surface> LOE" and "<surface> stuck".
    """
    names = [s.name for s in plant.estimated]
    gamma = [names.index(f"gamma_{surface}") for surface in position]
    b = [names.index(f"b_{surface}") for surface in position]
    limit = np.array(list(position.values()))
    lost = np.array([plant.label_of(frozenset({f"{surface} LOE"})) for surface in position])
    stuck = np.array([plant.label_of(frozenset({f"{surface} stuck"})) for surface in position])

    def candidate(r: Reading, label: Array) -> Array:
        assert r.z is not None
        loss_of, place = -r.z[:, gamma], np.abs(r.z[:, b])
        severity = np.maximum(loss_of / loss, place / limit)
        s = np.argmax(severity, axis=1)
        i = np.arange(len(r.z))
        is_stuck = (loss_of[i, s] > total) | (place[i, s] > limit[s])
        return np.where(severity[i, s] <= 1, 0, np.where(is_stuck, stuck[s], lost[s]))

    return candidate


def decision_rule(
    plant: Plant, decision: str, threshold: float, release_after: int, position: Mapping[str, float] | None = None,
    structured: bool = False,
) -> Rule:  # fmt: skip
    """The decision by name; with labels of simultaneous faults the threshold is a penalty per fault.

    Raises:
        NotApplicableError: Fixed thresholds, and no positions for the plant's surfaces.
        ValueError: Unknown name.
    """
    if decision == "thresholds":
        if not position:
            raise NotApplicableError(
                f"fixed thresholds need the position of each surface that is stuck; {plant.id} has none"
            )
        return by_candidate(surface_candidate(plant, position), 20, WARMUP)
    if decision != "distance":
        raise ValueError(f"unknown decision {decision!r}; there are distance, thresholds")
    after = Persistence(5, 10, release_after, WARMUP)
    if any(len(label.modes) > 1 for label in plant.labels):
        after = Persistence(10, 10, 10, WARMUP, same=True)
    return by_labels(plant, uniform(plant, threshold, after), on_line=structured)


def initial_covariances(plant: Plant) -> tuple[Array, Array]:
    """Of state and fault parameter: 0.01 I, and 1 for an effectiveness, 4 for a position."""
    return 0.01 * np.eye(len(plant.states)), np.diag([4.0 if s.unit else 1.0 for s in plant.theta])


@diagnoser("two_stage_kf", "Two-stage Kalman filter, constant bias", reference=True)
@diagnoser("two_stage_kf_random_walk", "Two-stage Kalman filter, random-walk bias", q_bias=1e-4)
@diagnoser("two_stage_kf_directional", "Two-stage Kalman filter, directional forgetting", forgetting="directional")
@diagnoser(
    "two_stage_kf_exponential", "Two-stage Kalman filter, exponential forgetting", reference=True, forgetting="exponential"
)
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
    position: Mapping[str, float] | None = None,
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
        position: Of the fixed thresholds: position of each surface that counts as stuck.
        structured: Report the magnitude of the declared fault in place of the free estimate.

    Raises:
        NotApplicableError: The plant is nonlinear, or fixed thresholds have no positions.
        ValueError: Unknown forgetting rule or decision.
    """
    filter = two_stage_filter(plant, aging(q_bias, forgetting, factor, a_min, a_max))
    return diagnoser_of(plant, filter, decision_rule(plant, decision, threshold, release_after, position, structured))
