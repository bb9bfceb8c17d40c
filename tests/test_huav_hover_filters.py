"""The three-stage filters, the hypothesis bank and the oracle on the hovering helicopter."""

import itertools

import numpy as np
import pytest
import scipy.linalg

from baselines.filters import robust_three_stage, three_stage
from baselines.filters.hypothesis_bank import transitions
from baselines.filters.propagation import Propagated, central_difference_propagation, extended_propagation, trim_model
from baselines.oracles.matched_oracle import steady_filter
from benchmarks.reproduction.numbered import fly
from fdi_gym.diagnosis import NotApplicableError, find_diagnoser, guarded, run
from fdi_gym.diagnosis.filtering import readings
from fdi_gym.discovery import load_plant
from fdi_gym.engine import no_noise, simulate
from fdi_gym.estimation.belief import Belief, fault_inputs
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.channels import by_channels
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.labels import channel_sets, label_of_channels
from fdi_gym.estimation.linear import linear_output
from fdi_gym.faults import FaultProcess, FaultScenario
from fdi_gym.kernels import kernel
from fdi_gym.plant import FaultMode, Kernels, Label, Plant, Signal
from fdi_gym.plants import b747_lateral, huav_hover
from fdi_gym.testing import check_plant, check_streams, check_vector_env

PAPER = {"b0_std": 2e-3, "d0_std": 0.5, "b_step": 7e-4, "d_step": 0.05, "x0_std": [*[0.1] * 3, *[0.02] * 6, *[0.005] * 2]}
X0_STD = PAPER["x0_std"]
P3, P4 = ("lon", "lat", "ped"), huav_hover.CHANNELS
FILTERS = ("ascdkf", "three_stage_cdkf", "three_stage_ekf", "robust_three_stage_cdkf", "robust_three_stage_ekf")
ALL = (*FILTERS, "hypothesis_bank", "matched_oracle")
MRAD = 1e-3


@pytest.fixture(scope="module")
def plant():
    return load_plant(huav_hover.ID)


def anything(plant):
    """A belief of the right shapes, for filters that are given all their tuning."""
    n, m, p, modes = len(plant.states), len(plant.outputs), len(plant.estimated), len(plant.modes)
    return Belief(
        x0=plant.trim_state, P0=np.eye(n), Q=plant.Q, R=plant.R, sensors=np.arange(m), z_size=np.ones(p), z_walk=np.ones(p),
        m_mean=np.zeros(modes), m_std=np.ones(modes), m_walk=np.ones(modes), changes=0.01, disturbances=np.zeros(0),
        d0=np.zeros(0), d_walk=np.zeros(0),
    )  # fmt: skip


def build(name, plant, scenarios=None, **tuning):
    entry = find_diagnoser(name)
    given = {"belief": anything(plant), "calibration": Calibration(), "scenarios": scenarios}
    given = {key: value for key, value in given.items() if entry.takes(key)}
    return entry.build(plant, **given, **entry.resolve(plant, **tuning))


def last_state(diagnoser, obs):
    """The filter's state after the observations (n, samples, n_obs), and what the diagnoser says last."""
    state, said = diagnoser.init(len(obs)), None
    for k in range(obs.shape[1]):
        state, said = diagnoser.update(state, obs[:, k])
    return state.filter, said


# -- a linear plant of any size, for the identities


@kernel
def linear_dynamics(t, x, u, theta, d, p, dx):
    """A x + Bu u + Bf theta + E d, the matrices row by row in p."""
    n, m, q, r = x.size, u.size, theta.size, d.size
    for i in range(n):
        dx[i] = 0.0
        for j in range(n):
            dx[i] += p[i * n + j] * x[j]
        for j in range(m):
            dx[i] += p[n * n + i * m + j] * u[j]
        for j in range(q):
            dx[i] += p[n * (n + m) + i * q + j] * theta[j]
        for j in range(r):
            dx[i] += p[n * (n + m + q) + i * r + j] * d[j]


@kernel
def linear_output_map(t, x, u, theta, d, p, y):
    """H x, H after the other matrices in p."""
    n, start = x.size, x.size * (x.size + u.size + theta.size + d.size)
    for i in range(y.size):
        y[i] = 0.0
        for j in range(n):
            y[i] += p[start + i * n + j] * x[j]


@kernel
def no_control(t, y, r, q, c, u):
    """The loop is open and nothing is commanded."""
    for i in range(u.size):
        u[i] = 0.0


def linear_plant(A, Bu, Bf, E, H, sigma_w, sigma_v, dt=0.02):
    """A discrete linear plant with an additive fault theta and a disturbance given as rows in the scenario."""
    inf = np.inf
    names = [f"b{i}" for i in range(Bf.shape[1])]
    eye = np.eye(len(names))
    return Plant(
        id="Linear", version=0, description="linear", dt=dt, substeps=0, linear=True,
        kernels=Kernels(linear_dynamics, linear_output_map, no_control),
        states=tuple(Signal(f"x{i}", "", -inf, inf, 1.0, s) for i, s in enumerate(sigma_w)),
        outputs=tuple(Signal(f"y{i}", "", -inf, inf, 1.0, s) for i, s in enumerate(sigma_v)),
        commands=tuple(Signal(f"u{i}", "", -1.0, 1.0) for i in range(Bu.shape[1])),
        theta=tuple(Signal(n, "", -inf, inf) for n in names),
        disturbances=tuple(Signal(f"d{i}", "", -inf, inf) for i in range(E.shape[1])),
        disturbance=lambda s: np.array(s.disturbance["rows"], float),
        modes=tuple(FaultMode(n, "", lambda th, i=i: np.abs(th[..., i]), (1.0, 2.0), (0.0,) * len(names),
                              tuple(eye[i]), (-1.0, 1.0)) for i, n in enumerate(names)),
        labels=(Label("none", frozenset()), *(Label(n, frozenset({n})) for n in names)),
        processes={"standard": FaultProcess(name="standard", description="", sample=lambda g: FaultScenario(
            plant="Linear", steps=10, disturbance={"rows": [[0.0] * E.shape[1]] * 11}))},
        physical=lambda changes: np.concatenate([M.ravel() for M in (A, Bu, Bf, E, H)]),
    )  # fmt: skip


