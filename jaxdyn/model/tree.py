"""The mechanism: a static tree of bodies (`Topology`) and the array leaves that give it numbers (`Model`)."""

import dataclasses
import itertools
from functools import cached_property

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import is_concrete, is_expanding
from jaxdyn.model.arguments import as_array, check_shapes
from jaxdyn.model.joints import (
    KINDS,
    joint_difference,
    joint_integrate,
    joint_neutral,
    joint_random,
    joint_rate,
    screw_mask,
)
from jaxdyn.model.printed import tree_of


@dataclasses.dataclass(frozen=True, eq=False)
class Topology:
    """Everything about a mechanism that decides what is compiled: who hangs on whom, and by which kind of joint.

    Bodies are listed so that a parent comes before its children (`parents[i] < i`; -1 is the world). Body i is moved by
    joint i. Two topologies with the same tree, kinds and names are equal, so models that differ in numbers alone share
    compiled code.
    """

    name: str
    parents: tuple[int, ...]
    kinds: tuple[str, ...]
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    frame_names: tuple[str, ...]
    frame_bodies: tuple[int, ...]
    couplings: tuple[tuple[int, int], ...] = ()  # (joint, source): the joint is to follow the source

    @cached_property
    def _key(self):
        return tuple(getattr(self, field.name) for field in dataclasses.fields(self))

    @cached_property
    def _hash(self):
        return hash(self._key)

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or (isinstance(other, Topology) and self._key == other._key)

    @property
    def nb(self) -> int:
        """Number of bodies."""
        return len(self.parents)

    @cached_property
    def nq(self) -> int:
        """Number of configuration coordinates."""
        return sum(KINDS[kind].nq for kind in self.kinds)

    @cached_property
    def nv(self) -> int:
        """Number of velocity coordinates (degrees of freedom)."""
        return sum(KINDS[kind].nv for kind in self.kinds)

    @cached_property
    def q_slices(self) -> tuple[slice, ...]:
        """Where each joint's coordinates stand in q."""
        ends = np.cumsum([0] + [KINDS[kind].nq for kind in self.kinds]).tolist()
        return tuple(slice(a, b) for a, b in itertools.pairwise(ends))

    @cached_property
    def v_slices(self) -> tuple[slice, ...]:
        """Where each joint's coordinates stand in v."""
        ends = np.cumsum([0] + [KINDS[kind].nv for kind in self.kinds]).tolist()
        return tuple(slice(a, b) for a, b in itertools.pairwise(ends))

    @cached_property
    def screw_mask(self) -> np.ndarray:
        """(nb, 6) of bool: the screw entries that each joint's kind reads."""
        return np.array([screw_mask(kind) for kind in self.kinds], bool).reshape(-1, 6)

    @cached_property
    def dof_body(self) -> np.ndarray:
        """(nv,): the body that each velocity coordinate moves first."""
        return np.repeat(np.arange(self.nb), [KINDS[kind].nv for kind in self.kinds])

    @cached_property
    def ancestors(self) -> np.ndarray:
        """(nb, nb) of bool: [i, j] is true when body j is body i or an ancestor of it. The world-frame G = (I - Gamma)^-1."""
        mask = np.eye(self.nb, dtype=bool)
        for i, parent in enumerate(self.parents):
            if parent >= 0:
                mask[i] |= mask[parent]
        return mask

    @cached_property
    def dof_ancestors(self) -> np.ndarray:
        """(nb, nv) of bool: [i, j] is true when velocity coordinate j moves body i."""
        return self.ancestors[:, self.dof_body]

    @cached_property
    def depths(self) -> np.ndarray:
        """(nb,): number of joints between the world and each body, at least 1."""
        return self.ancestors.sum(1)

    @cached_property
    def roots(self) -> np.ndarray:
        """(nb,): the root body of the tree that each body belongs to."""
        return np.argmax(self.ancestors, axis=1) if self.nb else np.zeros(0, int)

    @cached_property
    def jumps(self) -> tuple[np.ndarray, ...]:
        """Pointer-jumping tables: the 2^k-th ancestor of each body (nb means the world), k = 0 .. ceil(log2(depth)) - 1."""
        jump = np.array([p if p >= 0 else self.nb for p in self.parents] + [self.nb])
        tables = []
        while self.nb and (jump[:-1] != self.nb).any():
            tables.append(jump[:-1])
            jump = jump[jump]
        return tuple(tables)


