"""Choices of redundant rows that the user holds: the same results as without, and exchanged where they lose rank."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within

import jaxdyn as jd

TIMES = np.linspace(0.0, 1.0, 17)


def bricard():
    """Bricard's linkage and its states on the way through a place where four of its five rows lose rank."""
    scene = jd.scenes.bricard()
    motion = jd.simulate(scene, *jd.scenes.bricard.start(branch=-1), TIMES, stepsize=within(1e-10))
    return scene, motion.q, motion.v


def rounded(scene, digits):
    """The scene as a file of so many digits has it."""
    system, constraints = jax.tree.map(
        lambda x: jnp.round(x, digits) if eqx.is_inexact_array(x) else x, (scene.system, scene.constraints)
    )
    return jd.Scene(system.replace(rounding=0.5 * 10.0**-digits), constraints)


@pytest.mark.long
def test_a_held_choice_gives_the_same_dynamics():
    scene, q, v = bricard()
    chosen = jd.constraints.choose_rows(scene, q[0])
    one, held = (
        jax.jit(jax.vmap(lambda q, v, scene=x: jd.constrained_dynamics(scene, q, v)))(q, v) for x in (scene, chosen)
    )
    assert (np.asarray(held.rank) == 4).all() and held.success.all() and held.layout == one.layout
    # Both solve with the same rows to rounding, times the condition of the five rows, some 1e3 at the passage.
    np.testing.assert_allclose(held.acceleration, one.acceleration, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(held.multipliers, one.multipliers, rtol=1e-8, atol=1e-8)
    for x in (scene, chosen):
        assert jd.degrees_of_freedom(x, q[0]) == 1
    for k in range(0, len(TIMES), 4):
        P, wanted = (jd.constraints.projections(x, q[k]).P_T for x in (chosen, scene))
        np.testing.assert_allclose(P, wanted, atol=1e-9)


@pytest.mark.long
def test_derivatives_of_a_held_choice():
    scene, q, v = bricard()
    chosen = jd.constraints.choose_rows(scene, q[0])

    # Along velocities that the linkage has: others are not the same for all rows and for some.
    along = jd.constraints.projections(scene, q[2]).P_T @ jnp.arange(1.0, 1.0 + scene.nv)

    def power(scene, step):
        return jd.constrained_dynamics(scene, q[2], v[2] + step * along).acceleration @ jnp.arange(1.0, 1.0 + scene.nv)

    for derivative in (jax.grad, jax.jacfwd, lambda f: jax.jacfwd(jax.grad(f))):
        held, wanted = (jax.jit(derivative(lambda step, x=x: power(x, step)))(0.0) for x in (chosen, scene))
        np.testing.assert_allclose(held, wanted, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("digits", [6, 16])
def test_motions_of_a_held_choice(digits):
    exact, q, v = bricard()
    scene = exact if digits == 16 else rounded(exact, digits)
    start = jd.assemble(scene, q[0], v[0])
    chosen = jd.constraints.choose_rows(scene, start.q)
    motion = jd.simulate(chosen, start.q, start.v, TIMES, stepsize=within(1e-10))
    assert bool(motion.success) and int(motion.stats["redundant_rows"]) == 1
    np.testing.assert_allclose(motion.q, q, atol=1e-7 if digits == 16 else 10 * 0.5 * 10.0**-digits)
    again = jd.assemble(chosen, start.q + 0.01, start.v)
    assert bool(again.success) and again.dropped.sum() == 1


def test_scenes_that_need_no_choice_and_places_that_allow_none():
    bar, (q, _) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
    assert jd.constraints.choose_rows(bar, q) is bar
    assert not jd.constraints.choose_rows(jd.robots.iiwa(), jnp.zeros(7)).constraints
    with pytest.raises(ValueError, match="q has shape"):
        jd.constraints.choose_rows(bar, q[:2])
    scene, start = jd.scenes.bricard(), jd.scenes.bricard.start(branch=-1)[0]
    once = jd.constraints.choose_rows(scene, start)
    twice = jd.constraints.choose_rows(once, start)
    assert jax.tree.structure(once) == jax.tree.structure(twice)


def test_a_held_choice_of_rounded_rows_has_a_code_in_a_singular_position():
    """A flat parallelogram, whose rows have rank one there; a file of few digits does not say so."""
    exact = jd.scenes.four_bar(lengths=(1.0, 3.0, 1.0, 3.0), gravity=None, in_plane=False)
    scene, flat, at_rest = rounded(exact, 4), jnp.zeros(3), jnp.zeros(3)
    chosen = jd.constraints.choose_rows(scene, jnp.array([1.0, -1.0, 1.0]))
    for one in (scene, chosen):
        assert jd.constrained_dynamics(one, flat, at_rest).result == jd.RESULTS.unclear_rank
    motion = jd.constrained_dynamics(chosen, jnp.array([0.3, -0.3, 0.3]), at_rest, jnp.array([1.0, 0.3, 0.2]))
    wanted = jd.constrained_dynamics(exact, jnp.array([0.3, -0.3, 0.3]), at_rest, jnp.array([1.0, 0.3, 0.2]))
    assert bool(motion.success) and int(motion.rank) == int(wanted.rank) == 2
    np.testing.assert_allclose(motion.acceleration, wanted.acceleration, atol=10 * 0.5e-4)
