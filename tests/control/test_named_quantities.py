"""Quantities with names in the documents: A_ij of Property 2, Arnold's form B(c, a), the composite error and the gains K'."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import adjoint, assert_close, quick, random_states, random_tree
from scipy.linalg import expm
from test_constrained_control import circle, first_two

import jaxdyn as jd
from jaxdyn import scenes

KINDS = ["revolute", "prismatic", "helical", "continuous"]


def hat(xi):
    """Matrix (4, 4) of a twist, by numpy alone."""
    x, y, z = xi[3:]
    return np.block([[np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.reshape(xi[:3], (3, 1))], [np.zeros((1, 4))]])


def ad(xi):
    """Matrix (6, 6) of the bracket with a twist, by numpy alone."""
    turn, slide = hat(np.concatenate([np.zeros(3), xi[3:]]))[:3, :3], hat(np.concatenate([np.zeros(3), xi[:3]]))[:3, :3]
    return np.block([[turn, slide], [np.zeros((3, 3)), turn]])


@pytest.fixture(scope="module", params=[[-1, 0, 0, 2], [-1, 0, -1, 2]], ids=["tree", "forest"])
def tree(request):
    """A model, a configuration, and its base twists and adjoints."""
    model = random_tree(31, KINDS, parents=request.param, armature=False)
    q = random_states(model, 1, 3)[0][0]
    return model, q, *quick(lambda m, q: (jd.dynamics.base_twists(m), jd.dynamics.link_adjoints(m, q)))(model, q)


def test_adjoints_are_those_of_exponentials(tree):
    """The definition, with scipy's matrix exponential of the base twists."""
    model, q, xi, A = map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, tree)
    for i in range(model.nb):
        for j in range(model.nb):
            if not model.topology.ancestors[i, j]:
                np.testing.assert_array_equal(A[i, j], 0.0)
                continue
            between, body = np.eye(4), i
            while body != j:
                between, body = expm(hat(xi[body]) * q[body]) @ between, model.topology.parents[body]
            assert_close(A[i, j], np.linalg.inv(adjoint(between)), 1e-12)


def test_mass_matrix_and_its_derivative_follow(tree):
    """Property 2 with erratum E8, term by term, against crba's matrix and the closed form on recursions."""
    model, q, xi, A = tree[:2] + tuple(map(np.asarray, tree[2:]))
    home = jd.forward_kinematics(model, jd.neutral(model))
    n = model.nb
    back = [np.linalg.inv(adjoint(np.asarray(g))) for g in home]
    inertias = np.array(
        [b.T @ np.asarray(jd.inertia.spatial_inertia(p)) @ b for b, p in zip(back, model.inertias, strict=True)]
    )
    J = np.einsum("ljab,jb->lja", A, xi)  # columns A_lj xi_j of body l
    mass, derivative, automatic = quick(
        lambda q: (
            jd.mass_matrix(model, q),
            jd.dynamics.mass_matrix_derivative(model, q),
            jax.jacfwd(lambda q: jd.mass_matrix(model, q))(q),
        )
    )(q)
    assert_close(np.einsum("lia,lab,ljb->ij", J, inertias, J), mass, 1e-12)
    # d(A_lj xi_j)/dq_k = A_lk [A_kj xi_j, xi_k], for j at or above k: `J[k, j]` is zero for all others.
    brackets = np.array([[ad(J[k, j]) @ xi[k] for j in range(n)] for k in range(n)])
    dJ = np.einsum("lkab,kjb->klja", A, brackets)
    half = np.einsum("klia,lab,ljb->ijk", dJ, inertias, J)
    D = half + half.transpose(1, 0, 2)
    assert_close(derivative, D, 1e-12)
    assert_close(automatic, D, 1e-12)


