"""Built-in mechanisms: a real arm, and generators of chains and random trees."""

import jax
import numpy as np

from jaxdyn.model.builder import GRAVITY, ModelBuilder
from jaxdyn.model.joints import KINDS
from jaxdyn.model.tree import Model

_QUARTER = np.pi / 2
_IIWA_RPY = (
    (0, 0, 0),
    (_QUARTER, 0, np.pi),
    (_QUARTER, 0, np.pi),
    (_QUARTER, 0, 0),
    (-_QUARTER, np.pi, 0),
    (_QUARTER, 0, 0),
    (-_QUARTER, np.pi, 0),
)
_IIWA_XYZ = (
    (0, 0, 0.1575),
    (0, 0, 0.2025),
    (0, 0.2045, 0),
    (0, 0, 0.2155),
    (0, 0.1845, 0),
    (0, 0, 0.2155),
    (0, 0.081, 0),
)
_IIWA_INERTIAS = (
    (5.76, (0, -0.03, 0.12), (0.033, 0.0333, 0.0123)),
    (6.35, (0.0003, 0.059, 0.042), (0.0305, 0.0304, 0.011)),
    (3.5, (0, 0.03, 0.13), (0.025, 0.0238, 0.0076)),
    (3.5, (0, 0.067, 0.034), (0.017, 0.0164, 0.006)),
    (3.5, (0.0001, 0.021, 0.076), (0.01, 0.0087, 0.00449)),
    (1.8, (0, 0.0006, 0.0004), (0.0049, 0.0047, 0.0036)),
    (1.2, (0, 0, 0.02), (0.001, 0.001, 0.001)),
)
_IIWA_DEGREES = (170, 120, 170, 120, 170, 120, 175)
_IIWA_DEGREES_PER_SECOND = (85, 85, 100, 75, 130, 135, 135)
_IIWA_TORQUES = (320, 320, 176, 176, 110, 40, 40)


def iiwa(*, gravity=GRAVITY, dtype=None) -> Model:
    """The arm KUKA LBR iiwa 14: seven revolute joints on a fixed base.

    Joints iiwa_joint_1 .. 7 move bodies iiwa_link_1 .. 7 about their z axes; the frame iiwa_link_0 is the base.

    Source: kinematics and inertias of Drake's benchmark kuka_iiwa_robot; limits (rad, rad/s, N m) of KUKA's data sheet.
    """
    builder = ModelBuilder("iiwa", gravity=gravity, dtype=dtype).add_body("iiwa_link_0", joint="fixed")
    for i in range(7):
        reach = np.radians(_IIWA_DEGREES[i])
        builder.add_body(
            f"iiwa_link_{i + 1}",
            f"iiwa_link_{i}",
            "revolute",
            _IIWA_INERTIAS[i],
            joint_name=f"iiwa_joint_{i + 1}",
            pose=(_IIWA_XYZ[i], _IIWA_RPY[i]),
            lower=-reach,
            upper=reach,
            velocity_limit=np.radians(_IIWA_DEGREES_PER_SECOND[i]),
            effort_limit=_IIWA_TORQUES[i],
        )
    return builder.build()


def chain(n: int, *, length=1.0, mass=1.0, gravity=GRAVITY, dtype=None) -> Model:
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
    seed,
    nb: int,
    *,
    branching=1.5,
    skew=1.0,
    taper=0.95,
    kinds=tuple(KINDS),
    gravity=GRAVITY,
    dtype=None,
) -> Model:
    """A random tree of bodies with physical inertias and every kind of joint (after autoTree of spatial_v2).

    Body i hangs on body floor((i - 1) / branching), so 1 gives a chain, 2 a binary tree and nb a broom. The kinds are
    dealt out in a shuffled order until all have been used, then again. Helical joints have any screw, with an axis that
    misses the frame's origin.

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
            axes["screw"] = rng.normal(size=6)
        pose = (size * rng.uniform(-0.5, 0.5, 3), skew * rng.normal(size=3))
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
