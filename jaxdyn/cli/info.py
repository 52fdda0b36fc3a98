"""`jaxdyn info`: contents of a file, its faults, and its unsupported elements."""

import argparse
import collections
import contextlib
import warnings

import jax.numpy as jnp
import numpy as np

from jaxdyn.cli.common import FILE, add_model_options, load_scene, option, output_path, short, table, xacro_arguments
from jaxdyn.constraints.assembly import assemble
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual
from jaxdyn.constraints.selection import count_free, independent_rows, select_rows
from jaxdyn.io import LoadedScene, NotTakenWarning, save_urdf, urdf_inertia_report
from jaxdyn.io.formats import format_of
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math
from jaxdyn.model.configuration import columns_of, integrate
from jaxdyn.model.topology import KINDS
from jaxdyn.model.tree import Model, inertia_report, repair_inertias

HELP = "bodies, joints, limits, loops, frames and faulty inertias of a URDF, MJCF or SDF file"
DESCRIPTION = """\
Print the contents of a file: bodies with mass, joints with axes and limits in the order of q and v, loops and
couplings with their gaps, remaining degrees of freedom, frames, actuators, named states,
bodies with unphysical inertias, and unsupported elements.
"""
EPILOG = """\
examples:
  jaxdyn info panda.urdf
  jaxdyn info panda.urdf --lock panda_finger_joint1 panda_finger_joint2=0.02
  jaxdyn info humanoid.urdf --floating-base
  jaxdyn info hand.urdf --repair hand_repaired.urdf
  jaxdyn info cassie.sdf --fixed-base
  jaxdyn info go2_description

Links on fixed joints are merged into the body that carries them; they stay available as frames.
Units: kg, m, rad, rad/s or m/s, N m or N, kg m^2.
"""


_SOUND = "Inertias: every moving {} has a physical inertia."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", help=FILE)
    add_model_options(parser)
    option(
        parser,
        "--repair OUT.urdf",
        "write a URDF with faulty inertias replaced by physical ones close to them (merged links stay merged)",
    )


def run(args: argparse.Namespace) -> None:
    """Print the report, and write the repaired model if asked."""
    out = output_path(args.repair, (".urdf",), "--repair")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotTakenWarning)  # its content is printed below
        scene, file = load_scene(args.file, args)
    model, is_urdf = scene.system, format_of(file) == "urdf"
    if out is not None and not is_urdf:
        raise ValueError(f"--repair {args.repair}: only URDF files can be repaired; change the inertias in {file}")
    # Read once more for the names of the file, which a model does not hold.
    root = XmlFile(file, "robot", xacro_arguments(args)).root
    names = {element.get("name") for element in root.iter() if element.tag in ("link", "body")}
    # Massless bodies that a loader inserts between the joints of one body are no fault of the file.
    body_problems = [
        (body, text) for body, text in inertia_report(model) if text != "massless" or body.rpartition("::")[2] in names
    ]
    print(describe(scene, args.file))
    print(constraint_lines(scene))
    links = urdf_inertia_report(file, arguments=xacro_arguments(args)) if is_urdf else None
    print(_problems(links, body_problems))
    print("\n".join(["\nUnsupported elements of the file:", *(scene.not_taken or ["none"])]))
    if out is not None:
        repaired = repair_inertias(model)
        save_urdf(repaired, out)
        # Massless bodies stay as they are and are no repairs.
        changed = [name for name, *_ in body_problems if name not in dict(inertia_report(repaired))]
        print(f"\nWrote {out}: inertias of {len(changed)} bodies repaired{_name_list(changed)}.")


def _base(scene: LoadedScene) -> str:
    """Kind of base: fixed by joints, fixed by constraints on a free root, or floating."""
    model, top = scene.system, scene.system.topology
    free = [
        i for i, (parent, kind) in enumerate(zip(top.parents, top.kinds, strict=True)) if parent < 0 and kind == "free"
    ]
    held = []
    # The root of an SDF model floats by default, and a loop may hold it to the ground.
    if free and scene.constraints:
        rows = np.asarray(constraint_jacobian(scene, scene.starts["reference"].q, jnp.zeros(())), np.float64)
        _, singular, right = np.linalg.svd(rows)
        rank = int(np.sum(singular > 1e-9 * singular.max(initial=0.0)))
        # A root is held if no velocity in the null space of the constraints moves it.
        held = [i for i in free if np.abs(right[rank:, top.v_slices[i]]).max(initial=0.0) < 1e-6]
    floating = [model.body_names[i] for i in free if i not in held]
    roots = top.parents.count(-1)
    if not floating:
        return "fixed base" + " (by constraints)" * bool(held)
    if len(free) == roots:
        return "floating base" if roots == 1 else f"{len(floating)} floating bases"
    return f"fixed base and free bodies {', '.join(floating)}"


