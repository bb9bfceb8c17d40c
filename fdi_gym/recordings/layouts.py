"""How collections of recordings are laid out: whose files these are, which table each flight is, and what is known of it.

    columns   CSV or Parquet files, one a flight
    skab      Skoltech Anomaly Benchmark: CSV separated by ";", "anomaly" and "changepoint" beside the sensors; files of its
              folder "anomaly-free" have neither
    braatz    Tennessee Eastman process as Chiang, Russell and Braatz simulated it: d00.dat to d21.dat (training) and
              d00_te.dat to d21_te.dat (test; the fault acts from sample 160 on), 52 columns without a head, d00.dat on its
              side
    alfa      AirLab Failure and Anomaly flights: a folder a flight with a CSV for each topic; what failed, and from when on,
              is in the topics "failure_status-..."

Nothing of these collections is shipped. A reader gives a `Table` with a column "label" for each flight.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fdi_gym.files import RefusedError
from fdi_gym.recordings.channels import Channel, Channels
from fdi_gym.recordings.tables import Table, open_table, table_files

Array = np.ndarray

FILES = 10_000  # of a collection


class Layout(NamedTuple):
    """How a collection is read."""

    flights: Callable[[Path], list[Path]]  # the files or folders that are flights
    table: Callable[[Path], Table]
    channels: Callable[[Sequence[Path]], Channels] | None  # what is recorded, where the collection says it


# ---------------------------------------------------------------------------------------------------------------
# SKAB


def _skab_flights(folder: Path) -> list[Path]:
    return _some(folder, [path for path in folder.rglob("*.csv") if path.is_file()], ".csv files")


def _some(folder: Path, found: Sequence[Path], what: str) -> list[Path]:
    if not found:
        raise RefusedError(f"{folder} holds no {what}")
    if len(found) > FILES:
        raise RefusedError(f"{folder} holds more than {FILES} {what}")
    return sorted(found)


def _skab_table(path: Path) -> Table:
    table = open_table(path, separator=";")
    if "datetime" not in table.units:
        raise RefusedError(f"{path} is no file of SKAB: it has no column 'datetime'")

    def read(numbers: Sequence[str], texts: Sequence[str]) -> dict[str, Array]:
        has = "anomaly" in table.units
        others = [name for name in texts if name != "label"]
        found = table.read([*numbers, *(["anomaly"] if has and "label" in texts else [])], others)
        if "label" in texts:
            anomaly = found.pop("anomaly") if has else np.zeros(len(next(iter(found.values()))))
            found["label"] = np.where(np.nan_to_num(anomaly) > 0.5, "anomaly", "none")
        return found

    units = {name: unit for name, unit in table.units.items() if name not in ("anomaly", "changepoint")}
    return Table(str(path), {**units, "label": ""}, read)


def _skab_channels(flights: Sequence[Path]) -> Channels:
    names = [name for name in _skab_table(flights[0]).units if name not in ("datetime", "label")]
    return Channels(dt=1.0, sensors=[Channel(name) for name in names], labels=["anomaly"])


# ---------------------------------------------------------------------------------------------------------------
# Tennessee Eastman

_BRAATZ = re.compile(r"d(?P<fault>\d\d)(?P<test>_te)?\.dat")
_MEASURED, _MANIPULATED = 41, 11
_STEP, _ONSET = 180.0, 160  # s; samples of a test flight before its fault
_FAULTS = 21


def _braatz_flights(folder: Path) -> list[Path]:
    return _some(folder, [path for path in folder.iterdir() if _BRAATZ.fullmatch(path.name)], "files d00.dat to d21_te.dat")


def _braatz_table(path: Path) -> Table:
    said = _BRAATZ.fullmatch(path.name)
    if said is None or int(said["fault"]) > _FAULTS:
        raise RefusedError(f"{path} is no file of the Tennessee Eastman flights: those are d00.dat to d21_te.dat")
    raw = open_table(path, header=False, separator=" ")
    width = _MEASURED + _MANIPULATED
    values = np.column_stack(list(raw.read(list(raw.units), []).values()))
    if values.shape[1] != width and values.shape[0] == width:
        values = values.T  # d00.dat lies on its side
    if values.shape[1] != width:
        raise RefusedError(f"{path} has {values.shape[1]} columns, not {width}")
    fault = int(said["fault"])
    label = np.full(len(values), f"IDV {fault}" if fault else "none", dtype="U8")
    if said["test"]:
        label[:_ONSET] = "none"
    names = _braatz_names()
    columns = {"time": _STEP * np.arange(len(values)), **dict(zip(names, values.T, strict=True)), "label": label}
    return open_table(columns)._replace(source=str(path))


def _braatz_names() -> list[str]:
    return [*(f"XMEAS({i + 1})" for i in range(_MEASURED)), *(f"XMV({i + 1})" for i in range(_MANIPULATED))]


def _braatz_channels(flights: Sequence[Path]) -> Channels:
    names = _braatz_names()
    return Channels(
        dt=_STEP, sensors=[Channel(name) for name in names[:_MEASURED]],
        commands=[Channel(name) for name in names[_MEASURED:]], labels=[f"IDV {i + 1}" for i in range(_FAULTS)],
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------
# ALFA

_FAILURE = "failure_status-"
_ALFA_STEP = 0.2  # s
_ALFA = ("nav_info-roll", "nav_info-pitch", "nav_info-yaw", "nav_info-airspeed")  # what is measured, and what is commanded
_ALFA_FAULTS = ("engines", "aileron", "rudder", "elevator")


def _alfa_flights(folder: Path) -> list[Path]:
    found = {path.parent for path in folder.rglob("*-mavros-*.csv")}
    return _some(folder, list(found), "folders with files of topics, ...-mavros-....csv")


def _alfa_topics(flight: Path) -> dict[str, Path]:
    """The files of a flight by topic."""
    found = {}
    for path in sorted(flight.glob("*.csv")):
        name = path.stem.removeprefix(f"{flight.name}-")
        topic = re.search(r"(?:^|-)(?:mavros-)?((?:nav_info|failure_status)-\w+)$", name)
        if topic:
            found[topic[1]] = path
    return found


def _alfa_table(flight: Path) -> Table:
    """Measured and commanded values as they were last at even times, and the label from the first sign of a failure on."""
    topics = _alfa_topics(flight)
    measured = {topic: _alfa_topic(topics[topic]) for topic in _ALFA if topic in topics}
    if not measured:
        raise RefusedError(f"{flight} is no flight of ALFA: it has none of the topics {', '.join(_ALFA)}")
    first = min(times[0] for times, _ in measured.values())
    last = max(times[-1] for times, _ in measured.values())
    if not 0 < last - first < 1e6:
        raise RefusedError(f"{flight}: its topics span {last - first:.6g} s")
    time = np.arange(first, last + 1e-9, _ALFA_STEP)
    columns: dict[str, Array] = {"time": time - first}
    for topic in _ALFA:
        times, values = measured.get(topic, (time[:1], {"measured": np.full(1, np.nan), "commanded": np.full(1, np.nan)}))
        at = np.searchsorted(times, time + 1e-9) - 1  # the last value up to then
        fresh = (at >= 0) & (time - times[np.maximum(at, 0)] < 5 * _ALFA_STEP)
        for kind, column in values.items():
            columns[f"{topic.removeprefix('nav_info-')} {kind}"] = np.where(fresh, column[np.maximum(at, 0)], np.nan)
    columns["label"] = np.full(len(time), "none", dtype="U8")
    for fault in _ALFA_FAULTS:
        if _FAILURE + fault in topics and (onset := _alfa_onset(topics[_FAILURE + fault])) is not None:
            columns["label"][time >= onset] = fault
    return open_table(columns)._replace(source=str(flight))


def _alfa_times(path: Path, *columns: str) -> tuple[Array, dict[str, Array]]:
    table = open_table(path, separator=",")
    for name in ("%time", *columns):
        if name not in table.units:
            raise RefusedError(f"{path} is no topic of ALFA: it has no column {name!r}")
    found = table.read(["%time", *columns], [])
    there = np.isfinite(found["%time"])
    order = np.argsort(found["%time"][there], kind="stable")
    return found["%time"][there][order] * 1e-9, {name: found[name][there][order] for name in columns}


def _alfa_topic(path: Path) -> tuple[Array, dict[str, Array]]:
    times, found = _alfa_times(path, "field.measured", "field.commanded")
    if not len(times):
        raise RefusedError(f"{path} has no rows")
    return times, {name.removeprefix("field."): values for name, values in found.items()}


def _alfa_onset(path: Path) -> float | None:
    times, found = _alfa_times(path, "field.data")
    failed = np.flatnonzero(np.nan_to_num(found["field.data"]) != 0)
    return float(times[failed[0]]) if failed.size else None


def _alfa_channels(flights: Sequence[Path]) -> Channels:
    names = [topic.removeprefix("nav_info-") for topic in _ALFA]
    units = {"roll": "deg", "pitch": "deg", "yaw": "deg", "airspeed": "m/s"}
    return Channels(
        dt=_ALFA_STEP, sensors=[Channel(f"{n} measured", units[n]) for n in names],
        commands=[Channel(f"{n} commanded", units[n]) for n in names], labels=list(_ALFA_FAULTS),
    )  # fmt: skip


LAYOUTS: Mapping[str, Layout] = {
    "columns": Layout(table_files, open_table, None),
    "skab": Layout(_skab_flights, _skab_table, _skab_channels),
    "braatz": Layout(_braatz_flights, _braatz_table, _braatz_channels),
    "alfa": Layout(_alfa_flights, _alfa_table, _alfa_channels),
}
