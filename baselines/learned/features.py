"""What a network sees: blocks of samples, and a model of the plant identified from training flights by least squares.

The samples come in blocks of `stride`. Block k is reduced to z_k: the mean of its scaled samples, and the newest one. The
model is identified on blocks; the network looks at every so many of them, since its steps are what training costs. A
regression over training flights, whose truth is known, gives a model of the mean outputs of a block

    y_k = W phi_k + sum_j delta_j V_j psi_k + noise of covariance R,

phi_k the past blocks, the commands held over this one and their products, delta the scaled deviation of the estimated
quantity from healthy and psi_k made of the outputs, the commands, what else is known, and products of them. A flight is
then shown as its blocks, its whitened residuals e = R^(-1/2) (y - W phi), and the regularised recursive least-squares
estimates of delta with several memories, from exponentially forgotten sums of S'e and S'S, S = R^(-1/2) [V_j psi]. All
of it is causal, and nothing of it knows the plant's equations: it is learned from the observations and labels of
training flights. `baselines.learned.streams` makes it of samples, one by one or of whole flights.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.plant import Array, Plant

MEMORIES = np.array([4.0, 16.0, 64.0, 256.0])  # blocks
RIDGE = 1e-7  # of the regression, as a share of the mean square of a regressor
FAR = 20.0  # blocks with a scaled signal beyond this (a flight that diverges) teach the regression nothing
KNEE = 4.0  # products are of signals that saturate smoothly here


class FeatureShape(NamedTuple):
    """What the model is made of: samples per block, past blocks in phi, and the degree of the products in phi and psi.

    Products are of the present signals and the outputs' magnitudes; a degree of 1 has none.
    """

    stride: int
    lags: int
    degree: int
    effects: int = 1
    every: int = 1  # blocks per step of the network
    shares: bool = False  # whether a step says which share of each output's reports came

    @property
    def period(self) -> int:
        """Samples per step of the network."""
        return self.stride * self.every

    @property
    def linear(self) -> bool:
        """Whether the model is: such a one runs on through a gap, one with products runs away."""
        return max(self.degree, self.effects) == 1

    def width(self, observed: int, outputs: int, estimated: int) -> int:
        """Features of a step, for so many channels, of which so many are outputs, and estimated entries."""
        return 2 * observed + outputs * (2 if self.shares else 1) + len(MEMORIES) * (3 * estimated + 1)


class FeatureModel(NamedTuple):
    """The identified model, and mean and standard deviation of the features over training flights. All float32."""

    W: Array  # (n_y, n_phi)
    V: Array  # (n_estimated, n_y, n_psi)
    whiten: Array  # (n_y, n_y): R^(-1/2)
    mean: Array  # (n_features,)
    std: Array  # (n_features,)


def deviation(plant: Plant, target: Array) -> Array:
    """The estimated quantity (..., n_estimated) as (value - healthy) / scale."""
    healthy = plant.healthy
    return (target - healthy) / np.array([s.scale for s in plant.estimated])


def blocks(plant: Plant, obs: Array, stride: int) -> Array:
    """Recorded observations (N, K + 1, n_obs) as (N, (K + 1) // stride, 2, n_obs): mean and newest of each block."""
    n, samples, width = obs.shape
    z = plant.scale(obs[:, : samples // stride * stride]).reshape(n, -1, stride, width)
    return np.stack([z.mean(axis=2), z[:, :, -1]], axis=2)


@functools.cache
def _products(width: int, degree: int) -> list[Array]:
    return [
        np.array(list(itertools.combinations_with_replacement(range(width), d))).reshape(-1, d) for d in range(2, degree + 1)
    ]


def regressors(plant: Plant, shape: FeatureShape, past: Array, now: Array) -> tuple[Array, Array]:
    """phi (..., n_phi), psi (..., n_psi) of a block (..., 2, n_obs) and those before, newest first (..., lags, 2, n_obs)."""
    n_y = len(plant.outputs)
    held = now[..., 0, n_y:]
    here = KNEE * np.tanh(np.concatenate([past[..., 0, 1, :n_y], held], axis=-1) / KNEE)
    wide = np.concatenate([here, np.abs(here[..., :n_y])], axis=-1)
    one = np.ones((*here.shape[:-1], 1))
    products = [wide[..., which].prod(axis=-1) for which in _products(wide.shape[-1], max(shape.degree, shape.effects))]
    phi = [one, past.reshape(*past.shape[:-3], -1), held, *products[: shape.degree - 1]]
    return np.concatenate(phi, axis=-1), np.concatenate([one, here, *products[: shape.effects - 1]], axis=-1)


def sequences(plant: Plant, shape: FeatureShape, z: Array) -> tuple[Array, Array]:
    """The regressors of the blocks lags, lags + 1, ... of whole flights z (N, T, 2, n_obs)."""
    p, T = shape.lags, z.shape[1]
    return regressors(plant, shape, np.stack([z[:, p - 1 - i : T - 1 - i] for i in range(p)], axis=2), z[:, p:])


def identify(plant: Plant, shape: FeatureShape, flights: Iterable[tuple[Array, Array]]) -> FeatureModel:
    """Fit the model to flights: pairs of blocks (N, T, 2, n_obs) and their deviations (N, T, n_estimated).

    The features' mean and standard deviation are left at 0 and 1: `streams.standardised` sets them.
    """
    n_y = len(plant.outputs)
    n_phi, n_psi, total = 0, 0, 0.0
    G: Any = 0.0
    for z, delta in flights:
        phi, psi = sequences(plant, shape, z)
        n_phi, n_psi = phi.shape[-1], psi.shape[-1]
        effects = (delta[:, shape.lags :, :, None] * psi[:, :, None]).reshape(*psi.shape[:2], -1)
        rows = np.concatenate([phi, effects, z[:, shape.lags :, 0, :n_y]], axis=-1)
        now = z[:, shape.lags :]
        weight = (np.abs(now).max(axis=(2, 3)) < FAR) / (1 + (now**2).mean(axis=(2, 3)))
        rows = (rows * np.sqrt(weight)[..., None]).reshape(-1, rows.shape[-1])
        G = G + rows.T @ rows
        total += weight.sum()
    G = G / total
    scale = np.sqrt(np.diag(G)[:-n_y]) + 1e-9
    A, B = G[:-n_y, :-n_y] / scale[:, None] / scale, G[:-n_y, -n_y:] / scale[:, None]
    C = np.linalg.solve(A + RIDGE * np.eye(len(A)), B) / scale[:, None]
    joint = np.concatenate([-C, np.eye(n_y)])
    power, directions = np.linalg.eigh(joint.T @ G @ joint)
    whiten = (directions / np.sqrt(np.maximum(power, 1e-12))) @ directions.T
    V = C[n_phi:].reshape(-1, n_psi, n_y).transpose(0, 2, 1)
    width = shape.width(len(plant.observed), n_y, len(V))
    arrays = (C[:n_phi].T, V, whiten, np.zeros(width), np.ones(width))
    return FeatureModel(*(np.ascontiguousarray(a, np.float32) for a in arrays))


def tensor_shapes(plant: Plant, shape: FeatureShape) -> dict[str, tuple[int, ...]]:
    """The shapes of a model's arrays as they lie in a weight file."""
    n, n_y, p = len(plant.observed), len(plant.outputs), len(plant.estimated)
    sizes = [len(which) for which in _products(n + n_y, max(shape.degree, shape.effects))]
    n_phi, n_psi = 1 + 2 * shape.lags * n + n - n_y + sum(sizes[: shape.degree - 1]), 1 + n + sum(sizes[: shape.effects - 1])
    width = shape.width(n, n_y, p)
    found = {"W": (n_y, n_phi), "V": (p, n_y, n_psi), "whiten": (n_y, n_y), "mean": (width,), "std": (width,)}
    return {f"model.{name}": value for name, value in found.items()}


def expected(model: FeatureModel, phi: Array) -> Array:
    """The mean outputs (..., n_y) of healthy flight."""
    return phi @ model.W.T.astype(float)


def information(
    model: FeatureModel, phi: Array, psi: Array, y: Array, trust: Array | None = None
) -> tuple[Array, Array, Array]:
    """Whitened residuals e (..., n_y), S'e (..., p) and S'S (..., p, p) of mean outputs y (..., n_y).

    Outputs are trusted (..., n_y) from 1 down to 0: such a one has no residual, and no fault shows in it.
    """
    r = y - expected(model, phi)
    e = r @ model.whiten.T.astype(float)
    S = psi @ np.einsum("ab,jbx->xaj", model.whiten, model.V).astype(float).reshape(psi.shape[-1], -1)
    S = S.reshape(*psi.shape[:-1], len(model.whiten), len(model.V))
    if trust is not None and (trust < 1).any():
        some = (trust < 1).any(axis=-1)  # of the others nothing changes, whichever they are in a batch with
        less = trust[some]
        e[some] = (r[some] * less) @ model.whiten.T.astype(float)
        S[some] = model.whiten @ (less[..., None] * np.einsum("jbx,...x->...bj", model.V, psi[some]))
    St = np.swapaxes(S, -1, -2)
    return e, (St @ e[..., None])[..., 0], St @ S


def estimates(g: Array, info: Array) -> Array:
    """What the sums of S'e (..., M, p) and S'S (..., M, p, p) say: estimates, their significance, spread and gain, flat."""
    P = np.linalg.inv(info + np.eye(g.shape[-1]))
    delta = (P @ g[..., None])[..., 0]
    std = np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))
    gain = (g * delta).sum(axis=-1, keepdims=True)
    found = np.concatenate([np.arcsinh(2 * delta), np.arcsinh(delta / std), np.log(std), np.arcsinh(gain)], axis=-1)
    return found.reshape(*found.shape[:-2], -1)


def assembled(
    shape: FeatureShape, model: FeatureModel, mean: Array, newest: Array, e: Array, g: Array, info: Array, shares: Array
) -> Array:  # fmt: skip
    """The features of steps, from the means and newest samples, the sums of residuals, the forgotten sums, and shares."""
    seen = [np.arcsinh(mean), np.arcsinh(newest), np.arcsinh(e / np.sqrt(shape.every)), estimates(g, info)]
    seen += [shares] if shape.shares else []
    return (np.concatenate(seen, axis=-1) - model.mean) / model.std
