"""PPO through the bridge: its features, exact resume, the stored actor; and adapters show what environments show."""

import gymnasium as gym
import msgspec
import numpy as np
import pytest
import torch
from conftest import ROOT, build
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from baselines.learned import streams, weights
from baselines.learned._reinforcement import PolicyTraining
from baselines.learned.adapters import from_sb3, from_torch
from baselines.learned.feature_env import IdentifiedFeatures
from baselines.learned.features import FeatureShape
from baselines.learned.flights import VALIDATION, Condition, fly, identified
from baselines.learned.recipes import PolicyRecipe
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.engine import simulate
from fdi_gym.sb3 import FDIVecEnv, make_vec_env
from fdi_gym.testing import check_diagnoser
from fdi_gym.wrappers import VectorHistory

CONDITIONS = (Condition("standard", {}), Condition("hard", {}))
SHAPE = FeatureShape(stride=50, lags=2, degree=1, every=2)
TINY = PolicyRecipe(
    conditions=CONDITIONS, shape=SHAPE, identify=10, decisions=192, envs=8, steps=4, updates=2, epochs=1, batch=16, hidden=8,
    validate=1, validation=4,
)  # fmt: skip
FAST = {
    "B747Lateral": FeatureShape(stride=4, lags=3, degree=1, every=2),
    "HUAVHover": FeatureShape(stride=7, lags=2, degree=1),
}


def trained(folder, method="ppo", recipe=TINY, **arguments):
    return PolicyTraining(method, build("B747Lateral"), recipe, seed=0, work=folder).run(**arguments)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("run"))


def test_a_resumed_run_ends_with_the_same_bytes(tiny, tmp_path):
    trained(tmp_path, stop_after=1)
    again = trained(tmp_path)
    assert again.read_bytes() == tiny.read_bytes()
    curves = [[e["accuracy"] for e in weights.read_card(path).curve] for path in (tiny, again)]
    assert curves[0] == curves[1]
    assert len(curves[0]) == 3


def test_the_stored_actor_is_the_policy(tiny):
    """What the stored actor says of a stream is what the policy says of the observations that it was trained on."""
    plant, training = build("B747Lateral"), PolicyTraining("ppo", build("B747Lateral"), TINY, seed=0, work=tiny.parent)
    venv = training.venvs[0]
    venv.seed(VALIDATION)
    venv.reset()
    said = run(
        make_diagnoser("ppo", plant, path=str(tiny)), fly(plant, CONDITIONS[0], range(VALIDATION, VALIDATION + 8)).obs
    )
    assert (said.label[:, :99] == 0).all()
    for k in range(100, 1200, 100):
        obs, _, _, _ = venv.step(np.zeros(8, int))
        with torch.no_grad():
            probs = training.agent.policy.get_distribution(torch.from_numpy(obs)).distribution.probs.numpy()
        assert np.allclose(probs, said.label_probs[:, k - 1], atol=1e-5)
        assert np.array_equal(said.label_probs[:, k - 1], said.label_probs[:, k + 98])


def test_tensors_or_a_card_of_another_shape_are_refused(tiny, tmp_path):
    tensors, card = weights.read_tensors(tiny), weights.read_card(tiny)

    def refused(why, changed=tensors, card=card):
        weights.write(tmp_path / tiny.name, {k: v for k, v in changed.items() if v is not None}, card)
        with pytest.raises(weights.RefusedError, match=why):
            make_diagnoser("ppo", build("B747Lateral"), path=str(tmp_path / tiny.name))

    for name, other in (("model.V", None), ("model.W", tensors["model.W"][:, 1:]), ("layers.2.bias", np.zeros(6, "f4"))):
        refused(name, {**tensors, name: other})
    refused(
        "the shape's lags is a whole number",
        card=msgspec.structs.replace(card, shape={"stride": 50, "degree": 1, "effects": 1, "hidden": 8}),
    )


def test_an_sb3_zip_is_refused(tiny, tmp_path):
    PolicyTraining("ppo", build("B747Lateral"), TINY, seed=0, work=tiny.parent).agent.save(tmp_path / "model.zip")
    (tmp_path / "model.zip").rename(tmp_path / "model.safetensors")
    with pytest.raises(weights.RefusedError, match="zip archive"):
        make_diagnoser("ppo", build("B747Lateral"), path=str(tmp_path / "model.safetensors"))


def test_a_policy_estimates(tmp_path):
    path = trained(tmp_path, "ppo_identification", PolicyRecipe(**{**vars(TINY), "task": "identification", "decisions": 64}))
    plant = build("B747Lateral")
    check_diagnoser(lambda p, _: make_diagnoser("ppo_identification", p, path=str(path)), plant, samples=240)
    assert set(weights.read_card(path).curve[0]["accuracy"]) == {"standard rmse", "hard rmse"}


