"""The page and its pictures, from what was measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.acting.suites import ACCOMMODATION, ACTIVE
from fdi_gym import palette
from fdi_gym.discovery import load_plant
from fdi_gym.plots.panels import SMALL, TEXT, legend, new_figure, plain
from fdi_gym.tables import markdown

INTRODUCTION = """# Diagnoses that act

Written by `python -m benchmarks.acting --page-only` from the figures in `{data}/`, which
`python -m benchmarks.acting` measures. Probes are known inputs that a plant declares (`fdi-gym list PLANT`), added to find a
fault sooner; accommodation reconfigures the controller for what is diagnosed. Costs are each plant's flight cost, tracking
error and effort, per sample; intervals are 95 %. All differences are paired: the same flights, the same noise.

## Probing

An agent is a diagnoser, unchanged, and a prober that chooses every decision period: `never` (every passive method; the
best of those that were tried is what others are compared with),
`periodic` and `at_random` (the plant's probes in turn, or drawn), `greedy` (expected information gain against the price of a
probe), `ppo` (learned). A prober's curve runs from little probing to much. The cost is what the flight costs more than the
same flight without a probe; the delay is the mean time from the onset to the right label, where later than the median
fault's length counts as that.
"""

BOUNDS = """### The satellite at rest: what could be known

The Cramer-Rao bound (a standard deviation; the prior is 0.5) on the four effectivenesses 20 s after they may have
changed, at 45 dB, and the attitude's error meanwhile. Null motion leaves the attitude alone and is blind to a loss that all
four share; common moves see that one.
"""
ALLOWED = """## Accommodation

The controller is reconfigured every decision period for: nothing; the true label and estimate; a false alarm (another
fault of two thirds of its reach in every flight, all the time, on flights without a fault, to be compared with "no fault");
or what a diagnoser says. "Recovered" is the share of what the truth recovers of the cost. "Averted" and "caused" are
flights that
leave their envelope without, and with it; "worse" is the share of faulty flights that cost 5 % more than with nothing.
"""


def pm(value: list[float] | None, digits: int = 3, percent: bool = False) -> str:
    """A figure with its interval."""
    if value is None:
        return ""
    middle, low, high = (100 * v if percent else v for v in value)
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def probing_table(found: dict[str, Any]) -> str:
    """The agents of one suite."""
    rows = [
        [row["agent"], pm(row["per_sample"], 1, True), pm(row["per_decision"], 1, True), pm(row["per_sample_gain"], 1, True),
         f"{row['delay']:.2f}", pm(row["delay_gain"], 2), pm(row["cost"]), f"{100 * row['probed']:.0f}",
         "" if row["false_alarms_per_hour"] is None else f"{row['false_alarms_per_hour']:.1f}"]
        for row in found["rows"]
    ]  # fmt: skip
    head = ["agent", "accuracy per sample %", "per decision %", "more than the best passive", "delay s",
            "less than the best passive", "cost", "time probed %", "false alarms/h"]  # fmt: skip
    return markdown(head, rows)


def best_of(rows: list[dict[str, Any]], prober: str) -> dict[str, Any]:
    """A prober's row with the highest accuracy per sample."""
    return max((r for r in rows if r["prober"] == prober), key=lambda r: r["per_sample"][0])


def verdict(found: dict[str, Any]) -> str:
    """What the suite says, in words made of its figures."""
    rows = found["rows"]
    chosen = max((best_of(rows, p) for p in ("greedy", "ppo") if any(r["prober"] == p for r in rows)),
                 key=lambda r: r["per_sample"][0])  # fmt: skip
    sure = chosen["per_sample_gain"][1] > 0
    sooner = chosen["delay_gain"] is not None and chosen["delay_gain"][2] < 0
    words = ["more than chance" if certain else "no more than chance" for certain in (sure, sooner)]
    text = (
        f"The best chosen probing is `{chosen['agent']}`: {pm(chosen['per_sample_gain'], 1, True)} points of accuracy per "
        f"sample more than the best that never probes, `{found['passive']}` ({words[0]}), "
        f"{-(chosen['delay_gain'] or [0.0])[0]:.2f} s sooner ({words[1]}), at a cost of {pm(chosen['cost'])}."
    )
    blind = [r for r in rows if r["prober"] in ("periodic", "at_random")]
    for words, some in (("", blind), (" at no higher cost", [r for r in blind if r["cost"][0] <= chosen["cost"][0]])):
        if some:
            rival = max(some, key=lambda r: r["per_sample"][0])
            text += (
                f" The best that probes by the clock or at random{words} is `{rival['agent']}`: "
                f"{100 * rival['per_sample'][0]:.1f} % per sample at a cost of {rival['cost'][0]:.3f}, against "
                f"{100 * chosen['per_sample'][0]:.1f} %."
            )
    return text


