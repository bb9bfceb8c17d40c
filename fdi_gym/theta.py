"""theta over a flight as a table, for those who look back at one: what the compiled loop works out sample by sample."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_gym.faults import Abrupt, FaultScenario, Hold, Incipient, Intermittent, Ramp, Samples, Square


class ThetaTable(NamedTuple):
    """theta over a flight, entry by entry: on step k, tau seconds after sample k, it is a + b exp(-g tau).

    Where g < 0 it is a + b tau. Holds own their entries.

    a, b, g: (K + 1, n_theta). holds: (n_holds, 5) int64, rows (entry, first step, end step, command index, lag).
    """

    a: np.ndarray
    b: np.ndarray
    g: np.ndarray
    holds: np.ndarray


def theta_table(
    scenario: FaultScenario, nominal: np.ndarray, entries: Sequence[str], commands: Sequence[str], dt: float
) -> ThetaTable:
    """What the faults of a scenario that its plant has validated make of theta, step by step."""
    steps = scenario.steps
    a = np.tile(np.asarray(nominal, float), (steps + 1, 1))
    b, g = np.zeros_like(a), np.zeros_like(a)
    holds: list[tuple[int, int, int, int, int]] = []
    for fault in scenario.faults:
        end = steps + 1 if fault.end is None else min(fault.end, steps + 1)
        if end <= fault.onset:
            continue  # an empty window, or one after the flight
        window = slice(fault.onset, end)
        since = np.arange(window.start, window.stop) - fault.onset
        for effect in fault.effects:
            j = entries.index(effect.entry)
            match effect:
                case Abrupt(value=value):
                    a[window, j] = value
                case Incipient(value=value, rate=rate):
                    a[window, j] = value
                    b[window, j] = (nominal[j] - value) * np.exp(-rate * since * dt)
                    g[window, j] = rate
                case Ramp(value=value, duration=duration):
                    share, then = (np.minimum(s * dt / duration, 1.0) for s in (since, since + 1))
                    a[window, j] = nominal[j] + (value - nominal[j]) * share
                    b[window, j] = (value - nominal[j]) * (then - share) / dt
                    g[window, j] = np.where(then > share, -1.0, 0.0)
                case Intermittent(value=value, period=period, duty=duty):
                    on = (since * dt / period + 1e-9) % 1.0 < duty
                    a[window, j] = np.where(on, value, nominal[j])
                case Square(value=value, other=other, period=period):
                    half = np.floor(since * dt / (period / 2) + 1e-9)
                    a[window, j] = np.where(half % 2 == 0, value, other)
                case Hold(command=command, lag=lag):
                    holds.append((j, fault.onset, end, commands.index(command), lag))
                case Samples(values=values):
                    a[window, j] = np.asarray(values)[np.minimum(since, len(values) - 1)]
    return ThetaTable(a, b, g, np.array(holds, dtype=np.int64).reshape(-1, 5))
