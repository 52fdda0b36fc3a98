"""From `pip install` to the first picture: `python -m benchmarks.first_minute [--keep DIR]`.

Builds the wheel, installs it with the extra `plot` in a fresh environment, and starts `python -m jaxdyn.demo` there twice, in a
folder of its own and with caches of its own: cold, and once more with what the first run left. Prints the seconds until pip is
done, until the first line stands on the screen, until the first picture is a file, and until the demo ends. The first picture
is to be there within COLD and CACHED seconds; the exit status is 1 where it is later.
"""

import argparse
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

from benchmarks.wheel import installed

COLD, CACHED = 40.0, 15.0  # s
FIRST_LINE = 5.0  # s; importing jax is most of it


def watch(command: list, folder: Path, environment: dict[str, str], whole: bool) -> dict[str, float]:
    """Seconds to the first line, the first picture and the end of a run in a folder; the run is ended at its first picture
    unless `whole`.

    **Raises:** RuntimeError with what the run printed, where it ends without a picture.
    """
    began, seen, lines = time.perf_counter(), {}, []
    run = subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )

    def read():
        for line in run.stdout or ():
            seen.setdefault("first line", time.perf_counter() - began)
            lines.append(line)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    while run.poll() is None:
        if "first picture" not in seen and any(folder.rglob("*.png")):
            seen["first picture"] = time.perf_counter() - began
            if not whole:
                run.terminate()
        time.sleep(0.05)
    reader.join()
    seen["end"] = time.perf_counter() - began
    if "first picture" not in seen:
        raise RuntimeError(
            f"the demo ended with status {run.returncode} and without a picture: {''.join(lines)[-2000:]}"
        )
    return seen


def main(argv=None) -> int:
    """Install, run twice, print; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, help="make wheel and environment here and leave them")
    parser.add_argument("--whole", action="store_true", help="let both runs of the demo go on to their end")
    options = parser.parse_args(argv)
    with installed(options.keep, "[plot]") as (place, python, _, seconds):
        print(f"pip install: {seconds:.0f} s")
        caches = {"XDG_CACHE_HOME": str(place / "cache"), "MPLCONFIGDIR": str(place / "cache" / "matplotlib")}
        late = False
        for name, limit in (("cold", COLD), ("cached", CACHED)):
            folder = place / name
            folder.mkdir()
            command = [python, "-I", "-u", "-m", "jaxdyn.demo"]
            seen = watch(command, folder, {**os.environ, **caches}, options.whole)
            late |= seen["first picture"] > limit or seen["first line"] > FIRST_LINE
            ended = f", end {seen['end']:.0f} s" if options.whole else ""
            print(
                f"python -m jaxdyn.demo, {name}: first line after {seen['first line']:.1f} s, first picture after "
                f"{seen['first picture']:.1f} s (at most {limit:g} s){ended}"
            )
        print(f"from pip install to the first picture: {seconds:.0f} s and what 'cold' says")
        return int(late)


if __name__ == "__main__":
    sys.exit(main())
