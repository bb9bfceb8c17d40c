"""The source's Tables 5 to 10, with what was measured beside them."""

from __future__ import annotations

import numpy as np

from baselines.filters.covariance_adaptation import EPS_R
from benchmarks.reproduction.claims import Found, Missing, mean, share
from benchmarks.reproduction.cmg_satellite import earlier
from benchmarks.reproduction.cmg_satellite.blocks import scenarios_of
from benchmarks.reproduction.cmg_satellite.claims import timed
from benchmarks.reproduction.cmg_satellite.paper import CHANGES, GRIDS, LEVELS, LITERAL
from benchmarks.reproduction.cmg_satellite.plan import REFERENCE, campaign_blocks
from benchmarks.reproduction.cmg_satellite.results import (
    PHASES,
    column,
    confusion,
    line,
    near,
    units,
)
from fdi_gym.plants import cmg_satellite as cmg
from fdi_gym.tables import markdown

PAPER = REFERENCE["paper"]
STATES = ("attitude q1 to q3", "rate [rad/s]", "gimbal angles [rad]")


def table_5(found: Found) -> str:
    """Table 5"""
    drawn: dict[str, list[float]] = {name: [] for name in PAPER["ranges"]}
    mine = [b for b in campaign_blocks(False) if b.method == GRIDS[-1] and b.snr == 45]
    for b in mine:
        for s in scenarios_of(b):
            fault = s.faults[0]
            assert fault.end is not None
            drawn["start [s]"].append(fault.onset * cmg.DT)
            drawn["duration [s]"].append((fault.end - fault.onset) * cmg.DT)
            drawn["alpha_i"] += [-f.effects[0].value + 1.0 for f in s.faults]  # type: ignore[union-attr]
            if s.x0 is not None:
                drawn["q_i"] += s.x0[:4]
                drawn["omega_i [rad/s]"] += s.x0[4:7]
    rows = [[name, f"{low:g} to {high:g}", f"{min(drawn[name]):.2f} to {max(drawn[name]):.2f}", str(len(drawn[name]))]
            for name, (low, high) in PAPER["ranges"].items()]  # fmt: skip
    return (
        "**Table 5**, ranges of the random flights; the duration goes up to 199 s less the start. q is normalised. On the "
        "slew a "
        "flight starts on the reference; initial attitude and rate are those of the flights that regulate.\n\n"
        + markdown(["quantity", "source", "drawn here", "values"], rows) + "\n"
    )  # fmt: skip


def table_6(found: Found) -> str:
    """Table 6"""
    told, mark = earlier.counts(found)
    counts = np.array(told)
    n = counts[1:].sum(axis=1)
    cells = [
        [units(i), str(printed), share(int(counts[i, i]), int(n[i - 1])).text(2), *(str(v) if v else "." for v in counts[i])]
        for i, printed in zip(range(1, 16), PAPER["confusion"]["diagonal"], strict=True)
    ]  # fmt: skip
    return (
        f"**Table 6**, SGAUKF, 45 dB, slew{mark}: {int(n.sum())} flights ({int(n.min())} to {int(n.max())} of each label; "
        "the source "
        "has 100 of each). Rows true, columns decided. The source prints no column 0, and 0 or 1 in each of its 210 cells "
        "off the "
        "diagonal.\n\n" + markdown(["true", "source, of 100", "right here", *map(str, range(16))], cells) + "\n"
    )  # fmt: skip


def errors(found: Found) -> str:
    """Errors of the three filters"""
    r, rows = earlier.results(found), []
    for m in GRIDS:
        for s in LEVELS:
            counts = confusion(r.outcomes("table5", "slew", s, m))
            wrong = counts - np.diag(np.diag(counts))
            wrongs, none, neighbours = int(wrong.sum()), int(wrong[:, 0].sum()), near(wrong)
            rows.append([m, *map(str, (s, counts.sum(), wrongs, none, neighbours, wrongs - none - neighbours))])
    head = ["method", "dB", "n", "errors", 'decided "none"', "one unit differs", "more units differ"]
    return f"Errors of the three filters on Table 5's ranges, slew.\n\n{markdown(head, rows)}\n"


