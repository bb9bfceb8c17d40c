"""Flights: what happens in an episode, recorded in arrays.

A diagnosis never feeds back into the plant, so an episode can be flown ahead of the diagnoser that watches it. The
environments show it sample by sample, the evaluation reads it in batches; both come from here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_gym import kernels
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Plant, contiguous

Array = np.ndarray


class Record(NamedTuple):
    """N flights of up to K steps, sample by sample. Row k of the truth belongs to the interval that ends at sample k.

    After a flight's end (`length`) its last row is repeated.
    """

    obs: Array  # (N, K + 1, n_obs) what a diagnoser may see: y_k, u_{k-1}, known_k
    state: Array  # (N, K + 1, n_x)
    theta: Array  # (N, K + 1, n_theta) fault parameter that acted over [k - 1, k)
    target: Array  # (N, K + 1, n_estimated) what the identification task asks for
    label: Array  # (N, K + 1) int64
    length: Array  # (N,) int64, number of steps flown
    terminated: Array  # (N,) bool, ended before its scenario's last step


def white_noise(plant: Plant, rng: np.random.Generator, steps: int) -> tuple[Array, Array]:
    """Process noise w (steps, n_x) and sensor noise v (steps + 1, n_y), from the standard deviations of the data sheet."""
    v = rng.standard_normal((steps + 1, len(plant.outputs)))
    w = rng.standard_normal((steps, len(plant.states)))
    v *= [s.sigma for s in plant.outputs]
    w *= [s.sigma for s in plant.states]
    return w, v


def no_noise(plant: Plant, steps: int) -> tuple[Array, Array]:
    """The noise of a deterministic check: none, in the shapes of `white_noise`."""
    return np.zeros((steps, len(plant.states))), np.zeros((steps + 1, len(plant.outputs)))


def simulate(plant: Plant, scenarios: Sequence[FaultScenario], noise: Sequence[tuple[Array, Array]] | None = None) -> Record:
    """Fly the scenarios.

    Args:
        plant: The plant; its physical parameters come from each scenario.
        scenarios: One per flight; they may differ in length, the record is as long as the longest.
        noise: (w (K, n_x), v (K + 1, n_y)) per flight. Default: drawn from each scenario's noise seed.

    Raises:
        ValueError: A scenario of another plant, or one that names something this plant does not have.
    """
    for scenario in scenarios:
        plant.validate(scenario)
    n, longest = len(scenarios), max(s.steps for s in scenarios)
    widths = (len(plant.observed), len(plant.states), len(plant.theta))
    obs, state, theta = (np.empty((n, longest + 1, width)) for width in widths)
    label = np.zeros((n, longest + 1), dtype=np.int64)
    length, terminated = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool)
    sensor_range = np.array([[s.low for s in plant.outputs], [s.high for s in plant.outputs]], float)
    for i, scenario in enumerate(scenarios):
        steps = scenario.steps
        if noise is not None:
            w, v = noise[i]
        else:
            rng = np.random.default_rng(scenario.noise_seed)
            w, v = plant.noise(rng, steps) if plant.noise else white_noise(plant, rng, steps)
        if np.shape(w) != (steps, len(plant.states)) or np.shape(v) != (steps + 1, len(plant.outputs)):
            raise ValueError(f"noise has the shapes of `no_noise`, not {np.shape(w)} and {np.shape(v)}")
        r, d, p = plant.inputs(scenario)
        flown = kernels.simulate(
            *plant.addresses, plant.dt, plant.substeps,
            plant.trim_state if scenario.x0 is None else np.array(scenario.x0, float),
            plant.trim_command, contiguous(plant.c0), contiguous(plant.q),
            r, d, *plant.theta_table(scenario), contiguous(w), contiguous(v), sensor_range,
            p, plant.nominal_theta, int(plant.true_feedback), state[i], obs[i], theta[i],
        )  # fmt: skip
        length[i], terminated[i] = abs(flown), flown < 0
        label[i, : steps + 1] = plant.label_rows(scenario)
        for array in (obs, state, theta, label):
            array[i, length[i] + 1 :] = array[i, length[i]]
    target = plant.estimate_target(theta, plant.split(obs)[1])
    return Record(obs, state, theta, target, label, length, terminated)
