"""The CMG satellite: check values of its data sheet, identities, samplers, and the environment."""

import itertools

import gymnasium as gym
import numpy as np
import pytest

import fdi_gym
from fdi_gym.discovery import load_plant
from fdi_gym.engine import no_noise, simulate
from fdi_gym.faults import Fault, FaultScenario, Samples, draw
from fdi_gym.plants import cmg_satellite as cmg

DELTA = np.array([0.3, -0.2, 0.5, 0.1])
Q = np.array([0.1, -0.2, 0.3, np.sqrt(0.86)])
W = np.array([0.05, -0.02, 0.03])
R = np.array([[0.2, -0.1, 0.15, 0.05]])
F = np.array([[0.5, 1.0, 0.9, 0.7]])
X = np.concatenate([Q, W, DELTA])
Y = np.concatenate([Q[:3], W, DELTA, [1.0]])


def close(value, expected, rtol=1e-9):
    np.testing.assert_allclose(value, expected, rtol=rtol, atol=1e-12)


@pytest.fixture(scope="module")
def plant():
    return load_plant("CMGSatellite")


def flight(plant, steps, faults=(), **changes):
    scenario = FaultScenario(plant=cmg.ID, steps=steps, faults=list(faults)).replace(**changes)
    return simulate(plant, [scenario], noise=[no_noise(plant, steps)])


# -- check values


def test_initial_attitude_of_the_source():
    close(cmg.quaternion(cmg.START_ANGLES), [-7.0710678119e-01, 0, 1.2278780397e-01, 6.9636424032e-01])


def test_cluster():
    A, E = cmg.cluster(DELTA)
    close(A, [[-5.5164015579e-01, -1.9866933080e-01, 5.0674268875e-01, -9.9833416647e-02],
              [-2.9552020666e-01, -5.6592005627e-01, 4.7942553860e-01, 5.7454547062e-01],
              [7.7997496496e-01, 8.0016559968e-01, 7.1649354521e-01, 8.1236124422e-01]])  # fmt: skip
    close(cmg.singularity(DELTA), 7.7874503676e-01)
    close(cmg.singularity(np.zeros(4)), 1.1857, rtol=5e-5)
    close(cmg.H0 * E.sum(axis=1), [2.4226016617e-03, 5.0023686666e-03, 1.1040062802e-02])
    close(cmg.inertia(A), [[1.4993894688e-02, -4.6103832084e-06, 3.0725680839e-06],
                           [-4.6103832084e-06, 1.6990324510e-02, -1.2691565316e-06],
                           [3.0725680839e-06, -1.2691565316e-06, 1.9975780803e-02]])  # fmt: skip


def test_jacobian_is_the_derivative_of_the_momentum():
    A, _ = cmg.cluster(DELTA)
    for i in range(4):
        step = 1e-6 * np.eye(4)[i]
        change = (cmg.cluster(DELTA + step)[1] - cmg.cluster(DELTA - step)[1]).sum(axis=1) / 2e-6
        np.testing.assert_allclose(A[:, i], change, atol=1e-9)


def test_rates_of_change(plant):
    rate = plant.derivative(0.0, X, R)
    close(rate[:4], [2.3184046239e-02, -3.2736184955e-03, 1.7910427743e-02, -9.0e-03])
    close(rate[4:7], [5.0809622051e-02, -8.6862709083e-02, -2.3920203233e-01])
    close(rate[7:], R[0])
    close(plant.derivative(0.0, X, R, F)[4:7], [-1.4656535861e-02, -1.0304972607e-01, -1.3814030202e-01])
    wheel = load_plant("CMGSatellite", fault_model="wheel")
    close(wheel.derivative(0.0, X, R, F)[4:7], [-3.5872066634e-02, -1.0539103229e-01, -1.1292918814e-01])


def test_one_step(plant):
    close(plant.propagate(0.0, X, R, F), [
        1.0023296158e-01, -2.0003487735e-01, 3.0017555706e-01, 9.2727236355e-01,
        4.9855031526e-02, -2.1029249615e-02, 2.8618519931e-02, 0.302, -0.201, 0.5015, 0.1005,
    ])  # fmt: skip


