"""The satellite source's claims and printed tables, as checks of pieces."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from benchmarks.reproduction.claims import (
    Check,
    Checks,
    Claim,
    Found,
    Measured,
    Missing,
    exact,
    paired_shares,
    ratio,
    share,
)
from benchmarks.reproduction.cmg_satellite.earlier import accuracy, counts, line_means, results, rmse
from benchmarks.reproduction.cmg_satellite.paper import GRIDS, LEVELS
from benchmarks.reproduction.cmg_satellite.plan import REFERENCE
from benchmarks.reproduction.cmg_satellite.results import PHASES, column, line, near, right

PAPER = REFERENCE["paper"]
NEAR = 0.25  # a printed RMSE is met within this share of it
POINTS = 2.0  # a printed accuracy within so many points


def points(m: Measured) -> Measured:
    """A share in per cent."""
    return Measured(100 * m.value, 100 * m.low, 100 * m.high, m.n)


def unpaired(a: Measured, b: Measured) -> Measured:
    """Difference of two shares from their own intervals (Newcombe's), of the same flights or not."""
    middle = a.value - b.value
    low = math.hypot(a.value - a.low, b.high - b.value)
    high = math.hypot(a.high - a.value, b.value - b.low)
    return Measured(middle, middle - low, middle + high, min(a.n, b.n))


def quotient(a: Measured, b: Measured) -> Measured:
    """Ratio of two means from their own intervals, of the same flights or not."""
    half = math.hypot((a.high - a.value) / a.value, (b.high - b.value) / b.value)
    middle = a.value / b.value
    return Measured(middle, middle * math.exp(-half), middle * math.exp(half), min(a.n, b.n))


def ahead_of(other: str, least: float) -> Checks:
    """By how many points SGAUKF is more accurate: the same flights, paired where the flights themselves are at hand."""

    def checks(found: Found) -> list[Check]:
        made = []
        for variant, name in (("table5", "Table 5"), ("bench", '"bench"')):
            for s in LEVELS:
                try:
                    ours, theirs = results(found).paired(variant, "slew", s, ("SGAUKF", other))
                    ahead, mark = paired_shares(right(ours), right(theirs)), ""
                except Missing:
                    (mine, mark), (its, _) = (accuracy(found, variant, "slew", s, m) for m in ("SGAUKF", other))
                    ahead = unpaired(mine, its)
                made.append(Check(f"{name}, {s} dB, points ahead{mark}", points(ahead), least, digits=1))
        return made

    return checks


def table_7(profile: str, *methods: str) -> Checks:
    """Accuracies against the printed ones; those that have been measured."""

    def checks(found: Found) -> list[Check]:
        made, missing = [], None
        for m in methods:
            for s, value in PAPER["accuracy"][m].items():
                try:
                    ours, mark = accuracy(found, "table5", profile, int(s), m)
                except Missing as lacking:
                    missing = lacking
                    continue
                made.append(Check(f"{m}, {s} dB{mark}", points(ours), value - POINTS, value + POINTS, 1, "%"))
        if not made and missing is not None:
            raise missing
        return made

    return checks


def averages(found: Found) -> list[Check]:
    """The printed averages against the means of the printed rows."""
    return [Check(f"{m}: mean of its row less its average", exact(float(np.mean(list(row.values()))) - PAPER["averages"][m]),
            -0.01,
                 0.01, 2) for m, row in PAPER["accuracy"].items()]  # fmt: skip


def timed(found: Found, methods: Sequence[str]) -> list[int]:
    """The noise levels at which all of these have been timed, one flight at each.

    Raises:
        Missing: There is none.
    """
    levels = [s for s in LEVELS if all(f"time-{s}-{m}" in found for m in methods)]
    if not levels:
        raise Missing(next(name for s in LEVELS for m in methods if (name := f"time-{s}-{m}") not in found))
    return levels


def relative(found: Found, snr: int, method: str, figure: str) -> float:
    """Processor time in units of a plain step of the same run, which is the same work in all three filters."""
    piece = found[f"time-{snr}-{method}"]
    value: float = piece["whole"] if figure == "whole" else piece["adapted"][1]
    return value / piece["plain"][1]


def times(found: Found, figure: str, above: str, below: str) -> Measured:
    """Ratio of the times of two filters over the levels at which both have been timed."""
    levels = timed(found, (above, below))
    return ratio(*([relative(found, s, m, figure) for s in levels] for m in (above, below)))


def faster(found: Found) -> list[Check]:
    """Execution time of a whole flight, SGAUKF against GAUKF, one flight at each noise level."""
    return [Check("time of SGAUKF / GAUKF", times(found, "whole", "SGAUKF", "GAUKF"), 0.65, 0.8, 2)]


def table_8(found: Found) -> list[Check]:
    """Ratios of the execution times."""
    told, made = PAPER["seconds"], []
    for m in GRIDS[:2]:
        printed = told[m] / told["SGAUKF"]
        made.append(
            Check(
                f"{m} / SGAUKF (printed {printed:.2f})", times(found, "whole", m, "SGAUKF"), 0.9 * printed, 1.1 * printed, 2
            )
        )
    return made


def larger_during(found: Found) -> list[Check]:
    """RMSE during against before and after: "bench", SGAUKF."""
    made = []
    for s in LEVELS:
        (during, mark), *others = (rmse(found, "bench", s, "SGAUKF", phase) for phase in ("faulty", "pre", "post"))
        made += [Check(f"{s} dB, during / {phase}{mark}", quotient(during, m), 1.0, digits=2)
                 for (m, _), phase in zip(others, ("before", "after"), strict=True)]  # fmt: skip
    return made


def proportional(found: Found) -> list[Check]:
    """RMSE during the fault at 45 against 75 dB, where the noise is 31.6 times as large."""
    printed = PAPER["rmse"]["SGAUKF"]
    made = [Check("the source's own, SGAUKF", exact(printed["45"][1] / printed["75"][1]), 10.0, digits=2)]
    for m in GRIDS:
        (loud, mark), (quiet, _) = (rmse(found, "bench", s, m, "faulty") for s in (45, 75))
        made.append(Check(f"{m}: RMSE at 45 / 75 dB{mark}", quotient(loud, quiet), 10.0, digits=2))
    return made


def grows(found: Found) -> list[Check]:
    """Adapted steps at 45 against 75 dB, whose time is the computing time of isolation, the same flights."""
    made, missing = [], None
    for m in GRIDS:
        try:
            loud, quiet = (column(line(found, "slew", s, [m])[0], "adapted") for s in (45, 75))
        except Missing as lacking:
            missing = lacking
            continue
        n = min(len(loud), len(quiet))
        made.append(Check(f"{m}: adapted steps at 45 / 75 dB", ratio(loud[:n], quiet[:n]), 1.2, digits=2))
    if not made and missing is not None:
        raise missing
    return made


def table_10(found: Found) -> list[Check]:
    """Order of the filters by the time of an adapted step, and the printed ratio of the longest times at 45 dB."""
    return [Check(f"an adapted step, {slow} / {fast}", times(found, "adapted", slow, fast), 1.0, digits=2)
            for slow, fast in (("CAUKF", "GAUKF"), ("GAUKF", "SGAUKF"))]  # fmt: skip


def literally(grids: Sequence[str], words: str) -> Checks:
    """RMSE during the faults with a literal reading against both halves in turn, the same flights."""

    def checks(found: Found) -> list[Check]:
        made = []
        for grid in grids:
            ours, base = line(found, "slew", 45, [f"literal {grid}", "SGAUKF"])
            made.append(Check(f"{grid} {words}, RMSE during", ratio(column(ours, "faulty"), column(base, "faulty")),
            most=1.5,
                              digits=1))  # fmt: skip
        return made

    return checks


def residual_test(found: Found) -> list[Check]:
    """The largest unweighted r'r against eps_r."""
    return [
        Check(f"{g}, {s} dB: largest r'r / eps_r", exact(max(p["largest"]) / p["eps_r"]), 1.0, digits=6)
        for g in ("slew", "regulate") for s in (45, 75) for p in (found[f"residual-{g}-{s}"],)
    ]  # fmt: skip


def table_9(profile: str) -> Checks:
    """How many of the printed RMSE are met by ours, means over flights."""

    def checks(found: Found) -> list[Check]:
        cells, during, marks = [], [], set()
        for m, row in PAPER["rmse"].items():
            for s, values in row.items():
                try:
                    ours, mark = line_means(found, profile, int(s), m)
                except Missing:
                    continue
                marks.add(mark)
                cells += [abs(ours[phase].value - v) <= NEAR * v for phase, v in zip(PHASES, values, strict=True)]
                during.append(math.log(ours["faulty"].value / values[1]))
        if not cells:
            raise Missing(f"line-{profile}-45-CAUKF-0")
        mark = max(marks)
        return [
            Check(f"share of {len(cells)} printed RMSE met within {100 * NEAR:g} %{mark}", exact(float(np.mean(cells))), 0.9,
            digits=2),
            Check(f"RMSE during, ours / printed, geometric mean{mark}", exact(math.exp(float(np.mean(during)))), 0.75, 1.25,
            2),
        ]  # fmt: skip

    return checks


def errors_far(found: Found) -> list[Check]:
    """Errors of SGAUKF at 45 dB: shares that are off by more than one unit, and that call the flight healthy."""
    told, mark = counts(found)
    table = np.array(told)
    wrong = table - np.diag(np.diag(table))
    total, none, close = int(wrong.sum()), int(wrong[:, 0].sum()), near(wrong)
    return [Check(f"share of the errors that name a set more than one unit off{mark}", share(total - none - close, total),
            0.5,
                  digits=2),
            Check(f'flights called "none"{mark}', share(none, int(table.sum())), most=0.01)]  # fmt: skip


def diagonal(found: Found) -> list[Check]:
    """Recall of all labels together against the mean of the printed diagonal."""
    told, mark = counts(found)
    table, printed = np.array(told), float(np.mean(PAPER["confusion"]["diagonal"]))
    recall = points(share(int(np.diag(table)[1:].sum()), int(table[1:].sum())))
    return [Check(f"recall, all labels{mark}", recall, printed - POINTS, printed + POINTS, 1, "%")]


def adaptation_needed(found: Found) -> list[Check]:
    """The filter without adaptation against GAUKF, "bench"."""
    made = []
    for s in LEVELS:
        (plain, mark), (grid, _) = (rmse(found, "bench", s, m, "faulty") for m in ("UKF", "GAUKF"))
        made.append(Check(f"{s} dB: UKF / GAUKF, RMSE during{mark}", quotient(plain, grid), 2.0, digits=1))
    return made


TABLE_5, BENCH, TABLE_4, TIME, LITERAL = "table5-slew", "bench-slew", "line-slew", "time-", "literal-"
SEEN = "with the excitation of the slew; while regulating no filter sees a fault, see below"


CLAIMS: Sequence[Claim] = (
    Claim("(a)", "SGAUKF is more accurate than GAUKF (Table 7: 94.20 against 93.02 %)", ahead_of("GAUKF", 0.5),
          f"half a point at least, half of what is printed, at each level, paired; {SEEN}", TABLE_5),
    Claim("(a), CAUKF", "and than CAUKF (75.27 %)", ahead_of("CAUKF", 5.0), "five points at least", TABLE_5),
    Claim("(b)", "27 % less time than GAUKF (6.36 against 8.74 s for a run of 200 s)", faster,
          "one flight alone, processor time, warmed up; the plain steps are the same for all, so that 1 % of adapted steps "
          "decides little", TIME),
    Claim("(c)", "RMSE is larger during the fault than before and after it", larger_during, SEEN, BENCH),
    Claim("(c), noise", "RMSE is proportional to the noise", proportional,
          "a factor of 31.6 in noise; ten at least would be near proportional", BENCH),
    Claim("(d)", "Computing time grows with the noise, as more iterations are needed", grows,
          "counted in adapted steps, the same flights",
          TABLE_4),
    Claim("(e)", "Adapting half of the elements, odd or even, suffices", literally(("odd", "even"), "/ alternating"),
          "the other half keeps the small variance that it converged to, and the error is pushed into the half that is "
          "raised", LITERAL),
    Claim("Table 6", "SGAUKF, 45 dB: 87 to 94 of 100 right for each label", diagonal, "", TABLE_5),
    Claim("Table 6, errors", "Errors name far sets as often as near ones, never none", errors_far,
          "all 210 cells off the diagonal are printed as 0 or 1: no threshold on four estimates can do that", TABLE_5),
    *(Claim(f"Table 7, {m}", f"Accuracy of {m}: {', '.join(f'{v:g} % at {k} dB' for k, v in PAPER['accuracy'][m].items())}",
            table_7("slew", m), f"within {POINTS:g} points; {SEEN}", TABLE_5) for m in GRIDS),
    Claim("Table 7, regulate", "The same in the source's own case", table_7("regulate", *GRIDS),
          "after some 15 s the satellite is at rest, gimbals hardly move, and effectiveness shows in nothing",
          "table5-regulate"),
    Claim("Table 7, averages", "Averages 75.27, 93.02, 94.20 %", averages,
          "arithmetic on the printed figures; CAUKF's mean is 76.35"),
    Claim("Table 8", "Execution times 9.69, 8.74, 6.36 s", table_8, "ratios within 10 %; seconds are the machine's, so a "
                                                                    "run is counted in plain steps of its own", TIME),
    Claim("Table 9", "RMSE before, during and after the faults of Table 4", table_9("slew"), SEEN, TABLE_4),
    Claim("Table 9, regulate", "The same in the source's own case", table_9("regulate"),
          'about 0.43 is the RMSE of "always healthy"',
          "line-regulate"),
    Claim("Table 10", "Computing time of isolation: CAUKF > GAUKF > SGAUKF", table_10, "three levels, one flight each",
          TIME),
    Claim("motive", "Without adaptation the filter stays near the old value", adaptation_needed, "", BENCH),
    Claim("residual", "The adaptation runs while r'r > eps_r = 1e-3", residual_test,
          "unweighted, the test never fires: angles and rates are all small; here the innovation is weighted",
          "residual-"),
    Claim("state block", "The elements of the state's covariance are raised", literally(("state block",), "/ theta block"),
          "attitude and rate in place of the effectiveness: the text says covariance of the states and adapts a joint "
          "filter", LITERAL),
)  # fmt: skip
