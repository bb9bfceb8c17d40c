"""The general methods beyond the Gaussian filters: two-stage, interacting models, GLR, adaptive UKF, oracle."""

import numpy as np
import pytest
from conftest import build, readings, states
from scipy.stats import multivariate_normal
from test_general_filters import belief_of, interval, model_of

from baselines.filters import glr_signatures as glr
from baselines.filters import multiple_model
from baselines.filters.adaptive_ukf import WALK, adaptive_filter, every_subset
from baselines.filters.augmented_gaussian import gaussian_filter
from baselines.filters.joint_ukf import joint_ukf
from baselines.filters.two_stage_ekf import two_stage_filter
from baselines.filters.two_stage_kf import aging
from baselines.filters.two_stage_kf import two_stage_filter as papers_two_stage
from benchmarks.consistency import measure, verdict
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.diagnosis.fitting import flights_of
from fdi_gym.engine import no_noise, simulate
from fdi_gym.estimation import mixing
from fdi_gym.estimation.linear import linear_model
from fdi_gym.estimation.signatures import linearised, secants
from fdi_gym.faults import draw

FLIGHTS = 3


@pytest.fixture
def faulty(plant):
    """A few faulty flights of validation seeds."""
    return flights_of(plant, "standard", 400_000, FLIGHTS, True)[1]


def test_two_stage_is_the_augmented_extended_filter(plant, faulty):
    """Mean and covariance of state, fault and innovation, through a fault-free and a faulty stretch and through gaps."""
    model = model_of(plant)
    first = 300 if faulty.obs.shape[1] > 500 else 0
    obs = faulty.obs[:, first : first + 150].copy()
    gone = np.random.default_rng(0).random(obs[:, :, : len(plant.outputs)].shape) < 0.2
    gone[:, 60:70] = True
    obs[:, :, : len(plant.outputs)] = np.where(gone, np.nan, obs[:, :, : len(plant.outputs)])
    *_, a = readings(plant, gaussian_filter(model, "extended"), obs)
    *_, b = readings(plant, two_stage_filter(model), obs)
    scale, rest = model.scale, model.x
    assert np.abs((a.z - b.z) / scale[model.z]).max() < 1e-6
    assert np.abs((a.x - b.x) / scale[rest]).max() < 1e-6
    for mine, theirs, s in ((a.P, b.P, scale[model.z]), (a.Px, b.Px, scale[rest]), (a.S, b.S, np.sqrt(np.diag(model.R)))):
        assert np.abs((mine - theirs) / np.outer(s, s)).max() < 1e-6
    assert np.abs(a.nu - b.nu).max() < 1e-6 * max(np.abs(a.nu).max(), 1e-9)


def test_two_stage_equals_the_papers_on_the_linear_plant(b747):
    """Same prior and random walk: the Keller-Darouach recursion of the 747 to rounding."""
    record = flights_of(b747, "standard", 400_000, FLIGHTS, True)[1]
    model = model_of(b747, x0_std=[0.1] * 4, z0_std=[1, 1, 2, 2], z_walk=[1e-3] * 4)
    model = model.replace(limit=np.full(8, np.inf))
    own = papers_two_stage(b747, aging(1e-6, "none", 0.99, 1e-4, 1.0))
    obs = record.obs[:, :400]
    for a, b in zip(readings(b747, two_stage_filter(model, first_sample=False), obs), readings(b747, own, obs), strict=True):
        for name in ("z", "P", "x"):
            assert np.abs(getattr(a, name) - getattr(b, name)).max() < 1e-9


# -- interacting models


