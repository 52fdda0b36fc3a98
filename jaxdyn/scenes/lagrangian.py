"""Elementary systems: particles, pendulums, arms, a body that turns freely, a box, a sliding block."""

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from jaxdyn.compile.known import array_namespace
from jaxdyn.constraints import Holonomic
from jaxdyn.contact.unilateral import DryFriction
from jaxdyn.model.arguments import Checked, Number, Numbers, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.inertia import box, displaced
from jaxdyn.scenes._named import as_leaf, as_state, register_scene
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import MetricSystem


def _state(position, velocity):
    return as_leaf(position), as_leaf(velocity)


def _particle_start(position: Row = (0.0, 0.0), velocity: Row = (1.0, 2.0)) -> tuple[Array, Array]:
    return _state(position, velocity)


def _quadratic(q, v, t, p):
    return 0.5 * p["mass"] * jnp.sum(v * v)


def _height_energy(q, t, p):
    # The last coordinate is up.
    return p["mass"] * p["gravity"] * q[-1]


@register_scene(_particle_start)
def particle_in_plane(*, mass: Number = 1.0, gravity: Number = 9.81) -> Scene:
    """Particle in x and y (up): m xdd = F_x, m ydd = F_y - m g.

    Source: EQUATIONS section 1.
    """
    parameters = {"mass": mass, "gravity": gravity}
    return Scene(LagrangianSystem(_quadratic, 2, parameters=parameters, potential=_height_energy))


def _pendulum_start(angle: Number = -np.pi / 2, rate: Number = 0.0) -> tuple[Array, Array]:
    return _state([angle], [rate])


def _swing(q, v, t, p):
    return 0.5 * p["mass"] * p["length"] ** 2 * v[0] ** 2


def _swing_potential(q, t, p):
    return p["mass"] * p["gravity"] * p["length"] * (1 - jnp.cos(q[0]))


@register_scene(_pendulum_start)
def pendulum(*, mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81) -> Scene:
    """Pendulum by its angle from the downward vertical: m l^2 thetadd + m g l sin(theta) = tau.

    Without tau, sin(theta/2) = k sn(K(k) - w0 t), w0^2 = g/l, from rest at theta = -2 arcsin k. Start: `angle`, `rate`;
    by default problem A01 of the IFToMM benchmark library.

    Source: EQUATIONS section 1.
    """
    parameters = {"mass": mass, "length": length, "gravity": gravity}
    return Scene(LagrangianSystem(_swing, 1, parameters=parameters, potential=_swing_potential))


def _sphere_start(
    theta: Number = 1.0, phi: Number = 0.0, theta_rate: Number = 0.0, phi_rate: Number = 1.0
) -> tuple[Array, Array]:
    return _state([theta, phi], [theta_rate, phi_rate])


def _sphere(q, v, t, p):
    return 0.5 * p["mass"] * p["length"] ** 2 * (v[0] ** 2 + jnp.sin(q[0]) ** 2 * v[1] ** 2)


def _sphere_potential(q, t, p):
    return -p["mass"] * p["gravity"] * p["length"] * jnp.cos(q[0])


@register_scene(_sphere_start)
def spherical_pendulum_in_angles(*, mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81) -> Scene:
    """Spherical pendulum by theta from the downward vertical and phi about it; m l^2 sin^2(theta) phid is conserved.

    Singular at sin(theta) = 0; `spherical_pendulum` is not.

    Source: EQUATIONS section 1 and erratum E1.
    """
    parameters = {"mass": mass, "length": length, "gravity": gravity}
    return Scene(LagrangianSystem(_sphere, 2, parameters=parameters, potential=_sphere_potential))


def _rod(length, q, t):
    """Constraint (|q|^2 - length^2) / 2, so that A = q^T and the tension is -lam length."""
    # Squares instead of |q| - l: the rows stay defined at q = 0, where |q| has no derivative.
    return 0.5 * (jnp.sum(q * q) - length.astype(q.dtype) ** 2)


