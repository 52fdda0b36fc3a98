"""Integrability against growth vectors of the literature, and spurious terms against the equations worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn import scenes


def free(count):
    """A particle in R^count."""
    return jd.LagrangianSystem(lambda q, v: 0.5 * jnp.sum(v * v), count)


@pytest.mark.slow
def test_growth_of_known_distributions():
    """Nonholonomic: disk 2, 3, 4, knife edge 2, 3. Integrable: a loop, x dy + y dx, a gear between two angles."""
    place = jnp.asarray([0.3, -0.2, 0.7, 0.4])
    assert jd.reduction.involutive(scenes.rolling_disk(), place).ranks == (2, 3, 4)
    assert not jd.reduction.involutive(scenes.rolling_disk(), place).value
    edge = jd.Pfaffian(lambda q, t: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0 * t]))
    computed = jd.reduction.involutive(jd.Scene(free(3), (edge,)), place[:3])
    assert computed.ranks == (2, 3) and not computed.value
    # d(x y) = 0 times a factor that hides it, as a Pfaffian row.
    hidden = jd.Pfaffian(lambda q, t: jnp.exp(q[2]) * jnp.stack([q[1], q[0], 0.0 * t]))
    computed = jd.reduction.involutive(jd.Scene(free(3), (hidden,)), place[:3])
    assert computed.ranks == (2, 2) and computed.value
    gear = jd.Pfaffian(lambda q, t: jnp.stack([1.0 + 0 * t, -2.5 + 0 * t, 0 * t]))
    assert jd.reduction.involutive(jd.Scene(free(3), (gear,)), place[:3]).value
    assert jd.reduction.involutive(scenes.spherical_pendulum(), scenes.spherical_pendulum.start()[0]).ranks == (2, 2)
    # The rows of the leaning coin, of which the height is holonomic: growth of the disk and the lean.
    assert jd.reduction.involutive(scenes.rolling_coin(), scenes.rolling_coin.start()[0]).ranks == (3, 4, 5)
    # The singular values show how clear the answer is: [X, Y] of the edge has length 1.
    sizes = jd.reduction.involutive(jd.Scene(free(3), (edge,)), place[:3]).singular_values
    assert_close(sizes[0], [1.0, 1.0], 1e-12)
    assert_close(sizes[1], [1.0, 1.0, 1.0], 1e-12)


@pytest.mark.slow
def test_mixed_rows_count_the_holonomic_ones():
    """A knife edge and one integrable row in five coordinates: 3, 4, 4: of two rows one is holonomic."""

    def row(q, t):
        zero = 0.0 * t
        edge = jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), zero, zero, zero])
        level = jnp.stack([zero, zero, zero, 2 * q[3], zero])  # d(q3^2)
        tied = edge + level  # the rows only span the two forms
        return jnp.stack([tied, level - 0.5 * edge])

    computed = jd.reduction.involutive(jd.Scene(free(5), (jd.Pfaffian(row),)), jnp.asarray([0.1, 0.2, 0.5, 0.8, -0.3]))
    assert computed.ranks == (3, 4, 4) and not computed.value
    # A holonomic row added to the disk: it cannot climb, x^2 + y^2 = const. The growth stops one short.
    disk = scenes.rolling_disk()
    round_ = jd.Holonomic(lambda q, t: q[0] ** 2 + q[1] ** 2 - 1.0)
    both = jd.Scene(disk.system, (*disk.constraints, round_))
    computed = jd.reduction.involutive(both, jnp.asarray([0.6, 0.8, 0.3, 0.1]))
    assert computed.ranks[0] == 1 and computed.value  # one direction is left, and one field is always integrable


@pytest.mark.long
def test_prescribed_slip_is_part_of_the_test():
    """xdot = y in the plane: ker A = d/dy alone is integrable, the affine row is not; xdot = sin t is."""
    row = lambda q, t: jnp.stack([1.0 + 0 * t, 0 * t])  # noqa: E731
    place = jnp.asarray([0.2, 0.4])
    assert jd.reduction.involutive(jd.Scene(free(2), (jd.Pfaffian(row),)), place).ranks == (1, 1)
    assert jd.reduction.involutive(jd.Scene(free(2), (jd.Pfaffian(row, lambda q, t: q[1]),)), place).ranks == (1, 2)
    assert jd.reduction.involutive(
        jd.Scene(free(2), (jd.Pfaffian(row, lambda q, t: jnp.sin(t)),)), place, 0.3
    ).ranks == (1, 1)


@pytest.mark.long
def test_bodies_on_a_manifold():
    """A body on a ball joint that cannot spin about its own z axis turns about all three by 2, 3; about one only by 1, 1."""
    builder = jd.ModelBuilder("ball joint", gravity=None)
    builder.add_body("body", None, "spherical", (1.0, (0.0, 0.0, 0.0), (1.0, 2.0, 2.5)))
    model, q = builder.build(), jnp.asarray([0.8, 0.0, 0.6, 0.0])
    assert jd.reduction.involutive(jd.Scene(model, (jd.Pfaffian(lambda q, t: jnp.eye(3)[2]),)), q).ranks == (2, 3)
    assert jd.reduction.involutive(jd.Scene(model, (jd.Pfaffian(lambda q, t: jnp.eye(3)[:2]),)), q).ranks == (1, 1)


@pytest.mark.long
def test_brackets_end():
    """A threshold below rounding, brackets that are 1e12 times as long as the fields, and derivatives that are not finite."""
    edge = jd.Pfaffian(lambda q, t: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0 * t]))
    place = jnp.asarray([0.3, -0.2, 0.7])
    assert jd.reduction.involutive(jd.Scene(free(3), (edge,)), place, rank_tol=1e-300).ranks == (2, 3)
    # Two fields d/dx and a(x) d/dy + d/dz: the bracket a' d/dy is long, and the one after it longer.
    fast = jd.Pfaffian(lambda q, t: jnp.stack([0.0 * t, jnp.ones_like(t), -jnp.exp(25.0 * q[0])]))
    computed = jd.reduction.involutive(jd.Scene(free(3), (fast,)), jnp.asarray([1.0, 0.0, 0.0]))
    assert computed.ranks[-1] >= computed.ranks[0] and len(computed.ranks) <= 4
    kink = jd.Pfaffian(lambda q, t: jnp.stack([jnp.sqrt(jnp.abs(q[2])), jnp.ones_like(t), 0.0 * t]))
    with pytest.raises(ValueError, match="order 1 that"):
        jd.reduction.involutive(jd.Scene(free(3), (kink,)), place.at[2].set(0.0))


def trailers(theta):
    """A car and two trailers, hitched a metre ahead of their axles, with headings theta; q = (x, y of the last axle, theta)."""

    def rows(q, t):
        """No axle slips sideways: its speed is that of the last one and of the bars between them."""
        theta = q[2:]
        sideways = jnp.stack([jnp.sin(theta), -jnp.cos(theta)], 1)
        ahead = np.triu(np.ones((3, 3)), 1)
        return jnp.concatenate([sideways, -ahead * jnp.cos(theta[:, None] - theta[None])], 1)

    return jd.reduction.involutive(jd.Scene(free(5), (jd.Pfaffian(rows),)), jnp.asarray([0.1, 0.2, *theta]))


@pytest.mark.slow
def test_growth_of_trailers_at_right_angles():
    """Jean (1996): two trailers grow by 2, 3, 4, 5, but where the first is at right angles to the car by 2, 3, 4, 4, 5."""
    for theta, ranks in (
        ([0.3, 0.7, 0.9], (2, 3, 4, 5)),
        ([0.3, 0.7, 0.7 + np.pi / 2], (2, 3, 4, 5)),
        ([0.3, 0.3 + np.pi / 2, 0.9], (2, 3, 4, 4, 5)),
    ):
        computed = trailers(theta)
        assert computed.ranks == ranks and computed.complete and not computed.value
        assert len(computed.singular_values) == len(ranks)


def flat_to(order):
    """dz = y^n dx: of d/dx + y^n d/dz and d/dy the first bracket with a part along z at y = 0 is that of n times d/dy."""
    return jd.Scene(free(3), (jd.Pfaffian(lambda q, t: jnp.stack([-(q[1] ** order), 0 * t, 1 + 0 * t])),))


@pytest.mark.long
def test_growth_pauses_at_singular_places(monkeypatch):
    """In closed form: Martinet's distribution, and one that is integrable at z = 0 alone, where no motion leaves the plane."""
    place = jnp.asarray([0.3, 0.0, 0.1])
    computed = jd.reduction.involutive(flat_to(2), place)
    assert computed.ranks == (2, 2, 3) and computed.complete and not computed.value
    assert jd.reduction.involutive(flat_to(2), place.at[1].set(0.5)).ranks == (2, 3)
    plane = jd.Scene(free(3), (jd.Pfaffian(lambda q, t: jnp.stack([-q[1] * q[2], 0 * t, 1 + 0 * t])),))
    computed = jd.reduction.involutive(plane, jnp.asarray([0.3, 0.5, 0.0]))
    assert computed.ranks == (2, 2) and computed.complete and computed.value
    monkeypatch.setattr("jaxdyn.reduction.integrability._LEVELS", 2)
    computed = jd.reduction.involutive(flat_to(2), place)
    assert computed.ranks == (2, 2) and not computed.complete and not computed.value


