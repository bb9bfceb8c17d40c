"""How often the printed 95 % intervals hold the truth, on every standard and hard suite: writes leaderboards/coverage.md.

Each repetition draws a suite anew from a pool of 1,500 flights (5,000 for the helicopter) of its process, by the rule by
which the suite was drawn, and lets a method that errs in a known way answer on it. How well it does differs between labels,
between flights (all windows of a flight err together) and between windows; within a window the share of right samples is a
beta variable, and the decision is right where more than half of the samples are. The truth is the balanced accuracy over
all repetitions together. Three methods are tried: poor, middling and good. The percentile bootstrap, within strata, on the
first quarter of the repetitions, is what the intervals are held against.

    python benchmarks/coverage.py --repetitions 1000 --jobs 2
"""

import argparse
import importlib.util
from pathlib import Path
from typing import NamedTuple

import joblib
import msgspec
import numpy as np

from fdi_gym.files import write_whole
from fdi_gym.intervals import balanced_interval, resamples, strata
from fdi_gym.metrics import scored_samples, windows
from fdi_gym.suite import load_suite, suite_names
from fdi_gym.tables import markdown

PAGE = Path(__file__).parent.parent / "leaderboards" / "coverage.md"
METHODS = {"poor": 0.3, "middling": 1.5, "good": 3.0}  # mean log odds of a right sample
LABELS, FLIGHTS, WINDOWS, CONCENTRATION = 0.7, 0.5, 0.7, 3.0  # spreads of the log odds, and of the beta variable
BOOTSTRAP = 400


class Flight(NamedTuple):
    """What is true of a flight, as far as scores see it."""

    decisions: list[int]
    held: int  # the same labels, as bits
    label: np.ndarray  # of its answers: windows, and the healthy samples where there are windows
    samples: np.ndarray  # scored, of each
    decides: np.ndarray  # whether there is a decision about it


def script(name):
    """A script beside this one, as a module."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pool_of(suite, plant, count):
    """Flights of a suite's process, as the suite flies them; of those made healthy, as many as would be."""
    w = suite.windows
    seeds = list(range(10_000_000, 10_000_000 + count * w))
    healthy = list(range(20_000_000, 20_000_000 + len(suite.healthy)))
    many, scoring, found = (
        msgspec.structs.replace(suite, seeds=seeds, healthy=healthy),
        plant.process(suite.process).scoring,
        [],
    )
    for scenario in many.scenarios(plant, range(many.episodes)):
        label = plant.label_rows(scenario)
        scored = scored_samples(label, scenario.steps, scoring)
        asked = windows(label, scenario.steps, scored)
        labels, samples = [v for *_, v in asked], [int(scored[first:stop].sum()) for first, stop, _ in asked]
        rest = int((scored & (label == 0)).sum()) if 0 not in labels else 0
        found.append(Flight(labels, sum(1 << v for v in set(labels)), np.array([*labels, 0]), np.array([*samples, rest]),
                            np.array([True] * len(labels) + [False])))  # fmt: skip
    return found[:count], found[count:]


def drawn(rng, pool, healthy, labels, decisions):
    """A suite: flights taken in random order while they help, and the healthy ones that are made."""
    held, taken, short = [0] * labels, [], (1 << labels) - 1
    for i in rng.permutation(len(pool)):
        if pool[i].held & short:
            taken.append(pool[i])
            for label in pool[i].decisions:
                held[label] += 1
                if held[label] == decisions:
                    short &= ~(1 << label)
            if not short:
                break
    return taken + healthy[: max(0, decisions - held[0])]


