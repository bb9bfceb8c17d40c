"""The source's Figure 3 with zooms at the changes, and accuracy against severity."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reproduction.claims import Missing, share
from benchmarks.reproduction.cmg_satellite.paper import CHANGES, EVERY, FINE, GRIDS, ZOOM
from benchmarks.reproduction.cmg_satellite.plan import SEVERITIES, SEVERITY_METHODS
from benchmarks.reproduction.cmg_satellite.results import Results
from benchmarks.reproduction.cmg_satellite.tables import severity_hits
from fdi_gym import palette
from fdi_gym.plants import cmg_satellite as cmg
from fdi_gym.plots.panels import drawn, legend, new_figure, plain, truth

LEAST = 0.05  # what an axis of Figure 3 shows at least


def figure_3(found: dict[str, Any], profile: str, path: Path) -> bool:
    """The whole time line, a row for each unit, and a zoom at each change beside it; False while it is not measured."""
    mine = {m: found.get(f"tracking-{profile}-{m}") for m in GRIDS}
    if any(v is None for v in mine.values()):
        return False
    piece = {m: v["said"] for m, v in mine.items() if v} | {"truth": next(v["truth"] for v in mine.values() if v)}
    figure = new_figure(13.5, 7.2)
    grid = figure.add_gridspec(4, 1 + len(CHANGES), width_ratios=[3.2, *[1] * len(CHANGES)])
    handles: list[Any] = []
    for unit in range(4):
        for place in range(1 + len(CHANGES)):
            axis = figure.add_subplot(grid[unit, place])
            if place:
                change = CHANGES[place - 1]
                t = (np.arange(change + ZOOM[0], change + ZOOM[1], FINE)) * cmg.DT
                lines = {name: np.array(piece[name]["zooms"][place - 1], float)[:, unit] for name in ("truth", *GRIDS)}
                plain(axis, f"{change * cmg.DT:g} s" if unit == 0 else "")
            else:
                lines = {name: np.array(piece[name]["whole"], float)[:, unit] for name in ("truth", *GRIDS)}
                t = np.arange(len(lines["truth"])) * EVERY * cmg.DT
                plain(axis, f"effectiveness f_{unit + 1} [-]")
            drawn_lines = [drawn(axis, t, lines[m], i, lw=1.0 if place else 0.8, label=m) for i, m in enumerate(GRIDS)]
            ink = truth(axis, t, lines["truth"], label="true", lw=0.9)
            axis.set_xlim(t[0], t[-1])
            low, high = axis.get_ylim()
            if high - low < LEAST:  # nothing happens there: a zoom would show the digits that are kept
                axis.set_ylim((low + high - LEAST) / 2, (low + high + LEAST) / 2)
            handles = [ink, *drawn_lines]
            if unit == 3:
                axis.set_xlabel("time [s]", fontsize=8)
    legend(figure, handles)
    figure.suptitle(f"Figure 3: {profile}, 45 dB, one flight", fontsize=9, x=0.99, ha="right")
    figure.savefig(path)
    return True


def severity(r: Results, path: Path) -> bool:
    """Accuracy against severity with intervals, filters beside the clairvoyant bound; False while it is not measured."""
    names = {"oracle": "oracle (changes and severity known)", "CLAIR": "CLAIR (changes known)"}
    try:
        hits = {m: [severity_hits(r, "slew", m, a) for a in SEVERITIES] for m in SEVERITY_METHODS}
    except Missing:
        return False
    figure = new_figure(7.6, 4.2)
    axis = figure.subplots()
    handles = []
    for i, (m, cells) in enumerate(hits.items()):
        shares = np.array([share(sum(h), len(h))[:3] for h in cells]) * 100
        x = np.array(SEVERITIES) * (1 + 0.02 * (i - 1.5))
        handles.append(drawn(axis, x, shares[:, 0], i, marker="o", ms=3, label=names.get(m, m)))
        axis.vlines(x, shares[:, 1], shares[:, 2], color=palette.line(i)[0], lw=0.8)
    axis.axvline(0.05, color=palette.LINES[6], lw=0.8, ls=":")
    axis.annotate(
        "label threshold", (0.05, 0.6), xycoords=("data", "axes fraction"), fontsize=7, rotation=90, va="center", ha="right"
    )
    axis.set(xscale="log", ylim=(-2, 103))
    axis.set_xlabel("loss of effectiveness [-]", fontsize=8)
    plain(
        axis, f"right labels [%], slew, 45 dB, windows of 30 s, n = {len(hits['oracle'][0])} flights a point, 95 % intervals"
    )
    legend(figure, handles, ncol=2)
    figure.savefig(path)
    return True
