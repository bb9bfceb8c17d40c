"""The missile against its data sheet: check values at their printed precision, identities, sampler, environment."""

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_allclose

from baselines.filters import missile_model as model
from fdi_gym.discovery import load_plant
from fdi_gym.engine import no_noise, simulate
from fdi_gym.estimation.interval import Interval
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plants import missile_pitch as missile

DEG = np.pi / 180
RHO = [0.05, -0.05, 0.03, 0.02, -0.04, 0.01]
POINTS = [  # alpha, delta [deg], M; C_n0, C_m0, xi_1, xi_2, etabar_1, etabar_2, Z_1, Z_2 at q = 0.1, j = 0.2
    (10, -9, 2.5, -2.820666666667, -1.905, -0.02809576061102, 0.8073134486301, 0.007708838191596, 0.8989442131849,
     6.756518604452, 0.4192227743022),
    (-6, 5, 1.5, 1.844352, 1.57356, 0.1516791351852, 2.706696719030, 0.002914979381168, 0.2309606741170,
     -0.8756448111370, 1.139565649462),
    (3, 0, 3.0, -0.591069, -0.016695, 0.06336242609367, 1.014892179526, 0.001849116800011, 0.1853323447845,
     0.8756448111370, 1.737630112526),
    (15, -12, 2.0, -5.170625, -4.936875, -0.09036321253284, -10.94648801014, 0.01172301839129, 1.573980094726,
     9.729386790411, 0.05945843277232),
]  # fmt: skip
TRIMS = [  # alpha [deg], M; delta [deg], q [rad/s], eta [g]
    (10, 1.5, -15.84951456311, 0.08701834539071, -4.266012796593),
    (10, 2.5, -9.247572815534, 0.1276669789478, -10.43130548025),
    (10, 3.0, -5.946601941748, 0.1427822167153, -13.99959424414),
    (5, 2.0, -4.299150485437, 0.04979176008955, -3.217472033637),
    (-8, 2.8, 4.599611650485, -0.1057262034376, 9.621868690125),
]


@pytest.fixture(scope="module")
def plant():
    return missile.plant()


@pytest.fixture(scope="module")
def quiet():
    return missile.plant(noise_scale=0.0)


def rate(plant, x, u=(0.0, 0.0), theta=None, mach=2.5, rho=()):
    """xdot and noise-free sensors from the compiled kernels, with the truth's own p."""
    dx, y = np.zeros(5), np.zeros(3)
    theta = plant.nominal_theta if theta is None else np.array(theta, float)
    arguments = (0.0, np.array(x, float), np.array(u, float), theta, np.array([mach - 2.5, 0.0]),
                 missile.physical({"rho": list(rho)}))  # fmt: skip
    plant.kernels.dynamics(*arguments, dx)
    plant.kernels.output(*arguments, y)
    return dx, y


def test_constants():
    assert_allclose([missile.K_ALPHA, missile.K_Q, missile.K_Z],
                    [0.02069011307436, 1.231957808219, 0.6659389189525], rtol=1e-12)  # fmt: skip
    assert_allclose(
        [missile.A_N, missile.B_N, missile.C_N, missile.D_N, missile.A_M, missile.B_M, missile.C_M, missile.D_M],
        [19.37336772789, -31.02252000761, -9.717364205419, -1.948056503445,
         40.43955399510, -64.01472382523, 2.922084755167, -11.80293057969], rtol=1e-12,
    )  # fmt: skip


@pytest.mark.parametrize("point", POINTS)
def test_model_check_values(plant, point):
    alpha, delta, mach, C_n, C_m, *expected = point
    a = np.array([alpha * DEG])
    assert_allclose(sum(model.force_terms(a, mach)), C_n, rtol=1e-10)
    assert_allclose(sum(model.moment_terms(a, mach)), C_m, rtol=1e-10)
    bound = model.uncertainty_bound(a, mach)[0]
    Z_1, Z_2 = (model.fault_function(c, a, a, a, np.array([mach]))[0][0, 1] for c in (1, 2))
    xi = model.xi(a, 0.1, delta * DEG, 0.2, mach)[0]
    assert_allclose([*xi, *bound, Z_1, Z_2], expected, rtol=1e-10)
    # the compiled kernel says the same
    x = [alpha * DEG, 0.1, delta * DEG, 0.0, 0.2]
    healthy = rate(plant, x, mach=mach)[0][:2]
    aero, leak = (rate(plant, x, theta=np.eye(5)[i], mach=mach)[0][:2] for i in (0, 1))
    assert_allclose([*healthy, aero[1] - healthy[1], leak[1] - healthy[1]], [*expected[:2], *expected[4:]], rtol=1e-9)


