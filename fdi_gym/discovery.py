"""How plants are found: a file in `fdi_gym/plants/` with an `ID` line, an entry point of the group "fdi_gym.plants" (its
name is the environment's, its value the builder's "module:function"), or whatever `fdi_gym.register_plant` made known.

Nothing is listed, and nothing is imported to list them. `load_plant` builds one by its id.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import re
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

from fdi_gym.checks import is_whole
from fdi_gym.names import find_module, unknown
from fdi_gym.options import split_options
from fdi_gym.plant import Plant

_FOLDER = Path(__file__).parent / "plants"
_BUILDER = re.compile(r"\w+(\.\w+)*:\w+")


class PlantSource(NamedTuple):
    """Where a plant comes from: its builder as "module:function", and the version in its environment id."""

    builder: str
    version: int


class Origin(NamedTuple):
    """What a plant can be built from again, in any process."""

    plant_id: str
    source: PlantSource
    options: dict[str, Any]

    def build(self) -> Plant:
        """The plant."""
        return _built(*self)


_registered: dict[str, PlantSource] = {}


def _package_sources() -> dict[str, PlantSource]:
    found = {}
    for path in sorted(_FOLDER.glob("[!_]*.py")):
        text = path.read_text(encoding="utf-8")
        name = re.search(r'^ID = "(\w+)"$', text, re.MULTILINE)
        version = re.search(r"^VERSION = (\d+)$", text, re.MULTILINE)
        if name and version:
            found[name[1]] = PlantSource(f"fdi_gym.plants.{path.stem}:plant", int(version[1]))
    return found


@functools.cache
def _entry_point_sources() -> dict[str, PlantSource]:
    """Plants of other packages: entry points such as DCMotor-Faults-v0 = "dc_motor:plant"; others are left aside."""
    found = {}
    for entry_point in entry_points(group="fdi_gym.plants"):
        name = re.fullmatch(r"(\w+)-Faults-v(\d+)", entry_point.name)
        if name and _BUILDER.fullmatch(entry_point.value) and name[1] not in _package_sources():
            found[name[1]] = PlantSource(entry_point.value, int(name[2]))
    return found


def plant_sources() -> dict[str, PlantSource]:
    """All plants by id, read from the ID and VERSION lines of the plant files: nothing is imported to list them."""
    return dict(sorted((_package_sources() | _entry_point_sources() | _registered).items()))


def add_plant_source(plant_id: str, source: PlantSource) -> None:
    """Make a plant outside the package known; users call `fdi_gym.register_plant`, which registers its environment too.

    Raises:
        ValueError: The id, version or builder cannot be one, or a plant of the package has the id.
    """
    if not isinstance(plant_id, str) or not re.fullmatch(r"\w+", plant_id):
        raise ValueError(f"a plant's id is a word of letters, digits and underscores, not {plant_id!r}")
    if not is_whole(source.version) or source.version < 0:
        raise ValueError(f"{plant_id}: version is a whole number from 0 on, not {source.version!r}")
    if not isinstance(source.builder, str) or not _BUILDER.fullmatch(source.builder):
        raise ValueError(f"{plant_id}: the builder is named as 'module:function', not {source.builder!r}")
    if plant_id in _package_sources():
        raise ValueError(f"{plant_id} is a plant of this package; another one needs another id")
    _registered[plant_id] = source


def load_plant(plant_id: str, **options: Any) -> Plant:
    """Build a plant by id; "module:id" where importing the module registers it.

    It takes the options of its data sheet, and those of every plant (`fdi_gym.options`).

    Raises:
        ValueError: Unknown plant, option or option value (the message lists those that exist), or a builder that does
            not build the plant it is registered for.
    """
    if isinstance(plant_id, str) and ":" in plant_id:
        module, _, plant_id = plant_id.rpartition(":")
        find_module(module)
    sources = plant_sources()
    if not isinstance(plant_id, str) or plant_id not in sources:
        raise unknown("plant", plant_id, sources)
    return Origin(plant_id, sources[plant_id], options).build()


def _built(plant_id: str, source: PlantSource, options: dict[str, Any]) -> Plant:
    module, function = source.builder.split(":")
    try:
        build = getattr(importlib.import_module(module), function)
        parameters = inspect.signature(build).parameters
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise ValueError(f"{plant_id}: its builder {source.builder!r} cannot be imported: {what}") from error
    try:
        own, layers = split_options(options)
    except ValueError as error:
        raise ValueError(f"{plant_id}: {error}") from None
    named = [n for n, p in parameters.items() if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        for option in own:
            if option not in named and option in layers.__struct_fields__:  # "feedback", in nobody's words
                layers.check_feedback(own[option])
            if option not in named:
                raise unknown("option", option, [*named, *layers.__struct_fields__], f"{plant_id} has")
    try:
        plant = build(**own)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{plant_id} with the options {options}: {error}") from error
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise ValueError(f"{plant_id}: its builder {source.builder!r} fails with the options {options}: {what}") from error
    if not isinstance(plant, Plant) or (plant.id, plant.version) != (plant_id, source.version):
        made = f"the plant {plant.env_id}" if isinstance(plant, Plant) else repr(plant)
        raise ValueError(f"{source.builder!r} is registered for {plant_id}-Faults-v{source.version}, but returns {made}")
    try:
        plant = layers.applied(plant)
    except ValueError as error:
        raise ValueError(f"{plant_id} with the options {options}: {error}") from error
    defaults = {n: parameters[n].default for n in named}
    object.__setattr__(plant, "_origin", Origin(plant_id, source, {**defaults, **options}))
    return plant
