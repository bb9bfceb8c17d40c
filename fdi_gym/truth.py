"""What a scenario makes of a plant: the true label, what is asked of it, what the world does to it, and theta."""

from __future__ import annotations

import functools
import itertools
import reprlib
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from fdi_gym.data_sheet import FaultMode, Label
from fdi_gym.faults import FaultProcess, FaultScenario, draw
from fdi_gym.model import Array, Model, contiguous
from fdi_gym.theta import ThetaTable, theta_table


class Inputs(NamedTuple):
    """What a scenario's dicts make: rows (steps + 1, n_r) and (steps + 1, n_d), parameters (n_p,).

    Rows that are the same at every sample are one row, (1, n).
    """

    reference: Array
    disturbance: Array
    physical: Array


class Truth(Model):
    """What a plant's declaration makes of a scenario that the plant has accepted."""

    id: str
    labels: tuple[Label, ...]
    modes: tuple[FaultMode, ...]
    simultaneous: bool
    processes: Mapping[str, FaultProcess]
    reference: Callable[[FaultScenario], Array]
    disturbance: Callable[[FaultScenario], Array] | None

    @functools.cached_property
    def _label_index(self) -> dict[frozenset[str], int]:
        return {frozenset(label.modes): index for index, label in enumerate(self.labels)}

    def label_of(self, modes: frozenset[str]) -> int:
        """Index of the label whose modes these are.

        Raises:
            ValueError: No label says so; the message lists those that exist.
        """
        index = self._label_index.get(modes)
        if index is None and self.simultaneous:
            return len(self.labels) + sum(1 << i for i, mode in enumerate(self.modes) if mode.name in modes)
        if index is None:
            names = ", ".join(label.name for label in self.labels)
            raise ValueError(f"{self.id} has no label for {sorted(modes)} at once; it has {names}")
        return index

    def modes_of(self, label: Array) -> Array:
        """The set of modes (..., modes) that labels (...) say, or the numbers of sets without one."""
        label, bits = np.asarray(label), np.arange(len(self.modes))
        said = np.array([[mode.name in of.modes for mode in self.modes] for of in self.labels])
        beyond = (np.maximum(label - len(self.labels), 0)[..., None] >> bits) & 1
        return np.where((label < len(self.labels))[..., None], said[np.minimum(label, len(self.labels) - 1)], beyond > 0)

    def label_intervals(self, scenario: FaultScenario) -> Iterator[tuple[int, int, frozenset[str]]]:
        """The flight's intervals (first step, end step, active modes) between the changes of the set of active modes."""
        steps = scenario.steps
        windows = [(f.onset, steps if f.end is None else min(f.end, steps), f.mode) for f in scenario.faults]
        edges = {0, steps}
        for onset, end, _ in windows:
            edges |= {min(onset, steps), end}
        for start, stop in itertools.pairwise(sorted(edges)):
            yield start, stop, frozenset([mode for onset, end, mode in windows if onset <= start < end])

    def label_rows(self, scenario: FaultScenario) -> Array:
        """The true label at the samples 0..K: sample k has that of the fault which acted over [k - 1, k)."""
        rows = np.zeros(scenario.steps + 1, dtype=np.int64)
        for first, label in self.label_changes(scenario):
            rows[first:] = label
        return rows

    def label_changes(self, scenario: FaultScenario) -> list[tuple[int, int]]:
        """The true label as (first sample, label), in order: sample k has that of the fault which acted over [k - 1, k)."""
        changes = [(0, 0)]
        for start, _, active in self.label_intervals(scenario):
            label = self.label_of(active)
            if label != changes[-1][1]:
                changes.append((start + 1, label))
        return changes

    def inputs(self, scenario: FaultScenario) -> Inputs:
        """What the scenario's dicts make for the kernels, in the shapes that they take.

        Raises:
            ValueError: The plant's function refuses the dict, or returns something else than finite rows of that shape.
        """
        rows = scenario.steps + 1
        if self.disturbance is None:
            d = np.zeros((1, len(self.disturbances)))
        else:
            d = self._made("disturbance", self.disturbance, scenario, (rows, len(self.disturbances)))
        p = self.nominal_p
        if scenario.physical:
            p = self._made("physical", lambda s: self.physical(s.physical), scenario, p.shape)
        return Inputs(self._made("reference", self.reference, scenario, (rows, self.reference_width)), d, p)

    @functools.cached_property
    def reference_width(self) -> int:
        """Columns of the reference rows, as of a standard flight; a scenario that makes others is refused."""
        scenario = draw(self.processes["standard"], 0)
        return self._made("reference", self.reference, scenario, (scenario.steps + 1, None)).shape[1]

    def _made(self, name: str, make: Callable[[FaultScenario], Array], scenario: FaultScenario, shape: tuple) -> Array:
        try:
            made = np.asarray(make(scenario), float)
        except Exception as error:  # whatever the plant's author did not think of
            what = f"{type(error).__name__}: {error}"
            raise ValueError(f"{name} of a {self.id} scenario, {reprlib.repr(getattr(scenario, name))}: {what}") from error
        fits = made.shape == shape or (shape[-1] is None and made.shape[:-1] == shape[:-1])
        given = contiguous(made[:1] if fits and made.ndim == 2 and made.strides[0] == 0 else made)  # one row, broadcast
        if not fits or not np.isfinite(given).all():
            raise ValueError(
                f"{name} of a {self.id} scenario: the plant makes finite numbers in the shape {shape} of it, not those of "
                f"{reprlib.repr(getattr(scenario, name))} ({made.shape}{', not all finite' if fits else ''})"
            )
        return given

    def theta_table(self, scenario: FaultScenario) -> ThetaTable:
        """What the scenario makes of theta (see `fdi_gym.theta.theta_table`)."""
        entries, commands = ([s.name for s in signals] for signals in (self.theta, self.commands))
        return theta_table(scenario, self.nominal_theta, entries, commands, self.dt)
