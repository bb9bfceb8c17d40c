"""The paper's Figures 1 to 3: true faults, the robust filters' estimates, gusts, and where the actuators stand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reproduction.huav_hover.measure import SETS
from benchmarks.reproduction.huav_hover.paper import ROBUST
from fdi_gym import palette
from fdi_gym.plants.huav_hover import DT, paper
from fdi_gym.plots.panels import drawn, legend, new_figure, plain, shade_handle, truth

NAMES = dict(zip(ROBUST, ("RThSCDKF", "RThSEKF"), strict=True))
TITLES = {1: "bias estimation", 2: "floating and stuck fault", 3: "simultaneous faults"}


def write(piece: dict[str, Any], number: int, path: Path) -> None:
    """One figure: a column for each filter, a row for each channel; below, gusts and positions."""
    t = np.arange(len(piece["true"])) * DT
    true, gust = np.array(piece["true"], float), np.array(piece["gust"], float)
    command, position = np.array(piece["command"], float), np.array(piece["position"], float)
    figure = new_figure(9.6, 9.4)
    grid = figure.add_gridspec(7, 2, height_ratios=[1.35] * 3 + [1.0] * 4)
    handles, axes = {}, []
    for row, channel in enumerate(SETS[3]):
        pair: list[Any] = []
        for column, name in enumerate(ROBUST):
            axis = figure.add_subplot(grid[row, column], sharey=pair[0] if pair else None)
            raw, smooth = (np.array(piece[name][key], float)[:, row] for key in ("b", "s"))
            shade(axis, number, channel)
            handles["raw"] = axis.plot(t, raw, color=palette.LINES[5], lw=0.5, zorder=1)[0]
            handles["smooth"] = drawn(axis, t, smooth, 1, lw=1.3)
            handles["true"] = truth(axis, t, true[:, row])
            plain(axis, f"b_{channel} [mrad], {NAMES[name]}")
            pair.append(axis)
        axes += pair
    for column, name in enumerate(("u_g", "v_g")):
        axis = figure.add_subplot(grid[3, column])
        truth(axis, t, gust[:, column])
        plain(axis, f"gust {name} [m/s]")
        axes.append(axis)
    for row, channel in enumerate(SETS[3]):
        axis = figure.add_subplot(grid[4 + row, :])
        shade(axis, number, channel)
        handles["command"] = drawn(axis, t, command[:, row], 0, lw=0.9)
        truth(axis, t, position[:, row], lw=0.7)
        plain(axis, f"{channel}: commanded and true position about trim [mrad]")
        axes.append(axis)
    for axis in axes:
        axis.set_xlim(0, 20)
    axes[-1].set_xlabel("time [s]", fontsize=8)
    words = {"true": "true", "raw": "estimate", "smooth": "estimate, smoothed", "command": "command"}
    for key, text in words.items():
        handles[key].set_label(text)
    legend(figure, [*(handles[key] for key in words), shade_handle("this channel is faulty")])
    figure.suptitle(f"Figure {number}: {TITLES[number]}, kappa = 0, one flight", fontsize=9, x=0.99, ha="right")
    figure.savefig(path)


def shade(axis: Any, number: int, channel: str) -> None:
    """Where this channel is faulty."""
    for fault in paper(number).faults:
        if fault.mode == channel:
            axis.axvspan(fault.onset * DT, (fault.end or 1000) * DT, color=palette.SHADE, lw=0, zorder=0)
