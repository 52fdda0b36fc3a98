"""Shared parts of the readers: starts, named actuators, lists of unsupported elements, bodies with several joints."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.base import Constraint
from jaxdyn.dynamics.kinematics import body_jacobian
from jaxdyn.model import host_math
from jaxdyn.model.arguments import Checked, Function, Number, Numbers, as_array, check_shapes, warn
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.topology import SCREW_KINDS
from jaxdyn.model.tree import Model
from jaxdyn.sensors import Sensor
from jaxdyn.systems.scene import DriveDynamics, Force, Scene, as_pytree


class NotTakenWarning(UserWarning):
    """Warning of elements of a file that the model does not represent; the message names them."""


class UnitsWarning(UserWarning):
    """Warning of numbers of a file that look like other units than m, kg and rad; the message names them."""


class Start(eqx.Module):
    """Named state of a file: `q` (nq,), `v` (nv,) of the model; `control` (nu,) and `activation` (na,) of its actuators.

    `control` and `activation` are None where the file gives none. Units as for the model: m, rad, m/s, rad/s.
    """

    q: Float[Array, " nq"]
    v: Float[Array, " nv"]
    control: Float[Array, " nu"] | None = None
    activation: Float[Array, " na"] | None = None


class Actuators(eqx.Module):
    r"""Named actuators: generalised forces from controls.

    An actuator acts along a length l(q) with the force

    $$f = (g_0 + g_1 l + g_2 \dot l) u + b_0 + b_1 l + b_2 \dot l.$$

    That covers motors ($f = g_0 u$), position and velocity servos, dampers and general actuators. The force is clipped to
    `force_range`, the sum of all at each coordinate to `effort_range`, the control to `control_range`.

    An actuator with dynamics has an activation w, which takes the place of u in the force: a "filter" with $T \dot w = u - w$, an
    "integrator" with $\dot w = u$. At the ends of `activation_range` w stops. `drive` makes a force of a scene of them.

    Lengths are linear in q, l = moment q, with the coordinates that have v = dq/dt; actuators at a site have no
    length (l = 0) and act with a wrench fixed in the site's frame.

    **Fields:** `names` of the actuators, in the order of the controls; `moment` (nu, nv); `gain`, `bias` (nu, 3);
    `control_range`, `force_range` (nu, 2), infinite where there are none; `effort_range` (nv, 2); `sites`, for each
    actuator the name of its frame or None; `wrenches` (nu, 6), (f, tau) in the frame's axes for a unit force; `places`,
    for each velocity coordinate its place in q, or -1 where it has none; `dynamics`, for each actuator "filter", "integrator" or
    None; of those with dynamics `time_constant` T (na,), s (unused of integrators), and `activation_range` (na, 2).
    """

    names: tuple[str, ...] = eqx.field(static=True)
    sites: tuple[str | None, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    moment: Float[Array, "nu nv"]
    wrenches: Float[Array, "nu 6"]
    gain: Float[Array, "nu 3"]
    bias: Float[Array, "nu 3"]
    control_range: Float[Array, "nu 2"]
    force_range: Float[Array, "nu 2"]
    effort_range: Float[Array, "nv 2"]
    time_constant: Float[Array, " na"] | None = None
    activation_range: Float[Array, "na 2"] | None = None
    dynamics: tuple[str | None, ...] = eqx.field(static=True, default=(), kw_only=True)

    def __call__(
        self,
        system: Model,
        q: Numbers,
        v: Numbers,
        control: Numbers,
        activation: Numbers | None = None,
    ) -> Float[Array, " nv"]:
        """Generalised force (nv,) in N m or N of the controls (nu,), in the order of `names`.

        `activation` (na,), of the actuators with dynamics; None where there are none.

        **Raises:** ValueError for controls or activations of another shape.
        """
        force, rows = self._forces(system, q, v, control, activation)
        low, high = self.effort_range.astype(rows.dtype).T
        # MuJoCo's order: clip the control, then each force, then the sum at each coordinate.
        return jnp.clip(force @ rows, low, high)

    def thrusts(
        self,
        system: Model,
        q: Numbers,
        v: Numbers,
        control: Numbers,
        activation: Numbers | None = None,
    ) -> dict[str, Float[Array, "6"]]:
        """Wrenches (f, tau) (6,) of the actuators at sites by the sites' names, at their origins and in their axes, N and N m.

        They are a part of the generalised force, and what `jd.sensors.measure` takes as `thrusts`. Arguments as of the call.

        **Raises:** ValueError for controls or activations of another shape.
        """
        force, _ = self._forces(system, q, v, control, activation)
        result: dict[str, Array] = {}
        for i, site in enumerate(self.sites):
            if site is not None:
                result[site] = result.get(site, 0.0) + force[i] * self.wrenches[i].astype(force.dtype)
        return result

    def _forces(self, system: Model, q, v, control, activation) -> tuple[Array, Array]:
        """Force of each actuator (nu,), and the rows (nu, nv) along which they act."""
        q, v = check_shapes(system, q=q, v=v)
        control = self._clip(control, q.dtype)
        if self._active:
            low, high = jnp.asarray(self.activation_range, q.dtype).T
            # An integration step may overshoot the range slightly before the rate stops.
            active = jnp.clip(jnp.asarray(self._check_activation(activation), q.dtype), low, high)
            # The force of an actuator with dynamics depends on its activation and not on the control.
            control = control.at[np.array(self._active)].set(active)
        chosen = [place for place in self.places if place >= 0]
        columns = [i for i, place in enumerate(self.places) if place >= 0]
        moment = self.moment.astype(q.dtype)
        length = moment[:, jnp.asarray(columns, int)] @ q[jnp.asarray(chosen, int)]
        rows = moment
        for i, site in enumerate(self.sites):
            if site is not None:
                # A wrench fixed in the site's frame acts by the body Jacobian; such a row depends on q.
                rows = rows.at[i].set(self.wrenches[i].astype(q.dtype) @ body_jacobian(system, q, site))
        state = jnp.stack([jnp.ones_like(length), length, rows @ v], axis=1)
        gain, bias, limits = (x.astype(q.dtype) for x in (self.gain, self.bias, self.force_range))
        force = jnp.sum(gain * state, 1) * control + jnp.sum(bias * state, 1)
        return jnp.clip(force, limits[:, 0], limits[:, 1]), rows

    def activation_rate(self, control: Numbers, activation: Numbers) -> Float[Array, " na"]:
        """Rate of the activations (na,), zero where it would lead out of their range.

        **Raises:** ValueError for controls or activations of another shape.
        """
        # Of the dtype of the activation: a float32 model under x64 integrates float32.
        activation = self._check_activation(activation)
        activation = jnp.asarray(activation, activation.dtype if eqx.is_inexact_array(activation) else float)
        if not self._active:
            return activation
        wanted = self._clip(control, activation.dtype)[np.array(self._active, int)]
        is_filter = np.array([self.dynamics[i] == "filter" for i in self._active])
        # Integrators have no time constant: a 0 in the file would divide by zero and give NaN in gradients.
        constant = jnp.where(is_filter, jnp.asarray(self.time_constant, activation.dtype), 1.0)
        rate = jnp.where(is_filter, wanted - activation, wanted) / constant
        low, high = jnp.asarray(self.activation_range, activation.dtype).T
        # Only an outward rate is stopped, so that an activation at its limit can return.
        return jnp.where((activation >= high) & (rate > 0) | (activation <= low) & (rate < 0), 0.0, rate)

    def drive(self, law: Function, activation: Numbers | None = None) -> "ActuatorDrive":
        """Force of a scene under law(q, v, t) -> (nu,) for the controls, with the activations as its state.

        `activation` (na,) at the start; zeros by default. `outputs=("drive_state",)` of `jd.simulate` are those of the motion.

        **Raises:** ValueError for a law that cannot be called, and activations of another shape.
        """
        start = np.zeros(len(self._active)) if activation is None else as_array(activation, "activation")
        initial = jnp.asarray(self._check_activation(start), float)
        return ActuatorDrive(self, as_pytree(law, "law", "q, v, t"), initial)

    @property
    def _active(self) -> list[int]:
        """Places of the actuators with dynamics among all."""
        return [i for i, kind in enumerate(self.dynamics) if kind is not None]

    def _clip(self, control, dtype) -> Array:
        control = as_array(control, "control")
        if jnp.shape(control) != (len(self.names),):
            raise ValueError(
                f"control has shape {jnp.shape(control)}, expected {(len(self.names),)}: one number for each of "
                f"{', '.join(self.names)}"
            )
        low, high = self.control_range.astype(dtype).T
        return jnp.clip(jnp.asarray(control, dtype), low, high)

    def _check_activation(self, activation):
        names = [self.names[i] for i in self._active]
        activation = activation if activation is None else as_array(activation, "activation")
        if activation is None or jnp.shape(activation) != (len(names),):
            shape = None if activation is None else jnp.shape(activation)
            raise ValueError(
                f"activation has shape {shape}, expected {(len(names),)}: one number for each of {', '.join(names)}"
            )
        return activation


class ActuatorDrive(DriveDynamics):
    """Actuators under a law of their controls, whose torques are added to the command (`Actuators.drive`)."""

    actuators: Actuators
    law: Any
    initial: Float[Array, " na"]

    def start(self, system: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, " na"]:
        """The activations at the start."""
        return self.initial.astype(q.dtype)

    def torque(
        self,
        system: Model,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " na"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " nv"]:
        """Generalised force (nv,)."""
        return command + self.actuators(system, q, v, self.law(q, v, t), state)

    def rate(
        self,
        system: Model,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " na"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " na"]:
        """Rates of the activations."""
        return self.actuators.activation_rate(self.law(q, v, t), state)


class LoadedScene(Scene):
    """Scene of a file: a `Scene` with the file's starts and actuators.

    - `system`, `constraints`, `forces`: as in `Scene`. The system is a `Model`.
    - `starts`: states by name. "reference" is the placement that the file describes; the others are its keyframes. They
      are unchanged: project them to the constraints with `jd.assemble(scene, scene.starts[name].q)`.
    - `actuators`: `Actuators`, called as `scene.actuators(scene.system, q, v, control)` to give tau (nv,); None when
      there are none.
    - `sensors`: those of the file, for `jd.sensors.measure`.
    - `not_taken`: descriptions of the file's elements that the scene does not represent, as in `NotTakenWarning`.
    """

    # Dataclass fields after `Scene`'s defaults need defaults; `__init__` sets all of them.
    starts: dict[str, Start] = eqx.field(default_factory=dict)
    actuators: Actuators | None = None
    not_taken: tuple[str, ...] = eqx.field(static=True, default=())
    sensors: tuple[Sensor, ...] = ()

    def __init__(
        self,
        system: Model,
        constraints: Checked[Sequence[Constraint]] = (),
        forces: Checked[Sequence[Force]] = (),
        *,
        starts: Mapping,
        actuators: "Actuators | None" = None,
        not_taken: Sequence[str] = (),
        sensors: Sequence[Sensor] = (),
    ):
        # `Scene.__init__` checks its arguments, and an equinox module with its own `__init__` does not call it.
        super().__init__(system, constraints, forces)
        self.starts = dict(starts)
        self.actuators = actuators
        self.not_taken = tuple(not_taken)
        self.sensors = tuple(sensors)


_NAMES = 8


class NotTaken(dict[str, dict[str, None]]):
    """Names of a file's elements that a scene does not represent, by their descriptions, each once and in their order."""

    def add(self, what: str, names: Iterable[str]) -> None:
        """Add names, if there are any."""
        for name in names:
            self.setdefault(what, {})[name] = None

    def warn(self, path) -> list[str]:
        """Entries of `not_taken`: a description and the first names; warn once with all of them."""
        lines = []
        for what, names in self.items():
            # A warning that lists hundreds of geoms hides the other entries.
            more = f" and {len(names) - _NAMES} more" * (len(names) > _NAMES)
            lines.append(f"{what}: {', '.join(list(names)[:_NAMES])}{more}" if names else what)
        if lines:
            warn(f"{path}: not taken from the file: {'; '.join(lines)}", NotTakenWarning)
        return lines


