"""What a probe would tell: how well it sets hypotheses apart, and what is doubted because it has not been probed.

Hypotheses i and j, under a probe, differ in the innovations nu of the healthy plant's Kalman filter, with covariance S.
In so many samples they can be told apart by the Kullback-Leibler divergence

    D_ij = sum_k |nu_i,k - nu_j,k|^2_{S^-1} / 2

which is measured on flights without noise, of faults drawn from the process. An error between i and j, of which one is
true with the believed probabilities p_i and p_j, is resolved with the probability 1 - exp(-D_ij), for two labels the mean
over their faults: large ones that anybody sees say nothing of small ones that only a probe shows.

What is believed is what the diagnoser says, and doubt: at every decision a fault may have begun that has not been seen,
and what has been probed since is known better, by the same probability.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any

import msgspec
import numpy as np
import scipy.linalg

from fdi_gym.acts import Acts
from fdi_gym.diagnosis.contract import Diagnosis
from fdi_gym.engine import advance, no_noise
from fdi_gym.faults import draw
from fdi_gym.flights import Flights
from fdi_gym.plant import Array, Plant

SEEDS = range(2_000_000, 2_002_000)  # of the faults that the hypotheses stand for
EXAMPLES, BASES = 8, 3  # faults of each label, flights that they are put on


class Doubt:
    """Doubts (n, labels) about what a diagnoser says of n flights, decision by decision.

    Args:
        plant: The plant.
        process: The fault process that is met; how often its faults begin is the hazard.
        period: Decision period [samples].
        window: Samples over which hypotheses are told apart by a probe that goes on.
    """

    def __init__(self, plant: Plant, process: str, period: int, window: int = 400):
        self.apart = resolved(plant, process, window, period)
        self.labels, self.hazard = len(plant.labels), _hazard(plant, process, period)

    def begin(self, n: int) -> Array:
        """At the first decision: none."""
        return np.zeros((n, self.labels))

    def believed(self, doubt: Array, said: Diagnosis) -> tuple[Array, Array, Array]:
        """The doubts a decision later, the label that is said (n,), and what is believed with them (n, labels)."""
        label = np.clip(said.label, 0, self.labels - 1)
        probs = np.eye(self.labels)[label] if said.label_probs is None else np.nan_to_num(said.label_probs)
        doubt = np.minimum(doubt + self.hazard, 0.5 / self.labels)
        doubt[np.arange(len(label)), label] = 0.0
        return doubt, label, (1.0 - doubt.sum(axis=1, keepdims=True)) * probs + doubt

    def resolves(self, probs: Array) -> Array:
        """The probability (n, probes) of an error that a decision under each probe resolves, more than under none."""
        found = np.einsum("ni,pij,nj->np", probs, self.apart, probs) / 2.0
        return found - found[:, :1]

    def after(self, doubt: Array, label: Array, probe: Array) -> Array:
        """The doubts that a probe (n,) leaves."""
        return doubt * (1.0 - self.apart[probe, label])


def _hazard(plant: Plant, process: str, period: int) -> float:
    """The probability that a fault of one label begins within a decision, from flights of the process."""
    flights = [draw(plant.process(process), seed) for seed in SEEDS[:100]]
    begun = sum(len(s.faults) for s in flights)
    return begun * period / sum(s.steps for s in flights) / (len(plant.labels) - 1)


@functools.lru_cache(maxsize=8)
def resolved(plant: Plant, process: str, window: int, period: int) -> Array:
    """The probability (probes, labels, labels) that a decision under a probe resolves an error between two labels.

    Of D over `window` samples from when the faults begin, as late as they do in the process, a decision has its share. Bases
    are flights without a fault, on which faults of each label are put; it is the mean over these and over the faults.
    """
    faults, label, onset = examples(plant, process)
    filtered = steady(plant)
    assert plant.acting is not None
    found = []
    for seed in SEEDS[:BASES]:
        base = draw(plant.process(process), seed).without_faults().replace(physical={})
        begins = min(onset, base.steps - window - 1)
        begun = [[msgspec.structs.replace(f, onset=begins, end=None) for f in some] for some in faults]
        scenarios = [base.replace(faults=some) for some in begun]
        quiet = [no_noise(plant, base.steps)] * len(scenarios)
        found.append([])
        for number in range(len(plant.acting.probes)):
            flights = Flights(plant, scenarios, quiet)
            acts = Acts(flights, accommodation=False)
            advance(flights, begins)
            acts.choose(np.full(len(flights), number))
            chunk = acts.advance(window)
            nu = innovations(plant, filtered, chunk.state[0], chunk.obs, begins)  # (window, flights, n_s), whitened
            D = 0.5 * ((nu[:, :, None] - nu[:, None]) ** 2).sum(axis=(0, 3))
            apart = np.zeros((len(plant.labels), len(plant.labels)))
            for i, j in itertools.permutations(np.unique(label), 2):
                apart[i, j] = -np.expm1(-np.nan_to_num(D[np.ix_(label == i, label == j)]) * period / window).mean()
            found[-1].append(apart)
    return np.array(found).mean(axis=0)


def examples(plant: Plant, process: str) -> tuple[list[Any], Array, int]:
    """Faults of each label that the process draws, a few of each, their labels, and the sample where half have begun."""
    kept: dict[int, list[Any]] = {0: [[]]}
    onsets = []
    for seed in SEEDS[:400]:
        scenario = draw(plant.process(process), seed)
        if not scenario.faults:
            continue
        onsets.append(min(f.onset for f in scenario.faults))
        together = [f for f in scenario.faults if f.onset == onsets[-1]]
        label = plant.label_of(frozenset(f.mode for f in together))
        if len(kept.setdefault(label, [])) < EXAMPLES:
            kept[label].append(together)
    label = np.repeat(list(kept), [len(some) for some in kept.values()])
    return [faults for some in kept.values() for faults in some], label, int(np.median(onsets))


def steady(plant: Plant) -> tuple[Array, Array, Array]:
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


def innovations(plant: Plant, steady: tuple[Array, Array, Array], x: Array, obs: Array, first: int) -> Array:
    """The whitened innovations (K, n, n_s) of the healthy plant's filter from the states x (n, n_x) of a sample on."""
    K, seen, whiten = steady
    y, u, _ = plant.split(obs)
    found = []
    for k in range(len(obs)):
        x = plant.propagate((first + k - 1) * plant.dt, x, u[k]) if k else x
        nu = (y[k] - plant.measure((first + k) * plant.dt, x, u[k]))[:, seen]
        found.append(nu @ whiten.T)
        x = x + nu @ K.T
    return np.array(found)
