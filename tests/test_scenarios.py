"""Whatever is handed in as a scenario, a declaration or a plant's name is refused in words, or is right."""

import copy
import dataclasses
import json
import math
import pickle
import subprocess
import sys

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from conftest import PLANTS, ROOT, build

import fdi_gym
from fdi_gym.discovery import PlantSource, load_plant, plant_sources
from fdi_gym.engine import no_noise, simulate
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import (
    MAX_STEPS,
    Abrupt,
    Fault,
    FaultProcess,
    FaultScenario,
    Hold,
    Incipient,
    Intermittent,
    Samples,
    Scoring,
    Square,
    draw,
)
from fdi_gym.plant import Kernels, Label
from fdi_gym.shapes import OPEN
from fdi_gym.testing import check_plant
from fdi_gym.testing.plants import _check_range

NAN, INF = math.nan, math.inf
VARIANTS = (
    ("B747Lateral", {"variant": "bare/closed", "labels": "dual"}), ("MissilePitch", {"fault_scale": 2.0}),
    ("HUAVHover", {"kappa": 1.0}), ("CMGSatellite", {"reference": "regulate", "steering": "pinv", "fault_model": "wheel"}),
    ("CMGSatellite", {"excitation": "null", "feedback": "true"}),
)  # fmt: skip
EVERY = (*((plant_id, {}) for plant_id in (*PLANTS, "DCMotor")), *VARIANTS)


def flight(plant, seed=0, steps=30, process="standard"):
    """A short healthy flight of a plant."""
    return draw(plant.process(process), seed).without_faults().replace(steps=steps)


def refused(plant, match, /, **changes):
    """The flight with these changes is refused in words, where it is made or before it flies."""
    with pytest.raises(ValueError, match=match):
        simulate(plant, [flight(plant).replace(**changes)])


# -- scenarios


def test_drawn_scenarios_fit_their_plant_and_survive_json(plant):
    for process in plant.processes.values():
        for seed in range(5):
            scenario = draw(process, seed, plant.perturb and (lambda rng: plant.perturb(rng, 0.02)))
            plant.validate(scenario)
            assert FaultScenario.from_json(scenario.to_json()) == scenario


@pytest.mark.parametrize(("field", "values"), [
    ("steps", [0, -1, 1.5, True, "9", None, MAX_STEPS + 1, 10**30]),
    ("noise_seed", [-1, 2**63, True, 0.5, None]),
    ("x0", [[], [1.0], [0.0] * 99, "none", [None], {}, 3.0]),
    ("plant", ["Concorde", 3, None]),
    ("faults", ["none", [1], {}, None, [[]]]),
    ("reference", [[], None, {"fautls": 1}, {1: 2}, {"x": NAN}]),
    ("disturbance", [[], None, {"fautls": 1}, {"x": {"y": [[INF]]}}]),
    ("physical", [[], None, {"fautls": 1}, {"x": object()}, {"x": {1, 2}}]),
])  # fmt: skip
def test_a_wrong_field_is_refused_by_name(plant, field, values):
    for value in values:
        refused(plant, "belongs" if value == "Concorde" else field, **{field: value})


@pytest.mark.parametrize("value", [NAN, INF, -INF, 1e299, True, "1", None])
def test_an_initial_state_is_finite_and_near_its_range(plant, value):
    for j in range(len(plant.states)):
        if value == 1e299 and math.isinf(plant.states[j].high):
            continue
        x0 = plant.trim_state.tolist()
        x0[j] = value
        refused(plant, "x0", x0=x0)


def test_a_wrong_effect_is_refused_by_name(plant):
    entry, command, mode = plant.theta[0], plant.commands[0].name, plant.modes[0].name
    name, inside, beyond = entry.name, entry.nominal, entry.high + 1.0
    wrong = {
        "theta entry": [Abrupt("slope", 0.0)],
        "command": [Hold(name, "middle")],
        "value": [Abrupt(name, v) for v in (NAN, INF, True, "1", None)],
        "within": [Abrupt(name, beyond), Incipient(name, beyond, 1.0), Square(name, inside, beyond, 1.0),
                   Intermittent(name, beyond, 1.0), Samples(name, [inside, beyond])],
        "rate": [Incipient(name, inside, v) for v in (0.0, -1.0, NAN, INF)],
        "period": [*(Square(name, inside, inside, v) for v in (0.0, -1.0, NAN, INF)), Intermittent(name, inside, 0.0)],
        "duty": [Intermittent(name, inside, 1.0, v) for v in (0.0, -0.5, 1.01, NAN)],
        "lag": [Hold(name, command, v) for v in (-1000000000, -1000, -1, 7, 10**9, 2**70, 0.5, True)],
        "values": [Samples(name, v) for v in ([], [NAN], [[1.0]], 3.0, "ab")],
    }  # fmt: skip
    for match, effects in wrong.items():
        for effect in effects:
            refused(plant, match, faults=[Fault(mode, "", 5, [effect])])


