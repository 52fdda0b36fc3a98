"""The recursions over the tree, body by body, in single numbers: RNEA, CRBA, ABA and the square root of M.

Link frames as in EQUATIONS sections 4 and 5, for trees and joints of any kind. Two choices make them fast in batches:

- The recursion runs in *canonical* frames, turned so that a screw joint's axis is z. Transforms between bodies then are full
  of zeros and ones, which are left out (see `_scalar`). Zeros are read off leaves whose values are known while tracing; leaves
  that are traced (differentiated, batched or passed through `jit`) count as general numbers, so nothing can go stale.
- Values with several consumers are computed once (see `_materialize`).

Under `jax.vmap` every number is a vector over the batch. This module and `matrix_form` check each other: neither imports the
other.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn._articulated import (
    armatures_of,
    factorize,
    inertia_times,
    inertia_to_parent,
    keep_inertia,
    rigid_inertia,
    solve,
)
from jaxdyn._links import (
    canonical_bodies,
    combine,
    keep,
    numbers,
    place_joints,
    power,
    split,
    stack,
    wrench_to_parent,
)
from jaxdyn._materialize import materialize
from jaxdyn._scalar import ZERO3, add, apply, cross, dot, scale, symmetric_rows, transpose, vadd, vanishes, vsub
from jaxdyn._tracing import is_concrete
from jaxdyn.model import Model, check_shapes


def body_wrenches(model: Model, bodies, moves, v, a=None):
    """Wrench that each body's motion needs, gravity included: the outward pass of Newton-Euler (EQUATIONS section 4).

    Linear accelerations are those of the frame's origin as a point (not of the spatial velocity), so that the velocity of
    the origin is never needed. `a=None` stands for zero joint accelerations and costs nothing.
    """
    topology = model.topology
    gravity = ZERO3 if model.gravity is None else numbers(
        np.asarray(model.gravity) if is_concrete(model.gravity) else model.gravity, is_concrete(model.gravity)
    )  # fmt: skip
    speeds = split(v, topology.v_slices) if v is not None else None
    rates = split(a, topology.v_slices) if a is not None else None
    spin, swirl, lift, wrenches = [], [], [], []
    for i, (parent, moved, body) in enumerate(zip(topology.parents, moves, bodies, strict=True)):
        down = transpose(moved.rotation)
        w_parent, dw_parent, acc_parent = (
            (spin[parent], swirl[parent], lift[parent]) if parent >= 0 else (ZERO3, ZERO3, scale(-1, gravity))
        )
        carried = apply(down, w_parent)
        # Centripetal and Euler terms at the child's origin: w x (w x r) + dw x r.
        r = moved.shift
        inward = cross(w_parent, cross(w_parent, r))
        acc = vadd(acc_parent, cross(dw_parent, r), inward)
        acc = apply(down, acc if vanishes(inward) else keep(acc))
        dw = apply(down, dw_parent)
        w = carried
        if speeds is not None:
            v_rel, w_rel = combine(moved.columns, speeds[i])
            w = vadd(w, w_rel)
            dw = vadd(dw, cross(carried, w_rel))
            acc = vadd(acc, scale(2, cross(carried, v_rel)), cross(w_rel, v_rel))
        if rates is not None:
            dv_rel, dw_rel = combine(moved.columns, rates[i])
            dw, acc = vadd(dw, dw_rel), vadd(acc, dv_rel)
        flat = materialize(*w, *dw, *acc)
        w, dw, acc = tuple(flat[:3]), tuple(flat[3:6]), tuple(flat[6:])
        h = body.first
        force = vadd(scale(body.mass, acc), cross(dw, h), vsub(scale(dot(w, h), w), scale(dot(w, w), h)))
        rows = symmetric_rows(body.inertia)
        moment = vadd(apply(rows, dw), cross(w, apply(rows, w)), cross(h, acc))
        spin.append(w)
        swirl.append(dw)
        lift.append(acc)
        wrenches.append((force, moment))
    return wrenches


def joint_forces(model: Model, moves, wrenches):
    """Inward pass: tau_i = S_i^T (sum of the wrenches of the bodies that joint i carries)."""
    total = list(wrenches)
    tau: list = [None] * model.nb
    for i in reversed(range(model.nb)):
        flat = materialize(*total[i][0], *total[i][1])
        total[i] = (tuple(flat[:3]), tuple(flat[3:]))
        tau[i] = [power(column, total[i]) for column in moves[i].columns]
        parent = model.topology.parents[i]
        if parent >= 0:
            force, moment = wrench_to_parent(moves[i], total[i])
            total[parent] = (vadd(total[parent][0], force), vadd(total[parent][1], moment))
    return tau


def rnea(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], a: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Inverse dynamics tau = M a + C v + N by the recursive Newton-Euler algorithm.

    **Arguments:** `q` (nq,); `v`, `a` (nv,) joint velocities and accelerations.

    **Returns:** generalised forces (nv,), N m or N. Armature included.

    Source: EQUATIONS section 4; Luh, Walker & Paul 1980.
    """
    check_shapes(model, q=q, v=v, a=a)
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    tau = joint_forces(model, moves, body_wrenches(model, bodies, moves, v, a))
    out = stack(tau, q)
    return out if model.armature is None else out + model.armature * a


