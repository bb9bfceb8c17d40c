"""Bank of unknown-input observers for any plant: one per label, blind to that label's faults and to the disturbances.

Observer j treats as unknown inputs what the faults of label j and the unmeasured disturbances add to the state (E d) and to
the sensors (H d). Its gain cancels them, so that its error does not depend on d at all, and among the gains that do, it is
the one with the least variance: the optimal disturbance-decoupling observer [1], an unknown-input filter [2]. With
F = C E + H, nu the innovation and S its covariance,

    d^ = (F' S^-1 F)^-1 F' S^-1 nu,    x+ = x- + E d^ + K (nu - F d^),    K = P C' S^-1.

It exists where [3]: the sensors show every unknown input at once, rank F = rank [E; H], and the rest of the plant is
detectable; a residual is left where there are more sensors than unknown inputs. An observer that does not exist leaves its
label without a verdict.

If label j is the true one, the residual nu - F d^ of observer j stays small and those of the others do not. Labels that are
blind to the same inputs (a stuck and a weak actuator) differ in how the estimated input d^ comes about: it is compared with
what a constant fault of the label would have been. Sums forget at several paces.

[1] J. Chen, R. J. Patton, IEE Proceedings Control Theory and Applications 143(1), 1996; Robust Model-Based Fault Diagnosis
for Dynamic Systems, 1999, chapter 3. [2] S. Gillijns, B. De Moor, Automatica 43(1), 2007. [3] M. Darouach, M. Zasadzinski,
S. J. Xu, IEEE Transactions on Automatic Control 39(3), 1994.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fdi_gym.diagnosis import Diagnoser, Filter, NotApplicableError, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.estimation.decision import Reading, by_labels
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, masked, solve, symmetric, times
from fdi_gym.estimation.labels import Manifolds, manifolds, nearest_of
from fdi_gym.estimation.signatures import local
from fdi_gym.plant import Array, Plant

RANK = 1e-6  # of F against [E; H], both in typical sizes: below, the sensors do not show an input at once
NEVER = 1e12  # the cost of a label without an observer
MOST = 1e6  # products of the covariances' updates, n_x^3 each, in a second of flight
WIDE = 1e-8  # information in the prior of an unknown input: its spread is ten thousand typical sizes


class Bank(NamedTuple):
    """State: b observers, and what their residuals have added up to."""

    X: Array  # (n, b, n_x)
    P: Array  # (n, b, n_x, n_x) without the last interval's unknown input
    E: Array  # (n, n_x, c) what a typical size of each input has added in the last interval; c = p + q: faults, disturbances
    G: Array  # (n, b, paces, p, p) information about a constant fault, from the estimated inputs
    g: Array  # (n, b, paces, p)
    energy: Array  # (n, b, paces) of the residuals that the disturbances leave, in excess of what noise makes
    r: Array  # (n, b) nu' S^-1 nu of the last residual: all inputs of the observer cancelled
    freedoms: Array  # (n, b) and its degrees of freedom
    nu: Array  # (n, m) the last innovation of the first observer, and
    S: Array  # (n, m, m) its covariance, if disturbances have their typical sizes


class Cancelled(NamedTuple):
    """What the innovation says of unknown inputs, with a prior so wide that it counts for nothing."""

    d: Array  # (n, c) their estimate
    V: Array  # (n, c, c) its covariance; 0 for what is not shown
    hidden: Array  # (n, c, c) projector on the inputs that the sensors don't show
    gain: Array  # (n,) how much of nu' S^-1 nu they explain
    freedoms: Array  # (n,) how many of them are shown


def cancelled(W: Array, b: Array) -> Cancelled:
    """The unknown inputs, in units of their typical sizes, from W = F' S^-1 F (n, c, c) and b = F' S^-1 nu (n, c)."""
    one = np.eye(W.shape[1])
    V = solve(W + WIDE * one, np.broadcast_to(one, W.shape))
    d = times(V, b)
    return Cancelled(d, V - WIDE * V @ V, WIDE * V, (b * d).sum(axis=1), (V * W).sum(axis=(1, 2)))


class Observers(NamedTuple):
    """Which observers there are."""

    labels: Array  # (b,) label of each; the first is healthy: blind to the disturbances only
    blind: Array  # (b, c) bool: to which inputs


def existing(plant: Plant, model: AugmentedModel, size: Array) -> Observers:
    """The observers that exist for the plant linearised at trim, under commands of typical size.

    Raises:
        NotApplicableError: None of a faulty label does, or not even that which is blind to the disturbances alone.
    """
    n_x, q = len(plant.states), len(model.disturbances)
    u = plant.trim_command + np.array([[1.0], [-1.0]]) * [s.scale for s in plant.commands]
    known = np.tile([s.nominal for s in plant.known], (2, 1))
    d = None if plant.measured_disturbance is None else plant.measured_disturbance(0.0, known, known)
    at, X = Interval(np.ones(2, np.int64), u, d, known), np.tile(np.append(plant.trim_state, np.zeros(q)), (2, 1))
    f, h = local(model, size).f(X, at), local(model, size).h(X, at)
    inputs = np.concatenate([size, model.scale[model.d]])
    x, y = model.scale[model.x], np.sqrt(np.diag(model.R))
    E = np.concatenate([f.E[:, :n_x], f.A[:, :n_x, n_x:]], axis=2) * inputs / x[:, None]
    H = np.concatenate([h.E, np.zeros((2, len(y), q))], axis=2) * inputs / y[:, None]
    A, C = f.A[:, :n_x, :n_x] * x / x[:, None], h.A[..., :n_x] * x / y[:, None]
    moved = {mode.name: mode.moves for mode in plant.modes}
    labels, blind, reasons = [], [], {}
    for index, label in enumerate(plant.labels):
        faults = np.any([moved[name] for name in label.modes], axis=0) if label.modes else np.zeros(len(size), bool)
        which = np.concatenate([faults[model.inputs.estimated], np.ones(q, bool)])
        why = [_missing(A[i], E[i][:, which], C[i], H[i][:, which]) for i in range(2)]
        if all(why):
            reasons[label.name] = why[0]
        else:
            labels.append(index)
            blind.append(which)
    if "none" in reasons or 0 not in labels or len(labels) < 2:
        name, reason = next(iter(reasons.items()))
        raise NotApplicableError(f"no unknown-input observer exists for {plant.id}: {name}: {reason}")
    return Observers(np.array(labels), np.array(blind))


def _missing(A: Array, E: Array, C: Array, H: Array) -> str:
    """Why there is no observer, for matrices in typical sizes; "" where there is one."""
    F = C @ E + H
    shown = np.linalg.matrix_rank(F, tol=RANK)
    if shown < np.linalg.matrix_rank(np.concatenate([E, H]), tol=RANK):
        return "the sensors do not show all unknown inputs at once: rank(C E + H) < rank([E; H])"
    if shown >= len(C):
        return f"{shown} unknown inputs leave no residual of {len(C)} sensors"
    rest = A - E @ np.linalg.pinv(F, rcond=RANK) @ C @ A
    for value in np.linalg.eigvals(rest):
        if abs(value) > 1 + 1e-6 and np.linalg.matrix_rank(np.concatenate([rest - value * np.eye(len(A)), C])) < len(A):
            return f"what the sensors then still tell does not stabilise it: a mode of {abs(value):.3g} per sample is hidden"
    return ""


class _Functions:
    """The filter's functions.

    Args:
        plant: The plant.
        model: Its augmented model.
        size: Typical fault sizes (p,).
        observers: Which observers there are.
        paces: Samples within which each of the sums forgets.
    """

    def __init__(self, plant: Plant, model: AugmentedModel, size: Array, observers: Observers, paces: Sequence[float]):
        self.plant, self.model, self.size, self.observers = plant, model, size, observers
        self.about = local(model, size)
        self.b, self.p, self.q = len(observers.labels), len(size), len(model.disturbances)
        self.inputs, self.keep = np.concatenate([size, model.scale[model.d]]), 1.0 - 1.0 / np.asarray(paces, float)
        self.blind, self.Q = observers.blind.astype(float), model.Q[model.x, model.x]
        sets = manifolds(plant)
        self.each = [Manifolds(*(a[sets.labels == label] for a in sets)) for label in observers.labels]

    def start(self, n: int) -> Bank:
        """All observers at rest, and nothing heard."""
        plant, model, b, p, k = self.plant, self.model, self.b, self.p, len(self.keep)

        def zeros(*shape: int) -> Array:
            return np.zeros((n, *shape))

        X, P = np.tile(plant.trim_state, (n, b, 1)), np.tile(model.P0[model.x, model.x], (n, b, 1, 1))
        return Bank(
            X, P, zeros(len(plant.states), p + self.q), zeros(b, k, p, p), zeros(b, k, p), zeros(b, k), zeros(b), zeros(b),
            zeros(len(model.R)), np.tile(model.R, (n, 1, 1)),
        )  # fmt: skip

    def around(self, s: Bank) -> Array:
        """Where the model is linearised: the estimate of the observer whose residuals are smallest (n, n_x + q)."""
        best = np.argmin(s.energy[:, :, -1], axis=1)
        return np.concatenate([s.X[np.arange(len(best)), best], np.zeros((len(best), self.q))], axis=1)

    def full(self, X: Array) -> Array:
        """States (n, b, n_x) as points of the augmented model."""
        points = np.zeros((*X.shape[:2], len(self.model.scale)))
        points[..., self.model.x] = X
        return points

    def predict(self, s: Bank, at: Interval) -> Bank:
        """All observers over the interval, and the inputs' ways into the state."""
        n_x, x = s.X.shape[2], self.model.x
        f = self.about.f(self.around(s), at)
        A = f.A[:, None, :n_x, :n_x]
        E = np.concatenate([f.E[:, :n_x], f.A[:, :n_x, n_x:]], axis=2) * self.inputs
        P = symmetric(A @ s.P @ T(A)) + at.noise(self.Q).reshape(-1, 1, n_x, n_x)
        return s._replace(X=self.model.f(self.full(s.X), at)[..., x], P=P, E=E)

    def update(self, s: Bank, at: Interval, y: Array, seen: Array) -> Bank:
        """Correct all observers, and sum what speaks for each."""
        model, size, keep, b, p, q = self.model, self.size, self.keep, self.b, self.p, self.q
        n, n_x, m, y, seen = len(y), s.X.shape[2], len(model.R), y[:, model.sensors], seen[:, model.sensors]
        h = self.about.h(self.around(s), at)
        C, H = h.A[..., :n_x], np.concatenate([h.E, np.zeros((n, m, q))], axis=2) * self.inputs
        acted = (at.k > 0)[:, None, None]
        F = np.repeat(((C @ s.E + H) * acted)[:, None], b, axis=1)  # (n, b, m, c)
        cross = s.P @ T(C)[:, None]
        nu = y[:, None] - model.h(self.full(s.X), at)
        there = np.repeat(seen, b, axis=0)
        nu, S, cross, Ft = masked(
            there, nu.reshape(-1, m), (C[:, None] @ cross + model.R).reshape(-1, m, m), cross.reshape(-1, n_x, m),
            T(F).reshape(n * b, -1, m),
        )  # fmt: skip
        own = np.tile(self.blind, (n, 1))[:, None]
        E, Ft = np.repeat(s.E * acted, b, axis=0) * own, Ft * T(own)
        weighed = solve(S, np.concatenate([T(Ft), T(cross), nu[..., None]], axis=2))
        SF, K, Snu = weighed[..., : p + q], T(weighed[..., p + q : -1]), weighed[..., -1]
        W, wanted = Ft @ SF, times(Ft, Snu)
        inputs_of, total = cancelled(W, wanted), (nu * Snu).sum(axis=1)
        gap = E - T(Ft @ T(K))
        X = s.X.reshape(-1, n_x) + times(gap, inputs_of.d) + times(K, nu)
        P = s.P.reshape(-1, n_x, n_x) - K @ T(cross) + gap @ inputs_of.V @ T(gap) + E @ inputs_of.hidden @ T(E)
        free = cancelled(
            W[:, p:, p:], wanted[:, p:]
        )  # the disturbances alone: the faults of the label must explain the rest
        joint = W[:, :p, p:] @ free.V
        I, Iz = W[:, :p, :p] - joint @ W[:, p:, :p], wanted[:, :p] - times(joint, wanted[:, p:])  # noqa: E741
        I, Iz = I / size[:, None] / size, Iz / size  # noqa: E741
        excess = total - free.gain - there.sum(axis=1) + free.freedoms
        heard = (seen.any(axis=1) & (at.k > 0))[:, None, None]
        return Bank(
            X.reshape(n, b, n_x), symmetric(P).reshape(n, b, n_x, n_x), s.E,
            np.where(heard[..., None, None], keep[:, None, None] * s.G + I.reshape(n, b, 1, p, p), s.G),
            np.where(heard[..., None], keep[:, None] * s.g + Iz.reshape(n, b, 1, p), s.g),
            np.where(heard, keep * s.energy + excess.reshape(n, b, 1), s.energy),
            (total - inputs_of.gain).reshape(n, b), (there.sum(axis=1) - inputs_of.freedoms).reshape(n, b),
            nu.reshape(n, b, m)[:, 0], (S + T(Ft) @ Ft).reshape(n, b, m, m)[:, 0],
        )  # fmt: skip

    def read(self, s: Bank) -> Reading:
        """The label whose observer's residuals are smallest for what it may explain."""
        n, k, p, observers, labels = len(s.X), len(self.keep), self.p, self.observers, len(self.plant.labels)
        cost, z = np.full((n, labels), NEVER), np.zeros((n, labels, p))
        healthy = s.energy[:, 0]
        cost[:, 0] = 0.0
        for i, (label, set_) in enumerate(zip(observers.labels, self.each, strict=True)):
            if label == 0:
                continue
            value, magnitude = nearest_of(s.G[:, i].reshape(-1, p, p), s.g[:, i].reshape(-1, p), set_)
            ratio = s.energy[:, i] + value.reshape(n, k) - healthy
            when = np.argmin(ratio, axis=1)
            cost[:, label] = ratio[np.arange(n), when]
            z[:, label] = set_.points(magnitude.reshape(n, k, 1, -1)[np.arange(n), when])[:, 0]
        best = np.argmin(cost, axis=1)
        own = np.argmin(cost[:, observers.labels], axis=1)
        shown = {"residuals": s.r, "degrees of freedom": s.freedoms}
        return Reading(z[np.arange(n), best], x=s.X[np.arange(n), own], nu=s.nu, S=s.S, cost=cost, signals=shown)


