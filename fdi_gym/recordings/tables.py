"""Tables of columns from outside: CSV and Parquet files, and whatever has columns in memory.

A file is read in pieces, only the columns that are asked for, within bounds; what is beyond them or is not what it says is
refused in words. Parquet needs pyarrow, CSV nothing.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.faults import MAX_STEPS
from fdi_gym.files import RefusedError

Array = np.ndarray

ROWS = MAX_STEPS + 1
COLUMNS = 10_000
BYTES = 2**31  # of a file
LINE = 2**20  # characters of a line
PIECE = 20_000  # rows that are held as text
SEPARATORS = ",;\t|"
MISSING = ("", "nan", "na", "n/a", "null", "none", "-")
SUFFIXES = (".csv", ".parquet", ".txt", ".tsv", ".dat")

_UNIT = re.compile(r"^(?P<name>.*\S)\s*\[(?P<unit>[^\[\]]*)\]$")
_COMMA = re.compile(r"^\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*$")


class Table(NamedTuple):
    """Columns by name, not yet read.

    `read(numbers, texts)` gives the columns of these names as float64 (NaN where nothing is) and as text.
    """

    source: str  # for messages
    units: dict[str, str]  # of all columns, in order; "" where none is said
    read: Callable[[Sequence[str], Sequence[str]], dict[str, Array]]
    notes: tuple[str, ...] = ()


def need(library: str, what: str) -> Any:
    """An optional library, imported.

    Raises:
        RefusedError: It is not installed.
    """
    import importlib

    try:
        return importlib.import_module(library)
    except ImportError:
        extra = {"pyarrow": "data", "minari": "minari"}[library.split(".")[0]]
        raise RefusedError(f"{what} needs {library.split('.')[0]}: pip install 'fdi-gym[{extra}]'") from None


def table_files(place: Path) -> list[Path]:
    """The recordings that a path names: the file itself, or the CSV and Parquet files of a folder, by name.

    Raises:
        RefusedError: There is nothing, or no such file.
    """
    if place.is_dir():
        found = sorted(path for path in place.iterdir() if path.suffix.lower() in (".csv", ".parquet") and path.is_file())
        if not found:
            raise RefusedError(f"{place} holds no .csv or .parquet files")
        return found
    if place.suffix.lower() not in SUFFIXES:
        raise RefusedError(f"{place} is no recording: its name ends in {', '.join(SUFFIXES)}, or it is a folder of them")
    if not place.is_file():
        raise RefusedError(f"{place} is no file")
    return [place]


def open_table(source: Any, *, header: bool = True, separator: str | None = None) -> Table:
    """The columns of a file (CSV, Parquet), a dict of arrays, a data frame (pandas, polars) or an Arrow table.

    Args:
        source: The path or object.
        header: The first line of a text file names the columns; else they are "1", "2", ...
        separator: Of a text file's columns; " " for any white space. Default: the one of ",;|" and tab in the first line.

    Raises:
        RefusedError: It is none of these, too large, damaged, or has no columns.
    """
    if isinstance(source, Table):
        return source
    if not isinstance(source, (str, Path)):
        return _in_memory(source)
    path = Path(source)
    if not path.is_file():  # a pipe or a device would be read for ever
        raise RefusedError(f"{path} is no file")
    if path.stat().st_size > BYTES:
        raise RefusedError(f"{path} is larger than {BYTES} bytes")
    return _parquet(path) if path.suffix.lower() == ".parquet" else _text(path, header, separator)


def _named(source: str, names: Sequence[str], units: Sequence[str] | None = None) -> tuple[dict[str, str], dict[str, str]]:
    """Units by name, and how the columns are really called, from names such as "p [deg/s]"."""
    if not names:
        raise RefusedError(f"{source} has no columns")
    if len(names) > COLUMNS:
        raise RefusedError(f"{source} has {len(names)} columns; up to {COLUMNS} are read")
    found: dict[str, str] = {}
    real: dict[str, str] = {}
    for i, name in enumerate(names):
        split = _UNIT.match(name.strip())
        short, unit = (split["name"], split["unit"].strip()) if split else (name.strip(), "")
        if short in found:
            raise RefusedError(f"{source} has two columns called {short[:80]!r}")
        found[short], real[short] = unit or (units[i] if units else ""), name
    return found, real


# ---------------------------------------------------------------------------------------------------------------
# Text


def _lines(path: Path) -> Iterator[str]:
    """The lines of a text file, none of them without end."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        number = 0
        while True:
            number += 1
            try:
                line = file.readline(LINE)
            except UnicodeDecodeError:
                raise RefusedError(f"{path}: it is not text in UTF-8, near line {number}") from None
            if not line:
                return
            if len(line) >= LINE and not line.endswith("\n"):
                raise RefusedError(f"{path}: line {number} has {LINE} characters or more: it is no table")
            if "\0" in line:
                raise RefusedError(f"{path}: line {number} holds a zero byte: it is not text")
            yield line


