"""The missile's reference figures, measured again: `python -m baselines.reproduction.missile_pitch [--quick]`.

Writes leaderboards/reproduction/missile_pitch.md and its figures. The numbered episodes are the data sheet's own, so
their counts must be identical; where random numbers differ, the spread decides. Finished pieces are kept in --work."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tyro

from baselines.filters import approximation_detector as detection
from baselines.filters import generalised_observer_scheme as isolation
from baselines.filters import missile_model as model
from baselines.reproduction import missile_reference as reference
from baselines.reproduction.missile_page import (
    BATCH,
    Verdicts,
    draw_figure,
    other_sections,
    randomised_section,
    robustness_section,
    study_section,
)
from baselines.reproduction.numbered import fly
from baselines.reproduction.tables import markdown, pieces
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.engine import simulate
from fdi_gym.faults import FaultScenario, Incipient, draw
from fdi_gym.plant import Array, Plant
from fdi_gym.plants import missile_pitch as missile

DT = missile.DT
FIVE = (1, 2, 3, 4, 5)


@dataclass
class Arguments:
    """Command line."""

    quick: bool = False
    """A tenth of the random episodes; the page then says so."""
    work: Path = Path("runs/reproduction/missile_pitch")
    """Folder of finished pieces."""
    out: Path = Path("leaderboards/reproduction")
    """Where the page goes."""
    jobs: int = 1
    """Worker processes."""


# ---------------------------------------------------------------------------------------------------------------
# What is watched


def adaptive_bank(plant: Plant, obs: Array, classes: tuple[int, ...]) -> dict[str, Array]:
    """Detector and isolation bank at every sample, arrays with the samples along the second axis."""
    said = run(isolation.gos(plant, classes=classes), obs, signals=True)
    shown = said.signals or {}
    eps, threshold, excluded, begun = (shown[name] for name in ("residual", "threshold", "excluded", "isolating"))
    ratio = np.abs(eps) / threshold
    return {
        "alarm": said.alarm, "ratio": ratio.max(axis=2), "ratio_q": ratio[..., 1], "eps": eps[..., 1],
        "threshold": threshold[..., 1], "fhat": shown["fault function"], "residual": shown["isolation residuals"][..., 1],
        "lambda": shown["isolation thresholds"][..., 1], "theta": shown["parameters"], "excluded": excluded.astype(bool),
        "strict": isolation.strict_verdict(begun > 0, excluded > 0, classes),
        "tie_broken": isolation.tie_broken(begun > 0, excluded > 0, shown["energy"], classes),
    }  # fmt: skip


def first(condition: Array) -> list[float]:
    """Time [s] at which each row first holds; NaN where never."""
    held = np.asarray(condition.any(axis=1))
    return [round(float(k) * DT, 2) if h else math.nan for k, h in zip(condition.argmax(axis=1), held.tolist(), strict=True)]


def three(values: Sequence[float]) -> list[float]:
    """Smallest, median, largest."""
    return [float(np.min(values)), float(np.median(values)), float(np.max(values))]


# ---------------------------------------------------------------------------------------------------------------
# Pieces


def theorem(flown: Any, i: int, wrong: int, found: dict[str, Array]) -> float:
    """When Theorem 2's sufficient condition for excluding the wrong class is first met [s], noise-free."""
    x, size = flown.state[i], flown.theta[i, :, i]
    A, B0, B1 = detection.A, detection.B0, detection.B1
    alarm = int(found["alarm"][i].argmax())
    mach = np.full(len(x), missile.MACH)
    Z = [model.fault_function(c, x[:, 0], x[:, 2], x[:, 4], mach)[0][:, 1] for c in (1, 2)]
    bound = model.uncertainty_bound(x[:, 0], mach)[:, 1]
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
    found = adaptive_bank(plant, flown.obs, (1, 2))
    result: dict[str, Any] = {"figure": {}}
    alarm, excluded = first(found["alarm"]), [first(found["excluded"][..., c]) for c in (0, 1)]
    late = slice(1500, 2001)
    for i, name in enumerate(("study", "mirror")):
        x = flown.state[i]
        Z = model.fault_function(1 + i, x[:, 0], x[:, 2], x[:, 4], np.full(len(x), missile.MACH))[0][:, 1]
        truth = flown.theta[i, :, i] * Z
        error = truth[late] - found["fhat"][i, late]
        matched = np.abs(found["residual"][i, :, i]) / np.where(found["lambda"][i, :, i] > 0, found["lambda"][i, :, i], 1)
        begin = int(found["alarm"][i].argmax())
        result[name] = {
            "T_d": alarm[i], "T_s": excluded[1 - i][i], "true_excluded": bool(found["excluded"][i, :, i].any()),
            "matched": float(matched[begin + 50 :].max()), "matched_at_alarm": float(matched[begin]),
            "rms_error": float(np.sqrt(np.mean(error**2))), "rms": float(np.sqrt(np.mean(truth[late] ** 2))),
            "theta": [float(found["theta"][i, k, i]) for k in (1500, 2000)],
            "wrong_theta": float(found["theta"][i, 1800, 1 - i]), "theorem": theorem(flown, i, 1 - i, found),
        }  # fmt: skip
        result["figure"][name] = {
            "truth": truth.tolist(), "fhat": found["fhat"][i].tolist(), "eps": found["eps"][i].tolist(),
            "threshold": found["threshold"][i].tolist(), "residual": found["residual"][i].tolist(),
            "lambda": found["lambda"][i].tolist(),
        }  # fmt: skip
    return result


