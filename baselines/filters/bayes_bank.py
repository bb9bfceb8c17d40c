"""Bayes banks for the Boeing 747's actuator faults: what can be known, computed.

Given when a fault began and of which type it is, the innovations of the nominal filter are linear in its size with
Gaussian noise, so the size integrates out in closed form. What is left is a sum over onset times and types:

- `bayes_bank`: one permanent fault at an unknown onset. With the true priors it maximises the expected share of right
  labels: no diagnoser can beat it on average on the standard process.
- `baselines.filters.switching_bayes_bank`: faults that come and go; approximate.
- `baselines.oracles.known_onset_oracle`: is told the fault windows, not what happens in them.

Per onset: sensitivity of the filter's error M; information G = sum H' S^-1 H, g = sum H' S^-1 nu.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr, logsumexp

from baselines.filters import kalman_filter
from baselines.filters.kalman_filter import Healthy, Nominal, sense
from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation.decision import Reading, Rule, by_candidate
from fdi_gym.estimation.interval import Interval
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


class Sizes(NamedTuple):
    """How large a fault may be: uniform."""

    gamma: tuple[float, float]
    b_max: tuple[float, float]


def marginals(G: Array, g: Array, u_onset: Array, sizes: Sizes) -> tuple[Array, Array]:
    """log likelihood ratio of each type against no fault (..., 6), and the expected theta under it (..., 6, 4).

    G (..., 4, 4), g (..., 4); u_onset (..., 2) is the command at the onset, where a jam holds its surface.
    """
    shape = g.shape[:-1]
    value, theta = np.empty((*shape, 6)), np.zeros((*shape, 6, 4))
    for s in range(2):
        j, first = 2 + s, 3 * s
        value[..., first], theta[..., first, s] = log_mean_exp(g[..., s], G[..., s, s], *sizes.gamma)
        # a stuck surface: theta = -e_s + m e_j, so the log ratio is a constant, plus (g_j + G_sj) m - G_jj m^2 / 2
        constant, slope = -g[..., s] - 0.5 * G[..., s, s], g[..., j] + G[..., s, j]
        b = sizes.b_max[s]
        mass, mean = log_mean_exp(slope, G[..., j, j], -b, b)
        value[..., first + 1], theta[..., first + 1, j] = constant + mass, mean
        m = u_onset[..., s]
        value[..., first + 2], theta[..., first + 2, j] = constant + slope * m - 0.5 * G[..., j, j] * m * m, m
        theta[..., first + 1, s] = theta[..., first + 2, s] = -1.0
    return value, theta


def check(plant: Plant) -> None:
    """The bank's hypotheses are those of one plant with single-fault labels.

    Raises:
        NotApplicableError: It is another one.
    """
    if plant.id != "B747Lateral" or len(plant.labels) != 5:
        raise NotApplicableError("its hypotheses are the Boeing 747's single aileron and rudder faults")


def most_probable() -> Rule:
    """The label is the most probable one, at once."""
    return by_candidate(lambda r, label: np.argmax(np.asarray(r.probs), axis=1), 1)


def label_probabilities(weights: Array) -> Array:
    """Probabilities of the four faulty labels (..., 4) from those of the types (..., 6)."""
    return np.stack([weights[..., label == LABEL].sum(axis=-1) for label in range(1, 5)], axis=-1)


class Onsets(NamedTuple):
    """State: the nominal filter, and what each onset hypothesis has gathered; and the answer."""

    healthy: Healthy
    M: Array  # (n, T, 4, 4)
    G: Array  # (n, T, 4, 4)
    g: Array  # (n, T, 4)
    u_onset: Array  # (n, T, 2)
    log_prior: Array  # (n, 1 + T) of no fault so far, and of each onset; -inf for one that is still to come
    probs: Array  # (n, 5)
    z: Array  # (n, 4)


class Clock(NamedTuple):
    """When a fault may begin, and with which prior."""

    first_onset: int
    last_onset: int
    grid: int  # samples between onset hypotheses
    horizon: int  # length of the process's flights
    p_fault: float

    @property
    def slots(self) -> int:
        """Onset hypotheses."""
        return len(range(self.first_onset, self.last_onset + 1, self.grid))

    def used(self, k: Array) -> int:
        """Slots that any episode has in use at the samples k (n,)."""
        return int(np.clip((k.max() - 1 - self.first_onset) // self.grid + 1, 0, self.slots))


def posterior(s: Onsets, m: int, sizes: Sizes) -> tuple[Array, Array]:
    """log weights (n, 1 + 6 m) of no fault and of each onset and type, and the expected deviations (n, m, 6, 4)."""
    ratio, z = marginals(s.G[:, :m], s.g[:, :m], s.u_onset[:, :m], sizes)
    types = ratio + LOG_WEIGHT + s.log_prior[:, 1 : m + 1, None]
    return np.concatenate([s.log_prior[:, :1], types.reshape(len(z), -1)], axis=1), z


def begun(s: Onsets, step: Array, u: Array, clock: Clock, sizes: Sizes) -> Onsets:
    """New onset hypotheses, where one begins with this step (n,); past the last slot in place of the least probable one."""
    T, each = clock.slots, clock.p_fault / clock.slots
    late = step - clock.first_onset
    new = np.flatnonzero((late >= 0) & (late % clock.grid == 0) & ((step <= clock.last_onset) | (step >= clock.horizon)))
    if not new.size:
        return s
    slot = late[new] // clock.grid
    M, G, g, u_onset, log_prior = (a.copy() for a in (s.M, s.G, s.g, s.u_onset, s.log_prior))
    beyond = slot >= T
    if beyond.any():
        log, _ = posterior(s, T, sizes)
        slot[beyond] = np.argmin(log[new[beyond], 1:].reshape(-1, T, 6).max(axis=2), axis=1)
    M[new, slot], G[new, slot], g[new, slot], u_onset[new, slot] = 0.0, 0.0, 0.0, u[new]
    share = np.where(beyond, each / (1 - clock.p_fault), 1.0)  # of what is left of "no fault", once it is p_fault
    mass = np.exp(log_prior[new, 0])
    fresh = np.where(beyond, mass * (1 - np.exp(-share)), each)
    log_prior[new, 1 + slot] = np.log(fresh)
    log_prior[new, 0] = np.log(mass - fresh)
    return s._replace(M=M, G=G, g=g, u_onset=u_onset, log_prior=log_prior)


def gathered(s: Onsets, f: Nominal, healthy: Healthy, u: Array, m: int) -> Onsets:
    """What the hypotheses of the first m slots make of the sample that `healthy` has used."""
    if not m:
        return s._replace(healthy=healthy)
    M, G, g = s.M.copy(), s.G.copy(), s.g.copy()
    E = f.model.E(u)[:, None] * np.isfinite(s.log_prior[:, 1 : m + 1, None, None])
    M[:, :m], G[:, :m], g[:, :m] = sense(f, healthy, M[:, :m], G[:, :m], g[:, :m], E)
    return s._replace(healthy=healthy, M=M, G=G, g=g)


def concluded(s: Onsets, m: int, now: Array, sizes: Sizes) -> Onsets:
    """The answer from the posterior, in the episodes `now` (n,)."""
    log, z = posterior(s, m, sizes)
    w = np.exp(log - logsumexp(log, axis=1, keepdims=True))
    types = w[:, 1:].reshape(len(now), m, 6)
    probs = np.column_stack([w[:, 0], label_probabilities(types).sum(axis=1)])
    mean = (types[..., None] * z).sum(axis=(1, 2))
    return s._replace(probs=np.where(now[:, None], probs, s.probs), z=np.where(now[:, None], mean, s.z))


@diagnoser("bayes_bank", "Bayes bank over onsets and types, true priors: the bound of the standard process", reference=True)
def bayes_bank(
    plant: Plant,
    *,
    gamma: tuple[float, float] = (-0.9, -0.3),
    b_max: tuple[float, float] = (4.0, 2.0),
    first_onset: int = 200,
    last_onset: int = 800,
    grid: int = 10,
    horizon: int = 1200,
    p_fault: float = 0.8,
    decide_every: int = 1,
) -> Diagnoser:
    """The exact classifier of one permanent fault at an unknown onset.

    On a flight that is longer than its process's, faults go on beginning after it at the rate of before: a new onset then
    takes the place of the least probable one.

    Args:
        plant: The Boeing 747 with single-fault labels.
        gamma: Range of the loss of effectiveness.
        b_max: Largest random stuck position of aileron and rudder [deg].
        first_onset, last_onset, grid: Onset hypotheses, in samples.
        horizon: Length of the process's flights, in samples.
        p_fault: Prior probability of a fault.
        decide_every: Samples between evaluations of the posterior; the answer stands in between.

    Raises:
        NotApplicableError: Another plant.
    """
    check(plant)
    f, sizes = kalman_filter.nominal_filter(plant), Sizes((gamma[0], gamma[1]), (b_max[0], b_max[1]))
    clock = Clock(first_onset, last_onset, grid, horizon, p_fault)

    def start(n: int) -> Onsets:
        T, log_prior = clock.slots, np.full((n, 1 + clock.slots), -np.inf)
        log_prior[:, 0] = 0.0
        return Onsets(
            kalman_filter.start(f, plant, n), np.zeros((n, T, 4, 4)), np.zeros((n, T, 4, 4)), np.zeros((n, T, 4)),
            np.zeros((n, T, 2)), log_prior, np.tile([1.0, 0, 0, 0, 0], (n, 1)), np.zeros((n, 4)),
        )  # fmt: skip

    def predict(s: Onsets, at: Interval) -> Onsets:
        s = begun(s, at.k - 1, at.u, clock, sizes)
        return s._replace(healthy=kalman_filter.predict(f, s.healthy, at))

    def update(s: Onsets, at: Interval, y: Array, seen: Array) -> Onsets:
        m, now = clock.used(at.k), at.k % decide_every == 0
        s = gathered(s, f, kalman_filter.correct(f, s.healthy, y, seen), at.u, m)
        return concluded(s, m, now, sizes) if now.any() else s

    def read(s: Onsets) -> Reading:
        return Reading(s.z, x=s.healthy.x, Px=s.healthy.P, nu=s.healthy.nu, probs=s.probs)

    return diagnoser_of(plant, Filter(start, predict, update, read, first_sample=False), most_probable())
