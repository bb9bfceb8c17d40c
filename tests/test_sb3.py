"""The bridge to stable-baselines3 gives the numbers of DummyVecEnv; windows and rewards are those of a slow twin."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from conftest import build
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecNormalize

from baselines.learned.adapters import from_recurrent, from_sb3
from fdi_gym.diagnosis import run
from fdi_gym.engine import simulate
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import draw
from fdi_gym.sb3 import FDIVecEnv, make_vec_env
from fdi_gym.wrappers import DelayAwareReward, VectorHistory

N = 3
SHORT = {"decision_period": 200, "units": "scaled"}


def both(plant_id, **arguments):
    bridge = make_vec_env(f"{plant_id}-Faults-v0", N, **arguments)
    dummy = DummyVecEnv([lambda: FDIEnv(plant_id, **arguments) for _ in range(N)])
    for venv in (bridge, dummy):
        venv.seed(7)
    return bridge, dummy


@pytest.mark.parametrize("task", ["isolation", "identification"])
@pytest.mark.parametrize("plant_id", ["B747Lateral", "HUAVHover"])
def test_equals_dummy_vec_env_over_ends_of_episodes(plant_id, task):
    """HUAVHover ends early where it diverges: terminations and truncations both occur."""
    bridge, dummy = both(plant_id, task=task, **SHORT)
    rng, ends = np.random.default_rng(0), []
    assert np.array_equal(bridge.reset(), dummy.reset())
    for _ in range(150):
        actions = np.array([bridge.action_space.sample() for _ in range(N)])
        actions = rng.integers(5, size=N) if task == "isolation" else actions
        for venv in (bridge, dummy):
            venv.step_async(actions)
        (obs, rewards, dones, infos), (obs_, rewards_, dones_, infos_) = bridge.step_wait(), dummy.step_wait()
        assert obs.dtype == obs_.dtype
        assert rewards.dtype == rewards_.dtype
        assert np.array_equal(obs, obs_)
        assert np.array_equal(rewards, rewards_)
        assert np.array_equal(dones, dones_)
        for i in np.flatnonzero(dones):
            assert np.array_equal(infos[i]["terminal_observation"], infos_[i]["terminal_observation"])
            assert infos[i]["TimeLimit.truncated"] == infos_[i]["TimeLimit.truncated"]
            assert infos[i]["label"] == infos_[i]["label"]
            ends.append(infos[i]["TimeLimit.truncated"])
        running = np.flatnonzero(~dones)
        assert all(bridge.truth["label"][i] == infos_[i]["label"] for i in running)
    assert len(ends) > 2 * N
    assert plant_id != "HUAVHover" or set(ends) == {True, False}


def test_attributes_and_methods_are_those_of_the_single_environments():
    bridge, dummy = both("B747Lateral", render_mode="rgb_array", **SHORT)
    bridge.reset(), dummy.reset()
    assert bridge.get_attr("scenario") == dummy.get_attr("scenario")
    assert bridge.get_attr("render_mode", [1]) == ["rgb_array"]
    assert bridge.get_attr("observation_space") == dummy.get_attr("observation_space")
    assert bridge.env_method("get_wrapper_attr", "scenario", indices=[2]) == dummy.get_attr("scenario", [2])
    assert [a.shape for a in bridge.env_method("render", indices=[0, 1])] == [a.shape for a in dummy.get_images()[:2]]
    assert bridge.render().shape == dummy.render().shape
    assert bridge.has_attr("plant")
    assert not bridge.has_attr("no_such_thing")
    bridge.set_attr("note", 3)
    assert bridge.get_attr("note") == [3] * N
    with pytest.raises(ValueError, match="share"):
        bridge.set_attr("note", 4, indices=[0])
    assert bridge.env_is_wrapped(VectorHistory) == [False] * N
    bridge.close()


def test_environments_share_the_options_of_a_reset():
    bridge, _ = both("B747Lateral", **SHORT)
    with pytest.raises(ValueError, match="share the options"):
        bridge.set_options([{"a": 1}, {}, {}])


def test_needs_the_autoreset_of_sb3():
    with pytest.raises(ValueError, match="SameStep"):
        FDIVecEnv(gym.make_vec("B747Lateral-Faults-v0", num_envs=2))


def test_sb3_trains_normalises_and_evaluates():
    venv = VecNormalize(VecMonitor(VecCheckNan(make_vec_env("B747Lateral-Faults-v0", 8, seed=3, **SHORT))))
    model = PPO("MlpPolicy", venv, n_steps=16, batch_size=64, n_epochs=1, seed=0, device="cpu").learn(256)
    assert len(model.ep_info_buffer) > 0
    assert model.ep_info_buffer[0]["l"] == 6
    again = make_vec_env("B747Lateral-Faults-v0", 8, seed=3, **SHORT)
    plain = DummyVecEnv([lambda: FDIEnv("B747Lateral", **SHORT) for _ in range(8)])
    plain.seed(3)
    scores = [evaluate_policy(model, VecMonitor(v), n_eval_episodes=16, warn=False) for v in (again, plain)]
    assert scores[0] == pytest.approx(scores[1])


# ---------------------------------------------------------------------------------------------------------------
# Diagnosers with a memory


def flown(seeds=range(3_000_000, 3_000_004), samples=241):
    plant = build("B747Lateral")
    return plant, simulate(plant, [draw(plant.process("standard"), seed) for seed in seeds]).obs[:, :samples]


def test_scaled_units_are_the_plants_scale(plant):
    env = gym.make(plant.env_id, units="scaled").unwrapped
    seen, _ = env.reset(seed=5)
    raw, _ = gym.make(plant.env_id).reset(seed=5)
    assert np.array_equal(seen, plant.scale(raw).astype(np.float32))
    assert np.allclose(plant.unscale(plant.scale(raw)), raw, rtol=1e-12)
    assert np.array_equal(plant.unscale(np.zeros(len(raw))), [s.nominal for s in plant.observed])


@pytest.mark.parametrize("task", ["isolation", "identification"])
def test_a_recurrent_policy_says_what_it_says_in_its_environment(task):
    contrib = pytest.importorskip("sb3_contrib")
    plant, obs = flown()
    venv = make_vec_env("B747Lateral-Faults-v0", 4, units="scaled", decision_period=20, task=task, seed=3_000_000)
    model = contrib.RecurrentPPO("MlpLstmPolicy", venv, n_steps=8, batch_size=16, n_epochs=1, seed=0, device="cpu",
                                 policy_kwargs={"lstm_hidden_size": 16, "n_lstm_layers": 2})  # fmt: skip
    model.learn(64)
    said = run(from_sb3(model.policy, plant, task=task, decision_period=20), obs)
    shown, memory = venv.reset(), None
    venv.seed(3_000_000)
    shown = venv.reset()
    for k in range(12):
        action, memory = model.predict(shown, memory, np.full(4, k == 0), deterministic=True)
        at = 20 * k
        if task == "isolation":
            assert np.array_equal(action, said.label[:, at])
        else:
            low, high = (np.array([getattr(s, name) for s in plant.estimated]) for name in ("low", "high"))
            assert np.allclose(low + (high - low) * (action + 1) / 2, said.estimate[:, at], atol=1e-5)
        shown, *_ = venv.step(action)
    first = run(from_sb3(model.policy, plant, task=task, decision_period=20), obs[:, 200:])
    answer = "label_probs" if task == "isolation" else "estimate"
    assert not np.allclose(getattr(first, answer)[:, 0], getattr(said, answer)[:, 200])  # it remembers


def test_a_module_with_a_state_streams_what_it_says_of_the_whole_flight():
    import torch

    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gru, self.head = torch.nn.GRU(6, 12), torch.nn.Linear(12, 5)

        def forward(self, obs, state):
            found, state = self.gru(obs[None], state)
            return self.head(found[0]), state

    plant, obs = flown(samples=50)
    torch.manual_seed(0)
    module = Net()
    diagnoser = from_recurrent(module, plant, dtype=torch.float64)
    said = run(diagnoser, obs)
    with torch.inference_mode():
        whole = torch.from_numpy(plant.scale(obs).astype(np.float32).astype(float)).swapaxes(0, 1)
        logits = module.head(module.gru(whole)[0]).swapaxes(0, 1).numpy()
    odds = np.exp(logits)
    assert np.allclose(said.label_probs, odds / odds.sum(axis=2, keepdims=True), rtol=1e-9)
    assert np.ptp(said.label_probs, axis=1).max() > 1e-3
    state = diagnoser.init(len(obs))
    once, twice = (diagnoser.update(diagnoser.update(state, obs[:, 0])[0], obs[:, 1])[1] for _ in range(2))
    assert np.array_equal(once.label_probs, twice.label_probs)  # a state is a value


def test_a_policy_without_a_distribution_is_refused():
    from stable_baselines3 import DQN

    venv = make_vec_env("B747Lateral-Faults-v0", 1, units="scaled", decision_period=200)
    with pytest.raises(TypeError, match="actor-critic"):
        from_sb3(DQN("MlpPolicy", venv, buffer_size=10, device="cpu").policy, build("B747Lateral"))


# ---------------------------------------------------------------------------------------------------------------
# Windows and rewards


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda m: m.value)
@pytest.mark.parametrize(("length", "stride"), [(1, 1), (4, 1), (3, 5)])
def test_window_is_that_of_a_list_of_samples(mode, length, stride):
    arguments = {"num_envs": N, "decision_period": 100, "autoreset_mode": mode}
    plain = gym.make_vec("B747Lateral-Faults-v0", **arguments)
    shown = VectorHistory(gym.make_vec("B747Lateral-Faults-v0", **arguments), length, stride)
    obs, _ = plain.reset(seed=1)
    window, _ = shown.reset(seed=1)
    seen = [[o] for o in obs]
    over = np.zeros(N, bool)

    def expected(i):
        return np.stack([seen[i][max(len(seen[i]) - 1 - stride * back, 0)] for back in range(length - 1, -1, -1)])

    for _ in range(30):
        for i in range(N):
            assert np.array_equal(window[i], expected(i))
        actions = np.zeros(N, int)
        obs, _, terminated, truncated, infos = plain.step(actions)
        window, _, _, _, infos_shown = shown.step(actions)
        ended = terminated | truncated
        for i in range(N):
            if mode is AutoresetMode.SAME_STEP and ended[i]:
                seen[i].append(infos["final_obs"][i])
                assert np.array_equal(infos_shown["final_obs"][i], expected(i))
            fresh = ended[i] if mode is AutoresetMode.SAME_STEP else over[i]
            seen[i] = [obs[i]] if fresh else [*seen[i], obs[i]]
        over = ended & (mode is not AutoresetMode.SAME_STEP)
        if mode is AutoresetMode.DISABLED and ended.any():
            obs, _ = plain.reset(options={"reset_mask": ended.copy()})
            window, _ = shown.reset(options={"reset_mask": ended.copy()})
            for i in np.flatnonzero(ended):
                seen[i] = [obs[i]]
            over[:] = False
    assert shown.observation_space.contains(window)


def test_delay_costs_until_the_label_is_right_and_a_relapse_costs_all():
    env = DelayAwareReward(gym.make_vec("B747Lateral-Faults-v0", num_envs=40, decision_period=10), patience=4)
    _, infos = env.reset(seed=0)
    labels, rewards = [infos["label"]], []
    for k in range(119):
        wrong_first = np.where(np.arange(40) % 2, infos["label"], 0)  # odd ones know, even ones say "none"
        action = np.where(np.arange(40) % 4 == 3, (infos["label"] + 1) % 5 if k % 2 else infos["label"], wrong_first)
        _, reward, _, _, infos = env.step(action)
        rewards.append(reward)
        labels.append(infos["label"])
    rewards, labels = np.array(rewards), np.array(labels[:-1])
    assert (rewards[0] == 0).all()
    assert (rewards[1:, 1::4] == 1).all()
    assert ((rewards == 1) | (rewards <= 0)).all()
    late = rewards[:, 0::2]
    for column, label in zip(late.T, labels[:, 0::2].T, strict=True):
        if (label > 0).any() and label[0] == 0:
            onset = int(np.argmax(label > 0))
            assert column[onset : onset + 5].tolist() == pytest.approx([-0.25, -0.5, -0.75, -1, -1][: len(column) - onset])
    stays = labels[5::2, 3::4] == labels[4:-1:2, 3::4]  # the sample before was answered right
    assert (rewards[5::2, 3::4][stays] == -1).all()
    assert stays.mean() > 0.9


def test_weights_and_task_of_the_delay_aware_reward():
    with pytest.raises(ValueError, match="isolation"):
        DelayAwareReward(gym.make_vec("B747Lateral-Faults-v0", num_envs=2, task="identification"))
    with pytest.raises(ValueError, match="one weight per label"):
        DelayAwareReward(gym.make_vec("B747Lateral-Faults-v0", num_envs=2), weights=[1.0])
    with pytest.raises(ValueError, match="at least 1"):
        VectorHistory(gym.make_vec("B747Lateral-Faults-v0", num_envs=2), 0)


# ---------------------------------------------------------------------------------------------------------------
# The contracts of single environments


def test_a_reset_of_one_is_of_one_alone():
    bridge, dummy = both("B747Lateral", decision_period=20)
    bridge.reset(), dummy.reset()
    for venv in (bridge, dummy):
        venv.step(np.zeros(N, int))
    for indices, seed in (([0], 3), (2, np.int64(5)), ([1, 2], 8), (None, 9)):
        ours, theirs = (venv.env_method("reset", indices=indices, seed=seed) for venv in (bridge, dummy))
        assert len(ours) == len(theirs)
        for (obs, info), (obs_, info_) in zip(ours, theirs, strict=True):
            assert np.array_equal(obs, obs_)
            assert info.keys() == info_.keys()
            assert all(np.array_equal(info[name], info_[name]) for name in info)
        for _ in range(3):
            assert np.array_equal(bridge.step(np.zeros(N, int))[0], dummy.step(np.zeros(N, int))[0])
    assert bridge.get_attr("scenario") == dummy.get_attr("scenario")


def test_a_scenario_reaches_the_environments_that_are_meant():
    bridge, dummy = both("B747Lateral")
    scenario = dummy.envs[0].plant.process("hard").sample(np.random.default_rng(0))
    bridge.set_options({"scenario": scenario}), dummy.set_options({"scenario": scenario})
    assert np.array_equal(bridge.reset(), dummy.reset())
    assert bridge.get_attr("scenario") == [scenario] * N
    bridge.reset()
    bridge.env_method("reset", indices=[1], options={"scenario": scenario})
    assert [s == scenario for s in bridge.get_attr("scenario")] == [False, True, False]


def test_what_all_share_is_not_dealt_out():
    """Three labels, three environments: an answer of that length is one answer."""
    bridge, _ = both("B747Lateral")
    bridge.reset()
    bridge.envs.unwrapped.three = lambda: ["a", "b", "c"]
    assert bridge.env_method("three") == [["a", "b", "c"]] * N
    assert bridge.get_attr("scenarios")[0] == bridge.get_attr("scenario")
    for refused in (lambda: bridge.env_method("three", indices=[0]), lambda: bridge.env_method("step", np.zeros(N, int))):
        with pytest.raises(ValueError, match="the environments share"):
            refused()
    for indices in (N, [-1], [0, 7], "0", [0.5], [True]):
        with pytest.raises((ValueError, TypeError), match="environment"):
            bridge.env_method("reset", indices=indices)


@pytest.mark.parametrize("seed", [-1, 1.5, "3", True])
def test_bad_seeds_are_refused_before_the_reset(seed):
    bridge, _ = both("B747Lateral")
    with pytest.raises((ValueError, TypeError), match="seed"):
        bridge.seed(seed)
    bridge.reset()


@pytest.mark.parametrize("options", [{"mask": 1}, {"reset_mask": np.ones(N, bool)}, [{}, {}], "scenario", [1, 2, 3]])
def test_bad_options_are_refused(options):
    bridge, _ = both("B747Lateral")

    def reset():
        bridge.set_options(options)
        bridge.reset()

    with pytest.raises((ValueError, TypeError), match="option"):
        reset()


def test_the_bridge_travels():
    bridge, _ = both("B747Lateral", decision_period=20)
    bridge.reset()
    for _ in range(30):
        bridge.step(np.zeros(N, int))
    other = pickle.loads(pickle.dumps(bridge))
    for _ in range(60):
        for ours, theirs in zip(bridge.step(np.ones(N, int))[:3], other.step(np.ones(N, int))[:3], strict=True):
            assert ours.tobytes() == theirs.tobytes()
