"""Filters of the CMG satellite: check values of the data sheet, identities, gaps, batches, and what the methods can do."""

import numpy as np
import pytest

from baselines.filters.attitude import rotated
from baselines.filters.covariance_adaptation import Trial, binary_grid, element_grid, repeated
from baselines.filters.covariance_adaptive_ukf import EVEN, ODD, all_subsets, alternating
from baselines.filters.joint_ukf import Attitude, corrected, predicted, statistic
from baselines.filters.mekf import observation, transition
from baselines.oracles.cramer_rao_oracle import cramer_rao_oracle, log_evidence
from baselines.oracles.mekf_clairvoyant import changes
from fdi_gym.diagnosis import NotApplicableError, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.estimation.sigma_points import cholesky, covariance, mean_and_deviations, unscented_points, weights
from fdi_gym.faults import FaultScenario
from fdi_gym.plants import cmg_satellite as cmg

Q_V, W, DELTA = [0.1, -0.2, 0.3], [0.05, -0.02, 0.03], [0.3, -0.2, 0.5, 0.1]
R_K = np.array([[0.2, -0.1, 0.15, 0.05]])
METHODS = ("joint_ukf", "gaukf", "sgaukf", "caukf", "dual_ukf", "dual_gaukf", "dual_sgaukf", "mekf")


@pytest.fixture(scope="module")
def plant():
    return load_plant("CMGSatellite")


# -- one joint step


@pytest.fixture(scope="module")
def one_step(plant):
    """The data sheet's step: (run from a covariance) -> what is predicted, what is corrected, b and the residual v."""
    x = np.array([[*Q_V, *W, *DELTA, 1.0, 0.9, 0.8, 1.0]])
    truth = plant.propagate(0.0, np.array([*Q_V, np.sqrt(0.86), *W, *DELTA]), R_K, np.array([[0.5, 1.0, 0.9, 0.7]]))
    y = np.delete(truth, 3)[None] + 1e-4 * np.array([1, -1, 1, 2, -2, 1, 0.5, -0.5, 1, -1])
    Q, R, seen = 1e-10 * np.eye(14), 1e-8 * np.eye(10), np.ones((1, 10), bool)

    def from_covariance(P):
        ahead = predicted(plant, Q, Attitude(x, P[None], np.ones(1)), R_K)
        found = corrected(R, ahead, y, seen)
        return ahead, found, statistic(found.nu, found.S, seen), ((y - found.x[:, :10])[:, :6] ** 2).sum() / 1e-8

    return from_covariance


P_START = np.diag([1e-8] * 10 + [1e-2] * 4)


def close(value, expected, rtol=1e-9):
    np.testing.assert_allclose(value, expected, rtol=rtol)


def test_joint_step(one_step):
    ahead, s, b, v = one_step(P_START)
    close(ahead.x[0, :6], [1.0023514331e-01, -2.0003306695e-01, 3.0017406752e-01,
                               5.0735890220e-02, -2.0626679277e-02, 2.7742322260e-02])  # fmt: skip
    close(s.x[0, :10], [1.0028348512e-01, -2.0008528925e-01, 3.0022593863e-01, 5.0105300672e-02, -2.1117573131e-02,
                        2.8587892247e-02, 3.0202502116e-01, -2.0102514662e-01, 5.0155029098e-01,
                        1.0044967794e-01])  # fmt: skip
    close(s.x[0, 10:], [6.4337546745e-01, 1.0925032912e00, 8.0539978270e-01, 9.8117855381e-01])
    P = np.diag(s.P[0])
    close(P[:6], [5.0247718146e-09, 5.0247970321e-09, 5.0246726375e-09, 7.4710045622e-09, 6.6594902646e-09,
                  8.3388948536e-09])  # fmt: skip
    close(P[10:], [3.6148252478e-03, 7.9284229354e-03, 4.3013698774e-03, 9.2947347159e-03])
    close(b, [2.4396910357e01])
    close(v, 3.9431104181e00)


