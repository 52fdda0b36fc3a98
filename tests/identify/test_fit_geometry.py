"""Calibration of geometry: rank by theory, exact recovery, standard errors, choice of poses, loops, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn import identify
from jaxdyn.identify.geometry_errors import (
    close_loops,
    free_directions,
    linearise,
    make_mechanism,
    null_coordinates,
    redundant_directions,
)

BODY = (1.0, (0, 0, 0.1), (0.1, 0.1, 0.1))


EXP = jax.jit(jax.vmap(jd.se3.exp))


def motion(twist):
    """Of one twist, or of each in an array."""
    twist = np.asarray(twist, float)
    return np.asarray(EXP(twist.reshape(-1, 6))).reshape(*twist.shape[:-1], 4, 4)


def arm(kinds="rrprrr", error=0.0, seed=0):
    """A chain of revolute (r) and prismatic (p) joints in general position; `error` (m, rad) of all home poses."""
    shapes, errors = np.random.default_rng(5), np.random.default_rng(seed)
    builder, parent = jd.ModelBuilder("arm"), None
    for i, kind in enumerate(kinds):
        home = motion(np.concatenate([shapes.uniform(0.1, 0.4, 3), shapes.normal(size=3)]))
        pose = home @ motion(error * errors.normal(size=6))
        joint = "revolute" if kind == "r" else "prismatic"
        builder.add_body(f"b{i}", parent, joint_name=f"j{i}", joint=joint, axis=(0, 0, 1), pose=pose, inertia=BODY)
        parent = f"b{i}"
    builder.add_frame("tip", parent, pose=motion([0.05, 0.02, 0.1, 0.3, 0.2, 0.1]))
    return builder.build()


def tips(model, q):
    return np.asarray(jax.vmap(lambda q: jd.frame_pose(model, q, "tip"))(jnp.asarray(q)))


DEVICE = motion([1.0, 2.0, 0.5, 0.3, 0.9, 1.2])


@pytest.fixture(scope="module")
def measured():
    """Nominal and true arm, configurations, and exact poses seen by a device that stands elsewhere."""
    true = arm(error=0.01, seed=1)
    q = np.random.default_rng(2).uniform(-1.5, 1.5, (40, 6))
    return arm(), true, q, DEVICE @ tips(true, q)


@pytest.mark.parametrize(
    "kinds", ["rrprrr", "r", *(pytest.param(x, marks=pytest.mark.slow) for x in ("rrrrrr", "rprp"))]
)
def test_rank_is_that_of_theory(kinds):
    """Mooring, Roth & Driels (1991): 4 R + 2 P + 6, by elimination in closed form and by singular values of the errors."""
    model = arm(kinds)
    mechanism = make_mechanism(model, "tip", None)
    names, directions, _ = free_directions(mechanism, identify.geometry.PARTS)
    redundant = redundant_directions(mechanism, None)
    expected = 4 * kinds.count("r") + 2 * kinds.count("p") + 6
    assert len(names) == 6 * (len(kinds) + 2) and np.linalg.matrix_rank(redundant) == len(names) - expected
    assert null_coordinates(directions, redundant).shape == (len(names), len(names) - expected)
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (30, len(kinds)))
    fit = identify.fit_geometry(model, q, tips(model, q), frame="tip")
    s = np.linalg.svd(_errors(mechanism, directions, q).reshape(-1, len(names)), compute_uv=False)
    assert fit.rank == fit.expected == expected == np.sum(s > 1e-9 * s[0])
    # What theory calls redundant changes no pose at all.
    np.testing.assert_allclose(_errors(mechanism, np.eye(len(redundant)), q) @ redundant, 0, atol=1e-12)


def _errors(mechanism, directions, q):
    poses = tips(mechanism.model, q)
    data = identify.geometry.Measurements(poses, poses[:, None, :3, 3], np.zeros((1, 3)), np.eye(4), np.eye(4))
    return linearise(mechanism, data, directions, np.zeros(directions.shape[1]), q)[2]


def test_derivatives_of_the_errors_are_those_of_differences(measured):
    model, _, q, poses = measured
    mechanism = make_mechanism(model, "tip", None)
    _, directions, _ = free_directions(mechanism, identify.geometry.PARTS)
    data = identify.geometry.Measurements(poses[:3], poses[:3, None, :3, 3], np.zeros((1, 3)), DEVICE, np.eye(4))
    y = 0.01 * np.random.default_rng(0).normal(size=directions.shape[1])
    _, _, jacobian = linearise(mechanism, data, directions, y, q[:3])
    for k in (0, 8, 15, 33, 47):
        step = 1e-6 * np.eye(len(y))[k]
        after, before = (linearise(mechanism, data, directions, y + x, q[:3])[1] for x in (step, -step))
        np.testing.assert_allclose(jacobian[..., k], (after - before) / 2e-6, atol=1e-8)


def test_exact_poses_give_the_exact_geometry(measured):
    model, true, q, poses = measured
    fit = identify.fit_geometry(model, q, poses, frame="tip")
    assert bool(fit.success) and fit.rank == fit.expected == 28
    other = np.random.default_rng(9).uniform(-1.5, 1.5, (20, 6))
    np.testing.assert_allclose(fit.predict(other), DEVICE @ tips(true, other), atol=1e-11)
    # The base is free of cost: the others' smallest change has no share in the directions that no pose determines, to second
    # order in changes of some 0.01.
    units = free_directions(make_mechanism(model, "tip", None), identify.geometry.PARTS)[2]
    shares = fit.redundant[6:].T @ (fit.values / units)[6:]
    np.testing.assert_allclose(shares, 0, atol=3e-4)
    assert "28 of 28 identifiable" in fit.summary()


@pytest.mark.parametrize(("count", "rank"), [(1, 25), (2, 27), (3, 28)])
def test_markers_determine_the_tool_up_to_turns_about_them(measured, count, rank):
    """One marker leaves three turns of the tool, two leave one, three none."""
    model, true, q, poses = measured
    markers = 0.1 * np.eye(3)[:count]
    seen = np.einsum("nij,kj->nki", poses[:, :3, :3], markers) + poses[:, None, :3, 3]
    fit = identify.fit_geometry(model, q, positions=seen, markers=markers, frame="tip")
    assert bool(fit.success) and fit.rank == fit.expected == rank and np.isnan(fit.noise[1])
    other = np.random.default_rng(9).uniform(-1.5, 1.5, (20, 6))
    points = [np.einsum("nij,kj->nki", T[:, :3, :3], markers) + T[:, None, :3, 3]
              for T in (fit.predict(other), DEVICE @ tips(true, other))]  # fmt: skip
    np.testing.assert_allclose(*points, atol=1e-10)


def test_parts_are_fitted_alone(measured):
    """Encoder zeros alone: the first one is a turn of the base only where that is free too."""
    model, _, q, _ = measured
    offsets = 0.01 * np.arange(1, 7)
    poses = tips(model, q + offsets)
    fit = identify.fit_geometry(model, q, poses, frame="tip", free=("offsets",))
    assert fit.names == tuple(f"j{i} offset" for i in range(6)) and fit.rank == fit.expected == 6
    np.testing.assert_allclose(fit.values, offsets, atol=1e-11)
    wide = identify.fit_geometry(model, q, poses, frame="tip", free=("base", "offsets", "tool"))
    assert wide.rank == wide.expected == 16


def test_the_error_falls_with_the_root_of_the_number_of_poses():
    """Tip errors off the measured poses are noise sqrt(3 rank / (6 n)) in the mean, as predicted, for 30 and 270 poses."""
    model, true = arm("rrr"), arm("rrr", error=0.01, seed=3)
    test = np.random.default_rng(1).uniform(-1.5, 1.5, (50, 3))
    noise, rng, found = 1e-4, np.random.default_rng(0), {}
    for count in (30, 270):
        errors, told, scores = [], [], []
        for _ in range(12):
            q = rng.uniform(-1.5, 1.5, (count, 3))
            poses = tips(true, q) @ motion(noise * rng.normal(size=(count, 6)))
            fit = identify.fit_geometry(model, q, poses, frame="tip")
            errors.append(np.mean(np.sum((fit.predict(test) - tips(true, test))[:, :3, 3] ** 2, axis=1)))
            told.append(fit.tip_std**2)
            scores.append(fit.noise)
        found[count] = np.sqrt(np.mean(errors)), np.sqrt(np.mean(told))
        np.testing.assert_allclose(np.mean(scores, axis=0), noise, rtol=0.1)
        # 12 fits with 18 directions each: the root mean square is known to about 7 %.
        assert found[count][0] == pytest.approx(found[count][1], rel=0.2)
    assert found[30][0] / found[270][0] == pytest.approx(3.0, rel=0.2)


def test_standard_deviations_are_those_of_the_scatter():
    """Sixty fits to the same poses with other noise."""
    model, q = arm("rr"), np.random.default_rng(0).uniform(-1.5, 1.5, (15, 2))
    rng, exact = np.random.default_rng(1), tips(model, q)
    fits = [
        identify.fit_geometry(model, q, exact @ motion(1e-4 * rng.normal(size=(15, 6))), frame="tip") for _ in range(60)
    ]
    # The true base is the identity and the others are zero, so that all values are errors. A value without noise has none.
    z = np.stack([(fit.values / fit.std)[fits[0].std > 1e-9] for fit in fits])
    # 60 samples give a deviation within 9 %, one standard error; the largest of 24 is within three.
    np.testing.assert_allclose(np.sqrt(np.mean(z**2, axis=0)), 1.0, atol=0.3)
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.08)


def test_chosen_poses_are_better_than_random_ones():
    model = arm("rrprrr").replace(lower=-np.full(6, 1.5), upper=np.full(6, 1.5))
    q = identify.choose_poses(model, 12, frame="tip")
    assert q.shape == (12, 6) and np.abs(q).max() <= 1.5
    np.testing.assert_array_equal(q, identify.choose_poses(model, 12, frame="tip"))
    rng = np.random.default_rng(3)

    def log_deviation(q):
        poses = tips(model, q) @ motion(1e-4 * rng.normal(size=(len(q), 6)))
        fit = identify.fit_geometry(model, q, poses, frame="tip")
        # Of a given noise: the estimated one scatters. The determinant is that of the directions that are determined.
        return np.mean(np.log(np.linalg.eigvalsh(fit.covariance / fit.noise[0] ** 2)[-fit.rank :])) / 2

    assert log_deviation(q) < min(log_deviation(rng.uniform(-1.5, 1.5, (12, 6))) for _ in range(4)) - 0.05
    with pytest.raises(ValueError, match="28 directions need at least 5"):
        identify.choose_poses(model, 4, frame="tip")


# --- loops ------------------------------------------------------------------------------------------------------------


def four_bar(ground=1.0, crank=0.3, coupler=0.9, rocker=0.6):
    builder = jd.ModelBuilder("four_bar")
    builder.add_body("crank", None, joint_name="motor", axis=(0, 0, 1), inertia=BODY)
    builder.add_body("coupler", "crank", joint_name="a", axis=(0, 0, 1), pose=(crank, 0, 0), inertia=BODY)
    builder.add_body("rocker", None, joint_name="b", axis=(0, 0, 1), pose=(ground, 0, 0), inertia=BODY)
    builder.add_frame("tip", "coupler", pose=(coupler / 2, 0.2, 0))
    ends = ("coupler", (coupler, 0, 0), "rocker", (rocker, 0, 0))
    return jd.Scene(builder.build(), constraints=[jd.loop(*ends, "revolute", in_plane=True)])


def four_bar_states(scene, angles):
    """Configurations on the loop at the motor's angles, each from the one before."""
    mechanism = make_mechanism(scene, "tip", ["motor"])
    motor, a, b = (scene.system.q_index(name) for name in ("motor", "a", "b"))
    q, states = np.zeros(3), []
    q[a], q[b] = 0.8, 1.6
    for angle in angles:
        q[motor] = angle
        q = close_loops(mechanism, q[None])[0]
        states.append(q.copy())
    return np.array(states)


