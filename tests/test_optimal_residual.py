"""The unified solution: disturbances pass with gain 1, and no other observer has a better ratio."""

import numpy as np
import pytest
import scipy.linalg
from conftest import build, states
from test_general_filters import belief_of
from test_parity_space import commands, flown

from baselines.filters.optimal_residual import residual_filter, steady
from fdi_gym.diagnosis import NotApplicableError, make_diagnoser
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.linear import linear_model

FREQUENCIES = np.exp(1j * np.linspace(0.0, np.pi, 60))


def responses(plant, L, V, B, D):
    """Of V (y - y^) with the predictor's gain L to inputs that enter x by B and y by D, at all frequencies."""
    s = steady(plant, augmented(plant, belief_of(plant), faults=False))
    return [V @ (s.C @ np.linalg.solve(z * np.eye(len(s.A)) - s.A + L @ s.C, B - L @ D) + D) for z in FREQUENCIES]


def solution(plant):
    s = steady(plant, augmented(plant, belief_of(plant), faults=False))
    S = s.C @ s.Y @ s.C.T + s.R
    return s, s.A @ s.Y @ s.C.T @ np.linalg.inv(S), np.linalg.inv(np.linalg.cholesky(S))


def unknown_inputs(s):
    root = np.linalg.cholesky
    n, m = len(s.A), len(s.C)
    return np.hstack([root(s.Q), np.zeros((n, m))]), np.hstack([np.zeros((m, n)), root(s.R)])


def test_disturbances_pass_with_gain_one(b747):
    s, L, V = solution(b747)
    for G in responses(b747, L, V, *unknown_inputs(s)):
        assert np.allclose(G @ G.conj().T, np.eye(len(s.C)), atol=1e-8)


def test_no_other_gain_has_a_better_ratio(b747):
    """H-/H-infinity of two faults: the optimum against gains of other weights, each with its best weight V = 1."""
    s, L, V = solution(b747)
    E = linear_model(b747).E0[:, 2:]

    def ratio(L, V):
        fault = responses(b747, L, V, E, np.zeros((len(s.C), E.shape[1])))
        disturbance = responses(b747, L, V, *unknown_inputs(s))
        return min(np.linalg.svd(G, compute_uv=False)[-1] for G in fault) / max(np.linalg.norm(G, 2) for G in disturbance)

    best, rng = ratio(L, V), np.random.default_rng(0)
    for _ in range(10):
        Q, R = (np.diag(np.diag(a) * 10.0 ** rng.uniform(-2, 2, len(a))) for a in (s.Q, s.R))
        Y = scipy.linalg.solve_discrete_are(s.A.T, s.C.T, Q, R)
        other = s.A @ Y @ s.C.T @ np.linalg.inv(s.C @ Y @ s.C.T + R)
        for weight in (np.eye(len(s.C)), V):
            assert ratio(other, weight) <= best * (1 + 1e-9)
    assert ratio(other, np.eye(len(s.C))) < 0.99 * best


def test_a_fault_moves_it_by_its_signature(b747):
    z = np.array([0.0, 0.0, 4.0, -1.0])
    u = commands(b747, 2, 30)
    filter = residual_filter(b747, belief_of(b747), (10, 40))
    zero = np.zeros((2, 4))
    *_, s = states(b747, filter, flown(b747, zero, u, theta=b747.nominal_theta + z))
    *_, healthy = states(b747, filter, flown(b747, zero, u))
    assert np.allclose(s.sums.g, s.sums.G @ z, rtol=1e-8, atol=1e-8 * np.abs(s.sums.g).max())
    assert np.abs(healthy.sums.g).max() < 1e-9 * np.abs(s.sums.g).max()


def test_steady_without_gaps_and_again_after_one(b747):
    obs = flown(b747, np.zeros((1, 4)), commands(b747, 1, 120))
    obs[:, 40:50, :4] = np.nan
    Y = [s.Y[0] for s in states(b747, residual_filter(b747, belief_of(b747), (10,)), obs)]
    assert np.allclose(Y[39], Y[10], rtol=1e-6)
    assert np.trace(Y[49]) > 1.5 * np.trace(Y[39])
    assert np.abs(Y[120] - Y[39]).max() < 2e-3 * np.abs(Y[39]).max()


def test_signatures_that_cost_too_much_are_declined():
    with pytest.raises(NotApplicableError, match="31 evaluations of the model of CMGSatellite a sample, 3100 a second"):
        make_diagnoser("optimal_residual", build("CMGSatellite"))


def test_bad_settings(b747):
    with pytest.raises(ValueError, match="paces"):
        make_diagnoser("optimal_residual", b747, paces=(0,))
