"""The three tanks against their data sheet: check values, mass balances, controller, labels, what the processes draw."""

import collections
import dataclasses
import math

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_allclose

from fdi_gym.discovery import load_plant
from fdi_gym.engine import Flights, advance, no_noise, simulate
from fdi_gym.faults import Abrupt, Fault, FaultScenario, Incipient, Intermittent, draw
from fdi_gym.plants import three_tank as tank
from fdi_gym.sensors import sensor_mode
from fdi_gym.testing import check_plant

TRIM = (0.40, 0.20, 0.2957466063348417)
# fault, sensor 1's bias [m] from 50 on, commanded levels, sample, levels, command
CLOSED_LOOP = [
    (("leak 1", 0.3, 100), 0.0, [TRIM[:2]], 110, (0.3779500040179138, 0.19995910918405477, 0.29456902549256225), None),
    (("leak 1", 0.3, 100), 0.0, [TRIM[:2]], 400, (0.3941163009348294, 0.20109315966372832, 0.2906758419964143),
     (7.557274742369706e-05, 2.593905129093411e-05)),
    (("plug 13", 0.6, 50), 0.0, [TRIM[:2], (0.45, 0.18)], 300,
     (0.4559587447857206, 0.17587922138401335, 0.21300419210985175), (2.0339812227851305e-05, 3.351840545371186e-05)),
    (("pump loss 1", 0.5, 50), 0.0, [TRIM[:2]], 300, (0.38744356613819925, 0.1996439994303161, 0.2864140070621182),
     (6.867416773390431e-05, 2.6368257011071444e-05)),
    (None, 0.02, [TRIM[:2]], 300, (0.3791521625878655, 0.19905693284850176, 0.28517320371953064),
     (3.134031428937454e-05, 2.6212410572098762e-05)),
]  # fmt: skip


@pytest.fixture(scope="module")
def plant():
    return load_plant("ThreeTank")


def scenario_of(faults=(), steps=400, **dicts):
    return FaultScenario(plant=tank.ID, steps=steps, faults=[tank.fault(*f) for f in faults], **dicts)


def quiet(plant, scenario, bias=0.0, sensor="h1", onset=50):
    """A flight without noise, one sensor biased [m] from a sample on: the flights and what was flown."""
    if bias:
        plant = load_plant("ThreeTank", sensor_faults=True)
        fault = Fault(sensor_mode(sensor), "bias", onset, [Abrupt(f"bias_{sensor}", bias)])
        scenario = scenario.replace(faults=[*scenario.faults, fault])
    flights = Flights(plant, [scenario], [no_noise(plant, scenario.steps)])
    return flights, advance(flights, scenario.steps + 1)


def balances(h, u, theta, d, az=(0.46, 0.48, 0.58)):
    """A dh/dt [m^3/s] as the books have it: every flow on its own, from the higher side to the lower."""
    l1, l2, l3, eta1, eta2, c13, c32 = theta
    h1, h2, h3 = (max(level, 0.0) for level in h)

    def torricelli(a, drop):
        return math.copysign(a * 5e-5 * math.sqrt(2 * 9.81 * abs(drop)), drop)

    q13, q32 = torricelli(az[0] * (1 - c13), h1 - h3), torricelli(az[1] * (1 - c32), h3 - h2)
    q20 = torricelli(az[2] * (1 + d), h2)
    return np.array([
        eta1 * u[0] - q13 - torricelli(l1, h1), eta2 * u[1] + q32 - q20 - torricelli(l2, h2), q13 - q32 - torricelli(l3, h3)
    ])  # fmt: skip


def rate(plant, h, u, theta=None, d=0.0):
    theta = plant.nominal_theta if theta is None else np.array(theta, float)
    return plant.derivative(0.0, np.array(h, float), np.array(u, float), theta, np.array([d]))


def moved(plant, mode, severity):
    """theta with one fault, fully there."""
    theta = plant.nominal_theta.copy()
    (effect,) = tank.fault(mode, severity, 0).effects
    theta[plant.theta_entries.index(effect.entry)] = effect.value
    return theta


# ---------------------------------------------------------------------------------------------------------------
# Equations


def test_trim_is_the_sheets_and_an_equilibrium(plant):
    assert_allclose(plant.trim_state, TRIM, rtol=1e-14)
    assert_allclose(plant.trim_command, [3.289443551397114e-05, 2.4551922072911605e-05], rtol=1e-14)
    assert_allclose(rate(plant, plant.trim_state, plant.trim_command), 0.0, atol=1e-16)


