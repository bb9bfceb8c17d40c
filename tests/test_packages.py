"""Packages of one's own: what `fdi-gym new` writes conforms, is found by entry points, and its row is verified."""

import json
import os
import re
import subprocess
import sys
import tomllib

import pytest
from conftest import ROOT
from test_cli import refused

import fdi_gym
from fdi_gym import discovery, scaffold


def installed(folder, place):
    """The package of a folder as a wheel would put it: its modules, and its entry points beside them."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    name = project["name"].replace("-", "_")
    (place / name).symlink_to(folder / name)
    info = place / f"{name}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = [
        line
        for group, points in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{k} = {v}" for k, v in points.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A plant's and a diagnoser's package, written and installed, and how to call fdi-gym beside them."""
    place, site = tmp_path_factory.mktemp("packages"), tmp_path_factory.mktemp("site")
    for kind, name in (("plant", "bath_tub"), ("diagnoser", "bath_filter")):
        command = [sys.executable, "-m", "fdi_gym.cli", "new", kind, str(place / name)]
        subprocess.run(command, check=True, capture_output=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
        installed(place / name, site)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(site)])}

    def call(*arguments, cwd=place, python=("-m", "fdi_gym.cli")):
        done = subprocess.run(
            [sys.executable, *python, *map(str, arguments)], capture_output=True, text=True, env=environment, cwd=cwd
        )
        return done.returncode, done.stdout, done.stderr

    return place, call


def test_a_new_plant_is_found_everywhere(made):
    place, call = made
    code, out, err = call("list")
    assert code == 0, err
    assert all(word in out for word in ("BathTub-Faults-v0", "bath-tub-bench", "bath_filter", "bath-filter-bench"))
    assert "heated tank" in call("list", "BathTub")[1]
    assert "environment  BathTub-Faults-v0" in call("list", "bath-tub-bench")[1]
    code, out, err = call("check", "BathTub")
    assert code == 0, err
    assert "keeps the contract of a plant" in out
    code, out, err = call(
        "-c", "import gymnasium, fdi_gym; print(gymnasium.make('BathTub-Faults-v0').reset(seed=1)[0].shape)", python=()
    )
    assert out.strip() == "(2,)", err
    code, out, err = call(
        "freeze", "tubs", "--plant", "BathTub", "--process", "standard", "--description", "d", "--episodes", 3
    )
    assert code == 0, err
    assert (place / "tubs.json").exists()


@pytest.mark.parametrize(("name", "method"), [("bath_tub", "augmented_ekf"), ("bath_filter", "bath_filter")])
def test_the_row_of_a_new_package_is_verified_and_its_board_rendered(made, name, method):
    place, call = made
    bench = f"{name.replace('_', '-')}-bench"
    rows = place / name / "results" / bench
    code, _, err = call("verify", rows / f"{method}.json", rows / "null.json", cwd=place / name)
    assert code == 0, err
    before = {path.name: path.read_bytes() for path in (place / name / "boards").glob("*.md")}
    assert f"{bench}.md" in before
    code, _, err = call("leaderboard", "--results", "results", "--pages", "boards", "--no-pictures", cwd=place / name)
    assert code == 0, err
    assert {path.name: path.read_bytes() for path in (place / name / "boards").glob("*.md")} == before
    code, _, err = call("evaluate", f"{name}.suites:{bench}", "--diagnosers", "null", "--episodes", 3, "--jobs", 1)
    assert code == 0, err


@pytest.mark.parametrize("name", ["bath_tub", "bath_filter"])
def test_the_tests_of_a_new_package_pass(made, name):
    place, call = made
    code, out, err = call("-m", "pytest", "-q", "tests", cwd=place / name, python=())
    assert code == 0, out + err


@pytest.mark.parametrize(("name", "words"), [
    ("json", "is called by up to"), ("B", "is called by up to"), ("9x", "is called by up to"),
    ("class", "is called by up to"),
    ("msgspec", "is a module msgspec already"), ("b747lateral", ""),
])  # fmt: skip
def test_a_name_that_cannot_be_is_refused(capsys, tmp_path, name, words):
    if name == "b747lateral":
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine").write_text("")
        words = "not empty"
    assert words in refused(capsys, "new", "plant", tmp_path / name)
    assert {path.name for path in tmp_path.rglob("*")} <= {name, "mine"}


def test_what_does_not_keep_the_contract_is_said(capsys, tmp_path, monkeypatch):
    (tmp_path / "peeking.py").write_text(
        "import numpy as np\nfrom fdi_gym.diagnosis import Diagnoser, Diagnosis\n"
        "def build(plant):\n    rng = np.random.default_rng()\n"
        "    def update(state, obs):\n        alarm = rng.random(len(obs)) < 0.5\n        "
        "return state, Diagnosis(alarm, alarm.astype(int))\n"
        "    return Diagnoser(lambda n: 0, update, gaps=True)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert "not deterministic" in refused(capsys, "check", "peeking:build", "--plants", "B747Lateral")
    assert "runs on no plant" in refused(capsys, "check", "mekf", "--plants", "B747Lateral")
    assert "unknown diagnoser" in refused(capsys, "check", "nothing")


def test_an_entry_point_that_is_no_plant_harms_nothing(monkeypatch):
    from importlib.metadata import EntryPoint

    points = [EntryPoint(name, value, "fdi_gym.plants") for name, value in (
        ("Nothing", "a:b"), ("X-Faults-v0", "not a builder"), ("B747Lateral-Faults-v0", "evil:plant"),
        ("Y-Faults-v3", "nowhere:plant"),
    )]  # fmt: skip
    monkeypatch.setattr(discovery, "entry_points", lambda group: points)
    discovery._entry_point_sources.cache_clear()
    try:
        found = discovery.plant_sources()
        assert "X" not in found
        assert found["B747Lateral"].builder == "fdi_gym.plants.b747_lateral:plant"
        with pytest.raises(ValueError, match="'nowhere:plant' cannot be imported"):
            discovery.load_plant("Y")
    finally:
        discovery._entry_point_sources.cache_clear()


def test_the_row_of_a_package_says_its_version(made):
    place, _ = made
    for name, method, kind in (("bath_tub", "augmented_ekf", "plant"), ("bath_filter", "bath_filter", "method")):
        said = json.loads((place / name / "results" / f"{name.replace('_', '-')}-bench" / f"{method}.json").read_text())
        assert said["packages"][kind] == f"{name.replace('_', '-')} 0.1.0"
        assert said["packages"]["engine"] == f"fdi-gym {fdi_gym.__version__}"


def test_the_citation_and_the_project_file_are_of_this_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = dict(re.findall(r"^(\w+): (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    assert cited["version"] == project["version"] == fdi_gym.__version__
    assert cited["license"] == project["license"] == "MIT"


@pytest.mark.slow
def test_a_new_package_installs(tmp_path):
    folder = tmp_path / "bath_tub"
    scaffold.new("plant", folder)
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--target", str(tmp_path / "site"), str(folder)]
    subprocess.run(command, check=True)
    assert list((tmp_path / "site" / "bath_tub" / "suites").glob("*.json"))
