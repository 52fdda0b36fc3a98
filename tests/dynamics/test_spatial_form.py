"""Newton's and Euler's equations at the centres of mass, and wrenches in inertial axes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd


def floating_arm():
    builder = jd.ModelBuilder("arm", gravity=None)
    builder.add_body("base", joint="free", inertia=(2.0, (0.1, -0.2, 0.05), (0.3, 0.4, 0.5)))
    builder.add_body(
        "upper", "base", axis=(0, 1, 0), inertia=(1.0, (0.0, 0.1, 0.3), (0.1, 0.2, 0.15)), pose=(0.2, 0, 0)
    )
    builder.add_body("lower", "upper", "prismatic", axis=(0, 0, 1), inertia=(0.5, (0.0, 0.0, 0.2), (0.1, 0.1, 0.05)))
    return builder.build()


def state(model, seed=0):
    key = jax.random.split(jax.random.key(seed), 3)
    q = jd.integrate(model, jd.neutral(model), jax.random.normal(key[0], (model.nv,)))
    return q, *(jax.random.normal(k, (model.nv,)) for k in key[1:])


@pytest.mark.parametrize("make", (floating_arm, lambda: jd.robots.iiwa().replace(gravity=None, armature=None)))
def test_resultants_do_the_work_of_inverse_dynamics(make):
    """D'Alembert: the joints' forces are the resultants, taken by the Jacobians of the centres of mass."""
    model = make()
    q, v, a = state(model)
    form = jd.dynamics.spatial_form(model, q, v, a)
    wrenches = jnp.concatenate([form.force, form.torque], axis=1)
    computed = jd.dynamics.generalized_force(model, q, wrenches, axes="inertial")
    wanted = jd.inverse_dynamics(model, q, v, a)
    np.testing.assert_allclose(computed, wanted, atol=1e-10 * np.abs(wanted).max())
    # Half of omega . I omega and of m |pdot|^2 is the kinetic energy, whose rate is the power of the joints.
    power = jax.jvp(lambda q, v: jd.kinetic_energy(model, q, v), (q, v), (jd.configuration_rate(model, q, v), a))[1]
    np.testing.assert_allclose(wanted @ v, power, rtol=1e-10)


def test_euler_equations_of_a_free_body():
    moments, w, a = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.3, -0.2, 0.5]), jnp.array([0.1, 0.4, -0.7])
    body = jd.ModelBuilder("body", gravity=None).add_body("body", None, "spherical", (1.0, (0.0,) * 3, moments)).build()
    q = jnp.array([0.5, 0.5, -0.5, 0.5])
    form = jd.dynamics.spatial_form(body, q, w, a)
    R = jd.forward_kinematics(body, q)[0, :3, :3]
    np.testing.assert_allclose(R.T @ form.torque[0], moments * a + jnp.cross(w, moments * w), atol=1e-12)
    np.testing.assert_allclose(R.T @ form.angular_momentum[0], moments * w, atol=1e-12)
    np.testing.assert_allclose(form.inertia[0], R @ jnp.diag(moments) @ R.T, atol=1e-12)
    np.testing.assert_allclose(form.force, 0.0, atol=1e-12)


def test_derivatives_at_rest_are_finite():
    model = floating_arm()
    q, zero = jd.neutral(model), jnp.zeros(model.nv)
    for derivative in (jax.jacrev, jax.hessian):
        slopes = derivative(lambda v: jd.dynamics.spatial_form(model, q, v, zero).torque)(zero)
        assert np.isfinite(slopes).all()


def test_other_axes_are_refused():
    model = floating_arm()
    with pytest.raises(ValueError, match="axes is 'world'"):
        jd.dynamics.generalized_force(model, jd.neutral(model), jnp.zeros((model.nb, 6)), axes="world")
