"""What public functions do with numbers, systems and scenes that users pass: lists, integers, complex numbers, batches."""

# pyright: reportArgumentType=false

import pickle
import traceback

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick

import jaxdyn as jd
from jaxdyn.cli.common import output_path
from jaxdyn.constraints.codes import CODES, name_of
from jaxdyn.simulation.solution import OF_DIFFRAX, from_diffrax

ARM = jd.robots.chain(2)
BODY = ARM.body_names[-1]
CHAIN = jd.Scene(ARM, (jd.constraints.gear(ARM.joint_names[1], ARM.joint_names[0], 2.0),))
PLANE = jd.MetricSystem(lambda q: jnp.diag(1.0 + q * q), 2)
Q, V, A = [1, 2], [3, -1], [2, 5]
NU, WRENCH = [3], [[1, 2, 3, 4, 5, 6], [6, 5, 4, 3, 2, 1]]

OF_BODIES = {
    "aba": (jd.dynamics.aba, Q, V, A),
    "articulated_bodies": (lambda m, q, v, a: jd.dynamics.articulated_bodies(m, q, v, a).biases, Q, V, A),
    "body_jacobian": (lambda m, q: jd.body_jacobian(m, q, BODY), Q),
    "center_of_mass": (jd.center_of_mass, Q),
    "centroidal_momentum": (jd.dynamics.centroidal_momentum, Q, V),
    "centroidal_momentum_matrix": (jd.dynamics.centroidal_momentum_matrix, Q),
    "configuration_rate": (jd.configuration_rate, Q, V),
    "crba": (jd.dynamics.crba, Q),
    "difference": (jd.difference, Q, A),
    "forward_kinematics": (jd.forward_kinematics, Q),
    "frame_pose": (lambda m, q: jd.frame_pose(m, q, BODY), Q),
    "generalized_force": (jd.dynamics.generalized_force, Q, WRENCH),
    "integrate": (jd.integrate, Q, V),
    "jacobian_dot_v": (lambda m, q, v: jd.dynamics.jacobian_dot_v(m, q, v, BODY), Q, V),
    "link_adjoints": (jd.dynamics.link_adjoints, Q),
    "mass_matrix_derivative": (jd.dynamics.mass_matrix_derivative, Q),
    "mass_matrix_sqrt": (jd.dynamics.mass_matrix_sqrt, Q),
    "newton_euler_matrices": (lambda m, q, v: jd.newton_euler_matrices(m, q, v).V, Q, V),
    "normalize": (jd.normalize, Q),
    "regressor": (lambda m, q, v, a: jd.identify.regressor(m, [q], [v], [a]), Q, V, A),
    "rnea": (jd.dynamics.rnea, Q, V, A),
    "spatial_jacobian": (lambda m, q: jd.dynamics.spatial_jacobian(m, q, BODY), Q),
    "torque_regressor": (jd.dynamics.torque_regressor, Q, V, A),
}
OF_SYSTEMS = {
    "bias_force": (jd.bias_force, Q, V),
    "coriolis_matrix": (jd.coriolis_matrix, Q, V),
    "forward_dynamics": (jd.forward_dynamics, Q, V, A),
    "geometry.christoffel_symbols": (jd.geometry.christoffel_symbols, Q),
    "geometry.connection": (jd.geometry.connection, Q, V, A),
    "geometry.covariant_rate": (jd.geometry.covariant_rate, Q, V, A, A),
    "geometry.flat": (jd.geometry.flat, Q, V),
    "geometry.geodesic_acceleration": (jd.geometry.geodesic_acceleration, Q, V),
    "geometry.sectional_curvature": (jd.geometry.sectional_curvature, Q, V, A),
    "geometry.sharp": (jd.geometry.sharp, Q, V),
    "gravity_force": (jd.gravity_force, Q),
    "inverse_dynamics": (jd.inverse_dynamics, Q, V, A),
    "kinetic_energy": (jd.kinetic_energy, Q, V),
    "mass_matrix": (jd.mass_matrix, Q),
    "potential_energy": (jd.potential_energy, Q),
}
OF_SCENES = {
    "assemble": (lambda s, q, v: jd.assemble(s, q, v).q, Q, V),
    "constrained_dynamics": (lambda s, q, v, tau: jd.constrained_dynamics(s, q, v, tau).acceleration, Q, V, A),
    "constraint_forces": (lambda s, q, lam: list(jd.constraint_forces(s, q, lam).values()), Q, NU),
    "constraint_jacobian": (jd.constraint_jacobian, Q),
    "gauge_invariant": (lambda s, q, v, tau: jd.reduction.gauge_invariant(s, q, v, tau).acceleration, Q, V, A),
    "involutive": (lambda s, q: jd.reduction.involutive(s, q).singular_values, Q),
    "position_residual": (jd.constraints.position_residual, Q),
    "projections": (jd.constraints.projections, Q),
    "reduced_dynamics": (lambda s, q, nu, tau: jd.reduced_dynamics(s, q, nu, tau, basis=(0,)).acceleration, Q, NU, A),
    "second_fundamental_form": (jd.constraints.second_fundamental_form, Q, V),
    "simulate": (lambda s, q, v: jd.simulate(s, q, v, [0, 1], stepsize=0.5, throw=False).v, [0, 0], [0, 0]),
    "stiffness": (jd.stiffness, Q, V),
    "tangent_basis": (jd.reduction.tangent_basis, Q),
    "velocity_residual": (jd.constraints.velocity_residual, Q, V),
}
TAKES = [
    *((name, ARM, *call) for name, call in (OF_BODIES | OF_SYSTEMS).items()),
    *((f"{name} of a metric", PLANE, *call) for name, call in OF_SYSTEMS.items()),
    *((name, CHAIN, *call) for name, call in OF_SCENES.items()),
]
# Arguments that select a program: names, kinds and tolerances.
ONES, Q2 = jnp.ones(3), jnp.ones(2)
ARRAYS_FOR_STATIC = {
    "tip": lambda x: jd.newton_euler_matrices(ARM, jnp.zeros(2), jnp.zeros(2), tip=x),
    "frame": lambda x: jd.frame_jacobian(ARM, jnp.zeros(2), x),
    "joint": lambda x: jd.dynamics.joint_wrench(ARM, jnp.zeros(2), jnp.zeros(2), jnp.zeros(2), joint=x),
    "kind": lambda x: jd.contact.wrench_basis(x),
    "joint ": lambda x: jd.constraints.loop(None, None, "a", None, joint=x),
    "sequence": lambda x: jd.so3.euler_to_matrix(jnp.ones(3), sequence=x),
    "rows": lambda x: jd.dynamics.workspace_dynamics(ARM, BODY, jnp.zeros(2), jnp.zeros(2), rows=x),
    "least": lambda x: jd.dynamics.workspace_dynamics(ARM, BODY, jnp.zeros(2), jnp.zeros(2), rows=(0, 2), least=x),
    "axis": lambda x: jd.inertia.rod(1.0, 1.0, axis=x),
    "poles": lambda x: jd.contact.Sphere(0.1, poles=x),
    "rank_tol": lambda x: jd.degrees_of_freedom(CHAIN, jnp.zeros(2), rank_tol=x),
    "rank_tol ": lambda x: jd.reduction.tangent_basis(CHAIN, jnp.zeros(2), rank_tol=x),
    "tol": lambda x: jd.contact.solve_qp(jnp.eye(2), jnp.ones(2), tol=x),
    "tol ": lambda x: jd.control.ilqr(
        lambda x, u: x + u, lambda x, u, k: u @ u, lambda x: x @ x, jnp.ones(1), jnp.zeros((2, 1)), tol=x
    ),
    "atol": lambda x: jd.assemble(CHAIN, jnp.zeros(2), atol=x),
}


