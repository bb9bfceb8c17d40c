"""The sensor layer: absent it is nothing, present it does what its table says, and it feeds back through the controller."""

import copy
import dataclasses
import functools
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from conftest import PLANTS, build
from gymnasium.utils.env_checker import check_env
from numpy.testing import assert_allclose

from fdi_gym import effects
from fdi_gym.discovery import load_plant
from fdi_gym.engine import advance, no_noise, simulate
from fdi_gym.faults import Abrupt, Fault, FaultScenario, Incipient, Intermittent, Ramp, Samples, Sampling, draw
from fdi_gym.flights import Flights
from fdi_gym.model import SENSOR_FAULTS
from fdi_gym.sensors import BIAS, KINDS, failing, of_kind, sensor_fault, sensor_mode, unit, with_sensor_faults
from fdi_gym.testing import check_plant

STEPS = 60


@functools.cache
def failing_plant(name, **options):
    return load_plant(name, sensor_faults=True, **options)


@pytest.fixture(params=[*PLANTS, "DCMotor"])
def sick(request):
    """Every plant there is, with sensors that may fail, its loop closed."""
    options = {"variant": "bare/closed"} if request.param == "B747Lateral" else {}
    return failing_plant(request.param, **options)


@pytest.fixture(scope="module")
def open_loop():
    """A plant whose sensors reach nothing: what is wrong with them shows in them alone."""
    return failing_plant("B747Lateral")


def flight(plant, *faults, steps=STEPS, seed=3, **changes):
    healthy = draw(plant.process("standard"), seed).without_faults()
    return healthy.replace(steps=steps, faults=list(faults), **changes)


def fault(sensor, *effects, onset=20, end=40):
    return Fault(sensor_mode(sensor), "", onset, list(effects), end)


def test_the_columns_of_the_engine_are_those_of_the_layer():
    assert [getattr(effects, name.upper()) for name in SENSOR_FAULTS] == list(range(effects.FAULTS))


# ---------------------------------------------------------------------------------------------------------------
# Absent


@pytest.mark.parametrize("name", [*PLANTS, "DCMotor"])
def test_sensors_that_may_fail_and_do_not_are_the_plants_to_the_byte(name):
    plain, sick = build(name), failing_plant(name)
    scenarios = [draw(plain.process("standard"), seed).replace(steps=200) for seed in range(3)]
    zero = fault(
        plain.outputs[0].name, Abrupt(f"bias_{plain.outputs[0].name}", 0.0), Abrupt(f"lag_{plain.outputs[0].name}", 0.0)
    )
    for flown in (scenarios, [s.replace(faults=[zero]) for s in scenarios]):
        a = simulate(plain, [s.without_faults() for s in flown] if flown[0].faults == [zero] else flown)
        b = simulate(sick, flown)
        assert a.obs.tobytes() == b.obs.tobytes()
        assert a.state.tobytes() == b.state.tobytes()
        assert np.array_equal(a.theta, b.theta[..., : len(plain.theta)])
        assert np.array_equal(a.target, b.target[..., : len(plain.estimated)])
        assert not b.theta[..., len(plain.theta) :].any()


@pytest.mark.parametrize("name", PLANTS)
def test_sensors_that_report_at_every_sample_are_the_plants_to_the_byte(name):
    plant = build(name)
    plain = [draw(plant.process("standard"), seed).replace(steps=200) for seed in range(3)]
    told = [s.replace(sampling=Sampling()) for s in plain]
    for a, b in zip(simulate(plant, plain), simulate(plant, told), strict=True):
        assert a.tobytes() == b.tobytes()


# ---------------------------------------------------------------------------------------------------------------
# What a fault does


@pytest.mark.parametrize(("column", "value"), [("gain", -0.3), ("bias", 0.02), ("noise", 3.0), ("frozen", 1.0), ("lag", 7.0),
                                               ("missing", 1.0)])  # fmt: skip
