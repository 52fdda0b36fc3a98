"""MJCF loader: mujoco's compiler reads the file, and the compiled model becomes a scene with its contacts.

Defaults, includes, inertias from geometry, angles in degrees and the other rules of the format are left to the
compiler. Compiled numbers are in SI units; quaternions are (w, x, y, z) of unit length. Two conventions differ: a free
joint's linear velocity is in world axes there and in the body's here; a joint of one degree of freedom has a
reference `qpos0` there, the coordinate of the file's placement, which the home pose contains here.
"""

import os
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxdyn.contact.shape_contacts import HeightField
from jaxdyn.contact.unilateral import UnilateralContact
from jaxdyn.forces.elements import CoulombFriction, JointDamping, JointSpring
from jaxdyn.io.loaded import (
    Link,
    LoadedScene,
    Names,
    NotTaken,
    Start,
    add_chain,
    build_model,
    warn_of_units,
)
from jaxdyn.io.mjcf_file import (
    BALL,
    FREE,
    HINGE,
    SIZES,
    SLIDE,
    CompiledFile,
    assign_names,
    compile_file,
    import_mujoco,
    pose_of,
    sensors,
)
from jaxdyn.io.mjcf_parts import actuators, constraints, tendon_forces
from jaxdyn.io.solids import Collision, contacts_with_ground, geom_solid
from jaxdyn.io.xml_lines import LARGEST_ROUNDING, XmlFile, rounding_of_digits
from jaxdyn.model import host_math
from jaxdyn.model.arguments import DType, as_path
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.configuration import neutral
from jaxdyn.model.tree import Model

_HEIGHT_FIELD = 1  # mjtGeom


def contacts_of(
    file: CompiledFile, model: Model, contacts: str | Iterable[str] | None, has_missing_meshes: bool, left: NotTaken
) -> tuple[list[UnilateralContact], set[str]]:
    """Contacts with the ground, and the bodies that have them."""
    if contacts is None:
        return [], set()
    if file.off("CONTACT"):
        left["contacts, which the file disables"] = {}
        return [], set()
    m, collisions, spinning, soft = file.m, [], [], []
    has_two = [i for i in range(m.npair) if m.pair_friction[i, 0] != m.pair_friction[i, 1]]
    skewed = [m.geom_bodyid[g] for i in has_two for g in _pair(m, i)]
    if m.opt.enableflags & int(file.mujoco.mjtEnableBit.mjENBL_OVERRIDE):
        # Friction and margin of the options are those of all geoms and pairs (MuJoCo's "contact override").
        m.geom_friction[:], m.pair_friction[:] = m.opt.o_friction[[0, 2, 3]], m.opt.o_friction
        m.geom_margin[:] = m.opt.o_margin
        skewed = range(m.nbody) if m.opt.o_friction[0] != m.opt.o_friction[1] else []
    in_pairs = {g for i in range(m.npair) for g in _pair(m, i)}
    for g in range(m.ngeom):
        # Geoms without contype and conaffinity are visual and touch nothing unless a pair names them.
        if not (m.geom_contype[g] or m.geom_conaffinity[g] or g in in_pairs):
            continue
        body = file.bodies[m.geom_bodyid[g]]
        solid = _height_field(m, g) if m.geom_type[g] == _HEIGHT_FIELD else geom_solid(m, g)
        # `compile_file` replaces missing meshes by points of this size.
        is_point = has_missing_meshes and not isinstance(solid, HeightField) and solid and solid.size == (1e-3,) * 3
        if solid is None or is_point:
            continue
        collisions.append(Collision(body, pose_of(m.geom_pos[g], m.geom_quat[g]), solid, _own_friction(m, g), g))
        if body is not None and m.geom_condim[g] > 3:
            spinning.append(body)
        if body is not None and m.geom_margin[g]:
            soft.append(body)
    friction = lambda a, b: _friction(m, a.key, b.key)  # noqa: E731
    made, taken = contacts_with_ground(model, collisions, contacts, left, friction)
    left.add("torsional and rolling friction of bodies", [x for x in spinning if x in taken])
    left.add("margin of contacts of bodies", [x for x in soft if x in taken])
    left.add("friction of bodies in a second direction", [x for b in skewed if (x := file.bodies[b]) in taken and x])
    return made, taken


def _pair(m, i: int) -> set[int]:
    """The geoms of a contact pair of the file."""
    return {int(m.pair_geom1[i]), int(m.pair_geom2[i])}


def _own_friction(m, g: int) -> float:
    return float(m.geom_friction[g, 0]) if m.geom_condim[g] > 1 else 0.0


