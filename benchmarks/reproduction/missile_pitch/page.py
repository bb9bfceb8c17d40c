"""The missile's page and figures, from its pieces."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.reproduction.claims import Found, claims_table, judge, mean, section
from benchmarks.reproduction.missile_pitch import figures
from benchmarks.reproduction.missile_pitch.agreement import Statements, beside
from benchmarks.reproduction.missile_pitch.claims import CLAIMS
from benchmarks.reproduction.missile_pitch.episodes import randomised, variants
from benchmarks.reproduction.missile_pitch.measure import REFERENCE, sizes
from benchmarks.reproduction.missile_pitch.paper import ESTIMATORS
from fdi_gym.tables import markdown

INTRODUCTION = """# Pitch-axis missile: the study's claims and figures, measured again

A journal article on adaptive fault detection and isolation for an aerocraft's nonlinear uncertain closed-loop system. The
text at hand has lost its title page, its equations, Table 1 and the figures, so no link to it can be given; the scheme is
that of X. Zhang, M. M. Polycarpou, T. Parisini, IEEE TAC 47(4), 576-593, 2002. What was lost was taken from the
literature that the study builds on or chosen: [differences](differences.md). So what is judged here is the scheme, not the
study's figures.
"""
AGREEMENT = """## Agreement with a second implementation

This says nothing of the study: the reference is the data sheet's own implementation. The numbered episodes (seeds 10000 and
20000 onward) use its generator and order of draws, so they are the same flights.
"""
COMMAND = "python -m benchmarks.reproduction.missile_pitch"


def write(found: Found, quick: bool, path: Path) -> None:
    """The page and its figures."""
    path.write_text(page(found, quick), encoding="utf-8")
    if "study" in found and "detectability" in found:
        figures.write(found, path.parent)


def page(found: Found, quick: bool) -> str:
    """The whole page."""
    judged = [judge(claim, found) for claim in CLAIMS]
    own = [section(part, found) for part in (study_figures, state_table)]
    return "\n".join([INTRODUCTION, f"## Claims\n\n{claims_table(judged, COMMAND)}", *own, GENERAL, AGREEMENT,
                      *agreement(found, quick)])  # fmt: skip


def agreement(found: Found, quick: bool) -> list[str]:
    """The figures beside the reference's."""
    n, statements = sizes(quick), Statements()
    parts: list[Callable[[Found], str]] = [
        lambda f: study(f, statements), lambda f: robustness(f, statements), lambda f: rates(f, statements),
        lambda f: randomised(f, statements, n.numbered, not quick), lambda f: fault_free(f["fault-free"], statements),
        lambda f: variants(f, statements, n.variant, not quick), lambda f: hard(f, statements, n.groups),
    ]  # fmt: skip
    texts = [section(part, found) for part in parts]
    return [statements.table(), *texts]


# -- the study's own


def study_figures(found: Found) -> str:
    """Figure 2"""
    for piece in ("study", "detectability"):
        _ = found[piece]  # what the pictures are made of
    return (
        "## The study's figures\n\nFigure 1 is a diagram of the scheme. Figure 2: a the fault function and its "
        "approximation, b the "
        "detection residual and its threshold, c and d the residuals of both isolation estimators and their adaptive "
        "thresholds. "
        "Beside them the two sides of equation 11. Noise-free, coefficients as the estimators have them.\n\n"
        "![Figure 2: type 1](missile_pitch.png)\n\n![The same for a fault of type 2](missile_pitch_mirror.png)\n\n"
        "![Equation 11: when a fault is detectable](missile_pitch_detectability.png)\n"
    )


def state_table(found: Found) -> str:
    """State estimates"""
    rows = []
    for name in ESTIMATORS:
        piece = found[f"states {name}"]
        values = np.array(piece["states"])
        rows.append([name, *(mean(values[:, i].tolist()).text(4) for i in range(2))])
    sensors = np.array(found[f"states {ESTIMATORS[0]}"]["sensors"])
    rows.append(["the sensors", *(mean(sensors[:, i].tolist()).text(4) for i in range(2))])
    return (
        "## State estimates\n\nRMSE from 1 s on, mean over numbered episodes with faults and noise. The estimators of the "
        "scheme are "
        "observers with a fixed gain: their residual is what the fault leaves, so their pitch rate is no better than the "
        "sensor.\n\n"
        + markdown(["method", "incidence [deg]", "pitch rate [deg/s]"], rows) + "\n"
    )  # fmt: skip


