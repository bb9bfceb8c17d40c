"""The satellite source's claims and printed tables, as checks of pieces."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from benchmarks.reproduction.claims import Check, Checks, Claim, Found, Measured, exact, mean, paired_shares, ratio, share
from benchmarks.reproduction.cmg_satellite.paper import GRIDS, LEVELS
from benchmarks.reproduction.cmg_satellite.plan import REFERENCE, blocks
from benchmarks.reproduction.cmg_satellite.results import PHASES, Results, column, confusion, near, right

PAPER = REFERENCE["paper"]
NEAR = 0.25  # a printed RMSE is met within this share of it
POINTS = 2.0  # a printed accuracy within so many points
CONFUSED = "campaign at 45 dB"


def results(found: Found) -> Results:
    """What is measured of the blocks."""
    return Results({b: found[b.name()] for b in blocks(False) if b.name() in found})


def points(m: Measured) -> Measured:
    """A share in per cent."""
    return Measured(100 * m.value, 100 * m.low, 100 * m.high, m.n)


def accuracy(found: Found, profile: str, snr: int, method: str) -> Measured:
    """Share of the flights of Table 5's ranges that are labelled right [%]."""
    o = results(found).outcomes("table5", profile, snr, method)
    return points(share(sum(right(o)), len(o)))


def ahead_of(other: str, least: float) -> Checks:
    """By how many points SGAUKF is more accurate, the same flights."""

    def checks(found: Found) -> list[Check]:
        made = []
        for s in LEVELS:
            ours, theirs = results(found).paired("table5", "slew", s, ("SGAUKF", other))
            made.append(Check(f"{s} dB, points ahead", points(paired_shares(right(ours), right(theirs))), least, digits=1))
        return made

    return checks


def table_7(profile: str) -> Checks:
    """Accuracies against the printed ones."""
    return lambda found: [
        Check(f"{m}, {s} dB", accuracy(found, profile, int(s), m), value - POINTS, value + POINTS, 1, "%")
        for m, row in PAPER["accuracy"].items() for s, value in row.items()
    ]  # fmt: skip


def averages(found: Found) -> list[Check]:
    """The printed averages against the means of the printed rows."""
    return [Check(f"{m}: mean of its row less its average", exact(float(np.mean(list(row.values()))) - PAPER["averages"][m]),
            -0.01,
                 0.01, 2) for m, row in PAPER["accuracy"].items()]  # fmt: skip


def faster(found: Found) -> list[Check]:
    """Execution time of a whole flight, SGAUKF against GAUKF, one flight at each noise level."""
    ours, theirs = ([found[f"time-{s}-{m}"]["whole"] for s in LEVELS] for m in ("SGAUKF", "GAUKF"))
    return [Check("time of SGAUKF / GAUKF", ratio(ours, theirs), 0.65, 0.8, 2)]


def table_8(found: Found) -> list[Check]:
    """Ratios of the execution times."""
    told = PAPER["seconds"]
    times = {m: [found[f"time-{s}-{m}"]["whole"] for s in LEVELS] for m in GRIDS}
    return [Check(f"{m} / SGAUKF (printed {told[m] / told['SGAUKF']:.2f})", ratio(times[m], times["SGAUKF"]),
                 0.9 * told[m] / told["SGAUKF"], 1.1 * told[m] / told["SGAUKF"], 2) for m in GRIDS[:2]]  # fmt: skip


def rmse(found: Found, snr: int, method: str, phase: str, profile: str = "slew") -> list[float]:
    """RMSE of each flight of Table 4."""
    return column(results(found).outcomes("table4", profile, snr, method), phase)


def larger_during(found: Found) -> list[Check]:
    """RMSE during against before and after, the same flights, SGAUKF."""
    return [
        Check(f"{s} dB, during / {phase}", ratio(rmse(found, s, "SGAUKF", "faulty"), rmse(found, s, "SGAUKF", phase)), 1.0,
             digits=2)
        for s in LEVELS for phase in ("pre", "post")
    ]  # fmt: skip


def proportional(found: Found) -> list[Check]:
    """RMSE during the fault at 45 against 75 dB, where the noise is 31.6 times as large."""
    made = [Check(f"{m}: RMSE at 45 / 75 dB", ratio(rmse(found, 45, m, "faulty"), rmse(found, 75, m, "faulty")), 10.0,
    digits=2)
            for m in GRIDS]  # fmt: skip
    return [Check("the source's own, SGAUKF", exact(PAPER["rmse"]["SGAUKF"]["45"][1] / PAPER["rmse"]["SGAUKF"]["75"][1]),
            10.0, digits=2),
            *made]  # fmt: skip