@pytest.mark.parametrize("trim", TRIMS)
def test_trim(plant, trim):
    alpha, mach, delta, q, eta = trim
    dx, y = rate(plant, [alpha * DEG, q, delta * DEG, 0.0, 0.0], mach=mach)
    assert_allclose(dx[:2], 0.0, atol=1e-11)
    assert_allclose(y[2], eta, rtol=1e-10)


UNCERTAIN = [  # label, theta, gamma; alpha_dot, q_dot; alpha, q after one Runge-Kutta step
    (0, 0.0, 1.0, 0.1307939209553, -0.02770812867542, 0.1003266634212, 0.2000053643286),
    (1, 0.75, 0.2, 0.1307939209553, 0.5207229354528, 0.1003283802746, 0.2013815088630),
    (2, 0.75, 0.2, 0.1307939209553, 0.2683775783909, 0.1003275872547, 0.2007446397196),
    (3, 0.3, 0.5, 0.1298432712990, -0.8894096883672, 0.1003215760003, 0.1978379970568),
    (4, 1.0, 0.0, 0.1307939209553, -0.02770812867542, 0.1003265507493, 0.1999378302200),
    (5, 0.8, 1.0, 0.1307939209553, -0.4427471927218, 0.1003253410870, 0.1989365415547),
]
X0, U0 = [0.1, 0.2, -0.05, 0.3, 0.1], (-0.08, 0.15)


def profile(label, size, gamma, since):
    theta = np.zeros(5)
    if label:
        theta[label - 1] = size if label == 4 else size * (1 - np.exp(-gamma * since))
    return theta


@pytest.mark.parametrize("row", UNCERTAIN)
def test_uncertain_plant(plant, row):
    label, size, gamma, alpha_dot, q_dot, alpha, q = row

    def f(x, since):
        return rate(plant, x, U0, profile(label, size, gamma, since), rho=RHO)[0]

    k1 = f(X0, 2.0)
    assert_allclose(k1[:2], [alpha_dot, q_dot], rtol=1e-10)
    assert_allclose(k1[2:], [0.0, 0.0, 2.5] if label == 4 else [0.3, -738.0, 2.5], rtol=1e-12)
    h = 0.0025
    k2 = f(X0 + h / 2 * k1, 2 + h / 2)
    k3 = f(X0 + h / 2 * k2, 2 + h / 2)
    x = X0 + h / 6 * (k1 + 2 * (k2 + k3) + f(X0 + h * k3, 2 + h))
    fin = [-0.05, 0.3] if label == 4 else [-0.05119387255859, -1.120066669922]
    assert_allclose(x, [alpha, q, *fin, 0.1058751424154], rtol=1e-10)


def test_a_jammed_fin_has_no_rate_after_the_step(plant):
    jam = [0, 0, 0, 1, 0]
    after = plant.propagate(0.0, np.array([X0]), np.array([U0]), np.array([jam]))[0]
    assert after[2] == X0[2]
    assert after[3] == 0.0
    rateless = plant.propagate(0.0, np.array([[*X0[:3], 0.0, X0[4]]]), np.array([U0]), np.array([jam]))[0]
    assert (after == rateless).all()  # taking the rate away at the sample or after the step is the same flight


def test_open_loop(quiet):
    """Two seconds under constant commands with the profile inside the integrator, through the simulation's own step."""
    x = np.array([0.05, 0.0, 0.0, 0.0, 0.0])
    h = 0.0025
    u = (-0.05, 0.1)

    def f(x, t):
        return rate(quiet, x, u, profile(1, 0.75, 0.2, t), rho=RHO)[0]

    for i in range(800):
        t = i * h
        k1 = f(x, t)
        k2 = f(x + h / 2 * k1, t + h / 2)
        k3 = f(x + h / 2 * k2, t + h / 2)
        x = x + h / 6 * (k1 + 2 * (k2 + k3) + f(x + h * k3, t + h))
    assert_allclose(x[:2], [0.08743950947139, -0.009923604214988], rtol=1e-10)


