"""What a suite's rows say, as plain data for the page: table, comparisons, confusions, curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fdi_gym import comparison, tables
from fdi_gym.curves import Curve, delay_curve, label_curve, severity_curve
from fdi_gym.diagnosis import diagnosers
from fdi_gym.leaderboard import Board
from fdi_gym.metrics import BANDS
from fdi_gym.plant import Array
from fdi_gym.row import Row

KINDS = ("per_sample", "per_decision")


def figures(board: Board) -> dict[str, Any]:
    """All of the page but the flights to look at."""
    suite, plant = board.suite, board.plant
    ranked = sorted(board.rows, key=lambda row: (-(row.metrics["per_sample"]["balanced_accuracy"] or 0.0), row.diagnoser))
    drawn = {kind: board.drawn(board.honest(), kind) for kind in KINDS}
    tied = comparison.tied_with_best(drawn["per_sample"])
    groups = {name: shown for name, (_, shown) in tables.RANKINGS.items()}
    columns = list(dict.fromkeys(column for shown in groups.values() for column in shown))
    return {
        "suite": {
            "name": suite.name, "description": suite.description, "env": suite.env, "process": suite.process,
            "flights": suite.episodes, "version": suite.sha256[:12],
            "decisions": board.rows[0].metrics["decisions"] if board.rows else 0,
        },
        "labels": [label.name for label in plant.labels],
        "bands": BANDS,
        "columns": [{"key": key, "head": tables.COLUMNS[key][0]} for key in columns],
        "groups": groups,
        "methods": [_method(board, row, columns, row.diagnoser in tied) for row in ranked],
        "compared": {kind: _compared(drawn[kind]) for kind in KINDS},
    }  # fmt: skip


def _method(board: Board, row: Row, columns: Sequence[str], tied: bool) -> dict[str, Any]:
    entry, outcomes = diagnosers().get(row.diagnoser), board.outcomes[row.diagnoser]
    line = tables.Line(row, board.times.get(row.diagnoser), tied, board.attainable())
    labels, dt = len(board.plant.labels), board.plant.dt
    return {
        "name": row.diagnoser,
        "summary": entry.summary if entry else "",
        "family": _family(row),
        "knows": tables.knows(row),
        "ceiling": tables.ceiling(row),
        "lost": row.metrics["lost_episodes"],
        "cells": [tables.COLUMNS[key][1](line) for key in columns],
        "score": {kind: _score(row.metrics[kind]) for kind in KINDS},
        "confusion": {kind: row.metrics[kind]["confusion"] for kind in KINDS},
        "delay": {kind: _curve(delay_curve(outcomes, kind, dt)) for kind in ("detection", "isolation")},
        "severity": {kind: _curve(severity_curve(outcomes, kind)) for kind in KINDS},
        "recall": {kind: _curve(label_curve(outcomes, labels, kind)) for kind in KINDS},
    }  # fmt: skip


def _score(found: dict[str, Any]) -> list[float | None]:
    return _numbers([found["balanced_accuracy"], *(found["balanced_accuracy_interval"] or (None, None))])


def _family(row: Row) -> str:
    """What kind of method it is: the package that its file lies in; what frames the table is called so."""
    if row.diagnoser in tables.FLOOR:
        return "floor"
    entry = diagnosers().get(row.diagnoser)
    if entry is None:
        return "others"
    parts = entry.build.__module__.split(".")
    return parts[1] if len(parts) > 2 else parts[0]


def _compared(drawn: comparison.Drawn) -> dict[str, Any]:
    """Pairs of methods: difference, half its interval, and p of none, Holm-corrected over all that one is compared with."""
    n = len(drawn.names)
    order = np.argsort(-drawn.score, kind="stable") if n else np.zeros(0, int)
    p = drawn.p_values() if n else np.zeros((0, 0))
    gaps, reaches, holm = np.zeros((3, n, n))
    for i in range(n):
        others = [j for j in range(n) if j != i]
        holm[i, others] = comparison.holm(p[i, others])
        for j in others:
            gap, low, high = drawn.difference(drawn.names[i], drawn.names[j])
            gaps[i, j], reaches[i, j] = gap, (high - low) / 2
    square = np.ix_(order, order)
    return {
        "names": [drawn.names[i] for i in order],
        "gap": [_numbers(line) for line in gaps[square]], "reach": [_numbers(line) for line in reaches[square]],
        "p": [_numbers(line) for line in holm[square]], "cliques": comparison.cliques(drawn) if n > 1 else [],
    }  # fmt: skip


def _curve(curve: Curve) -> dict[str, Any]:
    return {name: _numbers(values) for name, values in curve._asdict().items()}


def _numbers(values: Sequence[float | None] | Array) -> list[float | None]:
    """To five digits, since nobody sees more; None where there is none."""
    return [None if v is None or not np.isfinite(v) else float(f"{v:.5g}") for v in values]
