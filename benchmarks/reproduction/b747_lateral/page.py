"""The Boeing 747's page, from its pieces."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reproduction.b747_lateral.measure import DETECTORS, GROUPS, PAPER_SEED, REFERENCE, Sizes, sizes
from benchmarks.reproduction.comparison import Comparisons, binomial_error, shown
from benchmarks.reproduction.numbered import fly
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.plants import b747_lateral as b747
from fdi_gym.plots import flight
from fdi_gym.tables import markdown

INTRODUCTION = """# Boeing 747: the reference figures, measured again

Written by `python -m benchmarks.reproduction.b747_lateral`. Every cell reads "reference / measured here"; the reference
is an independent implementation with other random streams. A star marks a difference of more than three standard errors
of the difference (from the spreads of both, or the binomial ones). Of some hundred comparisons a few are expected to be
starred by chance, and comparisons in one block share their episodes: they fail together.

How to read the stars that are there: before a fault, the restart filter and the structured estimates are zero unless a
flight raised an early alarm, which happens in none to two flights of 400. Those entries compare a handful of rare events,
not accuracies. The delays of the known-onset reference were read at every tenth sample, here at every one.

What the paper claims: the rudder's stuck fault is detected and isolated, and the estimates converge to (-1, 2). That
holds with a random-walk bias or forgetting only; the plain constant-bias filter is right about neither after 400 s,
when the fault begins after 200 s of healthy flight.

![The paper's scenario](rudder.png)
"""

Found = dict[str, Any]


def write(found: Found, quick: bool, path: Path) -> None:
    """The page and its picture."""
    picture(path.with_name("rudder.png"))
    path.write_text(page(found, sizes(quick)), encoding="utf-8")


def page(found: Found, n: Sizes) -> str:
    """The whole page."""
    t = Comparisons()
    parts = [
        paper_estimates(t, found, n.seeds), paper_logic(t, found, n.seeds), excitation(t, found, n.seeds),
        *(part for variant in REFERENCE["random"] for part in randomised(t, found, variant, n.per_group)),
        mismatch(t, found, n.count), simultaneous(t, found, n.count), surfaces(t, found),
        *(intermittent(t, found, variant, n.hard) for variant in REFERENCE["hard"]),
    ]  # fmt: skip
    summary = f"**{t.agree} of {t.total} compared figures agree within three standard errors.**\n"
    return "\n".join([INTRODUCTION, summary, *parts])


def paper_estimates(t: Comparisons, found: Found, seeds: int) -> str:
    """RMSE over the paper's scenario."""
    rows = []
    for method, reference in REFERENCE["scenario"]["rmse"].items():
        rmse = np.array(found[f"paper-{method}"]["rmse"])
        rows.append([method, *(
            t.cell(mean, values.mean(), error=math.hypot(spread, values.std(ddof=1)) / math.sqrt(seeds))
            for (mean, spread), values in zip(reference, rmse, strict=True)
        )])  # fmt: skip
    head = ["filter", "gamma_r pre", "b_r pre", "gamma_r faulty", "b_r faulty", "gamma_r post", "b_r post",
            "gamma_a faulty", "b_a faulty"]  # fmt: skip
    return f"## The paper's scenario, {seeds} noise seeds\n\nRMSE, mean over seeds.\n\n{markdown(head, rows)}\n"


def median_longest(delays: list[float | None]) -> tuple[float, float]:
    """Median, NaN where it never happens in half of the cases, and the longest."""
    values = np.array(delays, float)
    middle = float(np.median(np.where(np.isnan(values), math.inf, values)))
    return middle if math.isfinite(middle) else math.nan, float(np.fmax.reduce(values))


def paper_logic(t: Comparisons, found: Found, seeds: int) -> str:
    """What the distance logic makes of it, and when."""
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
    rows = []
    for command, (*reference, delay) in REFERENCE["excitation"].items():
        piece = found[f"command-{command}"]
        rmse = np.array(piece["rmse"])[[2, 3, 6, 7]]
        rows.append([command, *(
            "-" if math.isnan(r) else t.cell(r, v.mean(), error=v.std(ddof=1) * math.sqrt(2 / seeds))
            for r, v in zip(reference, rmse, strict=True)
        ), f"{delay:g} / {shown(median_longest(piece['detection'])[0], 2)}"])  # fmt: skip
    head = ["command", "gamma_r", "b_r", "gamma_a", "b_a", "detection s"]
    return f"### Excitation, exponential 0.99, faulty window\n\n{markdown(head, rows)}\n"


def randomised(t: Comparisons, found: Found, variant: str, per_group: int) -> list[str]:
    """The randomised process: accuracy and alarms, the windowed NIS, estimates."""
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
    title = f"## Randomised process, {variant}\n\n{GROUPS} x {per_group} episodes."
    return [f"{title}\n\n{markdown(head, rows)}\n", nis(t, found, variant, flights), estimates(t, found, variant)]


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
    return f"## Plant mismatch, printed/open, {count} + {count} fault-free episodes\n\n{markdown(head, rows)}\n"


def simultaneous(t: Comparisons, found: Found, count: int) -> str:
    """One or two faults at once."""
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
    return f"## Simultaneous faults, printed/open, {count} episodes, nine labels\n\n{markdown(head, rows)}\n"


def surfaces(t: Comparisons, found: Found) -> str:
    """Hard-over and floating surfaces."""
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
    return f"## Hard-over and float (aileron, rudder), exponential 0.99\n\n{markdown(head, rows)}\n"


def intermittent(t: Comparisons, found: Found, variant: str, episodes: int) -> str:
    """Faults that come and go, with mismatch."""
    rows = []
    for method, reference in REFERENCE["hard"][variant].items():
        piece = found[f"hard-{variant}-{method}"]
        errors = np.array(piece["groups"]).std(axis=1, ddof=1) * math.sqrt(2 / (episodes / 10))
        rows.append([method, *(t.cell(*pair, error=float(e)) for *pair, e in
                               zip(reference, piece["values"], errors, strict=True))])  # fmt: skip
    head = ["method", "all", "inside", "outside"]
    return f"## Intermittent faults with mismatch, {variant}, {episodes} episodes\n\n{markdown(head, rows)}\n"


def picture(path: Path) -> None:
    """The paper's scenario as two two-stage filters see it."""
    plant = load_plant(b747.ID)
    record = fly(plant, [b747.paper().replace(noise_seed=PAPER_SEED)])
    names = {"exponential forgetting": "two_stage_kf_exponential", "no forgetting": "two_stage_kf"}
    said = {label: run(make_diagnoser(name, plant), record.obs) for label, name in names.items()}
    flight(plant, record, said, entries=(1, 3)).savefig(path)
