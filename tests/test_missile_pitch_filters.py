"""The missile's estimators against their data sheet: check values, soundness, identities, conformance."""

import itertools

import msgspec
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import betabinom

from baselines.filters import approximation_detector as detection
from baselines.filters import augmented_ekf_bank as bank
from baselines.filters import augmented_ekf_imm as imm
from baselines.filters import generalised_observer_scheme as isolation
from baselines.filters import missile_ekf as ekf
from baselines.filters import missile_model as model
from baselines.oracles import innovation_oracle as oracle
from fdi_gym.diagnosis import NotApplicableError, diagnoser_of, find_diagnoser, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.estimation import mixing
from fdi_gym.estimation.calibration import Persistence
from fdi_gym.estimation.decision import Reading
from fdi_gym.estimation.interval import Interval
from fdi_gym.faults import FaultScenario
from fdi_gym.plants import missile_pitch as missile
from fdi_gym.testing import check_plant, check_streams, check_vector_env

FIVE = (1, 2, 3, 4, 5)
NAMES = (
    "approximation_detector", "approximation_detector_no_margin", "gos", "gos_strict", "gos_two_class",
    "gos_two_class_strict", "augmented_ekf_bank", "augmented_ekf_bank_unlatched", "augmented_ekf_imm",
    "augmented_ekf_mode_probabilities",
)  # fmt: skip


@pytest.fixture(scope="module")
def plant():
    return missile.plant()


@pytest.fixture(scope="module")
def quiet():
    return missile.plant(noise_scale=0.0)


@pytest.fixture(scope="module")
def study(quiet):
    """Detector and two-class bank at every sample of the study's scenario (episode 0) and its mirror (1), noise-free."""
    obs = simulate(quiet, [missile.study(), missile.study(2)]).obs
    return trace(quiet, obs, np.zeros(2), (1, 2))


@pytest.fixture(scope="module")
def numbered(plant):
    """The data sheet's episodes 0 and 1, noise included."""
    scenarios, noise = zip(*(missile.episode(seed) for seed in (0, 1)), strict=True)
    return list(scenarios), simulate(plant, scenarios, noise).obs


def trace(plant, obs, sigma, classes):
    """Detector and bank after each sample, for sensors with noise sigma."""
    rule = isolation.elimination(classes, True)
    diagnoser = diagnoser_of(plant, isolation.gos_filter(sigma, classes), rule)
    return [state.filter for state in states(diagnoser, obs)]


def states(diagnoser, obs):
    """The diagnoser's state after each sample."""
    state = diagnoser.init(len(obs))
    for k in range(obs.shape[1]):
        state, _ = diagnoser.update(state, obs[:, k])
        yield state


def first(condition):
    """Index of the first sample where it holds, or None."""
    return next((k for k, value in enumerate(condition) if value), None)


def test_filter_coefficients():
    assert_allclose([detection.A, detection.B0, detection.B1],
                    [0.9512294245007, 0.004836417097001, 0.004917698002856], rtol=1e-12)  # fmt: skip


def test_basis():
    phi = detection.basis(np.array([np.deg2rad(7)]))[0]
    assert_allclose(phi[6:], [0.7788007830714, 0.9726044771163, 0.4993517885993, 0.1053992245619, 0.009145947038428],
                    rtol=1e-10)  # fmt: skip


DETECTION = {  # sample: eps_2, thr_2, thr_1
    500: (-8.4990807699e-05, 1.5304656486e-01, 1.3917760661e-03),
    950: (-6.4550084252e-05, 1.6880246287e-01, 1.4849100426e-03),
    1100: (-1.5424605759e-01, 1.8948836206e-01, 1.6053499179e-03),
    1121: (-1.7714129200e-01, 1.7638070099e-01, 1.5300422638e-03),
    1500: (1.0361732598e-01, 7.9464907323e-02, 9.0191855234e-04),
}
ISOLATION = {  # sample: eps_2, lambda_2, theta of class 1, then of class 2
    1200: ((-3.8062887743e-02, 1.5113479594, 2.0627794605e-01), (-1.5089864155e-01, 3.9468729840e-01, -1.9480674317e-01)),
    1500: ((1.1147141352e-01, 1.1956256704, 2.9544732529e-01), (2.3537550901e-01, 4.4483462522e-01, 2.4485990247e-01)),
    1549: ((1.0563624062e-01, 2.0800040243, 4.2503748680e-01), (4.1162763187e-01, 4.0842626716e-01, 4.6287537030e-01)),
    1800: ((9.1770967655e-03, 2.7410688959, 5.8916358720e-01), (5.0173563378e-01, 5.4105099425e-01, 1.5)),
}


def test_detector_on_the_study(study):
    for k, (eps, threshold_2, threshold_1) in DETECTION.items():
        detector = study[k][0]
        assert_allclose(detector.eps[0, 1], eps, rtol=2e-8)
        assert_allclose(detector.threshold[0], [threshold_1, threshold_2], rtol=1e-9)