def linearised_helicopter(kappa=0.3, channels=P4):
    plant = load_plant(huav_hover.ID, kappa=kappa)
    at, H = trim_model(plant, fault_inputs(plant, channels)), linear_output(plant)
    return linear_plant(at.A, np.zeros((11, 4)), at.B, at.E, H, huav_hover.SIGMA_W, huav_hover.SIGMA_V)


def rows_flown(model, b, d, w, v):
    """Measurements (samples, n_y) and states of a linear plant under given inputs, by hand."""
    at, H = trim_model(model, fault_inputs(model)), linear_output(model)
    x = np.zeros((len(b) + 1, len(at.A)))
    for k in range(len(b)):
        x[k + 1] = at.A @ x[k] + at.B @ b[k] + at.E @ d[k] + w[k]
    return x @ H.T + v, x


def shown(model, y):
    """The same as observations (1, samples, n_obs)."""
    return np.hstack([y, np.zeros((len(y), len(model.commands)))])[None]


# -- check values


@pytest.mark.parametrize(("name", "b", "d"), [
    ("ascdkf", (0.004996343541, -5.29515e-08, -0.001562037280), (3.470429326, 2.644355883)),
    ("three_stage_cdkf", (0.004996324913, -5.29244e-08, -0.001559098950), (3.470405888, 2.644356209)),
    ("three_stage_ekf", (0.004996324700, -5.29278e-08, -0.001559190129), (3.470412741, 2.644335441)),
    ("robust_three_stage_cdkf", (0.004999997188, 9.7417e-11, -8.19455e-07), (3.999689426, 2.999812699)),
    ("robust_three_stage_ekf", (0.004999997099, 9.9463e-11, -8.55970e-07), (3.999701374, 2.999804348)),
])  # fmt: skip
def test_filter_rows_on_the_noise_free_flight(plant, name, b, d):
    obs = simulate(plant, [huav_hover.paper(1)], [no_noise(plant, huav_hover.STEPS)]).obs[:, :451]
    _, said = last_state(build(name, plant, channels=P3), obs)
    exact = not name.endswith("ekf")  # the EKF rows depend on the Jacobian at the 1e-9 level
    assert said.estimate[0, 1:] == pytest.approx(b, abs=1e-12 if exact else 1e-8)
    assert said.estimate[0, 0] == 0
    assert said.signals["disturbance"][0] == pytest.approx(d, abs=1e-9 if exact else 1e-4 if "robust" in name else 1e-6)


def test_hypothesis_bank_check_values(plant):
    obs = fly(plant, [huav_hover.episode(1)], huav_hover.prescribed_noise).obs
    diagnoser = build("hypothesis_bank", plant)
    state, seen = diagnoser.init(1), {}
    for k in range(522):
        state, said = diagnoser.update(state, obs[:, k])
        seen[k - 1] = said.label_probs[0, 0], said.label_probs[0, 2], said.estimate[0, 1] / MRAD
    assert seen[512][:2] == pytest.approx((0.966584, 0.003300), rel=2e-4)
    assert seen[513] == pytest.approx((0.002053, 0.978335, 3.66412), rel=2.5e-4)
    assert seen[520][1:] == pytest.approx((0.987608, 5.39050), rel=1e-4)


@pytest.mark.parametrize(("kappa", "channels", "condition", "radius", "std_b", "std_d"), [
    (0.0, P3, 1.15, 0.974864, (2.18, 1.16, 2.73), (113.8, 51.7)),
    (0.0, P4, 2.62, 0.974866, (25.91, 2.18, 1.34, 24.64), (113.8, 51.8)),
    (0.3, P3, 21.1, 0.974864, (3.27, 1.16, 230.17), (113.8, 51.7)),
    (0.3, P4, 24.3, 0.974866, (25.91, 3.28, 1.34, 232.36), (113.8, 51.8)),
    (1.0, P3, 70.0, 0.974864, (8.43, 1.16, 767.15), (113.9, 51.7)),
    (1.0, P4, 80.5, 0.974866, (25.91, 8.44, 1.34, 768.71), (113.9, 51.8)),
])  # fmt: skip
def test_existence_conditions(kappa, channels, condition, radius, std_b, std_d):
    plant = load_plant(huav_hover.ID, kappa=kappa)
    found = robust_three_stage.existence(plant, fault_inputs(plant, channels), linear_output(plant))
    assert found.rank == found.needed == len(channels) + 2
    assert found.condition == pytest.approx(condition, rel=5e-3)
    assert found.radius == pytest.approx(radius, abs=1e-6)
    assert found.std_b / MRAD == pytest.approx(std_b, abs=0.0051)
    assert found.std_d == pytest.approx(std_d, abs=0.051)


@pytest.mark.parametrize(("K_B", "std"), [(0.2, (7.0, 3.7)), (0.42, (4.0, 2.1)), (0.84, (2.2, 1.2)), (1.68, (1.2, 0.6))])
def test_robust_cyclic_accuracy_lives_on_the_direct_gain(K_B, std):
    plant = load_plant(huav_hover.ID, kappa=0.0, K_B=K_B)
    found = robust_three_stage.existence(plant, fault_inputs(plant, P3), linear_output(plant))
    assert found.std_b[:2] / MRAD == pytest.approx(std, abs=0.051)
    assert found.std_b[2] / MRAD == pytest.approx(2.7, abs=0.051)


