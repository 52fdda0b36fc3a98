"""Every public function of a scene with redundant rows, on mechanisms whose numbers are rounded, against the exact mechanism.

Results are within ten times the rounding of those of the exact mechanism, or carry a code that is not `successful`.
"""

import functools
import inspect
import types
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within

import jaxdyn as jd
from benchmarks.overconstrained import MECHANISMS
from jaxdyn.reduction.bases import independent_velocities

DIGITS = [4, 5, 6, 8, 12, 16]
BARS = {"crank": (1.0, 1.0), "coupler": (3.0, 3.0), "rocker": (2.5, 2.5)}


class Pair(NamedTuple):
    """A mechanism with exact numbers and the same with rounded ones, each with a state on its constraints."""

    exact: tuple
    rounded: tuple
    rounding: float


def four_bar(digits):
    """URDF of a planar four-bar whose coupler stands on rpy="1.5708 0 0", closed by three rows of which one is redundant."""
    links = "".join(
        f"<link name='{name}'><inertial><origin xyz='{size / 2} 0 0'/><mass value='{mass}'/><inertia ixx='0' "
        f"iyy='{mass * size**2 / 12!r}' izz='{mass * size**2 / 12!r}' ixy='0' ixz='0' iyz='0'/></inertial></link>"
        for name, (size, mass) in BARS.items()
    )
    return (
        f"<robot name='bars'><link name='ground'/>{links}"
        "<joint name='j1' type='continuous'><parent link='ground'/><child link='crank'/><axis xyz='0 0 1'/></joint>"
        f"<joint name='j2' type='continuous'><origin xyz='1 0 0' rpy='{np.pi / 2:.{digits}g} 0 0'/><parent link='crank'/>"
        "<child link='coupler'/><axis xyz='0 1 0'/></joint>"
        "<joint name='j3' type='continuous'><origin xyz='3.5 0 0'/><parent link='ground'/><child link='rocker'/>"
        "<axis xyz='0 0 1'/></joint>"
        "<link name='tip_a'/><joint name='ta' type='fixed'><origin xyz='3 0 0'/><parent link='coupler'/>"
        "<child link='tip_a'/></joint><link name='tip_b'/><joint name='tb' type='fixed'><origin xyz='2.5 0 0'/>"
        "<parent link='rocker'/><child link='tip_b'/></joint></robot>"
    )


@functools.cache
def load_four_bar(digits, folder):
    path = folder / f"bars{digits}.urdf"
    path.write_text(four_bar(digits))
    path.with_suffix(".yaml").write_text("closed_loop: [[tip_a, tip_b]]\ntype: [3d]\n")
    return jd.load(path, gravity=(0.0, -9.81, 0.0))


def round_leaves(scene, digits):
    """The scene with all numbers of its system and constraints rounded to digits after the point."""

    def rounded(x):
        if not eqx.is_inexact_array(x):
            return x
        x = np.round(np.asarray(x), digits)
        if x.shape[-2:] == (4, 4):  # files give angles: their rotations are orthogonal
            U, _, Vt = np.linalg.svd(x[..., :3, :3])
            x[..., :3, :3] = U @ Vt
        return jnp.asarray(x)

    system, constraints = jax.tree.map(rounded, (scene.system, scene.constraints))
    return jd.Scene(system.replace(rounding=0.5 * 10.0**-digits), constraints)


