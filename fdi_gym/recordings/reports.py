"""What methods said of a recorded flight: when there was an alarm, what was declared, and what was estimated then."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from fdi_gym.declaration import BRIDGED, SHORTEST, stretches
from fdi_gym.diagnosis import Decisions
from fdi_gym.plant import Array, Plant

SHOWN = 12  # events of a method on the screen
APART = 2.0  # standard deviations of an estimate from healthy from which on it is shown
SMALL = 0.05  # scales, where a method states none


class Event(NamedTuple):
    """A stretch of one flight under an alarm, gaps bridged."""

    first: int  # sample
    last: int
    labels: tuple[tuple[str, float], ...]  # what was declared, and for which share of it
    estimate: Array | None  # (n_estimated,) median over the second half
    std: Array | None


def events(plant: Plant, said: Decisions, flight: int = 0) -> list[Event]:
    """The alarms of a flight: those that last, or all where none does."""
    alarm, label = said.alarm[flight], said.label[flight]
    joined: list[tuple[int, int]] = []
    for first, after in stretches(alarm | (label > 0)):
        if joined and first - joined[-1][1] <= BRIDGED:
            joined[-1] = joined[-1][0], after
        else:
            joined.append((first, after))
    lasting = [(a, b) for a, b in joined if b - a >= SHORTEST]
    return [_event(plant, said, flight, a, b) for a, b in lasting or joined]


def _event(plant: Plant, said: Decisions, flight: int, first: int, after: int) -> Event:
    values, counts = np.unique(said.label[flight, first:after], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    labels = tuple(
        (plant.labels[values[i]].name if values[i] >= 0 else "lost", float(counts[i]) / (after - first)) for i in order
    )  # fmt: skip
    half = slice((first + after) // 2, after)
    settled = [
        None if a is None else np.nanmedian(a[flight, half], axis=0) if np.isfinite(a[flight, half]).any() else None
        for a in (said.estimate, said.estimate_std)
    ]  # fmt: skip
    return Event(first, after - 1, labels, *settled)


def lines(plant: Plant, name: str, said: Decisions, time: Array, label: Array | None) -> Iterator[str]:
    """What a method said of one flight, for the screen."""
    found = events(plant, said)
    right = "" if label is None else f"; right in {100 * (said.label[0, 1:] == label[1:]).mean():.1f} % of the samples"
    lost = "; it lost the flight" if (said.label[0] < 0).any() else ""
    yield f"  {name}: {len(found) or 'no'} alarm{'s' if len(found) != 1 else ''}{right}{lost}"
    for event in found[:SHOWN]:
        end = "to the end" if event.last == len(time) - 1 else f"to {time[event.last]:.6g} s"
        named = [f"{word} ({100 * share:.0f} %)" if share < 0.995 else word for word, share in event.labels if share > 0.05]
        yield f"    {time[event.first]:.6g} s {end}: {', '.join(named[:4])}"
        if event.estimate is not None and (text := _estimates(plant, event)):
            yield f"      {text}"
    if len(found) > SHOWN:
        yield f"    and {len(found) - SHOWN} more"


def _estimates(plant: Plant, event: Event) -> str:
    """The estimated entries that are away from healthy."""
    parts = []
    assert event.estimate is not None
    for i, signal in enumerate(plant.estimated):
        value, std = event.estimate[i], None if event.std is None else event.std[i]
        least = SMALL * signal.scale if std is None or not np.isfinite(std) else APART * std
        if np.isfinite(value) and abs(value - plant.healthy[i]) > least:
            spread = "" if std is None else f" ± {std:.2g}"
            parts.append(f"{signal.name} = {value:.3g}{spread} {signal.unit}".rstrip())
    return ", ".join(parts)


def decision_columns(plant: Plant, said: Mapping[str, Decisions], time: Array) -> tuple[dict[str, Array], dict[str, str]]:
    """What methods said of one flight as columns, a row per method and sample, and the columns' units."""
    names = np.array([*(label.name for label in plant.labels), "lost"])
    parts: dict[str, list[Array]] = {}
    entries = [s.name for s in plant.estimated]
    for name, one in said.items():
        n = len(time)
        columns: dict[str, Array] = {
            "method": np.full(n, name), "sample": np.arange(n), "time": time, "alarm": one.alarm[0],
            "label": names[one.label[0]],
        }  # fmt: skip
        for kind, values in (("", one.estimate), ("std of ", one.estimate_std)):
            blank = np.full((n, len(entries)), np.nan)
            rows = blank if values is None else values[0]
            columns |= {f"{kind}{entry}": rows[:, i] for i, entry in enumerate(entries)}
        for key, value in columns.items():
            parts.setdefault(key, []).append(value)
    units = {"time": "s"} | {f"{kind}{s.name}": s.unit for kind in ("", "std of ") for s in plant.estimated}
    return {key: np.concatenate(values) for key, values in parts.items()}, units
