"""Reference motions of named scenes in closed form, from their default parameters and starts; independent of the library.

They are in numpy and scipy, which is imported on use.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Rounding error of a closed form in double precision, in the error measure of the report.
ROUNDING = 1e-13


class Reference(NamedTuple):
    """Reference motion at times `ts` (nt,): `q` (nt, nq) and `v` (nt, nv); the first row is the start.

    `kind` is "closed form", "printed" or "converged"; `source` cites its origin; `error` is its own
    error in the measure of the report: points of a work-precision plot below it are meaningless.
    """

    ts: np.ndarray
    q: np.ndarray
    v: np.ndarray
    kind: str
    source: str
    error: float = ROUNDING


def closed_form(ts, q, v, source: str, error: float = 0.0) -> Reference:
    """Build a reference from columns of q and v over time."""
    q, v = (np.stack(np.broadcast_arrays(*x), -1) for x in (q, v))
    return Reference(ts, q, v, "closed form", source, max(error, ROUNDING))


def integral(rate: Callable, ts, longest: float) -> tuple[np.ndarray, float]:
    """Integral of a smooth function from ts[0] to each of `ts`, by Gauss's rule with 16 nodes; and its error.

    `longest`: length (s) over which the function is close to a polynomial. The error is the largest change when
    intervals are halved.
    """
    nodes, weights = np.polynomial.legendre.leggauss(16)

    def over(a, b, pieces):
        edges = np.linspace(a, b, pieces + 1)
        half = (b - a) / pieces / 2
        return half * np.sum(weights * rate((edges[:-1] + half)[:, None] + half * nodes))

    integrals = []
    for refined in (1, 2):
        pieces = [refined * max(1, int(np.ceil((b - a) / longest))) for a, b in itertools.pairwise(ts)]
        parts = [over(a, b, n) for (a, b), n in zip(itertools.pairwise(ts), pieces, strict=True)]
        integrals.append(np.concatenate([[0.0], np.cumsum(parts)]))
    return integrals[1], float(np.abs(integrals[1] - integrals[0]).max())


def plane_pendulum(ts, length: float = 1.0, gravity: float = 9.81) -> Reference:
    """Pendulum in x and y, from rest at x = -length: sin(th/2) = k sn(K - w0 t)."""
    from scipy.special import ellipj, ellipk

    k, rate = np.sin(np.pi / 4), np.sqrt(gravity / length)
    sn, cn, _, _ = ellipj(ellipk(k**2) - rate * ts, k**2)
    angle, turn = -2 * np.arcsin(k * sn), 2 * k * rate * cn
    q = length * np.sin(angle), -length * np.cos(angle)
    return closed_form(ts, q, (-turn * q[1], turn * q[0]), "Jacobi's elliptic functions")


def sphere_pendulum(ts, theta: float = 1.0, turn: float = 1.0, length: float = 1.0, gravity: float = 9.81) -> Reference:
    """Spherical pendulum from a turning point at the angle `theta` from below, circling at `turn` (rad/s).

    z'^2 l^2 = 2 (E - g z)(l^2 - z^2) - h^2 makes z = z1 + (z2 - z1) sn^2, and the angle is the integral of h/(l^2 - z^2).
    """
    from scipy.special import ellipj, ellipk

    start, across = -length * np.cos(theta), length * np.sin(theta)
    h = across**2 * turn
    energy = 0.5 * (across * turn) ** 2 + gravity * start
    # The start is one root of the cubic; the others are those of 2 g z^2 + b z + c.
    b = 2 * gravity * start - 2 * energy
    c = b * start - 2 * gravity * length**2
    other, last = ((-b + sign * np.sqrt(b**2 - 8 * gravity * c)) / (4 * gravity) for sign in (-1, 1))
    low, high = sorted((start, other))
    m, rate = (high - low) / (last - low), np.sqrt(gravity * (last - low) / 2) / length
    phase = 0.0 if start == low else ellipk(m)

    def height(t):
        return low + (high - low) * ellipj(rate * t + phase, m)[0] ** 2

    sn, cn, dn, _ = ellipj(rate * ts + phase, m)
    z, climb = height(ts), 2 * (high - low) * rate * sn * cn * dn
    phi, error = integral(lambda t: h / (length**2 - height(t) ** 2), ts, ellipk(m) / rate / 4)
    radius = np.sqrt(length**2 - z**2)
    cosine, sine, out, around = np.cos(phi), np.sin(phi), -z * climb / radius, h / radius
    q = radius * cosine, radius * sine, z
    v = out * cosine - around * sine, out * sine + around * cosine, climb
    return closed_form(ts, q, v, "Jacobi's elliptic functions and one integral", error)


def free_top(ts, moments=(1.0, 2.0, 3.0), start=(0.3, 0.8, -0.5)) -> Reference:
    """Free rigid body, I1 < I2 < I3, from the unit quaternion: its rates by Jacobi, its orientation by one integral.

    With the angular momentum L along z' in space, R = Rz(phi) Rx(theta) Rz(psi), where theta and psi are the direction of L
    in the body, and phi' = L (I1 w1^2 + I2 w2^2)/(I1^2 w1^2 + I2^2 w2^2).

    Source: Celledoni, Fasso, Safstrom & Zanna (2008); Landau & Lifshitz, Mechanics, sections 35 and 37.
    """
    from scipy.spatial.transform import Rotation
    from scipy.special import ellipj, ellipk, ellipkinc

    moments, start = np.asarray(moments), np.asarray(start)
    i1, i2, i3 = moments
    twice, square = np.sum(moments * start**2), np.sum(moments**2 * start**2)
    above, below = twice * i3 - square, square - twice * i1
    a1, a3 = np.sqrt(above / (i1 * (i3 - i1))), np.sqrt(below / (i3 * (i3 - i1)))
    outer = square >= twice * i2  # the momentum circles the axis of the largest moment
    a2 = np.sqrt(above / (i2 * (i3 - i2)) if outer else below / (i2 * (i2 - i1)))
    first, second = ((i3 - i2) * below, (i2 - i1) * above) if outer else ((i2 - i1) * above, (i3 - i2) * below)
    rate, m = np.sqrt(first / (i1 * i2 * i3)), second / first
    sign = np.sign(start[2] if outer else start[0])
    phase = ellipkinc(np.arctan2(sign * start[1] / a2, start[0] / a1 if outer else start[2] / a3), m)

    def rates(t):
        sn, cn, dn, _ = ellipj(rate * t + phase, m)
        along = (a1 * cn, sign * a3 * dn) if outer else (sign * a1 * dn, a3 * cn)
        return np.stack([along[0], sign * a2 * sn, along[1]], -1)

    def precession(t):
        x, y = (moments[:2] * rates(t)[..., :2] ** 2).T
        return np.sqrt(square) * ((x + y) / (i1 * x + i2 * y)).T

    omega = rates(ts)
    momentum = moments * omega / np.sqrt(square)
    phi, error = integral(precession, ts, ellipk(m) / rate / 4)
    angles = np.stack([phi, np.arccos(momentum[:, 2]), np.arctan2(momentum[:, 0], momentum[:, 1])], -1)
    turned = Rotation.from_euler("ZXZ", angles)
    quaternion = np.roll((turned[0].inv() * turned).as_quat(), 1, -1)
    source = "Jacobi's elliptic functions and one integral (Celledoni et al. 2008)"
    return closed_form(ts, quaternion.T, omega.T, source, error)


def windows(ts, count: int = 2, gravity: float = 9.81) -> Reference:
    """Problem A02: all uprights turn by th, I th'' = g G sin th with I = (N+1)/3 + N, G = (N+1)/2 + N, th' = 1 at th = 0.

    A pendulum over the top: th = pi + 2 am(a t - K), a^2 = (1 + 4 w^2)/4, w^2 = g G/I, m = w^2/a^2.
    """
    from scipy.special import ellipj, ellipk

    square = gravity * ((count + 1) / 2 + count) / ((count + 1) / 3 + count)
    rate = np.sqrt(0.25 + square)
    m = square / rate**2
    _, _, dn, am = ellipj(rate * ts - ellipk(m), m)
    angle, turn = np.pi + 2 * am, 2 * rate * dn
    # Uprights turn clockwise; each but the last one is followed by its coupler, which does not turn in space.
    signs = [-1.0, 1.0] * count + [-1.0]
    source = "Jacobi's elliptic functions, on the branch of parallelograms"
    return closed_form(ts, [s * angle for s in signs], [s * turn for s in signs], source)


def upright_disk(ts, radius: float = 0.5, steering: float = 1.0, rolling: float = 2.0) -> Reference:
    """Disk that rolls upright on a circle of radius `radius` rolling/steering."""
    circle, heading = radius * rolling / steering, steering * ts
    q = circle * np.sin(heading), circle * (1 - np.cos(heading)), heading, rolling * ts
    speed = radius * rolling
    v = speed * np.cos(heading), speed * np.sin(heading), steering + 0 * ts, rolling + 0 * ts
    return closed_form(ts, q, v, "circle (Murray, Li & Sastry 1994, section 6.1.1)")


def sleigh(ts, speed=0.2, turn=1.5, mass=1.0, moment=0.5, offset=0.3) -> Reference:
    """Chaplygin's sleigh: v = c tanh u, w = (c/k) sech u, u = (a c/k^2)(t + t0); the place by two integrals."""
    k = np.sqrt(moment / mass + offset**2)
    c = np.sqrt(speed**2 + (k * turn) ** 2)
    rate = offset * c / k**2
    phase = np.arctanh(speed / c)

    def heading(t):
        turned = [2 * np.arctan(np.tanh(u / 2)) for u in (rate * t + phase, phase)]
        return k / offset * (turned[0] - turned[1])

    def forward(t):
        return c * np.tanh(rate * t + phase)

    (x, one), (y, two) = (
        integral(lambda t, part=part: forward(t) * part(heading(t)), ts, 0.25 / rate) for part in (np.cos, np.sin)
    )
    v = forward(ts), 0 * ts, c / k / np.cosh(rate * ts + phase)
    return closed_form(ts, (x, y, heading(ts)), v, "tanh and sech (Bloch 2003, section 1.7)", max(one, two))


