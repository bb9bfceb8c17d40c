"""Diagnosers built, and trained, by name: each gets what it takes, and what fails is named."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fdi_gym.diagnosis.contract import Diagnoser, widened
from fdi_gym.diagnosis.guard import guarded
from fdi_gym.diagnosis.knowledge import knowledge_of
from fdi_gym.diagnosis.registry import find_diagnoser, find_trainer
from fdi_gym.names import blame, blamed
from fdi_gym.plant import NotApplicableError, Plant

_EXTRA = {**dict.fromkeys(("torch", "stable_baselines3", "safetensors", "tensorboard"), "learn"), "sklearn": "trees"}


def make_diagnoser(
    name: str, plant: Plant, *, process: str = "standard", scenarios: Sequence[Any] | None = None, **tuning: Any
) -> Diagnoser:
    """A diagnoser by name, for a plant and one of its fault processes, under the guard (see `guarded`).

    What it believes and when it alarms is what `fdi_gym.diagnosis.fitting` found for that process: shipped where it is, else
    found when it is first asked for.

    Args:
        name: As in `find_diagnoser`.
        plant: The plant whose model it gets.
        process: The fault process that it will meet.
        scenarios: The truth, one per episode; only a clairvoyant one gets it.
        tuning: Keyword arguments of its builder, over those of the name, which are over its paper's own for the plant.

    Raises:
        ValueError: Unknown name, process or keyword; `NotApplicableError` where the method cannot run on this plant, or
            a library that it needs is not installed.
    """
    entry = find_diagnoser(name)
    plant.process(process)
    shown, (plant, process) = plant, entry.told(plant, process)
    settings = entry.resolve(plant, **tuning)
    given: dict[str, Any] = {"process": process} if entry.takes("process") else {}
    if entry.clairvoyant:
        if scenarios is None:
            raise NotApplicableError(f"{name} knows the truth: it needs scenarios, one per episode")
        given["scenarios"] = scenarios
    try:
        given |= knowledge_of(entry, plant, process, settings)
        built = entry.build(plant, **given, **settings)
    except ValueError:
        raise
    except ModuleNotFoundError as error:
        raise _missing(error) from error
    except Exception as error:
        raise ValueError(f"the builder of {name} failed: {blame(error)}") from error
    if not isinstance(built, Diagnoser):
        raise ValueError(f"the builder of {name} gives {type(built).__name__}, not a Diagnoser")
    return guarded(built if plant is shown else widened(built, plant, shown), shown)


def train(
    name: str,
    plant: Plant,
    *,
    budget: int | None = None,
    seed: int = 0,
    work: Path = Path("runs"),
    threads: int = 1,
    **settings: Any,
) -> Path:
    """Train a diagnoser for a plant; the path of its weights.

    Args:
        name: As in `find_trainer`.
        plant: The plant, with its options.
        budget: How much to train, in the trainer's own measure; None for its recipe's.
        seed: Of the run.
        work: Folder of runs; one that was killed goes on.
        threads: Of the library that trains.
        settings: Keyword arguments of the trainer, over those of the name.

    Raises:
        ValueError: Unknown trainer or keyword, a number out of range, or the trainer fails (it is named);
            `NotApplicableError` where it cannot train for this plant, or a library that it needs is not installed.
    """
    for what, value, least in (("budget", budget, 1), ("seed", seed, 0), ("threads", threads, 1)):
        if value is not None and value < least:
            raise ValueError(f"{what} is {least} or more, not {value}")
    entry = find_trainer(name)
    if budget is not None and not entry.takes("budget"):
        raise ValueError(f"{name} takes no budget")
    given = {"budget": budget, "seed": seed, "work": work, "threads": threads}
    given = {argument: value for argument, value in given.items() if entry.takes(argument)}
    settings = entry.resolve(plant, **settings)
    with blamed(name):
        try:
            path = entry.build(plant, **given, **settings)
        except ModuleNotFoundError as error:
            raise _missing(error) from error
    if not isinstance(path, Path) or not path.with_suffix(".safetensors").is_file():
        raise ValueError(f"{name} gives {path!r}, not the path of weights")
    return path


def _missing(error: ModuleNotFoundError) -> NotApplicableError:
    library = (error.name or str(error)).split(".")[0]
    remedy = f": pip install 'fdi-gym[{_EXTRA[library]}]'" if library in _EXTRA else ", which is not installed"
    return NotApplicableError(f"needs {library}{remedy}")
