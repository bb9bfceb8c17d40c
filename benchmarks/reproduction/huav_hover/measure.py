"""The helicopter's pieces: filters, oracle and bounds under the noise streams that the data sheet prescribes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from baselines.oracles.matched_oracle import steady_filter
from benchmarks.reproduction.comparison import first, rms
from benchmarks.reproduction.numbered import fly
from benchmarks.reproduction.pieces import Jobs, reference
from fdi_gym.diagnosis import Diagnoser, make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.estimation.belief import fault_inputs
from fdi_gym.estimation.labels import channel_sets
from fdi_gym.faults import FaultScenario
from fdi_gym.plant import Array, Plant
from fdi_gym.plants.huav_hover import (
    CHANNELS,
    DT,
    ID,
    MRAD,
    disturbance_rows,
    episode,
    fault_free_episode,
    paper,
    prescribed_noise,
)

REFERENCE = reference("huav_hover")
SETS = {3: CHANNELS[1:], 4: CHANNELS}  # the paper's fault channels, and all
KAPPAS = (0.0, 0.3, 1.0)
NOISE_SEEDS = range(100, 124)
KINDS = ("bias", "stuck_at", "stuck_hold", "float_square", "float_free", "loe")
BOUND_AFTER = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # s
ORACLE_WINDOWS = {"0.2": 10, "0.5": 25, "1.0": 50, "2.0": 100, "rest": None}  # s: samples
DETECTED = 10.83  # chi-square of one degree of freedom, 0.1 %


def agreement_plan(quick: bool) -> Jobs:
    """What the comparison with the second implementation needs."""
    seeds, count, oracle = (2, 4, 40) if quick else (24, 100, 400)
    jobs: Jobs = {}
    for key in map(scenario_key, REFERENCE["scenario"]):
        jobs["scenario-{}-{}-{}-{}".format(*key)] = (scenario_piece, (*key, seeds))
    for r in REFERENCE["random"]:
        jobs[f"random-{r['kappa']}-{r['filter']}"] = (random_piece, (r["kappa"], r["filter"], count))
    for r in REFERENCE["threshold"]:
        key = (r["channels"], r["kappa"], r["filter"])
        jobs["threshold-{}-{}-{}".format(*key)] = (threshold_piece, (*key, 3 if quick else 100))
    for kappa in KAPPAS:
        jobs[f"bound-{kappa}"] = (bound_piece, (kappa,))
        jobs[f"oracle-{kappa}"] = (oracle_piece, (kappa, oracle))
    for step in REFERENCE["walk"]:
        jobs[f"walk-{step}"] = (scenario_piece, (3, 0.0, 1, "three_stage_ekf", seeds, float(step)))
    return jobs


def scenario_key(r: dict[str, Any]) -> tuple[int, float, int, str]:
    """Channels, kappa, number and filter of a row of the reference."""
    return r["channels"], r["kappa"], r["number"], r["filter"]


# -- what a filter says, and what became of it


class Said(NamedTuple):
    """What a filter made of flights; row k belongs to step k (its estimate from y_{k+1}, u_c,k)."""

    b: Array  # (N, K, p) raw estimate
    s: Array  # (N, K, p) smoothed estimate, NaN where the filter has none
    d: Array  # (N, K, 2) disturbance, likewise
    on: Array  # (N, K, p) flagged channels


def show(diagnoser: Diagnoser, plant: Plant, channels: tuple[str, ...], obs: Array) -> Said:
    """Show flights to a filter: its estimates, and its signals or, where it has no flags, the channels of its label."""
    inputs = fault_inputs(plant, channels)
    said = run(diagnoser, obs, signals=True)
    assert said.estimate is not None
    b, signals = said.estimate[:, 1:, inputs.estimated], said.signals or {}
    missing = np.full_like(b, np.nan)
    labels, sets = channel_sets(plant, inputs)
    position = np.searchsorted(labels, np.maximum(said.label[:, 1:], 0))
    return Said(
        b, signals["smoothed"][:, 1:] if "smoothed" in signals else missing,
        signals["disturbance"][:, 1:] if "disturbance" in signals else missing[..., :2],
        signals["channels_on"][:, 1:] > 0 if "channels_on" in signals else sets[position],
    )  # fmt: skip


class Window(NamedTuple):
    """One fault, as far as it counts."""

    flight: int
    channel: int
    onset: int
    end: int
    kind: str


def windows(scenarios: list[FaultScenario], last: Array, channels: tuple[str, ...]) -> list[Window]:
    """Every fault of these channels that begins before the flight's last counted step."""
    return [
        Window(i, channels.index(f.mode), f.onset, min(f.end or 10**9, int(last[i])), f.kind)
        for i, scenario in enumerate(scenarios) for f in scenario.faults if f.mode in channels and f.onset < last[i]
    ]  # fmt: skip


