"""Diagnosers by name: how a builder is made known, found, told what it may know, and built.

A builder makes a diagnoser from a plant and from data; it flies nothing and reads no file:

    @diagnoser("two_stage_kf", "Two-stage Kalman filter")
    def two_stage_kf(plant: Plant, *, forgetting: str = "none") -> Diagnoser: ...

    @diagnoser("augmented_ekf", "Augmented extended Kalman filter")
    def augmented_ekf(plant: Plant, belief: Belief, calibration: Calibration, *, walk: float = 1.0) -> Diagnoser: ...

Arguments of these names are given: `belief` and `calibration` are what `fdi_gym.diagnosis.fitting` found for the fault
process that will be met, `process` is that process's name, `scenarios` the truth, for ceilings only. All others are tuning.
Builders in the modules and packages of the entry-point group "fdi_gym.diagnosers" are discovered; none is listed.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import json
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

from fdi_gym.diagnosis.contract import Diagnoser
from fdi_gym.diagnosis.guard import guarded
from fdi_gym.names import blame, check_diagnoser_name, find_function, unknown
from fdi_gym.plant import Plant

GIVEN = {  # arguments of a builder that are no tuning
    "belief": "what it may assume of the plant, fitted to the process",
    "calibration": "when it alarms, fitted to the process",
    "process": "the fault process that will be met",
    "scenarios": "the truth: it is clairvoyant",
}


class Entry(NamedTuple):
    """A diagnoser that can be asked for by name."""

    name: str
    summary: str
    build: Callable[..., Diagnoser]
    settings: Mapping[str, Any]  # that belong to the name
    knows: str  # of the truth, in words; empty for a method that is told nothing
    ceiling: bool  # what it knows is more than any method can find out: it frames a table

    @property
    def clairvoyant(self) -> bool:
        """Whether it knows a part of the truth."""
        return bool(self.knows)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The keywords of its builder, without the plant."""
        return tuple(inspect.signature(self.build).parameters)[1:]

    def takes(self, argument: str) -> bool:
        """Whether its builder has this argument."""
        return argument in self.parameters

    def resolve(self, plant: Plant, **tuning: Any) -> dict[str, Any]:
        """All tuning that its builder gets: the caller's over the name's over the paper's own for this plant.

        Raises:
            ValueError: The builder has no such keyword.
        """
        asked = {**self.settings, **tuning}
        settings = {**paper_tuning(self, plant, asked), **asked}
        allowed = [name for name in self.parameters if name not in GIVEN]
        for key in settings:
            if key not in allowed:
                raise ValueError(f"{self.name} has no setting {key!r}; it has {', '.join(allowed) or 'none'}")
        return settings


def package_of(entry: Entry) -> Path | None:
    """The folder of the package that a diagnoser belongs to; None where there is none."""
    name = entry.build.__module__.split(".")[0]
    file = getattr(importlib.import_module(name), "__file__", None)
    return Path(file).parent if file else None


@functools.cache
def _tuning_file(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_bytes()) if path.is_file() else []


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def paper_tuning(entry: Entry, plant: Plant, asked: Mapping[str, Any]) -> dict[str, Any]:
    """What a method's paper gives for a plant: from `tuning/<Plant>.json` in the package of the method.

    The file is a list of {"methods": names, "options": options of the plant, "asked": settings that are asked for,
    "settings": ...}; an item holds where the method is named, the plant has these options, and these settings are asked
    for (null: not asked for).
    """
    home = package_of(entry)
    found: dict[str, Any] = {}
    for item in _tuning_file(home / "tuning" / f"{plant.id}.json") if home else ():
        options, given = item.get("options", {}), item.get("asked", {})
        if (
            entry.name in item["methods"]
            and all(plant.options.get(k) == v for k, v in options.items())
            and all(_plain(asked.get(k)) == v for k, v in given.items())
        ):
            found |= item["settings"]
    return found


_entries: dict[str, Entry] = {}


