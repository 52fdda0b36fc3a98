"""Reverse mode through the steps of the driver: the witness is diffrax's own loop with its `DirectAdjoint`."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick

import jaxdyn as jd
from jaxdyn.simulation import motion
from jaxdyn.simulation.solvers import reverse

pytestmark = pytest.mark.native

MODEL = jd.ModelBuilder("two links")
MODEL.add_body("upper", None, "revolute", (1.0, (0.4, 0.0, 0.0), (0.02, 0.05, 0.05)), axis=(0, 1, 0))
MODEL.add_body(
    "lower", "upper", "revolute", (0.7, (0.3, 0.0, 0.1), (0.01, 0.03, 0.03)), axis=(1, 0, 0), pose=(0.8, 0, 0)
)
MODEL = MODEL.build()
Q, V = jnp.asarray([0.3, -0.8]), jnp.asarray([1.5, -0.4])
# Several in one step, one where a step ends, the last one off the grid of steps of 0.05.
TS = jnp.asarray([0.0, 0.01, 0.02, 0.045, 0.05, 0.17, 0.31, 0.333])
WEIGHTS = np.cos(np.arange(2 * TS.size)).reshape(TS.size, 2)


def torque(gain, q, v, t):
    return -gain * v + jnp.asarray([jnp.sin(5 * t), 0.2])


def weighted(q, v, gain, ts, **options):
    control = jax.tree_util.Partial(torque, gain)
    moved = jd.simulate(MODEL, q, v, ts, control=control, **options)
    return jnp.sum(WEIGHTS * moved.q) + jnp.sum(WEIGHTS[::-1] * moved.v)


def gradients(adjoint, jit=jax.jit, **options):
    gradient = jax.grad(weighted, (0, 1, 2, 3))
    call = jit(lambda *args: gradient(*args, adjoint=adjoint, **options))
    return call(Q, V, jnp.asarray(0.3), TS)


@pytest.mark.long
@pytest.mark.parametrize(
    "options",
    [
        {"stepsize": jd.simulation.Steps(0.05, max_steps=16)},
        pytest.param(
            {"stepsize": jd.simulation.Steps(rtol=1e-6, atol=1e-6, max_steps=64), "solver": diffrax.Tsit5()},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["fixed", "adaptive"],
)
def test_derivatives_are_those_of_diffrax(options, monkeypatch):
    own, replay = gradients("reverse", **options), gradients("direct", quick, **options)
    with monkeypatch.context() as patch:
        patch.setattr(motion, "choose_loop", lambda *_: ("diffrax", "for comparison"))
        peer = gradients("direct", quick, **options)
    for x, y, z in zip(own, replay, peer, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(x, z, rtol=1e-11, atol=1e-11)
    if options["stepsize"].size is None:
        return
    monkeypatch.setattr(reverse, "KEPT", 5)  # so that steps between are taken again
    for x, y in zip(gradients("reverse", **options), own, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_derivatives_without_kernels():
    options = {"stepsize": jd.simulation.Steps(0.05, max_steps=16)}
    own = gradients("reverse", **options)
    with jd.compilation("plain"):
        plain = gradients("reverse", **options)
    for x, y in zip(own, plain, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-11)


@pytest.mark.long
def test_a_bad_lane_leaves_the_others_alone():
    gradient = jax.jit(jax.vmap(jax.grad(lambda q, v: weighted(q, v, 0.3, TS, stepsize=0.05, throw=False))))
    q = jnp.stack([Q, Q.at[0].set(jnp.nan), Q + 0.1])
    computed = gradient(q, jnp.broadcast_to(V, q.shape))
    assert np.isfinite(computed[::2]).all()
    alone = gradient(q[::2], jnp.broadcast_to(V, (2, 2)))
    np.testing.assert_allclose(computed[::2], alone, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["projected", pytest.param("reduced", marks=pytest.mark.slow)])
def test_derivatives_of_constrained_motions(method):
    """Of a rolling disk, in what it starts with and in its mass, forward and reverse."""
    scene, start = jd.scenes.rolling_disk(), jd.scenes.rolling_disk.start()
    q, v = start[:2]
    ts = jnp.linspace(0.0, 0.2, 5)
    reference = jd.reduction.tangent_basis(scene, q)
    chosen = jd.Reduced(reference) if method == "reduced" else method

    def end(v, adjoint):
        moved = jd.simulate(scene, q, v, ts, method=chosen, stepsize=0.02, adjoint=adjoint, throw=False)
        return jnp.sin(moved.q[-1]).sum() + jnp.sum(moved.v[2] ** 2)

    # Along a direction that the rows allow, as others leave the constraints.
    back = jax.jit(jax.grad(lambda x: end(x * v, "reverse")))(1.0)
    forth = jax.jit(jax.jacfwd(lambda x: end(x * v, "forward")))(1.0)
    np.testing.assert_allclose(back, forth, rtol=1e-10)
