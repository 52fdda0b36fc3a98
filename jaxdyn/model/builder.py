"""Construction of mechanisms in code.

`ModelBuilder` collects bodies and joints; `build` merges fixed bodies, sorts the tree and returns a `Model`.
All arithmetic of a build is float64 on known numbers; the result is stored in jax's default dtype. Numbers may be traced: the
structure (names, kinds of joints, which arguments are None) is known all the same.
"""

import dataclasses
import difflib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.model import host_math
from jaxdyn.model.arguments import DType, Number, Numbers, check_name, store_leaf
from jaxdyn.model.topology import KINDS, SCREW_KINDS
from jaxdyn.model.tree import Model, Topology, check_rounding, warn_unphysical_inertias

GRAVITY = (0.0, 0.0, -9.81)
_JOINT_LEAVES = {"armature": "nv", "damping": "nv", "friction": "nv"}
_LIMITS = {
    "lower": ("nq", -np.inf),
    "upper": ("nq", np.inf),
    "velocity_limit": ("nv", np.inf),
    "effort_limit": ("nv", np.inf),
}


@dataclasses.dataclass(frozen=True)
class _Body:
    name: str
    parent: str | None
    kind: str
    joint_name: str
    pose: host_math.Values
    screw: host_math.Values
    inertia: host_math.Values
    leaves: dict[str, host_math.Values | None]


