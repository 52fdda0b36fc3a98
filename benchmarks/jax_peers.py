"""The JAX libraries that the dynamics are timed against, where they are installed: forward dynamics of one sample of a robot.

The robot is written as a URDF and read by the peer, so all compute the same; `checked` compares accelerations first.
"""

import re
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd

_UNIT = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def forward_dynamics(model) -> dict[str, Callable]:
    """`f(q, v, tau) -> a` by name of each installed peer that can read the model; none for a floating base."""
    if any(kind not in ("revolute", "prismatic") for kind in model.topology.kinds):
        return {}
    computed = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        jd.save_urdf(model, path)
        for name, load in (("frax", _frax), ("MJX", _mjx)):
            try:
                computed[name] = load(path)
            except ImportError:
                print(f"{name} is not installed")
    return computed


def _frax(path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it asks for environment variables; all run with the defaults here
        import frax

        # It wants an inertia of the fixed base too, which moves nothing.
        text = re.sub(r'<link name="([^"]*)"\s*/>', rf'<link name="\1">{_UNIT}</link>', path.read_text(), count=1)
        path = path.with_name("frax.urdf")
        path.write_text(text)
        robot = frax.Robot(str(path))
    return lambda q, v, tau: robot.forward_dynamics(q, v, tau, None)


def _mjx(path):
    import mujoco
    from mujoco import mjx

    source = mujoco.MjModel.from_xml_path(str(path))
    # Joint limits are constraints there; the others have none.
    source.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    # Damping and friction of the file are no part of forward dynamics here.
    source.dof_damping[:], source.dof_frictionloss[:] = 0.0, 0.0
    model = mjx.put_model(source)
    empty = mjx.make_data(model)

    def call(q, v, tau):
        return mjx.forward(model, empty.replace(qpos=q, qvel=v, qfrc_applied=tau)).qacc

    return call


def checked(name: str, call: Callable, model, q, v, tau, *, few: int = 8) -> bool:
    """Whether a peer computes our accelerations, to what its precision allows; says by how much they differ."""
    q, v, tau = (x[:few] for x in (q, v, tau))
    want = jax.vmap(lambda *x: jd.forward_dynamics(model, *x))(q, v, tau)
    got = np.asarray(jax.jit(jax.vmap(call))(q, v, tau))
    error = float(np.abs(got - np.asarray(want)).max() / np.abs(np.asarray(want)).max())
    print(f"{name}: accelerations differ from ours by {error:.1e} of the largest")
    return error < (1e-2 if jnp.result_type(q) == jnp.float32 else 1e-6)
