"""Surfaces that roll on each other: against the equations of Montana and of Lagrange, and spheres in closed form."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from pinocchio_bridge import quick
from refusals import refusals
from test_contact_montana import EGG, ETA, TIP, bump
from test_contact_montana import PAIRS as ALL_PAIRS

import jaxdyn as jd
from jaxdyn import scenes, se3
from jaxdyn.constraints.base import rows

PAIRS = {name: pair for name, pair in ALL_PAIRS.items() if name != "sphere on sphere"}
PAIRS["plane on ellipsoid"] = (TIP, jd.contact.Plane())
POSE_A = se3.exp(jnp.array([0.1, -0.2, 0.05, 0.3, 0.2, -0.4]))
POSE_B = se3.exp(jnp.array([-0.03, 0.02, 0.04, -0.5, 0.1, 0.6]))
STONE = (0.4, (0.01, -0.02, 0.005), (0.002, 0.003, 0.0025))


def quaternion(R):
    w = 0.5 * jnp.sqrt(1 + jnp.trace(R))
    return jnp.stack([w, *(jnp.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w))])


def joints_of(pose):
    return jnp.concatenate([pose[:3, 3], quaternion(pose[:3, :3])])


def two_bodies(surface_a, surface_b, **options):
    """Two free bodies whose surfaces touch."""
    builder = jd.ModelBuilder("two stones", gravity=(0.0, 0.0, -9.81))
    builder.add_body("object", None, "free", (1.5, (0.02, 0.0, 0.01), (0.02, 0.03, 0.025)))
    builder.add_body("tip", None, "free", STONE)
    touch = jd.contact.rolling_contact("object", surface_a, "tip", surface_b, pose_a=POSE_A, pose_b=POSE_B, **options)
    system = jd.contact.RollingModel(builder.build(), [touch])
    return jd.Scene(system, system.rows)


def one_body(surface_a, surface_b, **options):
    """A body on a surface that stands still."""
    builder = jd.ModelBuilder("a stone", gravity=(0.5, 0.2, -9.81))
    builder.add_body("stone", None, "free", STONE)
    system = jd.contact.RollingModel(
        builder.build(), [jd.contact.rolling_contact(None, surface_a, "stone", surface_b, **options)]
    )
    return jd.Scene(system, system.rows)


TWIST = jnp.array([0.2, -0.1, 0.3, 0.5, 0.4, -0.6])


# The others differ in the surfaces alone.
FAST = ("ellipsoid on plane",)


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in PAIRS]
)
def test_rows_and_rates_are_montanas(name):
    """Contact coordinates, their rates and the rows of a soft finger, at a place that was set up by g_of."""
    a, b = PAIRS[name]
    scene = two_bodies(a, b, spin=True)
    system = scene.system
    # V_c: twist of L_f against L_o; the object moves too, so that both sides are seen.
    V_c = jnp.array([0.02, -0.03, 0.0, 0.7, -0.4, 0.5])

    @quick
    def setting(eta):
        kinematics = jd.contact.montana(a, b, eta)
        object_pose = se3.exp(jnp.array([0.3, -0.2, 0.5, 0.2, -0.3, 0.1]))
        tip_pose = object_pose @ POSE_A @ jd.contact.relative_pose(a, b, eta) @ se3.inverse(POSE_B)
        joints = jnp.concatenate([joints_of(object_pose), joints_of(tip_pose)])
        to_tip = POSE_B @ kinematics.finger.pose
        tip_twist = se3.Ad_apply(to_tip, V_c) + se3.Ad_apply(se3.inverse(tip_pose) @ object_pose, TWIST)
        rolling = tip_twist - se3.Ad_apply(to_tip, V_c.at[3:5].set(0.0))
        return joints, kinematics.forward @ V_c, jnp.concatenate([TWIST, tip_twist]), jnp.concatenate([TWIST, rolling])

    joints, wanted_rate, v, rolling = setting(ETA)
    # A search from nearby comes to the place.
    q = quick(lambda joints, near: system.place(joints, near=near))(joints, np.asarray(ETA)[None, :4] + 0.05)

    @quick
    def compute(q, v):
        rate = jd.configuration_rate(system, q, v)
        eta, eta_rate = jax.jvp(system.contact_coordinates, (q,), (rate,))
        A, A_rate = jax.jvp(lambda q: jd.constraint_jacobian(scene, q), (q,), (rate,))
        return eta[0], eta_rate[0], A, A_rate @ v, rows(scene, q, v, 0.0)

    eta, eta_rate, A, A_rate_v, row = jax.tree.map(np.asarray, compute(q, v))
    v, rolling = np.asarray(v), np.asarray(rolling)
    np.testing.assert_allclose(eta, ETA, atol=1e-11)
    np.testing.assert_allclose(eta_rate, wanted_rate, atol=1e-10, rtol=1e-10)
    np.testing.assert_allclose(row.A, A, atol=1e-13)
    # A a = gamma is A v = const differentiated.
    np.testing.assert_allclose(row.gamma, -A_rate_v, atol=1e-9 * np.abs(A_rate_v).max())
    # The gap opens against the tip's outward normal; slips are those of V_c in any two directions; then the spin, about
    # the object's outward normal, which is the tip's inward one.
    np.testing.assert_allclose(A @ v, [0.0, *(A @ v)[1:3], -V_c[5]], atol=1e-12)
    np.testing.assert_allclose(np.hypot(*(A @ v)[1:3]), np.hypot(*V_c[:2]), rtol=1e-11)
    np.testing.assert_allclose(A @ rolling, 0.0, atol=1e-12)


CLOSED = {
    "plane": (jd.contact.Plane(), {"on": "plane"}, jnp.array([0.3, -0.2, 0.1])),
    "sphere": (jd.contact.Sphere(0.3), {"on": "sphere", "surface_radius": 0.3}, 0.4 * jnp.array([0.6, -0.48, 0.64])),
    "cylinder": (jd.contact.Cylinder(0.3), {"on": "cylinder", "surface_radius": 0.3}, jnp.array([0.24, -0.32, 0.2])),
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("on", "spin"),
    [("plane", True), *(pytest.param(on, True, marks=pytest.mark.slow) for on in ("sphere", "cylinder"))],
)
def test_a_ball_has_the_rows_in_closed_form(on, spin):
    surface, options, center = CLOSED[on]
    general = one_body(surface, jd.contact.Sphere(0.1), spin=spin)
    closed = jd.Scene(
        one_body(surface, jd.contact.Sphere(0.1)).system, (jd.rolling_sphere("stone", None, 0.1, spin=spin, **options),)
    )
    joints = jnp.concatenate([center, jnp.array([0.5, -0.5, 0.1, 0.7])])
    q, v = general.system.place(joints), jnp.array([0.2, -0.1, 0.3, 0.5, 0.4, -0.6])
    one, other = (quick(lambda q, v, scene=scene: rows(scene, q, v, 0.0))(q, v) for scene in (general, closed))
    for name in ("A", "gamma", "velocity"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-12)
    # Where the ball is next to the surface, its own point and that of the surface.
    _, place = jnp.split(q, [7])
    R = jd.frame_pose(general.system, q, "stone")[:3, :3]
    inward = {"plane": jnp.array([0.0, 0.0, -1.0]), "sphere": -center / 0.4, "cylinder": jnp.array([-0.6, 0.8, 0.0])}[
        on
    ]
    np.testing.assert_allclose(R @ place[-3:], inward, atol=1e-12)
    want = {"plane": center[:2], "sphere": center / 0.4, "cylinder": jnp.array([np.arctan2(-0.32, 0.24), 0.2])}[on]
    np.testing.assert_allclose(place[:-3], want, atol=1e-12)


def touching(a, b, eta, V_c, **options):
    """A stone that touches a surface at contact coordinates eta and moves by V_c: scene, q, v."""
    scene = one_body(a, b, **options)
    q = scene.system.place(joints_of(jd.contact.relative_pose(a, b, eta)), near=eta[None])
    return scene, q, se3.Ad_apply(jd.contact.montana(a, b, eta).finger.pose, V_c)


def spatial_mass():
    return np.asarray(
        jd.inertia.spatial_inertia(jd.ModelBuilder("m").add_body("b", None, "free", STONE).build().inertias[0])
    )


@pytest.mark.slow
def test_sliding_is_lagranges_equations_in_contact_coordinates():
    """L(eta, etadot) with V_of = J_F etadot: five coordinates, against the row of the gap on SE(3)."""
    V_c = jnp.array([0.2, 0.1, 0.0, 0.7, -0.4, 0.5])
    scene, q, v = touching(EGG, TIP, ETA, V_c, slip=True)
    M, mass, com, fall = spatial_mass(), STONE[0], jnp.asarray(STONE[1]), jnp.asarray(scene.system.gravity)

    def metric(eta):
        J = jd.contact.montana(EGG, TIP, eta).J_F
        return J.T @ M @ J

    def potential(eta):
        pose = jd.contact.relative_pose(EGG, TIP, eta)
        return -mass * fall @ (pose[:3, :3] @ com + pose[:3, 3])

    @quick
    def both(q, v, eta):
        rates = jd.contact.montana(EGG, TIP, eta).forward @ V_c
        eta_rate2 = jd.forward_dynamics(jd.MetricSystem(metric, 5, potential=potential), eta, rates, jnp.zeros(5))
        J, J_rate = jax.jvp(lambda eta: jd.contact.montana(EGG, TIP, eta).J_F, (eta,), (rates,))
        return jd.constrained_dynamics(scene, q, v).acceleration, J @ eta_rate2 + J_rate @ rates, J @ rates

    acceleration, lagrange, twist = both(q, v, ETA)
    np.testing.assert_allclose(twist, v, atol=1e-13)
    np.testing.assert_allclose(acceleration, lagrange, atol=1e-10 * float(jnp.abs(lagrange).max()))


@pytest.mark.slow
def test_rolling_is_newton_eulers_equations_in_the_rates_of_rolling():
    """M V' - ad_V^T M V = G + A^T lam with V = J_F B (wx, wy): two rates and four forces, by one system of equations."""
    w = jnp.array([0.7, -0.4])
    scene, q, v = touching(EGG, TIP, ETA, jnp.array([0.0, 0.0, 0.0, *w, 0.0]), spin=True)
    M, kinematics = spatial_mass(), jd.contact.montana(EGG, TIP, ETA)

    def to_twist(eta):
        at = jd.contact.montana(EGG, TIP, eta)
        return at.J_F @ at.rolling

    J, J_rate = quick(lambda eta: jax.jvp(to_twist, (eta,), (kinematics.rolling @ w,)))(ETA)
    A = (np.asarray(se3.Ad(se3.inverse(kinematics.finger.pose))))[[0, 1, 2, 5]]
    fall, com = kinematics.g_of[:3, :3].T @ scene.system.gravity * STONE[0], jnp.asarray(STONE[1])
    weight = jnp.concatenate([fall, jnp.cross(com, fall)])
    turning = -se3.ad(v).T @ (M @ v)
    solved = np.linalg.solve(np.concatenate([M @ J, -A.T], 1), weight - turning - M @ (J_rate @ w))
    got = quick(lambda q, v: jd.constrained_dynamics(scene, q, v))(q, v)
    want = J @ solved[:2] + J_rate @ w
    np.testing.assert_allclose(got.acceleration, want, atol=1e-10 * float(jnp.abs(want).max()))
    rows_of = jd.constraint_jacobian(scene, q)
    np.testing.assert_allclose(rows_of.T @ got.multipliers, A.T @ solved[2:], atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("radius", "ranks"), [(0.1, (2, 3, 5)), (0.3, (2, 2))])
