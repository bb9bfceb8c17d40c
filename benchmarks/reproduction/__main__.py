"""The command; see the package's docstring."""

from pathlib import Path

import tyro

from benchmarks.reproduction.index import write


def main(pages: Path = Path("leaderboards/reproduction")) -> None:
    """Write the index over the papers, and what differs from each.

    Args:
        pages: Folder of the pages and their pieces.
    """
    write(pages)
    print(pages / "README.md", pages / "differences.md")


if __name__ == "__main__":
    tyro.cli(main)
