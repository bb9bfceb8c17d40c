"""Measurements in named pieces, each kept in a file, so that a killed run goes on; and the command around them.

What a page is made of lies beside it, `<plant>.pieces.gz`: JSON of all pieces by name, nine digits. A page is rendered from
that file alone, so that anybody can do it; pieces that are measured anew take the place of what was there.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import joblib
import msgspec
import tyro
from tqdm import tqdm

from benchmarks.reproduction.claims import Found
from fdi_gym.clusters import on, results
from fdi_gym.commands.arguments import Backend, Cluster
from fdi_gym.files import RefusedError, compress, decode, decompress, read_bytes, read_json, write_whole

Jobs = dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]  # name: function and its arguments


def reference(plant: str) -> dict[str, Any]:
    """The printed figures of a plant's folder, with their sources."""
    return tomllib.loads((Path(__file__).parent / plant / "reference.toml").read_text(encoding="utf-8"))


def finished(folder: Path, names: Jobs) -> dict[str, Any]:
    """The pieces that are there, undamaged, of those that are named."""
    found = {}
    for name in names:
        try:
            found[name] = read_json(_file(folder, name), object, "piece")
        except RefusedError:  # there is none, or it is damaged
            continue
    return found


def pieces(folder: Path, jobs: Jobs, workers: int = -1) -> dict[str, Any]:
    """Run named jobs in parallel, those that are not finished, and read all."""
    folder.mkdir(parents=True, exist_ok=True)
    done = finished(folder, jobs)
    missing = {name: job for name, job in jobs.items() if name not in done}
    if missing:
        tasks = (joblib.delayed(_one)(_file(folder.resolve(), name), *job) for name, job in missing.items())
        for _ in tqdm(results(tasks, len(missing), workers), total=len(missing), unit="piece"):
            pass
        done |= finished(folder, missing)
    return {name: done[name] for name in jobs}


def _file(folder: Path, name: str) -> Path:
    return folder / f"{name.replace('/', '_')}.json"


def _one(file: Path, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    write_whole(file, msgspec.json.encode(function(*arguments)))


def kept(pages: Path, plant: str) -> Found:
    """The pieces that lie beside a page.

    Raises:
        RefusedError: The file is damaged.
    """
    path = pages / f"{plant}.pieces.gz"
    if not path.is_file():
        return Found()
    return Found(decode(decompress(read_bytes(path), str(path)), dict[str, Any], f"{path} holds no pieces"))


def keep(pages: Path, plant: str, found: dict[str, Any]) -> None:
    """Lay pieces beside a page."""
    write_whole(pages / f"{plant}.pieces.gz", compress(msgspec.json.encode(found)))


def rounded(value: Any) -> Any:
    """A nest with its numbers rounded to nine digits."""
    if isinstance(value, float):
        return float(f"{value:.9g}")
    if isinstance(value, dict):
        return {key: rounded(part) for key, part in value.items()}
    return [rounded(part) for part in value] if isinstance(value, list) else value


@dataclasses.dataclass
class Arguments:
    """What is measured, and where it goes."""

    quick: bool = False
    """A small sample, to see that all works; its figures are not comparable, and its page stays with its pieces."""
    page_only: bool = False
    """Measure nothing: the page of the pieces that are finished, and of those that lie beside the page."""
    only: str = ""
    """Measure only the pieces whose name begins like this."""
    missing: bool = False
    """Measure only those that do not lie beside the page: to go on with what another machine has begun."""
    work: Path = Path("runs/reproduction")
    """Folder of the finished pieces."""
    pages: Path = Path("leaderboards/reproduction")
    """Folder of the page, its figures and its pieces."""
    workers: int = -1
    """Processes, or jobs of a cluster at a time; -1 for one per core."""
    backend: Backend = "loky"
    """Where they run: processes of this machine, or a cluster."""
    cluster: Cluster = dataclasses.field(default_factory=dict)
    """What the cluster is told, as name and value in turn; see docs/pages/clusters.md."""


def command(plant: str, plan: Callable[[bool], Jobs], write: Callable[[Found, bool, Path], None]) -> None:
    """Measure what is missing and write the page: the command line of a plant's folder.

    Args:
        plant: Name of the folder.
        plan: The jobs, for a quick run or a whole one.
        write: Writes the page and its figures from pieces, quick or not, to a path; a piece that is missing is named there.
    """
    arguments = tyro.cli(Arguments, description=f"Published figures of {plant}, measured again.")
    work = arguments.work / plant / ("quick" if arguments.quick else "full")
    pages = work if arguments.quick else arguments.pages
    jobs = plan(arguments.quick)
    before = kept(pages, plant)
    mine = {name: job for name, job in jobs.items() if name.startswith(arguments.only)}
    if not mine:
        raise SystemExit(f"no piece begins with {arguments.only!r}")
    if arguments.missing:
        mine = {name: job for name, job in mine.items() if name not in before}
    if not arguments.page_only:
        with on(arguments.backend, arguments.cluster, arguments.work):
            pieces(work, mine, arguments.workers)
    found = Found({name: piece for name, piece in before.items() if name in jobs} | rounded(finished(work, jobs)))
    if not found:
        raise SystemExit(f"no piece is finished in {work}, and none lies in {pages}: leave out --page-only")
    pages.mkdir(parents=True, exist_ok=True)
    keep(pages, plant, {name: found[name] for name in jobs if name in found})
    write(found, arguments.quick, pages / f"{plant}.md")
    print(f"{pages / plant}.md, {len(found)} of {len(jobs)} pieces")
