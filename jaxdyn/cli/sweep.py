"""`jaxdyn sweep`: resumable studies of many rollouts, described by a file, into a Zarr store."""

import argparse
import importlib.util
import inspect
import pathlib
import tomllib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn import scale, scenes
from jaxdyn.cli.common import Stopwatch, add_cluster_options, check_memory, check_minimum, connect, option, whole
from jaxdyn.constraints.assembly import assemble
from jaxdyn.io import load
from jaxdyn.model.arguments import as_path
from jaxdyn.model.configuration import integrate
from jaxdyn.simulation.events import events_of
from jaxdyn.simulation.options import as_output
from jaxdyn.simulation.run import simulate

HELP = "simulate a study of many rollouts into a Zarr store; resumable"
DESCRIPTION = """\
Simulate many rollouts with parameters drawn from distributions in a file. Finished chunks are kept: the same command
resumes after an interruption. With a Dask scheduler the workers of a cluster share one study.
"""
EPILOG = """\
examples:
  jaxdyn sweep study.toml
  jaxdyn sweep study.toml --samples 1000 --out trial.zarr
  jaxdyn sweep study.toml --workers 4
  jaxdyn sweep study.toml --client tcp://10.0.0.1:8786

study.toml:
  scene = "rolling_disk"      a scene of jd.scenes, a URDF, MJCF or SDF file, or a file .py with functions
                              scene(parameters) and states(parameters) -> (q0, v0)
  out = "disks.zarr"          relative to the folder of the study
  samples = 100000
  seed = 0
  duration = 1.0              s
  points = 11                 rows of each rollout
  outputs = ["energy"]        as in jd.simulate
  rows = true                 false: result codes and reductions only; or a list of names

  [parameters]                drawn for each rollout; arguments of a scene of jd.scenes and of its start;
                              of a robot's file: q0, a displacement from its placement, and v0 (size is nv); its
                              loops and couplings are closed at the start
  mass = { uniform = [1.0, 3.0], units = "kg" }
  radius = { normal = [0.5, 0.01], units = "m" }     mean, standard deviation
  # damping = { log_uniform = [1e-3, 1.0], size = 2 }

  [options]                   options of jd.simulate: stepsize, rtol, atol, method, max_steps
  stepsize = 0.01

  [reductions]
  energy = { mean = "energy" }
  spread = { quantiles = "energy", low = 0.0, high = 10.0 }
  # histogram = "energy" with low, high, bins; worst = "time_reached" with keep
"""

_DRAWS = {
    "uniform": lambda key, a, b, shape: jax.random.uniform(key, shape, minval=a, maxval=b),
    "normal": lambda key, a, b, shape: a + b * jax.random.normal(key, shape),
    "log_uniform": lambda key, a, b, shape: jnp.exp(jax.random.uniform(key, shape, minval=np.log(a), maxval=np.log(b))),
}
_REDUCTIONS = {
    "mean": scale.Mean,
    "histogram": scale.Histogram,
    "quantiles": scale.Quantiles,
    "worst": scale.Worst,
}
_KEYS: dict[str, tuple[type, ...]] = {
    "scene": (str,),
    "out": (str,),
    "samples": (int,),
    "seed": (int,),
    "duration": (int, float),
    "points": (int,),
    "outputs": (list,),
    "rows": (bool, list),
    "parameters": (dict,),
    "options": (dict,),
    "reductions": (dict,),
}
# Options of `jd.simulate` that a file can set, and of `jd.scale.run`.
_OPTIONS = {"batch_size", "rtol", "atol", "max_steps", *inspect.signature(simulate).parameters}
# The study sets these itself, or a file cannot express them.
_OPTIONS -= {"scene", "q0", "v0", "ts", "control", "outputs", "adjoint", "events", "throw"}
# Events by words (`events_of`).
_EVENTS = {"contacts", "limits", "max_events"}
_OPTIONS |= _EVENTS


def _options(study: dict[str, Any]) -> dict[str, Any]:
    given = study.get("options", {})
    options = {name: value for name, value in given.items() if name not in _EVENTS}
    events = events_of(**{name: value for name, value in given.items() if name in _EVENTS})
    return options | ({"events": events} if events else {})


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("study", help=".toml file that describes the study, see below")
    option(parser, "--out DIR", "store, instead of the study's")
    option(parser, "--samples N", "number of rollouts, instead of the study's", whole)
    option(parser, "--seed N", "seed, instead of the study's", whole)
    add_cluster_options(parser)
    option(parser, "--devices N", "CPU devices that share the rollouts (default: 1)", whole)
    option(parser, "--chunk N", "rollouts per chunk (default: two seconds' work)", whole)
    option(parser, "--quiet", "no progress meter")


