"""The picture of a recorded flight."""

from __future__ import annotations

from typing import Any

import numpy as np

from fdi_gym import palette
from fdi_gym.plant import Array, Plant
from fdi_gym.plots.panels import SMALL, TEXT, drawn, legend, new_figure, plain


def recording(plant: Plant, obs: Array, time: Array, label: Array | None, said: dict[str, Any]) -> Any:
    """A figure of one recorded flight: its sensors, and what each of any number of methods declared when, as strips.

    Args:
        plant: The plant.
        obs: Observations (K + 1, n_obs).
        time: (K + 1,) s.
        label: (K + 1,) true labels; None where they are not known.
        said: Decisions (of one flight) by name of the method.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    strips = ({} if label is None else {"truth": label}) | {name: one.label[0] for name, one in said.items()}
    height = 0.6 + 0.17 * len(strips)
    figure = new_figure(9.6, 3.4 + height)
    top, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [2.4, height]})
    lines = [
        drawn(top, time, (obs[:, j] - s.nominal) / s.scale, j, lw=0.7, label=f"{s.name} [{s.scale:g} {s.unit}]".strip())
        for j, s in enumerate(plant.outputs)
    ]
    plain(top, "sensors, in units of their scales")
    rows = np.array(list(strips.values()))
    faulty = max(len(plant.labels) - 1, 1)
    shades = [palette.SHADE, *(palette.LINES[i % len(palette.LINES)] for i in range(faulty)), palette.INK]
    rows = np.where(rows < 0, len(shades) - 1, rows)
    below.imshow(
        rows, aspect="auto", interpolation="nearest", cmap=ListedColormap(shades), vmin=-0.5, vmax=len(shades) - 0.5,
        extent=(time[0], time[-1], len(rows) - 0.5, -0.5),
    )  # fmt: skip
    below.set_yticks(range(len(strips)), list(strips), fontsize=SMALL - 1)
    below.set_xlabel("time [s]", fontsize=TEXT)
    plain(below)
    names = [*(entry.name for entry in plant.labels), "lost"]
    legend(figure, [*lines, *(Patch(color=shades[i], label=names[i]) for i in np.unique(rows))])
    return figure
