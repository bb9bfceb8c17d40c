"""The Boeing 747 against its data sheet's check values."""

import numpy as np
import pytest
from conftest import build

from fdi_gym.engine import no_noise, simulate
from fdi_gym.estimation.linear import linear_model
from fdi_gym.faults import draw
from fdi_gym.plants import b747_lateral as b747


def numbers(text):
    return np.array([[float(v) for v in line.split()] for line in text.strip().splitlines()])


AD = {
    "printed": numbers("""
      +0.983315940357  +0.007606116494  -0.091545496392  +0.005609272298
      -0.230647383844  +0.940327112677  +0.042462323149  +0.000153253257
      +0.142839545606  -0.026604766401  +0.880462960383  -0.025267527080
      -0.011300489368  +0.096929287636  +0.007470395409  +0.999950859762"""),
    "bare": numbers("""
      +0.987613056854  +0.005942288670  -0.098338169564  +0.003863933246
      -0.225597851268  +0.940700821904  +0.032577996544  -0.000444154920
      +0.082126371621  -0.002511270697  +0.978305787848  +0.000160122805
      -0.011192610485  +0.097009632221  +0.007224157359  +0.999985407976"""),
}
BD = {
    "printed": numbers("""
      -0.000005925307  +0.003597729047
      -0.019109068262  -0.000331989287
      -0.001030461409  -0.051682910526
      -0.000968078911  -0.000148426768"""),
    "bare": numbers("""
      -0.000011642331  +0.003735357539
      -0.018909035703  +0.007866919706
      -0.000892309184  -0.053961457766
      -0.000957456842  +0.000256745959"""),
}


@pytest.mark.parametrize(("airframe", "variant"), [("printed", "printed/open"), ("bare", "bare/closed")])
def test_discretisation(airframe, variant):
    model = linear_model(build("B747Lateral", variant=variant))
    assert model.A == pytest.approx(AD[airframe], abs=6e-13)
    assert model.B == pytest.approx(BD[airframe], abs=6e-13)


def test_eigenvalues():
    printed = np.linalg.eigvals(b747.A_PRINTED)
    bare = np.linalg.eigvals(b747.bare_airframe()[0])
    assert sorted(printed, key=lambda v: (v.real, v.imag)) == pytest.approx(
        [-0.6507483809 - 0.410225603j, -0.6507483809 + 0.410225603j, -0.2897266191 - 1.0765248109j,
         -0.2897266191 + 1.0765248109j], abs=1e-9)  # fmt: skip
    assert sorted(bare, key=lambda v: (v.real, v.imag)) == pytest.approx(
        [-0.6615487562, -0.0921151826 - 0.9988363206j, -0.0921151826 + 0.9988363206j, -0.0116600704], abs=1e-9
    )


def test_bare_airframe_from_derivatives():
    A, B = b747.bare_airframe()
    assert A == pytest.approx(numbers("""
        -0.0763394222  0.0581671493 -0.9983068580  0.0388493138
        -2.3467937915 -0.6037843506  0.2208245747  0
         0.8297815930 -0.0286493252 -0.1773154189  0
         0             1             0.0582658016  0"""), abs=6e-11)  # fmt: skip
    assert B == pytest.approx(
        numbers("0 0.0101785896\n-0.1947645006 0.0904789418\n-0.0092736400 -0.5454742434\n0 0"), abs=6e-11
    )


def test_steady_state_per_degree_held():
    held = -np.linalg.solve(b747.A_PRINTED, b747.B_PRINTED)
    assert held[:, 0] == pytest.approx([-0.0857251, 0.00075042, -0.0128849, -0.4652269], abs=6e-8)
    assert held[:, 1] == pytest.approx([-0.0163328, 0.00400207, -0.0687169, -1.8168831], abs=6e-8)


GAIN = {
    "printed/closed": [[0.2570439298, -0.1448124795, -0.1702645523, -0.1481286281],
                       [0.4403627258, -0.1993556134, -0.4200035495, -0.1646559547]],
    "bare/closed": [[1.3604039062, -0.7960421308, -1.4837608909, -0.77319987],
                    [0.7333704887, -0.3854748904, -1.5831796152, -0.3177179623]],
}  # fmt: skip


@pytest.mark.parametrize("variant", list(GAIN))
def test_controller_gain(variant):
    assert build("B747Lateral", variant=variant).q[:8].reshape(2, 4) == pytest.approx(np.array(GAIN[variant]), abs=1e-9)


