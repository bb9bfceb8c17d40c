"""What becomes of an episode of the satellite: which samples count, and when."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np

from baselines.oracles.mekf_clairvoyant import changes
from benchmarks.reproduction.comparison import rms
from fdi_gym.engine import Record
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant
from fdi_gym.plants import cmg_satellite as cmg

WIDE = 0.08  # a loss beyond which a unit counts as faulty, where the label's own threshold is thought too small


class Said(NamedTuple):
    """What a method said over a block."""

    estimate: Array  # (N, K + 1, 4)
    label: Array  # (N, K + 1)
    sd: Array  # (N, K + 1) sqrt(trace(P_ff) / 4)
    flag: Array  # (N, K + 1) fault flag or reset
    filter_steps: Array  # (N,) steps of the filter, candidates included
    seconds: float  # processor time of the filter, all episodes
    adapted: Array  # (N,) steps in which the covariance was adapted
    state: Array | None = None  # (N, K + 1, 11)


def rmse(error: Array) -> float | None:
    """Root mean square over samples and units; None of nothing."""
    return float(rms(error)) if error.size else None


def most_frequent(labels: Array) -> int:
    """The most frequent label, the lowest on ties; healthy where there is none."""
    return int(np.bincount(np.maximum(labels, 0), minlength=16).argmax()) if labels.size else 0


def since(condition: Array) -> float | None:
    """Time [s] from the sample before the first of these to the first where it holds; None where none does."""
    return float((condition.argmax() + 1) * cmg.DT) if condition.any() else None


def window_outcome(record: Record, said: Said, i: int, a: int, b: int) -> dict[str, Any]:
    """An episode with one window of faulty steps a <= k < b."""
    K = int(record.length[i])
    b = min(b, K)
    error, right = said.estimate[i] - record.theta[i], said.label[i, : K + 1] == record.label[i, : K + 1]
    inside = slice(a + 1, b + 1)
    delay = since(said.flag[i, inside])
    k = np.arange(K + 1)
    scored = (k >= 1) & ~((k > a) & (k <= a + 300)) & ~((k > b) & (k <= b + 300))
    return {
        "truth": int(record.label[i, min(a + 1, K)]) if a < b else 0,
        "decided": most_frequent(said.label[i, (a + b) // 2 : b]),
        "pre": rmse(error[min(500, a // 2) : a]),
        "faulty": rmse(error[a + 1 : b]),
        "post": rmse(error[b + 1 : K + 1]),
        "flagged": delay is not None,
        "delay": delay,
        "isolated": since(right[inside]),
        "false_alarm": bool(said.flag[i, 100 : a + 1].any()),
        "inside": float(right[inside].mean()) if b > a else None,
        "scored": float(right[scored].mean()),
        "sd": float(said.sd[i, b]),
        "right_at_end": bool(right[b]),
        "steps": int(said.filter_steps[i]),
    }


def state_errors(record: Record, said: Said, i: int) -> list[float] | None:
    """RMSE of the attitude's vector part, the rate [rad/s] and the gimbal angles [rad] from 5 s on."""
    if said.state is None:
        return None
    error = (said.state[i] - record.state[i])[500 : int(record.length[i]) + 1]
    return [float(rms(error[:, part])) for part in (slice(0, 3), slice(4, 7), slice(7, 11))]


def time_line_outcome(record: Record, said: Said, i: int) -> dict[str, Any]:
    """An episode of the source's Table 4: faults from 20 s to 150 s."""
    K = int(record.length[i])
    error, onset, end = said.estimate[i] - record.theta[i], 2000, 15000
    return {
        "pre": rmse(error[500:onset]), "faulty": rmse(error[onset + 1 : end]), "post": rmse(error[end + 1 : K + 1]),
        "right": float((said.label[i, : K + 1] == record.label[i, : K + 1]).mean()),
        "flags": int(said.flag[i].sum()), "at_once": bool(said.flag[i, end + 1]), "sd": rmse(said.sd[i, onset + 1 : end]),
        "steps": int(said.filter_steps[i]), "adapted": int(said.adapted[i]), "state": state_errors(record, said, i),
    }  # fmt: skip


def hard_outcome(plant: Plant, scenario: FaultScenario, record: Record, said: Said, i: int) -> dict[str, Any]:
    """An episode of "hard": sample and segment accuracy."""
    K = int(record.length[i])
    change = changes(plant, [scenario])[0][: K + 1]
    k = np.arange(K + 1)
    last = np.maximum.accumulate(np.where(change, k, -(10**6)))
    last = np.concatenate([[-(10**6)], last[:-1]])  # the last change j <= k - 1
    scored = (k >= 500) & (k - last > 100)
    truth, estimate = record.label[i, : K + 1], said.estimate[i, : K + 1]
    bits = np.array([sum(2**j for j in s) for s in cmg.SETS])
    wide = ((1.0 - estimate > WIDE) @ 2 ** np.arange(4)) == bits[truth]
    right = said.label[i, : K + 1] == truth
    segments, at_end = [], []
    for a, b in itertools.pairwise([0, *np.flatnonzero(change).tolist(), K]):
        a = max(a, 500)
        if b - a >= 300:
            segments.append(most_frequent(said.label[i, (a + b) // 2 + 1 : b + 1]) == truth[b])
            at_end.append(bool(right[b]))
    return {
        "sample": float(right[scored].mean()), "wide": float(wide[scored].mean()),
        "segment": float(np.mean(segments)), "at_end": float(np.mean(at_end)),
        "rmse": rmse((estimate - record.theta[i, : K + 1])[scored]), "sd": float(said.sd[i, 500 : K + 1].mean()),
    }  # fmt: skip
