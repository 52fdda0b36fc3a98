"""`jd.assemble` far from its guess: branch, half turns, tolerances, redundant rows, large batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import HEIGHT, delta_file, delta_hips

import jaxdyn as jd

FIRST, SECOND = 0.5, 0.4


class Tip(jd.constraints.Constraint):
    """The tip of a planar arm of two bars is at a target."""

    target: jax.Array
    name: str = "tip"

    def position(self, system, q, t):
        angles = jnp.stack([q[0], q[0] + q[1]])
        lengths = jnp.asarray([FIRST, SECOND], q.dtype)
        return jnp.stack([jnp.sum(lengths * jnp.cos(angles)), jnp.sum(lengths * jnp.sin(angles))]) - self.target


def arm(target):
    builder = jd.ModelBuilder("two bars", gravity=None)
    for name, parent, length in (("first", None, 0.0), ("second", "first", FIRST)):
        builder.add_body(
            name, parent, axis=(0, 0, 1), pose=(length, 0, 0), inertia=(1.0, (0.2, 0, 0), (0.01, 0.05, 0.05))
        )
    return jd.Scene(builder.build(), (Tip(target),))


GUESS = jnp.asarray([0.3, 1.2])


@pytest.fixture(scope="module")
def targets():
    """Points of a grid that the arm reaches, not closer than 2 cm to the ends of its reach."""
    x = np.linspace(-0.95, 0.95, 21)
    points = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(points, axis=1)
    return jnp.asarray(points[(distance > FIRST - SECOND + 0.02) & (distance < FIRST + SECOND - 0.02)])


@pytest.mark.long
def test_targets_all_over_the_workspace_are_reached_on_the_branch_of_the_guess(targets):
    """Against the closed form: the elbow keeps its sign, and hinges stay within half a turn of the guess."""
    found = jax.jit(jax.vmap(lambda target: jd.assemble(arm(target), GUESS)))(targets)
    assert len(targets) > 150 and bool(found.success.all())
    x, y = np.asarray(targets).T
    elbow = np.arccos((x**2 + y**2 - FIRST**2 - SECOND**2) / (2 * FIRST * SECOND))
    shoulder = np.arctan2(y, x) - np.arctan2(SECOND * np.sin(elbow), FIRST + SECOND * np.cos(elbow))
    q, passed = np.asarray(found.q), np.asarray(found.passed_singular)
    change = np.abs(q - np.asarray(GUESS))
    assert change.max() <= np.pi + 1e-9
    np.testing.assert_allclose(found.distance, change.max(1), atol=1e-12)
    same = np.sin(q[:, 1]) > 0
    # A branch that was changed is said; with the elbow bent as at the guess it hardly ever is.
    assert np.all(same | passed) and same.mean() > 0.9
    turn = (q[same] - np.stack([shoulder, elbow], axis=1)[same] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turn, 0.0, atol=1e-10)


@pytest.mark.long
def test_shorter_paths_do_not_arrive():
    target = jnp.asarray([-0.5, -0.3])
    one, many = (jd.assemble(arm(target), GUESS, steps=steps, guesses=1, throw=False) for steps in (1, 100))
    assert float(jnp.abs(one.q - many.q).max()) > 1e-3 or not bool(one.success)
    assert bool(jd.assemble(arm(target), GUESS, guesses=1).success)
    for name, wrong in (("steps", 0), ("steps", True), ("guesses", -2)):
        with pytest.raises(ValueError, match=f"{name} is {wrong}; give a positive integer"):
            jd.assemble(arm(target), GUESS, **{name: wrong})


def test_what_is_out_of_reach_is_met_as_near_as_can_be():
    """Least squares: the arm is stretched towards the target."""
    target = jnp.asarray([0.9, 0.9])
    far = float(jnp.linalg.norm(target)) - FIRST - SECOND
    with pytest.raises(ValueError, match="not assembled"):
        jd.assemble(arm(target), GUESS, guesses=1)
    found = jd.assemble(arm(target), GUESS, atol=0.3, guesses=1)
    assert bool(found.success)
    # A stretched arm is singular: the search ends with the elbow 0.04 rad from straight, as the rank has a tolerance, and the
    # distance grows with the square of that angle, by 2.4e-3 of itself.
    np.testing.assert_allclose(np.linalg.norm(Tip(target).position(None, found.q, 0.0)), far, rtol=3e-3)
    for wrong in (-1.0, np.nan):
        with pytest.raises(ValueError, match="atol is"):
            jd.assemble(arm(target), GUESS, atol=wrong)


def test_without_constraints_the_guess_is_the_answer():
    q, v = jnp.array([0.3, -0.2]), jnp.array([1.0, 2.0])
    state = jd.assemble(jd.robots.chain(2), q, v)
    assert bool(state.success) and "successful" in str(state)
    np.testing.assert_array_equal(state.q, q)
    np.testing.assert_array_equal(state.v, v)
    np.testing.assert_array_equal(state.residual, 0.0)
    batch = jax.vmap(lambda q: jd.assemble(jd.robots.chain(2), q).q)(jnp.stack([q, v]))
    np.testing.assert_array_equal(batch, [q, v])


@pytest.mark.parametrize("guess", [pytest.param(1e308, marks=pytest.mark.slow), np.inf, np.nan])
def test_a_guess_without_end_is_refused_with_the_open_loop(guess):
    # LAPACK's own error came first, where the path had left the finite numbers.
    with pytest.raises(ValueError, match="'knee' open by"):
        jd.assemble(jd.scenes.four_bar(), jnp.full(3, guess), guesses=2)
    state = jd.assemble(jd.scenes.four_bar(), jnp.full(3, guess), guesses=1, throw=False)
    assert state.result == jd.RESULTS.not_assembled


@pytest.mark.long
@pytest.mark.parametrize("count", [15, pytest.param(61, marks=pytest.mark.slow)])
def test_a_delta_robot_from_a_file_keeps_its_branch(count, tmp_path):
    """The plate held at all points of a grid that are in reach, up to 0.6 m away, from one guess; closed form of the hips."""
    path = tmp_path / "delta.xml"
    path.write_text(delta_file())
    scene = jd.load(path)
    model, guess = scene.system, scene.starts["reference"].q
    assert model.nv == 21 and jd.constraint_jacobian(scene, guess).shape == (18, 21)
    x = np.linspace(-0.6, 0.6, count)
    points = np.stack([*np.meshgrid(x, x), np.full((count, count), -HEIGHT)], axis=-1).reshape(-1, 3)
    hips = np.asarray(jax.vmap(delta_hips)(jnp.asarray(points)))
    reached = np.isfinite(hips).all(1)
    points, hips = points[reached], hips[reached]
    upright = jnp.asarray([1.0, 0.0, 0.0, 0.0])
    found = jax.jit(
        jax.vmap(lambda point: jd.assemble(scene, guess, hold={"plate": jnp.concatenate([point, upright])}))
    )(jnp.asarray(points))
    assert len(points) > 0.8 * count**2 and bool(found.success.all())
    q, passed = np.asarray(found.q), np.asarray(found.passed_singular)
    plate = model.topology.q_slices[model.joint_names.index("plate")]
    hinges = np.delete(np.abs(q - np.asarray(guess)), np.arange(plate.start, plate.stop), axis=1).max(1)
    assert hinges.max() <= np.pi + 1e-9 and (np.asarray(found.distance) >= hinges - 1e-12).all()
    computed = q[:, np.array([model.q_index(f"hip{i}") for i in range(3)])]
    error = np.abs((computed - hips + np.pi) % (2 * np.pi) - np.pi).max(1)
    # Elbows stay outwards as in the guess; at the edge of the reach, where both branches meet, a change of the branch is said.
    assert np.all((error < 1e-8) | passed) and np.mean(error < 1e-8) > 0.99


@pytest.mark.long
def test_far_guesses_end_at_the_least_change():
    """M (q - guess) vanishes in the null space of the rows, up to 1 rad away; derivatives by differences."""
    model, tip = jd.robots.iiwa(), "iiwa_link_7"
    place = jnp.array([0.3, 0.6, -0.2, -1.2, 0.4, 0.9, 0.1])
    goal = jd.frame_pose(model, place, tip)[:3, 3]
    scene = jd.Scene(model, [jd.Holonomic(lambda q, t=0.0: jd.frame_pose(model, q, tip)[:3, 3] - goal, name="tip")])
    directions = np.random.default_rng(0).normal(size=(100, 7))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    guesses = jnp.asarray(np.asarray(place) + np.repeat([0.05, 0.3, 1.0, 1.0], 25)[:, None] * directions)
    solve = jax.jit(jax.vmap(lambda guess: jd.assemble(scene, guess, throw=False)))
    found = solve(guesses)
    assert bool(found.success.all())
    masses = np.asarray(jax.vmap(lambda q: jd.mass_matrix(model, q))(guesses))
    rows = np.asarray(jax.vmap(jax.jacfwd(lambda q: jd.frame_pose(model, q, tip)[:3, 3]))(found.q))
    for M, A, e in zip(masses, rows, np.asarray(found.q - guesses), strict=True):
        null = np.linalg.svd(A)[2][3:]
        assert np.abs(null @ M @ e).max() < 1e-11 * (1 + np.abs(M @ e).max())
    along = jnp.asarray(directions[::-1])
    slopes = jax.jit(jax.vmap(lambda q, d: jax.jvp(lambda q: jd.assemble(scene, q, throw=False).q, (q,), (d,))[1]))(
        guesses, along
    )
    difference = (solve(guesses + 1e-6 * along).q - solve(guesses - 1e-6 * along).q) / 2e-6
    near = np.abs(difference).max(1) < 20  # not beside a guess from which two places are equally far
    # Rounding of 1e-14 over the step, and slopes that change fast near far guesses.
    np.testing.assert_allclose(slopes[near], difference[near], rtol=1e-5, atol=1e-8)
    assert near.sum() > 95
    # Too far for the search: a code, and derivatives of NaN.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxdyn.constraints.closing._NEAREST_STEPS", 1)
        short = jax.jit(lambda q: jd.assemble(scene, q, throw=False))(guesses[-1])
        assert short.result == jd.RESULTS.not_nearest and float(short.residual[0]) < 1e-11
        assert np.isnan(jax.jit(jax.jacrev(lambda q: jd.assemble(scene, q, throw=False).q))(guesses[-1])).all()


@pytest.mark.slow
def test_sweep_tells_where_it_changes_the_branch():
    """A four-bar's crank, each place from the same guess but some from its mirror image: exactly these steps change."""
    scene, (q, _) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
    angles = float(q[0]) + jnp.linspace(0.0, 0.5, 7)
    # The other assembly of the loop: coupler and rocker mirrored at the line from the crank's end to the rocker's foot.
    mirrored = next(
        found
        for x in np.random.default_rng(0).uniform(-3, 3, (40, 3))
        if (found := jd.assemble(scene, jnp.asarray(x), hold={"1": q[0]}, guesses=1, throw=False)).success
        and np.abs(np.sin((found.q - q)[1:] / 2)).max() > 0.2
    ).q
    guesses = jnp.stack([mirrored if i in (3, 4) else q for i in range(7)])
    sweep = jax.vmap(lambda guess, x: jd.assemble(scene, guess, hold={"1": x}))(guesses, angles)
    assert sweep.success.all()
    found = sweep.changes_branch(scene, {"1": angles})
    np.testing.assert_array_equal(found, [False, False, False, True, False, True, False])
    same = jax.vmap(lambda x: jd.assemble(scene, q, hold={"1": x}))(angles)
    assert not same.changes_branch(scene, {"1": angles}).any()