class ModelBuilder:
    """Collector of bodies, joints and frames that builds a `Model` from them.

    **Arguments:**

    - `name`: name of the mechanism.
    - `gravity`: gravitational acceleration (3,) in world axes, m/s^2; with None no gravity terms are compiled.
    - `dtype`: floating-point type of the leaves; jax's default when None.
    - `rounding`: size of the rounding of poses and axes (m or rad); 0 for exact ones, 5e-5 for an angle written as 1.5708.

    Every number of `add_body`, `add_frame`, `add_coupling` and of the gravity may be traced, so that `jax.grad` and `jax.vmap`
    differentiate and batch the construction. Names, kinds, and which numbers are given are structure and stay known. Faults that
    only values show are not refused in traced numbers: a zero axis or a singular mass matrix then shows in results (NaN, or
    a result code of `simulate`), and unphysical inertias give no warning.

    **Raises:** ValueError for a gravity that is not three finite numbers, and for float64 while jax runs in 32 bits.

    ```python
    def period(length):  # of a small swing
        builder = ModelBuilder("pendulum")
        builder.add_body("bob", joint="revolute", axis=(0, 1, 0), inertia=(1.0, (0, 0, -length), (0, 0, 0)))
        model = builder.build()
        stiffness = jax.jacfwd(lambda q: jd.gravity_force(model, q))(jnp.zeros(1))[0, 0]
        return 2 * jnp.pi * jnp.sqrt(jd.mass_matrix(model, jnp.zeros(1))[0, 0] / stiffness)

    jax.vmap(jax.grad(period))(jnp.array([0.5, 1.0, 2.0]))
    ```
    """

    def __init__(
        self,
        name: str = "mechanism",
        *,
        gravity: Numbers | None = GRAVITY,
        dtype: DType | None = None,
        rounding: float = 0.0,
    ):
        self._name = check_name(name, "name")
        self._rounding = check_rounding(rounding)
        three = {(3,): "three numbers (3,) or None"}
        self._gravity = None if gravity is None else host_math.numbers(gravity, three, "gravity")
        self._dtype = _float_dtype(dtype)
        self._bodies: dict[str, _Body] = {}
        self._joints: dict[str, str] = {}  # joint name -> body name
        self._frames: dict[str, tuple[str | None, host_math.Values]] = {}
        self._couplings: dict[str, tuple[str, host_math.Values]] = {}
        self.places: dict[str, str] = {}  # file:line of bodies that come from a file, for messages

    def add_body(
        self,
        name: str,
        parent: str | None = None,
        joint: str = "revolute",
        inertia: Numbers | None = None,
        *,
        joint_name: str | None = None,
        pose: Numbers | None = None,
        axis: Numbers = (0.0, 0.0, 1.0),
        pitch: Number = 0.0,
        screw: Numbers | None = None,
        armature: Numbers | None = None,
        damping: Numbers | None = None,
        friction: Numbers | None = None,
        lower: Numbers | None = None,
        upper: Numbers | None = None,
        velocity_limit: Numbers | None = None,
        effort_limit: Numbers | None = None,
    ) -> "ModelBuilder":
        """Add a body and the joint that carries it. Return the builder.

        **Arguments:**

        - `name`: of the body, and of its frame.
        - `parent`: name of a body added before, or None for the world.
        - `joint`: revolute, continuous, prismatic, helical, planar, spherical, free or fixed. A fixed body is merged
          into the one that carries it; its frame stays reachable by name. Inertia fixed to the world has no effect.
        - `inertia`: None (massless), the ten numbers (10,) about the body frame's origin, or (mass, centre of mass
          (3,), rotational inertia (3, 3) or principal moments (3,) about it); kg, m, kg m^2, in the body frame.
        - `joint_name`: `name` + "_joint" when None. Siblings are sorted by it. For a fixed body it names the frame too.
        - `pose`: of the body frame in the parent's at the joint's zero: None (identity), (4, 4), (3,) or (xyz, rpy).
        - `axis`: direction (3,) of a revolute, continuous, prismatic or helical joint in the body frame, of any
          length but zero. A planar joint moves in the x-y plane of its body frame at home.
        - `pitch`: of a helical joint, m per rad.
        - `screw`: twist (v, omega) (6,) of a one-degree-of-freedom joint in the body frame, instead of axis and
          pitch; it is scaled to |omega| = 1 (|v| = 1 for prismatic). Any screw is helical; the axis of a revolute or
          continuous joint passes through the body's origin.
        - `armature`, `damping`, `friction`: rotor inertia, viscous and Coulomb friction of the joint, a number or
          (nv,). When no joint of the model has one, the model's leaf is None.
        - `lower`, `upper`: position limits, a number or (nq,); `velocity_limit`, `effort_limit`: a number or (nv,).
          Infinite when None.

        **Raises:** ValueError that names the body and what is wrong with it.
        """
        what = f"body {name!r}"
        self._check_new(name, parent)
        # Fixed joints are no kind of `KINDS`: they have no coordinates and are merged away.
        if joint not in KINDS and joint != "fixed":
            raise ValueError(f"{what}: joint kind {joint!r} is unknown; kinds are fixed, {', '.join(KINDS)}")
        joint_name = f"{name}_joint" if joint_name is None else joint_name
        if not isinstance(joint_name, str) or not joint_name:
            raise ValueError(f"{what}: joint_name is {joint_name!r}; give a non-empty string")
        # Siblings are sorted by joint name, so equal names would leave their order undefined.
        if joint_name in self._joints:
            raise ValueError(
                f"{what}: joint name {joint_name!r} is that of body {self._joints[joint_name]!r}; rename one"
            )
        sizes = KINDS.get(joint)
        nq, nv = (sizes.nq, sizes.nv) if sizes else (0, 0)
        given = dict(armature=armature, damping=damping, friction=friction)
        given |= dict(lower=lower, upper=upper, velocity_limit=velocity_limit, effort_limit=effort_limit)
        leaves = {}
        for key, value in given.items():
            size = nq if key in ("lower", "upper") else nv
            leaves[key] = None if value is None else _joint_numbers(value, size, joint, key, what)
        # Concrete limits only: traced ones cannot decide the structure.
        low, high = leaves["lower"], leaves["upper"]
        if low is not None and high is not None and is_concrete(low, high) and np.any(low > high):
            raise ValueError(
                f"{what}: lower limit {lower} is above upper limit {upper}; swap them, or leave both out where there is no "
                "limit, which is how other simulators read such a pair"
            )
        # Equinox takes strings of NumPy for arrays.
        name, joint, joint_name = str(name), str(joint), str(joint_name)
        body = _Body(
            name,
            None if parent is None else str(parent),
            joint,
            joint_name,
            host_math.pose_matrix(pose, f"{what}: pose"),
            _screw(joint, axis, pitch, screw, what),
            host_math.inertia_numbers(inertia, f"{what}: inertia"),
            leaves,
        )
        self._bodies[name] = body
        self._joints[joint_name] = name
        return self

    def add_frame(self, name: str, parent: str | None = None, pose: Numbers | None = None) -> "ModelBuilder":
        """Add a named frame at `pose` (as in `add_body`) in the frame of the body `parent`, None for the world.

        Returns the builder. **Raises:** ValueError for a name in use, an unknown parent or a bad pose.
        """
        self._check_new(name, parent)
        self._frames[name] = (parent, host_math.pose_matrix(pose, f"frame {name!r}: pose"))
        return self

    def add_coupling(self, joint: str, source: str, multiplier: Number = 1.0, offset: Number = 0.0) -> "ModelBuilder":
        r"""Record a coupling of two one-degree-of-freedom joints (a gear, a mimic).

        $$q_\mathrm{joint} = \mathrm{multiplier} \cdot q_\mathrm{source} + \mathrm{offset}$$

        The joint stays free in the model; a scene takes the coupling as a constraint. Returns the builder.

        **Raises:** ValueError for an unknown joint or one of several degrees of freedom, a joint coupled twice or to
        itself (also through others), or numbers that are not finite.
        """
        what = f"coupling of {joint!r} to {source!r}"
        for name in (joint, source):
            if name not in self._joints:
                raise ValueError(f"{what}: {unknown('joint', name, self._joints)}")
            if (kind := self._bodies[self._joints[name]].kind) not in SCREW_KINDS:
                raise ValueError(f"{what}: joint {name!r} is {kind}; couple joints of one degree of freedom")
        if joint in self._couplings:
            raise ValueError(f"{what}: it follows {self._couplings[joint][0]!r} already; leave one coupling out")
        # Follow the chain of sources: a cycle of couplings has no configuration in general.
        followed = source
        while followed is not None:
            if followed == joint:
                raise ValueError(f"{what}: the joint would follow itself; leave one coupling out")
            followed = self._couplings[followed][0] if followed in self._couplings else None
        values = host_math.numbers([multiplier, offset], {(2,): "two numbers"}, f"{what}: (multiplier, offset)")
        self._couplings[joint] = (source, values)
        return self

    def build(self) -> Model:
        """Build the model: depth-first order with siblings sorted by joint name, fixed bodies merged.

        Frames are the bodies in their order, then all others sorted by the body that carries them and by name.

        **Raises:** ValueError that names a joint which moves no inertia, so that the mass matrix is singular in every
        configuration: $S^T I S = 0$ with the composite or the articulated inertia I of the bodies that it carries.

        **Warns:** UserWarning naming bodies with an unphysical inertia: a negative principal moment, or one that exceeds
        the sum of the other two (`repair_inertias`).
        """
        warn_unphysical_inertias({name: body.inertia for name, body in self._bodies.items()}, self.places)
        moving, carriers, parents, home, inertias = self._weld_bodies()
        others = [(carriers[b][0], name, _compose(carriers[b][1], pose)) for name, (b, pose) in self._frames.items()]
        fixed = [name for name, body in self._bodies.items() if body.kind == "fixed"]
        others += [(carriers[name][0], name, carriers[name][1]) for name in fixed]
        # Sorted, so that the order in which a file lists its frames does not decide which program is compiled.
        others.sort(key=lambda frame: frame[:2])
        index = {body.joint_name: i for i, body in enumerate(moving)}
        couplings = {(index[joint], index[c[0]]): c[1] for joint, c in self._couplings.items()}
        topology = Topology(
            name=self._name,
            parents=tuple(parents),
            kinds=tuple(body.kind for body in moving),
            body_names=tuple(body.name for body in moving),
            joint_names=tuple(body.joint_name for body in moving),
            frame_names=tuple(body.name for body in moving) + tuple(name for _, name, _ in others),
            frame_bodies=tuple(range(len(moving))) + tuple(body for body, _, _ in others),
            couplings=tuple(sorted(couplings)),
        )
        screws = _rows([body.screw for body in moving], (6,))
        leaves = {key: _joint_leaf(moving, key, size, 0.0) for key, size in _JOINT_LEAVES.items()}
        # Before the limits are added: they do not matter for regularity, and the check reads few arrays.
        host_math.check_regular(topology, home, screws, inertias, leaves["armature"])
        leaves |= {key: _joint_leaf(moving, key, size, fill, always=True) for key, (size, fill) in _LIMITS.items()}
        leaves |= dict(home=home, screws=screws, inertias=inertias, gravity=self._gravity)
        # The frame of each body comes first, at the body's own origin, so that frame i is body i for i < nb.
        leaves["frame_poses"] = _rows([np.eye(4)] * len(moving) + [pose for *_, pose in others], (4, 4))
        values = [couplings[pair] for pair in topology.couplings]
        leaves["coupling_values"] = _rows(values, (2,)) if couplings else None
        kept: dict[str, Any] = {
            key: None if value is None else store_leaf(value, self._dtype) for key, value in leaves.items()
        }
        # Sorted, as static fields are compared: another order of a file must not compile another program.
        fixed_joints = tuple((self._bodies[name].joint_name, name) for name in sorted(fixed))
        return Model(**kept, topology=topology, fixed_joints=fixed_joints, rounding=self._rounding)

    def _check_new(self, name, parent) -> None:
        if not isinstance(name, str) or not name:
            raise ValueError(f"name is {name!r}; give a non-empty string")
        if name in self._bodies or name in self._frames:
            raise ValueError(f"the name {name!r} is taken by another body or frame; rename one")
        if parent is not None and parent not in self._bodies:
            raise ValueError(f"{name!r}: {unknown('parent', parent, self._bodies)}; add a parent before its children")

    def _weld_bodies(self):
        """Merge fixed bodies: the moving ones in order, (index, pose) of each body's carrier, parents, homes, inertias."""
        children: dict[str | None, list[_Body]] = {}
        # In reverse, because the stack below pops the last child first; this is Pinocchio's depth-first order.
        for body in sorted(self._bodies.values(), key=lambda body: body.joint_name, reverse=True):
            children.setdefault(body.parent, []).append(body)
        moving, parents, home, inertias = [], [], [], []
        carriers: dict[str | None, tuple[int, host_math.Values]] = {None: (-1, np.eye(4))}
        stack = list(children.get(None, ()))
        while stack:
            body = stack.pop()
            stack.extend(children.get(body.name, ()))
            carrier, pose = carriers[body.parent]
            pose = _compose(pose, body.pose)
            if body.kind != "fixed":
                parents.append(carrier)
                home.append(pose)
                inertias.append(body.inertia)
                carriers[body.name] = (len(moving), np.eye(4))
                moving.append(body)
                continue
            # Poses of fixed chains accumulate, and later children attach to the moving carrier.
            carriers[body.name] = (carrier, pose)
            # Inertia that is fixed to the world never moves and has no place in the model.
            if carrier >= 0:
                inertias[carrier] = _sum(inertias[carrier], host_math.move_inertia(pose, body.inertia))
        return moving, carriers, parents, _rows(home, (4, 4)), _rows(inertias, (10,))


