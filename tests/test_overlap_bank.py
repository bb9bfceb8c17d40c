"""Bayes' rule over faults that overlap: against brute force, and what it counts in a process."""

import functools

import msgspec
import numpy as np
import pytest
from brute_force import log_density, states
from conftest import build
from numpy.testing import assert_allclose

from baselines.filters.event_bank import Bank
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.diagnosis.fitting import fit_belief
from fdi_gym.engine import simulate
from fdi_gym.estimation.events import ALTERNATES, WANDERS, events_of
from fdi_gym.estimation.interval import Interval
from fdi_gym.faults import Abrupt, Fault, FaultScenario, Samples, Square, draw
from fdi_gym.plant import NotApplicableError

FIRST = 4_950_000  # seeds of neither test nor validation nor training flights


def flight(*faults, steps=100):
    """A flight of the Boeing."""
    return FaultScenario(plant="B747Lateral", steps=steps, faults=list(faults))


def rudder(onset, end=None, size=-0.5):
    return Fault("rudder LOE", "LOE", onset, [Abrupt("gamma_rudder", size)], end)


def aileron(onset, end=None, size=-0.5):
    return Fault("aileron LOE", "LOE", onset, [Abrupt("gamma_aileron", size)], end)


# -- what a process does


def test_how_likely_another_event_begins_is_counted_by_how_many_act():
    plant = build("B747Lateral", labels="dual")
    both = flight(rudder(10, 60), aileron(30, 70))
    e = events_of(plant, [both] * 30 + [flight(rudder(10, 60))] * 10)
    alone = 30 * (20 + 10) + 10 * 50  # samples at which one acts
    assert_allclose(e.more, [30 / alone])
    assert_allclose([e.onset[10], e.again.sum()], [1.0, 0.0])
    labels = [plant.label_of(frozenset(names)) for names in ({"rudder LOE"}, {"aileron LOE"}, {"rudder LOE", "aileron LOE"})]
    assert_allclose(e.share[labels] * 4000, [30 * 20 + 10 * 50, 30 * 10, 30 * 30])
    bits = [1 << [m.name for m in plant.modes].index(name) for name in ("aileron LOE", "rudder LOE")]
    assert sorted(e.modes.tolist()) == sorted(bits)


def test_a_square_wave_has_a_part_that_alternates_and_one_that_stays():
    plant = build("B747Lateral")
    rng = np.random.default_rng(0)
    drawn = [
        flight(Fault("rudder LOE", "wave", 10, [Square("gamma_rudder", a + 0.2, -a + 0.2, 2.0), Abrupt("b_rudder", 3.0)]))
        for a in rng.uniform(0.1, 0.3, 50)
    ]
    e = events_of(plant, drawn)
    assert e.course.tolist() == [ALTERNATES]
    gamma, b = (e.entries.tolist().index(plant.theta_entries.index(name)) for name in ("gamma_rudder", "b_rudder"))
    assert_allclose([e.steady[0, gamma], e.steady[0, b], e.offset[0, b]], [0.2, 3.0, 0.0])
    assert_allclose(e.offset[0, gamma], 0.2, atol=0.02)
    assert_allclose(e.at(np.array([[0.5, 1.5, 2.5]])), [[1.0, -1.0, 1.0]])


def test_values_that_wander_have_their_spread_and_correlation():
    plant, rng, a = build("B747Lateral"), np.random.default_rng(1), 0.9
    drawn = []
    for _ in range(200):
        x = np.zeros(80)
        x[0] = rng.standard_normal()
        for k in range(1, 80):
            x[k] = a * x[k - 1] + np.sqrt(1 - a**2) * rng.standard_normal()
        drawn.append(flight(Fault("rudder LOE", "drift", 10, [Samples("gamma_rudder", (0.3 + 0.1 * x).tolist())])))
    e = events_of(plant, drawn)
    assert e.course.tolist() == [WANDERS]
    assert_allclose(e.first, [a], atol=0.02)
    assert_allclose([e.offset[0, 0], np.abs(e.direction[0, 0, 0])], [0.3, 0.1], atol=0.01)
    assert np.abs(e.direction[0]).sum() == np.abs(e.direction[0, 0, 0])


def without_disturbances(plant, process="standard"):
    """A belief of a plant on which nothing acts but its faults."""
    belief = fit_belief(plant, process)
    nothing = {"disturbances": np.zeros(0, np.int64), "d0": np.zeros(0), "d_walk": np.zeros(0)}
    return msgspec.structs.replace(belief, **nothing)


# -- Bayes by brute force


