"""Forces that are smooth in pieces: motions and derivatives through their kinks and jumps against closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import slider
from motion_helpers import within
from scipy.optimize import brentq

import jaxdyn as jd

G, K, END = 9.81, 1e3, 0.5
X = jnp.asarray([0.5, -1.0])  # height above the stop (m) and velocity (m/s)


def mass(damping):
    model = slider(axis=(0, 0, 1), gravity=(0.0, 0.0, -G), lower=0.0, upper=np.inf)
    return jd.Scene(model, forces=[jd.forces.JointStops(K, damping)])


def thrown_back(x, damping):
    """Height and velocity at `END` of a mass of 1 kg that falls on its stop, closed form; the time of the way out by `brentq`."""

    def ahead(x):
        fall = (x[1] + jnp.sqrt(x[1] ** 2 + 2 * G * x[0])) / G
        half, rest = damping / 2, -G / K
        rate = jnp.sqrt(K - half**2)
        sine = (x[1] - G * fall - half * rest) / rate

        def z(t):
            return rest + jnp.exp(-half * t) * (-rest * jnp.cos(rate * t) + sine * jnp.sin(rate * t))

        return fall, z, jax.grad(z)

    def push(x, t):
        _, z, dz = ahead(x)
        return K * z(t) + damping * dz(t)

    known = jax.lax.stop_gradient(x)
    concrete = np.asarray(X)
    out = brentq(lambda t: float(push(concrete, t)), 1e-3, 4 / np.sqrt(K), xtol=1e-15)
    # The derivative of the root is that of one Newton step.
    out = out - (push(x, out) - push(known, out)) / jax.grad(push, 1)(known, out)
    fall, z, dz = ahead(x)
    left = END - fall - out
    return jnp.stack([z(out) + dz(out) * left - G * left**2 / 2, dz(out) - G * left])


def end(scene, x, **options):
    motion = jd.simulate(scene, x[:1], x[1:], jnp.asarray([0.0, 0.3, END]), **options)
    return jnp.concatenate([motion.q[-1], motion.v[-1]])


@pytest.mark.long
@pytest.mark.parametrize("damping", [0.0, 20.0])
def test_gradient_through_a_stop_is_that_of_the_closed_form(damping):
    """Ten times the tolerance, of derivatives up to 6; with damping the force jumps where the stop is met."""
    exact = jax.jacfwd(lambda x: thrown_back(x, damping))(X)
    steps = within(1e-8)
    slopes, last = jax.jacrev(lambda x: (end(mass(damping), x, stepsize=steps),) * 2, has_aux=True)(X)
    np.testing.assert_allclose(last, thrown_back(X, damping), atol=1e-7)
    np.testing.assert_allclose(slopes, exact, atol=1e-7 * np.abs(exact).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [{"stepsize": 1e-3}, {"adjoint": "forward"}, {"method": "free", "stepsize": jd.simulation.Steps(rtol=1e-9)}],
)
def test_gradient_through_a_stop_by_other_steps(options):
    """RK4 with 1 ms follows the spring's 32 rad/s to (0.03)^4."""
    exact = jax.jacfwd(lambda x: thrown_back(x, 20.0))(X)
    jacobian = jax.jacfwd if "adjoint" in options else jax.jacrev
    np.testing.assert_allclose(jacobian(lambda x: end(mass(20.0), x, **options))(X), exact, atol=1e-6)


@pytest.mark.parametrize("adjoint", ["reverse", pytest.param("forward", marks=pytest.mark.slow)])
def test_gradient_through_a_stop_that_is_met_at_a_save_point(adjoint):
    """To rounding at 0.5 s; half a period of the spring later the body goes back with the velocity v that it had."""
    scene = jd.Scene(slider(2.0, lower=-np.inf, upper=0.2), forces=[jd.forces.JointStops(200.0, 0.0)])

    def places(v):
        return jd.simulate(scene, jnp.zeros(1), v[None], jnp.asarray([0.0, 0.5, 1.0]), adjoint=adjoint).q[1:, 0]

    v, half = jnp.asarray(0.4), np.pi / 10
    derivative = jax.jacfwd if adjoint == "forward" else jax.jacrev
    jacobian, reached = derivative(lambda v: (places(v),) * 2, has_aux=True)(v)
    np.testing.assert_allclose(reached, [0.5 * v, 0.4 - v * (1 - half)], atol=1e-8)
    np.testing.assert_allclose(jacobian, [0.5, half - 1], atol=1e-7)


