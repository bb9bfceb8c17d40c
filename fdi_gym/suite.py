"""Suites: frozen JSON files that say which environment, which fault process and which seeds.

A suite's content hash travels with every result. Suites of flights that are acted on (`ActingSuite`) and of recorded ones
(`fdi_gym.recordings.suite`) are loaded by the same names. Packages bring theirs by the entry-point group "fdi_gym.suites": a
package in whose folder the files are.
"""

from __future__ import annotations

import importlib.util
import inspect
import math
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, get_type_hints

import msgspec
import numpy as np

from fdi_gym.acts import acting_of
from fdi_gym.diagnosis import find_diagnoser, probers
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import Record, simulate
from fdi_gym.faults import MAX_STEPS, FaultScenario
from fdi_gym.files import RefusedError, digest, pretty, read_json, write_whole
from fdi_gym.names import blame, check_diagnoser_name, check_name, find_function, find_module, unknown
from fdi_gym.options import Options
from fdi_gym.plant import Plant
from fdi_gym.recordings.suite import RecordedSuite, read_recorded

_PACKAGED = Path(__file__).parent / "suites"
_CHECKOUT = Path(__file__).parent.parent / "leaderboards" / "suites"
SUITES = _CHECKOUT if _CHECKOUT.is_dir() else _PACKAGED
LARGEST = 2**20  # bytes of a suite's file
EPISODES, SEEDS, WINDOWS = 100_000, 2**62, 100  # upper ends


def scenarios_digest(scenarios: Sequence[FaultScenario]) -> str:
    """Digest of scenarios to nine digits: another machine's last bits don't matter, another sampler does."""

    def rounded(value: Any) -> Any:
        if isinstance(value, float):
            return f"{value:.9g}"
        if isinstance(value, dict):
            return {key: rounded(entry) for key, entry in value.items()}
        return [rounded(entry) for entry in value] if isinstance(value, list) else value

    return digest([rounded(msgspec.to_builtins(scenario)) for scenario in scenarios])


def checked_options(plant_id: str, options: Mapping[str, Any], *, typed: bool = True) -> dict[str, Any]:
    """A plant's options, of the types that its builder declares.

    Args:
        plant_id: The plant.
        options: Values by name.
        typed: The values have their types; False for text that a user typed ("0.5").

    Raises:
        ValueError: Unknown plant or option, or a value of another type.
    """
    sources = plant_sources()
    if plant_id not in sources:
        raise unknown("plant", plant_id, sources)
    build = find_function("plant", sources[plant_id].builder)
    signature, every = inspect.signature(build, eval_str=True).parameters, get_type_hints(Options)
    found = {}
    for name, value in options.items():
        if name not in signature and name not in every:
            raise unknown(f"option of {plant_id}", name, [*signature, *every])
        kind = signature[name].annotation if name in signature else every[name]
        kind = type(signature[name].default) if kind is inspect.Parameter.empty else kind
        try:
            found[name] = msgspec.convert(value, kind, strict=typed)
        except msgspec.ValidationError as error:
            raise ValueError(f"the option {name} of {plant_id}: {error}, not {value!r}") from None
        if isinstance(found[name], float) and not math.isfinite(found[name]):
            raise ValueError(f"the option {name} of {plant_id} is a finite number, not {value!r}")
    return found


def chained(scenarios: Sequence[FaultScenario], pace: float) -> FaultScenario:
    """One flight of several: the windows of their faults follow one another, each after the healthy time before it.

    All but the faults is the first one's. Times are multiplied by `pace`; a scenario counts up to the end of its last fault,
    or whole where it has none, and the flight ends with it.
    """
    if len(scenarios) == 1 and pace == 1.0:
        return scenarios[0]
    faults, now = [], 0
    for scenario in scenarios:
        ends = [scenario.steps if f.end is None else min(f.end, scenario.steps) for f in scenario.faults]
        for fault, end in zip(scenario.faults, ends, strict=True):
            onset = now + round(fault.onset * pace)
            faults.append(msgspec.structs.replace(fault, onset=onset, end=max(onset, now + round(end * pace))))
        now += max(1, round(max(ends, default=scenario.steps) * pace))
    return scenarios[0].replace(faults=faults, steps=now)


