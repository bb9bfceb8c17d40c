"""Plants and diagnosers of one's own, in packages of one's own: new, check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from fdi_gym.commands.arguments import Names


def new(
    kind: Annotated[tyro.conf.Positional[Literal["plant", "diagnoser"]], tyro.conf.arg(metavar="plant|diagnoser")],
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER")],
) -> None:
    """Write a package with a plant or a diagnoser, its test, a suite, a row and a board: a beginning that works.

    Args:
        kind: What it brings.
        folder: A new or empty folder; the package is called like it.
    """
    from fdi_gym.scaffold import new as write

    for path in write(kind, folder):
        print(path)
    print(f"\npip install -e {folder}, then {folder / 'README.md'} says what to type")


def check(
    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")],
    plants: Names = (),
) -> None:
    """Whether a plant or a diagnoser keeps the contract: `fdi_gym.testing`.

    Args:
        name: A plant or environment id, or a diagnoser; "module:id" or "module:function" for one of your own.
        plants: On which a diagnoser is checked. Default: all on which it runs.
    """
    from fdi_gym.diagnosis import NotApplicableError, make_diagnoser
    from fdi_gym.discovery import load_plant, plant_sources
    from fdi_gym.listing import as_plant, find_plant
    from fdi_gym.testing import check_diagnoser, check_plant, check_vector_env

    try:
        plant_id = as_plant(name)
        if plant_id is not None:
            check_plant(load_plant(plant_id))
            check_vector_env(load_plant(plant_id))
            print(f"{name} keeps the contract of a plant")
            return
        ran = 0
        for plant_id in [find_plant(plant)[1] for plant in plants] or list(plant_sources()):
            plant = load_plant(plant_id)
            try:
                check_diagnoser(lambda p, scenarios: make_diagnoser(name, p, scenarios=scenarios), plant)
                ran += 1
                print(f"{name} keeps the contract of a diagnoser on {plant_id}")
            except NotApplicableError as error:
                print(f"{name} does not run on {plant_id}: {error}")
    except AssertionError as error:
        raise ValueError(f"{name} does not keep the contract: {error}") from error
    if not ran:
        raise ValueError(f"{name} runs on no plant")
