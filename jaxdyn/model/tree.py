"""Parameters of a mechanism on a static tree of bodies, `Model`, with checks and repairs of its inertias."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxdyn.compile.known import is_concrete
from jaxdyn.model import host_math
from jaxdyn.model.arguments import Numbers, as_array, batch_hint, store_leaf, warn
from jaxdyn.model.description import tree_table
from jaxdyn.model.inertia import inertial_parameters, nearest_feasible, transform_inertia
from jaxdyn.model.topology import Topology as Topology
from jaxdyn.model.topology import coordinate_index, frame_index, velocity_indices


class Model(eqx.Module):
    """Tree of rigid bodies joined by screws, a pytree: the topology is static, every parameter is an array leaf.

    Build one with `ModelBuilder` or `load_model`. Shapes, units and frames of the leaves:

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
    - `fixed_joints`: (joint, frame) for each fixed joint: its name is a second name of the link's frame. Static.
    - `rounding`: size of the rounding of its poses (m or rad), 0 for exact ones; that of a file by its digits. Static. Rows of
      constraints that differ by rounding from combinations of others repeat them.
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
    fixed_joints: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    rounding: float = eqx.field(static=True, default=0.0)

    def __str__(self) -> str:
        return tree_table(self)

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

    def replace(self, **leaves: PyTree) -> "Model":
        """Copy with some leaves, or the `rounding` of its poses, replaced, e.g. `model.replace(gravity=None)`.

        **Raises:** ValueError for a name that is not a leaf, for a shape that differs from the present one, and for NaN or
        infinity (limits may be infinite) and entries of `screws` that the joint's kind leaves out, with the body, joint or frame
        that they belong to.

        **Warns:** UserWarning naming bodies whose new `inertias` are unphysical, as `ModelBuilder.build` does.
        """
        return _replace(self, leaves)

    def q_index(self, joint: str) -> int | slice:
        """Index of a joint's coordinate in q, or the slice of several.

        `q[model.q_index("elbow")]` reads them, `q.at[model.q_index("elbow")].set(0.5)` sets them.

        **Raises:** ValueError for a name that is no moving joint; similar names are listed.
        """
        return coordinate_index(self.topology.q_slices, self, joint)

    def v_index(self, joint: str) -> int | slice:
        """Index of a joint's coordinate in v, tau and every array (nv,), or the slice of several."""
        return coordinate_index(self.topology.v_slices, self, joint)

    def selection_matrix(self, joints: Iterable[str] | None = None) -> Float[Array, "nv nu"]:
        r"""Selection matrix S (nv, nu) of the actuated joints.

        $\tau = S u$ for their forces u (nu,), and $S^T v$ are their velocities.

        **Arguments:** `joints`, names in the order of u; None: all but free ones, which carry floating bases.

        **Raises:** ValueError for names that are no moving joints, or that are given twice.
        """
        if joints is None:
            named = zip(self.joint_names, self.topology.kinds, strict=True)
            joints = [name for name, kind in named if kind != "free"]
        return jnp.asarray(np.eye(self.nv)[:, velocity_indices(self, joints)], self.home.dtype)

    def with_payload(self, frame: str, inertia: Numbers) -> "Model":
        """Model carrying a payload at a frame: its inertia is added to that of the body with the frame.

        **Arguments:** `frame`, one of `model.frame_names` or of `model.joint_names`; `inertia`, in the frame's axes: the ten
        numbers (10,) about its origin, or (mass, centre of mass (3,), rotational inertia (3, 3) about it); kg, m, kg m^2.
        They may be traced: a batch of payloads is a `jax.vmap` over them.

        **Raises:** ValueError for an unknown frame, one fixed to the world, and for an inertia of other shapes, NaN or infinity.

        Source: Steiner's theorem, `jd.inertia.transform_inertia`.

        ```python
        heavier = model.with_payload("hand", (2.0, (0.0, 0.0, 0.1), jnp.diag(jnp.array([0.01, 0.01, 0.01]))))
        batch = jax.vmap(lambda ten: jd.gravity_force(model.with_payload("hand", ten), q))(tens)
        ```
        """
        index, dtype = frame_index(self, frame), self.home.dtype
        body = self.topology.frame_bodies[index]
        if body < 0:
            raise ValueError(
                f"frame {frame!r} is fixed to the world: a payload there has no effect; name a moving frame"
            )
        # Inertial parameters about one origin add up; the payload is moved to the body's own first.
        added = transform_inertia(self.frame_poses[index], _payload(inertia, dtype))
        return self.replace(inertias=self.inertias.at[body].add(added))

    def complete_configuration(self, q: Float[Array, " nq"], joints: Array) -> Float[Array, " nq"]:
        """Configuration near q with the joint coordinates `joints`; these are all of q in a `Model`.

        Subclasses may append dependent coordinates, which are functions of these defined only near q (see
        `jd.contact.RollingModel`).
        """
        return joints

    def complete_rate(self, q: Float[Array, " nq"], v: Float[Array, " nv"], rate: Array) -> Float[Array, " nq"]:
        """Rate dq/dt (nq,) where the joints' coordinates have the given rate."""
        return rate

    def is_consistent(self, q: Float[Array, " nq"]) -> Bool[Array, ""]:
        """Decide whether the dependent coordinates of q solve their equations; True for a `Model`."""
        return jnp.asarray(True)