def test_slew_reference_and_controller(plant):
    q0, w0 = cmg.slew(np.array(0.0))
    close(q0, [1.3095750486e-03, 3.9643552343e-02, -3.2989754822e-02, 9.9866828820e-01])
    close(w0, [4.3598278624e-02, -1.4261127255e-02, -1.7863622946e-02])
    q2, w2 = cmg.slew(np.array(2.0))
    close(q2, [3.6524536911e-02, 1.3630280882e-02, -4.3978099002e-02, 9.9827155647e-01])
    close(w2, [2.4029763798e-02, -3.2200707736e-02, 9.5971022432e-06])
    r = np.concatenate([q2, w2, [0.0]])
    close(cmg.attitude_error(*Q, r), [7.0662229079e-02, -1.9693934281e-01, 3.4893301364e-01, 9.1349192477e-01])
    close(cmg.sliding_mode(Y, r), [-1.2397555270e-02, 1.7691360842e-02, -3.7780266302e-02])
    close(cmg.commanded_hdot(Y, r, cmg.pyramid(*Y[6:10])[1]), [1.2768427586e-02, -1.7212035752e-02, 3.7481695836e-02])
    u = np.empty(4)
    cmg.control(2.0, Y, r, plant.q, np.zeros(0), u)
    close(u, [-2.1514467000e-01, 2.0528051308e00, 1.6419500072e00, -9.5664854869e-01])
    cmg.control(2.0, Y, r, load_plant("CMGSatellite", steering="pinv").q, np.zeros(0), u)
    close(u, [-2.1515862964e-01, 2.0528296831e00, 1.6419727436e00, -9.5667221417e-01])


def test_slew_rate_belongs_to_the_slew_attitude():
    t, h = np.linspace(0, 60, 50), 1e-5
    (q, w), (after, _), (before, _) = cmg.slew(t), cmg.slew(t + h), cmg.slew(t - h)
    qdot, (v, s) = (after - before) / (2 * h), (q[:, :3], q[:, 3:])
    np.testing.assert_allclose(qdot[:, :3], 0.5 * (s * w + np.cross(v, w)), atol=1e-9)


@pytest.mark.parametrize("feedback", ["measured", "true"])
def test_closed_loops(feedback):
    slew = flight(load_plant("CMGSatellite", feedback=feedback), 2000).state[0]
    close(slew[100], [
        2.1742156663e-02, 2.9541209804e-02, -4.1350832711e-02, 9.9847118345e-01, 3.9130559573e-02, -2.4399946589e-02,
        -1.0844590579e-02, -4.8998681721e-03, -9.4352845857e-03, 5.8095242920e-04, 5.0483201804e-03,
    ])  # fmt: skip
    close(slew[2000], [
        -9.7398869951e-03, -1.7442998112e-02, -3.3466804393e-02, 9.9924013601e-01, -4.3460213640e-02,
        -3.2268323433e-02, -1.9308357802e-02, -5.4626472368e-02, -1.5005911145e-02, 5.4477180344e-02, 1.2216175017e-02,
    ])  # fmt: skip
    regulate = flight(load_plant("CMGSatellite", reference="regulate", feedback=feedback), 100).state[0]
    close(regulate[100], [
        -4.9623026953e-01, 6.7290279255e-04, 8.8060167105e-02, 8.6371318953e-01, 5.3082009488e-01, -3.7463010103e-03,
        -9.5387773934e-02, 3.7592164451e-01, 1.7043682758e-02, -3.2562870533e-01, 5.2445450622e-02,
    ])  # fmt: skip


def test_plant_off_the_model(plant):
    physical = {"inertia_error": [0.01, -0.01, 0.005], "mounting_error_deg": [0.5, -0.5, 0.25, 0.0]}
    record = flight(plant, 500, [cmg.loss(1, 0.2, 0, 500)], physical=physical)
    close(record.state[0, 500], [
        3.0420297711e-02, -3.3208568773e-02, -2.8875862048e-02, 9.9856796516e-01, -3.0437097998e-02, -2.3461169744e-02,
        2.2860092348e-02, -6.0316795087e-02, -2.3606986302e-02, 3.1247295961e-02, -6.7484659343e-03,
    ])  # fmt: skip


