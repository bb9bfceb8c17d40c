"""How often the printed 95 % intervals hold the truth, on every standard and hard suite: writes leaderboards/coverage.md.

Each repetition draws a suite anew from a pool of 1,500 flights (5,000 for the helicopter) of its process, by the rule by
which the suite was drawn, and lets a method that errs in a known way answer on it. How well it does differs between labels,
between flights (all windows of a flight err together) and between windows; within a window the share of right samples is a
beta variable, and the decision is right where more than half of the samples are. The truth is the balanced accuracy over
all repetitions together. Three methods are tried: poor, middling and good. The percentile bootstrap, within strata, on the
same repetitions, is what the intervals are held against.

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
    samples: list[int]  # scored, of each decision's window
    healthy: int  # scored healthy samples


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
        samples = [int(scored[first:stop].sum()) for first, stop, _ in asked]
        found.append(Flight([v for *_, v in asked], samples, int((scored & (label == 0)).sum())))
    return found[:count], found[count:]


def drawn(rng, pool, healthy, labels, decisions):
    """A suite: flights taken in random order while they help, and the healthy ones that are made."""
    held, taken = np.zeros(labels, int), []
    for i in rng.permutation(len(pool)):
        if any(held[label] < decisions for label in pool[i].decisions):
            taken.append(pool[i])
            for label in pool[i].decisions:
                held[label] += 1
        if (held >= decisions).all():
            break
    return taken + healthy[: max(0, decisions - held[0])]


def answered(rng, flights, odds):
    """(right, all) answers (N, labels), per sample and per decision."""
    right, all_ = np.zeros((2, len(flights), len(odds))), np.zeros((2, len(flights), len(odds)))
    for i, flight in enumerate(flights):
        mood = FLIGHTS * rng.standard_normal()

        def share(label, mood=mood):
            p = 1 / (1 + np.exp(-(odds[label] + mood + WINDOWS * rng.standard_normal())))
            return rng.beta(p * CONCENTRATION, (1 - p) * CONCENTRATION)

        for label, samples in zip(flight.decisions, flight.samples, strict=True):
            found = share(label)
            right[1, i, label] += found > 0.5
            all_[1, i, label] += 1
            if label:
                right[0, i, label] += round(found * samples)
                all_[0, i, label] += samples
        found = share(0) if flight.healthy and 0 not in flight.decisions else found
        right[0, i, 0], all_[0, i, 0] = round(found * flight.healthy), flight.healthy
    return right, all_


def percentile(right, all_, stratum):
    """The bootstrap's interval."""
    weights = resamples(stratum, BOOTSTRAP)
    total = weights @ all_
    scores = np.where(total > 0, (weights @ right) / np.maximum(total, 1), np.nan)
    return np.percentile(np.nanmean(scores[:, all_.sum(axis=0) > 0], axis=1), [2.5, 97.5])


def study(name, repetitions, method):
    """One line of the table."""
    suite = load_suite(name)
    plant, level = suite.build(), METHODS[method]
    labels = len(plant.labels)
    pool, healthy = pool_of(suite, plant, 5000 if plant.id == "HUAVHover" else 1500)
    decisions = script("suites").DECISIONS.get(name, 30)
    rng = np.random.default_rng([len(name), round(10 * level)])
    odds = level + LABELS * rng.standard_normal(labels)
    total, intervals, flights = np.zeros((2, 2, labels)), [], []
    for _ in range(repetitions):
        mine = drawn(rng, pool, healthy, labels, decisions)
        right, all_ = answered(rng, mine, odds)
        total += [right.sum(axis=1), all_.sum(axis=1)]
        stratum = strata([flight.decisions for flight in mine])
        intervals.append([[f(right[k], all_[k], stratum) for f in (balanced_interval, percentile)] for k in (0, 1)])
        flights.append(len(mine))
    truth, found = (total[0] / total[1]).mean(axis=-1), np.array(intervals)  # (2,), (repetitions, 2, 2, low and high)
    holds = (found[..., 0] <= truth[:, None] + 1e-12) & (truth[:, None] - 1e-12 <= found[..., 1])
    cover, width = 100 * holds.mean(axis=0), 100 * (found[..., 1] - found[..., 0]).mean(axis=0)
    cells = [f(k) for k in (0, 1) for f in (lambda k: f"{100 * truth[k]:.1f}", lambda k: f"{width[k, 0]:.1f}",
                                            lambda k: f"{cover[k, 0]:.1f}", lambda k: f"{cover[k, 1]:.1f}")]  # fmt: skip
    return [name, f"{np.mean(flights):.0f}", method, *cells]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=-1)
    parser.add_argument("--page", type=Path, default=PAGE)
    arguments = parser.parse_args()
    names = [name for name in suite_names() if name.endswith(("-standard", "-hard"))]
    cases = [(name, arguments.repetitions, method) for name in names for method in METHODS]
    rows = joblib.Parallel(n_jobs=arguments.jobs)(joblib.delayed(study)(*case) for case in cases)
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
