"""Pieces of logs that are shared among devices: each computes with its own, and one sum over devices makes the loss of all.

Pieces do not know of each other, as samples of a batch do not. A device adds up the losses of its own pieces and their
derivatives; an iteration of a fit then exchanges one all-reduce, of as many numbers as there are unknowns.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
from jax import lax

AXIS = "pieces"


def shared_out(pieces: Any, devices: Sequence[Any] | None) -> tuple[Any, Any]:
    """Pieces along the leading axis of arrays, on as many of the devices as can have equally many, and their mesh.

    None in place of the mesh where that is one device, or `devices` is None; the pieces stay where they are then.

    **Raises:** ValueError for no device.
    """
    if devices is None:
        return pieces, None
    if not len(devices):
        raise ValueError("devices is empty; give some of jax.devices(), or None for one")
    count = len(jax.tree.leaves(pieces)[0])
    most = max(n for n in range(1, len(devices) + 1) if count % n == 0)
    if most == 1:
        return pieces, None
    mesh = jax.make_mesh((most,), (AXIS,), devices=list(devices)[:most], axis_types=(jax.sharding.AxisType.Auto,))
    return jax.device_put(pieces, jax.NamedSharding(mesh, jax.P(AXIS))), mesh


def mapped(function: Callable, mesh: Any) -> Callable:
    """`function(shared, pieces)`, whose results have the axis of the pieces, by each device for its own pieces."""
    return function if mesh is None else _by_device(function, mesh, jax.P(AXIS))


def summed(function: Callable, mesh: Any) -> Callable:
    """The sum over devices of `function(searched, known)`, which adds up what it finds for its pieces.

    `searched` and `known` are pairs of pytrees: what all devices share, and what has the axis of the pieces. Derivatives are by
    what is searched, in reverse mode and once; each device finds its own, and the sum of those that all share
    is in the same all-reduce as the sum itself.
    """
    if mesh is None:
        return function
    rows = jax.P(), jax.P(AXIS)

    def value(shared, pieces):
        return lax.psum(function((shared[0], pieces[0]), (shared[1], pieces[1])), AXIS)

    def both(shared, pieces):
        searched, known = (shared[0], pieces[0]), (shared[1], pieces[1])
        loss, slopes = jax.value_and_grad(function)(searched, known)
        loss, of_all = lax.psum((loss, slopes[0]), AXIS)
        return (loss, of_all), slopes[1]

    @eqx.filter_custom_vjp
    def total(searched, known):
        return _by_device(value, mesh, jax.P())(*zip(searched, known, strict=True))

    @total.def_fwd
    def _(perturbed, searched, known):
        (loss, of_all), of_pieces = _by_device(both, mesh, rows)(*zip(searched, known, strict=True))
        return loss, (of_all, of_pieces)

    @total.def_bwd
    def _(slopes, change, perturbed, searched, known):
        return jax.tree.map(lambda slope: change * slope, slopes)

    return total


def _by_device(function: Callable, mesh: Any, results: Any) -> Callable:
    """`function(shared, pieces)` in `jax.shard_map`."""

    def call(shared, pieces):
        arrays, rest = eqx.partition((shared, pieces), eqx.is_array)
        each = jax.shard_map(
            lambda *arrays: function(*eqx.combine(arrays, rest)),
            mesh=mesh,
            in_specs=(jax.P(), jax.P(AXIS)),
            out_specs=results,
            # Whether a value is the same on all devices is not looked at: loops of simulations begin with numbers that are.
            check_vma=False,
        )
        return each(*arrays)

    return call