def test_a_wrong_fault_is_refused_by_name(plant):
    entry, mode = plant.theta[0], plant.modes[0].name
    effect = Abrupt(entry.name, entry.nominal)
    wrong = {
        "no fault mode": [Fault("gremlins", "", 5, [effect])],
        "kind": [Fault(mode, 3, 5, [effect])],
        "onset": [Fault(mode, "", v, [effect]) for v in (-1, 0.5, True, None, 2**70)],
        "end": [Fault(mode, "", 5, [effect], v) for v in (4, -1, 0.5, True, 2**70)],
        "effects": [Fault(mode, "", 5, v) for v in ([], None, [3], "no")],
        "both own": [Fault(mode, "", 5, [effect, effect])],
    }
    for match, faults in wrong.items():
        for fault in faults:
            refused(plant, match, faults=[fault])
    refused(plant, "faults.1. both own", faults=[Fault(mode, "", 5, [effect]), Fault(mode, "", 7, [effect], 9)])


def test_modes_without_a_common_label_are_refused(plant):
    labels = {label.modes for label in plant.labels}
    pairs = [(a, b) for a in plant.modes for b in plant.modes if frozenset({a.name, b.name}) not in labels]
    if not pairs:
        pytest.skip("every two modes have a label")
    (a, b), (one, two) = pairs[0], plant.theta[:2]
    faults = [Fault(a.name, "", 5, [Abrupt(one.name, one.nominal)]), Fault(b.name, "", 8, [Abrupt(two.name, two.nominal)])]
    refused(plant, "no label for", faults=faults)


@pytest.mark.parametrize(("plant_id", "field", "value"), [
    ("B747Lateral", "reference", {"command": "chirp"}),
    ("B747Lateral", "reference", {"command": "multisine", "scale": 1.0}),
    ("B747Lateral", "reference", {"command": "multisine", "scale": 1.0, "phases": [[0.0, 1.0], [0.0, 1.0]]}),
    ("B747Lateral", "reference", {"command": "zero", "signs": [[1], [1]]}),
    ("B747Lateral", "reference", {"command": "prbs", "signs": [[1], [1]]}),  # too short for the flight
    ("B747Lateral", "reference", {"bank_levels": []}),
    ("B747Lateral", "disturbance", {"t0": 1.0, "rise": 1.0, "size": 1.0}),
    ("B747Lateral", "disturbance", {"t0": 1.0, "rise": 0.0, "size": 1.0, "hold": 1.0}),
    ("B747Lateral", "physical", {"factor_A": [[1.0] * 4] * 2}),
    ("B747Lateral", "physical", {"factor_B": [[1.0] * 4] * 4}),
    ("MissilePitch", "reference", {"command": "sine", "amplitude": 1.0}),
    ("MissilePitch", "reference", {"command": "sine", "amplitude": 1.0, "period": 0.0}),
    ("MissilePitch", "reference", {"command": "levels", "levels": [], "holds": []}),
    ("MissilePitch", "reference", {"command": "levels", "levels": [1.0], "holds": [-1]}),
    ("MissilePitch", "reference", {"command": "levels", "levels": [1.0], "holds": [1, 1]}),
    ("MissilePitch", "disturbance", {"mach": [2.0]}),
    ("MissilePitch", "disturbance", {"mach": [2.0, 20.0]}),
    ("MissilePitch", "physical", {"rho": [0.0] * 9}),
    ("HUAVHover", "reference", {"level": 1.0}),
    ("HUAVHover", "disturbance", {"w_g": {}}),
    ("HUAVHover", "disturbance", {"u_g": {"t0": 1.0, "rise": 0.0, "speed": 1.0, "hold": None}}),
    ("HUAVHover", "disturbance", {"u_g": {"t0": 1.0, "rise": 1.0, "speed": 1.0}}),
    ("HUAVHover", "physical", {"m": 0.0}),
    ("HUAVHover", "physical", {"kappa": 1.5}),
    ("CMGSatellite", "reference", {"profile": "regulate"}),
    ("CMGSatellite", "disturbance", {"torque": 1.0}),
    ("CMGSatellite", "physical", {"inertia_error": [0.0, 0.0]}),
    ("CMGSatellite", "physical", {"inertia_error": [-1.0, 0.0, 0.0]}),
    ("CMGSatellite", "physical", {"mounting_error_deg": 1.0}),
    ("DCMotor", "reference", {"levels": []}),
    ("DCMotor", "reference", {}),
    ("DCMotor", "disturbance", {"load": True}),
    ("DCMotor", "physical", {"R_A": 0.0}),
])  # fmt: skip
def test_a_dict_that_is_not_as_the_plant_declares_is_refused_by_name(plant_id, field, value):
    refused(build(plant_id), f"^{field} of a {plant_id} scenario", **{field: value})


