"""Rows: one entry of a leaderboard as a small JSON file, with the outcomes of its episodes compressed beside it.

    results/<suite>/<diagnoser>.json          the row
    results/<suite>/<diagnoser>.outcomes.gz   one line of JSON per episode
    results/<suite>/made.json                 how the suite's rows were made: nobody checks that

Everything in a row is compared with what the code says (`fdi_gym.verification`); what nobody can check is not in it.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from fdi_gym.files import (
    RefusedError,
    compress,
    decode,
    decompress,
    digest,
    pretty,
    read_bytes,
    read_json,
    sweep,
    write_whole,
)
from fdi_gym.metrics import Outcome, check_outcomes
from fdi_gym.names import check_diagnoser_name, check_name, file_name
from fdi_gym.plant import Plant
from fdi_gym.suite import AnySuite

LARGEST = 2**20  # bytes of a row's file
MADE = "made.json"


class Row(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One entry of a leaderboard.

    Args:
        schema: Of this file.
        suite, suite_sha256: What was run.
        diagnoser: Its name, or "module:function".
        settings: What its builder got, in full: the plant's tuning, the process it is told, the suite's settings.
        digests: SHA-256 of the outcomes and of what made them (`fdi_gym.provenance`).
        metrics: The scores; they follow from the outcomes.
        sha256: Digest of all the rest.

    Raises:
        ValueError: A name that cannot be one.
    """

    schema: Literal[1] = 1
    suite: str
    suite_sha256: str
    diagnoser: str
    settings: dict[str, Any]
    digests: dict[str, str]
    metrics: dict[str, Any]
    sha256: str = ""

    def __post_init__(self) -> None:
        check_name("suite", self.suite)
        check_diagnoser_name(self.diagnoser)

    def content_sha256(self) -> str:
        """The digest that `sha256` must equal."""
        return digest({k: v for k, v in msgspec.structs.asdict(self).items() if k != "sha256"})

    def sealed(self) -> Row:
        """The row as a reader will see it, with its digest."""
        row = msgspec.json.decode(msgspec.json.encode(self), type=Row)
        return msgspec.structs.replace(row, sha256=row.content_sha256())

    def changed(self, digests: Mapping[str, str]) -> list[str]:
        """Which of the digests of what made it are others than these, by name."""
        mine = {k: v for k, v in self.digests.items() if k != "outcomes"}
        return sorted(k for k in {*mine, *digests} if mine.get(k) != digests.get(k))

    def made_by(self, digests: Mapping[str, str]) -> Row:
        """The same row with these digests of what made it."""
        return msgspec.structs.replace(self, digests={"outcomes": self.digests["outcomes"], **digests}).sealed()


