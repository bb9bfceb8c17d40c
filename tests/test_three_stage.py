"""The family of filters of state, fault and unknown disturbance on any plant: who can run it, and which one it is."""

import numpy as np
import pytest

from baselines.filters.augmented_gaussian import augmented_ekf
from baselines.filters.unknown_inputs import known_of
from fdi_gym.diagnosis import NotApplicableError, find_diagnoser, run
from fdi_gym.diagnosis.filtering import readings
from fdi_gym.diagnosis.fitting import fit_belief, flights_of
from fdi_gym.discovery import load_plant
from fdi_gym.estimation.calibration import Calibration

FAMILY = ("ascdkf", "three_stage_cdkf", "three_stage_ekf")


def build(name, plant, belief, calibration=None, **tuning):
    entry = find_diagnoser(name)
    return entry.build(plant, belief, calibration or Calibration(), **entry.resolve(plant, **tuning))


@pytest.mark.parametrize(("name", "plant_id", "reason"), [
    ("three_stage_cdkf", "CMGSatellite", "no unknown input"), ("three_stage_ekf", "MissilePitch", "y = H x"),
    ("ascdkf", "MissilePitch", "y = H x"), ("robust_three_stage_cdkf", "B747Lateral", r"rank H\[B E\] = 5 .* it is 3"),
    ("robust_three_stage_ekf", "CMGSatellite", r"rank H\[B E\] = 4 .* it is 0"),
])  # fmt: skip
def test_reasons_of_the_three_stage_family(name, plant_id, reason):
    plant = load_plant(plant_id)
    with pytest.raises(NotApplicableError, match=reason):
        build(name, plant, fit_belief(plant, "fault-free") if "rank" in reason else None)


@pytest.mark.parametrize("process", ["standard", "gust"])
def test_three_stage_family_is_the_general_augmented_filter_on_the_747(process):
    """With what is believed of the process, where that has a gust; without one it adds a disturbance as good as none.

    Any sensor may be missing.
    """
    plant = load_plant("B747Lateral")
    belief = fit_belief(plant, process)
    obs = flights_of(plant, process, 900_000, 2, True)[1].obs[:, :200].copy()
    obs[..., :4][np.random.default_rng(1).random(obs[..., :4].shape) < 0.2] = np.nan
    general = [r for r, _ in readings(plant, augmented_ekf(plant, belief, Calibration(), first_sample=False), obs)]
    std = np.array([np.sqrt(np.einsum("nii->ni", r.P)) for r in general]).swapaxes(0, 1)
    z = np.array([r.z for r in general]).swapaxes(0, 1)
    assert (std < 1.9 * belief.z_size).all(), "the walk's limit, which the family does not have"
    tolerance = 1e-6 if process == "gust" else 0.02
    for name in FAMILY:
        said = run(build(name, plant, belief), obs)
        assert (said.estimate - z) / std == pytest.approx(np.zeros_like(z), abs=tolerance), name
        assert said.estimate_std == pytest.approx(std, rel=tolerance), name


def test_channels_alarm_at_the_thresholds_of_the_calibration_unless_they_are_given():
    plant = load_plant("HUAVHover", kappa=0.5)  # none is shipped for it
    obs = flights_of(plant, "standard", 800_000, 2, False)[1].obs[:, :60]

    def alarms(channels, **tuning):
        return run(build("three_stage_cdkf", plant, None, Calibration(channels=channels), **tuning), obs).alarm.any()

    assert not alarms({})
    assert alarms({"ped": 1e-9})
    assert not alarms({"ped": 1e-9}, thresholds=[1.0] * 4)
    assert alarms({}, thresholds=[1e-9] * 4)


def test_tuning_of_the_paper_is_data_which_a_caller_overrides():
    entry, plant = find_diagnoser("ascdkf"), load_plant("HUAVHover")
    theirs = entry.resolve(plant)
    assert theirs["b_step"] == 7e-4
    assert theirs["thresholds"] == [2.684e-3, 0.792e-3, 0.617e-3, 11.449e-3]
    assert entry.resolve(plant, b_step=1.0) == {**theirs, "b_step": 1.0}
    assert entry.resolve(plant, channels=("lon", "lat", "ped"))["thresholds"] == [0.792e-3, 0.616e-3, 11.654e-3]
    assert "thresholds" not in entry.resolve(load_plant("HUAVHover", kappa=0.5))
    assert entry.resolve(load_plant("B747Lateral")) == {}


def test_what_nobody_gives_is_what_is_believed():
    plant = load_plant("B747Lateral")
    belief = fit_belief(plant, "gust")
    known = known_of(plant, belief, None, {})
    assert np.array_equal(known.Q, belief.Q)
    assert np.diag(known.P0b) == pytest.approx((0.1 * belief.z_size) ** 2)
    assert np.diag(known.Qd)[belief.disturbances] == pytest.approx(belief.d_walk**2)
    given = {"x0_std": [1.0] * 4, "b0_std": 2.0, "b_step": 3.0, "d0_std": 4.0, "d_step": 5.0}
    assert np.array_equal(known_of(plant, belief, None, given).Q, plant.Q)
    assert np.diag(known_of(plant, belief, None, {**given, "b_step": None}).P0b) == pytest.approx(4.0)
    with pytest.raises(ValueError, match="not one of HUAVHover"):
        known_of(load_plant("HUAVHover"), belief, None, {})