def test_two_that_overlap_are_bayes_by_brute_force():
    """The first may begin at step 0, another beside it at step 20: what may have happened can be counted."""
    plant = build("B747Lateral", labels="dual")
    rng = np.random.default_rng(7)
    sizes = rng.uniform(0.1, 0.9, (80, 2))
    drawn = [flight(rudder(0, None, -a), aileron(20, None, -b), steps=40) for a, b in sizes[:40]]
    drawn += [flight(aileron(0, None, -a), rudder(20, None, -b), steps=40) for a, b in sizes[40:]]
    drawn += [flight(rudder(0, None, -a), steps=40) for a, _ in sizes] + [flight(steps=40)] * 40
    events = events_of(plant, drawn, courses=1)
    bank = Bank(plant, without_disturbances(plant), events, 2, 20, 20)
    reference = draw(plant.process("standard"), FIRST).reference
    truth = [flight(rudder(0, None, -0.7), aileron(20, None, -0.5), steps=40), flight(aileron(0, None, -0.8), steps=40)]
    obs = simulate(plant, [t.replace(noise_seed=i, reference=reference) for i, t in enumerate(truth)]).obs
    *_, s = states(plant, bank, obs)
    first, late, more = events.onset[:20].sum(), events.onset[20:40].sum(), 20 * events.more[0]
    first, late, more = (np.clip(c, 1e-12, 0.5) for c in (first, late, more))
    prior, kinds = events.log_prior, range(len(events.label))
    for i in range(2):
        density = functools.partial(log_density, plant, bank.model, events, obs[i])
        found = {0: [np.log1p(-first) + np.log1p(-late) + density([])]}
        for q in kinds:
            label = int(events.label[q])
            once = np.log(first) + prior[q] + np.log1p(-more) + density([(q, 0)])
            then = np.log1p(-first) + np.log(late) + prior[q] + density([(q, 20)])
            found.setdefault(label, []).extend([once, then])
            for other in kinds:
                both = dict(zip(bank.sets, bank.labels, strict=True)).get(events.modes[q] | events.modes[other], -1)
                if q != other and both >= 0:  # the only other kind: its share of those that may begin is 1
                    weight = np.log(first) + prior[q] + np.log(more)
                    found.setdefault(both, []).append(weight + density([(q, 0), (other, 20)]))
        logs = {label: np.logaddexp.reduce(values) for label, values in found.items()}
        total = np.logaddexp.reduce(list(logs.values()))
        probs = np.asarray(bank.read(s).probs)[i]
        assert_allclose(probs[list(logs)], [np.exp(v - total) for v in logs.values()], rtol=2e-5, atol=1e-9)
        assert 0.01 < probs.max() < 1 - 1e-6  # the comparison says something


def test_no_weight_is_lost_when_events_end_and_begin():
    plant = build("HUAVHover")
    drawn = [draw(plant.process("standard"), FIRST + i) for i in range(400)]
    events = events_of(plant, drawn)
    bank, rng = Bank(plant, fit_belief(plant, "standard"), events, 3, 1, 120), np.random.default_rng(4)
    s = bank.start(2)
    u = np.tile(plant.trim_command, (2, 1))
    for step in range(300, 400):
        s = bank.renewed(s, np.arange(2), np.full(2, step), u)
        assert_allclose(np.exp(s.log).sum(axis=1), 1.0, atol=1e-3)  # the least likely give way
        alive = s.log > -1e300
        assert ((s.kind[:, 1:] >= 0).any(axis=2) | ~alive[:, 1:]).all()
        rising = (s.kind[..., 0] < s.kind[..., 1]) | (s.kind[..., 1] < 0)
        assert rising[alive].all()
        assert (np.linalg.eigvalsh(s.P[alive]) > -1e-9).all()
        log = np.where(alive, s.log + 0.5 * rng.standard_normal(s.log.shape), s.log)  # as if something had been measured
        s = s._replace(log=log - np.where(alive, np.logaddexp.reduce(np.where(alive, log, -np.inf), axis=1)[:, None], 0.0))
    assert (s.kind[..., 1] >= 0).any()


def test_what_begins_has_a_place_where_its_kind_is_full_however_unlikely_it_is():
    """Two of its kind become one for it; elsewhere it needs a place that is free, or less likely."""
    plant = build("HUAVHover")
    events = events_of(plant, [draw(plant.process("standard"), FIRST + i) for i in range(400)])
    r, u = len(events.label), np.tile(plant.trim_command, (1, 1))
    bank = Bank(plant, fit_belief(plant, "standard"), events, 2, 1, 1 + 2 * r)
    s, one = bank.start(1), np.arange(1)
    for step in range(2):  # no two act at once: the table fills with two onsets of each kind
        s, _ = bank.begun(s, one, np.array([step]), u, np.array([[0.3, 1e-300]]), np.zeros(0))
    assert (s.log > -1e300).all()
    assert (s.kind[0, 1:, 1] < 0).all()
    s = s._replace(log=s.log + np.where(np.arange(1 + 2 * r) > 0, 20.0, 0.0))
    after, _ = bank.begun(s, one, np.array([2]), u, np.array([[0.1, 1e-300]]), np.zeros(0))
    newest = after.kind[0, after.onset[0, :, 0] == 2, 0]
    assert sorted(newest[newest >= 0]) == list(range(r))
    one_less = s._replace(kind=np.where(np.arange(1 + 2 * r)[:, None] == 1, [[0, 1]], s.kind[0])[None])  # of its kind
    missing = s.kind[0, 1, 0]
    after, _ = bank.begun(one_less, one, np.array([2]), u, np.array([[0.1, 1e-300]]), np.zeros(0))
    newest = after.kind[0, after.onset[0, :, 0] == 2, 0]
    assert sorted(newest[newest >= 0]) == [q for q in range(r) if q != missing]


