"""Monte-Carlo campaign on the satellite, resumable block by block: `python -m baselines.reproduction.cmg_campaign`.

The episodes of a variant are the same for every method and noise level. A block is flown and diagnosed together, and
its outcomes are one JSON file in --work, so a killed campaign goes on where it was.
"""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from baselines.oracles.mekf_clairvoyant import changes
from baselines.reproduction.numbered import fly
from baselines.reproduction.tables import pieces
from fdi_gym.diagnosis import find_diagnoser, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import Record
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant
from fdi_gym.plants import cmg_satellite as cmg

METHODS = {
    "UKF": "joint_ukf", "CAUKF": "caukf", "GAUKF": "gaukf", "SGAUKF": "sgaukf", "SGAUKF-odd": "sgaukf_odd",
    "dual GAUKF": "dual_gaukf", "dual SGAUKF": "dual_sgaukf", "MEKF": "mekf", "CLAIR": "mekf_clairvoyant",
    "oracle": "cramer_rao_oracle", "GAUKF, sigma_R 1e-4": "gaukf", "SGAUKF, sigma_R 1e-4": "sgaukf",
}  # fmt: skip
# what the oracle is told of the severities
ALPHA = {"bench": (0.1, 0.9), "table5": (0.0, 1.0), "table4": (0.5, 0.9), "hard": (0.02, 0.4)}
PER_BLOCK = {"bench": 5, "table5": 3, "severity": 2}  # episodes per fault label in a block
HARD_BLOCK, TABLE_4_BLOCK = 30, 10


class Piece(NamedTuple):
    """One block of a campaign. `level` is the mismatch of "hard" and the severity of "severity"."""

    variant: str
    reference: str
    snr: int
    method: str
    block: int
    level: float = 0.01

    def name(self) -> str:
        """Its file."""
        level = f"-{self.level:g}" if self.variant in ("hard", "severity") else ""
        method = METHODS[self.method] + ("-sigma_r" if "sigma_R" in self.method else "")
        return f"{self.variant}{level}-{self.reference}-{self.snr}-{method}-{self.block:03d}"


def scenarios_of(p: Piece) -> list[FaultScenario]:
    """The block's episodes: they depend on the variant, reference, level and block alone."""
    number = {"bench": 0, "table5": 1, "table4": 2, "hard": 3, "severity": 4}[p.variant]
    key = [20_231_123, number, int(p.reference == "slew"), p.block]
    found = []
    if p.variant in PER_BLOCK:
        for label in range(1, 16):
            for repeat in range(PER_BLOCK[p.variant]):
                rng = np.random.default_rng([*key, label, repeat])
                if p.variant == "bench":
                    scenario = cmg.bench(rng, label, p.reference)
                elif p.variant == "table5":
                    scenario = cmg.table5(rng, label, p.reference)
                    if p.reference == "regulate":
                        scenario = scenario.replace(x0=cmg.tumble(rng))
                else:  # 30 s at one severity, from 15 s on
                    faults = [cmg.loss(i, p.level, 1500, 4500) for i in cmg.SETS[label]]
                    scenario = FaultScenario(plant=cmg.ID, steps=4500, faults=faults, reference={"profile": p.reference})
                found.append(scenario.replace(noise_seed=int(rng.integers(2**62))))
        return found
    for i in range(HARD_BLOCK if p.variant == "hard" else TABLE_4_BLOCK):
        rng = np.random.default_rng([*key, i])
        scenario = cmg.table4(p.reference)
        if p.variant == "hard":
            scenario = cmg.intermittent(rng, p.reference).replace(physical=cmg.perturb(rng, p.level))
        found.append(scenario.replace(noise_seed=int(rng.integers(2**62))))
    return found


class Watched(NamedTuple):
    """What a method said over a block."""

    estimate: Array  # (N, K + 1, 4)
    label: Array  # (N, K + 1)
    sd: Array  # (N, K + 1) sqrt(trace(P_ff) / 4)
    flag: Array  # (N, K + 1) fault flag or reset
    filter_steps: Array  # (N,) steps of the filter, candidates included
    seconds: float  # processor time of the filter, all episodes


