"""Public functions take each of their keywords; they and classes that users make refuse what they cannot use, by its name."""

# pyright: reportArgumentType=false

import inspect
import operator
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.contact import Plane, Sphere

ARM = jd.robots.iiwa()
HAND = ARM.body_names[-1]
Q, V, A = (jnp.linspace(a, b, 7) for a, b in ((0.1, 0.9), (-1.0, 1.0), (2.0, -1.0)))
PUSH = jnp.ones((7, 6))
BAR, (BQ, BV) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
LAM = jd.constrained_dynamics(BAR, BQ, BV).multipliers
GRASP, (GQ, GV) = jd.scenes.hand_with_ball(), jd.scenes.hand_with_ball.start()
GLAM = jnp.zeros(9)
MOTIONS = jd.grasp.hand_motions(GRASP, GQ)
NU = jnp.zeros(MOTIONS.object.shape[1] + MOTIONS.internal.shape[1])
DOG = jd.robots.quadruped(floating_base=True)
FEET = [
    jd.control.foot(name, jd.contact.friction_cone("hard-finger", mu=0.6)) for name in ("FL_foot", "RR_foot", "RL_foot")
]
DQ, DV = jd.neutral(DOG), jnp.zeros(DOG.nv)
CONE = jd.contact.friction_cone("hard-finger", mu=0.5)
PLANE = jd.MetricSystem(lambda q: jnp.diag(1.0 + q * q), 2)
BEAD = jd.geometry.constrain_by_immersion(
    jd.scenes.particle_in_plane().system, lambda x: jnp.stack([x[0], x[0] ** 2]), 1
)
G3 = jnp.asarray(np.random.default_rng(0).normal(size=(6, 9)))
TWO = jd.robots.chain(2)
WEIGHTS = {"weights": jnp.ones(9)}

