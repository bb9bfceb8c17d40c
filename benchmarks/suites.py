"""How the committed suites were drawn, and what is in them.

    python benchmarks/suites.py            the table: flights, samples, decisions of each label
    python benchmarks/suites.py --draw     draws all of them again, which gives the files that are there

Satellite flights are long: the windows of three standard flights follow one another in one, five times as fast (ten times
where sensors fail as well, since there are 26 labels), and the hard flights are cut after 50 s. The papers' scenarios are
flown as they are, at 30 noise seeds; they hold only the labels that the paper has.
"""

import argparse

import msgspec
import numpy as np

from fdi_gym.design import by_label, truths
from fdi_gym.suite import load_suite, suite_names
from fdi_gym.tables import markdown

PAPERS = ("b747-paper", "huav-paper", "missile-paper", "cmg-paper")  # 30 flights of the paper's scenario
DECISIONS = {"b747-standard": 50, "b747-hard": 40, "missile-standard": 40}  # others: 30
SHAPES = {
    "cmg-standard": {"windows": 3, "pace": 0.2}, "cmg-dropout": {"windows": 3, "pace": 0.2},
    "cmg-mixed": {"windows": 3, "pace": 0.1}, "cmg-hard": {"steps": 5000},
}  # fmt: skip


def drawn(suite):
    """The suite with its seeds drawn anew."""
    suite = msgspec.structs.replace(suite, **SHAPES.get(suite.name, {}))
    if suite.name in PAPERS:
        seeds = list(range(1_000_000, 1_000_030))
        return msgspec.structs.replace(suite, seeds=seeds, healthy=[]).sealed()
    return by_label(suite, DECISIONS.get(suite.name, 30)).sealed()


def line(suite):
    """What is in a suite."""
    plant = suite.build()
    scenarios = suite.scenarios(plant, range(suite.episodes))
    labels = np.bincount([v for s in scenarios for v in truths(plant, suite.process, s)], minlength=len(plant.labels))
    samples, healthy = sum(s.steps for s in scenarios), len(suite.healthy) // suite.windows
    return [suite.name, str(suite.episodes), str(healthy), f"{samples / 1000:.0f}", ", ".join(map(str, labels))]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", action="store_true", help="draw them again and compare")
    arguments = parser.parse_args()
    rows = []
    for name in suite_names():
        suite = load_suite(name)
        if arguments.draw and drawn(suite) != suite:
            raise SystemExit(f"{name}: another suite than the one that is there")
        rows.append(line(suite))
    print(markdown(["suite", "flights", "of them made healthy", "thousand samples", "decisions of each label"], rows))
