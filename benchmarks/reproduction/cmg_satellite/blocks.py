"""Blocks of the satellite's Monte-Carlo runs: episodes that are flown and shown to a method together.

The episodes of a variant are the same for every method and noise level.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np

from benchmarks.reproduction.cmg_satellite.outcomes import Said, hard_outcome, time_line_outcome, window_outcome
from benchmarks.reproduction.numbered import fly
from fdi_gym.diagnosis import Diagnoser, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import Record
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Plant
from fdi_gym.plants import cmg_satellite as cmg

SIGMA_R = ", sigma_R 1e-4"  # the source's R in place of the true one
METHODS = {
    "UKF": "joint_ukf", "CAUKF": "caukf", "GAUKF": "gaukf", "SGAUKF": "sgaukf", "SGAUKF-odd": "sgaukf_odd",
    "dual GAUKF": "dual_gaukf", "dual SGAUKF": "dual_sgaukf", "MEKF": "mekf", "CLAIR": "mekf_clairvoyant",
    "oracle": "cramer_rao_oracle", f"GAUKF{SIGMA_R}": "gaukf", f"SGAUKF{SIGMA_R}": "sgaukf",
}  # fmt: skip
CANDIDATES = {"CAUKF": 40, "GAUKF": 16, "SGAUKF": 4, "SGAUKF-odd": 4, "dual GAUKF": 16, "dual SGAUKF": 4}  # per adapted step
# what the oracle is told of the severities
ALPHA = {"bench": (0.1, 0.9), "table5": (0.0, 1.0), "table4": (0.5, 0.9), "hard": (0.02, 0.4)}
VARIANTS = ("bench", "table5", "table4", "hard", "severity")  # their places are part of the seeds
PER_LABEL = {"bench": 5, "table5": 5, "severity": 2}  # episodes per fault label in a block
SEVERITY_WINDOW = (1500, 4500)  # steps: from 15 s on, 30 s at one severity
PER_BLOCK = {"hard": 30, "table4": 10}  # episodes in a block of those without labels


class Block(NamedTuple):
    """One block. `level` is the mismatch of "hard" and the severity of "severity"."""

    variant: str
    reference: str
    snr: int
    method: str
    number: int = 0
    level: float = 0.01

    def name(self) -> str:
        """Its file."""
        level = f"-{self.level:g}" if self.variant in ("hard", "severity") else ""
        method = METHODS[self.method] + ("-sigma_r" if SIGMA_R in self.method else "")
        return f"{self.variant}{level}-{self.reference}-{self.snr}-{method}-{self.number:03d}"


def scenarios_of(b: Block) -> list[FaultScenario]:
    """The block's episodes: they depend on the variant, reference, level and number alone."""
    key = [20_231_123, VARIANTS.index(b.variant), int(b.reference == "slew"), b.number]
    if b.variant in PER_LABEL:
        draws = [(label, (label, repeat)) for label in range(1, 16) for repeat in range(PER_LABEL[b.variant])]
    else:
        draws = [(0, (i,)) for i in range(PER_BLOCK[b.variant])]
    found = []
    for label, place in draws:
        rng = np.random.default_rng([*key, *place])
        found.append(_episode(b, label, rng).replace(noise_seed=int(rng.integers(2**62))))
    return found


def _episode(b: Block, label: int, rng: np.random.Generator) -> FaultScenario:
    match b.variant:
        case "bench":
            return cmg.bench(rng, label, b.reference)
        case "table5":
            scenario = cmg.table5(rng, label, b.reference)
            return scenario.replace(x0=cmg.tumble(rng)) if b.reference == "regulate" else scenario
        case "table4":
            return cmg.table4(b.reference)
        case "hard":
            return cmg.intermittent(rng, b.reference).replace(physical=cmg.perturb(rng, b.level))
        case _:
            onset, end = SEVERITY_WINDOW
            faults = [cmg.loss(i, b.level, onset, end) for i in cmg.SETS[label]]
            return FaultScenario(plant=cmg.ID, steps=end, faults=faults, reference={"profile": b.reference})


def show(plant: Plant, scenarios: list[FaultScenario], record: Record, method: str, **tuning: Any) -> Said:
    """Show a block to a method."""
    return read(make_diagnoser(METHODS[method], plant, scenarios=scenarios, **tuning), record, method)


def read(diagnoser: Diagnoser, record: Record, method: str) -> Said:
    """What a diagnoser says of a block, and what that took."""
    n, samples, _ = record.obs.shape
    begun = time.process_time()
    said = run(diagnoser, record.obs, signals=True)
    seconds = time.process_time() - begun
    assert said.estimate is not None
    assert said.estimate_std is not None
    sd, signals = np.sqrt((said.estimate_std**2).mean(axis=2)), said.signals or {}
    flag = signals["flag"] > 0 if "flag" in signals else np.zeros((n, samples), bool)
    adapted = signals["adapted"][:, -1].astype(np.int64) if "adapted" in signals else np.zeros(n, np.int64)
    filter_steps = samples - 1 + CANDIDATES.get(method.removesuffix(SIGMA_R), 0) * adapted
    return Said(said.estimate, said.label.astype(np.int64), sd, flag, filter_steps, seconds, adapted, said.state)


def tuning_of(b: Block) -> dict[str, Any]:
    """What the block's method is told beside its defaults."""
    if SIGMA_R in b.method:
        return {"sigma_r": 1e-4}
    if b.method == "oracle":
        low, high = (max(b.level - 0.005, 0.0), b.level + 0.005) if b.variant == "severity" else ALPHA[b.variant]
        return {"alpha_min": low, "alpha_max": high}
    return {}


def block_piece(b: Block) -> dict[str, Any]:
    """Fly and diagnose a block: {"outcomes": one per episode, "seconds": of the method, "samples"}."""
    plant = load_plant(cmg.ID, reference=b.reference, snr=b.snr)
    scenarios = scenarios_of(b)
    record = fly(plant, scenarios)
    said = show(plant, scenarios, record, b.method, **tuning_of(b))
    outcomes = []
    for i, scenario in enumerate(scenarios):
        if b.variant == "table4":
            outcomes.append(time_line_outcome(record, said, i))
        elif b.variant == "hard":
            outcomes.append(hard_outcome(plant, scenario, record, said, i))
        else:
            onset, end = scenario.faults[0].onset, scenario.faults[0].end
            assert end is not None
            outcomes.append(window_outcome(record, said, i, onset, end))
    return {"outcomes": outcomes, "seconds": said.seconds, "samples": int(record.length.sum())}
