"""Constrained dynamics against Pinocchio, a KKT solve, Gauss's principle, the lemmas of the projections, printed numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from motion_helpers import largest_residuals
from pinocchio_bridge import assert_close, quick, random_tree, to_pinocchio

import jaxdyn as jd
from benchmarks.report_cases import test_set
from jaxdyn import scenes
from jaxdyn.constraints.base import rows
from jaxdyn.constraints.rank import pseudo_inverse

KINDS = ("free", "revolute", "spherical", "prismatic", "helical")


@pytest.fixture(scope="module")
def tree():
    """A floating tree with two branches joined by a ball joint and its base welded to the world, and a guess."""
    model = random_tree(5, KINDS, parents=(-1, 0, 1, 0, 3))
    rng = np.random.default_rng(2)
    q = rng.normal(size=model.nq) * 0.3
    q[3] += 1.0
    q[3:7] /= np.linalg.norm(q[3:7])
    place = model.topology.q_slices[2]
    q[place.start] += 1.0
    q[place] /= np.linalg.norm(q[place])
    # The loops are closed where the guess is: the frames are put there.
    poses = np.asarray(jd.forward_kinematics(model, jnp.asarray(q)))
    pose = np.asarray(jd.loop("a", POSE, "b", None).pose_a)
    ball = jnp.asarray(np.linalg.inv(poses[4]) @ poses[2] @ pose)
    weld = jnp.asarray(np.linalg.inv(poses[0]) @ pose)
    closing = (
        jd.loop("b2", POSE, "b4", ball, "spherical", name="ball"),
        jd.loop(None, POSE, "b0", weld, "weld", name="weld"),
    )
    scene = jd.Scene(model, closing)
    return scene, jnp.asarray(q), jnp.asarray(rng.normal(size=model.nv)), jnp.asarray(rng.normal(size=model.nv))


POSE = ((0.1, -0.2, 0.3), (0.5, 0.2, -0.4))


@pytest.fixture(scope="module")
def solved(tree):
    """Everything that is compared, from one program."""
    scene, q, guess, tau = tree

    @quick
    def compute(scene, q, guess, tau):
        assembly = jd.assemble(scene, q, guess)
        q, v = assembly.q, assembly.v
        row = rows(scene, q, v, 0.0)
        ranked, schur = (jd.constrained_dynamics(scene, q, v, tau, method=method) for method in ("rank_aware", "schur"))
        return {
            "q": q,
            "v": v,
            "residual": assembly.residual,
            "A": row.A,
            "gamma": row.gamma,
            "M": jd.mass_matrix(scene.system, q),
            "h": jd.bias_force(scene.system, q, v),
            "C": jd.coriolis_matrix(scene.system, q, v),
            "N": jd.gravity_force(scene.system, q),
            "a": ranked.acceleration,
            "lam": ranked.multipliers,
            "rank": ranked.rank,
            "result": ranked.result == jd.RESULTS.successful,
            "schur": schur.acceleration,
            "schur lam": schur.multipliers,
            "P_T": jd.constraints.projections(scene, q).P_T,
            "S": jd.constraints.second_fundamental_form(scene, q, v),
            "wrenches": jd.constraints.constraint_wrenches(scene, q, ranked.multipliers),
            "forces": jd.constraint_forces(scene, q, ranked.multipliers),
        }

    return jax.tree.map(np.asarray, compute(scene, q, guess, tau)) | {"tau": np.asarray(tau)}


@pytest.mark.long
def test_all_methods_solve_the_saddle_point_system(solved):
    """M a + h = tau + A^T lam, A a = gamma, against a dense solve of both at once."""
    x = solved
    n, m = x["A"].shape[1], x["A"].shape[0]
    matrix = np.block([[x["M"], -x["A"].T], [x["A"], np.zeros((m, m))]])
    want = np.linalg.solve(matrix, np.concatenate([x["tau"] - x["h"], x["gamma"]]))
    assert x["residual"].max() < 1e-12
    assert x["rank"] == m == 9 and x["result"]
    assert_close(x["a"], want[:n], 1e-10)
    assert_close(x["lam"], want[n:], 1e-10)
    assert_close(x["schur"], want[:n], 1e-9)  # the condition number of A M^-1 A^T is that of Y squared
    assert_close(x["schur lam"], want[n:], 1e-9)


def test_acceleration_is_that_of_pinocchio(solved, tree):
    """Pinocchio's constraintDynamics with a 3d and a 6d contact; its contact forces are minus the joint's, on joint 1."""
    model, q = tree[0].system, solved["q"]
    source, bridge = to_pinocchio(model)
    ids = {name: source.getJointId(f"j{name[1:]}") for name in model.body_names}
    contacts = pin.StdVec_RigidConstraintModel()
    for kind, constraint in zip(
        (pin.ContactType.CONTACT_3D, pin.ContactType.CONTACT_6D), tree[0].constraints, strict=True
    ):
        ends = []
        for body, pose in ((constraint.body_a, constraint.pose_a), (constraint.body_b, constraint.pose_b)):
            offset = pin.SE3.Identity() if body is None else source.frames[source.getFrameId(body)].placement
            ends += [0 if body is None else ids[body], offset * pin.SE3(np.asarray(pose))]
        contacts.append(pin.RigidConstraintModel(kind, source, *ends, pin.ReferenceFrame.LOCAL))
    source.armature[:] = np.asarray(model.armature)
    data, datas = source.createData(), pin.StdVec_RigidConstraintData()
    datas.extend([contact.createData() for contact in contacts])
    pin.initConstraintDynamics(source, data, contacts, datas)
    settings = pin.ProximalSettings(1e-14, 0.0, 20)
    a = pin.constraintDynamics(
        source, data, bridge.q_to_pinocchio(q), solved["v"], solved["tau"], contacts, datas, settings
    )
    assert_close(solved["a"], a, 1e-9)  # Pinocchio stops at 1e-14 of its own proximal residual
    weld = solved["wrenches"]["weld"]
    assert_close(weld, datas[1].contact_force.vector * np.sign(weld @ datas[1].contact_force.vector), 1e-8)


def test_gauss_principle(solved):
    """The acceleration is the admissible one nearest to the free one in the metric M (least constraint)."""
    x = solved
    free = np.linalg.solve(x["M"], x["tau"] - x["h"])
    # All admissible accelerations: a particular one plus the null space; minimise by plain least squares.
    start = np.linalg.lstsq(x["A"], x["gamma"], rcond=None)[0]
    null = np.linalg.svd(x["A"])[2][x["rank"] :].T
    root = np.linalg.cholesky(x["M"]).T
    step = np.linalg.lstsq(root @ null, root @ (free - start), rcond=None)[0]
    assert_close(x["a"], start + null @ step, 1e-10)
    # Every other admissible acceleration has a larger constraint (a - free)^T M (a - free), by the square of the change.
    constraint = lambda a: (a - free) @ x["M"] @ (a - free)  # noqa: E731
    for change in np.random.default_rng(0).normal(size=(20, null.shape[1])) @ null.T:
        more = constraint(x["a"] + change) - constraint(x["a"])
        np.testing.assert_allclose(more, change @ x["M"] @ change, rtol=1e-8)


def test_removed_method_and_dependent_rows(tree):
    """The error names what replaces a method that is gone; the Schur complement reports dependent rows."""
    scene, q, v, _ = tree
    with pytest.raises(ValueError, match="now"):
        jd.constrained_dynamics(scene, q, v, method="range_space")
    broken = jd.Scene(scene.system, scene.constraints[:1] * 2)
    result = quick(lambda q, v: jd.constrained_dynamics(broken, q, v, method="schur").result)(q, v)
    assert bool(result == jd.RESULTS.dependent_rows)


def test_lemmas_of_the_projections(solved):
    """EQUATIONS section 7."""
    x = solved
    P, M, A = x["P_T"], x["M"], x["A"]
    n, rank = len(P), int(x["rank"])
    assert_close(P @ P, P, 1e-11)
    assert_close(P.T @ M, M @ P, 1e-11)  # self-adjoint in M: P_omega M = M P_T
    np.testing.assert_allclose(A @ P, 0, atol=1e-11)
    np.testing.assert_allclose(P.T @ A.T, 0, atol=1e-11)
    assert abs(np.trace(P) - (n - rank)) < 1e-10
    assert np.linalg.matrix_rank(P, tol=1e-8) == n - rank
    np.testing.assert_allclose(P @ x["v"], x["v"], atol=1e-11)  # an admissible velocity
    # Motion by the projected equation, and the force that keeps it there: M S = (1 - P_omega)(tau - N) + A^T lam.
    assert_close(P.T @ (M @ x["a"] + x["h"]), P.T @ x["tau"], 1e-10)
    normal = (np.eye(n) - P.T) @ (x["tau"] - x["N"]) + A.T @ x["lam"]
    assert_close(M @ x["S"], normal, 1e-10)
    np.testing.assert_allclose(P @ x["S"], 0, atol=1e-9 * np.abs(x["S"]).max())
    covariant = x["a"] + np.linalg.solve(M, x["C"] @ x["v"])
    assert_close(x["S"], (np.eye(n) - P) @ covariant, 1e-10)


def test_forces_by_name_are_those_of_the_wrenches(solved, tree):
    """A_i^T lam_i is what the wrench does on the two bodies: equal power on random velocities."""
    scene, x = tree[0], solved
    total = sum(x["forces"].values())
    assert set(x["forces"]) == {"ball", "weld"}
    assert_close(total, x["A"].T @ x["lam"], 1e-12)
    power = quick(lambda v: relative_twists(scene, jnp.asarray(x["q"]), v))
    v = jnp.asarray(np.random.default_rng(0).normal(size=scene.nv))
    for name, twist in power(v).items():
        np.testing.assert_allclose(x["forces"][name] @ v, x["wrenches"][name] @ twist, rtol=1e-9)
    np.testing.assert_allclose(total @ x["v"], 0, atol=1e-9 * np.abs(total).max())  # no work on the motion


def relative_twists(scene, q, v):
    """Twist of frame B against frame A, in A, by differences of Jacobians along v."""
    computed = {}
    for constraint in scene.constraints:

        def relative(s, constraint=constraint):
            poses = jd.forward_kinematics(scene.system, jd.integrate(scene.system, q, s * v))
            poses = jnp.concatenate([poses, jnp.eye(4)[None]])
            names = (*scene.system.body_names, None)
            a, b = (poses[names.index(n)] for n in (constraint.body_a, constraint.body_b))
            return jnp.linalg.inv(a @ constraint.pose_a) @ b @ constraint.pose_b

        pose, rate = jax.jvp(relative, (jnp.zeros(()),), (jnp.ones(()),))
        spatial = rate @ jnp.linalg.inv(pose)
        computed[constraint.name] = jnp.concatenate(
            [spatial[:3, 3], jnp.stack([spatial[2, 1], spatial[0, 2], spatial[1, 0]])]
        )
    return computed


def test_rows_without_a_solution_are_reported():
    """Both accelerations a = 0 and a = 1 are asked for."""
    q, v = jnp.zeros(2), jnp.ones(2)
    system = jd.LagrangianSystem(lambda q, v: 0.5 * jnp.sum(v * v), 2)
    rest, move = (
        jd.Pfaffian(lambda q, t: jnp.eye(2)[:1]),
        jd.Pfaffian(lambda q, t: jnp.eye(2)[:1], lambda q, t: t[None]),
    )
    dynamics = quick(lambda q, v: jd.constrained_dynamics(jd.Scene(system, (rest, move)), q, v))(q, v)
    assert bool(dynamics.result == jd.RESULTS.contradictory_rows) and int(dynamics.rank) == 1


def differences(function, direction, h=1e-3):
    """Slope along a direction by central differences of fourth order."""
    f = lambda s: function(s * direction)  # noqa: E731
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


def test_derivatives_in_states_and_masses_where_rows_depend():
    """Reverse mode by finite differences, for the four-bar with three rows without work."""
    q, v = scenes.four_bar.start()
    scene = scenes.four_bar(in_plane=False)

    def value(x):
        scale = jnp.ones((3, 1)) + x[6] * jnp.asarray([[0.0], [0.0], [1.0]])
        model = scene.system.replace(inertias=scene.system.inertias * scale)
        dynamics = jd.constrained_dynamics(jd.Scene(model, scene.constraints), q + x[:3], v + x[3:6])
        return jnp.sum(dynamics.acceleration * jnp.asarray([1.0, -0.3, 0.7])) + jnp.sum(dynamics.multipliers**2)

    direction = jnp.asarray(np.random.default_rng(0).normal(size=7))
    slope = quick(jax.grad(value))(jnp.zeros(7))
    assert (np.abs(slope) > 1e-3).all()
    np.testing.assert_allclose(slope @ direction, differences(quick(value), direction), rtol=1e-7)  # h^4


@pytest.mark.slow
def test_second_derivatives_where_rows_depend():
    """Hessians of the same motion with a row listed once (both methods) and twice (rank-aware) agree, also at rest."""
    q, v = scenes.spherical_pendulum.start(length=1.2, theta=0.8, theta_rate=0.3)
    once = scenes.spherical_pendulum(length=1.2)
    twice = jd.Scene(once.system, once.constraints * 2)

    def value(x, scene, method):
        return jnp.sum(jd.constrained_dynamics(scene, x[:3], x[3:], method=method).acceleration ** 2)

    x, at_rest = jnp.concatenate([q, v]), jnp.concatenate([q, 0 * v])
    for at in (x, at_rest):
        one, other, direct = (
            quick(jax.hessian(lambda x, s=s, m=m: value(x, s, m)))(at)
            for s, m in ((once, "rank_aware"), (twice, "rank_aware"), (once, "schur"))
        )
        assert_close(other, one, 1e-11)
        assert_close(direct, one, 1e-11)
    direction = jnp.asarray(np.random.default_rng(0).normal(size=6))
    grad = quick(jax.grad(lambda x: value(x, twice, "rank_aware")))
    hessian = quick(jax.hessian(lambda x: value(x, twice, "rank_aware")))(x)
    assert_close(hessian @ direction, differences(lambda dx: grad(x + dx), direction), 1e-8)  # h^4


@pytest.mark.parametrize("shape", [(7, 4), (4, 7), (6, 6)])
def test_pseudo_inverse_of_any_rank(shape):
    """The four Penrose conditions, numpy, and the derivative along a curve of constant rank."""
    rng, (m, n), h = np.random.default_rng(0), shape, 1e-3
    steps = h * np.array([0.0, -2.0, -1.0, 1.0, 2.0])

    @quick
    def compute(Y, turn_l, turn_r):
        """Inverses along the curve and the slope where it begins: one program for all ranks."""
        inverse = lambda s: pseudo_inverse((jnp.eye(m) + s * turn_l) @ Y @ (jnp.eye(n) + s * turn_r), 1e-9)  # noqa: E731
        inverses, slopes = jax.vmap(lambda s: jax.jvp(inverse, (s,), (jnp.ones(()),)))(jnp.asarray(steps))
        return inverses, slopes[0]

    for rank in (0, 1, 3, min(shape)):
        Y = rng.normal(size=(m, rank)) @ rng.normal(size=(rank, n))
        (P, *at), slope = (np.asarray(x) for x in compute(Y, rng.normal(size=(m, m)), rng.normal(size=(n, n))))
        np.testing.assert_allclose(P, np.linalg.pinv(Y, rcond=1e-9), atol=1e-12 * max(1, np.abs(P).max()))
        want = (8 * (at[2] - at[1]) - (at[3] - at[0])) / (12 * h)
        np.testing.assert_allclose(slope, want, atol=1e-7 * max(1, np.abs(want).max()))  # h^4 of the differences


@pytest.mark.long
def test_printed_numbers():
    """Planar pendulum of EQUATIONS section 6, Andrews' mechanism at its start, the coin's contact force."""
    angle, rate, mass, length = 0.5, 1.7, 0.7, 1.2
    q, v = scenes.pendulum_in_plane.start(length=length, angle=angle, rate=rate)
    pendulum = scenes.pendulum_in_plane(mass=mass, length=length)
    dynamics = quick(lambda q, v: jd.constrained_dynamics(pendulum, q, v))(q, v)
    np.testing.assert_allclose(dynamics.multipliers, -7.04496621, rtol=1e-9)
    np.testing.assert_allclose(-length * dynamics.multipliers, 8.45395945, rtol=1e-9)

    q, v = test_set.andrews.start()
    dynamics = quick(lambda scene: jd.constrained_dynamics(scene, q, v))(test_set.andrews())
    want = [14222.4439199541138705911625887, -10666.8329399655854029433719415, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(dynamics.acceleration, want, rtol=1e-11, atol=1e-8)
    # Printed multipliers stand on the left.
    want = [-98.5668703962410896057654982170, 6.12268834425566265503114393122, 0, 0, 0, 0]
    np.testing.assert_allclose(dynamics.multipliers, want, rtol=1e-11, atol=1e-11)

    q, v = scenes.rolling_coin.start()
    dynamics = quick(lambda scene: jd.constrained_dynamics(scene, q, v))(scenes.rolling_coin())
    normal, forward, across = np.asarray(dynamics.multipliers)
    np.testing.assert_allclose([normal, abs(across)], [2.990088, 0.174144017028], rtol=1e-10)
    assert abs(forward) < 1e-12
    centripetal = np.asarray(dynamics.acceleration)[:3] + np.cross(np.asarray(v)[3:], np.asarray(v)[:3])
    np.testing.assert_allclose(np.linalg.norm(centripetal), 0.174144017028 / 0.3048, rtol=1e-10)


def test_spherical_pendulum_by_projection():
    """S = -|v|^2/r^2 q and P_T = 1 - q q^T/r^2, and the motion against the equations in angles."""
    r, theta, rates = 1.3, 0.9, (0.4, 1.1)
    q, v = scenes.spherical_pendulum.start(length=r, theta=theta, phi=0.3, theta_rate=rates[0], phi_rate=rates[1])
    scene = scenes.spherical_pendulum(length=r)

    @quick
    def compute(q, v):
        return (
            jd.constraints.projections(scene, q).P_T,
            jd.constraints.second_fundamental_form(scene, q, v),
            jd.constrained_dynamics(scene, q, v),
        )

    P_T, bend, dynamics = compute(q, v)
    q, v = np.asarray(q), np.asarray(v)
    assert_close(P_T, np.eye(3) - np.outer(q, q) / r**2, 1e-14)
    assert_close(bend, -(v @ v) / r**2 * q, 1e-14)
    assert_close(dynamics.multipliers, [(9.81 * q[2] - v @ v) / r**2], 1e-14)

    def place(angles):
        return r * jnp.stack(
            [jnp.sin(angles[0]) * jnp.cos(angles[1]), jnp.sin(angles[0]) * jnp.sin(angles[1]), -jnp.cos(angles[0])]
        )

    # theta and phi from EQUATIONS section 1, carried to space.
    accelerations = np.array(
        [
            np.sin(theta) * np.cos(theta) * rates[1] ** 2 - 9.81 / r * np.sin(theta),
            -2 * rates[0] * rates[1] / np.tan(theta),
        ]
    )
    angles, speeds = jnp.asarray([theta, 0.3]), jnp.asarray(rates)

    def velocity(angles, speeds):
        return jax.jvp(place, (angles,), (speeds,))[1]

    want = quick(lambda *at: jax.jvp(velocity, at[:2], at[1:])[1])(angles, speeds, jnp.asarray(accelerations))
    assert_close(dynamics.acceleration, want, 1e-13)


@pytest.mark.long
def test_assemble_finds_the_nearest_configuration():
    """From a rough guess: closed to rounding, the least change in the metric M(guess), admissible velocity."""
    scene = scenes.four_bar()
    guess, rate = jnp.asarray([0.9, -0.4, 1.6]), jnp.asarray([1.0, 0.0, 0.0])

    @quick
    def solve(guess, rate):
        computed = jd.assemble(scene, guess, rate)
        before, after = (jd.mass_matrix(scene.system, x) for x in (guess, computed.q))
        pull = before @ jd.difference(scene.system, guess, computed.q)
        return computed, pull, after @ (computed.v - rate), rows(scene, computed.q, computed.v, 0.0).A

    computed, pull, change, row = solve(guess, rate)
    assert float(computed.residual.max()) < 1e-13
    # A stationary point: M (q - guess) is a combination of the rows.
    left = pull - row.T @ np.linalg.lstsq(np.asarray(row.T), np.asarray(pull), rcond=None)[0]
    np.testing.assert_allclose(left, 0, atol=1e-6)  # Newton's last steps, to close the loop, are not taken along it
    left = change - row.T @ np.linalg.lstsq(np.asarray(row.T), np.asarray(change), rcond=None)[0]
    np.testing.assert_allclose(left, 0, atol=1e-12)


@pytest.mark.long
def test_assemble_fails_clearly():
    scene = scenes.four_bar(lengths=(1.0, 1.0, 1.0, 2.5))
    far = scene.system.replace(home=scene.system.home.at[2, 0, 3].set(4.0))
    broken, guess = jd.Scene(far, scene.constraints), jnp.asarray([0.3, -0.4, 2.0])
    # The gap is 1 m at least, and the message gives the larger of its two components.
    with pytest.raises(ValueError, match=r"open by (0\.[7-9]|[1-9])"):
        jd.assemble(broken, guess)

    def fails(ground):
        model = scene.system.replace(home=far.home.at[2, 0, 3].set(ground))
        return jd.assemble(jd.Scene(model, scene.constraints), guess).result == jd.RESULTS.not_assembled

    codes = quick(jax.vmap(fails))(jnp.asarray([2.5, 4.0]))
    assert codes.tolist() == [False, True]
    system = jd.LagrangianSystem(lambda q, v: 0.5 * jnp.sum(v * v), 2)
    both = [jd.Holonomic(lambda q, t, x=x: q[0] - x, name=f"x = {x}") for x in (0.0, 1.0)]
    with pytest.raises(ValueError, match=r"open by 0\.5"):
        jd.assemble(jd.Scene(system, both), jnp.asarray([0.2, 0.1]))


@pytest.mark.long
def test_assembling_with_a_joint_held():
    """The crank where it was told to be, the loop closed; velocities are those of the free mechanism."""
    scene, (q, v) = scenes.four_bar(), scenes.four_bar.start()
    names = scene.system.joint_names
    wanted = float(q[0]) + 0.2
    assembly = jd.assemble(scene, q, v, hold={names[0]: wanted})
    np.testing.assert_allclose(assembly.q[0], wanted, atol=1e-12)
    np.testing.assert_allclose(largest_residuals(scene, assembly.q, assembly.v), 0, atol=1e-12)
    assert float(jnp.max(jnp.abs(assembly.v))) > 0.1
    again = jd.assemble(scene, assembly.q, assembly.v)
    np.testing.assert_allclose(again.q, assembly.q, atol=1e-12)
    with pytest.raises(ValueError, match="'elbow9' is not"):
        jd.assemble(scene, q, hold={"elbow9": 0.1})
    with pytest.raises(ValueError, match="from 3 configurations"):
        jd.assemble(scene, q, hold={names[0]: wanted, names[1]: 2.9}, guesses=4)


def test_a_tree_without_constraints_holds_what_it_is_told():
    """The other joints go where the change is least in the mass metric; velocities are those that are given."""
    arm, wanted = jd.robots.iiwa(), 0.5
    q, v = jnp.linspace(0.1, 0.4, 7), jnp.linspace(-1.0, 1.0, 7)
    for held in (
        jd.assemble(jd.Scene(arm), q, v, hold={"iiwa_joint_2": wanted}),
        jd.assemble(arm, q, v, hold={"iiwa_joint_2": wanted}),
    ):
        # The least |e| in M with one entry given: e = M^-1 row^T (row M^-1 row^T)^-1 (wanted - q).
        column = jnp.linalg.inv(jd.mass_matrix(arm, q))[:, 1]
        np.testing.assert_allclose(held.q, q + column / column[1] * (wanted - q[1]), atol=1e-12)
        np.testing.assert_array_equal(held.v, v)
        assert held.success and held.residual[0] < 1e-12 and held.residual[1] == 0


def test_assembling_from_a_bad_guess():
    """Stretched out, the loop's equations do not say to which side it closes; a configuration beside it does."""
    scene, straight = scenes.four_bar(), jnp.zeros(3)
    assert not bool(jd.assemble(scene, straight, guesses=1, throw=False).success)
    assembly = jd.assemble(scene, straight)
    assert assembly.guesses == 2
    np.testing.assert_allclose(largest_residuals(scene, assembly.q, assembly.v), 0, atol=1e-12)
    np.testing.assert_array_equal(assembly.q, jd.assemble(scene, straight).q)
    with pytest.raises(ValueError, match="guesses is 0"):
        jd.assemble(scene, straight, guesses=0)


