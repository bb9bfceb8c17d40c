"""A suite's flights as files for others: Parquet with a Croissant description, or a data set of Minari.

Flights are flown, or read, in blocks; a block is written whole before the next one, so that memory does not grow with their
number, and an export that was killed goes on from what is finished.

    OUT/<suite>/part-00000.parquet ...   a row per sample; units in the columns' metadata
    OUT/<suite>.croissant.json           what is in them, as JSON-LD (http://mlcommons.org/croissant/1.0)
    OUT/fdi_gym/<suite>-v0/              with MINARI_DATASETS_PATH=OUT: minari.load_dataset("fdi_gym/<suite>-v0")
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import joblib
import msgspec
import numpy as np
from tqdm import tqdm

import fdi_gym
from fdi_gym.diagnosis.knowledge import code_digest
from fdi_gym.engine import Record
from fdi_gym.files import RefusedError, digest, pretty, read_json, sweep, write_whole
from fdi_gym.plant import Plant
from fdi_gym.recordings.columns import to_frame, units_of
from fdi_gym.recordings.suite import RecordedSuite
from fdi_gym.recordings.tables import need
from fdi_gym.suite import AnySuite

SAMPLES = 60_000  # of a block, about
MARK = b"fdi_gym"  # key of a part's metadata
PROGRESS = ".progress.json"
WHOLE = ("episode", "sample")  # columns that are whole numbers


def blocks(suite: AnySuite, plant: Plant) -> list[range]:
    """The flights that are written together."""
    size = max(1, min(100, SAMPLES // _longest(suite, plant)))
    return [range(i, min(i + size, suite.episodes)) for i in range(0, suite.episodes, size)]


def _longest(suite: AnySuite, plant: Plant) -> int:
    if isinstance(suite, RecordedSuite):
        return SAMPLES  # one by one: nobody knows before they are read
    return max(scenario.steps + 1 for i in range(min(20, suite.episodes)) for scenario in suite.scenarios(plant, [i]))


def identity(suite: AnySuite, plant: Plant, episodes: range) -> str:
    """Digest of what makes a part."""
    place = [episodes.start, episodes.stop]
    return digest([suite.sha256, code_digest(plant), list(units_of(plant)), fdi_gym.__version__, place])


# ---------------------------------------------------------------------------------------------------------------
# Parquet


def _columns(plant: Plant, record: Record, episodes: range) -> dict[str, np.ndarray]:
    """The rows of a block."""
    frames = []
    for i, episode in enumerate(episodes):
        frame = to_frame(plant, record, i, truth=True)
        count = len(frame["time"])
        frames.append({"episode": np.full(count, episode, np.int32), "sample": np.arange(count, dtype=np.int32), **frame})
    return {name: np.concatenate([frame[name] for frame in frames]) for name in frames[0]}


def _write_part(suite: AnySuite, plant: Plant, episodes: range, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns, units = _columns(plant, suite.record(plant, episodes), episodes), units_of(plant)
    arrays = {name: pa.array(values) for name, values in columns.items()}
    arrays["label"] = arrays["label"].dictionary_encode()
    fields = [pa.field(n, a.type, metadata={"unit": units[n]} if units.get(n) else None) for n, a in arrays.items()]
    said = json.dumps({"suite": suite.name, "suite_sha256": suite.sha256, "identity": identity(suite, plant, episodes)})
    sink = io.BytesIO()
    pq.write_table(
        pa.table(list(arrays.values()), schema=pa.schema(fields, metadata={MARK: said})), sink, compression="zstd"
    )
    write_whole(path, sink.getvalue())


def _is_done(suite: AnySuite, plant: Plant, episodes: range, path: Path) -> bool:
    """Whether a part is there, whole, and made by what would make it now."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        said = json.loads((pq.read_schema(path).metadata or {}).get(MARK, b"{}"))
    except (OSError, ValueError, pa.ArrowException):
        return False
    return isinstance(said, dict) and said.get("identity") == identity(suite, plant, episodes)


def parquet(suite: AnySuite, output: Path, jobs: int = -1, progress: bool = True) -> Path:
    """Write a suite's flights as Parquet files, with a Croissant file beside them; gives their folder.

    Args:
        suite: The suite.
        output: Folder of exports.
        jobs: Worker processes, -1 for one per core.
        progress: Show a progress bar.

    Raises:
        RefusedError: pyarrow is not installed, or the folder holds parts of something else.
        OSError: A part cannot be written; those that are finished stay.
    """
    need("pyarrow", "Parquet")
    plant, folder = _plant(suite), output / suite.name
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder)
    wanted = {folder / f"part-{i:05d}.parquet": episodes for i, episodes in enumerate(blocks(suite, plant))}
    for path in folder.glob("part-*.parquet"):
        if path not in wanted:
            raise RefusedError(f"{path} is of another export; remove {folder}, or choose another folder")
    todo = {path: episodes for path, episodes in wanted.items() if not _is_done(suite, plant, episodes, path)}
    calls = (joblib.delayed(_write_part)(suite, plant, episodes, path) for path, episodes in todo.items())
    parallel: Any = joblib.Parallel(n_jobs=_workers(jobs, len(todo)), return_as="generator_unordered")
    with tqdm(total=len(wanted), initial=len(wanted) - len(todo), desc=suite.name, unit="part", disable=not progress) as bar:
        for _ in parallel(calls):
            bar.update()
    write_whole(output / f"{suite.name}.croissant.json", pretty(croissant(suite, plant, list(wanted))))
    return folder


