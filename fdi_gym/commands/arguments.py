"""Arguments that several commands take."""

from __future__ import annotations

from typing import Annotated

import tyro

WIDTH = 120  # of tables on the screen

Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="METHOD")]
SuiteNames = Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="SUITE")]
SuiteName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SUITE")]
PlantName = Annotated[str, tyro.conf.arg(metavar="PLANT")]
