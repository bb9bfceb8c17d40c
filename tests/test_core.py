"""Kernels, scenarios, simulation: the laws that every plant relies on."""

import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from conftest import ROOT, build

from fdi_gym import integration
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.drawing import random_sign, stream, streams, uniform
from fdi_gym.engine import no_noise, simulate, white_noise
from fdi_gym.faults import (
    Abrupt,
    Fault,
    FaultScenario,
    Hold,
    Incipient,
    Intermittent,
    Samples,
    Scoring,
    Square,
    draw,
)
from fdi_gym.plants import b747_lateral as b747
from fdi_gym.theta import theta_table
from fdi_gym.trigonometry import sincos

MOTOR = {"reference": {"levels": [100.0]}, "disturbance": {"load": 0.02}}


def test_rk4_is_of_fourth_order(motor):
    """Halving the step divides the error by 16."""
    x = np.array([[3.0, 50.0]])
    flow, steps = {}, (16, 32, 64, 2048)
    for n in steps:
        out = np.empty((1, 2))
        where, u, theta, d = (
            (motor.addresses.interval, motor.addresses.lanes),
            np.array([[12.0]]),
            np.array([[1.0, 0.5, 0.0]]),
            np.array([[0.02]]),
        )
        integration.propagate(*where, 8e-3, n, np.zeros(1), x, u, theta, d, motor.nominal_p[None], out)
        flow[n] = out
    error = [np.abs(flow[n] - flow[2048]).max() for n in steps[:3]]
    assert error[0] / error[1] == pytest.approx(16, rel=0.1)
    assert error[1] / error[2] == pytest.approx(16, rel=0.1)


def test_incipient_profiles_act_inside_the_integrator(motor):
    """A drifting parameter gives the same flight as the equation solved with the drift in it."""
    from scipy.integrate import solve_ivp

    fault = Fault("worn brush", "", 50, [Incipient("added_resistance", 2.0, 1.5)])
    scenario = FaultScenario(plant="DCMotor", steps=200, faults=[fault], **MOTOR)
    record = simulate(motor, [scenario], [no_noise(motor, 200)])
    u = record.obs[0, :, 2]

    def slope(t, x, k):
        added = 2.0 * (1 - np.exp(-1.5 * (t - 0.5))) if k >= 50 else 0.0
        return [(u[k + 1] - (1.0 + added) * x[0] - 0.05 * x[1]) / 5e-3, (0.05 * x[0] - 1e-4 * x[1] - 0.02) / 2e-4]

    x = np.zeros(2)
    for k in range(200):
        x = solve_ivp(slope, (k * 0.01, (k + 1) * 0.01), x, args=(k,), rtol=1e-11, atol=1e-12, method="Radau").y[:, -1]
    # the error that is left is the integrator's, ten substeps per sample
    assert record.state[0, -1] == pytest.approx(x, rel=2e-6)
    assert record.theta[0, 200, 1] == pytest.approx(2.0 * (1 - np.exp(-1.5 * 1.5)), rel=1e-12)


def table(effects, onset=3, end=None, steps=12, dt=0.5):
    scenario = FaultScenario(plant="p", steps=steps, faults=[Fault("m", "k", onset, effects, end)])
    return theta_table(scenario, np.array([1.0, 0.0]), ["gain", "offset"], ["left", "right"], dt)


def test_profiles():
    assert table([Abrupt("gain", 0.4)], end=6).a[:, 0].tolist() == [1] * 3 + [0.4] * 3 + [1] * 7
    drift = table([Incipient("gain", 0.0, 0.8)])
    tau = np.arange(10) * 0.5
    assert (drift.a + drift.b)[3:, 0] == pytest.approx(np.exp(-0.8 * tau))
    assert drift.g[3:, 0].tolist() == [0.8] * 10
    blink = table([Intermittent("offset", 2.0, period=2.0, duty=0.5)])
    assert blink.a[3:, 1].tolist() == [2, 2, 0, 0, 2, 2, 0, 0, 2, 2]
    wave = table([Square("offset", 1.0, -1.0, period=3.0)])
    assert wave.a[3:, 1].tolist() == [1, 1, 1, -1, -1, -1, 1, 1, 1, -1]
    given = table([Samples("offset", [5.0, 6.0])])
    assert given.a[3:, 1].tolist() == [5, 6, 6, 6, 6, 6, 6, 6, 6, 6]
    assert table([Hold("offset", "right", lag=1)], end=8).holds.tolist() == [[1, 3, 8, 1, 1]]


def test_zero_size_fault_is_healthy(b747):
    healthy = draw(b747.process("fault-free"), 4)
    nothing = healthy.replace(faults=[Fault("aileron LOE", "LOE", 300, [Abrupt("gamma_aileron", 0.0)])])
    a, b = simulate(b747, [healthy]), simulate(b747, [nothing])
    assert np.array_equal(a.obs, b.obs)
    assert (b.label[0, 301:] == 1).all()


