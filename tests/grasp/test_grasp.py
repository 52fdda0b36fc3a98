"""Grasps against contact geometry in numpy, the saddle-point solve, identities of the effective dynamics, and balances."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import adjoint, assert_close, placed, quick
from scipy.spatial.transform import Rotation

import jaxdyn as jd
from jaxdyn import events, inertia, scenes

NAMES = ("hand_with_bar", "hand_with_disk", "hand_with_ball", "hand_rolling_ball")
SPATIAL = NAMES[2:]
# One contact that is fixed and one that rolls in every run, the others in the slow ones.
CASES = [pytest.param(name, marks=[pytest.mark.slow] if name in NAMES[:3] else []) for name in NAMES]
STENCIL, WEIGHTS = (-3, -2, -1, 1, 2, 3), np.array([-1, 9, -45, 45, -9, 1]) / 60


@functools.cache
def solved(name):
    """A scene at a moving state under random torques: its grasp, state and everything that is computed of it."""
    family = getattr(scenes, name)
    grasp, (q, v) = family(), family.start()
    objects, hands = np.array(grasp.object_velocities), np.array(grasp.hand_velocities)
    random = np.random.default_rng(3)
    tau, lam = jnp.asarray(random.normal(size=grasp.nv)), jnp.asarray(random.normal(size=len(hands)))

    @quick
    def compute(q, v, tau):
        along = (jd.configuration_rate(grasp.system, q, v),)
        return {
            "object": jd.grasp.object_dynamics(grasp, q, v[objects], tau),
            "full": jd.constrained_dynamics(grasp, q, v, tau),
            "mass": jd.mass_matrix(grasp.system, q),
            "potential": jax.jvp(lambda q: jd.potential_energy(grasp.system, q), (q,), along)[1],
            "kinetic": jd.kinetic_energy(grasp.system, q, v),
            "A": jd.constraint_jacobian(grasp, q),
            "Jh": jd.grasp.hand_jacobian(grasp, q),
            "G": jd.grasp.grasp_map(grasp, q),
            "internal": jd.grasp.internal_forces(grasp, q, lam),
        }

    computed = compute(q, v, tau)
    return {
        "grasp": grasp,
        "q": q,
        "v": v,
        "tau": tau,
        "hands": hands,
        "objects": objects,
        "compute": compute,
    } | computed


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_reduced_equations_are_those_with_multipliers(name):
    """Accelerations and contact forces of (6.21)-(6.25) against the saddle-point solve."""
    at = solved(name)
    computed, full = at["object"], at["full"]
    assert bool(computed.result == jd.RESULTS.successful)
    assert int(full.rank) == len(at["hands"])
    assert_close(computed.velocity, at["v"], 1e-13)  # J_h thetadot = G^T V
    assert_close(computed.acceleration, full.acceleration, 1e-10)
    assert_close(computed.rate, full.acceleration[at["objects"]], 1e-10)
    assert_close(computed.contact_forces, full.multipliers, 1e-10)
    by_contact = computed.by_contact()
    assert list(by_contact) == [place.name for place in full.layout]
    assert_close(np.concatenate(list(by_contact.values())), computed.contact_forces, 0)


@pytest.mark.parametrize("name", CASES)
def test_effective_dynamics(name):
    """dM~/dt = C~ + C~^T along the motion (lemma 6.1); energies and powers are those of the whole mechanism."""
    at = solved(name)
    computed, V = at["object"], at["v"][at["objects"]]
    N = np.zeros((at["grasp"].nv, len(at["objects"])))
    N[at["objects"]], N[at["hands"]] = np.eye(len(at["objects"])), np.linalg.solve(at["Jh"], at["G"].T)
    assert_close(computed.mass_matrix, N.T @ at["mass"] @ N, 1e-12)
    # Differences of sixth order: truncation 1e-15 and rounding 1e-13 of the rate.
    step, move = 2e-3, quick(lambda v: jd.integrate(at["grasp"].system, at["q"], v))
    mass = [
        np.asarray(at["compute"](move(k * step * at["v"]), at["v"], at["tau"])["object"].mass_matrix) for k in STENCIL
    ]
    rate = sum(weight * M for weight, M in zip(WEIGHTS, mass, strict=True)) / step
    assert np.linalg.eigvalsh(np.asarray(computed.mass_matrix)).min() > 0
    skew = rate - 2 * computed.coriolis_matrix
    assert float(jnp.abs(computed.coriolis_matrix).max()) > 1e-3
    np.testing.assert_allclose(skew + skew.T, 0, atol=1e-10 * np.abs(rate).max())
    assert_close(0.5 * V @ computed.mass_matrix @ V, at["kinetic"], 1e-12)
    assert_close(computed.gravity_force @ V, at["potential"], 1e-12)
    assert_close(computed.force @ V, at["tau"] @ at["v"], 1e-12)
    left = computed.mass_matrix @ computed.rate + computed.coriolis_matrix @ V + computed.gravity_force
    assert_close(left, computed.force, 1e-11)


@pytest.mark.parametrize("name", CASES)
def test_internal_forces_move_nothing(name):
    """G lam_N = 0; torques J_h^T lam_N leave the motion as it is and add lam_N to the contact forces."""
    at = solved(name)
    internal, full = at["internal"], at["full"]
    pushed = at["compute"](at["q"], at["v"], at["tau"].at[at["hands"]].add(at["Jh"].T @ internal))["full"]
    assert np.linalg.matrix_rank(np.asarray(at["G"])) == len(at["objects"])
    assert float(jnp.abs(internal).max()) > 0.1
    np.testing.assert_allclose(at["G"] @ internal, 0, atol=1e-14)
    assert_close(pushed.acceleration, full.acceleration, 1e-11)
    assert_close(pushed.multipliers - full.multipliers, internal, 1e-11)


@pytest.mark.parametrize("name", CASES)
def test_contact_forces_balance_the_object(name):
    """Newton's and Euler's equations of the object alone, about its centre of mass."""
    at = solved(name)
    a, v = (np.asarray(x)[at["objects"]] for x in (at["object"].acceleration, at["v"]))
    model = at["grasp"].system
    m, *_, Ixx, _, Iyy, _, _, Izz = np.asarray(model.inertias[model.body_names.index(at["grasp"].object)])
    gravity = np.asarray(model.gravity)
    if name in SPATIAL:
        R = np.asarray(jd.frame_pose(model, at["q"], "ball"))[:3, :3]
        moments = np.array([Ixx, Iyy, Izz])
        push = m * (a[:3] + np.cross(v[3:], v[:3]) - R.T @ gravity)
        wrench = np.concatenate([push, moments * a[3:] + np.cross(v[3:], moments * v[3:])])
    else:
        c, s = np.cos(float(at["q"][-1])), np.sin(float(at["q"][-1]))
        pull = np.array([c * gravity[0] + s * gravity[1], -s * gravity[0] + c * gravity[1]])
        push = m * (a[:2] + v[2] * np.array([-v[1], v[0]]) - pull)
        wrench = np.array([*push, Izz * a[2]])
    forces = at["G"] @ at["object"].contact_forces
    assert_close(forces + at["tau"][at["objects"]], wrench, 1e-10)


@pytest.mark.long
def test_planar_hand_by_hand():
    """G and J_h of the bar: MLS's two-finger grasp, and the Jacobian of a 2R arm in axes of the contacts."""
    at = solved("hand_with_bar")
    half, (l1, l2) = 0.15, (0.3, 0.25)
    assert_close(at["G"], [[0, 1, 0, -1], [1, 0, 1, 0], [-half, 0, half, 0]], 1e-14)
    q, expected = np.asarray(at["q"]), np.zeros((4, 4))
    c, s = np.cos(q[6]), np.sin(q[6])
    for i, side in ((0, 1.0), (1, -1.0)):
        th, both = q[2 * i], q[2 * i] + q[2 * i + 1]
        knee = l2 * np.array([-np.sin(both), np.cos(both)])
        J = np.stack([knee + l1 * np.array([-np.sin(th), np.cos(th)]), knee], 1)
        expected[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = np.array([[-s, c], [side * c, side * s]]) @ J
    assert_close(at["Jh"], expected, 1e-14)
    A = np.zeros((4, 7))
    A[:, :4], A[:, 4:] = -expected, np.asarray(at["G"]).T
    assert_close(at["A"], A, 1e-14)


@functools.cache
def disk_rows():
    """q, v and the rows A of the disk between two fingers, at the start."""
    grasp, (q, v) = scenes.hand_with_disk(), scenes.hand_with_disk.start()
    return np.asarray(q), np.asarray(v), np.asarray(quick(lambda q: jd.constraint_jacobian(grasp, q))(q))


def test_maps_of_rolling_contacts():
    """Forces act at the points of contact, at right angles; J_h is the Jacobian of the material point there."""
    at, radius, tip_radius = solved("hand_rolling_ball"), 0.1, 0.02
    model, q = at["grasp"].system, at["q"]
    frames = quick(
        lambda q: [(jd.frame_pose(model, q, f"tip{i}"), jd.body_jacobian(model, q, f"tip{i}")) for i in (1, 2, 3)]
    )
    ball = np.asarray(jd.frame_pose(model, q, "ball"))
    G, Jh = np.asarray(at["G"]), np.asarray(at["Jh"])
    for i, (tip, J) in enumerate(frames(q)):
        tip, J = np.asarray(tip), np.asarray(J)
        rows = slice(3 * i, 3 * i + 3)
        directions, torques = ball[:3, :3] @ G[:3, rows], ball[:3, :3] @ G[3:, rows]
        normal = ball[:3, 3] - tip[:3, 3]
        assert_close(np.linalg.norm(normal), radius + tip_radius, 1e-14)
        normal = normal / (radius + tip_radius)
        assert_close(directions[:, 0], normal, 1e-13)
        assert_close(directions.T @ directions, np.eye(3), 1e-13)
        np.testing.assert_allclose(torques, np.cross(-radius * normal, directions.T).T, atol=1e-15)
        at_point = placed(np.eye(3), tip[:3, :3].T @ (tip_radius * normal))
        carried = tip[:3, :3] @ (adjoint(np.linalg.inv(at_point)) @ J)[:3]
        np.testing.assert_allclose(Jh[rows], directions.T @ carried[:, at["hands"]], atol=1e-14)
    # The disk's normal forces pass through its centre, tangential ones turn it.
    A, (n1, n2) = disk_rows()[2], ([np.cos(0.12), np.sin(0.12)], [-np.cos(0.05), np.sin(0.05)])
    columns = [[*n1, 0], [-n1[1], n1[0], -0.1], [*n2, 0], [-n2[1], n2[0], -0.1]]
    assert_close(A[:, 4:], columns, 1e-13)


def cartesian_fingers(names):
    """One model per finger: a body that moves freely."""
    names = list(names)
    builders = [jd.ModelBuilder(name, gravity=None) for name in names]
    return [
        b.add_body(name, None, "free", inertia.sphere(0.1, 0.02)).build()
        for b, name in zip(builders, names, strict=True)
    ]


def block(gravity=None):
    """A box on a free joint."""
    return (
        jd.ModelBuilder("block", gravity=gravity)
        .add_body("obj", None, "free", inertia.box(1.0, (0.2, 0.3, 0.1)))
        .build()
    )


def configuration(model, poses):
    """q of free bodies at poses by name."""
    q = np.zeros(model.nq)
    for name, place in zip(model.body_names, model.topology.q_slices, strict=True):
        xyzw = Rotation.from_matrix(poses[name][:3, :3]).as_quat()
        q[place] = [*poses[name][:3, 3], xyzw[3], *xyzw[:3]]
    return jnp.asarray(q)


def test_every_kind_of_contact():
    """G_i = Ad^T_{g_oc^-1} B and J_h = B^T Ad_{g_cf} for random frames; models are joined in order of joint names."""
    turns, random = Rotation.random(9, rng=5).as_matrix(), np.random.default_rng(5)
    kinds = {"a": "frictionless", "b": "hard-finger", "y": "soft-finger", "z": "rigid"}
    poses, frames, contacts = {"obj": placed(turns[8], random.normal(size=3))}, {}, []
    for i, (name, kind) in enumerate(kinds.items()):
        frame = placed(turns[i], random.normal(size=3))
        slid = placed(np.eye(3), [0.3, -0.2, 0.0] if kind == "frictionless" else np.zeros(3))
        turned = placed(np.eye(3) if kind == "rigid" else turns[4 + i], np.zeros(3))
        poses[name], frames[name] = poses["obj"] @ frame @ slid @ turned, (frame @ slid, turned)
        contacts.append(jd.grasp.contact(kind, name, frame))
    # A round fingertip on a face of the object: here z is the outward normal, and forces press, so they point inwards.
    face, radius = placed(turns[7], random.normal(size=3)), 0.05
    touched = face @ placed(np.eye(3), [0.1, -0.2, 0.0])
    lifted = placed(turns[3], [0.0, 0.0, radius])
    poses["c"] = poses["obj"] @ touched @ lifted
    rolling = jd.rolling_sphere("c", None, radius, surface=jnp.asarray(face), surface_body="obj")
    grasp = jd.grasp.Grasp(cartesian_fingers([*reversed(kinds), "c"]), block(), [*contacts, rolling])
    assert grasp.system.body_names == ("a", "b", "c", "obj", "y", "z")
    assert grasp.object_velocities == tuple(range(18, 24))
    q = configuration(grasp.system, poses)
    G, Jh = quick(lambda q: (jd.grasp.grasp_map(grasp, q), jd.grasp.hand_jacobian(grasp, q)))(q)
    frames["c"] = touched, lifted
    bases = {name: jd.contact.wrench_basis(kind) for name, kind in kinds.items()} | {"c": -np.eye(6)[:, [2, 0, 1]]}
    wanted = [adjoint(np.linalg.inv(frames[name][0])).T @ B for name, B in bases.items()]
    assert_close(G, np.concatenate(wanted, 1), 1e-13)
    expected, row = np.zeros((17, 30)), 0
    for name, B in bases.items():
        i = 6 * "abcyz".index(name)
        expected[row : row + B.shape[1], i : i + 6] = B.T @ adjoint(frames[name][1])
        row += B.shape[1]
    assert_close(Jh, expected, 1e-13)


def test_box_in_two_soft_fingers():
    """The grasp map of MLS example 5.2, and its internal forces: squeezing and twisting."""
    r = 0.15
    first = placed(np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]), [0, -r, 0])
    second = placed(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), [0, r, 0])
    contacts = [jd.grasp.contact("soft-finger", "a", first), jd.grasp.contact("soft-finger", "b", second)]
    grasp = jd.grasp.Grasp(cartesian_fingers("ab"), block(), contacts)
    q = configuration(grasp.system, {"obj": np.eye(4), "a": first, "b": second})
    lam = jnp.asarray(np.random.default_rng(2).normal(size=8))
    G, internal = quick(lambda q: (jd.grasp.grasp_map(grasp, q), jd.grasp.internal_forces(grasp, q, lam)))(q)
    rows = [
        [0, 1, 0, 0, 1, 0, 0, 0],
        [0, 0, 1, 0, 0, 0, -1, 0],
        [1, 0, 0, 0, 0, 1, 0, 0],
        [-r, 0, 0, 0, 0, r, 0, 0],
        [0, 0, 0, 1, 0, 0, 0, -1],
        [0, r, 0, 0, -r, 0, 0, 0],
    ]
    assert_close(G, rows, 1e-13)
    squeeze, twist = (lam[2] + lam[6]) / 2, (lam[3] + lam[7]) / 2
    assert_close(internal, [0, 0, squeeze, twist, 0, 0, squeeze, twist], 1e-12)


