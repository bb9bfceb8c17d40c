"""What is measured of each suite: flights with an agent on board, paired with those of nobody acting."""

from __future__ import annotations

import importlib
import inspect
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.acting.suites import PROBERS, Suite
from fdi_gym.acts import probe_prices
from fdi_gym.agents import Flown, Prober, fly
from fdi_gym.comparison import draw_again
from fdi_gym.diagnosis import Diagnoser, Diagnosis, make_diagnoser
from fdi_gym.metrics import Outcome, outcome
from fdi_gym.plant import Array, NotApplicableError, Plant
from fdi_gym.scores import summarise


def prober_of(name: str, plant: Plant, suite: Suite, settings: dict[str, Any]) -> Prober:
    """A prober of `baselines.probing` by name, told what it takes of the suite."""
    build = importlib.import_module(f"baselines.probing.{name}").prober
    told = {"process": suite.process, "period": suite.period}
    return build(plant, **{k: v for k, v in told.items() if k in inspect.signature(build).parameters}, **settings)


def label_of(name: str, settings: dict[str, Any]) -> str:
    """An agent's name in tables."""
    return " ".join([name, *(f"{k} {v}" for k, v in settings.items())])


def mean_interval(values: Array) -> list[float]:
    """Mean over flights and its 95 % interval, normal."""
    middle, half = float(values.mean()), float(1.96 * values.std(ddof=1) / np.sqrt(len(values)))
    return [middle, middle - half, middle + half]


def delays(outcomes: list[Outcome], horizon: float, dt: float) -> Array:
    """Time [s] from each flight's first onset to its right label, the horizon where it takes longer; nan where healthy."""
    found = []
    for one in outcomes:
        first = one.onsets[0] if one.onsets else None
        late = np.inf if first is None or first.isolation is None else first.isolation * dt
        found.append(np.nan if first is None else 0.0 if first.labelled else min(late, horizon))
    return np.array(found)


def probing(suite: Suite) -> dict[str, Any]:
    """Every agent on a suite's flights: accuracy, delay and cost, and the differences to the best that never probes."""
    diagnoser = suite.diagnosers[0]
    plant = suite.plant()
    scenarios = suite.scenarios(plant)
    on_board = make_diagnoser(diagnoser, plant, process=suite.process)
    scoring, entries = plant.process(suite.process).scoring, [s.name for s in plant.estimated]
    found: dict[str, tuple[str, Flown, list[Outcome]]] = {}
    for name, curve in PROBERS.items():
        for settings in curve:
            begun = time.monotonic()
            try:
                prober = prober_of(name, plant, suite, settings)
            except NotApplicableError:
                continue
            flown = fly(plant, scenarios, on_board, prober, period=suite.period)
            outcomes = [outcome(plant, scoring, flown.record, flown.decisions, i) for i in range(len(scenarios))]
            found[label_of(name, settings)] = name, flown, outcomes
            print(f"  {label_of(name, settings)}: {time.monotonic() - begun:.0f} s", flush=True)
    for other in suite.diagnosers[1:]:
        flown = fly(plant, scenarios, make_diagnoser(other, plant, process=suite.process), period=suite.period)
        outcomes = [outcome(plant, scoring, flown.record, flown.decisions, i) for i in range(len(scenarios))]
        found[f"never, {other} on board"] = "never", flown, outcomes
    drawn = {kind: draw_again({k: v[2] for k, v in found.items()}, len(plant.labels), kind)
             for kind in ("per_sample", "per_decision")}  # fmt: skip
    onsets = [o.onsets[0].length for o in found["never"][2] if o.onsets]
    horizon = float(np.median(onsets)) * plant.dt
    quiet = [key for key, (name, *_) in found.items() if name == "never"]
    best = max(quiet, key=lambda key: drawn["per_sample"].score[drawn["per_sample"].names.index(key)])
    passive = found[best]
    rows = []
    for key, (name, flown, outcomes) in found.items():
        scores = summarise(outcomes, len(plant.labels), entries, plant.dt)
        late = delays(outcomes, horizon, plant.dt)
        gap = (late - delays(passive[2], horizon, plant.dt))[np.isfinite(late)]
        rows.append({
            "agent": key, "prober": name,
            **{kind: [scores[kind]["balanced_accuracy"], *scores[kind]["balanced_accuracy_interval"]] for kind in drawn},
            **{f"{kind}_gain": list(drawn[kind].difference(key, best)) for kind in drawn},
            "delay": float(np.nanmean(late)), "delay_gain": mean_interval(gap) if gap.size > 1 else None,
            "false_alarms_per_hour": scores["detection"]["false_alarms_per_hour"],
            "cost": mean_interval(flown.cost[:, 1:].mean(axis=1) - passive[1].cost[:, 1:].mean(axis=1)),
            "probed": float((flown.probe[:, 1:] > 0).mean()),
            "lost": int(flown.record.terminated.sum()),
        })  # fmt: skip
    pictured = {key: found[key] for key in ("never", label_of("greedy", PROBERS["greedy"][1]))}
    return {
        "suite": suite._asdict(), "diagnoser": diagnoser, "passive": best, "horizon": horizon,
        "prices": dict(zip([p.name for p in plant.acting.probes], probe_prices(plant), strict=True)),  # type: ignore[union-attr]
        "rows": rows, "flight": _flight(plant, pictured),
    }  # fmt: skip


