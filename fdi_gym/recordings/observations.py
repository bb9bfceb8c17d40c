"""A recording as a plant's observations: channels found, in the plant's units and samples, and what was mended, in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.engine import Record
from fdi_gym.files import RefusedError
from fdi_gym.names import unknown
from fdi_gym.plant import Array, Plant
from fdi_gym.recordings import clock
from fdi_gym.recordings.columns import channel_columns
from fdi_gym.recordings.mapping import TIME, Column, Labels, Mapping, Onset, Time, factor_between
from fdi_gym.recordings.tables import Table, open_table

TIMES = ("time", "t", "timestamp", "datetime")  # columns that are the time where a mapping names none


class Recording(NamedTuple):
    """One recorded flight, as a method may see it."""

    obs: Array  # (K + 1, n_obs) NaN where nothing was measured
    time: Array  # (K + 1,) s, since its first row
    label: Array | None  # (K + 1,) int64 true label of the interval that ends at each sample, where the recording says it
    notes: tuple[str, ...]  # what was mended, in words


def observations(plant: Plant, source: Any, mapping: Mapping | None = None) -> Recording:
    """The observations of a recorded flight.

    Args:
        plant: The plant whose channels are looked for (`plant.observed`).
        source: As for `open_table`: a file, a dict of columns, a data frame, an Arrow table.
        mapping: Which column is what. Default: columns are called as the plant's channels.

    Raises:
        RefusedError: A channel or the time is not there or not a number, a unit that cannot be changed, a label that the
            plant has not, times that its samples cannot be made of.
    """
    table, mapping = open_table(source), mapping or Mapping()
    what, notes = table.source, list(table.notes)
    columns = _columns(plant, table, mapping)
    time = _time(table, mapping)
    truth = _truth_columns(table, mapping)
    texts = [*([time.column] if time else []), *truth]
    values = table.read([c.column for c in columns.values() if c.column not in texts], texts)
    count = len(next(iter(values.values())))
    if count == 0:
        raise RefusedError(f"{what} has no rows")
    if time is None:
        notes.append(f"no time column: rows are taken to be {plant.dt:g} s apart")
        t, stamps = plant.dt * np.arange(count), plant.dt * np.arange(count)
    else:
        unit = time.unit or (table.units[time.column] if table.units[time.column] in TIME else None)
        t, stamps = clock.seconds(values[time.column], unit, f"{what}: {time.column}")
    at = clock.clock(t, plant.dt, what)

    rows = np.full((len(at.t), len(plant.observed)), np.nan)
    for i, (channel, signal) in enumerate(zip(channel_columns(plant), plant.observed, strict=True)):
        if channel in columns:
            rows[:, i] = _scaled(table, columns[channel], signal.unit, values)[at.order]
    if (infinite := int(np.isinf(rows).sum())) > 0:
        notes.append(f"{infinite} values are infinite: taken as missing")
        rows[np.isinf(rows)] = np.nan
    n_y, n_u = len(plant.outputs), len(plant.commands)
    held = rows[:, n_y : n_y + n_u]
    if mapping.commands == "u_k" and n_u:
        notes.append("commands are said to be u_k: moved on by a row")
        breaks = np.diff(at.t) > clock.GAP * at.step
        held = np.vstack([np.full((1, n_u), np.nan), np.where(breaks[:, None], np.nan, held[:-1])])
    obs = np.empty((len(at.samples), rows.shape[1]))
    rest = np.r_[0:n_y, n_y + n_u : rows.shape[1]]
    obs[:, rest] = clock.sensors(at, rows[:, rest], _smooth(plant)[rest])
    obs[:, n_y : n_y + n_u] = clock.commands(at, held)
    _refuse_empty(plant, what, obs, mapping, notes)
    label = None
    if mapping.onset is not None or mapping.label is not None or truth:
        label = _label(plant, table, mapping, values, at, t, stamps, time)
    if mapping.not_recorded:
        notes.append(f"not recorded: {', '.join(dict.fromkeys(mapping.not_recorded))}")
    return Recording(obs, np.round(at.samples - at.t[0], 9), label, (*notes, *at.notes))


def as_record(plant: Plant, recordings: Sequence[Recording]) -> Record:
    """Recorded flights as a record of the plant: what nobody knows (state, fault parameter, target) is NaN.

    After a flight's end its last row is repeated. Where a recording says no labels, they are 0.
    """
    length = np.array([len(r.obs) - 1 for r in recordings], np.int64)
    N, K = len(recordings), int(length.max())
    obs = np.empty((N, K + 1, len(plant.observed)))
    label = np.zeros((N, K + 1), np.int64)
    for i, r in enumerate(recordings):
        obs[i, : length[i] + 1], obs[i, length[i] + 1 :] = r.obs, r.obs[-1]
        if r.label is not None:
            label[i, : length[i] + 1], label[i, length[i] + 1 :] = r.label, r.label[-1]
    state, theta, target = (np.full((N, K + 1, len(s)), np.nan) for s in (plant.states, plant.theta, plant.estimated))
    return Record(obs, state, theta, target, label, length, np.zeros(N, bool))


# ---------------------------------------------------------------------------------------------------------------
# Columns


def _columns(plant: Plant, table: Table, mapping: Mapping) -> dict[str, Column]:
    """Where each channel of the plant is."""
    channels = channel_columns(plant)
    for name in (*mapping.channels, *mapping.not_recorded):
        if name not in channels:
            raise RefusedError(str(unknown("channel", name[:80], channels, f"{plant.id} has")))
    found: dict[str, Column] = {}
    missing = []
    for name in channels:
        if name in mapping.not_recorded:
            continue
        given = mapping.channels.get(name, name)
        column = Column(given) if isinstance(given, str) else given
        if column.column not in table.units:
            if name in mapping.channels:
                raise RefusedError(f"{table.source}: {unknown('column', column.column, table.units, 'it has')}")
            missing.append(name)
        found[name] = column
    if missing:
        raise RefusedError(
            f"{table.source}: there is no column for {', '.join(missing)}; it has {_some(table.units)}. A mapping says "
            'which column is what ({"channels": {"'
            + missing[0]
            + '": "..."}}) and what was '
            + f'"not_recorded": ["{missing[0]}"]'
        )
    return found


def _some(names: Sequence[str] | dict[str, Any]) -> str:
    names = list(names)
    return ", ".join(name[:80] for name in names[:30]) + (f" and {len(names) - 30} more" if len(names) > 30 else "")


def _scaled(table: Table, column: Column, wanted: str, values: dict[str, Array]) -> Array:
    """The values of a column in the plant's unit."""
    unit = column.unit or ("" if column.factor is not None else table.units[column.column])
    factor = column.factor
    if column.unit and factor is not None:
        raise RefusedError(f"{table.source}: {column.column} has a unit or a factor, not both")
    if factor is None and unit:
        factor = factor_between(unit, wanted)
        if factor is None:
            raise RefusedError(
                f"{table.source}: {column.column[:80]} is in {unit[:80]!r}, the plant wants {wanted!r}, and nothing is "
                "known of how one is made of the other: give a factor"
            )
    raw = values[column.column]
    if raw.dtype.kind == "U":  # also the time, or a label
        try:
            raw = np.where(raw == "", "nan", raw).astype(float)
        except ValueError:
            raise RefusedError(f"{table.source}: {column.column} holds text, not numbers") from None
    with np.errstate(over="ignore"):
        return (1.0 if factor is None else factor) * raw + column.offset


