"""Log segments sharded over devices: each device evaluates its own segments, and one all-reduce adds up the loss.

Segments are independent, like the samples of a batch. A device adds up the losses of its own segments and their gradients; an
iteration of a fit exchanges one all-reduce of as many numbers as there are unknowns.

Linear algebra on small matrices keeps to one thread: OpenBLAS shares products and factorisations of a hundred rows among all
processors, whose threads then wait for each other: on two busy ones a search for terms took 61 s of their time instead of 4.
"""

import contextlib
import threading
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
from jax import lax
from threadpoolctl import threadpool_limits

AXIS = "segments"


def shard_blocks(pieces: Any, devices: Sequence[Any] | None) -> tuple[Any, Any]:
    """Shard segments (leading axis of arrays) over as many devices as divide their number, and make the mesh of these.

    The mesh is None for one device, or where `devices` is None; the segments then stay where they are.

    **Raises:** ValueError for no device.
    """
    if devices is None:
        return pieces, None
    if not len(devices):
        raise ValueError("devices is empty; give some of jax.devices(), or None for one")
    count = len(jax.tree.leaves(pieces)[0])
    # Shards have equal size; segments added to fill one up would count in the loss.
    most = max(n for n in range(1, len(devices) + 1) if count % n == 0)
    if most == 1:
        return pieces, None
    mesh = jax.make_mesh((most,), (AXIS,), devices=list(devices)[:most], axis_types=(jax.sharding.AxisType.Auto,))
    return jax.device_put(pieces, jax.NamedSharding(mesh, jax.P(AXIS))), mesh


def map_by_device(function: Callable, mesh: Any) -> Callable:
    """Map `function(shared, pieces)`, whose results have the axis of the segments, over the devices."""
    return function if mesh is None else _by_device(function, mesh, jax.P(AXIS))


def sum_over_devices(function: Callable, mesh: Any) -> Callable:
    """Sum over devices of `function(searched, known)`, which adds up over the segments of one device.

    `searched` and `known` are pairs of pytrees: shared by all devices, and with the axis of the segments. Derivatives are by
    `searched`, in reverse mode and of first order. Each device computes its own, and those by shared unknowns
    are in the same all-reduce as the sum itself.
    """
    if mesh is None:
        return function
    rows = jax.P(), jax.P(AXIS)

    def value(shared, pieces):
        return lax.psum(function((shared[0], pieces[0]), (shared[1], pieces[1])), AXIS)

    def both(shared, pieces):
        searched, known = (shared[0], pieces[0]), (shared[1], pieces[1])
        loss, gradients = jax.value_and_grad(function)(searched, known)
        loss, of_all = lax.psum((loss, gradients[0]), AXIS)
        return (loss, of_all), gradients[1]

    @eqx.filter_custom_vjp
    def total(searched, known):
        return _by_device(value, mesh, jax.P())(*zip(searched, known, strict=True))

    @total.def_fwd
    def _(perturbed, searched, known):
        (loss, of_all), of_pieces = _by_device(both, mesh, rows)(*zip(searched, known, strict=True))
        return loss, (of_all, of_pieces)

    @total.def_bwd
    def _(gradients, change, perturbed, searched, known):
        return jax.tree.map(lambda gradient: change * gradient, gradients)

    return total


def _by_device(function: Callable, mesh: Any, results: Any) -> Callable:
    """Wrap `function(shared, pieces)` in `jax.shard_map`."""

    def call(shared, pieces):
        # shard_map accepts arrays only; functions and settings pass through the closure.
        arrays, rest = eqx.partition((shared, pieces), eqx.is_array)
        each = jax.shard_map(
            lambda *arrays: function(*eqx.combine(arrays, rest)),
            mesh=mesh,
            in_specs=(jax.P(), jax.P(AXIS)),
            out_specs=results,
            # The check that values agree on all devices refuses loops of simulations, which start from constants.
            check_vma=False,
        )
        return each(*arrays)

    return call


class _OneThread(contextlib.ContextDecorator):
    """Decorator of functions while which numpy's and scipy's linear algebra keeps to one thread."""

    # The limit is one of the process. Of calls that overlap, in several threads, the first one sets it and the last one lifts it:
    # each for itself would take the limit of another one for the user's.
    lock, running = threading.Lock(), 0
    limit: Any = None

    def __enter__(self):
        with self.lock:
            if not self.running:
                self.limit = threadpool_limits(limits=1, user_api="blas")
            self.running += 1

    def __exit__(self, *_):
        with self.lock:
            self.running -= 1
            if not self.running:
                self.limit.restore_original_limits()


on_one_thread = _OneThread()