def answered(rng, flights, odds):
    """(right, all) answers (N, labels), per sample and per decision."""
    of = np.repeat(np.arange(len(flights)), [len(flight.label) for flight in flights])
    label, samples, decides = (
        np.concatenate([getattr(f, name) for f in flights]) for name in ("label", "samples", "decides")
    )
    mood = FLIGHTS * rng.standard_normal(len(flights))
    p = 1 / (1 + np.exp(-(odds[label] + mood[of] + WINDOWS * rng.standard_normal(len(label)))))
    share = rng.beta(p * CONCENTRATION, (1 - p) * CONCENTRATION)
    right, all_ = np.zeros((2, len(flights), len(odds))), np.zeros((2, len(flights), len(odds)))
    np.add.at(right[0], (of, label), np.round(share * samples))
    np.add.at(all_[0], (of, label), samples)
    np.add.at(right[1], (of, label), decides & (share > 0.5))
    np.add.at(all_[1], (of, label), decides)
    return right, all_


def percentile(right, all_, stratum):
    """The bootstrap's interval."""
    weights = resamples(stratum, BOOTSTRAP)
    total = weights @ all_
    scores = np.where(total > 0, (weights @ right) / np.maximum(total, 1), np.nan)
    return np.percentile(np.nanmean(scores[:, all_.sum(axis=0) > 0], axis=1), [2.5, 97.5])


def study(name, repetitions):
    """The lines of one suite."""
    suite = load_suite(name)
    plant = suite.build()
    pool, healthy = pool_of(suite, plant, 5000 if plant.id == "HUAVHover" else 1500)
    decisions = script("suites").DECISIONS.get(name, 30)
    return [[name, *line(pool, healthy, len(plant.labels), decisions, repetitions, method)] for method in METHODS]


def line(pool, healthy, labels, decisions, repetitions, method):
    """How one method fares: mean number of flights, its name and its figures."""
    level = METHODS[method]
    rng = np.random.default_rng([labels, round(10 * level)])
    odds = level + LABELS * rng.standard_normal(labels)
    total, intervals, others, flights = np.zeros((2, 2, labels)), [], [], []
    for turn in range(repetitions):
        mine = drawn(rng, pool, healthy, labels, decisions)
        right, all_ = answered(rng, mine, odds)
        total += [right.sum(axis=1), all_.sum(axis=1)]
        stratum = strata([flight.decisions for flight in mine])
        intervals.append([balanced_interval(right[k], all_[k], stratum) for k in (0, 1)])
        if turn < repetitions // 4:
            others.append([percentile(right[k], all_[k], stratum) for k in (0, 1)])
        flights.append(len(mine))
    truth, found = (total[0] / total[1]).mean(axis=-1), np.array(intervals)  # (2,), (repetitions, 2, low and high)

    def holds(found, k):
        return 100 * np.mean((found[:, k, 0] <= truth[k] + 1e-12) & (truth[k] - 1e-12 <= found[:, k, 1]))

    cells = [
        text for k in (0, 1)
        for text in (f"{100 * truth[k]:.1f}", f"{100 * np.mean(found[:, k, 1] - found[:, k, 0]):.1f}",
                     f"{holds(found, k):.1f}", f"{holds(np.array(others), k):.1f}")
    ]  # fmt: skip
    return [f"{np.mean(flights):.0f}", method, *cells]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=-1)
    parser.add_argument("--page", type=Path, default=PAGE)
    arguments = parser.parse_args()
    names = [name for name in suite_names() if name.endswith(("-standard", "-hard"))]
    parallel = joblib.Parallel(n_jobs=arguments.jobs, verbose=5)
    rows = [row for part in parallel(joblib.delayed(study)(name, arguments.repetitions) for name in names) for row in part]
    head = ["suite", "flights", "method", "per sample: truth %", "width", "holds %", "bootstrap holds %",
            "per decision: truth %", "width", "holds %", "bootstrap holds %"]  # fmt: skip
    error = 100 * np.sqrt(0.95 * 0.05 / arguments.repetitions)
    about = (__doc__ or "").split("\n\n")[1].replace("\n", " ")
    text = (
        f"# Coverage\n\nWritten by `python benchmarks/coverage.py --repetitions {arguments.repetitions}`: how often the "
        f"printed 95 % intervals hold the truth, in percent (standard error {error:.1f}).\n\n{about}"
        f"\n\n{markdown(head, rows)}\n"
    )
    write_whole(arguments.page, text.encode())
    print(text)


if __name__ == "__main__":
    main()