def test_lengths_of_a_loop_follow_from_its_motor_and_tip():
    """The tip of a four-bar leg whose links are off by some per cent; the passive joints have no encoders."""
    nominal, true = four_bar(), four_bar(1.01, 0.305, 0.89, 0.607)
    angles = np.linspace(0, 6, 40)
    seen = tips(true.system, four_bar_states(true, angles))[:, :3, 3]
    q = four_bar_states(nominal, angles)
    fit = identify.fit_geometry(
        nominal, q, positions=seen, frame="tip", free=("offsets", "lengths", "tool"), measured=["motor"]
    )
    # The tip's place in the coupler follows its length here, so that the tool is free too; the plane leaves the height.
    assert bool(fit.success) and fit.expected is None
    np.testing.assert_allclose(fit.predict(fit.q)[:, :3, 3], seen, atol=1e-10)
    other = np.linspace(0.3, 5.5, 7)
    start = [k for angle in other for k in [int(np.argmin(np.abs(angles - angle)))]]
    at = fit.q[start].copy()
    at[:, nominal.system.q_index("motor")] = other
    # The passive columns are those of other angles: the prediction closes the loops itself.
    wanted = tips(true.system, four_bar_states(true, other))[:, :3, 3]
    np.testing.assert_allclose(fit.predict(at)[:, :3, 3], wanted, atol=1e-9)


