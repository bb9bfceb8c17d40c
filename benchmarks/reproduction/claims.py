"""What a paper says beside what was measured, and a verdict that follows from the numbers.

A claim has checks: a figure with its 95 % interval against a stated criterion. A figure whose whole interval meets the
criterion confirms, one whose whole interval misses it does not, one whose interval holds the limit cannot be judged. A claim
is confirmed where all its checks are, not confirmed where none is, partly between; a claim that the numbers at hand cannot
reach says so with a reason, and its figures are shown all the same.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from fdi_gym.tables import markdown

CONFIRMED, PARTLY, NOT_CONFIRMED, OPEN = "confirmed", "partly", "not confirmed", "cannot be judged"
VERDICTS = (CONFIRMED, PARTLY, NOT_CONFIRMED, OPEN)


class Measured(NamedTuple):
    """A figure with its 95 % interval; one that is computed without chance has none."""

    value: float
    low: float
    high: float
    n: int = 0  # independent flights or draws behind it; 0: computed, not sampled

    def text(self, digits: int = 3, unit: str = "") -> str:
        """For example "0.050 [0.049, 0.051] rad/s, n = 24"."""
        suffix = f" {unit}" if unit else ""
        if not self.n:
            return f"{_number(self.value, digits)}{suffix}"
        bounds = ", ".join(_number(v, digits) for v in (self.low, self.high))
        return f"{_number(self.value, digits)} [{bounds}]{suffix}, n = {self.n}"


def _number(value: float, digits: int) -> str:
    if not math.isfinite(value):
        return "none" if math.isnan(value) else "never"
    if value and abs(value) < 0.5 * 10**-digits:
        return f"{value:.1e}"
    return f"{value:.{digits}f}"


def exact(value: float) -> Measured:
    """A figure in which there is no chance."""
    return Measured(float(value), float(value), float(value))


def mean(values: Iterable[float | None]) -> Measured:
    """Mean over independent flights with Student's interval."""
    given = np.array([v for v in values if v is not None and not math.isnan(v)], float)
    if not given.size:
        return Measured(math.nan, -math.inf, math.inf)
    middle = float(given.mean())
    if given.size == 1:
        return Measured(middle, -math.inf, math.inf, 1)
    half = float(scipy.special.stdtrit(given.size - 1, 0.975) * given.std(ddof=1) / math.sqrt(given.size))
    return Measured(middle, middle - half, middle + half, int(given.size))


def ratio(above: Sequence[float], below: Sequence[float]) -> Measured:
    """Ratio of two means over the same flights, from the logarithms of their paired ratios."""
    logs = mean(np.log(np.array(above, float) / np.array(below, float)).tolist())
    value, low, high = (math.exp(v) if math.isfinite(v) else math.inf * (v > 0) for v in logs[:3])
    return Measured(value, low, high, logs.n)


def share(hits: int, n: int) -> Measured:
    """A share with Wilson's interval."""
    if not n:
        return Measured(math.nan, -math.inf, math.inf)
    p, z = hits / n, 1.96
    centre, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return Measured(p, max((centre - half) / scale, 0.0), min((centre + half) / scale, 1.0), n)


def paired_shares(first: Sequence[bool], second: Sequence[bool]) -> Measured:
    """Difference of two shares over the same flights, with the paired normal interval (one half added to each cell)."""
    a, b = np.asarray(first, bool), np.asarray(second, bool)
    n = len(a)
    if not n:
        return Measured(math.nan, -math.inf, math.inf)
    only_a, only_b = int((a & ~b).sum()), int((b & ~a).sum())
    difference = (only_a - only_b) / n
    p, q, m = only_a + 0.5, only_b + 0.5, n + 2
    half = 1.96 * math.sqrt(p + q - (p - q) ** 2 / m) / m
    return Measured(difference, difference - half, difference + half, n)


