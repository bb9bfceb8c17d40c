"""What may be wrong with a recording, in words: a unit that the data sheet does not fit, a command of the next interval.

Nothing is changed here. A doubt says what speaks for it, and what to write into the mapping.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.plant import Array, Plant
from fdi_gym.recordings.alignment import held_too_early
from fdi_gym.recordings.columns import channel_columns
from fdi_gym.recordings.mapping import units_beside

OUTSIDE = 0.01  # share of samples outside of the range from which on a unit is doubted
QUIET = 8.0  # a sensor's noise that is so many times less than declared is doubted
ENOUGH = 60  # samples, for what is judged by statistics


def doubts(plant: Plant, obs: Array, commands: str = "u_k-1") -> list[str]:
    """What may be wrong with observations (K + 1, n_obs) of a plant, one sentence each.

    Args:
        plant: The plant.
        obs: The observations.
        commands: As in the mapping; where it says that they were moved already, they are not doubted.
    """
    found = of_units(plant, obs)
    if not found and commands == "u_k-1":  # in another unit, the equations would say anything of the commands
        found += of_commands(plant, obs)
    return found


def of_units(plant: Plant, obs: Array) -> list[str]:
    """Channels whose values lie outside the range of the data sheet, or whose noise is far from what it declares."""
    found = []
    for name, signal, values in zip(channel_columns(plant), plant.observed, obs.T, strict=True):
        values = values[np.isfinite(values)]
        if not values.size:
            continue
        others = units_beside(signal.unit)
        slack = 1e-6 * max(abs(signal.low), abs(signal.high), 1e-12) if np.isfinite([signal.low, signal.high]).all() else 0.0
        outside = float(((values < signal.low - slack) | (values > signal.high + slack)).mean())
        if outside > OUTSIDE:
            fits = [u for u, f in others.items() if f < 1 and _within(f * values, signal.low, signal.high)]
            found.append(
                f"{name} is outside its range [{signal.low:g}, {signal.high:g}] {signal.unit} in {100 * outside:.0f} % of "
                f"the samples (from {values.min():.4g} to {values.max():.4g}){_guess(name, fits)}"
            )
        elif signal.sigma > 0 and values.size >= ENOUGH:
            noise = _noise(values)
            if 0 < noise * QUIET < signal.sigma:
                ratio = signal.sigma / noise
                fits = [u for u, f in others.items() if f > 1 and 0.4 < ratio / f < 2.5]
                found.append(
                    f"{name} is {ratio:.0f} times quieter than its sensor's noise of {signal.sigma:.3g} {signal.unit}"
                    f"{_guess(name, fits) or ': filtered, or in another unit?'}"
                )
    return found


def _within(values: Array, low: float, high: float) -> bool:
    return float(((values >= low) & (values <= high)).mean()) > 1 - OUTSIDE


def _guess(name: str, units: list[str]) -> str:
    return f': in {" or ".join(units)}? "{name}": {{"column": ..., "unit": "{units[0]}"}}' if units else ""


def _noise(values: Array) -> float:
    """Standard deviation of white noise on a smooth signal, from third differences; robust."""
    differences = np.diff(values, 3)
    return float(np.median(np.abs(differences)) / 0.6745 / 20**0.5)


def of_commands(plant: Plant, obs: Array) -> list[str]:
    """Whether the rows hold u_k, which acts only after them, instead of u_{k-1}."""
    why = held_too_early(plant, obs)
    names = ", ".join(channel_columns(plant)[len(plant.outputs) : len(plant.outputs) + len(plant.commands)])
    return (
        [
            f"{names}: looks like u_k, not the command of the interval that has just ended, since {why}; "
            '"commands": "u_k" moves it'
        ]
        if why
        else []
    )
