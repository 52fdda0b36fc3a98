"""Rounded scenes with redundant rows in exported code, batches, derivatives of second order, float32, and from event to event."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from test_rounded_scenes import pair

import jaxdyn as jd

# The plane y = 0, which the end of the crank meets at a right angle.
GROUND = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("rounded")


def parallelogram(digits, pendulums=0):
    """Inclined parallelogram closed by five rows, two of which count; it is singular where it is flat. Next to it, pendulums."""
    rounding = 0.0 if digits > 15 else 0.5 * 10.0**-digits
    builder = jd.ModelBuilder("parallelogram", rounding=rounding)
    bar = lambda size: (1.0, (size / 2, 0.0, 0.0), (0.01, size**2 / 12, size**2 / 12))  # noqa: E731
    places = {"crank": (0.0, 0.0, 0.0), "rocker": (2.0, 0.0, 0.0)} | {f"p{i}": (i, 9.0, 0.0) for i in range(pendulums)}
    for name, place in places.items():
        builder.add_body(name, None, "continuous", bar(1.0), pose=(place, (0.7, 0.0, 0.0)))
    # The hinge of the coupler is parallel to the others but for the digits.
    builder.add_body("coupler", "crank", "continuous", bar(2.0), pose=((1.0, 0.0, 0.0), (rounding, 0.0, 0.0)))
    loop = jd.loop("coupler", (2.0, 0.0, 0.0), "rocker", (1.0, 0.0, 0.0), name="knee")
    return jd.Scene(builder.build(), [loop])


def at_angle(scene, angle):
    """Crank and rocker at an angle, the coupler parallel to the ground, and unit rates."""
    rates = {"crank": 1.0, "rocker": 1.0, "coupler": -1.0}
    v = jnp.array([rates.get(name, 0.0) for name in scene.system.body_names])
    return angle * v, v


@pytest.mark.long
@pytest.mark.parametrize(
    "kind", ["dynamics", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("step", "jacobian"))]
)
def test_exported_code_chooses_the_rows(folder, kind):
    """Of four rows that count and one that repeats them there is no regular solution without the choice."""
    _, (scene, q, v), _ = pair("four_bar", 5, folder)
    q, v, tau = np.asarray(q), np.asarray(v), np.array([0.3, 0.0, -0.2])
    step = jd.stepper(scene, 0.01)

    def solve(q, v, tau):
        motion = jd.constrained_dynamics(scene, q, v, tau)
        return motion.acceleration, motion.multipliers

    function = solve if kind != "step" else lambda q, v, tau: step((q, v), tau)
    given = {"derivatives": ("jacobian",)} if kind == "jacobian" else {}
    exported = jd.export(function, q, v, tau, name="bars", **given)
    for got, want in zip(exported(q, v, tau), function(*map(jnp.asarray, (q, v, tau))), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-10)
    if kind != "jacobian":
        return
    derivatives = exported.jacobian(q, v, tau)
    wanted = jax.jit(jax.jacfwd(solve, argnums=(0, 1, 2)))(q, v, tau)
    for got, want in zip(jax.tree.leaves(derivatives), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-10 * (1 + np.abs(want).max()))


@pytest.mark.long
def test_elements_of_a_batch_decide_for_themselves():
    """A flat parallelogram, which is singular, does not change its neighbours, nor does NaN; and has a code or the right rank."""
    scene, exact = parallelogram(5), parallelogram(16)
    q, v = jax.vmap(lambda angle: at_angle(scene, angle))(jnp.array([0.8, 0.0, -0.6, jnp.nan]))
    solve = lambda scene, q, v: jd.constrained_dynamics(scene, q, v)  # noqa: E731
    batch = eqx.filter_jit(jax.vmap(solve, (None, 0, 0)))(scene, q, v)
    want = eqx.filter_jit(jax.vmap(solve, (None, 0, 0)))(exact, q, v)
    assert list(want.rank[:3]) == [2, 1, 2]
    for i, is_regular in enumerate([True, False, True, False]):
        one = solve(scene, q[i], v[i])
        np.testing.assert_allclose(batch.acceleration[i], one.acceleration, atol=1e-10)
        assert bool(batch.success[i]) == bool(one.success) and int(batch.rank[i]) == int(one.rank)
        if is_regular or bool(one.success):
            assert bool(one.success) and int(one.rank) == int(want.rank[i])
            np.testing.assert_allclose(one.acceleration, want.acceleration[i], atol=10 * scene.rounding)


@pytest.mark.long
def test_tangent_basis_does_not_count_rows_that_repeat_others():
    """Six velocities, five rows, two of which count. Their number is a shape: traced, it is given or not a number."""
    scene = parallelogram(5, pendulums=3)
    q, v = at_angle(scene, 0.8)
    N = jd.reduction.tangent_basis(scene, q)
    assert (
        N.shape == (6, 4) and np.abs(jd.constraint_jacobian(scene, q) @ N).max() < 1e-4
    )  # rows differ by the rounding
    traced = jax.jit(lambda q: jd.reduction.tangent_basis(scene, q, dof=4))(q)
    np.testing.assert_allclose(traced @ traced.T, N @ N.T, atol=1e-10)
    assert np.isnan(jax.jit(lambda q: jd.reduction.tangent_basis(scene, q))(q)).all()
    code = jax.jit(lambda q, v: jd.reduction.gauge_invariant(scene, q, v).result)(q, v)
    assert code == jd.RESULTS.singular_basis
    with pytest.raises(ValueError, match="give dof"):
        jax.jit(lambda q: jd.reduction.tangent_basis(parallelogram(5), q))(q[jnp.array([0, 1, 5])])


@pytest.mark.long
def test_second_derivatives_and_float32_are_those_of_the_exact_mechanism(folder):
    _, (scene, *_), rounding = pair("four_bar", 8, folder)
    exact = jd.scenes.four_bar()
    order = np.array([scene.system.joint_names.index(joint) for joint in ("j1", "j2", "j3")])

    def along(scene, order, x):
        q, v = (jnp.zeros(3).at[order].set(y) for y in jd.scenes.four_bar.start(angle=x))
        return jd.constrained_dynamics(scene, q, v).acceleration[order]

    got, want = (
        jax.jit(jax.jacfwd(jax.jacrev(lambda x, s=s, order=order: along(s, order, x))))(jnp.asarray(1.0))
        for s, order in ((scene, order), (exact, np.arange(3)))
    )
    np.testing.assert_allclose(got, want, atol=10 * rounding * np.abs(want).max() + 1e-9)
    single = jax.tree.map(lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, scene)
    q, v = (jnp.zeros(3).at[order].set(y) for y in jd.scenes.four_bar.start())
    motion = jd.constrained_dynamics(single, q.astype(jnp.float32), v.astype(jnp.float32))
    assert int(motion.rank) == 2 and bool(motion.success)
    # Some thirty roundings of float32; the condition of A M^-1 A^T is 1.7.
    np.testing.assert_allclose(motion.acceleration, jd.constrained_dynamics(scene, q, v).acceleration, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("event", ["friction", "contact", "limit", "traced friction"])
def test_events_are_those_of_the_exact_mechanism(event, folder):
    """Friction of a hinge that slides and sticks, a contact of the crank with the ground, and the end of a joint's range."""
    times, found = jnp.linspace(0.0, 1.5, 4), []
    for scene, joints in (
        (pair("four_bar", 8, folder)[1][0], ("j1", "j2", "j3")),
        (jd.scenes.four_bar(), ("1", "2", "3")),
    ):
        order = np.array([scene.system.joint_names.index(joint) for joint in joints])
        q, v = (jnp.zeros(3).at[order].set(x) for x in jd.scenes.four_bar.start(angle=1.0, rate=-0.5))
        crank, system, options = int(order[0]), scene.system, {}
        forces = []
        if event == "contact":
            forces = [jd.contact.ground_contact(system.body_names[crank], (1.0, 0.0, 0.0), plane=GROUND)]
        elif event == "limit":
            lower = jnp.full(3, -jnp.inf).at[crank].set(0.7)
            system, options = (
                system.replace(lower=lower, upper=jnp.full(3, jnp.inf)),
                {"events": [jd.events.JointLimit()]},
            )
        else:
            forces = [jd.contact.DryFriction(0.4, 60.0, crank, static=0.6)]
        whole = jd.Scene(system, scene.constraints, forces)

        def run(q, v, whole=whole, options=options):
            return jd.simulate(whole, q, v, times, stepsize=within(1e-10), throw=False, **options)

        motion = (jax.jit(run) if event == "traced friction" else run)(q, v)
        found.append((motion.result, motion.q[:, order], motion.v[:, order], motion.stats["time_reached"]))
    (result, *got), (wanted, *want) = found
    assert result == wanted == (jd.RESULTS.joint_limit_passed if event == "limit" else jd.RESULTS.successful)
    for x, y in zip(got, want, strict=True):
        # Ten times the rounding of the file, and the errors of both runs.
        np.testing.assert_allclose(x, y, atol=1e-6)
