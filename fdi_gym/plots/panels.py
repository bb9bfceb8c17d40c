"""What the panels of all pictures have in common."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from fdi_gym import palette
from fdi_gym.data_sheet import Signal
from fdi_gym.declaration import stretches
from fdi_gym.plant import Array, Plant

SMALL, TEXT = 7, 8  # points


def titled(signal: Signal) -> str:
    """Name and unit: "beta [deg]"."""
    return f"{signal.name} [{signal.unit}]" if signal.unit else signal.name


def new_figure(width: float, height: float) -> Any:
    """A figure of a size in inches that shows in no window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def plain(axis: Any, title: str = "") -> None:
    """No box, small letters, numbers on the axes as they are (no offset to add), the title at the left above."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=SMALL, length=2.5)
    for formatter in (axis.xaxis.get_major_formatter(), axis.yaxis.get_major_formatter()):
        if hasattr(formatter, "set_useOffset"):
            formatter.set_useOffset(False)
    if title:
        axis.set_title(title, loc="left", fontsize=TEXT, pad=3)


def shade(axis: Any, label: Array, dt: float) -> None:
    """A shade where a fault acts."""
    for first, stop in stretches(label > 0):  # sample k closes the interval from k - 1
        axis.axvspan(max(first - 1, 0) * dt, (stop - 1) * dt, color=palette.SHADE, lw=0, zorder=0)


def drawn(axis: Any, x: Any, y: Any, i: int, **more: Any) -> Any:
    """The i-th line of a picture."""
    colour, dashes = palette.line(i)
    (line,) = axis.plot(x, y, color=colour, **{"lw": 1.2, "zorder": 2, **more})
    if dashes:
        line.set_dashes(dashes)
    return line


def truth(axis: Any, x: Any, y: Any, **more: Any) -> Any:
    """The truth: ink, above all else."""
    return axis.plot(x, y, color=palette.INK, **{"lw": 1.0, "zorder": 4, **more})[0]


def label_ticks(axis: Any, names: Sequence[str]) -> None:
    """A row for each label, the first one on top."""
    axis.set_ylim(len(names) - 0.5, -0.5)
    axis.set_yticks(range(len(names)), names, fontsize=SMALL if len(names) <= 9 else SMALL - 1)


def legend(figure: Any, handles: Iterable[Any], **place: Any) -> None:
    """A legend outside the panels."""
    handles = list(handles)
    figure.legend(handles=handles, **{"loc": "outside upper left", "ncol": min(len(handles), 6), "fontsize": SMALL + 0.5,
                                      "frameon": False, **place})  # fmt: skip


def shade_handle(text: str = "a fault acts") -> Any:
    """For the legend: what a shade means."""
    from matplotlib.patches import Patch

    return Patch(color=palette.SHADE, label=text)


def label_height(plant: Plant) -> float:
    """Inches that a panel of all labels takes."""
    return 0.5 + 0.14 * len(plant.labels)
