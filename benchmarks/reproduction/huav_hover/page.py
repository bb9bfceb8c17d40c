"""The helicopter's page and figures, from its pieces."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.reproduction.claims import Found, claims_table, judge, mean, section
from benchmarks.reproduction.comparison import Comparisons
from benchmarks.reproduction.huav_hover import figures
from benchmarks.reproduction.huav_hover.claims import CLAIMS
from benchmarks.reproduction.huav_hover.measure import (
    BOUND_AFTER,
    KAPPAS,
    NOISE_SEEDS,
    REFERENCE,
    SETS,
    scenario_key,
)
from benchmarks.reproduction.huav_hover.paper import NUMBERS, ROBUST, STATISTICAL
from fdi_gym.plants.huav_hover import CHANNELS, STATES
from fdi_gym.tables import markdown

SHORT = {"ascdkf": "ASCDKF", "three_stage_cdkf": "ThSCDKF", "three_stage_ekf": "ThSEKF",
         "robust_three_stage_cdkf": "RThSCDKF", "robust_three_stage_ekf": "RThSEKF",
         "hypothesis_bank": "HypBank"}  # fmt: skip
KIND_NAMES = ("bias", "stuck at", "stuck in place", "square", "drift", "loe")

INTRODUCTION = """# Helicopter UAV in hover: the paper's claims and figures, measured again

