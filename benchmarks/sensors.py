"""What is found of failing sensors, plant by plant and kind by kind, and whether they are told from the plant's own faults.

    python benchmarks/sensors.py [--page leaderboards/sensors.md]

Made of the rows of the suites whose process is "mixed".
"""

import argparse
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from learning_page import LEARNED, best
from sections import share, write_sections

from fdi_gym.leaderboard import read_board
from fdi_gym.sensors import KINDS
from fdi_gym.suite import load_suite
from fdi_gym.tables import ceiling, clairvoyant, markdown

ALL, OWN, HEALTHY = "All plants", "the plant's own", "healthy"
INTRODUCTION = """# Sensors that fail

Written by `python benchmarks/sensors.py` from the rows of the suites `*-mixed`: half of the faulty flights have a sensor's
fault in place of the plant's own. `fdi_gym.sensors` says what each kind is and how large; where a suite has another severity
its page says so. The first table of each plant gives the share of right decisions, one for each window of a fault and each
healthy flight, in percent; methods marked "*" know a part of the truth. The second gives more of the best filter, the best
learned method and the highest ceiling, with 95 % intervals (Clopper and Pearson): how many of the faults that begin from
healthy are detected, the median time until then, and the confusion that matters, a sensor's fault taken for one of the
plant's own or the reverse. "False alarms" are healthy flights that are declared faulty.

The general filters know biases as lines of the fault vector, and check each channel for readings that repeat, have grown
noisier or jump; a gain is neither. The banks over events (`onset_bank`, `overlap_bank`) are told how the process draws kinds
and sizes, and weigh each kind of each sensor since each onset.
"""


class Found(NamedTuple):
    """What was said of the faults of one kind."""

    right: list[bool]
    crossed: list[bool]  # of the decisions: a sensor's fault taken for the plant's own, or the reverse
    declared: list[bool]  # a fault, whichever
    detected: list[bool]
    delays: list[int]  # samples, of those detected


def by_kind(plant, scenarios, outcomes):
    """What a row says of each kind of fault.

    Args:
        plant: The plant whose sensors may fail.
        scenarios: Of the flights.
        outcomes: Of the flights, of one method.
    """
    own, found = len(plant.bare.labels), defaultdict(lambda: Found([], [], [], [], []))
    for scenario, outcome in zip(scenarios, outcomes, strict=True):
        kinds = defaultdict(list)
        for fault in scenario.faults:
            kinds[fault.mode].append(fault.kind)
        for what in (outcome.decisions, outcome.onsets):
            met = defaultdict(int)
            for entry in what:
                of_sensor = entry.label >= own
                name = OWN if entry.label else HEALTHY
                if of_sensor:
                    mode = plant.labels[entry.label].name
                    name = kinds[mode][met[mode]]
                    met[mode] += 1
                to = found[name]
                if what is outcome.decisions:
                    to.right.append(entry.declared == entry.label)
                    to.declared.append(entry.declared > 0)
                    to.crossed.append(0 < entry.declared < own if of_sensor else entry.declared >= own)
                elif entry.fresh and not entry.alarmed:
                    to.detected.append(entry.detection is not None)
                    to.delays.extend([] if entry.detection is None else [entry.detection])
    return found


def shown(board):
    """The best filter, the best learned method and the highest ceiling of a board, where it has them."""
    learned = [row for row in board.honest() if row.diagnoser in LEARNED]
    filters = [row for row in board.honest() if row.diagnoser not in LEARNED]
    return [row for row in (best(filters), best(learned), board.top()) if row]


def summary(board, found):
    """A line for each of a board's chosen methods: scores, and sensors against the plant's own."""
    for row in shown(board):
        f = found[row.diagnoser]
        right, crossed = (
            np.concatenate([np.array(part, bool) for part in parts])
            for parts in ([f[kind].right for kind in KINDS], [f[kind].crossed for kind in KINDS])
        )
        scores = (f"{100 * row.metrics[kind]['balanced_accuracy']:.1f}" for kind in ("per_sample", "per_decision"))
        own = f[OWN]
        yield [board.suite.plant, row.diagnoser + " *" * ceiling(row), *scores, share(right), share(np.array(own.right)),
               share(crossed), share(np.array(own.crossed))]  # fmt: skip


def section(board, found):
    """What is said of a plant."""
    plant, kinds = board.plant, [*KINDS, OWN, HEALTHY]
    ranked = sorted(board.rows, key=lambda row: -row.metrics["per_decision"]["balanced_accuracy"])

    def percent(row, kind):
        right = found[row.diagnoser][kind].right
        return f"{100 * np.mean(right):.0f}" if right else "-"

    count = {kind: len(found[ranked[0].diagnoser][kind].right) for kind in kinds}
    every = markdown(
        ["method", *(f"{kind} ({count[kind]})" for kind in kinds)],
        [[row.diagnoser + " *" * clairvoyant(row), *(percent(row, kind) for kind in kinds)] for row in ranked],
    )
    lines = []
    for row in shown(board):
        for kind in kinds:
            f = found[row.diagnoser][kind]
            if not f.right:
                continue
            right, declared, crossed, detected = (np.array(a, bool) for a in (f.right, f.declared, f.crossed, f.detected))
            delay = f"{np.median(f.delays) * plant.dt:.2f} s" if f.delays else "-"
            if kind == HEALTHY:
                lines.append([row.diagnoser, "false alarms", share(declared), "", "", share(crossed)])
            else:
                seen = share(detected) if detected.size else "-"
                lines.append([row.diagnoser, kind, seen, delay, share(right), share(crossed)])
    head = ["method", "what fails", "detected %", "median delay", "right label %", "sensor for plant, or reverse %"]
    told = f"[{board.suite.name}]({board.suite.name}.md): {board.suite.description}."
    return f"{told}\n\nRight decisions in percent (how many there are):\n\n{every}\n\nIn detail:\n\n{markdown(head, lines)}"


def page(results):
    """The page's sections by name."""
    folders = [folder for folder in sorted(results.iterdir()) if load_suite(folder.name).process == "mixed"]
    sections, lines = {}, []
    for board in map(read_board, folders):
        scenarios = board.suite.scenarios(board.plant, range(board.suite.episodes))
        found = {name: by_kind(board.plant, scenarios, outcomes) for name, outcomes in board.outcomes.items()}
        sections[board.suite.plant] = section(board, found)
        lines += summary(board, found)
    head = ["plant", "method", "per sample %", "per decision %", "right: sensors %", "the plant's own %",
            "a sensor's taken for the plant's %", "the plant's for a sensor's %"]  # fmt: skip
    return {ALL: "Best filter, best learned method, highest ceiling.\n\n" + markdown(head, lines), **sections}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("leaderboards/results"))
    parser.add_argument("--page", type=Path, default=Path("leaderboards/sensors.md"))
    arguments = parser.parse_args()
    write_sections(arguments.page, INTRODUCTION, page(arguments.results))


if __name__ == "__main__":
    main()
