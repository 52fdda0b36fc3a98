"""MuJoCo's numbers of an MJCF file in our coordinates: shared by the tests and `benchmarks/files.py`.

MuJoCo writes a free joint's linear velocity in world axes; v_mujoco = T(q) v with T the rotation there and the identity
elsewhere. The order of joints differs.
"""

import jax.numpy as jnp
import mujoco
import numpy as np
from pinocchio_bridge import quick

import jaxdyn as jd

# What makes M or the bias another than MuJoCo's, as the warning at load says.
APART = ("armature of tendons", "gyroscopic part of the armature")
SIZES = {0: (7, 6), 1: (4, 3), 2: (1, 1), 3: (1, 1)}  # free, ball, slide, hinge


class Oracle:
    """A compiled MJCF file with contacts, limits, springs, friction and drives off, and the places of its joints in ours.

    `whole` is the same file as it is.
    """

    def __init__(self, path, model: jd.Model):
        self.model, self.path = model, str(path)
        self.whole = mujoco.MjModel.from_xml_path(self.path)
        m = self.m = mujoco.MjModel.from_xml_path(self.path)
        for flag in ("CONTACT", "LIMIT", "FRICTIONLOSS", "SPRING", "DAMPER", "ACTUATION", "EQUALITY"):
            m.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
        m.opt.density = m.opt.viscosity = 0.0
        m.body_gravcomp[:] = 0.0
        self.bodies = [m.body(b).name or f"body{b}" for b in range(m.nbody)]
        joints = [m.joint(j).name or self._unnamed(j) for j in range(m.njnt)]
        places = [model.joint_names.index(name) for name in joints]
        q, v = model.topology.q_slices, model.topology.v_slices
        self.to_q = np.concatenate([np.r_[q[i]] for i in places]).astype(int)  # place in our q of each number of qpos
        self.to_v = np.concatenate([np.r_[v[i]] for i in places]).astype(int)
        self.free = [j for j in range(m.njnt) if m.jnt_type[j] == 0]
        self.data = mujoco.MjData(m)

    def _unnamed(self, j: int) -> str:
        body = self.m.jnt_bodyid[j]
        several = f"{j - self.m.body_jntadr[body]}" if self.m.body_jntnum[body] > 1 else ""
        return f"{self.bodies[body]}_joint{several}"

    def rotation(self, qpos, v) -> tuple[np.ndarray, np.ndarray]:
        """T (nv, nv) with v_mujoco = T v[to_v], and Tdot v."""
        T, rate = np.eye(self.m.nv), np.zeros(self.m.nv)
        ours = v[self.to_v]
        for j in self.free:
            q, dof = self.m.jnt_qposadr[j], self.m.jnt_dofadr[j]
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, qpos[q + 3 : q + 7] / np.linalg.norm(qpos[q + 3 : q + 7]))
            T[dof : dof + 3, dof : dof + 3] = turn.reshape(3, 3)
            rate[dof : dof + 3] = turn.reshape(3, 3) @ np.cross(ours[dof + 3 : dof + 6], ours[dof : dof + 3])
        return T, rate

    def set(self, q, v, data=None, m=None):
        """MuJoCo's data at our state; returns T and Tdot v."""
        data, m = data or self.data, m or self.m
        data.qpos[:] = np.asarray(q)[self.to_q]
        T, rate = self.rotation(data.qpos, np.asarray(v))
        data.qvel[:] = T @ np.asarray(v)[self.to_v]
        mujoco.mj_forward(m, data)
        return T, rate

    def ours(self, force_or_rows) -> np.ndarray:
        """The last axis moved from MuJoCo's order of velocities to ours."""
        out = np.empty_like(force_or_rows)
        out[..., self.to_v] = force_or_rows
        return out

    def dynamics(self, q, v, tau) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mass matrix, bias force and forward dynamics in our coordinates."""
        T, rate = self.set(q, v)
        M = np.zeros((self.m.nv, self.m.nv))
        mujoco.mj_fullM(self.m, self.data, M)
        bias = np.zeros(self.m.nv)
        mujoco.mj_rne(self.m, self.data, 0, bias)
        self.data.qfrc_applied[:] = T @ np.asarray(tau)[self.to_v]
        mujoco.mj_forward(self.m, self.data)
        acceleration = T.T @ (self.data.qacc_smooth - rate)
        whole = self.ours(self.ours(T.T @ M @ T).T).T
        return whole, self.ours(T.T @ (bias + M @ rate)), self.ours(acceleration)

    def body_poses(self) -> np.ndarray:
        """World poses (nbody - 1, 4, 4) of the file's bodies at the state that was set."""
        poses = np.tile(np.eye(4), (self.m.nbody - 1, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.data.xmat[1:].reshape(-1, 3, 3), self.data.xpos[1:]
        return poses

    def passive_force(self, q, v) -> np.ndarray:
        """Springs and dampers of joints and tendons as the file has them, without dry friction, fluid, gravity."""
        m = self.whole
        m.opt.density = m.opt.viscosity = 0.0
        m.body_gravcomp[:] = 0.0
        for t in range(m.ntendon):  # spatial tendons are not taken
            if m.wrap_type[m.tendon_adr[t]] != int(mujoco.mjtWrap.mjWRAP_JOINT):
                m.tendon_stiffness[t] = m.tendon_damping[t] = 0.0
        data = mujoco.MjData(m)
        T, _ = self.set(q, v, data, m)
        return self.ours(T.T @ (data.qfrc_spring + data.qfrc_damper))

    def equality_rows(self, q) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the active equalities in our velocities, and their residuals."""
        m = self.whole
        for flag in ("CONTACT", "LIMIT", "FRICTIONLOSS"):
            m.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
        m.opt.jacobian = 0
        data = mujoco.MjData(m)
        T, _ = self.set(q, np.zeros(m.nv), data, m)
        rows = data.efc_J.reshape(-1, m.nv)[data.efc_type == 0]
        return self.ours(rows @ T), data.efc_pos[data.efc_type == 0]

    def actuation(self, q, v, control: dict[str, float], activation) -> tuple[np.ndarray, np.ndarray]:
        """Generalised force of the actuators named, and the rates of their activations; all others are without force."""
        m = mujoco.MjModel.from_xml_path(self.path)
        data, active = mujoco.MjData(m), []
        for i in range(m.nactuator):
            name = m.actuator(i).name or f"actuator{i}"
            if name in control:
                data.ctrl[m.actuator_ctrladr[i]] = control[name]
                active += [m.actuator_actadr[i]] * int(m.actuator_actnum[i])
            else:
                m.actuator_gainprm[i] = m.actuator_biasprm[i] = 0.0
        m.body_gravcomp[:] = 0.0  # some of it would act through the actuators
        m.actuator_actearly[:] = 0  # a choice of MuJoCo's steps: forces by the activations at their end
        data.act[active] = activation
        T, _ = self.set(q, v, data, m)
        return self.ours(T.T @ data.qfrc_actuator), data.act_dot[active]


def error(ours, theirs, floor: float = 0.0) -> float:
    """Largest difference, relative to the largest number, so that a fly counts as much as a dog; or to a floor above it."""
    theirs = np.asarray(theirs)
    return float(
        np.abs(np.asarray(ours) - theirs).max(initial=0.0) / (max(np.abs(theirs).max(initial=0.0), floor) or 1.0)
    )


def row_space(rows) -> np.ndarray:
    """The projector on the space of the rows."""
    _, sizes, right = np.linalg.svd(np.asarray(rows), full_matrices=False)
    right = right[sizes > 1e-9 * max(1.0, sizes.max(initial=0.0))]
    return right.T @ right


def agreement(path, scene: jd.io.LoadedScene) -> dict[str, float]:
    """Errors against MuJoCo: the mass that moves; at a random state frames, M, bias, forward dynamics, springs and dampers,
    actuators; and at the reference, where loops close, those of the space that the constraints' rows span."""
    model, oracle, rng = scene.system, Oracle(path, scene.system), np.random.default_rng(1)
    start = scene.starts["reference"].q
    v, tau, step = (jnp.asarray(rng.normal(size=model.nv)) for _ in range(3))
    drives = scene.actuators
    control = rng.normal(size=0 if drives is None else len(drives.names))
    active = () if drives is None or drives.activation_range is None else np.asarray(drives.activation_range).T
    activation = np.clip(rng.normal(size=len(active[0])), *active) if len(active) else None

    @quick
    def ours(scene, start, step, v, tau, control, activation):
        model = scene.system
        q = jd.integrate(model, start, 0.7 * step)
        forces = [force for force in scene.forces if not isinstance(force, jd.forces.CoulombFriction)]
        computed = {
            "M": jd.mass_matrix(model, q),
            "bias": jd.bias_force(model, q, v),
            "acceleration": jd.forward_dynamics(model, q, v, tau),
            "passive": sum((force(model, q, v, 0.0) for force in forces), jnp.zeros(model.nv)),
        }
        if scene.actuators is not None:
            computed["actuation"] = scene.actuators(model, q, v, control, activation)
            if activation is not None:
                computed["activation"] = scene.actuators.activation_rate(control, activation)
        rows = jd.constraint_jacobian(scene, start) if scene.constraints else None
        return q, jd.forward_kinematics(model, q), computed, rows

    q, poses, computed, rows = ours(scene, start, step, v, tau, jnp.asarray(control), activation)
    theirs = dict(zip(("M", "bias", "acceleration"), oracle.dynamics(q, v, tau), strict=True))
    frames = [model.frame_names.index(name) for name in oracle.bodies[1:]]
    bodies = np.concatenate([np.asarray(poses), np.eye(4)[None]])[np.array(model.topology.frame_bodies)[frames]]
    # Bodies that no joint moves are welded to the world, 0, or to a mocap body, which is fixed here.
    carriers = oracle.m.body_weldid
    moving = oracle.m.body_mass[(carriers != 0) & (oracle.m.body_mocapid[carriers] < 0)]
    errors = {"mass": error(np.sum(np.asarray(model.inertias)[:, 0]), moving.sum())}
    errors |= {"frames": error(bodies @ np.asarray(model.frame_poses)[frames], oracle.body_poses())}
    theirs["passive"] = oracle.passive_force(q, v)
    if drives is not None:
        given = dict(zip(drives.names, control, strict=True))
        theirs["actuation"], theirs["activation"] = oracle.actuation(
            q, v, given, [] if activation is None else activation
        )
    # A bias of nothing but rounding, of a hinge that is upright, is compared with forces of a thousandth of M.
    floors = {"bias": 1e-3 * np.abs(theirs["M"]).max(initial=0.0)}
    errors |= {name: error(value, theirs[name], floors.get(name, 0.0)) for name, value in computed.items()}
    if rows is not None:
        errors["rows"] = error(row_space(rows), row_space(oracle.equality_rows(start)[0]))
    return errors
