"""Recorded flights: diagnose, collect; and what is flown here, for others: export."""

from __future__ import annotations

import importlib.util
import sys
import time as clock
from pathlib import Path
from typing import Annotated, Literal

import tyro

from fdi_gym.commands.arguments import Names, PlantName, SuiteName


def diagnose(
    flight: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FLIGHT")],
    plant: PlantName,
    diagnosers: Names = ("all",),
    mapping: Annotated[Path | None, tyro.conf.arg(metavar="JSON")] = None,
    process: Annotated[str, tyro.conf.arg(metavar="PROCESS")] = "standard",
    options: Annotated[dict[str, str], tyro.conf.arg(metavar="OPTION VALUE")] = {},  # noqa: B006 (tyro reads the default)
    output: Path = Path("diagnosis"),
) -> None:
    """Show recorded flights to diagnosers: say what happened when, and write their decisions and a picture.

    Args:
        flight: A CSV or Parquet file, or a folder of them. A row is a sample; its commands are those of the interval that
            has just ended.
        plant: Plant or environment id; "module:id" where the module registers it.
        diagnosers: Names; "all" for every one that can run on the plant and is told nothing of the truth.
        mapping: A file that says which column is what; without it columns are called as the plant's channels.
        process: Fault process that is expected.
        options: Options of the plant, as name and value in turn.
        output: Folder for the decisions and pictures.
    """
    from fdi_gym import recordings as rec
    from fdi_gym.diagnosis import run
    from fdi_gym.discovery import load_plant
    from fdi_gym.files import write_whole
    from fdi_gym.listing import find_plant
    from fdi_gym.recordings.reports import decision_columns, lines
    from fdi_gym.suite import checked_options

    plant_id = find_plant(plant)[1]
    built = load_plant(plant_id, **checked_options(plant_id, options, typed=False))
    columns = None if mapping is None else rec.read_mapping(mapping)
    files = rec.table_files(flight)
    shown = {}
    refused = 0
    for path in files:
        print(f"{path}")
        try:
            found = rec.observations(built, path, columns)
        except ValueError as error:
            if len(files) == 1:
                raise
            print(f"  refused: {error}")
            refused += 1
            continue
        shown = shown or _able(built, process, diagnosers)
        print(f"  {len(found.obs)} samples of {built.env_id}, {found.time[-1] - found.time[0]:.6g} s")
        for kind, said in (
            ("mended", found.notes),
            ("doubtful", rec.doubts(built, found.obs, columns.commands if columns else "u_k-1")),
        ):
            for text in said:
                print(f"  {kind}: {text}")
        if found.label is not None:
            print(f"  labels: {', '.join(_truth(built, found))}")
        said = {}
        for name, diagnoser in shown.items():
            begin = clock.perf_counter()
            said[name] = run(diagnoser, found.obs[None])
            print("\n".join(lines(built, name, said[name], found.time, found.label)))
            if clock.perf_counter() - begin > 60:
                print(f"    ({clock.perf_counter() - begin:.0f} s)", file=sys.stderr)
        output.mkdir(parents=True, exist_ok=True)
        ending = "parquet" if importlib.util.find_spec("pyarrow") else "csv"
        table = output / f"{path.stem}.diagnosis.{ending}"
        rec.write_table(table, *decision_columns(built, said, found.time))
        print(f"  decisions in {table}")
        if importlib.util.find_spec("matplotlib"):
            import io

            from fdi_gym import plots

            picture = io.BytesIO()
            plots.recording(built, found.obs, found.time, found.label, said).savefig(picture, format="png")
            write_whole(output / f"{path.stem}.png", picture.getvalue())
            print(f"  picture in {output / f'{path.stem}.png'}")
        else:
            print("  no picture: pip install 'fdi-gym[plot]'")
    if refused:
        raise ValueError(f"{refused} of {len(files)} recordings were refused")