def _cells(path: Path, separator: str) -> Iterator[tuple[int, list[str]]]:
    """(number, cells) of the lines that are not empty."""
    if separator == " ":
        yield from ((i, line.split()) for i, line in enumerate(_lines(path), 1) if line.strip())
        return
    reader = csv.reader(_lines(path), delimiter=separator, skipinitialspace=True)
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                yield reader.line_num, cells
    except csv.Error as error:
        raise RefusedError(f"{path}: line {reader.line_num}: {error}") from None


def _text(path: Path, header: bool, separator: str | None) -> Table:
    first = next((line for line in _lines(path) if line.strip()), None)
    if first is None:
        raise RefusedError(f"{path} is empty")
    if separator is None:
        separator = max(SEPARATORS, key=first.count)
    head = next(cells for _, cells in _cells(path, separator))
    if len(head) < 2 and header:
        raise RefusedError(
            f"{path} has one column, {head[0].strip()[:80]!r}: columns are separated by ',', ';', '|' or tabs"
        )
    names = head if header else [str(i + 1) for i in range(len(head))]
    units, real = _named(str(path), names)
    place = {name: i for i, name in enumerate(real)}

    def read(numbers: Sequence[str], texts: Sequence[str]) -> dict[str, Array]:
        wanted = [(name, place[name], name in numbers) for name in dict.fromkeys([*numbers, *texts])]
        pieces: dict[str, list[Array]] = {name: [] for name, _, _ in wanted}
        held: list[list[str]] = []
        at: list[int] = []

        def finish() -> None:
            for name, i, as_number in wanted:
                cells = [row[i] for row in held]
                pieces[name].append(_numbers(path, name, cells, at, separator) if as_number else _texts(cells))
            held.clear()
            at.clear()

        rows = _cells(path, separator)
        if header:
            next(rows)
        for count, (number, cells) in enumerate(rows):
            if len(cells) != len(names):
                raise RefusedError(f"{path}: line {number} has {len(cells)} cells, the first one has {len(names)}")
            if count == ROWS:
                raise RefusedError(f"{path} has more than {ROWS} rows")
            held.append(cells)
            at.append(number)
            if len(held) == PIECE:
                finish()
        finish()
        return {name: np.concatenate(found) for name, found in pieces.items()}

    return Table(str(path), units, read)


def _texts(cells: Sequence[str]) -> Array:
    return np.array([cell.strip() for cell in cells], dtype=str) if cells else np.zeros(0, "U1")


def _numbers(path: Path, name: str, cells: list[str], at: Sequence[int], separator: str) -> Array:
    try:
        return np.array(cells, dtype=str).astype(float) if cells else np.zeros(0)
    except ValueError:
        pass
    found = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        try:
            found[i] = float(cell)
        except ValueError:
            if separator != "," and _COMMA.match(cell):  # "0,5", as where columns are separated by ";"
                found[i] = float(cell.replace(",", "."))
            elif cell.strip().lower() in ("true", "false"):
                found[i] = float(cell.strip().lower() == "true")
            elif cell.strip().lower() not in MISSING:
                raise RefusedError(f"{path}: line {at[i]}: {name} is a number, not {cell[:80]!r}") from None
    return found


# ---------------------------------------------------------------------------------------------------------------
# Parquet, and tables in memory


