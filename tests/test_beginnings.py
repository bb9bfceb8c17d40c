"""How flights begin: the short ways of drawing and preparing them give what the long ways give, and nothing stalls."""

import dataclasses

import cloudpickle
import msgspec
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from fdi_gym import faults
from fdi_gym.engine import advance, simulate
from fdi_gym.envs import FDIEnv
from fdi_gym.faults import FaultProcess, FaultScenario, draw
from fdi_gym.flights import Flights
from fdi_gym.next_flights import TOGETHER
from fdi_gym.vector_envs import FDIVectorEnv


@pytest.fixture
def the_long_way(monkeypatch):
    """Scenarios are searched entry by entry."""
    return lambda: monkeypatch.setattr(faults, "_usual", lambda scenario: None)


def plainly(process: FaultProcess, seed: int) -> FaultScenario:
    """What `draw` gives, by NumPy's own streams."""
    initial, scenario, noise, _ = np.random.SeedSequence(seed).spawn(4)
    changes = {"noise_seed": int(noise.generate_state(1, np.uint64)[0]) >> 1}
    if process.initial is not None:
        changes["x0"] = list(process.initial(np.random.default_rng(initial)))
    return process.sample(np.random.default_rng(scenario)).replace(**changes)


def test_the_short_ways_give_the_scenarios_and_flights_of_the_long_ones(plant, the_long_way):
    seeds = (0, 7, 2**40 + 1, 2**62)
    short = [draw(process, seed) for process in plant.processes.values() for seed in seeds]
    assert all(faults._usual(scenario) is not None for scenario in short)  # it is the short way that is taken
    flown = [s.replace(steps=min(s.steps, 90)) for s in short]
    quick = Flights(plant, flown)
    many = advance(quick, 91)
    the_long_way()
    long = [plainly(process, seed) for process in plant.processes.values() for seed in seeds]
    assert [s.to_json() for s in short] == [s.to_json() for s in long]
    for i, scenario in enumerate(long):
        record = simulate(plant, [FaultScenario.from_json(scenario.replace(steps=min(scenario.steps, 90)).to_json())])
        last = int(record.length[0])
        assert last == quick.length[i]
        for one, all_of_them in zip((record.obs, record.state, record.theta, record.label), many, strict=True):
            assert one[0, : last + 1].tobytes() == all_of_them[: last + 1, i].tobytes()


@pytest.mark.parametrize("field", ["reference", "disturbance", "physical"])
@pytest.mark.parametrize("value", [
    {"a": [1, 2.5, True, None, "x", -0.0]}, {"a": {"b": [1e300]}}, {}, {"a": (1, 2)}, {"a": {1, 2}}, {"a": np.arange(3)},
    {"a": float("nan")}, {"a": [float("inf")]}, {"a": 2**63}, {1: 2}, {"a": [[[[1]]]]}, {"a": b"x"}, {"a": object()}, 3,
    None, [("a", 1)], {"a": 1e301}, {"a": msgspec.UNSET},
], ids=lambda value: type(value).__name__ if "object" in repr(value) else repr(value))  # fmt: skip
def test_the_short_way_takes_and_refuses_what_the_long_way_does(the_long_way, field, value):
    def made():
        try:
            return FaultScenario(plant="X", steps=5, **{field: value}).to_json()
        except (ValueError, TypeError) as error:
            return type(error), str(error)

    short = made()
    the_long_way()
    assert short == made()


def test_a_scenario_shares_nothing_with_what_it_was_made_of():
    given = {"a": [1, {"b": [2]}]}
    fault = faults.Fault("m", "k", 1, [faults.Abrupt("e", 1.0)])
    scenario = FaultScenario(plant="X", steps=5, reference=given, faults=[fault])
    again = scenario.replace()
    given["a"][1]["b"].append(3)
    scenario.faults.clear()
    scenario.reference["a"].clear()
    assert again.reference == {"a": [1, {"b": [2]}]}
    assert again.faults == [fault]


