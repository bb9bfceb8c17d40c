"""The paper's own figures: printed numbers, its Figures 2 to 6, its states, its equation 35, and the confusion matrix."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.reproduction.b747_lateral.measure import (
    GROUPS,
    METHODS,
    PAPER_SEED,
    agreement_plan,
    drawn,
    onsets,
    show,
    sizes,
)
from benchmarks.reproduction.comparison import state_errors
from benchmarks.reproduction.numbered import fly
from benchmarks.reproduction.pieces import Jobs
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.plant import Array
from fdi_gym.plants import b747_lateral as b747

PRINTED_MODES = np.array([-0.2897 + 1.0765j, -0.2897 - 1.0765j, -0.6507 + 0.4102j, -0.6507 - 0.4102j])
BLIND = "fault-blind Kalman filter"
STATED = ("exponential 0.99", "directional 1e-4", "TSKF Qz = 0", BLIND)
WINDOWS = {"healthy": slice(500, 2000), "faulty": slice(2301, 6001), "after": slice(6301, 8001)}  # samples
FAULTY = slice(2501, 6001)  # of the paper's estimates: without the transient
CONFUSED = ("exponential 0.99", "directional 1e-4", "TSKF Qz = 0")
EVERY = 5  # samples between two points of the figures


def plan(quick: bool) -> Jobs:
    """What the page needs, the paper's own first."""
    seeds, per_group, *_ = sizes(quick)
    jobs: Jobs = {"printed": (printed, ()), "equation 35": (equation_35, (seeds,)), "figure": (figure, ())}
    jobs |= {f"states-{method}": (states, (method, seeds)) for method in STATED}
    jobs |= {f"confusion-{method}": (confusion, (method, per_group)) for method in CONFUSED}
    return jobs | agreement_plan(quick)


def printed() -> dict[str, Any]:
    """Ranks, eigenvalues, the matrices from the derivative table, and the feedback that the printed A holds."""
    A, B, C = b747.A_PRINTED, b747.B_PRINTED, np.eye(4)
    bare_A, bare_B = b747.bare_airframe()
    powers = [np.linalg.matrix_power(A, i) for i in range(4)]
    found = np.linalg.eigvals(A)
    printed_modes, ours = (
        np.array(sorted(modes.tolist(), key=lambda v: (round(v.real, 3), v.imag))) for modes in (PRINTED_MODES, found)
    )
    bare = np.linalg.eigvals(bare_A)
    K = (A[2] - bare_A[2]) / B[2, 1]  # the rudder feedback that the yaw row holds
    entries = [(A, bare_A), (B, bare_B)]
    near = [bool(abs(p - t) <= 0.03 * abs(p)) for P, T in entries for p, t in zip(P.flat, T.flat, strict=True) if p or t]
    return {
        "controllable": int(np.linalg.matrix_rank(np.hstack([P @ B for P in powers]))),
        "observable": int(np.linalg.matrix_rank(np.vstack([C @ P for P in powers]))),
        "modes": [[v.real, v.imag] for v in ours.tolist()],
        "mode error": float(np.abs(ours - printed_modes).max()),
        "bare modes": [[v.real, v.imag] for v in sorted(bare.tolist(), key=lambda v: (v.real, v.imag))],
        "near": [sum(near), len(near)],
        "feedback": K.tolist(),
        "feedback error": float(np.abs(bare_A[0] + B[0, 1] * K - A[0]).max()),
        "A": A.tolist(), "B": B.tolist(), "bare A": bare_A.tolist(), "bare B": bare_B.tolist(),
    }  # fmt: skip


