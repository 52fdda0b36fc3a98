"""PyDy: Kane's equations by SymPy, integrated by SciPy's compiled DOP853 and LSODA.

PyDy writes the equations as Cython where that is installed, else as NumPy. Rolling takes no multipliers: speeds that depend
on others are eliminated, as Kane's method does.
"""

import functools
import importlib.util
from collections.abc import Callable

import numpy as np
import pydy
import sympy
from pydy.codegen.ode_function_generators import generate_ode_function
from scipy.spatial.transform import Rotation
from sympy.physics.mechanics import KanesMethod, Point, ReferenceFrame, RigidBody, dynamicsymbols, inertia

from benchmarks.peers.steps import dop853
from jaxdyn.reports.run import Contestant

# Generated code has to have a constant.
MASS = sympy.Symbol("mass")
COMPILED = importlib.util.find_spec("Cython") is not None


def _kane(mass, frame, coordinates, speeds, kinematics, body, loads=(), dependent=(), rows=()):
    """`slope(t, y)` -> dy/dt, y = (coordinates, speeds, dependent speeds), for one `mass`."""
    method = KanesMethod(
        frame, coordinates, speeds, kinematics, u_dependent=list(dependent), velocity_constraints=list(rows)
    )
    method.kanes_equations([body], list(loads))
    rates = generate_ode_function(
        method.forcing_full,
        coordinates,
        [*speeds, *dependent],
        [MASS],
        mass_matrix=method.mass_matrix_full,
        generator="cython" if COMPILED else "lambdify",
        constants_arg_type="array",
    )
    constants = np.array([mass])
    return lambda t, y: rates(y, t, constants)


def _disk(mass=2.0, radius=0.5, steer=0.125, roll=0.25):
    _, _, heading, angle = q = dynamicsymbols("x y heading angle")
    along, across, turn, spin = u = dynamicsymbols("ux uy turn spin")
    space = ReferenceFrame("N")
    steered = space.orientnew("A", "Axis", (heading, space.z))
    disk = steered.orientnew("B", "Axis", (angle, steered.y))
    disk.set_ang_vel(space, turn * space.z + spin * steered.y)
    origin, center = Point("O"), Point("C")
    origin.set_vel(space, 0)
    center.set_vel(space, along * space.x + across * space.y)
    body = RigidBody("disk", center, disk, MASS, (inertia(steered, 0, roll, steer), center))
    rows = [along - radius * sympy.cos(heading) * spin, across - radius * sympy.sin(heading) * spin]
    kinematics = [a.diff() - b for a, b in zip(q, u, strict=True)]
    slope = _kane(mass, space, [*q], [turn, spin], kinematics, body, (), [along, across], rows)
    # Speeds are ordered with the dependent ones at the end.
    there = lambda q, v: (q, v[..., [2, 3, 0, 1]])  # noqa: E731
    return slope, there, lambda y: (y[:, :4], y[:, [6, 7, 4, 5]])


def _sleigh(mass=1.0, moment=0.5, offset=0.3):
    x, y, heading = q = dynamicsymbols("x y heading")
    forward, sideways, turn = dynamicsymbols("forward sideways turn")
    space = ReferenceFrame("N")
    blade = space.orientnew("A", "Axis", (heading, space.z))
    blade.set_ang_vel(space, turn * space.z)
    contact, center = Point("P"), Point("C")
    contact.set_vel(space, forward * blade.x + sideways * blade.y)
    center.set_pos(contact, offset * blade.x)
    center.v2pt_theory(contact, space, blade)
    body = RigidBody("sleigh", center, blade, MASS, (inertia(blade, 0, 0, moment), center))
    c, s = sympy.cos(heading), sympy.sin(heading)
    kinematics = [x.diff() - c * forward + s * sideways, y.diff() - s * forward - c * sideways, heading.diff() - turn]
    slope = _kane(mass, space, [*q], [forward, turn], kinematics, body, (), [sideways], [sideways])
    there = lambda q, v: (q, v[..., [0, 2, 1]])  # noqa: E731
    return slope, there, lambda y: (y[:, :3], y[:, [3, 5, 4]])