def signatures(A, G, H, Q, R, steps):
    """Whitened innovations (steps, n_y, inputs) of a steady Kalman filter under unit steps of the inputs G."""
    P = scipy.linalg.solve_discrete_are(A.T, H.T, Q, R)
    C = H @ P @ H.T + R
    still, white = np.eye(len(A)) - P @ H.T @ np.linalg.solve(C, H), np.linalg.inv(np.linalg.cholesky(C))
    error, rows = np.zeros_like(G), []
    for _ in range(steps):
        ahead = A @ error + G
        rows.append(white @ H @ ahead)
        error = still @ ahead
    return np.array(rows)


@pytest.mark.parametrize(("kappa", "col_v", "ped_v", "norm_v"), [
    (0.0, 0.000, -0.0345, 1.86), (0.3, 0.730, -0.9957, 20.02), (1.0, 0.734, -0.9996, 66.31),
])  # fmt: skip
def test_side_gust_looks_like_a_pedal_fault(kappa, col_v, ped_v, norm_v):
    plant = load_plant(huav_hover.ID, kappa=kappa)
    at, H = trim_model(plant, fault_inputs(plant)), linear_output(plant)
    rows = signatures(at.A, np.hstack([at.B, at.E]), H, plant.Q, plant.R, 50).reshape(-1, 6)
    norm = np.linalg.norm(rows, axis=0)
    cosine = (rows / norm).T @ (rows / norm)
    assert norm * [MRAD, MRAD, MRAD, MRAD, 1, 1] == pytest.approx([5.73, 14.53, 18.23, 4.47, 0.84, norm_v], abs=0.0151)
    assert cosine[0, 3] == pytest.approx(-0.735, abs=5.1e-4)
    assert cosine[0, 5] == pytest.approx(col_v, abs=5.1e-4)
    assert cosine[3, 5] == pytest.approx(ped_v, abs=5.1e-5)


@pytest.mark.parametrize(("kappa", "alone", "joint"), [
    (0.0, (0.275, 0.103, 0.080, 0.321), (0.465, 0.103, 0.080, 0.545)),
    (0.3, (0.414, 0.103, 0.080, 0.868), (0.465, 0.103, 0.080, 0.975)),
    (1.0, (0.450, 0.103, 0.080, 1.745), (0.465, 0.103, 0.080, 1.803)),
])  # fmt: skip
def test_bound_on_a_bias_half_a_second_after_its_onset(kappa, alone, joint):
    plant = load_plant(huav_hover.ID, kappa=kappa)
    model = steady_filter(plant, fault_inputs(plant), 0.05)
    Q = scipy.linalg.block_diag(plant.Q, 0.05**2 * np.eye(2))
    rows = signatures(model.A, model.Bf, model.H, Q, plant.R, 25).reshape(-1, 4)
    G = rows.T @ rows
    assert 1 / np.sqrt(np.diag(G)) / MRAD == pytest.approx(alone, abs=5.1e-4)
    assert np.sqrt(np.diag(np.linalg.inv(G))) / MRAD == pytest.approx(joint, abs=5.1e-4)


# -- existence conditions that fail


def test_unstable_invariant_zero_is_refused_at_construction():
    # (z - zero) / ((z - 0.5) (z - 0.6)) from the fault to the one sensor
    def model(zero):
        A, B, H = np.array([[1.1, -0.3], [1.0, 0.0]]), np.array([[1.0], [0.0]]), np.array([[1.0, -zero]])
        return linear_plant(A, np.zeros((2, 1)), B, np.zeros((2, 0)), H, [0.1] * 2, [0.1])

    tuning = {"x0_std": [1.0] * 2, "thresholds": [1.0]}
    with pytest.raises(NotApplicableError, match=r"largest modulus .* is 1\.5: an unstable invariant zero"):
        build("robust_three_stage_cdkf", model(1.5), **tuning)
    build("robust_three_stage_cdkf", model(0.9), **tuning)


def test_too_many_unknown_inputs_are_refused_at_construction():
    # a vertical gust beside four faults and the horizontal gusts: seven inputs, six velocity-type outputs
    plant = load_plant(huav_hover.ID, kappa=0.0)
    at, H = trim_model(plant, fault_inputs(plant)), linear_output(plant)
    E = np.column_stack([at.E, 0.02 * 0.05 * np.eye(11)[2]])
    model = linear_plant(at.A, np.zeros((11, 4)), at.B, E, H, huav_hover.SIGMA_W, huav_hover.SIGMA_V)
    with pytest.raises(NotApplicableError, match="rank"):
        build("robust_three_stage_ekf", model, thresholds=[1.0] * 4, x0_std=X0_STD)


def test_an_input_that_no_sensor_sees_is_refused_at_construction():
    E = np.zeros((3, 1))
    model = linear_plant(0.9 * np.eye(3), np.zeros((3, 1)), np.eye(3)[:, :1], E, np.eye(3), [0.1] * 3, [0.1] * 3)
    with pytest.raises(NotApplicableError, match="rank"):
        build("robust_three_stage_cdkf", model, thresholds=[1.0], x0_std=[1.0] * 3)


def test_errors_name_what_is_allowed(plant):
    with pytest.raises(NotApplicableError, match="col, lon, lat, ped"):
        build("three_stage_cdkf", plant, channels=("rudder",))
    with pytest.raises(NotApplicableError, match="needs all fault channels of HUAVHover: col, lon, lat, ped"):
        build("three_stage_cdkf", plant, channels=P3, decision="distance")
    with pytest.raises(ValueError, match="unknown decision"):
        build("three_stage_cdkf", plant, decision="sets")
    with pytest.raises(ValueError, match="d_step needs one entry or 2"):
        build("three_stage_cdkf", plant, d_step=[1.0] * 3)
    with pytest.raises(NotApplicableError, match="x0_std"):
        build("ascdkf", plant, x0_std=[1.0])
    with pytest.raises(ValueError, match="unknown rule"):
        build("three_stage_cdkf", plant, rule="unscented")
    with pytest.raises(ValueError, match=r"one threshold per channel \(lon, lat, ped\)"):
        build("three_stage_cdkf", plant, channels=P3, thresholds=[1.0])
    with pytest.raises(NotApplicableError, match="errors of commands"):
        build("matched_oracle", load_plant(b747_lateral.ID), scenarios=[b747_lateral.paper()])


