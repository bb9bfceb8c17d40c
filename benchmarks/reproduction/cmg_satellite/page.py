"""The satellite's page and figures, from its pieces."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.reproduction.claims import Found, Missing, claims_table, judge, section
from benchmarks.reproduction.cmg_satellite import figures, source, tables
from benchmarks.reproduction.cmg_satellite.claims import CLAIMS
from benchmarks.reproduction.cmg_satellite.earlier import results
from benchmarks.reproduction.cmg_satellite.paper import GRIDS
from benchmarks.reproduction.cmg_satellite.plan import CAMPAIGN, blocks, campaign_blocks
from benchmarks.reproduction.cmg_satellite.results import Results

INTRODUCTION = """# Satellite with four control moment gyros: the source's claims and tables, measured again

A. Rahimi, study of the simplified binary grid adaptation (SGAUKF) for the isolation and identification of control moment
gyro faults, after 2020; the text at hand has no title page, so no link to it can be given. Its predecessor: A. Rahimi, K.
D. Kumar, H. Alighanbari, [Mechanical Systems and Signal Processing 135, 2020,
106419](https://doi.org/10.1016/j.ymssp.2019.106419). Momentum, noise definition, detector threshold, increments and label
rule are this benchmark's: [differences](differences.md).

The source lets the satellite come to rest. Then the gimbals hardly move, and a weaker gyro shows in nothing that is measured
(bounds below). So every comparison is made on a slew as well, where faults can be seen.
"""
AGREEMENT = """## Agreement with a second implementation

This says nothing of the source: an independent implementation of the same data sheet. Cells read "reference / measured
here"; a star marks a difference of more than three standard errors. References are of one run, or of the number of episodes
given there; its random streams are not ours, so only distributions can agree. CLAIR is the MEKF told when f changes; the
oracle draws from the Cramer-Rao bound and knows the range of the severities. A section is shown when its pieces are
measured.
"""
COMMAND = "python -m benchmarks.reproduction.cmg_satellite"


def write(found: Found, quick: bool, path: Path) -> None:
    """The page and its figures."""
    path.write_text(page(found, quick), encoding="utf-8")
    for profile in ("slew", "regulate"):
        figures.figure_3(found, profile, path.with_name(f"cmg_figure_3_{profile}.png"))
    figures.severity(results(found), path.with_name("cmg_severity.png"))


def page(found: Found, quick: bool) -> str:
    """The whole page."""
    judged = [judge(claim, found) for claim in CLAIMS]
    parts = [INTRODUCTION, f"## Claims\n\n{claims_table(judged, COMMAND)}", "## The source's tables\n", campaign(found)]
    own = (source.table_5, source.table_6, source.errors, source.table_7, source.table_8, source.table_9, source.phases,
    source.table_10,
           figure_3, source.states, source.literal)  # fmt: skip
    parts += [section(part, found) for part in own]
    return "\n".join([*parts, AGREEMENT, *agreement(found)])


def campaign(found: Found) -> str:
    """How far the campaign is."""
    slew = [b for b in campaign_blocks(False) if b.reference == "slew"]
    there = [b for b in slew if b.name() in found]
    flights = {b[2:4]: 0 for b in slew}
    for b in there:
        flights[b[2:4]] += len(found[b.name()]["outcomes"])
    low, high = min(flights.values()), max(flights.values())
    done = f"{low}" if low == high else f"{low} to {high}"
    onward = f"`{COMMAND} --only table5 --missing` " + ("goes on with it" if len(there) < len(slew) else "measures it")
    return (
        "The source's campaign: 1,500 flights of Table 5's ranges (100 of each of 15 labels), three filters, three noise "
        "levels. "
        f"Measured here, on the slew: {done} flights of 1,500 in each cell ({len(there)} of {len(slew)} blocks, {CAMPAIGN} "
        "a cell). "
        f"{onward}. Each table says its n; *earlier run* marks what an earlier run of this command measured, of the same "
        "processes and methods, and what has not been measured again "
        "(`earlier.toml`).\n"
    )


def figure_3(found: Found) -> str:
    """Figure 3"""
    profiles = [g for g in ("slew", "regulate") if all(f"tracking-{g}-{m}" in found for m in GRIDS)]
    if not profiles:
        raise Missing(f"tracking-slew-{GRIDS[0]}")
    words = {"slew": "On the slew", "regulate": "As the source has it, regulating: the three filters stay at one"}
    shown = "\n\n".join(f"{words[g]}:\n\n![Figure 3, {g}](cmg_figure_3_{g}.png)" for g in profiles)
    return (
        "## Figure 3\n\nEstimates of CAUKF, GAUKF and SGAUKF against the truth over Table 4, with zooms at the changes; 45 "
        "dB, one "
        f"flight. {shown}\n"
    )


def agreement(found: Found) -> list[str]:
    """The figures beside those of the second implementation."""
    r = Results({b: found[b.name()] for b in blocks(False) if b.name() in found})

    def of(part: Callable[..., str], *more: Any) -> Callable[[Found], str]:
        def make(_: Found) -> str:
            r.t.of(part.__name__)
            return part(r, *more)

        make.__doc__ = part.__doc__
        return make

    parts = [of(tables.slew), of(tables.wrong_noise), of(tables.regulate), of(tables.single_flights),
    lambda f: tables.tried(f),
             of(tables.bench), of(tables.ranges), of(tables.hard), of(tables.other_settings), of(tables.bound, found),
             of(tables.null_motion, found), of(tables.bound_of_time_line), of(tables.severity)]  # fmt: skip
    texts = [section(part, found) for part in parts]
    return [r.t.summary() + "\n", *texts]
