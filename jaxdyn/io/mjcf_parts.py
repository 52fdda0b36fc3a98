"""Constraints, tendons and actuators of a compiled MJCF file, each with a list of the unsupported ones.

The length of a tendon that is linear in the coordinates of joints of one degree of freedom is l = sum_i c_i q_i, so l and its
rate are one row of coefficients times q and v.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.base import Constraint, Holonomic
from jaxdyn.constraints.loops import gear, lock_joint, loop
from jaxdyn.io.loaded import Actuators, NotTaken
from jaxdyn.io.mjcf_file import HINGE, SLIDE, CompiledFile, pose_of
from jaxdyn.model.topology import body_index
from jaxdyn.model.tree import Model


class TendonForce(eqx.Module):
    """Springs and dampers along tendons: tau = -rows^T (stiffness s + damping ldot), s the excess of l over `rest`.

    Within the interval `rest` (lower, upper) the spring is slack; a spring without slack has both equal.

    **Fields:** `q_index`, `v_index` (n,), indices of the joints' coordinates in q and v; `rows` (nt, n), the
    coefficients c (1 or m/rad); `stiffness` (N/m), `damping` (N s/m), (nt,); `rest` (nt, 2), m.
    """

    q_index: tuple[int, ...] = eqx.field(static=True)
    v_index: tuple[int, ...] = eqx.field(static=True)
    rows: Float[Array, "nt n"]
    stiffness: Float[Array, " nt"]
    damping: Float[Array, " nt"]
    rest: Float[Array, "nt 2"]

    def __call__(self, system: Any, q: Float[Array, " nq"], v: Float[Array, " nv"], t) -> Float[Array, " nv"]:
        rows, stiffness, damping, rest = (
            x.astype(q.dtype) for x in (self.rows, self.stiffness, self.damping, self.rest)
        )
        length = rows @ q[np.array(self.q_index)]
        place = np.array(self.v_index)
        # Zero inside the rest interval, signed distance to it outside.
        stretch = length - jnp.clip(length, rest[:, 0], rest[:, 1])
        force = -(stiffness * stretch + damping * (rows @ v[place]))
        # Each joint is listed once, so that `set` on zeros loses nothing.
        return jnp.zeros((system.nv,), q.dtype).at[place].set(force @ rows)


class PolynomialCoupling(eqx.Module):
    """Residual of l_1 - r_1 = sum_k c_k (l_2 - r_2)^k, (1,); l_1 and l_2 are linear in q.

    **Fields:** `index` (n,), indices in q; `first`, `second` (n,), the rows of l_1 and l_2; `references` (2,), r;
    `coefficients` (5,), c_0 to c_4.
    """

    index: tuple[int, ...] = eqx.field(static=True)
    first: Float[Array, " n"]
    second: Float[Array, " n"]
    references: Float[Array, "2"]
    coefficients: Float[Array, "5"]

    def __call__(self, q: Float[Array, " nq"], t) -> Float[Array, "1"]:
        chosen = q[np.array(self.index)]
        first, second, references, coefficients = (
            x.astype(q.dtype) for x in (self.first, self.second, self.references, self.coefficients)
        )
        x = jnp.sum(second * chosen) - references[1]
        value = coefficients[4]
        for k in (3, 2, 1, 0):  # Horner's rule: no powers, so no derivative of 0^0
            value = value * x + coefficients[k]
        return (jnp.sum(first * chosen) - references[0] - value)[None]


_CONNECT, _WELD, _JOINT, _TENDON = range(4)  # mjtEq
_ON_JOINT, _IN_PARENT, _ON_TENDON, _AT_SITE = 0, 1, 3, 4  # mjtTrn
_NO_TURN = (1.0, 0.0, 0.0, 0.0)


def constraints(file: CompiledFile, model: Model, left: NotTaken) -> list[Constraint]:
    """Exact constraints of the `equality` elements."""
    m, taken = file.m, []
    for i in range(m.neq):
        name = file.mujoco.mj_id2name(m, file.mujoco.mjtObj.mjOBJ_EQUALITY, i) or f"equality{i}"
        # Equalities can be switched at run time in MuJoCo; a scene has a fixed set, that of the file's start.
        if not m.eq_active0[i] or file.off("EQUALITY") or file.off("CONSTRAINT"):
            left.add("equalities that the file switches off", [name])
            continue
        kind = m.eq_type[i]
        if kind in (_CONNECT, _WELD):
            made, reason = _loop(file, model, i, name)
        elif kind in (_JOINT, _TENDON):
            made, reason = _coupling(file, model, i, name)
        else:
            made, reason = None, "equalities of flexible bodies"
        taken += [] if made is None else [made]
        left.add(reason, [name] if made is None else [])
    return taken


def _loop(file: CompiledFile, model: Model, i: int, name: str) -> tuple[Constraint | None, str]:
    m = file.m
    first, second, data = int(m.eq_obj1id[i]), int(m.eq_obj2id[i]), m.eq_data[i]
    if m.eq_objtype[i] == int(file.mujoco.mjtObj.mjOBJ_SITE):
        ends = [(file.sites[first], np.eye(4)), (file.sites[second], np.eye(4))]
    elif m.eq_type[i] == _CONNECT:
        ends = [(file.bodies[first], pose_of(data[:3], _NO_TURN)), (file.bodies[second], pose_of(data[3:6], _NO_TURN))]
    else:
        # The compiler fills in the pose of the second body in the first, at the anchor given in the second.
        ends = [
            (file.bodies[first], pose_of(data[3:6], data[6:10])),
            (file.bodies[second], pose_of(data[:3], _NO_TURN)),
        ]
    # Bodies merged by fixed joints cannot move relative to each other: such rows are zero.
    if len({body_index(model, body) for body, _ in ends}) == 1:
        return None, "equalities between two parts of one body"
    points = m.eq_type[i] == _CONNECT or data[10] == 0  # without torque scale a weld constrains the point only
    (body_a, pose_a), (body_b, pose_b) = ends
    return loop(body_a, pose_a, body_b, pose_b, "spherical" if points else "weld", name=name), ""


def _coupling(file: CompiledFile, model: Model, i: int, name: str) -> tuple[Constraint | None, str]:
    m = file.m
    first, second, c = int(m.eq_obj1id[i]), int(m.eq_obj2id[i]), m.eq_data[i, :5]
    if m.eq_type[i] == _JOINT:
        r = [m.qpos0[m.jnt_qposadr[j]] if j >= 0 else 0.0 for j in (first, second)]
        # Without a second joint MuJoCo holds the first at its reference plus c0.
        if second < 0:
            return lock_joint(file.joints[first], r[0] + c[0], name=name), ""
        if not c[2:].any():
            # MuJoCo's polynomial is in displacements from qpos0; with c2 = c3 = c4 = 0 it is a gear with a shifted
            # offset.
            return gear(file.joints[first], file.joints[second], c[1], r[0] + c[0] - c[1] * r[1], name=name), ""
        rows = [{first: 1.0}, {second: 1.0}]
    else:
        joint_rows = _row(file, first), _row(file, second) if second >= 0 else {}
        if None in joint_rows:
            return None, "equalities of spatial tendons"
        rows = [row for row in joint_rows if row is not None]
        # MuJoCo measures lengths of tendons from those at qpos0.
        r = [m.tendon_length0[t] if t >= 0 else 0.0 for t in (first, second)]
    # Both rows are over one list of joints, in the order of their first occurrence.
    joints = list(dict.fromkeys(j for row in rows for j in row))
    values = [jnp.asarray([row.get(j, 0.0) for j in joints], float) for row in rows]
    index = tuple(_places(file, model, j)[0] for j in joints)
    residual = PolynomialCoupling(index, values[0], values[1], jnp.asarray(r, float), jnp.asarray(c, float))
    return Holonomic(residual, name=name), ""


def _places(file: CompiledFile, model: Model, joint: int) -> tuple[int, int]:
    """Indices of a joint's coordinate in the model's q and v."""
    i = model.joint_names.index(file.joints[joint])
    return model.topology.q_slices[i].start, model.topology.v_slices[i].start


def _row(file: CompiledFile, tendon: int) -> dict[int, float] | None:
    """Coefficients by joint of a tendon that is linear in the joints' coordinates, None for any other."""
    m, row = file.m, {}
    for w in range(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon]):
        if m.wrap_type[w] != int(file.mujoco.mjtWrap.mjWRAP_JOINT):
            return None
        joint = int(m.wrap_objid[w])
        # A joint may occur twice in one tendon; its coefficients add.
        row[joint] = row.get(joint, 0.0) + float(m.wrap_prm[w])
    return row