# -- identities


def textbook(x, P, y, A, H, Q, R):
    """A Kalman filter step as in any textbook; a prediction where nothing is measured."""
    x, P = A @ x, A @ P @ A.T + Q
    C = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(C)
    P = P - K @ C @ K.T
    return x + K @ (y - H @ x), (P + P.T) / 2


def joint_covariance(s):
    """The joint covariance of [x; b; d] (n, N, N) that a three-stage state stands for."""
    n, n_x, p, q = len(s.x), s.x.shape[1], s.b.shape[1], s.d.shape[1]
    V = np.tile(np.eye(n_x + p + q), (n, 1, 1))
    V[:, :n_x, n_x : n_x + p], V[:, :n_x, n_x + p :], V[:, n_x : n_x + p, n_x + p :] = s.V12, s.V13, s.V23
    P = np.zeros_like(V)
    P[:, :n_x, :n_x], P[:, n_x : n_x + p, n_x : n_x + p], P[:, n_x + p :, n_x + p :] = s.Px, s.Pb, s.Pd
    return V @ P @ np.swapaxes(V, 1, 2)


@pytest.mark.parametrize("share", [1.0, 0.6, 0.1, 0.0])
def test_three_stage_algebra_is_the_augmented_kalman_filter(share):
    """Random systems with feed-through and a full noise covariance of [x; b; d]; this share of the sensors reports."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        n, p, q, m = 5, 2, 2, 6
        N = n + p + q
        A = 0.4 * rng.standard_normal((n, n))
        B, E = rng.standard_normal((n, p)), rng.standard_normal((n, q))
        H, By, Ey = rng.standard_normal((m, n)), rng.standard_normal((m, p)), rng.standard_normal((m, q))
        root = 0.3 * rng.standard_normal((N, N))
        Qa, R = root @ root.T + 0.1 * np.eye(N), np.diag(rng.uniform(0.1, 1, m))
        Aa, Ha = np.eye(N), np.hstack([H, By, Ey])
        Aa[:n] = np.hstack([A, B, E])
        x, P = np.zeros(N), np.diag(rng.uniform(0.5, 2, N))
        s = three_stage.start(1, x[:n], P[:n, :n], P[n : n + p, n : n + p], P[n + p :, n + p :], R)
        for _ in range(100):
            y, seen = 3 * rng.standard_normal(m), rng.random(m) < share
            xhat, bhat, dhat = s.estimates()
            f = Propagated(xhat @ A.T + bhat @ B.T + dhat @ E.T, (A @ s.Px[0] @ A.T)[None], A[None], None, B[None], E[None])
            s = three_stage.predict(
                s, f, Qa[:n, :n], Qa[n : n + p, n : n + p], Qa[n + p :, n + p :],
                Qxb=Qa[:n, n : n + p], Qxd=Qa[:n, n + p :], Qbd=Qa[n : n + p, n + p :],
            )  # fmt: skip
            s = three_stage.update(s, np.where(seen, y, 0.0)[None], seen[None], H, R, By=By, Ey=Ey)
            x, P = textbook(x, P, y[seen], Aa, Ha[seen], Qa, R[np.ix_(seen, seen)])
            assert s.seen[0] == seen.sum()
        assert np.concatenate(s.estimates(), axis=1)[0] == pytest.approx(x, rel=1e-9, abs=1e-9)
        assert joint_covariance(s)[0] == pytest.approx(P, rel=1e-9, abs=1e-9)
        for found, block in zip(s.covariances(), (slice(0, n), slice(n, n + p)), strict=True):
            assert found[0] == pytest.approx(P[block, block], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("name", ["three_stage_cdkf", "three_stage_ekf"])
def test_three_stage_filter_is_the_augmented_one_on_the_linearised_helicopter(name, gaps):
    model = linearised_helicopter()
    rng = np.random.default_rng(2)
    k = np.arange(500)[:, None]
    b = 1e-4 * np.where(k > 100, [2, -1, 1, 2], 0) * np.sign(np.sin(k / 20 + np.arange(4)))  # the loop is open
    w, v = rng.standard_normal((500, 11)) * huav_hover.SIGMA_W, rng.standard_normal((501, 9)) * huav_hover.SIGMA_V
    y, _ = rows_flown(model, b, np.where(k > 50, [0.04, 0.03], 0), w, v)
    obs = shown(model, y)
    if gaps:
        obs[..., :9][np.random.default_rng(8).random((1, 501, 9)) < 0.3] = np.nan
        obs[:, 200:220] = np.nan
    s, _ = last_state(build(name, model, thresholds=[1.0] * 4, **PAPER), obs)
    a, _ = last_state(build("ascdkf", model, thresholds=[1.0] * 4, **PAPER), obs)
    scale = np.sqrt(np.diagonal(a.P[0]))
    assert np.concatenate(s.estimates(), axis=1)[0] / scale == pytest.approx(a.X[0] / scale, rel=1e-8, abs=1e-8)
    assert joint_covariance(s)[0] / np.outer(scale, scale) == pytest.approx(a.P[0] / np.outer(scale, scale), abs=1e-9)
    assert s.nu[0] == pytest.approx(a.nu[0], rel=1e-6, abs=1e-9)
    assert s.S[0] == pytest.approx(a.S[0], rel=1e-6, abs=1e-9)


def test_rules_agree_with_the_matrices_of_a_linear_plant():
    model = linearised_helicopter()
    inputs = fault_inputs(model)
    rng = np.random.default_rng(3)
    root = rng.standard_normal((2, 11, 11))
    P, x = root @ np.swapaxes(root, 1, 2), rng.standard_normal((2, 11))
    b, d, u = rng.standard_normal((2, 4)), rng.standard_normal((2, 2)), np.zeros((2, 4))
    p, at = model.nominal_p, (0, 121, 165, 209, 231)  # A, Bu, Bf, E, one after the other
    A, _, B, E = (p[i:j].reshape(11, -1) for i, j in itertools.pairwise(at))
    for rule in (central_difference_propagation(model, inputs), extended_propagation(model, inputs)):
        f = rule(0.0, x, P, u, b, d)
        for i in range(2):
            assert f.x[i] == pytest.approx(A @ x[i] + B @ b[i] + E @ d[i], abs=1e-9)
            assert f.P[i] == pytest.approx(A @ P[i] @ A.T, rel=1e-7, abs=1e-7)
            assert f.A[i] == pytest.approx(A, abs=1e-7)
            assert f.carry(np.eye(11)[None])[i] == pytest.approx(A, abs=1e-7)
            assert f.B[i] == pytest.approx(B, abs=1e-7)
            assert f.E[i] == pytest.approx(E, abs=1e-9)


def test_robust_filter_is_the_joint_unbiased_minimum_variance_filter():
    plant = load_plant(huav_hover.ID)
    inputs, H = fault_inputs(plant, P3), linear_output(plant)
    at = trim_model(plant, inputs)
    rng = np.random.default_rng(4)
    P, x = np.eye(11), np.zeros(11)
    for _ in range(200):
        y = rng.standard_normal(9) * huav_hover.SIGMA_V
        f = Propagated((at.A @ x)[None], (at.A @ P @ at.A.T)[None], at.A[None], None, at.B[None], at.E[None])
        L, P_joint = robust_three_stage.input_gain(f, H, plant.Q, plant.R)
        s = robust_three_stage.start(1, x, P, np.eye(3), np.eye(2))
        s = robust_three_stage.predict(s, f, plant.Q)
        s = robust_three_stage.update(s, y[None], np.ones((1, 9), bool), H, plant.R)
        joint = f.x[0] + L[0] @ (y - H @ f.x[0])
        std = np.sqrt(np.diagonal(s.P[0]))
        assert (s.x[0] - joint) / std == pytest.approx(np.zeros(11), abs=1e-7)
        assert s.P[0] / np.outer(std, std) == pytest.approx(P_joint[0] / np.outer(std, std), abs=1e-9)
        x, P = s.x[0], s.P[0]


def test_robust_filter_is_the_limit_of_the_optimal_one():
    model = linearised_helicopter(channels=P3)
    rng = np.random.default_rng(5)
    w, v = rng.standard_normal((200, 11)) * huav_hover.SIGMA_W, rng.standard_normal((201, 9)) * huav_hover.SIGMA_V
    y, _ = rows_flown(model, 0.01 * np.ones((200, 3)), np.ones((200, 2)), w, v)
    wide = {"x0_std": X0_STD, "b_step": 10.0, "d_step": 1e4, "b0_std": 10.0, "d0_std": 1e4, "thresholds": [1.0] * 3}
    s, _ = last_state(build("three_stage_ekf", model, **wide), shown(model, y))
    r, _ = last_state(build("robust_three_stage_ekf", model, thresholds=[1.0] * 3, x0_std=X0_STD), shown(model, y))
    xhat, bhat, dhat = s.estimates()
    for optimal, robust, cov in ((xhat, r.x, r.P), (bhat, r.b, r.cov_b), (dhat, r.d, r.cov_d)):
        assert np.abs(optimal - robust)[0] / np.sqrt(np.diagonal(cov[0])) == pytest.approx(0, abs=2e-2)


def arbitrary_signals(steps):
    """Square waves of 50 mrad, a ramp, steps of 200 mrad; gusts up to 80 m/s."""
    k = np.arange(steps)
    b = np.column_stack([
        0.05 * np.where(k // 25 % 2, -1, 1), 1e-3 * k, 0.2 * (k > steps // 3) - 0.4 * (k > steps // 2)
    ])  # fmt: skip
    return b, np.column_stack([80 * np.sin(0.2 * k), 60.0 * (k > steps // 4)])


@pytest.mark.parametrize("name", ["robust_three_stage_cdkf", "robust_three_stage_ekf"])
def test_robust_filter_follows_any_fault_and_gust_exactly_without_noise(name):
    model = linearised_helicopter(channels=P3)
    b, d = arbitrary_signals(120)
    y, x = rows_flown(model, b, d, np.zeros((120, 11)), np.zeros((121, 9)))
    diagnoser = build(name, model, thresholds=[1.0] * 3, x0_std=X0_STD)
    state = diagnoser.init(1)
    for k, row in enumerate(shown(model, y)[0]):
        state, said = diagnoser.update(state, row[None])
        if k:
            assert said.estimate[0] == pytest.approx(b[k - 1], abs=1e-7)
            assert said.signals["disturbance"][0] == pytest.approx(d[k - 1], abs=1e-5)
            assert said.state[0] == pytest.approx(x[k], abs=1e-7)


@pytest.mark.parametrize("name", ["robust_three_stage_cdkf", "robust_three_stage_ekf"])
def test_robust_filter_solves_for_what_acted_over_a_gap(name):
    """Inputs that are constant over it are exact at its end, as is the state; the last estimate stands until then."""
    model = linearised_helicopter(channels=P3)
    b, d = arbitrary_signals(120)
    b[50:71], d[50:71] = b[50], d[50]
    y, x = rows_flown(model, b, d, np.zeros((120, 11)), np.zeros((121, 9)))
    obs = shown(model, y)
    obs[:, 51:70] = np.nan  # nothing
    obs[:, 70, 0] = np.nan  # not all that are needed
    obs[:, 80:90, 6:9] = np.nan  # the attitude is not needed
    said = run(build(name, model, thresholds=[1.0] * 3, x0_std=X0_STD), obs, signals=True)
    assert said.estimate[0, 51:71] == pytest.approx(np.tile(said.estimate[0, 50], (20, 1)))
    after = [*range(1, 51), *range(71, 121)]
    assert said.estimate[0, after] == pytest.approx(b[np.array(after) - 1], abs=1e-7)
    assert said.signals["disturbance"][0, after] == pytest.approx(d[np.array(after) - 1], abs=1e-5)
    assert said.state[0, after] == pytest.approx(x[after], abs=1e-6)


@pytest.mark.parametrize("runs", [200, pytest.param(2000, marks=pytest.mark.slow)])
def test_robust_filter_is_unbiased_and_knows_its_variance(runs):
    model = linearised_helicopter(channels=P3)
    at, H = trim_model(model, fault_inputs(model)), linear_output(model)
    steps, rng = 200, np.random.default_rng(6)
    b, d = arbitrary_signals(steps)
    x0_std = np.array(X0_STD)
    x = rng.standard_normal((runs, 11)) * x0_std
    s = robust_three_stage.start(runs, np.zeros(11), np.diag(x0_std**2), np.eye(3), np.eye(2))
    tile = [np.broadcast_to(M, (runs, *M.shape)) for M in (at.B, at.E)]
    scores, ratios = [], []
    for k in range(steps):
        x = x @ at.A.T + at.B @ b[k] + at.E @ d[k] + rng.standard_normal((runs, 11)) * huav_hover.SIGMA_W
        y = x @ H.T + rng.standard_normal((runs, 9)) * huav_hover.SIGMA_V
        f = Propagated(s.x @ at.A.T, at.A @ s.P @ at.A.T, np.broadcast_to(at.A, s.P.shape), None, *tile)
        s = robust_three_stage.update(robust_three_stage.predict(s, f, model.Q), y, np.ones(y.shape, bool), H, model.R)
        error = np.hstack([s.b - b[k], s.d - d[k], s.x - x])
        predicted = np.sqrt(np.concatenate([np.diagonal(c[0]) for c in (s.cov_b, s.cov_d, s.P)]))
        scores.append(error.mean(axis=0) / (predicted / np.sqrt(runs)))
        ratios.append(error.std(axis=0) / predicted)
    scores, ratios = np.array(scores), np.array(ratios)
    assert np.sqrt((scores**2).mean()) == pytest.approx(1, abs=0.15)
    assert np.abs(scores).max() < 4.5
    assert ratios.min() > 1 - 4.5 / np.sqrt(2 * runs)
    assert ratios.max() < 1 + 4.5 / np.sqrt(2 * runs)


@pytest.mark.parametrize("name", FILTERS)
def test_filters_run_on_another_plant_with_a_gust(name):
    """The 747's lateral motion with a side gust as unknown input, its fault a stuck deflection."""
    A, B = b747_lateral.discretise(b747_lateral.A_PRINTED, b747_lateral.B_PRINTED)
    E = (np.eye(4) - A)[:, :1]  # a gust is a change of the sideslip that the airframe feels
    model = linear_plant(A, np.zeros((4, 2)), B, E, np.eye(4), b747_lateral.SIGMA_W, b747_lateral.SIGMA_V, dt=0.1)
    rng = np.random.default_rng(7)
    w, v = rng.standard_normal((600, 4)) * b747_lateral.SIGMA_W, rng.standard_normal((601, 4)) * b747_lateral.SIGMA_V
    y, _ = rows_flown(model, np.tile([3.0, 2.0], (600, 1)), 2 * np.ones((600, 1)), w, v)
    tuning = {"x0_std": [0.1] * 4, "thresholds": [0.5, 0.5]}
    if "robust" not in name:
        tuning |= {"b0_std": 2.0, "b_step": 0.05, "d0_std": 1.0, "d_step": 0.05}
    _, said = last_state(build(name, model, alpha=0.01, **tuning), shown(model, y))
    assert said.signals["smoothed"][0] == pytest.approx([3.0, 2.0], abs=4 * 0.01**0.5 * said.estimate_std[0].max() + 0.2)
    assert said.alarm[0]


