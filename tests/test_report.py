"""The report: one file that says what the rows say, does no harm, fits, and works in a reader's browser."""

import base64
import json
import re
import zlib

import msgspec
import numpy as np
import pytest
from browser import CHROMIUM, Browser
from conftest import ROOT

from fdi_gym import cli, curves, tables
from fdi_gym.engine import simulate
from fdi_gym.evaluation import evaluate
from fdi_gym.leaderboard import Board
from fdi_gym.metrics import Decision, Onset
from fdi_gym.report import LARGEST, html, report
from fdi_gym.report.flown import EMPTY, Budget, Line, chosen, pack, thin
from fdi_gym.report.page import embedded
from fdi_gym.scores import delay_quartiles
from fdi_gym.suite import load_suite

METHODS = ("null", "random", "augmented_ekf", "two_stage_kf_exponential", "windowed_nis")
SHOWN = ("augmented_ekf", "two_stage_kf_exponential", "windowed_nis")
EVIL = "</script><script>window.harmed = 1</script><img src=x onerror=window.harmed=2>&amp;\u2028'\""


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    suite = load_suite("b747-standard").head(30)
    found = evaluate(suite, METHODS, work=tmp_path_factory.mktemp("work"), jobs=1, progress=False)
    rows = [f.row for f in found.values()]
    return Board(suite, suite.build(), rows, {n: f.outcomes for n, f in found.items()}, dict.fromkeys(found, 1.5))


@pytest.fixture(scope="module")
def page(board):
    return report(board, SHOWN, 6, progress=False)


def data_of(page):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)[1])


def unpacked(block):
    """The lines of a block by (kind, name), as the page reads them."""
    raw, place, found = zlib.decompress(base64.b64decode(block["packed"])), 0, {}
    for kind, name, _, low, step, count, _ in block["heads"]:
        values = np.frombuffer(raw, "<u2", count, place)
        place += 2 * count
        found[kind, name] = np.where(values == EMPTY, np.nan, low + step * values)
    assert place == len(raw)
    return found


# ---------------------------------------------------------------------------------------------------------------
# What it says


def test_the_page_is_the_same_at_every_call(board, page):
    assert report(board, SHOWN, 6, progress=False) == page


def test_the_table_says_what_the_rows_say(board, page):
    data = data_of(page)
    keys = [column["key"] for column in data["columns"]]
    assert [m["name"] for m in data["methods"][:1]] == [board.best().diagnoser]
    for method in data["methods"]:
        row = next(row for row in board.rows if row.diagnoser == method["name"])
        line = tables.Line(row, 1.5, method["cells"][keys.index("tied")] == "=", board.attainable())
        assert method["cells"] == [tables.COLUMNS[key][1](line) for key in keys]
        assert method["confusion"]["per_decision"] == row.metrics["per_decision"]["confusion"]


def test_comparisons_are_antisymmetric_and_in_the_order_of_the_scores(page):
    data = data_of(page)
    for kind, found in data["compared"].items():
        gap = np.array(found["gap"])
        np.testing.assert_allclose(gap, -gap.T, atol=1e-9)
        scores = [next(m for m in data["methods"] if m["name"] == name)["score"][kind][0] for name in found["names"]]
        assert scores == sorted(scores, reverse=True)
        assert len(found["names"]) >= 2


def test_flights_are_those_of_the_suite(board, page):
    """Truth and labels of an embedded flight are those that the engine gives for its number."""
    flown = data_of(page)["flown"]
    numbers = [f["number"] for f in flown["flights"]]
    record = simulate(board.plant, board.suite.scenarios(board.plant, numbers))
    for i, flight in enumerate(flown["flights"]):
        label = np.concatenate([np.full(b - a, v) for a, b, v in flight["label"]])
        np.testing.assert_array_equal(label, record.label[i, : record.length[i] + 1])
        lines = unpacked(flight["lines"])
        for j, signal in enumerate(board.plant.outputs):
            whole = record.obs[i, : record.length[i] + 1, j]
            found = lines["sensor", signal.name]
            step = (whole.max() - whole.min()) / EMPTY
            assert abs(found.max() - whole.max()) <= step
            assert abs(found.min() - whole.min()) <= step
    assert {board.plant.labels[v].name for f in flown["flights"] for *_, v in f["label"]} == {
        x.name for x in board.plant.labels
    }


