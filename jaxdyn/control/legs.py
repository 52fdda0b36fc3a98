"""Legged robots: feet with their cones, and torques and ground forces for an unactuated base.

    M a + h = S^T tau + sum of J_i^T f_i,    f_i in its cone.

The unactuated rows determine the forces that balance the motion, the others give the torques: with G = (J^T)_base and
w = (M a + h)_base,  G f = w  and  tau = (M a + h - J^T f)_motors, which leaves a quadratic program in f.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.codes import RESULTS, Outcome
from jaxdyn.constraints.loops import Loop, loop
from jaxdyn.constraints.rank import pseudo_inverse, tolerance
from jaxdyn.contact.cones import FrictionCone, wrench_basis
from jaxdyn.contact.forces import cone_bounds
from jaxdyn.contact.qp import solve_qp
from jaxdyn.dynamics.kinematics import body_jacobian, frame_pose
from jaxdyn.dynamics.quantities import inverse_dynamics
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Numbers, as_array, as_float, as_number, check_shapes, is_concrete
from jaxdyn.model.host_math import ORTHONORMAL_GROUND, pose_leaf, rotation_fault
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.reduction.inverse_dynamics import velocity_choice
from jaxdyn.systems.scene import Scene

# A surface fixes the same six components as a rigid contact; it differs by its cone of wrenches.
_FLAT = ("rigid", "surface")


class FootConstraint(Loop):
    """Constraint of a foot fixed to the ground; its multipliers are the components of its force."""

    def wrench_components(self):
        """Order of all rows in the wrench: a point's forces, or a weld's forces and torques."""
        return tuple(range(self.kind.count))


class Foot(eqx.Module):
    """Contact of a body with the ground, built by `foot`.

    Its force f (m,), N and N m, is along the columns of the wrench basis of its cone's kind, in the contact frame: z is the
    normal out of the ground. A point's contact frame has the axes of the `ground`, a flat foot's those of its `pose`.
    """

    frame: str = eqx.field(static=True)
    cone: FrictionCone
    pose: Float[Array, "4 4"]
    ground: Float[Array, "3 3"]

    @property
    def size(self) -> int:
        """Number m of components of the foot's force."""
        return self.cone.size

    @property
    def is_flat(self) -> bool:
        """True where the foot transmits torques about all axes and keeps its attitude."""
        return self.cone.kind in _FLAT

    def contact_pose(self, model: Model, q: Float[Array, " nq"]) -> Float[Array, "4 4"]:
        """Pose of the contact frame in the world."""
        pose = matmul(frame_pose(model, q, self.frame), self.pose.astype(q.dtype))
        # A point's attitude is free: the axes of the ground keep the normal from tilting with the body.
        return pose if self.is_flat else pose.at[:3, :3].set(self.ground.astype(q.dtype))

    def jacobian(self, model: Model, q: Float[Array, " nq"]) -> Float[Array, "m nv"]:
        """Jacobian J (m, nv): the velocities along the components of the force f are J v.

        Its transpose maps the force to generalised forces.
        """
        # Ad of the inverse takes the body twist from the axes and origin of the frame to those of the contact.
        to_contact = matmul(se3.inverse(frame_pose(model, q, self.frame)), self.contact_pose(model, q))
        twist = matmul(se3.Ad(se3.inverse(to_contact)), body_jacobian(model, q, self.frame))
        kind = "rigid" if self.cone.kind == "surface" else self.cone.kind
        return matmul(jnp.asarray(wrench_basis(kind).T, q.dtype), twist)

    def hold(self, model: Model, q: Float[Array, " nq"]) -> FootConstraint:
        """Constraint that fixes the foot at its pose for q (nq,): a point, or a weld for a flat foot.

        Its multipliers are the foot's force in its contact frame, so that the foot's cone applies to it
        (`jd.control.standing`).
        """
        # Only the position of a point counts, so the axes of its pose are dropped.
        local = self.pose if self.is_flat else self.pose.at[:3, :3].set(jnp.eye(3, dtype=self.pose.dtype))
        joint = "weld" if self.is_flat else "point"
        hold_loop = loop(None, self.contact_pose(model, q), self.frame, local, joint, name=self.frame)
        # The rows are those of the loop. The class alone differs, by the order of its multipliers.
        return FootConstraint(**{part.name: getattr(hold_loop, part.name) for part in dataclasses.fields(hold_loop)})


