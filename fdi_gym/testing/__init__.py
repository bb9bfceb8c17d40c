"""The conformance kit: what every plant, environment and diagnoser must keep. Use it on yours, as our tests do on ours.

Each check raises AssertionError with what was wrong. Scenario processes are drawn with the seeds given.
"""

from fdi_gym.testing.diagnosers import check_diagnoser, with_gaps
from fdi_gym.testing.environments import check_streams, check_vector_env
from fdi_gym.testing.plants import check_plant

__all__ = ["check_diagnoser", "check_plant", "check_streams", "check_vector_env", "with_gaps"]
