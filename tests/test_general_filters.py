"""The filters that need nothing but a plant's declaration: model, prior, filters, alarms, calibration."""

import dataclasses
import inspect
import itertools
import json

import numpy as np
import pytest
from conftest import PLANTS, build
from scipy.optimize import lsq_linear
from scipy.stats import betabinom

from baselines.filters import ascdkf, augmented_kf, two_stage_kf
from fdi_gym.diagnosis import NotApplicableError, diagnosers, make_diagnoser, run
from fdi_gym.engine import simulate
from fdi_gym.estimation import calibration, unknown_inputs
from fdi_gym.estimation import prior as prior_file
from fdi_gym.estimation.alarm import (
    TESTS,
    Declared,
    Estimate,
    Evidence,
    Persistence,
    Thresholds,
    chi_square_test,
    cusum_test,
    declare,
    gain,
    glr_test,
    penalties,
)
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.decision import Manifolds, nearest_of
from fdi_gym.estimation.gaussian import RULES, advance, start
from fdi_gym.estimation.linear import linear_model
from fdi_gym.estimation.prior import VALIDATION_SEED, flights_of, long_run, prior
from fdi_gym.faults import draw
from fdi_gym.plants import b747_lateral as b747_file
from fdi_gym.plants import huav_hover

ALL_PLANTS = [*PLANTS, "DCMotor"]
SMALL = 5e-3
LEARNED = ("sequence_net", "residual_net")
TOLD = [name for name, entry in diagnosers().items() if "process" in inspect.signature(entry.build).parameters]
GENERAL = [name for name in TOLD if name not in LEARNED]
FAMILY = ("ascdkf", "three_stage_cdkf", "three_stage_ekf", "robust_three_stage_cdkf", "robust_three_stage_ekf")


def flown(plant, process="standard", flights=2, first=900_000):
    """Flights with validation seeds that nothing else uses."""
    scenarios = [draw(plant.process(process), VALIDATION_SEED + first + i) for i in range(flights)]
    return scenarios, simulate(plant, scenarios)


def followed(model, rule, obs, first_sample=True):
    """The filter's state after each sample."""
    s = start(model, len(obs))
    for k in range(obs.shape[1]):
        s = advance(model, RULES[rule], s, obs[:, k], first_sample)
        yield s


# -- on a linear plant there is one answer


@pytest.mark.parametrize("first_sample", [True, False])
@pytest.mark.parametrize("process", ["standard", "gust"])
def test_on_a_linear_plant_they_are_the_kalman_filter(b747, process, first_sample):
    """Written out once more from the textbook: F = [[A, E(u), Ed], [0, I, 0], [0, 0, 1]], H = [C, 0, 0]."""
    model = augmented(b747, process)
    linear, n_d = linear_model(b747), int(process == "gust")
    N, obs = 8 + n_d, flown(b747, process, 1)[1].obs[:, :200]
    Ed = b747_file.gust_input(b747_file.A_PRINTED)
    H = np.hstack([linear.C, np.zeros((4, 4 + n_d))])
    X, P, expected = np.zeros(N), model.P0, []
    for k, (y, u) in enumerate(zip(obs[0, :, :4], obs[0, :, 4:6], strict=True)):
        if k:
            F = np.eye(N)
            F[:4, :4], F[:4, 4:8] = linear.A, linear.E(u[None])[0]
            if n_d:
                F[:4, 8] = Ed
            X = F @ X
            X[:4] += linear.B @ u
            P = F @ P @ F.T + model.Q
            assert (np.diag(P) < model.limit).all(), "the cap on the walk must not bind here"
        if k or first_sample:
            S = H @ P @ H.T + b747.R
            K = P @ H.T @ np.linalg.inv(S)
            X, P = X + K @ (y - H @ X), (np.eye(N) - K @ H) @ P
        expected.append((X, P))
    for rule in RULES:
        for s, (X, P) in zip(followed(model, rule, obs, first_sample), expected, strict=True):
            assert s.X[0] == pytest.approx(X, rel=1e-9, abs=1e-9)
            assert s.P[0] == pytest.approx(P, rel=1e-9, abs=1e-9)


