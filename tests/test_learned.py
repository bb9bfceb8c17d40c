"""Learned diagnosers: a stream is seen as in training, runs resume exactly, weights are checked, splits are disjoint."""

import dataclasses
import hashlib
import itertools
import json
import pickle
import re
import sys
import zipfile

import joblib
import msgspec
import numpy as np
import pytest
import torch
from conftest import PLANTS, build
from numpy.testing import assert_allclose
from safetensors.numpy import load_file, save_file

from baselines.learned import (
    _attention,
    attention,
    features,
    flights,
    probabilities,
    recipes,
    sequence_net,
    streams,
    weights,
)
from baselines.learned._network import SequenceNetwork, loss
from baselines.learned._supervised import SupervisedTraining
from baselines.learned.features import FeatureShape
from baselines.learned.flights import CALIBRATION, PER_SEED, TEST, TRAINING, VALIDATION, Condition
from baselines.learned.recipes import SequenceRecipe
from fdi_gym.diagnosis import (
    NotApplicableError,
    diagnosers,
    find_diagnoser,
    find_trainer,
    make_diagnoser,
    probers,
    registry,
    run,
    train,
    trainer,
    trainers,
)
from fdi_gym.discovery import load_plant
from fdi_gym.listing import details
from fdi_gym.plant import Plant
from fdi_gym.suite import load_suite, suite_names
from fdi_gym.testing import check_diagnoser

TINY = SequenceRecipe(
    conditions=(Condition("standard", {}), Condition("hard", {})), shape=FeatureShape(20, 3, 1),
    flights=16, identify=8, chunk=8, passes=2, validation=4, validate=1, batch=8, hidden=16,
)  # fmt: skip
COMMITTED = sorted(weights.WEIGHTS.glob("*.safetensors"))
LEARNED = (
    "sequence_net",
    "residual_net",
    "randomised_net",
    "attention_net",
    "ppo",
    "ppo_identification",
    "gain_net",
)  # networks
CLOSED_FORM = ("pca", "dynamic_pca", "cva", "boosted_trees", "random_forest", "minirocket")  # what learns without torch
NETWORKS = [path for path in COMMITTED if "_net-" in path.stem and not path.stem.startswith("gain_net")]


def trained(folder, recipe=TINY, plant="B747Lateral", **arguments):
    return SupervisedTraining("sequence_net", build(plant), recipe, seed=1, work=folder).run(**arguments)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("run"))


# ---------------------------------------------------------------------------------------------------------------
# The network sees a stream as it saw whole flights


SHAPES = {"linear": FeatureShape(4, 3, 1, shares=True), "products": FeatureShape(5, 2, 2, 2, 3)}


def streamed(plant, shape, model, obs):
    """The features of samples one by one, and the state after them."""
    stream, seen = streams.begin(plant, shape, len(obs)), []
    for k in range(obs.shape[1]):
        stream, found = streams.add(plant, shape, model, stream, obs[:, k], k)
        seen += [] if found is None else [found]
    return np.stack(seen, axis=1), stream


@pytest.mark.parametrize("shares", [False, True])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("plant_id", ["B747Lateral", "MissilePitch"])
def test_features_of_a_stream_are_those_of_the_whole_flight(plant_id, shape, shares):
    """With gaps too, which change nothing before them, nor in other flights."""
    plant, shape = build(plant_id), shape._replace(shares=shares)
    record = flights.fly(plant, Condition("standard", {}), range(TRAINING, TRAINING + 4))
    z, n_y = features.blocks(plant, record.obs, shape.stride), len(plant.outputs)
    delta = flights.at_steps(features.deviation(plant, record.target), shape.stride)[:, : z.shape[1]]
    model = features.identify(plant, shape, [(z, delta)])
    model = streams.standardised(plant, shape, model, [record.obs])
    assert {f"model.{k}": a.shape for k, a in model._asdict().items()} == features.tensor_shapes(plant, shape)
    whole = streams.features(plant, shape, model, record.obs)
    assert np.allclose(streamed(plant, shape, model, record.obs)[0], whole, atol=1e-5)
    first = 8 * shape.period
    gaps = record.obs.copy()
    gaps[:2, first:, :n_y][np.random.default_rng(0).random(gaps[:2, first:, :n_y].shape) < 0.3] = np.nan
    gaps[0, first : first + 40, 0] = np.nan
    torn = streams.features(plant, shape, model, gaps)
    assert np.array_equal(streamed(plant, shape, model, gaps)[0].astype(np.float32), torn)
    assert np.isfinite(torn).all()
    assert np.allclose(torn[2:], whole[2:], atol=1e-5)
    assert np.allclose(torn[:, :8], whole[:, :8], atol=1e-5)
    if shares:
        there = ~np.isnan(gaps[:, : torn.shape[1] * shape.period, :n_y])
        came = there.reshape(len(gaps), torn.shape[1], shape.period, n_y).mean(axis=2)
        assert_allclose(torn[..., -n_y:] * model.std[-n_y:] + model.mean[-n_y:], came, atol=1e-6)