@pytest.mark.parametrize("name", ARRAYS_FOR_STATIC)
@pytest.mark.parametrize("value", [ONES, "zzz", None], ids=["array", "string", "traced"])
def test_arrays_for_arguments_that_select_a_program_are_refused(name, value):
    """By a ValueError with the argument's name; they ended in "unhashable type" or in an error of JAX's tracing."""
    call = ARRAYS_FOR_STATIC[name]
    with pytest.raises(ValueError, match=rf"\b{name.strip()} |frame 'zzz'|joint 'zzz'"):
        jax.eval_shape(call, 1.0) if value is None else call(value)


EVERY = pytest.mark.parametrize(
    ("system", "function", "args"), [(x[1], x[2], x[3:]) for x in TAKES], ids=[x[0] for x in TAKES]
)


pytestmark = pytest.mark.usefixtures("as_users_have_it")


def same(computed, wanted):
    for a, b in zip(jax.tree.leaves(computed), jax.tree.leaves(wanted), strict=True):
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)


@EVERY
def test_numbers_of_any_kind_give_those_of_the_model(system, function, args):
    """Lists and integers are taken as floats of the model's dtype."""
    wanted = function(system, *(jnp.asarray(x, float) for x in args))
    same(function(system, *args), wanted)
    same(function(system, *(jnp.asarray(x) for x in args)), wanted)
    assert all(np.asarray(x).dtype == float for x in jax.tree.leaves(wanted))


