"""What probing and accommodation are worth, on every plant; the page `leaderboards/acting.md` and its pictures.

    python -m benchmarks.acting [SUITE ...] [--page-only]

Figures lie in `leaderboards/acting/`, one file a suite; what is there is not measured again: remove it for that.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

from benchmarks.acting import measure, page
from benchmarks.acting.bounds import bounds
from benchmarks.acting.suites import ACCOMMODATION, ACTIVE

BOARDS = Path(__file__).parent.parent.parent / "leaderboards"
DATA = BOARDS / "acting"


def measured() -> dict[str, dict]:
    """What has been measured, by suite."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(DATA.glob("*.json"))}


def main() -> None:
    """Measure, and write the page."""
    everything = [*ACTIVE, *ACCOMMODATION, "bounds"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", default=everything, metavar="SUITE", help=", ".join(everything))
    parser.add_argument("--page-only", action="store_true", help="write the page of the figures that are there")
    arguments = parser.parse_args()
    for name in () if arguments.page_only else arguments.suites:
        if name not in everything:
            parser.error(f"unknown suite {name!r}; there are {', '.join(everything)}")
        print(name, flush=True)
        if name in ACTIVE:
            measure.kept(DATA / f"{name}.json", lambda s=ACTIVE[name]: measure.probing(s))
        elif name in ACCOMMODATION:
            measure.kept(DATA / f"{name}.json", lambda s=ACCOMMODATION[name]: measure.accommodation(s))
        else:
            measure.kept(DATA / "bounds.json", lambda: {"rows": bounds()})
    found = measured()
    page.draw(found, BOARDS / "pictures")
    (BOARDS / "acting.md").write_text(page.page(found, "leaderboards/acting"))


if __name__ == "__main__":
    main()
