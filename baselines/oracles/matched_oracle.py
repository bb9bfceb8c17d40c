"""Matched oracle: knows when each fault begins and ends and the shape of its error over time, not where it acts.

The ceiling for faults that are errors of commands. The Kalman filter of the plant linearised at trim, steady at first and
with the disturbance as a random walk, gives innovations; the known error, fed into each channel in turn, gives the
signature it would leave in them. The channel whose signature explains most energy is declared while that energy is above
the threshold. With two faults, the pair of channels is found jointly, and each fault must bring its own energy.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from baselines.filters.propagation import trim_model
from baselines.filters.unknown_inputs import of_all_channels
from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation.belief import FaultInputs, fault_inputs
from fdi_gym.estimation.decision import Reading, Rule, Verdict
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, right_divide, symmetric, times
from fdi_gym.estimation.labels import channel_sets, label_of_channels
from fdi_gym.estimation.linear import linear_output
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant


class SteadyFilter(NamedTuple):
    """Steady Kalman filter of [x; d] at trim, d a random walk, as deviations from trim."""

    A: Array  # (N, N)
    Bu: Array  # (N, n_u)
    Bf: Array  # (N, p) of the fault vector
    H: Array  # (n_y, N)
    Q: Array  # (N, N)
    P: Array  # (N, N) steady covariance of the prediction
    K: Array  # (N, n_y) steady gain
    C: Array  # (n_y, n_y) steady covariance of the innovation


def steady_filter(plant: Plant, inputs: FaultInputs, d_step: float) -> SteadyFilter:
    """The filter, from the plant's linearisation; d_step is the walk's standard deviation per step."""
    at, H = trim_model(plant, inputs), linear_output(plant)
    n_x, q = len(at.A), at.E.shape[1]
    A, stack = np.eye(n_x + q), lambda M: np.vstack([M, np.zeros((q, M.shape[1]))])
    A[:n_x, :n_x], A[:n_x, n_x:] = at.A, at.E
    steps = 1e-5 * np.eye(len(plant.commands))
    ahead, back = (plant.propagate(0.0, np.tile(plant.trim_state, (len(steps), 1)), plant.trim_command + sign * steps)
                   for sign in (1, -1))  # fmt: skip
    Ha = np.hstack([H, np.zeros((len(H), q))])
    Q = np.asarray(scipy.linalg.block_diag(plant.Q, d_step**2 * np.eye(q)))
    P = scipy.linalg.solve_discrete_are(A.T, Ha.T, Q, plant.R)
    C = Ha @ P @ Ha.T + plant.R
    return SteadyFilter(A, stack((ahead - back).T / 2e-5), stack(at.B), Ha, Q, P, np.linalg.solve(C, Ha @ P).T, C)


class Matched(NamedTuple):
    """State of the oracle, per episode, with up to F faults and p channels each."""

    which: Array  # (n,) index of the episode
    x: Array  # (n, N) the filter, as deviations from trim
    P: Array  # (n, N, N)
    stuck: Array  # (n, F) where an actuator was stuck in place
    s: Array  # (n, F * p, N) the error that each fault would leave in x on each channel
    G: Array  # (n, F * p, F * p) Gram matrix of the signatures
    g: Array  # (n, F * p) their products with the innovations
    error: Array  # (n, F) the error of each fault over the last interval
    active: Array  # (n, F) bool: it acted then


class Told(NamedTuple):
    """What the oracle is told of each episode: F faults over K steps."""

    theta: Array  # (n, F, K, n_theta) the fault parameter as each fault alone makes it
    active: Array  # (n, F, K) bool
    hold: Array  # (n, F, 4) entry that is stuck in place, step from which on, command, step of the command; -1: none


def told_of(plant: Plant, scenarios: Sequence[FaultScenario], count: int) -> Told:
    """The shapes of up to `count` faults per scenario."""
    longest = max(s.steps for s in scenarios) + 1
    theta = np.tile(plant.nominal_theta, (len(scenarios), count, longest, 1))
    active = np.zeros((len(scenarios), count, longest), bool)
    hold = np.full((len(scenarios), count, 4), -1)
    for i, scenario in enumerate(scenarios):
        for f, fault in enumerate(scenario.faults):
            table = plant.theta_table(scenario.replace(faults=[fault]))
            theta[i, f, : len(table.a)] = table.a + table.b
            active[i, f, fault.onset : fault.end] = True
            for entry, first, _, command, lag in table.holds:
                hold[i, f] = entry, first, command, first - lag
    return Told(theta, active, hold)


def errors(plant: Plant, told: Told, s: Matched, at: Interval) -> tuple[Array, Array]:
    """The error of each fault over the interval (n, F), and where actuators are stuck in place."""
    k, u = at.k - 1, at.u
    theta, now = told.theta[s.which, :, k], told.hold[s.which]
    caught = (now[..., 0] >= 0) & (now[..., 3] == k[:, None])
    stuck = np.where(caught, np.take_along_axis(u, np.maximum(now[..., 2], 0), axis=1), s.stuck)
    i, f = np.nonzero((now[..., 0] >= 0) & told.active[s.which, :, k])
    theta[i, f, now[i, f, 0]] = stuck[i, f]
    return plant.estimate_target(theta, u[:, None]).sum(axis=2), stuck


def energies(G: Array, g: Array, chosen: Array) -> tuple[Array, Array]:
    """g' G^-1 g and G^-1 g for the signatures chosen (n, r, f) or (r, f); those of faults still to come are zero."""
    rows = np.arange(len(g))[:, None, None]
    part, right = G[rows[..., None], chosen[..., :, None], chosen[..., None, :]], g[rows, chosen]
    size = np.linalg.solve(part + 1e-9 * np.eye(chosen.shape[-1]), right[..., None])[..., 0]
    return (right * size).sum(axis=-1), size


