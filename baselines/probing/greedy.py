"""Greedy information gain: the probe that is worth most, by what is believed and by what each probe would tell.

Hypotheses i and j, under a probe, differ in the innovations nu of the healthy plant's Kalman filter, with covariance S.
In so many samples they can be told apart by the Kullback-Leibler divergence

    D_ij = sum_k |nu_i,k - nu_j,k|^2_{S^-1} / 2

which is measured on flights without noise, of faults drawn from the process. An error between i and j, of which one is
true with the believed probabilities p_i and p_j, is resolved with the probability 1 - exp(-D_ij), and a fault that is
found pays for so many decisions to come. What that is worth more than without a probe is set against the price.
"""

from __future__ import annotations

import itertools
from typing import Any

import msgspec
import numpy as np
import scipy.linalg

from fdi_gym.acts import Acts, probe_prices
from fdi_gym.agents import Prober
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.engine import advance, no_noise
from fdi_gym.faults import draw
from fdi_gym.flights import Flights
from fdi_gym.plant import Array, Plant

SEEDS = range(2_000_000, 2_002_000)  # of the faults that the hypotheses stand for
EXAMPLES = 4  # of each


def prober(
    plant: Plant, *, process: str = "standard", period: int = 10, pays_for: float = 30.0, cost_weight: float = 1.0,
    window: int = 200, least: float = 0.02,
) -> Prober:  # fmt: skip
    """The probe with the largest gain, if any has one.

    Args:
        plant: The plant.
        process: The fault process that is met.
        period: Decision period [samples].
        pays_for: Decisions for which a fault that is told from another pays.
        cost_weight: Factor on the price of a probe.
        window: Samples over which hypotheses are told apart by a probe that goes on.
        least: The probability that every label keeps, since what has not been probed has not been seen.
    """
    gains = 1.0 - np.exp(-divergences(plant, process, window) * period / window)  # (probes, labels, labels)
    price = cost_weight * np.array(probe_prices(plant))
    labels = len(plant.labels)

    def choose(state: Any, obs: Array, said: Diagnosis) -> tuple[Any, Array]:
        probs = np.eye(labels)[np.clip(said.label, 0, labels - 1)] if said.label_probs is None else said.label_probs
        probs = np.nan_to_num(probs) * (1.0 - least) + least / labels
        resolved = np.einsum("ni,pij,nj->np", probs, gains, probs) / 2.0
        worth = pays_for * (resolved - resolved[:, :1]) - price
        return state, worth.argmax(axis=1)

    return Prober(lambda n: n, choose)


def divergences(plant: Plant, process: str, window: int) -> Array:
    """D (probes, labels, labels) over so many samples after a start at trim; the mean over the examples of two labels."""
    scenarios, label = _examples(plant, process, window)
    filtered = _steady(plant)
    assert plant.acting is not None
    found = []
    for number in range(len(plant.acting.probes)):
        flights = Flights(plant, scenarios, [no_noise(plant, s.steps) for s in scenarios])
        acts = Acts(flights, accommodation=False)
        acts.choose(np.full(len(flights), number))
        added = acts.tables(window)
        obs = advance(flights, window, inputs=added.inputs, references=added.references).obs
        nu = _innovations(plant, filtered, obs)  # (window, flights, n_y), whitened
        D = 0.5 * ((nu[:, :, None] - nu[:, None]) ** 2).sum(axis=(0, 3))
        apart = np.zeros((len(plant.labels), len(plant.labels)))
        for i, j in itertools.permutations(np.unique(label), 2):
            apart[i, j] = np.nan_to_num(D[np.ix_(label == i, label == j)]).mean()
        found.append(apart)
    return np.array(found)


def _examples(plant: Plant, process: str, window: int) -> tuple[list[Any], Array]:
    """Flights that begin with their fault: a few of each label that the process draws, and their labels."""
    kept: dict[int, list[Any]] = {0: []}
    for seed in SEEDS:
        scenario = draw(plant.process(process), seed)
        faults = [f for f in scenario.faults if f.onset == min(g.onset for g in scenario.faults)]
        label = plant.label_of(frozenset(f.mode for f in faults))
        if len(kept.setdefault(label, [])) < EXAMPLES:
            begun = [msgspec.structs.replace(f, onset=1, end=None) for f in faults]
            kept[label].append(scenario.replace(faults=begun, physical={}, x0=None))
        if len(kept) == len(plant.labels) and all(len(v) == EXAMPLES for v in kept.values()):
            break
    label = np.repeat(list(kept), [len(v) for v in kept.values()])
    return [s for v in kept.values() for s in v], label


def _steady(plant: Plant) -> tuple[Array, Array, Array]:
    """Of the plant linearised at trim: gain K (n_x, n_s), outputs with noise (n_s,), whitening L^-1 (n_s, n_s), S = L L'."""
    x, u = plant.trim_state, plant.trim_command
    h = 1e-5 * np.maximum([s.scale for s in plant.states], 1e-3)
    ahead = np.stack([plant.propagate(0.0, x + s, u) - plant.propagate(0.0, x - s, u) for s in np.diag(h)], axis=-1)
    seen = np.array([s.sigma > 0 for s in plant.outputs])
    sensed = np.stack([plant.measure(0.0, x + s, u) - plant.measure(0.0, x - s, u) for s in np.diag(h)], axis=-1)
    A, C = (1.0 - 1e-4) * ahead / (2 * h), (sensed / (2 * h))[seen]
    R = plant.R[np.ix_(seen, seen)]
    P = scipy.linalg.solve_discrete_are(A.T, C.T, plant.Q + 1e-12 * np.eye(len(x)), R)
    S = C @ P @ C.T + R
    return np.linalg.solve(S, C @ P).T, seen, np.linalg.inv(np.linalg.cholesky(S))


def _innovations(plant: Plant, steady: tuple[Array, Array, Array], obs: Array) -> Array:
    """The whitened innovations (K, n, n_s) of the healthy plant's filter on observations (K, n, n_obs)."""
    K, seen, whiten = steady
    y, u, _ = plant.split(obs)
    x, found = np.tile(plant.trim_state, (obs.shape[1], 1)), []
    for k in range(len(obs)):
        x = plant.propagate((k - 1) * plant.dt, x, u[k]) if k else x
        nu = (y[k] - plant.measure(k * plant.dt, x, u[k]))[:, seen]
        found.append(nu @ whiten.T)
        x = x + nu @ K.T
    return np.array(found)
