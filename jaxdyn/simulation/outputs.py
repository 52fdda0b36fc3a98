"""Outputs of a run at its save points, computed only if they are requested."""

from typing import Any

import jax.numpy as jnp

from jaxdyn.constraints.assembly import residuals
from jaxdyn.contact.forces import contact_forces
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.dynamics.quantities import kinetic_energy, potential_energy
from jaxdyn.simulation import controls
from jaxdyn.simulation.checks import CONTACT_OUTPUTS, POSE
from jaxdyn.simulation.equations import DRIVES, Equations, power
from jaxdyn.simulation.methods import Method
from jaxdyn.systems.scene import Scene


def state_outputs(system, outputs, q, v, t) -> dict[str, Any]:
    """Outputs that depend on the state alone: the energy, and the poses of frames."""
    values: dict[str, Any] = {}
    if "energy" in outputs:
        values["energy"] = kinetic_energy(system, q, v, t) + potential_energy(system, q, t)
    frames = [name.removeprefix(POSE) for name in outputs if name.startswith(POSE)]
    return values | {"poses": {frame: frame_pose(system, q, frame) for frame in frames}}


def at_save_point(
    scene: Scene, control: Any, method: Method, eqs: Equations, args, outputs, q, v, t, of_control
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