def test_identified_residuals_are_white_where_the_plant_is_linear_and_healthy():
    plant, shape = build("B747Lateral"), FeatureShape(1, 20, 1)
    record = flights.fly(plant, Condition("fault-free", {}), range(TRAINING, TRAINING + 40))
    z = features.blocks(plant, record.obs, 1)
    model = features.identify(plant, shape, [(z, np.zeros((*z.shape[:2], 4)))])
    phi, psi = features.sequences(plant, shape, z)
    e, _, _ = features.information(model, phi, psi, z[:, 20:, 0, :4])
    assert np.allclose(np.cov(e.reshape(-1, 4).T), np.eye(4), atol=0.05)
    assert abs(np.mean(e[:, 1:] * e[:, :-1])) < 0.02


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("plant_id", PLANTS)
def test_a_sensor_that_does_not_report_says_nothing(plant_id, degree):
    """A linear model says what is expected in its place; one with products what was reported last."""
    plant, shape = build(plant_id), FeatureShape(stride=4, lags=3, degree=degree)
    record = flights.fly(plant, Condition("standard", {}), range(TRAINING, TRAINING + 6))
    obs, n_y = record.obs[:, :200].copy(), len(plant.outputs)
    z = features.blocks(plant, obs, shape.stride)
    delta = flights.at_steps(features.deviation(plant, record.target), shape.stride)[:, : z.shape[1]]
    model = features.identify(plant, shape, [(z, delta)])

    def after(obs, samples):
        return streamed(plant, shape, model, obs[:, :samples])[1]

    before = after(obs, 100)
    obs[:, 100:104, :n_y] = np.nan  # a whole block
    silent = after(obs, 104)
    keep = (1 - 1 / features.MEMORIES)[:, None]
    assert_allclose(silent.g, keep * before.g)  # forgotten, and nothing new
    assert_allclose(silent.info, keep[..., None] * before.info)
    phi, _ = features.regressors(plant, shape, before.past, silent.past[:, 0])
    ahead = features.expected(model, phi) if shape.linear else before.past[:, 0, 1, :n_y]
    assert_allclose(silent.past[:, 0, 0, :n_y], ahead)
    assert_allclose(silent.past[:, 0, 1, :n_y], ahead)
    obs = record.obs[:, :104].copy()
    obs[:, 103, 0] = np.nan  # the last of a block, of one sensor
    part, whole = after(obs, 104), after(record.obs, 104)
    slope = (ahead[:, 0] - before.past[:, 0, 1, 0]) / 2.5
    rest = plant.scale(obs)[:, 100:103, 0]
    assert_allclose(part.past[:, 0, 0, 0], rest.mean(axis=1) + 0.5 * slope)
    assert_allclose(part.past[:, 0, 1, 0], rest[:, -1] + slope)
    assert_allclose(part.past[:, 0, :, 1:], whole.past[:, 0, :, 1:])


