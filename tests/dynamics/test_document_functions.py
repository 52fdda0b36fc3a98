"""Quantities of the source documents: moving base, articulated bodies, centre-of-mass coordinates, Euler rates."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, make_model, quick, random_states, random_tree
from scipy.spatial.transform import Rotation

import jaxdyn as jd
from jaxdyn.model.topology import KINDS

SEQUENCES = ["".join(s) for s in itertools.product("xyz", repeat=3) if s[1] not in (s[0], s[2])]


@pytest.fixture(scope="module")
def fixed():
    """Chain of joints of one degree of freedom as leaves of the fixed base, and a motion of the base."""
    model = random_tree(41, ["revolute", "prismatic", "spherical", "helical"], armature=False)
    q, v, a = (x[0] for x in random_states(model, 1, 7)[:3])
    rng = np.random.default_rng(3)
    return model, q, v, a, jnp.asarray(rng.normal(size=6)), jnp.asarray(rng.normal(size=6))


def test_newton_euler_with_a_moving_base(fixed):
    """Against inverse dynamics of the same tree on a free body, which has a recursion and kinematics of its own."""
    model, q, v, a, V0, V0_rate = fixed
    free = random_tree_on_free_body(model)
    m = quick(lambda *x: jd.newton_euler_matrices(x[0], x[1], x[2], base_twist=x[3], base_twist_rate=x[4]))(
        model, q, v, V0, V0_rate
    )
    pose = jnp.asarray([0.0, 0, 0, 1, 0, 0, 0])
    tau = jd.inverse_dynamics(free, jnp.concatenate([pose, q]), jnp.concatenate([V0, v]), jnp.concatenate([V0_rate, a]))
    assert_close(m.mass_matrix @ a + m.bias_force, tau[6:], 1e-11)
    # The block equations as printed, with V_0.
    V = m.G @ (m.P0 @ m.V0 + m.xi @ v)
    assert_close(m.V, V, 1e-12)
    rates = m.G @ (m.xi @ a + m.P0 @ m.V0_dot + m.ad_xi @ m.P0 @ m.V0 + m.ad_xi @ m.Gamma @ V)
    forces = m.G.T @ (m.M @ rates + m.ad_V_T @ m.M @ V)
    assert_close(m.xi.T @ forces, tau[6:], 1e-11)


def random_tree_on_free_body(model):
    """The tree carried by a body on a free joint whose frame is the base frame."""
    return make_model(
        [-1, *(parent + 1 for parent in model.topology.parents)],
        np.concatenate([np.eye(4)[None], model.home]),
        np.concatenate([np.zeros((1, 6)), model.screws]),
        np.concatenate([np.asarray(jd.inertia.box(2.0, (0.2, 0.3, 0.4)))[None], model.inertias]),
        kinds=["free", *model.topology.kinds],
        gravity=np.asarray(model.gravity),
    )


@pytest.mark.usefixtures("as_users_have_it")
def test_a_base_at_rest_changes_nothing(fixed):
    model, q, v, *_ = fixed
    at_rest, given = (
        jd.newton_euler_matrices(model, q, v),
        jd.newton_euler_matrices(model, q, v, base_twist=jnp.zeros(6)),
    )
    jax.tree.map(np.testing.assert_array_equal, at_rest, given)
    assert_close(at_rest.bias_force, at_rest.C0 @ v + at_rest.phi, 1e-12)
    assert_close(at_rest.bias_force, jd.bias_force(model, q, v), 1e-12)
    with pytest.raises(ValueError, match="base_twist has shape"):
        jd.newton_euler_matrices(model, q, v, base_twist=[0, 0, 1])


@pytest.mark.long
@pytest.mark.parametrize("armature", [False, True])
def test_articulated_bodies(armature):
    """F_i = Mh_i Vdot_i + b_i in the motion, the block equation of section 5 or its pivots, and det M."""
    model = random_tree(5, list(KINDS), armature=armature)
    q, v, tau = (x[0] for x in random_states(model, 1, 9)[:3])
    external = jnp.asarray(np.random.default_rng(4).normal(size=(model.nb, 6)))
    bodies = quick(lambda m, *x: jd.dynamics.articulated_bodies(m, *x[:-1], external=x[-1]))(model, q, v, tau, external)
    a = jd.forward_dynamics(model, q, v, tau, external=external)
    m = jd.newton_euler_matrices(model, q, v)
    rates = m.G @ (m.xi @ a + m.P0 @ m.V0_dot + m.ad_xi @ m.Gamma @ m.V)
    transmitted = jd.dynamics.joint_wrench(model, q, v, a, external=external)
    got = np.einsum("bij,bj->bi", bodies.inertias, rates.reshape(-1, 6)) + bodies.biases
    assert_close(got, transmitted, 1e-10)
    assert_close(bodies.inertias, np.swapaxes(bodies.inertias, 1, 2), 1e-12)
    extra = np.zeros(model.nv) if model.armature is None else np.asarray(model.armature)
    pivots = []
    for i, part in enumerate(model.topology.v_slices):
        S = np.asarray(m.xi)[6 * i : 6 * i + 6, part]
        pivots.append(np.linalg.det(S.T @ np.asarray(bodies.inertias[i]) @ S + np.diag(extra[part])))
    assert_close(np.prod(pivots), np.linalg.det(jd.mass_matrix(model, q)), 1e-10)
    if not armature:
        G, xi, M = (np.asarray(x) for x in (m.Gamma, m.xi, m.M))
        block = np.zeros_like(M)
        for i, inertia in enumerate(np.asarray(bodies.inertias)):
            block[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = inertia
        D = xi.T @ block @ xi
        own = np.asarray(model.topology.dof_body)
        D = np.where(own[:, None] == own, D, 0.0)
        total = M + G.T @ block @ G - G.T @ block @ xi @ np.linalg.solve(D, xi.T @ block @ G)
        # Siblings couple in the products; the equation is that of the diagonal blocks.
        for i, inertia in enumerate(np.asarray(bodies.inertias)):
            assert_close(total[6 * i : 6 * i + 6, 6 * i : 6 * i + 6], inertia, 1e-10)


@pytest.mark.long
def test_articulated_bodies_in_batches_and_without_bodies():
    model = random_tree(6, ["free", "revolute", "prismatic"])
    q, v, tau = random_states(model, 3, 2)[:3]
    batch = quick(jax.vmap(jd.dynamics.articulated_bodies, (None, 0, 0, 0)))(model, q, v, tau)
    for i in range(3):
        one = jd.dynamics.articulated_bodies(model, q[i], v[i], tau[i])
        jax.tree.map(lambda x, y, i=i: assert_close(x[i], y, 1e-12), batch, one)
    none = jd.ModelBuilder("nothing").build()
    assert jd.dynamics.articulated_bodies(none, jnp.zeros(0), jnp.zeros(0), jnp.zeros(0)).inertias.shape == (0, 6, 6)


@pytest.fixture(scope="module")
def floating():
    model = random_tree(43, ["free", "revolute", "spherical", "prismatic", "revolute"], armature=False)
    q, v, tau = (x[0] for x in random_states(model, 1, 5)[:3])
    return model, q, v, tau, jd.dynamics.com_dynamics(model, q, v)


@pytest.mark.long
def test_centre_of_mass_coordinates_decouple(floating):
    """The block structure, gravity, the velocity of the centre of mass, and the accelerations of forward dynamics."""
    model, q, v, F, terms = floating
    T, X = np.asarray(terms.jacobian), np.asarray(terms.inverse)
    assert_close(T @ X, np.eye(model.nv), 1e-12)
    M = X.T @ np.asarray(jd.mass_matrix(model, q)) @ X
    assert_close(M[:3, :3], float(terms.mass) * np.eye(3), 1e-11)
    assert np.abs(M[:3, 3:]).max() < 1e-11
    assert_close(terms.mass_matrix, M[3:, 3:], 1e-12)
    weight = X.T @ np.asarray(jd.gravity_force(model, q))
    assert_close(weight[:3], -float(terms.mass) * np.asarray(model.gravity), 1e-11)
    assert np.abs(weight[3:]).max() < 1e-11
    rate = jd.configuration_rate(model, q, v)
    cdot = jax.jvp(lambda q: jd.center_of_mass(model, q), (q,), (rate,))[1]
    nu = T @ v
    assert_close(nu[:3], cdot, 1e-11)
    np.testing.assert_array_equal(nu[3:], v[3:])
    a = jd.forward_dynamics(model, q, v, F)
    nu_rate, force = T @ a + np.asarray(terms.jacobian_rate) @ v, X.T @ F
    assert_close(float(terms.mass) * nu_rate[:3], float(terms.mass) * np.asarray(model.gravity) + force[:3], 1e-10)
    assert_close(terms.mass_matrix @ nu_rate[3:] + terms.coriolis_matrix @ nu[3:], force[3:], 1e-10)


def test_centre_of_mass_coordinates_have_a_skew_rate_and_ignore_translation(floating):
    model, q, v, _, terms = floating
    flow = (jd.configuration_rate(model, q, v),)
    rate = jax.jvp(lambda q: jd.dynamics.com_dynamics(model, q, v).mass_matrix, (q,), flow)[1]
    C = terms.coriolis_matrix
    assert_close(C + C.T, rate, 1e-10)
    pushed = jd.dynamics.com_dynamics(model, q.at[:3].add(2.0), v.at[:3].add(-3.0))
    assert_close(pushed.mass_matrix, terms.mass_matrix, 1e-11)
    assert_close(pushed.coriolis_matrix, C, 1e-10)


@pytest.mark.long
def test_centre_of_mass_coordinates_in_batches_and_their_derivatives(floating):
    """A batch equals the samples, and the derivative in a mass equals the difference quotient."""
    model, *_ = floating
    q, v, _ = random_states(model, 2, 8)[:3]
    batch = quick(jax.vmap(jd.dynamics.com_dynamics, (None, 0, 0)))(model, q, v)
    for i in range(2):
        jax.tree.map(lambda x, y, i=i: assert_close(x[i], y, 1e-11), batch, jd.dynamics.com_dynamics(model, q[i], v[i]))

    def value(mass):
        terms = jd.dynamics.com_dynamics(model.replace(inertias=model.inertias.at[2, 0].set(mass)), q[0], v[0])
        return jnp.sum(terms.coriolis_matrix) + jnp.sum(terms.mass_matrix)

    mass, step = model.inertias[2, 0], 1e-4
    forward, reverse = quick(lambda m: (jax.jacfwd(value)(m), jax.grad(value)(m)))(mass)
    difference = (value(mass + step) - value(mass - step)) / (2 * step)
    assert_close(forward, reverse, 1e-10)
    # The error of a central difference is of order step^2, about 1e-8 of the derivative.
    assert_close(forward, difference, 1e-6)
    assert abs(forward) > 1e-3


def test_centre_of_mass_coordinates_of_one_body():
    """In closed form: M' is the moment of inertia about the centre of mass, C' omega = omega x (I omega)."""
    model = random_tree(8, ["free"], armature=False)
    q, v, _ = (x[0] for x in random_states(model, 1, 3)[:3])
    terms, (m, *_rest) = jd.dynamics.com_dynamics(model, q, v), np.asarray(model.inertias[0])
    spatial = np.asarray(jd.inertia.spatial_inertia(model.inertias[0]))
    c = np.asarray(model.inertias[0, 1:4]) / m
    hat = np.asarray(jd.so3.hat(jnp.asarray(c)))
    inertia = spatial[3:, 3:] + m * hat @ hat
    omega = np.asarray(v[3:])
    assert_close(terms.mass_matrix, inertia, 1e-11)
    assert_close(terms.coriolis_matrix @ omega, np.cross(omega, inertia @ omega), 1e-10)


def test_centre_of_mass_coordinates_refuse_other_trees():
    arm = jd.robots.chain(2)
    with pytest.raises(ValueError, match=r"the roots.*\(revolute\)"):
        jd.dynamics.com_dynamics(arm, jnp.zeros(2), jnp.zeros(2))
    model = random_tree(44, ["free", "revolute"])
    if model.armature is not None:
        heavy = model.replace(armature=jnp.ones(model.nv))
        with pytest.raises(ValueError, match="must be zero"):
            jd.dynamics.com_dynamics(heavy, jd.neutral(heavy), jnp.zeros(heavy.nv))


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_euler_rates_of_every_sequence(sequence):
    """Against SciPy's rotation, and against the derivative of the rotation along the rates."""
    angles, rates = jnp.asarray([0.4, 1.1, -0.3]), jnp.asarray([0.5, -0.8, 1.3])
    R, R_rate = jax.jvp(lambda x: jd.so3.euler_to_matrix(x, sequence), (angles,), (rates,))
    assert_close(R, Rotation.from_euler(sequence.upper(), np.asarray(angles)).as_matrix(), 1e-13)
    E, E_s = jd.so3.euler_body_jacobian(angles, sequence), jd.so3.euler_spatial_jacobian(angles, sequence)
    assert_close(jd.so3.hat(E @ rates), R.T @ R_rate, 1e-13)
    assert_close(jd.so3.hat(E_s @ rates), R_rate @ R.T, 1e-13)
    assert_close(R @ E, E_s, 1e-13)


