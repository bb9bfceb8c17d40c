"""Methods by name: how the builder of a diagnoser or prober, or a trainer, is made known and found, and what it takes.

A builder makes a diagnoser from a plant and from data; it flies nothing and reads no file:

    @diagnoser("two_stage_kf", "Two-stage Kalman filter")
    def two_stage_kf(plant: Plant, *, forgetting: str = "none") -> Diagnoser: ...

    @diagnoser("augmented_ekf", "Augmented extended Kalman filter")
    def augmented_ekf(plant: Plant, belief: Belief, calibration: Calibration, *, walk: float = 1.0) -> Diagnoser: ...

A prober's builder makes one of a plant (`fdi_gym.agents.Prober`): what is added to a flight to find its fault sooner:

    @prober("periodic_probes", "The plant's probes in turn")
    def periodic_probes(plant: Plant, *, on: int = 10, every: int = 30) -> Prober: ...

A trainer makes weights for a diagnoser or a prober, in a folder of runs; it gives the path of the .safetensors file, whose
card lies beside it:

    @trainer("sequence_net", "Recurrent network, supervised")
    def train_sequence_net(plant: Plant, *, budget: int | None, seed: int, work: Path, threads: int) -> Path: ...

Arguments of the names in `GIVEN` are given to those that have them; all others are settings. Modules and packages of the
entry-point group "fdi_gym.diagnosers" are imported to find all; none is listed. A module whose name begins with "_" is
left for those that need it, with whatever slow library it imports.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import json
import pkgutil
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, NamedTuple

from fdi_gym.names import blame, check_diagnoser_name, find_function, unknown
from fdi_gym.plant import NotApplicableError, Plant

Kind = Literal["diagnoser", "prober", "trainer"]
GIVEN: dict[Kind, dict[str, str]] = {  # arguments that are no settings
    "diagnoser": {
        "belief": "what it may assume of the plant, fitted to the process",
        "calibration": "when it alarms, fitted to the process",
        "conformity": "how badly each label may fit, fitted to the process",
        "process": "the fault process that will be met",
        "scenarios": "the truth: it is clairvoyant",
    },
    "prober": {
        "process": "the fault process that will be met",
        "period": "samples from one decision to the next",
    },
    "trainer": {
        "budget": "how much to train, in its own measure; None for its recipe's",
        "seed": "of the run",
        "work": "folder of runs: checkpoints, logs, weights and cards",
        "threads": "of the library that trains",
    },
}


class Entry(NamedTuple):
    """A diagnoser, a prober or a trainer that can be asked for by name."""

    kind: Kind
    name: str
    summary: str
    build: Callable[..., Any]  # the builder of the diagnoser or prober, or the function that trains
    settings: Mapping[str, Any]  # that belong to the name
    knows: str = ""  # of the truth, in words; empty for a method that is told nothing
    ceiling: bool = False  # what it knows is more than any method can find out: it frames a table
    reference: bool = False  # others are compared with it first: in the group "reference", as ceilings are
    sensors: bool | None = None  # it goes by the plant's declaration, faults of sensors included

    @property
    def hears_sensors(self) -> bool:
        """Whether it is told that sensors may fail: what takes a belief is, if it does not say otherwise."""
        return self.takes("belief") if self.sensors is None else self.sensors

    def told(self, plant: Plant, process: str) -> tuple[Plant, str]:
        """The plant and the process as the method knows them: that of other methods has sensors that never fail.

        Of faults that nobody is told of, nobody is told; who takes a conformity has an answer for them.

        Raises:
            NotApplicableError: It knows a part of the truth, but not of sensors that fail, or its answer is no label.
        """
        if self.takes("conformity"):
            if not plant.unseen or plant.bare is None:
                raise NotApplicableError(
                    f"{plant.id} has no label for what nobody was told of; with the option unseen it has"
                )
            return plant, process if process in plant.bare.processes else "standard"
        if plant.bare is None or (self.hears_sensors and not plant.unseen):
            return plant, process
        if self.clairvoyant:
            raise NotApplicableError(f"what {self.name} is told of the truth does not cover faults of sensors")
        return plant.bare, process if process in plant.bare.processes else "standard"

    @property
    def clairvoyant(self) -> bool:
        """Whether it knows a part of the truth."""
        return bool(self.knows)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The keywords of its function, without the plant."""
        return tuple(inspect.signature(self.build).parameters)[1:]

    def takes(self, argument: str) -> bool:
        """Whether its function has this argument."""
        return argument in self.parameters

    def resolve(self, plant: Plant, **settings: Any) -> dict[str, Any]:
        """All settings that its function gets: the caller's over the name's over the paper's own for this plant.

        Raises:
            ValueError: The function has no such keyword.
        """
        asked = {**self.settings, **settings}
        found = {**paper_tuning(self, plant, asked), **asked} if self.kind == "diagnoser" else asked
        allowed = [name for name in self.parameters if name not in GIVEN[self.kind]]
        for key in found:
            if key not in allowed:
                raise ValueError(f"{self.name} has no setting {key!r}; it has {', '.join(allowed) or 'none'}")
        return found


def package_of(entry: Entry) -> Path | None:
    """The folder of the package that a method belongs to; None where there is none."""
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


GROUPS: dict[str, Callable[[Entry], bool]] = {
    "all": lambda entry: True,
    "reference": lambda entry: entry.reference or entry.ceiling,
}
_entries: dict[Kind, dict[str, Entry]] = {"diagnoser": {}, "prober": {}, "trainer": {}}