def test_isolation_estimators_on_the_study(study):
    for k, classes in ISOLATION.items():
        bank = study[k][1]
        for i, (eps, threshold, theta) in enumerate(classes):
            assert_allclose([bank.eps[0, i, 1], bank.threshold[0, i, 1], bank.used[0, i]], [eps, threshold, theta],
                            rtol=2e-8)  # fmt: skip
    bank = study[1500][1]  # of the mirror
    assert_allclose(bank.eps[1, :, 1], [6.0090672091e-02, 1.3791524605e-02], rtol=2e-8)
    assert_allclose(bank.threshold[1, :, 1], [9.9075987885e-01, 5.3518706142e-01], rtol=2e-8)
    assert_allclose(bank.used[1], [8.3623067923e-02, 4.0383337858e-01], rtol=2e-8)


def test_study_is_detected_and_isolated_when_it_says(study):
    alarm = np.array([d.alarm for d, _ in study])
    excluded = np.array([b.excluded for _, b in study])
    assert [first(alarm[:, 0]), first(alarm[:, 1])] == [1121, 1246]
    assert [first(excluded[:, 0, 1]), first(excluded[:, 1, 0])] == [1549, 1321]
    assert not excluded[:, 0, 0].any()
    assert not excluded[:, 1, 1].any()
    verdict = isolation.strict_verdict(study[-1][1].started, study[-1][1].excluded, (1, 2))
    assert verdict.tolist() == [1, 2]


def test_residual_of_the_true_class_stays_under_its_threshold(study):
    ratio = [np.abs(b.eps[0, 0, 1]) / b.threshold[0, 0, 1] for _, b in study[1121 + 50 :]]
    assert max(ratio) == pytest.approx(0.101, abs=1e-3)
    at_alarm = study[1121][1]
    assert abs(at_alarm.eps[0, 0, 1]) / at_alarm.threshold[0, 0, 1] == pytest.approx(0.989, abs=1e-3)


def test_noise_margin(quiet):
    """On the noise-free flight, with the sensors' sigma."""
    obs = simulate(quiet, [missile.study()]).obs
    rows = trace(quiet, obs, np.array(missile.SIGMA[:2]), (1, 2))
    assert_allclose(rows[900][0].sampled.nu[0], [8.924655737884e-03, 5.966486045777e-02], rtol=1e-10)
    assert_allclose(rows[2000][0].sampled.nu[0], [8.937822389253e-03, 4.638332425118e-02], rtol=1e-10)


def test_approximation_follows_the_fault_function(study, quiet):
    flown = simulate(quiet, [missile.study(), missile.study(2)])
    for i, (error, size) in enumerate([(0.688, 2.933), (0.134, 0.618)]):
        x, theta = flown.state[i, 1500:2001], flown.theta[i, 1500:2001]
        Z = model.fault_function(1 + i, x[:, 0], x[:, 2], x[:, 4], np.full(len(x), 2.5))[0][:, 1]
        truth = theta[:, i] * Z
        found = np.array([study[k][0].fhat[i] for k in range(1500, 2001)])
        assert np.sqrt(np.mean((truth - found) ** 2)) == pytest.approx(error, abs=2e-3)
        assert np.sqrt(np.mean(truth**2)) == pytest.approx(size, abs=2e-3)


def ratios_at(plant, obs, samples):
    said = run(bank.augmented_ekf_bank(plant), obs, signals=True)
    shown = (said.signals["log-likelihood ratios"], said.signals["fault parameters"], said.label)
    return {k: tuple(array[:, k] for array in shown) for k in samples}, said.alarm.T


def test_ekf_bank_on_the_study(plant, quiet):
    found, alarm = ratios_at(plant, simulate(quiet, [missile.study()]).obs, (1200, 2000))
    assert first(alarm[:, 0]) == 1048
    assert_allclose(found[1200][0][0], [609.0044556865, 557.8250842410, 244.6217188628, 535.2732168871, 527.0994442127],
                    rtol=1e-6)  # fmt: skip
    assert_allclose(found[1200][1][0], [0.2391810589921, -1.093752194239, 0, 0.08703757878659, 1], rtol=1e-6)
    assert_allclose(found[2000][0][0], [5178.109925525, 3307.816878187, 2934.690625741, 5090.923846575, 3912.235297097],
                    rtol=1e-6)  # fmt: skip
    assert found[2000][1][0, 0] == pytest.approx(0.6358146128830, rel=1e-6)
    assert found[2000][2] == [1]


