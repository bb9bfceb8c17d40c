"""Boeing 747, lateral-directional motion in cruise, with aileron and rudder faults.

Linear motion about steady flight at 826.772 ft/s and 35,000 ft; angles in degrees, rates in deg/s, as the source has it.

    xdot = A x + B u_eff + E d,   u_eff,i = (1 + gamma_i) u_i + b_i,   y = x + v

| vector | entries |
|---|---|
| state x | sideslip beta [deg], roll rate p [deg/s], yaw rate r [deg/s], bank angle phi [deg] |
| command u | aileron [deg] (positive rolls left), rudder [deg] (positive yaws left); clipped to 20 and 4 deg |
| disturbance d | lateral gust, as the sideslip beta_g [deg] that it adds to the air's; 0 but in the process "gust" |
| fault theta | loss of effectiveness gamma of aileron and rudder in [-1, 0]; stuck position b of each [deg] |

Loss of effectiveness (LOE) has gamma in (-1, 0) and b = 0; a stuck surface has gamma = -1 and its position in b: anywhere,
where it was commanded at the onset (jam), at the limit (hard-over) or free (float, b = 0).

The air loads follow beta - beta_g, so a gust enters through the first column of A: E = -A[:, 0]. The source has no gust;
it is here so that methods for unknown inputs meet this plant too.

Variants: "printed/open" and "printed/closed" use the matrix A of the source, which already contains a rudder feedback;
"bare/closed" is the airframe built from the derivative table, whose yaw damper works through the rudder that fails.
Closed loops follow a bank-angle reference with a discrete LQR state feedback on the measurements. Commands are held
over a sample, so the zero-order-hold discretisation is exact. Mismatch multiplies every entry of the first three rows
of A and of B by 1 + level * U(-1, 1).

A diagnosis can act: doublets of either surface as probes (the process "quiet" has no other excitation); a weak surface is
asked for more and a stuck one is left out of the loop, whose gain is designed anew for the other, which trims against it.

The flight ends early where the linear model stops to mean anything: |phi| > 60 deg or |beta| > 15 deg.

Source: A. Guven, C. Hajiyev, WSEAS Transactions on Signal Processing 19, 2023, doi 10.37394/232014.2023.19.4 (A, B, fault
model, scenario). Sample time, noise, commands, controller and random processes are this benchmark's.

Version history: v0, the first.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import scipy.linalg
from msgspec import UNSET, Meta, UnsetType

from fdi_gym.acting import Acting, Probe, square
from fdi_gym.drawing import uniform
from fdi_gym.faults import Abrupt, Fault, FaultProcess, FaultScenario, Hold, Scoring
from fdi_gym.integration import first_order
from fdi_gym.kernels import kernel
from fdi_gym.plant import FaultMode, Kernels, Label, Plant, Signal
from fdi_gym.shapes import Shapes, only_with, together

ID = "B747Lateral"
VERSION = 0

DT = 0.1  # s
STEPS, PAPER_STEPS = 1200, 8000  # 120 s and 800 s
SIGMA_V = (0.10, 0.05, 0.05, 0.10)  # deg, deg/s, deg/s, deg: sensors
SIGMA_W = (0.02, 0.03, 0.02, 0.002)  # deg, deg/s, deg/s, deg per step: process
U_MAX = (20.0, 4.0)  # deg: command limit and travel of aileron, rudder
SURFACES = ("aileron", "rudder")
UP_TO_LOSS, UP_TO_JAM = 0.5, 0.7  # shares of the faults, added up: loss of effectiveness, jam, stuck anywhere

A_PRINTED = np.array([
    [-0.08895, 0.06282, -0.9795, 0.04362],
    [-2.419, -0.602, 0.3438, 0.01244],
    [1.491, -0.2827, -1.19, -0.2719],
    [0.0, 1.0, 0.05824, 0.0],
])  # fmt: skip
B_PRINTED = np.array([[0.0, 0.01024], [-0.1967, 0.009127], [-0.0138, -0.5503], [0.0, 0.0]])

# LQR weights (state, command) of the two airframes
LQR = {
    "printed": (np.diag([0.1, 0.1, 0.5, 1.0]), np.diag([2.0, 4.0])),
    "bare": (np.diag([0.1, 0.1, 4.0, 2.0]), np.diag([1.0, 8.0])),
}
B_STUCK_MAX = {"printed": (4.0, 2.0), "bare": (4.0, 0.8)}  # deg: random stuck position of aileron, rudder
VARIANTS = ("printed/open", "printed/closed", "bare/closed")

CALM = np.zeros(1)  # deg: no gust

MULTISINE_AMPLITUDE = np.array([[1.2, 0.9, 0.6], [0.5, 0.4, 0.3]])  # deg
MULTISINE_OMEGA = np.array([[0.35, 0.75, 1.30], [0.25, 0.60, 1.05]])  # rad/s
PAPER_PHASES = [[0.0, 2.0, 4.0], [1.0, 3.0, 5.0]]  # rad

Phase = Annotated[float, Meta(ge=-1e3, le=1e3)]  # rad
Sign = Annotated[float, Meta(ge=-1.0, le=1.0)]
Signs = Annotated[list[Sign], Meta(min_length=1)]
Bank = Annotated[float, Meta(ge=-60.0, le=60.0)]  # deg
Time = Annotated[float, Meta(ge=0.0, le=1e6)]  # s
Factor = Annotated[float, Meta(ge=-10.0, le=10.0)]
Row4 = tuple[Factor, Factor, Factor, Factor]
Row2 = tuple[Factor, Factor]


class Reference(msgspec.Struct, forbid_unknown_fields=True):
    """What the pilot does: his command, a sign per second of "prbs" and surface, and bank levels of 15 s each [deg]."""

    command: Literal["multisine", "doublet", "prbs", "const", "zero"] = "zero"
    scale: Annotated[float, Meta(ge=-100.0, le=100.0)] | UnsetType = UNSET
    phases: tuple[tuple[Phase, Phase, Phase], tuple[Phase, Phase, Phase]] | UnsetType = UNSET
    signs: tuple[Signs, Signs] | UnsetType = UNSET
    bank_levels: Annotated[list[Bank], Meta(min_length=1)] | UnsetType = UNSET

    def __post_init__(self) -> None:
        only_with(self, "command", {"multisine": ("scale", "phases"), "prbs": ("signs",)})


class Gust(msgspec.Struct, forbid_unknown_fields=True):
    """One gust, as `gust_rows` has it: times [s] and size [deg]; or none of them in calm air."""

    t0: Time | UnsetType = UNSET
    rise: Annotated[float, Meta(ge=1e-3, le=1e6)] | UnsetType = UNSET
    size: Annotated[float, Meta(ge=-15.0, le=15.0)] | UnsetType = UNSET
    hold: Time | UnsetType = UNSET

    def __post_init__(self) -> None:
        together(self)


class Physical(msgspec.Struct, forbid_unknown_fields=True):
    """Factors on the entries of the first three rows of A and of B."""

    factor_A: tuple[Row4, Row4, Row4] | UnsetType = UNSET
    factor_B: tuple[Row2, Row2, Row2, Row2] | UnsetType = UNSET


def bare_airframe() -> tuple[np.ndarray, np.ndarray]:
    """A and B of the bare airframe, from the derivative table (two entries repaired: Izz and theta0 = alpha0)."""
    V, alpha0, S, b, W, g = 826.772, 0.0582, 5500.0, 196.0, 636636.0, 32.174  # ft/s, rad, ft^2, ft, lb, ft/s^2
    rho, Ixx, Izz, Ixz = 7.382e-4, 18.2e6, 49.7e6, 0.97e6  # slug/ft^3, slug ft^2
    Cl = np.array([-0.160, -0.340, 0.130, -0.013, 0.008])  # beta, p, r, aileron, rudder
    Cn = np.array([0.160, -0.026, -0.280, -0.001, -0.100])
    Cy_beta, Cy_dr = -0.900, 0.12
    qbar, m, k = rho * V**2 / 2, W / g, b / (2 * V)
    per = np.array([1.0, k, k, 1.0, 1.0])
    Lhat, Nhat = np.linalg.solve([[Ixx, -Ixz], [-Ixz, Izz]], qbar * S * b * np.vstack([Cl, Cn]) * per)
    Y_beta, Y_dr = qbar * S * np.array([Cy_beta, Cy_dr]) / (m * V)
    A = np.array([
        [Y_beta, np.sin(alpha0), -np.cos(alpha0), g * np.cos(alpha0) / V],
        [*Lhat[:3], 0.0],
        [*Nhat[:3], 0.0],
        [0.0, 1.0, np.tan(alpha0), 0.0],
    ])  # fmt: skip
    return A, np.array([[0.0, Y_dr], Lhat[3:], Nhat[3:], [0.0, 0.0]])


def discretise(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ad (4, 4) and Bd (4, 2) of the exact zero-order hold over one sample."""
    block = np.zeros((6, 6))
    block[:4, :4], block[:4, 4:] = A, B
    M = scipy.linalg.expm(block * DT)
    return M[:4, :4], M[:4, 4:]


