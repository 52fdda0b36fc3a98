"""What users call: against Pinocchio (C MuJoCo: `io/test_mjcf.py`), by identities of mechanics, by invariance; derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import assert_close, quick, random_states, random_tree, to_pinocchio
from scipy.spatial.transform import Rotation

import jaxdyn as jd
from jaxdyn import se3
from jaxdyn.dynamics import world_frame as matrix_form

ALL_KINDS = ["free", "revolute", "spherical", "planar", "helical", "prismatic", "continuous", "revolute"]
TREES = {
    "floating": lambda: random_tree(31, ALL_KINDS),
    "fixed": lambda: random_tree(32, ["spherical", "prismatic", "planar", "continuous", "helical", "spherical"]),
    "forest": lambda: random_tree(33, ALL_KINDS, parents=[-1, 0, 0, 2, -1, 4, 5, 4], armature=False),
}
# One tree with joints of every kind serves all fast tests, by one program; a forest: test_matrix_form; robots: test_robots.
CASES = [pytest.param(name, marks=[pytest.mark.slow] * (name != "floating")) for name in TREES]


def values(model, q, v, a, tau, external):
    # The matrix form itself: `dynamics` would compile the recursions too, which have their own tests.
    return {
        "mass_matrix": matrix_form.mass_matrix(model, q),
        "coriolis": jd.coriolis_matrix(model, q, v) @ v,
        "gravity_force": jd.gravity_force(model, q),
        "bias_force": matrix_form.inverse_dynamics(model, q, v, None),
        "inverse_dynamics": matrix_form.inverse_dynamics(model, q, v, a, external),
        "forward_dynamics": matrix_form.forward_dynamics(
            model, q, v, tau + matrix_form.generalized_force(model, q, external)
        ),
        "kinetic_energy": jd.kinetic_energy(model, q, v),
        "potential_energy": jd.potential_energy(model, q),
        "center_of_mass": jd.center_of_mass(model, q),
        "centroidal_momentum": jd.dynamics.centroidal_momentum(model, q, v),
        "centroidal_momentum_matrix": jd.dynamics.centroidal_momentum_matrix(model, q),
        "torque_regressor": jd.dynamics.torque_regressor(model, q, v, a),
    }


# One program per topology and dtype, whatever the numbers.
PROGRAM = quick(jax.vmap(values, (None, 0, 0, 0, 0, 0)))


@functools.cache
def case(name):
    """Pinocchio's model, ours, the bridge, five states, and all quantities at them from one compiled program."""
    model = TREES[name]()
    source, bridge = to_pinocchio(model)
    states = random_states(model, 5, 7)
    return source, model, bridge, states, jax.tree.map(np.asarray, PROGRAM(model, *states))


def pinocchio_values(source, bridge, q, v, a, tau, external):
    data = source.createData()
    # Pinocchio 4.1 counts the rotors of some joint types in the kinetic energy and of others not.
    bare = source.copy()
    bare.armature = np.zeros(source.nv)
    rotors = 0.5 * source.armature @ v**2
    wrenches = pin.StdVec_Force()
    wrenches.append(pin.Force.Zero())
    for offset, wrench in zip(bridge.offsets, external, strict=True):
        wrenches.append(pin.SE3(offset[:3, :3], offset[:3, 3]).act(pin.Force(wrench)))
    mass = np.triu(pin.crba(source, data, q))
    mass += np.triu(mass, 1).T
    out = {
        "mass_matrix": mass,
        "coriolis": pin.computeCoriolisMatrix(source, data, q, v) @ v,
        "gravity_force": pin.computeGeneralizedGravity(source, data, q),
        "bias_force": pin.nonLinearEffects(source, data, q, v),
        "inverse_dynamics": pin.rnea(source, data, q, v, a, wrenches),
        "kinetic_energy": pin.computeKineticEnergy(bare, bare.createData(), q, v) + rotors,
        "potential_energy": pin.computePotentialEnergy(source, data, q),
        "center_of_mass": pin.centerOfMass(source, data, q).copy(),
        "centroidal_momentum": pin.computeCentroidalMomentum(source, data, q, v).vector,
        "centroidal_momentum_matrix": pin.computeCentroidalMap(source, data, q).copy(),
    }
    if not bridge.offsets[:, :3, 3].any():
        out["torque_regressor"] = pin.computeJointTorqueRegressor(source, data, q, v, a).copy()
    acceleration = pin.aba(source, data, q, v, tau, wrenches).copy()
    return out, acceleration


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_agrees_with_pinocchio(name):
    source, _, bridge, states, ours = case(name)
    q, *rest = states
    for s, state in enumerate(zip(bridge.q_to_pinocchio(q), *map(np.asarray, rest), strict=True)):
        theirs, acceleration = pinocchio_values(source, bridge, *state)
        for key, want in theirs.items():
            assert_close(ours[key][s], want, label=key)
        # Both accelerations carry the condition number of M (up to 1e6 for hands and humanoids).
        condition = np.linalg.cond(ours["mass_matrix"][s])
        assert_close(ours["forward_dynamics"][s], acceleration, max(1e-10, 1e-15 * condition), "forward_dynamics")


