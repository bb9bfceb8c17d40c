"""What structure can tell apart: the three tanks' classes, laws of the decomposition, and the page."""

import numpy as np
import pytest
from conftest import PLANTS, ROOT, build
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import structural_rank

from benchmarks.isolability import angle, confused, overdetermined, page, structure

# as the Fault Diagnosis Toolbox 0.12.5 gives them for the same equations: python -m benchmarks.isolability --toolbox
ALONE = [{"leak 1", "pump loss 1"}, {"leak 2", "pump loss 2", "drain"}, {"leak 3"}, {"plug 13"}, {"plug 32"},
         {"sensor h1"}, {"sensor h2"}, {"sensor h3"}]  # fmt: skip
BESIDE = [{"leak 1", "pump loss 1"}, {"leak 3", "plug 32", "sensor h2"}, {"plug 13"}, {"sensor h1"}, {"sensor h3"}]
UNSEEN = {"leak 2", "pump loss 2"}


def test_leak_and_pump_loss_of_a_tank_are_one_to_structure():
    """In tank 2 the drain is a third; where it may do anything, that tank's balance says nothing of its faults."""
    for beside, classes, unseen in ((False, ALONE, set()), (True, BESIDE, UNSEEN)):
        found = confused(structure(build("ThreeTank"), beside))
        assert {name for name, others in found.items() if others is None} == unseen
        assert {frozenset({name} | others) for name, others in found.items() if others is not None} == set(
            map(frozenset, classes)
        )


def test_level_and_command_tell_apart_what_structure_cannot():
    """A leak and a pump loss move apart as soon as level and command do; a leak in tank 2 is the drain at any level."""
    tanks = build("ThreeTank")
    for pair in (("leak 1", "pump loss 1"), ("leak 2", "pump loss 2")):
        assert angle(tanks, *pair, flown=False) == pytest.approx(0.0, abs=1e-5)
        assert 5.0 < angle(tanks, *pair, flown=True) < 25.0
    assert angle(tanks, "leak 2", "drain", flown=True) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("plant_id", PLANTS)
def test_what_cannot_be_told_apart_is_a_class(plant_id):
    """Symmetric and transitive among the faults that are seen; a disturbance always there makes no class smaller."""
    plant = build(plant_id)
    alone, beside = (confused(structure(plant, there)) for there in (False, True))
    for found in (alone, beside):
        for name, others in found.items():
            for other in others or ():
                assert {other, *found[other]} == {name, *others}
    for name, others in beside.items():
        assert others is None or (alone[name] is not None and alone[name] - {s.name for s in plant.disturbances} <= others)


@pytest.mark.parametrize("plant_id", PLANTS)
def test_a_fault_stands_in_the_equations_that_it_moves(plant_id):
    """Sizes of sensors' faults in their own sensor; every mode somewhere; each state and its rate belong together."""
    plant = build(plant_id)
    model = structure(plant, False)
    assert all(model.enters.values())
    for s in plant.outputs:
        assert model.enters[f"sensor {s.name}"] == [s.name]
    assert set(plant.mode_names) <= set(model.faults)


def test_the_overdetermined_part_is_what_can_go_without_loss_of_rank():
    """An equation lies there where the rest determines as many unknowns without it: the definition, on random structures."""
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(200):
        matrix = rng.random((rng.integers(1, 9), rng.integers(1, 9))) < 0.3
        rank = structural_rank(csr_matrix(matrix))
        wanted = [structural_rank(csr_matrix(np.delete(matrix, i, axis=0))) == rank for i in range(len(matrix))]
        assert overdetermined(matrix).tolist() == wanted
        kinds |= set(wanted)
    assert kinds == {True, False}


def test_page_is_what_the_command_writes():
    assert (ROOT / "leaderboards" / "isolability.md").read_text() == page(PLANTS)