def grows(found: Found) -> list[Check]:
    """Adapted steps at 45 against 75 dB, whose time is the computing time of isolation, the same flights."""
    return [
        Check(f"{m}: adapted steps at 45 / 75 dB", ratio(rmse(found, 45, m, "adapted"), rmse(found, 75, m, "adapted")), 1.2,
             digits=2)
        for m in GRIDS
    ]  # fmt: skip


def table_10(found: Found) -> list[Check]:
    """Order of the filters: time of an adapted step, and of all those after one change."""
    made = []
    for slow, fast in (("CAUKF", "GAUKF"), ("GAUKF", "SGAUKF")):
        for name, figure in (
            ("adapted step", lambda p: p["adapted"][1]),
            ("after a change", lambda p: max(t for _, t in p["changes"])),
        ):
            values = [[figure(found[f"time-{s}-{m}"]) for s in LEVELS] for m in (slow, fast)]
            made.append(Check(f"{name}: {slow} / {fast}", ratio(*values), 1.0, digits=2))
    return made


def half_suffices(found: Found) -> list[Check]:
    """RMSE with one half always raised against both in turn."""
    o = {grid: found[f"literal-{grid}"]["outcomes"] for grid in ("odd", "even", "alternating")}
    base = column(o["alternating"], "faulty")
    return [Check(f"{grid} / alternating, RMSE during", ratio(column(o[grid], "faulty"), base), most=1.5, digits=1)
            for grid in ("odd", "even")]  # fmt: skip


def state_block(found: Found) -> list[Check]:
    """RMSE with the variances of attitude and rate raised in place of theta's."""
    o = {grid: column(found[f"literal-{grid}"]["outcomes"], "faulty") for grid in ("state block", "alternating")}
    return [Check("state block / theta block, RMSE during", ratio(o["state block"], o["alternating"]), most=1.5, digits=1)]


def residual_test(found: Found) -> list[Check]:
    """The largest unweighted r'r against eps_r."""
    return [
        Check(f"{g}, {s} dB: largest r'r / eps_r", exact(max(p["largest"]) / p["eps_r"]), 1.0, digits=6)
        for g in ("slew", "regulate") for s in (45, 75) for p in (found[f"residual-{g}-{s}"],)
    ]  # fmt: skip


def table_9(profile: str) -> Checks:
    """How many of the 27 printed RMSE are met."""

    def checks(found: Found) -> list[Check]:
        cells = [(printed, float(np.mean(rmse(found, int(s), m, phase, profile))))
                 for m, row in PAPER["rmse"].items() for s, values in row.items() for phase, printed in zip(PHASES, values,
                 strict=True)]  # fmt: skip
        met = sum(abs(ours - printed) <= NEAR * printed for printed, ours in cells)
        during = [math.log(ours / printed) for (printed, ours) in cells[1::3]]
        return [Check(f"share of the {len(cells)} printed RMSE met within {100 * NEAR:g} %", exact(met / len(cells)), 0.9,
                digits=2),
                Check("RMSE during, ours / printed, geometric mean", exact(math.exp(float(np.mean(during)))), 0.75, 1.25,
                     2)]  # fmt: skip

    return checks


def errors_far(found: Found) -> list[Check]:
    """Errors of SGAUKF at 45 dB: shares that call the flight healthy, and that are off by more than one unit."""
    counts = confusion(results(found).outcomes("table5", "slew", 45, "SGAUKF"))
    wrong = counts - np.diag(np.diag(counts))
    total, none, close = int(wrong.sum()), int(wrong[:, 0].sum()), near(wrong)
    return [Check("share of the errors that name a set more than one unit off", share(total - none - close, total), 0.5,
            digits=2),
            Check('flights called "none"', share(none, int(counts.sum())), most=0.01)]  # fmt: skip


def diagonal(found: Found) -> list[Check]:
    """Recall of each label against the printed diagonal: how many printed values our intervals hold."""
    counts = confusion(results(found).outcomes("table5", "slew", 45, "SGAUKF"))
    held = []
    for label, printed in zip(range(1, 16), PAPER["confusion"]["diagonal"], strict=True):
        m = share(int(counts[label, label]), int(counts[label].sum()))
        held.append(m.low <= printed / 100 <= m.high)
    n = int(counts[1].sum())
    return [
        Check(
            f"share of the 15 printed recalls within our intervals (n = {n} each)",
            exact(float(np.mean(held))),
            0.9,
            digits=2,
        )
    ]


