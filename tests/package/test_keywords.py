"""Public functions take each of their keywords; they and classes that users make refuse what they cannot use, by its name."""

# pyright: reportArgumentType=false

import inspect
import itertools
import operator
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd

ARM = jd.robots.iiwa()
HAND = ARM.body_names[-1]
Q, V, A = (jnp.linspace(a, b, 7) for a, b in ((0.1, 0.9), (-1.0, 1.0), (2.0, -1.0)))
PUSH = jnp.ones((7, 6))
BAR, (BQ, BV) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
LAM = jd.constrained_dynamics(BAR, BQ, BV).multipliers
GRASP, (GQ, _) = jd.scenes.hand_with_ball(), jd.scenes.hand_with_ball.start()
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


def args(*args, **given):
    """Arguments without a default, and keywords that need another value than their default or that of USUAL."""
    return args, given


USUAL = {"t": 0.3, "external": PUSH, "rank_tol": 1e-8}
CALLS = {
    "assemble": args(BAR, BQ, v=BV, hold={"1": BQ[0]}, guesses=2, steps=2, atol=1e-09),
    "bias_force": args(PLANE, jnp.ones(2), jnp.ones(2)),
    "constrained_dynamics": args(BAR, BQ, BV, tau=BV, method="rank_aware"),
    "constrained_inverse_dynamics": args(
        BAR, BQ, BV, jnp.ones(1), motors=["1"], independent=["1"], weights=jnp.ones(1), throw=False
    ),
    "constraint_forces": args(BAR, BQ, LAM),
    "constraint_jacobian": args(BAR, BQ),
    "constraints.distance": args(None, (0, 0, 0), "a", (0, 0, 1), 1.0, name="rod"),
    "constraints.gear": args("a", "b", 2.0, offset=0.1, name="gear"),
    "constraints.knife_edge": args("a", plane_body="b", contact=False, name="skate"),
    "constraints.lock_joint": args("a", value=0.2, name="lock"),
    "constraints.loop": args(None, np.eye(4), "a", np.eye(4), joint="point", in_plane=True, name="loop"),
    "constraints.choose_rows": args(BAR, BQ),
    "constraints.position_residual": args(BAR, BQ),
    "constraints.projections": args(BAR, BQ),
    "constraints.rolling_sphere": args("a", (0, 0, 0), 0.2, name="ball"),
    "constraints.rolling_wheel": args("a", np.eye(4), 0.2, name="wheel"),
    "constraints.second_fundamental_form": args(BAR, BQ, BV),
    "constraints.velocity_residual": args(BAR, BQ, BV),
    "contact.contact_forces": args(GRASP, GLAM, cones=CONE, smoothing=0.1),
    "contact.force_closure_of_map": args(G3, [CONE] * 3, faces=6, side="inscribed"),
    "contact.friction_cone": args("soft-finger", mu=0.5, gamma=0.1),
    "contact.gap_contact": args(lambda q, t: q[0], along=lambda q, t: q[1:], friction=0.3, static=0.4),
    "contact.ground_contact": args("a", friction=0.3, static=0.4, plane_body="b", name="foot"),
    "contact.shape_contacts": args(
        "a",
        jd.contact.Sphere(0.1),
        pose=(0, 0, 0.1),
        on=jd.contact.Plane(),
        surface=(0, 0, 0.1),
        surface_body="b",
        friction=0.3,
        static=0.4,
        name="foot",
    ),
    "contact.optimal_forces": args(
        G3, jnp.ones(6), [CONE] * 3, preload=0.1, target=jnp.ones(9), weights=jnp.ones(9), tol=1e-08
    ),
    "contact.rolling_contact": args("a", jd.contact.Sphere(0.1), "b", jd.contact.Plane(), spin=True, name="rolling"),
    "contact.solve_qp": args(jnp.eye(9), jnp.ones(9), A=G3, b=jnp.ones(6), tol=1e-08, max_steps=20),
    "contact.wrench_basis": args("hard-finger", in_plane=True),
    "control.foot": args("FL_foot", CONE, pose=np.eye(4), ground=np.eye(3)),
    "control.ilqr": args(
        lambda x, u: x + u,
        lambda x, u, k: u @ u,
        lambda x: x @ x,
        jnp.ones(1),
        jnp.zeros((2, 1)),
        limits=(-1.0, 1.0),
        iterations=2,
        tol=1e-06,
        regularization=0.1,
        second_order=True,
    ),
    "control.missing_wrench": args(DOG, DQ, DV, DV, FEET, passive=tuple(range(6))),
    "control.standing": args(DOG, DQ, FEET, forces=(jd.forces.JointDamping(0.1),)),
    "control.underactuated_inverse_dynamics": args(
        DOG, DQ, DV, DV, FEET, passive=tuple(range(6)), preload=1.0, torque_weight=2.0, effort_limit=90.0, tol=1e-08
    ),
    "coriolis_matrix": args(PLANE, jnp.ones(2), jnp.ones(2)),
    "degrees_of_freedom": args(BAR, BQ),
    "dynamics.articulated_bodies": args(ARM, Q, V, A),
    "dynamics.generalized_force": args(ARM, Q, PUSH, axes="inertial"),
    "dynamics.joint_wrench": args(ARM, Q, V, A, joint=ARM.joint_names[2], axes="world"),
    "dynamics.rnea": args(ARM, Q, V, A),
    "dynamics.workspace_dynamics": args(ARM, HAND, Q, V, axes="world", rows=(0, 1, 2), least=0.001),
    "follow": args(ARM, {HAND: jnp.broadcast_to(jd.frame_pose(ARM, Q, HAND), (2, 4, 4))}, Q, guesses=2, throw=False),
    "forces.elastic_joints": args(
        ARM, 10000.0, 0.0001, damping=1.0, gear=50.0, joints=ARM.joint_names[:2], suffix="_m"
    ),
    "forces.external_wrenches": args(jd.Scene(ARM, forces=[jd.forces.ExternalWrench(HAND, jnp.ones(6))]), Q, V),
    "forward_dynamics": args(ARM, Q, V, A),
    "frame_jacobian": args(ARM, Q, HAND, axes="body"),
    "geometry.christoffel_symbols": args(PLANE, jnp.ones(2), kind="first"),
    "geometry.constrain_by_immersion": args(
        jd.scenes.particle_in_plane().system, lambda x: jnp.stack([x[0], x[0] ** 2]), 1
    ),
    "grasp.contact": args("hard-finger", "tip", np.eye(4), object="ball", in_plane=False, name="touch"),
    "grasp.force_closure": args(GRASP, GQ, cones=CONE, required=True),
    "grasp.forces_for_wrench": args(GRASP, GQ, jnp.ones(6), preload=1.0),
    "grasp.grasp_map": args(GRASP, GQ),
    "grasp.hand_dynamics": args(GRASP, GQ, NU, tau=jnp.zeros(GRASP.nv), motions=MOTIONS),
    "grasp.hand_jacobian": args(GRASP, GQ),
    "grasp.hand_motions": args(GRASP, GQ, sizes=(MOTIONS.object.shape[1], MOTIONS.internal.shape[1])),
    "grasp.hold": args(GRASP, GQ, wrench=jnp.ones(6), cones=CONE, preload=0.1),
    "grasp.internal_force_basis": args(GRASP, GQ, reference=jd.grasp.internal_force_basis(GRASP, GQ)),
    "grasp.internal_forces": args(GRASP, GQ, GLAM),
    "grasp.joint_torques": args(GRASP, GQ, GLAM),
    "grasp.manipulability": args(GRASP, GQ, length=0.1, motions=MOTIONS),
    "grasp.object_dynamics": args(GRASP, GQ, jnp.zeros(6), tau=jnp.zeros(GRASP.nv)),
    "grasp.point_contacts": args({"tip": ((0.1, 0, 0), (-1, 0, 0))}, kind="soft-finger"),
    "geometry.reaction_force": args(BEAD, jnp.ones(1), jnp.ones(1), force=jnp.zeros(2)),
    "gravity_force": args(PLANE, jnp.ones(2)),
    "identify.base_parameters": args(TWO, terms=("viscous",), v_s=0.1, seed=1),
    "identify.parameter_names": args(TWO, terms=("viscous",)),
    "inertia.displaced": args(jd.inertia.sphere(1.0, 0.1), (0.1, 0, 0), rotation=np.eye(3)),
    "inertia.is_feasible": args(jd.inertia.sphere(1.0, 0.1), tolerance=1e-06),
    "inertia.nearest_feasible": args(jd.inertia.sphere(1.0, 0.1), floor=1e-06),
    "inertia.point_mass": args(1.0, position=(1.0, 0, 0)),
    "inertia.rod": args(1.0, 2.0, axis="x"),
    "integrate": args(ARM, Q, V, dt=0.5),
    "inverse_dynamics": args(ARM, Q, V, A),
    "inverse_kinematics": args(
        ARM,
        {HAND: jd.frame_pose(ARM, Q, HAND)},
        Q,
        weights={HAND: 2.0},
        limits=False,
        posture=Q,
        steps=5,
        guesses=2,
        atol=1e-06,
        throw=False,
    ),
    "join": args(ARM, TWO, prefix="left_", pose=np.eye(4), name="both"),
    "kinetic_energy": args(PLANE, jnp.ones(2), jnp.ones(2)),
    "mass_matrix": args(PLANE, jnp.ones(2)),
    "newton_euler_matrices": args(ARM, Q, V, tip=HAND, base_twist=jnp.ones(6), base_twist_rate=jnp.ones(6)),
    "potential_energy": args(PLANE, jnp.ones(2)),
    "reduced_dynamics": args(BAR, BQ, jnp.ones(1), tau=BV, basis=(0,)),
    "reduction.gauge_invariant": args(BAR, BQ, BV, tau=BV, dof=1),
    "reduction.involutive": args(BAR, BQ, dof=1),
    "reduction.kane_equation": args(BAR, BQ, BV, tau=BV),
    "reduction.quasi_connection": args(PLANE, jnp.ones(2), jnp.ones(2)),
    "reduction.spurious_terms": args(BAR, BQ, jnp.ones(1), tau=BV, independent=(0,)),
    "reduction.tangent_basis": args(BAR, BQ, dof=1),
    "scale.member": args({"g": jnp.arange(4.0)}, 3, seed=2),
    "sensors.measure": args(ARM, [jd.sensors.Imu(HAND)], Q, V, tau=A, thrusts={HAND: jnp.ones(6)}),
    "sensors.record": args(
        ARM,
        [jd.sensors.Imu(HAND)],
        jnp.arange(2.0),
        jnp.stack([Q, Q]),
        jnp.stack([V, V]),
        tau=jnp.stack([A, A]),
        thrusts={HAND: jnp.ones((2, 6))},
        key=jax.random.key(0),
    ),
    "so3.euler_body_jacobian": args(jnp.ones(3), sequence="xyz"),
    "so3.euler_spatial_jacobian": args(jnp.ones(3), sequence="xyz"),
    "so3.euler_to_matrix": args(jnp.ones(3), sequence="xyz"),
    "stepper": args(TWO, 0.01, substeps=2, remat=False, adjoint="forward"),
    "stiffness": args(TWO, jnp.ones(2), jnp.ones(2), control=lambda q, v, t: -v),
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


def all_keywords(name: str, function) -> dict[str, object]:
    """Keywords of a call or a class with the values that they have here."""
    defaults = keywords_of(function)
    usual = {key: value for key, value in USUAL.items() if key in defaults} if name in CALLS else {}
    return defaults | usual | (CALLS | CLASSES)[name][1]


FUNCTIONS = public_functions()
BUILDERS = [name for name in FUNCTIONS if name.startswith(("scenes.", "robots."))]


def run_of(name):
    """Run a call, or trace it only: nothing is compiled."""
    return (lambda call: call()) if name in OF_NUMBERS else eqx.filter_eval_shape


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(CALLS))
def test_every_keyword_is_accepted(name):
    """All keywords at once."""
    function = FUNCTIONS[name]
    run_of(name)(lambda: function(*CALLS[name][0], **all_keywords(name, function)))


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILDERS)
def test_every_number_of_a_named_scene_is_accepted(name):
    needed = {"robots.random_tree": {"seed": 0, "nb": 3}, "robots.chain": {"n": 2}}.get(name, {})
    FUNCTIONS[name](**keywords_of(FUNCTIONS[name]), **needed)