@pytest.mark.parametrize(("reference", "printed"), [
    ("regulate", {45: (1.846e-4, 1.791e-4, 1.437e-4), 75: (5.839e-6, 5.663e-6, 4.544e-6)}),
    ("slew", {45: (1.792e-4, 1.442e-4, 1.643e-4), 55: (5.668e-5, 4.561e-5, 5.195e-5)}),
])  # fmt: skip
def test_sensor_noise(reference, printed):
    for snr, sigma in printed.items():
        outputs = load_plant("CMGSatellite", reference=reference, snr=snr).outputs
        np.testing.assert_allclose([outputs[i].sigma for i in (0, 3, 6)], sigma, rtol=5e-4)
        assert outputs[10].sigma == 0.0


@pytest.mark.parametrize("reference", ["regulate", "slew"])
def test_signal_levels_of_the_reference_flights(reference):
    """The noise levels' constants are the root mean squares of the fault-free flights of 200 s."""
    y = flight(load_plant("CMGSatellite", reference=reference), 20000).obs[0]
    rms = [np.sqrt((y[:, group] ** 2).mean()) for group in (slice(0, 3), slice(3, 6), slice(6, 10))]
    np.testing.assert_allclose(rms, cmg.RMS[reference], rtol=2e-5)


# -- laws


def total_momentum(x):
    """Inertial angular momentum C(q)' (Js w + h) of states (K, 11), nominal cluster."""
    v, s = x[:, :3], x[:, 3:4]
    H = cmg.JS * x[:, 4:7] + cmg.H0 * cmg.cluster(x[:, 7:])[1].sum(axis=-1)
    return (s**2 - (v**2).sum(1, keepdims=True)) * H + 2 * v * (v * H).sum(1, keepdims=True) + 2 * s * np.cross(v, H)


def test_quaternion_keeps_its_length_over_200_s():
    plant = load_plant("CMGSatellite", reference="regulate")
    record = simulate(plant, [cmg.table4("regulate")])
    assert record.length[0] == 20000
    np.testing.assert_allclose(np.linalg.norm(record.state[0, :, :4], axis=1), 1.0, atol=1e-15)


def test_momentum_bookkeeping():
    """Healthy, momentum only wanders by the neglected J' w; while f != 1 it grows by the torque that goes missing."""
    plant = load_plant("CMGSatellite", reference="regulate", steering="pinv")
    x = flight(plant, 4000).state[0]
    assert np.linalg.norm(total_momentum(x), axis=1).max() == pytest.approx(4.8e-6, abs=0.05e-6)
    record = flight(plant, 200, [cmg.loss(0, 0.5, 0, 200)])
    x, r = record.state[0], record.obs[0, 1:, 11:15]
    H = total_momentum(x)
    assert np.linalg.norm(H[-1]) > 1e-3
    # the missing torque h0 A (1 - f) r, turned to inertial axes, by the trapezoidal rule over each step
    f = np.array([0.5, 1.0, 1.0, 1.0])

    def torque(x, r):
        body = cmg.H0 * ((cmg.cluster(x[:, 7:])[0] * (1 - f)) @ r[..., None])[..., 0]
        v, s = x[:, :3], x[:, 3:4]
        inner = (v * body).sum(1, keepdims=True)
        return (s**2 - (v**2).sum(1, keepdims=True)) * body + 2 * v * inner + 2 * s * np.cross(v, body)

    gained = np.cumsum(cmg.DT * (torque(x[:-1], r) + torque(x[1:], r)) / 2, axis=0)
    np.testing.assert_allclose(H[1:] - H[0], gained, atol=5e-6)


def test_steering_delivers_what_is_asked_for():
    """Pseudo-inverse: h0 A r is the commanded momentum rate exactly, and r is orthogonal to the null space."""
    plant = load_plant("CMGSatellite", steering="pinv")
    rng, u = np.random.default_rng(0), np.empty(4)
    for _ in range(20):
        y = np.concatenate([0.05 * rng.standard_normal(6), 0.3 * rng.standard_normal(4), [1.0]])
        r = np.array([0.0, 0, 0, 1, 0, 0, 0, 0])
        cmg.control(0.0, y, r, plant.q, np.zeros(0), u)
        A, _ = cmg.cluster(y[6:10])
        close(cmg.H0 * A @ u, cmg.commanded_hdot(y, r, cmg.pyramid(*y[6:10])[1]))
        assert abs(np.linalg.svd(A)[2][3] @ u) < 1e-12


