"""The environments: rules of time and reward, replay, bad input, pictures."""

import json

import gymnasium as gym
import numpy as np
import pytest
from conftest import build

from fdi_gym.engine import simulate
from fdi_gym.envs import FDIEnv, FDIVectorEnv
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plants import b747_lateral as b747


def play(env, policy, seed=None):
    obs, info = env.reset(seed=seed)
    rows, rewards, infos, over = [obs], [], [info], False
    while not over:
        obs, reward, terminated, truncated, info = env.step(policy(info))
        rows.append(obs)
        rewards.append(reward)
        infos.append(info)
        over = terminated or truncated
    return np.array(rows), np.array(rewards), infos, (terminated, truncated)


def test_episode_is_the_recorded_flight(plant):
    env = FDIEnv(plant.id)
    rows, rewards, infos, ends = play(env, lambda info: 0, seed=12)
    record = simulate(plant, [draw(plant.process("standard"), 12)])
    length = int(record.length[0])
    assert np.array_equal(rows, record.obs[0, : length + 1])
    assert [i["label"] for i in infos] == record.label[0, : length + 1].tolist()
    assert ends == (bool(record.terminated[0]), not record.terminated[0])
    assert len(rewards) == length


def test_the_right_label_at_the_right_time_earns_all(b747):
    """The info shows the truth that the next action is compared with; the first action is worth nothing."""
    _, rewards, _, _ = play(FDIEnv("B747Lateral"), lambda info: info["label"], seed=2)
    assert rewards[0] == 0
    assert (rewards[1:] == 1).all()


def test_identification_reward(b747):
    env = FDIEnv("B747Lateral", task="identification")
    _, rewards, _, _ = play(env, lambda info: info["target"], seed=2)
    assert rewards == pytest.approx(0)
    env.reset(seed=2)
    env.step(np.zeros(4))
    _, reward, _, _, _ = env.step(np.array([-0.5, -0.25, 2.0, -1.0]))
    assert reward == pytest.approx(-(0.5**2 + 0.25**2 + 2.0**2 / 16 + 1.0**2 / 4))


def test_actions_beyond_the_box_are_clipped():
    env = FDIEnv("B747Lateral", task="identification")
    env.reset(seed=2)
    env.step(np.zeros(4))
    _, reward, _, _, _ = env.step(np.array([9.0, 9.0, 0.0, 0.0]))
    assert reward == 0


def test_decision_period_gives_blocks():
    one, block = FDIEnv("B747Lateral"), FDIEnv("B747Lateral", decision_period=50)
    rows, _, _, _ = play(one, lambda info: 0, seed=3)
    blocks, rewards, infos, _ = play(block, lambda info: info["label"], seed=3)
    assert blocks.shape == (25, 50, 6)
    assert np.array_equal(blocks[0], np.tile(rows[0], (50, 1)))
    assert np.array_equal(blocks[1:].reshape(-1, 6), rows[1:])
    assert infos[1]["time"] == pytest.approx(5.0)
    assert (rewards[1:] == 1).all()


def test_scaled_units():
    plain, scaled = FDIEnv("B747Lateral"), FDIEnv("B747Lateral", units="scaled", task="identification")
    a, _ = plain.reset(seed=1)
    b, _ = scaled.reset(seed=1)
    assert b.dtype == np.float32
    assert b == pytest.approx(a / [1, 2, 1, 5, 5, 2], rel=1e-6)
    # -1 and 1 are the bounds of the box
    scaled.step(np.zeros(4, np.float32))
    _, reward, _, _, _ = scaled.step(np.array([1, 1, 0, 0], np.float32))
    assert reward == pytest.approx(0)


def test_a_scenario_is_replayed_with_its_noise():
    first = FDIEnv("B747Lateral", process="hard")
    rows, _, _, _ = play(first, lambda info: 0, seed=9)
    text = first.scenario.to_json()
    for scenario in (text, FaultScenario.from_json(text)):
        again, _, _, _ = play(FDIEnv("B747Lateral", scenario=scenario), lambda info: 0, seed=77)
        assert np.array_equal(rows, again)
    other = FDIEnv("B747Lateral")
    obs, _ = other.reset(options={"scenario": first.scenario})
    assert np.array_equal(obs, rows[0])


def test_spec_survives_json():
    env = gym.make("B747Lateral-Faults-v0", variant="bare/closed", task="identification", mismatch=0.1)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    a, b = env.reset(seed=4)[0], again.reset(seed=4)[0]
    assert np.array_equal(a, b)
    assert json.loads(env.spec.to_json())["kwargs"]["mismatch"] == 0.1