# Values that fit no argument but those of `IGNORED`.
VALUES = {"text": "zzz", "object": object(), "mapping": {"zzz": 1.0}, "none": None, "not a number": float("nan")}
IGNORED = {
    ("forward_dynamics", "t"): "the motion of bodies does not depend on it",
    ("inverse_dynamics", "t"): "as above",
    ("contact.gap_contact", "name"): "None is the default name",
    ("contact.DryFriction", "name"): "as above",
    ("ModelBuilder", "gravity"): "None is no gravity",
}
FLOWING = ("t", "preload", "dt")
CLASSES = {
    **dict.fromkeys(
        """events.ContactLost events.JointLimit events.ModeSwitches identify.Objective identify.Solver
        ModelBuilder Multipliers Projected Reduced Variational simulation.Baumgarte sensors.Noise""".split(),
        args(),
    ),
    "contact.DryFriction": args(0.3, 1.0, static=0.4, smoothing=0.1),
    "contact.Parametrised": args(lambda u: jnp.array([u[0], u[1], 0.0])),
    "contact.Sphere": args(0.1),
    "contact.UnilateralContact": args(jd.rolling_sphere("a", (0, 0, 0), 0.1, spin=False), static=0.2),
    "control.CartesianStiffness": args(ARM, HAND, lambda t: jnp.eye(4), 10.0, 1.0),
    "control.GraspForce": args(GRASP, lambda t: jnp.eye(4), 10.0, 1.0, ki=0.1),
    "control.HybridForce": args(BAR, lambda q: q[:1], lambda t: jnp.zeros(1), 4.0, kd=1.0),
    "control.OperationalSpace": args(ARM, HAND, lambda t: jnp.eye(4), 10.0, 1.0, posture=Q),
    "forces.CoulombFriction": args(level=0.1, joints="a"),
    "forces.Drive": args(1.0, 0.1, 0.0, effort_limit=1.0, joints="a"),
    "forces.EffortLimits": args(limit=2.0),
    "forces.ElasticTransmission": args("a", "b", 1.0),
    "forces.ExternalWrench": args("a", jnp.zeros(6)),
    "forces.FirstOrderDrive": args(0.1, joints="a"),
    "forces.JointDamping": args(coefficient=0.1, joints="a"),
    "forces.JointSpring": args(1.0, rest=0.1, joints="a"),
    "forces.JointStops": args(joints="a"),
    "forces.SecondOrderDrive": args(1.0, joints="a"),
    "forces.SlidingFriction": args(0.1, 1.0, 1),
    "identify.Measured": args(ARM, position_bias=Q, torque_gain=Q, torque_bias=Q),
    "Holonomic": args(lambda q, t: q[:1]),
    "Pfaffian": args(lambda q, t: q[None], b=lambda q, t: q[:1]),
    "MetricSystem": args(lambda q: jnp.eye(2), 2, potential=lambda q: q @ q),
    "LagrangianSystem": args(lambda q, v: v @ v, 2, potential=lambda q: q @ q),
    "ExplicitSystem": args(lambda q: jnp.eye(2), lambda q, v: v, 2, potential=lambda q: q @ q),
    "sensors.Encoder": args("a", resolution=0.1, noise=jd.sensors.Noise(0.1)),
    "sensors.ForceTorque": args("a", noise=jd.sensors.Noise(0.1)),
    "sensors.FramePose": args("a", noise=jd.sensors.Noise(0.1)),
    "sensors.Imu": args("a", noise=jd.sensors.Noise(0.1)),
}