def test_null_motion_delivers_no_torque():
    y = np.concatenate([np.zeros(6), DELTA, [1.0]])
    r = np.array([0.0, 0, 0, 1, 0, 0, 0, 0])
    plain, moved = np.empty(4), np.empty(4)
    cmg.control(1.0, y, r, load_plant("CMGSatellite").q, np.zeros(0), plain)
    cmg.control(1.0, y, r, load_plant("CMGSatellite", excitation="null").q, np.zeros(0), moved)
    assert np.linalg.norm(moved - plain) > 0.01
    np.testing.assert_allclose(cmg.cluster(DELTA)[0] @ (moved - plain), 0.0, atol=1e-15)


def test_integration_order():
    """Halving the step divides the Runge-Kutta error by 16."""
    plant = load_plant("CMGSatellite")
    x = np.concatenate([Q, [2.0, -3.0, 2.5], DELTA])
    r = np.array([[8.0, -6.0, 5.0, 7.0]])

    def end(substeps, h=0.08):
        from fdi_gym import integration

        out = np.empty((1, 11))
        integration.propagate(*plant.addresses[:2], h, substeps, np.zeros(1), x[None], r, F,
                              np.zeros((1, 0)), plant.nominal_p[None], out)  # fmt: skip
        return out[0]

    exact = end(256)
    ratio = np.linalg.norm(end(4) - exact) / np.linalg.norm(end(8) - exact)
    assert 13 < ratio < 19


@pytest.mark.parametrize("fault_model", ["torque", "wheel"])
def test_zero_severity_is_healthy(fault_model):
    plant = load_plant("CMGSatellite", fault_model=fault_model)
    healthy, zero = flight(plant, 300), flight(plant, 300, [cmg.loss(2, 0.0, 50, 200)])
    np.testing.assert_array_equal(healthy.state, zero.state)


def test_faulted_steering_would_hide_the_fault():
    """(A F)(A F)^+ = I: had the steering known f, the fault could not be seen. That it can be is tested above."""
    A, _ = cmg.cluster(DELTA)
    AF = A * F
    np.testing.assert_allclose(AF @ np.linalg.pinv(AF), np.eye(3), atol=1e-14)


def test_true_feedback_ignores_the_sensor_noise():
    """The state then depends on the process noise alone."""
    steps = 200
    scenario = FaultScenario(plant=cmg.ID, steps=steps)
    rng = np.random.default_rng(0)
    v = 1e-3 * rng.standard_normal((steps + 1, 11))
    states = {}
    for feedback in ("true", "measured"):
        plant = load_plant("CMGSatellite", feedback=feedback)
        w, _ = no_noise(plant, steps)
        states[feedback] = simulate(plant, [scenario], noise=[(w, v)]).state
    quiet = flight(load_plant("CMGSatellite"), steps).state
    np.testing.assert_array_equal(states["true"], quiet)
    assert np.abs(states["measured"] - quiet).max() > 1e-5


# -- sensors, faults, processes


def test_sign_of_q4_is_observed_without_noise():
    plant = load_plant("CMGSatellite", reference="regulate")
    x0 = np.array([0.999, 0.0, 0.04, 0.02, 1.0, 0, 0, 0, 0, 0, 0])
    x0[:4] /= np.linalg.norm(x0[:4])
    scenario = FaultScenario(plant=cmg.ID, steps=100, x0=x0.tolist(), noise_seed=3)
    record = simulate(plant, [scenario])
    np.testing.assert_array_equal(record.obs[0, :, 10], np.where(record.state[0, :, 3] >= 0, 1.0, -1.0))
    assert record.state[0, :, 3].min() < 0 < record.state[0, :, 3].max()


