"""Conformal prediction: whether a flight is like those that are known, from scores of flights of each label.

V. Vovk, A. Gammerman, G. Shafer, Algorithmic Learning in a Random World, 2005: with the scores of n flights of a label, and
that of another flight of the same label, the p-value (1 + the number of the n that are at least as large) / (n + 1) is at
most alpha with a probability of at most alpha, whatever the score is. What is excluded for every label is none that is
known; since the largest p-value is at least that of the label that is true, so it is for each label.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np

from fdi_gym.model import Array


class Conformity(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Scores of flights of each label, by its name, ascending: how unlike anything known they look.

    A label without flights has no say.
    """

    scores: Mapping[str, list[float]] = {}

    def p_value(self, score: Array) -> Array:
        """The largest p-value (n,) of any label, for scores (n,); 1 where there is no label."""
        found = [
            (1 + len(known) - np.searchsorted(known, score, side="left")) / (1 + len(known))
            for known in self.scores.values() if known
        ]  # fmt: skip
        return np.max(found, axis=0) if found else np.ones(len(score))