@pytest.mark.parametrize("name", [*sorted(CALLS), *sorted(CLASSES)])
def test_what_cannot_be_used_is_refused(name, as_users_have_it):
    """By a ValueError with the name of the keyword or the value."""
    function, args, wrong = operator.attrgetter(name)(jd), (CALLS | CLASSES)[name][0], []
    at_once = name in CLASSES or name.startswith(("constraints.", "contact."))
    run = (lambda call: call()) if at_once else run_of(name)
    keywords = all_keywords(name, function)
    for key, kind in itertools.product(keywords, VALUES):
        value, is_name = VALUES[kind], isinstance(keywords[key], str) or key.endswith(("name", "body", "object"))
        # States, times and forces that are not a number give results that are none, as everywhere in JAX.
        if (
            (name, key) in IGNORED
            or (key in FLOWING and kind == "not a number")
            or (value is None and keywords_of(function).get(key, 0) is None)
            or (kind == "text" and is_name)
        ):
            continue
        try:
            run(lambda key=key, value=value: function(*args, **{**keywords, key: value}))
        except ValueError as error:
            if key not in str(error) and "zzz" not in str(error):
                wrong.append(f"{key}, {kind}: {error}")
        except Exception as error:
            wrong.append(f"{key}, {kind}: {type(error).__name__}: {error}")
        else:
            wrong.append(f"{key}, {kind}: accepted")
    assert not wrong, "\n".join(wrong)
