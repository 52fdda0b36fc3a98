"""Mechanisms with a few measured joints: states on the constraints near a measurement, and logs of all joints."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.constraints.assembly import Assembly, assemble
from jaxdyn.constraints.base import layout, position_residual, rows
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.constraints.mobility import degrees_of_freedom
from jaxdyn.identify.logs import Log
from jaxdyn.model.arguments import Numbers, as_array, state_dtype, warn
from jaxdyn.model.names import velocity_indices
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import solve_positive
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike, displace, displacement

# Gauss-Newton steps, and the weights of constraints and of the change of all coordinates, relative to a measured one. The
# last is so small that it determines only coordinates that neither constraints nor measurements do.
_ROUNDS, _EXACT, _STAYS = 5, 1e2, 1e-8


def observation_columns(system: Any, observed: Sequence[Any]) -> tuple[int, ...]:
    """Indices in v of joints by name, or of the coordinates of a system without bodies by index.

    **Raises:** ValueError for those that do not exist.
    """
    if isinstance(system, Model):
        return tuple(int(i) for i in velocity_indices(system, observed))
    columns = tuple(observed)
    if not all(isinstance(i, int) and 0 <= i < system.nv for i in columns) or len(set(columns)) < len(columns):
        raise ValueError(
            f"{list(columns)} are no coordinates of a {type(system).__name__}; give indices below {system.nv}"
        )
    return columns  # pyright: ignore[reportReturnType]


def on_constraints(scene: Scene, q, v, t, columns: tuple[int, ...] | None) -> Assembly:
    """State on a scene's constraints nearest to (q, v).

    Nearest in the mass metric; or, where only the velocities `columns` and their coordinates were measured, by least squares of
    these, while the others change as little as the constraints allow.
    """
    if columns is None:
        return assemble(scene, q, v, t, throw=False)

    def nearer(at, _):
        step = rows(scene, at, jnp.zeros_like(v), t).A[holonomic]
        left = jnp.concatenate([-_EXACT * position_residual(scene, at, t), displacement(scene.system, at, q)[measured]])
        return displace(scene.system, at, _least_squares(step, picked, left)), None

    measured = np.array(columns)
    picked = jnp.eye(scene.nv, dtype=q.dtype)[measured]
    holonomic = np.concatenate([np.arange(place.start, place.nonholonomic) for place in layout(scene)])
    near = lax.scan(nearer, q, None, length=_ROUNDS)[0] if len(holonomic) else q
    return assemble(scene, near, nearest_velocity(scene, near, v, t, columns), t, throw=False)


def nearest_velocity(scene: Scene, q, v, t, columns: tuple[int, ...]) -> Float[Array, " nv"]:
    """Velocity (nv,) on a scene's constraints whose `columns` fit those of v by least squares."""
    picked = jnp.eye(scene.nv, dtype=q.dtype)[np.array(columns)]

    def nearer(now, _):
        here = rows(scene, q, now, t)
        left = jnp.concatenate([-_EXACT * here.velocity, (v - now)[np.array(columns)]])
        return now + _least_squares(here.A, picked, left), None

    return lax.scan(nearer, v, None, length=_ROUNDS)[0]


def _least_squares(A, picked, left):
    """Smallest change that removes the residuals of constraints and of measured coordinates."""
    both = jnp.concatenate([_EXACT * A, picked])
    return solve_positive(both.T @ both + _STAYS * jnp.eye(both.shape[1], dtype=both.dtype), both.T @ left)


def complete_log(scene: SceneLike, t: Numbers, measured: dict[Any, Any], tau: Numbers, guess: Numbers) -> Log:
    """Log of all joints of a mechanism, from the measured joints and the constraints.

    Positions of the other joints satisfy the constraints and are nearest to those of the sample before (the first to `guess`);
    velocities are the least squares of A v = b and of the measured ones. At least as many joints must be measured as the
    mechanism has degrees of freedom; with more, positions are the least squares of the measured ones on the constraints.

    **Arguments:** `scene`, with constraints; `t` (n,), s; `measured`: {joint: (q (n,), v (n,))} of joints with one degree of
    freedom,
      rad or m, by name, or by index for a system without bodies;
    `tau` (n, nv), N m or N, zero where there are no motors; `guess` (nq,): a configuration near the first one.

    **Returns:** `Log` without accelerations, in which measured joints keep their measured values. Pass the joints as
    `observed=` to `fit_parameters`, which then compares them alone.

    **Raises:** ValueError for joints that do not exist or have several degrees of freedom, wrong shapes, and for a sample at
    which the mechanism cannot be assembled (its number and time).

    Source: EQUATIONS section 6 (constraints as rows).
    """
    scene = as_scene(scene)
    system = scene.system
    if not scene.constraints:
        raise ValueError("scene has no constraints, from which the other joints could follow; pass a mechanism")
    dtype, names = state_dtype(system), list(measured)
    columns = observation_columns(system, names)
    places = [system.q_index(name) for name in names] if isinstance(system, Model) else list(columns)
    if not all(isinstance(place, int) for place in places) or len(columns) != len(names):
        raise ValueError(f"measured names {names}; name joints with one degree of freedom each")
    t = np.asarray(as_array(t, "t"), np.float64)
    motion = {name: [jnp.asarray(as_array(x, f"measured[{name!r}]", dtype)) for x in measured[name]] for name in names}
    for name, (q, v) in motion.items():
        if q.shape != t.shape or v.shape != t.shape:
            raise ValueError(f"measured[{name!r}] has shapes {q.shape} and {v.shape}; give q and v, {t.shape} each")
    positions, velocities = (jnp.stack([motion[name][i] for name in names], axis=1) for i in (0, 1))
    guess = jnp.asarray(as_array(guess, "guess", dtype))
    if guess.shape != (system.nq,):
        raise ValueError(f"guess has shape {guess.shape}, expected {(system.nq,)} = (nq,)")
    exact = isinstance(system, Model) and len(names) <= degrees_of_freedom(scene, guess)

    def follow(near, sample):
        at, rate, time = sample
        start = near.at[np.array(places)].set(at)
        v = jnp.zeros((system.nv,), dtype).at[np.array(columns)].set(rate)
        if not exact:
            nearest = on_constraints(scene, start, v, time, columns)
            return nearest.q, (nearest.q, nearest.v, nearest.result == RESULTS.successful)
        held = assemble(scene, start, None, time, hold={name: at[i] for i, name in enumerate(names)}, throw=False)
        v = nearest_velocity(scene, held.q, v, time, columns)
        return held.q, (held.q, v, held.result == RESULTS.successful)

    _, (q, v, good) = jax.jit(lambda *samples: lax.scan(follow, guess, samples))(
        positions, velocities, jnp.asarray(t, dtype)
    )
    if not bool(good.all()):
        i = int(np.argmin(np.asarray(good)))
        raise ValueError(
            f"the mechanism cannot be assembled at sample {i} (t = {t[i]:.6g} s); check measured, lengths and guess"
        )
    q, v = np.array(q), np.array(v)
    q[:, np.array(places)], v[:, np.array(columns)] = positions, velocities
    return Log(t, q, v, None, np.asarray(tau, np.float64))


def completed(scene: SceneLike, t: Numbers, measured: dict[Any, Any], tau: Numbers, guess: Numbers) -> Log:
    """Deprecated name of `complete_log`."""
    warn("jd.identify.completed is deprecated; call complete_log", DeprecationWarning)
    return complete_log(scene, t, measured, tau, guess)
