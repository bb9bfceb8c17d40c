"""The bank of unknown-input observers: blind to what they are blind to, and there only where theory lets them be."""

import numpy as np
import pytest
from conftest import build, states
from test_general_filters import belief_of
from test_parity_space import commands, flown

from baselines.filters.unknown_input_observers import _missing, bank_filter, existing
from fdi_gym.diagnosis import NotApplicableError, make_diagnoser
from fdi_gym.estimation.augmented import augmented


def bank(plant, process="standard"):
    belief = belief_of(plant, process)
    model = augmented(plant, belief)
    observers = existing(plant, model, belief.z_size)
    return observers, bank_filter(plant, model, belief.z_size, observers, (10,)), model


def followed(plant, obs, process="standard"):
    observers, filter, _ = bank(plant, process)
    *_, s = states(plant, filter, obs)
    return observers, s


@pytest.mark.parametrize("entry", [2, 3])
def test_the_error_does_not_depend_on_the_unknown_input(b747, entry):
    """Any time course of an actuator's error: its own observer estimates as if there were none, the healthy one does not."""
    rng = np.random.default_rng(0)
    u, x0 = commands(b747, 2, 40), np.zeros((2, 4))
    wild = np.zeros((2, 40, 4))
    wild[1, :, entry] = 30.0 * rng.standard_normal(40)
    noise = np.tile(0.1 * rng.standard_normal((1, 41, 4)), (2, 1, 1))
    x, truth, obs = x0, [x0], np.zeros((2, 41, 6))
    obs[:, 1:, 4:] = u[:1]
    for k in range(40):
        x = b747.propagate(0.0, x, np.repeat(u[:1, k], 2, axis=0), b747.nominal_theta + wild[:, k])
        truth.append(x)
    obs[..., :4] = np.stack(truth, axis=1) + noise
    observers, s = followed(b747, obs)
    error = s.X - truth[-1][:, None]
    own = [i for i, label in enumerate(observers.labels) if observers.blind[i, entry]]
    other = [i for i in range(len(observers.labels)) if i not in own]
    assert own
    assert other
    assert np.abs(error[0, own] - error[1, own]).max() < 1e-6 * np.abs(wild).max()
    assert np.abs(error[0, other] - error[1, other]).max() > 1e-3 * np.abs(wild).max()


def test_gusts_move_no_observer_that_is_blind_to_them(b747):
    u, x0 = commands(b747, 2, 30), np.zeros((2, 4))
    u[1] = u[0]
    gust = np.zeros((2, 30, 1))
    gust[1] = 40.0 * np.random.default_rng(1).standard_normal((30, 1))
    obs = flown(b747, x0, u, gust)
    _, s = followed(b747, obs, "gust")
    assert s.r.max() < 1e-4
    _, told = followed(b747, obs)
    assert told.r[1].min() > 1.0


def test_residual_of_the_right_observer_is_chi_square(b747):
    """Under the noise of the model and an actuator's error: mean as many as its degrees of freedom."""
    rng, belief, N = np.random.default_rng(2), belief_of(b747), 400
    obs, x = np.zeros((N, 31, 6)), np.zeros((N, 4))
    u = rng.standard_normal((N, 31, 2))
    error = 5.0 * rng.standard_normal((N, 31))
    for k in range(31):
        if k:
            theta = b747.nominal_theta + error[:, k, None] * np.array([0, 0, 1.0, 0])
            x = b747.propagate(0.0, x, u[:, k], theta) + rng.multivariate_normal(np.zeros(4), belief.Q, N)
        obs[:, k] = np.concatenate([x + rng.multivariate_normal(np.zeros(4), belief.R, N), u[:, k]], axis=1)
    observers, s = followed(b747, obs)
    stuck = list(observers.labels).index(2)
    assert np.allclose(s.freedoms[:, stuck], 3.0, atol=1e-3)
    assert s.r[:, stuck].mean() == pytest.approx(3.0, abs=5 * (6 / N) ** 0.5)
    assert s.r[:, 0].mean() > 6.0


