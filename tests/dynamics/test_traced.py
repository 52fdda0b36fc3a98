"""Construction with traced numbers: `grad`, `jvp` and `vmap` go through `ModelBuilder` and through every named scene."""

import inspect

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.constraints import base
from jaxdyn.contact import unilateral

BALL = (2.0, (0.1, 0.2, 0.3), (0.03, 0.04, 0.05))
_TURN = jd.se3.from_parts(jd.so3.exp(jnp.array([0.3, -0.2, 0.4])), jnp.array([0.1, -0.05, 0.02]))
# What defaults of None stand for; and the arguments that decide which numbers there are.
GIVEN = {
    "double_pendulum": {"moments": (0.08, 0.02)},
    "free_box": {"frame": np.asarray(_TURN), "gravity": 9.81},
    "parallel_manipulator": {"gravity": (0.0, -9.81, 0.5)},
    "closed_ring": {"gravity": (0.0, -9.81, 0.5)},
    "planar_arm": {"gravity": 9.81},
}
SHAPES = [
    *((name, {}) for name in jd.scenes.names()),
    *(("double_pendulum", {"formulation": shape}) for shape in ("model", "immersion", "loop")),
    ("sphere_arm", {"contact": "rolling"}),
    ("four_bar", {"in_plane": False}),
]


def numeric(function, given):
    """Arguments with numbers that are no integers: what may be traced."""

    def is_numeric(value):
        leaves = jax.tree.leaves(value)
        return bool(leaves) and all(isinstance(leaf, (float, np.ndarray)) for leaf in leaves)

    names = {name: p.default for name, p in inspect.signature(function).parameters.items()} | given
    known = inspect.signature(function).parameters
    return {name: value for name, value in names.items() if name in known and is_numeric(value)}


def weigh(tree):
    """A sum of all numbers of a tree, each with a weight of its own."""
    flat = jax.flatten_util.ravel_pytree([leaf for leaf in jax.tree.leaves(tree) if eqx.is_inexact_array(leaf)])[0]
    flat = jnp.where(jnp.isfinite(flat), flat, 0.0)  # limits
    return jnp.sum(flat * np.sin(1.0 + np.arange(flat.size)))


def quantities(scene, q, v):
    """All that a scene's equations are made of, at a state."""
    system = scene.system
    computed: list = [jd.mass_matrix(system, q), jd.bias_force(system, q, v)]
    if not any(isinstance(force, unilateral.WithModes) for force in scene.forces):
        computed.append(scene.applied_force(q, v, 0.3))
    if scene.constraints:
        rows = base.rows(scene, q, v, 0.3)
        computed += [jax.tree.leaves(rows), jd.constraints.position_residual(scene, q, 0.3)]
    return weigh(computed)


def check_slopes(function, at, seed=0, step=1e-4, rtol=1e-7):
    """Reverse mode, forward mode, and differences of fourth order of a batch; and the value on known numbers."""
    flat, build = jax.flatten_util.ravel_pytree(jax.tree.map(lambda x: np.asarray(x, float), at))
    flat = np.asarray(flat)
    direction = np.random.default_rng(seed).uniform(0.5, 1.0, flat.size) * np.where(flat == 0, 0.1, flat)

    @jax.jit
    def both(flat):
        value = lambda x: function(build(x))  # noqa: E731
        steps = step * jnp.array([0.0, -2.0, -1.0, 1.0, 2.0])
        values = jax.vmap(value)(flat[None] + steps[:, None] * direction[None])
        return jax.grad(value)(flat), jax.jvp(value, (flat,), (direction,))[1], values

    gradient, forward, values = (np.asarray(x) for x in both(jnp.asarray(flat)))
    differences = (values[1] - 8 * values[2] + 8 * values[3] - values[4]) / (12 * step)
    size = np.abs(gradient) @ np.abs(direction) + 1e-3
    assert np.all(np.isfinite(gradient))
    np.testing.assert_allclose(gradient @ direction, forward, rtol=0, atol=1e-10 * size)
    np.testing.assert_allclose(forward, differences, rtol=0, atol=rtol * size)
    np.testing.assert_allclose(values[0], function(at), rtol=1e-12, atol=1e-12)
    return gradient