class Made(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a row was made: what no second run gives again, or nobody can check."""

    command: str
    versions: dict[str, str]
    microseconds: float  # of processor time per sample


class Evaluated(NamedTuple):
    """A row with what belongs to it."""

    row: Row
    outcomes: list[Outcome]
    made: Made


def outcomes_text(outcomes: Sequence[Outcome]) -> bytes:
    """The outcomes as lines of JSON: what their digest is of."""
    return msgspec.json.Encoder().encode_lines(outcomes)


def outcomes_digest(outcomes: Sequence[Outcome]) -> str:
    """SHA-256 of `outcomes_text`."""
    return hashlib.sha256(outcomes_text(outcomes)).hexdigest()


def row_path(results: Path, suite: str, diagnoser: str) -> Path:
    """Where a row lies."""
    return results / check_name("suite", suite) / f"{file_name(diagnoser)}.json"


def outcomes_path(row: Path) -> Path:
    """Where the outcomes of a row lie."""
    return row.with_suffix(".outcomes.gz")


def read_row(path: Path) -> Row:
    """A row from its file.

    Raises:
        RefusedError: It is not a row as `write_rows` writes one, or of another name than its file.
    """
    row = read_json(path, Row, "row", LARGEST)
    if path.name != f"{file_name(row.diagnoser)}.json":
        raise RefusedError(f"{path} is the row of {row.diagnoser}, which belongs into {file_name(row.diagnoser)}.json")
    if row.sha256 != row.content_sha256():
        raise RefusedError(f"{path} was edited: its digest is {row.content_sha256()[:12]}, it says {row.sha256[:12]}")
    if pretty(row) != read_bytes(path, LARGEST):
        raise RefusedError(f"{path} is not written as rows are: something stands in it that is not read")
    return row


def read_outcomes(path: Path, row: Row, plant: Plant) -> list[Outcome]:
    """The outcomes that lie beside a row.

    Args:
        path: Of the row.
        row: The row.
        plant: The suite's plant.

    Raises:
        RefusedError: There are none, they are not the row's, or no flights of this plant can have them.
    """
    path = outcomes_path(path)
    text = decompress(read_bytes(path), f"{path} does not hold outcomes")
    if hashlib.sha256(text).hexdigest() != row.digests.get("outcomes"):
        raise RefusedError(f"{path} does not hold the outcomes of the row beside it: the digest differs")
    outcomes = [decode(line, Outcome, f"{path} does not hold outcomes") for line in text.splitlines()]
    try:
        check_outcomes(outcomes, len(plant.labels), len(plant.estimated))
    except ValueError as error:
        raise RefusedError(f"{path}: {error}") from None
    return outcomes


def read_made(folder: Path) -> dict[str, Made]:
    """How the rows in a suite's folder were made, where that was written down.

    Raises:
        RefusedError: The file is damaged.
    """
    path = folder / MADE
    return read_json(path, dict[str, Made], "record of how rows were made") if path.exists() else {}


def row_files(folder: Path) -> Iterator[Path]:
    """The files of the rows in a suite's folder."""
    return (path for path in sorted(folder.glob("*.json")) if path.name != MADE)


def check_writable(
    results: Path, suite: AnySuite, names: Iterable[str], digests: Callable[[str], Mapping[str, str]], replace: bool = False
) -> None:
    """Make sure, before anything runs, that rows can be written and nothing would be lost.

    Args:
        results: Folder of all rows.
        suite: The suite.
        names: Diagnosers whose rows will be written.
        digests: Gives the digests of what will make a diagnoser's row; asked where a row is there that may not go.
        replace: Rows of the same suite that something else has made may go.

    Raises:
        ValueError: The folder cannot be written; a file there is damaged, a row of another version of the suite, or one
            that something else has made.
    """
    folder = results / suite.name
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".probe-{os.getpid()}"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise ValueError(f"cannot write results to {folder}: {error.strerror or error}") from error
    sweep(folder)
    read_made(folder)
    for name in names:
        path = row_path(results, suite.name, name)
        if not path.exists():
            continue
        old = read_row(path)
        if old.suite_sha256 != suite.sha256:
            raise ValueError(
                f"{path} is from another version of {suite.name} "
                f"({old.suite_sha256[:12]}, here is {suite.sha256[:12]}); move it away first"
            )
        changed = [] if replace else old.changed(digests(name))
        if (changed or old.diagnoser != name) and not replace:
            raise ValueError(
                f"{path} was made by another {' and '.join(changed) or 'diagnoser'}; move it away, or --replace"
            )


def write_rows(results: Path, suite: AnySuite, evaluated: Mapping[str, Evaluated]) -> None:
    """Write rows and their outcomes, and how they were made into the file beside them.

    Raises:
        OSError: They cannot be written.
    """
    folder = results / suite.name
    folder.mkdir(parents=True, exist_ok=True)
    made = read_made(folder)
    for name, found in evaluated.items():
        path = row_path(results, suite.name, name)
        write_whole(outcomes_path(path), compress(outcomes_text(found.outcomes)))
        write_whole(path, pretty(found.row))
        made[name] = found.made
    write_whole(folder / MADE, pretty(dict(sorted(made.items()))))