class Model(eqx.Module):
    """A tree of rigid bodies joined by screws. A pytree: the topology is static, every number is a leaf.

    Build one with `ModelBuilder` or `load_urdf`. Shapes, units and frames of the leaves:

    - `home` (nb, 4, 4): pose of each body frame in its parent body frame at the joint's zero (m).
    - `screws` (nb, 6): unit twist (v, omega) of each one-degree-of-freedom joint in its body frame; zero for other kinds.
    - `inertias` (nb, 10): (m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz) about the body frame's origin, in its axes
      (kg, kg m, kg m^2).
    - `frame_poses` (nf, 4, 4): pose of each named frame in the body that carries it (m).
    - `gravity` (3,) in world axes (m/s^2), or None: no gravity terms are compiled.
    - `armature` (nv,): rotor inertia added to the diagonal of the mass matrix (kg m^2 or kg), or None.
    - `damping`, `friction` (nv,): viscous (N m s) and Coulomb (N m) joint friction as read from a file, or None. They are
      data for scene forces; the functions of the dynamics leave them out.
    - `lower`, `upper` (nq,) position limits (infinite where there are none); `velocity_limit`, `effort_limit` (nv,).
    - `coupling_values` (nc, 2): multiplier and offset (m or rad) of each coupling q[joint] = multiplier q[source] + offset in
      `topology.couplings`, or None when there are none. They are data for a scene's constraints; the joints stay free here.
    """

    home: Float[Array, "nb 4 4"]
    screws: Float[Array, "nb 6"]
    inertias: Float[Array, "nb 10"]
    frame_poses: Float[Array, "nf 4 4"]
    gravity: Float[Array, "3"] | None
    armature: Float[Array, " nv"] | None
    damping: Float[Array, " nv"] | None
    friction: Float[Array, " nv"] | None
    lower: Float[Array, " nq"]
    upper: Float[Array, " nq"]
    velocity_limit: Float[Array, " nv"]
    effort_limit: Float[Array, " nv"]
    topology: Topology = eqx.field(static=True)
    coupling_values: Float[Array, "nc 2"] | None = None

    def __str__(self) -> str:
        return tree_of(self)

    @property
    def name(self) -> str:
        """Name of the mechanism."""
        return self.topology.name

    @property
    def nq(self) -> int:
        """Number of configuration coordinates."""
        return self.topology.nq

    @property
    def nv(self) -> int:
        """Number of velocity coordinates."""
        return self.topology.nv

    @property
    def nb(self) -> int:
        """Number of bodies (fixed links are merged into the body that carries them)."""
        return self.topology.nb

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the bodies, in the order of every per-body array."""
        return self.topology.body_names

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints; joint i moves body i."""
        return self.topology.joint_names

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Names of all frames: bodies, links merged into them, and frames added by hand."""
        return self.topology.frame_names

    def replace(self, **leaves) -> "Model":
        """A copy with some leaves replaced, e.g. `model.replace(gravity=None)`.

        **Raises:** ValueError for a name that is not a leaf or for a shape that differs from the present one.
        """
        return _replace(self, leaves)

    def followed(self, q: Float[Array, " nq"], joints: Array) -> Float[Array, " nq"]:
        """The configuration next to q whose joints have the coordinates `joints`: all that there is to q, in a `Model`.

        A subclass may keep numbers behind the joints' coordinates that are functions of these and known near q alone.
        """
        return joints

    def followed_rate(self, q: Float[Array, " nq"], v: Float[Array, " nv"], rate: Array) -> Float[Array, " nq"]:
        """dq/dt (nq,) where the joints' coordinates have the given rate."""
        return rate

    def follows(self, q: Float[Array, " nq"]) -> Bool[Array, ""]:
        """Whether q is where `followed` leaves it and may go on from there; True for a `Model`."""
        return jnp.asarray(True)


