"""The Boeing 747's pieces: each flies scenarios under numbered noise, shows them to one method, and keeps its figures."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from benchmarks.reproduction.comparison import first, rms
from benchmarks.reproduction.numbered import fly
from benchmarks.reproduction.pieces import Jobs, reference
from fdi_gym.diagnosis import Decisions, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import Record
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.metrics import scored_samples
from fdi_gym.plant import Array, Plant
from fdi_gym.plants import b747_lateral as b747

REFERENCE = reference("b747_lateral")
GROUPS = 20  # the reference's seeds, with 20 episodes each
NEVER = 10**6
PAPER_SEED = 500_000  # noise of the paper's scenario
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "TSKF Qz = 0": ("two_stage_kf", {}),
    "TSKF Qz = 1e-6 I": ("two_stage_kf", {"q_bias": 1e-6}),
    "TSKF Qz = 1e-4 I": ("two_stage_kf", {"q_bias": 1e-4}),
    "directional 1e-4": ("two_stage_kf_directional", {}),
    "exponential 0.995": ("two_stage_kf_exponential", {"factor": 0.995}),
    "exponential 0.99": ("two_stage_kf_exponential", {}),
    "directional + threshold logic": ("two_stage_kf_thresholds", {}),
    "restart filter": ("restart_kf", {}),
    "directional 1e-4, structured": ("two_stage_kf_directional", {"structured": True}),
    "exponential 0.99, structured": ("two_stage_kf_exponential", {"structured": True}),
    "Bayes bank": ("bayes_bank", {"decide_every": 10}),
    "known onset": ("known_onset_oracle", {}),
    "exponential 0.96 (8, 50)": ("two_stage_kf_exponential", {"factor": 0.96}),
    "exponential 0.96 (3, 10)": ("two_stage_kf_exponential_fast", {}),
    "switching Bayes bank": ("switching_bayes_bank", {}),
    "known windows": ("known_onset_oracle", {"gamma": (-0.7, -0.2)}),
}
EVERY_TENTH = ("Bayes bank", "known onset", "switching Bayes bank")  # read there only
ABOUT_FAULTS = ("Bayes bank", "known onset")  # not shown flights without any
DETECTORS = {"(1, 0.9999)": (1, 0.9999), "(50, 0.9999)": (50, 0.9999), "(50, 0.999)": (50, 0.999)}


class Sizes(NamedTuple):
    """How much is flown."""

    seeds: int  # of the paper's scenario
    per_group: int  # episodes of the randomised process
    count: int  # with mismatch or simultaneous faults
    hard: int  # intermittent


def sizes(quick: bool) -> Sizes:
    """A tenth or all."""
    return Sizes(4, 2, 40, 20) if quick else Sizes(20, 20, 300, 150)


def agreement_plan(quick: bool) -> Jobs:
    """What the comparison with the second implementation needs."""
    n = sizes(quick)
    jobs: Jobs = {
        f"paper-{method}": (paper_piece, ("multisine", method, n.seeds)) for method in REFERENCE["scenario"]["rmse"]
    }
    for command in REFERENCE["excitation"]:
        jobs[f"command-{command}"] = (paper_piece, (command, "exponential 0.99", n.seeds))
    for variant, methods in REFERENCE["random"].items():
        for method in methods:
            jobs[f"random-{variant}-{method}"] = (random_piece, (variant, method, 700_000, n.per_group))
        for name, detector in DETECTORS.items():
            jobs[f"nis-{variant}-{name}"] = (nis_piece, (variant, *detector, 700_000, n.per_group))
    for delta, methods in REFERENCE["mismatch"].items():
        for method in methods:
            jobs[f"mismatch-{delta}-{method}"] = (mismatch_piece, (float(delta), method, 600_000, n.count))
    for variant, methods in REFERENCE["hard"].items():
        for method in methods:
            jobs[f"hard-{variant}-{method}"] = (hard_piece, (variant, method, 650_000, n.hard))
    for method in REFERENCE["dual"]:
        jobs[f"dual-{method}"] = (dual_piece, (method, 620_000, n.count))
    for variant in REFERENCE["hard_over"]:
        jobs[f"over-{variant}"] = (surface_piece, (variant, "hard-over", 630_000, 2 * n.seeds + 80))
    for variant in REFERENCE["float"]:
        jobs[f"float-{variant}"] = (surface_piece, (variant, "float", 640_000, 2 * n.seeds + 80))
    return jobs


def show(plant: Plant, scenarios: list[FaultScenario], method: str) -> tuple[Record, Decisions]:
    """Fly the scenarios and show them to a method."""
    name, settings = METHODS[method]
    record = fly(plant, scenarios)
    return record, run(make_diagnoser(name, plant, scenarios=scenarios, **settings), record.obs)


def drawn(plant: Plant, process: str, first_seed: int, count: int, delta: float | None = None) -> list[FaultScenario]:
    """Scenarios of a process, seeds from first_seed, with the true plant off the model by delta."""
    perturb = None if delta is None else lambda rng: b747.perturb(rng, delta)
    return [draw(plant.process(process), first_seed + i, perturb) for i in range(count)]


def onsets(scenarios: list[FaultScenario]) -> Array:
    """First onset of each flight (N,)."""
    return np.array([min((f.onset for f in s.faults), default=NEVER) for s in scenarios])


def healthy_alarms(plant: Plant, method: str, seed: int, count: int, delta: float | None = None) -> Array:
    """Where a method alarms on fault-free flights (N, K + 1)."""
    return show(plant, drawn(plant, "fault-free", seed + 50_000, count, delta), method)[1].label > 0


# -- the paper's scenario


def paper_piece(command: str, method: str, seeds: int) -> dict[str, Any]:
    """RMSE and delays over the paper's scenario; columns in the order of the reference table."""
    plant = load_plant(b747.ID)
    scenarios = [b747.paper(command, signs_seed=s).replace(noise_seed=PAPER_SEED + s) for s in range(seeds)]
    record, said = show(plant, scenarios, method)
    assert said.estimate is not None
    # the reference's filter step k takes (u_k, y_{k+1}): what it says stands at sample k + 1
    error, label = (said.estimate - record.target)[:, 1:], said.label[:, 1:]
    onset, end = 2000, 6000
    pre, faulty, post = slice(500, onset), slice(2500, end), slice(6500, 8000)
    gamma_a, gamma_r, b_a, b_r = range(4)
    columns = [(window, entry) for window in (pre, faulty, post) for entry in (gamma_r, b_r)]
    columns += [(faulty, gamma_a), (faulty, b_a)]
    return {
        "rmse": [rms(error[:, window, entry], axis=1).tolist() for window, entry in columns],
        "detection": (first(label[:, onset:] > 0) * b747.DT).tolist(),
        "isolation": (first(label[:, onset:] == 4) * b747.DT).tolist(),
        "release": (first(label[:, end:] == 0) * b747.DT).tolist(),
        "right": [float((label[:, faulty] == 4).mean()), float((label[:, post] == 0).mean())],
        "early": int((label[:, pre] > 0).any(axis=1).sum()),
    }


