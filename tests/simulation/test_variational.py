"""Variational steps: order against closed forms, what they conserve, their symmetry, gradients, and what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick

import jaxdyn as jd
from jaxdyn import scenes
from jaxdyn.reports import references
from jaxdyn.simulation import variational
from jaxdyn.systems.system import displace, displacement

BODY = (1.2, (0.1, -0.2, 0.3), (0.3, 0.4, 0.5))


def tree(*joints, gravity=(0.0, 0.0, -9.81)):
    """A chain of bodies on the given joints."""
    builder, parent = jd.ModelBuilder("chain", gravity=gravity), None
    for i, joint in enumerate(joints):
        screw = {"axis": (0.6, 0.8, 0.0)} if joint in ("revolute", "prismatic") else {}
        builder.add_body(f"{i}", parent, joint, BODY, pose=(0.3, 0.2, -0.3), **screw)
        parent = f"{i}"
    return builder.build()


def advance(scene, q, p, h, v=None):
    """One step from momentum p: configuration, momentum, velocity, whether it was solved."""
    v = jnp.ones(scene.nv) if v is None else v
    start = variational.begin(scene, q, v, jnp.asarray(0.0), None)
    start = start if p is None else start._replace(momentum=p)
    computed = variational.make_step(scene, q, v, start, jnp.asarray(0.0), h, scene.applied_force, None)
    return computed.q, computed.carried.momentum, computed.v, computed.solved


def motions(scene, steps, outputs=("energy",)):
    """Motions at several steps, as one batch: a program of (q, v, ts)."""
    steps = jnp.asarray(steps)

    @quick
    def run(scene, q, v, ts):
        def one(h):
            return jd.simulate(scene, q, v, ts, method="variational", stepsize=h, outputs=outputs)

        return jax.vmap(one)(steps)

    return lambda q, v, ts: run(scene, q, v, jnp.asarray(ts))


CLOSED = {
    "free_body": (references.free_top, 4.0, 0.05),
    "pendulum_in_plane": (references.plane_pendulum, 2.0, 0.01),
    "rolling_disk": (references.upright_disk, 4.0, 0.05),
    "chaplygin_sleigh": (references.sleigh, 4.0, 0.05),
}


@pytest.fixture(scope="module")
def runs():
    """Programs of the scenes with a closed form, at steps h, h/2 and h/4."""
    made = {}

    def get(name):
        if name not in made:
            h = CLOSED[name][2]
            made[name] = motions(getattr(scenes, name)(), [h, h / 2, h / 4])
        return made[name]

    return get


FEW = [pytest.param(name, marks=[pytest.mark.slow] * (name != "pendulum_in_plane")) for name in CLOSED]


@pytest.mark.long
@pytest.mark.parametrize("name", FEW)
def test_order_two(name, runs):
    """At save points that no step ends on, with the dense output, and at the end of a clipped step."""
    reference, end, _ = CLOSED[name]
    ts = np.linspace(0.0, 0.987 * end, 12)
    exact = reference(ts)
    computed = runs(name)(*getattr(scenes, name).start(), ts)
    assert computed.success.all()
    errors = np.maximum(
        np.abs(np.asarray(computed.q) - exact.q).max((1, 2)), np.abs(np.asarray(computed.v) - exact.v).max((1, 2))
    )
    # Where save points lie within the steps changes the dense output's share, of the order h^3.
    np.testing.assert_allclose(np.log2(errors[0] / errors[2]) / 2, 2.0, atol=0.07)


@pytest.mark.slow
def test_momenta_are_conserved():
    """Two bodies, one of them floating, without gravity: total momentum about the world's origin, over 400 steps."""
    model = tree("free", "revolute", gravity=None)
    q, v = jd.random_configuration(model, jax.random.key(1)), jax.random.normal(jax.random.key(2), (7,))

    def total(q, v):
        own = jd.dynamics.centroidal_momentum(model, q, v)
        return own.at[3:].add(jnp.cross(jd.center_of_mass(model, q), own[:3]))

    @quick
    def run(q, v):
        def body(state, _):
            computed = variational.make_step(jd.Scene(model), *state, 0.0, jnp.asarray(0.05), lambda *_: None, None)
            return (computed.q, computed.v, computed.carried), (total(computed.q, computed.v), computed.solved)

        start = variational.begin(jd.Scene(model), q, v, 0.0, None)
        return total(q, v), jax.lax.scan(body, (q, v, start), length=400)[1]

    first, (momenta, solved) = run(q, v)
    assert solved.all()
    np.testing.assert_allclose(momenta, np.broadcast_to(first, momenta.shape), rtol=1e-12, atol=1e-12)


