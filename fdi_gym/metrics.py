"""Outcomes: what a recorded flight and a diagnosis come to, as the counts that every score is made of.

`outcome` reduces one episode; `fdi_gym.scores` makes the scores of many from their outcomes alone, so that a row of a
leaderboard can be recomputed from the outcomes it carries.

One decision is asked for each fault window (a maximal run of samples with the same faulty label, of which some are scored)
and one for each healthy flight, so each decision is about a single true label.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np

from fdi_gym.declaration import PRESENT, declared_rows, errors, runs, true_rows
from fdi_gym.diagnosis import Decisions
from fdi_gym.engine import Record
from fdi_gym.faults import Scoring
from fdi_gym.plant import Array, Plant

PHASES = ("before", "during", "after")  # before the first fault, while a fault acts, healthy again after one
BANDS = ("small", "medium", "large")
DEVIATIONS = 1.96  # an estimate is covered where its error is at most so many of its stated standard deviations

Count = Annotated[int, msgspec.Meta(ge=0, le=2**40)]
Label = Annotated[int, msgspec.Meta(ge=0, le=2**15)]
Declared = Annotated[int, msgspec.Meta(ge=-1, le=2**15)]  # -1: no valid diagnosis


class Onset(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What became of one fault: a maximal run of samples with the same faulty label.

    Delays are in samples from the onset step to the sample whose diagnosis shows it; None where it never did before the
    fault changed or ended, and where it did before the fault began.
    """

    label: Label
    length: Count  # samples for which the fault was there
    fresh: bool  # it begins from healthy: only then its detection is asked for
    alarmed: bool  # an alarm was on when it began
    labelled: bool  # its label was declared when it began
    detection: Count | None
    isolation: Count | None