def describe(scene: LoadedScene, source: str) -> str:
    """Description of the model in tables."""
    model, base = scene.system, _base(scene)
    mass = float(np.asarray(model.inertias)[:, 0].sum())
    quaternions = "" if model.nq == model.nv else f" (q has {model.nq} numbers, v has {model.nv})"
    lines = [
        f"{source}: robot {model.name!r}, {base}, {model.nb} moving bodies, {model.nv} degrees of freedom{quaternions}",
        f"moving mass {mass:.6g} kg (links fixed to the world do not count)",
        "",
        "Joints, in the order of q and v (axis in the body's frame)",
        _joint_table(model),
        "",
        "Bodies (centre of mass and principal moments of inertia about it, in m and kg m^2)",
        _body_table(model),
        "",
        _frames(model),
    ]
    return "\n".join(lines)


def constraint_lines(scene: LoadedScene) -> str:
    """Table of loops and couplings with their gaps at every named state, remaining degrees of freedom, and actuators."""
    lines, q = [""], scene.starts["reference"].q
    if scene.constraints:
        rows = []
        for one in scene.constraints:
            holonomic, nonholonomic = one.sizes(scene.system, q.dtype)
            gaps = [_gap(one, scene, start.q) for start in scene.starts.values()]
            rows.append([one.name, type(one).__name__.lower(), str(holonomic + nonholonomic), *gaps])
        # Four states fit on a line.
        heads = ["constraint", "kind", "rows", *(f"gap at {name!r}" for name in list(scene.starts)[:4])]
        lines += [
            "Loops and couplings such as <mimic>, with their gaps (m or rad)",
            table(heads, [r[: len(heads)] for r in rows]),
        ]
        lines += _closure(scene, q)
    else:
        lines.append(f"Degrees of freedom after constraints: {scene.nv} of {scene.nv}")
    if len(scene.starts) > 1:
        lines.append(f"Named states: {', '.join(scene.starts)}")
    if scene.actuators is not None:
        lines.append(f"Actuators: {', '.join(scene.actuators.names)}")
    return "\n".join(lines)


def _closure(scene: LoadedScene, q) -> list[str]:
    """Closure of the loops from q, the remaining degrees of freedom, and redundant rows."""
    lines, closed = [], []
    try:
        q = assemble(scene, q).q
        closed, random = [q], np.random.default_rng(0)
        # Loops of a file that gives one pose of each body are closed in that pose only. Two others are enough to see such a gap.
        for _ in range(2):
            step = jnp.asarray(random.uniform(-0.1, 0.1, scene.nv), q.dtype)
            with contextlib.suppress(ValueError):  # not every configuration nearby can be assembled
                closed.append(assemble(scene, integrate(scene.system, q, step), guesses=1).q)
        lines.append("The constraints can be assembled: jd.assemble finds a configuration from the reference.")
    except ValueError as error:
        lines.append(f"The constraints cannot be assembled from the reference: {error}.")
    # Decided a finite distance away from q, because files like to put linkages flat.
    kept = select_rows(scene, np.asarray(q), 0.0).kept
    # Not `degrees_of_freedom`, which raises where rounding hides the rank of a singular position.
    here = int(count_free(independent_rows(scene, q, 0.0), q, 0.0, None))
    freedom = scene.nv - int(kept.sum())
    more = f" ({here} in the singular position of the reference)" if here > freedom else ""
    lines.append(f"Degrees of freedom after constraints: {freedom} of {scene.nv}{more}")
    return lines + _repeats(scene, closed, kept)


def _repeats(scene: LoadedScene, closed, kept) -> list[str]:
    """Lines on the redundant rows of each constraint, with their gaps in assembled configurations."""
    gaps = np.zeros((len(closed), len(kept)))
    for place, q in enumerate(closed):
        # Rows of velocities have no gap of position and stay at zero.
        gaps[place, holonomic_rows(layout(scene))] = np.abs(np.asarray(position_residual(scene, q, 0.0)))
    lines = []
    for place in layout(scene):
        dropped = 1 - kept[place.start : place.end]
        if count := int(dropped.sum()):
            gap = (gaps[:, place.start : place.end] * dropped).max(initial=0.0)
            by = f", which stay open by up to {gap:.2g} m or rad" if closed else ""
            lines.append(f"  {place.name}: {count} of {len(dropped)}{by}")
    return ["Redundant rows, which jd.simulate leaves out", *lines] if lines else []