GENERAL = """## The scheme on other plants

The scheme is stated for any xdot = phi(x, u) + eta + B f with a known bound on eta. Here it needs three things of a plant:
that bound as a function of what is measured, a fault function for each class that is linear in one parameter, and all
states in motion measured. The missile has them (`baselines/filters/missile_model.py`); no other plant of the benchmark
declares a bound on its model error, and a bound that is fitted to flights would void Theorem 1. So `approximation_detector`
and `gos` are the missile's: what is missing is an
entry for eta in `Plant`.
"""


# -- beside the reference


def study(found: Found, claims: Statements) -> str:
    """The study's scenario."""
    s, m = (found["study"][name] for name in ("study", "mirror"))
    values = [s["T_d"], s["T_s"], s["matched"], s["matched_at_alarm"], s["rms_error"], s["rms"], *s["theta"],
              s["wrong_theta"], s["theorem"], m["T_d"], m["T_s"], m["rms_error"], m["rms"], m["theorem"]]  # fmt: skip
    rows = [[r["quantity"], f"about {r['study']:g}" if "study" in r else "not stated", f"{r['reference']:g}", f"{value:.3f}"]
            for r, value in zip(REFERENCE["study"], values, strict=True)]  # fmt: skip
    claims.add("type 1 is detected at about 11.2 s", "11.21 s", f"{s['T_d']:.2f} s", s["T_d"] == 11.21)
    claims.add("type 2 is excluded at about 15.5 s", "15.49 s", f"{s['T_s']:.2f} s", s["T_s"] == 15.49)
    claims.add("residual 1 stays below its threshold", "ratio 0.101 at most", f"{s['matched']:.3f}",
               not s["true_excluded"] and s["matched"] < 1)  # fmt: skip
    claims.add("mirror scenario: detected, type 1 excluded", "12.46 s, 13.21 s", f"{m['T_d']:.2f} s, {m['T_s']:.2f} s",
               (m["T_d"], m["T_s"]) == (12.46, 13.21) and not m["true_excluded"])  # fmt: skip
    claims.add("the approximator follows the fault function", "error 23 % of its rms",
               f"{100 * s['rms_error'] / s['rms']:.0f} %", s["rms_error"] < 0.3 * s["rms"])  # fmt: skip
    return (
        "### The study's scenario\n\nNoise-free, rho = 0. The two times are the calibration of the data sheet (fault "
        "scale and command amplitude were chosen so that they come out), so they check the implementation, not the "
        "study. The approximator's error has a floor: it learns only outside its dead zone, which is as wide as the "
        "bound on the model error, up to 1 rad/s^2.\n\n" + markdown(["quantity", "study", "reference", "here"], rows) + "\n"
    )


def robustness(found: Found, claims: Statements) -> str:
    """Random and extreme coefficient errors."""
    rows, clean = [], True
    for case, wanted in REFERENCE["robustness"].items():
        piece = found[f"robustness {case}"]
        row = [case, f"{piece['early']}/{piece['runs']}"]
        row.append(f"{wanted['ratio']:g} / {piece['ratio']:.4f}" if "ratio" in wanted else "-")
        row += [", ".join(beside(wanted[name], piece[name])) if name in wanted else "-" for name in ("T_d", "T_s")]
        rows.append([*row, str(piece.get("true_excluded", "-"))])
        clean &= piece["early"] == 0 and not piece.get("true_excluded")
    corner = found["robustness no fault, 64 corners"]
    claims.add("no alarm at the 64 corners of the uncertainty box", "0/64, ratio 0.9905",
               f"{corner['early']}/64, ratio {corner['ratio']:.4f}", corner["early"] == 0)  # fmt: skip
    claims.add("under random errors: no early alarm, true class never excluded", "0", "0" if clean else "some", clean)
    head = ["case", "false or early alarms", "largest ratio", "T_d", "T_s", "true class excluded"]
    return (
        "### Robustness of that scenario\n\nEach cell reads reference / here; times in s as minimum, median, maximum. "
        "The random errors are other draws than the reference's. The noisy ratio is that of the q channel.\n\n"
        f"{markdown(head, rows)}\n"
    )


