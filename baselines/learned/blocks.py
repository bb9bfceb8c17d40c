"""A stream of samples as blocks, for methods that look at the channels alone: means, and which of them are whole.

A block is the mean of `stride` scaled samples. A channel that did not report in a part of a block has the mean of the rest,
one that did not report at all what it had before. Such a block is not whole, nor is one in which a command was held for want
of a report: relations that hold to a fraction of the noise hold in whole blocks only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fdi_gym.estimation.equivalent import has_equivalents, nearest
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant


class Stream(NamedTuple):
    """The state for n episodes."""

    total: Array  # (n, n_obs) of the block that is being filled: sums, and
    count: Array  # (n, n_obs) reports
    held: Array  # (n,) bool: a command or known signal did not report in it
    window: Array  # (n, length, n_obs) means of the last blocks, the newest first
    whole: Array  # (n,) whole blocks in a row
    heard: Array  # (n,) bool: every channel reported in the last block


def begin(plant: Plant, length: int, n: int) -> Stream:
    """Before the first sample."""
    width = len(plant.observed)
    zeros = np.zeros((n, width))
    return Stream(zeros, zeros, np.zeros(n, bool), np.zeros((n, length, width)), np.zeros(n, np.int64), np.zeros(n, bool))


def _at_rest(plant: Plant) -> Array:
    """What the outputs (n_y,) are at rest: of measurements that mean the same, the one nearest to it is taken."""
    rest = np.array([s.nominal for s in plant.outputs])
    rest[[parts[3] for parts in plant.quaternions]] = 1.0
    return rest


def add(plant: Plant, stride: int, s: Stream, at: Interval, y: Array, seen: Array) -> tuple[Stream, Array]:
    """With a sample: the state after it, and where it ended a block (n,) bool."""
    if has_equivalents(plant):
        y = nearest(plant, y, seen, np.tile(_at_rest(plant), (len(y), 1)))
    there = np.concatenate([seen, np.ones((len(y), len(plant.observed) - y.shape[1]), bool)], axis=1)
    now = np.where(there, plant.scale(np.concatenate([y, at.u, at.known], axis=1)), 0.0)
    total, count = s.total + now, s.count + there
    held = s.held if at.held is None else s.held | at.held
    ends = (at.k + 1) % stride == 0
    if not ends.any():
        return s._replace(total=total, count=count, held=held), ends
    mean = np.where(count > 0, total / np.maximum(count, 1), s.window[:, 0])
    window = np.where(ends[:, None, None], np.concatenate([mean[:, None], s.window[:, :-1]], axis=1), s.window)
    good, heard = (count == stride).all(axis=1) & ~held, np.where(ends, (count > 0).all(axis=1), s.heard)
    whole = np.where(ends, np.where(good, s.whole + 1, 0), s.whole)
    again = ~ends[:, None]
    return Stream(total * again, count * again, held & ~ends, window, whole, heard), ends


def of_flights(plant: Plant, obs: Array, stride: int) -> Array:
    """The blocks of recorded flights (N, K + 1, n_obs): (N, (K + 1) // stride, n_obs)."""
    n, samples, width = obs.shape
    return plant.scale(obs[:, : samples // stride * stride]).reshape(n, -1, stride, width).mean(axis=2)


def windows(blocks: Array, length: int) -> Array:
    """All windows of blocks (N, T, n_obs), the newest block first: (N, T - length + 1, length, n_obs), not copied."""
    view = np.lib.stride_tricks.sliding_window_view(blocks, length, axis=1)  # (N, T - length + 1, n_obs, length)
    return view.transpose(0, 1, 3, 2)[:, :, ::-1]