def _particle(q, v, t, p):
    return 0.5 * p["mass"] * jnp.sum(v * v) - p["mass"] * p["gravity"] * q[-1]


def _on_rod(dimension: int, mass, length, gravity) -> Scene:
    system = LagrangianSystem(_particle, dimension, parameters={"mass": mass, "gravity": gravity})
    return Scene(system, (Holonomic(Partial(_rod, as_leaf(length)), name="rod"),))


def _plane_start(length: Number = 1.0, angle: Number = -np.pi / 2, rate: Number = 0.0) -> tuple[Array, Array]:
    s, c = array_namespace(angle).sin(angle), array_namespace(angle).cos(angle)
    # The length multiplies arrays, so that it may be traced.
    return length * as_state([s, -c]), length * rate * as_state([c, s])


@register_scene(_plane_start)
def pendulum_in_plane(*, mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81) -> Scene:
    """Plane pendulum in x and y (up): L = m |v|^2/2 - m g y, phi = (x^2 + y^2 - l^2)/2.

    lam = -(m/l^2)(|v|^2 - g y); the tension of the rod is -l lam. Start: `angle` from the downward vertical and `rate`;
    by default problem A01 of the IFToMM benchmark library, x = -1, at rest.

    Source: EQUATIONS section 6, with the sign of the multiplier on the right.
    """
    return _on_rod(2, mass, length, gravity)


def _spherical_start(
    length: Number = 1.0, theta: Number = 1.0, phi: Number = 0.0, theta_rate: Number = 0.0, phi_rate: Number = 1.0
) -> tuple[Array, Array]:
    xp = array_namespace(theta, phi)
    s, c, sp, cp = xp.sin(theta), xp.cos(theta), xp.sin(phi), xp.cos(phi)
    q = length * jnp.asarray([s * cp, s * sp, -c])
    # The derivative of the position with respect to the angles, so the velocity is on the constraint.
    along = theta_rate * jnp.asarray([c * cp, c * sp, s]) + phi_rate * s * jnp.asarray([-sp, cp, 0.0])
    return q, length * along


@register_scene(_spherical_start)
def spherical_pendulum(*, mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81) -> Scene:
    """Spherical pendulum in x, y and z (up): L = m |v|^2/2 - m g z, phi = (|q|^2 - l^2)/2.

    lam = (m/l^2)(g z - |v|^2). Start by angles: theta from the downward vertical, phi about it.

    Source: EQUATIONS sections 1 and 7.
    """
    return _on_rod(3, mass, length, gravity)


def _arm_start(angles: Row = (0.3, 1.1), rates: Row = (0.7, -0.4)) -> tuple[Array, Array]:
    return _state(angles, rates)


def _arm(q, v, t, p):
    # Velocities of the centres need the absolute angles; the second coordinate is relative.
    a, b = q[0], q[0] + q[1]
    wa, wb = v[0], v[0] + v[1]
    across = lambda at: jnp.stack([-jnp.sin(at), jnp.cos(at)])  # noqa: E731
    elbow = p["length"] * wa * across(a)
    speeds = p["reaches"][0] * wa * across(a), elbow + p["reaches"][1] * wb * across(b)
    turning = p["moments"][0] * wa**2 + p["moments"][1] * wb**2
    return 0.5 * (sum(p["masses"][i] * jnp.sum(speeds[i] ** 2) for i in range(2)) + turning)


def _arm_potential(q, t, p):
    upper, lower = jnp.sin(q[0]), jnp.sin(q[0] + q[1])
    heights = p["reaches"][0] * upper, p["length"] * upper + p["reaches"][1] * lower
    return p["gravity"] * sum(p["masses"][i] * heights[i] for i in range(2))


