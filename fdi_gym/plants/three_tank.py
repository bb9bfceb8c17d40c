"""Three coupled tanks under level control, with leaks, weak pumps and plugged pipes.

Three cylinders in a row, after the DTS200 laboratory plant: pumps feed tank 1 (left) and tank 2 (right), pipes join tank 1
to tank 3 (middle) and tank 3 to tank 2, and tank 2 drains. SI units.

    A dh1/dt = eta1 u1 - q13 - s(l1, h1)          q13 = s(az13 (1 - c13), h1 - h3)
    A dh2/dt = eta2 u2 + q32 - q20 - s(l2, h2)    q32 = s(az32 (1 - c32), h3 - h2)
    A dh3/dt = q13 - q32 - s(l3, h3)              q20 = s(az20 (1 + d), h2)

    s(a, h) = sign(h) a S sqrt(2 g |h|), a level below 0 counts as 0;   y = h + v

| vector | entries |
|---|---|
| state x | levels h1, h2, h3 [m] |
| command u | flow of the pumps u1, u2 [m^3/s]; clipped to 0 and 1.2e-4 |
| known | commanded levels r1, r2 of tanks 1 and 2 [m] |
| fault theta | leaks l1, l2, l3; effectiveness eta1, eta2 of the pumps (nominal 1); plugs c13, c32 of the pipes |
| physical p | outflow coefficients az13, az32, az20 |
| disturbance d | relative opening of the drain valve, not measured: first-order Gauss-Markov, time constant 100 s |

| label | mode | effect |
|---|---|---|
| 1 to 3 | leak 1, 2, 3 | a hole in a tank: l, its outflow coefficient at a pipe's cross-section, 0.1 to 0.5 |
| 4, 5 | pump loss 1, 2 | loss of effectiveness: the share eta of the commanded flow comes, 0.3 to 0.8 |
| 6, 7 | plug 13, 32 | a pipe closes by the share c, 0.2 to 0.8 |

Each is abrupt, incipient (0.01 to 0.05 1/s) or intermittent. The balance of tank 1 alone has leak 1 and pump loss 1, so they
differ only in what they depend on, level and command; the same in tank 2, where the drain is a third. A plug enters two
balances with opposite signs.

A PI controller for each pump follows the commanded level. Mismatch multiplies each outflow coefficient by
1 + level * U(-1, 1). The flight ends where a tank overflows, above 0.62 m.

A diagnosis can act: pulses of a pump and of the commanded levels as probes; a weak pump is asked for more, what leaks out of
tank 1 or 2 is fed forward.

Processes: "standard" (one permanent fault in four flights of five, abrupt or incipient), "hard" (two passing faults of the
lower half of the severities, some intermittent with a period of 30 to 60 s; mismatch 0.02, a livelier drain), "fault-free".
Commanded levels change every 200 s.

Source: the DTS200 class of laboratory plants (amira), as in many papers; dimensions where sources differ, controller, noise,
drain and random processes are this benchmark's.

Version history: v0, the first.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType

from fdi_gym.acting import Acting, Probe, square
from fdi_gym.drawing import uniform
from fdi_gym.faults import Abrupt, Fault, FaultProcess, FaultScenario, Incipient, Intermittent, Scoring, Seed
from fdi_gym.integration import first_order
from fdi_gym.kernels import kernel
from fdi_gym.plant import FaultMode, Kernels, Label, Plant, Signal
from fdi_gym.shapes import Shapes, together

ID = "ThreeTank"
VERSION = 0

DT, SUBSTEPS = 1.0, 4  # s; Runge-Kutta steps of 0.25 s
STEPS, HOLD = 800, 200  # samples of a flight, and of a commanded level
SIGMA_V, SIGMA_W = 1e-3, 1e-4  # m: sensors, process per step
OVERFLOW = 0.62  # m

AREA, PIPE = 0.0154, 5e-5  # m^2, cross-sections of a tank and of a pipe
G = 9.81  # m/s^2
AZ = {"az13": 0.46, "az32": 0.48, "az20": 0.58}  # outflow coefficients
U_MAX = 1.2e-4  # m^3/s
LEVEL = 1e-4  # m: two levels that differ by less pass for equal in the derivative of a flow
KP, KI = 5e-4, 5e-6  # m^2/s, m^2/s^2
TAU_D = 100.0  # s: drain


class Moved(NamedTuple):
    """What a fault moves: an entry of theta, from its healthy end of [0, 1], and the range of how far."""

    entry: str
    healthy: float
    least: float
    most: float


FAULTS = {
    **{f"leak {i}": Moved(f"l{i}", 0.0, 0.1, 0.5) for i in (1, 2, 3)},
    **{f"pump loss {i}": Moved(f"eta{i}", 1.0, 0.2, 0.7) for i in (1, 2)},
    **{f"plug {i}": Moved(f"c{i}", 0.0, 0.2, 0.8) for i in (13, 32)},
}  # by mode, in the order of theta
MODES = tuple(FAULTS)
RATE, PERIOD = (0.01, 0.05), (30.0, 60.0)  # 1/s: incipient; s: intermittent, half of it on
LEVELS = ((0.36, 0.46), (0.14, 0.24))  # m: commanded in tanks 1 and 2


@kernel
def flow(a, h):
    """s(a, h): Torricelli's flow [m^3/s] through a pipe with outflow coefficient a, from the higher side."""
    return np.sign(h) * a * PIPE * np.sqrt(2.0 * G * abs(h))


