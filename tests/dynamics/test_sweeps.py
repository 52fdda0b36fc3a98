"""Recursions as sweeps: against those that are written out, their derivatives, and chains of hundreds of links."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn.compile import kernel
from jaxdyn.compile.trace import program_of
from jaxdyn.dynamics import centroidal, kinematics, recursions, scans, tree_frames, world_frame
from jaxdyn.dynamics.recursions import sweeps

pytestmark = pytest.mark.native

KINDS = [("revolute",), ("prismatic",), ("helical",), ("revolute", "prismatic", "helical", "continuous")]
# A slide is a screw as a helical joint is.
SOME = [pytest.param(x, marks=[pytest.mark.slow] * (x == ("prismatic",))) for x in KINDS]


def tree(kinds, nb=12, branching=1.6, **changes):
    model = jd.robots.random_tree(3, nb, branching=branching, skew=1.0, taper=0.9, kinds=kinds)
    # Screws that are not of unit length, and rotors.
    return model.replace(screws=model.screws * 1.3, armature=jnp.linspace(0.1, 0.2, nb), **changes)


def floating(kinds, nb=12, branching=1.6, armature=True, gravity=(0.3, -0.2, -9.81)):
    """A floating base with bodies on it."""
    rng, builder = np.random.default_rng(5), jd.ModelBuilder("floating", gravity=gravity)
    builder.add_body(
        "b000", None, "free", (2.0, (0.1, -0.2, 0.05), (0.3, 0.4, 0.5)), pose=((0.3, 0.1, -0.2), (0.4, -0.3, 0.2))
    )
    for i in range(1, nb):
        parent, kind = f"b{max(0, int((i - 1) / branching)):03d}", kinds[i % len(kinds)]
        inertia = (1.0, tuple(0.1 * rng.normal(size=3)), tuple(0.1 + 0.05 * rng.uniform(size=3)))
        options = {"pitch": 0.2} if kind == "helical" else {}
        pose = tuple(0.3 * rng.normal(size=3)), tuple(rng.normal(size=3))
        builder.add_body(f"b{i:03d}", parent, kind, inertia, pose=pose, axis=tuple(rng.normal(size=3)), **options)
    model = builder.build()
    # Screws that are not of unit length, and rotors.
    model = model.replace(screws=model.screws * jnp.where(jnp.arange(nb) > 0, 1.3, 1.0)[:, None])
    return model.replace(armature=jnp.linspace(0.1, 0.2, model.nv)) if armature else model


def state(model, seed=0):
    rng = np.random.default_rng(seed)
    q, v, x = rng.normal(size=model.nq), *rng.normal(size=(2, model.nv))
    return tuple(map(jnp.asarray, (q, v, x)))


@pytest.mark.parametrize("kinds", SOME)
@pytest.mark.parametrize("given", [False, True])
def test_as_the_recursions_that_are_written_out(kinds, given):
    if given and len(kinds) > 1:
        assert not jax.eval_shape(lambda m: jnp.zeros(int(sweeps.has_sweeps(m))), tree(kinds)).size
        return
    model = tree(kinds)
    q, v, x = state(model)

    def of(form):
        def both(model, q, v, x):
            return form.aba(model, q, v, x), form.rnea(model, q, v, x), form.gravity_force(model, q)

        compiled = kernel(both)
        return quick(compiled)(model, q, v, x) if given else quick(lambda *s: compiled(model, *s))(q, v, x)

    for a, b in zip(of(sweeps), of(recursions), strict=True):
        assert_close(a, b, 1e-12)


@pytest.mark.parametrize(
    ("armature", "given", "kinds"),
    [
        pytest.param(
            armature,
            given,
            kinds,
            marks=[pytest.mark.slow] * (kinds == KINDS[1] or (not armature and kinds != KINDS[0])),
        )
        for armature in (False, True)
        for given in (False, True)
        for kinds in KINDS
        if not given or len(kinds) == 1
    ],
)
def test_floating_base(kinds, given, armature):
    model = floating(kinds, armature=armature)
    assert sweeps.has_sweeps(model)
    q, v, x = state(model)

    def of(form):
        def all_of(model, q, v, x):
            a, times = form.acceleration_and_inverse(model, q, v, x)
            return (
                a,
                times(x * a),
                form.rnea(model, q, v, x),
                form.bias_force(model, q, v),
                form.gravity_force(model, q),
            )

        compiled = kernel(all_of)
        return quick(compiled)(model, q, v, x) if given else quick(lambda *s: compiled(model, *s))(q, v, x)

    for a, b in zip(of(sweeps), of(recursions), strict=True):
        assert_close(a, b, 1e-12)


def test_no_sweeps_of_other_trees():
    """Two floating bodies, and other joints of several degrees of freedom."""
    builder = jd.ModelBuilder("two")
    for name in "ab":
        builder.add_body(name, None, "free", (1.0, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1)))
    assert not sweeps.has_sweeps(builder.build())
    assert not sweeps.has_sweeps(jd.robots.random_tree(0, 3, kinds=("spherical",)))


def test_batches_gravity_and_given_inertias():
    model = tree(("revolute",), gravity=None)
    many = [jnp.stack([x, 2 * x, -x]) for x in state(model)]

    def of(form):
        compiled = kernel(lambda model, *s: form.aba(model, *s))
        return quick(lambda inertias, *s: jax.vmap(lambda *x: compiled(model.replace(inertias=inertias), *x))(*s))(
            model.inertias, *many
        )

    assert_close(of(sweeps), of(recursions), 1e-12)


@pytest.mark.parametrize("kinds", [("revolute",), ("free",), pytest.param(("helical",), marks=pytest.mark.slow)])
def test_derivatives(kinds, monkeypatch):
    """Reverse mode of public functions over all leaves: against the recursions that are written out, and differences."""
    nb = tree_frames.MIN_BODIES_IN_SWEEPS
    is_floating = kinds == ("free",)
    monkeypatch.setattr(tree_frames, "MAX_BODIES", nb - 1 if is_floating else tree_frames.MAX_BODIES)
    model = floating(("revolute",), nb, 1.3) if is_floating else tree(kinds, nb=nb, branching=1.3)
    at = (model, *state(model))
    weights = jnp.cos(jnp.arange(model.nv))

    def value(model, q, v, x):
        return jnp.sum(weights * jd.forward_dynamics(model, q, v, x)) + jnp.sum(
            weights * jd.inverse_dynamics(model, q, v, x)
        )

    def direct(model, q, v, x):
        a, tau = kernel(lambda m, *s: (recursions.aba(m, *s), recursions.rnea(m, *s)))(model, q, v, x)
        return jnp.sum(weights * a) + jnp.sum(weights * tau)

    computed = quick(jax.grad(value, (0, 1, 2, 3)))(*at)
    for a, b in zip(
        jax.tree.leaves(computed), jax.tree.leaves(quick(jax.grad(direct, (0, 1, 2, 3)))(*at)), strict=True
    ):
        assert_close(a, b, 1e-9)
    q, step = at[1], 1e-6
    along = jnp.cos(jnp.arange(model.nq))
    run = quick(value)
    difference = (run(model, q + step * along, *at[2:]) - run(model, q - step * along, *at[2:])) / (2 * step)
    assert_close(computed[1] @ along, difference, 1e-6)  # of central differences
    forward = quick(lambda q: jax.jvp(lambda q: value(model, q, *at[2:]), (q,), (along,))[1])(q)
    assert_close(forward, computed[1] @ along, 1e-9)


def test_code_does_not_grow_with_the_bodies():
    def program(nb):
        model = jd.robots.random_tree(1, nb, branching=1, skew=0.3, taper=1.0, kinds=("revolute",))
        return program_of(sweeps.aba, (), model, state(model))[1][0]

    few, many = program(50), program(150)
    assert sum(len(x.body.operations) for x in few.subprograms) == sum(len(x.body.operations) for x in many.subprograms)
    assert sum(op not in ("input", "part") for op, _, _ in many.operations) == len(many.subprograms) == 4


@pytest.mark.parametrize("links", [200, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("branching", [1, 2, "floating"])
def test_hundreds_of_links(links, branching):
    is_floating = branching == "floating"
    model = floating(("revolute",), links, 1.0, armature=False) if is_floating else None
    model = model or jd.robots.random_tree(1, links, branching=branching, skew=0.3, taper=1.0, kinds=("revolute",))
    q, v, tau = (0.3 * x for x in state(model))
    a = quick(lambda *s: jd.forward_dynamics(model, *s))(q, v, tau)
    inverse = quick(lambda *s: jd.inverse_dynamics(model, *s))
    size = jnp.max(jnp.abs(inverse(q, v, 0 * a)))
    assert jnp.max(jnp.abs(inverse(q, v, a) - tau)) < 1e-12 * size


MIXED = ("revolute", "spherical", "prismatic", "planar", "free", "helical")


@pytest.mark.parametrize("kinds", [pytest.param(("spherical",), marks=pytest.mark.slow), MIXED])
@pytest.mark.parametrize("given", [False, True])
def test_loops_of_joints_of_any_kinds(kinds, given, monkeypatch):
    """Dynamics in link frames and kinematics as native loops, against products of matrices by JAX."""
    monkeypatch.setattr(tree_frames, "MIN_BODIES_IN_LOOPS", 4)
    model = jd.robots.random_tree(3, 12, branching=1.6, skew=1.0, taper=0.9, kinds=kinds)
    model = model.replace(armature=jnp.linspace(0.1, 0.2, model.nv))
    _, v, x = state(model)
    q, wrenches = jd.random_configuration(model, jax.random.key(0)), jnp.ones((model.nb, 6))

    def of(form):
        def values(model, q, v, x):
            frame = tree_frames.tree_frame(model, q)
            kinetic = centroidal._kinetic_energy(model, q, v), world_frame.generalized_force(model, q, wrenches)
            a, times = form.acceleration_and_inverse(model, q, v, x)
            return frame, *kinetic, a, times(x * a), form.inverse_dynamics(model, q, v, x)

        return values

    compiled = kernel(of(scans))
    computed = quick(compiled)(model, q, v, x) if given else quick(lambda *s: compiled(model, *s))(q, v, x)
    with jd.compilation("plain"):
        expected = jax.jit(of(world_frame))(model, q, v, x)
    for a, b in zip(jax.tree.leaves(computed), jax.tree.leaves(expected), strict=True):
        assert_close(a, b, 1e-12)


@pytest.mark.parametrize(
    "kinds", [pytest.param(("revolute",), marks=pytest.mark.slow), ("revolute", "spherical", "prismatic")]
)
def test_many_joints_of_several_kinds(kinds):
    """Public functions of a tree with more bodies than are written out, and their derivatives against differences."""
    model = jd.robots.random_tree(3, tree_frames.MAX_BODIES + 4, branching=1.3, skew=1.0, taper=0.95, kinds=kinds)
    _, v, x = state(model)
    q = jd.random_configuration(model, jax.random.key(0))
    M, a = quick(lambda q: (jd.mass_matrix(model, q), jd.forward_dynamics(model, q, v, x)))(q)
    # The columns of M are forces of unit accelerations, and inverse dynamics inverts the motion.
    still = model.replace(gravity=None)
    columns = quick(jax.vmap(lambda e: jd.inverse_dynamics(still, q, jnp.zeros_like(v), e)))(jnp.eye(model.nv))
    assert_close(M, columns.T, 1e-12)
    assert_close(jd.inverse_dynamics(model, q, v, a), x, 1e-10)  # the condition number of M is 1e5

    def value(q):
        tip = jd.forward_kinematics(model, q)[-1, :3, 3]
        return (
            v @ jd.mass_matrix(model, q) @ x
            + tip @ (jd.body_jacobian(model, q, model.frame_names[-1])[:3] @ v)
            + v @ jd.forward_dynamics(model, q, v, x)
        )

    step, along, run = 1e-6, jnp.cos(jnp.arange(model.nv)), quick(value)
    difference = (run(jd.integrate(model, q, along, step)) - run(jd.integrate(model, q, along, -step))) / (2 * step)
    rate = jax.jvp(lambda s: jd.integrate(model, q, along, s), (0.0,), (1.0,))[1]
    assert_close(quick(jax.grad(value))(q) @ rate, difference, 1e-6)  # of central differences


def test_code_of_kinematics_does_not_grow_with_the_bodies():
    """Loops of 64 and of 128 bodies have the same operations, and a frame takes the bodies above it alone."""

    def count(nb, branching=1):
        model = jd.robots.random_tree(1, nb, branching=branching, skew=0.3, taper=1.0, kinds=("revolute",))
        q = state(model)[0]
        of_all = program_of(kinematics._world_poses.__wrapped__, (), model, (q,))[1][0]
        return [len(x.body.operations) for x in of_all.subprograms]

    few = tree_frames.MIN_BODIES_IN_LOOPS
    assert sum(count(few)) == sum(count(2 * few))


@pytest.mark.parametrize("kinds", [("revolute",), pytest.param(("revolute", "spherical"), marks=pytest.mark.slow)])
def test_recursions_by_name_of_many_bodies(kinds):
    """`rnea`, `aba` and `crba` of many bodies are the loops of the public quantities, with wrenches and without accelerations."""
    model = jd.robots.random_tree(3, tree_frames.MAX_BODIES + 2, branching=1.3, skew=1.0, taper=0.95, kinds=kinds)
    _, v, x = state(model)
    q, wrenches = jd.random_configuration(model, jax.random.key(0)), jnp.ones((model.nb, 6))
    computed = quick(
        lambda q: (
            jd.dynamics.aba(model, q, v, tau=x),
            jd.dynamics.rnea(model, q, v, x, external=wrenches),
            jd.dynamics.rnea(model, q, v, None),
            jd.dynamics.crba(model, q),
        )
    )(q)
    # The oracle: products of matrices by JAX.
    with jd.compilation("plain"):
        expected = (
            world_frame.forward_dynamics(model, q, v, x),
            world_frame.inverse_dynamics(model, q, v, x, wrenches),
            world_frame.inverse_dynamics(model, q, v, None),
            world_frame.mass_matrix(model, q),
        )
    for a, b, tolerance in zip(computed, expected, (1e-9, 1e-11, 1e-11, 1e-12), strict=True):
        assert_close(a, b, tolerance)  # of accelerations by the condition number of M


@pytest.mark.parametrize("count", [140, pytest.param(420, marks=pytest.mark.slow)])
def test_mass_matrix_of_a_shallow_tree(count):
    """Of many bodies and few pairs, written out and beyond by loops, and within another kernel: forces of unit accelerations."""
    model = jd.robots.random_tree(3, count, branching=20, skew=0.3, taper=1.0, kinds=("revolute",)).replace(
        gravity=None
    )
    q = state(model)[0]
    places = np.array([0, 7, count // 2, count - 1])
    columns = quick(jax.vmap(lambda e: jd.inverse_dynamics(model, q, jnp.zeros(count), e)))(jnp.eye(count)[places])
    twice = kernel(lambda model, q: 2 * jd.mass_matrix(model, q))
    for M in (quick(lambda q: jd.mass_matrix(model, q))(q), 0.5 * quick(lambda q: twice(model, q))(q)):
        assert_close(M[places], columns, 1e-12)