def robustness(label: int, noisy: bool, runs: int, corners: bool = False) -> dict[str, Any]:
    """The study's scenario with random coefficient errors (or at the corners of their box); label 0 for no fault."""
    plant = missile.plant(noise_scale=1.0 if noisy else 0.0)
    rng = np.random.default_rng(4711 + 10 * label + noisy)
    rhos = [[0.05 * s for s in signs] for signs in itertools.product((-1, 1), repeat=6)] if corners else \
        rng.uniform(-0.05, 0.05, (runs, 6)).tolist()  # fmt: skip
    order = functools.partial(missile.bounded_noise, noise_scale=float(noisy))
    base = missile.study(max(label, 1))
    scenarios = [base.replace(physical={"rho": rho}, noise_seed=i, faults=base.faults if label else [])
                 for i, rho in enumerate(rhos)]  # fmt: skip
    found = adaptive_bank(plant, fly(plant, scenarios, order).obs, (1, 2))
    onset = 1000 if label else 2001
    result: dict[str, Any] = {"runs": len(rhos), "early": int(found["alarm"][:, :onset].any(axis=1).sum())}
    if label:
        alarm, isolated = first(found["alarm"]), first(found["excluded"][..., 2 - label])
        result |= {
            "T_d": three(alarm), "T_s": three(isolated), "isolated": int(np.isfinite(isolated).sum()),
            "true_excluded": int(found["excluded"][:, -1, label - 1].sum()),
        }  # fmt: skip
    else:
        result["ratio"] = float(found["ratio_q" if noisy else "ratio"].max())
    return result


def rate(theta: float, gamma: float) -> list[list[float]]:
    """Detection and isolation times of types 1 and 2 at another size and rate, 30 s."""
    plant = missile.plant(noise_scale=0.0)
    flown = simulate(plant, [missile.study(label, theta, gamma, 3000) for label in (1, 2)])
    found = adaptive_bank(plant, flown.obs, (1, 2))
    alarm = first(found["alarm"])
    return [[alarm[i], first(found["excluded"][..., 1 - i])[i]] for i in (0, 1)]