def foot(
    frame: str, cone: Checked[FrictionCone], *, pose: Numbers | None = None, ground: Numbers | None = None
) -> Foot:
    """Contact of a body with the ground, with the cone of admissible ground forces.

    **Arguments:**

    - `frame`: name of a body or frame of the model.
    - `cone`: from `jd.contact.friction_cone`, for a point, or `jd.contact.surface_cone(jd.contact.wrench_cone(...))` for a
      flat foot.
    - `pose`: of the contact point in the frame: None (identity), (4, 4), (3,) or (xyz, rpy); m and rad. For a point
      only the position counts; a flat foot's z is the normal out of the ground.
    - `ground` (3, 3): axes of the ground in the world, z its normal; by default those of the world. Only for points.

    **Raises:** ValueError for an invalid cone or pose, and axes that are no rotation.
    """
    if not isinstance(cone, FrictionCone) or cone.in_plane:
        raise ValueError(f"foot {frame!r}: cone is {cone!r}; give one in space from jd.contact.friction_cone(...)")
    if ground is not None and cone.kind in _FLAT:
        raise ValueError(f"foot {frame!r}: a flat foot stands in the axes of its pose; leave ground out")
    rotation = as_array(np.eye(3) if ground is None else ground, f"foot {frame!r}: ground")
    if rotation.shape != (3, 3):
        raise ValueError(f"foot {frame!r}: ground has shape {rotation.shape}; give a rotation (3, 3)")
    if is_concrete(rotation):
        known = np.asarray(rotation, float)
        if fault := rotation_fault(known, ORTHONORMAL_GROUND):
            raise ValueError(
                f"foot {frame!r}: ground is {known.tolist()}, which is no rotation: it {fault}; give orthogonal axes"
            )
    return Foot(frame, cone, pose_leaf(pose, f"foot {frame!r}: pose"), jnp.asarray(rotation, float))


def check_feet(model: object, feet: object) -> tuple[Foot, ...]:
    """Check the feet of a model. **Raises:** ValueError for other types, unknown frames and repeated ones."""
    if not isinstance(model, Model):
        raise ValueError(f"model is a {type(model).__name__}, which has no bodies; pass a Model")
    if not isinstance(feet, (tuple, list)) or not all(isinstance(one, Foot) for one in feet):
        raise ValueError(f"contacts is {feet!r}; pass a list of jd.control.foot(frame, cone)")
    for one in feet:
        frame_index(model, one.frame)
    # `by_foot` and the outputs of a simulation identify feet by their frames.
    names = [one.frame for one in feet]
    if len(set(names)) < len(names):
        raise ValueError(f"contacts name a frame twice: {names}; give every contact a frame of its own")
    return tuple(feet)


class GroundForces(eqx.Module):
    """Weights and limits of the program for torques and ground forces of a `WholeBody`.

    **Arguments:** `preload` (), N; `torque_weight`, `force_weight`, `effort_limit`, `passive` as of
    `jd.control.underactuated_inverse_dynamics`.

    **Raises:** ValueError for numbers that are negative.
    """

    preload: Array
    torque_weight: Array
    force_weight: Array
    effort_limit: Array | None
    passive: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        preload: Numbers = 0.0,
        torque_weight: Numbers = 1.0,
        force_weight: Numbers = 1e-3,
        effort_limit: Numbers | None = None,
        passive: Checked[Sequence[int] | None] = None,
    ):
        self.preload = as_number(preload, "preload", zero=True)
        self.torque_weight = as_number(torque_weight, "torque_weight", zero=True)
        self.force_weight = as_number(force_weight, "force_weight", zero=True)
        self.effort_limit = None if effort_limit is None else as_float(effort_limit, "effort_limit")
        self.passive = None if passive is None else tuple(passive)


