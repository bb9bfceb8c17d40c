"""The guard under which a diagnoser runs: one bad sample or one lost filter never reaches another episode or ends a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fdi_gym.diagnosis import compiled
from fdi_gym.diagnosis.contract import Diagnoser, Diagnosis, choose, map_arrays
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant

LARGE = 1e12  # an estimate beyond it, in units of its scale, has left the numbers
SUM = 1e-6  # by which probabilities may miss 1


Examined = tuple[Diagnosis, Array, bool]


def examiner(plant: Plant) -> Callable[[int, Any], Examined]:
    """Looks at what a method of this plant says of n episodes.

    It gives the diagnosis with its arrays copied in their declared types, where it holds what cannot be (n,), and whether it
    does anywhere: such an episode is lost. That is an estimate or a state that is not finite or beyond all bounds, a
    negative standard deviation, probabilities that are negative, not finite or do not sum to 1.

    Raises (from the function):
        ValueError: A shape or a type that no diagnosis has, or a label that the plant does not have; the field is named.
    """
    most, largest = (LARGE * np.array([s.scale for s in signals]) for signals in (plant.estimated, plant.states))
    labels, p, n_x = len(plant.labels), len(plant.estimated), len(plant.states)

    def examined(n: int, said: Any) -> Examined:
        if not isinstance(said, Diagnosis):
            raise ValueError(f"update returns (state, Diagnosis), not a {type(said).__name__}")
        alarm, label = _copied("alarm", said.alarm, (n,), "b"), _copied("label", said.label, (n,), "iu")
        _, _, estimate, std, probs, state, signals = said
        estimate = None if estimate is None else _copied("estimate", estimate, (n, p), "iuf")
        std = None if std is None else _copied("estimate_std", std, (n, p), "iuf")
        probs = None if probs is None else _copied("label_probs", probs, (n, labels), "iuf")
        state = None if state is None else _copied("state", state, (n, n_x), "iuf")
        wrong, none = np.empty(n, bool), np.empty((n, 0))
        found = compiled.look(
            label, labels, none if estimate is None else estimate, none if std is None else std,
            none if probs is None else probs, none if state is None else state, most, largest, SUM, wrong,
        )  # fmt: skip
        if found < 0:
            unknown = label[(label < 0) | (label >= labels)][0]
            raise ValueError(f"a diagnosis has labels in 0..{labels - 1}, not {int(unknown)}")
        return Diagnosis(alarm, label, estimate, std, probs, state, signals), wrong, found > 0

    return examined


_TYPES = {"b": (np.dtype(bool), "bool"), "iu": (np.dtype(np.int64), "integer"), "iuf": (np.dtype(float), "numbers, or None")}


def _copied(name: str, given: Any, shape: tuple[int, ...], kinds: str) -> Array:
    """A field in its declared type; a copy, so that nobody who is told it reaches into the method's state."""
    dtype, what = _TYPES[kinds]
    if type(given) is np.ndarray and given.dtype == dtype and given.shape == shape:
        return given.copy()
    value = np.array(given, order="C")
    if value.shape != shape or value.dtype.kind not in kinds:
        raise ValueError(f"a diagnosis has {name} of shape {shape} and {what}, not {value.shape} of {value.dtype}")
    return value if value.dtype == dtype else value.astype(dtype)


def _singly(raw: Diagnoser, state: Any, obs: Array) -> tuple[Any, Diagnosis, Array]:
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


def guarded(raw: Diagnoser, plant: Plant) -> Diagnoser:
    """The diagnoser as the evaluation runs it.

    A method that does not handle gaps is not shown a sample with a missing value: its diagnosis stands. An episode whose
    diagnosis holds what cannot be (`examiner`), or whose update fails in linear algebra, is lost: label -1, which is never
    right, no alarm, estimate and state NaN, no probability for any label, from there to its end. The others are not touched.

    A diagnoser that is under the guard stays as it is.

    Raises (from update):
        ValueError: obs has the wrong shape, or the diagnoser's answer does.
    """
    if raw.guarded:
        return raw
    width, examined = len(plant.observed), examiner(plant)

    def init(n: int) -> Any:
        if n < 0 or isinstance(n, bool):
            raise ValueError(f"the number of episodes is at least 0, not {n}")
        estimate = np.tile(plant.healthy, (n, 1))
        healthy = Diagnosis(np.zeros(n, bool), np.zeros(n, np.int64), estimate, np.full_like(estimate, np.nan))
        return raw.init(n) if n else None, healthy, np.zeros((n, width)), np.zeros(n, bool)

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
        shown, whole = ~lost, not np.count_nonzero(lost)
        if not raw.gaps:
            shown &= np.isfinite(obs).all(axis=1)
            whole = bool(shown.all())
        if not whole:
            obs = np.where(shown[:, None], obs, last_obs)
        with np.errstate(all="ignore"):
            try:
                after, answer = raw.update(inner, obs)
                failed = None
            except np.linalg.LinAlgError:
                after, answer, failed = _singly(raw, inner, obs)
        answer, wrong, bad = examined(n, answer)
        if failed is not None:
            wrong, bad = wrong | failed, True
        if bad or not whole:
            fresh = wrong & shown
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

    def sweep(state: Any, obs: Array) -> tuple[Any, Diagnosis] | None:
        """As long as nobody is lost."""
        inner, _, _, lost = state
        (n, samples, _), found = obs.shape, None
        if raw.sweep is not None and n and samples and obs.shape[2] == width and not lost.any():
            with np.errstate(all="ignore"):
                found = raw.sweep(inner, obs)
        if found is None:
            return None
        after, said = found
        flat = map_arrays(lambda a: a.reshape(n * samples, *a.shape[2:]), said)
        flat, _, bad = examined(n * samples, flat)
        if bad:
            return None
        said = map_arrays(lambda a: a.reshape(n, samples, *a.shape[1:]), flat)
        return (after, map_arrays(lambda a: a[:, -1].copy(), said), contiguous(obs[:, -1]), lost), said

    return Diagnoser(init, update, raw.gaps, raw.filter, raw.rule, True, None if raw.sweep is None else sweep)