def test_where_a_model_has_products_residuals_after_a_gap_count_the_less_the_larger_they_are():
    plant, shape = build("MissilePitch"), FeatureShape(stride=2, lags=4, degree=2)
    record = flights.fly(plant, Condition("standard", {}), range(TRAINING, TRAINING + 6))
    z = features.blocks(plant, record.obs, shape.stride)
    delta = flights.at_steps(features.deviation(plant, record.target), shape.stride)[:, : z.shape[1]]
    model = features.identify(plant, shape, [(z, delta)])
    spread = np.sqrt(np.diag(np.linalg.inv(model.whiten.astype(float) @ model.whiten)))
    assert_allclose(streams._trust(model, np.array([[0.5, -30.0, 0.0]]) * spread), [[1.0, streams.BOUND / 30, 1.0]])
    obs = record.obs[:, :282].copy()
    obs[:, 240:280, 0] = np.nan
    silent, after = (streamed(plant, shape, model, obs[:, :k])[1] for k in (280, 282))
    assert (after.torn == [False, True, True, True]).all()
    last = plant.scale(obs)[:, 239, :1]
    assert_allclose(silent.past[:, 0, :, 0], np.concatenate([last, last], axis=1))
    bound = np.abs(model.whiten) @ (streams.BOUND * spread)
    phi, _ = features.regressors(plant, shape, silent.past, after.past[:, 0])
    plain = (after.past[:, 0, 0, :3] - features.expected(model, phi)) @ model.whiten.T
    assert (np.abs(plain) > bound).any()
    assert (np.abs(after.residuals - silent.residuals) <= bound).all()


@pytest.mark.parametrize("path", NETWORKS, ids=lambda p: p.stem)
def test_streamed_diagnoses_are_those_of_the_whole_sequence(path):
    card = weights.read_card(path)
    condition = Condition(card.processes[0], card.options[0])
    plant = load_plant(card.plant, **card.options[0])
    tensors, card = weights.read(path, plant)
    shape, model = weights.shape_of(path, card)[0], weights.model_of(tensors)
    record = flights.fly(plant, condition, range(VALIDATION, VALIDATION + 3))
    obs = record.obs[:, : 20 * shape.period + 3]
    seen = [streams.features(plant, shape, model, obs)]
    seen.append(flights.context(np.zeros(3, int), len(card.processes), 20))
    told = flights.filters_features(plant, condition.process, card.processes, card.filters, obs, shape.period)
    x = torch.from_numpy(np.concatenate([*seen, *told], axis=2)).double()
    width = sum(part.shape[2] for part in told)
    memory = "attention" if card.method == "attention_net" else "recurrent"
    size = (x.shape[2], len(plant.labels), len(plant.estimated), card.shape["hidden"], width, len(card.processes), memory)
    net = SequenceNetwork(*size).double()
    net.load_state_dict({name: torch.from_numpy(tensors[f"network.{name}"]) for name in net.state_dict()})
    with torch.inference_mode():
        logits, mean, log_std = (a.numpy() for a in net(x)[:3])
    said = run(make_diagnoser(path.stem.split("-")[0], plant), obs)
    fitted = card.calibration[card.processes[0]]
    probs = np.exp(probabilities.log_softmax(fitted.scale * logits + np.array(fitted.bias)))
    at = slice(shape.period - 1, None, shape.period)
    unit = np.array([s.scale for s in plant.estimated])
    assert np.allclose(said.label_probs[:, at], probs, atol=1e-5)
    assert np.allclose(features.deviation(plant, said.estimate[:, at]), mean, atol=1e-5)
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


def trusted(net, flown):
    """What the direct way makes of what filters say (N, T, labels), process by process."""
    weight = net.direct.weight.detach().numpy().reshape(net.labels, net.processes, net.told)
    return np.einsum("ntf,nlf->ntl", flown.features[..., -net.told :], weight[:, flown.process].swapaxes(0, 1))