def _gap(constraint, scene: LoadedScene, q) -> str:
    # A nonholonomic constraint has no position residual.
    residual = constraint.position(scene.system, q, 0.0)
    return "-" if residual is None else f"{float(np.abs(np.asarray(residual)).max(initial=0.0)):.2g}"


def _joint_table(model: Model) -> str:
    topology, screws = model.topology, np.asarray(model.screws)
    lower, upper = np.asarray(model.lower), np.asarray(model.upper)
    leaves = {key: getattr(model, key) for key in ("velocity_limit", "effort_limit", "damping", "friction", "armature")}
    shown = {key: np.asarray(value) for key, value in leaves.items() if value is not None}
    rows, units = [], columns_of(model).q_units
    for i, (name, kind) in enumerate(zip(model.joint_names, topology.kinds, strict=True)):
        in_q, in_v = topology.q_slices[i], topology.v_slices[i]
        single = KINDS[kind].nv == 1
        # Adding 0.0 turns -0.0 into 0.0.
        axis = screws[i, :3] + 0.0 if kind == "prismatic" else screws[i, 3:] + 0.0
        parent = "world" if topology.parents[i] < 0 else model.body_names[topology.parents[i]]
        span = f"{in_q.start}" if KINDS[kind].nq == 1 else f"{in_q.start}..{in_q.stop - 1}"
        limits = [short(float(x[in_q.start])) if single else "-" for x in (lower, upper)]
        numbers = [short(float(values[in_v.start])) if single else "-" for values in shown.values()]
        ways = [" ".join(f"{x:.4g}" for x in axis) if single else "", f"{parent} -> {model.body_names[i]}"]
        rows.append([span, name, kind, units[in_q.start] if single else "", *ways, *limits, *numbers])
    header = ["q", "joint", "kind", "unit", "axis", "moves", "lower", "upper", "speed", "effort"]
    return table(header + [key for key in shown if not key.endswith("_limit")], rows)


def _body_table(model: Model) -> str:
    rows = []
    for name, parameters in zip(model.body_names, np.asarray(model.inertias, float), strict=True):
        mass, com, moment = host_math.about_com(parameters)
        rows.append(
            [name, f"{mass:.4g}", *(f"{x:.4f}" for x in com), *(f"{x:.3g}" for x in np.linalg.eigvalsh(moment))]
        )
    return table(["body", "mass", "x", "y", "z", "I1", "I2", "I3"], rows)


def _frames(model: Model) -> str:
    carried = collections.defaultdict(list)
    for name, body in zip(model.frame_names[model.nb :], model.topology.frame_bodies[model.nb :], strict=True):
        carried["world" if body < 0 else model.body_names[body]].append(name)
    if not carried:
        return "Frames: those of the bodies."
    lines = [f"Frames: those of the {model.nb} bodies, and others fixed to them"]
    return "\n".join(lines + [f"  {body}: {', '.join(names)}" for body, names in carried.items()])


def _problems(links: list[tuple[str, str]] | None, bodies: list[tuple[str, str]]) -> str:
    """Lines on unphysical inertias: of the links that a URDF states (None for other files), and of the model's bodies."""
    if links is None:
        rows, advice = table(("body", "problem"), bodies), "jd.model.repair_inertias(scene.system) gives physical ones"
        return f"\nInertia problems ({len(bodies)}); {advice}\n{rows}" if bodies else f"\n{_SOUND.format('body')}"
    if not links:
        text = f"\n{_SOUND.format('link')}"
    else:
        rows = table(("link", "problem"), links)
        text = f"\nInertia problems of the links, as stated in the file ({len(links)})\n{rows}"
    if bodies:
        text += f"\nAfter merging fixed links, {len(bodies)} bodies are affected{_name_list([b for b, _ in bodies])}."
        text += "\nThe model is used unchanged; --repair writes a physical one."
    elif links:
        text += "\nOnce fixed links are merged, every body has a physical inertia."
    return text


def _name_list(names: list[str]) -> str:
    return f": {', '.join(names)}" if names else ""
