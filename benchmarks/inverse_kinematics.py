"""Inverse kinematics: success rate and time at random reachable targets, from random starts; against mink where it is installed.

python -m benchmarks.inverse_kinematics [CASE ...] [--count 1000] [--mink PYTHON]

A target is what the frames have at a random configuration within the limits, a start another one. Reached: every error below 1e-6
m or rad (1e-5 for Cassie, whose file has five digits). `--mink` names a Python that has mink and daqp; it solves the same
targets from the same starts, by velocity steps with limits, until they are reached or after 200 steps, one after the other.
Parallel robots have no peer here.
"""

import argparse
import json
import subprocess
import tempfile
import time
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks.first_calls import G1, PANDA, robot, robot_file, stewart
from benchmarks.linkages import delta
from benchmarks.timing import chosen_names, machine, write

HERE = Path(__file__).resolve().parent


class Case(NamedTuple):
    """A scene with the frames that have targets, and the start of a search under loops.

    `file`, of a peer; `atol`, of all errors (m, rad); `spread` of the configurations of targets around the start (rad or m).
    """

    scene: jd.Scene
    frames: list[str]
    start: jax.Array
    file: str | None = None
    atol: float = 1e-6
    spread: float = 0.3


def arm(which, frames):
    """A robot on its base, and the frames that have targets."""
    file, _, lock = which
    model = robot(file, False, lock)[0]
    return Case(jd.Scene(model), list(frames), jd.neutral(model), file)


def panda():
    """A Panda's hand: 7 joints, 6 rows."""
    return arm(PANDA, ["panda_hand"])


def g1():
    """A G1's hands and feet on a fixed pelvis: 29 joints, 24 rows."""
    limbs = ("ankle_roll", "wrist_yaw")
    return arm(G1, [f"{side}_{limb}_link" for side in ("left", "right") for limb in limbs])


