"""Bayes' rule over onset, kind and size: against brute force, and what it counts in a process."""

import dataclasses
import functools

import msgspec
import numpy as np
import pytest
from brute_force import log_density, states
from conftest import build
from numpy.testing import assert_allclose

from baselines.filters.event_bank import Bank
from baselines.filters.onset_bank import onset_bank
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.diagnosis.filtering import readings
from fdi_gym.diagnosis.fitting import fit_belief
from fdi_gym.engine import simulate
from fdi_gym.estimation import gaussian
from fdi_gym.estimation.augmented import augmented, on_lines
from fdi_gym.estimation.events import RISES, SATURATES, WANDERS, events_of
from fdi_gym.estimation.interval import Interval
from fdi_gym.faults import Abrupt, Fault, FaultScenario, Hold, Incipient, Intermittent, Ramp, draw
from fdi_gym.plant import NotApplicableError

FIRST = 4_900_000  # seeds of neither test nor validation nor training flights


def b747(steps=100, **fault):
    """A flight of the Boeing with at most one fault."""
    faults = [Fault("rudder LOE", "LOE", fault["onset"], [fault["effect"]], fault.get("end"))] if fault else []
    return FaultScenario(plant="B747Lateral", steps=steps, faults=faults)


# -- what a process does


def test_probabilities_of_onsets_and_ends_are_those_of_the_draws():
    effect = Abrupt("gamma_rudder", -0.5)
    drawn = [b747(onset=20, effect=effect, end=50)] * 30 + [b747(onset=60, effect=effect, end=90)] * 30 + [b747()] * 40
    e = events_of(build("B747Lateral"), drawn)
    assert_allclose([e.onset[20], e.onset[60], e.onset.sum()], [30 / 100, 30 / 70, 30 / 100 + 30 / 70])
    assert_allclose(e.end, np.eye(31)[30])
    assert not e.again.any()
    label = build("B747Lateral").label_of(frozenset({"rudder LOE"}))
    assert_allclose(e.share[[0, label]], [1 - 0.18, 0.18])
    assert_allclose(e.offset, [[-0.5 - build("B747Lateral").nominal_theta[e.entries[0]]]])


def test_a_second_event_is_counted_from_the_end_of_the_first():
    effect = Abrupt("gamma_rudder", -0.5)
    twice = b747(onset=10, effect=effect, end=30)
    twice = twice.replace(faults=[*twice.faults, Fault("rudder LOE", "LOE", 45, [effect], 60)])
    e = events_of(build("B747Lateral"), [twice] * 20 + [b747(onset=10, effect=effect, end=30)] * 20)
    assert_allclose([e.onset[10], e.again[15], e.again.sum()], [1.0, 1 / 3, 1 / 3])  # sixty times free again, twenty faults


@pytest.mark.parametrize(
    ("effect", "age", "share"),
    [
        (Incipient("gamma_rudder", -0.5, 2.0), 0.7, 1 - np.exp(-1.4)),
        (Ramp("gamma_rudder", -0.5, 4.0), 1.0, 0.25),
        (Ramp("gamma_rudder", -0.5, 4.0), 9.0, 1.0),
        (Intermittent("gamma_rudder", -0.5, 2.0, 0.25), 4.4, 1.0),
        (Intermittent("gamma_rudder", -0.5, 2.0, 0.25), 4.6, 0.0),
        (Abrupt("gamma_rudder", -0.5), 0.0, 1.0),
    ],
)
def test_courses_are_those_of_the_effects(effect, age, share):
    e = events_of(build("B747Lateral"), [b747(onset=20, effect=effect)] * 20)
    assert_allclose(e.at(np.full((1, 1), age)), [[share]])