def test_derivative_and_one_sample(plant):
    h, u = np.array([0.45, 0.15, 0.20]), np.array([5e-5, 2e-5])
    theta, d = np.array([0.1, 0.2, 0.05, 0.8, 0.9, 0.3, 0.1]), np.array([0.03])
    assert_allclose(plant.derivative(0.0, h, u, theta, d),
                    [-0.0006827184615429173, -0.0018833677528289625, 0.0006046077633629775], rtol=1e-13)  # fmt: skip
    assert_allclose(plant.propagate(0.0, h, u, theta, d),
                    [0.4493205932153972, 0.14814735870197623, 0.20058451464027036], rtol=1e-14)  # fmt: skip


@pytest.mark.parametrize(("fault", "bias", "levels", "sample", "h", "u"), CLOSED_LOOP,
                         ids=["leak 1, early", "leak 1", "plug 13", "pump loss 1", "sensor 1"])  # fmt: skip
def test_closed_loop(plant, fault, bias, levels, sample, h, u):
    """The command computed at a sample is seen at the next one."""
    scenario = scenario_of([fault] if fault else [], sample + 1, reference={"levels": levels})
    _, flown = quiet(plant, scenario, bias)
    assert_allclose(flown.state[sample, 0], h, rtol=1e-13)
    if u is not None:
        assert_allclose(plant.split(flown.obs[sample + 1, 0])[1], u, rtol=1e-12)


def test_equations_are_the_textbooks_balances(plant):
    """Anywhere, flows reversed and levels below zero included."""
    rng = np.random.default_rng(1)
    for _ in range(300):
        h, u = rng.uniform(-0.05, 0.7, 3), rng.uniform(0, 1.2e-4, 2)
        theta, d = rng.uniform(0, 1, 7), rng.uniform(-0.1, 0.1)
        assert_allclose(0.0154 * rate(plant, h, u, theta, d), balances(h, u, theta, d), rtol=1e-9, atol=1e-19)


def test_mass_is_kept(plant):
    """What flows between tanks leaves the sum alone: the volume changes by pumps, drain and leaks only."""
    rng = np.random.default_rng(2)
    for _ in range(100):
        h, u, plugs = rng.uniform(0.0, 0.6, 3), rng.uniform(0, 1.2e-4, 2), rng.uniform(0, 1, 2)
        theta = np.array([0.0, 0.0, 0.0, 1.0, 1.0, *plugs])
        drained = 0.58 * 5e-5 * math.sqrt(2 * 9.81 * h[1])
        assert 0.0154 * rate(plant, h, u, theta).sum() == pytest.approx(u.sum() - drained, rel=1e-9, abs=1e-18)


def test_a_plug_moves_two_balances_with_opposite_signs(plant):
    """Against the flow: the side from which it comes fills, the other empties."""
    for mode, (first, second) in (("plug 13", (0, 2)), ("plug 32", (2, 1))):
        for h in ((0.45, 0.15, 0.30), (0.20, 0.50, 0.35)):  # one way and the other
            change = rate(plant, h, (3e-5, 3e-5), moved(plant, mode, 0.5)) - rate(plant, h, (3e-5, 3e-5))
            assert change[first] == pytest.approx(-change[second], rel=1e-9)
            assert np.sign(change[first]) == np.sign(h[first] - h[second])
            assert change[({0, 1, 2} - {first, second}).pop()] == 0


def test_leaks_pump_losses_and_drain_move_one_balance_down(plant):
    h, u = (0.45, 0.15, 0.30), (3e-5, 3e-5)
    healthy = rate(plant, h, u)
    own = {"leak 1": 0, "leak 2": 1, "leak 3": 2, "pump loss 1": 0, "pump loss 2": 1}
    changes = {mode: rate(plant, h, u, moved(plant, mode, 0.3)) - healthy for mode in own}
    changes["drain"], own["drain"] = rate(plant, h, u, d=0.1) - healthy, 1
    for mode, change in changes.items():
        assert change[own[mode]] < 0, mode
        assert np.count_nonzero(change) == 1, mode