def fault_free(runs: int) -> dict[str, Any]:
    """The numbered episodes from 0 on without their faults."""
    plant = missile.plant()
    flights = [missile.episode(seed) for seed in range(runs)]
    obs = simulate(plant, [s.without_faults() for s, _ in flights], [noise for _, noise in flights]).obs
    found = adaptive_bank(plant, obs, FIVE)
    bare = run(make_diagnoser("approximation_detector_no_margin", plant), obs)
    bank = run(make_diagnoser("augmented_ekf_bank", plant), obs, signals=True)
    largest = float((bank.signals or {})["log-likelihood ratios"].max())
    return {
        "runs": runs, "detector": int(found["alarm"][:, -1].sum()), "bank": int(bank.alarm[:, -1].sum()),
        "bare": int(bare.alarm[:, -1].sum()), "ratio": float(found["ratio"].max()), "llr": largest,
    }  # fmt: skip


def numbered(seeds: Sequence[int], noise_scale: float, fault_scale: float) -> tuple[Plant, list[Any], list[Any]]:
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


def randomised(first_seed: int, runs: int, noise_scale: float = 1.0, fault_scale: float = 1.0) -> dict[str, Any]:
    """A batch of the randomised environment, exactly as the data sheet numbers it: every method's verdicts."""
    plant, scenarios, noise = numbered(range(first_seed, first_seed + runs), noise_scale, fault_scale)
    flown = simulate(plant, scenarios, noise)
    label, rows = flown.label[:, -1], np.arange(runs)
    onset = np.array([s.faults[0].onset if s.faults else 1000 for s in scenarios])
    times = [np.minimum(onset + 200, 2000), np.minimum(onset + 400, 2000), np.full(runs, 2000)]

    def at(mode: Array) -> list[list[int]]:
        return [mode[rows, k].astype(int).tolist() for k in times]

    five, two = adaptive_bank(plant, flown.obs, FIVE), adaptive_bank(plant, flown.obs, (1, 2))
    bank = run(make_diagnoser("augmented_ekf_bank", plant), flown.obs, signals=True)
    known = run(make_diagnoser("innovation_oracle", plant, scenarios=scenarios), flown.obs)
    true = np.maximum(label, 1)
    truth = flown.theta[rows, -1, true - 1]
    eta = flown.obs[..., 2] - np.stack([v[:, 2] for _, v in noise])
    tracking = flown.state[..., 0] - flown.obs[..., 8]
    after = np.arange(2001)[None, :] >= onset[:, None]
    return {
        "label": label.tolist(), "onset": onset.tolist(), "terminated": int(flown.terminated.sum()),
        "gos": at(five["tie_broken"]), "augmented_ekf_bank": at(bank.label),
        "innovation_oracle": at(known.label),
        "strict five": at(five["strict"]), "strict two": at(two["strict"]), "two": at(two["tie_broken"]),
        "excluded": five["excluded"][:, -1].astype(int).tolist(),
        "detector alarm": first(five["alarm"]), "bank alarm": first(bank.alarm),
        "truth": truth.tolist(), "ekf theta": (bank.signals or {})["fault parameters"][rows, -1, true - 1].tolist(),
        "gos theta": five["theta"][rows, -1, true - 1].tolist(),
        "largest": [float(np.abs(a).max()) for a in
                    (flown.state[..., 0] / missile.DEG, flown.state[..., 1], eta, flown.state[..., 2] / missile.DEG)],
        "tracking": (np.where(after, tracking, 0) ** 2).sum(axis=1).tolist(), "after": after.sum(axis=1).tolist(),
    }  # fmt: skip


HARD_METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "augmented_ekf_bank": ("augmented_ekf_bank", {}),
    "augmented_ekf_mode_probabilities": ("augmented_ekf_mode_probabilities", {}),
    "augmented_ekf_bank_unlatched": ("augmented_ekf_bank_unlatched", {}),
    "IMM, transition time 4 s": ("augmented_ekf_imm", {"dwell": 4.0}),
    "IMM, transition time 1.5 s": ("augmented_ekf_imm", {}),
    "oracle": ("innovation_oracle", {"hard": True, "every": 20}),
    "oracle, none not allowed": ("innovation_oracle", {"hard": True, "every": 20, "none_allowed": False}),
}