def test_cells_cut_what_varies_and_keep_its_moments():
    rng = np.random.default_rng(0)
    values, rates = -rng.uniform(0.2, 0.8, 400), rng.choice([0.5, 4.0], 400)
    drawn = [b747(onset=20, effect=Incipient("gamma_rudder", v, r)) for v, r in zip(values, rates, strict=True)]
    plant = build("B747Lateral")
    e = events_of(plant, drawn, courses=2, sizes=2)
    assert len(e.label) == 4
    assert (e.course == SATURATES).all()
    assert_allclose(np.exp(e.log_prior).sum(), 1.0)
    whole = events_of(plant, drawn, courses=1, sizes=1)
    assert_allclose(whole.offset[0, 0], (values - plant.nominal_theta[e.entries[0]]).mean())
    assert_allclose(np.abs(whole.direction[0, 0]).max(), values.std())
    w = np.exp(e.log_prior)
    assert_allclose(w @ e.offset[:, 0], whole.offset[0, 0])
    assert (np.abs(e.direction[:, 0]).max(axis=1) < 0.6 * values.std()).all()


def test_parameters_that_vary_are_found_with_their_covariance():
    plant = build("MissilePitch")
    drawn = [draw(plant.process("standard"), FIRST + i) for i in range(300)]
    e = events_of(plant, drawn)
    rho = np.array([plant.physical(s.physical) for s in drawn])[:, e.physical] - plant.nominal_p[e.physical]
    assert_allclose(e.mean, rho.mean(axis=0))
    assert_allclose(e.spread @ e.spread.T, np.cov(rho, rowvar=False, bias=True), atol=1e-12)
    assert len(e.physical) == 6
    assert RISES not in e.course


def test_parameters_that_are_off_in_all_flights_alike_are_known():
    plant = build("HUAVHover")
    e = events_of(plant, [draw(plant.process("hard"), FIRST + i) for i in range(100)])
    assert_allclose(e.mean, plant.physical({"kappa": 1.0})[e.physical] - plant.nominal_p[e.physical])
    assert e.spread.shape == (3, 0)


def test_a_process_without_faults_has_no_events():
    with pytest.raises(NotApplicableError, match="has no faults"):
        events_of(build("B747Lateral"), [b747()])


# -- the model


def test_an_entry_beyond_theta_is_a_physical_parameter():
    plant = build("MissilePitch")
    n_x, n_theta = len(plant.states), len(plant.theta)
    model = gaussian.bind(
        plant, scale=np.ones(n_x + 1), entries=[n_theta + 3], lines=(np.zeros((1, 1)), np.full((1, 1, 1), 0.1))
    )
    rng = np.random.default_rng(1)
    x = plant.trim_state + 0.05 * rng.standard_normal((4, n_x))
    u = np.tile(plant.trim_command, (4, 1)) + 0.01
    m = rng.standard_normal(4)
    p = np.tile(plant.nominal_p, (4, 1))
    p[:, 3] += 0.1 * m
    d = np.tile([s.nominal for s in plant.disturbances], (4, 1)).astype(float) if plant.disturbances else None
    X = np.column_stack([x, m])[:, None]
    found = gaussian.f(model, X, np.zeros(4), u, d)[:, 0]
    assert_allclose(found[:, :n_x], plant.propagate(np.zeros(4), x, u, None, d, p), rtol=1e-12)
    assert not np.allclose(found[:, :n_x], plant.propagate(np.zeros(4), x, u, None, d), rtol=1e-9)
    assert_allclose(found[:, n_x], m)


@pytest.mark.parametrize(("entry", "linear"), [("gamma_rudder", True), ("bias_r", False), ("gain_r", False)])
def test_sensors_are_a_matrix_only_where_they_do_not_see_what_a_line_moves(entry, linear):
    """Whatever the line is that the model is first bound on."""
    plant = build("B747Lateral", sensor_faults=True)
    line = np.zeros((1, 1)), np.zeros((1, 1, 1)), np.zeros((1, 1))
    entries = np.array([plant.theta_entries.index(entry)])
    model = on_lines(augmented(plant, fit_belief(plant, "mixed")), *line, 1.0, entries)
    assert (model.H is not None) == linear
    moved = model.on(np.array([[0.3]]), np.array([[[0.5]]]))
    X = moved.X0 + 0.1 * np.random.default_rng(0).standard_normal((3, len(moved.X0)))
    at = Interval(np.ones(3, int), np.tile(plant.trim_command, (3, 1)), None, np.zeros((3, 0)))
    theta = np.tile(plant.nominal_theta, (3, 1))
    theta[:, entries[0]] += 0.3 + 0.5 * X[:, moved.z.start]
    expected = plant.measure(np.full(3, plant.dt), X[:, moved.x], at.u, theta, None)[:, moved.sensors]
    assert_allclose(moved.h(X[:, None], at)[:, 0], expected, rtol=1e-9)
    updated = moved.update("extended", X, np.tile(1e-6 * np.eye(X.shape[1]), (3, 1, 1)), at, expected, np.ones((3, 4), bool))
    assert_allclose(updated.nu, 0.0, atol=1e-9)


