"""Error against run time beside MuJoCo, Pinocchio and SciPy, all timed in turn within one loop.

    python -m benchmarks.work_precision [SCENE ...] [--batch 1 1024] [--rounds 20] [--full] [--out out/work_precision]

The page is that of `jaxdyn report`, with the peers' ladders as dashed lines on scenes that they can do.
"""

import argparse

import jax

from benchmarks import motion_peers, timing
from jaxdyn.report import report


def main(argv=None) -> None:
    """Measure, print the tables, write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=None, metavar="SCENE")
    parser.add_argument("--batch", nargs="+", type=int, default=(1,))
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--out", default=str(timing.OUT / "work_precision"))
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    scenes = options.scenes or (None if options.full else tuple(motion_peers.twins()))
    found = report(
        scenes,
        full=options.full,
        dtypes=("float64",),
        batches=tuple(options.batch),
        rounds=options.rounds,
        out=options.out,
        peers=motion_peers.contestants,
        echo=lambda line: print(line, flush=True),
    )
    print(f"\n{found.table()}\n\nWritten to {options.out}/report.html")


if __name__ == "__main__":
    main()
