"""Suites, and the evaluation of diagnosers on them: block by block, in parallel, resumable.

A suite is a frozen JSON file: which environment, which fault process, which seeds. Its content hash travels with every
result. Episodes are flown and diagnosed in blocks; a finished block is one file, written whole and then renamed, so a
killed run goes on where it was and ends with the same rows.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import platform
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import msgspec
from tqdm import tqdm

from fdi_gym.diagnosis import NotApplicableError, find_diagnoser, make_diagnoser, run, told
from fdi_gym.engine import simulate
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.metrics import Outcome, outcome, summarise
from fdi_gym.plant import Plant, load_plant

BLOCK = 50  # episodes flown and diagnosed together
_PACKAGED = Path(__file__).parent / "suites"
_CHECKOUT = Path(__file__).parent.parent / "leaderboards" / "suites"
SUITES = _CHECKOUT if _CHECKOUT.is_dir() else _PACKAGED


def digest(value: Any) -> str:
    """SHA-256 of the value's canonical JSON."""
    return hashlib.sha256(msgspec.json.encode(value, order="sorted")).hexdigest()


def scenarios_digest(scenarios: Sequence[FaultScenario]) -> str:
    """Digest of scenarios to nine digits: another machine's last bits don't matter, another sampler does."""

    def rounded(value: Any) -> Any:
        if isinstance(value, float):
            return f"{value:.9g}"
        if isinstance(value, dict):
            return {key: rounded(entry) for key, entry in value.items()}
        return [rounded(entry) for entry in value] if isinstance(value, list) else value

    return digest([rounded(msgspec.to_builtins(scenario)) for scenario in scenarios])


