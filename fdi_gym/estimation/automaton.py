"""The decision automaton: from the evidence of each sample to a label that is raised, switched and released.

One automaton for every kind of evidence (a distance, a statistic over its threshold, probabilities, flags): it hears which
label is the best one, whether the evidence is over the threshold of an alarm, and whether it is under that of a release.
While the label is 0, `over` counts consecutive samples over; in alarm, `other` counts those on which another label is the
best one and `under` those under. A count that reaches its length raises, switches or releases; a release wins.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, int64, void

from fdi_gym.kernels import compiled, helper
from fdi_gym.plant import Array

I1, B1 = int64[::1], boolean[::1]


class Automaton(NamedTuple):
    """State after a sample; integers (...), one automaton an entry. Its first state is all zeros."""

    label: Array  # what is declared; 0: no alarm
    over: Array  # consecutive samples
    other: Array
    under: Array
    last: Array  # the best label of the sample before


@helper
def advance(label, over, other, under, last, best, over_now, under_now, rise, switch, release, same):
    """One automaton one sample later: label, over, other, under and last."""
    on = label > 0
    again = not same or best == last
    o = (over + 1 if again else 1) if over_now and not on else 0
    s = (other + 1 if again else 1) if on and best != label else 0
    r = under + 1 if on and under_now else 0
    raised, switched, released = o >= rise, s >= switch, r >= release
    label = 0 if released else best if raised or switched else label
    return label, 0 if raised else o, 0 if switched or released else s, 0 if released else r, best


@compiled(void(I1, I1, I1, I1, I1, I1, B1, B1, B1, int64, int64, int64, boolean, I1, I1, I1, I1, I1))
def _step(
    label, over, other, under, last, best, over_now, under_now, informed, rise, switch, release, same,
    label1, over1, other1, under1, last1,
):  # fmt: skip
    n = best.size
    if not n == label.size == over.size == other.size == under.size == last.size == over_now.size == under_now.size:
        raise ValueError("state and evidence need one shape")
    if informed.size != n:
        raise ValueError("state and evidence need one shape")
    for i in range(n):
        state = label[i], over[i], other[i], under[i], last[i]
        if informed[i]:
            state = advance(*state, best[i], over_now[i], under_now[i], rise, switch, release, same)
        label1[i], over1[i], other1[i], under1[i], last1[i] = state


def first(*shape: int) -> Automaton:
    """Automata before their first sample: no alarm."""
    return Automaton(*(np.zeros(shape, np.int64) for _ in Automaton._fields))


def step(
    state: Automaton,
    best: Array,
    over_now: Array,
    under_now: Array,
    *,
    rise: int,
    switch: int,
    release: int,
    same: bool = False,
    informed: Array | None = None,
) -> Automaton:
    """The automata one sample later.

    Args:
        state: Their state; arrays of any one shape (...).
        best: The label (...) that the evidence prefers, an integer.
        over_now: Whether the evidence is over the threshold of an alarm (...), bool.
        under_now: Whether it is under that of a release (...), bool.
        rise: Consecutive samples over that raise an alarm.
        switch: Consecutive samples with another best label that switch to the one of the last of them.
        release: Consecutive samples under that release.
        same: Samples count as consecutive towards a rise or a switch only while the best label is the same.
        informed: Where the sample says anything (...), bool; elsewhere nothing changes. Default: everywhere.

    Raises:
        ValueError: A length below 1, or shapes that differ.
        TypeError: A label that is no integer, or a flag that is no bool.
    """
    if rise < 1 or switch < 1 or release < 1:
        raise ValueError(f"rise, switch and release are at least one sample, not {rise}, {switch}, {release}")
    out = Automaton(*(np.empty(np.shape(best), np.int64) for _ in Automaton._fields))
    given = (*state, best, over_now, under_now, np.ones(np.shape(best), bool) if informed is None else informed)
    if np.ndim(best) == 1:
        try:
            _step(*given, rise, switch, release, same, *out)
            return out
        except TypeError:  # not as the kernel takes them: the way below
            pass
    flat = [_flat(name, a, out.label.shape) for name, a in zip(_NAMES, given, strict=True)]
    _step(*flat, int(rise), int(switch), int(release), bool(same), *(a.reshape(-1) for a in out))
    return out


_NAMES = (*Automaton._fields, "best", "over_now", "under_now", "informed")


def _flat(name: str, given: Array, shape: tuple[int, ...]) -> Array:
    """An array (...) as the kernel takes it (size,)."""
    a, kind = np.asarray(given), bool if name.endswith("_now") or name == "informed" else np.int64
    if a.shape != shape:
        raise ValueError(f"state and evidence need one shape: {name} has {a.shape}, best {shape}")
    if not np.can_cast(a.dtype, kind, "same_kind"):
        raise TypeError(f"{name} needs {np.dtype(kind)}, not {a.dtype}")
    return np.array(a, kind, order="C").reshape(-1)
