"""Bring a recording: a CSV file with names, units and a clock of its own, shown to a method of the package.

On the command line:

    fdi-gym diagnose flight.csv --plant B747Lateral --diagnosers two_stage_kf_exponential --mapping mapping.json
"""

import json
from pathlib import Path
from tempfile import mkdtemp

import numpy as np

from fdi_gym.diagnosis import make_diagnoser, run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.faults import draw
from fdi_gym.recordings import doubts, observations, read_mapping, to_frame, write_table

MAPPING = {
    "time": {"column": "stamp", "unit": "ms"},
    "channels": {"r": {"column": "yaw rate", "unit": "rad/s"}},  # the plant has deg/s
    "label": {"column": "state", "names": {"ok": "none"}},
}

if __name__ == "__main__":
    folder, plant = Path(mkdtemp()), load_plant("B747Lateral")
    # somebody's file: a flight that is flown here, in other names and units, without three seconds in the middle
    frame = to_frame(plant, simulate(plant, [draw(plant.process("standard"), 5)]))
    label = np.where(frame["label"] == "none", "ok", frame.pop("label"))
    frame |= {"stamp": 1000 * frame.pop("time"), "yaw rate": np.radians(frame.pop("r")), "state": label}
    kept = np.abs(frame["stamp"] - 60_000) > 1500
    write_table(folder / "flight.csv", {name: column[kept] for name, column in frame.items()}, {})
    (folder / "mapping.json").write_text(json.dumps(MAPPING))

    recording = observations(plant, folder / "flight.csv", read_mapping(folder / "mapping.json"))
    for note in recording.notes:
        print(f"mended: {note}")
    for doubt in doubts(plant, recording.obs):
        print(f"doubtful: {doubt}")
    said = run(make_diagnoser("two_stage_kf_exponential", plant), recording.obs[None])
    changes = np.flatnonzero(np.diff(said.label[0], prepend=0))
    for k in changes[:10]:
        print(f"{recording.time[k]:6.1f} s: {plant.labels[said.label[0, k]].name}")
    print(f"right labels: {(said.label[0] == recording.label)[1:].mean():.2f}")
