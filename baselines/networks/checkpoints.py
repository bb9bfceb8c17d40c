"""Checkpoints of training runs: tensors, the optimiser's moments, and what the run needs to know to go on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.numpy import save

from baselines.networks import weights
from fdi_gym.files import write_whole
from fdi_gym.plant import Array, Plant

MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # of Adam


def identity(method: str, plant: Plant, seed: int, recipe: Any) -> str:
    """What a checkpoint must share with the run that goes on from it."""
    return json.dumps({"method": method, "plant": plant.env_id, "seed": seed, **asdict(recipe)})


def write(path: Path, run: str, tensors: Mapping[str, Any], optimiser: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Write a checkpoint whole: tensors of torch or NumPy, Adam's moments, and a state that JSON can say."""
    found = dict(tensors)
    for i, moments in optimiser.state_dict()["state"].items():
        found |= {f"adam.{i}.{name}": value for name, value in moments.items()}
    plain = {name: a.cpu().numpy() if isinstance(a, torch.Tensor) else a for name, a in found.items()}
    content = {name: np.asarray(a, order="C") for name, a in plain.items()}
    write_whole(path, save(content, metadata={"state": json.dumps({**state, "run": run})}))


def read(path: Path, run: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """Tensors and state of a checkpoint.

    Raises:
        ValueError: It is of another run.
    """
    tensors = weights.read_tensors(path)
    with safe_open(path, "np") as file:
        state = json.loads(file.metadata()["state"])
    if state.pop("run") != run:
        raise ValueError(f"{path} is of a run with another recipe or seed; move it away to begin a new one")
    return tensors, state


def restore(module: torch.nn.Module, prefix: str, optimiser: torch.optim.Optimizer, tensors: Mapping[str, Array]) -> None:
    """Give a module and its optimiser what a checkpoint holds of them."""
    module.load_state_dict({name: torch.from_numpy(tensors[f"{prefix}.{name}"]) for name in module.state_dict()})
    adam = optimiser.state_dict()
    adam["state"] = {
        i: {name: torch.from_numpy(tensors[f"adam.{i}.{name}"]) for name in MOMENTS}
        for i in adam["param_groups"][0]["params"]
    }
    optimiser.load_state_dict(adam)
