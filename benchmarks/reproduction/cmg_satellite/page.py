"""The satellite's page and figures, from its pieces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.reproduction.cmg_satellite.campaign import campaign
from benchmarks.reproduction.cmg_satellite.plan import SEVERITIES, SEVERITY_METHODS, TRACKED, blocks, is_campaign
from benchmarks.reproduction.cmg_satellite.results import Results
from benchmarks.reproduction.cmg_satellite.source import claims
from benchmarks.reproduction.cmg_satellite.source import tables as source_tables
from benchmarks.reproduction.cmg_satellite.tables import severity_hits, tables

INTRODUCTION = """# Satellite with four CMGs: reference figures, measured again

Written by `python -m benchmarks.reproduction.cmg_satellite`. Cells read "reference / measured here"; a star marks a
difference of more than three standard errors. References are the source's printed values where the heading says
*source*, else those of an independent implementation of the same data sheet (one run, or the number of episodes given
there; its random streams are not ours, so only distributions can agree). RMSE are of the effectiveness f, before,
during and after the fault. CLAIR is the MEKF told when f changes; the oracle draws from the Cramer-Rao bound and
knows the range of the severities.
"""
TRACKING = """## Tracking

Table 4's time line. While regulating SGAUKF and MEKF see no fault; both lie at 1.

![fault tracking](cmg_tracking.png)"""


def write(found: dict[str, Any], quick: bool, path: Path) -> None:
    """The page and its figures."""
    r = Results({b: found[b.name()] for b in blocks(quick)})
    tracking_figure({g: found[f"tracking-{g}"] for g in ("slew", "regulate")}, path.with_name("cmg_tracking.png"))
    severity_figure(r, path.with_name("cmg_severity.png"))
    path.write_text(page(r, found), encoding="utf-8")


def page(r: Results, found: dict[str, Any]) -> str:
    """The whole page."""
    parts = [claims(r), TRACKING, campaign(r), source_tables(r), tables(r, found)]
    grids, whole = (sum(v["seconds"] for b, v in r.blocks.items() if keep(b)) / 60 for keep in (is_campaign, lambda _: True))
    summary = (
        f"{r.t.agree} of {r.t.total} compared figures agree within three standard errors. The methods took {whole:.0f} "
        f"core-minutes, {grids:.0f} of them the three filters of the source in the campaign; batches on a shared machine."
    )
    return "\n\n".join([f"{INTRODUCTION}\n{summary}", *parts]) + "\n"


def tracking_figure(tracks: dict[str, dict[str, Any]], path: Path) -> None:
    """Estimates over the source's time line."""
    figure = Figure((11, 8), layout="constrained")
    axes = figure.subplots(4, 2, sharex=True, sharey=True)
    for column, (profile, found) in enumerate(tracks.items()):
        t = np.linspace(0, 200, len(found["truth"]))
        for i in range(4):
            ax = axes[i, column]
            ax.plot(t, np.array(found["truth"])[:, i], "k", lw=2.5, alpha=0.35, label="truth")
            for method in TRACKED:
                ax.plot(t, np.array(found[method])[:, i], lw=0.9, label=method)
            ax.set_ylabel(f"$f_{i + 1}$")
            ax.set_ylim(-0.3, 1.5)
        axes[0, column].set_title(f"{profile}, 45 dB")
        axes[3, column].set_xlabel("t [s]")
    axes[0, 0].legend(loc="lower right", fontsize=8)
    figure.savefig(path, dpi=110)


def severity_figure(r: Results, path: Path) -> None:
    """Accuracy against severity, filters beside the clairvoyant bound."""
    styles = {"oracle": "k--", "CLAIR": "C3-.", "SGAUKF": "C0-", "MEKF": "C1:"}
    names = {"oracle": "oracle (changes and severity known)", "CLAIR": "CLAIR (changes known)"}
    figure = Figure((7.5, 4.5), layout="constrained")
    ax = figure.subplots()
    for m in SEVERITY_METHODS:
        share = [100 * float(np.mean(severity_hits(r, "slew", m, a))) for a in SEVERITIES]
        ax.plot(SEVERITIES, share, styles[m], marker="o", ms=4, label=names.get(m, m))
    ax.axvline(0.05, color="0.7", lw=1)
    ax.text(0.053, 4, "label threshold", fontsize=8, color="0.4")
    ax.set(xscale="log", xlabel="loss of effectiveness", ylabel="accuracy [%]", ylim=(-2, 103),
           title="Slew, 45 dB, windows of 30 s")  # fmt: skip
    ax.legend()
    figure.savefig(path, dpi=110)