# Arguments without a default, by function; what follows are keywords that need another value than their default.
CALLS = {
    "assemble": ((BAR, BQ), {"v": BV, "hold": {"1": BQ[0]}, "guesses": 2, "steps": 2, "atol": 1e-9, "rank_tol": 1e-8}),
    "bias_force": ((PLANE, jnp.ones(2), jnp.ones(2)), {"t": 0.3}),
    "constrained_dynamics": ((BAR, BQ, BV), {"tau": BV, "t": 0.3, "method": "rank_aware", "rank_tol": 1e-8}),
    "constrained_inverse_dynamics": (
        (BAR, BQ, BV, jnp.ones(1)),
        {"t": 0.3, "motors": ["1"], "independent": ["1"], "weights": jnp.ones(1), "rank_tol": 1e-8, "throw": False},
    ),
    "constraint_forces": ((BAR, BQ, LAM), {"t": 0.3}),
    "constraint_jacobian": ((BAR, BQ), {"t": 0.3}),
    "constraints.distance": ((None, (0, 0, 0), "a", (0, 0, 1), 1.0), {"name": "rod"}),
    "constraints.gear": (("a", "b", 2.0), {"offset": 0.1, "name": "gear"}),
    "constraints.knife_edge": (("a",), {"plane_body": "b", "contact": False, "name": "skate"}),
    "constraints.lock_joint": (("a",), {"value": 0.2, "name": "lock"}),
    "constraints.loop": ((None, np.eye(4), "a", np.eye(4)), {"joint": "point", "in_plane": True, "name": "loop"}),
    "constraints.choose_rows": ((BAR, BQ), {"t": 0.3}),
    "constraints.projections": ((BAR, BQ), {"t": 0.3, "rank_tol": 1e-8}),
    "constraints.rolling_sphere": (("a", (0, 0, 0), 0.2), {"name": "ball"}),
    "constraints.rolling_wheel": (("a", np.eye(4), 0.2), {"name": "wheel"}),
    "constraints.second_fundamental_form": ((BAR, BQ, BV), {"t": 0.3, "rank_tol": 1e-8}),
    "contact.contact_forces": ((GRASP, GLAM), {"cones": CONE, "smoothing": 0.1}),
    "contact.force_closure_of_map": ((G3, [CONE] * 3), {"faces": 6, "side": "inscribed"}),
    "contact.friction_cone": (("soft-finger",), {"mu": 0.5, "gamma": 0.1}),
    "contact.gap_contact": ((lambda q, t: q[0],), {"along": lambda q, t: q[1:], "friction": 0.3, "static": 0.4}),
    "contact.ground_contact": (("a",), {"friction": 0.3, "static": 0.4, "plane_body": "b", "name": "foot"}),
    "contact.shape_contacts": (
        ("a", Sphere(0.1)),
        {
            "pose": (0, 0, 0.1),
            "on": Plane(),
            "surface": (0, 0, 0.1),
            "surface_body": "b",
            "friction": 0.3,
            "static": 0.4,
            "name": "foot",
        },
    ),
    "contact.optimal_forces": (
        (G3, jnp.ones(6), [CONE] * 3),
        {"preload": 0.1, "target": jnp.ones(9), "weights": jnp.ones(9), "tol": 1e-8},
    ),
    "contact.rolling_contact": (("a", Sphere(0.1), "b", Plane()), {"spin": True, "name": "rolling"}),
    "contact.solve_qp": ((jnp.eye(9), jnp.ones(9)), {"A": G3, "b": jnp.ones(6), "tol": 1e-8, "max_steps": 20}),
    "contact.wrench_basis": (("hard-finger",), {"in_plane": True}),
    "control.foot": (("FL_foot", CONE), {"pose": np.eye(4), "ground": np.eye(3)}),
    "control.ilqr": (
        (lambda x, u: x + u, lambda x, u, k: u @ u, lambda x: x @ x, jnp.ones(1), jnp.zeros((2, 1))),
        {"limits": (-1.0, 1.0), "iterations": 2, "tol": 1e-6, "regularization": 0.1, "second_order": True},
    ),
    "control.missing_wrench": ((DOG, DQ, DV, DV, FEET), {"passive": tuple(range(6))}),
    "control.standing": ((DOG, DQ, FEET), {"forces": (jd.forces.JointDamping(0.1),)}),
    "control.underactuated_inverse_dynamics": (
        (DOG, DQ, DV, DV, FEET),
        {"passive": tuple(range(6)), "preload": 1.0, "torque_weight": 2.0, "effort_limit": 90.0, "tol": 1e-8},
    ),
    "coriolis_matrix": ((PLANE, jnp.ones(2), jnp.ones(2)), {"t": 0.3}),
    "degrees_of_freedom": ((BAR, BQ), {"t": 0.3, "rank_tol": 1e-8}),
    "dynamics.articulated_bodies": ((ARM, Q, V, A), {"external": PUSH}),
    "dynamics.generalized_force": ((ARM, Q, PUSH), {"axes": "inertial"}),
    "dynamics.joint_wrench": ((ARM, Q, V, A), {"joint": ARM.joint_names[2], "external": PUSH, "axes": "world"}),
    "dynamics.rnea": ((ARM, Q, V, A), {"external": PUSH}),
    "dynamics.workspace_dynamics": ((ARM, HAND, Q, V), {"axes": "world", "rows": (0, 1, 2), "least": 1e-3}),
    "follow": (
        (ARM, {HAND: jnp.broadcast_to(jd.frame_pose(ARM, Q, HAND), (2, 4, 4))}, Q),
        {"guesses": 2, "t": 0.3, "throw": False},
    ),
    "forces.elastic_joints": (
        (ARM, 1e4, 1e-4),
        {"damping": 1.0, "gear": 50.0, "joints": ARM.joint_names[:2], "suffix": "_m"},
    ),
    "forces.external_wrenches": (
        (jd.Scene(ARM, forces=[jd.forces.ExternalWrench(HAND, jnp.ones(6))]), Q, V),
        {"t": 0.3},
    ),
    "forward_dynamics": ((ARM, Q, V, A), {"t": 0.3, "external": PUSH}),
    "frame_jacobian": ((ARM, Q, HAND), {"axes": "body"}),
    "geometry.christoffel_symbols": ((PLANE, jnp.ones(2)), {"kind": "first", "t": 0.3}),
    "geometry.constrain_by_immersion": (
        (jd.scenes.particle_in_plane().system, lambda x: jnp.stack([x[0], x[0] ** 2]), 1),
        {},
    ),
    "grasp.contact": (("hard-finger", "tip", np.eye(4)), {"object": "ball", "in_plane": False, "name": "touch"}),
    "grasp.force_closure": ((GRASP, GQ), {"cones": CONE, "t": 0.3, "required": True}),
    "grasp.forces_for_wrench": ((GRASP, GQ, jnp.ones(6)), {"preload": 1.0, "t": 0.3}),
    "grasp.grasp_map": ((GRASP, GQ), {"t": 0.3}),
    "grasp.hand_dynamics": ((GRASP, GQ, NU), {"tau": jnp.zeros(GRASP.nv), "t": 0.3, "motions": MOTIONS}),
    "grasp.hand_jacobian": ((GRASP, GQ), {"t": 0.3}),
    "grasp.hand_motions": ((GRASP, GQ), {"t": 0.3, "sizes": (MOTIONS.object.shape[1], MOTIONS.internal.shape[1])}),
    "grasp.hold": ((GRASP, GQ), {"wrench": jnp.ones(6), "cones": CONE, "preload": 0.1, "t": 0.3}),
    "grasp.internal_force_basis": ((GRASP, GQ), {"t": 0.3, "reference": jd.grasp.internal_force_basis(GRASP, GQ)}),
    "grasp.internal_forces": ((GRASP, GQ, GLAM), {"t": 0.3}),
    "grasp.joint_torques": ((GRASP, GQ, GLAM), {"t": 0.3}),
    "grasp.manipulability": ((GRASP, GQ), {"t": 0.3, "length": 0.1, "motions": MOTIONS}),
    "grasp.object_dynamics": ((GRASP, GQ, jnp.zeros(6)), {"tau": jnp.zeros(GRASP.nv), "t": 0.3}),
    "grasp.point_contacts": (({"tip": ((0.1, 0, 0), (-1, 0, 0))},), {"kind": "soft-finger"}),
    "geometry.reaction_force": ((BEAD, jnp.ones(1), jnp.ones(1)), {"force": jnp.zeros(2), "t": 0.3}),
    "gravity_force": ((PLANE, jnp.ones(2)), {"t": 0.3}),
    "identify.base_parameters": ((TWO,), {"terms": ("viscous",), "v_s": 0.1, "seed": 1}),
    "identify.parameter_names": ((TWO,), {"terms": ("viscous",)}),
    "inertia.displaced": ((jd.inertia.sphere(1.0, 0.1), (0.1, 0, 0)), {"rotation": np.eye(3)}),
    "inertia.is_feasible": ((jd.inertia.sphere(1.0, 0.1),), {"tolerance": 1e-6}),
    "inertia.nearest_feasible": ((jd.inertia.sphere(1.0, 0.1),), {"floor": 1e-6}),
    "inertia.point_mass": ((1.0,), {"position": (1.0, 0, 0)}),
    "inertia.rod": ((1.0, 2.0), {"axis": "x"}),
    "integrate": ((ARM, Q, V), {"dt": 0.5}),
    "inverse_dynamics": ((ARM, Q, V, A), {"t": 0.3, "external": PUSH}),
    "inverse_kinematics": (
        (ARM, {HAND: jd.frame_pose(ARM, Q, HAND)}, Q),
        {
            "weights": {HAND: 2.0},
            "limits": False,
            "posture": Q,
            "steps": 5,
            "guesses": 2,
            "atol": 1e-6,
            "t": 0.3,
            "throw": False,
        },
    ),
    "join": ((ARM, TWO), {"prefix": "left_", "pose": np.eye(4), "name": "both"}),
    "kinetic_energy": ((PLANE, jnp.ones(2), jnp.ones(2)), {"t": 0.3}),
    "mass_matrix": ((PLANE, jnp.ones(2)), {"t": 0.3}),
    "newton_euler_matrices": ((ARM, Q, V), {"tip": HAND, "base_twist": jnp.ones(6), "base_twist_rate": jnp.ones(6)}),
    "potential_energy": ((PLANE, jnp.ones(2)), {"t": 0.3}),
    "reduced_dynamics": ((BAR, BQ, jnp.ones(1)), {"tau": BV, "t": 0.3, "basis": (0,)}),
    "reduction.gauge_invariant": ((BAR, BQ, BV), {"tau": BV, "t": 0.3, "dof": 1, "rank_tol": 1e-8}),
    "reduction.involutive": ((BAR, BQ), {"t": 0.3, "dof": 1, "rank_tol": 1e-8}),
    "reduction.kane_equation": ((BAR, BQ, BV), {"tau": BV, "t": 0.3}),
    "reduction.quasi_connection": ((PLANE, jnp.ones(2), jnp.ones(2)), {"t": 0.3}),
    "reduction.spurious_terms": ((BAR, BQ, jnp.ones(1)), {"tau": BV, "t": 0.3, "independent": (0,)}),
    "reduction.tangent_basis": ((BAR, BQ), {"t": 0.3, "dof": 1, "rank_tol": 1e-8}),
    "scale.member": (({"g": jnp.arange(4.0)}, 3), {"seed": 2}),
    "sensors.measure": ((ARM, [jd.sensors.Imu(HAND)], Q, V), {"tau": A, "t": 0.3, "thrusts": {HAND: jnp.ones(6)}}),
    "sensors.record": (
        (ARM, [jd.sensors.Imu(HAND)], jnp.arange(2.0), jnp.stack([Q, Q]), jnp.stack([V, V])),
        {"tau": jnp.stack([A, A]), "thrusts": {HAND: jnp.ones((2, 6))}, "key": jax.random.key(0)},
    ),
    "so3.euler_body_jacobian": ((jnp.ones(3),), {"sequence": "xyz"}),
    "so3.euler_spatial_jacobian": ((jnp.ones(3),), {"sequence": "xyz"}),
    "so3.euler_to_matrix": ((jnp.ones(3),), {"sequence": "xyz"}),
    "stepper": ((TWO, 0.01), {"substeps": 2, "remat": False, "adjoint": "forward"}),
    "stiffness": ((TWO, jnp.ones(2), jnp.ones(2)), {"t": 0.3, "control": lambda q, v, t: -v}),
}
# Functions that decide by numbers, or call SciPy.
OF_NUMBERS = {
    *("contact.force_closure_of_map", "grasp.force_closure", "reduction.involutive"),
    *("identify.base_parameters", "identify.parameter_names", "scale.member"),
}