def diagnoser(
    name: str,
    summary: str,
    *,
    knows: str = "",
    ceiling: bool = False,
    reference: bool = False,
    sensors: bool | None = None,
    **settings: Any,
) -> Callable[[Any], Any]:
    """Make a builder known under a name. Stacked, it gives one builder several names with different settings.

    Args:
        name: As users and tables call it.
        summary: One line for tables.
        knows: What it is told of the truth, in a few words for tables ("when faults begin and end"): its builder takes
            `scenarios=`, one per episode.
        ceiling: No method that is told nothing can be better, as far as is known: it frames the tables.
        reference: One of those that others are compared with first.
        sensors: Of a plant whose sensors may fail it gets that plant; others get the same without, and are not told.
            Default: whether it takes a belief.
        settings: Keyword arguments of the builder that belong to this name.

    Raises:
        ValueError: The name is taken or a group's, the builder has no such keyword, or a ceiling that knows nothing.
    """
    if ceiling and not knows:
        raise ValueError(f"{name} is called a ceiling, but knows nothing of the truth")
    return functools.partial(_register, "diagnoser", name, summary, settings, (knows, ceiling, reference, sensors))


def prober(name: str, summary: str, *, reference: bool = False, **settings: Any) -> Callable[[Any], Any]:
    """Make a prober's builder known under a name, as `diagnoser` does with a diagnoser's; no diagnoser has that name.

    Raises:
        ValueError: As there.
    """
    return functools.partial(_register, "prober", name, summary, settings, ("", False, reference))


def trainer(name: str, summary: str, **settings: Any) -> Callable[[Any], Any]:
    """Make a training function known under a name, as `diagnoser` does with a builder.

    Raises:
        ValueError: As there.
    """
    return functools.partial(_register, "trainer", name, summary, settings, ())


def _register(
    kind: Kind,
    name: str,
    summary: str,
    settings: Mapping[str, Any],
    facts: tuple[Any, ...],
    build: Callable[..., Any],
) -> Callable[..., Any]:
    if name in GROUPS:
        raise ValueError(f"{name!r} is a group of diagnosers, and cannot be the name of one")
    rivals = ("diagnoser", "prober") if kind != "trainer" else ("trainer",)  # that are asked for in one place
    taken = next((_entries[rival][name] for rival in rivals if name in _entries[rival]), None)
    if taken is not None and (taken.build.__module__, taken.build.__qualname__) != (build.__module__, build.__qualname__):
        raise ValueError(
            f"two {kind if kind == taken.kind else 'method'}s are called {name!r}: "
            f"{taken.build.__module__} and {build.__module__}"
        )
    allowed = inspect.signature(build).parameters
    for setting in settings:
        if setting not in allowed:
            raise ValueError(f"{build.__name__} has no setting {setting!r}; it has {', '.join(allowed)}")
    _entries[kind][name] = Entry(kind, name, summary, build, settings, *facts)
    return build


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
            if "._" not in module.name:
                load(module.name, functools.partial(importlib.import_module, module.name))
    return broken


def _known(kind: Kind) -> dict[str, Entry]:
    broken_plugins()  # imports the modules in which they are
    return dict(_entries[kind])


def diagnosers() -> dict[str, Entry]:
    """All diagnosers by name, in the order in which their modules declare them."""
    return _known("diagnoser")


def probers() -> dict[str, Entry]:
    """All probers by name, in the order in which their modules declare them."""
    return _known("prober")


def trainers() -> dict[str, Entry]:
    """All trainers by name, in the order in which their modules declare them."""
    return _known("trainer")


def named(names: Iterable[str], probing: bool = False) -> list[str]:
    """These names, each once, with the diagnosers of a group (`GROUPS`) in its place; with probing its probers too."""
    found: list[str] = []
    entries = [*diagnosers().values(), *(probers().values() if probing else ())]
    for name in names:
        belongs = GROUPS.get(name)
        found += [name] if belongs is None else [entry.name for entry in entries if belongs(entry)]
    return list(dict.fromkeys(found))


def _find(kind: Kind, name: str) -> Entry:
    if ":" in name:
        build = find_function(kind, check_diagnoser_name(name))
        try:
            arguments = inspect.signature(build).parameters
        except (ValueError, TypeError):  # a builtin
            arguments = {}
        if not arguments:
            raise ValueError(f"{name} is no {kind if kind == 'trainer' else f'builder of a {kind}'}: it takes no plant")
        return Entry(kind, name, (inspect.getdoc(build) or name).splitlines()[0], build, {})
    found = _known(kind)
    if name not in found:
        raise unknown(kind, name, found)
    return found[name]


def find_diagnoser(name: str) -> Entry:
    """The diagnoser of this name; "module:function" names a builder that is not discovered.

    Raises:
        ValueError: There is none; the message lists those that exist.
    """
    return _find("diagnoser", name)


def find_prober(name: str) -> Entry:
    """The prober of this name; "module:function" names a builder that is not discovered.

    Raises:
        ValueError: There is none; the message lists those that exist.
    """
    return _find("prober", name)


def find_trainer(name: str) -> Entry:
    """The trainer of this name; "module:function" names one that is not discovered.

    Raises:
        ValueError: There is none; the message lists those that exist.
    """
    return _find("trainer", name)
