"""What of a plant's faults any method could tell apart: which pairs, at what size, after how long.

The plant is linearised along healthy flights of a fault process, and a Kalman filter of state and disturbance is run along
them. A fault that sets in at a known time moves its innovations by a signature that is linear in the fault vector z, so that
G(t) = sum of V' S^-1 V up to t, V the signature, is the Fisher information about z. It gives both measures:

- the Kullback-Leibler distinguishability [1] of a fault z from the faults of another label: half the least of
  (z - q)' G (z - q) over that label's q, in nats. It is the mean of the log likelihood ratio by which the best test tells
  the two apart, and that test errs in one case of 20 at NEEDED nats. From "none" it is z' G z / 2;
- the Cramer-Rao bound of a mode's magnitude m along its direction d, its onset known and nothing else at fault: the standard
  deviation 1 / sqrt(d' G d) that no unbiased estimate goes below; on a plane D, the root of the diagonal of (D G D')^-1.

A fault is never told from a label that holds it (a second fault of size 0, where its reach has that): only the price of the
second fault speaks against such a label. Both measures hold for a known onset and a linear model: methods that are told
neither are slower. A fault that acts through a command (a loss of effectiveness) shows only as far as flights command it.

[1] D. Eriksson, E. Frisk, M. Krysander, Automatica 49(6), 2013, who take the samples of a window; the innovations of the
filter are the same information with all samples before the onset known.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtri

from fdi_gym.diagnosis.fitting import VALIDATION_SEED, fit_belief
from fdi_gym.engine import Record, simulate
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.interval import Interval
from fdi_gym.estimation.kalman import T, right_divide, symmetric
from fdi_gym.estimation.labels import manifolds, nearest_of
from fdi_gym.estimation.signatures import local
from fdi_gym.faults import draw
from fdi_gym.plant import Array, Plant

ERROR = 0.05  # of the test between two faults
NEEDED = 2.0 * float(ndtri(ERROR)) ** 2  # nats: a distance of 2 * 1.645 standard deviations
SIZES = (0.05, 0.15, 0.25, 0.35, 0.5, 0.65, 0.75, 0.85, 0.95)  # quantiles of the magnitudes that the process draws
SHOWN = (2, 4, 6)  # of these, as small, medium and large in tables
MEDIUM = 4
FIRST = 600_000  # its flights begin at VALIDATION_SEED + FIRST
DRAWN = 100  # flights whose faults say how large they are
SETTLED = 200  # samples within which the filter has settled


class Diagnosability(NamedTuple):
    """Faults by label (rows: the faulty ones, each with all its modes at one size) against labels, over time since onset."""

    plant: str
    process: str
    labels: tuple[str, ...]  # all; the first is "none"
    faults: Array  # (labels,) how many simultaneous faults each has
    magnitudes: tuple[str, ...]  # the mode, and of planes the entry
    unit: tuple[str, ...]  # of each magnitude
    seconds: Array  # (T,) since onset
    divergence: Array  # (T, labels - 1, sizes, labels) nats: median over flights; NaN of a label with itself
    bound: Array  # (T, magnitudes) standard deviation; median over flights

    def told_apart(self) -> Array:
        """Seconds until each fault is told from each label (labels - 1, sizes, labels): inf for never, NaN as above."""
        over = self.divergence >= NEEDED
        first = np.where(over.any(axis=0), self.seconds[np.argmax(over, axis=0)], np.inf)
        return np.where(np.isnan(self.divergence[-1]), np.nan, first)

    def confusions(self) -> Array:
        """What a method that weighs all labels would say of each fault (labels - 1, labels): shares, over time and sizes.

        Each label counts by exp(-nats), and must be better by NEEDED nats for each of its faults.
        """
        cost = np.nan_to_num(self.divergence) + NEEDED * self.faults
        share = np.exp(cost.min(axis=-1, keepdims=True) - cost)
        share = (share / share.sum(axis=-1, keepdims=True)).mean(axis=2)
        return np.trapezoid(share, self.seconds, axis=0) / (self.seconds[-1] - self.seconds[0])

    def text(self) -> str:
        """Tables for the screen."""
        after, said, n = self.told_apart(), self.confusions(), len(self.labels) - 1
        wide = max(len(name) for name in (*self.labels, "fault"))
        lines = [
            f"{self.plant}, process {self.process}: seconds from onset until a test errs in {ERROR:.0%} of the cases, for a "
            "small, medium and large fault",
            "",
            f"{'fault':{wide}s}  {'seen':>17s}  {'hardest to tell from':>{wide + 2}s}  {'after':>17s}",
        ]

        def cell(values: Array) -> str:
            return " ".join(f"{v:5.3g}" if np.isfinite(v) else "never" for v in values)

        for i in range(n):
            others = np.array([j for j in range(n + 1) if j != i + 1])
            hardest = others[np.argmax(said[i, others])]
            lines.append(
                f"{self.labels[i + 1]:{wide}s}  {cell(after[i, SHOWN, 0])}  {self.labels[hardest]:>{wide + 2}s}  "
                f"{cell(after[i, SHOWN, hardest])}"
            )
        if n <= 8:
            lines += ["", "a medium fault (row) is told from (column) after", ""]
            lines.append(" " * wide + "".join(f"  {name:>{max(len(name), 5)}s}" for name in self.labels))
            for i in range(n):
                cells = ["-" if np.isnan(v) else f"{v:.3g}" if np.isfinite(v) else "never" for v in after[i, MEDIUM]]
                row = "".join(f"  {c:>{max(len(m), 5)}s}" for c, m in zip(cells, self.labels, strict=True))
                lines.append(f"{self.labels[i + 1]:{wide}s}{row}")
            lines += ["", f"a fault (row) is taken for (column), % of the {self.seconds[-1]:.3g} s after its onset", ""]
            lines.append(" " * wide + "".join(f"  {name:>{max(len(name), 5)}s}" for name in self.labels))
            for i in range(n):
                row = "".join(f"  {v:{max(len(m), 5)}.1f}" for v, m in zip(100 * said[i], self.labels, strict=True))
                lines.append(f"{self.labels[i + 1]:{wide}s}{row}")
        when = np.unique(np.linspace(0, len(self.seconds) - 1, 4).astype(int))
        head = "".join(f"{f'{self.seconds[k]:.3g} s':>12s}" for k in when)
        wide = max(len(name) for name in (*self.magnitudes, "mode"))
        lines += ["", "least standard deviation of a magnitude, its mode and onset known", "", f"{'mode':{wide}s}{head}"]
        for i, (mode, unit) in enumerate(zip(self.magnitudes, self.unit, strict=True)):
            cells = "".join(f"{self.bound[k, i]:12.3g}" for k in when)
            lines.append(f"{mode:{wide}s}{cells} {unit}")
        return "\n".join(line.rstrip() for line in lines)

    def picture(self) -> Any:
        """A figure: how far each medium fault is from each label at the end, and the bounds over time."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        n = len(self.labels) - 1
        figure = Figure(figsize=(10.5, 4.2), dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        left, right = figure.subplots(1, 2)
        share = np.log10(np.maximum(self.divergence[-1, :, MEDIUM] / NEEDED, 1e-2))
        shown = left.imshow(share, cmap="RdBu", vmin=-2, vmax=2, aspect="auto")
        left.set_xticks(range(n + 1), self.labels, rotation=60, ha="right", fontsize=7)
        left.set_yticks(range(n), self.labels[1:], fontsize=7)
        left.set_title(f"told from, {self.seconds[-1]:.3g} s after onset", fontsize=9)
        figure.colorbar(shown, ax=left, label=f"log10 of nats / {NEEDED:.1f}")
        for i, mode in enumerate(self.magnitudes):
            right.loglog(self.seconds, self.bound[:, i], label=f"{mode} [{self.unit[i]}]" if self.unit[i] else mode)
        right.set(xlabel="s since onset", title="Cramer-Rao bound of each magnitude")
        right.legend(fontsize=7, frameon=False)
        figure.suptitle(f"{self.plant}, process {self.process}", fontsize=10)
        return figure


def drawn(plant: Plant, process: str) -> list[Array]:
    """The magnitudes (count, f) that a process gives each mode, those of its reach where it draws none: by size."""
    scenarios = [draw(plant.process(process), VALIDATION_SEED + FIRST + i) for i in range(DRAWN)]
    record = simulate(plant, scenarios)
    flown = np.arange(record.label.shape[1]) <= record.length[:, None]
    found = plant.magnitudes(np.where(flown, record.label, 0), record.target - plant.healthy)
    out = []
    for mode, which in zip(plant.modes, plant.magnitudes_of, strict=True):
        low, high = mode.reaches.T
        own = found[..., which]
        values = np.unique(own[np.isfinite(own).all(axis=-1)], axis=0)
        values = values[((values >= low) & (values <= high)).all(axis=1)]
        values = values if len(values) else np.linspace(low, high, 100)
        sizes = np.abs(values) / np.where(high > low, high - low, 1.0)
        out.append(values[np.argsort(sizes.max(axis=1))])
    return out


def of_size(values: Array, size: float) -> tuple[Array, Array]:
    """The magnitudes (f,) at a quantile of those drawn (count, f), by size; twice, with both signs where both are."""
    m = values[int(size * (len(values) - 1))]
    return m, np.where((values.min(axis=0) < 0) & (values.max(axis=0) > 0), -m, m)


def information(
    plant: Plant, model: AugmentedModel, size: Array, record: Record, onset: int, times: Array
) -> Array:  # fmt: skip
    """Fisher information about a constant fault from `onset` on (times, N, p, p), along healthy flights.

    Args:
        plant: The plant.
        model: Its augmented model.
        size: Typical fault sizes (p,).
        record: N healthy flights.
        onset: The sample from which on the fault acts.
        times: Samples after it at which the information is wanted, in order.
    """
    n, p, about, rest = len(record.obs), len(size), local(model, size), model.rest
    N, m, Q = len(rest), len(model.R), model.Q[np.ix_(model.rest, model.rest)]
    P, M, G = np.tile(model.P0[np.ix_(rest, rest)], (n, 1, 1)), np.zeros((n, N, p)), np.zeros((n, p, p))
    found, none = [], np.zeros((n, N - len(plant.states)))
    one = np.tile(np.eye(m), (n, 1, 1))
    for k in range(max(onset - SETTLED, 0) + 1, onset + int(times[-1]) + 1):
        _, u, known = plant.split(record.obs[:, k])
        before = plant.split(record.obs[:, k - 1])[2]
        d = None if plant.measured_disturbance is None else plant.measured_disturbance((k - 1) * plant.dt, before, known)
        at = Interval(np.full(n, k), u, d, known)
        f = about.f(np.concatenate([record.state[:, k - 1], none], axis=1), at)
        P = symmetric(f.A @ P @ T(f.A)) + Q
        M = f.A @ M + f.E * (k > onset)
        h = about.h(np.concatenate([record.state[:, k], none], axis=1), at)
        cross = P @ T(h.A)
        S = h.A @ cross + model.R
        V = h.A @ M + h.E * (k > onset)
        K = right_divide(cross, S)
        G = G + T(V) @ right_divide(one, S) @ V
        P, M = symmetric(P - K @ T(cross)), M - K @ V
        if k - onset in times:
            found.append(G)
    return np.array(found)


def diagnosability(
    plant: Plant,
    process: str = "standard",
    *,
    flights: int = 12,
    seconds: float | None = None,
    belief: Belief | None = None,
) -> Diagnosability:
    """Which faults of a plant can be told apart, at what size, and after how long.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        process: The fault process, of whose healthy flights the commands and noises are.
        flights: Healthy flights that it is averaged over, of validation seeds.
        seconds: How long after the onset, which is a third into the flight. Default: another third.
        belief: Noises of the model. Default: fitted to the process.

    Raises:
        ValueError: Unknown process, or a number out of range.
        NotApplicableError: The plant is not of that kind.
    """
    asked = plant.process(process)
    if flights < 1:
        raise ValueError(f"at least 1 flight is needed, not {flights}")
    scenarios = [draw(asked, VALIDATION_SEED + FIRST + i).without_faults() for i in range(flights)]
    steps = min(s.steps for s in scenarios)
    onset = steps // 3
    wanted = steps // 3 if seconds is None else seconds / plant.dt
    if not 0.5 <= wanted <= steps - onset:
        raise ValueError(f"up to {(steps - onset) * plant.dt:g} s after the onset can be looked at, not {seconds:g}")
    length = max(round(wanted), 1)
    belief = fit_belief(plant, process) if belief is None else belief
    model = augmented(plant, belief)
    record = simulate(plant, scenarios)
    whole = record.length >= onset + length
    if not whole.any():
        raise ValueError(f"no healthy flight of {process} goes on for {length * plant.dt:g} s after the onset")
    record = record._replace(**{name: getattr(record, name)[whole] for name in ("obs", "state")})
    times = np.unique(np.geomspace(1, length, 32).astype(int))
    G = information(plant, model, belief.z_size, record, onset, times)  # (T, n, p, p)
    sets, which = manifolds(plant), model.inputs.estimated
    count, n, p = len(times), G.shape[1], G.shape[2]
    flat = G.reshape(count * n, p, p)
    found = np.full((count, len(plant.labels) - 1, len(SIZES), len(plant.labels)), np.nan)
    sizes = dict(zip(plant.mode_names, zip(plant.modes, drawn(plant, process), strict=True), strict=True))
    for i, label in enumerate(plant.labels[1:]):
        for s, size in enumerate(SIZES):
            nats = []
            for sign in (0, 1):
                parts = [np.array(mode.offset) + of_size(values, size)[sign] @ mode.directions
                         for mode, values in (sizes[name] for name in sorted(label.modes))]  # fmt: skip
                z = np.sum(parts, axis=0)[which]
                Gz = flat @ z
                own = Gz @ z
                value, _ = nearest_of(flat, Gz, sets)
                all_labels = np.zeros((count * n, len(plant.labels)))
                all_labels[:, 0], all_labels[:, sets.labels] = own, own[:, None] + value
                nats.append(0.5 * np.maximum(all_labels, 0.0).reshape(count, n, -1))
            found[:, i, s] = np.median(np.mean(nats, axis=0), axis=1)
            found[:, i, s, i + 1] = np.nan
    bound = np.concatenate([_bound(mode.directions[:, which], G) for mode in plant.modes], axis=1)
    entries = [(mode, plant.estimated[i]) for mode in plant.modes for i in np.argmax(np.abs(mode.directions), axis=1)]
    faults = np.array([len(label.modes) for label in plant.labels])
    return Diagnosability(
        plant.env_id, process, tuple(label.name for label in plant.labels), faults,
        tuple(f"{mode.name} {entry.name}" if len(mode.directions) > 1 else mode.name for mode, entry in entries),
        tuple(entry.unit for _, entry in entries), times * plant.dt, found, bound,
    )  # fmt: skip


def _bound(directions: Array, G: Array) -> Array:
    """The Cramer-Rao bounds (T, f) of magnitudes along directions (f, p) from informations (T, n, p, p): medians."""
    power, f = directions @ G @ directions.T, len(directions)
    left = np.empty(power.shape[:3])  # of the information about each, when the others are not known
    for i in range(f):
        rest = [j for j in range(f) if j != i]
        both = power[..., i : i + 1, rest]
        taken = both @ np.linalg.pinv(power[..., rest, :][..., rest], hermitian=True) @ T(both)
        left[..., i] = power[..., i, i] - taken[..., 0, 0]
    with np.errstate(divide="ignore"):
        return np.median(1.0 / np.sqrt(np.maximum(left, 0.0)), axis=1)