def test_controller(plant):
    c, u = np.array([-0.05, 0.0, 0.0, 1.0, 0.12, 0.0]), np.zeros(2)
    plant.kernels.control(0.0, np.array([0.1, 0.2, 0.0]), np.array([0.0, 2.5]), plant.q, c, u)
    assert_allclose([*u, c[3]], [-0.05432510553320, -0.07175520299011, 0.7932152849021], rtol=1e-10)


def test_prefilter(plant):
    c, u, at = np.zeros(6), np.zeros(2), {}
    for k in range(51):
        at[k] = c[4]
        plant.kernels.control(0.0, np.zeros(3), np.array([1.0, 2.5]), plant.q, c, u)
    assert_allclose([at[k] for k in (1, 2, 10, 50)],
                    [0.003066104558375, 0.01174954641910, 0.2076374159287, 0.9933466357846], rtol=1e-10)  # fmt: skip


STUDY = {  # alpha, q, delta, jet
    500: (1.507974652557e-01, 5.495232947158e-02, -1.241574198520e-01, -1.502759694282e-02),
    1000: (-1.852527746562e-01, -1.457511373311e-01, 1.793206874115e-01, 1.174721063510e-03),
    1500: (1.275324056468e-01, 1.564752546132e-01, -8.166799694021e-02, -1.301727018479e-01),
    2000: (-4.569181036853e-03, -9.117038781133e-02, 6.568259206214e-04, -4.930218206960e-03),
}
LOOP = [  # label, theta, gamma, sample; alpha, q, delta, jet, eta
    (0, 0.0, 1.0, 900, 7.120660133707e-02, 1.702797471231e-01, -2.553281873583e-02, 5.365156877814e-03,
     -4.092756286208),
    (0, 0.0, 1.0, 2000, 5.888821266679e-02, -8.840831519396e-02, -2.649113109415e-02, -2.457195384311e-02,
     -2.891154560775),
    (1, 0.5, 0.5, 2000, 5.764814547246e-02, -8.815743154686e-02, -2.361728974060e-02, -5.274026588946e-02,
     -2.840147230983),
    (2, -0.5, 0.5, 2000, 5.849271348305e-02, -8.923475412968e-02, -3.119845447017e-02, 4.478011590686e-02,
     -2.832829628087),
    (3, 0.3, 0.5, 2000, 6.044656530477e-02, -8.664705955837e-02, -3.235527230260e-02, 4.305611909486e-02,
     -3.010896230009),
    (4, 0.0, 1.0, 2000, 7.884377967004e-02, 1.894650143505e-02, -1.242569410586e-01, -9.999966445785e-01,
     -3.368379178622),
    (5, 0.8, 0.5, 2000, 5.870016145506e-02, -8.848674382210e-02, -2.519940832006e-02, -4.089896358174e-02,
     -2.889795568653),
]  # fmt: skip


def test_study_scenario(quiet):
    flown = simulate(quiet, [missile.study(), missile.study(2)])
    for k, expected in STUDY.items():
        assert_allclose(flown.state[0, k][[0, 1, 2, 4]], expected, rtol=1e-9)
    assert_allclose(flown.state[1, 1500, :2], [1.262604666490e-01, 1.541657347987e-01], rtol=1e-9)


@pytest.mark.parametrize("row", LOOP)
def test_closed_loop(quiet, row):
    label, size, gamma, k, *expected = row
    scenario = FaultScenario(
        plant=missile.ID, steps=2000, faults=[missile.fault(label, size, gamma, 1000)] if label else [],
        reference={"command": "sine", "amplitude": 10.0, "period": 8.0},
        disturbance={"mach": [2.8, 2.4]}, physical={"rho": RHO},
    )  # fmt: skip
    flown = simulate(quiet, [scenario])
    # the jet sits at its limit after a jam; its distance from it, 3e-6, is what carries the rounding
    assert_allclose([*flown.state[0, k][[0, 1, 2, 4]], flown.obs[0, k, 2]], expected, rtol=1e-9)


