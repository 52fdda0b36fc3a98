"""Command line: `jaxdyn info`, `simulate`, `sweep`, `excite`, `identify`, `calibrate`, `report` and `export`."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from typing import NoReturn

import jax

from jaxdyn import __version__
from jaxdyn.cli import calibrate, excite, export, identify, info, report, simulate, sweep
from jaxdyn.cli.common import help_format, option

COMMANDS = (info, simulate, sweep, excite, identify, calibrate, report, export)
_EPILOG = """\
examples:
  jaxdyn info panda.urdf
  jaxdyn simulate panda.urdf --duration 2 --torque gravity --out motion.csv
  jaxdyn sweep study.toml
  jaxdyn identify --urdf panda.urdf --log log.csv --out fitted.urdf
  jaxdyn calibrate arm.urdf --frame flange --poses poses.csv --out calibrated.urdf
  jaxdyn report four_bar --out report
  jaxdyn export panda.urdf --function forward_dynamics --jacobian --out panda_fd

All numbers are in SI units and radians, in float64. `jaxdyn COMMAND --help` explains a command. Options can stand in a file:
`jaxdyn identify @fit.txt --train 0.6`; later ones override earlier ones.
Exit status: 0 done; 1 the computation failed; 2 wrong input or arguments.
"""


class _Parser(argparse.ArgumentParser):
    """Parser whose files of options, @FILE, are split as by a shell, with comments after #."""

    def error(self, message: str) -> NoReturn:
        """End with a message; a file of options without its @ is named with it."""
        words = message.removeprefix("unrecognized arguments: ").split() if message.startswith("unrecognized") else []
        if any(word.endswith((".txt", ".toml", ".yaml", ".yml", ".ini", ".cfg")) for word in words):
            message += "; a file of options is given as @fit.txt, with lines such as --urdf arm.urdf"
        super().error(message)

    def convert_arg_line_to_args(self, arg_line: str) -> list[str]:
        """Options of a line."""
        try:
            return shlex.split(arg_line, comments=True)
        except ValueError:
            self.error(f"a line in a file of options is {arg_line!r}; close its quotation marks")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command with the given arguments (by default those of the process) and return the exit status."""
    parser = _Parser(
        prog="jaxdyn",
        description="Rigid-body dynamics of robots: inspect a file, simulate it, run studies of many rollouts, identify "
        "inertias from logs, calibrate their geometry, report error against run time, and export functions to C.",
        epilog=_EPILOG,
        formatter_class=help_format,
        fromfile_prefix_chars="@",
    )
    parser.add_argument("--version", action="version", version=f"jaxdyn {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    # A command is a module: its name, HELP, DESCRIPTION, EPILOG, add_arguments and run.
    for module in COMMANDS:
        name = module.__name__.rpartition(".")[2]
        command = commands.add_parser(
            name,
            help=module.HELP,
            description=module.DESCRIPTION,
            epilog=module.EPILOG,
            formatter_class=help_format,
        )
        module.add_arguments(command)
        option(command, "--debug", "show the traceback of an error")
        # argparse then selects the function together with the command.
        command.set_defaults(run=module.run)
    try:
        args = parser.parse_args(argv)
    except RecursionError:
        parser.error("a file of options names itself in a line that begins with @; leave this line out")
    # Commands are programs of their own, so they may choose float64; the library never does.
    jax.config.update("jax_enable_x64", True)
    try:
        return args.run(args) or 0
    except BrokenPipeError:  # the reader (`head`, `less`) closed the pipe
        # Python would report the closed pipe once more when it flushes at exit.
        sys.stderr.close()
        return 0
    # The library refuses inputs by these three, so that they mean status 2.
    except (ValueError, OSError, ImportError) as error:
        return _complain(error, 2, args.debug)
    except (RuntimeError, MemoryError, ArithmeticError) as error:
        return _complain(error, 1, args.debug)
    except KeyboardInterrupt:
        print("jaxdyn: interrupted", file=sys.stderr)
        # Shells report 128 plus the number of the signal, 2 for SIGINT.
        return 130


def _complain(error: Exception, status: int, debug: bool) -> int:
    # Users see one line; a traceback helps only those who look for a fault of the library.
    if debug:
        raise error
    text = " ".join(str(error).split()) or type(error).__name__
    # A MemoryError has a short text that does not say what it is.
    print(f"jaxdyn: {'not enough memory: ' * isinstance(error, MemoryError)}{text}", file=sys.stderr)
    return status