def test_leak_and_pump_loss_of_a_tank_differ_only_in_level_and_command(plant):
    """At one level and command the one is the other; a deeper tank shows the leak, a busier pump the loss."""
    for tank_number, (h, u) in {1: (0.4, 3e-5), 2: (0.2, 2.5e-5)}.items():
        lost = 0.1 * 5e-5 * math.sqrt(2 * 9.81 * h) / u  # as much as a leak of 0.1

        def change(mode, severity, deeper=0.0, busier=0.0, i=tank_number - 1):
            levels, command = np.array(TRIM), np.array([3e-5, 2.5e-5])
            levels[i] += deeper
            command[i] += busier
            return (rate(plant, levels, command, moved(plant, mode, severity)) - rate(plant, levels, command))[i]

        leak, loss = f"leak {tank_number}", f"pump loss {tank_number}"
        assert change(leak, 0.1) == pytest.approx(change(loss, lost), rel=1e-9)
        assert change(leak, 0.1, deeper=0.1) < change(loss, lost, deeper=0.1)
        assert change(leak, 0.1, busier=1e-5) > change(loss, lost, busier=1e-5)


def test_halving_the_step_changes_little(plant):
    scenario = scenario_of([("plug 13", 0.6, 50)], reference={"levels": [TRIM[:2], (0.45, 0.18)]})
    _, four = quiet(plant, scenario)
    _, eight = quiet(dataclasses.replace(plant, substeps=8), scenario)
    assert np.abs(four.state - eight.state).max() < 1e-9


# ---------------------------------------------------------------------------------------------------------------
# Controller


def test_the_integral_stands_still_where_the_pump_is_at_a_limit(plant):
    """Each pump for itself; elsewhere it grows by ki dt e."""
    for y, grows in (((0.40, 0.20), (True, True)), ((0.10, 0.21), (False, True)), ((0.39, 0.60), (True, False))):
        c, u, r = np.array([1e-6, -2e-6]), np.zeros(2), np.array([0.40, 0.19])
        e = r - y
        wanted = plant.trim_command + 5e-4 * e + c
        plant.kernels.control(0.0, np.array([*y, 0.3]), r, plant.q, c, u)
        assert_allclose(u, np.clip(wanted, 0.0, 1.2e-4), rtol=1e-13)
        assert (u == wanted).tolist() == list(grows)
        assert_allclose(c, np.array([1e-6, -2e-6]) + np.where(grows, 5e-6 * e, 0.0), rtol=1e-13)


def test_a_pump_leaves_its_limit_while_the_level_still_rises(plant):
    """After 400 s in which nearly nothing came of a pump at its limit: an integral wound up would overflow the tank."""
    _, flown = quiet(plant, scenario_of([("pump loss 1", 0.95, 0, 400)], 1200))
    u1, h1 = plant.split(flown.obs[:, 0])[1][:, 0], flown.state[:, 0, 0]
    assert (u1[100:400] == 1.2e-4).all()
    left = 401 + int(np.argmax(u1[401:] < 1.2e-4))
    assert h1[left] < 0.40
    assert h1.max() < 0.45
    assert h1[-1] == pytest.approx(0.40, abs=0.002)


def test_the_controller_brings_the_levels_to_their_commands(plant):
    _, flown = quiet(plant, scenario_of([("leak 2", 0.2, 50)], 3000, reference={"levels": [(0.42, 0.18)]}))
    assert_allclose(flown.state[-1, 0, :2], [0.42, 0.18], atol=1e-3)


def test_the_flight_ends_where_a_tank_overflows(plant):
    """A sensor that reads low makes the pump go on."""
    flights, flown = quiet(plant, scenario_of(steps=800, reference={"levels": [(0.60, 0.20)]}), bias=-0.1)
    k = int(flights.length[0])
    assert flights.terminated[0]
    assert k < 800
    assert flown.state[k - 1, 0].max() <= 0.62 < flown.state[k, 0].max()


# ---------------------------------------------------------------------------------------------------------------
# Scenarios


@pytest.mark.parametrize("mode", list(tank.FAULTS))
def test_a_fault_acts_from_its_onset_on_and_shows_one_sample_later(plant, mode):
    index = 1 + list(tank.FAULTS).index(mode)
    assert plant.labels[index].name == mode
    scenario = scenario_of([(mode, 0.3, 20, 40)], 60)
    (_, faulty), (_, healthy) = quiet(plant, scenario), quiet(plant, scenario.without_faults())
    differs = (faulty.state != healthy.state).any(axis=(1, 2))
    assert np.flatnonzero(differs)[0] == 21
    assert np.flatnonzero(faulty.label[:, 0]).tolist() == list(range(21, 41))
    assert set(faulty.label[21:41, 0]) == {index}
    off = np.abs(faulty.theta[:, 0] - plant.nominal_theta)
    assert np.flatnonzero(off.any(axis=1)).tolist() == list(range(21, 41))
    assert_allclose(off[21:41, index - 1], 0.3, rtol=1e-12)