@pytest.mark.parametrize(("plant_id", "filter"), [("DCMotor", "multiple_model_ekf"), ("B747Lateral", "two_stage_kf")])
def test_a_network_that_is_shown_filters_starts_from_one_that_is_not(plant_id, filter, tmp_path):
    plant = build(plant_id)
    recipe = dataclasses.replace(
        recipes.sequence_recipe(plant),
        shape=FeatureShape(20, 3, 1),
        flights=4,
        identify=8,
        chunk=4,
        passes=1,
        validation=2,
        hidden=8,
    )
    shown = dataclasses.replace(recipe, filters=(filter, "null"))
    with pytest.raises(ValueError, match=f"train sequence_net {plant_id}"):
        SupervisedTraining("residual_net", plant, shown, seed=0, work=tmp_path / "none", base=tmp_path / "none.safetensors")
    base = SupervisedTraining("sequence_net", plant, recipe, seed=0, work=tmp_path / "base").run()
    training = SupervisedTraining("residual_net", plant, shown, seed=0, work=tmp_path / "run", base=base)
    old, new = load_file(base), training.network.state_dict()
    assert np.array_equal(new["memory.weight_hh_l0"], old["network.memory.weight_hh_l0"])
    assert not new["value.weight"][:, old["network.value.weight"].shape[1] :].any()
    flown, labels = training.chunk(0), len(plant.labels)
    told = training.network.told
    said = np.stack([np.eye(told)[flown.label], np.eye(told)[labels - 1 - flown.label]])  # the second process's filters lie
    made = flown._replace(
        features=np.concatenate([flown.features[..., :-told], said[flown.process, np.arange(len(flown.label))]], axis=2,
                                dtype=np.float32)
    )  # fmt: skip
    training.stack(made)
    right = training.logits(made).argmax(axis=2) == flown.label
    assert right[flown.scored].mean() > 0.999
    training.stack(flown)
    own = SupervisedTraining("sequence_net", plant, recipe, seed=0, work=tmp_path / "base").network
    alone = training.logits(flown) - 10 * trusted(training.network, flown)
    with torch.inference_mode():
        plain = own(torch.from_numpy(flown.features[..., :-told]))[0].numpy()
    scale = (alone * plain).sum() / (plain**2).sum()
    assert_allclose(alone, scale * plain, atol=1e-4)
    path = training.run()
    assert weights.read_card(path).filters == [filter, "null"]
    check_diagnoser(lambda p, _: make_diagnoser("residual_net", p, path=str(path)), plant, samples=60)


@pytest.mark.parametrize("memory", ["recurrent", "attention"])
@pytest.mark.parametrize("told", [0, 10], ids=["alone", "filters"])
def test_a_step_on_numpy_is_a_step_of_the_network_that_was_trained(told, memory, monkeypatch):
    monkeypatch.setattr(attention, "WINDOW", 5)  # shorter than what is shown
    monkeypatch.setattr(_attention, "WINDOW", 5)
    torch.manual_seed(0)
    net = SequenceNetwork(8 + 2 + told, 3, 2, 16, told, processes=2, memory=memory).double()
    for value in net.parameters():
        value.data.normal_(std=0.7)
    tensors = {name: value.numpy() for name, value in net.state_dict().items()}
    x = np.random.default_rng(0).normal(size=(5, 7, net.value.in_features))
    with torch.inference_mode():
        whole = [a.numpy() for a in net(torch.from_numpy(x))[:3]]
    h = attention.begin(5, 16) if memory == "attention" else np.zeros((5, 16))
    for k in range(x.shape[1]):
        *answer, h = sequence_net.forward(tensors, x[:, k], h, 3, 2)
        for a, b in zip(answer, whole, strict=True):
            assert np.allclose(a, b[:, k], atol=1e-12)


@pytest.mark.parametrize("plant_id", ["DCMotor", "B747Lateral"])  # of outside, and of the package
def test_what_filters_say_is_the_same_in_another_process(plant_id):
    plant, condition = build(plant_id), Condition("standard", {})
    arguments = (plant, "standard", ["standard"], ("null", "random"), flights.fly(plant, condition, range(3)).obs[:, :40], 4)
    here = flights.filters_features(*arguments)
    for there in joblib.Parallel(2)(joblib.delayed(flights.filters_features)(*arguments) for _ in range(2)):
        assert [a.shape[:2] for a in there] == [(3, 10), (3, 10)]
        assert all(np.array_equal(a, b) for a, b in zip(here, there, strict=True))


def test_a_filter_that_does_not_apply_to_a_process_is_shown_as_a_lost_one_as_wide_as_where_it_does():
    plant = build("CMGSatellite")
    obs, labels = flights.fly(plant, Condition("hard", {}), range(1)).obs[:, :8], len(plant.labels)
    processes = ("standard", "hard", "standard-dropout")
    shown = [flights.filters_features(plant, name, processes, ("overlap_bank",), obs, 4)[0] for name in processes[:2]]
    assert shown[0].shape == shown[1].shape
    assert_allclose(shown[0], np.broadcast_to(np.arange(shown[0].shape[2]) == labels, shown[0].shape))
    assert not np.allclose(shown[1][..., labels], 1.0)
    with pytest.raises(NotApplicableError, match="no two faults overlap"):
        flights.shown_filter("overlap_bank", plant, "standard", ["standard"])


