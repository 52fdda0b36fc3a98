"""Inverse kinematics: closed forms, loops and limits, least change, derivatives by the implicit function theorem, paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import ANCHORS, CORNERS, delta, delta_hips, stewart
from pinocchio_bridge import assert_close, quick
from scipy.optimize import nnls

import jaxdyn as jd
from jaxdyn import scenes

TIP = "iiwa_link_7"


def two_bars(lengths=(1.0, 0.8), **limits):
    builder, bar = jd.ModelBuilder("two bars", gravity=(0, -9.81, 0)), jd.inertia.rod(1.0, 1.0, "x")
    builder.add_body("a", None, "revolute" if limits else "continuous", bar, **limits)
    builder.add_body("b", "a", "continuous", bar, pose=(lengths[0], 0, 0))
    return builder.add_frame("end", "b", (lengths[1], 0, 0)).build()


@pytest.mark.long
def test_two_bars_in_closed_form():
    """Both elbows, by the guess; derivatives of the angles by place and lengths, of first and second order."""
    model, place = two_bars(), np.array([0.9, 0.7, 0.0])
    c = (place @ place - 1 - 0.64) / 1.6
    for elbow in (1.0, -1.0):
        second = elbow * np.arccos(c)
        first = np.arctan2(place[1], place[0]) - np.arctan2(0.8 * np.sin(second), 1 + 0.8 * np.cos(second))
        reached = jd.inverse_kinematics(model, {"end": place}, jnp.array([0.5, elbow]), weights={"end": [1, 1, 0]})
        assert reached.result == jd.RESULTS.successful and int(reached.guesses) == 1
        np.testing.assert_allclose(reached.q, [first, second], atol=1e-11)
        assert float(reached.residual) < 1e-11

    def by_search(x):
        targets = {"end": jnp.stack([x[0], x[1], jnp.zeros_like(x[0])])}
        return jd.inverse_kinematics(
            two_bars((x[2], x[3])), targets, jnp.array([0.5, 1.0]), weights={"end": [1, 1, 0]}
        ).q

    def closed(x):
        cosine = (x[0] ** 2 + x[1] ** 2 - x[2] ** 2 - x[3] ** 2) / (2 * x[2] * x[3])
        second = jnp.arccos(cosine)
        lean = jnp.arctan2(x[3] * jnp.sin(second), x[2] + x[3] * jnp.cos(second))
        return jnp.stack([jnp.arctan2(x[1], x[0]) - lean, second])

    x = jnp.array([0.9, 0.7, 1.0, 0.8])
    for order in (jax.jacfwd, lambda f: jax.jacfwd(jax.jacrev(f))):
        assert_close(quick(order(by_search))(x), order(closed)(x), 1e-9)


@pytest.mark.long
def test_random_poses_of_an_arm_with_limits():
    """All of a batch within the limits, each as alone; the derivative is the least change in the mass metric."""
    model = jd.robots.iiwa()
    keys = jax.random.split(jax.random.key(0), 128)
    goals = quick(jax.vmap(lambda k: jd.frame_pose(model, jd.random_configuration(model, k), TIP)))(keys)
    starts = quick(jax.vmap(lambda k: jd.random_configuration(model, k)))(jax.random.split(jax.random.key(1), 128))
    solve = quick(jax.vmap(lambda goal, q: jd.inverse_kinematics(model, {TIP: goal}, q)))
    reached = solve(goals, starts)
    assert bool(reached.success.all())
    assert np.all((reached.q >= model.lower[None]) & (reached.q <= model.upper[None]))
    assert_close(jax.vmap(lambda q: jd.frame_pose(model, q, TIP))(reached.q), goals, 1e-10)
    alone = jd.inverse_kinematics(model, {TIP: goals[5]}, starts[5])
    assert_close(alone.q, reached.q[5], 1e-8)
    free = int(np.argmax(np.all((reached.q > model.lower[None]) & (reached.q < model.upper[None]), 1)))
    q, goal = reached.q[free], goals[free]

    def moved(p):
        return jd.inverse_kinematics(model, {TIP: goal.at[:3, 3].add(p)}, q).q

    J, M = np.asarray(jd.frame_jacobian(model, q, TIP)), np.asarray(jd.mass_matrix(model, q))
    least = np.linalg.solve(M, J.T) @ np.linalg.inv(J @ np.linalg.solve(M, J.T))
    assert_close(quick(jax.jacrev(moved))(jnp.zeros(3)), least[:, :3], 1e-8)


@pytest.mark.long
def test_posture_is_the_nearest_configuration():
    """Stationary in the null space, in the mass metric; joints that would pass a limit stay on it."""
    model = jd.robots.iiwa()
    goal = jd.frame_pose(model, jnp.array([0.3, 0.6, -0.2, 1.2, 0.1, 0.5, 0.0]), TIP)
    posture = jnp.array([0.5, 0.4, 0.0, 1.0, 0.3, 0.4, 0.2])
    reached = jd.inverse_kinematics(model, {TIP: goal}, jnp.full(7, 0.4), posture=posture)
    assert float(reached.residual) < 1e-10
    J, M = np.asarray(jd.frame_jacobian(model, reached.q, TIP)), np.asarray(jd.mass_matrix(model, posture))
    null = np.linalg.svd(J)[2][6]
    assert abs(null @ M @ np.asarray(reached.q - posture)) < 1e-9
    step = 1e-4
    change = quick(jax.jacfwd(lambda p: jd.inverse_kinematics(model, {TIP: goal}, reached.q, posture=p).q))(posture)
    ends = [
        jd.inverse_kinematics(model, {TIP: goal}, reached.q, posture=posture.at[0].add(s * step)).q for s in (1, -1)
    ]
    np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), change[:, 0], atol=1e-6)  # central differences of 1e-4
    far = posture.at[3].set(4.0)  # beyond the limit of 120 degrees
    limited = jd.inverse_kinematics(model, {TIP: goal}, jnp.full(7, 0.4), posture=far)
    assert np.all((limited.q >= model.lower - 1e-12) & (limited.q <= model.upper + 1e-12))


@pytest.mark.slow
def test_postures_far_away_satisfy_the_optimality_conditions():
    """Karush, Kuhn and Tucker, by SciPy's nonnegative least squares: M e = J^T y + the pushes of limits."""
    model, count = jd.robots.iiwa(), 60
    low, high = np.asarray(model.lower), np.asarray(model.upper)
    rng = np.random.default_rng(1)
    starts, postures = rng.uniform(0.9 * low, 0.9 * high, (2, count, 7))
    goals = jax.vmap(lambda q: jd.frame_pose(model, q, TIP))(jnp.asarray(starts))

    def solve(goal, q, posture):
        return jd.inverse_kinematics(model, {TIP: goal}, q, posture=posture)

    found = jax.jit(jax.vmap(solve))(goals, jnp.asarray(starts), jnp.asarray(postures))
    assert bool(found.success.all())
    q = np.asarray(found.q)
    assert np.all((q >= low) & (q <= high))
    forces = jax.vmap(lambda p, q: jd.mass_matrix(model, p) @ (q - p))(jnp.asarray(postures), found.q)
    held = 0
    for force, J, x in zip(
        np.asarray(forces), jax.vmap(lambda q: jd.frame_jacobian(model, q, TIP))(found.q), q, strict=True
    ):
        at_low, at_high = np.eye(7)[:, x <= low], -np.eye(7)[:, x >= high]
        held += at_low.shape[1] + at_high.shape[1]
        pushes = np.concatenate([J.T, -J.T, at_low, at_high], 1)
        assert nnls(pushes, force, maxiter=1000)[1] < 1e-9 * np.linalg.norm(force)
    assert held > 10


