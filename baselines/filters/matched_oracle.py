"""Matched oracle: knows when each fault begins and ends and the shape of its error over time, not where it acts.

The ceiling for faults that are errors of commands. A steady Kalman filter of the plant linearised at trim, with the
disturbance as a random walk, gives innovations; the known error, fed into each channel in turn, gives the signature it
would leave in them. The channel whose signature explains most energy is declared while that energy is above the
threshold. With two faults, the pair of channels is found jointly, and each fault must bring its own energy.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from fdi_gym.diagnosis import Diagnoser, Diagnosis, NotApplicableError, diagnoser
from fdi_gym.estimation.flags import label_of_flags, label_sets
from fdi_gym.estimation.kalman import T, times
from fdi_gym.estimation.propagation import FaultInputs, fault_inputs, linear_output, trim_model
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant


class SteadyFilter(NamedTuple):
    """Steady Kalman filter of [x; d] at trim, d a random walk, as deviations from trim."""

    A: Array  # (N, N)
    Bu: Array  # (N, n_u)
    Bf: Array  # (N, p) of the fault vector
    H: Array  # (n_y, N)
    K: Array  # (N, n_y)
    C: Array  # (n_y, n_y) covariance of the innovation


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
    Q = scipy.linalg.block_diag(plant.Q, d_step**2 * np.eye(q))
    P = scipy.linalg.solve_discrete_are(A.T, Ha.T, Q, plant.R)
    C = Ha @ P @ Ha.T + plant.R
    return SteadyFilter(A, stack((ahead - back).T / 2e-5), stack(at.B), Ha, np.linalg.solve(C, Ha @ P).T, C)


class Matched(NamedTuple):
    """State of the oracle, per episode, with up to F faults and p channels each."""

    which: Array  # (n,) index of the episode
    x: Array  # (n, N) the filter, after its measurement
    held: Array  # (n, F) where an actuator was stuck in place
    s: Array  # (n, F * p, N) the error that each fault would leave in x on each channel
    G: Array  # (n, F * p, F * p) Gram matrix of the signatures
    g: Array  # (n, F * p) their products with the innovations


@diagnoser("matched_oracle", "Oracle: onset and shape of the error known, channel and size not", clairvoyant=True)
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
    inputs = fault_inputs(plant)
    model = steady_filter(plant, inputs, d_step)
    p, N = len(inputs.names), len(model.A)
    weight = np.linalg.inv(model.C)
    still = np.eye(N) - model.K @ model.H
    count = max(1, *(len(s.faults) for s in scenarios))
    labels, sets = label_sets(plant, inputs)
    longest = max(s.steps for s in scenarios) + 1
    theta_rows = np.tile(plant.nominal_theta, (len(scenarios), count, longest, 1))
    active = np.zeros((len(scenarios), count, longest), bool)
    hold = np.full((len(scenarios), count, 4), -1)  # entry, step from which on it is held, command, step of the command
    for i, scenario in enumerate(scenarios):
        for f, fault in enumerate(scenario.faults):
            table = plant.theta_table(scenario.replace(faults=[fault]))
            theta_rows[i, f, : len(table.a)] = table.a + table.b
            active[i, f, fault.onset : fault.end] = True
            for entry, first, _, command, lag in table.holds:
                hold[i, f] = entry, first, command, first - lag
    y0, u0 = plant.measure(0.0, plant.trim_state, plant.trim_command), plant.trim_command
    choices = np.array(list(itertools.permutations(range(p), count)))  # the channel of each fault
    columns = choices + p * np.arange(count)

    def init(n: int) -> Any:
        F = count * p
        return 0, Matched(
            np.arange(n), np.zeros((n, N)), np.zeros((n, count)), np.zeros((n, F, N)), np.zeros((n, F, F)), np.zeros((n, F))
        )

    def waveforms(s: Matched, k: int, u: Array) -> tuple[Array, Array]:
        """The error of each fault over step k (n, F), and where actuators are held."""
        theta, now = theta_rows[s.which, :, k].copy(), hold[s.which]
        caught = (now[..., 0] >= 0) & (now[..., 3] == k)
        held = np.where(caught, np.take_along_axis(u, np.maximum(now[..., 2], 0), axis=1), s.held)
        stuck = (now[..., 0] >= 0) & active[s.which, :, k]
        i, f = np.nonzero(stuck)
        theta[i, f, now[i, f, 0]] = held[i, f]
        return plant.estimate_target(theta, u[:, None]).sum(axis=2), held

    def energies(G: Array, g: Array, chosen: Array) -> tuple[Array, Array]:
        """g' G^-1 g and G^-1 g for the signatures chosen (n, m, f) or (m, f); those of faults still to come are zero."""
        rows = np.arange(len(g))[:, None, None]
        part, right = G[rows[..., None], chosen[..., :, None], chosen[..., None, :]], g[rows, chosen]
        size = np.linalg.solve(part + 1e-9 * np.eye(chosen.shape[-1]), right[..., None])[..., 0]
        return (right * size).sum(axis=-1), size

    def step(s: Matched, k: int, u: Array, y: Array) -> tuple[Matched, Array]:
        wave, held = waveforms(s, k, u)
        x = times(model.A, s.x) + times(model.Bu, u - u0)
        nu = y - y0 - times(model.H, x)
        x = x + times(model.K, nu)
        n = len(y)
        push = (wave[:, :, None, None] * model.Bf.T).reshape(n, count * p, N)
        moved = s.s @ model.A.T + push
        rho = moved @ model.H.T
        weighted = rho @ weight
        return Matched(
            s.which, x, held, moved @ still.T, s.G + weighted @ T(rho), s.g + times(weighted, nu)
        ), wave  # fmt: skip

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, s = state
        y, u, _ = plant.split(obs)
        n = len(obs)
        flagged, b, std = np.zeros((n, p), bool), np.zeros((n, p)), np.zeros((n, p))
        if k == 0:
            s = s._replace(x=times(model.K, y - y0))
        else:
            s, wave = step(s, k - 1, u, y)
            energy, size = energies(s.G, s.g, columns[None])
            best, i = np.argmax(energy, axis=1), np.arange(n)
            for f in range(count):
                others = np.delete(columns[best], f, axis=1)[:, None]
                without = energies(s.G, s.g, others)[0][:, 0] if count > 1 else 0.0
                channel = choices[best, f]
                found = active[s.which, f, k - 1] & (energy[i, best] - without > threshold)
                flagged[i, channel] |= found
                b[i, channel] += np.where(found, size[i, best, f] * wave[:, f], 0.0)
                own = np.maximum(s.G[i, columns[best, f], columns[best, f]], 1e-9)
                std[i, channel] += np.where(found, np.abs(wave[:, f]) / np.sqrt(own), 0.0)
        label = label_of_flags(labels, sets, flagged, np.abs(b))
        said, spread = np.zeros((n, len(plant.estimated))), np.zeros((n, len(plant.estimated)))
        said[:, inputs.estimated], spread[:, inputs.estimated] = b, std
        return (k + 1, s), Diagnosis(label > 0, label, said, spread)

    return Diagnoser(init, update)