def test_involutive_refuses():
    with pytest.raises(ValueError, match="no constraints"):
        jd.reduction.involutive(jd.Scene(free(2)), jnp.zeros(2))
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda q: jnp.asarray(jd.reduction.involutive(scenes.rolling_disk(), q).ranks))(jnp.zeros(4))


def test_spurious_terms_of_the_printed_example():
    """L = (r1'^2 + r2'^2 + s'^2)/2, s' = -r1 r2' (EQUATIONS section 6): numbers by hand, right and wrong."""
    scene = jd.Scene(free(3), (jd.Pfaffian(lambda q, t: jnp.stack([0 * t, q[0], 1.0 + 0 * t])),))
    q, nu = jnp.asarray([0.7, -0.4, 0.2]), jnp.asarray([1.1, 0.6])
    terms = jd.reduction.spurious_terms(scene, q, nu, independent=(0, 1))
    r1, (d1, d2) = 0.7, (1.1, 0.6)
    assert_close(terms.mass_matrix, np.diag([1.0, 1 + r1**2]), 1e-14)
    assert_close(terms.bias_force, [0.0, r1 * d1 * d2], 1e-14)
    assert_close(terms.wrong_bias_force, [-r1 * d2**2, 2 * r1 * d1 * d2], 1e-14)
    assert_close(terms.terms, [r1 * d2**2, -r1 * d1 * d2], 1e-14)
    assert_close(terms.acceleration, [0.0, -r1 * d1 * d2 / (1 + r1**2)], 1e-14)
    assert_close(terms.wrong_acceleration, [r1 * d2**2, -2 * r1 * d1 * d2 / (1 + r1**2)], 1e-14)