# -- the randomised process


def random_piece(variant: str, method: str, seed: int, per_group: int) -> dict[str, Any]:
    """All figures of one method on the randomised process and on separate fault-free flights."""
    plant = load_plant(b747.ID, variant=variant)
    scenarios = drawn(plant, "standard", seed, GROUPS * per_group)
    record, said = show(plant, scenarios, method)
    assert said.estimate is not None
    onset, k = onsets(scenarios), np.arange(record.label.shape[1])
    after = k - onset[:, None]
    counted = (k >= 1) & (k % (10 if method in EVERY_TENTH else 1) == 0) & np.full(after.shape, True)
    right, error = said.label == record.label, (said.estimate - record.target) ** 2
    groups = np.split(np.arange(len(scenarios)), GROUPS)
    masks = {"acc": counted, "post": counted & (after > 0), "late": counted & (after > 200)}
    windows = {"pre": (k > 150) & (after <= 0), "transient": (after > 0) & (after <= 200), "late": after > 200}
    found: dict[str, Any] = {
        name: [float(right[g][mask[g]].mean()) for g in groups] for name, mask in masks.items()
    } | detection(onset, first(said.label > 0))  # fmt: skip
    found["final"] = [float(right[g, -1].mean()) for g in groups]
    found["rmse"] = {
        name: np.sqrt([error[g][mask[g]].mean(axis=0) for g in groups]).T.tolist() for name, mask in windows.items()
    }
    found["rmse_all"] = {name: np.sqrt(error[mask].mean(axis=0)).tolist() for name, mask in windows.items()}
    if method not in ABOUT_FAULTS:
        alarms = healthy_alarms(plant, method, seed, len(scenarios))
        found["fa"] = float(alarms.any(axis=1).mean())
        rises = (alarms[:, 1:] & ~alarms[:, :-1]).sum()
        found["fa_h"] = float(rises / (len(alarms) * (len(k) - 1) * b747.DT / 3600))
    return found


def detection(onset: Array, alarm: Array) -> dict[str, Any]:
    """Share of the faults that are detected, and the delays' median and 90 % point [s]."""
    faulty = onset < NEVER
    delay = (alarm - onset)[faulty & (alarm > onset)] * b747.DT
    return {
        "det": delay.size / int(faulty.sum()),
        "faulty": int(faulty.sum()),
        "delay": np.percentile(delay, [50, 90]).tolist(),
    }