def test_rolling_reaches_all_contact_coordinates_unless_radii_are_equal(radius, ranks):
    """Murray, Li & Sastry (1994), section 7.4: equal spheres roll as mirror images, which can be integrated."""
    scene = one_body(jd.contact.Sphere(0.3), jd.contact.Sphere(radius), spin=True)
    center = (0.3 + radius) * jnp.array([0.6, -0.48, 0.64])
    q = scene.system.place(jnp.concatenate([center, jnp.array([0.5, -0.5, 0.1, 0.7])]))
    assert jd.reduction.involutive(scene, q).ranks == ranks


def test_fingertips_that_cannot_reach_the_egg_are_refused():
    """The fixed point of their angles does not converge for tips that are long against the links."""
    with pytest.raises(ValueError, match="its contact point"):
        jd.scenes.hand_rolling_egg.start(tip_semi_axes=(0.08, 0.02, 0.02))


@pytest.mark.slow
def test_assembly_from_far_away_ends_where_the_surfaces_touch():
    """The places are the closest points there, not at the guess, and the displacement is along the gradient of the gap."""
    scene = one_body(jd.contact.Ellipsoid([0.3, 0.2, 0.25]), jd.contact.Ellipsoid([0.1, 0.2, 0.15], poles="x"))
    system = scene.system
    guess = system.place(jnp.array([0.5, -0.6, 0.7, 0.8, -0.2, 0.4, 0.4]))
    found = jd.assemble(scene, guess)
    assert bool(system.is_consistent(found.q))
    np.testing.assert_allclose(found.q, system.place(found.q[:7]), atol=1e-14)
    # By the searched places and not by those of the assembly.
    search = quick(
        lambda e: jd.constraints.position_residual(scene, system.place(jd.integrate(system, guess, e)[:7]), 0.0)[0]
    )
    e, steps = jd.difference(system, guess, found.q), 1e-4 * np.eye(6)
    gradient = (
        np.array([8 * (search(e + d) - search(e - d)) - search(e + 2 * d) + search(e - 2 * d) for d in steps]) / 12e-4
    )
    force = np.asarray(jd.mass_matrix(system, guess) @ e)
    np.testing.assert_allclose(search(e), 0.0, atol=1e-15)
    np.testing.assert_allclose(force / np.linalg.norm(force), -gradient / np.linalg.norm(gradient), atol=1e-10)