def tendon_forces(file: CompiledFile, model: Model, left: NotTaken) -> list[TendonForce]:
    """Springs and dampers of linear tendons."""
    m = file.m
    # Flags leave the numbers of the compiled model as they are.
    springs = m.tendon_stiffness * (not file.off("SPRING"))
    dampers = m.tendon_damping * (not file.off("DAMPER"))
    rows = [_row(file, t) for t in range(m.ntendon)]
    taken = [t for t, row in enumerate(rows) if row is not None and (springs[t] or dampers[t])]

    def leave(what: str, condition) -> None:
        left.add(what, [name for t, name in enumerate(file.tendons) if condition(t)])

    leave("forces of spatial tendons", lambda t: rows[t] is None and (springs[t] or dampers[t]))
    leave("limits of tendons", lambda t: m.tendon_limited[t])
    leave("dry friction of tendons", lambda t: m.tendon_frictionloss[t])
    leave("armature of tendons", lambda t: m.tendon_armature[t])
    leave("plastic springs of tendons", lambda t: m.tendon_plasticadr[t] >= 0)
    nonlinear = lambda t: m.tendon_stiffnesspoly[t].any() or m.tendon_dampingpoly[t].any()  # noqa: E731
    leave("nonlinear springs or damping of tendons", nonlinear)
    if not taken:
        return []
    joints = sorted({j for t in taken for j in rows[t] or ()})
    places = [_places(file, model, j) for j in joints]
    force = TendonForce(
        tuple(q for q, _ in places),
        tuple(v for _, v in places),
        jnp.asarray([[(rows[t] or {}).get(j, 0.0) for j in joints] for t in taken], float),
        jnp.asarray(springs[taken], float),
        jnp.asarray(dampers[taken], float),
        jnp.asarray(m.tendon_lengthspring[taken], float),
    )
    return [force]


