"""The study's Figure 2 in its four panels, its mirror, and both sides of equation 11."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reproduction.missile_pitch.measure import DT, STEPS
from fdi_gym import palette
from fdi_gym.plants import missile_pitch as missile
from fdi_gym.plots.panels import drawn, legend, new_figure, plain, truth

ONSET = 10.0  # s
NAMES = {"study": ("missile_pitch.png", "type 1 (aero)"), "mirror": ("missile_pitch_mirror.png", "type 2 (leak)")}


def write(found: dict[str, Any], folder: Path) -> None:
    """All pictures."""
    for name, (file, title) in NAMES.items():
        figure_2(found["study"]["figure"][name], found["study"][name], title).savefig(folder / file)
    equation_11(found["detectability"]).savefig(folder / "missile_pitch_detectability.png")


def marked(axis: Any, times: dict[str, float], title: str) -> None:
    """A panel with its title and the times of onset and decisions."""
    for i, (text, at) in enumerate(times.items()):
        axis.axvline(at, color=palette.LINES[6], lw=0.8, ls=":", zorder=1)
        side = "left" if i == len(times) - 1 else "right"  # the last two may be close together
        axis.annotate(text, (at, 1), xycoords=("data", "axes fraction"), rotation=90, va="top", ha=side, fontsize=7)
    plain(axis, title)
    axis.set_xlim(0, 20)


def figure_2(piece: dict[str, Any], said: dict[str, Any], title: str) -> Any:
    """Four panels."""
    t = np.arange(STEPS + 1) * DT
    figure = new_figure(9.6, 6.4)
    axes = figure.subplots(2, 2, sharex=True)
    times = {"onset": ONSET, f"detected {said['T_d']:.2f} s": said["T_d"], f"isolated {said['T_s']:.2f} s": said["T_s"]}
    marked(axes[0, 0], times, "a: fault function [rad/s$^2$]")
    said_line = drawn(axes[0, 0], t, piece["fhat"], 0)
    true = truth(axes[0, 0], t, piece["truth"])
    panels = [(axes[0, 1], "b: detection, pitch rate [rad/s]", np.abs(piece["eps"]), np.array(piece["threshold"]))]
    running = t >= said["T_d"] - 1e-9
    residual, threshold = np.abs(piece["residual"]), np.array(piece["lambda"])
    panels += [(axes[1, c], f"{'cd'[c]}: isolation estimator {c + 1} ({missile.MODES[c]}), pitch rate [rad/s]",
                np.where(running, residual[:, c], np.nan), np.where(running, threshold[:, c], np.nan)) for c in (0,
                1)]  # fmt: skip
    for axis, words, solid, dashed in panels:
        marked(axis, times, words)
        above = drawn(axis, t, dashed, 1)
        below = drawn(axis, t, solid, 2)
        below.set_linestyle("-")
    for axis in axes[1]:
        axis.set_xlabel("time [s]", fontsize=8)
    for handle, text in (
        (true, "fault function"),
        (said_line, "approximation"),
        (below, "|residual|"),
        (above, "threshold"),
    ):
        handle.set_label(text)
    legend(figure, [true, said_line, below, above])
    figure.suptitle(f"{title}, theta 0.75, gamma 0.2, onset 10 s", fontsize=9, x=0.99, ha="right")
    return figure


def equation_11(piece: dict[str, Any]) -> Any:
    """Both sides of the condition for both types."""
    figure = new_figure(9.6, 3.2)
    axes = figure.subplots(1, 2, sharex=True)
    for axis, (name, (_, title)) in zip(axes, NAMES.items(), strict=True):
        found = piece[name]
        t = np.arange(len(found["left"])) * 5 * DT
        marked(axis, {"onset": ONSET, f"alarm {found['T_d']:.2f} s": found["T_d"],
        f"eq. 11 met {found['T_11']:.2f} s": found["T_11"]},
               f"{title}: pitch rate [rad/s]")  # fmt: skip
        right = drawn(axis, t, found["right"], 1)
        left = drawn(axis, t, found["left"], 0)
        axis.set_xlabel("time [s]", fontsize=8)
    left.set_label("|filtered fault function|")
    right.set_label("twice the threshold")
    legend(figure, [left, right])
    return figure