def test_rolling_in_a_plane_is_a_differential():
    """No slip means that the way along the face less radius times angle is constant: the row is its gradient."""
    (q, _, A), radius, l1 = disk_rows(), 0.1, 0.3

    def rolled(q, i, side):
        low, high = q[2 * i], q[2 * i] + q[2 * i + 1]
        knee = np.array([side * 0.25 + l1 * np.cos(low), l1 * np.sin(low)])
        return -side * ((q[4:6] - knee) @ [np.cos(high), np.sin(high)]) - radius * (q[6] - high)

    for i, side in enumerate((-1.0, 1.0)):
        step = 1e-3
        moved = np.array([[rolled(q + k * step * unit, i, side) for k in STENCIL] for unit in np.eye(7)])
        # The angle of the disk is zero, so its v is qdot.
        np.testing.assert_allclose(A[2 * i + 1], moved @ WEIGHTS / step, atol=1e-11)


def steady(q, v, t):
    """Constant torques on the fingers, and a force on the object."""
    return 0.3 * jnp.cos(jnp.arange(v.shape[0], dtype=v.dtype))


def simulated(grasp, q, v, methods):
    """Motions by `simulate`, on the contacts, with an energy that changes by the work done."""
    outputs = ("energy", "work", "constraint_residual")
    options = {
        "control": steady,
        "rtol": 1e-12,
        "atol": 1e-12,
        "outputs": outputs,
        "events": [events.ContactLost(stop=False)],
    }
    runs = [jd.simulate(grasp, q, v, jnp.linspace(0.0, 0.1, 3), method=method, **options) for method in methods]
    for one in runs:
        assert float(one.constraint_residual.max()) < 1e-12
        assert_close(one.energy - one.energy[0], one.work, 1e-9)
    return runs


