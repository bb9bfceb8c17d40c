"""The missile's pieces: the study's scenario and its variations, numbered episodes, fault-free flights, the hard process."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from baselines.filters import approximation_detector as detection
from baselines.filters import generalised_observer_scheme as isolation
from baselines.filters import missile_model as model
from benchmarks.reproduction.comparison import first, rms
from benchmarks.reproduction.numbered import fly
from benchmarks.reproduction.pieces import Jobs, reference
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.engine import Record, simulate
from fdi_gym.faults import FaultScenario, Incipient, draw
from fdi_gym.plant import Array, Plant
from fdi_gym.plants import missile_pitch as missile

REFERENCE = reference("missile_pitch")
DT = missile.DT
STEPS = 2000  # 20 s
FIVE, STUDIED = (1, 2, 3, 4, 5), (1, 2)  # classes of the banks
Q = 1  # the pitch rate's place among the residuals
BATCH = 100  # numbered episodes per piece
HARD_METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "augmented_ekf_bank": ("augmented_ekf_bank", {}),
    "augmented_ekf_mode_probabilities": ("augmented_ekf_mode_probabilities", {}),
    "augmented_ekf_bank_unlatched": ("augmented_ekf_bank_unlatched", {}),
    "IMM, transition time 4 s": ("augmented_ekf_imm", {"dwell": 4.0}),
    "IMM, transition time 1.5 s": ("augmented_ekf_imm", {}),
    "oracle": ("innovation_oracle", {"hard": True, "every": 20}),
    "oracle, none not allowed": ("innovation_oracle", {"hard": True, "every": 20, "none_allowed": False}),
}


class Sizes(NamedTuple):
    """Episodes."""

    runs: int  # of the study's scenario, and fault-free
    numbered: int
    variant: int  # numbered too, per variant
    groups: int  # of the hard process
    group: int  # episodes in each


def sizes(quick: bool) -> Sizes:
    """A tenth or all."""
    return Sizes(20, 60, 30, 1, 20) if quick else Sizes(200, 600, 300, 10, 60)


def batches(episodes: int) -> list[range]:
    """The numbers of the episodes, in pieces."""
    size = min(BATCH, episodes)
    return [range(b, b + size) for b in range(0, episodes, size)]


def agreement_plan(quick: bool) -> Jobs:
    """What the comparison with the data sheet's own implementation needs."""
    n = sizes(quick)
    jobs: Jobs = {"study": (study, ()), "fault-free": (fault_free, (n.runs,))}
    for case in REFERENCE["robustness"]:
        label = int(case[5]) if case.startswith("type") else 0
        jobs[f"robustness {case}"] = (robustness, (label, "noisy" in case, n.runs, "corners" in case))
    for r in REFERENCE["rate"]:
        jobs[f"rate {r['theta']} {r['gamma']}"] = (rate, (r["theta"], r["gamma"]))
    for b, seeds in enumerate(batches(n.numbered)):
        jobs[f"randomised {b}"] = (randomised, (10_000 + seeds.start, len(seeds)))
    for r, (b, seeds) in itertools.product(REFERENCE["variant"], enumerate(batches(n.variant))):
        settings = (r["noise"], r["size"])
        jobs[f"variant {r['noise']} {r['size']} {b}"] = (randomised, (20_000 + seeds.start, len(seeds), *settings))
    return jobs | {f"hard {g}": (hard, (30_000 + 60 * g, n.group)) for g in range(n.groups)}


# -- what is read from the methods


def adaptive_bank(plant: Plant, obs: Array, classes: tuple[int, ...]) -> dict[str, Array]:
    """Detector and isolation bank at every sample, arrays with the samples along the second axis; residuals are of q."""
    said = run(isolation.gos(plant, classes=classes), obs, signals=True)
    signals = said.signals or {}
    ratio = np.abs(signals["residual"]) / signals["threshold"]
    begun, excluded = signals["isolating"] > 0, signals["excluded"] > 0
    return {
        "alarm": said.alarm, "ratio": ratio.max(axis=2), "ratio_q": ratio[..., Q],
        "eps": signals["residual"][..., Q], "threshold": signals["threshold"][..., Q], "fhat": signals["fault function"],
        "residual": signals["isolation residuals"][..., Q], "lambda": signals["isolation thresholds"][..., Q],
        "theta": signals["parameters"], "excluded": excluded,
        "strict": isolation.strict_verdict(begun, excluded, classes),
        "tie_broken": isolation.tie_broken(begun, excluded, signals["energy"], classes),
    }  # fmt: skip


