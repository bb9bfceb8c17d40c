"""Decision logic: from an estimate of the fault parameter and its covariance to an alarm and a label.

Each logic is a part that any parameter-estimating filter can use: `start(n)` gives its state for n episodes, and
`step(state, k, z, P)` takes the estimate's deviation from healthy z (n, p) and covariance P (n, p, p) at sample k and
returns (state, Decision).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Diagnosis
from fdi_gym.plant import Array, FaultMode, Plant, contiguous


class Decision(NamedTuple):
    """What a logic says after a sample."""

    alarm: Array  # (n,) bool
    label: Array  # (n,) int
    structured: Array  # (n, p) the deviation that the label's own line explains best; 0 without alarm


class Logic(NamedTuple):
    """A pair of functions; see the module's docstring."""

    start: Callable[[int], Any]
    step: Callable[[Any, int, Array, Array], tuple[Any, Decision]]


class Manifolds(NamedTuple):
    """The sets that labels of f simultaneous faults span in the estimated space: offset + directions m, low <= m <= high."""

    labels: Array  # (h,) label indices
    offset: Array  # (h, p)
    direction: Array  # (h, p, f)
    low: Array  # (h, f)
    high: Array  # (h, f)


def manifolds(plant: Plant) -> list[Manifolds]:
    """The faulty labels of a plant as sets, from the lines of their modes, grouped by the number of faults."""
    modes = {mode.name: mode for mode in plant.modes}
    groups: dict[int, list[tuple[int, list[FaultMode]]]] = {}
    for index, label in enumerate(plant.labels):
        if label.modes:
            groups.setdefault(len(label.modes), []).append((index, [modes[name] for name in sorted(label.modes)]))
    return [
        Manifolds(
            np.array([index for index, _ in group]),
            np.array([np.sum([line.offset for line in lines], axis=0) for _, lines in group]),
            np.array([np.transpose([line.direction for line in lines]) for _, lines in group]),
            np.array([[line.reach[0] for line in lines] for _, lines in group]),
            np.array([[line.reach[1] for line in lines] for _, lines in group]),
        )
        for _, group in sorted(groups.items())
    ]


def nearest_of(I: Array, Iz: Array, sets: Manifolds) -> tuple[Array, Array]:  # noqa: E741
    """min over m in its box of q' I q - 2 q' Iz with q = offset + D m, the log likelihood ratio of a set, times -2.

    I (n or 1, p, p) information about the deviation from healthy, Iz (n, p) what it says. Returns (n, h) and m (n, h, f).
    """
    from fdi_gym.estimation import compiled

    D, offset = sets.direction, sets.offset
    Io = (I @ offset.T).swapaxes(1, 2)  # (n, h, p)
    base = (Io * offset).sum(axis=2) - 2 * Iz @ offset.T
    g = ((Iz[:, None, :] - Io)[:, :, None, :] @ D)[:, :, 0, :]  # (n, h, f)
    G = np.swapaxes(D, 1, 2) @ I[:, None] @ D  # (n, h, f, f)
    G = G if len(G) == len(g) else np.repeat(G, len(g), axis=0)  # the kernel does not repeat the only row of I
    m, value = np.zeros_like(g), np.empty_like(base)
    compiled.box_minimum(*(contiguous(a) for a in (G, g, sets.low, sets.high)), m, value)
    return base + value, m


def closest(z: Array, I: Array, sets: Manifolds) -> tuple[Array, Array]:  # noqa: E741
    """Distance of each estimate to each set: min over m in its box of (z - offset - D m)' I (z - offset - D m).

    z (n, p), I = P^-1 (n, p, p). Returns (J (n, h), m (n, h, f)).
    """
    Iz = (I @ z[..., None])[..., 0]
    value, m = nearest_of(I, Iz, sets)
    return (Iz * z).sum(axis=1)[:, None] + value, m


class Fits(NamedTuple):
    """The faulty labels ranked by distance, over all groups."""

    labels: Array  # (h,)
    J: Array  # (n, h)
    J_healthy: Array  # (n,)
    deviation: Array  # (n, h, p) the closest point of each label's set


