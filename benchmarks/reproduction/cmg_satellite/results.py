"""Statistics over the blocks, and their comparison with a reference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.reproduction.claims import Found, Missing, share
from benchmarks.reproduction.cmg_satellite.blocks import Block
from benchmarks.reproduction.cmg_satellite.paper import PARTS
from benchmarks.reproduction.comparison import Comparisons, Figure, shown
from fdi_gym.plant import Array
from fdi_gym.plants import cmg_satellite as cmg

Outcomes = list[dict[str, Any]]
PHASES = ("pre", "faulty", "post")


class Results:
    """The outcomes of the blocks that are measured, looked up by setting, and their comparison with the reference."""

    def __init__(self, blocks: dict[Block, dict[str, Any]]):
        self.blocks, self.t = blocks, Comparisons()

    def measured(self, variant: str, reference: str, snr: int, method: str, level: float = 0.01) -> Outcomes:
        """All episodes of one setting; none where none is measured."""
        key = (variant, reference, snr, method)
        return [o for b, piece in self.blocks.items() if b[:4] == key and b.level == level for o in piece["outcomes"]]

    def outcomes(self, variant: str, reference: str, snr: int, method: str, level: float = 0.01) -> Outcomes:
        """All episodes of one setting.

        Raises:
            Missing: None is measured.
        """
        found = self.measured(variant, reference, snr, method, level)
        if not found:
            raise Missing(Block(variant, reference, snr, method, 0, level).name())
        return found

    def paired(self, variant: str, reference: str, snr: int, methods: Sequence[str]) -> list[Outcomes]:
        """The episodes of one setting that all of these methods have been shown, in the same order.

        Raises:
            Missing: There is none.
        """
        numbers = [{b.number for b in self.blocks if b[:4] == (variant, reference, snr, m)} for m in methods]
        both = sorted(set.intersection(*numbers))
        if not both:
            lacking = next(m for m, n in zip(methods, numbers, strict=True) if not n) if not all(numbers) else methods[0]
            raise Missing(Block(variant, reference, snr, lacking).name())
        return [[o for n in both for o in self.blocks[Block(variant, reference, snr, m, n)]["outcomes"]] for m in methods]

    def seconds(self, variant: str, reference: str, snr: int, method: str) -> float:
        """Processor time per 200 s of flight."""
        mine = [piece for b, piece in self.blocks.items() if b[:4] == (variant, reference, snr, method)]
        return 20000 * sum(piece["seconds"] for piece in mine) / sum(piece["samples"] for piece in mine)

    def mean(self, reference: Figure, values: Sequence[Figure], n_reference: int, digits: int) -> str:
        """A mean against the reference's mean over n_reference episodes; the spread is that of our episodes."""
        given = present(values)
        if reference is None or math.isnan(reference) or not given.size:
            return shown(float(given.mean()) if given.size else None, digits)
        spread = given.std(ddof=1) if given.size > 1 else 0.0
        return self.t.cell(reference, given.mean(), digits, spread * math.sqrt(1 / n_reference + 1 / given.size))

    def means(self, reference: Sequence[Figure], o: Outcomes, n_reference: int, digits: int) -> list[str]:
        """RMSE before, during and after the fault."""
        return [self.mean(v, column(o, phase), n_reference, digits) for v, phase in zip(reference, PHASES, strict=True)]

    def share(self, reference: Figure, hits: Sequence[bool], n_reference: int) -> str:
        """A share in % against the reference's, as two binomials."""
        p, n = float(np.mean(hits)), len(hits)
        if reference is None:
            return f"{100 * p:.1f}"
        pooled = (p * n + reference / 100 * n_reference) / (n + n_reference)
        error = 100 * math.sqrt(pooled * (1 - pooled) * (1 / n + 1 / n_reference))
        return self.t.cell(reference, 100 * p, 1, error)

    def interval(self, reference: float, half: float, shares: Sequence[float]) -> str:
        """A mean in % against the reference's mean +- half (95 %)."""
        given = 100 * np.array(shares)
        error = given.std(ddof=1) / math.sqrt(len(given))
        return f"{self.t.cell(reference, given.mean(), 1, math.hypot(half / 1.96, error))} +- {1.96 * error:.1f}"


