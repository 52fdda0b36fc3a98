"""Translation between jaxdyn models and Pinocchio models, and random trees: shared by the tests.

`to_jaxdyn` and `to_pinocchio` return `(model, Bridge)`; the bridge converts configurations both ways. Velocities agree
without conversion. Gravity None on our side is zero gravity on Pinocchio's.
"""

import dataclasses
import os

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation
from xla_options import QUICK

import jaxdyn as jd
from jaxdyn.model.topology import KINDS, SCREW_KINDS

ROBOTS = os.path.join(os.path.dirname(pin.__file__), "../../../../share/example-robot-data/robots")


@dataclasses.dataclass(frozen=True)
class Bridge:
    """Kinds of the joints on our side, whether Pinocchio writes an angle as (cos, sin), and the offset (nb, 4, 4) of
    our body frame in Pinocchio's joint frame."""

    kinds: tuple[str, ...]
    circles: tuple[bool, ...]
    offsets: np.ndarray

    def q_to_pinocchio(self, q) -> np.ndarray:
        """Our configuration in Pinocchio's numbers; batch axes in front."""
        return self._convert(np.asarray(q, float), True)

    def q_from_pinocchio(self, q) -> np.ndarray:
        """Pinocchio's configuration in our numbers; batch axes in front."""
        return self._convert(np.asarray(q, float), False)

    def _convert(self, q, forth):
        parts, at = [], 0
        for kind, circle in zip(self.kinds, self.circles, strict=True):
            angle = (kind == "planar") * 2
            nq = KINDS[kind].nq + (circle and not forth)
            x = q[..., at : at + nq]
            at += nq
            if circle and forth:
                x = np.concatenate([x[..., :angle], np.cos(x[..., angle:]), np.sin(x[..., angle:])], -1)
            elif circle:
                x = np.concatenate([x[..., :angle], np.arctan2(x[..., -1:], x[..., -2:-1])], -1)
            elif kind in ("spherical", "free"):
                x = np.concatenate([x[..., :-4], np.roll(x[..., -4:], -1 if forth else 1, -1)], -1)
            parts.append(x)
        assert at == q.shape[-1]
        return np.concatenate(parts, -1)


def quick(function):
    """`jax.jit` that compiles fast and runs slowly, for tests that compare numbers of many models."""
    return jax.jit(function, compiler_options=QUICK)


def to_pinocchio(model: jd.Model) -> tuple[pin.Model, Bridge]:
    """The same mechanism in Pinocchio. Body frames and named frames are operational frames of the same names.

    Joint axes may pass beside our body frame's origin, Pinocchio's may not, so the joint frame is moved onto the axis.
    """
    topology, out = model.topology, pin.Model()
    out.name = model.name
    out.gravity.linear = np.zeros(3) if model.gravity is None else np.asarray(model.gravity)
    offsets = np.zeros((model.nb, 4, 4))
    offsets[:] = np.eye(4)
    ids = []
    for i, kind in enumerate(topology.kinds):
        v, w = np.split(np.asarray(model.screws[i], float), 2)
        if kind in ("revolute", "continuous", "helical"):
            offsets[i, :3, 3] = -np.cross(w, v)
        joint = {
            "revolute": lambda v, w: pin.JointModelRevoluteUnaligned(w),
            # Pinocchio's unbounded joints have no constructor for a skew axis; the angle is the same number.
            "continuous": lambda v, w: pin.JointModelRevoluteUnaligned(w),
            "prismatic": lambda v, w: pin.JointModelPrismaticUnaligned(v),
            "helical": lambda v, w: pin.JointModelHelicalUnaligned(w, float(w @ v)),
            "planar": lambda v, w: pin.JointModelPlanar(),
            "spherical": lambda v, w: pin.JointModelSpherical(),
            "free": lambda v, w: pin.JointModelFreeFlyer(),
        }[kind](v, w)
        parent = topology.parents[i]
        outer = np.eye(4) if parent < 0 else offsets[parent]
        placement = outer @ np.asarray(model.home[i]) @ np.linalg.inv(offsets[i])
        ids.append(out.addJoint(0 if parent < 0 else ids[parent], joint, _pin_se3(placement), topology.joint_names[i]))
        inertia = pin.Inertia.FromDynamicParameters(_feasible_enough(model.inertias[i]))
        out.appendBodyToJoint(ids[i], inertia, _pin_se3(offsets[i]))
    for name, body, pose in zip(topology.frame_names, topology.frame_bodies, model.frame_poses, strict=True):
        joint, offset = (0, np.eye(4)) if body < 0 else (ids[body], offsets[body])
        out.addFrame(pin.Frame(name, joint, 0, _pin_se3(offset @ np.asarray(pose)), pin.FrameType.OP_FRAME), False)
    if model.armature is not None:
        out.armature = np.asarray(model.armature, float)
    circles = tuple(kind == "planar" for kind in topology.kinds)
    return out, Bridge(topology.kinds, circles, offsets)


