"""The command; see the package's docstring."""

from benchmarks.reproduction.huav_hover.page import write
from benchmarks.reproduction.huav_hover.paper import plan
from benchmarks.reproduction.pieces import command

if __name__ == "__main__":
    command("huav_hover", plan, write)