@EVERY
def test_what_does_not_fit_is_refused_with_its_name(system, function, args):
    for i in range(len(args)):
        for wrong in (jnp.asarray(args[i], complex), "abc"):
            with pytest.raises(ValueError, match=r"is complex|array of numbers|pass one"):
                function(system, *args[:i], wrong, *args[i + 1 :])
    if function is not OF_BODIES["regressor"][0]:
        with pytest.raises(ValueError, match=r"has shape \(2, .*vmap"):
            function(system, jnp.ones((2, 2)), *args[1:])


@pytest.mark.parametrize(("name", "call"), (OF_BODIES | OF_SYSTEMS).items())
def test_functions_of_a_system_say_what_to_pass_for_a_scene(name, call):
    with pytest.raises(ValueError, match=r"pass scene\.system"):
        call[0](CHAIN, *call[1:])


@pytest.mark.parametrize(("name", "call"), OF_BODIES.items())
def test_functions_of_bodies_refuse_other_systems(name, call):
    with pytest.raises(ValueError, match="has no bodies"):
        call[0](PLANE, *call[1:])


@pytest.mark.parametrize(("name", "call"), OF_SCENES.items())
def test_functions_of_a_scene_take_a_system_as_one(name, call):
    """With the same results, or the same refusal, as for `Scene(system)`."""
    if name in ("assemble", "constrained_dynamics", "position_residual", "simulate", "stiffness", "velocity_residual"):
        same(call[0](ARM, *call[1:]), call[0](jd.Scene(ARM), *call[1:]))
    else:
        with pytest.raises(ValueError, match="has no constraints"):
            call[0](ARM, *call[1:])


def stiffer(q, v, t):
    return -q if t < 0.5 else q


OPTIONS = [
    ({"stepsize": jd.simulation.Steps(rtol=np.inf)}, "rtol is inf; pass a finite number"),
    ({"stepsize": jd.simulation.Steps(rtol=-1)}, "rtol is -1; pass a finite number that is not negative"),
    ({"stepsize": jd.simulation.Steps(atol=np.nan)}, "atol is nan"),
    ({"stepsize": jd.simulation.Steps(rtol="1e-8")}, "rtol is .*; pass an array of numbers"),
    ({"stepsize": jd.simulation.Steps(rtol=[1e-8, 1e-6])}, r"rtol has shape \(2,\); pass one number.*vmap"),
    ({"stepsize": "0.1"}, "stepsize is .*; pass an array of numbers"),
    ({"stepsize": -0.1}, "stepsize is -0.1; pass a positive number"),
    ({"stepsize": jd.simulation.Steps(0.1, rtol=1e-6)}, "rtol is given, and RK4 has no use for it with fixed steps"),
    ({"stepsize": jd.simulation.Steps(0.1, atol=1e-6), "solver": diffrax.Tsit5()}, "atol .*Tsit5 has no use"),
    ({"stepsize": jd.simulation.Steps(diffrax.StepTo(jnp.linspace(0, 1, 5)), rtol=1e-6)}, "rtol .*their own steps"),
    ({"events": [jd.events.ModeSwitches(8)]}, "ModeSwitches.*no force of"),
    ({"events": jd.events.JointLimit()}, "events is JointLimit.*; pass a list"),
    ({"events": ["stop"]}, "events has 'stop'; give objects of jd.events"),
    ({"events": [jd.events.ContactLost()]}, "ContactLost.*, and the scene has no cones"),
    ({"control": lambda q, v, t: np.sin(q)}, "control needs the values .* jax.numpy"),
    ({"control": stiffer}, r"control needs the values .* jax\.lax\.cond instead of if"),
    ({"control": lambda q, v, t: jnp.ones((4, 2))}, r"shape \(4, 2\).*jax\.vmap"),
    ({"stepsize": [0.1, 0.2]}, r"stepsize .*jax\.vmap"),
    ({"control": lambda q, v: q}, r"control takes \(q, v\), but is called as control\(q, v, t\)"),
]