def to_jaxdyn(source: pin.Model, dtype=jnp.float64) -> tuple[jd.Model, Bridge]:
    """The same mechanism in jaxdyn, with Pinocchio's joint frames as body frames and all of its frames by name.

    Raises ValueError for joints that have no kind on our side.
    """
    kinds, screws, circles = [], [], []
    for joint in source.joints[1:]:
        kind, circle, axis = _kind(joint)
        kinds.append(kind)
        circles.append(circle)
        screws.append(axis)
    nb = len(kinds)
    body_names = tuple(source.names)[1:]
    frames = [("body " + name, i, np.eye(4)) for i, name in enumerate(body_names)]
    for frame in source.frames[1:]:
        frames.append((frame.name, frame.parentJoint - 1, frame.placement.homogeneous))
    unique = {name: (body, pose) for name, body, pose in frames}
    topology = jd.model.Topology(
        name=source.name,
        parents=tuple(int(source.parents[i + 1]) - 1 for i in range(nb)),
        kinds=tuple(kinds),
        body_names=body_names,
        joint_names=body_names,
        frame_names=tuple(unique),
        frame_bodies=tuple(int(body) for body, _ in unique.values()),
    )
    armature = np.asarray(source.armature, float)
    leaves = {
        "home": np.stack([p.homogeneous for p in source.jointPlacements[1:]]),
        "screws": np.stack(screws),
        "inertias": np.stack([i.toDynamicParameters() for i in source.inertias[1:]]),
        "frame_poses": np.stack([pose for _, pose in unique.values()]),
        "gravity": np.asarray(source.gravity.linear),
        "armature": armature if armature.any() else None,
    }
    return _model(topology, leaves, dtype), Bridge(tuple(kinds), tuple(circles), np.tile(np.eye(4), (nb, 1, 1)))


def load_robot(path: str, *, floating=False, lock=()) -> tuple[pin.Model, jd.Model, Bridge]:
    """A robot of example-robot-data by its path below the folder of robots; `lock` names joints to fix at neutral."""
    file = os.path.join(ROBOTS, path)
    source = pin.buildModelFromUrdf(file, pin.JointModelFreeFlyer()) if floating else pin.buildModelFromUrdf(file)
    if lock:
        ids = [i for i, name in enumerate(source.names) if any(part in name for part in lock)]
        source = pin.buildReducedModel(source, ids, pin.neutral(source))
    return (source, *to_jaxdyn(source))


