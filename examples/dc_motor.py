"""A plant in one file: a DC motor under speed control, with a weak amplifier, a worn brush and a stuck sensor offset.

    python examples/dc_motor.py

evaluates every diagnoser that can run on it: augmented Kalman filters with five decision
logics, adaptive unscented filters, two-stage filter, interacting models, GLR test, oracle. They need nothing but the
declaration below. Importing this file registers `DCMotor-Faults-v0`, so that `gym.make("dc_motor:DCMotor-Faults-v0")` and
`fdi-gym train sequence_net dc_motor:DCMotor` find it. Copy it for a plant of yours.
"""

import tempfile
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

import fdi_gym
from fdi_gym.diagnosis import diagnosers
from fdi_gym.evaluation import applicable, evaluate
from fdi_gym.faults import Abrupt, Fault, FaultProcess, FaultScenario, Incipient, Scoring
from fdi_gym.kernels import kernel
from fdi_gym.plant import FaultMode, Kernels, Label, Plant, Signal
from fdi_gym.shapes import Shapes
from fdi_gym.suite import Suite
from fdi_gym.tables import table

ID, VERSION = "DCMotor", 0

# A small brushed motor
R_A, L_A = 1.0, 5e-3  # ohm, H: armature
K_T = 0.05  # N m/A, V s/rad
J, B = 2e-4, 1e-4  # kg m^2, N m s/rad: rotor with load
DT, STEPS = 0.01, 500  # s
U_MAX = 24.0  # V


@kernel
def dynamics(t, x, u, theta, d, p, dx):
    """Armature and shaft."""
    current, speed = x[0], x[1]  # A, rad/s
    effectiveness, added_resistance = theta[0], theta[1]  # -, ohm
    load = d[0]  # N m
    dx[0] = (effectiveness * u[0] - (p[0] + added_resistance) * current - K_T * speed) / L_A
    dx[1] = (K_T * current - B * speed - load) / J


@kernel
def output(t, x, u, theta, d, p, y):
    """Current and speed; the speed sensor may have an offset."""
    y[0] = x[0]
    y[1] = x[1] + theta[2]


@kernel
def control(t, y, r, q, c, u):
    """PI speed control; c[0] is the integral."""
    error = r[0] - y[1]
    c[0] = min(max(c[0] + q[1] * DT * error, -U_MAX), U_MAX)
    u[0] = min(max(q[0] * error + c[0], -U_MAX), U_MAX)


class Reference(msgspec.Struct, forbid_unknown_fields=True):
    levels: Annotated[list[Annotated[float, Meta(ge=-300, le=300)]], Meta(min_length=1)]  # rad/s


class Load(msgspec.Struct, forbid_unknown_fields=True):
    load: Annotated[float, Meta(ge=0, le=0.1)]  # N m


class Physical(msgspec.Struct, forbid_unknown_fields=True):
    R_A: Annotated[float, Meta(ge=0.1, le=10)] = R_A  # ohm


def reference(scenario: FaultScenario) -> np.ndarray:
    """Speed command, rad/s: steps of a second each."""
    levels = np.array(scenario.reference["levels"])
    return levels[np.minimum(np.arange(scenario.steps + 1) // 100, len(levels) - 1)][:, None]


def disturbance(scenario: FaultScenario) -> np.ndarray:
    """Load torque, N m, constant."""
    return np.full((scenario.steps + 1, 1), scenario.disturbance["load"])


def sample(rng: np.random.Generator) -> FaultScenario:
    """One fault in three flights of four, anywhere in the middle of the flight."""
    faults = []
    if rng.random() < 0.75:
        kind, onset = int(rng.integers(3)), int(rng.integers(100, 300))
        effect = (
            Abrupt("effectiveness", float(rng.uniform(0.4, 0.8))),
            Incipient("added_resistance", float(rng.uniform(0.5, 2.0)), float(rng.uniform(0.5, 3.0))),
            Abrupt("speed_offset", float(rng.choice([-1, 1]) * rng.uniform(5, 20))),
        )[kind]
        faults.append(Fault(MODES[kind].name, "", onset, [effect]))
    levels = rng.uniform(50, 200, STEPS // 100 + 1).tolist()
    return FaultScenario(plant=ID, steps=STEPS, faults=faults, reference={"levels": levels},
                         disturbance={"load": float(rng.uniform(0, 0.05))})  # fmt: skip


MODES = (
    FaultMode("weak amplifier", "effectiveness below 1", lambda th: 1 - th[..., 0], (0.3, 0.5),
              offset=(0.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0), reach=(-0.9, -0.1)),
    FaultMode("worn brush", "armature resistance grows", lambda th: th[..., 1], (1.0, 1.5),
              offset=(0.0, 0.0, 0.0), direction=(0.0, 1.0, 0.0), reach=(0.2, 3.0)),
    FaultMode("speed sensor offset", "speed reads wrong", lambda th: np.abs(th[..., 2]), (10.0, 15.0),
              offset=(0.0, 0.0, 0.0), direction=(0.0, 0.0, 1.0), reach=(-30.0, 30.0)),
)  # fmt: skip


def physical(changes: dict) -> np.ndarray:
    """p = (armature resistance), ohm."""
    return np.array([changes.get("R_A", R_A)])


def plant() -> Plant:
    """Build the plant."""
    standard = FaultProcess(
        name="standard", description="one fault in 75 % of the flights", sample=sample, scoring=Scoring(grace=20)
    )
    return Plant(
        id=ID, version=VERSION, description="DC motor under speed control", dt=DT, substeps=10,
        kernels=Kernels(dynamics, output, control),
        states=(Signal("current", "A", -100, 100, 5.0), Signal("speed", "rad/s", -600, 600, 100.0, 0.05)),
        outputs=(Signal("current", "A", -100, 100, 5.0, 0.05), Signal("speed", "rad/s", -600, 600, 100.0, 0.5)),
        commands=(Signal("voltage", "V", -U_MAX, U_MAX, 12.0),),
        disturbances=(Signal("load", "N m", 0.0, 0.1, 0.05),),
        theta=(Signal("effectiveness", "", 0.0, 1.0, 1.0, nominal=1.0), Signal("added_resistance", "ohm", 0.0, 5.0, 1.0),
               Signal("speed_offset", "rad/s", -50.0, 50.0, 10.0)),
        modes=MODES, labels=(Label("none", frozenset()), *(Label(m.name, frozenset({m.name})) for m in MODES)),
        processes=[standard], c0=np.zeros(1), q=np.array([0.2, 2.0]), physical=physical,
        perturb=lambda rng, level: {"R_A": R_A * float(1 + level * rng.uniform(-1, 1))},
        reference=reference, disturbance=disturbance, shapes=Shapes(Reference, Load, Physical),
    )  # fmt: skip


ENV = fdi_gym.register_plant(ID, f"{__name__}:plant")


def main() -> None:
    suite = Suite(
        name="dc-motor", description="a DC motor", env=ENV, plant=ID, options={}, process="standard", mismatch=None,
        seeds=list(range(1_000_000, 1_000_020)), settings={},
    ).sealed()  # fmt: skip
    names, _ = applicable(suite, suite.build(), list(diagnosers()))
    with tempfile.TemporaryDirectory() as work:
        found = evaluate(suite, names, work=Path(work), jobs=1)
    print(table([f.row for f in found.values()], {name: f.made.microseconds for name, f in found.items()}))


if __name__ == "__main__":
    main()