def _flight(plant: Plant, pictured: dict[str, tuple[str, Flown, list[Outcome]]]) -> dict[str, Any]:
    """The flight to look at: the one in which acting has changed most, thinned to about 300 samples."""
    (_, passive, _), (_, active, _) = pictured.values()
    right = [(f.decisions.label == f.record.label).mean(axis=1) for f in (passive, active)]
    i = int(np.argmax(right[1] - right[0]))
    length = int(active.record.length[i])
    k = np.unique(np.linspace(0, length, 300).astype(int))
    shown: dict[str, Any] = {"time": (k * plant.dt).tolist(), "label": active.record.label[i, k].tolist()}
    for key, (_, flown, _) in pictured.items():
        probs = flown.decisions.label_probs
        belief = probs[i, k] if probs is not None else np.eye(len(plant.labels))[flown.decisions.label[i, k]]
        shown[key] = {"belief": np.round(belief, 3).tolist(), "probe": flown.probe[i, k].tolist(),
                      "cost": np.round(flown.cost[i, k], 4).tolist()}  # fmt: skip
    return shown


def accommodation(suite: Suite) -> dict[str, Any]:
    """What is recovered of a fault's cost by each diagnoser, of what is recovered by the truth; label by label."""
    plant = suite.plant()
    scenarios = suite.scenarios(plant)
    label = np.array([max((v for _, v in plant.label_changes(s)), default=0) for s in scenarios])
    nobody = make_diagnoser("null", plant, process=suite.process)
    flown = {
        "no fault": fly(plant, [s.without_faults() for s in scenarios], nobody, period=suite.period),
        "nothing": fly(plant, scenarios, nobody, period=suite.period),
        "the truth": fly(plant, scenarios, nobody, allow_for="truth", period=suite.period),
        "a false alarm": fly(plant, [s.without_faults() for s in scenarios],
                             _always(plant), allow_for="diagnosis", period=suite.period),
    }  # fmt: skip
    for name in suite.diagnosers:
        begun = time.monotonic()
        on_board = make_diagnoser(name, plant, process=suite.process)
        flown[name] = fly(plant, scenarios, on_board, allow_for="diagnosis", period=suite.period)
        print(f"  {name}: {time.monotonic() - begun:.0f} s", flush=True)
    costs = {key: f.cost[:, 1:].mean(axis=1) for key, f in flown.items()}
    lost = {key: f.record.terminated for key, f in flown.items()}
    rows = []
    for key in flown:
        row: dict[str, Any] = {
            "allowed_for": key, "cost": mean_interval(costs[key]), "lost": int(lost[key].sum()),
            "averted": int((lost["nothing"] & ~lost[key]).sum()), "caused": int((~lost["nothing"] & lost[key]).sum()),
            "worse": float((costs[key] > 1.05 * costs["nothing"])[label > 0].mean()),
            "unusable": int(flown[key].unusable.sum()),
            "by_label": {plant.labels[v].name: [float(costs[key][label == v].mean()), int((label == v).sum())]
                         for v in np.unique(label)},
        }  # fmt: skip
        if key not in ("no fault", "a false alarm"):
            row["recovered"] = _share(costs["nothing"], costs[key], costs["the truth"])
        rows.append(row)
    return {"suite": suite._asdict(), "rows": rows}


def _share(nothing: Array, mine: Array, truth: Array) -> list[float]:
    """The share of what the truth recovers, of sums over flights; its interval from resampled flights."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(mine), size=(2000, len(mine)))
    gained, possible = (nothing - mine)[drawn].sum(axis=1), (nothing - truth)[drawn].sum(axis=1)
    low, high = np.percentile(gained / possible, [2.5, 97.5])
    return [float((nothing - mine).sum() / (nothing - truth).sum()), float(low), float(high)]


def _always(plant: Plant) -> Diagnoser:
    """A diagnoser that names one fault all the time, of two thirds of its reach; from flight to flight another label."""
    estimates = np.tile(plant.healthy, (len(plant.labels), 1))
    for i, label in enumerate(plant.labels):
        for mode in plant.modes:
            if mode.name in label.modes:
                low, high = mode.reaches.T
                estimates[i] += np.array(mode.offset) + (low + 2 / 3 * (high - low)) @ mode.directions

    def update(n: int, obs: Array) -> tuple[int, Diagnosis]:
        label = 1 + np.arange(len(obs)) % (len(plant.labels) - 1)
        return n, Diagnosis(np.ones(len(obs), bool), label, estimates[label])

    return Diagnoser(lambda n: n, update)


def kept(path: Path, make: Any) -> dict[str, Any]:
    """What is in the file, else what is made now and put there."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(make(), indent=1) + "\n")
    return json.loads(path.read_text())
