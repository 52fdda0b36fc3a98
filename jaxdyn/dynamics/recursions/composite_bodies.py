"""The mass matrix by the composite-rigid-body algorithm."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.dynamics.recursions._arrays import constants, contract, dot_transpose, join, part, select, transpose
from jaxdyn.dynamics.recursions.links import Links, joint_transforms, links_of
from jaxdyn.dynamics.recursions.transforms import Chain, moments_to_parent, wrench_to_parent
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.tree import Model


def momentum_columns(moments, S):
    """Wrenches I S (6, nj) of unit joint accelerations of a composite body with the given moments (4, 4)."""
    table = constants(moments.dtype)
    # Y = [hat(w) v] J for each column (v, w) of S, as in `rnea`.
    rates = join([contract(table.hat, part(S, 3, 6), (2,), (0,)), part(S, 0, 3).reshape(3, 1, -1)], 1)
    Y = contract(rates, moments, (1,), (0,))  # (3, nj, 4)
    return contract(table.moment, Y, (1, 2), (0, 2))


def ancestor_rows(links: Links, chains: list[Chain], i: int, columns) -> list:
    """Blocks (nj of the ancestor, k) of S^T F along the path from the parent of body i to the root, for wrenches F (6, k)."""
    pieces, at = [], i
    while links.parents[at] >= 0:
        columns = wrench_to_parent(chains[at], columns)
        at = links.parents[at]
        pieces.append((at, dot_transpose(links.subspaces[at], columns)))
    return pieces


def place_rows(links: Links, pieces: dict, width: int, dtype):
    """Assemble rows (nv, width) from blocks at their joints, zero for all other joints."""
    rows = []
    for i, place in enumerate(links.model.topology.v_slices):
        # Numpy zeros are known, so the sparsity of branches survives in the scalar program.
        rows.append(pieces[i] if i in pieces else np.zeros((place.stop - place.start, width), dtype))
    return join(rows, 0)


def crba(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    """Mass matrix M(q) (nv, nv), armature included, in kg m^2, kg m or kg by the kinds of the two joints.

    Entries between joints on different branches are zeros that are never computed.

    Source: Featherstone (2008), table 6.2.
    """
    check_shapes(model, q=q)
    links = links_of(model)
    chains = joint_transforms(links, q)
    total = list(links.moments)
    columns: list = [None] * model.nb
    for i in reversed(range(model.nb)):
        force = momentum_columns(total[i], links.subspaces[i])
        own = dot_transpose(links.subspaces[i], force)
        pieces = dict([(i, own), *ancestor_rows(links, chains, i, force)])
        columns[i] = place_rows(links, pieces, own.shape[1], q.dtype)
        if links.parents[i] >= 0:
            total[links.parents[i]] = total[links.parents[i]] + moments_to_parent(chains[i], total[i])
    if not columns:
        return jnp.zeros((0, 0), q.dtype)
    # Each column holds the entries of its joint's ancestors only: the upper triangle.
    above = join(columns, 1)
    M: Any = select(np.triu(np.ones((model.nv, model.nv), bool)), above, transpose(above))
    if links.armature is not None:
        M = M + links.armature[:, None] * np.eye(model.nv, dtype=q.dtype)
    # An M that does not depend on q is a numpy array up to here.
    return jnp.asarray(M if links.scale is None else links.scale[:, None] * M * links.scale[None, :])