@pytest.mark.parametrize(("units", "v", "theta"), [
    ((0,), 2.5716520976e00, [5.6469853145e-01, 1.0406897851e00, 7.9637331840e-01, 9.9813929098e-01]),
    ((0, 2), 2.5699412801e00, [5.6458150789e-01, 1.0406148441e00, 7.9537652859e-01, 9.9844604428e-01]),
    ((0, 1, 2, 3), 2.0145910333e00, [6.0012647568e-01, 1.1402615988e00, 8.0121280050e-01, 9.8969784885e-01]),
])  # fmt: skip
def test_candidates(one_step, units, v, theta):
    P = P_START.copy()
    P[[10 + i for i in units], [10 + i for i in units]] += 1e-2
    _, found, _, residual = one_step(P)
    close(residual, v)
    close(found.x[0, 10:], theta)


# -- the sequence check: all filters on one flight with an integer generator's noise


def integer_noise(samples):
    z, n = 1, np.empty(samples)
    for i in range(samples):
        z = (1103515245 * z + 12345) % 2**31
        n[i] = np.sqrt(12.0) * (z / 2**31 - 0.5)
    return n


@pytest.fixture(scope="module")
def sequence(plant):
    n = integer_noise(4510).reshape(451, 10)
    np.testing.assert_allclose(n[0, :7], [4.8047360083e-02, -1.1232650751e00, -6.6285059174e-01, 1.1962889271e-01,
                                          1.5506286191e00, -1.1371388086e00, 7.0054931829e-01], rtol=1e-9)  # fmt: skip
    v = np.zeros((451, 11))
    v[:, :10] = n * [s.sigma for s in plant.outputs[:10]]
    faults = [cmg.loss(1, 0.6, 300, 451), cmg.loss(3, 0.3, 300, 451)]
    return simulate(plant, [FaultScenario(plant=cmg.ID, steps=450, faults=faults)], noise=[(np.zeros((450, 11)), v)])


def test_sequence_flight(sequence):
    close(sequence.state[0, 450], [
        3.7393880551e-02, -2.7048111580e-02, -3.3903529068e-02, 9.9835897756e-01, -2.2827579173e-02, -2.8258195619e-02,
        2.0210828909e-02, -5.3503746679e-02, -2.0957308465e-02, 2.7789989853e-02, -5.7910789873e-03,
    ], rtol=1e-8)  # fmt: skip
    close(sequence.obs[0, 450, :10], [
        3.7171427387e-02, -2.7008629063e-02, -3.4099633489e-02, -2.2634048280e-02, -2.8398267876e-02, 2.0313022961e-02,
        -5.3251046902e-02, -2.0788435791e-02, 2.7776166137e-02, -6.0341579667e-03,
    ], rtol=1e-8)  # fmt: skip
    close(sequence.obs[0, 450, 11:15], [-1.2791427454e-02, 6.4104329035e-03, 7.3960649493e-03, -1.0834219437e-02], 1e-8)


def told(name, plant, obs, **tuning):
    """What a method says, and its signals."""
    return run(make_diagnoser(name, plant, **tuning), obs, signals=True)


@pytest.mark.parametrize(("name", "expected", "beta", "adapted", "first"), [
    ("joint_ukf", [0.98716514594, 0.98336014591, 1.0168694371, 0.90935895011], 14.020626480, 0, 412),
    ("gaukf", [1.1673717442, 0.66912468917, 0.74898035324, 0.44576151026], 7.8583863472, 14, 412),
    ("sgaukf", [1.1540137923, 0.62728499473, 0.77910903636, 0.45392201417], 8.0042706803, 17, 412),
    ("caukf", [1.1477202519, 0.61744759321, 0.78459484877, 0.48221849296], 7.8397198428, 13, 412),
    ("dual_ukf", [0.98733454507, 0.99492195449, 1.0079378763, 0.98539269418], 15.828245093, 0, None),
    ("dual_gaukf", [0.98824073233, 0.97829964876, 1.0080408156, 0.96193770882], 15.599598077, 56, 382),
    ("dual_sgaukf", [0.98761064500, 0.98671309791, 1.0081376783, 0.97366615905], 15.715958367, 56, 382),
])  # fmt: skip
def test_sequence_of_unscented_filters(plant, sequence, name, expected, beta, adapted, first):
    found = told(name, plant, sequence.obs)
    close(found.estimate[0, 450], expected, 1e-8)
    close(found.signals["statistic"][0, 450], beta, 1e-8)
    assert found.signals["adapted"][0, 450] == adapted
    up = np.flatnonzero(found.signals["flag"][0])
    if first is not None:
        assert up[0] == first
    if name == "joint_ukf":
        assert len(up) == 39
    dual = name.startswith("dual")
    close(found.signals["statistic"][0, 300], 5.3630330521 if dual else 5.3629343137, 1e-8)
    close(found.estimate[0, 300], [1.0002270876, 0.99991369366, 0.99982981812, 1.0003164528] if dual
          else [1.0009143339, 0.99850089273, 0.99895047955, 1.0013206112], 1e-8)  # fmt: skip