@pytest.mark.long
def test_stewart_platform_in_closed_form():
    """The legs' lengths are distances; the loops hold to rounding; along a path the branch stays."""
    scene, guess = stewart()
    angle = 0.2
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [0.1, -0.05, 1.1]
    reached = jd.inverse_kinematics(scene, {"plate": pose}, guess)
    legs = np.asarray(reached.q)[velocity_slots(scene.system, [f"leg{i}" for i in range(6)])]
    np.testing.assert_allclose(legs, np.linalg.norm(CORNERS @ turn.T + pose[:3, 3] - ANCHORS, axis=1), atol=1e-10)
    assert float(reached.constraint_residual) < 1e-11


def velocity_slots(model, names):
    """Places in q of joints of one degree of freedom."""
    return np.array([model.topology.q_slices[model.joint_names.index(name)].start for name in names])


@pytest.mark.slow
def test_delta_robot_in_a_batch():
    scene, guess = delta()
    rng = np.random.default_rng(0)
    points = jnp.asarray(rng.uniform([-0.15, -0.15, -0.75], [0.15, 0.15, -0.55], (32, 3)))
    reached = quick(jax.vmap(lambda p: jd.inverse_kinematics(scene, {"platform": p}, guess, guesses=1)))(points)
    assert bool(reached.success.all())
    hips = reached.q[:, velocity_slots(scene.system, [f"hip{i}" for i in range(3)])]
    np.testing.assert_allclose(hips, jax.vmap(delta_hips)(points), atol=1e-9)
    assert float(reached.constraint_residual.max()) < 1e-10
    # The derivative with respect to the place is that of the closed form.
    one = quick(jax.jacrev(lambda p: jd.inverse_kinematics(scene, {"platform": p}, guess, guesses=1).q))(points[0])
    slots = velocity_slots(scene.system, [f"hip{i}" for i in range(3)])
    assert_close(one[slots], jax.jacfwd(delta_hips)(points[0]), 1e-8)