def _payload(inertia: Any, dtype) -> Array:
    """Ten inertial parameters of an inertia argument, traced or not."""
    ask = "give the ten numbers (10,), or (mass, centre of mass (3,), rotational inertia (3, 3) about it)"
    if isinstance(inertia, (tuple, list)) and len(inertia) == 3:
        parts = [as_array(part, "inertia", dtype) for part in inertia]
        if [part.shape for part in parts] != [(), (3,), (3, 3)]:
            raise ValueError(f"inertia has parts of shapes {[part.shape for part in parts]}; {ask}")
        ten = inertial_parameters(*parts)
    else:
        ten = as_array(inertia, "inertia", dtype)
    if ten.shape != (10,):
        raise ValueError(f"inertia has shape {ten.shape}; {ask}{batch_hint(ten, (10,))}")
    if is_concrete(ten) and not np.isfinite(np.asarray(ten)).all():
        raise ValueError(f"inertia is {np.asarray(ten).tolist()}; give finite numbers")
    return ten


def _replace(model: Model, leaves: dict) -> Model:
    rounding = check_rounding(leaves.pop("rounding", model.rounding))
    static = "topology", "fixed_joints", "rounding"
    names = [field.name for field in dataclasses.fields(Model) if field.name not in static]
    sizes = {"gravity": (3,), "armature": (model.nv,), "damping": (model.nv,), "friction": (model.nv,)}
    # Without couplings in the static topology there is nothing that the values could belong to.
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
        if is_concrete(value):
            _check_finite(model, name, np.asarray(value))
        if name == "screws" and is_concrete(value):
            _check_screws(model, np.asarray(value))
        if name == "inertias" and is_concrete(value):
            warn_unphysical_inertias(dict(zip(model.body_names, np.asarray(value), strict=True)))
        # Arrays of jax keep their dtype: the caller may differentiate a leaf of another precision.
        leaves[name] = jnp.asarray(value, model.home.dtype) if not isinstance(value, jax.Array) else value
    leaves = {name: leaves.get(name, getattr(model, name)) for name in names}
    return Model(**leaves, topology=model.topology, fixed_joints=model.fixed_joints, rounding=rounding)


def check_rounding(rounding: object) -> float:
    """Check the rounding of poses. **Raises:** ValueError for anything but a number from 0 to 0.01."""
    # Above that redundant rows are not distinguishable from independent ones, whatever the mechanism.
    if not isinstance(rounding, (int, float, np.number)) or not 0 <= rounding <= 1e-2:
        raise ValueError(f"rounding is {rounding!r}; give the size of the poses' rounding errors, 0 to 0.01 (m or rad)")
    return float(rounding)


