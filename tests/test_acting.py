"""Diagnoses that act: what plants declare, the active environments, agents, and what acting is worth."""

import dataclasses
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import fdi_gym
from baselines.learned import weights
from baselines.probing import doubt, ppo
from baselines.probing._learning import ProbingTraining
from baselines.probing.periodic import periodic_probes
from baselines.probing.recipes import recipe_of
from fdi_gym.acting import NO_PROBE, Acting, Probe, square
from fdi_gym.acts import Acts, accommodated, acting_of, costs, probe_prices
from fdi_gym.agents import NEVER, fly
from fdi_gym.diagnosis import Diagnoser, Diagnosis, NotApplicableError, make_diagnoser, probers, run, trainers
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import advance, simulate
from fdi_gym.entrants import make_prober
from fdi_gym.faults import draw
from fdi_gym.flights import Flights

BUILDERS = list({entry.build: name for name, entry in probers().items()}.values())  # a name of each
PLANTS = [name for name in plant_sources() if load_plant(name).acting is not None]
SHORT = 150  # samples


def scenarios(plant, count, process="standard", steps=None):
    """So many flights, cut to a length."""
    found = [draw(plant.process(process), 1_000_000 + i) for i in range(count)]
    if steps is None:
        return found
    return [s.replace(steps=steps, faults=[f for f in s.faults if f.onset < steps]) for s in found]


def silent(plant):
    """A diagnoser that never says anything."""
    return Diagnoser(lambda n: n, lambda n, obs: (n, Diagnosis(np.zeros(n, bool), np.zeros(n, np.int64))))


# ---------------------------------------------------------------------------------------------------------------
# What plants declare


def test_all_plants_of_the_package_can_be_acted_on():
    assert set(PLANTS) >= {"B747Lateral", "CMGSatellite", "HUAVHover", "MissilePitch", "ThreeTank"}


@pytest.mark.parametrize("plant_id", PLANTS)
def test_a_plant_declares_probes_accommodation_and_a_cost(plant_id):
    plant = load_plant(plant_id)
    acting = acting_of(plant, probing=True, accommodation=True)
    assert acting.probes[0] is NO_PROBE
    assert len({p.name for p in acting.probes}) == len(acting.probes) > 1
    np.testing.assert_array_equal(acting.accommodate(plant.healthy[None]), [plant.q])
    flight = simulate(plant, scenarios(plant, 1, "fault-free"))
    rows = np.broadcast_to(
        plant.inputs(scenarios(plant, 1, "fault-free")[0]).reference, (*flight.state.shape[:2], plant.reference_width)
    )
    cost = acting.cost(flight.state, plant.split(flight.obs)[1], rows)
    assert cost.shape == flight.label.shape
    assert 0 <= cost.min() <= cost.max() <= acting.lost


def changed(plant, **fields):
    return dataclasses.replace(plant, acting=dataclasses.replace(plant.acting, **fields))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"probes": (Probe("big", "", command=square(4, (25.0, 0.0))),)}, "beyond the actuator's limits"),
        ({"probes": (Probe("flat", "", command=np.zeros(4)),)}, "rows"),
        ({"probes": (Probe("wide", "", command=np.zeros((4, 3))),)}, "rows"),
        ({"probes": (Probe("nan", "", reference=np.full((4, 3), np.nan)),)}, "finite"),
        ({"probes": (Probe("nothing", ""),)}, "adds something"),
        ({"probes": (Probe("a", "", command=np.ones((1, 2))), Probe("a", "", command=np.ones((1, 2))))}, "two probes"),
        ({"probes": (Probe("q", "", parameters=np.zeros(2)),)}, "parameters"),
        ({"lost": -1.0}, "lost"),
        ({"lost": np.nan}, "lost"),
        ({"flight_cost": 3.0}, "flight_cost"),
        ({"accommodate": lambda b: np.zeros((len(b), 14))}, "healthy plant"),
        ({"accommodate": lambda b: 1 / 0}, "ZeroDivisionError"),
    ],
)
def test_a_declaration_that_contradicts_itself_is_refused(fields, words):
    with pytest.raises(ValueError, match=words):
        changed(load_plant("B747Lateral"), **fields)