@pytest.mark.parametrize(("options", "said"), OPTIONS)
def test_options_of_simulate_are_refused_before_the_motion(options, said):
    with pytest.raises(ValueError, match=said):
        jd.simulate(ARM, [0, 0], [0, 0], [0, 1], **options)


def test_a_model_without_moving_bodies():
    """What is summed over no bodies is zero, what is divided by their mass is NaN, and nothing is simulated."""
    empty, none = jd.ModelBuilder("base").build(), jnp.zeros(0)

    @quick
    def compute():
        masses = jd.mass_matrix(empty, none), jd.dynamics.centroidal_momentum_matrix(empty, none)
        energies = jd.potential_energy(empty, none), jd.kinetic_energy(empty, none, none)
        centre, momentum = jd.center_of_mass(empty, none), jd.dynamics.centroidal_momentum(empty, none, none)
        return energies, masses, jd.forward_dynamics(empty, none, none, none), centre, momentum

    energies, (mass, matrix), acceleration, centre, momentum = compute()
    assert energies == (0, 0) and mass.shape == (0, 0) and matrix.shape == (6, 0)
    assert acceleration.shape == (0,) and np.isnan(centre).all() and not momentum.any()
    with pytest.raises(ValueError, match="so nothing moves"):
        jd.simulate(empty, none, none, [0.0, 1.0])


