"""Pictures: every plant in every task, flights with many methods, what a suite comes to, and the command that draws them."""

import warnings

import numpy as np
import pytest
from conftest import PLANTS, ROOT, build

from fdi_gym import cli, curves, palette, plots
from fdi_gym.diagnosis import Decisions, make_diagnoser, run
from fdi_gym.engine import simulate
from fdi_gym.faults import draw
from fdi_gym.leaderboard import read_board

RESULTS = str(ROOT / "leaderboards" / "results")


def lightness(colour):
    """Relative luminance of a colour."""
    parts = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def deuteranope(colour):
    """How who lacks the green cones sees a colour: linear RGB, Viénot, Brettel & Mollon (1999)."""
    parts = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]]) @ linear


def test_lines_differ_in_colour_and_dashes():
    lines = [palette.line(i) for i in range(2 * len(palette.LINES))]
    assert len(set(lines)) == len(lines)
    assert len({dashes for _, dashes in lines[: len(palette.LINES)]}) == len(palette.LINES)


def test_neighbouring_colours_are_told_apart_without_green_cones():
    for a, b in zip(palette.LINES[:-2], palette.LINES[1:], strict=False):
        assert np.abs(deuteranope(a) - deuteranope(b)).max() > 0.1, (a, b)
    assert all(lightness(c) < 0.5 for c in palette.LINES)  # to be seen on white
    assert lightness(palette.SHADE) > 0.7


def titles(figure):
    return [axis.get_title(loc="left") for axis in figure.axes]


def canvas_of(plant, task, k, declared):
    canvas = plots.Canvas(plant, task)
    record = simulate(plant, [draw(plant.process("standard"), 1).replace(steps=60)])
    picture = canvas.draw(record, k, declared)
    return canvas, record, picture


def answer(plant, task):
    n = len(plant.estimated)
    return {"isolation": 0, "identification": plant.healthy, "diagnosis": np.r_[0, plant.healthy],
            "scenario": np.zeros((len(plant.modes), 4))}[task] if n else None  # fmt: skip


@pytest.mark.parametrize("task", ["isolation", "identification", "diagnosis", "scenario"])
def test_every_sensor_and_entry_has_a_panel_with_its_unit(plant, task):
    canvas, *_ = canvas_of(plant, task, 40, [(40, answer(plant, task))])
    said = titles(canvas.figure)
    entries = plant.estimated if task in ("identification", "diagnosis") else ()
    for signal in (*plant.outputs, *entries):
        assert (f"{signal.name} [{signal.unit}]" if signal.unit else signal.name) in said
    assert len(said) == len(plant.outputs) + len(entries) + (task != "identification")


@pytest.mark.parametrize("plant_id", PLANTS)
def test_panels_lie_within_the_picture_and_apart(plant_id):
    canvas, _, picture = canvas_of(build(plant_id), "diagnosis", 40, [(40, answer(build(plant_id), "diagnosis"))])
    boxes = [axis.get_window_extent() for axis in canvas.figure.axes]
    for i, a in enumerate(boxes):
        assert 0 <= a.x0 < a.x1 <= picture.shape[1]
        assert 0 <= a.y0 < a.y1 <= picture.shape[0]
        assert not any(a.overlaps(b) for b in boxes[:i])
    renderer = canvas.figure.canvas.get_renderer()
    for axis in canvas.figure.axes:  # names of labels, too
        assert all(text.get_window_extent(renderer).x0 >= 0 for text in axis.get_yticklabels() if text.get_text())


def test_a_right_none_is_seen_beside_the_truth(b747):
    """The declared label is drawn below the truth and is wider: both are seen where they agree."""
    canvas, _, right = canvas_of(b747, "isolation", 40, [(k, 0) for k in range(1, 41)])
    _, _, silent = canvas_of(b747, "isolation", 40, [])
    said, truth = np.array([int(palette.LINES[1][i : i + 2], 16) for i in (1, 3, 5)]), 0
    assert (right == said).all(axis=-1).sum() > (silent == said).all(axis=-1).sum() + 300
    lines = canvas.answer.get_lines()
    assert [line.get_zorder() for line in lines] == sorted(line.get_zorder() for line in lines)
    assert lines[-1].get_color() == palette.INK
    assert (right == truth).all(axis=-1).sum() > 200


def test_nothing_of_the_flight_is_drawn_beyond_the_sample(b747):
    """A flight's later samples don't show: the picture is that of a flight which ends here."""
    record = simulate(b747, [draw(b747.process("standard"), 4).replace(steps=400)])
    cut = record._replace(obs=record.obs[:, :201], label=record.label[:, :201], target=record.target[:, :201])
    for task in ("isolation", "identification", "diagnosis"):
        whole, short = (plots.Canvas(b747, task).draw(r, 200, []) for r in (record, cut))
        np.testing.assert_array_equal(whole, short)


@pytest.fixture(scope="module")
def flown():
    plant = build("B747Lateral")
    record = simulate(plant, [draw(plant.process("standard"), seed).replace(steps=400) for seed in (2, 3)])
    names = ("two_stage_kf_exponential", "augmented_ekf", "windowed_nis", "null")
    return plant, record, {name: run(make_diagnoser(name, plant), record.obs, signals=True) for name in names}


