"""`jaxdyn identify fit.toml`: options of the command in a file."""

import argparse
import tomllib
from typing import Any

from jaxdyn.model.arguments import as_path

# Options with paths, relative to the folder of the TOML file.
_FILES = ("urdf", "log", "test_log", "payload_log", "out", "report", "html", "plot")
# Options with the values yes and no, which TOML writes as true and false.
_YES_NO = ("unwrap",)


class _Parser(argparse.ArgumentParser):
    """Parser that raises ValueError instead of exiting."""

    def error(self, message):
        raise ValueError(message)


def with_file(args: argparse.Namespace, add_arguments) -> argparse.Namespace:
    """Merge the arguments with those of the TOML file `args.file` where the command line leaves the default.

    **Raises:** ValueError, with the file, for malformed TOML, an unknown option, and an invalid value.
    """
    if args.file is None:
        return args
    path = as_path(args.file, "file")
    if path.suffix.lower() != ".toml":
        raise ValueError(f"{path}: options are read from a .toml file; the robot is --urdf, a log --log")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: {error}") from None
    # A help option in a file would print and exit.
    parser = _Parser(add_help=False)
    add_arguments(parser)
    defaults = vars(parser.parse_args([]))
    tokens: list[str] = []
    # Through the same parser as the command line, so that types and choices are checked once.
    for name, value in table.items():
        if name.replace("-", "_") not in defaults or name == "file":
            names = ", ".join(option.replace("_", "-") for option in defaults if option != "file")
            raise ValueError(f"{path}: {name} is no option; options are {names}")
        tokens += _tokens(name, value, path)
    try:
        given = vars(parser.parse_args(tokens))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    # The positional argument takes what is left over, such as a second value of an option with one.
    if given["file"] is not None:
        raise ValueError(f"{path}: unrecognized arguments: {given['file']}; an option of one value has a list")
    # An option that the command line sets to its default looks like one that is left out; the file wins then.
    merged = vars(args) | {key: given[key] for key, value in defaults.items() if getattr(args, key) == value}
    return argparse.Namespace(**merged | {"file": args.file})


def _tokens(name: str, value: Any, path) -> list[str]:
    """Convert one entry to command-line tokens."""
    option = f"--{name.replace('_', '-')}"
    if name in _YES_NO and isinstance(value, bool):
        value = "yes" if value else "no"
    # Flags have no value on the command line: false means that the option is absent.
    if isinstance(value, bool):
        return [option] if value else []
    values = value if isinstance(value, list) else [value]
    if any(isinstance(item, bool | dict | list) for item in values):
        raise ValueError(f"{path}: {name} is {value!r}; give a number, a string, or a list of them")
    if name.replace("-", "_") in _FILES:
        # An absolute path stays: joining drops the folder in front of it.
        values = [path.parent / str(item) for item in values]
    # The form --option=value lets a value start with a minus sign.
    return [option, *map(str, values)] if isinstance(value, list) else [f"{option}={values[0]}"]