def watch(plant: Plant, scenarios: list[FaultScenario], record: Record, method: str, **tuning: Any) -> Watched:
    """Show a block to a method."""
    name = METHODS[method]
    known = {"scenarios": scenarios} if find_diagnoser(name).clairvoyant else {}
    diagnoser = make_diagnoser(name, plant, **known, **tuning)
    n, samples, _ = record.obs.shape
    begun = time.process_time()
    said = run(diagnoser, record.obs, signals=True)
    seconds = time.process_time() - begun
    assert said.estimate is not None
    assert said.estimate_std is not None
    sd, signals = np.sqrt((said.estimate_std**2).mean(axis=2)), said.signals or {}
    flag = signals["flag"] > 0 if "flag" in signals else np.zeros((n, samples), bool)
    per_step = {"caukf": 40, "gaukf": 16, "sgaukf": 4, "sgaukf_odd": 4, "dual_gaukf": 16, "dual_sgaukf": 4}.get(name, 0)
    adapted = signals["adapted"][:, -1].astype(np.int64) if "adapted" in signals else np.zeros(n, np.int64)
    return Watched(said.estimate, said.label.astype(np.int64), sd, flag, samples - 1 + per_step * adapted, seconds)


def rmse(error: Array) -> float | None:
    """Root mean square over samples and units; None of nothing."""
    return float(np.sqrt((error**2).mean())) if error.size else None


def most_frequent(labels: Array) -> int:
    """The most frequent label, the lowest on ties; healthy where there is none."""
    return int(np.bincount(np.maximum(labels, 0), minlength=16).argmax()) if labels.size else 0