def test_chosen_places_of_a_loop_close_it_and_repeat_with_their_seed():
    scene = four_bar()
    guess = four_bar_states(scene, [0.0])[0]

    def choose(seed):
        return identify.choose_poses(
            scene,
            8,
            frame="tip",
            markers=np.zeros((1, 3)),
            free=("lengths",),
            measured=["motor"],
            guess=guess,
            seed=seed,
        )

    q = choose(3)
    coupler, rocker = (
        np.stack([jd.frame_pose(scene.system, jnp.asarray(x), name) for x in q]) for name in ("coupler", "rocker")
    )
    np.testing.assert_allclose(coupler @ [0.9, 0, 0, 1], rocker @ [0.6, 0, 0, 1], atol=1e-14)
    np.testing.assert_array_equal(q, choose(3))


def test_refusals_of_loops():
    scene = four_bar()
    q = np.zeros((9, 3))
    with pytest.raises(ValueError, match="measured is missing; name the joints"):
        identify.fit_geometry(scene, q, positions=np.zeros((9, 3)), frame="tip")
    with pytest.raises(ValueError, match="pose 0: the loops stay open"):
        far = four_bar(ground=3.0)
        identify.fit_geometry(far, q, positions=np.zeros((9, 3)), frame="tip", measured=["motor"], free=("offsets",))
    with pytest.raises(ValueError, match="2 rows for 1 joints that are not measured"):
        identify.fit_geometry(
            scene, q, positions=np.zeros((9, 3)), frame="tip", measured=["motor", "a"], free=("offsets",)
        )


