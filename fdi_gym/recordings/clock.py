"""The clock of a recording: its times in seconds, and which of its rows a plant's samples are.

Samples are dt apart. Each takes the row nearest to it; where the rows do not fit them (jitter, another rate) sensors are
interpolated between neighbours, commands averaged over the interval. Where no row is near, the sample is missing. All of it
is said.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from fdi_gym.faults import MAX_STEPS
from fdi_gym.files import RefusedError
from fdi_gym.recordings.mapping import TIME

Array = np.ndarray

GAP = 1.5  # rows that are so many typical steps apart have a gap between them
FITS = 0.1  # root mean square of the rows' distance from the samples, in steps of the plant, up to which they fit
SLOWEST, FASTEST = 100.0, 0.001  # of a recording's step, in steps of the plant
_DATE = re.compile(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}(:\d{2}(\.\d{1,9})?)?")


def seconds(values: Array, unit: str | None, what: str) -> tuple[Array, Array]:
    """Times in seconds since the first of them, NaN where there is none, and as integers of nanoseconds or as they stand.

    Args:
        values: Numbers in a unit or dates, as text.
        unit: Of numbers. Default: seconds.
        what: For messages.

    Raises:
        RefusedError: They are neither.
    """
    text = np.char.strip(values)
    filled = text[text != ""]
    if filled.size and _DATE.match(str(filled[0])):
        found = np.full(len(text), np.nan)
        for date in text:
            if date and not _DATE.fullmatch(str(date).removesuffix("Z").removesuffix("+00:00")):
                raise RefusedError(f"{what}: a date is as in '2026-03-09 10:14:33.25', not {str(date)[:80]!r}")
        try:
            dates = [
                np.datetime64(str(d).removesuffix("Z").removesuffix("+00:00"), "ns") if d else np.datetime64("NaT")
                for d in text
            ]
        except ValueError as error:  # the thirteenth month
            raise RefusedError(f"{what}: there is no such date: {error}") from None
        stamps = np.array(dates, "datetime64[ns]")
        there = ~np.isnat(stamps)
        found[there] = (stamps[there] - stamps[there][0]).astype(np.int64) * 1e-9
        return found, stamps.astype(np.int64).astype(float) * 1e-9
    if not np.char.count(text, ".").any():
        text = np.char.replace(text, ",", ".")  # a decimal comma
    try:
        if np.char.count(text, "_").any():  # a number to Python, to nobody else
            raise ValueError
        numbers = np.where(text == "", "nan", text).astype(float)
    except ValueError:
        wrong = next(str(cell) for cell in filled if not _is_number(str(cell)))
        raise RefusedError(f"{what} is a number or a date, not {wrong[:80]!r}") from None
    numbers = np.where(np.isfinite(numbers), numbers, np.nan) * TIME[unit or "s"]
    there = np.isfinite(numbers)
    with np.errstate(over="ignore"):  # what is too far away for a number has no time
        return numbers - (numbers[there][0] if there.any() else 0.0), numbers


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


class Clock(NamedTuple):
    """Which rows of a recording the samples are."""

    order: Array  # (rows,) the rows that are used, by rising time, out of those of the file
    t: Array  # (rows,) s, their times
    step: float  # s, typical between rows
    samples: Array  # (K + 1,) s, times of the samples, on the same clock
    nearest: Array  # (K + 1,) the row of each, -1 where none is near
    fits: bool  # rows and samples coincide
    notes: list[str]


def clock(t: Array, dt: float, what: str) -> Clock:
    """Bring times (rows,) [s] to samples that are dt [s] apart.

    Raises:
        RefusedError: Too few, too far apart, or at a rate that this plant's samples cannot be made of.
    """
    notes: list[str] = []
    there = np.isfinite(t)
    if (lost := int((~there).sum())) > 0:
        if lost > 0.5 * len(t):
            raise RefusedError(f"{what}: {lost} of {len(t)} rows have no time")
        notes.append(f"{lost} rows without a time are left out")
    order = np.flatnonzero(there)
    jumps = np.diff(t[order])
    if np.any(jumps < 0):
        back = int((-jumps > 0.5 * np.ptp(t[order])).sum())
        order = order[np.argsort(t[order], kind="stable")]
        if back and (np.diff(t[order]) == 0).sum() > 0.1 * len(order):
            raise RefusedError(f"{what}: its times begin again {back} times: it holds several flights; a file is one flight")
        notes.append(f"rows are out of order at {int((jumps < 0).sum())} places: sorted by time")
    again = np.flatnonzero(np.diff(t[order]) == 0)
    if again.size:
        notes.append(f"{again.size} rows have the time of the one before: the last of each is used")
        order = np.delete(order, again)
    t = t[order]
    if len(t) < 2:
        raise RefusedError(f"{what}: at least two rows with different times are needed, there are {len(t)}")
    step = float(np.median(np.diff(t)))
    ratio = step / dt
    if not FASTEST <= ratio <= SLOWEST:
        raise RefusedError(
            f"{what}: rows are {step:.6g} s apart, the plant's samples {dt:g} s; "
            f"from {FASTEST * dt:g} to {SLOWEST * dt:g} s can be used{_other_unit(ratio)}"
        )
    span = float(t[-1] - t[0])
    if span / dt > MAX_STEPS:
        at = int(np.argmax(np.diff(t)))
        raise RefusedError(
            f"{what}: it spans {span:.6g} s, more than {MAX_STEPS} samples; "
            f"the longest gap is {t[at + 1] - t[at]:.6g} s, from {t[at]:.6g} s on"
        )
    steps = (t - t[0]) / dt
    off = (steps - np.round(steps)) * dt
    begin = t[0] + (float(np.median(off)) if np.std(off) < 0.25 * dt else 0.0)
    samples = begin + dt * np.arange(int(np.floor((t[-1] - begin) / dt + 0.5)) + 1)
    after = np.clip(np.searchsorted(t, samples), 1, len(t) - 1)
    nearest = np.where(samples - t[after - 1] <= t[after] - samples, after - 1, after)
    away = t[nearest] - samples
    near = np.abs(away) <= (0.5 + 1e-9) * dt
    rms = float(np.sqrt(np.mean(away[near] ** 2))) / dt if near.any() else 0.0
    fits = rms <= FITS
    _say_rate(notes, step, dt, ratio, rms, fits)
    gaps = np.diff(t) > GAP * max(step, dt)
    if gaps.any():
        longest = float(np.diff(t).max())
        notes.append(
            f"{int(gaps.sum())} gaps, the longest {longest:.6g} s: "
            f"{int((~near).sum())} of {len(samples)} samples are missing"
        )
    if ratio > 0.75 and fits and (unused := len(t) - len(np.unique(nearest[near]))) > 0:
        notes.append(f"{unused} rows lie between samples and are left out")
    return Clock(order, t, step, samples, np.where(near, nearest, -1), fits, notes)


def _other_unit(ratio: float) -> str:
    near = [unit for unit, size in TIME.items() if unit != "s" and 0.5 < ratio * size < 2]
    return f'; if times are in {near[0]}, say so: "time": {{"column": ..., "unit": "{near[0]}"}}' if near else ""


def _say_rate(notes: list[str], step: float, dt: float, ratio: float, rms: float, fits: bool) -> None:
    how = "the nearest rows are used" if fits else "sensors are interpolated, commands averaged"
    if abs(ratio - 1) > 0.02:
        between = "; sensors are missing in between" if ratio > GAP else ""
        notes.append(f"rows are {step:.6g} s apart, the plant's samples {dt:g} s: {how}{between}")
    elif rms > 1e-3:
        notes.append(f"times lie {100 * rms:.2g} % of a sample (rms) off even steps of {dt:g} s: {how}")


def sensors(at: Clock, values: Array, smooth: Array) -> Array:
    """Values (rows, n) at the samples (K + 1, n): of the nearest row, or interpolated where rows and samples do not fit.

    Args:
        at: The clock.
        values: Of the rows in its order.
        smooth: (n,) bool; others are never interpolated.
    """
    found = np.where((at.nearest >= 0)[:, None], values[np.maximum(at.nearest, 0)], np.nan)
    if at.fits or not smooth.any():
        return found
    after = np.clip(np.searchsorted(at.t, at.samples), 1, len(at.t) - 1)
    before = after - 1
    width = at.t[after] - at.t[before]
    share = np.clip((at.samples - at.t[before]) / width, 0.0, 1.0)[:, None]
    between = (1 - share) * values[before] + share * values[after]
    usable = ((width <= GAP * at.step) & (at.nearest >= 0))[:, None] & np.isfinite(between)
    return np.where(usable & smooth, between, found)


def commands(at: Clock, values: Array) -> Array:
    """Commands (rows, n), each held over the time that ends at its row, over the intervals between the samples (K + 1, n).

    Where rows and samples are the same, they are the rows'; else the average over the interval, NaN where half of it or
    more is unknown.
    """
    dt = float(at.samples[1] - at.samples[0]) if len(at.samples) > 1 else at.step
    if at.fits and abs(at.step / dt - 1) < 0.25:
        return np.where((at.nearest >= 0)[:, None], values[np.maximum(at.nearest, 0)], np.nan)
    lasts = np.diff(at.t, prepend=at.t[0] - at.step)
    lasts = np.where(lasts <= GAP * at.step, lasts, at.step)  # a row after a gap speaks of the last step of it
    begins = at.t - lasts
    edges = np.ravel(np.column_stack([begins, at.t]))
    found = np.empty((len(at.samples), values.shape[1]))
    for i, column in enumerate(values.T):
        there = np.isfinite(column)
        sums = [np.where(there, column, 0.0) * lasts, np.where(there, lasts, 0.0)]
        total, known = (
            np.interp(at.samples, edges, np.ravel(np.column_stack([s - d, s])))
            - np.interp(at.samples - dt, edges, np.ravel(np.column_stack([s - d, s])))
            for d in sums for s in [np.cumsum(d)]
        )  # fmt: skip
        found[:, i] = np.where(known >= 0.5 * dt, total / np.maximum(known, 1e-300), np.nan)
    return found


def following(at: Clock) -> Array:
    """The row whose interval each sample ends or lies in (K + 1,): the first one that is not before it."""
    dt = float(at.samples[1] - at.samples[0]) if len(at.samples) > 1 else at.step
    slack = min(0.5 * dt, 0.5 * at.step)
    return np.minimum(np.searchsorted(at.t, at.samples - slack), len(at.t) - 1)
