"""Pictures: signals, truth and diagnosis of a flight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_gym.declaration import END, ONSET, PRESENT, stretches, true_declaration
from fdi_gym.engine import Record
from fdi_gym.plant import Array, Plant

INK, TRUTH, SAID, SHADE = "#333333", "#1b6ca8", "#d1495b", "#f3dcd4"


class Canvas:
    """One figure, drawn again as the flight goes on: what the sensors say, and truth and diagnosis beside each other.

    Of the label, the estimated entries, both, or, for a declared scenario, the windows in which each mode acted.

    Args:
        plant: The plant.
        task: Name of the task.
        window: Show a window that follows along; else pictures only.
    """

    def __init__(self, plant: Plant, task: str, window: bool = False):
        from matplotlib.figure import Figure

        self.plant, self.task = plant, task
        entries = min(len(plant.estimated), 4 if task == "identification" else 3)
        rows = 1 + {"isolation": 1, "identification": entries, "diagnosis": 1 + entries, "scenario": 1}[task]
        size = (9.6, 6.4)
        if window:
            import matplotlib.pyplot as plt

            self.figure: Any = plt.figure(figsize=size, num=plant.env_id)
            self._show = plt
        else:
            from matplotlib.backends.backend_agg import FigureCanvasAgg

            self.figure = Figure(figsize=size, dpi=100)
            FigureCanvasAgg(self.figure)
            self._show = None
        ratios = [2.2, *[1.0] * (rows - 1)]
        self.axes = self.figure.subplots(rows, 1, sharex=True, gridspec_kw={"height_ratios": ratios})

    def draw(self, record: Record, k: int, declared: Sequence[tuple[int, Any]]) -> Array | None:
        """Draw the flight up to sample k.

        Args:
            record: One flight (its first one is drawn).
            k: The current sample.
            declared: (sample, answer) pairs so far, as the task's `check` gives them.

        Returns:
            The picture, (H, W, 3) uint8, or None for a window.
        """
        plant, t = self.plant, np.arange(k + 1) * self.plant.dt
        label = record.label[0, : k + 1]
        said_t = np.array([j for j, _ in declared]) * plant.dt
        for axis in self.axes:
            axis.clear()
            _dress(axis, label, plant.dt)
        top = self.axes[0]
        for j, signal in enumerate(plant.outputs):
            values = (record.obs[0, : k + 1, j] - signal.nominal) / signal.scale
            top.plot(t, values, lw=0.8, label=signal.name)
        top.legend(loc="upper left", ncol=6, fontsize=7, frameon=False)
        top.set_ylabel("sensors, scaled")
        top.set_title(f"{plant.env_id}   t = {k * plant.dt:.1f} s   shaded: a fault acts", loc="left", fontsize=9)
        if self.task in ("isolation", "diagnosis"):
            self._draw_labels(t, label, said_t, [int(a if self.task == "isolation" else a[0]) for _, a in declared])
        if self.task in ("identification", "diagnosis"):
            at = int(self.task == "diagnosis")
            for j, axis in enumerate(self.axes[1 + at :]):
                axis.plot(t, record.target[0, : k + 1, j], color=TRUTH, lw=1.8, label="truth")
                axis.plot(said_t, [a[at + j] for _, a in declared], color=SAID, lw=0.9, label="diagnosis")
                axis.set_ylabel(f"{plant.estimated[j].name}\n{plant.estimated[j].unit}", fontsize=7)
            self.axes[-1].legend(loc="upper left", fontsize=7, frameon=False, ncol=2)
        if self.task == "scenario":
            self._draw_windows(record, k, declared[-1][1] if declared else None)
        self.axes[-1].set_xlabel("time, s")
        self.axes[-1].set_xlim(0, max(k, 1) * plant.dt)
        if self._show is not None:
            self.figure.canvas.draw_idle()
            self._show.pause(1e-3)
            return None
        self.figure.tight_layout()
        self.figure.canvas.draw()
        return np.asarray(self.figure.canvas.buffer_rgba())[..., :3].copy()

    def _draw_labels(self, t: Array, label: Array, said_t: Array, said: Sequence[int]) -> None:
        axis = self.axes[1]
        axis.step(t, label, where="post", color=TRUTH, lw=1.8, label="truth")
        axis.plot(said_t, said, ".", ms=2.5, color=SAID, label="diagnosis")
        axis.set_ylim(-0.5, len(self.plant.labels) - 0.5)
        axis.set_yticks(range(len(self.plant.labels)), [entry.name for entry in self.plant.labels], fontsize=7)
        axis.legend(loc="upper left", fontsize=7, frameon=False)

    def _draw_windows(self, record: Record, k: int, said: Array | None) -> None:
        """The windows of each mode: the true one up to sample k, and the one declared last, as shares of the flight."""
        axis, length, dt = self.axes[1], int(record.length[0]), self.plant.dt
        truth = true_declaration(self.plant, record)[0]
        for i, row in enumerate(truth):
            if row[PRESENT] and row[ONSET] < k:
                axis.barh(i + 0.15, (min(row[END], k) - row[ONSET]) * dt, 0.3, row[ONSET] * dt, color=TRUTH)
            if said is not None and said[i, PRESENT] >= 0.5:
                axis.barh(
                    i - 0.15, (said[i, END] - said[i, ONSET]) * length * dt, 0.3, said[i, ONSET] * length * dt, color=SAID
                )
        axis.set_ylim(-0.5, len(truth) - 0.5)
        axis.set_yticks(range(len(truth)), [mode.name for mode in self.plant.modes], fontsize=7)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._show is not None:
            self._show.close(self.figure)


def _dress(axis: Any, label: Array, dt: float) -> None:
    """No box, and a shade where a fault acts."""
    axis.spines[["top", "right"]].set_visible(False)
    for first, stop in stretches(label > 0):  # sample k closes the interval from k - 1
        axis.axvspan(max(first - 1, 0) * dt, (stop - 1) * dt, color=SHADE, lw=0, zorder=0)


def flight(plant: Plant, record: Record, said: dict[str, Any], i: int = 0, entries: Sequence[int] | None = None) -> Any:
    """A figure of one recorded flight with the diagnoses of several methods: labels, then the estimated entries.

    Args:
        plant: The plant.
        record: The flights.
        said: Decisions by name of the method.
        i: Which flight.
        entries: Which estimated entries are shown; default the first four.
    """
    from matplotlib.figure import Figure

    estimates = {name: d for name, d in said.items() if d.estimate is not None}
    shown = list(range(min(len(plant.estimated), 4))) if entries is None else list(entries)
    rows = 1 + len(shown)
    figure = Figure(figsize=(9.6, 1.6 + 1.5 * rows), dpi=120, layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True)
    length = int(record.length[i]) + 1
    t = np.arange(length) * plant.dt
    colours = [SAID, "#e0a030", "#4c9f70", "#7b5ea7", INK]
    axes[0].step(t, record.label[i, :length], where="post", color=TRUTH, lw=3.5, alpha=0.5, label="truth")
    for colour, (name, decisions) in zip(colours, said.items(), strict=False):
        axes[0].step(t, decisions.label[i, :length], where="post", color=colour, lw=1.1, label=name)
    axes[0].set_yticks(range(len(plant.labels)), [entry.name for entry in plant.labels], fontsize=7)
    for j, axis in zip(shown, axes[1:], strict=True):
        axis.plot(t, record.target[i, :length, j], color=TRUTH, lw=3.5, alpha=0.5)
        for colour, (name, decisions) in zip(colours, said.items(), strict=False):
            if name in estimates:
                axis.plot(t, decisions.estimate[i, :length, j], color=colour, lw=0.9)
        axis.set_ylabel(f"{plant.estimated[j].name} {plant.estimated[j].unit}", fontsize=8)
    for axis in axes:
        _dress(axis, record.label[i, :length], plant.dt)
    axes[0].legend(loc="upper left", fontsize=7, frameon=False, ncol=5, bbox_to_anchor=(0, 1.25))
    axes[-1].set_xlabel("time, s")
    return figure


def recording(plant: Plant, obs: Array, time: Array, label: Array | None, said: dict[str, Any]) -> Any:
    """A figure of one recorded flight: its sensors, and what each of any number of methods declared when, as strips.

    Args:
        plant: The plant.
        obs: Observations (K + 1, n_obs).
        time: (K + 1,) s.
        label: (K + 1,) true labels; None where they are not known.
        said: Decisions (of one flight) by name of the method.
    """
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    strips = ({} if label is None else {"truth": label}) | {name: one.label[0] for name, one in said.items()}
    height = 0.6 + 0.17 * len(strips)
    figure = Figure(figsize=(9.6, 3.0 + height), dpi=120, layout="constrained")
    top, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [2.4, height]})
    for j, signal in enumerate(plant.outputs):
        top.plot(time, (obs[:, j] - signal.nominal) / signal.scale, lw=0.7, label=signal.name)
    top.legend(loc="upper left", ncol=8, fontsize=6, frameon=False)
    top.set_ylabel("sensors, scaled", fontsize=8)
    top.spines[["top", "right"]].set_visible(False)
    rows = np.array(list(strips.values()))
    shades = np.vstack([[0.93, 0.93, 0.93, 1.0], colormaps["tab20"](np.arange(max(len(plant.labels) - 1, 1)) % 20)])
    rows = np.where(rows < 0, len(shades), rows)
    below.imshow(
        rows, aspect="auto", interpolation="nearest", cmap=ListedColormap([*shades, (0, 0, 0, 1)]), vmin=-0.5,
        vmax=len(shades) + 0.5, extent=(time[0], time[-1], len(rows) - 0.5, -0.5),
    )  # fmt: skip
    below.set_yticks(range(len(strips)), list(strips), fontsize=6)
    below.set_xlabel("time, s")
    seen = np.unique(rows)
    names = [*(entry.name for entry in plant.labels), "lost"]
    patches = [Patch(color=[*shades, (0, 0, 0, 1)][i], label=names[i]) for i in seen]
    below.legend(handles=patches, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=6, frameon=False)
    return figure


def method_signals(plant: Plant, record: Record, said: Any, i: int = 0) -> Any:
    """A figure of what a method shows of itself (`run(..., signals=True)`): residuals, thresholds, approximations.

    Args:
        plant: The plant.
        record: The flights.
        said: Decisions with signals.
        i: Which flight.

    Raises:
        ValueError: There are no signals.
    """
    from matplotlib.figure import Figure

    if not said.signals:
        raise ValueError("no signals were recorded: run(..., signals=True) with a method that has some")
    figure = Figure(figsize=(9.6, 1.0 + 1.5 * len(said.signals)), dpi=120, layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(said.signals), 1, sharex=True))
    length = int(record.length[i]) + 1
    t = np.arange(length) * plant.dt
    for axis, (name, values) in zip(axes, said.signals.items(), strict=True):
        axis.plot(t, values[i, :length].reshape(length, -1), lw=0.9)
        axis.set_ylabel(name, fontsize=8)
        _dress(axis, record.label[i, :length], plant.dt)
    axes[-1].set_xlabel("time, s")
    return figure


def ranking(rows: Sequence[Any], frame: Sequence[Any], bars: Sequence[tuple[int, int]]) -> Any:
    """A critical-difference picture: balanced accuracy per sample with its interval, best first.

    Args:
        rows: Rows (`fdi_gym.row.Row`) in the order of their scores.
        frame: Rows of floor and ceilings: lines.
        bars: (first, last) of the runs of rows no two of which can be told apart.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 1.2 + 0.22 * len(rows)), dpi=120, layout="constrained")
    axis = figure.subplots()
    scores = [row.metrics["per_sample"] for row in rows]
    for place, found in enumerate(scores):
        low, high = found["balanced_accuracy_interval"]
        axis.plot([100 * low, 100 * high], [place, place], color=TRUTH, lw=1.6)
        axis.plot(100 * found["balanced_accuracy"], place, "o", color=TRUTH, ms=4)
    lines: dict[int, list[str]] = {}  # at whole percents, so that the names of null and random don't overlap
    for row in frame:
        lines.setdefault(round(100 * row.metrics["per_sample"]["balanced_accuracy"]), []).append(row.diagnoser)
    for at, names in lines.items():
        axis.axvline(at, color=INK, lw=0.8, ls=":")
        axis.annotate(", ".join(names), (at, 1.0), xycoords=("data", "axes fraction"), fontsize=7, rotation=20, ha="left")
    for i, (first, last) in enumerate(bars):
        axis.plot([1.01 + 0.012 * i] * 2, [first - 0.2, last + 0.2], color=SAID, lw=2.5, clip_on=False,
                  transform=axis.get_yaxis_transform())  # fmt: skip
    axis.set_yticks(range(len(rows)), [row.diagnoser for row in rows], fontsize=7)
    axis.set_ylim(len(rows) - 0.5, -0.5)
    axis.set_xlabel("balanced accuracy per sample, %; bars at the right join what cannot be told apart")
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def confusions(row: Any, labels: Sequence[str]) -> Any:
    """A figure of a row's confusion matrices, per sample and per decision, in percent of the true label.

    Args:
        row: The row (`fdi_gym.row.Row`).
        labels: Names of the labels.
    """
    from matplotlib.figure import Figure

    side = 2.2 + 0.34 * len(labels)
    figure = Figure(figsize=(2 * side, side), dpi=110, layout="constrained")
    for axis, kind in zip(figure.subplots(1, 2), ("per_sample", "per_decision"), strict=True):
        counts = np.array(row.metrics[kind]["confusion"], float)
        names = [*labels, "lost"] if counts[:, -1].any() else list(labels)
        total = counts.sum(axis=1, keepdims=True)
        share = np.where(total > 0, 100 * counts / np.maximum(total, 1), np.nan)[:, : len(names)]
        axis.imshow(share, vmin=0, vmax=100, cmap="Blues", aspect="auto")
        for i, j in np.argwhere(share >= 0.5):
            colour = "white" if share[i, j] > 60 else INK
            axis.text(j, i, f"{share[i, j]:.0f}", ha="center", va="center", fontsize=6, color=colour)
        axis.set_xticks(range(len(names)), names, rotation=90, fontsize=6)
        axis.set_yticks(range(len(labels)), labels, fontsize=6)
        axis.set_title(f"{row.diagnoser}, {kind.replace('_', ' ')}, %", fontsize=8, loc="left")
        axis.set_xlabel("declared", fontsize=7)
        axis.set_ylabel("true", fontsize=7)
    return figure
