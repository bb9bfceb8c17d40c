"""False alarms and accuracy through gaps: every method that handles them, on every plant it runs on.

    python benchmarks/gaps.py [PLANT ...] [--flights 40 ...] [--samples 1200 ...] [--methods NAME ...]
        [--page leaderboards/gaps.md] [--finished]

Numbers of flights and samples are one for all plants or one for each; `--finished` makes the page of what is there.

The same flights under each pattern of missing samples: none; three gaps of 1, 5, 10, 20 or 40 samples in everything; one
sensor at every seventh sample; nothing at sample 0; all of these together. Healthy flights count those with any alarm;
their number should not exceed what a method with the calibrated rate, or its own without gaps if that is higher, has in
97.5 % of such samples. Faulty flights show what the gaps cost. What is finished is kept in the work folder, by the digests
of what made it, so that a run goes on where it was killed.
"""

import argparse
import os
import sys
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import msgspec
import numpy as np
from scipy.special import bdtr
from scipy.stats import binomtest

from fdi_gym.diagnosis import NotApplicableError, diagnosers, make_diagnoser, run
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import simulate
from fdi_gym.estimation.calibration import RATE
from fdi_gym.faults import draw
from fdi_gym.files import digest, write_whole
from fdi_gym.provenance import provenance
from fdi_gym.tables import markdown

GAPS = (1, 5, 10, 20, 40)  # samples
FIRST = 4_000_000  # seed; neither test nor validation nor training flights
INTRODUCTION = """# Through gaps

Written by `python benchmarks/gaps.py {command}`, of methods that handle missing
samples themselves; those that are not named were not run. So many healthy flights of the standard process had an alarm,
whole and under each pattern of missing samples: three gaps of 1, 5, 10, 20 or 40 samples in everything, one sensor at every
seventh sample, nothing at sample 0, all of these together. A
method is calibrated so that {rate:.0%} of the healthy flights alarm. "!" marks more flights than a method with that rate, or
with its own without gaps where that is higher, has in 97.5 % of the cases. The last columns are the share of right labels
in as many flights with their faults, whole and with all gaps together.
"""
SECTION = """
## {plant}

{flights} flights, {samples} samples at most. Up to {most} flights with an alarm agree with {rate:.0%}. 95 % intervals of the
rates (Wilson): {intervals}.
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


class Found(msgspec.Struct):
    """Of one method: flights with an alarm under each pattern, and the share of right labels, whole and with all gaps."""

    alarms: dict[str, int]
    right: tuple[float, float]


def applicable(plant, names):
    """The methods that can run on the plant, know nothing of the truth and handle gaps."""
    for name, entry in diagnosers().items():
        if not entry.clairvoyant and name != "null" and (not names or name in names):
            try:
                diagnoser = make_diagnoser(name, plant)
            except NotApplicableError:
                continue
            if diagnoser.gaps:
                yield name, diagnoser


def study(plant, flights, samples, names, work, finished=False):
    """What became of each method, by its name; with `finished` of those that are there."""
    scenarios = [draw(plant.process("standard"), FIRST + i) for i in range(flights)]
    healthy = simulate(plant, [s.without_faults() for s in scenarios]).obs[:, :samples]
    faulty = simulate(plant, scenarios)
    patterns = with_gaps(healthy, len(plant.outputs))
    hurt = with_gaps(faulty.obs[:, :samples], len(plant.outputs))
    label = faulty.label[:, :samples]
    for name, diagnoser in applicable(plant, names):
        made = digest([provenance(name, plant, "standard", {}), flights, samples, FIRST, sorted(patterns)])
        path = work / f"{plant.id}-{name}-{made[:12]}.json"
        if not path.exists() and finished:
            continue
        if not path.exists():
            said = run(diagnoser, np.concatenate([*patterns.values(), hurt["whole"], hurt["all"]]))
            counts = said.alarm.any(axis=1).reshape(-1, flights).sum(axis=1).tolist()
            right = 100 * (said.label.reshape(-1, *label.shape)[-2:] == label).mean(axis=(1, 2))
            alarms = dict(zip(patterns, counts[:-2], strict=True))
            write_whole(path, msgspec.json.encode(Found(alarms, (float(right[0]), float(right[1])))))
        yield name, msgspec.json.decode(path.read_bytes(), type=Found)


def section(plant, flights, samples, found):
    """A plant's part of the page."""
    rows, seen = [], set()
    for name, (alarms, right) in ((name, (f.alarms, f.right)) for name, f in found.items()):
        allowed = most(flights, max(RATE, alarms["whole"] / flights))
        cells = [f"{count}{' !' if count > allowed else ''}" for count in alarms.values()]
        rows.append([name, *cells, *(f"{value:.1f}" for value in right)])
        seen |= set(alarms.values())
    intervals = []
    for count in sorted(seen):
        low, high = binomtest(count, flights).proportion_ci(method="wilson")
        intervals.append(f"{count}: {100 * low:.0f} to {100 * high:.0f} %")
    patterns = next(iter(found.values())).alarms
    head = ["method", *(f"{n} samples" if n.isdigit() else n for n in patterns), "right, whole %", "right, all %"]
    about = SECTION.format(plant=plant, flights=flights, samples=samples, most=most(flights), rate=RATE,
                           intervals=", ".join(intervals))  # fmt: skip
    return f"{about}\n{markdown(head, rows)}\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plants", nargs="*", default=list(plant_sources()))
    parser.add_argument("--flights", type=int, nargs="+", default=[40])
    parser.add_argument("--samples", type=int, nargs="+", default=[1200])
    parser.add_argument("--methods", nargs="*", default=[])
    parser.add_argument("--work", type=Path, default=Path("runs/gaps"))
    parser.add_argument("--page", type=Path)
    parser.add_argument("--finished", action="store_true")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    parts = [INTRODUCTION.format(rate=RATE, command=" ".join(sys.argv[1:]))]
    for i, plant_id in enumerate(arguments.plants):
        found = {}
        about = [values[min(i, len(values) - 1)] for values in (arguments.flights, arguments.samples)]
        for name, mine in study(load_plant(plant_id), *about, arguments.methods, arguments.work, arguments.finished):
            found[name] = mine
            print(plant_id, name, *mine.alarms.values(), *(f"{value:.1f}" for value in mine.right), flush=True)
        parts.append(section(plant_id, *about, found))
    if arguments.page:
        write_whole(arguments.page, "".join(parts).encode())


if __name__ == "__main__":
    main()