# -- the general method is the special one on the special one's plant


@pytest.mark.parametrize("rule", RULES)
def test_general_filter_is_the_augmented_kf_with_its_tuning(b747, rule):
    tuning = {"x0_std": [0.1] * 4, "z0_std": [1.0, 1.0, 2.0, 2.0], "z_walk": [0.01] * 4}
    model = augmented(b747, **tuning)
    model = model._replace(limit=np.full(8, np.inf))
    obs = flown(b747)[1].obs[:, :200]
    said = run(make_diagnoser("augmented_kf", b747, q_bias=1e-4, forgetting="none"), obs)
    P_x, P_z = two_stage_kf.prior(b747)
    special, linear = augmented_kf.start(2, 4, P_x, P_z), linear_model(b747)
    for k, s in enumerate(followed(model, rule, obs, False)):
        if k:
            y, u, _ = b747.split(obs[:, k])
            special = augmented_kf.step(special, u, y, linear, b747.Q, b747.R, special.Pz + 1e-4 * np.eye(4))
            assert s.nu == pytest.approx(special.nu, rel=1e-9, abs=1e-9)
            assert s.S == pytest.approx(special.S, rel=1e-9, abs=1e-9)
        assert s.X == pytest.approx(special.X, rel=1e-9, abs=1e-9)
        assert s.P == pytest.approx(special.P, rel=1e-9, abs=1e-9)
        assert s.X[:, 4:] == pytest.approx(said.estimate[:, k], rel=1e-9, abs=1e-9)


def test_general_central_difference_filter_is_the_ascdkf_with_its_tuning():
    plant = build("HUAVHover")
    model = augmented(plant, x0_std=huav_hover.X0_STD, z0_std=[2e-3] * 4, z_walk=[7e-4] * 4)
    P0, Q = model.P0.copy(), model.Q.copy()
    P0[15:, 15:], Q[:11, :11], Q[15:, 15:] = 0.5**2 * np.eye(2), plant.Q, 0.05**2 * np.eye(2)
    model = model._replace(P0=P0, Q=Q, R=plant.R, limit=np.full(17, np.inf))
    obs = flown(plant)[1].obs[:, :120]
    diagnoser = ascdkf.ascdkf(plant, **plant.tuning["ascdkf"])
    state = diagnoser.init(2)
    for k, s in enumerate(followed(model, "central difference", obs, False)):
        state, _ = diagnoser.update(state, obs[:, k])
        std = np.sqrt(np.einsum("nii->ni", state[1].P))
        assert s.X / std == pytest.approx(state[1].x / std, abs=1e-8)
        assert s.P / (std[:, :, None] * std[:, None]) == pytest.approx(
            state[1].P / (std[:, :, None] * std[:, None]), abs=1e-8
        )


def test_walk_widens_no_fault_beyond_its_limit(b747):
    model = augmented(b747, walk=50.0)
    root = np.random.default_rng(0).standard_normal((3, 8, 8))
    wide = root @ np.swapaxes(root, 1, 2) * 20
    P = model.limited(wide)
    variance, before = (np.einsum("nii->ni", M) for M in (P, wide))
    assert (before[:, 4:] > model.limit[4:]).any()
    assert variance == pytest.approx(np.minimum(before, model.limit), rel=1e-12)
    correlation = [M / np.sqrt(v[:, :, None] * v[:, None]) for M, v in ((P, variance), (wide, before))]
    assert correlation[0] == pytest.approx(correlation[1], abs=1e-12)
    assert np.array_equal(model.limited(0 * wide), 0 * wide)
    obs = np.zeros((1, 300, 6))  # nothing is commanded: an effectiveness cannot be seen, and its variance would grow
    for s in followed(model, "extended", obs):
        assert (np.einsum("nii->ni", s.P)[:, 4:] <= model.limit[4:] * (1 + 1e-12)).all()
    assert s.P[0, 4, 4] == pytest.approx(model.limit[4])