def nis_piece(variant: str, window: int, confidence: float, seed: int, per_group: int) -> dict[str, Any]:
    """Detection share, delays and false alarms of a windowed NIS test."""
    plant = load_plant(b747.ID, variant=variant)

    def alarms(process: str, first_seed: int) -> tuple[list[FaultScenario], Array]:
        scenarios = drawn(plant, process, first_seed, GROUPS * per_group)
        diagnoser = make_diagnoser("windowed_nis", plant, window=window, confidence=confidence)
        return scenarios, run(diagnoser, fly(plant, scenarios).obs).alarm

    scenarios, alarm = alarms("standard", seed)
    quiet = alarms("fault-free", seed + 50_000)[1]
    return detection(onsets(scenarios), first(alarm)) | {"fa": float(quiet.any(axis=1).mean())}


# -- mismatch, intermittent and simultaneous faults, single surfaces


def mismatch_piece(delta: float, method: str, seed: int, count: int) -> dict[str, Any]:
    """Accuracy, late accuracy, false alarms with the true plant off the model by delta."""
    plant = load_plant(b747.ID)
    scenarios = drawn(plant, "standard", seed, count, delta)
    record, said = show(plant, scenarios, method)
    right = said.label == record.label
    late = np.arange(right.shape[1]) > onsets(scenarios)[:, None] + 200
    accuracy = right[:, 1:].mean(axis=1)
    return {
        "values": [float(accuracy.mean()), float(right[late].mean()),
                   float(healthy_alarms(plant, method, seed, count, delta).any(axis=1).mean())],
        "acc_error": float(accuracy.std() / math.sqrt(count)), "count": count,
    }  # fmt: skip


def dual_piece(method: str, seed: int, count: int) -> dict[str, Any]:
    """One or two permanent faults, nine labels: acc, post, final, and false alarms on fault-free flights."""
    plant = load_plant(b747.ID, labels="dual")
    scenarios = drawn(plant, "dual", seed, count)
    record, said = show(plant, scenarios, method)
    right = said.label == record.label
    post = np.arange(right.shape[1]) > onsets(scenarios)[:, None]
    accuracy = right[:, 1:].mean(axis=1)
    return {
        "values": [float(accuracy.mean()), float(right[post].mean()), float(right[:, -1].mean()),
                   float(healthy_alarms(plant, method, seed, count).any(axis=1).mean())],
        "acc_error": float(accuracy.std() / math.sqrt(count)), "count": count,
    }  # fmt: skip


def hard_piece(variant: str, method: str, seed: int, count: int) -> dict[str, Any]:
    """Accuracy on the intermittent process: all, inside and outside the fault windows, per group of ten episodes."""
    plant = load_plant(b747.ID, variant=variant)
    record, said = show(plant, drawn(plant, "hard", seed, count), method)
    scoring = plant.process("hard").scoring
    scored = np.array([scored_samples(record.label[i], int(record.length[i]), scoring) for i in range(count)])
    if method in EVERY_TENTH:
        scored &= np.arange(scored.shape[1]) % 10 == 0
    right, faulty = said.label == record.label, record.label > 0
    masks = (scored, scored & faulty, scored & ~faulty)
    tens = [slice(i, i + 10) for i in range(0, count, 10)]
    return {
        "values": [float(right[m].mean()) for m in masks],
        "groups": [[float(right[ten][m[ten]].mean()) for ten in tens] for m in masks],
    }


def surface_piece(variant: str, process: str, seed: int, count: int) -> dict[str, Any]:
    """A floating or hard-over surface: per surface the late accuracy (per episode) and the largest |phi| [deg]."""
    plant = load_plant(b747.ID, variant=variant)
    scenarios = drawn(plant, process, seed, count)
    record, said = show(plant, scenarios, "exponential 0.99")
    k, onset = np.arange(record.label.shape[1]), onsets(scenarios)[:, None]
    late = (k > onset + 200) & (k <= record.length[:, None])
    right = said.label == record.label
    roll = plant.states.index(next(s for s in plant.states if s.name == "phi"))
    found: dict[str, Any] = {"late": [], "phi": []}
    for surface in ("aileron", "rudder"):
        mine = [i for i, s in enumerate(scenarios) if s.faults[0].mode == f"{surface} stuck"]
        found["late"].append([float(right[i][late[i]].mean()) for i in mine if late[i].any()])
        found["phi"].append(float(np.abs(record.state[mine][:, :, roll]).max()))
    return found