def test_sizes_are_severities_and_their_bands_the_thirds(plant):
    ranges = {"leak": (0.1, 0.5), "pump": (0.2, 0.7), "plug": (0.2, 0.8)}
    for mode in plant.modes:
        low, high = ranges[mode.name.split()[0]]
        assert mode.reach == (low, high)
        assert_allclose(mode.bands, [low + (high - low) / 3, high - (high - low) / 3], rtol=1e-12)
        assert mode.size(moved(plant, mode.name, 0.25)) == pytest.approx(0.25)
        assert mode.size(plant.nominal_theta) == 0


def test_commanded_levels_step_every_200_samples_and_are_known(plant):
    levels = [[0.36, 0.14], [0.46, 0.24], [0.40, 0.20]]
    rows = tank.reference_rows(scenario_of(steps=800, reference={"levels": levels}))
    assert [rows[k].tolist() for k in (0, 199, 200, 399, 400, 800)] == [levels[i] for i in (0, 0, 1, 1, 2, 2)]
    _, flown = quiet(plant, scenario_of(steps=800, reference={"levels": levels}))
    assert np.array_equal(plant.split(flown.obs[:, 0])[2], rows)


def test_the_drain_is_first_order_gauss_markov():
    """Stationary from the start, correlation exp(-t / 100 s); the same seed gives the same course, longer or shorter."""

    def course(seed, steps=800):
        return tank.drain_rows(scenario_of(steps=steps, disturbance={"sigma": 0.02, "seed": seed}))[:, 0]

    d = np.array([course(seed) for seed in range(1500)])
    assert_allclose(d.std(axis=0)[[0, 400, 800]], 0.02, rtol=0.06)
    for lag in (1, 50, 100, 200):
        assert (d[:, lag:] * d[:, :-lag]).mean() / (d**2).mean() == pytest.approx(math.exp(-lag / 100), abs=0.03)
    assert np.array_equal(course(3), course(3))
    assert np.array_equal(course(3, 100), course(3)[:101])
    assert not np.array_equal(course(3), course(4))
    assert not tank.drain_rows(scenario_of()).any()


def test_nobody_is_told_of_the_drain(plant):
    """It is in no observation but through the levels, and the model that diagnosers get has it at rest."""
    assert plant.measured_disturbance is None
    moving = scenario_of(steps=50, disturbance={"sigma": 0.1, "seed": 1})
    (_, a), (_, b) = quiet(plant, moving), quiet(plant, moving.replace(disturbance={}))
    assert np.array_equal(a.obs[0], b.obs[0])
    assert not np.array_equal(a.state[1, 0, 1], b.state[1, 0, 1])


