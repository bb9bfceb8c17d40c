"""Rao-Blackwellised particles: optimal resampling, exact Bayes with all histories, and towards it with more particles."""

import itertools

import numpy as np
import pytest
from conftest import build, states
from test_general_filters import belief_of

from baselines.filters import multiple_model
from baselines.filters.mode_switching_particles import (
    mode_switching_particles,
    particle_filter,
    thinned,
    threshold,
    uniform,
)
from fdi_gym.diagnosis import NotApplicableError, find_diagnoser, make_diagnoser, run
from fdi_gym.diagnosis.fitting import flights_of
from fdi_gym.diagnosis.knowledge import knowledge_of
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.linear import linear_model

BRANCH, STEPS = 10, 31  # branches at samples 1, 11, 21: 125 histories of 5 labels


def restless(plant):
    """The models of the labels, with changes that are frequent enough to matter within a few branches."""
    b = multiple_model.hypotheses(plant, belief_of(plant))
    labels = len(b.m0)
    change = 0.01
    return b._replace(transition=np.full((labels, labels), change) + (1 - change * labels) * np.eye(labels))


def flight(plant):
    """A stretch around an onset."""
    scenarios, record = flights_of(plant, "standard", 400_000, 30, True)
    i = next(i for i, s in enumerate(scenarios) if s.faults and s.faults[0].mode == "rudder stuck")
    onset = scenarios[i].faults[0].onset
    return record.obs[i : i + 1, onset - 12 : onset - 12 + STEPS]


def probabilities(b, obs, particles, seed=0):
    *_, s = states(b.model.plant, particle_filter(b, particles, BRANCH, seed), obs)
    found = np.zeros((len(obs), len(b.m0)))
    np.add.at(found, (np.arange(len(obs))[:, None], s.label), s.w)
    return found[0]


def exact(b, obs):
    """Every history of labels, each with its own Kalman filter, from the textbook."""
    plant = b.model.plant
    linear, (offset, direction) = linear_model(plant), b.model.lines
    labels, segments = len(b.m0), len(range(1, STEPS, BRANCH))
    T = np.linalg.matrix_power(b.transition, BRANCH)
    weight, last = [], []
    H, R = np.hstack([linear.C, np.zeros((4, 1))]), b.model.R
    for history in itertools.product(range(labels), repeat=segments):
        log, before = 0.0, 0
        x = np.concatenate([b.model.X0[:4], b.m0[0]])
        P = np.zeros((5, 5))
        P[:4, :4], P[4:, 4:] = b.model.P0[:4, :4], b.M0[0]
        for k in range(STEPS):
            y, u = obs[0, k, :4], obs[0, k, 4:]
            j = history[max(k - 1, 0) // BRANCH] if k else 0
            if k and (k - 1) % BRANCH == 0:
                log += np.log(T[before, j])
                if j != before:
                    x[4], P[4], P[:, 4] = b.m0[j, 0], 0.0, 0.0
                    P[4, 4] = b.M0[j, 0, 0]
                before = j
            if k:
                E, F = linear.E(u[None])[0], np.eye(5)
                F[:4, :4], F[:4, 4] = linear.A, E @ direction[j][:, 0]
                x = F @ x + np.concatenate([linear.B @ u + E @ offset[j], [0.0]])
                P = F @ P @ F.T + b.model.Q[j]
            S, nu = H @ P @ H.T + R, y - H @ x
            K = P @ H.T @ np.linalg.inv(S)
            log -= 0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(S)[1])
            x, P = x + K @ nu, P - K @ H @ P
        weight.append(log)
        last.append(before)
    w = np.exp(np.array(weight) - max(weight))
    return np.bincount(last, w / w.sum(), labels)


def test_with_all_histories_it_is_exact_bayes_and_with_more_particles_nearer(b747):
    b, obs = restless(b747), flight(b747)
    truth = exact(b, obs)
    assert np.abs(probabilities(b, obs, 125) - truth).max() < 1e-9
    assert 1e-3 < truth.max() < 1.0
    errors = [np.mean([np.abs(probabilities(b, obs, M, seed) - truth).sum() for seed in range(6)]) for M in (2, 10, 40)]
    assert errors[2] < 0.1 * max(errors[0], 1e-6) or errors[2] < 1e-3
    assert errors[2] <= errors[1] <= errors[0] + 1e-9


def test_threshold_solves_its_equation():
    rng = np.random.default_rng(0)
    q = rng.dirichlet(np.full(50, 0.1), 200)
    for most in (1, 3, 10):
        enough = (q > 1e-15).sum(axis=1) > most
        c = threshold(q[enough], most)
        assert np.allclose(np.minimum(q[enough] / c[:, None], 1.0).sum(axis=1), most)


def test_thinning_keeps_the_heavy_and_is_unbiased():
    rng = np.random.default_rng(1)
    q = rng.dirichlet(np.full(12, 0.5))
    many = 20_000
    u = (np.arange(many) + 0.5) / many
    stay, w = thinned(np.tile(q, (many, 1)), 5, u)
    mean = np.zeros(12)
    np.add.at(mean, stay, w)
    assert np.allclose(mean / many, q, atol=2e-3)
    c = threshold(q[None], 5)[0]
    for i in np.flatnonzero(q > 1.001 * c):
        assert (stay == i).any(axis=1).all()
    assert (np.sort(stay, axis=1)[:, 1:] != np.sort(stay, axis=1)[:, :-1]).all()
    few, weight = thinned(np.array([[0.0, 0.7, 0.0, 0.3, 0.0, 0.0]]), 4, np.array([0.5]))
    assert set(few[0, :2]) == {1, 3}
    assert weight[0].tolist() == [0.7, 0.3, 0.0, 0.0]


def particles_of(plant, **settings):
    """With the shipped belief, never alarming."""
    belief = knowledge_of(find_diagnoser("multiple_model_ekf"), plant, "standard", {})["belief"]
    return mode_switching_particles(plant, belief, Calibration(), **settings)


def test_random_numbers_are_functions_of_seed_and_sample():
    a = uniform(0, np.array([3, 7, 3]))
    assert a[0] == a[2] == uniform(0, np.array([3]))[0] != a[1]
    assert uniform(1, np.array([3]))[0] != a[0]
    assert (a > 0).all()


def test_the_same_bytes_alone_and_in_company_and_another_seed_differs(b747):
    obs = flights_of(b747, "standard", 400_000, 3, True)[1].obs[:, :150]

    def probs(seed, obs):
        return run(particles_of(b747, particles=3, seed=seed), obs).label_probs

    said = probs(0, obs)
    assert np.array_equal(said[1], probs(0, obs[1:2])[0])
    assert not np.array_equal(said, probs(1, obs))


def test_too_much_work_is_declined_and_less_is_not():
    satellite = build("CMGSatellite")
    with pytest.raises(NotApplicableError, match=r"cost too much.*fewer particles run"):
        particles_of(satellite)
    particles_of(satellite, particles=8)


@pytest.mark.parametrize("settings", [{"particles": 0}, {"branch_s": 0}, {"branch_s": float("nan")}, {"seed": -1}])
def test_bad_settings(b747, settings):
    with pytest.raises(ValueError, match="1 or more"):
        make_diagnoser("mode_switching_particles", b747, **settings)
