"""What a method can attain that is told nothing of the truth: Bayes' rule over the process, refined until it stands still.

    python benchmarks/attainable.py [SUITE ...] [--decisions 10] [--page leaderboards/attainable.md]
    python benchmarks/attainable.py --page-only

The suites named are flown with fresh seeds, so many decisions of each label; sections of others that the page has stay
there. The table of all suites is made of the rows in leaderboards/results.
"""

import argparse
import os
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

from sections import sections_of, write_sections

from fdi_gym.design import by_label
from fdi_gym.diagnosis import NotApplicableError, make_diagnoser, run
from fdi_gym.leaderboard import boards
from fdi_gym.metrics import outcome
from fdi_gym.scores import summarise
from fdi_gym.suite import ActingSuite, load_suite
from fdi_gym.tables import markdown

FIRST = 5_000_000  # fresh seeds: neither test nor validation nor training flights
BANKS = "onset_bank", "onset_bank_fine", "overlap_bank"
SETTINGS = {  # of the first of these methods that can run
    "onset_bank": [
        {"onsets": 2, "courses": 1},
        {"onsets": 3},
        {},
        {"onsets": 8},
        {"courses": 4},
        {"sizes": 2},
        {"every": 2},
        {"every": 1},
        {"every": 1, "onsets": 10},
    ],
    "overlap_bank": [
        {"filters": 60},
        {},
        {"onsets": 4, "filters": 200},
        {"onsets": 8, "filters": 400},
        {"courses": 5},
        {"sizes": 2},
        {"every": 5},
        {"disturbance": 4.0},
    ],
    "mode_particles": [{"particles": 8}, {"particles": 16}, {"particles": 32}, {}, {"particles": 96}, {"every": 10}],
}
SUITES = ("b747-standard", "b747-hard", "tank-standard", "missile-standard", "huav-standard")
INTRODUCTION = """# What can be attained

Written by `python benchmarks/attainable.py --page leaderboards/attainable.md`. A ceiling is told when faults begin; no
method is. What a method could reach that is told nothing but the process lies between the best such method on the board and
the ceiling. `onset_bank` is meant to close that bracket from below: Bayes' rule over all that the process leaves open (the
table has it or `onset_bank_fine`, which takes an onset at every sample, or where faults overlap `overlap_bank`, whichever is
best). It is exact where the model is linear, sizes are Gaussian and every onset is kept; the sections below show on fresh
flights how far its score moves as that is refined: where it still moves, what can be attained lies higher. Where another
method is better, it has not converged, or its model is off: gusts are bursts, and it takes them for a walk. Where sensors
fail (`*-mixed`), a bias, a drift and a gain are lines in theta, more noise and spikes are a bias that is another at each
sample, and a frozen reading must come again; spikes are rarer and larger than that, so there it is not exact.
"""


def score(name, plant, process, record, **settings):
    """Balanced accuracy per sample and per decision, log score, and the time [us] per sample."""
    method, begun = make_diagnoser(name, plant, process=process, **settings), time.process_time()
    said = run(method, record.obs)
    spent = time.process_time() - begun
    scoring = plant.process(process).scoring
    outcomes = [outcome(plant, scoring, record, said, i) for i in range(len(record.length))]
    found = summarise(outcomes, len(plant.labels), [s.name for s in plant.estimated], plant.dt)
    return found, 1e6 * spent / record.length.sum()


def method_for(plant, process):
    """The first method that can run there."""
    for name in SETTINGS:
        try:
            make_diagnoser(name, plant, process=process)
        except NotApplicableError:
            continue
        return name
    raise SystemExit(f"none of {', '.join(SETTINGS)} can run on {plant.id}")


def refined(fresh, name):
    """A row for each setting of a method: of the flights of a suite."""
    plant = fresh.build()
    record = fresh.record(plant, range(fresh.episodes))
    for settings in SETTINGS[name]:
        found, spent = score(name, plant, fresh.process, record, **settings)
        told = ", ".join(f"{key} {value}" for key, value in settings.items()) or "as it is"
        yield [told, *(f"{100 * found[kind]['balanced_accuracy']:.1f}" for kind in ("per_sample", "per_decision")),
               f"{found['log_score']:.3f}", f"{spent:.0f}"]  # fmt: skip


def brackets(results):
    """A row for each suite that has a ceiling: the best without the bank, the bank, the ceiling."""
    for board in boards(results):
        top = board.top()
        if isinstance(board.suite, ActingSuite) or top is None:
            continue

        def of(row):
            return row.metrics["per_sample"]["balanced_accuracy"]

        others = sorted((row for row in board.honest() if row.diagnoser not in BANKS), key=of)
        bank = max((row for row in board.rows if row.diagnoser in BANKS), key=of, default=None)
        if not others:
            continue
        best = others[-1]
        low = max(of(best), of(bank) if bank else 0.0)
        yield [f"[{board.suite.name}]({board.suite.name}.md)", f"{best.diagnoser} {100 * of(best):.1f}",
               f"{bank.diagnoser} {100 * of(bank):.1f}" if bank else "-", f"{top.diagnoser} {100 * of(top):.1f}",
               f"{100 * (of(top) - of(best)):.1f}", f"{100 * max(of(top) - low, 0.0):.1f}"]  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", default=SUITES)
    parser.add_argument("--decisions", type=int, default=10, help="of each label")
    parser.add_argument("--results", type=Path, default=Path("leaderboards/results"))
    parser.add_argument("--page", type=Path, default=Path("leaderboards/attainable.md"))
    parser.add_argument("--page-only", action="store_true", help="measure nothing: the table of all suites anew")
    arguments = parser.parse_args()
    head = ["suite", "best without it, per sample %", "the bank", "ceiling", "bracket before", "and with it"]
    sections = {name: text for name, text in sections_of(arguments.page).items() if name != "All suites"}

    def write():
        table = markdown(head, list(brackets(arguments.results)))
        write_sections(arguments.page, INTRODUCTION, {"All suites": table, **sections})

    for name in () if arguments.page_only else arguments.suites:
        suite, rows = by_label(load_suite(name), arguments.decisions, first_seed=FIRST), []
        method = method_for(suite.build(), suite.process)
        for row in refined(suite, method):
            rows.append(row)
            print(name, *row, sep="  ", flush=True)
        table = markdown(["settings", "per sample %", "per decision %", "log score", "us/sample"], rows)
        sections[name] = f"`{method}`, {suite.episodes} fresh flights.\n\n{table}"
        write()
    write()


if __name__ == "__main__":
    main()
