"""Loops over the bodies: against the matrix form and Pinocchio on joints of every kind, and on chains of hundreds of links."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import assert_close, quick, random_states, random_tree, to_pinocchio

from jaxdyn.dynamics import quantities as dynamics
from jaxdyn.dynamics import scans, tree_frames, world_frame
from jaxdyn.model.robots import chain as planar_chain
from jaxdyn.model.robots import random_tree as chain

pytestmark = pytest.mark.native

KINDS = ("free", "revolute", "spherical", "helical", "planar", "prismatic")


@pytest.mark.long
def test_joints_of_every_kind():
    model = random_tree(3, KINDS, parents=(-1, 0, 1, 0, -1, 4))
    q, v, a, tau, _ = random_states(model, 3, 0)

    def both(q, v, a, tau):
        ours = scans.inverse_dynamics(model, q, v, a), scans.forward_dynamics(model, q, v, tau)
        return ours, (world_frame.inverse_dynamics(model, q, v, a), world_frame.forward_dynamics(model, q, v, tau))

    for x, y in zip(*quick(jax.vmap(both))(q, v, a, tau), strict=True):
        assert_close(x, y, 1e-11)


@pytest.mark.slow
def test_derivatives():
    model = random_tree(3, ("revolute", "spherical", "prismatic"), parents=(-1, 0, 0))
    q, v, _, tau, _ = (x[0] for x in random_states(model, 1, 1))

    steps = tuple(jnp.asarray(x) for x in (np.ones(5), np.arange(5.0), np.cos(np.arange(30.0)).reshape(3, 10)))

    def of(form):
        def value(v, tau, inertias):
            here = model.replace(inertias=inertias)
            a = form.forward_dynamics(here, q, v, tau)
            return jnp.sum(jnp.sin(a)) + jnp.sum(form.inverse_dynamics(here, q, v, a + tau) ** 2)

        at = v, tau, model.inertias
        return jax.grad(value, (0, 1, 2))(*at), jax.jvp(value, at, steps)

    computed, want = quick(lambda: (of(scans), of(world_frame)))()
    for x, y in zip(jax.tree.leaves(computed), jax.tree.leaves(want), strict=True):
        assert_close(x, y, 1e-9)  # M is factored in two ways


@pytest.mark.slow
@pytest.mark.parametrize("branching", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_five_hundred_links(branching):
    """A chain and a binary tree: residual at rounding, Pinocchio's accelerations, and derivatives by the implicit function."""
    model = chain(1, 500, branching=branching, skew=0.3, taper=1.0, kinds=("revolute",))
    rng = np.random.default_rng(0)
    q, v, tau, step = (jnp.asarray(x) for x in rng.normal(size=(4, model.nv)) * 0.3)
    none = jnp.zeros_like(v)

    def everything():
        a, moved = jax.jvp(lambda tau: dynamics.forward_dynamics(model, q, v, tau), (tau,), (step,))
        states = (v, a), (v, none), (none, moved), (none, none)
        return a, [dynamics.inverse_dynamics(model, q, *state) for state in states]

    a, (back, bias, pushed, weight) = jax.jit(everything)()
    assert jnp.abs(back - tau).max() <= 1e-12 * jnp.abs(bias).max()
    assert_close(pushed - weight, step, 1e-9)  # the weights, 1e5 N m, cancel in the difference
    source, bridge = to_pinocchio(model)
    want = pin.aba(source, source.createData(), bridge.q_to_pinocchio(q), np.asarray(v), np.asarray(tau))
    # Both lose what the chain's mass matrix is badly conditioned.
    assert_close(a, want, 1e-8)


@pytest.mark.long
@pytest.mark.parametrize("links", [pytest.param(40, marks=pytest.mark.slow), tree_frames.MAX_BODIES + 1])
@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 40])
def test_long_chains(count, links):
    """Sweeps in native code, against the matrix form."""
    model = planar_chain(links)
    q, v, tau = (jnp.asarray(x) for x in np.random.default_rng(0).normal(size=(3, count, links)))
    run = quick(jax.vmap(lambda *state: dynamics.forward_dynamics(model, *state)))
    # One kernel for all of it.
    assert "stablehlo.while" not in run.lower(q, v, tau).as_text()
    by_matrices = quick(
        jax.vmap(lambda *x: (world_frame.forward_dynamics(model, *x), world_frame.mass_matrix(model, x[0])))
    )
    want, masses = by_matrices(q, v, tau)
    # Solving with M amplifies rounding by its condition number, which grows as the fourth power of the number of links.
    assert_close(run(q, v, tau), want, max(1e-10, 1e-15 * np.linalg.cond(masses).max()))
