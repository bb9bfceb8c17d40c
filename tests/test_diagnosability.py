"""What can be told apart: information against its definition, laws of the measures, and the order of real confusions."""

import json

import numpy as np
import pytest
from conftest import ROOT, build
from scipy.stats import spearmanr
from test_general_filters import belief_of

from fdi_gym import cli
from fdi_gym.diagnosability import NEEDED, diagnosability, drawn, information, of_size
from fdi_gym.diagnosis.fitting import flights_of
from fdi_gym.estimation.augmented import augmented
from fdi_gym.estimation.linear import linear_model
from fdi_gym.estimation.parity import stacked


@pytest.fixture(scope="module")
def found():
    return diagnosability(build("B747Lateral"), belief=belief_of(build("B747Lateral")))


def test_information_is_that_of_the_whole_record_at_once(b747):
    """T' (S + O P0 O')^-1 T of all samples after the onset, stacked."""
    belief, s = belief_of(b747), 12
    model = augmented(b747, belief)
    record = flights_of(b747, "standard", 620_000, 2, False)[1]
    (G,) = information(b747, model, belief.z_size, record, 0, np.array([s]))
    linear = linear_model(b747)
    u = b747.split(record.obs)[1][:, 1 : s + 1]
    E = np.stack([linear.E(u[:, i]) for i in range(s)], axis=1)
    n = len(u)
    w = stacked(
        np.tile(linear.A, (n, s, 1, 1)), E, np.zeros((n, s, 4, 0)), np.tile(belief.Q, (n, s, 1, 1)),
        np.tile(linear.C, (n, s + 1, 1, 1)), np.zeros((n, s + 1, 4, 4)), belief.R, np.ones((n, s + 1, 4), bool),
    )  # fmt: skip
    late = slice(4, None)
    for i in range(n):
        S = (w.S[i] + w.O[i] @ belief.P0 @ w.O[i].T)[late, late]
        assert np.allclose(G[i], w.T[i, late].T @ np.linalg.solve(S, w.T[i, late]), rtol=1e-8)


def test_time_and_size_help(found):
    """More samples never say less of one fault against health, nor does a larger fault; a bound never rises."""
    against_none = found.divergence[..., 0]
    assert (np.diff(against_none, axis=0) > -1e-9).all()
    assert (np.diff(found.bound, axis=0) < 1e-12).all()
    loe = [found.labels[1:].index(name) for name in ("aileron LOE", "rudder LOE")]
    assert (np.diff(against_none[:, loe], axis=2) > -1e-9).all()
    after = found.told_apart()
    assert (after[loe, 2, 0] >= after[loe, 6, 0]).all()
    assert np.isnan(after[0, 0, 1])
    assert np.nanmin(after) > 0


def test_a_label_is_no_nearer_than_health_where_it_holds_faults_next_to_it(found):
    """Every divergence is 0 or more, and told apart means that NEEDED nats are reached."""
    assert (found.divergence[~np.isnan(found.divergence)] >= 0).all()
    after, i, j = found.told_apart(), 1, 0
    k = list(found.seconds).index(after[i, 4, j])
    assert found.divergence[k, i, 4, j] >= NEEDED
    assert k == 0 or found.divergence[k - 1, i, 4, j] < NEEDED


def test_bound_is_attained_by_weighted_least_squares(b747):
    """A stuck aileron's position from noisy flights, everything else known: spread of the estimate over many draws."""
    belief, s = belief_of(b747), 30
    model = augmented(b747, belief)
    record = flights_of(b747, "standard", 620_000, 1, False)[1]
    G = information(b747, model, belief.z_size, record, 0, np.array([s]))[0, 0]
    linear, rng, N = linear_model(b747), np.random.default_rng(0), 4000
    x = rng.multivariate_normal(np.zeros(4), belief.P0, N)  # the deviation from the model's path, fault-free
    X, P, M, g, b = np.zeros((N, 4)), belief.P0, np.zeros(4), np.zeros(N), linear.E0[:, 2]
    for _ in range(s):
        x = x @ linear.A.T + rng.multivariate_normal(np.zeros(4), belief.Q, N) + 2.0 * b
        y = x + rng.multivariate_normal(np.zeros(4), belief.R, N)
        X, P, M = X @ linear.A.T, linear.A @ P @ linear.A.T + belief.Q, linear.A @ M + b
        S = P + belief.R
        nu, K = y - X, P @ np.linalg.inv(S)
        g += nu @ np.linalg.solve(S, M)
        X, P, M = X + nu @ K.T, P - K @ P, M - K @ M
    estimate = g / G[2, 2]
    assert estimate.mean() == pytest.approx(2.0, abs=5 / np.sqrt(G[2, 2] * N))
    assert estimate.std() == pytest.approx(G[2, 2] ** -0.5, rel=0.06)


@pytest.mark.parametrize("row", ["multiple_model_ekf", "bayes_bank"])
def test_agrees_in_order_with_the_confusions_of_good_methods(found, row):
    path = ROOT / "leaderboards" / "results" / "b747-standard" / f"{row}.json"
    confusion = np.array(json.loads(path.read_bytes())["metrics"]["per_sample"]["confusion"], float)[1:, :5]
    pairs = ~np.isnan(found.divergence[-1, :, 0])
    said = confusion / confusion.sum(axis=1, keepdims=True)
    assert spearmanr(found.confusions()[pairs], said[pairs]).statistic > 0.7


def test_sizes_are_those_that_the_process_draws(b747):
    values = drawn(b747, "standard")
    for mode, own in zip(b747.modes, values, strict=True):
        assert (own >= mode.reaches[:, 0]).all()
        assert (own <= mode.reaches[:, 1]).all()
        assert (np.diff(np.abs(own), axis=0) >= 0).all()
    assert of_size(values[0], 0.0) == (values[0][0], values[0][0])
    first = of_size(values[1], 0.5)
    assert first[0] == -first[1]


def test_every_plant(plant):
    """Shares sum to one, every label is in the text."""
    dt = plant.dt
    found = diagnosability(plant, belief=belief_of(plant), flights=2, seconds=60 * dt)
    assert np.allclose(found.confusions().sum(axis=1), 1.0)
    assert np.isfinite(found.bound[-1]).any()
    for name in (*found.labels, *found.magnitudes):
        assert name in found.text()


def test_command_line(capsys, tmp_path):
    picture = tmp_path / "b747.png"
    cli.main(["diagnosability", "B747Lateral", "--flights", "2", "--seconds", "5", "--picture", str(picture)])
    assert "hardest to tell from" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["B747Latera"], "unknown plant"),
        (["B747Lateral", "--process", "strange"], "strange"),
        (["B747Lateral", "--seconds", "0"], "after the onset"),
        (["B747Lateral", "--seconds", "1e6"], "after the onset"),
        (["B747Lateral", "--seconds", "nan"], "after the onset"),
        (["B747Lateral", "--flights", "0"], "at least 1 flight"),
        (["B747Lateral", "--picture", "a.txt"], ".png"),
    ],
)
def test_bad_input_is_one_line(capsys, arguments, message):
    with pytest.raises(SystemExit) as stopped:
        cli.main(["diagnosability", *arguments])
    assert stopped.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