def test_a_flight_has_what_the_methods_say_of_it(page):
    flown = data_of(page)["flown"]
    assert flown["methods"] == list(SHOWN)
    said = flown["flights"][0]["said"]
    kinds = {name: {head[0] for head in of["lines"]["heads"]} for name, of in said.items()}
    assert {"estimate", "deviation", "residual"} <= kinds["augmented_ekf"]
    assert {"signal", "residual"} <= kinds["windowed_nis"]


def test_residuals_are_small_where_the_estimate_is_right(board, page):
    """Post-fit residuals of a healthy flight are about the sensors' noise: signs and states are those of the model."""
    flown = data_of(page)["flown"]
    healthy = next(f for f in flown["flights"] if all(v == 0 for *_, v in f["label"]))
    lines = unpacked(healthy["said"]["augmented_ekf"]["lines"])
    for signal in board.plant.outputs:
        assert np.std(lines["residual", signal.name]) < 2 * signal.sigma


def test_flights_to_look_at_have_all_labels_and_are_chosen_once(board):
    for count in (0, 5, 30):
        found = chosen(board, count)
        assert len(set(found)) == count
    labels = {d.label for i in chosen(board, 5) for d in board.outcomes["null"][i].decisions}
    assert labels == set(range(5))


@pytest.mark.parametrize("samples", [1, 2, 7, 100, 1201])
def test_thinned_lines_keep_their_extremes(samples):
    values = np.random.default_rng(samples).standard_normal(samples)
    values[::5] = np.nan
    found = thin(values, 60)
    assert len(found) == min(samples, 60)
    if np.isfinite(values).any():
        assert np.nanmax(found) == np.nanmax(values)
        assert np.nanmin(found) == np.nanmin(values)


def test_packed_lines_come_back_to_sixteen_bits():
    wave = np.sin(np.linspace(0, 6, 50)) * 1e3
    wave[7] = np.nan
    found = unpacked(pack([Line("sensor", "a", "m", wave), Line("sensor", "b", "", np.full(50, 3.0)),
                           Line("signal", "c", "", np.full(9, np.nan))], 600))  # fmt: skip
    np.testing.assert_allclose(found["sensor", "a"], wave, atol=2e3 / EMPTY)
    assert (found["sensor", "b"] == 3.0).all()
    assert np.isnan(found["signal", "c"]).all()


# ---------------------------------------------------------------------------------------------------------------
# Curves


def flight_with(outcome, *onsets):
    return msgspec.structs.replace(outcome, onsets=list(onsets))


def test_delay_curves_pass_the_quartiles_of_the_rows(board):
    for row in board.rows:
        for kind, key in (("detection", "delay_quartiles"), ("isolation", "isolation_delay_quartiles")):
            curve = curves.delay_curve(board.outcomes[row.diagnoser], kind, board.plant.dt)
            shown = list(zip(np.round(curve.x / board.plant.dt).astype(int), 1 - curve.share, strict=True))
            assert delay_quartiles(shown[1:-1], board.plant.dt) == pytest.approx(row.metrics["detection"][key])
            assert ((curve.low <= curve.share + 1e-12) & (curve.share <= curve.high + 1e-12)).all()