class Check(NamedTuple):
    """A figure and its criterion."""

    what: str
    found: Measured
    least: float = -math.inf
    most: float = math.inf
    digits: int = 3
    unit: str = ""

    def verdict(self) -> str:
        """Confirmed, not confirmed or open, from the interval and the limits."""
        low, high = self.found.low, self.found.high
        if math.isnan(self.found.value):
            return OPEN
        if low >= self.least and high <= self.most:
            return CONFIRMED
        return NOT_CONFIRMED if high < self.least or low > self.most else OPEN

    def criterion(self) -> str:
        """In words."""
        least, most = (f"{limit:g}" for limit in (self.least, self.most))
        if math.isinf(self.least):
            return f"at most {most}"
        return f"at least {least}" if math.isinf(self.most) else f"{least} to {most}"

    def text(self) -> str:
        """The figure with its criterion."""
        return f"{self.what} {self.found.text(self.digits, self.unit)} ({self.criterion()})"


class Missing(KeyError):
    """A piece that has not been measured."""


class Found(dict[str, Any]):
    """Pieces by name; one that is not there says so as `Missing`."""

    def __missing__(self, name: str) -> Any:
        raise Missing(name)


Checks = Callable[[Found], Sequence[Check]]


class Claim(NamedTuple):
    """What a paper says, and the checks of it."""

    name: str  # "(a)", "Table 7"
    says: str
    checks: Checks
    why: str = ""
    pieces: str = ""  # `--only` that measures it again
    open: str = ""  # why it cannot be judged, whatever the figures


class Judged(NamedTuple):
    """A claim with its figures."""

    claim: Claim
    checks: Sequence[Check]
    verdict: str
    why: str


def judge(claim: Claim, found: Found) -> Judged:
    """The verdict, from the figures alone."""
    try:
        checks = claim.checks(found)
    except Missing as missing:
        return Judged(claim, (), OPEN, f"piece `{missing.args[0]}` is not measured")
    verdict = OPEN if claim.open else together([t.verdict() for t in checks])
    return Judged(claim, checks, verdict, ". ".join(part.rstrip(".") for part in (claim.open, claim.why) if part))


def together(verdicts: Sequence[str]) -> str:
    """One verdict of several."""
    if not verdicts or all(v == OPEN for v in verdicts):
        return OPEN
    if all(v == CONFIRMED for v in verdicts):
        return CONFIRMED
    return PARTLY if CONFIRMED in verdicts else NOT_CONFIRMED


def counts(judged: Sequence[Judged]) -> str:
    """How many of each verdict."""
    found = Counter(j.verdict for j in judged)
    return ", ".join(f"{found[v]} {v}" for v in VERDICTS if found[v])


def claims_table(judged: Sequence[Judged], command: str) -> str:
    """The table of claims, and how to get each number."""
    rows = []
    for j in judged:
        name = f"'{j.claim.pieces}'" if " " in j.claim.pieces else j.claim.pieces
        again = f"`--only {name}`" if name else ""
        why = ". ".join(part for part in (j.why, again) if part)
        rows.append([j.claim.name, j.claim.says, "; ".join(t.text() for t in j.checks) or "-", f"**{j.verdict}**", why])
    head = ["claim", "the paper", "measured here, 95 % interval (criterion)", "verdict", "why; how to measure it again"]
    return (
        f"Of {len(judged)} claims and printed figures: {counts(judged)}.\n\n{markdown(head, rows)}\n\n"
        "A verdict follows from the figures alone. A check is confirmed where its whole interval meets the criterion, "
        "missed where "
        "none of it does, open where the interval holds the limit. A claim is confirmed where all its checks are, partly "
        "where some "
        "are, not confirmed where none is and one is missed; where all are open it cannot be judged. A figure without an "
        "interval is "
        "computed, not sampled; checks of one claim are of the same flights. "
        f"`{command} --only NAME` measures the pieces of a row again, `{command} --page-only` renders the page.\n"
    )


def section(make: Callable[[Found], str], found: Found) -> str:
    """A section of a page, or which piece it waits for."""
    try:
        return make(found)
    except Missing as missing:
        waits = f"iece `{missing.args[0]}` is not measured.*\n"
        while isinstance(make, functools.partial):
            make = make.func
        title = (make.__doc__ or "").strip().partition("\n")[0].rstrip(".")
        return f"*{title}: p{waits}" if title else f"*P{waits}"
