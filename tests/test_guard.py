"""The guard checks what a diagnoser says: types and labels are refused by name, what cannot be makes the episode wrong."""

import numpy as np
import pytest
from conftest import PLANTS, build

from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnosers, guarded, make_diagnoser, run
from fdi_gym.diagnosis.contract import map_arrays
from fdi_gym.engine import simulate
from fdi_gym.faults import draw
from fdi_gym.metrics import outcome
from fdi_gym.scores import summarise

N, SAMPLES, BAD = 4, 30, 12  # episodes, samples, the sample from which on something is wrong with episode 1


def saying(plant, field, value, rows=(1,)):
    """A diagnoser whose diagnoses are right in form, but for a field of some episodes from sample BAD on."""

    def init(n):
        return np.zeros(n, int)

    def update(k, obs):
        n = len(obs)
        said = {
            "alarm": np.zeros(n, bool), "label": np.zeros(n, int), "estimate": np.zeros((n, len(plant.estimated))),
            "estimate_std": np.ones((n, len(plant.estimated))), "label_probs": np.eye(len(plant.labels))[np.zeros(n, int)],
            "state": np.zeros((n, len(plant.states))),
        }  # fmt: skip
        if k[0] >= BAD:
            whole = (
                said[field].astype(float)
                if said[field].dtype.kind != "b" and np.asarray(value).dtype.kind == "f"
                else said[field]
            )
            whole = whole.astype(np.result_type(whole, np.asarray(value)))
            whole[list(rows)] = value
            said[field] = whole
        return k + 1, Diagnosis(**said)

    return guarded(Diagnoser(init, update), plant)


def observed(plant):
    return np.tile(np.array([s.nominal for s in plant.observed]), (N, SAMPLES, 1))


@pytest.mark.parametrize(("field", "value", "says"), [
    ("label", 99, "labels in 0"), ("label", -2, "labels in 0"), ("label", -1, "labels in 0"),
    ("label", 65536, "labels in 0"), ("label", 2**40, "labels in 0"), ("label", 0.9, "integer"), ("label", 1.0, "integer"),
    ("alarm", 1, "bool"), ("alarm", 0.5, "bool"),
])  # fmt: skip
@pytest.mark.parametrize("plant_id", PLANTS)
def test_what_is_no_label_or_alarm_is_refused(plant_id, field, value, says):
    plant = build(plant_id)
    with pytest.raises(ValueError, match=says):
        run(saying(plant, field, value), observed(plant))


@pytest.mark.parametrize("wrong", [
    {"label": np.zeros(N, bool)}, {"label": np.zeros((N, 1), int)}, {"label": np.zeros(N + 1, int)}, {"label": ["a"] * N},
    {"alarm": np.zeros((N, 2), bool)}, {"estimate": np.zeros((N, 99))}, {"estimate": np.zeros(N)},
    {"estimate": np.full((N, 4), "x")}, {"label_probs": np.zeros((N, 2))}, {"state": np.zeros((N, 1))},
    {"estimate_std": np.zeros((N, 4), complex)},
])  # fmt: skip
def test_shapes_and_types_are_refused(b747, wrong):
    said = {"alarm": np.zeros(N, bool), "label": np.zeros(N, int)} | wrong
    with pytest.raises(ValueError, match="a diagnosis has"):
        run(guarded(Diagnoser(lambda n: (), lambda s, obs: (s, Diagnosis(**said))), b747), observed(b747))
    with pytest.raises(ValueError, match="returns"):
        run(guarded(Diagnoser(lambda n: (), lambda s, obs: (s, "no diagnosis")), b747), observed(b747))


IMPOSSIBLE = [
    ("label_probs", 5.0), ("label_probs", -0.1), ("label_probs", np.nan), ("label_probs", np.inf), ("label_probs", 0.0),
    ("estimate", np.nan), ("estimate", 1e150), ("estimate", -np.inf), ("estimate_std", -1.0), ("state", np.nan),
    ("state", 1e300),
]  # fmt: skip


@pytest.mark.parametrize(("field", "value"), IMPOSSIBLE)
@pytest.mark.parametrize("plant_id", PLANTS)
def test_what_cannot_be_counts_as_wrong_and_stays_alone(plant_id, field, value):
    """Episode 1 is lost from there to its end, with no alarm, no estimate and no probability; the others notice nothing."""
    plant = build(plant_id)
    said = run(saying(plant, field, value), observed(plant))
    assert (said.label[1, BAD:] == -1).all()
    assert not said.alarm[1, BAD:].any()
    assert np.isnan(said.estimate[1, BAD:]).all()
    assert (said.label_probs[1, BAD:] == 0).all()
    assert (said.label[1, :BAD] == 0).all()
    rest = [0, 2, 3]
    assert (said.label[rest] == 0).all()
    assert np.isfinite(said.estimate[rest]).all()


