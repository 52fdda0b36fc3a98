"""Loader for every format: the scene of a file, or of a robot known by name to the package robot_descriptions."""

import difflib
import importlib
import os
import pathlib
from collections.abc import Iterable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.loops import model_couplings
from jaxdyn.forces.elements import CoulombFriction, JointDamping
from jaxdyn.io.loaded import LoadedScene, Start, summarize, warn_not_taken
from jaxdyn.io.mjcf import read_mjcf
from jaxdyn.io.sdf import read_sdf
from jaxdyn.io.solids import FRICTION, check_choice, collision_of, contacts_with_ground, urdf_elements
from jaxdyn.io.urdf import urdf_model
from jaxdyn.io.urdf_loops import loop_constraints, motors_of, plugin_followers, read_closures
from jaxdyn.io.urdf_parts import elements_without_effect
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model.arguments import Checked, DType, Numbers, as_path
from jaxdyn.model.builder import GRAVITY
from jaxdyn.model.configuration import neutral
from jaxdyn.model.tree import Model

_BY_SUFFIX = {".urdf": "urdf", ".xacro": "urdf", ".sdf": "sdf", ".world": "sdf", ".mjcf": "mjcf"}
_BY_ROOT = {"robot": "urdf", "sdf": "sdf", "gazebo": "sdf", "mujoco": "mjcf", "mujocoinclude": "mjcf"}


