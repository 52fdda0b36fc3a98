"""Shared parts of the commands: options of the model and of Dask clusters, vectors on the command line, output files."""

import argparse
import contextlib
import os
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from jaxdyn.constraints.loops import Loop
from jaxdyn.io import LoadedScene, formats, urdf_inertia_report
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import inertia
from jaxdyn.model.arguments import as_path, parse_number
from jaxdyn.model.builder import GRAVITY
from jaxdyn.model.description import short as short
from jaxdyn.model.description import table as table
from jaxdyn.model.tree import Model
from jaxdyn.pictures import plot
from jaxdyn.reports.plotting import BLUE, bands, new_figure
from jaxdyn.simulation.solution import Solution, signals, times
from jaxdyn.systems.system import SceneLike

FILE = "a URDF, xacro, MJCF or SDF file, or a name of robot_descriptions such as go2_description"


def help_format(prog: str) -> argparse.HelpFormatter:
    """Help formatter that keeps options and their texts on one line where they fit."""
    # Raw, because the examples in the epilogs have line breaks of their own.
    return argparse.RawDescriptionHelpFormatter(prog, max_help_position=29)


def option(
    place: argparse._ActionsContainer,
    usage: str,
    text: str,
    kind: Callable[[str], float] | None = None,
    default: object = None,
    **more: Any,
) -> None:
    """Add an option to a parser or a group by its usage, as help prints it, and a text.

    "--view" is a flag, "--dt S" has a value, "--q0 Q ..." several, "--gravity X Y Z" three, "--abi {c,casadi}" one of these.
    """
    name, *values = usage.split()
    if not values:
        place.add_argument(name, action="store_true", help=text)
        return
    if values[0].startswith("{"):
        more["choices"] = values[0].strip("{}").split(",")
    elif values[-1] == "...":
        more |= {"nargs": "+", "metavar": values[0]}
    else:
        more |= {"nargs": len(values), "metavar": tuple(values)} if len(values) > 1 else {"metavar": values[0]}
    if more.get("action") == "extend":
        # Shells expand one pattern per option, so that a repeated option extends its list.
        default = []
    place.add_argument(name, help=text, type=kind or str, default=default, **more)


def add_model_options(parser: argparse.ArgumentParser, title: str = "model") -> None:
    """Add the options that determine the mechanism of a file."""
    group = parser.add_argument_group(title)
    option(group, "--floating-base", "let the root link move freely (6 more degrees of freedom)")
    # SDF models float by default and URDF models do not, so each direction has an option.
    option(group, "--fixed-base", "fix the root links of an SDF file to the world")
    option(
        group,
        "--lock JOINT[=VALUE] ...",
        "lock these joints of a URDF file, at neutral or at a value (rad, m)",
        action="extend",
    )
    option(
        group,
        "--mimic {couple,ignore}",
        "joints of a URDF file that follow others: coupled (info and simulate: the default), or free",
    )
    option(group, "--arguments NAME=VALUE ...", "arguments of a .xacro file, which is expanded first", action="extend")
    option(
        group,
        "--gravity X Y Z",
        "gravity, m/s^2 (default: that of the file; for URDF 0 0 -9.81 in axes of the root link)",
        real,
    )


def load_model(path: str, args: argparse.Namespace, missing_inertia: Any = None) -> Model:
    """Load the model of a URDF file under the options of `add_model_options`."""
    # A model alone imposes no couplings, so that joints which follow others are free by default.
    model = formats.load_model(
        path,
        floating_base=args.floating_base,
        lock=_lock(args),
        mimic=args.mimic or "ignore",
        gravity=GRAVITY if args.gravity is None else tuple(args.gravity),
        missing_inertia=missing_inertia,
        arguments=xacro_arguments(args),
    )
    return _movable(model, path)


def load_for_repair(path: str, args: argparse.Namespace) -> tuple[Model, list[str]]:
    """Load a model, and the names of the massless moving links that were given a small ball.

    Links are changed only if the file cannot be loaded as it is. The ball makes the mass matrix positive definite and changes the
    motion of the other links little; the fit replaces it.

    **Raises:** ValueError as `load_model`, where balls do not help.
    """
    try:
        return load_model(path, args), []
    except ValueError:
        file = XmlFile(path, "URDF", xacro_arguments(args))
        masses = [parse_number(mass.get("value", "0")) for mass in file.root.iterfind("link/inertial/mass")]
        # A hundredth of the heaviest link, of 1 kg if no link has a mass.
        ball = inertia.sphere(1e-2 * (max(masses, default=0.0) or 1.0), 0.05)
        model = load_model(path, args, ball)
        report = urdf_inertia_report(path, arguments=xacro_arguments(args))
        massless = [name for name, problem in report if problem.startswith("massless") and name in model.body_names]
        return model, massless


