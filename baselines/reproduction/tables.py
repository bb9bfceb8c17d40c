"""What the reproductions share: resumable pieces, comparison of figures, Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import joblib
import msgspec
from tqdm import tqdm

from fdi_gym.files import RefusedError, read_json, write_whole
from fdi_gym.tables import markdown

__all__ = ["compared", "markdown", "pieces"]


def pieces(folder: Path, jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]], workers: int = -1) -> dict[str, Any]:
    """Run named jobs in parallel; each result is one JSON file, and what is there already, undamaged, is not run again."""
    folder.mkdir(parents=True, exist_ok=True)

    def one(name: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        write_whole(folder / f"{name}.json", msgspec.json.encode(function(*arguments)))

    def there(name: str) -> bool:
        try:
            read_json(folder / f"{name}.json", object, "piece")
        except RefusedError:  # there is none, or it is damaged
            return False
        return True

    missing = {name: job for name, job in jobs.items() if not there(name)}
    if missing:
        parallel = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")
        tasks = (joblib.delayed(one)(name, *job) for name, job in missing.items())
        for _ in tqdm(parallel(tasks), total=len(missing), unit="piece"):
            pass
    return {name: read_json(folder / f"{name}.json", object, "piece") for name in jobs}


def compared(reference: float, found: float, error: float, digits: int = 3, tally: list[bool] | None = None) -> str:
    """ "reference / found", starred where they differ by more than three standard errors of the difference.

    Half a unit of the reference's last digit is allowed for its rounding.
    """
    same = (math.isnan(reference) and math.isnan(found)) or abs(reference - found) <= 3 * error + 0.5 * 10**-digits
    if tally is not None:
        tally.append(same)
    return f"{reference:.{digits}f} / {found:.{digits}f}{'' if same else ' *'}"
