"""Which faults structure alone can tell apart, on every plant: writes leaderboards/isolability.md.

    python -m benchmarks.isolability             the page
    python -m benchmarks.isolability --toolbox   also holds the three tanks against the Fault Diagnosis Toolbox

A structural model knows which unknowns stand in which equation and nothing else. The overdetermined part of its
Dulmage-Mendelsohn decomposition is what can be checked: a fault is seen where its equation lies there, and told from another
where it still does after the other's equation is taken away. E. Frisk, M. Krysander, J. Aslund, A toolbox for analysis and
design of model based diagnosis systems for large scale models, IFAC-PapersOnLine 50(1), 2017 (pip install
faultdiagnosistoolbox); M. Krysander, E. Frisk, IEEE Trans. Systems, Man, and Cybernetics A 38(6), 2008.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching

from fdi_gym.discovery import load_plant, plant_sources
from fdi_gym.engine import no_noise, simulate
from fdi_gym.faults import draw
from fdi_gym.files import write_whole
from fdi_gym.plant import Array, Plant
from fdi_gym.tables import markdown

PAGE = Path(__file__).parent.parent / "leaderboards" / "isolability.md"
POINTS, FLIGHTS, SEARCHED = 20, 20, 1000  # random points of an equation, flights of an angle, seeds for a fault of each mode
INTRODUCTION = """# Isolability

