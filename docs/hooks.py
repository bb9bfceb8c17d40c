"""Pages of the site that are data: made of the package, the rows and the pages beside them when the site is built.

- plants/<id>.md: the data sheet of every plant, its docstring and what it declares
- suites/<name>.md: the data sheet of every suite
- origins.md: where every plant and method comes from, and under which licence it is here
- methods.md: every diagnoser with its settings
- boards/...: leaderboards/ as it is, with its pictures
- reference/<module>.md: the public modules, for mkdocstrings
- reports/<suite>.html: a report for each suite that mkdocs.yml names (`extra.reports`); `fdi-gym report` makes the others
"""

from __future__ import annotations

import logging
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

from sheets import data_sheet, methods, origins, plants, suite_sheet, suites

from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.leaderboard import read_board
from fdi_gym.report import report
from fdi_gym.suite import load_suite, suite_names

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
                   "estimation.interval", "estimation.equivalent", "estimation.events"),
    "Scores": ("metrics", "declaration", "scores", "intervals", "comparison", "curves"),
    "Suites and rows": ("suite", "design", "evaluation", "row", "verification", "rounds", "leaderboard", "tables"),
    "Recordings": ("recordings", "recordings.observations", "recordings.mapping", "recordings.suite", "export"),
    "Clusters": ("clusters",),
    "Pages and pictures": ("report", "pictures", "plots", "palette"),
    "Checks": ("testing",),
}  # fmt: skip


def on_config(config: Any) -> Any:
    """The pages that are made get their places."""
    made = {
        "@plants": ["plants/index.md", *({name: f"plants/{name}.md"} for name in plant_sources())],
        "@suites": ["suites/index.md", *({name: f"suites/{name}.md"} for name in suite_names())],
        "@boards": ["boards/README.md", {"Grid of methods and plants": "boards/grid.md"},
                    {"Learned": "boards/learning/README.md"}, {"Seeds of training": "boards/learning/seeds.md"},
                    {"Flights of training": "boards/learning/flights.md"},
                    {"What can be attained": "boards/attainable.md"},
                    {"Coverage of the intervals": "boards/coverage.md"},
                    {"Bounds with probes": "boards/acting-bounds.md"}, {"Sensors": "boards/sensors.md"},
                    {"Unseen faults": "boards/unseen.md"},
                    {"Missing samples": "boards/gaps.md"},
                    {"Structural isolability": "boards/isolability.md"},
                    *({path.stem: f"boards/{path.name}"} for path in sorted(BOARDS.glob("*-*.md"))
                      if path.stem in suite_names())],
        "@reproduction": ["boards/reproduction/README.md",
                          *({path.stem: f"boards/reproduction/{path.name}"} for path in _reproduction())],
        "@reference": [{title: f"reference/{_slug(title)}.md"} for title in REFERENCE],
    }  # fmt: skip
    config.nav = [{k: made[v] if isinstance(v, str) and v in made else v for k, v in item.items()} for item in config.nav]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Make them."""
    texts = {f"plants/{name}.md": data_sheet(load_plant(name)) for name in plant_sources()}
    texts |= {f"suites/{name}.md": suite_sheet(load_suite(name)) for name in suite_names()}
    texts |= {"suites/index.md": suites(), "origins.md": origins()}
    texts |= {"plants/index.md": plants(), "methods.md": methods()}
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
    found = {f"reports/{name}.html": _report(name) for name in config.extra["reports"]}
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
    return sorted(path for path in (BOARDS / "reproduction").glob("*.md") if path.name != "README.md")


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


def _report(name: str) -> str:
    return report(read_board(BOARDS / "results" / name, {name: load_suite(name)}), flights=FLIGHTS, progress=False)


def _front(text: str, reports: list[str]) -> str:
    """The first page: it shows the first report, and leads to the others."""
    links = " ".join(f"[{Path(uri).stem}]({uri})" for uri in reports)
    frame = f'<iframe class="report" src="{reports[0]}" title="{Path(reports[0]).stem}"></iframe>'
    return text.replace("{{report}}", f"{frame}\n\nReports: {links}")


# ---------------------------------------------------------------------------------------------------------------
# Pages that lead to others


def reference(title: str, modules: tuple[str, ...]) -> str:
    """A page of the reference."""
    return f"# {title}\n\n" + "\n\n".join(f"::: fdi_gym.{module}" for module in modules) + "\n"
