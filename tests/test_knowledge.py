"""What methods know of a plant is shipped for the shipped suites: building flies nothing, fitting gives the same again."""

import dataclasses
import json

import msgspec
import numpy as np
import pytest
from conftest import ROOT, build

from fdi_gym.diagnosis import NotApplicableError, conforming, diagnosers, find_diagnoser, fitting, knowledge, make_diagnoser
from fdi_gym.diagnosis.knowledge import Fits, fits_file, write_fits
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.data import alike, digest
from fdi_gym.faults import draw
from fdi_gym.suite import load_suite, suite_names

SUITES = list(suite_names())
SUITED = sorted({load_suite(name).plant for name in SUITES})


def shipped(plant_id):
    return fits_file(ROOT / "baselines", plant_id)


@pytest.mark.parametrize("plant_id", SUITED)
def test_shipped_fits_are_of_the_code_that_is_here(plant_id):
    fits = shipped(plant_id)
    assert fits is not None, f"fdi-gym fit {plant_id}"
    assert fits.plant == plant_id
    assert fits.code == knowledge.code_digest(build(plant_id)), f"the plant's code changed: fdi-gym fit {plant_id}"


@pytest.mark.parametrize("name", SUITES)
def test_building_on_a_shipped_suite_flies_nothing(monkeypatch, name):
    """Every diagnoser, with the settings that the suite gives it: what it knows is shipped, or it says why it cannot run."""

    def fly(*_, **__):
        raise AssertionError("a flight")

    monkeypatch.setattr(knowledge, "_kept", {})
    monkeypatch.setattr(knowledge, "cache_folder", lambda source: None)
    monkeypatch.setattr(fitting, "flights_of", fly)
    suite = load_suite(name)
    plant = suite.build()
    scenarios, built = suite.scenarios(plant, [0]), 0
    for method, entry in diagnosers().items():
        settings = suite.settings.get(method, {})
        try:
            make_diagnoser(method, plant, process=suite.process, scenarios=scenarios, **settings)
            built += entry.takes("calibration")
        except NotApplicableError:
            continue
    assert built >= 10


@pytest.mark.parametrize("plant_id", SUITED)
def test_methods_get_what_is_shipped_for_them(plant_id):
    """Not another method's, process's or plant's."""
    plant, fits = build(plant_id), shipped(plant_id)
    for process in ("standard", "hard"):
        if knowledge.belief_key(plant, process) not in fits.beliefs:
            continue  # a process that suites fly with other options only
        for name in ("augmented_ekf", "augmented_ukf", "glr_ekf"):
            entry = find_diagnoser(name)
            given = knowledge.knowledge_of(entry, plant, process, entry.resolve(plant))
            assert digest(given["belief"]) == digest(fits.beliefs[knowledge.belief_key(plant, process)])
            key = knowledge.calibration_key(entry, plant, process, entry.resolve(plant))
            assert json.loads(key)[:2] == [name, process]
            assert digest(given["calibration"]) == digest(fits.calibrations[key])


def test_an_edited_plant_or_a_damaged_file_is_not_answered_by_old_fits(monkeypatch, tmp_path, b747):
    entry = find_diagnoser("augmented_ekf")
    made = Calibration(thresholds={mode.name: 1.0 for mode in b747.modes})
    monkeypatch.setattr(knowledge, "_kept", {})
    monkeypatch.setattr(knowledge, "package_of", lambda entry: tmp_path)
    monkeypatch.setattr(knowledge, "cache_folder", lambda source: None)
    key = knowledge.calibration_key(entry, b747, "standard", {})
    path = tmp_path / "fits" / f"{b747.id}.json"

    def ask():
        knowledge.fits_file.cache_clear()
        knowledge._kept.clear()
        return knowledge._known(entry, b747, "calibrations", key, lambda: Calibration())

    write_fits(path, Fits(plant=b747.id, code=knowledge.code_digest(b747), calibrations={key: made}))
    assert digest(ask()) == digest(made)
    whole = path.read_bytes()
    for damaged in (whole[:50], b"", b"[]", whole.replace(b"beliefs", b"believes"), b"\xff" * 10):
        path.write_bytes(damaged)
        assert digest(ask()) == digest(Calibration())
    path.write_bytes(whole)
    assert digest(ask()) == digest(made)
    monkeypatch.setattr(knowledge, "code_digest", lambda plant: "edited")
    assert digest(ask()) == digest(Calibration())
    knowledge.fits_file.cache_clear()