def faulty_steps(scenarios: list[FaultScenario], steps: int, channels: tuple[str, ...]) -> Array:
    """True fault sets (N, K, p)."""
    truth = np.zeros((len(scenarios), steps, len(channels)), bool)
    for w in windows(scenarios, np.full(len(scenarios), steps), channels):
        truth[w.flight, w.onset : w.end, w.channel] = True
    return truth


def wrong_flags(on: Array, truth: Array, counted: Array) -> int:
    """Flags raised on a channel that is healthy and was so for the second before."""
    risen = on & ~np.concatenate([np.zeros_like(on[:, :1]), on[:, :-1]], axis=1)
    recent = truth.copy()
    for back in range(1, round(1 / DT) + 1):
        recent[:, back:] |= truth[:, :-back]
    return int((risen & ~recent & counted[:, :, None]).sum())


class Delays(NamedTuple):
    """Faults and the time [s] from onset to flag, NaN where it never came while the fault acted."""

    faults: list[Window]
    seconds: Array

    def of(self, mine: Array) -> tuple[list[int], float | None]:
        """[flagged, of how many] and mean delay of some of the faults."""
        flagged = self.seconds[mine & np.isfinite(self.seconds)]
        return [flagged.size, int(mine.sum())], float(flagged.mean()) if flagged.size else None

    def by_channel(self, p: int) -> tuple[list[list[int]], list[float | None]]:
        """The same for each channel."""
        found = [self.of(np.array([w.channel == c for w in self.faults], bool)) for c in range(p)]
        return [counts for counts, _ in found], [mean for _, mean in found]


def delays(on: Array, faults: list[Window]) -> Delays:
    """When each fault was flagged on its channel."""
    waited = [(first(on[w.flight, None, w.onset : w.end, w.channel])[0] + 1) * DT for w in faults]
    return Delays(faults, np.array(waited))


# -- pieces


def scenario_piece(
    p: int, kappa: float, number: int, name: str, seeds: int, walk: float | None = None
) -> dict[str, Any]:  # fmt: skip
    """One filter on one of the source's scenarios; `walk`: of the fault per step [rad], where it is not the paper's."""
    channels, plant = SETS[p], load_plant(ID, kappa=kappa)
    scenarios = [paper(number).replace(noise_seed=s) for s in NOISE_SEEDS[:seeds]]
    record = fly(plant, scenarios, prescribed_noise)
    tuning: dict[str, Any] = {} if walk is None else {"b_step": walk}
    w = show(make_diagnoser(name, plant, channels=channels, **tuning), plant, channels, record.obs)
    truth = record.target[:, 1:, [CHANNELS.index(c) for c in channels]]
    sets = faulty_steps(scenarios, truth.shape[1], channels)
    waited = delays(w.on, windows(scenarios, record.length, channels))
    raw = rms(w.b - truth, axis=1) / MRAD
    return {
        "rmse": raw.mean(axis=0).tolist(), "smoothed": (rms(w.s - truth, axis=(0, 1)) / MRAD).tolist(),
        "d": rms(w.d - disturbance_rows(scenarios[0])[:-1], axis=(0, 1)).tolist(),
        "detected": waited.of(np.ones(len(waited.faults), bool))[0], "delay": waited.by_channel(p)[1],
        "false": wrong_flags(w.on, sets, np.ones(sets.shape[:2], bool)),
        "accuracy": float((w.on == sets).all(axis=2).mean()),
        "raw": raw.tolist(),
    }  # fmt: skip


def random_piece(kappa: float, name: str, count: int) -> dict[str, Any]:
    """One filter on the randomised process and on fault-free flights."""
    plant = load_plant(ID, kappa=kappa)
    scenarios = [episode(s) for s in range(count)]
    record = fly(plant, scenarios, prescribed_noise)
    w = show(make_diagnoser(name, plant), plant, CHANNELS, record.obs)
    steps = w.on.shape[1]
    last = np.where(record.terminated, record.length - 1, record.length)  # a step that ends the flight does not count
    counted = np.arange(steps) < last[:, None]
    sets = faulty_steps(scenarios, steps, CHANNELS)
    waited = delays(w.on, windows(scenarios, last, CHANNELS))
    detected, delay = waited.by_channel(len(CHANNELS))
    right, healthy = (w.on == sets).all(axis=2), np.asarray(~sets.any(axis=2))
    d = np.array([disturbance_rows(s)[:-1] for s in scenarios])
    quiet = fly(plant, [fault_free_episode(s) for s in range(6000, 6000 + count)], prescribed_noise)
    flags = show(make_diagnoser(name, plant), plant, CHANNELS, quiet.obs).on
    kinds = np.array([fault.kind for fault in waited.faults])
    return {
        "rmse": (rms((w.b - record.target[:, 1:])[counted], axis=0) / MRAD).tolist(),
        "d": rms((w.d - d)[counted], axis=0).tolist() if np.isfinite(w.d).any() else None,
        "accuracy": [float(right[m].mean()) for m in (counted, counted & ~healthy, counted & healthy)],
        "detected": detected, "delay": delay, "first": first_flags(w.on, scenarios, last),
        "false_flights": float(flags.any(axis=(1, 2)).mean()), "wrong": wrong_flags(w.on, sets, counted),
        "kinds": {kind: waited.of(kinds == kind)[0] for kind in np.unique(kinds).tolist()},
        "none": float(healthy[counted].mean()), "terminated": float(record.terminated.mean()),
    }  # fmt: skip