def public_functions() -> dict[str, object]:
    """Public functions with keywords, by their names below `jd`."""
    found, seen = {}, set()

    def walk(namespace, prefix):
        for name in dir(namespace):
            value = getattr(namespace, name)
            if isinstance(value, types.ModuleType):
                if not prefix and "__dir__" in vars(value):
                    walk(value, f"{name}.")
            elif callable(value) and not inspect.isclass(value) and id(value) not in seen:
                seen.add(id(value))
                if keywords_of(value):
                    found[prefix + name] = value

    walk(jd, "")
    return found


def keywords_of(function) -> dict[str, object]:
    """Arguments with a default, and these."""
    known = inspect.signature(function).parameters.values()
    return {one.name: one.default for one in known if one.default is not one.empty}


FUNCTIONS = public_functions()
BUILDERS = [name for name in FUNCTIONS if name.startswith(("scenes.", "robots."))]


def run_of(name):
    """Run a call, or trace it only: nothing is compiled."""
    return (lambda call: call()) if name in OF_NUMBERS else eqx.filter_eval_shape


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(CALLS))
def test_every_keyword_is_accepted(name):
    """All keywords at once."""
    args, given = CALLS[name]
    run_of(name)(lambda: FUNCTIONS[name](*args, **(keywords_of(FUNCTIONS[name]) | given)))


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILDERS)
def test_every_number_of_a_named_scene_is_accepted(name):
    needed = {"robots.random_tree": {"seed": 0, "nb": 3}, "robots.chain": {"n": 2}}.get(name, {})
    FUNCTIONS[name](**keywords_of(FUNCTIONS[name]), **needed)


