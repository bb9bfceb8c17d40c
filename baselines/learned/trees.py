"""Gradient-boosted trees and a random forest on windows of the channels.

Of each window of blocks the trees see, over several lengths, mean, standard deviation and trend of every channel and the
covariances of commands with outputs, and the newest block. scikit-learn grows them [1, 2]; they are stored as plain arrays
and run by a kernel of our own, so that nothing that is loaded can run code.

[1] J. H. Friedman, Annals of Statistics 29(5), 2001. [2] L. Breiman, Machine Learning 45, 2001.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from baselines.learned import classifier, weights
from baselines.learned.classifier import LENGTH, Examples, Learned
from baselines.learned.recipes import sequence_recipe
from baselines.learned.tree_kernels import descend
from fdi_gym.diagnosis import Diagnoser, diagnoser, trainer
from fdi_gym.estimation.calibration import Calibration
from fdi_gym.files import RefusedError
from fdi_gym.model import contiguous
from fdi_gym.plant import Array, Plant

LENGTHS = (4, 16, LENGTH)  # blocks
ROUNDS, LEAVES = 40, 15  # of boosting: trees per label, leaves of each
FOREST, DEEP, FEWEST = 40, 128, 20  # of the forest: trees, leaves, examples in a leaf
FIELDS = ("feature", "threshold", "left", "right", "value", "roots", "target", "base")


def featurise(plant: Plant, windows: Array) -> Array:
    """What the trees see of windows (n, L, n_obs): (n, F)."""
    w = windows.astype(float)
    n_y, n_u = len(plant.outputs), len(plant.commands)
    found = [w[:, 0]]
    for length in LENGTHS:
        part = w[:, :length]
        mean = part.mean(axis=1)
        off = part - mean[:, None]
        ramp = np.linspace(1.0, -1.0, length)
        joint = np.swapaxes(off[..., :n_y], 1, 2) @ off[..., n_y : n_y + n_u] / length
        found += [mean, np.sqrt((off**2).mean(axis=1)), (ramp @ off) / (ramp @ ramp), joint.reshape(len(w), -1)]
    return np.concatenate(found, axis=1)


def width(plant: Plant, processes: int) -> int:
    """Features of a window, and of the process."""
    n = len(plant.observed)
    return n + len(LENGTHS) * (3 * n + len(plant.outputs) * len(plant.commands)) + processes


def answer(forest: Mapping[str, Array], labels: int, x: Array) -> Array:
    """The sum of what all trees say (n, labels)."""
    out = np.tile(forest["base"], (len(x), 1))
    whole = {name: forest[name].astype(np.int64) for name in ("feature", "left", "right", "roots", "target")}
    descend(
        contiguous(x), whole["feature"], forest["threshold"], whole["left"], whole["right"], forest["value"], whole["roots"],
        whole["target"], out,
    )  # fmt: skip
    return out


def logits(method: str, forest: Mapping[str, Array], labels: int, x: Array) -> Array:
    """A forest's shares as log odds; boosting adds them up itself."""
    found = answer(forest, labels, x)
    return found if method == "boosted_trees" else np.log(np.maximum(found, 1e-3))


def flattened(trees: list[tuple[Array, Array, Array, Array, Array, int]], base: Array) -> dict[str, Array]:
    """Trees (feature, threshold, left, right, value (nodes, w), target) in arrays, one after the other."""
    offsets = np.cumsum([0, *(len(t[0]) for t in trees)])[:-1]
    parts = [
        (f, th, np.where(f >= 0, le + o, 0), np.where(f >= 0, r + o, 0), v)
        for (f, th, le, r, v, _), o in zip(trees, offsets, strict=True)
    ]
    arrays = [np.concatenate(a).astype(float) for a in zip(*parts, strict=True)]
    return dict(zip(FIELDS, [*arrays, offsets.astype(float), np.array([t[-1] for t in trees], float), base], strict=True))