def test_mismatch_changes_the_truth_and_not_the_model():
    a, b = FDIEnv("B747Lateral"), FDIEnv("B747Lateral", mismatch=0.1)
    first, second = play(a, lambda info: 0, seed=5)[0], play(b, lambda info: 0, seed=5)[0]
    assert a.scenario.faults == b.scenario.faults
    assert a.scenario.noise_seed == b.scenario.noise_seed
    assert not np.array_equal(first, second)
    assert np.array_equal(a.plant.nominal_p, b.plant.nominal_p)


BAD = [
    ({"task": "prediction"}, "isolation, identification"),
    ({"process": "easy"}, "standard"),
    ({"units": "furlongs"}, "physical, scaled"),
    ({"decision_period": 0}, "at least 1"),
    ({"render_mode": "ascii"}, "rgb_array"),
    ({"variant": "stretched"}, "printed/open"),
    ({"wings": 3}, "variant, labels"),
    ({"scenario": "{bad json"}, "not a FaultScenario"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[next(iter(a)) + str(i) for i, (a, _) in enumerate(BAD)])
@pytest.mark.parametrize("make", [FDIEnv, FDIVectorEnv])
def test_bad_arguments_say_what_is_allowed(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make("B747Lateral", **arguments)


@pytest.mark.parametrize("action", [-1, 5, 1.5, np.nan, np.zeros(2, int), "none", None])
def test_bad_labels_are_refused(action):
    env = FDIEnv("B747Lateral")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"0\.\.4"):
        env.step(action)


@pytest.mark.parametrize("action", [np.zeros(3), np.array([0, 0, 0, np.nan]), np.full(4, np.inf), 0])
def test_bad_estimates_are_refused(action):
    env = FDIEnv("B747Lateral", task="identification")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"finite and has the shape \(4,\)"):
        env.step(action)


def test_bad_batches_are_refused():
    env = FDIVectorEnv("B747Lateral", num_envs=3)
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(np.zeros(3, int))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(3,\)"):
        env.step(np.zeros(2, int))
    with pytest.raises(ValueError, match="at least one True"):
        env.reset(options={"reset_mask": np.zeros(3, bool)})
    with pytest.raises(ValueError, match="one seed per environment"):
        env.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="NextStep"):
        FDIVectorEnv("B747Lateral", num_envs=3, autoreset_mode="sometimes")
    with pytest.raises(ValueError, match="at least 1"):
        FDIVectorEnv("B747Lateral", num_envs=0)


def test_step_after_the_end_is_refused():
    env = FDIEnv("B747Lateral", scenario=draw(build("B747Lateral").process("standard"), 0).replace(steps=2))
    env.reset()
    env.step(0)
    env.step(0)
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(0)


def test_disabled_autoreset_names_the_ended():
    scenario = draw(build("B747Lateral").process("standard"), 0).replace(steps=2, faults=[])
    env = FDIVectorEnv("B747Lateral", num_envs=2, scenario=scenario, autoreset_mode="Disabled")
    env.reset(seed=0)
    for _ in range(2):
        env.step(np.zeros(2, int))
    with pytest.raises(RuntimeError, match=r"episodes \[0, 1\] are over"):
        env.step(np.zeros(2, int))


def test_mismatch_where_there_is_none():
    import dataclasses

    plant = dataclasses.replace(build("B747Lateral"), perturb=None)
    with pytest.raises(ValueError, match="declares no mismatch"):
        FDIEnv(plant, mismatch=0.1)


def test_episodes_of_the_process_differ_and_repeat():
    env = FDIEnv("B747Lateral")
    first = [env.reset(seed=3)[0], env.reset()[0], env.reset()[0]]
    again = [env.reset(seed=3)[0], env.reset()[0], env.reset()[0]]
    assert np.array_equal(first, again)
    assert not np.array_equal(first[1], first[2])


@pytest.mark.parametrize("task", ["isolation", "identification"])
def test_pictures(plant, task):
    env = FDIEnv(plant.id, task=task, render_mode="rgb_array")
    env.reset(seed=1)
    blank = env.render()
    for _ in range(30):
        env.step(0 if task == "isolation" else env.action_space.low)
    picture = env.render()
    assert picture.shape == blank.shape
    assert picture.dtype == np.uint8
    assert (picture != blank).mean() > 0.002
    env.close()
    many = FDIVectorEnv(plant.id, num_envs=2, task=task, render_mode="rgb_array")
    many.reset(seed=1)
    assert len(many.render()) == 2


def test_human_window(monkeypatch):
    import matplotlib

    matplotlib.use("agg")
    env = FDIEnv("B747Lateral", render_mode="human", scenario=b747.paper().replace(steps=5, faults=[]))
    env.reset(seed=0)
    for _ in range(3):
        env.step(0)
    env.close()
