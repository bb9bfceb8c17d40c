"""Banks of observers for sensor faults, for any plant: the dedicated and the generalised scheme.

Both ask which sensor is inconsistent with the others. In the generalised scheme [1] observer i hears all sensors but those
of group i: where group i is at fault, it alone stays consistent, and all others do not. In the dedicated scheme [2] observer
i hears the sensors of group i only and predicts the rest: what is inconsistent are the pairs that involve the faulty group.
The observers are healthy extended Kalman filters, their residuals are weighed by their covariances, and sums of the squares
in excess of what noise makes forget at several paces:

    generalised   T_g = sum over time of nu' S^-1 nu - m of the observer without g
    dedicated     T_g = sum over time and sensors j outside g of the mean over observers i other than g of nu_ij^2 / S_ij - 1

T_0 leaves nothing out. Group g is suspected by T_0 - T_g, the evidence in `signals`. A fault that no single group explains
(an actuator's, the plant's) raises the alarm too; the scheme cannot say which: the alarm then comes with label 0.

Which labels are a sensor's is read off the plant's declaration: their faults move the readings of one group and no state.

[1] P. M. Frank, Automatica 26(3), 1990. [2] R. N. Clark, IEEE Transactions on Aerospace and Electronic Systems 14(3), 1978.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, Rule, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, quadratic
from fdi_gym.estimation.signatures import local
from fdi_gym.plant import Array, Plant

NEVER = 1e12  # the cost of a group that cannot be left out
SIGMAS = 3.0  # of a sum of squares: a fault whose best group leaves more than that unexplained is no single sensor's
WIDEST = 10.0  # spread of an observer that hears too little, in units of the scales
TINY = 1e-9  # of a typical size


class Groups(NamedTuple):
    """The sensors as they are left out together."""

    names: tuple[str, ...]
    members: Array  # (groups, m) bool, of the sensors with noise
    of_label: Array  # (labels,) the group that each label is the fault of; -1 for others


class Bank(NamedTuple):
    """State: the observers, the first of which hears everything, and what their residuals have added up to."""

    X: Array  # (n, b, N)
    P: Array  # (n, b, N, N)
    T: Array  # (n, 1 + groups, paces)
    worst: Array  # (n, m) normalised residuals of the last sample: of each sensor, in an observer that does not hear it
    nu: Array  # (n, m) the last innovation of that which hears everything, and
    S: Array  # (n, m, m) its covariance


def grouped(plant: Plant, model: AugmentedModel, size: Array, groups: Sequence[Sequence[str]] | None) -> Groups:
    """The groups of sensors, one for each by default, and the labels that are theirs.

    Raises:
        ValueError: A name that is no sensor with noise, or one in two groups.
        NotApplicableError: Fewer than two groups.
    """
    names = [plant.outputs[i].name for i in model.sensors]
    asked = [[name] for name in names] if groups is None else [list(group) for group in groups]
    every = [name for group in asked for name in group]
    if not set(every) <= set(names) or len(set(every)) < len(every) or not all(asked):
        raise ValueError(f"groups are made of different ones of {', '.join(names)}, not {asked}")
    members = np.array([[name in group for name in names] for group in asked]).reshape(len(asked), len(names))
    if len(asked) < 2:
        raise NotApplicableError(f"needs at least two groups of sensors; {plant.id} has {len(asked)}")
    u = plant.trim_command + np.array([[1.0], [-1.0]]) * [s.scale for s in plant.commands]
    known = np.tile([s.nominal for s in plant.known], (2, 1))
    d = None if plant.measured_disturbance is None else plant.measured_disturbance(0.0, known, known)
    at, about = Interval(np.ones(2, np.int64), u, d, known), local(model, size)
    X = np.tile(np.append(plant.trim_state, np.zeros(len(model.disturbances))), (2, 1))
    E, H = (
        about.f(X, at).E * size / model.scale[model.rest, None],
        about.h(X, at).E * size / np.sqrt(np.diag(model.R))[:, None],
    )
    moves_state, moves_sensor = np.abs(E).max(axis=(0, 1)) > TINY, np.abs(H).max(axis=0).T > TINY  # (p,), (p, m)
    entries = {mode.name: mode.moves[model.inputs.estimated] for mode in plant.modes}
    of_label = np.full(len(plant.labels), -1)
    for index, label in enumerate(plant.labels):
        moved = np.any([entries[name] for name in label.modes], axis=0) if label.modes else np.zeros(len(size), bool)
        read = moves_sensor[moved].any(axis=0)
        home = [g for g, group in enumerate(members) if read.any() and not (read & ~group).any()]
        if home and not moves_state[moved].any():
            of_label[index] = home[0]
    return Groups(tuple("+".join(group) for group in asked), members, of_label)


def instant(hears: Array, members: Array, dedicated: bool, nu: Array, S: Array, seen: Array) -> tuple[Array, Array]:
    """What one sample adds to T (n, 1 + groups), and each sensor's residual where it is not heard (n, m).

    Args:
        hears: (b, m) what each observer hears; the first hears everything.
        members: (groups, m).
        dedicated: Which scheme.
        nu, S: Innovations of all sensors (n, b, m) and their covariances (n, b, m, m).
        seen: (n, m) bool.
    """
    n, b, m = nu.shape
    square = nu**2 / np.diagonal(S, axis1=2, axis2=3)  # (n, b, m)
    deaf = ~hears & seen[:, None]
    spread = np.where(deaf, np.abs(nu) / np.sqrt(np.diagonal(S, axis1=2, axis2=3)), 0.0)
    worst = spread.sum(axis=1) / np.maximum(deaf.sum(axis=1), 1)
    if not dedicated:
        which = (hears & seen[:, None]).reshape(n * b, m)
        own, covariance = masked(which, nu.reshape(n * b, m), S.reshape(n * b, m, m))
        return (quadratic(own, covariance) - which.sum(axis=1)).reshape(n, b), worst
    pairs = np.where(deaf, square - 1.0, 0.0)[:, 1:]  # (n, groups, m)
    found = np.empty((n, 1 + len(members)))
    found[:, 0] = (pairs.sum(axis=1) / (len(members) - 1)).sum(axis=1)
    for g, group in enumerate(members):
        others = np.arange(len(members)) != g
        rest = pairs[:, others][:, :, ~group]
        found[:, 1 + g] = (rest.sum(axis=1) / max(len(members) - 2, 1)).sum(axis=1)
    return found, worst


def can_be_left_out(plant: Plant, model: AugmentedModel, hears: Array) -> Array:
    """(b,) bool: whether each observer, linearised at trim, is stable with what it hears."""
    at = Interval(np.ones(1, np.int64), plant.trim_command[None], None, np.array([[s.nominal for s in plant.known]]))
    if plant.measured_disturbance is not None:
        at = at._replace(d=plant.measured_disturbance(0.0, at.known, at.known))
    X = model.X0[None]
    A, C = model.jacobian_f(X, at)[1][0], model.jacobian_h(X, at)[1][0]
    A, C = A * model.scale / model.scale[:, None], C * model.scale
    grows = [v for v in np.linalg.eigvals(A) if abs(v) > 1 + 1e-6]
    return np.array([
        all(np.linalg.matrix_rank(np.concatenate([A - v * np.eye(len(A)), C[heard]])) == len(A) for v in grows)
        for heard in hears
    ])  # fmt: skip


def bank_filter(plant: Plant, model: AugmentedModel, groups: Groups, dedicated: bool, paces: Sequence[float]) -> Filter:
    """The bank.

    Args:
        plant: The plant.
        model: Of the healthy plant.
        groups: The sensors.
        dedicated: Which scheme.
        paces: Samples within which each of the sums forgets.

    Raises:
        NotApplicableError: No group can be left out, or no group is enough for an observer.
    """
    members, m, N = groups.members, len(model.R), len(model.scale)
    hears = np.concatenate([np.ones((1, m), bool), members if dedicated else ~members])
    there = can_be_left_out(plant, model, hears)
    if not there[1:].any():
        what = "is enough for a stable observer" if dedicated else "can be left out of a stable observer"
        raise NotApplicableError(f"no group of sensors of {plant.id} {what}")
    b, keep = len(hears), 1.0 - 1.0 / np.asarray(paces, float)
    ceiling = np.diag(WIDEST**2 * model.scale**2)
    usable = there[1:] if not dedicated else np.ones(len(members), bool)
    margin = SIGMAS * np.sqrt(m * np.asarray(paces, float))
    labels = len(plant.labels)

    def start(n: int) -> Bank:
        return Bank(
            np.tile(model.X0, (n, b, 1)), np.tile(model.P0, (n, b, 1, 1)), np.zeros((n, b, len(keep))), np.zeros((n, m)),
            np.zeros((n, m)), np.tile(model.R, (n, 1, 1)),
        )  # fmt: skip

    def predict(s: Bank, at: Interval) -> Bank:
        n = len(s.X)
        X, P = model.predict("extended", s.X.reshape(-1, N), s.P.reshape(-1, N, N), at)
        X, P = X.reshape(n, b, N), P.reshape(n, b, N, N)
        blind = ~there
        if blind.any():  # an observer that hears too little knows no more than it would at trim
            X, P = X.copy(), P.copy()
            X[:, blind], P[:, blind] = model.X0, ceiling
        return s._replace(X=X, P=P)

    def update(s: Bank, at: Interval, y: Array, seen: Array) -> Bank:
        n = len(y)
        X, P = s.X.reshape(-1, N), s.P.reshape(-1, N, N)
        if model.H is None:
            many = at.of(np.repeat(np.arange(n), b))
            mean, H = model.jacobian_h(X, many)
        else:
            mean, H = X @ model.H.T, np.broadcast_to(model.H, (n * b, m, N))
        own, heard = y[:, model.sensors], seen[:, model.sensors]
        nu = np.where(heard[:, None], own[:, None] - mean.reshape(n, b, m), 0.0)
        S = (H @ P @ T(H) + model.R).reshape(n, b, m, m)
        told, worst = instant(hears, members, dedicated, nu, S, heard)
        new: Array = np.asarray(heard.any(axis=1))
        which = np.zeros((n, b, len(plant.outputs)), bool)
        which[:, :, model.sensors] = hears & heard[:, None]
        done = model.update(
            "extended", X, P, at.of(np.repeat(np.arange(n), b)), np.repeat(y, b, axis=0), which.reshape(n * b, -1)
        )
        sums = np.where(new[:, None, None], keep * s.T + told[..., None], s.T)
        first = (a.reshape(n, b, *a.shape[1:])[:, 0] for a in (done.nu, done.S))
        return Bank(
            done.X.reshape(n, b, N), done.P.reshape(n, b, N, N), sums, np.where(new[:, None], worst, s.worst), *first
        )  # fmt: skip

    def read(s: Bank) -> Reading:
        gain = (s.T[:, :1] - s.T[:, 1:]).max(axis=2)  # (n, groups)
        gain = np.where(usable, gain, -NEVER)
        cost = np.zeros((len(gain), labels))
        cost[:, 1:] = -(s.T[:, 0] - margin).max(axis=1)[:, None]
        sensors = np.flatnonzero(groups.of_label >= 0)
        cost[:, sensors] = -gain[:, groups.of_label[sensors]]
        x = model.x
        signals = {"evidence": gain, "residuals unheard": s.worst}
        return Reading(x=s.X[:, 0, x], Px=s.P[:, 0, x, x], nu=s.nu, S=s.S, cost=cost, signals=signals)

    return Filter(start, predict, update, read, expect=lambda s, at: model.expect(s.X[:, 0, model.x], at))


def only_sensors(rule: Rule, of_label: Array) -> Rule:
    """The rule's verdict, with label 0 where its label is no sensor's: there is a fault, and the scheme cannot say which."""

    def step(s: object, k: Array, r: Reading, informed: Array) -> tuple[object, object]:
        s, verdict = rule.step(s, k, r, informed)
        return s, verdict._replace(label=np.where(of_label[verdict.label] >= 0, verdict.label, 0))

    return Rule(rule.start, step)  # type: ignore[arg-type]


@diagnoser("generalised_observers", "Observers that leave out one sensor each: which is inconsistent, for any plant")
@diagnoser(
    "dedicated_observers", "Observers that hear one sensor each: which is inconsistent, for any plant", scheme="dedicated"
)
def generalised_observers(
    plant: Plant,
    belief: Belief,
    calibration: Calibration,
    *,
    scheme: str = "generalised",
    groups: Sequence[Sequence[str]] | None = None,
    paces: Sequence[float] = (10, 40, 160),
) -> Diagnoser:
    """The scheme with its decision.

    Args:
        plant: Any plant whose estimated quantity enters additively, with two sensors with noise or more, and labels
            that are faults of theirs.
        belief: What it may assume of the plant.
        calibration: When it alarms.
        scheme: "generalised" or "dedicated".
        groups: Sensors that are left out, or heard, together. Default: each alone.
        paces: Samples within which each of the sums of evidence forgets, 1 or more.

    Raises:
        NotApplicableError: No label is a sensor's fault, too few sensors, or none can be left out.
        ValueError: Unknown scheme or sensor, or a number out of range.
    """
    if scheme not in ("generalised", "dedicated"):
        raise ValueError(f"unknown scheme {scheme!r}; there are generalised, dedicated")
    if not paces or min(paces) < 1:
        raise ValueError(f"paces of at least 1 sample are allowed, not {tuple(paces)}")
    found = grouped(plant, augmented(plant, belief), belief.z_size, groups)
    if (found.of_label < 0).all():
        raise NotApplicableError(f"no label of {plant.id} is a sensor's fault; with the option sensor_faults there are")
    bare = augmented(plant, belief, faults=False)
    filter = bank_filter(plant, bare, found, scheme == "dedicated", paces)
    return diagnoser_of(plant, filter, only_sensors(by_labels(plant, calibration), found.of_label))