def seconds(condition: Array) -> list[float]:
    """Time [s] at which each row first holds; NaN where never."""
    return np.round(first(condition) * DT, 2).tolist()


def three(values: Sequence[float]) -> list[float]:
    """Smallest, median, largest."""
    return [float(np.min(values)), float(np.median(values)), float(np.max(values))]


# -- the study's scenario


def fault_function(flown: Record, i: int, label: int) -> Array:
    """A class's function of a flight's true state in the pitch channel (K + 1,)."""
    x = flown.state[i]
    return model.fault_function(label, x[:, 0], x[:, 2], x[:, 4], np.full(len(x), missile.MACH))[0][:, 1]


def theorem(flown: Record, i: int, wrong: int, found: dict[str, Array]) -> float:
    """When Theorem 2's sufficient condition for excluding the wrong class is first met [s], noise-free."""
    x, size = flown.state[i], flown.theta[i, :, i]
    A, B0, B1 = detection.A, detection.B0, detection.B1
    alarm = int(found["alarm"][i].argmax())
    Z = [fault_function(flown, i, c) for c in STUDIED]
    bound = model.uncertainty_bound(x[:, 0], np.full(len(x), missile.MACH))[:, 1]
    theta = found["theta"][i, :, wrong]
    mismatch = size * Z[i] - theta * Z[wrong]
    since = np.maximum(np.arange(len(x)) - alarm, 0) * DT
    kappa = isolation.RADIUS[wrong] + np.abs(theta)
    right = 2 * bound + (kappa + np.exp(-isolation.GAMMA_LOW * since) * np.abs(theta)) * np.abs(Z[wrong])
    left_z, right_z = 0.0, 2 * abs(found["eps"][i, alarm])
    for k in range(alarm + 1, len(x)):
        left_z = A * left_z + B0 * mismatch[k - 1] + B1 * mismatch[k]
        right_z = A * right_z + B0 * right[k - 1] + B1 * right[k]
        if abs(left_z) > right_z + detection.NU_0[1]:
            return round(k * DT, 2)
    return math.nan


def study() -> dict[str, Any]:
    """The study's scenario and its mirror, noise-free; also what the figures show."""
    plant = missile.plant(noise_scale=0.0)
    flown = simulate(plant, [missile.study(), missile.study(2)])
    found = adaptive_bank(plant, flown.obs, STUDIED)
    result: dict[str, Any] = {"figure": {}}
    alarm, excluded = seconds(found["alarm"]), [seconds(found["excluded"][..., c]) for c in (0, 1)]
    late = slice(1500, STEPS + 1)
    for i, name in enumerate(("study", "mirror")):
        truth = flown.theta[i, :, i] * fault_function(flown, i, 1 + i)
        threshold = found["lambda"][i, :, i]
        matched = np.abs(found["residual"][i, :, i]) / np.where(threshold > 0, threshold, 1)
        begin = int(found["alarm"][i].argmax())
        result[name] = {
            "T_d": alarm[i], "T_s": excluded[1 - i][i], "true_excluded": bool(found["excluded"][i, :, i].any()),
            "matched": float(matched[begin + 50 :].max()), "matched_at_alarm": float(matched[begin]),
            "rms_error": float(rms(truth[late] - found["fhat"][i, late])), "rms": float(rms(truth[late])),
            "theta": [float(found["theta"][i, k, i]) for k in (1500, 2000)],
            "wrong_theta": float(found["theta"][i, 1800, 1 - i]), "theorem": theorem(flown, i, 1 - i, found),
        }  # fmt: skip
        drawn = {key: found[key][i].tolist() for key in ("fhat", "eps", "threshold", "residual", "lambda")}
        result["figure"][name] = drawn | {"truth": truth.tolist()}
    return result