def test_hold_with_lag_takes_the_command_before():
    plant = build("B747Lateral")
    effects = [Abrupt("gamma_aileron", -1.0), Hold("b_aileron", "aileron", lag=1)]
    scenario = b747.paper().replace(steps=400, faults=[Fault("aileron stuck", "jam", 200, effects, 300)])
    record = simulate(plant, [scenario])
    u = record.obs[0, :, 4]
    assert (record.theta[0, 201:301, 2] == u[200]).all()  # u_199, shown at sample 200
    assert (record.theta[0, 301:, 2] == 0).all()


def test_streams_are_independent():
    assert len({np.random.default_rng(s).random() for s in streams(7)}) == 4
    assert streams(7).noise.generate_state(1) == streams(7).noise.generate_state(1)


@pytest.mark.parametrize("seed", [0, 1, 7, 2**32 - 1, 2**32, 2**63 - 1, 2**64 - 1, 2**64, 2**100 + 3])
def test_a_stream_is_what_numpy_spawns_in_its_place(seed):
    for name, spawned in zip(streams(seed)._fields, np.random.SeedSequence(seed).spawn(4), strict=True):
        assert stream(seed, name).generate_state(8).tolist() == spawned.generate_state(8).tolist()


@pytest.mark.parametrize(("ours", "numpys"), [
    (lambda rng: uniform(rng, -0.3, 7.1), lambda rng: float(rng.uniform(-0.3, 7.1))),
    (random_sign, lambda rng: rng.choice([-1.0, 1.0])),
], ids=["uniform", "random_sign"])  # fmt: skip
def test_numbers_are_drawn_as_numpy_draws_them(ours, numpys):
    ours_from, numpys_from = np.random.default_rng(3), np.random.default_rng(3)
    drawn = [ours(ours_from) for _ in range(1000)]
    assert drawn == [numpys(numpys_from) for _ in range(1000)]
    assert type(drawn[0]) is float
    assert len(set(drawn)) > 1
    assert ours_from.bit_generator.state == numpys_from.bit_generator.state


def test_noise_has_the_declared_statistics(b747):
    w, v = white_noise(b747, np.random.default_rng(0), 40_000)
    assert w.std(axis=0) == pytest.approx([s.sigma for s in b747.states], rel=0.02)
    assert v.std(axis=0) == pytest.approx([s.sigma for s in b747.outputs], rel=0.02)
    assert np.abs(np.corrcoef(np.column_stack([w, v[1:]]).T) - np.eye(8)).max() < 0.025


def test_results_do_not_depend_on_the_batch(b747):
    scenarios = [draw(b747.process("hard"), s) for s in range(6)]
    together = simulate(b747, scenarios)
    for i, scenario in enumerate(scenarios):
        assert np.array_equal(simulate(b747, [scenario]).obs[0], together.obs[i])


def test_flights_of_unequal_length_repeat_their_last_row(b747):
    scenarios = [draw(b747.process("standard"), 1).replace(steps=n) for n in (50, 80)]
    record = simulate(b747, scenarios)
    assert record.length.tolist() == [50, 80]
    assert (record.obs[0, 50:] == record.obs[0, 50]).all()


def test_scenario_of_another_plant_is_refused(b747, motor):
    with pytest.raises(ValueError, match="belongs to DCMotor, not to B747Lateral"):
        simulate(b747, [draw(motor.process("standard"), 0)])


def test_scenario_that_is_none_is_refused():
    with pytest.raises(ValueError, match="not a FaultScenario"):
        FaultScenario.from_json('{"plant": 3}')


def test_scoring_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="final"):
        Scoring(decision="best of three")


def test_unknown_names_list_what_exists():
    with pytest.raises(ValueError, match="B747Lateral"):
        load_plant("Concorde")
    with pytest.raises(ValueError, match="variant, labels"):
        load_plant("B747Lateral", wing="swept")
    with pytest.raises(ValueError, match="standard, hard"):
        load_plant("B747Lateral").process("easy")


def run_python(code, **environment):
    return subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True, capture_output=True, text=True,
                          env={**os.environ, **environment}, cwd=ROOT).stdout.strip()  # fmt: skip


def test_importing_imports_nothing_heavy():
    heavy = run_python("""
        import sys, gymnasium, fdi_gym
        assert "B747Lateral-Faults-v0" in gymnasium.registry
        print(*[m for m in ("numba", "matplotlib", "torch", "stable_baselines3", "scipy", "pandas") if m in sys.modules])
    """)
    assert heavy == ""


def test_listing_compiles_nothing(tmp_path):
    loaded = run_python("""
        import sys
        from fdi_gym.cli import main
        main(["list"])
        print("loaded:", *[m for m in ("torch", "stable_baselines3", "matplotlib") if m in sys.modules])
    """, FDI_GYM_CACHE_DIR=str(tmp_path))  # fmt: skip
    assert "two_stage_kf" in loaded
    assert loaded.endswith("loaded:")
    assert not list(tmp_path.rglob("*.nbi"))


