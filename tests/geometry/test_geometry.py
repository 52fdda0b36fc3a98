"""Geometry of metrics against definitions and closed forms, immersions against multipliers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn import geometry

STATES = np.random.default_rng(4).normal(size=(4, 20, 3))


def bumpy(q):
    """A metric of R^3 without symmetries."""
    x, y, z = q
    root = jnp.stack([x * y, jnp.sin(z), x, 1 + y * y, jnp.cos(x * z), y, z, x + y, jnp.exp(0.3 * z)]).reshape(3, 3)
    return root @ root.T + jnp.eye(3)


FIELDS = (
    lambda q: jnp.stack([q[1] * q[2], jnp.sin(q[0]), q[0] ** 2]),
    lambda q: jnp.stack([jnp.cos(q[1]), q[0] * q[1], q[2]]),
    lambda q: jnp.stack([q[2], q[0], q[1] ** 2 + 1]),
)


def derivative(field, q, v):
    return jax.jvp(field, (q,), (v,))[1]


@quick
@jax.vmap
def levi_civita(q, v, w):
    X, Y, Z = FIELDS
    g, second = bumpy(q), geometry.christoffel_symbols(bumpy, q)
    across = lambda of, along: geometry.covariant_derivative(bumpy, of, q, along(q))  # noqa: E731
    inner = lambda q: jnp.sum(Y(q) * geometry.flat(bumpy, q, Z(q)))  # noqa: E731
    pairs = {
        "torsion": (across(Y, X) - across(X, Y), derivative(Y, q, X(q)) - derivative(X, q, Y(q))),
        "compatible": (
            jnp.sum(across(Y, X) * (g @ Z(q))) + jnp.sum(across(Z, X) * (g @ Y(q))),
            derivative(inner, q, X(q)),
        ),
        "sharp": (geometry.sharp(bumpy, q, geometry.flat(bumpy, q, v)), v),
        "kinds": (jnp.einsum("il,ljk->ijk", g, second), geometry.christoffel_symbols(bumpy, q, "first")),
        "connection": (geometry.connection(bumpy, q, v, w), jnp.einsum("ijk,j,k->i", second, v, w)),
    }
    # R(X, Y) Z by its definition, as derivatives of fields.
    along = lambda of, by: lambda q: geometry.covariant_derivative(bumpy, of, q, by(q))  # noqa: E731
    bracket = lambda q: derivative(Y, q, X(q)) - derivative(X, q, Y(q))  # noqa: E731
    twice = across(along(Z, Y), X) - across(along(Z, X), Y) - across(Z, bracket)
    R = geometry.riemann_tensor(bumpy, q)
    low = jnp.einsum("im,mjkl->ijkl", g, R)
    pairs |= {
        "curvature": (jnp.einsum("ijkl,j,k,l->i", R, Z(q), X(q), Y(q)), twice),
        "pairs of indices": (low, low.transpose(2, 3, 0, 1)),
        "first pair": (low, -low.transpose(1, 0, 2, 3)),
        "Bianchi": (R + R.transpose(0, 2, 3, 1), -R.transpose(0, 3, 1, 2)),
    }
    rest = jnp.zeros(())
    lagrangian = jd.LagrangianSystem(lambda q, v: 0.5 * jnp.sum(v * (bumpy(q) @ v)), 3)
    metric = jd.MetricSystem(bumpy, 3)
    pairs |= {
        "geodesic": (geometry.geodesic_acceleration(bumpy, q, v), jd.forward_dynamics(lagrangian, q, v, 0 * v)),
        "bias": (metric.bias_force(q, v, rest), lagrangian.bias_force(q, v, rest)),
        "system": (
            geometry.christoffel_symbols(metric, q, "first"),
            geometry.christoffel_symbols(lagrangian, q, "first"),
        ),
        "of a system": (geometry.connection(metric, q, v, w), geometry.connection(bumpy, q, v, w)),
        "energy": (metric.kinetic_energy(q, v, rest), lagrangian.kinetic_energy(q, v, rest)),
    }
    return pairs


@pytest.mark.long
def test_connection_of_levi_civita():
    """No torsion, constant metric; curvature by its definition, with its symmetries; geodesics by Euler-Lagrange."""
    q, v, w, _ = (jnp.asarray(x) for x in STATES)
    for name, (got, want) in levi_civita(q, v, w).items():
        assert_close(got, want, 1e-11, name)


def sphere(q, radius=1.7):
    s, c = jnp.sin(q), jnp.cos(q)
    return radius * jnp.stack([s[0] * c[1], s[0] * s[1], -c[0]])


def torus(q, large=2.0, small=0.6):
    out = large + small * jnp.cos(q[0])
    return jnp.stack([out * jnp.cos(q[1]), out * jnp.sin(q[1]), small * jnp.sin(q[0])])


@pytest.mark.long
def test_surfaces_have_their_curvature():
    """Sphere, torus, plane in polar coordinates, hyperbolic plane; embedded ones by pull-back of the flat metric."""
    flat = lambda x: jnp.eye(x.shape[0])  # noqa: E731
    polar = lambda q: q[0] * jnp.stack([jnp.cos(q[1]), jnp.sin(q[1])])  # noqa: E731
    metrics = {
        "sphere": (jd.geometry.pull_back(flat, sphere), lambda q: 1 / 1.7**2 + 0 * q[0]),
        "torus": (jd.geometry.pull_back(flat, torus), lambda q: jnp.cos(q[0]) / (0.6 * (2 + 0.6 * jnp.cos(q[0])))),
        "plane": (jd.geometry.pull_back(flat, polar), lambda q: 0 * q[0]),
        "hyperbolic": (lambda q: jnp.eye(2) / q[1] ** 2, lambda q: -1 + 0 * q[0]),
    }
    u, w = jnp.asarray([0.3, 1.1]), jnp.asarray([-0.8, 0.4])
    q = jnp.asarray(np.random.default_rng(2).uniform(0.5, 1.4, (20, 2)))

    @quick
    @jax.vmap
    def compute(q):
        curvatures = {n: (geometry.sectional_curvature(m, q, u, w), k(q)) for n, (m, k) in metrics.items()}
        return curvatures, geometry.christoffel_symbols(metrics["sphere"][0], q)

    computed, on_sphere = compute(q)
    for name, (got, want) in computed.items():
        assert_close(got, want, 1e-11, name)
    s, c = np.sin(q[0, 0]), np.cos(q[0, 0])
    symbols = np.zeros((2, 2, 2))
    symbols[0, 1, 1], symbols[1, 0, 1], symbols[1, 1, 0] = -s * c, c / s, c / s
    assert_close(on_sphere[0], symbols, 1e-13)


def test_covariant_rate_is_the_tangent_part_of_the_rate_in_space():
    """Gauss: on a surface Dw/dt is what a rate in the surrounding space leaves in the tangent plane."""
    metric = jd.geometry.pull_back(lambda x: jnp.eye(3), torus)

    @quick
    @jax.vmap
    def both(q, v, w, rate):
        q, v, w, rate = q[:2], v[:2], w[:2], rate[:2]
        J = jax.jacfwd(torus)(q)
        _, space = jax.jvp(lambda q: jax.jacfwd(torus)(q) @ w, (q,), (v,))
        tangent = jnp.linalg.solve(J.T @ J, J.T @ (space + J @ rate))
        return geometry.covariant_rate(metric, q, v, w, rate), tangent

    got, want = both(*(jnp.asarray(x) for x in STATES))
    assert_close(got, want, 1e-11)


def test_pull_back_of_functions_forms_and_tensors():
    third = lambda x: jnp.einsum("i,j,k->ijk", x, x**2, jnp.cos(x))  # noqa: E731
    s, v = jnp.asarray([0.7, -0.4]), jnp.asarray([1.2, 0.3])

    @quick
    def compute(s):
        pulled = [jd.geometry.pull_back(f, torus)(s) for f in (lambda x: x[2], jnp.sin, third)]
        return torus(s), jax.jacfwd(torus)(s), *pulled

    x, J, height, form, tensor = (np.asarray(x) for x in compute(s))
    v, speed = np.asarray(v), J @ np.asarray(v)
    assert_close(height, x[2], 1e-14)
    assert_close(form @ v, np.sin(x) @ speed, 1e-13)  # power
    assert_close(np.einsum("ijk,i,j,k", tensor, v, v, v), (x @ speed) * (x**2 @ speed) * (np.cos(x) @ speed), 1e-13)


class Hoop(eqx.Module):
    """A hoop that turns about the vertical at a rate: a moving immersion."""

    radius: jax.Array
    rate: jax.Array

    def __call__(self, s, t):
        turn, (a,) = self.rate * t, s
        return self.radius * jnp.stack([jnp.sin(a) * jnp.cos(turn), jnp.sin(a) * jnp.sin(turn), -jnp.cos(a)])


def in_gravity(q, v):
    return 0.5 * 1.3 * jnp.sum(v * v) - 1.3 * 9.81 * q[2]


def drag(system, q, v, t):
    return -0.4 * v * jnp.sqrt(jnp.sum(v * v))


def on_torus(q, t):
    return (jnp.sqrt(q[0] ** 2 + q[1] ** 2) - 2.0) ** 2 + q[2] ** 2 - 0.36


def test_immersion_equals_multipliers():
    """A particle on a torus with drag and a given force: the same motion, and A^T lam is the reaction."""
    particle = jd.LagrangianSystem(in_gravity, 3)
    immersed = jd.geometry.constrain_by_immersion(jd.Scene(particle, forces=(drag,)), torus, 2)
    held = jd.Scene(particle, (jd.Holonomic(on_torus),), (drag,))

    @quick
    @jax.vmap
    def both(s, v, force):
        s, v = s[:2], v[:2]
        J = jax.jacfwd(torus)(s)
        a = jd.constrained_dynamics(immersed, s, v, J.T @ force).acceleration
        curve = lambda s, v: jax.jvp(torus, (s,), (v,))  # noqa: E731
        (q, speed), (_, whole) = jax.jvp(curve, (s, v), (v, a))
        other = jd.constrained_dynamics(held, q, speed, force)
        reaction = jd.geometry.reaction_force(immersed, s, v, force)
        A = jax.grad(on_torus)(q, 0.0)
        energies = [jd.kinetic_energy(of, *at) for of, at in ((immersed.system, (s, v)), (particle, (q, speed)))]
        return {
            "acceleration": (whole, other.acceleration),
            "reaction": (reaction, A * other.multipliers),
            # Beside 1 N m, as reactions of some 10 N leave rounding errors of 1e-14 of them.
            "work": (1 + J.T @ reaction, jnp.ones(2)),
            "kinetic": tuple(energies),
            "potential": (jd.potential_energy(immersed.system, s), 1.3 * 9.81 * q[2]),
            "gravity": (jd.gravity_force(immersed.system, s), 1.3 * 9.81 * J[2]),
            "coriolis": (
                jd.coriolis_matrix(immersed.system, s, v) @ v + jd.gravity_force(immersed.system, s),
                jd.bias_force(immersed.system, s, v),
            ),
            "metric": (
                jd.mass_matrix(immersed.system, s),
                jd.geometry.pull_back(lambda x: jd.mass_matrix(particle, x), torus)(s),
            ),
        }

    for name, (got, want) in both(*(jnp.asarray(x) for x in STATES[:3])).items():
        assert_close(got, want, 1e-11, name)


def helix(s):
    """Pose of a body that slides along a helix and turns with it, (x, y, z, quaternion)."""
    half, zero = s[0] / 2, jnp.zeros_like(s[0])
    return jnp.stack([jnp.cos(s[0]), jnp.sin(s[0]), 0.3 * s[0], jnp.cos(half), zero, zero, jnp.sin(half)])


def on_helix(q, t):
    angle = q[2] / 0.3
    turned = q[3] * jnp.sin(angle / 2) - q[6] * jnp.cos(angle / 2)
    return jnp.stack([q[0] - jnp.cos(angle), q[1] - jnp.sin(angle), q[4], q[5], turned])


@pytest.mark.long
def test_immersion_of_a_body_with_a_quaternion_equals_multipliers():
    """A body off its centre of mass on a helix, damped: velocities are body twists and not rates of coordinates."""
    builder = jd.ModelBuilder("nut")
    builder.add_body("nut", None, "free", (1.3, (0.1, -0.2, 0.05), (1.0, 2.0, 2.5)))
    model, damping = builder.build(), (jd.forces.JointDamping(0.4),)
    immersed = jd.geometry.constrain_by_immersion(jd.Scene(model, forces=damping), helix, 1)
    held = jd.Scene(model, (jd.Holonomic(on_helix),), damping)

    @quick
    @jax.vmap
    def both(s, v):
        s, v, t = s[:1], v[:1], jnp.zeros(())
        system = immersed.system
        (twist,), (rate,) = system.velocities(s, v, t), jax.jvp(helix, (s,), (v,))[1:]
        a = jd.constrained_dynamics(immersed, s, v).acceleration
        (whole,) = jax.jvp(lambda s, v: system.velocities(s, v, t), (s, v), (v, a))[1]
        other = jd.constrained_dynamics(held, helix(s), twist)
        return {
            "rate": (jd.configuration_rate(model, helix(s), twist), rate),
            "acceleration": (whole, other.acceleration),
            "reaction": (
                jd.geometry.reaction_force(immersed, s, v),
                jd.constraint_jacobian(held, helix(s)).T @ other.multipliers,
            ),
        }

    for name, (got, want) in both(*(jnp.asarray(x) for x in STATES[:2])).items():
        assert_close(got, want, 1e-11, name)


def test_moving_immersion_is_a_bead_on_a_turning_hoop():
    """theta'' = w^2 sin cos - (g/r) sin; the moment that turns the hoop does the work by which the energy changes."""
    radius, rate = jnp.asarray(0.8), jnp.asarray(3.0)
    system = jd.geometry.constrain_by_immersion(jd.LagrangianSystem(in_gravity, 3), Hoop(radius, rate), 1, moving=True)

    @quick
    @jax.vmap
    def both(s, v, t):
        s, v, t = s[:1], v[:1], t[0]
        a = jd.forward_dynamics(system, s, v, jnp.zeros(1), t)
        (angle,) = s
        want = rate**2 * jnp.sin(angle) * jnp.cos(angle) - 9.81 / radius * jnp.sin(angle)
        power = jax.jvp(
            lambda *state: jd.kinetic_energy(system, *state) + jd.potential_energy(system, state[0], state[2]),
            (s, v, t),
            (v, a, jnp.ones(())),
        )[1]
        _, across = jax.jvp(lambda t: Hoop(radius, rate)(s, t), (t,), (jnp.ones(()),))
        reaction = jd.geometry.reaction_force(system, s, v, t=t)
        return {"acceleration": (a[0], want), "power": (reaction @ across, power)}

    for name, (got, want) in both(*(jnp.asarray(x) for x in STATES[:3])).items():
        assert_close(got, want, 1e-11, name)


@pytest.mark.long
def test_geodesic_of_the_sphere_is_a_great_circle():
    """Simulated, in float64; and the acceleration in float32."""
    q0, v0, ts = jnp.asarray([1.1, 0.3]), jnp.asarray([0.4, 0.9]), jnp.asarray([0.0, 0.5, 1.0])
    system = jd.MetricSystem(jd.geometry.pull_back(lambda x: jnp.eye(3), sphere), 2)
    solution = jd.simulate(system, q0, v0, ts, stepsize=jd.simulation.Steps(rtol=1e-11, atol=1e-11))
    x, speed = jax.jvp(sphere, (q0,), (v0,))
    rate = jnp.sqrt(jnp.sum(speed * speed)) / 1.7
    circle = jnp.cos(rate * ts)[:, None] * x[None] + jnp.sin(rate * ts)[:, None] * (speed / rate)[None]
    assert_close(jax.vmap(sphere)(solution.q), circle, 1e-9)  # the tolerance of the steps, times their number
    half = quick(lambda q, v: jd.forward_dynamics(system, q, v, 0 * v))(*(x.astype(jnp.float32) for x in (q0, v0)))
    assert half.dtype == jnp.float32
    s, c = np.sin(1.1), np.cos(1.1)
    assert_close(half, [s * c * 0.9**2, -2 * c / s * 0.4 * 0.9], 1e-5)


def test_bad_immersions_and_metrics_are_refused():
    particle = jd.LagrangianSystem(in_gravity, 3)
    pole, one = jnp.asarray([0.0, 0.4]), jnp.ones(2)
    on_sphere = jd.geometry.constrain_by_immersion(particle, sphere, 2)
    with pytest.raises(ValueError, match=r"the immersion has rank 1 at s = \[0.0, 0.4\], expected 2"):
        jd.geometry.pull_back(bumpy, sphere)(pole)
    with pytest.raises(ValueError, match=r"the immersion has rank 1 at s = \[0.0, 0.4\], t = 0, expected 2"):
        jd.forward_dynamics(on_sphere, pole, one, one)
    with pytest.raises(ValueError, match=r"the immersion has rank 1 at s = \[0.0, 0.4\], t = 0, expected 2"):
        jd.simulate(on_sphere, pole, one, jnp.asarray([0.0, 1.0]))
    with pytest.raises(ValueError, match=r"xi returned shapes \[\(3,\)\], expected \[\(2,\)\]"):
        jd.mass_matrix(jd.geometry.constrain_by_immersion(jd.MetricSystem(lambda q: jnp.eye(2), 2), sphere, 2), one)
    with pytest.raises(ValueError, match="a scene has 1 constraints"):
        jd.geometry.constrain_by_immersion(jd.Scene(particle, (jd.Holonomic(on_torus),)), torus, 2)
    with pytest.raises(ValueError, match=r"field returned shape \(2, 2\), expected \(3, ...\)"):
        jd.geometry.pull_back(lambda x: jnp.eye(2), torus)(one)
    with pytest.raises(ValueError, match="nq is 0"):
        jd.geometry.constrain_by_immersion(particle, torus, 0)
    with pytest.raises(ValueError, match="forces or constraints in s, whose share in q is not known"):
        jd.geometry.reaction_force(jd.Scene(on_sphere, forces=(drag,)), one, one)
    with pytest.raises(ValueError, match="system is a LagrangianSystem"):
        jd.geometry.reaction_force(particle, jnp.ones(3), jnp.ones(3))
    with pytest.raises(ValueError, match="kind is 'third'"):
        geometry.christoffel_symbols(bumpy, jnp.ones(3), "third")
    with pytest.raises(ValueError, match=r"metric returned shape \(3, 3\), expected \(2, 2\)"):
        geometry.flat(Partial(lambda q: jnp.eye(3)), one, one)
    with pytest.raises(ValueError, match="metric is 3; pass a function"):
        geometry.flat(3, one, one)