@pytest.fixture(scope="module", params=FAST)
def seen(request):
    """A plant, the shape of a model and the model, identified from a few flights."""
    plant, shape = build(request.param), FAST[request.param]
    return plant, shape, identified([plant], shape, [fly(plant, CONDITIONS[0], range(40))])


def observed(seen, n, **arguments):
    """Environments that show features."""
    plant, shape, model = seen
    arguments = {
        "units": "physical",
        "decision_period": shape.period,
        "autoreset_mode": AutoresetMode.SAME_STEP,
        **arguments,
    }
    return IdentifiedFeatures(gym.make_vec(plant.env_id, num_envs=n, **arguments), plant, shape, model)


@pytest.mark.parametrize("units", ["physical", "scaled"])
def test_features_are_those_of_each_flight_alone(seen, units):
    """Also across the ends of episodes, some of which come early (HUAVHover), and in `final_obs`."""
    plant, shape, model = seen
    n, m, envs = 3, shape.period, observed(seen, 3, units=units)
    close = {"atol": 1e-6 if units == "physical" else 1e-4, "rtol": 1e-6}

    def alone(i):
        """The features of the flight that environment i is on, with those before the first step: (T + 1, n_features)."""
        record = simulate(plant, [envs.unwrapped.scenarios[i]])
        obs = record.obs[:, : int(record.length[0]) + 1]
        steps = streams.features(plant, shape, model, obs)[0]
        return np.concatenate([np.zeros_like(steps[:1]), steps])

    obs, _ = envs.reset(seed=VALIDATION)
    assert obs.dtype == np.float32
    flights, j, ends = [alone(i) for i in range(n)], np.zeros(n, int), 0
    for _ in range(2500 // m):
        obs, _, terminated, truncated, infos = envs.step(np.zeros(n, int))
        j += 1
        for i in range(n):
            if terminated[i] or truncated[i]:
                assert np.allclose(infos["final_obs"][i], flights[i][-1], **close)
                flights[i], j[i], ends = alone(i), 0, ends + 1
            assert np.allclose(obs[i], flights[i][j[i]], **close)
    assert ends > n


def test_features_ask_for_blocks_that_go_on_together(seen):
    with pytest.raises(ValueError, match="decision_period"):
        observed(seen, 2, decision_period=3)
    with pytest.raises(ValueError, match="SameStep"):
        observed(seen, 2, autoreset_mode=AutoresetMode.NEXT_STEP)
    envs = observed(seen, 2)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match="together"):
        envs.reset(options={"reset_mask": np.array([True, False])})


class Recorder(torch.nn.Module):
    """Keeps what it is shown and says "none"."""

    def __init__(self, labels):
        super().__init__()
        self.labels, self.shown = labels, []

    def forward(self, x):
        self.shown.append(x.numpy().copy())
        return torch.zeros(len(x), self.labels)


@pytest.mark.parametrize(("period", "length", "stride"), [(1, None, 1), (10, None, 1), (1, 4, 3), (10, 3, 2)])
def test_an_adapter_shows_what_the_environment_shows(period, length, stride):
    plant = build("B747Lateral")
    envs = gym.make_vec("B747Lateral-Faults-v0", num_envs=2, units="scaled", decision_period=period,
                        autoreset_mode=AutoresetMode.DISABLED)  # fmt: skip
    if length is not None:
        envs = VectorHistory(envs, length, stride)
    obs, _ = envs.reset(seed=VALIDATION)
    expected = [obs, *(envs.step(np.zeros(2, int))[0] for _ in range(12))]
    module = Recorder(5)
    record = fly(plant, Condition("standard", {}), range(VALIDATION, VALIDATION + 2))
    run(from_torch(module, plant, decision_period=period, length=length, stride=stride), record.obs[:, : 12 * period + 1])
    assert len(module.shown) == 13
    for seen, wanted in zip(module.shown, expected, strict=True):
        assert np.array_equal(seen, wanted)


def test_a_policy_of_your_own_becomes_a_diagnoser():
    plant = build("B747Lateral")
    venv = FDIVecEnv(VectorHistory(make_vec_env("B747Lateral-Faults-v0", 4, units="scaled", decision_period=50).envs, 2))
    model = PPO("MlpPolicy", VecMonitor(venv), n_steps=8, batch_size=16, n_epochs=1, seed=0, device="cpu").learn(32)
    diagnoser = from_sb3(model.policy, plant, decision_period=50, length=2)
    said = run(diagnoser, fly(plant, Condition("standard", {}), range(VALIDATION, VALIDATION + 2)).obs[:, :200])
    assert said.label_probs is not None
    assert np.allclose(said.label_probs.sum(axis=2), 1)


def test_readme_section_is_short():
    readme = (ROOT / "README.md").read_text()
    block = next(b for b in readme.split("```") if "from_torch" in b and b.startswith("python"))
    assert len([line for line in block.splitlines() if line.strip()]) < 20
