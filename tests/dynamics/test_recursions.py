"""The recursions written with arrays: against the matrix form, Pinocchio and their own identities, on every joint kind."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from jax.extend.core import jaxpr_as_fun
from pinocchio_bridge import as_dtype, assert_close, quick, random_states, random_tree, to_pinocchio

import jaxdyn
from jaxdyn import neutral
from jaxdyn.dynamics import recursions, scans
from jaxdyn.dynamics import world_frame as matrix_form
from jaxdyn.dynamics.recursions import frames
from jaxdyn.model.topology import KINDS

# Every kind, as a root, inside the tree and at its end; with and without armature.
TREES = {
    "every kind": lambda: random_tree(1, list(KINDS)),
    "floating, no armature": lambda: random_tree(
        3, ["free", "revolute", "prismatic", "helical", "spherical", "revolute"], armature=False
    ),
    "planar, no armature": lambda: random_tree(5, ["planar", "prismatic", "revolute"], armature=False),
    "screws of other norms": lambda: random_tree(6, ["helical", "revolute", "prismatic"]).replace(
        screws=1.7 * random_tree(6, ["helical", "revolute", "prismatic"]).screws
    ),
}


def run(function, *args):
    """function(*args), traced by JAX and computed operation by operation: as it is written, without a kernel."""
    jaxpr, shape = jax.make_jaxpr(function, return_shape=True)(*args)
    out = jaxpr_as_fun(jaxpr)(*jax.tree.leaves(args))
    return jax.tree.unflatten(jax.tree.structure(shape), [np.asarray(x) for x in out])


def everything(model, q, v, a, tau, wrenches):
    """All quantities at one sample."""
    again, times_inverse = recursions.acceleration_and_inverse(model, q, v, tau)
    return {
        "rnea": recursions.rnea(model, q, v, a),
        "bias": recursions.bias_force(model, q, v),
        "gravity": recursions.gravity_force(model, q),
        "aba": recursions.aba(model, q, v, tau),
        "crba": recursions.crba(model, q),
        "sqrt": recursions.mass_matrix_sqrt(model, q),
        "again": again,
        "tangent": times_inverse(tau - 0.5 * again),
    }


def expected(model, q, v, a, tau, wrenches):
    """The same from the matrix form's M, C v + N, and N."""

    def at(q, v):
        return (
            matrix_form.mass_matrix(model, q),
            matrix_form.inverse_dynamics(model, q, v, None),
            matrix_form.gravity_force(model, q),
        )

    mass, bias, weight = (np.asarray(x) for x in quick(at)(q, v))
    free = np.linalg.solve(mass, tau - bias)
    return {
        "rnea": mass @ a + bias,
        "bias": bias,
        "gravity": weight,
        "aba": free,
        "crba": mass,
        "again": free,
        "tangent": np.linalg.solve(mass, tau - 0.5 * free),
    }


@functools.cache
def wanted(name):
    model = TREES[name]()
    return expected(model, *(x[0] for x in random_states(model, 1, 7)))


@pytest.mark.parametrize("traced", [False, True], ids=["known", "traced"])
@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=[pytest.mark.slow] * (x not in ("every kind", "screws of other norms"))) for x in TREES],
)
def test_against_matrix_form(name, traced):
    model = TREES[name]()
    sample = [x[0] for x in random_states(model, 1, 7)]
    got = run(everything, model, *sample) if traced else run(lambda *x: everything(model, *x), *sample)
    want = wanted(name)
    for key, value in want.items():
        assert_close(got[key], value, 1e-10, key)
    root = np.asarray(got["sqrt"])
    assert_close(root @ root.T, want["crba"], 1e-10, "W W^T")
    assert_close(np.prod(np.diag(root)) ** 2, np.linalg.det(want["crba"]), 1e-9, "det M = prod W_kk^2")


@pytest.mark.long
def test_gradients_at_rest():
    """At the neutral configuration, at rest, without gravity: finite, and those of the matrix form; every leaf."""
    model = random_tree(2, ["free", "helical", "spherical"], armature=False)
    arrays, static = eqx.partition(model, eqx.is_inexact_array)
    zero = jnp.zeros(model.nv)
    tau = jnp.arange(1.0, model.nv + 1)

    def loss(of):
        return lambda arrays, *x: jnp.sum(jnp.sin(of(eqx.combine(arrays, static), *x)))

    args = arrays, neutral(model), zero, tau
    got = run(jax.grad(loss(recursions.aba), (0, 1, 2, 3)), *args)
    want = quick(jax.grad(loss(matrix_form.forward_dynamics), (0, 1, 2, 3)))(*args)
    for one, other in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert_close(one, other, 1e-9)