@pytest.mark.slow
def test_gradient_of_steps_through_a_stop():
    """RK4 with 5 ms, which ends at the stop: to (0.16)^4 / 120 of the derivatives, up to 6."""
    exact = jax.jacfwd(lambda x: thrown_back(x, 20.0))(X)
    step = jd.stepper(mass(20.0), 5e-3)

    def run(x):
        (q, v), _ = jax.lax.scan(lambda s, _: (step(s, jnp.zeros(1)), None), (x[:1], x[1:]), None, length=100)
        return jnp.concatenate([q, v])

    np.testing.assert_allclose(run(X), thrown_back(X, 20.0), atol=5e-5)
    np.testing.assert_allclose(jax.jacrev(run)(X), exact, atol=5e-5)


BLOCK = jd.LagrangianSystem(lambda q, v: 0.5 * v @ v, 1)


def spring(q, v, t):
    return -4.0 * q


@pytest.mark.long
def test_gradient_through_a_limit_of_effort():
    """A spring of 4 N/m by a motor of at most 2 N: a parabola from 1 m to 0.5 m, then a cosine of 2 rad/s."""

    def run(x):
        scene = jd.Scene(BLOCK, forces=[jd.forces.EffortLimits(x[1])])
        return jd.simulate(scene, x[:1], [0.0], [0.0, 1.1], control=spring).q[-1, 0]

    def exact(x):
        edge = x[1] / 4
        reached = jnp.sqrt(2 * (x[0] - edge) / x[1])
        left = 1.1 - reached
        return edge * jnp.cos(2 * left) - x[1] * reached / 2 * jnp.sin(2 * left)

    x = jnp.asarray([1.0, 2.0])
    value, slopes = jax.value_and_grad(run)(x)
    np.testing.assert_allclose(value, exact(x), atol=1e-7)
    np.testing.assert_allclose(slopes, jax.grad(exact)(x), atol=1e-7)


class Backlash(jd.forces.PiecewiseForce):
    stiffness: jax.Array
    play: jax.Array

    def guards(self, system, q, v, t):
        return jnp.stack([q[0] - self.play, -q[0] - self.play])

    def force(self, system, q, v, t, positive):
        beyond = jnp.where(positive[0], q[0] - self.play, jnp.where(positive[1], q[0] + self.play, 0.0))
        return jnp.zeros_like(v).at[0].set(-self.stiffness * beyond)


@pytest.mark.slow
def test_gradient_of_a_spring_with_play():
    """A quarter of a period to where the spring lets go, and on at a constant velocity; by the play and the stiffness."""

    def run(x):
        return jd.simulate(jd.Scene(BLOCK, forces=[Backlash(x[0], x[1])]), x[2:], [0.0], [0.0, 0.25]).q[-1, 0]

    def exact(x):
        rate = jnp.sqrt(x[0])
        return x[1] - (x[2] - x[1]) * rate * (0.25 - jnp.pi / (2 * rate))

    x = jnp.asarray([100.0, 0.2, 0.5])
    value, slopes = jax.value_and_grad(run)(x)
    np.testing.assert_allclose(value, exact(x), atol=1e-8)
    np.testing.assert_allclose(slopes, jax.grad(exact)(x), atol=1e-7)