@pytest.mark.parametrize("name", CASES)
def test_identities_at_one_state(name):
    _, model, _, (_, v, a, tau, _), ours = case(name)
    mass, armature = ours["mass_matrix"], 0.0 if model.armature is None else np.asarray(model.armature)
    np.testing.assert_array_equal(mass, mass.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(mass).min() > 0
    v, a, tau = map(np.asarray, (v, a, tau))
    assert_close(ours["kinetic_energy"], 0.5 * np.einsum("si,sij,sj->s", v, mass, v), 1e-12)
    assert_close(ours["bias_force"], ours["coriolis"] + ours["gravity_force"], 1e-12)
    assert_close(ours["centroidal_momentum"], np.einsum("sij,sj->si", ours["centroidal_momentum_matrix"], v), 1e-12)
    # M a_fd + h = tau + J^T f and M a + h = tau_id + J^T f: the wrenches drop out of the difference.
    forced = ours["inverse_dynamics"] - np.einsum("sij,sj->si", mass, a)
    residual = np.einsum("sij,sj->si", mass, ours["forward_dynamics"]) + forced - tau
    assert np.abs(residual).max() <= 1e-10 * np.abs(forced).max()
    # Y pi leaves out the rotors and the external wrenches.
    linear = ours["torque_regressor"] @ np.asarray(model.inertias).reshape(-1) + armature * a
    assert_close(linear, np.einsum("sij,sj->si", mass, a) + ours["bias_force"], 1e-11)


@pytest.mark.long
def test_identities_along_the_motion():
    _, model, _, (q, v, a, tau, external), _ = case("floating")
    model = model.replace(armature=None)  # rotors have no momentum
    tau_inside = tau.at[:, :6].set(0.0)  # nothing pushes on a floating base

    @quick
    @functools.partial(jax.vmap, in_axes=(None, 0, 0, 0, 0, 0, 0))
    def rates(model, q, v, a, tau, tau_inside, external):
        qdot = jd.configuration_rate(model, q, v)

        def along(function):
            return jax.jvp(function, (q,), (qdot,))[1]

        def along_motion(function, acceleration):
            return jax.jvp(function, (q, v), (qdot, acceleration))[1]

        def energy(q, v):
            return jd.kinetic_energy(model, q, v) + jd.potential_energy(model, q)

        coriolis = jd.coriolis_matrix(model, q, v)
        acceleration = matrix_form.forward_dynamics(model, q, v, tau)
        free = matrix_form.forward_dynamics(model, q, v, tau_inside)
        last = jnp.zeros_like(external).at[-1].set(external[-1])
        return {
            "skew": (along(lambda q: matrix_form.mass_matrix(model, q)), coriolis + coriolis.T),
            "gravity": (along(lambda q: jd.potential_energy(model, q)), jd.gravity_force(model, q) @ v),
            "power": (along_motion(energy, acceleration), v @ tau),
            "momentum": (
                jnp.sum(model.inertias[:, 0]) * along(lambda q: jd.center_of_mass(model, q)),
                jd.dynamics.centroidal_momentum(model, q, v)[:3],
            ),
            "free_momentum": along_motion(lambda q, v: jd.dynamics.centroidal_momentum(model, q, v), free),
            "wrench": (
                jd.dynamics.generalized_force(model, q, last),
                jd.body_jacobian(model, q, model.body_names[-1]).T @ external[-1],
            ),
            "external": (
                matrix_form.inverse_dynamics(model, q, v, a, external),
                matrix_form.inverse_dynamics(model, q, v, a) - jd.dynamics.generalized_force(model, q, external),
            ),
        }

    out = rates(model, q, v, a, tau, tau_inside, external)
    free = out.pop("free_momentum")
    for key, (got, want) in out.items():
        assert_close(got, want, label=key)
    weight = float(jnp.sum(model.inertias[:, 0])) * np.asarray(model.gravity)
    assert_close(free, np.tile(np.concatenate([weight, np.zeros(3)]), (5, 1)), label="free momentum")


def _in_other_frames(model, seed):
    """The same mechanism described in displaced body frames (screw joints only)."""
    rng = np.random.default_rng(seed)
    transforms = np.tile(np.eye(4), (model.nb, 1, 1))
    transforms[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(model.nb, 3))).as_matrix()
    transforms[:, :3, 3] = rng.normal(size=(model.nb, 3))
    back = np.linalg.inv(transforms)
    outer = np.stack([np.eye(4) if p < 0 else back[p] for p in model.topology.parents])
    own = np.array(model.topology.frame_bodies)
    return model.replace(
        home=jnp.asarray(outer @ np.asarray(model.home) @ transforms),
        screws=quick(jax.vmap(se3.Ad_inv_apply))(jnp.asarray(transforms), model.screws),
        inertias=quick(jax.vmap(jd.inertia.transform_inertia))(jnp.asarray(back), model.inertias),
        frame_poses=jnp.asarray(back[own] @ np.asarray(model.frame_poses)),
    ), transforms