def window_outcome(record: Record, said: Watched, i: int, a: int, b: int) -> dict[str, Any]:
    """An episode with one window of faulty steps a <= k < b."""
    K = int(record.length[i])
    b = min(b, K)
    error = said.estimate[i] - record.theta[i]
    truth = int(record.label[i, min(a + 1, K)]) if a < b else 0
    half = slice((a + b) // 2, b)
    inside = slice(a + 1, b + 1)
    flags = np.flatnonzero(said.flag[i, a + 1 : b + 1])
    right = np.flatnonzero(said.label[i, inside] == record.label[i, inside])
    k = np.arange(K + 1)
    scored = (k >= 1) & ~((k > a) & (k <= a + 300)) & ~((k > b) & (k <= b + 300))
    return {
        "truth": truth,
        "decided": most_frequent(said.label[i, half]),
        "pre": rmse(error[min(500, a // 2) : a]),
        "faulty": rmse(error[a + 1 : b]),
        "post": rmse(error[b + 1 : K + 1]),
        "flagged": bool(flags.size),
        "delay": float((flags[0] + 1) * cmg.DT) if flags.size else None,
        "isolated": float((right[0] + 1) * cmg.DT) if right.size else None,
        "false_alarm": bool(said.flag[i, 100 : a + 1].any()),
        "inside": float((said.label[i, inside] == record.label[i, inside]).mean()) if b > a else None,
        "scored": float((said.label[i, : K + 1] == record.label[i, : K + 1])[scored].mean()),
        "sd": float(said.sd[i, b]),
        "at_end": int(said.label[i, b]),
        "terminated": bool(record.terminated[i]),
        "steps": int(said.filter_steps[i]),
    }


def table4_outcome(record: Record, said: Watched, i: int) -> dict[str, Any]:
    """An episode of the source's time line."""
    error, K = said.estimate[i] - record.theta[i], int(record.length[i])
    return {
        "pre": rmse(error[500:2000]), "faulty": rmse(error[2001:15000]), "post": rmse(error[15001 : K + 1]),
        "right": float((said.label[i, : K + 1] == record.label[i, : K + 1]).mean()),
        "flags": int(said.flag[i].sum()), "at_once": bool(said.flag[i, 15001]), "sd": rmse(said.sd[i, 2001:15000]),
        "steps": int(said.filter_steps[i]), "terminated": bool(record.terminated[i]),
    }  # fmt: skip


def hard_outcome(plant: Plant, scenario: FaultScenario, record: Record, said: Watched, i: int) -> dict[str, Any]:
    """An episode of "hard": sample and segment accuracy."""
    K = int(record.length[i])
    change = changes(plant, [scenario])[0][: K + 1]
    k = np.arange(K + 1)
    # the last change j <= k - 1
    last = np.maximum.accumulate(np.where(change, k, -(10**6)))
    last = np.concatenate([[-(10**6)], last[:-1]])
    scored = (k >= 500) & (k - last > 100)
    truth, error = record.label[i, : K + 1], said.estimate[i, : K + 1] - record.theta[i, : K + 1]
    bits = np.array([sum(2**j for j in s) for s in cmg.SETS])
    wide = ((1.0 - said.estimate[i, : K + 1] > 0.08) @ 2 ** np.arange(4)) == bits[truth]
    right = said.label[i, : K + 1] == truth
    faulty = scored & (truth > 0)
    edges = [0, *np.flatnonzero(change).tolist(), K]
    segments, at_end = [], []
    for a, b in itertools.pairwise(edges):
        a = max(a, 500)
        if b - a >= 300:
            segments.append(most_frequent(said.label[i, (a + b) // 2 + 1 : b + 1]) == truth[b])
            at_end.append(bool(said.label[i, b] == truth[b]))
    return {
        "sample": float(right[scored].mean()), "wide": float(wide[scored].mean()),
        "faulty": float(right[faulty].mean()) if faulty.any() else None,
        "segment": float(np.mean(segments)), "at_end": float(np.mean(at_end)), "rmse": rmse(error[scored]),
        "sd": float(said.sd[i, 500 : K + 1].mean()), "changes": int(change.sum()),
        "none": float((truth[scored] == 0).mean()), "det": float(cmg.singularity(record.state[i, :, 7:]).min()),
        "steps": int(said.filter_steps[i]),
    }  # fmt: skip


def run_piece(p: Piece) -> dict[str, Any]:
    """Fly and diagnose a block: {"outcomes": one per episode, "seconds": of the filter}."""
    plant = load_plant(cmg.ID, reference=p.reference, snr=p.snr)
    scenarios = scenarios_of(p)
    tuning: dict[str, Any] = {"sigma_r": 1e-4} if "sigma_R" in p.method else {}
    if p.method == "oracle":
        low, high = (max(p.level - 0.005, 0.0), p.level + 0.005) if p.variant == "severity" else ALPHA[p.variant]
        tuning = {"alpha_min": low, "alpha_max": high}
    record = fly(plant, scenarios)
    said = watch(plant, scenarios, record, p.method, **tuning)
    outcomes = []
    for i, scenario in enumerate(scenarios):
        if p.variant == "table4":
            outcomes.append(table4_outcome(record, said, i))
        elif p.variant == "hard":
            outcomes.append(hard_outcome(plant, scenario, record, said, i))
        else:
            a, b = scenario.faults[0].onset, scenario.faults[0].end
            assert b is not None
            alphas = [1.0 - fault.effects[0].value for fault in scenario.faults]  # type: ignore[union-attr]
            outcomes.append(window_outcome(record, said, i, a, b) | {"onset": a, "end": b, "alpha": alphas})
    return {"outcomes": outcomes, "seconds": said.seconds, "samples": int(record.length.sum())}


def campaign(work: Path, wanted: list[Piece], workers: int) -> dict[Piece, dict[str, Any]]:
    """Run the blocks that are missing, and read all."""
    done = pieces(work, {p.name(): (run_piece, (p,)) for p in wanted}, workers)
    return {p: done[p.name()] for p in wanted}


def main(
    variant: str = "bench",
    reference: str = "slew",
    snr: tuple[int, ...] = (45, 55, 75),
    methods: tuple[str, ...] = ("SGAUKF",),
    episodes: int = 20,
    level: float = 0.01,
    workers: int = -1,
    work: Path = Path("runs/reproduction-cmg"),
) -> None:
    """Run a campaign and print its accuracy.

    Args:
        variant: "bench", "table5", "severity" (episodes per fault label), "hard" or "table4" (episodes in all).
        reference: "slew" or "regulate".
        snr: Noise levels [dB].
        methods: As the tables call them.
        episodes: Per fault label or in all; whole blocks are flown.
        level: Mismatch of "hard", severity of "severity".
        workers: Processes; -1 for one per core.
        work: Folder of the finished blocks.
    """
    per_block = PER_BLOCK.get(variant, HARD_BLOCK if variant == "hard" else TABLE_4_BLOCK)
    blocks = range(-(-episodes // per_block))
    wanted = [Piece(variant, reference, s, m, b, level) for s in snr for m in methods for b in blocks]
    found = campaign(work, wanted, workers)
    for s in snr:
        for m in methods:
            mine = [found[p] for p in wanted if (p.snr, p.method) == (s, m)]
            outcomes = [o for piece in mine for o in piece["outcomes"]]
            if variant in PER_BLOCK:
                right = np.mean([o["decided"] == o["truth"] for o in outcomes])
            else:
                right = np.mean([o["sample" if variant == "hard" else "right"] for o in outcomes])
            seconds = sum(piece["seconds"] for piece in mine)
            print(f"{s} dB {m}: {100 * right:.1f} % of {len(outcomes)} episodes, {seconds:.0f} s of processor time")


if __name__ == "__main__":
    tyro.cli(main)
