r"""Errors of measured tip poses as functions of a mechanism's geometry, and the directions that no pose determines.

Every joint i has a home pose $H_i$ and a screw $S_i$; the tip is at

$$T = B\,e^{\beta} \prod_i H_i\,e^{\xi_i}\,e^{S_i q_i}\, F\,e^{\tau}$$

with the base B in the frame of the measuring device and the tool F in the last body. Unknown are the twists $\beta$, $\xi_i$ and
$\tau$. The errors of the zero of an encoder, of the direction of an axis and of lengths between joints are components of $\xi_i$.

Not all of them can be found. The frame of a body may be moved by a twist $\zeta$ that commutes with the screw of its joint,
$[\zeta, S_i] = 0$: turns about and shifts along the axis of a revolute joint (2), all shifts and turns about its direction for a
prismatic one (4), any twist where there is no joint, at the base (6). $H_i$ then becomes $H_i e^\zeta$, and all that the body
carries is multiplied by $e^{-\zeta}$; no pose changes. Of base, n joints and tool, 6 (n + 2) numbers, the rank is 4 for each
revolute joint, 2 for each prismatic one and 6 for the tool, however many poses are measured.

Source: Mooring, Roth & Driels (1991), "Fundamentals of manipulator calibration", the count 4 R + 2 P + 6; Park & Okamura (1994),
"Kinematic calibration and the product of exponentials formula"; He, Zhao, Yang & Yang (2010), identifiability by POE.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.base import position_residual
from jaxdyn.constraints.loops import Loop
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.identify.blocks import perpendicular_basis
from jaxdyn.lie import se3, so3
from jaxdyn.model import host_math
from jaxdyn.model.arguments import as_array
from jaxdyn.model.topology import SCREW_KINDS, frame_index
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, as_scene

# Singular values below this share of the largest one are not determined: derivatives are exact to about 1e-13.
RANK = 1e-8
PARTS = ("base", "offsets", "axes", "lengths", "tool")
# Steps that close the loops, and the largest residual (rad, m) of loops that are closed.
_CLOSING, _CLOSED = 30, 1e-10
# Relative singular value below which a matrix of closed forms has lost rank: rounding is at 1e-15, a true one near 1.
_ZERO = 1e-9


class Mechanism(NamedTuple):
    """Scene, measured frame, bodies whose home poses may change, and indices of loops among the constraints.

    `passive`: indices in q of the joints that are not measured. `size` (m): the arm's, by which shifts count against turns.
    """

    scene: Scene
    frame: str
    bodies: tuple[int, ...]
    loops: tuple[int, ...]
    passive: tuple[int, ...]
    size: float

    @property
    def model(self) -> Model:
        """The scene's model."""
        return self.scene.system

    @property
    def places(self) -> tuple[str, ...]:
        """Names of the twists: of the base, of the joints, of the tool, and two for each loop."""
        loops = [f"{self.scene.constraints[k].name} {end}" for k in self.loops for end in "ab"]
        return ("base", *(self.model.joint_names[i] for i in self.bodies), "tool", *loops)

    @property
    def tool(self) -> int:
        """Index of the tool's twist."""
        return 1 + len(self.bodies)