@pytest.mark.long
def test_euler_rates_as_printed():
    """The closed forms of EQUATIONS section 12, for ZYZ, with errata E51 and E52; finite gradients at the pole."""
    phi, theta, psi = angles = jnp.asarray([0.4, 1.1, -0.3])
    (sf, cf), (st, ct), (sp, cp) = ((np.sin(x), np.cos(x)) for x in (phi, theta, psi))
    E = np.asarray(jd.so3.euler_body_jacobian(angles))
    assert_close(E, [[-st * cp, sp, 0], [st * sp, cp, 0], [ct, 0, 1]], 1e-14)
    assert_close(jd.so3.euler_spatial_jacobian(angles), [[0, -sf, st * cf], [0, cf, st * sf], [1, 0, ct]], 1e-14)
    assert_close(np.linalg.det(E), -st, 1e-14)
    printed = [[-cp / st, sp, cp * ct / st], [sp / st, cp, -sp * ct / st], [0, 0, 1]]
    assert_close(np.linalg.inv(E).T, printed, 1e-13)
    assert np.isfinite(jax.jacrev(jax.jacfwd(jd.so3.euler_body_jacobian))(jnp.zeros(3))).all()
    for wrong in ("zzy", "xy", "abc"):
        with pytest.raises(ValueError, match="sequence is"):
            jd.so3.euler_to_matrix(angles, wrong)
