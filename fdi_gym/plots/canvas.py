"""The picture of a flight under way, as environments render it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_gym import palette
from fdi_gym.declaration import END, ONSET, PRESENT, true_declaration
from fdi_gym.engine import Record
from fdi_gym.plant import Array, Plant
from fdi_gym.plots.panels import TEXT, label_height, label_ticks, plain, shade, titled, truth

ACROSS = 4  # small panels beside each other
SENSORS, ENTRIES = 0.95, 1.1  # inches of a row of panels
SAID = palette.LINES[1]


class Canvas:
    """One figure, drawn again as the flight goes on: a panel for each sensor, and truth and diagnosis in one.

    Of the label, the estimated entries, both, or, for a declared scenario, the windows in which each mode acted.

    Args:
        plant: The plant.
        task: Name of the task.
        window: Show a window that follows along; else pictures only.
    """

    def __init__(self, plant: Plant, task: str, window: bool = False):
        self.plant, self.task = plant, task
        outputs, entries = len(plant.outputs), len(plant.estimated)
        heights = [SENSORS] * math.ceil(outputs / ACROSS)
        rows = len(heights)
        if task in ("isolation", "diagnosis"):
            heights.append(label_height(plant))
        if task in ("identification", "diagnosis"):
            heights += [ENTRIES] * math.ceil(entries / ACROSS)
        if task in ("scenario", "modes"):
            heights.append(0.5 + 0.14 * len(plant.modes))
        size = (9.6, sum(heights) + 0.42 * (len(heights) - 1) + 0.95)
        if window:
            import matplotlib.pyplot as plt

            self.figure: Any = plt.figure(figsize=size, dpi=100, num=plant.env_id)
            self._show = plt
        else:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure

            self.figure = Figure(figsize=size, dpi=100)
            FigureCanvasAgg(self.figure)
            self._show = None
        names = [label.name for label in plant.labels] if task not in ("scenario", "modes") else list(plant.mode_names)
        wide = min(0.05 + 0.0078 * max(map(len, names)), 0.26) if task != "identification" else 0.06
        grid = self.figure.add_gridspec(
            len(heights), 1, height_ratios=heights, left=0.06, right=0.985, top=1 - 0.55 / size[1], bottom=0.42 / size[1],
            hspace=0.42 * len(heights) / sum(heights),
        )  # fmt: skip
        self.sensors = self._panels(grid, 0, outputs)
        row = rows
        self.answer: Any = None
        self.entries: Any = None
        if task != "identification":
            self.answer = self.figure.add_subplot(grid[row])
            box = self.answer.get_position()
            self.answer.set_position((wide, box.y0, box.x1 - wide, box.height))
            row += 1
        if task in ("identification", "diagnosis"):
            self.entries = self._panels(grid, row, entries)

    def _panels(self, grid: Any, row: int, count: int) -> list[Any]:
        """Small panels from a row of the grid on."""
        across = min(ACROSS, count)
        found = []
        for i in range(count):
            if i % across == 0:
                inner = grid[row + i // across].subgridspec(1, across, wspace=0.28)
            found.append(self.figure.add_subplot(inner[i % across]))
        return found

    def draw(self, record: Record, k: int, declared: Sequence[tuple[int, Any]]) -> Array | None:
        """Draw the flight up to sample k.

        Args:
            record: One flight (its first one is drawn).
            k: The current sample.
            declared: (sample, answer) pairs so far, as the task's `check` gives them.

        Returns:
            The picture, (H, W, 3) uint8, or None for a window.
        """
        from matplotlib.lines import Line2D

        from fdi_gym.plots.panels import shade_handle

        plant, t = self.plant, np.arange(k + 1) * self.plant.dt
        label = record.label[0, : k + 1]
        at = np.array([j for j, _ in declared], float) * plant.dt
        last = [*self.sensors, *([self.answer] if self.answer else []), *(self.entries or [])]
        for axis in last:
            axis.clear()
            shade(axis, label, plant.dt)
            axis.set_xlim(0, max(k, 1) * plant.dt)
            if axis is not self.answer:
                axis.locator_params(nbins=3)  # most of the time goes into ticks
        for j, (axis, signal) in enumerate(zip(self.sensors, plant.outputs, strict=True)):
            axis.plot(t, record.obs[0, : k + 1, j], lw=0.8, color=palette.LINES[0])
            plain(axis, titled(signal))
        if self.task in ("isolation", "diagnosis"):
            said = [int(a if self.task == "isolation" else a[0]) for _, a in declared]
            self.answer.plot(at, said, "s", ms=4, mew=0, color=SAID, zorder=2)
            self.answer.step(t, label, where="post", color=palette.INK, lw=1.1, zorder=4)
            label_ticks(self.answer, [entry.name for entry in plant.labels])
            plain(self.answer, "label")
        if self.task == "modes":
            row = np.arange(len(plant.modes))
            told = np.array([a for _, a in declared], bool).reshape(-1, len(row))
            self.answer.plot(at, np.where(told, row, np.nan), "s", ms=4, mew=0, color=SAID, zorder=2)
            self.answer.plot(t, np.where(plant.modes_of(label), row, np.nan), color=palette.INK, lw=1.1, zorder=4)
            label_ticks(self.answer, plant.mode_names)
            plain(self.answer, "fault modes")
        if self.entries is not None:
            first = int(self.task == "diagnosis")
            for j, (axis, signal) in enumerate(zip(self.entries, plant.estimated, strict=True)):
                axis.plot(at, [a[first + j] for _, a in declared], color=SAID, lw=1.2, zorder=2)
                truth(axis, t, record.target[0, : k + 1, j])
                plain(axis, titled(signal))
        if self.task == "scenario":
            self._windows(record, k, declared[-1][1] if declared else None)
        last[-1].set_xlabel("time [s]", fontsize=TEXT)
        for text in self.figure.texts:
            text.remove()
        for old in self.figure.legends:
            old.remove()
        self.figure.text(
            0.012, 1 - 0.2 / self.figure.get_figheight(), f"{plant.env_id}, t = {k * plant.dt:.1f} s", fontsize=9
        )
        mark: dict[str, Any] = {"color": SAID}
        if self.answer is not None:
            mark |= {"ls": "", "marker": "s", "ms": 5}
        handles = [
            shade_handle(),
            Line2D([], [], color=palette.INK, label="truth"),
            Line2D([], [], label="diagnosis", **mark),
        ]
        self.figure.legend(handles=handles, loc="upper right", ncol=3, fontsize=8, frameon=False)
        if self._show is not None:
            self.figure.canvas.draw_idle()
            self._show.pause(1e-3)
            return None
        self.figure.canvas.draw()
        return np.asarray(self.figure.canvas.buffer_rgba())[..., :3].copy()

    def _windows(self, record: Record, k: int, said: Array | None) -> None:
        """The windows of each mode: the true one up to sample k, and the one declared last, as shares of the flight."""
        axis, length, dt = self.answer, int(record.length[0]), self.plant.dt
        for i, row in enumerate(true_declaration(self.plant, record)[0]):
            if said is not None and said[i, PRESENT] >= 0.5:
                first, end = said[i, ONSET] * length * dt, said[i, END] * length * dt
                axis.barh(i, end - first, 0.62, first, color=SAID, zorder=2)
            if row[PRESENT] and row[ONSET] < k:
                axis.plot([row[ONSET] * dt, min(row[END], k) * dt], [i, i], color=palette.INK, lw=2, zorder=4)
        label_ticks(axis, self.plant.mode_names)
        plain(axis, "windows of the fault modes")

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._show is not None:
            self._show.close(self.figure)
