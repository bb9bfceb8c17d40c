"""Learned diagnosers: a stream is seen as in training, runs resume exactly, weights are checked, splits are disjoint."""

import dataclasses
import hashlib
import itertools
import json
import pickle
import sys
import zipfile

import numpy as np
import pytest
import torch
from conftest import build
from safetensors.numpy import load_file, save_file

from baselines.networks import calibration, flights, identification, recipes, weights
from baselines.networks.flights import CALIBRATION, TEST, TRAINING, VALIDATION, Source
from baselines.networks.identification import Shape
from baselines.networks.network import SequenceNetwork, loss
from baselines.networks.supervised import Recipe, Run
from fdi_gym.diagnosis import NotApplicableError, make_diagnoser, run
from fdi_gym.plant import load_plant
from fdi_gym.suite import load_suite, suite_names
from fdi_gym.testing import check_diagnoser
from fdi_gym.training import find_trainer, trainers

TINY = Recipe(
    sources=(Source("standard", {}), Source("hard", {})), shape=Shape(20, 3, 1), flights=16, identify=8, chunk=8, passes=2,
    validation=4, validate=1, batch=8, hidden=16,
)  # fmt: skip
COMMITTED = sorted(weights.WEIGHTS.glob("*.safetensors"))
NETWORKS = [path for path in COMMITTED if "_net-" in path.stem]


def trained(folder, recipe=TINY, plant="B747Lateral", **arguments):
    return Run("sequence_net", plant, recipe, seed=1, work=folder).run(**arguments)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("run"))


# ---------------------------------------------------------------------------------------------------------------
# The network sees a stream as it saw whole flights


@pytest.mark.parametrize("shape", [Shape(4, 3, 1), Shape(5, 2, 2, 2, 3)], ids=["linear", "products"])
@pytest.mark.parametrize("plant_id", ["B747Lateral", "MissilePitch"])
def test_features_of_a_stream_are_those_of_the_whole_flight(plant_id, shape):
    plant = build(plant_id)
    record = flights.fly(plant, Source("standard", {}), range(TRAINING, TRAINING + 4))
    z = identification.blocks(plant, record.obs, shape.stride)
    delta = flights.at_steps(identification.deviation(plant, record.target), shape.stride)[:, : z.shape[1]]
    model = identification.identify(plant, shape, [(z, delta)])
    model = identification.standardised(plant, shape, model, z)
    assert {f"model.{k}": a.shape for k, a in model._asdict().items()} == identification.shapes(plant, shape)
    whole = identification.features(plant, shape, model, z)
    stream, seen = identification.begin(plant, shape, 4), []
    for k in range(record.obs.shape[1]):
        stream, features = identification.add(plant, shape, model, stream, record.obs[:, k], k)
        seen += [] if features is None else [features]
    assert np.allclose(np.stack(seen, axis=1), whole, atol=1e-5)


def test_identified_residuals_are_white_where_the_plant_is_linear_and_healthy():
    plant, shape = build("B747Lateral"), Shape(1, 20, 1)
    record = flights.fly(plant, Source("fault-free", {}), range(TRAINING, TRAINING + 40))
    z = identification.blocks(plant, record.obs, 1)
    model = identification.identify(plant, shape, [(z, np.zeros((*z.shape[:2], 4)))])
    phi, psi = identification._sequences(plant, shape, z)
    e, _, _ = identification.information(model, phi, psi, z[:, 20:, 0, :4])
    assert np.allclose(np.cov(e.reshape(-1, 4).T), np.eye(4), atol=0.05)
    assert abs(np.mean(e[:, 1:] * e[:, :-1])) < 0.02