def bias_force(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Bias force C v + N (nv,): `rnea` at zero acceleration, whose terms are not computed."""
    check_shapes(model, q=q, v=v)
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    return stack(joint_forces(model, moves, body_wrenches(model, bodies, moves, v)), q)


def gravity_force(model: Model, q: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """Gravity force N = +dV/dq (nv,): `rnea` at rest, whose velocity terms are not computed."""
    check_shapes(model, q=q)
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    return stack(joint_forces(model, moves, body_wrenches(model, bodies, moves, None)), q)


def aba(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], tau: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Forward dynamics a = M^-1 (tau - C v - N) by the articulated-body algorithm.

    Velocity terms are gathered outward as the wrenches that zero joint accelerations would need, so that the inward and
    outward sweeps are those of a plain M^-1 (EQUATIONS section 5 with b_i started from the bias wrench; Featherstone 2008,
    section 7.3).

    **Arguments:** `q` (nq,); `v` (nv,); `tau` (nv,) generalised forces.

    **Returns:** joint accelerations (nv,). NaN or infinite where M is singular.
    """
    check_shapes(model, q=q, v=v, tau=tau)
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    wrenches = body_wrenches(model, bodies, moves, v)
    factor = factorize(model, bodies, moves)
    return stack(solve(model, moves, factor, split(tau, model.topology.v_slices), wrenches), q)


def mass_matrix_inverse_times(model: Model, q: Float[Array, " nq"], forces: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """M(q)^-1 times a vector of generalised forces, without forming M: two sweeps over the articulated bodies."""
    check_shapes(model, q=q, forces=forces)
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    return stack(solve(model, moves, factorize(model, bodies, moves), split(forces, model.topology.v_slices)), q)


def aba_with_columns(model: Model, q, v, tau, columns):
    """Forward dynamics a (nv,) and M^-1 times `columns` (nv, k), from one factorisation of M, in O(nb k) operations."""
    a, times = _free_and_inverse(model, q, v, tau)
    return a, jax.vmap(times, 1, 1)(columns)


def aba_tangent(model: Model, q, v, tau, force_change):
    """Forward dynamics a and M^-1 times `force_change(a)` (nv,), both from one factorisation of M.

    With ID(q, v, a) = tau, a change of (model, q, v, tau) changes a by M^-1 (dtau - dID at fixed a); `force_change` returns the
    bracket. In reverse this costs one more M^-1 and one reverse pass of RNEA, instead of a reverse pass of ABA.
    """
    a, times = _free_and_inverse(model, q, v, tau)
    return a, times(force_change(a))


def _free_and_inverse(model: Model, q, v, tau):
    """Forward dynamics a (nv,) and the function f -> M^-1 f, from one factorisation of M."""
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    wrenches = body_wrenches(model, bodies, moves, v)
    factor = factorize(model, bodies, moves)
    slices = model.topology.v_slices
    a = stack(solve(model, moves, factor, split(tau, slices), wrenches), q)
    return a, lambda force: stack(solve(model, moves, factor, split(force, slices)), q)


def crba(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    """Mass matrix M(q) (nv, nv) by the composite-rigid-body algorithm, armature included.

    Entries between joints on different branches are zeros that are never computed.

    Source: Featherstone 2008, table 6.2.
    """
    check_shapes(model, q=q)
    topology = model.topology
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    total: list = [rigid_inertia(body) for body in bodies]
    entries: dict = {}
    armatures = armatures_of(model)
    for i in reversed(range(model.nb)):
        parent = topology.parents[i]
        if parent >= 0:
            up = inertia_to_parent(moves[i], total[i])
            old = total[parent]
            total[parent] = keep_inertia(
                (
                    vadd(old[0], up[0]),
                    tuple(vadd(x, y) for x, y in zip(old[1], up[1], strict=True)),
                    vadd(old[2], up[2]),
                )
            )
        start = topology.v_slices[i].start
        for j, column in enumerate(moves[i].columns):
            force = inertia_times(total[i], column)
            for k, other in enumerate(moves[i].columns[: j + 1]):
                extra = armatures[i][j] if k == j else 0
                entries[start + j, start + k] = add(power(other, force), extra)
            at = i
            while topology.parents[at] >= 0:
                flat = materialize(*force[0], *force[1])
                force = wrench_to_parent(moves[at], (tuple(flat[:3]), tuple(flat[3:])))
                at = topology.parents[at]
                for k, other in enumerate(moves[at].columns):
                    entries[start + j, topology.v_slices[at].start + k] = power(other, force)
    return _square(entries, model.nv, q, symmetric=True)


def _square(entries: dict, n: int, like, symmetric: bool):
    """Matrix (n, n) from a dictionary of its nonzero entries."""
    places = list(entries)
    values = stack([[entries[place]] for place in places], like)
    rows, columns = (np.array([place[k] for place in places], int) for k in (0, 1))
    matrix = jnp.zeros((n, n), like.dtype).at[rows, columns].set(values)
    return matrix.at[columns, rows].set(values) if symmetric else matrix


def mass_matrix_sqrt(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    """Square root W (nv, nv) of the mass matrix, M = W W^T, from the articulated bodies; no Cholesky factorisation.

    W = xi^T G^T Mh xi D^(-1/2): column k holds, for joint k and its ancestors, the force that U_k / sqrt(D_k) needs. Upper
    triangular for a chain (within a joint of several degrees of freedom, lower triangular). det M = prod W_kk^2.

    Source: EQUATIONS section 5; Rodriguez, Jain & Kreutz-Delgado 1992.
    """
    check_shapes(model, q=q)
    topology = model.topology
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    factor = factorize(model, bodies, moves)
    entries: dict = {}
    for i in range(model.nb):
        start = topology.v_slices[i].start
        for j in range(len(moves[i].columns)):
            root = materialize(1 / jnp.sqrt(factor.inverses[i][j]))[0]
            gain = factor.gains[i][j]
            force = (scale(root, gain[0]), scale(root, gain[1]))
            entries[start + j, start + j] = root
            for k in range(j + 1, len(moves[i].columns)):
                entries[start + k, start + j] = power(moves[i].columns[k], force)
            at = i
            while topology.parents[at] >= 0:
                flat = materialize(*force[0], *force[1])
                force = wrench_to_parent(moves[at], (tuple(flat[:3]), tuple(flat[3:])))
                at = topology.parents[at]
                for k, other in enumerate(moves[at].columns):
                    entries[topology.v_slices[at].start + k, start + j] = power(other, force)
    return _square(entries, model.nv, q, symmetric=False)
