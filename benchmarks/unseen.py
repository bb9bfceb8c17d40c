"""Faults that no method was told of: how often a method names one as a fault that it knows, and what "something else" does.

    python benchmarks/unseen.py [PLANT ...] [--methods multiple_model_ekf sequence_net] [--flights 40] [--mismatch 0.1]
                                [--page leaderboards/unseen.md]

Sections of other plants that the page has stay there.
"""

import argparse
import os
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np
from scipy.stats import mannwhitneyu
from sections import sections_of, share, write_sections

from fdi_gym.diagnosis import NotApplicableError, diagnosers, make_diagnoser
from fdi_gym.diagnosis.conforming import decided, of_each_label
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.tables import markdown
from fdi_gym.unseen import SOMETHING_ELSE

KNOWN, UNSEEN = 4_700_000, 4_800_000  # first seeds; neither test nor validation nor training flights
CONFORMAL = "conformal_"
METHODS = [name.removeprefix(CONFORMAL) for name in diagnosers() if name.startswith(CONFORMAL)]
HEAD = ["method", "known: right before %", "with %", "called something else %", "off the model %", "unseen: named before %",
        "with %", "something else %", "AUROC"]  # fmt: skip
INTRODUCTION = """# Faults that nobody was told of

Written by `python benchmarks/unseen.py --page leaderboards/unseen.md`. Known flights are of each label alike many, of the
standard process; unseen ones have a fault of a sensor (`fdi_gym.unseen`), of which no method is told. A method by itself
can only name a fault that it knows, or none; `conformal_<method>` may answer "something else", and calls a known flight so
with a probability of at most 5 %, whichever label it has, where it is decided: at the end of its first fault, or of the
flight. "Off the model" are the same known flights on a plant whose parameters are off by so much as is said, for which
nothing is promised. AUROC is the probability that an unseen flight looks less like anything known than a known one does.
Percent with 95 % intervals (Clopper and Pearson), AUROC with one of resampled flights.
"""


def area(unseen, known):
    """The area under the curve of one score against the other, with its interval."""

    def found(a, b):
        return mannwhitneyu(a, b).statistic / (len(a) * len(b))

    rng = np.random.default_rng(0)
    again = [found(rng.choice(unseen, len(unseen)), rng.choice(known, len(known))) for _ in range(1000)]
    return f"{found(unseen, known):.2f} ({np.quantile(again, 0.025):.2f}-{np.quantile(again, 0.975):.2f})"


def off_the_model(plant, scenarios, level):
    """The same flights of a plant whose parameters are off by a level."""
    rng = np.random.default_rng(KNOWN)
    return [scenario.replace(physical=dict(plant.perturb(rng, level))) for scenario in scenarios]


def study(plant, methods, count, level):
    """A row for each method that can run."""
    other, known = len(plant.labels) - 1, of_each_label(plant.bare, "standard", KNOWN, count)
    unseen = [
        s for s in of_each_label(plant, "unseen", UNSEEN, 2 * count) if any(f.mode == SOMETHING_ELSE for f in s.faults)
    ]
    off = off_the_model(plant, known, level) if plant.perturb is not None else []
    for name in methods:
        try:
            conformal = make_diagnoser(CONFORMAL + name, plant, process="unseen")
        except NotApplicableError as reason:
            print(f"{plant.id}: {name}: {reason}", flush=True)
            continue
        method = make_diagnoser(name, plant, process="unseen")
        (score, label, said), (strange, _, answer) = (decided(conformal, plant, some) for some in (known, unseen))
        before, named = (decided(method, plant, some, score="")[2] for some in (known, unseen))
        yield [name, share(before == label), share(said == label), share(said == other),
               share(decided(conformal, plant, off)[2] == other) if off else "-", share(named > 0),
               share((answer > 0) & (answer < other)), share(answer == other), area(strange, score)]  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plants", nargs="*", default=list(plant_sources()))
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--mismatch", type=float, default=0.1)
    parser.add_argument("--page", type=Path)
    arguments = parser.parse_args()
    sections = sections_of(arguments.page)
    for plant_id in arguments.plants:
        rows = []
        for row in study(load_plant(plant_id, unseen=True), arguments.methods, arguments.flights, arguments.mismatch):
            rows.append(row)
            print(plant_id, *row, sep="  ", flush=True)
        n, level = arguments.flights, 100 * arguments.mismatch
        said = f"{n} known flights of each label, where so many are met, {2 * n} unseen ones; off the model by {level:g} %."
        sections[plant_id] = f"{said}\n\n{markdown(HEAD, rows)}"
        if arguments.page:
            write_sections(arguments.page, INTRODUCTION, sections)


if __name__ == "__main__":
    main()