def _time(table: Table, mapping: Mapping) -> Time | None:
    if mapping.time is not None:
        time = Time(mapping.time) if isinstance(mapping.time, str) else mapping.time
        if time.column not in table.units:
            raise RefusedError(f"{table.source}: {unknown('column', time.column, table.units, 'it has')}")
        return time
    found = [name for name in table.units if name.lower() in TIMES]
    return Time(found[0]) if found else None


def _smooth(plant: Plant) -> Array:
    """Which channels may be interpolated: no angles that jump by a turn, no quaternions, no signs."""
    jumps = {i for parts in plant.quaternions for i in parts}
    return np.array([s.period == 0 and i not in jumps for i, s in enumerate(plant.observed)])


def _refuse_empty(plant: Plant, what: str, obs: Array, mapping: Mapping, notes: list[str]) -> None:
    n_y = len(plant.outputs)
    if not np.isfinite(obs[:, :n_y]).any():
        raise RefusedError(f"{what} holds no value of any sensor")
    for name, column in zip(channel_columns(plant), obs.T, strict=True):
        share = float(np.isfinite(column).mean())
        if share == 0 and name not in mapping.not_recorded:
            notes.append(f"{name} holds no value")


# ---------------------------------------------------------------------------------------------------------------
# Truth


def _truth_columns(table: Table, mapping: Mapping) -> list[str]:
    """The columns in which the truth is; by default "label", or "onset" with "end" and "fault", where they are there."""
    label, onset = _labels(table, mapping), _onset(table, mapping)
    named = [label.column] if label else [c for c in (onset.column, onset.end, onset.fault) if c] if onset else []
    for name in named:
        if name not in table.units:
            raise RefusedError(f"{table.source}: {unknown('column', name, table.units, 'it has')}")
    return named


