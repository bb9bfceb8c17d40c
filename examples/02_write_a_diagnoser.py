"""A diagnoser of your own: two functions, batched over episodes. This one tests the mean of each innovation.

fdi-gym evaluate b747-standard --diagnosers 02_write_a_diagnoser:mean_innovation_test
"""

import numpy as np

from baselines.filters.kalman_filter import nominal_filter
from fdi_gym.diagnosis import Diagnoser, Diagnosis, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.faults import draw
from fdi_gym.plant import Plant
from fdi_gym.testing import check_diagnoser


def mean_innovation_test(plant: Plant, *, memory: float = 0.98, limit: float = 4.5) -> Diagnoser:
    """Which innovation is off? Yaw says rudder, roll says aileron; stuck or not it cannot tell."""
    nominal = nominal_filter(plant)
    sigma = np.sqrt(np.diag(nominal.S) * (1 - memory) / (1 + memory))  # of an exponentially weighted mean
    aileron, rudder = (plant.label_of(frozenset({f"{surface} stuck"})) for surface in ("aileron", "rudder"))

    def init(n):
        return 0, np.zeros((n, 4)), np.zeros((n, 4))

    def update(state, obs):
        k, x, mean = state
        y, u, _ = plant.split(obs)
        if k > 0:
            x = x @ nominal.model.A.T + u @ nominal.model.B.T
            nu = y - x @ nominal.model.C.T
            x = x + nu @ nominal.K.T
            mean = memory * mean + (1 - memory) * nu
        score = np.abs(mean) / sigma
        label = np.where(score[:, 2] > limit, rudder, np.where(score[:, 1] > limit, aileron, 0))
        return (k + 1, x, mean), Diagnosis(label > 0, label)

    return Diagnoser(init, update)


if __name__ == "__main__":
    plant = load_plant("B747Lateral")
    check_diagnoser(lambda plant, scenarios: mean_innovation_test(plant), plant)
    flights = simulate(plant, [draw(plant.process("standard"), seed) for seed in range(100)])
    said = run(mean_innovation_test(plant), flights.obs)
    print("right labels:", (said.label == flights.label)[:, 1:].mean().round(3))
