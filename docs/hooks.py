"""Pages of the site that are data: made of the package, the rows and the pages beside them when the site is built.

- plants/<id>.md: the data sheet of every plant, its docstring and what it declares
- methods.md: every diagnoser with its settings
- boards/...: leaderboards/ as it is, with its pictures
- reference/<module>.md: the public modules, for mkdocstrings
- reports/<suite>.html: a report for each suite that has rows
"""

from __future__ import annotations

import importlib
import inspect
import logging
import posixpath
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from fdi_gym import diagnosis
from fdi_gym.diagnosis.registry import GIVEN
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.leaderboard import read_board
from fdi_gym.plant import Plant
from fdi_gym.report import report
from fdi_gym.suite import load_suite, suite_names
from fdi_gym.tables import markdown, plain

BOARDS = ROOT / "leaderboards"
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
FLIGHTS = 10  # of a report
REFERENCE = {
    "Environments": ("envs", "vector_envs", "active_envs", "tasks", "wrappers", "sb3"),
    "Plants": ("plant", "data_sheet", "acting", "faults", "shapes", "kernels", "discovery"),
    "Flights": ("engine", "flights", "acts", "agents", "model"),
    "Diagnosers": ("diagnosis.contract", "diagnosis.filtering", "diagnosis.registry", "diagnosis.making",
                   "diagnosis.fitting", "diagnosis.guard"),
    "Estimation": ("estimation.belief", "estimation.calibration", "estimation.decision", "estimation.augmented",
                   "estimation.gaussian", "estimation.kalman", "estimation.linear", "estimation.labels",
                   "estimation.interval", "estimation.equivalent"),
    "Scores": ("metrics", "declaration", "scores", "intervals", "comparison", "curves"),
    "Suites and rows": ("suite", "design", "evaluation", "row", "verification", "leaderboard", "tables"),
    "Pages and pictures": ("report", "pictures", "plots", "palette"),
    "Checks": ("testing",),
}  # fmt: skip


def on_config(config: Any) -> Any:
    """The pages that are made get their places."""
    made = {
        "@plants": ["plants/index.md", *({name: f"plants/{name}.md"} for name in plant_sources())],
        "@boards": ["boards/README.md", {"Grid of methods and plants": "boards/grid.md"},
                    {"Learned": "boards/learning/README.md"}, {"Coverage of the intervals": "boards/coverage.md"},
                    {"Acting": "boards/acting.md"},
                    *({path.stem: f"boards/{path.name}"} for path in sorted(BOARDS.glob("*-*.md")))],
        "@reproduction": ["reproduction.md", *({path.stem: f"boards/reproduction/{path.name}"} for path in _reproduction())],
        "@reference": [{title: f"reference/{_slug(title)}.md"} for title in REFERENCE],
    }  # fmt: skip
    config.nav = [{k: made[v] if isinstance(v, str) and v in made else v for k, v in item.items()} for item in config.nav]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Make them."""
    texts = {f"plants/{name}.md": data_sheet(load_plant(name)) for name in plant_sources()}
    texts |= {"plants/index.md": plants(), "methods.md": methods(), "reproduction.md": reproduction()}
    texts |= {f"reference/{_slug(title)}.md": reference(title, modules) for title, modules in REFERENCE.items()}
    mirrored = {f"boards/{path.relative_to(BOARDS).as_posix()}": path for path in BOARDS.rglob("*.*")
                if path.suffix in (".md", ".png") and path.name != "template.md"}  # fmt: skip
    for uri, path in mirrored.items():
        if path.suffix == ".png":
            files.append(File.generated(config, uri, abs_src_path=str(path)))
        else:
            texts[uri] = _within(path.read_text(encoding="utf-8"), uri, set(mirrored))
    texts["contributing.md"] = _within((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), "contributing.md", set())
    logging.getLogger("fdi_gym").setLevel(logging.ERROR)
    found = dict(_reports())
    texts["index.md"] = _front((Path(config.docs_dir) / "index.md").read_text(encoding="utf-8"), list(found))
    old = files.get_file_from_path("index.md")
    if old is not None:
        files.remove(old)
    for uri, text in (texts | found).items():
        files.append(File.generated(config, uri, content=text))
    return files


def _slug(title: str) -> str:
    return title.lower().replace(" ", "-")


def _reproduction() -> list[Path]:
    return sorted((BOARDS / "reproduction").glob("*.md"))


def _within(text: str, uri: str, known: set[str]) -> str:
    """A page whose links lead to pages of the site; what lies outside is named and not linked."""

    def link(found: re.Match[str]) -> str:
        picture, words, target = found.groups()
        path = target.partition("#")[0]
        inside = not path or posixpath.normpath(posixpath.join(posixpath.dirname(uri), path)) in known
        return found[0] if "://" in target or inside else f"`{path}`" if picture else f"{words} (`{path}`)"

    return LINK.sub(link, text)


# ---------------------------------------------------------------------------------------------------------------
# Reports


def _reports() -> Iterator[tuple[str, str]]:
    for name in suite_names():
        folder = BOARDS / "results" / name
        if folder.is_dir():
            yield (
                f"reports/{name}.html",
                report(read_board(folder, {name: load_suite(name)}), flights=FLIGHTS, progress=False),
            )


def _front(text: str, reports: list[str]) -> str:
    """The first page: it shows the first report, and leads to the others."""
    if not reports:
        return text.replace("{{report}}", "There are no rows yet.")
    links = " ".join(f"[{Path(uri).stem}]({uri})" for uri in reports)
    frame = f'<iframe class="report" src="{reports[0]}" title="{Path(reports[0]).stem}"></iframe>'
    return text.replace("{{report}}", f"{frame}\n\nReports: {links}")


# ---------------------------------------------------------------------------------------------------------------
# Data sheets


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
        "### Suites", ", ".join(f"`{name}`" for name in suite_names() if load_suite(name).plant == plant.id) or "none",
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


def reproduction() -> str:
    """The page that leads to the reproduction pages."""
    links = "\n".join(f"- [{path.stem}](boards/reproduction/{path.name})" for path in _reproduction())
    return ("# Reproduction\n\nThe published figures of each plant's source beside ours. `python -m "
            f"benchmarks.reproduction.<plant>`, from a checkout, measures them again.\n\n{links}\n")  # fmt: skip


def reference(title: str, modules: tuple[str, ...]) -> str:
    """A page of the reference."""
    return f"# {title}\n\n" + "\n\n".join(f"::: fdi_gym.{module}" for module in modules) + "\n"