def legs():
    """A trunk that turns, with four legs: each is an inclined four-bar whose knee is closed by five rows."""
    builder, loops = jd.ModelBuilder("legs"), []
    builder.add_body("trunk", None, "continuous", (5.0, (0.0, 0.0, 0.0), (0.3, 0.4, 0.5)), axis=(0, 0, 1))
    bars = []
    for leg, (x, y) in enumerate([(1.0, 0.3), (-1.0, 0.3), (1.0, -0.3), (-1.0, -0.3)]):
        tilt = 0.3 + 0.4 * leg
        for name, parent, place in (("crank", "trunk", (x, y, 0.0)), ("rocker", "trunk", (x + 3.5, y, 0.0))):
            bars.append((name, leg, parent, (place, (tilt, 0.0, 0.0))))
        bars.append(("coupler", leg, f"crank{leg}", (1.0, 0.0, 0.0)))
        loops.append(jd.loop(f"coupler{leg}", (3.0, 0.0, 0.0), f"rocker{leg}", (2.5, 0.0, 0.0), name=f"knee{leg}"))
    for name, leg, parent, pose in bars:
        size, mass = BARS[name]
        inertia = (mass, (size / 2, 0.0, 0.0), (0.01, mass * size**2 / 12, mass * size**2 / 12))
        builder.add_body(f"{name}{leg}", parent, "continuous", inertia, pose=pose, joint_name=f"{name}{leg}")
    scene = jd.Scene(builder.build(), loops)
    names = list(scene.system.joint_names)
    q, v = np.zeros(scene.nq), np.zeros(scene.nv)
    v[0] = 0.4
    for leg in range(4):
        angles, rates = jd.scenes.four_bar.start(angle=0.8 + 0.1 * leg, rate=1.0 - 0.2 * leg)
        for name, angle, rate in zip(("crank", "coupler", "rocker"), angles, rates, strict=True):
            place = names.index(f"{name}{leg}")
            q[place], v[place] = angle, rate
    return scene, jnp.asarray(q), jnp.asarray(v)


def assembled(scene, q, v):
    state = jd.assemble(scene, q, v)
    return scene, state.q, state.v


@functools.cache
def pair(name, digits, folder):
    if name == "four_bar":
        exact, rounded = load_four_bar(16, folder), load_four_bar(digits, folder)
        q, v = jd.scenes.four_bar.start()
        order = [exact.system.joint_names.index(joint) for joint in ("j1", "j2", "j3")]
        q, v = (jnp.zeros(3).at[jnp.array(order)].set(x) for x in (q, v))
        # Digits of 1.57...: the first one stands before the point.
        return Pair(assembled(exact, q, v), assembled(rounded, q, v), 0.5 * 10.0 ** (1 - digits))
    if name == "legs":
        exact, q, v = legs()
    else:
        one = MECHANISMS[name][1]()
        exact, (q, v) = one.scene, one.start(np.asarray(one.x), np.asarray(one.rate))
    return Pair((exact, q, v), assembled(round_leaves(exact, digits), q, v), 0.5 * 10.0**-digits)


def freedom(scene, q):
    return len(INDEPENDENT[scene.system.name, scene.nv])


def frame(scene):
    return scene.system.body_names[-1]


def outcome(result, *names):
    """Whether a result is `successful`, and the entries to compare."""
    return result.success, [getattr(result, name) for name in names]


def drive(scene, q, v):
    chosen = INDEPENDENT[scene.system.name, scene.nv]
    return jd.constrained_inverse_dynamics(
        scene, q, v, jnp.linspace(0.3, 0.5, len(chosen)), motors=chosen, independent=chosen, throw=False
    )


def hybrid(scene, q, v):
    index = INDEPENDENT[scene.system.name, scene.nv][0]
    return jd.control.HybridForce(scene, lambda q: q[index : index + 1], lambda t: jnp.full(1, 0.1), kp=4.0, kd=2.0)


def gauge_law(scene, q, v):
    chosen = np.array(INDEPENDENT[scene.system.name, scene.nv])
    return jd.control.GaugeInvariant(scene, lambda q: q[chosen], lambda t: jnp.full(chosen.size, 0.1), kp=4.0, kd=2.0)


def moved(scene, q, v):
    motion = jd.simulate(scene, q, v, jnp.array([0.0, 0.05]), stepsize=within(1e-10), throw=False)
    return motion.success, [motion.q[-1], motion.v[-1]]


def stepped(scene, q, v):
    return jd.stepper(scene, 0.01)((q, v), jnp.zeros(scene.nv))


def reached(scene, q, v):
    """The pose of a frame at a state on the constraints is reached from a guess nearby."""
    target = jd.frame_pose(scene.system, q, frame(scene))[:3, 3]
    # One row: the mechanisms of one degree of freedom reach no more.
    found = jd.inverse_kinematics(
        scene, {frame(scene): target}, q + 0.01, weights={frame(scene): jnp.array([1.0, 0.0, 0.0])}, throw=False
    )
    return found.success, [found.errors[0], jnp.max(jnp.abs(found.q - q)) > 1]