def actuators(file: CompiledFile, model: Model, left: NotTaken) -> Actuators | None:
    """Actuators, None without any."""
    m, taken = file.m, []
    for i, name in enumerate(file.actuators):
        if reason := _fault(file, i):
            left.add(f"actuators {reason}", [name])
        else:
            taken.append(i)
    left.add(
        "armature or damping of actuators on tendons and sites",
        [
            file.actuators[i]
            for i in range(m.nactuator)
            if (m.actuator_armature[i] or m.actuator_damping[i] or m.actuator_dampingpoly[i].any())
            and (m.actuator_trntype[i] not in (_ON_JOINT, _IN_PARENT) or m.actuator_dampingpoly[i].any())
        ],
    )
    if not taken:
        return None
    n = len(taken)
    moment, wrenches = np.zeros((n, model.nv)), np.zeros((n, 6))
    # -1 marks coordinates of ball and free joints, for which no length is defined.
    places, force_range = np.full(model.nv, -1), np.tile([-np.inf, np.inf], (model.nv, 1))
    for j in range(m.njnt):
        if m.jnt_type[j] in (SLIDE, HINGE):
            q, v = _places(file, model, j)
            places[v] = q
            if m.jnt_actfrclimited[j]:
                force_range[v] = m.jnt_actfrcrange[j]
    sites: list[str | None] = [None] * n
    for k, i in enumerate(taken):
        kind, target, pull = m.actuator_trntype[i], int(m.actuator_trnid[i, 0]), m.actuator_gear[i]
        if kind == _AT_SITE:
            sites[k], wrenches[k] = file.sites[target], pull
            continue
        # Joints and fixed tendons are the same: one row of coefficients.
        row = {target: 1.0} if kind != _ON_TENDON else _row(file, target) or {}
        for joint, coefficient in row.items():
            moment[k, _places(file, model, joint)[1]] += pull[0] * coefficient

    def ranges_of(limited, ranges, off: bool) -> np.ndarray:
        # A range is stored also where it is not active.
        return np.where((limited[taken] != 0)[:, None] & (not off), ranges[taken], [-np.inf, np.inf])

    # Fixed gains and absent biases may leave stale parameters in the arrays.
    no_gain = m.actuator_gaintype[taken] == int(file.mujoco.mjtGain.mjGAIN_FIXED)
    no_bias = m.actuator_biastype[taken] == int(file.mujoco.mjtBias.mjBIAS_NONE)
    gain, bias = m.actuator_gainprm[taken, :3].copy(), m.actuator_biasprm[taken, :3].copy()
    gain[no_gain, 1:] = 0.0
    bias[no_bias] = 0.0
    numbers = (
        moment,
        wrenches,
        gain,
        bias,
        ranges_of(m.actuator_ctrllimited, m.actuator_ctrlrange, file.off("CLAMPCTRL")),
        ranges_of(m.actuator_forcelimited, m.actuator_forcerange, False),
        force_range,
    )
    names = tuple(file.actuators[i] for i in taken)
    leaves = [jnp.asarray(x, model.home.dtype) for x in numbers]
    dynamics = tuple(_dynamics(file, i) for i in taken)
    if any(dynamics):
        active = [i for i, kind in zip(taken, dynamics, strict=True) if kind]
        limited = m.actuator_actlimited[active].astype(bool)[:, None]
        of_active = m.actuator_dynprm[active, 0], np.where(limited, m.actuator_actrange[active], [-np.inf, np.inf])
        leaves += [jnp.asarray(x, model.home.dtype) for x in of_active]
    return Actuators(names, tuple(sites), tuple(int(x) for x in places), *leaves, dynamics=dynamics)


