"""Linkages written as files: each from the points where its bars meet, in any of four formats, closed at zero.

Bars lie in the x-z plane and turn about y; a bar is rigid through its points, so that any points make a closed configuration. A
tree of them is chosen breadth first from the ground; the joints that are left close loops. Spatial mechanisms follow: a
platform on six legs (URDF, balls and loops in the YAML file), a delta robot (MJCF), Bennett's linkage (SDF).
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

# Points (x, z) in m, and bars by the points that they join; "ground" stands still.
PLANAR = {
    "four_bar": (
        dict(A=(0, 0), B=(0.1, 0.3), C=(0.8, 0.45), D=(0.7, 0)),
        dict(ground="AD", crank="AB", rod="BC", rocker="DC"),
    ),
    "five_bar": (
        dict(A=(0, 0), B=(-0.3, 0.4), C=(0.2, 0.9), D=(0.7, 0.4), E=(0.4, 0)),
        dict(ground="AE", left="AB", upper_left="BC", right="ED", upper_right="DC"),
    ),
    "watt": (
        dict(A=(0, 0), B=(0.1, 0.3), C=(0.6, 0.5), D=(0.5, 0), E=(0.7, 0.3), F=(1.2, 0.5), G=(1.1, 0)),
        dict(ground="ADG", crank="AB", rod="BC", rocker="DCE", link="EF", output="GF"),
    ),
    "stephenson": (
        dict(A=(0, 0), B=(0.1, 0.25), C=(0.6, 0.5), D=(0.7, 0), E=(0.4, 0.7), F=(1.0, 0.9), G=(1.2, 0.2)),
        dict(ground="ADG", crank="AB", coupler="BCE", rocker="DC", link="EF", output="GF"),
    ),
    "peaucellier": (
        dict(O=(0, 0), Q=(0.3, 0.1), A=(0.8, 0.35), B=(0.8, -0.35), C=(0.55, 0.05), D=(1.05, -0.02)),
        dict(ground="OQ", arm_1="OA", arm_2="OB", link="QC", side_1="AC", side_2="CB", side_3="BD", side_4="DA"),
    ),
    "jansen": (
        dict(O=(0, 0), P=(-0.38, -0.08), C=(0.15, 0.05), T=(-0.2, 0.3), L=(-0.75, 0.05), K=(-0.25, -0.45))
        | dict(F=(-0.62, -0.38), W=(-0.3, -0.95)),
        dict(ground="OP", crank="OC", upper="CT", knee="PTL", lower="CK", thigh="PK", shin="LF", foot="KFW"),
    ),
}


def _tree(bars: dict[str, str]) -> tuple[list[tuple[str, str, str]], list[tuple[str, str, str]]]:
    """Joints (point, carrier, carried) of a tree from the ground, breadth first, and those that close loops."""
    edges = []
    for point in dict.fromkeys("".join(bars.values())):
        first, *rest = [bar for bar, points in bars.items() if point in points]
        edges += [(point, first, other) for other in rest]
    reached, queue, tree = {"ground"}, ["ground"], []
    while queue:
        bar = queue.pop(0)
        for edge in edges:
            ends = edge[1:]
            if bar in ends and (other := ends[ends[0] == bar]) not in reached:
                reached.add(other)
                queue.append(other)
                tree.append((edge[0], bar, other))
    used = {(point, frozenset((a, b))) for point, a, b in tree}
    return tree, [edge for edge in edges if (edge[0], frozenset(edge[1:])) not in used]


def _rod(points: list[np.ndarray]) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass (1 kg/m), centre of mass and moments about it of a bar through points, as of a thin box around them."""
    middle = np.mean(points, axis=0)
    size = 0.03 + np.ptp(points, axis=0)
    mass = float(np.hypot(*size))
    x, z = size
    moments = mass / 12 * np.array([z**2 + 0.03**2, x**2 + z**2, x**2 + 0.03**2])
    return mass, np.array([middle[0], 0.0, middle[1]]), moments


def _words(*numbers) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(numbers))


class _Planar:
    """A planar linkage as data: frames of bars stand where the bar is carried, with the world's axes."""

    def __init__(self, name: str):
        points, bars = PLANAR[name]
        self.name, self.bars = name, bars
        self.points = {label: np.array(point, float) for label, point in points.items()}
        self.tree, self.loops = _tree(bars)
        self.origins = {"ground": np.zeros(2)} | {bar: self.points[point] for point, _, bar in self.tree}

    def at(self, bar: str, point: str) -> np.ndarray:
        """A point (3,) in a bar's frame."""
        x, z = self.points[point] - self.origins[bar]
        return np.array([x, 0.0, z])

    def inertia(self, bar: str):
        return _rod([self.points[p] - self.origins[bar] for p in self.bars[bar]])


