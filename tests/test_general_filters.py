"""The filters that need nothing but a plant's declaration: model, belief, filters, decisions, calibration."""

import itertools
import re

import msgspec
import numpy as np
import pytest
from conftest import PLANTS, build, states
from scipy.optimize import lsq_linear
from scipy.stats import betabinom

from baselines.filters import augmented_kf, two_stage_kf
from baselines.filters.augmented_gaussian import gaussian_filter
from fdi_gym.diagnosis import NotApplicableError, diagnosers, fit, fitting, knowledge, make_diagnoser, run
from fdi_gym.diagnosis.fitting import VALIDATION_SEED, fit_belief, flights_of, long_run
from fdi_gym.engine import simulate
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration, Persistence, gain
from fdi_gym.estimation.data import digest, from_json, to_json
from fdi_gym.estimation.decision import STATISTICS, Reading, by_labels, chi_square, cusum, declare, glr, undeclared
from fdi_gym.estimation.gaussian import RULES
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.labels import Manifolds, nearest_of
from fdi_gym.estimation.linear import linear_model
from fdi_gym.faults import draw
from fdi_gym.plants import b747_lateral as b747_file

ALL_PLANTS = [*PLANTS, "DCMotor"]
SMALL = 5e-3
GENERAL = [name for name, entry in diagnosers().items() if entry.takes("belief") or entry.takes("calibration")]
FAMILY = ("ascdkf", "three_stage_cdkf", "three_stage_ekf", "robust_three_stage_cdkf", "robust_three_stage_ekf")
beliefs = {}


def belief_of(plant, process="standard"):
    """The belief that is fitted, once per session."""
    key = (plant.id, str(plant.options), process)
    if key not in beliefs:
        beliefs[key] = fit_belief(plant, process)
    return beliefs[key]


def model_of(plant, process="standard", **tuning):
    return augmented(plant, belief_of(plant, process), **tuning)


def flown(plant, process="standard", flights=2, first=900_000):
    """Flights with validation seeds that nothing else uses."""
    scenarios = [draw(plant.process(process), VALIDATION_SEED + first + i) for i in range(flights)]
    return scenarios, simulate(plant, scenarios)


def followed(model, rule, obs, first_sample=True):
    """The filter's state after each sample."""
    return states(model.plant, gaussian_filter(model, rule, first_sample), obs)


# -- on a linear plant there is one answer


@pytest.mark.parametrize("first_sample", [True, False])
@pytest.mark.parametrize("process", ["standard", "gust"])
def test_on_a_linear_plant_they_are_the_kalman_filter(b747, process, first_sample):
    """Written out once more from the textbook: F = [[A, E(u), Ed], [0, I, 0], [0, 0, 1]], H = [C, 0, 0]."""
    model = model_of(b747, process)
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
    model = model_of(b747, **tuning)
    model = model.replace(limit=np.full(8, np.inf))
    obs = flown(b747)[1].obs[:, :200]
    special = augmented_kf.augmented_filter(
        b747, augmented_kf.augmented_model(b747), two_stage_kf.aging(1e-4, "none", 0.99, 1e-4, 1.0)
    )
    said = run(make_diagnoser("augmented_kf", b747, q_bias=1e-4, forgetting="none"), obs)
    for k, (s, own) in enumerate(zip(followed(model, rule, obs, False), states(b747, special, obs), strict=True)):
        if k:
            assert s.nu == pytest.approx(own.nu, rel=1e-9, abs=1e-9)
            assert s.S == pytest.approx(own.S, rel=1e-9, abs=1e-9)
        assert s.X == pytest.approx(own.X, rel=1e-9, abs=1e-9)
        assert s.P == pytest.approx(own.P, rel=1e-9, abs=1e-9)
        assert s.X[:, 4:] == pytest.approx(said.estimate[:, k], rel=1e-9, abs=1e-9)


def test_walk_widens_no_fault_beyond_its_limit(b747):
    model = model_of(b747, walk=50.0)
    obs = np.zeros((1, 300, 6))  # nothing is commanded: an effectiveness cannot be seen, and its variance would grow
    for s in followed(model, "extended", obs):
        assert (np.einsum("nii->ni", s.P)[:, 4:] <= model.limit[4:] * (1 + 1e-12)).all()
    assert s.P[0, 4, 4] == pytest.approx(model.limit[4])


# -- the model


