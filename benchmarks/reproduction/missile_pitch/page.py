"""The missile's page and figures, from its pieces."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.reproduction.missile_pitch.claims import Claims, beside
from benchmarks.reproduction.missile_pitch.episodes import randomised, variants
from benchmarks.reproduction.missile_pitch.measure import DT, REFERENCE, STEPS, sizes
from fdi_gym.plants import missile_pitch as missile
from fdi_gym.tables import markdown

INTRODUCTION = """# Pitch-axis missile: the reference figures, measured again

Written by `python -m benchmarks.reproduction.missile_pitch`. Reference: the data sheet's own implementation. The numbered
episodes (seeds 10000 and 20000 onward) use its generator and order of draws, so they are the same flights.
"""

Found = dict[str, Any]


def write(found: Found, quick: bool, path: Path) -> None:
    """The page and its figures."""
    path.write_text(page(found, quick), encoding="utf-8")
    for name, file, label in (("study", "missile_pitch.png", 1), ("mirror", "missile_pitch_mirror.png", 2)):
        draw(path.with_name(file), found["study"]["figure"][name], found["study"][name], label)


def page(found: Found, quick: bool) -> str:
    """The whole page."""
    n, claims = sizes(quick), Claims()
    sections = [
        study(found["study"], claims), robustness(found, claims), rates(found, claims),
        randomised(found, claims, n.numbered, not quick), fault_free(found["fault-free"], claims),
        variants(found, claims, n.variant, not quick), hard(found, claims, n.groups),
    ]  # fmt: skip
    warning = ["**Quick run: a tenth of the episodes.**\n"] if quick else []
    return "\n".join([INTRODUCTION, *warning, claims.table(), *sections])


def study(found: Found, claims: Claims) -> str:
    """The study's scenario."""
    s, m = found["study"], found["mirror"]
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
        "## The study's scenario\n\nNoise-free, rho = 0. The two times are the calibration of the data sheet (fault "
        "scale and command amplitude were chosen so that they come out), so they check the implementation, not the "
        "study. The approximator's error has a floor: it learns only outside its dead zone, which is as wide as the "
        "bound on the model error, up to 1 rad/s^2.\n\n"
        + markdown(["quantity", "study", "reference", "here"], rows)
        + "\n\n![The study's Figure 2](missile_pitch.png)\n\n![The mirror scenario](missile_pitch_mirror.png)\n"
    )


def robustness(found: Found, claims: Claims) -> str:
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
        "## Robustness of that scenario\n\nEach cell reads reference / here; times in s as minimum, median, maximum. "
        "The random errors are other draws than the reference's. The noisy ratio is that of the q channel.\n\n"
        f"{markdown(head, rows)}\n"
    )


def rates(found: Found, claims: Claims) -> str:
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


def fault_free(f: Found, claims: Claims) -> str:
    """Fault-free flights."""
    claims.add("fault-free flights: no alarm of detector or EKF bank", "0, 0 of 200",
               f"{f['detector']}, {f['bank']} of {f['runs']}", f["detector"] == f["bank"] == 0)  # fmt: skip
    claims.add("without the noise margin every noisy flight alarms", "200/200", f"{f['bare']}/{f['runs']}",
               f["bare"] == f["runs"])  # fmt: skip
    reference = REFERENCE["fault_free"]
    return (
        f"## Fault-free flights, {f['runs']} episodes\n\nDetector {f['detector']} alarms (largest residual-to-threshold "
        f"ratio {reference['ratio']:g} / {f['ratio']:.3f}), EKF bank {f['bank']} "
        f"(largest likelihood ratio {reference['likelihood_ratio']:g} / {f['llr']:.1f}), detector "
        f"without the noise margin {f['bare']}. Other seeds than the reference's.\n"
    )


def hard(found: Found, claims: Claims, groups: int) -> str:
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
        f"## Process hard, {groups} groups of 60 episodes\n\n"
        "Share of right labels (reference, one group / here, mean and standard deviation of the groups); "
        f"{faulty:.1f} % of the scored samples are faulty (reference 32.8 %).\n\n"
        f"{markdown(['method', 'all', 'inside windows', 'outside'], rows)}\n\n"
        f"The detector, whose 5 % bound is violated here, alarmed before the first window in {early:.0f} % of the "
        f"episodes (reference {100 * REFERENCE['hard_early_alarm']:.0f} %). The un-latched bank's tuning was chosen on the "
        "reference's own episodes.\n"
    )


def draw(path: Path, figure: dict[str, Any], times: dict[str, float], label: int) -> None:
    """The study's Figure 2 in four panels: fault function, detection residual, both isolation residuals."""
    t = np.arange(STEPS + 1) * DT
    fig = Figure((11, 7), layout="constrained")
    axes = fig.subplots(2, 2, sharex=True)
    panels = [("fault function and its approximation", figure["truth"], figure["fhat"], "fault", "approximation"),
              ("detection", np.abs(figure["eps"]), figure["threshold"], "|residual|", "threshold")]  # fmt: skip
    residual, threshold, running = np.abs(figure["residual"]), np.array(figure["lambda"]), t >= times["T_d"] - 1e-9
    panels += [(f"isolation estimator {c + 1} ({missile.MODES[c]})", np.where(running, residual[:, c], np.nan),
                np.where(running, threshold[:, c], np.nan), "|residual|", "adaptive threshold") for c in (0, 1)]  # fmt: skip
    for ax, (title, solid, dashed, first_name, second_name) in zip(axes.flat, panels, strict=True):
        ax.plot(t, solid, color="#1f4e79", lw=1.3, label=first_name)
        ax.plot(t, dashed, color="#c0504d", lw=1.3, ls="--", label=second_name)
        ax.axvline(10.0, color="0.7", lw=0.8)
        for name, text in (("T_d", "detected"), ("T_s", "isolated")):
            ax.axvline(times[name], color="0.3", lw=0.8, ls=":")
            ax.annotate(f"{text} {times[name]:.2f} s", (times[name], 1), xycoords=("data", "axes fraction"), rotation=90,
                        va="top", ha="right", fontsize=7, color="0.3")  # fmt: skip
        ax.set_title(title, fontsize=10)
        ax.set_ylabel("rad/s$^2$" if ax is axes.flat[0] else "rad/s")
        ax.legend(fontsize=8, loc="upper left")
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    fig.suptitle(f"{missile.MODES[label - 1]}, theta 0.75, gamma 0.2, onset 10 s (pitch channel)", fontsize=11)
    fig.savefig(path, dpi=110)