def test_an_effect_is_what_the_table_of_advance_says(sick, column, value):
    """One layer, two ways in: the scenario's effect, and the table that is put in by hand."""
    sensor = sick.outputs[1].name
    scenario = flight(sick, fault(sensor, Abrupt(f"{column}_{sensor}", value)))
    table = np.zeros((STEPS + 1, 1, len(sick.outputs), effects.FAULTS))
    table[20:40, 0, 1, SENSOR_FAULTS.index(column)] = value
    said = advance(Flights(sick, [scenario]), STEPS + 1)
    by_hand = advance(Flights(sick.bare, [scenario.without_faults()], longest_lag=8), STEPS + 1, sensors=table)
    assert said.obs.tobytes() == by_hand.obs.tobytes()
    assert said.state.tobytes() == by_hand.state.tobytes()
    healthy = advance(Flights(sick, [scenario.without_faults()]), STEPS + 1)
    assert said.obs[:20].tobytes() == healthy.obs[:20].tobytes()
    assert said.obs[20:40, 0, 1].tobytes() != healthy.obs[20:40, 0, 1].tobytes()  # the first false reading is the onset's


def test_a_drift_runs_straight_to_its_limit(open_loop):
    dt = open_loop.dt
    scenario = flight(open_loop, fault("beta", Ramp("bias_beta", 2.0, 10 * dt)))
    still = [no_noise(open_loop, STEPS)]
    well, ill = (simulate(open_loop, [s], still).obs[0, :, 0] for s in (scenario.without_faults(), scenario))
    expected = np.zeros(STEPS + 1)
    expected[20:40] = np.minimum(0.2 * np.arange(20), 2.0)
    assert ill - well == pytest.approx(expected, abs=1e-12)


def test_a_ramp_moves_the_plant_within_the_interval(motor):
    """Against Runge-Kutta at a hundredth of the interval, theta held: what a ramp is in the limit."""
    entry, steps = motor.theta[0], 30
    value = entry.nominal + 0.4 * (entry.high - entry.nominal) if entry.high > entry.nominal else 0.5 * entry.low
    ramp = Fault(motor.modes[0].name, "", 5, [Ramp(entry.name, value, 20 * motor.dt)])
    scenario = draw(motor.process("standard"), 0).replace(steps=steps, faults=[ramp])
    record = simulate(motor, [scenario], [no_noise(motor, steps)])
    fine = dataclasses.replace(motor, dt=motor.dt / 100, substeps=1)
    _, u, _ = motor.split(record.obs)
    d = motor.inputs(scenario).disturbance
    for k in range(5, 29):
        x = record.state[0, k : k + 1]
        for j in range(100):
            share = min((k - 5 + (j + 0.5) / 100) / 20, 1.0)
            theta = motor.nominal_theta.copy()
            theta[0] += (value - entry.nominal) * share
            x = fine.propagate(k * motor.dt + j * fine.dt, x, u[0, k + 1 : k + 2], theta[None], d[min(k, len(d) - 1)][None])
        assert record.state[0, k + 1] == pytest.approx(x[0], rel=2e-5, abs=5e-5)
    assert record.theta[0, 26:, 0] == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("effect", [
    lambda e: Incipient(e, 0.3, 2.0), lambda e: Intermittent(e, 0.3, 1.0, 0.5), lambda e: Samples(e, [0.1, 0.0, -0.2]),
])  # fmt: skip
def test_every_profile_moves_a_bias_as_it_moves_theta(open_loop, effect):
    scenario = flight(open_loop, fault("p", effect("bias_p")))
    still = [no_noise(open_loop, STEPS)]
    well, ill = (simulate(open_loop, [s], still) for s in (scenario.without_faults(), scenario))
    a, b, _, _ = open_loop.theta_table(scenario)
    entry = open_loop.theta_entries.index("bias_p")
    moved = (a + b)[: STEPS + 1, entry]
    assert ill.obs[0, :, 1] - well.obs[0, :, 1] == pytest.approx(moved, abs=1e-12)
    assert np.ptp(moved) > 0.1
    assert ill.target[0, :, open_loop.estimated.index(next(s for s in open_loop.estimated if s.name == "bias_p"))].any()