class Suite(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is run.

    Args:
        name: Name of the file, without ".json".
        description: One line for the table.
        env: Environment id; "module:id" where the module registers it.
        plant: Plant id.
        options: Options of the plant.
        process: Name of the fault process.
        mismatch: Level of mismatch, from 0 to 1; None for what the process prescribes.
        seeds: The public seeds of the flights, `windows` a flight.
        healthy: Seeds of more flights, after those: flown without their faults.
        windows: Seeds a flight: the fault windows that they draw follow one another (see `chained`).
        pace: Factor on the times of the drawn faults where windows are chained.
        steps: Flights are cut after so many samples; None for as long as they are drawn.
        settings: Per diagnoser, tuning that belongs to this suite (the prior of an oracle).
        scenarios_sha256: Digest of the drawn scenarios: a changed sampler shows.
        sha256: Digest of all the rest of this file.

    Raises:
        ValueError: A name that cannot be a file's, a number out of range, a description of more than a line.
    """

    name: str
    description: str
    env: str
    plant: str
    options: dict[str, Any]
    process: str
    mismatch: float | None
    seeds: list[int]
    healthy: list[int] = []
    windows: int = 1
    pace: float = 1.0
    steps: int | None = None
    settings: dict[str, dict[str, Any]]
    scenarios_sha256: str = ""
    sha256: str = ""

    def __post_init__(self) -> None:
        check_name("suite", self.name)
        if not self.description.isprintable() or len(self.description) > 300:
            raise ValueError(f"a description is one line of up to 300 printable characters, not {self.description[:80]!r}")
        for diagnoser in self.settings:
            check_diagnoser_name(diagnoser)
        if not 1 <= self.windows <= WINDOWS:
            raise ValueError(f"windows is from 1 to {WINDOWS}, not {self.windows}")
        if not 1 <= self.episodes <= EPISODES:
            raise ValueError(f"a suite has from 1 to {EPISODES} flights, not {self.episodes}")
        for name, seeds in (("seeds", self.seeds), ("healthy", self.healthy)):
            if len(seeds) % self.windows:
                raise ValueError(f"{name} are {self.windows} a flight, which {len(seeds)} are not")
            if len(set(seeds)) < len(seeds):
                raise ValueError(f"{name} are named once each")
            if not all(0 <= seed <= SEEDS for seed in seeds):
                raise ValueError(f"{name} are from 0 to 2^62")
        if not 0.01 <= self.pace <= 100:
            raise ValueError(f"pace is from 0.01 to 100, not {self.pace}")
        if self.steps is not None and not 1 <= self.steps <= MAX_STEPS:
            raise ValueError(f"steps is from 1 to {MAX_STEPS}, not {self.steps}")
        if self.mismatch is not None and not 0 <= self.mismatch <= 1:
            raise ValueError(f"mismatch is from 0 to 1, not {self.mismatch}")

    def content_sha256(self) -> str:
        """The digest that `sha256` must equal."""
        return digest({k: v for k, v in msgspec.structs.asdict(self).items() if k != "sha256"})

    def sealed(self) -> Suite:
        """The suite with its digests, computed."""
        drawn = scenarios_digest(self.scenarios(self.build(), range(self.episodes)))
        suite = msgspec.structs.replace(self, scenarios_sha256=drawn)
        return msgspec.structs.replace(suite, sha256=suite.content_sha256())

    @property
    def episodes(self) -> int:
        """Number of flights."""
        return (len(self.seeds) + len(self.healthy)) // self.windows

    def head(self, episodes: int) -> Suite:
        """So many of the flights, evenly spread, as a suite of their own: a quick look, whose rows are not rows of this one.

        Raises:
            ValueError: There are not so many.
        """
        if not 1 <= episodes <= self.episodes:
            raise ValueError(f"{self.name} has from 1 to {self.episodes} flights, not {episodes}")
        w, flights = self.windows, len(self.seeds) // self.windows
        chosen = np.linspace(0, self.episodes - 1, episodes).round().astype(int)
        seeds = [seed for i in chosen if i < flights for seed in self.seeds[i * w : (i + 1) * w]]
        healthy = [seed for i in chosen - flights if i >= 0 for seed in self.healthy[i * w : (i + 1) * w]]
        return msgspec.structs.replace(self, name=f"{self.name}-{episodes}", seeds=seeds, healthy=healthy).sealed()

    def build(self) -> Plant:
        """The plant.

        Raises:
            ValueError: It cannot be built, has no such process, or is not the one that the environment id says.
        """
        module, _, env_id = self.env.rpartition(":")
        if module:
            find_module(module)
        options = checked_options(self.plant, self.options)
        try:
            plant = load_plant(self.plant, **options)
        except ValueError:
            raise
        except Exception as error:
            raise ValueError(f"{self.plant} cannot be built with {options}: {blame(error)}") from error
        if self.process not in plant.processes:
            raise unknown(f"process of {self.plant}", self.process, plant.processes)
        if plant.env_id != env_id:
            raise ValueError(f"{self.name} is of {env_id!r}; this {self.plant} is {plant.env_id}")
        if self.mismatch is not None and plant.perturb is None:
            raise ValueError(f"{self.plant} has no mismatch")
        if plant.simultaneous:
            raise ValueError("a suite scores labels; sets of modes are scored by fdi_gym.simultaneous.scores")
        return plant

    def scenarios(self, plant: Plant, episodes: Sequence[int]) -> list[FaultScenario]:
        """The scenarios of these flights (0, 1, ...). Of one seed: that of `reset(seed=seed)`."""
        seeds, w, found = [*self.seeds, *self.healthy], self.windows, []
        for i in episodes:
            drawn = [plant.draw(self.process, seed, self.mismatch) for seed in seeds[i * w : (i + 1) * w]]
            scenario = chained(drawn, self.pace)
            scenario = scenario if i * w < len(self.seeds) else scenario.without_faults()
            found.append(scenario if self.steps is None else scenario.replace(steps=min(scenario.steps, self.steps)))
        return found

    def record(self, plant: Plant, episodes: Sequence[int]) -> Record:
        """These flights, flown."""
        return simulate(plant, self.scenarios(plant, episodes))

    def check_scenarios(self, plant: Plant) -> None:
        """Make sure that this version draws what the suite was frozen with.

        Raises:
            ValueError: It does not.
        """
        if scenarios_digest(self.scenarios(plant, range(self.episodes))) != self.scenarios_sha256:
            raise ValueError(f"{self.name}: this version draws other scenarios than the suite was frozen with")


class ActingSuite(Suite, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is run where the diagnosis acts: flights as in `Suite`, that answer to who is on board.

    Args:
        acts: "probing": probers enter, with the suite's diagnoser on board, and diagnosers that never probe.
            "accommodation": diagnosers enter, and the controller is reconfigured for what they say.
        decision_period: Samples from one decision to the next.
        on_board: The diagnoser that probers have on board; "" for accommodation.

    Raises:
        ValueError: As for `Suite`; nobody on board, or somebody where nobody can be.
    """

    acts: Literal["probing", "accommodation"]
    decision_period: int
    on_board: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.decision_period <= MAX_STEPS:
            raise ValueError(f"decision_period is from 1 to {MAX_STEPS}, not {self.decision_period}")
        if self.acts == "probing":
            check_diagnoser_name(self.on_board)
        elif self.on_board:
            raise ValueError(f"for accommodation whoever enters is on board, not {self.on_board!r} too")

    def build(self) -> Plant:
        """As `Suite.build`.

        Raises:
            ValueError: As there; the plant does not declare how it can be acted on so.
        """
        plant = super().build()
        acting_of(plant, self.acts == "probing", self.acts == "accommodation")
        return plant

    def record(self, plant: Plant, episodes: Sequence[int]) -> Record:
        """Nobody can fly them without who acts.

        Raises:
            ValueError: Always.
        """
        raise ValueError(
            f"the flights of {self.name} answer to who acts on them; for what is flown once and shown to all, take a suite "
            "that does not act"
        )


AnySuite = Suite | RecordedSuite


def suite_files() -> dict[str, Path]:
    """The files of the suites that are installed, by name: those of this package, then those of others."""
    found: dict[str, Path] = {}
    for folder in (SUITES, *(_folder(entry_point.value) for entry_point in entry_points(group="fdi_gym.suites"))):
        for path in sorted(folder.glob("*.json")) if folder is not None else ():
            found.setdefault(path.stem, path)
    return found


def _folder(module: str) -> Path | None:
    """Where a package or module lies; None where there is none."""
    try:
        spec = importlib.util.find_spec(module)
    except Exception:  # whatever a package does when it is imported
        return None
    place = spec and (next(iter(spec.submodule_search_locations or ()), None) or (spec.origin and Path(spec.origin).parent))
    return Path(place) if place else None


def suite_names() -> list[str]:
    """Names of the suites that are installed."""
    return sorted(suite_files())


def load_suite(name: str) -> AnySuite:
    """A suite by name, "module:name" where its file lies beside a module's, or from a path that ends in ".json".

    Raises:
        ValueError: No such suite; `RefusedError` where its file is none, or was edited after it was frozen.
    """
    module, _, within = name.rpartition(":")
    known = suite_files()
    if name.endswith(".json"):
        path = Path(name)
        if not path.is_file():
            raise ValueError(f"there is no suite {name}")
    elif module and (folder := _folder(module)) is not None:
        path = folder / f"{check_name('suite', within)}.json"
        if not path.is_file():
            raise ValueError(f"there is no suite {within!r} in {folder}")
    elif name not in known:
        raise unknown("suite", name, sorted(known))
    else:
        path = known[name]
    said = read_json(path, dict[str, msgspec.Raw], "suite")
    if "flights" in said:
        return read_recorded(path)
    suite = read_json(path, ActingSuite if "acts" in said else Suite, "suite", LARGEST)
    if suite.name != path.stem:
        raise RefusedError(f"{path} holds a suite that is called {suite.name}")
    if suite.sha256 != suite.content_sha256():
        raise RefusedError(
            f"{path} was edited after it was frozen: its hash is {suite.content_sha256()[:12]}, it says {suite.sha256[:12]}"
        )
    return suite


def freeze(suite: Suite, folder: Path = SUITES) -> Path:
    """Write a suite with its digests. A frozen suite is not changed: a different one needs another name.

    Raises:
        ValueError: A suite of that name and another content exists, or settings are of no diagnoser or not its own.
    """
    if isinstance(suite, ActingSuite) and suite.on_board:
        find_diagnoser(suite.on_board)
    for name, settings in suite.settings.items():
        entry = probers().get(name) or find_diagnoser(name)
        allowed = inspect.signature(entry.build).parameters
        for key in settings:
            if key not in allowed:
                raise unknown(f"setting of {name}", key, list(allowed)[1:])
    suite = suite.sealed()
    path = folder / f"{suite.name}.json"
    if path.exists() and load_suite(str(path)).sha256 != suite.sha256:
        raise ValueError(f"{path} is frozen with another content; choose another name")
    write_whole(path, pretty(suite))
    return path
