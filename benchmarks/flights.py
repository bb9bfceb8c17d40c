"""How many training flights a network that is shown filters would need: it is trained with ever more, and scored.

    python benchmarks/flights.py PLANT [--budget N] [--gaps standard hard] [--work runs]

The largest budget is the recipe's or that given, the others a half, a quarter and an eighth of it. Each run gives the
weights of `fdi-gym train residual_net PLANT --budget N` and goes on where it was killed; flights are flown and shown to the
filters once for all. All are scored on the validation flights of each condition, and so is the bank that is the best
known to be attained, under those named. Writes leaderboards/learning/flights.json, and from it flights.md and flights.png;
what these say of other plants stays.
"""

import argparse
import json
import os
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import joblib
import numpy as np

from baselines.learned import flights as data
from baselines.learned import weights
from baselines.learned._supervised import SupervisedTraining
from baselines.learned.recipes import residual_recipe
from fdi_gym.comparison import draw_again
from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.diagnosis.contract import Decisions
from fdi_gym.discovery import load_plant
from fdi_gym.files import write_whole
from fdi_gym.metrics import outcome
from fdi_gym.plots import panels
from fdi_gym.tables import markdown

METHOD = "residual_net"
REFERENCES = {  # the best by plant and process; onset_bank elsewhere
    "HUAVHover": {"standard": "overlap_bank", "hard": "overlap_bank"},
    "MissilePitch": {"standard": "onset_bank_fine", "hard": "onset_bank_fine"},
    "CMGSatellite": {"standard": "multiple_model_ekf", "hard": "overlap_bank"},
}
HALVINGS = 3
TREND = 3  # of the largest budgets the trend is taken
POINTS = {"standard": 1.0, "hard": 3.0}  # that are left of a gap that counts as closed
FLAT, FAR = 0.5, 10  # points a doubling that are as good as none; doublings beyond which nothing is foretold
HOME = Path(__file__).parent.parent / "leaderboards" / "learning"
INTRODUCTION = """# How many flights more

Written by `python benchmarks/flights.py PLANT`. `residual_net` with ever more training flights, passes over each and all
else the same, one seed. Balanced accuracy per sample in percent, on the same validation flights for all, and that of a bank
that is told the plant's equations, and mostly the process: on most suites [the best that is known to be
attained](../attainable.md). Gaps to it are paired, with 95 % intervals over flights; [another seed of training](seeds.md)
moves a score, too.

"A doubling" is the slope of the score over the logarithm of the flights, of the three largest budgets. Where it is surely
above 0, the line is drawn on to a gap of 3 points on the hard process and 1 elsewhere: so many flights per process it takes
if the score goes on rising as it did. Curves bend, so these are the fewest. Where it is not, nothing can be told, and the
curve is called flat where a doubling gives less than half a point.

![Score over training flights](flights.png)
"""


class Shared(SupervisedTraining):
    """A run that takes its flights from those of a larger one, where it has begun with them."""

    def __init__(self, *arguments, flown, **further):
        self.flown_before = flown
        super().__init__(*arguments, **further)

    def prepared(self, seeds):
        """Flights under all conditions: those of these seeds, the first of those that the larger run began with."""
        found = self.flown_before.get(seeds[0][0])
        if found is None:
            found = self.flown_before[seeds[0][0]] = super().prepared(seeds)
        flown, records = found
        count = [np.cumsum(flown.process == i)[-1] for i in range(len(seeds))]
        keep = np.concatenate([np.arange(most) < len(own) for most, own in zip(count, seeds, strict=True)])
        return type(flown)(*(a[keep] for a in flown)), records


def trained(plant, budget, work, flown):
    """A finished run with so many flights."""
    base = weights.WEIGHTS / f"{weights.stem('sequence_net', plant)}.safetensors"
    found = Shared(
        METHOD, plant, residual_recipe(plant, budget), seed=0, work=work / f"{weights.stem(METHOD, plant)}-{budget}",
        base=base, command=weights.command(METHOD, plant, None if budget == residual_recipe(plant).flights else budget, 0),
        flown=flown,
    )  # fmt: skip
    found.run()
    return found


def declared(training, index):
    """What a network says of the validation flights of a condition: its labels, held from step to step."""
    flown, records = training.validation
    label = training.logits(flown).argmax(axis=2)[flown.process == index]
    held = data.at_samples(label, training.recipe.shape.period, records[index].label.shape[1])
    return Decisions(held > 0, held, None, None, None)


def judged(name, plant, process, obs):
    """What a reference says of flights; halves of them side by side."""

    def labels(some):
        return run(make_diagnoser(name, plant, process=process), some).label

    label = np.concatenate(joblib.Parallel(2)(joblib.delayed(labels)(some) for some in np.array_split(obs, 2)))
    return Decisions(label > 0, label, None, None, None)


