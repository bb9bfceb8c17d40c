"""The paper's Figures 2 to 6, with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.reproduction.b747_lateral.paper import EVERY
from fdi_gym import palette
from fdi_gym.discovery import load_plant
from fdi_gym.plants import b747_lateral as b747
from fdi_gym.plots.panels import drawn, legend, new_figure, plain, shade_handle, titled, truth

WINDOW = (200.0, 600.0)  # s: the rudder is stuck
NAMES = {"beta": 3, "p": 5, "r": 4, "phi": 6}  # figure numbers of the paper


def write(piece: dict[str, Any], folder: Path) -> None:
    """Both pictures."""
    inputs_and_faults(piece).savefig(folder / "b747_lateral_faults.png")
    states(piece).savefig(folder / "b747_lateral_states.png")


def panel(axis: Any, title: str) -> None:
    """An empty panel with the time in which the fault acts."""
    axis.axvspan(*WINDOW, color=palette.SHADE, lw=0, zorder=0)
    axis.set_xlim(0, 800)
    plain(axis, title)


def inputs_and_faults(piece: dict[str, Any]) -> Any:
    """Figure 2: inputs, the four entries of the fault with their estimates, and the errors of the estimates."""
    plant = load_plant(b747.ID)
    inputs, said, true = (np.array(piece[name], float) for name in ("inputs", "entries", "true entries"))
    t = np.arange(len(said)) * EVERY * b747.DT
    figure = new_figure(9.6, 8.2)
    axes = figure.subplots(5, 2, sharex=True)
    for j, signal in enumerate(plant.commands):
        panel(axes[0, j], f"input: {titled(signal)}")
        drawn(axes[0, j], t, inputs[:, j], 6, lw=0.5)
    for j, signal in enumerate(plant.estimated):
        row, place = 1 + 2 * (j // 2), j % 2
        panel(axes[row, place], titled(signal))
        estimate = drawn(axes[row, place], t, said[:, j], 0, lw=0.9)
        ink = truth(axes[row, place], t, true[:, j])
        panel(axes[row + 1, place], f"error of {titled(signal)}")
        error = drawn(axes[row + 1, place], t, said[:, j] - true[:, j], 1, lw=0.7)
        error.set_linestyle("-")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", fontsize=8)
    for handle, words in ((ink, "true"), (estimate, "two-stage, forgetting 0.99"), (error, "estimate - true")):
        handle.set_label(words)
    legend(figure, [ink, estimate, error, shade_handle("the rudder is stuck at 2 deg")])
    return figure


def states(piece: dict[str, Any]) -> Any:
    """Figures 3 to 6: each state, true and estimated, and what the two filters' estimates are off."""
    plant = load_plant(b747.ID)
    true, said, blind = (np.array(piece[name], float) for name in ("true states", "states", "blind"))
    t = np.arange(len(true)) * EVERY * b747.DT
    figure = new_figure(12.0, 8.2)
    axes = figure.subplots(4, 3, sharex="col")
    for row, i in enumerate(sorted(range(4), key=lambda i: NAMES[plant.states[i].name])):
        signal = plant.states[i]
        for place, words in enumerate(
            (f"Figure {NAMES[signal.name]}: {titled(signal)}", "the onset", f"error of {titled(signal)}")
        ):
            panel(axes[row, place], words)
        for axis in axes[row, :2]:
            lost = drawn(axis, t, blind[:, i], 1, lw=0.9)
            with_filter = drawn(axis, t, said[:, i], 0, lw=0.9)
            ink = truth(axis, t, true[:, i], lw=0.6)
        axes[row, 1].set_xlim(180, 280)
        drawn(axes[row, 2], t, blind[:, i] - true[:, i], 1, lw=0.5).set_linestyle("-")
        drawn(axes[row, 2], t, said[:, i] - true[:, i], 0, lw=0.5)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", fontsize=8)
    for handle, words in ((ink, "true"), (with_filter, "two-stage, forgetting 0.99"), (lost, "fault-blind Kalman filter")):
        handle.set_label(words)
    legend(figure, [ink, with_filter, lost, shade_handle("the rudder is stuck at 2 deg")])
    return figure