def first_flags(on: Array, scenarios: list[FaultScenario], last: Array) -> list[int]:
    """Of single faults: those whose first flags are right, how many there are, those without any flag until 1 s after."""
    right = none = single = 0
    for w in windows(scenarios, last, CHANNELS):
        if len(scenarios[w.flight].faults) == 1:
            end = scenarios[w.flight].faults[0].end or on.shape[1]
            rows = on[w.flight, w.onset : min(end + round(1 / DT), int(last[w.flight]))]
            some = np.flatnonzero(rows.any(axis=1))
            single += 1
            none += not some.size
            right += bool(some.size and (rows[some[0]] == (np.arange(len(CHANNELS)) == w.channel)).all())
    return [right, single, none]


def threshold_piece(p: int, kappa: float, name: str, count: int) -> list[float]:
    """Thresholds [mrad] from the fault-free flights: 99 % quantiles of the largest smoothed magnitude."""
    plant = load_plant(ID, kappa=kappa)
    obs = fly(plant, [fault_free_episode(s) for s in range(5000, 5000 + count)], prescribed_noise).obs
    said = show(make_diagnoser(name, plant, channels=SETS[p]), plant, SETS[p], obs)
    return (np.quantile(np.abs(said.s).max(axis=1), 0.99, axis=0) / MRAD).tolist()


def bound_piece(kappa: float) -> list[list[list[float]]]:
    """Bounds on a bias with known onset [mrad], alone and with the others unknown, from the whitened signatures of steps."""
    plant = load_plant(ID, kappa=kappa)
    m = steady_filter(plant, fault_inputs(plant), 0.05)
    still, white = np.eye(len(m.A)) - m.K @ m.H, np.linalg.inv(np.linalg.cholesky(m.C))
    s, information, bounds = np.zeros(m.Bf.shape), np.zeros((len(CHANNELS),) * 2), []
    wanted = [round(T / DT) for T in BOUND_AFTER]
    for k in range(1, wanted[-1] + 1):
        moved = m.A @ s + m.Bf
        signature = white @ m.H @ moved
        information, s = information + signature.T @ signature, still @ moved
        if k in wanted:
            jointly = np.sqrt(np.diag(np.linalg.inv(information)))
            bounds.append([(1 / np.sqrt(np.diag(information)) / MRAD).tolist(), (jointly / MRAD).tolist()])
    return bounds


def oracle_piece(kappa: float, count: int) -> dict[str, list[float]]:
    """Share of single faults that the matched oracle attributes within a window: all, by channel, by kind; NaN of none."""
    plant = load_plant(ID, kappa=kappa)
    scenarios = [s for s in map(episode, range(count)) if len(s.faults) == 1]
    record = fly(plant, scenarios, prescribed_noise)
    diagnoser = make_diagnoser("matched_oracle", plant, scenarios=scenarios)
    energy = (run(diagnoser, record.obs, signals=True).signals or {})["energy"]
    faults = [s.faults[0] for s in scenarios]
    truth, kinds = np.array([CHANNELS.index(f.mode) for f in faults]), np.array([f.kind for f in faults])
    onset, end = (np.array([getattr(f, name) for f in faults]) for name in ("onset", "end"))
    right = (energy.argmax(axis=2) == truth[:, None]) & (energy.max(axis=2) > DETECTED)
    groups = [truth >= 0, *(truth == c for c in range(len(CHANNELS))), *(kinds == kind for kind in KINDS)]
    found = {}
    for name, window in ORACLE_WINDOWS.items():
        until = record.length if window is None else np.minimum(onset + window, np.minimum(end, record.length))
        ok = right[np.arange(len(faults)), until]
        found[name] = [float(ok[g].mean()) if g.any() else float("nan") for g in groups]
    return found
