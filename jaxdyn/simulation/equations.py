"""Differential equation of a run: rates of the state, the projection after a step, allowances that end a run, and outputs."""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxdyn.compile import implicit, kernel, value_and_jvp
from jaxdyn.compile.batch import rarely
from jaxdyn.compile.known import partition_tracers
from jaxdyn.constraints.assembly import residuals
from jaxdyn.constraints.redundancy import exchange_rows
from jaxdyn.constraints.selection import are_rows_poor, renew_rows
from jaxdyn.contact.forces import contact_forces
from jaxdyn.dynamics.centroidal import kinetic_energy, potential_energy
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.forces.piecewise import Pieces, fix_pieces, guards, pieces_of, values_and_levels
from jaxdyn.simulation import controls
from jaxdyn.simulation.checks import CONTACT_OUTPUTS
from jaxdyn.simulation.events import Conditions, contact_allowances, limit_allowances
from jaxdyn.simulation.methods import Method
from jaxdyn.simulation.options import Pose
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import retract, velocity_to_rate

# Entry of the state of a mechanism with redundant rows: the rows that a step keeps. Rank is decided once a step, at its start on
# the manifold: between its stages, where rows that depend on each other are open by the local error, it would change.
KEPT = "kept_rows"
# Entry of the state: the states of the scene's drives.
DRIVES = "drives"
# Entry of the state in diffrax's loop: -1 where an allowance has been negative within the last step, else 1.
WITHIN = "within_step"


def power(force, v):
    """Power of a force (nv,) or None."""
    return jnp.zeros((), v.dtype) if force is None else jnp.sum(v * force)


def equations(
    scene: Scene,
    control: controls.Control,
    method: Method,
    start: dict,
    q0,
    v0,
    t0,
    conditions: Conditions,
    terminals: tuple = (),
) -> tuple["Equations", tuple | None]:
    """Equations of a run and their arguments; `start`: entries of the control and the drives at the start (q0, v0, t0)."""
    # diffrax compiles its arguments, which hides their values. Known leaves are compiled in, the rest is `args`: flat, because
    # its continuous adjoint supports no empty tuples.
    unknown, known = partition_tracers((scene, control, method, terminals))
    args = tuple(unknown) or None
    eqs = Equations(known, len(unknown), tuple(start), conditions)
    eqs.pieces = pieces_of(scene, start, q0, v0, t0, lambda y, q, v, t: (eqs.effort(args, y, q, v, t), y.get(DRIVES)))
    return eqs, args