def test_paths(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for load in (jd.load_model, jd.load):
        with pytest.raises(ValueError, match=r"(path|source) is None"):
            load(None)
    jd.save_urdf(ARM, "~/arm.urdf")
    assert (tmp_path / "arm.urdf").exists()
    assert jd.load_model("~/arm.urdf").joint_names == ARM.joint_names
    with pytest.raises(ValueError, match=r"--out .* directory nowhere"):
        output_path("nowhere/a.csv", (".csv",), "--out")


PENDULUM = jd.robots.chain(1)
LANES = {
    "q0": (jnp.asarray([[0.1], [jnp.nan]]), "nonfinite_start"),
    "v0": (jnp.asarray([[0.1], [jnp.inf]]), "nonfinite_start"),
    "ts": (jnp.asarray([[0.0, 0.1, 0.2], [0.0, 0.2, 0.1]]), "unordered_times"),
    "stepsize": (jnp.asarray([0.01, -0.01]), "bad_stepsize"),
    "rtol": (jnp.asarray([1e-8, jnp.nan]), "bad_tolerance"),
}


@pytest.mark.parametrize(("name", "method"), [*((name, "free") for name in LANES), ("stepsize", "variational")])
def test_a_bad_lane_leaves_the_good_one_alone(name, method):
    """Both lanes of the batch, against one with two good lanes."""
    options = {} if name == "rtol" else {"stepsize": 0.01}
    given = {"q0": [0.1], "v0": [0.3], "ts": [0.0, 0.1, 0.2]} | options

    @jax.jit
    @jax.vmap
    def run(value):
        changed = {"stepsize": jd.simulation.Steps(rtol=value)} if name == "rtol" else {name: value}
        return jd.simulate(PENDULUM, **(given | changed), method=method, outputs=("energy",), throw=False)

    values, code = LANES[name]
    both, good = run(values), run(values[:1].repeat(2, 0))
    assert both.success.tolist() == [True, False]
    assert (both.result == getattr(jd.RESULTS, code)).tolist() == [False, True]
    np.testing.assert_allclose(both.q[0], good.q[0], rtol=1e-10)
    np.testing.assert_allclose(both.energy[0], good.energy[0], rtol=1e-10)
    assert np.isnan(both.q[1]).all()


def test_no_success_with_rows_that_are_not_finite():
    """A force that is infinite where the motion ends enters no step; what is reported of it counts."""
    late = lambda system, q, v, t: jnp.where(t >= 0.2, jnp.inf, 0.0) * jnp.ones(2)  # noqa: E731
    scene = jd.Scene(ARM, forces=(late,))
    solution = jd.simulate(scene, [0.1, 0.2], [0, 0], [0, 0.2], stepsize=0.01, outputs=("acceleration",), throw=False)
    assert not solution.success


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e300])
def test_no_success_with_an_acceleration_that_is_not_finite(wrong):
    """Under jit and in a batch beside a good sample, whose code does not change; 1e300 m/s overflow in their squares."""
    free, two = jd.Scene(ARM), jnp.asarray([1.0, wrong])
    functions = {
        "free": lambda x: jd.constrained_dynamics(free, [1, 2], x * jnp.asarray([3.0, -1.0])),
        "pivots": lambda x: jd.constrained_dynamics(CHAIN, [1, 2], x * jnp.asarray([1.0, 2.0])),
        "schur": lambda x: jd.constrained_dynamics(CHAIN, [1, 2], x * jnp.asarray([1.0, 2.0]), method="schur"),
        "reduced": lambda x: jd.reduced_dynamics(CHAIN, [1, 2], x * jnp.ones(1), basis=(0,)),
        "gauge": lambda x: jd.reduction.gauge_invariant(CHAIN, [1, 2], x * jnp.asarray([1.0, 2.0])),
    }
    for name, function in functions.items():
        result = jax.jit(jax.vmap(function))(two).result
        assert (result == jd.RESULTS.successful).tolist() == [True, False], name


def test_one_enumeration_of_results():
    solution = [
        jd.assemble(CHAIN, Q),
        jd.constrained_dynamics(CHAIN, Q, V),
        jd.reduced_dynamics(CHAIN, Q, NU, basis=(0,)),
        jd.simulate(PENDULUM, [0.1], [0.0], [0.0, 0.1], stepsize=0.1),
    ]
    assert all(one.result == jd.RESULTS.successful and one.success for one in solution)
    assert "successful" in str(solution[0].result) and "<>" not in str(solution[3].result)
    stopped = jd.simulate(PENDULUM, [0.1], [0.0], [0.0, 9.0], stepsize=jd.simulation.Steps(max_steps=1), throw=False)
    assert stopped.result == jd.RESULTS.max_steps_reached != solution[1].result and not stopped.success


def test_every_code_of_diffrax_has_its_name():
    assert len(OF_DIFFRAX) == len(set(OF_DIFFRAX)) == len(diffrax.RESULTS)
    for name in OF_DIFFRAX:
        assert from_diffrax(getattr(diffrax.RESULTS, name)) == getattr(jd.RESULTS, name)
    assert len(CODES) == len(jd.RESULTS) and all(name_of(getattr(jd.RESULTS, name)) == name for name in CODES)


