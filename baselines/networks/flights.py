"""Flights for supervised training: flown on the fly from the seeds that are theirs, as the features of steps."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import joblib
import numpy as np

from baselines.networks import identification as ident
from baselines.networks.identification import Model, Shape
from fdi_gym.diagnosis import Diagnosis, make_diagnoser, run
from fdi_gym.engine import Record, simulate
from fdi_gym.faults import draw
from fdi_gym.metrics import scored_samples
from fdi_gym.plant import Array, Plant, PlantSource, add_plant_source, load_plant, plant_sources
from fdi_gym.scores import balanced_accuracy

# the first seed of each split, which ends where the next begins
TEST, VALIDATION, CALIBRATION, TRAINING = 1_000_000, 2_000_000, 2_500_000, 3_000_000
PER_SEED = 1_000_000  # training seeds that belong to one seed of a run


class Source(NamedTuple):
    """A fault process to train on, and the plant's options with it."""

    process: str
    options: dict[str, float]


class Flights(NamedTuple):
    """N flights of T steps of the network, with the truth at the newest sample of each."""

    features: Array  # (N, T, n) float32
    label: Array  # (N, T) int64
    deviation: Array  # (N, T, n_estimated) float32
    scored: Array  # (N, T) bool
    process: Array  # (N,) index of the source


@functools.cache
def _plant(plant_id: str, options: tuple[tuple[str, float], ...]) -> Plant:
    return load_plant(plant_id, **dict(options))


def plant_of(plant_id: str, source: Source) -> Plant:
    """The plant of a source, built once."""
    return _plant(plant_id, tuple(sorted(source.options.items())))


def fly(plant: Plant, source: Source, seeds: Sequence[int]) -> Record:
    """The flights of `reset(seed)` for these seeds."""
    process = plant.process(source.process)
    return simulate(plant, [draw(process, seed) for seed in seeds])


def identified(plants: Sequence[Plant], shape: Shape, records: Sequence[Record]) -> Model:
    """The model of a plant, identified from recorded flights of each of its variants; their truth is used."""
    z = [ident.blocks(plant, record.obs, shape.stride) for plant, record in zip(plants, records, strict=True)]
    truth = [
        at_steps(ident.deviation(plant, record.target), shape.stride)[:, : b.shape[1]]
        for plant, record, b in zip(plants, records, z, strict=True)
    ]
    pairs = ((b[i : i + 50], d[i : i + 50]) for b, d in zip(z, truth, strict=True) for i in range(0, len(b), 50))
    model = ident.identify(plants[0], shape, pairs)
    return ident.standardised(plants[0], shape, model, np.concatenate([b[:40] for b in z]))


def selected(plant: Plant, source: Source, candidates: Sequence[int], count: int) -> list[int]:
    """`count` of the candidate seeds, so that flights whose rarest label is any given one come as evenly as they can.

    Where a process hardly ever shows a label, a network that is to know it must meet it more often than it occurs.
    """
    if len(candidates) == count:
        return list(candidates)
    shown = [np.unique(plant.label_rows(draw(plant.process(source.process), seed))) for seed in candidates]
    often = np.bincount(np.concatenate(shown), minlength=len(plant.labels))
    rarest = np.array([labels[np.argmin(often[labels])] for labels in shown])
    turn = np.array([np.count_nonzero(rarest[:i] == label) for i, label in enumerate(rarest)])  # of its group
    return [candidates[i] for i in sorted(np.lexsort((rarest, turn))[:count])]


def label_share(plant: Plant, source: Source, seeds: Sequence[int]) -> Array:
    """Share of each label in the flights of these seeds, as they are planned."""
    rows = [plant.label_rows(draw(plant.process(source.process), seed)) for seed in seeds]
    return np.bincount(np.concatenate(rows), minlength=len(plant.labels)) / sum(map(len, rows))


def scored_of(plant: Plant, source: Source, record: Record) -> Array:
    """Which samples of recorded flights are scored: (N, K + 1)."""
    scoring = plant.process(source.process).scoring
    return np.stack([scored_samples(true, int(n), scoring) for true, n in zip(record.label, record.length, strict=True)])


def accuracy(plant: Plant, source: Source, record: Record, mode: Array) -> float:
    """Balanced accuracy per sample of declared labels (N, K + 1), as the leaderboards count it."""
    scored, labels = scored_of(plant, source, record), len(plant.labels)
    confusion = np.zeros((labels, labels + 1))
    np.add.at(confusion, (record.label[scored], mode[scored]), 1)
    return float(balanced_accuracy(confusion))


def at_steps(samples: Array, period: int) -> Array:
    """Recorded samples (N, K + 1, ...) at the newest sample of each step of `period` samples."""
    return samples[:, period - 1 :: period]