def rates(found: Found, claims: Statements) -> str:
    """Other sizes and rates."""
    rows, same = [], True
    for r in REFERENCE["rate"]:
        wanted, here = (r["type_1"], r["type_2"]), found[f"rate {r['theta']} {r['gamma']}"]
        same &= np.allclose(here, wanted, atol=1e-9)
        rows.append([f"{r['theta']:g}", f"{r['gamma']:g}", *(f"{a:.2f}, {b:.2f} / {c:.2f}, {d:.2f}"
                     for (a, b), (c, d) in zip(wanted, here, strict=True))])  # fmt: skip
    claims.same("times at other sizes and rates", "10 pairs", bool(same))
    text = "Other sizes and rates, noise-free, 30 s: T_d, T_s.\n\n"
    return text + markdown(["theta", "gamma", "type 1", "type 2"], rows) + "\n"


def fault_free(f: Found, claims: Statements) -> str:
    """Fault-free flights."""
    claims.add("fault-free flights: no alarm of detector or EKF bank", "0, 0 of 200",
               f"{f['detector']}, {f['bank']} of {f['runs']}", f["detector"] == f["bank"] == 0)  # fmt: skip
    claims.add("without the noise margin every noisy flight alarms", "200/200", f"{f['bare']}/{f['runs']}",
               f["bare"] == f["runs"])  # fmt: skip
    reference = REFERENCE["fault_free"]
    return (
        f"### Fault-free flights, {f['runs']} episodes\n\nDetector {f['detector']} alarms (largest residual-to-threshold "
        f"ratio {reference['ratio']:g} / {f['ratio']:.3f}), EKF bank {f['bank']} "
        f"(largest likelihood ratio {reference['likelihood_ratio']:g} / {f['llr']:.1f}), detector "
        f"without the noise margin {f['bare']}. Other seeds than the reference's.\n"
    )


def hard(found: Found, claims: Statements, groups: int) -> str:
    """The process "hard"."""
    parts, rows = [found[f"hard {g}"] for g in range(groups)], []
    for name, wanted in REFERENCE["hard"].items():
        values = np.array([part[name] for part in parts])
        mean, sd = values.mean(axis=0), values.std(axis=0, ddof=1) if groups > 1 else np.full(3, np.nan)
        rows.append([name, *(f"{a:.3f} / {b:.3f} ({s:.3f})" for a, b, s in zip(wanted, mean, sd, strict=True))])
        if groups > 1:
            within = bool(abs(mean[0] - wanted[0]) <= 3 * sd[0] * math.sqrt(1 + 1 / groups))
            claims.add(f"hard: {name}", f"{wanted[0]:.3f}", f"{mean[0]:.3f} (sd of a group {sd[0]:.3f})", within)
    faulty, early = (100 * np.mean([part[key] for part in parts]) for key in ("faulty", "early"))
    return (
        f"### Process hard, {groups} groups of 60 episodes\n\n"
        "Share of right labels (reference, one group / here, mean and standard deviation of the groups); "
        f"{faulty:.1f} % of the scored samples are faulty (reference 32.8 %).\n\n"
        f"{markdown(['method', 'all', 'inside windows', 'outside'], rows)}\n\n"
        f"The detector, whose 5 % bound is violated here, alarmed before the first window in {early:.0f} % of the "
        f"episodes (reference {100 * REFERENCE['hard_early_alarm']:.0f} %). The un-latched bank's tuning was chosen on the "
        "reference's own episodes.\n"
    )