def test_models_scenes_and_solutions_print_as_short_text():
    text = str(ARM)
    assert text.splitlines()[0] == "Model 'chain 2': 2 bodies, nq = 2, nv = 2, float64"
    assert all(name in text for name in (*ARM.body_names, *ARM.joint_names, "revolute", "0 1 0"))
    foot = jd.contact.ground_contact(BODY, friction=0.5, name="foot")
    assert str(jd.Scene(ARM, forces=[foot, jd.forces.JointDamping(1.0)])).endswith(
        "force 'foot' (UnilateralContact)\nforce JointDamping"
    )
    assert "(Gear): 1 holonomic row" in str(CHAIN) and str(jd.Scene(PLANE)) == "Scene of MetricSystem: nq = 2, nv = 2"
    solution = jd.simulate(PENDULUM, [0.1], [0.0], [0.0, 0.1], stepsize=0.05, outputs=("energy",))
    assert str(solution) == (
        "Solution: successful, t = 0 to 0.1 s of 0.1 s\n  RK4: 2 steps, 0 rejected\n  2 rows of q (1), v (1), energy"
    )
    seen = []
    jax.jit(lambda scene: seen.append(str(scene)))(CHAIN)
    jax.vmap(lambda q: seen.append(str(jd.simulate(PENDULUM, q, q, [0.0, 0.1], stepsize=0.1))))(jnp.ones((2, 1)))
    assert "?" in seen[0] and "Solution: traced" in seen[1]


def _free_and_ball():
    builder = jd.ModelBuilder("free and ball")
    builder.add_body("base", joint="free", inertia=jd.inertia.box(1.0, (0.3, 0.2, 0.1)))
    builder.add_body("arm", parent="base", joint="spherical", inertia=jd.inertia.box(0.5, (0.1, 0.1, 0.4)))
    return builder.build()


@pytest.mark.long
def test_quaternions_stand_for_their_direction():
    """Of any length, in functions and under jit: those of the unit quaternion, with no derivative along the length."""
    model = _free_and_ball()
    rng = np.random.default_rng(0)
    q, (v, tau) = jnp.asarray(rng.normal(size=model.nq)), jnp.asarray(rng.normal(size=(2, model.nv)))
    scale = jnp.ones(model.nq).at[3:7].set(3.0).at[7:11].set(0.2)
    unit = jd.normalize(model, q)
    scene = jd.Scene(model, (jd.constraints.distance("arm", (0.1, 0, 0.2), None, (2.0, 0, 0), 1.0),))

    def values(q):
        return (
            jd.forward_kinematics(model, q),
            jd.mass_matrix(model, q),
            jd.forward_dynamics(model, q, v, tau),
            jd.integrate(model, q, v),
            jd.difference(model, unit, q),
            jd.constraint_jacobian(scene, q),
            jd.potential_energy(model, q),
        )

    compiled = quick(values)
    same(compiled(unit), compiled(unit * scale))
    same(values(unit), values(unit * scale))
    rate = quick(lambda q: jd.configuration_rate(model, q, v))
    np.testing.assert_allclose(rate(unit * scale)[3:], (rate(unit) * scale)[3:], rtol=1e-12)
    along = (unit * scale).at[:3].set(0.0)
    slopes = quick(lambda q: jax.jvp(values, (q,), (along,))[1])(unit * scale)
    assert all(np.abs(x).max() < 1e-12 for x in jax.tree.leaves(slopes))


@pytest.mark.parametrize("modes", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["smooth", "events"])
def test_motions_start_from_unit_quaternions(modes):
    """Others are refused where they are known, and end with a code where they are traced, beside lanes that go on."""
    model = jd.ModelBuilder("ball").add_body("ball", joint="spherical", inertia=jd.inertia.box(1.0, (1, 2, 3))).build()
    scene = jd.Scene(model, forces=(jd.contact.DryFriction(0.3, normal=1.0, along=0),) if modes else ())
    starts = jnp.asarray([[1.0, 0, 0, 0], [2.0, 0, 0, 0], [1.0002, 0, 0, 0], [0.0, 0, 0, 0], [jnp.nan, 0, 0, 0]])
    v0, options = jnp.asarray([1.0, 0.2, 0.1]), {"throw": False} | ({} if modes else {"stepsize": 0.05})
    with pytest.raises(ValueError, match=r"length 2 .*'ball_joint'"):
        jd.simulate(scene, starts[1], v0, [0.0, 0.1], **options)
    run = jax.jit(jax.vmap(lambda q: jd.simulate(scene, q, v0, [0.0, 0.1], **options)))
    computed = run(starts)
    codes = ["successful", "unnormalized_start", "successful", "nonfinite_start", "nonfinite_start"]
    for i, code in enumerate(codes):
        assert bool((computed.result == getattr(jd.RESULTS, code))[i]), code
    np.testing.assert_allclose(computed.q[2], computed.q[0], rtol=1e-12)
    assert np.isnan(computed.q[1]).all()