def test_a_reference_probe_of_another_width_is_refused_when_it_is_flown():
    plant = changed(load_plant("B747Lateral"), probes=(Probe("narrow", "", reference=np.ones((4, 2))),))
    with pytest.raises(ValueError, match="references"):
        fly(plant, scenarios(plant, 1), silent(plant), periodic_probes(plant, on=1, every=1))


@pytest.mark.parametrize("plant_id", PLANTS)
def test_prices_are_what_probes_cost_a_healthy_flight(plant_id):
    prices = np.array(probe_prices(load_plant(plant_id)))
    assert prices[0] == 0.0
    assert (prices[1:] > 0).all()


def test_the_price_of_a_probe_on_a_linear_plant_grows_with_its_square():
    plant = load_plant("B747Lateral")
    rows = plant.acting.probes[1].command
    prices = probe_prices(changed(plant, probes=(Probe("one", "", command=rows), Probe("two", "", command=2 * rows))))
    assert prices[2] / prices[1] == pytest.approx(4.0, rel=0.05)


# ---------------------------------------------------------------------------------------------------------------
# Environments


@pytest.mark.parametrize("plant_id", PLANTS)
@pytest.mark.parametrize("period", [1, 7])
def test_without_a_probe_it_is_the_passive_environment_to_the_byte(plant_id, period):
    active, passive = (gym.make(f"{plant_id}-{kind}-v0", decision_period=period).unwrapped for kind in ("Active", "Faults"))
    for seed in (3, None):
        (a, info), (b, told) = active.reset(seed=seed), passive.reset(seed=seed)
        for _ in range(SHORT):
            assert a.tobytes() == b.tobytes()
            assert all(np.array_equal(info[key], told[key]) for key in told)
            (a, x, *ends, info), (b, y, *others, told) = active.step(np.array([1, 0])), passive.step(1)
            assert (x, ends) == (y, others)
            if any(ends):
                break


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("plant_id", PLANTS)
def test_the_vector_environment_is_so_many_single_ones(plant_id, mode):
    n, kw = 3, {"decision_period": 20, "probing": True, "accommodation": True, "process": "standard"}
    plant = load_plant(plant_id)
    flights = scenarios(plant, n, steps=SHORT)
    envs = gym.make_vec(f"{plant_id}-Active-v0", num_envs=n, autoreset_mode=AutoresetMode(mode), **kw)
    singles = [gym.make(f"{plant_id}-Active-v0", **kw).unwrapped for _ in range(n)]
    assert (
        envs.reset(seed=5, options={"scenario": flights[0]})[0].tobytes()
        == np.stack([e.reset(seed=5 + i, options={"scenario": flights[0]})[0] for i, e in enumerate(singles)]).tobytes()
    )
    rng, labels, probes = np.random.default_rng(0), *envs.single_action_space.nvec
    over = np.zeros(n, bool)
    for _ in range(2 * SHORT // 20):
        actions = np.stack([rng.integers(labels, size=n), rng.integers(probes, size=n)], axis=1)
        obs, rewards, terminated, truncated, infos = envs.step(actions)
        for i, single in enumerate(singles):
            if over[i] and mode == "NextStep":
                alone, reward, ends, over[i] = single.reset()[0], 0.0, [False, False], False
            else:
                alone, reward, *ends, info = single.step(actions[i])
                over[i] = any(ends)
                if not over[i] or mode == "NextStep":
                    assert info["cost"] == infos["cost"][i]
                if over[i] and mode == "SameStep":
                    alone, over[i] = single.reset()[0], False
            assert alone.tobytes() == obs[i].tobytes()
            assert (reward, *ends) == (rewards[i], terminated[i], truncated[i])


def test_a_flight_that_is_over_is_not_stepped():
    plant = load_plant("B747Lateral")
    flight = scenarios(plant, 1, steps=20)[0]
    env = gym.make("B747Lateral-Active-v0", scenario=flight, decision_period=20).unwrapped
    envs = gym.make_vec(
        "B747Lateral-Active-v0", 2, scenario=flight, decision_period=20, autoreset_mode=AutoresetMode.DISABLED
    )
    for reset, step, action in ((env.reset, env.step, [0, 0]), (envs.reset, envs.step, [[0, 0]] * 2)):
        with pytest.raises(RuntimeError, match="reset"):
            step(np.array(action))
        reset(seed=0)
        step(np.array(action))
        with pytest.raises(RuntimeError, match="over"):
            step(np.array(action))


@pytest.mark.parametrize("plant_id", PLANTS)
def test_pickled_in_the_middle_it_goes_on_the_same(plant_id):
    env = gym.make(f"{plant_id}-Active-v0", decision_period=5, accommodation=True).unwrapped
    env.reset(seed=1)
    for _ in range(4):
        env.step(np.array([1, 1]))
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(6):
        (a, x, *_), (b, y, *_) = env.step(np.array([2, 1])), twin.step(np.array([2, 1]))
        assert a.tobytes() == b.tobytes()
        assert x == y


def test_a_probe_is_added_to_the_command_one_sample_after_it_was_chosen():
    """In the open loop in level flight nothing else moves a surface."""
    env = gym.make("B747Lateral-Active-v0", process="quiet", decision_period=1).unwrapped
    env.reset(seed=0)
    rows = env.plant.acting.probes[1].command
    shown = [env.step(np.array([0, 1]))[0] for _ in range(120)]
    moved = np.array([env.plant.split(obs)[1] for obs in shown])
    np.testing.assert_array_equal(moved[0], [0.0, 0.0])  # the command of sample 0 was there before the choice
    np.testing.assert_array_equal(moved[1:], np.concatenate([rows, rows])[: len(moved) - 1])


def test_a_probe_that_goes_on_is_not_begun_anew_and_one_that_changes_is():
    plant = load_plant("B747Lateral")
    acts = Acts(Flights(plant, scenarios(plant, 2)))
    acts.choose(np.array([1, 3]))
    first = acts.tables(30).inputs
    acts.choose(np.array([1, 1]))
    second = acts.tables(30).inputs
    rows = [p.command for p in plant.acting.probes]
    np.testing.assert_array_equal(np.concatenate([first, second])[:, 0], rows[1][:60])
    np.testing.assert_array_equal(second[:, 1], rows[1][:30])


def test_a_probed_command_stays_within_its_range():
    plant = load_plant("B747Lateral", variant="printed/closed")
    found = fly(plant, scenarios(plant, 6), silent(plant), periodic_probes(plant, on=1, every=1, probes=("both",)))
    for j, signal in enumerate(plant.commands):
        u = plant.split(found.record.obs)[1][..., j]
        assert signal.low <= u.min() <= u.max() <= signal.high


def test_the_reward_of_probing_is_the_diagnosis_less_the_price():
    kw = {"process": "quiet", "decision_period": 10}
    free, dear = (gym.make("B747Lateral-Active-v0", cost_weight=w, **kw).unwrapped for w in (0.0, 2.0))
    free.reset(seed=4), dear.reset(seed=4)
    prices = probe_prices(free.plant)
    for k in range(20):
        probe = k % 4
        a, b = free.step(np.array([0, probe])), dear.step(np.array([0, probe]))
        assert a[0].tobytes() == b[0].tobytes()
        assert a[1] - b[1] == pytest.approx(2.0 * prices[probe])


@pytest.mark.parametrize("plant_id", PLANTS)
def test_the_reward_of_accommodation_is_minus_the_cost(plant_id):
    plant = load_plant(plant_id)
    flight = scenarios(plant, 1, steps=SHORT)[0]
    env = gym.make(f"{plant_id}-Active-v0", scenario=flight, accommodation=True, probing=False, decision_period=10).unwrapped
    env.reset(seed=0)
    rewards, ends = [], False
    while not ends:
        _, reward, terminated, truncated, info = env.step(0)
        rewards.append(reward)
        assert reward == -info["cost"] or terminated
        ends = terminated or truncated
    flights = Flights(plant, [flight])
    first = advance(flights, 1)
    cost = costs(flights, advance(flights, SHORT), np.ones(1, np.int64))
    assert first.obs.shape[0] == 1
    assert sum(rewards) == pytest.approx(-cost.sum() / 10)


def test_what_is_left_of_a_lost_flight_costs_the_most():
    plant = load_plant("HUAVHover")
    seeds = [s for s in range(1_000_000, 1_000_400) if len(draw(plant.process("standard"), s).faults) == 2]
    lost = next(s for s in (draw(plant.process("standard"), seed) for seed in seeds) if simulate(plant, [s]).terminated[0])
    env = gym.make("HUAVHover-Active-v0", scenario=lost, accommodation=True, probing=False, decision_period=10).unwrapped
    env.reset(seed=0)
    terminated = False
    while not terminated:
        _, reward, terminated, truncated, info = env.step(0)
        assert not truncated
    left = lost.steps - simulate(plant, [lost]).length[0]
    assert reward == pytest.approx(-info["cost"] - plant.acting.lost * left / 10)
    found = fly(plant, [lost], silent(plant))
    assert (found.cost[0, found.record.length[0] + 1 :] == plant.acting.lost).all()


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"probing": False}, ValueError, "probing=True or accommodation=True"),
        ({"probing": 1}, TypeError, "True or False"),
        ({"task": "identification"}, ValueError, "isolation, diagnosis"),
        ({"cost_weight": -1.0}, ValueError, "cost_weight"),
        ({"cost_weight": float("nan")}, ValueError, "cost_weight"),
        ({"process": "nowhere"}, ValueError, "nowhere"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(arguments, error, words):
    for make in (gym.make, lambda name, **kw: gym.make_vec(name, 2, **kw)):
        with pytest.raises(error, match=words):
            make("B747Lateral-Active-v0", **arguments)


def test_a_plant_that_declares_nothing_is_refused_in_words():
    bare = dataclasses.replace(load_plant("B747Lateral"), acting=None)
    fixed = changed(load_plant("B747Lateral"), accommodate=None)
    blind = changed(load_plant("B747Lateral"), probes=())
    from fdi_gym.active_envs import ActiveEnv

    for plant, kw, words in (
        (bare, {}, "declares nothing"), (fixed, {"accommodation": True}, "no accommodation"), (blind, {}, "no probes"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            ActiveEnv(plant, **kw)
    ActiveEnv(fixed), ActiveEnv(blind, probing=False, accommodation=True)


@pytest.mark.parametrize("action", [[0, 9], [0, -1], [7, 0], [0.0, 1.0], 0, [0], [0, 0, 0], [True, False], "none", None])
def test_an_action_that_is_none_is_refused_and_nothing_happens(action):
    env = gym.make("B747Lateral-Active-v0").unwrapped
    twin = gym.make("B747Lateral-Active-v0").unwrapped
    env.reset(seed=0), twin.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(action)
    assert env.step(np.array([0, 1]))[0].tobytes() == twin.step(np.array([0, 1]))[0].tobytes()


@pytest.mark.parametrize("units", ["physical", "scaled"])
def test_an_estimate_that_is_not_a_number_reconfigures_nothing_and_is_counted(units):
    kw = {"task": "diagnosis", "accommodation": True, "decision_period": 5, "units": units}
    env, twin = (gym.make("B747Lateral-Active-v0", variant="bare/closed", **kw).unwrapped for _ in range(2))
    envs = gym.make_vec("B747Lateral-Active-v0", 2, variant="bare/closed", **kw)
    env.reset(seed=0), twin.reset(seed=0), envs.reset(seed=0)
    low = -1.0 if units == "scaled" else 0.0
    action = np.full(env.action_space.shape, low)
    action[1] = action[9] = 1.0  # the aileron has lost effectiveness; no probe
    healthy = action.copy()
    action[5], healthy[1], healthy[0] = np.nan, low, 1.0
    for count in (1, 2):
        a, b, c = env.step(action), twin.step(healthy), envs.step(np.stack([action, action]))
        assert a[0].tobytes() == b[0].tobytes() == c[0][0].tobytes()
        assert (a[4]["unusable"], c[4]["unusable"][0], b[4]["unusable"]) == (count, count, 0)
    with pytest.raises(ValueError, match="shape"):
        env.step(action[:-1])


# ---------------------------------------------------------------------------------------------------------------
# What is allowed for


@pytest.mark.parametrize("plant_id", PLANTS)
def test_what_is_allowed_for_lies_on_the_lines_of_the_labels_modes(plant_id):
    plant, rng = load_plant(plant_id), np.random.default_rng(1)
    scale = np.array([s.scale for s in plant.estimated])
    for index, label in enumerate(plant.labels):
        estimate = plant.healthy + rng.normal(size=(4, len(scale))) * scale
        found = accommodated(plant, np.full(4, index), estimate)
        lines = np.array([m.direction for m in plant.modes if m.name in label.modes]).reshape(-1, len(scale))
        offset = np.sum([m.offset for m in plant.modes if m.name in label.modes], axis=0) if label.modes else 0.0
        left = (found - plant.healthy - offset).T
        if len(lines):
            left = left - lines.T @ np.linalg.lstsq(lines.T, left, rcond=None)[0]
        np.testing.assert_allclose(left, 0.0, atol=1e-9)


def test_a_sensors_fault_is_no_reason_to_reconfigure():
    plant = load_plant("B747Lateral", sensor_faults=True)
    own = len(plant.bare.labels)
    found = accommodated(plant, np.array([own, len(plant.labels) - 1, 0]), np.zeros((3, len(plant.estimated))))
    np.testing.assert_array_equal(found, np.tile(plant.bare.healthy, (3, 1)))
    env = gym.make("B747Lateral-Active-v0", sensor_faults=True, accommodation=True).unwrapped
    env.reset(seed=0)
    env.step(np.array([own, 1]))


@pytest.mark.parametrize(
    ("plant_id", "options", "process"),
    [("B747Lateral", {"variant": "bare/closed"}, "banking"), ("ThreeTank", {}, "standard"),
     ("HUAVHover", {}, "quiet")],
)  # fmt: skip
def test_allowing_for_the_truth_is_better_than_for_nothing_and_a_false_alarm_is_worse(plant_id, options, process):
    plant = load_plant(plant_id, **options)
    flights = scenarios(plant, 40, process)
    nothing, truth = (fly(plant, flights, silent(plant), allow_for=what, period=5) for what in ("nothing", "truth"))
    gain = nothing.cost.mean(axis=1) - truth.cost.mean(axis=1)
    assert gain.mean() > 2 * gain.std() / np.sqrt(len(gain))

    size = max(plant.modes[0].reach, key=abs) / 2
    estimate = plant.healthy + size * np.array(plant.modes[0].direction)

    def update(n, obs):
        return n, Diagnosis(np.ones(len(obs), bool), np.ones(len(obs), np.int64), np.tile(estimate, (len(obs), 1)))

    healthy = [s.without_faults() for s in flights]
    alarmed = fly(plant, healthy, Diagnoser(lambda n: n, update), allow_for="diagnosis", period=50)
    worse = alarmed.cost.mean(axis=1) - fly(plant, healthy, silent(plant)).cost.mean(axis=1)
    assert worse.mean() > 0


# ---------------------------------------------------------------------------------------------------------------
# Agents


@pytest.mark.parametrize("plant_id", PLANTS)
def test_an_agent_that_does_nothing_flies_what_is_simulated_and_says_what_is_said(plant_id):
    plant = load_plant(plant_id)
    flights = scenarios(plant, 2, steps=SHORT) + scenarios(plant, 1, steps=SHORT // 2)
    diagnoser = make_diagnoser("augmented_ekf", plant)
    found, record = fly(plant, flights, diagnoser, NEVER, period=7), simulate(plant, flights)
    for a, b in zip(found.record, record, strict=True):
        np.testing.assert_array_equal(a, b)
    said = run(diagnoser, record.obs)
    for name in ("alarm", "label", "estimate", "estimate_std", "state"):
        np.testing.assert_array_equal(getattr(found.decisions, name), getattr(said, name))
    assert not found.probe.any()


@pytest.mark.parametrize("plant_id", PLANTS)
@pytest.mark.parametrize("name", BUILDERS)
def test_a_prober_chooses_probes_that_there_are_and_for_a_flight_alone_as_in_a_batch(plant_id, name):
    plant = load_plant(plant_id)
    flights = scenarios(plant, 3, steps=SHORT)
    try:
        whole, alone = (
            fly(plant, some, silent(plant), make_prober(name, plant, period=5), period=5) for some in (flights, flights[2:])
        )
    except NotApplicableError as error:
        assert "train" in str(error)  # noqa: PT017 (a prober without weights for this plant)
        return
    assert 0 <= whole.probe.min() <= whole.probe.max() < len(plant.acting.probes)
    np.testing.assert_array_equal(whole.probe[2:], alone.probe)
    np.testing.assert_array_equal(whole.record.obs[2:], alone.record.obs)


@pytest.mark.parametrize("settings", [{"probes": ("wings",)}, {"on": 5, "every": 3}, {"on": -1}])
def test_a_prober_with_senseless_settings_is_refused(settings):
    with pytest.raises(ValueError, match="probe"):
        make_prober("periodic_probes_10", load_plant("B747Lateral"), **settings)


def test_nothing_is_allowed_for_but_what_exists():
    plant = load_plant("B747Lateral")
    with pytest.raises(ValueError, match="allow_for"):
        fly(plant, scenarios(plant, 1), silent(plant), allow_for="wishes")
    assert fly(plant, scenarios(plant, 1, steps=20), silent(plant), NEVER).cost.shape == (1, 21)


def test_in_level_flight_a_weak_surface_is_told_from_none_by_its_probe_alone():
    """Without an excitation a loss of effectiveness changes nothing, so nothing tells it; a doublet of that surface does."""
    plant = load_plant("B747Lateral")
    found = doubt.resolved(plant, "quiet", 200, 200)
    names, labels = [p.name for p in plant.acting.probes], [label.name for label in plant.labels]
    none, aileron, rudder = labels.index("none"), labels.index("aileron LOE"), labels.index("rudder LOE")
    np.testing.assert_allclose(found, found.swapaxes(1, 2))
    assert found.max() <= 1.0
    assert found[0, none, aileron] == found[0, none, rudder] == 0.0
    assert found[names.index("aileron"), none, aileron] > 0.6 > found[names.index("aileron"), none, rudder]
    assert found[names.index("rudder"), none, rudder] > 0.6


def test_a_probe_is_worth_what_it_shows_of_faults_that_nobody_sees_without():
    """In quiet hover most losses are seen at once, weak ones of the longitudinal cyclic are not; its probe shows them."""
    plant = load_plant("HUAVHover")
    found, lon = doubt.resolved(plant, "quiet", 400, 25), [label.name for label in plant.labels].index("lon")
    cyclic = [p.name for p in plant.acting.probes].index("cyclic")
    assert found[0, 0, lon] < 0.99 < found[cyclic, 0, lon]
    others = [i for i in (1, 2, 3, 4) if i != lon]
    assert (found[0, 0, others] > 0.99).all()


@pytest.mark.parametrize(
    ("plant_id", "probe", "options", "state", "command", "size"),
    [("CMGSatellite", "null", {"reference": "regulate"}, slice(4, 7), slice(0, 4), 0.05),
     ("MissilePitch", "dither", {}, slice(1, 2), slice(1, 2), 0.2)],
)  # fmt: skip
def test_a_probe_in_the_null_space_moves_the_actuators_and_hardly_the_healthy_plant(
    plant_id, probe, options, state, command, size
):
    """One that is no null motion, of the same size, moves it far more."""
    plant = load_plant(plant_id, **options)
    rows = np.zeros((50, len(plant.commands)))
    rows[:25, command], rows[25:, command] = size, -size
    other = changed(plant, probes=(plant.acting.probes[1], Probe("other", "", command=rows)))
    flights = scenarios(plant, 2, "fault-free", steps=1000)
    still, null, shaken = (
        fly(other, flights, silent(plant), periodic_probes(other, on=on, every=1, probes=(name,))).record
        for on, name in ((0, probe), (1, probe), (1, "other"))
    )
    effort, moved, more = (
        np.abs(a - b).max()
        for a, b in ((plant.split(null.obs)[1], plant.split(still.obs)[1]),
                     (null.state[..., state], still.state[..., state]), (shaken.state[..., state], still.state[..., state]))
    )  # fmt: skip
    assert effort > size / 3
    assert moved < 0.2 * more


def test_the_bridge_to_stable_baselines3_takes_active_environments():
    sb3 = pytest.importorskip("stable_baselines3")
    from fdi_gym.sb3 import make_vec_env

    venv = make_vec_env("B747Lateral-Active-v0", 4, units="scaled", decision_period=10, process="quiet")
    model = sb3.PPO("MlpPolicy", venv, n_steps=16, batch_size=32, n_epochs=1, gamma=0.95, seed=0, device="cpu")
    model.learn(64)
    actions, _ = model.predict(venv.reset())
    assert venv.step(actions)[0].shape == (4, *venv.observation_space.shape)


def test_registering_a_plant_registers_its_active_environment():
    for plant_id, source in plant_sources().items():
        assert f"{plant_id}-Active-v{source.version}" in gym.registry
    assert fdi_gym.__version__
    assert isinstance(load_plant("ThreeTank").acting, Acting)


# ---------------------------------------------------------------------------------------------------------------
# Learned probers

WEIGHTS = sorted(ppo.FOLDER.glob("*.safetensors"))


@pytest.mark.parametrize("path", WEIGHTS, ids=lambda path: path.stem)
def test_a_learned_prober_chooses_probes_and_one_that_does_not_look_ahead_never_pays(path):
    card = weights.read_card(path)
    plant, told = load_plant(card.plant, **card.options[0]), {"process": card.processes[0], "period": card.shape["period"]}
    built = make_prober(card.method, plant, **told)
    on_board = make_diagnoser(card.filters[0], plant, process=card.processes[0])
    found = fly(plant, scenarios(plant, 4, "quiet", steps=600), on_board, built, period=card.shape["period"])
    share = (found.probe > 0).mean()
    assert (share < 0.01) if card.shape["discount"] == 0.0 else share > 0.01
    with pytest.raises(NotApplicableError, match="trained for the process"):
        make_prober(card.method, plant, process="gust", period=card.shape["period"])
    assert trainers()[card.method].settings["method"] == card.method


def test_a_prober_is_trained_by_its_name_and_goes_on_where_it_was_killed(tmp_path):
    recipe = recipe_of(load_plant("B747Lateral"), decisions=32, envs=4, steps=4, validate=1, validation=2, batch=8, epochs=1)

    def run(folder, **until):
        return ProbingTraining("ppo_probes", load_plant("B747Lateral"), recipe, seed=0, work=folder).run(**until)

    whole = run(tmp_path / "whole")
    run(tmp_path / "killed", stop_after=1)
    assert run(tmp_path / "killed").read_bytes() == whole.read_bytes()
    built = make_prober("ppo_probes", load_plant("B747Lateral"), process="quiet", path=str(whole))
    assert fly(load_plant("B747Lateral"), scenarios(load_plant("B747Lateral"), 1, steps=50), silent(None), built).probe.any()
