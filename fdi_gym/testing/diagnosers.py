"""What every diagnoser must keep: causal, the same for one flight as for many, through gaps too."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fdi_gym.diagnosis import Decisions, Diagnoser, guarded, run
from fdi_gym.engine import simulate
from fdi_gym.faults import FaultScenario, draw
from fdi_gym.plant import Array, Plant


def check_diagnoser(
    build: Callable[[Plant, Sequence[FaultScenario]], Diagnoser], plant: Plant, seed: int = 11, samples: int = 300
) -> None:
    """Shapes, determinism, batch independence, no look-ahead, and gaps in the measurement.

    A method that handles gaps must stay quiet through them and keep its accuracy; the others, which the guard holds, must
    not be lost.

    Args:
        build: Makes the diagnoser from the plant; the scenarios are for clairvoyant ones.
        plant: The plant.
        seed: Of the episodes it is shown.
        samples: How many samples of them.
    """
    scenarios = [draw(plant.processes["standard"], seed + i) for i in range(4)]
    obs = simulate(plant, scenarios).obs[:, :samples].copy()
    obs.setflags(write=False)  # as worker processes get large arrays

    def fresh(which: Sequence[int]) -> Diagnoser:
        raw = build(plant, [scenarios[i] for i in which])
        return guarded(raw, plant)

    everyone = list(range(len(scenarios)))
    said = run(fresh(everyone), obs, signals=True)
    shown = _arrays(said)
    n_labels = len(plant.labels)
    assert ((said.label >= -1) & (said.label < n_labels)).all(), "what is declared is no label"
    if said.label_probs is not None:
        probs = said.label_probs
        assert (probs >= -1e-9).all(), "a probability is negative"
        assert np.allclose(probs.sum(axis=2), 1, atol=1e-6), "probabilities do not sum to 1"
    if said.estimate_std is not None:
        assert not (said.estimate_std < 0).any(), "a standard deviation is negative"
    # no look-ahead: what is said up to a sample is the same, to the bit, when it is said again before something else
    half = samples // 2
    changed = obs.copy()
    changed[:, half:] = changed[:, :1]
    other = _arrays(run(fresh(everyone), changed, signals=True))
    try:
        _equal(
            _pick(shown, slice(None), slice(half)),
            _pick(other, slice(None), slice(half)),
            "what it says depends on later samples",
        )
    except AssertionError:
        _equal(shown, _arrays(run(fresh(everyone), obs, signals=True)), "a second run differs: not deterministic")
        raise
    alone = _arrays(run(fresh([2]), obs[2:3], signals=True))
    _equal(_pick(shown, slice(2, 3)), alone, "an episode depends on its batch", 1e-6)
    # a dropout in one episode: that one goes on, the others don't notice
    holes = obs.copy()
    holes[1, half, 0] = np.nan
    holes[1, half + 1] = np.nan
    hurt = run(fresh(everyone), holes, signals=True)
    rest = [0, 2, 3]
    _equal(_pick(shown, rest), _pick(_arrays(hurt), rest), "a NaN in one episode reaches another", 1e-6)
    assert (hurt.label[1] >= 0).all(), "a dropout loses the episode"
    assert hurt.estimate is None or np.isfinite(hurt.estimate[1]).all(), "a dropout leaves a NaN in the estimate"
    _check_gaps(fresh(everyone), plant, scenarios, obs, said)


GAPS = (1, 5, 10, 20)  # samples


def with_gaps(obs: Array, plant: Plant) -> Array:
    """Observations (N, K, n_obs) with gaps of 1 to 20 samples, one sensor missing every seventh, and nothing at first."""
    found, k = obs.copy(), obs.shape[1] // 3
    found[:, 0] = np.nan
    for length in GAPS:
        found[:, k : k + length] = np.nan
        k += length + obs.shape[1] // 12
    found[:, ::7, len(plant.outputs) // 2] = np.nan
    return found


def _check_gaps(diagnoser: Diagnoser, plant: Plant, scenarios: Sequence[FaultScenario], obs: Array, said: Decisions) -> None:
    """Through gaps a method stays as quiet as without them, and as right."""
    hurt = run(diagnoser, with_gaps(obs, plant))
    assert (hurt.label >= 0).all() or (said.label < 0).any(), "gaps lose an episode"
    if not diagnoser.gaps:
        return
    truth = np.stack([plant.label_rows(s)[: obs.shape[1]] for s in scenarios])
    right, right_hurt = ((d.label == truth).mean() for d in (said, hurt))
    assert right_hurt >= right - 0.15, f"gaps cost accuracy: {right:.2f} without, {right_hurt:.2f} with"
    alarms, alarms_hurt = ((d.alarm & (truth == 0)).any(axis=1).sum() for d in (said, hurt))
    # at the calibrated rate of 5 %, two of four flights alarm by chance once in 71 times
    assert alarms_hurt <= alarms + 1, f"gaps raise false alarms: in {alarms} flights without, in {alarms_hurt} with"


def _arrays(said: Decisions) -> dict[str, Array]:
    """Everything that was said, by name, the method's own signals included."""
    return {name: a for name, a in said._asdict().items() if isinstance(a, np.ndarray)} | (said.signals or {})


def _pick(arrays: dict[str, Array], which: Sequence[int] | slice, samples: slice = slice(None)) -> dict[str, Array]:
    return {name: a[which][:, samples] for name, a in arrays.items()}


def _equal(left: dict[str, Array], right: dict[str, Array], what: str, tolerance: float = 0.0) -> None:
    assert left.keys() == right.keys(), f"{what}: {sorted(left)} against {sorted(right)}"
    for name, a in left.items():
        b = right[name]
        if a.dtype == bool or np.issubdtype(a.dtype, np.integer):
            assert np.array_equal(a, b), f"{what} ({name})"
        else:
            scale = np.nanmax(np.abs(a), initial=1.0)
            assert np.allclose(a, b, rtol=tolerance, atol=tolerance * scale, equal_nan=True), f"{what} ({name})"
