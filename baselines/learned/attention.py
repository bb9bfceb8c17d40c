"""Causal attention over the last steps, step by step, without torch: the memory of `attention_net`.

Each layer attends from the newest step to itself and the WINDOW - 1 before it, in HEADS heads. How far a step lies back
counts by a slope of each head that is learned, in place of an encoding of positions (O. Press, N. A. Smith, M. Lewis, ICLR
2022), so nothing depends on when a flight began. The layers are those of A. Vaswani et al., NeurIPS 2017, normalised before
(R. Xiong et al., ICML 2020). `baselines.learned._attention` trains them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fdi_gym.plant import Array

LAYERS, HEADS, WINDOW, WIDER = 2, 4, 96, 2
EPSILON = 1e-5  # of the normalisation


class Recent(NamedTuple):
    """What n episodes remember: keys and values of the last steps, the newest last."""

    kept: Array  # (n, LAYERS, 2, WINDOW, hidden)
    steps: Array  # (n,) how many there have been


def begin(n: int, hidden: int) -> Recent:
    """Nothing yet."""
    return Recent(np.zeros((n, LAYERS, 2, WINDOW, hidden)), np.zeros(n, np.int64))


def tensor_shapes(hidden: int) -> dict[str, tuple[int, ...]]:
    """The shapes of the memory's tensors."""
    found: dict[str, tuple[int, ...]] = {}
    for i in range(LAYERS):
        found |= {f"slope.{i}": (HEADS,), f"join.{i}.weight": (hidden, hidden), f"join.{i}.bias": (hidden,)}
        for name, wide in (("ask", 3 * hidden), ("up", WIDER * hidden)):
            found |= {f"{name}.{i}.weight": (wide, hidden), f"{name}.{i}.bias": (wide,)}
        found |= {f"down.{i}.weight": (hidden, WIDER * hidden), f"down.{i}.bias": (hidden,)}
        for name in ("before", "between"):
            found |= {f"{name}.{i}.weight": (hidden,), f"{name}.{i}.bias": (hidden,)}
    return found


def step(net: Mapping[str, Array], x: Array, s: Recent) -> tuple[Array, Recent]:
    """What is remembered at a step x (n, hidden), and the memory after it; net has the tensors of `tensor_shapes`."""
    n, hidden = x.shape
    steps, kept, y = s.steps + 1, np.roll(s.kept, -1, axis=3), x
    back = np.arange(WINDOW)[::-1]
    there = back < steps[:, None]  # (n, WINDOW)

    def linear(name: str, a: Array) -> Array:
        return a @ net[f"{name}.weight"].T + net[f"{name}.bias"]

    def normal(name: str, a: Array) -> Array:
        centred = a - a.mean(axis=-1, keepdims=True)
        scaled = centred / np.sqrt((centred**2).mean(axis=-1, keepdims=True) + EPSILON)
        return scaled * net[f"{name}.weight"] + net[f"{name}.bias"]

    def heads(a: Array) -> Array:
        return a.reshape(*a.shape[:-1], HEADS, hidden // HEADS)

    for i in range(LAYERS):
        q, kept[:, i, 0, -1], kept[:, i, 1, -1] = np.split(linear(f"ask.{i}", normal(f"before.{i}", y)), 3, axis=1)
        fit = np.einsum("nhd,nwhd->nhw", heads(q), heads(kept[:, i, 0])) / np.sqrt(hidden // HEADS)
        fit = np.where(there[:, None], fit - np.exp(net[f"slope.{i}"])[:, None] * back, -np.inf)
        weight = np.exp(fit - fit.max(axis=2, keepdims=True))
        weight /= weight.sum(axis=2, keepdims=True)
        found = np.einsum("nhw,nwhd->nhd", weight, heads(kept[:, i, 1])).reshape(n, hidden)
        y = y + linear(f"join.{i}", found)
        wide = linear(f"up.{i}", normal(f"between.{i}", y))
        y = y + linear(f"down.{i}", wide * (0.5 + 0.5 * np.tanh(0.5 * wide)))
    return y - x, Recent(kept, steps)
