"""The guard under which a diagnoser runs: one bad sample or one lost filter never reaches another episode or ends a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from fdi_gym.diagnosis.contract import Diagnoser, Diagnosis, choose, map_arrays
from fdi_gym.plant import Array, Plant, contiguous

LARGE = 1e12  # an estimate beyond it, in units of its scale, has left the numbers
SUM = 1e-6  # by which probabilities may miss 1


def checked(plant: Plant, n: int, diagnosis: Diagnosis) -> Diagnosis:
    """The diagnosis with its arrays in their declared types.

    Raises:
        ValueError: A shape or a type that no diagnosis has, or a label that the plant does not have; the field is named.
    """
    if not isinstance(diagnosis, Diagnosis):
        raise ValueError(f"update returns (state, Diagnosis), not a {type(diagnosis).__name__}")
    alarm, label = np.asarray(diagnosis.alarm), np.asarray(diagnosis.label)
    for name, value, kinds in (("alarm", alarm, "b"), ("label", label, "iu")):
        if value.shape != (n,) or value.dtype.kind not in kinds:
            what = "bool" if kinds == "b" else "integer"
            raise ValueError(f"a diagnosis has {name} of shape {(n,)} and {what}, not {value.shape} of {value.dtype}")
    labels = len(plant.labels)
    if ((label < 0) | (label >= labels)).any():
        wrong = label[(label < 0) | (label >= labels)][0]
        raise ValueError(f"a diagnosis has labels in 0..{labels - 1}, not {int(wrong)}")
    widths = {
        "estimate": len(plant.estimated), "estimate_std": len(plant.estimated), "label_probs": labels,
        "state": len(plant.states),
    }  # fmt: skip
    found: dict[str, Any] = {}
    for name, width in widths.items():
        value = getattr(diagnosis, name)
        if value is None:
            continue
        value = np.asarray(value)
        if value.shape != (n, width) or value.dtype.kind not in "iuf":
            raise ValueError(
                f"a diagnosis has {name} of shape {(n, width)} and numbers, or None, not {value.shape} of {value.dtype}"
            )
        found[name] = value.astype(float)
    return diagnosis._replace(alarm=alarm, label=label.astype(np.int64), **found)


def invalid(plant: Plant, said: Diagnosis) -> Array:
    """Where a checked diagnosis holds what cannot be (n,): such an episode is lost.

    An estimate or a state that is not finite or beyond all bounds, a negative standard deviation, probabilities that are
    negative, not finite or do not sum to 1.
    """
    wrong = np.zeros(len(said.label), bool)
    for name, signals in (("estimate", plant.estimated), ("state", plant.states)):
        value = getattr(said, name)
        if value is not None:
            bound = LARGE * np.array([s.scale for s in signals])
            wrong |= ~(np.abs(value) <= bound).all(axis=1)
    if said.estimate_std is not None:
        wrong |= (said.estimate_std < 0).any(axis=1)
    if said.label_probs is not None:
        total = said.label_probs.sum(axis=1)
        wrong |= ~((said.label_probs >= -SUM).all(axis=1) & (np.abs(total - 1.0) <= SUM))
    return wrong


def guarded(raw: Diagnoser, plant: Plant) -> Diagnoser:
    """The diagnoser as the evaluation runs it.

    A method that does not handle gaps is not shown a sample with a missing value: its diagnosis stands. An episode whose
    diagnosis is `invalid`, or whose update fails in linear algebra, is lost: label -1, which is never right, no alarm,
    estimate and state NaN, no probability for any label, from there to its end. The other episodes are not touched.

    Raises (from update):
        ValueError: obs has the wrong shape, or the diagnoser's answer does.
    """
    width = len(plant.observed)

    def init(n: int) -> Any:
        if n < 0 or isinstance(n, bool):
            raise ValueError(f"the number of episodes is at least 0, not {n}")
        estimate = np.tile(plant.estimate_target(plant.nominal_theta, plant.trim_command), (n, 1))
        healthy = Diagnosis(np.zeros(n, bool), np.zeros(n, np.int64), estimate, np.full_like(estimate, np.nan))
        return raw.init(n) if n else None, healthy, np.zeros((n, width)), np.zeros(n, bool)

    def singly(state: Any, obs: Array) -> tuple[Any, Diagnosis, Array]:
        """The update, episode by episode, after it failed for the batch; and which failed."""
        n = len(obs)
        failed, states, answers = np.zeros(n, bool), [], []
        for i in range(n):
            part = map_arrays(lambda a, i=i: a[i : i + 1], state)
            try:
                part, answer = raw.update(part, obs[i : i + 1])
            except (np.linalg.LinAlgError, FloatingPointError):
                failed[i], answer = True, None
            states.append(part)
            answers.append(answer)
        template = next((a for a in answers if a is not None), Diagnosis(np.zeros(1, bool), np.zeros(1, np.int64)))
        answers = [template if a is None else a for a in answers]
        leader = int(np.argmin(failed))
        states[0], states[leader] = states[leader], states[0]  # shared counters are those of one that went on
        order = np.arange(n)
        order[0], order[leader] = leader, 0
        joined = map_arrays(lambda *parts: np.concatenate(parts)[order], *states)
        return joined, map_arrays(lambda *parts: np.concatenate(parts), *answers), failed

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        inner, last, last_obs, lost = state
        n = len(lost)
        obs = contiguous(obs)
        if obs.shape != (n, width):
            raise ValueError(
                f"obs has the shape {(n, width)} ({', '.join(s.name for s in plant.observed)}), not {obs.shape}"
            )
        if n == 0:
            return state, last
        shown = ~lost
        if not raw.gaps:
            shown &= np.isfinite(obs).all(axis=1)
        if not shown.all():
            obs = np.where(shown[:, None], obs, last_obs)
        with np.errstate(all="ignore"):
            try:
                after, answer = raw.update(inner, obs)
                failed = np.zeros(n, bool)
            except np.linalg.LinAlgError:
                after, answer, failed = singly(inner, obs)
        answer = checked(plant, n, answer)
        failed |= invalid(plant, answer)
        if failed.any() or not shown.all():
            fresh = failed & shown
            lost = lost | fresh
            after = choose(shown & ~lost, after, inner)
            if fresh.any():  # where it stays, out of harm's way; shared counters are those of the episodes that go on
                after = choose(~fresh, after, raw.init(n))
            kept: Any = Diagnosis._make(b if a is None or b is None else a for a, b in zip(last, answer, strict=True))
            answer = choose(shown & ~lost, answer, kept)
            numbers = {
                name: np.where(lost[:, None], 0.0 if name == "label_probs" else np.nan, value)
                for name in ("estimate", "label_probs", "state")
                if (value := getattr(answer, name)) is not None
            }
            answer = answer._replace(alarm=answer.alarm & ~lost, label=np.where(lost, -1, answer.label), **numbers)
        return (after, answer, obs, lost), answer

    return Diagnoser(init, update, raw.gaps, raw.filter, raw.rule)
