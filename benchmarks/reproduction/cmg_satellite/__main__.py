"""The command; see the package's docstring."""

from benchmarks.reproduction.cmg_satellite.page import write
from benchmarks.reproduction.cmg_satellite.plan import plan
from benchmarks.reproduction.pieces import command

if __name__ == "__main__":
    command("cmg_satellite", plan, write)
