"""SDF loader (the format of Gazebo), versions 1.4 to 1.12: trees, loops, gearboxes, nested models, worlds."""

import os
from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.base import Constraint
from jaxdyn.constraints.loops import gear, lock_joint, loop
from jaxdyn.forces.elements import CoulombFriction, JointDamping, JointSpring
from jaxdyn.io.loaded import (
    Link,
    LoadedScene,
    Names,
    Start,
    add_chain,
    build_model,
    summarize,
    summarize_all,
    warn_not_taken,
    warn_of_units,
)
from jaxdyn.io.sdf_file import LOOPS, Axis, Joint, SdfFile, inertia_of, read_joints
from jaxdyn.io.solids import FRICTION, collision_of, contacts_with_ground, sdf_elements
from jaxdyn.io.unread import SDF_FRAME, SDF_JOINT, SDF_LINK, SDF_MODEL, SDF_ROOT, SDF_WORLD, unread_parts
from jaxdyn.io.urdf import ROOT_JOINT
from jaxdyn.io.xml_lines import rounding_of_digits
from jaxdyn.model import host_math
from jaxdyn.model.arguments import DType
from jaxdyn.model.builder import GRAVITY, ModelBuilder
from jaxdyn.model.configuration import neutral
from jaxdyn.model.topology import body_index
from jaxdyn.model.tree import Model

_KINDS = dict(revolute="revolute", continuous="revolute", revolute2="revolute", universal="revolute")
_KINDS |= dict(prismatic="prismatic", screw="helical", ball="spherical")
_SECOND = "_axis2"  # suffix of a two-axis joint's second coordinate
_PARALLEL = 1e-4  # files give right angles with four or five digits
_MIMIC = (("multiplier", 1.0), ("offset", 0.0), ("reference", 0.0))


def read_sdf(path: str | os.PathLike, *, floating_base: bool, contacts, dtype: DType | None) -> LoadedScene:
    """Scene of an SDF file, with options as of `jd.load`.

    A joint that closes a loop becomes a constraint; the choice keeps coordinates for springs, damping and limits, and cuts ball
    joints first (`spanning_tree`). Two axes of one joint are two joints, JOINT and JOINT_axis2; names in nested models start with
    MODEL::.
    A positive angle rotates the child relative to the parent about the axis, also where the tree runs from child to parent. Free
    roots have the joint "root_joint", or LINK_root_joint of several; the root of a part is its model's canonical link.

    **Raises:** ValueError with file and line for a file that cannot be read, malformed XML, entity declarations,
    another version, unknown names or types, reserved names, a part that is given twice, cyclic poses, bad numbers, an inertia
    that is to be computed from shapes, or whose pose is relative to another frame; for a joint that moves no inertia.
    """
    file = SdfFile(path)
    joints = read_joints(file)
    # A gearbox couples two other joints; as an edge of the graph it would close a loop that does not exist.
    moving = [joint for joint in joints if joint.kind != "gearbox"]
    static = [name for name, (_, scope) in file.links.items() if scope.static]
    # A model that is not fixed moves by its canonical link, which becomes the root of its part.
    first = [link for model in file.models.values() if (link := file.canonical_link(model)) is not None]
    edges, cut = spanning_tree(file.links, static, moving, first)
    model, roots = _model(file, edges, set(static), floating_base, dtype)
    tree = {edge.joint.name: edge.joint for edge in edges if edge.joint is not None}
    loops, left = _loops(file, model, cut)
    # Joints that were cut have no coordinate, so couplings are looked up among those of the tree.
    couplings, also = _couplings(file, joints, tree)
    touching, apart, taken = ([], [], set()) if contacts is None else _contacts(file, model, contacts)
    not_taken = (*left, *also, *_elements_without_effect(file, taken), *apart)
    warn_not_taken(path, not_taken)
    warn_of_units(path, model)
    starts = {"reference": _start(file, model, roots)}
    forces = [*_forces(model, tree), *touching]
    return LoadedScene(model, [*loops, *couplings], forces, starts=starts, not_taken=not_taken)


class Edge(NamedTuple):
    """Edge of the tree: `body` is attached to `carrier` by `joint`, backwards where `body` is the joint's parent in the file."""

    joint: Joint | None  # None: the body is a root without a joint in the file
    carrier: str | None
    body: str
    backwards: bool


