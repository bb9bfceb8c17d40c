"""The engine: many flights in lock-step, advanced by as many samples as are asked for.

    flights = Flights(plant, scenarios)
    chunk = advance(flights, 256)  # samples 0 to 255 of every flight
    chunk = advance(flights, 256)  # the next ones

A flight is a function of its plant, its scenario and nothing else: chunks, batches, threads, copies and pickling give the
same bytes. `simulate` is `advance` to the end; the environments fly chunks ahead of the agent, since a diagnosis does not
feed back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numba
import numpy as np

from fdi_gym import closed_loop, effects
from fdi_gym.faults import FaultScenario
from fdi_gym.flights import Chunk, Flights
from fdi_gym.model import contiguous
from fdi_gym.plant import Plant

Array = np.ndarray

WORTH_A_THREAD = 4096  # samples; fewer are flown sooner than a thread is started


class Record(NamedTuple):
    """N flights of up to K steps, sample by sample. Row k of the truth belongs to the interval that ends at sample k.

    After a flight's end (`length`) its last row is repeated.
    """

    obs: Array  # (N, K + 1, n_obs) what a diagnoser may see: y_k, u_{k-1}, known_k
    state: Array  # (N, K + 1, n_x)
    theta: Array  # (N, K + 1, n_theta) fault parameter that acted over [k - 1, k)
    target: Array  # (N, K + 1, n_estimated) what the identification task asks for
    label: Array  # (N, K + 1) int64
    length: Array  # (N,) int64, number of steps flown
    terminated: Array  # (N,) bool, ended before its scenario's last step


class Added(NamedTuple):
    """What an agent adds to N flights in m samples, as `advance` takes it."""

    inputs: Array | None = None  # (m, N, n_u)
    references: Array | None = None  # (m, N, n_r)


def white_noise(plant: Plant, rng: np.random.Generator, steps: int) -> tuple[Array, Array]:
    """Process noise w (steps, n_x) and sensor noise v (steps + 1, n_y) from a generator, to be injected."""
    v = rng.standard_normal((steps + 1, len(plant.outputs)))
    w = rng.standard_normal((steps, len(plant.states)))
    v *= [s.sigma for s in plant.outputs]
    w *= [s.sigma for s in plant.states]
    return w, v


def no_noise(plant: Plant, steps: int) -> tuple[Array, Array]:
    """The noise of a deterministic check: none, in the shapes of `white_noise`."""
    return np.zeros((steps, len(plant.states))), np.zeros((steps + 1, len(plant.outputs)))


def advance(
    flights: Flights,
    samples: int,
    into: Chunk | None = None,
    first: int = 0,
    slots: Array | None = None,
    inputs: Array | None = None,
    references: Array | None = None,
    sensors: Array | None = None,
    threads: int | None = None,
    meanwhile: Callable[[], bool] | None = None,
) -> Chunk:
    """Fly on by so many samples, or to a flight's end; without the GIL, blocks of flights in threads.

    Args:
        flights: The flights; their state is moved on.
        samples: How many.
        into: Where the samples are written, from row `first` on. Default: a new chunk.
        first: That row.
        slots: (n,) int64, the flights that are flown. Default: all.
        inputs: (samples, N, n_u) added to the command, within its range. Default: none.
        references: (samples, N, n_r) added to the reference rows, for all who read them. Default: none.
        sensors: (samples, N, n_y, 6) what is wrong with each sensor: relative error of its gain, bias, relative increase
            of its noise, 1 where it is frozen at its last reading, samples by which it lags, 1 where it does not report (it
            reads NaN, and the controller goes on with the last reading). Default: nothing, as is a table of zeros.
        threads: How many at most. Default: as many as numba may use (`NUMBA_NUM_THREADS`).
        meanwhile: Called again and again while threads fly, until it says that there is nothing more to do.

    Raises:
        ValueError: Arrays of another shape, or a lag beyond what the flights remember.
    """
    plant, n = flights.plant, len(flights)
    n_y, n_u = len(plant.outputs), len(plant.commands)
    chunk = flights.blank(first + samples) if into is None else into
    slots = np.arange(n) if slots is None else slots
    inputs = _optional("inputs", inputs, (samples, n, n_u))
    references = _optional("references", references, (samples, n, plant.reference_width))
    sensors = _optional("sensors", sensors, (samples, n, n_y, effects.FAULTS))
    lags = sensors[..., effects.LAG]
    if lags.size and (lags.min() < 0 or lags.max() > max(flights.history.shape[1] - 1, 0)):
        raise ValueError(
            f"a sensor lags by 0 to {max(flights.history.shape[1] - 1, 0)} samples (longest_lag of the flights)"
        )
    arguments = (
        *plant.addresses, plant.dt, plant.substeps, int(plant.true_feedback), plant.nominal_theta,
        *flights.signals, *flights.arrays(),
    )  # fmt: skip

    def fly(block: Array) -> None:
        closed_loop.fly(*arguments, block, first, samples, inputs, references, sensors, *chunk)

    most = numba.config.NUMBA_NUM_THREADS if threads is None else threads  # type: ignore[attr-defined]
    parts = max(1, min(most, len(slots), len(slots) * samples // WORTH_A_THREAD))
    if parts > 1:
        with ThreadPoolExecutor(parts) as pool:
            under_way = [pool.submit(fly, block) for block in np.array_split(slots, parts)]
            while meanwhile is not None and not all(part.done() for part in under_way) and meanwhile():
                pass
            for part in under_way:
                part.result()
    else:
        fly(slots)
    return chunk


def _optional(name: str, table: Array | None, shape: tuple[int, ...]) -> Array:
    if table is None:
        return np.zeros((0, *shape[1:]))
    table = contiguous(table)
    if table.shape != shape or not np.isfinite(table).all():
        raise ValueError(f"{name} is finite and has the shape {shape}, not {table.shape}")
    return table


def simulate(
    plant: Plant,
    scenarios: Sequence[FaultScenario],
    noise: Sequence[tuple[Array, Array]] | None = None,
    threads: int | None = None,
) -> Record:
    """Fly the scenarios to their ends.

    Args:
        plant: The plant; its physical parameters come from each scenario.
        scenarios: One per flight; they may differ in length, the record is as long as the longest.
        noise: (w (K, n_x), v (K + 1, n_y)) per flight. Default: by counter, from each scenario's noise seed.
        threads: As in `advance`.

    Raises:
        ValueError: No scenario, or one that the plant refuses, or noise of another shape.
    """
    if not scenarios:
        raise ValueError("at least one scenario is needed")
    flights = Flights(plant, scenarios, noise)
    chunk = advance(flights, int(flights.length.max()) + 1, threads=threads)
    hold_last(flights, chunk)
    return recorded(flights, chunk)


def hold_last(flights: Flights, chunk: Chunk, first: int = 0) -> None:
    """From row `first` of a chunk on that begins at sample 0: a flight's last sample stands in the rows after its end."""
    for i in np.flatnonzero(flights.length < len(chunk.label) - 1):
        end = flights.length[i]
        for array in chunk:
            array[max(end + 1, first) :, i] = array[end, i]


def recorded(flights: Flights, chunk: Chunk) -> Record:
    """The record of a chunk that begins at sample 0."""
    obs, state, theta, label = (a.swapaxes(0, 1) for a in chunk)
    target = flights.plant.estimate_target(theta, flights.plant.split(obs)[1])
    return Record(obs, state, theta, target, label, flights.length.copy(), flights.terminated)