class Found(NamedTuple):
    """Which channels bring enough energy."""

    on: Array  # (n, p) bool
    b: Array  # (n, p) the error of each
    variance: Array  # (n, p)


def found_by(s: Matched, choices: Array, threshold: float) -> Found:
    """The choice of channels (choices, F) that explains most energy, of which each fault must bring its own."""
    n, F = s.error.shape
    p = s.g.shape[1] // F
    columns = choices + p * np.arange(F)
    on, b, variance = np.zeros((n, p), bool), np.zeros((n, p)), np.zeros((n, p))
    energy, size = energies(s.G, s.g, columns[None])
    best, i = np.argmax(energy, axis=1), np.arange(n)
    for f in range(F):
        others = np.delete(columns[best], f, axis=1)[:, None]
        without = energies(s.G, s.g, others)[0][:, 0] if F > 1 else 0.0
        channel = choices[best, f]
        found = s.active[:, f] & (energy[i, best] - without > threshold)
        on[i, channel] |= found
        b[i, channel] += np.where(found, size[i, best, f] * s.error[:, f], 0.0)
        own = np.maximum(s.G[i, columns[best, f], columns[best, f]], 1e-9)
        variance[i, channel] += np.where(found, s.error[:, f] ** 2 / own, 0.0)
    return Found(on, b, variance)


@diagnoser(
    "matched_oracle",
    "Matched filters of the known errors of commands, channel and size not known",
    knows="when each fault begins and ends, and its error's shape",
    ceiling=True,
)
def matched_oracle(
    plant: Plant, *, scenarios: Sequence[FaultScenario], threshold: float = 10.83, d_step: float = 0.05
) -> Diagnoser:
    """The matched oracle.

    Args:
        plant: A plant whose estimated quantity is the error of its commands.
        scenarios: The truth, one per episode.
        threshold: Of the energy; 10.83 is exceeded by noise alone in one case of a thousand (chi-square, 1 d.o.f.).
        d_step: Standard deviation of the disturbance's random walk per step.

    Raises:
        NotApplicableError: The plant is not of that kind.
    """
    if plant.target is None:
        raise NotApplicableError(f"needs faults that are errors of commands; those of {plant.id} are not")
    if plant.n_magnitudes > len(plant.modes):
        raise NotApplicableError(
            f"needs faults that are errors of one command each; {plant.id} has some of several magnitudes"
        )
    inputs = fault_inputs(plant)
    model = steady_filter(plant, inputs, d_step)
    p, N, n_x, m = len(inputs.names), len(model.A), len(plant.states), len(model.H)
    count = max(1, *(len(s.faults) for s in scenarios))
    labels, sets = channel_sets(plant, inputs)
    told = told_of(plant, scenarios, count)
    y0, u0 = plant.measure(0.0, plant.trim_state, plant.trim_command), plant.trim_command
    choices = np.array(list(itertools.permutations(range(p), count)))  # the channel of each fault

    def start(n: int) -> Matched:
        F = count * p
        return Matched(
            np.arange(n), np.zeros((n, N)), np.tile(model.P, (n, 1, 1)), np.zeros((n, count)), np.zeros((n, F, N)),
            np.zeros((n, F, F)), np.zeros((n, F)), np.zeros((n, count)), np.zeros((n, count), bool),
        )  # fmt: skip

    def predict(s: Matched, at: Interval) -> Matched:
        error, stuck = errors(plant, told, s, at)
        push = (error[:, :, None, None] * model.Bf.T).reshape(len(error), count * p, N)
        return s._replace(
            x=times(model.A, s.x) + times(model.Bu, at.u - u0), P=symmetric(model.A @ s.P @ model.A.T) + model.Q,
            stuck=stuck, s=s.s @ model.A.T + push, error=error, active=told.active[s.which, :, at.k - 1],
        )  # fmt: skip

    def update(s: Matched, at: Interval, y: Array, seen: Array) -> Matched:
        cross = s.P @ model.H.T
        nu, C, cross, rho = masked(seen, y - y0 - times(model.H, s.x), model.H @ cross + plant.R, cross, s.s @ model.H.T)
        K = right_divide(cross, C)
        weighted = rho @ right_divide(np.eye(m), C)
        return s._replace(
            x=s.x + times(K, nu), P=symmetric(s.P - K @ T(cross)), s=s.s - rho @ T(K), G=s.G + weighted @ T(rho),
            g=s.g + times(weighted, nu),
        )  # fmt: skip

    def read(s: Matched) -> Reading:
        n, found = len(s.x), found_by(s, choices, threshold)
        alone = (s.g**2 / np.maximum(np.einsum("nii->ni", s.G), 1e-12)).reshape(n, count, p).max(axis=1)
        x, P = plant.trim_state + s.x[:, :n_x], found.variance[:, :, None] * np.eye(p)
        reading = Reading(found.b, P, x, s.P[:, :n_x, :n_x], signals={"energy": alone, "on": found.on})
        return of_all_channels(plant, inputs, reading)

    def decide(_: None, k: Array, r: Reading, informed: Array) -> tuple[None, Verdict]:
        """Anew at every sample: that a fault has begun or ended is known, whether sensors report or not."""
        assert r.signals is not None
        assert r.z is not None
        label = label_of_channels(labels, sets, r.signals["on"], np.abs(r.z[:, inputs.estimated]))
        return None, Verdict(label > 0, label)

    return diagnoser_of(plant, Filter(start, predict, update, read), Rule(lambda n: None, decide))
