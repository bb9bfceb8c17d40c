"""The paper's own: Figures 1 to 3, states and faults together, decoupling, stress, other plants, the augmented form."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines.filters.ascdkf import augmented_model
from baselines.filters.augmented_gaussian import gaussian_filter
from baselines.filters.unknown_inputs import decided, known_of
from benchmarks.reproduction.comparison import rms, state_errors
from benchmarks.reproduction.huav_hover.measure import (
    NOISE_SEEDS,
    SETS,
    agreement_plan,
    faulty_steps,
    scenario_piece,
    show,
)
from benchmarks.reproduction.numbered import fly
from benchmarks.reproduction.pieces import Jobs
from fdi_gym.diagnosis import NotApplicableError, find_diagnoser, make_diagnoser, run
from fdi_gym.diagnosis.knowledge import knowledge_of
from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.faults import draw
from fdi_gym.plant import Array
from fdi_gym.plants.huav_hover import CHANNELS, ID, MRAD, U_TRIM, disturbance_rows, paper, prescribed_noise

ROBUST = ("robust_three_stage_cdkf", "robust_three_stage_ekf")
STATISTICAL = ("ascdkf", "three_stage_cdkf", "three_stage_ekf")
NUMBERS = (1, 2, 3)  # the paper's scenarios with faults; 4 is 1 with all filters
SETTLED = slice(101, 1001)  # samples after the first two seconds
SPREAD = 20.0  # of the initial state under stress, in the filter's own standard deviations
X0_STD = np.array([0.1] * 3 + [0.02] * 6 + [0.005] * 2)  # m/s, rad/s and rad, rad: the tuning of the data sheet
EARLY = 5  # samples after which the stress is over


def plan(quick: bool) -> Jobs:
    """What the page needs, the paper's own first."""
    seeds = 2 if quick else len(NOISE_SEEDS)
    jobs: Jobs = {f"figure-{n}": (figure, (n,)) for n in NUMBERS}
    jobs |= {f"states-{n}-{name}": (states, (n, name, seeds)) for n in NUMBERS for name in (*ROBUST[:1], STATISTICAL[1])}
    jobs |= {f"decoupling-{n}-{kappa}": (decoupling, (n, kappa, seeds)) for n in NUMBERS for kappa in (0.0, 1.0)}
    for n in NUMBERS:
        for name in (*ROBUST, *STATISTICAL):
            jobs[f"scenario-3-0.0-{n}-{name}"] = (scenario_piece, (3, 0.0, n, name, seeds))
    jobs |= {f"stress-{name}": (stress, (name, seeds)) for name in (*ROBUST, *STATISTICAL[1:])}
    jobs["form"] = (form, (seeds,))
    jobs |= {f"elsewhere-{name}": (elsewhere, (name, 2 if quick else 20)) for name in (ROBUST[0], STATISTICAL[1])}
    return jobs | agreement_plan(quick)


def states(number: int, name: str, seeds: int) -> dict[str, Any]:
    """RMSE of every estimated state and of the sensors, per flight, faults estimated at the same time."""
    plant = load_plant(ID, kappa=0.0)
    record = fly(plant, [paper(number).replace(noise_seed=s) for s in NOISE_SEEDS[:seeds]], prescribed_noise)
    said = run(make_diagnoser(name, plant, channels=SETS[3]), record.obs)
    assert said.state is not None
    y = plant.split(record.obs)[0]
    return {"states": state_errors(said.state, record.state, SETTLED),
            "sensors": state_errors(y, record.state[..., :9], SETTLED)}  # fmt: skip


def decoupling(number: int, kappa: float, seeds: int) -> dict[str, Any]:
    """Mean error [mrad] of each channel while it is healthy and another is not, per flight; the robust filter."""
    plant = load_plant(ID, kappa=kappa)
    scenarios = [paper(number).replace(noise_seed=s) for s in NOISE_SEEDS[:seeds]]
    record = fly(plant, scenarios, prescribed_noise)
    w = show(make_diagnoser(ROBUST[0], plant, channels=SETS[3]), plant, SETS[3], record.obs)
    truth = record.target[:, 1:, [CHANNELS.index(c) for c in SETS[3]]]
    sets = faulty_steps(scenarios, truth.shape[1], SETS[3])
    found: dict[str, Any] = {}
    for c, channel in enumerate(SETS[3]):
        others = np.delete(sets, c, axis=2).any(axis=2) & ~sets[..., c]
        if others.any():
            found[channel] = [float((w.b - truth)[i, others[i], c].mean() / MRAD) for i in range(seeds)]
    return found


