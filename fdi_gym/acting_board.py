"""The page of a suite whose flights are acted on: curves of probing against its cost, and what accommodation recovers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fdi_gym.acted import NEVER, Acted, accuracy, at_this_cost, delays, family, horizon, shares, truths
from fdi_gym.comparison import Drawn
from fdi_gym.entrants import NOTHING, TRUTH, fly_entrant
from fdi_gym.intervals import mean_interval
from fdi_gym.row import Row
from fdi_gym.tables import FLOOR, clairvoyant, knows, markdown, plain, told

UNSEEING = ("false_alarm", *FLOOR)  # diagnosers that look at nothing: by chance one is right soon, and not for long
WORSE = 1.05  # a flight is worse where it costs more than so many times what it costs with nothing

PROBING = """An entrant is a diagnoser that never probes, or a prober with `{on_board}` on board that chooses a probe every
{period} samples. Costs are the plant's flight cost per sample, tracking error and effort; what a prober costs is what
the flights cost more than without a probe. Differences are paired, the same flights and the same noise, with 95 %
intervals; the best that never probes is `{passive}`. "At this cost" compares a prober that looks with those that
probe by the clock or by chance: their best mixture of the same mean cost. Delays run from the onset to the right
label; longer ones than the median fault's length count as that.
"""
ACCOMMODATION = """Every {period} samples the controller is reconfigured for what the entrant says: `null` says
nothing, `truth` is always right, `false_alarm` names one fault all the time. Costs are the plant's flight cost per
sample. "Recovered" is the share of what the truth recovers of the cost, where it recovers more than chance; "averted"
and "caused" are flights that leave their envelope with nothing and not with the entrant, and the reverse, in brackets
those without a fault, which a false alarm has caused; "worse" is the share of faulty flights that cost 5 % more than
with nothing. Intervals are 95 %, by resampled flights.
"""


def said(value: Sequence[float] | None, digits: int = 3, factor: float = 1.0) -> str:
    """A figure with its interval."""
    if value is None:
        return "-"
    middle, low, high = (factor * v for v in value)
    return f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def probing_table(acted: Acted, drawn: Drawn, width: int | None = None) -> str:
    """Who enters a suite of probing, best accuracy first, and what those know that are told of the truth."""
    passive, lines = acted.passive(), []
    for row in sorted(acted.rows, key=lambda row: (-accuracy(row), row.diagnoser)):
        name, m = row.diagnoser, row.metrics
        gain = late = added = None
        if passive is not None:
            gain = drawn.difference(name, passive.diagnoser)
            far = horizon(acted.outcomes[name])
            mine, theirs = (delays(acted.outcomes[n], far, acted.plant.dt) for n in (name, passive.diagnoser))
            gaps = (mine - theirs)[np.isfinite(mine)]
            late = mean_interval(gaps) if gaps.size else None
            added = mean_interval(acted.cost(name) - acted.cost(passive.diagnoser))
        mean = m["detection"]["isolation_delay_restricted_mean"]
        alarms = m["detection"]["false_alarms_per_hour"]
        passed = [[v["balanced_accuracy"], *v["balanced_accuracy_interval"]] for v in (m["per_sample"], m["per_decision"])]
        lines.append([
            plain(name) + (" *" if clairvoyant(row) else ""), *(said(v, 1, 100.0) for v in passed), said(gain, 1, 100.0),
            "-" if mean is None else f"{mean:.2f}", said(late, 2), said(added),
            said(at_this_cost(acted, drawn, row), 1, 100.0), f"{100 * m['acting']['probed']:.0f}",
            "-" if alarms is None else f"{alarms:.1f}",
        ])  # fmt: skip
    head = ["entrant", "per sample %", "per decision %", "more than the best passive", "isolated after s",
            "later than the best passive s", "added cost", "more at this cost", "probed %", "false alarms/h"]  # fmt: skip
    return "\n\n".join(part for part in (markdown(head, lines, width), told(acted.rows)) if part)


def accommodation_table(acted: Acted, width: int | None = None) -> str:
    """Who enters a suite of accommodation, the cheapest first."""
    lost = {name: np.array([flight.terminated for flight in some]) for name, some in acted.outcomes.items()}
    lines = []
    for row in sorted(acted.rows, key=lambda row: (row.metrics["acting"]["cost"], row.diagnoser)):
        name, m = row.diagnoser, row.metrics
        label = truths(acted.outcomes[name])
        averted = caused = worse = "-"
        if NOTHING in lost:
            more = ~lost[NOTHING] & lost[name]
            averted, caused = (
                str(int((lost[NOTHING] & ~lost[name]).sum())),
                f"{int(more.sum())} ({int(more[label == 0].sum())})",
            )
            faulty = label > 0
            worse = f"{100 * (acted.cost(name) > WORSE * acted.cost(NOTHING))[faulty].mean():.0f}" if faulty.any() else "-"
        found = m["per_sample"]
        lines.append([
            plain(name), said([m["acting"]["cost"], *m["acting"]["cost_interval"]]), said(shares(acted, name), 0, 100.0),
            str(int(lost[name].sum())), averted, caused, worse, str(m["acting"]["unusable"]),
            said([found["balanced_accuracy"], *found["balanced_accuracy_interval"]], 1, 100.0),
        ])  # fmt: skip
    head = ["entrant", "cost", "recovered %", "flights lost", "averted", "caused (healthy)", "worse %", "unusable",
            "accuracy per sample %"]  # fmt: skip
    return markdown(head, lines, width)


def by_fault_table(acted: Acted, width: int | None = None) -> str:
    """The cost of each fault by entrant; in brackets the share recovered, in percent."""
    names = [row.diagnoser for row in sorted(acted.rows, key=lambda row: (row.metrics["acting"]["cost"], row.diagnoser))]
    label, lines = truths(acted.outcomes[names[0]]), []
    for value in np.unique(label):
        mask, cells = label == value, []
        for name in names:
            share = shares(acted, name, mask)
            back = f" ({100 * share[0]:.0f})" if share is not None and name not in (NOTHING, TRUTH.name) else ""
            cells.append(f"{acted.cost(name)[mask].mean():.3f}{back}")
        lines.append([plain(acted.plant.labels[value].name), str(int(mask.sum())), *cells])
    return markdown(["fault", "flights", *map(plain, names)], lines, width)


def verdict(acted: Acted, drawn: Drawn) -> str:
    """What a suite of probing says, in words made of its figures."""
    chosen, passive = acted.chosen(), acted.passive()
    if chosen is None or passive is None:
        return ""
    name = chosen.diagnoser
    others = [r.diagnoser for r in acted.rows if family(r) == NEVER and not clairvoyant(r) and r.diagnoser not in UNSEEING]
    gain = drawn.difference(name, passive.diagnoser)
    far = horizon(acted.outcomes[name])
    mine = delays(acted.outcomes[name], far, acted.plant.dt)
    late = {n: mean_interval((mine - delays(acted.outcomes[n], far, acted.plant.dt))[np.isfinite(mine)]) for n in others}
    sure = all(drawn.difference(name, n)[1] > 0 for n in others) and all(gap[2] < 0 for gap in late.values())
    added = mean_interval(acted.cost(name) - acted.cost(passive.diagnoser))
    gap = late[passive.diagnoser]
    when = f"{said(gap, 2)} s later" if gap[0] > 0 else f"{said((-gap[0], -gap[2], -gap[1]), 2)} s sooner"
    words = (
        f"The best chosen probing, `{name}`, has {said(gain, 1, 100.0)} points of accuracy per sample more than the best "
        f"that never probes, and isolates {when}, at a cost of {said(added)}: it "
        f"{'beats' if sure else 'does not beat'} every diagnoser that looks and never probes in both."
    )
    oracle = acted.passive(told=True)
    if oracle is not None:
        words += (
            f" `{oracle.diagnoser}`, which knows {knows(oracle)} and never probes, has {100 * accuracy(oracle):.1f} %: "
            f"{said(drawn.difference(name, oracle.diagnoser), 1, 100.0)} more has the chosen probing."
        )
    return words


def tables(acted: Acted, width: int | None = None) -> str:
    """The tables of a suite."""
    if acted.suite.acts == "probing":
        return probing_table(acted, acted.drawn(), width)
    return f"{accommodation_table(acted, width)}\n\nCost by fault:\n\n{by_fault_table(acted, width)}"


def page(acted: Acted) -> str:
    """What a suite's page says below its head."""
    suite, period = acted.suite, acted.suite.decision_period
    picture = f"pictures/{suite.name}"
    if suite.acts == "accommodation":
        drawing = f"\n![What is recovered]({picture}.png)\n"
        return "\n".join([ACCOMMODATION.format(period=period), tables(acted), drawing])
    passive = acted.passive()
    words = PROBING.format(on_board=suite.on_board, period=period, passive=passive.diagnoser if passive else "nobody")
    shown = [f"\n![Accuracy against cost]({picture}.png)\n"]
    shown += [f"![A flight]({picture}-flight.png)\n"] if passive is not None and acted.chosen() is not None else []
    drawn = acted.drawn()
    return "\n".join([words, f"{verdict(acted, drawn)}\n", probing_table(acted, drawn), *shown])


