"""The gain network: its filter is the augmented one, its slopes are true, it runs as it was trained, gaps leave no trace."""

import dataclasses
import functools

import numpy as np
import pytest
import torch
from conftest import build
from safetensors.numpy import load_file
from test_learned import TINY, altered

from baselines.filters.augmented_gaussian import augmented_ekf
from baselines.learned import flights, gain_filter, gain_net, probabilities, weights
from baselines.learned._gain import FilterStep, GainNetwork, GainTraining, Stream
from baselines.learned.features import FeatureShape, deviation
from baselines.learned.flights import TRAINING, VALIDATION, Condition
from fdi_gym.diagnosis import NotApplicableError, make_diagnoser, run
from fdi_gym.diagnosis.fitting import fit_belief
from fdi_gym.diagnosis.knowledge import knowledge_of
from fdi_gym.diagnosis.registry import find_diagnoser
from fdi_gym.estimation.interval import Interval

STRIDE = 4
COMMITTED = sorted(weights.WEIGHTS.glob("gain_net-*.safetensors"))
SMALL = dataclasses.replace(TINY, shape=FeatureShape(STRIDE, 1, 1), flights=4, chunk=4, passes=2, identify=4, batch=4)


@functools.cache
def nominal(plant_id):
    plant = build(plant_id)
    return gain_net.nominal_of(plant, fit_belief(plant, "standard"), STRIDE)


def flown(plant_id, samples, n=3):
    return flights.fly(build(plant_id), Condition("standard", {}), range(TRAINING, TRAINING + n)).obs[:, :samples].copy()


def network(plant_id, spread=0.0, processes=2):
    """A network of random weights, in double precision; with no spread its gains are nominal."""
    torch.manual_seed(0)
    net = GainNetwork(nominal(plant_id), STRIDE, len(build(plant_id).labels), 8, processes).double()
    net.gain.weight.data.normal_(std=spread)
    return net


def as_numpy(net):
    tensors = {name: value.numpy() for name, value in net.state_dict().items()}
    return tensors | {f"{name}_l0": value for name, value in tensors.items() if name.startswith("memory.")}


def filter_of(plant_id, net):
    labels = len(build(plant_id).labels)
    plain = weights.ProbabilityCalibration(
        scale=1.0, bias=[0.0] * labels, prior=[1 / labels] * labels, log_score=(0.0, 0.0), calibration_error=(0.0, 0.0)
    )
    return gain_net.gain_filter(nominal(plant_id), as_numpy(net), np.eye(2)[0], STRIDE, plain)


def diagnoser(plant_id, net):
    rule = gain_net.by_candidate(lambda r, _: np.argmin(r.cost, axis=1), after=1)
    return gain_net.diagnoser_of(build(plant_id), filter_of(plant_id, net), rule)


# tolerance: where the nominal gain depends on the estimate, what it does is left out
@pytest.mark.parametrize(("plant_id", "tolerance"), [("B747Lateral", 1e-6), ("ThreeTank", 0.03), ("MissilePitch", 0.03)])
def test_slopes_through_the_filter_are_those_of_finite_differences(plant_id, tolerance):
    model, layout = nominal(plant_id).model, nominal(plant_id).layout
    obs, n_y = flown(plant_id, 2 * STRIDE), len(model.plant.outputs)
    obs[0, 6, 0], obs[1, 3:7, :n_y] = np.nan, np.nan  # a gap within a step, and one across two
    rng, rows, m = np.random.default_rng(0), model.z.stop, len(model.R)
    of_X = torch.from_numpy(rng.normal(size=(3, len(model.X0))) / model.scale)
    of_shown = torch.from_numpy(rng.normal(size=(3, len(layout.unit))) / layout.unit)
    log = torch.from_numpy(0.3 * rng.normal(size=(2, 3, rows, m))).requires_grad_()
    X = torch.from_numpy(model.X0 + 0.01 * rng.normal(size=(3, len(model.X0))) * model.scale).requires_grad_()

    def value(X, log):
        stream, total = Stream(model, obs, STRIDE), torch.zeros(())
        for step in log:
            X, shown = FilterStep.apply(X, torch.exp(step), stream, layout)
            total = total + (of_shown * shown).sum()
        return total + (of_X * X).sum()

    slopes = torch.autograd.grad(value(X, log), (X, log))
    scales = (torch.from_numpy(np.tile(model.scale, (3, 1))), torch.ones(2, 3, rows, m))
    with torch.no_grad():
        for which, (slope, scale) in enumerate(zip(slopes, scales, strict=True)):
            for _ in range(3):  # along random directions
                way = scale * torch.from_numpy(rng.normal(size=slope.shape))
                ends = [[X, log], [X, log]]
                ends[0][which], ends[1][which] = ends[0][which] + 1e-5 * way, ends[1][which] - 1e-5 * way
                found = (value(*ends[0]) - value(*ends[1])) / 2e-5
                size = (slope * way).abs().sum()
                assert abs(float(found - (slope * way).sum())) < tolerance * float(size)