def parts(name, shape):
    """A scene with its shape settled, its start, and the numbers of each."""
    scene, given = getattr(jd.scenes, name), GIVEN.get(name, {}) | shape
    known = inspect.signature(scene.start_function).parameters
    fixed = {key: value for key, value in shape.items() if key in known}
    build = lambda numbers: scene(**shape, **numbers)  # noqa: E731
    start = lambda numbers: scene.start(**fixed, **numbers)  # noqa: E731
    return build, numeric(scene._build, given), start, numeric(scene.start_function, given)


# One of each kind of construction; all others are slow tests, as XLA compiles each for some seconds.
QUICK = ("bennett", "double_pendulum-model", "rolling_coin", "suslov")


def cases(slow):
    for name, shape in SHAPES:
        label = "-".join([name, *map(str, shape.values())])
        marks = [pytest.mark.slow] if slow or label not in QUICK else []
        yield pytest.param(name, shape, id=label, marks=marks)


@pytest.mark.long
@pytest.mark.parametrize(("name", "shape"), list(cases(slow=False)))
def test_every_number_of_every_scene_and_start_can_be_traced(name, shape):
    build, numbers, start, of_start = parts(name, shape)
    with jd.compilation("plain"):
        if numbers:
            check_slopes(lambda numbers: weigh(build(numbers)), numbers)
        if of_start:
            check_slopes(lambda numbers: weigh(start(numbers)), of_start)
    assert numbers or not inspect.signature(getattr(jd.scenes, name)._build).parameters


@pytest.mark.parametrize(("name", "shape"), list(cases(slow=True)))
def test_equations_have_slopes_by_every_number_of_a_scene(name, shape):
    build, numbers, start, _ = parts(name, shape)
    q, v = start({})
    with jd.compilation("plain"):
        if numbers:
            check_slopes(lambda numbers: quantities(build(numbers), q, v), numbers, rtol=1e-6)


def arm(numbers):
    """A tree of all kinds of numbers: a fixed body, a helical joint, a frame, friction, limits and a coupling."""
    builder = jd.ModelBuilder("arm", gravity=numbers["gravity"])
    upper = (numbers["mass"], numbers["center"], numbers["moments"])
    builder.add_body("upper", None, "revolute", upper, axis=numbers["axis"], armature=numbers["armature"], damping=0.2)
    builder.add_body(
        "lower", "upper", "helical", numbers["ten"], pose=(numbers["length"], 0.0, 0.0), screw=numbers["screw"]
    )
    builder.add_body("tool", "lower", "fixed", (0.3, (0.0, 0.1, 0.0), (1e-3, 2e-3, 2e-3)), pose=numbers["pose"])
    builder.add_body(
        "slide", "lower", "prismatic", jd.inertia.box(numbers["mass"], numbers["size"]), upper=numbers["length"]
    )
    builder.add_frame("tip", "tool", numbers["center"])
    builder.add_coupling("slide_joint", "upper_joint", numbers["mass"], 0.1)
    return builder.build()


NUMBERS = {
    "gravity": np.array([0.1, -9.0, 1.0]),
    "mass": 1.3,
    "center": (0.2, 0.1, -0.1),
    "moments": np.array([0.02, 0.03, 0.04]),
    "axis": np.array([0.1, 0.9, 0.2]),
    "armature": 0.05,
    "ten": np.array([0.8, 0.1, 0.05, 0.0, 0.03, 0.001, 0.04, 0.0, 0.002, 0.05]),
    "length": 0.6,
    "screw": np.array([0.1, 0.2, 0.3, 0.0, 0.4, 0.9]),
    "pose": np.array([[0.1, 0.2, 0.3], [0.3, -0.2, 0.5]]),
    "size": (0.2, 0.1, 0.3),
}


@pytest.mark.long
def test_a_builder_takes_traced_numbers_everywhere():
    gradient = check_slopes(lambda numbers: weigh(arm(numbers)), NUMBERS)
    assert np.count_nonzero(gradient) == gradient.size


def test_vmap_over_a_length_is_a_loop_of_builds():
    lengths = jnp.array([0.3, 0.6, 1.1])
    batch = jax.vmap(lambda length: arm(NUMBERS | {"length": length}))(lengths)
    for i, length in enumerate(lengths):
        one = arm(NUMBERS | {"length": float(length)})
        for got, want in zip(jax.tree.leaves(batch), jax.tree.leaves(one), strict=True):
            np.testing.assert_allclose(got[i], want, rtol=1e-15, atol=1e-16)