def at_samples(answers: Array, period: int, samples: int) -> Array:
    """Answers per step (N, T, ...) held until the next one; 0 before the first."""
    held = np.repeat(answers, period, axis=1)[:, : samples - period + 1]
    rest = samples - period + 1 - held.shape[1]
    early = np.zeros((len(answers), period - 1, *answers.shape[2:]), answers.dtype)
    return np.concatenate([early, held, np.repeat(held[:, -1:], rest, axis=1)], axis=1)


def word(plant: Plant, said: Diagnosis) -> Array:
    """A filter's diagnosis as features (n, ...): its label, probabilities, estimate and spread."""
    labels = len(plant.labels)
    found = [np.eye(labels + 1)[said.label]]  # the last column is a lost filter's -1
    if said.label_probs is not None:
        found.append(np.log(np.maximum(said.label_probs, 1e-6)) / 5)
    if said.estimate is not None:
        found.append(np.arcsinh(2 * ident.deviation(plant, said.estimate)))
    if said.estimate_std is not None:
        found.append(np.log(np.maximum(ident.deviation(plant, said.estimate_std + plant.estimate_target(
            plant.nominal_theta, plant.trim_command)), 1e-4)) / 2)  # fmt: skip
    return np.nan_to_num(np.concatenate(found, axis=1), nan=0.0, posinf=0.0, neginf=0.0)


def words(plant_id: str, source: Source, filters: Sequence[str], obs: Array, period: int) -> list[Array]:
    """What each filter says at the newest sample of each step: (N, T, ...), float32."""
    return [_words(plant_of(plant_id, source), source, name, obs, period) for name in filters]


def _elsewhere(known: PlantSource, plant_id: str, *arguments: Any) -> list[Array]:
    """`words` in a worker process, which may not know the plant yet."""
    add_plant_source(plant_id, known)
    return words(plant_id, *arguments)


def _words(plant: Plant, source: Source, name: str, obs: Array, period: int) -> Array:
    said = run(make_diagnoser(name, plant, process=source.process), obs)
    parts = [getattr(said, name) for name in ("alarm", "label", "estimate", "estimate_std", "label_probs")]
    n, samples = said.label.shape
    steps = samples // period
    every = slice(period - 1, steps * period, period)
    flat = [None if a is None else a[:, every].reshape(n * steps, *a.shape[2:]) for a in parts]
    answer = Diagnosis(*flat)  # type: ignore[arg-type]
    return word(plant, answer).reshape(n, steps, -1).astype(np.float32)


def context(process: Array, processes: int, steps: int) -> Array:
    """Which process is expected, as features (N, T, processes)."""
    return np.repeat(np.eye(processes, dtype=np.float32)[process][:, None], steps, axis=1)


def prepare(
    plant_id: str,
    sources: Sequence[Source],
    index: int,
    shape: Shape,
    model: Model,
    filters: Sequence[str],
    seeds: Sequence[int],
) -> tuple[Flights, Record]:
    """Fly one source's seeds and show them as a network sees them."""
    source = sources[index]
    plant = plant_of(plant_id, source)
    record = fly(plant, source, seeds)
    z = ident.blocks(plant, record.obs, shape.stride)
    n, T = len(z), z.shape[1] // shape.every
    process = np.full(n, index)
    pieces = np.array_split(np.arange(n), max(1, n // 50))
    own = np.concatenate([ident.features(plant, shape, model, z[i]) for i in pieces])
    seen = [own, context(process, len(sources), T)]
    if filters:
        known = plant_sources()[plant_id]
        tasks = (joblib.delayed(_elsewhere)(known, plant_id, source, filters, record.obs[i], shape.period) for i in pieces)
        heard = joblib.Parallel(n_jobs=-1)(tasks)
        seen.append(np.concatenate([np.concatenate(piece, axis=2) for piece in heard]))  # type: ignore[arg-type]
    parts = (record.label, ident.deviation(plant, record.target), scored_of(plant, source, record))
    truth = [at_steps(a, shape.period)[:, :T] for a in parts]
    return Flights(np.concatenate(seen, axis=2), truth[0], truth[1].astype(np.float32), truth[2], process), record


def joined(parts: Sequence[Flights]) -> Flights:
    """Flights of several sources side by side; shorter ones are padded with steps that are not scored."""
    longest = max(part.label.shape[1] for part in parts)

    def padded(name: str, a: Array) -> Array:
        if a.ndim == 1:
            return a
        mode = {"mode": "constant"} if name == "scored" else {"mode": "edge"}
        return np.pad(a, [(0, 0), (0, longest - a.shape[1])] + [(0, 0)] * (a.ndim - 2), **mode)  # type: ignore[call-overload]

    return Flights(*(np.concatenate([padded(n, getattr(p, n)) for p in parts]) for n in Flights._fields))