@pytest.mark.slow
def test_rolling_ball_is_not_integrable_and_moves():
    """Brackets reach all that the three gaps allow, 15 - 3."""
    grasp, (q, v) = scenes.hand_rolling_ball(), scenes.hand_rolling_ball.start()
    computed = jd.reduction.involutive(grasp, q)
    assert not computed.value and computed.ranks == (6, 12)
    simulated(grasp, q, v, [jd.Reduced(grasp.object_velocities)])


@pytest.mark.slow
def test_batch_of_grasps_with_different_links():
    """One vmap over hands of different lengths equals a loop; also in float32, in its own dtype."""
    lengths = [(0.3, 0.25), (0.28, 0.27), (0.33, 0.22)]
    grasps = [scenes.hand_with_bar(links=links) for links in lengths]
    starts = [scenes.hand_with_bar.start(links=links) for links in lengths]
    rows = [(grasp, *start) for grasp, start in zip(grasps, starts, strict=True)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *rows)
    solve = lambda grasp, q, v: jd.grasp.object_dynamics(grasp, q, v[4:])  # noqa: E731
    one, many = quick(solve), quick(jax.vmap(solve))
    loop, computed = [one(*row) for row in rows], many(*batch)
    for name in ("acceleration", "contact_forces", "mass_matrix"):
        assert_close(getattr(computed, name), np.stack([getattr(x, name) for x in loop]), 1e-12)
    assert float(jnp.ptp(computed.mass_matrix, axis=0).max()) > 1e-2
    single = jax.tree.map(lambda x: x.astype(jnp.float32), batch)
    rough = many(*single)
    assert rough.acceleration.dtype == rough.contact_forces.dtype == jnp.float32
    assert_close(rough.acceleration, computed.acceleration, 1e-4)


