"""Multivariate process monitoring, learned from the channels alone: PCA, dynamic PCA and canonical variates.

What healthy channels have in common is found from training flights, and what a sample has beyond it is measured twice, by
Hotelling's T^2 within what varies and by the squared prediction error (SPE, Q) outside of it:

- "pca": principal components of the channels at one step [1];
- "dynamic_pca": of the channels at several steps in a row [2]; the small components are relations that the plant's dynamics
  impose, as in parity space, but identified;
- "cva": canonical variates of past channels and future outputs, a state that is identified, and the rest of the past [3].

Each statistic has a limit that one healthy step in a hundred exceeds. For isolation both become one index, T^2 and SPE by
their limits, and a label is weighed by what of the index is left when the directions that its faults took in training
flights are taken out of the sample (reconstruction, [4]). Sums of that forget at several paces. A step is a block of
samples.

Closed form: moments, and an eigenvalue problem. Each fault process that it was trained on has a model of its own.

[1] J. E. Jackson, G. S. Mudholkar, Technometrics 21(3), 1979. [2] W. Ku, R. H. Storer, C. Georgakis, Chemometrics and
Intelligent Laboratory Systems 30(1), 1995. [3] E. L. Russell, L. H. Chiang, R. D. Braatz, Chemometrics and Intelligent
Laboratory Systems 51(1), 2000. [4] R. Dunia, S. J. Qin, AIChE Journal 44(8), 1998; H. H. Yue, S. J. Qin, Industrial &
Engineering Chemistry Research 40(20), 2001.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.learned import blocks, weights
from baselines.learned import flights as data
from baselines.learned.blocks import Stream
from baselines.learned.flights import CALIBRATION, PER_SEED, TRAINING, Condition
from baselines.learned.recipes import SequenceRecipe, sequence_recipe
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of, trainer
from fdi_gym.engine import Record
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant

METHODS = ("pca", "dynamic_pca", "cva")
KEPT = 0.9  # share of the variance, or of the squared canonical correlations, in the first subspace
LIMIT = 0.99  # quantile of healthy steps
DIRECTIONS, SHARE = 6, 0.9  # of a label: at most so many, with this share of what its faults add
FLOOR = 1e-9  # of a variance, relative to the largest: a channel that never moves tells nothing


class Monitor(NamedTuple):
    """What one process has taught. A window v (D,) becomes w = factor (v - mean)."""

    mean: Array  # (D,)
    factor: Array  # (a + b, D): the squares of the first a add up to T^2 / limit, the others' to SPE / limit
    first: Array  # () a
    basis: Array  # (labels, a + b, r) orthonormal directions of each label's faults; 0 where it has fewer
    expected: Array  # (labels,) mean index of a healthy step with a label's directions taken out


class Watch(NamedTuple):
    """State: the window of blocks, and what its index has added up to."""

    stream: Stream
    T: Array  # (n, labels, paces)
    T2: Array  # (n,) the last step's statistics, as shares of their limits
    SPE: Array  # (n,)


# ---------------------------------------------------------------------------------------------------------------
# Training


class Moments(NamedTuple):
    """Sums over windows: how many, of v, and of v v'."""

    count: Any = 0.0
    total: Any = 0.0
    square: Any = 0.0

    def plus(self, v: Array) -> Moments:
        """With windows v (..., D)."""
        return Moments(self.count + len(v), self.total + v.sum(axis=0), self.square + v.T @ v)

    def about(self, mean: Array) -> Array:
        """Second moment about a point (D, D)."""
        one = self.total / max(self.count, 1)
        cross = np.outer(mean, one)
        return self.square / max(self.count, 1) - cross - cross.T + np.outer(mean, mean)


