"""PPO through the bridge: runs resume exactly, a stored actor is its policy, adapters show what environments show."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import ROOT, build
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from baselines.networks import weights
from baselines.networks.adapters import from_sb3, from_torch
from baselines.networks.flights import VALIDATION, Source, fly
from baselines.networks.reinforcement import Recipe, Run
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.sb3 import FDIVecEnv, make_vec_env
from fdi_gym.testing import check_diagnoser
from fdi_gym.wrappers import VectorHistory

TINY = Recipe(
    source=Source("standard", {}), decision_period=100, length=3, decisions=192, envs=8, steps=4, updates=2, epochs=1,
    batch=16, hidden=8, validate=1, validation=4,
)  # fmt: skip


def trained(folder, method="ppo", recipe=TINY, **arguments):
    return Run(method, "B747Lateral", recipe, seed=0, work=folder).run(**arguments)


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
    plant, run_ = build("B747Lateral"), Run("ppo", "B747Lateral", TINY, seed=0, work=tiny.parent)
    venv = run_.model.get_env()
    venv.seed(VALIDATION)
    obs = venv.reset()
    said = run(make_diagnoser("ppo", plant, path=str(tiny)), fly(plant, TINY.source, range(VALIDATION, VALIDATION + 8)).obs)
    for k in range(0, 1200, 100):
        with torch.no_grad():
            probs = run_.model.policy.get_distribution(torch.from_numpy(obs)).distribution.probs.numpy()
        assert np.allclose(probs, said.mode_probs[:, k], atol=1e-5)
        obs, _, _, _ = venv.step(np.zeros(8, int))


def test_an_sb3_zip_is_refused(tiny, tmp_path):
    Run("ppo", "B747Lateral", TINY, seed=0, work=tiny.parent).model.save(tmp_path / "model.zip")
    (tmp_path / "model.zip").rename(tmp_path / "model.safetensors")
    with pytest.raises(weights.RefusedError, match="zip archive"):
        make_diagnoser("ppo", build("B747Lateral"), path=str(tmp_path / "model.safetensors"))


def test_a_policy_estimates(tmp_path):
    path = trained(tmp_path, "ppo_identification", Recipe(**{**vars(TINY), "task": "identification", "decisions": 64}))
    plant = build("B747Lateral")
    check_diagnoser(lambda p, _: make_diagnoser("ppo_identification", p, path=str(path)), plant, samples=240)
    assert "rmse" in weights.read_card(path).curve[0]["accuracy"]


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
    record = fly(plant, Source("standard", {}), range(VALIDATION, VALIDATION + 2))
    run(from_torch(module, plant, decision_period=period, length=length, stride=stride), record.obs[:, : 12 * period + 1])
    assert len(module.shown) == 13
    for seen, wanted in zip(module.shown, expected, strict=True):
        assert np.array_equal(seen, wanted)


def test_a_policy_of_your_own_becomes_a_diagnoser():
    plant = build("B747Lateral")
    venv = FDIVecEnv(VectorHistory(make_vec_env("B747Lateral-Faults-v0", 4, units="scaled", decision_period=50).envs, 2))
    model = PPO("MlpPolicy", VecMonitor(venv), n_steps=8, batch_size=16, n_epochs=1, seed=0, device="cpu").learn(32)
    diagnoser = from_sb3(model.policy, plant, decision_period=50, length=2)
    said = run(diagnoser, fly(plant, Source("standard", {}), range(VALIDATION, VALIDATION + 2)).obs[:, :200])
    assert said.mode_probs is not None
    assert np.allclose(said.mode_probs.sum(axis=2), 1)


def test_readme_section_is_short():
    readme = (ROOT / "README.md").read_text()
    block = next(b for b in readme.split("```") if "from_torch" in b and b.startswith("python"))
    assert len([line for line in block.splitlines() if line.strip()]) < 20