@pytest.mark.parametrize("column", ["bias", "gain", "frozen", "missing"])
def test_the_loop_is_closed(sick, column):
    """Faulty feedback moves the commands and with them the plant; healthy feedback flies the healthy flight."""
    healthy_feedback = failing_plant(
        sick.id, feedback="healthy", **({"variant": "bare/closed"} if sick.id == "B747Lateral" else {})
    )
    values = {"bias": 0.05, "gain": 0.3, "frozen": 1.0, "missing": 1.0}
    faults = [fault(s.name, Abrupt(f"{column}_{s.name}", values[column]), end=STEPS) for s in failing(sick)]
    for one in faults:
        well, ill = (advance(Flights(sick, [s]), STEPS + 1) for s in (flight(sick), flight(sick, one)))
        if not np.array_equal(well.state, ill.state):
            break
    else:
        raise AssertionError(f"{column} of no sensor reaches the plant")
    n_y, n_u = len(sick.outputs), len(sick.commands)
    u, v = (chunk.obs[:, 0, n_y : n_y + n_u] for chunk in (well, ill))
    assert np.array_equal(u[:21], v[:21])  # u_20 is the first command that hears it, shown at sample 21
    first = np.flatnonzero((u != v).any(axis=1))[0]
    assert not np.array_equal(well.state[first:], ill.state[first:])
    fed = advance(Flights(healthy_feedback, [flight(sick, one)]), STEPS + 1)
    assert fed.state.tobytes() == well.state.tobytes()
    assert fed.obs[:, 0, n_y:].tobytes() == well.obs[:, 0, n_y:].tobytes()
    shown = np.isnan(fed.obs) if column == "missing" else fed.obs != well.obs
    assert shown[20:, 0, :n_y].any()


def test_chunks_batches_threads_and_pickling_give_the_same_bytes(sick):
    sampling = Sampling(dropout=0.3, burst=4, periods={sick.outputs[0].name: 3}, delays={sick.outputs[1].name: 5})
    sensor = sick.outputs[1].name
    flown = [flight(sick, fault(sensor, Abrupt(f"lag_{sensor}", 9.0)), seed=s, sampling=sampling) for s in range(4)]
    flown[1] = flown[1].replace(sampling=Sampling())
    whole = advance(Flights(sick, flown), STEPS + 1)
    cut = Flights(sick, flown)
    parts = []
    for m in (1, 17, 30, 13):
        parts.append(advance(cut, m, threads=2))
        cut = pickle.loads(pickle.dumps(cut)) if m == 17 else copy.deepcopy(cut)
    assert np.concatenate([p.obs for p in parts]).tobytes() == whole.obs.tobytes()
    for i, one in enumerate(flown):
        assert advance(Flights(sick, [one]), STEPS + 1).obs[:, 0].tobytes() == whole.obs[:, i].tobytes()
    assert np.isnan(whole.obs[:, 0]).any()
    assert not np.isnan(whole.obs[:, 1]).any()


def test_a_slower_sensor_that_begins_leaves_the_others_their_past(open_loop):
    slow = flight(open_loop, sampling=Sampling(delays={"beta": 6}))
    slower = flight(open_loop, sampling=Sampling(delays={"p": 25}))
    alone = advance(Flights(open_loop, [slow]), STEPS + 1).obs[:, 0]
    flights = Flights(open_loop, [slow, flight(open_loop)])
    first = advance(flights, 30).obs[:, 0]
    flights.begin([1], [slower])
    rest = advance(flights, 31).obs[:, 0]
    assert np.concatenate([first, rest]).tobytes() == alone.tobytes()


# ---------------------------------------------------------------------------------------------------------------
# How sensors report


