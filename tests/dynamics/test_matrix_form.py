"""The matrix form in its two frames: link frames against the tree frame, block identities, derivatives of the mass matrix."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, load_robot, quick, random_states, random_tree

import jaxdyn as jd
from jaxdyn.dynamics import world_frame as matrix_form

ALL_KINDS = ["free", "revolute", "spherical", "planar", "helical", "prismatic", "continuous", "revolute"]
CASES = {
    "every_kind": lambda: random_tree(11, ALL_KINDS, armature=False),
    "forest": lambda: random_tree(12, ALL_KINDS, parents=[-1, 0, 0, 2, -1, 4, 5, 4], armature=False),
}
FEW = pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x != "forest")) for x in CASES])


@cache
def case(name):
    model = CASES[name]()
    tip = model.frame_names[-1]
    states = random_states(model, 3, 5)[:3]

    def values(model, q, v, a):
        link = jd.newton_euler_matrices(model, q, v, tip=tip)
        flow = (jd.configuration_rate(model, q, v),)
        world = {
            "mass_matrix": matrix_form.mass_matrix(model, q),
            "mass_matrix_rate": jax.jvp(lambda q: matrix_form.mass_matrix(model, q), (q,), flow)[1],
            "coriolis_matrix": jd.coriolis_matrix(model, q, v),
            "gravity_force": jd.gravity_force(model, q),
            "inverse_dynamics": matrix_form.inverse_dynamics(model, q, v, a),
            "bias_force": matrix_form.inverse_dynamics(model, q, v, None),
            "tip": jd.body_jacobian(model, q, tip),
        }
        products = {name: getattr(link, name) for name in ("mass_matrix", "phi", "Jt", "C0", "Cs", "jacobians")}
        return link, products, world

    out = quick(jax.vmap(values, (None, 0, 0, 0)))(model, *states)
    return (model, states, *jax.tree.map(np.asarray, out))


@pytest.mark.long
@FEW
def test_link_frames_agree_with_the_tree_frame(name):
    _, (_, v, a), _, link, world = case(name)
    assert_close(link["mass_matrix"], world["mass_matrix"], 1e-12)
    assert_close(link["phi"], world["gravity_force"], 1e-12)
    assert_close(link["Jt"], world["tip"], 1e-12)
    assert_close(link["Cs"], world["coriolis_matrix"], 1e-12)
    bias = np.einsum("sij,sj->si", link["C0"], v) + link["phi"]
    assert_close(bias, world["bias_force"], 1e-12)
    assert_close(np.einsum("sij,sj->si", link["mass_matrix"], a) + bias, world["inverse_dynamics"], 1e-12)


@FEW
def test_identities_of_the_block_matrices(name):
    model, (_, v, a), m, link, world = case(name)
    for s in range(len(v)):
        power = np.eye(6 * model.nb)
        for _ in range(int(model.topology.depths.max())):
            assert np.abs(power).max() > 0
            power = power @ m.Gamma[s]
        assert not power.any()  # nilpotent, and its index is the depth
        assert_close(m.G[s] @ (np.eye(6 * model.nb) - m.Gamma[s]), np.eye(6 * model.nb), 1e-12)
        # The recursions in block form: V, Vdot, F, tau.
        twists = m.G[s] @ m.xi[s] @ v[s]
        assert_close(m.V[s], twists, 1e-13)
        rates = m.G[s] @ (m.xi[s] @ a[s] + m.P0[s] @ m.V0_dot[s] + m.ad_xi[s] @ m.Gamma[s] @ twists)
        forces = m.G[s].T @ (m.M[s] @ rates + m.ad_V_T[s] @ m.M[s] @ twists)
        assert_close(m.xi[s].T @ forces, world["inverse_dynamics"][s], 1e-12)
        # dM/dt = Y + Y^T, Y = xi^T G^T M G ad_xi Gamma G xi; dM/dt - 2 Cs is skew, with C0 it is not.
        y = m.xi[s].T @ m.G[s].T @ m.M[s] @ m.G[s] @ m.ad_xi[s] @ m.Gamma[s] @ m.G[s] @ m.xi[s]
        rate = world["mass_matrix_rate"][s]
        assert_close(y + y.T, rate, 1e-12)
        for c in (link["Cs"][s], world["coriolis_matrix"][s]):
            assert_close(c + c.T, rate, 1e-12)
        c0 = link["C0"][s]
        assert np.abs(c0 + c0.T - rate).max() > 1e-3 * np.abs(rate).max()


def test_tip_wrench_by_virtual_power():
    # Jt^T F_t: the tip's wrench on its surroundings is an external wrench on the last body with the sign turned.
    model, (q, v, _), m, link, world = case("forest")
    wrench = np.array([1.0, -2, 3, 0.4, 0.5, -0.6])
    body = model.topology.frame_bodies[-1]
    on_body = -m.Pt[0][:, 6 * body : 6 * body + 6].T @ wrench
    external = jnp.zeros((model.nb, 6)).at[body].set(on_body)
    zero = jnp.zeros(model.nv)
    tau = quick(matrix_form.inverse_dynamics)(model, q[0], v[0], zero, external)
    assert_close(tau, world["bias_force"][0] + link["Jt"][0].T @ wrench, 1e-12)


@pytest.mark.long
@pytest.mark.parametrize(
    "parents",
    [*(pytest.param(x, marks=pytest.mark.slow) for x in (None, [0, 1, 2, 3, 4, 5])), [0, 0, 2, -1, 4, 4]],
    ids=["tree", "chain", "forest"],
)
def test_derivative_of_the_mass_matrix(parents):
    kinds = ["revolute", "prismatic", "helical", "continuous", "revolute", "helical", "revolute"]
    model = random_tree(21, kinds, parents=None if parents is None else [-1, *parents])
    q, v = (x[0] for x in random_states(model, 1, 2)[:2])

    @quick
    def values(model, q, v):
        return (
            jd.dynamics.mass_matrix_derivative(model, q),
            jax.jacfwd(lambda q: matrix_form.mass_matrix(model, q))(q),
            jd.geometry.christoffel_symbols(model, q, "first"),
            jd.coriolis_matrix(model, q, v),
        )

    closed, automatic, symbols, coriolis = values(model, q, v)
    assert_close(closed, automatic, 1e-12)
    assert_close(symbols, symbols.transpose(0, 2, 1), 1e-13)
    own = jnp.einsum("ijk,k->ij", symbols, v)
    assert_close(own @ v, coriolis @ v, 1e-12)
    assert_close(own + own.T, coriolis + coriolis.T, 1e-12)
    # Turning the first joint of a tree turns all of it.
    assert_close(closed[:, :, 0], np.zeros_like(closed[:, :, 0]), 1e-12)


def test_refusals():
    model = random_tree(1, ["revolute", "planar"])
    for function in (partial(jd.geometry.christoffel_symbols, kind="first"), jd.dynamics.mass_matrix_derivative):
        with pytest.raises(ValueError, match="planar"):
            function(model, jnp.zeros(4))
    with pytest.raises(ValueError, match="tip is None"):
        _ = quick(jd.newton_euler_matrices)(random_tree(1, ["revolute"]), jnp.zeros(1), jnp.zeros(1)).Jt
    with pytest.raises(ValueError, match="frame 'none' is"):
        jd.newton_euler_matrices(model, jnp.zeros(4), jnp.zeros(4), tip="none")
    arm = load_robot("panda_description/urdf/panda.urdf", lock=("finger",))[1]
    base = next(n for n, b in zip(arm.frame_names, arm.topology.frame_bodies, strict=True) if b < 0)
    with pytest.raises(ValueError, match="to the world"):
        jd.newton_euler_matrices(arm, jnp.zeros(7), jnp.zeros(7), tip=base)
