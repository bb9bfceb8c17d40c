"""Sets that bounded noise never leaves: no false alarm, the true label never refuted, and what is left is true."""

import numpy as np
import pytest

from baselines.filters.set_membership import deviations, fewer, set_filter, set_membership
from fdi_gym.diagnosis import diagnoser_of, make_diagnoser, run
from fdi_gym.diagnosis.fitting import fit_belief
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.decision import by_candidate
from fdi_gym.faults import draw
from fdi_gym.plant import NotApplicableError

BOUND, FLIGHTS, MEMORY = 0.5, 60, 10**6


@pytest.fixture(scope="module")
def belief():
    return fit_belief(load_plant("B747Lateral"), "standard")


@pytest.fixture(scope="module")
def flown():
    """747s whose noise is anywhere within BOUND standard deviations, or at the bounds."""
    plant, rng, scenarios, noise = load_plant("B747Lateral"), np.random.default_rng(5), [], []
    for i in range(FLIGHTS):
        scenario = draw(plant.process("standard"), 4_200_000 + i).replace(x0=[0.0] * 4)
        scenarios.append(scenario)
        e = (
            rng.uniform(-1, 1, (2 * scenario.steps + 1, 4))
            if i % 2
            else rng.choice([-1.0, 1.0], (2 * scenario.steps + 1, 4))
        )
        w, v = e[: scenario.steps], e[scenario.steps :]
        sigma = [np.array([s.sigma for s in signals]) for signals in (plant.states, plant.outputs)]
        noise.append((BOUND * sigma[0] * w, BOUND * sigma[1] * v))
    return plant, simulate(plant, scenarios, noise)


def test_fewer_generators_hold_the_same_points():
    rng = np.random.default_rng(0)
    G = rng.standard_normal((3, 4, 20)) * rng.uniform(0.01, 1, 20)
    small, along = fewer(G, 9), rng.standard_normal((50, 4))
    assert small.shape == (3, 4, 9)
    # the support in every direction grows, and that along the axes stays
    assert (np.abs(along @ small).sum(-1) >= np.abs(along @ G).sum(-1) - 1e-12).all()
    np.testing.assert_allclose(np.abs(small).sum(-1), np.abs(G).sum(-1))
    np.testing.assert_array_equal(fewer(G, 30)[..., :20], G)


def test_bounded_noise_never_raises_an_alarm_and_never_refutes_the_true_label(flown, belief):
    plant, record = flown
    said = run(set_membership(plant, belief, bound=BOUND, memory=MEMORY), record.obs, signals=True)
    assert said.signals is not None
    since, last = said.signals["since"], record.label[:, -1]
    assert not said.alarm[record.label == 0].any()
    assert (since[np.arange(FLIGHTS), -1, last] == MEMORY).all()
    possible = (since[:, -1] == MEMORY).sum(axis=1)
    alone = (possible == 1) & (last > 0)
    assert (said.label[alone, -1] == last[alone]).all()
    assert said.alarm[last > 0, -1].mean() > 0.5  # at such small noise most faults are too large for it
    assert alone.sum() > 5


def test_the_true_state_is_in_the_healthy_set(flown, belief):
    plant, record = flown
    model = augmented(plant, belief, faults=False)
    filter = set_filter(plant, model, deviations(plant, belief), BOUND, MEMORY)

    def read(s):
        reading = filter.read(s)
        edges = np.abs(s.G[:, 0, :4]).sum(axis=-1)
        return reading._replace(signals={"centre": s.c[:, 0, :4], "edge": edges})

    diagnoser = diagnoser_of(plant, filter._replace(read=read), by_candidate(lambda r, label: label, 1))
    signals = run(diagnoser, record.obs, signals=True).signals
    assert signals is not None
    healthy = np.cumsum(record.label, axis=1) == 0
    inside = np.abs(record.state[..., :4] - signals["centre"]) <= signals["edge"] + 1e-12
    assert inside[healthy].all()
    assert (signals["edge"][healthy][-1] < 3 * BOUND).all()  # and the set is no trivial one


def test_noise_beyond_the_bounds_is_noticed(flown, belief):
    plant, record = flown
    said = run(set_membership(plant, belief, bound=0.1 * BOUND), record.obs)
    assert said.alarm[record.label == 0].mean() > 0.5


def test_what_it_refuses(belief):
    plant = load_plant("B747Lateral")
    with pytest.raises(ValueError, match="bound is positive and memory at least 1, not 0 and 100"):
        set_membership(plant, belief, bound=0)
    with pytest.raises(ValueError, match="at least 1, not 3"):
        set_membership(plant, belief, memory=0)
    with pytest.raises(NotApplicableError, match="MissilePitch is nonlinear"):
        make_diagnoser("set_membership", load_plant("MissilePitch"))
    with pytest.raises(NotApplicableError, match="linear and do not fail"):
        make_diagnoser("set_membership", load_plant("B747Lateral", sensor_faults=True), process="mixed")
