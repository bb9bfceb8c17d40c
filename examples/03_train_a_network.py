"""Train the supervised network for a few seconds, look at what it learned, and use it. The real thing: fdi-gym train."""

import argparse
from pathlib import Path
from tempfile import mkdtemp

from baselines.learned import weights
from baselines.learned._supervised import SupervisedTraining
from baselines.learned.features import FeatureShape
from baselines.learned.flights import Condition
from baselines.learned.recipes import SequenceRecipe
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.faults import draw

# Change the block length, the memory of the identified model, the width, the flights: what pays?
parser = argparse.ArgumentParser()
parser.add_argument("--flights", type=int, default=64)
flights = parser.parse_args().flights
recipe = SequenceRecipe(
    conditions=(Condition("standard", {}),), shape=FeatureShape(stride=10, lags=5, degree=1),
    flights=flights, identify=50, chunk=min(64, flights), passes=4, validate=4, validation=20, hidden=32,
)  # fmt: skip

if __name__ == "__main__":
    plant = load_plant("B747Lateral")
    path = SupervisedTraining("sequence_net", plant, recipe, seed=0, work=Path(mkdtemp())).run()
    card = weights.read_card(path)
    for entry in card.curve:
        print(f"step {entry['step']:4d}, {entry['seconds']:5.1f} s: balanced accuracy {entry['accuracy']['standard']:.3f}")
    before, after = card.calibration["standard"].log_score
    print(f"log score on validation flights: {before:.3f}, calibrated {after:.3f}")
    seen = simulate(plant, [draw(plant.process("standard"), seed) for seed in range(20)])
    said = run(make_diagnoser("sequence_net", plant, path=str(path)), seen.obs)
    print("right labels:", (said.label == seen.label)[:, 1:].mean().round(3))