def test_ekf_bank_on_the_numbered_episodes(plant, numbered):
    found, alarm = ratios_at(plant, numbered[1], (2000,))
    llr, theta, mode = found[2000]
    assert [first(alarm[:, 0]), first(alarm[:, 1])] == [1376, 1603]
    assert mode.tolist() == [5, 2]
    assert_allclose(llr, [
        [4.15782740864, 0.2290619058, 2.622994911863, -65.632281373, 13.63307716765],
        [123.4813361497, 1133.222066980, 231.1238192533, 1048.682738428, 647.7116007042],
    ], rtol=1e-9)  # fmt: skip
    assert_allclose(theta, [
        [0.063543493357, 0.010217808543, 0.028244480249, -0.033127455068, 0.236357822725],
        [0.013966728124, 0.19902493012, 0.001566412388, 0.14418419572, 0.002371913253],
    ], rtol=1e-8)  # fmt: skip


ORACLE = {  # (episode, sample): log evidence of labels 1..5 minus that of none
    (0, 924): (-3.113689471526, -2.181438219296, -4.051860516596, -13288.51756985, -0.403580377401),
    (0, 2000): (-4.874260106472, -7.053009966532, 63.03179413977, -460804.6966457, 217.1827745183),
    (1, 1741): (4.487769522287, 1638.270945570, 140.7249785874, -162344.7080177, 1262.380558490),
    (1, 2000): (38.14988777269, 3003.600472488, 52.13021162585, -936357.3240600, 335.9830543368),
}


def test_oracle_evidence(plant, numbered):
    scenarios, obs = numbered
    diagnoser = oracle.innovation_oracle(plant, scenarios=scenarios)
    for k, state in enumerate(states(diagnoser, obs)):
        for (episode, sample), expected in ORACLE.items():
            if sample == k:
                found = state.filter.log[episode]
                assert_allclose(found[1:] - found[0], expected, rtol=1e-9, atol=1e-9)
    assert np.argmax(state.filter.log, axis=1).tolist() == [5, 2]


def test_evidence_is_the_direct_gaussian_marginal_likelihood(plant):
    """The closed form against the dense Gaussian density of stacked innovations, on random numbers."""
    from scipy.stats import multivariate_normal

    rng = np.random.default_rng(0)
    p = oracle.priors([(0.1, 0.7), (0.1, 0.7), (0.05, 0.40), (0.3, 1.0)], (0.15, 2.0), 0.05, 0.0)
    steps, m, c = 6, 6, 6 + 28
    X, v, S = rng.normal(size=(steps, 2, c)), rng.normal(size=(steps, 2)), np.array([[2.0, 0.3], [0.3, 1.0]])

    def informed(rows, columns):
        found = oracle.nothing(1, columns)
        for i in rows:
            A, b = X[i, :, :columns], v[i]
            W = np.linalg.solve(S, A)
            found = found.add(oracle.Information(
                (A.T @ W)[None], (W.T @ b)[None], np.array([b @ np.linalg.solve(S, b) + np.log(np.linalg.det(S))]),
            ), np.array([True]))  # fmt: skip
        return found

    found = oracle.evidence(informed([0, 1], m), informed(range(2, steps), c), informed(range(2, steps), m),
                            np.zeros((1, 7)), p).log[0]  # fmt: skip

    def direct(column, mean, sd):
        """All six innovations; the first two carry no fault."""
        H = np.zeros((2 * steps, m + 1))
        for i in range(steps):
            H[2 * i : 2 * i + 2, :m] = X[i, :, :m]
            if column is not None and i >= 2:
                H[2 * i : 2 * i + 2, m] = X[i, :, column]
        prior = np.diag([*p.rho**2, sd**2])
        cov = H @ prior @ H.T + np.kron(np.eye(steps), S)
        return multivariate_normal(H @ np.array([*np.zeros(m), mean]), cov).logpdf(v.ravel())

    none = direct(None, 0.0, 1.0)
    for i, label in enumerate(oracle.LINEAR):
        parts = [direct(m + 7 * i + g, mu, p.sd[i]) for g in range(7) for mu in p.mu[i]]
        assert found[label] - found[0] == pytest.approx(np.logaddexp.reduce(parts) - np.log(14) - none, abs=1e-9)
    assert found[4] == pytest.approx(found[0], abs=1e-12)  # the same innovations for the jam's filter


def test_no_alarm_at_the_corners_of_the_uncertainty_box(quiet):
    """The threshold is sound, and close to sharp: the largest residual reaches 0.99 of it."""
    scenarios = [missile.study().without_faults().replace(physical={"rho": [0.05 * s for s in signs]})
                 for signs in itertools.product((-1, 1), repeat=6)]  # fmt: skip
    rows = trace(quiet, simulate(quiet, scenarios).obs, np.zeros(2), (1, 2))
    ratio = np.max([np.abs(d.eps) / d.threshold for d, _ in rows], axis=(0, 2))
    assert not rows[-1][0].alarm.any()
    assert ratio.max() == pytest.approx(0.9905, abs=1e-3)


def flights(seeds, faults=True):
    scenarios, noise = zip(*(missile.episode(seed) for seed in seeds), strict=True)
    return [s if faults else s.without_faults() for s in scenarios], noise