def spanning_tree(
    links: Iterable[str], fixed: Iterable[str], joints: list[Joint], first: Iterable[str]
) -> tuple[list[Edge], list[Joint]]:
    """Choose the joints of the tree, parents before children; the remaining joints close loops.

    A joint that closes a loop has no coordinate, so its spring, damping and limits are lost. The tree prefers
    joints with a spring, then with damping or friction, then with limits; ball joints, and joints marked
    to be cut, come last; ties are broken by depth from the root in breadth-first order, then by the file's order.

    **Arguments:** `links`; `fixed`, links that do not move; `joints` without gearboxes; `first`, links preferred as
    roots of parts without a joint to the world, in order of preference.
    """
    # The arguments are read several times and may be iterators.
    links, fixed, first = list(links), set(fixed), list(first)
    # The world is a node, so that all joints to it are edges like others.
    nodes: list[str | None] = [None, *links]
    near: dict[str | None, list[str | None]] = {node: [] for node in nodes}
    for joint in joints:
        near[joint.parent].append(joint.child)
        near[joint.child].append(joint.parent)
    # Links of static models are at depth 1 although no joint holds them.
    for link in fixed:
        near[None].append(link)
    depth: dict[str | None, int] = {}
    roots: list[str | None] = []
    # Breadth first from the world, then from each preferred root of a part not reached yet.
    for start in (None, *first, *links):
        if start in depth:
            continue
        roots.append(start)
        depth[start], queue = 0, [start]
        for node in queue:
            for other in near[node]:
                if other not in depth:
                    depth[other] = depth[node] + 1
                    queue.append(other)

    def cost(joint: Joint):
        leaves = [axis.leaves for axis in joint.axes]
        moving = any("damping" in leaf or "friction" in leaf for leaf in leaves)
        springs, limits = any(axis.stiffness for axis in joint.axes), any(axis.limited for axis in joint.axes)
        # Of equal joints the one nearer to the root stays, which gives short branches.
        deep = min(depth[joint.parent], depth[joint.child])
        return joint.cut, joint.kind == "ball", not springs, not moving, not limits, deep

    # Kruskal's algorithm: adding the cheapest joint between two parts gives the tree of least total cost.
    part: dict[str | None, str | None] = {node: node for node in nodes} | dict.fromkeys(fixed, None)

    def group(node: str | None) -> str | None:
        while part[node] != node:
            node = part[node]
        return node

    chosen: list[Joint] = []
    left: set[str] = set()
    for joint in sorted(joints, key=cost):
        a, b = group(joint.parent), group(joint.child)
        if a == b:
            left.add(joint.name)
            continue
        chosen.append(joint)
        # The world represents its own group, since it can never be merged into another.
        part[b if a is None else a] = a if a is None else b
    # Directions follow from the roots outwards, whatever parent and child are in the file.
    edges: list[Edge] = [Edge(None, None, link, False) for link in links if link in fixed]
    edges += [Edge(None, None, root, False) for root in roots if root is not None]
    seen: set[str | None] = {None, *(edge.body for edge in edges)}
    queue = [None, *(edge.body for edge in edges)]
    for node in queue:
        for joint in chosen:
            for here, there, backwards in ((joint.parent, joint.child, False), (joint.child, joint.parent, True)):
                if here == node and there is not None and there not in seen:
                    seen.add(there)
                    queue.append(there)
                    edges.append(Edge(joint, node, there, backwards))
    return edges, [joint for joint in joints if joint.name in left]


