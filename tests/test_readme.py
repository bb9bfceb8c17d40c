"""The README says what is there, and its code runs."""

import re
import subprocess
import sys

import pytest
from conftest import PLANTS, ROOT, build

README = (ROOT / "README.md").read_text()
CODE = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("code", CODE, ids=[str(i) for i in range(len(CODE))])
def test_code_blocks_run(code):
    exec(compile(code, "README.md", "exec"), {})


def test_every_plant_is_in_the_table():
    for plant_id in PLANTS:
        assert f"`{build(plant_id).env_id}`" in README


def test_links_lead_somewhere():
    for page in ("README.md", "CONTRIBUTING.md", "leaderboards/README.md"):
        text = (ROOT / page).read_text()
        for link in re.findall(r"\]\((?!http)([^)#]+)\)", text):
            assert ((ROOT / page).parent / link).exists(), f"{page}: {link}"


def test_ci_runs_the_readmes_test_command():
    command = next(line for line in README.splitlines() if "pytest -n" in line)
    assert "grep -m1 'pytest -n' README.md" in (ROOT / ".ci" / "run").read_text()
    assert command.startswith("pip install -c constraints.txt")
    assert (ROOT / "constraints.txt").exists()


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda p: p.stem)
def test_examples_run(path):
    done = subprocess.run([sys.executable, str(path)], capture_output=True, text=True, timeout=300, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