def _charge(q, v):
    """In a magnetic field that is not uniform, and a well: p is not M v."""
    return 0.5 * jnp.sum(v * v) + (1 + q[0] ** 2) * (q[0] * v[1] - q[1] * v[0]) - 0.5 * jnp.sum(q**4)


@pytest.mark.parametrize("system", [pytest.param("tree", marks=pytest.mark.slow), "magnetic"])
def test_steps_are_symplectic(system):
    """J^T Omega(p1) J = Omega(p0) in left-trivialised (q, p), Omega((e, s), (e', s')) = e s' - e' s + p [e, e']."""
    if system == "tree":
        system = tree("spherical", "prismatic")
        q, v = jd.random_configuration(system, jax.random.key(3)), jax.random.normal(jax.random.key(4), (4,))
    else:
        system, q, v = jd.LagrangianSystem(_charge, 2), jnp.array([0.4, -0.3]), jnp.array([0.7, 1.1])
    scene, n = jd.Scene(system), system.nv
    p = variational.begin(scene, q, v, jnp.asarray(0.0), None).momentum

    @quick
    def jacobian(q, p):
        def moved(z):
            q1, p1, _, solved = advance(scene, displace(system, q, z[:n]), p + z[n:], 0.1)
            return jnp.concatenate([displacement(system, jax.lax.stop_gradient(q1), q1), p1]), (p1, solved)

        return jax.jacfwd(moved, has_aux=True)(jnp.zeros(2 * n))

    def omega(p):
        brackets = np.zeros((n, n))
        if n == 4:
            brackets[:3, :3] = [[0, p[2], -p[1]], [-p[2], 0, p[0]], [p[1], -p[0], 0]]
        return np.block([[brackets, np.eye(n)], [-np.eye(n), np.zeros((n, n))]])

    J, (last, solved) = jacobian(q, p)
    assert solved
    np.testing.assert_allclose(J.T @ omega(np.asarray(last)) @ J, omega(np.asarray(p)), atol=1e-10)


@pytest.mark.slow
def test_a_step_back_returns():
    """A planar joint and a revolute one, with a row on positions and one on velocities."""
    constraints = (
        jd.Holonomic(lambda q, t: q[1] - 0.3 * jnp.sin(q[0])),
        jd.Pfaffian(lambda q, t: jnp.stack([jnp.zeros_like(q[0]), 0 * q[0], q[0], 1.0 + 0.2 * jnp.cos(q[2])])),
    )
    scene = jd.Scene(tree("planar", "revolute"), constraints)
    step = quick(lambda q, v, h: advance(scene, q, None, h, v))
    h = jnp.asarray(0.05)
    start, _, v, _ = step(jnp.array([0.4, 0.1, 0.7, -0.2]), jnp.array([1.0, 2.0, -3.0, 0.5]), h)  # on the constraints
    end, _, velocity, solved = step(start, v, h)
    back, _, first, returned = step(end, velocity, -h)
    assert solved and returned and float(jnp.abs(end - start).max()) > 0.02
    np.testing.assert_allclose(back, start, atol=1e-13)
    np.testing.assert_allclose(first, v, atol=1e-12)


@pytest.mark.parametrize("name", ["pendulum_in_plane", pytest.param("four_bar", marks=pytest.mark.slow)])
def test_rows_that_depend_on_each_other(name):
    """A rod given twice; a four-bar with all five rows of its joint, three of them dependent."""
    whole = getattr(scenes, name)()
    more = jd.Scene(whole.system, 2 * whole.constraints) if name != "four_bar" else scenes.four_bar(in_plane=False)
    ends = []
    for scene in (whole, more):
        step = quick(lambda q, v, scene=scene: advance(scene, q, None, 0.05, v))
        q, v = getattr(scenes, name).start()
        for _ in range(3):
            q, _, v, solved = step(q, v)
            assert solved
        ends.append(np.concatenate([q, v]))
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-12)


def test_a_loop_whose_angles_are_zero():
    """Short steps from rest where the zeros of the joints are: the rounding of a loop does not vanish with the angles."""
    scene, (q, v) = scenes.four_bar(), scenes.four_bar.start()
    homes = scene.system.home @ jax.vmap(jd.se3.exp)(jnp.zeros((3, 6)).at[:, 5].set(q))
    shifted = jd.Scene(scene.system.replace(home=homes), scene.constraints)
    step = quick(lambda scene, q, h: advance(scene, q, None, h, 0 * v))
    for h in (1e-4, 2e-4, 5e-4):
        expected, found = step(scene, q, jnp.asarray(h)), step(shifted, 0 * q, jnp.asarray(h))
        assert found[-1]
        np.testing.assert_allclose(found[0], expected[0] - q, atol=1e-14)


