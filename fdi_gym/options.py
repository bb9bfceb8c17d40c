"""Options of every plant, beside its own: how its sensors fail and report, and whether faults come at once."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import msgspec

from fdi_gym.faults import Sampling
from fdi_gym.plant import Plant
from fdi_gym.sensors import with_sampling, with_sensor_faults
from fdi_gym.simultaneous import with_simultaneous
from fdi_gym.unseen import with_unseen

FEEDBACK = ("faulty", "healthy")
LASTING = ("sensor_faults", "sensor_severity", "unseen", "simultaneous", "feedback", "delays")  # what a method may know


class Options(msgspec.Struct, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """What `load_plant` and every environment take beside a plant's own options.

    Args:
        sensor_faults: Its sensors may fail (`fdi_gym.sensors`).
        sensor_severity: Factor on the sizes of their faults that the processes draw, from 0.01 to 1.
        unseen: It meets faults that no method was told of (`fdi_gym.unseen`).
        simultaneous: Any of its faults may act at once (`fdi_gym.simultaneous`).
        feedback: What the controller gets from a sensor that fails: what it says ("faulty"), or what a healthy one would
            ("healthy").
        dropout, burst, periods, delays, hold: How its sensors report, as in `fdi_gym.faults.Sampling`.
    """

    sensor_faults: bool = False
    sensor_severity: float = 1.0
    unseen: bool = False
    simultaneous: bool = False
    feedback: str = "faulty"
    dropout: float = 0.0
    burst: float = 1.0
    periods: dict[str, int] = {}
    delays: dict[str, int] = {}
    hold: bool = False

    @staticmethod
    def check_feedback(value: Any) -> None:
        """Raises ValueError for what is no feedback of sensors."""
        if value not in FEEDBACK:
            raise ValueError(f"unknown feedback {value!r}; there are {', '.join(FEEDBACK)}")

    def applied(self, plant: Plant) -> Plant:
        """The plant with them.

        Raises:
            ValueError: A value that is not allowed or has no effect, or a sensor that the plant does not have.
        """
        self.check_feedback(self.feedback)
        fields = ("dropout", "burst", "periods", "delays", "hold")
        given = msgspec.to_builtins(self)
        sampling = msgspec.convert({name: getattr(self, name) for name in fields}, Sampling)
        if self.sensor_faults:
            plant = with_sensor_faults(plant, self.sensor_severity)
        elif self.sensor_severity != 1.0:
            raise ValueError("sensor_severity is that of sensor_faults, which are not asked for")
        if self.unseen:
            plant = with_unseen(plant)
        if self.simultaneous:
            plant = with_simultaneous(plant)
        if self.feedback == "healthy":
            plant = dataclasses.replace(plant, healthy_feedback=True)
        lasting = {name: value for name, value in given.items() if name in LASTING}
        regular = with_sampling(plant, Sampling(delays=self.delays)) if self.delays else plant
        regular = dataclasses.replace(regular, options={**plant.options, **lasting}) if lasting else regular
        if given == lasting:
            return regular
        return dataclasses.replace(with_sampling(plant, sampling), regular=regular, options={**plant.options, **given})


def split_options(options: Mapping[str, Any]) -> tuple[dict[str, Any], Options]:
    """The options of a plant: its own, and those of every plant.

    `feedback` is the sensors' where its value is one of `FEEDBACK`; a plant may have an option of that name.

    Raises:
        ValueError: A value of another type.
    """
    layer = {name: value for name, value in options.items() if name in Options.__struct_fields__}
    if "feedback" in layer and layer["feedback"] not in FEEDBACK:
        del layer["feedback"]
    try:
        found = msgspec.convert(msgspec.to_builtins(layer), Options)
    except (msgspec.ValidationError, TypeError) as error:
        raise ValueError(f"{error}; the options of sensors are {', '.join(Options.__struct_fields__)}") from None
    return {name: value for name, value in options.items() if name not in layer}, found
