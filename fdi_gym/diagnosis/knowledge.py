"""What methods know of a plant, as files: shipped with a package, or kept from an earlier session.

`<package of the method>/fits/<Plant>.json` holds beliefs and calibrations by what they were made for. They are valid as long
as the plant's code is the one that they were made from. What is not shipped is found when it is first asked for, and kept
in the cache folder under the sources of the method.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib
import inspect
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fdi_gym.clusters import in_order
from fdi_gym.diagnosis import fitting
from fdi_gym.diagnosis.conforming import fit_conformity
from fdi_gym.diagnosis.fitting import fit_belief, fit_calibration
from fdi_gym.diagnosis.registry import Entry, find_diagnoser, package_of
from fdi_gym.discovery import plant_sources
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.conformity import Conformity
from fdi_gym.estimation.data import alike, from_json, to_json
from fdi_gym.files import write_whole
from fdi_gym.kernel_cache import cache_folder, sources
from fdi_gym.plant import NotApplicableError, Plant


class Fits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The file of a plant: beliefs and calibrations by what they were made for, and the digest of the plant's code."""

    plant: str
    code: str
    beliefs: dict[str, Belief] = {}
    calibrations: dict[str, Calibration] = {}
    conformities: dict[str, Conformity] = {}


def code_digest(plant: Plant) -> str:
    """Digest of the plant's file, comments and docstrings aside; "" for a plant that no file declares."""
    source = plant_sources().get(plant.id)
    file = getattr(importlib.import_module(source.builder.split(":")[0]), "__file__", None) if source else None
    return _code_digest(Path(file)) if file else ""


@functools.cache
def _code_digest(path: Path) -> str:
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
            body[0].value = ast.Constant("")
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:16]


def belief_key(plant: Plant, process: str) -> str:
    """What a belief was made for."""
    return json.dumps([process, dict(plant.options)], sort_keys=True)


def calibration_key(entry: Entry, plant: Plant, process: str, settings: Mapping[str, Any]) -> str:
    """What a calibration was made for."""
    return json.dumps([entry.name, process, dict(plant.options), dict(settings)], sort_keys=True, default=list)


@functools.cache
def fits_file(folder: Path, plant_id: str) -> Fits | None:
    """The shipped fits of a plant in a package's folder; None where there are none, or the file is no such file."""
    path = folder / "fits" / f"{plant_id}.json"
    try:
        return from_json(path.read_bytes(), Fits) if path.is_file() else None
    except (OSError, ValueError) as error:
        print(f"fdi_gym: {path} is not used: {error}", file=sys.stderr)
        return None


_kept: dict[str, Any] = {}
_KINDS = {"beliefs": Belief, "calibrations": Calibration, "conformities": Conformity}


def _known(entry: Entry, plant: Plant, kind: str, key: str, make: Any) -> Any:
    code = code_digest(plant)
    home = package_of(entry)
    shipped = fits_file(home, plant.id) if home else None
    if shipped is not None and shipped.code == code:
        found = getattr(shipped, kind).get(key)
        if found is not None:
            return found
    if not code:  # who can say whether it is the plant of an earlier call
        return make()
    place = f"{plant.env_id} {code} {kind} {key} {_fitting()}"
    if place not in _kept:
        _kept[place] = _on_disk(entry, place, _KINDS[kind], make)
    return _kept[place]


@functools.cache
def _fitting() -> str:
    """Digest of the sources that find a fit, beside the method's and the plant's."""
    digest = hashlib.sha256()
    for path in sources(Path(fitting.__file__)):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _on_disk(entry: Entry, place: str, of: Any, make: Any) -> Any:
    """What an earlier session found with the same sources, else what is found now; a damaged file is made again."""
    folder = cache_folder(inspect.getfile(entry.build))
    if folder is None:
        return make()
    path = folder / f"fit-{hashlib.sha256(place.encode()).hexdigest()[:24]}.json"
    try:
        return from_json(path.read_bytes(), of)
    except (OSError, ValueError):
        found = make()
    part = path.with_suffix(f".{os.getpid()}.part")
    try:
        part.write_bytes(to_json(found))
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
    return found


