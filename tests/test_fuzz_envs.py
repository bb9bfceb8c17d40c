"""Whatever is done to an environment is done, or refused by a documented exception, and loses nothing."""

import copy
import pickle

import numpy as np
import pytest
from conftest import PLANTS, build
from gymnasium.vector import AutoresetMode

from fdi_gym.envs import FDIEnv
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.sb3 import FDIVecEnv
from fdi_gym.tasks import TASKS
from fdi_gym.vector_envs import FDIVectorEnv

N = 3
DOCUMENTED = (ValueError, TypeError, RuntimeError)  # RuntimeError: no episode has begun, or it is over
SEEDS = [None, 0, 7, np.int64(3), np.uint8(200), -1, 1.5, "3", True, np.bool_(False), [], [1, 2], [1, None, 3], (0, 0, 0),
         np.array([4, 5, 6]), np.array([1.0, 2.0, 3.0]), [1, -2, 3], 2**80, float("nan"), object()]  # fmt: skip
MASKS = [np.array([True, False, True]), np.ones(N, bool), np.zeros(N, bool), np.ones(N, int), [True] * N, None,
         "all", np.ones(N + 1, bool), np.ones((N, 1), bool)]  # fmt: skip
ACTIONS = [0, 1, np.int32(2), -1, 99, 0.5, True, np.bool_(True), None, "none", np.nan, [], [0], {}, np.zeros(N, int),
           [0, 1, 2], [True, 0, 1], np.zeros(N), np.zeros(N, bool), np.array([0, 1, 10**6]), np.uint64(2**64 - 1), 2**100,
           [[0], [1, 2]], np.array(["a"] * N), np.full(N, 2), 1 + 2j, object(), np.full((N, 4), 1e300),
           np.full(4, np.inf)]  # fmt: skip


def scenario_like(plant, rng):
    """Something that may be taken for a scenario of this plant."""
    good = draw(plant.process("standard"), int(rng.integers(100))).replace(steps=int(rng.integers(1, 40)), faults=[])
    other = draw(build(PLANTS[0] if plant.id != PLANTS[0] else PLANTS[1]).process("standard"), 0)
    choices = [good, good, good.to_json(), other, other.to_json(), "{", "", 3, {"plant": plant.id}, None]
    return choices[rng.integers(len(choices))]


def options_like(plant, rng, several):
    keys = rng.choice(["scenario", "reset_mask", "mask", "seed", "Scenario"], size=rng.integers(0, 3), replace=False,
                      p=[0.5, 0.3 if several else 0.1, 0.1, 0.05, 0.05 if several else 0.25])  # fmt: skip
    values = {"scenario": scenario_like(plant, rng), "reset_mask": MASKS[rng.integers(len(MASKS))]}
    found = {str(key): values.get(str(key), 1) for key in keys}
    return [found, found, found, None, {}, [], "scenario", 5][rng.integers(8)]


def action_like(space, rng):
    """A good action half of the time."""
    return space.sample() if rng.random() < 0.5 else ACTIONS[rng.integers(len(ACTIONS))]


class Single:
    """One environment; every call is also made on a twin that is a copy of it."""

    def __init__(self, plant, rng):
        task = list(TASKS)[rng.integers(len(TASKS))]
        self.plant, self.env = plant, FDIEnv(plant.id, task=task, decision_period=int(rng.choice([1, 3])))

    def calls(self, rng, several=False):
        seed, options = SEEDS[rng.integers(len(SEEDS))], options_like(self.plant, rng, several)
        action, good = action_like(self.env.action_space, rng), self.env.action_space.sample()
        return {
            "reset": lambda env: env.reset(seed=seed, options=options),
            "step": lambda env: env.step(action),
            "good": lambda env: env.step(good),
            "seed": lambda env: env.np_random_seed,
            "close": lambda env: env.close(),
        }


class Many(Single):
    """Vector environments in all autoreset modes."""

    def __init__(self, plant, rng):
        task = list(TASKS)[rng.integers(len(TASKS))]
        mode = list(AutoresetMode)[rng.integers(3)]
        period = int(rng.choice([1, 3]))
        self.plant, self.env = plant, FDIVectorEnv(plant.id, N, task, decision_period=period, autoreset_mode=mode)

    def calls(self, rng, several=True):
        short = draw(self.plant.process("standard"), 1).replace(steps=2, faults=[])
        return super().calls(rng, several) | {
            "short": lambda env: env.reset(options={"scenario": short}),
            "truth": lambda env: env.truth(),
        }