def random_tree(seed: int, kinds, *, parents=None, armature=True, dtype=jnp.float64) -> jd.Model:
    """A random tree with the given joint kinds: skew placements and axes, tapering physical inertias.

    Parents are drawn so that every subtree is listed without gaps, or given. Each body carries one extra frame.
    """
    rng = np.random.default_rng(seed)
    n = len(kinds)
    if parents is None:
        parents = [-1]
        for i in range(1, n):
            # Any body on the path from the last body to its root keeps the order depth-first.
            path = [i - 1]
            while parents[path[-1]] >= 0:
                path.append(parents[path[-1]])
            parents.append(path[int(rng.integers(0, min(len(path), 3)))])
    poses = [_random_pose(rng, 0.4) for _ in range(2 * n)]
    screws = np.zeros((n, 6))
    for i, kind in enumerate(kinds):
        axis = _unit(rng.normal(size=3))
        if kind == "prismatic":
            screws[i, :3] = axis
        elif kind == "helical":
            screws[i] = np.concatenate([np.cross(rng.normal(size=3) * 0.1, axis) + 0.2 * axis, axis])
        elif kind in SCREW_KINDS:
            screws[i, 3:] = axis
    inertias = np.stack([random_inertia(rng) * 0.8 ** (i % 8) for i in range(n)])
    names = tuple(f"b{i}" for i in range(n))
    topology = jd.model.Topology(
        name=f"tree{seed}",
        parents=tuple(parents),
        kinds=tuple(kinds),
        body_names=names,
        joint_names=tuple(f"j{i}" for i in range(n)),
        frame_names=names + tuple(f"f{i}" for i in range(n)),
        frame_bodies=tuple(range(n)) * 2,
    )
    leaves = {
        "home": np.stack(poses[:n]),
        "screws": screws,
        "inertias": inertias,
        "frame_poses": np.concatenate([np.tile(np.eye(4), (n, 1, 1)), np.stack(poses[n:])]),
        "gravity": np.array([0.3, -0.4, -9.81]),
        "armature": rng.uniform(0.01, 0.1, topology.nv) if armature else None,
    }
    return _model(topology, leaves, dtype)


def make_model(parents, home, screws, inertias, *, kinds=None, gravity=(0.0, 0.0, -9.81), armature=None) -> jd.Model:
    """A model from its numbers; joints are revolute unless `kinds` says otherwise. Frames are the bodies' alone."""
    n = len(parents)
    names = tuple(f"b{i}" for i in range(n))
    topology = jd.model.Topology(
        name="made",
        parents=tuple(parents),
        kinds=tuple(kinds or ("revolute",) * n),
        body_names=names,
        joint_names=tuple(f"j{i}" for i in range(n)),
        frame_names=names,
        frame_bodies=tuple(range(n)),
    )
    leaves = {
        "home": np.asarray(home),
        "screws": np.asarray(screws),
        "inertias": np.asarray(inertias),
        "frame_poses": np.tile(np.eye(4), (n, 1, 1)),
        "gravity": gravity,
        "armature": armature,
    }
    return _model(topology, leaves, jnp.float64)


def random_states(model: jd.Model, n: int, seed: int):
    """Batches of q (n, nq), v, a, tau (n, nv) and external wrenches (n, nb, 6)."""
    rng = np.random.default_rng(seed)
    dtype = model.home.dtype
    parts = [np.zeros((n, 0))]
    for kind in model.topology.kinds:
        x = rng.normal(size=(n, KINDS[kind].nq))
        if kind in ("spherical", "free"):
            x[:, -4:] /= np.linalg.norm(x[:, -4:], axis=1, keepdims=True)
        parts.append(x)
    v, a, tau = rng.normal(size=(3, n, model.nv))
    wrenches = rng.normal(size=(n, model.nb, 6))
    return tuple(jnp.asarray(x, dtype) for x in (np.concatenate(parts, 1), v, a, tau, wrenches))


