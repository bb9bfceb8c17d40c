"""Data sheets of plants and suites, the list of methods, and where all comes from, made of what the package declares."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path
from typing import Any

from fdi_gym import diagnosis
from fdi_gym.design import DECISIONS, truths
from fdi_gym.diagnosis.registry import GIVEN
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.plant import Plant
from fdi_gym.suite import ActingSuite, Suite, load_suite, suite_names
from fdi_gym.tables import markdown, plain

BOARDS = Path(__file__).parent.parent / "leaderboards"


def _number(value: float) -> str:
    return "inf" if value == float("inf") else "-inf" if value == -float("inf") else f"{value:g}"


def _signals(signals: Any, *, noise: bool = False, nominal: str = "") -> str:
    head = ["name", "unit", "low", "high", "scale", *([nominal] if nominal else []), *(["noise (1 sigma)"] if noise else [])]
    rows = [
        [f"`{s.name}`", s.unit or "-", _number(s.low), _number(s.high), _number(s.scale),
         *([_number(s.nominal)] if nominal else []), *([_number(s.sigma)] if noise else [])]
        for s in signals
    ]  # fmt: skip
    return markdown(head, rows)


def data_sheet(plant: Plant) -> str:
    """A plant's page: the docstring of its file, which says what it is and where it departs from its source, then all that
    it declares."""
    source = plant_sources()[plant.id].builder.partition(":")[0]
    words = inspect.getdoc(importlib.import_module(source)) or ""
    title, _, rest = words.partition("\n")
    options = markdown(["option", "default"], [[f"`{k}`", f"`{v!r}`"] for k, v in plant.options.items()])
    parts = [
        f"# {plant.id}", f"**{title}** Environment `{plant.env_id}`; sample time {plant.dt:g} s; "
        f"{'linear' if plant.linear else 'nonlinear'} dynamics. Source file: `{source.replace('.', '/')}.py`.",
        _headings(rest), "## Declared", "What follows is made of the declaration itself.",
        "### Sensors", _signals(plant.outputs, noise=True),
        "### Commands", _signals(plant.commands, nominal="trim"),
    ]  # fmt: skip
    if plant.known:
        parts += ["### Known beside them", _signals(plant.known)]
    parts += ["### States", _signals(plant.states, noise=True)]
    if plant.disturbances:
        parts += ["### Disturbances", _signals(plant.disturbances)]
    parts += [
        "### Fault parameter theta", _signals(plant.theta, nominal="healthy"),
        "### Estimated in the identification task", _signals(plant.estimated),
        "### Fault modes",
        markdown(["mode", "what it does", "small below", "large from", "reach"],
                 [[f"`{m.name}`", plain(m.description), _number(m.bands[0]), _number(m.bands[1]),
                   f"{_number(m.reach[0])} to {_number(m.reach[1])}"] for m in plant.modes]),
        "### Labels", markdown(["label", "name", "modes"], [[str(i), f"`{x.name}`", ", ".join(sorted(x.modes)) or "-"]
                                                              for i, x in enumerate(plant.labels)]),
        "### Fault processes",
        markdown(["process", "what it draws", "scored from sample", "grace [samples]", "decision"],
                 [[f"`{name}`", plain(p.description), str(p.scoring.start), str(p.scoring.grace), p.scoring.decision]
                  for name, p in plant.processes.items()]),
        "### Options", options,
        "### Suites", ", ".join(f"[{name}](../suites/{name}.md)" for name in suite_names()
                                if load_suite(name).plant == plant.id) or "none",
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def _headings(text: str) -> str:
    """A docstring's words under a heading; paragraphs about sources and departures from them are called so."""
    body, _, sources = text.strip().partition("\nSource")
    sources = f"Source{sources}".removeprefix("Sources: ").removeprefix("Source: ") if sources else ""
    return f"## What is flown\n\n{body}" + (
        f"\n\n## Sources, and what is this benchmark's own\n\n{sources}" if sources else ""
    )