def test_what_is_known_of_a_plant_that_no_file_declares_is_found_each_time(b747):
    """Its author may have changed it since."""
    mine, found = dataclasses.replace(b747, id="Mine"), []
    entry = find_diagnoser("augmented_ekf")
    for _ in range(2):
        knowledge._known(entry, mine, "calibrations", "key", lambda: found.append(1) or Calibration())
    assert len(found) == 2


def test_docstrings_and_comments_do_not_make_another_plant(tmp_path):
    text = '"""A plant."""\nX = 1.0  # unit\n\n\ndef f(x):\n    """It."""\n    return x + X\n'
    digests = []
    for i, version in enumerate(
        (text, text.replace("A plant", "The plant").replace("  # unit", ""), text.replace("1.0", "1.1"))
    ):
        path = tmp_path / f"{i}.py"
        path.write_text(version)
        digests.append(knowledge._code_digest(path))
    assert digests[0] == digests[1] != digests[2]


def test_fitting_some_methods_keeps_what_the_file_holds_of_others(tmp_path, b747):
    """Of the same plant code; what was made from other code goes, and so does a damaged file."""
    path = tmp_path / f"{b747.id}.json"
    a, b, c = (Calibration(thresholds={b747.modes[0].name: value}) for value in (1.0, 2.0, 3.0))
    found = Fits(plant=b747.id, code="now", calibrations={"mine": b})
    assert knowledge.merged(path, found) == found
    write_fits(path, Fits(plant=b747.id, code="now", calibrations={"mine": a, "theirs": c}))
    together = knowledge.merged(path, found).calibrations
    assert {name: digest(value) for name, value in together.items()} == {"mine": digest(b), "theirs": digest(c)}
    write_fits(path, Fits(plant=b747.id, code="before", calibrations={"theirs": c}))
    assert set(knowledge.merged(path, found).calibrations) == {"mine"}
    path.write_bytes(b"{")
    assert set(knowledge.merged(path, found).calibrations) == {"mine"}


@pytest.mark.slow
@pytest.mark.parametrize("plant_id", SUITED)
def test_fitting_again_gives_the_same_bytes(plant_id):
    """Beliefs of all suites, and the calibrations of two quick methods."""
    fits, suites = shipped(plant_id), [suite for suite in map(load_suite, SUITES) if suite.plant == plant_id]
    entries = [find_diagnoser(name) for name in ("augmented_ekf", "two_stage_ekf")]
    (again,) = knowledge.fit_suites(entries, suites).values()
    assert again.code == fits.code
    for kind in ("beliefs", "calibrations"):
        found = getattr(again, kind)
        assert found
        for key, value in found.items():
            assert digest(value) == digest(getattr(fits, kind)[key]), key


def test_a_belief_is_near_what_the_data_sheet_declares():
    """Process and sensor noise of the shipped beliefs are at least the declared ones, and walks reach the faults' sizes."""
    for plant_id in SUITED:
        for key, belief in shipped(plant_id).beliefs.items():
            assert (np.linalg.eigvalsh(belief.Q) > -1e-12 * np.trace(belief.Q)).all(), key
            assert (belief.z_walk > 0).all()
            assert (belief.z_walk < 10 * belief.z_size).all(), key
            assert 0 <= belief.changes < 0.1