def test_no_false_alarm_on_fault_free_flights_and_one_in_each_without_the_margin(plant):
    scenarios, noise = flights(range(50), faults=False)
    obs = simulate(plant, scenarios, noise).obs
    for name in ("approximation_detector", "augmented_ekf_bank"):
        assert not run(make_diagnoser(name, plant), obs).alarm.any(), name
    bare = run(make_diagnoser("approximation_detector_no_margin", plant), obs[:20])
    assert bare.alarm[:, -1].all()


def test_the_true_class_is_never_excluded(plant):
    scenarios, noise = flights(range(40))
    record = simulate(plant, scenarios, noise)
    bank = trace(plant, record.obs, np.array(missile.SIGMA[:2]), FIVE)[-1][1]
    label = record.label[:, -1]
    faulty = np.flatnonzero(label)
    assert bank.excluded.any()  # there is something to exclude
    assert not bank.excluded[faulty, label[faulty] - 1].any()
    assert (bank.started <= (label > 0)).all()


def test_no_fault_means_no_bank(plant):
    scenarios, noise = flights(range(3), faults=False)
    bank = trace(plant, simulate(plant, scenarios, noise).obs, np.array(missile.SIGMA[:2]), FIVE)[-1][1]
    assert not bank.eps.any()
    assert (isolation.tie_broken(bank.started, bank.excluded, bank.energy, FIVE) == isolation.NONE).all()


def test_strict_verdicts():
    started = np.array([False, True, True, True])
    excluded = np.array([[0, 0, 0], [1, 0, 1], [1, 0, 0], [1, 1, 1]], bool)
    energy = np.array([[1, 2, 3], [1, 9, 2], [1, 9, 2], [3, 2, 1]], float)
    strict = isolation.strict_verdict(started, excluded, (1, 2, 4))
    assert strict.tolist() == [isolation.NONE, 2, isolation.SEVERAL, isolation.ALL]
    assert isolation.tie_broken(started, excluded, energy, (1, 2, 4)).tolist() == [isolation.NONE, 2, 4, 4]


def random_known(rng, n):
    """What may be known at a sample: everything has reported."""
    return model.Known(rng.uniform(-0.2, 0.2, n), rng.uniform(-0.2, 0.2, n), rng.uniform(1.5, 3, n), np.zeros(n, bool),
                       rng.normal(size=n))  # fmt: skip


def interval(known):
    """The interval that ends at a sample of which this is known."""
    n = len(known.delta)
    return Interval(np.full(n, 7), np.zeros((n, 2)), None, np.stack([*known[:3], 0 * known.mach], axis=1))


def random_filters(rng, n):
    L = rng.normal(0, 0.03, (n, 6, 6, 6))
    alpha = rng.uniform(-0.2, 0.2, (n, 6))
    return ekf.Filters(
        rng.normal(0, 0.1, (n, 6, 6)), L @ np.swapaxes(L, -1, -2), np.zeros((n, 6)), alpha, random_known(rng, n)
    )


def test_ekf_prediction_is_the_textbook_one():
    """The two rows that are written out against Phi P Phi' + Q with the whole matrix Phi."""
    rng = np.random.default_rng(2)
    n = 3
    filters, now = random_filters(rng, n), random_known(rng, n)
    after = ekf.predict(filters, interval(now))
    f1, F1 = ekf.rates(filters.z, filters.known)
    euler = filters.z.copy()
    euler[..., :2] += 0.01 * f1
    f2, F2 = ekf.rates(euler, now)
    E = np.zeros((n, 6, 6, 6))
    E[..., :2, :] = 0.01 * (F1 + F2) / 2
    Phi = np.eye(6) + E + E @ E / 2
    expected = Phi @ filters.P @ np.swapaxes(Phi, -1, -2)
    bound = model.uncertainty_bound(filters.alpha, filters.known.mach[:, None])[..., 0]
    expected[..., 0, 0] += 0.01 * ((0.577 * bound) ** 2 * 0.5 + 1e-8)
    expected[..., 1, 1] += 1e-7
    expected[..., 2, 2] += 0.01 * ekf.Q_THETA
    assert_allclose(after.P, expected, rtol=1e-10, atol=1e-15)
    assert_allclose(after.z[..., :2], filters.z[..., :2] + 0.005 * (f1 + f2), rtol=1e-12)
    assert np.array_equal(after.z[..., 2:], filters.z[..., 2:])


def test_ekf_jacobian_column_of_the_parameter_is_the_derivative():
    rng = np.random.default_rng(3)
    known = random_known(rng, 5)
    z = rng.normal(0, 0.1, (5, 6, 6))
    _, F = ekf.rates(z, known)
    for i in (1, 2, 3, 4, 5):
        up, down = z.copy(), z.copy()
        up[..., i] += 1e-6
        down[..., i] -= 1e-6
        difference = (ekf.rates(up, known)[0] - ekf.rates(down, known)[0]) / 2e-6
        assert_allclose(F[..., i], difference, rtol=1e-6, atol=1e-8)


