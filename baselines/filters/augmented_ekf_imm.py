"""Interacting multiple models over the augmented extended Kalman filters: follows faults that come and go.

The six filters of the bank exchange their estimates before each prediction, weighted by the probability that the
fault has just begun or ended. Mode 0 forgets the fault parameter; a fault's mode restarts it from a prior where the
fault is new. The label is the most probable mode.

H. A. P. Blom, Y. Bar-Shalom, IEEE TAC 33(8), 1988; for faults Y. Zhang, X. R. Li, IEEE Trans. Aerospace and Electronic
Systems 34(4), 1998.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.filters import missile_ekf as ekf
from baselines.filters import missile_model as model
from baselines.filters.missile_ekf import JAM, Filters
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of
from fdi_gym.estimation import mixing
from fdi_gym.estimation.decision import Reading, by_candidate
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.missile_pitch import DEG, DT

RESTART_SD = np.array([0.0, 0.2, 0.2, 0.1, 2 * DEG, 0.2])  # of theta where a fault begins, l = 0..5
RESTART_MEAN = np.array([0.0, 0.0, 0.0, 0.1, np.nan, 0.3])  # a jam begins at delta^
SIGMA_RHO = 0.08 / 3**0.5
MU_MIN = 1e-8


class Interacting(NamedTuple):
    """The filters and the probabilities of their modes."""

    filters: Filters
    mu: Array  # (n, 6)


def transition(p: float) -> Array:
    """Mode transitions (6, 6): none to each fault with p/5, each fault to none with p, no fault to another."""
    Pi = (1 - p) * np.eye(6)
    Pi[0, 1:], Pi[1:, 0] = p / 5, p
    return Pi


def mixed(f: Filters, w: Array) -> Filters:
    """The filters after their interaction: theta belongs to each mode alone. w (n, to, from)."""
    m0 = np.tile(RESTART_MEAN, (len(w), 1))
    m0[:, JAM] = f.known.delta
    z, P = mixing.mix(w, f.z, f.P, slice(2, 3), m0[..., None], (RESTART_SD**2)[:, None, None])
    return f._replace(z=z, P=P)


@diagnoser("augmented_ekf_imm", "Augmented EKFs as interacting multiple models", reference=True)
@diagnoser("augmented_ekf_mode_probabilities", "The bank's filters with mode probabilities, no interaction",
           interaction=False, dwell=4.0, sigma_rho=ekf.SIGMA_RHO)  # fmt: skip
def augmented_ekf_imm(
    plant: Plant, *, dwell: float = 1.5, sigma_rho: float = SIGMA_RHO, interaction: bool = True
) -> Diagnoser:
    """The interacting filters.

    Args:
        plant: The missile.
        dwell: Mean time in a mode [s].
        sigma_rho: Initial standard deviation of the moment coefficients' errors.
        interaction: Mix the estimates; without it the filters run alone, as in the bank, and only mu is filtered.

    Raises:
        NotApplicableError: Another plant, or one without sensor noise.
    """
    model.require_missile(plant, "the interacting filter bank", noisy=True)
    R, Pi = plant.R[:2, :2], transition(DT / dwell)
    sigma_theta = RESTART_SD if interaction else ekf.SIGMA_THETA

    def start(n: int) -> Interacting:
        return Interacting(ekf.start(n), np.tile(np.eye(6)[0], (n, 1)))

    def begin(s: Interacting, at: Interval, y: Array) -> Interacting:
        return Interacting(ekf.begin(s.filters, at, y, R, sigma_theta, sigma_rho), np.maximum(s.mu, MU_MIN))

    def predict(s: Interacting, at: Interval) -> Interacting:
        c, w = mixing.ahead(s.mu, Pi)
        return Interacting(ekf.predict(mixed(s.filters, w) if interaction else s.filters, at), c)

    def update(s: Interacting, at: Interval, y: Array, seen: Array) -> Interacting:
        filters = ekf.update(s.filters, y, seen, R)
        return Interacting(filters, mixing.weigh(s.mu, filters.log_likelihood, MU_MIN))

    def read(s: Interacting) -> Reading:
        mu = s.mu / s.mu.sum(axis=1, keepdims=True)
        return ekf.reading(s.filters, mu, -2.0 * np.log(np.maximum(mu, MU_MIN)), mu)

    filter = Filter(start, predict, update, read, True, begin, model.SENSORS)
    rule = by_candidate(lambda r, label: np.argmax(np.asarray(r.probs), axis=1), 1)
    return diagnoser_of(plant, filter, ekf.only_declared(rule))
