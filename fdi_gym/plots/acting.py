"""Pictures of flights that are acted on: accuracy against cost, what is recovered, and one flight with its probes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fdi_gym import palette
from fdi_gym.plant import Array, Plant
from fdi_gym.plots.panels import SMALL, TEXT, legend, new_figure, plain

MOST = 6  # labels whose belief is shown


class Point(NamedTuple):
    """A row on a curve: value and cost with their intervals."""

    name: str
    value: tuple[float, float, float]
    cost: tuple[float, float, float]


class Shown(NamedTuple):
    """One flight under one agent: belief (K + 1, labels), probe (K + 1,) and cost (K + 1,)."""

    belief: Array
    probe: Array
    cost: Array


def pareto(curves: Mapping[str, Sequence[Point]], title: str) -> Any:
    """Accuracy [%] against the cost of probing, a curve for each family, from little probing to much.

    Args:
        curves: Points by family.
        title: What is shown.
    """
    figure = new_figure(8.2, 4.6)
    axis, handles = figure.subplots(), []
    for i, (name, points) in enumerate(curves.items()):
        colour, dash = palette.line(i)
        points = sorted(points, key=lambda point: point.cost[0])
        x, y = np.array([p.cost for p in points]), 100 * np.array([p.value for p in points])
        (line,) = axis.plot(x[:, 0], y[:, 0], color=colour, dashes=dash, marker="o", ms=4, lw=1.5, label=name)
        for centre, (middle, low, high) in ((x, y.T), (y, x.T)):
            reach = [np.maximum(middle - low, 0.0), np.maximum(high - middle, 0.0)]
            at = (centre[:, 0], middle) if centre is x else (middle, centre[:, 0])
            which = {"yerr": reach} if centre is x else {"xerr": reach}
            axis.errorbar(*at, **which, fmt="none", ecolor=colour, elinewidth=0.8, alpha=0.7)  # type: ignore[arg-type]
        handles.append(line)
    axis.set_xlabel("cost that probing adds to a flight, per sample [1]", fontsize=TEXT)
    axis.set_ylabel("balanced accuracy per sample [%]", fontsize=TEXT)
    axis.set_title(title, fontsize=TEXT)
    axis.grid(lw=0.4)
    plain(axis)
    legend(figure, handles, ncol=3)
    return figure


def allowances(points: Sequence[Point], title: str) -> Any:
    """What flights cost with each entrant, the cheapest first, and how right it is.

    Args:
        points: Accuracy and cost of each entrant.
        title: What is shown.
    """
    figure = new_figure(8.2, 1.2 + 0.34 * len(points))
    axis = figure.subplots()
    points = sorted(points, key=lambda point: point.cost[0])
    for place, point in enumerate(points):
        middle, low, high = point.cost
        axis.plot([low, high], [place, place], color=palette.LINES[0], lw=1.8)
        axis.plot(middle, place, "o", color=palette.LINES[0], ms=4.5)
    names = [f"{p.name} ({100 * p.value[0]:.0f} % right)" for p in points]
    axis.set_yticks(range(len(points)), names, fontsize=SMALL)
    axis.set_ylim(len(points) - 0.5, -0.5)
    axis.grid(axis="x", lw=0.4)
    plain(axis)
    axis.set_xlabel("flight cost per sample [1], 95 % intervals", fontsize=TEXT)
    axis.set_title(title, fontsize=TEXT)
    return figure


def acted_flight(plant: Plant, label: Array, shown: Mapping[str, Shown], title: str) -> Any:
    """One flight under several agents: their beliefs, which probe acts, and what it costs.

    Args:
        plant: The plant.
        label: (K + 1,) the true label.
        shown: By agent; the last one's probes are shown.
        title: What is shown.
    """
    assert plant.acting is not None
    t = np.arange(len(label)) * plant.dt
    figure = new_figure(9.2, 2.0 * len(shown) + 2.8)
    axes = figure.subplots(len(shown) + 2, 1, sharex=True)
    common = np.argsort(-sum(s.belief.sum(axis=0) for s in shown.values()), kind="stable").tolist()
    values = list(dict.fromkeys([0, *label[label > 0].tolist()[:1], *common]))[:MOST]
    for axis, (name, one) in zip(axes, shown.items(), strict=False):
        for i, value in enumerate(values):
            colour, dash = palette.line(i)
            axis.plot(t, one.belief[:, value], color=colour, dashes=dash, lw=1.3, label=plant.labels[value].name)
        axis.fill_between(t, 0, 1, where=label > 0, color=palette.SHADE, lw=0, zorder=0)
        axis.set_ylabel("belief [1]", fontsize=SMALL)
        axis.set_title(f"{name}; shaded: {plant.labels[int(label.max())].name} acts", fontsize=SMALL, loc="left")
        axis.legend(fontsize=SMALL, frameon=False, bbox_to_anchor=(1.0, 1.0), loc="upper left")
        axis.set_ylim(-0.03, 1.03)
    names = [p.name for p in plant.acting.probes]
    axes[-2].step(t, list(shown.values())[-1].probe, where="post", color=palette.INK, lw=1.2)
    axes[-2].set_yticks(range(len(names)), names, fontsize=SMALL)
    axes[-2].set_ylim(-0.3, len(names) - 0.7)
    axes[-2].set_ylabel("probe", fontsize=SMALL)
    for i, (name, one) in enumerate(shown.items()):
        colour, dash = palette.line(i)
        axes[-1].plot(t, one.cost, color=colour, dashes=dash, lw=1.2, label=name)
    top = np.percentile(np.concatenate([one.cost for one in shown.values()]), 98)
    axes[-1].set_ylim(0, 1.1 * max(top, 1e-3))
    axes[-1].set_ylabel("flight cost [1]", fontsize=SMALL)
    axes[-1].set_xlabel("time [s]", fontsize=SMALL)
    axes[-1].legend(fontsize=SMALL, frameon=False, bbox_to_anchor=(1.0, 1.0), loc="upper left")
    for axis in axes:
        plain(axis)
    figure.suptitle(title, fontsize=TEXT)
    return figure