# Values that fit no argument but those of `ACCEPTED`.
VALUES = {"text": "zzz", "object": object(), "mapping": {"zzz": 1.0}, "none": None, "not a number": float("nan")}
TARGET = lambda t: jnp.zeros(7)  # noqa: E731
IGNORED = {
    ("forward_dynamics", "t"): "the motion of bodies does not depend on it",
    ("inverse_dynamics", "t"): "as above",
    ("contact.gap_contact", "name"): "None is the default name",
    ("contact.DryFriction", "name"): "as above",
    ("ModelBuilder", "gravity"): "None is no gravity",
}
FLOWING = ("t", "preload", "dt")
CLASSES = {
    "contact.DryFriction": ((0.3, 1.0), {"static": 0.4, "smoothing": 0.1}),
    "contact.Parametrised": ((lambda u: jnp.array([u[0], u[1], 0.0]),), {}),
    "contact.Sphere": ((0.1,), {}),
    "contact.UnilateralContact": ((jd.rolling_sphere("a", (0, 0, 0), 0.1, spin=False),), {"static": 0.2}),
    "control.CartesianStiffness": ((ARM, HAND, lambda t: jnp.eye(4), 10.0, 1.0), {}),
    "control.GraspForce": ((GRASP, lambda t: jnp.eye(4), 10.0, 1.0), {"ki": 0.1}),
    "control.HybridForce": ((BAR, lambda q: q[:1], lambda t: jnp.zeros(1), 4.0), {"kd": 1.0}),
    "control.OperationalSpace": ((ARM, HAND, lambda t: jnp.eye(4), 10.0, 1.0), {"posture": Q}),
    "events.ContactLost": ((), {}),
    "events.JointLimit": ((), {}),
    "events.ModeSwitches": ((), {}),
    "forces.CoulombFriction": ((), {"level": 0.1, "joints": "a"}),
    "forces.Drive": ((1.0, 0.1, 0.0), {"effort_limit": 1.0, "joints": "a"}),
    "forces.EffortLimits": ((), {"limit": 2.0}),
    "forces.ElasticTransmission": (("a", "b", 1.0), {}),
    "forces.ExternalWrench": (("a", jnp.zeros(6)), {}),
    "forces.FirstOrderDrive": ((0.1,), {"joints": "a"}),
    "forces.JointDamping": ((), {"coefficient": 0.1, "joints": "a"}),
    "forces.JointSpring": ((1.0,), {"rest": 0.1, "joints": "a"}),
    "forces.JointStops": ((), {"joints": "a"}),
    "forces.SecondOrderDrive": ((1.0,), {"joints": "a"}),
    "forces.SlidingFriction": ((0.1, 1.0, 1), {}),
    "identify.Measured": ((ARM,), {"position_bias": Q, "torque_gain": Q, "torque_bias": Q}),
    "identify.Objective": ((), {}),
    "identify.Solver": ((), {}),
    "Holonomic": ((lambda q, t: q[:1],), {}),
    "Pfaffian": ((lambda q, t: q[None],), {"b": lambda q, t: q[:1]}),
    "ModelBuilder": ((), {}),
    "MetricSystem": ((lambda q: jnp.eye(2), 2), {"potential": lambda q: q @ q}),
    "LagrangianSystem": ((lambda q, v: v @ v, 2), {"potential": lambda q: q @ q}),
    "ExplicitSystem": ((lambda q: jnp.eye(2), lambda q, v: v, 2), {"potential": lambda q: q @ q}),
    "Multipliers": ((), {}),
    "Projected": ((), {}),
    "Reduced": ((), {}),
    "Variational": ((), {}),
    "simulation.Baumgarte": ((), {}),
    "sensors.Encoder": (("a",), {"resolution": 0.1, "noise": jd.sensors.Noise(0.1)}),
    "sensors.ForceTorque": (("a",), {"noise": jd.sensors.Noise(0.1)}),
    "sensors.FramePose": (("a",), {"noise": jd.sensors.Noise(0.1)}),
    "sensors.Imu": (("a",), {"noise": jd.sensors.Noise(0.1)}),
    "sensors.Noise": ((), {}),
}