# Robot joints turn by two or three turns at most, and links are shorter than 100 m; ships and cranes may trigger the warning.
_MAX_TURNS, _LONGEST = 4.0, 100.0
# Limits from here on are none: files write 1e16, the default of SDF up to version 1.6.
UNLIMITED = 1e15


def warn_of_units(path, model: Model) -> None:
    """Warn where limits look like degrees, or positions and inertias like millimetres; nothing is changed."""
    top, doubts = model.topology, []
    lower, upper = np.asarray(model.lower), np.asarray(model.upper)
    for name, kind, place in zip(top.joint_names, top.kinds, top.q_slices, strict=True):
        ends = np.abs(np.concatenate([lower[place], upper[place]]))
        # Infinite limits and the huge numbers of files are no limits; they must not count as degrees.
        if kind == "revolute" and (ends[ends < UNLIMITED] > 2 * np.pi * _MAX_TURNS).any():
            doubts.append(f"limits {lower[place][0]:g} to {upper[place][0]:g} rad of joint {name!r} (degrees?)")
    for name, home, parameters in zip(top.body_names, np.asarray(model.home), np.asarray(model.inertias), strict=True):
        if (far := np.linalg.norm(home[:3, 3])) > _LONGEST:
            doubts.append(f"body {name!r} {far:g} m from its parent (millimetres?)")
        # sqrt(I/m) is a length whatever the mass: kg mm^2 gives a radius 1000 times too large.
        mass, _, moment = host_math.about_com(parameters)
        if mass > 0 and (radius := np.sqrt(np.abs(moment).max() / mass)) > _LONGEST:
            doubts.append(f"radius of gyration {radius:g} m of body {name!r} (inertia in kg mm^2 or g mm^2?)")
    if doubts:
        more = f"; and {len(doubts) - 5} more" if len(doubts) > 5 else ""
        text = f"{path}: numbers that look like other units than m, kg, rad: {'; '.join(doubts[:5])}{more}"
        warn(text, UnitsWarning)


