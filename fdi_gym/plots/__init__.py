"""Pictures: a flight under way, recorded flights with diagnoses, and what the flights of a suite come to.

Colours are those of `fdi_gym.palette`, units stand in brackets, legends outside, and the truth above what is said about it.
matplotlib is imported when something is drawn.
"""

from fdi_gym.palette import LINES
from fdi_gym.plots.acting import Point, Shown, acted_flight, allowances, pareto
from fdi_gym.plots.canvas import Canvas
from fdi_gym.plots.flights import flight, method_signals
from fdi_gym.plots.recordings import recording
from fdi_gym.plots.scores import confusions, delays, ranking, severities

__all__ = [
    "LINES", "Canvas", "Point", "Shown", "acted_flight", "allowances", "confusions", "delays", "flight", "method_signals",
    "pareto", "ranking", "recording", "severities",
]  # fmt: skip