def test_known_numbers_beside_traced_ones_stay_known():
    """Leaves that nothing traced went into are arrays of values, which kernels are written with."""

    @jax.jit
    def known(mass):
        model = arm(NUMBERS | {"mass": mass})
        assert not isinstance(model.home, jax.core.Tracer) and isinstance(model.inertias, jax.core.Tracer)
        return model.inertias

    known(1.0)


def test_what_decides_structure_stays_known():
    def build(**options):
        def one(x):
            given = {key: value(x) for key, value in options.items() if callable(value)}
            return jd.ModelBuilder("one").add_body("b", inertia=BALL, **options | given).build().screws.sum()

        return lambda: jax.grad(one)(1.0)

    refused = {
        "screw is traced": build(joint="prismatic", screw=lambda x: jnp.stack([x, x, x, 0 * x, 0 * x, 0 * x])),
        "joint is revolute": build(joint="revolute", pitch=lambda x: x),
        "has no axis": build(joint="planar", axis=lambda x: jnp.stack([x, x, x])),
        "expected [(]3,[)]": build(axis=lambda x: jnp.stack([x, x])),
    }
    for message, call in refused.items():
        with pytest.raises(ValueError, match=message):
            call()
    # What only values could tell is left to results: a negative mass, moments of no body, a joint without inertia.
    assert np.isfinite(
        jax.jit(
            lambda m: jd.ModelBuilder("b").add_body("b", inertia=(m, (0.1, 0, 0), (1.0, 1.0, 1.0))).build().inertias
        )(-1.0)
    ).all()


def test_lengths_that_do_not_close_are_told_by_the_simulation():
    """On known numbers a ValueError; traced, a start that is open, and a result code instead of NaN."""
    with pytest.raises(ValueError, match="do not close"):
        jd.scenes.four_bar.start(lengths=(1.0, 3.0, 0.5, 9.0))

    @jax.jit
    def run(ground):
        lengths = (1.0, 3.0, 2.5, ground)
        q, v = jd.scenes.four_bar.start(lengths=lengths)
        return q, v, jd.constraints.position_residual(jd.scenes.four_bar(lengths=lengths), q)

    q, _, residual = run(9.0)
    assert np.isfinite(q).all() and np.abs(residual).max() > 1
    assert np.abs(run(3.5)[2]).max() < 1e-14


def test_float32_numbers():
    """Numbers of a lower precision are taken into the model's."""
    model = jax.jit(lambda mass: arm(NUMBERS | {"mass": mass}))(jnp.float32(1.5))
    # The moments of the box are computed in the precision of their numbers.
    np.testing.assert_allclose(model.inertias, arm(NUMBERS | {"mass": 1.5}).inertias, rtol=1e-6)
    assert model.inertias.dtype == jnp.float64


@pytest.mark.long
def test_gradient_of_a_motion_by_a_length():
    """A pendulum whose inertia goes with its length: q = f(t sqrt(g / l)), so that dq/dl = -t v / (2 l) from rest."""

    def swing(length, adjoint="reverse"):
        body = (1.0, jnp.stack([0 * length, 0 * length, -length]), length**2 * jnp.array([0.1, 0.1, 0.02]))
        model = jd.ModelBuilder("pendulum").add_body("bob", axis=(0, 1, 0), inertia=body).build()
        ts = jnp.linspace(0.0, 1.0, 3)
        motion = jd.simulate(model, jnp.array([1.0]), jnp.zeros(1), ts, stepsize=5e-3, adjoint=adjoint)
        return motion.q[-1, 0], motion.v[-1, 0]

    slope, v = jax.jit(jax.grad(swing, has_aux=True))(0.7)
    expected = -float(v) / (2 * 0.7)
    assert abs(expected) > 0.1
    np.testing.assert_allclose(slope, expected, rtol=1e-8)  # 200 steps of RK4
    forward = jax.jit(lambda x: jax.jvp(lambda x: swing(x, "forward")[0], (x,), (1.0,))[1])
    np.testing.assert_allclose(forward(0.7), slope, rtol=1e-11)