def test_a_flight_shows_each_method_in_a_line_of_its_own_below_the_truth(flown):
    plant, record, said = flown
    figure = plots.flight(plant, record, said, 1, sensors=True)
    assert len(figure.axes) == 1 + len(plant.estimated) + len(plant.outputs)
    for axis in figure.axes[1 : 1 + len(plant.estimated)]:
        colours = [line.get_color() for line in axis.get_lines()]
        assert colours[-1] == palette.INK
        assert len(set(colours)) == len(colours)
        truth = axis.get_lines()[-1]
        assert all(truth.get_zorder() > line.get_zorder() for line in axis.get_lines()[:-1])
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["a fault acts", "truth", *said]


def test_a_flight_says_what_was_declared(flown):
    """The bars of a method, put together, are its labels sample by sample."""
    plant, record, said = flown
    figure = plots.flight(plant, record, said)
    names = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    found = np.full(record.length[0] + 1, -1)
    for bar in figure.axes[0].patches:
        if bar.get_facecolor()[:3] == tuple(np.array([0, 0x72, 0xB2]) / 255):
            first, stop = (round(x / plant.dt) for x in (bar.get_x(), bar.get_x() + bar.get_width()))
            found[first + 1 : stop + 1] = [x.name for x in plant.labels].index(
                names[round(bar.get_y() + bar.get_height() / 2)]
            )
    np.testing.assert_array_equal(found[1:], said["two_stage_kf_exponential"].label[0, 1 : record.length[0] + 1])


def test_signals_are_shown_or_it_is_said_that_there_are_none(flown):
    plant, record, said = flown
    assert titles(plots.method_signals(plant, record, said["windowed_nis"])) == ["NIS", "limit of the mean"]
    with pytest.raises(ValueError, match="no signals"):
        plots.method_signals(plant, record, said["null"])


def test_a_residual_shares_its_panel_with_its_threshold(flown):
    plant, record, said = flown
    shape = (*record.label.shape, 2)
    both = {
        "residual": np.random.default_rng(0).standard_normal(shape),
        "threshold": np.full(shape, 3.0),
        "x": np.zeros(shape),
    }
    made = Decisions(*said["null"][:6], signals=both)
    figure = plots.method_signals(plant, record, made)
    assert titles(figure) == ["residual 0", "residual 1", "x"]
    levels = {float(v) for line in figure.axes[0].get_lines()[1:] for v in np.unique(line.get_ydata())}
    assert levels == {-3.0, 3.0}


@pytest.fixture(scope="module")
def board():
    return read_board(ROOT / "leaderboards" / "results" / "b747-standard")


def test_curves_carry_bands_and_numbers(board):
    names = [row.diagnoser for row in board.honest()][:3]
    of = {kind: {n: curves.delay_curve(board.outcomes[n], kind, board.plant.dt) for n in names}
          for kind in ("detection", "isolation")}  # fmt: skip
    figure = plots.delays(of)
    for axis, kind in zip(figure.axes, of, strict=True):
        assert len(axis.get_lines()) == len(axis.collections) == len(names)
        for name in names:
            assert str(int(of[kind][name].count[0])) in axis.get_title(loc="left")
    assert [text.get_text() for text in figure.legends[0].get_texts()] == names
    bands = plots.severities(
        {n: curves.severity_curve(board.outcomes[n], "per_decision") for n in names}, ("a", "b", "c"), "x"
    )
    assert all("n " in text.get_text() for text in bands.axes[0].get_xticklabels())


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [*((kind, "svg") for kind in ("flight", "signals", "confusion", "delay", "severity", "ranking")), ("confusion", "png")],
)
def test_the_command_draws_every_kind(tmp_path, capsys, kind, suffix):
    target = tmp_path / f"x.{suffix}"
    methods = ["--methods", "windowed_nis"] if kind == "signals" else []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cli.main(["plot", kind, "b747-standard", "-o", str(target), "--results", RESULTS, *methods])
    assert str(target) in capsys.readouterr().out
    assert target.read_bytes()[:5] == {"png": b"\x89PNG\r", "svg": b"<?xml"}[suffix]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["confusion", "b747-standard", "--methods", "augmented_efk"], "did you mean augmented_ekf"),
        (["confusion", "b747-standard", "--methods", "null", "random"], "confusion shows one method, not 2"),
        (["flight", "b747-standard", "--flight", "250"], "has the flights 0 to 249, not 250"),
        (["signals", "b747-standard", "--methods", "null"], "no signals"),
        (["ranking", "b747-standard", "-o", "x.doc"], "a picture is png, svg or pdf, not '.doc'"),
        (["ranking", "b747-standard", "--results", "."], "there is no row"),
        (["ranking", "b747-standart"], "did you mean b747-standard"),
    ],
)
def test_what_cannot_be_drawn_is_said_in_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        cli.main(["plot", "--results", RESULTS, *arguments])
    err = capsys.readouterr().err
    assert ended.value.code == 2
    assert message in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())