@kernel
def dynamics(t, x, u, theta, d, p, dx):
    """Mass balances of the tanks."""
    h1, h2, h3 = max(x[0], 0.0), max(x[1], 0.0), max(x[2], 0.0)
    l1, l2, l3, eta1, eta2, c13, c32 = theta[0], theta[1], theta[2], theta[3], theta[4], theta[5], theta[6]
    q13 = flow(p[0] * (1.0 - c13), h1 - h3)
    q32 = flow(p[1] * (1.0 - c32), h3 - h2)
    q20 = flow(p[2] * (1.0 + d[0]), h2)
    dx[0] = (eta1 * u[0] - q13 - flow(l1, h1)) / AREA
    dx[1] = (eta2 * u[1] + q32 - q20 - flow(l2, h2)) / AREA
    dx[2] = (q13 - q32 - flow(l3, h3)) / AREA


@kernel
def slope(s, h):
    """ds/dh where s(1, h) / A = s. It has no bound at h = 0: nearer than LEVEL it is what it is there."""
    return 0.5 * abs(s) / abs(h) if abs(h) > LEVEL else 0.5 * flow(1.0, LEVEL) / LEVEL / AREA


@kernel
def jacobian(t, x, u, theta, d, p, J_x, J_theta, J_d, J_p):
    """Partial derivatives of `dynamics`."""
    h1, h2, h3 = max(x[0], 0.0), max(x[1], 0.0), max(x[2], 0.0)
    l1, l2, l3, c13, c32 = theta[0], theta[1], theta[2], theta[5], theta[6]
    f13, f32 = flow(1.0, h1 - h3) / AREA, flow(1.0, h3 - h2) / AREA
    f1, f2, f3 = flow(1.0, h1) / AREA, flow(1.0, h2) / AREA, flow(1.0, h3) / AREA
    s13, s32 = p[0] * (1.0 - c13) * slope(f13, h1 - h3), p[1] * (1.0 - c32) * slope(f32, h3 - h2)
    if x[0] >= 0.0:
        J_x[0, 0], J_x[2, 0] = -s13 - l1 * slope(f1, h1), s13
    if x[1] >= 0.0:
        J_x[1, 1], J_x[2, 1] = -s32 - (p[2] * (1.0 + d[0]) + l2) * slope(f2, h2), s32
    if x[2] >= 0.0:
        J_x[0, 2], J_x[1, 2], J_x[2, 2] = s13, s32, -s13 - s32 - l3 * slope(f3, h3)
    J_theta[0, 0], J_theta[1, 1], J_theta[2, 2] = -f1, -f2, -f3
    J_theta[0, 3], J_theta[1, 4] = u[0] / AREA, u[1] / AREA
    J_theta[0, 5], J_theta[2, 5] = p[0] * f13, -p[0] * f13
    J_theta[1, 6], J_theta[2, 6] = -p[1] * f32, p[1] * f32
    J_d[1, 0] = -p[2] * f2
    J_p[0, 0], J_p[2, 0] = -(1.0 - c13) * f13, (1.0 - c13) * f13
    J_p[1, 1], J_p[2, 1] = (1.0 - c32) * f32, -(1.0 - c32) * f32
    J_p[1, 2] = -(1.0 + d[0]) * f2


