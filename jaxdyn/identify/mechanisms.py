"""Logs of mechanisms of which a few joints were measured: the rest of the motion from the constraints."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdyn.constraints.assembly import assemble
from jaxdyn.constraints.base import layout, rows
from jaxdyn.constraints.dynamics import RESULTS
from jaxdyn.constraints.mobility import degrees_of_freedom
from jaxdyn.identify.logs import Log
from jaxdyn.model.arguments import as_array, state_dtype
from jaxdyn.model.names import columns_in_v
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import as_scene
from jaxdyn.systems.system import displace

# Gauss-Newton steps of positions where more joints were measured than there are freedoms; they start a sample away.
_ROUNDS = 4


def observed_columns(system: Any, observed: Sequence[Any]) -> tuple[int, ...]:
    """Places in v of joints by name, or of the coordinates of a system without bodies by index.

    **Raises:** ValueError for those that do not exist.
    """
    if isinstance(system, Model):
        return tuple(int(i) for i in columns_in_v(system, observed))
    columns = tuple(observed)
    if not all(isinstance(i, int) and 0 <= i < system.nv for i in columns) or len(set(columns)) < len(columns):
        raise ValueError(
            f"{list(columns)} are no coordinates of a {type(system).__name__}; give indices below {system.nv}"
        )
    return columns  # pyright: ignore[reportReturnType]


def completed(scene: Any, t, measured: dict[Any, Any], tau, guess) -> Log:
    """A log of all joints of a mechanism, from those that were measured and the constraints.

    Positions of the others are those next to the ones before (the first next to `guess`) with which the constraints hold;
    velocities are the least squares of A v = b and of the measured ones. So as many joints are needed as there are freedoms, or
    more; with more, positions are the least squares of those measured, on the constraints.

    **Arguments:** `scene`, with constraints; `t` (n,), s; `measured`: {joint: (q (n,), v (n,))} of joints of one freedom,
      rad or m, by name, or by index for a system without bodies;
    `tau` (n, nv), N m or N, zero where there are no motors; `guess` (nq,): a configuration near the first one.

    **Returns:** `Log` without accelerations. Pass the joints as `observed=` to `fit_parameters`, which then compares them alone.

    **Raises:** ValueError for joints that do not exist or have several freedoms, wrong shapes, and for a sample at which the
    mechanism cannot be assembled (its number and time).

    Source: EQUATIONS section 6 (constraints as rows).
    """
    scene = as_scene(scene)
    system = scene.system
    if not scene.constraints:
        raise ValueError("scene has no constraints, from which the other joints could follow; pass a mechanism")
    dtype, names = state_dtype(system), list(measured)
    columns = observed_columns(system, names)
    places = [system.q_index(name) for name in names] if isinstance(system, Model) else list(columns)
    if not all(isinstance(place, int) for place in places) or len(columns) != len(names):
        raise ValueError(f"measured names {names}; name joints of one freedom each")
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

    picked = jnp.eye(system.nv, dtype=dtype)[np.array(columns)]
    holonomic = np.concatenate([np.arange(place.start, place.nonholonomic) for place in layout(scene)])

    def least_squares(A, b, measured):
        # The constraints' rows are exact: they count a thousand times as much as what was measured.
        return jnp.linalg.lstsq(jnp.concatenate([1e3 * A, picked]), jnp.concatenate([1e3 * b, measured]))[0]

    def follow(near, sample):
        at, rate, time = sample
        start = near.at[np.array(places)].set(at)
        hold = {name: at[i] for i, name in enumerate(names)} if exact else None
        assembly = assemble(scene, start, None, time, hold=hold, throw=False)

        def nearer(_, assembly):
            A = rows(scene, assembly.q, jnp.zeros_like(assembly.v), time).A[holonomic]
            change = least_squares(A, jnp.zeros_like(A[:, 0]), at - assembly.q[np.array(places)])
            return assemble(scene, displace(system, assembly.q, change), None, time, throw=False)

        if not exact and len(holonomic):
            assembly = lax.fori_loop(0, _ROUNDS, nearer, assembly)
        here = rows(scene, assembly.q, jnp.zeros_like(assembly.v), time)
        v = least_squares(here.A, -here.velocity, rate)
        return assembly.q, (assembly.q, v, assembly.result == RESULTS.successful)

    _, (q, v, good) = jax.jit(lambda *samples: lax.scan(follow, guess, samples))(
        positions, velocities, jnp.asarray(t, dtype)
    )
    if not bool(good.all()):
        i = int(np.argmin(np.asarray(good)))
        raise ValueError(
            f"the mechanism cannot be assembled at sample {i} (t = {t[i]:.6g} s); check measured, lengths and guess"
        )
    return Log(t, np.asarray(q), np.asarray(v), None, np.asarray(tau, np.float64))
