"""Scores of many flights, from their outcomes alone: isolation, detection, identification, with 95 % intervals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
import numpy as np

from fdi_gym.intervals import balanced_interval, mean_interval, recalls, resamples, strata
from fdi_gym.metrics import BANDS, PHASES, Acted, Onset, Outcome
from fdi_gym.plant import Array

BOOTSTRAP = 1000


def balanced_accuracy(confusion: Array) -> float:
    """Mean of the diagonal of the row-normalised confusion matrix (labels, labels + 1), over rows that occur."""
    rows = confusion.sum(axis=-1)
    seen = rows > 0
    return float(np.mean(np.diagonal(confusion[:, :-1])[seen] / rows[seen])) if seen.any() else float("nan")


def macro_f1(confusion: Array) -> float:
    """Mean F1 over the labels that occur or are declared."""
    hits = np.diagonal(confusion[:, :-1])
    total = confusion.sum(axis=1) + confusion[:, :-1].sum(axis=0)
    seen = total > 0
    return float(np.mean(2 * hits[seen] / total[seen])) if seen.any() else float("nan")


def survival(delays: Sequence[int | None], waited: Sequence[int]) -> list[tuple[int, float]]:
    """Kaplan-Meier: (samples, share that has not shown by then) at each step down; right-censored after `waited`."""
    events = np.array([d if d is not None else w for d, w in zip(delays, waited, strict=True)], int)
    seen = np.array([d is not None for d in delays], bool)
    left, curve = 1.0, []
    for time in np.unique(events[seen]):
        left *= 1 - (seen & (events == time)).sum() / (events >= time).sum()
        curve.append((int(time), float(left)))
    return curve


def delay_quartiles(curve: Sequence[tuple[int, float]], dt: float) -> list[float | None]:
    """Quartiles [s] of a survival curve; None beyond the data."""
    return [next((time * dt for time, left in curve if left <= share + 1e-12), None) for share in (0.75, 0.5, 0.25)]


def restricted_mean(curve: Sequence[tuple[int, float]], horizon: int, dt: float) -> float:
    """Mean delay [s] if each that is longer than the horizon counts as the horizon: the area below the curve."""
    area, since, left = 0.0, 0, 1.0
    for time, after in curve:
        if time >= horizon:
            break
        area, since, left = area + left * (time - since), time, after
    return (area + left * (horizon - since)) * dt


def asked(onsets: Iterable[Onset], kind: str) -> list[Onset]:
    """The faults whose delay counts: of "detection", those that begin from healthy and under no alarm; of "isolation",
    those whose label was not declared already.
    """
    if kind == "detection":
        return [onset for onset in onsets if onset.fresh and not onset.alarmed]
    return [onset for onset in onsets if not onset.labelled]


def answers(outcomes: Sequence[Outcome], labels: int, kind: str) -> Array:
    """Confusion counts per flight (N, labels, labels + 1); the last column is "no valid diagnosis".

    Args:
        outcomes: The flights.
        labels: Number of labels.
        kind: "per_sample" or "per_decision".
    """
    found = np.zeros((len(outcomes), labels, labels + 1))
    for i, flight in enumerate(outcomes):
        said = flight.confusion if kind == "per_sample" else [(d.label, d.declared, 1) for d in flight.decisions]
        for true, declared, count in said:
            found[i, true, declared] += count  # -1 is the last column
    return found


def strata_of(outcomes: Sequence[Outcome]) -> Array:
    """Stratum of each flight: of what is true, so the same for all rows of a suite."""
    return strata([[d.label for d in flight.decisions] for flight in outcomes])


def _isolation(matrix: Array, stratum: Array) -> dict[str, Any]:
    total = matrix.sum(axis=0)
    if not total.any():  # nothing was asked: flights that end within the grace
        return dict.fromkeys(("balanced_accuracy", "balanced_accuracy_interval", "accuracy", "macro_f1")) | {
            "confusion": [[0] * matrix.shape[2]] * matrix.shape[1]
        }
    score = balanced_accuracy(total)
    hits, counts = np.diagonal(matrix[..., :-1], axis1=1, axis2=2), matrix.sum(axis=2)
    answers = np.flatnonzero(total.sum(axis=0))
    # who always gives the same answer is right about that label and no other, whichever flights are drawn
    interval = [score, score] if len(answers) == 1 else balanced_interval(hits, counts, stratum)
    return {
        "balanced_accuracy": score, "balanced_accuracy_interval": interval,
        "accuracy": float(np.trace(total) / total.sum()), "macro_f1": macro_f1(total),
        "confusion": [[int(v) for v in row] for row in total],
    }  # fmt: skip


def _detection(outcomes: Sequence[Outcome], stratum: Array, dt: float) -> dict[str, Any]:
    seen, under = (np.array([[pair[j] for pair in flight.alarmed] for flight in outcomes], float) for j in (0, 1))
    hits = np.column_stack([seen[:, 0] - under[:, 0], under[:, 1]])
    score = interval = None
    if seen.any():
        score = float(np.nanmean(recalls(hits, seen)))
        always = not under.any() or bool(
            (under == seen).all()
        )  # never an alarm, or one throughout: nothing is left to chance
        interval = [score, score] if always else balanced_interval(hits, seen, stratum)
    alarms = np.array([flight.false_alarms for flight in outcomes], float)
    steps = np.array([flight.healthy_steps for flight in outcomes], float)
    below = sum(flight.alarm_steps for flight in outcomes)
    drawn = resamples(stratum, BOOTSTRAP)
    hours, exposure = steps.sum() * dt / 3600, drawn @ steps * dt / 3600
    rates = (drawn @ alarms)[exposure > 0] / exposure[exposure > 0]
    onsets = [onset for flight in outcomes for onset in flight.onsets]
    fresh = [onset for onset in onsets if onset.fresh]
    timed, wanted = asked(onsets, "detection"), asked(onsets, "isolation")
    horizons = [int(np.median([o.length for o in some])) if some else 0 for some in (fresh, onsets)]
    detected = survival([o.detection for o in timed], [o.length for o in timed])
    isolated = survival([o.isolation for o in wanted], [o.length for o in wanted])
    return {
        "balanced_accuracy": score,
        "balanced_accuracy_interval": interval,
        "false_alarms_per_hour": float(alarms.sum() / hours) if hours else None,
        "false_alarms_per_hour_interval": [float(v) for v in np.percentile(rates, [2.5, 97.5])] if len(rates) else None,
        "healthy_share_under_alarm": float(below / steps.sum()) if hours else None,
        "begun_under_alarm_rate": (len(fresh) - len(timed)) / len(fresh) if fresh else None,
        "missed_rate": sum(o.detection is None for o in timed) / len(timed) if timed else None,
        "delay_quartiles": delay_quartiles(detected, dt),
        "delay_restricted_mean": restricted_mean(detected, horizons[0], dt) if timed else None,
        "delay_horizon": horizons[0] * dt,
        "isolation_delay_quartiles": delay_quartiles(isolated, dt),
        "isolation_delay_restricted_mean": restricted_mean(isolated, horizons[1], dt) if wanted else None,
        "isolation_delay_horizon": horizons[1] * dt,
    }


def _identification(outcomes: Sequence[Outcome], entries: Sequence[str]) -> dict[str, Any] | None:
    steps = np.array([flight.error_steps for flight in outcomes], float).sum(axis=0)
    if not steps.sum():
        return None
    squares = np.array([flight.squared_error for flight in outcomes]).sum(axis=0)
    moved = np.array([flight.squared_fault for flight in outcomes]).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        rmse, relative = np.sqrt(squares / steps[:, None]), np.sqrt(squares[1] / moved)
    stated = [flight.stated for flight in outcomes if flight.stated is not None]
    said = [[sum(getattr(one[j], field) for one in stated) for j in range(len(entries))]
            for field in ("samples", "covered", "squares")]  # fmt: skip
    usable = [j for j in range(len(entries)) if said[0][j]]
    return {
        "relative_error": float(relative[moved > 0].mean()) if (moved > 0).any() else None,
        "rmse": {
            phase: dict(zip(entries, [float(v) for v in rmse[p]], strict=True)) if steps[p] else None
            for p, phase in enumerate(PHASES)
        },
        "coverage": float(np.mean([said[1][j] / said[0][j] for j in usable])) if usable else None,
        "nees": float(np.mean([said[2][j] / said[0][j] for j in usable])) if usable else None,
    }


def _scenario(outcomes: Sequence[Outcome], dt: float) -> dict[str, Any]:
    """Of the declarations of whole flights. Errors are those of the modes that are both true and declared."""
    said = [flight.declaration for flight in outcomes]
    found = [f for one in said for f in one.found]
    onsets = np.abs([f.onset for f in found]) * dt
    sizes = np.abs([f.size for f in found if f.size is not None])
    return {
        "worth": float(np.mean([one.worth for one in said])),
        "exact": float(np.mean([one.exact for one in said])),
        "found": float(len(found) / modes) if (modes := sum(one.modes for one in said)) else None,
        "onset_error_quartiles": np.quantile(onsets, (0.25, 0.5, 0.75)).tolist() if found else None,
        "overlap": float(np.mean([f.overlap for f in found])) if found else None,
        "size_error": float(np.median(sizes)) if sizes.size else None,
    }


def acted_of(outcomes: Sequence[Outcome]) -> list[Acted]:
    """What acting came to on each flight; none where the diagnosis does not act."""
    return [flight.acted for flight in outcomes if flight.acted is not msgspec.UNSET]


def costs(outcomes: Sequence[Outcome]) -> Array:
    """The flight cost of each flight (N,), where the diagnosis acts."""
    return np.array([one.cost for one in acted_of(outcomes)])


def _acting(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    acted, steps = acted_of(outcomes), sum(flight.steps for flight in outcomes)
    middle, low, high = mean_interval(costs(outcomes))
    return {
        "cost": middle, "cost_interval": [low, high], "probed": sum(one.probed for one in acted) / steps,
        "unusable": sum(one.unusable for one in acted),
    }  # fmt: skip


def summarise(outcomes: Sequence[Outcome], labels: int, entries: Sequence[str], dt: float) -> dict[str, Any]:
    """The scores of a set of flights, from their outcomes alone.

    Isolation ("per_sample", "per_decision") is scored by balanced accuracy; detection by the mean of the share of healthy
    samples without and of faulty ones with an alarm; identification, while a fault acts, by the error relative to that of
    always saying healthy (1; 0 is perfect; mean over the entries that faults move), by the share of errors within 1.96
    stated deviations (0.95 if they are right) and by the mean of (error / deviation)^2 (NEES per entry, 1 if right). Delays
    leave out faults that began under an alarm, or with their label declared; the restricted mean counts what is longer
    than the median fault as the median fault.

    The scenario task is scored on what the labels and estimates amount to as one declaration of each flight
    (`fdi_gym.declaration`).

    Where the diagnosis acts there is what it cost ("acting"): the mean flight cost with its interval, and the share of the
    samples under a probe.

    Args:
        outcomes: One per flight.
        labels: Number of labels.
        entries: Names of the estimated entries.
        dt: Sample time [s].
    """
    stratum = strata_of(outcomes)
    bands = np.array([flight.banded for flight in outcomes], float).sum(axis=0)
    decisions = [d for flight in outcomes for d in flight.decisions]
    by_band = [[d.declared == d.label for d in decisions if d.band == b] for b in range(len(BANDS))]
    scored = [(e.log_score, sum(c for *_, c in e.confusion)) for e in outcomes if e.log_score is not None]
    samples = sum(c for _, c in scored)
    return {
        "episodes": len(outcomes),
        "decisions": len(decisions),
        "per_sample": _isolation(answers(outcomes, labels, "per_sample"), stratum),
        "per_decision": _isolation(answers(outcomes, labels, "per_decision"), stratum),
        "accuracy_by_severity": {
            band: {
                "per_sample": float(bands[b][1] / bands[b][0]) if bands[b][0] else None,
                "per_decision": float(np.mean(by_band[b])) if by_band[b] else None,
                "decisions": len(by_band[b]),
            }
            for b, band in enumerate(BANDS)
        },
        "detection": _detection(outcomes, stratum, dt),
        "identification": _identification(outcomes, entries),
        "scenario": _scenario(outcomes, dt),
        "log_score": float(sum(s for s, _ in scored) / samples) if samples else None,
        "lost_episodes": sum(flight.lost for flight in outcomes),
        "terminated_episodes": sum(flight.terminated for flight in outcomes),
        **({"acting": _acting(outcomes)} if acted_of(outcomes) else {}),
    }