Written by `python -m benchmarks.isolability`: which faults can be told apart by structure, that is by which unknowns stand
in which equation (x' is the rate of a state, or its next value), before any number is known. A sensor's fault is a bias of
any course, a plant's fault any course of the entries of theta that its mode moves; one fault at a time. What structure
cannot tell apart no residual can, whatever the numbers; what it can, numbers may still hide.

A disturbance that nothing measures is taken in two ways: as one more thing that may happen ("alone"), or as always there, of
any course ("beside"). Truth lies between: a filter knows how large and how fast it may be.
"""
ANGLES = f"""### What structure cannot

Faults of one equation differ only in what they depend on. The angle between what the two do to the states: 0 deg, the one is
the other at some size, however long one looks. At trim nothing moves; in healthy flights of `standard` (median of {FLIGHTS})
commands and states do. A dash: one of them does nothing there.
"""


class Structure(NamedTuple):
    """Which unknowns (columns) stand in which equations (rows)."""

    matrix: Array
    faults: dict[str, int]  # the equation that says a fault's size: that it is 0
    enters: dict[str, list[str]]  # the equations in which that size stands


def theta_of(plant: Plant, mode: str) -> Array:
    """theta (n_theta,) under the first fault of a mode that the process "standard" draws, fully there."""
    for seed in range(SEARCHED):
        scenario = draw(plant.process("standard"), seed)
        for fault in scenario.faults:
            if fault.mode == mode:
                end = scenario.steps if fault.end is None else min(fault.end, scenario.steps)
                return plant.theta_table(scenario.replace(faults=[fault])).a[end - 1]
    raise ValueError(f"{plant.id}: no {mode} in {SEARCHED} flights")


def unmeasured(plant: Plant) -> tuple[str, ...]:
    """The disturbances that no known signal tells."""
    return () if plant.measured_disturbance is not None else tuple(s.name for s in plant.disturbances)


def structure(plant: Plant, beside: bool) -> Structure:
    """The structural model of a plant: rates, sensors, how rates and states belong together, sizes of faults.

    An unknown stands in an equation where moving it moves the equation's value at any of POINTS random points.

    Args:
        plant: The plant.
        beside: Unmeasured disturbances are always there; else each is a fault among others.
    """
    rng, n, m = np.random.default_rng(0), len(plant.states), len(plant.outputs)

    def around(signals: Any) -> Array:
        scale, nominal = (np.array([getattr(s, field) for s in signals]) for field in ("scale", "nominal"))
        return nominal + scale * rng.uniform(-1, 1, (POINTS, len(signals)))

    x, u, d = around(plant.states), around(plant.commands), around(plant.disturbances)

    def values(x: Array = x, d: Array = d, theta: Array = plant.nominal_theta) -> Array:
        """Rates and sensors (POINTS, n + m)."""
        theta = np.broadcast_to(theta, (POINTS, len(theta)))
        return np.hstack([plant.derivative(1.0, x, u, theta, d), plant.measure(1.0, x, u, theta, d)])

    healthy = values()

    def stands(**moved: Array) -> Array:
        return (values(**moved) != healthy).any(axis=0)

    of_x = [stands(x=x + row) for row in np.diag([0.3 * s.scale for s in plant.states])]
    of_d = [stands(d=d + row) for row in np.diag([0.3 * s.scale for s in plant.disturbances]).reshape(d.shape[1:] * 2)]
    hidden = {name: column for name, column in zip([s.name for s in plant.disturbances], of_d, strict=True)
              if name in unmeasured(plant)}  # fmt: skip
    sizes = {mode: stands(theta=theta_of(plant, mode)) for mode in plant.mode_names}
    sizes |= {f"sensor {s.name}": np.arange(n + m) == n + i for i, s in enumerate(plant.outputs)}
    if not beside:
        sizes |= hidden
    rates, unknown = np.eye(n + m, n, dtype=bool), np.column_stack([*(sizes | hidden).values()])
    k, q = len(sizes), unknown.shape[1]
    matrix = np.block([
        [np.column_stack(of_x), rates, unknown],
        [np.eye(n, dtype=bool), np.eye(n, dtype=bool), np.zeros((n, q), bool)],
        [np.zeros((k, 2 * n), bool), np.eye(k, q, dtype=bool)],
    ])  # fmt: skip
    equations = [f"{s.name}'" for s in plant.states] + [s.name for s in plant.outputs]
    enters = {name: [equations[i] for i in np.flatnonzero(column)] for name, column in sizes.items()}
    return Structure(matrix, {name: n + m + n + i for i, name in enumerate(sizes)}, enters)


def overdetermined(matrix: Array) -> Array:
    """Which equations (rows) lie in the overdetermined part: reached from an unmatched one by an alternating path."""
    match = maximum_bipartite_matching(csr_matrix(matrix), perm_type="column")
    reached = match < 0
    while True:
        more = reached | ((match >= 0) & matrix[reached].any(axis=0)[match])
        if (more == reached).all():
            return reached
        reached = more


def confused(model: Structure) -> dict[str, set[str] | None]:
    """For each fault those that it cannot be told from; None for one that is not seen at all."""
    names, rows = list(model.faults), list(model.faults.values())
    seen = overdetermined(model.matrix)
    apart = {}
    for name, row in model.faults.items():
        without = model.matrix.copy()
        without[row] = False  # an equation with nothing in it: it is matched to nothing, and reaches nothing
        apart[name] = overdetermined(without)
    return {
        f: {g for g in names if g != f and not apart[g][row]} if seen[row] else None
        for f, row in zip(names, rows, strict=True)
    }


def angle(plant: Plant, first: str, second: str, flown: bool) -> float:
    """Angle [deg] between what two faults (or disturbances) do to the states, in healthy flights or at trim; or NaN."""
    scale = np.array([s.scale for s in plant.states])

    def effect(name: str, x: Array, u: Array) -> Array:
        d = np.zeros((len(x), len(plant.disturbances)))
        healthy = plant.derivative(0.0, x, u, None, d)
        if name in plant.mode_names:
            return ((plant.derivative(0.0, x, u, theta_of(plant, name)[None], d) - healthy) / scale).ravel()
        d[:, [s.name for s in plant.disturbances].index(name)] = 0.01
        return ((plant.derivative(0.0, x, u, None, d) - healthy) / scale).ravel()

    found = []
    for seed in range(FLIGHTS if flown else 1):
        x, u = plant.trim_state[None], plant.trim_command[None]
        if flown:
            scenario = draw(plant.process("standard"), seed).without_faults()
            record = simulate(plant, [scenario], [no_noise(plant, scenario.steps)])
            x, u = record.state[0, :-1], plant.split(record.obs[0, 1:])[1]
        a, b = effect(first, x, u), effect(second, x, u)
        if not (a.any() and b.any()):
            return np.nan
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        found.append(2 * np.arcsin(0.5 * min(np.linalg.norm(a - b), np.linalg.norm(a + b))))
    return float(np.rad2deg(np.median(found)))


def section(plant: Plant) -> str:
    """A plant's part of the page."""
    hidden = unmeasured(plant)
    models = [structure(plant, beside) for beside in ((False, True) if hidden else (False,))]
    found = [confused(model) for model in models]

    def cell(others: set[str] | None) -> str:
        return "not seen" if others is None else ", ".join(sorted(others)) or "-"

    def plain(degrees: float) -> str:
        return "-" if np.isnan(degrees) else f"{degrees:.1f}"

    head = ["fault", "stands in", "alone, cannot be told from", f"beside {', '.join(hidden)}"][: 2 + len(models)]
    body = [[name, ", ".join(enters), *(cell(of[name]) if name in of else "" for of in found)]
            for name, enters in models[0].enters.items()]  # fmt: skip
    parts = [f"## {plant.id}\n\n{plant.description}.", markdown(head, body)]
    able = (*plant.mode_names, *hidden)
    pairs = [(f, g) for f, g in itertools.combinations(able, 2) if g in (found[0][f] or ())]
    if pairs:
        rows = [[f"{f}, {g}", *(plain(angle(plant, f, g, flown)) for flown in (False, True))] for f, g in pairs]
        parts += [ANGLES.strip(), markdown(["pair", "at trim, deg", "in flight, deg"], rows)]
    return "\n\n".join(parts)


def page(plants: Iterable[str]) -> str:
    """The whole page."""
    return "\n\n".join([INTRODUCTION.strip(), *(section(load_plant(name)) for name in plants)]) + "\n"


# ---------------------------------------------------------------------------------------------------------------


def toolbox(beside: bool) -> dict[str, set[str] | None]:
    """What `confused` says of the three tanks, by the Fault Diagnosis Toolbox from the equations of the data sheet."""
    fdt, sympy = importlib.import_module("faultdiagnosistoolbox"), importlib.import_module("sympy")
    modes = ("leak 1", "leak 2", "leak 3", "pump loss 1", "pump loss 2", "plug 13", "plug 32")
    faults = [*modes, "sensor h1", "sensor h2", "sensor h3", *(() if beside else ("drain",))]
    model = {
        "type": "Symbolic", "x": ["h1", "h2", "h3", "r1", "r2", "r3", "q13", "q32", "q20", *(("drain",) if beside else ())],
        "f": faults, "z": ["u1", "u2", "y1", "y2", "y3"], "parameters": ["A"],
    }  # fmt: skip
    s = {name: sympy.Symbol(name) for kind in ("x", "f", "z", "parameters") for name in model[kind]}
    root = sympy.sqrt
    model["rels"] = [
        -s["A"] * s["r1"] + (1 - s["pump loss 1"]) * s["u1"] - s["q13"] - s["leak 1"] * root(s["h1"]),
        -s["A"] * s["r2"] + (1 - s["pump loss 2"]) * s["u2"] + s["q32"] - s["q20"] - s["leak 2"] * root(s["h2"]),
        -s["A"] * s["r3"] + s["q13"] - s["q32"] - s["leak 3"] * root(s["h3"]),
        -s["q13"] + (1 - s["plug 13"]) * root(s["h1"] - s["h3"]),
        -s["q32"] + (1 - s["plug 32"]) * root(s["h3"] - s["h2"]),
        -s["q20"] + (1 + s["drain"]) * root(s["h2"]),
        *(-s[f"y{i}"] + s[f"h{i}"] + s[f"sensor h{i}"] for i in (1, 2, 3)),
        *(fdt.DiffConstraint(f"r{i}", f"h{i}") for i in (1, 2, 3)),
    ]
    model = fdt.DiagnosisModel(model, name="three tanks")
    unseen, same = model.DetectabilityAnalysis()[1], np.array(model.IsolabilityAnalysis(permute=False), bool)
    return {
        f: None if f in unseen else {g for g, alike in zip(faults, row, strict=True) if alike and g != f}
        for f, row in zip(faults, same, strict=True)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--toolbox", action="store_true", help="hold the three tanks against the Fault Diagnosis Toolbox")
    if parser.parse_args().toolbox:
        for beside in (False, True):
            ours, theirs = confused(structure(load_plant("ThreeTank"), beside)), toolbox(beside)
            if ours != theirs:
                raise SystemExit(f"the toolbox says {theirs}, not {ours}")
        print("ThreeTank: the Fault Diagnosis Toolbox says the same")
    write_whole(PAGE, page(plant_sources()).encode())
    print(PAGE)


if __name__ == "__main__":
    main()
