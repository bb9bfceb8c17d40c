"""The command; see the package's docstring."""

from benchmarks.reproduction.b747_lateral.page import write
from benchmarks.reproduction.b747_lateral.paper import plan
from benchmarks.reproduction.pieces import command

if __name__ == "__main__":
    command("b747_lateral", plan, write)