def sleigh(q, v):
    """Mass 1 at 0.3 ahead of the blade, moment 0.5; q = (x, y, theta) of the blade."""
    c, s = jnp.cos(q[2]), jnp.sin(q[2])
    com = v[0] - 0.3 * s * v[2], v[1] + 0.3 * c * v[2]
    return 0.5 * (com[0] ** 2 + com[1] ** 2) + 0.25 * v[2] ** 2


def blade(q, t):
    return jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0 * t])


@pytest.mark.long
def test_spurious_terms_of_the_sleigh():
    """Right: forward speed u with u' = a w^2, w' = -m a u w/(I + m a^2). Wrong: another motion, by terms worked out here.

    y' = tan(th) x': p = dL/dy', spurious = p (sec^2(th) x' w) against x' and -p sec^2(th) x' x' ... with the signs of E33.
    """
    scene = jd.Scene(jd.LagrangianSystem(sleigh, 3), (jd.Pfaffian(blade),))
    theta, u, w = 0.5, 0.8, 1.3
    c, s = np.cos(theta), np.sin(theta)
    q, tau = jnp.asarray([0.2, -0.1, theta]), jnp.asarray([0.1, 0.3, -0.2])
    terms = jd.reduction.spurious_terms(scene, q, jnp.asarray([u * c, w]), independent=(0, 2))
    # x' = u cos(th): x'' = u' cos(th) - u w sin(th).
    rates = 0.3 * w**2, -0.3 * u * w / (0.5 + 0.09)
    assert_close(terms.acceleration, [rates[0] * c - u * w * s, rates[1]], 1e-12)
    # a = (-tan, 0): a_x' - 0 = -sec^2 w;   -(da_x/dth) x' = sec^2 x'.
    p = u * s + 0.3 * c * w
    assert_close(terms.terms, [-p * w / c**2, p * u * c / c**2], 1e-12)
    assert_close(terms.bias_force - terms.wrong_bias_force, terms.terms, 1e-12)
    assert np.abs(terms.acceleration - terms.wrong_acceleration).max() > 0.5
    pushed = jd.reduction.spurious_terms(scene, q, jnp.asarray([u * c, w]), tau, independent=(0, 2))
    want = quick(lambda q, nu: jd.reduced_dynamics(scene, q, nu, tau, basis=(0, 2)).nu_rate)(q, jnp.asarray([u * c, w]))
    assert_close(pushed.acceleration, want, 1e-12)
    # What is spurious does no work: the wrong equations conserve the energy too, which is why they look right.
    assert abs(terms.terms @ np.array([u * c, w])) < 1e-12