def egg_on_plane(axes):
    """An egg that rolls on a plane, its centre of mass in the middle; a ball for None."""
    shape = jd.contact.Sphere(AXES[2]) if axes is None else jd.contact.Ellipsoid(axes)
    builder = jd.ModelBuilder("egg", gravity=(0.0, 0.0, -9.81))
    builder.add_body("egg", None, "free", jd.inertia.ellipsoid(1.0, (0.3, 0.2, 0.25)))
    system = jd.contact.RollingModel(
        builder.build(), [jd.contact.rolling_contact(None, jd.contact.Plane(), "egg", shape)]
    )
    return jd.Scene(system, system.rows)


AXES, OMEGA = jnp.array([0.3, 0.2, 0.25]), jnp.array([4.0, 6.0, 0.5])


def egg_start(scene, omega, height=AXES[2]):
    """The egg on the pole of its chart, where it rolls without slip."""
    q = scene.system.place(jnp.concatenate([jnp.zeros(2), height[None], jnp.array([1.0, 0.0, 0.0, 0.0])]))
    return q, jnp.concatenate([jnp.stack([height * omega[1], -height * omega[0], 0.0 * height]), omega])


@pytest.mark.slow
def test_an_egg_keeps_its_energy_and_both_methods_agree():
    scene = egg_on_plane(AXES)
    q, v = egg_start(scene, OMEGA)
    ts, ends = jnp.linspace(0.0, 5.0, 26), []
    for method in ("projected", "reduced"):
        solution = jd.simulate(
            scene, q, v, ts, method=method, stepsize=within(1e-11), outputs=("energy", "constraint_residual")
        )
        assert float(solution.constraint_residual.max()) < 1e-13
        np.testing.assert_allclose(solution.energy, solution.energy[0], rtol=1e-9)
        ends.append(solution.q)
    # It has turned over, past the poles of every chart.
    places = np.asarray(ends[0][:, 9:])
    assert (np.ptp(places, axis=0) > 1.5).all()
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 1.0, atol=1e-14)
    # Errors of some 1e-11 a step, of motions that part from each other in 5 s.
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)
    # The places are where the surfaces touch, and eta gives the pose back. (The start is the pole, where this chart ends.)
    for row in ends[0][5::5]:
        pose = jd.contact.relative_pose(
            jd.contact.Plane(), jd.contact.Ellipsoid(AXES), scene.system.contact_coordinates(row)[0]
        )
        np.testing.assert_allclose(pose, jd.frame_pose(scene.system, row, "egg"), atol=1e-11)