def test_a_delay_curve_by_hand(board):
    """Four faults of 10 samples: two show after 2 and 4, one is cut off unseen after 3, one never shows."""
    outcome = board.outcomes["null"][0]
    made = [Onset(1, 10, True, False, False, 2, None), Onset(1, 10, True, False, False, 4, None),
            Onset(1, 3, True, False, False, None, None), Onset(1, 10, True, False, False, None, None),
            Onset(1, 10, True, True, False, None, None), Onset(1, 10, False, False, False, None, None)]  # fmt: skip
    curve = curves.delay_curve([flight_with(outcome, onset) for onset in made], "detection", 0.5)
    assert curve.x.tolist() == [0.0, 1.0, 2.0, 5.0]
    assert curve.share == pytest.approx([0.0, 0.25, 1 - 0.75 * 0.5, 1 - 0.75 * 0.5])
    assert curve.count.tolist() == [4, 4, 2, 1]


def test_severity_and_label_curves_agree_with_the_rows(board):
    for row in board.rows:
        outcomes = board.outcomes[row.diagnoser]
        for kind in ("per_sample", "per_decision"):
            bands = [row.metrics["accuracy_by_severity"][band][kind] for band in ("small", "medium", "large")]
            assert curves.severity_curve(outcomes, kind).share == pytest.approx(bands)
            recalls = curves.label_curve(outcomes, len(board.plant.labels), kind).share
            assert np.nanmean(recalls) == pytest.approx(row.metrics[kind]["balanced_accuracy"])


def test_more_flights_make_narrower_intervals(board):
    outcomes = board.outcomes["two_stage_kf_exponential"]
    width = lambda of: np.nanmean(np.subtract(*curves.severity_curve(of, "per_sample")[3:1:-1]))  # noqa: E731
    assert 0.4 < width(outcomes * 4) / width(outcomes) < 0.65


def test_curves_of_no_fault_are_empty(board):
    healthy = [msgspec.structs.replace(board.outcomes["null"][0], onsets=[], decisions=[Decision(0, 0, None)],
                                       banded=[(0, 0)] * 3)] * 3  # fmt: skip
    assert curves.delay_curve(healthy, "detection", 0.1).x.size == 0
    assert np.isnan(curves.severity_curve(healthy, "per_decision").share).all()


# ---------------------------------------------------------------------------------------------------------------
# It does no harm, and fits


def test_data_cannot_leave_its_element():
    text = embedded({"name": EVIL})
    assert json.loads(text)["name"] == EVIL
    assert not set(text) & set("<>&\u2028\u2029")
    page = html(EVIL, {"suite": EVIL})
    assert len(re.findall(r"<script", page)) == 2
    assert "<img" not in page


def test_the_page_names_no_address(page):
    """Nothing could be fetched: no address but the name of the SVG language, and the policy forbids the rest."""
    markup = page.replace(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1], "")
    assert set(re.findall(r"\w+://[\w./]+", markup)) == {"http://www.w3.org/2000/svg"}
    assert "default-src 'none'" in markup
    assert "innerHTML" not in markup


def test_four_hundred_flights_fit(board):
    """Every line has points enough to be seen, and even lines that don't compress stay below the limit."""
    plant = board.plant
    budget = Budget(LARGEST * 0.7, plant, 400, 5)
    assert budget.points >= 60
    noise = np.random.default_rng(0)
    lines = [Line("sensor", s.name, s.unit, noise.standard_normal(1201)) for s in plant.observed + plant.estimated]
    said = [Line("estimate", s.name, s.unit, noise.standard_normal(1201)) for s in plant.estimated * 3 + plant.outputs]
    size = len(
        msgspec.json.encode([pack(lines, budget.points, budget.steps), *[pack(said, budget.points, budget.steps)] * 5])
    )
    assert 400 * size < 0.85 * LARGEST


def test_more_than_fits_is_refused_with_what_would(board):
    with pytest.raises(ValueError, match=r"20000 flights of 40 methods don't fit into a report: \d+ flights would"):
        Budget(LARGEST * 0.7, board.plant, 20_000, 40)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"flights": 31}, "has 30 flights, not 31"),
        ({"flights": -1}, "has 30 flights, not -1"),
        ({"methods": ("augmented_efk",)}, "did you mean augmented_ekf"),
        ({"methods": ("joint_ukf",)}, "joint_ukf"),
    ],
)
def test_what_cannot_be_shown_is_said(board, arguments, message):
    with pytest.raises(ValueError, match=message) as error:
        report(board, **{"flights": 2, "progress": False, **arguments})
    assert error


