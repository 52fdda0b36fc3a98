"""Equations of motion written by hand, for the peers that take equations: SymPy with NumPy, CasADi, compiled C.

M(q) v' = f + J^T lambda, q' = rates(q, v), under position rows phi(t, q) = 0 or velocity rows psi(t, q, v) = 0. Functions take a
namespace `m` with sin, cos and sqrt, and numbers or symbols one by one, so that one text serves every tool. Multipliers
and derivatives are left to the tool. None of it calls jaxdyn; the numbers are the default parameters of its scenes.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

GRAVITY = 9.81


def same(q, v):
    """Coordinates that are those of the scene."""
    return np.asarray(q), np.asarray(v)


class Equations(NamedTuple):
    """Equations of a scene with `nq` coordinates and `nv` speeds.

    `mass(m, q)` -> rows of M, zeros as 0.0; `force(m, t, q, v)`; `rows(m, t, q)` or `velocity_rows(m, t, q, v)` if it has
    constraints; `rates(m, q, v)` -> q', None where it is v. `there(q, v)` takes states of the scene, with leading axes,
    to these coordinates, and `back` takes them back.
    """

    nq: int
    nv: int
    mass: Callable[[Any, Sequence], list]
    force: Callable[[Any, Any, Sequence, Sequence], list]
    rows: Callable | None = None
    velocity_rows: Callable | None = None
    rates: Callable | None = None
    there: Callable = same
    back: Callable = same


def diagonal(entries) -> list:
    """A diagonal matrix as rows."""
    return [[x if i == j else 0.0 for j in range(len(entries))] for i, x in enumerate(entries)]


def to_angle(q, v):
    """x and y of a pendulum -> its angle from below."""
    angle = np.arctan2(q[..., 0], -q[..., 1])
    return angle[..., None], (np.cos(angle) * v[..., 0] + np.sin(angle) * v[..., 1])[..., None]


def from_angle(q, v):
    """The way back from `to_angle`."""
    c, s = np.cos(q[..., 0]), np.sin(q[..., 0])
    return np.stack([s, -c], -1), v * np.stack([c, s], -1)


def pendulum() -> Equations:
    """th'' = -g sin th."""
    return Equations(
        1,
        1,
        lambda m, q: [[1.0]],
        lambda m, t, q, v: [-GRAVITY * m.sin(q[0])],
        there=to_angle,
        back=from_angle,
    )


def _absolute(parents):
    """Angles relative to parents <-> absolute ones, by the matrix that adds along each chain."""
    chain = np.eye(len(parents))
    for i, parent in enumerate(parents):
        if parent is not None:
            chain[i] += chain[parent]
    back = np.linalg.inv(chain)
    return {"there": lambda q, v: (q @ chain.T, v @ chain.T), "back": lambda q, v: (q @ back.T, v @ back.T)}


def double_pendulum(masses=(1.0, 0.5), length=1.0, reaches=(0.5, 0.35)) -> Equations:
    """Two bars in absolute angles a, b: [[A, B c], [B c, D]] (a'', b'') + B s (b'^2, -a'^2) + (G sin a, H sin b) = 0."""
    (m1, m2), (r1, r2) = masses, reaches
    i1, i2 = (m * (2 * r) ** 2 / 12 for m, r in zip(masses, reaches, strict=True))
    A, B, D = i1 + m1 * r1**2 + m2 * length**2, m2 * length * r2, i2 + m2 * r2**2
    first, second = GRAVITY * (m1 * r1 + m2 * length), GRAVITY * m2 * r2

    def mass(m, q):
        c = B * m.cos(q[0] - q[1])
        return [[A, c], [c, D]]

    def force(m, t, q, v):
        s = B * m.sin(q[0] - q[1])
        return [-s * v[1] ** 2 - first * m.sin(q[0]), s * v[0] ** 2 - second * m.sin(q[1])]

    return Equations(2, 2, mass, force, **_absolute((None, 0)))


def _quaternion_rate(m, q, v):
    w, x, y, z = q
    a, b, c = v
    rate = [-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a]
    return [0.5 * r for r in rate]


def unit_quaternion(q, v):
    """Quaternions at their length of one, as a solver lets it drift."""
    return q / np.linalg.norm(q, axis=-1, keepdims=True), np.asarray(v)


def free_body(moments=(1.0, 2.0, 3.0)) -> Equations:
    """I w' = (I w) x w, and the quaternion's rate."""
    i, j, k = moments

    def force(m, t, q, v):
        return [(j - k) * v[1] * v[2], (k - i) * v[2] * v[0], (i - j) * v[0] * v[1]]

    return Equations(4, 3, lambda m, q: diagonal(moments), force, rates=_quaternion_rate, back=unit_quaternion)


def four_bar(lengths=(1.0, 3.0, 2.5, 3.5), masses=(1.0, 3.0, 2.5)) -> Equations:
    """Crank, coupler and rocker in absolute angles from x, closed at the knee."""
    (a, b, c, ground), (m1, m2, m3) = lengths, masses

    def mass(m, q):
        cross = m2 * a * b / 2 * m.cos(q[0] - q[1])
        return [[(m1 / 3 + m2) * a**2, cross, 0.0], [cross, m2 * b**2 / 3, 0.0], [0.0, 0.0, m3 * c**2 / 3]]

    def force(m, t, q, v):
        s = m2 * a * b / 2 * m.sin(q[0] - q[1])
        return [
            -s * v[1] ** 2 - GRAVITY * (m1 / 2 + m2) * a * m.cos(q[0]),
            s * v[0] ** 2 - GRAVITY * m2 * b / 2 * m.cos(q[1]),
            -GRAVITY * m3 * c / 2 * m.cos(q[2]),
        ]

    def rows(m, t, q):
        return [
            a * m.cos(q[0]) + b * m.cos(q[1]) - c * m.cos(q[2]) - ground,
            a * m.sin(q[0]) + b * m.sin(q[1]) - c * m.sin(q[2]),
        ]

    return Equations(3, 3, mass, force, rows, **_absolute((None, 0, None)))


def windows(count=2) -> Equations:
    """N four-bar windows of unit bars: upright i, turned by q_2i from the vertical, carries the bar q_2i+1 from x on."""
    size = 2 * count + 1

    def mass(m, q):
        M = [[0.0] * size for _ in range(size)]
        for i in range(0, size, 2):
            M[i][i] = 1 / 3 if i == size - 1 else 4 / 3
        for i in range(0, size - 1, 2):
            M[i + 1][i + 1] = 1 / 3
            M[i][i + 1] = M[i + 1][i] = 0.5 * m.sin(q[i + 1] - q[i])
        return M

    def force(m, t, q, v):
        f = []
        for i in range(0, size - 1, 2):
            c = 0.5 * m.cos(q[i + 1] - q[i])
            f += [1.5 * GRAVITY * m.sin(q[i]) - c * v[i + 1] ** 2, c * v[i] ** 2 - 0.5 * GRAVITY * m.cos(q[i + 1])]
        return [*f, 0.5 * GRAVITY * m.sin(q[-1])]

    def rows(m, t, q):
        computed = []
        for i in range(0, size - 1, 2):
            computed.append(-m.sin(q[i]) + m.cos(q[i + 1]) + m.sin(q[i + 2]) - 1.0)
            computed.append(m.cos(q[i]) + m.sin(q[i + 1]) - m.cos(q[i + 2]))
        return computed

    return Equations(
        size, size, mass, force, rows, **_absolute([None, *(i if i % 2 == 0 else None for i in range(size - 1))])
    )


def andrews() -> Equations:
    """Andrews' squeezing mechanism as printed in the test set for IVP solvers; Hairer & Wanner (1996), section VII.7."""
    m1, m2, m3, m4, m5, m6, m7 = 0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498
    i1, i2, i3, i4, i5, i6, i7 = 2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5
    (xa, ya), (xb, yb), (xc, yc), c0, l0 = (-0.06934, -0.00227), (-0.03635, 0.03273), (0.014, 0.072), 4530.0, 0.07785
    d, da, e, ea, rr, ra, ss, sa, sb = 0.028, 0.0115, 0.02, 0.01421, 0.007, 0.00092, 0.035, 0.01874, 0.01043
    sc, sd, ta, tb, u, ua, ub, zf, zt, fa = 0.018, 0.02, 0.02308, 0.00916, 0.04, 0.01228, 0.00449, 0.02, 0.04, 0.01421
    torque, arm, reach = 0.033, e - ea, zf - fa

    def mass(m, q):
        _, th, _, ph, _, om, _ = q
        M = [[0.0] * 7 for _ in range(7)]
        M[0][0] = m1 * ra**2 + m2 * (rr**2 - 2 * da * rr * m.cos(th) + da**2) + i1 + i2
        M[0][1] = M[1][0] = m2 * (da**2 - da * rr * m.cos(th)) + i2
        M[1][1] = m2 * da**2 + i2
        M[2][2] = m3 * (sa**2 + sb**2) + i3
        M[3][3] = m4 * arm**2 + i4
        M[3][4] = M[4][3] = m4 * (arm**2 + zt * arm * m.sin(ph)) + i4
        M[4][4] = m4 * (zt**2 + 2 * zt * arm * m.sin(ph) + arm**2) + m5 * (ta**2 + tb**2) + i4 + i5
        M[5][5] = m6 * reach**2 + i6
        M[5][6] = M[6][5] = m6 * (reach**2 - u * reach * m.sin(om)) + i6
        M[6][6] = m6 * (reach**2 - 2 * u * reach * m.sin(om) + u**2) + m7 * (ua**2 + ub**2) + i6 + i7
        return M

    def force(m, t, q, v):
        _, th, ga, ph, _, om, _ = q
        be_, th_, _, ph_, de_, om_, ep_ = v
        x, y = sd * m.cos(ga) + sc * m.sin(ga) + xb - xc, sd * m.sin(ga) - sc * m.cos(ga) + yb - yc
        length = m.sqrt(x**2 + y**2)
        pull = -c0 * (length - l0) / length
        return [
            torque - m2 * da * rr * th_ * (th_ + 2 * be_) * m.sin(th),
            m2 * da * rr * be_**2 * m.sin(th),
            pull * (x * (sc * m.cos(ga) - sd * m.sin(ga)) + y * (sd * m.cos(ga) + sc * m.sin(ga))),
            m4 * zt * arm * de_**2 * m.cos(ph),
            -m4 * zt * arm * ph_ * (ph_ + 2 * de_) * m.cos(ph),
            -m6 * u * reach * ep_**2 * m.cos(om),
            m6 * u * reach * om_ * (om_ + 2 * ep_) * m.cos(om),
        ]

    def rows(m, t, q):
        be, th, ga, ph, de, om, ep = q
        ex, ey = rr * m.cos(be) - d * m.cos(be + th), rr * m.sin(be) - d * m.sin(be + th)
        return [
            ex - ss * m.sin(ga) - xb,
            ey + ss * m.cos(ga) - yb,
            ex - e * m.sin(ph + de) - zt * m.cos(de) - xa,
            ey + e * m.cos(ph + de) - zt * m.sin(de) - ya,
            ex - zf * m.cos(om + ep) - u * m.sin(ep) - xa,
            ey - zf * m.sin(om + ep) + u * m.cos(ep) - ya,
        ]

    return Equations(7, 7, mass, force, rows)


