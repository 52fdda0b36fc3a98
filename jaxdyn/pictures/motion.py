"""Moving parts of a picture: poses of bodies over time, ends of loops, forces. Plain numpy arrays."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.base import layout
from jaxdyn.constraints.frames import Pair
from jaxdyn.constraints.loops import Distance, Loop
from jaxdyn.contact.cones import components
from jaxdyn.contact.forces import contacts_with_cones
from jaxdyn.dynamics.kinematics import forward_kinematics
from jaxdyn.grasp.hand import Contact
from jaxdyn.model.arguments import as_array
from jaxdyn.model.topology import SCREW_KINDS
from jaxdyn.model.tree import Model
from jaxdyn.pictures.default_solids import frame_poses
from jaxdyn.simulation.solution import Solution
from jaxdyn.systems.scene import Scene, as_scene


class Motion(NamedTuple):
    """Motions of one scene. Rows after an early end repeat the last valid one.

    - `ts` (nt,), s; `q` (n, nt, nq); `poses` (n, nt, nb, 4, 4), of the bodies in the world.
    - `multipliers` (n, nt, nc) and `torque` (n, nt, nv), None where the solution has none.
    """

    scene: Scene
    ts: np.ndarray
    q: np.ndarray
    poses: np.ndarray
    multipliers: np.ndarray | None
    torque: np.ndarray | None


class Force(NamedTuple):
    """Arrows of one constraint or joint: points (n, nt, 3), m, and vectors (n, nt, 3), N (or N m of a torque)."""

    name: str
    kind: str  # "normal", "friction", "bearing", "contact" (both, of a contact with a cone), "force" or "torque" of a joint
    places: np.ndarray
    vectors: np.ndarray


class Mark(NamedTuple):
    """Mark of a constraint: points (n, nt, 3) on its two bodies, and the axis (n, nt, 3) of a loop's joint or normal."""

    name: str
    kind: str  # "loop", "distance" or "contact"
    a: np.ndarray
    b: np.ndarray
    axis: np.ndarray


class Cone(NamedTuple):
    """Friction cone of a contact: apex and direction of the normal force, (n, nt, 3), in the world, and its coefficient.

    `across` (n, nt, 3): direction of slip of a planar contact, whose cone is a wedge; None for a round cone.
    """

    name: str
    apex: np.ndarray
    axis: np.ndarray
    across: np.ndarray | None
    slope: float


def drawable(scene: Any) -> Scene:
    """Convert a model to a scene. **Raises:** ValueError for systems without bodies."""
    scene = as_scene(scene)
    if not isinstance(scene.system, Model):
        raise ValueError(
            f"the system is a {type(scene.system).__name__}, which has no bodies to draw; a Model has (jd.ModelBuilder, "
            "jd.load_model, ...). Its coordinates over time: jd.plot.states(scene, solution)"
        )
    return scene


@functools.lru_cache(maxsize=32)
def _kinematics(structure):
    """One compiled function for models that differ only in their parameters."""
    # The argument is the key of the cache; the function itself takes the model.
    del structure
    return jax.jit(lambda model, qs: jax.vmap(lambda q: forward_kinematics(model, q))(qs))


def poses_of(model: Model, qs) -> np.ndarray:
    """Poses (n, nb, 4, 4) of the bodies at configurations (n, nq)."""
    qs = as_array(qs, "q", model.home.dtype)
    return np.asarray(_kinematics(model.topology)(model, qs), float)


