"""Switching Bayes bank: the Boeing 747's faults come and go at unknown times.

Hypotheses "healthy", "active since tau" and "recovering since off"; every 10 samples old recoveries are merged into
healthy, long-lived faults may end, and a new fault may begin. It takes the gaps as geometric with a mean of 25 s and
cuts the transient of a recovery after 4 s, so the optimum of a causal diagnoser lies somewhat above it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import logsumexp

from baselines.filters.bayes_bank import LABEL, LOG_WEIGHT, Prior, answer, b_max_of, check, marginals, sense
from baselines.filters.windowed_nis import steady_filter
from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser
from fdi_gym.plant import Array, Plant

START, GRID = 200, 10  # first sample and period of the bookkeeping
SHORTEST, LONGEST = 150, 310  # age at which a fault may end, and by which it has
MERGE_AFTER = 40  # samples after which a recovery is healthy again
P_BEGIN = 10.0 / 250.0  # probability of a new fault per period


@diagnoser("switching_bayes_bank", "Bayes bank with fault and recovery hypotheses: reference for intermittent faults")
def switching_bayes_bank(plant: Plant, *, gamma: tuple[float, float] = (-0.7, -0.2)) -> Diagnoser:
    """The switching bank; it knows the nominal plant only.

    Args:
        plant: The Boeing 747 with single-fault labels.
        gamma: Range of the loss of effectiveness.

    Raises:
        NotApplicableError: Another plant.
    """
    check(plant)
    nominal, prior = steady_filter(plant), Prior(gamma, b_max_of(plant))

    def init(n: int) -> Any:
        none = answer(np.tile(np.log([1.0] + [1e-300] * 4), (n, 1)), np.zeros((n, 4)))
        empty = [
            np.zeros((n, 0, 4, 4)),
            np.zeros((n, 0, 4, 4)),
            np.zeros((n, 0, 4)),
            np.zeros((n, 0, 2)),
            np.zeros((n, 0)),
        ]
        # tau and off are lists of shared numbers: when each hypothesis began and, for a recovery, when it ended
        return 0, np.zeros((n, 4)), np.zeros(n), [*empty], (), (), none

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, x, w_healthy, (M, G, g, u_onset, w), tau, off, last = state
        n = len(obs)
        if k == 0:
            return (1, *state[1:]), last
        y, u, _ = plant.split(obs)
        step = k - 1
        if step >= START and step % GRID == 0:
            begun, ended = np.array(tau, int), np.array([-1 if o is None else o for o in off], int)
            # (1) old recoveries merge into healthy
            old = (ended >= 0) & (step - ended >= MERGE_AFTER)
            if old.any():
                ratio, _ = marginals(G[:, old], g[:, old], u_onset[:, old], prior)
                merged = w[:, old] + logsumexp(ratio + LOG_WEIGHT, axis=2)
                w_healthy = logsumexp(np.column_stack([w_healthy, merged]), axis=1)
            # (2) a fault of sufficient age may end now
            age = step - begun
            may_end = (ended < 0) & (age >= SHORTEST)
            h = np.where(may_end, np.minimum(1.0, GRID / np.maximum(LONGEST - age, GRID)), 0.0)
            with np.errstate(divide="ignore"):
                leaving, staying = np.log(h), np.log1p(-h)
            keep = ~old & np.isfinite(staying)
            moved = [np.concatenate([a[:, keep], a[:, may_end]], axis=1) for a in (M, G, g, u_onset)]
            w = np.concatenate([(w + staying)[:, keep], (w + leaving)[:, may_end]], axis=1)
            begun, ended = np.append(begun[keep], begun[may_end]), np.append(ended[keep], np.full(may_end.sum(), step))
            # (3) a new fault may begin now
            M, G, g, u_onset = (
                np.concatenate([a, new], axis=1)
                for a, new in zip(
                    moved,
                    (np.zeros((n, 1, 4, 4)), np.zeros((n, 1, 4, 4)), np.zeros((n, 1, 4)), u[:, None]),
                    strict=True,
                )
            )
            w = np.column_stack([w, w_healthy + np.log(P_BEGIN)])
            w_healthy = w_healthy + np.log1p(-P_BEGIN)
            tau, off = (*begun.tolist(), step), (*(None if o < 0 else int(o) for o in ended), None)
        x, nu = nominal.step(x, u, y)
        gone = np.array([o is not None for o in off], bool)
        if tau:
            E = nominal.model.E(u)[:, None] * ~gone[:, None, None]
            M, G, g = sense(M, G, g, E, nu, nominal)
        if k % GRID == 0 and tau:
            ratio, theta = marginals(G, g, u_onset, prior)
            each = ratio + LOG_WEIGHT + w[..., None]
            top = np.maximum(each.max(axis=(1, 2)), w_healthy)
            p = np.exp(each - top[:, None, None])
            healthy = np.exp(w_healthy - top) + p[:, gone].sum(axis=(1, 2))
            active = p[:, ~gone]
            probs = np.column_stack([healthy, *(active[:, :, label == LABEL].sum(axis=(1, 2)) for label in range(1, 5))])
            total = probs.sum(axis=1, keepdims=True)
            probs = probs / total
            mode = np.argmax(probs, axis=1)
            last = Diagnosis(mode > 0, mode, (active[..., None] * theta[:, ~gone]).sum(axis=(1, 2)) / total, None, probs)
        return (k + 1, x, w_healthy, [M, G, g, u_onset, w], tau, off, last), last

    return Diagnoser(init, update)