def _replace(model: Model, leaves: dict) -> Model:
    names = [field.name for field in dataclasses.fields(Model) if field.name != "topology"]
    sizes = {"gravity": (3,), "armature": (model.nv,), "damping": (model.nv,), "friction": (model.nv,)}
    if model.topology.couplings == ():
        names.remove("coupling_values")
    for name, value in leaves.items():
        if name not in names:
            raise ValueError(f"replace: {name!r} is not a leaf of Model; leaves are {', '.join(names)}")
        if value is None:
            if name not in sizes:
                raise ValueError(f"replace: {name} cannot be None; only {', '.join(sizes)} can be absent")
            continue
        want = sizes.get(name) or getattr(model, name).shape
        if np.shape(value) != want:
            raise ValueError(f"replace: {name} has shape {np.shape(value)}, expected {want}")
        leaves[name] = jnp.asarray(value, model.home.dtype) if not isinstance(value, jax.Array) else value
    return Model(**{name: leaves.get(name, getattr(model, name)) for name in names}, topology=model.topology)


def geometry(model: Model) -> tuple[Array | np.ndarray, Array | np.ndarray]:
    """Home poses (nb, 4, 4) and screws (nb, 6) as every algorithm reads them.

    Values are those of the leaves, except that screw entries which the joint's kind does not have are zero. Derivatives
    are made unique: a change of a home pose that leaves SE(3) has no meaning, and algorithms would answer it differently,
    so it is projected onto SE(3), by R (3 - R^T R)/2, which is R for a rotation and has the projection as its derivative.
    """
    mask = model.topology.screw_mask
    if is_expanding() and is_concrete(model.home, model.screws):
        return jnp.asarray(_snapped(model.home)), jnp.asarray(_snapped(model.screws) * mask.astype(model.screws.dtype))
    screws = model.screws * jnp.asarray(mask, model.screws.dtype)
    if is_concrete(model.home):
        return model.home, screws
    rotation = model.home[:, :3, :3]
    gram = jnp.einsum("nji,njk->nik", rotation, rotation)
    rotation = jnp.einsum("nij,njk->nik", rotation, 1.5 * jnp.eye(3, dtype=rotation.dtype)[None] - 0.5 * gram)
    last = jnp.broadcast_to(jnp.asarray(np.eye(4)[3:], rotation.dtype), (model.nb, 1, 4))
    return jnp.concatenate([jnp.concatenate([rotation, model.home[:, :3, 3:]], 2), last], 1), screws


def _snapped(leaf) -> np.ndarray:
    """Known numbers with those within rounding of 0, 1 and -1 replaced by these, which programs of numbers leave out.

    A rotation by a right angle that was computed has cosines of 1e-16.
    """
    values = np.asarray(leaf)
    near = np.round(values)
    close = (np.abs(near) <= 1) & (np.abs(values - near) <= 4 * np.finfo(values.dtype).eps)
    return np.where(close, near, values)


def _per_joint(topology: Topology, function, q, *rest) -> Array:
    """Apply `function(kind, q of the joint, ...)` to every joint; one-number joints are done in one operation."""
    parts = []
    i = 0
    while i < topology.nb:
        j = i
        while j < topology.nb and KINDS[topology.kinds[j]].nq == 1:
            j += 1
        last = max(j - 1, i)  # a run of one-number joints is a run of plain vectors
        qs = slice(topology.q_slices[i].start, topology.q_slices[last].stop)
        args = [
            x[qs] if along_q else x[topology.v_slices[i].start : topology.v_slices[last].stop] for x, along_q in rest
        ]
        parts.append(function(topology.kinds[i], q[qs], *args))
        i = last + 1
    return jnp.concatenate(parts) if parts else q


def neutral(model: Model) -> Float[Array, " nq"]:
    """Configuration at which every body is at its home pose, (nq,)."""
    check_shapes(model)
    parts = [joint_neutral(kind) for kind in model.topology.kinds]
    return jnp.asarray(np.concatenate(parts) if parts else np.zeros(0), model.home.dtype)


