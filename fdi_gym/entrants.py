"""Who enters a suite: a diagnoser; where diagnoses act also a prober, or the truth itself.

On suites of probing a prober enters with the suite's diagnoser on board, and a diagnoser as one that never probes. On suites
of accommodation the controller is reconfigured for what a diagnoser says; "truth" is who is always right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fdi_gym.agents import NEVER, Prober, fly
from fdi_gym.diagnosis import Decisions, Diagnoser, Entry, diagnosers, find_diagnoser, find_prober, make_diagnoser, probers
from fdi_gym.engine import Record
from fdi_gym.metrics import Acted
from fdi_gym.names import blame, blamed, check_diagnoser_name, find_function, unknown
from fdi_gym.plant import NotApplicableError, Plant
from fdi_gym.suite import ActingSuite, AnySuite

NOTHING = "null"  # the diagnoser for which nothing is ever reconfigured
TRUTH = Entry("diagnoser", "truth", "What is true", lambda plant: make_diagnoser(NOTHING, plant), {}, "everything", True)
_probes: dict[Callable[..., Any], bool] = {}  # whether a builder outside the package makes a prober


def find_entrant(suite: AnySuite, plant: Plant, name: str) -> Entry:
    """Who enters a suite under a name; "module:function" names a builder of a diagnoser or, to probe, of a prober.

    Raises:
        ValueError: Nobody; the message lists who could, or says which suite a prober is for.
    """
    probing = isinstance(suite, ActingSuite) and suite.acts == "probing"
    if isinstance(suite, ActingSuite) and not probing and name == TRUTH.name:
        return TRUTH
    if name in probers() or (":" in name and _is_prober(suite, plant, name, probing)):
        if not probing:
            raise _misplaced(suite, name)
        return find_prober(name)
    if probing and ":" not in name and name not in diagnosers():
        raise unknown("prober or diagnoser", name, [*probers(), *diagnosers()])
    return find_diagnoser(name)


def _misplaced(suite: AnySuite, name: str) -> ValueError:
    what = "allows for diagnoses" if isinstance(suite, ActingSuite) else "is of flights that nobody acts on"
    return ValueError(f"{name} is a prober, and {suite.name} {what}: a diagnoser enters there")


def _is_prober(suite: AnySuite, plant: Plant, name: str, probing: bool) -> bool:
    """Whether a builder outside the package makes a prober: it is registered as one, or is asked where probers enter.

    One that takes what only diagnosers get is not asked.
    """
    build = find_function("prober or diagnoser" if probing else "diagnoser", check_diagnoser_name(name))
    if any(entry.build is build for entry in probers().values()):
        return True
    return probing and _makes_prober(suite, plant, name, build)


def _makes_prober(suite: AnySuite, plant: Plant, name: str, build: Callable[..., Any]) -> bool:
    if build not in _probes:
        _probes[build] = False
        try:
            entry = find_prober(name)
            if plant.acting is not None and not {"belief", "calibration", "scenarios"} & set(entry.parameters):
                period = suite.decision_period if isinstance(suite, ActingSuite) else 1
                _probes[build] = isinstance(entry.build(plant, **_told(entry, suite.process, period)), Prober)
        except Exception:  # whatever it is, it is built, and blamed, as what it is asked for
            return False
    return _probes[build]


def _told(entry: Entry, process: str, period: int) -> dict[str, Any]:
    return {name: value for name, value in (("process", process), ("period", period)) if entry.takes(name)}


def settings_of(suite: AnySuite, plant: Plant, name: str) -> dict[str, Any]:
    """The tuning that an entrant's builder gets on a suite, in full: its paper's, the name's own, the suite's.

    Raises:
        ValueError: Unknown entrant or setting, or settings that JSON cannot say.
    """
    found = find_entrant(suite, plant, name).resolve(plant, **suite.settings.get(name, {}))
    try:
        return msgspec.json.decode(msgspec.json.encode(found))
    except (TypeError, msgspec.MsgspecError) as error:
        raise ValueError(f"{name}: its settings are not plain data: {error}") from error


def make_prober(name: str, plant: Plant, *, process: str = "standard", period: int = 10, **tuning: Any) -> Prober:
    """A prober by name, for a plant and one of its fault processes.

    Args:
        name: As in `fdi_gym.diagnosis.find_prober`.
        plant: The plant.
        process: The fault process that it will meet.
        period: Samples from one decision to the next.
        tuning: Keyword arguments of its builder, over those of the name.

    Raises:
        ValueError: Unknown name, process or keyword; `NotApplicableError` where it cannot probe this plant.
    """
    entry = find_prober(name)
    plant.process(process)
    settings = entry.resolve(plant, **tuning)
    try:
        built = entry.build(plant, **_told(entry, process, period), **settings)
    except ValueError:
        raise
    except Exception as error:
        raise ValueError(f"the builder of {name} failed: {blame(error)}") from error
    if not isinstance(built, Prober):
        raise ValueError(f"the builder of {name} gives {type(built).__name__}, not a Prober")
    return built


def make_entrant(suite: AnySuite, plant: Plant, name: str, scenarios: Sequence[Any] | None) -> tuple[Diagnoser, Prober]:
    """An entrant's diagnoser and prober (`NEVER` for one that does not probe), with the settings of the suite.

    Raises:
        ValueError: As `make_diagnoser` and `make_prober`.
    """
    entry, settings = find_entrant(suite, plant, name), settings_of(suite, plant, name)
    told: dict[str, Any] = {"process": suite.process, "scenarios": scenarios}
    if isinstance(suite, ActingSuite) and entry.kind == "prober":
        with blamed(name):
            prober = make_prober(name, plant, process=suite.process, period=suite.decision_period, **settings)
        return make_diagnoser(suite.on_board, plant, **told, **suite.settings.get(suite.on_board, {})), prober
    with blamed(name):
        try:
            return entry.build(plant) if entry is TRUTH else make_diagnoser(name, plant, **told, **settings), NEVER
        except NotApplicableError:
            raise
        except (
            ValueError
        ):  # it may be what enters elsewhere: where probers do not enter nobody was asked before it was built
            if ":" in name and _makes_prober(suite, plant, name, entry.build):
                raise _misplaced(suite, name) from None
            raise


class Flown(NamedTuple):
    """Flights that an entrant has acted on."""

    record: Record
    decisions: Decisions
    acted: list[Acted]
    probe: Any  # (N, K + 1) and
    cost: Any  # (N, K + 1), as in `fdi_gym.agents.Flown`


def fly_entrant(suite: ActingSuite, plant: Plant, name: str, episodes: Sequence[int]) -> Flown:
    """Fly episodes of a suite with an entrant on board.

    Raises:
        ValueError: As `make_entrant`; the entrant's own code fails.
    """
    scenarios = suite.scenarios(plant, episodes)
    diagnoser, prober = make_entrant(suite, plant, name, scenarios)
    knows = find_entrant(suite, plant, name) is TRUTH
    allow_for = "nothing" if suite.acts == "probing" else "truth" if knows else "diagnosis"
    with blamed(name):
        found = fly(plant, scenarios, diagnoser, prober, allow_for, suite.decision_period)
    record, said = found.record, found.decisions
    if knows:
        said = Decisions(record.label > 0, record.label.astype(np.int16), record.target, None, None)
    acted = [
        Acted(
            cost=float(found.cost[i, 1 : s.steps + 1].mean()),
            probed=int((found.probe[i, 1 : record.length[i] + 1] > 0).sum()),
            unusable=int(found.unusable[i]),
        )
        for i, s in enumerate(scenarios)
    ]
    return Flown(record, said, acted, found.probe, found.cost)