@pytest.mark.parametrize(("dropout", "burst"), [(0.1, 1.0), (0.3, 8.0), (0.6, 20.0)])
def test_dropout_has_its_share_and_its_bursts(dropout, burst):
    """20 flights of 4 sensors and 1200 samples; five standard errors, the gaps counted as independent."""
    plant = load_plant("B747Lateral", dropout=dropout, burst=burst)
    record = simulate(plant, [draw(plant.process("standard"), seed) for seed in range(20)])
    gone = np.isnan(record.obs[..., :4])
    length = burst if burst > 1 else 1 / (1 - dropout)
    gaps = int((gone[:, 1:] & ~gone[:, :-1]).sum() + gone[:, 0].sum())
    assert gone.mean() == pytest.approx(dropout, abs=5 * dropout * np.sqrt(2 / gaps))
    assert gone.sum() / gaps == pytest.approx(length, rel=0.02 + 5 / np.sqrt(gaps))
    assert gone[:, 0].mean() == pytest.approx(dropout, abs=5 * np.sqrt(dropout / 80))
    both = gone[..., 0] & gone[..., 1]
    assert both.mean() == pytest.approx(dropout**2, abs=0.02)  # sensors fail to report each for itself
    assert not np.array_equal(gone[0], gone[1])


def test_periods_delays_and_holding(open_loop):
    told = Sampling(periods={"p": 4}, delays={"r": 3})
    well, said = (advance(Flights(open_loop, [flight(open_loop, sampling=s)], [no_noise(open_loop, STEPS)]), STEPS + 1).obs
                  for s in (Sampling(), told))  # fmt: skip
    assert np.array_equal(np.isnan(said[:, 0, 1]), np.arange(STEPS + 1) % 4 != 0)
    assert np.array_equal(said[::4, 0, 1], well[::4, 0, 1])
    assert np.array_equal(said[3:, 0, 2], well[:-3, 0, 2])
    assert np.array_equal(said[:3, 0, 2], np.full(3, well[0, 0, 2]))
    held = advance(Flights(open_loop, [flight(open_loop, sampling=Sampling(periods={"p": 4}, hold=True))],
                           [no_noise(open_loop, STEPS)]), STEPS + 1).obs  # fmt: skip
    assert np.array_equal(held[:, 0, 1], well[np.arange(STEPS + 1) // 4 * 4, 0, 1])


def test_a_scenario_says_how_its_sensors_report_and_replays():
    plant = load_plant("B747Lateral", dropout=0.2, burst=5, periods={"beta": 3}, delays={"phi": 2})
    scenario = draw(plant.process("standard"), 1)
    assert scenario.sampling == Sampling(dropout=0.2, burst=5, periods={"beta": 3}, delays={"phi": 2})
    again = FaultScenario.from_json(scenario.to_json())
    assert again == scenario
    a, b = simulate(plant, [scenario]), simulate(build("B747Lateral"), [again])
    assert a.obs.tobytes() == b.obs.tobytes()
    assert "sampling" not in draw(build("B747Lateral").process("standard"), 1).to_json()


# ---------------------------------------------------------------------------------------------------------------
# What is drawn and declared


def test_a_plant_with_failing_sensors_keeps_the_laws_of_plants(sick):
    check_plant(sick, seeds=range(3))


def test_labels_and_the_estimated_quantity(sick):
    bare, sensors = sick.bare, failing(sick)
    assert [label.name for label in sick.labels] == [label.name for label in bare.labels] + [
        sensor_mode(s.name) for s in sensors
    ]
    assert [s.name for s in sick.estimated[len(bare.estimated) :]] == [f"bias_{s.name}" for s in sick.outputs]
    assert pickle.loads(pickle.dumps(sick)) == sick
    name = sensors[0].name
    record = simulate(sick, [flight(sick, fault(name, Abrupt(f"bias_{name}", unit(sensors[0]))))])
    label = sick.label_of(frozenset({sensor_mode(name)}))
    assert record.label[0].tolist() == [0] * 21 + [label] * 20 + [0] * 20
    bias = record.target[0, :, len(bare.estimated)]
    assert bias.tolist() == pytest.approx([0.0] * 21 + [unit(sensors[0])] * 20 + [0.0] * 20)
    mode = next(m for m in sick.modes if m.name == sensor_mode(name))
    assert mode.size(record.theta[0, 30]) == pytest.approx(1.0)


@pytest.mark.parametrize("name", PLANTS)
def test_mixed_draws_none_and_plant_and_sensor_faults(name):
    plant = failing_plant(name)
    drawn = [draw(plant.process("mixed"), seed) for seed in range(400)]
    sensors = {sensor_mode(s.name) for s in failing(plant)}
    kinds = [f.kind for s in drawn for f in s.faults if f.mode in sensors]
    own = sum(1 for s in drawn if s.faults and s.faults[0].mode not in sensors)
    faulty = sum(1 for s in drawn if s.faults)
    assert len(kinds) / faulty == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / faulty))
    assert own + len(kinds) == faulty
    standard = [draw(plant.process("standard"), seed) for seed in range(400)]
    assert faulty == sum(1 for s in standard if s.faults)  # the healthy ones are the standard's
    assert set(kinds) == set(KINDS)
    assert {f.mode for s in drawn for f in s.faults if f.mode in sensors} == sensors
    for scenario in drawn:
        for f in scenario.faults:
            if f.mode in sensors:
                assert 0.15 * scenario.steps - 1 <= f.onset <= 0.65 * scenario.steps
    fault_free = [draw(plant.process("fault-free"), seed) for seed in range(5)]
    assert not any(s.faults for s in fault_free)