# -- the model


def intervals(model, flights=3, count=4):
    """X (n, N) and Interval along simulated flights, off the estimate by the typical scales."""
    plant, rng = model.plant, np.random.default_rng(5)
    record = flown(plant, flights=flights)[1]
    for k in rng.integers(5, int(record.length.min()), count):
        before = model.read(int(k) - 1, record.obs[:, k - 1], np.zeros((flights, len(plant.known))))[1]
        at, _ = model.read(int(k), record.obs[:, k], before)
        X = np.tile(model.X0, (flights, 1))
        X[:, model.x] = record.state[:, k - 1]
        X[:, model.z] += 0.2 * rng.standard_normal(X[:, model.z].shape) * model.scale[model.z]
        X[:, model.d] += 0.2 * rng.standard_normal(X[:, model.d].shape) * model.scale[model.d]
        yield X, at


@pytest.mark.parametrize("plant_id", ALL_PLANTS)
@pytest.mark.parametrize("function", ["f", "h"])
def test_jacobian(plant_id, function):
    """Against a five-point difference with another step."""
    model = augmented(build(plant_id))
    N = len(model.scale)
    of = model.f if function == "f" else model.h
    for X, at in intervals(model):
        mean, J = model.jacobian(function, X, at)
        assert mean == pytest.approx(of(X[:, None], at)[:, 0], rel=1e-12, abs=1e-12)
        step = 4e-4 * model.scale
        values = [of(X[:, None] + j * np.diag(step), at) for j in (-2, -1, 1, 2)]
        five = np.swapaxes(values[0] - 8 * values[1] + 8 * values[2] - values[3], 1, 2) / (12 * step)
        unit = np.abs(five * model.scale).max(axis=2, keepdims=True) / model.scale
        assert J.shape == five.shape == (len(X), mean.shape[1], N)
        assert J / unit == pytest.approx(five / unit, abs=1e-5)


@pytest.mark.parametrize("plant_id", ALL_PLANTS)
def test_model_is_the_flight_without_noise(plant_id):
    """f and h, fed with the true state, fault and disturbance, are what flew but for the declared noise.

    A fault that grows within a sample is held there by the model: SMALL, in units of the states' scales.
    """
    plant = build(plant_id)
    model = augmented(plant)
    p = model.prior
    scenarios = [draw(plant.process("standard"), VALIDATION_SEED + 900_000 + i).replace(physical={}) for i in range(8)]
    record = simulate(plant, scenarios)
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)
    ends = [(0, 2, *np.flatnonzero(record.label[i])[:2], record.length[i] - 1) for i in range(8)]
    seen = 0
    for i, end in enumerate(ends):
        for k in (1, *(int(j) + 1 for j in end)):
            known = plant.split(record.obs[i : i + 1, k - 1])[2]
            at, _ = model.read(k, record.obs[i : i + 1, k], known)
            X = model.X0[None].copy()
            X[:, model.x] = record.state[i, k - 1]
            X[:, model.z] = record.target[i, k] - healthy
            if len(p.disturbances):
                X[:, model.d] = plant.disturbance(scenarios[i])[k - 1, p.disturbances]
            seen += record.label[i, k] > 0
            moved = model.f(X[:, None], at)[0, 0, model.x]
            error = np.abs(moved - record.state[i, k])
            assert (error <= 6 * np.sqrt(np.diag(plant.Q)) + SMALL * np.array([s.scale for s in plant.states])).all()
            X[:, model.x] = record.state[i, k]
            error = np.abs(at.y - model.h(X[:, None], at)[0, 0])
            assert (error <= 6 * np.sqrt(np.diag(p.R)) + 1e-9).all()
    assert seen >= 4


