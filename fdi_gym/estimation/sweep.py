"""An augmented filter with labels as its decision, over many samples in one compiled call.

What is said is to the bit what `fdi_gym.diagnosis.filtering` says sample by sample; only the way through Python is spared,
which costs a filter of a few states more than its equations do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.estimation import sweep_kernels
from fdi_gym.estimation.decision import Labelling
from fdi_gym.estimation.equivalent import has_equivalents
from fdi_gym.estimation.gaussian import RULES, Model
from fdi_gym.kernels import address
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant


class Swept(NamedTuple):
    """State of a filter and its decision after the last sample, and what was said of each."""

    filter: tuple[
        Array, ...
    ]  # X (n, N), P (n, N, N), nu (n, m) the last innovation, S (n, m, m), count (n,) of sensors in it
    declared: Array  # (n, 5) the automata
    waiting: Array  # (n, 2 + p)
    alarm: Array  # (n, K) bool
    label: Array  # (n, K) int16
    estimate: Array  # (n, K, p)
    std: Array  # (n, K, p)
    state: Array  # (n, K, n_x)


class Age(NamedTuple):
    """A kernel of the signature `sweep_kernels.AGE`, and its constants: what becomes of a prediction's covariance."""

    kernel: Any
    constants: Array


Sweep = Callable[..., Swept]


def sweep_of(
    plant: Plant, model: Model, rule: str, Q: Array, R: Array, decision: Labelling | None, age: Age | None = None
) -> Sweep | None:
    """The sweep of an augmented filter whose decision is `by_labels`; None where it must go sample by sample.

    That is where a statistic raises the alarm, or where measurements have equivalents to choose from.

    Args:
        plant: The plant.
        model: Its augmented model, whose magnitudes are those of `plant.estimated`.
        rule: One of `gaussian.RULES`.
        Q: Covariance (N, N) that a sample adds.
        R: Covariance (m, m) of the sensors' noise.
        decision: What the decision weighs with.
        age: What else becomes of a prediction's covariance.
    """
    if decision is None or has_equivalents(plant):
        return None
    healthy = contiguous(plant.healthy)
    noises = contiguous(Q[None]), contiguous(R[None])
    head = (RULES[rule], *model.constants, model.limit, model.linear, model.H, model.plain, *noises)
    age = Age(sweep_kernels.no_age, np.zeros(0)) if age is None else age
    metric = decision.excess if decision.metric is None else decision.metric[0]
    weighed = (
        metric, decision.metric is not None, decision.sets.labels, *decision.sets[1:], decision.penalty,
        decision.limit, decision.lengths, healthy,
    )  # fmt: skip

    def sweep(obs: Array, d: Array | None, k: Array, filter: tuple[Array, ...], declared: Array, waiting: Array) -> Swept:
        """Over obs (n, K, n_obs) with measured disturbances d (n, K, n_D), from sample k (n,) on; states as in `Swept`."""
        n, K, _ = obs.shape
        steps = np.array([address(kernel) for kernel in (*sweep_kernels.STEPS, age.kernel)])
        known = np.zeros((n, K, len(plant.disturbances))) if d is None else contiguous(d)
        *after, declared, waiting = (np.array(a, order="C") for a in (*filter, declared, waiting))
        alarm, label, state = np.empty((n, K), bool), np.empty((n, K), np.int16), np.empty((n, K, len(plant.states)))
        estimate, std = np.empty((2, n, K, len(healthy)))
        sweep_kernels.sweep(
            steps, age.constants, *head, *weighed, contiguous(obs), known, k, *after, declared, waiting, alarm, label,
            estimate, std, state,
        )  # fmt: skip
        return Swept(tuple(after), declared, waiting, alarm, label, estimate, std, state)

    return sweep
