"""Calibration of probabilities: one temperature and one bias per label, fitted on flights of their own."""

from __future__ import annotations

import numpy as np

from fdi_gym.plant import Array

PULL = 1e-3  # towards the start, per scored sample and squared unit: labels that hardly occur keep their prior
BINS = 15


def log_softmax(logits: Array) -> Array:
    """Log probabilities (..., labels)."""
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def log_score(log_probs: Array, label: Array) -> float:
    """Mean log probability of the true label; higher is better. Cut at 1e-12, as the leaderboards do."""
    return float(np.maximum(log_probs[np.arange(len(label)), label], np.log(1e-12)).mean())


def calibration_error(log_probs: Array, label: Array) -> float:
    """Expected calibration error: mean distance between confidence and accuracy, over bins of confidence."""
    confidence, right = np.exp(log_probs.max(axis=1)), log_probs.argmax(axis=1) == label
    which = np.minimum((confidence * BINS).astype(int), BINS - 1)
    gaps = [abs((confidence[which == b] - right[which == b]).sum()) for b in range(BINS)]
    return float(sum(gaps) / len(label))


def fit(logits: Array, label: Array, prior: Array) -> tuple[float, Array]:
    """Temperature and biases that maximise the log score of scale * logits + bias, starting from 1 and the log prior.

    Args:
        logits: (n, labels), trained with labels of equal weight.
        label: True labels (n,).
        prior: Share of each label in the training flights.

    Returns:
        scale, bias (labels,)
    """
    import scipy.optimize

    start = np.concatenate([[1.0], np.log(prior)])
    onehot = np.eye(logits.shape[1])[label]

    def cost(v: Array) -> tuple[float, Array]:
        log_probs = log_softmax(v[0] * logits + v[1:])
        slope = (np.exp(log_probs) - onehot) / len(label)
        value = -(log_probs * onehot).sum() / len(label) + PULL * ((v - start) ** 2).sum()
        return value, np.concatenate([[(slope * logits).sum()], slope.sum(axis=0)]) + 2 * PULL * (v - start)

    found = scipy.optimize.minimize(
        cost, start, jac=True, method="L-BFGS-B", bounds=[(0.05, 20)] + [(None, None)] * len(prior)
    )
    return float(found.x[0]), found.x[1:]
