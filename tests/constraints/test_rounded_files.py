"""Mechanisms in files that hold few digits: rows that would repeat others but for rounding are dropped, and said."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from scipy.spatial.transform import Rotation

import jaxdyn as jd

TILT = Rotation.from_euler("xyz", [0.3, -0.5, 0.7])
TIMES = jnp.linspace(0.0, 2.0, 5)
# A crank of 0.3 m, a rod of 0.8 m and a rocker, in a plane whose normal is y before the tilt: angle and origin of each bar.
BARS = {"crank": (0.2, (0.0, 0.0, 0.0)), "rod": (1.1, (0.3, 0.0, 0.05)), "rocker": (0.4, (0.9, 0.0, -0.1))}
TIP = (0.75, 0.0, 0.33)
PARENTS = {"crank": "world", "rod": "crank", "rocker": "world"}
MOMENTS = (0.02, 0.03, 0.025)


def pose_of(name, tilt):
    angle, origin = BARS[name]
    return tilt * Rotation.from_euler("y", angle), tilt.apply(origin)


def relative(name, tilt):
    turn, place = pose_of(name, tilt)
    if PARENTS[name] == "world":
        return turn, place
    other, origin = pose_of(PARENTS[name], tilt)
    return other.inv() * turn, other.inv().apply(place - origin)


def tip_in(name, tilt):
    turn, place = pose_of(name, tilt)
    return turn.inv().apply(tilt.apply(TIP) - place)


class Writer:
    """Text of a file with a number of digits after the point."""

    def __init__(self, digits):
        self.digits = digits

    def __call__(self, *numbers):
        return " ".join(f"{x:.{self.digits}f}" for x in np.concatenate([np.ravel(x) for x in numbers]))

    def inertial(self, place="0.1 0.01 0.05"):
        return f'<mass value="1.3"/><inertia ixx="{MOMENTS[0]}" iyy="{MOMENTS[1]}" izz="{MOMENTS[2]}" ixy="0" ixz="0" iyz="0"/>'


def sdf(path, digits, tilt):
    text = Writer(digits)
    links = ""
    for name in BARS:
        turn, place = pose_of(name, tilt)
        links += (
            f"<link name='{name}'><pose>{text(place, turn.as_euler('xyz'))}</pose><inertial><pose>0.1 0.01 0.05 0 0 0</pose>"
            f"<mass>1.3</mass><inertia><ixx>0.02</ixx><iyy>0.03</iyy><izz>0.025</izz></inertia></inertial></link>"
        )
    for joint, name in zip("abc", BARS, strict=True):
        links += (
            f"<joint name='{joint}' type='revolute'><parent>{PARENTS[name]}</parent><child>{name}</child>"
            "<axis><xyz>0 1 0</xyz></axis></joint>"
        )
    place = text(tip_in("rocker", tilt))
    links += (
        f"<joint name='d' type='revolute'><pose>{place} 0 0 0</pose><parent>rod</parent><child>rocker</child>"
        "<axis><xyz>0 1 0</xyz></axis></joint>"
    )
    path = path.with_suffix(".sdf")
    path.write_text(f"<sdf version='1.9'><model name='bars'>{links}</model></sdf>")
    return path


def urdf_text(digits, tilt, turns=False):
    text = Writer(digits)
    parts = "<link name='world'/>"
    for joint, name in zip("abc", BARS, strict=True):
        turn, place = relative(name, tilt)
        parts += (
            f"<link name='{name}'><inertial><origin xyz='0.1 0.01 0.05'/>{text.inertial()}</inertial></link>"
            f"<joint name='{joint}' type='revolute'><origin xyz='{text(place)}' rpy='{text(turn.as_euler('xyz'))}'/>"
            f"<parent link='{PARENTS[name]}'/><child link='{name}'/><axis xyz='0 1 0'/>"
            "<limit lower='-9' upper='9' effort='9' velocity='9'/></joint>"
        )
    for name in ("rod", "rocker"):
        turn = pose_of(name, tilt)[0].inv() * tilt
        kind = "revolute" if turns and name == "rod" else "fixed"
        parts += (
            f"<link name='tip_{name}'>"
            + (f"<inertial>{text.inertial()}</inertial>" if turns and name == "rod" else "")
            + f"</link><joint name='to_{name}' type='{kind}'>"
            f"<origin xyz='{text(tip_in(name, tilt))}' rpy='{text(turn.as_euler('xyz'))}'/><parent link='{name}'/>"
            f"<child link='tip_{name}'/><axis xyz='0 1 0'/>"
            "<limit lower='-9' upper='9' effort='9' velocity='9'/></joint>"
        )
    return f"<robot name='bars'>{parts}</robot>"


def urdf(path, digits, tilt, kind="3d"):
    path = path.with_suffix(".urdf")
    path.write_text(urdf_text(digits, tilt, turns=kind == "6d"))
    path.with_suffix(".yaml").write_text(f"closed_loop: [[tip_rod, tip_rocker]]\ntype: [{kind}]\n")
    return path


def urdf_6d(path, digits, tilt):
    return urdf(path, digits, tilt, "6d")


def mjcf(path, digits, tilt):
    text = Writer(digits)

    def body(name, inner=""):
        turn, place = relative(name, tilt)
        moments = " ".join(map(str, MOMENTS))
        return (
            f"<body name='{name}' pos='{text(place)}' quat='{text(np.roll(turn.as_quat(), 1))}'>"
            f"<inertial pos='0.1 0.01 0.05' mass='1.3' diaginertia='{moments}'/>"
            f"<joint name='j_{name}' axis='0 1 0'/>{inner}</body>"
        )

    bodies = body("crank", body("rod")) + body("rocker")
    anchor = text(tip_in("rod", tilt))
    path = path.with_suffix(".xml")
    path.write_text(
        f"<mujoco><compiler angle='radian'/><worldbody>{bodies}</worldbody>"
        f"<equality><connect name='d' body1='rod' body2='rocker' anchor='{anchor}'/></equality></mujoco>"
    )
    return path


WRITERS = {"sdf": sdf, "urdf_3d": urdf, "urdf_6d": urdf_6d, "mjcf": mjcf}


def crank_angles(path, **options):
    """Of a motion from the reference under gravity, and the solution."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = jd.load(path)
    start = jd.assemble(scene, scene.starts["reference"].q, guesses=1)
    motion = jd.simulate(scene, start.q, start.v, TIMES, stepsize=within(1e-9), **options)
    return np.asarray(motion.q[:, 0] - motion.q[0, 0]), motion, start, scene


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    """The motion with all digits: of the three bars, and with a body at the tip."""
    folder = tmp_path_factory.mktemp("exact")
    return functools.cache(lambda kind: crank_angles(WRITERS[kind](folder / kind, 17, TILT))[0])


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "digits"),
    [
        ("sdf", 8),
        ("urdf_3d", 5),
        ("mjcf", 6),
        *(
            pytest.param(kind, digits, marks=pytest.mark.slow)
            for kind in WRITERS
            for digits in (4, 5, 6, 8, 12)
            if (kind, digits) not in (("sdf", 8), ("urdf_3d", 5), ("mjcf", 6))
        ),
    ],
)
def test_a_four_bar_with_few_digits_moves_as_with_all(tmp_path, exact, kind, digits):
    angles, motion, start, scene = crank_angles(WRITERS[kind](tmp_path / kind, digits, TILT))
    assert bool(motion.success) and bool(start.success)
    rounding = 0.5 * 10.0**-digits
    # The crank swings by 1.9 rad. What rounding changes in lengths and in the plane's angle to gravity changes the time of a
    # swing: by 10 units of the last digit in the worst of these files, 20 where quaternions hold half of the angle.
    want = exact("urdf_6d" if kind == "urdf_6d" else "mjcf")
    assert np.ptp(want) > 1.5
    np.testing.assert_allclose(angles, want, atol=60 * rounding + 1e-8)
    redundant = {"urdf_3d": 1, "mjcf": 1, "urdf_6d": 3}.get(kind, 3)
    assert int(motion.stats.get("redundant_rows", 0)) == redundant or digits == 12
    (line,) = start.redundancies()
    said = f"dropped {redundant} redundant row"
    assert said in line and line in str(start) and (said in str(motion) or digits == 12)
    assert float(start.gaps.max()) < 20 * rounding
    kept = 1 - np.asarray(start.dropped)
    phi = jax.jit(lambda q: jnp.concatenate([c.position(scene.system, q, 0.0) for c in scene.constraints]))(start.q)
    assert np.abs(kept * np.asarray(phi)).max() < 1e-12
