"""What an earlier run of this command measured, where it has not been measured again."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from benchmarks.reproduction.claims import Found, Measured, Missing, mean, share
from benchmarks.reproduction.cmg_satellite.blocks import Block
from benchmarks.reproduction.cmg_satellite.plan import blocks
from benchmarks.reproduction.cmg_satellite.results import PHASES, Outcomes, Results, column, confusion, line, right
from fdi_gym.plant import Array

EARLIER: dict[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
MARK = " (earlier run)"


def results(found: Found) -> Results:
    """What is measured of the blocks."""
    return Results({b: found[b.name()] for b in blocks(False) if b.name() in found})


def _cell(variant: str, profile: str, snr: int, method: str) -> dict[str, Any]:
    process = variant if profile == "slew" else profile
    found: dict[str, Any] | None = EARLIER.get("campaign", {}).get(process, {}).get(str(snr), {}).get(method)
    if found is None:
        raise Missing(Block(variant, profile, snr, method).name())
    return found


def accuracy(found: Found, variant: str, profile: str, snr: int, method: str) -> tuple[Measured, str]:
    """Share of the random flights that are labelled right, and where it is from: "" or MARK.

    Raises:
        Missing: It has never been measured.
    """
    o = results(found).measured(variant, profile, snr, method)
    if o:
        return share(sum(right(o)), len(o)), ""
    cell = _cell(variant, profile, snr, method)
    return share(cell["right"], cell["n"]), MARK


def rmse(found: Found, variant: str, snr: int, method: str, phase: str) -> tuple[Measured, str]:
    """RMSE of the random flights on the slew, and where it is from.

    Raises:
        Missing: It has never been measured.
    """
    o = results(found).measured(variant, "slew", snr, method)
    if o:
        return mean(column(o, phase)), ""
    cell = _cell(variant, "slew", snr, method)
    middle, half = cell[phase]
    return Measured(middle, middle - half, middle + half, cell["n"]), MARK


def counts(found: Found) -> tuple[Array | list[list[int]], str]:
    """SGAUKF's confusions (16, 16) on Table 5's ranges, slew, 45 dB, and where they are from.

    Raises:
        Missing: They have never been measured.
    """
    o = results(found).measured("table5", "slew", 45, "SGAUKF")
    if o:
        return confusion(o), ""
    if "confusion" not in EARLIER:
        raise Missing(Block("table5", "slew", 45, "SGAUKF").name())
    return [[0] * 16, *EARLIER["confusion"]["counts"]], MARK


def line_means(found: Found, profile: str, snr: int, method: str) -> tuple[dict[str, Measured], str]:
    """RMSE over Table 4's time line by phase; of the earlier run means alone, of 10 flights.

    Raises:
        Missing: They have never been measured.
    """
    try:
        o: Outcomes = line(found, profile, snr, [method])[0]
    except Missing:
        told = EARLIER.get("line", {}).get(profile, {}).get(str(snr), {}).get(method)
        if told is None:
            raise
        return {phase: Measured(v, v, v) for phase, v in zip(PHASES, told, strict=True)}, MARK
    return {phase: mean(column(o, phase)) for phase in PHASES}, ""