def accommodation_table(found: dict[str, Any]) -> str:
    """Who is allowed for what, and what it recovers."""
    rows = [
        [row["allowed_for"], pm(row["cost"]), pm(row["recovered"], 0, True) if "recovered" in row else "",
         str(row["lost"]), str(row["averted"]), str(row["caused"]), f"{100 * row['worse']:.0f}", str(row["unusable"])]
        for row in found["rows"]
    ]  # fmt: skip
    head = ["allowed for", "cost", "recovered %", "flights lost", "averted", "caused", "worse %", "unusable"]
    return markdown(head, rows)


def by_label_table(found: dict[str, Any]) -> str:
    """The cost of each fault by what is allowed for."""
    names = [row["allowed_for"] for row in found["rows"]]
    labels = list(found["rows"][0]["by_label"])
    rows = [
        [label, str(found["rows"][0]["by_label"][label][1]), *(f"{row['by_label'][label][0]:.3f}" for row in found["rows"])]
        for label in labels
    ]  # fmt: skip
    return markdown(["fault", "flights", *names], rows)


def pareto(found: dict[str, Any], name: str) -> Any:
    """Accuracy against cost, a curve for each prober."""
    figure = new_figure(7.2, 4.2)
    axis, handles = figure.subplots(), []
    probers = list(dict.fromkeys(row["prober"] for row in found["rows"]))
    for i, prober in enumerate(probers):
        colour, dash = palette.line(i)
        mine = sorted((r for r in found["rows"] if r["prober"] == prober), key=lambda r: r["cost"][0])
        x, y = [r["cost"][0] for r in mine], [100 * r["per_sample"][0] for r in mine]
        spread = np.array([[100 * (r["per_sample"][0] - r["per_sample"][1]), 100 * (r["per_sample"][2] - r["per_sample"][0])]
                           for r in mine]).T  # fmt: skip
        (line,) = axis.plot(x, y, color=colour, dashes=dash, marker="o", ms=4, lw=1.5, label=prober)
        axis.errorbar(x, y, yerr=spread, fmt="none", ecolor=colour, elinewidth=0.8, alpha=0.7)
        handles.append(line)
    axis.set_xlabel("added flight cost per sample [1]", fontsize=TEXT)
    axis.set_ylabel("balanced accuracy per sample [%]", fontsize=TEXT)
    axis.set_title(
        f"{name}, {found['diagnoser']} on board, {found['suite']['flights']} flights, 95 % intervals", fontsize=TEXT
    )
    axis.grid(lw=0.4)
    plain(axis)
    legend(figure, handles, ncol=len(handles))
    return figure