def random_inertia(rng) -> np.ndarray:
    """Ten numbers of a random physical body of a few kg, its mass beside the origin."""
    points, weights = rng.normal(size=(8, 3)) * 0.15 + rng.normal(size=3) * 0.1, rng.uniform(0.1, 1, 8)
    second = np.einsum("p,pi,pj->ij", weights, points, points)
    inertia = np.trace(second) * np.eye(3) - second
    return np.concatenate([[weights.sum()], weights @ points, inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def assert_close(got, want, tol=1e-10, label=""):
    """Largest error at most `tol` times the largest number of the expected array (or of 1e-3, where it is all zero)."""
    got, want = np.asarray(got, float), np.asarray(want, float)
    assert got.shape == want.shape, (label, got.shape, want.shape)
    assert np.isfinite(got).all(), label
    error, size = np.abs(got - want).max(initial=0.0), max(np.abs(want).max(initial=0.0), 1e-3)
    assert error <= tol * size, f"{label}: error {error:.3e}, size {size:.3e}"


def placed(rotation, position) -> np.ndarray:
    """Pose (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def adjoint(pose) -> np.ndarray:
    """Ad of a pose (4, 4), linear part first, by NumPy alone."""
    R, (x, y, z) = pose[:3, :3], pose[:3, 3]
    hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.block([[R, hat @ R], [np.zeros((3, 3)), R]])


def as_dtype(model: jd.Model, dtype) -> jd.Model:
    """The same model with every leaf in another dtype."""
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x).astype(dtype)), model)


def _model(topology: jd.model.Topology, leaves: dict, dtype) -> jd.Model:
    leaves = {name: None if x is None else jnp.asarray(x, dtype) for name, x in leaves.items()}
    # By numpy, as all of this: XLA would compile a program for every size.
    limits = {name: jnp.asarray(np.full(topology.nv, np.inf), dtype) for name in ("velocity_limit", "effort_limit")}
    for name, bound in (("lower", -np.inf), ("upper", np.inf)):
        limits[name] = jnp.asarray(np.full(topology.nq, bound), dtype)
    return jd.Model(**leaves, **limits, damping=None, friction=None, topology=topology)


def _kind(joint) -> tuple[str, bool, np.ndarray]:
    name = joint.shortname().removeprefix("JointModel")
    if name == "FreeFlyer":
        return "free", False, np.zeros(6)
    if name == "Spherical":
        return "spherical", False, np.zeros(6)
    if name == "Planar":
        return "planar", True, np.zeros(6)
    if joint.nv != 1:
        raise ValueError(f"joint {name} has no kind in jaxdyn")
    data = joint.createData()
    joint.calc(data, np.array([1.0, 0.0]) if joint.nq == 2 else np.zeros(1))
    screw = np.asarray(data.S).reshape(6)
    if joint.nq == 2:
        return "continuous", True, screw
    if not screw[3:].any():
        return "prismatic", False, screw
    return ("helical" if screw[:3].any() else "revolute"), False, screw


def _pin_se3(pose) -> pin.SE3:
    return pin.SE3(np.ascontiguousarray(pose[:3, :3], float), np.ascontiguousarray(pose[:3, 3], float))


def _feasible_enough(parameters) -> np.ndarray:
    # Pinocchio divides by the mass; a body without one must have none of the other numbers either.
    parameters = np.asarray(parameters, float)
    if parameters[0] == 0 and parameters.any():
        raise ValueError("a body without mass but with moments cannot be written in Pinocchio")
    return parameters


def _unit(x) -> np.ndarray:
    return x / np.linalg.norm(x)


def _random_pose(rng, reach) -> np.ndarray:
    return placed(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.normal(size=3) * reach)


def _paths():
    paths = {}
    for folder, _, files in sorted(os.walk(ROBOTS)):
        for file in sorted(files):
            if file.endswith(".urdf"):
                paths.setdefault(file, os.path.join(folder, file))
    return paths


ROBOT_FILES = _paths()


def load_both(file, floating):
    """The robot on both sides, and the conversion of configurations."""
    source = pin.buildModelFromUrdf(ROBOT_FILES[file], *([pin.JointModelFreeFlyer()] if floating else []))
    model = jd.load_model(ROBOT_FILES[file], floating_base=floating)
    extra = [
        joint.nq - (part.stop - part.start)
        for joint, part in zip(list(source.joints)[1:], model.topology.q_slices, strict=True)
    ]
    return model, source, Bridge(model.topology.kinds, tuple(x == 1 for x in extra), np.zeros(0))