# -- channels


def switched(plant, values, alpha=1.0, stds=None):
    """Whether one channel with threshold 1 is on after each of these estimates, with these deviations (default: 1)."""
    rule, found = by_channels(plant, fault_inputs(plant, ("lon",)), alpha, np.ones(1)), ""
    state = rule.start(1)
    for k, value in enumerate(values):
        z = np.zeros((1, 4))
        z[0, 1] = 0.0 if value is None else value
        P = (1.0 if stds is None else stds[k]) ** 2 * np.eye(4)[None]
        state, said = rule.step(state, np.array([k]), Reading(z, P), np.array([value is not None]))
        assert said.alarm[0] == (plant.labels[said.label[0]].name == "lon")
        found += ".F"[int(said.alarm[0])]
    return found, said


def test_channel_needs_three_in_a_row_and_clears_after_twenty_low_ones(plant):
    assert switched(plant, [2, 2, 0.9, 2, 2, 2, 0.7, 2])[0] == ".....FFF"
    assert switched(plant, [2] * 3 + [0.4] * 19 + [0.6] + [-0.4] * 20)[0] == ".." + "F" * 40 + "."
    assert switched(plant, [2] * 3 + [0.4] * 20 + [2, 2, 2])[0] == ".." + "F" * 20 + "...F"
    assert switched(plant, [-2, 2, -2])[0] == "..F"