def _check_finite(model: Model, name: str, values: np.ndarray) -> None:
    """Refuse NaN, and infinity where it is no limit. **Raises:** ValueError that names what the first such row belongs to."""
    limits = {"lower": -np.inf, "upper": np.inf, "velocity_limit": np.inf, "effort_limit": np.inf}
    bad = ~np.isfinite(values) & (values != limits.get(name, np.nan))
    if not bad.any():
        return
    row = int(np.argwhere(bad)[0, 0])
    top = model.topology
    owners = {
        "home": top.body_names,
        "screws": top.body_names,
        "inertias": top.body_names,
        "frame_poses": top.frame_names,
    }
    if name in owners:
        what = f"{name} of {'frame' if name == 'frame_poses' else 'body'} {owners[name][row]!r}"
    elif name in ("gravity", "coupling_values"):
        what = name
    else:
        slices = top.q_slices if name in ("lower", "upper") else top.v_slices
        what = f"{name} of joint {next(j for j, s in zip(top.joint_names, slices, strict=True) if s.start <= row < s.stop)!r}"
    shown = values if name == "gravity" else values[row]
    raise ValueError(f"replace: {what} is {shown.tolist()}; give finite numbers")


def _check_screws(model: Model, screws: np.ndarray) -> None:
    """Refuse entries that joints of their kinds leave out. **Raises:** ValueError that names the first such body."""
    unused = np.where(model.topology.screw_mask, 0, np.abs(screws))
    # Screws that were transformed have entries of rounding there.
    bad = (unused > 1e-6 * np.abs(screws).max(axis=1, initial=0, keepdims=True)).any(axis=1)
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(
            f"replace: screws of body {model.body_names[i]!r} is {screws[i].tolist()}, and its joint is "
            f"{model.topology.kinds[i]}: revolute axes pass through the body's origin, which `home` places, and prismatic joints "
            "do not turn; change `home`, or build another kind"
        )


def warn_unphysical_inertias(inertias: Mapping[str, Any], places: Mapping[str, str] | None = None) -> None:
    """Give one warning for all bodies whose inertia (10,) is unphysical; `places` gives file:line of bodies."""
    faults = []
    for name, parameters in inertias.items():
        if is_concrete(parameters) and (fault := host_math.inertia_fault(np.asarray(parameters))):
            place = f"{places[name]}: " if places and name in places else ""
            faults.append(f"{place}body {name!r}: {fault}")
    if faults:
        more = f"; and {len(faults) - 5} more bodies" if len(faults) > 5 else ""
        fix = "correct the numbers, or use jd.model.repair_inertias(model)"
        warn(f"{'; '.join(faults[:5])}{more}. No body has such an inertia: {fix}", UserWarning)