def delta_robot():
    """The plate of a delta robot of six rods on balls, from MJCF: 6 rows and 3 degrees of freedom under 18 rows of loops."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "delta.xml"
        path.write_text(delta())
        scene = jd.load(path)
    return Case(scene, ["plate"], scene.starts["reference"].q)


def stewart_platform():
    """The plate of a Stewart platform: 6 rows, under 18 rows of loops."""
    scene, guess = stewart()
    return Case(scene, ["plate"], guess)


def cassie():
    """The feet of Cassie on a fixed pelvis, from SDF: 12 rows, under four loops of balls with rods and leaf springs."""
    warnings.simplefilter("ignore", jd.io.NotTakenWarning)
    scene = jd.io.load(robot_file("cassie_description/robots/cassie_v2.sdf"), floating_base=False)
    # Standing: the reference of the file is beyond the limits of four joints.
    leg = jnp.array([0.0, 0.0, 0.5, -1.2, 0.0, 1.43, -1.6, -1.52, 1.5, 0.0, 0.0])
    start = jd.assemble(scene, jnp.tile(leg, 2), throw=False).q
    # Redundant rows of the loops are open by 1e-8, as angles of the file have five digits: so much closer is no target reached.
    return Case(scene, ["left-foot", "right-foot"], start, atol=1e-5, spread=0.1)


CASES: dict[str, Callable] = {f.__name__: f for f in (panda, g1, delta_robot, stewart_platform, cassie)}


def reachable(case: Case, count: int):
    """Targets (count, frames, 4, 4) and starts (count, nq)."""
    scene, guess, model = case.scene, case.start, case.scene.system
    keys = jax.random.split(jax.random.key(0), count)
    if not scene.constraints:
        there = jax.vmap(lambda key: jd.random_configuration(model, key))(keys)
        starts = jax.vmap(lambda key: jd.random_configuration(model, key))(jax.random.split(jax.random.key(1), count))
    else:  # configurations around the guess that close; searches start at the guess
        shift = jax.vmap(lambda key: case.spread * jax.random.normal(key, (model.nv,)))(keys)
        closed = jax.jit(jax.vmap(lambda d: jd.assemble(scene, jd.integrate(model, guess, d), throw=False)))(shift)
        within = (closed.q >= model.lower) & (closed.q <= model.upper)
        kept = np.flatnonzero(np.asarray(closed.success & within.all(1)))
        there = closed.q[jnp.asarray(np.resize(kept, count))]
        starts = jnp.broadcast_to(guess, there.shape)
    poses = jax.jit(jax.vmap(lambda q: jnp.stack([jd.frame_pose(model, q, frame) for frame in case.frames])))(there)
    return poses, starts


def ours(case: Case, poses, starts, guesses: int):
    """Share of targets reached, microseconds each in a batch, milliseconds alone, and seconds of the first call."""

    def solve(poses, q):
        targets = dict(zip(case.frames, poses, strict=True))
        return jd.inverse_kinematics(case.scene, targets, q, guesses=guesses, atol=case.atol)

    batch, alone = jax.jit(jax.vmap(solve)), jax.jit(solve)
    begin = time.perf_counter()
    reached = jax.block_until_ready(batch(poses, starts))
    first = time.perf_counter() - begin
    jax.block_until_ready(alone(poses[0], starts[0]))
    times, singles = [], []
    for _ in range(5):
        begin = time.perf_counter()
        jax.block_until_ready(batch(poses, starts))
        times.append(time.perf_counter() - begin)
    for k in range(20):
        begin = time.perf_counter()
        jax.block_until_ready(alone(poses[k], starts[k]))
        singles.append(time.perf_counter() - begin)
    success = float(np.mean(np.asarray(reached.success)))
    return {
        "reached": success,
        "microseconds": min(times) / len(poses) * 1e6,
        "milliseconds alone": float(np.median(singles)) * 1e3,
        "first call": first,
        "guesses": float(np.mean(np.asarray(reached.guesses))),
    }


def bare_urdf(file: str, lock, folder: Path) -> Path:
    """The URDF without meshes, and with the locked joints fixed, for a peer that would look for them."""
    path = robot_file(file)
    tree = ET.parse(path)
    for link in tree.getroot().findall("link"):
        for tag in ("visual", "collision"):
            for element in link.findall(tag):
                link.remove(element)
    for joint in tree.getroot().findall("joint"):
        if joint.get("name") in lock:
            joint.set("type", "fixed")
    mujoco = ET.SubElement(tree.getroot(), "mujoco")
    ET.SubElement(mujoco, "compiler", fusestatic="false", discardvisual="false")
    bare = folder / "robot.urdf"
    tree.write(bare)
    return bare


def by_mink(python: str, case: Case, poses, starts, count: int) -> dict:
    """The same by mink, in its own Python."""
    lock = PANDA[2] if case.file == PANDA[0] else ()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data = {
            "urdf": str(bare_urdf(case.file, lock, folder)),
            "frames": case.frames,
            "joints": list(case.scene.system.joint_names),
            "poses": np.asarray(poses)[:count].tolist(),
            "starts": np.asarray(starts)[:count].tolist(),
            "atol": case.atol,
        }
        given = folder / "given.json"
        given.write_text(json.dumps(data))
        done = subprocess.run(
            [python, str(HERE / "peers" / "with_mink.py"), str(given)], capture_output=True, text=True, check=False
        )
    if done.returncode:
        raise RuntimeError(f"mink failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main(argv=None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--mink", metavar="PYTHON")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    report: dict = {"machine": machine(), "count": options.count}
    for name in chosen_names(options.cases, CASES):
        case = CASES[name]()
        poses, starts = reachable(case, options.count)
        rows = {f"jaxdyn, {guesses} guesses": ours(case, poses, starts, guesses) for guesses in (1, 16, 64)}
        if options.mink and case.file:
            rows["mink"] = by_mink(options.mink, case, poses, starts, options.count)
        report[name] = rows
        print(f"{name}: {CASES[name].__doc__}")
        for row, values in rows.items():
            print(f"  {row:22}", ", ".join(f"{key} {value:.4g}" for key, value in values.items()), flush=True)
    print(write("inverse_kinematics", report))


if __name__ == "__main__":
    main()