def test_sequence_of_mekf(plant, sequence):
    found = told("mekf", plant, sequence.obs)
    close(found.estimate[0, 450], [1.1231160411, 0.62633430046, 0.82328160960, 0.53756170088], 1e-8)
    close(found.signals["statistic"][0, 450], 6.1078305276, 1e-8)
    assert np.flatnonzero(np.diff(found.signals["resets"][0], prepend=0)).tolist() == [422]
    assert np.flatnonzero(found.signals["flag"][0]).tolist() == [422]
    close(found.estimate[0, 300], [1.0008497852, 0.99844368573, 0.99893276833, 1.0009396505], 1e-8)
    close(found.signals["statistic"][0, 300], 5.5623058820, 1e-8)


# -- identities


def test_unscented_transform_is_exact_for_linear_maps():
    rng = np.random.default_rng(0)
    x, B = rng.standard_normal((3, 5)), rng.standard_normal((3, 5, 5))
    P, A = B @ np.swapaxes(B, 1, 2), rng.standard_normal((4, 5))
    points = unscented_points(x, P)
    mean, dev = mean_and_deviations(points @ A.T, weights(5))
    np.testing.assert_allclose(mean, x @ A.T, atol=1e-13)
    np.testing.assert_allclose(covariance(dev, dev, weights(5)), A @ P @ A.T, atol=1e-12)


def test_cholesky_jitter_is_only_for_the_matrix_that_needs_it():
    good, flat = np.diag([2.0, 3.0]), np.array([[1.0, 1.0], [1.0, 1.0 - 1e-13]])
    L = cholesky(np.stack([good, flat, -np.eye(2)]))
    np.testing.assert_array_equal(L[0], np.linalg.cholesky(good))
    np.testing.assert_allclose(L[1] @ L[1].T, flat, atol=1e-9)
    assert np.isnan(L[2]).all()


def scripted(scores):
    """A run whose residual is that of a script, by which elements the candidate raised; and what was asked."""
    asked = []

    def go(rows, P):
        asked.append((rows.copy(), P.copy()))
        v = np.array([scores(r, p) for r, p in zip(rows, P, strict=True)])
        return Trial(np.zeros((len(rows), 1)), P, v, P)

    return go, asked


def test_binary_grid_takes_the_first_best_candidate_and_caps():
    search = binary_grid(np.arange(4), 0.1, all_subsets)
    P = np.tile(np.diag([0.2, 0.01, 0.01, 0.01]), (2, 1, 1))
    go, asked = scripted(lambda r, p: 0.0 if p[1, 1] > 0.05 or r == 1 else 1.0)
    kept = search(P, np.zeros(2, int), go)
    assert len(asked) == 1
    assert len(asked[0][0]) == 32
    np.testing.assert_allclose(np.diag(kept.base[0]), [0.2, 0.11, 0.01, 0.01])  # candidate 2, before 3, 6, 7, ...
    np.testing.assert_array_equal(kept.base[1], P[1])  # all the same: number 0, nothing raised
    assert asked[0][1][:, 0, 0].max() == 0.25


def test_simplified_grid_alternates():
    assert ODD[:, [0, 2]].tolist() == [[False, False], [True, False], [False, True], [True, True]]
    assert not ODD[:, [1, 3]].any()
    assert EVEN[:, [1, 3]].tolist() == ODD[:, [0, 2]].tolist()
    assert not EVEN[:, [0, 2]].any()
    np.testing.assert_array_equal(alternating(np.array([0, 1, 2])), [ODD, EVEN, ODD])