def coin(ts, radius=0.05, circle=0.5, lean=np.pi / 36, gravity=9.81) -> Reference:
    """Disk that leans and rolls steadily on a circle: R = Rz(turn t) Rx(lean) Ry(spin t)."""
    from scipy.spatial.transform import Rotation

    rho, sine, cosine = radius / circle, np.sin(lean), np.cos(lean)
    spin = np.sqrt(4 * gravity / radius * sine / ((6 - 5 * rho * sine) * rho * cosine))
    turn = -rho * spin
    turned = Rotation.from_euler("ZXY", np.stack([turn * ts, lean + 0 * ts, spin * ts], -1))
    center = Rotation.from_rotvec(turn * ts[:, None] * [0.0, 0.0, 1.0]).apply(
        [0.0, circle - radius * sine, radius * cosine]
    )
    velocity = turned.inv().apply(np.cross([0.0, 0.0, turn], center))
    # The lean angle is constant: in the axes of the leaning but not spinning disk the rates are constant.
    rates = Rotation.from_rotvec(-spin * ts[:, None] * [0.0, 1.0, 0.0]).apply([0.0, turn * sine + spin, turn * cosine])
    q = [*center.T, *np.roll(turned.as_quat(), 1, -1).T]
    return closed_form(ts, q, [*velocity.T, *rates.T], "steady rolling (Le Saux, Leine & Glocker 2005, eqs 5.10-5.12)")