class Suite(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is run.

    Args:
        name: Name of the file, without ".json".
        description: One line for the table.
        env: Environment id; "module:id" where the module registers it.
        plant: Plant id.
        options: Options of the plant.
        scenario: Name of the fault process.
        mismatch: Level of mismatch, or None for what the process prescribes.
        first_seed, episodes: The public seeds are first_seed, first_seed + 1, ...
        settings: Per diagnoser, tuning that belongs to this suite (the prior of an oracle).
        scenarios_sha256: Digest of the drawn scenarios: a changed sampler shows.
        sha256: Digest of all the rest of this file.
    """

    name: str
    description: str
    env: str
    plant: str
    options: dict[str, Any]
    scenario: str
    mismatch: float | None
    first_seed: int
    episodes: int
    settings: dict[str, dict[str, Any]]
    scenarios_sha256: str = ""
    sha256: str = ""

    def content_sha256(self) -> str:
        """The digest that `sha256` must equal."""
        return digest({k: v for k, v in msgspec.structs.asdict(self).items() if k != "sha256"})

    def sealed(self) -> Suite:
        """The suite with its digests, computed."""
        drawn = scenarios_digest(self.scenarios(self.build(), range(self.episodes)))
        suite = msgspec.structs.replace(self, scenarios_sha256=drawn)
        return msgspec.structs.replace(suite, sha256=suite.content_sha256())

    def head(self, episodes: int) -> Suite:
        """The first episodes as a suite of their own, for a quick look; its rows are not rows of this one."""
        return msgspec.structs.replace(self, name=f"{self.name}-{episodes}", episodes=episodes).sealed()

    def build(self) -> Plant:
        """The plant."""
        if ":" in self.env:
            importlib.import_module(self.env.split(":")[0])
        return load_plant(self.plant, **self.options)

    def scenarios(self, plant: Plant, episodes: Sequence[int]) -> list[FaultScenario]:
        """The scenarios of these episodes (0, 1, ...): those of `reset(seed=first_seed + i)`."""
        process, perturb = plant.process(self.scenario), None
        if self.mismatch is not None:
            assert plant.perturb is not None
            perturb = lambda rng: plant.perturb(rng, self.mismatch)  # type: ignore[misc]  # noqa: E731
        return [draw(process, self.first_seed + i, perturb) for i in episodes]


def suite_names() -> list[str]:
    """Names of the suites that ship with the package."""
    return sorted(path.stem for path in SUITES.glob("*.json"))


def load_suite(name: str) -> Suite:
    """A suite by name, or from a path that ends in ".json".

    Raises:
        ValueError: No such suite, or its file was edited after it was frozen.
    """
    path = Path(name) if name.endswith(".json") else SUITES / f"{name}.json"
    if not path.is_file():
        raise ValueError(f"unknown suite {name!r}; there are {', '.join(suite_names()) or 'none'}")
    try:
        suite = msgspec.json.decode(path.read_bytes(), type=Suite)
    except msgspec.DecodeError as error:
        raise ValueError(f"{path} is not a suite: {error}") from error
    if suite.sha256 != suite.content_sha256():
        raise ValueError(
            f"{path} was edited after it was frozen: its hash is {suite.content_sha256()[:12]}, it says {suite.sha256[:12]}"
        )
    return suite


def freeze(suite: Suite, folder: Path = SUITES) -> Path:
    """Write a suite with its digests. A frozen suite is not changed: a different one needs another name.

    Raises:
        ValueError: A suite of that name and another content exists.
    """
    suite = suite.sealed()
    path = folder / f"{suite.name}.json"
    if path.exists() and msgspec.json.decode(path.read_bytes(), type=Suite).sha256 != suite.sha256:
        raise ValueError(f"{path} is frozen with another content; choose another name")
    path.write_bytes(msgspec.json.format(msgspec.json.encode(suite), indent=2) + b"\n")
    return path


class Block(msgspec.Struct, frozen=True):
    """What one diagnoser made of one block of episodes."""

    outcomes: list[Outcome]
    seconds: float  # of processor time
    samples: int


class Row(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One entry of a leaderboard: everything that is needed to check it.

    `metrics` follows from `outcomes` alone; `sha256` is the digest of the rest. The time per sample is not in the row,
    since no second run gives it again: it is beside it, in timing.json.
    """

    schema: int = 1
    suite: str
    suite_sha256: str
    diagnoser: str
    summary: str
    settings: dict[str, Any]
    clairvoyant: bool
    versions: dict[str, str]
    command: str
    metrics: dict[str, Any]
    outcomes: list[Outcome]
    sha256: str = ""

    def content_sha256(self) -> str:
        """The digest that `sha256` must equal."""
        return digest({k: v for k, v in msgspec.structs.asdict(self).items() if k != "sha256"})


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is either there whole or not there."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.write_bytes(content)
    part.replace(path)


def settings_of(suite: Suite, name: str) -> dict[str, Any]:
    """A diagnoser's tuning on a suite: its own settings, the suite's, and the fault process if it asks for one.

    Which process will be met is known to a method as the plant is: it may learn from flights of its own seeds.
    """
    entry = find_diagnoser(name)
    return {**told(name, suite.scenario), **entry.settings, **suite.settings.get(name, {})}


def diagnose(suite: Suite, plant: Plant, name: str, episodes: Sequence[int], record: Any = None) -> Block:
    """Fly episodes of a suite, diagnose them and reduce them to outcomes.

    Raises:
        NotApplicableError: The method cannot run on this plant.
    """
    scenarios = suite.scenarios(plant, episodes)
    diagnoser = make_diagnoser(name, plant, scenarios=scenarios, **settings_of(suite, name))
    record = simulate(plant, scenarios) if record is None else record
    diagnoser.update(diagnoser.init(len(scenarios)), record.obs[:, 0])  # what is compiled or calibrated once is not timed
    start = time.process_time()
    said = run(diagnoser, record.obs)
    seconds = time.process_time() - start
    scoring = plant.process(suite.scenario).scoring
    outcomes = [outcome(plant, scoring, record, said, i) for i in range(len(scenarios))]
    return Block(outcomes, seconds, int((record.length + 1).sum()))


def _blocks(suite: Suite, size: int) -> list[range]:
    return [range(i, min(i + size, suite.episodes)) for i in range(0, suite.episodes, size)]


def _block_path(folder: Path, name: str, index: int) -> Path:
    return folder / name.replace(":", ".") / f"block-{index:04d}.json"


def _run_block(suite: Suite, names: Sequence[str], index: int, episodes: range, folder: Path) -> int:
    """Fly one block once and show it to every diagnoser that has not seen it."""
    missing = [name for name in names if not _block_path(folder, name, index).exists()]
    if missing:
        plant = suite.build()
        record = simulate(plant, suite.scenarios(plant, episodes))
        for name in missing:
            path = _block_path(folder, name, index)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, msgspec.json.encode(diagnose(suite, plant, name, episodes, record)))
    return len(missing)


