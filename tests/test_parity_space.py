"""Parity space: what no state and no disturbance moves, what a fault moves, and when nothing is left."""

import msgspec
import numpy as np
import pytest
import scipy.linalg
from conftest import build, readings, states
from test_general_filters import belief_of

from baselines.filters.parity_space import parity_filter
from fdi_gym.diagnosis import NotApplicableError, make_diagnoser
from fdi_gym.diagnosis.fitting import flights_of
from fdi_gym.estimation.parity import projected, stacked

SIZE, ORDER = "parity residual", 10


def flown(plant, x0, u, d=None, theta=None, noise=None):
    """Observations (N, K + 1, n_obs) of a plant without known signals under commands u (N, K, n_u), from its equations."""
    (N, K, _), x = u.shape, x0
    obs = np.zeros((N, K + 1, len(plant.observed)))
    held = np.concatenate([np.tile(plant.trim_command, (N, 1, 1)), u], axis=1)
    for k in range(K + 1):
        if k:
            now = None if d is None else d[:, k - 1]
            x = plant.propagate((k - 1) * plant.dt, x, held[:, k], theta, now)
        y = plant.measure(k * plant.dt, x, held[:, k], theta)
        obs[:, k] = np.concatenate([y if noise is None else y + noise[:, k], held[:, k]], axis=1)
    return obs


def last_size(plant, belief, obs):
    *_, r = readings(plant, parity_filter(plant, belief, ORDER, (1,)), obs)
    return r.signals[SIZE]


def commands(plant, N=4, K=2 * ORDER):
    return np.random.default_rng(0).standard_normal((N, K, len(plant.commands))) * [s.scale for s in plant.commands]


def test_without_noise_and_fault_it_is_zero_for_any_state_and_command(b747):
    x0 = 50.0 * np.random.default_rng(1).standard_normal((4, 4))
    u = commands(b747)
    assert last_size(b747, belief_of(b747), flown(b747, x0, u)).max() < 1e-18
    theta = b747.nominal_theta + np.array([0.0, 0.0, 3.0, 0.0])
    assert last_size(b747, belief_of(b747), flown(b747, x0, u, theta=theta)).min() > 1e-3


def test_an_unmeasured_disturbance_leaves_no_trace(b747):
    """With the gust among the unknown disturbances; a filter that does not know of it is moved."""
    rng = np.random.default_rng(2)
    u, x0 = commands(b747), np.zeros((4, 4))
    gust = 20.0 * rng.standard_normal((4, u.shape[1], 1))
    obs = flown(b747, x0, u, gust)
    assert last_size(b747, belief_of(b747, "gust"), obs).max() < 1e-18
    assert last_size(b747, belief_of(b747), obs).min() > 1.0


def test_a_fault_moves_it_by_its_signature(b747):
    """r = V z, exactly where the model is linear in the fault: what the sums say is G z."""
    z = np.array([0.0, 0.0, 4.0, -1.0])
    obs = flown(b747, np.zeros((4, 4)), commands(b747), theta=b747.nominal_theta + z)
    *_, w = states(b747, parity_filter(b747, belief_of(b747), ORDER, (1, 4)), obs)
    assert np.allclose(w.sums.g, w.sums.G @ z, rtol=1e-9, atol=1e-9 * np.abs(w.sums.g).max())
    assert np.abs(w.sums.g).max() > 1.0


def test_white_under_the_noise_of_the_model(b747):
    """Mean square of a whitened residual: one for each parity relation."""
    rng, belief = np.random.default_rng(3), belief_of(b747)
    A, s, N = np.stack([np.eye(4) + 0.1 * rng.standard_normal((4, 4)) for _ in range(ORDER)])[None], ORDER, 4000
    C, none = np.tile(np.eye(4), (1, s + 1, 1, 1)), np.zeros((1, s, 4, 1))
    w = stacked(A, none, none[..., :0], np.tile(belief.Q, (1, s, 1, 1)), C, np.zeros((1, s + 1, 4, 1)), belief.R,
                np.ones((1, s + 1, 4), bool))  # fmt: skip
    x, e = rng.standard_normal((N, 4)), []
    for i in range(s + 1):
        x = x if not i else x @ A[0, i - 1].T + rng.multivariate_normal(np.zeros(4), belief.Q, N)
        e.append(x + rng.multivariate_normal(np.zeros(4), belief.R, N))
    e = np.stack(e, axis=1).reshape(N, -1)
    (r,) = projected(w, np.ones(4), e.T[None])
    relations = 4 * (s + 1) - 4
    assert (r[0] ** 2).sum(axis=0).mean() == pytest.approx(relations, rel=5 * (2 / relations / N) ** 0.5)


def test_projection_is_all_parity_vectors(b747):
    """r' (W S W')^-1 r with r = W e, W a basis of the left null space of [O, B], as in the paper."""
    rng = np.random.default_rng(4)
    s, m, n_x, q = 5, 3, 4, 1
    A, D = rng.standard_normal((1, s, n_x, n_x)), rng.standard_normal((1, s, n_x, q))
    seen = np.ones((1, s + 1, m), bool)
    seen[0, 2, 1] = seen[0, 4] = False
    Q, R = np.tile(np.diag([0.1, 0.2, 0.3, 0.4]), (1, s, 1, 1)), np.diag([0.5, 1.0, 2.0])
    w = stacked(A, D, D, Q, rng.standard_normal((1, s + 1, m, n_x)), np.zeros((1, s + 1, m, q)), R, seen)
    e = rng.standard_normal((m * (s + 1), 1)) * seen.reshape(-1, 1)
    (r,) = projected(w, np.ones(n_x + s * q), e[None])
    W = scipy.linalg.null_space(np.concatenate([w.O[0], w.B[0]], axis=1).T).T
    assert len(W) == m * (s + 1) - n_x - s * q
    expected = (W @ e).T @ np.linalg.solve(W @ w.S[0] @ W.T, W @ e)
    assert (r**2).sum() == pytest.approx(float(expected[0, 0]), rel=1e-9)


def test_no_relation_no_method(motor):
    """One sensor, two states and a free disturbance at each interval: s + 1 samples, s + 2 unknowns."""
    belief = belief_of(motor)
    assert parity_filter(motor, belief, ORDER, (1,))
    poorer = msgspec.structs.replace(belief, sensors=belief.sensors[1:], R=belief.R[1:, 1:])
    with pytest.raises(NotApplicableError, match="no parity relation"):
        parity_filter(motor, poorer, ORDER, (1,))


@pytest.mark.parametrize("settings", [{"order": 0}, {"paces": ()}, {"paces": (0.5,)}])
def test_bad_settings(b747, settings):
    with pytest.raises(ValueError, match="order of at least 1"):
        make_diagnoser("parity_space", b747, **settings)


def test_names_faults_of_the_747():
    """Better than chance by far on flights of the standard process: it isolates."""
    plant = build("B747Lateral")
    record = flights_of(plant, "standard", 400_000, 30, True)[1]
    from fdi_gym.diagnosis import run

    said = run(make_diagnoser("parity_space", plant), record.obs)
    faulty = record.label[:, -1] > 0
    assert (said.label == record.label)[faulty, -1].mean() > 0.7