def integrate(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], dt=1.0) -> Float[Array, " nq"]:
    """Configuration reached from q after time dt at the constant body velocity v, on the joints' manifold.

    **Arguments:** `q` (nq,); `v` (nv,), body-fixed; `dt` in s.

    **Returns:** (nq,), with unit quaternions.
    """
    q, v = check_shapes(model, q=q, v=v)
    dt = as_array(dt, "dt", q.dtype)
    return model.followed(q, _per_joint(model.topology, joint_integrate, q, (v * dt, False)))


def difference(model: Model, q0: Float[Array, " nq"], q1: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """Body velocity that moves q0 to q1 in unit time: `integrate(model, q0, difference(model, q0, q1)) == q1`.

    Rotations are compared by the shorter way round; at exactly half a turn one of the two ways is chosen.
    """
    q0, q1 = check_shapes(model, q0=q0, q1=q1)
    return _per_joint(model.topology, joint_difference, q0, (q1, True))


def configuration_rate(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """dq/dt (nq,) for the body velocity v (nv,): the kinematic map qdot = H(q) v."""
    q, v = check_shapes(model, q=q, v=v)
    return model.followed_rate(q, v, joint_rates(model, q, v))


def joint_rates(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Array:
    """Rates of the joints' coordinates in q for the body velocity v (nv,)."""
    return _per_joint(model.topology, joint_rate, q, (v, False))


def normalize(model: Model, q: Float[Array, " nq"]) -> Float[Array, " nq"]:
    """Put q back on the manifold: unit quaternions, other coordinates unchanged."""
    (q,) = check_shapes(model, q=q)

    def unit(kind, qj):
        if kind not in ("spherical", "free"):
            return qj
        quat = qj[-4:] / jnp.sqrt(jnp.sum(qj[-4:] ** 2))
        return quat if kind == "spherical" else jnp.concatenate([qj[:3], quat])

    return model.followed(q, _per_joint(model.topology, unit, q))


def random_configuration(model: Model, key: Array) -> Float[Array, " nq"]:
    """Random configuration (nq,): uniform within finite position limits (else within +-pi or +-1 m), uniform rotations."""
    check_shapes(model)
    topology = model.topology
    keys = jax.random.split(key, topology.nb)
    parts = []
    for i, kind in enumerate(topology.kinds):
        place = topology.q_slices[i]
        reach = np.full(KINDS[kind].nq, 1.0 if kind in ("prismatic", "planar", "free") else np.pi)
        if kind == "planar":
            reach[2] = np.pi
        low, high = model.lower[place], model.upper[place]
        low = jnp.where(jnp.isfinite(low), low, jnp.asarray(-reach, low.dtype))
        high = jnp.where(jnp.isfinite(high), high, jnp.asarray(reach, high.dtype))
        parts.append(joint_random(kind, keys[i], low, high, model.home.dtype))
    return jnp.concatenate(parts) if parts else jnp.zeros((0,), model.home.dtype)


def body_index(model: Model, name: str | None) -> int:
    """Index of a body by name; None means the world, -1.

    **Raises:** ValueError for a name that is neither a body nor a frame merged into one; the near names are listed.
    """
    if name is None:
        return -1
    if name in model.body_names:
        return model.body_names.index(name)
    return model.topology.frame_bodies[frame_index(model, name)]


def frame_index(model: Model, name: str) -> int:
    """Index of a frame by name; where no frame has the name of a joint, that stands for the frame of the body that it moves.

    **Raises:** ValueError when there is no frame of that name; names that look alike are listed.
    """
    import difflib

    moved = dict(zip(model.joint_names, model.body_names, strict=True)).get(name)
    try:
        return model.frame_names.index(name if name in model.frame_names or moved is None else moved)
    except ValueError:
        names = (*model.frame_names, *model.joint_names)
        near = difflib.get_close_matches(str(name), names, n=5, cutoff=0.4)
        hint = f"did you mean {', '.join(near)}?" if near else f"frames are {', '.join(model.frame_names[:10])} ..."
        raise ValueError(f"frame {name!r} is not in model {model.name!r}; {hint}") from None
