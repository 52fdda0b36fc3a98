"""Functions that users pass: what a compiled program would keep of them is refused, what it takes as an input is not."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.systems.scene import as_pytree

ARM = jd.robots.chain(2)
TIMES = [0.0, 0.1]


class Gain:
    def __init__(self, k):
        self.k = k

    def __call__(self, *state):
        return -self.k * state[-3]

    def damping(self, q, v, t):
        return -self.k * v


class Slotted:
    __slots__ = ("k",)

    def __init__(self, k):
        self.k = k

    def __call__(self, q, v, t):
        return -self.k * q


class Module(eqx.Module):
    k: jax.Array

    def __call__(self, q, v, t):
        return -self.k * q


class Tuple(NamedTuple):
    k: jax.Array

    def spring(self, q, v, t):
        return -self.k * q


class Bare:
    def __call__(self, q, v, t):
        return -q

    def method(self, q, v, t):
        return -q


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (Gain(1.0), r"class Gain\(eqx\.Module\)"),
        (Gain(1.0).damping, "method of a"),
        (Slotted(1.0), "Slotted, whose attributes"),
        (functools.partial(Gain(1.0)), "Gain, whose attributes"),
    ],
    ids=["object", "method", "slots", "partial"],
)
def test_objects_with_attributes_are_refused(function, said):
    with pytest.raises(ValueError, match=said):
        jd.simulate(ARM, [0, 0], [0, 0], TIMES, control=function)


def test_in_scenes_too():
    with pytest.raises(ValueError, match=r"forces\[0\] is a"):
        jd.Scene(ARM, forces=(Gain(1.0),))
    with pytest.raises(ValueError, match="phi is a"):
        jd.Holonomic(Gain(1.0))
    with pytest.raises(ValueError, match="metric is a"):
        jd.MetricSystem(Gain(1.0), 2)


def test_functions_and_what_wraps_them_stay_static():
    def plain(q, v, t):
        return -q

    wrapped = (plain, jax.jit(plain), functools.lru_cache(plain), functools.partial(plain), jax.custom_jvp(plain))
    for function in (*wrapped, Bare(), Bare().method, jnp.sin, np.sin):
        assert not jax.tree.leaves(as_pytree(function, "control"))


def test_attributes_of_pytrees_are_inputs():
    """A method of a pytree as well; each value has its own motion, by one program, equal to that of a new function."""
    pendulum = jd.robots.chain(1)

    def reached(control):
        return jd.simulate(pendulum, [0.3], [0], TIMES, control=control, stepsize=0.05).q[-1]

    for function in (Module(jnp.ones(())), Module(jnp.ones(())).__call__, Tuple(jnp.ones(())).spring):
        assert len(jax.tree.leaves(as_pytree(function, "control"))) == 1
    soft, stiff = (reached(Tuple(jnp.asarray(k)).spring) for k in (1.0, 9.0))
    np.testing.assert_allclose(stiff, reached(lambda q, v, t: -9.0 * q), rtol=1e-12)
    assert np.abs(stiff - soft).max() > 1e-3


def _last(k, control=None, force=None, phi=None):
    forces, constraints = [() if x is None else (x,) for x in (force, phi)]
    scene = jd.Scene(jd.robots.chain(2), constraints, forces)
    start = jnp.asarray([0.3, -0.3 * 1.0]), jnp.zeros(2)
    return jd.simulate(scene, *start, [0.0, 0.1], control=control, stepsize=0.01, throw=False).q[-1, 0]


class _Law(eqx.Module):
    k: jax.Array

    def __call__(self, *args):
        return -self.k * args[-3]


def _nested(k):
    scaled = {"gain": [k, "a name"]}

    def spring(q):
        return -scaled["gain"][0] * q

    return lambda *args: spring(args[-3])


PLAIN = lambda k: lambda *args: -k * args[-3]  # noqa: E731


@pytest.mark.long
@pytest.mark.parametrize(
    ("place", "law", "change"),
    [
        ("control", PLAIN, lambda f: jax.jit(jax.hessian(f))),
        *((place, law, jax.value_and_grad) for place in ("control", "force") for law in (PLAIN, _nested)),
    ],
)
def test_traced_values_that_a_function_captures_are_those_of_a_module(place, law, change):
    """Values and derivatives, in a batch; a traced value was an UnexpectedTracerError or none."""
    own, wanted = (lambda k, f=f: _last(k, **{place: f(k)}) for f in (law, _Law))
    k = jnp.asarray([1.0, 3.0])
    np.testing.assert_allclose(jax.vmap(change(own))(k), jax.vmap(change(wanted))(k), rtol=1e-12)


@pytest.mark.long
def test_traced_values_in_constraints_energies_and_bases():
    arm = jd.robots.chain(2)
    x = jnp.asarray([0.3, 0.2])

    def acceleration(k):
        return jd.constrained_dynamics(
            jd.Scene(arm, (jd.Holonomic(lambda q, t: q[:1] - k * q[1:] ** 2),)), x, x
        ).acceleration

    step = 1e-5
    difference = (acceleration(0.7 + step) - acceleration(0.7 - step)) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(acceleration)(0.7), difference, rtol=1e-7)
    np.testing.assert_allclose(jax.jacrev(acceleration)(0.7), difference, rtol=1e-7)
    mass = lambda k: jd.mass_matrix(jd.LagrangianSystem(lambda q, v: k**3 * v @ v, 1), jnp.ones(1))[0, 0]  # noqa: E731
    np.testing.assert_allclose([jax.grad(mass)(2.0), jax.hessian(mass)(2.0)], [24.0, 24.0])
    scene, q = jd.scenes.four_bar(), jd.scenes.four_bar.start()[0]
    N = jd.reduction.tangent_basis(scene, q)
    rate = lambda k: jd.reduced_dynamics(scene, q, jnp.zeros(1), basis=lambda q, t: k * N).nu_rate[0]  # noqa: E731
    np.testing.assert_allclose(jax.grad(rate)(2.0), -rate(2.0) / 2.0, rtol=1e-10)


def test_functions_that_call_each_other_are_searched_once():
    def even(count, q):
        return -q if count == 0 else odd(count - 1, q)

    def odd(count, q):
        return even(count - 1, q)

    arm, x = jd.robots.chain(2), jnp.asarray([0.3, 0.2])
    computed, wanted = (
        jd.constrained_dynamics(jd.Scene(arm, (), forces=(f,)), x, x).acceleration
        for f in (lambda system, q, v, t: even(2, q), lambda system, q, v, t: -q)
    )
    np.testing.assert_allclose(computed, wanted, rtol=1e-14)