@pytest.mark.long
def test_frames_of_description_do_not_matter():
    model = random_tree(51, ["helical", "prismatic", "helical", "helical", "helical", "prismatic"])
    other, transforms = _in_other_frames(model, 0)
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), [3, -4, 5]
    turned_home = np.array(model.home)
    turned_home[0] = world @ turned_home[0]
    turned = model.replace(
        home=jnp.asarray(turned_home), gravity=jnp.asarray(world[:3, :3] @ np.asarray(model.gravity))
    )
    q, v, a, tau, external = random_states(model, 5, 3)
    want = PROGRAM(model, q, v, a, tau, external)
    carried = quick(jax.vmap(jax.vmap(se3.AdT_apply), (None, 0)))(jnp.asarray(transforms), external)
    invariant = ("mass_matrix", "coriolis", "gravity_force", "inverse_dynamics", "forward_dynamics", "kinetic_energy")
    by_other, by_turned = PROGRAM(other, q, v, a, tau, carried), PROGRAM(turned, q, v, a, tau, external)
    for got in (by_other, by_turned):
        for key in invariant:
            assert_close(got[key], want[key], label=key)
    for key in ("potential_energy", "center_of_mass", "centroidal_momentum"):
        assert_close(by_other[key], want[key], label=key)
    assert_close(by_turned["center_of_mass"], np.asarray(want["center_of_mass"]) @ world[:3, :3].T + world[:3, 3])


@pytest.mark.long
def test_without_gravity_and_armature_nothing_of_them_is_compiled():
    model = random_tree(61, ["revolute", "spherical", "revolute"])
    bare = model.replace(gravity=None, armature=None)
    zero = model.replace(gravity=jnp.zeros(3), armature=jnp.zeros(model.nv))
    state = [x[0] for x in random_states(model, 1, 0)]
    one = quick(lambda m, q, v, a, tau, _: (matrix_form.forward_dynamics(m, q, v, tau), jd.kinetic_energy(m, q, v)))
    for got, want in zip(one(bare, *state), one(zero, *state), strict=True):
        assert_close(got, want, 1e-13)

    def operations(function, model, *args):
        return len(str(jax.make_jaxpr(function)(model, *args)).splitlines())

    q, v, a, tau, _ = state
    for function, args in ((matrix_form.forward_dynamics, (q, v, tau)), (matrix_form.inverse_dynamics, (q, v, a))):
        assert operations(function, bare, *args) < operations(function, zero, *args) - 4
    for function in (jd.gravity_force, jd.potential_energy):
        jaxpr = str(jax.make_jaxpr(lambda m, q, f=function: f(m, q))(bare, q))
        assert "dot_general" not in jaxpr and "sin" not in jaxpr
        np.testing.assert_array_equal(function(bare, q), np.zeros(model.nv if function is jd.gravity_force else ()))