def run(args: argparse.Namespace) -> int:
    """Run the study and print its outcome; return 1 if a rollout failed."""
    check_minimum(args, chunk=1, samples=1)
    path = as_path(args.study, "study")
    study = _read(path)
    if args.devices is not None:
        if not 1 <= args.devices <= 4096:
            raise ValueError(f"--devices is {args.devices}; give 1 to 4096")
        # Before the first computation: JAX fixes its devices then.
        jax.config.update("jax_num_cpu_devices", args.devices)
    given = _require(study, path, "samples") if args.samples is None else args.samples
    duration, points = float(_require(study, path, "duration")), study.get("points", 2)
    if not 0 < duration < np.inf or points < 2 or given < 1:
        raise ValueError(
            f"{path}: samples is {given}, duration {duration} s, points {points}; give at least one sample, a positive duration "
            "and at least two points"
        )
    check_memory(float(points), f"{path}: points {points}")
    # Relative to the study, so that the command may be called from any folder.
    out = path.parent / _require(study, path, "out") if args.out is None else as_path(args.out, "--out")
    parameters = study.get("parameters", {})
    draw = make_draw(parameters)
    scene, states = _scene(_require(study, path, "scene"), path, tuple(parameters))
    ts = np.linspace(0.0, duration, points)
    options, watch = _options(study), Stopwatch()
    with connect(args) as client:
        result = scale.run(
            scene,
            states,
            draw,
            ts,
            samples=given,
            seed=study.get("seed", 0) if args.seed is None else args.seed,
            out=out,
            outputs=tuple(map(as_output, study.get("outputs", ()))),
            rows=study.get("rows", True),
            reductions={name: _reduction(name, one) for name, one in study.get("reductions", {}).items()},
            units={name: one["units"] for name, one in parameters.items() if isinstance(one, dict) and "units" in one},
            resources=scale.Resources(
                client, batch_size=options.pop("batch_size", None), chunk=args.chunk, progress=not args.quiet
            ),
            **options,
        )
    print(f"{result}\nin {watch}, compilation included.")
    return int(not result.success)


def make_draw(parameters: Mapping[str, Any]) -> Callable[[Any], dict[str, Any]]:
    """Function that draws the parameters of one rollout from its key; each parameter has its own key, in the order of names.

    **Raises:** ValueError for values that are neither numbers nor distributions.
    """
    drawn: dict[str, tuple[str, float, float, tuple[int, ...]]] = {}
    known: dict[str, float] = {}
    # Sorted, so that the order in the file does not change the samples of a seed.
    for name in sorted(parameters):
        one = parameters[name]
        # `type` and not isinstance: True is an int to Python.
        if type(one) in (int, float) and np.isfinite(one):
            known[name] = float(one)
            continue
        given: dict[str, Any] = one if isinstance(one, dict) else {}
        # Exactly one distribution, since two of them would contradict each other.
        kinds = [kind for kind in _DRAWS if kind in given]
        ends: Any = given[kinds[0]] if len(kinds) == 1 else ()
        numbers = isinstance(ends, list) and len(ends) == 2 and all(type(x) in (int, float) for x in ends)
        if not (numbers and np.all(np.isfinite(ends))):
            raise ValueError(
                f"parameter {name} is {one!r}; give a finite number, or one of {', '.join(_DRAWS)} = [a, b]"
            )
        size = given.get("size", 1)
        if type(size) is not int or not 1 <= size < 2**31:
            raise ValueError(f"parameter {name}: size is {size!r}; give a whole number of at least 1")
        if kinds[0] == "log_uniform" and not min(ends) > 0:
            raise ValueError(f"parameter {name}: log_uniform = {ends}; give positive numbers")
        drawn[name] = (kinds[0], float(ends[0]), float(ends[1]), (int(given["size"]),) if "size" in given else ())

    def draw(key: jax.Array) -> dict[str, Any]:
        keys = jax.random.split(key, max(1, len(drawn)))
        values = {
            name: _DRAWS[kind](own, a, b, shape)
            for own, (name, (kind, a, b, shape)) in zip(keys, drawn.items(), strict=False)
        }
        # Known numbers are returned too, so that the store holds all parameters of a rollout.
        return values | {name: jnp.asarray(value) for name, value in known.items()}

    return draw


