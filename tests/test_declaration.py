"""A declaration of a whole scenario: what it is of the truth, of what a diagnoser said, and what it is worth."""

import numpy as np
import pytest

from fdi_gym.declaration import (
    BRIDGED,
    END,
    ONSET,
    PRESENT,
    SHORTEST,
    SIZE,
    alarms,
    declared,
    errors,
    true_declaration,
    worth,
)
from fdi_gym.diagnosis import Decisions
from fdi_gym.engine import simulate
from fdi_gym.faults import draw


def said(label, estimate=None):
    return Decisions(label > 0, label, estimate, None, None)


@pytest.fixture(scope="module")
def flown():
    kept = {}

    def fly(plant):
        if plant.id not in kept:
            scenarios = [draw(plant.process("standard"), 5_000_000 + i) for i in range(12)]
            kept[plant.id] = scenarios, simulate(plant, scenarios)
        return kept[plant.id]

    return fly


def test_truth_is_what_the_scenario_says(plant, flown):
    scenarios, record = flown(plant)
    truth = true_declaration(plant, record)
    for scenario, rows, length in zip(scenarios, truth, record.length, strict=True):
        acting = [f for f in scenario.faults if f.onset < length and (f.end is None or f.end > f.onset)]
        for mode, row in zip(plant.modes, rows, strict=True):
            mine = [f for f in acting if f.mode == mode.name]
            assert bool(row[PRESENT]) == bool(mine)
            if mine:
                ends = [length if f.end is None else min(f.end, length) for f in mine]
                assert (row[ONSET], row[END]) == (min(f.onset for f in mine), max(ends))
                assert mode.reach[0] - 1e-9 <= row[SIZE] <= mode.reach[1] + 1e-9
    assert truth[..., PRESENT].any()


def test_the_truth_said_in_time_is_worth_one_and_nothing_said_is_right_of_healthy_flights_only(plant, flown):
    _, record = flown(plant)
    truth = true_declaration(plant, record)
    whole = declared(plant, said(record.label, record.target), record.length)
    lasting = [all(b - a >= SHORTEST for a, b in zip(w[::2], w[1::2], strict=True))
               for w in (np.flatnonzero(np.diff(np.r_[0, row > 0, 0])) for row in record.label)]  # fmt: skip
    assert worth(plant, truth, whole)[lasting] == pytest.approx(1.0)
    nothing = declared(plant, said(np.zeros_like(record.label)), record.length)
    assert np.array_equal(worth(plant, truth, nothing), ~truth[..., PRESENT].any(axis=1).astype(bool))


def test_what_is_late_or_of_another_size_is_worth_less(motor, flown):
    _, record = flown(motor)
    truth = true_declaration(motor, record)
    i, j = np.argwhere(truth[..., PRESENT] > 0)[0]
    base = worth(motor, truth, truth)[i]
    late, larger, other = truth.copy(), truth.copy(), truth.copy()
    late[i, j, ONSET] += 0.5 * (truth[i, j, END] - truth[i, j, ONSET])
    reach = motor.modes[j].reach
    larger[i, j, SIZE] += 0.25 * (reach[1] - reach[0])
    other[i, j, PRESENT] = 0.0
    assert base == 1.0
    assert worth(motor, truth, late)[i] == pytest.approx(1 - 0.5 / 3)
    assert worth(motor, truth, larger)[i] == pytest.approx(1 - 0.25 / 3)
    assert worth(motor, truth, other)[i] == 0.0
    found = errors(motor, truth, late)
    assert found.onset[i, j] == pytest.approx(0.5 * (truth[i, j, END] - truth[i, j, ONSET]))
    assert errors(motor, truth, larger).size[i, j] == pytest.approx(0.25)


def test_alarms_bridge_gaps_and_leave_out_what_is_short():
    label = np.zeros(400, int)
    label[50:100], label[100 + BRIDGED : 150] = 1, 2
    label[300 : 300 + SHORTEST - 1] = 1
    assert alarms(label) == [(50, 150)]
    label[300 : 300 + SHORTEST] = 1
    assert alarms(label) == [(50, 150), (300, 300 + SHORTEST)]
    label[100 : 101 + BRIDGED] = 0
    assert alarms(label)[0] == (50, 100)


def test_a_first_guess_that_was_soon_corrected_is_not_declared_but_dates_the_fault(b747):
    label = np.zeros((1, 600), np.int16)
    label[0, 100:125], label[0, 125:] = 1, 3
    row = declared(b747, said(label), np.array([599]))[0]
    names = {m.name for m, r in zip(b747.modes, row, strict=True) if r[PRESENT]}
    assert names == set(b747.labels[3].modes)
    (at,) = np.flatnonzero(row[:, PRESENT])
    assert (row[at, ONSET], row[at, END]) == (99, 599)
