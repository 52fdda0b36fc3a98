"""Mechanisms of the test set for initial-value problems (CWI and Bari), from their published equations."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints import Holonomic, loop
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import NamedScene, as_leaf, as_state, flat_moments
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import ExplicitSystem


def _with_start(start):
    return lambda build: NamedScene(build, start)


# Names as printed; m, I are lists m1..m7 and I1..I7. SI units.
_ANDREWS = {
    "m": (0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498),
    "I": (2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5),
    "A": (-0.06934, -0.00227),
    "B": (-0.03635, 0.03273),
    "C": (0.014, 0.072),
    "c0": 4530.0,
    "l0": 0.07785,
    "lengths": {
        "d": 0.028,
        "da": 0.0115,
        "e": 0.02,
        "ea": 0.01421,
        "rr": 0.007,
        "ra": 0.00092,
        "ss": 0.035,
        "sa": 0.01874,
        "sb": 0.01043,
        "sc": 0.018,
        "sd": 0.02,
        "ta": 0.02308,
        "tb": 0.00916,
        "u": 0.04,
        "ua": 0.01228,
        "ub": 0.00449,
        "zf": 0.02,
        "zt": 0.04,
        "fa": 0.01421,
    },
    "torque": 0.033,
}


def _numbers(parameters):
    """Convert the published parameters to leaves."""
    if isinstance(parameters, dict):
        return {key: _numbers(value) for key, value in parameters.items()}
    return as_leaf(parameters)


def _andrews_mass(q, t, p):
    _, th, _, ph, _, om, _ = jnp.unstack(q)
    m1, m2, m3, m4, m5, m6, m7 = jnp.unstack(p["m"])
    I1, I2, I3, I4, I5, I6, I7 = jnp.unstack(p["I"])
    s = p["lengths"]
    arm, zf_fa = s["e"] - s["ea"], s["zf"] - s["fa"]
    M = jnp.zeros((7, 7), q.dtype)
    M = M.at[0, 0].set(
        m1 * s["ra"] ** 2 + m2 * (s["rr"] ** 2 - 2 * s["da"] * s["rr"] * jnp.cos(th) + s["da"] ** 2) + I1 + I2
    )
    M = M.at[0, 1].set(m2 * (s["da"] ** 2 - s["da"] * s["rr"] * jnp.cos(th)) + I2)
    M = M.at[1, 1].set(m2 * s["da"] ** 2 + I2)
    M = M.at[2, 2].set(m3 * (s["sa"] ** 2 + s["sb"] ** 2) + I3)
    M = M.at[3, 3].set(m4 * arm**2 + I4)
    M = M.at[3, 4].set(m4 * (arm**2 + s["zt"] * arm * jnp.sin(ph)) + I4)
    M = M.at[4, 4].set(
        m4 * (s["zt"] ** 2 + 2 * s["zt"] * arm * jnp.sin(ph) + arm**2) + m5 * (s["ta"] ** 2 + s["tb"] ** 2) + I4 + I5
    )
    M = M.at[5, 5].set(m6 * zf_fa**2 + I6)
    M = M.at[5, 6].set(m6 * (zf_fa**2 - s["u"] * zf_fa * jnp.sin(om)) + I6)
    M = M.at[6, 6].set(
        m6 * (zf_fa**2 - 2 * s["u"] * zf_fa * jnp.sin(om) + s["u"] ** 2) + m7 * (s["ua"] ** 2 + s["ub"] ** 2) + I6 + I7
    )
    return jnp.triu(M) + jnp.triu(M, 1).T


def _andrews_spring(q, p):
    """Position (2,) of the end D of the spring relative to its base C."""
    s, c, sn = p["lengths"], jnp.cos(q[2]), jnp.sin(q[2])
    end = jnp.stack([s["sd"] * c + s["sc"] * sn, s["sd"] * sn - s["sc"] * c])
    # Body 3 turns about B.
    return end + p["B"] - p["C"]


def _andrews_bias(q, v, t, p):
    _, th, ga, ph, _, om, _ = jnp.unstack(q)
    be_, th_, _, ph_, de_, om_, ep_ = jnp.unstack(v)
    _, m2, _, m4, _, m6, _ = jnp.unstack(p["m"])
    s = p["lengths"]
    arm, zf_fa = s["e"] - s["ea"], s["zf"] - s["fa"]
    stretch = _andrews_spring(q, p)
    length = jnp.sqrt(jnp.sum(stretch**2))
    # The spring pulls along C to D; the stretch has that direction.
    fx, fy = jnp.unstack(-p["c0"] * (length - p["l0"]) / length * stretch)
    force = jnp.stack(
        [
            p["torque"] - m2 * s["da"] * s["rr"] * th_ * (th_ + 2 * be_) * jnp.sin(th),
            m2 * s["da"] * s["rr"] * be_**2 * jnp.sin(th),
            fx * (s["sc"] * jnp.cos(ga) - s["sd"] * jnp.sin(ga)) + fy * (s["sd"] * jnp.cos(ga) + s["sc"] * jnp.sin(ga)),
            m4 * s["zt"] * arm * de_**2 * jnp.cos(ph),
            -m4 * s["zt"] * arm * ph_ * (ph_ + 2 * de_) * jnp.cos(ph),
            -m6 * s["u"] * zf_fa * ep_**2 * jnp.cos(om),
            m6 * s["u"] * zf_fa * om_ * (om_ + 2 * ep_) * jnp.cos(om),
        ]
    )
    # The publication has M p'' = f on the right; h is on the left.
    return -force


def _andrews_potential(q, t, p):
    """Energy of the spring and of the constant motor torque."""
    length = jnp.sqrt(jnp.sum(_andrews_spring(q, p) ** 2))
    # A constant torque on beta has the potential -torque beta.
    return 0.5 * p["c0"] * (length - p["l0"]) ** 2 - p["torque"] * q[0]


class _AndrewsLoops(eqx.Module):
    """Closure of the three loops, two rows each."""

    lengths: dict
    A: Float[Array, "2"]
    B: Float[Array, "2"]

    def __call__(self, q, t):
        be, th, ga, ph, de, om, ep = jnp.unstack(q)
        s = self.lengths
        ex = s["rr"] * jnp.cos(be) - s["d"] * jnp.cos(be + th)
        ey = s["rr"] * jnp.sin(be) - s["d"] * jnp.sin(be + th)
        (xa, ya), (xb, yb) = jnp.unstack(self.A), jnp.unstack(self.B)
        return jnp.stack(
            [
                ex - s["ss"] * jnp.sin(ga) - xb,
                ey + s["ss"] * jnp.cos(ga) - yb,
                ex - s["e"] * jnp.sin(ph + de) - s["zt"] * jnp.cos(de) - xa,
                ey + s["e"] * jnp.cos(ph + de) - s["zt"] * jnp.sin(de) - ya,
                ex - s["zf"] * jnp.cos(om + ep) - s["u"] * jnp.sin(ep) - xa,
                ey - s["zf"] * jnp.sin(om + ep) + s["u"] * jnp.cos(ep) - ya,
            ]
        )


def _andrews_start() -> tuple[Array, Array]:
    q = (
        -0.0617138900142764496358948458001,
        0.0,
        0.455279819163070380255912382449,
        0.222668390165885884674473185609,
        0.487364979543842550225598953530,
        -0.222668390165885884674473185609,
        1.23054744454982119249735015568,
    )
    return as_state(q), as_state(np.zeros(7))


# Place of each joint of the tree in the printed coordinates: beta, Theta, gamma, delta, Phi, epsilon, Omega.
ANDREWS_ORDER = (0, 1, 2, 4, 3, 6, 5)


class _AndrewsPotential(eqx.Module):
    """Forces of the spring between C and the point D of body 3, and of the motor: minus the gradient of their energy."""

    stiffness: Float[Array, ""] = eqx.field(converter=as_leaf)
    rest: Float[Array, ""] = eqx.field(converter=as_leaf)
    foot: Float[Array, "2"] = eqx.field(converter=as_leaf)
    torque: Float[Array, ""] = eqx.field(converter=as_leaf)

    def energy(self, system, q):
        end = frame_pose(system, q, "D")[:2, 3]
        length = jnp.sqrt(jnp.sum((end - self.foot.astype(q.dtype)) ** 2))
        stored = 0.5 * self.stiffness.astype(q.dtype) * (length - self.rest.astype(q.dtype)) ** 2
        return stored - self.torque.astype(q.dtype) * q[0]

    def __call__(self, system, q, v, t):
        # Coordinates have v = dq/dt here, so a gradient in q is a generalised force.
        return -jax.grad(self.energy, argnums=1)(system, q)


def _andrews_bodies_start() -> tuple[Array, Array]:
    q, v = _andrews_start()
    return as_state(np.asarray(q)[np.array(ANDREWS_ORDER)]), v


@_with_start(_andrews_bodies_start)
def andrews_bodies() -> Scene:
    """Andrews' squeezing mechanism of seven bodies: a tree of four branches, three loops at the point E.

    The angles are those of `andrews`, as the tree orders them: (beta, Theta, gamma, delta, Phi, epsilon, Omega). Spring
    and motor are a force of the scene.

    Source: as `andrews`; the drawing of the mechanism says where the centres of mass are.
    """
    p, s = _ANDREWS, _ANDREWS["lengths"]
    builder = ModelBuilder("Andrews' mechanism", gravity=None)

    def body(number, parent, joint, center, place=(0.0, 0.0)):
        # Motion is in the plane, so that moments about x and y have no effect.
        inertia = (p["m"][number - 1], (*center, 0.0), flat_moments(p["I"][number - 1]))
        builder.add_body(f"K{number}", parent, "continuous", inertia, joint_name=joint, pose=(*place, 0.0))

    # x of each body is along the link where the published equations have a cosine; -y where they have (sin, -cos).
    body(1, None, "1 beta", (s["ra"], 0.0))
    body(2, "K1", "2 Theta", (-s["da"], 0.0), (s["rr"], 0.0))
    body(3, None, "3 gamma", (s["sb"], -s["sa"]), p["B"])
    body(5, None, "4 delta", (s["ta"], s["tb"]), p["A"])
    body(4, "K5", "5 Phi", (0.0, s["ea"] - s["e"]), (s["zt"], 0.0))
    body(7, None, "6 epsilon", (-s["ub"], -s["ua"]), p["A"])
    body(6, "K7", "7 Omega", (s["zf"] - s["fa"], 0.0), (0.0, -s["u"]))
    builder.add_frame("D", "K3", (s["sd"], -s["sc"], 0.0))
    ends = {"K3": (0.0, -s["ss"], 0.0), "K4": (0.0, -s["e"], 0.0), "K6": (s["zf"], 0.0, 0.0)}
    closing = [
        loop("K2", (-s["d"], 0.0, 0.0), name, end, in_plane=True, name=f"E on {name}") for name, end in ends.items()
    ]
    return Scene(builder.build(), closing, (_AndrewsPotential(p["c0"], p["l0"], p["C"], p["torque"]),))


@_with_start(_andrews_start)
def andrews() -> Scene:
    """Andrews' squeezing mechanism: seven bodies, three loops, q = (beta, Theta, gamma, Phi, delta, Omega, epsilon).

    M and f as printed; the printed multipliers have the opposite sign, as they stand on the left. The potential energy
    includes the work of the constant motor torque, so that the sum of the energies is constant.

    Source: Hairer & Wanner, Solving Ordinary Differential Equations II (1996), section VII.7; test set for IVP solvers.
    """
    p: Any = _numbers(_ANDREWS)
    system = ExplicitSystem(_andrews_mass, _andrews_bias, 7, parameters=p, potential=_andrews_potential)
    return Scene(system, (Holonomic(_AndrewsLoops(p["lengths"], p["A"], p["B"]), name="loops"),))


def _road(t, p):
    """Position (xb, yb) of the right wheel's axle on the road."""
    yb = p["amplitude"] * jnp.sin(p["frequency"] * t)
    # The distance of the wheels is constant while the right one rises and sinks.
    return jnp.sqrt(p["length"] ** 2 - yb**2), yb