@register_scene(_arm_start)
def planar_arm(
    *,
    masses: Row = (1.0, 0.8),
    length: Number = 1.0,
    reaches: Row = (0.5, 0.4),
    moments: Row = (0.1, 0.05),
    gravity: Number | None = None,
) -> Scene:
    """Planar arm with two revolute joints, q = (th1, th2), th1 from the x axis and th2 relative to the first link.

    M = [[alpha + 2 beta c2, delta + beta c2], [delta + beta c2, delta]] with alpha = I1 + I2 + m1 r1^2 + m2 (l1^2 + r2^2),
    beta = m2 l1 r2, delta = I2 + m2 r2^2. `reaches`, joint to centre of mass, and `length` of the first link, m; `moments`
    about z at the centres, kg m^2. `gravity` along -y (m/s^2); None is a horizontal plane.

    Source: EQUATIONS section 1.
    """
    parameters = {"masses": masses, "length": length, "reaches": reaches, "moments": moments}
    potential = None
    if gravity is not None:
        # Without gravity neither a parameter nor a potential is there to be compiled.
        parameters, potential = parameters | {"gravity": gravity}, _arm_potential
    return Scene(LagrangianSystem(_arm, 2, parameters=parameters, potential=potential))


def _spatial_start(angles: Row = (0.3, 0.4, -0.7), rates: Row = (0.5, -0.6, 0.8)) -> tuple[Array, Array]:
    return _state(angles, rates)


@register_scene(_spatial_start)
def spatial_arm(
    *,
    lengths: Row = (0.5, 0.4),
    reaches: Row = (0.2, 0.25, 0.15),
    masses: Row = (3.0, 2.0, 1.0),
    moments: Row = ((0.01, 0.02, 0.03), (0.03, 0.01, 0.04), (0.02, 0.015, 0.025)),
    gravity: Number = 9.81,
) -> Scene:
    """Arm with a yaw and two parallel pitch axes, its links along +y at zero, z up; positive pitch angles lower it.

    `lengths` of base and upper arm, `reaches` from each joint to the centre of mass, m; `moments` (Ix, Iy, Iz) of each
    link about it. The frames "centre1" to "centre3" stand at the centres of mass.

    Source: EQUATIONS section 1 with errata E3 to E7.
    """
    base, upper = lengths
    builder = ModelBuilder("spatial arm", gravity=(0.0, 0.0, -gravity))
    centres = ((0.0, 0.0, reaches[0]), (0.0, reaches[1], 0.0), (0.0, reaches[2], 0.0))
    places = ((0.0, 0.0, 0.0), (0.0, 0.0, base), (0.0, upper, 0.0))
    for i, parent in enumerate((None, "link1", "link2")):
        # The pitch axes are -x: with the links along +y a positive angle lowers them.
        name, axis = f"link{i + 1}", (0.0, 0.0, 1.0) if i == 0 else (-1.0, 0.0, 0.0)
        builder.add_body(name, parent, inertia=(masses[i], centres[i], moments[i]), pose=places[i], axis=axis)
        builder.add_frame(f"centre{i + 1}", name, centres[i])
    return Scene(builder.build())


def _free_start(rates: Row = (0.3, 0.8, -0.5)) -> tuple[Array, Array]:
    return as_state([1.0, 0.0, 0.0, 0.0]), as_leaf(rates)


@register_scene(_free_start)
def free_body(*, moments: Row = (1.0, 2.0, 3.0)) -> Scene:
    """Rigid body that turns freely about its centre of mass: I w' = (I w) x w, by Jacobi's elliptic functions.

    q = (w, x, y, z), a unit quaternion, v = angular velocity in the body's axes, principal ones; `moments`, kg m^2.
    Start: turned by nothing, with body `rates` (rad/s).

    Source: Celledoni, Fasso, Safstrom & Zanna (2008), The exact computation of the free rigid body motion.
    """
    builder = ModelBuilder("free body", gravity=None)
    # The mass at the fixed point has no effect without gravity.
    builder.add_body("body", None, "spherical", (1.0, (0.0, 0.0, 0.0), tuple(moments)))
    return Scene(builder.build())


def _euler_start(angles: Row = (0.4, 1.1, -0.3), rates: Row = (0.5, -0.8, 1.3)) -> tuple[Array, Array]:
    return _state(angles, rates)


