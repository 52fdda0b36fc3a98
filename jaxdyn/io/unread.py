"""Elements and attributes of URDF and SDF files that their readers do not read.

A table for each format says what becomes of an element. What the tables do not have is unknown to the format, and is reported
too: a misspelt `<dampng>` would otherwise change the motion without a word. Names with a colon are extensions of other programs.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

from jaxdyn.io.xml_lines import XmlFile


class Part(NamedTuple):
    """Element that is read: its attributes, and what becomes of its children.

    - `attributes`: those that are read or have no effect on the motion.
    - `children`: a `Part` is read in turn, and occurs once; `Left` is reported; None has no effect on the motion, or is read as
      an element of its own.
    - `open`: whether other children are as well known as None.
    """

    attributes: tuple[str, ...] = ()
    children: dict[str, "Part | Left | None"] = {}  # noqa: RUF012
    open: bool = False


class Left(NamedTuple):
    """Element that is reported in these words, where its value is not the `default` (None: always)."""

    words: str
    default: bool | float | None = None


def _attributes(words: str) -> tuple[str, ...]:
    return tuple(words.split())


def _texts(words: str) -> dict[str, "Part | Left | None"]:
    return dict.fromkeys(words.split(), Part())


def _without_effect(words: str) -> dict[str, "Part | Left | None"]:
    return dict.fromkeys(words.split())


def _report(words: str, of: str) -> dict[str, "Part | Left | None"]:
    return {tag: Left(f"<{tag}> of {of}") for tag in words.split()}


_ORIGIN = Part(("xyz", "rpy"))
URDF_LINK = Part(
    ("name", "type"),
    {
        "inertial": Part(
            children={
                "origin": _ORIGIN,
                "mass": Part(("value",)),
                "inertia": Part(_attributes("ixx ixy ixz iyy iyz izz")),
            }
        ),
        # `contact` has friction and stiffness of the ground, for Bullet; a link's `origin` is one of old files.
        **_without_effect("visual collision contact self_collision_checking material"),
    },
)
URDF_JOINT = Part(
    ("name", "type", "dont_collapse"),  # of a converter that merges links
    {
        "origin": _ORIGIN,
        "parent": Part(("link",)),
        "child": Part(("link",)),
        "axis": Part(("xyz",)),
        "limit": Part(_attributes("lower upper velocity effort")),
        "dynamics": Part(_attributes("damping friction armature")),
        "mimic": Part(_attributes("joint multiplier offset")),
        # Soft limits and the positions of reference switches are of controllers.
        **_without_effect("calibration safety_controller hardwareInterface"),
    },
)
URDF_ROBOT = Part(
    ("name", "version"),
    # `jaxdyn` holds the torque terms of `save_urdf`, which `read_torque_terms` reads.
    _without_effect("link joint gazebo material transmission ros2_control sensor group mujoco kinematics jaxdyn"),
)
# Gazebo copies whatever it finds into its own format.
URDF_GAZEBO = Part(
    ("reference",),
    {
        "gravity": Left("links without gravity (simulated with gravity)", True),
        "turnGravityOff": Left("links without gravity (simulated with gravity)", False),
        "springStiffness": Left("springs in <gazebo>", 0.0),
        "dampingFactor": Left("velocity decay of links", 0.0),
        "initial_joint_position": Left("initial position of joints", 0.0),
    },
    open=True,
)

_POSE = Part(_attributes("relative_to frame degrees rotation_format"))
_AXIS = Part(
    children={
        "xyz": Part(("expressed_in",)),
        "limit": Part(children=_texts("lower upper effort velocity") | _without_effect("stiffness dissipation")),
        "dynamics": Part(children=_texts("damping friction spring_reference spring_stiffness")),
        "mimic": Part(("joint", "axis"), _texts("multiplier offset reference")),
        "use_parent_model_frame": Part(),
        "initial_position": Left("initial position of joints", 0.0),
    }
)
SDF_LINK = Part(
    ("name",),
    {
        "pose": _POSE,
        "inertial": Part(
            ("auto",),
            {
                "pose": _POSE,
                **_texts("mass"),
                "inertia": Part(children=_texts("ixx ixy ixz iyy iyz izz")),
                "fluid_added_mass": Left("fluid added mass of links"),
                # Of inertias that are computed from shapes, which are refused.
                **_without_effect("density auto_inertia_params"),
            },
        ),
        "gravity": Left("links without gravity (simulated with gravity)", True),
        "enable_wind": Left("wind on links", False),
        "kinematic": Left("kinematic links", False),
        "velocity_decay": Part(
            children={tag: Left("velocity decay of links", 0.0) for tag in ("linear", "angular")},
        ),
        **_report("collision sensor plugin battery particle_emitter projector audio_source", "links"),
        # The base of a part is chosen by `canonical_link`.
        **_without_effect("visual light audio_sink self_collide must_be_base_link"),
    },
)
SDF_JOINT = Part(
    ("name", "type"),
    {
        "pose": _POSE,
        "axis": _AXIS,
        "axis2": _AXIS,
        **_texts("parent child gearbox_ratio gearbox_reference_body thread_pitch screw_thread_pitch"),
        "physics": Part(
            children={
                "simbody": Part(children=_texts("must_be_loop_joint")),
                "ode": Part(
                    children={
                        "velocity": Left("motors of joints", 0.0),
                        **_without_effect("cfm_damping implicit_spring_damper fudge_factor cfm erp bounce max_force"),
                        **_without_effect("limit suspension provide_feedback"),
                    }
                ),
                **_without_effect("provide_feedback"),
            }
        ),
        "sensor": Left("<sensor> of joints"),
    },
)
SDF_MODEL = Part(
    _attributes("name namespace canonical_link placement_frame"),
    {
        "pose": _POSE,
        "static": Part(),
        "enable_wind": Left("wind on models", False),
        **_report("plugin gripper", "models"),
        **_without_effect("frame link joint model include self_collide allow_auto_disable"),
    },
)
SDF_FRAME = Part(("name", "attached_to"), {"pose": _POSE})
SDF_WORLD = Part(
    ("name", "namespace"),
    {
        "gravity": Part(),
        **_report("plugin actor state population", "worlds"),
        # Wind has an effect on the links that enable it.
        **_without_effect(
            "audio wind include magnetic_field atmosphere gui physics scene light frame joint model road"
        ),
        **_without_effect("spherical_coordinates"),
    },
)
SDF_ROOT = Part(("version",), {**_report("actor", "files"), **_without_effect("world model light include frame joint")})


def unread_parts(file: XmlFile, elements: Iterable[tuple[Any, str, Part]]) -> dict[str, list[str]]:
    """Descriptions, with the names of their owners, of what is not read of elements, each given with its owner and its table.

    **Raises:** ValueError with file and line for a part that is given twice, of which a reader takes the first, and for a value
    that is none.
    """
    left: dict[str, list[str]] = {}

    def report(words: str, owner: str) -> None:
        names = left.setdefault(words, [])
        if owner not in names:
            names.append(owner)

    def check(element, owner: str, part: Part) -> None:
        for key in element.keys():
            if key not in part.attributes and not key.startswith("xmlns"):
                report(f"attribute {key} of <{element.tag}>", owner)
        for child in element:
            entry = part.children.get(child.tag)
            if isinstance(entry, Part):
                if (first := element.find(child.tag)) is not child:
                    raise file.fault(
                        child, f"a second <{child.tag}> of {owner!r}, the first is on line {first.line}; keep one"
                    )
                check(child, owner, entry)
            elif isinstance(entry, Left):
                default, what = entry.default, repr(owner)
                if isinstance(default, bool):
                    has_effect = (child.text or "").strip() and file.flag(element, child.tag, what) is not default
                else:
                    has_effect = default is None or file.number(element, child.tag, default, what) != default
                if has_effect:
                    report(entry.words, owner)
            elif child.tag not in part.children and not part.open:
                report(f"unknown <{child.tag}> in <{element.tag}>", owner)

    for element, owner, part in elements:
        check(element, owner, part)
    return left