def interval(plant, before, now, k):
    """What is known of the interval that ends with the observations `now` at sample k."""
    _, u, known = plant.split(now)
    d = None
    if plant.measured_disturbance is not None:
        d = plant.measured_disturbance((k - 1) * plant.dt, plant.split(before)[2], known)
    return Interval(np.full(len(now), k), u, d, known)


def intervals(model, flights=3, count=4):
    """X (n, N) and Interval along simulated flights, off the estimate by the typical scales."""
    plant, rng = model.plant, np.random.default_rng(5)
    record = flown(plant, flights=flights)[1]
    for k in rng.integers(5, int(record.length.min()), count):
        at = interval(plant, record.obs[:, k - 1], record.obs[:, k], int(k))
        X = np.tile(model.X0, (flights, 1))
        X[:, model.x] = record.state[:, k - 1]
        X[:, model.z] += 0.2 * rng.standard_normal(X[:, model.z].shape) * model.scale[model.z]
        X[:, model.d] += 0.2 * rng.standard_normal(X[:, model.d].shape) * model.scale[model.d]
        yield X, at


@pytest.mark.parametrize("plant_id", ALL_PLANTS)
@pytest.mark.parametrize("function", ["f", "h"])
def test_jacobian(plant_id, function):
    """Against a five-point difference; near a kink (the missile's |alpha|) within what a wider difference errs."""
    model = model_of(build(plant_id))
    N = len(model.scale)
    of = model.f if function == "f" else model.h
    for X, at in intervals(model):
        mean, J = (model.jacobian_f if function == "f" else model.jacobian_h)(X, at)
        assert mean == pytest.approx(of(X[:, None], at)[:, 0], rel=1e-12, abs=1e-12)
        step = 4e-4 * model.scale
        values = [of(X[:, None] + j * np.diag(step), at) for j in (-2, -1, 1, 2)]
        five = np.swapaxes(values[0] - 8 * values[1] + 8 * values[2] - values[3], 1, 2) / (12 * step)
        unit = np.abs(five * model.scale).max(axis=2, keepdims=True) / model.scale
        assert J.shape == five.shape == (len(X), mean.shape[1], N)
        twice = 2e-3 * model.scale
        low, high = (of(X[:, None] + j * np.diag(twice), at) for j in (-1, 1))
        wide = np.swapaxes(high - low, 1, 2) / (2 * twice)
        assert (np.abs(J - five) <= unit * 1e-5 + np.abs(wide - five)).all()


@pytest.mark.parametrize("plant_id", ALL_PLANTS)
def test_model_is_the_flight_without_noise(plant_id):
    """f and h, fed with the true state, fault and disturbance, are what flew but for the declared noise.

    A fault that grows within a sample is held there by the model: SMALL, in units of the states' scales.
    """
    plant = build(plant_id)
    model = model_of(plant)
    scenarios = [draw(plant.process("standard"), VALIDATION_SEED + 900_000 + i).replace(physical={}) for i in range(8)]
    record = simulate(plant, scenarios)
    healthy = plant.healthy
    ends = [(0, 2, *np.flatnonzero(record.label[i])[:2], record.length[i] - 1) for i in range(8)]
    seen = 0
    for i, end in enumerate(ends):
        for k in (1, *(int(j) + 1 for j in end)):
            at = interval(plant, record.obs[i : i + 1, k - 1], record.obs[i : i + 1, k], k)
            X = model.X0[None].copy()
            X[:, model.x] = record.state[i, k - 1]
            X[:, model.z] = record.target[i, k] - healthy
            if len(model.disturbances):
                X[:, model.d] = plant.disturbance(scenarios[i])[k - 1, model.disturbances]
            seen += record.label[i, k] > 0
            moved = model.f(X[:, None], at)[0, 0, model.x]
            error = np.abs(moved - record.state[i, k])
            assert (error <= 6 * np.sqrt(np.diag(plant.Q)) + SMALL * np.array([s.scale for s in plant.states])).all()
            X[:, model.x] = record.state[i, k]
            error = np.abs(record.obs[i, k, model.sensors] - model.h(X[:, None], at)[0, 0])
            assert (error <= 6 * np.sqrt(np.diag(model.R)) + 1e-9).all()
    assert seen >= 4


def test_measured_disturbance_of_the_missile():
    plant = build("MissilePitch")
    scenarios, record = flown(plant, flights=3)
    rows = np.array([plant.disturbance(s)[0] for s in scenarios])
    assert np.ptp(rows, axis=0).min() > 0
    for k in range(1, int(record.length.min()) + 1):
        at = interval(plant, record.obs[:, k - 1], record.obs[:, k], k)
        assert at.d == pytest.approx(rows, abs=1e-12)


