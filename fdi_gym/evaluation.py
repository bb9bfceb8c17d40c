"""The evaluation of diagnosers on a suite: block by block, in parallel, resumable.

Episodes are flown and diagnosed in blocks. A finished block is one file, written whole, that says what made it and
carries a digest of what it holds; a killed run goes on from the blocks that are there and ends with the same rows. A
block that is damaged, edited, or made by other sources or data is made again.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import msgspec
from tqdm import tqdm

import fdi_gym
from fdi_gym.clusters import check_jobs, results
from fdi_gym.compilation import compile_kernels
from fdi_gym.diagnosis import NotApplicableError, find_diagnoser, make_diagnoser, run
from fdi_gym.engine import Record
from fdi_gym.entrants import find_entrant, fly_entrant, make_entrant, settings_of
from fdi_gym.files import RefusedError, digest, read_json, sweep, write_whole
from fdi_gym.metrics import Outcome, outcome
from fdi_gym.names import blamed, file_name
from fdi_gym.plant import Plant
from fdi_gym.provenance import made_of, packages, provenance, sources
from fdi_gym.row import Evaluated, Made, Row, outcomes_digest
from fdi_gym.scores import summarise
from fdi_gym.suite import ActingSuite, AnySuite

BLOCK = 100  # episodes flown and diagnosed together


class Block(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one diagnoser made of one block of episodes.

    Args:
        outcomes: Of its episodes.
        seconds: Of processor time.
        samples: That were shown.
        identity: Digest of what made it: suite, settings, sources, data, versions, episodes.
        sha256: Digest of all the rest.
    """

    outcomes: list[Outcome]
    seconds: float
    samples: int
    identity: str = ""
    sha256: str = ""

    def content_sha256(self) -> str:
        """The digest that `sha256` must equal."""
        return digest(msgspec.structs.replace(self, sha256=""))


def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    libraries = {name: version(name) for name in ("numpy", "scipy", "numba")}
    return {"python": platform.python_version(), "fdi-gym": fdi_gym.__version__} | libraries


def digests_of(suite: AnySuite, plant: Plant, name: str) -> dict[str, str]:
    """Digests of what makes an entrant's row on a suite, beside the suite; see `made_of`, which uses the method once.

    What a prober has on board has a digest of its own: "on board".
    """
    settings = settings_of(suite, plant, name)
    if not isinstance(suite, ActingSuite):
        return provenance(name, plant, suite.process, settings)
    entry = find_entrant(suite, plant, name)
    few = msgspec.structs.replace(suite, seeds=suite.seeds[: suite.windows], healthy=[], steps=suite.decision_period)
    found = made_of(
        entry, plant, suite.process, settings, lambda: fly_entrant(few, plant, name, [0]), fly_entrant.__module__
    )  # fmt: skip
    if entry.kind == "prober":
        its = suite.settings.get(suite.on_board, {})
        board = provenance(suite.on_board, plant, suite.process, find_diagnoser(suite.on_board).resolve(plant, **its))
        found["on board"] = digest({kind: sha256 for kind, sha256 in board.items() if kind not in ("plant", "engine")})
    return found


def diagnose(suite: AnySuite, plant: Plant, name: str, episodes: Sequence[int], record: Record | None = None) -> Block:
    """Fly episodes of a suite, or read them, diagnose them and reduce them to outcomes.

    Raises:
        ValueError: The method's own code fails; `NotApplicableError` where it cannot run on this plant.
    """
    scoring = plant.process(suite.process).scoring
    if isinstance(suite, ActingSuite):
        start = time.process_time()
        flown = fly_entrant(suite, plant, name, episodes)
        seconds = time.process_time() - start
        outcomes = [
            msgspec.structs.replace(outcome(plant, scoring, flown.record, flown.decisions, i), acted=flown.acted[i])
            for i in range(len(episodes))
        ]
        return Block(outcomes, seconds, int((flown.record.length + 1).sum()))
    find_entrant(suite, plant, name)  # or it says why not
    scenarios = suite.scenarios(plant, episodes)
    record = suite.record(plant, episodes) if record is None else record
    with blamed(name):
        diagnoser = make_diagnoser(
            name, plant, process=suite.process, scenarios=scenarios, **settings_of(suite, plant, name)
        )
        diagnoser.update(diagnoser.init(len(episodes)), record.obs[:, 0])  # what is done once is not timed
        start = time.process_time()
        said = run(diagnoser, record.obs)
        seconds = time.process_time() - start
    outcomes = [outcome(plant, scoring, record, said, i) for i in range(len(episodes))]
    return Block(outcomes, seconds, int((record.length + 1).sum()))


