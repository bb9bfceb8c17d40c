"""PCA, dynamic PCA and canonical variates: streams as in training, rates as designed, reconstruction, weights checked."""

import numpy as np
import pytest
from conftest import build, states
from safetensors.numpy import load_file, save_file

from baselines.learned import blocks, monitoring, weights
from baselines.learned.flights import VALIDATION, Condition, fly
from baselines.learned.monitoring import METHODS, Moments, canonical, labelled, monitor_filter, subspaces
from fdi_gym.diagnosis import NotApplicableError, make_diagnoser, run, train
from fdi_gym.files import RefusedError

STANDARD = Condition("standard", {})
SHIPPED = sorted(path for path in weights.WEIGHTS.glob("*.safetensors") if path.stem.split("-")[0] in METHODS)


def monitor_of(path, process="standard"):
    tensors, card = load_file(path), weights.read_card(path)
    process = process if process in card.processes else card.processes[0]
    return card, monitoring.Monitor(*(tensors[f"{process}.{name}"].astype(float) for name in monitoring.Monitor._fields))


@pytest.mark.parametrize("method", METHODS)
def test_a_stream_is_watched_as_whole_flights_were(method, b747):
    card, m = monitor_of(weights.WEIGHTS / f"{method}-B747Lateral.safetensors")
    stride, length = card.shape["stride"], card.shape["length"]
    record = fly(b747, STANDARD, range(VALIDATION + 70_000, VALIDATION + 70_003))
    v, _ = labelled(b747, record, stride, length)
    w = (v - m.mean) @ m.factor.T
    a = int(m.first)
    filter = monitor_filter(b747, stride, length, m, (1,))
    found = [s for k, s in enumerate(states(b747, filter, record.obs)) if (k + 1) % stride == 0][length - 1 :]
    assert len(found) == v.shape[1]
    assert np.allclose([s.T2 for s in found], (w[..., :a] ** 2).sum(axis=2).T, rtol=1e-9)
    assert np.allclose([s.SPE for s in found], (w[..., a:] ** 2).sum(axis=2).T, rtol=1e-9)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_limits_are_exceeded_as_often_as_designed(path):
    """One healthy step in a hundred, on flights that nothing was fitted to.

    The satellite's exceedances come in a few flights of a hundred, too many to fly here: an upper bound only.
    """
    card, m = monitor_of(path)
    plant = build(card.plant)
    condition = Condition(card.processes[0], {k: v for k, v in card.options[0].items() if plant.options.get(k) != v})
    first, count = VALIDATION + 71_000, 12 if card.plant == "CMGSatellite" else 60
    own = monitoring.data.plant_under(plant, condition)
    v = monitoring._healthy(own, condition, first, count, card.shape["stride"], card.shape["length"])
    w = (v - m.mean) @ m.factor.T
    a = int(m.first)
    for part in (slice(a), slice(a, None)):
        rate = ((w[:, part] ** 2).sum(axis=1) > 1.0).mean()
        assert (0.0 if card.plant == "CMGSatellite" else 0.001) <= rate < 0.03, rate


def test_subspaces_whiten_and_share_the_variance():
    rng = np.random.default_rng(0)
    mix = rng.standard_normal((6, 6)) * [1, 1, 1, 0.05, 0.05, 0.05]
    S = mix @ mix.T
    first, second = subspaces(S)
    assert np.allclose(first @ S @ first.T, np.eye(len(first)), atol=1e-8)
    assert np.allclose(first @ S @ second.T, 0.0, atol=1e-8)
    assert len(first) + len(second) == 6
    std = np.sqrt(np.diag(S))
    assert 1 - np.trace(second @ S @ second.T) / 6 >= monitoring.KEPT
    assert np.allclose((second * std) @ (second * std).T, np.eye(len(second)))


def test_canonical_variates_of_an_autoregression():
    """One channel that follows its past and one that does not: the first variate is the former, with its correlation."""
    rng, a = np.random.default_rng(1), 0.9
    x = np.zeros((200, 400))
    for k in range(1, 400):
        x[:, k] = a * x[:, k - 1] + np.sqrt(1 - a**2) * rng.standard_normal(200)
    z = np.stack([x, rng.standard_normal(x.shape)], axis=2)
    v = blocks.windows(z, 2).reshape(-1, 4)
    first, second = canonical(np.cov(v.T), 2, 2)
    assert first.shape == (1, 2)
    assert abs(first[0, 0]) == pytest.approx(1.0, rel=0.05)
    assert abs(first[0, 1]) < 0.05
    assert second.shape == (1, 2)


