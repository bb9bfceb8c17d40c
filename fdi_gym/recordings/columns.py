"""Columns: how a plant's channels are called in a table, a recorded flight as columns, and tables as files."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fdi_gym.engine import Record
from fdi_gym.files import write_whole
from fdi_gym.plant import Array, Plant
from fdi_gym.recordings.tables import need


def channel_columns(plant: Plant) -> tuple[str, ...]:
    """The names of the observed channels as columns: the data sheet's; of two of a name, the later says what it is."""
    n_y, n_u = len(plant.outputs), len(plant.commands)
    found: list[str] = []
    for i, signal in enumerate(plant.observed):
        kind = "sensor" if i < n_y else "command" if i < n_y + n_u else "known"
        found.append(signal.name if signal.name not in found else f"{signal.name} {kind}")
    return tuple(found)


def units_of(plant: Plant) -> dict[str, str]:
    """The units of the columns that `to_frame` gives."""
    channels = dict(zip(channel_columns(plant), (s.unit for s in plant.observed), strict=True))
    truth = {f"{kind}: {s.name}": s.unit for kind, signals in _truth(plant) for s in signals}
    return {"time": "s", **channels, "label": "", **truth}


def _truth(plant: Plant):
    return (("state", plant.states), ("theta", plant.theta), ("estimated", plant.estimated))


def to_frame(plant: Plant, record: Record, flight: int = 0, truth: bool = False) -> dict[str, Array]:
    """One flight of a record as columns: "time" [s], the observed channels by name, "label" (the true one's name).

    `pandas.DataFrame(to_frame(plant, record))` is a data frame, and `observations` reads it back.

    Args:
        plant: The plant of the record; a record does not know its channels' names.
        record: The record.
        flight: Which of its flights.
        truth: Also the state, the fault parameter and the estimated quantity: "state: ...", "theta: ...", "estimated: ...".
    """
    samples = int(record.length[flight]) + 1
    names = np.array([label.name for label in plant.labels])
    found: dict[str, Array] = {"time": np.round(plant.dt * np.arange(samples), 9)}
    found |= dict(zip(channel_columns(plant), record.obs[flight, :samples].T, strict=True))
    found["label"] = names[record.label[flight, :samples]]
    if truth:
        for (kind, signals), rows in zip(_truth(plant), (record.state, record.theta, record.target), strict=True):
            found |= {f"{kind}: {s.name}": rows[flight, :samples, i] for i, s in enumerate(signals)}
    return found


def write_table(path: Path, columns: Mapping[str, Array], units: Mapping[str, str]) -> None:
    """Write columns as Parquet (units in the columns' metadata) or as CSV (units in its head, "p [deg/s]"), whole.

    Args:
        path: Its name ends in ".parquet" or ".csv".
        columns: By name; numbers or text, NaN where nothing is.
        units: By name.

    Raises:
        RefusedError: Parquet without pyarrow.
        OSError: It cannot be written.
    """
    if path.suffix == ".parquet":
        need("pyarrow", "Parquet")
        import pyarrow as pa
        import pyarrow.parquet as pq

        arrays = {name: pa.array(values) for name, values in columns.items()}
        fields = [pa.field(n, a.type, metadata={"unit": units[n]} if units.get(n) else None) for n, a in arrays.items()]
        sink = io.BytesIO()
        pq.write_table(pa.table(list(arrays.values()), schema=pa.schema(fields)), sink)
        write_whole(path, sink.getvalue())
        return
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([f"{name} [{units[name]}]" if units.get(name) else name for name in columns])
    cells = [
        ["" if v != v else repr(v) for v in values.tolist()] if values.dtype.kind == "f" else values.tolist()
        for values in columns.values()
    ]  # fmt: skip
    writer.writerows(zip(*cells, strict=True))
    write_whole(path, text.getvalue().encode())