@pytest.mark.slow
@pytest.mark.parametrize("in_plane", [False, True])
def test_assembling_from_afar_is_differentiable(in_plane):
    """The guess is half a radian off, where the curvature of the constraint counts; dependent rows change nothing."""
    scene = scenes.four_bar(in_plane=in_plane)
    q, _ = scenes.four_bar.start()
    guess, weights = q + jnp.asarray([0.5, -0.3, 0.4]), jnp.asarray([0.3, -1.0, 0.5])
    step = jnp.asarray([0.2, 0.5, -0.7, 1.0])

    def computed(x):
        model = scene.system.replace(home=scene.system.home.at[2, 0, 3].add(x[3]))
        return jnp.vdot(weights, jd.assemble(jd.Scene(model, scene.constraints), guess + x[:3]).q)

    def along(x):
        return jax.jvp(computed, (x,), (step,))[1]

    def everything(x):
        return computed(x), along(x), jnp.vdot(jax.grad(computed)(x), step), jax.jvp(along, (x,), (step,))[1]

    h = 1e-4
    places = h * jnp.stack([-step, jnp.zeros(4), step])
    value, forward, backward, second = quick(jax.vmap(everything))(places)
    # Iterations towards the minimum end at 1e-7 of it, squared by their convergence, and differences lose h^2.
    assert_close(forward[1], (value[2] - value[0]) / (2 * h), 1e-6)
    assert_close(backward, forward, 1e-10)
    assert_close(second[1], (forward[2] - forward[0]) / (2 * h), 1e-6)