def test_rows_that_a_plant_makes_are_checked_before_they_fly(motor):
    """Of a plant that declares nothing of its dicts, and whose functions believe what they get."""
    rows = {
        "raises": lambda s: {}["levels"],
        "too short": lambda s: np.zeros((s.steps, 1)),
        "a vector": lambda s: np.zeros(s.steps + 1),
        "nothing": lambda s: None,
        "not finite": lambda s: np.full((s.steps + 1, 1), NAN),
    }
    for make in rows.values():
        refused(dataclasses.replace(motor, shapes=OPEN, reference=make), "^reference of a DCMotor scenario")
        refused(dataclasses.replace(motor, shapes=OPEN, disturbance=make), "^disturbance of a DCMotor scenario")
    refused(dataclasses.replace(motor, disturbance=lambda s: np.zeros((s.steps + 1, 2))), "shape")
    wrong = dataclasses.replace(motor, shapes=OPEN, physical=lambda p: np.ones(1 + len(p)))
    refused(wrong, "^physical of a DCMotor scenario", physical={"R_A": 1.0})


def test_noise_of_another_shape_is_refused(plant):
    scenario = flight(plant)
    for w, v in (no_noise(plant, 29), no_noise(plant, 31), (np.zeros((30, 1)), np.zeros((31, 1)))):
        with pytest.raises(ValueError, match="noise"):
            simulate(plant, [scenario], [(w, v)])


def test_numbers_of_numpy_are_numbers(plant):
    scenario = draw(plant.process("standard"), 3)
    x0 = plant.trim_state
    like = scenario.replace(
        steps=np.int32(40), noise_seed=np.uint64(5), x0=x0,
        faults=[Fault(f.mode, f.kind, np.int64(f.onset), f.effects, f.end) for f in scenario.faults],
        physical={name: np.array(value) for name, value in scenario.physical.items()},
    )  # fmt: skip
    same = scenario.replace(steps=40, noise_seed=5, x0=x0.tolist())
    assert like == same
    assert FaultScenario.from_json(like.to_json()) == same
    assert np.array_equal(simulate(plant, [like]).obs, simulate(plant, [same]).obs)


def test_what_is_written_into_a_scenario_afterwards_is_checked_too(plant):
    scenario = flight(plant).replace(x0=plant.trim_state)
    scenario.x0.append(1.0)
    with pytest.raises(ValueError, match="x0"):
        simulate(plant, [scenario])
    scenario = flight(plant)
    scenario.physical["gravity"] = NAN
    with pytest.raises(ValueError, match="gravity"):
        scenario.to_json()


def test_a_scenario_does_not_share_what_it_was_made_of():
    levels = [1.0, 2.0]
    scenario = FaultScenario(plant="DCMotor", steps=3, reference={"levels": levels})
    levels.append(NAN)
    assert scenario.reference == {"levels": [1.0, 2.0]}


@pytest.mark.parametrize("text", [
    "", "{", "null", "[]", "3", '"plant"', "nan", b"\xff\xfe", "\ud800",
    '{"plant": 3}', '{"plant": "x", "steps": 5, "fautls": []}', '{"plant": "x", "steps": 5, "x0": [NaN]}',
    '{"plant": "x", "steps": 5, "x0": [1e400]}', '{"plant": "x", "steps": true}', '{"plant": "x", "steps": 1e30}',
    '{"plant": "x", "steps": 5, "faults": [{"mode": "m", "kind": "k", "onset": 1, "effects": [], "fin": 3}]}',
    '{"plant": "x", "steps": 5, "faults": [{"mode": "m", "kind": "k", "onset": 1, '
    '"effects": [{"profile": "abrupt", "entry": "e", "value": 1, "rate": 2}]}]}',
    '{"plant": "x", "steps": 5, "faults": [{"mode": "m", "kind": "k", "onset": 1, "effects": [{"profile": "odd"}]}]}',
    "[" * 200_000, '{"plant": "x", "steps": 5, "reference": {"a": ' + "[" * 100_000 + "]" * 100_000 + "}}",
    '{"plant": "x", "steps": 5, "reference": {"a": ' + "[" * 20 + "]" * 20 + "}}",
    '{"plant": "' + "x" * 2**25 + '", "steps": 5}',
])  # fmt: skip
def test_json_that_is_no_scenario_is_refused(text):
    with pytest.raises(ValueError, match=r"not a FaultScenario|deep"):
        FaultScenario.from_json(text)


