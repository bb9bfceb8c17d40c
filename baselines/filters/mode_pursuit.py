"""Which of the fault modes act, each for itself: the augmented filter, its estimate explained by as few modes as it takes.

The deviation from healthy that the filter estimates is a sum of points on the modes' lines. Modes are added one after the
other, each time the one that explains most of what is left, with all magnitudes fitted again, as long as that gains more
than the mode's threshold: orthogonal matching pursuit (Y. C. Pati, R. Rezaiifar, P. S. Krishnaprasad, 27th Asilomar
Conference, 1993) in the metric of the estimate's covariance. Each mode has an automaton of its own. So faults at once need
no label; the signal "modes" (n, modes) says which act, and the label is that of the set, or of its strongest mode.
"""

from __future__ import annotations

import numpy as np

from baselines.filters.augmented_gaussian import gaussian_filter
from fdi_gym.diagnosis import Diagnoser, diagnoser, diagnoser_of
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.automaton import Automaton
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.calibration import Calibration, least
from fdi_gym.estimation.decision import Evidence, Reading, Rule, Verdict, declare, undeclared
from fdi_gym.plant import Array, Plant

MOST = 3  # modes at once


class Lines:
    """The lines and planes of a plant's modes in the estimated space; beyond a mode's own directions there are zeros."""

    def __init__(self, plant: Plant):
        self.offset = np.array([mode.offset for mode in plant.modes])  # (modes, p)
        most = max(len(which) for which in plant.magnitudes_of)
        self.directions = np.zeros((len(plant.modes), most, len(plant.estimated)))  # (modes, f, p)
        for mode, rows in zip(plant.modes, self.directions, strict=True):
            rows[: len(mode.directions)] = mode.directions

    def pursue(self, z: Array, I: Array, threshold: Array) -> tuple[Array, Array]:  # noqa: E741
        """Modes that explain z.

        Args:
            z: Deviation from healthy (n, p).
            I: Its information (n, p, p).
            threshold: What a mode must gain (modes,).

        Returns:
            How much each gained when it was added, 0 for those that were not (n, modes), and the gain of each alone.
        """
        n, (modes, f, _) = len(z), self.directions.shape
        gained, alone = np.zeros((n, modes)), np.zeros((n, modes))
        chosen, left = np.zeros((n, 0, z.shape[1])), z.copy()
        cost = np.einsum("np,npq,nq->n", z, I, z)
        going = np.ones(n, bool)
        for count in range(MOST):
            b = left[:, None] - self.offset  # (n, modes, p)
            D = np.concatenate([
                np.broadcast_to(chosen[:, None], (n, modes, count * f, z.shape[1])),
                np.broadcast_to(self.directions, (n, modes, f, z.shape[1])),
            ], axis=2)  # fmt: skip
            DI = D @ I[:, None]
            A = DI @ np.swapaxes(D, 2, 3)
            A = A + 1e-9 * (np.einsum("nmaa->nm", A)[..., None, None] + 1e-300) * np.eye(count * f + f)
            m = np.linalg.solve(A, DI @ b[..., None])
            r = b - (m * D).sum(axis=2)
            gain = cost[:, None] - np.einsum("nmp,npq,nmq->nm", r, I, r)
            alone = np.maximum(gain, 0.0) if count == 0 else alone
            gain = np.where(gained > 0, -np.inf, gain)
            best = np.argmax(gain - threshold, axis=1)
            most = gain[np.arange(n), best]
            going = going & (most > threshold[best])
            if not going.any():
                break
            gained[going, best[going]] = most[going]
            left = np.where(going[:, None], left - self.offset[best], left)
            cost = np.where(going, cost - most, cost)
            chosen = np.concatenate([chosen, np.where(going[:, None, None], self.directions[best], 0.0)], axis=1)
        return gained, alone


def by_modes(plant: Plant, calibration: Calibration) -> Rule:
    """Modes, each with its automaton, by what they gain in fit beyond their thresholds.

    Raises:
        ValueError: A calibration of another plant.
    """
    calibration.penalties(plant)
    lines, after, modes = Lines(plant), calibration.persistence, len(plant.modes)
    threshold = np.array([calibration.thresholds.get(mode.name, least(mode)) for mode in plant.modes])
    sets = plant.modes_of(np.arange(len(plant.labels)))
    single = _labels(sets, np.eye(modes, dtype=bool))
    p = len(plant.estimated)
    excess = np.zeros((p, p)) if calibration.excess is None else calibration.excess

    def step(s: Automaton, k: Array, r: Reading, informed: Array) -> tuple[Automaton, Verdict]:
        assert r.z is not None
        assert r.P is not None
        n = len(k)
        gained, alone = lines.pursue(r.z, np.linalg.inv(r.P + excess), threshold)
        if r.gain is not None:
            of_mode = np.where(single >= 0, r.gain[:, np.maximum(single, 0)], 0.0)
            gained = np.maximum(gained, np.where(of_mode > threshold, of_mode, 0.0))
            alone = np.maximum(alone, of_mode)
        told = np.broadcast_to((informed & (k > after.warmup))[:, None], gained.shape)
        s = declare(s, np.ones(gained.shape, np.int64), gained > 0, gained < 0.5 * threshold, after, told)
        acts = s.label > 0
        cost = np.zeros((n, len(plant.labels)))
        cost[:, single[single >= 0]] = -alone[:, single >= 0]
        strongest = single[np.argmax(np.where(acts & (single >= 0), alone, -1.0), axis=1)]
        label = _labels(sets, acts)
        label = np.where(label >= 0, label, np.maximum(strongest, 0))
        return s, Verdict(np.any(acts, axis=1), label, evidence=Evidence(cost), signals={"modes": acts})

    return Rule(lambda n: undeclared((n, modes)), step)


def _labels(sets: Array, acts: Array) -> Array:
    """The labels (n,) whose sets (labels, modes) are the modes that act (n, modes), all bool; -1 where there is none."""
    same = (acts[:, None] == sets).all(axis=2)
    return np.where(same.any(axis=1), same.argmax(axis=1), -1)


@diagnoser("mode_pursuit_ekf", "The augmented EKF, its estimate explained by as few fault modes as it takes")
def mode_pursuit_ekf(plant: Plant, belief: Belief, calibration: Calibration) -> Diagnoser:
    """The augmented filter with the pursuit.

    Args:
        plant: Any plant whose estimated quantity enters additively and whose sensors have noise.
        belief: What it may assume of the plant.
        calibration: When it alarms.
    """
    return diagnoser_of(plant, gaussian_filter(augmented(plant, belief), "extended"), by_modes(plant, calibration))