def test_four_bar_by_a_point_on_its_coupler():
    """One degree of freedom and one row of a target; the loop holds."""
    scene, (q, _) = scenes.four_bar(), scenes.four_bar.start()
    goal = jd.frame_pose(scene.system, q, "coupler")[:3, 3]
    reached = jd.inverse_kinematics(scene, {"coupler": goal}, q.at[0].add(0.3), weights={"coupler": [1, 1, 0]})
    assert_close(reached.q, q, 1e-9)
    assert np.abs(jd.constraints.position_residual(scene, reached.q)).max() < 1e-11


@pytest.mark.long
def test_directions_and_the_centre_of_mass():
    """A floating quadruped: its feet stay, its centre of mass and the direction of its trunk follow."""
    model = jd.robots.quadruped()
    rng = np.random.default_rng(1)
    legs = np.tile([0.0, 0.9, -1.7], 4) + 0.1 * rng.normal(size=12)
    q = jd.neutral(model).at[7:].set(jnp.asarray(legs))
    feet = [name for name in model.frame_names if "foot" in name.lower()][:4]
    base = model.body_names[0]
    centre = jd.center_of_mass(model, q) + jnp.array([0.01, -0.01, -0.01])
    direction = jnp.array([0.05, -0.1, 1.0])
    targets = {foot: jd.frame_pose(model, q, foot)[:3, 3] for foot in feet}
    targets |= {"center_of_mass": centre, base: {"direction": direction}}
    reached = jd.inverse_kinematics(model, targets, q)
    assert reached.result == jd.RESULTS.successful
    assert_close(jd.center_of_mass(model, reached.q), centre, 1e-10)
    assert_close(jd.frame_pose(model, reached.q, base)[:3, 2], direction / jnp.linalg.norm(direction), 1e-10)
    np.testing.assert_allclose(jnp.linalg.norm(reached.q[3:7]), 1.0, atol=1e-12)
    other = jd.inverse_kinematics(model, {base: {"direction": [0, 0, 1], "axis": [1, 0, 0], "position": [0, 0, 1]}}, q)
    assert_close(jd.frame_pose(model, other.q, base)[:3, 0], [0, 0, 1], 1e-10)
    assert other.errors.shape == (5,)


