"""Pictures of what the flights of a suite come to: rankings, confusions, delays, severities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fdi_gym import palette
from fdi_gym.plots.panels import SMALL, TEXT, drawn, legend, new_figure, plain


def ranking(rows: Sequence[Any], frame: Sequence[Any], bars: Sequence[tuple[int, int]], flights: int = 0) -> Any:
    """A critical-difference picture: balanced accuracy per sample with its interval, best first.

    Args:
        rows: Rows (`fdi_gym.row.Row`) in the order of their scores.
        frame: Rows of floor and ceilings: lines.
        bars: (first, last) of the runs of rows no two of which can be told apart.
        flights: How many there were, for the caption.
    """
    figure = new_figure(9.6, 1.4 + 0.22 * max(len(rows), 1))
    axis = figure.subplots()
    for place, row in enumerate(rows):
        found = row.metrics["per_sample"]
        low, high = found["balanced_accuracy_interval"]
        axis.plot([100 * low, 100 * high], [place, place], color=palette.LINES[0], lw=1.8)
        axis.plot(100 * found["balanced_accuracy"], place, "o", color=palette.LINES[0], ms=4.5)
    handles = []
    for i, row in enumerate(frame):
        score = row.metrics["per_sample"]["balanced_accuracy"]
        if score is not None:
            colour = palette.LINES[-1] if i % 2 else palette.INK
            handles.append(axis.axvline(100 * score, color=colour, lw=1, ls=(0, (1 + i, 1.5)),
                                        label=f"{row.diagnoser} {100 * score:.1f}"))  # fmt: skip
    for i, (first, last) in enumerate(bars):
        axis.plot([1.012 + 0.012 * i] * 2, [first - 0.2, last + 0.2], color=palette.LINES[1], lw=2.5, clip_on=False,
                  transform=axis.get_yaxis_transform())  # fmt: skip
    axis.set_yticks(range(len(rows)), [row.diagnoser for row in rows], fontsize=SMALL)
    axis.set_ylim(len(rows) - 0.5, -0.5)
    axis.grid(axis="x", lw=0.4)
    plain(axis)
    count = f", {flights} flights" if flights else ""
    said = f"balanced accuracy per sample [%], 95 % intervals{count}; bars at the right join what cannot be told apart"
    axis.set_xlabel(said, fontsize=TEXT)
    if handles:
        legend(figure, handles, ncol=3)
    return figure


def confusions(row: Any, labels: Sequence[str]) -> Any:
    """A figure of a row's confusion matrices, per sample and per decision, in percent of the true label.

    Long names across are numbers, which stand before the names down.

    Args:
        row: The row (`fdi_gym.row.Row`).
        labels: Names of the labels.
    """
    many = len(labels) > 8
    side = 2.4 + 0.32 * len(labels)
    figure = new_figure(2 * side - (1.0 if many else 0.6), side - (0.6 if many else 0.4))
    axes = figure.subplots(1, 2, sharey=True)
    down = [f"{name}  {i}" for i, name in enumerate(labels)] if many else list(labels)
    for axis, kind in zip(axes, ("per_sample", "per_decision"), strict=True):
        counts = np.array(row.metrics[kind]["confusion"], float)
        lost = counts[:, -1].any()
        across = [str(i) for i in range(len(labels))] if many else list(labels)
        across += ["lost"] if lost else []
        total = counts.sum(axis=1, keepdims=True)
        share = np.where(total > 0, 100 * counts / np.maximum(total, 1), np.nan)[:, : len(across)]
        axis.imshow(share, vmin=0, vmax=100, cmap="Blues", aspect="auto")
        for i, j in np.argwhere(share >= 0.5):
            colour = "white" if share[i, j] > 60 else palette.INK
            axis.text(j, i, f"{share[i, j]:.0f}", ha="center", va="center", fontsize=6.5, color=colour)
        rotation = {} if many else {"rotation": 90}
        axis.set_xticks(range(len(across)), across, fontsize=SMALL, **rotation)
        axis.set_yticks(range(len(labels)), down, fontsize=SMALL)
        least, most = int(total.min()), int(total.max())
        n = f"n {least}" if least == most else f"n {least} to {most}"
        axis.set_title(f"{kind.replace('_', ' ')} [% of the true label], {n}", fontsize=TEXT, loc="left")
        axis.set_xlabel("declared", fontsize=TEXT)
    axes[0].set_ylabel("true", fontsize=TEXT)
    figure.suptitle(row.diagnoser, fontsize=TEXT + 1, x=0.01, ha="left")
    return figure


def delays(curves: Mapping[str, Mapping[str, Any]]) -> Any:
    """How soon faults show: the share that is detected, and isolated, by a time after the onset, with 95 % bands.

    Args:
        curves: By "detection" and "isolation" the curve (`fdi_gym.curves.Curve`) of each method.
    """
    figure = new_figure(9.6, 3.6)
    axes = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    handles: dict[str, Any] = {}
    for axis, (kind, of) in zip(axes, curves.items(), strict=True):
        for m, (name, curve) in enumerate(of.items()):
            line = drawn(axis, curve.x, 100 * curve.share, m, drawstyle="steps-post")
            handles.setdefault(name, line).set_label(name)
            axis.fill_between(
                curve.x, 100 * curve.low, 100 * curve.high, step="post", lw=0, alpha=0.18, color=palette.line(m)[0]
            )
        counts = ", ".join(str(int(curve.count[0]) if len(curve.count) else 0) for curve in of.values())
        plain(
            axis,
            f"{ {'detection': 'an alarm is on', 'isolation': 'the right label is declared'}[kind] } (n {counts} faults)",
        )
        axis.set(ylim=(0, 102), xlim=(0, None))
        axis.grid(lw=0.4)
        axis.set_xlabel("time since the onset [s]", fontsize=TEXT)
    axes[0].set_ylabel("share of faults [%]", fontsize=TEXT)
    legend(figure, handles.values(), ncol=3)
    return figure


def severities(curves: Mapping[str, Any], bands: Sequence[str], unit: str) -> Any:
    """The share of right labels by the severity of the fault, with 95 % intervals.

    Args:
        curves: The curve (`fdi_gym.curves.Curve`) of each method.
        bands: Names of the severities.
        unit: What is counted: "samples" or "decisions".
    """
    figure = new_figure(6.4, 3.8)
    axis = figure.subplots()
    handles, count = [], np.zeros(len(bands))
    for m, (name, curve) in enumerate(curves.items()):
        x = curve.x + 0.06 * (m - (len(curves) - 1) / 2)
        handles.append(drawn(axis, x, 100 * curve.share, m, marker="o", ms=4, label=name))
        axis.vlines(x, 100 * curve.low, 100 * curve.high, color=palette.line(m)[0], lw=1.2)
        count = curve.count
    axis.set_xticks(range(len(bands)), [f"{band}\nn {int(n)}" for band, n in zip(bands, count, strict=True)], fontsize=SMALL)
    axis.set_ylim(0, 102)
    axis.grid(axis="y", lw=0.4)
    plain(axis)
    axis.set_ylabel(f"right labels [% of {unit}]", fontsize=TEXT)
    legend(figure, handles, ncol=2)
    return figure
