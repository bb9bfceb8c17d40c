"""A report: what a suite's rows say and a few of its flights, in one HTML file that needs nothing else to be looked at."""

from fdi_gym.report.assembly import report
from fdi_gym.report.page import LARGEST, html

__all__ = ["LARGEST", "html", "report"]