@pytest.mark.long
def test_derivatives_across_kinks_are_refused_where_steps_cannot_end_there():
    """Implicit steps are not cut; their motion is right, their derivative would lack what the time of the stop adds."""
    options = {"solver": diffrax.Kvaerno3(), "stepsize": within(1e-6)}
    np.testing.assert_allclose(end(mass(20.0), X, **options), thrown_back(X, 20.0), atol=1e-4)
    with pytest.raises(ValueError, match=r"PiecewiseForce.*Kvaerno3.*Dopri8"):
        jax.jacrev(lambda x: end(mass(20.0), x, **options))(X)


def falling(e):
    system = jd.LagrangianSystem(lambda q, v: 0.5 * v @ v - G * q[0], 1)
    return jd.Scene(system, forces=[jd.contact.gap_contact(lambda q, t: q[0], restitution=e, name="floor")])


@pytest.mark.long
def test_impact_at_the_start_is_an_event_and_a_refused_start_has_none():
    ts = jnp.asarray([0.0, 0.05, 0.15])
    motion = jax.jit(lambda q: jd.simulate(falling(0.5), q, jnp.asarray([-1.0]), ts))
    struck = motion(jnp.zeros(1))
    assert struck.success and struck.events.name[0] == "floor: touch" and struck.events.time[0] == 0.0
    np.testing.assert_allclose(struck.events.time[1], 1.0 / G, rtol=1e-12)  # up with half of 1 m/s
    np.testing.assert_allclose(struck.v[1, 0], 0.5 - 0.05 * G, rtol=1e-12)
    for bad in (jnp.nan, -1.0):
        refused = motion(jnp.full(1, bad))
        assert not refused.success and int(refused.events.count) == 0 and np.isnan(refused.events.time).all()


@pytest.mark.slow
def test_float32_bounces_to_rest():
    """The last impact of a ball is at t (1 + e) / (1 - e) after a fall of t; a rebound below eps^0.3, 8e-3 m/s, is none."""
    with jax.enable_x64(False):
        ts, heights = jnp.linspace(0.0, 3.0, 7), jnp.linspace(0.3, 1.2, 8)[:, None]
        motion = jax.vmap(lambda q: jd.simulate(falling(0.5), q, jnp.zeros(1), ts, throw=False))(heights)
        assert motion.q.dtype == jnp.float32 and motion.success.all() and not np.isnan(motion.q).any()
        last = np.nanmax(np.asarray(motion.events.time), 1)
        np.testing.assert_allclose(last, 3 * np.sqrt(2 * np.asarray(heights)[:, 0] / G), atol=5e-3)
        np.testing.assert_allclose(motion.q[:, -1], 0.0, atol=1e-5)
        np.testing.assert_array_equal(motion.v[:, -1], 0.0)


@pytest.mark.long
def test_friction_under_a_negative_normal_force_drives_nothing():
    for make in (lambda n: jd.contact.DryFriction(0.5, normal=n), lambda n: jd.forces.SlidingFriction(0.5, n, 1)):
        with pytest.raises(ValueError, match=r"normal is -1\.0"):
            make(-1.0)
    with pytest.raises(ValueError, match="coefficient"):
        jd.forces.SlidingFriction(np.asarray(-0.5), 1.0, 1)
    q, v = jnp.zeros(1), jnp.ones(1)
    pulls = jax.jit(lambda n: jd.forces.SlidingFriction(0.5, n, 1)(BLOCK, q, v, 0.0))
    np.testing.assert_array_equal(pulls(-1.0), [0.0])
    np.testing.assert_array_equal(pulls(2.0), [-1.0])
    given = jd.forces.SlidingFriction(0.5, lambda system, q, v, t: -1.0 - q[0], 1)
    np.testing.assert_array_equal(given(BLOCK, q, v, 0.0), [0.0])
    friction = jd.contact.DryFriction(0.5, normal=lambda system, q, v, t: jnp.asarray(-1.0), along=0)
    motion = jd.simulate(jd.Scene(BLOCK, forces=[friction]), q, v, [0.0, 1.0])
    np.testing.assert_allclose(motion.v[-1], 1.0, rtol=1e-12)