def hard(first_seed: int, runs: int) -> dict[str, Any]:
    """A group of the hard process. Labels as the data sheet has them: sample k has the fault of [k, k + 1)."""
    plant = missile.plant()
    scenarios: list[FaultScenario] = [draw(plant.process("hard"), first_seed + i) for i in range(runs)]
    flown = fly(plant, scenarios, missile.bounded_noise)
    label = np.concatenate([flown.label[:, 1:], flown.label[:, -1:]], axis=1)
    scored = np.zeros(label.shape, bool)
    scored[:, 200:] = True
    for i, k in zip(*np.nonzero(np.diff(label, axis=1)), strict=True):
        scored[i, k + 1 : k + 101] = False
    result: dict[str, Any] = {"terminated": int(flown.terminated.sum()), "faulty": float((label[scored] > 0).mean())}
    for name, (method, settings) in HARD_METHODS.items():
        known = {"scenarios": scenarios} if method == "innovation_oracle" else {}
        right = run(make_diagnoser(method, plant, **known, **settings), flown.obs).label == label
        result[name] = [float(right[scored & mask].mean()) for mask in (label >= 0, label > 0, label == 0)]
    alarm = run(make_diagnoser("approximation_detector", plant), flown.obs).alarm
    begin = np.array([min([f.onset for f in s.faults], default=2000) for s in scenarios])
    result["early"] = float(alarm[np.arange(runs), begin].mean())
    return result


INTRODUCTION = """# Pitch-axis missile: the reference figures, measured again

Written by `python -m baselines.reproduction.missile_pitch`. Reference: the data sheet's own implementation. The numbered
episodes (seeds 10000 and 20000 onward) use its generator and order of draws, so they are the same flights.
"""


def main(arguments: Arguments) -> None:
    """Run what is missing and write the page."""
    quick = arguments.quick
    runs, episodes, variants, groups = (20, 60, 30, 1) if quick else (200, 600, 300, 10)
    jobs: dict[str, Any] = {"study": (study, ())}
    for case in reference.ROBUSTNESS:
        label = int(case[5]) if case.startswith("type") else 0
        jobs[f"robustness {case}"] = (robustness, (label, "noisy" in case, runs, "corners" in case))
    jobs |= {f"rate {theta} {gamma}": (rate, (theta, gamma)) for theta, gamma in reference.RATE}
    jobs["fault-free"] = (fault_free, (runs,))
    size = min(BATCH, episodes)
    jobs |= {f"randomised {b}": (randomised, (10000 + size * b, size)) for b in range(episodes // size)}
    part = min(BATCH, variants)
    for noise, scale in reference.VARIANTS:
        for b in range(variants // part):
            jobs[f"variant {noise} {scale} {b}"] = (randomised, (20000 + part * b, part, noise, scale))
    jobs |= {f"hard {g}": (hard, (30000 + 60 * g, 20 if quick else 60)) for g in range(groups)}
    found = pieces(arguments.work / ("quick" if quick else "full"), jobs, arguments.jobs)

    verdicts = Verdicts()
    parts = [found[f"randomised {b}"] for b in range(episodes // size)]
    sections = [
        study_section(found["study"], verdicts), robustness_section(found, verdicts),
        randomised_section(parts, verdicts, not quick), other_sections(found, verdicts, variants, groups, not quick),
    ]  # fmt: skip
    held = sum(row[-1] == "holds" for row in verdicts.rows)
    table = markdown(["claim", "reference", "here", "verdict"], verdicts.rows)
    head = [INTRODUCTION, f"**{held} of {len(verdicts.rows)} claims hold.**\n", table + "\n"]
    if quick:
        head.insert(1, "**Quick run: a tenth of the episodes.**\n")
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "missile_pitch.md").write_text("\n".join([*head, *sections]), encoding="utf-8")
    for name, file, label in (("study", "missile_pitch.png", 1), ("mirror", "missile_pitch_mirror.png", 2)):
        draw_figure(arguments.out / file, found["study"]["figure"][name], found["study"][name], label)
    print(arguments.out / "missile_pitch.md")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
