"""Scenes as trees of joints and loops, for the peers that take mechanisms: MuJoCo, Pinocchio and MJX."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import jaxdyn as jd
from benchmarks.peers.equations import from_angle, same, to_angle, unit_quaternion
from benchmarks.report_cases import test_set


class Spring(NamedTuple):
    """A linear spring from a point in space to a point `end` of body number `body`: stiffness (N/m) and rest (m)."""

    foot: tuple[float, float, float]
    body: int
    end: tuple[float, float, float]
    stiffness: float
    rest: float


class Twin(NamedTuple):
    """The same motion for a peer: revolute joints about z, or one ball, with loops; a spring and constant torques.

    `there(q, v)` takes states of the scene, with leading axes, to the joints of the tree, `back` takes them back.
    `push(q)` are the torques of spring and motors, by hand, for peers that have no such thing.
    """

    scene: jd.Scene
    there: Callable = same
    back: Callable = same
    spring: Spring | None = None
    torques: tuple[float, ...] = ()
    push: Callable | None = None


def _pendulum() -> Twin:
    builder = jd.ModelBuilder("pendulum", gravity=(0.0, -9.81, 0.0))
    builder.add_body("bob", None, "continuous", (1.0, (0.0, -1.0, 0.0), (0.0, 0.0, 0.0)))
    return Twin(jd.Scene(builder.build()), to_angle, from_angle)


def _andrews() -> Twin:
    # beta, Theta, gamma, delta, Phi, epsilon, Omega, of the printed beta, Theta, gamma, Phi, delta, Omega, epsilon.
    order = [0, 1, 2, 4, 3, 6, 5]
    spring = Spring((0.014, 0.072, 0.0), 2, (0.02, -0.018, 0.0), 4530.0, 0.07785)
    torques = (0.033, *[0.0] * 6)
    motor = torques[0]

    def turn(q, v):
        return np.asarray(q)[..., order], np.asarray(v)[..., order]

    def push(q):
        # The spring's body turns by gamma about a point in space, B.
        c, s = math.cos(q[2]), math.sin(q[2])
        (x, y, _), (xc, yc, _) = spring.end, spring.foot
        armx, army = c * x - s * y, s * x + c * y
        dx, dy = -0.03635 + armx - xc, 0.03273 + army - yc
        length = math.hypot(dx, dy)
        pull = -spring.stiffness * (length - spring.rest) / length
        return np.array([motor, 0.0, pull * (armx * dy - army * dx), 0.0, 0.0, 0.0, 0.0])

    return Twin(test_set.andrews_bodies(), turn, turn, spring, torques, push)


TWINS: dict[str, Callable[[], Twin]] = {
    "pendulum_in_plane": _pendulum,
    "double_pendulum": lambda: Twin(jd.scenes.double_pendulum(formulation="model")),
    "free_body": lambda: Twin(jd.scenes.free_body(), back=unit_quaternion),
    "four_bar": lambda: Twin(jd.scenes.four_bar()),
    "windows": lambda: Twin(jd.scenes.windows(count=2)),
    "windows_40": lambda: Twin(jd.scenes.windows(count=40)),
    "andrews": _andrews,
}