@pytest.mark.parametrize("path", NETWORKS, ids=lambda p: p.stem)
def test_streamed_diagnoses_are_those_of_the_whole_sequence(path):
    card = weights.read_card(path)
    source = Source(card.processes[0], card.options[0])
    plant = load_plant(card.plant, **card.options[0])
    tensors, card = weights.read(path, plant)
    shape = Shape(**{name: card.shape[name] for name in Shape._fields if name in card.shape})
    model = identification.Model(*(tensors[f"model.{name}"] for name in identification.Model._fields))
    record = flights.fly(plant, source, range(VALIDATION, VALIDATION + 3))
    obs = record.obs[:, : 30 * shape.period + 3]
    seen = [identification.features(plant, shape, model, identification.blocks(plant, obs, shape.stride))]
    seen.append(flights.context(np.zeros(3, int), len(card.processes), 30))
    heard = flights.words(card.plant, source, card.filters, obs, shape.period)
    x = torch.from_numpy(np.concatenate([*seen, *heard], axis=2)).double()
    widths = tuple(word.shape[2] for word in heard)
    size = (x.shape[2], len(plant.labels), len(plant.estimated), card.shape["hidden"], widths, len(card.processes))
    net = SequenceNetwork(*size).double()
    net.load_state_dict({name: torch.from_numpy(tensors[f"network.{name}"]) for name in net.state_dict()})
    with torch.inference_mode():
        logits, mean, log_std, _ = (a.numpy() for a in net(x))
    said = run(make_diagnoser(path.stem.split("-")[0], plant), obs)
    fitted = card.calibration[card.processes[0]]
    probs = np.exp(calibration.log_softmax(fitted.scale * logits + np.array(fitted.bias)))
    at = slice(shape.period - 1, None, shape.period)
    unit = np.array([s.scale for s in plant.estimated])
    assert np.allclose(said.label_probs[:, at], probs, atol=1e-5)
    assert np.allclose(identification.deviation(plant, said.estimate[:, at]), mean, atol=1e-5)
    assert np.allclose(said.estimate_std[:, at] / unit, np.exp(log_std), rtol=1e-5)
    assert np.array_equal(said.label[:, at], logits.argmax(axis=2))


# ---------------------------------------------------------------------------------------------------------------
# Training


def test_loss_falls_on_a_fixed_batch():
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    net = SequenceNetwork(6, 3, 2, 16)
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-2)
    x = torch.from_numpy(rng.standard_normal((8, 20, 6)).astype(np.float32))
    label, delta = (x[..., 0].cumsum(dim=1) > 0).long(), x[..., 1:3].cumsum(dim=1) / 5
    values = []
    for _ in range(60):
        value = loss(net(x), label, delta, torch.ones(8, 20), share=0.1)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        values.append(float(value.detach()))
    assert values[-1] < 0.4 * values[0]


def test_an_untrained_network_believes_the_filters_it_hears():
    torch.manual_seed(0)
    net = SequenceNetwork(8 + 2 + 4 + 6, 3, 2, 16, words=(4, 6), processes=2)
    x = torch.zeros(2, 5, 20)
    x[0, :, 8] = x[1, :, 9] = 1.0  # the first expects one process, the second the other
    plain = net(x)[0]
    x[0, :, 10 + 1] = x[0, :, 14 + 1] = x[1, :, 10 + 2] = 1.0  # both filters say 1; the first says 2, the other nothing
    net.value.weight.data[:, 10:] = net.gate.weight.data[:, 10:] = net.join.weight.data[:, 10:20] = 0.0
    gain = net(x)[0] - plain
    assert torch.allclose(gain[0], torch.tensor([0.0, 3.0, 0.0]), atol=1e-5)
    assert torch.allclose(gain[1], torch.tensor([0.0, 0.0, 1.5]), atol=1e-5)
    net.direct.weight.data[:, :10] = 0.0  # trust of the first process
    gain = net(x)[0] - plain
    assert torch.allclose(gain[0], torch.zeros(3), atol=1e-5)
    assert torch.allclose(gain[1], torch.tensor([0.0, 0.0, 1.5]), atol=1e-5)


def test_a_network_that_hears_starts_from_one_that_does_not_on_any_plant(tmp_path):
    recipe = dataclasses.replace(
        recipes.general("DCMotor"), flights=8, identify=8, chunk=8, passes=1, validation=4, hidden=8
    )
    hears = dataclasses.replace(recipe, filters=("augmented_ekf_cusum", "null"))
    with pytest.raises(ValueError, match="train sequence_net DCMotor"):
        Run("residual_net", "DCMotor", hears, seed=0, work=tmp_path / "none", base=tmp_path / "none.safetensors")
    base = Run("sequence_net", "DCMotor", recipe, seed=0, work=tmp_path / "base").run()
    run_ = Run("residual_net", "DCMotor", hears, seed=0, work=tmp_path / "run", base=base)
    old, new = load_file(base), run_.network.state_dict()
    assert np.array_equal(new["memory.weight_hh_l0"], old["network.memory.weight_hh_l0"])
    assert not new["value.weight"][:, old["network.value.weight"].shape[1] :].any()
    path = run_.run()
    assert weights.read_card(path).filters == ["augmented_ekf_cusum", "null"]
    check_diagnoser(lambda p, _: make_diagnoser("residual_net", p, path=str(path)), build("DCMotor"), samples=60)