def _passed(row: Row) -> tuple[float, float, float]:
    found = row.metrics["per_sample"]
    low, high = found["balanced_accuracy_interval"] or (accuracy(row), accuracy(row))
    return accuracy(row), low, high


def draw(acted: Acted, folder: Path) -> None:
    """Draw the pictures of a suite's page into a folder: curves or costs, and a flight with its probes."""
    from fdi_gym import plots

    suite, passive, chosen = acted.suite, acted.passive(), acted.chosen()
    folder.mkdir(parents=True, exist_ok=True)
    title = f"{suite.name}, {suite.episodes} flights, 95 % intervals"
    if suite.acts == "accommodation":
        points = [plots.Point(row.diagnoser, _passed(row), mean_interval(acted.cost(row.diagnoser))) for row in acted.rows]
        plots.allowances(points, title).savefig(folder / f"{suite.name}.png")
        return
    curves: dict[str, list[plots.Point]] = {}
    oracle = acted.passive(told=True)
    for row in acted.rows:
        kind = family(row)
        if kind == NEVER and row not in (passive, oracle):
            continue  # they all cost nothing: the best says enough
        added = acted.cost(row.diagnoser) - (0.0 if passive is None else acted.cost(passive.diagnoser))
        place = f"{kind}: {row.diagnoser}{', told' if row is oracle else ''}" if kind == NEVER else kind
        curves.setdefault(place, []).append(plots.Point(row.diagnoser, _passed(row), mean_interval(added)))
    plots.pareto(curves, f"{title}; {suite.on_board} on board").savefig(folder / f"{suite.name}.png")
    if passive is not None and chosen is not None:
        flight(acted, (passive.diagnoser, chosen.diagnoser)).savefig(folder / f"{suite.name}-flight.png")