def test_imm_without_transitions_leaves_the_filters_alone():
    rng = np.random.default_rng(4)
    filters = random_filters(rng, 2)
    filters.z[:, 0, 2], filters.P[:, 0, 2, :], filters.P[:, 0, :, 2] = 0, 0, 0
    mu = rng.dirichlet(np.ones(6), 2)
    c, w = mixing.ahead(mu, imm.transition(0.0))
    mixed = imm.mixed(filters, w)
    assert_allclose(c, mu, rtol=1e-12)
    assert_allclose(mixed.z, filters.z, rtol=1e-12, atol=1e-15)
    assert_allclose(mixed.P, filters.P, rtol=1e-12, atol=1e-15)


def test_imm_interaction_is_the_moment_matching_of_its_parts():
    """Written out: a fault's mode from itself and from health with theta anew, health from all without theta."""
    rng = np.random.default_rng(5)
    filters, p = random_filters(rng, 1), 0.3
    filters.z[:, 0, 2], filters.P[:, 0, 2, :], filters.P[:, 0, :, 2] = 0, 0, 0
    z, P, mu = filters.z[0], filters.P[0], rng.dirichlet(np.ones(6))
    Pi = imm.transition(p)

    def matched(weights, means, covariances):
        mean = sum(w * m for w, m in zip(weights, means, strict=True))
        return mean, sum(w * (C + np.outer(m - mean, m - mean))
                         for w, m, C in zip(weights, means, covariances, strict=True))  # fmt: skip

    def anew(j, value, variance):
        mean, covariance = z[j].copy(), P[j].copy()
        mean[2], covariance[2], covariance[:, 2] = value, 0.0, 0.0
        covariance[2, 2] = variance
        return mean, covariance

    c, w = mixing.ahead(mu[None], Pi)
    found = imm.mixed(filters, w)
    assert_allclose(c[0], mu @ Pi)
    parts = [anew(j, 0.0, 0.0) for j in range(6)]
    expected = [matched(mu * Pi[:, 0] / c[0, 0], *zip(*parts, strict=True))]
    means = [None, 0.0, 0.0, 0.1, filters.known.delta[0], 0.3]
    for j in range(1, 6):
        begun = anew(0, means[j], imm.RESTART_SD[j] ** 2)
        shares = [mu[j] * Pi[j, j] / c[0, j], mu[0] * Pi[0, j] / c[0, j]]
        expected.append(matched(shares, [z[j], begun[0]], [P[j], begun[1]]))
    for j, (mean, covariance) in enumerate(expected):
        assert_allclose(found.z[0, j], mean, rtol=1e-12, atol=1e-15)
        assert_allclose(found.P[0, j], covariance, rtol=1e-12, atol=1e-15)


def test_no_mode_is_ever_ruled_out(plant, numbered):
    """However little a mode explains, it keeps the least probability there is, and comes back if it must."""
    least = [state.filter.mu.min() for state in states(imm.augmented_ekf_imm(plant), numbered[1][:, :900])]
    assert min(least) == 1e-8


def test_mode_transitions_are_a_distribution():
    Pi = imm.transition(0.01 / 1.5)
    assert_allclose(Pi.sum(axis=1), 1.0)
    assert Pi[0, 1] == pytest.approx(0.01 / 7.5)
    assert Pi[1, 2] == 0


@pytest.mark.parametrize(("release", "expected"), [(15.0, "....AAAAAAAAAAA....."), (None, "....AAAAAAAAAAAAAAAA")])
def test_alarm_is_raised_and_released_by_runs_of_samples(release, expected):
    """Label 2 leads by 40 for 6 samples, then by 0: on at the 5th, off at the 10th sample under the release level."""
    rule = bank.likelihood_ratios(30.0, release, Persistence(5, 1, 10))
    state, found, informed = rule.start(1), "", np.ones(1, bool)
    for k in range(20):
        cost = np.array([[0.0, 0, -80 if k < 6 else 0, 0, 0, 0]])
        state, said = rule.step(state, np.array([k]), Reading(cost=cost), informed)
        found += "A" if said.alarm[0] else "."
        assert said.label[0] == (2 if said.alarm[0] else 0)
    assert found == expected


def test_label_is_the_best_of_the_last_sample_over_the_threshold():
    rule = bank.likelihood_ratios(30.0, 15.0, Persistence(1, 1, 10))
    state, found = rule.start(1), []
    for best, lead in [(2, 40), (3, 20), (3, 40), (1, 20), (5, 0)]:
        state, said = rule.step(state, np.zeros(1), Reading(cost=-2.0 * lead * np.eye(6)[best][None]), np.ones(1, bool))
        found.append(int(said.label[0]))
    assert found == [2, 2, 3, 3, 3]


# -- gaps