def test_codes_of_a_batch_print_as_words():
    """`RESULTS[...]` of one sample is its sentence, of a batch the sentences of all lanes; the same enumeration everywhere."""
    lanes = jax.vmap(lambda q: jd.constrained_dynamics(CHAIN, q, jnp.zeros(2)))(jnp.zeros((3, 2)))
    assert jd.RESULTS[lanes.result] == "['successful' 'successful' 'successful']" and lanes.success.all()
    one = jd.constrained_dynamics(CHAIN, jnp.zeros(2), jnp.zeros(2))
    assert jd.RESULTS[one.result] == "successful" and str(one.result) == repr(one.result) == "successful"
    assert str(lanes.result) == "['successful' 'successful' 'successful']" and "result=successful" in repr(one)
    stalled = jax.jit(lambda x: jd.RESULTS.where(x > 0, jd.RESULTS.successful, jd.RESULTS.stalled))(0.0)
    assert f"{stalled}" == "stalled" and "not solved to the tolerance" in jd.RESULTS[stalled]
    assert repr(pickle.loads(pickle.dumps(stalled))) == "stalled"
    with pytest.raises(ValueError, match="compared with 0"):
        assert one.result == 0


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: jd.Scene(CHAIN), r"pass scene\.system"),
        (lambda: jd.Scene("arm"), "system is a str"),
        # Batches without vmap.
        (lambda: jd.reduced_dynamics(CHAIN, Q, jnp.ones((4, 1)), basis=(0,)), r"nu .*jax\.vmap"),
        (lambda: jd.constraint_forces(CHAIN, Q, jnp.ones((4, 1))), r"multipliers .*jax\.vmap"),
        # Functions of other arguments.
        (
            lambda: jd.simulate(jd.Scene(ARM, forces=(stiffer,)), [0, 0], [0, 0], [0, 1], stepsize=0.1),
            r"forces\[0\] takes",
        ),
        (lambda: jd.Holonomic(lambda q: q), r"phi takes \(q\), but is called as \(q, t\)"),
        (lambda: jd.Holonomic(lambda q, t: q, with_system=True), r"called as \(system, q, t\)"),
        (lambda: jd.Pfaffian(lambda q: q), r"A takes \(q\), but is called as \(q, t\)"),
        (lambda: jd.Pfaffian(lambda q, t: q, lambda q: q), r"b takes \(q\)"),
        (lambda: jd.LagrangianSystem(lambda q: q, 1), r"lagrangian takes \(q\), but is called as \(q, v\)"),
        (lambda: jd.LagrangianSystem(lambda q, v: q, 1, parameters=1.0), r"called as \(q, v, t, parameters\)"),
        (lambda: jd.MetricSystem(lambda q, v: q, 1), r"metric takes \(q, v\), but is called as \(q\)"),
        (lambda: jd.forces.RayleighDissipation(lambda v: v @ v), r"called as \(q, v, t\)"),
        (lambda: hybrid(lambda q, v: q), r"task \(of position\) takes \(q, v\), but is called as \(q\)"),
        (lambda: hybrid(lambda q: q, of="velocity"), r"task \(of velocity\) takes \(q\), but is called as \(q, v\)"),
        (lambda: hybrid(lambda q: q, target=lambda t, x: x), r"target takes \(t, x\), but is called as \(t\)"),
        (lambda: hybrid(lambda q: q, force=lambda: 0), r"force takes \(\), but is called as \(t\)"),
    ],
)
def test_what_does_not_fit_is_refused_when_it_is_given(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def hybrid(task, of="position", target=(0.0,), **options):
    kd = 1.0 if of == "position" else None
    return jd.control.HybridForce(jd.scenes.four_bar(), task, target, 1.0, kd, of=of, **options)


def _raises(q, v, t):
    raise KeyError("of the law")


RETURNS = {
    "constraint 'own': the returned phi": lambda f: jd.Holonomic(lambda q, t: f(q), name="own").position(ARM, Q2, 0.0),
    "constraint 'own': the returned A": lambda f: jd.Pfaffian(lambda q, t: f(q), name="own").velocity(ARM, Q2, Q2, 0.0),
    "constraint 'own': the returned b": lambda f: jd.Pfaffian(
        lambda q, t: q, lambda q, t: f(q)[:1], name="own"
    ).velocity(ARM, Q2, Q2, 0.0),
    "bias_force": lambda f: jd.bias_force(jd.ExplicitSystem(lambda q: jnp.eye(2), lambda q, v: f(q), 2), Q2, Q2),
    "metric": lambda f: jd.geometry.flat(lambda q: f(jnp.eye(2)), Q2, Q2),
    "field": lambda f: jd.geometry.pull_back(f, lambda s: s)(Q2),
    "immersion": lambda f: jd.geometry.pull_back(lambda q: q, f)(Q2),
    "surface: f": lambda f: jd.contact.Parametrised(lambda a: f(jnp.ones(3))).point(Q2),
    "RayleighDissipation: function": lambda f: jd.forces.RayleighDissipation(lambda q, v, t: f(v)[0])(ARM, Q2, Q2, 0.0),
}


@pytest.mark.parametrize(("name", "call"), RETURNS.items())
def test_complex_results_of_functions_are_refused(name, call):
    """A cast to real numbers dropped the imaginary part without a word."""
    with pytest.raises(ValueError, match=f"^{name} is complex"):
        call(lambda x: x.astype(complex))


def test_functions_may_return_lists_of_numbers():
    """Within a trace they ended in JAX's error on arrays of numpy."""
    zero = jnp.zeros(2)
    spring = lambda system, q, v, t: [-q[0], -2.0 * q[1]]  # noqa: E731
    held = jd.ExplicitSystem(lambda q: [[2.0 + q[0], 0.0], [0.0, 4.0]], lambda q, v: [q[0], q[1]], 2)
    same(jax.jit(lambda q: jd.forward_dynamics(held, q, zero, zero))(Q2), -Q2 / jnp.asarray([3.0, 4.0]))
    pulled = jd.constrained_dynamics(jd.Scene(held, forces=[spring]), Q2, zero).acceleration
    same(pulled, jnp.asarray([-2.0 / 3.0, -0.75]))
    same(jd.geometry.flat(lambda q: [[q[0], 0.0], [0.0, q[1]]], Q2, 3 * Q2), 3 * Q2)


@pytest.mark.parametrize("way", ["simulate", "stepper"])
def test_an_error_inside_a_traced_law_is_told_in_few_lines(way):
    """Under jit, vmap and grad the user reads the frames of his own code and of the library, and no program of JAX."""
    arm, zero = jd.robots.chain(2), jnp.zeros(2)
    step = jd.stepper(arm, 0.1)

    def end(v):
        if way == "simulate":
            return jd.simulate(arm, zero, v, jnp.array([0.0, 0.1]), control=_raises).q[-1, 0]
        return jax.lax.scan(lambda state, _: (step(state, _raises), None), (zero, v), length=3)[0][0][0]

    with pytest.raises(KeyError, match="of the law") as caught:
        jax.jit(jax.vmap(jax.grad(end)))(jnp.ones((3, 2)))
    text = "".join(traceback.format_exception(caught.value))
    assert len(text.splitlines()) < 100 and "{ lambda" not in text


@pytest.mark.long
@pytest.mark.filterwarnings("error")
def test_scenes_are_built_without_a_warning():
    """In single precision, as a new process has it; Allegro's file alone holds inertias of no body."""
    with jax.enable_x64(False):
        for name in sorted(set(jd.scenes.names()) - {"allegro_with_cube"}):
            scene = getattr(jd.scenes, name)
            scene()
            # The starts of these take seconds to assemble, and other tests have them.
            if name not in ("coordinated_lifting", "sphere_arm"):
                scene.start()
