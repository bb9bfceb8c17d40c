"""A Kalman filter of state and faults, with a decision: gaps, counters and thresholds are the framework's business.

fdi-gym evaluate b747-standard --diagnosers 06_write_a_filter:my_filter
"""

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser_of
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.kalman import T, times, update
from fdi_gym.estimation.linear import linear_model
from fdi_gym.plant import Plant


def my_filter(plant: Plant, belief: Belief, calibration: Calibration) -> Diagnoser:
    """X = [state, fault]: the fault is a random walk, as fast as the faults of the process that will be met."""
    model, n_x, p = linear_model(plant), len(belief.x0), len(belief.z_size)
    H = np.hstack([model.C, np.zeros((len(model.C), p))])

    def start(n):  # before any sample, for n episodes
        X, P = np.zeros((n, n_x + p)), np.zeros((n, n_x + p, n_x + p))
        P[:, :n_x, :n_x], P[:, n_x:, n_x:] = belief.P0, np.diag(0.1 * belief.z_size) ** 2
        return X, P

    def predict(s, at):  # over the interval that has just ended: the model only
        F = np.tile(np.eye(n_x + p), (len(s[0]), 1, 1))
        F[:, :n_x, :n_x], F[:, :n_x, n_x:] = model.A, model.E(at.u)
        X, P = times(F, s[0]), F @ s[1] @ T(F)
        X[:, :n_x] += times(model.B, at.u)
        P[:, :n_x, :n_x] += at.noise(belief.Q)
        P[:, n_x:, n_x:] += np.diag(belief.z_walk**2)
        return X, P

    def correct(s, at, y, seen):  # with the sensors that reported
        return update(s[0], s[1], y - times(H, s[0]), H, plant.R, seen)[:2]

    def read(s):  # what it knows now: the fault's deviation from healthy and its covariance, and the state
        return Reading(z=s[0][:, n_x:], P=s[1][:, n_x:, n_x:], x=s[0][:, :n_x])

    return diagnoser_of(plant, Filter(start, predict, correct, read), by_labels(plant, calibration))


if __name__ == "__main__":
    from fdi_gym.diagnosis import fit, run
    from fdi_gym.discovery import load_plant
    from fdi_gym.engine import simulate
    from fdi_gym.faults import draw

    plant = load_plant("B747Lateral")
    flights = simulate(plant, [draw(plant.process("standard"), seed) for seed in range(10)])
    said = run(my_filter(plant, *fit(f"{__file__.rsplit('/', 1)[-1][:-3]}:my_filter", plant)), flights.obs)
    print("right labels:", (said.label == flights.label)[:, 1:].mean().round(3))
