"""Diagnosers whose numbers were learned. Discovered without torch: what needs it is imported when one is built."""

import importlib
from typing import Any

from fdi_gym.diagnosis import NotApplicableError


def network_module(name: str) -> Any:
    """The module `baselines.networks.<name>`.

    Raises:
        NotApplicableError: The extra with torch and stable-baselines3 is not installed.
    """
    try:
        return importlib.import_module(f"baselines.networks.{name}")
    except ModuleNotFoundError as error:
        raise NotApplicableError(f"needs {error.name}: pip install 'fdi-gym[learn]'") from error