def _coin(mass=0.3048, radius=0.05, gravity=9.81):
    """Disk that leans: yaw, lean and spin, and the contact point; speeds are its rates in the axes that do not spin."""
    yaw, lean, spin, x, y = q = dynamicsymbols("yaw lean spin x y")
    a, b, c = u = dynamicsymbols("a b c")
    space = ReferenceFrame("N")
    steered = space.orientnew("Y", "Axis", (yaw, space.z))
    leaning = steered.orientnew("L", "Axis", (lean, steered.x))
    disk = leaning.orientnew("D", "Axis", (spin, leaning.y))
    rates = disk.ang_vel_in(space).express(leaning)
    kinematics = [rates.dot(axis) - speed for axis, speed in zip((leaning.x, leaning.y, leaning.z), u, strict=True)]
    # The contact point runs along the rim as the disk spins against its leaning axes: forward is steered.x.
    kinematics += [x.diff() - radius * spin.diff() * sympy.cos(yaw), y.diff() - radius * spin.diff() * sympy.sin(yaw)]
    solved = sympy.solve(kinematics[:3], [yaw.diff(), lean.diff(), spin.diff()])
    leaning.set_ang_vel(
        space, a * leaning.x + (rates.dot(leaning.y) - spin.diff()).subs(solved) * leaning.y + c * leaning.z
    )
    disk.set_ang_vel(space, a * leaning.x + b * leaning.y + c * leaning.z)
    contact, center = Point("P"), Point("C")
    contact.set_vel(space, 0)
    center.set_pos(contact, radius * leaning.z)
    center.set_vel(space, disk.ang_vel_in(space).cross(radius * leaning.z))
    moments = [k * MASS * radius**2 for k in (0.25, 0.5, 0.25)]
    body = RigidBody("coin", center, disk, MASS, (inertia(leaning, *moments), center))
    slope = _kane(mass, space, [*q], [*u], kinematics, body, [(center, -MASS * gravity * space.z)])

    def there(q, v):
        turned = Rotation.from_quat(np.roll(q[..., 3:], -1, -1))
        yaw, lean, spin = turned.as_euler("ZXY").T
        up = Rotation.from_euler("ZX", np.stack([yaw, lean], -1)).apply([0.0, 0.0, radius])
        rates = Rotation.from_rotvec(spin[..., None] * [0.0, 1.0, 0.0]).apply(v[..., 3:])
        return np.stack([yaw, lean, spin, *(q[..., :2] - up[..., :2]).T], -1), rates

    def back(rows):
        turned = Rotation.from_euler("ZXY", rows[:, :3])
        up = Rotation.from_euler("ZX", rows[:, :2]).apply([0.0, 0.0, radius])
        place = np.concatenate([rows[:, 3:5], np.zeros((len(rows), 1))], 1) + up
        rates = Rotation.from_rotvec(-rows[:, 2:3] * [0.0, 1.0, 0.0]).apply(rows[:, 5:])
        # The centre moves by the body's rates about the contact point.
        arm = turned.inv().apply(up)
        quaternion = np.roll(turned.as_quat(), 1, -1)
        return np.concatenate([place, quaternion], 1), np.concatenate([np.cross(rates, arm), rates], 1)

    return slope, there, back


_BUILT = {"rolling_disk": _disk, "chaplygin_sleigh": _sleigh, "rolling_coin": _coin}


@functools.cache
def _built(name: str) -> tuple[Callable, Callable, Callable]:
    return _BUILT[name]()


def contestants(prepared, starts) -> list[Contestant]:
    """Rungs of DOP853 for one trajectory."""
    if prepared.case.name not in _BUILT or len(starts[0]) > 1:
        return []
    slope, there, back = _built(prepared.case.name)
    start = np.concatenate(there(*(np.array(x[0]) for x in starts[:2])), -1)
    backend = "Cython" if COMPILED else "NumPy"
    return dop853(prepared, f"PyDy {pydy.__version__} ({backend})", slope, start, back, "Kane")