def fit(z: Array, P: Array, groups: list[Manifolds]) -> Fits:
    """Distances of the estimate to healthy and to every faulty label, in the metric of its covariance."""
    I = np.linalg.inv(P)  # noqa: E741 (the metric itself is needed: it weighs many residuals)
    parts = [closest(z, I, sets) for sets in groups]
    points = [sets.offset + (sets.direction @ m[..., None])[..., 0] for sets, (_, m) in zip(groups, parts, strict=True)]
    return Fits(
        np.concatenate([sets.labels for sets in groups]),
        np.concatenate([J for J, _ in parts], axis=1),
        (z[:, None, :] @ I @ z[:, :, None])[:, 0, 0],
        np.concatenate(points, axis=1),
    )


def _count(condition: Array, counter: Array) -> Array:
    """Consecutive samples on which the condition has held."""
    return np.where(condition, counter + 1, 0)


def _structured(fits: Fits, label: Array) -> Array:
    """The closest point of the declared label's set; healthy where none is declared."""
    mine = fits.labels == label[:, None]
    return (fits.deviation * mine[..., None]).sum(axis=1)


def distance_logic(
    plant: Plant,
    *,
    threshold: float = 8.0,
    alarm_after: int = 5,
    switch_after: int = 10,
    release_after: int = 50,
    warmup: int = 150,
) -> Logic:
    """Mahalanobis distance of the estimate to the faulty labels' sets against its distance to healthy.

    G = J_0 - min J_h is the gain in fit of the best faulty label. Alarm at the `alarm_after`-th consecutive sample with
    G > threshold; in alarm, the label follows the best one after it differed for `switch_after` samples, and is
    released after `release_after` samples with G < threshold / 2 (a release wins over a switch). Silent and not
    counting for the first `warmup` samples.
    """
    groups, p = manifolds(plant), len(plant.estimated)

    def start(n: int) -> tuple[Array, ...]:
        return tuple(np.zeros(n, np.int64) for _ in range(4))

    def step(state: tuple[Array, ...], k: int, z: Array, P: Array) -> tuple[tuple[Array, ...], Decision]:
        label, over, other, under = state
        n = len(z)
        if k <= warmup:
            return state, Decision(np.zeros(n, bool), label, np.zeros((n, p)))
        fits = fit(z, P, groups)
        nearest = np.argmin(fits.J, axis=1)
        gain, best = fits.J_healthy - fits.J[np.arange(n), nearest], fits.labels[nearest]
        on = label > 0
        over = _count((gain > threshold) & ~on, over)
        other = _count((best != label) & on, other)
        under = _count((gain < threshold / 2) & on, under)
        raised, switched, released = over == alarm_after, other == switch_after, under == release_after
        label = np.where(released, 0, np.where(raised | switched, best, label))
        over, under = np.where(raised, 0, over), np.where(released, 0, under)
        other = np.where(switched | released, 0, other)
        return (label, over, other, under), Decision(label > 0, label, _structured(fits, label))

    return Logic(start, step)


def penalty_logic(plant: Plant, *, penalty: float = 8.0, change_after: int = 10, warmup: int = 150) -> Logic:
    """Distance to each label's set plus a penalty per fault; for labels of several simultaneous faults.

    The label changes when the same other one has been the best for `change_after` consecutive samples. Silent for the
    first `warmup` samples.
    """
    groups, p = manifolds(plant), len(plant.estimated)
    faults = np.array([len(label.modes) for label in plant.labels])

    def start(n: int) -> tuple[Array, ...]:
        return tuple(np.zeros(n, np.int64) for _ in range(3))

    def step(state: tuple[Array, ...], k: int, z: Array, P: Array) -> tuple[tuple[Array, ...], Decision]:
        label, candidate, count = state
        n = len(z)
        if k <= warmup:
            return state, Decision(np.zeros(n, bool), label, np.zeros((n, p)))
        fits = fit(z, P, groups)
        cost = np.column_stack([fits.J_healthy, fits.J + penalty * faults[fits.labels]])
        best = np.append(0, fits.labels)[np.argmin(cost, axis=1)]
        count = np.where(best == label, 0, np.where(best == candidate, count + 1, 1))
        label = np.where(count == change_after, best, label)
        return (label, best, np.where(count == change_after, 0, count)), Decision(label > 0, label, _structured(fits, label))

    return Logic(start, step)


