"""Trees and MiniRocket: our predictors against their definitions, what is loaded is checked, windows as in training."""

import numpy as np
import pytest
from safetensors.numpy import load_file

from baselines.learned import classifier, minirocket, trees, weights
from baselines.learned.flights import TRAINING, VALIDATION, Condition, fly
from baselines.learned.minirocket import BIASES, DILATIONS, PAIRS, TRIPLES
from baselines.learned.recipes import sequence_recipe
from fdi_gym.diagnosis import make_diagnoser, run, train
from fdi_gym.files import RefusedError

STANDARD = Condition("standard", {})


def data(n=600, features=6, labels=4):
    rng = np.random.default_rng(0)
    x = rng.standard_normal((n, features))
    label = (x[:, 0] > 0).astype(int) + 2 * (x[:, 1] * x[:, 2] > 0)
    label[label == 2] = 3  # a label that no example has
    return x, label, rng.uniform(0.5, 2.0, n), labels


def test_boosted_trees_answer_as_scikit_learn_does():
    ensemble = pytest.importorskip("sklearn.ensemble")
    x, label, weight, labels = data()
    ours = trees.answer(trees.boosted(x, label, weight, labels, 0), labels, x)
    model = ensemble.HistGradientBoostingClassifier(
        max_iter=trees.ROUNDS, max_leaf_nodes=trees.LEAVES, learning_rate=0.15, min_samples_leaf=trees.FEWEST,
        l2_regularization=1.0, early_stopping=False, random_state=0,
    ).fit(x, label, sample_weight=weight)  # fmt: skip
    assert np.allclose(ours[:, model.classes_], model.decision_function(x), atol=1e-9)
    assert (ours[:, 2] == -20.0).all()


def test_the_forest_answers_as_scikit_learn_does():
    ensemble = pytest.importorskip("sklearn.ensemble")
    x, label, weight, labels = data()
    x = x.astype(np.float32).astype(float)
    ours = trees.answer(trees.grown(x, label, weight, labels, 0), labels, x)
    model = ensemble.RandomForestClassifier(
        n_estimators=trees.FOREST, max_leaf_nodes=trees.DEEP, min_samples_leaf=trees.FEWEST, random_state=0
    ).fit(x, label, sample_weight=weight)
    assert np.allclose(ours[:, model.classes_], model.predict_proba(x), atol=1e-9)
    assert np.allclose(ours.sum(axis=1), 1.0)


@pytest.mark.parametrize(
    "spoil",
    [
        {"left": [0.0, 1, 2]}, {"right": [0.0, 0, 0]}, {"right": [3.0, 0, 0]}, {"feature": [7.0, -1, -1]},
        {"feature": [0.5, -1, -1]}, {"roots": [3.0]}, {"target": [9.0]}, {"target": [-1.0]}, {"base": [0.0]},
    ],
    ids=str,
)  # fmt: skip
def test_what_is_no_forest_is_refused(tmp_path, spoil):
    """No way down is endless, none leaves the arrays."""
    good = {"feature": [0.0, -1, -1], "threshold": [0.5, 0, 0], "left": [1.0, 0, 0], "right": [2.0, 0, 0],
            "value": [[0.0], [1.0], [2.0]], "roots": [0.0], "target": [1.0], "base": [0.0, 0.0]}  # fmt: skip
    good = {name: np.array(value) for name, value in good.items()}
    forest = trees.checked(tmp_path, good, 7, 2)
    assert trees.answer(forest, 2, np.array([[0.0] * 7, [1.0] * 7])).tolist() == [[0.0, 1.0], [0.0, 2.0]]
    with pytest.raises(RefusedError):
        trees.checked(tmp_path, good | {name: np.array(value) for name, value in spoil.items()}, 7, 2)


def test_shares_are_those_of_the_convolutions():
    """Against numpy.convolve, for random pairs of kernel and dilation."""
    rng = np.random.default_rng(1)
    windows = rng.standard_normal((3, 64, 5))
    rocket = minirocket.drawn(windows, rng)
    found = minirocket.featurise(rocket, windows)
    x = minirocket.saturated(windows)
    for pair in rng.choice(PAIRS, 20, replace=False):
        d, k = pair // len(TRIPLES), pair % len(TRIPLES)
        kernel = np.zeros(8 * DILATIONS[d] + 1)
        kernel[:: DILATIONS[d]] = np.where(np.isin(np.arange(9), TRIPLES[k]), 2.0, -1.0)
        for i in range(3):
            together = x[i][rocket["channels"][pair] > 0].sum(axis=0)
            value = np.convolve(together, kernel[::-1])[4 * DILATIONS[d] :][:64]
            edge = 4 * DILATIONS[d] if (d + k) % 2 else 0
            value = value[edge : 64 - edge]
            expected = (value[:, None] > rocket["bias"][pair]).mean(axis=0)
            assert np.allclose(found[i, pair * BIASES : (pair + 1) * BIASES], expected)