def motion_of(scene: Any, solution: Any, rows: int | None = None, maximum: int | None = None) -> Motion:
    """Convert a solution, batched or not, or a configuration (nq,) to a motion of at most `rows` rows and `maximum` trajectories.

    **Raises:** ValueError for systems without bodies, and for arrays that do not fit the scene.
    """
    scene = drawable(scene)
    model = scene.system
    if not isinstance(solution, Solution):
        q = np.asarray(as_array(solution, "q", model.home.dtype), float)
        if q.shape != (model.nq,):
            raise ValueError(
                f"solution has shape {q.shape}; give what jd.simulate returns, or one configuration ({model.nq},) = (nq,)"
            )
        return Motion(scene, np.zeros(1), q[None, None], poses_of(model, q[None])[None], None, None)
    q = np.asarray(solution.q, float)
    if q.ndim < 2 or q.shape[-1] != model.nq:
        raise ValueError(
            f"solution.q has shape {q.shape}, expected (..., nt, {model.nq}); is the scene that of the solution?"
        )
    nt = q.shape[-2]
    # All batch axes become one.
    q = q.reshape(-1, nt, model.nq)
    ts = np.asarray(solution.ts, float).reshape(-1, nt)
    if (ts != ts[0]).any():
        raise ValueError(
            "solution.ts differs from motion to motion; save all of them at the same times to show them together"
        )
    extras: list[Any] = [solution.multipliers, solution.torque]
    if maximum is not None and len(q) > maximum:
        # Evenly from the batch, since its order often follows a parameter.
        chosen = np.unique(np.linspace(0, len(q) - 1, maximum).round().astype(int))
    else:
        chosen = np.arange(len(q))
    kept = np.arange(nt) if rows is None or nt <= rows else select_rows(ts[0], rows)
    q = q[chosen][:, kept]
    reached = np.logical_and.reduce(np.isfinite(q), axis=-1)
    if not reached[:, 0].all():
        raise ValueError("solution.q is not finite at the start; there is nothing to show")
    last = np.maximum.accumulate(np.where(reached, np.arange(q.shape[1]), 0), axis=1)[..., None]
    # A motion that ended early stays at its last state instead of disappearing.
    q = np.take_along_axis(q, last, 1)
    for k, values in enumerate(extras):
        if values is not None:
            values = np.asarray(values, float).reshape(-1, nt, values.shape[-1])[chosen][:, kept]
            extras[k] = np.take_along_axis(values, last, 1)
    poses = poses_of(model, q.reshape(-1, model.nq)).reshape(*q.shape[:2], model.nb, 4, 4)
    return Motion(scene, ts[0, kept], q, poses, *extras)


def select_rows(ts: np.ndarray, maximum: int) -> np.ndarray:
    """Rows evenly spaced in time, as save points need not be."""
    wanted = np.linspace(ts[0], ts[-1], max(maximum, 2) if len(ts) > 1 else 1)
    return np.unique(np.abs(ts - wanted[:, None]).argmin(1))


def _ends(motion: Motion, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, nt, 4, 4) of the frames A and B of a constraint."""
    model = motion.scene.system
    a, b = (
        frame_poses(model, motion.poses, body) @ np.asarray(pose, float) for body, pose in pair.resolve(model).ends()
    )
    return a, b


def marks(motion: Motion) -> list[Mark]:
    """Marks of the constraints between bodies."""
    drawn = []
    for constraint in motion.scene.constraints:
        if not isinstance(constraint, Pair):
            continue
        a, b = _ends(motion, constraint)
        if isinstance(constraint, Loop | Distance):
            kind = "distance" if isinstance(constraint, Distance) else "loop"
            drawn.append(Mark(constraint.name, kind, a[..., :3, 3], b[..., :3, 3], a[..., :3, 2]))
            continue
        point, normal = _contact(motion, constraint, a, b)
        drawn.append(Mark(constraint.name, "contact", point, point, normal))
    return drawn


def _contact(motion: Motion, constraint: Pair, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Point (n, nt, 3) and normal (n, nt, 3) of a contact in the world."""
    model = motion.scene.system
    # A contact at a fixed point: frame A is there, with z along the normal.
    if not hasattr(constraint.resolve(model), "contact_point"):
        return a[..., :3, 3], a[..., :3, 2]

    def touch(R, p, q):
        at: Any = constraint.at(model, q)
        return at.contact_point(R, p)

    R, p, q = _rows(motion, a, b)
    point, normal = (np.asarray(x, float).reshape(a.shape[0], a.shape[1], 3) for x in jax.vmap(touch)(R, p, q))
    turn = a[..., :3, :3]
    return (turn @ point[..., None])[..., 0] + a[..., :3, 3], (turn @ normal[..., None])[..., 0]


