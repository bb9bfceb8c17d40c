"""What the shells share, compiled, against the same in NumPy: samples taken apart, decisions, held commands."""

import numpy as np
import pytest
from conftest import PLANTS, build

from fdi_gym.diagnosis import compiled
from fdi_gym.estimation.automaton import first, step
from fdi_gym.estimation.calibration import Calibration, Persistence, gain
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import HELD, Interval, held_command_covariance
from fdi_gym.estimation.labels import distances, manifolds
from fdi_gym.estimation.linear import linear_model


@pytest.mark.parametrize("plant_id", PLANTS)
def test_a_sample_is_taken_apart(plant_id):
    """What did not report is 0 and not seen, or held; the flags say whether anything is."""
    plant, rng, n = build(plant_id), np.random.default_rng(0), 6
    n_y, n_u = len(plant.outputs), len(plant.commands)
    for missing, k0 in ((0.0, 1), (0.0, 0), (0.3, 1)):
        obs = rng.standard_normal((n, len(plant.observed)))
        obs[rng.random(obs.shape) < missing] = np.nan
        last_u, last_stale = rng.standard_normal((n, n_u)), rng.integers(0, 3, (n, n_u)).astype(float)
        last_known = rng.standard_normal((n, len(plant.known)))
        y, u, known = plant.split(obs)
        seen, heard, held = np.empty(y.shape, bool), np.empty(n, bool), np.empty(n, bool)
        following = np.empty(n, np.int64)
        out = [np.empty(a.shape) for a in (y, u, known, u)]
        flags = compiled.receive(
            obs, np.full(n, k0), np.ones(n, bool), last_u, last_known, last_stale, following, out[0], seen, *out[1:],
            heard, held,
        )  # fmt: skip
        for found, expected in zip((*out, seen, heard, held, following), (
            np.nan_to_num(y), np.where(np.isnan(u), last_u, u), np.where(np.isnan(known), last_known, known),
            np.where(np.isnan(u), last_stale + 1, 0.0), np.isfinite(y), np.isfinite(y).any(axis=1),
            np.isnan(obs[:, n_y:]).any(axis=1), np.full(n, k0 + 1),
        ), strict=True):  # fmt: skip
            assert np.array_equal(found, expected)
        assert bool(flags & compiled.RUNNING) == (k0 > 0)
        assert bool(flags & compiled.STALE) == bool(np.isnan(u).any())
        assert bool(flags & compiled.HELD) == bool(np.isnan(obs[:, n_y:]).any())


@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("plant_id", PLANTS)
def test_labels_are_declared_as_their_costs_say(plant_id, same):
    """The automaton on argmin and share of the costs, whatever numbers they are; without evidence nothing changes."""
    plant, rng, n = build(plant_id), np.random.default_rng(1), 40
    labels, after = len(plant.labels), Persistence(2, 3, 2, 4, same)
    calibration = Calibration(thresholds={m.name: 3.0 + i for i, m in enumerate(plant.modes)}, persistence=after)
    rule, penalty = by_labels(plant, calibration), calibration.penalties(plant)
    state, expected, declared = rule.start(n), first(n), set()
    base = rng.uniform(0, 30, (n, labels))
    for k in range(60):
        cost = base + rng.standard_normal((n, labels))
        cost[rng.random((n, labels)) < 0.02] = np.inf
        cost[rng.random(n) < 0.02, 1] = np.nan
        if k % 15 == 0:
            base = rng.uniform(0, 30, (n, labels))
        informed = rng.random(n) < 0.9
        state, said = rule.step(state, np.full(n, k), Reading(cost=cost), informed)
        share = gain(cost, penalty)
        best, over, under = 1 + np.argmin((cost + penalty)[:, 1:], axis=1), share > 1, share < 0.5
        if same:
            best = np.argmin(cost + penalty, axis=1)
            over, under = best > 0, np.zeros(n, bool)
        expected = step(
            expected, best, over, under, rise=2, switch=3, release=2, same=same, informed=informed & (k > after.warmup)
        )
        assert np.array_equal(said.label, expected.label)
        assert np.array_equal(said.alarm, expected.label > 0)
        declared |= set(said.label.tolist())
    assert len(declared) > 2


@pytest.mark.parametrize("plant_id", PLANTS)
def test_distances_are_those_of_the_closest_points(plant_id):
    plant, rng, n = build(plant_id), np.random.default_rng(2), 10
    sets, p = manifolds(plant), len(plant.estimated)
    root = rng.standard_normal((n, p, p)) + 2 * np.eye(p)
    P, z, excess = root @ np.swapaxes(root, 1, 2), rng.standard_normal((n, p)), np.diag(rng.uniform(0, 1, p))
    found, I = distances(z, P, sets, excess), np.linalg.inv(P + excess)  # noqa: E741
    assert found.J[:, 0] == pytest.approx(np.einsum("ni,nij,nj->n", z, I, z))
    gap = z[:, None] - sets.points(found.m)
    assert found.J[:, 1:] == pytest.approx(np.einsum("nhi,nij,nhj->nh", gap, I, gap))
    assert (found.m >= sets.low - 1e-9).all()
    assert (found.m <= sets.high + 1e-9).all()
    for _ in range(200):  # no other point of a set is closer
        m = np.clip(found.m + 0.05 * rng.standard_normal(found.m.shape), sets.low, sets.high)
        other = z[:, None] - sets.points(m)
        assert (np.einsum("nhi,nij,nhj->nh", other, I, other) >= found.J[:, 1:] - 1e-9).all()


def test_held_commands_are_process_noise(b747):
    """The j-th sample in a row adds (2 j - 1) min(j / HELD, 1)^2 times what a command's typical size moves, squared."""
    B, n_x = linear_model(b747).B * [s.scale for s in b747.commands], len(b747.states)
    stale = np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 20.0]])
    k, u = np.full(3, 50), np.tile(b747.trim_command, (3, 1))
    Q_held = held_command_covariance(b747, b747.trim_state, k, u, None, stale)
    weight = np.maximum(2 * stale - 1, 0) * np.minimum(stale / HELD, 1) ** 2
    assert Q_held == pytest.approx(np.einsum("xu,nu,yu->nxy", B, weight, B), rel=1e-6, abs=1e-12)
    assert not Q_held[0].any()
    N, lines = n_x + 2, 4
    Q = np.random.default_rng(0).standard_normal((lines, N, N))
    at = Interval(k, u, None, np.zeros((3, 0)), stale=stale, Q_held=Q_held)
    noise = at.noise(Q, 3 * lines)
    for row in range(3 * lines):
        expected = Q[row % lines].copy()
        expected[:n_x, :n_x] += Q_held[row // lines]
        assert np.array_equal(noise[row], expected)
    assert np.array_equal(at.of(np.array([2, 0])).noise(Q[0]), noise[[2 * lines, 0]])
    assert Interval(k, u, None, np.zeros((3, 0))).noise(Q) is Q