@kernel
def output(t, x, u, theta, d, p, y):
    """All levels are measured."""
    for i in range(3):
        y[i] = x[i]


@kernel
def known(t, r, c, out):
    """The commanded levels."""
    out[0], out[1] = r[0], r[1]


@kernel
def control(t, y, r, q, c, u):
    """PI with conditional anti-windup: u = clip(u0 + kp e + c), e = r - y; c grows by ki dt e where nothing was clipped.

    q = the flow fed forward u0 (2), what a pump is asked for per flow that is wanted (2).
    """
    for i in range(2):
        e = r[i] - y[i]
        wanted = (q[i] + KP * e + c[i]) * q[2 + i]
        u[i] = min(max(wanted, 0.0), U_MAX)
        if u[i] == wanted:
            c[i] += KI * DT * e


@kernel
def outside(t, x, r):
    """A tank overflows."""
    return max(x[0], x[1], x[2]) > OVERFLOW


def trim() -> tuple[np.ndarray, np.ndarray]:
    """The equilibrium: levels (3,) with h1 = 0.40 m, h2 = 0.20 m and q13 = q32, and the command (2,) that holds it."""
    h1, h2 = 0.40, 0.20
    a, b = AZ["az13"] ** 2, AZ["az32"] ** 2
    h3 = (a * h1 + b * h2) / (a + b)
    q13, q20 = flow.py_func(AZ["az13"], h1 - h3), flow.py_func(AZ["az20"], h2)
    return np.array([h1, h2, h3]), np.array([q13, q20 - q13])


X_TRIM, U_TRIM = trim()

# ---------------------------------------------------------------------------------------------------------------
# Scenarios

Height = Annotated[float, Meta(ge=0.0, le=0.6)]  # m
Coefficient = Annotated[float, Meta(ge=0.0, le=2.0)]
Spread = Annotated[float, Meta(ge=0.0, le=0.1)]  # d stays far from -1, a closed drain


class Reference(msgspec.Struct, forbid_unknown_fields=True):
    """The commanded levels (r1, r2) [m], for 200 samples each; the last ones stay. Trim where they are not given."""

    levels: Annotated[list[tuple[Height, Height]], Meta(min_length=1)] | UnsetType = UNSET


class Drain(msgspec.Struct, forbid_unknown_fields=True):
    """Standard deviation of the drain's opening and the seed of its course; or none of them: it does not move."""

    sigma: Spread | UnsetType = UNSET
    seed: Seed | UnsetType = UNSET

    def __post_init__(self) -> None:
        together(self)


class Physical(msgspec.Struct, forbid_unknown_fields=True):
    """Outflow coefficients of the truth."""

    az13: Coefficient | UnsetType = UNSET
    az32: Coefficient | UnsetType = UNSET
    az20: Coefficient | UnsetType = UNSET


