"""What `fdi-gym list` says: everything there is, or one thing in full."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterator

from fdi_gym.diagnosis import (
    Entry,
    NotApplicableError,
    broken_plugins,
    diagnosers,
    find_diagnoser,
    find_prober,
    find_trainer,
    make_diagnoser,
    probers,
    trainers,
)  # fmt: skip
from fdi_gym.diagnosis.registry import GIVEN, GROUPS
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.faults import draw
from fdi_gym.names import blamed, find_module, unknown
from fdi_gym.recordings.suite import RecordedSuite
from fdi_gym.suite import ActingSuite, AnySuite, load_suite, suite_names


def find_plant(text: str) -> tuple[str, str]:
    """The plant that a plant or environment id names, and the module before a ":" that registers it, imported.

    Returns:
        (module or "", plant id)

    Raises:
        ValueError: There is none.
    """
    module, _, name = text.rpartition(":")
    found = as_plant(text)
    if found is None:
        raise unknown("plant", name, plant_sources())
    return module, found


def as_plant(text: str) -> str | None:
    """The id of the plant that a plant or environment id names, "module:id" too; None where it names none.

    Raises:
        ValueError: The module before a ":" cannot be imported.
    """
    module, _, name = text.rpartition(":")
    if module:
        find_module(module)
    return _ids().get(name)


def _ids() -> dict[str, str]:
    """The plants by their own ids and those of their environments."""
    found = {plant: plant for plant in plant_sources()}
    for plant, source in plant_sources().items():
        found |= {f"{plant}-{kind}-v{source.version}": plant for kind in ("Faults", "Active")}
    return found


def overview() -> str:
    """Names of all environments, suites and methods, with a line for each; what is broken is listed as such."""
    lines = ["Environments (the second of a plant where it declares how it can be acted on)"]
    lines += [f"  {name}-Faults-v{s.version} {name}-Active-v{s.version}" for name, s in plant_sources().items()]
    lines += ["", "Suites", *(f"  {name:32s} {_said(lambda n=name: load_suite(n).description)}" for name in suite_names())]
    marked = {name: "*" if GROUPS["reference"](entry) else "" for name, entry in diagnosers().items()}
    lines += ["", 'Diagnosers (*: in the group "reference"; "all" is the group of all)']
    lines += [f"  {name:30s} {marked[name]:1s} {entry.summary}" for name, entry in diagnosers().items()]
    lines += ["", 'Probers (*: in the group "reference")']
    lines += [f"  {name:30s} {'*' if entry.reference else '':1s} {entry.summary}" for name, entry in probers().items()]
    lines += ["", "Trainers", *(f"  {name:32s} {found.summary}" for name, found in trainers().items())]
    if broken := broken_plugins():
        lines += ["", "Broken plug-ins", *(f"  {name:32s} {reason}" for name, reason in broken.items())]
    return "\n".join(lines)


def _said(describe: Callable[[], str]) -> str:
    try:
        return describe()
    except (ValueError, OSError) as error:
        return f"broken: {error}"


def details(text: str) -> str:
    """Everything about a plant, an environment, a suite or a method; a name may be more than one of these.

    Raises:
        ValueError: Nothing is called so.
    """
    name = text.rpartition(":")[2]
    ids = _ids()
    found = []
    if text in ids:
        found.append(load_plant(find_plant(text)[1]).describe())
    elif ":" in text:
        found.append(_outside(text, name))
    if text in suite_names() or text.endswith(".json"):
        found.append(_suite(load_suite(text)))
    if text in diagnosers():
        found.append(_diagnoser(find_diagnoser(text)))
    if text in probers():
        found.append(_prober(find_prober(text)))
    if text in trainers():
        found.append(_trainer(find_trainer(text)))
    if not found:
        everything = [*sorted(ids), *suite_names(), *diagnosers(), *probers(), *trainers()]
        near = " or ".join(difflib.get_close_matches(text, everything, 3))
        raise ValueError(f"nothing is called {text!r}; {f'did you mean {near}? ' if near else ''}'fdi-gym list' names all")
    return "\n\n".join(found)


def _outside(text: str, name: str) -> str:
    """What "module:name" names: a plant that the module registers, or else a trainer, a prober or a builder in it."""
    function = getattr(find_module(text.rpartition(":")[0]), name, None)
    if name in _ids():
        return load_plant(find_plant(text)[1]).describe()
    if any(entry.build is function for entry in trainers().values()):
        return _trainer(find_trainer(text))
    if any(entry.build is function for entry in probers().values()):
        return _prober(find_prober(text))
    return _diagnoser(find_diagnoser(text))


def _suite(suite: AnySuite) -> str:
    if isinstance(suite, RecordedSuite):
        lines = [f"{suite.name}: {suite.description}", "", f"  recorded     {suite.episodes} flights, {suite.env}"]
        return "\n".join([*lines, f"  layout       {suite.layout}", f"  version      {suite.sha256[:12]}"])
    lines = [f"{suite.name}: {suite.description}", "", f"  environment  {suite.env}", f"  options      {suite.options}"]
    lines += [f"  process      {suite.process}", f"  mismatch     {suite.mismatch}"]
    seeds = [*suite.seeds, *suite.healthy]
    lines += [f"  flights      {suite.episodes}, of seeds between {min(seeds)} and {max(seeds)}"]
    if isinstance(suite, ActingSuite):
        lines += [f"  acts         {suite.acts}, a decision every {suite.decision_period} samples"]
        lines += [f"  on board     {suite.on_board}"] if suite.on_board else []
    lines += [f"  settings of {name}: {settings}" for name, settings in suite.settings.items()]
    return "\n".join([*lines, f"  version      {suite.sha256[:12]}", "", f"  fdi-gym evaluate {suite.name}"])


def _diagnoser(entry: Entry) -> str:
    return "\n".join([*_settings(entry), "", "plants, as they are by default", *_plants(entry)])


def _prober(entry: Entry) -> str:
    return "\n".join([*_settings(entry), "", f"  fdi-gym evaluate SUITE --diagnosers {entry.name}, on a suite of probing"])


def _trainer(entry: Entry) -> str:
    return "\n".join([*_settings(entry), "", f"  fdi-gym train {entry.name} PLANT"])


def _settings(entry: Entry) -> Iterator[str]:
    yield from (f"{entry.name}: {entry.summary}", "", "settings")
    for parameter in list(inspect.signature(entry.build).parameters.values())[1:]:
        if parameter.name in GIVEN[entry.kind]:
            said = GIVEN[entry.kind][parameter.name]
        elif parameter.name in entry.settings:
            said = f"{entry.settings[parameter.name]!r} under this name"
        elif parameter.default is not inspect.Parameter.empty:
            said = repr(parameter.default)
        else:
            said = "no default"
        yield f"  {parameter.name:20s} {said}"


def _plants(entry: Entry) -> Iterator[str]:
    for plant_id in plant_sources():
        plant = load_plant(plant_id)
        try:
            with blamed(entry.name):
                built = make_diagnoser(entry.name, plant, scenarios=[draw(plant.process("standard"), 0)])
            yield f"  {plant_id:20s} runs{'' if built.gaps else '; its diagnosis is held while a sensor is missing'}"
        except NotApplicableError as error:
            yield f"  {plant_id:20s} does not run: {error}"
        except ValueError as error:
            yield f"  {plant_id:20s} fails: {error}"