class Equations:
    """Functions that diffrax and the library's own loops integrate.

    They are keys of caches and hold no tracers: traced leaves of the scene, the control and the method are their `args`. If
    flags follow these, the switching functions that are positive, forces keep to the pieces in between (`fix_pieces`).
    """

    pieces: Pieces

    def __init__(self, known, count: int, added: tuple[str, ...], conditions: Conditions):
        self._known, self._count, self._added, self.conditions = known, count, added, conditions
        # diffrax and differentiation call these in many places: each is traced once for all of them.
        self.derivative, self.explicit_part, self.implicit_part = map(
            jax.jit, (self._derivative, self._explicit_part, self._implicit_part)
        )
        self.guards = jax.jit(self._guards)

    def unpack(self, args, y=None):
        """Scene with the rows that the step from y keeps, control and method."""
        args = args or ()
        scene, control, method, _ = self._known(args[: self._count])
        if y is not None and KEPT in y:
            scene = exchange_rows(scene, y[KEPT])
        if len(args) > self._count:
            scene = fix_pieces(scene, self.pieces, args[self._count])
        return scene, control, method

    def effort(self, args, y, q, v, t):
        """Torque of the control before drives and limits, (nv,) or None without a control and drives."""
        scene, control, method = self.unpack(args, y)

        def multipliers(tau):
            force = scene.applied_force(q, v, t)
            return method.multipliers(scene, q, v, t, tau if force is None else tau + force)

        tau = controls.torque(control, scene, y, q, v, t, multipliers)
        return jnp.zeros_like(v) if tau is None and DRIVES in self._added else tau

    def drive(self, args, y, q, v, t):
        """Torque behind the scene's drives and limits, (nv,) or None without any, and the rates of the drives' states."""
        tau = self.effort(args, y, q, v, t)
        if tau is None:
            return None, None
        return self.unpack(args, y)[0].drive_torque(q, v, t, tau, y.get(DRIVES))

    def torque(self, args, y, q, v, t):
        """Torque behind the scene's drives and limits, (nv,) or None without any."""
        return self.drive(args, y, q, v, t)[0]

    def generalized_force(self, args, y, q, v, t):
        """Sum of tau and the scene's forces, (nv,), or None where there are none."""
        force, tau = self.unpack(args, y)[0].applied_force(q, v, t), self.torque(args, y, q, v, t)
        return force if tau is None else tau if force is None else tau + force

    def switching(self, t, y, args):
        """Switching functions of the scene's forces, and their rounding levels."""
        scene, _, method = self.unpack(args, y)
        q, v = method.to_qv(scene, y, t)
        own = [y[DRIVES]] if DRIVES in y else []

        def values(q, v, *own):
            return guards(scene, q, v, t, self.effort(args, y, q, v, t), *own)

        return values_and_levels(values, q, v, *own)

    def _extra_rates(self, args, y, q, v, t, force):
        scene, control, method = self.unpack(args, y)
        rates = controls.rates(control, y, q, v, t, lambda: method.multipliers(scene, q, v, t, force))
        return rates | ({DRIVES: self.drive(args, y, q, v, t)[1]} if DRIVES in y else {})

    def _derivative(self, t, y, args):
        scene, _, method = self.unpack(args, y)
        q, v, in_basis = method.to_qv_and_basis(scene, y, t)
        force = self.generalized_force(args, y, q, v, t)
        rates = method.rates(scene, y, q, v, t, force, in_basis)
        if self._added:
            rates = rates | self._extra_rates(args, y, q, v, t, force)
        rates = rates | _constants(y)
        return rates | {"work": power(force, v)} if "work" in y else rates

    def _explicit_part(self, t, y, args):
        """All rates except those of the implicit part."""
        scene, _, method = self.unpack(args, y)
        q, v = method.to_qv(scene, y, t)
        rates = method.rates(scene, y, q, v, t, self.torque(args, y, q, v, t)) | {"q": jnp.zeros_like(y["q"])}
        rates = rates | _constants(y)
        # Controllers and the work see the whole force, although the rate of v has a share of it only.
        force = self.generalized_force(args, y, q, v, t) if self._added or "work" in y else None
        rates = rates | self._extra_rates(args, y, q, v, t, force)
        return rates | {"work": power(force, v)} if "work" in y else rates

    def _implicit_part(self, t, y, args):
        """Rate dq/dt = H v, and the share of the scene's forces in the rates of velocity, which are linear in them."""
        scene, _, method = self.unpack(args, y)
        q, v = method.to_qv(scene, y, t)
        rates = jax.tree.map(jnp.zeros_like, y)
        force = scene.applied_force(q, v, t)
        if force is not None:
            # Work and the entries of the control and the drives are integrated explicitly.
            by_force = {name: y[name] for name in y if name not in ("work", *self._added)}
            # Rates are affine in the force: their derivative along it is its share, without the rest.
            _, share = jax.jvp(lambda f: method.rates(scene, by_force, q, v, t, f), (jnp.zeros_like(v),), (force,))
            rates = rates | share
        return rates | {"q": velocity_to_rate(scene.system, q, v)}

    def project(self, t, y, error, args):
        """Correct the state and the error at the end of a step, and renew what is constant during the next one."""
        scene, control, method = self.unpack(args, y)
        # A step that will be rejected may be too long to be projected, so failing here does not end the run.
        end, error, is_poor = method.end_step(scene, y, t, error)
        y = method.renew(scene, end, t)
        if KEPT in y:
            is_poor = are_rows_poor(scene, retract(scene.system, y["q"]), t) if is_poor is None else is_poor
            y = rarely(is_poor, functools.partial(_renew_rows, scene, method, t), y)
        if controls.HELD in y:
            y = y | {controls.HELD: controls.sample(control, y[controls.HELD], *method.to_qv(scene, y, t), t)}
        return end, y, error

    def quality(self, t, y, args):
        """Quality of the method's basis."""
        scene, _, method = self.unpack(args, y)
        return method.quality(scene, y, t)

    def begin(self, t, y, args):
        """Data of the first variational step."""
        scene, _, method = self.unpack(args, y)
        return method.begin(scene, y, t)

    def advance(self, t0, t1, y, args, carried):
        """A variational step: state, mean velocity, what the next step needs, and whether it succeeded."""
        leaves, structure = jax.tree.flatten((t0, t1, y, carried))

        def step(args, *leaves):
            return _advance(self, args, *jax.tree.unflatten(structure, leaves))

        def tangent(args, *rest):
            *leaves, steps = rest
            results, changes = value_and_jvp(step, (args, *leaves), steps)
            return results, jax.tree.map(jnp.zeros_like, results) if changes is None else changes

        def solve(args, *leaves):
            whole: Any = kernel(_advance, static=1, derivative=False)
            return whole(self, args, *jax.tree.unflatten(structure, leaves))

        return implicit(args, tuple(leaves), solve, tangent)

    def allowances(self, args, y, q, v, t):
        """Distances of the contacts, joints and control from the conditions that end the run."""
        scene, control, method = self.unpack(args, y)
        margins = []
        if self.conditions.contacts:
            force = self.generalized_force(args, y, q, v, t)
            margins.append(contact_allowances(scene, method.multipliers(scene, q, v, t, force)))
        if self.conditions.limits:
            margins.append(limit_allowances(scene.system, q))
        if self.conditions.control:
            margins.append(control.allowance(q, v, t)[None])
        if self.conditions.terminals:
            values = self.terminal_values(args, q, v, t)
            # NaN compares with nothing, so that a run would pass it in silence.
            margins.append(jnp.where(jnp.isnan(values), -jnp.ones_like(values), values))
        return jnp.concatenate(margins)

    def terminal_values(self, args, q, v, t):
        """Values of the functions of the terminal events."""
        return jnp.stack([one.margin(q, v, t) for one in self._known((args or ())[: self._count])[3]])

    def _guards(self, t, y, args):
        scene, _, method = self.unpack(args, y)
        q, v = method.to_qv(scene, y, t)
        values = self.allowances(args, y, q, v, t)
        return values, jnp.zeros_like(values)  # allowances have the rounding in them


