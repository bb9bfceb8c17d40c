"""The command line: evaluate, verify, leaderboard, list, freeze, train."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import tyro

Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")]


def evaluate(
    suite: tyro.conf.Positional[str],
    diagnosers: Names = ("all",),
    results: Path | None = None,
    work: Path = Path("runs"),
    jobs: int = -1,
    confusion: Literal["best", "all", "none"] = "best",
) -> None:
    """Run diagnosers on a suite, print the comparison table, and write one row per diagnoser.

    Args:
        suite: Name of a suite, or path of a suite file.
        diagnosers: Names; "all" for every one that can run on the suite's plant; "module:function" for your own.
        results: Folder for the rows; without it nothing but the table is made.
        work: Folder of finished blocks. A killed run goes on from there.
        jobs: Worker processes, -1 for one per core.
        confusion: Whose confusion matrices to print.
    """
    from fdi_gym import evaluation, leaderboard
    from fdi_gym.diagnosis import diagnosers as known

    frozen = evaluation.load_suite(suite)
    plant = frozen.build()
    names = list(known()) if diagnosers == ("all",) else list(dict.fromkeys(diagnosers))
    names, reasons = evaluation.applicable(frozen, plant, names)
    for name, reason in reasons.items():
        print(f"{name}: not applicable: {reason}", file=sys.stderr)
    if not names:
        raise ValueError(f"none of these diagnosers can run on {frozen.plant}")
    if results is not None:
        leaderboard.check_writable(results, frozen, names)
    command = f"fdi-gym evaluate {frozen.name} --diagnosers {' '.join(names)}"
    rows, timing = evaluation.evaluate(frozen, names, work=work, jobs=jobs, command=command)
    print(f"\n{frozen.name}: {frozen.description}\n\n{leaderboard.table(list(rows.values()), timing)}")
    ranked = sorted(rows.values(), key=lambda row: -row.metrics["per_sample"]["balanced_accuracy"])
    honest = [row for row in ranked if not row.clairvoyant] or ranked
    for row in {"best": honest[:1], "all": ranked, "none": []}[confusion]:
        print(f"\n{leaderboard.confusion_table(row, [label.name for label in plant.labels])}")
    if results is not None:
        leaderboard.write_rows(results, frozen, rows, timing)
        print(f"\n{len(rows)} rows in {results / frozen.name}")


def verify(rows: tyro.conf.Positional[tuple[Path, ...]], share: float = 0.1) -> None:
    """Check rows against their own episodes, and run a share of the episodes again.

    Args:
        rows: Row files.
        share: Share of each row's episodes to run again.
    """
    from fdi_gym import leaderboard

    for path in rows:
        count = leaderboard.verify(path, share)
        print(f"{path}: every figure follows from the episodes; {count} run again, same outcomes")


def render(results: Path = Path("leaderboards/results"), page: Path = Path("leaderboards/README.md")) -> None:
    """Render the tables of all rows.

    Args:
        results: Folder of the rows.
        page: The page to write.
    """
    from fdi_gym import leaderboard
    from fdi_gym.evaluation import write_whole

    write_whole(page, leaderboard.render(results).encode())
    print(page)


def show(plant: tyro.conf.Positional[str] = "") -> None:
    """Say what there is: plants, suites and diagnosers; or, for one plant, its signals, faults and labels.

    Args:
        plant: Plant id for its data sheet.
    """
    from fdi_gym.diagnosis import diagnosers
    from fdi_gym.evaluation import load_suite, suite_names
    from fdi_gym.plant import load_plant, plant_sources

    if plant:
        print(load_plant(plant).describe())
        return
    print("Environments")
    for name, source in plant_sources().items():
        print(f"  {name}-Faults-v{source.version}")
    print("\nSuites")
    for name in suite_names():
        print(f"  {name:24s} {load_suite(name).description}")
    print("\nDiagnosers")
    for name, entry in diagnosers().items():
        print(f"  {name:32s} {entry.summary}")


def freeze(
    name: tyro.conf.Positional[str],
    plant: str,
    scenario: str,
    description: str,
    episodes: int,
    first_seed: int = 1_000_000,
    options: dict[str, str] = {},  # noqa: B006 (tyro reads the default)
    mismatch: float | None = None,
    settings: str = "{}",
    folder: Path | None = None,
) -> None:
    """Freeze a new suite: write its file with the digest of its scenarios.

    Args:
        name: Name of the suite.
        plant: Plant id.
        scenario: Fault process.
        description: One line for the table.
        episodes: How many.
        first_seed: First public seed.
        options: Options of the plant.
        mismatch: Level of mismatch; without it what the process prescribes.
        settings: Tuning that belongs to the suite, as JSON: {"diagnoser": {"keyword": value}}.
        folder: Where the file goes; default: beside the other suites.
    """
    from fdi_gym import evaluation
    from fdi_gym.plant import load_plant

    built = load_plant(plant, **options)
    suite = evaluation.Suite(
        name=name, description=description, env=built.env_id, plant=plant, options=dict(built.options),
        scenario=scenario,
        mismatch=mismatch, first_seed=first_seed, episodes=episodes, settings=msgspec.json.decode(settings),
    )  # fmt: skip
    print(evaluation.freeze(suite, folder or evaluation.SUITES))


def train(
    method: tyro.conf.Positional[str],
    plant: tyro.conf.Positional[str],
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
        threads: Of torch.
        output: Folder that gets a copy of weights and card.
    """
    import shutil

    from fdi_gym.training import find_trainer

    module, _, plant_id = plant.rpartition(":")
    if module:
        importlib.import_module(module)
    path = find_trainer(method).train(plant_id.split("-Faults-v")[0], budget=budget, seed=seed, work=work, threads=threads)
    for suffix in (".safetensors", ".json"):
        if output is not None:
            output.mkdir(parents=True, exist_ok=True)
            shutil.copy(path.with_suffix(suffix), output / f"{path.stem}{suffix}")
    print(path if output is None else output / path.name)


def main(argv: list[str] | None = None) -> None:
    """Entry point of `fdi-gym`. Errors that a user can mend are one line on stderr, exit status 2."""
    commands: dict[str, Any] = {
        "evaluate": evaluate, "verify": verify, "leaderboard": render, "list": show, "freeze": freeze,
        "train": train,
    }  # fmt: skip
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="fdi-gym", args=argv)
    except (ValueError, OSError) as error:
        print(f"fdi-gym: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
