"""Files of others against what they say: `python -m benchmarks.files mjcf|loops [FOLDER ...] [OPTIONS]`.

`mjcf`: every MJCF file below the folders that MuJoCo itself loads, against MuJoCo with contacts, limits, springs, friction and
drives off: the mass that moves, frames, mass matrix, bias, forward dynamics, and apart from that springs and dampers, drives, and
the rows of equalities. Files that compile to the same numbers are counted once.

`loops`: every mechanism with loops or couplings, of MJCF, SDF and URDF files below the folders, and those that this script
writes: loaded, assembled, simulated for 1 s under gravity, and written as a page for the browser.

Without folders those of installed packages are taken. Wheels that nothing here depends on are fetched and unpacked elsewhere:
`pip download --no-deps -d W brax dm_control gymnasium gymnasium-robotics mujoco-mjx playground robosuite`, then `python -m
zipfile -e W/brax-*.whl U` and so on for each, and the folder U.
"""

import argparse
import contextlib
import hashlib
import importlib.util
import re
import sys
import tempfile
import time
import warnings
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import jaxdyn as jd
from benchmarks import linkages
from jaxdyn.constraints.loops import Loop

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from mujoco_bridge import APART, agreement  # the oracle is that of the tests

PACKAGES = ("mujoco", "brax", "dm_control", "gymnasium", "gymnasium_robotics", "mujoco_playground", "robosuite")
WRITTEN = "written"  # by this script, in the names of the table
AGREED = 1e-9
CLOSED = 1e-10
MAX_FREEDOMS = 100  # degrees of freedom; beyond that the files at hand repeat one humanoid
SHOWN = ("mass", "frames", "M", "bias", "acceleration", "passive", "actuation", "rows")


def folders(given: list[str]) -> list[Path]:
    """The folders given, or those of installed packages."""
    if given:
        if missing := [name for name in given if not Path(name).is_dir()]:
            raise ValueError(f"no folders: {', '.join(missing)}; give folders that hold MJCF, SDF or URDF files")
        return [Path(name) for name in given]
    specs = (importlib.util.find_spec(name) for name in PACKAGES)
    computed = [Path(spec.submodule_search_locations[0]) for spec in specs if spec and spec.submodule_search_locations]
    try:
        data = distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")
    except PackageNotFoundError:
        return computed
    return [*computed, Path(str(data))]


def files(roots: list[Path], suffix: str, text: bytes) -> list[tuple[str, Path]]:
    """Files of a suffix that hold the text, each with a name short enough for a table."""
    rows = []
    for root in roots:
        for path in sorted(root.rglob(f"*{suffix}")):
            if text in path.read_bytes():
                rows.append((f"{root.name}/{path.relative_to(root)}", path))
    return rows


def quietly(make, *arguments, **options):
    """A call without its warnings, of what a file holds and is not taken."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return make(*arguments, **options)


def print_row(*cells) -> None:
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


def fingerprint(m) -> str:
    """The same for files that compile to the same numbers."""
    parts = (m.body_mass, m.body_inertia, m.body_pos, m.jnt_type, m.jnt_axis, m.jnt_pos, m.qpos0, m.dof_armature)
    more = (m.dof_damping, m.jnt_stiffness, m.eq_type, m.eq_data, m.actuator_gainprm, m.actuator_gear)
    digest = hashlib.sha256()
    for part in (*parts, *more):
        digest.update(np.ascontiguousarray(part).tobytes() + b";")
    return digest.hexdigest()


def compare(path: Path, m) -> tuple[dict[str, float], str]:
    """Errors of one file by quantity, and in words what stands against comparing others. A scene that is refused has none."""
    try:
        scene = quietly(jd.load, path)
    except ValueError as error:
        return {}, str(error).removeprefix(f"{path}: ")
    errors = quietly(agreement, path, scene)
    difference = [line for line in scene.not_taken if line.startswith(APART)]
    if difference:
        errors = {name: errors[name] for name in ("mass", "frames", "passive")}
    return errors, "; ".join(difference)


def mjcf(roots: list[Path], match: str) -> int:
    """Print the table of MJCF files; the number of faults."""
    seen: dict[str, str] = {}
    agreed, listed, faults, twins = 0, [], 0, 0
    print_row("file", "nv", *SHOWN)
    print_row(*["---"] * (2 + len(SHOWN)))
    for name, path in files(roots, ".xml", b"<mujoco"):
        if not re.search(match, name):
            continue
        try:
            m = quietly(mujoco.MjModel.from_xml_path, str(path))
        except ValueError:
            continue  # fragments that others include, and files whose meshes other packages hold
        if not 0 < m.nv <= MAX_FREEDOMS:
            continue
        if (key := fingerprint(m)) in seen:
            twins += 1
            continue
        seen[key] = name
        errors, reason = compare(path, m)
        print_row(name, m.nv, *(f"{errors[key]:.0e}" if key in errors else "" for key in SHOWN))
        worst = max(errors.values(), default=0.0)
        if reason:
            listed.append((name, reason))
        elif worst < AGREED:
            agreed += 1
        faults += not worst < AGREED
        if worst >= AGREED:
            listed.append((name, f"differs by {worst:.1e}"))
        jax.clear_caches()
    print(f"\n{agreed} files agree within {AGREED:g} in all quantities, {len(listed)} are listed, {faults} differ;")
    print(f"{twins} more compile to the numbers of one of them.\n")
    for name, reason in listed:
        print(f"- {name}: {reason}")
    return faults


def candidates(roots: list[Path], written: Path, only_written: bool) -> list[tuple[str, Path]]:
    """Files that may hold loops: those that this script writes, MJCF with equalities, SDF, URDF with a YAML file beside it."""
    computed = [(f"{WRITTEN}/{path.name}", path) for path in linkages.write(written, 4)]
    if only_written:
        return computed
    computed += files(roots, ".sdf", b"<sdf")
    computed += files(roots, ".xml", b"<mujoco")
    return computed + [one for one in files(roots, ".urdf", b"<robot") if one[1].with_suffix(".yaml").exists()]


def mechanism(path: Path):
    """The scene of a file; an SDF file's on a fixed base. ValueError where it is refused."""
    return quietly(jd.load, path, **({"floating_base": False} if path.suffix == ".sdf" else {}))