def _able(plant, process, diagnosers):
    """The diagnosers that are asked for and can run, by name; the reasons of the others are printed."""
    from fdi_gym.diagnosis import NotApplicableError, make_diagnoser
    from fdi_gym.diagnosis import diagnosers as known
    from fdi_gym.names import blamed
    from fdi_gym.tables import FLOOR

    plant.process(process)
    everything = diagnosers == ("all",)
    names = [n for n, entry in known().items() if not entry.clairvoyant and n not in FLOOR] if everything else diagnosers
    found = {}
    for name in dict.fromkeys(names):
        try:
            with blamed(name):
                found[name] = make_diagnoser(name, plant, process=process)
        except NotApplicableError as error:
            if not everything:
                print(f"{name}: not applicable: {error}", file=sys.stderr)
    if not found:
        raise ValueError(f"none of these diagnosers can run on {plant.id}")
    return found


def _truth(plant, found):
    """The true labels of a recording and when they were, in words."""
    from fdi_gym.declaration import runs

    for first, after, label in runs(found.label, 1):
        yield f"{plant.labels[label].name} {found.time[first - 1]:.6g} to {found.time[after - 1]:.6g} s"


def collect(
    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")],
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")],
    plant: PlantName,
    description: Annotated[str, tyro.conf.arg(metavar="TEXT")],
    layout: Literal["columns", "skab", "braatz", "alfa"] = "columns",
    mapping: Annotated[Path | None, tyro.conf.arg(metavar="JSON")] = None,
    channels: Annotated[Path | None, tyro.conf.arg(metavar="JSON")] = None,
    process: Annotated[str, tyro.conf.arg(metavar="PROCESS")] = "standard",
    options: Annotated[dict[str, str], tyro.conf.arg(metavar="OPTION VALUE")] = {},  # noqa: B006 (tyro reads the default)
) -> None:
    """Make a suite of recorded flights that say their labels or onsets: FOLDER/NAME.json, which evaluate and verify take.

    Args:
        name: Name of the suite.
        folder: Where the recordings lie.
        plant: Plant or environment id; "module:id" where the module registers it; a new name where no equations are known.
        description: One line for the table.
        layout: How the recordings are laid out.
        mapping: A file that says which column is what.
        channels: A file that says what is recorded, of a plant without equations.
        process: Fault process of the plant that is expected.
        options: Options of the plant, as name and value in turn.
    """
    from fdi_gym.discovery import plant_sources
    from fdi_gym.files import read_json
    from fdi_gym.listing import find_plant
    from fdi_gym.recordings import read_mapping
    from fdi_gym.recordings.channels import Channels
    from fdi_gym.recordings.suite import collect as make
    from fdi_gym.suite import checked_options

    declared = None if channels is None else read_json(channels, Channels, "declaration of channels")
    found = {}
    if declared is None and (layout == "columns" or ":" in plant or plant in plant_sources()):
        module, plant_id = find_plant(plant)
        plant, found = f"{module}:{plant_id}" if module else plant_id, checked_options(plant_id, options, typed=False)
    columns = None if mapping is None else read_mapping(mapping)
    print(
        make(
            folder,
            name,
            description,
            plant,
            options=found,
            process=process,
            channels=declared,
            layout=layout,
            mapping=columns,
        )
    )


def export(
    suite: SuiteName,
    format: Literal["parquet", "minari"] = "parquet",
    output: Path = Path("export"),
    jobs: int = -1,
) -> None:
    """Write a suite's flights as files for others, truth included; an export that was killed goes on.

    Args:
        suite: Name of a suite, or path of a suite file.
        format: Parquet files with a Croissant description, or a data set of Minari.
        output: Folder of exports; for Minari, what MINARI_DATASETS_PATH is set to.
        jobs: Worker processes for Parquet, -1 for one per core.
    """
    from fdi_gym import export as to
    from fdi_gym.suite import load_suite

    frozen = load_suite(suite)
    if format == "parquet":
        print(to.parquet(frozen, output, jobs))
    else:
        folder = to.minari(frozen, output)
        print(f'{folder}: MINARI_DATASETS_PATH={output}, minari.load_dataset("{folder.relative_to(output).as_posix()}")')