def reference_rows(scenario: FaultScenario) -> np.ndarray:
    """r_k = (r1, r2), the commanded levels."""
    levels = np.array(scenario.reference.get("levels", [X_TRIM[:2]]))
    if len(levels) == 1:
        return np.broadcast_to(levels[0], (scenario.steps + 1, 2))
    return levels[np.minimum(np.arange(scenario.steps + 1) // HOLD, len(levels) - 1)]


def drain_rows(scenario: FaultScenario) -> np.ndarray:
    """d (steps + 1, 1): d_{k+1} = a d_k + sigma sqrt(1 - a^2) n_k with a = exp(-dt / tau), stationary from the start."""
    if not scenario.disturbance:
        return np.broadcast_to(np.zeros(1), (scenario.steps + 1, 1))
    n = np.random.default_rng(scenario.disturbance["seed"]).standard_normal(scenario.steps + 1)
    a = float(np.exp(-DT / TAU_D))
    n[1:] *= np.sqrt(1.0 - a * a)
    return scenario.disturbance["sigma"] * first_order(a, n)[:, None]


def physical(changes: Mapping[str, Any]) -> np.ndarray:
    """p = (az13, az32, az20)."""
    return np.array([changes.get(name, value) for name, value in AZ.items()])


def perturb(rng: np.random.Generator, level: float) -> dict[str, float]:
    """Each outflow coefficient times 1 + level U(-1, 1)."""
    return {name: value * (1.0 + level * uniform(rng, -1.0, 1.0)) for name, value in AZ.items()}


def fault(
    mode: str, severity: float, onset: int, end: int | None = None, rate: float | None = None, period: float | None = None
) -> Fault:
    """A fault that moves its entry by `severity`: incipient at a rate [1/s], intermittent with a period [s], else abrupt."""
    entry, healthy, *_ = FAULTS[mode]
    value = abs(healthy - severity)
    if rate is not None:
        return Fault(mode, "incipient", onset, [Incipient(entry, value, rate)], end)
    if period is not None:
        return Fault(mode, "intermittent", onset, [Intermittent(entry, value, period)], end)
    return Fault(mode, "abrupt", onset, [Abrupt(entry, value)], end)


def _flight(rng: np.random.Generator, faults: list[Fault], sigma: float, changed: dict[str, float]) -> FaultScenario:
    """A flight with these faults: commanded levels drawn anew every 200 s, then the drain's seed."""
    levels = [[uniform(rng, *bounds) for bounds in LEVELS] for _ in range(STEPS // HOLD)]
    drain = {"sigma": sigma, "seed": int(rng.integers(2**32))}
    return FaultScenario(plant=ID, steps=STEPS, faults=faults, reference={"levels": levels}, disturbance=drain,
                         physical=changed)  # fmt: skip


def standard(rng: np.random.Generator) -> FaultScenario:
    """No fault in a fifth of the flights, else a permanent one from U(100, 500) on, half of them incipient."""
    faults = []
    if rng.random() >= 0.2:
        mode, onset = MODES[rng.integers(len(MODES))], int(rng.integers(100, 501))
        severity = uniform(rng, FAULTS[mode].least, FAULTS[mode].most)
        rate = uniform(rng, *RATE) if rng.random() < 0.5 else None
        faults.append(fault(mode, severity, onset, rate=rate))
    return _flight(rng, faults, 0.02, {})


def hard(rng: np.random.Generator) -> FaultScenario:
    """Two faults of the lower half of the severities, from about 100 and 450 on, for U(120, 240) s."""
    faults = []
    for about in (100, 450):
        mode, onset = MODES[rng.integers(len(MODES))], about + int(rng.integers(-20, 21))
        end = onset + int(rng.integers(120, 241))
        _, _, least, most = FAULTS[mode]
        severity, profile = uniform(rng, least, (least + most) / 2), int(rng.integers(3))
        rate = uniform(rng, *RATE) if profile == 1 else None
        period = uniform(rng, *PERIOD) if profile == 2 else None
        faults.append(fault(mode, severity, onset, end, rate, period))
    return _flight(rng, faults, 0.03, perturb(rng, 0.02))


# ---------------------------------------------------------------------------------------------------------------
# Declaration


def _mode(i: int, mode: str) -> FaultMode:
    entry, healthy, least, most = FAULTS[mode]
    third, direction = (most - least) / 3, (1.0 - 2.0 * healthy) * np.eye(len(FAULTS))[i]
    return FaultMode(
        mode, f"{entry} off {healthy:g} by {least:g} to {most:g}", lambda theta: np.abs(theta[..., i] - healthy),
        (least + third, least + 2 * third), (0.0,) * len(FAULTS), tuple(direction.tolist()), (least, most),
    )  # fmt: skip


def flight_cost(x: np.ndarray, u: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Errors of the levels of tanks 1 and 2 over 3 cm, and a tenth of the pumps' moves over 2e-5 m^3/s, squared."""
    error, effort = (x[..., :2] - r) / 0.03, (u - U_TRIM) / 2e-5
    return (error**2).sum(axis=-1) + 0.1 * (effort**2).sum(axis=-1)


def accommodate(theta: np.ndarray) -> np.ndarray:
    """q (n, 4) for estimated theta (n, 7): leaks of tanks 1 and 2 fed forward at trim, weak pumps asked for more."""
    leak = flow.py_func(np.maximum(theta[:, :2], 0.0), X_TRIM[:2])
    return np.concatenate([U_TRIM + leak, 1.0 / np.clip(theta[:, 3:5], 0.2, 1.0)], axis=1)


PROBES = (
    Probe("pump 1", "the flow of pump 1 by 1.5e-5 m^3/s, up and down for 20 s each", command=square(40, (1.5e-5, 0.0))),
    Probe("pump 2", "the flow of pump 2 by 1.5e-5 m^3/s, up and down for 20 s each", command=square(40, (0.0, 1.5e-5))),
    Probe("levels", "the commanded levels by 3 cm, one up and the other down, for 40 s each",
          reference=square(80, (0.03, -0.03))),
)  # fmt: skip


def plant() -> Plant:
    """Build the plant."""
    return Plant(
        id=ID, version=VERSION, description="Three coupled tanks under level control: leaks, weak pumps, plugged pipes",
        dt=DT, substeps=SUBSTEPS,
        kernels=Kernels(dynamics, output, control, known, outside=outside, jacobian=jacobian),
        states=tuple(Signal(f"h{i + 1}", "m", 0.0, OVERFLOW, 0.05, SIGMA_W, h) for i, h in enumerate(X_TRIM.tolist())),
        outputs=tuple(Signal(f"h{i + 1}", "m", -0.1, 0.8, 0.05, SIGMA_V, h) for i, h in enumerate(X_TRIM.tolist())),
        commands=tuple(Signal(f"u{i + 1}", "m^3/s", 0.0, U_MAX, 2e-5, 0.0, u) for i, u in enumerate(U_TRIM.tolist())),
        known=tuple(Signal(f"r{i + 1}", "m", 0.0, 0.6, 0.05, 0.0, h) for i, h in enumerate(X_TRIM[:2].tolist())),
        disturbances=(Signal("drain", "", -1.0, 1.0, 0.02),),
        theta=tuple(Signal(m.entry, "", 0.0, 1.0, (m.least + m.most) / 2, nominal=m.healthy) for m in FAULTS.values()),
        modes=tuple(_mode(i, mode) for i, mode in enumerate(MODES)),
        labels=(Label("none", frozenset()), *(Label(mode, frozenset({mode})) for mode in MODES)),
        processes=[
            FaultProcess(name="standard", description="one permanent fault in four flights of five", sample=standard,
                         scoring=Scoring(grace=20)),
            FaultProcess(name="hard", description="two slight passing faults, plant off the model by 2 %", sample=hard,
                         scoring=Scoring(grace=20, decision="second_half")),
        ],
        c0=np.zeros(2), q=np.concatenate([U_TRIM, np.ones(2)]), physical=physical, perturb=perturb,
        reference=reference_rows, disturbance=drain_rows, shapes=Shapes(Reference, Drain, Physical),
        acting=Acting(flight_cost=flight_cost, lost=50.0, probes=PROBES, accommodate=accommodate),
    )  # fmt: skip
