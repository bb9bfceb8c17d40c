"""Bayes banks for the Boeing 747's actuator faults: what can be known, computed.

Given when a fault began and of which type it is, the innovations of the nominal filter are linear in its size with
Gaussian noise, so the size integrates out in closed form. What is left is a sum over onset times and types:

- `bayes_bank`: one permanent fault at an unknown onset. With the true priors it maximises the expected share of right
  labels: no diagnoser can beat it on average on the standard process.
- `switching_bayes_bank`: faults that come and go; approximate (geometric gaps, transients cut after 4 s).
- `known_onset_oracle`: is told the fault windows, not what happens in them.

Per onset: sensitivity of the filter's error M, of its innovation H; information G = sum H' S^-1 H, g = sum H' S^-1 nu.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import log_ndtr, logsumexp

from baselines.filters.windowed_nis import SteadyFilter, steady_filter
from fdi_gym.diagnosis import Diagnoser, Diagnosis, NotApplicableError, diagnoser
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant

# (label, type, prior weight): per surface LOE 0.25, random position 0.15, jam 0.10
TYPES = (
    (1, "LOE", 0.25),
    (2, "position", 0.15),
    (2, "jam", 0.10),
    (3, "LOE", 0.25),
    (4, "position", 0.15),
    (4, "jam", 0.10),
)
LOG_WEIGHT = np.log([weight for *_, weight in TYPES])
LABEL = np.array([label for label, *_ in TYPES])


def log_mean_exp(l: Array, a: Array, lo: float, hi: float) -> tuple[Array, Array]:  # noqa: E741
    """log of the mean of exp(l m - a m^2 / 2) over m uniform in (lo, hi), and the posterior mean of m."""
    sd = 1.0 / np.sqrt(np.maximum(a, 1e-300))
    mu = l / np.maximum(a, 1e-300)
    low, high = (lo - mu) / sd, (hi - mu) / sd
    flip = low > 0  # both ends in the upper tail: mirror, where log_ndtr keeps its digits
    low, high = np.where(flip, -high, low), np.where(flip, -low, high)
    top, bottom = log_ndtr(high), log_ndtr(low)
    log_mass = top + np.log1p(-np.exp(np.minimum(bottom - top, -1e-300)))
    value = 0.5 * l * mu + np.log(sd) + 0.5 * np.log(2 * np.pi) + log_mass - np.log(hi - lo)
    density = [np.exp(-0.5 * end**2 - 0.5 * np.log(2 * np.pi) - log_mass) for end in (low, high)]
    mean = mu + sd * np.where(flip, -1, 1) * (density[0] - density[1])
    flat = a < 1e-12  # no information: the prior
    return np.where(flat, 0.0, value), np.where(flat, 0.5 * (lo + hi), np.clip(mean, lo, hi))


class Prior(NamedTuple):
    """What a bank believes about the size of a fault."""

    gamma: tuple[float, float]
    b_max: tuple[float, float]


def marginals(G: Array, g: Array, u_onset: Array, prior: Prior) -> tuple[Array, Array]:
    """log likelihood ratio of each type against no fault (..., 6), and the expected theta under it (..., 6, 4).

    G (..., 4, 4), g (..., 4); u_onset (..., 2) is the command at the onset, where a jam holds its surface.
    """
    shape = g.shape[:-1]
    value, theta = np.empty((*shape, 6)), np.zeros((*shape, 6, 4))
    for s in range(2):
        j, first = 2 + s, 3 * s
        value[..., first], theta[..., first, s] = log_mean_exp(g[..., s], G[..., s, s], *prior.gamma)
        # a stuck surface: theta = -e_s + m e_j, so the log ratio is a constant, plus (g_j + G_sj) m - G_jj m^2 / 2
        constant, slope = -g[..., s] - 0.5 * G[..., s, s], g[..., j] + G[..., s, j]
        b = prior.b_max[s]
        mass, mean = log_mean_exp(slope, G[..., j, j], -b, b)
        value[..., first + 1], theta[..., first + 1, j] = constant + mass, mean
        m = u_onset[..., s]
        value[..., first + 2], theta[..., first + 2, j] = constant + slope * m - 0.5 * G[..., j, j] * m * m, m
        theta[..., first + 1, s] = theta[..., first + 2, s] = -1.0
    return value, theta


def sense(M: Array, G: Array, g: Array, E: Array, nu: Array, nominal: SteadyFilter) -> tuple[Array, Array, Array]:
    """One step of the sensitivities: H = A M + E, then G, g and M = (I - K) H. E is 0 once the fault is gone.

    M, G (n, hypotheses, 4, 4), g (n, hypotheses, 4), E broadcasts to M, nu (n, 4).
    """
    H = nominal.model.A @ M + E
    HtW = np.swapaxes(H, -1, -2) @ nominal.W
    return H - nominal.K @ H, G + HtW @ H, g + (HtW @ nu[:, None, :, None])[..., 0]


def check(plant: Plant) -> None:
    """The bank's hypotheses are those of one plant with single-fault labels.

    Raises:
        NotApplicableError: It is another one.
    """
    if plant.id != "B747Lateral" or len(plant.labels) != 5:
        raise NotApplicableError("its hypotheses are the Boeing 747's single aileron and rudder faults")


def b_max_of(plant: Plant) -> tuple[float, float]:
    """Largest random stuck position of aileron and rudder in the plant's standard process, deg."""
    from fdi_gym.plants.b747_lateral import B_STUCK_MAX

    return B_STUCK_MAX[plant.options["variant"].split("/")[0]]


