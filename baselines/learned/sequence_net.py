"""A recurrent network over blocks of observations, and one that hears filters too: trained under supervision.

The network sees what `baselines.networks.identification` makes of the samples so far and answers at the end of each
block; the answer holds until the next. It was trained with labels of equal weight, so its most probable label is the one
that balanced accuracy asks for: that is the label it declares. The probabilities are calibrated for the process it
expects (scale, bias per label), so the most probable label may be another where a label is rare.

It is told which fault process to expect, as the filters are; one that it was not trained on it takes for the first.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from baselines.learned import network_module
from fdi_gym.diagnosis import Diagnoser, Diagnosis, NotApplicableError, diagnoser, diagnosers, make_diagnoser
from fdi_gym.plant import Array, Plant
from fdi_gym.training import trainer


@diagnoser("sequence_net", "Recurrent network on observations, supervised", method="sequence_net")
@diagnoser("residual_net", "Recurrent network that hears filters too, supervised", method="residual_net")
def sequence_net(plant: Plant, *, method: str = "sequence_net", process: str = "standard", path: str = "") -> Diagnoser:
    """The trained network.

    Args:
        plant: A plant that there are weights for.
        method: Which network: "sequence_net" or "residual_net".
        process: The fault process that it is told to expect.
        path: Weights of your own; their card lies beside them.

    Raises:
        ValueError: The plant has no such process.
        NotApplicableError: No weights for this plant and its options, or no torch.
        RefusedError: Weights or a card that are not what they should be.
    """
    weights, network, ident, flights, calibration = (
        network_module(name) for name in ("weights", "network", "identification", "flights", "calibration")
    )
    import torch

    plant.process(process)
    file = Path(path) if path else weights.WEIGHTS / f"{method}-{plant.id}.safetensors"
    if not file.exists():
        raise NotApplicableError(f"no trained weights for {plant.id}; train them: fdi-gym train {method} {plant.id}")
    try:
        tensors, card = weights.read(file, plant)
    except weights.WrongPlantError as error:
        raise NotApplicableError(str(error)) from error
    expected = process if process in card.processes else card.processes[0]
    shape, hidden = weights.shape_of(file, card)
    entries = diagnosers()
    for name in card.filters:  # never "module:function", which would be imported
        if name not in entries or entries[name].clairvoyant:
            raise weights.RefusedError(f"{file.with_suffix('.json')} names {name!r}, which is no filter that can be heard")
    inputs, processes = weights.width_of(file, tensors, "network.value.weight"), len(card.processes)
    direct = weights.width_of(file, tensors, "network.direct.weight") if "network.direct.weight" in tensors else 0
    words = (direct // processes,) if direct else ()
    size = (inputs, len(plant.labels), len(plant.estimated), hidden, words, processes)
    net = network.SequenceNetwork(*size).double()
    sizes = {f"network.{name}": tuple(value.shape) for name, value in net.state_dict().items()}
    weights.check_tensors(file, tensors, sizes | ident.shapes(plant, shape))
    net.load_state_dict({name: torch.from_numpy(tensors[f"network.{name}"]) for name in net.state_dict()})
    model = ident.Model(*(tensors[f"model.{name}"] for name in ident.Model._fields))
    context = np.eye(processes)[card.processes.index(expected)]
    fitted = weights.fitted_of(file, card, expected)
    scale, bias, prior = fitted.scale, np.array(fitted.bias), np.array(fitted.prior)
    healthy = plant.estimate_target(plant.nominal_theta, plant.trim_command)
    unit = np.array([s.scale for s in plant.estimated])
    heard = [make_diagnoser(name, plant, process=expected) for name in card.filters]

    def init(n: int) -> Any:
        said = Diagnosis(np.zeros(n, bool), np.zeros(n, np.int64), np.tile(healthy, (n, 1)), np.tile(unit, (n, 1)),
                         np.tile(prior / prior.sum(), (n, 1)))  # fmt: skip
        return 0, ident.begin(plant, shape, n), np.zeros((n, hidden)), [f.init(n) for f in heard], said

    def answer(features: Array, h: Array) -> tuple[Array, Diagnosis]:
        with torch.inference_mode():
            x = torch.from_numpy(features[:, None])
            logits, mean, log_std, memory = (a.numpy() for a in net(x, torch.from_numpy(h[None])))
        mode = logits[:, 0].argmax(axis=1)
        probs = np.exp(calibration.log_softmax(scale * logits[:, 0] + bias))
        return memory[0], Diagnosis(mode > 0, mode, healthy + unit * mean[:, 0], unit * np.exp(log_std[:, 0]), probs)

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        k, stream, h, inner, said = state
        stream, seen = ident.add(plant, shape, model, stream, obs, k)
        further = [f.update(own, obs) for f, own in zip(heard, inner, strict=True)]
        if seen is not None:
            parts = [seen, np.tile(context, (len(obs), 1)), *(flights.word(plant, word) for _, word in further)]
            h, said = answer(np.concatenate(parts, axis=1), h)
        return (k + 1, stream, h, [own for own, _ in further], said), said

    return Diagnoser(init, update)


@trainer("sequence_net", "Recurrent network on observations, supervised")
def train_sequence_net(plant_id: str, **arguments: Any) -> Path:
    """Train the network on observations."""
    return network_module("recipes").train("sequence_net", plant_id, **arguments)


@trainer("residual_net", "The network that hears filters too; starts from sequence_net")
def train_residual_net(plant_id: str, **arguments: Any) -> Path:
    """Train the network that hears filters."""
    return network_module("recipes").train("residual_net", plant_id, **arguments)
