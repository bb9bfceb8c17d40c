"""Recordings: what is read is what was flown, what is wrong is said, and recorded flights are scored as flown ones."""

import csv
import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
from conftest import build
from test_cli import refused, said

from fdi_gym.diagnosis import NotApplicableError, diagnosers, make_diagnoser, run
from fdi_gym.engine import simulate
from fdi_gym.faults import draw
from fdi_gym.files import RefusedError
from fdi_gym.metrics import outcome
from fdi_gym.recordings import doubts, observations, open_table, read_mapping, to_frame, write_table
from fdi_gym.recordings import tables as tables_module
from fdi_gym.recordings.channels import Channel, Channels, channels_plant
from fdi_gym.recordings.columns import channel_columns, units_of
from fdi_gym.recordings.mapping import Column, Labels, Mapping, Onset, Time, factor_between
from fdi_gym.recordings.observations import as_record
from fdi_gym.recordings.suite import collect, read_recorded
from fdi_gym.suite import load_suite

pytest.importorskip("pyarrow")


def flown(plant, seed=5, count=1, process="standard"):
    return simulate(plant, [draw(plant.process(process), seed + i) for i in range(count)])


@pytest.fixture(scope="module")
def flight():
    """A flight of the 747 with a fault, as columns, and its record."""
    plant = build("B747Lateral")
    record = flown(plant)
    return plant, record, to_frame(plant, record)


def rows(frame, which):
    return {name: values[which] for name, values in frame.items()}


# -- what is read is what was flown


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_written_flight_is_read_back_to_the_bit(plant, tmp_path, ending):
    record = flown(plant)
    path = tmp_path / f"flight.{ending}"
    write_table(path, to_frame(plant, record, truth=True), units_of(plant))
    found = observations(plant, path)
    samples = int(record.length[0]) + 1
    assert np.array_equal(found.obs, record.obs[0, :samples], equal_nan=True)
    assert np.array_equal(found.label, record.label[0, :samples])
    assert not found.notes


def test_any_table_in_memory_will_do(flight):
    import pyarrow as pa

    plant, record, frame = flight

    class DataFrame:  # what pandas and polars have in common
        columns = list(frame)

        def __getitem__(self, name):
            return frame[name]

    for table in (frame, pa.table(frame), DataFrame()):
        assert np.array_equal(observations(plant, table).obs, record.obs[0])


def test_names_units_factors_and_offsets_lead_to_the_same(flight, tmp_path):
    plant, record, frame = flight
    other = {
        "stamp": 1e6 + 1e3 * frame["time"], "sideslip": np.radians(frame["beta"]), "p": frame["p"], "yaw": -frame["r"],
        "phi": (frame["phi"] - 7) / 2, "aileron": frame["aileron"], "rudder": frame["rudder"],
    }  # fmt: skip
    file = tmp_path / "mapping.json"
    file.write_text(json.dumps({
        "time": {"column": "stamp", "unit": "ms"},
        "channels": {"beta": {"column": "sideslip", "unit": "rad"}, "r": {"column": "yaw", "factor": -1},
                     "phi": {"column": "phi", "factor": 2, "offset": 7}},
    }))  # fmt: skip
    assert np.allclose(observations(plant, other, read_mapping(file)).obs, record.obs[0], rtol=0, atol=1e-9)