def _car(q, v, t, p):
    xl, yl, xr, yr = jnp.unstack(q)
    xb, yb = _road(t, p)
    left = jnp.sqrt(xl**2 + yl**2) - p["rest"]
    right = jnp.sqrt((xr - xb) ** 2 + (yr - yb) ** 2) - p["rest"]
    # The springs of the test set have unit stiffness.
    return 0.5 * p["k"] * jnp.sum(v * v) - 0.5 * (left**2 + right**2) - p["k"] * p["g"] * (yl + yr)


class _CarRows(eqx.Module):
    """Constraints: the left spring is perpendicular to the axle, and the chassis has a fixed length."""

    parameters: dict

    def __call__(self, q, t):
        xl, yl, xr, yr = jnp.unstack(q)
        xb, yb = _road(t, self.parameters)
        return jnp.stack([xb * xl + yb * yl, (xl - xr) ** 2 + (yl - yr) ** 2 - self.parameters["length"] ** 2])


def _car_start() -> tuple[Array, Array]:
    return as_state([0.0, 0.5, 1.0, 0.5]), as_state([-0.5, 0.0, -0.5, 0.0])


@_with_start(_car_start)
def car_axis() -> Scene:
    """Car axis on a bumpy road: two masses on springs, q = (xl, yl, xr, yr), with rheonomic constraints.

    Source: Schneider (1995); test set for IVP solvers, problem "car axis", with k = M eps^2/2 = 5e-4.
    """
    eps, mass = 1e-2, 10.0
    p: Any = {"k": mass * eps**2 / 2, "length": 1.0, "rest": 0.5, "amplitude": 0.1, "frequency": 10.0, "g": 1.0}
    p = _numbers(p)
    system = LagrangianSystem(_car, 4, parameters=p)
    return Scene(system, (Holonomic(_CarRows(p), name="rows"),))