def test_nominal_actuators_are_the_true_ones_without_a_fin_fault(quiet):
    flown = simulate(quiet, [missile.study(), missile.study(2)])
    _, _, known = quiet.split(flown.obs)
    assert_allclose(known[..., 0], flown.state[..., 2], rtol=0, atol=1e-14)
    assert_allclose(known[..., 1], flown.state[..., 4], rtol=0, atol=1e-14)


def test_a_jam_freezes_the_fin_where_it_is_and_releases_it_at_rest(quiet):
    scenario = missile.study().replace(faults=[missile.fault(4, 0.0, 1.0, 1000, 1200)])
    x = simulate(quiet, [scenario]).state[0]
    assert (x[1000:1201, 2] == x[1000, 2]).all()
    assert (x[1001:1201, 3] == 0).all()
    assert abs(x[999, 3]) > 0
    assert abs(x[1201, 3]) > 0


def test_compiled_kernel_has_the_affine_fault_form_of_the_estimators(plant):
    rng = np.random.default_rng(5)
    alpha, q, delta, jet = rng.uniform(-0.3, 0.3, (4, 20))
    mach = rng.uniform(1.5, 3, 20)
    nominal = model.xi(alpha, q, delta, jet, mach)
    size = {1: 0.7, 2: -1.2, 3: 0.3, 4: 0.11, 5: 0.6}
    for label in range(1, 6):
        Z, F0 = model.fault_function(label, alpha, delta, jet, mach)
        wanted = nominal + F0 + size[label] * Z
        for i in range(20):
            fin = size[4] if label == 4 else delta[i]
            theta = np.zeros(5) if label == 4 else size[label] * np.eye(5)[label - 1]
            dx, _ = rate(plant, [alpha[i], q[i], fin, 0, jet[i]], theta=theta, mach=mach[i])
            assert_allclose(dx[:2], wanted[i], rtol=1e-10, atol=1e-12)


def test_slopes_and_regressors_are_derivatives():
    rng = np.random.default_rng(6)
    alpha, q, delta, jet = rng.uniform(-0.3, 0.3, (4, 50))
    mach, h = rng.uniform(1.5, 3, 50), 1e-6

    def difference(f):
        return (f(alpha + h) - f(alpha - h)) / (2 * h)

    A11, A21 = model.slopes(alpha, delta, mach)
    d = difference(lambda a: model.xi(a, q, delta, jet, mach))
    assert_allclose(np.stack([A11, A21], -1), d, rtol=1e-6, atol=1e-6)
    for label in (1, 2):
        d = difference(lambda a, label=label: model.fault_function(label, a, delta, jet, mach)[0][..., 1])
        assert_allclose(model.fault_slope(label, alpha, mach), d, rtol=1e-6, atol=1e-6)


def near(rng, n=2000):
    """Points alpha, q, where the estimators may be, how far off at most, points that are within that; and what is known."""
    a, spread = np.column_stack([rng.uniform(-0.3, 0.3, n), rng.uniform(-1, 1, n)]), rng.uniform(0.0, 0.04, (n, 2))
    x = np.clip(
        a + spread * rng.choice([-1.0, 1.0, *rng.uniform(-1, 1, 2)], (n, 2)), [-20 * DEG, -np.inf], [20 * DEG, np.inf]
    )
    delta, mach = rng.uniform(-0.3, 0.3, n), rng.uniform(1.5, 3, n)
    return a, spread, x, model.Known(delta, rng.uniform(-0.2, 0.2, n), mach, np.zeros(n, bool), np.zeros(n))


def test_an_error_grows_no_faster_than_its_bound():
    """Through the model's slope and errors of the coefficients, and where actuators do not report through those."""
    rng = np.random.default_rng(8)
    a, spread, x, known = near(rng)
    apart = np.abs(model.xi(*x.T, *known[:3]) - model.xi(*a.T, *known[:3]))
    error = model.uncertainty_bound(x[:, 0], known.mach)
    bound = model.growth(a[:, 0], spread, known)
    assert (apart + error <= bound + 1e-12).all()
    assert (model.growth(x[:, 0], None, known) == error).all()
    assert ((apart + error) / bound).max(axis=0).min() > 0.9  # and no bound is far off
    fins, jets = rng.uniform(-missile.DELTA_MAX, missile.DELTA_MAX, (2, len(a))), rng.uniform(-1, 1, (2, len(a)))
    moved = np.abs(np.subtract(*(model.xi(*x.T, fin, jet, known.mach) for fin, jet in zip(fins, jets, strict=True))))
    assert (moved <= model.growth(x[:, 0], None, known._replace(held=np.ones(len(a), bool))) - error + 1e-12).all()