def answer(log_probs: Array, theta: Array | None = None) -> Diagnosis:
    """The diagnosis from log probabilities (n, 5) of the labels, normalised here."""
    probs = np.exp(log_probs - logsumexp(log_probs, axis=1, keepdims=True))
    mode = np.argmax(probs, axis=1)
    return Diagnosis(mode > 0, mode, theta, None, probs)


@diagnoser("bayes_bank", "Bayes bank over onsets and types, true priors: the bound of the standard process")
def bayes_bank(
    plant: Plant,
    *,
    gamma: tuple[float, float] = (-0.9, -0.3),
    first_onset: int = 200,
    last_onset: int = 800,
    grid: int = 10,
    p_fault: float = 0.8,
    decide_every: int = 1,
) -> Diagnoser:
    """The exact classifier of one permanent fault at an unknown onset.

    Args:
        plant: The Boeing 747 with single-fault labels.
        gamma: Range of the loss of effectiveness.
        first_onset, last_onset, grid: Onset hypotheses, in samples.
        p_fault: Prior probability of a fault.
        decide_every: Samples between evaluations of the posterior; the answer is held in between.

    Raises:
        NotApplicableError: Another plant.
    """
    check(plant)
    nominal, prior = steady_filter(plant), Prior(gamma, b_max_of(plant))
    taus = np.arange(first_onset, last_onset + 1, grid)
    T = len(taus)

    def init(n: int) -> Any:
        zeros = [np.zeros((n, T, 4, 4)), np.zeros((n, T, 4, 4)), np.zeros((n, T, 4)), np.zeros((n, T, 2))]
        none = answer(np.tile(np.log([1.0] + [1e-300] * 4), (n, 1)), np.zeros((n, 4)))
        return 0, np.zeros((n, 4)), *zeros, none

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, x, M, G, g, u_onset, last = state
        if k == 0:
            return (1, *state[1:]), last
        y, u, _ = plant.split(obs)
        x, nu = nominal.step(x, u, y)
        m = int(np.searchsorted(taus, k - 1, side="right"))  # onsets at or before the step from k - 1 to k
        if m:
            if taus[m - 1] == k - 1:
                u_onset = u_onset.copy()
                u_onset[:, m - 1] = u
            M, G, g = M.copy(), G.copy(), g.copy()
            M[:, :m], G[:, :m], g[:, :m] = sense(M[:, :m], G[:, :m], g[:, :m], nominal.model.E(u)[:, None], nu, nominal)
        if k % decide_every == 0:
            ratio, theta = marginals(G[:, :m], g[:, :m], u_onset[:, :m], prior)
            log_w = np.concatenate(
                [
                    np.full((len(y), 1), np.log(1 - p_fault + p_fault * (T - m) / T)),
                    (ratio + LOG_WEIGHT + np.log(p_fault / T)).reshape(len(y), -1),
                ],
                axis=1,
            )
            w = np.exp(log_w - logsumexp(log_w, axis=1, keepdims=True))
            types = w[:, 1:].reshape(len(y), m, 6)
            probs = np.column_stack([w[:, 0], *(types[:, :, label == LABEL].sum(axis=(1, 2)) for label in range(1, 5))])
            mean = (types[..., None] * theta).sum(axis=(1, 2))
            mode = np.argmax(probs, axis=1)
            last = Diagnosis(mode > 0, mode, mean, None, probs)
        return (k + 1, x, M, G, g, u_onset, last), last

    return Diagnoser(init, update)