def robustness(label: int, noisy: bool, runs: int, corners: bool = False) -> dict[str, Any]:
    """The study's scenario with random coefficient errors (or at the corners of their box); label 0 for no fault."""
    plant = missile.plant(noise_scale=1.0 if noisy else 0.0)
    rng = np.random.default_rng(4711 + 10 * label + noisy)
    box = 0.05 * np.array(list(itertools.product((-1, 1), repeat=6)))
    rhos = (box if corners else rng.uniform(-0.05, 0.05, (runs, 6))).tolist()
    order = functools.partial(missile.bounded_noise, noise_scale=float(noisy))
    base = missile.study(max(label, 1))
    scenarios = [base.replace(physical={"rho": rho}, noise_seed=i, faults=base.faults if label else [])
                 for i, rho in enumerate(rhos)]  # fmt: skip
    found = adaptive_bank(plant, fly(plant, scenarios, order).obs, STUDIED)
    onset = 1000 if label else STEPS + 1
    result: dict[str, Any] = {"runs": len(rhos), "early": int(found["alarm"][:, :onset].any(axis=1).sum())}
    if not label:
        return result | {"ratio": float(found["ratio_q" if noisy else "ratio"].max())}
    alarm, isolated = seconds(found["alarm"]), seconds(found["excluded"][..., 2 - label])
    return result | {
        "T_d": three(alarm), "T_s": three(isolated), "true_excluded": int(found["excluded"][:, -1, label - 1].sum()),
    }  # fmt: skip


def rate(theta: float, gamma: float) -> list[list[float]]:
    """Detection and isolation times of types 1 and 2 at another size and rate, 30 s."""
    plant = missile.plant(noise_scale=0.0)
    flown = simulate(plant, [missile.study(label, theta, gamma, 3000) for label in STUDIED])
    found = adaptive_bank(plant, flown.obs, STUDIED)
    alarm = seconds(found["alarm"])
    return [[alarm[i], seconds(found["excluded"][..., 1 - i])[i]] for i in (0, 1)]


# -- random episodes


def fault_free(runs: int) -> dict[str, Any]:
    """The numbered episodes from 0 on without their faults."""
    plant = missile.plant()
    flights = [missile.episode(seed) for seed in range(runs)]
    obs = simulate(plant, [s.without_faults() for s, _ in flights], [noise for _, noise in flights]).obs
    found = adaptive_bank(plant, obs, FIVE)
    bare = run(make_diagnoser("approximation_detector_no_margin", plant), obs)
    bank = run(make_diagnoser("augmented_ekf_bank", plant), obs, signals=True)
    return {
        "runs": runs, "detector": int(found["alarm"][:, -1].sum()), "bank": int(bank.alarm[:, -1].sum()),
        "bare": int(bare.alarm[:, -1].sum()), "ratio": float(found["ratio"].max()),
        "llr": float((bank.signals or {})["log-likelihood ratios"].max()),
    }  # fmt: skip


def numbered(
    seeds: range, noise_scale: float, fault_scale: float
) -> tuple[Plant, list[FaultScenario], list[tuple[Array, Array]]]:
    """The numbered episodes with noise and sizes scaled, and the plant whose filters are told. Sizes are not clipped."""
    scenarios, noise = [], []
    for seed in seeds:
        scenario, (w, v) = missile.episode(seed)
        faults = []
        for fault in scenario.faults:
            effects = [msgspec.structs.replace(e, value=e.value * fault_scale) if isinstance(e, Incipient) else e
                       for e in fault.effects]  # fmt: skip
            faults.append(msgspec.structs.replace(fault, effects=effects))
        scenarios.append(scenario.replace(faults=faults))
        noise.append((w, v * noise_scale))
    return missile.plant(noise_scale=noise_scale, fault_scale=fault_scale), scenarios, noise


