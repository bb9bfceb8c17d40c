"""The tasks beyond label and estimate: both in one action, and the whole scenario at the end; also for a learner."""

import numpy as np
import pytest

from fdi_gym.declaration import true_declaration
from fdi_gym.engine import simulate
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import draw
from fdi_gym.tasks import TASKS
from fdi_gym.vector_envs import FDIVectorEnv


@pytest.mark.parametrize("units", ["physical", "scaled"])
def test_a_diagnosis_is_worth_its_label_and_its_estimate(plant, units):
    env, rng = FDIEnv(plant, task="diagnosis", units=units), np.random.default_rng(3)
    label_only, estimate_only = FDIEnv(plant), FDIEnv(plant, task="identification", units=units)
    for e in (env, label_only, estimate_only):
        e.reset(seed=5)
    labels = len(plant.labels)
    for _ in range(60):
        estimate = estimate_only.action_space.sample()
        said = int(rng.integers(labels))
        scores = rng.uniform(0.0, 0.4, labels)
        scores[said] = 0.9
        action = np.concatenate([scores, estimate]).astype(env.action_space.dtype)
        assert env.action_space.contains(action)
        together = env.step(action)[1]
        assert together == pytest.approx(label_only.step(said)[1] + estimate_only.step(estimate)[1], abs=1e-9)


@pytest.mark.parametrize("units", ["physical", "scaled"])
def test_the_truth_declared_last_is_worth_one_and_all_before_is_worth_nothing(plant, units):
    scenario = draw(plant.process("standard"), 11)
    env = FDIEnv(plant, task="scenario", units=units, scenario=scenario, decision_period=50)
    record = simulate(plant, [scenario])
    truth = true_declaration(plant, record)
    task = TASKS["scenario"](plant, units == "scaled")
    right = task.action(truth, record.length)[0]
    assert env.action_space.contains(right)
    wrong = truth.copy()
    wrong[0, 0, 0] = 1.0 - wrong[0, 0, 0]
    for last, reward in ((right, 1.0), (task.action(wrong, record.length)[0], 0.0)):
        env.reset(seed=0)
        over, rewards = False, []
        while not over:
            _, r, terminated, truncated, _ = env.step(last)
            over = terminated or truncated
            rewards.append(r)
        assert rewards[:-1] == [0.0] * (len(rewards) - 1)
        assert rewards[-1] == pytest.approx(reward, abs=1e-5)


@pytest.mark.parametrize("task", ["diagnosis", "scenario"])
def test_what_is_no_answer_is_refused_and_nothing_has_happened(b747, task):
    env = FDIVectorEnv(b747, num_envs=2, task=task)
    before, _ = env.reset(seed=1)
    size = env.single_action_space.shape[0]
    for action in (
        0,
        np.zeros((2, size + 1)),
        np.full((2, size), np.nan),
        np.zeros((2, size), bool),
        "label",
        [[0.0] * size],
    ):
        with pytest.raises(ValueError, match="the action is"):
            env.step(action)
    after = FDIVectorEnv(b747, num_envs=2, task=task)
    after.reset(seed=1)
    assert np.array_equal(env.step(np.zeros((2, size)))[0], after.step(np.zeros((2, size)))[0])
    assert before.shape[0] == 2


@pytest.mark.parametrize("task", ["diagnosis", "scenario"])
def test_a_policy_learns_to_answer(task):
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    from fdi_gym.sb3 import make_vec_env

    venv = VecMonitor(make_vec_env("B747Lateral-Faults-v0", 8, task=task, units="scaled", decision_period=100))
    model = PPO("MlpPolicy", venv, n_steps=16, batch_size=64, n_epochs=1, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(256)
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))
    action, _ = model.predict(venv.reset())
    assert action.shape == (8, *venv.action_space.shape)
    assert np.isfinite(venv.step(action)[1]).all()
