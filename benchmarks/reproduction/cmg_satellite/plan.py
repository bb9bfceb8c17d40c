"""What the satellite's page needs: the blocks, and pieces that are none."""

from __future__ import annotations

from typing import Any

import numpy as np

from baselines.filters.mekf import first_covariance
from baselines.oracles.cramer_rao_oracle import Q_FLOOR, bound_step, opened
from benchmarks.reproduction.cmg_satellite.blocks import SIGMA_R, Block, block_piece, scenarios_of, show
from benchmarks.reproduction.cmg_satellite.outcomes import time_line_outcome
from benchmarks.reproduction.cmg_satellite.paper import GRIDS, LEVELS, own_plan
from benchmarks.reproduction.numbered import fly
from benchmarks.reproduction.pieces import Jobs, reference
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate, white_noise
from fdi_gym.faults import FaultScenario
from fdi_gym.plants import cmg_satellite as cmg

REFERENCE = reference("cmg_satellite")
SEVERITIES = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.9)
SEVERITY_METHODS = ("SGAUKF", "MEKF", "CLAIR", "oracle")
# Table 4 at 75 dB, where the reference's one flight is far from our mean: how far single flights are apart
SINGLE_FLIGHTS = (("slew", "GAUKF"), ("slew", "CAUKF"), ("regulate", "UKF"))
CAMPAIGN = 20  # blocks of Table 5's ranges: 1,500 flights, 100 of each fault label, as the source has them
AFTER = (100, 300, 1000, 3000)  # samples after the onset at which the bound is read
BOUND_ONSETS = (4000, 10000)
# other readings of the data sheet's regulation at 75 dB: options of the plant, process noise, tuning of the filter
TRIED: dict[str, tuple[dict[str, Any], float, dict[str, Any]]] = {
    "as the data sheet": ({}, 1.0, {}),
    "pseudo-inverse steering": ({"steering": "pinv"}, 1.0, {}),
    "true-state feedback": ({"feedback": "true"}, 1.0, {}),
    "no process noise": ({}, 0.0, {}),
    "R = (1e-4)^2 I": ({}, 1.0, {"sigma_r": 1e-4}),
}


def plan(quick: bool) -> Jobs:
    """All pieces: the source's own, the time line that its tables are of, its campaign, and then the rest."""
    count = 2 if quick else 8
    jobs = own_plan(quick) | {b.name(): (block_piece, (b,)) for b in blocks(quick)}
    for g, levels in REFERENCE["bound"].items():
        for s in levels:
            for onset in BOUND_ONSETS:
                jobs[f"bound-{g}-{s}-{onset}"] = (bound_piece, (g, int(s), onset, count))
    jobs["bound-null"] = (bound_piece, ("regulate", 55, BOUND_ONSETS[0], count, "null"))
    return jobs | {f"tried-{i}": (tried_piece, (name,)) for i, name in enumerate(TRIED)}


def is_campaign(b: Block) -> bool:
    """Whether a block belongs to the campaign at the source's size."""
    return b.variant == "table5" and b.method in GRIDS and b.reference == "slew"


def campaign_blocks(quick: bool) -> list[Block]:
    """The source's campaign: 1,500 flights of Table 5's ranges for each filter and noise level, on the slew.

    Its own case, regulating, where no filter sees anything, once for each. Block by block, so that the flights of all
    filters and levels are as many at any time.
    """
    slew, regulate = (
        [[Block("table5", g, s, m, b) for s in LEVELS for m in GRIDS] for b in range(1 if quick else n)]
        for g, n in (("slew", CAMPAIGN), ("regulate", 1))
    )
    return [b for part in (*slew[:1], *regulate, *slew[1:]) for b in part]


