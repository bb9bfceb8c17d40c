"""An oracle for any plant: the augmented extended Kalman filter, told when the label changes, not to what.

At every change the fault vector's covariance is the prior's again; while there is no fault the fault vector is known to
be zero. So nothing is lost on detection, and what is left is isolation and identification.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.decision import fit, manifolds
from fdi_gym.estimation.gaussian import advance, extended, start
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant

PER_FAULT = 3.84  # what each simultaneous fault must gain in fit: the 95 % point of one degree of freedom


@diagnoser("told_onset_ekf", "Augmented EKF, told when the label changes; for any plant", clairvoyant=True)
def told_onset_ekf(
    plant: Plant, *, scenarios: Sequence[FaultScenario], process: str = "standard", walk: float = 0.3
) -> Diagnoser:
    """The oracle.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        scenarios: One per episode; when the label changes, and whether a fault acts, is all that is read of them.
        process: The fault process that will be met.
        walk: Factor on the standard deviation of the faults' random walk; small, since the jumps are told.

    Raises:
        NotApplicableError: No sensor has noise, or the fault does not enter additively.
        ValueError: Unknown process; from init: the number of episodes is not that of the scenarios.
    """
    model = augmented(plant, process, walk=walk)
    groups, z = manifolds(plant), model.z
    opened = np.diag(model.prior.z_size**2)
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)
    extra = PER_FAULT * np.array([len(label.modes) for label in plant.labels])

    def init(n: int) -> Any:
        if n != len(scenarios):
            raise ValueError(f"the oracle was told of {len(scenarios)} flights, not {n}")
        longest = max(scenario.steps for scenario in scenarios)
        label = np.zeros((n, longest + 1), np.int64)
        for row, scenario in zip(label, scenarios, strict=True):
            rows = plant.label_rows(scenario)
            row[: len(rows)], row[len(rows) :] = rows, rows[-1]
        told = np.column_stack([np.zeros(n, bool), np.diff(label, axis=1) != 0])
        return start(model, n), told, label > 0

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        s, told, acts = state
        now, fault = told[:, s.k], acts[:, s.k]
        X, P = s.X.copy(), s.P.copy()
        reset = now | ~fault
        X[reset, z] = 0.0
        P[reset, z, :] = 0.0
        P[reset, :, z] = 0.0
        P[now & fault, z, z] = opened
        s = advance(model, extended, s._replace(X=X, P=P), obs)
        mode = np.zeros(len(obs), np.int64)
        if fault.any():
            fits = fit(s.X[fault, z], s.P[fault, z, z], groups)
            mode[fault] = fits.labels[np.argmin(fits.J + extra[fits.labels], axis=1)]
        theta = healthy + np.where(fault[:, None], s.X[:, z], 0.0)
        std = np.where(fault[:, None], np.sqrt(np.einsum("npp->np", s.P[:, z, z])), 0.0)
        return (s, told, acts), Diagnosis(mode > 0, mode, theta, std)

    return Diagnoser(init, update)