def test_measured_disturbance_of_the_missile():
    plant = build("MissilePitch")
    model = augmented(plant)
    scenarios, record = flown(plant, flights=3)
    known = np.zeros((3, len(plant.known)))
    rows = np.array([plant.disturbance(s)[0] for s in scenarios])
    assert np.ptp(rows, axis=0).min() > 0
    for k in range(int(record.length.min()) + 1):
        at, known = model.read(k, record.obs[:, k], known)
        if k:
            assert at.d == pytest.approx(rows, abs=1e-12)


# -- the prior


@pytest.fixture
def few_flights(monkeypatch):
    """Priors from four flights; none is kept."""
    monkeypatch.setattr(prior_file, "FLIGHTS", 4)
    monkeypatch.setattr(prior_file, "_found", {})


@pytest.mark.parametrize(("plant_id", "process"), [*((p, "fault-free") for p in ALL_PLANTS), ("B747Lateral", "hard"),
                                                   ("MissilePitch", "standard"), ("MissilePitch", "hard")])  # fmt: skip
def test_prior_noise_is_the_declared_one_and_the_models_errors(few_flights, plant_id, process):
    plant = build(plant_id)
    p = prior(plant, process)
    noisy = np.flatnonzero(np.diag(plant.Q))
    R = plant.R[np.ix_(p.sensors, p.sensors)]
    assert np.array_equal(p.sensors, [i for i, s in enumerate(plant.outputs) if s.sigma > 0])
    assert (np.linalg.eigvalsh(p.Q) > 0).all()
    if any(s.physical for s in flights_of(plant, process, 0, 4, False)[0]):
        more = p.Q - plant.Q
        assert np.linalg.eigvalsh(more).min() >= -1e-12 * np.abs(more).max()
        assert np.linalg.eigvalsh(p.R - R).min() >= -1e-12 * np.abs(R).max()
        floor = (prior_file.FLOOR * np.array([state.scale for state in plant.states])) ** 2
        assert (np.diag(more) > 2 * floor).any()
    else:
        assert np.array_equal(p.Q[np.ix_(noisy, noisy)], plant.Q[np.ix_(noisy, noisy)])
        assert np.array_equal(p.R, R)


def test_prior_of_mismatch_is_there_where_the_plant_flies_off_the_model(few_flights, b747):
    assert any(s.physical for s in flights_of(b747, "hard", 0, 4, False)[0])
    assert not any(s.physical for s in flights_of(b747, "fault-free", 0, 4, False)[0])


def test_long_run_of_white_noise_is_its_covariance_and_of_a_constant_grows_with_the_block():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((3, 3))
    C = root @ root.T
    e = rng.standard_normal((60, 1000, 3)) @ root.T
    valid = np.ones((60, 1000), bool)
    for block, n in ((1, 60_000), (20, 3000)):
        spread = np.sqrt((C**2 + np.outer(np.diag(C), np.diag(C))) / n)
        assert (np.abs(long_run(e, valid, block) - C) < 4.5 * spread).all()
    c = np.array([1.0, -2.0, 0.5])
    assert long_run(np.tile(c, (4, 100, 1)), np.ones((4, 100), bool), 10) == pytest.approx(10 * np.outer(c, c))
    short = np.arange(100) < np.array([100, 35, 5, 0])[:, None]  # only whole blocks count
    e = np.where(short[..., None], c, 1e6)
    assert long_run(e, short, 10) == pytest.approx(10 * np.outer(c, c))


def test_seeds_are_those_of_validation(monkeypatch, few_flights, motor):
    seeds = {}

    def noted(process, seed, *rest):
        seeds.setdefault(stage, set()).add(seed)
        return draw(process, seed, *rest)

    monkeypatch.setattr(prior_file, "draw", noted)
    stage = "prior"
    prior(motor)
    stage = "calibration"
    calibration._healthy_flights(motor, "standard")
    flights_of(motor, "standard", unknown_inputs.FIRST, unknown_inputs.FLIGHTS, False)
    assert len(seeds["prior"]) == 4
    assert 20 <= len(seeds["calibration"]) <= 100
    assert not seeds["prior"] & seeds["calibration"]
    for used in seeds.values():
        assert min(used) >= 2_000_000
        assert max(used) < 3_000_000