def _workers(jobs: int, tasks: int) -> int:
    if jobs != -1 and jobs < 1:
        raise ValueError(f"jobs is 1 or more, or -1 for one per core, not {jobs}")
    return min(jobs, max(tasks, 1))


def _plant(suite: AnySuite) -> Plant:
    plant = suite.build()
    suite.check_scenarios(plant)
    return plant


# ---------------------------------------------------------------------------------------------------------------
# Croissant

_CONTEXT = {
    "@language": "en", "@vocab": "https://schema.org/", "sc": "https://schema.org/", "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/", "conformsTo": "dct:conformsTo", "column": "cr:column", "recordSet": "cr:recordSet",
    "field": "cr:field", "fileObject": "cr:fileObject", "fileSet": "cr:fileSet", "source": "cr:source",
    "extract": "cr:extract",
    "includes": "cr:includes", "dataType": {"@id": "cr:dataType", "@type": "@vocab"}, "key": "cr:key", "md5": "cr:md5",
    "citeAs": "cr:citeAs", "isLiveDataset": "cr:isLiveDataset", "references": "cr:references", "repeated": "cr:repeated",
    "regex": "cr:regex", "replace": "cr:replace", "separator": "cr:separator", "subField": "cr:subField",
    "transform": "cr:transform", "format": "cr:format", "fileProperty": "cr:fileProperty", "jsonPath": "cr:jsonPath",
    "parentField": "cr:parentField", "path": "cr:path", "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"}, "examples": {"@id": "cr:examples", "@type": "@json"},
}  # fmt: skip


def croissant(suite: AnySuite, plant: Plant, parts: list[Path]) -> dict[str, Any]:
    """The description of an export: its files with their digests, and the columns with their units and meanings."""
    files = []
    for path in parts:
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        files.append({
            "@type": "cr:FileObject", "@id": path.name, "name": path.name, "contentUrl": f"{suite.name}/{path.name}",
            "contentSize": f"{path.stat().st_size} B", "encodingFormat": "application/x-parquet", "sha256": sha256,
        })  # fmt: skip
    units, fields = units_of(plant), []
    for name in (*WHOLE, *units):
        kind = "sc:Integer" if name in WHOLE else "sc:Text" if name == "label" else "sc:Float"
        fields.append({
            "@type": "cr:Field", "@id": f"samples/{name}", "name": name, "description": _meaning(name, units.get(name, "")),
            "dataType": kind, "source": {"fileSet": {"@id": "parts"}, "extract": {"column": name}},
        })  # fmt: skip
    return {
        "@context": _CONTEXT, "@type": "sc:Dataset", "name": suite.name, "conformsTo": "http://mlcommons.org/croissant/1.0",
        "description": f"{suite.description}. {suite.episodes} flights of {suite.env}, process {suite.process}, "
                       f"suite version {suite.sha256}.",
        "version": fdi_gym.__version__, "license": "https://spdx.org/licenses/MIT", "url": "https://github.com/fdi-gym/fdi_gym",
        "distribution": [*files, {"@type": "cr:FileSet", "@id": "parts", "name": "parts",
                                  "includes": f"{suite.name}/part-*.parquet",
                                  "encodingFormat": "application/x-parquet",
                                  "containedIn": [{"@id": path.name} for path in parts]}],
        "recordSet": [{"@type": "cr:RecordSet", "@id": "samples", "name": "samples", "field": fields,
                       "description": "A row per sample. The truth of a row is that of the interval that ends at it."}],
    }  # fmt: skip


def _meaning(name: str, unit: str) -> str:
    kinds = {"episode": "flight of the suite, from 0", "sample": "number of the sample, from 0", "time": "since sample 0",
             "label": "true label of the interval that ends at the sample"}  # fmt: skip
    found = kinds.get(name) or (f"true {name}" if ": " in name else f"{name}, as observed")
    return f"{found}, in {unit}" if unit else found


# ---------------------------------------------------------------------------------------------------------------
# Minari


