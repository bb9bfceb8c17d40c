"""Figures beside their reference, and the few statistics that all pages need."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from fdi_gym.plant import Array

Figure = float | None  # None or NaN where there is none


def shown(value: Figure, digits: int | None = None) -> str:
    """A figure, rounded or as short as it is; "-" for none."""
    if value is None or math.isnan(value):
        return "-"
    return f"{value:g}" if digits is None else f"{value:.{digits}f}"


class Comparisons:
    """Cells "reference / found" with a star where the two differ, and the count of those that agree.

    Figures of the same flights are not independent, so they are counted by the flights that they are of, too.
    """

    def __init__(self) -> None:
        self.agree = self.total = 0
        self.sets: dict[str, bool] = {}  # flights: whether all their figures agree
        self._flights = "all"

    def of(self, flights: str) -> None:
        """The figures from here on are of these flights."""
        self._flights = flights

    def count(self, same: bool) -> bool:
        """Count one comparison."""
        self.agree, self.total = self.agree + bool(same), self.total + 1
        self.sets[self._flights] = self.sets.get(self._flights, True) and bool(same)
        return same

    def summary(self) -> str:
        """How many agree."""
        sets = f"{sum(self.sets.values())} of {len(self.sets)} sets of flights agree in all their figures"
        figures = f"{self.agree} of {self.total} figures"
        return f"{sets}, {figures}; figures of one set are of the same flights and not independent."

    def cell(self, reference: Figure, found: Figure, digits: int = 3, error: float = 0.0) -> str:
        """They agree within three standard errors of their difference and its rounding, or where neither is there."""
        r, f = (math.nan if v is None else float(v) for v in (reference, found))
        same = (math.isnan(r) and math.isnan(f)) or abs(r - f) <= 3 * error + 0.501 * 10**-digits
        return f"{shown(r, digits)} / {shown(f, digits)}" + ("" if self.count(same) else " *")

    def cells(
        self, reference: Iterable[Figure], found: Iterable[Figure], digits: int = 3, errors: Iterable[float] | None = None
    ) -> str:
        """Several figures in one cell."""
        reference = list(reference)
        errors = [0.0] * len(reference) if errors is None else errors
        return ", ".join(self.cell(r, f, digits, float(e)) for r, f, e in zip(reference, found, errors, strict=True))

    def counts(self, reference: Sequence[int], found: Sequence[int]) -> str:
        """Whole numbers, like 3/4."""
        said, ours = ("/".join(map(str, numbers)) for numbers in (reference, found))
        return said if self.count(list(reference) == list(found)) else f"{said} but {ours} *"


def binomial_error(share: float, n: float, least: float = 0.0) -> float:
    """Standard error of the difference of two shares near `share`, of n each; `least`: a variance p (1 - p) to assume."""
    return math.sqrt(2 * max(share * (1 - share), least) / n)


def rms(x: Array, axis: Any = None) -> Any:
    """Root mean square."""
    return np.sqrt(np.mean(x**2, axis=axis))


def first(condition: Array) -> Array:
    """First sample (N,) at which each row (N, K) holds; NaN where none does."""
    return np.where(condition.any(axis=1), condition.argmax(axis=1), np.nan)


def state_errors(estimate: Array, true: Array, window: slice) -> list[list[float]]:
    """Root mean square error of each estimated state over a window: one row per flight (N, n_x) of (N, K + 1, n_x)."""
    return rms((estimate - true)[:, window], axis=1).tolist()
