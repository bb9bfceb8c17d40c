"""What methods know, and what any could: fit, train, diagnosability."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from fdi_gym.commands.arguments import Backend, Cluster, Names


def fit(
    plant: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PLANT")],
    diagnosers: Names = ("all",),
    suites: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SUITE")] = (),
    jobs: int = -1,
    output: Path | None = None,
    renew: bool = False,
    count: int = 4,
    seed: int | None = None,
    backend: Backend = "loky",
    cluster: Cluster = {},  # noqa: B006 (tyro reads the default)
) -> None:
    """Fit what methods know of a plant, for all suites of it that are here: beliefs, calibrations, conformities.

    Args:
        plant: Plant or environment id; "module:id" where the module registers it.
        diagnosers: Names; "reference" for those that others are compared with first, "all" for every one that takes any.
            What the file holds of others stays where names are given, as long as the plant's code is the one that it is of.
        suites: For these suites alone; what the file holds for others stays then. Default: all of the plant.
        jobs: Worker processes, -1 for one per core.
        output: Folder that gets PLANT.json. Default: `fits` in the package of the methods, whence they are read.
        renew: The plant's file has changed and its flights should not have: find some of the fits anew, and where they are
            the same, to rounding, write the present digest of the code into the file.
        count: So many beliefs, calibrations and conformities are found anew then.
        seed: Which ones. Default: drawn anew each time.
        backend: Where they run: "loky" is this machine; dask, ray and slurm are clusters that exist.
        cluster: What the cluster is told, as name and value in turn: address HOST:PORT, or parameters of submitit.
    """
    import secrets

    from fdi_gym.clusters import on
    from fdi_gym.diagnosis import find_diagnoser, knowledge, named
    from fdi_gym.diagnosis.registry import package_of
    from fdi_gym.listing import find_plant
    from fdi_gym.suite import load_suite, suite_names

    plant_id = find_plant(plant)[1]
    entries = [
        entry
        for entry in map(find_diagnoser, named(diagnosers))
        if any(entry.takes(kind) for kind in ("belief", "calibration", "conformity"))
    ]
    asked = [suite for suite in map(load_suite, suites or suite_names()) if suite.plant == plant_id]
    if not entries or len(asked) < max(1, len(suites)):
        raise ValueError(f"nothing to fit: {len(asked)} suites of {plant_id}, {len(entries)} methods that take a belief")
    if renew:
        for path in {(package_of(entry) or Path()) / "fits" / f"{plant_id}.json" for entry in entries}:
            seed = secrets.randbits(32) if seed is None else seed
            knowledge.write_fits(path, knowledge.renewed(path, entries, asked, count, seed))
            print(f"up to {count} fits of each kind (seed {seed}) are the same; {path} is of this code now")
        return
    with on(backend, cluster):
        fits = knowledge.fit_suites(entries, asked, jobs)
    for path, found in fits.items():
        place = path if output is None else output / path.name
        if suites or diagnosers != ("all",):
            found = knowledge.merged(place, found)
        knowledge.write_fits(place, found)
        print(
            f"{len(found.beliefs)} beliefs, {len(found.calibrations)} calibrations and {len(found.conformities)} "
            f"conformities in {place}"
        )


def train(
    method: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="METHOD")],
    plant: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PLANT")],
    budget: int | None = None,
    seed: int = 0,
    options: Annotated[dict[str, str], tyro.conf.arg(metavar="OPTION VALUE")] = {},  # noqa: B006 (tyro reads the default)
    work: Path = Path("runs"),
    threads: int = 1,
    output: Path | None = None,
) -> None:
    """Train a diagnoser; a run that was killed goes on from its checkpoint and ends with the same weights.

    Args:
        method: Name of a trainer, or "module:function".
        plant: Plant or environment id; "module:id" where the module registers it.
        budget: How much to train: flights per process, or for reinforcement learning agent steps. Default: the recipe's.
        seed: Of the run.
        options: Options of the plant, as name and value in turn; with sensor_faults it learns the sensors' labels too.
        work: Folder of runs: checkpoint, tensorboard log, weights and card.
        threads: Of the library that trains.
        output: Folder that gets a copy of weights and card.
    """
    from fdi_gym.diagnosis import train as run
    from fdi_gym.discovery import load_plant
    from fdi_gym.files import write_whole
    from fdi_gym.listing import find_plant
    from fdi_gym.suite import checked_options

    plant_id = find_plant(plant)[1]
    built = load_plant(plant_id, **checked_options(plant_id, options, typed=False))
    path = run(method, built, budget=budget, seed=seed, work=work, threads=threads)
    for suffix in (".safetensors", ".json"):
        if output is not None:
            output.mkdir(parents=True, exist_ok=True)
            write_whole(output / f"{path.stem}{suffix}", path.with_suffix(suffix).read_bytes())
    print(path if output is None else output / path.name)


def diagnosability(
    plant: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PLANT")],
    process: Annotated[str, tyro.conf.arg(metavar="PROCESS")] = "standard",
    flights: int = 12,
    seconds: float | None = None,
    picture: Path | None = None,
) -> None:
    """Say which faults of a plant can be told apart, at what size and after how long, whatever the method.

    Args:
        plant: Plant or environment id; "module:id" where the module registers it.
        process: Fault process, of whose flights the commands and noises are.
        flights: Healthy flights that it is averaged over.
        seconds: How long after the onset. Default: a third of a flight.
        picture: File (.png, .pdf, .svg) that gets a picture of it.
    """
    from fdi_gym.diagnosability import diagnosability as measure
    from fdi_gym.discovery import load_plant
    from fdi_gym.files import make_room
    from fdi_gym.listing import find_plant

    if picture is not None and picture.suffix not in (".png", ".pdf", ".svg"):
        raise ValueError(f"a picture is a .png, .pdf or .svg file, not {picture.name}")
    if picture is not None:
        make_room(picture)
    found = measure(load_plant(find_plant(plant)[1]), process, flights=flights, seconds=seconds)
    print(found.text())
    if picture is not None:
        found.picture().savefig(picture)