def load_scene(path: str, args: argparse.Namespace) -> tuple[LoadedScene, pathlib.Path]:
    """Load the scene of a file or a named robot under the options of `add_model_options`; return it with its file."""
    file = as_path(path, "file")
    if not file.suffix and not file.exists():
        file = formats.find_description(path)
    if args.floating_base and args.fixed_base:
        raise ValueError("--floating-base and --fixed-base contradict each other; give one of them")
    # Neither option: None, for the default of the format.
    floating = False if args.fixed_base else True if args.floating_base else None
    scene = formats.load(
        file, floating_base=floating, lock=_lock(args), mimic=args.mimic, arguments=xacro_arguments(args)
    )
    _movable(scene.system, path)
    if args.gravity is not None:
        scene = eqx.tree_at(lambda s: s.system, scene, scene.system.replace(gravity=np.array(args.gravity)))
    return scene, file


def load_mechanism(path: str, args) -> LoadedScene | None:
    """Scene of a file that has loops; None for a tree."""
    scene, _ = load_scene(path, args)
    return scene if any(isinstance(constraint, Loop) for constraint in scene.constraints) else None


def _lock(args: argparse.Namespace) -> dict[str, Any]:
    lock: dict[str, Any] = {}
    for item in args.lock:
        name, equals, text = item.partition("=")
        lock[name] = number(text, f"--lock {item}") if equals else None
    return lock


def xacro_arguments(args: argparse.Namespace) -> dict[str, str]:
    """Values of the file's `<xacro:arg>` elements. **Raises:** ValueError for items other than NAME=VALUE."""
    if bad := [item for item in args.arguments if item.find("=") < 1]:
        raise ValueError(f"--arguments {bad[0]}: give NAME=VALUE")
    return {name: value for name, _, value in (item.partition("=") for item in args.arguments)}


def _movable(model: Model, path: str) -> Model:
    # Later failures, on empty arrays, would not name the cause.
    if model.nv == 0:
        raise ValueError(f"{path}: no joint is free to move; lock fewer joints or use --floating-base")
    return model


def number(text: str, what: str) -> float:
    """Parse a finite number. **Raises:** ValueError that names the option."""
    with contextlib.suppress(ValueError):
        if np.isfinite(value := parse_number(text)):
            return value
    raise ValueError(f"{what}: {text!r} is no finite number")


def real(text: str) -> float:
    """Argument type of finite numbers in decimal digits."""
    try:
        return number(text, "argument")
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no finite number") from None


def whole(text: str) -> int:
    """Argument type of integers of at most 18 digits."""
    with contextlib.suppress(ValueError):
        # Python reads "1_0" as ten; larger numbers overflow the int64 of JAX.
        if "_" not in text and abs(value := int(text)) < 2**62:
            return value
    raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at most 18 digits")


def check_minimum(args: argparse.Namespace, **minimum: int) -> None:
    """Check lower bounds of options, by their names in `args`. **Raises:** ValueError that names one."""
    for name, bound in minimum.items():
        values = getattr(args, name)
        for value in values if isinstance(values, list) else [] if values is None else [values]:
            if value < bound:
                raise ValueError(f"--{name.replace('_', '-')} is {value}; give at least {bound}")


def check_memory(count: float, options: str) -> None:
    """Refuse results with more double-precision numbers than the machine has memory for.

    **Raises:** ValueError that names the options.
    """
    # Windows has no sysconf; 64 GB stands for an unknown size.
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2**36
    # Negated, so that NaN and infinity are refused too.
    if not 8 * count < memory:
        raise ValueError(
            f"{options}: {8 * count / 2**30:.3g} GB of results, and the machine has {memory / 2**30:.3g} GB; request fewer rows "
            "or motions"
        )