def knowledge_of(entry: Entry, plant: Plant, process: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The belief, calibration and conformity that a method's builder takes: shipped, or found now and kept for the session.

    Nobody is told which samples go missing: what is known is that of sensors which report at every one.

    Raises:
        NotApplicableError: It takes some, and the plant has no equations from which they could be found.
    """
    found: dict[str, Any] = {}
    if plant.kernels is None and (entry.takes("belief") or entry.takes("calibration")):
        raise NotApplicableError(f"needs equations; {plant.id} declares channels only")
    plant, process = entry.told(plant, process)
    plant = plant if plant.regular is None else plant.regular
    if entry.takes("belief"):
        found["belief"] = _known(entry, plant, "beliefs", belief_key(plant, process), lambda: fit_belief(plant, process))
    if entry.takes("calibration"):
        key = calibration_key(entry, plant, process, settings)
        found["calibration"] = _known(
            entry, plant, "calibrations", key,
            lambda: fit_calibration(entry, plant, process, settings, found.get("belief")),
        )  # fmt: skip
    if entry.takes("conformity"):
        key = calibration_key(entry, plant, process, settings)
        found["conformity"] = _known(
            entry, plant, "conformities", key, lambda: fit_conformity(entry, plant, process, settings)
        )
    return found


def write_fits(path: Path, fits: Fits) -> None:
    """Write a plant's file, indented for readers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, msgspec.json.format(to_json(fits), indent=0) + b"\n")


def merged(path: Path, found: Fits) -> Fits:
    """What was found, and what a file holds of the same plant code beside it: other methods', settings' and processes'."""
    try:
        old = from_json(path.read_bytes(), Fits)
    except (OSError, ValueError):
        return found
    if (old.plant, old.code) != (found.plant, found.code):
        return found
    return msgspec.structs.replace(found, **{kind: {**getattr(old, kind), **getattr(found, kind)} for kind in _KINDS})


class Task(NamedTuple):
    """One fit: a method on a plant, a fault process and its settings."""

    entry: Entry
    plant: Plant
    process: str
    settings: Mapping[str, Any]


def tasks_of(entries: Sequence[Entry], suites: Sequence[Any]) -> dict[str, Task]:
    """What is to be fitted of methods for suites of one plant, by the keys of the calibrations."""
    tasks: dict[str, Task] = {}
    for suite in suites:
        built = suite.build()
        for entry in entries:
            try:
                plant, process = entry.told(built, suite.process)
            except NotApplicableError:
                continue
            if plant is not built:
                continue  # it knows what it knows of the plant without
            plant = built if built.regular is None else built.regular
            settings = entry.resolve(plant, **suite.settings.get(entry.name, {}))
            tasks[calibration_key(entry, plant, process, settings)] = Task(entry, plant, process, settings)
    return tasks


def fit_suites(entries: Sequence[Entry], suites: Sequence[Any], jobs: int = -1) -> dict[Path, Fits]:
    """The fits of methods on the suites of one plant, found anew, side by side; by the file that they belong into.

    Methods that cannot run on the plant have none.
    """
    import joblib

    tasks = tasks_of(entries, suites)
    wanted = {belief_key(t.plant, t.process): t for t in tasks.values() if t.entry.takes("belief")}
    made = in_order([joblib.delayed(_belief)(t.plant, t.process) for t in wanted.values()], jobs)
    beliefs: dict[str, Belief | None] = dict(zip(wanted, made, strict=True))
    last = {kind: {k: t for k, t in tasks.items() if t.entry.takes(kind)} for kind in ("calibration", "conformity")}
    calls = [
        joblib.delayed(_calibration)(
            t.entry.name, *t[1:], beliefs[belief_key(t.plant, t.process)] if t.entry.takes("belief") else None
        )
        for t in last["calibration"].values()
    ]  # fmt: skip
    calls += [joblib.delayed(_conformity)(t.entry.name, *t[1:]) for t in last["conformity"].values()]
    found = dict(zip([*last["calibration"], *last["conformity"]], in_order(calls, jobs), strict=True))
    files: dict[Path, Fits] = {}
    for key, task in tasks.items():
        home = package_of(task.entry)
        path = (home or Path()) / "fits" / f"{task.plant.id}.json"
        fits = files.setdefault(path, Fits(plant=task.plant.id, code=code_digest(task.plant)))
        believed = belief_key(task.plant, task.process)
        if task.entry.takes("belief") and (belief := beliefs[believed]) is not None:
            fits.beliefs[believed] = belief
        if (fit := found.get(key)) is not None:
            (fits.conformities if isinstance(fit, Conformity) else fits.calibrations)[key] = fit
    return files


def renewed(path: Path, entries: Sequence[Entry], suites: Sequence[Any], count: int, seed: int) -> Fits:
    """A plant's file with the digest of the code that is here, where that code gives the same fits.

    Args:
        path: The file.
        entries, suites: Methods, and suites of the plant, for which there are fits in it.
        count: So many beliefs, calibrations and conformities are found anew, drawn at random, and compared to rounding.
        seed: Of that draw.

    Raises:
        ValueError: One is another now: the plant's flights have changed, and all are to be fitted anew.
    """
    fits = from_json(path.read_bytes(), Fits)
    tasks = tasks_of(entries, suites)
    beliefs = {belief_key(t.plant, t.process): t for t in tasks.values()}
    rng = np.random.default_rng(seed)
    for kind, by_key, held in (
        ("belief", beliefs, fits.beliefs), ("calibration", tasks, fits.calibrations),
        ("conformity", tasks, fits.conformities),
    ):  # fmt: skip
        there = sorted(key for key in by_key if key in held)
        for key in rng.permutation(there)[:count].tolist():
            task = by_key[key]
            believed = fits.beliefs.get(belief_key(task.plant, task.process))
            if kind == "belief":
                found: Any = fit_belief(task.plant, task.process)
            elif kind == "conformity":
                found = fit_conformity(task.entry, task.plant, task.process, task.settings)
            else:
                found = fit_calibration(
                    task.entry, task.plant, task.process, task.settings, believed if task.entry.takes("belief") else None
                )
            if not alike(found, held[key]):
                raise ValueError(f"{path}: the {kind} {key} is another now; fit the plant anew")
    return msgspec.structs.replace(fits, code=code_digest(next(iter(tasks.values())).plant))


def _belief(plant: Plant, process: str) -> Belief | None:
    try:
        return fit_belief(plant, process)
    except NotApplicableError:
        return None


def _calibration(
    name: str, plant: Plant, process: str, settings: Mapping[str, Any], belief: Belief | None
) -> Calibration | None:
    entry = find_diagnoser(name)
    if entry.takes("belief") and belief is None:
        return None
    try:
        return fit_calibration(entry, plant, process, settings, belief)
    except NotApplicableError:
        return None


def _conformity(name: str, plant: Plant, process: str, settings: Mapping[str, Any]) -> Conformity | None:
    try:
        return fit_conformity(find_diagnoser(name), plant, process, settings)
    except NotApplicableError:
        return None