def _model(file: SdfFile, edges: list[Edge], static: set[str], floating: bool, dtype) -> tuple[Model, dict[str, str]]:
    """Build the model; return it with the joints of its free roots and the link of each."""
    first = next(iter(file.models.values())).element.get("name")
    # A world names the whole only where it holds several models.
    name = first if len(file.models) == 1 or file.world is None else ""
    name = name or (file.world.get("name") if file.world is not None else "") or "mechanism"
    gravity: np.ndarray | tuple | None = GRAVITY
    if file.world is not None:
        # Up to version 1.5 gravity is an element of <physics>.
        gravity_element = file.world.find("gravity" if file.minor > 5 else "physics/gravity")
        gravity_element = file.world.find("gravity") if gravity_element is None else gravity_element
        gravity = (
            # The format's default is 9.8, not 9.81.
            np.array([0.0, 0.0, -9.8]) if gravity_element is None else file.numbers(gravity_element, 3, "the world")
        )
        gravity = gravity if gravity.any() else None
    builder = ModelBuilder(name, gravity=gravity, dtype=dtype, rounding=rounding_of_digits(file.root))
    builder.places = {link: f"{file.path}:{element.line}" for link, (element, _) in file.links.items()}
    # Joints may have the names of links in SDF, so the two namespaces are kept apart.
    frames, names = Names(), Names()
    for link in file.links:
        frames.new(link)
    for joint in file.joints:
        names.new(joint)
    free = [edge.body for edge in edges if edge.joint is None and edge.body not in static and floating]
    roots: dict[str, str] = {}
    for edge in edges:
        inertia = inertia_of(file, edge.body)
        place = file.pose(edge.body)
        links: list[Link] = []
        if edge.joint is not None:
            links = _links(edge, place)
            # All poses of the file are resolved to the world; home poses are relative to the carrier.
            place = host_math.inverse(file.pose(edge.carrier)) @ place if edge.carrier is not None else place
        elif edge.body in free:
            root = names.new(ROOT_JOINT if len(free) == 1 else f"{edge.body}_{ROOT_JOINT}")
            # The free joint's coordinates are the world pose of the link, so its home pose is the identity.
            roots[root] = edge.body
            links, place = [Link(root, "free", np.zeros(3), np.zeros(3), 0.0, {})], np.eye(4)
        # A fault is located at the joint that moves the body, or at the link of a root.
        element = file.links[edge.body][0] if edge.joint is None else edge.joint.element
        try:
            add_chain(builder, frames, names, edge.body, edge.carrier, place, links, inertia)
        except ValueError as error:
            raise file.fault(element, str(error)) from error
    # Frames come after all links, so that a clash of names renames the frame and not the link.
    for frame, (_, _) in file.frames.items():
        carrier = file.link_of(frame)
        pose = file.pose(frame) if carrier is None else host_math.inverse(file.pose(carrier)) @ file.pose(frame)
        builder.add_frame(frames.new(frame), carrier, pose)
    return build_model(builder, file.path), roots


def _axis_names(joint: Joint) -> list[str]:
    return [joint.name, joint.name + _SECOND][: max(1, len(joint.axes))]


def _links(edge: Edge, place: np.ndarray) -> list[Link]:
    """Chain of joints of a body: axes and anchor in its frame, reversed where the tree runs from child to parent."""
    joint = edge.joint
    # Without joints `add_chain` fixes the body.
    if joint is None or joint.kind == "fixed":
        return []
    # The joint's axis passes through its own origin, which need not be the child's.
    anchor = np.asarray(host_math.inverse(place) @ joint.pose)[:3, 3]
    kind, sign = _KINDS[joint.kind], -1.0 if edge.backwards else 1.0
    if kind == "spherical":
        return [Link(joint.name, kind, np.zeros(3), anchor, 0.0, {})]
    links = []
    for name, axis in zip(_axis_names(joint), joint.axes, strict=True):
        # Limits of +-1e16, the default up to version 1.6, are none; such a joint is continuous.
        word = "continuous" if kind == "revolute" and not axis.limited else kind
        # Axes were resolved in the world; a chain wants them in the body's own axes.
        direction = sign * place[:3, :3].T @ axis.direction
        links.append(Link(name, word, direction, anchor, 0.0, axis.leaves, joint.pitch))
    # Two-axis joints reverse their order as well as their sign.
    return links[::-1] if edge.backwards else links