# -- the belief


@pytest.fixture
def few_flights(monkeypatch):
    """Beliefs from four flights; none is kept."""
    monkeypatch.setattr(fitting, "FLIGHTS", 4)


@pytest.mark.parametrize(("plant_id", "process"), [*((p, "fault-free") for p in ALL_PLANTS), ("B747Lateral", "hard"),
                                                   ("MissilePitch", "standard"), ("MissilePitch", "hard")])  # fmt: skip
def test_noise_of_a_belief_is_the_declared_one_and_the_models_errors(few_flights, plant_id, process):
    plant = build(plant_id)
    p = fit_belief(plant, process)
    noisy = np.flatnonzero(np.diag(plant.Q))
    R = plant.R[np.ix_(p.sensors, p.sensors)]
    assert np.array_equal(p.sensors, [i for i, s in enumerate(plant.outputs) if s.sigma > 0])
    assert (np.linalg.eigvalsh(p.Q) > 0).all()
    if any(s.physical for s in flights_of(plant, process, 0, 4, False)[0]):
        more = p.Q - plant.Q
        assert np.linalg.eigvalsh(more).min() >= -1e-8 * np.abs(more).max()
        assert np.linalg.eigvalsh(p.R - R).min() >= -1e-8 * np.abs(R).max()
        floor = (fitting.FLOOR * np.array([state.scale for state in plant.states])) ** 2
        assert (np.diag(more) > 2 * floor).any()
    else:
        assert p.Q[np.ix_(noisy, noisy)] == pytest.approx(plant.Q[np.ix_(noisy, noisy)], rel=1e-8)
        assert p.R == pytest.approx(R, rel=1e-8)


def test_mismatch_is_there_where_the_plant_flies_off_the_model(few_flights, b747):
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
    seeds, stage = {}, "belief"

    def noted(process, seed, *rest):
        seeds.setdefault(stage, set()).add(seed)
        return draw(process, seed, *rest)

    monkeypatch.setattr(fitting, "draw", noted)
    fit_belief(motor, "standard")
    stage = "calibration"
    fitting._healthy(motor, "standard")
    fitting._healthy(motor, "standard", fitting.CHANNEL_FLIGHTS)
    assert len(seeds["belief"]) == 4
    assert 20 <= len(seeds["calibration"]) <= 100
    assert not seeds["belief"] & seeds["calibration"]
    for used in seeds.values():
        assert min(used) >= 2_000_000
        assert max(used) < 3_000_000


def test_beliefs_and_calibrations_are_data(plant):
    """JSON and back to an equal object; the digest is that of the content; what does not fit together is refused."""
    belief = belief_of(plant)
    again = from_json(to_json(belief), Belief)
    for name in belief.__struct_fields__:
        assert np.array_equal(getattr(belief, name), getattr(again, name))
    assert digest(again) == digest(belief)
    assert digest(msgspec.structs.replace(belief, changes=belief.changes + 1e-6)) != digest(belief)
    p = len(plant.estimated)
    calibration = Calibration(thresholds={m.name: 5.0 for m in plant.modes}, excess=np.eye(p), rise=1.5)
    back = from_json(to_json(calibration), Calibration)
    assert np.array_equal(back.excess, np.eye(p))
    assert digest(back) == digest(calibration)
    with pytest.raises(ValueError, match="P0 has the shape"):
        msgspec.structs.replace(belief, P0=np.eye(len(plant.states) + 1))
    with pytest.raises(ValueError, match="not finite"):
        msgspec.structs.replace(belief, x0=belief.x0 + np.nan)
    with pytest.raises(ValueError, match="not a Belief"):
        from_json(b'{"x0": [1], "nonsense": 2}', Belief)
    with pytest.raises(ValueError, match="another plant"):
        Calibration(thresholds={"no such mode": 1.0}).penalties(plant)


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
        yield Reading(nu=e @ L.T, S=S, seen=np.full(n, m))


def statistics(test, estimates, n, m):
    state, found = test.start(n, m), []
    for e in estimates:
        state, value = test.step(state, e, np.ones(n, bool))
        found.append(value)
    return np.array(found).T