def _body_rates(q):
    """Matrix E with w = E qd, body-fixed, for R = Rz(phi) Ry(theta) Rz(psi)."""
    s, c, sp, cp = jnp.sin(q[1]), jnp.cos(q[1]), jnp.sin(q[2]), jnp.cos(q[2])
    zero, one = jnp.zeros_like(s), jnp.ones_like(s)
    return jnp.stack([jnp.stack([-s * cp, sp, zero]), jnp.stack([s * sp, cp, zero]), jnp.stack([c, zero, one])])


def _euler_metric(q, t, p):
    E = _body_rates(q)
    # E^T diag(I) E, with the rows of E scaled instead of a matrix product.
    return E.T @ (jnp.stack(p["moments"])[:, None] * E)


@register_scene(_euler_start)
def rigid_body_in_euler_angles(*, moments: Row = (1.0, 2.0, 3.0)) -> Scene:
    """Body that turns freely about its centre, q = (phi, theta, psi) with R = Rz(phi) Ry(theta) Rz(psi): a geodesic.

    The metric is rho = E^T diag(I1, I2, I3) E with w = E qd in body axes; tau are the torques about the Euler axes,
    E^T of those in body axes. Singular at sin(theta) = 0; a `Model` with a spherical joint is not.

    Source: EQUATIONS section 12 with errata E50 to E52.
    """
    return Scene(MetricSystem(_euler_metric, 3, parameters={"moments": moments}))


def _box_start(
    position: Row = (0.0, 0.0, 0.0),
    orientation: Row = (1.0, 0.0, 0.0, 0.0),
    velocity: Row = (0.0,) * 3,
    turning: Row = (0.1, 4.0, 0.2),
) -> tuple[Array, Array]:
    return _state((*position, *orientation), (*velocity, *turning))


@register_scene(_box_start)
def free_box(
    *, mass: Number = 1.0, size: Row = (0.3, 0.2, 0.1), frame: Numbers | None = None, gravity: Number | None = None
) -> Scene:
    """Box in free motion, its edges `size` (3,) along x, y, z: M = diag(m, m, m, Ix, Iy, Iz), Ix = m (y^2 + z^2)/12.

    `frame` (4, 4): pose of the body's frame in that of the centre, which makes it M' = Ad^T M Ad; None for the centre.
    The start, `position` and `orientation` of the frame and its body twist, turns about the middle axis, which is unstable.
    `gravity` along -z (m/s^2); None for none.

    Source: EQUATIONS section 1.
    """
    numbers = box(mass, size)
    if frame is not None:
        pose = array_namespace(frame).asarray(frame, float)
        rotation, place = pose[:3, :3], pose[:3, 3]
        # Parameters transform by the pose of the centre in the new frame, the inverse of `frame`.
        numbers = displaced(numbers, -rotation.T @ place, rotation.T)
    builder = ModelBuilder("box", gravity=None if gravity is None else (0.0, 0.0, -gravity))
    return Scene(builder.add_body("box", None, "free", numbers).build())


def _block_start(position: Number = 0.0, velocity: Number = 2.0) -> tuple[Array, Array]:
    return _state([position], [velocity])


def _block(q, v, t, p):
    return 0.5 * p["mass"] * v[0] ** 2


@register_scene(_block_start)
def sliding_block(
    *,
    mass: Number = 1.0,
    friction: Number = 0.3,
    static: Checked[Number | None] = None,
    gravity: Number = 9.81,
) -> Scene:
    """Block that slides on a table with Coulomb friction, m xdd = u - sign(xd) mu m g, and sticks for |u| <= `static` m g.

    Without u it stops after |v0| / (mu g), v0^2 / (2 mu g) further on, where it sticks (`jd.contact.DryFriction`, whose events
    say when). `static`: None for the coefficient of sliding. `jd.forces.SlidingFriction` is friction that does not stick.

    Source: EQUATIONS section 11 and erratum E42.
    """
    system = LagrangianSystem(_block, 1, parameters={"mass": mass})
    return Scene(system, forces=(DryFriction(friction, mass * gravity, 0, static=static),))
