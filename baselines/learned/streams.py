"""The features of `baselines.learned.features`, of a stream of samples one by one, and of whole flights in one go.

Sensors may be silent. An output that did not report in a part of a block has the mean and the newest of its reports, moved
along the slope that the model expects to where they stand for; one that did not report at all has what the model expects,
without effect on the estimates; a command is what it was. Where the model has products it would run away: it expects what
was reported last, and residuals of a block that is not whole, or that follows one within the model's past, count the less
the larger they are. Where the shape says so, a step tells which share of each output's reports came.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from baselines.learned.features import (
    MEMORIES,
    FeatureModel,
    FeatureShape,
    assembled,
    blocks,
    expected,
    information,
    regressors,
    sequences,
)
from fdi_gym.plant import Array, Plant

BOUND = 2.0  # residuals after a gap beyond so many standard deviations count less


class Stream(NamedTuple):
    """The state of a stream of samples for n episodes; `add` takes one sample each."""

    count: Array  # (n, n_obs) reports in the block that is being filled,
    total: Array  # (n, n_obs) their sum,
    when: Array  # (n, n_obs) that of their places in the block, 1 to stride,
    last: Array  # (n, n_obs) and the last of these places
    newest: Array  # (n, n_obs) the last report of each channel
    past: Array  # (n, lags, 2, n_obs), newest first
    torn: Array  # (n, lags) bool: an output did not report throughout
    filled: Array  # (n,) blocks so far
    g: Array  # (n, M, p)
    info: Array  # (n, M, p, p)
    blocks: Array  # (n,) blocks of the step that is being filled,
    means: Array  # (n, n_obs) the sum of their means,
    residuals: Array  # (n, n_y) of their residuals,
    reports: Array  # (n, n_y) and of their reports


def begin(plant: Plant, shape: FeatureShape, n: int) -> Stream:
    """The state before the first sample."""
    p, M, width, n_y = len(plant.estimated), len(MEMORIES), len(plant.observed), len(plant.outputs)
    count, total, when, last, newest, means = np.zeros((6, n, width))
    residuals, reports = np.zeros((2, n, n_y))
    return Stream(
        count=count, total=total, when=when, last=last, newest=newest, past=np.zeros((n, shape.lags, 2, width)),
        torn=np.zeros((n, shape.lags), bool), filled=np.zeros(n, np.int64), g=np.zeros((n, M, p)),
        info=np.zeros((n, M, p, p)), blocks=np.zeros(n), means=means, residuals=residuals, reports=reports,
    )  # fmt: skip


def add(
    plant: Plant, shape: FeatureShape, model: FeatureModel, stream: Stream, obs: Array, k: int
) -> tuple[Stream, Array | None]:  # fmt: skip
    """Sample k (n, n_obs): the state after it and, at the end of a step, what `features` has there (n, n_features)."""
    sample = plant.scale(obs)
    there = ~np.isnan(sample)
    place = k % shape.stride + 1.0
    stream = stream._replace(
        count=stream.count + there, total=stream.total + np.where(there, sample, 0.0), when=stream.when + place * there,
        last=np.where(there, place, stream.last), newest=np.where(there, sample, stream.newest),
    )  # fmt: skip
    if (k + 1) % shape.stride:
        return stream, None
    stream = _close_block(plant, shape, model, stream)
    if (k + 1) % shape.period:
        return stream, None
    means, shares = stream.means / stream.blocks[:, None], stream.reports / (shape.stride * stream.blocks[:, None])
    seen = assembled(shape, model, means, stream.newest, stream.residuals, stream.g, stream.info, shares)
    done = ("blocks", "means", "residuals", "reports")
    return stream._replace(**{name: np.zeros_like(getattr(stream, name)) for name in done}), seen


def _close_block(plant: Plant, shape: FeatureShape, model: FeatureModel, stream: Stream) -> Stream:
    n_y, heard, middle = len(plant.outputs), stream.count > 0, (shape.stride + 1) / 2
    mean = stream.total / np.maximum(stream.count, 1.0)
    if not heard.all():
        mean = np.where(heard, mean, stream.past[:, 0, 0])  # a command is what it was
    now = np.stack([mean, stream.newest], axis=1)
    phi, psi = regressors(plant, shape, stream.past, now)
    part = stream.count[:, :n_y] < shape.stride
    if part.any():
        before = stream.past[:, 0, 1, :n_y]
        ahead = expected(model, phi) if shape.linear else before
        slope = (ahead - before) / middle  # per sample
        early = middle - stream.when[:, :n_y] / np.maximum(stream.count[:, :n_y], 1.0)
        for row, filled in (
            (0, np.where(heard[:, :n_y], mean[:, :n_y] + slope * early, ahead)),
            (1, np.where(heard[:, :n_y], stream.newest[:, :n_y] + slope * (shape.stride - stream.last[:, :n_y]), ahead)),
        ):
            now[:, row, :n_y] = np.where(part, filled, now[:, row, :n_y])
    y, trust = now[:, 0, :n_y], heard[:, :n_y].astype(float)
    torn = np.concatenate([part.any(axis=1, keepdims=True), stream.torn], axis=1)
    doubted = torn.any(axis=1)
    if not shape.linear and doubted.any():
        trust[doubted] *= _trust(model, y[doubted] - expected(model, phi[doubted]))
    e, g, info = information(model, phi, psi, y, trust)
    ready = (stream.filled >= shape.lags).astype(float)
    keep = (1 - 1 / MEMORIES)[:, None]
    count, total, when, last = (np.zeros_like(stream.total) for _ in range(4))
    return Stream(
        count=count, total=total, when=when, last=last, newest=now[:, 1],
        past=np.concatenate([now[:, None], stream.past[:, :-1]], axis=1), torn=torn[:, :-1], filled=stream.filled + 1,
        g=keep * stream.g + (g * ready[:, None])[:, None],
        info=keep[..., None] * stream.info + (info * ready[:, None, None])[:, None],
        blocks=stream.blocks + 1, means=stream.means + now[:, 0], residuals=stream.residuals + e * ready[:, None],
        reports=stream.reports + stream.count[:, :n_y],
    )  # fmt: skip


def _trust(model: FeatureModel, r: Array) -> Array:
    """Trust (n, n_y) in residuals (n, n_y) whose past is doubtful: what brings them down to the bound."""
    spread = np.sqrt(np.diag(np.linalg.inv(model.whiten.astype(float) @ model.whiten)))
    return np.minimum(1.0, BOUND * spread / np.maximum(np.abs(r), 1e-12))


def features(plant: Plant, shape: FeatureShape, model: FeatureModel, obs: Array) -> Array:
    """Recorded observations (N, K + 1, n_obs) as a network sees them (N, (K + 1) // period, n_features), float32."""
    if np.isnan(obs).any():
        stream, steps = begin(plant, shape, len(obs)), []
        for k in range(obs.shape[1] // shape.period * shape.period):
            stream, seen = add(plant, shape, model, stream, obs[:, k], k)
            steps += [] if seen is None else [np.float32(seen)]
        return np.stack(steps, axis=1)

    import scipy.signal  # takes a second, and only training comes here

    z, m, n_y = blocks(plant, obs, shape.stride), shape.every, len(plant.outputs)
    T = z.shape[1] // m * m
    z = z[:, :T]
    phi, psi = sequences(plant, shape, z)
    known = information(model, phi, psi, z[:, shape.lags :, 0, :n_y])
    e, g, info = (np.pad(a, [(0, 0), (T - a.shape[1], 0)] + [(0, 0)] * (a.ndim - 2)) for a in known)
    keep = 1 - 1 / MEMORIES

    def forgotten(part: Array) -> Array:
        return np.stack(
            [np.asarray(scipy.signal.lfilter([1.0], [1.0, -a], part, axis=1))[:, m - 1 :: m] for a in keep], axis=2
        )

    by_step = (len(z), T // m, m, -1)
    mean, newest = z[:, :, 0].reshape(by_step).mean(axis=2), z[:, m - 1 :: m, 1]
    sums = (e.reshape(by_step).sum(axis=2), forgotten(g), forgotten(info), np.ones((*mean.shape[:2], n_y)))
    return assembled(shape, model, mean, newest, *sums).astype(np.float32)


def standardised(plant: Plant, shape: FeatureShape, model: FeatureModel, flights: Iterable[Array]) -> FeatureModel:
    """The model with the features' mean and standard deviation over flights (N, K + 1, n_obs)."""
    seen = [features(plant, shape, model, obs).reshape(-1, len(model.mean)).astype(float) for obs in flights]
    every = np.concatenate(seen)
    return model._replace(mean=np.float32(every.mean(axis=0)), std=np.float32(every.std(axis=0) + 1e-3))