def test_gain_is_that_of_the_unknown_input_filter(b747):
    """Gillijns and De Moor's equations, with a new fault input at each sample and none of the bank's reformulation."""
    observers, filter, model = bank(b747)
    obs = flown(
        b747, np.ones((1, 4)), commands(b747, 1, 20), noise=0.1 * np.random.default_rng(3).standard_normal((1, 21, 4))
    )
    *_, s = states(b747, filter, obs)
    from fdi_gym.estimation.linear import linear_model

    m, i = linear_model(b747), list(observers.labels).index(2)
    x, P = model.X0[:4], model.P0[:4, :4]
    for k in range(21):
        y, u = obs[0, k, :4], obs[0, k, 4:]
        if k:
            G = m.E(u[None])[0][:, 2:3]
            x, P = m.A @ x + m.B @ u, m.A @ P @ m.A.T + model.Q[:4, :4]
            S, F = m.C @ P @ m.C.T + model.R, m.C @ G
            M = np.linalg.solve(F.T @ np.linalg.solve(S, F), F.T @ np.linalg.inv(S))
            x = x + G @ M @ (y - m.C @ x)
            P_star = (np.eye(4) - G @ M @ m.C) @ P @ (np.eye(4) - G @ M @ m.C).T + G @ M @ model.R @ M.T @ G.T
            S_star = -G @ M @ model.R
            K = (P_star @ m.C.T + S_star) @ np.linalg.pinv(
                m.C @ P_star @ m.C.T + model.R + m.C @ S_star + S_star.T @ m.C.T, rcond=1e-9
            )
            L = G @ M + K @ (np.eye(4) - m.C @ G @ M)
            x = x + K @ (y - m.C @ x)
            P = (np.eye(4) - L @ m.C) @ P @ (np.eye(4) - L @ m.C).T + L @ model.R @ L.T
        else:
            K = P @ m.C.T @ np.linalg.inv(m.C @ P @ m.C.T + model.R)
            x, P = x + K @ (y - m.C @ x), P - K @ m.C @ P
    assert np.allclose(s.X[0, i], x, atol=1e-6)
    assert np.allclose(s.P[0, i], P, atol=1e-6)


def test_existence_conditions(b747, motor):
    """The motor's load and a fault are as many unknown inputs as it has sensors; the 747's labels all have an observer."""
    with pytest.raises(NotApplicableError, match="leave no residual of 2 sensors"):
        make_diagnoser("unknown_input_observers", motor)
    assert set(existing(b747, augmented(b747, belief_of(b747)), belief_of(b747).z_size).labels) == set(range(5))
    A, C = np.diag([0.5, 0.5, 1.2]), np.eye(3)[:2]
    assert "rank" in _missing(A, np.eye(3)[:, 2:], C, np.zeros((2, 1)))
    assert "hidden" in _missing(A, np.eye(3)[:, :1], C, np.zeros((2, 1)))
    assert _missing(np.diag([0.5, 0.5, 0.9]), np.eye(3)[:, :1], C, np.zeros((2, 1))) == ""
    assert "leave no residual" in _missing(A, np.eye(3)[:, :2], C, np.zeros((2, 2)))


def test_a_bank_that_costs_too_much_is_declined():
    with pytest.raises(NotApplicableError, match="16 observers of 11 states at 100 samples a second cost too much"):
        make_diagnoser("unknown_input_observers", build("CMGSatellite"))


def test_gaps_leave_an_unknown_input_uncertain(b747):
    """Without a sensor the observer's covariance grows by the fault's typical size, and shrinks again after."""
    obs = flown(b747, np.zeros((1, 4)), commands(b747, 1, 60))
    obs[:, 30:40, :4] = np.nan
    _, filter, _ = bank(b747)
    spread = [np.trace(s.P[0, -1]) for s in states(b747, filter, obs)]
    assert spread[39] > 2 * spread[29]
    assert spread[60] < 1.5 * spread[29]


def test_bad_settings(b747):
    with pytest.raises(ValueError, match="paces"):
        make_diagnoser("unknown_input_observers", b747, paces=(0.1,))
