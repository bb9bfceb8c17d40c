"""Networks over steps of several samples, one that is shown filters too: trained under supervision.

Its memory is recurrent, or attends to the last steps (`baselines.learned.attention`).

The network sees what `baselines.learned.features` makes of the samples so far and answers at the end of each step; the
answer holds until the next. It was trained with labels of equal weight, so its most probable label is the one that balanced
accuracy asks for: that is the label it declares. The probabilities are calibrated for the process it expects (scale, bias
per label), so the most probable label may be another where a label is rare.

It is told which fault process to expect, as the filters are, and whether samples will be missing; a process that it was not
trained on it takes for the first. It runs on NumPy; torch trains it (`baselines.learned._supervised`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from baselines.learned import attention, streams, weights
from baselines.learned import features as feat
from baselines.learned.flights import filter_features, shown_filter, told_by
from baselines.learned.probabilities import log_softmax
from baselines.learned.recipes import attention_recipe, network_recipe, randomised_recipe, residual_recipe
from fdi_gym.diagnosis import Diagnoser, Diagnosis, diagnoser, diagnosers, trainer
from fdi_gym.plant import Array, Plant

ATTENTION = "attention_net"
RECIPES = {
    "sequence_net": network_recipe, "residual_net": residual_recipe, "randomised_net": randomised_recipe,
    ATTENTION: attention_recipe,
}  # fmt: skip
REACH = 10.0  # trust in filters is learned so many times faster than the rest: it must rise and fall by several logits
LOG_STD = (-6.0, 3.0)  # bounds of the estimate's log standard deviation


@diagnoser("sequence_net", "Recurrent network on observations, supervised", sensors=True, method="sequence_net")
@diagnoser("residual_net", "Recurrent network that is shown filters too, supervised", sensors=True, method="residual_net")
@diagnoser("randomised_net", "Recurrent network trained on plants off the model", sensors=True, method="randomised_net")
@diagnoser(ATTENTION, "Network that attends to the last steps, supervised", sensors=True, method=ATTENTION)
def sequence_net(plant: Plant, *, method: str = "sequence_net", process: str = "standard", path: str = "") -> Diagnoser:
    """The trained network.

    Args:
        plant: A plant that there are weights for.
        method: Which network: "sequence_net", "residual_net", "randomised_net" or "attention_net".
        process: The fault process that it is told to expect.
        path: Weights of your own; their card lies beside them.

    Raises:
        ValueError: The plant has no such process.
        NotApplicableError: No weights for this plant and its options.
        RefusedError: Weights or a card that are not what they should be.
    """
    plant.process(process)
    file, tensors, card = weights.find(method, plant, path)
    expected = card.expected(process)
    shape, hidden = weights.shape_of(file, card)
    entries = diagnosers()
    for name in card.filters:  # never "module:function", which would be imported
        if name not in entries or entries[name].clairvoyant:
            raise weights.RefusedError(f"{file.with_suffix('.json')} names {name!r}, which is no filter that can be shown")
    filters = [shown_filter(name, plant, expected, card.processes) for name in card.filters]
    told = told_by(plant, filters)
    weights.check_tensors(file, tensors, tensor_shapes(plant, shape, hidden, told, len(card.processes), method))
    model = weights.model_of(tensors)
    net = {name.removeprefix("network."): value.astype(float) for name, value in tensors.items()}
    condition = card.condition(plant, expected)
    context = np.eye(len(card.processes))[card.processes.index(condition)]
    calibration = weights.calibration_of(file, card, condition)
    scale, bias, prior = calibration.scale, np.array(calibration.bias), np.array(calibration.prior)
    healthy = plant.healthy
    unit = np.array([s.scale for s in plant.estimated])

    def init(n: int) -> Any:
        first = Diagnosis(np.zeros(n, bool), np.zeros(n, np.int64), np.tile(healthy, (n, 1)), np.tile(unit, (n, 1)),
                          np.tile(prior / prior.sum(), (n, 1)))  # fmt: skip
        h = attention.begin(n, hidden) if method == ATTENTION else np.zeros((n, hidden))
        return 0, streams.begin(plant, shape, n), h, [f.init(n) for f in filters], first

    def answer(x: Array, h: Any) -> tuple[Any, Diagnosis]:
        logits, mean, log_std, h = forward(net, x, h, len(plant.labels), len(context))
        label = logits.argmax(axis=1)
        probs = np.exp(log_softmax(scale * logits + bias))
        return h, Diagnosis(label > 0, label, healthy + unit * mean, unit * np.exp(log_std), probs)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, stream, h, inner, diagnosis = state
        stream, features = streams.add(plant, shape, model, stream, obs, k)
        further = [f.update(own, obs) for f, own in zip(filters, inner, strict=True)]
        if features is not None:
            parts = [features, np.tile(context, (len(obs), 1)), *(filter_features(plant, own) for _, own in further)]
            h, diagnosis = answer(np.concatenate(parts, axis=1), h)
        return (k + 1, stream, h, [own for own, _ in further], diagnosis), diagnosis

    return Diagnoser(init, update, gaps=(shape.linear or shape.shares) and all(f.gaps for f in filters))


@trainer("sequence_net", "Recurrent network on observations, supervised")
@trainer("residual_net", "The network that is shown filters too; starts from sequence_net", method="residual_net")
@trainer("randomised_net", "The network on plants off the model, each flight another", method="randomised_net")
@trainer(ATTENTION, "The network that attends to the last steps", method=ATTENTION)
def train_sequence_net(
    plant: Plant, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs"), threads: int = 1,
    method: str = "sequence_net",
) -> Path:  # fmt: skip
    """Train the network; the path of its weights.

    Args:
        plant: The plant.
        budget: Training flights per condition. Default: the recipe's.
        seed: Of the run; each has training seeds of its own.
        work: Folder of runs; one that was killed goes on. "residual_net" starts from the weights of "sequence_net" there,
            or else from those that ship.
        threads: Of torch.
        method: "sequence_net", "residual_net", "randomised_net" or "attention_net".

    Raises:
        NotApplicableError: The plant has no mismatch, and randomised_net needs it.
        ValueError: There is no network to start from, or the folder holds another run.
    """
    from baselines.learned._supervised import SupervisedTraining

    recipe = RECIPES[method](plant, budget)
    name = weights.stem("sequence_net", plant)
    file = f"{name}.safetensors"
    own = work / f"{name}-{seed}" / file
    return SupervisedTraining(
        method, plant, recipe, seed=seed, work=work / f"{weights.stem(method, plant)}-{seed}",
        base=own if own.exists() else weights.WEIGHTS / file, command=weights.command(method, plant, budget, seed),
        threads=threads,
    ).run()  # fmt: skip


def tensor_shapes(
    plant: Plant, shape: feat.FeatureShape, hidden: int, told: int, processes: int, method: str = "sequence_net"
) -> dict[str, tuple[int, ...]]:  # fmt: skip
    """The shapes of all arrays of a stored network, `told` entries by filters: the network's and the model's."""
    model = feat.tensor_shapes(plant, shape)
    inputs, labels = model["model.mean"][0] + processes + told, len(plant.labels)
    layers = {
        "value": (hidden, inputs), "gate": (hidden, inputs), "join": (hidden, inputs + hidden), "read": (hidden, hidden),
        "heads": (labels + 2 * len(plant.estimated), hidden),
    }  # fmt: skip
    found = {f"network.{name}.weight": size for name, size in layers.items()}
    found |= {f"network.{name}.bias": size[:1] for name, size in layers.items()}
    if method == ATTENTION:
        found |= {f"network.memory.{name}": size for name, size in attention.tensor_shapes(hidden).items()}
    else:
        for end in ("ih", "hh"):
            found[f"network.memory.weight_{end}_l0"] = (3 * hidden, hidden)
            found[f"network.memory.bias_{end}_l0"] = (3 * hidden,)
    if told:
        found["network.direct.weight"] = (labels, processes * told)
    return found | model


def _sigmoid(x: Array) -> Array:
    return 0.5 + 0.5 * np.tanh(0.5 * x)


def recur(net: Mapping[str, Array], x: Array, h: Array) -> Array:
    """The memory (n, hidden) of a gated recurrent unit after a step x (n, hidden)."""
    reset, keep, new = np.split(x @ net["memory.weight_ih_l0"].T + net["memory.bias_ih_l0"], 3, axis=1)
    reset_h, keep_h, new_h = np.split(h @ net["memory.weight_hh_l0"].T + net["memory.bias_hh_l0"], 3, axis=1)
    keep = _sigmoid(keep + keep_h)
    return (1 - keep) * np.tanh(new + _sigmoid(reset + reset_h) * new_h) + keep * h


def forward(
    net: Mapping[str, Array], x: Array, h: Any, labels: int, processes: int
) -> tuple[Array, Array, Array, Any]:  # fmt: skip
    """One step of the network that `_network.SequenceNetwork` trains.

    Args:
        net: Its tensors.
        x: Features (n, inputs): those of the model, the process (n, processes), and those of filters.
        h: Memory (n, hidden), or an `attention.Recent`.
        labels: Labels of the plant.
        processes: Fault processes that it knows.

    Returns:
        logits (n, labels), mean and log standard deviation of the deviation (n, n_estimated), memory
    """

    def linear(name: str, a: Array) -> Array:
        return a @ net[f"{name}.weight"].T + net[f"{name}.bias"]

    product = linear("value", x) * np.tanh(linear("gate", x))
    joined = linear("join", np.concatenate([x, product], axis=1))
    seen = joined * _sigmoid(joined)
    if isinstance(h, attention.Recent):
        own = {name.removeprefix("memory."): value for name, value in net.items() if name.startswith("memory.")}
        remembered, h = attention.step(own, seen, h)
    else:
        remembered = h = recur(net, seen, h)
    read = linear("read", seen + remembered)
    out = linear("heads", read * _sigmoid(read))
    logits, (mean, log_std) = out[:, :labels], np.split(out[:, labels:], 2, axis=1)
    if "direct.weight" in net:
        told = net["direct.weight"].shape[1] // processes
        process, filters = x[:, -told - processes : -told], x[:, -told:]
        logits = logits + REACH * (process[:, :, None] * filters[:, None]).reshape(len(x), -1) @ net["direct.weight"].T
    return logits, mean, np.clip(log_std, *LOG_STD), h
