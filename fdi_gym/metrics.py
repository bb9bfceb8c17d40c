"""Scores: functions of recorded arrays, and nothing else.

`outcome` reduces one episode to the counts that every score is made of; `summarise` makes the scores of many episodes
from their outcomes alone, with bootstrap intervals over episodes. So a row of a leaderboard can be recomputed from the
outcomes it carries.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import msgspec
import numpy as np

from fdi_gym.diagnosis import Decisions
from fdi_gym.engine import Record
from fdi_gym.faults import Scoring
from fdi_gym.plant import Array, Plant

PHASES = ("before", "during", "after")  # before the first fault, while a fault acts, healthy again after one
BANDS = ("small", "medium", "large")
BOOTSTRAP, CONFIDENCE = 1000, 0.95


Count = Annotated[int, msgspec.Meta(ge=0, le=2**40)]
Label = Annotated[int, msgspec.Meta(ge=0, le=2**15)]
Declared = Annotated[int, msgspec.Meta(ge=-1, le=2**15)]  # -1: no valid diagnosis


class Onset(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What became of one fault: a maximal run of samples with the same faulty label.

    Delays are in samples from the onset step to the sample whose diagnosis shows it; None where it never did before the
    fault changed or ended. `detection` is asked only of faults that begin from healthy, and is None also where an alarm
    was already on. `length` is how long the fault was there.
    """

    label: Label
    length: Count
    fresh: bool
    detection: Count | None
    isolation: Count | None


