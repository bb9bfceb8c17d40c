"""Random draws: the streams of an episode, and single numbers as plants draw them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

WORD = 0xFFFFFFFF


class Streams(NamedTuple):
    """The random streams of one episode. They don't share draws: adding one to a stream leaves the others alone."""

    initial: np.random.SeedSequence
    scenario: np.random.SeedSequence
    noise: np.random.SeedSequence
    physical: np.random.SeedSequence


def streams(seed: int) -> Streams:
    """The random streams that belong to an episode's seed."""
    return Streams(*(stream(seed, name) for name in Streams._fields))


def stream(seed: int, name: str) -> np.random.SeedSequence:
    """One of them: what `SeedSequence(seed).spawn(4)` gives in its place."""
    place = Streams._fields.index(name)
    if seed >> 64:
        return np.random.SeedSequence(seed, spawn_key=(place,))
    # the words that NumPy makes of seed and spawn key, four of them the seed's: half the time of having it make them
    return np.random.SeedSequence(np.array((seed & WORD, seed >> 32, 0, 0, place), np.uint32))  # type: ignore[arg-type]


def uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """The bits of `float(rng.uniform(low, high))`, in a third of the time."""
    return low + (high - low) * rng.random()


def random_sign(rng: np.random.Generator) -> float:
    """The bits of `rng.choice([-1.0, 1.0])`, in a third of the time."""
    return 2.0 * int(rng.integers(2)) - 1.0
