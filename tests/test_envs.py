"""The environments: rules of time and reward, replay, bad input, pictures."""

import copy
import json
import pickle

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from conftest import PLANTS, build
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plants import b747_lateral as b747
from fdi_gym.rules import CHUNK
from fdi_gym.tasks import TASKS
from fdi_gym.vector_envs import FDIVectorEnv


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


@pytest.mark.parametrize("period", [1, 7])
def test_what_an_agent_gets_is_its_own(plant, period):
    """It may write to it: what follows, rewards too, is as if it had not."""
    ours, theirs = (FDIEnv(plant.id, task="identification", decision_period=period) for _ in range(2))
    low, high = ours.action_space.low, ours.action_space.high
    action = np.where(np.isfinite(low) & np.isfinite(high), 0.5 * low + 0.5 * high, 0.0)
    (obs, info), (other, written) = ours.reset(seed=4), theirs.reset(seed=4)
    for _ in range(300 // period):
        assert np.array_equal(obs, other)
        assert {name: np.array(v).tolist() for name, v in info.items()} == \
            {name: np.array(v).tolist() for name, v in written.items()}  # fmt: skip
        other[:], written["target"][:], written["theta"][:] = 1e6, 1e6, 1e6
        obs, reward, _, over, info = ours.step(action)
        other, same, _, _, written = theirs.step(action)
        assert reward == same
        if over:
            break


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
    ({"task": "prediction"}, "isolation, modes, identification, diagnosis, scenario"),
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


@pytest.mark.parametrize(
    ("plant_id", "task"),
    [*((plant_id, "isolation") for plant_id in PLANTS), *(("B747Lateral", task) for task in TASKS if task != "isolation")],
)
def test_pictures(plant_id, task):
    plant = build(plant_id)
    env = FDIEnv(plant.id, task=task, render_mode="rgb_array")
    env.reset(seed=1)
    blank = env.render()
    nothing = {"isolation": 0, "modes": np.zeros(len(plant.modes), int)}.get(task, getattr(env.action_space, "low", None))
    for _ in range(30):
        env.step(nothing)
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


# ---------------------------------------------------------------------------------------------------------------
# State that travels


def on(env, steps=30):
    """What the next steps give, single or vector."""
    n = getattr(env, "num_envs", None)
    rows = []
    for _ in range(steps):
        obs, reward, terminated, truncated, info = env.step(0 if n is None else np.zeros(n, int))
        rows.append(obs.tobytes() + np.asarray(reward).tobytes() + np.asarray(info["theta"]).tobytes())
        if n is None and (terminated or truncated):
            rows.append(env.reset()[0].tobytes())
    return rows


TRAVEL = {
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "deepcopy": copy.deepcopy,
    "cloudpickle": lambda env: cloudpickle.loads(cloudpickle.dumps(env)),
}


@pytest.mark.parametrize("how", TRAVEL)
@pytest.mark.parametrize("make", [FDIEnv, lambda plant, **k: FDIVectorEnv(plant, 3, **k)], ids=["single", "vector"])
@pytest.mark.parametrize("begun", [None, 0, 25, 290], ids=lambda b: f"after {b}")
def test_an_environment_that_travelled_goes_on_with_the_same_bytes(how, make, begun):
    env = make("B747Lateral", decision_period=4)
    if begun is not None:
        env.reset(seed=5)
        on(env, begun)
    other = TRAVEL[how](env)
    if begun is None:
        env.reset(seed=5), other.reset(seed=5)
    assert on(env) == on(other)


def test_every_plants_environment_travels(plant):
    env = FDIEnv(plant.id)
    env.reset(seed=2)
    on(env, 20)
    assert on(pickle.loads(pickle.dumps(env))) == on(env)


def test_spawned_environments_are_the_local_ones():
    plant = load_plant("B747Lateral")
    plant.propagate(0.0, plant.trim_state, plant.trim_command)  # has addresses of this process
    envs = AsyncVectorEnv([lambda: FDIEnv(plant)] * 2, context="spawn")
    try:
        far, _ = envs.reset(seed=4)
        near, _ = FDIVectorEnv("B747Lateral", 2).reset(seed=4)
        assert np.array_equal(far, near)
    finally:
        envs.close()


@pytest.mark.parametrize("make", [gym.make, lambda *a, **k: gym.make_vec(*a, num_envs=2, **k)], ids=["single", "vector"])
def test_specs_survive_json_whatever_they_hold(make):
    scenario = draw(build("B747Lateral").process("hard"), 3)
    env = make("B747Lateral-Faults-v0", scenario=scenario, decision_period=np.int64(5), labels="dual")
    text = env.spec.to_json()
    again = gym.envs.registration.EnvSpec.from_json(text)
    assert FaultScenario.from_json(again.kwargs["scenario"]) == scenario
    kwargs = {key: value for key, value in again.kwargs.items() if key not in ("plant", "num_envs", "vectorization_mode")}
    assert np.array_equal(env.reset(seed=0)[0], make("B747Lateral-Faults-v0", **kwargs).reset(seed=9)[0])


# ---------------------------------------------------------------------------------------------------------------
# What is handed in


BAD_SEEDS = [
    -1,
    1.0,
    "7",
    True,
    np.bool_(True),
    np.float64(3),
    b"1",
    ...,
    float("nan"),
    [1.5, 2, 3],
    [True, 1, 2],
    [-1, 0, 1],
]


@pytest.mark.parametrize("seed", BAD_SEEDS, ids=repr)
@pytest.mark.parametrize("make", [FDIEnv, lambda plant: FDIVectorEnv(plant, 3)], ids=["single", "vector"])
def test_bad_seeds_are_refused_and_lose_nothing(make, seed):
    env, twin = make("B747Lateral"), make("B747Lateral")
    for one in (env, twin):
        one.reset(seed=1)
    with pytest.raises((ValueError, TypeError), match="seed"):
        env.reset(seed=seed)
    assert on(env) == on(twin)


@pytest.mark.parametrize("seed", [np.int64(7), np.uint8(7), np.array(7), 7])
def test_integers_of_numpy_are_integers(seed):
    assert np.array_equal(FDIEnv("B747Lateral").reset(seed=seed)[0], FDIEnv("B747Lateral").reset(seed=7)[0])
    many = FDIVectorEnv("B747Lateral", num_envs=np.int16(3), decision_period=np.uint32(2))
    assert np.array_equal(many.reset(seed=seed)[0], many.reset(seed=np.array([7, 8, 9]))[0])
    assert np.array_equal(many.reset(seed=seed)[0], many.reset(seed=(7, np.int8(8), 9))[0])


BAD_OPTIONS = [
    ({"mask": np.ones(3, bool)}, "unknown option 'mask'"),
    ({"Scenario": 1}, "unknown option 'Scenario'"),
    ({"scenario": 3}, "FaultScenario or its JSON text"),
    ({"scenario": "{}"}, "not a FaultScenario"),
    ({"scenario": lambda: draw(build("HUAVHover").process("standard"), 0)}, "belongs to HUAVHover"),
    ([], "a dict"),
    ("scenario", "a dict"),
]


@pytest.mark.parametrize(("options", "message"), BAD_OPTIONS, ids=[str(i) for i in range(len(BAD_OPTIONS))])
@pytest.mark.parametrize("make", [FDIEnv, lambda plant: FDIVectorEnv(plant, 3)], ids=["single", "vector"])
def test_bad_options_are_refused_and_lose_nothing(make, options, message):
    if isinstance(options, dict):
        options = {key: value() if callable(value) else value for key, value in options.items()}
    env, twin = make("B747Lateral"), make("B747Lateral")
    for one in (env, twin):
        one.reset(seed=1)
    with pytest.raises((ValueError, TypeError), match=message):
        env.reset(seed=2, options=options)
    assert on(env) == on(twin)


BAD_MASKS = [np.ones(2, bool), np.ones((3, 1), bool), np.zeros(3, bool), np.ones(3, int), [True, False, True], "all", True]


@pytest.mark.parametrize("mask", BAD_MASKS, ids=repr)
def test_bad_masks_are_refused_and_lose_nothing(mask):
    env, twin = FDIVectorEnv("B747Lateral", 3), FDIVectorEnv("B747Lateral", 3)
    for one in (env, twin):
        one.reset(seed=1)
    with pytest.raises((ValueError, TypeError), match=r"bool array of shape \(3,\)"):
        env.reset(options={"reset_mask": mask})
    assert on(env) == on(twin)


def test_a_single_environment_has_no_mask():
    with pytest.raises(ValueError, match="unknown option 'reset_mask'"):
        FDIEnv("B747Lateral").reset(options={"reset_mask": np.ones(1, bool)})


def test_options_of_the_vector_environment_are_those_of_single_ones():
    """A scenario is replayed in the environments of the mask, and what else they do is what single ones do."""
    scenario = draw(build("B747Lateral").process("hard"), 3)
    many, loop = FDIVectorEnv("B747Lateral", 3), SyncVectorEnv([lambda: FDIEnv("B747Lateral")] * 3)
    mask = np.array([True, False, True])
    for options in ({"scenario": scenario}, {"scenario": scenario.to_json()}, {"scenario": scenario, "reset_mask": mask}):
        first = many.reset(seed=[1, 2, 3], options=dict(options))
        assert data_equivalence(first, loop.reset(seed=[1, 2, 3], options=dict(options)), exact=True)
        assert on(many, 5) == on(loop, 5)
    assert many.scenarios == [scenario] * 3


def test_generators_and_seeds_are_those_of_single_ones():
    many, loop = FDIVectorEnv("B747Lateral", 3), SyncVectorEnv([lambda: FDIEnv("B747Lateral")] * 3)
    for envs in (many, loop):
        envs.reset(seed=7)
    assert many.np_random_seed == loop.np_random_seed == (7, 8, 9)
    assert [g.bit_generator.state for g in many.np_random] == [g.bit_generator.state for g in loop.np_random]
    mask = np.array([False, True, False])
    for envs in (many, loop):
        envs.reset(options={"reset_mask": mask.copy()})
    assert [g.bit_generator.state for g in many.np_random] == [g.bit_generator.state for g in loop.np_random]
    assert [g.random() for g in many.np_random] == [g.random() for g in loop.np_random]


@pytest.mark.parametrize("action", [True, np.True_, [True, 0, 1], np.zeros(3, bool), [0, 1], np.zeros(3), 1 + 2j, "0", None,
                                    [[0], [1, 2]], np.uint64(2**64 - 1), 2**100, ...], ids=repr)  # fmt: skip
def test_what_is_no_label_is_refused_and_loses_nothing(action):
    for make in (FDIEnv, lambda plant: FDIVectorEnv(plant, 3)):
        env, twin = make("B747Lateral"), make("B747Lateral")
        for one in (env, twin):
            one.reset(seed=1)
        with pytest.raises(ValueError, match=r"label in 0\.\.4"):
            env.step(action)
        assert on(env) == on(twin)


BAD_ARGUMENTS = [
    ({"decision_period": True}, "decision_period"), ({"decision_period": 2.0}, "decision_period"),
    ({"mismatch": -0.1}, "mismatch"), ({"mismatch": np.nan}, "mismatch"), ({"mismatch": "0.1"}, "mismatch"),
    ({"mismatch": True}, "mismatch"), ({"scenario": 5}, "scenario"), ({"process": 5}, "standard"),
    ({"process": "hard", "scenario": "SCENARIO"}, "replayed as it is"),
    ({"mismatch": 0.1, "scenario": "SCENARIO"}, "replayed as it is"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS, ids=[str(i) for i in range(len(BAD_ARGUMENTS))])
@pytest.mark.parametrize("make", [FDIEnv, FDIVectorEnv])
def test_arguments_of_another_kind_are_refused(make, arguments, message):
    text = draw(build("B747Lateral").process("standard"), 0).to_json()
    arguments = {key: text if value == "SCENARIO" else value for key, value in arguments.items()}
    with pytest.raises((ValueError, TypeError), match=message):
        make("B747Lateral", **arguments)


@pytest.mark.parametrize("n", [True, 2.0, "2", 0, -1, None, np.float64(2)])
def test_num_envs_is_a_whole_number(n):
    with pytest.raises((ValueError, TypeError), match="num_envs"):
        FDIVectorEnv("B747Lateral", num_envs=n)


# ---------------------------------------------------------------------------------------------------------------
# Truth on request


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda m: m.value)
def test_truth_on_request_is_the_info(plant, mode):
    short = draw(plant.process("standard"), 0).replace(steps=9, faults=[])
    told, untold = (FDIVectorEnv(plant.id, 2, scenario=short, autoreset_mode=mode, truth=truth) for truth in (True, False))
    _, infos = told.reset(seed=1)
    assert untold.reset(seed=1)[1] == {}
    for _ in range(25):
        truth = untold.truth()
        assert all(np.array_equal(truth[name], infos[name]) for name in infos if name in truth)
        assert {*truth, *(f"_{name}" for name in truth)} == infos.keys() - {
            "final_obs",
            "_final_obs",
            "final_info",
            "_final_info",
        }
        if mode is AutoresetMode.DISABLED and told._over.any():
            infos = told.reset(options={"reset_mask": np.ones(2, bool)})[1]
            untold.reset(options={"reset_mask": np.ones(2, bool)})
            continue
        _, _, _, _, infos = told.step(np.zeros(2, int))
        _, _, _, _, rest = untold.step(np.zeros(2, int))
        assert rest.keys() <= {"final_obs", "_final_obs", "final_info", "_final_info"}


def test_memory_follows_the_chunk_and_not_the_flight():
    """Of a vector environment over flights a hundred times as long as a chunk."""
    plant = build("CMGSatellite")
    long = draw(plant.process("standard"), 0).replace(steps=25_600, faults=[])
    env = FDIVectorEnv(plant, 8, scenario=long)
    env.reset(seed=0)
    for _ in range(600):
        env.step(np.zeros(8, int))
    flown = sum(a.nbytes for a in vars(env).values() if isinstance(a, np.ndarray)) + sum(a.nbytes for a in env._buffer)
    assert flown < 8 * (CHUNK + 1) * 8 * (len(plant.observed) + len(plant.states) + 3 * len(plant.theta) + 4)