def followed(scene, q, v):
    target = jd.frame_pose(scene.system, q, frame(scene))[:3, 3]
    weights = {frame(scene): jnp.array([1.0, 0.0, 0.0])}
    path = jd.follow(scene, {frame(scene): jnp.stack([target, target])}, q, weights=weights, throw=False)
    return path.success.all(), [path.q[-1] - q]


def logged(scene, q, v):
    chosen = INDEPENDENT[scene.system.name, scene.nv]
    names = [scene.system.joint_names[i] for i in chosen]
    ts = np.array([0.0, 0.1])
    measured = {n: (np.full(2, float(q[i])), np.full(2, float(v[i]))) for n, i in zip(names, chosen, strict=True)}
    log = jd.identify.complete_log(scene, ts, measured, np.zeros((2, scene.nv)), q)
    return log.q, log.v


def dynamics(scene, q, v, **options):
    return outcome(jd.constrained_dynamics(scene, q, v, **options), "acceleration", "multipliers", "rank")


def sensed(scene, q, v):
    return list(jd.sensors.measure(scene, [jd.sensors.Accelerometer(frame(scene))], q, v).values())


# By the function's public name: (scene, q, v) -> (successful, arrays), or the arrays of a function without a code.
CALLS = {
    "assemble": lambda s, q, v: outcome(jd.assemble(s, q + 1e-3, v, throw=False), "q", "v"),
    "constrained_dynamics": dynamics,
    "constrained_dynamics, schur": functools.partial(dynamics, method="schur"),
    "constrained_inverse_dynamics": lambda s, q, v: outcome(drive(s, q, v), "torques", "acceleration", "multipliers"),
    "constraint_forces": lambda s, q, v: list(
        jd.constraint_forces(s, q, jd.constrained_dynamics(s, q, v).multipliers).values()
    ),
    "constraints.constraint_jacobian": lambda s, q, v: [jd.constraint_jacobian(s, q)],
    "constraints.body_wrenches": lambda s, q, v: [
        jd.constraints.body_wrenches(s, q, jd.constrained_dynamics(s, q, v).multipliers)
    ],
    "constraints.constraint_wrenches": lambda s, q, v: list(
        jd.constraints.constraint_wrenches(s, q, jd.constrained_dynamics(s, q, v).multipliers).values()
    ),
    "constraints.projections": lambda s, q, v: list(jd.constraints.projections(s, q)),
    "constraints.second_fundamental_form": lambda s, q, v: [jd.constraints.second_fundamental_form(s, q, v)],
    "control.GaugeInvariant": lambda s, q, v: [gauge_law(s, q, v)(q, v, 0.0)],
    "control.HybridForce": lambda s, q, v: [hybrid(s, q, v)(q, v, 0.0), hybrid(s, q, v).regularity(q, v)],
    "degrees_of_freedom": lambda s, q, v: [jd.degrees_of_freedom(s, q)],
    "constraints.choose_rows": lambda s, q, v: [
        jd.constrained_dynamics(jd.constraints.choose_rows(s, q), q, v).acceleration
    ],
    "follow": followed,
    "identify.complete_log": logged,
    "inverse_kinematics": reached,
    "reduced_dynamics": lambda s, q, v: outcome(
        jd.reduced_dynamics(
            s, q, v[np.array(INDEPENDENT[s.system.name, s.nv])], basis=INDEPENDENT[s.system.name, s.nv]
        ),
        "acceleration",
        "velocity",
    ),
    "reduction.gauge_invariant": lambda s, q, v: outcome(
        jd.reduction.gauge_invariant(s, q, v, dof=freedom(s, q)), "acceleration", "multipliers"
    ),
    "reduction.involutive": lambda s, q, v: [np.array(jd.reduction.involutive(s, q).ranks)],
    "reduction.tangent_basis": lambda s, q, v: (
        lambda N: [N @ N.T]  # the choice of the basis is arbitrary
    )(jd.reduction.tangent_basis(s, q, dof=freedom(s, q))),
    "sensors.measure": sensed,
    "simulate": moved,
    "stepper": stepped,
    "stiffness": lambda s, q, v: list(jd.stiffness(s, q, v)),
}
# Functions that search, branch on numbers, or build programs: concrete arguments alone.
CONCRETE = {"simulate", "stepper", "follow", "identify.complete_log", "reduction.involutive", "stiffness"}
# Compiled for long operation by operation.
TRACED = {"constraints.body_wrenches", "constraints.constraint_wrenches"}
# Public functions that decide nothing on rows, and why.
OTHERS = {
    "of all rows, whatever their rank": ("constraints.position_residual", "constraints.velocity_residual"),
    "pictures of states": ("animate", "draw", "view", "pictures."),
    "contact cones act on given multipliers": ("contact.contact_forces",),
    "laws without constraints": ("control.ComputedTorque", "control.OperationalSpace"),
    "of hands, whose rows are contacts": ("grasp.", "control.GraspForce"),
    "calibration of logs": ("identify.Measured",),
    "result of a calibration": ("identify.GeometryFit",),
    "runs `simulate`, `sensors.measure`": ("scale.run", "sensors.record"),
    "forces of a scene, not of its rows": ("forces.external_wrenches",),
    "data": ("scenes.NamedScene", "sensors.Motion"),
    "dense algebra of `reduced_dynamics`, for v = dq/dt and symmetric Lagrangians": ("reduction.spurious_terms",),
    "runs `gauge_invariant`": ("reduction.kane_equation",),
}
INDEPENDENT = {}


