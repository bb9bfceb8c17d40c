"""Pictures of recorded flights: what is true, what methods say of it, and what they show of themselves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_gym import palette
from fdi_gym.declaration import runs
from fdi_gym.engine import Record
from fdi_gym.plant import Plant
from fdi_gym.plots.panels import (
    TEXT,
    drawn,
    label_ticks,
    legend,
    new_figure,
    plain,
    shade,
    shade_handle,
    titled,
    truth,
)

BAND = 1.96  # stated deviations


def flight(
    plant: Plant, record: Record, said: dict[str, Any], i: int = 0, entries: Sequence[int] | None = None,
    sensors: bool = False,
) -> Any:  # fmt: skip
    """A figure of one recorded flight with the diagnoses of several methods: labels, then the estimated entries.

    Each method has a row of its own within each label, so that none hides another; the truth is above all.

    Args:
        plant: The plant.
        record: The flights.
        said: Decisions by name of the method.
        i: Which flight.
        entries: Which estimated entries are shown. Default: all where a method estimates.
        sensors: Show what the sensors say, too.
    """
    from matplotlib.lines import Line2D

    last = int(record.length[i])
    flown, t = slice(last + 1), np.arange(last + 1) * plant.dt
    estimating = any(d.estimate is not None for d in said.values())
    shown = list(range(len(plant.estimated) if estimating else 0)) if entries is None else list(entries)
    label = record.label[i, flown]
    declared = [decisions.label[i, flown] for decisions in said.values()]
    used = [int(v) for v in np.unique(np.concatenate([[0], label, *declared])) if v >= 0]
    small = [(signal, "estimate", j) for j, signal in enumerate(plant.estimated) if j in shown]
    small += [(signal, "sensor", j) for j, signal in enumerate(plant.outputs)] if sensors else []
    rows = math.ceil(len(small) / 2)
    tall = 0.45 + max(0.16, 0.09 * len(said)) * len(used)
    figure = new_figure(9.6, 0.5 + tall + 1.35 * rows)
    grid = figure.add_gridspec(1 + rows, 2, height_ratios=[tall, *[1.35] * rows])
    top = figure.add_subplot(grid[0, :])
    for m, decisions in enumerate(said.values()):
        colour, _ = palette.line(m)
        at = -0.36 + 0.72 * (m + 0.5) / len(said)
        for first, stop, value in runs(decisions.label[i, flown]):
            if value in used:
                begin, end = max(first - 1, 0) * plant.dt, (stop - 1) * plant.dt
                top.barh(used.index(value) + at, end - begin, 0.66 / len(said), begin, color=colour, zorder=2)
    xs = [x for first, stop, _ in runs(label) for x in (max(first - 1, 0) * plant.dt, (stop - 1) * plant.dt)]
    ys = [used.index(value) for *_, value in runs(label) for _ in range(2)]
    truth(top, xs, ys, lw=1.3)
    label_ticks(top, [plant.labels[v].name for v in used])
    plain(top, "label")
    axes = [top]
    for place, (signal, kind, j) in enumerate(small):
        axis = figure.add_subplot(grid[1 + place // 2, place % 2], sharex=top)
        axes.append(axis)
        plain(axis, titled(signal))
        if kind == "sensor":
            axis.plot(t, record.obs[i, flown, j], lw=0.7, color=palette.LINES[-1])
            continue
        values = [record.target[i, flown, j]]
        for m, decisions in enumerate(said.values()):
            if decisions.estimate is not None:
                estimate = decisions.estimate[i, flown, j]
                drawn(axis, t, estimate, m)
                values.append(estimate)
                if decisions.estimate_std is not None:
                    reach = BAND * decisions.estimate_std[i, flown, j]
                    colour, _ = palette.line(m)
                    axis.fill_between(t, estimate - reach, estimate + reach, color=colour, alpha=0.15, lw=0, zorder=1)
                    values += [estimate - np.nanmedian(reach), estimate + np.nanmedian(reach)]
        truth(axis, t, record.target[i, flown, j])
        _limits(axis, signal, values)
    for axis in axes:
        shade(axis, label, plant.dt)
    for axis in axes[-2:] if small else axes:
        axis.set_xlabel("time [s]", fontsize=TEXT)
    top.set_xlim(0, max(last, 1) * plant.dt)
    handles = [shade_handle(), Line2D([], [], color=palette.INK, label="truth")]
    for m, name in enumerate(said):
        colour, dashes = palette.line(m)
        handles.append(Line2D([], [], color=colour, label=name, lw=1.6, dashes=dashes or (None, None)))
    legend(figure, handles)
    return figure


def _limits(axis: Any, signal: Any, values: Sequence[Any]) -> None:
    """What is drawn, a few wild samples left out, and never less than a fifth of what the entry typically moves."""
    found = np.concatenate([v[np.isfinite(v)] for v in values])
    if not found.size:
        return
    low, high = np.quantile(found, [0.002, 0.998])
    half = max(0.56 * (high - low), 0.1 * signal.scale)
    axis.set_ylim((low + high) / 2 - half, (low + high) / 2 + half)


def method_signals(plant: Plant, record: Record, said: Any, i: int = 0) -> Any:
    """A figure of what a method shows of itself (`run(..., signals=True)`): residuals, thresholds, approximations.

    Where there are a residual and a threshold of the same shape they are in one panel for each component.

    Args:
        plant: The plant.
        record: The flights.
        said: Decisions with signals.
        i: Which flight.

    Raises:
        ValueError: There are no signals.
    """
    if not said.signals:
        raise ValueError("no signals were recorded: run(..., signals=True) with a method that has some")
    last = int(record.length[i])
    t = np.arange(last + 1) * plant.dt
    own = {name: values[i, : last + 1].reshape(last + 1, -1).astype(float) for name, values in said.signals.items()}
    panels: list[tuple[str, Any, Any]] = []
    residual, threshold = own.get("residual"), own.get("threshold")
    if residual is not None and threshold is not None and residual.shape == threshold.shape:
        panels += [(f"residual {j}", residual[:, [j]], threshold[:, [j]]) for j in range(residual.shape[1])]
        own = {name: values for name, values in own.items() if name not in ("residual", "threshold")}
    panels += [(name, values, None) for name, values in own.items()]
    figure = new_figure(9.6, 0.6 + 1.35 * len(panels))
    axes = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
    for axis, (name, values, limit) in zip(axes, panels, strict=True):
        for j in range(values.shape[1]):
            drawn(axis, t, values[:, j], j, lw=0.9)
        for edge in (limit, -limit) if limit is not None else ():
            axis.plot(t, edge, color=palette.INK, lw=0.9, ls="--", zorder=3)
        plain(axis, name)
        shade(axis, record.label[i, : last + 1], plant.dt)
        axis.set_xlim(0, max(last, 1) * plant.dt)
    axes[-1].set_xlabel("time [s]", fontsize=TEXT)
    from matplotlib.lines import Line2D

    bound = [Line2D([], [], color=palette.INK, ls="--", label="threshold")] if panels[0][2] is not None else []
    legend(figure, [shade_handle(), *bound])
    return figure