def _source_digest(names: Sequence[str]) -> str:
    """Digest of sources and weights that results depend on: blocks that others made are not resumed from."""
    found = hashlib.sha256()
    modules = {find_diagnoser(name).build.__module__.split(".")[0] for name in names} | {"fdi_gym"}
    for module in sorted(modules):
        home = Path(importlib.import_module(module).__file__ or "")
        files = (p for kind in ("*.py", "*.safetensors") for p in home.parent.rglob(kind))
        for path in sorted(files) if home.stem == "__init__" else [home]:
            found.update(path.name.encode() + b"\0" + path.read_bytes())
    return found.hexdigest()


def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    return {"python": platform.python_version()} | {name: version(name) for name in ("fdi-gym", "numpy", "scipy", "numba")}


def applicable(suite: Suite, plant: Plant, names: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """The diagnosers that can run on the suite's plant, and for the others the reason why not."""
    able, reasons = [], {}
    scenarios = suite.scenarios(plant, [0])
    for name in names:
        try:
            make_diagnoser(name, plant, scenarios=scenarios, **settings_of(suite, name))
            able.append(name)
        except NotApplicableError as error:
            reasons[name] = str(error)
    return able, reasons


def evaluate(
    suite: Suite,
    names: Sequence[str],
    *,
    work: Path,
    jobs: int = -1,
    progress: bool = True,
    command: str = "",
    block: int = BLOCK,
) -> tuple[dict[str, Row], dict[str, float]]:
    """Rows of diagnosers on a suite, and their microseconds per sample.

    Args:
        suite: The suite.
        names: Diagnosers that can run on it (see `applicable`).
        work: Folder of the finished blocks; a run that finds some there goes on from them.
        jobs: Worker processes, -1 for one per core. A joblib backend (Ray, Dask) is used if one is active.
        progress: Show a progress bar.
        command: What to type to get these rows again.
        block: Episodes flown and diagnosed together.

    Raises:
        ValueError: The suite's scenarios are not those that were frozen, or an unknown diagnoser.
    """
    plant = suite.build()
    if scenarios_digest(suite.scenarios(plant, range(suite.episodes))) != suite.scenarios_sha256:
        raise ValueError(f"{suite.name}: this version draws other scenarios than the suite was frozen with")
    folder = work / f"{suite.name}-{suite.sha256[:8]}-{_source_digest(names)[:8]}-{block}"
    ranges = _blocks(suite, block)
    tasks = [joblib.delayed(_run_block)(suite, names, i, episodes, folder) for i, episodes in enumerate(ranges)]
    parallel = joblib.Parallel(n_jobs=min(jobs, len(tasks)), return_as="generator_unordered")
    for _ in tqdm(parallel(tasks), total=len(tasks), desc=suite.name, unit="block", disable=not progress):
        pass
    rows, timing = {}, {}
    for name in names:
        blocks = [msgspec.json.decode(_block_path(folder, name, i).read_bytes(), type=Block) for i in range(len(ranges))]
        outcomes = [episode for block in blocks for episode in block.outcomes]
        entry = find_diagnoser(name)
        row = Row(
            suite=suite.name, suite_sha256=suite.sha256, diagnoser=name, summary=entry.summary,
            settings=settings_of(suite, name), clairvoyant=entry.clairvoyant,
            versions=versions(), command=command, outcomes=outcomes,
            metrics=summarise(outcomes, len(plant.labels), [s.name for s in plant.estimated], plant.dt),
        )  # fmt: skip
        row = msgspec.json.decode(msgspec.json.encode(row), type=Row)  # as a reader will see it
        rows[name] = msgspec.structs.replace(row, sha256=row.content_sha256())
        timing[name] = 1e6 * sum(b.seconds for b in blocks) / sum(b.samples for b in blocks)
    return rows, timing