@pytest.mark.parametrize("plant_id", ["B747Lateral", "ThreeTank", "MissilePitch"])
def test_without_a_correction_it_is_the_augmented_filter(plant_id):
    plant, obs = build(plant_id), flown(plant_id, 60)
    obs[1, 20:25, 0] = obs[2, 30:34] = np.nan
    known = knowledge_of(find_diagnoser("augmented_ekf"), plant, "standard", {})
    known["belief"] = nominal(plant_id).belief
    plain, own = run(augmented_ekf(plant, **known), obs), run(diagnoser(plant_id, network(plant_id)), obs)
    assert np.allclose(own.estimate, plain.estimate, atol=1e-9)
    assert np.allclose(own.state, plain.state, atol=1e-9 * np.abs(plain.state).max())
    moved = run(diagnoser(plant_id, network(plant_id, spread=1.0)), obs)
    assert np.allclose(moved.estimate[:, :STRIDE], plain.estimate[:, :STRIDE])  # before it has spoken
    assert not np.allclose(moved.estimate, plain.estimate, atol=1e-3)


def test_a_larger_gain_follows_the_innovation_further():
    """With one sensor and one factor above 1, the correction is in the nominal direction and longer by that factor."""
    model = nominal("B747Lateral").model
    X, P, one = model.X0[None], model.P0[None], np.ones((1, model.z.stop, 4))
    at = Interval(np.ones(1, int), np.zeros((1, 2)), None, np.zeros((1, 0)))
    y, seen = np.array([[0.3, 0.0, 0.0, 0.0]]), np.array([[True, False, False, False]])
    plain = gain_filter.corrected(model, X, P, at, y, seen, one)
    twice = gain_filter.corrected(model, X, P, at, y, seen, 2 * one)
    assert 0 < plain.X[0, 0] < 0.3
    assert np.allclose(twice.X - X, 2 * (plain.X - X))
    assert np.array_equal(twice.P, plain.P)  # the nominal covariance is nobody's to correct


def test_a_sensor_that_did_not_report_leaves_no_trace():
    model = nominal("B747Lateral").model
    rng = np.random.default_rng(0)
    X, P = rng.normal(size=(2, len(model.X0))), np.tile(model.P0, (2, 1, 1))
    at = Interval(np.ones(2, int), np.zeros((2, 2)), None, np.zeros((2, 0)))
    seen, y, factor = np.array([[True, True, False, True]] * 2), np.zeros((2, 4)), np.ones((2, model.z.stop, 4))
    y[1, 2], factor[1, :, 2] = 77.0, 5.0
    X[1] = X[0]
    c = gain_filter.corrected(model, X, P, at, y, seen, factor)
    total = gain_filter.added(model, np.zeros((2, gain_filter.layout(model, STRIDE).moved.start)), c, factor)
    assert np.array_equal(c.X[0], c.X[1])
    assert np.array_equal(total[0], total[1])
    assert not c.nu[:, 2].any()
    silent = gain_filter.corrected(model, X, P, at, y, np.zeros_like(seen), factor)
    assert np.array_equal(silent.X, X)


def test_an_estimate_that_is_lost_begins_again_and_one_that_is_far_off_is_stopped():
    model = nominal("B747Lateral").model
    X, P = np.stack([np.full(len(model.X0), np.nan), 1e9 * model.scale]), np.tile(model.P0, (2, 1, 1))
    at = Interval(np.ones(2, int), np.zeros((2, 2)), None, np.zeros((2, 0)))
    c = gain_filter.corrected(model, X, P, at, np.zeros((2, 4)), np.zeros((2, 4), bool), np.ones((2, model.z.stop, 4)))
    assert np.array_equal(c.X[0], model.X0)
    assert np.allclose(c.X[1], model.X0 + gain_filter.FARTHEST * model.scale)
    assert not c.kept.any()


