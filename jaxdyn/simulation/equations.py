"""The differential equation of a run: rates of the state, the projection after a step, and the margins that end a run.

Functions of a run hold no arrays: what is traced of scene, control and method goes through `args`.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp

from jaxdyn.compile.known import partition_tracers
from jaxdyn.constraints.redundancy import exchange_rows
from jaxdyn.constraints.selection import renew_rows
from jaxdyn.forces.piecewise import Pieces, fix_pieces, guards, pieces_of, values_and_levels
from jaxdyn.simulation import contacts as unilateral
from jaxdyn.simulation import controls
from jaxdyn.simulation import limits as joint_limits
from jaxdyn.simulation.methods import Method, Projected
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import retract, velocity_to_rate

# Entry of the state: which rows a step keeps, of a mechanism with rows that repeat others.
KEPT = "kept_rows"
# Entry of the state: the states of the scene's drives.
DRIVES = "drives"


class Equations(NamedTuple):
    """What diffrax and our own loops integrate.

    - `args`: what is traced. `derivative(t, y, args)`, and its two parts for solvers that split it.
    - `torque(args, y, q, v, t)` of the control and `generalized_force`, which is that plus the scene's forces, (nv,) or None.
    - `project(t, y, error, args)` after a step; `quality` of the method's basis; `begin`, `advance` for steps of its own.
    - `pieces`: the switching functions of the scene's forces, and switching(t, y, args) -> their values and rounding levels.
      With which of them are positive behind the other `args`, forces keep to these pieces (`with_pieces`).
    - `allowances(args, y, q, v, t)` of contacts, joints and the control, which can end the run;
      `least_allowance(t, y, args)`, or None where nothing can.
    """

    args: tuple | None
    torque: Callable
    generalized_force: Callable
    derivative: Callable
    explicit_part: Callable
    implicit_part: Callable
    project: Callable
    quality: Callable
    begin: Callable
    advance: Callable
    pieces: Pieces
    switching: Callable
    allowances: Callable
    least_allowance: Callable | None


def with_pieces(unknown, positive) -> tuple:
    """The arguments of equations whose forces keep to pieces."""
    return (*(unknown or ()), positive)


def power(force, v):
    """Of a force (nv,) or None."""
    return jnp.zeros((), v.dtype) if force is None else jnp.sum(v * force)


def equations(scene: Scene, control: Any, method: Method, start: dict, q0, v0, t0, options: dict) -> Equations:
    """The equations of a run; `start`: what the control adds to the state, at its start (q0, v0, t0)."""
    system, added = scene.system, tuple(start)  # names alone, as functions of a run hold no arrays
    # diffrax compiles its arguments, which hides their values. What is known stays in closures, the rest is `args`:
    # flat, because its continuous adjoint takes no empty tuples.
    unknown, known = partition_tracers((scene, control, method))
    args, count = tuple(unknown) or None, len(unknown)

    def given(args, y=None):
        """The scene with the rows that the step from y keeps, the control and the method."""
        args = args or ()
        scene, control, method = known(args[:count])
        if y is not None and KEPT in y:
            scene = exchange_rows(scene, y[KEPT])
        return fix_pieces(scene, pieces, args[count]) if len(args) > count else scene, control, method

    def effort(args, y, q, v, t):
        """Of the control before limits, or None when there is none."""
        scene, control, method = given(args, y)

        def multipliers(tau):
            force = scene.applied_force(q, v, t)
            return method.multipliers(scene, q, v, t, tau if force is None else tau + force)

        tau = controls.torque(control, scene, y, q, v, t, multipliers)
        return jnp.zeros_like(v) if tau is None and DRIVES in added else tau

    def driven(args, y, q, v, t):
        """Torque behind the scene's drives and limits, or None when there is none; the rates of the drives' states."""
        tau = effort(args, y, q, v, t)
        return (None, None) if tau is None else given(args, y)[0].drive_torque(q, v, t, tau, y.get(DRIVES))

    def torque(args, y, q, v, t):
        return driven(args, y, q, v, t)[0]

    pieces = pieces_of(scene, start, q0, v0, t0, lambda y, q, v, t: (effort(args, y, q, v, t), y.get(DRIVES)))

    def switching(t, y, args):
        scene, _, method = given(args, y)
        q, v = method.to_qv(scene, y, t)

        own = [y[DRIVES]] if DRIVES in y else []
        return values_and_levels(lambda q, v, *own: guards(scene, q, v, t, effort(args, y, q, v, t), *own), q, v, *own)

    def generalized_force(args, y, q, v, t):
        """Tau plus the scene's forces, or None when there are none."""
        force, tau = given(args, y)[0].applied_force(q, v, t), torque(args, y, q, v, t)
        return force if tau is None else tau if force is None else tau + force

    def of_control(args, y, q, v, t, force):
        """Rates of what the control and the drives add to the state."""
        scene, control, method = given(args, y)
        rates = controls.rates(control, y, q, v, t, lambda: method.multipliers(scene, q, v, t, force))
        return rates | ({DRIVES: driven(args, y, q, v, t)[1]} if DRIVES in y else {})

    # diffrax and differentiation call it in many places: it is traced once for all of them.
    @jax.jit
    def derivative(t, y, args):
        scene, _, method = given(args, y)
        rates, force, v = method.evaluated(scene, y, t, functools.partial(generalized_force, args, y))
        if added:
            rates = rates | of_control(args, y, retract(system, y["q"]), v, t, force)
        if KEPT in y:
            rates = rates | {KEPT: jnp.zeros_like(y[KEPT])}
        return rates | {"work": power(force, v)} if "work" in y else rates

    @jax.jit
    def explicit_part(t, y, args):
        """All rates but those of `implicit_part`."""
        scene, _, method = given(args, y)
        q, v = method.to_qv(scene, y, t)
        rates = method.rates(scene, y, q, v, t, torque(args, y, q, v, t)) | {"q": jnp.zeros_like(y["q"])}
        rates = rates | ({KEPT: jnp.zeros_like(y[KEPT])} if KEPT in y else {})
        force = generalized_force(args, y, q, v, t) if added or "work" in y else None
        rates = rates | of_control(args, y, q, v, t, force)
        return rates | {"work": power(force, v)} if "work" in y else rates

    @jax.jit
    def implicit_part(t, y, args):
        """dq/dt = H v, and what the scene's forces add to the rates of velocity, on which they act linearly."""
        scene, _, method = given(args, y)
        q, v = method.to_qv(scene, y, t)
        rates = jax.tree.map(jnp.zeros_like, y)
        force = scene.applied_force(q, v, t)
        if force is not None:
            by_force = {name: y[name] for name in y if name not in ("work", *added)}
            _, pushed = jax.jvp(lambda f: method.rates(scene, by_force, q, v, t, f), (jnp.zeros_like(v),), (force,))
            rates = rates | pushed
        return rates | {"q": velocity_to_rate(scene.system, q, v)}

    def project(t, y, error, args):
        scene, _, method = given(args, y)
        y, error = method.stepped(scene, y, t, error)
        # A step that will be rejected may be too long to be projected, so failing here does not end the run.
        y = method.continued(scene, y, t)
        if KEPT in y:
            y = y | {KEPT: renew_rows(scene, retract(system, y["q"]), t, isinstance(method, Projected))}
        if controls.HELD in y:
            y = y | {
                controls.HELD: controls.sampled(given(args, y)[1], y[controls.HELD], *method.to_qv(scene, y, t), t)
            }
        return y, error, diffrax.RESULTS.successful

    def quality(t, y, args, **_):
        scene, _, method = given(args, y)
        return method.quality(scene, y, t)

    def begin(t, y, args):
        scene, _, method = given(args, y)
        return method.begin(scene, y, t)

    by_contacts, by_control = unilateral.can_end(scene, options["contacts"]), options["control_ends"]

    def allowances(args, y, q, v, t):
        """How far the contacts are from being lost, the joints from their limits, and the control from where it ends."""
        scene, control, method = given(args, y)
        margins = []
        if by_contacts:
            margins.append(
                unilateral.allowances(scene, method.multipliers(scene, q, v, t, generalized_force(args, y, q, v, t)))
            )
        if options["limits"] == "stop":
            margins.append(joint_limits.limit_margins(scene.system, q))
        if by_control:
            margins.append(control.allowance(q, v, t)[None])
        return jnp.concatenate(margins)

    @jax.jit
    def least_allowance(t, y, args):
        scene, _, method = given(args, y)
        q, v = method.to_qv(scene, y, t)
        return jnp.min(allowances(args, y, q, v, t))

    @jax.jit
    def advance(t0, t1, y, args, carried):
        scene, _, method = given(args, y)
        return method.advance(scene, y, t0, t1, carried, functools.partial(generalized_force, args, y))

    has_margins = by_contacts or by_control or options["limits"] == "stop"
    return Equations(
        args, torque, generalized_force, derivative, explicit_part, implicit_part, project, quality, begin, advance, pieces,
        switching, allowances, least_allowance if has_margins else None,
    )  # fmt: skip
