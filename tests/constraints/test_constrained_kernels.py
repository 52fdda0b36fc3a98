"""Constrained dynamics in kernels: against the rank-aware solve, plain mode and the equations themselves; singular samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import largest_residuals
from pinocchio_bridge import assert_close, quick, random_states, random_tree

import jaxdyn as jd
from benchmarks.report_cases import test_set
from jaxdyn import scenes
from jaxdyn.constraints.base import rows
from jaxdyn.constraints.dynamics import solve_rows
from jaxdyn.simulation.methods import consistent
from jaxdyn.systems.system import retract

pytestmark = pytest.mark.native

POSE = ((0.1, -0.2, 0.3), (0.5, 0.2, -0.4))
OTHER = ((-0.3, 0.1, 0.2), (-0.2, 0.7, 0.3))
# A floating base carries three branches: the loops have bodies in common, one reaches the world, one its own ancestor.
KINDS = ("free", "revolute", "spherical", "helical", "planar", "revolute", "prismatic", "free")
PARENTS = (-1, 0, 1, 0, 0, 4, 3, 0)
JOINTS = {
    "few": (("b2", "b5", "revolute"), (None, "b6", "point")),
    "turning": (("b5", "b7", "prismatic"), ("b1", "b7", "universal"), ("b0", "b2", "planar")),
    "in plane": (("b3", "b7", "weld"),),
}
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("turning", "in plane")]


def mechanism(name):
    """A scene with loops that are open where the states are: the equations hold there as well."""
    bodies = 7 if name == "few" else 8  # none of whose loops is at the last one
    model = random_tree(5, KINDS[:bodies], parents=PARENTS[:bodies])
    loops = [jd.loop(a, POSE, b, OTHER, joint, in_plane=name == "in plane") for a, b, joint in JOINTS[name]]
    return jd.Scene(model, loops)


def dense(scene, q, v, tau, t=0.0):
    """The rank-aware solve."""
    return solve_rows(scene, q, v, tau, t, rows(scene, q, v, t))


def has_kernel(function, *args):
    return "jaxdyn_kernel" in jax.jit(function).lower(*args).as_text()


@pytest.fixture(scope="module", params=["few", *SLOW])
def solved(request):
    """Solutions at three states by both methods, and by the dense solve."""
    scene = mechanism(request.param)
    q, v, tau = random_states(scene.system, 3, 1)[:3]

    def computed(q, v, tau):
        return jd.constrained_dynamics(scene, q, v, tau), jd.constrained_dynamics(scene, q, v, tau, method="schur")

    program = quick(jax.vmap(computed)).lower(q, v, tau)
    assert "jaxdyn_kernel" in program.as_text()
    numbers = program.compile()(q, v, tau)
    with jd.compilation("plain"):
        return numbers, quick(jax.vmap(lambda *x: dense(scene, *x)))(q, v, tau)


@pytest.mark.long
def test_accelerations_and_multipliers_are_those_of_the_dense_solve(solved):
    numbers, want = solved
    for computed in numbers:
        # The rows' matrix squares the condition number of the rows, 1e3 at worst here.
        assert_close(computed.acceleration, want.acceleration, 1e-9)
        assert_close(computed.multipliers, want.multipliers, 1e-9)
        assert computed.rank.tolist() == want.rank.tolist() == [want.multipliers.shape[1]] * 3


# --- singular samples ---

# Uprights and couplers in one line: the rows of the windows lose rank.
FLAT = jnp.asarray([-np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, -np.pi / 2])


def two_windows():
    scene = scenes.windows(count=2)
    q0, v0 = scenes.windows.start(count=2)
    return scene, jnp.stack([q0, q0.at[0].add(0.1), q0 - 0.3, q0 + 0.2]), jnp.asarray(v0)


@pytest.mark.long
def test_a_singular_sample_is_solved_with_its_rank():
    scene, q, v0 = two_windows()

    def run(q):
        computed = jd.constrained_dynamics(scene, q, v0, jnp.zeros(5))
        return computed.acceleration, computed.multipliers, computed.rank

    def wanted(q):
        computed = dense(scene, q, v0, jnp.zeros(5))
        return computed.acceleration, computed.multipliers, computed.rank

    program = quick(jax.vmap(run))
    schur = jax.jit(
        jax.vmap(lambda q: jd.constrained_dynamics(scene, q, v0, jnp.zeros(5), method="schur").acceleration)
    )
    assert "lapack" not in schur.lower(q).as_text()  # no factorisation is called
    with_singular = q.at[1].set(FLAT)
    with jd.compilation("plain"):
        reference = quick(jax.vmap(wanted))
        for states in (q, with_singular):
            want = reference(states)
            for x, y in zip(program(states), want, strict=True):
                assert_close(x, y, 1e-10)
    assert program(q)[2].tolist() == [4, 4, 4, 4]
    assert program(with_singular)[2].tolist()[1] < 4
    alone = quick(run)
    for k in range(4):
        for x, y in zip(alone(with_singular[k]), want, strict=True):
            assert_close(x, y[k], 1e-10)


@pytest.mark.slow
def test_gradients_beside_a_singular_sample():
    scene, q, v0 = two_windows()
    q, turn, others = q.at[1].set(FLAT), jnp.cos(jnp.arange(5.0)), np.array([0, 2, 3])

    def pulled(solve):
        one = jax.grad(lambda q, tau: jnp.sum(turn * solve(scene, q, v0, tau).acceleration), (0, 1))
        return jax.jit(lambda: jax.vmap(one, (0, None))(q, jnp.zeros(5)))()

    computed = pulled(jd.constrained_dynamics)
    with jd.compilation("plain"):
        want = pulled(dense)
    for x, y in zip(computed, want, strict=True):
        assert_close(x[others], y[others], 1e-9)  # through normal equations the condition number is lost twice
        assert np.isfinite(np.asarray(x)).all()


@pytest.mark.long
@pytest.mark.parametrize("name", ["windows", *(pytest.param(x, marks=pytest.mark.slow) for x in ("few", "turning"))])
def test_residuals_of_open_loops(name):
    """Under nested `vmap`s, their derivatives, and the check of a motion's states, in both modes."""
    scene = scenes.windows() if name == "windows" else mechanism(name)
    states = [random_states(scene.system, 2, k) for k in range(3)]
    q, v = (jnp.stack([jnp.asarray(state[i]) for state in states]) for i in range(2))

    def computed():
        def one(q, v):
            return (
                largest_residuals(scene, q, v),
                jax.jacfwd(lambda v: largest_residuals(scene, q, v))(v),
                consistent(scene, q, v, 0.0),
            )

        return quick(jax.vmap(jax.vmap(one)))(q, v)

    by_kernels = computed()
    with jd.compilation("plain"):
        plain = computed()
    for x, y in zip(by_kernels, plain, strict=True):
        assert_close(x, y, 1e-12)
    assert not np.any(plain[2])