def _loops(file: SdfFile, model: Model, cut: list[Joint]) -> tuple[list[Constraint], list[str]]:
    """Loop constraints, and descriptions of unsupported features of loop joints."""
    taken, left = [], {}
    for joint in cut:
        ends = (joint.parent, joint.child)
        if len(bodies := {body_index(model, end) for end in ends}) == 1:
            # Files often join rigidly connected links twice; such a joint adds nothing.
            if joint.kind != "fixed" and bodies != {-1}:
                left.setdefault("joints between two parts of one body", []).append(joint.name)
            continue
        # A universal loop has axes at right angles; other angles would change the constraint.
        skew = len(joint.axes) == 2 and abs(joint.axes[0].direction @ joint.axes[1].direction) > _PARALLEL
        if joint.kind == "screw" or skew:
            reason = "screws that close loops" if joint.kind == "screw" else "skew joints of two axes that close loops"
            left.setdefault(reason, []).append(joint.name)
            continue
        if any(axis.stiffness or axis.leaves for axis in joint.axes):
            left.setdefault("springs, damping, friction and limits of joints that close loops", []).append(joint.name)
        poses = []
        for k, end in enumerate(ends):
            # A universal joint has one axis on each body; other joints share theirs.
            axis = joint.axes[min(k, len(joint.axes) - 1)].direction if joint.axes else joint.pose[:3, 2]
            # The file's placement closes the loop: both frames are at the joint, z along the end's own axis.
            place = host_math.rotation_from_z(axis)
            place[:3, 3] = joint.pose[:3, 3]
            poses.append(place if end is None else host_math.inverse(file.pose(end)) @ place)
        taken.append(loop(ends[0], poses[0], ends[1], poses[1], LOOPS[joint.kind], name=joint.name))
    return taken, summarize_all(left)


def _couplings(file: SdfFile, joints: list[Joint], tree: dict[str, Joint]) -> tuple[list[Constraint], list[str]]:
    """Couplings by gearboxes and mimicked axes, and descriptions of those whose joints have no coordinate."""
    couplings: list[tuple[str, Constraint | None]] = []
    for joint in joints:
        if joint.kind == "gearbox":
            couplings.append((joint.name, _gearbox(file, joint, tree.values())))
            continue
        # <mimic> is an element of an axis and not of the joint.
        axes = [x for x in zip(_axis_names(joint), joint.axes, strict=False) if x[1].mimic is not None]
        couplings += [(name, _mimic(file, joint, name, axis, tree)) for name, axis in axes]
    left = [name for name, coupling in couplings if coupling is None]
    text = "couplings of joints that have no coordinate or axes that are not parallel"
    return [coupling for _, coupling in couplings if coupling is not None], summarize(text, left)


def _gearbox(file: SdfFile, joint: Joint, tree: Iterable[Joint]) -> Constraint | None:
    """Gearbox coupling theta_2 = -ratio theta_1 of the angles of its child and parent relative to its reference body."""
    element, scope = file.joints[joint.name]
    tag = element.find("gearbox_reference_body")
    if tag is None or not (tag.text or "").strip():
        raise file.fault(element, f"gearbox {joint.name!r} has no <gearbox_reference_body>")
    reference = file.link_of(file.find(tag.text.strip(), scope, tag))
    ends = []
    for link, axis in zip((joint.parent, joint.child), joint.axes, strict=True):
        for other in tree:
            # A gear ratio relates angles, which joints of other kinds do not have.
            if other.kind not in ("revolute", "continuous") or {other.parent, other.child} != {reference, link}:
                continue
            # The axes of a gearbox are those of its two joints, up to the sign.
            along = float(other.axes[0].direction @ axis.direction)
            if abs(abs(along) - 1.0) < _PARALLEL:
                ends.append((other.name, np.sign(along) * (1.0 if other.child == link else -1.0)))
                break
    if len(ends) < 2:
        return None
    (first, sign_1), (second, sign_2) = ends
    ratio = -file.number(element, "gearbox_ratio", 1.0, f"joint {joint.name!r}") * sign_1 * sign_2
    return gear(second, first, ratio, name=joint.name)