def test_channel_waits_where_nothing_is_said(plant):
    assert switched(plant, [2, 2, None, None, 2])[0] == "....F"
    assert switched(plant, [2] * 3 + [0.4] * 19 + [None] * 30 + [0.4])[0] == ".." + "F" * 50 + "."


def test_channel_asks_for_more_while_an_estimate_has_not_got_over_a_gap(plant):
    gap, low = [None] * 2, [0.1] * 3
    stds = [1.0] * 3 + [3.0] * 2
    assert switched(plant, low + gap + [2] * 6, stds=stds + [3.0] * 6)[0] == "." * 11  # 2 is within 3 times the threshold
    assert switched(plant, low + gap + [4] * 6, stds=stds + [3.0] * 6)[0] == "." * 7 + "FFFF"
    assert switched(plant, low + gap + [2] * 6, stds=[*stds, 3.0, 2.5, 1.09, 1, 1, 1])[0] == "." * 9 + "FF"
    assert switched(plant, low + [2] * 6, stds=[1.0] * 3 + [3.0] * 6)[0] == "." * 5 + "FFFF"  # there was no gap
    on = [2] * 3 + gap + [0.6] * 30
    assert switched(plant, on, stds=[1.0] * 3 + [9.0] * 32)[0] == ".." + "F" * 33  # what is on does not go off for it
    assert switched(plant, low + gap + [2] * 20, stds=stds + [3.0] * 20)[0] == "." * 17 + "F" * 8  # 3 is the usual by then