@pytest.mark.parametrize("guesses", [pytest.param(1, marks=pytest.mark.slow), 16])
def test_opposite_direction_is_half_a_turn_away(guesses):
    """From upright, where each component of a cross product is zero; and the error of a frame that cannot turn."""
    model = jd.robots.iiwa()
    reached = jd.inverse_kinematics(model, {TIP: {"direction": [0, 0, -1.0]}}, jnp.zeros(7), guesses=guesses)
    np.testing.assert_allclose(jd.frame_pose(model, reached.q, TIP)[:3, 2], [0, 0, -1], atol=1e-11)
    builder = jd.ModelBuilder("slider")
    builder.add_body("slide", None, "prismatic", jd.inertia.box(1.0, (0.1, 0.1, 0.1)), axis=(1, 0, 0))
    held = jd.inverse_kinematics(builder.build(), {"slide": {"direction": [0, 0, -1.0]}}, jnp.zeros(1), throw=False)
    assert held.result == jd.RESULTS.targets_not_reached
    np.testing.assert_allclose(
        held.residual, np.pi, atol=1e-7
    )  # the axis of half a turn is chosen by the root of rounding


@pytest.mark.long
def test_out_of_reach():
    """The nearest place, its code, derivatives of NaN; limits bind there too."""
    model = two_bars(lower=-1.0, upper=0.5)
    given = {"weights": {"end": [1, 1, 0]}, "throw": False}
    far = jd.inverse_kinematics(model, {"end": [3.0, 0.3, 0.0]}, jnp.array([0.2, 0.1]), **given)
    assert far.result == jd.RESULTS.targets_not_reached
    np.testing.assert_allclose(far.q, [np.arctan2(0.3, 3.0), 0.0], atol=1e-3)
    np.testing.assert_allclose(far.residual, np.hypot(3.0, 0.3) - 1.8, rtol=0.02)
    up = jd.inverse_kinematics(model, {"end": [0.0, 3.0, 0.0]}, jnp.array([0.2, 0.1]), **given)
    assert float(up.q[0]) == 0.5
    slope = jax.jacrev(
        lambda x: jd.inverse_kinematics(model, {"end": jnp.stack([x, x, 0 * x])}, jnp.zeros(2), **given).q
    )
    assert np.isnan(slope(jnp.array(3.0))).all()
    with pytest.raises(ValueError, match="targets_not_reached: errors"):
        jd.inverse_kinematics(model, {"end": [3.0, 0.3, 0.0]}, jnp.array([0.2, 0.1]))


@pytest.mark.long
@pytest.mark.parametrize(
    "derivative", [jax.grad, *(pytest.param(one, marks=pytest.mark.slow) for one in (jax.jacfwd, jax.hessian))]
)
def test_reasons_under_derivatives(derivative):
    """Outside of jit a failing search gives its reason under jax.grad, jacfwd and hessian too."""
    model, four_bar = two_bars(), scenes.four_bar()
    q = scenes.four_bar.start()[0]
    given = {"weights": {"end": [1, 1, 0]}, "guesses": 1}

    def point(x):
        return jnp.stack([x, x, 0 * x])

    def by_motors(x):
        return jd.constrained_inverse_dynamics(
            jd.Scene(two_bars()),
            jnp.zeros(2),
            jnp.zeros(2),
            [x, 1.0],
            motors=["a_joint"],
            independent=["a_joint", "b_joint"],
        ).torque.sum()

    cases = (
        (
            lambda x: jd.inverse_kinematics(model, {"end": point(x)}, jnp.ones(2), **given).q.sum(),
            "targets_not_reached: errors",
        ),
        (lambda x: jd.follow(model, {"end": point(x)[None]}, jnp.ones(2), **given).q.sum(), "follow: 1 places"),
        (lambda x: jd.assemble(four_bar, q, hold={"1": 0.5, "2": x}, guesses=1).q.sum(), "not assembled: jointlock"),
        (by_motors, "motors: they cannot"),
    )
    for search, reason in cases:
        with pytest.raises(ValueError, match=reason):
            derivative(search)(10.0)


@pytest.mark.long
def test_unreachable_target_on_a_linkage_leaves_it_closed():
    """The constraints hold to rounding at the place of least error, and the code is that of the target."""
    for scene, start, frame in ((scenes.four_bar(), scenes.four_bar.start()[0], "coupler"), (*delta(), "platform")):
        for far in ([9.0, 1.0, 0.0], [1.0, 0.0, 0.2], [-4.0, 4.0, 1.0]):
            place = jd.inverse_kinematics(scene, {frame: far}, start, throw=False)
            assert place.result == jd.RESULTS.targets_not_reached
            assert float(place.constraint_residual) < 1e-11