def wrong_outcomes(name, function, args, given, run):
    """What happened, for each keyword and value that was accepted or refused without the keyword's name or the value."""
    keywords = keywords_of(function) | given
    wrong = []
    for key, usual in keywords.items():
        for kind, value in VALUES.items():
            if (name, key) in IGNORED:
                continue
            # States, times and forces that are not a number give results that are none, as everywhere in JAX.
            if key in FLOWING and kind == "not a number":
                continue
            if (value is None and keywords_of(function).get(key, 0) is None) or (
                kind == "text" and (isinstance(usual, str) or key.endswith(("name", "body", "object")))
            ):
                continue
            try:
                run(lambda key=key, value=value: function(*args, **{**keywords, key: value}))
            except ValueError as error:
                if key not in str(error) and "zzz" not in str(error):
                    wrong.append(f"{name}: {key}, {kind}: {error}")
            except Exception as error:
                wrong.append(f"{name}: {key}, {kind}: {type(error).__name__}: {error}")
            else:
                wrong.append(f"{name}: {key}, {kind}: accepted")
    return wrong


@pytest.mark.parametrize("name", sorted(CALLS))
def test_functions_refuse_what_they_cannot_use(name, as_users_have_it):
    args, given = CALLS[name]
    run = (lambda call: call()) if name.startswith(("constraints.", "contact.")) else run_of(name)
    wrong = wrong_outcomes(name, FUNCTIONS[name], args, given, run)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_classes_refuse_what_they_cannot_use(name, as_users_have_it):
    function = operator.attrgetter(name)(jd)
    wrong = wrong_outcomes(name, function, *CLASSES[name], lambda call: call())
    assert not wrong, "\n".join(wrong)
