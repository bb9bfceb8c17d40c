"""What a plant declares for a diagnosis that acts: probes, what a flight costs, how its controller is reconfigured."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from fdi_gym.model import Array


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


def square(period: int, amplitudes: Iterable[float], rest: int = 0) -> Array:
    """Rows (T, n) of a probe: so much up for half a period [samples], as much down for the other half, then rest."""
    amplitudes = np.array(list(amplitudes), float)
    up, half = np.tile(amplitudes, (period // 2, 1)), np.zeros((rest, amplitudes.size))
    return np.concatenate([up, -up, half])
