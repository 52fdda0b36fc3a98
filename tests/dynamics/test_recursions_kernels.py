"""The recursions in kernels, as users call them: accuracy on every joint kind, derivatives, and how many operations they take."""

import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import as_dtype, assert_close, quick, random_states, random_tree

import jaxdyn as jd
from jaxdyn.dynamics import world_frame as matrix_form
from jaxdyn.model.topology import KINDS

pytestmark = pytest.mark.native


def program_of(function, *args):
    """The program of the one kernel that a function is."""
    (eqn,) = (eqn for eqn in jax.make_jaxpr(function)(*args).eqns if eqn.primitive.name == "jaxdyn_kernel")
    return eqn.params["program"]


@pytest.mark.long
@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)])
def test_forward_dynamics_of_every_joint(dtype):
    """Against the world-frame matrix form, for one sample, a few and nested batches."""
    model = as_dtype(random_tree(1, list(KINDS)), dtype)
    q, v, tau = (jnp.asarray(x, dtype) for x in random_states(model, 6, seed=2)[:3])
    wanted = quick(jax.vmap(partial(matrix_form.forward_dynamics, model)))(q, v, tau)
    run, nested = partial(jd.forward_dynamics, model), [x.reshape(2, 3, -1) for x in (q, v, tau)]
    alone = quick(run)
    size = 1e-10 if dtype == jnp.float64 else 4e-4  # 5 eps times the condition number of M, at most 642
    for computed in (
        np.stack([alone(*args) for args in zip(q, v, tau, strict=True)]),
        quick(jax.vmap(run))(q, v, tau),
        quick(jax.vmap(jax.vmap(run)))(*nested).reshape(6, -1),
    ):
        assert computed.dtype == dtype
        np.testing.assert_allclose(computed, wanted, atol=size * np.abs(wanted).max(), rtol=0)


def test_inverse_dynamics_in_float32():
    model = as_dtype(random_tree(1, list(KINDS)), jnp.float32)
    q, v, a, _, _ = random_states(model, 3, 5)
    got = quick(jax.vmap(partial(jd.inverse_dynamics, model)))(q, v, a)
    assert got.dtype == jnp.float32
    wide = as_dtype(model, jnp.float64)
    exact = quick(jax.vmap(partial(matrix_form.inverse_dynamics, wide)))
    want = exact(*(jnp.asarray(x, jnp.float64) for x in (q, v, a)))
    # A dozen bodies, each a few roundings of 6e-8 on partly cancelling sums.
    assert_close(got, want, 2e-5)


@pytest.mark.long
def test_every_quantity_in_both_modes():
    """What users call, with the model known, against operations of JAX alone; the other kinds of joints are cases of these."""
    model = random_tree(5, ["free", "helical", "planar", "spherical"])
    q, v, a, tau, wrenches = (x[0] for x in random_states(model, 1, 7))

    def everything(q, v, a, tau, wrenches):
        root = jd.dynamics.mass_matrix_sqrt(model, q)
        return {
            "M": jd.mass_matrix(model, q),
            "C": jd.coriolis_matrix(model, q, v),
            "N": jd.gravity_force(model, q),
            "h": jd.bias_force(model, q, v),
            "tau": jd.inverse_dynamics(model, q, v, a, external=wrenches),
            "a": jd.forward_dynamics(model, q, v, tau, external=wrenches),
            "J^T f": jd.dynamics.generalized_force(model, q, wrenches),
            "T": jd.kinetic_energy(model, q, v),
            "V": jd.potential_energy(model, q),
            "c": jd.center_of_mass(model, q),
            "momentum": jd.dynamics.centroidal_momentum(model, q, v),
            "A": jd.dynamics.centroidal_momentum_matrix(model, q),
            "Y": jd.dynamics.torque_regressor(model, q, v, a),
            "W W^T": root @ root.T,
            "poses": jd.forward_kinematics(model, q),
        }

    computed = quick(everything)(q, v, a, tau, wrenches)
    with jd.compilation("plain"):
        wanted = quick(lambda *x: everything(*x))(q, v, a, tau, wrenches)
    for name, value in wanted.items():
        for x, y in zip(jax.tree.leaves(computed[name]), jax.tree.leaves(value), strict=True):
            assert_close(x, y, 1e-10, name)
    assert_close(computed["W W^T"], wanted["M"], 1e-11)


def test_operations_grow_with_the_number_of_bodies():
    """Linearly for the recursions, of known and of given models."""
    for given in (False, True):
        costs = []
        for n in (3, 6, 12):
            model = random_tree(6, ["revolute"] * n, parents=list(range(-1, n - 1)), armature=False)
            states = [jnp.zeros(n)] * 3
            made = (
                program_of(jd.dynamics.aba, model, *states)
                if given
                else program_of(partial(jd.dynamics.aba, model), *states)
            )
            costs.append(made.cost)
        assert costs[2] - costs[1] < 2.1 * (costs[1] - costs[0]), costs


@pytest.mark.long
def test_derivatives_of_forward_dynamics():
    """Every argument and leaf, order 2, against the matrix form and finite differences."""
    model = random_tree(9, ["spherical", "helical"])
    q, v, _, tau, _ = random_states(model, 4, 3)
    leaves = eqx.filter(model, eqx.is_array)

    def loss(leaves, q, v, tau):
        return jnp.sum(jnp.sin(jd.forward_dynamics(eqx.combine(leaves, model), q, v, tau)))

    def gradients(loss):
        return quick(jax.vmap(jax.grad(loss, (0, 1, 2, 3)), (None, 0, 0, 0)))(leaves, q, v, tau)

    batch = gradients(loss)
    with jd.compilation("plain"):
        plain = gradients(lambda *x: loss(*x))
    for name, one, other in zip(itertools.count(), jax.tree.leaves(batch), jax.tree.leaves(plain), strict=False):
        assert_close(one, other, 1e-9, f"leaf {name}")
    # Along a line through (q, v, tau): first and second derivative against five-point differences.
    rng = np.random.default_rng(1)
    step = [jnp.asarray(rng.normal(size=x.shape[1:])) for x in (q, v, tau)]
    h = 2e-4

    def along(s):
        return loss(leaves, q[0] + s * step[0], v[0] + s * step[1], tau[0] + s * step[2])

    def line(s):
        return along(s), jax.grad(along)(s), jax.jvp(jax.grad(along), (s,), (jnp.ones(()),))[1]

    value, first, second = map(np.asarray, quick(jax.vmap(line))(h * jnp.arange(-2.0, 3.0)))
    stencil = np.array([1, -8, 0, 8, -1]) / (12 * h)
    # Differences of numbers near 1 over steps of 2e-4 keep eleven digits, and leave h^4 times a fifth derivative.
    assert_close(first[2], stencil @ value, 1e-8)
    assert_close(second[2], stencil @ first, 1e-8)