def test_smoothing_starts_at_zero_and_goes_on_for_the_samples_that_an_estimate_spans(plant):
    _, said = switched(plant, [1, 1], 0.2)
    assert said.signals["smoothed"][0] == pytest.approx(0.36)
    rule = by_channels(plant, fault_inputs(plant, ("lon",)), 0.2, np.ones(1))
    _, said = rule.step(
        rule.start(1), np.array([2]), Reading(np.ones((1, 4)), np.eye(4)[None], span=np.array([2])), np.array([True])
    )
    assert said.signals["smoothed"][0] == pytest.approx(0.36)


def test_label_is_the_flagged_set(plant):
    labels, sets = channel_sets(plant, fault_inputs(plant))
    names = [label.name for label in plant.labels]

    def said(on, severity):
        return names[label_of_channels(labels, sets, np.array([on], bool), np.array([severity], float))[0]]

    assert said([0, 0, 0, 0], [9, 9, 9, 9]) == "none"
    assert said([0, 1, 0, 0], [9, 0, 9, 9]) == "lon"
    assert said([1, 0, 0, 1], [1, 9, 9, 0]) == "col+ped"
    assert said([1, 1, 0, 1], [3, 1, 9, 2]) == "col+ped"  # no label has three: the most severe two
    labels, sets = channel_sets(plant, fault_inputs(plant, P3))
    assert [names[i] for i in labels] == ["none", "lon", "lat", "ped", "lon+lat", "lon+ped", "lat+ped"]


def test_bank_transitions():
    sets = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], bool)
    Pi = transitions(sets, 0.01, 0.1)
    assert Pi[0] == pytest.approx([0.98, 0.01, 0.01, 0])
    assert Pi[1] == pytest.approx([0.1, 0.89, 0, 0.01])
    assert Pi[3] == pytest.approx([0, 0.1, 0.1, 0.8])


# -- conduct


def test_plant_conforms(plant):
    check_plant(plant, range(3))
    check_streams(plant)


@pytest.mark.parametrize("task", ["isolation", "identification"])
def test_vector_environment_equals_single_ones(plant, task):
    check_vector_env(plant, n=3, steps=150, task=task)


GAPS = {
    **{f"{n} samples": lambda y, n=n: np.where((k := np.arange(y.shape[1])[:, None]) - 150 < n, k >= 150, False)
       for n in (1, 5, 10, 20, 40)},
    "one sensor every seventh": lambda y: (np.arange(y.shape[1])[:, None] % 7 == 3) & (np.arange(9) == 1),
    "nothing at first": lambda y: np.arange(y.shape[1])[:, None] == 0,
    "a tenth of all": lambda y: np.random.default_rng(5).random(y.shape) < 0.1,
}  # fmt: skip


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("flights", [8, pytest.param(60, marks=pytest.mark.slow)])
def test_gaps_raise_no_alarms(plant, name, flights):
    """As many healthy flights with a false alarm as without gaps, but for the few that the rate of 5 % allows."""
    scenarios = [huav_hover.fault_free_episode(s).replace(steps=300) for s in range(7000, 7000 + flights)]
    obs = simulate(plant, scenarios).obs
    diagnoser = guarded(build(name, plant, scenarios), plant)

    def alarmed(obs):
        said = run(diagnoser, obs)
        assert (said.label >= 0).all(), "lost"
        return said.alarm.any(axis=1).sum()

    allowed = alarmed(obs) + (0.05 * flights + 2 * (0.05 * flights) ** 0.5 if flights > 8 else 0)
    for gap, lost in GAPS.items():
        holes = obs.copy()
        holes[..., :9][np.broadcast_to(lost(holes[..., :9]), holes[..., :9].shape)] = np.nan
        assert alarmed(holes) <= allowed, gap


@pytest.mark.parametrize("name", ALL)
def test_missing_sensors_are_removed_rows(plant, name):
    """What a missing sensor would have read changes nothing, and a sample without any is a prediction."""
    scenarios = [huav_hover.episode(s) for s in range(2)]
    diagnoser = build(name, plant, scenarios)
    obs = simulate(plant, scenarios).obs[:, :60]
    filter = diagnoser.filter
    state = diagnoser.init(2)
    for k in range(60):
        state, _ = diagnoser.update(state, obs[:, k])
    y, u, known = plant.split(obs[:, -1])
    at = Interval(np.full(2, 59), u, None, known)
    moved = filter.predict(state.filter, at)
    seen = np.ones((2, 9), bool)
    seen[:, [0, 4, 8]] = False
    found = filter.read(filter.update(moved, at, y, seen))
    for other in (0.0, 1e3):
        again = filter.read(filter.update(moved, at, np.where(seen, y, other), seen))
        assert again.z == pytest.approx(found.z, rel=1e-12, abs=1e-15)
        assert again.x == pytest.approx(found.x, rel=1e-12, abs=1e-15)
    nothing = filter.read(filter.update(moved, at, np.zeros_like(y), np.zeros_like(seen)))
    assert nothing.z == pytest.approx(filter.read(moved).z, rel=1e-9, abs=1e-12) or name == "hypothesis_bank"
    assert nothing.x == pytest.approx(filter.read(moved).x, rel=1e-9, abs=1e-12) or name == "hypothesis_bank"
    if name == "hypothesis_bank":
        assert nothing.probs[:, : moved.c.shape[1]] == pytest.approx(moved.c, rel=1e-9)