# --- bodies with several joints, or with joint axes off the body origin, as chains of bodies of a `Model` ---


class Link(NamedTuple):
    """Joint of a chain: axis (3,) and anchor (3,) in the body's axes and frame, reference in rad or m."""

    name: str
    kind: str
    axis: np.ndarray
    anchor: np.ndarray
    reference: float
    leaves: dict[str, Any]
    pitch: float = 0.0


class Names(set[str]):
    """Names in use. Formats have separate namespaces of joints, bodies and sites; a model has one of frames."""

    def new(self, wanted: str) -> str:
        """Reserve a name, with underscores appended while it is taken."""
        # An appended underscore keeps the file's spelling recognisable, and the result does not depend on other names.
        while wanted in self:
            wanted += "_"
        self.add(wanted)
        return wanted


def build_model(builder: ModelBuilder, path) -> Model:
    """Build the model of a file. **Raises:** ValueError of `ModelBuilder.build`, with the file and without advice for URDF."""
    try:
        return builder.build()
    except ValueError as error:
        # The builder's advice `lock=` is for URDF files; the loaders of SDF and MJCF have no such option.
        raise ValueError(f"{path}: {re.sub(r' .of a URDF: lock=.*', '', str(error))}") from error


def add_chain(
    builder: ModelBuilder,
    frames: Names,
    joint_names: Names,
    body: str,
    parent: str | None,
    pose,
    joints: list[Link],
    inertia,
) -> None:
    """Add a body with its joints. The frame `body` is the body's own; intermediate bodies are named BODY_JOINT.

    A joint of a `Model` rotates its body about an axis through the body's origin. Formats let the axis pass anywhere, and put
    several joints between two bodies. Each joint k displaces all after it by D_k(x) = Trans(a_k) J_k(x) Trans(-a_k), with the
    anchor a_k and the axis in the axes of the body, so that the pose of the body is

        pose D_1(q_1 - r_1) D_2(q_2 - r_2) ...

    with the joints' reference positions r_k: where the body is at `pose`, q = r.

    `pose` (4, 4) is that of the body's frame in the parent's where all joints are at their references; without joints
    the body is fixed. New names are reserved in `frames` and `joint_names`, which hold those of the file.
    """
    here, carrier = np.asarray(pose, float), parent
    for k, joint in enumerate(joints):
        # Translations and free joints do not depend on the anchor.
        turns = joint.kind not in ("prismatic", "free")
        anchor = np.eye(4)
        if turns:
            # The anchor's component along the axis has no effect; dropping it avoids intermediate bodies.
            along = joint.axis * (joint.axis @ joint.anchor) if joint.kind in SCREW_KINDS else np.zeros(3)
            # The subtraction leaves rounding where the anchor lies on the axis, which would add a massless body per joint.
            shift = joint.anchor - along
            anchor[:3, 3] = np.where(np.abs(shift) > 1e-15 * np.abs(joint.anchor).max(initial=0.0), shift, 0.0)
        leaves: dict[str, Any] = dict(joint.leaves)
        home = here @ anchor
        if joint.kind in SCREW_KINDS:
            leaves |= {"axis": joint.axis, "pitch": joint.pitch}
            slide = np.zeros(3) if joint.kind != "prismatic" else joint.axis
            screw = np.concatenate([slide, joint.axis if turns else np.zeros(3)])
            if joint.reference:
                # D(x - r) = D(-r) D(x): the reference position moves into the home pose, and q keeps the file's zero.
                home = home @ host_math.joint_pose(joint.kind, screw, np.array([-joint.reference]))
        # Only the body itself carries the inertia; intermediate bodies are massless.
        last = k == len(joints) - 1 and not anchor[:3, 3].any()
        # Default joint names contain the body's name already; repeating it would give BODY_BODY_joint.
        between = joint.name if joint.name.startswith(body) else f"{body}_{joint.name}"
        name = body if last else frames.new(between)
        builder.add_body(
            name, carrier, joint.kind, inertia if last else None, joint_name=joint.name, pose=home, **leaves
        )
        if last:
            return
        # The next joint is given in the body's axes, and Trans(-a_k) of D_k comes after J_k.
        here, carrier = host_math.inverse(anchor), name
    # The last anchor is off the origin: a fixed body brings the frame back to the file's own.
    builder.add_body(body, carrier, "fixed", inertia, joint_name=joint_names.new(f"{body}_fixed"), pose=here)
