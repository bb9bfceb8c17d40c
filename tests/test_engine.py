"""The engine: the same bytes however a flight is cut up, what is put into it does what it says, noise is white."""

import copy
import dataclasses
import os
import pickle
import subprocess
import sys
import textwrap
from pathlib import Path

import numba
import numpy as np
import pytest
from conftest import build
from scipy import stats

from fdi_gym import effects, noise
from fdi_gym.engine import advance, no_noise, simulate, white_noise
from fdi_gym.faults import Abrupt, Fault, Hold, Samples, draw
from fdi_gym.flights import Chunk, Flights
from fdi_gym.kernels import kernel
from fdi_gym.testing import check_plant

ROOT = Path(__file__).resolve().parents[1]


def scenarios(plant, n, steps=150):
    """Drawn flights with their faults moved into the first samples."""
    found, names = [], [name for name in ("standard", "hard") if name in plant.processes]
    for seed in range(n):
        scenario = draw(plant.process(names[seed % len(names)]), seed)
        onset = min((f.onset for f in scenario.faults), default=0)
        shift = max(onset - 20, 0)
        faults = [
            Fault(f.mode, f.kind, f.onset - shift, f.effects, None if f.end is None else f.end - shift)
            for f in scenario.faults
        ]
        faults = [f for f in faults if f.onset < steps]
        found.append(scenario.replace(steps=steps - 7 * (seed % 3), faults=faults))
    return found


def joined(chunks):
    return Chunk(*(np.concatenate(arrays) for arrays in zip(*chunks, strict=True)))


def equal(left, right, flights):
    """The same bytes at every sample that was flown."""
    for name, a, b in zip(Chunk._fields, left, right, strict=True):
        for i, last in enumerate(flights.length):
            assert a[: last + 1, i].tobytes() == b[: last + 1, i].tobytes(), f"{name} of flight {i}"


# ---------------------------------------------------------------------------------------------------------------
# The same bytes