def test_a_fault_without_duration_does_nothing(plant):
    """Neither an empty window nor one after the flight, whatever its profile."""
    entry, command, mode = plant.theta[0], plant.commands[0], plant.modes[0].name
    effects = [Abrupt(entry.name, entry.low), Incipient(entry.name, entry.low, 1.0), Samples(entry.name, [entry.low])]
    if entry.low <= command.low <= command.high <= entry.high:
        effects.append(Hold(entry.name, command.name))
    healthy = simulate(plant, [flight(plant)])
    for effect in effects:
        for onset, end in ((5, 5), (30, None), (31, 40), (MAX_STEPS, None)):
            record = simulate(plant, [flight(plant).replace(faults=[Fault(mode, "", onset, [effect], end)])])
            assert np.array_equal(record.theta, healthy.theta)
            assert (record.label == 0).all()


@pytest.mark.parametrize("wrong", ["x", "u", "theta", "d", "p"])
def test_the_model_refuses_arrays_of_other_widths(plant, wrong):
    widths = dict(zip(["x", "u", "theta", "d", "p"], (plant.states, plant.commands, plant.theta, plant.disturbances,
                                                 plant.nominal_p), strict=True))  # fmt: skip
    good = {name: np.zeros((6, len(vector))) for name, vector in widths.items()}
    n = len(widths[wrong])
    for shape in ((6, n + 1), (6, max(n - 1, 0)), (4, n), (12, n), (0, n)):
        if shape != (6, n) and not (wrong == "x" and shape in ((12, n), (0, n))):
            with pytest.raises(ValueError, match=r"columns and rows|t is one"):
                plant.propagate(np.zeros(6), **{**good, wrong: np.zeros(shape)})
    assert plant.propagate(0.0, **{name: a[:0] for name, a in good.items()}).shape == (0, len(plant.states))


# -- declarations


def first(signals, **changes):
    return (signals[0]._replace(**changes), *signals[1:])


WRONG = {
    "an id": lambda p: {"id": "a plant"},
    "version": lambda p: {"version": -1},
    "dt": lambda p: {"dt": 0.0},
    "dt NaN": lambda p: {"dt": NAN},
    "substeps": lambda p: {"substeps": 1.5},
    "kernel": lambda p: {"kernels": Kernels(None, p.kernels.output, p.kernels.control)},
    "kernel not compiled": lambda p: {"kernels": p.kernels._replace(dynamics=len)},
    "scale": lambda p: {"states": first(p.states, scale=0.0)},
    "scale negative": lambda p: {"outputs": first(p.outputs, scale=-1.0)},
    "scale of theta": lambda p: {"theta": first(p.theta, scale=NAN)},
    "low": lambda p: {"outputs": first(p.outputs, low=2.0, high=1.0, nominal=1.5)},
    "low NaN": lambda p: {"theta": first(p.theta, low=NAN)},
    "nominal": lambda p: {"theta": first(p.theta, nominal=p.theta[0].high + 1)},
    "sigma": lambda p: {"outputs": first(p.outputs, sigma=-1.0)},
    "at most": lambda p: {"states": tuple(p.states[0]._replace(name=f"x{i}") for i in range(129))},
    "two states": lambda p: {"states": (*p.states[:-1], p.states[0])},
    "two outputs": lambda p: {"outputs": (*p.outputs[:-1], p.outputs[0])},
    "two modes": lambda p: {"modes": (*p.modes, p.modes[0])},
    "two labels": lambda p: {"labels": (*p.labels, Label(p.labels[1].name, frozenset()))},
    "two labels' sets": lambda p: {"labels": (*p.labels, Label("again", p.labels[1].modes))},
    "labels start": lambda p: {"labels": p.labels[1:], "isolation_reward": None},
    "labels use": lambda p: {"labels": (*p.labels, Label("more", frozenset({"gremlins"})))},
    "bands": lambda p: {"modes": first(p.modes, bands=p.modes[0].bands[::-1])},
    "reach": lambda p: {"modes": first(p.modes, reach=(1.0, -1.0))},
    "offset": lambda p: {"modes": first(p.modes, offset=(0.0,))},
    "direction": lambda p: {"modes": first(p.modes, direction=(*p.modes[0].direction, 0.0))},
    "direction nowhere": lambda p: {"modes": first(p.modes, direction=(0.0,) * len(p.estimated), offset=p.modes[0].offset)},
    "size": lambda p: {"modes": first(p.modes, size=None)},
    "c0": lambda p: {"c0": np.array([NAN])},
    "q": lambda p: {"q": np.zeros((2, 2))},
    "isolation_reward": lambda p: {"isolation_reward": np.eye(len(p.labels) + 1)},
    "standard": lambda p: {"processes": [FaultProcess(name="hard", description="", sample=p.processes["standard"].sample)]},
    "two processes": lambda p: {"processes": [p.processes["standard"]] * 2},
    "process": lambda p: {"processes": {**p.processes, "easy": p.processes["standard"]}},
}


