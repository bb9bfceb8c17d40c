"""Sealed rounds: seal, reveal."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from fdi_gym.commands.arguments import Backend, Cluster, Names, SuiteName


def seal(
    round: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ROUND")],
    suite: SuiteName,
    folder: Path = Path(),
    decisions: int = 30,
    episodes: int | None = None,
) -> None:
    """Begin a sealed round: draw secret flights, and write their digest, to be published now.

    Args:
        round: Its name.
        suite: The public suite whose rows are submissions: its name, or path of its file.
        folder: Where ROUND.sealed.json (publish it) and ROUND.secret.json (keep it) go.
        decisions: Flights are drawn so that there are so many decisions about every label at least.
        episodes: So many flights of consecutive seeds instead.
    """
    from fdi_gym import rounds
    from fdi_gym.suite import load_suite

    found = rounds.seal(round, load_suite(suite), folder, decisions, episodes)  # type: ignore[arg-type]
    print(f"{folder / round}.sealed.json: {found.flights} flights, bound by {found.commitment}; publish it")
    print(f"{folder / round}.secret.json: keep it, and keep it to yourself; fdi-gym reveal publishes it")


def reveal(
    sealed: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ROUND.sealed.json")],
    secret: Path | None = None,
    results: Path = Path("leaderboards/results"),
    suite: Annotated[str, tyro.conf.arg(metavar="SUITE")] = "",
    trust: Names = (),
    work: Path = Path("runs"),
    jobs: int = -1,
    backend: Backend = "loky",
    cluster: Cluster = {},  # noqa: B006 (tyro reads the default)
) -> None:
    """End a sealed round: check its secret against the digest, publish it, and run every submitted method on its flights.

    Writes ROUND.json (a suite like any other from now on), ROUND.revealed.json and ROUND.md beside the published file, and
    rows of ROUND. A row that is refused, or whose method is another one here, is named and not run.

    Args:
        sealed: What was published.
        secret: The organiser's file. Default: ROUND.secret.json beside the published one.
        results: Folder of the rows: those of the public suite are the submissions.
        suite: Name of the public suite, or path of its file. Default: the name that the round says.
        trust: Diagnosers "module:function" that may be imported. Look at their code first.
        work: Folder of finished blocks.
        jobs: Worker processes, -1 for one per core.
        backend: Where they run: "loky" is this machine; dask, ray and slurm are clusters that exist.
        cluster: What the cluster is told, as name and value in turn: address HOST:PORT, or parameters of submitit.
    """
    from fdi_gym import rounds
    from fdi_gym.clusters import on

    kept = sealed.with_name(sealed.name.replace(".sealed.json", ".secret.json")) if secret is None else secret
    with on(backend, cluster, work):
        found = rounds.reveal(sealed, kept, results, suite=suite, trust=trust, work=work, jobs=jobs)
    print(f"\n{found.page}")
    print(f"{found.suite}, rows in {results / found.suite.stem}")
    for path, reason in found.refused.items():
        print(f"{path}: not run: {reason}", file=sys.stderr)
    if found.refused:
        raise ValueError(f"{len(found.refused)} of {len(found.refused) + len(found.methods)} submissions were not run")