# One operand may be traced and the other known, in float64: each sum and product takes the module that both need.


def _compose(first: host_math.Values, second: host_math.Values) -> host_math.Values:
    xp = array_namespace(first, second)
    return xp.asarray(first, float) @ xp.asarray(second, float)


def _sum(one: host_math.Values, other: host_math.Values) -> host_math.Values:
    xp = array_namespace(one, other)
    return xp.asarray(one, float) + xp.asarray(other, float)


def _rows(values, shape: tuple[int, ...]) -> host_math.Values:
    """Stack arrays of one shape as rows; without any, an empty array of that shape."""
    return array_namespace(values).asarray(values, float).reshape(-1, *shape)


def _float_dtype(dtype):
    default = jnp.dtype(jax.dtypes.canonicalize_dtype(float))
    if dtype is None:
        return default
    try:
        is_floating = jnp.issubdtype(dtype, jnp.floating)
    except TypeError:
        is_floating = False
    if not is_floating:
        raise ValueError(f"dtype is {dtype!r}; give a floating-point type such as jax.numpy.float32")
    # jax would truncate to float32 without an error, and every later comparison would fail by 1e-7.
    if jax.dtypes.canonicalize_dtype(dtype) != jnp.dtype(dtype):
        name = jnp.dtype(dtype).name
        raise ValueError(
            f"dtype is {name}, but jax runs in 32 bits; call jax.config.update('jax_enable_x64', True) first"
        )
    return jnp.dtype(dtype)