def test_other_lines_are_those_of_a_model_that_is_bound_anew():
    plant = build("ThreeTank")
    base = augmented(plant, fit_belief(plant, "standard"))
    rng = np.random.default_rng(4)
    p = len(base.inputs.entries)
    one, other = ((rng.standard_normal((r, p)), rng.standard_normal((r, p, 2))) for r in (1, 3))
    model = on_lines(base, *one, np.zeros((1, 2)), 1.0)
    N = len(model.scale)
    X, P = np.tile(model.X0, (6, 1)) + 0.01, np.tile(1e-4 * np.eye(N), (6, 1, 1))
    at = Interval(np.ones(6, int), np.tile(plant.trim_command, (6, 1)), None, np.zeros((6, len(plant.known))))
    found, expected = (m.predict("extended", X, P, at) for m in (model.on(*other), model.replace(lines=other)))
    for a, b in zip(found, expected, strict=True):
        assert np.array_equal(a, b)
    assert not np.array_equal(found[0], model.predict("extended", X, P, at)[0])


@pytest.fixture
def b747_ends():
    """A bank that takes onsets every ten samples, of a process whose faults last 30 or 45 samples."""
    plant, effect = build("B747Lateral"), Abrupt("gamma_rudder", -0.5)
    drawn = [b747(onset=20, effect=effect, end=50)] * 30 + [b747(onset=40, effect=effect, end=85)] * 30 + [b747()] * 40
    return Bank(plant, fit_belief(plant, "standard"), events_of(plant, drawn), 11, 10)


# -- Bayes by brute force


def brute_force(plant, bank, obs, every):
    """Log of p(healthy) and of each kind, from the joint density of all measurements under each kind and onset."""
    e, K = bank.events, len(obs) - 1
    density = functools.partial(log_density, plant, bank.model, e, obs)
    free, by_kind = 0.0, np.full((len(e.label), 0), 0.0)
    for step in range(0, K, every):
        rate = e.onset[step : step + every].sum()
        each = [free + np.log(max(rate, 1e-12)) + e.log_prior[r] + density([(r, step)]) for r in range(len(e.label))]
        by_kind = np.column_stack([by_kind, each])
        free += np.log1p(-max(rate, 1e-12))
    return free + density([]), np.logaddexp.reduce(by_kind, axis=1)