def diagnoser(name: str, summary: str, *, knows: str = "", ceiling: bool = False, **settings: Any) -> Callable[[Any], Any]:
    """Make a builder known under a name. Stacked, it gives one builder several names with different settings.

    Args:
        name: As users and tables call it.
        summary: One line for tables.
        knows: What it is told of the truth, in a few words for tables ("when faults begin and end"): its builder takes
            `scenarios=`, one per episode.
        ceiling: No method that is told nothing can be better, as far as is known: it frames the tables.
        settings: Keyword arguments of the builder that belong to this name.

    Raises:
        ValueError: The name is taken, the builder has no such keyword, or a ceiling that knows nothing.
    """
    if ceiling and not knows:
        raise ValueError(f"{name} is called a ceiling, but knows nothing of the truth")

    def register(build: Callable[..., Diagnoser]) -> Callable[..., Diagnoser]:
        taken = _entries.get(name)
        if taken is not None and (taken.build.__module__, taken.build.__qualname__) != (
            build.__module__, build.__qualname__,
        ):  # fmt: skip
            raise ValueError(f"two diagnosers are called {name!r}: {taken.build.__module__} and {build.__module__}")
        allowed = inspect.signature(build).parameters
        for setting in settings:
            if setting not in allowed:
                raise ValueError(f"{build.__name__} has no setting {setting!r}; it has {', '.join(allowed)}")
        _entries[name] = Entry(name, summary, build, settings, knows, ceiling)
        return build

    return register


@functools.cache
def broken_plugins() -> dict[str, str]:
    """The modules of the entry-point group that cannot be imported, with the reason; the others are imported."""
    broken = {}

    def load(what: str, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except (Exception, SystemExit) as error:
            broken[what] = blame(error)
            return None

    for entry_point in entry_points(group="fdi_gym.diagnosers"):
        place = load(entry_point.value, entry_point.load)
        for module in pkgutil.walk_packages(getattr(place, "__path__", []), f"{entry_point.value}.", onerror=lambda _: None):
            load(module.name, functools.partial(importlib.import_module, module.name))
    return broken


def diagnosers() -> dict[str, Entry]:
    """All diagnosers by name, in the order in which their modules declare them."""
    broken_plugins()  # imports the modules in which they are
    return dict(_entries)


def find_diagnoser(name: str) -> Entry:
    """The diagnoser of this name; "module:function" names a builder that is not discovered.

    Raises:
        ValueError: There is none; the message lists those that exist.
    """
    if ":" in name:
        build = find_function("diagnoser", check_diagnoser_name(name))
        try:
            arguments = inspect.signature(build).parameters
        except (ValueError, TypeError):  # a builtin
            arguments = {}
        if not arguments:
            raise ValueError(f"{name} is no builder of a diagnoser: it takes no plant")
        return Entry(name, (inspect.getdoc(build) or name).splitlines()[0], build, {}, "", False)
    found = diagnosers()
    if name not in found:
        raise unknown("diagnoser", name, found)
    return found[name]


def make_diagnoser(
    name: str, plant: Plant, *, process: str = "standard", scenarios: Sequence[Any] | None = None, **tuning: Any
) -> Diagnoser:
    """A diagnoser by name, for a plant and one of its fault processes, under the guard (see `guarded`).

    What it believes and when it alarms is what `fdi_gym.diagnosis.fitting` found for that process: shipped where it is, else
    found when it is first asked for.

    Args:
        name: As in `find_diagnoser`.
        plant: The plant whose model it gets.
        process: The fault process that it will meet.
        scenarios: The truth, one per episode; only a clairvoyant one gets it.
        tuning: Keyword arguments of its builder, over those of the name, which are over its paper's own for the plant.

    Raises:
        ValueError: Unknown name, process or keyword; `NotApplicableError` where the method cannot run on this plant.
    """
    from fdi_gym.diagnosis.knowledge import knowledge_of

    entry = find_diagnoser(name)
    plant.process(process)
    settings = entry.resolve(plant, **tuning)
    given: dict[str, Any] = {"process": process} if entry.takes("process") else {}
    if entry.clairvoyant:
        if scenarios is None:
            raise ValueError(f"{name} knows the truth: it needs scenarios, one per episode")
        given["scenarios"] = scenarios
    try:
        given |= knowledge_of(entry, plant, process, settings)
        built = entry.build(plant, **given, **settings)
    except ValueError:
        raise
    except Exception as error:
        raise ValueError(f"the builder of {name} failed: {blame(error)}") from error
    if not isinstance(built, Diagnoser):
        raise ValueError(f"the builder of {name} gives {type(built).__name__}, not a Diagnoser")
    return guarded(built, plant)
