"""The command line: `fdi-gym COMMAND`. A command is a function in `fdi_gym.commands`."""

from __future__ import annotations

import os
import sys
from typing import Any

import tyro

from fdi_gym.commands import methods, packages, pages, recordings, rounds, rows, suites
from fdi_gym.names import in_a_line

COMMANDS: dict[str, Any] = {
    "evaluate": rows.evaluate, "verify": rows.verify,
    "leaderboard": pages.leaderboard, "report": pages.report, "plot": pages.plot,
    "list": suites.show, "freeze": suites.freeze, "fit": methods.fit, "train": methods.train,
    "diagnosability": methods.diagnosability,
    "diagnose": recordings.diagnose, "collect": recordings.collect, "export": recordings.export,
    "seal": rounds.seal, "reveal": rounds.reveal,
    "new": packages.new, "check": packages.check,
}  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Entry point of `fdi-gym`. Errors that a user can mend are one line on stderr, exit status 2."""
    argv = sys.argv[1:] if argv is None else argv
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # "module:function" in the current folder, behind all that is installed
    try:
        if argv == ["--version"]:
            from fdi_gym import __version__

            print(f"fdi-gym {__version__}")
        else:
            tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="fdi-gym", args=argv)
        sys.stdout.flush()
    except BrokenPipeError:  # whoever read our output has seen enough
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (until the process ends)
        raise SystemExit(141) from None
    except KeyboardInterrupt:
        print("\nfdi-gym: interrupted; the same command goes on from what is finished", file=sys.stderr)
        raise SystemExit(130) from None
    except (ValueError, OSError) as error:
        print(f"fdi-gym: {in_a_line(error)}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