@pytest.mark.slow
def test_no_spurious_terms():
    """Integrable rows, s = h(r), allow the substitution; so does, by accident, the upright disk."""
    curved = jd.Pfaffian(
        lambda q, t: jnp.stack([jnp.cos(q[0]) * q[1], jnp.sin(q[0]), 1.0 + 0 * t])
    )  # d(q1 sin q0 + q2)
    terms = jd.reduction.spurious_terms(
        jd.Scene(free(3), (curved,)), jnp.asarray([0.7, -0.4, 0.2]), jnp.asarray([1.1, 0.6]), independent=(0, 1)
    )
    assert np.abs(terms.bias_force).max() > 0.1
    np.testing.assert_allclose(terms.terms, 0, atol=1e-15)
    assert_close(terms.wrong_acceleration, terms.acceleration, 1e-13)
    q, v = scenes.rolling_disk.start(heading=0.7)
    terms = jd.reduction.spurious_terms(scenes.rolling_disk(), q, v[2:], independent=(2, 3))
    np.testing.assert_allclose(terms.terms, 0, atol=1e-15)


def test_spurious_terms_refuse():
    scene = jd.Scene(jd.LagrangianSystem(sleigh, 3), (jd.Pfaffian(blade),))
    with pytest.raises(ValueError, match="the eliminated coordinates"):
        jd.reduction.spurious_terms(scene, jnp.asarray([0.2, -0.1, 0.5]), jnp.ones(2), independent=(0, 1))
    with pytest.raises(ValueError, match="nu has shape"):
        jd.reduction.spurious_terms(scene, jnp.zeros(3), jnp.ones(1), independent=(0, 2))
    with pytest.raises(ValueError, match="give different indices"):
        jd.reduction.spurious_terms(scene, jnp.zeros(3), jnp.ones(2), independent=(0, 9))
    with pytest.raises(ValueError, match="nq = 7"):
        jd.reduction.spurious_terms(
            scenes.rolling_coin(), scenes.rolling_coin.start()[0], jnp.ones(3), independent=(0, 1, 2)
        )