def test_a_network_is_told_the_process_and_takes_an_unknown_one_for_the_first(tiny):
    plant = build("B747Lateral")
    obs = flights.fly(plant, Condition("standard", {}), range(VALIDATION, VALIDATION + 2)).obs[:, :200]
    first, same, other = (
        run(make_diagnoser("sequence_net", plant, path=str(tiny), process=name), obs)
        for name in ("standard", "gust", "hard")
    )
    assert np.array_equal(first.label_probs, same.label_probs)
    assert not np.allclose(first.label_probs, other.label_probs)
    with pytest.raises(ValueError, match="unknown process"):
        make_diagnoser("sequence_net", plant, path=str(tiny), process="no such")


def test_a_network_that_has_learned_of_gaps_is_told_of_them_and_others_are_not(tiny, tmp_path):
    """One with products is held where it has not."""
    plant, missing = (build("B747Lateral", **options) for options in ({}, recipes.DROPOUT))
    further = (*TINY.conditions, Condition("standard", recipes.DROPOUT))
    shape = FeatureShape(20, 3, 2, shares=True)
    path = trained(tmp_path, dataclasses.replace(TINY, conditions=further, shape=shape))
    card, old = weights.read_card(path), weights.read_card(tiny)
    assert card.processes == ["standard", "hard", "standard-dropout"]
    assert [card.condition(p, "standard") for p in (plant, missing)] == ["standard", "standard-dropout"]
    assert [card.condition(p, "hard") for p in (plant, missing)] == ["hard", "hard"]
    assert old.condition(missing, "standard") == "standard"
    obs = flights.fly(missing, further[0], range(VALIDATION, VALIDATION + 2)).obs[:, :200]
    assert np.isnan(obs).any()
    told, other = (make_diagnoser("sequence_net", p, path=str(path)) for p in (missing, plant))
    assert told.gaps
    assert other.gaps
    assert not np.allclose(run(told, obs).label_probs, run(other, obs).label_probs)
    assert np.isfinite(run(told, obs).label_probs).all()
    deaf = dataclasses.replace(TINY, shape=shape._replace(shares=False))
    assert not make_diagnoser("sequence_net", missing, path=str(trained(tmp_path / "deaf", deaf))).gaps


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


def test_weights_of_failing_sensors_are_others_and_name_them(tmp_path, b747):
    plant = build("B747Lateral", sensor_faults=True)
    path = train("pca", plant, budget=16, work=tmp_path)
    card = weights.read_card(path)
    assert path.stem == "pca-B747Lateral-sensors" != weights.stem("pca", b747)
    assert card.processes == ["mixed"]
    assert card.labels == [label.name for label in plant.labels]
    assert card.command == "fdi-gym train pca B747Lateral --options sensor_faults true --budget 16"
    assert make_diagnoser("pca", plant, process="mixed", path=str(path))
    with pytest.raises(NotApplicableError, match="trained with the labels"):
        make_diagnoser("pca", b747, path=str(path))
    with pytest.raises(
        NotApplicableError, match=r"train them: fdi-gym train minirocket B747Lateral --options sensor_faults true"
    ):
        make_diagnoser("minirocket", plant, process="mixed")


def test_a_run_leaves_a_card_and_a_log(tiny):
    card = weights.read_card(tiny)
    assert card.env == "B747Lateral-Faults-v0"
    assert card.budget["steps"] == 8
    assert [(entry["step"], entry["flights"]) for entry in card.curve] == [(2, 8), (4, 8), (6, 16), (8, 16)]
    assert card.seeds["training"] == [TRAINING + 1_000_000, TRAINING + 1_000_023]
    assert list((tiny.parent / "tensorboard").iterdir())
    assert set(card.calibration) == {"standard", "hard"}


# ---------------------------------------------------------------------------------------------------------------
# Trainers by name, in the registry of the diagnosers


def test_every_learned_method_has_a_trainer_of_its_name():
    assert {*LEARNED, *CLOSED_FORM} == set(trainers()) - set(probers())
    assert set(trainers()) <= {*diagnosers(), *probers()}
    with pytest.raises(ValueError, match=r"unknown trainer 'sequence_nett'; did you mean sequence_net\?"):
        find_trainer("sequence_nett")
    with pytest.raises(ValueError, match="two trainers are called 'ppo'"):
        trainer("ppo", "Another")(lambda plant: None)


def outside(plant, *, work, seed, scale=1.0):
    """A trainer of one's own, which takes no budget."""
    path = work / "own.safetensors"
    save_file({"a": np.full(1, scale * seed)}, path)
    return path


