"""A plant of which only the channels are known: what data-driven methods need, and nothing that a model could be made of."""

from __future__ import annotations

from typing import Annotated, NoReturn

import msgspec
import numpy as np
from msgspec import Meta

from fdi_gym.data_sheet import FaultMode, Label, Signal
from fdi_gym.faults import FaultProcess, Scoring
from fdi_gym.model import NotApplicableError
from fdi_gym.plant import Plant

Word = Annotated[str, Meta(min_length=1, max_length=200)]
Finite = Annotated[float, Meta(ge=-1e300, le=1e300)]


class Channel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One channel. Its range and scale are what learners divide by, and what a unit is doubted by."""

    name: Word
    unit: str = ""
    low: Finite = -1e300
    high: Finite = 1e300
    scale: Annotated[float, Meta(gt=0, le=1e300)] = 1.0

    def signal(self) -> Signal:
        """As an entry of a data sheet."""
        return Signal(self.name, self.unit, self.low, self.high, self.scale, nominal=min(max(0.0, self.low), self.high))


class Channels(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is recorded, how often, and what may be wrong.

    Args:
        dt: Sample time [s] to which recordings are brought.
        sensors: What is measured.
        commands: What the actuators are told.
        labels: Names of the faults; "none" is added before them.
        grace: Samples after a change of the true label that are not scored.
        start: First scored sample: how long methods may look at a plant that is healthy.
    """

    dt: Annotated[float, Meta(gt=0, le=1e9)]
    sensors: Annotated[list[Channel], Meta(min_length=1, max_length=10_000)]
    commands: Annotated[list[Channel], Meta(max_length=10_000)] = []
    labels: Annotated[list[Word], Meta(min_length=1, max_length=1000)] = msgspec.field(default_factory=lambda: ["fault"])
    grace: Annotated[int, Meta(ge=0, le=10**6)] = 0
    start: Annotated[int, Meta(ge=1, le=10**6)] = 1


def _nothing_flies(rng: np.random.Generator) -> NoReturn:
    raise NotApplicableError("needs equations; this plant declares channels only")


def _unknown(theta: np.ndarray) -> np.ndarray:
    return np.full(theta.shape[:-1], np.nan)


def channels_plant(plant_id: str, channels: Channels) -> Plant:
    """The plant: channels, labels and scoring. Its fault parameter says for each fault whether it is there.

    Whatever needs its equations raises NotApplicableError.

    Raises:
        ValueError: Names that occur twice, or an id that is no word.
    """
    n = len(channels.labels)
    modes = tuple(
        FaultMode(name, "as labelled", _unknown, (1.0, 1.0),
                  offset=tuple(np.eye(n)[i]), direction=(0.0,) * n, reach=(0.0, 0.0))
        for i, name in enumerate(channels.labels)
    )  # fmt: skip
    recorded = FaultProcess(
        name="standard", description="recorded flights", sample=_nothing_flies,
        scoring=Scoring(start=channels.start, grace=channels.grace),
    )  # fmt: skip
    return Plant(
        id=plant_id, version=0, description="channels only", dt=channels.dt, substeps=0, kernels=None, states=(),
        outputs=tuple(c.signal() for c in channels.sensors), commands=tuple(c.signal() for c in channels.commands),
        theta=tuple(Signal(name, "", 0.0, 1.0) for name in channels.labels), modes=modes,
        labels=(Label("none", frozenset()), *(Label(name, frozenset({name})) for name in channels.labels)),
        processes=(recorded,),
    )  # fmt: skip