# ---------------------------------------------------------------------------------------------------------------
# Flights that end together

N, STEPS = 32, 60


@pytest.fixture
def short_flights(b747):
    """The 747 in flights of 60 samples; and a list that gets a word for each that is drawn."""
    drawn, process = [], b747.process("standard")

    def sample(rng):
        drawn.append("one")
        return process.sample(rng).replace(steps=STEPS, faults=[])

    plant = dataclasses.replace(b747, processes=(dataclasses.replace(process, sample=sample),))
    return plant, drawn


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_step_draws_a_few_flights_at_most_however_many_end_together(short_flights, mode):
    plant, drawn = short_flights
    envs = FDIVectorEnv(plant, N, autoreset_mode=mode)
    envs.reset(seed=0)
    ended, most = [], 0
    for _ in range(4 * STEPS):
        before = len(drawn)
        _, _, _, truncated, _ = envs.step(np.zeros(N, int))
        most = max(most, len(drawn) - before)
        ended.append(truncated.sum())
    assert max(ended) == N
    assert 0 < most <= 2 * TOGETHER
    assert len(drawn) <= N * (sum(ended) // N + 2) + 1  # none is drawn twice; one for the width of the reference


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda m: m.value)
@pytest.mark.parametrize("between", ["nothing", "pickled", "reset", "seeded"])
def test_prepared_flights_are_those_of_single_environments(short_flights, mode, between):
    """In all modes; travelling, or with other resets in between, when some of the next flights are prepared already."""
    plant, _ = short_flights
    envs, singles = FDIVectorEnv(plant, N, autoreset_mode=mode), [FDIEnv(plant) for _ in range(N)]
    envs.reset(seed=5)
    for i, env in enumerate(singles):
        env.reset(seed=5 + i)
    over, shown = np.zeros(N, bool), [None] * N
    some = np.arange(N) % 3 == 0
    for k in range(2 * STEPS + 30):
        if k in (40, 75) and between == "pickled":
            envs = cloudpickle.loads(cloudpickle.dumps(envs))
        if k in (40, 75) and between in ("reset", "seeded"):
            seeds = [9 * i for i in range(N)] if between == "seeded" else None
            obs, _ = envs.reset(seed=seeds, options={"reset_mask": some})
            for i in np.flatnonzero(some):
                shown[i], _ = singles[i].reset(seed=None if seeds is None else seeds[i])
                assert np.array_equal(obs[i], shown[i])
            over &= ~some
        if mode is AutoresetMode.DISABLED and over.any():
            envs.reset(options={"reset_mask": over.copy()})
            for i in np.flatnonzero(over):
                singles[i].reset()
            over[:] = False
        obs, rewards, _, truncated, _ = envs.step(np.ones(N, int))
        for i, env in enumerate(singles):
            if over[i]:  # NEXT_STEP
                shown[i], _ = env.reset()
                assert np.array_equal(obs[i], shown[i])
                over[i] = False
                continue
            shown[i], reward, _, over[i], _ = env.step(1)
            assert (reward, over[i]) == (rewards[i], truncated[i])
            if over[i] and mode is AutoresetMode.SAME_STEP:
                shown[i], _ = env.reset()
                over[i] = False
            assert np.array_equal(obs[i], shown[i])
    assert [env.scenario for env in singles] == envs.scenarios


def test_a_flight_that_cannot_be_drawn_is_told_when_it_begins(b747):
    process = b747.process("standard")
    doomed = []

    def sample(rng):
        if doomed:
            raise ArithmeticError("no such flight")
        return process.sample(rng).replace(steps=STEPS, faults=[])

    plant = dataclasses.replace(b747, processes=(dataclasses.replace(process, sample=sample),))
    envs = FDIVectorEnv(plant, N, autoreset_mode="SameStep")
    envs.reset(seed=0)
    doomed.append(True)
    for _ in range(STEPS - 1):
        envs.step(np.zeros(N, int))
    with pytest.raises(ArithmeticError, match="no such flight"):
        envs.step(np.zeros(N, int))
