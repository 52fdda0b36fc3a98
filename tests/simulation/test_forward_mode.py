"""Derivatives of runs and steps in a mode that their adjoint does not have: refused with the option that allows it."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd

TS = jnp.linspace(0.0, 0.1, 3)
Q = jnp.array([0.3, -0.2])


def simulated(q, **options):
    return jd.simulate(jd.scenes.double_pendulum(), q, jnp.zeros(2), TS, **options).q[-1]


def stepped(q, **options):
    return jd.stepper(jd.scenes.double_pendulum(), 0.01, substeps=2, **options)((q, jnp.zeros(2)), jnp.zeros(2))[0]


def stiffly(q, **options):
    return simulated(q, solver=jd.solvers.Rodas5P(), **options)


@pytest.mark.long
@pytest.mark.parametrize("function", [simulated, stepped, stiffly])
def test_forward_mode_names_its_option(function):
    """Under jit and outside, and for a single direction; the option gives the Jacobian of reverse mode."""
    for derivative in (jax.jacfwd(function), jax.jit(jax.jacfwd(function)), lambda q: jax.jvp(function, (q,), (q,))):
        with pytest.raises(ValueError, match='needs adjoint="forward"'):
            derivative(Q)
    by_rows = jax.jit(jax.jacrev(function))(Q)
    np.testing.assert_allclose(
        jax.jit(jax.jacfwd(lambda q: function(q, adjoint="forward")))(Q), by_rows, rtol=1e-9, atol=1e-12
    )


@pytest.mark.long
def test_methods_with_first_derivatives_alone_name_what_gives_second_ones():
    def end(q, **options):
        options = {"method": "variational", "stepsize": jd.simulation.Steps(0.02, max_steps=8)} | options
        return jd.simulate(jd.scenes.double_pendulum(), q, jnp.zeros(2), TS, **options).q[-1].sum()

    def implicit(q):
        return end(q, method="auto", solver=diffrax.Kvaerno3(), stepsize=0.02)

    for derivative in (jax.jacfwd(end), jax.hessian(end), jax.hessian(implicit)):
        with pytest.raises(ValueError, match='Hessians need adjoint="direct"'):
            derivative(Q)
    twice = jax.jit(jax.jacfwd(jax.jacfwd(lambda q: end(q, adjoint="forward"))))(Q)
    hessian = jax.jit(jax.hessian(lambda q: end(q, adjoint="direct")))(Q)
    np.testing.assert_allclose(hessian, twice, rtol=1e-9, atol=1e-12)
    gradient = jax.jit(jax.grad(end))
    differences = [(gradient(Q + step) - gradient(Q - step)) / 2e-5 for step in 1e-5 * np.eye(2)]
    np.testing.assert_allclose(hessian, differences, rtol=0, atol=1e-8)  # of the differences


@pytest.mark.long
@pytest.mark.parametrize(
    "options",
    [{"solver": diffrax.Kvaerno3()}, {"method": "variational", "stepsize": jd.simulation.Steps(0.05, max_steps=4)}],
)
def test_reverse_mode_names_its_option(options):
    """Through loops of diffrax; what does not depend on the run is differentiated, and forward mode is as without the mark."""

    def end(q, adjoint="forward"):
        return simulated(q, adjoint=adjoint, **options).sum()

    for derivative, q in (
        (jax.grad(end), Q),
        (jax.jit(jax.vmap(jax.grad(end))), jnp.stack([Q, -Q])),
    ):
        with pytest.raises(ValueError, match='needs adjoint="reverse"'):
            derivative(q)
    # Forward over reverse mode: JAX 0.10 fails before it comes to the mark.
    error = (TypeError, "NoneType") if jax.__version_info__ < (0, 11) else (ValueError, 'needs adjoint="reverse"')
    with pytest.raises(error[0], match=error[1]):
        jax.hessian(end)(Q)
    apart = jax.grad(lambda q: end(jax.lax.stop_gradient(q)) + q.sum())(Q)
    np.testing.assert_array_equal(apart, 1.0)
    by_rows = jax.jit(jax.grad(lambda q: end(q, "reverse")))(Q)
    # Adaptive steps of two programs differ by the rounding of error estimates.
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(Q), by_rows, rtol=1e-7)