def test_a_network_is_told_the_process_and_takes_an_unknown_one_for_the_first(tiny):
    plant = build("B747Lateral")
    obs = flights.fly(plant, Source("standard", {}), range(VALIDATION, VALIDATION + 2)).obs[:, :200]
    first, same, other = (
        run(make_diagnoser("sequence_net", plant, path=str(tiny), process=name), obs)
        for name in ("standard", "gust", "hard")
    )
    assert np.array_equal(first.label_probs, same.label_probs)
    assert not np.allclose(first.label_probs, other.label_probs)
    with pytest.raises(ValueError, match="unknown scenario"):
        make_diagnoser("sequence_net", plant, path=str(tiny), process="no such")


@pytest.mark.parametrize("stop", [1, 3])
def test_a_resumed_run_ends_with_the_same_bytes(tiny, tmp_path, stop):
    trained(tmp_path, stop_after=stop)
    again = trained(tmp_path)
    assert again.read_bytes() == tiny.read_bytes()
    first, second = weights.read_card(tiny), weights.read_card(again)
    assert [e["loss"] for e in first.curve] == [e["loss"] for e in second.curve]
    assert first.calibration == second.calibration


def test_a_folder_belongs_to_one_run(tiny):
    with pytest.raises(ValueError, match="another recipe"):
        trained(tiny.parent, dataclasses.replace(TINY, rate=1.0))


def test_a_run_leaves_a_card_and_a_log(tiny):
    card = weights.read_card(tiny)
    assert card.env == "B747Lateral-Faults-v0"
    assert card.budget["steps"] == 8
    assert [entry["step"] for entry in card.curve] == [2, 4, 6, 8]
    assert card.seeds["training"] == [TRAINING + 1_000_000, TRAINING + 1_000_023]
    assert list((tiny.parent / "tensorboard").iterdir())
    assert set(card.calibration) == {"standard", "hard"}


def test_trainers_are_found_by_name():
    assert {"sequence_net", "residual_net"} <= set(trainers())
    with pytest.raises(ValueError, match="unknown trainer"):
        find_trainer("no_such")


def test_calibration_recovers_a_temperature_and_improves_the_log_score():
    rng = np.random.default_rng(0)
    logits = rng.standard_normal((20000, 3)) * 2
    bias = np.array([1.0, 0.0, -1.0])
    true = np.exp(calibration.log_softmax(0.5 * logits + bias))
    label = (true.cumsum(axis=1) < rng.random((len(true), 1))).sum(axis=1)
    scale, fitted = calibration.fit(logits, label, np.full(3, 1 / 3))
    assert scale == pytest.approx(0.5, abs=0.03)
    assert fitted - fitted.mean() == pytest.approx(bias, abs=0.06)
    before, after = calibration.log_softmax(logits), calibration.log_softmax(scale * logits + fitted)
    assert calibration.log_score(after, label) > calibration.log_score(before, label)
    assert calibration.calibration_error(after, label) < 0.02 < calibration.calibration_error(before, label)


# ---------------------------------------------------------------------------------------------------------------
# Splits


def test_splits_are_disjoint_from_the_suites_and_from_each_other():
    tested = [(min(seeds), max(seeds)) for seeds in ([*s.seeds, *s.healthy] for s in map(load_suite, suite_names()))]
    assert all(TEST <= first and last < VALIDATION for first, last in tested)
    for path in COMMITTED:
        splits = sorted(weights.read_card(path).seeds.values())
        assert all(a[1] < b[0] for a, b in itertools.pairwise(splits)), path
        assert all(last < begin or end < first for begin, end in splits for first, last in tested), path


def test_every_recipe_trains_on_training_seeds(tiny, monkeypatch):
    """The seeds that a run draws are those that its card names."""
    drawn = []
    draw = flights.draw
    monkeypatch.setattr(flights, "draw", lambda process, seed: drawn.append(seed) or draw(process, seed))
    run = Run("sequence_net", "B747Lateral", TINY, seed=1, work=tiny.parent)
    run.chunk(0), run.chunk(1)
    first, last = weights.read_card(tiny).seeds["training"]
    assert drawn
    assert all(first <= seed <= last for seed in drawn)
    assert first >= TRAINING > CALIBRATION > VALIDATION > TEST


