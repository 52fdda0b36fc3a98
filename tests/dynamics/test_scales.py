"""Mechanisms of any size, from nanometres to thousands of kilometres: what is closed at one size is closed at all of them.

With lengths and gravity scaled by the same number, a mechanism of revolute joints moves by the same angles in the same time.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick

from jaxdyn import RESULTS, ModelBuilder, assemble, scenes, simulate
from jaxdyn.constraints.redundancy import coordinate_sizes, own_length

LENGTHS = np.array([1.0, 3.0, 2.5, 3.5])
SCALES = (1e-9, 1e-6, 1e-3, 1.0, 1e5, 1e6)
TIMES = [0.0, 0.5]


def four_bar(scale):
    return scenes.four_bar(lengths=tuple(LENGTHS * scale), gravity=(0.0, -9.81 * scale, 0.0))


def slider_crank(scale):
    return scenes.slider_crank(crank=scale, rod=2.5 * scale)


@quick
def guessed(scene, q, v):
    assembly = assemble(scene, q, v)
    return assembly.q, assembly.v, assembly.success


@pytest.fixture(scope="module")
def moved():
    """Results of a motion with fixed steps, by method; one program for all sizes."""

    def by(method):
        @quick
        def run(scene, q, v):
            solution = simulate(scene, q, v, TIMES, method=method, stepsize=0.01, throw=False)
            return solution.q[-1], solution.result

        return run

    return {method: by(method) for method in ("multipliers", "projected")}


@pytest.mark.parametrize("scale", SCALES)
def test_an_assembled_linkage_is_assembled_at_every_size(scale):
    q, v = scenes.four_bar.start()
    rough = q + jnp.asarray([0.0, 0.05, -0.05])
    computed, known = (guessed(four_bar(x), rough, v) for x in (scale, 1.0))
    assert computed[2]
    np.testing.assert_allclose(computed[0], known[0], atol=1e-12)
    np.testing.assert_allclose(computed[1], known[1], atol=1e-12)


@pytest.mark.parametrize("method", ["multipliers", "projected"])
@pytest.mark.parametrize("scale", SCALES)
def test_the_same_motion_and_the_same_refusals(moved, scale, method):
    """A loop open by a third of the crank, one that slips as fast, and one that is closed."""
    q, v = scenes.four_bar.start()
    scene, tilted = four_bar(scale), jnp.asarray([0.0, 0.0, 0.13])
    run = moved[method]
    end, result = run(scene, q, v)
    assert result == RESULTS.successful
    np.testing.assert_allclose(end, run(four_bar(1.0), q, v)[0], rtol=1e-10)
    for start in ((q + tilted, v), (q, v + tilted)):
        assert run(scene, *start)[1] == RESULTS.inconsistent_start
        with pytest.raises(ValueError, match=r"'knee' (open by|slips at)"):
            simulate(scene, *start, TIMES, method=method, stepsize=0.01)


@pytest.mark.parametrize("scale", SCALES)
def test_slides_are_measured_by_the_length_of_the_mechanism(scale):
    q, v = (x.at[2].multiply(scale) for x in scenes.slider_crank.start())
    scene = slider_crank(scale)
    place, _, success = guessed(scene, q * 1.02, v)
    assert success
    # The slide of a closed loop, from the angles.
    want = scale * (np.cos(place[0]) + 2.5 * np.cos(place[0] + place[1]))
    np.testing.assert_allclose(place[2], want, rtol=1e-12)
    with pytest.raises(ValueError, match="on the constraints"):
        simulate(scene, q.at[2].multiply(1.001), v, TIMES, method="multipliers", stepsize=0.01)


def test_the_length_is_that_of_the_mechanism_wherever_it_stands():
    model = four_bar(1e-3).system
    length = quick(own_length)
    np.testing.assert_allclose(length(model), 3.5e-3, rtol=1e-14)
    far = eqx.tree_at(lambda model: model.home, model, model.home.at[jnp.asarray([0, 2]), 0, 3].add(1e3))
    np.testing.assert_allclose(length(far), 3.5e-3, rtol=1e-9)
    # Of one free body, its radius of gyration about the origin of its frame; of one without mass, none.
    builder = ModelBuilder("ball")
    builder.add_body("ball", joint="free", inertia=(2.0, (0.0, 0.0, -0.3), 0.02 * np.eye(3)))
    ball, radius = builder.build(), np.sqrt(0.3**2 + 1.5 * 0.01)
    np.testing.assert_allclose(length(ball), radius, rtol=1e-14)
    np.testing.assert_allclose(coordinate_sizes(ball, jnp.float64)[0], [radius] * 3 + [1.0] * 3, rtol=1e-14)
    assert length(eqx.tree_at(lambda model: model.inertias, ball, jnp.zeros((1, 10)))) == 1.0