@pytest.mark.parametrize("what", list(WRONG))
def test_a_contradiction_in_a_declaration_is_refused_by_name(plant, what):
    if what == "direction nowhere" and any(plant.modes[0].offset):
        pytest.skip("a mode with an offset may be a point")
    with pytest.raises(ValueError, match=what.split()[0]):
        dataclasses.replace(plant, **WRONG[what](plant))


def test_a_wrong_process_or_scoring_is_refused():
    for wrong in ({"name": ""}, {"name": "{}"}, {"name": 3}, {"sample": 3}, {"initial": 3}, {"scoring": "final"}):
        with pytest.raises((ValueError, TypeError), match="process"):
            FaultProcess(**{"name": "a", "description": "", "sample": flight, **wrong})
    for wrong in ({"start": 0}, {"start": True}, {"start": 1.5}, {"grace": -1}, {"grace": NAN}, {"decision": "best"}):
        with pytest.raises(ValueError, match="start >= 1"):
            Scoring(**wrong)
    with pytest.raises(TypeError, match="draws a FaultScenario, not NoneType"):
        draw(FaultProcess(name="a", description="", sample=lambda rng: None), 0)


def test_the_fault_free_process_is_the_standard_one_without_faults(plant):
    standard, free = plant.process("standard"), plant.process("fault-free")
    assert free.scoring == standard.scoring
    for seed in range(4):
        assert draw(free, seed) == draw(standard, seed).without_faults()


# -- check_plant: each of these has flown, and is found by flying


def modes_with(plant, **changes):
    """The plant's first mode that has a one-sided reach, or the first, changed."""
    one_sided = [i for i, m in enumerate(plant.modes) if m.reach[0] * m.reach[1] >= 0]
    i = one_sided[0] if one_sided else 0
    mode = plant.modes[i]
    found = {name: change(mode) for name, change in changes.items()}
    return {"modes": (*plant.modes[:i], mode._replace(**found), *plant.modes[i + 1 :])}


def swapped(plant):
    """The labels of the first two modes the other way round, in the scenarios: each moves the other's entry."""
    a, b = plant.modes[0].name, plant.modes[1].name
    other = {a: b, b: a}

    def swap(process):
        def sample(rng):
            drawn = process.sample(rng)
            faults = [Fault(other.get(f.mode, f.mode), f.kind, f.onset, f.effects, f.end) for f in drawn.faults]
            return drawn.replace(faults=faults)

        return dataclasses.replace(process, sample=sample)

    return {"processes": [swap(process) for process in plant.processes.values()]}


def half(signals):
    """Ranges that the flights do not keep."""
    return tuple(s._replace(low=s.nominal, high=s.nominal + 1e-9 * s.scale) for s in signals)