def boosted(x: Array, label: Array, weight: Array, labels: int, seed: int) -> dict[str, Array]:
    """Gradient-boosted trees, one per label and round."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    model = HistGradientBoostingClassifier(
        max_iter=ROUNDS, max_leaf_nodes=LEAVES, learning_rate=0.15, min_samples_leaf=FEWEST, l2_regularization=1.0,
        early_stopping=False, random_state=seed,  # pyright: ignore[reportArgumentType]
    ).fit(x, label, sample_weight=weight)  # fmt: skip
    trees = []
    for stage in model._predictors:
        for c, predictor in enumerate(stage):
            node = predictor.nodes
            leaf = node["is_leaf"].astype(bool)
            feature = np.where(leaf, -1, node["feature_idx"].astype(np.int64))
            trees.append((feature, np.where(leaf, 0.0, node["num_threshold"]), node["left"].astype(np.int64),
                          node["right"].astype(np.int64), node["value"][:, None], int(model.classes_[c])))  # fmt: skip
    base = np.full(labels, -20.0)
    base[model.classes_] = np.ravel(model._baseline_prediction)
    return flattened(trees, base)


def grown(x: Array, label: Array, weight: Array, labels: int, seed: int) -> dict[str, Array]:
    """A random forest."""
    from sklearn.ensemble import RandomForestClassifier

    model = RandomForestClassifier(n_estimators=FOREST, max_leaf_nodes=DEEP, min_samples_leaf=FEWEST, random_state=seed).fit(
        x.astype(np.float32), label, sample_weight=weight
    )
    trees = []
    for tree in (e.tree_ for e in model.estimators_):
        value = np.zeros((tree.node_count, labels))
        share = tree.value[:, 0]
        value[:, model.classes_] = share / share.sum(axis=1, keepdims=True) / FOREST
        feature = np.where(tree.children_left < 0, -1, tree.feature)
        trees.append(
            (feature, np.where(feature < 0, 0.0, tree.threshold), tree.children_left, tree.children_right, value, -1)
        )
    return flattened(trees, np.zeros(labels))


@trainer("boosted_trees", "Gradient-boosted trees on windows", method="boosted_trees")
@trainer("random_forest", "Random forest on windows", method="random_forest")
def train_trees(
    plant: Plant, *, budget: int | None = None, seed: int = 0, work: Path = Path("runs"), method: str = "boosted_trees"
) -> Path:
    """Grow the trees; the path of their weights.

    Args:
        plant: The plant.
        budget: Training flights per condition. Default: those of the network.
        seed: Of the run; each has training seeds of its own.
        work: Folder of runs.
        method: "boosted_trees" or "random_forest".
    """
    recipe, labels = sequence_recipe(plant, budget), len(plant.labels)

    def learn(e: Examples, weight: Array, rng: np.random.Generator) -> Learned:
        x = classifier.with_process(featurise(plant, e.windows), e.process, len(recipe.conditions))
        make = boosted if method == "boosted_trees" else grown
        forest = make(x, e.label, weight, labels, int(rng.integers(2**31)))
        return Learned(forest, lambda w: featurise(plant, w), lambda x: logits(method, forest, labels, x))

    shape = {"lengths": list(LENGTHS)}
    return classifier.train(method, plant, recipe, seed, work, learn, shape, weights.command(method, plant, budget, seed))


def checked(path: Path, forest: dict[str, Array], features: int, labels: int) -> dict[str, Array]:
    """A stored forest, in which every way down ends in a leaf.

    Raises:
        RefusedError: It is none.
    """
    nodes, trees = forest.get("feature", np.zeros(0)).size, forest.get("roots", np.zeros(0)).size
    wide = forest.get("value", np.zeros((0, 0))).shape[-1]
    weights.check_tensors(path, forest, {
        **dict.fromkeys(("feature", "threshold", "left", "right"), (nodes,)), "value": (nodes, wide),
        "roots": (trees,), "target": (trees,), "base": (labels,),
    })  # fmt: skip
    f = {name: value.astype(float) for name, value in forest.items()}
    inner = f["feature"] >= 0
    here = np.arange(nodes)
    fine = all((f[name] == np.round(f[name])).all() for name in ("feature", "left", "right", "roots", "target"))
    fine &= bool(((f["feature"] >= -1) & (f["feature"] < features)).all())
    for side in ("left", "right"):  # children come after their parent: no way is endless
        fine &= bool(((f[side] > here) & (f[side] < nodes))[inner].all())
    fine &= bool(((f["roots"] >= 0) & (f["roots"] < nodes)).all() and ((f["target"] >= -1) & (f["target"] < labels)).all())
    fine &= wide >= 1 and (wide == labels or not (f["target"] < 0).any())
    if not fine:
        raise RefusedError(f"{path} holds no trees: a node, a feature or a label that is not there")
    return {name: contiguous(value) for name, value in f.items()}


@diagnoser("boosted_trees", "Gradient-boosted trees on windows of the channels", sensors=True, method="boosted_trees")
@diagnoser("random_forest", "Random forest on windows of the channels", sensors=True, method="random_forest")
def trees(
    plant: Plant, calibration: Calibration, *, method: str = "boosted_trees", process: str = "standard", path: str = ""
) -> Diagnoser:
    """The trees with their decision.

    Args:
        plant: A plant that there are weights for.
        calibration: When it alarms.
        method: "boosted_trees" or "random_forest".
        process: The fault process that it is told to expect.
        path: Weights of your own; their card lies beside them.

    Raises:
        ValueError: The plant has no such process.
        NotApplicableError: No weights for this plant and its options.
        RefusedError: Weights or a card that are not what they should be.
    """
    plant.process(process)
    file, tensors, card = weights.find(method, plant, path)
    labels = len(plant.labels)
    forest = checked(file, tensors, width(plant, len(card.processes)), labels)

    def score(x: Array) -> Any:
        return logits(method, forest, labels, x)

    return classifier.classifier(plant, calibration, file, card, process, lambda w: featurise(plant, w), score)
