"""The dedicated and the generalised scheme: which sensor is inconsistent with the others."""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import build, readings, states
from test_general_filters import belief_of

from baselines.filters.augmented_gaussian import gaussian_filter
from baselines.filters.observer_schemes import bank_filter, can_be_left_out, grouped, instant
from fdi_gym.diagnosis import NotApplicableError, make_diagnoser, run
from fdi_gym.diagnosis.fitting import flights_of
from fdi_gym.estimation.augmented import augmented

SCHEMES = ["generalised", "dedicated"]


def bank(plant, scheme, groups=None):
    belief = belief_of(plant)
    found = grouped(plant, augmented(plant, belief), belief.z_size, groups)
    bare = augmented(plant, belief, faults=False)
    return found, bare, bank_filter(plant, bare, found, scheme == "dedicated", (20, 80))


def recorded(plant, samples=200):
    return flights_of(plant, "standard", 410_000, 1, False)[1].obs[:, :samples]


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("plant_id", ["B747Lateral", "HUAVHover"])
def test_evidence_names_the_sensor_that_is_wrong(plant_id, scheme):
    """A bias of ten standard deviations, put into a healthy flight's record: every sensor in turn."""
    plant = build(plant_id)
    found, bare, filter = bank(plant, scheme)
    obs = np.repeat(recorded(plant), len(found.names), axis=0)
    for i, sensor in enumerate(bare.sensors):
        obs[i, 60:, sensor] += 10.0 * plant.outputs[sensor].sigma
    *_, r = readings(plant, filter, obs)
    right = r.signals["evidence"].argmax(axis=1) == np.arange(len(found.names))
    assert right.mean() >= (1.0 if scheme == "generalised" else 0.5), right
    assert (r.cost[:, 1] < -100).all()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_without_a_fault_no_sensor_is_suspected(b747, scheme):
    """What each observer adds is its excess over what noise makes: zero on average."""
    _, _, filter = bank(b747, scheme)
    obs = flights_of(b747, "standard", 411_000, 20, False)[1].obs[:, :300]
    found = np.mean([s.T[..., 0].mean(axis=0) for s in list(states(b747, filter, obs))[100:]], axis=0)
    assert np.abs(found).max() < 4.0 * np.sqrt(2 * 4 * 20 / 20)  # standard deviation of a sum, over as many flights


def test_the_observer_that_hears_all_is_the_healthy_filter(b747):
    _, bare, filter = bank(b747, "generalised")
    obs = recorded(b747)
    *_, a = readings(b747, filter, obs)
    *_, b = readings(b747, gaussian_filter(bare, "extended"), obs)
    assert np.allclose(a.x, b.x, atol=1e-12)


def test_an_observer_is_deaf_to_the_group_that_it_leaves_out(b747):
    """Any reading of that sensor leaves its observer's estimate as it is, to the bit; the others hear it."""
    _, _, filter = bank(b747, "generalised")
    obs = np.repeat(recorded(b747, 100), 2, axis=0)
    obs[1, 50:, 2] += 100.0
    *_, s = states(b747, filter, obs)
    assert np.array_equal(s.X[0, 3], s.X[1, 3])
    assert np.abs(s.X[0] - s.X[1]).max(axis=1)[[0, 1, 2, 4]].min() > 1e-3


def test_a_sensor_fault_of_the_plant_is_named_and_others_are_not():
    """The motor declares a fault of its speed sensor; its other faults are nobody's."""
    plant = build("DCMotor")
    found, *_ = bank(plant, "generalised")
    assert found.of_label.tolist() == [-1, -1, -1, 1]
    record = flights_of(plant, "standard", 400_000, 40, True)[1]
    said = run(make_diagnoser("generalised_observers", plant), record.obs)
    assert set(np.unique(said.label)) <= {0, 3}
    last = record.label[:, -1]
    assert (said.alarm[last == 3, -1]).mean() > 0.9
    assert (said.label[(last == 1) | (last == 2), -1] == 0).mean() > 0.7


def test_where_no_label_is_a_sensors_there_is_nothing_to_name(b747):
    with pytest.raises(
        NotApplicableError, match=r"no label of B747Lateral is a sensor's fault; with the option sensor_faults"
    ):
        make_diagnoser("generalised_observers", b747)
    make_diagnoser("generalised_observers", build("B747Lateral", sensor_faults=True), process="mixed")


def test_dedicated_sums_leave_out_all_pairs_of_the_group():
    """Written out as loops."""
    rng, m = np.random.default_rng(0), 4
    members = np.eye(m, dtype=bool)
    hears = np.concatenate([np.ones((1, m), bool), members])
    nu, S = rng.standard_normal((1, 5, m)), np.tile(np.diag([1.0, 2, 3, 4]), (1, 5, 1, 1))
    found, _ = instant(hears, members, True, nu, S, np.ones((1, m), bool))
    for g in (None, 0, 1, 2, 3):
        others = [i for i in range(m) if i != g]
        total = sum(
            nu[0, 1 + i, j] ** 2 / S[0, 0, j, j] - 1
            for i in others for j in others if i != j
        )  # fmt: skip
        count = (m - 1) if g is None else (m - 2)
        assert found[0, 0 if g is None else 1 + g] == pytest.approx(total / count)


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"scheme": "both"}, "unknown scheme"),
        ({"groups": [["beta"], ["alpha"]]}, "groups are made of"),
        ({"groups": [["beta", "p"], ["p"]]}, "groups are made of"),
        ({"paces": ()}, "paces"),
    ],
)
def test_bad_settings(b747, settings, error):
    with pytest.raises(ValueError, match=error):
        make_diagnoser("generalised_observers", b747, **settings)
    with pytest.raises(NotApplicableError, match="two groups"):
        make_diagnoser("generalised_observers", b747, groups=[["beta", "p", "r", "phi"]])


def test_a_sensor_is_needed_where_the_others_do_not_see_what_grows_whatever_the_units():
    """Two states that grow together: their difference says nothing of that, each of them does."""
    A, C, hears = np.array([[0.6, 0.5], [0.5, 0.6]]), np.array([[1.0, -1.0], [1.0, 0.0]]), ~np.eye(2, dtype=bool)
    plant = SimpleNamespace(trim_command=np.zeros(1), known=(), measured_disturbance=None)
    for scale in ([1.0, 1.0], [1.0, 2.0], [1e-3, 50.0]):
        model = SimpleNamespace(
            X0=np.zeros(2),
            scale=np.array(scale),
            jacobian_f=lambda X, at: (X, A[None]),
            jacobian_h=lambda X, at: (X, C[None]),
        )
        assert can_be_left_out(plant, model, hears).tolist() == [True, False]