@pytest.mark.parametrize(
    ("effectiveness", "poles"),
    [
        ((1, 1), [-0.676 + 0.317j, -0.676 - 0.317j, -0.269 + 1.059j, -0.269 - 1.059j]),
        ((0, 1), [-0.601 + 0.229j, -0.601 - 0.229j, -0.256 + 1.051j, -0.256 - 1.051j]),
        ((1, 0), [-0.526, -0.305, -0.0971 + 0.9993j, -0.0971 - 0.9993j]),
    ],
)
def test_bare_closed_loop_poles(effectiveness, poles):
    plant = build("B747Lateral", variant="bare/closed")
    model, K = linear_model(plant), plant.q[:8].reshape(2, 4)
    found = np.log(np.linalg.eigvals(model.A - model.B @ np.diag(effectiveness) @ K).astype(complex)) / b747.DT
    assert sorted(found, key=lambda v: (round(v.real, 3), v.imag)) == pytest.approx(
        sorted(poles, key=lambda v: (np.real(v), np.imag(v))), abs=6e-4
    )


def test_multisine():
    e = b747.excitation({"command": "multisine", "scale": 1.0, "phases": b747.PAPER_PHASES}, 100)
    assert e[0] == pytest.approx([0.364286187, 0.1895062132], abs=6e-10)
    assert e[1] == pytest.approx([0.3289043172, 0.1827839868], abs=6e-10)
    assert e[37] == pytest.approx([0.602480161, 0.2735818489], abs=6e-10)


def test_doublet_and_prbs():
    e = b747.excitation({"command": "doublet"}, 400)
    assert e[0, 0] == 3.0
    assert e[20, 0] == -3.0
    assert e[40, 0] == 0.0
    assert e[200, 0] == 3.0
    assert (e[:100, 1] == 0).all()
    assert e[100, 1] == 1.2
    assert e[120, 1] == -1.2
    with pytest.raises(ValueError, match="multisine, doublet, prbs"):
        build("B747Lateral").validate(b747.paper().replace(reference={"command": "chirp"}))


def test_bank_reference_starts_with_one_step_of_its_lag(b747):
    scenario = draw(build("B747Lateral", variant="printed/closed").process("standard"), 0)
    rows = build("B747Lateral", variant="printed/closed").reference(scenario)
    level = scenario.reference["bank_levels"][0]
    assert rows[0, 2] == pytest.approx((1 - np.exp(-0.05)) * level)
    assert rows[149, 2] == pytest.approx((1 - np.exp(-0.05 * 150)) * level)


def test_stuck_rudder_settles_where_theory_says():
    """Open loop, no command, rudder stuck at 1 deg: the state goes to -A^-1 B e_r."""
    plant = build("B747Lateral")
    scenario = b747.paper("zero").replace(faults=[b747.stuck("rudder", 1.0, 0)], steps=2000)
    record = simulate(plant, [scenario], [no_noise(plant, 2000)])
    assert record.state[0, -1] == pytest.approx([-0.0163328, 0.00400207, -0.0687169, -1.8168831], abs=6e-8)


def test_paper_scenario_labels_the_interval_that_ended():
    plant = build("B747Lateral")
    record = simulate(plant, [b747.paper()])
    label = record.label[0]
    assert (label[:2001] == 0).all()  # the fault acts on step 2000, whose interval ends at sample 2001
    assert (label[2001:6001] == 4).all()
    assert (label[6001:] == 0).all()
    assert record.theta[0, 3000] == pytest.approx([0, -1, 0, 2])


def test_jam_holds_the_command_of_the_onset():
    plant = build("B747Lateral")
    scenario = b747.paper().replace(faults=[b747.stuck("aileron", None, 700)])
    record = simulate(plant, [scenario])
    u = record.obs[0, :, 4:]
    assert record.theta[0, 701:, 2] == pytest.approx(np.full(8000 - 700, u[701, 0]))
    assert record.theta[0, 701, 0] == -1