class _Field(eqx.Module):
    stiffness: jax.Array

    def __call__(self, system, q, v, t):
        return -self.stiffness * q - 0.3 * v + jnp.cos(t)


@pytest.mark.long
def test_forces():
    """Damped oscillator under a periodic force: order 2 against its closed form, and its work."""
    system = jd.LagrangianSystem(lambda q, v: 0.5 * v[0] ** 2, 1)
    k, c, v0, end = 4.0, 0.3, 0.7, 3.0
    run = motions(jd.Scene(system, forces=(_Field(jnp.asarray(k)),)), [0.08, 0.04, 0.02], ("work", "energy"))
    computed = run(jnp.array([0.5]), jnp.array([v0]), [0.0, end])
    forced = np.linalg.solve([[k - 1, c], [-c, k - 1]], [1.0, 0.0])  # of cos t and sin t
    w = np.sqrt(k - c * c / 4)
    a = 0.5 - forced[0]
    b = (v0 - forced[1] + c / 2 * a) / w
    free = np.exp(-c * end / 2) * (a * np.cos(w * end) + b * np.sin(w * end))
    errors = np.abs(np.asarray(computed.q)[:, -1, 0] - free - forced @ [np.cos(end), np.sin(end)])
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 2.0, atol=0.05)
    # For a constant mass the midpoint's balance of energy is exact.
    np.testing.assert_allclose(computed.work[:, -1], computed.energy[:, -1] - computed.energy[:, 0], atol=1e-13)


@pytest.mark.slow
def test_gradients():
    """Pendulum in the plane in a field: reverse mode against forward mode and differences, also in the field's number."""
    pendulum = scenes.pendulum_in_plane()

    def height(x, adjoint="reverse"):
        angle, scene = x[0], jd.Scene(pendulum.system, pendulum.constraints, (_Field(x[1] * jnp.array([1.0, 0.0])),))
        q, v = jnp.stack([jnp.sin(angle), -jnp.cos(angle)]), jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        ts = jnp.array([0.0, 0.3, 0.61])
        return jd.simulate(scene, q, v, ts, method="variational", stepsize=0.03, adjoint=adjoint).q[1:, 1].sum()

    x, d = jnp.array([0.4, 3.0]), 1e-5
    reverse = quick(jax.grad(height))(x)
    forward = quick(jax.jacfwd(lambda x: height(x, "forward")))(x)
    values = quick(jax.vmap(height))(x[None] + d * jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    np.testing.assert_allclose(reverse, (values[::2] - values[1::2]) / (2 * d), rtol=1e-7)  # half of the digits


@pytest.mark.slow
def test_slopes_of_a_lagrangian():
    """dL/dv and dL/dq of a tree of all joints by automatic differentiation; of one system given in three ways."""
    model = tree("free", "spherical", "planar", "revolute")
    q, v = jd.random_configuration(model, jax.random.key(5)), jax.random.normal(jax.random.key(6), (model.nv,))

    def lagrangian(v, shift):
        at = jd.integrate(model, q, shift)
        return jd.kinetic_energy(model, at, v) - jd.potential_energy(model, at)

    want = quick(jax.grad(lagrangian, (0, 1)))(v, jnp.zeros(model.nv))
    for got, expected in zip(
        quick(lambda q, v: variational._lagrangian_derivatives(model, q, v, 0.0))(q, v), want, strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11)

    mass = lambda q: jnp.diag(1 + q**2)  # noqa: E731
    potential = lambda q: jnp.sum(jnp.cos(q))  # noqa: E731
    systems = (
        jd.LagrangianSystem(lambda q, v: 0.5 * v @ mass(q) @ v - potential(q), 2),
        jd.MetricSystem(mass, 2, potential=potential),
        jd.ExplicitSystem(mass, lambda q, v: q * v * v - jnp.sin(q), 2),
    )
    q, v = jnp.array([0.3, -0.8]), jnp.array([1.1, 0.6])
    for system in systems:
        p, pull = variational._lagrangian_derivatives(system, q, v, jnp.asarray(0.0))
        np.testing.assert_allclose(p, (1 + q**2) * v, rtol=1e-12)
        np.testing.assert_allclose(pull, q * v * v + jnp.sin(q), rtol=1e-12)


@pytest.mark.slow
def test_float32(runs):
    """As exact as float64 up to rounding: 2e-4 after 800 steps, beside a method's error of 2e-4."""
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), scenes.pendulum_in_plane())
    q, v = scenes.pendulum_in_plane.start()
    ts = jnp.linspace(0.0, 2.0, 12)
    outputs = ("energy", "constraint_residual")
    run = quick(lambda q, v: jd.simulate(scene, q, v, ts, method="variational", stepsize=0.0025, outputs=outputs))
    computed = run(q, v)
    assert computed.success and computed.q.dtype == computed.v.dtype == computed.energy.dtype == jnp.float32
    np.testing.assert_allclose(computed.q, runs("pendulum_in_plane")(q, v, ts).q[2], atol=2e-4)
    assert float(computed.constraint_residual.max()) < 1e-5  # |v| is 4 m/s, its rounding 5e-7


