"""The rows of the suites whose flights are acted on, and the page of what could be known with and without probes.

    python -m benchmarks.acting [SUITE ...] [--bounds]

A row that is there is not made again. `fdi-gym leaderboard` renders the pages of the suites; the bounds are written here.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

from benchmarks.acting.bounds import page
from benchmarks.acting.entrants import ENTRANTS
from fdi_gym.evaluation import applicable, evaluate
from fdi_gym.row import row_path, write_rows
from fdi_gym.suite import load_suite

BOARDS = Path(__file__).parent.parent.parent / "leaderboards"


def main() -> None:
    """Make the rows that are missing, or the page of the bounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", metavar="SUITE", help=", ".join(ENTRANTS))
    parser.add_argument("--bounds", action="store_true", help="the page of the bounds alone")
    parser.add_argument("--jobs", type=int, default=-1)
    arguments = parser.parse_args()
    if arguments.bounds:
        (BOARDS / "acting-bounds.md").write_text(page())
        return
    for name in arguments.suites or ENTRANTS:
        if name not in ENTRANTS:
            parser.error(f"unknown suite {name!r}; there are {', '.join(ENTRANTS)}")
        suite, results = load_suite(name), BOARDS / "results"
        missing = [entrant for entrant in ENTRANTS[name] if not row_path(results, name, entrant).exists()]
        able, _ = applicable(suite, suite.build(), missing)
        for entrant in able:
            found = evaluate(
                suite, [entrant], work=Path("runs"), jobs=arguments.jobs, command=f"fdi-gym evaluate {name} --diagnosers"
            )
            write_rows(results, suite, found)


if __name__ == "__main__":
    main()
