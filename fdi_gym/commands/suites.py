"""What there is, and new suites: list, freeze."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from fdi_gym.commands.arguments import PlantName


def show(name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")] = "") -> None:
    """Say what there is; or all about one plant, environment, suite, diagnoser, prober or trainer.

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
    acts: Literal["no", "probing", "accommodation"] = "no",
    decision_period: int = 10,
    on_board: Annotated[str, tyro.conf.arg(metavar="DIAGNOSER")] = "",
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
        acts: What the diagnosis does: a prober chooses probes, or the controller is reconfigured for what is said.
        decision_period: Where it acts, samples from one decision to the next.
        on_board: The diagnoser that probers have on board.
        folder: Where the file goes. Default: beside the other suites for a plant of this package, else the current folder.
    """
    from fdi_gym.design import by_label
    from fdi_gym.discovery import load_plant, plant_sources
    from fdi_gym.files import decode
    from fdi_gym.listing import find_plant
    from fdi_gym.suite import SUITES, ActingSuite, Suite, checked_options
    from fdi_gym.suite import freeze as write

    module, plant_id = find_plant(plant)
    built = load_plant(plant_id, **checked_options(plant_id, options, typed=False))
    tuning = decode(settings, dict[str, dict[str, Any]], "--settings is not JSON of settings by diagnoser")
    count = windows * (1 if episodes is None else episodes)
    how = {} if acts == "no" else {"acts": acts, "decision_period": decision_period, "on_board": on_board}
    suite = (ActingSuite if how else Suite)(
        name=name, description=description, env=f"{module}:{built.env_id}" if module else built.env_id, plant=plant_id,
        options=dict(built.options), process=process, mismatch=mismatch, seeds=list(range(first_seed, first_seed + count)),
        windows=windows, pace=pace, steps=steps, settings=tuning, **how,  # type: ignore[arg-type]
    )  # fmt: skip
    if episodes is None:
        suite = by_label(suite, decisions, healthy, first_seed)
    own = plant_sources()[plant_id].builder.startswith("fdi_gym.plants.")
    print(write(suite, folder or (SUITES if own else Path())))