def _dynamics(file: CompiledFile, i: int) -> str | None:
    """Kind of an actuator's dynamics in `Actuators.dynamics`, "" for others."""
    kinds = file.mujoco.mjtDyn
    # The two filters have one equation; they differ in MuJoCo's steps.
    names = {kinds.mjDYN_NONE: None, kinds.mjDYN_INTEGRATOR: "integrator"}
    names |= {kinds.mjDYN_FILTER: "filter", kinds.mjDYN_FILTEREXACT: "filter"}
    # "" and not None: None is an actuator without dynamics, which is supported.
    return {int(kind): name for kind, name in names.items()}.get(int(file.m.actuator_dyntype[i]), "")


def _fault(file: CompiledFile, i: int) -> str:
    """Reason why an actuator is unsupported, to follow "actuators"; empty when it is supported."""
    m, mujoco = file.m, file.mujoco
    dynamics, gain, bias = _dynamics(file, i), m.actuator_gaintype[i], m.actuator_biastype[i]
    kind, target = m.actuator_trntype[i], [int(x) for x in m.actuator_trnid[i]]
    # disableactuator has one bit per group; actuators of a negative group cannot be disabled.
    if file.off("ACTUATION") or (m.actuator_group[i] >= 0 and m.opt.disableactuator >> m.actuator_group[i] & 1):
        return "that the file switches off"
    if m.actuator_plugin[i] >= 0:
        return "of plugins"
    if gain == int(mujoco.mjtGain.mjGAIN_MUSCLE) or bias == int(mujoco.mjtBias.mjBIAS_MUSCLE):
        return "that are muscles"
    if m.actuator_delay[i]:
        return "with a delay"
    if dynamics == "":
        return "with dynamics other than an integrator or a filter"
    if dynamics == "filter" and not m.actuator_dynprm[i, 0] > 0:
        return "with a filter without a time constant"
    affine = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
    if gain not in affine or bias not in (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)):
        return "whose force is not affine in length and velocity"
    if m.actuator_ctrlnum[i] != 1 or m.actuator_outnum[i] != 1:
        return "of several controls or forces"
    # For hinges and slides the two transmissions are the same; they differ for ball and free joints only.
    if kind in (_ON_JOINT, _IN_PARENT):
        return "on ball and free joints" if m.jnt_type[target[0]] not in (SLIDE, HINGE) else ""
    if kind == _ON_TENDON:
        limited = m.tendon_actfrclimited[target[0]]
        if _row(file, target[0]) is None:
            return "on spatial tendons"
        return "on tendons that limit their force" if limited else ""
    if kind == _AT_SITE:
        return "at a site against another" if target[1] >= 0 else ""
    return "on slider-cranks or bodies"