# -- as a diagnoser


@pytest.mark.parametrize(
    ("plant", "process", "steps", "least"), [("HUAVHover", "standard", 1000, 0.75), ("CMGSatellite", "hard", 3000, 0.7)]
)
def test_it_tells_faults_apart_that_overlap(plant, process, steps, least):
    plant = build(plant)
    record = simulate(plant, [draw(plant.process(process), FIRST + i).replace(steps=steps) for i in range(8)])
    valid = np.arange(record.obs.shape[1]) <= record.length[:, None]
    said = run(make_diagnoser("overlap_bank", plant, process=process), record.obs).label
    assert (said == record.label)[valid].mean() > least


@pytest.mark.parametrize("comes_again", [True, False])
def test_of_a_sensor_that_is_frozen_beside_another_event_nothing_is_heard(comes_again):
    """In its hypotheses alone: the filter is the one without that sensor, and another reading is the end of them."""
    plant, rng = build("B747Lateral", labels="dual", sensor_faults=True), np.random.default_rng(8)
    drawn = [flight(rudder(10, None, -a), aileron(30, None, -b)) for a, b in rng.uniform(0.1, 0.9, (30, 2))]
    drawn += [flight(Fault("r sensor", "freeze", 20, [Abrupt("frozen_r", 1.0)]))] * 20 + [flight()] * 40
    events = events_of(plant, drawn, courses=1)
    bank = Bank(plant, without_disturbances(plant, "mixed"), events, 2, 1, 20)
    frozen = int(np.flatnonzero(events.frozen >= 0)[0])
    loss = int(np.flatnonzero(events.label == plant.label_of(frozenset({"rudder LOE"})))[0])
    pair = sorted((frozen, loss))
    s, r = bank.start(1), [o.name for o in plant.outputs].index("r")
    s.kind[0, 1], s.kind[0, 2, 0], s.log[0, :3] = pair, loss, np.log([0.2, 0.5, 0.3])
    N = s.X.shape[2]
    root = 0.1 * rng.standard_normal((3, N, N))
    s.X[0, :3], s.P[0, :3] = 0.1 * rng.standard_normal((3, N)), root @ np.swapaxes(root, 1, 2)
    before = rng.standard_normal((1, 4))
    y = before + 0.1
    if comes_again:
        y[0, r] = before[0, r]
    at = Interval(np.array([5]), plant.trim_command[None], None, np.zeros((1, 0)))
    after = bank.update(s._replace(y=before), at, y, np.ones((1, 4), bool))
    gain, log = [], [s.log[0, i] for i in range(3)]
    for i, kinds in enumerate(([], pair, [loss])):
        direction = np.zeros((1, len(events.entries), bank.width))
        for place, q in enumerate(kinds):
            direction[0, :, place * bank.f : (place + 1) * bank.f] = events.direction[q]
        offset = sum((events.offset[q] for q in kinds), np.zeros(len(events.entries)))[None]
        seen = np.ones((1, 4), bool)
        seen[0, r] = frozen not in kinds
        found = bank.model.on(offset, direction).update("extended", s.X[:, i], s.P[:, i], at, y, seen)
        gain.append(float(found.log_likelihood[0]))
        if i != 1 or comes_again:
            assert_allclose(after.X[0, i], found.X[0], rtol=1e-9, atol=1e-12)
            assert_allclose(after.P[0, i], found.P[0], rtol=1e-9, atol=1e-12)
    gain[1] += 10.0 - 0.5 * np.log(2 * np.pi * plant.outputs[r].sigma ** 2) if comes_again else -np.inf
    logs = np.array(log) + gain
    assert_allclose(np.exp(after.log[0, :3]), np.exp(logs - np.logaddexp.reduce(logs)), rtol=1e-9)
    assert after.y[0].tolist() == y[0].tolist()


def test_what_it_cannot_do_it_says():
    with pytest.raises(NotApplicableError, match="no two faults overlap"):
        make_diagnoser("overlap_bank", build("B747Lateral"), process="standard")


@pytest.mark.parametrize(
    ("settings", "what"),
    [({"onsets": 1}, "onsets is 2 or more"), ({"every": 0}, "every is 1 or more"), ({"filters": 9}, "filters are more than"),
     ({"disturbance": 0.0}, "disturbance is above 0")],
)  # fmt: skip
def test_numbers_out_of_range_are_refused(settings, what):
    with pytest.raises(ValueError, match=what):
        make_diagnoser("overlap_bank", build("HUAVHover"), process="standard", **settings)