def test_a_trainer_gets_what_it_takes(tmp_path, b747):
    name = f"{__name__}:outside"
    assert load_file(train(name, b747, seed=3, work=tmp_path, scale=2.0))["a"] == 6.0
    for arguments, reason in [
        ({"budget": 5}, "takes no budget"), ({"rate": 1.0}, "has no setting 'rate'; it has scale"),
        ({"seed": -1}, "seed is 0 or more"), ({"work": tmp_path / "none"}, "No such file"),
    ]:  # fmt: skip
        with pytest.raises(ValueError, match=reason):
            train(name, b747, **{"work": tmp_path, **arguments})


def test_list_says_what_a_trainer_takes(monkeypatch):
    assert "fdi-gym train ppo_identification PLANT" in details("ppo_identification")
    assert "'identification' under this name" in details("ppo_identification")
    entry = registry.Entry("trainer", "outside", "One's own", outside, {})
    monkeypatch.setitem(registry._entries["trainer"], "outside", entry)
    assert f"fdi-gym train {__name__}:outside PLANT" in details(f"{__name__}:outside")


@pytest.mark.parametrize("name", LEARNED)
def test_learned_methods_see_through_gaps_or_are_held_and_their_entry_says_so(name, b747):
    """A network with a linear model goes on; of the others what they said stands. Answers are numbers."""
    diagnoser = make_diagnoser(name, b747)
    assert diagnoser.gaps == name.endswith("_net")
    held = re.search(r"B747Lateral +runs; its diagnosis is held while a sensor is missing", details(name))
    assert bool(held) != diagnoser.gaps
    obs = flights.fly(b747, Condition("hard", {}), range(VALIDATION, VALIDATION + 2)).obs[:, :160].copy()
    whole = run(diagnoser, obs)
    obs[0, 60:75, 2] = np.nan
    said = run(diagnoser, obs)
    for field in ("label", "estimate", "label_probs"):
        value, plain = getattr(said, field), getattr(whole, field)
        if value is not None:
            stands = (value[0, 60:75] == value[0, 59]).all()
            assert stands if not diagnoser.gaps else field == "label" or not stands, field
            assert np.array_equal(value[1], plain[1]), field
            assert np.isfinite(value).all(), field


@pytest.mark.parametrize("path", [p for p in NETWORKS if "residual_net" not in p.stem], ids=lambda p: p.stem)
def test_shipped_networks_go_on_through_gaps_where_their_model_is_linear_or_they_have_learned_to(path):
    card = weights.read_card(path)
    plant = load_plant(card.plant, **{**card.options[0], **recipes.DROPOUT})
    diagnoser = make_diagnoser(card.method, plant, process=card.processes[0])
    shape = weights.shape_of(path, card)[0]
    assert diagnoser.gaps == (shape.linear or shape.shares)
    assert shape.shares == any(name.endswith(weights.MISSING) for name in card.processes)
    obs = flights.fly(plant, Condition(card.processes[0], card.options[0]), range(VALIDATION, VALIDATION + 2)).obs[:, :200]
    assert np.isnan(obs).any()
    assert np.isfinite(run(diagnoser, obs).label_probs).all()


def test_calibration_recovers_a_temperature_and_improves_the_log_score():
    rng = np.random.default_rng(0)
    logits = rng.standard_normal((20000, 3)) * 2
    bias = np.array([1.0, 0.0, -1.0])
    true = np.exp(probabilities.log_softmax(0.5 * logits + bias))
    label = (true.cumsum(axis=1) < rng.random((len(true), 1))).sum(axis=1)
    scale, fitted = probabilities.fit(logits, label, np.full(3, 1 / 3))
    assert scale == pytest.approx(0.5, abs=0.03)
    assert fitted - fitted.mean() == pytest.approx(bias, abs=0.06)
    before, after = probabilities.log_softmax(logits), probabilities.log_softmax(scale * logits + fitted)
    assert probabilities.log_score(after, label) > probabilities.log_score(before, label)
    assert probabilities.calibration_error(after, label) < 0.02 < probabilities.calibration_error(before, label)


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
    draw = Plant.draw
    monkeypatch.setattr(Plant, "draw", lambda plant, process, seed, *a: drawn.append(seed) or draw(plant, process, seed, *a))
    training = SupervisedTraining("sequence_net", build("B747Lateral"), TINY, seed=1, work=tiny.parent)
    training.chunk(0), training.chunk(1)
    first, last = weights.read_card(tiny).seeds["training"]
    assert drawn
    assert all(first <= seed <= last for seed in drawn)
    assert first >= TRAINING > CALIBRATION > VALIDATION > TEST
    drawn.clear()
    training.held_out(CALIBRATION)
    assert [min(drawn), max(drawn)] == weights.read_card(tiny).seeds["calibration"]