FLOWN = {
    "the sign of the reach": ("reach", lambda p: modes_with(p, reach=lambda m: (-m.reach[1], -max(m.reach[0], 1e-3)))),
    "a reach too short": ("reach", lambda p: modes_with(p, reach=lambda m: tuple(np.array(m.reach) * 1e-3))),
    "another direction": ("line", lambda p: modes_with(p, direction=lambda m: tuple(np.roll(m.direction, 1)))),
    "another offset": ("line", lambda p: modes_with(p, offset=lambda m: tuple(np.add(m.offset, np.roll(m.direction, 1))))),
    "another mode's entry": ("line", swapped),
    "theta outside its range": ("theta", lambda p: {"theta": half(p.theta)}),
    "outputs outside their range": ("range", lambda p: {"commands": half(p.commands), "acting": None}),
    "estimates outside their range": ("estimated", lambda p: {"estimated": half(p.estimated)}),
    "negative sizes": ("size", lambda p: {"modes": [m._replace(size=lambda th, m=m: -1 - m.size(th)) for m in p.modes]}),
    "sizes of another shape": ("size", lambda p: {"modes": [m._replace(size=lambda th: th) for m in p.modes]}),
    "linear": ("linear", lambda p: {"linear": True}),
    "bands reversed": ("bands", lambda p: modes_with(p, bands=lambda m: m.bands[::-1])),
    "two states of one name": ("two states", WRONG["two states"]),
    "a scale of 0": ("scale", WRONG["scale"]),
}  # fmt: skip


@pytest.mark.parametrize("what", list(FLOWN))
def test_check_plant_finds_and_names_a_wrong_declaration(plant, what):
    match, change = FLOWN[what]
    if what == "linear" and plant.linear:
        pytest.skip("it is")
    if what == "the sign of the reach" and all(m.reach[0] * m.reach[1] < 0 for m in plant.modes):
        pytest.skip("all its modes reach to both sides")
    with pytest.raises((AssertionError, ValueError), match=match):
        check_plant(dataclasses.replace(plant, **change(plant)), seeds=range(2 if what == "linear" else 12))


def test_check_plant_names_the_sensor_that_is_not_finite(motor):
    from fdi_gym.kernels import kernel

    @kernel
    def output(t, x, u, theta, d, p, y):
        y[0] = x[0]
        y[1] = x[1] / d[0] * 0.0 / 0.0

    with pytest.raises(AssertionError, match="observation speed is not finite"):
        check_plant(dataclasses.replace(motor, kernels=motor.kernels._replace(output=output)))


# -- plants travel


@pytest.mark.parametrize("travel", [
    lambda p: pickle.loads(pickle.dumps(p)), copy.copy, copy.deepcopy, lambda p: cloudpickle.loads(cloudpickle.dumps(p)),
], ids=["pickle", "copy", "deepcopy", "cloudpickle"])  # fmt: skip
def test_a_plant_arrives_equal_and_without_addresses(plant, travel):
    scenario = flight(plant)
    flown = simulate(plant, [scenario])
    there = travel(plant)
    assert there == plant
    assert hash(there) == hash(plant)
    assert "addresses" not in there.__dict__
    assert np.array_equal(simulate(there, [scenario]).obs, flown.obs)


def test_plants_with_other_options_differ():
    assert load_plant("B747Lateral") == load_plant("B747Lateral", variant="printed/open")
    assert load_plant("B747Lateral") != load_plant("B747Lateral", variant="bare/closed")
    assert load_plant("B747Lateral") != dataclasses.replace(load_plant("B747Lateral"), dt=0.2)


@pytest.mark.parametrize("flown", [False, True])
@pytest.mark.parametrize("make", [load_plant, lambda i: dataclasses.replace(load_plant(i), description="by hand")])
def test_a_plant_flies_the_same_in_another_process(motor, make, flown):
    """Also one that has flown here, one made by hand, and one whose registration the other process has not seen."""
    plants = [make("B747Lateral"), make("DCMotor")]
    mine = [float(simulate(p, [flight(p)]).obs.sum()) for p in (plants if flown else [load_plant(q.id) for q in plants])]
    code = f"""
import sys, pickle
sys.path.insert(0, {str(ROOT / "examples")!r})
plants, scenarios = pickle.load(sys.stdin.buffer)
from fdi_gym.engine import simulate
print([float(simulate(p, [s]).obs.sum()) for p, s in zip(plants, scenarios)])
"""
    sent = cloudpickle.dumps((plants, [flight(p) for p in plants]))
    there = subprocess.run([sys.executable, "-c", code], input=sent, capture_output=True, check=True, cwd=ROOT)
    assert json.loads(there.stdout) == mine


def test_a_flown_plant_in_spawned_environments(motor):
    simulate(motor, [flight(motor)])
    envs = gym.vector.AsyncVectorEnv([lambda: FDIEnv(motor)] * 2, context="spawn")
    try:
        obs, _ = envs.reset(seed=3)
    finally:
        envs.close()
    assert np.array_equal(obs[0], FDIEnv(motor).reset(seed=3)[0])


