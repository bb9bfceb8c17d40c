"""The pages of the leaderboards: one a suite, with its tables and pictures, and the page that leads to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from fdi_gym import acting_board
from fdi_gym.acted import Acted
from fdi_gym.comparison import Drawn, cliques, draw_again, tied_with_best
from fdi_gym.files import RefusedError
from fdi_gym.metrics import Outcome
from fdi_gym.plant import Plant
from fdi_gym.row import Row, read_made, read_outcomes, read_row, row_files
from fdi_gym.suite import ActingSuite, AnySuite, load_suite
from fdi_gym.tables import (
    FLOOR,
    RANKINGS,
    ceiling,
    clairvoyant,
    isolates,
    markdown,
    plain,
    table,
    told,
)
from fdi_gym.verification import check_row

INTRODUCTION = """# Leaderboards

Rendered by `fdi-gym leaderboard` from the rows in `results/`; a test renders it again and compares. Check a row with
`fdi-gym verify leaderboards/results/<suite>/<row>.json`.

A suite has at least 30 decisions about every label (papers' suites: about those that the paper's scenario has). There is
one decision about each window of a fault, and one about each healthy flight. Four tasks are ranked, each by its own figure:

- **Isolation**: balanced accuracy, the mean over the labels of the share of right answers, in percent, per sample (outside
  the grace after a change) and per decision. Raw accuracy never ranks: often "always none" is right most of the time.
  Attained: the way from chance to what can be attained that a method has gone, in percent. What can be attained lies
  between the best that is told nothing and the ceiling, so there are two figures: [how wide that bracket is](attainable.md).
  S/M/L: share of right samples while the smallest active fault is small, medium, large. The log score is the mean log
  probability of the true label. Methods that declare one label throughout are not ranked here.
- **Detection**: mean of the share of healthy samples without and of faulty samples with an alarm. Beside it false alarms
  per healthy hour (one that is on from the start counts), the share of healthy time under alarm, the share of faults that
  begin under an alarm, and of the others the share never detected.
- **Identification**, while a fault acts: the error relative to that of always estimating "healthy" (1), 0 is perfect; the
  share of errors within 1.96 of the stated deviations (95 % if they are right); NEES per entry (1 if they are right); the
  root mean square error of each entry with its unit.
- **Scenario**: what labels and estimates amount to as one declaration of the whole flight, 0 for a wrong set of faults, else
  the mean of 1, the overlap of the windows and 1 less the error of the size as a share of its reach. Beside it the share of
  flights with the right set of faults, and for faults that are both true and declared the onset's error (median and
  quartiles), the windows' overlap and the size's median error.

Delays in seconds: mean, if longer ones count as the median length of a fault, then median (quartiles), right-censored where
never reached. Faults that begin under an alarm, or with their label declared already, are left out.

Intervals are 95 %; how often they hold the truth is [measured](coverage.md). Methods are compared on the same flights, by
a paired bootstrap within labels with Holm's correction; "=" marks those that cannot be told from the best. Methods marked
"*" know a part of the truth, each page says which; ceilings frame the tables and are never "best". Times are processor
times per sample on the machine of the run, in blocks of 100 flights.
"""

ACTING = """## Where the diagnosis acts

Suites of probing: the best prober that chooses and the best entrant that never probes, per sample %. Of accommodation: the
share of what the truth recovers of the flights' cost, in percent. What could be known with and without probes:
[bounds](acting-bounds.md).
"""


class Board(NamedTuple):
    """All that is on a suite's page."""

    suite: AnySuite
    plant: Plant
    rows: list[Row]
    outcomes: dict[str, list[Outcome]]
    times: dict[str, float]

    def honest(self) -> list[Row]:
        """The rows of methods that isolate and are told nothing."""
        return [row for row in self.rows if isolates(row) and not clairvoyant(row) and row.diagnoser not in FLOOR]

    def drawn(self, rows: list[Row], kind: str = "per_sample") -> Drawn:
        """Their scores, on resamples of the flights."""
        return draw_again({row.diagnoser: self.outcomes[row.diagnoser] for row in rows}, len(self.plant.labels), kind)

    def acted(self, suite: ActingSuite) -> Acted:
        """The rows as those of a suite whose flights are acted on."""
        return Acted(suite, self.plant, self.rows, self.outcomes)

    def attainable(self) -> list[float]:
        """The scores per sample between which what can be attained lies: of the best that is told nothing, and of a ceiling.

        Empty where the board has no ceiling, or nothing that it could hold for.
        """
        best, top = self.best(), self.top()
        if best is None or top is None:
            return []
        low, high = (row.metrics["per_sample"]["balanced_accuracy"] for row in (best, top))
        return [low, max(low, high)]

    def top(self) -> Row | None:
        """The highest ceiling."""
        above = (row for row in self.rows if ceiling(row))
        return max(above, key=lambda row: row.metrics["per_sample"]["balanced_accuracy"], default=None)

    def best(self) -> Row | None:
        """The best row of a method that is told nothing."""
        return max(self.honest(), key=lambda row: row.metrics["per_sample"]["balanced_accuracy"], default=None)


def read_rows(folder: Path) -> list[Row]:
    """The rows in a suite's folder; those that are not rows are refused.

    Raises:
        RefusedError: One is not a row, or of another suite.
    """
    rows = [read_row(path) for path in row_files(folder)] if folder.is_dir() else []
    for row in rows:
        if row.suite != folder.name:
            raise RefusedError(f"{folder} holds a row of {row.diagnoser} on another suite, {row.suite}")
    return rows