def states(method: str, seeds: int) -> dict[str, Any]:
    """State errors per flight over the paper's scenario, and how the fault's entries stand in its second half."""
    plant = load_plant(b747.ID)
    scenarios = [b747.paper().replace(noise_seed=PAPER_SEED + s) for s in range(seeds)]
    if method == BLIND:
        record = fly(plant, scenarios)
        said = run(make_diagnoser("windowed_nis", plant), record.obs)
    else:
        record, said = show(plant, scenarios, method)
    assert said.state is not None
    found: dict[str, Any] = {name: state_errors(said.state, record.state, w) for name, w in WINDOWS.items()}
    y = plant.split(record.obs)[0]
    found["sensors"] = state_errors(y, record.state, WINDOWS["faulty"])
    if said.estimate is not None:
        found["mean"] = said.estimate[:, FAULTY].mean(axis=1).tolist()
        found["right"] = (said.label[:, FAULTY] == 4).mean(axis=1).tolist()
    return found


def confusion(method: str, per_group: int) -> dict[str, Any]:
    """Labels on the randomised process: true (rows) and declared, of all samples, and at the end of each flight."""
    plant = load_plant(b747.ID)
    scenarios = drawn(plant, "standard", 700_000, GROUPS * per_group)
    record, said = show(plant, scenarios, method)
    labels = len(plant.labels)

    def counts(truth: Array, declared: Array) -> list[list[int]]:
        return np.bincount(labels * truth.ravel() + declared.ravel(), minlength=labels**2).reshape(labels, -1).tolist()

    truth, declared = record.label[:, 1:].astype(int), said.label[:, 1:].astype(int)
    return {
        "samples": counts(truth, declared), "flights": counts(truth[:, -1], declared[:, -1]),
        "names": [label.name for label in plant.labels], "n": len(scenarios),
        "faulty": int((onsets(scenarios) < 1200).sum()),
    }  # fmt: skip


def equation_35(seeds: int) -> dict[str, Any]:
    """The bias stage with the state's gain Kx where Kz belongs, as equation 35 prints it: when it leaves all bounds [s]."""
    plant = load_plant(b747.ID)
    record = fly(plant, [b747.paper().replace(noise_seed=PAPER_SEED + s) for s in range(seeds)])
    y, u, _ = plant.split(record.obs)
    return {"seconds": [_diverges(y[i], u[i], plant.Q, plant.R) for i in range(seeds)]}


def _diverges(y: Array, u: Array, Q: Array, R: Array) -> float | None:
    """The time [s] at which an entry of the estimate passes 1e6; None if it never does."""
    Ad, Bd = b747.discretise(b747.A_PRINTED, b747.B_PRINTED)
    x, Px, z, Pz, V = np.zeros(4), 0.01 * np.eye(4), np.zeros(4), np.diag([1.0, 1.0, 4.0, 4.0]), np.zeros((4, 4))
    for k in range(len(y) - 1):
        command = u[k + 1]
        H = Ad @ V + np.hstack([Bd * command, Bd])  # no forgetting, no walk: W and V- are the same
        x, Px = Ad @ x + Bd @ command, Ad @ Px @ Ad.T + Q
        K = Px @ np.linalg.inv(Px + R)
        r = y[k + 1] - x
        z, Pz = z + K @ (r - H @ z), (np.eye(4) - K @ H) @ Pz  # as printed; the gain of the bias belongs here
        x, Px, V = x + K @ r, (np.eye(4) - K) @ Px, H - K @ H
        if not np.abs(z).max() < 1e6:
            return (k + 1) * b747.DT
    return None


def figure() -> dict[str, Any]:
    """What Figures 2 to 6 show, one sample in five: inputs, entries, states true, with the filter, and fault-blind."""
    plant = load_plant(b747.ID)
    scenarios = [b747.paper().replace(noise_seed=PAPER_SEED)]
    record, said = show(plant, scenarios, "exponential 0.99")
    blind = run(make_diagnoser("windowed_nis", plant), record.obs)
    assert said.estimate is not None
    assert said.state is not None
    assert blind.state is not None

    def thin(a: Array) -> list[list[float]]:
        return [[float(f"{v:.5g}") for v in row] for row in a[0, ::EVERY].tolist()]

    return {
        "inputs": thin(plant.split(record.obs)[1]), "entries": thin(said.estimate), "true entries": thin(record.target),
        "states": thin(said.state), "blind": thin(blind.state), "true states": thin(record.state),
        "method": METHODS["exponential 0.99"][0],
    }  # fmt: skip