def swing(ts, length: float = 1.0, gravity: float = 9.81) -> Reference:
    """Pendulum of `plane_pendulum` by its angle from the downward vertical."""
    known = plane_pendulum(ts, length, gravity)
    x, y = known.q.T
    rate = (known.v[:, 1] * x - known.v[:, 0] * y) / length**2
    return closed_form(ts, [np.arctan2(x, -y)], [rate], known.source)


def projectile(ts, velocity=(1.0, 2.0), gravity: float = 9.81) -> Reference:
    """Projectile from the origin."""
    (x, y), zero = velocity, 0 * ts
    return closed_form(ts, (x * ts, y * ts - gravity * ts**2 / 2), (x + zero, y - gravity * ts), "parabola")


def skate(ts, turn: float = 2.0, slope: float = np.pi / 6, gravity: float = 9.81) -> Reference:
    """Knife edge on an inclined plane, from rest: a cycloid; velocities along the blade, across it, and the turning."""
    pull, angle = gravity * np.sin(slope), turn * ts
    size = pull / (2 * turn**2)
    q = size * np.sin(angle) ** 2, size * (angle - np.sin(2 * angle) / 2), angle
    v = pull / turn * np.sin(angle), 0 * ts, turn + 0 * ts
    return closed_form(ts, q, v, "cycloid (Bloch 2003, section 1.6)")