def test_passes_stop_where_the_residual_is_small():
    """Each pass goes on from the covariance that the one before kept; an episode that is done keeps what it has."""
    search = binary_grid(np.arange(1), 0.1, lambda count: np.tile([[True]], (len(count), 1, 1)))
    go, asked = scripted(lambda r, p: 0.0 if r == 0 else 1.0)
    kept = repeated(search, 3)(np.full((2, 1, 1), 0.01), np.zeros(2, int), go)
    assert len(asked) == 3
    np.testing.assert_allclose(kept.base[:, 0, 0], [0.11, 0.25])  # 0.01 + 0.1; 0.01 + 0.3, capped
    with pytest.raises(ValueError, match="1 pass"):
        repeated(search, 0)


def test_element_grid_skips_what_is_not_a_covariance():
    search = element_grid(np.arange(2), 0.1)
    P = np.array([[[0.24, 0.0], [0.0, 1e-6]]])
    go, asked = scripted(lambda r, p: -p.sum())
    kept = search(P, np.zeros(1, int), go)
    tried = np.concatenate([p for _, p in asked])
    assert (np.linalg.eigvalsh(tried)[:, 0] > 0).all()
    assert [len(rows) for rows, _ in asked] == [1, 1, 4]  # 0.24 + 0.025 is over the cap; any coupling is indefinite
    np.testing.assert_allclose(kept.base[0], [[0.24, 0.0], [0.0, 0.100001]])


@pytest.mark.parametrize("name", METHODS)
def test_an_episode_is_the_same_alone_and_in_a_batch(plant, name):
    """Flags rise in some episodes and not in others: nobody else's numbers move."""
    scenarios = [
        FaultScenario(plant=cmg.ID, steps=260, noise_seed=i,
                      faults=[] if i == 1 else [cmg.loss(i, 0.9, 60, 260), cmg.loss((i + 1) % 4, 0.8, 60, 260)])
        for i in range(3)
    ]  # fmt: skip
    obs = simulate(plant, scenarios).obs
    together = run(make_diagnoser(name, plant), obs)
    for i in range(3):
        alone = run(make_diagnoser(name, plant), obs[i : i + 1])
        np.testing.assert_array_equal(alone.estimate[0], together.estimate[i])
        np.testing.assert_array_equal(alone.label[0], together.label[i])


def test_mekf_jacobian_is_the_derivative_of_the_step():
    for fault_model in ("torque", "wheel"):
        plant = load_plant("CMGSatellite", fault_model=fault_model)
        q, w, d = np.array([[*Q_V, np.sqrt(0.86)]]), np.array([W]), np.array([DELTA])
        f, r = np.array([[0.5, 1.0, 0.9, 0.7]]), 0.1 * R_K
        Phi = transition(q, w, d, f, r, fault_model == "wheel")[0]

        def after(e, plant=plant, q=q, w=w, d=d, f=f, r=r):
            x = np.concatenate([rotated(q, e[None, :3]), w + e[3:6], d], axis=1)
            return plant.propagate(0.0, x, r, f + e[6:])[0]

        base, h = after(np.zeros(10)), 1e-6
        v, s = -base[:3], base[3]
        for j in range(10):
            moved = (after(h * np.eye(10)[j]) - after(-h * np.eye(10)[j])) / (2 * h)
            turned = 2 * (s * moved[:3] + moved[3] * v + np.cross(v, moved[:3]))  # vector part of 2 q^-1 dq
            found = np.concatenate([turned, moved[4:7]])
            # Phi leaves out that the gimbals move within the step
            np.testing.assert_allclose(found, Phi[:6, j], atol=1e-2 * np.abs(Phi[:6, j]).max())


def test_mekf_observation_is_the_derivative_of_the_measurement():
    q = np.array([[*Q_V, -np.sqrt(0.86)]])
    for j in range(3):
        t = 1e-6 * np.eye(3)[j : j + 1]
        change = (rotated(q, t) - rotated(q, -t))[0, :3] / 2e-6
        np.testing.assert_allclose(observation(q)[0, :3, j], change, atol=1e-9)