def _advance(eqs: Equations, args, t0, t1, y, carried):
    scene, _, method = eqs.unpack(args, y)
    return method.advance(scene, y, t0, t1, carried, functools.partial(eqs.generalized_force, args, y))


def _renew_rows(scene: Scene, method: Method, t, y: dict[str, Any]) -> dict[str, Any]:
    """The state with the rows of the next step, where the kept ones are nearly dependent.

    Rows of rounded numbers that were dropped are open by the rounding. The step after an exchange would close them, and take the
    distance for its error, which no shorter step reduces.
    """
    rows = renew_rows(scene, retract(scene.system, y["q"]), t)
    is_new, moved = jnp.any(y[KEPT] != rows), method.correct(exchange_rows(scene, rows), y, t)
    return jax.tree.map(lambda x, y: jnp.where(is_new, x, y), moved, y) | {KEPT: rows}


def _constants(y) -> dict[str, Any]:
    """Rates of what is constant during a step and renewed at its end."""
    return {name: jnp.zeros_like(y[name]) for name in (KEPT, WITHIN) if name in y}


def state_outputs(system, outputs, q, v, t) -> dict[str, Any]:
    """Outputs that depend on the state alone: the energy, and the poses of frames."""
    values: dict[str, Any] = {}
    if "energy" in outputs:
        values["energy"] = kinetic_energy(system, q, v, t) + potential_energy(system, q, t)
    frames = [one.frame for one in outputs if isinstance(one, Pose)]
    return values | {"poses": {frame: frame_pose(system, q, frame) for frame in frames}}


def at_save_point(
    scene: Scene, control: controls.Control, method: Method, eqs: Equations, args, outputs, q, v, t, of_control
) -> dict[str, Any]:
    """Outputs at one state; `of_control`: entries of the control and the drives in the state."""
    values = state_outputs(scene.system, outputs, q, v, t)
    of_force = {"power", "acceleration", "multipliers", *CONTACT_OUTPUTS} & set(outputs)
    force = eqs.generalized_force(args, of_control, q, v, t) if of_force else None
    if "power" in outputs:
        values["power"] = power(force, v)
    if "acceleration" in outputs:
        values["acceleration"] = method.acceleration(scene, q, v, t, force)
    if {"multipliers", *CONTACT_OUTPUTS} & set(outputs):
        multipliers = method.multipliers(scene, q, v, t, force)
        contacts = contact_forces(scene, multipliers) if set(CONTACT_OUTPUTS) & set(outputs) else None
        if "multipliers" in outputs:
            values["multipliers"] = multipliers
        if contacts is not None and "contact_forces" in outputs:
            values["contact_forces"] = contacts.forces
        if contacts is not None and "contact_margins" in outputs:
            values["contact_margins"] = contacts.margins
    if "constraint_residual" in outputs:
        values["constraint_residual"] = residuals(scene, q, v, t)
    if "torque" in outputs:
        tau = eqs.torque(args, of_control, q, v, t)
        values["torque"] = jnp.zeros_like(v) if tau is None else tau
    if "control_state" in outputs:
        values["control_state"] = controls.state_of(control, of_control, q, v, t)
    if "drive_state" in outputs:
        values["drive_state"] = of_control.get(DRIVES)
    return values