def _friction(m, g: int, h: int) -> float | None:
    """Sliding friction of two geoms, None where they do not touch."""
    for i in range(m.npair):
        if _pair(m, i) == {g, h}:
            return float(m.pair_friction[i, 0]) if m.pair_dim[i] > 1 else 0.0
    bodies = {int(m.geom_bodyid[g]), int(m.geom_bodyid[h])}
    # A signature holds the numbers of two bodies.
    if any({int(x) >> 16, int(x) & 0xFFFF} == bodies for x in m.exclude_signature):
        return None
    bits = (m.geom_contype[g] & m.geom_conaffinity[h]) | (m.geom_contype[h] & m.geom_conaffinity[g])
    if not bits:
        return None
    if m.geom_priority[g] != m.geom_priority[h]:
        return _own_friction(m, g if m.geom_priority[g] > m.geom_priority[h] else h)
    if max(m.geom_condim[g], m.geom_condim[h]) == 1:
        return 0.0
    return float(max(m.geom_friction[g, 0], m.geom_friction[h, 0]))


def _height_field(m, g: int) -> HeightField:
    """Height field of a geom. MuJoCo has rows along y, and heights from 0 to 1 in units of the elevation."""
    i = int(m.geom_dataid[g])
    rows, columns = int(m.hfield_nrow[i]), int(m.hfield_ncol[i])
    start = int(m.hfield_adr[i])
    heights = np.asarray(m.hfield_data[start : start + rows * columns], float).reshape(rows, columns).T
    half = np.asarray(m.hfield_size[i, :2], float)
    return HeightField(heights * float(m.hfield_size[i, 2]), 2 * half / (np.array([columns, rows]) - 1))


def read_mjcf(path: str | os.PathLike, *, contacts, dtype: DType | None) -> LoadedScene:
    """Scene of an MJCF file, with options as of `jd.load`.

    Missing names become "bodyN" and BODY_joint (BODY_jointK of several), names in use get an underscore appended, and a site with
    the name of a body is SITE_site. Several joints on one body become a chain of massless bodies BODY_JOINT.

    **Raises:** ValueError with the file (and the line, where mujoco gives it) for a file that cannot be read or
    compiled; for a joint that moves no inertia. ImportError without mujoco.
    """
    mujoco = import_mujoco()
    given = str(as_path(path))
    m, missing = compile_file(mujoco, given)
    file = assign_names(mujoco, m, given)
    model = _model(file, dtype)
    left = NotTaken({line: {} for line in missing})
    rows = constraints(file, model, left)
    tendons = tendon_forces(file, model, left)
    drives = actuators(file, model, left)
    touching, taken = contacts_of(file, model, contacts, bool(missing), left)
    readings = sensors(file, model, taken, left)
    _add_elements_without_effect(file, taken, left)
    not_taken = left.warn(path)
    warn_of_units(path, model)
    forces = (*_joint_forces(file, model), *tendons, *touching)
    starts = _starts(file, model, drives)
    return LoadedScene(model, rows, forces, starts=starts, actuators=drives, not_taken=not_taken, sensors=readings)


def _rounding(path: str) -> float:
    """`rounding_of_digits` of a file that mujoco has read; the largest one for a file that it alone can read."""
    try:
        root = XmlFile(path, "MJCF").root
    except ValueError:
        return LARGEST_ROUNDING
    # Included files may hold numbers of any digits.
    return LARGEST_ROUNDING if root.find(".//include") is not None else rounding_of_digits(root)


def _model(file: CompiledFile, dtype) -> Model:
    m = file.m
    # Without gravity its terms are not compiled.
    gravity = None if file.off("GRAVITY") or not m.opt.gravity.any() else m.opt.gravity
    # The buffer of names begins with that of the model, ended by a zero byte.
    name = m.names.split(b"\0", 1)[0].decode() or "mechanism"
    builder = ModelBuilder(name, gravity=gravity, dtype=dtype, rounding=_rounding(file.path))
    frames, joint_names = Names(), Names()
    # All names of the file are reserved before any intermediate body takes one. Body 0 is the world.
    for taken in (*file.bodies[1:], *file.sites):
        frames.new(str(taken))
    for taken in file.joints:
        joint_names.new(taken)
    armature, damping = _rotors(file)
    # MuJoCo numbers parents before children, as `ModelBuilder` requires.
    for b in range(1, m.nbody):
        # body_jntadr is -1 where a body has no joint.
        joints = range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]) if m.body_jntnum[b] else ()
        links = [_link(file, j, armature, damping) for j in joints]
        inertia = (m.body_mass[b], *_central_inertia(m, b))
        # MuJoCo's free joint has the world pose as its configuration, so the home pose is the identity.
        free = bool(links) and links[0].kind == "free"
        pose = np.eye(4) if free else pose_of(m.body_pos[b], m.body_quat[b])
        parent = file.bodies[m.body_parentid[b]]
        add_chain(builder, frames, joint_names, str(file.bodies[b]), parent, pose, links, inertia)
    for s, site in enumerate(file.sites):
        builder.add_frame(site, file.bodies[m.site_bodyid[s]], pose_of(m.site_pos[s], m.site_quat[s]))
    return build_model(builder, file.path)