def public_functions():
    """Public names of functions and classes whose signature has a scene."""
    found, seen = [], [jd]

    def walk(module, prefix):
        for name in dir(module):
            item = getattr(module, name, None)
            if isinstance(item, types.ModuleType):
                if item.__name__.startswith("jaxdyn") and item not in seen and "__dir__" in vars(item):
                    seen.append(item)
                    walk(item, f"{prefix}{name}.")
            elif callable(item) and getattr(item, "__module__", "").startswith("jaxdyn"):
                try:
                    parameters = inspect.signature(item).parameters.values()
                except (TypeError, ValueError):
                    continue
                if any(p.name in ("scene", "grasp") or "Scene" in str(p.annotation) for p in parameters):
                    found.append(prefix + name)

    walk(jd, "")
    return found


def test_every_public_function_of_a_scene_is_listed():
    """A new function that takes a scene has to be called below, or to say why it decides nothing on rows."""
    others = tuple(prefix for prefixes in OTHERS.values() for prefix in prefixes)
    called = {name.partition(",")[0] for name in CALLS}
    called |= {name.rpartition(".")[2] for name in called}  # some have a second name at the top of the package
    missing = [name for name in public_functions() if name not in called and not name.startswith(others)]
    assert not missing


def as_arrays(value):
    """Successful or not, and arrays, of what a call in `CALLS` returns."""
    has_code = isinstance(value, tuple) and isinstance(value[1], list)
    success, arrays = value if has_code else (True, value)
    return bool(np.all(success)), [np.asarray(x, float) for x in arrays]


