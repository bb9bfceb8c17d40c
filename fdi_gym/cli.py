"""The command line: evaluate, verify, leaderboard, list, freeze, train."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="METHOD")]
SuiteName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SUITE")]
WIDTH = 120  # of tables on the screen
PlantName = Annotated[str, tyro.conf.arg(metavar="PLANT")]


def evaluate(
    suite: SuiteName,
    diagnosers: Names = ("all",),
    results: Path | None = None,
    work: Path = Path("runs"),
    jobs: int = -1,
    confusion: Literal["best", "all", "none"] = "best",
    columns: Annotated[tuple[str, ...], tyro.conf.arg(metavar="COLUMN")] = (),
    csv: Path | None = None,
    episodes: int | None = None,
    replace: bool = False,
) -> None:
    """Run diagnosers on a suite, print the comparison table, and write one row per diagnoser.

    Args:
        suite: Name of a suite, or path of a suite file.
        diagnosers: Names; "all" for every one that can run on the suite's plant; "module:function" for your own.
        results: Folder for the rows; without it nothing but the table is made.
        work: Folder of finished blocks. A killed run goes on from there.
        jobs: Worker processes, -1 for one per core.
        confusion: Whose confusion matrices to print.
        columns: One table of these columns in place of the three rankings; a wrong one lists them.
        csv: A file for all figures, comma-separated.
        episodes: A quick look: so many of the flights, evenly spread. Makes no rows.
        replace: Rows in the folder that other sources, settings or data have made may go.
    """
    from fdi_gym import evaluation, leaderboard, row, tables
    from fdi_gym.diagnosis import diagnosers as known
    from fdi_gym.files import write_whole
    from fdi_gym.names import unknown
    from fdi_gym.suite import load_suite

    for column in columns:
        if column not in tables.COLUMNS:
            raise unknown("column", column, tables.COLUMNS)
    if episodes is not None and results is not None:
        raise ValueError("rows are made of the whole suite: --results and --episodes don't go together")
    frozen = load_suite(suite)
    frozen = frozen if episodes is None else frozen.head(episodes)
    plant = frozen.build()
    names = list(known()) if diagnosers == ("all",) else list(dict.fromkeys(diagnosers))
    names, reasons = evaluation.applicable(frozen, plant, names)
    for name, reason in reasons.items():
        print(f"{name}: not applicable: {reason}", file=sys.stderr)
    if not names:
        raise ValueError(f"none of these diagnosers can run on {frozen.plant}")
    if results is not None:
        row.check_writable(results, frozen, {name: evaluation.digests_of(frozen, plant, name) for name in names}, replace)
    command = f"fdi-gym evaluate {suite} --diagnosers {' '.join(names)}"
    found = evaluation.evaluate(frozen, names, work=work, jobs=jobs, command=command)
    rows = [f.row for f in found.values()]
    times = {name: f.made.microseconds for name, f in found.items()}
    board = leaderboard.Board(frozen, plant, rows, {name: f.outcomes for name, f in found.items()}, times)
    print(f"\n{frozen.name}: {frozen.description}\n\n{leaderboard.tables(board, columns, WIDTH)}")
    ranked, best = tables.by_isolation(rows), board.best()
    for shown in {"best": [best] if best else [], "all": ranked, "none": []}[confusion]:
        print(f"\n{tables.confusion_table(shown, [label.name for label in plant.labels], WIDTH)}")
    if csv is not None:
        write_whole(csv, tables.comma_separated(rows, times).encode())
        print(f"\nall figures in {csv}")
    if results is not None:
        row.write_rows(results, frozen, found)
        print(f"\n{len(rows)} rows in {results / frozen.name}")


def verify(
    rows: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="ROW")],
    share: float = 0.1,
    seed: int | None = None,
    suite: Annotated[str, tyro.conf.arg(metavar="SUITE")] = "",
    trust: Names = (),
) -> None:
    """Check all that rows say against their episodes and the code that is here, and run a share of the episodes again.

    Args:
        rows: Row files; their outcomes lie beside them.
        share: Share of each row's episodes to run again, above 0 and up to 1.
        seed: Draws which ones; without it nobody can know beforehand.
        suite: Name of a suite, or path of a suite file. Default: the one that the row names.
        trust: Diagnosers "module:function" that may be imported. Look at their code first.
    """
    from fdi_gym.row import MADE
    from fdi_gym.verification import verify as check

    rows = tuple(path for path in rows if path.name != MADE)  # so that *.json will do
    if not rows:
        raise ValueError("there are no rows to verify")
    for path in rows:
        episodes = check(path, share, seed=seed, suite=suite, trust=trust)
        print(f"{path}: every figure follows from the episodes; {len(episodes)} run again, same outcomes: {episodes}")


def render(results: Path = Path("leaderboards/results"), pages: Path = Path("leaderboards"), pictures: bool = True) -> None:
    """Render the tables of all rows: README.md, a page for each suite, and their pictures.

    Args:
        results: Folder of the rows.
        pages: Folder of the pages.
        pictures: Draw the pictures, too.
    """
    from fdi_gym import leaderboard
    from fdi_gym.files import write_whole

    for name, text in leaderboard.render(results).items():
        write_whole(pages / name, text.encode())
        print(pages / name)
    for board in leaderboard.boards(results) if pictures else ():
        leaderboard.draw(board, pages / "pictures")


def show(name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")] = "") -> None:
    """Say what there is; or all about one plant, environment, suite, diagnoser or trainer.

    Args:
        name: Whose details to print; "module:id" for a plant or diagnoser of your own.
    """
    from fdi_gym import listing

    print(listing.details(name) if name else listing.overview())


def freeze(
    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")],
    plant: PlantName,
    process: Annotated[str, tyro.conf.arg(metavar="PROCESS")],
    description: Annotated[str, tyro.conf.arg(metavar="TEXT")],
    episodes: int | None = None,
    decisions: int = 30,
    healthy: bool = True,
    windows: int = 1,
    pace: float = 1.0,
    steps: int | None = None,
    first_seed: int = 1_000_000,
    options: Annotated[dict[str, str], tyro.conf.arg(metavar="OPTION VALUE")] = {},  # noqa: B006 (tyro reads the default)
    mismatch: float | None = None,
    settings: Annotated[str, tyro.conf.arg(metavar="JSON")] = "{}",
    folder: Path | None = None,
) -> None:
    """Draw and freeze a new suite: write its file with its seeds and the digest of its scenarios.

    Args:
        name: Name of the suite.
        plant: Plant or environment id; "module:id" where the module registers it.
        process: Fault process.
        description: One line for the table.
        episodes: So many flights of consecutive seeds. Without it flights are drawn by label.
        decisions: At least so many about every label that the process draws.
        healthy: Add flights without their faults where the process draws too few healthy ones.
        windows: Drawn flights whose fault windows follow one another in one.
        pace: Factor on the times of the faults then.
        steps: Flights are cut after so many samples.
        first_seed: The first seed that is looked at.
        options: Options of the plant, as name and value in turn.
        mismatch: Level of mismatch, from 0 to 1; without it what the process prescribes.
        settings: Tuning that belongs to the suite: {"diagnoser": {"keyword": value}}.
        folder: Where the file goes; default: beside the other suites.
    """
    from fdi_gym.design import by_label
    from fdi_gym.discovery import load_plant
    from fdi_gym.files import decode
    from fdi_gym.listing import find_plant
    from fdi_gym.suite import SUITES, Suite, checked_options
    from fdi_gym.suite import freeze as write

    module, plant_id = find_plant(plant)
    built = load_plant(plant_id, **checked_options(plant_id, options, typed=False))
    tuning = decode(settings, dict[str, dict[str, Any]], "--settings is not JSON of settings by diagnoser")
    count = windows * (1 if episodes is None else episodes)
    suite = Suite(
        name=name, description=description, env=f"{module}:{built.env_id}" if module else built.env_id, plant=plant_id,
        options=dict(built.options), process=process, mismatch=mismatch, seeds=list(range(first_seed, first_seed + count)),
        windows=windows, pace=pace, steps=steps, settings=tuning,
    )  # fmt: skip
    if episodes is None:
        suite = by_label(suite, decisions, healthy, first_seed)
    print(write(suite, folder or SUITES))


def fit(
    plant: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PLANT")],
    diagnosers: Names = ("all",),
    jobs: int = -1,
    output: Path | None = None,
) -> None:
    """Fit what methods know of a plant, for all suites of it that are here: beliefs, and calibrations on healthy flights.

    Args:
        plant: Plant or environment id; "module:id" where the module registers it.
        diagnosers: Names; "all" for every one that takes any.
        jobs: Worker processes, -1 for one per core.
        output: Folder that gets PLANT.json. Default: `fits` in the package of the methods, whence they are read.
    """
    from fdi_gym.diagnosis import diagnosers as known
    from fdi_gym.diagnosis import find_diagnoser, knowledge
    from fdi_gym.listing import find_plant
    from fdi_gym.suite import load_suite, suite_names

    plant_id = find_plant(plant)[1]
    names = list(known()) if diagnosers == ("all",) else list(dict.fromkeys(diagnosers))
    entries = [entry for entry in map(find_diagnoser, names) if entry.takes("belief") or entry.takes("calibration")]
    suites = [suite for suite in map(load_suite, suite_names()) if suite.plant == plant_id]
    if not entries or not suites:
        raise ValueError(f"nothing to fit: {len(suites)} suites of {plant_id}, {len(entries)} methods that take a belief")
    for path, found in knowledge.fit_suites(entries, suites, jobs).items():
        place = path if output is None else output / path.name
        knowledge.write_fits(place, found)
        print(f"{len(found.beliefs)} beliefs and {len(found.calibrations)} calibrations in {place}")


def train(
    method: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="METHOD")],
    plant: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PLANT")],
    budget: int | None = None,
    seed: int = 0,
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
        work: Folder of runs: checkpoint, tensorboard log, weights and card.
        threads: Of the library that trains.
        output: Folder that gets a copy of weights and card.
    """
    from fdi_gym.diagnosis import train as run
    from fdi_gym.discovery import load_plant
    from fdi_gym.files import write_whole
    from fdi_gym.listing import find_plant

    path = run(method, load_plant(find_plant(plant)[1]), budget=budget, seed=seed, work=work, threads=threads)
    for suffix in (".safetensors", ".json"):
        if output is not None:
            output.mkdir(parents=True, exist_ok=True)
            write_whole(output / f"{path.stem}{suffix}", path.with_suffix(suffix).read_bytes())
    print(path if output is None else output / path.name)


COMMANDS: dict[str, Any] = {
    "evaluate": evaluate, "verify": verify, "leaderboard": render, "list": show, "freeze": freeze, "fit": fit,
    "train": train,
}  # fmt: skip


def _said(error: ValueError | OSError) -> str:
    """An error in one line, after whose it is."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    return " ".join("".join([*(f"{note}: " for note in getattr(error, "__notes__", [])), text]).split())


def main(argv: list[str] | None = None) -> None:
    """Entry point of `fdi-gym`. Errors that a user can mend are one line on stderr, exit status 2."""
    argv = sys.argv[1:] if argv is None else argv
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # "module:function" in the current folder, behind all that is installed
    try:
        if argv == ["--version"]:
            from fdi_gym import __version__

            print(f"fdi-gym {__version__}")
        else:
            tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="fdi-gym", args=argv)
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read our output has seen enough
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (until the process ends)
        raise SystemExit(141) from None
    except KeyboardInterrupt:
        print("\nfdi-gym: interrupted; the same command goes on from what is finished", file=sys.stderr)
        raise SystemExit(130) from None
    except (ValueError, OSError) as error:
        print(f"fdi-gym: {_said(error)}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