# -- plants by name


@pytest.mark.parametrize(("plant_id", "options", "match"), [
    ("B747Latreal", {}, "did you mean B747Lateral"), ("b747", {}, "did you mean B747Lateral"), (3, {}, "there are"),
    ([], {}, "there are"), ("B747Lateral", {"varient": 1}, "did you mean variant"),
    ("B747Lateral", {"variant": 3}, "printed/open"), ("B747Lateral", {"labels": ["single"]}, "single, dual"),
    ("MissilePitch", {"noise_scale": "1"}, "noise_scale"), ("MissilePitch", {"noise_scale": NAN}, "noise_scale"),
    ("MissilePitch", {"fault_scale": 0}, "fault_scale"), ("MissilePitch", {"fault_scale": True}, "fault_scale"),
    ("HUAVHover", {"kappa": None}, "kappa"), ("HUAVHover", {"K_B": INF}, "K_B"), ("HUAVHover", {"K_B": -1.0}, "K_B"),
    ("CMGSatellite", {"snr": True}, "snr"), ("CMGSatellite", {"snr": -1e9}, "snr"),
    ("CMGSatellite", {"steering": None}, "robust, pinv"), ("DCMotor", {"voltage": 3}, "DCMotor has sensor_faults"),
])  # fmt: skip
def test_a_wrong_name_or_option_says_what_exists(plant_id, options, match):
    with pytest.raises(ValueError, match=match):
        load_plant(plant_id, **options)


