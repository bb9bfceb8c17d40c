"""Writes leaderboards/learning/: the page that sets the learned diagnosers beside filters and oracle, and learning curves.

python benchmarks/learning_page.py

Every figure is read from the rows of the leaderboards and from the cards of the weights.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from baselines.learned import weights
from baselines.learned.weights import Card
from fdi_gym.diagnosis import diagnosers
from fdi_gym.files import write_whole
from fdi_gym.leaderboard import read_rows
from fdi_gym.plots import panels
from fdi_gym.row import Row
from fdi_gym.suite import ActingSuite, load_suite, suite_names
from fdi_gym.tables import clairvoyant, markdown

HOME = Path(__file__).parent.parent / "leaderboards"
LEARNED = tuple(name for name, entry in diagnosers().items() if entry.build.__module__.startswith("baselines.learned."))
REFERENCE = (
    "bayes_bank",
    "switching_bayes_bank",
    "hypothesis_bank",
    "onset_bank",
    "onset_bank_fine",
    "overlap_bank",
)  # this package's own, of no paper
FLOOR = ("null", "random")


def percent(row: Row | None) -> str:
    """Balanced accuracy per sample with its interval."""
    if row is None:
        return "-"
    found = row.metrics["per_sample"]
    low, high = found["balanced_accuracy_interval"]
    return f"{100 * found['balanced_accuracy']:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def best(rows: list[Row]) -> Row | None:
    """The row with the highest balanced accuracy."""
    return max(rows, key=lambda row: row.metrics["per_sample"]["balanced_accuracy"], default=None)


def rows_of(suite: str) -> dict[str, Row]:
    """A suite's rows by diagnoser."""
    return {row.diagnoser: row for row in read_rows(HOME / "results" / suite)}


def verdict(row: Row, other: Row | None) -> str:
    """Whether a row's interval lies above another's, overlaps it or lies below."""
    if other is None:
        return "-"
    (low, high), (floor, ceiling) = (r.metrics["per_sample"]["balanced_accuracy_interval"] for r in (row, other))
    gap = 100 * (row.metrics["per_sample"]["balanced_accuracy"] - other.metrics["per_sample"]["balanced_accuracy"])
    return f"{gap:+.1f}, " + ("above" if low > ceiling else "below" if high < floor else "intervals overlap")


def accuracy_table() -> str:
    """One line per suite and learned diagnoser; where a diagnosis acts, the suite's own page compares."""
    lines = []
    for suite in suite_names():
        if isinstance(load_suite(suite), ActingSuite):
            continue
        rows = rows_of(suite)
        filters = [r for r in rows.values() if not clairvoyant(r) and r.diagnoser not in (*LEARNED, *FLOOR)]
        paper = best([r for r in filters if r.diagnoser not in REFERENCE])
        bank, oracle = (
            best([r for r in filters if r.diagnoser in REFERENCE]),
            best([r for r in rows.values() if clairvoyant(r)]),
        )
        for name in LEARNED:
            if name in rows and name != "ppo_identification":
                row = rows[name]
                lines.append([
                    suite, name, percent(row), f"{paper.diagnoser} {percent(paper)}" if paper else "-", verdict(row, paper),
                    f"{bank.diagnoser} {percent(bank)}" if bank else "-", verdict(row, bank), percent(oracle),
                ])  # fmt: skip
    head = [
        "suite",
        "learned",
        "per sample %",
        "best filter",
        "against it",
        "best reference bank",
        "against it",
        "oracle",
    ]
    return markdown(head, lines)


def calibration_table(cards: list[Card]) -> str:
    """Log score and calibration error on the validation flights, before and after."""
    lines = []
    for card in cards:
        for process, found in card.calibration.items():
            (l0, l1), (e0, e1) = found.log_score, found.calibration_error
            lines.append([card.plant, card.method, process, f"{l0:.3f}", f"{l1:.3f}", f"{e0:.4f}", f"{e1:.4f}"])
    return markdown(["plant", "network", "process", "log score before", "after", "calibration error before", "after"], lines)