def bank_filter(plant: Plant, model: AugmentedModel, size: Array, observers: Observers, paces: Sequence[float]) -> Filter:
    """The bank; arguments as in `_Functions`."""
    f = _Functions(plant, model, size, observers, paces)

    def expect(s: Bank, at: Interval) -> Array:
        return model.expect(f.around(s)[:, : s.X.shape[2]], at)

    return Filter(f.start, f.predict, f.update, f.read, expect=expect)


@diagnoser("unknown_input_observers", "Bank of unknown-input observers, one blind to each label's faults, for any plant")
def unknown_input_observers(
    plant: Plant, belief: Belief, calibration: Calibration, *, paces: Sequence[float] = (10, 40, 160, 640)
) -> Diagnoser:
    """The bank with its decision.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: What it may assume of the plant.
        calibration: When it alarms.
        paces: Samples within which each of the sums of evidence forgets, 1 or more.

    Raises:
        NotApplicableError: No observer exists: a rank condition, or an unstable mode that nothing shows; or so many
            that they cost too much.
        ValueError: A number out of range.
    """
    if not paces or min(paces) < 1:
        raise ValueError(f"paces of at least 1 sample are allowed, not {tuple(paces)}")
    model = augmented(plant, belief)
    observers = existing(plant, model, belief.z_size)
    many, n_x, rate = len(observers.labels), len(plant.states), 1.0 / plant.dt
    work = many * n_x**3 * rate
    if work > MOST:
        raise NotApplicableError(
            f"{many} observers of {n_x} states at {rate:g} samples a second cost too much: {work:.1e} products a second of "
            f"flight, where {MOST:.0e} are allowed"
        )
    return diagnoser_of(plant, bank_filter(plant, model, belief.z_size, observers, paces), by_labels(plant, calibration))