@pytest.mark.parametrize("m", [1, 17, 256])
def test_chunks_give_the_same_bytes(plant, m):
    flown = scenarios(plant, 5)
    whole = Flights(plant, flown)
    expected = advance(whole, 151)
    parts = Flights(plant, flown)
    equal(expected, joined([advance(parts, m) for _ in range(-(-151 // m))]), whole)
    assert np.array_equal(parts.length, whole.length)
    assert parts.over.all()


@pytest.mark.parametrize("n", [7, 64])
def test_batches_give_the_same_bytes(plant, n):
    flown = scenarios(plant, n, steps=60)
    many = Flights(plant, flown)
    together = advance(many, 61)
    for i in range(0, n, 5):
        alone = Flights(plant, flown[i : i + 1])
        equal(advance(alone, 61), Chunk(*(a[:, i : i + 1] for a in together)), alone)


@pytest.mark.slow
def test_a_thousand_give_the_bytes_of_one(plant):
    flown = scenarios(plant, 1024, steps=300)
    together = simulate(plant, flown)
    for i in range(0, 1024, 101):
        alone = simulate(plant, flown[i : i + 1])
        length = alone.length[0] + 1
        for a, b in zip(alone[:5], together[:5], strict=True):
            assert a[0, :length].tobytes() == b[i, :length].tobytes()


def test_threads_give_the_same_bytes(plant):
    flown = scenarios(plant, 40)
    one, two = Flights(plant, flown), Flights(plant, flown)
    equal(advance(one, 151, threads=1), advance(two, 151, threads=2), one)


def test_who_waits_for_threads_may_do_something_else(plant):
    flown, done = scenarios(plant, 64), []
    one, two = Flights(plant, flown), Flights(plant, flown)
    chunk = advance(two, 151, threads=2, meanwhile=lambda: done.append(1) is None and len(done) < 3)
    assert len(done) <= 3
    equal(advance(one, 151, threads=1), chunk, one)


@pytest.mark.parametrize("travel", [copy.deepcopy, lambda f: pickle.loads(pickle.dumps(f))], ids=["copy", "pickle"])
def test_a_copy_in_the_middle_goes_on_with_the_same_bytes(plant, travel):
    flights = Flights(plant, scenarios(plant, 4))
    advance(flights, 53)
    other = travel(flights)
    equal_rows = advance(flights, 60), advance(other, 60)
    for a, b in zip(*equal_rows, strict=True):
        assert a.tobytes() == b.tobytes()


def test_slots_begin_anew_while_the_others_go_on(plant):
    first, later = scenarios(plant, 3), scenarios(plant, 6)[3:]
    flights = Flights(plant, first)
    advance(flights, 40)
    flights.begin([1], later[1:2])
    chunk = advance(flights, 30)
    fresh, alone = advance(Flights(plant, later[1:2]), 30), advance(Flights(plant, first), 70)
    assert chunk.obs[:, 1].tobytes() == fresh.obs[:, 0].tobytes()
    assert chunk.obs[:, 2].tobytes() == alone.obs[40:, 2].tobytes()


def test_simulate_is_advance_to_the_end(plant):
    flown = scenarios(plant, 4)
    record, flights = simulate(plant, flown), Flights(plant, flown)
    chunk = advance(flights, 151)
    assert np.array_equal(record.length, flights.length)
    for i, last in enumerate(record.length):
        assert record.obs[i, : last + 1].tobytes() == chunk.obs[: last + 1, i].tobytes()
        assert (record.obs[i, last:] == record.obs[i, last]).all()


# ---------------------------------------------------------------------------------------------------------------
# What acts


def test_a_row_kept_once_flies_as_rows_that_repeat_it(plant):
    drawn = scenarios(plant, 1)[0]
    kept = {"reference": plant.inputs(drawn).reference[-1]}
    if plant.disturbance is not None:
        kept["disturbance"] = plant.inputs(drawn).disturbance[-1]
    once = {name: lambda s, row=row: np.broadcast_to(row, (s.steps + 1, row.size)) for name, row in kept.items()}
    often = {name: lambda s, row=row: np.tile(row, (s.steps + 1, 1)) for name, row in kept.items()}
    once, often = dataclasses.replace(plant, **once), dataclasses.replace(plant, **often)
    for name in kept:
        assert len(getattr(once.inputs(drawn), name)) == 1
        assert len(getattr(often.inputs(drawn), name)) == drawn.steps + 1
    for a, b in zip(simulate(once, [drawn]), simulate(often, [drawn]), strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_reference_of_another_width_is_refused_and_the_flights_go_on(motor):
    plant = dataclasses.replace(motor, reference=lambda s: np.ones((s.steps + 1, 1 if s.noise_seed else 2)))
    good = scenarios(motor, 2)
    flights, expected = (Flights(plant, good) for _ in range(2))
    with pytest.raises(ValueError, match=r"^reference of a DCMotor scenario: .* in the shape \(\d+, 1\)"):
        flights.begin([1], [good[1].replace(noise_seed=0)])
    with pytest.raises(ValueError, match=r"^reference of a DCMotor scenario"):
        simulate(plant, [good[0].replace(noise_seed=0), good[1]])
    equal(advance(flights, 151), advance(expected, 151), flights)


@kernel
def third(r):
    return r[2]


@kernel
def control_by_a_helper(t, y, r, q, c, u):
    u[0] = third(r)


@kernel
def known_beyond(t, r, c, out):
    out[0] = 1.0


@kernel
def control_once_it_turns(t, y, r, q, c, u):
    u[0] = r[0] if y[1] < 5.0 else r[1]


NARROW = {
    "a reference": (lambda p: {"reference": lambda s: np.zeros((s.steps + 1, 0))}, "control"),
    "parameters of the controller": (lambda p: {"q": np.zeros(1)}, "control"),
    "a controller's state": (lambda p: {"c0": np.zeros(0)}, "control"),
    "disturbances": (lambda p: {"disturbances": (), "disturbance": None}, "dynamics"),
    "physical parameters": (lambda p: {"physical": lambda changes: np.zeros(0)}, "dynamics"),
    "outputs": (lambda p: {"outputs": p.outputs[:1]}, "output"),
    "what a helper reads": (lambda p: {"kernels": p.kernels._replace(control=control_by_a_helper)}, "control"),
    "known signals": (lambda p: {"kernels": p.kernels._replace(known=known_beyond)}, "known"),
}


@pytest.mark.parametrize("what", NARROW)
def test_a_kernel_that_reaches_beyond_its_arrays_is_refused_before_it_flies(motor, what):
    change, role = NARROW[what]
    plant = dataclasses.replace(motor, **change(motor))
    for _ in range(2):  # it does not pass by having been asked
        with pytest.raises(ValueError, match=rf"^DCMotor: the kernel '{role}' reaches beyond its arrays: index \d"):
            simulate(plant, [draw(plant.process("standard"), 0)])


def test_check_plant_finds_a_kernel_that_reaches_beyond_later_in_a_flight(motor):
    plant = dataclasses.replace(motor, kernels=motor.kernels._replace(control=control_once_it_turns))
    with pytest.raises(ValueError, match="the kernel 'control' reaches beyond its arrays"):
        check_plant(plant, range(1))


def test_theta_is_what_the_scenarios_table_says(plant):
    """The compiled effects against the table that NumPy makes of the same faults; holds take theirs from the commands."""
    flown = [draw(plant.process(name), seed) for name in plant.processes for seed in range(3)]
    flown = [s.replace(steps=min(s.steps, 1500), faults=[f for f in s.faults if f.onset < 1500]) for s in flown]
    record = simulate(plant, flown)
    for i, scenario in enumerate(flown):
        a, b, g, holds = plant.theta_table(scenario)
        k = np.arange(record.length[i])
        expected = (a + b * np.exp(-g * plant.dt))[k]
        for entry, onset, end, _, _ in holds:
            expected[onset:end, entry] = record.theta[i, 1:, entry][: record.length[i]][onset:end]
        assert record.theta[i, 1 : record.length[i] + 1] == pytest.approx(expected, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("lag", [0, 1, 5, 26])
def test_a_hold_keeps_the_command_of_so_many_steps_before(lag):
    plant = build("B747Lateral")
    effects = [Abrupt("gamma_aileron", -1.0), Hold("b_aileron", "aileron", lag)]
    scenario = draw(plant.process("standard"), 0).replace(steps=60, faults=[Fault("aileron stuck", "jam", 25, effects)])
    record = simulate(plant, [scenario])
    caught = record.obs[0, 26 - lag, 4] if lag <= 25 else plant.trim_command[0]
    assert (record.theta[0, 26:, 2] == caught).all()


def test_an_entry_passes_from_one_fault_to_the_next():
    plant = build("B747Lateral")
    faults = [Fault("rudder LOE", "", 10, [Abrupt("gamma_rudder", -0.5)], 20),
              Fault("rudder LOE", "", 20, [Samples("gamma_rudder", [-0.1, -0.2])], 25)]  # fmt: skip
    theta = simulate(plant, [draw(plant.process("standard"), 0).replace(steps=40, faults=faults)]).theta[0, 1:, 1]
    assert theta.tolist() == [0.0] * 10 + [-0.5] * 10 + [-0.1] + [-0.2] * 4 + [0.0] * 15


def quiet(plant, n=2, steps=60, longest_lag=0):
    flown = [s.without_faults().replace(steps=steps) for s in scenarios(plant, n)]
    return Flights(plant, flown, [no_noise(plant, steps)] * n, longest_lag)


@pytest.mark.parametrize("what", ["inputs", "sensors"])
def test_nothing_added_is_absent_to_the_byte(plant, what):
    n_y, n_u = len(plant.outputs), len(plant.commands)
    zeros = {"inputs": np.zeros((151, 5, n_u)), "sensors": np.zeros((151, 5, n_y, effects.FAULTS))}[what]
    without, with_zeros = Flights(plant, scenarios(plant, 5)), Flights(plant, scenarios(plant, 5))
    equal(advance(without, 151), advance(with_zeros, 151, **{what: zeros}), without)


def test_an_input_is_added_to_the_command_within_its_range(plant):
    n_y, n_u = len(plant.outputs), len(plant.commands)
    size = np.array([0.01 * (s.high - s.low) for s in plant.commands])
    inputs = np.zeros((61, 2, n_u))
    inputs[30, 0] = size
    inputs[40, 0] = 1e6 * size
    plain, probed = advance(quiet(plant), 61), advance(quiet(plant), 61, inputs=inputs)
    u, v = (chunk.obs[:, :, n_y : n_y + n_u] for chunk in (plain, probed))
    high = np.array([s.high for s in plant.commands])
    assert np.array_equal(u[:31], v[:31])
    assert v[31, 0] == pytest.approx(np.minimum(u[31, 0] + size, high), rel=1e-12)
    assert np.array_equal(v[41, 0], high)
    assert np.array_equal(plain.obs[:, 1], probed.obs[:, 1])  # the other flight
    assert not np.array_equal(plain.state[32, 0], probed.state[32, 0])  # it reaches the plant


def faulty_sensor(plant, column, value, at=slice(20, 40), longest_lag=0, flights=None):
    """The readings of sensor 0 of flight 0 with this fault and without; from an open loop's plant they are comparable."""
    sensors = np.zeros((61, 2, len(plant.outputs), effects.FAULTS))
    sensors[at, 0, 0, column] = value
    made = flights or (lambda: quiet(plant, longest_lag=longest_lag))
    return advance(made(), 61).obs, advance(made(), 61, sensors=sensors).obs


@pytest.fixture(scope="module")
def open_loop():
    """A plant whose sensors reach nothing: what is wrong with them shows in them alone."""
    return build("B747Lateral")


def test_gain_and_bias_of_a_sensor(open_loop):
    well, ill = faulty_sensor(open_loop, effects.GAIN, 0.25)
    expected = well.copy()
    expected[20:40, 0, 0] *= 1.25
    assert ill == pytest.approx(expected, rel=1e-14)
    well, ill = faulty_sensor(open_loop, effects.BIAS, -0.5)
    expected = well.copy()
    expected[20:40, 0, 0] -= 0.5
    assert ill == pytest.approx(expected, rel=1e-14)


def test_a_reading_stays_in_the_sensors_range(plant):
    _, ill = faulty_sensor(plant, effects.BIAS, 1e9)
    assert (ill[20:40, 0, 0] == plant.outputs[0].high).all()


def test_a_sensors_noise_grows(open_loop):
    flown = [s.without_faults().replace(steps=60) for s in scenarios(open_loop, 2)]
    rng = np.random.default_rng(0)
    drawn = [white_noise(open_loop, rng, 60) for _ in range(2)]
    for w, _ in drawn:
        w[:] = 0
    well, ill = faulty_sensor(open_loop, effects.NOISE, 2.0, flights=lambda: Flights(open_loop, flown, drawn))
    still = advance(quiet(open_loop), 61).obs
    assert ill[20:40, 0, 0] - still[20:40, 0, 0] == pytest.approx(3 * (well[20:40, 0, 0] - still[20:40, 0, 0]), rel=1e-9)
    assert np.array_equal(np.delete(ill, 0, axis=2), np.delete(well, 0, axis=2))


def test_a_frozen_sensor_repeats_its_last_reading(open_loop):
    well, ill = faulty_sensor(open_loop, effects.FROZEN, 1.0)
    expected = well.copy()
    expected[20:40, 0, 0] = well[19, 0, 0]
    assert np.array_equal(ill, expected)


def test_a_lagging_sensor_shows_the_past(open_loop):
    well, ill = faulty_sensor(open_loop, effects.LAG, 4, longest_lag=6)
    expected = well.copy()
    expected[20:40, 0, 0] = well[16:36, 0, 0]
    assert np.array_equal(ill, expected)
    with pytest.raises(ValueError, match="0 to 6"):
        faulty_sensor(open_loop, effects.LAG, 7, longest_lag=6)
    with pytest.raises(ValueError, match="0 to 0"):
        faulty_sensor(open_loop, effects.LAG, 1)


def test_a_missing_reading_is_nan_and_the_controller_goes_on_with_the_last(plant):
    _, ill = faulty_sensor(plant, effects.MISSING, 1.0)
    _, frozen = faulty_sensor(plant, effects.FROZEN, 1.0)
    assert np.isnan(ill[20:40, 0, 0]).all()
    assert np.isnan(ill).sum() == 20
    shown = ~np.isnan(ill)
    assert np.array_equal(ill[shown], frozen[shown])  # fed alike, it flies alike


def test_a_sensors_fault_reaches_the_plant_through_the_controller(plant):
    if plant.id == "B747Lateral":
        plant = build("B747Lateral", variant="bare/closed")
    sensors = np.zeros((61, 2, len(plant.outputs), effects.FAULTS))
    sensors[20:, 0, :3, effects.BIAS] = 0.05
    well, ill = advance(quiet(plant), 61), advance(quiet(plant), 61, sensors=sensors)
    assert np.array_equal(well.state[:21], ill.state[:21])
    assert not np.allclose(well.state[60, 0], ill.state[60, 0], rtol=1e-9, atol=0)
    assert np.array_equal(well.state[:, 1], ill.state[:, 1])


@pytest.mark.parametrize(("arguments", "message"), [
    ({"inputs": np.zeros((10, 2, 9))}, r"inputs .* shape \(10, 2, 2\)"),
    ({"inputs": np.full((10, 2, 2), np.nan)}, "inputs is finite"),
    ({"sensors": np.zeros((9, 2, 4, 6))}, "sensors"),
])  # fmt: skip
def test_tables_of_another_shape_are_refused(arguments, message):
    flights = quiet(build("B747Lateral"))
    with pytest.raises(ValueError, match=message):
        advance(flights, 10, **arguments)


def test_noise_of_another_shape_is_refused(plant):
    scenario = draw(plant.process("standard"), 0).replace(steps=20, faults=[])
    w, v = no_noise(plant, 20)
    for bad in ((w[:-1], v), (w, v[:, 1:]), (w, np.full_like(v, np.inf))):
        with pytest.raises(ValueError, match="noise is finite and has the shapes"):
            simulate(plant, [scenario], [bad])
    with pytest.raises(ValueError, match="at least one scenario"):
        simulate(plant, [])


# ---------------------------------------------------------------------------------------------------------------
# Noise


@pytest.mark.parametrize(("counter", "key", "words"), [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    ((0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344), (0xA4093822, 0x299F31D0),
     (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1)),
])  # fmt: skip
def test_philox_gives_the_published_vectors(counter, key, words):
    """philox4x32 10 of Random123's kat_vectors."""
    assert tuple(int(w) for w in noise.philox(*(np.uint64(v) for v in (*counter, *key)))) == words


@numba.njit
def fill(seed, start, samples, used, words, z):
    noise.fill(seed, start, samples, used, words, z)  # a helper, which kernels alone can call


def normals(seed, samples, channels=4, start=0):
    z, words = np.empty((samples, channels)), np.empty((2, samples), np.uint64)
    fill(np.uint64(seed), start, samples, np.ones(channels, bool), words, z)
    return z


def test_normals_are_normal():
    z = normals(12345, 500_000).ravel()
    n = z.size
    assert abs(z.mean()) < 4 / np.sqrt(n)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / n)
    assert abs(stats.skew(z)) < 4 * np.sqrt(6 / n)
    assert abs(stats.kurtosis(z)) < 4 * np.sqrt(24 / n)
    assert stats.kstest(z, "norm").pvalue > 1e-3
    for bound in (3.0, noise.TAIL, 4.5):  # the tail is its own code
        expected = n * 2 * stats.norm.sf(bound)
        assert abs((np.abs(z) > bound).sum() - expected) < 4 * np.sqrt(expected)
    tail = np.abs(z[np.abs(z) > noise.TAIL])
    assert stats.kstest(stats.norm.sf(tail) / stats.norm.sf(noise.TAIL), "uniform").pvalue > 1e-3


def test_normals_are_independent_across_seeds_channels_and_samples():
    n = 20_000
    columns = [normals(seed, n) for seed in (0, 1, 2, 2**32, 2**62 + 1)]
    together = np.hstack([*columns, columns[0][np.r_[1:n, 0]]])  # the last ones: a sample later
    correlation = np.corrcoef(together.T) - np.eye(together.shape[1])
    assert np.abs(correlation).max() < 5 / np.sqrt(n)
    squares = np.corrcoef((together**2).T) - np.eye(together.shape[1])
    assert np.abs(squares).max() < 5 / np.sqrt(n)


def test_a_normal_is_a_function_of_seed_sample_and_channel_alone():
    z = normals(7, 200, 6)
    assert np.array_equal(normals(7, 50, 6, start=90), z[90:140])
    assert np.array_equal(normals(7, 200, 3), z[:, :3])
    some = np.array([True, False, False, True, False, False])
    left = np.full((200, 6), np.nan)
    fill(np.uint64(7), 0, 200, some, np.empty((2, 200), np.uint64), left)
    assert np.array_equal(left[:, some], z[:, some])
    assert np.isnan(left[:, ~some]).all()


def test_noise_of_a_flight_has_the_declared_spread(plant):
    """Of the sensors, against the same flight without noise in them."""
    steps = 1500
    scenario = draw(plant.process("standard"), 0).replace(steps=steps, faults=[], noise_seed=5)
    record = simulate(plant, [scenario])
    length = int(record.length[0])
    true = plant.measure(np.arange(length + 1) * plant.dt, record.state[0, : length + 1], plant.split(record.obs[0])[1],
                         p=plant.physical(scenario.physical)[None] if scenario.physical else None,
                         d=None if plant.disturbance is None else plant.disturbance(scenario))  # fmt: skip
    error = plant.split(record.obs[0])[0] - true
    sigma = np.array([s.sigma for s in plant.outputs])
    noisy = sigma > 0
    assert error.std(axis=0)[noisy] == pytest.approx(sigma[noisy], rel=0.1)
    assert (error[:, ~noisy] == 0).all()
    assert (np.abs(error)[:, noisy] <= plant.noise_limit * sigma[noisy] * (1 + 1e-9)).all()


# ---------------------------------------------------------------------------------------------------------------
# Compiled code that was damaged

FLY = """
import numpy as np
from fdi_gym.engine import simulate
from fdi_gym.faults import draw
from fdi_gym.discovery import load_plant
plant = load_plant("B747Lateral")
print(simulate(plant, [draw(plant.process("standard"), 1).replace(steps=20, faults=[])]).obs.tobytes().hex()[-64:])
"""


def fly_in_another_process(cache):
    environment = {**os.environ, "FDI_GYM_CACHE_DIR": str(cache)}
    run = subprocess.run([sys.executable, "-c", FLY], capture_output=True, text=True, env=environment, cwd=ROOT, check=False)
    assert run.returncode == 0, run.stderr[-2000:]
    return run.stdout.strip()


def damaged(data, how, rng):
    match how:
        case "empty":
            return b""
        case "cut":
            return data[: len(data) // 2]
        case "garbage":
            return rng.bytes(len(data))
        case _:  # one bit in the machine code
            where = len(data) // 2
            return data[:where] + bytes([data[where] ^ 1]) + data[where + 1 :]


@pytest.mark.slow
@pytest.mark.parametrize("how", ["empty", "cut", "garbage", "a bit"])
def test_a_damaged_cache_is_compiled_anew(tmp_path, how):
    expected = fly_in_another_process(tmp_path)
    files = list(tmp_path.rglob("*.nb?"))
    assert {path.suffix for path in files} == {".nbi", ".nbc"}
    rng = np.random.default_rng(0)
    for path in files:
        path.write_bytes(damaged(path.read_bytes(), how, rng))
    assert fly_in_another_process(tmp_path) == expected
    assert fly_in_another_process(tmp_path) == expected


def test_a_damaged_cache_file_is_an_absent_one(tmp_path):
    """Every kind of damage to index and data of one kernel, in one process each."""
    source = tmp_path / "small.py"
    source.write_text(
        textwrap.dedent("""
        from fdi_gym.kernels import kernel
        @kernel
        def outside(t, x, r):
            return x[0] > 1.0
    """)
    )
    code = """import numpy as np, small; from fdi_gym import kernels; kernels.address(small.outside)
print(small.outside(0.0, np.array([2.0]), np.empty(0)), sum(small.outside.stats.cache_hits.values()))"""
    cache = tmp_path / "cache"

    def run():
        where = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}", "FDI_GYM_CACHE_DIR": str(cache)}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=where, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout.strip()

    assert run() == "True 0"
    assert run() == "True 1"
    rng = np.random.default_rng(0)
    for suffix, how in [(".nbi", "cut"), (".nbi", "garbage"), (".nbc", "empty"), (".nbc", "a bit")]:
        (path,) = cache.rglob(f"small*{suffix}")
        path.write_bytes(damaged(path.read_bytes(), how, rng))
        assert run() == "True 0", (suffix, how)
        assert run() == "True 1", (suffix, how)


def test_a_cache_that_cannot_be_written_costs_time_only(tmp_path):
    """Neither a folder that is none nor a full disk: files may not grow beyond 0 bytes."""
    (tmp_path / "file").write_text("")
    small = "import numpy as np; from fdi_gym import kernels; kernels.address(kernels.outside); print('compiled')"
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)); import signal; " \
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "  # fmt: skip
    for code, cache in ((small, tmp_path / "file" / "cache"), (full + small, tmp_path / "full")):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False,
                              env={**os.environ, "FDI_GYM_CACHE_DIR": str(cache)})  # fmt: skip
        assert done.stdout.strip() == "compiled", done.stderr[-2000:]