def test_units_in_the_head_of_a_column_are_minded(flight, tmp_path):
    plant, record, frame = flight
    units = {**units_of(plant), "p": "rad/s", "time": "ms"}
    for ending in ("csv", "parquet"):
        path = tmp_path / f"flight.{ending}"
        write_table(path, {**frame, "p": np.radians(frame["p"]), "time": 1e3 * frame["time"]}, units)
        assert np.allclose(observations(plant, path).obs, record.obs[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("unit", ["deg", "deg/s", "%", "ft", "kn", "mV"])
def test_a_change_of_unit_and_back_is_none(unit):
    others = {"deg": "rad", "deg/s": "rad/s", "%": "", "ft": "m", "kn": "m/s", "mV": "V"}[unit]
    assert factor_between(unit, others) * factor_between(others, unit) == pytest.approx(1)
    assert factor_between(unit, "A") is None


# -- time


def test_dropped_rows_are_missing_samples(flight):
    plant, record, frame = flight
    keep = np.ones(len(frame["time"]), bool)
    keep[300:340] = keep[700] = False
    found = observations(plant, rows(frame, keep))
    assert np.isnan(found.obs[~keep]).all()
    assert np.array_equal(found.obs[keep], record.obs[0, keep])
    assert np.array_equal(found.label, record.label[0])
    assert "2 gaps, the longest 4.1 s: 41 of 1201 samples are missing" in " ".join(found.notes)


def test_order_repetition_and_missing_times_are_mended_and_said(flight):
    plant, record, frame = flight
    mixed = rows(frame, np.r_[0:500, 499, 700:1201, 500:700, 3])
    mixed["time"][-1] = np.nan
    found = observations(plant, mixed)
    assert np.array_equal(found.obs, record.obs[0])
    text = " ".join(found.notes)
    assert all(word in text for word in ("out of order", "1 rows have the time of the one before", "1 rows without a time"))


def test_several_flights_in_one_file_are_refused(flight):
    plant, _, frame = flight
    with pytest.raises(RefusedError, match="begin again 2 times: it holds several flights"):
        observations(plant, rows(frame, np.r_[0:1201, 0:1201, 0:600]))


@pytest.mark.parametrize("jitter", [0.01, 0.04])
def test_jitter_is_said_and_costs_little(flight, jitter):
    plant, record, frame = flight
    off = np.random.default_rng(1).uniform(-jitter, jitter, len(frame["time"]))
    found = observations(plant, {**frame, "time": 40.0 + frame["time"] + off})
    assert len(found.obs) in (1200, 1201)
    assert np.isfinite(found.obs).mean() > 0.98
    assert "off even steps" in " ".join(found.notes)
    n = min(len(found.obs), 1201)
    error = found.obs[:n] - record.obs[0, :n]
    assert np.nanstd(error[:, 2]) < 0.1


def test_a_faster_recording_gives_the_same_samples_and_the_mean_command():
    """A motor recorded at 1 ms: sensors of every tenth row, commands averaged over ten."""
    plant = build("DCMotor")
    t = np.arange(0, 2.0005, 0.001)
    frame = {"time": t, "current": np.sin(t), "speed": 10 * t, "voltage": np.where(t > 1.0, 5.0, -3.0)}
    found = observations(plant, frame)
    assert len(found.obs) == 201
    assert np.allclose(found.obs[:, 0], np.sin(found.time))
    k = np.arange(1, 201)
    assert np.allclose(found.obs[k, 2], np.where(k <= 100, -3.0, 5.0))
    ramp = observations(plant, {**frame, "voltage": t})
    assert np.allclose(ramp.obs[1:, 2], 0.01 * k - 0.0045)  # the mean of the ten rows of the interval


def test_a_slower_recording_has_gaps_between_and_holds_its_commands():
    plant = build("DCMotor")
    t = np.arange(0, 4.01, 0.05)
    found = observations(plant, {"time": t, "current": t, "speed": t, "voltage": np.round(2 * t)})
    whole = np.isfinite(found.obs[:, 0])
    assert np.array_equal(np.flatnonzero(whole), np.arange(0, 401, 5))
    assert np.allclose(found.obs[1:, 2], np.repeat(np.round(2 * t)[1:], 5))
    assert "sensors are missing in between" in " ".join(found.notes)


def test_another_rate_that_fits_nowhere_is_interpolated():
    plant = build("DCMotor")
    t = np.arange(0, 3, 0.0083)
    found = observations(plant, {"time": t, "current": 3 * t, "speed": t, "voltage": 0 * t + 2})
    assert np.allclose(found.obs[1:-1, 0], 3 * found.time[1:-1], atol=1e-9)
    assert np.allclose(found.obs[1:-1, 2], 2)
    assert "interpolated" in " ".join(found.notes)


def test_dates_are_times():
    plant = build("DCMotor")
    stamps = np.array([f"2026-03-09 10:14:{i / 100:05.2f}" for i in range(100)])
    found = observations(plant, {"datetime": stamps, **{c: np.arange(100.0) for c in ("current", "speed", "voltage")}})
    assert len(found.obs) == 100
    assert np.isfinite(found.obs).all()


# -- doubts


PLANTS_WITH_FEEDBACK = ["HUAVHover", "MissilePitch", "CMGSatellite", "DCMotor"]


@pytest.mark.parametrize("plant_id", PLANTS_WITH_FEEDBACK)
def test_a_command_of_the_next_interval_is_doubted_and_a_right_one_is_not(plant_id):
    plant = build(plant_id)
    record = flown(plant, 40, 2, "fault-free")
    n_y, n_u = len(plant.outputs), len(plant.commands)
    for i in range(2):
        obs = record.obs[i, : int(record.length[i]) + 1]
        early = obs.copy()
        early[:-1, n_y : n_y + n_u] = obs[1:, n_y : n_y + n_u]
        assert not doubts(plant, obs)
        assert any("looks like u_k" in text for text in doubts(plant, early))


def test_the_remedy_that_a_doubt_names_is_the_right_one(flight):
    plant, record, frame = flight
    early = {**frame, **{c: np.r_[frame[c][1:], frame[c][-1]] for c in ("aileron", "rudder")}}
    found = observations(plant, early, Mapping(commands="u_k"))
    assert np.array_equal(found.obs[1:], record.obs[0, 1:])


@pytest.mark.parametrize(
    ("channel", "factor", "unit"), [("beta", np.pi / 180, "rad"), ("p", np.pi / 180, "rad/s"), ("rudder", 1e3, "")]
)
def test_another_unit_is_doubted_and_guessed(flight, channel, factor, unit):
    plant, _, frame = flight
    found = doubts(plant, observations(plant, {**frame, channel: factor * frame[channel]}).obs)
    assert any(text.startswith(channel) and unit in text for text in found)
    assert not any("looks like u_k" in text for text in found)


def test_degrees_for_radians_are_out_of_range():
    plant = build("MissilePitch")
    frame = to_frame(plant, flown(plant))
    found = doubts(plant, observations(plant, {**frame, "alpha": np.degrees(frame["alpha"])}).obs)
    assert any(text.startswith("alpha is outside its range") and '"unit": "deg"' in text for text in found)


# -- what is wrong is said in words


def column_is(name, value):
    return lambda f: {**f, name: np.full(len(f["time"]), value)}


WRONG = [
    (lambda f: {k: v for k, v in f.items() if k not in ("p", "rudder")}, Mapping(), "no column for p, rudder"),
    (column_is("beta", "much"), Mapping(), "not numbers"),
    (lambda f: {**f, **dict.fromkeys(("beta", "p", "r", "phi"), np.full(len(f["time"]), np.nan))}, Mapping(),
     "no value of any sensor"),
    (lambda f: {**f, "time": np.full(len(f["time"]), np.nan)}, Mapping(), "rows have no time"),
    (column_is("time", 3.0), Mapping(), "at least two rows"), (column_is("time", "noon"), Mapping(), "a number or a date"),
    (lambda f: rows(f, slice(0, 0)), Mapping(), "no rows"), (lambda f: rows(f, slice(0, 1)), Mapping(), "at least two rows"),
    (lambda f: {**f, "time": 1e3 * f["time"]}, Mapping(), 'times are in ms'),
    (lambda f: {**f, "time": 1e-6 * f["time"]}, Mapping(), "rows are"),
    (lambda f: {**f, "time": np.r_[f["time"][:-1], 1e12]}, Mapping(), "more than 1000000 samples"),
    (lambda f: {**f, "p": f["p"][:-3]}, Mapping(), "differ in length"),
    (lambda f: {**f, "p": np.zeros((len(f["time"]), 2))}, Mapping(), "one column"),
    (lambda f: f, Mapping(channels={"bta": "beta"}), "did you mean beta"),
    (lambda f: f, Mapping(time="tme"), "did you mean time"),
    (lambda f: f, Mapping(channels={"beta": "bta"}), "did you mean beta"),
    (lambda f: f, Mapping(label="lable"), "did you mean label"),
    (lambda f: f, Mapping(not_recorded=["q"]), "unknown channel 'q'"),
    (lambda f: f, Mapping(channels={"beta": Column("beta", unit="kg")}), "nothing is known of how one is made"),
    (lambda f: f, Mapping(channels={"beta": Column("beta", unit="rad", factor=2.0)}), "a unit or a factor"),
    (column_is("label", "broken"), Mapping(), "unknown label 'broken'"),
    (column_is("label", "77"), Mapping(), "unknown label '77'"),
    (column_is("begins", 7), Mapping(onset="begins"), "which fault began is in no column"),
    (lambda f: {**f, "begins": f["time"]}, Mapping(onset="begins"), "one time for the flight"),
    (lambda f: {**f, "p ": f["p"]}, Mapping(), "two columns called 'p'"), (lambda f: {}, Mapping(), "no columns"),
    (lambda f: 7, Mapping(), "has columns by name"), (lambda f: {1: f["p"]}, Mapping(), "has columns by name"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "mapping", "words"), WRONG, ids=[w[:30] for *_, w in WRONG])
def test_what_cannot_be_used_is_refused_in_words(flight, change, mapping, words):
    plant, _, frame = flight
    with pytest.raises(RefusedError, match=words):
        observations(plant, change(frame), mapping)


HEAD = "time,current,speed,voltage\n"
TEXTS = [
    ("", "is empty"), ("time\n1\n2\n", "has one column, 'time'"),
    (HEAD + "1,2,3\n", "line 2 has 3 cells, the first one has 4"),
    (HEAD + "0,1,much,1\n", "line 2: speed is a number, not 'much'"), ("a,a\n1,2\n", "two columns called 'a'"),
    ("time,current,speed,voltage\n", "has no rows"),
    (HEAD + '"1,2\n' + "x" * 200_000 + "\n", "field larger than field limit"),
    (HEAD + "1\0,2,3,4\n", "zero byte"), (HEAD + "1" * 2_000_000, "1048576 characters or more"),
    (b"\xff\xfea\0,\0b\0\n\0", "not text"),
    ("time,current,speed,voltage\n" + "0,1,1,1\n" * 3, "at least two rows"),
    (",".join(map(str, range(20_000))) + "\n1", "up to 10000"), (",,,,\n,,,,\n", "has no columns"),
    (HEAD + "2026-13-40 00:00:00,1,2,3\n" * 3, "there is no such date"), (HEAD + "0000-00-00 00:00,1,2,3\n", "no such date"),
    (HEAD + "1_0,1,2,3\n0,1,2,3\n", "a number or a date, not '1_0'"),
    (HEAD + "0,1,2,3\n0.01,1,2_0,3\n", "line 3: speed is a number, not '2_0'"),
    (HEAD + "-1e308,1,2,3\n1e308,1,2,3\n", "at least two rows"),
    (HEAD.strip() + ",label\n" + f"0,1,2,3,{'9' * 90_000}\n0.01,1,2,3,0\n", "^.{1,300}$"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "words"), TEXTS, ids=[w[:30] for _, w in TEXTS])
def test_files_that_are_no_tables_are_refused_in_words(motor, tmp_path, text, words):
    path = tmp_path / "flight.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(RefusedError, match=words):
        observations(motor, path)


def test_text_files_as_they_come(motor, tmp_path):
    """Semicolons with decimal commas, a byte-order mark, quotes, blanks, empty cells, lines ended in any way."""
    path = tmp_path / "flight.csv"
    path.write_bytes(
        '\ufefftime;"current"; speed [rpm];voltage\r\n0,00;1,5;0;2\r\n0,01;;60;NaN\r\n\r\n0,02;-2;120;1e0\r\n'.encode()
    )
    found = observations(motor, path).obs
    assert np.allclose(found, [[1.5, 0, 2], [np.nan, 2 * np.pi, np.nan], [-2, 4 * np.pi, 1]], equal_nan=True)


def test_parquet_that_is_none_or_holds_something_else_is_refused(motor, tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = tmp_path / "flight.parquet"
    path.write_bytes(b"PAR1" + bytes(100) + b"PAR1")
    with pytest.raises(RefusedError, match="is not a Parquet file"):
        observations(motor, path)
    base = {name: np.arange(3.0) / 100 for name in ("time", "current", "voltage")}
    pq.write_table(pa.table({**base, "speed": [[1.0], [2.0], []]}), path)
    with pytest.raises(RefusedError, match=r"speed holds list<.*not numbers"):
        observations(motor, path)
    pq.write_table(pa.table({**base, "speed": ["a", "b", "c"]}), path)
    with pytest.raises(RefusedError, match="speed holds string, not numbers"):
        observations(motor, path)
    whole = path.read_bytes()
    pq.write_table(pa.table({**base, "speed": np.arange(3.0)}), path)
    content = bytearray(path.read_bytes())
    content[8:60] = bytes(52)
    path.write_bytes(content)
    with pytest.raises(RefusedError, match=r"cannot be read|is not a Parquet file|differ in length|no value"):
        observations(motor, path)
    path.write_bytes(whole[:-20])
    with pytest.raises(RefusedError, match="is not a Parquet file"):
        observations(motor, path)


def test_times_with_a_zone_are_those_of_utc(motor, tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    base = {name: np.arange(40.0) for name in ("current", "speed", "voltage")}
    stamps = [1_774_746_000_000 + 10 * i for i in range(-20, 20)]  # ms: a summer time begins in their middle
    for zone in (None, "UTC", "Europe/Berlin"):
        pq.write_table(pa.table({**base, "time": pa.array(stamps, pa.timestamp("ms", zone))}), tmp_path / "flight.parquet")
        found = observations(motor, tmp_path / "flight.parquet")
        assert np.allclose(found.time, np.arange(40) / 100)
        assert found.notes == ()


def test_nothing_in_a_parquet_file_is_executed(motor, tmp_path):
    """The metadata of an extension type that older readers unpickle."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "executed"), "w"))

    marked = {"ARROW:extension:name": "arrow.py_extension_type", "ARROW:extension:metadata": pickle.dumps(Evil())}
    names = ("time", "current", "speed", "voltage")
    schema = pa.schema([pa.field(name, pa.float64(), metadata=marked if name == "speed" else None) for name in names])
    pq.write_table(pa.table([pa.array(np.arange(3.0) / 100)] * 4, schema=schema), tmp_path / "flight.parquet")
    observations(motor, tmp_path / "flight.parquet")
    assert not (tmp_path / "executed").exists()


def test_more_rows_than_a_flight_has_are_refused(motor, tmp_path, monkeypatch):
    import pyarrow as pa
    import pyarrow.parquet as pq

    monkeypatch.setattr(tables_module, "ROWS", 50)
    frame = {name: np.arange(51.0) / 100 for name in ("time", "current", "speed", "voltage")}
    write_table(tmp_path / "flight.csv", frame, {})
    pq.write_table(pa.table(frame), tmp_path / "flight.parquet")
    for source in (tmp_path / "flight.csv", tmp_path / "flight.parquet", frame):
        with pytest.raises(RefusedError, match="more than 50 rows"):
            observations(motor, source)


MAPPINGS = [
    ("[]", "object"), ("{", "not a mapping"), ('{"chanels": {}}', "unknown field `chanels`"),
    ('{"channels": {"p": 3}}', "channels"),
    ('{"channels": {"p": {"column": "x", "factor": "2"}}}', "factor"), ('{"commands": "u"}', "Invalid enum value"),
    ('{"time": {"column": "t", "unit": "days"}}', "Invalid enum value"),
    ('{"channels": {"p": {"column": "x", "factor": 1e400}}}', "out of range|factor"),
    ('{"channels": {"p": {"factor": 2}}}', "missing required field `column`"),
    ('{"label": "a", "onset": "b"}', "not by both"),
    ('{"channels": {"p": {"column": "x", "factor": 0}}}', "factor is not 0"),
    ("[" * 100_000, "Expected `object`"), ('{"not_recorded": [""]}', "length >= 1"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "words"), MAPPINGS, ids=[t[:30] for t, _ in MAPPINGS])
def test_a_mapping_that_is_none_is_refused_in_words(tmp_path, text, words):
    (tmp_path / "mapping.json").write_text(text)
    with pytest.raises(RefusedError, match=words):
        read_mapping(tmp_path / "mapping.json")


# -- truth in recordings


def test_labels_onsets_and_indices_say_the_same(flight):
    plant, record, frame = flight
    truth = record.label[0]
    bare = {k: v for k, v in frame.items() if k != "label"}
    assert observations(plant, bare).label is None
    onset = frame["time"][np.argmax(truth > 0) - 1]
    fault = plant.labels[truth.max()].name
    n = len(truth)
    ways = {
        "names": ({**bare, "label": frame["label"]}, Mapping()),
        "indices": ({**bare, "label": truth}, Mapping()),
        "words of one's own": ({**bare, "state": np.where(truth > 0, "kaputt", "ok")},
                               Mapping(label=Labels("state", {"kaputt": fault, "ok": "none"}))),
        "onset": ({**bare, "onset": np.full(n, onset), "fault": np.full(n, fault)}, Mapping()),
        "mapped onset": ({**bare, "t0": np.full(n, onset), "what": np.full(n, "x")},
                         Mapping(onset=Onset("t0", None, "what", {"x": fault}))),
    }  # fmt: skip
    for how, (table, mapping) in ways.items():
        assert np.array_equal(observations(plant, table, mapping).label, truth), how
    clock = {**ways["onset"][0], "time": 1e3 * (500 + frame["time"]), "onset": np.full(n, 1e3 * (500 + onset))}
    assert np.array_equal(observations(plant, clock, Mapping(time=Time("time", "ms"))).label, truth)
    healthy = {**bare, "onset": np.full(n, np.nan), "fault": np.full(n, "")}
    assert not observations(plant, healthy).label.any()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recorded suite of six motor flights, and their record."""
    plant = build("DCMotor")
    record = flown(plant, 300, 6)
    folder = tmp_path_factory.mktemp("flights")
    for i in range(6):
        write_table(folder / f"{i}.{'csv' if i % 2 else 'parquet'}", to_frame(plant, record, i), units_of(plant))
    return plant, record, collect(folder, "bench", "motors on a bench", "dc_motor:DCMotor")


def test_recorded_flights_are_scored_as_flown_ones(recorded):
    plant, record, path = recorded
    suite = load_suite(str(path))
    read = suite.record(suite.build(), range(6))
    said = run(make_diagnoser("augmented_ekf", plant), record.obs)
    scoring = plant.process("standard").scoring
    for i in range(6):
        a, b = outcome(plant, scoring, record, said, i), outcome(plant, scoring, read, said, i)
        for field in (
            "steps",
            "confusion",
            "onsets",
            "false_alarms",
            "healthy_steps",
            "alarm_steps",
            "alarmed",
            "log_score",
        ):
            assert getattr(a, field) == getattr(b, field), field
        assert [(d.label, d.declared) for d in a.decisions] == [(d.label, d.declared) for d in b.decisions]
        assert a.declaration.exact == b.declaration.exact
        assert not any(b.error_steps)  # nobody knows what was there to be estimated
        assert all(f.size is None for f in b.declaration.found)
        assert all(d.band is None for d in b.decisions)


def test_a_recorded_suite_gets_rows_that_are_verified_and_rendered(capsys, recorded, tmp_path):
    _, _, path = recorded
    results, pages = tmp_path / "results", tmp_path / "pages"
    pages.mkdir()
    code, out, err = said(capsys, "evaluate", path, "--diagnosers", "null", "augmented_ekf", "known_onset_oracle",
                          "--results", results,
                          "--work", tmp_path / "work", "--jobs", "1")  # fmt: skip
    assert code == 0, err
    assert "motors on a bench" in out
    assert "known_onset_oracle: not applicable" in err
    code, out, err = said(capsys, "verify", results / "bench" / "augmented_ekf.json", "--suite", path, "--share", "0.5")
    assert code == 0, err
    code, out, err = said(capsys, "leaderboard", "--results", results, "--pages", pages, "--suites", path, "--no-pictures")
    assert code == 0, err
    assert "augmented\\_ekf" in (pages / "bench.md").read_text() or "augmented_ekf" in (pages / "bench.md").read_text()


def test_a_recording_that_was_changed_is_another(recorded, tmp_path, capsys):
    plant, record, _ = recorded
    write_table(tmp_path / "a.csv", to_frame(plant, record), units_of(plant))
    path = collect(tmp_path, "one", "one flight", "dc_motor:DCMotor")
    with (tmp_path / "a.csv").open("a") as file:
        file.write("\n")
    assert "a.csv is not the recording" in refused(
        capsys, "evaluate", path, "--diagnosers", "null", "--work", tmp_path / "w"
    )
    text = json.loads(path.read_text())
    for change, words in (({"description": "another"}, "was edited"),
    ({"flights": {"../x.csv": "0" * 64}}, "lie in the folder"),
                          ({"flights": {"/etc/passwd": "0" * 64}}, "lie in the folder"), ({"more": 1}, "unknown field"),
                          ({"flights": {}}, "from 1 to"), ({"folder": "/etc"}, "says where it lies")):  # fmt: skip
        path.write_text(json.dumps({**text, **change}))
        with pytest.raises(RefusedError, match=words):
            read_recorded(path)


def test_a_link_does_not_lead_out_of_the_folder(recorded, tmp_path):
    plant, record, _ = recorded
    (tmp_path / "flights").mkdir()
    write_table(tmp_path / "outside.csv", to_frame(plant, record), units_of(plant))
    (tmp_path / "flights" / "a.csv").symlink_to(tmp_path / "outside.csv")
    with pytest.raises(RefusedError, match="leads out of the folder"):
        collect(tmp_path / "flights", "one", "one flight", "dc_motor:DCMotor")


# -- channels alone


PUMP = Channels(
    dt=1.0, sensors=[Channel("pressure", "bar"), Channel("flow")], commands=[Channel("speed")], labels=["leak", "block"]
)


@pytest.mark.parametrize("name", [name for name in diagnosers() if name not in ("null", "random", "false_alarm")])
def test_without_equations_a_model_based_method_is_not_applicable(name):
    with pytest.raises(NotApplicableError):
        make_diagnoser(name, channels_plant("Pump", PUMP))


def test_a_plant_without_equations_flies_nowhere_and_travels():
    cloudpickle = pytest.importorskip("cloudpickle")
    plant = channels_plant("Pump", PUMP)
    for call in (lambda: plant.propagate(0.0, np.zeros(0), np.zeros(1)), lambda: draw(plant.process("standard"), 0)):
        with pytest.raises(NotApplicableError, match="channels only"):
            call()
    assert cloudpickle.loads(cloudpickle.dumps(plant)).labels == plant.labels  # as joblib sends it
    assert "Pump" in plant.describe()


# -- layouts of three collections, in small files as those are laid out

METHOD = '''
"""Looks at channels alone: how far a sensor is from where it was at first."""
import numpy as np
from fdi_gym.diagnosis import Diagnoser, Diagnosis

def build(plant):
    n_y = len(plant.outputs)
    def init(n):
        return np.zeros(n, int), np.zeros((n, n_y)), np.zeros((n, n_y))
    def update(state, obs):
        k, mean, square = state
        y = np.where(np.isfinite(obs[:, :n_y]), obs[:, :n_y], mean)
        far = (np.abs(y - mean) > 8 * np.sqrt(square / 20 + 1e-12)).any(axis=1) & (k >= 20)
        first = (k < 20)[:, None]
        new = np.where(first, mean + (y - mean) / (k[:, None] + 1), mean)
        square = np.where(first, square + (y - mean) * (y - new), square)
        return (k + 1, new, square), Diagnosis(far, np.where(far, 1, 0))
    return Diagnoser(init, update, gaps=True)
'''


@pytest.fixture
def away(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "deviation.py").write_text(METHOD)
    sys.modules.pop("deviation", None)
    yield tmp_path
    sys.modules.pop("deviation", None)


def scored(capsys, away, path):
    """The row of the method above on a recorded suite, verified."""
    code, _, err = said(capsys, "evaluate", path, "--diagnosers", "deviation:build", "null", "augmented_ekf",
                        "--results", "results",
                        "--work", "work", "--jobs", "1")  # fmt: skip
    assert code == 0, err
    assert "augmented_ekf: not applicable: needs equations" in err
    row = next((away / "results").rglob("deviation.build.json"))
    code, _, err = said(capsys, "verify", row, "--suite", path, "--share", "1", "--trust", "deviation:build")
    assert code == 0, err
    return json.loads(row.read_text())["metrics"]


def write_skab(folder, rng, skip=()):
    head = ["datetime", "Accelerometer1RMS", "Current", "Pressure", "Volume Flow RateRMS"]
    for place, faulty in (("anomaly-free", False), ("valve1", True)):
        (folder / place).mkdir(parents=True)
        with (folder / place / "0.csv").open("w") as file:
            writer = csv.writer(file, delimiter=";")
            writer.writerow([*head, *(["anomaly", "changepoint"] if faulty else [])])
            for k in range(200):
                if faulty and k in skip:
                    continue
                bad = faulty and 100 <= k < 160
                cells = [f"2020-03-09 10:{14 + k // 60}:{k % 60:02d}", *(rng.normal(5 * bad, 0.1, 4).round(4))]
                writer.writerow([*cells, *([float(bad), float(k in (100, 160))] if faulty else [])])


def test_the_layout_of_skab(capsys, away):
    write_skab(away / "skab", np.random.default_rng(0), skip=range(90, 96))
    code, _, err = said(
        capsys, "collect", "skab-small", "skab", "--plant", "SKAB", "--layout", "skab", "--description", "a test"
    )
    assert code == 0, err
    suite = load_suite("skab/skab-small.json")
    plant = suite.build()
    assert [s.name for s in plant.outputs] == ["Accelerometer1RMS", "Current", "Pressure", "Volume Flow RateRMS"]
    record = suite.record(plant, range(2))
    assert not record.label[0].any()
    assert np.array_equal(np.flatnonzero(record.label[1]), np.arange(100, 160))  # seconds count, those that are missing too
    assert np.isnan(record.obs[1, 90:96]).all()
    found = scored(capsys, away, "skab/skab-small.json")
    assert found["detection"]["balanced_accuracy"] > 0.95
    assert found["detection"]["delay_quartiles"][1] == 1.0  # s
    assert found["identification"] is None


def test_the_layout_of_the_tennessee_eastman_files(capsys, away):
    rng, folder = np.random.default_rng(0), away / "te"
    folder.mkdir()
    np.savetxt(folder / "d00.dat", rng.normal(size=(52, 500)), fmt="%.5e")  # on its side
    np.savetxt(folder / "d04.dat", rng.normal(size=(480, 52)) + 9, fmt="%.5e")
    test = rng.normal(size=(960, 52))
    test[160:] += 40
    np.savetxt(folder / "d04_te.dat", test, fmt="%.5e")
    code, _, err = said(
        capsys, "collect", "te-small", "te", "--plant", "TennesseeEastman", "--layout", "braatz", "--description", "a test"
    )
    assert code == 0, err
    suite = load_suite("te/te-small.json")
    plant = suite.build()
    assert (len(plant.outputs), len(plant.commands), len(plant.labels), plant.dt) == (41, 11, 22, 180.0)
    record = suite.record(plant, range(3))
    assert list(record.length) == [499, 479, 959]
    fault = [label.name for label in plant.labels].index("IDV 4")
    assert np.array_equal(np.unique(record.label[1]), [fault])
    assert (record.label[2, :160] == 0).all()
    assert (record.label[2, 160:] == fault).all()
    assert np.allclose(record.obs[2], test, atol=1e-3)
    found = scored(capsys, away, "te/te-small.json")
    assert found["detection"]["delay_quartiles"][1] == 180.0  # s
    (folder / "d04_te.dat").write_text("1 2 3\n")
    with pytest.raises(RefusedError, match="has 3 columns, not 52"):
        suite.record(plant, [2])


def test_the_layout_of_alfa(capsys, away):
    """Topics at rates of their own, in nanoseconds since 1970; a failure is known from the first message about it on."""
    rng, name, start = np.random.default_rng(0), "carbonZ_2018-07-18-15-53-31_1_engine_failure", 1.531943611e18
    folder = away / "alfa" / name
    folder.mkdir(parents=True)
    for topic, rate in (("roll", 20.0), ("pitch", 20.0), ("yaw", 10.0), ("airspeed", 4.0)):
        t = np.cumsum(rng.uniform(0.5, 1.5, int(60 * rate)) / rate)
        with (folder / f"{name}-mavros-nav_info-{topic}.csv").open("w") as file:
            file.write("%time,field.header.seq,field.header.stamp,field.header.frame_id,field.commanded,field.measured\n")
            for k, s in enumerate(t):
                value = rng.normal(30.0 if s >= 40 else 0.0, 0.5)
                file.write(f"{int(start + 1e9 * s)},{k},{int(start + 1e9 * s)},base,{0.0},{value:.4f}\n")
    with (folder / f"{name}-failure_status-engines.csv").open("w") as file:
        file.write("%time,field.data\n" + "".join(f"{int(start + 1e9 * s)},1\n" for s in np.arange(40.0, 60, 0.2)))
    code, _, err = said(
        capsys, "collect", "alfa-small", "alfa", "--plant", "ALFA", "--layout", "alfa", "--description", "a test"
    )
    assert code == 0, err
    suite = load_suite("alfa/alfa-small.json")
    plant = suite.build()
    record = suite.record(plant, [0])
    engines = [label.name for label in plant.labels].index("engines")
    onset = np.flatnonzero(record.label[0] == engines)[0] * plant.dt
    assert onset == pytest.approx(40.0, abs=0.5)
    assert np.isfinite(record.obs[0, 10:-10, :3]).all()
    found = scored(capsys, away, "alfa/alfa-small.json")
    assert found["detection"]["delay_quartiles"][1] < 1.5  # s


def test_folders_without_what_a_layout_wants_are_refused(capsys, tmp_path):
    for layout in ("skab", "braatz", "alfa", "columns"):
        plant = "B747Lateral" if layout == "columns" else "Mine"
        assert "holds no" in refused(
            capsys, "collect", "x", tmp_path, "--plant", plant, "--layout", layout, "--description", "d"
        )


# -- the command


def test_a_flight_is_diagnosed_by_one_command(capsys, flight, tmp_path):
    plant, record, frame = flight
    write_table(tmp_path / "flight.csv", frame, units_of(plant))
    code, out, err = said(capsys, "diagnose", tmp_path / "flight.csv", "--plant", "B747Lateral", "--diagnosers",
                          "bayes_bank",
                          "two_stage_kf_exponential", "mekf", "--output", tmp_path / "out")  # fmt: skip
    assert code == 0, err
    assert "mekf: not applicable" in err
    fault = plant.labels[record.label[0].max()].name
    assert f"to the end: {fault}" in out
    assert (tmp_path / "out" / "flight.png").stat().st_size > 10_000
    table = open_table(tmp_path / "out" / "flight.diagnosis.parquet")
    assert table.units["time"] == "s"
    assert table.units["b_rudder"] == "deg"
    found = table.read(["sample", "b_rudder"], ["method", "label"])
    mine = found["method"] == "bayes_bank"
    direct = run(make_diagnoser("bayes_bank", plant), record.obs)
    assert np.array_equal(found["b_rudder"][mine], direct.estimate[0, :, 3])
    assert np.array_equal(found["label"][mine], [plant.labels[i].name for i in direct.label[0]])


def test_of_a_folder_what_is_broken_is_refused_and_the_rest_diagnosed(capsys, flight, tmp_path):
    _, _, frame = flight
    write_table(tmp_path / "b.csv", rows(frame, slice(0, 200)), {})
    (tmp_path / "a.csv").write_text("time,nothing\n1,2\n")
    code, out, err = said(
        capsys, "diagnose", tmp_path, "--plant", "B747Lateral", "--diagnosers", "two_stage_kf", "--output", tmp_path / "out"
    )
    assert code == 2
    assert "1 of 2 recordings were refused" in err
    assert "refused" in out
    assert (tmp_path / "out" / "b.diagnosis.parquet").exists()
    for path, words in (("nowhere.csv", "is no file"), ("/dev/zero", "is no recording"), (tmp_path / "out", "")):
        assert words in refused(capsys, "diagnose", path, "--plant", "B747Lateral")


def test_without_pyarrow_csv_goes_in_and_out(flight, tmp_path):
    plant, _, frame = flight
    write_table(tmp_path / "flight.csv", rows(frame, slice(0, 100)), units_of(plant))
    code = "import sys; sys.modules['pyarrow'] = None\nfrom fdi_gym import cli; cli.main(sys.argv[1:])"
    command = [sys.executable, "-c", code, "diagnose"]
    rest = ["--plant", "B747Lateral", "--diagnosers", "two_stage_kf", "--output", str(tmp_path)]
    done = subprocess.run([*command, str(tmp_path / "flight.csv"), *rest], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "flight.diagnosis.csv").exists()
    (tmp_path / "flight.parquet").write_bytes(b"PAR1")
    done = subprocess.run([*command, str(tmp_path / "flight.parquet"), *rest], capture_output=True, text=True)
    assert done.returncode == 2
    assert "pip install 'fdi-gym[data]'" in done.stderr


def test_channels_of_the_same_name_are_told_apart(plant):
    names = channel_columns(plant)
    assert len(set(names)) == len(plant.observed)


def test_a_record_of_recordings_repeats_the_last_row(motor):
    record = flown(motor, 300, 2)
    read = [observations(motor, {k: v[:n] for k, v in to_frame(motor, record, i).items()}) for i, n in enumerate((300, 401))]
    joined = as_record(motor, read)
    assert list(joined.length) == [299, 400]
    assert (joined.obs[0, 300:] == record.obs[0, 299]).all()