def trend(budgets, scores, reference, points):
    """What a doubling gives, and how many flights leave so many points of the gap; for scores (..., budgets)."""
    x = np.log2(budgets[-TREND:])
    x = x - x.mean()
    y = scores[..., -TREND:]
    slope = (y * x).sum(axis=-1) / (x**2).sum()
    last = y.mean(axis=-1) + slope * x[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        doublings = np.where(slope > 0, (reference - points - last) / slope, np.inf)
    closed = reference - last <= points
    return slope, budgets[-1] * 2.0 ** np.where(closed, 0.0, np.clip(doublings, 0.0, FAR + 1.0))


def curve_of(budgets, drawn, reference, points):
    """The scores of the budgets and what a doubling gives; with a reference the gap, and the flights that close it."""

    def interval(values):
        return np.quantile(values, (0.025, 0.975)).round(2).tolist()

    scores, again = 100 * drawn.score, 100 * drawn.again
    n = len(budgets)
    attained, others = (scores[-1], again[:, -1]) if points is not None else (np.inf, np.inf)
    slope, needed = trend(budgets, scores[:n], attained, points or 0.0)
    slopes, all_needed = trend(budgets, again[:, :n], others, points or 0.0)
    found = {"scores": scores[:n].round(2).tolist(), "doubling": [round(float(slope), 2), *interval(slopes)]}
    if points is None:
        return found
    gaps = [(100 * np.array(drawn.difference(reference, str(budget)))).round(2).tolist() for budget in budgets]
    return found | {
        "attained": round(float(attained), 2), "points": points, "gaps": gaps,
        "needed": [round(float(needed)), *interval(all_needed)],
    }  # fmt: skip


def measured(plant_id, budget, gaps, work):
    """The curves of a plant, one per condition; those of the gaps with the reference."""
    plant, flown = load_plant(plant_id), {}
    recipe, references = residual_recipe(plant, budget), REFERENCES.get(plant_id, {})
    budgets = [recipe.flights >> i for i in reversed(range(HALVINGS + 1))]
    runs = [trained(plant, n, work, flown) for n in reversed(budgets)][::-1]
    found = {}
    for i, (own, condition, record) in enumerate(
        zip(runs[-1].plants, recipe.conditions, runs[-1].validation[1], strict=True)
    ):
        every = {str(n): declared(one, i) for n, one in zip(budgets, runs, strict=True)}
        points = POINTS[condition.name] if condition.name in gaps else None
        reference = references.get(condition.process, "onset_bank")
        if points is not None:
            every[reference] = judged(reference, own, condition.process, record.obs)
        scoring = own.process(condition.process).scoring
        outcomes = {
            name: [outcome(own, scoring, record, said, j) for j in range(len(record.obs))] for name, said in every.items()
        }
        found[condition.name] = curve_of(budgets, draw_again(outcomes, len(own.labels)), reference, points)
        if points is not None:
            found[condition.name]["reference"] = reference
        print(plant_id, condition.name, found[condition.name], flush=True)
    return {
        "budgets": budgets,
        "filters": list(recipe.filters),
        "validation": recipe.validation,
        "curves": found,
    }


def forecast(curve, most):
    """How many flights would close the gap, in words."""
    (gap, _, _), (slope, low, _), (needed, fewest, greatest) = curve["gaps"][-1], curve["doubling"], curve["needed"]
    if gap <= curve["points"]:
        return "closed"
    if low <= 0:
        return "flat" if slope < FLAT else "cannot be told"
    if needed > most * 2**FAR:
        return f"more than {most * 2**FAR:,}"
    upper = f"{greatest:,.0f}" if greatest <= most * 2**FAR else "more than a thousand times these"
    return f"{needed:,.0f} ({fewest:,.0f} to {upper})"


def section(found):
    """The table of a plant."""
    budgets, rows = found["budgets"], []
    flights = [f"{n} flights" for n in budgets]
    for name, curve in found["curves"].items():
        slope, least, most = curve["doubling"]
        line = [name, *(f"{score:.1f}" for score in curve["scores"]), f"{slope:+.1f} [{least:+.1f}, {most:+.1f}]"]
        if "gaps" in curve:
            gap, low, high = curve["gaps"][-1]
            line += [
                f"{curve['attained']:.1f} ({curve['reference']})",
                f"{gap:.1f} [{low:.1f}, {high:.1f}]",
                forecast(curve, budgets[-1]),
            ]
        rows.append(line + ["-"] * (len(budgets) + 5 - len(line)))
    head = ["condition", *flights, "a doubling", "attained by", "gap", "flights that close it"]
    shown = " and ".join(f"`{name}`" for name in found["filters"])
    return f"## {{}}\n\nShown {shown}; {found['validation']} validation flights per condition.\n\n" + markdown(head, rows)


def picture(every, path):
    """Score over training flights, a panel per plant; the references as dotted lines."""
    figure = panels.new_figure(3.1 * len(every), 3.2)
    handles = {}
    for axes, (plant, found) in zip(np.atleast_1d(figure.subplots(1, len(every))), sorted(every.items()), strict=True):
        for i, (name, curve) in enumerate(found["curves"].items()):
            line = panels.drawn(axes, found["budgets"], curve["scores"], i, marker=".", markersize=5, label=name)
            if "attained" in curve:
                axes.axhline(curve["attained"], color=line.get_color(), lw=0.8, ls=":")
            handles.setdefault(name, line)
        axes.set_xscale("log", base=2)
        axes.set_xticks(found["budgets"], [str(n) for n in found["budgets"]])
        axes.minorticks_off()
        axes.set_xlabel("training flights per condition")
        panels.plain(axes, plant)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("balanced accuracy [%]")
    panels.legend(figure, handles.values(), ncol=len(handles))
    figure.savefig(path, dpi=110)


def page(every):
    """The page's text."""
    return "\n".join([INTRODUCTION, *(section(found).format(plant) + "\n" for plant, found in sorted(every.items()))])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("plant")
    parser.add_argument("--budget", type=int, help="largest number of training flights per condition")
    parser.add_argument("--gaps", nargs="+", choices=POINTS, default=list(POINTS), help="conditions with the reference")
    parser.add_argument("--work", type=Path, default=Path("runs"))
    arguments = parser.parse_args()
    file = HOME / "flights.json"
    every = json.loads(file.read_text()) if file.exists() else {}
    every[arguments.plant] = measured(arguments.plant, arguments.budget, arguments.gaps, arguments.work)
    write_whole(file, (json.dumps(dict(sorted(every.items())), indent=1) + "\n").encode())
    write_whole(HOME / "flights.md", page(every).encode())
    picture(every, HOME / "flights.png")


if __name__ == "__main__":
    main()