def flight(found: dict[str, Any], name: str) -> Any:
    """One flight: the belief without and with probes, which probe acts, what it costs."""
    shown, suite = found["flight"], found["suite"]
    plant = load_plant(suite["plant_id"], **suite["options"])
    assert plant.acting is not None
    agents = [key for key in shown if key not in ("time", "label")]
    t, label = np.array(shown["time"]), np.array(shown["label"])
    figure = new_figure(8.4, 6.0)
    axes = figure.subplots(4, 1, sharex=True)
    for axis, key in zip(axes[:2], agents, strict=True):
        belief = np.array(shown[key]["belief"])
        spans = [0, *sorted({int(v) for v in label if v})] if label.any() else [0]
        named = dict.fromkeys([*spans, *np.argsort(-belief.mean(axis=0))[:4].tolist()])
        for i, value in enumerate(list(named)[:6]):
            colour, dash = palette.line(i)
            axis.plot(t, belief[:, value], color=colour, dashes=dash, lw=1.4, label=plant.labels[value].name)
        axis.fill_between(t, 0, 1, where=label > 0, color=palette.SHADE, lw=0, zorder=0)
        axis.set_ylabel("belief [1]", fontsize=SMALL)
        axis.set_title(f"{key}; shaded: {plant.labels[int(label.max())].name} acts", fontsize=SMALL, loc="left")
        axis.legend(fontsize=SMALL, frameon=False, bbox_to_anchor=(1.0, 1.0), loc="upper left")
        axis.set_ylim(-0.03, 1.03)
    names = [p.name for p in plant.acting.probes]
    axes[2].step(t, shown[agents[1]]["probe"], where="post", color=palette.INK, lw=1.2)
    axes[2].set_yticks(range(len(names)), names, fontsize=SMALL)
    axes[2].set_ylabel("probe", fontsize=SMALL)
    for i, key in enumerate(agents):
        colour, dash = palette.line(i)
        axes[3].plot(t, shown[key]["cost"], color=colour, dashes=dash, lw=1.2, label=key)
    top = np.percentile([v for key in agents for v in shown[key]["cost"]], 98)
    axes[3].set_ylim(0, 1.1 * max(top, 1e-3))
    axes[3].set_ylabel("flight cost [1]", fontsize=SMALL)
    axes[3].set_xlabel("time [s]", fontsize=SMALL)
    axes[3].legend(fontsize=SMALL, frameon=False, bbox_to_anchor=(1.0, 1.0), loc="upper left")
    for axis in axes:
        plain(axis)
    figure.suptitle(name, fontsize=TEXT)
    return figure


def page(found: dict[str, dict[str, Any]], data: str) -> str:
    """The page as Markdown; suites that have not been measured are not there."""
    parts = [INTRODUCTION.format(data=data)]
    for name, suite in ACTIVE.items():
        if name in found:
            mine = found[name]
            prices = ", ".join(f"{probe} {price:.3f}" for probe, price in mine["prices"].items() if probe != "none")
            parts += [
                f"### {name}\n\n{suite.plant_id}, process \"{suite.process}\": {suite.why}. {mine['suite']['flights']} "
                f"flights, `{mine['diagnoser']}` on board, a decision every {suite.period} samples. Prices of the probes on "
                f"healthy flights, per sample: {prices}.\n\n{verdict(mine)}\n",
                probing_table(mine),
                f"\n![accuracy against cost](pictures/{name}.png)\n\n![a flight](pictures/{name}-flight.png)\n",
            ]  # fmt: skip
    if "bounds" in found:
        head = ["probes", "bound on an effectiveness", "bound on the common loss", "attitude error, rms deg"]
        rows = [[r["probes"], f"{r['effectiveness']:.3f}", f"{r['common']:.3f}", f"{r['attitude']:.4f}"]
                for r in found["bounds"]["rows"]]  # fmt: skip
        parts += [BOUNDS, markdown(head, rows) + "\n"]
    parts.append(ALLOWED)
    for name, suite in ACCOMMODATION.items():
        if name in found:
            mine, options = found[name], " ".join(map(str, suite.options.values()))
            parts += [f"### {name}\n\n{suite.plant_id} {options}, process \"{suite.process}\": {suite.why}. "
                      f"{mine['suite']['flights']} flights, a decision every {suite.period} samples.\n",
                      accommodation_table(mine), "\nCost by fault:\n", by_label_table(mine) + "\n"]  # fmt: skip
    return "\n".join(parts).rstrip() + "\n"


def draw(found: dict[str, dict[str, Any]], folder: Path) -> None:
    """All pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ACTIVE:
        if name in found:
            for suffix, picture in (("", pareto), ("-flight", flight)):
                picture(found[name], name).savefig(folder / f"{name}{suffix}.png", dpi=130, bbox_inches="tight")
