"""The documentation: it builds without a warning, and what is data in it is what the package says."""

import html
import os
import re
import subprocess
import sys
from collections import Counter

import pytest
from conftest import PLANTS, ROOT, build

from fdi_gym.design import truths
from fdi_gym.diagnosis import diagnosers
from fdi_gym.suite import load_suite, suite_names

pytest.importorskip("mkdocstrings", reason="pip install 'fdi-gym[docs]'")
pytest.importorskip("material", reason="pip install 'fdi-gym[docs]'")
PAGES = ROOT / "docs" / "pages"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    target = tmp_path_factory.mktemp("site")
    # not -q: what is quiet counts no warnings, and --strict then passes them
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(ROOT / "docs" / "mkdocs.yml"), "-d", target]
    done = subprocess.run(command, capture_output=True, text=True, timeout=580, cwd=ROOT,
                          env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return target


def words(path):
    """What a page says, without its markup."""
    text = re.sub(r"(?s)<(script|style).*?</\1>", "", path.read_text(encoding="utf-8"))
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", text)).split())


@pytest.mark.parametrize("plant_id", PLANTS)
def test_a_data_sheet_says_all_that_a_plant_declares(site, plant_id):
    said, plant = words(site / "plants" / f"{plant_id}.html"), build(plant_id)
    for signal in (*plant.observed, *plant.states, *plant.theta, *plant.estimated, *plant.disturbances):
        assert f"{signal.name} {signal.unit or '-'} " in said
    for named in (*plant.modes, *plant.labels):
        assert named.name in said
    for name in (*plant.processes, *plant.options, plant.env_id):
        assert name in said
    assert "Sources, and what is this benchmark's own" in said


@pytest.mark.parametrize("name", suite_names())
def test_a_suites_sheet_says_what_is_in_it(site, name):
    suite, said = load_suite(name), words(site / "suites" / f"{name}.html")
    plant = suite.build()
    held = Counter(v for s in suite.scenarios(plant, range(suite.episodes)) for v in truths(plant, suite.process, s))
    for i, label in enumerate(plant.labels):
        assert f"{label.name} {held[i]} " in said
    for word in (suite.sha256, suite.scenarios_sha256, f"{suite.episodes}: ", "MIT", plant.env_id):
        assert word in said


def test_every_plant_and_method_says_where_it_comes_from(site):
    said = words(site / "origins.html")
    for name in (
        *PLANTS,
        *(name for name, entry in diagnosers().items() if entry.build.__module__.startswith("baselines.")),
    ):
        assert f"{name} " in said or f"{name}," in said
    assert "Source: " in said


def test_every_method_has_its_line(site):
    said = words(site / "methods.html")
    for name, entry in diagnosers().items():
        assert name in said
        assert entry.knows in said


def test_boards_and_reports_are_those_of_the_repository(site):
    for path in sorted((ROOT / "leaderboards" / "results").glob("*")):
        assert (site / "boards" / f"{path.name}.html").exists()
    assert "<script" in (site / "reports" / "b747-standard.html").read_text()
    assert 'src="reports/b747-standard.html"' in (site / "index.html").read_text()


def test_the_reference_has_shapes_and_units(site):
    said = words(site / "reference" / "flights.html")
    assert "(N, K + 1, n_obs) what a diagnoser may see" in (ROOT / "fdi_gym" / "engine.py").read_text()
    for name in ("fdi_gym.engine", "simulate", "advance", "(samples, N, n_u)"):
        assert name in said


def test_a_tutorials_code_is_an_example_that_runs():
    """Code in the tutorials is included from examples/, which a test runs; none is written a second time."""
    pages = sorted((PAGES / "tutorials").glob("*.md"))
    blocks = [b for page in pages for b in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)]
    assert len(blocks) >= 5
    for block in blocks:
        found = re.fullmatch(r'--8<-- "(examples/\w+\.py)"\n', block)
        assert found
        assert (ROOT / found[1]).exists()


def test_nothing_is_fetched_from_elsewhere(site):
    for path in ("index.html", "concepts/time.html", "plants/B747Lateral.html"):
        fetched = re.findall(r'<(?:script|link|img|iframe)[^>]*(?:src|href)="(https?://[^"]+)"', (site / path).read_text())
        assert not fetched