def _parquet(path: Path) -> Table:
    need("pyarrow", f"{path}: Parquet")
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(path)
        schema, rows = file.schema_arrow, file.metadata.num_rows
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        raise RefusedError(f"{path} is not a Parquet file: {' '.join(str(error).split())[:300]}") from None
    if rows > ROWS:
        raise RefusedError(f"{path} has more than {ROWS} rows")
    said = [(field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace") for field in schema]
    units, real = _named(str(path), schema.names, said)

    def read(numbers: Sequence[str], texts: Sequence[str]) -> dict[str, Array]:
        wanted = list(dict.fromkeys([*numbers, *texts]))
        pieces: dict[str, list[Array]] = {name: [] for name in wanted}
        count = 0
        try:
            for batch in pq.ParquetFile(path).iter_batches(PIECE, columns=[real[name] for name in wanted]):
                count += batch.num_rows
                if count > ROWS:
                    raise RefusedError(f"{path} has more than {ROWS} rows")
                for name in wanted:
                    pieces[name].append(_column(str(path), name, batch.column(real[name]), name in numbers))
        except (pa.ArrowException, OSError) as error:
            raise RefusedError(f"{path} cannot be read: {' '.join(str(error).split())[:300]}") from None
        return {name: np.concatenate(found) if found else np.zeros(0) for name, found in pieces.items()}

    return Table(str(path), units, read)


def _column(source: str, name: str, values: Any, as_number: bool) -> Array:
    """An Arrow array as numbers or text."""
    import pyarrow as pa

    kind = values.type.value_type if pa.types.is_dictionary(values.type) else values.type
    if pa.types.is_dictionary(values.type):
        values = values.cast(kind)
    plain = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind) or pa.types.is_null(kind)
    stamp = pa.types.is_timestamp(kind)
    if as_number and plain:
        return (
            values.cast(pa.int8() if pa.types.is_boolean(kind) else kind).cast(pa.float64()).to_numpy(zero_copy_only=False)
        )
    if not as_number and (plain or stamp or pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        if pa.types.is_floating(kind):
            return values.to_numpy(zero_copy_only=False).astype(str)
        return np.array(["" if v is None else v for v in values.cast(pa.string()).to_pylist()], dtype=str)
    raise RefusedError(f"{source}: {name} holds {str(kind)[:80]}, not {'numbers' if as_number else 'numbers or text'}")


def _in_memory(source: Any) -> Table:
    """A mapping of columns, or an object with `columns` (pandas, polars) or `column_names` (Arrow) and []."""
    names: Any = list(source) if isinstance(source, Mapping) else None
    for attribute in ("column_names", "columns"):
        found = getattr(source, attribute, None)
        if names is None and found is not None and not callable(found):
            names = list(found)
    if names is None or not all(isinstance(name, str) for name in names):
        raise RefusedError(f"a recording is a file, or has columns by name; {type(source).__name__} has not")
    what = type(source).__name__
    units, real = _named(what, names)
    schema = getattr(source, "schema", None)
    for short, name in real.items() if hasattr(schema, "field") else ():
        units[short] = units[short] or (schema.field(name).metadata or {}).get(b"unit", b"").decode()  # type: ignore[union-attr]

    def one(name: str, as_number: bool) -> Array:
        values = source[real[name]]
        values = values.combine_chunks() if hasattr(values, "combine_chunks") else values
        if type(values).__module__.startswith("pyarrow"):
            return _column(what, name, values, as_number)
        array = np.asarray(values)
        if array.ndim != 1:
            raise RefusedError(f"{what}: {name} is one column, not an array of the shape {array.shape}")
        if len(array) > ROWS:
            raise RefusedError(f"{what} has more than {ROWS} rows")
        if not as_number:
            return np.array(["" if v is None or v != v else str(v) for v in array.tolist()] if array.dtype == object
                            else array.astype(str), dtype=str)  # fmt: skip
        try:
            return array.astype(float)
        except (TypeError, ValueError):
            raise RefusedError(f"{what}: {name} holds {array.dtype}, not numbers") from None

    def read(numbers: Sequence[str], texts: Sequence[str]) -> dict[str, Array]:
        found = {name: one(name, name in numbers) for name in dict.fromkeys([*numbers, *texts])}
        lengths = {name: len(values) for name, values in found.items()}
        if len(set(lengths.values())) > 1:
            raise RefusedError(f"{what}: its columns differ in length: {lengths}")
        return found

    return Table(what, units, read)