def _central_inertia(m, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass (3,) and inertia (3, 3) about it in the body's frame.

    Where the inertial frame is within some nanometres of the body's, MuJoCo treats them as equal.
    """
    same_frame, same_turn = m.body_sameframe[b] == 1, m.body_sameframe[b] in (1, 3)  # mjtSameFrame: BODY, BODYROT
    turn = np.eye(3) if same_turn else pose_of(np.zeros(3), m.body_iquat[b])[:3, :3]
    # MuJoCo diagonalises the inertia: body_inertia holds principal moments in the axes of body_iquat.
    return np.zeros(3) if same_frame else m.body_ipos[b].copy(), turn @ np.diag(m.body_inertia[b]) @ turn.T


def _rotors(file: CompiledFile) -> tuple[np.ndarray, np.ndarray]:
    """Armature and damping (nv,) of the joints, including the contributions of actuators on joints."""
    m = file.m
    armature, damping = m.dof_armature.copy(), m.dof_damping.copy()
    for i in range(m.nactuator):
        if m.actuator_trntype[i] in (0, 1) and m.jnt_type[j := m.actuator_trnid[i, 0]] in (SLIDE, HINGE):
            # Rotor quantities reflect through the gear with its square.
            armature[m.jnt_dofadr[j]] += m.actuator_gear[i, 0] ** 2 * m.actuator_armature[i]
            damping[m.jnt_dofadr[j]] += m.actuator_gear[i, 0] ** 2 * m.actuator_damping[i]
    # <flag damper="disable"> leaves the numbers in the compiled model and only skips the forces.
    return armature, damping * (not file.off("DAMPER"))


def _link(file: CompiledFile, j: int, armature: np.ndarray, damping: np.ndarray) -> Link:
    m = file.m
    kind = m.jnt_type[j]
    dofs = slice(m.jnt_dofadr[j], m.jnt_dofadr[j] + SIZES[kind][1])
    leaves: dict[str, Any] = {
        key: values[dofs] if values[dofs].any() else None
        for key, values in (("armature", armature), ("damping", damping), ("friction", m.dof_frictionloss))
    }
    # The range of a ball joint is a cone angle, which is no bound of a coordinate.
    limited = bool(m.jnt_limited[j]) and kind in (SLIDE, HINGE)
    if limited:
        leaves |= {"lower": m.jnt_range[j, 0], "upper": m.jnt_range[j, 1]}
    if m.jnt_actfrclimited[j] and kind in (SLIDE, HINGE):
        # A model has symmetric effort limits; the asymmetric range itself clips in `Actuators`.
        leaves["effort_limit"] = np.abs(m.jnt_actfrcrange[j]).max()
    # In the order of mjtJoint.
    word = ("free", "spherical", "prismatic", "revolute" if limited else "continuous")[kind]
    # qpos0 of ball and free joints is a pose and not an offset of the coordinate.
    reference = m.qpos0[m.jnt_qposadr[j]] if kind in (SLIDE, HINGE) else 0.0
    return Link(file.joints[j], word, m.jnt_axis[j].copy(), m.jnt_pos[j].copy(), float(reference), leaves)


def _joint_forces(file: CompiledFile, model: Model) -> list:
    m, forces = file.m, []
    # A free joint has no spring here; it is reported as not taken.
    scalars = [j for j in range(m.njnt) if m.jnt_type[j] in (SLIDE, HINGE, BALL) and m.jnt_stiffness[j]]
    if scalars and not file.off("SPRING"):
        rest = [m.qpos_spring[m.jnt_qposadr[j] :][: SIZES[m.jnt_type[j]][0]] for j in scalars]
        stiffness = np.repeat(m.jnt_stiffness[scalars], [SIZES[m.jnt_type[j]][1] for j in scalars])
        forces.append(JointSpring(stiffness, np.concatenate(rest), [file.joints[j] for j in scalars]))
    # Damping disabled by the file is already zero, and zeros give no leaf.
    if model.damping is not None:
        forces.append(JointDamping())
    # Dry friction is a constraint of MuJoCo's solver.
    if model.friction is not None and not (file.off("FRICTIONLOSS") or file.off("CONSTRAINT")):
        forces.append(CoulombFriction())
    return forces


def _starts(file: CompiledFile, model: Model, drives) -> dict[str, Start]:
    m, dtype = file.m, model.home.dtype

    # Only the actuators that are taken have a control in the scene, in the order of their names.
    def start(qpos, qvel, control=None, act=None) -> Start:
        q, v = _state(file, model, qpos, qvel)
        taken = active = None
        if drives is not None and control is not None:
            places = [file.actuators.index(name) for name in drives.names]
            taken = jnp.asarray(control[m.actuator_ctrladr[places]], dtype)
            if act is not None and any(drives.dynamics):
                active = jnp.asarray(act[[m.actuator_actadr[i] for i in places if m.actuator_actnum[i]]], dtype)
        return Start(jnp.asarray(q, dtype), jnp.asarray(v, dtype), taken, active)

    starts = {"reference": start(m.qpos0, np.zeros(m.nv))}
    for k in range(m.nkey):
        name = file.mujoco.mj_id2name(m, file.mujoco.mjtObj.mjOBJ_KEY, k) or f"key{k}"
        starts[name] = start(m.key_qpos[k], m.key_qvel[k], m.key_ctrl[k], m.key_act[k])
    return starts


def _state(file: CompiledFile, model: Model, qpos, qvel) -> tuple[np.ndarray, np.ndarray]:
    """Convert MuJoCo's state to the model's coordinates."""
    m = file.m
    q = np.array(neutral(model), float)
    v = np.zeros(model.nv)
    for j, name in enumerate(file.joints):
        i = model.joint_names.index(name)
        nq, nv = SIZES[m.jnt_type[j]]
        # Joints have another order here than in the file, so each one is looked up by its name.
        here, rate = qpos[m.jnt_qposadr[j] :][:nq].copy(), qvel[m.jnt_dofadr[j] :][:nv].copy()
        # Keyframes are written by hand with few digits; the model expects unit quaternions.
        if nq > 1:
            here[-4:] /= np.linalg.norm(here[-4:])
        # World-frame linear velocity there, body-frame here.
        if nq == 7:
            rate[:3] = host_math.joint_pose("free", np.zeros(6), here)[:3, :3].T @ rate[:3]
        q[model.topology.q_slices[i]], v[model.topology.v_slices[i]] = here, rate
    return q, v


def _add_elements_without_effect(file: CompiledFile, taken: set[str], left: NotTaken) -> None:
    """Add the elements of the file that the scene does not represent, apart from constraints, tendons and actuators.

    `taken`: bodies with contacts.
    """
    m, mujoco = file.m, file.mujoco
    free = [file.joints[j] for j in range(m.njnt) if m.jnt_type[j] == FREE]

    def joints(condition) -> list[str]:
        return [file.joints[j] for j in range(m.njnt) if condition(j)]

    def dofs(values) -> list[str]:
        return [file.joints[m.dof_jntid[i]] for i in np.flatnonzero(values)]

    # Geoms without contype and conaffinity are visual and touch nothing unless a pair names them.
    touching = {m.geom_bodyid[g] for g in range(m.ngeom) if m.geom_contype[g] or m.geom_conaffinity[g]}
    touching |= {m.geom_bodyid[g] for pair in (m.pair_geom1, m.pair_geom2) for g in pair}
    names = [file.bodies[b] or "world" for b in sorted(touching) if not taken or file.bodies[b] is not None]
    names = [name for name in names if name not in taken] if not file.off("CONTACT") else []
    flexes = [mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_FLEX, i) or f"flex{i}" for i in range(m.nflex)]
    left.add("contact geometry of bodies", names)
    left.add("limit of ball joints", joints(lambda j: m.jnt_type[j] == BALL and m.jnt_limited[j]))
    left.add("spring of free joints", joints(lambda j: m.jnt_type[j] == FREE and m.jnt_stiffness[j]))
    left.add("nonlinear spring of joints", joints(lambda j: m.jnt_stiffnesspoly[j].any()))
    left.add("plastic spring of joints", joints(lambda j: m.jnt_plasticadr[j] >= 0))
    left.add("nonlinear damping of joints", dofs(m.dof_dampingpoly.any(1)))
    gyroscopic = "gyroscopic part of the armature of free joints (MuJoCo adds it in world axes)"
    left.add(gyroscopic, [name for name in dofs(m.dof_armature) if name in free])
    left.add("gravity compensation of bodies", [str(file.bodies[b]) for b in np.flatnonzero(m.body_gravcomp) if b])
    left.add("mocap bodies, fixed here", [str(file.bodies[b]) for b in range(m.nbody) if m.body_mocapid[b] >= 0])
    left.add("fluid forces", [key for key in ("density", "viscosity") if getattr(m.opt, key)])
    left.add("flexible bodies", flexes)
    if m.nplugin:
        left["plugins"] = {}
