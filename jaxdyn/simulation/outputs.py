"""What a run gives back beside the motion: the outputs that were asked for, computed at the save points."""

from typing import Any

import jax.numpy as jnp

from jaxdyn.constraints.assembly import residuals
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.dynamics.quantities import kinetic_energy, potential_energy
from jaxdyn.model.names import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.simulation import contacts as unilateral
from jaxdyn.simulation import controls
from jaxdyn.simulation.equations import DRIVES, Equations, power
from jaxdyn.simulation.methods import Method
from jaxdyn.systems.scene import Scene

_OUTPUTS = (
    "energy",
    "power",
    "work",
    "acceleration",
    "multipliers",
    "constraint_residual",
    "torque",
    "control_state",
    "drive_state",
    *unilateral.OUTPUTS,
)
_POSE = "pose:"


def checked_outputs(scene: Scene, outputs) -> tuple[str, ...]:
    """The names in order, each once.

    **Raises:** ValueError for names that are none of the outputs, and for frames that do not exist.
    """
    if isinstance(outputs, str):
        raise ValueError(f"outputs is the string {outputs!r}; pass a tuple, e.g. outputs=({outputs!r},)")
    for name in outputs:
        if isinstance(name, str) and name.startswith(_POSE) and isinstance(scene.system, Model):
            frame_index(scene.system, name.removeprefix(_POSE))
        elif name not in _OUTPUTS:
            raise ValueError(f"outputs has {name!r}; choose from {', '.join(_OUTPUTS)} and '{_POSE}<frame>'")
    return tuple(sorted(set(outputs)))


def at_save_point(
    scene: Scene, control: Any, method: Method, eqs: Equations, outputs, q, v, t, of_control
) -> dict[str, Any]:
    """The outputs at one state; `of_control`: what the control adds to the state."""
    system, values = scene.system, {}
    pushed = {"power", "acceleration", "multipliers", *unilateral.OUTPUTS} & set(outputs)
    force = eqs.generalized_force(eqs.args, of_control, q, v, t) if pushed else None
    if "energy" in outputs:
        values["energy"] = kinetic_energy(system, q, v, t) + potential_energy(system, q, t)
    if "power" in outputs:
        values["power"] = power(force, v)
    if "acceleration" in outputs:
        values["acceleration"] = method.acceleration(scene, q, v, t, force)
    if {"multipliers", *unilateral.OUTPUTS} & set(outputs):
        multipliers = method.multipliers(scene, q, v, t, force)
        values |= {"multipliers": multipliers} if "multipliers" in outputs else {}
        values |= unilateral.reported(scene, multipliers, outputs)
    if "constraint_residual" in outputs:
        values["constraint_residual"] = residuals(scene, q, v, t)
    if "torque" in outputs:
        tau = eqs.torque(eqs.args, of_control, q, v, t)
        values["torque"] = jnp.zeros_like(v) if tau is None else tau
    if "control_state" in outputs:
        values["control_state"] = controls.state_of(control, of_control, q, v, t)
    if "drive_state" in outputs:
        values["drive_state"] = of_control.get(DRIVES)
    frames = [name.removeprefix(_POSE) for name in outputs if name.startswith(_POSE)]
    return values | {"poses": {frame: frame_pose(system, q, frame) for frame in frames}}
