"""Sealed rounds: flights that nobody could fit a method to, since their seeds were secret and bound by a digest before.

    seal      draws seeds with the randomness of the operating system; ROUND.sealed.json is published now, ROUND.secret.json
              is kept by the organiser, and its SHA-256 is what the other one holds
    reveal    publishes the secret, which anybody can hold against the digest (sha256sum), and shows every submitted method
              the sealed flights: ROUND.json, an ordinary suite from then on, rows of it, and a page

A submission is a row of the public suite. A method that was fitted to the public flights does better on them than on others:
what its score loses is held against the intervals of both.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
import scipy.special
from msgspec import Meta

from fdi_gym.comparison import holm
from fdi_gym.design import DECISIONS, by_label
from fdi_gym.diagnosis import find_diagnoser
from fdi_gym.evaluation import digests_of, evaluate
from fdi_gym.files import RefusedError, decode, pretty, read_bytes, read_json, write_whole
from fdi_gym.intervals import CONFIDENCE
from fdi_gym.names import check_name, in_a_line
from fdi_gym.provenance import packages
from fdi_gym.row import Row, read_outcomes, read_row, row_files, write_rows
from fdi_gym.suite import LARGEST, ActingSuite, Suite, freeze, load_suite, suite_names
from fdi_gym.tables import isolates, markdown, plain
from fdi_gym.verification import check_made_by, check_row, check_settings, check_trusted

Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
FIRST = 2**61  # seeds are drawn below it


class Sealed(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is published when a round begins.

    Args:
        round: Its name, and that of its suite.
        suite, suite_sha256: The public suite whose rows are submissions.
        flights: How many are sealed.
        commitment: SHA-256 of the secret file.
    """

    schema: Literal[1] = 1
    round: str
    suite: str
    suite_sha256: Sha256
    flights: int
    commitment: Sha256