def nearest_rotation(rotation: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3 3"]:
    """R (3 - R^T R)/2, one Newton step towards the orthogonal factor, which is differentiable without an SVD."""
    gram = jnp.einsum("...ji,...jk->...ik", rotation, rotation)
    one = jnp.eye(3, dtype=rotation.dtype).reshape((1,) * (rotation.ndim - 2) + (3, 3))
    return jnp.einsum("...ij,...jk->...ik", rotation, 1.5 * one - 0.5 * gram)


def geometry(model: Model) -> tuple[Array | np.ndarray, Array | np.ndarray]:
    """Home poses (nb, 4, 4) and screws (nb, 6) as every algorithm uses them.

    Values are those of the leaves; screw entries that the joint's kind does not have are zero. Entries of a known model within
    rounding of 0, 1 or -1 are exact, so that they cost no operation of a kernel. Derivatives are made unique: a change of a home
    pose that leaves SE(3) has no meaning, and algorithms would give different derivatives for it. It is projected onto SE(3) by
    R (3 - R^T R)/2, which equals R for a rotation and whose derivative is the projection.
    """
    mask = model.topology.screw_mask
    # A known home pose is not differentiated, so that the projection would only add rounding.
    if is_concrete(model.home, model.screws):
        return _snap_to_integers(model.home), _snap_to_integers(model.screws) * mask.astype(model.screws.dtype)
    # A revolute joint of a declared kind ignores v, so that its derivative with respect to v is zero too.
    screws = model.screws * jnp.asarray(mask, model.screws.dtype)
    if is_concrete(model.home):
        return model.home, screws
    rotation = nearest_rotation(model.home[:, :3, :3])
    last = jnp.broadcast_to(jnp.asarray(np.eye(4)[3:], rotation.dtype), (model.nb, 1, 4))
    return jnp.concatenate([jnp.concatenate([rotation, model.home[:, :3, 3:]], 2), last], 1), screws


def _snap_to_integers(leaf) -> np.ndarray:
    """Replace known numbers within rounding of 0, 1 and -1 by these, so that scalar programs drop their products.

    A computed rotation by a right angle has cosines of 1e-16.
    """
    values = np.asarray(leaf)
    near = np.round(values)
    close = (np.abs(near) <= 1) & (np.abs(values - near) <= 4 * np.finfo(values.dtype).eps)
    return np.where(close, near, values)


def inertia_report(model: Model) -> list[tuple[str, str]]:
    """Unphysical inertias of a model, as (body, problem).

    Listed are bodies that are massless, whose rotational inertia about the centre of mass is not positive definite, or
    whose principal moments break the triangle inequality (one exceeds the sum of the other two).

    Such bodies are common in files made by hand and harmless where other bodies move with them; see `repair_inertias`.
    """
    return [
        (name, problem)
        for name, parameters in zip(model.body_names, np.asarray(model.inertias), strict=True)
        for problem in inertia_problems(parameters)
    ]


def inertia_problems(parameters) -> list[str]:
    """Faults of ten inertial parameters (10,), in words; an empty list for physical ones."""
    parameters = np.asarray(parameters)
    # The shift from the origin to the centre of mass leaves a few roundings of the precision the numbers came in.
    rounding = 64 * np.finfo(parameters.dtype).eps
    parameters = parameters.astype(np.float64)
    if not np.isfinite(parameters).all():
        return [f"not finite: {parameters.tolist()}"]
    if not parameters.any():
        return ["massless"]
    if parameters[0] <= 0:
        return [f"mass {parameters[0]} kg with first moments and inertia {parameters[1:].tolist()}"]
    moments = np.linalg.eigvalsh(host_math.about_com(parameters)[2])
    slack = rounding * np.abs(host_math.rotational_inertia(parameters)).max()
    text = ", ".join(f"{moment:.6g}" for moment in moments)
    if moments[0] <= slack:
        return [f"not positive definite: principal moments {text} kg m^2"]
    if moments[2] > moments[0] + moments[1] + slack:
        return [f"triangle inequality violated: principal moments {text} kg m^2"]
    return []


def repair_inertias(model: Model) -> Model:
    """Copy of a model in which every body with mass has physical inertial parameters (`inertia.nearest_feasible`).

    Bodies that `inertia_report` does not list and massless ones stay unchanged.

    **Raises:** ValueError that names the body for NaN or infinity.
    """
    inertias = np.array(model.inertias)
    for i, parameters in enumerate(inertias):
        # A massless body has no inertia to repair: only the file's author knows the mass.
        if parameters[0] > 0 and inertia_problems(parameters):
            try:
                inertias[i] = nearest_feasible(parameters)
            except ValueError as error:
                raise ValueError(f"body {model.body_names[i]!r}: {error}") from error
    return model.replace(inertias=store_leaf(inertias, inertias.dtype))