@pytest.mark.parametrize("kind", KINDS)
def test_sizes_are_counted_in_the_sensors_own_unit(kind, open_loop):
    rng = np.random.default_rng(0)
    sensor, own = open_loop.outputs[0], unit(open_loop.outputs[0])
    assert own == pytest.approx(5 * sensor.sigma)
    drawn = [sensor_fault(rng, sensor, kind, 10, 500, 0.1).effects[0] for _ in range(200)]
    if kind in ("bias", "drift"):
        sizes = np.array([e.value for e in drawn]) / own
        assert np.abs(sizes).min() >= BIAS[0]
        assert np.abs(sizes).max() <= BIAS[1]
        assert 0.35 < (sizes > 0).mean() < 0.65
    if kind == "spikes":
        values = np.array([e.values for e in drawn])
        assert (values != 0).mean() == pytest.approx(0.1, abs=0.01)
    drawn = draw(of_kind(open_loop, kind), 0)
    assert {f.kind for f in drawn.faults} <= {kind}


def test_severity_multiplies_what_is_drawn_and_nothing_else():
    whole, mild = build("B747Lateral", sensor_faults=True), build("B747Lateral", sensor_faults=True, sensor_severity=0.25)
    met = set()
    for seed in range(150):
        for a, b in zip(draw(whole.process("mixed"), seed).faults, draw(mild.process("mixed"), seed).faults, strict=True):
            assert (a.mode, a.kind, a.onset, a.end) == (b.mode, b.kind, b.onset, b.end)
            if a.mode in whole.bare.mode_names or a.kind == "freeze":
                assert a == b
                continue
            met.add(a.kind)
            for one, other in zip(a.effects, b.effects, strict=True):
                values = (one.values, other.values) if a.kind == "spikes" else (one.value, other.value)
                assert_allclose(values[1], 0.25 * np.array(values[0]))
    assert met == set(KINDS) - {"freeze"}
    mode, soft = (next(m for m in plant.modes if m.name == sensor_mode("phi")) for plant in (whole, mild))
    assert_allclose(soft.bands, 0.25 * np.array(mode.bands))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensor_faults": True, "sensor_severity": 0.0}, "from 0.01 to 1, not 0"),
        ({"sensor_faults": True, "sensor_severity": 2.0}, "from 0.01 to 1, not 2"),
        ({"sensor_faults": True, "sensor_severity": float("nan")}, "from 0.01 to 1, not nan"),
        ({"sensor_faults": True, "sensor_severity": "mild"}, "sensor_severity"),
        ({"sensor_severity": 0.5}, "which are not asked for"),
    ],
)
def test_a_severity_that_is_none_or_of_nothing_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        build("B747Lateral", **options)


