"""Faults at once: sets of modes as truth, as action, and as what a method tells."""

import functools

import gymnasium as gym
import numpy as np
import pytest
from conftest import PLANTS, build
from gymnasium.utils.env_checker import check_env

from baselines.filters.mode_pursuit import Lines
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.faults import Abrupt, Fault, draw
from fdi_gym.simultaneous import MOST, scores, told
from fdi_gym.suite import Suite


@functools.cache
def several(name="B747Lateral", **options):
    return load_plant(name, simultaneous=True, **options)


def two(plant):
    """Aileron and rudder at once, for which the plant has no label."""
    faults = [Fault("aileron LOE", "LOE", 20, [Abrupt("gamma_aileron", -0.8)], 60),
              Fault("rudder stuck", "", 40, [Abrupt("gamma_rudder", -1.0), Abrupt("b_rudder", 1.0)], 80)]  # fmt: skip
    return draw(plant.process("standard"), 1).replace(steps=100, faults=faults)


def test_a_set_without_a_label_has_a_number_and_flies_as_it_flew():
    plain, plant = build("B747Lateral"), several()
    with pytest.raises(ValueError, match="no label for"):
        simulate(plain, [two(plain)])
    record = simulate(plant, [two(plant)])
    sets = plant.modes_of(record.label[0])
    names = np.array(plant.mode_names)
    assert [set(names[sets[k]]) for k in (20, 21, 41, 61, 81)] == [
        set(), {"aileron LOE"}, {"aileron LOE", "rudder stuck"}, {"rudder stuck"}, set(),
    ]  # fmt: skip
    assert record.label[0, 50] >= len(plant.labels)
    both = build("B747Lateral", labels="dual")  # where that set has a label
    assert simulate(both, [two(both)]).obs.tobytes() == record.obs.tobytes()
    for label, of in enumerate(plant.labels):
        assert set(names[plant.modes_of(np.int64(label))]) == of.modes


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("sensor_faults", [False, True])
def test_the_process_draws_up_to_three_that_fit_together(name, sensor_faults):
    plant = several(name, sensor_faults=sensor_faults)
    drawn = [draw(plant.process("simultaneous"), seed) for seed in range(200)]
    counts = np.bincount([len(s.faults) for s in drawn], minlength=MOST + 1)
    assert counts[0] > 0
    assert counts[1] > 0
    assert counts[2] > 0
    for scenario in drawn:
        plant.validate(scenario)
        assert len({f.mode for f in scenario.faults}) == len(scenario.faults)


def test_the_task_and_its_reward():
    env = gym.make("B747Lateral-Faults-v0", simultaneous=True, task="modes", process="simultaneous")
    check_env(env.unwrapped, skip_render_check=True)
    plant = env.unwrapped.plant
    env = gym.make("B747Lateral-Faults-v0", simultaneous=True, task="modes", scenario=two(plant))
    _, info = env.reset()
    for bad in ([2, 0, 0, 0], [0, 0], "none", [0.5, 0, 0, 0], 1):
        with pytest.raises(ValueError, match="0 or 1 for each fault mode"):
            env.unwrapped.step(bad)
    rewards = []
    for k in range(100):
        answer = plant.modes_of(np.int64(info["label"])).astype(np.int8)
        answer[0] ^= k >= 50  # one of four wrong from then on
        _, reward, _, _, info = env.step(answer)
        rewards.append(reward)
    assert rewards == [0.0] + [1.0] * 49 + [0.75] * 50
    envs = gym.make_vec("B747Lateral-Faults-v0", num_envs=2, simultaneous=True, task="modes", process="simultaneous")
    envs.reset(seed=0)
    _, reward, *_ = envs.step(np.zeros((2, 4), np.int8))
    _, reward, *_ = envs.step(np.array([[0, 0, 0, 0], [1, 0, 0, 0]]))
    assert reward.tolist() == [1.0, 0.75]


@pytest.mark.parametrize("task", ["isolation", "diagnosis", "scenario"])
def test_tasks_that_need_a_label_are_refused(task):
    with pytest.raises(ValueError, match="no label says which: the task is one of modes, identification"):
        gym.make("B747Lateral-Faults-v0", simultaneous=True, task=task)
    with pytest.raises(ValueError, match="scored by"):
        Suite(name="s", description="", env="B747Lateral-Faults-v0", plant="B747Lateral", options={"simultaneous": True},
              process="simultaneous", mismatch=None, seeds=[1_000_000], settings={}).build()  # fmt: skip


def test_scores_of_the_truth_and_of_nothing():
    plant = several()
    record = simulate(plant, [draw(plant.process("simultaneous"), seed) for seed in range(20)])
    truth = plant.modes_of(record.label)
    best, none = scores(plant, record.label, record.length, truth), scores(plant, record.label, record.length, truth & False)
    assert best.exact == best.decisions == 1.0
    assert np.nan_to_num(best.f1, nan=1.0).tolist() == [1.0] * 4
    assert none.exact == pytest.approx((record.label[:, 1:] == 0).mean())
    assert np.nan_to_num(none.recall).tolist() == [0.0] * 4
    early = scores(plant, record.label, record.length, np.roll(truth, 1, axis=1))
    assert early.exact < 1.0
    assert scores(plant, record.label, record.length, np.roll(truth, 1, axis=1), grace=1).exact == 1.0


def test_a_sum_of_lines_is_taken_apart():
    """Any two modes of different surfaces, their magnitudes free, in a metric that is not the identity."""
    plant, rng = several(), np.random.default_rng(0)
    lines, threshold = Lines(plant), np.full(4, 9.0)
    A = rng.standard_normal((4, 4))
    information = 100 * (A @ A.T + np.eye(4))
    for i, j in ((0, 2), (0, 3), (1, 2), (1, 3)):
        z = sum(lines.offset[m] + lines.directions[m, 0] * v for m, v in ((i, -0.5), (j, -0.6)))
        gained, _ = lines.pursue(z[None], information[None], threshold)
        assert set(np.flatnonzero(gained[0])) == {i, j}
    assert not lines.pursue(np.zeros((1, 4)), information[None], threshold)[0].any()


def test_a_method_tells_sets():
    """Better than the label of one fault can be, on flights of which a third have two or three."""
    plant = several()
    scenarios = [draw(plant.process("simultaneous"), 4_700_000 + seed) for seed in range(60)]
    record = simulate(plant, scenarios)
    found = {}
    for name in ("mode_pursuit_ekf", "augmented_ekf"):
        said = run(make_diagnoser(name, plant, process="simultaneous"), record.obs, signals=True)
        found[name] = scores(plant, record.label, record.length, told(plant, said.label, said.signals))
    assert found["mode_pursuit_ekf"].decisions > found["augmented_ekf"].decisions + 0.1
    assert found["mode_pursuit_ekf"].decisions > 0.45
    healthy = simulate(plant, [s.without_faults() for s in scenarios])
    said = run(make_diagnoser("mode_pursuit_ekf", plant, process="simultaneous"), healthy.obs)
    assert said.alarm.any(axis=1).mean() <= 0.17