def line(found: Found, profile: str, snr: int, methods: Sequence[str]) -> list[Outcomes]:
    """The flights of Table 4 that all of these have been shown; "literal odd" and the like are readings of SGAUKF.

    Raises:
        Missing: There is none.
    """
    names = [m.replace(" ", "-", 1) if m.startswith("literal ") else f"line-{profile}-{snr}-{m}" for m in methods]
    parts = [part for part in range(PARTS) if all(f"{name}-{part}" in found for name in names)]
    if not parts:
        raise Missing(next((f"{n}-0" for n in names if f"{n}-0" not in found), f"{names[0]}-0"))
    return [[o for part in parts for o in found[f"{name}-{part}"]["outcomes"]] for name in names]


def column(outcomes: Outcomes, name: str) -> list[Any]:
    """One entry of all outcomes."""
    return [o[name] for o in outcomes]


def present(values: Sequence[Figure]) -> Array:
    """Those that are there."""
    return np.array([v for v in values if v is not None], float)


def average(outcomes: Outcomes, name: str) -> float:
    """Mean over the episodes that have the entry."""
    return float(present(column(outcomes, name)).mean())


def right(outcomes: Outcomes) -> list[bool]:
    """Whether the episode's label was right."""
    return [o["decided"] == o["truth"] for o in outcomes]


def percent(outcomes: Outcomes) -> str:
    """Accuracy with its 95 % Wilson interval and the number of episodes."""
    if not outcomes:
        return "-"
    p, low, high, n = share(sum(right(outcomes)), len(outcomes))
    return f"{100 * p:.1f} [{100 * low:.1f}, {100 * high:.1f}], n = {n}"


def spread(values: Sequence[Figure], digits: int) -> str:
    """Mean +- 1.96 standard errors over the episodes that have a value."""
    given = present(values)
    if given.size < 2:
        return "-"
    return f"{given.mean():.{digits}f} +- {1.96 * given.std(ddof=1) / math.sqrt(given.size):.{digits}f}"


def between(values: Sequence[float]) -> str:
    """Mean (lowest to highest) of an RMSE over flights."""
    return f"{np.mean(values):.4f} ({min(values):.4f} to {max(values):.4f})" if values else "-"


def triple(values: Sequence[float]) -> str:
    """Three RMSE."""
    return " / ".join(f"{v:.4f}" for v in values)


def quantiles(times: Sequence[Figure]) -> str:
    """Median, 90 % and longest, of observed values."""
    values = np.array(times, float)
    found = np.quantile(np.where(np.isnan(values), np.inf, values), [0.5, 0.9, 1.0], method="higher")
    return " / ".join("never" if np.isinf(v) else f"{v:.2f}" for v in found)


def confusion(outcomes: Outcomes) -> Array:
    """Episodes by true (row) and decided label (16, 16)."""
    found = np.zeros((16, 16), int)
    for o in outcomes:
        found[o["truth"], o["decided"]] += 1
    return found


def near(counts: Array) -> int:
    """Confusions (16, 16) between two non-empty sets that differ in one unit."""
    return int(sum(counts[i, j] for i in range(1, 16) for j in range(1, 16)
                   if len(set(cmg.SETS[i]) ^ set(cmg.SETS[j])) == 1))  # fmt: skip


def units(label: int) -> str:
    """A label with the set of its units."""
    return f"{label} {{{','.join(str(i + 1) for i in cmg.SETS[label])}}}"


def flags(outcomes: Outcomes) -> list[str]:
    """Episodes with a false alarm, and those whose fault raised no flag."""
    return [str(sum(column(outcomes, "false_alarm"))), str(sum(not v for v in column(outcomes, "flagged")))]
