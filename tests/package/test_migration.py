"""The tables of the page for those who come from other libraries: both sides of each row give the same numbers."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pages import ROOT

import jaxdyn as jd

PAGE = (ROOT / "docs" / "migration.md").read_text()

ARM = """<mujoco><option gravity="0 0 -9.81"/><worldbody>
  <body name="upper" pos="0 0 0.3"><joint name="a" axis="0 1 0"/><inertial pos="0 0 .2" mass="2" diaginertia=".03 .02 .01"/>
    <body name="lower" pos="0.1 0 0.4" euler="10 20 30"><joint name="b" axis="1 0 0"/>
      <inertial pos="0 .1 .2" mass="1.5" fullinertia=".02 .03 .025 .001 .002 .003"/>
      <body name="hand" pos="0 0.05 0.35"><joint name="c" axis="0 0 1"/>
        <inertial pos=".05 0 .1" mass=".7" diaginertia=".01 .02 .01"/>
</body></body></body></worldbody></mujoco>"""


def rows(section: str) -> list[tuple[str, str]]:
    """The two calls of each row of a section's table."""
    text = re.split(r"\n## ", PAGE.partition(f"## {section}\n")[2])[0]
    matches = re.findall(r"^\| `([^`]+)` \| `([^`]+)` \|$", text, flags=re.MULTILINE)
    assert len(matches) == len(re.findall(r"^\|", text, flags=re.MULTILINE)) - 2, "a row that is not read"
    return matches


def agree(section: str, theirs: dict, ours: dict, rtol: float) -> None:
    """Both sides of every row, each with its own names; MuJoCo's arrays are copied before the next call writes them."""
    ours |= {"jd": jd, "jax": jax, "jnp": jnp}
    for left, right in rows(section):
        a, b = np.array(eval(left, dict(theirs)), float), np.array(eval(right, dict(ours)), float)
        np.testing.assert_allclose(b, a, rtol=rtol, atol=rtol * max(1.0, np.abs(a[np.isfinite(a)]).max()), err_msg=left)


@pytest.mark.slow
def test_calls_of_pinocchio(robots_dir):
    path = str(robots_dir / "ur_description" / "urdf" / "ur5_robot.urdf")
    model, robot = pin.buildModelFromUrdf(path), jd.load_model(path)
    q, v, a, tau, u = np.random.default_rng(0).normal(size=(5, robot.nv)) * 0.5
    tip = model.frames[model.nframes - 1].name
    names = {"model": model, "data": model.createData(), "pin": pin, "W": pin.LOCAL_WORLD_ALIGNED}
    names |= {"fid": model.getFrameId(tip), "name": robot.joint_names[2]}
    values = {"q": q, "v": v, "a": a, "tau": tau, "u": u}
    ours = {name: jnp.asarray(x) for name, x in values.items()}
    agree("Pinocchio", names | values, ours | {"robot": robot, "tip": tip, "name": robot.joint_names[2]}, 1e-9)


def of_mujoco(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed")
    (tmp_path / "arm.xml").write_text(ARM)
    m = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    d = mujoco.MjData(m)
    robot = jd.load(tmp_path / "arm.xml").system
    q, v = np.array([0.3, -0.5, 0.8]), np.array([0.4, 0.2, -0.6])
    d.qpos[:], d.qvel[:] = q, v
    mujoco.mj_forward(m, d)
    names = {"m": m, "d": d, "mujoco": mujoco, "full": np.zeros((3, 3)), "jac": np.zeros((6, 3)), "tip": "hand"}
    names |= {"body": m.body("hand").id, "name": "b"}
    return names, {"q": jnp.asarray(q), "v": jnp.asarray(v), "robot": robot, "tip": "hand", "name": "b"}


def test_calls_of_mujoco(tmp_path):
    agree("MuJoCo", *of_mujoco(tmp_path), 1e-9)


@pytest.mark.slow
def test_calls_of_mjx(tmp_path):
    mjx = pytest.importorskip("mujoco.mjx", reason="mujoco-mjx is not installed")
    names, ours = of_mujoco(tmp_path)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        mx, dx = mjx.put_model(names["m"]), mjx.put_data(names["m"], names["d"])
        agree("MJX", names | {"mjx": mjx, "mx": mx, "dx": mjx.forward(mx, dx)}, ours, 1e-6)
