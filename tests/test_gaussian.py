"""The compiled Gaussian step and the decision automaton, against textbook formulas in NumPy."""

import copy
import dataclasses

import numpy as np
import pytest
from conftest import PLANTS, build

from fdi_gym.discovery import load_plant
from fdi_gym.estimation import automaton, gaussian
from fdi_gym.estimation.gaussian import RULES
from fdi_gym.kernels import kernel
from fdi_gym.model import NotApplicableError


@kernel
def dynamics(t, x, u, theta, d, p, dx):
    """Equations that see the time, and all that there is."""
    dx[0] = theta[0] * u[0] * np.cos(t) - x[0] * x[1] + d[0]
    dx[1] = theta[1] * x[0] - np.sin(t) * x[1] + theta[2] * d[0]


@kernel
def jacobian(t, x, u, theta, d, p, J_x, J_theta, J_d, J_p):
    """Their derivatives."""
    J_x[0, 0], J_x[0, 1] = -x[1], -x[0]
    J_x[1, 0], J_x[1, 1] = theta[1], -np.sin(t)
    J_theta[0, 0], J_theta[1, 1], J_theta[1, 2] = u[0] * np.cos(t), x[0], d[0]
    J_d[0, 0], J_d[1, 0] = 1.0, theta[2]


@kernel
def project(x, theta):
    """Onto a curve."""
    size = np.sqrt(1.0 + (x[0] / 50.0) ** 2 + (x[1] / 500.0) ** 2)
    x[0] /= size
    x[1] /= size


@kernel
def output(t, x, u, theta, d, p, y):
    """The same."""
    y[0] = x[0] * np.cos(t) + theta[2] + 0.1 * u[0]
    y[1] = x[0] * x[1] + t + d[0]


KERNELS = build("DCMotor").kernels._replace(dynamics=dynamics, output=output, jacobian=jacobian)
CLOCKS = {
    "clock": dataclasses.replace(build("DCMotor"), kernels=KERNELS),
    "clock on a curve": dataclasses.replace(build("DCMotor"), kernels=KERNELS._replace(project=project), substeps=3),
    "discrete clock": dataclasses.replace(build("DCMotor"), kernels=KERNELS, substeps=0),
}
ALL_PLANTS = [*PLANTS, "DCMotor", "clock"]
DIFFERENTIATED = [plant_id for plant_id in PLANTS if build(plant_id).kernels.jacobian is not None] + list(CLOCKS)
EPISODES = 6
TOLERANCE = 1e-10  # in units of standard deviations