def urdf(linkage: _Planar, loops: str) -> str:
    """A URDF; `loops`: "yaml", frames for `yaml_of`, or "gazebo", joints in `<gazebo>`."""
    links, joints, rest = ['<link name="ground"/>'], [], []
    for point, carrier, bar in linkage.tree:
        mass, com, moments = linkage.inertia(bar)
        inertia = " ".join(
            f'{key}="{value!r}"' for key, value in zip(("ixx", "iyy", "izz"), moments.tolist(), strict=True)
        )
        links.append(
            f'<link name="{bar}"><inertial><origin xyz="{_words(com)}"/><mass value="{mass!r}"/>'
            f'<inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        joints.append(
            f'<joint name="{carrier}_{bar}" type="continuous"><origin xyz="{_words(linkage.at(carrier, point))}"/>'
            f'<parent link="{carrier}"/><child link="{bar}"/><axis xyz="0 1 0"/></joint>'
        )
    for point, a, b in linkage.loops:
        if loops == "gazebo":
            rest.append(
                f'<gazebo><joint name="{point}_{a}_{b}" type="revolute"><parent>{a}</parent><child>{b}</child>'
                f"<pose>{_words(linkage.at(b, point))} 0 0 0</pose><axis><xyz>0 1 0</xyz></axis></joint></gazebo>"
            )
            continue
        for bar, end in ((a, "A"), (b, "B")):
            frame = f"{point}_{a}_{b}_{end}"
            links.append(f'<link name="{frame}"/>')
            joints.append(
                f'<joint name="{frame}_fixed" type="fixed"><origin xyz="{_words(linkage.at(bar, point))}"/>'
                f'<parent link="{bar}"/><child link="{frame}"/></joint>'
            )
    return f'<robot name="{linkage.name}">' + "\n".join([*links, *joints, *rest]) + "</robot>\n"


def yaml_of(linkage: _Planar) -> str:
    """The loops of a URDF whose frames stand in it."""
    pairs = [[f"{point}_{a}_{b}_A", f"{point}_{a}_{b}_B"] for point, a, b in linkage.loops]
    return f"closed_loop: {pairs}\ntype: {['3d'] * len(pairs)}\nname_mot: [{linkage.tree[0][1]}_{linkage.tree[0][2]}]\n"


def sdf(linkage: _Planar) -> str:
    """An SDF 1.7 with a joint wherever bars meet."""
    parts = []
    for bar, origin in linkage.origins.items():
        mass, com, moments = (1.0, np.zeros(3), np.ones(3)) if bar == "ground" else linkage.inertia(bar)
        parts.append(
            f"<link name='{bar}'><pose>{_words(origin[0], 0, origin[1])} 0 0 0</pose><inertial><pose>{_words(com)} 0 0 0</pose>"
            f"<mass>{mass!r}</mass><inertia>"
            + "".join(f"<{k}>{v!r}</{k}>" for k, v in zip(("ixx", "iyy", "izz"), moments.tolist(), strict=True))
            + "</inertia></inertial></link>"
        )
    parts.append("<joint name='base' type='fixed'><parent>world</parent><child>ground</child></joint>")
    for point, a, b in (*linkage.tree, *linkage.loops):
        parts.append(
            f"<joint name='{point}_{a}_{b}' type='revolute'><parent>{a}</parent><child>{b}</child>"
            f"<pose>{_words(linkage.at(b, point))} 0 0 0</pose><axis><xyz>0 1 0</xyz></axis></joint>"
        )
    return f"<sdf version='1.7'><model name='{linkage.name}'>" + "\n".join(parts) + "</model></sdf>\n"


def mjcf(linkage: _Planar) -> str:
    """An MJCF whose loops are `connect`."""

    def body(bar: str) -> str:
        inner = []
        for point, carrier, carried in linkage.tree:
            if carrier != bar:
                continue
            mass, com, moments = linkage.inertia(carried)
            inner.append(
                f'<body name="{carried}" pos="{_words(linkage.at(bar, point))}"><joint name="{bar}_{carried}" axis="0 1 0"/>'
                f'<inertial pos="{_words(com)}" mass="{mass!r}" diaginertia="{_words(moments)}"/>{body(carried)}</body>'
            )
        return "\n".join(inner)

    rows = [
        f'<connect name="{point}_{a}_{b}" body1="{a.replace("ground", "world")}" body2="{b.replace("ground", "world")}" '
        f'anchor="{_words(linkage.at(a, point))}"/>'
        for point, a, b in linkage.loops
    ]
    return (
        f'<mujoco model="{linkage.name}"><worldbody>{body("ground")}</worldbody>'
        f"<equality>{''.join(rows)}</equality></mujoco>\n"
    )