def test_rudder_hard_over_ends_the_bare_flight():
    plant = build("B747Lateral", variant="bare/closed")
    scenarios = [draw(plant.process("hard-over"), s) for s in range(20)]
    record = simulate(plant, scenarios)
    rudder = np.array([s.faults[0].mode == "rudder stuck" for s in scenarios])
    assert record.terminated[rudder].all()
    assert not record.terminated[~rudder].any()
    last = record.state[np.arange(20), record.length]
    assert (np.abs(last[rudder, 3]) > 60).all()


@pytest.mark.parametrize("variant", b747.VARIANTS)
def test_standard_flights_have_the_declared_statistics(variant):
    plant = build("B747Lateral", variant=variant)
    n = 1000
    scenarios = [draw(plant.process("standard"), s) for s in range(n)]
    kinds = [s.faults[0].kind if s.faults else "none" for s in scenarios]
    share = {kind: kinds.count(kind) / n for kind in ("none", "LOE", "jam", "position")}
    for kind, p in {"none": 0.2, "LOE": 0.4, "jam": 0.16, "position": 0.24}.items():
        assert share[kind] == pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / n)), kind
    onsets = np.array([s.faults[0].onset for s in scenarios if s.faults])
    assert onsets.min() >= 200
    assert onsets.max() <= 800
    assert onsets.mean() == pytest.approx(500, abs=4 * 173.5 / np.sqrt(len(onsets)))
    size = [e.value for s in scenarios for f in s.faults if f.kind == "position" for e in f.effects if e.entry == "b_rudder"]
    assert np.max(np.abs(size)) <= b747.B_STUCK_MAX[variant.split("/")[0]][1]


def test_signal_levels():
    """rms over random flights, as the data sheet gives them (400 flights there, its own draws)."""
    record = simulate(build("B747Lateral"), [draw(build("B747Lateral").process("standard"), s) for s in range(200)])
    rms = np.sqrt((record.obs[:, 1:, 4:] ** 2).mean(axis=(0, 1)))
    assert rms == pytest.approx([1.19, 0.52], rel=0.05)
    assert np.sqrt((record.state[:, 1:] ** 2).mean(axis=(0, 1))) == pytest.approx([0.23, 0.52, 0.18, 1.12], rel=0.12)


def test_hard_process_windows():
    scenarios = [draw(build("B747Lateral").process("hard"), s) for s in range(300)]
    share = np.mean([not s.faults for s in scenarios])
    assert share == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / 300))
    for s in scenarios:
        assert s.physical["factor_A"] != s.physical["factor_B"]
        assert all(0.95 <= v <= 1.05 for row in s.physical["factor_A"] for v in row)
        if s.faults:
            assert 200 <= s.faults[0].onset <= 300
            assert len(s.faults) >= 2
        for before, after in zip(s.faults, s.faults[1:], strict=False):
            assert 150 <= before.end - before.onset <= 300
            assert 100 <= after.onset - before.end <= 250


def test_dual_labels_are_mixed_radix():
    plant = build("B747Lateral", labels="dual")
    for index, label in enumerate(plant.labels):
        modes = divmod(index, 3)
        for surface, mode in zip(("aileron", "rudder"), modes, strict=True):
            said = {f"{surface} LOE": 1, f"{surface} stuck": 2}
            assert next((said[m] for m in label.modes if m in said), 0) == mode
    assert {len(draw(plant.process("dual"), s).faults) for s in range(40)} == {0, 1, 2}


def test_unknown_variant_lists_what_exists():
    with pytest.raises(ValueError, match="printed/open, printed/closed, bare/closed"):
        build("B747Lateral", variant="stretched")


def test_a_held_gust_is_a_shift_of_the_air():
    """In the steady state of a held gust beta follows it: the aircraft weathercocks, and all air loads vanish."""
    x = np.zeros((1, 4))
    for _ in range(1000):
        x = build("B747Lateral").propagate(0.0, x, np.zeros((1, 2)), None, np.array([[1.0]]))
    assert x[0] == pytest.approx([1, 0, 0, 0], abs=1e-9)


def test_gust_shape():
    scenario = b747.paper().replace(disturbance={"t0": 10.0, "rise": 2.0, "size": 1.5, "hold": 5.0})
    d = b747.gust_rows(scenario)[:, 0]
    assert (d[:101] == 0).all()
    assert d[110] == pytest.approx(0.75)
    assert d[120:171] == pytest.approx(np.full(51, 1.5))
    assert d[180] == pytest.approx(0.75)
    assert d[190:] == pytest.approx(np.zeros(len(d) - 190))