def test_channels_left_out_are_taken_as_healthy(plant):
    obs = simulate(plant, [huav_hover.paper(3)]).obs[:, :420]
    _, said = last_state(build("three_stage_cdkf", plant, channels=P3), obs)
    assert said.estimate[0, 0] == 0
    assert said.estimate_std[0, 0] == 0


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", [*FILTERS, "hypothesis_bank"])
def test_a_lost_filter_is_counted_and_its_neighbours_go_on(plant, name):
    obs = simulate(plant, [huav_hover.episode(s) for s in range(3)]).obs[:, :60]
    wrecked = obs.copy()
    wrecked[1, 30, :9] = 1e300
    said = run(guarded(build(name, plant), plant), wrecked)
    assert (said.label[1, 31:] == -1).all()
    assert np.isnan(said.estimate[1, 31:]).all()
    clean = run(guarded(build(name, plant), plant), obs)
    for i in (0, 2):
        assert np.array_equal(said.label[i], clean.label[i])
        assert said.estimate[i] == pytest.approx(clean.estimate[i], rel=1e-9, abs=1e-12)


# -- slow


def covariances(name, s):
    """The covariances that a filter's state carries."""
    if name == "hypothesis_bank":  # the errors that a hypothesis excludes have none
        return [s.P[:, :, :11, :11], s.P[:, :, 15:, 15:]]
    if name == "ascdkf":
        return [s.P]
    return [s.Px, s.Pb, s.Pd] if name.startswith("three") else [s.P, s.cov_b, s.cov_d]


@pytest.mark.slow
@pytest.mark.parametrize("name", [*FILTERS, "hypothesis_bank"])
def test_covariances_stay_positive_definite_over_a_long_flight(plant, name):
    """A thousand seconds with faults that come and go."""
    steps = 50_000 if name != "hypothesis_bank" else 10_000
    faults = [huav_hover.bias(P4[i % 4], 0.008 * (-1) ** (i // 4), 1000 * i + 300, 1000 * i + 700)
              for i in range(steps // 1000)]  # fmt: skip
    scenario = FaultScenario(plant=plant.id, steps=steps, faults=faults, disturbance=huav_hover.PAPER_GUSTS)
    record = simulate(plant, [scenario])
    assert not record.terminated[0]
    diagnoser = build(name, plant)
    state = diagnoser.init(1)
    for k in range(steps + 1):
        state, said = diagnoser.update(state, record.obs[:, k])
        if k % 50:
            continue
        for P in covariances(name, state.filter) if k else ():
            assert np.array_equal(P, np.swapaxes(P, -1, -2)), f"sample {k}"
            assert (np.linalg.eigvalsh(P) > 0).all(), f"sample {k}"
        assert np.isfinite(said.estimate).all()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "channels", "kappa"), [
    ("three_stage_cdkf", P4, 0.3), ("robust_three_stage_cdkf", P4, 0.3), ("ascdkf", P3, 0.0),
])  # fmt: skip
def test_thresholds_are_those_of_the_fault_free_flights(name, channels, kappa):
    """The shipped ones are the 99 % quantiles, over a hundred flights, of the largest smoothed estimates."""
    plant = load_plant(huav_hover.ID, kappa=kappa)
    process = plant.process("fault-free")
    scenarios = [process.sample(np.random.default_rng([s, 1])).replace(noise_seed=s + 1_000_000) for s in range(5000, 5100)]
    most = np.zeros((100, len(channels)))
    for _, verdict in readings(
        plant, build(name, plant, channels=channels), fly(plant, scenarios, huav_hover.prescribed_noise).obs
    ):
        most = np.maximum(most, verdict.evidence.channels)
    shipped = find_diagnoser(name).resolve(plant, channels=channels)["thresholds"]
    assert np.quantile(most, 0.99, axis=0) / MRAD == pytest.approx(np.array(shipped) / MRAD, abs=0.00051)


@pytest.mark.slow
@pytest.mark.parametrize(("kappa", "shares"), [
    (0.0, (0.866, 0.962, 0.989, 1.0)), (0.3, (0.824, 0.920, 0.969, 0.985)), (1.0, (0.771, 0.885, 0.924, 0.950)),
])  # fmt: skip
def test_matched_oracle_attributes_as_the_data_sheet_says(kappa, shares):
    scenarios = [s for s in map(huav_hover.episode, range(400)) if len(s.faults) == 1]
    assert len(scenarios) == 262
    plant = load_plant(huav_hover.ID, kappa=kappa)
    record = fly(plant, scenarios, huav_hover.prescribed_noise)
    said = run(build("matched_oracle", plant, scenarios=scenarios), record.obs)
    i, fault = np.arange(262), [s.faults[0] for s in scenarios]
    truth = np.array([1 + P4.index(f.mode) for f in fault])
    onset, end = np.array([f.onset for f in fault]), np.array([f.end for f in fault])
    for window, share in zip((10, 25, 50, 100), shares, strict=True):
        k = np.minimum(np.minimum(onset + window, end), record.length)
        assert (said.label[i, k] == truth).mean() == pytest.approx(share, abs=0.00051)