def test_a_wheel_built_from_bodies_moves_as_the_disk_in_coordinates():
    """Planar joint and axle with `rolling_wheel` against the Lagrangian of Murray, Li & Sastry."""

    mass, rho, steer, roll = 2.0, 0.5, 0.125, 0.25
    builder = jd.ModelBuilder("disk", gravity=None)
    builder.add_body("fork", None, "planar", (0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), pose=(0.0, 0.0, rho))
    builder.add_body("wheel", "fork", "continuous", (mass, (0, 0, 0), (steer, roll, steer)), axis=(0.0, 1.0, 0.0))
    wheel = jd.rolling_wheel("wheel", ((0, 0, 0), (-np.pi / 2, 0, 0)), rho, contact=False)
    scene = jd.Scene(builder.build(), (wheel,))
    q, v = jnp.asarray([0.1, 0.2, 0.7, 0.3]), jnp.asarray([rho * 2.0, 0.0, 1.3, 2.0])
    solve = quick(lambda scene, q, v, tau: (largest_residuals(scene, q, v), jd.constrained_dynamics(scene, q, v, tau)))
    error, computed = solve(scene, q, v, jnp.asarray([0.0, 0.0, 0.3, 0.9]))
    assert float(error.max()) < 1e-14
    turn, rolling = 0.3 / steer, 0.9 / (roll + mass * rho**2)
    assert_close(computed.acceleration, [rho * rolling, 0.0, turn, rolling], 1e-12)
    assert_close(computed.multipliers[1:], [mass * rho * 2.0 * 1.3], 1e-12)


def test_locked_joints_and_float32():
    """Locking all but one joint leaves a pendulum; in float32 the numbers keep their type."""
    q, _ = scenes.four_bar.start()
    model = scenes.four_bar().system
    locked = jd.Scene(model, (jd.constraints.lock_joint("2", float(q[1])), jd.constraints.lock_joint("3", float(q[2]))))
    v = jnp.asarray([1.0, 0.0, 0.0])
    solve = quick(lambda scene, q, v: jd.constrained_dynamics(scene, q, v))
    solution = solve(locked, q, v)
    M, h = quick(lambda q, v: (jd.mass_matrix(model, q), jd.bias_force(model, q, v)))(q, v)
    assert_close(solution.acceleration, [-h[0] / M[0, 0], 0.0, 0.0], 1e-13)
    single = jax.tree.map(lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, locked)
    low = solve(single, q.astype(jnp.float32), v.astype(jnp.float32))
    assert low.acceleration.dtype == low.multipliers.dtype == jnp.float32
    assert_close(low.acceleration, solution.acceleration, 1e-5)
