"""Three-stage central-difference Kalman filter: state, fault and gust in three stages.

Fault and gust are random walks; the propagation is at the full estimates with the spread of the decoupled state. The
algebra is in `fdi_gym.estimation.three_stage`, the propagation rules in `fdi_gym.estimation.propagation`.

Z. Nejati et al., Int. J. Engineering, Transactions B 34(5), 2021, Table 1.
"""

from __future__ import annotations

from collections.abc import Sequence

from baselines.filters.flag_thresholds import thresholds_for
from fdi_gym.diagnosis import Diagnoser, NotApplicableError, diagnoser
from fdi_gym.estimation.propagation import Rule, central_difference_rule, extended_rule
from fdi_gym.estimation.three_stage import ThreeStage, start, step
from fdi_gym.estimation.unknown_inputs import judged, known_of
from fdi_gym.plant import Array, Plant

RULES = {"central difference": central_difference_rule, "extended": extended_rule}


@diagnoser("three_stage_cdkf", "Three-stage central-difference Kalman filter (ThSCDKF)")
def three_stage_cdkf(
    plant: Plant,
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
    process: str = "standard",
    rule: str = "central difference",
) -> Diagnoser:
    """The optimal three-stage filter.

    Args:
        plant: A plant whose fault enters additively, whose sensors are linear, and which has an unknown disturbance.
        channels: The fault channels, for example ("lon", "lat", "ped"). Default: all.
        x0_std: Standard deviations of the initial state.
        b0_std, d0_std: Of the initial fault and disturbance, in the data sheet's units; one, or one per entry.
        b_step, d_step: Standard deviations of their random walks per step, likewise.
        alpha: Smoothing of the flag logic.
        thresholds: Of the flag logic, one per channel. Default: the calibrated table, else calibrated when first used.
        decision: "flags" or "distance". Default: flags where they can tell the plant's labels apart.
        process: The fault process that will be met. Tuning that is None is what this process
            says; the helicopter brings its paper's (`Plant.tuning`).
        rule: Propagation, "central difference" or "extended".

    Raises:
        NotApplicableError: The plant is not of that kind, or has no unknown input.
        ValueError: Unknown rule, decision or process, or a list of the wrong length.
    """
    if rule not in RULES:
        raise ValueError(f"unknown rule {rule!r}; there are {', '.join(RULES)}")
    if not plant.disturbances:
        raise NotApplicableError(f"no unknown input: {plant.id} has no disturbance for the third stage")
    given = {"x0_std": x0_std, "b0_std": b0_std, "d0_std": d0_std, "b_step": b_step, "d_step": d_step}
    known = known_of(plant, channels, process, given)
    inputs, sensors, H, x0, P0, Q, R, P0b, Qb, P0d, Qd = known
    propagate: Rule = RULES[rule](plant, inputs)
    name = "three_stage_cdkf" if rule == "central difference" else "three_stage_ekf"

    def first(n: int) -> ThreeStage:
        return start(n, x0, P0, P0b, P0d)

    def advance(s: ThreeStage, t: float, u: Array, y: Array) -> ThreeStage:
        x, b, d = s.estimates()
        return step(s, propagate(t, x, s.Px, u, b, d), y.take(sensors, axis=1), H, Q, R, Qb, Qd)

    def read(s: ThreeStage) -> tuple[Array, Array]:
        return s.estimates()[1], s.fault_covariance()

    return judged(
        plant, inputs, first, advance, read, decision=decision, process=process, alpha=alpha,
        thresholds=thresholds_for(plant, name, inputs, thresholds), source=__file__, what=f"{name} {channels} {given}",
    )  # fmt: skip