class Progress(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How far a data set of Minari is: what makes it, flights that are finished, and its metadata as they were then."""

    identity: str
    episodes: int
    metadata: dict[str, Any]


def minari(suite: AnySuite, output: Path, progress: bool = True) -> Path:
    """Write a suite's flights as a data set of Minari: its actions are the true labels; gives its folder.

    Args:
        suite: The suite; no recorded one, which has no environment.
        output: Folder of data sets, for MINARI_DATASETS_PATH.
        progress: Show a progress bar.

    Raises:
        RefusedError: Minari is not installed, the flights are recorded, or the folder holds another data set.
        OSError: It cannot be written; what is finished stays.
    """
    if isinstance(suite, RecordedSuite):
        raise RefusedError(f"{suite.name}: recorded flights have no environment; they are exported as Parquet")
    need("minari", "a data set of Minari")
    need("pyarrow", "a data set of Minari")
    from minari.dataset.minari_storage import METADATA_FILE_NAME, MinariStorage
    from minari.namespace import create_namespace

    plant, name = _plant(suite), f"fdi_gym/{suite.name}-v0"
    folder = output / name / "data"
    made = identity(suite, plant, range(suite.episodes))
    folder.mkdir(parents=True, exist_ok=True)
    sweep(folder)
    done, metadata_file = 0, folder / METADATA_FILE_NAME
    if (folder / PROGRESS).exists():
        said = read_json(folder / PROGRESS, Progress, "record of an export")
        if said.identity != made:
            raise RefusedError(f"{folder} holds another export; remove it, or choose another folder")
        done = said.episodes
        metadata_file.write_text(json.dumps(said.metadata))  # it may have been cut off
    elif any(path.name != PROGRESS for path in folder.iterdir()):
        if metadata_file.exists() and json.loads(metadata_file.read_text() or "{}").get("total_episodes"):
            raise RefusedError(f"{folder} holds another data set; remove it, or choose another folder")
        shutil.rmtree(folder)
        folder.mkdir()
    if done:
        storage = MinariStorage.read(folder)
    else:
        metadata_file.unlink(missing_ok=True)
        with _datasets_in(output), contextlib.suppress(ValueError):
            create_namespace("fdi_gym")
        storage = MinariStorage.new(folder, env_spec=environment(suite, plant), data_format="parquet")
        storage.update_metadata({
            "dataset_id": name, "description": suite.description, "algorithm_name": "the truth",
            "minari_version": _version(),
            "requirements": [f"fdi-gym=={fdi_gym.__version__}"], "suite_sha256": suite.sha256,
        })  # fmt: skip
    size, storage.get_size = storage.get_size, lambda: 0.0  # type: ignore[method-assign]  # asks for all files, at each flight
    with tqdm(total=suite.episodes, initial=done, desc=suite.name, unit="flight", disable=not progress) as bar:
        for episodes in blocks(suite, plant):
            if episodes.stop <= done:
                continue
            storage.update_episodes(_episodes(suite, plant, episodes))
            said = Progress(made, episodes.stop, json.loads(metadata_file.read_text()))
            write_whole(folder / PROGRESS, pretty(said))
            bar.update(len(episodes))
    storage.update_metadata({"dataset_size": float(size())})
    write_whole(folder / PROGRESS, pretty(Progress(made, suite.episodes, json.loads(metadata_file.read_text()))))
    return folder.parent


def _version() -> str:
    import minari

    return minari.__version__


@contextlib.contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    import os

    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["MINARI_DATASETS_PATH"]
        else:
            os.environ["MINARI_DATASETS_PATH"] = before


def environment(suite: Any, plant: Plant) -> Any:
    """The specification of the environment that flies a suite's flights, as `gym.make` takes it in any process."""
    import gymnasium as gym

    spec = copy.deepcopy(gym.spec(plant.env_id))
    module = suite.env.rpartition(":")[0]
    spec.kwargs |= {"plant": f"{module}:{plant.id}" if module else plant.id, "process": suite.process, **suite.options}
    if suite.mismatch is not None:
        spec.kwargs["mismatch"] = suite.mismatch
    return spec


def _episodes(suite: Any, plant: Plant, episodes: range) -> Iterator[Any]:
    """Flights as Minari takes them: the action after a sample is its true label; that after sample 0 is worth nothing."""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    record = suite.record(plant, episodes)
    reward: Any = plant.isolation_reward
    seeds = [*suite.seeds, *suite.healthy]
    for i, episode in enumerate(episodes):
        K = int(record.length[i])
        label, last = record.label[i, : K + 1], np.arange(K) == K - 1
        worth = reward[label[:K], label[:K]].astype(float)
        worth[0] = 0.0
        yield EpisodeBuffer(
            id=episode, seed=int(seeds[episode * suite.windows]), observations=record.obs[i, : K + 1], actions=label[:K],
            rewards=worth, terminations=last & record.terminated[i], truncations=last & ~record.terminated[i],
            infos={"label": label.tolist(), "target": record.target[i, : K + 1], "theta": record.theta[i, : K + 1]},
        )  # fmt: skip