class Decision(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The one decision about a fault window or a healthy flight."""

    label: Label  # the true one
    declared: Declared
    band: Count | None  # severity band at the end of the window, None where healthy or not known


class Stated(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the errors of one estimated entry compare with their stated standard deviations, while a fault acts."""

    samples: Count  # with a stated deviation above zero
    covered: Count  # errors within 1.96 deviations
    squares: float  # sum of (error / deviation)^2


class Found(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a fault mode that a flight had was declared, as in `fdi_gym.declaration.errors`."""

    onset: int  # declared less true, in samples
    overlap: float  # of the two windows, as a share of their union
    size: float | None  # declared less true, as a share of the mode's reach; None where the true one is not known


class Declaration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the diagnosis amounts to as one declaration of the whole flight."""

    modes: Count  # that the flight had
    exact: bool  # they are those that are declared
    worth: float  # 0 to 1
    found: list[Found]  # of the modes that are both


class Acted(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What acting came to on a flight."""

    cost: float  # flight cost, mean over the samples for which the flight was planned
    probed: Count  # samples under a probe
    unusable: Count  # diagnoses that were to be allowed for and were not numbers


class Outcome(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One episode, reduced to counts."""

    steps: Count
    terminated: bool
    lost: bool  # the diagnoser's estimate left the numbers
    decisions: list[Decision]
    confusion: list[tuple[Label, Declared, Count]]  # (true label, declared label, scored samples)
    banded: list[tuple[Count, Count]]  # per band: scored faulty samples, and those with the right label
    onsets: list[Onset]
    false_alarms: Count  # alarms that rose while the plant was healthy, or were on from the start
    healthy_steps: Count
    alarm_steps: Count  # healthy samples under an alarm
    alarmed: list[tuple[Count, Count]]  # healthy, faulty: scored samples, and those under an alarm
    squared_error: list[list[float]]  # per phase: sum over samples, per estimated entry
    error_steps: list[Count]  # per phase
    squared_fault: list[float]  # while a fault acts: sum of squared deviations of the truth from healthy, per entry
    declaration: Declaration
    stated: list[Stated] | None  # per estimated entry, where the method states deviations
    log_score: float | None  # sum of log probabilities of the true label over scored samples, where there are any
    acted: Acted | msgspec.UnsetType = msgspec.UNSET  # where the diagnosis acts


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
        said = [*(v for d in episode.decisions for v in (d.label, d.declared)), *(o.label for o in episode.onsets),
                *(v for pair in episode.confusion for v in pair[:2])]  # fmt: skip
        stated = episode.stated or []
        counted = [sum(c for *_, c in episode.confusion), sum(seen for seen, _ in episode.banded), sum(episode.error_steps),
                   sum(o.length for o in episode.onsets), episode.healthy_steps, episode.false_alarms,
                   sum(seen for seen, _ in episode.alarmed), len(episode.decisions),
                   *(s.samples for s in stated)]  # fmt: skip
        sums = [*(value for phase in episode.squared_error for value in phase), *episode.squared_fault,
                *(s.squares for s in stated)]  # fmt: skip
        parts = [*episode.banded, *episode.alarmed, *((s.samples, s.covered) for s in stated),
                 (episode.healthy_steps, episode.alarm_steps)]  # fmt: skip
        entry_wise = [*episode.squared_error, episode.squared_fault, *([stated] if episode.stated is not None else [])]
        wrong = {
            "a label that the plant does not have": max(said, default=0) >= labels,
            "counts above the length of the flight": max(counted) > episode.steps,
            "more right samples than samples": any(right > seen for seen, right in parts),
            "lists of another length": (len(episode.banded), len(episode.error_steps), len(episode.squared_error))
            != (len(BANDS), len(PHASES), len(PHASES)) or len(episode.alarmed) != 2
            or any(len(part) != entries for part in entry_wise),
            "an unknown severity": any(d.band is not None and d.band >= len(BANDS) for d in episode.decisions),
            "a severity of no fault": any(d.band is not None and d.label == 0 for d in episode.decisions),
            "a delay beyond its fault": any(d is not None and d > o.length for o in episode.onsets
                                            for d in (o.detection, o.isolation)),
            "a delay of what was there before": any(((o.alarmed or not o.fresh) and o.detection is not None)
                                                    or (o.labelled and o.isolation is not None) for o in episode.onsets),
            "sums of squares that no error has": any(not 0 <= value < 1e300 for value in sums),
            "a declaration that cannot be": not _possible(episode.declaration, episode.steps),
            "acts that no flight can have": episode.acted is not msgspec.UNSET
            and not (0 <= episode.acted.cost < 1e12 and max(episode.acted.probed, episode.acted.unusable) <= episode.steps),
            "a log score above 0": episode.log_score is not None and not -1e300 < episode.log_score <= 1e-6,
        }  # fmt: skip
        for what, is_so in wrong.items():
            if is_so:
                raise ValueError(f"episode {i} has {what}")


def _possible(said: Declaration, steps: int) -> bool:
    within = all(abs(f.onset) <= steps and 0 <= f.overlap <= 1 and abs(f.size or 0.0) < 1e12 for f in said.found)
    whole = len(said.found) <= said.modes and (len(said.found) == said.modes or not said.exact)
    return within and whole and 0 <= said.worth <= 1 and (said.exact or said.worth == 0)


def scored_samples(label: Array, length: int, scoring: Scoring) -> Array:
    """Mask (K + 1,) of the samples that count: from `start` to the end of the flight, without the grace after changes."""
    k = np.arange(len(label))
    mask = (k >= scoring.start) & (k <= length)
    if scoring.grace:
        for change in np.flatnonzero(np.diff(label)) + 1:
            mask[change : change + scoring.grace] = False
    return mask


def severity_bands(plant: Plant, label: Array, theta: Array) -> Array:
    """Band index (K + 1,) of each sample by the size of its smallest active fault; -1 where healthy or not known."""
    band = np.full(len(label), -1)
    modes = {mode.name: mode for mode in plant.modes}
    for index in np.unique(label[label > 0]):
        mine = label == index
        sizes = [(modes[name].size(theta[mine]), modes[name].bands) for name in plant.labels[index].modes]
        known = np.isfinite([size for size, _ in sizes]).all(axis=0)
        band[mine] = np.where(known, np.min([np.digitize(size, bands) for size, bands in sizes], axis=0), -1)
    return band


def windows(label: Array, length: int, scored: Array) -> list[tuple[int, int, int]]:
    """What decisions are about: (first sample, sample after the last, label) of the fault windows, or the healthy flight."""
    faulty = [run for run in runs(label, 1, length) if run[2] > 0]
    found = faulty or [(1, length + 1, 0)]
    return [(first, stop, value) for first, stop, value in found if scored[first:stop].any()]


def decide(rule: str, mode: Array, first: int, stop: int, scored: Array) -> int:
    """The declared label of one decision: a rule of `Scoring` over the scored samples first..stop - 1."""
    if rule == "second_half":
        half = slice((first + stop) // 2, stop)
        values, counts = np.unique(mode[half][scored[half]], return_counts=True)  # sorted: the lowest label wins a tie
        return int(values[np.argmax(counts)])
    return int(mode[stop - 1])


def _onsets(label: Array, alarm: Array, mode: Array, length: int) -> list[Onset]:
    found = []
    for first, stop, value in runs(label, 1, length):
        if value == 0:
            continue
        fresh = first == 1 or label[first - 1] == 0
        alarmed, labelled = bool(alarm[first - 1]), bool(mode[first - 1] == value)
        alarms, right = np.flatnonzero(alarm[first:stop]), np.flatnonzero(mode[first:stop] == value)
        found.append(Onset(
            label=value, length=stop - first, fresh=bool(fresh), alarmed=alarmed, labelled=labelled,
            detection=int(alarms[0]) + 1 if fresh and alarms.size and not alarmed else None,
            isolation=int(right[0]) + 1 if right.size and not labelled else None,
        ))  # fmt: skip
    return found


def _stated(error: Array, std: Array, during: Array) -> list[Stated]:
    """Squared errors and stated deviations (K + 1, entries), over the samples of the mask."""
    found = []
    for squared, deviation in zip(error[during].T, std[during].T, strict=True):
        usable = np.isfinite(deviation) & (deviation > 0)
        ratio = np.minimum(squared[usable] / np.maximum(deviation[usable], 1e-150) ** 2, 1e280)
        found.append(Stated(int(usable.sum()), int((ratio <= DEVIATIONS**2).sum()), float(ratio.sum())))
    return found


def _declaration(plant: Plant, label: Array, target: Array, said: Array, estimate: Array | None) -> Declaration:
    """Of one flight, from its samples 0..length."""
    truth, declared = true_rows(plant, label, target)[None], declared_rows(plant, said, estimate)[None]
    wrong = errors(plant, truth, declared)
    both = np.flatnonzero(np.isfinite(wrong.onset[0]))
    return Declaration(
        int(truth[0, :, PRESENT].sum()), bool(wrong.exact[0]), float(wrong.worth[0]),
        [Found(int(wrong.onset[0, i]), float(wrong.overlap[0, i]), None if np.isnan(wrong.size[0, i])
               else float(wrong.size[0, i])) for i in both],
    )  # fmt: skip


def outcome(plant: Plant, scoring: Scoring, record: Record, said: Decisions, i: int) -> Outcome:
    """Reduce episode i of a record, and what was said about it, to counts."""
    length = int(record.length[i])
    label, mode, alarm = record.label[i], said.label[i].astype(np.int64), said.alarm[i]
    k = np.arange(len(label))
    flown, scored = (k >= 1) & (k <= length), scored_samples(label, length, scoring)
    pairs, counts = np.unique(np.column_stack([label[scored], mode[scored]]), axis=0, return_counts=True)
    band = severity_bands(plant, label, record.theta[i])
    healthy = (label == 0) & flown
    before = np.concatenate([[False], alarm[:-1]])
    before[1] = False  # an alarm that is on from sample 0 is one at the first sample that counts
    first_fault = int(np.argmax(label > 0)) if (label > 0).any() else len(label)
    phase = np.where(label > 0, 1, np.where(k < first_fault, 0, 2))
    phase[(k < scoring.start) | (k > length)] = -1
    entries = len(plant.estimated)
    squares, steps, stated = [[0.0] * entries for _ in PHASES], [0] * len(PHASES), None
    moved = [0.0] * entries
    if said.estimate is not None:
        error = (said.estimate[i] - record.target[i]) ** 2
        phase[~np.isfinite(error).all(axis=1)] = -1  # a lost filter has no estimate; `lost` counts it
        for p in range(len(PHASES)):
            squares[p] = [float(v) for v in error[phase == p].sum(axis=0)]
            steps[p] = int((phase == p).sum())
        moved = [float(v) for v in ((record.target[i] - plant.healthy)[phase == 1] ** 2).sum(axis=0)]
        if said.estimate_std is not None:
            stated = _stated(error, said.estimate_std[i], phase == 1)
    flight = slice(length + 1)
    estimate = None if said.estimate is None else said.estimate[i, flight]
    declaration = _declaration(plant, label[flight], record.target[i, flight], mode[flight], estimate)
    log_score = None
    if said.label_probs is not None:
        log_score = float(np.log(np.maximum(said.label_probs[i, scored, label[scored]], 1e-12)).sum())
    return Outcome(
        steps=length, terminated=bool(record.terminated[i]), lost=bool((mode[1 : length + 1] < 0).any()),
        decisions=[Decision(value, decide(scoring.decision, mode, first, stop, scored),
                            int(band[stop - 1]) if band[stop - 1] >= 0 else None)
                   for first, stop, value in windows(label, length, scored)],
        confusion=[(int(a), int(b), int(c)) for (a, b), c in zip(pairs, counts, strict=True)],
        banded=[(int((scored & (band == b)).sum()), int((scored & (band == b) & (mode == label)).sum()))
                for b in range(len(BANDS))],
        onsets=_onsets(label, alarm, mode, length),
        false_alarms=int((alarm & ~before & healthy).sum()), healthy_steps=int(healthy.sum()),
        alarm_steps=int((alarm & healthy).sum()),
        alarmed=[(int((scored & kind).sum()), int((scored & kind & alarm).sum())) for kind in (label == 0, label > 0)],
        squared_error=squares, error_steps=steps, squared_fault=moved, stated=stated, declaration=declaration,
        log_score=log_score,
    )  # fmt: skip