def test_statistics_of_white_innovations():
    n, steps, m = 4000, 120, 3
    chi = statistics(chi_square(20), white(n, steps, m), n, m)[:, -1]
    std = np.sqrt(2 * m / 39)  # of the mean with memory 20
    assert abs(chi.mean()) < 4.5 * std / n**0.5
    assert chi.std() == pytest.approx(std, rel=0.1)
    window = statistics(glr((7,)), white(n, steps, m, seed=1), n, m)[:, -1]  # chi-square with m degrees of freedom
    assert abs(window.mean() - m) < 4.5 * np.sqrt(2 * m / n)
    assert window.var() == pytest.approx(2 * m, rel=0.2)
    drift = statistics(cusum(0.5), white(n, steps, m, seed=2), n, m)
    assert drift[:, -1].mean() == pytest.approx(drift[:, 60].mean(), rel=0.15)  # it stays where it is


@pytest.mark.parametrize("name", STATISTICS)
def test_a_jump_raises_the_statistic(name):
    n, steps, m = 200, 100, 3
    found = statistics(STATISTICS[name](), white(n, steps, m, jump=1.0), n, m)
    assert np.median(found[:, -1]) > np.quantile(found[:, 45], 0.99)


def test_glr_is_the_largest_over_all_windows():
    n, steps, m = 5, 60, 3
    estimates = list(white(n, steps, m, seed=4))
    windows = (2, 5, 10, 20, 40)
    found = statistics(glr(windows), estimates, n, m)
    e = np.array([np.linalg.solve(np.linalg.cholesky(s.S), s.nu[..., None])[..., 0] for s in estimates])  # (steps, n, m)
    for k in range(steps):
        ratios = [(e[k + 1 - w : k + 1].sum(axis=0) ** 2).sum(axis=1) / w for w in windows if w <= k + 1]
        assert found[:, k] == pytest.approx(np.max(ratios, axis=0) if ratios else np.zeros(n), rel=1e-9, abs=1e-12)


def test_cusum_is_the_largest_sum_that_ends_now():
    n, steps, m = 5, 40, 3
    estimates = list(white(n, steps, m, jump=0.8, seed=5))
    found = statistics(cusum(0.5), estimates, n, m)
    excess = np.array([[v @ np.linalg.solve(S, v) - 1.5 * m for v, S in zip(s.nu, s.S, strict=True)] for s in estimates])
    for k in range(steps):
        sums = np.cumsum(excess[k::-1], axis=0).max(axis=0)
        assert found[:, k] == pytest.approx(np.maximum(sums, 0), rel=1e-9, abs=1e-9)


def test_statistics_wait_for_a_sample_that_says_something():
    """What was not seen changes nothing; a sensor that is missing is none that is quiet."""
    n, m = 3, 4
    shown = list(white(n, 30, m, seed=6))
    for name in STATISTICS:
        test = STATISTICS[name]()
        state, _ = test.start(n, m), None
        for r in shown:
            state, value = test.step(state, r, np.ones(n, bool))
        _, after = test.step(state, shown[0], np.zeros(n, bool))
        assert np.array_equal(after, value), name


def declared(costs, rises=None, rise=None, after=None):
    """Labels after each of these costs (samples, labels) of one episode; the penalty of a fault is 10."""
    after = after or Persistence(2, 3, 4)
    s, labels, penalty = undeclared(1), "", np.array([0.0, 10.0, 10.0])
    for k, cost in enumerate(costs):
        share = gain(np.array([cost], float), penalty)
        over = share > 1 if rises is None else np.array([rises[k] > rise])
        best = 1 + np.argmin(np.array([cost[1:]], float), axis=1)
        s = declare(s, best, over, share < 0.5, after, np.ones(1, bool))
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
    found = Calibration(thresholds={m.name: 2.0**j for j, m in enumerate(plant.modes)}).penalties(plant)
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
        np.arange(1, h + 1), np.full(h, f), rng.standard_normal((h, p)), rng.standard_normal((h, p, f)),
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


def test_share_of_flights_with_a_false_alarm_is_the_rate(monkeypatch, b747):
    """On fresh flights. The threshold is the r-th smallest of N healthy flights' statistics, so the probability that a
    fresh flight exceeds it is Beta(N - r + 1, r), and the number that do is beta-binomial: calibration's own sampling
    error is in the interval."""
    N, fresh, rate = 30, 60, 0.05
    monkeypatch.setattr(fitting, "SAMPLES", N * 1200)
    belief, calibration = fit("augmented_ukf", b747)
    diagnoser = diagnosers()["augmented_ukf"].build(b747, belief, calibration, rule="unscented")
    obs = flights_of(b747, "standard", 800_000, fresh, False)[1].obs
    alarms = run(diagnoser, obs).alarm.any(axis=1).sum()
    r = int(np.ceil((1 - rate) * (N - 1))) + 1
    low, high = betabinom.interval(0.999, fresh, N - r + 1, r)
    assert low <= alarms <= high
    assert high < fresh


