"""`jaxdyn report`: error against run time of scenes."""

import argparse

from jaxdyn import scenes
from jaxdyn.cli.common import Stopwatch, check_memory, check_minimum, option, whole
from jaxdyn.reports import report

HELP = "error against run time of scenes"
DESCRIPTION = """\
Integrate scenes of `jaxdyn.scenes` for one second by several methods, solvers, tolerances and steps; print error and run
time of each run, and write a page with log-log plots.
"""
EPILOG = """\
examples:
  jaxdyn report --list
  jaxdyn report pendulum_in_plane
  jaxdyn report four_bar windows --dtype float64 float32 --batch 1 256 --out out/report

The usual integrators, at four tolerances or three steps each, take a quarter of a minute to two minutes a scene,
most of it compilation.

output (--out DIR):
  report.html      one page: plots, tables, the machine; needs no network
  report.json      the same as data; jaxdyn.reports.Report.from_json reads it
  report.txt       what is printed
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help="names of scenes of jd.scenes (see --list), no files"
    )
    option(parser, "--list", "print the scenes and exit")
    option(parser, "--out DIR", "directory for the page, the data and the text")
    option(parser, "--dtype T ...", "float64, float32 (default: float64)", default=["float64"])
    option(parser, "--batch N ...", "trajectories at once (default: 1)", whole, [1])
    option(parser, "--integrator I ...", "method:solver, e.g. projected:Dopri8, instead of the usual ones")
    option(parser, "--rounds N", "timings of each run (default: 20)", whole, 20)


def run(args: argparse.Namespace) -> int:
    """Measure, print tables, write the files."""
    if args.list:
        print("\n".join(scenes.names()))
        return 0
    if not args.scenes:
        raise ValueError(f"no scene is named; name one of {', '.join(scenes.names())}")
    check_minimum(args, batch=1, rounds=1)
    check_memory(1000.0 * max(args.batch), f"--batch {max(args.batch)}")
    watch = Stopwatch()
    integrators = None if args.integrator is None else [tuple(pair.split(":")) for pair in args.integrator]
    options = {
        "dtypes": args.dtype,
        "batches": args.batch,
        "integrators": integrators,
        "rounds": args.rounds,
        "out": args.out,
    }
    # Flushed, since a long report's output may go to a file.
    result = report(args.scenes, echo=lambda line: print(line, flush=True), **options)
    print(f"\n{result.table()}\n\n{len(result.records)} runs in {watch}, compilation included.")
    if args.out:
        print(f"Wrote {args.out}/report.html, .json and .txt.")
    return 0