def car_axis() -> Equations:
    """Car axis as printed in the test set for IVP solvers, with k = M eps^2/2 = 5e-4."""
    k, rest, length = 5e-4, 0.5, 1.0

    def road(m, t):
        y = 0.1 * m.sin(10.0 * t)
        return m.sqrt(length**2 - y**2), y

    def force(m, t, q, v):
        xl, yl, xr, yr = q
        xb, yb = road(m, t)
        left, right = m.sqrt(xl**2 + yl**2), m.sqrt((xr - xb) ** 2 + (yr - yb) ** 2)
        a, b = (rest - left) / left, (rest - right) / right
        return [a * xl, a * yl - k, b * (xr - xb), b * (yr - yb) - k]

    def rows(m, t, q):
        xb, yb = road(m, t)
        return [xb * q[0] + yb * q[1], (q[0] - q[2]) ** 2 + (q[1] - q[3]) ** 2 - length**2]

    return Equations(4, 4, lambda m, q: diagonal([k] * 4), force, rows)


def rolling_disk(mass=2.0, radius=0.5, steer=0.125, roll=0.25) -> Equations:
    """Upright disk, with the two rows of rolling."""

    def rows(m, t, q, v):
        return [v[0] - radius * m.cos(q[2]) * v[3], v[1] - radius * m.sin(q[2]) * v[3]]

    return Equations(
        4,
        4,
        lambda m, q: diagonal([mass, mass, steer, roll]),
        lambda m, t, q, v: [0.0] * 4,
        velocity_rows=rows,
    )


def sleigh(mass=1.0, moment=0.5, offset=0.3) -> Equations:
    """Chaplygin's sleigh by its forward speed and its turn: m v' = m a w^2, (I + m a^2) w' = -m a v w."""

    def back(q, v):
        return np.asarray(q), np.stack([v[..., 0], 0 * v[..., 0], v[..., 1]], -1)

    return Equations(
        3,
        2,
        lambda m, q: diagonal([mass, moment + mass * offset**2]),
        lambda m, t, q, v: [mass * offset * v[1] ** 2, -mass * offset * v[0] * v[1]],
        rates=lambda m, q, v: [v[0] * m.cos(q[2]), v[0] * m.sin(q[2]), v[1]],
        there=lambda q, v: (np.asarray(q), np.asarray(v)[..., [0, 2]]),
        back=back,
    )


EQUATIONS: dict[str, Callable[[], Equations]] = {
    "pendulum_in_plane": pendulum,
    "double_pendulum": double_pendulum,
    "free_body": free_body,
    "four_bar": four_bar,
    "windows": windows,
    "windows_40": lambda: windows(40),
    "andrews": andrews,
    "car_axis": car_axis,
    "rolling_disk": rolling_disk,
    "chaplygin_sleigh": sleigh,
}
