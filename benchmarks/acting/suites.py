"""The suites: whose flights are probed or accommodated, with which diagnoser on board, and by which agents."""

from __future__ import annotations

from typing import Any, NamedTuple

from fdi_gym.discovery import load_plant
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plant import Plant

FIRST = 1_000_000  # seed: of test flights


class Suite(NamedTuple):
    """Flights of a plant's process, an agent's clock, and the diagnosers that are on board."""

    plant_id: str
    options: dict[str, Any]
    process: str
    flights: int
    period: int  # samples of a decision
    diagnosers: tuple[str, ...]  # on board: of an active suite the first one with all agents, the others with none
    why: str

    def plant(self) -> Plant:
        """The plant."""
        return load_plant(self.plant_id, **self.options)

    def scenarios(self, plant: Plant) -> list[FaultScenario]:
        """Its flights."""
        return [draw(plant.process(self.process), FIRST + i) for i in range(self.flights)]


ACTIVE = {
    "b747-active": Suite("B747Lateral", {}, "quiet", 120, 10,
                         ("bayes_bank", "two_stage_kf", "augmented_ekf", "multiple_model_ekf"),
                         "level flight, no excitation: a weak surface that is not moved is not seen"),
    "huav-active": Suite("HUAVHover", {}, "quiet", 60, 25, ("hypothesis_bank", "augmented_ekf"),
                         "hover in still air: little moves but by the sensors' noise"),
    "missile-active": Suite("MissilePitch", {}, "standard", 90, 50, ("augmented_ekf", "mode_pursuit_ekf"),
                            "the standard flights, whose commanded incidence is zero in a third of the time"),
    "cmg-active": Suite("CMGSatellite", {"reference": "regulate"}, "standard", 64, 100, ("mekf", "augmented_ekf"),
                        "at rest after the first 15 s: nothing turns, so no effectiveness is seen"),
    "tank-active": Suite("ThreeTank", {}, "standard", 120, 10, ("mode_pursuit_ekf", "augmented_ekf"),
                         "the standard flights, whose commanded levels change every 200 s"),
}  # fmt: skip

ACCOMMODATION = {
    "b747-accommodation": Suite("B747Lateral", {"variant": "bare/closed"}, "banking", 120, 10,
                                ("bayes_bank", "two_stage_kf", "augmented_ekf"), "bank levels are followed"),
    "huav-accommodation": Suite("HUAVHover", {}, "quiet", 120, 2, ("hypothesis_bank", "augmented_ekf"),
                                "loss of effectiveness in hover"),
    "huav-accommodation-hard": Suite("HUAVHover", {}, "standard", 100, 2, ("augmented_ekf",),
                                     "any fault of an actuator, most of which leave nothing to be allowed for"),
    "missile-accommodation": Suite("MissilePitch", {}, "standard", 90, 20, ("augmented_ekf",),
                                   "a staircase of commanded incidences"),
    "cmg-accommodation": Suite("CMGSatellite", {}, "standard", 64, 50, ("mekf",), "the slew"),
    "tank-accommodation": Suite("ThreeTank", {}, "standard", 120, 10, ("mode_pursuit_ekf", "augmented_ekf"),
                                "levels that change every 200 s"),
}  # fmt: skip

# Agents that probe: name of the prober and its settings; a curve for each, from little to much
PROBERS: dict[str, list[dict[str, Any]]] = {
    "never": [{}],
    "periodic": [{"on": 2, "every": 20}, {"on": 6, "every": 20}],
    "at_random": [{"share": 0.1, "hold": 2}, {"share": 0.3, "hold": 6}],
    "greedy": [{"cost_weight": 3.0}, {"cost_weight": 1.0}, {"cost_weight": 0.3}],
    "ppo": [{}, {"variant": "discount-0"}],
    "recurrent_ppo": [{}],
}
