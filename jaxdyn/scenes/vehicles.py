"""Vehicles on wheels that roll without slipping, or on blades, built from their bodies."""

import numpy as np
from jaxtyping import Array

from jaxdyn.compile.known import array_namespace
from jaxdyn.constraints import knife_edge, rolling_wheel
from jaxdyn.model.arguments import Number, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_state, flat_moments, register_scene
from jaxdyn.systems.scene import Scene

_AXLE = (np.zeros(3), (-np.pi / 2, 0.0, 0.0))  # z of the wheel along y of the body


def _bicycle_start(
    speed: Number = 4.6,
    roll_rate: Number = 0.0,
    steer_rate: Number = 0.0,
    wheel_base: Number = 1.02,
    trail: Number = 0.08,
    tilt: Number = np.pi / 10,
    rear_radius: Number = 0.3,
    front_radius: Number = 0.35,
) -> tuple[Array, Array]:
    # The steer axis points down, so steering turns the front wheel's contact, behind the axis, to the left.
    yaw_rate = -trail * array_namespace(tilt).cos(tilt) / wheel_base * steer_rate
    q = [0.0, 0.0, rear_radius, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    v = [speed, -rear_radius * roll_rate, 0.0, roll_rate, 0.0, yaw_rate]
    return as_state(q), as_state([*v, speed / rear_radius, steer_rate, speed / front_radius])


@register_scene(_bicycle_start)
def bicycle(
    *,
    wheel_base: Number = 1.02,
    trail: Number = 0.08,
    tilt: Number = np.pi / 10,
    rear_radius: Number = 0.3,
    front_radius: Number = 0.35,
    rear_wheel: Row = (2.0, (0.0603, 0.12, 0.0603)),
    rear_frame: Row = (85.0, (0.3, 0.0, 0.9), (9.2, 11.0, 2.8, -2.4)),
    front_frame: Row = (4.0, (0.9, 0.0, 0.7), (0.05892, 0.06, 0.00708, 0.00756)),
    front_wheel: Row = (3.0, (0.1405, 0.28, 0.1405)),
    gravity: Number = 9.81,
) -> Scene:
    """Bicycle on level ground, without rider or with a rigid one: Whipple's model, by default the benchmark's.

    Bodies: the rear frame (free, with its origin at the rear wheel's centre), the rear wheel, the front frame on the
    steer axis, the front wheel. Upright and straight the axes are x forward, y left, z up. q = (the free joint,
    rear wheel, steer, front wheel); the steer axis points down, so that a positive steer angle turns right, as a
    positive roll leans right.

    **Arguments:** `wheel_base`, `trail` (m) and `tilt` (rad) of the steer axis from the vertical, which passes
    through the ground at wheel_base + trail; `rear_radius`, `front_radius`, m, of the wheels; `rear_wheel`, `front_wheel`:
    (mass, (Ixx, Iyy, Izz)), kg and kg m^2; `rear_frame`, `front_frame`: (mass, centre of mass from the rear contact, (Ixx, Iyy,
    Izz, Ixz)), kg, m and kg m^2, upright and straight.

    Start: upright and straight at `speed` (m/s), with `roll_rate` and `steer_rate` (rad/s) that the wheels allow.

    Source: Meijaard, Papadopoulos, Ruina & Schwab (2007), table 1; there z points down.
    """
    xp = array_namespace(wheel_base, trail, tilt, rear_radius, front_radius, rear_frame, front_frame)
    hub = xp.asarray([0.0, 0.0, rear_radius])
    axis = xp.asarray([xp.sin(tilt), 0.0, -xp.cos(tilt)])
    # A point of the steer axis close to the front wheel: its foot on the ground, moved up to the height of the axle.
    head = xp.asarray([wheel_base + trail, 0.0, 0.0]) - front_radius / xp.cos(tilt) * axis
    axle = xp.asarray([wheel_base, 0.0, front_radius])

    def frame(numbers, origin):
        mass, center, (xx, yy, zz, xz) = numbers
        # The publication gives centres from the rear contact, a body wants them from its own origin.
        return mass, xp.asarray(center, float) - origin, [[xx, 0.0, xz], [0.0, yy, 0.0], [xz, 0.0, zz]]

    def wheel(numbers):
        mass, moments = numbers
        return mass, (0.0, 0.0, 0.0), moments

    builder = ModelBuilder("bicycle", gravity=(0.0, 0.0, -gravity))
    builder.add_body("rear frame", None, "free", frame(rear_frame, hub), joint_name="base")
    turning = {"joint": "continuous", "axis": (0.0, 1.0, 0.0)}
    builder.add_body("rear wheel", "rear frame", inertia=wheel(rear_wheel), joint_name="rear wheel", **turning)
    front = {"inertia": frame(front_frame, head), "pose": head - hub, "axis": axis}
    builder.add_body("front frame", "rear frame", "continuous", joint_name="steer", **front)
    hanging = {"inertia": wheel(front_wheel), "pose": axle - head}
    builder.add_body("front wheel", "front frame", joint_name="front wheel", **hanging, **turning)
    rolling = [
        rolling_wheel("rear wheel", _AXLE, rear_radius, name="rear contact"),
        rolling_wheel("front wheel", _AXLE, front_radius, name="front contact"),
    ]
    return Scene(builder.build(), rolling)


def _drive_start(
    speed: Number = 0.5, yaw_rate: Number = 0.4, radius: Number = 0.1, half_track: Number = 0.25
) -> tuple[Array, Array]:
    speed_difference = yaw_rate * half_track
    spins = [(speed - speed_difference) / radius, (speed + speed_difference) / radius]
    return as_state(np.zeros(5)), as_state([speed, 0.0, yaw_rate, *spins])


def _add_wheel(builder, name, parent, mass, radius, place):
    """Add a wheel, a uniform disk, that rotates about the y axis of its parent."""
    moment = 0.5 * mass * radius**2
    disk = (mass, (0.0, 0.0, 0.0), (0.5 * moment, moment, 0.5 * moment))
    builder.add_body(name, parent, "continuous", disk, pose=place, axis=(0.0, 1.0, 0.0))


def _add_chassis(builder, mass, moment, offset, wheel_mass, radius, half_track, where):
    """Add a chassis with two wheels on one axle; the constraints of the wheels, whose names begin with `where`."""
    chassis = (mass, (offset, 0.0, 0.0), (moment, moment, moment))
    builder.add_body("chassis", None, "planar", chassis, pose=(0.0, 0.0, radius))
    left, right = f"{where}left wheel", f"{where}right wheel"
    _add_wheel(builder, left, "chassis", wheel_mass, radius, (0.0, half_track, 0.0))
    _add_wheel(builder, right, "chassis", wheel_mass, radius, (0.0, -half_track, 0.0))
    # Both wheels on one axle forbid the same sideways slip: one such row is enough.
    rolling = rolling_wheel(left, _AXLE, radius, contact=False)
    return [rolling, rolling_wheel(right, _AXLE, radius, contact=False, lateral=False)]


@register_scene(_drive_start)
def differential_drive(
    *,
    mass: Number = 8.0,
    moment: Number = 0.3,
    offset: Number = 0.05,
    wheel_mass: Number = 0.5,
    radius: Number = 0.1,
    half_track: Number = 0.25,
) -> Scene:
    """Mobile robot with two driven wheels on one axle, on a level floor; a castor without friction holds it up.

    q = (x, y, heading, left, right wheel angle), of the axle's middle; tau = (0, 0, 0, left, right motor torque).
    `mass` (kg) and `moment` (kg m^2, about its centre) of the chassis, its centre `offset` (m) ahead of the axle.
    With m = mass + 2 wheels, J a wheel's moment, b the half track, r the radius, I the moment about the axle's middle:

        (m + 2 J/r^2) vdot - mass offset w^2 = (tau_l + tau_r)/r
        (I + 2 J b^2/r^2) wdot + mass offset v w = (tau_r - tau_l) b/r

    Start: `speed` (m/s) and `yaw_rate` (rad/s).
    """
    builder = ModelBuilder("differential drive", gravity=None)
    rolling = _add_chassis(builder, mass, moment, offset, wheel_mass, radius, half_track, "")
    return Scene(builder.build(), rolling)


def _car_start(
    speed: Number = 2.0,
    steer: Number = 0.2,
    steer_rate: Number = 0.0,
    radius: Number = 0.15,
    half_track: Number = 0.4,
    wheel_base: Number = 1.2,
) -> tuple[Array, Array]:
    xp = array_namespace(steer)
    # The circle about the intersection of the two axles has the radius wheel_base / tan(steer).
    yaw_rate = speed * xp.tan(steer) / wheel_base
    speed_difference = yaw_rate * half_track
    spins = [
        (speed - speed_difference) / radius,
        (speed + speed_difference) / radius,
        steer_rate,
        speed / xp.cos(steer) / radius,
    ]
    return as_state([0.0, 0.0, 0.0, 0.0, 0.0, steer, 0.0]), as_state([speed, 0.0, yaw_rate, *spins])


@register_scene(_car_start)
def car(
    *,
    mass: Number = 60.0,
    moment: Number = 12.0,
    offset: Number = 0.5,
    fork_moment: Number = 0.2,
    wheel_mass: Number = 2.0,
    radius: Number = 0.15,
    half_track: Number = 0.4,
    wheel_base: Number = 1.2,
) -> Scene:
    """Car-like robot on a level floor: two wheels on the rear axle that turn freely, a steered wheel in front.

    q = (x, y, heading, left, right wheel, steer, front wheel angle), of the rear axle's middle. `mass` (kg) and
    `moment` (kg m^2, about its centre) of the chassis, its centre `offset` (m) ahead of the rear axle;
    `fork_moment` of the fork about the steer axis, which is vertical and carries the front wheel's centre.
    With the steer angle held it drives on a circle of radius wheel_base / tan(steer).

    Start: `speed` of the rear axle's middle (m/s), `steer` angle (rad) and `steer_rate` (rad/s).

    Source: Murray & Sastry (1993), Nonholonomic motion planning, for the rows xdot sin(theta + phi) - ydot
    cos(theta + phi) - thetadot l cos(phi) = 0 and xdot sin(theta) - ydot cos(theta) = 0.
    """
    builder = ModelBuilder("car", gravity=None)
    rolling = _add_chassis(builder, mass, moment, offset, wheel_mass, radius, half_track, "rear ")
    fork = (0.0, (0.0, 0.0, 0.0), flat_moments(fork_moment))
    # The fork has a moment about the steer axis and no mass.
    builder.add_body("steering", "chassis", "continuous", fork, pose=(wheel_base, 0.0, 0.0))
    # The front wheel has its centre on the steer axis, so that steering does not move it.
    _add_wheel(builder, "front wheel", "steering", wheel_mass, radius, None)
    return Scene(builder.build(), [*rolling, rolling_wheel("front wheel", _AXLE, radius, contact=False)])


def _snakeboard_start(
    speed: Number = 1.0,
    angles: Row = (0.3, -0.2),
    rates: Row = (0.0, 0.0),
    rotor_rate: Number = 1.0,
    half_length: Number = 0.3,
) -> tuple[Array, Array]:
    # A blade lets its truck move along its own direction only, so sideways over forward speed is the tangent.
    front, back = (array_namespace(angle).tan(angle) for angle in angles)
    sideways, yaw_rate = speed * (front + back) / 2, speed * (front - back) / (2 * half_length)
    return as_state([0.0, 0.0, 0.0, *angles, 0.0]), as_state([speed, sideways, yaw_rate, *rates, rotor_rate])


@register_scene(_snakeboard_start)
def snakeboard(
    *,
    mass: Number = 6.0,
    moment: Number = 0.1,
    rotor_moment: Number = 0.16,
    truck_moment: Number = 0.02,
    half_length: Number = 0.3,
) -> Scene:
    """Snakeboard on a level floor: a board with a truck at each end that turns, and a rotor for the rider's body.

    q = (x, y, heading, front truck, back truck, rotor angle), of the board's middle, angles relative to the board.
    `mass` (kg) of the whole, moments (kg m^2) of board, rotor and each truck about their own axes; the trucks' wheels
    are blades at `half_length` (m) from the middle:

        -xdot sin(theta + phi_f) + ydot cos(theta + phi_f) + l thetadot cos(phi_f) = 0
        -xdot sin(theta + phi_b) + ydot cos(theta + phi_b) - l thetadot cos(phi_b) = 0

    Turning rotor and trucks in turn drives it forward. Start: `speed` of the board's middle along the board (m/s),
    truck `angles` (rad) and `rates`, `rotor_rate` (rad/s).

    Source: Ostrowski, Lewis, Murray & Burdick (1994), Nonholonomic mechanics and locomotion: the snakeboard example.
    """

    def turning(moment):
        return 0.0, (0.0, 0.0, 0.0), flat_moments(moment)

    builder = ModelBuilder("snakeboard", gravity=None)
    builder.add_body("board", None, "planar", (mass, (0.0, 0.0, 0.0), flat_moments(moment)))
    for name, joint, place in (("front truck", "1 front", half_length), ("back truck", "2 back", -half_length)):
        # Names of joints give the order of q: front truck, back truck, rotor.
        builder.add_body(name, "board", "continuous", turning(truck_moment), pose=(place, 0.0, 0.0), joint_name=joint)
    builder.add_body("rotor", "board", "continuous", turning(rotor_moment), joint_name="3 rotor")
    # Planar joints hold the board at its height, so the blades need no contact row.
    blades = [knife_edge(name, contact=False) for name in ("front truck", "back truck")]
    return Scene(builder.build(), blades)