@diagnoser("known_onset_oracle", "Is told when each fault begins and ends, not what it is", clairvoyant=True)
def known_onset_oracle(
    plant: Plant, *, scenarios: Sequence[FaultScenario], gamma: tuple[float, float] = (-0.9, -0.3)
) -> Diagnoser:
    """The Bayes classifier inside known fault windows; label 0 outside.

    Args:
        plant: The Boeing 747 with single-fault labels.
        scenarios: The truth, one per episode of the batch.
        gamma: Range of the loss of effectiveness.

    Raises:
        NotApplicableError: Another plant.
    """
    check(plant)
    nominal, prior = steady_filter(plant), Prior(gamma, b_max_of(plant))
    steps = max(s.steps for s in scenarios)
    active, begins = (np.zeros((len(scenarios), steps + 1), bool) for _ in range(2))
    for i, scenario in enumerate(scenarios):
        for fault in scenario.faults:
            active[i, fault.onset : fault.end] = True
            begins[i, fault.onset] = True

    def init(n: int) -> Any:
        # each episode carries its own windows, so that it can be told apart in any batch
        if n != len(scenarios):
            raise ValueError(f"there are scenarios for {len(scenarios)} episodes, not for {n}")
        return (
            0,
            active,
            begins,
            np.zeros((n, 4)),
            np.zeros((n, 4, 4)),
            np.zeros((n, 4, 4)),
            np.zeros((n, 4)),
            np.zeros((n, 2)),
        )

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, active, begins, x, M, G, g, u_onset = state
        n = len(obs)
        theta, log_probs = np.zeros((n, 4)), np.tile(np.log([1.0] + [1e-300] * 4), (n, 1))
        if k > 0:
            y, u, _ = plant.split(obs)
            x, nu = nominal.step(x, u, y)
            on, begin = active[:, k - 1], begins[:, k - 1]
            fresh = (begin | ~on)[:, None, None]
            M, G, g = np.where(fresh, 0.0, M), np.where(fresh, 0.0, G), np.where(fresh[..., 0], 0.0, g)
            u_onset = np.where(begin[:, None], u, u_onset)
            E = nominal.model.E(u) * on[:, None, None]
            M, G, g = (a[:, 0] for a in sense(M[:, None], G[:, None], g[:, None], E[:, None], nu, nominal))
            ratio, sizes = marginals(G, g, u_onset, prior)
            log_w = ratio + LOG_WEIGHT
            w = np.exp(log_w - logsumexp(log_w, axis=1, keepdims=True))
            probs = np.column_stack([w[:, label == LABEL].sum(axis=1) for label in range(1, 5)])
            log_probs = np.where(on[:, None], np.log(np.maximum(np.column_stack([np.zeros(n), probs]), 1e-300)), log_probs)
            theta = (w[..., None] * sizes).sum(axis=1) * on[:, None]
        return (k + 1, active, begins, x, M, G, g, u_onset), answer(log_probs, theta)

    return Diagnoser(init, update)
