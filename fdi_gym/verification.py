"""Verification: no row is believed that cannot be recomputed.

What a row says is compared with its suite, its outcomes and the code that is here; then some of its episodes are run
again. Which ones is drawn by whoever verifies, so that nobody can know beforehand which others to make up.

Sources may change without a change of outcomes. A row is then still what the code gives but not made of what it says:
renewing it writes the digests of what is here into it, and into a row that the code no longer gives nothing.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import msgspec
import numpy as np

from fdi_gym.clusters import check_jobs
from fdi_gym.diagnosis import diagnosers, probers
from fdi_gym.entrants import TRUTH, find_entrant, settings_of
from fdi_gym.evaluation import diagnose, digests_of
from fdi_gym.files import RefusedError, pretty, write_whole
from fdi_gym.metrics import Outcome
from fdi_gym.names import unknown
from fdi_gym.plant import Plant
from fdi_gym.provenance import packages
from fdi_gym.row import Row, read_outcomes, read_row
from fdi_gym.scores import summarise
from fdi_gym.suite import AnySuite, load_suite


class Verified(NamedTuple):
    """A row that holds: which of its episodes were run again, and which of its digests were made anew."""

    episodes: list[int]
    renewed: list[str]


ACROSS = 1e-3  # errors of estimates agree so well on another processor, where rounding grows; counts and labels do exactly


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


def check_settings(row: Row, suite: AnySuite, plant: Plant) -> None:
    """Compare a row with the settings that its diagnoser's builder gets here.

    Raises:
        RefusedError: They are others; they are named.
    """
    _compare(row, row.settings, settings_of(suite, plant, row.diagnoser), "settings")


def check_made_by(row: Row, digests: Mapping[str, str], packages: Mapping[str, str]) -> None:
    """Compare a row with the digests of what would make it here, and the versions of the packages where it says them.

    Raises:
        RefusedError: They are others; they are named.
    """
    try:
        _compare(row, {k: v for k, v in row.digests.items() if k != "outcomes"}, dict(digests), "digests")
        if row.packages is not msgspec.UNSET:
            _compare(row, row.packages, dict(packages), "packages")
    except RefusedError as error:
        raise RefusedError(f"{error} (renew it, if the code still gives the same outcomes)") from None


def check_episodes(row: Row, outcomes: Sequence[Outcome], suite: AnySuite, plant: Plant, episodes: Sequence[int]) -> None:
    """Run episodes again and compare their outcomes.

    Raises:
        RefusedError: One has another outcome; it is named.
    """
    block = diagnose(suite, plant, row.diagnoser, episodes)
    for i, again in zip(episodes, block.outcomes, strict=True):
        said = msgspec.json.decode(msgspec.json.encode(outcomes[i]))
        try:
            _compare(row, said, again, f"outcomes[{i}]", tolerance=ACROSS)
        except RefusedError as error:
            raise RefusedError(f"the code no longer gives this row; {error}") from None


def check_trusted(row: Row, path: Path, trust: Collection[str]) -> None:
    """Make sure, before anything is imported, that a row's method is installed, or may be imported.

    Raises:
        RefusedError: It is neither.
    """
    if ":" in row.diagnoser and row.diagnoser not in trust:
        raise RefusedError(
            f"{path}: {row.diagnoser} is code outside the package; look at it, then once more with --trust {row.diagnoser}"
        )
    known = [*diagnosers(), *probers(), TRUTH.name]
    if ":" not in row.diagnoser and row.diagnoser not in known:
        raise RefusedError(f"{path}: {unknown('diagnoser', row.diagnoser, known)}")


def check_drawing(share: float, seed: int | None) -> None:
    """Check what draws the episodes that are run again.

    Raises:
        ValueError: The share or seed is out of range.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share is above 0 and up to 1, not {share}")
    if seed is not None and seed < 0:
        raise ValueError(f"seed is 0 or more, not {seed}")


def verify(
    path: Path,
    share: float = 0.1,
    *,
    seed: int | None = None,
    suite: str = "",
    trust: Collection[str] = (),
    renew: bool = False,
) -> Verified:
    """Check everything in a row, and run a share of its episodes again.

    Args:
        path: The row's file; its outcomes lie beside it.
        share: Share of the episodes to run again, above 0 and up to 1; at least one is.
        seed: Draws which ones; None for the system's randomness.
        suite: Name or path of the suite; default: the one of this package that the row names.
        trust: Diagnosers of the form "module:function" that may be imported; no other module that a row names is.
        renew: Where other sources, data, belief or calibration are here than those that made the row, and all else holds,
            write their digests into it. Its outcomes, figures and settings stay as they are; so does a row that fails.

    Raises:
        ValueError: The share or seed is out of range; `RefusedError` where the row fails, in words.
        OSError: The row cannot be written.
    """
    check_drawing(share, seed)
    row = read_row(path)
    check_trusted(row, path, trust)
    frozen = load_suite(suite or row.suite)
    plant = frozen.build()
    outcomes = read_outcomes(path, row, plant)
    check_row(row, outcomes, frozen, plant)
    check_settings(row, frozen, plant)
    digests, brought = digests_of(frozen, plant, row.diagnoser), packages(find_entrant(frozen, plant, row.diagnoser), plant)
    if not renew:
        check_made_by(row, digests, brought)
    rng = np.random.default_rng(seed)
    count = min(frozen.episodes, max(1, math.ceil(share * frozen.episodes)))
    episodes = sorted(int(i) for i in rng.choice(frozen.episodes, count, replace=False))
    check_episodes(row, outcomes, frozen, plant, episodes)
    changed = [*row.changed(digests), *(["packages"] if row.packages != brought else [])] if renew else []
    if changed:
        write_whole(path, pretty(row.made_by(digests, brought)))
    return Verified(episodes, changed)


def verify_all(
    paths: Sequence[Path], share: float = 0.1, *, seed: int | None = None, jobs: int = 1, **options: Any
) -> Iterator[tuple[Path, Verified | ValueError | OSError]]:
    """Verify many rows, in parallel: in their order each with what was found, or the error that refuses it.

    Args:
        paths: The rows' files.
        share, seed: As for `verify`.
        jobs: Worker processes, -1 for one per core.
        options: The further ones of `verify`.

    Raises:
        ValueError: The share, the seed or the number of jobs is out of range.
    """
    check_drawing(share, seed)
    check_jobs(jobs)
    calls = (joblib.delayed(_tried)(path, share, {"seed": seed, **options}) for path in paths)
    parallel: Any = joblib.Parallel(n_jobs=jobs if len(paths) > 1 else 1, return_as="generator")
    return zip(paths, parallel(calls), strict=True)


def _tried(path: Path, share: float, options: Mapping[str, Any]) -> Verified | ValueError | OSError:
    try:
        return verify(path, share, **options)
    except (ValueError, OSError) as error:
        return error