@pytest.mark.slow
def test_gradients_through_the_reduced_motion():
    """Where the bar goes, against its mass and the mass of the outer links, in reverse mode and by differences."""
    grasp, (q, v) = scenes.hand_with_bar(), scenes.hand_with_bar.start()
    bar, outer = (grasp.system.body_names.index(name) for name in ("bar", "finger1_2"))

    def reached(scales):
        inertias = grasp.system.inertias.at[jnp.array([bar, outer])].multiply(scales[:, None], unique_indices=True)
        changed = eqx.tree_at(lambda g: g.system.inertias, grasp, inertias)
        ts, method = jnp.linspace(0.0, 0.05, 2), jd.Reduced(grasp.object_velocities)
        end = jd.simulate(changed, q, v, ts, method=method, stepsize=2.5e-3, events=[events.ContactLost(stop=False)]).q[
            -1
        ]
        return jnp.stack([end[5], end[6]])

    place = jnp.asarray([1.0, 1.0])
    slopes = quick(jax.jacrev(reached))(place)
    run, step = quick(reached), 1e-3
    moved = [[run(place + k * step * unit) for k in STENCIL] for unit in jnp.eye(2)]
    expected = np.einsum("pko,k->op", np.asarray(moved), WEIGHTS) / step
    assert np.abs(expected).min() > 1e-4
    assert_close(slopes, expected, 1e-6)


