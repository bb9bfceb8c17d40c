"""Flights for supervised training: flown on the fly from the seeds that are theirs, as the features of steps."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from baselines.learned import features as feat
from baselines.learned import streams
from baselines.learned.features import FeatureModel, FeatureShape
from baselines.learned.weights import MISSING
from fdi_gym.diagnosis import Diagnoser, Diagnosis, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import Record, simulate
from fdi_gym.faults import FaultScenario
from fdi_gym.metrics import scored_samples
from fdi_gym.plant import Array, NotApplicableError, Plant
from fdi_gym.scores import balanced_accuracy
from fdi_gym.suite import chained

# the first seed of each split, which ends where the next begins
TEST, VALIDATION, CALIBRATION, TRAINING = 1_000_000, 2_000_000, 2_500_000, 3_000_000
PER_SEED = 1_000_000  # training seeds that belong to one seed of a run


class Condition(NamedTuple):
    """A fault process to train on, and how its flights are."""

    process: str
    options: dict[str, float]  # of the plant
    mismatch: float = 0.0  # how far its parameters may be off
    windows: int = 1  # drawn flights whose faults follow one another in one, as in suites,
    pace: float = 1.0  # with their times multiplied by this

    @property
    def name(self) -> str:
        """What a network is told to expect: the process, and whether samples will be missing."""
        return self.process + (MISSING if self.options.get("dropout") else "")

    def seeds(self, flight: int) -> range:
        """The seeds of a flight of this number, which counts from the first seed of its split."""
        split = max(first for first in (0, TEST, VALIDATION, CALIBRATION, TRAINING) if first <= flight)
        first = split + (flight - split) // PER_SEED * PER_SEED
        begin = first + (flight - first) * self.windows
        return range(begin, begin + self.windows)

    def scenario(self, plant: Plant, flight: int) -> FaultScenario:
        """What a flight of this number is."""
        return chained([plant.draw(self.process, seed, self.mismatch or None) for seed in self.seeds(flight)], self.pace)


class Flights(NamedTuple):
    """N flights of T steps of the network, with the truth at the newest sample of each."""

    features: Array  # (N, T, n) float32
    label: Array  # (N, T) int64
    deviation: Array  # (N, T, n_estimated) float32
    scored: Array  # (N, T) bool
    process: Array  # (N,) index of the condition


def plant_under(plant: Plant, condition: Condition) -> Plant:
    """The plant with the options of a condition over its own."""
    options = {**plant.options, **condition.options}
    return plant if options == dict(plant.options) else load_plant(plant.id, **options)


def fly(plant: Plant, condition: Condition, seeds: Sequence[int]) -> Record:
    """The flights of `reset(seed)` for these seeds; off the model each is of another plant.

    Raises:
        NotApplicableError: The plant has no mismatch, and the condition has.
    """
    return simulate(plant, [condition.scenario(plant, seed) for seed in seeds])


def identified(plants: Sequence[Plant], shape: FeatureShape, records: Sequence[Record]) -> FeatureModel:
    """The model of a plant, from recorded flights of its variants whose sensors all report; their truth is used."""
    reported = [(p, r) for p, r in zip(plants, records, strict=True) if p.regular is None]
    z = [feat.blocks(plant, record.obs, shape.stride) for plant, record in reported]
    truth = [
        at_steps(feat.deviation(plant, record.target), shape.stride)[:, : b.shape[1]]
        for (plant, record), b in zip(reported, z, strict=True)
    ]
    pairs = ((b[i : i + 50], d[i : i + 50]) for b, d in zip(z, truth, strict=True) for i in range(0, len(b), 50))
    model = feat.identify(plants[0], shape, pairs)
    return streams.standardised(plants[0], shape, model, [record.obs[:40] for record in records])


def selected(plant: Plant, condition: Condition, candidates: Sequence[int], count: int) -> list[int]:
    """`count` of the candidate seeds, so that flights whose rarest label is any given one come as evenly as they can.

    Where a process hardly ever shows a label, a network that is to know it must meet it more often than it occurs.
    """
    if len(candidates) == count:
        return list(candidates)
    shown = [np.unique(plant.label_rows(condition.scenario(plant, seed))) for seed in candidates]
    often = np.bincount(np.concatenate(shown), minlength=len(plant.labels))
    rarest = np.array([labels[np.argmin(often[labels])] for labels in shown])
    turn = np.array([np.count_nonzero(rarest[:i] == label) for i, label in enumerate(rarest)])  # of its group
    return [candidates[i] for i in sorted(np.lexsort((rarest, turn))[:count])]


def label_share(plant: Plant, condition: Condition, seeds: Sequence[int]) -> Array:
    """Share of each label in the flights of these seeds, as they are planned."""
    rows = [plant.label_rows(condition.scenario(plant, seed)) for seed in seeds]
    return np.bincount(np.concatenate(rows), minlength=len(plant.labels)) / sum(map(len, rows))


def scored_of(plant: Plant, condition: Condition, record: Record) -> Array:
    """Which samples of recorded flights are scored: (N, K + 1)."""
    scoring = plant.process(condition.process).scoring
    return np.stack([scored_samples(true, int(n), scoring) for true, n in zip(record.label, record.length, strict=True)])


def accuracy(plant: Plant, condition: Condition, record: Record, declared: Array) -> float:
    """Balanced accuracy per sample of declared labels (N, K + 1), as the leaderboards count it."""
    scored, labels = scored_of(plant, condition, record), len(plant.labels)
    confusion = np.zeros((labels, labels + 1))
    np.add.at(confusion, (record.label[scored], declared[scored]), 1)
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


def shown_filter(name: str, plant: Plant, process: str, processes: Sequence[str]) -> Diagnoser:
    """A filter that a network is shown; where it does not apply to the process, one that is lost from the start.

    Args:
        name: The filter's.
        plant: The plant.
        process: That it is built for.
        processes: Those that the network is trained on, names of a `Condition`.

    Raises:
        NotApplicableError: It applies to none of these.
    """
    try:
        return make_diagnoser(name, plant, process=process)
    except NotApplicableError:
        for other in dict.fromkeys(known.removesuffix(MISSING) for known in processes):
            with suppress(NotApplicableError):
                return _lost(make_diagnoser(name, plant, process=other), plant)
        raise


def first_word(filter: Diagnoser, plant: Plant) -> Diagnosis:
    """What a filter says when all is at rest: (1, ...)."""
    return filter.update(filter.init(1), np.array([[s.nominal for s in plant.observed]]))[1]


def told_by(plant: Plant, filters: Sequence[Diagnoser]) -> int:
    """How many features filters make."""
    return sum(filter_features(plant, first_word(filter, plant)).shape[1] for filter in filters)


def _lost(filter: Diagnoser, plant: Plant) -> Diagnoser:
    """Who says nothing in place of a filter, as lost ones do."""
    said = first_word(filter, plant)
    wide = {name: a for name in ("estimate", "estimate_std", "label_probs") if (a := getattr(said, name)) is not None}

    def update(state: Array, obs: Array) -> tuple[Array, Diagnosis]:
        n = len(obs)
        nothing = {name: np.full((n, a.shape[1]), np.nan) for name, a in wide.items()}
        return state, Diagnosis(np.zeros(n, bool), np.full(n, -1))._replace(**nothing)

    return Diagnoser(np.zeros, update, gaps=True)


def filter_features(plant: Plant, diagnosis: Diagnosis) -> Array:
    """A filter's diagnosis as features (n, ...): its label, probabilities, estimate and spread."""
    labels = len(plant.labels)
    found = [np.eye(labels + 1)[diagnosis.label]]  # the last column is a lost filter's -1
    if diagnosis.label_probs is not None:
        found.append(np.log(np.maximum(diagnosis.label_probs, 1e-6)) / 5)
    if diagnosis.estimate is not None:
        found.append(np.arcsinh(2 * feat.deviation(plant, diagnosis.estimate)))
    if diagnosis.estimate_std is not None:
        unit = np.array([s.scale for s in plant.estimated])
        found.append(np.log(np.maximum(diagnosis.estimate_std / unit, 1e-4)) / 2)
    return np.nan_to_num(np.concatenate(found, axis=1), nan=0.0, posinf=0.0, neginf=0.0)