def unclipped(plant: Plant) -> Plant:
    """The plant with a jetloss beyond 1, as it comes out where sizes are scaled."""
    *others, jetloss = plant.theta
    return dataclasses.replace(plant, theta=(*others, jetloss._replace(high=2.0)))


def randomised(first_seed: int, runs: int, noise_scale: float = 1.0, fault_scale: float = 1.0) -> dict[str, Any]:
    """A batch of the randomised environment, exactly as the data sheet numbers it: every method's verdicts."""
    plant, scenarios, noise = numbered(range(first_seed, first_seed + runs), noise_scale, fault_scale)
    flown = simulate(unclipped(plant), scenarios, noise)
    label, rows = flown.label[:, -1], np.arange(runs)
    onset = np.array([s.faults[0].onset if s.faults else STEPS // 2 for s in scenarios])
    times = [np.minimum(onset + 200, STEPS), np.minimum(onset + 400, STEPS), np.full(runs, STEPS)]

    def at(labels: Array) -> list[list[int]]:
        return [labels[rows, k].astype(int).tolist() for k in times]

    five, two = adaptive_bank(plant, flown.obs, FIVE), adaptive_bank(plant, flown.obs, STUDIED)
    bank = run(make_diagnoser("augmented_ekf_bank", plant), flown.obs, signals=True)
    known = run(make_diagnoser("innovation_oracle", plant, scenarios=scenarios), flown.obs)
    true = np.maximum(label, 1) - 1  # the parameter of the true class
    y, _, signals = plant.split(flown.obs)
    eta = y[..., 2] - np.stack([v[:, 2] for _, v in noise])
    tracking = flown.state[..., 0] - signals[..., 3]
    after = np.arange(STEPS + 1)[None, :] >= onset[:, None]
    flight = (flown.state[..., 0] / missile.DEG, flown.state[..., 1], eta, flown.state[..., 2] / missile.DEG)
    return {
        "label": label.tolist(), "onset": onset.tolist(), "terminated": int(flown.terminated.sum()),
        "gos": at(five["tie_broken"]), "augmented_ekf_bank": at(bank.label), "innovation_oracle": at(known.label),
        "strict five": at(five["strict"]), "strict two": at(two["strict"]), "two": at(two["tie_broken"]),
        "excluded": five["excluded"][:, -1].astype(int).tolist(),
        "detector alarm": seconds(five["alarm"]), "bank alarm": seconds(bank.alarm),
        "truth": flown.theta[rows, -1, true].tolist(),
        "ekf theta": (bank.signals or {})["fault parameters"][rows, -1, true].tolist(),
        "gos theta": five["theta"][rows, -1, true].tolist(), "largest": [float(np.abs(a).max()) for a in flight],
        "tracking": (np.where(after, tracking, 0) ** 2).sum(axis=1).tolist(), "after": after.sum(axis=1).tolist(),
    }  # fmt: skip


def hard(first_seed: int, runs: int) -> dict[str, Any]:
    """A group of the hard process. Labels as the data sheet has them: sample k has the fault of [k, k + 1)."""
    plant = missile.plant()
    scenarios = [draw(plant.process("hard"), first_seed + i) for i in range(runs)]
    flown = fly(plant, scenarios, missile.bounded_noise)
    label = np.concatenate([flown.label[:, 1:], flown.label[:, -1:]], axis=1)
    scored = np.zeros(label.shape, bool)
    scored[:, 200:] = True
    for i, k in zip(*np.nonzero(np.diff(label, axis=1)), strict=True):
        scored[i, k + 1 : k + 101] = False
    result: dict[str, Any] = {"faulty": float((label[scored] > 0).mean())}
    for name, (method, settings) in HARD_METHODS.items():
        right = run(make_diagnoser(method, plant, scenarios=scenarios, **settings), flown.obs).label == label
        result[name] = [float(right[scored & mask].mean()) for mask in (label >= 0, label > 0, label == 0)]
    alarm = run(make_diagnoser("approximation_detector", plant), flown.obs).alarm
    begin = np.array([min([f.onset for f in s.faults], default=STEPS) for s in scenarios])
    return result | {"early": float(alarm[np.arange(runs), begin].mean())}