def gust_input(A: np.ndarray) -> np.ndarray:
    """Ed (4,) of a gust angle held over one sample: the air loads follow beta - beta_g."""
    return -(discretise(A, np.column_stack([A[:, 0], np.zeros(4)]))[1])[:, 0]


@kernel
def dynamics(t, x, u, theta, d, p, dx):
    """The next state: Ad x + Bd u_eff + Ed beta_g, with Ad and Bd row by row and Ed in p."""
    aileron = (1.0 + theta[0]) * u[0] + theta[2]
    rudder = (1.0 + theta[1]) * u[1] + theta[3]
    for i in range(4):
        dx[i] = (
            p[4 * i] * x[0] + p[4 * i + 1] * x[1] + p[4 * i + 2] * x[2] + p[4 * i + 3] * x[3]
            + p[16 + 2 * i] * aileron + p[17 + 2 * i] * rudder + p[24 + i] * d[0]
        )  # fmt: skip


@kernel
def output(t, x, u, theta, d, p, y):
    """All four states are measured."""
    for i in range(4):
        y[i] = x[i]


@kernel
def control(t, y, r, q, c, u):
    """u = clip(s e + o - K (y - [0, 0, 0, phi_ref])); K = 0 in the open loop. r = (e_aileron, e_rudder, phi_ref).

    q = the gain K (2, 4) row by row, travel (2), and for the pilot's command the factor s (2) and the offset o (2).
    """
    for i in range(2):
        feedback = (
            q[4 * i] * y[0] + q[4 * i + 1] * y[1] + q[4 * i + 2] * y[2] + q[4 * i + 3] * (y[3] - r[2])
        )  # fmt: skip
        u[i] = min(max(q[10 + i] * r[i] + q[12 + i] - feedback, -q[8 + i]), q[8 + i])