def test_a_disturbance_that_stands_still_may_move_by_a_thousandth_of_its_scale_over_a_flight(b747):
    steady = dataclasses.replace(b747, disturbance=lambda s: np.full((s.steps + 1, len(b747.disturbances)), 0.3))
    found, steps = fitting.fit_belief(steady, "standard"), draw(b747.process("standard"), 0).steps
    floor = 1e-3 * b747.disturbances[0].scale
    assert found.d_walk == pytest.approx(floor / np.sqrt(steps))
    assert found.d0 == pytest.approx(np.hypot(0.3, floor), rel=1e-7)


def test_what_stands_after_a_flights_end_does_not_count(b747):
    """The spread of a healthy estimate is that of the samples that were flown."""
    record = fitting.flights_of(b747, "standard", 400_000, 3, False)[1]
    record = record._replace(obs=5.0 * record.obs[:, :200], length=np.array([60, 150, 199]))
    other, k = record.obs.copy(), np.arange(200)
    other[k[None] > record.length[:, None]] *= 2.0

    belief, built = fitting.fit_belief(b747, "standard"), find_diagnoser("augmented_ekf").build

    def excess(obs):
        return fitting._excess(b747, lambda c: built(b747, belief=belief, calibration=c), record._replace(obs=obs))

    assert np.trace(excess(record.obs)) > 0
    assert np.array_equal(excess(record.obs), excess(other))


def test_flights_of_a_fit_are_validation_flights():
    assert fitting.VALIDATION_SEED == 2_000_000
    assert fitting.VALIDATION_SEED + fitting.FIRST + 100 < 3_000_000


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ({"R": [[1.0, 1e-21], [1e-21, 1.0]]}, {"R": [[1.0, 0.0], [3e-22, 1.0]]}, True),
        ({"R": [1.0, 2.0]}, {"R": [1.0, 2.0 + 1e-7]}, False),
        ({"R": [1.0, 2.0]}, {"R": [1.0, 2.0, 3.0]}, False),
        ({"names": ["a"]}, {"names": ["b"]}, False),
        ({"rise": 0.001}, {"rise": 0.0010001}, False),
        ({"rise": 1}, {"fall": 1}, False),
        ({"rise": True}, {"rise": 1}, False),
        ({"rise": None}, {"rise": 0.0}, False),
    ],
)
def test_what_is_the_same_to_rounding(one, other, same):
    assert alike(one, other) is same
    assert alike(one, one)


@pytest.mark.parametrize("kind", ["belief", "calibration", "conformity"])
def test_fits_are_renewed_where_the_code_gives_the_same(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(conforming, "EACH", 4)
    suite = load_suite("b747-standard")
    if kind == "conformity":
        suite = msgspec.structs.replace(suite, options={**suite.options, "unseen": True}, process="unseen")
    entry, path = find_diagnoser("conformal_bayes_bank" if kind == "conformity" else "augmented_ekf"), tmp_path / "fits.json"
    [(_, fits)] = knowledge.fit_suites([entry], [suite], 1).items()
    held = {"belief": fits.beliefs, "calibration": fits.calibrations, "conformity": fits.conformities}[kind]
    [key] = held
    write_fits(path, msgspec.structs.replace(fits, code="of another time"))
    assert knowledge.renewed(path, [entry], [suite], 1, 0).code == fits.code
    changed = {
        "belief": lambda b: msgspec.structs.replace(b, m_mean=b.m_mean + 1e-6),
        "calibration": lambda c: msgspec.structs.replace(c, thresholds={k: v + 1e-6 for k, v in c.thresholds.items()}),
        "conformity": lambda c: msgspec.structs.replace(c, scores={**c.scores, "none": [0.0]}),
    }[kind]
    held[key] = changed(held[key])
    write_fits(path, fits)
    with pytest.raises(ValueError, match=f"the {kind} .* is another now"):
        knowledge.renewed(path, [entry], [suite], 1, 0)
