"""What is found of failing sensors, plant by plant and kind by kind, and whether they are told from the plant's own faults.

    python benchmarks/sensors.py [PLANT ...] [--methods augmented_ekf told_source_oracle] [--flights 40]
                                 [--page leaderboards/sensors.md]

Flights whose sensors fail in one way each, flights with the plant's own standard faults, and healthy ones; the methods know
the process "mixed". What counts is what is declared at the flight's last sample. Sections of other plants that the page has
stay there.
"""

import argparse
import os
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np
from scipy.stats import binomtest

from fdi_gym.diagnosis import NotApplicableError, make_diagnoser, run
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import simulate
from fdi_gym.faults import draw
from fdi_gym.sensors import KINDS, of_kind
from fdi_gym.tables import markdown

FIRST = 4_600_000  # seed; neither test nor validation nor training flights
METHODS = ("augmented_ekf", "multiple_model_ekf", "sequence_net", "told_source_oracle")
INTRODUCTION = """# Sensors that fail

Written by `python benchmarks/sensors.py --page leaderboards/sensors.md`. In each row flights in which a sensor fails in one
way (`fdi_gym.sensors` says how much), in which the plant's own standard faults act, or healthy ones; a method knows the
process "mixed", not which of these it meets, and what counts is what it declares at the flight's last sample.
`sequence_net` was trained on that process, where it is there; `told_source_oracle` is a ceiling: it is told when the label
changes and whether a sensor fails. Percent, with 95 % intervals (Clopper and Pearson); the delay is the median time from the
onset to the alarm of those that are found. "as the plant's" are flights whose sensor failed and that are called one of the
plant's own faults; for the plant's own faults it is the reverse.
"""


def flights_of(plant, what, count):
    """So many flights of a kind of sensor fault, of the plant's own faults, or healthy."""
    processes = {"plant": plant.bare.process("standard"), "healthy": plant.process("fault-free")}
    process, found, seed = processes[what] if what in processes else of_kind(plant, what), [], FIRST
    while len(found) < count:
        scenario = draw(process, seed)
        found += [scenario] if scenario.faults or what == "healthy" else []
        seed += 1
    return found


def share(hits):
    """A share in percent with its interval."""
    low, high = binomtest(int(hits.sum()), hits.size).proportion_ci(0.95)
    return f"{100 * hits.mean():.0f} ({100 * low:.0f}-{100 * high:.0f})"


def study(plant, methods, count):
    """A row for each method and kind."""
    own = len(plant.bare.labels)
    for what in (*KINDS, "plant", "healthy"):
        scenarios = flights_of(plant, what, count)
        record = simulate(plant, scenarios)
        rows, last = np.arange(count), record.length
        truth = record.label[rows, last]
        for name in methods:
            try:
                diagnoser = make_diagnoser(name, plant, process="mixed", scenarios=scenarios)
            except NotApplicableError:
                continue
            said = run(diagnoser, record.obs)
            label = said.label[rows, last]
            if what == "healthy":
                yield [name, what, share(said.alarm.any(axis=1)), "", "", ""]
                continue
            acts = record.label > 0
            onset = acts.argmax(axis=1)
            alarmed = said.alarm & acts
            found = alarmed.any(axis=1)
            delay = np.median((alarmed.argmax(axis=1) - onset)[found]) * plant.dt if found.any() else np.nan
            other = (label >= own) if what == "plant" else (label > 0) & (label < own)
            yield [name, what, share(label > 0), share(label == truth), f"{delay:.2f} s", share(other)]


def sections_of(page):
    """What a page says of each plant."""
    parts = page.read_text().split("\n## ")[1:] if page is not None and page.is_file() else []
    return {name: text.strip() for name, text in (part.split("\n", 1) for part in parts)}


def write_sections(page, introduction, sections):
    """The page: what it is about, and a section for each plant."""
    parts = [introduction, *(f"\n## {name}\n\n{text}" for name, text in sorted(sections.items()))]
    page.write_text("\n".join(parts).rstrip() + "\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plants", nargs="*", default=list(plant_sources()))
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--page", type=Path)
    arguments = parser.parse_args()
    head = ["method", "what fails", "alarm %", "right label %", "delay", "as the plant's %"]
    sections = sections_of(arguments.page)
    for plant_id in arguments.plants:
        rows = []
        for row in study(load_plant(plant_id, sensor_faults=True), arguments.methods, arguments.flights):
            rows.append(row)
            print(plant_id, *row, flush=True)
        table = markdown(head, sorted(rows, key=lambda row: arguments.methods.index(row[0])))
        sections[plant_id] = f"{arguments.flights} flights a row.\n\n{table}"
        if arguments.page:
            write_sections(arguments.page, INTRODUCTION, sections)


if __name__ == "__main__":
    main()