def stress(name: str, seeds: int) -> dict[str, Any]:
    """RMSE of the fault estimates [mrad] over the first samples and the rest, from initial states far beyond the usual."""
    plant = load_plant(ID, kappa=0.0)
    rng = np.random.default_rng(20)
    scenarios = []
    for s in NOISE_SEEDS[:seeds]:
        x0 = plant.trim_state + SPREAD * X0_STD * rng.standard_normal(len(X0_STD)) * np.array([1.0] * 3 + [0.5] * 8)
        scenarios.append(paper(1).replace(noise_seed=s, x0=x0.tolist()))
    record = fly(plant, scenarios, prescribed_noise)
    diagnoser = make_diagnoser(name, plant, channels=SETS[3], x0_std=(SPREAD * X0_STD).tolist())
    w = show(diagnoser, plant, SETS[3], record.obs)
    error = w.b - record.target[:, 1:, [CHANNELS.index(c) for c in SETS[3]]]
    late = [error[i, EARLY : int(n)] for i, n in enumerate(record.length)]
    return {"early": (rms(error[:, :EARLY], axis=1) / MRAD).tolist(), "late": [(rms(e,
    axis=0) / MRAD).tolist() for e in late],
            "lost": int(record.terminated.sum())}  # fmt: skip


def form(seeds: int) -> dict[str, Any]:
    """The augmented filter with its sensors through central differences, as the paper's Table 1 has them, RMSE [mrad].

    The sensors of this plant are linear in the state; ours uses that.
    """
    plant = load_plant(ID, kappa=0.0)
    record = fly(plant, [paper(1).replace(noise_seed=s) for s in NOISE_SEEDS[:seeds]], prescribed_noise)
    entry = find_diagnoser("ascdkf")
    knows = knowledge_of(entry, plant, "standard", entry.resolve(plant, channels=SETS[3]))
    given = {"x0_std": X0_STD.tolist(), "b0_std": 0.002, "d0_std": 0.5, "b_step": 0.0007, "d_step": 0.05}
    known = known_of(plant, knows["belief"], SETS[3], given)
    truth = record.target[:, 1:, [CHANNELS.index(c) for c in SETS[3]]]
    found = {}
    for label, model in (
        ("linear", augmented_model(plant, known)),
        ("differences", augmented_model(plant, known).replace(H=None)),
    ):
        filter = gaussian_filter(model, "central difference", first_sample=False)
        diagnoser = decided(
            plant, known.inputs, filter, knows["calibration"], decision=None, alpha=0.2, thresholds=[1.0] * 3
        )
        said = run(diagnoser, record.obs)
        assert said.estimate is not None
        found[label] = (rms(said.estimate[:, 1:, known.inputs.estimated] - truth, axis=1) / MRAD).tolist()
    return found


def elsewhere(name: str, count: int) -> dict[str, Any]:
    """Every plant: why the filter does not apply, or its error in fault windows beside that of estimating nothing."""
    found: dict[str, Any] = {}
    for plant_id in plant_sources():
        plant = load_plant(plant_id)
        try:
            diagnoser = make_diagnoser(name, plant)
        except NotApplicableError as error:
            found[plant_id] = {"reason": str(error)}
            continue
        record = fly(plant, [draw(plant.process("standard"), 2_100_000 + i) for i in range(count)])
        said = run(diagnoser, record.obs)
        assert said.estimate is not None
        scale = np.array([s.scale for s in plant.estimated])
        faulty = record.label > 0
        error, truth = ((a / scale) ** 2 for a in (said.estimate - record.target, record.target - plant.healthy))
        found[plant_id] = {"ratio": [float(np.sqrt(error[i, m].mean() / truth[i, m].mean()))
                                     for i, m in enumerate(faulty) if m.any() and truth[i, m].any()]}  # fmt: skip
    return found


def figure(number: int) -> dict[str, Any]:
    """What Figures 1 to 3 show, one flight: faults and estimates [mrad], gusts [m/s], actuator positions [mrad]."""
    plant = load_plant(ID, kappa=0.0)
    scenario = paper(number).replace(noise_seed=NOISE_SEEDS[0])
    record = fly(plant, [scenario], prescribed_noise)
    u = plant.split(record.obs)[1][0, 1:]

    def short(a: Array) -> list[list[float]]:
        return [[float(f"{v:.4g}") for v in row] for row in a.tolist()]

    found: dict[str, Any] = {
        "true": short(record.target[0, 1:, 1:] / MRAD), "gust": short(disturbance_rows(scenario)[1:]),
        "command": short((u - U_TRIM)[:, 1:] / MRAD), "position": short((u + record.target[0, 1:] - U_TRIM)[:, 1:] / MRAD),
    }  # fmt: skip
    for name in ROBUST:
        w = show(make_diagnoser(name, plant, channels=SETS[3]), plant, SETS[3], record.obs)
        found[name] = {"b": short(w.b[0] / MRAD), "s": short(w.s[0] / MRAD)}
    return found
