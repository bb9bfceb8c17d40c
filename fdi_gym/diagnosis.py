"""What a diagnoser is, how one is found by name, and the guard under which it runs.

A diagnoser is a pair of functions, batched over n episodes:

    init(n) -> state
    update(state, obs) -> (state, Diagnosis)      # obs (n, n_obs): the samples k = 0, 1, ... in turn

The state is any nest of tuples, NamedTuples, lists and dicts. Its arrays have the episodes along their first axis; a
plain number in it (a sample counter) is shared by all episodes. A builder makes one from a plant:

    @diagnoser("two_stage_kf", "Two-stage Kalman filter")
    def two_stage_kf(plant: Plant, *, forgetting: str = "none") -> Diagnoser: ...

Builders in the modules and packages of the entry-point group "fdi_gym.diagnosers" are discovered; none is listed.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points
from typing import Any, NamedTuple

import numpy as np

from fdi_gym.names import blame, check_diagnoser_name, find_function, unknown
from fdi_gym.plant import Array, Plant, contiguous


class Diagnosis(NamedTuple):
    """What a diagnoser says after a sample about the interval that has just ended, for n episodes.

    A method that does not isolate gives label 0 or any guess with its alarm; what a method does not give is None.
    """

    alarm: Array  # (n,) bool: there is a fault
    label: Array  # (n,) int: label index
    estimate: Array | None = None  # (n, n_estimated) estimate of what the identification task asks for
    estimate_std: Array | None = None  # (n, n_estimated) its standard deviation
    label_probs: Array | None = None  # (n, labels) probabilities, where the method has them
    state: Array | None = None  # (n, n_x) estimate of the plant's state
    signals: dict[str, Array] | None = None  # (n, ...) each: residuals, thresholds, an approximated fault function


class Diagnoser(NamedTuple):
    """A pair of functions; see the module's docstring."""

    init: Callable[[int], Any]
    update: Callable[[Any, Array], tuple[Any, Diagnosis]]


class NotApplicableError(ValueError):
    """A builder's word that its method cannot run on this plant, with the reason (no unknown input, rank condition)."""


class Entry(NamedTuple):
    """A diagnoser that can be asked for by name."""

    name: str
    summary: str
    build: Callable[..., Diagnoser]
    settings: Mapping[str, Any]
    clairvoyant: bool

    def settings_on(self, plant: Plant, **tuning: Any) -> dict[str, Any]:
        """What its builder gets: the caller's tuning over the name's settings over what the plant brings."""
        return {**plant.tuning.get(self.name, {}), **self.settings, **tuning}


_entries: dict[str, Entry] = {}


def diagnoser(name: str, summary: str, *, clairvoyant: bool = False, **settings: Any) -> Callable[[Any], Any]:
    """Make a builder known under a name. Stacked, it gives one builder several names with different settings.

    Args:
        name: As users and tables call it.
        summary: One line for tables.
        clairvoyant: The builder takes `scenarios=`, one per episode, and its row says that it knows the truth.
        settings: Keyword arguments of the builder that belong to this name.

    Raises:
        ValueError: The name is taken, or the builder has no such keyword.
    """

    def register(build: Callable[..., Diagnoser]) -> Callable[..., Diagnoser]:
        taken = _entries.get(name)
        if taken is not None and (taken.build.__module__, taken.build.__qualname__) != (
            build.__module__, build.__qualname__,
        ):  # fmt: skip
            raise ValueError(f"two diagnosers are called {name!r}: {taken.build.__module__} and {build.__module__}")
        allowed = inspect.signature(build).parameters
        for setting in settings:
            if setting not in allowed:
                raise ValueError(f"{build.__name__} has no setting {setting!r}; it has {', '.join(allowed)}")
        _entries[name] = Entry(name, summary, build, settings, clairvoyant)
        return build

    return register


