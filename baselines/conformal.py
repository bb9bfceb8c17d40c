"""Any diagnoser that gives probabilities, with one answer more: "something else".

What it believes of each label is smoothed over time. A flight looks unlike anything known by what the most believed label
lacks of certainty; flights of each label say how much of that is known (`fdi_gym.estimation.conformity`). What is more, for
as long as the smoothing takes, is something else. A flight of a label that is known is called so with a probability of at
most `level` where it is decided, whichever label it is, on flights like those of the process. Nothing is promised of faults
that nobody was told of: one that a method takes for a fault that it knows, in all certainty, it does not find.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser, make_diagnoser
from fdi_gym.estimation.conformity import Conformity
from fdi_gym.plant import Array, NotApplicableError, Plant


class Smoothed(NamedTuple):
    """State: the method's own, what it believes, smoothed, and for how long no label has fitted."""

    own: Any
    belief: Array  # (n, labels); NaN before the first sample
    unknown: Array  # (n,) samples for which it has looked like nothing that is known


@diagnoser("conformal_minirocket", "minirocket that may answer something else", of="minirocket")
@diagnoser("conformal_boosted_trees", "boosted_trees that may answer something else", of="boosted_trees")
@diagnoser("conformal_residual_net", "residual_net that may answer something else", of="residual_net")
@diagnoser("conformal_sequence_net", "sequence_net that may answer something else", of="sequence_net")
@diagnoser("conformal_hypothesis_bank", "hypothesis_bank that may answer something else", of="hypothesis_bank")
@diagnoser("conformal_bayes_bank", "bayes_bank that may answer something else", of="bayes_bank")
@diagnoser("conformal_multiple_model_ekf", "multiple_model_ekf that may answer something else", of="multiple_model_ekf")
def conformal(
    plant: Plant,
    conformity: Conformity,
    *,
    of: str = "multiple_model_ekf",
    process: str = "standard",
    pace: float = 0.05,
    level: float = 0.05,
) -> Diagnoser:
    """The method with its answer more.

    Its `label_probs` are what is believed; "something else" has the share that no label excludes: one less the p-value.

    Args:
        plant: A plant with a label for faults that nobody is told of, the last one.
        conformity: How unlike anything known flights of each label look.
        of: The method.
        process: The fault process, of those that are known, that it is told of.
        pace: Of the smoothing, as a share of the process's flights.
        level: The p-value up to which a flight is none that is known.

    Raises:
        NotApplicableError: The method cannot run on this plant, or gives no probabilities.
        ValueError: A pace or a level that is not between 0 and 1.
    """
    for name, value in (("pace", pace), ("level", level)):
        if not 0.0 < value < 1.0:
            raise ValueError(f"{name} is a number between 0 and 1, not {value}")
    method = make_diagnoser(of, plant, process=process)
    steps = plant.process("fault-free").sample(np.random.default_rng(0)).steps
    lasts = max(1, round(pace * steps))
    keep, other = 1.0 - 1.0 / lasts, len(plant.labels) - 1
    first = np.array([[s.nominal for s in plant.observed]])
    if method.update(method.init(1), first)[1].label_probs is None:
        raise NotApplicableError(f"{of} gives no probabilities")

    def init(n: int) -> Smoothed:
        return Smoothed(method.init(n), np.full((n, other), np.nan), np.zeros(n, np.int64))

    def update(s: Smoothed, obs: Array) -> tuple[Smoothed, Diagnosis]:
        own, said = method.update(s.own, obs)
        assert said.label_probs is not None
        now = said.label_probs[:, :other]
        belief = np.where(np.isnan(s.belief), now, keep * s.belief + (1.0 - keep) * now)
        unlike = 1.0 - belief.max(axis=1)
        p = conformity.p_value(unlike)
        unknown = np.where(p <= level, s.unknown + 1, 0)
        found = said._replace(
            alarm=said.alarm | (unknown >= lasts),
            label=np.where(unknown >= lasts, other, np.maximum(said.label, 0)),  # -1 where it was lost: so is this
            label_probs=np.column_stack([p[:, None] * belief, 1.0 - p]),
            signals={**(said.signals or {}), "unlike": unlike},
        )  # fmt: skip
        return Smoothed(own, belief, unknown), found

    return Diagnoser(init, update, method.gaps)