def test_ekf_update_with_missing_sensors_is_that_with_their_rows_removed(plant):
    rng = np.random.default_rng(6)
    filters, y, R = random_filters(rng, 4), rng.normal(0, 0.1, (4, 3)), plant.R[:2, :2]
    filters.z[..., 2] = 0.5 * (ekf.THETA_MIN + ekf.THETA_MAX)
    seen = np.array([[1, 1, 1], [1, 0, 0], [0, 1, 1], [0, 0, 1]], bool)
    after = ekf.update(filters, y, seen, R)
    for i, j in itertools.product(range(3), range(6)):
        rows = np.flatnonzero(seen[i, :2])
        z, P, H = filters.z[i, j], filters.P[i, j], np.eye(2, 6)[rows]
        v, S = y[i, rows] - H @ z, H @ P @ H.T + R[np.ix_(rows, rows)]
        K = P @ H.T @ np.linalg.inv(S)
        expected = z + K @ v
        expected[2] = np.clip(expected[2], ekf.THETA_MIN[j], ekf.THETA_MAX[j])
        assert_allclose(after.z[i, j], expected, rtol=1e-9, atol=1e-12)
        assert_allclose(after.P[i, j], P - K @ S @ K.T, rtol=1e-9, atol=1e-12)
        log = -0.5 * (v @ np.linalg.solve(S, v) + np.log(np.linalg.det(S)))
        assert after.log_likelihood[i, j] == pytest.approx(log, rel=1e-9)
    assert np.array_equal(after.z[3], filters.z[3])
    assert_allclose(after.P[3], filters.P[3], rtol=1e-12)
    assert not after.log_likelihood[3].any()


def test_ekf_knows_nothing_of_the_state_where_the_actuators_are_not_known(plant):
    """Then the fault parameter keeps its estimate and no sample speaks for or against a label."""
    rng = np.random.default_rng(7)
    filters = random_filters(rng, 2)
    filters.z[..., :2] *= 0.1
    after = ekf.predict(filters, interval(random_known(rng, 2))._replace(held=np.array([True, False])))
    assert_allclose(after.P[0, :, :2, :2], np.broadcast_to(np.diag(model.RANGE**2), (6, 2, 2)))
    assert not after.P[0, :, :2, 2:].any()
    assert_allclose(after.P[0, :, 3:, 3:], filters.P[0, :, 3:, 3:])
    y = np.column_stack([after.z[:, 0, :2], np.zeros(2)])
    done = ekf.update(after, y, np.ones((2, 3), bool), plant.R[:2, :2])
    assert np.ptp(done.log_likelihood[0]) < 0.02
    assert np.ptp(done.log_likelihood[1]) > 0.2
    assert_allclose(done.z[0, :, 2], np.clip(filters.z[0, :, 2], ekf.THETA_MIN, ekf.THETA_MAX), atol=1e-6)


def test_oracle_update_with_missing_sensors_is_that_with_their_rows_removed(plant):
    rng = np.random.default_rng(8)
    c, R = 5, plant.R[:2, :2]
    L = rng.normal(0, 0.05, (3, 2, 2))
    f = oracle.Tracked(rng.normal(size=(3, 2)), L @ np.swapaxes(L, 1, 2), rng.normal(size=(3, 2, c)))
    y, seen = rng.normal(size=(3, 2)), np.array([[1, 0], [0, 1], [0, 0]], bool)
    after, told = oracle.update(f, y, seen, R)
    for i in (0, 1):
        h, S = f.s[i, i], f.P[i, i, i] + R[i, i]
        K, v = f.P[i, :, i] / S, y[i, i] - f.x[i, i]
        assert_allclose(after.x[i], f.x[i] + K * v, rtol=1e-9)
        assert_allclose(after.P[i], f.P[i] - np.outer(K, f.P[i, i]), rtol=1e-9, atol=1e-12)
        assert_allclose(after.s[i], f.s[i] - np.outer(K, h), rtol=1e-9)
        assert_allclose(told.A[i], np.outer(h, h) / S, rtol=1e-9)
        assert_allclose(told.b[i], h * v / S, rtol=1e-9)
        assert told.c[i] == pytest.approx(v**2 / S + np.log(S), rel=1e-9)
    assert not any(part[2].any() for part in told)
    assert all(np.allclose(a[2], b[2], rtol=1e-12) for a, b in zip(after, f, strict=True))


def gappy(obs, kind):
    """The observations without everything for so many samples in a row, twice; or by the name of the pattern."""
    obs = obs.copy()
    if kind == "nothing at sample 0":
        obs[:, 0] = np.nan
    elif kind == "alpha every seventh":
        obs[:, ::7, 0] = np.nan
    elif kind == "q every seventh":
        obs[:, ::7, 1] = np.nan
    elif kind == "known signals every seventh":
        obs[:, ::7, 3:] = np.nan
    else:
        for k in (120, 300):
            obs[:, k : k + kind] = np.nan
    return obs


PATTERNS = [1, 5, 10, 20, 40, "nothing at sample 0", "alpha every seventh", "q every seventh", "known signals every seventh"]