def _labels(table: Table, mapping: Mapping) -> Labels | None:
    if mapping.label is not None:
        return Labels(mapping.label) if isinstance(mapping.label, str) else mapping.label
    return Labels("label") if mapping.onset is None and "label" in table.units else None


def _onset(table: Table, mapping: Mapping) -> Onset | None:
    if mapping.onset is None and (mapping.label is not None or "onset" not in table.units):
        return None
    if isinstance(mapping.onset, Onset):
        return mapping.onset
    beside = [name if name in table.units else None for name in ("end", "fault")]
    return Onset(mapping.onset or "onset", beside[0], beside[1])


def _label(
    plant: Plant, table: Table, mapping: Mapping, values: dict[str, Array], at: clock.Clock, t: Array, stamps: Array,
    time: Time | None,
) -> Array:  # fmt: skip
    """The true label at each sample (K + 1,)."""
    found = _labels(table, mapping)
    if found is not None:
        text = values[found.column][at.order]
        index = {word: label_index(plant, str(word), found.names, table.source) for word in np.unique(text)}
        rows = np.array([index[word] for word in text], np.int64)
        return rows[clock.following(at)]
    onset = _onset(table, mapping)
    assert onset is not None
    begin, end = (_moment(table, name, values, t, stamps, time) for name in (onset.column, onset.end))
    label = np.zeros(len(at.samples), np.int64)
    if begin is None:
        return label
    words = [w for w in np.unique(values[onset.fault]) if w.strip()] if onset.fault else []
    if len(words) > 1:
        raise RefusedError(f"{table.source}: {onset.fault} names more than one fault: {_some(words)}")
    if words:
        fault = label_index(plant, str(words[0]), onset.names, table.source)
    elif len(plant.labels) == 2:
        fault = 1
    else:
        raise RefusedError(f"{table.source}: which fault began is in no column; {plant.id} has {len(plant.labels) - 1}")
    ends = at.samples - 1e-6 * plant.dt  # of intervals, a rounding error earlier
    label[(ends > begin) & (ends <= (np.inf if end is None else end))] = fault
    return label


def _moment(
    table: Table, name: str | None, values: dict[str, Array], t: Array, stamps: Array, time: Time | None
) -> float | None:
    """The one time that a column holds, on the recording's clock; None where it is empty."""
    words = [] if name is None else [w for w in np.unique(values[name]) if w.strip() and w.strip().lower() != "nan"]
    if not words:
        return None
    if len(words) > 1:
        raise RefusedError(f"{table.source}: {name} holds one time for the flight, not {len(words)}")
    unit = time.unit or (table.units[time.column] if table.units[time.column] in TIME else None) if time else None
    moment = clock.seconds(np.array(words), unit, f"{table.source}: {name}")[1][0]
    if not np.isfinite(moment):
        raise RefusedError(f"{table.source}: {name} holds {str(words[0])[:80]!r}, which is no time")
    first = np.flatnonzero(np.isfinite(t))[0]
    return float(moment - stamps[first] + t[first])


def label_index(plant: Plant, word: str, names: dict[str, str], source: str) -> int:
    """The label that a recording means by a word: its name or index, or what `names` makes of it."""
    word = word.strip()
    said = names.get(word, word)
    known = [label.name for label in plant.labels]
    if said in known:
        return known.index(said)
    folded = [name.lower() for name in known]
    if folded.count(said.lower()) == 1:
        return folded.index(said.lower())
    try:
        number = float(said)
    except ValueError:
        number = np.nan
    if number in range(len(known)):
        return int(number)
    raise RefusedError(f"{source}: {unknown('label', said[:80], known, f'{plant.id} has')}, or their numbers from 0")