def test_places_of_a_loop_respect_the_limits_of_passive_joints():
    scene = four_bar()
    guess = four_bar_states(scene, [0.0])[0]
    lower, upper = guess - 0.25, guess + 0.25
    model = scene.system.replace(lower=lower, upper=upper)
    q = identify.choose_poses(
        jd.Scene(model, scene.constraints), 6, frame="tip", markers=np.zeros((1, 3)), free=("lengths",), measured=["motor"],
        guess=guess,
    )  # fmt: skip
    assert (q >= lower).all() and (q <= upper).all() and np.ptp(q[:, 0]) > 0.05


def test_trial_steps_that_open_the_loops_are_halved():
    """A start whose full first step leaves no closed loop: the fit reaches the truth all the same."""
    nominal, true = four_bar(), four_bar(1.12, 0.31, 0.8, 0.5)
    angles = np.linspace(-0.6, 0.6, 24)
    seen = tips(true.system, four_bar_states(true, angles))[:, :3, 3]
    q = four_bar_states(nominal, angles)
    fit = identify.fit_geometry(
        nominal, q, positions=seen + 1e-4 * np.random.default_rng(0).normal(size=seen.shape), frame="tip",
        measured=["motor"],
    )  # fmt: skip
    assert bool(fit.success) and np.all(np.diff(fit.history) < 0)
    np.testing.assert_allclose(fit.predict(q)[:, :3, 3], seen, atol=4e-4)


