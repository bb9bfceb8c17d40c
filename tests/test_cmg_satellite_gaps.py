"""The satellite's filters where sensors are missing: textbook rows removed, predictions, quiet and accurate through gaps."""

import functools

import numpy as np
import pytest

from baselines.filters.covariance_adaptation import BETA_0
from baselines.filters.mekf import observation
from fdi_gym.diagnosis import find_diagnoser, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.sigma_points import covariance, mean_and_deviations, unscented_points, weights
from fdi_gym.faults import FaultScenario
from fdi_gym.plants import cmg_satellite as cmg

UKFS = ("joint_ukf", "dual_ukf", "caukf", "gaukf", "sgaukf", "sgaukf_odd", "dual_caukf", "dual_gaukf", "dual_sgaukf",
        "dual_sgaukf_odd")  # fmt: skip
METHODS = (*UKFS, "mekf")
SOME = ("joint_ukf", "dual_ukf", "caukf", "sgaukf", "dual_gaukf", "mekf")  # each search and each form
PLANT = load_plant(cmg.ID)
R = PLANT.R[:10, :10]


@functools.cache
def flights(count, steps, faulty):
    onset = 3 * steps // 10
    faults = [cmg.loss(0, 0.4, onset, steps), cmg.loss(2, 0.7, onset, steps)] if faulty else []
    scenarios = [FaultScenario(plant=cmg.ID, steps=steps, faults=faults, noise_seed=70 + i) for i in range(count)]
    return simulate(PLANT, scenarios)


def filter_of(name):
    entry = find_diagnoser(name)
    return entry.build(PLANT, **entry.settings).filter


def interval(obs, k):
    _, u, known = PLANT.split(obs[:, k])
    return Interval(np.full(len(obs), k), u, None, known)


def followed(filter, obs, samples):
    """The filter's state after so many whole samples, and the interval and the measurement of the next."""
    s, seen = filter.start(len(obs)), np.ones((len(obs), 11), bool)
    for k in range(samples):
        s = filter.predict(s, interval(obs, k)) if k else s
        s = filter.update(s, interval(obs, k), obs[:, k, :11], seen)
    at = interval(obs, samples)
    return s, filter.predict(s, at), at, obs[:, samples, :11]


def rows_removed(x, P, nu, cross, S, seen):
    """The textbook's update of one episode with the sensors that are there, and no others."""
    C, K = cross[:, seen], cross[:, seen] @ np.linalg.inv(S[np.ix_(seen, seen)])
    return x + K @ nu[seen], P - K @ C.T


def patterns(count, width):
    seen = np.random.default_rng(4).random((count, width)) < 0.6
    seen[0], seen[1] = True, False
    return seen


def near(found, expected, P):
    """Equal within a millionth of the standard deviations."""
    s = np.sqrt(np.diag(P))
    assert np.abs((found[0] - expected[0]) / s).max() < 1e-6
    assert np.abs((found[1] - expected[1]) / np.outer(s, s)).max() < 1e-6


def test_joint_update_is_the_textbooks_with_the_missing_rows_removed():
    filter = filter_of("joint_ukf")
    _, ahead, at, y = followed(filter, flights(12, 60, False).obs, 50)
    seen = patterns(12, 11)
    after = filter.update(ahead, at, np.where(seen, y, 0.0), seen).now
    for i in range(12):
        x, P = ahead.now.x[i], ahead.now.P[i]
        expected = rows_removed(x, P, y[i, :10] - x[:10], P[:, :10], P[:10, :10] + R, seen[i, :10])
        near((after.x[i], after.P[i]), expected, P)


def test_dual_updates_are_the_textbooks_with_the_missing_rows_removed():
    filter = filter_of("dual_ukf")
    _, ahead, at, y = followed(filter, flights(12, 60, False).obs, 50)
    seen = patterns(12, 11)
    after = filter.update(ahead, at, np.where(seen, y, 0.0), seen)

    def seen_through(f):
        x = np.repeat(ahead.before.x[:, None], f.shape[1], axis=1)
        q4 = np.sqrt(1.0 - (x[..., :3] ** 2).sum(axis=-1, keepdims=True))
        moved = PLANT.propagate(0.0, np.concatenate([x[..., :3], q4, x[..., 3:]], axis=-1), at.u, f)
        return np.delete(moved, 3, axis=-1)

    points, w = unscented_points(ahead.f, ahead.P_f), weights(4)
    mean, deviations = mean_and_deviations(seen_through(points), w)
    cross, spread = covariance(points - ahead.f[:, None], deviations, w), covariance(deviations, deviations, w)
    for i in range(12):
        x, P, there = ahead.now.x[i], ahead.now.P[i], seen[i, :10]
        near((after.now.x[i], after.now.P[i]), rows_removed(x, P, y[i, :10] - x, P, P + R, there), P)
        expected = rows_removed(ahead.f[i], ahead.P_f[i], y[i, :10] - mean[i], cross[i], spread[i] + P + R, there)
        near((after.f[i], after.P_f[i]), expected, ahead.P_f[i])


