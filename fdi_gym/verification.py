"""Verification: no row is believed that cannot be recomputed.

What a row says is compared with its suite, its outcomes and the code that is here; then some of its episodes are run
again. Which ones is drawn by whoever verifies, so that nobody can know beforehand which others to make up.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fdi_gym.diagnosis import diagnosers
from fdi_gym.evaluation import diagnose, digests_of, settings_of
from fdi_gym.files import RefusedError
from fdi_gym.metrics import Outcome
from fdi_gym.names import unknown
from fdi_gym.plant import Plant
from fdi_gym.row import Row, read_outcomes, read_row
from fdi_gym.scores import summarise
from fdi_gym.suite import AnySuite, load_suite


def _differences(said: Any, found: Any, path: str, tolerance: float = 1e-9) -> Iterator[str]:
    """Where two nests of figures differ, by name."""
    if isinstance(said, dict) and isinstance(found, dict):
        for key in [*said, *(k for k in found if k not in said)]:
            place = f"{path}.{key}" if path else key
            yield from _differences(said.get(key, "nothing"), found.get(key, "nothing"), place, tolerance)
    elif isinstance(said, list) and isinstance(found, list) and len(said) == len(found):
        for i, (a, b) in enumerate(zip(said, found, strict=True)):
            yield from _differences(a, b, f"{path}[{i}]", tolerance)
    elif isinstance(said, float) and isinstance(found, float):
        if not math.isclose(said, found, rel_tol=tolerance, abs_tol=1e-12):
            yield f"{path}: the row says {said!r}, it is {found!r}"
    elif type(said) is not type(found) or said != found:
        yield f"{path}: the row says {said!r}, it is {found!r}"


def _compare(row: Row, said: Any, found: Any, path: str, tolerance: float = 1e-9) -> None:
    found = msgspec.json.decode(msgspec.json.encode(found))  # as a file holds it
    differences = list(_differences(said, found, path, tolerance))
    if differences:
        raise RefusedError(f"{row.suite}/{row.diagnoser}: {'; '.join(text[:300] for text in differences[:5])}")


def check_row(row: Row, outcomes: Sequence[Outcome], suite: AnySuite, plant: Plant) -> None:
    """Compare a row with its suite and its outcomes: its figures. Nothing is run or imported.

    Raises:
        RefusedError: Another suite, or a figure that does not follow from the outcomes; it is named.
    """
    here = f"{row.suite}/{row.diagnoser}"
    if (row.suite, row.suite_sha256) != (suite.name, suite.sha256):
        raise RefusedError(
            f"{here}: made with version {row.suite_sha256[:12]} of the suite; here is {suite.name} {suite.sha256[:12]}"
        )
    if len(outcomes) != suite.episodes:
        raise RefusedError(f"{here}: {len(outcomes)} episodes, the suite has {suite.episodes}")
    found = summarise(outcomes, len(plant.labels), [s.name for s in plant.estimated], plant.dt)
    _compare(row, row.metrics, found, "metrics")


def check_made_by(row: Row, suite: AnySuite, plant: Plant) -> None:
    """Compare a row with the code that is here: its settings, and the digests of what made it.

    Raises:
        RefusedError: They are others; they are named.
    """
    _compare(row, row.settings, settings_of(suite, plant, row.diagnoser), "settings")
    digests = {k: v for k, v in row.digests.items() if k != "outcomes"}
    _compare(row, digests, digests_of(suite, plant, row.diagnoser), "digests")


def check_episodes(row: Row, outcomes: Sequence[Outcome], suite: AnySuite, plant: Plant, episodes: Sequence[int]) -> None:
    """Run episodes again and compare their outcomes.

    Raises:
        RefusedError: One has another outcome; it is named.
    """
    block = diagnose(suite, plant, row.diagnoser, episodes)
    for i, again in zip(episodes, block.outcomes, strict=True):
        _compare(row, msgspec.json.decode(msgspec.json.encode(outcomes[i])), again, f"outcomes[{i}]", tolerance=1e-6)


def verify(
    path: Path, share: float = 0.1, *, seed: int | None = None, suite: str = "", trust: Collection[str] = ()
) -> list[int]:
    """Check everything in a row, and run a share of its episodes again; returns which.

    Args:
        path: The row's file; its outcomes lie beside it.
        share: Share of the episodes to run again, above 0 and up to 1; at least one is.
        seed: Draws which ones; None for the system's randomness.
        suite: Name or path of the suite; default: the one of this package that the row names.
        trust: Diagnosers of the form "module:function" that may be imported; no other module that a row names is.

    Raises:
        ValueError: The share or seed is out of range; `RefusedError` where the row fails, in words.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share is above 0 and up to 1, not {share}")
    if seed is not None and seed < 0:
        raise ValueError(f"seed is 0 or more, not {seed}")
    row = read_row(path)
    if ":" in row.diagnoser and row.diagnoser not in trust:
        raise RefusedError(
            f"{path}: {row.diagnoser} is code outside the package; look at it, then verify with --trust {row.diagnoser}"
        )
    if ":" not in row.diagnoser and row.diagnoser not in diagnosers():
        raise RefusedError(f"{path}: {unknown('diagnoser', row.diagnoser, diagnosers())}")
    frozen = load_suite(suite or row.suite)
    plant = frozen.build()
    outcomes = read_outcomes(path, row, plant)
    check_row(row, outcomes, frozen, plant)
    check_made_by(row, frozen, plant)
    rng = np.random.default_rng(seed)
    count = min(frozen.episodes, max(1, math.ceil(share * frozen.episodes)))
    episodes = sorted(int(i) for i in rng.choice(frozen.episodes, count, replace=False))
    check_episodes(row, outcomes, frozen, plant, episodes)
    return episodes