@pytest.mark.parametrize(("field", "value"), IMPOSSIBLE)
def test_scores_stay_in_their_range(b747, field, value):
    """A score never gains by a diagnosis that cannot be: the lost samples are wrong ones, with the least log score."""
    scenarios = [draw(b747.process("standard"), 60_000 + i).replace(steps=SAMPLES - 1, faults=[]) for i in range(N)]
    record = simulate(b747, scenarios)
    scoring = b747.process("standard").scoring
    entries = [s.name for s in b747.estimated]

    def scores(diagnoser):
        said = run(diagnoser, record.obs)
        found = [outcome(b747, scoring, record, said, i) for i in range(N)]
        return summarise(found, len(b747.labels), entries, b747.dt)

    good, bad = scores(saying(b747, "label", 0)), scores(saying(b747, field, value))
    assert good["log_score"] == pytest.approx(0.0)
    assert bad["log_score"] < -1.0
    assert bad["lost_episodes"] == 1
    assert bad["per_sample"]["accuracy"] == pytest.approx(1 - (SAMPLES - BAD) / (N * (SAMPLES - 1)))
    assert all(
        np.isfinite(v) and v < 1e3 for phase in bad["identification"]["rmse"].values() if phase for v in phase.values()
    )


@pytest.mark.parametrize("plant_id", PLANTS)
def test_an_empty_batch_is_an_empty_answer(plant_id):
    plant = build(plant_id)
    for name in ("null", "random"):
        said = run(make_diagnoser(name, plant), np.zeros((0, 5, len(plant.observed))))
        assert said.label.shape == (0, 5)
    with pytest.raises(ValueError, match="at least 0"):
        make_diagnoser("null", plant).init(-1)
    with pytest.raises(ValueError, match="shape"):
        run(make_diagnoser("null", plant), np.zeros((2, 5, len(plant.observed) + 1)))


def test_a_batch_that_fails_is_done_one_by_one(b747):
    """A singular matrix in one episode: that one is lost, the others get what they would have got alone."""

    def update(state, obs):
        k, total = state
        if (obs[:, 0] > 9).any():
            raise np.linalg.LinAlgError("Singular matrix")
        total = total + obs[:, :4] * k
        return (k + 1, total), Diagnosis(total[:, 0] > 3, (total[:, 0] > 3).astype(int), total)

    raw = Diagnoser(lambda n: (0, np.zeros((n, 4))), update)
    obs = np.random.default_rng(0).random((N, SAMPLES, 6))
    hurt = obs.copy()
    hurt[0, BAD, 0] = 10.0  # the first one: the batch's shared counter must come from another
    whole, said = run(guarded(raw, b747), obs), run(guarded(raw, b747), hurt)
    assert (said.label[0, BAD:] == -1).all()
    for field in ("label", "estimate", "alarm"):
        assert np.array_equal(getattr(said, field)[1:], getattr(whole, field)[1:]), field
        assert np.array_equal(getattr(said, field)[0, :BAD], getattr(whole, field)[0, :BAD]), field


def test_methods_without_gaps_are_held_and_say_so(b747):
    """What was said stands through a sample with something missing; the method is not shown it."""
    shown = []

    def update(state, obs):
        shown.append(obs.copy())
        assert np.isfinite(obs).all()
        return state + 1, Diagnosis(state > 3, (state > 3).astype(int), obs[:, :4])

    obs = np.random.default_rng(1).random((N, 8, 6))
    obs[2, 4, 1] = np.nan
    said = run(guarded(Diagnoser(lambda n: np.zeros(n, int), update), b747), obs)
    assert np.array_equal(said.estimate[2, 4], said.estimate[2, 3])
    assert said.label[2].tolist() == [0, 0, 0, 0, 0, 1, 1, 1]  # its own counter has stood still
    assert said.label[0].tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    gaps = {name for name, entry in diagnosers().items() if not entry.clairvoyant and entry.takes("calibration")}
    assert all(make_diagnoser(name, b747).gaps for name in gaps & {"augmented_ekf", "glr_ekf"})


def test_states_are_mapped_as_nests():
    nest = {"a": (np.arange(3), [np.ones((3, 2)), 7]), "b": "word"}
    doubled = map_arrays(lambda a: 2 * a, nest)
    assert np.array_equal(doubled["a"][0], [0, 2, 4])
    assert doubled["a"][1][1] == 7
    assert doubled["b"] == "word"
