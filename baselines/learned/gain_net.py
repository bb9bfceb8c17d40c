"""A gain network: the plant's model predicts, a recurrent network corrects the gain and names the fault.

The scheme is KalmanNet's (G. Revach, N. Shlezinger, X. Ni, A. Lopez Escoriza, R. J. G. van Sloun, Y. C. Eldar, "KalmanNet:
Neural Network Aided Kalman Filtering for Partially Known Dynamics", IEEE Transactions on Signal Processing 70, 2022):
predict by the model, update by a gain that a recurrent network computes from differences of observations, innovations and
estimates. `baselines.learned.gain_filter` has the filter and what the network is shown of it. What differs:

- the state is the augmented one, with the fault vector as random walks, so the estimate is a diagnosis;
- the network does not emit the gain but a factor for each of its entries, exp(r tanh(.)), on the nominal gain of the
  augmented extended Kalman filter, whose covariance is carried along: it starts as a filter that works, and what it may
  change is bounded (r = log 2 for the plant's state, log 10 for the fault vector);
- it speaks once per step of several samples, for the samples of the next one, where the paper has every sample;
- the same recurrent state answers for the label, and for how sure the estimate is. The paper's estimate has neither.

The label with the largest logit is declared, since training gave all labels equal weight; probabilities are calibrated for
the process that it expects. One that it was not trained on it takes for the first. Its filter is that of the first process,
whichever is met. It runs on NumPy; torch trains it (`baselines.learned._gain`), through the filter.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from baselines.learned import gain_filter as gain
from baselines.learned import weights
from baselines.learned.probabilities import log_softmax
from baselines.learned.recipes import gain_recipe
from baselines.learned.sequence_net import LOG_STD, recur
from fdi_gym.diagnosis import Diagnoser, Filter, diagnoser, diagnoser_of, trainer
from fdi_gym.diagnosis.contract import choose
from fdi_gym.estimation.augmented import AugmentedModel, augmented
from fdi_gym.estimation.belief import Belief
from fdi_gym.estimation.decision import Reading, by_candidate
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, NotApplicableError, Plant

BELIEF = "filter.belief."  # before the names of a belief's fields among the tensors


class Nominal(NamedTuple):
    """The filter whose gain is corrected, and how what is shown of it is standardised."""

    belief: Belief
    model: AugmentedModel
    layout: gain.Layout
    mean: Array  # (features,)
    std: Array
    rest: Array  # (rows,) what [x; z] is counted from: trim, and healthy
    scale: Array  # (rows,) scales of the data sheet


def nominal_of(plant: Plant, given: Belief | Mapping[str, Array], stride: int) -> Nominal:
    """The nominal filter of a belief, or of the tensors of a network.

    Raises:
        NotApplicableError: The state lies on a manifold, or the plant cannot be augmented.
        ValueError: The tensors are no belief of this plant.
    """
    if plant.quaternions:
        raise NotApplicableError(f"the state of {plant.id} holds a quaternion, of which differences are no corrections")
    if isinstance(given, Belief):
        belief, mean, std = given, np.zeros(1), np.ones(1)
    else:
        fields = {name: given[BELIEF + name] for name in Belief.__struct_fields__}
        belief = Belief(**{**fields, "changes": float(fields["changes"][0])})
        mean, std = given["filter.mean"], given["filter.std"]
    model = augmented(plant, belief)
    layout = gain.layout(model, stride)
    if isinstance(given, Belief):
        mean, std = np.zeros(len(layout.unit)), np.ones(len(layout.unit))
    p = model.z.stop - model.z.start
    rest = np.concatenate([plant.trim_state, np.zeros(p)])
    scale = np.array([s.scale for s in (*plant.states, *plant.estimated)])
    return Nominal(belief, model, layout, mean, std, rest, scale)


def nominal_tensors(nominal: Nominal) -> dict[str, Array]:
    """The nominal filter as tensors."""
    fields = {BELIEF + name: getattr(nominal.belief, name) for name in Belief.__struct_fields__}
    found = {name: np.atleast_1d(np.asarray(value, float)) for name, value in fields.items()}
    return found | {"filter.mean": nominal.mean, "filter.std": nominal.std}


def tensor_shapes(plant: Plant, tensors: Mapping[str, Array], hidden: int, processes: int) -> dict[str, tuple[int, ...]]:
    """The shapes of all arrays of a stored network; how many sensors and disturbances its filter has is its own."""
    n_x, p, magnitudes = len(plant.states), len(plant.estimated), plant.n_magnitudes
    m, q = (np.asarray(tensors.get(BELIEF + name, np.zeros(0))).size for name in ("sensors", "disturbances"))
    rows, labels = n_x + p, len(plant.labels)
    shown = 4 * m + 2 * rows + 2 * p + n_x + labels + len(plant.commands) + len(plant.known)
    inputs = shown + processes
    layers = {
        "value": (hidden, inputs), "gate": (hidden, inputs), "join": (hidden, inputs + hidden), "read": (hidden, hidden),
        "heads": (labels + rows, hidden), "gain": (rows * m, hidden),
    }  # fmt: skip
    found: dict[str, tuple[int, ...]] = {f"network.{name}.weight": size for name, size in layers.items()}
    found |= {f"network.{name}.bias": size[:1] for name, size in layers.items()}
    for end in ("ih", "hh"):
        found |= {f"network.memory.weight_{end}": (3 * hidden, hidden), f"network.memory.bias_{end}": (3 * hidden,)}
    fields = {
        "x0": (n_x,), "P0": (n_x, n_x), "Q": (n_x, n_x), "R": (m, m), "sensors": (m,), "z_size": (p,), "z_walk": (p,),
        "m_mean": (magnitudes,), "m_std": (magnitudes,), "m_walk": (magnitudes,), "changes": (1,), "disturbances": (q,),
        "d0": (q,), "d_walk": (q,),
    }  # fmt: skip
    found |= {BELIEF + name: size for name, size in fields.items()}
    return found | {"filter.mean": (shown,), "filter.std": (shown,)}


class Answer(NamedTuple):
    """What the network says at the end of a step."""

    logits: Array  # (n, labels)
    log_std: Array  # (n, rows) of the estimate of [x; z], in scales of the data sheet
    factor: Array  # (n, rows, m) on the nominal gain
    h: Array  # (n, hidden)


def forward(net: Mapping[str, Array], x: Array, h: Array, reach: Array, labels: int) -> Answer:
    """One step of the network that `_gain.GainNetwork` trains.

    Args:
        net: Its tensors, those of the memory with "_l0" at the end.
        x: Features (n, inputs), the process included.
        h: Memory (n, hidden).
        reach: Largest log factor of each row (rows,).
        labels: Labels of the plant.
    """

    def linear(name: str, a: Array) -> Array:
        return a @ net[f"{name}.weight"].T + net[f"{name}.bias"]

    def silu(a: Array) -> Array:
        return a * (0.5 + 0.5 * np.tanh(0.5 * a))

    product = linear("value", x) * np.tanh(linear("gate", x))
    seen = silu(linear("join", np.concatenate([x, product], axis=1)))
    h = recur(net, seen, h)
    read = silu(linear("read", seen + h))
    heads, log = linear("heads", read), np.tanh(linear("gain", read)).reshape(len(x), len(reach), -1)
    return Answer(heads[:, :labels], np.clip(heads[:, labels:], *LOG_STD), np.exp(reach[:, None] * log), h)


class Filtered(NamedTuple):
    """State for n episodes."""

    X: Array  # (n, N)
    P: Array  # (n, N, N) the nominal covariance
    total: Array  # (n, white to seen) sums of the step that is being filled
    start: Array  # (n, N) the estimate, and
    reported: Array  # (n, m) the newest reports at the end of the step before
    newest: Array  # (n, m) now
    said: Answer


def gain_filter(nominal: Nominal, net: Mapping[str, Array], context: Array, stride: int, calibration: Any) -> Filter:
    """The filter with the network in it.

    Args:
        nominal: The filter whose gain is corrected.
        net: The network's tensors, as `forward` takes them.
        context: Which process is expected (processes,).
        stride: Samples per step.
        calibration: Of the probabilities (`weights.ProbabilityCalibration`).
    """
    model, plant = nominal.model, nominal.model.plant
    labels, rows, m, n_x = len(plant.labels), model.z.stop, len(model.R), model.x.stop
    reach, hidden, sums = gain.reach(model), net["read.bias"].size, nominal.layout.moved.start
    scale, bias, prior = calibration.scale, np.array(calibration.bias), np.array(calibration.prior)

    def start(n: int) -> Filtered:
        X, newest = np.tile(model.X0, (n, 1)), gain.at_rest(model, n)
        first = np.tile((np.log(np.maximum(prior, 1e-12)) - bias) / scale, (n, 1))
        said = Answer(first, np.zeros((n, rows)), np.ones((n, rows, m)), np.zeros((n, hidden)))
        return Filtered(X, np.tile(model.P0, (n, 1, 1)), np.zeros((n, sums)), X, newest, newest, said)

    def predict(s: Filtered, at: Interval) -> Filtered:
        X, P = gain.predicted(model, s.X, s.P, at)
        return s._replace(X=X, P=P)

    def update(s: Filtered, at: Interval, y: Array, seen: Array) -> Filtered:
        c = gain.corrected(model, s.X, s.P, at, y, seen, s.said.factor)
        total = gain.added(model, s.total, c, s.said.factor)
        s = s._replace(X=c.X, P=c.P, total=total, newest=gain.newest(model, s.newest, y, seen))
        ends = (at.k + 1) % stride == 0
        return choose(ends, spoken(s, at), s) if ends.any() else s

    def spoken(s: Filtered, at: Interval) -> Filtered:
        """At the end of a step."""
        raw = gain.shown(model, nominal.layout.sets, s.total, s.X, s.start, s.P, s.newest - s.reported, at.u, at.known)
        own = gain.features(raw, nominal.layout.unit, nominal.mean, nominal.std)
        x = np.concatenate([own, np.tile(context, (len(own), 1))], axis=1)
        said = forward(net, x, s.said.h, reach, labels)
        return s._replace(total=np.zeros_like(s.total), start=s.X, reported=s.newest, said=said)

    def read(s: Filtered) -> Reading:
        probs = np.exp(log_softmax(scale * s.said.logits + bias))
        std = nominal.scale * np.exp(s.said.log_std)
        P = std[:, n_x:, None] ** 2 * np.eye(rows - n_x)
        return Reading(s.X[:, model.z], P, s.X[:, model.x], cost=-s.said.logits, probs=probs)

    return Filter(start, predict, update, read, expect=lambda s, at: model.expect(s.X[:, model.x], at))


@diagnoser("gain_net", "Augmented filter whose gain a recurrent network corrects, supervised")
def gain_net(plant: Plant, *, process: str = "standard", path: str = "") -> Diagnoser:
    """The trained network and its filter.

    Args:
        plant: A plant that there are weights for.
        process: The fault process that it is told to expect.
        path: Weights of your own; their card lies beside them.

    Raises:
        ValueError: The plant has no such process.
        NotApplicableError: No weights for this plant and its options.
        RefusedError: Weights or a card that are not what they should be.
    """
    plant.process(process)
    file, tensors, card = weights.find("gain_net", plant, path)
    stride = weights.whole_number(file, card, "stride", weights.SIZES["stride"])
    hidden = weights.whole_number(file, card, "hidden", weights.SIZES["hidden"])
    weights.check_tensors(file, tensors, tensor_shapes(plant, tensors, hidden, len(card.processes)))
    expected = card.expected(process)
    try:
        nominal = nominal_of(plant, {name: a.astype(float) for name, a in tensors.items()}, stride)
    except NotApplicableError:
        raise
    except (ValueError, IndexError) as error:
        raise weights.RefusedError(f"{file} holds no filter of {plant.id}: {error}") from error
    net = {name.removeprefix("network."): value.astype(float) for name, value in tensors.items()}
    net |= {f"{name}_l0": value for name, value in net.items() if name.startswith("memory.")}
    context = np.eye(len(card.processes))[card.processes.index(expected)]
    found = gain_filter(nominal, net, context, stride, weights.calibration_of(file, card, expected))
    best = by_candidate(lambda r, _: np.argmin(np.asarray(r.cost), axis=1), after=1)
    return diagnoser_of(plant, found, best)


@trainer("gain_net", "The network that corrects the gain, trained through the filter")
def train_gain_net(
    plant: Plant, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs"), threads: int = 1
) -> Path:  # fmt: skip
    """Train the network; the path of its weights.

    Args:
        plant: The plant.
        budget: Training flights per condition. Default: the recipe's.
        seed: Of the run; each has training seeds of its own.
        work: Folder of runs; one that was killed goes on.
        threads: Of torch.

    Raises:
        NotApplicableError: The plant's state lies on a manifold, or its processes need different options.
        ValueError: The folder holds another run.
    """
    from baselines.learned._gain import GainTraining

    return GainTraining(
        "gain_net", plant, gain_recipe(plant, budget), seed=seed, work=work / f"{weights.stem('gain_net', plant)}-{seed}",
        command=weights.command("gain_net", plant, budget, seed), threads=threads,
    ).run()  # fmt: skip