def test_a_suite_without_rows_says_how_to_make_some(board):
    with pytest.raises(ValueError, match="there are no rows of b747-standard-30: fdi-gym evaluate"):
        report(board._replace(rows=[], outcomes={}))


def test_a_row_of_unknown_code_is_shown_and_never_imported(board):
    """Whoever sends a row names a module: only who asks for it by name has it imported."""
    stranger = msgspec.structs.replace(board.rows[2], diagnoser="no_such_module:build")
    outcomes = {**board.outcomes, "no_such_module:build": board.outcomes["augmented_ekf"]}
    with_it = board._replace(rows=[*board.rows, stranger], outcomes=outcomes)
    data = data_of(report(with_it, methods=("all",), flights=1, progress=False))
    assert "no_such_module:build" in [m["name"] for m in data["methods"]]
    assert "no_such_module:build" not in data["flown"]["methods"]


def test_the_command_writes_the_report(tmp_path, capsys):
    target = tmp_path / "r.html"
    arguments = ["report", "b747-standard", "-o", str(target), "--flights", "1", "--methods", "null"]
    cli.main([*arguments, "--results", str(ROOT / "leaderboards" / "results")])
    assert str(target) in capsys.readouterr().out
    assert data_of(target.read_text())["flown"]["methods"] == ["null"]


# ---------------------------------------------------------------------------------------------------------------
# In a browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip("there is no Chromium")
    found = Browser(tmp_path_factory.mktemp("profile"))
    yield found
    found.close()