def test_bad_input_is_refused():
    scene = scenes.pendulum_in_plane()
    state, ts = scenes.pendulum_in_plane.start(), [0.0, 1.0]
    cases = (
        ({}, "stepsize is None"),
        ({"stepsize": 0.01, "solver": jax}, "solver is module"),
        ({"stepsize": -1.0}, "stepsize is -1.0"),
        ({"stepsize": 0.01, "adjoint": "backsolve"}, "adjoint is 'backsolve'"),
    )
    for options, message in cases:
        with pytest.raises(ValueError, match=message):
            jd.simulate(scene, *state, ts, method="variational", **options)
    with pytest.raises(ValueError, match="rank_tol is 2"):
        jd.Variational(rank_tol=2.0)


@pytest.mark.long
def test_a_step_that_cannot_be_solved_ends_the_run():
    """Steps far too long for the rod: no point of the circle can be reached. Rows after that are NaN.

    The time reached is where that step began: the start, or the seventh step of 0.125 s if a push comes with it.
    """
    scene = scenes.pendulum_in_plane()
    q, v, ts = jnp.array([0.0, -1.0]), jnp.array([30.0, 0.0]), [0.0, 1.0, 2.0]
    with pytest.raises(RuntimeError, match="smaller stepsize"):
        jd.simulate(scene, q, v, ts, method=jd.Variational(), stepsize=0.5)
    solution = jd.simulate(scene, q, v, ts, method="variational", stepsize=0.5, throw=False)
    assert solution.result == jd.RESULTS.nonlinear_divergence and float(solution.stats["time_reached"]) == 0.0
    assert np.isnan(solution.q[1:]).all() and np.isfinite(solution.q[0]).all()

    def push(q, v, t):
        return jnp.where(t > 0.75, 1e4, 0.0) * jnp.array([1.0, 0.0])

    ts = [0.0, 0.5, 0.75, 1.0]
    solution = jd.simulate(scene, q, 0 * v, ts, method="variational", stepsize=0.125, control=push, throw=False)
    assert solution.result == jd.RESULTS.nonlinear_divergence and float(solution.stats["time_reached"]) == 0.75
    np.testing.assert_array_equal(np.isnan(solution.q[:, 0]), [False, False, False, True])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, stepsize, steps",
    [
        ("free_body", 0.05, 1e6),  # energy error 4.7108e-5 J in the first tenth, 4.7108e-5 J in the last one
        ("double_pendulum", 0.02, 1e6),  # 1.70e-3 J, 1.65e-3 J
        ("pendulum_in_plane", 0.01, 1e6),  # 3.6094e-3 J, 3.6094e-3 J
        ("four_bar", 0.02, 1e5),  # 0.13761 J, 0.13759 J
        ("suslov", 0.05, 1e5),  # 4.7739e-5 J, 4.7739e-5 J
    ],
)
def test_a_million_steps(name, stepsize, steps):
    """The energy error of the last tenth is that of the first one, and loops are closed. Mechanisms take fewer steps."""
    scene, (q, v) = getattr(scenes, name)(), getattr(scenes, name).start()
    ts = np.linspace(0.0, steps * stepsize, 20001)
    outputs = ("energy", "constraint_residual") if scene.constraints else ("energy",)
    solution = jd.simulate(scene, q, v, ts, method="variational", stepsize=stepsize, outputs=outputs)
    error = np.abs(np.asarray(solution.energy) - float(solution.energy[0]))
    print(name, error[:2001].max(), error[-2001:].max())
    assert error[-2001:].max() < 1.1 * error[:2001].max()
    if scene.constraints:
        assert float(solution.constraint_residual.max()) < 1e-12