def blocks(quick: bool) -> list[Block]:
    """The blocks of the page, the source's campaign first; one of each kind for a quick run."""

    def several(n: int) -> range:
        return range(1 if quick else n)

    grids = [Block("bench", "slew", s, m, b) for s in LEVELS for m in GRIDS for b in several(4)]
    slew = REFERENCE["table_4"]["slew"]
    table4 = [Block("table4", "slew", s, m) for s in LEVELS for m in slew]
    table4 += [Block("table4", "regulate", s, m) for s in (45, 75) for m in slew if m != "SGAUKF-odd"]
    table4 += [
        Block("table4", "slew", int(s), m + SIGMA_R) for m, row in REFERENCE["table_4"]["sigma_r"].items() for s in row
    ]
    table4 += [Block("table4", g, s, "oracle") for g in ("slew", "regulate") for s in (45, 75)]
    table4 += [Block("table4", g, 75, m, b) for g, m in SINGLE_FLIGHTS for b in several(4)]
    hard = [Block("hard", "slew", 45, m, b) for m in REFERENCE["hard"] for b in several(1 if m == "dual GAUKF" else 2)]
    severity = [Block("severity", "slew", 45, m, 0, a) for a in SEVERITIES for m in SEVERITY_METHODS]
    severity += [Block("severity", "regulate", 45, "oracle", 0, float(a)) for a in REFERENCE["severity"]["regulate"]]
    others = {"MEKF": 4, "CLAIR": 4, "UKF": 4, "dual GAUKF": 4, "oracle": 1}
    bench = [Block("bench", "slew", s, m, b) for s in LEVELS for m, n in others.items() for b in several(n)]
    bench += [Block("table5", "slew", s, "UKF", b) for s in LEVELS for b in several(4)]
    settings = [
        Block("hard", "slew", r["snr"], m, 0, r["mismatch"]) for r in REFERENCE["hard_setting"] for m in r["methods"]
    ]
    ranges = [
        Block("table5", g, int(s), m) for g, levels in REFERENCE["table_5"].items() for s, row in levels.items() for m in row
    ]
    return list(dict.fromkeys(campaign_blocks(quick) + grids + table4 + hard + severity + bench + settings + ranges))


def bound_piece(profile: str, snr: int, onset: int, count: int, excitation: str = "none") -> list[list[list[float]]]:
    """sd of f along its principal directions (AFTER, count, 4) that the bound leaves after a change in healthy flight."""
    plant = load_plant(cmg.ID, reference=profile, snr=snr, excitation=excitation)
    steps = onset + AFTER[-1]
    scenarios = [
        FaultScenario(plant=cmg.ID, steps=steps, reference={"profile": profile}, noise_seed=900 + i) for i in range(count)
    ]
    record = fly(plant, scenarios)
    x, r, f = record.state, plant.split(record.obs)[1], np.ones((count, 4))
    R = plant.R[:6, :6]  # of attitude and rate
    Q = np.diag([0.0] * 3 + [max(cmg.SIGMA_Q, Q_FLOOR) ** 2] * 3 + [0.0] * 4)
    P, found = first_covariance(x[:, 0, :4], R, 0.0), []
    for k in range(1, steps + 1):
        P = bound_step(P, x[:, k - 1], x[:, k], r[:, k], f, Q, R, wheel=False)
        if k - onset in AFTER:
            found.append(np.sqrt(np.linalg.eigvalsh(P[:, 6:, 6:])).tolist())
        if k == onset:
            P = opened(P, np.ones(count, bool))
    return found


def tried_piece(name: str) -> list[dict[str, Any]]:
    """Outcomes of the UKF over the source's time line, regulating at 75 dB, under another reading."""
    options, process_noise, tuning = TRIED[name]
    plant = load_plant(cmg.ID, reference="regulate", snr=75, **options)
    scenarios = scenarios_of(Block("table4", "regulate", 75, "UKF"))
    noise = []
    for scenario in scenarios:
        w, v = white_noise(plant, np.random.default_rng(scenario.noise_seed), scenario.steps)
        noise.append((process_noise * w, v))
    record = simulate(plant, scenarios, noise)
    said = show(plant, scenarios, record, "UKF", **tuning)
    return [time_line_outcome(record, said, i) for i in range(len(scenarios))]
