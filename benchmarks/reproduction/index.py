"""The index over the four papers, and the page of what differs from each: `python -m benchmarks.reproduction`."""

from __future__ import annotations

import importlib
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.reproduction.claims import VERDICTS, Claim, judge
from benchmarks.reproduction.pieces import kept
from fdi_gym.tables import markdown

FOLDER = Path(__file__).parent
NAMES = {
    "b747_lateral": "Boeing 747, two-stage Kalman filter",
    "huav_hover": "Helicopter UAV, robust three-stage central-difference Kalman filter",
    "missile_pitch": "Missile, adaptive estimators with adaptive thresholds",
    "cmg_satellite": "Satellite, condensed adaptation of the covariance (SGAUKF)",
}
KINDS = ("sign", "loss", "repair", "choice", "not reproducible")


class Difference(NamedTuple):
    """Where we depart from a paper."""

    place: str
    printed: str
    here: str
    why: str
    kind: str


def plants() -> list[str]:
    """Folders of papers."""
    return sorted(path.parent.name for path in FOLDER.glob("*/__main__.py"))


def claims(plant: str) -> Sequence[Claim]:
    """The claims of a paper."""
    found: Sequence[Claim] = importlib.import_module(f"benchmarks.reproduction.{plant}.claims").CLAIMS
    return found


def differences_of(plant: str) -> tuple[str, list[Difference]]:
    """Citation and differences, from the plant's `differences.toml`.

    Raises:
        ValueError: A kind that does not exist.
    """
    told: dict[str, Any] = tomllib.loads((FOLDER / plant / "differences.toml").read_text(encoding="utf-8"))
    found = [Difference(**entry) for entry in told["difference"]]
    for difference in found:
        if difference.kind not in KINDS:
            raise ValueError(f"{plant}: {difference.kind!r} is no kind; there are {', '.join(KINDS)}")
    return told["citation"], found


def index(pages: Path) -> str:
    """The page over the four papers, from the pieces beside their pages."""
    rows, listed = [], []
    for plant in plants():
        found = kept(pages, plant)
        judged = [judge(claim, found) for claim in claims(plant)]
        counted = [sum(j.verdict == verdict for j in judged) for verdict in VERDICTS]
        rows.append([f"[{NAMES[plant]}]({plant}.md)", differences_of(plant)[0], *map(str, counted)])
        listed += [[NAMES[plant].partition(",")[0], j.claim.name, j.claim.says, j.verdict] for j in judged]
    head = ["page", "source", *VERDICTS]
    return (
        "# Reproduction: what four papers say, and what was measured\n\nWritten by `python -m benchmarks.reproduction`, "
        "from the "
        "pieces that lie beside the pages. Each page opens with the paper's claims and printed figures, ours with 95 % "
        "intervals, and "
        "a verdict that follows from them; then the counterparts of its figures and tables; agreement with a second "
        "implementation of "
        "the same data sheet, which says nothing of the paper, comes last.\n\n"
        + markdown(head, rows)
        + "\n\nWhat differs from each paper, and why: [differences](differences.md). Whether a paper's method is good "
        "beyond its own "
        "scenario is the boards' question.\n\n## All claims\n\n"
        + markdown(["paper", "claim", "in words", "verdict"], listed)
        + "\n"
    )


def differences() -> str:
    """The page of what differs from each paper."""
    parts = [
        "# What differs from the papers, and why\n\nWritten by `python -m benchmarks.reproduction`, from "
        "`benchmarks/reproduction/<plant>/differences.toml`. *sign*: a sign or an index that cannot be as printed; *loss*: "
        "not in the "
        "text at hand; *repair*: an equation, table or statement that does not hold as printed; *choice*: the paper does "
        "not say; "
        "*not reproducible*: printed, and out of reach whatever one chooses.\n"
    ]
    for plant in plants():
        citation, found = differences_of(plant)
        rows = [[d.kind, d.place, d.printed, d.here, d.why] for d in sorted(found, key=lambda d: KINDS.index(d.kind))]
        counted = ", ".join(f"{n} {kind}" for kind in KINDS if (n := sum(d.kind == kind for d in found)))
        title = f"## {NAMES[plant]}\n\n{citation} [Page]({plant}.md). {counted}.\n\n"
        parts.append(title + markdown(["kind", "where", "the paper", "here", "why"], rows) + "\n")
    return "\n".join(parts)


def write(pages: Path) -> None:
    """Both pages."""
    (pages / "README.md").write_text(index(pages), encoding="utf-8")
    (pages / "differences.md").write_text(differences(), encoding="utf-8")