@pytest.mark.parametrize(("body", "match"), [
    ("raise RuntimeError('no licence')", "no licence"), ("return None", "returns None"),
    ("from fdi_gym.discovery import load_plant; return load_plant('B747Lateral')", "returns the plant B747Lateral"),
    ("return undefined", "NameError"), ("import nowhere_to_be_found", "nowhere_to_be_found"),
])  # fmt: skip
def test_a_broken_builder_is_named(tmp_path, monkeypatch, body, match):
    (tmp_path / "broken_plant.py").write_text(f"def build():\n    {body}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "broken_plant", raising=False)
    monkeypatch.setattr("fdi_gym.discovery._registered", {"Broken": PlantSource("broken_plant:build", 0)})
    with pytest.raises(ValueError, match=match):
        load_plant("Broken")


@pytest.mark.parametrize("builder", ["nowhere_to_be_found:plant", "dc_motor:nothing", "dc_motor:DT"])
def test_a_builder_that_is_not_there_is_named(monkeypatch, builder):
    monkeypatch.setattr("fdi_gym.discovery._registered", {"Broken": PlantSource(builder, 0)})
    with pytest.raises(ValueError, match=builder):
        load_plant("Broken")


@pytest.mark.parametrize(("arguments", "match"), [
    (("a plant", "m:f"), "word"), (("", "m:f"), "word"), ((3, "m:f"), "word"), (("P", "m"), "module:function"),
    (("P", "m:f:g"), "module:function"), (("P", "../m:f"), "module:function"), (("P", None), "module:function"),
    (("P", "m:f", -1), "version"), (("P", "m:f", True), "version"), (("P", "m:f", "0"), "version"),
    (("B747Lateral", "m:f"), "is a plant of this package"),
])  # fmt: skip
def test_a_wrong_registration_is_refused(arguments, match):
    before = plant_sources(), dict(gym.registry)
    with pytest.raises(ValueError, match=match):
        fdi_gym.register_plant(*arguments)
    assert (plant_sources(), dict(gym.registry)) == before


# -- fuzz

NASTY = (
    None, True, False, 0, -1, 1, 2, 7, 29, 1000, 2**31, 2**63, -(2**63), 10**30, 0.0, -0.0, 0.5, -1.0, 3.14, 1e-9, 1e9,
    1e300, -1e308, "", "x", "zero", "levels", [], [0.0], [1.0, 2.0], [[1.0]], [None], {}, {"x": 1}, {"profile": "hold"},
)  # fmt: skip


def mutated(rng, node):
    """One change somewhere in a tree of JSON: a nasty value, a number scaled, an element lost, repeated or renamed."""
    places = []

    def visit(parent):
        for key in list(parent) if isinstance(parent, dict) else range(len(parent)):
            places.append((parent, key))
            if isinstance(parent[key], (dict, list)) and parent[key]:
                visit(parent[key])

    visit(node)
    parent, key = places[rng.integers(len(places))]
    kind = rng.integers(6)
    value = parent[key]
    if kind == 0 and isinstance(value, (int, float)) and not isinstance(value, bool):
        parent[key] = value * [-1, 0.5, 2, 10, 1e3, 1e-3][rng.integers(6)]
    elif kind == 1:
        del parent[key]
    elif kind == 2 and isinstance(parent, dict):
        parent[key + "x"] = parent.pop(key)
    elif kind == 3 and isinstance(parent, list):
        parent.insert(key, copy.deepcopy(value))
    elif kind == 4 and isinstance(value, int) and not isinstance(value, bool):
        parent[key] = int(rng.integers(-2, 40))
    else:
        parent[key] = copy.deepcopy(NASTY[rng.integers(len(NASTY))])


def fuzz(calls, seed):
    """Scenario JSON, changed in one to three places: refused in words, or flown with finite observations in range."""
    rng = np.random.default_rng(seed)
    drawn = {}
    flown = refused = 0
    for _ in range(calls):
        plant_id, options = EVERY[rng.integers(len(EVERY))]
        plant = build(plant_id, **options)
        name = list(plant.processes)[rng.integers(len(plant.processes))]
        key = plant.id, str(options), name, int(rng.integers(6))
        if key not in drawn:
            scenario = draw(plant.process(name), key[3])
            steps = 40
            faults = [
                Fault(f.mode, f.kind, f.onset * steps // scenario.steps, [
                    Samples(e.entry, e.values[:20]) if isinstance(e, Samples) else e for e in f.effects
                ], None if f.end is None else f.end * steps // scenario.steps) for f in scenario.faults
            ]  # fmt: skip
            drawn[key] = json.loads(scenario.replace(steps=steps, faults=faults, x0=plant.trim_state).to_json())
        data = copy.deepcopy(drawn[key])
        for _ in range(rng.integers(1, 4)):
            if data:
                mutated(rng, data)
        text = json.dumps(data)
        if rng.random() < 0.05:
            text = text[: rng.integers(len(text))]
        try:
            scenario = FaultScenario.from_json(text)
            assert FaultScenario.from_json(scenario.to_json()) == scenario
            plant.validate(scenario)
            if scenario.steps > 2000:
                continue
            record = simulate(plant, [scenario])
        except (ValueError, TypeError):
            refused += 1
            continue
        flown += 1
        _check_range(text, plant.observed, record.obs)
        _check_range(text, plant.theta, record.theta)
    assert flown > calls / 20
    assert refused > calls / 20


def test_mutated_scenarios_are_refused_or_fly():
    fuzz(600, seed=0)


@pytest.mark.slow
def test_many_mutated_scenarios_are_refused_or_fly():
    fuzz(30_000, seed=1)


def derivatives(of_x=1.0, of_theta=1.0, of_d=1.0, of_p=1.0, row=1):
    """The motor's, some of them times a factor."""
    from fdi_gym.kernels import kernel

    @kernel
    def jacobian(t, x, u, theta, d, p, J_x, J_theta, J_d, J_p):
        J_x[0, 0], J_x[0, 1] = -(p[0] + theta[1]) / 5e-3, -0.05 / 5e-3
        J_x[1, 0], J_x[row, 1] = of_x * 0.05 / 2e-4, -1e-4 / 2e-4
        J_theta[0, 0], J_theta[0, 1] = u[0] / 5e-3, -of_theta * x[0] / 5e-3
        J_d[1, 0], J_p[0, 0] = -of_d / 2e-4, -of_p * x[0] / 5e-3

    return jacobian


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({}, None),
        ({"of_x": -1.0}, r"d dx\[1\] / d x\[0\] is -250 .* say 250$"),
        ({"of_theta": 1.01}, r"d dx\[0\] / d theta\[1\] is"),
        ({"of_d": -1.0}, r"d dx\[1\] / d d\[0\] is 5000 .* say -5000$"),
        ({"of_p": 0.0}, r"d dx\[0\] / d p\[0\] is -?0 "),
        ({"row": 2}, "'jacobian' reaches beyond its arrays.*J_x 2 by 2"),
    ],
)
def test_check_plant_compares_the_derivatives_with_the_dynamics(motor, changes, match):
    plant = dataclasses.replace(motor, kernels=motor.kernels._replace(jacobian=derivatives(**changes)))
    if match is None:
        check_plant(plant, seeds=range(2))
        return
    with pytest.raises((AssertionError, ValueError), match=match):
        check_plant(plant, seeds=range(2))
