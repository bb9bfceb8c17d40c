"""Flights that are acted on: probes under way, controllers that have been reconfigured, and what each sample costs."""

from __future__ import annotations

import functools

import numpy as np

from fdi_gym.acting import Acting
from fdi_gym.engine import Added, advance
from fdi_gym.faults import draw
from fdi_gym.flights import Chunk, Flights
from fdi_gym.plant import Array, Plant

PRICED = range(2_000_000, 2_000_004)  # seeds of the healthy flights on which probes are priced


def acting_of(plant: Plant, probing: bool = False, accommodation: bool = False) -> Acting:
    """What a plant declares about being acted on.

    Raises:
        ValueError: It declares nothing, no probe where there shall be probing, or no accommodation.
    """
    acting = plant.acting
    if acting is None:
        raise ValueError(f"{plant.id} declares nothing that a diagnosis could act on")
    if probing and len(acting.probes) < 2:
        raise ValueError(f"{plant.id} declares no probes")
    if accommodation and acting.accommodate is None:
        raise ValueError(f"{plant.id} declares no accommodation: its controller cannot be reconfigured")
    return acting


def accommodated(plant: Plant, label: Array, estimate: Array | None = None) -> Array:
    """The estimated quantity (n, n_estimated) that a controller allows for: the estimate along the lines of the label's
    modes.

    Without an estimate it is the middle of each mode's reach. Nothing is allowed for where the label is "none", a sensor's
    or unknown, or where the estimate is not finite.

    Args:
        plant: The plant.
        label: (n,) labels.
        estimate: (n, n_estimated) of the plant that they are labels of, whose sensors may fail.
    """
    own = plant if plant.bare is None else plant.bare
    label = np.where(label < len(own.labels), label, 0)
    healthy = np.tile(own.healthy, (len(label), 1))
    usable, deviation = np.ones(len(label), bool), np.zeros_like(healthy)
    if estimate is not None:
        deviation = estimate[:, : healthy.shape[1]] - healthy
        usable = np.asarray(np.isfinite(deviation).all(axis=1))
    sizes = own.magnitudes(label, np.where(usable[:, None], deviation, 0.0))
    for mode, which in zip(own.modes, own.magnitudes_of, strict=True):
        size, (low, high) = sizes[:, which], mode.reaches.T
        has = usable & np.isfinite(size).all(axis=1)
        size = np.tile((low + high) / 2, (len(label), 1)) if estimate is None else np.clip(size, low, high)
        healthy[has] += np.array(mode.offset) + (size[has, :, None] * mode.directions).sum(axis=1)
    return healthy


class Acts:
    """What acts on N flights: a probe each, and how far it has come; the parameters of their controllers.

    Args:
        flights: The flights; their `q` is written to.
        probing, accommodation: What may be asked for.
    """

    def __init__(self, flights: Flights, probing: bool = True, accommodation: bool = True):
        acting_of(flights.plant, probing, accommodation)
        self.flights = flights
        self.probe, self.phase = np.zeros(len(flights), np.int64), np.zeros(len(flights), np.int64)
        q = np.asarray(flights.plant.q, float)
        self._q = np.tile(q, (len(flights), 1))
        self._added = np.array([np.zeros_like(q) if p.parameters is None else p.parameters for p in self.acting.probes])

    @property
    def acting(self) -> Acting:
        """What the plant declares."""
        return acting_of(self.flights.plant)

    def begin(self, slots: Array) -> None:
        """New flights are in these slots: no probe, the plant's own controller."""
        self.probe[slots], self.phase[slots], self._q[slots] = 0, 0, self.flights.plant.q
        self.flights.q[slots] = self.flights.plant.q

    def choose(self, probe: Array) -> None:
        """The probes (N,) that act from the next sample on; one that goes on is not begun anew."""
        self.phase[probe != self.probe] = 0
        self.probe[:] = probe
        self.flights.q[:] = self._q + self._added[self.probe]

    def accommodate(self, estimate: Array) -> None:
        """Reconfigure the controllers for these estimated quantities (N, n_estimated) of the plant's own faults."""
        assert self.acting.accommodate is not None
        self._q[:] = self.acting.accommodate(estimate)
        self.flights.q[:] = self._q + self._added[self.probe]

    def tables(self, samples: int) -> Added:
        """What the probes add in so many samples, as `advance` takes it; they have come so much further then."""
        found: dict[str, Array | None] = {"inputs": None, "references": None}
        for number, probe in enumerate(self.acting.probes):
            slots = np.flatnonzero(self.probe == number)
            for name, rows in (("inputs", probe.command), ("references", probe.reference)):
                if rows is None or not slots.size:
                    continue
                table = found[name]
                if table is None:
                    table = found[name] = np.zeros((samples, len(self.flights), rows.shape[1]))
                table[:, slots] = rows[(self.phase[slots] + np.arange(samples)[:, None]) % len(rows)]
        self.phase += samples
        return Added(**found)

    def advance(self, samples: int, into: Chunk | None = None, first: int = 0) -> Chunk:
        """Fly all flights on by so many samples, with what acts on them; arguments as in `fdi_gym.engine.advance`."""
        added = self.tables(samples)
        return advance(self.flights, samples, into, first, inputs=added.inputs, references=added.references)


def costs(flights: Flights, chunk: Chunk, k: Array) -> Array:
    """What the samples (m, N) of a chunk cost, which begins at the samples k (N,); 0 after the end of a flight."""
    plant, m = flights.plant, len(chunk.label)
    rows = np.empty((len(flights), m, plant.reference_width))
    for mine, (reference, *_), first in zip(rows, flights.tables, k.tolist(), strict=True):
        if len(reference) == 1 or first + m <= len(reference):
            mine[:] = reference if len(reference) == 1 else reference[first : first + m]
        else:
            mine[:] = reference[np.minimum(np.arange(first, first + m), len(reference) - 1)]
    cost = acting_of(plant).cost(chunk.state, plant.split(chunk.obs)[1], rows.swapaxes(0, 1))
    return np.where(k + np.arange(m)[:, None] <= flights.length, cost, 0.0)


def spent(flights: Flights, chunk: Chunk, k: Array) -> Array:
    """What a chunk has cost each flight (N,), added up sample by sample: the same bits for one flight as for many."""
    total = np.zeros(len(flights))
    for row in costs(flights, chunk, k):
        total += row
    return total


@functools.lru_cache(maxsize=32)
def probe_prices(plant: Plant) -> tuple[float, ...]:
    """What each probe costs a healthy flight, per sample: the mean flight cost with it throughout, less that without.

    Flights of the process "fault-free", with the same noise. On a linear plant with a quadratic cost that is what it costs
    any flight on average, since what is linear in the probe averages out.
    """
    acting, process = acting_of(plant), plant.process("fault-free")
    scenarios = [draw(process, seed) for seed in PRICED]
    means = []
    for number in range(len(acting.probes)):
        flights = Flights(plant, scenarios)
        acts, steps = Acts(flights, accommodation=False), int(flights.length.max())
        advance(flights, 1)
        acts.choose(np.full(len(flights), number))
        total = costs(flights, acts.advance(steps), np.ones(len(flights), np.int64)).sum(axis=0)
        lost = acting.lost * (np.array([s.steps for s in scenarios]) - flights.length)
        means.append(float(((total + lost) / [s.steps for s in scenarios]).mean()))
    return tuple(max(mean - means[0], 0.0) for mean in means)
