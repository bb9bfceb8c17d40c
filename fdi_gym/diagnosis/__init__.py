"""Diagnosers: the contract, the filters' contract, the guard, the registry of all methods, and what is fitted for them."""

from fdi_gym.diagnosis.contract import Decisions, Diagnoser, Diagnosis, run
from fdi_gym.diagnosis.filtering import Filter, diagnoser_of
from fdi_gym.diagnosis.fitting import fit
from fdi_gym.diagnosis.guard import guarded
from fdi_gym.diagnosis.making import make_diagnoser, train
from fdi_gym.diagnosis.registry import (
    Entry,
    broken_plugins,
    diagnoser,
    diagnosers,
    find_diagnoser,
    find_prober,
    find_trainer,
    named,
    prober,
    probers,
    trainer,
    trainers,
)  # fmt: skip
from fdi_gym.plant import NotApplicableError

__all__ = [
    "Decisions", "Diagnoser", "Diagnosis", "Entry", "Filter", "NotApplicableError",
    "broken_plugins", "diagnoser", "diagnoser_of", "diagnosers", "find_diagnoser", "find_prober",
    "find_trainer", "fit", "guarded",
    "make_diagnoser", "named", "prober", "probers", "run", "train", "trainer", "trainers",
]  # fmt: skip
