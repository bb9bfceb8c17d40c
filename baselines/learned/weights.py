"""Weights on disk: a safetensors file, and beside it a card that says what they are, for what, and where they came from.

Nothing that can run code is ever read: pickles and zip archives (a torch or stable-baselines3 file) are refused by their
first bytes, whatever they are called.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shlex
import subprocess
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from baselines.learned.features import FeatureModel, FeatureShape
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.files import RefusedError, read_bytes, read_json, write_whole
from fdi_gym.plant import Array, NotApplicableError, Plant

WEIGHTS = Path(__file__).parent / "weights"

# upper ends of what a card may ask for, so that no card makes the building of a network take all memory
SIZES = {"stride": 1000, "lags": 1000, "degree": 3, "effects": 3, "every": 1000, "hidden": 1024}
LARGEST, LARGEST_CARD = 2**28, 2**20  # bytes
MISSING = "-dropout"  # ends the name of a process whose samples go missing


class ProbabilityCalibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A calibration for one process.

    Args:
        scale, bias: Of the logits; one bias per label.
        prior: Share of each label in training flights.
        log_score, calibration_error: On the validation flights, with the prior alone and calibrated.

    Raises:
        ValueError: A number out of range.
    """

    scale: float
    bias: list[float]
    prior: list[float]
    log_score: tuple[float, float]
    calibration_error: tuple[float, float]

    def __post_init__(self) -> None:
        if not 0 < self.scale < 1e6 or any(abs(value) > 1e6 for value in self.bias):
            raise ValueError("a calibration's scale is above 0, and its numbers are below a million")
        if any(not 0 <= value <= 1 for value in self.prior) or not sum(self.prior) > 0:
            raise ValueError("a calibration's prior is made of shares from 0 to 1")