def test_multiplicative_update_is_the_textbooks_with_the_missing_rows_removed():
    filter = filter_of("mekf")
    _, ahead, at, y = followed(filter, flights(12, 60, False).obs, 50)
    seen = patterns(12, 11)
    after = filter.update(ahead, at, np.where(seen, y, 0.0), seen)
    H = observation(ahead.q)
    for i in range(12):
        x, P = np.concatenate([np.zeros(3), ahead.w[i], ahead.f[i]]), ahead.P[i]
        nu = y[i, :6] - np.concatenate([ahead.q[i, :3], ahead.w[i]])
        found = rows_removed(x, P, nu, P @ H[i].T, H[i] @ P @ H[i].T + R[:6, :6], seen[i, :6])
        v, q4, t = ahead.q[i, :3], ahead.q[i, 3], found[0][:3]
        turned = np.array([*(v + 0.5 * (q4 * t + np.cross(v, t))), q4 - 0.5 * v @ t])
        np.testing.assert_allclose(after.q[i], turned / np.linalg.norm(turned), atol=1e-12)
        mine = np.concatenate([found[0][:3], after.w[i], after.f[i]])
        near((mine, after.P[i]), found, P)
        gain = np.where(seen[i, 6:10], 1.0 / 51, 0.0)
        np.testing.assert_allclose(after.d[i], ahead.d[i] + gain * (y[i, 6:10] - ahead.d[i]), atol=1e-15)


@pytest.mark.parametrize("name", METHODS)
def test_all_sensors_missing_is_prediction(name):
    """Nothing moves, the flag and its statistic neither; where the flag is up the covariance is not searched."""
    filter = filter_of(name)
    _, ahead, at, _ = followed(filter, flights(3, 60, False).obs, 55)
    if name != "mekf":
        ahead = ahead._replace(flag=ahead.flag._replace(beta=np.full(3, 2 * BETA_0)))
    after = filter.update(ahead, at, np.zeros((3, 11)), np.zeros((3, 11), bool))
    before, now = filter.read(ahead), filter.read(after)
    for field in ("z", "P", "x"):
        np.testing.assert_allclose(getattr(now, field), getattr(before, field), rtol=1e-12, atol=1e-18)
    for count in ("adapted", "resets", "statistic"):
        if count in now.signals:
            np.testing.assert_array_equal(now.signals[count], before.signals[count])


@pytest.mark.parametrize("name", METHODS)
def test_what_stands_in_the_place_of_a_missing_sensor_is_not_used(name):
    """Also by the searches, in whose candidates the missing rows are removed too."""
    filter = filter_of(name)
    _, ahead, at, y = followed(filter, flights(8, 60, True).obs, 55)
    if name != "mekf":
        ahead = ahead._replace(flag=ahead.flag._replace(beta=np.full(8, 3 * BETA_0)))
    seen = patterns(8, 11)
    clean, rubbish = (filter.update(ahead, at, np.where(seen, y, value), seen) for value in (0.0, 7.7))
    if "adapted" in filter.read(clean).signals and name not in ("joint_ukf", "dual_ukf"):
        assert (filter.read(clean).signals["adapted"] > 0).sum() >= 6
    for field in ("z", "P", "x"):
        np.testing.assert_array_equal(getattr(filter.read(clean), field), getattr(filter.read(rubbish), field))


# -- whole flights


