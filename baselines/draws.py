"""Chance that is a flight's own: the same for it alone as in any batch, on any run and on any machine."""

from __future__ import annotations

import numpy as np

from fdi_gym.plant import Array

DROPPED = np.uint32(11)  # of a float32's 23 bits: rounding, which differs between processors, is far below what is left


def uniform(obs: Array, count: int, seed: int = 0) -> Array:
    """Numbers from 0 to 1 (n, count), from a hash of the newest samples (n, n_obs) at four digits."""
    bits = (np.ascontiguousarray(obs, np.float32).view(np.uint32) >> DROPPED).astype(np.uint64)
    with np.errstate(over="ignore"):  # splitmix64, a stream for each number
        odd = np.arange(1, 2 * bits.shape[1], 2, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        h = (bits * odd).sum(axis=1, dtype=np.uint64)[:, None]
        h = h + np.uint64(0x9E3779B97F4A7C15) * np.arange(seed * count + 1, (seed + 1) * count + 1, dtype=np.uint64)
        h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        h = h ^ (h >> np.uint64(31))
    return (h >> np.uint64(11)) / 2.0**53