def test_steps_keep_the_branch():
    """Equal parts of the way: the elbow stays on its side where one long step may change it."""
    model = two_bars()
    guess, goal = jnp.array([0.0, 0.3]), jd.frame_pose(two_bars(), jnp.array([2.5, 0.5]), "end")[:3, 3]
    reached = jd.inverse_kinematics(model, {"end": goal}, guess, steps=10, guesses=1)
    assert_close(reached.q, [2.5, 0.5], 1e-9)


@pytest.mark.long
def test_paths():
    """A circle: as solved place by place; through a singular position the branch changes, and is said to."""
    model, given = two_bars(), {"weights": {"end": [1, 1, 0]}}
    angles = jnp.linspace(0, 2 * np.pi, 41)
    circle = jnp.stack([1.1 + 0.3 * jnp.cos(angles), 0.3 * jnp.sin(angles), 0 * angles], 1)
    path = jd.follow(model, {"end": circle}, jnp.array([-0.5, 1.0]), **given)
    assert bool(path.success.all()) and not bool(path.changes_branch.any())
    assert_close(path.q[-1], path.q[0], 1e-9)
    assert np.all(path.q[:, 1] > 0)
    ends = jax.vmap(lambda q: jd.frame_pose(model, q, "end")[:3, 3])(path.q)
    assert_close(ends, circle, 1e-10)
    # |R| |R^+| of the Jacobian by singular values.
    J = np.asarray(jd.frame_jacobian(model, path.q[7], "end"))[:2]
    s = np.linalg.svd(J, compute_uv=False)
    np.testing.assert_allclose(path.regularity[7], 2 / np.sqrt((s**2).sum() * (1 / s**2).sum()), rtol=1e-8)
    assert path.regularity.min() > 0.05
    # Through the base of a symmetric arm: at the inner edge of the annulus the arm is folded.
    out = jnp.stack([jnp.linspace(1.0, 1.79, 20), 0 * angles[:20], 0 * angles[:20]], 1)
    near = jd.follow(model, {"end": out}, jnp.array([-0.5, 1.0]), **given)
    assert near.regularity[-1] < 0.2 * near.regularity[0]
    with pytest.raises(ValueError, match="row for each"):
        jd.follow(model, {"end": circle, "b": circle[:5]}, jnp.zeros(2))
    with pytest.raises(ValueError, match="places of 41"):
        jd.follow(model, {"end": circle + 5.0}, jnp.array([-0.5, 1.0]), **given)


def test_refusals():
    model, q, pose = jd.robots.iiwa(), jnp.full(7, 0.3), {TIP: np.eye(4)}
    for nothing in ({}, {"axis": [0, 0, 1.0]}):
        for search in (jd.inverse_kinematics, jd.follow):
            with pytest.raises(ValueError, match="names no target"):
                search(model, {TIP: nothing}, q)
    for match, targets, options in (
        ("frame 'hand' is", {"hand": np.eye(4)}, {}),
        (r"has shape \(2,\)", {TIP: [0.0, 1.0]}, {}),
        ("no rotation matrix", {TIP: 2 * np.eye(4)}, {}),
        ("key 'speed'", {TIP: {"speed": [0, 0, 1.0]}}, {}),
        ("direction is", {TIP: {"direction": [0.0, 0, 0]}}, {}),
        ("axis has shape", {TIP: {"direction": [0, 0, 1.0], "axis": [0, 1.0]}}, {}),
        ("weights names", pose, {"weights": {"hand": 1.0}}),
        (r"'iiwa_link_7'\] has shape", pose, {"weights": {TIP: [1.0, 2.0]}}),
        (r"weights.* is -1\.0", pose, {"weights": {TIP: -1.0}}),
        ("guesses is 0", pose, {"guesses": 0}),
        ("targets is None", None, {}),
        ("q_posture has shape", pose, {"posture": jnp.zeros(3)}),
    ):
        with pytest.raises(ValueError, match=match):
            jd.inverse_kinematics(model, targets, q, **options)
    with pytest.raises(ValueError, match="has no frames"):
        jd.inverse_kinematics(jd.Scene(scenes.double_pendulum().system), {"x": np.zeros(3)}, jnp.zeros(2))
