"""Classifiers of windows of blocks: the training examples, the calibration of their scores, and the diagnoser they become.

A classifier is two functions: `featurise` makes features (n, F) of windows of blocks (n, L, n_obs), the newest block first,
and `score` makes of features, with the fault process appended, a logit for each label (n, labels). A window that began
before the flight is filled with the nominal values. Training examples are steps of training flights, so many of each; labels
weigh alike. The scores become probabilities by one temperature and one bias per label, found on calibration flights.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.learned import blocks, probabilities, weights
from baselines.learned import flights as data
from baselines.learned.blocks import Stream
from baselines.learned.flights import CALIBRATION, PER_SEED, TRAINING, VALIDATION
from baselines.learned.probabilities import log_softmax
from baselines.learned.recipes import SequenceRecipe
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser_of
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant

LENGTH = 64  # blocks in a window
EXAMPLES = 30_000  # training examples, of all flights together
CHECKED = 24  # steps of each calibration and validation flight
LEAST = 1e-12  # probability of a label

Featurise = Callable[[Array], Array]
Score = Callable[[Array], Array]


class Examples(NamedTuple):
    """N labelled windows."""

    windows: Array  # (N, L, n_obs) float32
    label: Array  # (N,)
    process: Array  # (N,) index of the condition


def examples(
    plants: Sequence[Plant], recipe: SequenceRecipe, index: int, seeds: Sequence[int], each: int, key: Sequence[int]
) -> tuple[Examples, Array]:  # fmt: skip
    """Up to `each` scored steps of every flight of these seeds under one condition, and the share of labels in the flights.

    Args:
        plants: The plant under each condition.
        recipe: The recipe.
        index: Which condition.
        seeds: Of the flights.
        each: Steps of each flight.
        key: Of the random choice of steps.
    """
    plant, condition, stride = plants[index], recipe.conditions[index], recipe.shape.stride
    record = data.fly(plant, condition, seeds)
    z = blocks.of_flights(plant, record.obs, stride)
    T = z.shape[1]
    label = data.at_steps(record.label, stride)[:, :T]
    scored = data.at_steps(data.scored_of(plant, condition, record), stride)[:, :T]
    full = np.concatenate([np.zeros((len(z), LENGTH - 1, z.shape[2])), z], axis=1)
    view = blocks.windows(full, LENGTH)
    order = np.where(scored, np.random.default_rng(key).random(scored.shape), np.inf)
    step = np.argsort(order, axis=1)[:, :each]
    rows = np.repeat(np.arange(len(z))[:, None], step.shape[1], axis=1)
    kept = scored[rows, step]
    rows, step = rows[kept], step[kept]
    share = np.bincount(label[scored], minlength=len(plant.labels)) / max(scored.sum(), 1)
    return Examples(view[rows, step].astype(np.float32), label[rows, step], np.full(len(rows), index)), share


def joined(parts: Sequence[Examples]) -> Examples:
    """All examples."""
    return Examples(*(np.concatenate(a) for a in zip(*parts, strict=True)))


class Learned(NamedTuple):
    """What a method has learned."""

    tensors: dict[str, Array]
    featurise: Featurise
    score: Score


def with_process(features: Array, process: Array, processes: int) -> Array:
    """Features with the fault process appended, one column each."""
    return np.concatenate([features, np.eye(processes)[process]], axis=1)


def train(
    method: str,
    plant: Plant,
    recipe: SequenceRecipe,
    seed: int,
    work: Path,
    learn: Callable[[Examples, Array, np.random.Generator], Learned],
    shape: Mapping[str, Any],
    command: str,
) -> Path:
    """Fly the training flights, learn, calibrate, and write weights and card.

    Args:
        method: Name of the trainer.
        plant: The plant.
        recipe: The flights.
        seed: Of the run.
        work: Folder of runs.
        learn: Learns from examples, weighted (N,) so that labels count alike.
        shape: What the card says of it, beside the blocks.
        command: For the card.
    """
    began = time.perf_counter()
    plants, conditions = [data.plant_under(plant, c) for c in recipe.conditions], recipe.conditions
    first, chunk = TRAINING + PER_SEED * seed + recipe.identify, recipe.chunk * recipe.candidates
    each = max(1, EXAMPLES // (recipe.flights * len(conditions)))
    parts, shares = [], []
    for i in range(len(conditions)):
        found = []
        for group in range(first, first + recipe.flights * recipe.candidates, chunk):
            most = min(group + chunk, first + recipe.flights * recipe.candidates)
            seeds = data.selected(plants[i], conditions[i], range(group, most), -(-(most - group) // recipe.candidates))
            part, share = examples(plants, recipe, i, seeds, each, [seed, i, group])
            parts.append(part)
            found.append(share)
        shares.append(np.maximum(np.mean(found, axis=0), 1e-4))
    every = joined(parts)
    count = np.bincount(every.label, minlength=len(plant.labels))
    learned = learn(every, (len(every.label) / np.maximum(count, 1) / np.count_nonzero(count))[every.label],
                    np.random.default_rng([seed, 1]))  # fmt: skip
    calibration, accuracy = {}, {}
    for i, condition in enumerate(conditions):
        fitted, measured = (
            examples(plants, recipe, i, range(start, start + recipe.validation), CHECKED, [seed, i, start])[0]
            for start in (CALIBRATION, VALIDATION)
        )
        logits, other = (
            learned.score(with_process(learned.featurise(e.windows), e.process, len(conditions))) for e in (fitted, measured)
        )
        scale, bias = probabilities.fit(logits, fitted.label, shares[i])
        plain, better = log_softmax(other + np.log(shares[i])), log_softmax(scale * other + bias)
        calibration[condition.process] = weights.ProbabilityCalibration(
            scale=scale, bias=bias.tolist(), prior=shares[i].tolist(),
            log_score=(probabilities.log_score(plain, measured.label), probabilities.log_score(better, measured.label)),
            calibration_error=(probabilities.calibration_error(plain, measured.label),
                               probabilities.calibration_error(better, measured.label)),
        )  # fmt: skip
        present = np.unique(measured.label)
        right = other.argmax(axis=1) == measured.label
        accuracy[condition.process] = float(np.mean([right[measured.label == j].mean() for j in present]))
    return weights.deliver(
        method, plant, recipe, seed, work, learned.tensors, command, task="isolation", calibration=calibration,
        shape={"stride": recipe.shape.stride, "length": LENGTH, **shape},
        budget={"flights": len(conditions) * recipe.flights, "examples": len(every.label),
                "seconds": round(time.perf_counter() - began, 1)},
        curve=[{"flights": recipe.flights, "balanced accuracy of steps": accuracy}],
        seeds={"calibration": [CALIBRATION, CALIBRATION + recipe.validation - 1]},
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------
# Running


class Watching(NamedTuple):
    """State: the window of blocks, and the log probabilities of the labels at its last step."""

    stream: Stream
    log: Array  # (n, labels)
    even: Array  # (n, labels) the same, were all labels equally frequent: what the decision weighs


def classifier(
    plant: Plant, calibration: Calibration, file: Path, card: weights.Card, process: str, featurise: Featurise, score: Score
) -> Diagnoser:  # fmt: skip
    """The diagnoser of a classifier: its probabilities are the evidence that the decision weighs.

    Args:
        plant: The plant.
        calibration: When it alarms.
        file: Of the weights.
        card: Their card.
        process: The fault process that it is told to expect; one that it was not trained on it takes for the first.
        featurise, score: The classifier.
    """
    stride = weights.whole_number(file, card, "stride", weights.SIZES["stride"])
    expected = card.expected(process)
    own = weights.calibration_of(file, card, expected)
    bias, prior = np.array(own.bias), np.log(np.maximum(np.array(own.prior) / sum(own.prior), LEAST))
    index = card.processes.index(expected)

    def start(n: int) -> Watching:
        even = np.full((n, len(prior)), -np.log(len(prior)))
        return Watching(blocks.begin(plant, LENGTH, n), np.tile(prior, (n, 1)), even)

    def update(s: Watching, at: Interval, y: Array, seen: Array) -> Watching:
        stream, ends = blocks.add(plant, stride, s.stream, at, y, seen)
        new = ends & stream.heard
        if not new.any():
            return s._replace(stream=stream)
        features = with_process(featurise(stream.window), np.full(len(y), index), len(card.processes))
        logits = own.scale * score(features)
        log, even = log_softmax(logits + bias), log_softmax(logits)
        return Watching(stream, *(np.where(new[:, None], a, b) for a, b in ((log, s.log), (even, s.even))))

    def read(s: Watching) -> Reading:
        return Reading(cost=-2.0 * np.maximum(s.even, np.log(LEAST)), probs=np.exp(s.log))

    made = diagnoser_of(plant, Filter(start, lambda s, at: s, update, read), by_labels(plant, calibration))
    return made._replace(gaps=False)  # a window with a gap in it is like none of training: alarms come of it
