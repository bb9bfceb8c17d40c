"""MiniRocket: fixed convolutions of windows of the channels, the share of their values above a bias, a ridge classifier.

84 kernels of nine weights, six of -1 and three of 2, at several dilations, each over a random subset of the channels; the
biases are quantiles of the convolutions of training windows [1]. What is learned is linear: ridge regression of one column
per label, each example weighted so that labels count alike; its penalty is chosen on held-out training examples.

[1] A. Dempster, D. F. Schmidt, G. I. Webb, MiniRocket, Proceedings of KDD 2021; the multivariate form of the authors' code.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from baselines.learned import classifier, weights
from baselines.learned.classifier import Examples, Learned
from baselines.learned.minirocket_kernels import WEIGHTS, transform, values
from baselines.learned.recipes import sequence_recipe
from fdi_gym.diagnosis import Diagnoser, diagnoser, trainer
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.files import RefusedError
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant

TRIPLES = np.array(list(itertools.combinations(range(WEIGHTS), 3)))  # (84, 3)
DILATIONS = np.array([1, 2, 4, 7])  # the longest kernel spans 57 of 64 blocks
BIASES = 3  # of each kernel and dilation: about a thousand features
PAIRS = len(TRIPLES) * len(DILATIONS)
FEATURES = PAIRS * BIASES
SAMPLES = 60  # training windows whose convolutions give the biases
KNEE = 8.0  # channels saturate smoothly here, in units of their scale: one flight that diverges teaches nothing
RIDGE = 10.0 ** np.arange(-3, 4)  # penalties that are tried, per example
HELD_OUT = 0.2  # share of the examples that choose


def saturated(windows: Array) -> Array:
    """Windows (n, L, n_obs) as the kernels see them: (n, n_obs, L)."""
    return contiguous(KNEE * np.tanh(np.swapaxes(np.asarray(windows, float), 1, 2) / KNEE))


def featurise(rocket: Mapping[str, Array], windows: Array) -> Array:
    """Shares of windows (n, L, n_obs), the newest block first: (n, FEATURES)."""
    out = np.empty((len(windows), FEATURES))
    transform(
        saturated(windows),
        DILATIONS,
        TRIPLES,
        np.ascontiguousarray(rocket["channels"] > 0.5),
        contiguous(rocket["bias"]),
        out,
    )
    return out


def drawn(windows: Array, rng: np.random.Generator) -> dict[str, Array]:
    """The channels of each pair of kernel and dilation, and its biases."""
    many = windows.shape[2]
    channels = np.zeros((PAIRS, many), bool)
    for row in channels:
        size = int(2 ** rng.uniform(0.0, np.log2(min(many, WEIGHTS) + 1)))
        row[rng.choice(many, size, replace=False)] = True
    some = saturated(windows[rng.choice(len(windows), min(SAMPLES, len(windows)), replace=False)])
    found = np.empty((len(some), PAIRS, some.shape[2]))
    values(some, DILATIONS, TRIPLES, channels, found)
    golden = (np.arange(1, PAIRS * BIASES + 1) * (np.sqrt(5.0) + 1) / 2 % 1.0).reshape(PAIRS, BIASES)
    which = rng.integers(len(some), size=PAIRS)
    bias = np.stack([np.quantile(found[which[i], i], golden[i]) for i in range(PAIRS)])
    return {"channels": channels.astype(float), "bias": bias}


def ridge(x: Array, label: Array, weight: Array, labels: int, rng: np.random.Generator) -> dict[str, Array]:
    """Mean and scale of the features, and the columns of the regression."""
    mean, scale = x.mean(axis=0), x.std(axis=0) + 1e-3
    z = np.concatenate([(x - mean) / scale, np.ones((len(x), 1))], axis=1)
    target = 2.0 * np.eye(labels)[label] - 1.0
    test = rng.random(len(x)) < HELD_OUT
    joint = [
        ((z[part] * weight[part, None]).T @ z[part], (z[part] * weight[part, None]).T @ target[part])
        for part in (~test, test)
    ]

    def solved(A: Array, b: Array, penalty: float, count: int) -> Array:
        return np.linalg.solve(A + penalty * count * np.eye(len(A)), b)

    def right(B: Array) -> float:
        hit = (z[test] @ B).argmax(axis=1) == label[test]
        return float((hit * weight[test]).sum())

    best = max(RIDGE, key=lambda penalty: right(solved(*joint[0], penalty, int((~test).sum()))))
    B = solved(joint[0][0] + joint[1][0], joint[0][1] + joint[1][1], best, len(x))
    return {"mean": mean, "scale": scale, "columns": B}


def score(rocket: Mapping[str, Array], x: Array) -> Array:
    """What the regression gives each label (n, labels)."""
    return ((x - rocket["mean"]) / rocket["scale"]) @ rocket["columns"][:-1] + rocket["columns"][-1]


@trainer("minirocket", "MiniRocket and a ridge classifier")
def train_minirocket(plant: Plant, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs")) -> Path:
    """Draw the kernels, and fit the classifier; the path of their weights.

    Args:
        plant: The plant.
        budget: Training flights per condition. Default: those of the network.
        seed: Of the run; each has training seeds of its own.
        work: Folder of runs.
    """
    recipe, labels = sequence_recipe(plant, budget), len(plant.labels)

    def learn(e: Examples, weight: Array, rng: np.random.Generator) -> Learned:
        rocket = drawn(e.windows, rng)
        x = classifier.with_process(featurise(rocket, e.windows), e.process, len(recipe.conditions))
        rocket |= ridge(x, e.label, weight, labels, rng)
        return Learned(rocket, lambda w: featurise(rocket, w), lambda x: score(rocket, x))

    shape = {"dilations": DILATIONS.tolist(), "biases": BIASES}
    command = weights.command("minirocket", plant, budget, seed)
    return classifier.train("minirocket", plant, recipe, seed, work, learn, shape, command)


@diagnoser("minirocket", "MiniRocket on windows of the channels, ridge classifier", sensors=True)
def minirocket(plant: Plant, calibration: Calibration, *, process: str = "standard", path: str = "") -> Diagnoser:
    """The classifier with its decision.

    Args:
        plant: A plant that there are weights for.
        calibration: When it alarms.
        process: The fault process that it is told to expect.
        path: Weights of your own; their card lies beside them.

    Raises:
        ValueError: The plant has no such process.
        NotApplicableError: No weights for this plant and its options.
        RefusedError: Weights or a card that are not what they should be.
    """
    plant.process(process)
    file, tensors, card = weights.find("minirocket", plant, path)
    wide = FEATURES + len(card.processes)
    weights.check_tensors(file, tensors, {
        "channels": (PAIRS, len(plant.observed)), "bias": (PAIRS, BIASES), "mean": (wide,), "scale": (wide,),
        "columns": (wide + 1, len(plant.labels)),
    })  # fmt: skip
    rocket = {name: value.astype(float) for name, value in tensors.items()}
    if not (rocket["scale"] > 0).all():
        raise RefusedError(f"{file}: a scale is above 0")
    return classifier.classifier(
        plant, calibration, file, card, process, lambda w: featurise(rocket, w), lambda x: score(rocket, x)
    )