def test_adjoints_compose_and_differentiate(tree):
    """A_ij A_jk = A_ik along a path; derivatives in q, forwards and backwards, by the formula of Property 2."""
    model, q, xi, A = tree
    last = model.nb - 1
    above = int(np.flatnonzero(model.topology.ancestors[last])[0])
    middle = model.topology.parents[last]
    assert_close(A[last, middle] @ A[middle, above], A[last, above], 1e-12)
    moved = lambda q: jd.dynamics.link_adjoints(model, q)[last, above] @ xi[above]  # noqa: E731
    forward, reverse = quick(lambda q: (jax.jacfwd(moved)(q), jax.jacrev(moved)(q)))(q)
    columns = [A[last, k] @ jd.se3.ad_apply(A[k, above] @ xi[above], xi[k]) for k in range(model.nb)]
    assert_close(forward, np.stack(columns, 1), 1e-12)
    assert_close(reverse, forward, 1e-12)


@pytest.mark.parametrize("kind", ["free", "spherical"])
def test_joints_of_several_freedoms(kind):
    """The body Jacobian of the last link from A_ij, with blocks of several base twists."""
    model = random_tree(5, [kind, "revolute"], parents=[-1, 0])
    q = random_states(model, 1, 4)[0][0]
    xi, A = jd.dynamics.base_twists(model), jd.dynamics.link_adjoints(model, q)
    home = jd.forward_kinematics(model, jd.neutral(model))
    J = np.stack([A[1, i] @ x for i, x in zip(model.topology.dof_body, xi, strict=True)], 1)
    want = jd.body_jacobian(model, q, model.body_names[1])
    mine = np.linalg.inv(adjoint(np.asarray(home[1]))) @ J
    # Base twists of a joint of several freedoms are those of its body: its own exponential leaves one twist alone fixed.
    assert_close(mine[:, -1], want[:, -1], 1e-12)
    own = np.linalg.inv(adjoint(np.asarray(home[0]))) @ np.stack([A[0, 0] @ x for x in xi[:-1]], 1)
    assert_close(own, jd.body_jacobian(model, q, model.body_names[0])[:, :-1], 1e-12)


def test_arnold_form_of_a_turning_body():
    """Its definition by brackets, the printed numbers of EQUATIONS section 3, and gradients."""
    inertia, omega = jnp.diag(jnp.asarray([1.0, 2.0, 3.0])), jnp.asarray([0.3, 0.5, -0.7])
    form = quick(jd.geometry.arnold_form)
    assert_close(form(inertia, omega, omega), [0.35, -0.21, -0.05], 1e-14)
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    inertia, (a, b, c) = jnp.asarray(root @ root.T + np.eye(3)), jnp.asarray(rng.normal(size=(3, 3)))
    B = np.asarray(form(inertia, c, a))
    # Bilinear, so that the derivatives are known; none is NaN at rest.
    slopes = quick(lambda *at: [d(jd.geometry.arnold_form, 2)(*at) for d in (jax.jacfwd, jax.jacrev)])
    forward, reverse = (np.asarray(x) for x in slopes(inertia, c, jnp.zeros(3)))
    inertia, a, b, c = (np.asarray(x) for x in (inertia, a, b, c))
    assert_close(B @ inertia @ b, np.cross(a, b) @ inertia @ c, 1e-12)
    assert_close(forward @ a, B, 1e-12)
    assert_close(forward, reverse, 1e-12)


def test_arnold_form_of_a_moving_body():
    """dV/dt = B(V, V) is the motion of a free body without gravity, about any point of it; the definition on se(3)."""
    model = random_tree(8, ["free"], armature=False)
    at_rest = jd.forward_dynamics(model, jd.neutral(model), jnp.zeros(6), jnp.zeros(6))
    V = jnp.asarray(np.random.default_rng(1).normal(size=6))
    inertia = jd.inertia.spatial_inertia(model.inertias[0])
    a = jd.forward_dynamics(model, jd.neutral(model), V, jnp.zeros(6))
    assert_close(jd.geometry.arnold_form(inertia, V, V), a - at_rest, 1e-11)
    b, c = jnp.asarray(np.random.default_rng(2).normal(size=(2, 6)))
    assert_close(jd.geometry.arnold_form(inertia, c, V) @ inertia @ b, jd.se3.ad_apply(V, b) @ inertia @ c, 1e-12)