@pytest.fixture(scope="module")
def shown(browser, page, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(page)
    return path


@pytest.fixture
def opened(browser, shown):
    browser.events.clear()
    browser.size(1280)
    browser.open(shown)
    browser.wait("document.querySelectorAll('#panels figure').length > 0")
    yield browser
    assert browser.trouble() == []


NAMES = "[...document.querySelectorAll('#table tbody tr')].map((row) => row.dataset.name)"
CELLS = "[...document.querySelectorAll('#table tbody tr')].map((row) => row.cells[{}].textContent)"
PICK = """((id, text) => {{
  const select = [...document.querySelectorAll(`#${{id}} select`)].find((s) => [...s.options].some((o) => o.text === text));
  select.value = [...select.options].find((o) => o.text === text).value;
  select.dispatchEvent(new Event("change"));
}})({}, {})"""


def pick(browser, controls, text):
    browser.run(PICK.format(json.dumps(controls), json.dumps(text)))


def test_the_table_sorts_by_any_column_either_way(opened, board):
    heads = opened.run("[...document.querySelectorAll('#table thead button')].map((b) => b.dataset.key)")
    assert heads[0] == "name"
    for i, key in enumerate(heads):
        orders = []
        for _ in range(2):
            opened.run(f"document.querySelector('#table [data-key=\"{key}\"]').click()")
            cells = opened.run(CELLS.format(i))
            sort = opened.run(f"document.querySelector('#table th:nth-child({i + 1})').getAttribute('aria-sort')")
            if key == "name":
                assert cells == sorted(cells, reverse=sort == "descending")
            else:
                numbers = [float(re.search(r"-?\d+\.?\d*", c)[0]) for c in cells if re.match(r"-?\d", c)]
                assert numbers == sorted(numbers, reverse=sort == "descending")
            orders.append(sort)
        assert sorted(orders) == ["ascending", "descending"]


def test_the_table_filters_by_name_kind_and_task(opened):
    assert len(opened.run(NAMES)) == len(METHODS)
    typed = "((box) => {{ box.value = {}; box.dispatchEvent(new Event('input')); }})(document.getElementById('filter'))"
    opened.run(typed.format("'TWO_stage'"))
    assert opened.run(NAMES) == ["two_stage_kf_exponential"]
    opened.run(typed.format("'nobody is called so'"))
    assert opened.run(NAMES) == []
    opened.run(typed.format("''"))
    opened.run("document.querySelector('#table-controls input[value=floor]').click()")
    assert set(opened.run(NAMES)) == set(METHODS) - {"null", "random"}
    pick(opened, "table-controls", "Detection")
    heads = opened.run("[...document.querySelectorAll('#table thead button')].map((b) => b.textContent)")
    assert "false alarms/h" in heads
    assert "per sample %" not in heads


def test_a_flight_and_a_method_are_picked(opened, page):
    flown = data_of(page)["flown"]
    facts = lambda: opened.run("document.getElementById('flight-facts').textContent")  # noqa: E731
    first = facts()
    other = opened.run("document.querySelector('#flight-controls select').options[3].textContent")
    pick(opened, "flight-controls", other)
    opened.wait(f"document.getElementById('flight-facts').textContent.startsWith('Flight {flown['flights'][3]['number']},')")
    assert facts() != first
    pick(opened, "flight-controls", "windowed_nis")
    opened.wait("document.getElementById('flight-legend').textContent.includes('declared by windowed_nis')")
    assert "limit of the mean" in opened.run("document.getElementById('panels').textContent")
    drawn = "[...document.querySelectorAll('#panels path.truth')].every((p) => p.getAttribute('d').length > 20)"
    assert opened.run(drawn)


def test_the_cursor_moves_by_keyboard(opened):
    opened.run("document.querySelector('#cursor-controls input').focus()")
    said = lambda: opened.run("document.querySelector('#cursor-controls output').textContent")  # noqa: E731
    before = said()
    opened.key("ArrowRight", 39)
    assert said() != before


def test_a_column_is_sorted_by_keyboard_and_keeps_the_focus(opened):
    opened.run("document.querySelector('#table [data-key=decision]').focus()")
    opened.key("Enter", 13)
    assert opened.run("document.activeElement.dataset.key") == "decision"
    assert opened.run("document.activeElement.closest('th').getAttribute('aria-sort')") == "descending"


def test_another_method_is_compared_with(opened):
    before = opened.run("document.getElementById('differences').textContent")
    pick(opened, "comparison-controls", "augmented_ekf")
    assert opened.run("document.getElementById('differences').textContent") != before
    pick(opened, "confusion-controls", "null")
    assert "100" in opened.run("document.querySelector('#matrices tbody td').textContent")


@pytest.mark.parametrize("width", [390, 820, 1280])
def test_nothing_is_wider_than_the_window(opened, width):
    opened.size(width)
    opened.wait(f"window.innerWidth === {width}")
    opened.call("Page.reload")
    opened.wait("document.querySelectorAll('#panels figure').length > 0")
    assert opened.run("document.documentElement.scrollWidth") <= width


def test_it_prints(opened):
    assert len(base64.b64decode(opened.call("Page.printToPDF")["data"])) > 20_000


def test_markup_in_names_is_shown_as_text(browser, board, tmp_path):
    """Names of rows are checked at the door; a page must not depend on it."""
    data = data_of(report(board, flights=1, progress=False, methods=("augmented_ekf",)))
    name = data["flown"]["methods"][0]
    text = json.dumps(data).replace(json.dumps(name)[1:-1], json.dumps(EVIL)[1:-1])
    data = json.loads(text)
    data["suite"] |= {"name": EVIL, "description": EVIL}
    data["labels"][1] = EVIL
    path = tmp_path / "evil.html"
    path.write_text(html(EVIL, data))
    browser.events.clear()
    browser.size(1280)
    browser.open(path)
    browser.wait("document.querySelectorAll('#panels figure').length > 0")
    assert browser.run("window.harmed") is None
    assert browser.run("document.getElementById('title').textContent") == EVIL
    assert browser.run("document.images.length") == 0
    assert browser.trouble() == []
