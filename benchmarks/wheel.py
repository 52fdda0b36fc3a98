"""The wheel, installed elsewhere and tried without the repository.

    python -m benchmarks.wheel [--keep DIR] [--python NAME] [--oldest]

Builds the wheel, installs it alone in a fresh environment, and runs there: an import, a URDF, a motion, the commands, and
requests for extras that are missing; then, with the extra `plot`, the examples of the README and of docs/start.md as they
are printed. Warnings and logged fallbacks are failures, so native kernels are in use. `--python` names another interpreter,
`--oldest` takes the lowest versions that the wheel admits. Prints the time to import jaxdyn and jax, the best of five fresh
processes each, in seconds of the processor, which do not count what else the machine does; more than LIMIT beyond jax is a
failure.
"""

import argparse
import contextlib
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LIMIT = 1.0  # s

SMOKE = """
import logging, pathlib, jax
logging.getLogger("jaxdyn").addHandler(type("Fail", (logging.Handler,), {"emit": lambda _, record: exit(record.getMessage())})())
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jaxdyn as jd

assert "site-packages" in jd.__file__, jd.__file__
model = jd.robots.iiwa()
jd.save_urdf(model, "arm.urdf")
scene = jd.load("arm.urdf")
assert scene.system.joint_names == model.joint_names
q = jnp.full(7, 0.3)
a = jd.forward_dynamics(scene.system, q, q, q)
assert abs(jd.inverse_dynamics(scene.system, q, q, a) - q).max() < 1e-10
pathlib.Path("arm.yaml").write_text("closed_loop: [[iiwa_link_7, iiwa_link_0]]\\ntype: [3d]\\n")
assert len(jd.load("arm.urdf").constraints) == 1
pathlib.Path("arm.yaml").unlink()
bar = jd.scenes.four_bar()
motion = jd.simulate(bar, *jd.scenes.four_bar.start(), jnp.linspace(0.0, 0.5, 6), outputs=("constraint_residual",))
assert motion.success and abs(motion.constraint_residual).max() < 1e-10
try:
    jd.draw(bar, motion.q[0])
except ImportError as error:
    assert "jaxdyn[plot]" in str(error), error
else:
    raise SystemExit("matplotlib is there, though the wheel does not ask for it")
for name in ("go2_description", "robot.xml"):
    try:
        pathlib.Path("robot.xml").write_text("<mujoco/>")
        jd.load(name)
    except ImportError as error:
        assert "pip install jaxdyn[" in str(error), error
print("smoke test passed with jax", jax.__version__)
"""


def seconds_to_import(python: Path, name: str, folder: Path) -> float:
    """Best of five fresh processes, s of the processor."""
    rows = []
    for _ in range(5):
        began = os.times()
        subprocess.run([python, "-I", "-c", f"import {name}"], cwd=folder, check=True)
        ended = os.times()
        rows.append(ended.children_user + ended.children_system - began.children_user - began.children_system)
    return min(rows)


def run_examples(python: Path, folder: Path) -> None:
    """Run the blocks of Python of the README and of the first page, each page in one process."""
    for page in ("README.md", "docs/start.md"):
        blocks = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
        script = folder / f"{Path(page).stem}_examples.py"
        script.write_text("\n".join(blocks), encoding="utf-8")
        subprocess.run(
            [python, "-W", "error::UserWarning", "-I", script],
            cwd=folder,
            check=True,
            env=os.environ | {"MPLBACKEND": "agg"},
        )
        print(f"{len(blocks)} examples of {page} run")


@contextlib.contextmanager
def installed(keep: Path | None, extras: str = "", interpreter: str = sys.executable, oldest: bool = False):
    """The wheel with `extras` in a fresh environment: its folder, its Python, the wheel, and the seconds that installing took.

    All of it is made in `keep` and left there, or in a temporary folder that goes at the end. With `oldest` the dependencies have
    the lowest versions that the wheel admits, which takes the package uv.
    """
    with contextlib.ExitStack() as stack:
        folder = (keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
        subprocess.run([*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, ROOT], check=True)
        wheel = max(folder.glob("jaxdyn-*.whl"), key=os.path.getmtime)
        subprocess.run([interpreter, "-m", "venv", folder / "env"], check=True)
        python = folder / "env" / ("Scripts" if os.name == "nt" else "bin") / "python"
        began = time.perf_counter()
        install(python, wheel, extras, oldest)
        yield folder, python, wheel, time.perf_counter() - began


def install(python: Path, wheel: Path, extras: str, oldest: bool) -> None:
    """Install the wheel by pip, or by uv with the lowest versions of all that it asks for, which pip cannot find."""
    if oldest:
        uv = ["uv", "pip", "install", "--quiet", "--python", python]
        chosen = [x for name in re.findall(r"\w+", extras) for x in ("--extra", name)]
        subprocess.run([*uv, "--resolution", "lowest-direct", "-r", ROOT / "pyproject.toml", *chosen], check=True)
        subprocess.run([*uv, "--no-deps", wheel], check=True)
    else:
        pip = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, f"{wheel}{extras}"], check=True)


def main(argv=None) -> int:
    """Build, install, try; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keep", type=Path, help="make wheel and environment here and leave them")
    parser.add_argument("--python", default=sys.executable, help="the interpreter of the fresh environment")
    parser.add_argument(
        "--oldest", action="store_true", help="with the lowest versions that the wheel admits (needs uv)"
    )
    options = parser.parse_args(argv)
    with installed(options.keep, "", options.python, options.oldest) as (folder, python, wheel, seconds):
        print(f"built {wheel.name}, {wheel.stat().st_size / 1e3:.0f} kB; installed in {seconds:.0f} s")
        subprocess.run([python, "-I", "-c", SMOKE], cwd=folder, check=True)
        subprocess.run(
            [python, "-I", "-m", "jaxdyn", "info", "arm.urdf"], cwd=folder, check=True, stdout=subprocess.DEVNULL
        )
        demo = subprocess.run([python, "-I", "-m", "jaxdyn.demo"], cwd=folder, capture_output=True, text=True)
        if demo.returncode != 2 or "pip install jaxdyn[plot]" not in demo.stderr:
            print(f"the demo without matplotlib: status {demo.returncode}, {demo.stderr[-300:]}")
            return 1
        jax, ours = (seconds_to_import(python, name, folder) for name in ("jax", "jaxdyn"))
        print(
            f"import jax: {jax:.2f} s, import jaxdyn: {ours:.2f} s, beyond jax {ours - jax:.2f} s (at most {LIMIT:g} s)"
        )
        install(python, wheel, "[plot]", options.oldest)
        run_examples(python, folder)
        return int(ours - jax > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