# --- systems of equations, and forces ---

NAMES = ("andrews", "car_axis", "rolling_disk", "chaplygin_sleigh", "rolling_coin", "pendulum_in_plane", "suslov")


def at_start(name):
    made = getattr(scenes, name, None) or getattr(test_set, name)
    q, v = (jnp.asarray(x, float) for x in made.start())
    return made(), q, v


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.slow] * (x not in ("andrews", "rolling_coin"))) for x in NAMES]
)
def test_systems_of_equations(name):
    """Accelerations, multipliers and derivatives, also off the constraints."""
    scene, q, v = at_start(name)
    tau, t = 0.3 * jnp.cos(jnp.arange(float(scene.nv))), jnp.asarray(0.2)
    q = retract(scene.system, q + 1e-3 * jnp.sin(jnp.arange(float(scene.nq)) + 1))
    along = jnp.sin(jnp.arange(float(scene.nv)) + 0.5)

    def dynamics(tau):
        return jd.constrained_dynamics(scene, q, v, tau, t)

    def everything(tau):
        slope = jax.jvp(lambda tau: dynamics(tau).acceleration, (tau,), (along,))[1]
        return dynamics(tau), slope, jax.jacrev(lambda tau: dynamics(tau).acceleration)(tau) @ along

    assert has_kernel(dynamics, tau)
    computed, *slopes = quick(everything)(tau)
    with jd.compilation("plain"):
        three = jnp.stack([tau, tau + along, tau - along])
        wanted = quick(jax.vmap(lambda tau: dense(scene, q, v, tau, t)))(three)
    for x, y in ((computed.acceleration, wanted.acceleration[0]), (computed.multipliers, wanted.multipliers[0])):
        np.testing.assert_allclose(x, y, atol=1e-10 * (1 + float(jnp.abs(y).max())), rtol=0)
    change = (wanted.acceleration[1] - wanted.acceleration[2]) / 2  # linear in tau
    for x in slopes:
        np.testing.assert_allclose(x, change, atol=1e-10 * (1 + float(jnp.abs(x).max())), rtol=0)


def test_dependent_rows_are_left_to_the_careful_way():
    """A row that is given twice: the kernel's pivots say so, and the multipliers are those of least norm."""
    scene, q, v = at_start("rolling_disk")
    twice = jd.Scene(scene.system, (*scene.constraints, *scene.constraints[:1]))
    dynamics, once = quick(lambda q, v: [jd.constrained_dynamics(x, q, v) for x in (twice, scene)])(q, v)
    wanted = quick(lambda q, v: dense(twice, q, v, 0 * v))(q, v)
    assert int(dynamics.rank) == 2
    np.testing.assert_allclose(dynamics.acceleration, wanted.acceleration, atol=1e-10)
    np.testing.assert_allclose(dynamics.multipliers, wanted.multipliers, atol=1e-10)
    np.testing.assert_allclose(dynamics.acceleration, once.acceleration, atol=1e-10)


heard: list = []


def spoken(system, q, v, t):
    jax.debug.callback(lambda v: heard.append(float(v[0])), v)
    jax.debug.callback(lambda: heard.append("again"))
    return 0.1 * v


def test_forces_with_effects_have_them_in_every_call():
    """A force that prints is no part of a kernel, and is not heard while it is traced."""
    heard.clear()
    scene, q, v = at_start("rolling_disk")
    loud = jd.Scene(scene.system, scene.constraints, (spoken,))
    run = jax.jit(lambda q, v: jd.constrained_dynamics(loud, q, v))
    assert not heard and "jaxdyn_kernel" in run.lower(q, v).as_text()  # the rest runs in one
    with jd.compilation("plain"):
        assert not has_kernel(lambda q, v: jd.constrained_dynamics(scene, q, v), q, v)
    for speed in (1.0, 2.0):
        computed = run(q, v.at[0].set(speed))
    jax.effects_barrier()
    assert sorted(map(str, heard)) == ["1.0", "2.0", "again", "again"]
    assert bool(jnp.isfinite(computed.acceleration).all())