# -- alarms


def white(n, steps, m, jump=None, seed=0):
    """Estimates with white innovations of covariance S; from the middle on their mean is `jump` standard deviations."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((m, m)) + 2 * np.eye(m)
    S = np.tile(root @ root.T, (n, 1, 1))
    L = np.linalg.cholesky(S[0])
    for k in range(steps):
        e = rng.standard_normal((n, m))
        if jump is not None and k >= steps // 2:
            e = e + jump
        yield Estimate(np.zeros((n, 0)), np.zeros((n, 0, 0)), e @ L.T, S)


def statistics(test, estimates, n, m):
    state, found = test.start(n, m), []
    for e in estimates:
        state, value = test.step(state, e)
        found.append(value)
    return np.array(found).T


def test_statistics_of_white_innovations():
    n, steps, m = 4000, 120, 3
    chi = statistics(chi_square_test(20), white(n, steps, m), n, m)[:, -1]
    std = np.sqrt(2 * m / 39)  # of the mean with memory 20
    assert abs(chi.mean()) < 4.5 * std / n**0.5
    assert chi.std() == pytest.approx(std, rel=0.1)
    window = statistics(glr_test((7,)), white(n, steps, m, seed=1), n, m)[:, -1]  # chi-square with m degrees of freedom
    assert abs(window.mean() - m) < 4.5 * np.sqrt(2 * m / n)
    assert window.var() == pytest.approx(2 * m, rel=0.2)
    drift = statistics(cusum_test(0.5), white(n, steps, m, seed=2), n, m)
    assert drift[:, -1].mean() == pytest.approx(drift[:, 60].mean(), rel=0.15)  # it stays where it is


@pytest.mark.parametrize("name", TESTS)
def test_a_jump_raises_the_statistic(name):
    n, steps, m = 200, 100, 3
    found = statistics(TESTS[name](), white(n, steps, m, jump=1.0), n, m)
    assert np.median(found[:, -1]) > np.quantile(found[:, 45], 0.99)


def test_glr_is_the_largest_over_all_windows():
    n, steps, m = 5, 60, 3
    estimates = list(white(n, steps, m, seed=4))
    windows = (2, 5, 10, 20, 40)
    found = statistics(glr_test(windows), estimates, n, m)
    e = np.array([np.linalg.solve(np.linalg.cholesky(s.S), s.nu[..., None])[..., 0] for s in estimates])  # (steps, n, m)
    for k in range(steps):
        ratios = [(e[k + 1 - w : k + 1].sum(axis=0) ** 2).sum(axis=1) / w for w in windows if w <= k + 1]
        assert found[:, k] == pytest.approx(np.max(ratios, axis=0) if ratios else np.zeros(n), rel=1e-9, abs=1e-12)


def test_cusum_is_the_largest_sum_that_ends_now():
    n, steps, m = 5, 40, 3
    estimates = list(white(n, steps, m, jump=0.8, seed=5))
    found = statistics(cusum_test(0.5), estimates, n, m)
    excess = np.array([[v @ np.linalg.solve(S, v) - 1.5 * m for v, S in zip(s.nu, s.S, strict=True)] for s in estimates])
    for k in range(steps):
        sums = np.cumsum(excess[k::-1], axis=0).max(axis=0)
        assert found[:, k] == pytest.approx(np.maximum(sums, 0), rel=1e-9, abs=1e-9)


def declared(costs, rises=None, rise=None, after=None):
    """Labels after each of these costs (samples, labels) of one episode; the penalty of a fault is 10."""
    after = after or Persistence(2, 3, 4)
    s, labels = Declared(*(np.zeros(1, np.int64) for _ in range(4))), ""
    for k, cost in enumerate(costs):
        risen = None if rises is None else np.array([float(rises[k])])
        e = Evidence(np.array([cost], float), np.zeros((1, 0)), rise=risen)
        s = declare(s, e, np.array([0.0, 10.0, 10.0]), rise, after)
        labels += ".AB"[int(s.label[0])]
    return labels


def test_declaration():
    none, a, b, weak = (0, 0, 0), (20, 0, 15), (20, 15, 0), (20, 12, 20)  # weak: a gain of 0.8 of what it must be
    low = (20, 16, 20)  # 0.4
    assert declared([a, a, a]) == ".AA"
    assert declared([a, none, a, none]) == "...."
    assert declared([weak] * 5) == "....."
    assert declared([a, b, b]) == ".BB"  # the alarm needs two in a row, its label is the best at the end
    assert declared([a, a, b, b, b, b]) == ".AAABB"
    assert declared([a, a, b, b, a, b, b, b]) == ".AAAAAAB"
    assert declared([a, a] + [weak] * 6) == ".AAAAAAA"  # hysteresis
    assert declared([a, a] + [low] * 5) == ".AAAA.."
    assert declared([a, a, low, low, low, weak, low, low, low, low]) == ".AAAAAAAA."
    assert declared([a, a, none, none, none, none, a, a]) == ".AAAA..A"
    # a statistic of its own raises the alarm; the costs keep it
    assert declared([a] * 4, rises=[0, 0, 0, 0], rise=1.0) == "...."
    assert declared([weak] * 4, rises=[2, 2, 0, 0], rise=1.0) == ".AAA"
    assert declared([a] * 3, rises=[1, 1, 1], rise=1.0) == "..."  # not above it
    # a release wins over a switch
    assert declared([a, a] + [(20, 20, 16)] * 4, after=Persistence(2, 4, 4)) == ".AAAA."


def test_penalties_and_gain():
    plant = build("B747Lateral", labels="dual")
    found = penalties(plant, Thresholds((1.0, 2.0, 4.0, 8.0)))
    expected = {"none": 0, "aileron LOE": 1, "aileron stuck": 2, "rudder LOE": 4, "rudder stuck": 8,
                "aileron LOE + rudder stuck": 9, "aileron stuck + rudder LOE": 6}  # fmt: skip
    for i, label in enumerate(plant.labels):
        assert found[i] == sum({m.name: 2.0**j for j, m in enumerate(plant.modes)}[name] for name in label.modes)
        assert found[i] == expected.get(label.name, found[i])
    cost = np.array([[10.0, 8.0, 2.0], [0.0, 5.0, 9.0]])
    assert gain(cost, np.array([0.0, 4.0, 2.0])) == pytest.approx([4.0, -1.25])


# -- the closest point of a label's set


@pytest.mark.parametrize("f", [1, 2, 3, 4])
def test_nearest_point_of_a_box(f):
    """Against an active-set least-squares solver."""
    rng = np.random.default_rng(f)
    p, h, n, at_bounds = 5, 3, 20, 0
    sets = Manifolds(
        np.arange(1, h + 1), rng.standard_normal((h, p)), rng.standard_normal((h, p, f)),
        -rng.uniform(0, 0.6, (h, f)), rng.uniform(0, 0.6, (h, f)),
    )  # fmt: skip
    root = rng.standard_normal((n, p, p)) + np.eye(p)
    z = rng.standard_normal((n, p))
    information = np.swapaxes(root, 1, 2) @ root
    value, m = nearest_of(information, (information @ z[..., None])[..., 0], sets)
    for i, j in itertools.product(range(n), range(h)):
        A, b = root[i] @ sets.direction[j], root[i] @ (z[i] - sets.offset[j])
        best = lsq_linear(A, b, (sets.low[j], sets.high[j]), method="bvls", tol=1e-14)
        q = sets.offset[j] + sets.direction[j] @ best.x
        assert value[i, j] == pytest.approx(q @ information[i] @ q - 2 * q @ information[i] @ z[i], rel=1e-8, abs=1e-8)
        assert m[i, j] == pytest.approx(best.x, abs=1e-6)
        at_bounds += (best.active_mask != 0).any()
    assert 0 < at_bounds < n * h or f > 2
    Iz = z @ information[0]
    one, many = nearest_of(information[:1], Iz, sets), nearest_of(np.tile(information[:1], (n, 1, 1)), Iz, sets)
    assert np.array_equal(one[0], many[0])  # one information for all
    assert np.array_equal(one[1], many[1])


# -- calibration


@pytest.mark.parametrize("rate", [0.05, 0.5])
def test_share_of_flights_with_a_false_alarm_is_the_rate(monkeypatch, b747, rate):
    """On fresh flights. The threshold is the r-th smallest of N healthy flights' statistics, so the probability that a
    fresh flight exceeds it is Beta(N - r + 1, r), and the number that do is beta-binomial: calibration's own sampling
    error is in the interval."""
    N, fresh = 30, 60
    monkeypatch.setattr(calibration, "SAMPLES", N * 1200)
    monkeypatch.setattr(calibration, "_kept", {})
    monkeypatch.setattr(calibration, "cache_folder", lambda source: None)
    monkeypatch.setattr(calibration.thresholds_of, "__defaults__", (calibration.PERSISTENCE, rate))
    obs = flights_of(b747, "standard", 800_000, fresh, False)[1].obs
    alarms = run(make_diagnoser("augmented_ukf", b747), obs).alarm.any(axis=1).sum()
    r = int(np.ceil((1 - rate) * (N - 1))) + 1
    low, high = betabinom.interval(0.999, fresh, N - r + 1, r)
    assert low <= alarms <= high
    assert high < fresh


def test_calibrations_are_kept_and_an_edit_shows(monkeypatch, tmp_path, motor):
    calls = []

    def compute():
        calls.append(1)
        return {"modes": [1.0, 2.0], "rise": None}

    source = tmp_path / "method.py"
    source.write_text("x = 1\n")

    def folder_of(source):
        return tmp_path

    monkeypatch.setattr(calibration, "_kept", {})
    monkeypatch.setattr(calibration, "cache_folder", folder_of)

    def ask(plant=motor, process="standard", what="a", forget=False):
        if forget:
            calibration._kept.clear()
        found = calibration.once(plant, process, str(source), what, compute)
        assert found == {"modes": [1.0, 2.0], "rise": None}
        return len(calls)

    assert [ask(), ask(), ask(forget=True)] == [1, 1, 1]  # computed, in memory, on disk
    (path,) = tmp_path.glob("calibration-*.json")
    assert json.loads(path.read_bytes()) == {"modes": [1.0, 2.0], "rise": None}
    assert ask(what="b") == 2
    assert ask(process="fault-free") == 3
    assert ask(plant=build("B747Lateral")) == 4
    assert ask(plant=build("B747Lateral", labels="dual")) == 5
    monkeypatch.setattr(calibration, "_source_of", lambda plant: "edited")
    assert ask() == 6


# -- every general method, on every plant


@pytest.mark.parametrize("plant_id", ALL_PLANTS)
@pytest.mark.parametrize("name", GENERAL)
def test_builds_or_says_why_not(monkeypatch, plant_id, name):
    def fly(*_):
        raise AssertionError("a builder does not calibrate")

    monkeypatch.setattr(calibration, "flights_of", fly)
    monkeypatch.setattr(unknown_inputs, "flights_of", fly)
    plant, entry = build(plant_id), diagnosers()[name]
    known = {"scenarios": [draw(plant.process("standard"), 0)]} if entry.clairvoyant else {}
    reason = ""
    try:
        entry.build(plant, **entry.settings_on(plant), **known)
    except NotApplicableError as error:
        reason = str(error) or "none given"
    assert not reason or (len(reason) > 20 and name in FAMILY), reason
    if not reason:
        with pytest.raises(ValueError, match="unknown scenario"):
            entry.build(plant, **{**entry.settings, **known, "process": "no such"})


@pytest.mark.parametrize(("name", "plant_id", "reason"), [
    ("three_stage_cdkf", "CMGSatellite", "no unknown input"), ("three_stage_ekf", "MissilePitch", "y = H x"),
    ("three_stage_cdkf", "DCMotor", "y = H x"), ("ascdkf", "MissilePitch", "y = H x"),
    ("robust_three_stage_cdkf", "B747Lateral", r"rank H\[B E\] = 5 .* it is 3"),
    ("robust_three_stage_ekf", "CMGSatellite", r"rank H\[B E\] = 4 .* it is 0"),
])  # fmt: skip
def test_reasons_of_the_three_stage_family(name, plant_id, reason):
    with pytest.raises(NotApplicableError, match=reason):
        make_diagnoser(name, build(plant_id))


@pytest.mark.parametrize("process", ["standard", "gust"])
@pytest.mark.parametrize("name", ["ascdkf", "three_stage_cdkf", "three_stage_ekf"])
def test_three_stage_family_is_the_general_augmented_filter_on_the_747(short_calibrations, b747, name, process):
    """With the process's own prior, where that has a gust; without one it adds a disturbance that is as good as none."""
    model = augmented(b747, process)
    model = model._replace(limit=np.full(len(model.limit), np.inf))
    obs = flown(b747, process)[1].obs[:, :200]
    said = run(make_diagnoser(name, b747, process=process), obs)
    for k, s in enumerate(followed(model, "extended", obs, False)):
        std = np.sqrt(np.einsum("nii->ni", s.P))[:, 4:8]
        tolerance = 1e-6 if process == "gust" else 0.02
        assert (s.X[:, 4:8] - said.estimate[:, k]) / std == pytest.approx(np.zeros((2, 4)), abs=tolerance)
        assert std == pytest.approx(said.estimate_std[:, k], rel=tolerance)