def persistence_logic(plant: Plant, candidate: Callable[[Array], Array], *, after: int = 20, warmup: int = 150) -> Logic:
    """The label becomes the candidate at the `after`-th consecutive sample on which that is the same.

    Args:
        plant: The plant.
        candidate: Maps the estimate's deviation from healthy (n, p) to a label (n,), sample by sample.
        after: Persistence in samples.
        warmup: Samples without a decision and without counting; the candidate before them is 0.
    """
    p = len(plant.estimated)

    def start(n: int) -> tuple[Array, ...]:
        return tuple(np.zeros(n, np.int64) for _ in range(3))

    def step(state: tuple[Array, ...], k: int, z: Array, P: Array) -> tuple[tuple[Array, ...], Decision]:
        label, last, count = state
        n = len(z)
        if k <= warmup:
            return state, Decision(np.zeros(n, bool), label, np.zeros((n, p)))
        now = candidate(z)
        count = np.where(now == last, count + 1, 1)
        label = np.where(count == after, now, label)
        return (label, now, count), Decision(label > 0, label, np.where((label > 0)[:, None], z, 0.0))

    return Logic(start, step)


def surface_candidate(plant: Plant, *, loss: float = 0.4, total: float = 0.8, position: dict[str, float]) -> Callable:
    """Fixed thresholds on the effectiveness and position of each control surface.

    The surface with the largest max(-gamma / loss, |b| / position) is faulty where that exceeds 1: stuck if
    -gamma > total or |b| exceeds its position limit, else LOE. For plants whose estimate has the entries gamma_<surface>
    and b_<surface> and whose modes are "<surface> LOE" and "<surface> stuck".
    """
    names = [s.name for s in plant.estimated]
    gamma = [names.index(f"gamma_{surface}") for surface in position]
    b = [names.index(f"b_{surface}") for surface in position]
    limit = np.array(list(position.values()))
    lost = np.array([plant.label_of(frozenset({f"{surface} LOE"})) for surface in position])
    stuck = np.array([plant.label_of(frozenset({f"{surface} stuck"})) for surface in position])

    def candidate(z: Array) -> Array:
        loss_of, place = -z[:, gamma], np.abs(z[:, b])
        severity = np.maximum(loss_of / loss, place / limit)
        s = np.argmax(severity, axis=1)
        i = np.arange(len(z))
        is_stuck = (loss_of[i, s] > total) | (place[i, s] > limit[s])
        return np.where(severity[i, s] <= 1, 0, np.where(is_stuck, stuck[s], lost[s]))

    return candidate


def with_logic(
    plant: Plant,
    first: Callable[[int], Any],
    advance: Callable[[Any, Array, Array], Any],
    logic: Logic,
    structured: bool = False,
) -> Diagnoser:
    """A diagnoser from a parameter-estimating filter and a decision logic.

    Args:
        plant: The plant.
        first: first(n) gives the filter's state, with the fields z (n, p), the estimate's deviation from healthy, and
            Pz (n, p, p), its covariance.
        advance: advance(state, u, y) gives the next one from the command u_{k-1} and the measurement y_k.
        logic: The decision logic.
        structured: Report the magnitude along the declared label's own line in place of the free estimate.
    """
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)

    def init(n: int) -> Any:
        return 0, first(n), logic.start(n)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, s, decided = state
        n = len(obs)
        if k == 0:  # no interval has ended: the filter keeps its prior
            said = Decision(np.zeros(n, bool), np.zeros(n, np.int64), np.zeros_like(s.z))
        else:
            y, u, _ = plant.split(obs)
            s = advance(s, u, y)
            decided, said = logic.step(decided, k, s.z, s.Pz)
        std = np.sqrt(np.einsum("npp->np", s.Pz))
        theta = healthy + (said.structured if structured else s.z)
        return (k + 1, s, decided), Diagnosis(said.alarm, said.label, theta, std)

    return Diagnoser(init, update)