def load(
    source: str | os.PathLike,
    *,
    floating_base: bool | None = None,
    lock: Iterable[str] | Mapping[str, Any] = (),
    mimic: str | None = None,
    gravity: Numbers | None = GRAVITY,
    loops: str | os.PathLike | bool | None = None,
    missing_inertia: Numbers | None = None,
    contacts: Checked[str | Iterable[str] | None] = None,
    arguments: Mapping[str, Any] | None = None,
    packages: Mapping[str, str | os.PathLike] | None = None,
    dtype: DType | None = None,
) -> LoadedScene:
    """Load the scene of a URDF, xacro, MJCF or SDF file, or of a robot by its name in the package robot_descriptions.

    All formats give a `LoadedScene`, with the `Model` in `.system`. For a URDF it has the file's mimicked joints as
    couplings, its joint damping and dry friction (smoothed at 0.01 rad/s) as forces, and the start "reference", q = 0. A URDF
    is a tree; loops come from a YAML file next to it (`closed_loop`: pairs of frames, `type`: 3d or 6d; `name_mot`: motors,
    which become `.actuators`; `joint_name` and `joint_type`: spherical or locked joints), and from joints and mimicking
    plugins in `<gazebo>` elements (`jaxdyn.io.urdf_loops`). They close with `jd.assemble(scene, scene.starts["reference"].q)`.
    `load_model` returns the `Model` alone.

    MJCF is compiled by the mujoco package. Joints have MuJoCo's coordinates (a free body's q is its pose in the world), and
    velocities in body axes; `equality` elements are exact, where MuJoCo softens them. In SDF, a joint beyond a tree is a
    constraint; zero coordinates are the placement of the file, and those of a free root are its link's pose in the world. In
    both every body or link keeps a frame of its name, limits are the model's `lower` and `upper`, and "reference" is the
    placement of the file. What of each format is supported is on the page on files.

    **Arguments:**

    - `source`: a path; or a name such as "go2_description" or "go2_mj_description", whose file robot_descriptions has in its
      cache. Files missing there are downloaded by git once, if there is a network.
    - `floating_base`: whether the root moves freely. None: the default of the format: fixed in URDF, free in SDF. MJCF files
      state it.
    - `lock`, `gravity`, `missing_inertia`, `packages`, of a URDF: as for `load_model`.
    - `mimic`, of a URDF: "couple" (the default), "ignore" or "error", as for `load_model`; plugins in `<gazebo>` elements that
      mimic a joint count too. "ignore" loads files whose joints follow missing ones.
    - `loops`: the YAML file of a URDF's loops. None: the one with the URDF's name in its folder, if there is one;
      False: no YAML file.
    - `contacts`: "ground" for unilateral contacts of the collision shapes of all moving links with the ground, or a list of the
      links that touch it, as ["LF_FOOT", "RF_FOOT"]; None for none. They are `jd.contact.shape_contacts`, named by their link, in
      `.forces`. The ground is the file's planes and height fields that are fixed to the world, else the plane z = 0; URDF
      has none. A mesh counts by at most 12 vertices of its convex hull. Coefficients of friction are those of the file; in a URDF
      `<mu1>` in the `<gazebo>` element of the link or `<lateral_friction>` in its `<contact>`, and 1 without; in SDF the
      smaller `<mu>` of both; in MJCF by the rules of bits, priority, pairs and exclusions, zero for condim 1, without softness.
      Steps take time with the number of contacts cubed, and "ground" is refused where it gives more than 64: name the feet,
      and {"LF_FOOT": 1} for contacts in the lowest corner alone of their boxes and meshes, or {"LF_FOOT": 4} of a flat foot
      (`lowest` of `shape_contacts`, for `jd.stepper`).
    - `arguments`: of the `<xacro:arg>` elements of a file whose name ends in .xacro, {"prefix": "left_"}. The package xacro
      expands it to a URDF; lines in errors are those of the expanded text.
    - `dtype`: as for `ModelBuilder`.

    **Returns:** `LoadedScene`: `.system`, `.constraints`, `.forces`, `.starts`, `.actuators`, `.sensors`, `.not_taken`.

    **Warns:** `NotTakenWarning` naming elements that the scene does not represent; `UnitsWarning` where limits look like
    degrees, or lengths and inertias like millimetres.

    **Raises:** ValueError for a file that does not exist or is of no known format, an unknown name (similar ones are listed), a
    robot that could not be downloaded, an option that the loader of the format does not have, loops between frames that
    do not exist; and as the loader of the format does. ImportError without the package that reads the format.

    ```python
    scene = jd.load("robot.urdf")  # or jd.load("go2_mj_description")
    q = jd.neutral(scene.system)
    ```
    """
    path = _find(source, "source")
    contacts = check_choice(contacts)
    # The suffix or the root element decides, because URDF, MJCF and SDF all occur as .xml.
    kind = format_of(path)
    if kind == "urdf":
        of_model = {
            "floating_base": floating_base,
            "gravity": gravity,
            "missing_inertia": missing_inertia,
            "dtype": dtype,
        }
        file = XmlFile(path, "URDF", arguments, packages)
        return _urdf_scene(file, loops, contacts, lock, mimic=mimic or "couple", **of_model)
    if loops is not None:
        raise ValueError(
            f"loops is {loops!r}, but {path} is {kind.upper()}, which states its loops in the file; leave it out"
        )
    of_urdf = {"lock": (lock or (), ()), "mimic": (mimic, None), "gravity": (gravity, GRAVITY)}
    of_urdf |= {"arguments": (arguments or None, None), "packages": (packages or None, None)}
    of_urdf["missing_inertia"] = (missing_inertia, None)
    for name, (value, default) in of_urdf.items():
        # An option that the format ignores would silently change nothing, so it is refused.
        if value is not default:
            raise ValueError(
                f"{name} is {value!r}, but {path} is {kind.upper()}: it applies to URDF files; leave it out"
            )
    if kind == "mjcf":
        if floating_base is not None:
            raise ValueError(
                f"floating_base is {floating_base}, but {path} is MJCF, which states it by <freejoint>; leave it out"
            )
        return read_mjcf(path, contacts=contacts, dtype=dtype)
    # None means the default of the format, which is a free base in SDF and a fixed one in URDF.
    return read_sdf(path, floating_base=floating_base is not False, contacts=contacts, dtype=dtype)