@pytest.mark.parametrize("plant_id", ["B747Lateral", "ThreeTank", "MissilePitch"])
def test_it_runs_on_numpy_as_torch_trains_it(plant_id):
    plant, obs = build(plant_id), flown(plant_id, 15 * STRIDE)
    obs[0, 10:14, 0], obs[1, 20:30, : len(plant.outputs)] = np.nan, np.nan
    net = network(plant_id, spread=0.5)
    told = np.tile(np.eye(2)[0], (3, 15, 1))
    x = torch.from_numpy(np.concatenate([obs.reshape(3, 15, -1), told], axis=2))
    with torch.inference_mode():
        logits, mean, log_std, _ = (a.numpy() for a in net(x))
    said, at = run(diagnoser(plant_id, net), obs), slice(STRIDE - 1, None, STRIDE)
    n_x = len(plant.states)
    assert np.allclose(said.label_probs[:, at], np.exp(probabilities.log_softmax(logits)), atol=1e-9)
    assert np.allclose(deviation(plant, said.estimate[:, at]), mean[..., n_x:], atol=1e-9)
    unit = np.array([s.scale for s in plant.estimated])
    assert np.allclose(said.estimate_std[:, at] / unit, np.exp(log_std[..., n_x:]))
    assert np.array_equal(said.label[:, STRIDE:][:, at], logits[:, 1:].argmax(axis=2))


@pytest.mark.parametrize("path", COMMITTED, ids=lambda p: p.stem)
def test_shipped_weights_run_as_they_were_trained(path):
    card = weights.read_card(path)
    plant, stride = build(card.plant), card.shape["stride"]
    tensors, _ = weights.read(path, plant)
    found = gain_net.nominal_of(plant, {name: a.astype(float) for name, a in tensors.items()}, stride)
    net = GainNetwork(found, stride, len(plant.labels), card.shape["hidden"], len(card.processes)).double()
    net.load_state_dict({name: torch.from_numpy(tensors[f"network.{name}"]) for name in net.state_dict()})
    record = flights.fly(plant, Condition(card.processes[0], {}), range(VALIDATION, VALIDATION + 3))
    obs = record.obs[:, : 30 * stride]
    told = np.tile(np.eye(len(card.processes))[0], (3, 30, 1))
    with torch.inference_mode():
        logits, mean, _, _ = (
            a.numpy() for a in net(torch.from_numpy(np.concatenate([obs.reshape(3, 30, -1), told], axis=2)))
        )
    said, at = run(make_diagnoser("gain_net", plant), obs), slice(stride - 1, None, stride)
    assert np.array_equal(said.label[:, at], logits.argmax(axis=2))
    assert np.allclose(deviation(plant, said.estimate[:, at]), mean[..., len(plant.states) :], atol=1e-6)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gain")
    return GainTraining("gain_net", build("B747Lateral"), SMALL, seed=1, work=folder).run()


def test_a_resumed_run_ends_with_the_same_bytes(tiny, tmp_path):
    for stop in (1, None):
        path = GainTraining("gain_net", build("B747Lateral"), SMALL, seed=1, work=tmp_path).run(stop_after=stop)
    assert path.read_bytes() == tiny.read_bytes()
    assert weights.read_card(path).shape == {"stride": STRIDE, "hidden": SMALL.hidden}


def test_a_few_steps_of_training_move_gains_and_labels(tiny):
    tensors = load_file(tiny)
    assert np.abs(tensors["network.gain.weight"]).max() > 0
    assert set(weights.read_card(tiny).calibration) == {"standard", "hard"}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: {k: v for k, v in t.items() if k != "filter.belief.Q"}, "lacks the tensor filter.belief.Q"),
        (lambda t: t | {"filter.belief.sensors": np.array([0.0, 1.0, 2.0, 9.0])}, "holds no filter of B747Lateral"),
        (lambda t: t | {"network.gain.bias": np.zeros(3, np.float32)}, "has the shape"),
    ],
    ids=["missing", "sensor", "shape"],
)
def test_tensors_that_are_not_the_networks_are_refused(tiny, tmp_path, change, reason):
    with pytest.raises(weights.RefusedError, match=reason):
        make_diagnoser("gain_net", build("B747Lateral"), path=str(altered(tiny, tmp_path, change)))


def test_a_state_on_a_manifold_is_none_of_its_business():
    plant = build("CMGSatellite")
    with pytest.raises(NotApplicableError, match="quaternion"):
        gain_net.nominal_of(plant, fit_belief(plant, "standard"), STRIDE)
