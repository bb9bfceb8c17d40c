"""New packages: a plant or a diagnoser outside this one, with its entry points, a test, a suite, a row and a board."""

from __future__ import annotations

import contextlib
import keyword
import re
import sys
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Literal

import fdi_gym
from fdi_gym import leaderboard, row
from fdi_gym.diagnosis import diagnosers
from fdi_gym.discovery import plant_sources
from fdi_gym.evaluation import evaluate
from fdi_gym.files import write_whole
from fdi_gym.names import find_module
from fdi_gym.suite import Suite, freeze, suite_names

EXAMPLE = "B747Lateral"  # the plant of a new diagnoser's suite: a linear one
FLIGHTS = 10
FIRST_SEED = 1_000_000


def new(kind: Literal["plant", "diagnoser"], folder: Path) -> list[Path]:
    """Write a package into a folder that is not there yet, or empty; its name is the folder's.

    Args:
        kind: What it brings.
        folder: The folder.

    Returns:
        The files.

    Raises:
        ValueError: The folder holds something, or its name cannot be that of a package, or is taken.
    """
    name = folder.resolve().name.replace("-", "_")
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,40}", name) or keyword.iskeyword(name) or name in sys.stdlib_module_names:
        raise ValueError(
            f"a package is called by up to 41 of a to z, digits and '_', and like no module of Python, not {name!r}"
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} is there already and not empty")
    with contextlib.suppress(ValueError):
        find_module(name)
        raise FileExistsError(f"there is a module {name} already; choose another name")
    identifier = "".join(part.capitalize() for part in name.split("_"))
    bench = f"{name.replace('_', '-')}-bench"
    method = "augmented_ekf" if kind == "plant" else name
    for what, taken in ((identifier, plant_sources()), (name, diagnosers()), (bench, suite_names())):
        if what in taken:
            raise ValueError(f"there is {what} already; choose another name")
    points = {
        "plant": f'[project.entry-points."fdi_gym.plants"]\n{identifier}-Faults-v0 = "{name}.plant:plant"',
        "diagnoser": f'[project.entry-points."fdi_gym.diagnosers"]\n{name} = "{name}.method"',
    }[kind]
    conforms = {
        "plant": f'check_plant(load_plant("{identifier}"))',
        "diagnoser": f'check_diagnoser(lambda plant, scenarios: make_diagnoser("{name}", plant), load_plant("{EXAMPLE}"))',
    }[kind]
    imports = {
        "plant": ["discovery import load_plant", "suite import load_suite", "testing import check_plant"],
        "diagnoser": ["diagnosis import make_diagnoser", "discovery import load_plant", "suite import load_suite",
                      "testing import check_diagnoser"],
    }[kind]  # fmt: skip
    words = {
        "IMPORTS": "\n".join(f"from fdi_gym.{line}" for line in imports),
        "ENTRY_POINTS": f'{points}\n\n[project.entry-points."fdi_gym.suites"]\n{name} = "{name}.suites"',
        "CONFORMS": conforms, "IDENTIFIER": identifier, "DISTRIBUTION": name.replace("_", "-"), "PACKAGE": name,
        "BENCH": bench,
        "METHOD": method, "KIND": f"A {kind}", "WHAT": identifier if kind == "plant" else name,
        "PLANT": "plant" if kind == "plant" else "method",
    }  # fmt: skip
    code = "plant" if kind == "plant" else "method"
    texts = {
        "pyproject.toml": _text("pyproject", words), "README.md": _text("readme", words),
        f"tests/test_{name}.py": _text("test", words),
        f"{name}/__init__.py": f'"""{identifier}: a {kind} for fdi_gym."""\n',
        f"{name}/suites/__init__.py": '"""The suites of this package."""\n',
        f"{name}/{code}.py": _text("plant" if kind == "plant" else "diagnoser", words),
    }  # fmt: skip
    for path, text in texts.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write_whole(folder / path, text.encode())
    with _importable(folder):
        if kind == "plant":
            fdi_gym.register_plant(identifier, f"{name}.plant:plant")
        else:
            find_module(f"{name}.method")
        _make_row(folder, name, bench, identifier if kind == "plant" else EXAMPLE, ["null", method])
    return sorted(path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)


def _text(name: str, words: dict[str, str]) -> str:
    text = files("fdi_gym.templates").joinpath(f"{name}.txt").read_text(encoding="utf-8")
    return re.sub(r"\b(" + "|".join(words) + r")\b", lambda found: words[found[0]], text)


@contextlib.contextmanager
def _importable(folder: Path) -> Iterator[None]:
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path.remove(str(folder.resolve()))


def _make_row(folder: Path, name: str, bench: str, plant_id: str, methods: list[str]) -> None:
    """Freeze the suite, evaluate it and render its board."""
    built = plant_sources()[plant_id]
    suite = Suite(
        name=bench, description=f"{FLIGHTS} flights of {plant_id}", env=f"{plant_id}-Faults-v{built.version}",
        plant=plant_id,
        options={}, process="standard", mismatch=None, seeds=list(range(FIRST_SEED, FIRST_SEED + FLIGHTS)), settings={},
    ).sealed()  # fmt: skip
    path = freeze(suite, folder / name / "suites")
    found = evaluate(suite, methods, work=folder / "runs", jobs=1, progress=False, command=f"fdi-gym evaluate {bench}")
    row.write_rows(folder / "results", suite, found)
    (folder / "boards").mkdir()
    for page, text in leaderboard.pages(leaderboard.boards(folder / "results", [str(path)])).items():
        write_whole(folder / "boards" / page, text.encode())
    write_whole(folder / ".gitignore", b"runs/\n__pycache__/\n")