def load_model(
    path: str | os.PathLike,
    *,
    floating_base: bool | None = None,
    lock: Iterable[str] | Mapping[str, Any] = (),
    mimic: str = "ignore",
    gravity: Numbers | None = GRAVITY,
    missing_inertia: Numbers | None = None,
    arguments: Mapping[str, Any] | None = None,
    packages: Mapping[str, str | os.PathLike] | None = None,
    dtype: DType | None = None,
) -> Model:
    """Load the `Model` of a file, the tree of its bodies alone: without loops, forces and actuators. Meshes are not read.

    Of MJCF and SDF files it is the system of `jd.load`, with the options of that. Of URDF and xacro files: links joined by fixed
    joints are merged; every link keeps a frame of its name. Joints are in Pinocchio's order. The inertias are those of the file,
    physical or not (`urdf_inertia_report`, `repair_inertias`). `damping` and `friction` of `<dynamics>` become leaves; so does
    `armature`, the rotor inertia seen at the joint, an attribute that is an extension of URDF that `save_urdf` writes. A planar
    joint moves in the plane normal to its axis, as URDF defines it (Pinocchio moves it in the x-y plane of its frame whatever the
    axis); where that axis is not z, the moving body is called LINK_plane, has its z along the axis, and carries LINK.

    **Arguments:**

    - `path`: the file, or a name as for `jd.load`.
    - `floating_base`: whether the root link moves freely, by a first joint "root_joint"; by default it is fixed to the world.
    - `lock`: joints to lock, at neutral (names) or at given coordinates (name -> number or (nq of the joint,)).
      They become fixed and their links are merged.
    - `mimic`: treatment of mimic joints. "ignore" leaves them free, "couple" leaves them free and
      records the couplings for a scene to impose (and locks those that follow a locked or a fixed joint, the latter at their
      offset), "error" refuses them.
    - `missing_inertia`: the inertia of links that a joint moves and that have none, as `inertia` of `ModelBuilder.add_body`:
      `jd.inertia.sphere(1.0, 0.1)` loads an arm without inertias for kinematics. None: they are massless.
    - `arguments`: of the `<xacro:arg>` elements of a file that ends in .xacro, which the package xacro expands.
    - `packages`: folders of packages that such a file names by `$(find NAME)`, by name. Those beside the file or above it, and
      those of an installed ROS, are found without.
    - `gravity`, `dtype`: as for `ModelBuilder`.

    **Raises:** ValueError with file and line for a file that cannot be read, malformed XML, links that are not a tree,
    an unknown joint type, a bad number, a part that is given twice, a declared entity, a negative mass, a negative limit of
    velocity or effort, a zero axis; for names in `lock` that are not movable joints;
    for a joint that moves no inertia. ImportError for a xacro file without the package xacro.

    **Warns:** `NotTakenWarning` naming elements and attributes that are not read, as `jd.load` does (its `not_taken` is the
    list); UserWarning naming the links with an unphysical inertia; `UnitsWarning` where limits look like degrees,
    or lengths and inertias like millimetres.
    """
    options: dict[str, Any] = {"floating_base": floating_base, "lock": lock, "gravity": gravity, "dtype": dtype}
    options["missing_inertia"] = missing_inertia
    source = _find(path, "path")
    # A file of another suffix is a URDF.
    if source.suffix.lower() in (*_BY_SUFFIX, ".xml") and format_of(source) != "urdf":
        kept = None if mimic == "ignore" else mimic
        return load(source, mimic=kept, arguments=arguments, packages=packages, **options).system
    file = XmlFile(source, "URDF", arguments, packages)
    model = urdf_model(file, mimic=mimic, **options)
    warn_not_taken(file.path, elements_without_effect(file))
    return model


def _find(source: str | os.PathLike, argument: str) -> pathlib.Path:
    path = as_path(source, argument)
    # A file without a suffix takes precedence over a robot of that name.
    return path if path.suffix or path.exists() else find_description(str(source))