def plants() -> str:
    """All plants."""
    rows = []
    for name in plant_sources():
        plant = load_plant(name)
        rows.append([f"[{name}]({name}.md)", plain(plant.description), str(len(plant.outputs)), str(len(plant.labels)),
                     f"{plant.dt:g}"])  # fmt: skip
    head = ["plant", "what it is", "sensors", "labels", "sample time [s]"]
    words = ("One page for each plant: what is flown, where its numbers come from and where it departs from its source, and "
             "all that it declares, with units.")  # fmt: skip
    return f"# Data sheets\n\n{words}\n\n{markdown(head, rows)}\n"


def suite_sheet(suite: Suite) -> str:
    """A suite's page: what it is, how it was drawn, what is in it, and what it is not for."""
    plant = suite.build()
    scenarios = suite.scenarios(plant, range(suite.episodes))
    said = [truths(plant, suite.process, scenario) for scenario in scenarios]
    rows = []
    for i, label in enumerate(plant.labels):
        count = sum(labels.count(i) for labels in said)
        rows.append(
            [f"`{label.name}`", str(count), str(sum(i in labels for labels in said)), "" if count >= DECISIONS else "*"]
        )
    few = any(row[-1] for row in rows)
    steps = [scenario.steps for scenario in scenarios]
    process, drawn = plant.processes[suite.process], len(suite.seeds) // suite.windows
    facts = [
        ["plant", f"[{plant.id}](../plants/{plant.id}.md), `{suite.env}`"],
        ["options", ", ".join(f"`{k}={v!r}`" for k, v in suite.options.items()) or "the defaults"],
        ["fault process", f"`{suite.process}`: {plain(process.description)}"],
        ["mismatch", "what the process prescribes" if suite.mismatch is None else f"level {suite.mismatch:g}"],
        ["flights", f"{suite.episodes}: {drawn} as drawn" + (f", {suite.episodes - drawn} without their faults"
                                                                if suite.healthy else "")],
        ["seeds", f"{min(suite.seeds)} to {max([*suite.seeds, *suite.healthy])}, public; {suite.windows} a flight"],
        ["length", f"{min(steps) * plant.dt:g} to {max(steps) * plant.dt:g} s at {plant.dt:g} s; {sum(steps)} samples"],
        ["scored", f"from sample {process.scoring.start}, but for {process.scoring.grace} samples after a label's change"],
        *([["acts", f"{suite.acts}, a decision every {suite.decision_period} samples"
            + (f", `{suite.on_board}` on board" if suite.on_board else "")]] if isinstance(suite, ActingSuite) else []),
        ["tuning of its own", ", ".join(f"`{name}`" for name in suite.settings) or "none"],
        ["version", f"`{suite.sha256}`"], ["scenarios", f"`{suite.scenarios_sha256}`"],
        ["origin, licence", "simulated by this package, of the declaration of its plant; MIT, as the package; no persons"],
    ]  # fmt: skip
    parts = [
        f"# {suite.name}", plain(suite.description) + f". [Board](../boards/{suite.name}.md)."
        if (BOARDS / f"{suite.name}.md").exists() else plain(suite.description) + ".",
        markdown(["", ""], facts), "## Decisions",
        "One about each window of a fault that holds a scored sample, one about each healthy flight.",
        markdown(["label", "decisions", "flights that have one", ""], rows),
    ]  # fmt: skip
    if few:
        parts.append(f"\\* fewer than {DECISIONS}: what is said about this label alone is uncertain, or it is not drawn.")
    parts += [
        "## Use it for, and not for",
        "For comparing diagnosers on the same flights, with intervals. Not for rates of a fleet: labels are drawn about "
        "evenly, sizes and onsets by the rules of the process. Not for tuning: its seeds are test seeds; validation begins "
        "at 2,000,000, training at 3,000,000.",
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def suites() -> str:
    """All suites."""
    rows = []
    for name in suite_names():
        suite = load_suite(name)
        rows.append([f"[{name}]({name}.md)", plain(suite.description), suite.plant, suite.process, str(suite.episodes)])
    words = "Frozen files of seeds: the same flights for everybody. A suite is never changed; another one gets another name."
    return f"# Suites\n\n{words}\n\n{markdown(['suite', 'what it is', 'plant', 'process', 'flights'], rows)}\n"


def origins() -> str:
    """Where everything comes from."""
    sheets = [
        [f"[{name}](plants/{name}.md)", plain(_sources_of(importlib.import_module(source.builder.partition(":")[0])))]
        for name, source in plant_sources().items()
    ]  # fmt: skip
    files: dict[str, list[str]] = {}
    for name, entry in diagnosis.diagnosers().items():
        files.setdefault(entry.build.__module__, []).append(name)
    made = [[f"`{module.replace('.', '/')}.py`", ", ".join(f"`{n}`" for n in names),
             plain(_sources_of(importlib.import_module(module)))] for module, names in files.items()]  # fmt: skip
    return "\n\n".join([
        "# Origins and licences",
        "All code is written for this package and is MIT-licensed. Equations, numbers and algorithms come from the "
        "publications named here; no code and no data were copied from elsewhere, and no recording comes with the package. "
        "Weights in `baselines/learned/weights` were trained here, on flights that were flown here, and are MIT-licensed "
        "too; their cards say how. What a docstring does not name a source for is textbook, or this benchmark's own.",
        "## Plants", markdown(["plant", "sources"], sheets), "## Methods", markdown(["file", "names", "sources"], made),
        "## Libraries",
        "Dependencies keep their own licences: NumPy, SciPy, Numba, joblib, msgspec and cloudpickle BSD, Gymnasium, tyro "
        "and platformdirs MIT, tqdm MPL 2.0 and MIT; of the extras torch and distributed BSD, stable-baselines3, "
        "sb3-contrib, submitit and Minari MIT, "
        "pyarrow, Ray, safetensors and tensorboard Apache 2.0, Matplotlib its own, like Python's.",
    ]) + "\n"  # fmt: skip


def _sources_of(module: Any) -> str:
    """The part of a module's docstring that names its sources."""
    paragraphs = [" ".join(part.split()) for part in (inspect.getdoc(module) or "").split("\n\n")]
    named = [p for p in paragraphs if re.match(r"(Sources?: |\[1\])", p)]
    cited = [p for p in paragraphs if re.search(r"\b(?:19|20)\d\d\b", p)]
    return " ".join(named or cited[:2]) or "textbook, or this benchmark's own"


def methods() -> str:
    """All diagnosers and trainers."""
    families: dict[str, list[list[str]]] = {}
    for name, entry in diagnosis.diagnosers().items():
        module = entry.build.__module__
        parameters = list(inspect.signature(entry.build).parameters.values())[1:]
        settings = [f"{p.name}={entry.settings.get(p.name, p.default)!r}" for p in parameters
                    if p.name not in GIVEN[entry.kind]]  # fmt: skip
        knows = f" Knows {entry.knows}." if entry.knows else ""
        words = ", ".join(f"`{setting}`" for setting in settings).replace("|", "\\|")
        family = module.split(".")[1] if "." in module else module
        families.setdefault(family, []).append([f"`{name}`", plain(entry.summary) + knows, words or "-"])
    parts = ["# Methods", "Every diagnoser that comes with the package, by where it lies in `baselines/`. `fdi-gym list "
             "NAME` says on which plants one runs, and why not on the others."]  # fmt: skip
    for family, rows in families.items():
        parts += [f"## {family}", markdown(["name", "what it is", "settings"], rows)]
    trainers = [[f"`{name}`", plain(entry.summary)] for name, entry in diagnosis.trainers().items()]
    return "\n\n".join([*parts, "## Trainers", markdown(["name", "what it trains"], trainers)]) + "\n"