CASES = [*(("four_bar", digits) for digits in DIGITS), ("bennett", 5), ("bricard", 5), ("three_legs", 5), ("legs", 5)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("rounded")


@pytest.mark.long
@pytest.mark.parametrize("digits", [4, *(pytest.param(x, marks=pytest.mark.slow) for x in (5, 8))])
def test_a_file_of_few_digits_has_the_rank_of_the_mechanism(digits, folder):
    """Accelerations of the planar four-bar with two exact rows; concrete, traced, and in a batch."""
    _, (scene, q, v), _ = pair("four_bar", digits, folder)
    exact = jd.constrained_dynamics(jd.scenes.four_bar(), *jd.scenes.four_bar.start())
    order = np.array([scene.system.joint_names.index(joint) for joint in ("j1", "j2", "j3")])
    solve = lambda q, v: jd.constrained_dynamics(scene, q, v)  # noqa: E731
    batch = jax.jit(jax.vmap(solve))(jnp.stack([q, q]), jnp.stack([v, 0 * v]))
    for motion in (solve(q, v), jax.jit(solve)(q, v), jax.tree.map(lambda x: x[0], batch)):
        assert int(motion.rank) == 2 and bool(motion.success)
        # The axis is off by the rounding e, and cosines of e by its square.
        assert np.abs(motion.acceleration[order] - exact.acceleration).max() < 1e-10 + 10 * 0.25 * 100.0 ** (1 - digits)
    assert jd.degrees_of_freedom(scene, q) == 1 == int(jax.jit(lambda q: jd.degrees_of_freedom(scene, q))(q))
    gradient = jax.jit(jax.jacrev(lambda q: solve(q, v).acceleration))(q)
    assert np.isfinite(gradient).all()
    code = jd.constrained_dynamics(scene, q, v, method="schur")
    assert int(code.rank) == 2 and code.result == jd.RESULTS.dependent_rows


@pytest.mark.long
def test_rounding_survives_another_scene_of_the_same_model(folder):
    """A force or a constraint that is added in Python leaves the digits of the file."""
    _, (scene, q, v), _ = pair("four_bar", 5, folder)
    other = jd.Scene(scene.system, scene.constraints, [jd.forces.CoulombFriction(jnp.full(3, 0.1))])
    assert scene.rounding == other.rounding == 5e-5
    assert int(jd.constrained_dynamics(other, q, v).rank) == 2


@pytest.mark.long
def test_rows_without_a_gap_have_a_code():
    """Numbers typed with five digits and not said to be rounded: the row that repeats others leaves no motion."""
    _, (scene, q, v), _ = pair("bennett", 5, None)
    typed = jd.Scene(scene.system.replace(rounding=0.0), scene.constraints)
    # As five rows, three of which count, they contradict each other.
    assert not bool(jd.constrained_dynamics(typed, q, v).success)
    assert int(jax.jit(lambda q: jd.degrees_of_freedom(typed, q))(q)) == -1
    with pytest.raises(ValueError, match="is not clear"):
        jd.degrees_of_freedom(typed, q)


@pytest.mark.long
@pytest.mark.parametrize("digits", [5, pytest.param(15, marks=pytest.mark.slow)])
def test_concrete_and_traced_assembly_drop_the_same_rows(digits):
    _, (scene, q, v), _ = pair("bennett", digits, None)
    traced = jax.jit(lambda q: jd.assemble(scene, q, v))
    for off in (0.0, 1e-3, -0.02):
        one, other = jd.assemble(scene, q + off, v), traced(q + off)
        assert (one.dropped == other.dropped).all() and np.abs(one.q - other.q).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(("name", "digits"), CASES)
def test_results_are_those_of_the_exact_mechanism_or_carry_a_code(name, digits, folder):
    exact, rounded, rounding = pair(name, digits, folder)
    INDEPENDENT[exact[0].system.name, exact[0].nv] = independent_velocities(exact[0], jnp.asarray(exact[1]))
    wrong = []
    for function, call in CALLS.items():
        for traced in (False, True):
            if function in (CONCRETE if traced else TRACED):
                continue
            run = (lambda s, q, v, c=call: eqx.filter_jit(lambda q, v: c(s, q, v))(q, v)) if traced else call
            try:
                success, values = as_arrays(run(*rounded))
            except ValueError as error:
                # Refused for the rank alone; a trace has a code instead.
                if traced or "rank" not in str(error):
                    wrong.append(f"{function}{' traced' * traced}: {error}")
                continue
            if not success:
                continue
            other = (
                call if function in CONCRETE else lambda s, q, v, c=call: eqx.filter_jit(functools.partial(c, s))(q, v)
            )
            wanted = as_arrays(other(*exact))[1]
            for got, want in zip(values, wanted, strict=True):
                # Rounding errors move results by the derivatives of the latter, which are of the order of their size.
                got, want = (np.nan_to_num(x, nan=np.nan, posinf=0.0) for x in (got, want))
                off = np.max(np.abs(got - want), initial=0.0) / max(1.0, np.max(np.abs(want), initial=0.0))
                if not off <= 10 * rounding + 1e-9:
                    wrong.append(f"{function}{' traced' * traced}: {off:.2g}, rounding {rounding:.1g}")
    assert not wrong, "\n".join(wrong)
