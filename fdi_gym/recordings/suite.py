"""Recorded suites: flights that somebody has recorded, with their labels, scored as drawn ones are.

The file of a suite lies beside the recordings, names each with its digest, and says which plant they are of or, where no
equations are known, which channels they have.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import Record
from fdi_gym.files import RefusedError, digest, pretty, read_json, write_whole
from fdi_gym.names import check_diagnoser_name, check_name, find_module, unknown
from fdi_gym.plant import Plant
from fdi_gym.recordings.channels import Channels, channels_plant
from fdi_gym.recordings.layouts import FILES, LAYOUTS
from fdi_gym.recordings.mapping import Mapping
from fdi_gym.recordings.observations import Recording, as_record, observations
from fdi_gym.recordings.tables import BYTES

LARGEST = 2**23  # bytes of a suite's file
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


class RecordedSuite(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What was recorded.

    Args:
        name: Name of the file, without ".json".
        description: One line for the table.
        plant: Plant id, "module:id" where the module registers it; or the id that the channels get.
        options: Options of the plant.
        process: Fault process of the plant whose beliefs and scoring hold.
        channels: What is recorded, of a plant without equations.
        layout: How the recordings are laid out (`fdi_gym.recordings.layouts`).
        mapping: Which column is what.
        flights: Their digests by path, relative to the suite's file.
        settings: Per diagnoser, tuning that belongs to this suite.
        sha256: Digest of all the rest of this file.

    Raises:
        ValueError: A name that cannot be one, a path that leaves the folder.
    """

    name: str
    description: str
    plant: str
    options: dict[str, Any] = {}
    process: str = "standard"
    channels: Channels | None = None
    layout: Literal["columns", "skab", "braatz", "alfa"] = "columns"
    mapping: Mapping = Mapping()
    flights: dict[str, Sha256]
    settings: dict[str, dict[str, Any]] = {}
    sha256: str = ""
    folder: str = ""  # where it lies; not in the file

    def __post_init__(self) -> None:
        check_name("suite", self.name)
        if not self.description.isprintable() or len(self.description) > 300:
            raise ValueError(f"a description is one line of up to 300 printable characters, not {self.description[:80]!r}")
        for diagnoser in self.settings:
            check_diagnoser_name(diagnoser)
        if not 1 <= len(self.flights) <= FILES:
            raise ValueError(f"a recorded suite has from 1 to {FILES} flights, not {len(self.flights)}")
        for path in self.flights:
            if Path(path).is_absolute() or ".." in Path(path).parts or "\\" in path or "\0" in path or not path:
                raise ValueError(f"flights lie in the folder of the suite or below it, which {path[:200]!r} does not")

    def content_sha256(self) -> str:
        """The digest that `sha256` must equal."""
        return digest({k: v for k, v in msgspec.structs.asdict(self).items() if k not in ("sha256", "folder")})

    @property
    def episodes(self) -> int:
        """Number of flights."""
        return len(self.flights)

    @property
    def env(self) -> str:
        """What is run, for the page."""
        return self.plant if self.channels is None else f"channels of {self.plant}"

    def head(self, episodes: int) -> RecordedSuite:
        """The first so many of the flights, as a suite of their own.

        Raises:
            ValueError: There are not so many.
        """
        if not 1 <= episodes <= self.episodes:
            raise ValueError(f"{self.name} has from 1 to {self.episodes} flights, not {episodes}")
        some = dict(list(self.flights.items())[:episodes])
        return msgspec.structs.replace(self, name=f"{self.name}-{episodes}", flights=some).sealed()

    def sealed(self) -> RecordedSuite:
        """The suite with its digest, computed."""
        return msgspec.structs.replace(self, sha256=self.content_sha256())

    def build(self) -> Plant:
        """The plant.

        Raises:
            ValueError: There is none of that id, or it has no such process.
        """
        if self.channels is not None:
            if self.plant in plant_sources():
                raise ValueError(f"{self.plant} is a plant with equations; channels without get another id")
            return channels_plant(self.plant, self.channels)
        module, _, plant_id = self.plant.rpartition(":")
        if module:
            find_module(module)
        plant = load_plant(plant_id, **self.options)
        if self.process not in plant.processes:
            raise unknown(f"process of {plant_id}", self.process, plant.processes)
        return plant

    def recording(self, plant: Plant, flight: str) -> Recording:
        """A flight, read as its layout says.

        Raises:
            RefusedError: It is no recording, has no labels, or leads out of the folder of the suite.
        """
        path, folder = Path(self.folder) / flight, Path(self.folder).resolve()
        if not path.resolve().is_relative_to(folder):
            raise RefusedError(f"{path} leads out of the folder of the suite")
        found = observations(plant, LAYOUTS[self.layout].table(path), self.mapping)
        if found.label is None:
            raise RefusedError(f"{path} says neither labels nor onsets: there is nothing to score")
        return found

    def record(self, plant: Plant, episodes: Sequence[int]) -> Record:
        """The flights (0, 1, ...) as a record; what is not recorded is NaN.

        Raises:
            RefusedError: As `recording`.
        """
        names = list(self.flights)
        return as_record(plant, [self.recording(plant, names[i]) for i in episodes])

    def scenarios(self, plant: Plant, episodes: Sequence[int]) -> None:
        """Nobody knows them."""

    def check_scenarios(self, plant: Plant) -> None:
        """Make sure that the files are those that the suite was made of.

        Raises:
            RefusedError: One is missing, or another.
        """
        for flight, sha256 in self.flights.items():
            if flight_sha256(Path(self.folder) / flight) != sha256:
                raise RefusedError(f"{self.name}: {flight} is not the recording that the suite was made of")


