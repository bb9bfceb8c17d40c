"""Optimal residual generator in the sense of H-/H-infinity, for any plant: as sensitive to faults as disturbances allow.

Of all observers and post-filters, r = V (y - y^) with the gain L and the weight V of the unified solution [1]

    Y = A Y A' + Ed Ed' - L S L',    S = C Y C' + Fd Fd',    L = A Y C' S^-1,    V = S^-1/2,

Ed and Fd what unknown inputs of unit size do to state and sensors, makes the response to them co-inner: their gain is 1 at
every frequency and in every direction, and the ratio of the gain of any fault to that of the disturbances is the largest
that a residual can have, at every frequency at once: H-/H-infinity, H-infinity/H-infinity and the rest. The unknown inputs
here are the noises and model errors of the belief and the disturbances that nothing measures, by their sizes.

The gain is that of the plant linearised at trim, steady; its model runs nonlinear. A gap in the measurements moves Y on by
the same equation until it has settled again. Isolation is by the signature that a fault has in the residual: how it moves
the observer's error is followed along the flight, and sums of what the residuals say forget at several paces.

[1] S. X. Ding, Model-Based Fault Diagnosis Techniques, 2nd ed., 2013, chapter 7; S. X. Ding, T. Jeinsch, P. M. Frank,
E. L. Ding, International Journal of Adaptive Control and Signal Processing 14(7), 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, quadratic, right_divide, solve, symmetric, times
from fdi_gym.estimation.labels import manifolds
from fdi_gym.estimation.signatures import Sums, heard, local, nothing_said, spoken_for
from fdi_gym.plant import Array, Plant

MOST = 2500.0  # evaluations of the model in a second of flight, from which the signatures of the faults follow


class Steady(NamedTuple):
    """The plant at trim and the solution of its equation; N states and disturbances, m sensors."""

    A: Array  # (N, N)
    C: Array  # (m, N)
    Q: Array  # (N, N) Ed Ed'
    R: Array  # (m, m) Fd Fd'
    Y: Array  # (N, N) after a step, before the measurement


def steady(plant: Plant, model: AugmentedModel) -> Steady:
    """The generator of a plant at trim.

    Raises:
        NotApplicableError: The equation has no stabilising solution: the sensors do not show what is not stable.
    """
    known = np.array([[s.nominal for s in plant.known]])
    d = None if plant.measured_disturbance is None else plant.measured_disturbance(0.0, known, known)
    at, scale = Interval(np.ones(1, np.int64), plant.trim_command[None], d, known), model.scale
    bare = model.X0[None]
    A, C = model.jacobian_f(bare, at)[1][0], model.jacobian_h(bare, at)[1][0]
    try:  # in typical sizes, where it is well conditioned
        Y = scipy.linalg.solve_discrete_are(
            (A * scale / scale[:, None]).T, (C * scale).T, model.Q / scale / scale[:, None], model.R
        )
    except (np.linalg.LinAlgError, ValueError) as error:
        raise NotApplicableError(f"no steady observer of {plant.id} at trim: {error}") from error
    return Steady(A, C, model.Q, model.R, Y * scale * scale[:, None])


class Generator(NamedTuple):
    """State: the observer, how a fault moves its error, and what the residuals have said."""

    X: Array  # (n, N)
    Y: Array  # (n, N, N)
    M: Array  # (n, N, p)
    faults: Array  # (n,) bool: an interval has ended in which a fault could have acted
    nu: Array  # (n, m) the last innovation, and
    S: Array  # (n, m, m) its covariance
    sums: Sums


def residual_filter(plant: Plant, belief: Belief, paces: Sequence[float]) -> Filter:
    """The generator and its evidence.

    Args:
        plant: The plant.
        belief: What is believed of it.
        paces: Samples within which each of the sums forgets.
    """
    model, bare = augmented(plant, belief), augmented(plant, belief, faults=False)
    s0, about = steady(plant, bare), local(model, belief.z_size)
    keep, p, N, m = 1.0 - 1.0 / np.asarray(paces, float), len(belief.z_size), len(bare.scale), len(bare.R)
    sets, labels, x = manifolds(plant), len(plant.labels), bare.x

    def start(n: int) -> Generator:
        return Generator(
            np.tile(bare.X0, (n, 1)), np.tile(s0.Y, (n, 1, 1)), np.zeros((n, N, p)), np.zeros(n, bool), np.zeros((n, m)),
            np.tile(s0.R, (n, 1, 1)), nothing_said(n, len(keep), p),
        )  # fmt: skip

    def predict(s: Generator, at: Interval) -> Generator:
        f = about.f(s.X, at)
        Y = symmetric(s0.A @ s.Y @ s0.A.T) + at.noise(s0.Q)
        return s._replace(X=f.mean, Y=Y, M=f.A @ s.M + f.E, faults=np.ones_like(s.faults))

    def update(s: Generator, at: Interval, y: Array, seen: Array) -> Generator:
        there, h = seen[:, model.sensors], about.h(s.X, at)
        cross = s.Y @ s0.C.T
        signature = (h.A @ s.M + h.E) * s.faults[:, None, None]
        nu, S, cross, Vt = masked(there, y[:, model.sensors] - h.mean, s0.C @ cross + s0.R, cross, T(signature))
        K = right_divide(cross, S)
        weighed = solve(S, T(Vt))
        new = there.any(axis=1)
        sums = heard(s.sums, keep, Vt @ weighed, times(T(weighed), nu), new & s.faults)
        return Generator(
            s.X + times(K, nu), symmetric(s.Y - K @ T(cross)), s.M - K @ T(Vt), s.faults, nu, S, sums
        )  # fmt: skip

    def read(s: Generator) -> Reading:
        cost, z = spoken_for(s.sums.G, s.sums.g, sets, labels)
        shown = {"residual": quadratic(s.nu, s.S) / m}
        return Reading(z, x=s.X[:, x], Px=s.Y[:, x, x], nu=s.nu, S=s.S, cost=cost, signals=shown)

    return Filter(start, predict, update, read, expect=lambda s, at: bare.expect(s.X[:, x], at))


@diagnoser("optimal_residual", "Optimal residual generator (H-/H-infinity, unified solution), for any plant")
def optimal_residual(
    plant: Plant, belief: Belief, calibration: Calibration, *, paces: Sequence[float] = (10, 40, 160, 640)
) -> Diagnoser:
    """The residual with its decision.

    Args:
        plant: Any plant whose estimated quantity enters additively, whose sensors have noise and show what is not stable.
        belief: What it may assume of the plant.
        calibration: When it alarms.
        paces: Samples within which each of the sums of evidence forgets, 1 or more.

    Raises:
        NotApplicableError: There is no steady observer at trim, or following the signatures costs too much.
        ValueError: A number out of range.
    """
    if not paces or min(paces) < 1:
        raise ValueError(f"paces of at least 1 sample are allowed, not {tuple(paces)}")
    points = 1 + 2 * (len(plant.states) + len(belief.disturbances) + len(belief.z_size))
    rate = points / plant.dt
    if rate > MOST:
        raise NotApplicableError(
            f"its signatures cost too much: {points} evaluations of the model of {plant.id} a sample, {rate:.0f} a second "
            f"of flight, where {MOST:.0f} are allowed"
        )
    return diagnoser_of(plant, residual_filter(plant, belief, paces), by_labels(plant, calibration))
