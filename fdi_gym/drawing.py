"""Random draws: the streams of an episode, its scenario, and single numbers as plants draw them.

`reset(seed)` is the only door. Each consumer has a stream of its own, so that a draw more in one leaves the others alone.
"""

from __future__ import annotations

import numpy as np


def uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """The bits of `float(rng.uniform(low, high))`, in a third of the time."""
    return low + (high - low) * rng.random()


def random_sign(rng: np.random.Generator) -> float:
    """The bits of `rng.choice([-1.0, 1.0])`, in a third of the time."""
    return 2.0 * int(rng.integers(2)) - 1.0