def filters_features(
    plant: Plant, process: str, processes: Sequence[str], filters: Sequence[str], obs: Array, period: int
) -> list[Array]:  # fmt: skip
    """What `filter_features` has of each shown filter at the newest sample of each step: (N, T, ...), float32."""
    found = []
    for name in filters:
        decisions = run(shown_filter(name, plant, process, processes), obs)
        n, samples = decisions.label.shape
        steps = samples // period
        flat = [
            None if a is None else at_steps(a, period)[:, :steps].reshape(n * steps, *a.shape[2:])
            for a in (getattr(decisions, field) for field in ("alarm", "label", "estimate", "estimate_std", "label_probs"))
        ]
        diagnosis = Diagnosis(*flat)  # type: ignore[arg-type]
        found.append(filter_features(plant, diagnosis).reshape(n, steps, -1).astype(np.float32))
    return found


def context(process: Array, processes: int, steps: int) -> Array:
    """Which process is expected, as features (N, T, processes)."""
    return np.repeat(np.eye(processes, dtype=np.float32)[process][:, None], steps, axis=1)


def prepare(
    plant: Plant, conditions: Sequence[Condition], index: int, shape: FeatureShape, model: FeatureModel,
    filters: Sequence[str], seeds: Sequence[int],
) -> tuple[Flights, Record]:  # fmt: skip
    """Fly the seeds under one of the conditions, whose plant it is, and show them as a network sees them."""
    condition = conditions[index]
    record = fly(plant, condition, seeds)
    n, T = len(record.obs), record.obs.shape[1] // shape.period
    process = np.full(n, index)
    pieces = np.array_split(np.arange(n), max(1, n // 50))
    own = np.concatenate([streams.features(plant, shape, model, record.obs[i]) for i in pieces])
    shown = [own, context(process, len(conditions), T)]
    if filters:
        import joblib

        task, jobs = joblib.delayed(filters_features), min(n, joblib.cpu_count())
        told = plant, condition.process, [c.name for c in conditions], filters
        pieces = np.array_split(np.arange(n), max(jobs, n // 50))  # most of the time is theirs: some for every processor
        found = joblib.Parallel(jobs)(task(*told, record.obs[i], shape.period) for i in pieces)
        shown.append(np.concatenate([np.concatenate(piece, axis=2) for piece in found]))  # type: ignore[arg-type]
    parts = (record.label, feat.deviation(plant, record.target), scored_of(plant, condition, record))
    truth = [at_steps(a, shape.period)[:, :T] for a in parts]
    return Flights(np.concatenate(shown, axis=2), truth[0], truth[1].astype(np.float32), truth[2], process), record


def joined(parts: Sequence[Flights]) -> Flights:
    """Flights under several conditions side by side; shorter ones are padded with steps that are not scored."""
    longest = max(part.label.shape[1] for part in parts)

    def padded(name: str, a: Array) -> Array:
        if a.ndim == 1:
            return a
        mode = {"mode": "constant"} if name == "scored" else {"mode": "edge"}
        return np.pad(a, [(0, 0), (0, longest - a.shape[1])] + [(0, 0)] * (a.ndim - 2), **mode)  # type: ignore[call-overload]

    return Flights(*(np.concatenate([padded(n, getattr(p, n)) for p in parts]) for n in Flights._fields))