class Card(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What weights are.

    Args:
        method: The name of the trainer that made them.
        env: Environment id, with its version; weights of another version are refused.
        plant: Plant id.
        options: Options of the plant, one dict per process that they were trained on.
        processes: The fault processes, in the order in which the network is told of them: names of `flights.Condition`.
        labels, observed, estimated: Names, in order.
        task: "isolation", "identification" or "both".
        shape: What the network is made of.
        filters: The diagnosers that it is shown.
        mismatch: How far the plants were off the model that it was trained on.
        windows, paces: Of each process: fault windows in a flight, and the factor on their times; empty for whole flights.
        seeds: First and last seed of the training, validation and calibration flights.
        budget: What was used: flights, samples, steps, seconds.
        curve: The training curve: one entry per validation.
        calibration: Per process what was fitted on the calibration flights.
        command: What to type to train them again.
        revision: Git revision of the code, or "".
        versions: Of the libraries.
        sha256: Digest of the weight file.

    Raises:
        ValueError: No process, or more filters than any network is shown.
    """

    schema: Literal[1] = 1
    method: str
    env: str
    plant: str
    options: list[dict[str, Any]]
    processes: list[str]
    labels: list[str]
    observed: list[str]
    estimated: list[str]
    task: str
    shape: dict[str, Any]
    filters: list[str] = []
    mismatch: float = 0.0
    windows: list[int] = []
    paces: list[float] = []
    seeds: dict[str, list[int]]
    budget: dict[str, float]
    curve: list[dict[str, Any]]
    calibration: dict[str, ProbabilityCalibration] = {}
    command: str
    revision: str
    versions: dict[str, str]
    sha256: str = ""

    def expected(self, process: str) -> str:
        """The process that a method expects which is told this one: that, or the first where it was not trained on it."""
        return process if process in self.processes else self.processes[0]

    def condition(self, plant: Plant, process: str) -> str:
        """What it is told that expects this process: also that samples go missing, where it was trained on that."""
        missing = process + MISSING
        return missing if plant.regular is not None and missing in self.processes else process

    def __post_init__(self) -> None:
        if not 1 <= len(self.processes) <= 100 or len(set(self.processes)) < len(self.processes):
            raise ValueError("weights are for 1 to 100 different processes")
        if len(self.filters) > 16:
            raise ValueError("a network is shown up to 16 filters")


def names(plant: Plant) -> dict[str, list[str]]:
    """The names that a card and a plant must share."""
    return {
        "labels": [label.name for label in plant.labels],
        "observed": [s.name for s in plant.observed],
        "estimated": [s.name for s in plant.estimated],
    }


def made_with() -> tuple[str, dict[str, str]]:
    """The git revision of this code ("" outside a repository), and the versions of the libraries."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    found = {}
    for name in ("fdi-gym", "torch", "numpy", "scipy", "scikit-learn", "safetensors"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return done.stdout.strip(), found


def write(path: Path, tensors: dict[str, Array], card: Card) -> None:
    """Write weights and their card, `path` with .safetensors and with .json."""
    from safetensors.numpy import save

    content = save({name: np.asarray(a, order="C") for name, a in tensors.items()})
    card = msgspec.structs.replace(card, sha256=hashlib.sha256(content).hexdigest())
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path.with_suffix(".safetensors"), content)
    write_whole(path.with_suffix(".json"), msgspec.json.format(msgspec.json.encode(card), indent=1) + b"\n")


def stem(method: str, plant: Plant) -> str:
    """The name of a method's weights for a plant; where its sensors may fail they are others."""
    return f"{method}-{plant.id}" + ("" if plant.bare is None else "-sensors")


def command(method: str, plant: Plant, budget: int | None, seed: int) -> str:
    """What to type to train the same weights again."""
    usual = load_plant(plant.id).options if plant.id in plant_sources() else {}
    options = [
        f"{name} {shlex.quote(value if isinstance(value, str) else json.dumps(value))}"
        for name, value in plant.options.items() if name not in usual or usual[name] != value
    ]  # fmt: skip
    parts = ["fdi-gym train", method, plant.id, "--options" if options else "", *options,
             f"--budget {budget}" if budget else "", f"--seed {seed}" if seed else ""]  # fmt: skip
    return " ".join(part for part in parts if part)


def deliver(
    method: str, plant: Plant, recipe: Any, seed: int, work: Path, tensors: dict[str, Array], command: str, **card: Any
) -> Path:  # fmt: skip
    """Write the weights of a method that learns in one go, and their card; their path.

    Args:
        method: Name of the trainer.
        plant: The plant.
        recipe: The flights that it was shown (`recipes.SequenceRecipe`).
        seed: Of the run.
        work: Folder of runs.
        tensors: What was learned.
        command: For the card.
        card: What the card says beyond what every card says.
    """
    from baselines.learned.flights import PER_SEED, TRAINING, VALIDATION, plant_under

    revision, versions = made_with()
    first = TRAINING + PER_SEED * seed
    last = first + recipe.identify + recipe.flights * recipe.candidates - 1
    seeds = {"training": [first, last], "validation": [VALIDATION, VALIDATION + recipe.validation - 1]}
    found = Card(
        method=method, env=plant.env_id, plant=plant.id,
        options=[dict(plant_under(plant, c).options) for c in recipe.conditions],
        processes=[c.name for c in recipe.conditions], **names(plant),  # type: ignore[arg-type]
        seeds=seeds | card.pop("seeds", {}), command=command, revision=revision, versions=versions, **card,
    )  # fmt: skip
    path = work / f"{stem(method, plant)}-{seed}" / f"{stem(method, plant)}.safetensors"
    write(path, tensors, found)
    return path


def read_tensors(path: Path) -> dict[str, Array]:
    """The tensors of a safetensors file.

    Raises:
        RefusedError: Another kind of file, or a value that is not a finite floating-point number.
    """
    return _tensors(path, _content(path))


def _content(path: Path) -> bytes:
    if path.suffix != ".safetensors":
        raise RefusedError(f"{path}: weights are .safetensors files, not {path.suffix or 'without a suffix'}")
    return read_bytes(path, LARGEST)


def _tensors(path: Path, content: bytes) -> dict[str, Array]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    for magic, what in ((b"\x80", "a pickle"), (b"PK", "a zip archive (torch or stable-baselines3)")):
        if content.startswith(magic) and not content[8:9] == b"{":
            raise RefusedError(f"{path} is {what}, which can run code when it is read; weights are safetensors")
    try:
        tensors = load(content)
    except (SafetensorError, ValueError, TypeError, KeyError, OverflowError) as error:
        raise RefusedError(f"{path} is not a safetensors file: {error}") from error
    for name, value in tensors.items():
        if value.dtype.kind != "f":
            raise RefusedError(f"{path}: {name} is made of {value.dtype}, not of floating-point numbers")
        if not np.isfinite(value).all():
            raise RefusedError(f"{path}: {name} holds values that are not finite")
    return tensors


def read_card(path: Path) -> Card:
    """The card beside the weights.

    Raises:
        RefusedError: There is none, or it is not a card.
    """
    try:
        return read_json(path.with_suffix(".json"), Card, "card", LARGEST_CARD)
    except OSError as error:
        raise RefusedError(f"{path.with_suffix('.json')} is not a card: {error.strerror}") from error


def read(path: Path, plant: Plant) -> tuple[dict[str, Array], Card]:
    """Weights for a plant, checked against their card.

    Raises:
        RefusedError: The file, the card, or the two together are not what they should be.
        NotApplicableError: They are, but for another plant or other options, beside those that say how sensors report.
    """
    content = _content(path)
    tensors, card = _tensors(path, content), read_card(path)
    if hashlib.sha256(content).hexdigest() != card.sha256:
        raise RefusedError(f"{path}: the card belongs to another file: the digest differs")
    if card.env != plant.env_id:
        raise NotApplicableError(f"{path.name} was trained for {card.env}, not for {plant.env_id}")
    for name, here in names(plant).items():
        if getattr(card, name) != here:
            raise NotApplicableError(f"{path.name} was trained with the {name} {getattr(card, name)}, not {here}")
    as_trained = (plant, plant if plant.regular is None else plant.regular)  # samples may be missing that were not then
    if not any(dict(one.options) in card.options for one in as_trained):
        raise NotApplicableError(f"{path.name} was trained with the options {card.options}, not {dict(plant.options)}")
    return tensors, card


def find(method: str, plant: Plant, path: str = "") -> tuple[Path, dict[str, Array], Card]:
    """The weights of a method for a plant: those at a path, or else those that ship.

    Returns:
        their file, their tensors and their card

    Raises:
        NotApplicableError: There are none for this plant and its options.
        RefusedError: As `read`.
    """
    file = Path(path) if path else WEIGHTS / f"{stem(method, plant)}.safetensors"
    if not file.exists():
        raise NotApplicableError(f"no trained weights for {plant.id}; train them: {command(method, plant, None, 0)}")
    return file, *read(file, plant)


def model_of(tensors: Mapping[str, Array]) -> FeatureModel:
    """The identified model among the tensors."""
    return FeatureModel(*(tensors[f"model.{name}"] for name in FeatureModel._fields))


def model_tensors(model: FeatureModel) -> dict[str, Array]:
    """The identified model as tensors."""
    return {f"model.{name}": value for name, value in model._asdict().items()}


def shape_of(path: Path, card: Card) -> tuple[FeatureShape, int]:
    """The shape of the identified model and the width of the layers, as the card gives them.

    Raises:
        RefusedError: One is missing, or not a whole number above 0 and up to its upper end, or not true or false.
    """
    defaults = {**FeatureShape._field_defaults, **card.shape}
    card = msgspec.structs.replace(card, shape=defaults)
    if type(shares := defaults["shares"]) is not bool:
        raise RefusedError(f"{path.with_suffix('.json')}: the shape's shares is true or false, not {str(shares)[:80]!r}")
    sizes = {name: whole_number(path, card, name, most) for name, most in SIZES.items()}
    hidden = sizes.pop("hidden")
    return FeatureShape(**sizes, shares=shares), hidden


def whole_number(path: Path, card: Card, name: str, most: int) -> int:
    """A size that the card's shape gives.

    Raises:
        RefusedError: It is missing, or not a whole number from 1 to `most`.
    """
    value = card.shape.get(name)
    if type(value) is not int or not 1 <= value <= most:
        what = f"a whole number above 0, up to {most}"
        raise RefusedError(f"{path.with_suffix('.json')}: the shape's {name} is {what}, not {str(value)[:80]!r}")
    return value


def calibration_of(path: Path, card: Card, process: str) -> ProbabilityCalibration:
    """The calibration for a process.

    Raises:
        RefusedError: There is none, or not one entry per label.
    """
    found = card.calibration.get(process)
    if found is None or not len(found.bias) == len(found.prior) == len(card.labels):
        raise RefusedError(f"{path.with_suffix('.json')} has no calibration of {len(card.labels)} labels for {process!r}")
    return found


def check_tensors(path: Path, tensors: dict[str, Array], expected: dict[str, tuple[int, ...]]) -> None:
    """Make sure that the tensors are those of a network, by name and shape.

    Raises:
        RefusedError: One is missing, one too many, or of another shape.
    """
    for name in sorted(expected.keys() - tensors.keys()):
        raise RefusedError(f"{path} lacks the tensor {name}")
    for name in sorted(tensors.keys() - expected.keys()):
        raise RefusedError(f"{path} has a tensor {name} that the network does not have")
    for name, shape in expected.items():
        if tensors[name].shape != shape:
            raise RefusedError(f"{path}: {name} has the shape {tensors[name].shape}, the network needs {shape}")