def false_alarms(plant, name, count, patterns):
    """How many of these healthy flights, 4.2 s long, have an alarm: without gaps, then by pattern."""
    scenarios, noise = flights(range(count), faults=False)
    scenarios, noise = [s.replace(steps=420) for s in scenarios], [(w[:420], v[:421]) for w, v in noise]
    healthy = simulate(plant, scenarios, noise).obs
    obs = np.concatenate([healthy, *(gappy(healthy, pattern) for pattern in patterns)])
    return run(make_diagnoser(name, plant), obs).alarm.any(axis=1).reshape(-1, count).sum(axis=1)


@pytest.mark.parametrize("name", ["approximation_detector", "gos", "augmented_ekf_bank", "augmented_ekf_bank_unlatched"])
def test_gaps_raise_no_alarm_on_healthy_flights(plant, name):
    alarms = false_alarms(plant, name, 8, PATTERNS)
    assert not alarms.any(), dict(zip([None, *PATTERNS], alarms.tolist(), strict=True))


@pytest.mark.parametrize("name", ["augmented_ekf_imm", "augmented_ekf_mode_probabilities"])
def test_gaps_do_not_raise_the_rate_of_false_alarms(plant, name):
    """The label is the most probable one, so one sample is enough: within what the rate without gaps predicts."""
    patterns = [5, 20, "nothing at sample 0", "q every seventh"]
    without, *alarms = false_alarms(plant, name, 32, patterns).tolist()
    assert max(alarms) <= betabinom.ppf(0.99, 32, without + 1, 32 - without + 1), (without, alarms)
    assert without < 10


def sensors_missing(obs, kind):
    """Without the sensors, the rest is there: 40 samples, or at random."""
    obs, rng = obs.copy(), np.random.default_rng(9)
    if kind == "all":
        for k in (150, 450, 1050):
            obs[:, k : k + 40, :3] = np.nan
    elif kind in ("alpha", "q"):
        for k in (150, 450, 1050):
            obs[:, k : k + 40, 0 if kind == "alpha" else 1] = np.nan
    else:
        obs[:, 1:, :3][rng.random(obs[:, 1:, :3].shape) < 0.2] = np.nan
    return obs


@pytest.mark.parametrize("kind", ["all", "alpha", "q", "random"])
def test_thresholds_bound_the_residual_through_gaps_at_the_corners_of_the_uncertainty_box(quiet, kind):
    """Where there is no noise the bound is the model error's alone; the gaps' part of it is not slack only."""
    corners = [(1,) * 6, (-1,) * 6, (1, -1, 1, -1, 1, -1), (-1, 1, 1, 1, -1, -1), (1, 1, -1, -1, -1, 1)]
    healthy = missile.study(steps=1300).without_faults()
    scenarios = [healthy.replace(physical={"rho": [0.05 * s for s in signs]}) for signs in corners]
    obs = sensors_missing(simulate(quiet, scenarios).obs, kind)
    rows = [d for d, _ in trace(quiet, obs, np.zeros(2), (1, 2))]
    ratio = np.max([np.abs(d.eps) / d.threshold for d in rows])
    assert not rows[-1].alarm.any()
    assert ratio > 0.5


@pytest.mark.parametrize("kind", ["all", "alpha", "q", "random"])
def test_the_spread_bounds_what_the_prediction_is_off(plant, kind):
    scenarios, noise = flights(range(6), faults=False)
    record = simulate(plant, scenarios, noise)
    obs = sensors_missing(record.obs, kind)[:, :800]
    for k, state in enumerate(states(detection.approximation_detector(plant), obs)):
        e = state.filter.estimator
        assert (np.abs(record.state[:, k, :2] - e.a) <= e.spread).all()


@pytest.mark.parametrize("kind", ["all", "random"])
def test_the_true_class_is_never_excluded_through_gaps(plant, kind):
    scenarios, noise = flights(range(24))
    record = simulate(plant, scenarios, noise)
    bank = trace(plant, sensors_missing(record.obs, kind), np.array(missile.SIGMA[:2]), FIVE)[-1][1]
    label = record.label[:, -1]
    faulty = np.flatnonzero(label)
    assert bank.excluded.any()
    assert not bank.excluded[faulty, label[faulty] - 1].any()
    assert (bank.started <= (label > 0)).all()


