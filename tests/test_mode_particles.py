"""Rao-Blackwellised particles: the resampling keeps what it must, and with all histories kept it is Bayes' rule."""

import itertools

import numpy as np
import pytest
from scipy.special import logsumexp

from baselines.filters.mode_particles import CHANCE, MOST, mode_particles, particle_filter, survivors
from baselines.filters.multiple_model import hypotheses
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.diagnosis.fitting import fit_belief
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.interval import Interval
from fdi_gym.faults import draw
from fdi_gym.plant import NotApplicableError


@pytest.mark.parametrize("spread", [0.1, 3.0, 30.0])
@pytest.mark.parametrize("count", [1, 2, 7, 20])
def test_survivors_are_different_so_many_and_weigh_on_average_what_they_did(spread, count):
    log = spread * np.random.default_rng(0).standard_normal(40)
    w, many = np.exp(log - logsumexp(log)), 4000
    order, found = survivors(np.tile(log, (many, 1)), count, (np.arange(many) + 0.5) / many)
    assert order.shape == (many, count)
    assert (np.diff(order, axis=1) > 0).all()
    np.testing.assert_allclose(np.exp(found).sum(axis=1), 1.0)
    mean = np.zeros(40)
    np.add.at(mean, order, np.exp(found) / many)
    np.testing.assert_allclose(mean, w, atol=2.0 / many)


def test_few_survive_whole_and_what_is_certain_stays_certain():
    log = np.array([[0.0, -np.inf, -1.0, -np.inf, -2.0]])
    order, found = survivors(log, 4, np.array([0.3]))
    assert {*order[0][np.isfinite(found[0])]} == {0, 2, 4}
    np.testing.assert_allclose(found[0][np.isfinite(found[0])], log[0, [0, 2, 4]] - logsumexp(log))
    heavy = np.log(np.array([[0.9, *[0.01] * 10]]))
    order, found = survivors(heavy, 5, np.array([0.9]))
    assert order[0, 0] == 0
    np.testing.assert_allclose(np.exp(found[0]), [0.9, *[0.025] * 4])


@pytest.fixture(scope="module")
def belief():
    return fit_belief(load_plant("B747Lateral"), "standard")


@pytest.fixture(scope="module")
def bank(belief):
    plant = load_plant("B747Lateral")
    return plant, hypotheses(plant, belief)


def interval(plant, k, u):
    return Interval(np.array([k]), u, None, np.zeros((1, len(plant.known))))


def test_with_all_histories_it_is_bayes_rule(bank):
    """Every second sample may change the label: after two turns there are labels^2 histories, each a filter of its own."""
    plant, b = bank
    labels, every, last = len(plant.labels), 2, 5
    f = particle_filter(b, labels**2, every)
    rng = np.random.default_rng(3)
    y, u = 0.3 * rng.standard_normal((last + 1, 1, 4)), 0.1 * rng.standard_normal((last + 1, 1, 2))
    seen, s = np.ones((1, 4), bool), f.start(1)
    s = f.update(s, interval(plant, 0, u[0]), y[0], seen)
    for k in range(1, last + 1):
        at = interval(plant, k, u[k])
        s = f.update(f.predict(s, at), at, y[k], seen)
    read = f.read(s)
    assert read.probs is not None
    assert read.x is not None

    model, z = b.model, b.model.z
    Pi = every * b.transition
    np.fill_diagonal(Pi, 1 - every * (1 - np.diag(b.transition)))
    weights, labelled, states = [], [], []
    for history in itertools.product(range(labels), repeat=2):
        X, P, log, now = model.X0[None].copy(), model.P0[None].copy(), 0.0, 0
        X[:, z], P[:, z, z] = b.m0[0], b.M0[0]
        for k in range(last + 1):
            at = interval(plant, k, u[k])
            if k and k % every == 0:
                new = history[k // every - 1]
                log += np.log(Pi[now, new])
                if new != now:
                    X[:, z], P[:, z, :], P[:, :, z] = b.m0[new], 0.0, 0.0
                    P[:, z, z] = b.M0[new]
                now = new
            mine = model.replace(lines=tuple(a[[now]] for a in model.lines), Q=model.Q[[now]])
            if k:
                X, P = mine.predict("extended", X, P, at)
            done = mine.update("extended", X, P, at, y[k], seen)
            X, P, log = done.X, done.P, log + done.log_likelihood[0]
        weights.append(log)
        labelled.append(now)
        states.append(X[0, model.x])
    w = np.exp(np.array(weights) - logsumexp(weights))
    np.testing.assert_allclose(read.probs[0], np.bincount(labelled, w, labels), rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(read.x[0], w @ np.array(states), rtol=1e-8, atol=1e-11)


def test_one_particle_of_a_plant_that_does_not_change_is_the_healthy_filter(bank):
    plant, b = bank
    f, model = particle_filter(b, 1, 10**6), b.model
    mine = model.replace(lines=tuple(a[:1] for a in model.lines), Q=model.Q[:1])
    rng, s, seen = np.random.default_rng(4), f.start(1), np.ones((1, 4), bool)
    X, P = model.X0[None].copy(), model.P0[None].copy()
    X[:, model.z], P[:, model.z, model.z] = b.m0[0], b.M0[0]
    for k in range(1, 30):
        at, y = interval(plant, k, np.zeros((1, 2))), rng.standard_normal((1, 4))
        s = f.update(f.predict(s, at), at, y, seen)
        X, P = mine.predict("extended", X, P, at)
        done = mine.update("extended", X, P, at, y, seen)
        X, P = done.X, done.P
        np.testing.assert_array_equal(s.X[0], X)
        np.testing.assert_array_equal(s.nu, done.nu)


def test_more_particles_are_no_worse_and_a_fault_is_named():
    plant = load_plant("B747Lateral")
    scenarios = [draw(plant.process("standard"), 4_100_000 + i) for i in range(40)]
    record, right = simulate(plant, scenarios), {}
    for count in (4, 64):
        said = run(make_diagnoser("mode_particles", plant, particles=count), record.obs)
        right[count] = (said.label[:, -1] == record.label[:, -1]).mean()
        assert said.label_probs is not None
        np.testing.assert_allclose(said.label_probs.sum(axis=-1), 1.0)
    assert right[64] >= max(right[4], 0.85)


def test_what_it_refuses(belief):
    plant = load_plant("B747Lateral")
    with pytest.raises(ValueError, match=f"at least 1, not 0 and {round(CHANCE / belief.changes)}$"):
        mode_particles(plant, belief, Calibration(), particles=0)
    with pytest.raises(ValueError, match="at least 1, not 8 and 0"):
        mode_particles(plant, belief, Calibration(), particles=8, every=0)
    with pytest.raises(NotApplicableError, match=f"{MOST:.0f} are allowed"):
        mode_particles(plant, belief, Calibration(), particles=10**6)