def number_of_loops(scene) -> int:
    return sum(isinstance(row, Loop) for row in scene.constraints)


def structure(scene) -> tuple:
    """The same for mechanisms with the same tree, kinds of joints and kinds of constraints, whatever their numbers."""
    topology = scene.system.topology
    return (
        topology.parents,
        topology.kinds,
        tuple((type(row).__name__, getattr(row, "joint", "")) for row in scene.constraints),
    )


def motion_of(name: str, path: Path, scene, html: Path, duration: float) -> tuple[str, ...]:
    """The row of a mechanism: sizes, gap of the file, steps, residuals, size of its page; the last cell is a fault or empty."""
    loops = number_of_loops(scene)
    sizes = (name, scene.nv, f"{loops} + {len(scene.constraints) - loops}")
    q = scene.starts["reference"].q
    gap = float(np.abs(jd.constraints.position_residual(scene, q, jnp.asarray(0.0))).max())
    began = time.perf_counter()
    try:
        start = jd.assemble(scene, q)
    except ValueError as error:
        return *sizes, f"{gap:.0e}", "", "", "", "", "", str(error)
    freedom = jd.degrees_of_freedom(scene, start.q)
    ts = jnp.linspace(0.0, duration, 41)
    options: dict = {"outputs": ("constraint_residual",), "throw": False}
    motion = jd.simulate(scene, start.q, start.v, ts, **options)
    # Rows that repeat others, also but for a file's digits, are dropped and counted (docs/constraints.md).
    dropped, gap_left = int(motion.stats.get("redundant_rows", 0)), float(motion.stats.get("redundant_gap", 0.0))
    note = f", {dropped} redundant rows, open by {gap_left:.0e}" if dropped else ""
    last = np.isfinite(np.asarray(motion.q)).all(1).sum()
    residual = np.nanmax(np.abs(np.asarray(motion.constraint_residual)[:last]), axis=0)
    steps = int(motion.stats["num_steps"])
    page = html / f"{path.parent.name}_{path.stem}.html"
    jd.pictures.save_html(page, scene, motion)
    fault = "" if motion.success else f"{motion.result} after {float(ts[last - 1]):.2f} s"
    if residual.max() >= CLOSED:
        fault += f" residual {residual.max():.1e}"
    kilobytes = page.stat().st_size / 1e3
    seconds = time.perf_counter() - began
    numbers = (f"{gap:.0e}", freedom, steps, *(f"{x:.0e}" for x in residual), f"{kilobytes:.0f}")
    return *sizes, *numbers, fault.strip() or f"{seconds:.0f} s{note}"


def loops(roots: list[Path], match: str, html: Path, duration: float, only_written: bool) -> int:
    """Print the table of mechanisms with loops; the number of faults."""
    print_row(
        "file",
        "nv",
        "loops + others",
        "gap",
        "freedom",
        "steps",
        "position",
        "velocity",
        "page kB",
        "fault, or seconds",
    )
    print_row(*["---"] * 10)
    good, faults, seen = 0, 0, set()
    with tempfile.TemporaryDirectory() as written:
        for name, path in candidates(roots, Path(written), only_written):
            if not re.search(match, name):
                continue
            try:
                scene = mechanism(path)
            except ValueError as error:
                if path.suffix != ".xml":  # an MJCF may be a fragment that others include
                    print_row(name, *[""] * 8, str(error).removeprefix(f"{path}: "))
                    faults += 1
                continue
            key = structure(scene)
            if not number_of_loops(scene) or (key in seen and not name.startswith(WRITTEN)):
                continue  # couplings alone, or one mechanism in other surroundings
            seen.add(key)
            row = motion_of(name, path, scene, html, duration)
            print_row(*row)
            moved = re.match(r"\d+ s\b", str(row[-1])) is not None
            good, faults = good + moved, faults + (not moved)
            jax.clear_caches()
    print(f"\n{good} mechanisms assemble and move for {duration:g} s with residuals below {CLOSED:g}, {faults} do not.")
    return faults


def main(argv=None) -> int:
    """The exit status: 1 where a file differs or a motion fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("mjcf", "loops"))
    parser.add_argument("folders", nargs="*")
    parser.add_argument("--html", type=Path, help="loops: write the pages here and keep them")
    parser.add_argument("--duration", type=float, default=1.0, help="loops: length of the motions (s)")
    parser.add_argument("--written", action="store_true", help="loops: only those that this script writes")
    parser.add_argument("--match", default="", help="only files whose name in the table has this regular expression")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    began = time.perf_counter()
    roots = folders(options.folders)
    if options.what == "mjcf":
        faults = mjcf(roots, options.match)
    else:
        with contextlib.ExitStack() as stack:
            html = options.html or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            html.mkdir(parents=True, exist_ok=True)
            faults = loops(roots, options.match, html, options.duration, options.written)
    print(f"\n{time.perf_counter() - began:.0f} s")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