def _mimic(file: SdfFile, joint: Joint, name: str, axis: Axis, tree: dict[str, Joint]) -> Constraint | None:
    """Mimic coupling: follower = multiplier (leader - reference) + offset."""
    element, scope = axis.mimic, file.joints[joint.name][1]
    leader = scope.prefix + (element.get("joint") or "").strip()
    if leader not in file.joints:
        raise file.fault(
            element, f"joint {name!r} mimics {leader!r}, which is not a joint of the file; correct <mimic>"
        )
    which = element.get("axis") or "axis"
    numbers = (file.number(element, tag, default, f"joint {name!r}") for tag, default in _MIMIC)
    multiplier, offset, reference = numbers
    # A fixed leader stays at zero, so the follower is held and not coupled.
    if joint.name in tree and leader in tree and tree[leader].kind == "fixed":
        return lock_joint(name, offset - multiplier * reference, name=f"mimic {name}-{leader}")
    if joint.name not in tree or leader not in tree or len(tree[leader].axes) < (2 if which == "axis2" else 1):
        return None
    source = leader + (_SECOND if which == "axis2" else "")
    if source == name:
        raise file.fault(element, f"joint {name!r} mimics itself; name another joint")
    return gear(name, source, multiplier, offset - multiplier * reference, name=f"mimic {name}-{source}")


def _forces(model: Model, tree: dict[str, Joint]) -> list:
    named = [
        (name, axis) for joint in tree.values() for name, axis in zip(_axis_names(joint), joint.axes, strict=False)
    ]
    sprung = [(name, axis) for name, axis in named if axis.stiffness]
    forces: list = []
    if sprung:
        stiffness, rest = np.array([axis.stiffness for _, axis in sprung]), np.array([axis.rest for _, axis in sprung])
        forces.append(JointSpring(stiffness, rest, [name for name, _ in sprung]))
    if model.damping is not None:
        forces.append(JointDamping())
    if model.friction is not None:
        forces.append(CoulombFriction())
    return forces


def _start(file: SdfFile, model: Model, roots: dict[str, str]) -> Start:
    """Start at the placement of the file."""
    q = np.array(neutral(model), float)
    for joint, link in roots.items():
        pose = file.pose(link)
        q[model.topology.q_slices[model.joint_names.index(joint)]] = np.concatenate(
            [pose[:3, 3], host_math.quaternion(pose[:3, :3])]
        )
    return Start(jnp.asarray(q, model.home.dtype), jnp.zeros(model.nv, model.home.dtype))


def _contacts(file: SdfFile, model: Model, contacts) -> tuple[list, list[str], set[str]]:
    """Contacts with the ground, descriptions of what is left out, and the links that have contacts."""
    missing: list[str] = []
    collisions, uneven, bouncing = [], [], []
    for element in sdf_elements(file, "collision", missing):
        what = f"<collision> of link {element.frame!r}"
        friction = element.xml.find("surface/friction/ode")
        mu = file.number(friction, "mu", FRICTION, what)
        uneven += [element.frame] * (file.number(friction, "mu2", mu, what) != mu)
        bounce = file.number(element.xml, "surface/bounce/restitution_coefficient", 0.0, what)
        bouncing += [element.frame] * (bounce != 0)
        collisions += collision_of(element, mu)
    made, left, taken = contacts_with_ground(model, collisions, contacts)
    left += summarize("friction of collisions in a second direction", [x for x in dict.fromkeys(uneven) if x in taken])
    left += summarize("restitution of collisions", [x for x in dict.fromkeys(bouncing) if x in taken])
    return made, [*left, *summarize("collisions", missing)], taken


def _elements_without_effect(file: SdfFile, taken: set[str]) -> list[str]:
    """Elements of the file that the scene does not represent; `taken`: links with contacts."""
    elements = [(element, name, SDF_LINK) for name, (element, _) in file.links.items()]
    elements += [(element, name, SDF_JOINT) for name, (element, _) in file.joints.items()]
    elements += [(element, name, SDF_FRAME) for name, (element, _) in file.frames.items()]
    elements += [(scope.element, scope.element.get("name") or name, SDF_MODEL) for name, scope in file.models.items()]
    elements += [] if file.world is None else [(file.world, file.world.get("name") or "world", SDF_WORLD)]
    elements += [(file.root, os.path.basename(file.path), SDF_ROOT)]
    unread = unread_parts(file, elements)
    grounds = {name for name, (_, scope) in file.links.items() if scope.static} if taken else set()
    unread["<collision> of links"] = [
        name for name in unread.get("<collision> of links", ()) if name not in taken and name not in grounds
    ]
    lines = summarize_all(unread)
    lines += summarize("links with the reserved name of the world, which they stand for", file.of_world)
    return [*lines, *summarize("includes", file.includes)]