def regulate(found: Found) -> list[Check]:
    """The source's own case: RMSE during the faults."""
    return [Check(f"{m}, {s} dB", mean(rmse(found, s, m, "faulty", "regulate")), most=0.06) for s in LEVELS for m in GRIDS]


def adaptation_needed(found: Found) -> list[Check]:
    """The filter without adaptation against GAUKF."""
    return [Check(f"{s} dB: UKF / GAUKF, RMSE during", ratio(rmse(found, s, "UKF", "faulty"), rmse(found, s, "GAUKF",
            "faulty")), 5.0,
                 digits=1) for s in LEVELS]  # fmt: skip


TABLE_5, TABLE_4, TIME, LITERAL = "table5-slew", "table4-slew", "time-", "literal-"
SEEN = "with the excitation of the slew; while regulating no filter sees a fault, see below"


CLAIMS: Sequence[Claim] = (
    Claim("(a)", "SGAUKF is more accurate than GAUKF (Table 7: 94.20 against 93.02 %)", ahead_of("GAUKF", 0.5),
          f"half a point at least, half of what is printed, at each level, paired; {SEEN}", TABLE_5),
    Claim("(a), CAUKF", "and than CAUKF (75.27 %)", ahead_of("CAUKF", 5.0), "five points at least", TABLE_5),
    Claim("(b)", "27 % less time than GAUKF (6.36 against 8.74 s for a run of 200 s)", faster,
          "one flight alone, processor time, warmed up; the plain steps are the same for all, so that 1 % of adapted steps "
          "decides little", TIME),
    Claim("(c)", "RMSE is larger during the fault than before and after it", larger_during, SEEN, TABLE_4),
    Claim("(c), noise", "RMSE is proportional to the noise", proportional,
          "a factor of 31.6 in noise; ten at least would be near proportional", TABLE_4),
    Claim("(d)", "Computing time grows with the noise, as more iterations are needed", grows,
          "counted in adapted steps, the same flights",
          TABLE_4),
    Claim("(e)", "Adapting half of the elements, odd or even, suffices", half_suffices,
          "the other half keeps the small variance that it converged to, and the error is pushed into the half that is "
          "raised", LITERAL),
    Claim("Table 6", "SGAUKF, 45 dB: 87 to 94 of 100 right for each label", diagonal, "", TABLE_5),
    Claim("Table 6, errors", "Errors name far sets as often as near ones, never none", errors_far,
          "all 210 cells off the diagonal are printed as 0 or 1: no threshold on four estimates can do that", TABLE_5),
    Claim("Table 7", "Accuracy of three filters at three noise levels", table_7("slew"), f"within {POINTS:g} points; {SEEN}",
          TABLE_5),
    Claim("Table 7, regulate", "The same in the source's own case", table_7("regulate"),
          "after some 15 s the satellite is at rest, gimbals hardly move, and effectiveness shows in nothing",
          "table5-regulate"),
    Claim("Table 7, averages", "Averages 75.27, 93.02, 94.20 %", averages,
          "arithmetic on the printed figures; CAUKF's mean is 76.35"),
    Claim("Table 8", "Execution times 9.69, 8.74, 6.36 s", table_8, "ratios within 10 %; seconds are the machine's", TIME),
    Claim("Table 9", "RMSE before, during and after the faults of Table 4", table_9("slew"), SEEN, TABLE_4),
    Claim("Table 9, regulate", "The same in the source's own case", regulate, 'about 0.43 is the RMSE of "always healthy"',
          "table4-regulate"),
    Claim("Table 10", "Computing time of isolation: CAUKF > GAUKF > SGAUKF", table_10, "three levels, one flight each",
          TIME),
    Claim("motive", "Without adaptation the filter stays near the old value", adaptation_needed, "", TABLE_4),
    Claim("residual", "The adaptation runs while r'r > eps_r = 1e-3", residual_test,
          "unweighted, the test never fires: metres, radians and their rates are all small; here the innovation is weighted",
          "residual-"),
    Claim("state block", "The elements of the state's covariance are raised", state_block,
          "attitude and rate in place of the effectiveness: the text says covariance of the states and adapts a joint "
          "filter", LITERAL),
)  # fmt: skip