def with_gaps(obs):
    """The flights under each pattern of missing samples, one pattern after the other: {name: obs}."""
    found = {"none": obs}
    for length in (1, 5, 10, 20, 40):
        gap = obs.copy()
        gap[:, 100 : 100 + length, :11] = np.nan
        found[f"{length} samples"] = gap
    for j, name in ((1, "q2"), (4, "w2"), (8, "d3"), (10, "sign")):
        gap = obs.copy()
        gap[:, ::7, j] = np.nan
        found[f"{name} every seventh"] = gap
    for columns, name in (([0, 1, 2], "q_v"), ([10], "sign"), ([3, 4, 5], "w"), ([8], "d3")):
        gap = obs.copy()
        gap[:, 120:260, columns] = np.nan
        found[f"{name} for a while"] = gap
    for columns, name in ((range(22), "all"), ([1], "q2"), ([10], "sign")):
        gap = obs.copy()
        gap[:, 0, list(columns)] = np.nan
        found[f"{name} at sample 0"] = gap
    gap = obs.copy()
    gap[:, :, 8] = np.nan
    found["d3 always"] = gap
    return found


def check_gaps(name, count, steps):
    healthy, faulty = flights(count, steps, False), flights(count, steps, True)
    gaps, faulty_gaps = with_gaps(healthy.obs), with_gaps(faulty.obs)
    diagnoser = make_diagnoser(name, PLANT)
    quiet = run(diagnoser, np.concatenate(list(gaps.values())))
    found = run(diagnoser, np.concatenate(list(faulty_gaps.values())))
    alarms = quiet.alarm.reshape(len(gaps), count, -1).any(axis=2).mean(axis=1)
    late = slice(-steps // 10, None)
    theta, label = (np.concatenate([truth[:, late]] * len(gaps)) for truth in (faulty.theta, faulty.label))
    error = np.abs(found.estimate[:, late] - theta).reshape(len(gaps), -1).mean(axis=1)
    right = (found.label[:, late] == label).reshape(len(gaps), -1).mean(axis=1)
    for i, pattern in enumerate(gaps):
        assert alarms[i] <= alarms[0], (
            f"{pattern}: {alarms[i]:.0%} of the healthy flights have an alarm, {alarms[0]:.0%} without"
        )
        assert right[i] >= right[0] - 0.05, f"{pattern}: {right[i]:.0%} of the labels are right, {right[0]:.0%} without"
        if "always" not in pattern:  # an angle that nobody measures costs what it tells
            assert error[i] <= 1.3 * error[0] + 0.01, f"{pattern}: error {error[i]:.4f}, {error[0]:.4f} without"
    assert np.isfinite(quiet.state).all()
    spread = np.abs(quiet.state[:, 30:] - np.tile(healthy.state[:, 30:], (len(gaps), 1, 1)))
    assert spread[..., :7].max() < 0.02


@pytest.mark.parametrize("name", SOME)
def test_gaps_raise_no_alarm_and_cost_no_accuracy(name):
    check_gaps(name, 2, 500)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_gaps_raise_no_alarm_and_cost_no_accuracy_in_many_flights(name):
    check_gaps(name, 30, 2500)


@pytest.mark.parametrize("name", METHODS)
def test_gaps_of_one_episode_are_its_own(name):
    obs = flights(3, 120, True).obs
    gap = obs.copy()
    gap[1, ::3, :11], gap[1, 10:30] = np.nan, np.nan
    gap[1, :4, 2] = np.nan
    with_gap, without = (run(make_diagnoser(name, PLANT), o) for o in (gap, obs))
    for i in (0, 2):
        np.testing.assert_array_equal(with_gap.estimate[i], without.estimate[i])
        np.testing.assert_array_equal(with_gap.alarm[i], without.alarm[i])
    alone = run(make_diagnoser(name, PLANT), gap[1:2])
    np.testing.assert_array_equal(alone.estimate[0], with_gap.estimate[1])


@pytest.mark.parametrize("name", METHODS)
def test_a_filter_begins_with_what_is_there(name):
    """Nothing at the first samples: as if the flight began where all sensors report."""
    obs = flights(3, 120, False).obs
    late = obs.copy()
    late[:, :5, :11] = np.nan
    first = run(make_diagnoser(name, PLANT), late)
    later = run(make_diagnoser(name, PLANT), obs[:, 5:])
    assert (first.label[:, :6] == 0).all()
    np.testing.assert_allclose(first.estimate[:, 5:], later.estimate, atol=1e-7)
    np.testing.assert_allclose(first.state[:, 5:], later.state, atol=1e-9)