def _rows(motion: Motion, a: np.ndarray, b: np.ndarray) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Rotations and positions of frame B in A, and configurations, of all rows of all trajectories."""
    transpose = np.swapaxes(a[..., :3, :3], -1, -2)
    R, p = transpose @ b[..., :3, :3], (transpose @ (b[..., :3, 3:] - a[..., :3, 3:]))[..., 0]
    R, p, q = (jnp.asarray(x.reshape(-1, *x.shape[2:])) for x in (R, p, motion.q))
    return R, p, q


def forces(motion: Motion) -> list[Force]:
    """Arrows of the solution's constraint forces, on frame B (for grasps: on the object), and of its joint torques."""
    arrows = []
    if motion.multipliers is not None:
        coned = {cone.name for cone in cones(motion)}
        normals = {mark.name: mark.axis for mark in marks(motion) if mark.kind == "contact"}
        for constraint, place in zip(motion.scene.constraints, layout(motion.scene), strict=True):
            if not isinstance(constraint, Pair):
                continue
            force = _force(motion, constraint, place.name, motion.multipliers[..., place.start : place.end])
            if place.name in coned:
                # One arrow, to be compared with its cone.
                arrows.append(force)
            elif constraint.name in normals:
                normal = normals[constraint.name]
                along = np.sum(force.vectors * normal, axis=-1, keepdims=True) * normal
                arrows.append(force._replace(kind="normal", vectors=along))
                arrows.append(force._replace(kind="friction", vectors=force.vectors - along))
            else:
                arrows.append(force._replace(kind="bearing"))
    if motion.torque is not None:
        model = motion.scene.system
        top = model.topology
        for i, kind in enumerate(top.kinds):
            # A joint of several coordinates has no single axis along which its torque could be drawn.
            if kind not in SCREW_KINDS:
                continue
            screw = np.asarray(model.screws, float)[i]
            axis = screw[:3] if kind == "prismatic" else screw[3:]
            direction = motion.poses[:, :, i, :3, :3] @ axis
            size = motion.torque[:, :, top.v_slices[i]]
            word = "force" if kind == "prismatic" else "torque"
            arrows.append(Force(top.joint_names[i], word, motion.poses[:, :, i, :3, 3], direction * size))
    # A force that is zero throughout would be an arrow without a direction, and what is left of a difference no friction.
    maximum = max(
        (float(np.abs(force.vectors).max(initial=0.0)) for force in arrows if force.kind != "torque"), default=0.0
    )
    return [f for f in arrows if np.abs(f.vectors).max(initial=0.0) > (0.0 if f.kind == "torque" else 1e-9 * maximum)]


def _force(motion: Motion, constraint: Pair, name: str, multipliers: np.ndarray) -> Force:
    """Force of a constraint between two bodies for its multipliers (n, nt, rows)."""
    a, b = _ends(motion, constraint)
    R, p, q = _rows(motion, a, b)
    lam = jnp.asarray(multipliers.reshape(len(p), -1))
    wrench = np.asarray(_wrenches(motion.scene.system, constraint, R, p, q, lam), float)
    wrench = wrench[:, :3].reshape(*a.shape[:2], 3)
    # Multipliers of grasps act on the object, which is frame A; others on frame B.
    vectors = (a[..., :3, :3] @ wrench[..., None])[..., 0] * (-1.0 if isinstance(constraint, Contact) else 1.0)
    at = b[..., :3, 3] if isinstance(constraint, Loop | Distance) else _contact(motion, constraint, a, b)[0]
    return Force(name, "contact", at, vectors)


def cones(motion: Motion) -> list[Cone]:
    """Friction cones of a scene's contacts, without those of surface contacts, whose cones are six-dimensional."""
    scene, drawn = motion.scene, []
    if scene.cones is None:
        return drawn
    places = {place.name: place for place in layout(scene)}
    constraints = dict(zip(places, scene.constraints, strict=True))
    for contact in contacts_with_cones(scene):
        constraint, place, cone = constraints[contact.name], places[contact.name], contact.cone
        if cone.mu is None or not isinstance(constraint, Pair):
            continue
        normal, first = components(cone.kind, cone.in_plane, contact.name).index(2), 0

        def direction(component, contact=contact, constraint=constraint, place=place) -> Force:
            unit = np.zeros((*motion.q.shape[:2], place.end - place.start))
            # The direction of a component is the force of its unit multiplier.
            unit[..., contact.rows[component] - place.start] = 1.0
            return _force(motion, constraint, contact.name, unit)

        along = direction(normal)
        across = direction(first).vectors if cone.in_plane else None
        drawn.append(Cone(contact.name, along.places, along.vectors, across, float(cone.mu)))
    return drawn


@eqx.filter_jit
def _wrenches(model: Model, constraint: Pair, R, p, q, lam):
    return jax.vmap(lambda R, p, q, lam: constraint.at(model, q).wrench(R, p, lam))(R, p, q, lam)


def joint_axes(motion: Motion) -> list[tuple[np.ndarray, np.ndarray]]:
    """Position (n, nt, 3) and axis (n, nt, 3) of each joint that has one."""
    model, axes = motion.scene.system, []
    for i, kind in enumerate(model.topology.kinds):
        if kind in SCREW_KINDS or kind == "planar":
            screw = np.asarray(model.screws, float)[i]
            local = np.eye(3)[2] if kind == "planar" else screw[:3] if kind == "prismatic" else screw[3:]
            axes.append((motion.poses[:, :, i, :3, 3], motion.poses[:, :, i, :3, :3] @ local))
    return axes