def flight_sha256(path: Path) -> str:
    """Digest of a recording: of a file, or of the files of a folder with their names."""
    if path.is_dir():
        parts = [f"{file.name} {flight_sha256(file)}" for file in sorted(path.glob("*.csv"))]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()
    if not path.is_file():
        raise RefusedError(f"{path} is no file")
    if path.stat().st_size > BYTES:
        raise RefusedError(f"{path} is larger than {BYTES} bytes")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_recorded(path: Path) -> RecordedSuite:
    """A recorded suite from its file.

    Raises:
        RefusedError: It is no such file, or was edited after it was made.
    """
    suite = read_json(path, RecordedSuite, "recorded suite", LARGEST)
    if suite.folder:
        raise RefusedError(f"{path} says where it lies; it lies where it is")
    if suite.name != path.stem:
        raise RefusedError(f"{path} holds a suite that is called {suite.name}")
    if suite.sha256 != suite.content_sha256():
        raise RefusedError(
            f"{path} was edited after it was made: its hash is {suite.content_sha256()[:12]}, it says {suite.sha256[:12]}"
        )
    return msgspec.structs.replace(suite, folder=str(path.parent))


def collect(
    folder: Path, name: str, description: str, plant: str, *, options: dict[str, Any] | None = None,
    process: str = "standard", channels: Channels | None = None, layout: str = "columns", mapping: Mapping | None = None,
    settings: dict[str, dict[str, Any]] | None = None,
) -> Path:  # fmt: skip
    """Make a suite of the recordings in a folder: each is read once, and the suite's file is written beside them.

    Args:
        folder: Where they lie.
        name, description, plant, options, process, channels, mapping, settings: As in `RecordedSuite`. Layouts that say
            their channels need none.
        layout: A name of `LAYOUTS`.

    Raises:
        ValueError: A recording cannot be read or has no labels; a suite of that name and another content exists.
    """
    if layout not in LAYOUTS:
        raise unknown("layout", layout, LAYOUTS)
    reader = LAYOUTS[layout]
    flights = reader.flights(folder)
    if (
        channels is None
        and reader.channels is not None
        and plant.rpartition(":")[2] not in plant_sources()
        and ":" not in plant
    ):
        channels = reader.channels(flights)
    suite = RecordedSuite(
        name=name, description=description, plant=plant, options=options or {}, process=process, channels=channels,
        layout=layout, mapping=mapping or Mapping(), settings=settings or {},  # type: ignore[arg-type]
        flights={path.relative_to(folder).as_posix(): flight_sha256(path) for path in flights}, folder=str(folder),
    ).sealed()  # fmt: skip
    built = suite.build()
    for flight in suite.flights:
        suite.recording(built, flight)
    path = folder / f"{name}.json"
    if path.exists() and read_recorded(path).sha256 != suite.sha256:
        raise ValueError(f"{path} is another suite; choose another name")
    write_whole(path, pretty({k: v for k, v in msgspec.structs.asdict(suite).items() if k != "folder"}))
    return path