def cost_table(cards: list[Card]) -> str:
    """What the policies cost beside supervision: samples and time until the same validated accuracy."""
    supervised = {card.plant: card for card in cards if card.method == "sequence_net" and "standard" in card.processes}
    lines = []
    for card in cards:
        if card.method != "ppo" or card.plant not in supervised:
            continue
        reached = max(entry["accuracy"]["standard"] for entry in card.curve)
        first = next(e for e in card.curve if e["accuracy"]["standard"] == reached)
        samples = first["step"] * card.budget["samples"] / card.budget["decisions"]
        other = supervised[card.plant]
        per_flight = other.budget["samples"] / other.budget["flights"]
        same = next((e for e in other.curve if e["accuracy"]["standard"] >= reached), None)
        seen = "-" if same is None else f"{len(other.processes) * same['flights'] * per_flight / 1e6:.1f} M"
        lines.append([
            card.plant, f"{100 * reached:.1f}", f"{samples / 1e6:.1f} M",
            f"{first['seconds'] / 60:.1f}", f"at most {seen}", "-" if same is None else f"{same['seconds'] / 60:.1f}",
            f"{100 * max(e['accuracy']['standard'] for e in other.curve):.1f}", f"{other.budget['seconds'] / 60:.1f}",
        ])  # fmt: skip
    head = [
        "plant",
        "PPO reaches %",
        "samples",
        "minutes",
        "supervision: samples",
        "minutes",
        "it ends at %",
        "after minutes",
    ]
    return markdown(head, lines)


def identification_table() -> str:
    """Root mean square errors while a fault acts."""
    lines = []
    for suite in suite_names():
        rows = rows_of(suite)
        if "ppo_identification" in rows:
            for name in ("null", "ppo_identification", *(n for n in LEARNED if n in rows and n.endswith("_net"))):
                during = rows[name].metrics["identification"]["rmse"]["during"]
                lines.append([suite, name, *(f"{entry} {value:.3g}" for entry, value in during.items())])
    return markdown(["suite", "method", *("" for _ in lines[0][2:])], lines) if lines else "No policy estimates yet."


def budget_table(cards: list[Card]) -> str:
    """What each committed file was trained with."""
    lines = [
        [f"`{card.command}`", f"{card.budget['samples'] / 1e6:.1f} M", f"{card.budget['seconds'] / 60:.1f}",
         f"{card.seeds['training'][0]} to {card.seeds['training'][1]}", ", ".join(card.filters) or "-"]
        for card in cards
    ]  # fmt: skip
    return markdown(["command", "samples", "minutes", "training seeds", "filters"], lines)


def title(card: Card) -> str:
    """What weights are called: their file's name without suffix."""
    return f"{card.method}-{card.plant}" + ("-sensors" if any(o.get("sensor_faults") for o in card.options) else "")


def picture(card: Card, path: Path) -> None:
    """The learning curve: validated score over training time."""
    figure = panels.new_figure(6, 3.4)
    axes = figure.subplots()
    minutes = [entry["seconds"] / 60 for entry in card.curve]
    handles = []
    for i, name in enumerate(card.curve[0]["accuracy"]):
        values: list[Any] = [entry["accuracy"][name] for entry in card.curve]
        shown = values if name.endswith("rmse") else [100 * v for v in values]
        handles.append(panels.drawn(axes, minutes, shown, i, label=name, marker=".", markersize=4))
    score = "balanced accuracy [%]" if card.task != "identification" else "scaled RMSE"
    axes.set(xlabel="training [min], one core of a shared machine", ylabel=f"{score}, validation flights")
    axes.set_title(title(card), fontsize=10)
    panels.plain(axes)
    panels.legend(figure, handles, ncol=2)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def page(cards: list[Card]) -> str:
    """The page's text."""
    text = (HOME / "learning" / "template.md").read_text()
    parts = {
        "accuracy": accuracy_table(), "calibration": calibration_table(cards), "cost": cost_table(cards),
        "identification": identification_table(), "budget": budget_table(cards),
        "curves": "\n".join(f"![{title(c)}]({title(c)}.png)" for c in cards),
    }  # fmt: skip
    for name, part in parts.items():
        text = text.replace(f"{{{{{name}}}}}", part)
    return text


def main() -> None:
    """Write the page and the pictures."""
    cards = [weights.read_card(path) for path in sorted(weights.WEIGHTS.glob("*.safetensors"))]
    cards = [card for card in cards if "accuracy" in card.curve[-1]]  # of what is trained round by round
    for card in cards:
        picture(card, HOME / "learning" / f"{title(card)}.png")
    write_whole(HOME / "learning" / "README.md", page(cards).encode())
    print(HOME / "learning" / "README.md")


if __name__ == "__main__":
    main()
