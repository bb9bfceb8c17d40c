"""False alarms and accuracy through gaps: every method that handles them, on every plant it runs on.

    python benchmarks/gaps.py [PLANT ...] [--flights 40] [--samples 1200] [--page leaderboards/gaps.md]

The same flights under each pattern of missing samples: none; three gaps of 1, 5, 10, 20 or 40 samples in everything; one
sensor at every seventh sample; nothing at sample 0; all of these together. Healthy flights count those with any alarm;
their number should not exceed what a method with the calibrated rate, or its own without gaps if that is higher, has in
97.5 % of such samples. Faulty flights show what the gaps cost.
"""

import argparse
import os
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np
from scipy.special import bdtr

from fdi_gym.diagnosis import NotApplicableError, diagnosers, make_diagnoser, run
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import simulate
from fdi_gym.estimation.calibration import RATE
from fdi_gym.faults import draw
from fdi_gym.tables import markdown

GAPS = (1, 5, 10, 20, 40)  # samples
FIRST = 4_000_000  # seed; neither test nor validation nor training flights
INTRODUCTION = """# Through gaps

Written by `python benchmarks/gaps.py --page leaderboards/gaps.md`. Of {flights} healthy flights of the standard process
({samples} samples at most), those with an alarm, under each pattern of missing samples; in the last columns the share of
right labels in as many flights with their faults, whole and with all gaps together, in percent. A method with the calibrated
rate of {rate:.0%} has at most {most} such flights in 97.5 % of the cases; more than that, or than a method with its own rate
without gaps has where that is higher, is marked "!".
"""


def with_gaps(obs, sensors):
    """The flights under each pattern, by its name."""
    K, found = obs.shape[1], {"whole": obs}
    everything = obs.copy()
    everything[:, 0] = np.nan
    everything[:, ::7, sensors // 2] = np.nan
    for length in GAPS:
        gap = obs.copy()
        for k in np.linspace(K // 4, K - K // 5, 3).astype(int):
            gap[:, k : k + length] = np.nan
        found[f"{length}"] = gap
    for length, k in zip(GAPS, np.linspace(K // 5, K - K // 5, len(GAPS)).astype(int), strict=True):
        everything[:, k : k + length] = np.nan
    found["every seventh"], found["sample 0"] = obs.copy(), obs.copy()
    found["every seventh"][:, ::7, sensors // 2] = np.nan
    found["sample 0"][:, 0] = np.nan
    return found | {"all": everything}


def most(flights, rate=RATE):
    """How many of so many flights a method with this rate alarms in, at most, in 97.5 % of the cases."""
    return int(next(k for k in range(flights + 1) if bdtr(k, flights, rate) >= 0.975))


def study(plant, flights, samples):
    """A row for each method: its name, flights with an alarm under each pattern, accuracy whole and with all gaps."""
    scenarios = [draw(plant.process("standard"), FIRST + i) for i in range(flights)]
    healthy = simulate(plant, [s.without_faults() for s in scenarios]).obs[:, :samples]
    faulty = simulate(plant, scenarios)
    patterns = with_gaps(healthy, len(plant.outputs))
    hurt = with_gaps(faulty.obs[:, :samples], len(plant.outputs))
    label = faulty.label[:, :samples]
    for method, entry in diagnosers().items():
        if entry.clairvoyant:
            continue
        try:
            diagnoser = make_diagnoser(method, plant)
        except NotApplicableError:
            continue
        if not diagnoser.gaps or method == "null":
            continue
        alarms = run(diagnoser, np.concatenate(list(patterns.values()))).alarm.any(axis=1)
        counts = dict(zip(patterns, alarms.reshape(len(patterns), flights).sum(axis=1).tolist(), strict=True))
        right = [100 * (run(diagnoser, hurt[name]).label == label).mean() for name in ("whole", "all")]
        yield method, counts, right


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plants", nargs="*", default=list(plant_sources()))
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--samples", type=int, default=1200)
    parser.add_argument("--page", type=Path)
    arguments = parser.parse_args()
    limit = most(arguments.flights)
    parts = [INTRODUCTION.format(flights=arguments.flights, samples=arguments.samples, rate=RATE, most=limit)]
    for plant_id in arguments.plants:
        rows = []
        for method, counts, right in study(load_plant(plant_id), arguments.flights, arguments.samples):
            allowed = most(arguments.flights, max(RATE, counts["whole"] / arguments.flights))
            cells = [f"{count}{' !' if count > allowed else ''}" for count in counts.values()]
            rows.append([method, *cells, *(f"{value:.1f}" for value in right)])
            print(plant_id, *rows[-1], flush=True)
        head = ["method", *(f"{n} samples" if n.isdigit() else n for n in counts), "right, whole %", "right, all %"]
        parts += [f"\n## {plant_id}\n", markdown(head, rows)]
    if arguments.page:
        arguments.page.write_text("\n".join(parts).rstrip() + "\n")


if __name__ == "__main__":
    main()