def platform() -> tuple[str, str]:
    """A platform on six legs, each on two crossed hinges, with a slide and a ball: URDF and YAML. The first leg carries it."""
    solid = '<inertial>{origin}<mass value="{mass}"/><inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
    links, joints, pairs = ['<link name="base"/>'], [], []
    feet = np.deg2rad([10, 110, 130, 230, 250, 350])
    hands = np.deg2rad([50, 70, 170, 190, 290, 310])
    limit = '<limit lower="-2" upper="2" effort="500" velocity="5"/>'
    balls, first = [], None
    for k in range(6):
        foot = 0.5 * np.array([np.cos(feet[k]), np.sin(feet[k]), 0.0])
        hand = 0.3 * np.array([np.cos(hands[k]), np.sin(hands[k]), 0.0]) + np.array([0, 0, 0.7])
        leg = hand - foot
        pitch, yaw = np.arctan2(np.hypot(leg[0], leg[1]), leg[2]), np.arctan2(leg[1], leg[0])
        for name, mass in ((f"cross_{k}", 0.1), (f"lower_{k}", 1.0), (f"upper_{k}", 0.8)):
            links.append(f'<link name="{name}">{solid.format(origin="", mass=mass, i=0.01 * mass)}</link>')
        joints += [
            f'<joint name="hip_{k}_x" type="continuous"><origin xyz="{_words(foot)}" rpy="{_words(0, pitch, yaw)}"/>'
            f'<parent link="base"/><child link="cross_{k}"/><axis xyz="1 0 0"/></joint>',
            f'<joint name="hip_{k}_y" type="continuous"><parent link="cross_{k}"/><child link="lower_{k}"/>'
            '<axis xyz="0 1 0"/></joint>',
            f'<joint name="slide_{k}" type="prismatic"><origin xyz="0 0 {float(np.linalg.norm(leg))!r}"/>'
            f'<parent link="lower_{k}"/><child link="upper_{k}"/><axis xyz="0 0 1"/>{limit}</joint>',
        ]
        if k == 0:
            first = hand
            # The platform's axes are the world's: the turn of the leg is taken back.
            turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]) @ np.array(
                [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
            )
            back = turn.T
            angles = np.arctan2(back[2, 1], back[2, 2]), -np.arcsin(back[2, 0]), np.arctan2(back[1, 0], back[0, 0])
            middle = np.array([0, 0, 0.7]) - hand
            top = solid.format(origin=f'<origin xyz="{_words(middle)}"/>', mass=5.0, i=0.1)
            links.append(f'<link name="platform">{top}</link>')
            joints.append(
                f'<joint name="ball_0" type="continuous"><origin rpy="{_words(*angles)}"/><parent link="upper_0"/>'
                '<child link="platform"/><axis xyz="0 0 1"/></joint>'
            )
            balls.append("ball_0")
            continue
        links.append(f'<link name="hand_{k}"/>')
        joints.append(
            f'<joint name="hand_{k}_fixed" type="fixed"><origin xyz="{_words(hand - first)}"/><parent link="platform"/>'
            f'<child link="hand_{k}"/></joint>'
        )
        pairs.append([f"upper_{k}", f"hand_{k}"])
    motors = [f"slide_{k}" for k in range(6)]
    yaml = f"closed_loop: {pairs}\ntype: 3d\nname_mot: {motors}\njoint_name: {balls}\njoint_type: [SPHERICAL]\n"
    return '<robot name="platform">' + "\n".join([*links, *joints]) + "</robot>\n", yaml


def delta() -> str:
    """A delta robot: three arms, each with two rods on balls, and a plate in the middle that the six rods hold: MJCF."""
    bodies, rows = [], []
    for k, angle in enumerate((0, 120, 240)):
        rods = []
        for side, y in (("l", 0.04), ("r", -0.04)):
            # Rods run from the elbow (0.4 outside, 0.05 below) to the plate's rim (0.1 outside, 0.55 below).
            rods.append(
                f'<body name="rod_{k}{side}" pos="0.2 {y} -0.05"><joint name="ball_{k}{side}" type="ball" damping="0.01"/>'
                '<geom type="capsule" fromto="0 0 0 -0.3 0 -0.5" size="0.006" contype="0" conaffinity="0"/></body>'
            )
            rows.append(f'<connect name="end_{k}{side}" body1="rod_{k}{side}" body2="plate" anchor="-0.3 0 -0.5"/>')
        bodies.append(
            f'<body name="mount_{k}" euler="0 0 {angle}"><body name="arm_{k}" pos="0.2 0 0"><joint name="arm_{k}" axis="0 1 0"/>'
            '<geom type="capsule" fromto="0 0 0 0.2 0 -0.05" size="0.015" contype="0" conaffinity="0"/>'
            f"{''.join(rods)}</body></body>"
        )
    return (
        f'<mujoco model="delta"><worldbody>{"".join(bodies)}<body name="plate" pos="0 0 -0.55"><freejoint name="plate"/>'
        '<geom type="cylinder" size="0.1 0.01" mass="0.5" contype="0" conaffinity="0"/></body></worldbody>'
        f"<equality>{''.join(rows)}</equality></mujoco>\n"
    )


def bennett() -> str:
    """Bennett's linkage: four hinges, a / sin(alpha) the same for opposite bars; one freedom against Grübler's count: SDF."""
    lengths, twists = (0.5, 0.35355339059327373), (np.pi / 2, np.pi / 4)  # 0.5 / sin 90 = 0.354 / sin 45

    def step(theta: float, a: float, alpha: float) -> np.ndarray:
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, 0], [0, 0, 0, 1.0]])

    # tan(theta_1 / 2) tan(theta_2 / 2) = sin((alpha + beta) / 2) / sin((alpha - beta) / 2), with opposite angles 2 pi - theta.
    first = 1.2
    ratio = np.sin((twists[1] + twists[0]) / 2) / np.sin((twists[1] - twists[0]) / 2)
    second = 2 * np.arctan(ratio / np.tan(first / 2))
    angles = (first, second, -first, -second)
    poses, place = [np.eye(4)], np.eye(4)
    for k in range(4):
        place = place @ step(angles[k], lengths[k % 2], twists[k % 2])
        poses.append(place.copy())
    if not np.allclose(place, np.eye(4), atol=1e-12):
        raise ValueError(f"Bennett's linkage does not close: {place.round(3).tolist()}")
    parts = []
    for k in range(4):
        start, end = poses[k], poses[k + 1]
        com = (end[:3, 3] - start[:3, 3]) / 2
        parts.append(
            f"<link name='bar_{k}'><pose>{_words(start[:3, 3])} 0 0 0</pose><inertial><pose>{_words(com)} 0 0 0</pose>"
            "<mass>1</mass><inertia><ixx>0.02</ixx><iyy>0.02</iyy><izz>0.02</izz></inertia></inertial></link>"
        )
    parts.append("<joint name='base' type='fixed'><parent>world</parent><child>bar_0</child></joint>")
    for k in range(4):
        axis = poses[k + 1][:3, 2]
        other = (k + 1) % 4
        parts.append(
            f"<joint name='hinge_{k}' type='revolute'><parent>bar_{k}</parent><child>bar_{other}</child>"
            f"<axis><xyz expressed_in='__model__'>{_words(axis)}</xyz></axis></joint>"
        )
    return "<sdf version='1.7'><model name='bennett'>" + "\n".join(parts) + "</model></sdf>\n"


_FORMATS: dict[str, Callable] = {
    "yaml.urdf": lambda one: urdf(one, "yaml"),
    "gazebo.urdf": lambda one: urdf(one, "gazebo"),
    "sdf": sdf,
    "xml": mjcf,
}


def write(folder: Path, formats: int = 2) -> Iterator[Path]:
    """Write all mechanisms into a folder, each planar one in so many of the four formats; yields those to load."""
    for k, name in enumerate(PLANAR):
        linkage = _Planar(name)
        chosen = [list(_FORMATS)[(k + n) % 4] for n in range(formats)]
        for suffix in chosen:
            path = folder / f"{name}.{suffix}"
            path.write_text(_FORMATS[suffix](linkage), encoding="utf-8")
            if suffix == "yaml.urdf":
                path.with_suffix(".yaml").write_text(yaml_of(linkage), encoding="utf-8")
            yield path
    text, yaml = platform()
    for name, content in (
        ("platform.urdf", text),
        ("platform.yaml", yaml),
        ("delta.xml", delta()),
        ("bennett.sdf", bennett()),
    ):
        (folder / name).write_text(content, encoding="utf-8")
        if not name.endswith("yaml"):
            yield folder / name