def make_mechanism(system: Any, frame: str, measured: Sequence[str] | None) -> Mechanism:
    """Mechanism up to a frame, with the bodies of all loops. **Raises:** ValueError as `fit_geometry`."""
    scene = as_scene(system)
    model = scene.system
    if not isinstance(model, Model):
        raise ValueError(f"system is a {type(model).__name__}; geometry is that of a Model's joints")
    body = model.topology.frame_bodies[frame_index(model, frame)]
    loops = tuple(k for k, constraint in enumerate(scene.constraints) if isinstance(constraint, Loop))
    if len(loops) < len(scene.constraints):
        raise ValueError("the scene has constraints other than loops (jd.loop); geometry is fitted with loops alone")
    ends = [end for k in loops for end, _ in scene.constraints[k].ends() if end is not None]
    bodies: set[int] = set()
    for tip in (body, *(model.topology.frame_bodies[frame_index(model, end)] for end in ends)):
        while tip >= 0:
            bodies.add(tip)
            tip = model.topology.parents[tip]
    strange = [model.joint_names[i] for i in bodies if model.topology.kinds[i] not in SCREW_KINDS]
    if not bodies or strange:
        what = f"joints {', '.join(strange)} have several degrees of freedom" if strange else "no joint moves it"
        raise ValueError(f"frame {frame!r}: {what}; geometry is that of revolute, prismatic and helical joints")
    passive: tuple[int, ...] = ()
    if measured is not None:
        unknown = [name for name in measured if name not in model.joint_names]
        if unknown or not loops:
            raise ValueError(
                f"measured is {list(measured)}; give names of joints ({', '.join(model.joint_names)}), of a scene with loops"
            )
        places = model.topology.q_slices
        passive = tuple(places[i].start for i in sorted(bodies) if model.joint_names[i] not in measured)
    elif loops:
        raise ValueError(
            "measured is missing; name the joints with encoders, from which the loops determine the others"
        )
    home = np.asarray(model.home, np.float64)
    # Shifts by the arm's size and turns by one radian move its tip alike.
    size = float(sum(np.linalg.norm(home[i, :3, 3]) for i in bodies)) or 1.0
    return Mechanism(scene, frame, tuple(sorted(bodies)), loops, passive, size)


def change_scene(mechanism: Mechanism, twists) -> Scene:
    """Scene whose home poses and loop frames are changed by the twists (places, 6) of joints and loops."""
    exps, index = jax.vmap(se3.exp)(twists), np.array(mechanism.bodies, int)
    home = mechanism.model.home.at[index].set(mechanism.model.home[index] @ exps[1 : mechanism.tool])
    constraints: list[Any] = list(mechanism.scene.constraints)
    for place, k in enumerate(mechanism.loops):
        a, b = exps[mechanism.tool + 1 + 2 * place], exps[mechanism.tool + 2 + 2 * place]
        ends = (constraints[k].pose_a @ a, constraints[k].pose_b @ b)
        constraints[k] = eqx.tree_at(lambda loop: (loop.pose_a, loop.pose_b), constraints[k], ends)
    model = eqx.tree_at(lambda model: model.home, mechanism.model, home)
    return eqx.tree_at(lambda s: (s.system, s.constraints), mechanism.scene, (model, tuple(constraints)))


class Measurements(NamedTuple):
    """Poses (n, 4, 4) of the frame, or None and `positions` (n, k, 3) of `markers` (k, 3) in it; base and tool at the start."""

    poses: np.ndarray | None
    positions: np.ndarray
    markers: np.ndarray
    base: np.ndarray
    tool: np.ndarray


def tip_errors(mechanism: Mechanism, data: Measurements, twists, q, seen):
    """Errors of one measurement `seen`: position (m) and rotation (rad) of the frame (6,), or positions of the markers (3 k,)."""
    scene = change_scene(mechanism, twists)
    pose = data.base @ se3.exp(twists[0]) @ frame_pose(scene.system, q, mechanism.frame)
    pose = pose @ data.tool @ se3.exp(twists[mechanism.tool])
    if data.poses is None:
        return (data.markers @ pose[:3, :3].T + pose[None, :3, 3] - seen).reshape(-1)
    return jnp.concatenate([pose[:3, 3] - seen[:3, 3], so3.log(seen[:3, :3].T @ pose[:3, :3])])


@eqx.filter_jit
def _close_step(mechanism: Mechanism, twists, q):
    """Residuals of the loops (n, r) and their Jacobian (n, r, passive) by the joints that are not measured."""
    scene, passive = change_scene(mechanism, twists), np.array(mechanism.passive, int)

    def residual(x, q):
        value = position_residual(scene, q.at[passive].set(x))
        return value, value

    jacobian, value = jax.vmap(jax.jacfwd(residual, has_aux=True))(q[:, passive], q)
    return value, jacobian