def read_board(folder: Path, suites: Mapping[str, AnySuite] = MappingProxyType({})) -> Board:
    """A suite's rows, each checked against its outcomes.

    Args:
        folder: Of the suite's rows.
        suites: By name, those that are not installed.

    Raises:
        RefusedError: A row does not agree with its outcomes or its suite; it is named.
    """
    suite = suites[folder.name] if folder.name in suites else load_suite(folder.name)
    rows, outcomes = read_rows(folder), {}
    plant = suite.build()
    for path, row in zip(row_files(folder), rows, strict=True):
        outcomes[row.diagnoser] = read_outcomes(path, row, plant)
        check_row(row, outcomes[row.diagnoser], suite, plant)
    return Board(suite, plant, rows, outcomes, {name: made.microseconds for name, made in read_made(folder).items()})


def tables(board: Board, columns: tuple[str, ...] = (), width: int | None = None) -> str:
    """The rankings, or how acting is compared; with columns of one's choice one table, ranked by isolation."""
    if isinstance(board.suite, ActingSuite) and not columns:
        return acting_board.tables(board.acted(board.suite), width)
    tied = tied_with_best(board.drawn(board.honest()))
    if columns:
        rows = RANKINGS["Isolation"][0](board.rows)
        rows += [row for row in RANKINGS["Detection"][0](board.rows) if row not in rows]
        text = table(rows, board.times, columns, tied, width=width, attainable=board.attainable())
        return f"{text}\n\n{told(rows)}".rstrip()
    parts = []
    for name, (rank, shown) in RANKINGS.items():
        rows = rank(board.rows)
        plant = board.plant if name == "Identification" else None
        text = table(rows, board.times, shown, tied, plant, width, board.attainable()) if rows else "No rows."
        parts.append(f"## {name}\n\n{text}\n")
    constant = [plain(row.diagnoser) for row in board.rows if not isolates(row) and row.diagnoser not in FLOOR]
    if constant:
        parts.insert(1, f"Not ranked, since they declare one label throughout: {', '.join(constant)}.\n")
    return "\n".join([*parts, told(board.rows)]).rstrip()


def page(board: Board) -> str:
    """The page of a suite."""
    suite = board.suite
    head = (
        f"# {suite.name}\n\n{plain(suite.description)}\n\n`{suite.env}`, process `{suite.process}`, {suite.episodes} "
        f"flights, version `{suite.sha256[:12]}`. [What the figures mean](README.md).\n"
    )
    if not board.rows:
        return f"{head}\nNo rows yet.\n"
    if isinstance(suite, ActingSuite):
        return f"{head}\n{acting_board.page(board.acted(suite))}"
    parts = [head, tables(board) + "\n"]
    best = board.best()
    if best is not None:
        parts += [
            f"![Balanced accuracy, intervals; bars join what cannot be told apart](pictures/{suite.name}-ranking.png)\n",
            f"![Confusion matrices of {best.diagnoser}](pictures/{suite.name}-confusion.png)\n",
        ]
    return "\n".join(parts)


def framing(board: Board) -> list[Row]:
    """The rows that frame a ranking: floor and ceilings."""
    return [row for row in board.rows if row.diagnoser in FLOOR or ceiling(row)]


def draw(board: Board, folder: Path) -> None:
    """Draw the pictures of a suite's page into a folder: the ranking, and what the best row confuses."""
    from fdi_gym import plots

    if isinstance(board.suite, ActingSuite):
        acting_board.draw(board.acted(board.suite), folder)
        return
    best = board.best()
    if best is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    rows = RANKINGS["Isolation"][0](board.honest())
    drawn = board.drawn(rows)
    plots.ranking(rows, framing(board), cliques(drawn), board.suite.episodes).savefig(
        folder / f"{board.suite.name}-ranking.png"
    )
    labels = [label.name for label in board.plant.labels]
    plots.confusions(best, labels).savefig(folder / f"{board.suite.name}-confusion.png")


def boards(results: Path, suites: Sequence[str] = ()) -> list[Board]:
    """The boards of all suites in the folder of rows.

    Args:
        results: The folder.
        suites: Paths, or "module:name", of suites that are not installed.

    Raises:
        RefusedError: As `read_board`.
    """
    found = {suite.name: suite for suite in map(load_suite, suites)}
    return [read_board(folder, found) for folder in sorted(path for path in results.glob("*") if path.is_dir())]


def front(found: list[Board]) -> str:
    """The page that leads to the others."""
    lines, acting = [], []
    for board in found:
        link, size = f"[{board.suite.name}]({board.suite.name}.md)", str(board.suite.episodes)
        if isinstance(board.suite, ActingSuite):
            acting.append([link, size, str(len(board.rows)), acting_board.in_a_line(board.acted(board.suite))])
            continue
        best, top = board.best(), board.top()
        score, above = (row.metrics["per_sample"]["balanced_accuracy"] if row else None for row in (best, top))
        tied = len(tied_with_best(board.drawn(board.honest()))) if best else 0
        lines.append([
            link, size, str(len(board.rows)),
            f"{plain(best.diagnoser)} {100 * score:.1f}" if best and score is not None else "-", str(max(tied - 1, 0)),
            "-" if above is None else f"{100 * above:.1f}",
        ])  # fmt: skip
    head = ["suite", "flights", "rows", "best, per sample %", "not told from it", "ceiling %"]
    text = f"{INTRODUCTION}\n{markdown(head, lines)}\n" if lines else INTRODUCTION
    if acting:
        text += f"\n{ACTING}\n{markdown(['suite', 'flights', 'rows', 'the best'], acting)}\n"
    return text


def pages(found: list[Board]) -> dict[str, str]:
    """All pages of boards, by file name."""
    return {"README.md": front(found), **{f"{board.suite.name}.md": page(board) for board in found}}