@pytest.mark.parametrize("shared", [True, False], ids=["lines for all", "lines of each"])
def test_a_mixture_on_lines_is_that_of_its_parts(shared):
    rng = np.random.default_rng(4)
    n, L, p, f = 3, 4, 5, 2
    w, m, root = rng.dirichlet(np.ones(L), n), rng.standard_normal((n, L, f)), rng.standard_normal((n, L, f, f))
    offset, direction = rng.standard_normal((n, L, p)), rng.standard_normal((n, L, p, f))
    if shared:
        offset[:], direction[:] = offset[0], direction[0]
    lines = (offset[0], direction[0]) if shared else (offset, direction)
    mean, P = mixing.over_lines(w, *lines, m, root @ np.swapaxes(root, 2, 3))
    for i in range(n):
        at = [offset[i, j] + direction[i, j] @ m[i, j] for j in range(L)]
        first = sum(w[i, j] * at[j] for j in range(L))
        own = [direction[i, j] @ root[i, j] for j in range(L)]
        second = sum(w[i, j] * (own[j] @ own[j].T + np.outer(at[j], at[j])) for j in range(L))
        np.testing.assert_allclose(mean[i], first, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(P[i], second - np.outer(first, first), rtol=1e-10, atol=1e-12)


def test_mixing_keeps_the_mixture(plant):
    """Mean and second moment of state and disturbance, over all models, are those from before the mixing."""
    models = multiple_model.hypotheses(plant, belief_of(plant))
    record = flights_of(plant, "standard", 400_000, FLIGHTS, True)[1]
    *_, s = states(plant, multiple_model.bank(models), record.obs[:, :30])
    rng = np.random.default_rng(1)
    mu = rng.dirichlet(np.ones(s.mu.shape[1]), FLIGHTS)
    X0 = s.X + rng.standard_normal(s.X.shape) * models.model.scale
    c, w = mixing.ahead(mu, models.transition)
    X, P = mixing.mix(w, X0, s.P, models.model.z, models.m0, models.M0)
    assert np.allclose(c.sum(axis=1), 1.0)
    keep = models.model.rest

    def moments(weight, x, p):
        x, p = x[..., keep], p[..., keep, :][..., keep]
        return (weight[..., None] * x).sum(1), (weight[..., None, None] * (p + x[..., :, None] * x[..., None, :])).sum(1)

    for before, after in zip(moments(mu, X0, s.P), moments(c, X, P), strict=True):
        assert np.allclose(before, after, rtol=1e-9, atol=1e-12)
    assert np.linalg.eigvalsh(P / np.outer(models.model.scale, models.model.scale)).min() > -1e-9


def test_a_model_is_left_as_often_as_the_process_changes(plant):
    """And for each of the others alike."""
    belief = belief_of(plant)
    transition = multiple_model.hypotheses(plant, belief).transition
    assert transition.sum(axis=1) == pytest.approx(1.0)
    assert 1.0 - np.diag(transition) == pytest.approx(belief.changes)
    assert np.ptp(transition[~np.eye(len(transition), dtype=bool)]) == 0.0


def test_bank_without_changes_is_bayes_over_single_filters(b747):
    """With no exchange between the models, the probabilities are those of independent filters' likelihoods."""
    models = multiple_model.hypotheses(b747, belief_of(b747))
    labels = len(b747.labels)
    alone = models._replace(transition=np.eye(labels))
    record = flights_of(b747, "standard", 400_000, 1, True)[1]
    bank = multiple_model.bank(alone)
    even = np.full((1, labels), 1 / labels)
    *_, s = states(b747, bank, record.obs[:, :60], bank.start(1)._replace(mu=even, c=even))
    linear, (offset, direction) = linear_model(b747), models.model.lines
    filters = [(np.zeros(5), None) for _ in range(labels)]
    log = np.zeros(labels)
    for k in range(60):
        y, u, _ = b747.split(record.obs[:, k])
        for j in range(labels):
            x, P = filters[j]
            if P is None:
                x = np.concatenate([models.model.X0[:4], models.m0[j]])
                P = np.zeros((5, 5))
                P[:4, :4], P[4:, 4:] = models.model.P0[:4, :4], models.M0[j]
            else:
                E = linear.E(u)[0]
                F = np.eye(5)
                F[:4, :4], F[:4, 4] = linear.A, E @ direction[j][:, 0]
                x = F @ x + np.concatenate([linear.B @ u[0] + E @ offset[j], [0.0]])
                P = F @ P @ F.T + models.model.Q[j]
            H = np.hstack([linear.C, np.zeros((4, 1))])
            S = H @ P @ H.T + models.model.R
            log[j] += multivariate_normal.logpdf(y[0], H @ x, S)
            K = P @ H.T @ np.linalg.inv(S)
            filters[j] = (x + K @ (y[0] - H @ x), P - K @ H @ P)
    expected = np.exp(log - log.max())
    expected /= expected.sum()
    assert np.allclose(s.mu[0], np.maximum(expected, multiple_model.LEAST), rtol=1e-6, atol=1e-9)
    for j in range(labels):
        assert np.allclose(s.X[0, j], filters[j][0], rtol=1e-7, atol=1e-8)


# -- GLR


def test_signature_predicts_the_innovations_of_a_fault(b747):
    """Noise-free, from one of the tried onsets on: the innovations less the healthy ones are signature x fault."""
    spacing, onset = 20, 199  # a slot that opens at sample 200 stands for a fault over [199, 200) and later
    filter = glr.glr_filter(b747, model_of(b747), belief_of(b747).z_size, 8, spacing)
    drawn = (draw(b747.process("standard"), 2_400_000 + i) for i in range(99))
    scenario = next(s for s in drawn if s.faults and s.faults[0].kind == "LOE")
    fault = scenario.faults[0]
    scenario = scenario.replace(faults=[type(fault)(fault.mode, fault.kind, onset, fault.effects)])
    record = simulate(b747, [scenario, scenario.without_faults()], [no_noise(b747, scenario.steps)] * 2)
    *_, s = states(b747, filter, record.obs[:, : onset + 60])
    truth = record.theta[0, -1]
    slot = (onset + 60 - 1) // spacing - (onset + 1) // spacing
    moved = s.g[0] - s.g[1]
    assert np.abs(moved[slot] - s.G[0, slot] @ truth).max() < 1e-9 * np.abs(moved[slot]).max()
    assert np.abs(np.delete(moved - s.G[0] @ truth, slot, axis=0)).max(axis=1).min() > 1e-3 * np.abs(moved[slot]).max()


def test_secants_lie_on_the_side_of_the_modes():
    low, high = secants(build("CMGSatellite"), np.full(4, 0.5))
    assert np.array_equal(low, [-0.5] * 4)
    assert np.array_equal(high, [0.0] * 4)
    low, high = secants(build("MissilePitch"), np.ones(5))
    assert np.array_equal(low, [-1, -1, 0, 0, 0])
    assert np.array_equal(high, np.ones(5))


def test_linearisation_equals_the_jacobian_where_the_model_is_linear_in_the_fault(b747):
    model, obs = model_of(b747), np.zeros((2, 6))
    X = np.random.default_rng(3).standard_normal((2, 4))
    obs[:, 4:] = [[1.0, -2.0], [0.5, 0.3]]
    at = interval(b747, obs, obs, 5)

    def f(points):
        return model.f(points, at)

    found = linearised(model, f, X, *secants(b747, belief_of(b747).z_size), model.rest)
    _, F = model.jacobian_f(np.concatenate([X, np.zeros((2, 4))], axis=1), at)
    assert np.allclose(found.A, F[:, :4, :4], atol=1e-9)
    assert np.allclose(found.E, F[:, :4, 4:], atol=1e-9)


# -- adaptive UKF


def test_subsets():
    assert np.array_equal(every_subset(2), [[False, False], [True, False], [False, True], [True, True]])
    assert len(np.unique(every_subset(5), axis=0)) == 32


@pytest.mark.parametrize("grid", ["full", "simplified", "elements"])
def test_without_a_flag_it_is_the_augmented_ukf(plant, grid):
    model = model_of(plant, walk=WALK)
    obs = flights_of(plant, "standard", 400_000, FLIGHTS, False)[1].obs[:, :60]
    *_, s = states(plant, adaptive_filter(model, belief_of(plant).z_size, grid), obs)
    *_, plain = states(plant, gaussian_filter(model, "unscented"), obs)
    assert not s.adapted.any()
    assert np.array_equal(s.filter.X, plain.X)
    assert np.array_equal(s.filter.P, plain.P)


def test_a_raised_variance_follows_a_jump_faster(b747):
    """After a fault the adaptive filter has adapted, and its error is smaller than that of the same filter without."""
    model = model_of(b747, walk=0.01)
    scenarios, record = flights_of(b747, "standard", 400_000, 12, True)
    adaptive = states(b747, adaptive_filter(model, belief_of(b747).z_size, "full"), record.obs)
    plain, errors, s = readings(b747, gaussian_filter(model, "unscented"), record.obs), [], None
    for k, (s, r) in enumerate(zip(adaptive, plain, strict=True)):
        truth = record.theta[:, k]
        errors.append([np.abs(z - truth).mean(axis=1) for z in (s.filter.X[:, model.z], r.z)])
    mean = np.array(errors).mean(axis=0)
    changed = np.array([bool(scenario.faults) for scenario in scenarios]) & (s.adapted > 0)
    assert changed.sum() >= 3
    assert mean[0, changed].mean() < 0.8 * mean[1, changed].mean()


def test_general_forms_agree_with_the_satellites_own():
    """Another state (q4 is one) and another residual: the same estimate within a few percent, adapted or not."""
    plant = build("CMGSatellite")
    scenarios = [s.replace(steps=3000) for s in flights_of(plant, "standard", 400_000, 2, False)[0]]
    from fdi_gym.plants.cmg_satellite import loss

    scenarios = [s.replace(faults=[loss(1, 0.5, 1000, 3000)]) for s in scenarios]
    record = simulate(plant, scenarios)
    model = model_of(plant, z0_std=[1e-2] * 4, z_walk=[1e-5] * 4)
    own = run(joint_ukf(plant), record.obs[:, :2000]).estimate
    *_, s = states(plant, gaussian_filter(model, "unscented"), record.obs[:, :2000])
    jump = np.abs(own[:, -1] - 1.0).max()
    assert np.abs(1.0 + s.X[:, model.z] - own[:, -1]).max() < 0.05 * jump
    model = model_of(plant, walk=WALK)
    *_, a = states(plant, adaptive_filter(model, belief_of(plant).z_size, "simplified"), record.obs)
    theirs = run(make_diagnoser("sgaukf", plant), record.obs).estimate[:, -1]
    assert np.abs(1.0 + a.filter.X[:, model.z] - record.theta[:, -1]).max() < 0.05
    assert np.abs(1.0 + a.filter.X[:, model.z] - theirs).max() < 0.06


# -- oracle and consistency


def test_oracle_is_told_when_and_not_what(plant):
    """Other faults at the same times, told of in place of the true ones, change nothing in what it says."""
    scenarios, record = flights_of(plant, "standard", 400_000, 4, True)
    told = make_diagnoser("told_onset_ekf", plant, scenarios=scenarios)
    said = run(told, record.obs[:, :400])
    acting = np.stack([plant.label_rows(s)[:400] > 0 for s in scenarios])
    assert np.array_equal(said.alarm, acting)
    single = [i for i, s in enumerate(scenarios) if len(s.faults) == 1]
    if single:
        other = next(mode.name for mode in plant.modes if mode.name != scenarios[single[0]].faults[0].mode)
        lie = [
            s
            if i != single[0]
            else s.replace(faults=[type(s.faults[0])(other, "", s.faults[0].onset, s.faults[0].effects, s.faults[0].end)])
            for i, s in enumerate(scenarios)
        ]
        again = run(make_diagnoser("told_onset_ekf", plant, scenarios=lie), record.obs[:, :400])
        assert np.array_equal(again.label, said.label)


def test_consistency_of_the_kalman_filter(b747):
    """Without a walk and without mismatch the augmented filter is the Kalman filter: NIS and NEES within their bounds."""
    found = measure(b747, "standard", "augmented_ekf")
    assert abs(found["NIS"]["mean"] - 1) < 0.05
    assert found["NEES"]["mean"] < 1.05  # conservative: it allows for faults that never come
    residual = measure(b747, "standard", "ascdkf")  # from residuals after the update, not from innovations
    same = measure(b747, "standard", "augmented_cdkf")
    assert residual["NIS"]["mean"] == pytest.approx(same["NIS"]["mean"], abs=5e-3)
    assert residual["NEES"]["mean"] == pytest.approx(same["NEES"]["mean"], abs=5e-3)
    assert verdict(1.0, 0.95) == "consistent"
    assert verdict(1.2, 0.5) == "optimistic"
    assert verdict(0.8, 0.5) == "conservative"
