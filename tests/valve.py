"""A plant with a fault that is a plane, for tests: a tank whose valve has a gain and a bias that move each for itself."""

import numpy as np

import fdi_gym
from fdi_gym.drawing import random_sign, uniform
from fdi_gym.faults import Abrupt, Fault, FaultProcess, FaultScenario, Scoring
from fdi_gym.kernels import kernel
from fdi_gym.plant import FaultMode, Kernels, Label, Plant, Signal

ID, VERSION = "Valve", 0
DT, STEPS = 0.1, 400  # s
GAIN, BIAS, LEAK = (-0.6, -0.2), (-0.5, 0.5), (0.2, 0.8)


@kernel
def dynamics(t, x, u, theta, d, p, dx):
    """Flow through the valve, and level."""
    dx[0] = ((1.0 + theta[0]) * u[0] + theta[1] - x[0]) / 0.3
    dx[1] = x[0] - (1.0 + theta[2]) * x[1]


@kernel
def output(t, x, u, theta, d, p, y):
    """Flow and level."""
    y[0] = x[0]
    y[1] = x[1]


@kernel
def control(t, y, r, q, c, u):
    """Proportional level control about the reference."""
    u[0] = min(max(r[0] + q[0] * (r[0] - y[1]), 0.0), 4.0)


def reference(scenario: FaultScenario) -> np.ndarray:
    """Two levels in turn, one second each."""
    return np.where(np.arange(scenario.steps + 1) // 10 % 2, 2.0, 1.0)[:, None]


def sample(rng: np.random.Generator) -> FaultScenario:
    """A faulty valve, a leak, both or none."""
    faults, kind, onset = [], int(rng.integers(4)), int(rng.integers(60, 160))
    if kind & 1:
        effects = [Abrupt("gain", uniform(rng, *GAIN)), Abrupt("bias", random_sign(rng) * uniform(rng, 0.1, BIAS[1]))]
        faults.append(Fault("valve", "", onset, effects))
    if kind & 2:
        faults.append(Fault("leak", "", onset, [Abrupt("leak", uniform(rng, *LEAK))]))
    return FaultScenario(plant=ID, steps=STEPS, faults=faults)


def plant(as_rows: bool = True, both: bool = True) -> Plant:
    """Build it.

    Args:
        as_rows: Declare the leak's line as a tuple of one direction.
        both: With a label of both faults.
    """
    line, reach = (0.0, 0.0, 1.0), LEAK
    modes = (
        FaultMode("valve", "gain and bias", lambda th: np.abs(th[..., :2]).max(axis=-1), (0.3, 0.4), (0.0,) * 3,
                  ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), (GAIN, BIAS)),
        FaultMode("leak", "more flows out", lambda th: np.abs(th[..., 2]), (0.3, 0.5), (0.0,) * 3,
                  (line,) if as_rows else line, (reach,) if as_rows else reach),
    )  # fmt: skip
    labels = [Label("none", frozenset()), *(Label(m.name, frozenset({m.name})) for m in modes)]
    labels += [Label("valve + leak", frozenset({"valve", "leak"}))] if both else []
    standard = FaultProcess(
        name="standard", description="valve, leak, both or none", sample=sample, scoring=Scoring(grace=20)
    )
    return Plant(
        id=ID, version=VERSION, description="a tank behind a valve", dt=DT, substeps=2,
        options={"as_rows": as_rows, "both": both}, kernels=Kernels(dynamics, output, control),
        states=(Signal("flow", "l/s", -10, 10, 1.0, 0.005, 1.0), Signal("level", "m", -10, 10, 1.0, 0.005, 1.0)),
        outputs=(Signal("flow", "l/s", -10, 10, 1.0, 0.02, 1.0), Signal("level", "m", -10, 10, 1.0, 0.02, 1.0)),
        commands=(Signal("valve", "", 0.0, 4.0, 1.0, nominal=1.0),),
        theta=(Signal("gain", "", -1.0, 1.0, 0.3), Signal("bias", "l/s", -1.0, 1.0, 0.3), Signal("leak", "", 0.0, 1.0, 0.3)),
        modes=modes, labels=tuple(labels), processes=[standard], q=np.array([0.3]), reference=reference,
    )  # fmt: skip


fdi_gym.register_plant(ID, f"{__name__}:plant")