def test_flags_are_calibrated_where_the_table_has_no_thresholds(short_calibrations):
    """On healthy flights, when the first sample is seen."""
    plant = build("HUAVHover", kappa=0.5)
    obs = flights_of(plant, "standard", 800_000, 3, False)[1].obs[:, :120]
    diagnoser = make_diagnoser("three_stage_cdkf", plant)
    assert not calibration._kept
    said = run(diagnoser, obs)
    (thresholds,) = calibration._kept.values()
    assert np.shape(thresholds) == (4,)
    assert min(thresholds) > 0
    assert not said.alarm[:, :10].any()


def test_a_plant_brings_tuning_which_a_caller_overrides():
    plant, entry = build("HUAVHover"), diagnosers()["ascdkf"]
    assert entry.settings_on(plant) == {"x0_std": huav_hover.X0_STD, **huav_hover.WALKS}
    assert entry.settings_on(plant, b_step=1.0)["b_step"] == 1.0
    assert diagnosers()["augmented_ekf_cusum"].settings_on(plant)["decision"] == "cusum"
    obs = flown(plant)[1].obs[:, :40]
    theirs = run(make_diagnoser("ascdkf", plant), obs).estimate
    plain = dataclasses.replace(plant, tuning={})
    assert np.array_equal(theirs, run(make_diagnoser("ascdkf", plain, **plant.tuning["ascdkf"]), obs).estimate)
    assert not np.allclose(theirs, run(make_diagnoser("ascdkf", plant, b_step=1e-2), obs).estimate)
    with pytest.raises(ValueError, match="null has no setting 'gain'"):
        make_diagnoser("null", dataclasses.replace(plant, tuning={"null": {"gain": 1}}))