class Outcome(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One episode, reduced to counts."""

    steps: Count
    terminated: bool
    lost: bool  # the diagnoser's estimate left the numbers
    decision: tuple[Label, Declared]  # true label and declared label of the episode's one decision
    band: Count | None  # severity band of the episode's decision, None where it is healthy
    confusion: list[tuple[Label, Declared, Count]]  # (true label, declared label, scored samples)
    banded: list[tuple[Count, Count]]  # per band: scored faulty samples, and those with the right label
    onsets: list[Onset]
    false_alarms: Count  # alarms that rose while the plant was healthy
    healthy_steps: Count
    squared_error: list[list[float]]  # per phase: sum over samples, per estimated entry
    error_steps: list[Count]  # per phase
    log_score: float | None  # sum of log probabilities of the true label over scored samples, where there are any


def check_outcomes(outcomes: Sequence[Outcome], labels: int, entries: int) -> None:
    """Make sure that outcomes from a file can be those of flights of a plant, so that scores can be made of them.

    Args:
        outcomes: The outcomes; their fields are of the declared types.
        labels: Number of labels.
        entries: Number of estimated entries.

    Raises:
        ValueError: A label that the plant has not, counts that exceed the flight, lists of another length, sums that no
            error has.
    """
    for i, episode in enumerate(outcomes):
        said = [*episode.decision, *(o.label for o in episode.onsets), *(v for pair in episode.confusion for v in pair[:2])]
        counted = [sum(c for *_, c in episode.confusion), sum(seen for seen, _ in episode.banded), sum(episode.error_steps),
                   sum(o.length for o in episode.onsets), episode.healthy_steps, episode.false_alarms]  # fmt: skip
        sums = [value for phase in episode.squared_error for value in phase]
        wrong = {
            "a label that the plant does not have": max(said) >= labels,
            "counts above the length of the flight": max(counted) > episode.steps,
            "more right samples than samples": any(right > seen for seen, right in episode.banded),
            "lists of another length": (len(episode.banded), len(episode.error_steps), len(episode.squared_error))
            != (len(BANDS), len(PHASES), len(PHASES)) or any(len(phase) != entries for phase in episode.squared_error),
            "an unknown severity": episode.band is not None and episode.band >= len(BANDS),
            "a delay beyond its fault": any(d is not None and d > o.length for o in episode.onsets
                                            for d in (o.detection, o.isolation)),
            "sums of squares that no error has": any(not 0 <= value < 1e300 for value in sums),
            "a log score above 0": episode.log_score is not None and not -1e300 < episode.log_score <= 1e-6,
        }  # fmt: skip
        for what, is_so in wrong.items():
            if is_so:
                raise ValueError(f"episode {i} has {what}")


def scored_samples(label: Array, length: int, scoring: Scoring) -> Array:
    """Mask (K + 1,) of the samples that count: from `start` to the end of the flight, without the grace after changes."""
    k = np.arange(len(label))
    mask = (k >= scoring.start) & (k <= length)
    if scoring.grace:
        for change in np.flatnonzero(np.diff(label)) + 1:
            mask[change : change + scoring.grace] = False
    return mask


def runs(label: Array, first: int, last: int) -> list[tuple[int, int, int]]:
    """Maximal runs of equal labels on the samples first..last: (first sample, sample after the last, label)."""
    edges = np.flatnonzero(np.diff(label[first : last + 1])) + first + 1
    starts, stops = [first, *edges.tolist()], [*edges.tolist(), last + 1]
    return [(a, b, int(label[a])) for a, b in zip(starts, stops, strict=True) if b > a]


def severity_bands(plant: Plant, label: Array, theta: Array) -> Array:
    """Band index (K + 1,) of each sample by the size of its smallest active fault; -1 where healthy."""
    band = np.full(len(label), -1)
    modes = {mode.name: mode for mode in plant.modes}
    for index in np.unique(label[label > 0]):
        mine = label == index
        of_modes = [np.digitize(modes[name].size(theta[mine]), modes[name].bands) for name in plant.labels[index].modes]
        band[mine] = np.min(of_modes, axis=0)
    return band


def decide(rule: str, label: Array, mode: Array, length: int) -> tuple[int, int, int]:
    """The one decision of an episode: (sample it is about, true label, declared label)."""
    if rule == "second_half":
        faulty = [run for run in runs(label, 1, length) if run[2] > 0]
        first, stop = (faulty[0][0], faulty[-1][1]) if faulty else (1, length + 1)
        half = mode[(first + stop) // 2 : stop]
        values, counts = np.unique(half, return_counts=True)  # sorted: the lowest label wins a tie
        return stop - 1, int(label[stop - 1]), int(values[np.argmax(counts)])
    return length, int(label[length]), int(mode[length])


def _onsets(label: Array, alarm: Array, mode: Array, length: int) -> list[Onset]:
    found = []
    for first, stop, value in runs(label, 1, length):
        if value == 0:
            continue
        fresh = first == 1 or label[first - 1] == 0
        alarms, right = np.flatnonzero(alarm[first:stop]), np.flatnonzero(mode[first:stop] == value)
        early = bool(alarm[first - 1])
        found.append(Onset(
            label=value, length=stop - first, fresh=bool(fresh),
            detection=int(alarms[0]) + 1 if fresh and alarms.size and not early else None,
            isolation=int(right[0]) + 1 if right.size else None,
        ))  # fmt: skip
    return found


def outcome(plant: Plant, scoring: Scoring, record: Record, said: Decisions, i: int) -> Outcome:
    """Reduce episode i of a record, and what was said about it, to counts."""
    length = int(record.length[i])
    label, mode, alarm = record.label[i], said.label[i].astype(np.int64), said.alarm[i]
    scored = scored_samples(label, length, scoring)
    pairs, counts = np.unique(np.column_stack([label[scored], mode[scored]]), axis=0, return_counts=True)
    band = severity_bands(plant, label, record.theta[i])
    about, true, declared = decide(scoring.decision, label, mode, length)
    healthy = (label == 0) & (np.arange(len(label)) >= 1) & (np.arange(len(label)) <= length)
    rising = alarm & ~np.concatenate([[False], alarm[:-1]])
    first_fault = int(np.argmax(label > 0)) if (label > 0).any() else len(label)
    phase = np.where(label > 0, 1, np.where(np.arange(len(label)) < first_fault, 0, 2))
    phase[(np.arange(len(label)) < scoring.start) | (np.arange(len(label)) > length)] = -1
    squares, steps = [[0.0] * len(plant.estimated) for _ in PHASES], [0] * len(PHASES)
    if said.estimate is not None:
        error = (said.estimate[i] - record.target[i]) ** 2
        phase[~np.isfinite(error).all(axis=1)] = -1  # a lost filter has no estimate; `lost` counts it
        for p in range(len(PHASES)):
            squares[p] = [float(v) for v in error[phase == p].sum(axis=0)]
            steps[p] = int((phase == p).sum())
    log_score = None
    if said.label_probs is not None:
        log_score = float(np.log(np.maximum(said.label_probs[i, scored, label[scored]], 1e-12)).sum())
    return Outcome(
        steps=length, terminated=bool(record.terminated[i]), lost=bool((mode[1 : length + 1] < 0).any()),
        decision=(true, declared), band=int(band[about]) if true > 0 else None,
        confusion=[(int(a), int(b), int(c)) for (a, b), c in zip(pairs, counts, strict=True)],
        banded=[(int((scored & (band == b)).sum()), int((scored & (band == b) & (mode == label)).sum()))
                for b in range(len(BANDS))],
        onsets=_onsets(label, alarm, mode, length),
        false_alarms=int((rising & healthy).sum()), healthy_steps=int(healthy.sum()),
        squared_error=squares, error_steps=steps, log_score=log_score,
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------
# Scores of many episodes


def balanced_accuracy(confusion: Array) -> Array:
    """Mean of the diagonal of the row-normalised confusion matrix (..., labels, labels + 1), over rows that occur."""
    rows = confusion.sum(axis=-1)
    hits = np.diagonal(confusion[..., :-1], axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.nanmean(np.where(rows > 0, hits / rows, np.nan), axis=-1)


def macro_f1(confusion: Array) -> float:
    """Mean F1 over the labels that occur or are declared."""
    hits = np.diagonal(confusion[:, :-1])
    total = confusion.sum(axis=1) + confusion[:, :-1].sum(axis=0)
    seen = total > 0
    return float(np.mean(2 * hits[seen] / total[seen])) if seen.any() else float("nan")


def delay_quartiles(delays: Sequence[int | None], waited: Sequence[int], dt: float) -> list[float | None]:
    """Kaplan-Meier quartiles [s] of delays, right-censored after `waited` where never reached; None beyond the data."""
    events = np.array([d if d is not None else w for d, w in zip(delays, waited, strict=True)], float)
    seen = np.array([d is not None for d in delays])
    survival, curve = 1.0, []
    for time in np.unique(events[seen]) if len(events) else []:
        at_risk = (events >= time).sum()
        survival *= 1 - (seen & (events == time)).sum() / at_risk
        curve.append((time, survival))
    return [next((float(time * dt) for time, s in curve if s <= share + 1e-12), None) for share in (0.75, 0.5, 0.25)]


def _interval(values: Array) -> list[float]:
    tail = 100 * (1 - CONFIDENCE) / 2
    return [float(v) for v in np.nanpercentile(values, [tail, 100 - tail])]


def _matrix(outcomes: Sequence[Outcome], labels: int) -> Array:
    """Confusion counts per episode (N, labels, labels + 1); the last column is "no valid diagnosis"."""
    found = np.zeros((len(outcomes), labels, labels + 1))
    for i, episode in enumerate(outcomes):
        for true, declared, count in episode.confusion:
            found[i, true, declared] += count  # -1 is the last column
    return found


def summarise(outcomes: Sequence[Outcome], labels: int, entries: Sequence[str], dt: float) -> dict[str, Any]:
    """The scores of a set of episodes, from their outcomes alone.

    Args:
        outcomes: One per episode.
        labels: Number of labels.
        entries: Names of the estimated entries.
        dt: Sample time [s].
    """
    n = len(outcomes)
    # the resamples are the same for every row of a suite: rows are compared on equal terms
    weights = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), BOOTSTRAP).astype(float)
    per_sample = _matrix(outcomes, labels)
    per_episode = np.zeros_like(per_sample)
    for i, episode in enumerate(outcomes):
        per_episode[i, episode.decision[0], episode.decision[1]] += 1

    def both(matrix: Array) -> dict[str, Any]:
        total = matrix.sum(axis=0)
        resampled = (weights @ matrix.reshape(n, -1)).reshape(BOOTSTRAP, *total.shape)
        return {
            "balanced_accuracy": float(balanced_accuracy(total)),
            "balanced_accuracy_interval": _interval(balanced_accuracy(resampled)),
            "accuracy": float(np.trace(total) / total.sum()),
            "macro_f1": macro_f1(total),
            "confusion": [[int(v) for v in row] for row in total],
        }

    fresh = [onset for episode in outcomes for onset in episode.onsets if onset.fresh]
    onsets = [onset for episode in outcomes for onset in episode.onsets]
    hours = sum(episode.healthy_steps for episode in outcomes) * dt / 3600
    alarms = np.array([episode.false_alarms for episode in outcomes], float)
    exposure = np.array([episode.healthy_steps * dt / 3600 for episode in outcomes])
    missed = sum(onset.detection is None for onset in fresh)
    bands = np.array([episode.banded for episode in outcomes], float).sum(axis=0)
    by_band = [[e for e in outcomes if e.band == b] for b in range(len(BANDS))]
    steps = np.array([episode.error_steps for episode in outcomes], float).sum(axis=0)
    squares = np.array([episode.squared_error for episode in outcomes]).sum(axis=0)
    estimates = bool(steps.sum())
    scored = [(e.log_score, sum(c for *_, c in e.confusion)) for e in outcomes if e.log_score is not None]
    with np.errstate(invalid="ignore", divide="ignore"):
        alarm_rate = (weights @ alarms) / (weights @ exposure)
        rmse = np.sqrt(squares / steps[:, None])
    return {
        "episodes": n,
        "per_sample": both(per_sample),
        "per_episode": both(per_episode),
        "false_alarms_per_hour": float(alarms.sum() / hours) if hours else None,
        "false_alarms_per_hour_interval": _interval(alarm_rate) if hours else None,
        "missed_detection_rate": missed / len(fresh) if fresh else None,
        "detection_delay_quartiles": delay_quartiles([o.detection for o in fresh], [o.length for o in fresh], dt),
        "isolation_delay_quartiles": delay_quartiles([o.isolation for o in onsets], [o.length for o in onsets], dt),
        "accuracy_by_severity": {
            band: {
                "per_sample": float(bands[b][1] / bands[b][0]) if bands[b][0] else None,
                "per_episode": float(np.mean([e.decision[0] == e.decision[1] for e in by_band[b]])) if by_band[b] else None,
                "episodes": len(by_band[b]),
            }
            for b, band in enumerate(BANDS)
        },
        "rmse": {
            phase: dict(zip(entries, [float(v) for v in rmse[p]], strict=True)) if steps[p] else None
            for p, phase in enumerate(PHASES)
        }
        if estimates
        else None,
        "log_score": float(sum(s for s, _ in scored) / sum(c for _, c in scored)) if scored else None,
        "lost_episodes": sum(episode.lost for episode in outcomes),
        "terminated_episodes": sum(episode.terminated for episode in outcomes),
    }