@pytest.mark.parametrize(("position", "turn"), [(1e-3, 0.0), (0.0, 1e-3), (1e-3, 1e-9), (1e-3, 1e-3)])
def test_deviations_are_right_for_any_ratio_of_the_noises(measured, position, turn):
    model, true, q, _ = measured
    exact, rng, told, found = tips(true, q), np.random.default_rng(0), [], []
    for _ in range(8):
        twists = np.concatenate([np.zeros((len(q), 3)), turn * rng.normal(size=(len(q), 3))], axis=1)
        poses = exact @ motion(twists)
        poses[:, :3, 3] += position * rng.normal(size=(len(q), 3))
        fit = identify.fit_geometry(model, q, poses, frame="tip")
        assert bool(fit.success) and fit.rank == fit.expected
        told.append(fit.tip_std)
        found.append(np.mean(np.sum((fit.predict(q) - exact)[:, :3, 3] ** 2, axis=1)))
    told, found = np.sqrt(np.mean(np.square(told))), np.sqrt(np.mean(found))
    # 8 fits with at least 13 directions each: known to about 7 %, three standard errors. Exact positions leave the limit of
    # the weights, a rounding that is not noise.
    assert found == pytest.approx(told, rel=0.25) if position else found < 1e-8
    assert fit.noise == pytest.approx((position, turn), rel=0.25, abs=1e-8)


def test_wrong_data_are_doubted(measured):
    model, _, q, poses = measured
    with pytest.warns(UserWarning, match="are no noise of a device"):
        identify.fit_geometry(model, np.random.default_rng(0).permutation(q), poses, frame="tip")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"q": np.where(np.arange(40)[:, None] == 3, np.nan, 1.0) * np.ones((40, 6))},
            r"q\[3\] has numbers that are not finite",
        ),
        ({"frame": "nowhere"}, "nowhere"),
        ({"q": np.zeros((40, 5))}, r"q has shape \(40, 5\); give finite numbers of shape \(n, 6\)"),
        ({"poses": np.zeros((40, 4, 4))}, r"poses\[0\] is no pose"),
        ({"poses": np.zeros((39, 4, 4))}, r"poses has shape \(39, 4, 4\)"),
        ({"poses": None}, "one of them"),
        ({"markers": np.zeros((1, 3))}, "markers are given with poses"),
        ({"poses": None, "positions": np.zeros((40, 2, 3))}, r"positions has shape \(40, 2, 3\)"),
        ({"free": ("screws",)}, "free is"),
        ({"free": ()}, "free is"),
        ({"measured": ["j0"]}, "of a scene with loops"),
        (
            {"q": np.zeros((4, 6)), "poses": np.tile(np.eye(4), (4, 1, 1))},
            "4 poses give 24 numbers; 28 directions to find and the noise need at least 29",
        ),
    ],
)
def test_refusals(measured, change, message):
    model, _, q, poses = measured
    given = {"q": q, "poses": poses, "frame": "tip"} | change
    with pytest.raises(ValueError, match=message):
        identify.fit_geometry(model, **given)