def vector(model: Model, items: Sequence[str], start, what: str) -> np.ndarray:
    """Parse coordinates: as many numbers as `start` has, or JOINT=NUMBER[,NUMBER...] to change some of them."""
    # A copy, since some of its entries are overwritten.
    start = np.array(start, float)
    slices = model.topology.q_slices if what == "--q0" else model.topology.v_slices
    # In JOINT=1,2 the comma separates the numbers of one joint; elsewhere it separates coordinates.
    items = [part for item in items for part in (item.split(",") if "=" not in item else [item])]
    if not any("=" in item for item in items):
        if len(items) != len(start):
            raise ValueError(
                f"{what} has {len(items)} numbers, the model needs {len(start)} (joints {', '.join(model.joint_names)}); "
                "give all of them or JOINT=VALUE"
            )
        return np.array([number(item, what) for item in items])
    for item in items:
        name, _, text = item.partition("=")
        if name not in model.joint_names:
            raise ValueError(f"{what}: {name!r} is no joint of the model; joints are {', '.join(model.joint_names)}")
        place = slices[model.joint_names.index(name)]
        values = [number(part, f"{what} {item}") for part in text.split(",")]
        if len(values) != place.stop - place.start:
            raise ValueError(f"{what} {item}: joint {name!r} has {place.stop - place.start} numbers, got {len(values)}")
        start[place] = values
    return start


def per_coordinate(model: Model, values: Sequence[float], what: str) -> np.ndarray:
    """Broadcast one number to all velocity coordinates, or check one each."""
    if len(values) not in (1, model.nv):
        raise ValueError(f"{what} has {len(values)} numbers; give 1, or {model.nv}, one per velocity coordinate")
    return np.broadcast_to(np.array(values, float), (model.nv,)).copy()


def output_path(text: str | None, suffixes: Sequence[str], option: str) -> pathlib.Path | None:
    """Path of an output file, checked before any work is done: known suffix, existing directory."""
    if text is None:
        return None
    path = as_path(text, option)
    # The suffix selects the writer, so it is checked with the path.
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{option} {text}: write to a file that ends in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise ValueError(f"{option} {text}: there is no directory {path.parent}")
    return path


def plot_motion(path: pathlib.Path, scene: SceneLike, solution: Solution) -> None:
    """Plot positions, velocities and torques of a motion to a file; of a batch, the bands of the first eight of each."""
    if np.ndim(solution.q) == 2:
        figure, axes = new_figure(8.5, 7.5, 3, 1, sharex=True)
        plot.states(scene, solution, axes[:2, 0])
        plot.forces(scene, solution, axes[2, 0])
    else:
        # Bands of several joints would cover each other.
        drawn = [one for one in signals(solution, scene) if one.key in ("q", "v", "tau")]
        columns = min(8, max(len(one.names) for one in drawn))
        figure, axes = new_figure(2.1 * columns + 0.7, 6.2, len(drawn), columns, sharex=True)
        for row, one in zip(axes, drawn, strict=True):
            for k, (ax, name, unit) in enumerate(zip(row, one.names, one.units, strict=False)):
                bands(ax, times(solution), one.values[:, :, k], BLUE)
                ax.set(xlabel="time (s)", ylabel=f"{one.key} {name} ({unit})")
        figure.suptitle(f"median, 25 to 75 % and 5 to 95 % of {len(solution.q)} motions", fontsize=10)
    figure.savefig(path)
    print(f"Wrote {path}.")


class Stopwatch:
    """Wall-clock time since construction, in seconds."""

    def __init__(self):
        # A monotonic clock: corrections of the wall clock do not show.
        self._start = time.perf_counter()

    def __str__(self):
        return f"{time.perf_counter() - self._start:.1f} s"


# --- options `--client` and `--workers`: Dask clusters that compute for a command ---


def add_cluster_options(parser: argparse._ActionsContainer) -> None:
    """Add the options to a parser or to a group of one."""
    place = parser.add_mutually_exclusive_group()
    option(place, "--client ADDRESS", "address of a Dask scheduler whose workers compute, as tcp://host:8786")
    option(place, "--workers N", "number of local Dask worker processes to start", whole)


@contextlib.contextmanager
def connect(args: argparse.Namespace) -> Iterator[Any]:
    """Connect to the scheduler at --client, or to a local cluster of --workers processes; None with neither.

    **Raises:** ValueError where no scheduler answers, for fewer than one worker, and where Dask is not installed.
    """
    check_minimum(args, workers=1)
    if args.client is None and args.workers is None:
        yield None
        return
    try:
        # Imported on use: Dask is an extra.
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ValueError(f"--client and --workers need {error.name}: pip install 'jaxdyn[scale]'") from error
    with contextlib.ExitStack() as stack:
        place = args.client
        if place is None:
            # Any free port for the dashboard, whose address is printed.
            local = LocalCluster(n_workers=args.workers, threads_per_worker=2, processes=True, dashboard_address=":0")
            place = stack.enter_context(local)
        try:
            client = stack.enter_context(Client(place))
        except (OSError, ValueError) as error:
            raise ValueError(f"--client is {args.client}, where no scheduler of Dask answers: {error}") from error
        yield client