@pytest.mark.usefixtures("as_users_have_it")
def test_arnold_form_refuses():
    eye = jnp.eye(3)
    with pytest.raises(ValueError, match="inertia has shape"):
        jd.geometry.arnold_form(jnp.eye(4), jnp.zeros(4), jnp.zeros(4))
    with pytest.raises(ValueError, match="a has shape"):
        jd.geometry.arnold_form(eye, jnp.zeros(3), jnp.zeros(6))
    form = jd.geometry.arnold_form([[2, 0, 0], [0, 1, 0], [0, 0, 1]], [1, 0, 2], [0, 1, 1])
    assert_close(form, [-1.0, -2.0, 2.0], 1e-14)
    assert np.isnan(jd.geometry.arnold_form(-eye, jnp.ones(3), jnp.ones(3))).all()


@pytest.fixture(scope="module")
def pendulum():
    """A particle on a sphere below its centre, and a start."""
    return scenes.spherical_pendulum(mass=1.3), *scenes.spherical_pendulum.start(theta=1.0, phi_rate=0.7)


def motion_of_two(q):
    """J (3, 2) on the sphere: motions of unit rates of the first two coordinates."""
    return np.vstack([np.eye(2), -np.asarray(q[:2]) / float(q[2])])


@pytest.mark.long
def test_composite_error(pendulum):
    """Its norm is the kinetic energy of ed + Kp e (it decays: `test_gauge_invariant_law_on_a_moving_plane`)."""
    scene, q, v = pendulum
    p, k, t = 2.0, 3.0, 0.3
    law = jd.control.GaugeInvariant(scene, first_two, circle, p, k)
    # By one program: the basis V2 is one of many, and which one it is rounding decides.
    eps, gauge = quick(
        lambda q, v: (law.composite_error(q, v, t), jd.reduction.gauge_invariant(scene, q, v, None, t, dof=2))
    )(q, v)
    slow = v[:2] - jax.jacfwd(circle)(t) + p * (q[:2] - circle(t))
    assert_close(eps @ eps, 1.3 * np.sum((motion_of_two(q) @ slow) ** 2), 1e-12)
    assert_close(eps, gauge.V2.T @ gauge.W.T @ motion_of_two(q) @ slow, 1e-10)


@pytest.mark.long
def test_equivalent_gains(pendulum):
    """Of numbers the closed form; of a matrix Kd the torque of the law, which they give back."""
    scene, q, v = pendulum
    p, k, t = 2.0, 3.0, 0.3
    plain = jd.control.GaugeInvariant(scene, first_two, circle, p, k)
    kp, kd = quick(lambda q: plain.equivalent_gains(q, t))(q)
    assert_close(kp, k * p * np.eye(2), 1e-12)
    assert_close(kd, (p + k) * np.eye(2), 1e-12)
    Kp, Kd = np.array([[2.0, 0.3], [0.1, 1.5]]), np.array([[3.0, 0.5], [0.5, 2.0]])
    law = jd.control.GaugeInvariant(scene, first_two, circle, Kp + Kp.T, Kd)
    gains, gauge = quick(
        lambda q: (law.equivalent_gains(q, t), jd.reduction.gauge_invariant(scene, q, v, None, t, dof=2))
    )(q)
    gains = [np.asarray(x) for x in gains]
    B = np.asarray(gauge.V2.T @ gauge.W.T) @ motion_of_two(q)
    assert_close(gains[0], np.linalg.inv(B) @ Kd @ B @ (Kp + Kp.T), 1e-10)
    assert_close(gains[1], Kp + Kp.T + np.linalg.inv(B) @ Kd @ B, 1e-10)
    # Where the composite error vanishes the law with these gains is the geometric one: HybridForce takes kp and kd as matrices
    # only if symmetric, so the acceleration that each asks for is compared instead.
    e, rate = q[:2] - circle(t), -(Kp + Kp.T) @ (q[:2] - circle(t))
    speed = jnp.asarray(motion_of_two(q) @ (jax.jacfwd(circle)(t) + rate))
    a = quick(lambda q, v: jd.constrained_dynamics(scene, q, v, law(q, v, t), t).acceleration)(q, speed)[:2]
    want = jax.jacfwd(jax.jacfwd(circle))(t) - gains[1] @ rate - gains[0] @ e
    assert_close(a, want, 1e-9)