@kernel
def outside(t, x, r):
    """The linear model holds for |beta| <= 15 deg and |phi| <= 60 deg."""
    return abs(x[0]) > 15.0 or abs(x[3]) > 60.0


@functools.lru_cache(maxsize=4)
def _waves(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """sin(omega t) and cos(omega t) of the multisine's components, each (surface, steps + 1, 3)."""
    angle = MULTISINE_OMEGA[:, None, :] * (np.arange(steps + 1) * DT)[None, :, None]
    return np.sin(angle), np.cos(angle)


def excitation(reference: Mapping[str, Any], steps: int) -> np.ndarray:
    """The pilot's command e_k (steps + 1, 2) in deg, before feedback and clipping."""
    e = np.zeros((steps + 1, 2))
    command = reference.get("command", "zero")
    if command == "multisine":
        phases, (sines, cosines) = np.array(reference["phases"]), _waves(steps)
        weight = reference["scale"] * MULTISINE_AMPLITUDE
        for i in range(2):  # sin(omega t + phase), the parts in t computed once
            e[:, i] = sines[i] @ (weight[i] * np.cos(phases[i])) + cosines[i] @ (weight[i] * np.sin(phases[i]))
    elif command == "doublet":
        k = np.arange(steps + 1)
        for i, (amplitude, start) in enumerate([(3.0, 0), (1.2, 100)]):
            phase = (k - start) % 200
            e[:, i] = amplitude * (1.0 * (phase < 20) - 1.0 * ((phase >= 20) & (phase < 40))) * (k >= start)
    elif command == "prbs":
        for i, (signs, amplitude) in enumerate(zip(reference["signs"], (1.6, 0.6), strict=True)):
            if len(signs) <= steps // 10:
                raise ValueError(f"{steps} steps need {steps // 10 + 1} signs for each surface, not {len(signs)}")
            e[:, i] = amplitude * np.array(signs, float)[np.arange(steps + 1) // 10]
    elif command == "const":
        e[:] = 1.5, 0.6
    return e


def reference_rows(scenario: FaultScenario) -> np.ndarray:
    """r_k = (e_aileron, e_rudder, phi_ref): the bank reference is the drawn levels through a 2 s lag."""
    steps = scenario.steps
    rows = np.zeros((steps + 1, 3))
    rows[:, :2] = excitation(scenario.reference, steps)
    levels = scenario.reference.get("bank_levels", [0.0])
    if any(levels):
        a, last = float(np.exp(-DT / 2.0)), len(levels) - 1
        rows[:, 2] = first_order(a, (1 - a) * np.array(levels)[np.minimum(np.arange(steps + 1) // 150, last)])
    return rows


def gust_rows(scenario: FaultScenario) -> np.ndarray:
    """d (steps + 1, 1): one gust, 1 - cos up in `rise` s from t0 to size [deg], `hold` s there, and down again."""
    if not scenario.disturbance:
        return np.broadcast_to(CALM, (scenario.steps + 1, 1))
    t0, rise, size, hold = (scenario.disturbance[name] for name in ("t0", "rise", "size", "hold"))
    s = np.arange(scenario.steps + 1) * DT - t0
    up, down = (0.5 * (1 - np.cos(np.pi * np.clip(x / rise, 0, 1))) for x in (s, s - rise - hold))
    return (size * (up - down))[:, None]


def draw_reference(rng: np.random.Generator, low: float, high: float, closed: bool) -> dict[str, Any]:
    """A multisine with a common activity U(low, high) and free phases; in the closed loop also bank levels U(-8, 8) deg."""
    reference: dict[str, Any] = {
        "command": "multisine",
        "scale": uniform(rng, low, high),
        "phases": rng.uniform(0, 2 * np.pi, (2, 3)).tolist(),
    }
    if closed:
        reference["bank_levels"] = rng.uniform(-8, 8, STEPS // 150 + 1).tolist()
    return reference


def loss(surface: str, gamma: float, onset: int, end: int | None = None) -> Fault:
    """Loss of effectiveness: u_eff = (1 + gamma) u."""
    return Fault(f"{surface} LOE", "LOE", onset, [Abrupt(f"gamma_{surface}", gamma)], end)


def stuck(surface: str, b: float | None, onset: int, end: int | None = None, kind: str = "position") -> Fault:
    """A stuck surface: u_eff = b [deg]; b = None freezes it where it is commanded at the onset (jam)."""
    place = Hold(f"b_{surface}", surface) if b is None else Abrupt(f"b_{surface}", b)
    return Fault(f"{surface} stuck", "jam" if b is None else kind, onset, [Abrupt(f"gamma_{surface}", -1.0), place], end)


def paper(command: str = "multisine", signs_seed: int = 0) -> FaultScenario:
    """The source's scenario: rudder stuck at 2 deg from 200 to 600 s of 800 s."""
    reference: dict[str, Any] = {"command": command}
    if command == "multisine":
        reference |= {"scale": 1.0, "phases": PAPER_PHASES}
    if command == "prbs":
        rng = np.random.default_rng(signs_seed)
        reference["signs"] = rng.choice([-1, 1], (2, PAPER_STEPS // 10 + 1)).tolist()
    fault = stuck("rudder", 2.0, 2000, 6000)
    return FaultScenario(plant=ID, steps=PAPER_STEPS, faults=[fault], reference=reference)


def perturb(rng: np.random.Generator, level: float) -> dict[str, Any]:
    """Factors on the first three rows of A and on B: 1 + level U(-1, 1) each."""
    return {
        "factor_A": (1 + level * rng.uniform(-1, 1, (3, 4))).tolist(),
        "factor_B": (1 + level * rng.uniform(-1, 1, (4, 2))).tolist(),
    }


def processes(airframe: str, closed: bool, dual: bool) -> list[FaultProcess]:
    """The fault processes of one variant."""
    b_max = B_STUCK_MAX[airframe]

    def fault(rng: np.random.Generator, i: int, onset: int, end: int | None, gamma: tuple[float, float]) -> Fault:
        kind = rng.random()
        if kind < UP_TO_LOSS:
            return loss(SURFACES[i], uniform(rng, *gamma), onset, end)
        return stuck(SURFACES[i], None if kind < UP_TO_JAM else uniform(rng, -b_max[i], b_max[i]), onset, end)

    def flight(rng: np.random.Generator, faults: list[Fault], low: float = 0.5, high: float = 1.5) -> FaultScenario:
        return FaultScenario(plant=ID, steps=STEPS, faults=faults, reference=draw_reference(rng, low, high, closed))

    def standard(rng: np.random.Generator) -> FaultScenario:
        faults = []
        if rng.random() >= 0.2:
            i, onset = int(rng.integers(2)), int(rng.integers(200, 801))
            faults.append(fault(rng, i, onset, None, (-0.9, -0.3)))
        return flight(rng, faults)

    def two_faults(rng: np.random.Generator) -> FaultScenario:
        faults = []
        if rng.random() >= 0.2:
            i, second = int(rng.integers(2)), rng.random() < 0.5
            surfaces = [i, 1 - i] if second else [i]
            faults = [fault(rng, j, int(rng.integers(200, 801)), None, (-0.9, -0.3)) for j in surfaces]
        return flight(rng, faults)

    def hard(rng: np.random.Generator) -> FaultScenario:
        faults = []
        if rng.random() >= 0.1:
            onset = int(rng.integers(200, 301))
            while onset <= 1150:
                end = onset + int(rng.integers(150, 301))
                faults.append(fault(rng, int(rng.integers(2)), onset, end, (-0.7, -0.2)))
                onset = end + int(rng.integers(100, 251))
        return flight(rng, faults, 0.6, 1.6).replace(physical=perturb(rng, 0.05))

    def gusty(rng: np.random.Generator) -> FaultScenario:
        disturbance = {
            "t0": float(rng.uniform(15, 90)), "rise": float(rng.uniform(1, 4)), "size": float(rng.uniform(-2, 2)),
            "hold": float(rng.uniform(0, 10)),
        }  # fmt: skip
        return standard(rng).replace(disturbance=disturbance)

    def quiet(rng: np.random.Generator) -> FaultScenario:
        return standard(rng).replace(reference={"command": "zero"})

    def banking(rng: np.random.Generator) -> FaultScenario:
        flown = standard(rng)
        return flown.replace(reference={"command": "zero", "bank_levels": flown.reference["bank_levels"]})

    def hard_over(rng: np.random.Generator) -> FaultScenario:
        i, onset = int(rng.integers(2)), int(rng.integers(200, 801))
        return flight(rng, [stuck(SURFACES[i], U_MAX[i] * float(rng.choice([-1, 1])), onset, kind="hard-over")])

    def floating(rng: np.random.Generator) -> FaultScenario:
        i, onset = int(rng.integers(2)), int(rng.integers(200, 801))
        return flight(rng, [stuck(SURFACES[i], 0.0, onset, kind="float")])

    found = [
        FaultProcess(name="standard", description="one permanent fault in 80 % of the flights", sample=standard),
        FaultProcess(name="hard", description="intermittent faults, plant off the model by 5 %", sample=hard,
                     scoring=Scoring(start=151, grace=50)),
        FaultProcess(name="gust", description="the standard faults, and one lateral gust in every flight", sample=gusty),
        FaultProcess(name="quiet", description="the standard faults in level flight, no excitation", sample=quiet),
        FaultProcess(name="hard-over", description="a surface runs to its limit", sample=hard_over),
        FaultProcess(name="float", description="a surface floats at zero", sample=floating),
    ]  # fmt: skip
    if closed:
        found.append(FaultProcess(name="banking", description="the standard faults while the autopilot follows bank levels",
                                  sample=banking))  # fmt: skip
    else:
        found.append(FaultProcess(name="paper", description="the source's: rudder stuck at 2 deg, 200 to 600 s",
                                  sample=lambda rng: paper(), scoring=Scoring(decision="second_half")))  # fmt: skip
    if dual:
        found.append(FaultProcess(name="dual", description="one or two permanent faults", sample=two_faults))
    return found


def _modes(airframe: str) -> tuple[FaultMode, ...]:
    modes, unit = [], np.eye(4)
    for i, surface in enumerate(SURFACES):
        b = B_STUCK_MAX[airframe][i]
        modes += [
            FaultMode(f"{surface} LOE", f"gamma_{surface} in (-1, 0)", lambda th, i=i: np.abs(th[..., i]), (0.5, 0.7),
                      offset=(0.0,) * 4, direction=tuple(unit[i]), reach=(-0.95, -0.10)),
            FaultMode(f"{surface} stuck", f"gamma_{surface} = -1, b_{surface} [deg] is where",
                      lambda th, i=i: np.abs(th[..., 2 + i]), (b / 3, 2 * b / 3),
                      offset=tuple(-unit[i]), direction=tuple(unit[2 + i]), reach=(-U_MAX[i], U_MAX[i])),
        ]  # fmt: skip
    return tuple(modes)


def _labels(dual: bool) -> tuple[Label, ...]:
    """Single: none and the four modes. Dual: label 3 i + j has aileron mode i and rudder mode j (healthy, LOE, stuck)."""
    if not dual:
        names = [f"{surface} {mode}" for surface in SURFACES for mode in ("LOE", "stuck")]
        return Label("none", frozenset()), *(Label(name, frozenset({name})) for name in names)
    parts = {s: [(), (f"{s} LOE",), (f"{s} stuck",)] for s in SURFACES}
    both = [a + r for a in parts["aileron"] for r in parts["rudder"]]
    return tuple(Label(" + ".join(modes) or "none", frozenset(modes)) for modes in both)


PROBES = (
    Probe("aileron", "a doublet of the aileron by 3 deg, 2 s each way, every 10 s", command=square(40, (3.0, 0.0), 60)),
    Probe("rudder", "a doublet of the rudder by 1.2 deg, 2 s each way, every 10 s", command=square(40, (0.0, 1.2), 60)),
    Probe("both", "the doublets of both surfaces at once", command=square(40, (3.0, 1.2), 60)),
)  # fmt: skip
STUCK = 0.1  # effectiveness below which a surface is left out


def regulator(Ad: np.ndarray, Bd: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """The gain (inputs, 4) of the discrete LQ regulator."""
    P = scipy.linalg.solve_discrete_are(Ad, Bd, Q, R)
    return np.linalg.solve(R + Bd.T @ P @ Bd, Bd.T @ P @ Ad)


def acting(airframe: str, Ad: np.ndarray, Bd: np.ndarray, gain: np.ndarray) -> Acting:
    """How the loop with this gain is acted on. The flight costs what its regulator minimises, over (5 deg of bank)^2."""
    Q, R = LQR[airframe]

    known: dict[tuple[float, ...], tuple[np.ndarray, np.ndarray]] = {}  # by the surfaces' effectiveness

    def designed(*surfaces: float) -> tuple[np.ndarray, np.ndarray]:
        """Gain (2, 4) for surfaces of this effectiveness; what the other one deflects per deg of one that is stuck (2,)."""
        if surfaces in known:
            return known[surfaces]
        left = np.array(surfaces)
        K = gain if (left == 1.0).all() or not gain.any() else regulator(Ad, Bd * left, Q, R)
        trims = np.zeros(2)
        for i, j in ((0, 1), (1, 0)):  # so that the steady state costs least
            if left[i] == 0.0 < left[j]:
                settled = np.linalg.solve(np.eye(4) - Ad + Bd * left @ K, Bd)
                trims[i] = settled[:, i] @ Q @ settled[:, j] / (settled[:, j] @ Q @ settled[:, j])
        known[surfaces] = K, trims
        return K, trims

    def flight_cost(x: np.ndarray, u: np.ndarray, r: np.ndarray) -> np.ndarray:
        error = x - np.stack([*[np.zeros_like(r[..., 2])] * 3, r[..., 2]], axis=-1)
        return ((error**2 * np.diag(Q)).sum(axis=-1) + (u**2 * np.diag(R)).sum(axis=-1)) / 25.0

    def accommodate(theta: np.ndarray) -> np.ndarray:
        left = 1.0 + np.clip(theta[:, :2], -1.0, 0.0)
        left = np.where(left < STUCK, 0.0, np.maximum(np.round(left, 2), STUCK))
        pairs = [designed(*row) for row in left.tolist()]
        K, trims = (np.stack(parts).reshape(len(left), -1) for parts in zip(*pairs, strict=True))
        stuck, b = left == 0.0, theta[:, 2:]
        factor = np.where(stuck, 0.0, 1.0 / np.maximum(left, STUCK))
        offset = np.where(stuck, 0.0, 0.0 - b - (trims * np.where(stuck, b, 0.0))[:, ::-1]) * factor
        return np.concatenate([K, np.tile(U_MAX, (len(left), 1)), factor, offset], axis=1)

    return Acting(flight_cost=flight_cost, lost=100.0, probes=PROBES, accommodate=accommodate)


def plant(*, variant: str = "printed/open", labels: str = "single") -> Plant:
    """Build the plant.

    Args:
        variant: Airframe and loop: "printed/open", "printed/closed" or "bare/closed".
        labels: "single" (5 labels, one fault at a time) or "dual" (9 labels; `divmod(label, 3)` gives the mode of
            aileron and rudder: 0 healthy, 1 LOE, 2 stuck).

    Raises:
        ValueError: Unknown variant or label set.
    """
    if variant not in VARIANTS:
        raise ValueError(f"unknown variant {variant!r}; {ID} has {', '.join(VARIANTS)}")
    if labels not in ("single", "dual"):
        raise ValueError(f"unknown labels {labels!r}; {ID} has single, dual")
    airframe, loop = variant.split("/")
    A, B = (A_PRINTED, B_PRINTED) if airframe == "printed" else bare_airframe()
    Ad, Bd = discretise(A, B)
    gain = regulator(Ad, Bd, *LQR[airframe]) if loop == "closed" else np.zeros((2, 4))

    def physical(changes: Mapping[str, Any]) -> np.ndarray:
        A_true, B_true = A.copy(), B * np.array(changes.get("factor_B", 1.0))
        A_true[:3] *= np.array(changes.get("factor_A", 1.0))
        Ad, Bd = discretise(A_true, B_true)
        return np.concatenate([Ad.ravel(), Bd.ravel(), gust_input(A_true)])

    travel = {"aileron": U_MAX[0], "rudder": U_MAX[1]}
    return Plant(
        id=ID, version=VERSION, options={"variant": variant, "labels": labels},
        description="Boeing 747, lateral motion in cruise: aileron and rudder faults",
        dt=DT, substeps=0, linear=True,
        kernels=Kernels(dynamics, output, control, outside=outside),
        states=tuple(Signal(n, unit, -lim, lim, scale, w) for n, unit, lim, scale, w in zip(
            ("beta", "p", "r", "phi"), ("deg", "deg/s", "deg/s", "deg"), (45, 90, 60, 180), (1, 2, 1, 5), SIGMA_W,
            strict=True)),
        outputs=tuple(Signal(n, unit, -lim, lim, scale, v) for n, unit, lim, scale, v in zip(
            ("beta", "p", "r", "phi"), ("deg", "deg/s", "deg/s", "deg"), (45, 90, 60, 180), (1, 2, 1, 5), SIGMA_V,
            strict=True)),
        commands=(Signal("aileron", "deg", -U_MAX[0], U_MAX[0], 5.0), Signal("rudder", "deg", -U_MAX[1], U_MAX[1], 2.0)),
        theta=(
            *(Signal(f"gamma_{s}", "", -1.0, 0.0, 1.0) for s in SURFACES),
            *(Signal(f"b_{s}", "deg", -travel[s], travel[s], scale) for s, scale in zip(SURFACES, (4.0, 2.0), strict=True)),
        ),
        modes=_modes(airframe), labels=_labels(labels == "dual"),
        processes=processes(airframe, loop == "closed", labels == "dual"),
        q=np.concatenate([gain.ravel(), U_MAX, [1.0, 1.0, 0.0, 0.0]]), physical=physical, perturb=perturb,
        reference=reference_rows,
        disturbances=(Signal("beta_g", "deg", -15.0, 15.0, 1.0),), disturbance=gust_rows,
        shapes=Shapes(Reference, Gust, Physical), acting=acting(airframe, Ad, Bd, gain),
    )  # fmt: skip