def flight(acted: Acted, names: Sequence[str], episode: int | None = None) -> Any:
    """A figure of one flight under several entrants.

    Args:
        acted: The rows.
        names: The entrants; the last one's probes are shown.
        episode: Which flight. Default: the one on which the last is right for longer than the first by most.
    """
    from fdi_gym import plots

    if episode is None:
        right = [np.array([sum(c for true, said, c in f.confusion if true == said) for f in acted.outcomes[name]])
                 for name in (names[0], names[-1])]  # fmt: skip
        episode = int(np.argmax(right[1] - right[0]))
    shown, label = {}, np.zeros(1, int)
    for name in names:
        found = fly_entrant(acted.suite, acted.plant, name, [episode])
        rows = slice(0, int(found.record.length[0]) + 1)
        label, probs = found.record.label[0, rows], found.decisions.label_probs
        declared = np.clip(found.decisions.label[0, rows], 0, len(acted.plant.labels) - 1)
        belief = np.eye(len(acted.plant.labels))[declared] if probs is None else probs[0, rows]
        shown[name] = plots.Shown(belief, found.probe[0, rows], found.cost[0, rows])
    return plots.acted_flight(acted.plant, label, shown, f"{acted.suite.name}, flight {episode}")


def in_a_line(acted: Acted) -> str:
    """What a suite comes to, for the page that leads to it."""
    if acted.suite.acts == "probing":
        chosen, passive = acted.chosen(), acted.passive()
        if chosen is None or passive is None:
            return "-"
        return f"{plain(chosen.diagnoser)} {100 * accuracy(chosen):.1f}, passive {100 * accuracy(passive):.1f}"
    own = [r for r in acted.rows if not clairvoyant(r) and r.diagnoser not in (TRUTH.name, *UNSEEING)]
    best = min(own, key=lambda row: row.metrics["acting"]["cost"], default=None)
    share = None if best is None else shares(acted, best.diagnoser)
    if best is None or share is None:
        return "nothing to recover"
    return f"{plain(best.diagnoser)} recovers {said(share, 0, 100.0)}"