def test_singular_hand_jacobian_gives_a_code():
    """A finger that is stretched out cannot follow the object."""
    at = solved("hand_with_bar")
    computed = at["compute"](at["q"].at[1].set(0.0), at["v"], at["tau"])["object"]
    assert bool(computed.result == jd.RESULTS.singular_basis)
    assert all(bool(jnp.isfinite(x).all()) for x in (computed.acceleration, computed.contact_forces))


def test_refusals():
    """What does not fit is refused by name."""
    with pytest.raises(ValueError, match="kind 'sticky' is"):
        jd.grasp.contact("sticky", "tip1", None)
    with pytest.raises(ValueError, match="in a plane"):
        jd.contact.wrench_basis("soft-finger", in_plane=True)
    fingers, held = cartesian_fingers("ab"), jd.grasp.contact("rigid", "a", None)
    slipping = jd.Pfaffian(lambda q, t: jnp.zeros((1, 18)), lambda q, t: jnp.ones(1))
    bar = scenes.hand_with_bar().system
    for match, *given in (
        ("frame 'c' is", fingers, block(), [jd.grasp.contact("rigid", "c", None)]),
        ("least one contact", fingers, block(), []),
        (r"\['a_joint'\] are in", [fingers[0], fingers[0].replace(gravity=None)], block(), [held]),
        ("different gravity", fingers, block(gravity=(0.0, 0.0, -9.81)), [held]),
        ("object 'thing' is", fingers, "thing", [held]),
        ("of a tree", bar, "finger1_1", [held]),
        ("no fingers", block(), "obj", [held]),
        ("object has 5", fingers, bar, [held]),
        ("be the object", fingers, block(), [jd.rolling_sphere("a", None, 0.1, surface_body="b")]),
        ("is on 'b'", fingers, block(), [jd.grasp.contact("rigid", "a", None, object="b")]),
        ("prescribes a slip", fingers, block(), [slipping]),
    ):
        with pytest.raises(ValueError, match=match):
            jd.grasp.Grasp(*given)
    grasp = scenes.hand_with_bar()
    with pytest.raises(ValueError, match="V has shape"):
        jd.grasp.object_dynamics(grasp, solved("hand_with_bar")["q"], jnp.zeros(2))
    loose = scenes.hand_with_bar(kind="frictionless")
    with pytest.raises(ValueError, match="hand 4 joints"):
        jd.grasp.object_dynamics(loose, solved("hand_with_bar")["q"], jnp.zeros(3))