def labelled(plant: Plant, record: Record, stride: int, length: int) -> tuple[Array, Array]:
    """Windows (N, T, D) of recorded flights and the label (N, T) of those that show one alone; -1 for others."""
    z = blocks.of_flights(plant, record.obs, stride)
    label = record.label[:, stride - 1 :: stride][:, : z.shape[1]]
    inside = (np.arange(z.shape[1]) + 1) * stride - 1 <= record.length[:, None]
    over = np.lib.stride_tricks.sliding_window_view(label, length, axis=1)
    one = (over == over[..., :1]).all(axis=2) & inside[:, length - 1 :]
    v = blocks.windows(z, length)
    return v.reshape(*v.shape[:2], -1), np.where(one, over[..., 0], -1)


def subspaces(S: Array) -> tuple[Array, Array]:
    """The factors (a, D) of T^2 and (b, D) of the prediction error, from the covariance of healthy windows."""
    std = np.sqrt(np.maximum(np.diag(S), FLOOR * np.diag(S).max()))
    size, U = np.linalg.eigh(S / std[:, None] / std)
    size, U = np.maximum(size[::-1], FLOOR), U[:, ::-1]
    a = min(int(np.searchsorted(np.cumsum(size) / size.sum(), KEPT)) + 1, len(size) - 1)
    return (U[:, :a] / np.sqrt(size[:a])).T / std, U[:, a:].T / std


def canonical(S: Array, n_obs: int, n_y: int) -> tuple[Array, Array]:
    """The factors (a, D) and (b, D) of past windows, from the covariance of windows twice as long, newest block first."""
    half = len(S) // 2
    std = np.sqrt(np.maximum(np.diag(S), FLOOR * np.diag(S).max()))
    C = S / std[:, None] / std + FLOOR * np.eye(len(S))
    future, past = np.array([j for j in range(half) if j % n_obs < n_y]), np.arange(half, len(S))

    def inverse_root(M: Array) -> Array:
        size, U = np.linalg.eigh(M)
        return (U / np.sqrt(np.maximum(size, FLOOR))) @ U.T

    whiten = inverse_root(C[np.ix_(past, past)])
    _, corr, Vt = np.linalg.svd(inverse_root(C[np.ix_(future, future)]) @ C[np.ix_(future, past)] @ whiten)
    a = min(int(np.searchsorted(np.cumsum(corr**2) / (corr**2).sum(), KEPT)) + 1, len(Vt) - 1)
    return Vt[:a] @ whiten / std[past], Vt[a:] @ whiten / std[past]


def learned(
    method: str, plant: Plant, moments: Sequence[Moments], long: Moments, statistics: Sequence[Array]
) -> Monitor:  # fmt: skip
    """The monitor of a process.

    Args:
        method: One of METHODS.
        plant: The plant.
        moments: Of windows that show one label alone, by label.
        long: Of healthy windows twice as long, for "cva".
        statistics: Windows (N, D) of healthy calibration flights.
    """
    mean = moments[0].total / moments[0].count
    if method == "cva":
        S = long.about(long.total / long.count)
        first, second = canonical(S, len(plant.observed), len(plant.outputs))
    else:
        first, second = subspaces(moments[0].about(mean))
    limits = [np.quantile(np.concatenate([((v - mean) @ f.T) ** 2 @ np.ones(len(f)) for v in statistics]), LIMIT)
              for f in (first, second)]  # fmt: skip
    factor = np.concatenate([f / np.sqrt(limit) for f, limit in zip((first, second), limits, strict=True)])
    healthy = factor @ moments[0].about(mean) @ factor.T
    basis, expected = np.zeros((len(plant.labels), len(factor), DIRECTIONS)), np.zeros(len(plant.labels))
    expected[0] = np.trace(healthy)
    for j, m in enumerate(moments[1:], 1):
        expected[j] = expected[0]
        if m.count:
            size, U = np.linalg.eigh(factor @ m.about(mean) @ factor.T - healthy)
            size, U = np.maximum(size[::-1], 0.0), U[:, ::-1]
            r = min(int(np.searchsorted(np.cumsum(size) / max(size.sum(), 1e-300), SHARE)) + 1, DIRECTIONS, len(size))
            basis[j, :, :r] = U[:, :r]
            expected[j] -= np.trace(U[:, :r].T @ healthy @ U[:, :r])
    return Monitor(mean, factor, np.array(float(len(first))), basis, expected)