LEAVES = ("home", "screws", "inertias", "gravity", "armature")


def _flat(model, leaves, q, v, u):
    model = model.replace(**leaves)
    terms = [
        matrix_form.forward_dynamics(model, q, v, u),
        jd.coriolis_matrix(model, q, v) @ u,
        jd.potential_energy(model, q)[None],
        jd.dynamics.centroidal_momentum(model, q, v),
    ]
    return jnp.concatenate(terms)


def _derivative_case():
    # Helical and spherical joints: both kinds of joint transform.
    model = random_tree(71, ["helical", "spherical"], parents=[-1, 0])
    return model, ({name: getattr(model, name) for name in LEAVES}, *(x[0] for x in random_states(model, 1, 4)[:3]))


def _total(model, leaves, q, v, tau):
    return jnp.sum(jnp.tanh(matrix_form.forward_dynamics(model.replace(**leaves), q, v, tau) / 10))


@pytest.mark.long
def test_every_quantity_has_derivatives_in_every_leaf():
    model, at = _derivative_case()
    rng = np.random.default_rng(0)
    along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), at)
    weights = jnp.asarray(rng.normal(size=2 * model.nv + 7))
    function = functools.partial(_flat, model)
    h = 1e-5

    def moved(step):
        return jax.tree.map(lambda x, d: jnp.asarray(np.asarray(x) + step * np.asarray(d)), at, along)

    @quick
    def first(at, along):
        return *jax.jvp(function, at, along), jax.vjp(function, *at)[1](weights)

    ahead, back = (np.asarray(first(moved(step), along)[0]) for step in (h, -h))
    _, forward, gradient = first(at, along)
    # Central differences: h^2 and eps / h, both about 1e-10, times third derivatives and values of some hundred.
    assert_close(forward, (ahead - back) / (2 * h), 1e-7)
    pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(along), strict=True)
    assert_close(sum(np.vdot(g, d) for g, d in pairs), weights @ forward, 1e-10)
    for name, part in gradient[0].items():
        assert np.abs(part).max() > 1e-3, name

    # Second order, forward over reverse, against differences of the gradient.
    @quick
    def second(at, along):
        return jax.jvp(lambda at: jax.grad(_total, argnums=(1, 2, 3, 4))(model, *at), (at,), (along,))

    _, hessian = second(at, along)
    (ahead, _), (back, _) = second(moved(h), along), second(moved(-h), along)
    differences = jax.tree.map(lambda a, b: (np.asarray(a) - np.asarray(b)) / (2 * h), ahead, back)
    for got, want in zip(jax.tree.leaves(hessian), jax.tree.leaves(differences), strict=True):
        assert_close(got, want, 1e-5)


@pytest.mark.usefixtures("as_users_have_it")  # annotations would refuse most of these before the function does
def test_refusals():
    model = random_tree(1, ["revolute", "spherical"])
    q, v = jnp.asarray([0.0, 1, 0, 0, 0]), jnp.zeros(4)
    for match, call in (
        ("q has shape", lambda: jd.mass_matrix(model, v)),
        ("a has shape", lambda: jd.inverse_dynamics(model, q, v, v[:3])),
        ("tau has shape", lambda: jd.forward_dynamics(model, q, v, q)),
        ("external has shape", lambda: jd.dynamics.generalized_force(model, q, jnp.zeros((4, 6)))),
    ):
        with pytest.raises(ValueError, match=match):
            call()
    for function in (jd.coriolis_matrix, jd.bias_force, jd.kinetic_energy):
        with pytest.raises(ValueError, match="v has shape"):
            function(model, q, q)
    with pytest.raises(ValueError, match=r"v has shape"):
        jd.dynamics.torque_regressor(model, q, q, v)
    with pytest.raises(ValueError, match=r"q has shape"):
        jd.center_of_mass(model, v)
