"""Statements about the second implementation's figures, with what was found and whether they hold."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fdi_gym.tables import markdown


class Statements:
    """Collects statements with their figures and says plainly which hold."""

    def __init__(self) -> None:
        self.rows: list[list[str]] = []

    def add(self, claim: str, wanted: Any, found: Any, holds: bool) -> None:
        """One statement."""
        self.rows.append([claim, str(wanted), str(found), "holds" if holds else "**does not hold**"])

    def same(self, claim: str, wanted: str, identical: bool) -> None:
        """A statement that figures are the reference's to the last digit."""
        self.add(claim, wanted, "identical" if identical else "differ", identical)

    def table(self) -> str:
        """How many hold, and all of them."""
        held = sum(row[-1] == "holds" for row in self.rows)
        table = markdown(["statement", "reference", "here", "verdict"], self.rows)
        said = f"{held} of {len(self.rows)} statements hold; those of the numbered episodes are of the same flights."
        return f"**{said}**\n\n{table}\n"


def beside(reference: Iterable[float], found: Iterable[float], digits: int = 2) -> list[str]:
    """Cells "reference / here"."""
    return [f"{a:.{digits}f} / {b:.{digits}f}" for a, b in zip(reference, found, strict=True)]