@pytest.mark.slow
def test_a_hand_rolls_an_egg_and_stays_in_touch():
    scene, (q, v) = scenes.hand_rolling_egg(gravity=0.0), scenes.hand_rolling_egg.start()
    outputs = ("energy", "constraint_residual", "contact_forces")
    solution = jd.simulate(
        scene, q, v, jnp.linspace(0.0, 5.0, 26), outputs=outputs, events=[jd.events.ContactLost(stop=False)]
    )
    assert solution.contact_forces is not None and set(solution.contact_forces) == {"finger1", "finger2", "finger3"}
    assert float(solution.constraint_residual.max()) < 1e-11
    # Tolerances of 1e-8 of coordinates of the order of 1; the energy is some 4e-4 J.
    np.testing.assert_allclose(solution.energy, solution.energy[0], atol=1e-9)
    eta = jax.vmap(scene.system.contact_coordinates)(solution.q)
    assert (np.abs(eta[-1, :, :4] - eta[0, :, :4]).max(1) > 0.1).all()
    # 9 rows on 15 velocities; the object's six are left.
    assert jd.grasp.hand_jacobian(scene, q).shape == (9, 9)


@pytest.mark.slow
def test_motions_are_batched_and_have_derivatives_in_states_and_shapes():
    def end(axes, omega):
        scene = egg_on_plane(axes)
        options = {"stepsize": 0.02, "solver": diffrax.Dopri5(), "adjoint": "reverse"}
        solution = jd.simulate(scene, *egg_start(scene, omega, axes[2]), jnp.array([0.0, 0.1, 0.2]), **options)
        return jnp.sum(solution.q[-1] ** 2)

    step = 1e-4
    axes, omegas = step * jnp.eye(3, 3), step * jnp.eye(3)
    value, slopes = quick(jax.value_and_grad(end, (0, 1)))(AXES, OMEGA)
    steps = jnp.concatenate([-2 * axes, -axes, axes, 2 * axes])
    none = jnp.zeros_like(steps)
    ends = quick(jax.vmap(end))(
        AXES[None] + jnp.concatenate([steps, none]), OMEGA[None] + jnp.concatenate([none, steps * omegas[0, 0] / step])
    )
    low2, low, high, high2 = jnp.moveaxis(ends.reshape(2, 4, 3), 1, 0)
    differences = (low2 - 8 * low + 8 * high - high2) / (12 * step)
    # Differences of fourth order of numbers that are known to 1e-13.
    np.testing.assert_allclose(slopes, differences, atol=1e-7)
    np.testing.assert_allclose(value, end(AXES, OMEGA), rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("how", ["simulate", "stepper"])
def test_a_known_scene_rolls_from_traced_starts(how):
    """A ball on a plane, x = r w t; a generic configuration, by which rows are counted, lacked the places of the contact."""
    scene, speed, time = egg_on_plane(None), 3.0, 1e-3

    def end(speed):
        q, v = egg_start(scene, jnp.array([0.0, 1.0, 0.0]) * speed)
        if how == "stepper":
            return jd.stepper(scene, time)((q, v), jnp.zeros(6))[0][:2]
        return jd.simulate(scene, q, v, jnp.array([0.0, time])).q[-1, :2]

    x, derivative = quick(lambda speed: (end(speed), jax.jacrev(end)(speed)))(speed)
    np.testing.assert_allclose(x, [0.25 * speed * time, 0.0], atol=1e-12)
    np.testing.assert_allclose(derivative, [0.25 * time, 0.0], atol=1e-12)


@pytest.mark.slow
def test_a_valley_that_becomes_too_narrow_ends_the_motion():
    def narrowing(a):
        return jnp.stack([a[0], a[1], 0.5 * a[0] ** 2 + 12.0 * a[0] ** 4 + 0.5 * a[1] ** 2])

    scene = one_body(jd.contact.Parametrised(narrowing), jd.contact.Sphere(0.3))
    q = scene.system.place(jnp.array([0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0]), near=[[0.0, 0.0, -0.5, 0.0]])
    v = jnp.array([1.2, 0.0, 0.0, 0.0, 4.0, 0.0])
    for size in (None, 0.005):
        steps = jd.simulation.Steps(size, max_steps=2000)
        solution = jd.simulate(scene, q, v, jnp.linspace(0.0, 0.5, 51), throw=False, stepsize=steps)
        assert solution.result == jd.RESULTS.no_single_contact, solution.result
        assert 0 < float(solution.stats["time_reached"]) < 0.5 and np.isnan(solution.q[-1]).all()


BALL = jnp.array([0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0])


def placed_on(f, **options):
    return one_body(jd.contact.Parametrised(f), jd.contact.Sphere(0.3)).system.place(BALL, **options)


def simulated(change):
    scene = one_body(jd.contact.Plane(), jd.contact.Sphere(0.3))
    q = change(scene.system)
    return jd.simulate(scene, q, jnp.zeros(6), jnp.array([0.0, 0.1]))


test_bad_input_is_refused = refusals(
    (lambda: jd.contact.rolling_contact(None, jd.contact.Plane(), "stone", jd.contact.Sphere(-0.1)), "radius is -0.1"),
    (lambda: jd.contact.rolling_contact(None, "plane", "stone", jd.contact.Sphere(0.1)), "surface is a"),
    (
        lambda: jd.contact.rolling_contact(
            None, jd.contact.Plane(), "ball", jd.contact.Sphere(0.1), slip=True, contact=False
        ),
        "leaves no rows",
    ),
    (lambda: jd.contact.RollingModel(one_body(jd.contact.Plane(), jd.contact.Sphere(0.3)).system, []), "model is a"),
    (lambda: jd.contact.RollingModel(scenes.sphere_arm().system, ["ball"]), "contacts is"),
    (
        lambda: jd.contact.RollingModel(
            scenes.sphere_arm().system,
            [jd.contact.rolling_contact(None, jd.contact.Plane(), "stone", jd.contact.Sphere(0.1))],
        ),
        "frame 'stone' is",
    ),
    (lambda: placed_on(lambda a: jnp.stack([a[0], a[1], 5 * a @ a]), near=[[0, 0, 0, 0]]), "curvature is not"),
    (lambda: placed_on(lambda a: jnp.stack([a[0], a[1], jnp.sqrt(a @ a)]), near=[[0, 0, 0, 0]]), "do not touch"),
    (lambda: placed_on(bump), "give near="),
    (lambda: placed_on(bump, near=[0.0, 0.0]), "near has shape"),
    (lambda: one_body(jd.contact.Plane(), jd.contact.Sphere(0.3)).system.place(BALL[:3]), "joints has shape"),
    (lambda: simulated(lambda system: system.place(BALL + 0.05 * jnp.eye(7)[2])), "open by 0.05"),
    (lambda: simulated(lambda system: system.place(BALL).at[7].set(0.5)), "the closest points"),
    (lambda: simulated(lambda system: BALL), "q0 has shape"),
    (
        lambda: jd.constraint_jacobian(
            jd.Scene(scenes.sphere_arm().system, one_body(jd.contact.Plane(), jd.contact.Sphere(0.3)).system.rows),
            jnp.zeros(6),
        ),
        "in the system",
    ),
    (
        lambda: jd.join(
            one_body(jd.contact.Plane(), jd.contact.Sphere(0.3)).system, scenes.sphere_arm().system, prefix=("a", "b")
        ),
        "is a RollingModel",
    ),
)