def test_ridge_is_the_weighted_least_squares_solution():
    rng = np.random.default_rng(2)
    x, label, weight = rng.standard_normal((400, 5)), rng.integers(3, size=400), rng.uniform(0.5, 2, 400)
    rocket = minirocket.ridge(x, label, weight, 3, rng)
    z = np.concatenate([(x - rocket["mean"]) / rocket["scale"], np.ones((400, 1))], axis=1)
    target = 2.0 * np.eye(3)[label] - 1.0
    slopes = (z * weight[:, None]).T @ (z @ rocket["columns"] - target)
    penalties = -slopes / rocket["columns"] / 400
    assert np.allclose(penalties, penalties[0, 0], rtol=1e-6)
    assert np.abs(minirocket.RIDGE / penalties[0, 0] - 1).min() < 1e-6


def test_a_constant_in_all_channels_moves_the_levels_that_trees_see_and_nothing_else(b747):
    """What is seen of spread, trend and correlation is about the mean of its window."""
    w = np.random.default_rng(0).standard_normal((5, max(trees.LENGTHS), len(b747.observed)))
    moved = trees.featurise(b747, w + 3.0) - trees.featurise(b747, w)
    levels = len(b747.observed) * (1 + len(trees.LENGTHS))
    assert np.allclose(np.sort(moved, axis=1)[:, -levels:], 3.0)
    assert np.allclose(np.sort(moved, axis=1)[:, :-levels], 0.0)


def test_a_stream_is_seen_as_in_training(b747):
    """The features at the end of a stream are those of the last window of the recorded flight."""
    recipe = sequence_recipe(b747)
    stride = recipe.shape.stride
    seed = VALIDATION + 72_000
    record = fly(b747, STANDARD, [seed])
    last = record.obs.shape[1] // stride * stride
    seen = []

    def featurise(window):
        seen.append(window.copy())
        return np.zeros((len(window), 1))

    card = weights.read_card(weights.WEIGHTS / "boosted_trees-B747Lateral.safetensors")
    from fdi_gym.estimation.calibration import Calibration

    d = classifier.classifier(
        b747, Calibration(), weights.WEIGHTS / "boosted_trees-B747Lateral.safetensors", card, "standard", featurise,
        lambda x: np.zeros((len(x), 5)),
    )  # fmt: skip
    run(d, record.obs[:, :last])
    e, share = classifier.examples([b747, b747], recipe, 0, [seed], last, [0])
    assert share.sum() == pytest.approx(1.0)
    shown = np.array(seen)[:, 0].astype(np.float32)
    for window in e.windows:
        assert np.isclose(shown, window, atol=1e-5).all(axis=(1, 2)).any()


@pytest.mark.parametrize("method", ["boosted_trees", "random_forest", "minirocket"])
def test_training_is_reproducible_and_its_weights_run(method, b747, tmp_path, monkeypatch):
    if method != "minirocket":
        pytest.importorskip("sklearn")
    monkeypatch.setattr(classifier, "EXAMPLES", 400)
    monkeypatch.setattr(classifier, "CHECKED", 4)
    one, two = (train(method, b747, budget=6, work=tmp_path / name) for name in "ab")
    assert one.read_bytes() == two.read_bytes()
    card = weights.read_card(one)
    assert card.seeds["training"][0] == TRAINING
    assert set(card.calibration) == {"standard", "hard"}
    said = run(make_diagnoser(method, b747, path=str(one)), fly(b747, STANDARD, [VALIDATION + 70_020]).obs[:, :150])
    assert np.allclose(said.label_probs.sum(axis=2), 1.0)
    tensors = load_file(one)
    name = sorted(tensors)[0]
    weights.write(one, {**tensors, name: tensors[name][:-1]}, card)
    with pytest.raises(RefusedError):
        make_diagnoser(method, b747, path=str(one))