def test_what_does_not_fit_is_refused(plant):
    for field, value, says in (
        ("reference", {"levels": []}, "levels"), ("reference", {"levels": [[0.4, 0.7]]}, "0.6"),
        ("reference", {"levels": [[0.4]]}, "levels"), ("reference", {"level": [[0.4, 0.2]]}, "level"),
        ("disturbance", {"sigma": 0.02}, "seed is missing"), ("disturbance", {"sigma": 0.2, "seed": 1}, "0.1"),
        ("disturbance", {"sigma": 0.02, "seed": -1}, "seed"), ("physical", {"az31": 0.4}, "az31"),
        ("physical", {"az13": -0.1}, "az13"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=says):
            plant.validate(scenario_of(**{field: value}))


# ---------------------------------------------------------------------------------------------------------------
# Processes

DRAWS = 800


@pytest.fixture(scope="module")
def drawn(plant):
    return {name: [draw(plant.process(name), seed) for seed in range(DRAWS)] for name in ("standard", "hard")}


def profiles(faults):
    return collections.Counter(type(f.effects[0]) for f in faults)


def severity(fault):
    entry, healthy, *_ = tank.FAULTS[fault.mode]
    (effect,) = fault.effects
    assert effect.entry == entry
    return abs(effect.value - healthy)


def fills(values, low, high):
    """All within a range, which they fill evenly."""
    values = np.array(values)
    assert low - 1e-12 <= values.min() <= low + 0.1 * (high - low)
    assert high - 0.1 * (high - low) <= values.max() <= high + 1e-12
    assert values.mean() == pytest.approx((low + high) / 2, abs=4 * (high - low) / math.sqrt(12 * len(values)))


def near(count, share, of):
    """A count that is the share of so many draws, to four standard deviations."""
    assert count == pytest.approx(share * of, abs=4 * math.sqrt(share * (1 - share) * of))


def test_standard_draws_what_is_declared(drawn):
    flights = drawn["standard"]
    faults = [f for s in flights for f in s.faults]
    near(len(faults), 0.8, DRAWS)
    assert {len(s.faults) for s in flights} == {0, 1}
    for mode, (_, _, least, most) in tank.FAULTS.items():
        mine = [f for f in faults if f.mode == mode]
        near(len(mine), 0.8 / 7, DRAWS)
        fills([severity(f) for f in mine], least, most)
    assert {f.end for f in faults} == {None}
    fills([f.onset for f in faults], 100, 500)
    near(profiles(faults)[Incipient], 0.5, len(faults))
    assert set(profiles(faults)) == {Incipient, Abrupt}
    fills([f.effects[0].rate for f in faults if isinstance(f.effects[0], Incipient)], 0.01, 0.05)
    assert {(s.steps, s.disturbance["sigma"], len(s.physical)) for s in flights} == {(800, 0.02, 0)}


def test_hard_draws_what_is_declared(drawn):
    flights = drawn["hard"]
    assert {(s.steps, s.disturbance["sigma"], len(s.faults)) for s in flights} == {(800, 0.03, 2)}
    faults = [f for s in flights for f in s.faults]
    for mode, (_, _, least, most) in tank.FAULTS.items():
        mine = [f for f in faults if f.mode == mode]
        near(len(mine), 1 / 7, len(faults))
        fills([severity(f) for f in mine], least, (least + most) / 2)
    fills([s.faults[0].onset for s in flights], 80, 120)
    fills([s.faults[1].onset for s in flights], 430, 470)
    fills([f.end - f.onset for f in faults], 120, 240)
    for profile in (Abrupt, Incipient, Intermittent):
        near(profiles(faults)[profile], 1 / 3, len(faults))
    for name, nominal in tank.AZ.items():
        fills([s.physical[name] / nominal for s in flights], 0.98, 1.02)


@pytest.mark.parametrize("process", ["standard", "hard"])
def test_commands_and_drain_are_drawn_anew_in_every_flight(drawn, process):
    flights = drawn[process]
    levels = np.array([s.reference["levels"] for s in flights])
    assert levels.shape == (DRAWS, 4, 2)
    fills(levels[..., 0], 0.36, 0.46)
    fills(levels[..., 1], 0.14, 0.24)
    assert len({s.disturbance["seed"] for s in flights}) == DRAWS


@pytest.mark.parametrize("process", ["standard", "hard"])
def test_no_flight_overflows_or_runs_dry(plant, drawn, process):
    """The faults that are drawn don't end a flight: all of it can be scored."""
    record = simulate(plant, drawn[process][:300])
    assert not record.terminated.any()
    assert record.state.min() > 0.05
    assert record.state.max() < 0.6


def test_mismatch_is_of_the_outflow_coefficients(plant):
    rng = np.random.default_rng(0)
    factors = np.array([plant.physical(plant.perturb(rng, 0.1)) for _ in range(200)]) / plant.nominal_p
    assert_allclose(plant.nominal_p, [0.46, 0.48, 0.58])
    for column in factors.T:
        fills(column, 0.9, 1.1)
    assert np.array_equal(plant.physical(plant.perturb(rng, 0.0)), plant.nominal_p)
    assert np.array_equal(plant.physical({"az32": 0.5}), [0.46, 0.5, 0.58])


def test_the_declaration_holds_over_many_flights(plant):
    check_plant(plant, seeds=range(100, 140))


def test_environment():
    env = gym.make("ThreeTank-Faults-v0")
    assert env.observation_space.shape == (7,)
    assert env.action_space.n == 8
    first, _ = env.reset(seed=3)
    assert env.observation_space.contains(first)
    assert_allclose(first[3:5], [3.289443551397114e-05, 2.4551922072911605e-05])
    rewards, over = 0.0, False
    while not over:
        _, reward, terminated, truncated, _ = env.step(0)
        rewards, over = rewards + reward, terminated or truncated
    assert truncated
    faults = env.unwrapped.scenario.faults
    assert rewards == (faults[0].onset if faults else 799)  # label 0 is right up to the onset; sample 800 is not asked
