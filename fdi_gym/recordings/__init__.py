"""Recordings: flights that somebody has recorded, as files or tables, and what methods and scores need of them.

    recording = observations(plant, open_table("flight.csv"))       # or a dict of columns, a data frame, an Arrow table
    said = run(make_diagnoser("augmented_ekf", plant), recording.obs[None])

`observations` finds the plant's channels among the columns, brings them to the plant's units and samples, and says what it
mended; `doubts` says what else may be wrong. `to_frame` is the way back. They are functions and no methods of `Plant` and
`Record`, since those lie below files, clocks and units. Nothing that is read here is executed.
"""

from fdi_gym.recordings.columns import to_frame, write_table
from fdi_gym.recordings.doubts import doubts
from fdi_gym.recordings.mapping import Mapping, read_mapping
from fdi_gym.recordings.observations import Recording, observations
from fdi_gym.recordings.tables import Table, open_table, table_files

__all__ = [
    "Mapping", "Recording", "Table",
    "doubts", "observations", "open_table", "read_mapping", "table_files", "to_frame", "write_table",
]  # fmt: skip
