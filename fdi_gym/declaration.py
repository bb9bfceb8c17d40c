"""A whole scenario as a diagnosis: which faults a flight had, when they began and ended, and how large they were.

One declaration is made at the end of a flight: a row for each fault mode of the plant. `true_declaration` makes it of the
truth, `declared` of what any diagnoser said over the flight, `errors` compares the two and `worth` makes one number of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fdi_gym.engine import Record
from fdi_gym.plant import Array, Plant

if TYPE_CHECKING:  # an environment begins without the filters' modules
    from fdi_gym.diagnosis.contract import Decisions

PRESENT, ONSET, END, SIZE = range(4)  # of a declaration's rows; from SIZE on one column for each magnitude
BRIDGED = 20  # samples without an alarm that do not end it, as of an intermittent fault
SHORTEST = 10  # samples that an alarm must last to be declared
SHARE, LASTING = 0.5, 0.05  # a mode is declared that so much of its alarm, or of the flight, names


class Errors(NamedTuple):
    """What is wrong with declarations of n flights; NaN where a mode is not both true and declared."""

    exact: Array  # (n,) bool: the set of modes is the true one
    onset: Array  # (n, modes) declared less true onset, in samples
    overlap: Array  # (n, modes) intersection over union of the declared and the true window
    size: Array  # (n, modes) declared less true size as a share of the reach, of the magnitude that is furthest off
    worth: Array  # (n,) what the declarations are worth, 0 to 1; see `worth`


def columns(plant: Plant) -> int:
    """Of a declaration's rows: 4, or more where a mode has more than one magnitude; what is beyond a mode's own is 0."""
    return SIZE + max((len(which) for which in plant.magnitudes_of), default=1)


def bounds(plant: Plant) -> Array:
    """The ends of the sizes in a declaration's rows (modes, columns - SIZE, 2): the modes' reaches."""
    found = np.zeros((len(plant.modes), columns(plant) - SIZE, 2))
    for mode, row in zip(plant.modes, found, strict=True):
        row[: len(mode.reaches)] = mode.reaches
    return found


def runs(label: Array, first: int = 0, last: int | None = None) -> list[tuple[int, int, int]]:
    """Maximal runs of equal labels on the samples first..last: (first sample, sample after the last, label)."""
    last = len(label) - 1 if last is None else last
    edges = np.flatnonzero(np.diff(label[first : last + 1])) + first + 1
    starts, stops = [first, *edges.tolist()], [*edges.tolist(), last + 1]
    return [(a, b, int(label[a])) for a, b in zip(starts, stops, strict=True) if b > a]


def stretches(mask: Array) -> list[tuple[int, int]]:
    """The runs of True of a mask (K,): (first sample, sample after the last)."""
    return [(a, b) for a, b, there in runs(mask) if there]


def _settled(values: Array) -> float:
    """The median over the second half of a fault's window, when it has built up."""
    values = values[len(values) // 2 :]
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else np.nan


Windows = dict[int, list[tuple[int, int]]]  # of each mode: (first sample, sample after the last)


def _windows_to_rows(plant: Plant, windows: Windows, label: Array, estimate: Array | None) -> Array:
    """The rows (modes, 4) of one flight from the windows of each mode, and the estimated quantity (K + 1, n) within them."""
    rows = np.zeros((len(plant.modes), columns(plant)))
    reach = plant.reaches
    size = np.full((len(label), len(reach)), np.nan)
    if estimate is not None:
        size = np.clip(plant.magnitudes(label, estimate - plant.healthy), reach[:, 0], reach[:, 1])
    for i, found in windows.items():
        rows[i, :SIZE] = 1.0, max(found[0][0] - 1, 0), found[-1][1] - 1
        for column, which in enumerate(plant.magnitudes_of[i], SIZE):
            settled = _settled(np.concatenate([size[a:b, which] for a, b in found]))
            rows[i, column] = np.mean(reach[which]) if np.isnan(settled) else settled
    return rows


def _members(plant: Plant) -> list[Array]:
    """The labels that contain each mode."""
    return [np.array([k for k, said in enumerate(plant.labels) if mode.name in said.modes], int) for mode in plant.modes]


def true_rows(plant: Plant, label: Array, target: Array) -> Array:
    """What was true of one flight (modes, 4), from its labels (K + 1,) and estimated quantity (K + 1, n), NaN if unknown."""
    found = {i: stretches(np.isin(label, labels)) for i, labels in enumerate(_members(plant))}
    rows = _windows_to_rows(plant, {i: windows for i, windows in found.items() if windows}, label, target)
    if np.isnan(target).all():  # a recorded flight: which faults it had is known, how large they were is not
        rows[rows[:, PRESENT] > 0, SIZE:] = np.nan
    return rows


def true_declaration(plant: Plant, record: Record) -> Array:
    """What was true of recorded flights: (N, modes, 4), the columns PRESENT, ONSET, END, SIZE; more for planes (`columns`).

    Onset and end are steps: a fault acts on onset <= k < end, from the first time to the last. The size is that on the
    mode's line, the median over the second half of the time in which it acted; on a plane it is one for each direction.
    """
    flights = zip(record.label, record.target, record.length, strict=True)
    return np.array([true_rows(plant, label[: last + 1], target[: last + 1]) for label, target, last in flights])


def alarms(label: Array) -> list[tuple[int, int]]:
    """The alarms of a flight (first sample, sample after the last), gaps bridged and short ones left out."""
    joined: list[tuple[int, int]] = []
    for first, last in stretches(label > 0):
        if joined and first - joined[-1][1] <= BRIDGED:
            joined[-1] = joined[-1][0], last
        else:
            joined.append((first, last))
    return [(a, b) for a, b in joined if b - a >= SHORTEST]


def declared_rows(plant: Plant, label: Array, estimate: Array | None) -> Array:
    """What a diagnoser's labels (K + 1,) and estimates (K + 1, n) over one flight amount to (modes, 4); see `declared`."""
    windows: Windows = {}
    members = _members(plant)
    for first, after in alarms(label):
        enough = min(SHARE * (after - first), max(SHORTEST, LASTING * len(label)))
        named: dict[int, tuple[int, int]] = {}
        for i, labels in enumerate(members):
            found = first + np.flatnonzero(np.isin(label[first:after], labels))
            if len(found) >= enough:
                named[i] = int(found[0]), int(found[-1]) + 1
        earliest = min((begin for begin, _ in named.values()), default=first)
        for i, (begin, end) in named.items():
            windows.setdefault(i, []).append((first if begin == earliest else begin, end))
    return _windows_to_rows(plant, windows, label, estimate)


def declared(plant: Plant, said: Decisions, length: Array) -> Array:
    """What a diagnoser's labels and estimates over flights amount to: (N, modes, 4), as `true_declaration`.

    An alarm declares a mode that half of its samples name, or a twentieth of the flight's: not what was guessed at first
    and soon corrected. The mode acted from the first of these samples to the last; what an alarm names first of those that
    it declares began with the alarm. Sizes are those of the estimate on the label's lines; without an estimate, the middle
    of the mode's reach.

    Args:
        plant: The plant.
        said: What the diagnoser said.
        length: (N,) last sample of each flight.
    """
    return np.array([
        declared_rows(plant, said.label[n, : last + 1], None if said.estimate is None else said.estimate[n, : last + 1])
        for n, last in enumerate(length)
    ])  # fmt: skip


def errors(plant: Plant, truth: Array, declaration: Array) -> Errors:
    """How declarations (n, modes, 4) differ from the truth; PRESENT counts from 0.5 on."""
    is_there, is_said = truth[..., PRESENT] >= 0.5, declaration[..., PRESENT] >= 0.5
    both = is_there & is_said
    a, b = truth[..., ONSET : END + 1], declaration[..., ONSET : END + 1]
    common = np.maximum(np.minimum(a[..., 1], b[..., 1]) - np.maximum(a[..., 0], b[..., 0]), 0.0)
    union = (a[..., 1] - a[..., 0]) + np.maximum(b[..., 1] - b[..., 0], 0.0) - common
    exact, overlap, error = (
        (is_there == is_said).all(axis=-1),
        np.where(both, common / np.maximum(union, 1.0), np.nan),
        np.where(both[..., None], declaration[..., SIZE:] - truth[..., SIZE:], np.nan),
    )
    low, high = np.moveaxis(bounds(plant), 2, 0)
    shares = error / np.where(high > low, high - low, 1.0)
    worst = np.argmax(np.abs(shares), axis=-1)[..., None]
    share = np.take_along_axis(shares, worst, axis=-1)[..., 0]
    right = np.maximum(1.0 - np.abs(share), 0.0)
    parts = np.stack([np.ones_like(right), overlap, right]).mean(axis=0)
    parts = np.where(np.isnan(truth[..., SIZE]), 0.5 * (1.0 + overlap), parts)
    mean = np.where(is_there, np.nan_to_num(parts), 0.0).sum(axis=-1) / np.maximum(is_there.sum(axis=-1), 1)
    value = np.where(exact, np.where(is_there.any(axis=-1), mean, 1.0), 0.0)
    return Errors(exact, np.where(both, b[..., 0] - a[..., 0], np.nan), overlap, share, value)


def worth(plant: Plant, truth: Array, declaration: Array) -> Array:
    """The reward of declarations (n,), 0 to 1: 0 for a wrong set of modes, 1 for a healthy flight that is called healthy.

    Else the mean of 1, the overlap of the windows, and 1 less the error of the size as a share of its mode's reach (not
    below 0; left out where the true size is not known), over the modes.
    """
    return errors(plant, truth, declaration).worth