def applicable(suite: AnySuite, plant: Plant, names: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """The diagnosers that can run on the suite's plant, and for the others the reason why not.

    Raises:
        ValueError: Unknown diagnoser, or one whose builder fails; it is named.
    """
    able, reasons = [], {}
    scenarios = suite.scenarios(plant, [0])
    for name in names:
        try:
            with blamed(name):
                make_entrant(suite, plant, name, scenarios)
            able.append(name)
        except NotApplicableError as error:
            reasons[name] = str(error)
    return able, reasons


# ---------------------------------------------------------------------------------------------------------------
# Blocks as files


def read_block(path: Path, identity: str) -> Block | None:
    """A finished block; None where there is none, or one that is damaged, edited or made by something else."""
    try:
        block = read_json(path, Block, "block")
    except (RefusedError, OSError):
        return None
    return block if (block.identity, block.sha256) == (identity, block.content_sha256()) else None


def write_block(path: Path, block: Block, identity: str) -> None:
    """Write a finished block with its digest.

    Raises:
        OSError: It cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    block = msgspec.structs.replace(block, identity=identity)
    write_whole(path, msgspec.json.encode(msgspec.structs.replace(block, sha256=block.content_sha256())))


_flown: dict[
    tuple[Any, ...], tuple[Plant, Record | None]
] = {}  # the last flights: methods are shown them one after the other


def _fly(suite: AnySuite, episodes: range, plant_digest: str) -> tuple[Plant, Record | None]:
    """The plant, and the flights where nobody acts on them."""
    key = (suite.sha256, episodes, plant_digest)
    if key not in _flown:
        plant = suite.build()
        _flown.clear()
        _flown[key] = plant, None if isinstance(suite, ActingSuite) else suite.record(plant, episodes)
    return _flown[key]


def _run_block(suite: AnySuite, name: str, episodes: range, path: Path, identity: str, plant: str) -> tuple[str, int, float]:
    """Fly one block, show it to one diagnoser and write what came of it: its name, the block's start and the time."""
    block = read_block(path, identity)  # made before its worker was lost
    if block is None:
        built, record = _fly(suite, episodes, plant)
        block = diagnose(suite, built, name, episodes, record)
        write_block(path, block, identity)
    return name, episodes.start, block.seconds / block.samples


class _Plan:
    """Which blocks there are to run, in which order: block after block, in each the quickest method first.

    In the last one it is the slowest, so that at the end no core waits for it.
    """

    def __init__(self, suite: AnySuite, plant: Plant, names: Sequence[str], work: Path, size: int):
        self.suite, self.plant, self.names = suite, plant, names
        self.folder = work / f"{suite.name}-{suite.sha256[:8]}"
        self.ranges = [range(i, min(i + size, suite.episodes)) for i in range(0, suite.episodes, size)]
        self.digests: dict[str, dict[str, str]] = {}  # by method
        self.seconds: dict[str, float] = {}  # per sample, as far as they are known
        self.failure: Exception | None = None

    def prepare(self, name: str) -> None:
        """Use a method once, here: what it compiles is then compiled for all workers, and what it is made of is known."""
        if name not in self.digests:
            self.digests[name] = digests_of(self.suite, self.plant, name)

    def identity(self, name: str, episodes: range) -> str:
        """Digest of what makes a block."""
        settings = settings_of(self.suite, self.plant, name)
        place = [episodes.start, episodes.stop]
        return digest([self.suite.sha256, name, settings, self.digests[name], versions(), place])

    def path(self, name: str, episodes: range) -> Path:
        """Where a block lies: blocks of another making lie elsewhere."""
        size = len(self.ranges[0])
        made = digest([settings_of(self.suite, self.plant, name), self.digests[name], versions(), size])
        return self.folder / f"{file_name(name)}-{made[:12]}" / f"block-{episodes.start:06d}.json"

    def blocks(self, name: str) -> list[Block]:
        """The finished blocks of a method.

        Raises:
            RefusedError: One was lost or damaged since it was made.
        """
        found = []
        for episodes in self.ranges:
            path = self.path(name, episodes)
            block = read_block(path, self.identity(name, episodes))
            if block is None:
                raise RefusedError(f"{path} was damaged while the run went on; run it again")
            found.append(block)
        return found

    def tasks(self, bar: Any) -> Iterator[Any]:
        """The blocks that are missing; what is there already only moves the bar. joblib may ask from a thread of its own,
        where an error would be lost: it is kept for the caller."""
        try:
            for i, episodes in enumerate(self.ranges):
                last = 0 < i == len(self.ranges) - 1
                order = sorted(self.names, key=lambda n: self.seconds.get(n, float("inf") if i else 0.0), reverse=last)
                for name in order:
                    if name not in self.digests:
                        bar.set_postfix_str(f"{name}: preparing")
                    self.prepare(name)
                    path, identity = self.path(name, episodes), self.identity(name, episodes)
                    done = read_block(path, identity)
                    if done is None:
                        arguments = (self.suite, name, episodes, path, identity, self.digests[name]["plant"])
                        yield joblib.delayed(_run_block)(*arguments)
                    else:
                        self.seconds[name] = done.seconds / done.samples
                        bar.update()
        except Exception as error:
            self.failure = error


def evaluate(
    suite: AnySuite,
    names: Sequence[str],
    *,
    work: Path,
    jobs: int = -1,
    progress: bool = True,
    command: str = "",
    block: int = BLOCK,
) -> dict[str, Evaluated]:
    """Rows of diagnosers on a suite, with their outcomes.

    Args:
        suite: The suite.
        names: Diagnosers that can run on it (see `applicable`).
        work: Folder of the finished blocks; a run that finds some there goes on from them.
        jobs: Worker processes, -1 for one per core; on a cluster calls at a time (`fdi_gym.clusters`).
        progress: Show a progress bar.
        command: What to type to get one of these rows again, before its name.
        block: Episodes flown and diagnosed together.

    Raises:
        ValueError: The suite's scenarios are not those that were frozen, an unknown diagnoser, one that fails, a number out
            of range.
        OSError: A block cannot be written; those that are finished stay.
    """
    check_jobs(jobs)
    if block < 1:
        raise ValueError(f"a block has 1 episode or more, not {block}")
    plant = suite.build()
    suite.check_scenarios(plant)
    plan = _Plan(suite, plant, list(dict.fromkeys(names)), work.resolve(), block)
    plan.folder.mkdir(parents=True, exist_ok=True)
    sweep(plan.folder)
    makers = {find_entrant(suite, plant, name).build.__module__ for name in plan.names}
    compile_kernels(sources({__name__, *makers}), jobs, progress)
    total = len(plan.names) * len(plan.ranges)
    with tqdm(total=total, desc=suite.name, unit="block", disable=not progress) as bar:
        for name, first, seconds in results(plan.tasks(bar), total, jobs):
            plan.seconds[name] = seconds
            bar.set_postfix_str(f"{name}: from episode {first}")
            bar.update()
    if plan.failure is not None:
        raise plan.failure
    return {name: _evaluated(suite, plant, name, plan.blocks(name), plan.digests[name], command) for name in plan.names}


def _evaluated(
    suite: AnySuite, plant: Plant, name: str, blocks: list[Block], digests: Mapping[str, str], command: str
) -> Evaluated:
    outcomes = [episode for block in blocks for episode in block.outcomes]
    row = Row(
        suite=suite.name, suite_sha256=suite.sha256, diagnoser=name, settings=settings_of(suite, plant, name),
        digests={"outcomes": outcomes_digest(outcomes), **digests},
        packages=packages(find_entrant(suite, plant, name), plant),
        metrics=summarise(outcomes, len(plant.labels), [s.name for s in plant.estimated], plant.dt),
    )  # fmt: skip
    time = 1e6 * sum(b.seconds for b in blocks) / sum(b.samples for b in blocks)
    made = Made(command=f"{command} {name}".strip(), versions=versions(), microseconds=round(time, 2))
    return Evaluated(row.sealed(), outcomes, made)