def test_detector_learns_and_tests_nothing_where_a_sensor_is_missing(plant):
    scenarios, noise = flights([1])
    obs = simulate(plant, scenarios, noise).obs[:, 1500:]  # a leak begins at 41
    without = [s.filter for s in states(detection.approximation_detector(plant), obs)]
    learns = np.diff([d.W[0] for d in without], axis=0).any(axis=1)
    k = np.flatnonzero(learns)[learns.sum() // 2]  # the weights change from sample k to the next
    obs[:, k + 1, 0] = np.nan
    holed = [s.filter for s in states(detection.approximation_detector(plant), obs)]
    assert np.array_equal(holed[k].W, without[k].W)
    assert np.array_equal(holed[k + 1].W, holed[k].W)
    assert not np.array_equal(holed[-1].W, holed[k].W)
    assert holed[k + 1].eps[0, 0] == 0.0
    assert holed[k + 1].eps[0, 1] == pytest.approx(without[k + 1].eps[0, 1], rel=0.05)
    assert (holed[k + 1].threshold >= without[k + 1].threshold).all()


def test_oracle_reads_the_times_only(plant):
    scenario = missile.study()
    other = missile.study().replace(faults=[missile.fault(3, 0.2, 1.0, 1000)])
    obs = simulate(plant, [scenario]).obs[:, :1100]
    a, b = (run(make_diagnoser("innovation_oracle", plant, scenarios=[s]), obs) for s in (scenario, other))
    assert (a.label == b.label).all()
    assert (a.label[0, :1001] == 0).all()


@pytest.mark.parametrize("name", [*NAMES, "innovation_oracle"])
def test_not_applicable_elsewhere(name):
    known = {"scenarios": []} if name == "innovation_oracle" else {}
    with pytest.raises(NotApplicableError):
        make_diagnoser(name, load_plant("B747Lateral"), **known)


@pytest.mark.parametrize("name", ["augmented_ekf_bank", "augmented_ekf_imm", "innovation_oracle"])
def test_filters_that_divide_by_the_noise_decline_a_plant_without(quiet, name):
    known = {"scenarios": []} if name == "innovation_oracle" else {}
    with pytest.raises(NotApplicableError, match="noise"):
        make_diagnoser(name, quiet, **known)


def test_plant_conformance(plant):
    check_plant(plant, range(3))
    check_streams(plant)


@pytest.mark.parametrize("kwargs", [{}, {"task": "identification", "units": "scaled"},
                                    {"decision_period": 5, "mismatch": 0.02, "process": "hard"}])  # fmt: skip
def test_vector_env_conformance(plant, kwargs):
    check_vector_env(plant, n=3, steps=120, **kwargs)


@pytest.mark.slow
def test_randomised_accuracy(plant):
    """200 numbered episodes: the data sheet's bands and ordering."""
    seeds = range(10000, 10200)
    scenarios, noise = flights(seeds)
    record = simulate(plant, scenarios, noise)
    label = record.label[:, -1]
    onset = np.array([s.faults[0].onset if s.faults else 1000 for s in scenarios])
    accuracy = {}
    for name in ("gos", "augmented_ekf_bank", "innovation_oracle"):
        known = {"scenarios": scenarios} if name == "innovation_oracle" else {}
        mode = run(make_diagnoser(name, plant, **known), record.obs).label
        at = [np.minimum(onset + 200, 2000), np.minimum(onset + 400, 2000), np.full(len(seeds), 2000)]
        accuracy[name] = [np.mean(mode[np.arange(len(seeds)), k] == label) for k in at]
    assert 0.85 <= accuracy["augmented_ekf_bank"][2] <= 0.96
    assert 0.62 <= accuracy["gos"][2] <= 0.80
    assert (np.array(accuracy["gos"]) < accuracy["augmented_ekf_bank"]).all()
    assert (np.array(accuracy["augmented_ekf_bank"]) < accuracy["innovation_oracle"]).all()


def test_scenario_without_faults_has_an_empty_oracle_window_when_hard(plant):
    scenario = FaultScenario(plant=missile.ID, steps=2000)
    obs = simulate(plant, [scenario]).obs[:, :60]
    said = run(make_diagnoser("innovation_oracle", plant, scenarios=[scenario], hard=True), obs)
    assert not said.alarm.any()


@pytest.mark.parametrize("name", [*NAMES, "innovation_oracle"])
def test_settings_of_a_name_can_be_written_to_a_row(name):
    settings = dict(find_diagnoser(name).settings)
    msgspec.json.encode(settings)
    assert all(type(value) in (bool, int, float, str, tuple) for value in settings.values())


def test_the_approximated_fault_function_is_part_of_the_diagnosis():
    """On the study's flight it follows the fault function with an rms error of 23 % over 15 to 20 s."""
    from fdi_gym.plots import method_signals

    plant = load_plant("MissilePitch", noise_scale=0.0)
    record = simulate(plant, [plant.process("study").sample(np.random.default_rng(0))])
    said = run(make_diagnoser("approximation_detector", plant), record.obs, signals=True)
    alpha, theta = record.state[0, :, 0], record.theta[0, :, 0]
    true = theta * missile.K1 * missile.K_Q * 2.5**2 * abs(missile.B_M) * alpha * np.abs(alpha)
    late = slice(1500, 2001)
    error = said.signals["fault function"][0, late] - true[late]
    assert np.sqrt((error**2).mean()) == pytest.approx(0.688, abs=0.01)
    assert np.sqrt((true[late] ** 2).mean()) == pytest.approx(2.933, abs=0.01)
    assert len(method_signals(plant, record, said).axes) == 3