class LeggedDynamics(Outcome):
    r"""Torques and ground forces for a given acceleration.

    - `tau` (nv,), N m: zero for unactuated velocities. `forces` (m,), N and N m: of all feet, in their order, each in its
      contact frame (`Foot`). `margins` (k,): of each foot's force in its cone (`FrictionCone.margin`), $\mu f_n - |f_t|$;
      negative outside.
    - `result`: one of `jd.RESULTS`; `infeasible` where no forces in the cones balance the motion within the
      limits of the torques (`missing_wrench` gives the remainder). Forces are then those of least norm without cones and
      limits, of which one is violated.
    """

    tau: Float[Array, " nv"]
    forces: Float[Array, " m"]
    margins: Float[Array, " k"]
    result: Any
    feet: tuple[tuple[str, int], ...] = eqx.field(static=True)

    def by_foot(self) -> dict[str, Array]:
        """Force of each foot, by the name of its frame."""
        ends = np.cumsum([size for _, size in self.feet])[:-1]
        return dict(zip([name for name, _ in self.feet], jnp.split(self.forces, ends, -1), strict=True))


def underactuated_inverse_dynamics(
    model: Model,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    a: Float[Array, " nv"],
    contacts: Checked[Sequence[Foot]],
    *,
    passive: tuple[int, ...] | None = None,
    preload: Numbers = 0.0,
    torque_weight: Numbers = 1.0,
    force_weight: Numbers = 1e-3,
    effort_limit: Numbers | None = None,
    tol: float | None = None,
) -> LeggedDynamics:
    r"""Torques and contact forces, inside their cones, for the acceleration a.

    $$\begin{gathered}
        \min_{\tau, f} w_\tau |\tau|^2 + w_f |f|^2 \quad \text{with} \quad M a + h = S^T \tau + \sum_i J_i^T f_i, \\
        \mathrm{margins}(f_i) \ge \mathrm{preload}, \quad |\tau| \le \tau_\mathrm{limit}
        \end{gathered}$$

    One small quadratic program per sample (`jd.contact.solve_qp`): batched, and differentiable in the state, the
    acceleration, the model and the coefficients of friction. Feet are not constrained to be at rest: choose an `a` with
    $J a + \dot J v = 0$ for feet at rest.

    **Arguments:**

    - `q` (nq,), `v` (nv,), `a` (nv,), the given acceleration.
    - `contacts`: list of `jd.control.foot(frame, cone)`; empty in flight.
    - `passive`: indices of the unactuated velocities; by default those of all free joints.
    - `preload` (), N: least margin of every cone. `torque_weight`, `force_weight`: the second one positive, for N m and N.
    - `effort_limit`: N m, a number or one per velocity, of which only actuated ones are used; None: no limit.
    - `tol`: of `solve_qp`.

    **Returns:** `LeggedDynamics`.

    **Raises:** ValueError for inconsistent shapes, unknown frames, a list with other entries than
    feet, a fully actuated model.

    Source: Righetti, Buchli, Mistry, Kalakrishnan & Schaal (2013), section 3; EQUATIONS section 11.

    ```python
    feet = [jd.control.foot(name, jd.contact.friction_cone("hard-finger", mu=0.6)) for name in ("FL", "FR", "HL", "HR")]
    still = jnp.zeros(model.nv)
    dynamics = jd.control.underactuated_inverse_dynamics(model, q, still, still, feet)
    ```
    """
    q, v, a = check_shapes(model, q=q, v=v, a=a)
    feet = check_feet(model, contacts)
    base = passive_velocities(model, passive)
    motors = np.setdiff1d(np.arange(model.nv), base)
    preload = as_float(preload, "preload", (), q.dtype)
    torque_weight = as_number(torque_weight, "torque_weight", zero=True).astype(q.dtype)
    force_weight = as_number(force_weight, "force_weight", zero=True).astype(q.dtype)
    needed = inverse_dynamics(model, q, v, a)
    if not feet:
        result = RESULTS.where(jnp.any(needed[base] != 0), RESULTS.infeasible, RESULTS.successful)
        tau = needed.at[base].set(0)
        return LeggedDynamics(tau, jnp.zeros((0,), q.dtype), jnp.zeros((0,), q.dtype), result, ())
    # With tau eliminated, |tau|^2 = |needed - across^T f|^2: only f remains in the program.
    J = jnp.concatenate([one.jacobian(model, q) for one in feet])
    across, along = J[:, motors], J[:, base].T
    # The positive weight of forces makes Q definite where the torques do not determine f.
    Q = torque_weight * matmul(across, across.T) + force_weight * jnp.eye(J.shape[0], dtype=q.dtype)
    bounds = cone_bounds([one.cone for one in feet], preload, q.dtype)
    if effort_limit is not None:
        limit = as_float(effort_limit, "effort_limit", None, q.dtype)
        if limit.shape not in ((), (model.nv,)):
            raise ValueError(
                f"effort_limit has shape {limit.shape}; give one number or ({model.nv},), one per velocity"
            )
        limit = jnp.broadcast_to(limit, (model.nv,))[motors]
        rows, levels = bounds.get("G", jnp.zeros((0, J.shape[0]), q.dtype)), bounds.get("h", jnp.zeros((0,), q.dtype))
        # |tau| <= limit with tau = needed - across^T f: two linear rows per motor.
        bounds["G"] = jnp.concatenate([rows, -across.T, across.T])
        bounds["h"] = jnp.concatenate([levels, limit - needed[motors], limit + needed[motors]])
    linear = -torque_weight * matmul(across, needed[motors])
    # The rows of `along` may be dependent: two point feet exert no torque about the line through them.
    optimum = solve_qp(Q, linear, A=along, b=needed[base], tol=tol, **bounds)
    # The last iterate of an infeasible program diverges, so it is replaced by the least-norm forces.
    shortest = matmul(pseudo_inverse(along.T, tolerance(None, along)).T, needed[base])
    forces = jnp.where(optimum.result == RESULTS.infeasible, shortest, optimum.x)
    sizes = np.cumsum([one.size for one in feet])[:-1]
    margins = [one.cone.margin(f) for one, f in zip(feet, jnp.split(forces, sizes), strict=True)]
    # The rows of the base vanish up to the tolerance of the program only.
    tau = (needed - matmul(J.T, forces)).at[base].set(0)
    return LeggedDynamics(
        tau=tau,
        forces=forces,
        margins=jnp.stack(margins),
        result=optimum.result,
        feet=tuple((one.frame, one.size) for one in feet),
    )