def _urdf_scene(file: XmlFile, loops, contacts, lock, **options: Any) -> LoadedScene:
    """Scene of a URDF file, with `options` of `urdf_model`."""
    closures = read_closures(file.source, loops)
    if isinstance(lock, str):
        raise ValueError(f"lock is {lock!r}; give a list of joint names or a mapping of name to value")
    # Joints locked by the user override those locked by the YAML file.
    locked = lock if isinstance(lock, Mapping) else dict.fromkeys(lock)
    locked = {**dict.fromkeys(closures.locked), **locked}
    model = urdf_model(file, lock=locked, balls=closures.balls, followers=plugin_followers(file), **options)
    rows, not_taken = loop_constraints(closures, file, model)
    touching, apart = ([], []) if contacts is None else _contacts(file, model, contacts)
    not_taken = [*not_taken, *elements_without_effect(file), *apart]
    warn_not_taken(file.path, not_taken)
    # Zeros in <dynamics> are common; a force of zeros would be compiled and evaluated in every step.
    forces: list = []
    for leaf, force in ((model.damping, JointDamping), (model.friction, CoulombFriction)):
        if leaf is not None and np.any(np.asarray(leaf) != 0):
            forces.append(force(leaf))
    forces += touching
    starts = {"reference": Start(neutral(model), jnp.zeros((model.nv,), model.home.dtype))}
    drives = motors_of(closures, model)
    # Mimicked joints precede the loops, so that row indices of the couplings do not depend on the YAML file.
    rows = [*model_couplings(model), *rows]
    return LoadedScene(model, rows, forces, starts=starts, actuators=drives, not_taken=not_taken)


def _contacts(file: XmlFile, model: Model, contacts) -> tuple[list, list[str]]:
    """Contacts of a URDF with the plane z = 0, and descriptions of what is left out."""
    friction: dict[str, float] = {}
    for link in file.root.findall("link"):
        part = link.find("contact/lateral_friction")
        if part is not None:
            friction[str(link.get("name"))] = float(file.numbers(part, 1, "a link", "value")[0])
    for extension in file.root.findall("gazebo"):
        # Gazebo's own element has priority, as it is made for the file's simulator.
        if (link := extension.get("reference")) and extension.find("mu1") is not None:
            friction[link] = file.number(extension, "mu1", FRICTION, "a link")
    missing: list[str] = []
    collisions = [
        one
        for element in urdf_elements(file, "collision", missing)
        for one in collision_of(element, friction.get(element.frame, FRICTION))
    ]
    made, left, _ = contacts_with_ground(model, collisions, contacts)
    return made, [*left, *summarize("collisions", missing)]


def format_of(path: pathlib.Path) -> str:
    """Format "urdf" (.xacro too), "mjcf" or "sdf", by the suffix; for .xml files by the name of the root element.

    **Raises:** ValueError for a file that cannot be read, and for other suffixes and elements.
    """
    kind = _BY_SUFFIX.get(path.suffix.lower())
    if kind is None and path.suffix.lower() == ".xml":
        kind = _BY_ROOT.get(XmlFile(path, "robot").root.tag)
    if kind is None:
        raise ValueError(
            f"{path}: not a file of a known format; give .urdf, .xacro, .sdf, .world, .mjcf, or .xml with one of them"
        )
    return kind


def find_description(name: str) -> pathlib.Path:
    """Path of the file of a robot in robot_descriptions.

    **Raises:** ValueError for an unknown name, a robot without a supported file, and one that cannot be downloaded;
    ImportError without the package.
    """
    try:
        # Imported here: the package is an extra, and its modules clone git repositories when they are imported.
        import robot_descriptions
    except ImportError as error:
        raise ImportError(
            f"{name!r} is no file; as a name of a robot it needs the package robot_descriptions: "
            "pip install jaxdyn[robots]"
        ) from error
    known = robot_descriptions.DESCRIPTIONS
    if name not in known:
        near = difflib.get_close_matches(name, known, n=5, cutoff=0.5)
        hint = f"did you mean {', '.join(near)}?" if near else "names end in _description or _mj_description"
        raise ValueError(f"{name!r} is neither a file nor a robot of robot_descriptions; {hint}")
    try:
        module = importlib.import_module(f"robot_descriptions.{name}")
    except Exception as error:  # git, the network or the disk raise anything
        reason = (str(error).strip() or type(error).__name__).splitlines()[-1]
        raise ValueError(
            f"{name!r} is not in the cache of robot_descriptions and could not be downloaded: {reason}"
        ) from error
    # A description may offer several formats; the first of this order is taken.
    for attribute in ("URDF_PATH", "MJCF_PATH", "XACRO_PATH"):
        if (path := getattr(module, attribute, None)) is not None:
            return pathlib.Path(path)
    raise ValueError(f"{name!r} has neither a URDF, an MJCF nor a xacro file")