class Secret(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the organiser keeps: the sealed suite, and a number that nobody guesses, so that the digest tells nothing."""

    nonce: Sha256
    suite: Suite


class Compared(NamedTuple):
    """A method on public and on sealed flights."""

    public: Row
    sealed: Row


class Revealed(NamedTuple):
    """What a round has come to."""

    suite: Path
    methods: list[Compared]
    refused: dict[Path, str]  # rows that were not run, with the reason
    page: str


def seal(round: str, public: Suite, folder: Path, decisions: int = DECISIONS, episodes: int | None = None) -> Sealed:
    """Begin a round: draw the flights, and write what is published (ROUND.sealed.json) and what is kept (ROUND.secret.json).

    Args:
        round: Its name; no suite may have it.
        public: The suite whose rows are submissions: the sealed flights differ from its own in their seeds alone.
        folder: Where both files go; nobody else may read the secret one.
        decisions: Flights are drawn so that there are so many about every label at least.
        episodes: So many flights of consecutive seeds instead.

    Raises:
        ValueError: A name that cannot be one or is taken, flights that are recorded, or numbers out of range.
    """
    check_name("round", round)
    if not isinstance(public, Suite):
        raise ValueError(f"{public.name} holds recorded flights: nobody can draw others")
    if isinstance(public, ActingSuite):
        raise ValueError(f"{public.name} is of flights that are acted on: rounds are sealed of those that are shown to all")
    published, kept = folder / f"{round}.sealed.json", folder / f"{round}.secret.json"
    for path in (published, kept):
        if path.exists():
            raise ValueError(f"{path} is there already: a round is sealed once")
    if round in suite_names():
        raise ValueError(f"there is a suite {round} already; choose another name")
    first = secrets.randbelow(FIRST)
    suite = msgspec.structs.replace(
        public, name=round, description=f"Sealed flights beside {public.name}", healthy=[],
        seeds=list(range(first, first + public.windows * (1 if episodes is None else episodes))),
    )  # fmt: skip
    suite = by_label(suite, decisions, True, first) if episodes is None else suite
    secret = pretty(Secret(nonce=secrets.token_hex(32), suite=suite.sealed()))
    found = Sealed(
        round=round, suite=public.name, suite_sha256=public.sha256, flights=suite.episodes,
        commitment=hashlib.sha256(secret).hexdigest(),
    )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    with os.fdopen(os.open(kept, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(secret)
    write_whole(published, pretty(found))
    return found


def read_sealed(path: Path) -> Sealed:
    """What was published when a round began.

    Raises:
        RefusedError: It is no such file.
    """
    found = read_json(path, Sealed, "sealed round", LARGEST)
    if path.name != f"{check_name('round', found.round)}.sealed.json":
        raise RefusedError(f"{path} is of the round {found.round}, which belongs into {found.round}.sealed.json")
    return found


def opened(sealed: Sealed, secret: Path, public: Suite) -> Suite:
    """The sealed suite, from the organiser's file; nothing is built or imported.

    Raises:
        RefusedError: The file is not the one that was bound, or its suite differs from the public one in more than seeds.
    """
    content = read_bytes(secret, LARGEST)
    if hashlib.sha256(content).hexdigest() != sealed.commitment:
        raise RefusedError(f"{secret} is not the secret of {sealed.round}: its SHA-256 is not {sealed.commitment}")
    suite = decode(content, Secret, f"{secret} is not a secret of a round").suite
    if (public.name, public.sha256) != (sealed.suite, sealed.suite_sha256):
        raise RefusedError(f"{sealed.round} is beside version {sealed.suite_sha256[:12]} of {sealed.suite}")
    if (suite.name, suite.sha256) != (sealed.round, suite.content_sha256()):
        raise RefusedError(f"{secret} holds {suite.name}, which is not the round {sealed.round} as it was sealed")
    drawn = ("name", "description", "seeds", "healthy", "scenarios_sha256", "sha256")
    theirs, ours = (
        {k: v for k, v in msgspec.structs.asdict(s).items() if k not in drawn} for s in (suite, public)
    )  # fmt: skip
    if theirs != ours:
        differ = ", ".join(k for k in ours if ours[k] != theirs[k])
        raise RefusedError(f"{secret}: the sealed flights differ from those of {public.name} in {differ}")
    return suite


def reveal(
    published: Path, secret: Path, results: Path, *, suite: str = "", trust: Collection[str] = (), work: Path = Path("runs"),
    jobs: int = -1, progress: bool = True,
) -> Revealed:  # fmt: skip
    """End a round: publish its secret, and run every method that was submitted on the sealed flights.

    A submitted method must be here as it was: the same sources, data and settings as in its row.

    Args:
        published: ROUND.sealed.json. ROUND.json and ROUND.revealed.json are written beside it.
        secret: The organiser's file.
        results: Folder of rows: those of the public suite are the submissions, those of the sealed one are written there.
        suite: Path of the public suite, or "module:name", where it is not installed.
        trust: Diagnosers "module:function" that may be imported; no other module that a row names is.
        work: Folder of finished blocks.
        jobs: Worker processes, -1 for one per core.
        progress: Show a progress bar.

    Raises:
        RefusedError: The secret is not the one that was bound; or no row can be run.
        ValueError: There is no such suite.
        OSError: Something cannot be written.
    """
    sealed = read_sealed(published)
    public = load_suite(suite or sealed.suite)
    assert isinstance(public, Suite)
    flights = opened(sealed, secret, public)
    flights.check_scenarios(plant := flights.build())
    found: dict[str, tuple[Path, Row]] = {}
    refused: dict[Path, str] = {}
    folder = results / public.name
    for path in row_files(folder) if folder.is_dir() else ():
        try:
            row = read_row(path)
            check_trusted(row, path, trust)
            check_row(row, read_outcomes(path, row, plant), public, plant)
            check_settings(row, public, plant)
            check_made_by(row, digests_of(public, plant, row.diagnoser), packages(find_diagnoser(row.diagnoser), plant))
            found[row.diagnoser] = path, row
        except (ValueError, OSError) as error:
            refused[path] = in_a_line(error)
    if not found:
        reasons = "".join(f"; {reason}" for reason in refused.values())
        raise RefusedError(f"there is no row of {public.name} in {folder} that can be run{reasons}")
    place = published.parent
    file = freeze(flights, place)
    write_whole(place / f"{sealed.round}.revealed.json", read_bytes(secret, LARGEST))
    how = {"work": work, "jobs": jobs, "progress": progress, "command": f"fdi-gym reveal {published}"}
    try:
        again = evaluate(flights, list(found), **how)
    except ValueError:  # somebody's: whose is found one by one, from the blocks that are finished
        again = {}
        for name, (path, _) in found.items():
            try:
                again |= evaluate(flights, [name], **how)
            except ValueError as error:
                refused[path] = in_a_line(error)
    write_rows(results, flights, again)
    compared = [Compared(found[name][1], one.row) for name, one in again.items()]
    compared.sort(key=lambda pair: -(pair.sealed.metrics["per_sample"]["balanced_accuracy"] or 0.0))
    text = page(sealed, flights, compared)
    write_whole(place / f"{sealed.round}.md", text.encode())
    return Revealed(file, compared, refused, text)


# ---------------------------------------------------------------------------------------------------------------
# What is lost between public and sealed flights


class Loss(NamedTuple):
    """Public less sealed score, its 95 % interval, and whether it is more than chance, of all methods together."""

    value: float
    low: float
    high: float
    real: bool


def losses(pairs: Sequence[Compared], kind: str) -> dict[str, Loss]:
    """What each method's balanced accuracy loses on sealed flights, by name; those without one are left out.

    The interval of the difference is made of the two scores' intervals, the flights being independent (Zou & Donner, 2008,
    Stat. Med. 27(10):1693-1702; Newcombe's for shares). Of many methods each is asked for more, by Holm's procedure.

    Args:
        pairs: The methods.
        kind: "per_sample", "per_decision" or "detection".
    """
    names, rows, p = [], [], []
    for pair in pairs:
        found = [row.metrics[kind] for row in pair]
        if any(one["balanced_accuracy"] is None for one in found):
            continue
        (a, (la, ha)), (b, (lb, hb)) = ((one["balanced_accuracy"], one["balanced_accuracy_interval"]) for one in found)
        gap = a - b
        low, high = gap - np.hypot(a - la, hb - b), gap + np.hypot(ha - a, b - lb)
        spread = (gap - low if gap > 0 else high - gap) / scipy.special.ndtri(0.5 + CONFIDENCE / 2)
        p.append(1.0 if abs(gap) < 1e-12 else 2 * scipy.special.ndtr(-abs(gap) / spread) if spread > 1e-12 else 0.0)
        names.append(pair.public.diagnoser)
        rows.append((float(gap), float(low), float(high)))
    real = holm(np.array(p)) < 1 - CONFIDENCE
    return {
        name: Loss(row[0], row[1], row[2], bool(one and row[0] > 0))
        for name, row, one in zip(names, rows, real, strict=True)
    }


KINDS = {"per_sample": "Isolation, per sample", "per_decision": "Isolation, per decision", "detection": "Detection"}


def page(sealed: Sealed, flights: Suite, pairs: Sequence[Compared]) -> str:
    """The page of a round, as Markdown."""
    parts = [
        f"# {sealed.round}\n\n{flights.episodes} flights beside the public ones of {sealed.suite}; their seeds were bound "
        f"by `{sealed.commitment}`, the SHA-256 of `{sealed.round}.revealed.json`.\n\nBalanced accuracy in percent, with "
        "95 % intervals. What a method loses is marked where it is more than chance, of all methods together (Holm): it was "
        "fitted to the public flights.\n"
    ]  # fmt: skip
    for kind, title in KINDS.items():
        lost = losses([pair for pair in pairs if kind == "detection" or isolates(pair.public)], kind)
        lines = [
            [plain(name), *(_score(row.metrics[kind]) for row in pair), _points(lost[name]), "!" if lost[name].real else ""]
            for pair in pairs if (name := pair.public.diagnoser) in lost
        ]  # fmt: skip
        body = markdown(["method", "public %", "sealed %", "loses", "fitted"], lines) if lines else "No rows."
        parts.append(f"## {title}\n\n{body}\n")
    return "\n".join(parts)


def _score(found: dict[str, Any]) -> str:
    low, high = found["balanced_accuracy_interval"]
    return f"{100 * found['balanced_accuracy']:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def _points(loss: Loss) -> str:
    return f"{100 * loss.value:+.1f} [{100 * loss.low:+.1f}, {100 * loss.high:+.1f}]"
