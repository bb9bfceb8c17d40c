"""The flights that come next, prepared before they are wanted: while threads fly, and a few at a time in the steps after.

Flights of one length end together, and to begin a thousand in one step stalls it. An episode's seed comes from its
environment's generator, so the flight that follows is known long before: it is drawn and prepared ahead, and taken where
the generator gives that seed in the end. Where it gives another (a reset with a seed came between) the flight is dropped.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from fdi_gym.flights import Prepared

TOGETHER = 8  # flights that are prepared in one step: the first of them finds cold caches


class NextFlights:
    """Of each environment at most one: prepared in the order in which they are wanted, at the pace that this needs.

    Args:
        prepare: Makes the flight of an episode's seed.
    """

    def __init__(self, prepare: Callable[[int], Prepared]):
        self._make = prepare
        self._ready: dict[int, tuple[int, Prepared]] = {}  # by environment, with the seed that it has
        self._queue: list[int] = []  # environments, the first one last
        self._pace, self._owed = 0.0, 0.0  # flights per step

    def plan(self, slots: np.ndarray, left: np.ndarray) -> None:
        """These environments want their next flights after so many steps each; others are not looked after."""
        missing = np.array([slot not in self._ready for slot in slots.tolist()], bool)
        slots, left = slots[missing], np.maximum(left[missing], 1)
        order = np.argsort(left, kind="stable")
        self._queue = slots[order][::-1].tolist()
        self._pace = float((np.arange(1, len(order) + 1) / left[order]).max(initial=0.0))

    def prepare(self, generator: Callable[[int], np.random.Generator]) -> None:
        """The share of one step; the environments' generators stay as they are."""
        self._owed = self._owed + self._pace if self._queue else 0.0
        if self._owed < TOGETHER:
            return
        due, self._owed = int(self._owed), 0.0
        while due and self.prepare_one(generator):
            due -= 1

    def prepare_one(self, generator: Callable[[int], np.random.Generator]) -> bool:
        """The next of the queue; whether there was one."""
        if not self._queue:
            return False
        slot = self._queue.pop()
        rng = generator(slot)
        state = rng.bit_generator.state
        seed = int(rng.integers(2**63))
        rng.bit_generator.state = state
        with contextlib.suppress(Exception):  # what is wrong is told when the flight begins, if it does
            self._ready[slot] = seed, self._make(seed)
        return True

    def take(self, slot: int, seed: int) -> Prepared | None:
        """The prepared flight of this environment, if it has that seed."""
        expected, flight = self._ready.pop(slot, (None, None))
        return flight if expected == seed else None