PLANT_FILE = """
from fdi_gym.kernels import kernel

@kernel
def helper(x):
    return {factor} * x

@kernel
def dynamics(t, x, u, theta, d, p, dx):
    dx[0] = helper(x[0])
"""


def test_a_changed_helper_is_never_answered_by_old_code(tmp_path):
    """Change a helper, and the next process gives the new answer; unchanged, it comes from the cache."""
    code = """
        import numpy as np, edited
        out = np.empty(1)
        e = np.empty(0)
        edited.dynamics(0.0, np.ones(1), e, e, e, e, out)
        print(out[0], sum(edited.dynamics.stats.cache_hits.values()))
    """
    where = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}", "FDI_GYM_CACHE_DIR": str(tmp_path / "cache"),
             "PYTHONDONTWRITEBYTECODE": "1"}  # fmt: skip
    source = tmp_path / "edited.py"
    source.write_text(PLANT_FILE.format(factor=1.0))
    before = source.stat()
    assert run_python(code, **where) == "1.0 0"
    assert run_python(code, **where) == "1.0 1"
    source.write_text(PLANT_FILE.format(factor=2.0))
    os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns))  # the same size and time, as a checkout may have it
    assert run_python(code, **where) == "2.0 0"


def test_an_unwritable_cache_only_costs_time(tmp_path):
    (tmp_path / "file").write_text("")
    code = "from fdi_gym.discovery import load_plant; print(load_plant('B747Lateral').env_id)"
    assert run_python(code, FDI_GYM_CACHE_DIR=str(tmp_path / "file" / "cache")) == "B747Lateral-Faults-v0"


def test_registered_plant_has_its_environment(motor):
    import dc_motor
    import gymnasium as gym

    env = gym.make("dc_motor:DCMotor-Faults-v0")
    obs, _ = env.reset(seed=0)
    assert obs.shape == (3,)
    assert motor.env_id == dc_motor.ENV == "DCMotor-Faults-v0"  # what registering it returned


def test_sines_and_cosines_are_right_to_less_than_two_rounding_units():
    rng = np.random.default_rng(0)
    near = np.concatenate([
        rng.uniform(-7, 7, 20_000), rng.uniform(-1e5, 1e5, 20_000), 10.0 ** rng.uniform(-300, 0, 2000),
        np.arange(-4000, 4001) * (np.pi / 4), [0.0],
    ])  # fmt: skip
    far = rng.uniform(-1, 1, 2000) * 10.0 ** rng.uniform(5, 15, 2000)
    for x, bound in ((near, 1.6e-16), (far, 1.6e-16 + np.spacing(np.abs(far)))):
        found = np.array([sincos(value) for value in x.tolist()]).T
        exact = np.array([np.sin(x.astype(np.longdouble)), np.cos(x.astype(np.longdouble))])
        assert (np.abs(found - exact) < bound).all()
    assert all(abs(part) <= 1.0 for value in 10.0 ** rng.uniform(5, 308, 2000) for part in sincos(value))
    assert np.isnan([sincos(value) for value in (np.nan, np.inf, -np.inf)]).all()


@pytest.mark.parametrize("name", [*plant_sources()])
def test_points_moved_side_by_side_are_moved_one_by_one(name):
    plant, rng = load_plant(name), np.random.default_rng(0)
    nominal, scale = ([getattr(s, field) for s in (*plant.states, *plant.commands)] for field in ("nominal", "scale"))
    for count in (1, 2, 3, 8, 29):
        z = nominal + 0.3 * np.array(scale) * rng.standard_normal((count, len(nominal)))
        x, u = z[:, : len(plant.states)], z[:, len(plant.states) :]
        theta = plant.nominal_theta + 0.3 * rng.random((count, len(plant.theta)))
        d, t = rng.standard_normal((count, len(plant.disturbances))), rng.uniform(0, 10, count)
        moved = plant.propagate(t, x, u, theta, d)
        assert np.isfinite(moved).all()
        alone = [plant.propagate(t[i], x[i : i + 1], u[i], theta[i], d[i])[0] for i in range(count)]
        np.testing.assert_array_equal(moved, alone)


def test_small_solves_are_lapacks():
    from fdi_gym.estimation.kalman import solve

    rng = np.random.default_rng(0)
    for m, width in ((1, 1), (4, 4), (9, 11), (14, 2)):
        S, B = rng.standard_normal((7, m, m)), rng.standard_normal((7, m, width))
        assert solve(S, B) == pytest.approx(np.linalg.solve(S, B), rel=1e-9, abs=1e-9)
        assert solve(S[0], B) == pytest.approx(np.linalg.solve(S[0], B), rel=1e-9, abs=1e-9)
    permuted = np.array([[[0.0, 1.0], [1.0, 0.0]]])  # needs its pivot
    assert solve(permuted, np.array([[[2.0], [3.0]]]))[0, :, 0].tolist() == [3.0, 2.0]
    assert not np.isfinite(solve(np.zeros((1, 2, 2)), np.ones((1, 2, 1)))).any()