# ---------------------------------------------------------------------------------------------------------------
# Weights


@pytest.mark.parametrize("plant_id", PLANTS)
def test_every_number_of_a_recipe_is_positive_or_nothing(plant_id):
    plant = build(plant_id)
    for recipe in (recipes.sequence_recipe(plant), recipes.policy_recipe(plant, "isolation")):
        for field in dataclasses.fields(recipe):
            value = getattr(recipe, field.name)
            for number in dataclasses.astuple(value) if dataclasses.is_dataclass(value) else [value]:
                assert not isinstance(number, int | float) or number >= 0, field.name
    assert recipes.sequence_recipe(plant).passes > 0


@pytest.mark.parametrize(
    ("options", "budget", "seed", "rest"),
    [({}, None, 0, ""), ({"labels": "dual"}, 9, 3, " --options labels dual --budget 9 --seed 3")],
)
def test_the_command_that_makes_weights_again_says_what_is_not_as_usual(options, budget, seed, rest):
    plant = build("B747Lateral", **options)
    assert weights.command("sequence_net", plant, budget, seed) == f"fdi-gym train sequence_net B747Lateral{rest}"


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
        ({"shape": {**shape, "shares": 1}}, "the shape's shares is true or false, not '1'"),
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


def test_without_weights_or_a_library_the_reason_is_given(monkeypatch, tmp_path):
    with pytest.raises(NotApplicableError, match="fdi-gym train sequence_net DCMotor"):
        make_diagnoser("sequence_net", build("DCMotor"))
    for name in [m for m in sys.modules if m.startswith("baselines.learned._")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    make_diagnoser("sequence_net", build("B747Lateral"))
    for name in LEARNED:
        with pytest.raises(NotApplicableError, match=r"needs torch: pip install 'fdi-gym\[learn\]'"):
            train(name, build("B747Lateral"), work=tmp_path)
    monkeypatch.setitem(sys.modules, "safetensors", None)
    for name in LEARNED:
        with pytest.raises(NotApplicableError, match=r"needs safetensors: pip install 'fdi-gym\[learn\]'"):
            make_diagnoser(name, build("B747Lateral"))


@pytest.mark.parametrize("sensor_faults", [False, True])
@pytest.mark.parametrize("plant_id", PLANTS)
def test_recipes_name_what_exists(plant_id, sensor_faults):
    plant = build(plant_id, sensor_faults=sensor_faults)
    recipe = recipes.network_recipe(plant)
    for condition in recipe.conditions:
        assert condition.process in flights.plant_under(plant, condition).processes
    names = [condition.name for condition in recipe.conditions]
    assert len(set(names)) == len(names)
    assert recipe.shape.shares == any(name.endswith(weights.MISSING) for name in names) == (not sensor_faults)
    for name in recipes.residual_recipe(plant).filters:
        assert not find_diagnoser(name).clairvoyant


def test_flights_of_several_windows_are_those_of_suites_and_no_seed_is_in_two_splits():
    plant = build("CMGSatellite")
    condition = Condition("standard", {}, windows=3, pace=0.2)
    for first in (VALIDATION, CALIBRATION, TRAINING, TRAINING + PER_SEED):
        found = [seed for i in range(5) for seed in condition.seeds(first + i)]
        assert found == list(range(first, first + 15))
    scenario = condition.scenario(plant, TRAINING + 7)
    suite = msgspec.structs.replace(load_suite("cmg-standard"), seeds=list(range(TRAINING + 21, TRAINING + 24)), healthy=[])
    assert scenario == suite.scenarios(plant, [0])[0]
    assert scenario.steps < plant.draw("standard", TRAINING + 21).steps
    whole = Condition("standard", {})
    assert whole.scenario(plant, TRAINING + 7) == plant.draw("standard", TRAINING + 7)
