"""The command; see the package's docstring."""

from benchmarks.reproduction.missile_pitch.page import write
from benchmarks.reproduction.missile_pitch.paper import plan
from benchmarks.reproduction.pieces import command

if __name__ == "__main__":
    command("missile_pitch", plan, write)