def unknown(role: str, name, known) -> str:
    """Sentence on a name that is not among the known ones, with those nearest to it."""
    near = difflib.get_close_matches(str(name), [str(k) for k in known], n=3, cutoff=0.4)
    return f"{role} {name!r} is unknown" + (f" (did you mean {', '.join(near)}?)" if near else "")


def _joint_numbers(value, size: int, kind: str, key: str, what: str) -> host_math.Values:
    if size == 0:
        raise ValueError(f"{what}: {key} is {value!r}, but the joint is fixed; leave it out")
    limit = key in _LIMITS
    if kind == "continuous" and key in ("lower", "upper"):
        raise ValueError(f"{what}: {key} is {value!r}, but a continuous joint has no position limits; use revolute")
    shapes = {(size,): f"({size},)"}
    # One number cannot bound metres, radians and quaternion entries at once.
    if size == 1 or key not in ("lower", "upper"):
        shapes = {(): "a number", **shapes}
    array = host_math.numbers(value, shapes, f"{what}: {key}", finite=not limit)
    if not limit and is_concrete(array) and np.any(array < 0):
        raise ValueError(f"{what}: {key} is {value!r}; it must not be negative")
    return array_namespace(array).broadcast_to(array, (size,))


def _screw(kind: str, axis, pitch, screw, what: str) -> host_math.Values:
    axis = host_math.numbers(axis, {(3,): "(3,)"}, f"{what}: axis")
    pitch = host_math.numbers(pitch, {(): "a number"}, f"{what}: pitch")
    # A traced axis counts as given: its value cannot be compared with the default.
    turned = not is_concrete(axis) or not np.array_equal(axis, [0, 0, 1])
    pitched = not is_concrete(pitch) or bool(pitch)
    xp = array_namespace(axis, pitch, screw)
    if kind not in SCREW_KINDS:
        if turned or pitched or screw is not None:
            raise ValueError(f"{what}: a {kind} joint has no axis, pitch or screw; turn its pose instead")
        return np.zeros(6)
    if pitched and kind != "helical":
        raise ValueError(f"{what}: pitch is {pitch}, but the joint is {kind}; use joint='helical'")
    if screw is None:
        # An axis of any length is a direction; v = pitch * axis places the screw through the body's origin.
        axis = host_math.unit(axis, f"{what}: axis")
        axis = xp.asarray(axis, float)
        return xp.concatenate([axis, xp.zeros(3)] if kind == "prismatic" else [xp.asarray(pitch, float) * axis, axis])
    if turned or pitched:
        raise ValueError(f"{what}: screw is given together with axis or pitch; give one of them")
    screw = host_math.numbers(screw, {(6,): "(v, omega) (6,)"}, f"{what}: screw")
    v, omega = screw[:3], screw[3:]
    # The kind cannot be checked against traced numbers; any screw with rotation is helical, so that kind alone is safe.
    if not is_concrete(screw):
        if kind != "helical":
            raise ValueError(
                f"{what}: screw is traced, and only its values say whether it is that of a {kind} joint; give axis=, or use "
                "joint='helical', which takes any screw that turns"
            )
        return screw / jnp.sqrt(jnp.sum(omega * omega))
    size = np.linalg.norm(v if kind == "prismatic" else omega)
    if size == 0:
        part = "v" if kind == "prismatic" else "omega"
        raise ValueError(f"{what}: screw is {screw.tolist()}; a {kind} joint needs {part} other than zero")
    if kind == "prismatic" and omega.any():
        raise ValueError(f"{what}: screw {screw.tolist()} turns, but the joint is prismatic; use joint='helical'")
    # v along omega is a pitch, v across it an axis that misses the origin: both need the helical code path.
    if kind in ("revolute", "continuous") and v.any():
        raise ValueError(
            f"{what}: screw {screw.tolist()} has a pitch or passes beside the body's origin; use joint='helical', "
            f"which takes any screw"
        )
    return screw / size


def _joint_leaf(moving: list[_Body], key: str, size: str, fill: float, *, always: bool = False):
    values = [body.leaves[key] for body in moving]
    if not always and all(value is None for value in values):
        return None
    sizes = [getattr(KINDS[body.kind], size) for body in moving]
    xp = array_namespace(values)
    parts = [xp.full(n, fill) if value is None else xp.asarray(value) for value, n in zip(values, sizes, strict=True)]
    return xp.concatenate(parts) if parts else np.zeros(0)