# ---------------------------------------------------------------------------------------------------------------
# Environments


def test_the_environments_take_it():
    env = gym.make("B747Lateral-Faults-v0", sensor_faults=True, process="mixed", dropout=0.2, burst=3, feedback="healthy")
    held = gym.make("B747Lateral-Faults-v0", sensor_faults=True, process="mixed", dropout=0.2, burst=3, hold=True)
    check_env(held.unwrapped, skip_render_check=True)  # it compares observations by ==, which NaN never is
    assert env.action_space.n == 9
    obs, _ = env.reset(seed=5)
    assert obs in env.observation_space
    envs = gym.make_vec("B747Lateral-Faults-v0", num_envs=3, sensor_faults=True, process="mixed", dropout=0.2, burst=3,
                        feedback="healthy")  # fmt: skip
    many, _ = envs.reset(seed=5)
    for _ in range(40):
        assert many[0].tobytes() == obs.tobytes()
        obs, *_ = env.step(0)
        many, *_ = envs.step(np.zeros(3, int))
    env.close()
    envs.close()


@pytest.mark.parametrize(("options", "message"), [
    ({"dropout": 1.0}, "dropout"), ({"dropout": -0.1}, "dropout"), ({"dropout": "often"}, "dropout"),
    ({"dropout": 0.9, "burst": 2.0}, "at least 9"), ({"burst": 0.5}, "burst"),
    ({"periods": {"beta": 0}}, "periods"), ({"periods": {"bet": 2}}, "unknown sensor 'bet'; did you mean beta"),
    ({"periods": 3}, "periods"), ({"delays": {"beta": -1}}, "delays"), ({"delays": {"x": 1}}, "delays: unknown sensor"),
    ({"delays": {"beta": 1201}}, "at most the flight's 1200"), ({"feedback": "wrong"}, "feedback"),
    ({"sensor_faults": "yes"}, "sensor_faults"),
    ({"sensor_fault": True}, "did you mean sensor_faults"), ({"feedback": "sick"}, "there are faulty, healthy"),
])  # fmt: skip
def test_bad_options_are_refused_in_words(options, message):
    with pytest.raises(ValueError, match=message):
        gym.make("B747Lateral-Faults-v0", **options)


@pytest.mark.parametrize(("effect", "message"), [
    (Abrupt("bias_bet", 0.1), "no theta entry 'bias_bet'"), (Abrupt("lag_beta", 61.0), "at most the flight's 60"),
    (Abrupt("frozen_beta", 2.0), "within"), (Abrupt("noise_beta", -1.0), "within"), (Ramp("bias_beta", 1e9, 1.0), "within"),
    (Samples("lag_beta", [0.0, 99.0]), "lags by at most"),
])  # fmt: skip
def test_bad_effects_are_refused_in_words(open_loop, effect, message):
    with pytest.raises(ValueError, match=message):
        simulate(open_loop, [flight(open_loop, fault("beta", effect))])


def test_a_lag_beyond_the_flight_is_refused(open_loop):
    with pytest.raises(ValueError, match="lags by at most the flight's 60 samples, not 61"):
        simulate(open_loop, [flight(open_loop, sampling=Sampling(delays={"p": 61}))])
    with pytest.raises(ValueError, match="may fail already"):
        with_sensor_faults(open_loop)


def test_the_page_of_sensors_is_that_of_the_rows(tmp_path):
    page = tmp_path / "sensors.md"
    subprocess.run([sys.executable, "benchmarks/sensors.py", "--page", page], check=True)
    assert page.read_text() == Path("leaderboards/sensors.md").read_text()