@pytest.mark.parametrize("label", range(6))
def test_a_faults_part_of_an_error_grows_no_faster_than_its_bound(label):
    a, spread, x, known = near(np.random.default_rng(label))
    size = np.random.default_rng(9).uniform(-1, 1, len(a))

    def fault(alpha):
        Z, F0 = model.fault_function(label, alpha, known.delta, known.jet, known.mach)
        return F0 + size[:, None] * Z

    high = model.reach(a[:, 0], spread)[1]
    bound = model.fault_growth(label, high, np.abs(size), known) * spread[:, :1]
    assert (np.abs(fault(x[:, 0]) - fault(a[:, 0])) <= bound + 1e-12).all()


def test_the_nominal_fin_is_the_one_that_flies(quiet):
    """Without a fault the angle and the rate that all estimators go by are those of the flight."""
    record = simulate(quiet, [missile.study().replace(faults=[])])
    _, u, known = quiet.split(record.obs)
    now = model.unknown(1)
    for k in range(1, 500):
        now = model.known(Interval(np.full(1, k), u[:, k], None, known[:, k]), now)
        assert_allclose(model.state(np.zeros((1, 2)), now)[0, 2:], record.state[0, k, 2:], rtol=1e-9, atol=1e-9)


def test_uncertainty_stays_inside_its_bound_and_follows_its_regressors(plant):
    rng = np.random.default_rng(7)
    for _ in range(50):
        rho, x = rng.uniform(-0.05, 0.05, 6), [*rng.uniform(-0.3, 0.3, 3), 0.0, 0.1]
        mach = rng.uniform(1.5, 3)
        error = (rate(plant, x, rho=rho, mach=mach)[0] - rate(plant, x, mach=mach)[0])[:2]
        a = np.array([x[0]])
        assert (np.abs(error) <= model.uncertainty_bound(a, np.array([mach]))[0] + 1e-12).all()
        assert_allclose(error, model.uncertainty_regressors(a, np.array([mach]))[0] @ rho, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("seed", "label", "onset", "size", "gamma", "mach", "rho", "levels", "noise"), [
    (0, 5, 724, 0.3286814667553, 0.1565610900748, (2.719905358800, 2.263527570162),
     (0.01066357757672, 0.02294965609840, 0.004362499146542, 0.04350724237878, 0.03158535541215, -0.04972614998299),
     (0, -4.806914627103, 11.93303845894), (-0.001762116149076, 0.003801667705396, -0.07397939171418)),
    (1, 2, 1541, 0.1864957676318, 1.750909784235, (1.967747178016, 1.756083953529),
     (0.03277025938204, -0.009080086363084, 0.004959368767306, -0.04724408867569, 0.02535131086748, 0.003814331321928),
     (0, 11.07977264793, -5.354611102911), (-0.0008971103562176, -0.01597874572713, -0.1292559998405)),
])  # fmt: skip
def test_sampler(plant, seed, label, onset, size, gamma, mach, rho, levels, noise):
    scenario, (w, v) = missile.episode(seed)
    assert plant.label_rows(scenario)[-1] == label
    (found,) = scenario.faults
    assert found.onset == onset
    assert_allclose([found.effects[0].value, found.effects[0].rate], [size, gamma], rtol=1e-12)
    assert_allclose(scenario.disturbance["mach"], mach, rtol=1e-12)
    assert_allclose(scenario.physical["rho"], rho, rtol=1e-10)
    assert_allclose(missile.reference_rows(scenario)[[500, 1000, 1500], 0] / DEG, levels, rtol=1e-12, atol=1e-12)
    assert_allclose(v[0], noise, rtol=1e-12)
    assert not w.any()


def test_label_counts_of_the_numbered_episodes(plant):
    labels = [missile.sample_standard(np.random.default_rng(seed)).faults for seed in range(10000, 10600)]
    index = [missile.MODES.index(faults[0].mode) + 1 if faults else 0 for faults in labels]
    assert np.bincount(index).tolist() == [89, 100, 100, 111, 109, 91]


