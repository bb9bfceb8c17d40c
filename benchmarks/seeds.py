"""How much a network's score depends on the seed of its training: trains it again with other seeds, scores all on suites.

    python benchmarks/seeds.py B747Lateral [--methods sequence_net residual_net ppo] [--seeds 3] [--budget N] [--work runs]
                               [--page leaderboards/learning/seeds.md]

Seed 0 is trained again too: the weights that ship may be of earlier flights. A run that was killed goes on from its
checkpoints in the folder `--work`. Sections of other plants that the page has stay there.
"""

import argparse
import os
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import msgspec
import numpy as np
from sections import sections_of, write_sections

from fdi_gym.diagnosis import train
from fdi_gym.discovery import load_plant
from fdi_gym.evaluation import evaluate
from fdi_gym.suite import ActingSuite, load_suite, suite_names
from fdi_gym.tables import markdown

PROCESSES = ("standard", "hard")
INTRODUCTION = """# Other seeds of training

Written by `python benchmarks/seeds.py`. Each network is trained anew with several seeds: other initial weights, other
training flights; `residual_net` starts from the `sequence_net` of its seed. All are scored on the suites' flights; balanced
accuracy per sample in percent, and its standard deviation over the seeds. The interval is that of the first seed's score:
how sure it is for the flights of the suite, all other things equal. Where the seeds differ by more than that, a difference
between two networks is no difference between two methods.
"""


def suites_of(plant):
    """The suites of a plant with the processes that networks are trained on, at its usual options."""
    for suite in map(load_suite, suite_names()):
        usual = suite.plant == plant.id and suite.options == dict(plant.options)
        if usual and suite.process in PROCESSES and suite.mismatch is None and not isinstance(suite, ActingSuite):
            yield suite


def score(suite, method, path, work):
    """Balanced accuracy per sample of these weights, with its interval."""
    told = msgspec.structs.replace(suite, settings={method: {"path": str(path.resolve())}})
    found = evaluate(told, [method], work=work, jobs=1, progress=False)[method].row.metrics["per_sample"]
    return found["balanced_accuracy"], found["balanced_accuracy_interval"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plant")
    parser.add_argument("--methods", nargs="+", default=["sequence_net", "residual_net", "ppo"])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget", type=int, help="of each training; default: the recipe's")
    parser.add_argument("--work", type=Path, default=Path("runs"))
    parser.add_argument("--page", type=Path, default=Path("leaderboards/learning/seeds.md"))
    arguments = parser.parse_args()
    plant, rows = load_plant(arguments.plant), []
    suites = list(suites_of(plant))
    for method in arguments.methods:
        found = []
        for seed in range(arguments.seeds):
            path = train(method, plant, budget=arguments.budget, seed=seed, work=arguments.work)
            found.append([score(suite, method, path, arguments.work) for suite in suites])
            print(method, seed, *(f"{suite.name} {100 * s:.1f}" for suite, (s, _) in zip(suites, found[-1], strict=True)),
                  flush=True)  # fmt: skip
        for suite, per_seed in zip(suites, zip(*found, strict=True), strict=True):
            scores = 100 * np.array([s for s, _ in per_seed])
            low, high = per_seed[0][1]
            rows.append([suite.name, method, *(f"{s:.1f}" for s in scores), f"{scores.std(ddof=1):.1f}",
                         f"{100 * low:.1f}-{100 * high:.1f}"])  # fmt: skip
    head = ["suite", "network", *(f"seed {i}" for i in range(arguments.seeds)), "standard deviation", "interval of seed 0"]
    sections = sections_of(arguments.page)
    sections[plant.id] = markdown(head, sorted(rows, key=lambda row: row[0]))
    write_sections(arguments.page, INTRODUCTION, sections)


if __name__ == "__main__":
    main()