# -- what the methods can do


def test_clairvoyant_resets_at_the_changes(plant):
    rows = changes(plant, [cmg.table4("slew"), FaultScenario(plant=cmg.ID, steps=100)])
    assert np.flatnonzero(rows[0]).tolist() == [2000, 4000, 7000, 10000, 15000]
    assert not rows[1].any()


@pytest.mark.parametrize("name", ["gaukf", "sgaukf", "caukf", "mekf", "mekf_clairvoyant"])
def test_a_fault_is_found_isolated_and_measured(plant, name):
    """Ten seconds after a jump of two units their labels are right and the estimate is within 0.05 (bound: 0.004)."""
    scenario = FaultScenario(plant=cmg.ID, steps=1400, noise_seed=5,
                             faults=[cmg.loss(0, 0.4, 400, 1400), cmg.loss(2, 0.7, 400, 1400)])  # fmt: skip
    record = simulate(plant, [scenario])
    known = {"scenarios": [scenario]} if name == "mekf_clairvoyant" else {}
    found = run(make_diagnoser(name, plant, **known), record.obs)
    assert not found.alarm[0, :401].any()
    assert (found.label[0, 1300:] == plant.label_of(frozenset({"CMG 1", "CMG 3"}))).mean() > 0.95
    np.testing.assert_allclose(found.estimate[0, -1], [0.6, 1.0, 0.3, 1.0], atol=0.05)


def test_other_plants_are_refused():
    with pytest.raises(NotApplicableError):
        make_diagnoser("sgaukf", load_plant("B747Lateral"))
    with pytest.raises(NotApplicableError):
        make_diagnoser("mekf", load_plant("B747Lateral"))


def test_a_wrong_form_or_grid_is_named(plant):
    with pytest.raises(ValueError, match="joint"):
        make_diagnoser("gaukf", plant, form="triple")
    with pytest.raises(ValueError, match="alternating"):
        make_diagnoser("gaukf", plant, grid="even")


def test_oracle_classifier_integrates_to_a_density(plant):
    """Each label's evidence is a density of f_hat: for two units against the integral over the severities."""
    rng = np.random.default_rng(2)
    B = 0.05 * rng.standard_normal((4, 4))
    P, f_hat = B @ B.T + 0.01 * np.eye(4), np.array([0.7, 1.02, 0.95, 0.6])
    alpha = np.linspace(0.1, 0.9, 801)
    a, b = np.meshgrid(alpha, alpha)
    gap = f_hat - np.stack([1 - a, np.ones_like(a), np.ones_like(a), 1 - b], axis=-1)
    exponent = -0.5 * np.einsum("abi,ij,abj->ab", gap, np.linalg.inv(P), gap)
    density = np.exp(exponent) / np.sqrt(np.linalg.det(2 * np.pi * P))
    expected = np.trapezoid(np.trapezoid(density, alpha), alpha) / 0.8**2
    found = log_evidence(f_hat[None], P[None], 0.1, 0.9)[0, plant.label_of(frozenset({"CMG 1", "CMG 4"}))]
    np.testing.assert_allclose(np.exp(found), expected, rtol=1e-4)


def test_bound_on_the_slew(plant):
    """Healthy slew at 45 dB, change at 40 s: sd 0.039-0.049, 0.0100-0.0102, 0.0038-0.0039 after 1, 3, 10 s."""
    faults = [cmg.loss(0, 1e-9, 4000, 6000)]
    scenario = FaultScenario(plant=cmg.ID, steps=5001, faults=faults, noise_seed=3)
    oracle = cramer_rao_oracle(plant, scenarios=[scenario])
    s, sd = oracle.init(1), {}
    for k in range(5001):
        s, _ = oracle.update(s, np.zeros((1, 22)))
        if k in (4100, 4300, 5000):
            sd[k] = np.sqrt(np.trace(s.P[0, 6:, 6:]) / 4)
    assert 0.036 < sd[4100] < 0.052
    assert sd[4300] == pytest.approx(0.0101, abs=0.0003)
    assert sd[5000] == pytest.approx(0.00385, abs=0.0001)