def table_7(found: Found) -> str:
    """Table 7"""

    def cell(variant: str, profile: str, snr: int, method: str) -> str:
        try:
            (p, low, high, n), mark = earlier.accuracy(found, variant, profile, snr, method)
        except Missing:
            return "-"
        return f"{100 * p:.1f} [{100 * low:.1f}, {100 * high:.1f}], n = {n}{mark}"

    rows = [
        [m, s, f"{value:.2f}", *(cell(v, g, int(s), m) for v, g in (("table5", "slew"), ("table5", "regulate"), ("bench",
        "slew")))]
        for m, claimed in PAPER["accuracy"].items() for s, value in claimed.items()
    ]  # fmt: skip
    head = ["method", "dB", "source", "Table 5, slew", "Table 5, regulate", '"bench", slew']
    return (
        '**Table 7**, accuracy (%): the label most frequent over the second half of the window. "bench": windows of 20 to '
        "45 s, "
        "losses of 0.1 to 0.9. The same flights for all filters and levels; figures of one column are not independent. A "
        "dash has "
        f"never been measured.\n\n{markdown(head, rows)}\n"
    )


def table_8(found: Found) -> str:
    """Table 8"""
    told, rows = PAPER["seconds"], []
    for m, value in told.items():
        levels = timed(found, (m,))
        ours = [found[f"time-{s}-{m}"] for s in levels]
        rows.append([m, f"{value:.2f} ({value / told['SGAUKF']:.2f})", " / ".join(map(str, levels)),
                     " / ".join(f"{p['whole']:.2f}" for p in ours),
                     " / ".join(f"{p['whole'] / p['plain'][1]:.0f}" for p in ours),
                     " / ".join(str(p["steps"]) for p in ours)])  # fmt: skip
    head = ["method", "source [s] (ratio to SGAUKF)", "dB", "here [s]", "in plain steps", "adapted steps"]
    return (
        "**Table 8**, execution time of a run of 200 s. Here: processor time of one flight of Table 4 (slew) shown alone, "
        "20,000 steps, "
        "after a warm-up. The machine was shared, and its seconds differ between runs by tens of per cent; a plain step is "
        "the same "
        f"work in all three filters, so a run is counted in plain steps of its own, too.\n\n{markdown(head, rows)}\n"
    )


def table_9(found: Found) -> str:
    """Table 9"""

    def cell(profile: str, snr: int, method: str, phase: str) -> str:
        try:
            means, mark = earlier.line_means(found, profile, snr, method)
        except Missing:
            return "-"
        return means[phase].text(4) + (f", n = 10{mark}" if mark else "")

    rows = [
        [m, s, phase, f"{printed:.4f}", *(cell(g, int(s), m, phase) for g in ("slew", "regulate"))]
        for m, claimed in PAPER["rmse"].items() for s, values in claimed.items()
        for phase, printed in zip(PHASES, values, strict=True)
    ]  # fmt: skip
    return (
        "**Table 9**, RMSE of the effectiveness over Table 4's time line, mean of flights with 95 % intervals (of the "
        "earlier run the "
        "means alone). The same flights for all filters and levels. The source flies "
        f'"regulate".\n\n{markdown(["method", "dB", "phase", "source", "slew", "regulate"], rows)}\n'
    )


def phases(found: Found) -> str:
    """RMSE of random flights by phase"""

    def cell(variant: str, snr: int, method: str, phase: str) -> str:
        try:
            m, mark = earlier.rmse(found, variant, snr, method, phase)
        except Missing:
            return "-"
        return m.text(4) + mark

    rows = [
        [m, str(s), process, *(cell(variant, s, m, phase) for phase in PHASES)]
        for m in ("UKF", *GRIDS) for s in LEVELS for variant, process in (("bench", '"bench"'), ("table5",
        "Table 5's ranges"))
    ]  # fmt: skip
    head = ["method", "dB", "random flights", *(f"RMSE {phase}" for phase in PHASES)]
    return f"RMSE of the effectiveness in random flights on the slew, by phase.\n\n{markdown(head, rows)}\n"