class Case:
    """A plant with its whole theta estimated, and a random Gaussian for each of n episodes.

    Without `lines` half of its disturbances are in X; with them none is, and all are known. Its Jacobians are those of
    differences, but where the plant's own derivatives are asked for.
    """

    def __init__(self, plant_id, lines=None, n=EPISODES, seed=0, derivatives=False):
        plant = CLOCKS.get(plant_id) or build(plant_id)
        if not derivatives:
            plant = dataclasses.replace(plant, kernels=plant.kernels._replace(jacobian=None))
        self.plant = plant
        rng = self.rng = np.random.default_rng(seed)
        p, n_D = len(plant.theta), len(plant.disturbances)
        self.entries = rng.permutation(p)
        self.disturbances = rng.permutation(n_D)[: (n_D + 1) // 2 if lines is None else 0]
        self.sensors = rng.permutation(len(plant.outputs))
        if lines is None:
            self.offset, self.direction = np.zeros((1, p)), np.eye(p)[None]
        else:
            self.offset, self.direction = 0.1 * rng.standard_normal((lines, p)), rng.standard_normal((lines, p, 2))
        n_m = self.direction.shape[2]
        self.scale = np.concatenate([
            [s.scale for s in plant.states], 0.3 * np.ones(n_m), [plant.disturbances[i].scale for i in self.disturbances]
        ])  # fmt: skip
        N, m = len(self.scale), len(self.sensors)
        centre = np.concatenate([plant.trim_state, np.zeros(N - len(plant.states))])
        self.X = centre + 0.05 * self.scale * rng.standard_normal((n, N))
        self.P = self.random_covariance(n, 0.02 * self.scale)
        self.Q = self.random_covariance(1 if lines is None else lines, 0.005 * self.scale)
        self.noise = np.array([0.01 * plant.outputs[i].scale for i in self.sensors])
        self.R = self.random_covariance(1, self.noise)
        self.t = rng.uniform(0, 10, n)
        self.u = plant.trim_command + 0.1 * rng.standard_normal((n, len(plant.commands)))
        self.d = 0.1 * rng.standard_normal((n, n_D)) * [s.scale for s in plant.disturbances] if n_D else np.zeros((n, 0))
        self.y = self.h(self.X[:, None])[:, 0] + 2 * self.noise * rng.standard_normal((n, m))
        self.limit = np.full(N, np.inf)
        self.model = self.bind()

    def bind(self, **changes):
        return gaussian.bind(self.plant, **{
            "scale": self.scale, "entries": self.entries, "disturbances": self.disturbances, "sensors": self.sensors,
            "limit": self.limit, "lines": (self.offset, self.direction), **changes,
        })  # fmt: skip

    def random_covariance(self, n, std):
        root = self.rng.standard_normal((n, len(std), 2 * len(std)))
        return std[:, None] * (root @ np.swapaxes(root, 1, 2) / (2 * len(std))) * std

    def inputs(self, points):
        """theta and d of points (n, M, N)."""
        n_x, n_m = len(self.plant.states), self.direction.shape[2]
        theta = np.tile(self.plant.nominal_theta, (*points.shape[:2], 1))
        d = np.repeat(self.d[:, None], points.shape[1], axis=1)
        for i in range(len(points)):
            line = i % len(self.offset)
            theta[i][:, self.entries] += self.offset[line] + points[i, :, n_x : n_x + n_m] @ self.direction[line].T
        d[..., self.disturbances] = points[..., n_x + n_m :]
        return theta, d

    def f(self, points):
        theta, d = self.inputs(points)
        moved, n_x = points.copy(), len(self.plant.states)
        moved[..., :n_x] = self.plant.propagate(self.t, points[..., :n_x], self.u, theta, d)
        return moved

    def h(self, points):
        theta, d = self.inputs(points)
        return self.plant.measure(self.t, points[..., : len(self.plant.states)], self.u, theta, d)[..., self.sensors]

    def seen(self):
        """Which sensors reported: none in the first episode, all in the second, any in the others."""
        pattern = self.rng.random(self.y.shape) < 0.6
        pattern[0], pattern[1] = False, True
        return pattern

    def predict(self, rule, **changes):
        given = {"X": self.X, "P": self.P, "t": self.t, "u": self.u, "d": self.d, "Q": self.Q, "model": self.model}
        return gaussian.predict(rule=rule, **given | changes)

    def update(self, rule, seen, **changes):
        given = {"X": self.X, "P": self.P, "t": self.t, "u": self.u, "d": self.d, "y": self.y, "R": self.R}
        return gaussian.update(rule=rule, seen=seen, **{"model": self.model} | given | changes)


def moments(rule, g, X, P, step):
    """Mean, covariance and covariance with X of g of one Gaussian, from the papers' formulas."""
    N = len(X)
    if rule == "extended":
        J = np.stack([(g(X + e) - g(X - e)) / (2 * e.sum()) for e in np.diag(step)], axis=1)
        return g(X), J @ P @ J.T, P @ J.T
    L = np.linalg.cholesky(P)
    if rule == "unscented":
        w = np.array([2 / (N + 2)] + [1 / (2 * (N + 2))] * (2 * N))
        points = np.array([X, *(X + np.sqrt(N + 2) * L.T), *(X - np.sqrt(N + 2) * L.T)])
        values = np.array([g(x) for x in points])
        mean = w @ values
        return mean, (values - mean).T @ np.diag(w) @ (values - mean), (points - X).T @ np.diag(w) @ (values - mean)
    h = np.sqrt(3)
    plus, minus = (np.array([g(X + sign * h * s) for s in L.T]).T for sign in (1, -1))
    centre = g(X)
    D1, D2 = (plus - minus) / (2 * h), np.sqrt(h**2 - 1) / (2 * h**2) * (plus + minus - 2 * centre[:, None])
    mean = (h**2 - N) / h**2 * centre + (plus + minus).sum(axis=1) / (2 * h**2)
    return mean, D1 @ D1.T + D2 @ D2.T, L @ D1.T


def on_one(function, i):
    """A function of stacks of points as one of a point of episode i."""

    def g(x):
        stack = np.zeros((EPISODES, 1, len(x)))
        stack[i, 0] = x
        return function(stack)[i, 0]

    return g


def assert_close(X, P, expected_X, expected_P):
    std = np.sqrt(np.diag(expected_P))
    assert X / std == pytest.approx(expected_X / std, abs=TOLERANCE, rel=TOLERANCE)
    assert P / np.outer(std, std) == pytest.approx(expected_P / np.outer(std, std), abs=TOLERANCE)


# -- the model


@pytest.mark.parametrize("plant_id", ALL_PLANTS)
@pytest.mark.parametrize("lines", [None, 3])
def test_f_and_h_are_the_plants(plant_id, lines):
    case = Case(plant_id, lines)
    points = case.X[:, None] + 0.1 * case.scale * case.rng.standard_normal((EPISODES, 5, len(case.scale)))
    moved = gaussian.f(case.model, points, case.t, case.u, case.d)
    assert moved == pytest.approx(case.f(points), rel=1e-13, abs=1e-13)
    assert np.array_equal(moved[..., len(case.plant.states) :], points[..., len(case.plant.states) :])
    assert gaussian.h(case.model, points, case.t, case.u, case.d) == pytest.approx(case.h(points), rel=1e-13, abs=1e-13)


@pytest.mark.parametrize("plant_id", ALL_PLANTS)
@pytest.mark.parametrize("which", ["f", "h"])
def test_jacobians_are_central_differences(plant_id, which):
    case = Case(plant_id)
    function = getattr(case, which)
    value, J = getattr(gaussian, f"jacobian_{which}")(case.model, case.X, case.t, case.u, case.d)
    assert value == pytest.approx(function(case.X[:, None])[:, 0], rel=1e-13, abs=1e-13)
    step = 1e-3 * case.scale
    plus, minus = (function(case.X[:, None] + sign * np.diag(step)) for sign in (1, -1))
    expected = np.swapaxes(plus - minus, 1, 2) / (2 * step)
    unit = np.abs(expected * case.scale).max(axis=2, keepdims=True)
    unit = np.where(unit > 0, unit, 1.0) / case.scale  # a sign does not move
    assert J / unit == pytest.approx(expected / unit, abs=1e-10)


@pytest.mark.parametrize("plant_id", DIFFERENTIATED)
@pytest.mark.parametrize("lines", [None, 3])
@pytest.mark.parametrize("physical", [False, True])
def test_with_the_plants_derivatives_the_jacobian_is_exact(plant_id, lines, physical):
    """Against a five-point difference; the prediction is F P F' + Q with it, and the mean the plant's to the bit."""
    case = Case(plant_id, lines, derivatives=True)
    if physical:  # entries beyond theta
        case.entries = len(case.plant.theta) + case.rng.permutation(len(case.plant.nominal_p))[: len(case.entries)]
        used = slice(0, len(case.entries))
        case.offset, case.direction = 0.1 * case.offset[:, used], 0.1 * case.direction[:, used]
        case.model = case.bind()
    X, F = gaussian.jacobian_f(case.model, case.X, case.t, case.u, case.d)
    step = 1e-5 * case.scale

    def f(points):
        return gaussian.f(case.model, points, case.t, case.u, case.d)

    assert np.array_equal(X, f(case.X[:, None])[:, 0])
    values = [f(case.X[:, None] + j * np.diag(step)) for j in (-2, -1, 1, 2)]
    five = np.swapaxes(values[0] - 8 * values[1] + 8 * values[2] - values[3], 1, 2) / (12 * step)
    unit = np.abs(five * case.scale).max(axis=2, keepdims=True) / case.scale
    unit = np.where(unit > 0, unit, 1.0)
    assert F / unit == pytest.approx(five / unit, abs=2e-8)
    mean, P = case.predict("extended")
    assert np.array_equal(mean, X)
    expected = F @ case.P @ np.swapaxes(F, 1, 2) + case.Q[np.arange(EPISODES) % len(case.Q)]
    std = np.sqrt(np.einsum("nii->ni", expected))
    unit = std[:, :, None] * std[:, None]
    assert P / unit == pytest.approx(expected / unit, abs=TOLERANCE)


def test_only_one_plant_is_linear_and_is_taken_so():
    assert [plant_id for plant_id in ALL_PLANTS if len(Case(plant_id).model.linear)] == ["B747Lateral"]


# -- predict and update


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("lines", [None, 3])
@pytest.mark.parametrize("plant_id", ALL_PLANTS)
def test_prediction_is_the_textbooks(plant_id, lines, rule):
    case = Case(plant_id, lines)
    X, P = case.predict(rule)
    for i in range(EPISODES):
        mean, cov, _ = moments(rule, on_one(case.f, i), case.X[i], case.P[i], 1e-3 * case.scale)
        assert_close(X[i], P[i], mean, cov + case.Q[i % len(case.Q)])
    assert np.array_equal(P, np.swapaxes(P, 1, 2))


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("lines", [None, 3])
@pytest.mark.parametrize("plant_id", ALL_PLANTS)
def test_update_is_the_textbooks_without_the_rows_of_missing_sensors(plant_id, lines, rule):
    case = Case(plant_id, lines)
    seen = case.seen()
    got = case.update(rule, seen, y=np.where(seen, case.y, np.nan))
    for i, rows in enumerate(seen):
        mean, cov, cross = moments(rule, on_one(case.h, i), case.X[i], case.P[i], 1e-3 * case.scale)
        nu, S, cross = (case.y[i] - mean)[rows], (cov + case.R[0])[np.ix_(rows, rows)], cross[:, rows]
        K = cross @ np.linalg.inv(S)
        assert_close(got.X[i], got.P[i], case.X[i] + K @ nu, case.P[i] - K @ S @ K.T)
        assert got.nu[i, rows] / case.noise[rows] == pytest.approx(nu / case.noise[rows], rel=1e-9, abs=1e-9)
        assert got.S[i][np.ix_(rows, rows)] == pytest.approx(S, rel=1e-9, abs=1e-9 * np.abs(S).max(initial=0))
        assert not got.nu[i, ~rows].any()
        assert np.array_equal(got.S[i][~rows], np.eye(len(rows))[~rows])
        assert np.array_equal(got.S[i][:, ~rows], np.eye(len(rows))[:, ~rows])
        nis, size = nu @ np.linalg.solve(S, nu), np.linalg.slogdet(2 * np.pi * S)[1] if rows.any() else 0.0
        assert got.nis[i] == pytest.approx(nis, rel=1e-9)
        assert got.log_likelihood[i] == pytest.approx(-0.5 * (nis + size), rel=1e-9)
    assert np.array_equal(got.P, np.swapaxes(got.P, 1, 2))
    assert np.array_equal(got.X[0], case.X[0])  # nothing was seen: the prediction stands
    assert got.P[0] == pytest.approx(case.P[0], rel=1e-15)
    assert (got.nis[0], got.log_likelihood[0]) == (0.0, 0.0)


@pytest.mark.parametrize("plant_id", ALL_PLANTS)
def test_linear_sensors_are_the_cheap_case_of_the_rules(plant_id):
    """With H given, h is H X: the update that `correct` makes of these moments, gain included."""
    case = Case(plant_id)
    m, N = case.y.shape[1], len(case.scale)
    H = case.rng.standard_normal((m, N)) * case.noise[:, None] / (0.02 * case.scale)
    seen = case.seen()
    got = case.update("extended", seen, model=case.bind(H=H))
    cross = case.P @ H.T
    own = gaussian.correct(case.X, case.P, case.X @ H.T, cross, H @ cross + case.R, case.y, seen)
    for i, rows in enumerate(seen):
        S = (H @ case.P[i] @ H.T + case.R[0])[np.ix_(rows, rows)]
        K = case.P[i] @ H[rows].T @ np.linalg.inv(S)
        X = case.X[i] + K @ (case.y[i] - H @ case.X[i])[rows]
        A = np.eye(N) - K @ H[rows]
        joseph = A @ case.P[i] @ A.T + K @ case.R[0][np.ix_(rows, rows)] @ K.T
        assert_close(got.X[i], got.P[i], X, joseph)
        assert_close(own.X[i], own.P[i], X, joseph)
        unit = np.sqrt(np.diag(case.P[i]))[:, None] / case.noise
        assert own.K[i] / unit == pytest.approx(scattered(K, rows) / unit, abs=TOLERANCE)
    for name in ("nu", "S", "nis", "log_likelihood"):
        assert getattr(got, name) == pytest.approx(getattr(own, name), rel=1e-9, abs=1e-12), name


@pytest.mark.parametrize("plant_id", ["HUAVHover", "ThreeTank", "B747Lateral"])
@pytest.mark.parametrize("lines", [None, 3])
def test_faults_of_linear_sensors_need_no_differences(plant_id, lines, monkeypatch):
    monkeypatch.setitem(CLOCKS, "failing", load_plant(plant_id, sensor_faults=True))
    case = Case("failing", lines)
    seen, (m, n_x) = case.seen(), case.model.plain.shape
    assert (m, n_x) == (case.y.shape[1], len(case.plant.states))
    got = case.update("extended", seen)
    differenced = case.update("extended", seen, model=case.model._replace(plain=np.zeros((0, n_x))))
    for i in range(EPISODES):
        assert_close(got.X[i], got.P[i], differenced.X[i], differenced.P[i])


def test_sensors_that_see_more_than_the_state_are_not_plain():
    assert Case("clock").model.plain.shape == (0, 2)
    assert Case("MissilePitch").model.plain.shape == (0, 5)


def scattered(K, rows):
    full = np.zeros((len(K), len(rows)))
    full[:, rows] = K
    return full


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("exact", [True, False])
def test_on_a_linear_plant_every_rule_is_the_kalman_filter(rule, exact):
    """Whether the plant's matrices are used or its equations are called."""
    case = Case("B747Lateral")
    model = case.model if exact else case.model._replace(linear=np.zeros((0, 0)))
    X, P = case.predict(rule, model=model)
    F = gaussian.jacobian_f(case.model, case.X, case.t, case.u, case.d)[1]
    moved = case.f(case.X[:, None])[:, 0]
    H = np.eye(4, len(case.scale))[case.sensors]
    after = case.update(rule, np.ones(case.y.shape, bool), model=model, X=X, P=P)
    for i in range(EPISODES):
        expected = F[i] @ case.P[i] @ F[i].T + case.Q[0]
        assert_close(X[i], P[i], moved[i], expected)
        S = H @ expected @ H.T + case.R[0]
        K = expected @ H.T @ np.linalg.inv(S)
        assert_close(
            after.X[i], after.P[i], moved[i] + K @ (case.y[i] - H @ moved[i]), (np.eye(len(F[i])) - K @ H) @ expected
        )


@pytest.mark.parametrize("rule", RULES)
def test_variances_keep_their_limit_and_correlations_stay(plant, rule):
    case = Case(plant.id)
    _, free = case.predict(rule)
    before = np.einsum("nii->ni", free)
    limit = np.where(case.rng.random(len(case.scale)) < 0.5, 0.5 * before.mean(axis=0), np.inf)
    _, P = case.predict(rule, model=case.bind(limit=limit))
    variance = np.einsum("nii->ni", P)
    assert (before > limit).any()
    assert variance == pytest.approx(np.minimum(before, limit), rel=1e-12)
    correlation = [M / np.sqrt(v[:, :, None] * v[:, None]) for M, v in ((P, variance), (free, before))]
    assert correlation[0] == pytest.approx(correlation[1], abs=1e-12)


# -- numerics


def jittered(P):
    """The lower factor of P with the jitter that helps first; NaN where none does."""
    for jitter in (0.0, *(1e-14 * 100.0**j for j in range(7))):
        try:
            return np.linalg.cholesky(P + jitter * np.eye(len(P)))
        except np.linalg.LinAlgError:
            continue
    return np.full_like(P, np.nan)


@pytest.mark.parametrize("rule", ["unscented", "central difference"])
@pytest.mark.parametrize("lost", [3e-12, 3e-8, 2e-3])
def test_a_covariance_that_lost_its_definiteness_gets_the_jitter_that_helps(rule, lost):
    """`lost`: the negative eigenvalue; the jitters are 1e-14 times powers of 100, up to 1e-2."""
    case = Case("DCMotor")
    N = len(case.scale)
    axes = np.linalg.qr(case.rng.standard_normal((N, N)))[0]
    case.P[2] = axes @ np.diag([-lost, *np.linspace(0.01, 0.02, N - 1)]) @ axes.T
    L = jittered(case.P[2])
    assert np.isfinite(L).all()
    X, P = case.predict(rule)
    mean, cov, _ = moments(rule, on_one(case.f, 2), case.X[2], L @ L.T, None)
    cov[2:, 2:] = case.P[2, 2:, 2:]  # what f leaves alone keeps its covariance as it was
    assert_close(X[2], P[2], mean, cov + case.Q[0])
    others = [0, 1, 3, 4, 5]
    assert np.array_equal(P[others], Case("DCMotor").predict(rule)[1][others])


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("where", ["X", "P", "u", "y"])
def test_what_is_no_number_in_one_episode_reaches_no_other(plant, rule, where):
    case, whole = Case(plant.id), Case(plant.id)
    getattr(case, where)[3] = np.nan
    others, seen = [0, 1, 2, 4, 5], np.ones(case.y.shape, bool)
    for got, expected in (
        (case.predict(rule), whole.predict(rule)), (case.update(rule, seen), whole.update(rule, seen)),
    ):  # fmt: skip
        for a, b in zip(got, expected, strict=True):
            assert np.isfinite(b).all()
            assert np.array_equal(a[others], b[others])
    assert np.isnan(case.update(rule, seen).X[3]).any() or where == "u"


@pytest.mark.parametrize("rule", RULES)
def test_a_hopeless_covariance_is_lost_and_says_so(rule):
    case = Case("HUAVHover")
    case.P[1] = -np.eye(len(case.scale))
    X, P = case.predict(rule) if rule != "extended" else case.update(rule, np.ones(case.y.shape, bool))[:2]
    assert np.isnan(X[1]).any()
    assert np.isnan(P[1]).any()
    assert np.isfinite(X[[0, 2, 3, 4, 5]]).all()


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("lines", [None, 3])
def test_an_episode_does_not_depend_on_its_batch(plant, rule, lines):
    case, seen = Case(plant.id, lines), None
    seen = case.seen()
    together = (*case.predict(rule), *case.update(rule, seen))
    line = len(case.offset)
    for i in range(EPISODES):
        own = (case.offset[i % line][None], case.direction[i % line][None])
        model, one = case.bind(lines=own), slice(i, i + 1)
        given = {"X": case.X[one], "P": case.P[one], "t": case.t[one], "u": case.u[one], "d": case.d[one], "model": model}
        alone = (
            *case.predict(rule, **given, Q=case.Q[i % line][None]), *case.update(rule, seen[one], **given, y=case.y[one])
        )  # fmt: skip
        for a, b in zip(alone, together, strict=True):
            assert np.array_equal(a[0], b[i])


@pytest.mark.parametrize("rule", RULES)
def test_rows_that_serve_several_episodes_are_rows_repeated(plant, rule):
    """Time, command, disturbance and measurement of a bank's six models in two episodes; what is not known is zero."""
    case, seen = Case(plant.id, 3), None
    seen = case.seen()
    few = {name: getattr(case, name)[::3] for name in ("t", "u", "d")}
    many = {name: np.repeat(a, 3, axis=0) for name, a in few.items()}
    y = case.y[::3]
    got = (*case.predict(rule, **few), *case.update(rule, seen[::3], y=y, **few))
    expected = (
        *case.predict(rule, **many), *case.update(rule, np.repeat(seen[::3], 3, axis=0), y=np.repeat(y, 3, axis=0), **many)
    )  # fmt: skip
    for a, b in zip(got, expected, strict=True):
        assert np.array_equal(a, b)
    nothing = np.zeros_like(case.d)
    for a, b in zip(case.predict(rule, d=None), case.predict(rule, d=nothing), strict=True):
        assert np.array_equal(a, b)


def test_any_array_will_do():
    """Read-only, in another order, of another type: what the numbers say counts."""
    case, seen = Case("MissilePitch"), None
    seen = case.seen()
    expected = (*case.predict("unscented"), *case.update("unscented", seen))
    frozen = np.broadcast_to(case.Q, (EPISODES, *case.Q.shape[1:]))
    turned = np.asfortranarray(case.P)
    wide = np.repeat(case.X, 2, axis=1)[:, ::2]
    got = (
        *case.predict("unscented", Q=frozen, P=turned, X=wide),
        *case.update("unscented", np.asfortranarray(seen), P=turned, X=wide),
    )
    for a, b in zip(got, expected, strict=True):
        assert np.array_equal(a, b)


def test_a_copied_model_finds_the_compiled_code_again():
    """What is pickled holds no address; whoever unpickles it asks the plant for its own."""
    case = Case("MissilePitch", derivatives=True)
    assert case.model.constants[0][:3].all()
    assert not case.model.__reduce__()[1][2][0][:3].any()
    again = copy.copy(case.model)
    for rule in ("unscented", "extended"):
        for a, b in zip(case.predict(rule, model=again), case.predict(rule), strict=True):
            assert np.array_equal(a, b)


def test_an_empty_batch_is_one():
    case = Case("DCMotor")
    none = {name: getattr(case, name)[:0] for name in ("X", "P", "t", "u", "d")}
    assert [a.shape[0] for a in case.predict("extended", **none)] == [0, 0]
    assert {a.shape[0] for a in case.update("extended", np.zeros((0, 2), bool), y=case.y[:0], **none)} == {0}


# -- bad input


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"X": np.zeros((6, 3))}, "one entry for each"), ({"P": np.zeros((5, 6, 6))}, "shape"),
        ({"P": np.zeros((6, 5, 5))}, "shape"), ({"t": np.zeros(4)}, "one row for each episode"),
        ({"t": np.zeros(0)}, "one row for each episode"), ({"u": np.zeros((6, 2))}, "each command"),
        ({"u": np.zeros((4, 1))}, "one row for each episode"), ({"d": np.zeros((6, 2))}, "each disturbance"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("act", ["predict", "update"])
def test_shapes_that_do_not_fit_are_refused(changes, says, act):
    case = Case("DCMotor")
    assert case.X.shape == (6, 6)
    with pytest.raises(ValueError, match=says):
        case.predict("extended", **changes) if act == "predict" else case.update("extended", case.seen(), **changes)


def test_an_estimate_of_more_than_the_stack_holds_is_refused(motor):
    lines = np.zeros((1, 1)), np.full((1, 1, 99), 1e-4)
    with pytest.raises(NotApplicableError, match="at most 100 numbers at once, not 101"):
        gaussian.bind(motor, scale=np.ones(101), entries=[0], lines=lines)
    model = gaussian.bind(motor, scale=np.ones(100), entries=[0], lines=(lines[0], lines[1][..., :98]))
    X, P, t, u = np.zeros((1, 100)), np.eye(100)[None] * 1e-8, np.zeros(1), motor.trim_command[None]
    for rule in gaussian.RULES:
        X1, P1 = gaussian.predict(model, rule, X, P, t, u, None, P)
        done = gaussian.update(model, rule, X1, P1, t, u, None, np.zeros((1, 2)), np.ones((1, 2), bool), motor.R[None])
        assert all(np.isfinite(a).all() for a in (X1, P1, done.X, done.P))


def test_other_bad_input_is_refused():
    case = Case("DCMotor")
    seen = case.seen()
    with pytest.raises(ValueError, match="Q needs the shape"):
        case.predict("extended", Q=case.Q[0][None, :5, :5])
    with pytest.raises(ValueError, match="R \\(1, m, m\\)"):
        case.update("extended", seen, R=np.zeros((4, 2, 2)))
    with pytest.raises(ValueError, match="y and seen"):
        case.update("extended", seen[:3])
    with pytest.raises(ValueError, match="unknown rule 'cubature'; there are extended"):
        case.predict("cubature")
    with pytest.raises(TypeError, match="`seen` bool"):
        case.update("extended", seen.astype(float))
    with pytest.raises(TypeError, match="documented dimensions"):
        case.predict("extended", Q=case.Q[0])
    with pytest.raises(ValueError, match="the shapes are"):
        gaussian.correct(case.X, case.P, case.y[:5], case.P[:, :, :2], case.P[:, :2, :2], case.y, seen)
    with pytest.raises(ValueError, match="X needs the shape"):
        gaussian.jacobian_f(case.model, case.X[:, :4], case.t, case.u)
    for changes, says in (
        ({"scale": case.scale[:-1]}, "scale needs 6"), ({"scale": -case.scale}, "positive"),
        ({"entries": [0.5, 1.0, 2.0]}, "list of integers"), ({"entries": np.ones((1, 3), int)}, "list of integers"),
        ({"entries": [0, 0, 1]}, "different positions"), ({"entries": [0, 1, 3 + len(case.plant.nominal_p)]}, "from 0 to"),
        ({"sensors": [2]}, "sensors"), ({"disturbances": [-1]}, "disturbances"), ({"limit": -case.scale}, "limit"),
        ({"limit": [np.nan] * 6}, "limit"), ({"H": np.zeros((2, 5))}, "H needs"),
        ({"H": np.full((2, 6), np.nan)}, "H needs"),
        ({"lines": (np.zeros((2, 3)), np.zeros((1, 3, 1)))}, "lines are"),
        ({"lines": (np.zeros(3), np.eye(3))}, "lines are"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=says):
            case.bind(**changes)


# -- the decision automaton


def plain(state, best, over_now, under_now, rise, switch, release, same):
    """One automaton, one sample, as its definition reads."""
    label, over, other, under, last = state
    fresh = same and best != last
    over = 0 if label or not over_now else 1 if fresh else over + 1
    other = 0 if not label or best == label else 1 if fresh else other + 1
    under = under + 1 if label and under_now else 0
    if under >= release:
        return 0, over, 0, 0, best
    if over >= rise:
        return best, 0, other, under, best
    if other >= switch:
        return best, over, 0, under, best
    return label, over, other, under, best


@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("lengths", [(1, 1, 1), (3, 2, 4), (2, 4, 3), (5, 3, 3)])
@pytest.mark.parametrize("shape", [(40,), (8, 5)])
def test_automaton_is_its_definition(same, lengths, shape):
    rng = np.random.default_rng(3)
    rise, switch, release = lengths
    state, expected, visited = automaton.first(*shape), [(0,) * 5] * 40, set()
    best = rng.integers(0, 3, shape)
    for _ in range(300):
        best = np.where(rng.random(shape) < 0.3, rng.integers(0, 3, shape), best)
        over, under = rng.random(shape) < 0.7, rng.random(shape) < 0.6
        state = automaton.step(state, best, over, under, rise=rise, switch=switch, release=release, same=same)
        flags = zip(best.ravel(), over.ravel(), under.ravel(), strict=True)
        expected = [plain(s, *now, *lengths, same) for s, now in zip(expected, flags, strict=True)]
        assert np.array_equal(np.stack([a.ravel() for a in state], axis=1), expected)
        assert state.label.shape == shape
        visited |= {s[0] for s in expected}
    assert visited == {0, 1, 2}


def test_bad_evidence_is_refused():
    state, flags, best = automaton.first(3), np.ones(3, bool), np.ones(3, np.int64)
    after = automaton.step(state, np.ones(3, np.int32), flags, flags, rise=1, switch=1, release=1)
    assert after.label.tolist() == [1, 1, 1]
    with pytest.raises(ValueError, match="at least one"):
        automaton.step(state, best, flags, flags, rise=0, switch=1, release=1)
    with pytest.raises(ValueError, match="one shape"):
        automaton.step(state, best, flags[:2], flags, rise=1, switch=1, release=1)
    with pytest.raises(ValueError, match="one shape"):
        automaton.step(state, best.reshape(3, 1), flags, flags, rise=1, switch=1, release=1)
    with pytest.raises(TypeError, match="best needs int64"):
        automaton.step(state, best * 1.5, flags, flags, rise=1, switch=1, release=1)
    with pytest.raises(TypeError, match="over_now needs bool"):
        automaton.step(state, best, 1.0 * flags, flags, rise=1, switch=1, release=1)