def test_labels_are_the_sixteen_sets(plant):
    sets = [(), (1,), (2,), (3,), (4,), (1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4),
            (1, 2, 3), (1, 2, 4), (1, 3, 4), (2, 3, 4), (1, 2, 3, 4)]  # fmt: skip
    assert [label.modes for label in plant.labels] == [frozenset(f"CMG {i}" for i in s) for s in sets]


def test_table_4(plant):
    (scenario,) = (plant.process("paper").sample(np.random.default_rng(0)),)
    record = simulate(plant, [scenario])
    assert record.length[0] == 20000
    for t, f in [(0.01, [1, 1, 1, 1]), (20, [1, 1, 1, 1]), (20.01, [0.5, 1, 1, 1]), (40, [0.5, 1, 1, 1]),
                 (40.01, [1, 0.1, 1, 1]), (70.01, [1, 1, 0.1, 1]), (150, [1, 1, 1, 0.1]), (150.01, [1, 1, 1, 1]),
                 (200, [1, 1, 1, 1])]:  # fmt: skip
        k = round(t * 100)
        np.testing.assert_allclose(record.theta[0, k], f, err_msg=str(t))
        assert record.label[0, k] == next((i + 1 for i in range(4) if f[i] < 1), 0)


def windows(scenario):
    return {(fault.onset, fault.end) for fault in scenario.faults}


def test_standard_process(plant):
    drawn = [draw(plant.process("standard"), seed) for seed in range(400)]
    labels = [plant.label_of(frozenset(f.mode for f in s.faults)) for s in drawn]
    counts = np.bincount(labels, minlength=16)
    assert counts.min() > 8
    assert counts.max() < 50  # uniform over 16 labels: 25 each
    for scenario in drawn:
        assert scenario.steps == 10000
        assert len(windows(scenario)) == (len(scenario.faults) > 0)
        for a, b in windows(scenario):
            assert 2000 <= a <= 5000
            assert b - a + 1 >= 2000
            assert b - a <= 4501
        assert all(0.1 <= fault.effects[0].value <= 0.9 for fault in scenario.faults)
    assert FaultScenario.from_json(drawn[0].to_json()) == drawn[0]


def test_table5_processes():
    slew, regulate = load_plant("CMGSatellite"), load_plant("CMGSatellite", reference="regulate")
    for plant, name in ((slew, "paper-slew"), (slew, "table5"), (regulate, "table5")):
        for seed in range(50):
            scenario = draw(plant.process(name), seed)
            assert scenario.steps == 20000
            assert all(0 <= a <= b <= 19900 for a, b in windows(scenario))
            assert (scenario.x0 is None) == (plant is slew)
            if scenario.x0 is not None:
                np.testing.assert_allclose(np.linalg.norm(scenario.x0[:4]), 1.0)
                assert scenario.x0[3] >= 0
                assert np.abs(scenario.x0[4:7]).max() <= 0.5
            assert FaultScenario.from_json(scenario.to_json()) == scenario


def test_hard_process(plant):
    changes, labels = [], set()
    for seed in range(60):
        scenario = draw(plant.process("hard"), seed)
        assert np.abs(scenario.physical["inertia_error"]).max() <= 0.01
        assert np.abs(scenario.physical["mounting_error_deg"]).max() <= 0.5
        for i in range(4):
            own = [f for f in scenario.faults if f.mode == f"CMG {i + 1}"]
            assert 500 <= own[0].onset <= 3000
            assert all(b.onset - a.end >= 999 for a, b in itertools.pairwise(own))
            assert all(0.6 <= f.effects[0].value <= 0.98 for f in own)
        rows = plant.label_rows(scenario)
        labels |= set(rows.tolist())
        changes.append((np.diff(rows) != 0).sum())
    assert labels == set(range(16))
    assert 19.5 < np.mean(changes) < 22  # 20.8 measured


def test_mismatch_levels(plant):
    for level, degrees in ((0.0, 0.0), (0.01, 0.5), (0.03, 1.0)):
        rng = np.random.default_rng(0)
        drawn = [plant.perturb(rng, level) for _ in range(400)]
        assert np.abs([d["inertia_error"] for d in drawn]).max() == pytest.approx(level, rel=0.02)
        assert np.abs([d["mounting_error_deg"] for d in drawn]).max() == pytest.approx(degrees, rel=0.02)