def test_moments_are_those_of_all_windows():
    rng = np.random.default_rng(2)
    v = rng.standard_normal((50, 3)) + 1.0
    m = Moments().plus(v[:20]).plus(v[20:])
    about = np.array([0.5, -1.0, 2.0])
    assert np.allclose(m.about(about), (v - about).T @ (v - about) / 50)


def test_a_labels_own_direction_is_explained_by_it_alone(b747):
    """A window displaced along one: that label's cost falls by the displacement, health's rises."""
    card, m = monitor_of(weights.WEIGHTS / "dynamic_pca-B747Lateral.safetensors")
    j = 2
    w = 30.0 * m.basis[j, :, 0]
    v = m.mean + np.linalg.pinv(m.factor) @ w
    stride, length = card.shape["stride"], card.shape["length"]
    window = v.reshape(length, -1)[::-1]
    scale, nominal = (np.array([getattr(s, name) for s in b747.observed]) for name in ("scale", "nominal"))
    obs = np.repeat(window * scale + nominal, stride, axis=0)[None]
    filter = monitor_filter(b747, stride, length, m, (1,))
    *_, s = states(b747, filter, obs)
    cost = filter.read(s).cost[0]
    assert cost[j] == cost.min()
    assert cost[j] < -100.0
    assert s.T2[0] + s.SPE[0] == pytest.approx(900.0, rel=0.05)


def test_a_window_with_a_hole_says_nothing(b747):
    card, m = monitor_of(weights.WEIGHTS / "dynamic_pca-B747Lateral.safetensors")
    stride, length = card.shape["stride"], card.shape["length"]
    obs = fly(b747, STANDARD, [VALIDATION + 70_010]).obs[:, : 4 * stride * length].copy()
    hole = 2 * stride * length
    obs[:, hole : hole + stride, 1] = np.nan
    after = [s.T for s in states(b747, monitor_filter(b747, stride, length, m, (1,)), obs)]
    moved = [not np.array_equal(x, y) for x, y in zip(after[1:], after[:-1], strict=True)]
    quiet = moved[hole : hole + stride * length - 1]
    assert not any(quiet)
    assert any(moved[: hole - 1])
    assert any(moved[hole + stride * (length + 1) :])


@pytest.mark.parametrize("method", METHODS)
def test_training_is_reproducible_and_names_its_seeds(method, b747, tmp_path):
    one, two = (train(method, b747, budget=8, work=tmp_path / name) for name in "ab")
    assert one.read_bytes() == two.read_bytes()
    card = weights.read_card(one)
    assert card.seeds["training"][0] == 3_000_000
    assert set(card.curve[-1]["above the limits"]) == {"standard", "hard"}
    said = run(make_diagnoser(method, b747, path=str(one)), fly(b747, STANDARD, [VALIDATION + 70_020]).obs[:, :200])
    assert said.alarm.shape == (1, 200)


def test_health_is_learned_from_healthy_windows_alone(b747, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(monitoring, "labelled", lambda *a: seen.append(labelled(*a)) or seen[-1])
    _, m = monitor_of(train("pca", b747, budget=4, work=tmp_path))
    v, label = seen[0]
    assert 0.2 < (label > 0).mean() < 0.8
    assert np.allclose(m.mean, v[label == 0].mean(axis=0), rtol=1e-5, atol=1e-6)


def test_weights_that_do_not_fit_are_refused(b747, tmp_path):
    path = train("pca", b747, budget=4, work=tmp_path)
    tensors, card = load_file(path), weights.read_card(path)
    for name, value in (("standard.mean", np.zeros(3)), ("hard.basis", np.zeros((5, 2, 6))), ("more", np.zeros(1))):
        weights.write(path, {**tensors, name: value}, card)
        with pytest.raises(RefusedError):
            make_diagnoser("pca", b747, path=str(path))
    save_file(tensors, path)
    with pytest.raises(RefusedError, match="digest"):
        make_diagnoser("pca", b747, path=str(path))


def test_bad_settings(b747, motor):
    with pytest.raises(ValueError, match="unknown method"):
        make_diagnoser("pca", b747, method="ica")
    with pytest.raises(ValueError, match="paces"):
        make_diagnoser("pca", b747, paces=())
    with pytest.raises(NotApplicableError, match="fdi-gym train pca DCMotor"):
        make_diagnoser("pca", motor)
