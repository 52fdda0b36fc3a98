"""Built-in mechanisms: two arms, a hand, a quadruped, and generators of chains and random trees."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array

from jaxdyn.model import host_math
from jaxdyn.model.arguments import DType, Number, Numbers
from jaxdyn.model.builder import GRAVITY, ModelBuilder
from jaxdyn.model.inertia import box, cylinder, displaced, nearest_feasible, sphere
from jaxdyn.model.topology import KINDS
from jaxdyn.model.tree import Model

_QUARTER = np.pi / 2
# For each joint: position in its parent and rotation there (rpy); mass, centre of mass and principal moments of its body; limits
# of angle (deg), speed (deg/s) and torque.
_IIWA = (
    ((0, 0, 0.1575), (0, 0, 0), 5.76, (0, -0.03, 0.12), (0.033, 0.0333, 0.0123), 170, 85, 320),
    ((0, 0, 0.2025), (_QUARTER, 0, np.pi), 6.35, (0.0003, 0.059, 0.042), (0.0305, 0.0304, 0.011), 120, 85, 320),
    ((0, 0.2045, 0), (_QUARTER, 0, np.pi), 3.5, (0, 0.03, 0.13), (0.025, 0.0238, 0.0076), 170, 100, 176),
    ((0, 0, 0.2155), (_QUARTER, 0, 0), 3.5, (0, 0.067, 0.034), (0.017, 0.0164, 0.006), 120, 75, 176),
    ((0, 0.1845, 0), (-_QUARTER, np.pi, 0), 3.5, (0.0001, 0.021, 0.076), (0.01, 0.0087, 0.00449), 170, 130, 110),
    ((0, 0, 0.2155), (_QUARTER, 0, 0), 1.8, (0, 0.0006, 0.0004), (0.0049, 0.0047, 0.0036), 120, 135, 40),
    ((0, 0.081, 0), (-_QUARTER, np.pi, 0), 1.2, (0, 0, 0.02), (0.001, 0.001, 0.001), 175, 135, 40),
)


def iiwa(*, gravity: Numbers | None = GRAVITY, dtype: DType | None = None) -> Model:
    """KUKA LBR iiwa 14 arm: seven revolute joints on a fixed base.

    Joints iiwa_joint_1 .. 7 move bodies iiwa_link_1 .. 7 about their z axes; the frame iiwa_link_0 is the base.

    Source: kinematics and inertias of Drake's benchmark kuka_iiwa_robot; limits (rad, rad/s, N m) of KUKA's data sheet.
    """
    builder = ModelBuilder("iiwa", gravity=gravity, dtype=dtype).add_body("iiwa_link_0", joint="fixed")
    for i, (place, rpy, *inertia, degrees, speed, torque) in enumerate(_IIWA):
        builder.add_body(
            f"iiwa_link_{i + 1}",
            f"iiwa_link_{i}",
            "revolute",
            inertia,
            joint_name=f"iiwa_joint_{i + 1}",
            pose=(place, rpy),
            lower=-np.radians(degrees),
            upper=np.radians(degrees),
            velocity_limit=np.radians(speed),
            effort_limit=torque,
        )
    return builder.build()


# A finger of the Allegro hand from its palm to its tip: (mass, moments xx, yy, zz, products xy, yz, xz) of a link about its own
# frame's origin, which is its centre of mass, kg and kg m^2; the length to the next link, m; and the limits of its joint, rad.
_ALLEGRO_FINGER = (
    (0.0119, (1.01666658333e-06, 6.47677333333e-07, 1.01666658333e-06), (0, 0, 0), 0.0164, (-0.47, 0.47)),
    (
        0.065,
        (8.08728875979549e-05, 2.85700490570738e-05, 7.96647061621031e-05),
        (1.48386162019941e-05, 2.14347646011766e-05, 4.2343545689576e-06),
        0.054,
        (-0.196, 1.61),
    ),
    (
        0.0355,
        (2.7108908376807e-05, 1.49716294427206e-05, 2.66287347075153e-05),
        (5.4115225794551e-06, 7.93657186922407e-06, 2.85079817622615e-06),
        0.0384,
        (-0.174, 1.709),
    ),
    (
        0.0096,
        (4.701248e-06, 3.649312e-06, 4.701248e-06),
        (1.255968e-06, 1.7622e-06, 1.2936e-06),
        0.0267,
        (-0.227, 1.618),
    ),
)
_ALLEGRO_THUMB = (
    (
        0.0176,
        (1.96731938544998e-05, 1.55885860593306e-05, 1.97505895464656e-05),
        (5.34714941558415e-06, 5.0204641842028e-06, 3.28371818678657e-06),
        (-0.027, 0.005, 0.0399),
        (0.263, 1.396),
    ),
    (
        0.0119,
        (4.3875110939419e-06, 4.65422984297958e-06, 4.34097290977866e-06),
        (7.95929506936549e-07, 1.18904291699917e-06, 1.35226331844583e-06),
        0.0177,
        (-0.105, 1.163),
    ),
    (
        0.038,
        (4.3811817294825e-05, 1.66059448592103e-05, 4.31323573125218e-05),
        (8.18299639785789e-06, 1.1844769255572e-05, 2.55404234759754e-06),
        0.0514,
        (-0.189, 1.644),
    ),
    (
        0.0388,
        (3.29223173333e-05, 1.47493026667e-05, 3.29223173333e-05),
        (8.042076e-06, 1.1283525e-05, 5.2283e-06),
        0.0423,
        (-0.162, 1.719),
    ),
)
# Pose of each finger on the palm, and the axes of its joints.
_BEND = ((0, 0, 1), (0, 1, 0), (0, 1, 0), (0, 1, 0))
_ALLEGRO = (
    (((0, 0.0435, -0.001542), (-0.08726646255, 0, 0)), _BEND, _ALLEGRO_FINGER),
    ((0, 0, 0.0007), _BEND, _ALLEGRO_FINGER),
    (((0, -0.0435, -0.001542), (0.08726646255, 0, 0)), _BEND, _ALLEGRO_FINGER),
    (
        ((-0.0182, 0.019333, -0.045987), (0, -1.65806278845, -1.5707963259)),
        ((-1, 0, 0), (0, 0, 1), (0, 1, 0), (0, 1, 0)),
        _ALLEGRO_THUMB,
    ),
)
_ALLEGRO_TIP = (0.0168, (0, 0, 0), (9.68e-07,) * 3)


def allegro(*, gravity: Numbers | None = GRAVITY, dtype: DType | None = None) -> Model:
    """Right Allegro hand: index, middle and ring finger and a thumb of four revolute joints each on a fixed palm.

    Joints joint_0.0 .. 3.0 are those of the index finger from the palm outwards, 4 .. 7 of the middle finger, 8 .. 11 of the ring
    finger and 12 .. 15 of the thumb; they move bodies link_0.0 .. link_15.0. The frames link_3.0_tip, link_7.0_tip, link_11.0_tip
    and link_15.0_tip are in the middles of the fingertips, 12 mm balls; the frame palm_link is the palm.

    Source: allegro_right_hand.urdf of Wonik Robotics (allegro_hand_linux_v4, BSD); its damping and friction are left out. The
    moments of inertia of its last links break the triangle inequality; they are those of `jd.model.repair_inertias`.
    """
    palm = (0.4154, (0, 0, 0.0475), (1e-4, 1e-4, 1e-4))
    builder = ModelBuilder("allegro", gravity=gravity, dtype=dtype).add_body(
        "palm_link", None, "fixed", palm, joint_name="root_joint"
    )
    for finger, (place, axes, links) in enumerate(_ALLEGRO):
        parent, pose = "palm_link", place
        for i, (axis, (mass, moments, products, length, (lower, upper))) in enumerate(zip(axes, links, strict=True)):
            number, (xy, yz, xz) = 4 * finger + i, products
            moment = np.diag(moments) + np.array([[0, xy, xz], [xy, 0, yz], [xz, yz, 0]])
            body = np.asarray(host_math.inertia_numbers((mass, np.zeros(3), moment), "link"))
            # Of the file's numbers those that no body has are replaced by the nearest ones that a body has.
            body = np.asarray(nearest_feasible(body), float) if host_math.inertia_fault(body) else body
            builder.add_body(
                f"link_{number}.0",
                parent,
                "revolute",
                body,
                joint_name=f"joint_{number}.0",
                axis=axis,
                pose=pose,
                lower=lower,
                upper=upper,
                velocity_limit=7,
                effort_limit=15,
            )
            parent, pose = f"link_{number}.0", length if isinstance(length, tuple) else (0, 0, length)
        builder.add_body(
            f"{parent}_tip", parent, "fixed", _ALLEGRO_TIP, joint_name=f"joint_{parent[5:]}_tip", pose=pose
        )
    return builder.build()


# For each joint: name, position in its parent and rotation there about y (deg), axis, limits of angle, speed and torque; for its
# body: mass, centre of mass, radius and length of a cylinder along z.
_UR5 = (
    ("shoulder_pan", (0, 0, 0.089159), 0, "z", 360, 3.15, 150, 3.7, 0.0, 0.06, 0.15),
    ("shoulder_lift", (0, 0.13585, 0), 90, "y", 360, 3.15, 150, 8.393, 0.28, 0.06, 0.56),
    ("elbow", (0, -0.1197, 0.425), 0, "y", 180, 3.15, 150, 2.275, 0.25, 0.06, 0.5),
    ("wrist_1", (0, 0, 0.39225), 90, "y", 360, 3.2, 28, 1.219, 0.0, 0.045, 0.12),
    ("wrist_2", (0, 0.093, 0), 0, "z", 360, 3.2, 28, 1.219, 0.0, 0.045, 0.12),
    ("wrist_3", (0, 0, 0.09465), 0, "y", 360, 3.2, 28, 0.1879, 0.0, 0.045, 0.04),
)


def ur5(*, gravity: Numbers | None = GRAVITY, dtype: DType | None = None) -> Model:
    """Universal Robots UR5 arm: six revolute joints on a fixed base.

    Joints shoulder_pan, shoulder_lift, elbow, wrist_1, wrist_2, wrist_3 move bodies of the same names with _link behind; the
    frames are base_link and tool0, the flange, with z outwards.

    Source: lengths, masses, centres of mass and limits (rad/s, N m) as published by the manufacturer and used in ROS
    descriptions of the arm. Moments of inertia are not published: each body is a uniform cylinder of its mass.
    """
    axes = {"y": (0, 1, 0), "z": (0, 0, 1)}
    builder = ModelBuilder("ur5", gravity=gravity, dtype=dtype).add_body("base_link", joint="fixed")
    parent = "base_link"
    for name, place, turn, axis, degrees, speed, torque, mass, com, radius, length in _UR5:
        builder.add_body(
            f"{name}_link",
            parent,
            "revolute",
            displaced(cylinder(mass, radius, length), (0, 0, com)),
            joint_name=name,
            pose=(place, (0, np.radians(turn), 0)),
            axis=axes[axis],
            lower=-np.radians(degrees),
            upper=np.radians(degrees),
            velocity_limit=speed,
            effort_limit=torque,
        )
        parent = f"{name}_link"
    return builder.add_frame("tool0", parent, ((0, 0.0823, 0), (-_QUARTER, 0, 0))).build()


def quadruped(*, floating_base: bool = True, gravity: Numbers | None = GRAVITY, dtype: DType | None = None) -> Model:
    """Generic quadruped of about 12 kg: a trunk and, for each leg, hip, thigh and shank.

    Legs are FL, FR, RL, RR; joints LEG_hip turn about x, LEG_thigh and LEG_knee about y; feet are frames LEG_foot. At q = 0 legs
    hang straight, 0.4 m long; thigh 0.8 and knee -1.6 rad stand it up. With `floating_base` the trunk's pose comes first in q.

    Source: none; sizes and masses are round numbers typical of such robots.
    """
    builder = ModelBuilder("quadruped", gravity=gravity, dtype=dtype)
    trunk = "free" if floating_base else "fixed"
    builder.add_body("trunk", joint=trunk, joint_name="root_joint", inertia=box(6.0, (0.4, 0.2, 0.1)))
    for leg, x, y in (("FL", 1, 1), ("FR", 1, -1), ("RL", -1, 1), ("RR", -1, -1)):
        limb = displaced(cylinder(0.5, 0.02, 0.2), (0, 0, -0.1))
        hip = displaced(sphere(0.5, 0.04), (0, 0.04 * y, 0))
        for name, parent, place, axis, inertia, reach in (
            ("hip", "trunk", (0.2 * x, 0.06 * y, 0), (1, 0, 0), hip, (-0.9, 0.9)),
            ("thigh", f"{leg}_hip_link", (0, 0.08 * y, 0), (0, 1, 0), limb, (-1.6, 3.2)),
            ("knee", f"{leg}_thigh_link", (0, 0, -0.2), (0, 1, 0), limb, (-2.7, 0.0)),
        ):
            builder.add_body(
                f"{leg}_{name}_link",
                parent,
                "revolute",
                inertia,
                joint_name=f"{leg}_{name}",
                pose=place,
                axis=axis,
                lower=reach[0],
                upper=reach[1],
                velocity_limit=20.0,
                effort_limit=25.0,
            )
        builder.add_frame(f"{leg}_foot", f"{leg}_knee_link", (0, 0, -0.2))
    return builder.build()


def chain(
    n: int, *, length: Number = 1.0, mass: Number = 1.0, gravity: Numbers | None = GRAVITY, dtype: DType | None = None
) -> Model:
    """A hanging chain of n uniform thin rods on revolute joints about y: a planar n-fold pendulum, at rest at q = 0.

    **Arguments:** `n`: number of rods; `length` (m) and `mass` (kg) of each rod.

    **Raises:** ValueError for n < 1.
    """
    if n < 1:
        raise ValueError(f"n is {n}; a chain needs at least one rod")
    builder = ModelBuilder(f"chain {n}", gravity=gravity, dtype=dtype)
    moment = mass * length**2 / 12
    rod = (mass, (0, 0, -length / 2), (moment, moment, 0.0))
    for i in range(n):
        parent, place = (f"rod_{i - 1}", (0, 0, -length)) if i else (None, (0, 0, 0))
        builder.add_body(f"rod_{i}", parent, "revolute", rod, axis=(0, 1, 0), pose=place)
    return builder.build()


def random_tree(
    seed: int | Array,
    nb: int,
    *,
    branching: Number = 1.5,
    skew: Number = 1.0,
    taper: Number = 0.95,
    kinds: Sequence[str] = tuple(KINDS),
    gravity: Numbers | None = GRAVITY,
    dtype: DType | None = None,
) -> Model:
    """A random tree of bodies with physical inertias and every kind of joint (after autoTree of spatial_v2).

    The parent of body i is body floor((i - 1) / branching), so 1 gives a chain, 2 a binary tree and nb a broom. The kinds are
    drawn without replacement, in a new random order each time all have been used. Helical joints have any
    screw, with an axis that misses the frame's origin.

    **Arguments:**

    - `seed`: an integer, or a jax key.
    - `nb`: number of bodies, those on fixed joints (kind "fixed") included.
    - `branching`: mean number of children of a body that has any, at least 1.
    - `skew`: spread of the rotations between joint frames, rad; 0 makes them parallel.
    - `taper`: ratio of the lengths of successive bodies; masses go with its cube.
    - `kinds`: the joint kinds to use.

    **Raises:** ValueError for nb < 1, branching < 1, taper not positive, or an unknown kind.
    """
    if nb < 1 or branching < 1 or not taper > 0:
        raise ValueError(f"nb is {nb}, branching {branching}, taper {taper}; give nb >= 1, branching >= 1, taper > 0")
    if unknown := [kind for kind in kinds if kind not in KINDS and kind != "fixed"]:
        raise ValueError(f"kinds {unknown} are unknown; kinds are fixed, {', '.join(KINDS)}")
    if isinstance(seed, jax.Array):
        # Traces of keys give the same tree: only the key's data, known numbers, seed numpy's generator.
        seed = np.asarray(jax.random.key_data(seed)).tolist()
    rng = np.random.default_rng(seed)
    builder = ModelBuilder(f"random tree {nb}", gravity=gravity, dtype=dtype)
    depths: list[int] = []
    deck: list[str] = []
    for i in range(nb):
        parent = int((i - 1) / branching) if i else None
        depths.append(0 if parent is None else depths[parent] + 1)
        if not deck:
            deck = list(rng.permutation(np.asarray(kinds)))
        kind = str(deck.pop())
        size = taper ** depths[i]
        # A body is a cloud of point masses, so its inertia is physical; eight of them are never in one plane.
        points, masses = size * rng.uniform(-0.3, 0.3, (8, 3)), size**3 * rng.uniform(0.1, 0.3, 8)
        com = masses @ points / masses.sum()
        arms = points - com
        second = (masses[:, None] * arms).T @ arms
        inertia = (masses.sum(), com, np.trace(second) * np.eye(3) - second)
        axes = {}
        if kind in ("revolute", "continuous", "prismatic"):
            axes["axis"] = np.array([0, 0, 1.0]) + skew * rng.normal(size=3)
        elif kind == "helical":
            # Six random numbers give a pitch and an axis that misses the origin with probability one.
            axes["screw"] = rng.normal(size=6)
        pose = (size * rng.uniform(-0.5, 0.5, 3), skew * rng.normal(size=3))
        # Leading zeros keep the order of names that of the numbers, as the builder sorts by name.
        label = f"{i:0{len(str(nb))}d}"
        builder.add_body(
            f"body_{label}",
            None if parent is None else f"body_{parent:0{len(str(nb))}d}",
            kind,
            inertia,
            joint_name=f"joint_{label}",
            pose=pose,
            **axes,
        )
    return builder.build()


__all__ = [
    "allegro",
    "chain",
    "iiwa",
    "quadruped",
    "random_tree",
    "ur5",
]


def __dir__() -> list[str]:
    return __all__