Z. Nejati et al., [Robust Three Stage Central Difference Kalman Filter for Helicopter Unmanned Aerial Vehicle Actuators Fault
Estimation](https://doi.org/10.5829/ije.2021.34.05b.23), International Journal of Engineering, Transactions B 34(5), 2021.
The paper prints figures and no numbers of results; parameters, controller, noise, sample time and gusts are this
benchmark's, so what is judged here is what the paper's method does under them. What differs from the paper, and why:
[differences](differences.md).
"""
AGREEMENT = """## Agreement with a second implementation

This says nothing of the paper: an independent implementation of the same data sheet with the same noise streams. Every cell
reads "reference / measured here"; a star marks a difference beyond the rounding of the reference's last digit. Two
accuracies of HypBank (a bank of ordinary Kalman filters, one per label) differ by a few samples in the fourth digit.
"""
COMMAND = "python -m benchmarks.reproduction.huav_hover"


def write(found: Found, quick: bool, path: Path) -> None:
    """The page and its figures."""
    path.write_text(page(found, quick), encoding="utf-8")
    for number in NUMBERS:
        if f"figure-{number}" in found:
            figures.write(found[f"figure-{number}"], number, path.with_name(f"huav_hover_figure_{number}.png"))


def page(found: Found, quick: bool) -> str:
    """The whole page."""
    judged = [judge(claim, found) for claim in CLAIMS]
    own = [section(part, found) for part in (paper_figures, accuracy, state_table, applicability)]
    return "\n".join([INTRODUCTION, f"## Claims\n\n{claims_table(judged, COMMAND)}", *own, AGREEMENT, *agreement(found)])


def agreement(found: Found) -> list[str]:
    """The figures beside those of the second implementation."""
    t = Comparisons()
    parts: list[Callable[[Found], str]] = [
        *(functools.partial(scenarios, t, p=p, kappa=kappa) for p, kappa in ((3, 0.0), (4, 0.0), (4, 1.0))),
        functools.partial(randomised, t), functools.partial(thresholds, t), functools.partial(bounds, t),
        functools.partial(oracle, t), functools.partial(mistuning, t), lost,
    ]  # fmt: skip
    texts = [section(part, found) for part in parts]
    return [t.summary() + "\n", *texts]


# -- the paper's own


def paper_figures(found: Found) -> str:
    """Figures 1 to 3"""
    text = (
        "## The paper's figures\n\nThe paper shows, for each scenario, the true fault and the estimates of RThSCDKF and "
        "RThSEKF. "
        "Below them are the gusts that act and the positions of the actuators, which the paper does not show; one flight "
        f"(noise seed {NOISE_SEEDS[0]}), kappa = 0.\n"
    )
    for number in NUMBERS:
        _ = found[f"figure-{number}"]  # what the picture is made of
        text += f"\n![Figure {number}: {figures.TITLES[number]}](huav_hover_figure_{number}.png)\n"
    return text


def accuracy(found: Found) -> str:
    """Fault estimates of all filters"""
    rows = []
    for number in NUMBERS:
        for name in (*ROBUST, *STATISTICAL):
            piece = found[f"scenario-3-0.0-{number}-{name}"]
            raw = np.array(piece["raw"])
            flagged, of = piece["detected"]
            rows.append([str(number), SHORT[name], *(mean(raw[:, i].tolist()).text(2) for i in range(3)), f"{flagged}/{of}",
                         str(piece["false"])])  # fmt: skip
    head = ["scenario", "filter", *(f"RMSE of b_{c} [mrad]" for c in SETS[3]), "faults flagged", "wrong flags"]
    return (
        "## Fault estimates\n\nRMSE of the raw estimate over 20 s in the paper's setting, mean over flights. Scenario 4 is "
        "scenario 1 with all filters. The filters see the same flights: their figures are "
        f"paired.\n\n{markdown(head, rows)}\n"
    )


def state_table(found: Found) -> str:
    """State estimates"""
    rows = []
    for number in NUMBERS:
        for name in (ROBUST[0], STATISTICAL[1]):
            values = np.array(found[f"states-{number}-{name}"]["states"])
            rows.append([str(number), SHORT[name], *(f"{v:.4f}" for v in values.mean(axis=0))])
        sensors = np.array(found[f"states-{number}-{ROBUST[0]}"]["sensors"])
        rows.append([str(number), "the sensors", *(f"{v:.4f}" for v in sensors.mean(axis=0)), "-", "-"])
    head = ["scenario", "filter", *STATES]
    return (
        "## State estimates\n\nRMSE from 2 s on, mean over "
        f"{len(found[f'states-1-{ROBUST[0]}']['states'])} flights, estimated together with the faults; velocities in m/s, "
        "rates in "
        f"rad/s, angles in rad. The flapping angles are not measured.\n\n{markdown(head, rows)}\n"
    )


def applicability(found: Found) -> str:
    """Other plants"""
    rows = []
    for name in (STATISTICAL[1], ROBUST[0]):
        for plant, said in found[f"elsewhere-{name}"].items():
            rows.append([SHORT[name], plant, mean(said["ratio"]).text(2) if "ratio" in said else said["reason"]])
    head = ["filter", "plant", "error in fault windows / that of estimating nothing; or why it cannot be built"]
    return (
        "## Other plants\n\nAs each plant comes (the helicopter with kappa = 0.3 and all four channels), belief and "
        "thresholds "
        f"fitted to its process.\n\n{markdown(head, rows)}\n\nThe three-stage filters take sensors y = H x. With nonlinear "
        "sensors "
        "each stage would need its own linearisation of the sensors at the state that the other stages correct, and the "
        "decoupling "
        "that makes the three stages equal to the augmented filter holds for one common H only; the paper's plant has "
        "linear sensors, "
        "and no equation of it says which point to take. So they are not offered there: `augmented_cdkf` is the augmented "
        "filter "
        "for such plants.\n"
    )


# -- beside the second implementation


def scenarios(t: Comparisons, found: Found, p: int, kappa: float) -> str:
    """The source's scenarios in one setting."""
    t.of(f"scenarios, {p} channels, kappa {kappa:g}")
    rows = []
    for r in REFERENCE["scenario"]:
        if (r["channels"], r["kappa"]) == (p, kappa):
            piece = found["scenario-{}-{}-{}-{}".format(*scenario_key(r))]
            rows.append([
                str(r["number"]), SHORT[r["filter"]], t.cells(r["rmse"], piece["rmse"], 2),
                t.cells(r["smoothed"], piece["smoothed"], 2), t.counts(r["detected"], piece["detected"]),
                t.cells(r["delay"], piece["delay"], 2), t.cell(r["false"], piece["false"], 0),
                t.cell(r["accuracy"], piece["accuracy"]), t.cells(r["d"], piece["d"], 1),
            ])  # fmt: skip
    head = ["scenario", "filter", f"RMSE b {', '.join(SETS[p])} [mrad]", "smoothed [mrad]", "flagged", "delay [s]",
            "false", "accuracy", "RMSE d [m/s]"]  # fmt: skip
    title = "The paper's setting" if (p, kappa) == (3, 0.0) else "All four channels"
    return f"### {title}, kappa = {kappa:g}\n\n{markdown(head, rows)}\n"


def randomised(t: Comparisons, found: Found) -> str:
    """The randomised process, its wrong flags, and what is detected by kind of fault."""
    t.of("randomised process")
    rows = []
    for r in REFERENCE["random"]:
        piece = found[f"random-{r['kappa']}-{r['filter']}"]
        rows.append([
            f"{r['kappa']:g}", SHORT[r["filter"]], t.cells(r["rmse"], piece["rmse"], 2),
            t.cells(r["d"], piece["d"], 1) if "d" in r else "-", t.cells(r["accuracy"], piece["accuracy"]),
            ", ".join(t.counts(*pair) for pair in zip(r["detected"], piece["detected"], strict=True)),
            t.cells(r["delay"], piece["delay"], 2), t.counts(r["first"], piece["first"]),
            t.cell(r["false_flights"], piece["false_flights"], 2),
        ])  # fmt: skip
    head = ["kappa", "filter", "RMSE b col, lon, lat, ped [mrad]", "RMSE d [m/s]", "accuracy all, faulty, healthy",
            "flagged col, lon, lat, ped", "delay [s]", "first flag right/of/none", "flights with a false flag"]  # fmt: skip
    table = f"### Randomised process, 100 flights, all four channels\n\n{markdown(head, rows)}\n"
    rows = [[SHORT[name], *(t.cell(n, found[f"random-{kappa}-{name}"]["wrong"], 0) for kappa, n in per.items())]
            for name, per in REFERENCE["wrong_flags"].items()]  # fmt: skip
    wrong = "Flags on a healthy channel in the same flights.\n\n" + markdown(["filter", "kappa 0", "0.3", "1"], rows) + "\n"
    rows = []
    for name, kinds in REFERENCE["kinds"].items():
        ours = found[f"random-0.3-{name}"]["kinds"]
        rows.append([SHORT[name], *(t.counts(of, ours.get(kind, [0, 0])) for kind, of in kinds.items())])
    head = ["filter", *next(iter(REFERENCE["kinds"].values()))]
    return "\n".join([table, wrong, f"Detected by kind of fault, kappa = 0.3.\n\n{markdown(head, rows)}\n"])


def thresholds(t: Comparisons, found: Found) -> str:
    """Thresholds of the flag logic."""
    t.of("fault-free flights")
    rows = []
    for r in REFERENCE["threshold"]:
        p, kappa, name = r["channels"], r["kappa"], r["filter"]
        rows.append([", ".join(SETS[p]), f"{kappa:g}", SHORT[name], t.cells(r["J"], found[f"threshold-{p}-{kappa}-{name}"])])
    return f"### Thresholds of the flag logic [mrad]\n\n{markdown(['channels', 'kappa', 'filter', 'J'], rows)}\n"


def bounds(t: Comparisons, found: Found) -> str:
    """Bounds on a bias."""
    t.of("bounds")
    rows = []
    for r in REFERENCE["bound"]:
        ours = found[f"bound-{r['kappa']}"][BOUND_AFTER.index(r["after"])]
        rows.append([f"{r['kappa']:g}", f"{r['after']:g}",
                     *(t.cells(*pair) for pair in zip((r["alone"], r["jointly"]), ours, strict=True))])  # fmt: skip
    head = ["kappa", "s after onset", "alone: col, lon, lat, ped", "with the others unknown"]
    return f"### Bound on a constant bias [mrad], known onset\n\n{markdown(head, rows)}\n"


def oracle(t: Comparisons, found: Found) -> str:
    """What the matched oracle attributes."""
    t.of("oracle")
    rows = []
    for r in REFERENCE["oracle"]:
        told, *shares = zip(r["shares"], found[f"oracle-{r['kappa']}"][r["window"]], strict=True)
        rows.append([f"{r['kappa']:g}", r["window"], t.cell(*told), *(t.cell(*pair, digits=2) for pair in shares)])
    title = "### Matched oracle: single faults detected and attributed within a window"
    return f"{title}\n\n{markdown(['kappa', 'window [s]', 'all', *CHANNELS, *KIND_NAMES], rows)}\n"


def mistuning(t: Comparisons, found: Found) -> str:
    """Other random walks."""
    t.of("scenarios, 3 channels, kappa 0")
    rows = [[f"{1e3 * float(step):g}", t.cells(rmse, found[f"walk-{step}"]["rmse"], 2)]
            for step, rmse in REFERENCE["walk"].items()]  # fmt: skip
    title = "### What mistuning costs: random walk of the fault, ThSEKF, scenario 1"
    return f"{title}\n\n{markdown(['step [mrad]', 'RMSE b lon, lat, ped [mrad]'], rows)}\n"


def lost(found: Found) -> str:
    """Flights lost"""
    lost = ", ".join(f"{found[f'random-{k}-three_stage_cdkf']['terminated']:.2f}" for k in KAPPAS)
    return (f"Flights lost at kappa 0, 0.3, 1: {lost} (reference 0.08, 0.08, 0.14). A constant \"none\" is right for "
            f"{found['random-0.3-three_stage_cdkf']['none']:.3f} of the samples (0.650).\n")  # fmt: skip