def test_fits_are_kept_and_what_made_them_tells_them_apart(monkeypatch, tmp_path, motor):
    calls, entry = [], diagnosers()["augmented_ekf"]
    monkeypatch.setattr(knowledge, "fits_file", lambda folder, plant_id: None)
    monkeypatch.setattr(knowledge, "_kept", {})
    monkeypatch.setattr(knowledge, "cache_folder", lambda source: tmp_path)
    made = Calibration(thresholds={"worn brush": 2.0})

    def make():
        calls.append(1)
        return made

    def ask(plant=motor, key="a", forget=False):
        if forget:
            knowledge._kept.clear()
        assert digest(knowledge._known(entry, plant, "calibrations", key, make)) == digest(made)
        return len(calls)

    assert [ask(), ask(), ask(forget=True)] == [1, 1, 1]  # made, in memory, on disk
    (path,) = tmp_path.glob("fit-*.json")
    path.write_bytes(path.read_bytes()[:10])  # a damaged file is made again
    assert ask(forget=True) == 2
    assert ask(key="b") == 3
    assert ask(plant=build("B747Lateral")) == 4
    monkeypatch.setattr(knowledge, "code_digest", lambda plant: "edited")
    assert ask() == 5


# -- every general method, on every plant


@pytest.mark.parametrize("plant_id", ALL_PLANTS)
@pytest.mark.parametrize("name", GENERAL)
def test_builders_fly_nothing_and_say_why_they_cannot(monkeypatch, plant_id, name):
    plant, entry = build(plant_id), diagnosers()[name]
    given = {"belief": belief_of(plant)} if entry.takes("belief") else {}
    given |= {"calibration": Calibration()} if entry.takes("calibration") else {}
    given |= {"scenarios": [draw(plant.process("standard"), 0)]} if entry.clairvoyant else {}
    given |= {"process": "standard"} if entry.takes("process") else {}

    def fly(*_):
        raise AssertionError("a builder flies")

    monkeypatch.setattr(fitting, "simulate", fly)
    monkeypatch.setattr(fitting, "flights_of", fly)
    reason = ""
    try:
        entry.build(plant, **given, **entry.resolve(plant))
    except NotApplicableError as error:
        reason = str(error) or "none given"
    assert not reason or len(reason) > 20, reason
    assert (
        not reason
        or name in FAMILY
        or re.search(
            "needs a linear plant|no trained weights|no label of|no unknown-input observer|are allowed|too much|"
            "three tanks only|overlap in time|no two faults overlap",
            reason,
        )
    ), reason
    with pytest.raises(ValueError, match="no such"):
        make_diagnoser(name, plant, process="no such", **({"scenarios": []} if entry.clairvoyant else {}))


def test_after_a_gap_labels_wait_until_the_estimate_is_as_sure_as_before(b747):
    """What is unsure since a gap raises no alarm; the same readings without a gap do, and so they do once they are sure."""
    thresholds = {mode.name: 9.0 for mode in b747.modes}
    rule = by_labels(b747, Calibration(thresholds=thresholds, persistence=Persistence(3, 3, 3)))
    p, mode = len(b747.estimated), b747.modes[0]
    faulty = np.asarray(mode.offset) + mode.reach[1] * np.asarray(mode.direction)

    def alarms(gap, wide):
        state, found = rule.start(1), []
        for k in range(60):
            inside, after = 20 <= k < 30, 30 <= k < 30 + wide
            reading = Reading(
                faulty[None] if k >= 20 else np.zeros((1, p)), 1e-4 * (3.0 if inside or after else 1.0) * np.eye(p)[None]
            )
            state, verdict = rule.step(state, np.array([k]), reading, np.array([not (gap and inside)]))
            found.append(bool(verdict.alarm[0]))
        return np.flatnonzero(found)

    assert alarms(gap=False, wide=15)[0] == 22
    assert alarms(gap=True, wide=0)[0] == 32
    assert alarms(gap=True, wide=15)[0] == 47
    assert alarms(gap=True, wide=15)[-1] == 59
