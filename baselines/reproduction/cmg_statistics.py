"""Statistics over the blocks of the satellite's campaign."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from baselines.reproduction.cmg_campaign import Piece
from baselines.reproduction.tables import compared
from fdi_gym.plant import Array
from fdi_gym.plants import cmg_satellite as cmg


class Results:
    """The outcomes of the blocks, looked up by setting."""

    def __init__(self, found: dict[Piece, dict[str, Any]]):
        self.found, self.tally = found, []

    def outcomes(self, variant: str, reference: str, snr: int, method: str, level: float = 0.01) -> list[dict[str, Any]]:
        """All episodes of one setting."""
        key = (variant, reference, snr, method)
        return [o for p, v in self.found.items() if p[:4] == key and p.level == level for o in v["outcomes"]]

    def seconds(self, variant: str, reference: str, snr: int, method: str) -> float:
        """Processor time per 200 s of flight."""
        mine = [v for p, v in self.found.items() if p[:4] == (variant, reference, snr, method)]
        return 20000 * sum(v["seconds"] for v in mine) / max(1, sum(v["samples"] for v in mine))

    def mean(self, reference: float | None, values: list[Any], n_reference: int, digits: int) -> str:
        """A mean against the reference's mean over n_reference episodes; the spread is that of our episodes."""
        given = np.array([v for v in values if v is not None], float)
        if reference is None or not given.size:
            return "-" if not given.size else f"{given.mean():.{digits}f}"
        spread = given.std(ddof=1) if given.size > 1 else 0.0
        return compared(
            reference, float(given.mean()), spread * math.sqrt(1 / n_reference + 1 / given.size), digits, self.tally
        )

    def share(self, reference: float | None, hits: list[bool], n_reference: int) -> str:
        """A share in % against the reference's, as two binomials."""
        if not hits:
            return "-"
        p, n = float(np.mean(hits)), len(hits)
        if reference is None:
            return f"{100 * p:.1f}"
        pooled = (p * n + reference / 100 * n_reference) / (n + n_reference)
        error = 100 * math.sqrt(pooled * (1 - pooled) * (1 / n + 1 / n_reference))
        return compared(reference, 100 * p, error, 1, self.tally)

    def interval(self, reference: float, half: float, values: list[float], digits: int = 1) -> str:
        """A mean in % against the reference's mean +- half (95 %)."""
        given = 100 * np.array(values)
        se = given.std(ddof=1) / math.sqrt(len(given)) if len(given) > 1 else 0.0
        text = compared(reference, float(given.mean()), math.hypot(half / 1.96, se), digits, self.tally)
        return f"{text} +- {1.96 * se:.1f}"


def column(outcomes: list[dict[str, Any]], name: str) -> list[Any]:
    """One figure of all episodes."""
    return [o[name] for o in outcomes]


def average(outcomes: list[dict[str, Any]], name: str) -> float:
    """Mean of one figure over all episodes that have it; NaN of none."""
    given = [o[name] for o in outcomes if o[name] is not None]
    return float(np.mean(given)) if given else math.nan


def right(outcomes: list[dict[str, Any]]) -> list[bool]:
    """Whether the episode's label was right."""
    return [o["decided"] == o["truth"] for o in outcomes]


def wilson(outcomes: list[dict[str, Any]]) -> tuple[float, float]:
    """95 % Wilson interval of the accuracy in %; NaN of none."""
    if not outcomes:
        return math.nan, math.nan
    n, p, z = len(outcomes), float(np.mean(right(outcomes))), 1.96
    centre, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    scale = 100 / (1 + z * z / n)
    return scale * (centre - half), scale * (centre + half)


def percent(outcomes: list[dict[str, Any]]) -> str:
    """Accuracy with its 95 % Wilson interval and the number of episodes."""
    if not outcomes:
        return "-"
    low, high = wilson(outcomes)
    return f"{100 * float(np.mean(right(outcomes))):.1f} [{low:.1f}, {high:.1f}], n = {len(outcomes)}"


def spread(values: list[Any], digits: int) -> str:
    """Mean +- 1.96 standard errors over the episodes that have a value."""
    given = np.array([v for v in values if v is not None], float)
    if given.size < 2:
        return "-"
    return f"{given.mean():.{digits}f} +- {1.96 * given.std(ddof=1) / math.sqrt(given.size):.{digits}f}"


def confusion(outcomes: list[dict[str, Any]]) -> Array:
    """Episodes by true (row) and decided label (16, 16)."""
    found = np.zeros((16, 16), int)
    for o in outcomes:
        found[o["truth"], o["decided"]] += 1
    return found


def cmg_name(label: int) -> str:
    """A label as the set of its units."""
    return f"{label} {{{','.join(str(i + 1) for i in cmg.SETS[label])}}}"


def flags(outcomes: list[dict[str, Any]]) -> list[str]:
    """Episodes with a false alarm, and those whose fault raised no flag."""
    return [str(sum(column(outcomes, "false_alarm"))), str(sum(not v for v in column(outcomes, "flagged")))]


def near(counts: Array) -> int:
    """Confusions (16, 16) between two non-empty sets that differ in one unit."""
    return int(sum(counts[i, j] for i in range(1, 16) for j in range(1, 16)
                   if len(set(cmg.SETS[i]) ^ set(cmg.SETS[j])) == 1))  # fmt: skip


def triple(values: Any) -> str:
    """Three RMSE."""
    return " / ".join(f"{v:.4f}" for v in values)


def quantiles(times: Array) -> list[float]:
    """Median, 90 % and longest, of observed values (never is infinite)."""
    return [float(np.quantile(times, q, method="higher")) for q in (0.5, 0.9, 1.0)]