def turntable(ts, radius=0.2, rate=3.0, position=(1.0, 0.0), velocity=(0.0, 0.5)) -> Reference:
    """Solid ball on a turntable: its centre moves on a circle at (2/7) of the table's rate, about a fixed point.

    The velocity at the contact gives the angular velocity; the orientation follows by integrating it (DOP853, two tolerances).

    Source: Weltner (1979), Am. J. Phys. 47, 984.
    """
    from scipy.integrate import solve_ivp
    from scipy.spatial.transform import Rotation

    slow = 2 / 7 * rate
    # In complex numbers x + i y of the plane: vdot = i slow v.
    start, toward = complex(*position), complex(*velocity) / (1j * slow)
    middle = start - toward
    across = toward * np.exp(1j * slow * ts)
    place, speed = middle + across, 1j * slow * across

    def spin(t):
        turned = (rate * middle + (rate - slow) * toward * np.exp(1j * slow * t)) / radius
        return np.array([turned.real, turned.imag, 0.0 * turned.real])

    def tumble(t, q):
        (x, y, z), (a, b, c, d) = spin(t), q
        return 0.5 * np.array(
            [-x * b - y * c - z * d, x * a + y * d - z * c, y * a + z * b - x * d, z * a + x * c - y * b]
        )

    solved = [
        solve_ivp(tumble, (ts[0], ts[-1]), [1.0, 0.0, 0.0, 0.0], "DOP853", ts, rtol=tolerance, atol=tolerance).y
        for tolerance in (1e-12, 3e-14)
    ]
    # The quaternion has its scalar first, scipy's last.
    into_body = Rotation.from_quat(np.roll(solved[1], -1, 0).T).inv()
    zero = 0 * ts
    linear, angular = into_body.apply(np.stack([speed.real, speed.imag, zero], -1)), into_body.apply(spin(ts).T)
    q = [rate * ts, place.real, place.imag, radius + zero, *solved[1]]
    source, error = "circle (Weltner 1979), orientation by DOP853", float(np.abs(solved[1] - solved[0]).max())
    return closed_form(ts, q, [rate + zero, *linear.T, *angular.T], source, error)


def falling_table(
    ts, tilt=0.02, size=(0.2, 0.16, 0.24), mass=1.0, table=(1.0, 0.6, 0.05), table_mass=20.0, height=0.025, gravity=9.81
) -> Reference:
    """Box on a table that tips over with it: a pendulum from rest near its highest position.

    With phi = pi - theta from below, sin(phi/2) = k sn(K(k) + w t), k = cos(tilt/2).
    """
    from scipy.special import ellipj, ellipk

    r = height + size[2] / 2
    moment = table_mass * (table[0] ** 2 + table[2] ** 2) / 12 + mass * ((size[0] ** 2 + size[2] ** 2) / 12 + r**2)
    k, rate = np.cos(tilt / 2), np.sqrt(mass * gravity * r / moment)
    sn, cn, _, _ = ellipj(ellipk(k**2) + rate * ts, k**2)
    angle, turn = np.pi - 2 * np.arcsin(k * sn), -2 * k * rate * cn
    zero, half = 0 * ts, angle / 2
    q = r * np.sin(angle), zero, r * np.cos(angle), np.cos(half), zero, np.sin(half), zero, angle
    return closed_form(ts, q, (r * turn, zero, zero, zero, turn, zero, turn), "Jacobi's elliptic functions")


# Functions of the times by the names of `jaxdyn.scenes`.
CLOSED_FORMS: dict[str, Callable[..., Reference]] = {
    "ball_on_turntable": turntable,
    "box_on_table": falling_table,
    "chaplygin_sleigh": sleigh,
    "free_body": free_top,
    "knife_edge_on_incline": skate,
    "particle_in_plane": projectile,
    "pendulum": swing,
    "pendulum_in_plane": plane_pendulum,
    "rolling_coin": coin,
    "rolling_disk": upright_disk,
    "spherical_pendulum": sphere_pendulum,
    "windows": windows,
}
