"""`jaxdyn export`: functions of a robot's dynamics as object files for C or CasADi."""

import argparse
from collections.abc import Callable

import numpy as np

import jaxdyn as jd
from jaxdyn.cli.common import FILE, add_model_options, load_scene, option
from jaxdyn.exports.exported import ABIS, HOST, TARGETS

HELP = "write a function of a robot as an object file for C or CasADi"
DESCRIPTION = """\
Compile a function of a robot's dynamics to an object file that needs no Python, with a C header, a test program and a
build file, or with CasADi's interface. The robot's parameters are compiled in.
"""
EPILOG = """\
examples:
  jaxdyn export panda.urdf --function forward_dynamics --jacobian --out panda_fd
  jaxdyn export panda.urdf --function inverse_dynamics --target aarch64 --out panda_id
  jaxdyn export robot.xml --function constrained_dynamics --jacobian --abi casadi --out robot_cd

FOLDER/NAME.h documents the C function; `cc NAME_test.c NAME.o -lm && ./a.out` compares it with reference results.
"""

# Arguments of each function: q, v and a third vector.
_ARGUMENTS = {
    "forward_dynamics": ("q", "v", "tau"),
    "constrained_dynamics": ("q", "v", "tau"),
    "inverse_dynamics": ("q", "v", "a"),
    "bias_force": ("q", "v"),
    "gravity_force": ("q",),
    "mass_matrix": ("q",),
    "forward_kinematics": ("q",),
    "center_of_mass": ("q",),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", help=FILE)
    add_model_options(parser)
    parser.add_argument(
        "--function",
        choices=tuple(_ARGUMENTS),
        default="forward_dynamics",
        help="function to export (default: forward_dynamics)",
    )
    option(parser, "--name NAME", "name of the C function (default: that of --function)")
    option(parser, "--jacobian", "add the Jacobians of the result with respect to each argument")
    option(parser, "--batch", "add a vectorised function of many samples")
    option(parser, "--out FOLDER", "output folder, created if missing", required=True)
    option(
        parser,
        "--target TARGET",
        f"target platform: {HOST}, {', '.join(TARGETS)}, or an LLVM triple (default: {HOST})",
        default=HOST,
    )
    option(parser, "--cpu CPU", "processor in LLVM's notation, such as cortex-a72")
    option(parser, "--features FEATURES", "processor features in LLVM's notation, such as +neon")
    parser.add_argument("--abi", choices=ABIS, default="c", help="calling interface (default: c)")


def run(args: argparse.Namespace) -> None:
    """Export the function and print the paths of its files."""
    scene, _ = load_scene(args.file, args)
    # The examples fix shapes and dtypes; neutral keeps quaternions of unit length in the reference results.
    names, example = _ARGUMENTS[args.function], np.asarray(jd.neutral(scene.system), float)
    rest = np.zeros(scene.system.nv)
    name = args.function if args.name is None else args.name
    system, function = scene.system, getattr(jd, args.function)
    # The C header takes its argument names from the signature, so `*args` would not do.
    wrappers: dict[tuple[str, ...], Callable] = {
        ("q", "v", "tau"): lambda q, v, tau: function(system, q, v, tau),
        ("q", "v", "a"): lambda q, v, a: function(system, q, v, a),
        ("q", "v"): lambda q, v: function(system, q, v),
        ("q",): lambda q: function(system, q),
    }
    if args.function == "constrained_dynamics":
        # An exported function returns one array; the result of the library holds more.
        wrappers[names] = lambda q, v, tau: jd.constrained_dynamics(scene, q, v, tau).acceleration
    exported = jd.export(
        wrappers[names],
        *(example if x == "q" else rest for x in names),
        name=name,
        derivatives=("jacobian",) if args.jacobian else (),
        batch=args.batch,
    )
    folder = exported.save(args.out, args.target, args.abi, cpu=args.cpu, features=args.features)
    # The folder may hold exports of other names.
    files = ", ".join(sorted(x.name for x in folder.iterdir() if x.name.startswith(name)))
    print(f"{exported} for {args.target}, in {folder}: {files}")
    # The library refuses a scene here; the command has only a file, whose other parts would silently be lost.
    if args.function in ("forward_dynamics", "inverse_dynamics") and (scene.constraints or scene.forces):
        parts = [row.name for row in scene.constraints] + [type(force).__name__ for force in scene.forces]
        print(
            f"{args.function} is that of the tree, without {', '.join(parts)}; --function constrained_dynamics has them"
        )
