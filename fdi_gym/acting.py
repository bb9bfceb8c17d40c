"""What a plant declares for a diagnosis that acts: probes, what a flight costs, how its controller is reconfigured."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fdi_gym.model import Array

if TYPE_CHECKING:
    from fdi_gym.plant import Plant


class Probe(NamedTuple):
    """A known input that is added to find a fault sooner. What it is made of begins anew when it has reached its end.

    Args:
        name: How it is called.
        description: What it moves, and by how much.
        command: (T, n_u) added to the command at the samples after it was chosen; the sum stays within the range.
        reference: (T, n_r) added to the reference rows.
        parameters: (n_q,) added to the controller's parameters while it acts, for what depends on the state.
    """

    name: str
    description: str
    command: Array | None = None
    reference: Array | None = None
    parameters: Array | None = None


NO_PROBE = Probe("none", "nothing is added")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Acting:
    """How a plant can be acted on.

    Args:
        flight_cost: What a sample of the flight costs, tracking error and effort: flight_cost(x, u, r) -> (...) of the state
            (..., n_x), the command held up to it (..., n_u) and the reference row (..., n_r); from 0 on, about 1 where the
            flight is poor.
        lost: The most that a sample may cost, and what each sample costs after the envelope has been left.
        probes: What can be added; "none" is put before them.
        accommodate: The controller's parameters (n, n_q) for an estimated quantity (n, n_estimated); for that of the healthy
            plant they are the plant's `q`. None where its controller cannot be reconfigured.
    """

    flight_cost: Callable[[Array, Array, Array], Array]
    lost: float
    probes: tuple[Probe, ...] = ()
    accommodate: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        if not self.probes or self.probes[0] is not NO_PROBE:
            object.__setattr__(self, "probes", (NO_PROBE, *self.probes))

    def cost(self, x: Array, u: Array, r: Array) -> Array:
        """What samples (...) cost: the flight cost, `lost` at most."""
        return np.minimum(self.flight_cost(x, u, r), self.lost)


def wrong_acting(plant: Plant, acting: Acting) -> Iterable[str]:
    """What contradicts the rest of the plant's declaration."""
    if not callable(acting.flight_cost):
        yield f"flight_cost is a function of x, u and r, not {acting.flight_cost!r}"
    if isinstance(acting.lost, bool) or not isinstance(acting.lost, (int, float)) or not 0 < acting.lost < np.inf:
        yield f"lost is a positive number, not {acting.lost!r}"
    names = [probe.name for probe in acting.probes]
    for name in names:
        if names.count(name) > 1:
            yield f"two probes are called {name!r}"
    for probe in acting.probes[1:]:
        yield from _wrong_probe(plant, probe)
    if acting.accommodate is not None:
        q, n = np.asarray(plant.q, float), len(plant.estimated)
        try:
            found = np.asarray(acting.accommodate(np.tile(plant.healthy, (2, 1))), float)
        except Exception as error:  # whatever the plant's author did not think of
            yield f"accommodate fails for the healthy plant's estimate (2, {n}): {type(error).__name__}: {error}"
            return
        if found.shape != (2, q.size) or not (found == q).all():
            yield f"accommodate gives the plant's parameters q (2, {q.size}) for the healthy plant, not {found!r}"


def _wrong_probe(plant: Plant, probe: Probe) -> Iterable[str]:
    n_u, q = len(plant.commands), np.asarray(plant.q, float)
    if probe.command is None and probe.reference is None and probe.parameters is None:
        yield f"the probe {probe.name!r} adds something to the command, the reference or the controller's parameters"
    for name, width in (("command", n_u), ("reference", None)):
        rows = getattr(probe, name)
        if rows is None:
            continue
        rows = np.asarray(rows)
        good = rows.ndim == 2 and len(rows) and rows.dtype.kind in "iuf" and np.isfinite(rows).all()
        if not good or (width is not None and rows.shape[1] != width):
            yield f"the probe {probe.name!r} has finite rows (T, {width or 'n_r'}) as its {name}, not the shape {rows.shape}"
        elif name == "command":
            for signal, column in zip(plant.commands, rows.T, strict=True):
                low, high = signal.nominal + column.min(), signal.nominal + column.max()
                if not signal.low <= low <= high <= signal.high:
                    yield (
                        f"the probe {probe.name!r} would bring {signal.name} from {low:g} to {high:g} {signal.unit}, beyond "
                        f"the actuator's limits [{signal.low:g}, {signal.high:g}]"
                    )
    if probe.parameters is not None:
        given = np.asarray(probe.parameters)
        if given.shape != q.shape or given.dtype.kind not in "iuf" or not np.isfinite(given).all():
            yield f"the probe {probe.name!r} has finite parameters ({q.size},), not {probe.parameters!r}"


def square(period: int, amplitudes: Iterable[float], rest: int = 0) -> Array:
    """Rows (T, n) of a probe: so much up for half a period [samples], as much down for the other half, then rest."""
    amplitudes = np.array(list(amplitudes), float)
    up, half = np.tile(amplitudes, (period // 2, 1)), np.zeros((rest, amplitudes.size))
    return np.concatenate([up, -up, half])