def test_a_body_without_mass():
    """A body without mass in the middle of a chain leaves all numbers and gradients finite."""
    model = random_tree(4, ["revolute"] * 3, parents=[-1, 0, 1])
    model = model.replace(inertias=model.inertias * jnp.array([1.0, 0.0, 1.0])[:, None])
    q, v, _, tau, _ = (x[0] for x in random_states(model, 1, 0))
    value, slope = run(jax.value_and_grad(lambda q: jnp.sum(recursions.aba(model, q, v, tau))), q)
    want = jnp.sum(quick(lambda q: matrix_form.forward_dynamics(model, q, v, tau))(q))
    assert_close(value, want, 1e-10)
    assert np.isfinite(slope).all()


def test_a_mass_matrix_that_is_not_positive_definite_gives_no_numbers():
    """A body of negative mass at the end of a chain: every pivot above it would be wrong."""
    model = random_tree(4, ["revolute", "helical", "prismatic"], parents=[-1, 0, 1])
    model = model.replace(inertias=model.inertias * jnp.array([1.0, 1.0, -1.5])[:, None])
    q, v, _, tau, _ = (x[0] for x in random_states(model, 1, 0))
    assert np.isnan(run(lambda q: recursions.aba(model, q, v, tau), q)).all()
    forms = matrix_form.forward_dynamics, scans.forward_dynamics, jaxdyn.forward_dynamics
    mass, *others = quick(lambda q: (matrix_form.mass_matrix(model, q), *(form(model, q, v, tau) for form in forms)))(q)
    assert np.linalg.eigvalsh(mass)[0] < -0.01
    assert len(others) == 3 and all(np.isnan(other).all() for other in others)


def test_root_of_a_chain_is_triangular():
    model = random_tree(4, ["revolute", "prismatic", "helical"], parents=[-1, 0, 1])
    root = run(lambda q: recursions.mass_matrix_sqrt(model, q), random_states(model, 1, 0)[0][0])
    assert np.array_equal(np.tril(root, -1), np.zeros((3, 3)))
    assert (np.diag(root) > 0).all()


@pytest.mark.long
def test_results_keep_the_dtype():
    """No conversion of numbers anywhere, with known and with traced leaves."""
    dtype = jnp.float32
    model = as_dtype(TREES["every kind"](), dtype)
    sample = [x[0] for x in random_states(model, 1, 5)]
    for function, args in ((everything, (model, *sample)), (lambda *x: everything(model, *x), sample)):
        jaxpr = jax.make_jaxpr(function)(*args).jaxpr
        assert {v.aval.dtype for eqn in jaxpr.eqns for v in eqn.outvars if v.aval.dtype.kind == "f"} == {
            np.dtype(dtype)
        }


def test_without_gravity_and_without_bodies():
    model = random_tree(7, ["revolute", "prismatic"]).replace(gravity=None)
    q, v, a, _, _ = (x[0] for x in random_states(model, 1, 0))
    source, _ = to_pinocchio(model)
    assert_close(run(lambda q: recursions.gravity_force(model, q), q), np.zeros(2))
    want = pin.rnea(source, source.createData(), *map(np.asarray, (q, v, a)))
    assert_close(run(lambda *x: recursions.rnea(model, *x), q, v, a), want, 1e-12)
    empty = jaxdyn.ModelBuilder("empty").build()
    none = jnp.zeros(0)
    assert recursions.aba(empty, none, none, none).shape == recursions.rnea(empty, none, none, None).shape == (0,)
    assert recursions.crba(empty, none).shape == recursions.mass_matrix_sqrt(empty, none).shape == (0, 0)


def test_nearly_parallel_axes():
    """Common normals that lie far away are not used."""
    tilt = 1e-4
    pose = np.array(
        [[1, 0, 0, 0.3], [0, np.cos(tilt), -np.sin(tilt), 0.2], [0, np.sin(tilt), np.cos(tilt), 0.1], [0, 0, 0, 1]]
    )
    home = frames._decompose(pose, 1e-15)
    assert abs(home.e) + abs(home.d) + np.abs(home.shift).max() < 1


def test_masses_on_a_joint_axis_belong_to_the_parent():
    model = random_tree(1, ["revolute", "revolute", "prismatic"], parents=[-1, 0, 1])
    moments = frames.pseudo_inertias(model, frames.canonical_frames(model))
    for J, kind in zip(moments, model.topology.kinds, strict=True):
        assert not J[frames.SHARED[kind]].any()