@pytest.mark.parametrize("name", ["standard", "hard", "fault-free", "study", "mirror", "paper"])
def test_scenarios_survive_json(plant, name):
    for seed in range(20):
        scenario = draw(plant.process(name), seed)
        assert FaultScenario.from_json(scenario.to_json()) == scenario


def test_hard_process_keeps_its_ranges(plant):
    for seed in range(200):
        scenario = draw(plant.process("hard"), seed)
        assert len(scenario.faults) in (0, 2)
        assert np.abs(scenario.physical["rho"]).max() <= 0.08
        assert np.abs(scenario.physical["rho"][6:]).max() <= 0.05
        if scenario.faults:
            first, second = scenario.faults
            assert 300 <= first.onset <= 500
            assert 250 <= second.onset - first.end <= 400
            assert all(250 <= f.end - f.onset <= 450 for f in scenario.faults)


def test_noise_is_bounded(plant):
    _, v = missile.bounded_noise(np.random.default_rng(0), 200000)
    assert (np.abs(v) <= 4 * np.array(missile.SIGMA) * (1 + 1e-12)).all()
    assert_allclose(v.std(axis=0), missile.SIGMA, rtol=0.01)


def test_fault_scale_keeps_parameters_in_their_sets():
    large = missile.plant(fault_scale=2.0)
    for seed in range(300):
        for fault in draw(large.process("standard"), seed).faults:
            mode = next(mode for mode in large.modes if mode.name == fault.mode)
            assert mode.reach[0] <= fault.effects[0].value <= mode.reach[1]
    with pytest.raises(ValueError, match="fault_scale"):
        missile.plant(fault_scale=3.0)


def test_halving_the_step_changes_little(quiet):
    """The data sheet's integration accuracy: 2e-8 in alpha and 8e-8 in q."""
    import dataclasses

    scenario = missile.study()
    fine = dataclasses.replace(quiet, substeps=8)
    difference = np.abs(simulate(quiet, [scenario]).state - simulate(fine, [scenario]).state)[0]
    # the flight computer's own actuator model keeps its four steps: only the plant is refined
    assert difference[:, 0].max() < 5e-8
    assert difference[:, 1].max() < 5e-7


def test_environment():
    env = gym.make("MissilePitch-Faults-v0")
    plant = env.unwrapped.plant
    assert env.observation_space.shape == (9,)
    first, info = env.reset(seed=3)
    again, _ = gym.make("MissilePitch-Faults-v0").reset(seed=3)
    assert (first == again).all()
    assert env.observation_space.contains(first)
    rewards, over = 0.0, False
    while not over:
        _, reward, terminated, truncated, info = env.step(0)
        rewards, over = rewards + reward, terminated or truncated
    assert truncated
    label = info["label"]
    onset = env.unwrapped.scenario.faults[0].onset
    assert label > 0
    assert rewards == pytest.approx(-0.5 * (2000 - onset - 1))  # sample 2000 can no longer be answered
    assert (plant.isolation_reward[0, 1:] == -1).all()
    assert plant.isolation_reward[2].tolist() == [-0.5, -1, 0, -1, -1, -1]


def test_policy_does_not_touch_the_plant():
    def fly(seed, policy):
        env = gym.make("MissilePitch-Faults-v0", task="identification")
        obs, _ = env.reset(seed=seed)
        return np.array([obs, *(env.step(policy(k))[0] for k in range(300))])

    a = fly(11, lambda k: np.zeros(5))
    b = fly(11, lambda k: np.array([1.0, -1.0, 0.5, 1.0, k / 300]))
    assert (a == b).all()


def test_generic_model_knows_mach_as_a_disturbance():
    plant = load_plant("MissilePitch")
    x = np.array([[0.1, 0.1, -0.1, 0.0, 0.2]])
    at = plant.derivative(4.0, x, np.zeros((1, 2)), d=np.array([[0.3, -0.02]]))
    assert_allclose(at[0, :2], model.xi(x[:, 0], x[:, 1], x[:, 2], x[:, 4], np.array([2.72]))[0], rtol=1e-12)


def test_no_noise_is_what_noise_scale_zero_flies(quiet):
    scenario = missile.study()
    assert (simulate(quiet, [scenario]).obs == simulate(quiet, [scenario], [no_noise(quiet, 2000)]).obs).all()