class Bridge(Single):
    """The bridge to stable-baselines3."""

    def __init__(self, plant, rng):
        self.plant = plant
        self.env = FDIVecEnv(
            FDIVectorEnv(plant.id, N, autoreset_mode="SameStep", units="scaled", truth=bool(rng.integers(2)))
        )

    def calls(self, rng, several=True):
        some = [None, 0, [0], [0, 2], [1, 1], N, -1, "0", [0.5], [], True, np.int64(1)][rng.integers(12)]
        seed = SEEDS[rng.integers(10)]
        options = options_like(self.plant, rng, True)
        action, good = action_like(self.env.envs.action_space, rng), self.env.envs.action_space.sample()
        name = ["reset", "render", "step", "close_extras", "truth", "get_wrapper_attr"][rng.integers(6)]

        def one(env):
            how = {"seed": seed, "options": options} if name == "reset" else {}
            what = ("scenario",) if name == "get_wrapper_attr" else ()
            return env.env_method(name, *what, indices=some, **how)

        return {
            "reset": lambda env: env.reset(),
            "seed": lambda env: env.seed(seed),
            "options": lambda env: env.set_options(options),
            "step": lambda env: env.step(action),
            "good": lambda env: env.step(good),
            "method": one,
            "scenario": lambda env: env.get_attr("scenario", some),
            "set": lambda env: env.set_attr("note", 1, some),
            "truth": lambda env: env.truth,
        }


def same(left, right):
    """Equal answers, to the byte, however nested."""
    assert type(left) is type(right)
    if isinstance(left, np.ndarray) and left.dtype != object:
        assert left.tobytes() == right.tobytes()
    elif isinstance(left, dict):
        assert left.keys() == right.keys()
        for key in left:
            same(left[key], right[key])
    elif isinstance(left, (tuple, list, np.ndarray)):
        assert len(left) == len(right)
        for a, b in zip(left, right, strict=True):
            same(a, b)
    elif isinstance(left, (bool, int, float, str, FaultScenario, np.generic, type(None))):
        assert left == right or left != left  # NaN


def answer(call, env):
    try:
        return call(env)
    except DOCUMENTED as refusal:
        return f"{type(refusal).__name__}: {len(str(refusal)) > 0}"


def fuzz(calls, seed):
    rng = np.random.default_rng(seed)
    subject, twin = None, None
    answered = refused = 0
    for number in range(calls):
        if subject is None or rng.random() < 0.02:
            kind = [Single, Many, Bridge][rng.integers(3)]
            subject = kind(build(PLANTS[rng.integers(len(PLANTS))]), rng)
            subject.env.action_space.seed(number)
            subject.env.reset() if kind is Bridge and rng.random() < 0.5 else None
            twin = None
        if twin is None and subject.env is not None and rng.random() < 0.3:
            travel = copy.deepcopy if rng.random() < 0.5 else lambda env: pickle.loads(pickle.dumps(env))
            try:
                twin = travel(subject.env)
            except DOCUMENTED:
                raise AssertionError("an environment does not travel") from None
        possible = subject.calls(rng)
        names = list(possible)
        name = names[rng.integers(len(names))] if rng.random() < 0.6 else "good"
        said = answer(possible[name], subject.env)
        refused += isinstance(said, str)
        assert not isinstance(said, str) or said.endswith("True"), "a refusal says what was wrong"
        answered += not isinstance(said, str)
        unseeded = name in (
            "reset",
            "short",
            "method",
            "seed",
            "options",
            "scenario",
        )  # draws from the system, where no seed was given
        if twin is not None and not unseeded:
            same(said, answer(possible[name], twin))
            if rng.random() < 0.2:
                twin = None
        elif unseeded:
            twin = None
    return answered, refused


@pytest.mark.parametrize("seed", range(2))
def test_calls_of_every_kind(seed):
    answered, refused = fuzz(350, seed)
    assert min(answered, refused) > 50  # both happened


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 120))
def test_many_calls_of_every_kind(seed):
    answered, refused = fuzz(2000, seed)
    assert min(answered, refused) > 200
