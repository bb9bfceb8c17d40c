"""The hovering helicopter against the check values of its data sheet."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import fdi_gym  # noqa: F401 (registers the environments)
from benchmarks.reproduction.numbered import fly
from fdi_gym.discovery import load_plant
from fdi_gym.engine import no_noise, simulate
from fdi_gym.faults import FaultScenario
from fdi_gym.plants import huav_hover as huav

KAPPAS = (0.0, 0.3, 1.0)
X = np.array([0.5, -0.4, 0.3, 0.10, -0.20, 0.15, 0.12, -0.08, 0.50, 0.010, -0.020])
U = np.array([0.100, 0.005, -0.004, 0.010])


@pytest.fixture(scope="module")
def plant():
    return load_plant(huav.ID)


def test_rotor_constants():
    main = (huav.CT_M, huav.DT_M, huav.CQ_M, huav.DQ_M)
    tail = (huav.CT_T, huav.DT_T, huav.CQ_T, huav.DQ_T)
    assert main == pytest.approx((1690.99984135, 9.115006259216, 0.002784991332013, 4.288990506697), rel=1e-11)
    assert tail == pytest.approx((78.78030698682, 3.238633895503, 0.003562839686877, 0.03686918366983), rel=1e-11)


def test_thrust_solves_its_equation_and_vanishes_below_zero():
    for angle in (0.01, 0.1, 0.2):
        T = huav.thrust(huav.CT_M, huav.DT_M, angle)
        assert T + huav.DT_M * np.sqrt(T) == pytest.approx(huav.CT_M * angle, rel=1e-12)
    assert huav.thrust(huav.CT_M, huav.DT_M, -0.01) == pytest.approx(0.0, abs=1e-12)


def test_trim():
    x, u = huav.trim()
    assert x[[6, 7, 9, 10]] == pytest.approx(
        [0.07842732761387, -0.00139044042583, 0.001115782802921, 0.006071823678415], abs=1e-12
    )
    assert u == pytest.approx([0.09569538224056, 0.000332078215155, 0.001807090380481, -0.0102018651698], abs=1e-12)
    rates = load_plant(huav.ID).derivative(0.0, x[None], u[None])
    assert np.abs(rates).max() < 1e-12


@pytest.mark.parametrize("kappa", KAPPAS)
def test_gust_matrix(kappa):
    along, side, roll, yaw = huav.gust_matrix(huav.U_TRIM, kappa)
    assert along == pytest.approx(0.03111037702042, rel=1e-11)
    assert side == pytest.approx(0.06844282944491 + kappa * (0.1565915078273 - 0.06844282944491), rel=1e-11)
    assert (roll, yaw) == pytest.approx((kappa * 0.3212529612159, kappa * -2.349162278892), rel=1e-11)


def test_derivative_and_step(plant):
    rate = (0.6366941127744, -0.03612487841115, -0.6627557197863, -13.11659820643, 2.748459595204, 2.58502893987,
            0.08998030721606, -0.2165185582641, 0.125379855522, 0.25678, -0.045224)  # fmt: skip
    step = (0.5126582571252, -0.4006397212576, 0.2867133992307, -0.1589121148222, -0.1352968988829, 0.2017005787974,
            0.1191348761005, -0.08377951502165, 0.5030970499904, 0.01414498852578, -0.01836282656102)  # fmt: skip
    assert plant.derivative(0.0, X[None], U[None])[0] == pytest.approx(rate, rel=1e-11)
    assert plant.propagate(0.0, X[None], U[None])[0] == pytest.approx(step, rel=1e-11)


def test_derivative_and_step_with_fault_and_gust(plant):
    rate = (0.7292588300382, -0.08224796340819, -1.078142654234, -11.39916412657, 2.064453735897, 1.553632448493,
            0.08998030721606, -0.2165185582641, 0.125379855522, 0.144556, 0.095056)  # fmt: skip
    step = (0.5147178115819, -0.4012730033924, 0.2784016701015, -0.1145642177707, -0.1533177166832, 0.1810726489699,
            0.1195667118457, -0.08392069608278, 0.5028710738682, 0.01223589513211, -0.01617076976667)  # fmt: skip
    theta = np.array([[1, 1, 1, 1, 0.003, -0.004, 0.005, -0.010]])
    d = np.array([[2, -1.5]])
    assert plant.derivative(0.0, X[None], U[None], theta, d)[0] == pytest.approx(rate, rel=1e-11)
    assert plant.propagate(0.0, X[None], U[None], theta, d)[0] == pytest.approx(step, rel=1e-11)


def test_halving_the_step_divides_the_error_by_sixteen(plant):
    exact = dataclasses.replace(plant, substeps=256).propagate(0.0, X[None], U[None])
    errors = [
        np.abs(dataclasses.replace(plant, substeps=m).propagate(0.0, X[None], U[None]) - exact).max() for m in (4, 8, 16)
    ]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.1)


def test_jacobians():
    Ad, Bd = huav.linearised(huav.X_TRIM, huav.U_TRIM)
    moduli = np.sort_complex(np.linalg.eigvals(Ad))
    expected = [0.84963473 - 0.35273927j, 0.84963473 + 0.35273927j, 0.88393476 - 0.25473393j, 0.88393476 + 0.25473393j]
    assert moduli[:4] == pytest.approx(expected, abs=1e-8)
    assert np.abs(moduli[4:] - 1).max() < 5e-2  # a sevenfold defective eigenvalue, known to eps^(1/7) at best
    assert np.trace(Ad) == pytest.approx(7 + sum(expected).real, abs=1e-7)
    assert Bd[2] == pytest.approx([-2.733340275385, 3.8197541e-06, -4.0654746580e-04, 2.2167354e-05], rel=1e-6, abs=1e-10)
    assert Bd[3] == pytest.approx([0.2163488279513, 0, 8.742238225507, -0.4221394047206], rel=1e-9, abs=1e-9)
    assert Bd[4] == pytest.approx([0.02131076616647, 4.679667671881, 0, -0.03973828613812], rel=1e-9, abs=1e-9)
    assert Bd[5] == pytest.approx([-2.994577369745, 0, 0, 3.168819452379], rel=1e-9, abs=1e-9)


def test_continuous_eigenvalues_follow_the_closed_form(plant):
    A = np.column_stack([
        (plant.derivative(0.0, (huav.X_TRIM + s)[None], huav.U_TRIM[None])
         - plant.derivative(0.0, (huav.X_TRIM - s)[None], huav.U_TRIM[None]))[0] / 2e-5
        for s in 1e-5 * np.eye(11)
    ])  # fmt: skip
    found = np.sort(np.linalg.eigvals(A)[np.abs(np.linalg.eigvals(A)) > 1].imag)
    hub = 80.19465609365 * huav.H_MR + huav.K_BETA
    roll, pitch = (np.sqrt(hub * huav.K_F / J - 1 / (4 * huav.TAU_F**2)) for J in (huav.JXX, huav.JYY))
    assert found == pytest.approx([-roll, -pitch, pitch, roll], abs=1e-7)
    assert (roll, pitch) == pytest.approx((19.6791248227, 14.0293108801), rel=1e-10)


def test_lqi_gain():
    K = huav.lqi_gain(*huav.linearised(huav.X_TRIM, huav.U_TRIM))
    expected = [
        [-0.0009716548821, -0.0008762075499, -0.03233782874, 9.662555485e-05, 7.614196881e-05, -0.003987487924,
         0.001724380206, 0.004006806073, -0.01899292417, 0.002119096588, 0.001130702289, -0.0004138693212,
         -0.0003696347708, -0.01437979714, -0.008476572319],
        [-0.02053046233, -3.141195456e-05, 0.0001016606133, -1.572895104e-06, 0.004586483084, -0.0003239354412,
         -6.004327497e-05, 0.113775698, 0.00592306408, 0.1110248861, -6.232424703e-05, -0.008249549579,
         -1.553729149e-05, 4.856331999e-05, 0.002452400221],
        [2.041796916e-05, 0.02044920659, -0.001045954678, 0.002701140074, -2.532223995e-06, 0.00114022856,
         0.1106660328, -0.000185450271, 0.001565687217, -6.641629172e-05, 0.1166418133, 6.635472148e-06,
         0.008272438355, -0.0004259634375, 0.0005418112259],
        [0.006312022589, -0.001908256338, -0.02395997417, -0.0001038625233, -0.0005695962124, 0.04308813163,
         0.00115978964, -0.02912891277, 0.1447488553, -0.0150705108, 0.0005072819636, 0.002635995212,
         -0.0009273728035, -0.01028727977, 0.0621570579],
    ]  # fmt: skip
    assert np.abs(K - expected).max() < 1e-9


def test_noise_free_closed_loop(plant):
    record = simulate(plant, [huav.paper(1)], [no_noise(plant, huav.STEPS)])
    x, u = record.state[0], plant.split(record.obs[0])[1]
    x250 = (0.04412418928913, -0.007730299445756, -0.0157142982297, 0.09019506541891, 0.0002302334378597,
            0.004372926015406, 0.212298094168, 0.01385204524536, -0.001921518949769, 0.001098349166062,
            -0.001289076893525)  # fmt: skip
    x450 = (-0.278819061347, 0.1222132654271, 0.01532286012688, 0.02877106656211, -0.0583293669245, 0.01678015154354,
            0.02318605329815, 0.0266786784152, -0.01117274907102, 0.002847590014743, 0.005468607838739)  # fmt: skip
    assert x[250] == pytest.approx(x250, rel=1e-8)
    assert x[450] == pytest.approx(x450, rel=1e-8)
    # u_c,k is shown at sample k + 1
    assert u[251] == pytest.approx((0.09494304573718, 0.000340296825687, -0.006897752494846, -0.0107317178522), rel=1e-8)
    assert u[451] == pytest.approx((0.09584091871712, -0.00625742284599, 0.002614035592682, 0.002867125444054), rel=1e-8)


def test_healthy_hover_without_gust_stays_at_trim(plant):
    still = FaultScenario(plant=huav.ID, steps=500)
    record = simulate(plant, [still], [no_noise(plant, 500)])
    # psi is integrated with its trim offset of zero; the integrals of u, v, w, psi stay zero
    assert np.abs(record.state[0] - huav.X_TRIM).max() < 1e-12
    assert record.label.max() == 0
    assert np.abs(record.target).max() == 0


def test_first_episodes():
    def facts(seed):
        scenario = huav.episode(seed)
        assert scenario.noise_seed == seed + 1_000_000
        assert FaultScenario.from_json(scenario.to_json()) == scenario
        gusts = huav.disturbance_rows(scenario)[500]
        return [(f.mode, f.kind, f.onset, f.end) for f in scenario.faults], gusts, scenario.faults

    what, gusts, faults = facts(0)
    assert what == [("lon", "loe", 176, 323), ("lat", "float_square", 428, 1000)]
    assert faults[0].effects[0].value == pytest.approx(0.200154120179, rel=1e-11)
    assert abs(faults[1].effects[1].value - huav.U_TRIM[2]) == pytest.approx(0.00480851140039, rel=1e-11)
    assert gusts == pytest.approx([-1.28993935054, 0], rel=1e-11)

    what, gusts, faults = facts(1)
    assert what == [("lon", "bias", 512, 1000)]
    assert faults[0].effects[0].value == pytest.approx(0.00528432746564, rel=1e-11)
    assert gusts == pytest.approx([0, -3.75876383641], rel=1e-11)

    what, gusts, faults = facts(2)
    assert what == [("col", "loe", 169, 1000), ("lat", "bias", 168, 453)]
    assert faults[0].effects[0].value == pytest.approx(0.942239551288, rel=1e-11)
    assert faults[1].effects[0].value == pytest.approx(-0.000470728937612, rel=1e-11)
    assert gusts == pytest.approx([0, 0])

    what, gusts, faults = facts(3)
    assert what == [("lon", "stuck_at", 392, 673)]
    assert faults[0].effects[1].value == pytest.approx(0.00181890809931, rel=1e-11)
    assert gusts == pytest.approx([3.38380736897, -1.86643135194], rel=1e-11)


def test_drift_is_drawn_in_the_prescribed_order():
    """The first drifting fault of the numbering, drawn again by hand."""
    seed, fault = next(
        (s, huav.episode(s).faults[0]) for s in range(300)
        if len(huav.episode(s).faults) == 1 and huav.episode(s).faults[0].kind == "float_free"
    )  # fmt: skip
    g = np.random.default_rng([seed, 1])
    g.choice(3, p=[0.15, 0.65, 0.20])
    c = g.permutation(4)[0]
    g.choice(4, p=[0.4, 0.2, 0.2, 0.2])
    k0, dur = round(g.uniform(3, 12) / 0.02), g.uniform(2, 6)
    k1 = 1000 if g.random() < 0.3 else min(1000, k0 + round(dur / 0.02))
    g.random()
    sigma = g.uniform(*np.array([(2, 10), (1, 5), (1, 5), (3, 10)])[c] * 1e-3)
    s = [sigma * g.standard_normal()]
    e, a = g.standard_normal(k1 - k0), np.exp(-0.04)
    for i in range(k1 - k0 - 1):
        s.append(a * s[-1] + sigma * np.sqrt(1 - a * a) * e[i])
    assert (fault.onset, fault.end) == (k0, k1)
    assert np.array(fault.effects[1].values) == pytest.approx(huav.U_TRIM[c] + np.array(s), abs=1e-15)


def test_noise_of_the_numbered_flights_is_process_then_sensor():
    w, v = huav.prescribed_noise(np.random.default_rng(7), 5)
    g = np.random.default_rng(7)
    assert np.array_equal(w, g.standard_normal((5, 11)) * huav.SIGMA_W)
    assert np.array_equal(v, g.standard_normal((6, 9)) * huav.SIGMA_V)


@pytest.mark.parametrize("channel", huav.CHANNELS)
@pytest.mark.parametrize("kind", ["bias", "stuck_at", "stuck_hold", "float_square", "float_free", "loe"])
def test_fault_moves_the_actuator_as_its_kind_says(plant, channel, kind):
    c, centre = huav.CHANNELS.index(channel), huav.U_TRIM[huav.CHANNELS.index(channel)]
    fault = {
        "bias": huav.bias(channel, 1e-3, 20, 60),
        "stuck_at": huav.stuck(channel, centre + 1e-3, 20, 60),
        "stuck_hold": huav.stuck(channel, None, 20, 60),
        "float_square": huav.floating_square(channel, centre + 1e-3, centre - 1e-3, 0.2, 20, 60),
        "float_free": huav.floating(channel, (centre + 1e-3 * np.sin(np.arange(40))).tolist(), 20, 60),
        "loe": huav.loss(channel, 0.5, 20, 60),
    }[kind]
    record = simulate(plant, [FaultScenario(plant=huav.ID, steps=100, faults=[fault], noise_seed=3)])
    u = plant.split(record.obs[0])[1]
    true = u + record.target[0]  # row k + 1 belongs to step k
    k = np.arange(20, 60)
    expected = {
        "bias": u[k + 1, c] + 1e-3,
        "stuck_at": np.full(40, centre + 1e-3),
        "stuck_hold": np.full(40, u[20, c]),
        "float_square": centre + np.where((k - 20) // 5 % 2 == 0, 1e-3, -1e-3),
        "float_free": centre + 1e-3 * np.sin(k - 20),
        "loe": 0.5 * u[k + 1, c],
    }[kind]
    assert true[k + 1, c] == pytest.approx(expected, abs=1e-15)
    healthy = np.ones((101, 4), bool)
    healthy[k + 1, c] = False
    assert np.abs(record.target[0][healthy]).max() == 0
    assert (record.label[0][k + 1] == 1 + c).all()
    assert record.label[0].sum() == 40 * (1 + c)


def test_paper_scenarios(plant):
    labels = [label.name for label in plant.labels]
    for number, name, rows in (
        (1, "paper", {201: "lat", 401: "lon", 501: "ped", 701: "none"}),
        (2, "scenario-2", {201: "lat", 401: "none", 701: "lon", 901: "none"}),
        (3, "scenario-3", {400: "none", 401: "lat+ped", 700: "lat+ped", 701: "none"}),
        (4, "scenario-4", {201: "lat", 401: "lon", 501: "ped", 701: "none"}),
    ):
        scenario = plant.process(name).sample(np.random.default_rng(0))
        assert scenario == huav.paper(number)
        row = plant.label_rows(scenario)
        assert {k: labels[row[k]] for k in rows} == rows
    d = huav.disturbance_rows(huav.paper(1))
    assert d[[100, 150, 200, 1000], 0] == pytest.approx([0, 2, 4, 4])
    assert d[[250, 300, 350, 1000], 1] == pytest.approx([0, 1.5, 3, 3])


def test_complete_gust_dies_down():
    scenario = FaultScenario(plant=huav.ID, steps=500, disturbance={"v_g": huav.gust(1.0, 2.0, -3.0, 1.0)})
    v = huav.disturbance_rows(scenario)[:, 1]
    assert v[[50, 100, 150, 200, 250, 300, 400]] == pytest.approx([0, -1.5, -3, -3, -1.5, 0, 0])


def test_isolation_reward_charges_each_wrongly_accused_channel(plant):
    index = {label.name: i for i, label in enumerate(plant.labels)}
    reward = plant.isolation_reward
    assert reward[index["lon"], index["lon"]] == 1
    assert reward[index["lon"], index["none"]] == 0
    assert reward[index["lon"], index["lon+ped"]] == -0.5
    assert reward[index["none"], index["lon+ped"]] == -1
    assert reward[index["lon+ped"], index["lon"]] == 0


def test_identification_reward_is_capped(plant):
    error = np.array([0.005, 0.002, -0.004, 1.0])
    assert plant.identification_reward(error) == pytest.approx(-(1 + 1 + 2 + 5) / 4)


def test_hard_process_flies_the_full_coupling():
    easy, full = load_plant(huav.ID), load_plant(huav.ID, kappa=1.0)
    scenario = easy.process("hard").sample(np.random.default_rng(0))
    assert scenario.physical == {"kappa": 1.0}
    assert np.array_equal(simulate(easy, [scenario]).obs, simulate(full, [scenario.replace(physical={})]).obs)


def test_mismatch_changes_the_truth_and_not_the_model(plant):
    changes = plant.perturb(np.random.default_rng(0), 0.05)
    assert {
        name: abs(value / nominal - 1) < 0.05
        for (name, value), nominal in zip(changes.items(), (huav.MASS, huav.JXX, huav.JYY, huav.JZZ), strict=True)
    } == dict.fromkeys(changes, True)
    scenario = FaultScenario(plant=huav.ID, steps=200, physical=changes)
    flown = simulate(plant, [scenario], [no_noise(plant, 200)])
    assert 1e-3 < np.abs(flown.state[0, -1] - huav.X_TRIM).max() < 1  # another mass is held by another collective
    assert not flown.terminated[0]


def test_loss_of_control_terminates(plant):
    fault = huav.stuck("lat", 0.1, 50)
    record = simulate(plant, [FaultScenario(plant=huav.ID, steps=1000, faults=[fault])])
    assert record.terminated[0]
    end = record.length[0]
    assert np.abs(record.state[0, end, 6:8]).max() > np.pi / 3 or np.abs(record.state[0, end, 3:6]).max() > 8
    assert np.abs(record.state[0, :end, 6:8]).max() <= np.pi / 3


def test_wrong_options_say_what_is_allowed(plant):
    with pytest.raises(ValueError, match="kappa is a number from 0 to 1"):
        load_plant(huav.ID, kappa=2.0)
    with pytest.raises(ValueError, match="u_g, v_g"):
        simulate(plant, [FaultScenario(plant=huav.ID, steps=5, disturbance={"w_g": huav.gust(0, 1, 1)})])
    with pytest.raises(ValueError, match="kappa"):
        simulate(plant, [FaultScenario(plant=huav.ID, steps=5, physical={"mass": 1.0})])


@pytest.mark.parametrize("task", ["isolation", "identification"])
def test_environment(task):
    env = gym.make("HUAVHover-Faults-v0", task=task, kappa=0.0)
    check_env(env.unwrapped, skip_render_check=True)
    obs, info = env.reset(seed=3)
    assert obs.shape == (13,)
    assert np.array_equal(obs[9:], huav.U_TRIM)
    assert info["label"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(("kappa", "share"), [(0.0, 0.08), (0.3, 0.08), (1.0, 0.14)])
def test_share_of_lost_flights(kappa, share):
    flown = fly(load_plant(huav.ID, kappa=kappa), [huav.episode(s) for s in range(100)], huav.prescribed_noise)
    assert flown.terminated.mean() == pytest.approx(share)
    healthy = fly(load_plant(huav.ID, kappa=kappa), [huav.fault_free_episode(s) for s in range(100)], huav.prescribed_noise)
    assert not healthy.terminated.any()


@pytest.mark.slow
@pytest.mark.parametrize(("number", "kappa", "angles", "speeds", "rates"), [
    (1, 0.0, (12.7, 3.5), (0.35, 0.36, 0.09), (1.14, 0.27, 0.21)),
    (2, 0.0, (16.7, 6.0), (0.43, 1.64, 0.08), (1.90, 0.50, 0.06)),
    (3, 0.0, (19.7, 1.7), (0.11, 7.10, 0.11), (2.86, 0.12, 0.19)),
    (1, 1.0, (12.7, 3.2), (0.38, 0.37, 0.15), (1.13, 0.27, 0.22)),
    (2, 1.0, (17.3, 8.9), (0.71, 1.70, 0.17), (1.94, 0.76, 0.23)),
    (3, 1.0, (20.0, 1.7), (0.11, 7.02, 0.16), (2.87, 0.12, 0.22)),
])  # fmt: skip
def test_closed_loop_over_24_seeds(number, kappa, angles, speeds, rates):
    plant = load_plant(huav.ID, kappa=kappa)
    record = fly(plant, [huav.paper(number).replace(noise_seed=s) for s in range(100, 124)], huav.prescribed_noise)
    assert not record.terminated.any()
    most = np.abs(record.state).max(axis=(0, 1))
    assert np.degrees(most[6:8]) == pytest.approx(angles, abs=0.051)
    assert most[:3] == pytest.approx(speeds, abs=0.0051)
    assert most[3:6] == pytest.approx(rates, abs=0.0051)
