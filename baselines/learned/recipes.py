"""How networks are trained: the recipes of the shipped weights, one per plant, and a general one for any other."""

from __future__ import annotations

from dataclasses import dataclass, replace

from baselines.learned.features import FeatureShape
from baselines.learned.flights import Condition
from fdi_gym.plant import Plant


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What all training has.

    Args:
        conditions: Fault processes, with the options of the plant.
        shape: Of the identified model; a step of the network is `shape.period` samples.
        identify: Flights per condition from which the model is identified, with their truth: the first training flights.
        candidates: Seeds per training flight, from which those are taken that show rare labels.
        hidden: Width of the layers.
        rate: Learning rate at its height.
        validate: Rounds (passes, legs) between validations.
        validation: Flights per condition of the validation.
    """

    conditions: tuple[Condition, ...]
    shape: FeatureShape
    identify: int = 300
    candidates: int = 1
    hidden: int = 64
    rate: float = 3e-3
    validate: int = 8
    validation: int = 100


@dataclass(frozen=True, kw_only=True)
class SequenceRecipe(Recipe):
    """How a recurrent network is trained under supervision.

    Args:
        filters: Diagnosers that the network is shown; training then starts from the network that is shown none.
        flights: Training flights per condition.
        chunk: Flights per condition that are flown together ...
        passes: ... and shown so many times.
        batch: Flights per step of the optimiser.
        decay: Weight decay.
        share: Of the identification task in the loss.
        memory: Of the network: "recurrent" or "attention".
    """

    filters: tuple[str, ...] = ()
    flights: int = 2048
    chunk: int = 64
    passes: int = 4
    batch: int = 32
    decay: float = 1e-2
    share: float = 0.05
    memory: str = "recurrent"


@dataclass(frozen=True, kw_only=True)
class LegsRecipe(Recipe):
    """How a policy is trained by PPO, in legs that begin new flights.

    Args:
        decisions: The budget.
        envs: Environments side by side. Their flights begin together, so `steps` should span whole flights ...
        steps: Decisions of each per update; ... but not their very end, where new flights would begin for nothing.
        updates: Updates per leg.
        epochs: Passes over an update's decisions.
        batch: Decisions per gradient step.
        entropy: Weight of the entropy.
    """

    rate: float = 1e-3
    validation: int = 60
    decisions: int
    envs: int = 64
    steps: int
    updates: int = 1
    epochs: int
    batch: int = 512
    entropy: float


@dataclass(frozen=True, kw_only=True)
class PolicyRecipe(LegsRecipe):
    """How a policy learns to diagnose; the conditions take turns.

    Args:
        task: "isolation" or "identification".
        patience: Of the delay-aware reward, in decisions.
    """

    hidden: int = 128
    task: str = "isolation"
    patience: float = 10.0
    decisions: int = 1_000_000
    steps: int = 250
    epochs: int = 4
    entropy: float = 0.01


MISMATCH = 0.1  # of the plants that a network is trained on that is to bear it: that of the suites
BOTH = (Condition("standard", {}), Condition("hard", {}))
DROPOUT = {"dropout": 0.2, "burst": 10.0}  # of the suites
FURTHER = ("gust",)  # processes beside the first two that a network is trained on, where a plant has them
SEQUENCES = {
    "B747Lateral": SequenceRecipe(
        conditions=BOTH, shape=FeatureShape(stride=4, lags=12, degree=1), flights=6144, validate=16
    ),
    "HUAVHover": SequenceRecipe(
        conditions=(Condition("standard", {"kappa": 0.3}), Condition("hard", {"kappa": 1.0})),
        shape=FeatureShape(stride=5, lags=6, degree=1), flights=10240, candidates=8, validate=16,
    ),
    "MissilePitch": SequenceRecipe(
        conditions=BOTH, shape=FeatureShape(stride=2, lags=8, degree=3, effects=2, every=5),
        identify=200, flights=6144, validate=16,
    ),
    "CMGSatellite": SequenceRecipe(
        conditions=BOTH, shape=FeatureShape(stride=20, lags=2, degree=2, effects=2, every=2),
        identify=100, flights=6144, chunk=64, passes=8, validation=60, validate=32,
    ),
}  # fmt: skip
FILTERS = {  # that residual_net is shown, and training flights per condition: filters cost more than networks
    "B747Lateral": (("onset_bank", "switching_bayes_bank"), 600),
    "HUAVHover": (("overlap_bank", "hypothesis_bank"), 240),
    "MissilePitch": (("onset_bank_fine", "augmented_ekf_imm"), 240),
    "CMGSatellite": (("multiple_model_ekf", "overlap_bank"), 240),
    "ThreeTank": (("onset_bank", "multiple_model_ekf"), 400),
}
SENSOR_FILTERS = {  # the same, where sensors may fail
    "B747Lateral": (("onset_bank", "multiple_model_ekf"), 400),
    "MissilePitch": (("onset_bank", "multiple_model_ekf"), 300),
    "ThreeTank": (("onset_bank", "multiple_model_ekf"), 400),
}
# fault windows in a flight that networks are shown, and their pace: whole flights are long, and its suites are so too
WINDOWS = {"CMGSatellite": {"standard": (3, 0.2), "mixed": (3, 0.1)}}
GAINS = {  # training flights per condition, and passes, of the network that corrects the gain of a filter
    "B747Lateral": {"flights": 12288, "passes": 2},
    "ThreeTank": {"flights": 6144, "passes": 2, "validate": 16},
}
GENERAL_FILTERS = (("augmented_ekf", "multiple_model_ekf"), 300)
POLICIES = {  # steps: decisions of a flight, less one
    "B747Lateral": {"steps": 299, "decisions": 600_000, "entropy": 0.003},
    "HUAVHover": {"steps": 199, "decisions": 1_000_000},
    "MissilePitch": {"steps": 199, "decisions": 800_000},
    "CMGSatellite": {"steps": 249, "decisions": 600_000, "candidates": 4, "epochs": 6, "validate": 6},
}


def sequence_recipe(plant: Plant, budget: int | None = None) -> SequenceRecipe:
    """A plant's recipe, or for one without: its standard and hard processes, or whichever it has beside the healthy one.

    Args:
        plant: The plant.
        budget: Training flights per condition, in place of the recipe's.
    """
    found = SEQUENCES.get(plant.id)
    if found is None:
        names = [name for name in ("standard", "hard") if name in plant.processes]
        names = names or [name for name in plant.processes if name != "fault-free"]
        shape = FeatureShape(stride=5, lags=6, degree=2)
        found = SequenceRecipe(conditions=tuple(Condition(name, {}) for name in names), shape=shape)
    if plant.bare is not None:  # sensors may fail too: the one process that shows all labels
        found = replace(found, conditions=(Condition("mixed", found.conditions[0].options),))
    return found if budget is None else replace(found, flights=budget, chunk=min(found.chunk, budget))


def network_recipe(plant: Plant, budget: int | None = None) -> SequenceRecipe:
    """The recipe of the recurrent network: with more processes, and with samples that go missing.

    Where whole flights are long, it is shown several windows of faults in a shorter one. Where sensors fail there is the one
    process.

    Args:
        plant: The plant.
        budget: Training flights per condition, in place of the recipe's.
    """
    found, cut = sequence_recipe(plant, budget), WINDOWS.get(plant.id, {})
    if plant.bare is None:
        first = found.conditions[0]
        missing = first._replace(options={**first.options, **DROPOUT})
        further = (first._replace(process=name) for name in FURTHER if name in plant.processes)
        found = replace(found, conditions=(*found.conditions, missing, *further), shape=found.shape._replace(shares=True))
    windowed = [c if c.process not in cut else c._replace(windows=cut[c.process][0], pace=cut[c.process][1])
                for c in found.conditions]  # fmt: skip
    return replace(found, conditions=tuple(windowed))


def randomised_recipe(plant: Plant, budget: int | None = None) -> SequenceRecipe:
    """The recipe of the network that is trained on plants off the model; arguments as in `sequence_recipe`."""
    found = network_recipe(plant, budget)
    return replace(found, conditions=tuple(c._replace(mismatch=MISMATCH) for c in found.conditions))


def attention_recipe(plant: Plant, budget: int | None = None) -> SequenceRecipe:
    """The recipe of the network that attends to the last steps; arguments as in `sequence_recipe`."""
    return replace(network_recipe(plant, budget), memory="attention", rate=1e-3)


def residual_recipe(plant: Plant, budget: int | None = None) -> SequenceRecipe:
    """The recipe of the network that is shown filters too; arguments as in `sequence_recipe`."""
    filters, most = (FILTERS if plant.bare is None else SENSOR_FILTERS).get(plant.id, GENERAL_FILTERS)
    flights = most if budget is None else budget
    chunk = min(most, flights)
    return replace(
        network_recipe(plant), filters=filters, identify=100, flights=flights, chunk=chunk, passes=20, validate=2, rate=1e-3
    )


def gain_recipe(plant: Plant, budget: int | None = None) -> SequenceRecipe:
    """The recipe of the network that corrects a filter's gain, in steps of one block; arguments as in `sequence_recipe`."""
    like = sequence_recipe(plant)
    shape = like.shape._replace(stride=like.shape.period, every=1)
    found = replace(like, shape=shape, **{"flights": 2048, "passes": 2, **GAINS.get(plant.id, {})})
    return found if budget is None else replace(found, flights=budget, chunk=min(found.chunk, budget))


def policy_recipe(plant: Plant, task: str, budget: int | None = None) -> PolicyRecipe:
    """How a plant's policy is trained: under the conditions of its recurrent network, seeing the same features.

    Args:
        plant: The plant.
        task: "isolation" or "identification".
        budget: Decisions, in place of the recipe's.
    """
    like = sequence_recipe(plant)
    found = PolicyRecipe(
        **{"conditions": like.conditions, "shape": like.shape, "identify": like.identify, "candidates": like.candidates}
        | POLICIES.get(plant.id, {})
    )
    if task == "identification":
        found = replace(found, task=task, entropy=0.0, decisions=2_000_000)
    return found if budget is None else replace(found, decisions=budget)