def missing_wrench(
    model: Model,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    a: Float[Array, " nv"],
    contacts: Checked[Sequence[Foot]],
    *,
    passive: tuple[int, ...] | None = None,
) -> Float[Array, " np"]:
    r"""Remainder of the generalised force at the base that feet in their cones cannot exert.

    $$(M a + h)_\mathrm{base} - G f$$

    f in the cones minimises its norm. Zero, up to the tolerance of the program and about 1e-6 of its
    norm, where the feet can carry the robot. NaN where the program was not solved.

    **Arguments:** as of `underactuated_inverse_dynamics`.

    **Returns:** (np,), N and N m, in the order of the base's velocities: for a free joint the wrench at its origin, in its
    axes.

    **Raises:** ValueError as there.
    """
    q, v, a = check_shapes(model, q=q, v=v, a=a)
    feet, base = check_feet(model, contacts), passive_velocities(model, passive)
    needed = inverse_dynamics(model, q, v, a)[base]
    if not feet:
        return needed
    G = jnp.concatenate([one.jacobian(model, q) for one in feet])[:, base].T
    # The small term determines internal forces, which the remainder does not. In float32 rounding of G^T G hides a smaller one.
    small = max(1e-6, 100 * float(jnp.finfo(q.dtype).eps))
    Q = matmul(G.T, G) + small * jnp.eye(G.shape[1], dtype=q.dtype)
    # Without preload, which would count as a missing wrench where the feet carry little.
    bounds = cone_bounds([one.cone for one in feet], jnp.zeros((), q.dtype), q.dtype)
    optimum = solve_qp(Q, -matmul(G.T, needed), **bounds)
    return jnp.where(optimum.success, needed - matmul(G, optimum.x), jnp.nan)


def passive_velocities(model: Model, passive: Sequence[int] | None) -> np.ndarray:
    """Indices of the unactuated velocities. **Raises:** ValueError for none, and for indices out of range."""
    top = model.topology
    if passive is None:
        places = [
            np.arange(part.start, part.stop)
            for kind, part in zip(top.kinds, top.v_slices, strict=True)
            if kind == "free"
        ]
        # The empty array keeps the result valid, and an array of integers, for a model without free joints.
        indices = np.concatenate([*places, np.zeros(0, int)])
        if not indices.size:
            raise ValueError(
                f"model {model.name!r} has no free joint, so it is fully actuated; use jd.inverse_dynamics, or name "
                "the unactuated velocities in passive"
            )
        return indices
    # Sorted: the order of the base's velocities is that of v, whatever the order given.
    return np.array(sorted(velocity_choice(Scene(model), passive, "passive")))