def test_losing_attitude_control_ends_the_flight():
    """Three dead units: two axes of torque are gone, and the slew can no longer be followed."""
    plant = load_plant("CMGSatellite")
    scenario = FaultScenario(plant=cmg.ID, steps=20000, faults=[cmg.loss(i, 1.0, 0, 20000) for i in range(4)])
    record = simulate(plant, [scenario])
    assert record.terminated[0]
    k = record.length[0]
    error = cmg.attitude_error(*record.state[0, k, :4], np.concatenate([cmg.slew(k * cmg.DT)[0], np.zeros(4)]))[3]
    assert 2 * np.degrees(np.arccos(abs(error))) > 60
    before = cmg.attitude_error(*record.state[0, k - 1, :4], np.concatenate([cmg.slew((k - 1) * cmg.DT)[0], np.zeros(4)]))[3]
    assert 2 * np.degrees(np.arccos(abs(before))) <= 60


def test_a_wrong_option_is_named():
    with pytest.raises(ValueError, match="robust, pinv"):
        load_plant("CMGSatellite", steering="magic")
    with pytest.raises(ValueError, match="dB"):
        load_plant("CMGSatellite", snr="loud")
    with pytest.raises(ValueError, match="profile \\(slew\\)"):
        simulate(load_plant("CMGSatellite"), [cmg.table4("regulate")])


# -- the environment


@pytest.mark.parametrize("task", ["isolation", "identification"])
def test_environment(task):
    env = gym.make("CMGSatellite-Faults-v0", task=task, snr=55)
    assert fdi_gym.plant_sources()["CMGSatellite"].version == cmg.VERSION
    obs, info = env.reset(seed=4)
    assert obs.shape == (22,)
    assert env.observation_space.contains(obs)
    wrong = 1 if task == "isolation" else np.array([0.0, 1.0, 1.0, 1.0])
    assert info["label"] == 0
    rewards = [env.step(wrong)[1] for _ in range(3)]
    assert rewards == ([0.0, -1.0, -1.0] if task == "isolation" else [0.0, -0.25, -0.25])


def test_info_reports_the_distance_to_a_singularity(plant):
    """info["det"] is det(A A') of the recorded state, in both environments, and diagnosers don't see it."""
    env = gym.make("CMGSatellite-Faults-v0", process="hard")
    _, info = env.reset(seed=4)
    infos = [info, *(env.step(0)[4] for _ in range(300))]
    state = simulate(plant, [env.unwrapped.scenario]).state[0, :301]
    A, _ = cmg.cluster(state[:, 7:])
    assert [i["det"] for i in infos] == cmg.singularity(state[:, 7:]).tolist()
    close([i["det"] for i in infos], np.linalg.det(A @ np.swapaxes(A, 1, 2)))
    many = gym.make_vec("fdi_gym:CMGSatellite-Faults-v0", num_envs=2, process="hard")
    many.reset(seed=[4, 5])
    for k in range(1, 30):
        assert many.step(np.zeros(2, int))[4]["det"][0] == infos[k]["det"]
    assert load_plant("B747Lateral").monitor(state) == {}


def test_observation_order(plant):
    """[y_k, r_{k-1}, reference at k], and the reference is the slew's."""
    scenario = cmg.bench(np.random.default_rng(1), 3).replace(steps=50, noise_seed=7, faults=[])
    record = simulate(plant, [scenario])
    q_d, w_d = cmg.slew(np.arange(51) * cmg.DT)
    np.testing.assert_array_equal(record.obs[0, :, 15:], np.hstack([q_d, w_d]))
    np.testing.assert_array_equal(record.obs[0, 0, 11:15], 0.0)
    d, r = record.state[0, :, 7:], record.obs[0, :, 11:15]
    np.testing.assert_allclose(d[1:] - d[:-1], cmg.DT * r[1:], atol=1e-15)


def test_samples_profile_moves_f(plant):
    fault = Fault("CMG 2", "LOE", 10, [Samples("f2", [0.9, 0.8, 0.7])], 13)
    record = flight(plant, 20, [fault])
    np.testing.assert_allclose(record.theta[0, 10:15, 1], [1.0, 0.9, 0.8, 0.7, 1.0])