def train(method: str, plant: Plant, recipe: SequenceRecipe, seed: int, work: Path, command: str) -> Path:
    """Fly the recipe's training flights, and write weights and card."""
    began, stride = time.perf_counter(), recipe.shape.stride
    length = 1 if method == "pca" else recipe.shape.lags + 1
    start = TRAINING + PER_SEED * seed + recipe.identify
    tensors: dict[str, Array] = {}
    rates: dict[str, Any] = {}
    for condition in recipe.conditions:
        own = data.plant_under(plant, condition)
        moments, long = [Moments()] * len(plant.labels), Moments()
        for group in range(start, start + recipe.flights * recipe.candidates, recipe.chunk * recipe.candidates):
            most = min(group + recipe.chunk * recipe.candidates, start + recipe.flights * recipe.candidates)
            count = -(-(most - group) // recipe.candidates)
            record = data.fly(own, condition, data.selected(own, condition, range(group, most), count))
            v, label = labelled(own, record, stride, length)
            moments = [m.plus(v[label == j]) for j, m in enumerate(moments)]
            if method == "cva":
                v, label = labelled(own, record, stride, 2 * length)
                long = long.plus(v[label == 0])
        held, fresh = (
            _healthy(own, condition, first, recipe.validation, stride, length) for first in (CALIBRATION, data.VALIDATION)
        )
        monitor = learned(method, own, moments, long, [held])
        w = (fresh - monitor.mean) @ monitor.factor.T
        a = int(monitor.first)
        rates[condition.process] = [float(((w[:, part] ** 2).sum(axis=1) > 1).mean()) for part in (slice(a), slice(a, None))]
        tensors |= {f"{condition.process}.{name}": value for name, value in monitor._asdict().items()}
    return weights.deliver(
        method, plant, recipe, seed, work, tensors, command,
        shape={"stride": stride, "length": length},
        budget={"flights": len(recipe.conditions) * recipe.flights, "seconds": round(time.perf_counter() - began, 1)},
        curve=[{"flights": recipe.flights, "above the limits": rates}],
        seeds={"calibration": [CALIBRATION, CALIBRATION + recipe.validation - 1]}, task="isolation",
    )  # fmt: skip


def _healthy(plant: Plant, condition: Condition, first: int, count: int, stride: int, length: int) -> Array:
    """Healthy windows (N, D) of flights of their own."""
    v, label = labelled(plant, data.fly(plant, condition, range(first, first + count)), stride, length)
    return v[label == 0]


@trainer("pca", "Principal components of the channels", method="pca")
@trainer("dynamic_pca", "Principal components of several steps", method="dynamic_pca")
@trainer("cva", "Canonical variates of past and future", method="cva")
def train_monitor(
    plant: Plant, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs"), method: str = "pca"
) -> Path:
    """Find the subspaces; the path of their weights.

    Args:
        plant: The plant.
        budget: Training flights per condition. Default: those of the network.
        seed: Of the run; each has training seeds of its own.
        work: Folder of runs.
        method: "pca", "dynamic_pca" or "cva".
    """
    recipe = sequence_recipe(plant, budget)
    return train(method, plant, recipe, seed, work, weights.command(method, plant, budget, seed))


# ---------------------------------------------------------------------------------------------------------------
# Running


def shapes(plant: Plant, length: int, tensors: Mapping[str, Array], processes: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """The shapes of all arrays of stored monitors; each has as many directions as its factor has rows."""
    D, labels, found = length * len(plant.observed), len(plant.labels), {}
    for p in processes:
        rows = len(np.atleast_1d(tensors.get(f"{p}.factor", np.zeros(0))))
        found |= {
            f"{p}.mean": (D,), f"{p}.factor": (rows, D), f"{p}.first": (), f"{p}.basis": (labels, rows, DIRECTIONS),
            f"{p}.expected": (labels,),
        }  # fmt: skip
    return found


def monitor_filter(plant: Plant, stride: int, length: int, monitor: Monitor, paces: Sequence[float]) -> Filter:
    """The statistics of a stream and their sums.

    Args:
        plant: The plant.
        stride: Samples in a block.
        length: Blocks in a window.
        monitor: What is known.
        paces: Blocks within which each of the sums forgets.
    """
    keep, labels, a = 1.0 - 1.0 / np.asarray(paces, float), len(plant.labels), int(monitor.first)
    unit = len(monitor.factor) / monitor.expected[0]  # the index of a healthy step is then one for each direction

    def start(n: int) -> Watch:
        return Watch(blocks.begin(plant, length, n), np.zeros((n, labels, len(keep))), np.zeros(n), np.zeros(n))

    def update(s: Watch, at: Interval, y: Array, seen: Array) -> Watch:
        stream, ends = blocks.add(plant, stride, s.stream, at, y, seen)
        new = ends & (stream.whole >= length)
        if not new.any():
            return s._replace(stream=stream)
        w = (stream.window.reshape(len(y), -1) - monitor.mean) @ monitor.factor.T
        whole = (w**2).sum(axis=1)[:, None] - ((w @ monitor.basis) ** 2).sum(axis=2).T  # (n, labels)
        T = keep * s.T + (unit * (whole - monitor.expected))[..., None]
        T2, SPE = (w[:, :a] ** 2).sum(axis=1), (w[:, a:] ** 2).sum(axis=1)
        return Watch(stream, np.where(new[:, None, None], T, s.T), np.where(new, T2, s.T2), np.where(new, SPE, s.SPE))

    def read(s: Watch) -> Reading:
        cost = (s.T - s.T[:, :1]).min(axis=2)
        return Reading(cost=cost, signals={"T^2 / limit": s.T2, "SPE / limit": s.SPE})

    return Filter(start, lambda s, at: s, update, read)


@diagnoser("pca", "Principal components of the channels at one step, T^2 and SPE", sensors=True, method="pca")
@diagnoser(
    "dynamic_pca", "Principal components of the channels over several steps, T^2 and SPE", sensors=True, method="dynamic_pca"
)
@diagnoser("cva", "Canonical variates of past channels and future outputs, T^2 and Q", sensors=True, method="cva")
def monitoring(
    plant: Plant,
    calibration: Calibration,
    *,
    method: str = "dynamic_pca",
    process: str = "standard",
    paces: Sequence[float] = (1, 4, 16, 64),
    path: str = "",
) -> Diagnoser:
    """The statistics with their decision.

    Args:
        plant: A plant that there are weights for.
        calibration: When it alarms.
        method: "pca", "dynamic_pca" or "cva".
        process: The fault process that it is told to expect.
        paces: Blocks within which each of the sums of evidence forgets, 1 or more.
        path: Weights of your own; their card lies beside them.

    Raises:
        ValueError: Unknown method or process, or a number out of range.
        NotApplicableError: No weights for this plant and its options.
        RefusedError: Weights or a card that are not what they should be.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; there are {', '.join(METHODS)}")
    if not paces or min(paces) < 1:
        raise ValueError(f"paces of at least 1 block are allowed, not {tuple(paces)}")
    plant.process(process)
    file, tensors, card = weights.find(method, plant, path)
    expected = process if process in card.processes else card.processes[0]
    stride, length = (weights.whole_number(file, card, name, weights.SIZES["lags"]) for name in ("stride", "length"))
    weights.check_tensors(file, tensors, shapes(plant, length, tensors, card.processes))
    monitor = Monitor(*(tensors[f"{expected}.{name}"].astype(float) for name in Monitor._fields))
    return diagnoser_of(plant, monitor_filter(plant, stride, length, monitor, paces), by_labels(plant, calibration))