def close_loops(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    """Configurations (n, nq) whose joints that are not measured close the loops.

    **Raises:** ValueError for a pose where they cannot be closed, and for loops with more rows than these joints can close.
    """
    q, is_closed, gap = solve_loops(mechanism, np.zeros((len(mechanism.places), 6)), q)
    if not is_closed.all():
        pose = int(np.argmax(gap))
        raise ValueError(f"pose {pose}: the loops stay open by {gap[pose]:.3g}; check q and the geometry")
    return q


def solve_loops(mechanism: Mechanism, twists: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Best configurations (n, nq) of Newton's method on the loops, whether they are closed (n,), and by how much open (n,)."""
    best, gap, passive = q, np.full(len(q), np.inf if mechanism.loops else 0.0), np.array(mechanism.passive, int)
    for _ in range(_CLOSING if mechanism.loops else 0):
        value, jacobian = (np.asarray(x) for x in _close_step(mechanism, jnp.asarray(twists), jnp.asarray(q)))
        if value.shape[1] != len(passive):
            raise ValueError(
                f"the loops have {value.shape[1]} rows for {len(passive)} joints that are not measured; as many are needed: "
                "name other joints in measured, or close planar loops with in_plane=True"
            )
        size = np.abs(value).max(axis=1)
        # Closed loops are improved until rounding hides it.
        is_settled = gap.max() < _CLOSED and not (size < gap / 2).any()
        best, gap = np.where((size < gap)[:, None], q, best), np.minimum(size, gap)
        if is_settled:
            break
        # The floor on the singular values, and the bound of 1 (rad, m), keep steps near a dead point finite.
        step = np.einsum("nij,nj->ni", np.linalg.pinv(jacobian, rcond=_ZERO), value)
        q = q.copy()
        q[:, passive] -= step / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1.0)
    return best, gap < _CLOSED, gap


@eqx.filter_jit
def _derivatives(mechanism: Mechanism, data: Measurements, directions, y, q, seen):
    passive = np.array(mechanism.passive, int)

    def twists(y):
        return (directions @ y).reshape(-1, 6)

    def one(q, seen):
        def both(y, x):
            at = q.at[passive].set(x)
            errors = tip_errors(mechanism, data, twists(y), at, seen)
            closure = position_residual(change_scene(mechanism, twists(y)), at) if mechanism.loops else jnp.zeros(0)
            return (errors, closure), errors

        return jax.jacfwd(both, (0, 1), has_aux=True)(y, q[passive])

    return jax.vmap(one)(q, seen)


def linearise(mechanism: Mechanism, data: Measurements, directions: np.ndarray, y: np.ndarray, q: np.ndarray):
    """Configurations on the loops, errors (n, k), and their Jacobian (n, k, w) by y, with twists = directions y.

    Errors of poses whose loops stay open are NaN.
    """
    q, is_closed, _ = solve_loops(mechanism, (directions @ y).reshape(-1, 6), q)
    seen = data.positions if data.poses is None else data.poses
    arrays = (jnp.asarray(x, mechanism.model.home.dtype) for x in (directions, y, q, seen))
    ((by_y, by_q), (loops_by_y, loops_by_q)), errors = jax.tree.map(np.asarray, _derivatives(mechanism, data, *arrays))
    if mechanism.loops:
        # On the loops dq = -(d closure / d q)^-1 (d closure / d y) dy.
        by_y = by_y - by_q @ (np.linalg.pinv(loops_by_q, rcond=_ZERO) @ loops_by_y)
    return q, np.where(is_closed[:, None], errors, np.nan), by_y


def free_directions(mechanism: Mechanism, parts: Sequence[str]) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names (w,) of the free numbers, the twists (6 places, w) of their unit changes, and these units (w,), rad and m.

    **Raises:** ValueError for parts that are unknown, repeated or none.
    """
    if isinstance(parts, str) or not parts or set(parts) - set(PARTS) or len(set(parts)) < len(parts):
        raise ValueError(f"free is {parts!r}; give some of {PARTS}, each once")
    names, columns, units = [], [], []

    def add(place: int, name: str, twist: np.ndarray, unit: float) -> None:
        column = np.zeros((len(mechanism.places), 6))
        column[place] = unit * twist
        names.append(name)
        columns.append(column.reshape(-1))
        units.append(unit)

    size, screws = mechanism.size, np.asarray(mechanism.model.screws, np.float64)
    for place, name in enumerate(mechanism.places):
        if 0 < place < mechanism.tool:
            screw = screws[mechanism.bodies[place - 1]]
            turns = bool(np.linalg.norm(screw[3:]) > 0)
            axis = screw[3:] if turns else screw[:3]
            across = perpendicular_basis(axis).T
            if "offsets" in parts:
                add(place, f"{name} offset", screw, 1.0 if turns else size)
            if "axes" in parts:
                # Turns of a prismatic joint about its own direction belong to the next joint's axis: they are in its home too.
                tilts = across if turns else [*across, axis]
                for k, tilt in enumerate(tilts, 1):
                    add(place, f"{name} tilt{k}", np.concatenate([np.zeros(3), tilt]), 1.0)
            if "lengths" in parts:
                for label, shift in zip("xyz" if turns else "12", np.eye(3) if turns else across, strict=True):
                    add(place, f"{name} shift {label}", np.concatenate([shift, np.zeros(3)]), size)
        elif (name if place <= mechanism.tool else "lengths") in parts:
            for k, label in enumerate(("shift x", "shift y", "shift z", "turn x", "turn y", "turn z")):
                add(place, f"{name} {label}", np.eye(6)[k], size if k < 3 else 1.0)
    return tuple(names), np.stack(columns, axis=1), np.array(units)


def redundant_directions(mechanism: Mechanism, markers: np.ndarray | None) -> np.ndarray:
    """Twists (6 places, d) that change no pose of the frame of a chain, or of `markers` (k, 3) in it: a basis in closed form."""
    model, tool = mechanism.model, mechanism.tool
    home = np.asarray(model.home, np.float64)
    frame = frame_index(model, mechanism.frame)
    tip = model.topology.frame_bodies[frame]
    columns = []
    for place, body in enumerate((-1, *mechanism.bodies)):
        # The frame of a body may move by what commutes with its joint; the world is the body of the base, without a joint.
        commuting = np.eye(6) if body < 0 else null_space(np.asarray(se3.ad(model.screws[body]), np.float64))
        for twist in commuting.T:
            column = np.zeros((len(mechanism.places), 6))
            column[place] = twist
            # exp(-zeta) H = H exp(-Ad(H^-1) zeta) for each pose H that the body carries.
            for k, child in enumerate(mechanism.bodies, 1):
                if model.topology.parents[child] == body:
                    column[k] -= host_math.adjoint(host_math.inverse(home[child])) @ twist
            if body == tip:
                pose = np.asarray(model.frame_poses, np.float64)[frame]
                column[tool] -= host_math.adjoint(host_math.inverse(pose)) @ twist
            columns.append(column.reshape(-1))
    if markers is not None:
        # Velocities v + omega x r of the markers: zero for turns about the one marker, or about the line of two.
        rows = np.concatenate([np.concatenate([np.eye(3), -host_math.hat(r)], axis=1) for r in markers])
        for twist in null_space(rows).T:
            column = np.zeros((len(mechanism.places), 6))
            column[tool] = twist
            columns.append(column.reshape(-1))
    return np.stack(columns, axis=1)


def null_coordinates(directions: np.ndarray, redundant: np.ndarray) -> np.ndarray:
    """Orthonormal coordinates (w, d) of the free directions (m, w) whose twists are redundant ones (m, k)."""
    basis = np.linalg.svd(redundant, full_matrices=False)
    # What of each direction lies outside of the redundant twists.
    span = basis.U[:, basis.S > _ZERO * basis.S.max(initial=0.0)]
    return null_space(directions - span @ (span.T @ directions))


def null_space(matrix: np.ndarray) -> np.ndarray:
    """Orthonormal basis (n, d) of the null space of a matrix (m, n)."""
    _, s, Vt = np.linalg.svd(matrix)
    return Vt[int(np.sum(s > _ZERO * s.max(initial=0.0))) :].T


def nearest_motion(points: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Rigid motion (4, 4) that brings points (n, 3) nearest to others (Kabsch 1976)."""
    centre, other = points.mean(axis=0), seen.mean(axis=0)
    U, _, Vt = np.linalg.svd((seen - other).T @ (points - centre))
    # The last column's sign makes it a rotation, and no reflection.
    rotation = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return np.asarray(host_math.pose_of(rotation, other - rotation @ centre))


def check_configurations(mechanism: Mechanism, q) -> np.ndarray:
    """Configurations (n, nq) as an array. **Raises:** ValueError for other shapes and numbers that are not finite."""
    return _check_rows(q, "q", (None, mechanism.model.nq), "a row for each pose")


def check_measurements(count: int, poses, positions, markers) -> Measurements:
    """Measurements as arrays, with base and tool at the identity. **Raises:** ValueError as `fit_geometry`."""
    if (poses is None) == (positions is None):
        raise ValueError("give poses (n, 4, 4), or positions (n, 3) of markers: one of them")
    if poses is not None:
        if markers is not None:
            raise ValueError("markers are given with poses; they belong to positions")
        T = _check_rows(poses, "poses", (count, 4, 4), f"as q has {count} rows")
        off = np.abs(np.swapaxes(T[:, :3, :3], 1, 2) @ T[:, :3, :3] - np.eye(3)).max(axis=(1, 2))
        off = np.maximum(off, np.abs(T[:, 3] - [0, 0, 0, 1]).max(axis=1)) + 9 * (np.linalg.det(T[:, :3, :3]) < 0)
        if off.max() > 1e-4:
            row = int(np.argmax(off))
            raise ValueError(
                f"poses[{row}] is no pose: its rotation is off by {off[row]:.3g}; give rigid motions (4, 4), m"
            )
        return Measurements(T, T[:, None, :3, 3], np.zeros((1, 3)), np.eye(4), np.eye(4))
    points = np.zeros((1, 3)) if markers is None else check_markers(markers)
    seen = np.array(as_array(positions, "positions"), np.float64)
    wanted, why = (count, len(points), 3), f"as q has {count} rows, and markers {len(points)}"
    seen = _check_rows(seen[:, None] if seen.ndim == 2 else seen, "positions", wanted, why)
    return Measurements(None, seen, points, np.eye(4), np.eye(4))


def check_markers(markers) -> np.ndarray:
    """Markers (k, 3) as an array. **Raises:** ValueError for other shapes and numbers that are not finite."""
    return _check_rows(np.atleast_2d(np.array(as_array(markers, "markers"), np.float64)), "markers", (None, 3), "m")


def _check_rows(values, name: str, shape: tuple[int | None, ...], why: str) -> np.ndarray:
    """Array (float64) of a shape with any number of rows where that is None, and at least one."""
    array = np.array(as_array(values, name), np.float64)
    if array.ndim != len(shape) or array.shape[1:] != shape[1:] or len(array) != (shape[0] or max(len(array), 1)):
        wanted = ", ".join("n" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} has shape {array.shape}; give finite numbers of shape ({wanted}), {why}")
    bad = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
    if bad.size:
        raise ValueError(
            f"{name}[{bad[0]}] has numbers that are not finite; leave out this row everywhere, or measure it"
        )
    return array
