"""Kernels compiled by several processes, and groups of diagnosers: what the first command does before it flies."""

import os
import subprocess
import sys

import pytest

from fdi_gym.diagnosis import diagnoser, diagnosers, named, registry

COMPILE = """
from fdi_gym.compilation import compile_kernels
from fdi_gym.diagnosis import compiled
from fdi_gym.kernels import uncompiled
modules = ["fdi_gym.diagnosis.compiled", "fdi_gym.no_such_module"]
names = sorted(kernel.py_func.__name__ for kernel in uncompiled(modules))
compile_kernels(modules, jobs=2, progress=False)
print(*names, "|", *(kernel.py_func.__name__ for kernel in uncompiled(modules)), "|", len(compiled.report.overloads))
"""


def test_kernels_that_other_processes_compile_are_in_the_cache(tmp_path):
    environment = os.environ | {"FDI_GYM_CACHE_DIR": str(tmp_path)}
    for expected in ("look receive report | | 0", "| | 0"):
        done = subprocess.run([sys.executable, "-c", COMPILE], env=environment, capture_output=True, text=True)
        assert done.stdout.strip() == expected, done.stderr[-2000:]


def test_a_group_stands_for_its_diagnosers():
    everything = diagnosers()
    assert named(["all"]) == list(everything)
    reference = named(["reference"])
    assert set(reference) == {name for name, entry in everything.items() if entry.reference or entry.ceiling}
    assert {"null", "random", "two_stage_kf", "augmented_ekf"} < set(reference) < set(everything)
    assert named(["my_module:own", "null", "reference", "null"]) == ["my_module:own", *dict.fromkeys(["null", *reference])]


@pytest.mark.parametrize("group", registry.GROUPS)
def test_no_diagnoser_has_the_name_of_a_group(group):
    assert group not in diagnosers()
    with pytest.raises(ValueError, match="group"):
        diagnoser(group, "Mine")(lambda plant: None)