# ---------------------------------------------------------------------------------------------------------------
# Weights


def altered(path, folder, change=None, edit=None):
    """A copy of weights whose tensors or card were changed, with a digest that fits."""
    tensors, card = load_file(path), json.loads(path.with_suffix(".json").read_text())
    copy = folder / path.name
    save_file(change(tensors) if change else tensors, copy)
    card["sha256"] = hashlib.sha256(copy.read_bytes()).hexdigest()
    card |= edit or {}
    copy.with_suffix(".json").write_text(json.dumps(card))
    return copy


def load(path):
    return make_diagnoser("sequence_net", build("B747Lateral"), path=str(path))


def test_weights_that_are_in_order_load(tiny, tmp_path):
    load(altered(tiny, tmp_path))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: {k: v for k, v in t.items() if k != "network.heads.bias"}, "lacks the tensor network.heads.bias"),
        (lambda t: t | {"extra": np.zeros(1, np.float32)}, "has a tensor extra"),
        (lambda t: t | {"network.heads.bias": np.zeros(3, np.float32)}, "has the shape"),
        (lambda t: t | {"network.heads.bias": np.full_like(t["network.heads.bias"], np.nan)}, "not finite"),
    ],
    ids=["missing", "extra", "shape", "nan"],
)
def test_tensors_that_are_not_the_networks_are_refused(tiny, tmp_path, change, reason):
    with pytest.raises(weights.RefusedError, match=reason):
        load(altered(tiny, tmp_path, change))


def test_pickles_zips_and_other_files_are_refused(tiny, tmp_path):
    path = altered(tiny, tmp_path)
    for content, reason in (
        (pickle.dumps({"a": 1}), "a pickle"),
        (b"something else that is long", "not a safetensors file"),
    ):
        path.write_bytes(content)
        with pytest.raises(weights.RefusedError, match=reason):
            load(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data.pkl", b"x")
    with pytest.raises(weights.RefusedError, match="zip archive"):
        load(path)
    torch.save({"a": torch.zeros(1)}, tmp_path / "model.pt")
    with pytest.raises(weights.RefusedError, match=r"not \.pt"):
        load(tmp_path / "model.pt")


def test_a_card_that_does_not_fit_is_refused(tiny, tmp_path):
    with pytest.raises(weights.RefusedError, match="digest differs"):
        load(altered(tiny, tmp_path, edit={"sha256": "0" * 64}))
    shape = weights.read_card(tiny).shape
    for edit, reason in [
        ({"shape": {**shape, "hidden": "16"}}, "hidden is a whole number above 0, up to 1024, not '16'"),
        (
            {"shape": {k: v for k, v in shape.items() if k != "lags"}},
            "the shape's lags is .*, not 'None'",
        ),
        ({"calibration": {}}, "no calibration of 5 labels for 'standard'"),
        ({"filters": ["os:system"]}, "'os:system', which is no filter"),
        ({"filters": ["known_onset_oracle"]}, "'known_onset_oracle', which is no filter"),
    ]:
        with pytest.raises(weights.RefusedError, match=reason):
            load(altered(tiny, tmp_path, edit=edit))
    with pytest.raises(NotApplicableError, match="B747Lateral-Faults-v9"):
        load(altered(tiny, tmp_path, edit={"env": "B747Lateral-Faults-v9"}))
    with pytest.raises(weights.RefusedError, match="not a card"):
        load(altered(tiny, tmp_path, edit={"surprise": 1}))
    with pytest.raises(NotApplicableError, match="trained with the labels"):
        make_diagnoser("sequence_net", load_plant("B747Lateral", labels="dual"), path=str(altered(tiny, tmp_path)))


def test_without_weights_or_torch_the_reason_is_given(monkeypatch):
    with pytest.raises(NotApplicableError, match="fdi-gym train sequence_net DCMotor"):
        make_diagnoser("sequence_net", build("DCMotor"))
    for name in [m for m in sys.modules if m.startswith("baselines.networks")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(NotApplicableError, match=r"fdi-gym\[learn\]"):
        make_diagnoser("sequence_net", build("B747Lateral"))


def test_recipes_name_what_exists():
    for plant_id, recipe in recipes.RECIPES.items():
        for source in recipe.sources:
            assert source.process in flights.plant_of(plant_id, source).processes