def _read(path: pathlib.Path) -> dict[str, Any]:
    try:
        study = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is malformed TOML: {error}") from error
    # A misspelt key would silently leave its default in force.
    if unknown := study.keys() - _KEYS:
        raise ValueError(f"{path} has {', '.join(sorted(unknown))}; a study has {', '.join(sorted(_KEYS))}")
    for name, value in study.items():
        kinds = _KEYS[name]
        if type(value) not in kinds or (type(value) is int and abs(value) >= 2**62):
            raise ValueError(f"{path}: {name} is {value!r}; see `jaxdyn sweep --help`")
        if isinstance(value, list) and not all(isinstance(one, str) for one in value):
            raise ValueError(f"{path}: {name} is {value!r}; give a list of names")
    options = study.get("options", {})
    if bad := [name for name, value in options.items() if name not in _OPTIONS or isinstance(value, (list, dict))]:
        raise ValueError(
            f"{path}: [options] {bad[0]} is {options[bad[0]]!r}; options are {', '.join(sorted(_OPTIONS))}"
        )
    for name, one in study.get("parameters", {}).items():
        if isinstance(one, dict) and not isinstance(one.get("units", ""), str):
            raise ValueError(f"{path}: units of {name} are {one['units']!r}; give a text")
    return study


def _require(study: Mapping[str, Any], path: pathlib.Path, name: str) -> Any:
    if name not in study:
        raise ValueError(f"{path} has no {name}; see `jaxdyn sweep --help`")
    return study[name]


def _reduction(name: str, given: Any) -> scale.Reduction:
    kinds = [kind for kind in _REDUCTIONS if isinstance(given, dict) and kind in given]
    if len(kinds) != 1:
        raise ValueError(f"reduction {name} is {given!r}; give one of {', '.join(_REDUCTIONS)} = NAME")
    options = {key: value for key, value in given.items() if key != kinds[0]}
    try:
        if "probabilities" in options:
            # TOML has lists, and a static field must be hashable.
            options["probabilities"] = tuple(options["probabilities"])
        return _REDUCTIONS[kinds[0]](given[kinds[0]], **options)
    except TypeError as error:
        raise ValueError(f"reduction {name} is {given!r}: {error}") from error


def _scene(name: str, path: pathlib.Path, parameters: tuple[str, ...]) -> tuple[Any, Any]:
    """Functions of the parameters: the scene, and its initial state."""
    file = path.parent / name
    if file.suffix == ".py":
        # Loaded by path: the folder of the study need not be on sys.path.
        spec = importlib.util.spec_from_file_location(file.stem, file)
        if spec is None or spec.loader is None or not file.is_file():
            raise ValueError(f"{path}: scene is {name!r}, and there is no file {file}")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        missing = [part for part in ("scene", "states") if not callable(getattr(module, part, None))]
        if missing:
            raise ValueError(f"{file} has no function {' and '.join(missing)} of the parameters")
        return module.scene, module.states
    if file.suffix:
        # The scene and not the model alone: loops, couplings, springs, damping and friction of the file act.
        loaded = load(file)
        if unknown := set(parameters) - {"q0", "v0"}:
            raise ValueError(f"{path}: parameters of {file.name} are q0 and v0, not {', '.join(sorted(unknown))}")

        def states(p: Mapping[str, Any]) -> tuple[Any, Any]:
            at_rest = jnp.zeros(loaded.nv)
            # A displacement from the reference, since a draw of q itself would leave the unit quaternions.
            q = integrate(loaded.system, loaded.starts["reference"].q, p.get("q0", at_rest))
            v = jnp.asarray(p.get("v0", at_rest))
            if not loaded.constraints:
                return q, v
            closed = assemble(loaded, q, v, throw=False)
            return closed.q, closed.v

        return loaded, states
    if name not in scenes.names():
        raise ValueError(
            f"{path}: scene is {name!r}; name one of {', '.join(scenes.names())}, or a file of a robot or .py"
        )
    named = getattr(scenes, name)
    # A parameter may belong to the scene, to its start, or to both.
    of_scene, of_start = (set(inspect.signature(part).parameters) for part in (named, named.start_function))
    if unknown := set(parameters) - of_scene - of_start:
        raise ValueError(
            f"{path}: {name} has no parameter {', '.join(sorted(unknown))}; it has {', '.join(sorted(of_scene | of_start))}"
        )

    def refusal(error: Exception) -> ValueError:
        return ValueError(
            f"{path}: the scene {name!r} is built from concrete numbers, so that {', '.join(parameters)} cannot be drawn; "
            f"write a file .py whose scene(parameters) sets them with model.replace. {str(error).splitlines()[0]}"
        )

    def build(p: Mapping[str, Any]) -> Any:
        try:
            return named(**{key: value for key, value in p.items() if key in of_scene})
        except (jax.errors.JAXTypeError, TypeError, ValueError) as error:
            raise refusal(error) from error

    def start(p: Mapping[str, Any]) -> Any:
        try:
            return named.start(**{key: value for key, value in p.items() if key in of_start})
        except (jax.errors.JAXTypeError, TypeError, ValueError) as error:
            raise refusal(error) from error

    return build, start