@functools.cache
def broken_plugins() -> dict[str, str]:
    """The modules of the entry-point group that cannot be imported, with the reason; the others are imported."""
    broken = {}

    def load(what: str, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except (Exception, SystemExit) as error:
            broken[what] = blame(error)
            return None

    for entry_point in entry_points(group="fdi_gym.diagnosers"):
        place = load(entry_point.value, entry_point.load)
        for module in pkgutil.walk_packages(getattr(place, "__path__", []), f"{entry_point.value}.", onerror=lambda _: None):
            load(module.name, functools.partial(importlib.import_module, module.name))
    return broken


def diagnosers() -> dict[str, Entry]:
    """All diagnosers by name, in the order in which their modules declare them."""
    broken_plugins()  # imports the modules in which they are
    return dict(_entries)


def find_diagnoser(name: str) -> Entry:
    """The diagnoser of this name; "module:function" names a builder that is not discovered.

    Raises:
        ValueError: There is none; the message lists those that exist.
    """
    if ":" in name:
        build = find_function("diagnoser", check_diagnoser_name(name))
        try:
            arguments = inspect.signature(build).parameters
        except (ValueError, TypeError):  # a builtin
            arguments = {}
        if not arguments:
            raise ValueError(f"{name} is no builder of a diagnoser: it takes no plant")
        return Entry(name, (inspect.getdoc(build) or name).splitlines()[0], build, {}, False)
    found = diagnosers()
    if name not in found:
        raise unknown("diagnoser", name, found)
    return found[name]


def make_diagnoser(name: str, plant: Plant, *, scenarios: Sequence[Any] | None = None, **tuning: Any) -> Diagnoser:
    """A diagnoser by name, for a plant, under the guard (see `guarded`).

    Args:
        name: As in `find_diagnoser`.
        plant: The plant whose model it gets.
        scenarios: The truth, one per episode; only a clairvoyant one gets it.
        tuning: Keyword arguments of its builder, over those of the name, which are over those of the plant.

    Raises:
        ValueError: Unknown name or keyword; `NotApplicableError` where the method cannot run on this plant.
    """
    entry = find_diagnoser(name)
    allowed = inspect.signature(entry.build).parameters
    settings = entry.settings_on(plant, **tuning)
    for key in settings:
        if key not in allowed:
            raise ValueError(f"{name} has no setting {key!r}; it has {', '.join(list(allowed)[1:]) or 'none'}")
    known = {"scenarios": scenarios} if entry.clairvoyant else {}
    if entry.clairvoyant and scenarios is None:
        raise ValueError(f"{name} knows the truth: it needs scenarios, one per episode")
    try:
        built = entry.build(plant, **settings, **known)
    except ValueError:
        raise
    except Exception as error:
        raise ValueError(f"the builder of {name} failed: {blame(error)}") from error
    if not isinstance(built, Diagnoser):
        raise ValueError(f"the builder of {name} gives {type(built).__name__}, not a Diagnoser")
    return guarded(built, plant)


def told(name: str, process: str) -> dict[str, str]:
    """`{"process": process}` where a method's builder asks which fault process to expect, else nothing."""
    return {"process": process} if "process" in inspect.signature(find_diagnoser(name).build).parameters else {}


# ---------------------------------------------------------------------------------------------------------------
# The guard: one bad sample or one lost filter never reaches another episode, and never ends a run.


def _map(function: Callable[..., Any], *trees: Any) -> Any:
    """Apply to the arrays of equal nests; other leaves are those of the first."""
    first = trees[0]
    if isinstance(first, np.ndarray):
        return function(*trees)
    if isinstance(first, dict):
        return {key: _map(function, *(tree[key] for tree in trees)) for key in first}
    if isinstance(first, (tuple, list)):
        parts = [_map(function, *branches) for branches in zip(*trees, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else type(first)(parts)
    return first


def _choose(mask: Array, yes: Any, no: Any) -> Any:
    """The nest whose episodes are those of `yes` where the mask is set, else those of `no`."""
    return _map(lambda a, b: np.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), yes, no)


def _normal(plant: Plant, n: int, diagnosis: Diagnosis) -> Diagnosis:
    """The diagnosis with its arrays in their declared types."""
    label = np.asarray(diagnosis.label, dtype=np.int64)
    alarm = np.asarray(diagnosis.alarm, dtype=bool)
    for name, value, shape in (("alarm", alarm, (n,)), ("label", label, (n,))):
        if value.shape != shape:
            raise ValueError(f"a diagnosis has {name} of shape {shape}, not {value.shape}")
    for name, width in (
        ("estimate", len(plant.estimated)),
        ("estimate_std", len(plant.estimated)),
        ("label_probs", len(plant.labels)),
        ("state", len(plant.states)),
    ):
        value = getattr(diagnosis, name)
        if value is not None and np.shape(value) != (n, width):
            raise ValueError(f"a diagnosis has {name} of shape {(n, width)} or None, not {np.shape(value)}")
    return diagnosis._replace(alarm=alarm, label=label)


def guarded(raw: Diagnoser, plant: Plant) -> Diagnoser:
    """The diagnoser as the evaluation runs it.

    A sample with a non-finite value in it is a dropout: that episode's diagnoser does not see it and repeats its last
    word. An episode whose estimate leaves the numbers, or whose update fails in linear algebra, is lost: label -1, which
    is never right, and estimate NaN, from there to its end. The other episodes of the batch are not touched.

    Raises (from update):
        ValueError: obs has the wrong shape, or the diagnoser's answer does.
    """
    width = len(plant.observed)

    def init(n: int) -> Any:
        theta = np.tile(plant.estimate_target(plant.nominal_theta, plant.trim_command), (n, 1))
        healthy = Diagnosis(np.zeros(n, bool), np.zeros(n, np.int64), theta, np.full_like(theta, np.nan))
        return raw.init(n), healthy, np.zeros((n, width)), np.zeros(n, bool)

    def singly(state: Any, obs: Array) -> tuple[Any, Diagnosis, Array]:
        """The update, episode by episode, after it failed for the batch; and which failed."""
        n = len(obs)
        failed, states, answers = np.zeros(n, bool), [], []
        for i in range(n):
            part = _map(lambda a, i=i: a[i : i + 1], state)
            try:
                part, answer = raw.update(part, obs[i : i + 1])
            except (np.linalg.LinAlgError, FloatingPointError):
                failed[i], answer = True, None
            states.append(part)
            answers.append(answer)
        template = next((a for a in answers if a is not None), Diagnosis(np.zeros(1, bool), np.zeros(1, np.int64)))
        answers = [template if a is None else a for a in answers]
        leader = int(np.argmin(failed))
        states[0], states[leader] = states[leader], states[0]  # shared counters are those of one that went on
        order = np.arange(n)
        order[0], order[leader] = leader, 0
        joined = _map(lambda *parts: np.concatenate(parts)[order], *states)
        return joined, _map(lambda *parts: np.concatenate(parts), *answers), failed

    def update(state: Any, obs: Array) -> tuple[Any, Diagnosis]:
        inner, last, last_obs, lost = state
        n = len(lost)
        obs = contiguous(obs)
        if obs.shape != (n, width):
            raise ValueError(
                f"obs has the shape {(n, width)} ({', '.join(s.name for s in plant.observed)}), not {obs.shape}"
            )
        seen = np.isfinite(obs).all(axis=1) & ~lost
        if not seen.all():
            obs = np.where(seen[:, None], obs, last_obs)
        with np.errstate(all="ignore"):
            try:
                after, answer = raw.update(inner, obs)
                failed = np.zeros(n, bool)
            except np.linalg.LinAlgError:
                after, answer, failed = singly(inner, obs)
        answer = _normal(plant, n, answer)
        if answer.estimate is not None:
            failed |= ~np.isfinite(answer.estimate).all(axis=1)
        if failed.any() or not seen.all():
            fresh = failed & seen
            lost = lost | fresh
            after = _choose(seen & ~lost, after, inner)
            if fresh.any():  # where it stays, out of harm's way; shared counters are those of the episodes that go on
                after = _choose(~fresh, after, raw.init(n))
            kept: Any = Diagnosis._make(b if a is None or b is None else a for a, b in zip(last, answer, strict=True))
            answer = _choose(seen & ~lost, answer, kept)
            lines = {
                k: np.where(lost[:, None], np.nan, a) for k in ("estimate", "state") if (a := getattr(answer, k)) is not None
            }
            answer = answer._replace(alarm=answer.alarm & ~lost, label=np.where(lost, -1, answer.label), **lines)
        return (after, answer, obs, lost), answer

    return Diagnoser(init, update)


class Decisions(NamedTuple):
    """What a diagnoser said over recorded flights: the fields of `Diagnosis` with samples along the second axis."""

    alarm: Array  # (N, K + 1) bool
    label: Array  # (N, K + 1) int16
    estimate: Array | None  # (N, K + 1, n_estimated)
    estimate_std: Array | None
    label_probs: Array | None  # (N, K + 1, labels)
    state: Array | None = None  # (N, K + 1, n_x)
    signals: dict[str, Array] | None = None  # (N, K + 1, ...) each, where they were asked for


def run(diagnoser: Diagnoser, obs: Array, signals: bool = False) -> Decisions:
    """Show recorded observations (N, K + 1, n_obs) to a diagnoser, sample by sample, and record what it says.

    Args:
        diagnoser: The diagnoser.
        obs: The observations.
        signals: Record the method's own signals too.
    """
    n, samples, _ = obs.shape
    state = diagnoser.init(n)
    alarm, label = np.zeros((n, samples), bool), np.zeros((n, samples), np.int16)
    wide: dict[str, Array | None] = dict.fromkeys(("estimate", "estimate_std", "label_probs", "state"))
    own: dict[str, Array] = {}
    for k in range(samples):
        state, said = diagnoser.update(state, obs[:, k])
        alarm[:, k], label[:, k] = said.alarm, said.label
        for name in wide:
            value = getattr(said, name)
            if value is not None:
                store = wide[name]
                if store is None:
                    store = wide[name] = np.full((n, samples, value.shape[1]), np.nan)
                store[:, k] = value
        for name, value in (said.signals or {}).items() if signals else ():
            own.setdefault(name, np.full((n, samples, *value.shape[1:]), np.nan))[:, k] = value
    return Decisions(alarm, label, **wide, signals=own or None)