def table_10(found: Found) -> str:
    """Table 10"""
    rows = []
    for m, claimed in PAPER["isolation"].items():
        for s, (least, most) in claimed.items():
            p = found.get(f"time-{s}-{m}")
            printed = [m, s, f"{least:.2f} / {most:.2f}"]
            if p is None:
                rows.append([*printed, "-", "-", "-", "-"])
                continue
            per = [t for _, t in p["changes"]]
            low, middle, high = (1e3 * v for v in p["adapted"])
            rows.append([*printed, f"{min(per):.3f} / {max(per):.3f}", f"{low:.2f} / {middle:.2f} / {high:.2f}",
                         f"{1e3 * p['plain'][1]:.2f}", str(p["steps"])])  # fmt: skip
    timed(found, GRIDS[-1:])
    head = ["method", "dB", "source, shortest / longest [s]", f"here, of the {len(CHANGES)} changes: shortest / longest [s]",
            "an adapted step, shortest / median / longest [ms]", "a plain step, median [ms]", "adapted steps"]  # fmt: skip
    return (
        "**Table 10**, computing time of isolation and identification. Here: processor time of all adapted steps after a "
        "change of f, "
        f"one flight of Table 4 (slew) shown alone, after a warm-up. A dash is not measured.\n\n{markdown(head, rows)}\n"
    )


def states(found: Found) -> str:
    """State estimates"""
    rows = []
    for m in ("UKF", *GRIDS):
        for s in LEVELS:
            try:
                values = np.array(column(line(found, "slew", s, [m])[0], "state"))
            except Missing:
                continue
            rows.append(
                [m, str(s), *(f"{v.value:.2e} [{v.low:.2e}, {v.high:.2e}], n = {v.n}" for v in map(mean, values.T.tolist()))]
            )
    if not rows:
        raise Missing("line-slew-45-SGAUKF-0")
    noise = cmg.sensor_sigma("slew", 45.0)
    sensors = ", ".join(f"{noise[i]:.2e}" for i in (0, 3, 6))
    return (
        "## State estimates\n\nRMSE from 5 s on over Table 4 (slew), estimated together with the effectiveness; the "
        "sensors at 45 dB "
        f"have {sensors}. Those that are measured.\n\n{markdown(['method', 'dB', *STATES], rows)}\n"
    )


def literal(found: Found) -> str:
    """The source's words taken literally"""
    rows, cases = [], []
    for grid in (*LITERAL, "SGAUKF"):
        try:
            (o,) = line(found, "slew", 45, [grid if grid == "SGAUKF" else f"literal {grid}"])
        except Missing:
            rows.append([grid, "0", *"-----"])
            continue
        rows.append([grid, str(len(o)), *(mean(column(o, phase)).text(3) for phase in PHASES),
                     mean([100 * v for v in column(o, "right")]).text(1), mean(column(o, "adapted")).text(0)])  # fmt: skip
    head = ["elements that are raised", "flights", *(f"RMSE {p}" for p in PHASES), "steps right (%)", "adapted steps"]
    for g in ("slew", "regulate"):
        for s in (45, 75):
            p = found.get(f"residual-{g}-{s}")
            cases.append([f"{g}, {s} dB", f"{max(p['largest']):.1e}", f"{p['eps_r']:g}", str(sum(p["above"]))] if p else
                         [f"{g}, {s} dB", "-", f"{EPS_R:g}", "-"])  # fmt: skip
    return (
        "## The source's words taken literally\n\nSGAUKF over Table 4, slew, 45 dB. *odd*, *even*: one half of the "
        "effectiveness's "
        "variances, always; *SGAUKF*: both in turn; *state block*: the variances of attitude and rate, both of an axis "
        "together.\n\n"
        + markdown(head, rows) + "\n\nThe residual test without weights, r'r > eps_r, on three flights each (a dash is not "
                                 "measured):\n\n"
        + markdown(["case", "largest r'r", "eps_r", "samples above"], cases) + "\n"
    )  # fmt: skip
