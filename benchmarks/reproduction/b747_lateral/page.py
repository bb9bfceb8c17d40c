"""The Boeing 747's page, from its pieces."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.reproduction.b747_lateral import figures
from benchmarks.reproduction.b747_lateral.claims import CLAIMS
from benchmarks.reproduction.b747_lateral.measure import DETECTORS, GROUPS, PAPER_SEED, REFERENCE, Sizes, sizes
from benchmarks.reproduction.b747_lateral.paper import CONFUSED, STATED, WINDOWS
from benchmarks.reproduction.claims import Found, claims_table, judge, mean, section
from benchmarks.reproduction.comparison import Comparisons, binomial_error, shown
from benchmarks.reproduction.numbered import fly
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.plants import b747_lateral as b747
from fdi_gym.plots import flight
from fdi_gym.tables import markdown

INTRODUCTION = """# Boeing 747: the paper's figures, measured again

A. Guven, C. Hajiyev, [Two-Stage Kalman Filter Based Estimation of Boeing 747 Actuator/Control Surface Stuck
Faults](https://doi.org/10.37394/232014.2023.19.4), WSEAS Transactions on Signal Processing 19, 2023. The paper gives A, B,
the fault, and plots; sample time, noise, commands, the forgetting rule and the decision are this benchmark's, so what is
judged here is what the paper's method does under them. What differs from the paper, and why: [differences](differences.md).
"""
AGREEMENT = """## Agreement with a second implementation

This says nothing of the paper: an independent implementation of the same data sheet, with other random streams. Every cell
reads "reference / measured here"; a star marks a difference of more than three standard errors (from the spreads of both,
or the binomial ones). Before a fault, the restart filter and the structured estimates are zero unless a flight raised an
early alarm, which happens in none to two flights of 400. The delays of the known-onset reference were read at every tenth
sample, here at every one.
"""
COMMAND = "python -m benchmarks.reproduction.b747_lateral"


def write(found: Found, quick: bool, path: Path) -> None:
    """The page and its pictures."""
    path.write_text(page(found, quick), encoding="utf-8")
    picture(path.with_name("rudder.png"))
    if "figure" in found:
        figures.write(found["figure"], path.parent)


def page(found: Found, quick: bool) -> str:
    """The whole page."""
    judged = [judge(claim, found) for claim in CLAIMS]
    parts = [INTRODUCTION, f"## Claims\n\n{claims_table(judged, COMMAND)}"]
    parts += [section(part, found) for part in (printed, paper_figures, state_table, confusions)]
    return "\n".join([*parts, AGREEMENT, *agreement(found, sizes(quick))])


def agreement(found: Found, n: Sizes) -> list[str]:
    """The figures beside those of the second implementation."""
    t = Comparisons()
    parts: list[Callable[[Found], str]] = [
        lambda f: paper_estimates(t, f, n.seeds), lambda f: paper_logic(t, f, n.seeds),
        lambda f: excitation(t, f, n.seeds),
        *(functools.partial(randomised, t, variant=v, per_group=n.per_group) for v in REFERENCE["random"]),
        lambda f: mismatch(t, f, n.count), lambda f: simultaneous(t, f, n.count), lambda f: surfaces(t, f),
        *(functools.partial(intermittent, t, variant=v, episodes=n.hard) for v in REFERENCE["hard"]),
    ]  # fmt: skip
    texts = [section(part, found) for part in parts]
    return [t.summary() + "\n", *texts]


# -- the paper's own


def printed(found: Found) -> str:
    """Ranks, eigenvalues and matrices"""
    p = found["printed"]

    def roots(values: list[list[float]]) -> str:
        return ", ".join(f"{re:.4f}" + (f" {'+' if im > 0 else '-'} {abs(im):.4f}i" if im else "") for re, im in values)

    head = ["quantity", "paper", "here"]
    rows = [
        ["rank of controllability", "4", str(p["controllable"])], ["rank of observability", "4", str(p["observable"])],
        ["eigenvalues of the printed A", "-0.2897 +- 1.0765i, -0.6507 +- 0.4102i", roots(p["modes"])],
        ["of the airframe of Table 1", "not given", roots(p["bare modes"])],
    ]  # fmt: skip
    names = ["beta", "p", "r", "phi"]
    matrices = [
        [f"{letter}, row {name}", *(f"{a:g} / {b:.4g}" for a, b in zip(*rows_of, strict=True))]
        for letter, size in (("A", 4), ("B", 2))
        for name, *rows_of in zip(names, p[letter], p[f"bare {letter}"], strict=True) if len(rows_of[0]) == size
    ]  # fmt: skip
    a_rows, b_rows = matrices[:4], matrices[4:]
    feedback = ", ".join(f"{v:.3f}" for v in p["feedback"])
    return (
        f"## Printed numbers\n\n{markdown(head, rows)}\n\nThe matrices, printed / from the derivatives of Table 1 (two "
        "entries of it repaired):\n\n"
        + markdown(["row", *names], a_rows) + "\n\n" + markdown(["row", "aileron", "rudder"], b_rows)
        + f"\n\nThe yaw rows differ by one rudder feedback K = [{feedback}] on (beta, p, r, phi). The same K explains the "
          "first "
        f"row of A to {p['feedback error']:.1e}, without a free parameter: the printed A is an airframe with an active yaw "
        "damper, and a rudder that is stuck in the paper keeps it.\n"
    )  # fmt: skip


def paper_figures(found: Found) -> str:
    """Figures 2 to 6"""
    _ = found["figure"]  # what the pictures are made of
    return (
        "## The paper's figures\n\nFigure 1 compares the paper's nonlinear model with the linear one; the paper does not "
        "give "
        "that model, so the figure has no counterpart. One noise seed; the paper prints no values beside its plots.\n\n"
        "![Figure 2: inputs, the fault's entries and their errors](b747_lateral_faults.png)\n\n"
        "![Figures 3 to 6: the four states, true, with the two-stage filter and fault-blind](b747_lateral_states.png)\n\n"
        "![The paper's scenario: labels and the rudder's entries](rudder.png)\n"
    )


def state_table(found: Found) -> str:
    """State estimates"""
    rows = []
    for method in STATED:
        piece = found[f"states-{method}"]
        for window in WINDOWS:
            cells = [mean(np.array(piece[window])[:, i].tolist()).text(4) for i in range(4)]
            rows.append([method, window, *cells])
    sensors = np.array(found[f"states-{STATED[0]}"]["sensors"])
    rows.append(["the sensors", "faulty", *(mean(sensors[:, i].tolist()).text(4) for i in range(4))])
    head = ["filter", "window", "beta [deg]", "p [deg/s]", "r [deg/s]", "phi [deg]"]
    return (
        "## State estimates\n\nRMSE over the paper's scenario: before the fault (50 to 200 s), while it acts (230 to 600 "
        "s), "
        f"after it (630 to 800 s).\n\n{markdown(head, rows)}\n"
    )


def confusions(found: Found) -> str:
    """Confusion matrices"""
    parts = []
    for method in CONFUSED:
        piece = found[f"confusion-{method}"]
        names = piece["names"]
        rows = []
        for name, samples, flights in zip(names, piece["samples"], piece["flights"], strict=True):
            total = max(sum(samples), 1)
            rows.append([name, *(f"{100 * s / total:.1f} ({f})" for s, f in zip(samples, flights, strict=True))])
        parts.append(f"{method}:\n\n{markdown(['true', *names], rows)}\n")
    n = found[f"confusion-{CONFUSED[0]}"]["n"]
    return (
        f"## Confusion\n\nThe randomised process, {n} flights: rows the truth, columns what is declared, in % of the row's "
        f"samples, and in brackets the flights by their labels at the end.\n\n" + "\n".join(parts)
    )


# -- beside the second implementation


def paper_estimates(t: Comparisons, found: Found, seeds: int) -> str:
    """RMSE over the paper's scenario."""
    t.of("the paper's scenario")
    rows = []
    for method, reference in REFERENCE["scenario"]["rmse"].items():
        rmse = np.array(found[f"paper-{method}"]["rmse"])
        rows.append([method, *(
            t.cell(mean, values.mean(), error=math.hypot(spread, values.std(ddof=1)) / math.sqrt(seeds))
            for (mean, spread), values in zip(reference, rmse, strict=True)
        )])  # fmt: skip
    head = ["filter", "gamma_r pre", "b_r pre", "gamma_r faulty", "b_r faulty", "gamma_r post", "b_r post",
            "gamma_a faulty", "b_a faulty"]  # fmt: skip
    return f"### The paper's scenario, {seeds} noise seeds\n\nRMSE, mean over seeds.\n\n{markdown(head, rows)}\n"


def median_longest(delays: list[float | None]) -> tuple[float, float]:
    """Median, NaN where it never happens in half of the cases, and the longest."""
    values = np.array(delays, float)
    middle = float(np.median(np.where(np.isnan(values), math.inf, values)))
    return middle if math.isfinite(middle) else math.nan, float(np.fmax.reduce(values))


def paper_logic(t: Comparisons, found: Found, seeds: int) -> str:
    """What the distance logic makes of it, and when."""
    t.of("the paper's scenario")
    rows = []
    for method, reference in REFERENCE["scenario"]["logic"].items():
        piece, row = found[f"paper-{method}"], [method]
        for name, (middle, longest) in zip(("detection", "isolation", "release"), reference["delays"], strict=True):
            ours, ours_longest = median_longest(piece[name])
            # a median's standard error is about 1.25 standard deviations over the root of the count
            given = [v for v in piece[name] if v is not None]
            error = 1.25 * math.sqrt(2) * float(np.std(given)) / math.sqrt(seeds) if len(given) > 1 else 0.0
            row.append(f"{t.cell(middle, ours, 1, error)} ({shown(longest)} / {shown(ours_longest, 1)})")
        row += [f"{r:.3f} / {o:.3f}" for r, o in zip(reference["right"], piece["right"], strict=True)]
        rows.append([*row, f"{reference['early']} / {piece['early']}"])
    head = ["filter (distance logic)", "detection s, median (max)", "isolation s", "release s", "right 250-600 s",
            "right 650-800 s", "early alarms"]  # fmt: skip
    return markdown(head, rows) + "\n"


def excitation(t: Comparisons, found: Found, seeds: int) -> str:
    """Other commands."""
    t.of("the paper's scenario")
    rows = []
    for command, (*reference, delay) in REFERENCE["excitation"].items():
        piece = found[f"command-{command}"]
        rmse = np.array(piece["rmse"])[[2, 3, 6, 7]]
        rows.append([command, *(
            "-" if math.isnan(r) else t.cell(r, v.mean(), error=v.std(ddof=1) * math.sqrt(2 / seeds))
            for r, v in zip(reference, rmse, strict=True)
        ), f"{delay:g} / {shown(median_longest(piece['detection'])[0], 2)}"])  # fmt: skip
    head = ["command", "gamma_r", "b_r", "gamma_a", "b_a", "detection s"]
    return f"#### Excitation, exponential 0.99, faulty window\n\n{markdown(head, rows)}\n"


def randomised(t: Comparisons, found: Found, variant: str, per_group: int) -> str:
    """The randomised process: accuracy and alarms, the windowed NIS, estimates."""
    t.of(f"{variant}")
    flights, rows = GROUPS * per_group, []
    for method, reference in REFERENCE["random"][variant].items():
        if "acc" not in reference:
            continue
        piece, row = found[f"random-{variant}-{method}"], [method]
        for name in ("acc", "post", "late", "final"):
            (mean, spread), values = reference[name], np.array(piece[name], float)  # nan: a group without such samples
            error = math.hypot(spread, np.nanstd(values, ddof=1)) / math.sqrt(GROUPS)
            row.append(t.cell(mean, float(np.nanmean(values)), error=error))
        told = "det" in reference
        row.append(t.cell(reference["det"], piece["det"], error=binomial_error(0.03, 0.8 * flights)) if told else
                   f"- / {piece['det']:.3f}")  # fmt: skip
        row.append(" ".join(f"{r:g} / {o:.1f}" for r, o in zip(reference["delay"], piece["delay"], strict=True)))
        if "fa" in piece:
            row.append(t.cell(reference["fa"], piece["fa"], 4, binomial_error(reference["fa"], flights, 0.005)))
            row.append(f"{reference['fa_h']:.2f} / {piece['fa_h']:.2f}")
        rows.append(row + ["-"] * (9 - len(row)))
    head = ["method", "acc", "post", "late", "final", "det", "delay s, median, 90 %", "FA", "FA/h"]
    title = f"### Randomised process, {variant}\n\n{GROUPS} x {per_group} episodes."
    return "\n".join([f"{title}\n\n{markdown(head, rows)}\n", nis(t, found, variant, flights), estimates(t, found, variant)])


def nis(t: Comparisons, found: Found, variant: str, flights: int) -> str:
    """The windowed NIS test."""
    rows = []
    for name in DETECTORS:
        (det, *delays, fa), piece = REFERENCE["nis"][variant][name], found[f"nis-{variant}-{name}"]
        rows.append([
            name, t.cell(det, piece["det"], error=binomial_error(det, piece["faulty"])),
            *(f"{r:g} / {o:.1f}" for r, o in zip(delays, piece["delay"], strict=True)),
            t.cell(fa, piece["fa"], 4, binomial_error(fa, flights, 0.005)),
        ])  # fmt: skip
    return markdown(["NIS (window, confidence)", "det", "median s", "90 % s", "FA"], rows) + "\n"


def estimates(t: Comparisons, found: Found, variant: str) -> str:
    """RMSE on the randomised process."""
    rows = []
    for method, reference in REFERENCE["random"][variant].items():
        if "rmse" in reference:
            piece, row = found[f"random-{variant}-{method}"], [method]
            for phase in ("pre", "transient", "late"):
                errors = np.nanstd(np.array(piece["rmse"][phase], float), axis=1, ddof=1) * math.sqrt(2 / GROUPS)
                row.append(t.cells(reference["rmse"][phase], piece["rmse_all"][phase], errors=errors))
            rows.append(row)
    head = ["method", "pre", "transient", "late"]
    return f"RMSE of [gamma_a, gamma_r, b_a, b_r].\n\n{markdown(head, rows)}\n"


def mismatch(t: Comparisons, found: Found, count: int) -> str:
    """The true plant off the model."""
    t.of("mismatch")
    rows = []
    for delta, methods in REFERENCE["mismatch"].items():
        for method, (acc, late, fa) in methods.items():
            piece = found[f"mismatch-{delta}-{method}"]
            ours = piece["values"]
            rows.append([
                delta, method, t.cell(acc, ours[0], error=math.sqrt(2) * piece["acc_error"]), f"{late:.3f} / {ours[1]:.3f}",
                t.cell(fa, ours[2], error=binomial_error(fa, count, 0.005)),
            ])  # fmt: skip
    head = ["delta", "method", "acc", "late", "FA"]
    return f"### Plant mismatch, printed/open, {count} + {count} fault-free episodes\n\n{markdown(head, rows)}\n"


def simultaneous(t: Comparisons, found: Found, count: int) -> str:
    """One or two faults at once."""
    t.of("simultaneous")
    rows = []
    for method, reference in REFERENCE["dual"].items():
        piece = found[f"dual-{method}"]
        errors = [math.sqrt(2) * piece["acc_error"], 3 * piece["acc_error"], binomial_error(0.09, count),
                  binomial_error(0.0, count, 0.005)]  # fmt: skip
        rows.append([method, *(
            f"- / {o:.3f}" if math.isnan(r) else t.cell(r, o, error=e)
            for r, o, e in zip(reference, piece["values"], errors, strict=True)
        )])  # fmt: skip
    head = ["method", "acc", "post", "final", "FA"]
    return f"### Simultaneous faults, printed/open, {count} episodes, nine labels\n\n{markdown(head, rows)}\n"


def surfaces(t: Comparisons, found: Found) -> str:
    """Hard-over and floating surfaces."""
    t.of("single surfaces")
    rows = []
    for variant, phi in REFERENCE["hard_over"].items():
        over, floating = found[f"over-{variant}"], "-"
        if variant in REFERENCE["float"]:
            late = found[f"float-{variant}"]["late"]
            errors = [math.sqrt(2 / len(v)) * float(np.std(v)) for v in late]
            floating = t.cells(REFERENCE["float"][variant], [float(np.mean(v)) for v in late], 2, errors)
        rows.append([variant, ", ".join(f"{r:g} / {o:.1f}" for r, o in zip(phi, over["phi"], strict=True)),
                     ", ".join(f"{np.mean(v):.3f}" if v else "ended" for v in over["late"]), floating])  # fmt: skip
    head = ["variant", "hard-over: largest abs(phi), deg", "hard-over: late labels right", "float: late accuracy"]
    return f"### Hard-over and float (aileron, rudder), exponential 0.99\n\n{markdown(head, rows)}\n"


def intermittent(t: Comparisons, found: Found, variant: str, episodes: int) -> str:
    """Faults that come and go, with mismatch."""
    t.of(f"intermittent, {variant}")
    rows = []
    for method, reference in REFERENCE["hard"][variant].items():
        piece = found[f"hard-{variant}-{method}"]
        errors = np.array(piece["groups"]).std(axis=1, ddof=1) * math.sqrt(2 / (episodes / 10))
        rows.append([method, *(t.cell(*pair, error=float(e)) for *pair, e in
                               zip(reference, piece["values"], errors, strict=True))])  # fmt: skip
    head = ["method", "all", "inside", "outside"]
    return f"### Intermittent faults with mismatch, {variant}, {episodes} episodes\n\n{markdown(head, rows)}\n"


def picture(path: Path) -> None:
    """The paper's scenario as two two-stage filters see it."""
    plant = load_plant(b747.ID)
    record = fly(plant, [b747.paper().replace(noise_seed=PAPER_SEED)])
    names = {"exponential forgetting": "two_stage_kf_exponential", "no forgetting": "two_stage_kf"}
    said = {label: run(make_diagnoser(name, plant), record.obs) for label, name in names.items()}
    flight(plant, record, said, entries=(1, 3)).savefig(path)