def test_it_is_bayes_by_brute_force_where_all_onsets_are_kept():
    plant = build("B747Lateral")
    belief = msgspec.structs.replace(
        fit_belief(plant, "standard"), disturbances=np.zeros(0, np.int64), d0=np.zeros(0), d_walk=np.zeros(0)
    )
    rng = np.random.default_rng(3)
    drawn = [b747(40, onset=int(rng.integers(5, 35)), effect=Abrupt("gamma_rudder", -v)) for v in rng.uniform(0.1, 0.9, 60)]
    drawn += [
        b747(40).replace(faults=[Fault("aileron LOE", "LOE", int(rng.integers(5, 35)), [Abrupt("gamma_aileron", -v)])])
        for v in rng.uniform(0.1, 0.9, 40)
    ] + [b747(40)] * 20
    events, every = events_of(plant, drawn), 8
    bank = Bank(plant, belief, events, 40 // every + 1, every)
    flights = [b747(40, onset=12, effect=Abrupt("gamma_rudder", -0.9)).replace(noise_seed=i) for i in range(2)]
    record = simulate(plant, [s.replace(reference=draw(plant.process("standard"), FIRST).reference) for s in flights])
    *_, s = states(plant, bank, record.obs)
    for i in range(2):
        healthy, kinds = brute_force(plant, bank, record.obs[i], every)
        logs = np.array([healthy, *kinds])
        expected = np.exp(logs - np.logaddexp.reduce(logs))
        found = np.asarray(bank.read(s).probs)[i]
        assert_allclose(found[[0, *events.label]], expected, rtol=1e-5, atol=1e-9)
        assert 0.01 < expected.max() < 1.0 - 1e-6  # the comparison says something


def of_the_sensor(kind, onset, value):
    """A fault of the sensor r that begins at a step."""
    entry = {"bias": "bias_r", "noise": "noise_r", "freeze": "frozen_r"}[kind]
    return b747(40).replace(faults=[Fault("r sensor", kind, onset, [Abrupt(entry, value)])])


@pytest.mark.parametrize(("kind", "value"), [("bias", 0.2), ("noise", 1.0), ("freeze", 1.0)])
def test_of_sensors_that_fail_too(kind, value):
    """Of a sensor that is frozen all other readings are impossible, and one that comes again has a density of its own."""
    plant, rng = build("B747Lateral", sensor_faults=True), np.random.default_rng(5)
    belief = msgspec.structs.replace(
        fit_belief(plant, "mixed"), disturbances=np.zeros(0, np.int64), d0=np.zeros(0), d_walk=np.zeros(0)
    )
    onsets = iter(rng.integers(5, 35, 80))
    drawn = [of_the_sensor("bias", int(next(onsets)), b) for b in rng.normal(0.0, 0.1, 20)]
    drawn += [of_the_sensor("noise", int(next(onsets)), v) for v in rng.uniform(0.5, 2.0, 20)]
    drawn += [of_the_sensor("freeze", int(next(onsets)), 1.0) for _ in range(20)]
    drawn += [b747(40, onset=int(next(onsets)), effect=Abrupt("gamma_rudder", -v)) for v in rng.uniform(0.1, 0.9, 20)]
    events, every = events_of(plant, drawn + [b747(40)] * 120, courses=1), 8
    bank = Bank(plant, belief, events, 40 // every + 1, every)
    reference = draw(plant.process("standard"), FIRST).reference
    obs = simulate(plant, [of_the_sensor(kind, 17, value).replace(noise_seed=3, reference=reference)]).obs
    for part in (18, 41):  # the sensor's frozen reading has come twice, and often
        *_, s = states(plant, bank, obs[:, :part])
        healthy, kinds = brute_force(plant, bank, obs[0, :part], every)
        logs = np.array([healthy, *kinds])
        expected = np.bincount([0, *events.label], np.exp(logs - np.logaddexp.reduce(logs)), len(plant.labels))
        assert_allclose(np.asarray(bank.read(s).probs)[0], expected, rtol=1e-5, atol=1e-9)
        assert part > 18 or 0.01 < expected.max() < 1.0 - 1e-9  # the comparison says something
    assert expected.argmax() == plant.label_of(frozenset({"r sensor"}))


def test_what_says_nothing_of_a_frozen_sensor():
    """A reading at the end of its range, one of a sensor without noise, and one that did not report."""
    plant = build("B747Lateral", sensor_faults=True)
    drawn = [of_the_sensor("freeze", 5, 1.0)] * 20
    bank = Bank(plant, fit_belief(plant, "mixed"), events_of(plant, drawn), 2, 1)
    before = np.array([[1.0, 2.0, plant.outputs[2].high, np.nan]])
    density = -0.5 * np.log(2 * np.pi * np.array([s.sigma for s in plant.outputs]) ** 2)
    found = bank.repeated(before, np.array([[1.0, 2.5, plant.outputs[2].high, 3.0]]), np.ones((1, 4), bool))[0]
    assert_allclose(found[[0, 2, 3, 4]], [10.0 + density[0], density[2], 0.0, 0.0])
    assert found[1] < -1e200
    assert not bank.repeated(before, before, np.zeros((1, 4), bool)).any()
    quiet = dataclasses.replace(plant, outputs=tuple(s._replace(sigma=0.0) for s in plant.outputs))
    bank = Bank(quiet, fit_belief(plant, "mixed"), events_of(plant, drawn), 2, 1)
    assert_allclose(bank.repeated(before, before, np.ones((1, 4), bool))[0, :2], density[:2])


def test_a_lag_and_reports_that_do_not_come_have_no_course():
    plant = build("B747Lateral", sensor_faults=True)
    for entry in ("lag_r", "missing_r"):
        with pytest.raises(NotApplicableError, match="has no course that could be known"):
            events_of(plant, [b747(40).replace(faults=[Fault("r sensor", "x", 5, [Abrupt(entry, 1.0)])])])


def test_noise_of_many_sizes_is_cut_by_them():
    plant, rng = build("B747Lateral", sensor_faults=True), np.random.default_rng(6)
    sizes = rng.uniform(0.5, 5.0, 90)
    e = events_of(plant, [of_the_sensor("noise", 5, v) for v in sizes], courses=3)
    sigma = next(s.sigma for s in plant.outputs if s.name == "r")
    added = np.sort(sigma**2 * ((1.0 + sizes) ** 2 - 1.0)).reshape(3, 30).mean(axis=1)
    assert [plant.theta_entries[i] for i in e.entries] == ["bias_r"]
    assert_allclose(np.sort((e.direction[:, 0] ** 2).sum(axis=1)), added)
    assert (e.first == 0.0).all()
    assert (e.course == WANDERS).all()


def test_events_that_end_give_their_weight_to_health_and_what_was_never_faulty_keeps_its_own(b747_ends):
    """No weight is lost, and the end of an event makes no flight one without any event so far."""
    bank, rng = b747_ends, np.random.default_rng(4)
    s, step = bank.start(5), np.full(5, 60)
    log = np.log(rng.dirichlet(np.ones(s.log.shape[1]), 5))
    kind, onset = np.zeros_like(s.kind), rng.integers(0, 6, s.onset.shape) * 10.0
    kind[:, 0] = -1
    s = s._replace(log=log, kind=kind, onset=onset, first=rng.uniform(0.2, 0.8, 5))
    all_of = np.arange(5)
    after = bank.renewed(s, all_of, step, np.tile(bank.plant.trim_command, (5, 1)))
    assert_allclose(np.exp(after.log).sum(axis=1), 1.0)
    healthy = np.exp(after.log[:, 0]) / (
        1.0 - bank.chances(s._replace(first=after.first, since=after.since), all_of, step)[:, 0]
    )
    assert (healthy > np.exp(log[:, 0])).all()
    assert_allclose(after.first * healthy, s.first * np.exp(log[:, 0]), rtol=1e-6)


def test_a_mixture_of_two_onsets_has_the_mean_and_covariance_of_its_parts(b747_ends):
    """A kind has as many onsets as are kept: as one more begins, two become one."""
    bank, rng = b747_ends, np.random.default_rng(2)
    s = bank.start(1)
    N, count = s.X.shape[2], bank.count
    roots = rng.standard_normal((count, N, N))
    X, P = rng.standard_normal((1, count, N)), (roots @ np.swapaxes(roots, 1, 2))[None]
    log, onset = np.log(rng.dirichlet(np.ones(count)))[None], np.arange(count)[None, :, None] * 10.0
    kind = np.zeros_like(s.kind)
    kind[:, 0] = -1
    s = s._replace(X=X, P=P, log=log, kind=kind, onset=onset)
    step = np.array([200])
    after, _ = bank.begun(s, np.arange(1), step, np.tile(bank.plant.trim_command, (1, 1)), np.array([[0.1]]), np.zeros(0))
    w = np.exp(log[0])
    mine = np.flatnonzero(~np.isin(np.exp(after.log[0]).round(12), w.round(12)))
    both = [i for i in mine if i > 0 and after.onset[0, i, 0] < 200]
    assert len(both) == 1
    lost = [i for i in range(1, count) if not np.isclose(np.exp(after.log[0]), w[i], rtol=1e-9).any()]
    assert len(lost) == 2
    share = w[lost] / w[lost].sum()
    mean = share @ X[0, lost]
    second = np.einsum("a,aij->ij", share, P[0, lost] + X[0, lost][:, :, None] * X[0, lost][:, None, :])
    assert_allclose(np.exp(after.log[0, both[0]]), w[lost].sum())
    assert_allclose(after.X[0, both[0]], mean)
    assert_allclose(after.P[0, both[0]], second - np.outer(mean, mean), rtol=1e-9, atol=1e-9)
    assert_allclose(after.onset[0, both[0], 0], share @ onset[0, lost, 0])


# -- as a diagnoser


def test_more_onsets_change_little_and_it_is_the_best_where_faults_come_and_go():
    plant = build("B747Lateral")
    scenarios = [draw(plant.process("hard"), FIRST + i) for i in range(16)]
    record = simulate(plant, scenarios)
    valid = np.arange(record.obs.shape[1]) <= record.length[:, None]

    def balanced(name, **settings):
        said = run(make_diagnoser(name, plant, process="hard", **settings), record.obs)
        return np.mean([(said.label[valid & (record.label == l)] == l).mean() for l in range(len(plant.labels))])  # noqa: E741

    bank = balanced("onset_bank")
    assert abs(bank - balanced("onset_bank", onsets=12, sizes=2)) < 0.02
    assert bank > balanced("multiple_model_ekf") + 0.05


@pytest.mark.parametrize("process", ["hard", "gust"])
def test_told_the_onsets_it_is_a_ceiling(process):
    plant = build("B747Lateral")
    scenarios = [draw(plant.process(process), FIRST + 20 + i) for i in range(12)]
    record = simulate(plant, scenarios)
    told = run(make_diagnoser("told_events_oracle", plant, process=process, scenarios=scenarios), record.obs).label
    bank = run(make_diagnoser("onset_bank", plant, process=process), record.obs).label
    valid = np.arange(record.obs.shape[1]) <= record.length[:, None]
    acts = valid & (record.label > 0)
    assert ((told > 0) == acts)[valid].all()
    assert (told == record.label)[acts].mean() > max(0.8, (bank == record.label)[acts].mean())
    with pytest.raises(ValueError, match="told of 12 flights, not 3"):
        make_diagnoser("told_events_oracle", plant, process=process, scenarios=scenarios).init(3)


def test_held_commands_are_those_at_the_onset():
    plant = build("B747Lateral")
    jam = Fault("rudder stuck", "jam", 300, [Abrupt("gamma_rudder", -1.0), Hold("b_rudder", "rudder")])
    found = []
    for i in range(4):
        drawn = draw(plant.process("standard"), FIRST + 50 + i)
        scenario = drawn.replace(faults=[jam])
        record = simulate(plant, [scenario])
        *_, (reading, _) = readings(plant, make_diagnoser("onset_bank", plant), record.obs)
        entry = [s.name for s in plant.estimated].index("b_rudder")
        found.append(
            [
                np.asarray(reading.z)[0, entry],
                (record.target - plant.healthy)[0, -1, entry],
                np.asarray(reading.probs)[0].argmax(),
            ]
        )
    found = np.array(found)
    assert (found[:, 2] == plant.label_of(frozenset({"rudder stuck"}))).mean() >= 0.75
    assert_allclose(found[:, 0], found[:, 1], atol=0.06)


@pytest.mark.parametrize(
    ("settings", "what"),
    [({"onsets": 1}, "onsets is 2 or more"), ({"courses": 0}, "courses is 1 or more"), ({"sizes": 0}, "sizes is 1"),
     ({"every": 0}, "every is 1 or more")],
)  # fmt: skip
def test_numbers_out_of_range_are_refused(settings, what):
    with pytest.raises(ValueError, match=what):
        make_diagnoser("onset_bank", build("B747Lateral"), **settings)


@pytest.mark.parametrize("plant_id", ["B747Lateral", "MissilePitch"])
def test_a_process_that_says_when_faults_begin_is_none_to_be_told(plant_id):
    """Else it would know the onset, and stand above ceilings that do."""
    plant = build(plant_id)
    assert len({tuple(f.onset for f in plant.draw("paper", seed).faults) for seed in range(5)}) == 1
    with pytest.raises(NotApplicableError, match="at the same time in all flights"):
        onset_bank(plant, fit_belief(plant, "paper"), "paper")


def test_faults_that_overlap_are_for_the_other_bank():
    with pytest.raises(NotApplicableError, match="overlap in time: overlap_bank"):
        make_diagnoser("onset_bank", build("HUAVHover"), process="standard")
