"""Equations and mechanisms of the benchmarks' peers are those of the scenes."""

import ast
import pkgutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick

import jaxdyn as jd
from benchmarks.peers import Peers
from benchmarks.peers.equations import EQUATIONS
from benchmarks.peers.twins import TWINS
from benchmarks.peers.with_mujoco import _timed
from benchmarks.peers.with_pinocchio import slope
from benchmarks.report_cases import cases, test_set

# Accelerations of Andrews' mechanism at its start, printed in the test set for IVP solvers; the others are zero.
ANDREWS = (14222.4439199541138705911625887, -10666.8329399655854029433719415, 0.0, 0.0, 0.0, 0.0, 0.0)


def accelerations(name, q, v, t=0.0):
    """v' and multipliers from equations by hand, dense, in numpy; derivatives by jax."""
    equations = EQUATIONS[name]()
    q, v = np.asarray(q), np.asarray(v)
    M, f = np.array(equations.mass(np, q), float), np.array(equations.force(np, t, q, v), float)

    def moving(q, v, t):
        if equations.velocity_rows:
            return jnp.stack(equations.velocity_rows(jnp, t, q, v))
        return jax.jvp(lambda q, t: jnp.stack(equations.rows(jnp, t, q)), (q, t), (v, jnp.ones(())))[1]

    @quick
    def compute(q, v, t):
        drift = jax.jvp(lambda q, t: moving(q, v, t), (q, t), (v, jnp.ones(())))[1]
        return jax.jacfwd(moving, 1)(q, v, t), drift

    J, drift = (np.asarray(x) for x in compute(q, v, t))
    rows = len(J)
    K = np.block([[M, -J.T], [J, np.zeros((rows, rows))]])
    computed = np.linalg.lstsq(K, np.concatenate([f, -drift]))[0]
    return computed[: len(v)], computed[len(v) :]


def test_andrews_by_hand_has_the_printed_accelerations():
    q, v = (np.asarray(x) for x in test_set.andrews.start())
    computed, multipliers = accelerations("andrews", q, v)
    np.testing.assert_allclose(computed, ANDREWS, rtol=1e-10, atol=1e-8)
    # They stand on the left as printed.
    np.testing.assert_allclose(-multipliers[:2], (98.5668703962410896, -6.12268834425566265), rtol=1e-11)


def test_car_axis_by_hand_has_the_printed_multipliers():
    case = cases()["car_axis"]
    end = case.reference(case.build()[1])
    _, multipliers = accelerations("car_axis", end.q[-1], end.v[-1], 3.0)
    np.testing.assert_allclose(multipliers, (-0.473688659084893324729e-2, -0.110468033125734368808e-2), rtol=1e-10)


@pytest.mark.long
@pytest.mark.parametrize("count", [2, 40])
def test_windows_by_hand_turn_as_a_pendulum(count):
    """th'' = g G sin th/I for the uprights, and the couplers stay level."""
    angle, turn, name = 0.7, -1.3, {2: "windows", 40: "windows_40"}[count]
    uprights = np.arange(2 * count + 1) % 2 == 0
    computed, _ = accelerations(name, np.where(uprights, angle, 0.0), np.where(uprights, turn, 0.0))
    inertia, weight = (count + 1) / 3 + count, 9.81 * ((count + 1) / 2 + count)
    np.testing.assert_allclose(computed, np.where(uprights, weight / inertia * np.sin(angle), 0.0), atol=1e-10)


def test_disk_by_hand_rolls_on_a_circle():
    """The centre at 1 m/s turns at 1 rad/s; friction is mass times that."""
    q, v = (np.asarray(x) for x in jd.scenes.rolling_disk.start(heading=0.4))
    computed, multipliers = accelerations("rolling_disk", q, v)
    want = np.array([-np.sin(0.4), np.cos(0.4)])
    np.testing.assert_allclose(computed, [*want, 0.0, 0.0], atol=1e-13)
    np.testing.assert_allclose(multipliers, 2.0 * want, atol=1e-13)


def test_four_bar_by_hand_is_that_of_pinocchio():
    equations, twin = EQUATIONS["four_bar"](), TWINS["four_bar"]()
    q, v = (np.asarray(x) for x in jd.scenes.four_bar.start())
    computed, _ = accelerations("four_bar", *equations.there(q, v))
    want = slope(twin)(0.0, np.concatenate(twin.there(q, v)))[3:]
    np.testing.assert_allclose(equations.back(np.zeros(3), computed)[1], want, rtol=1e-10)


@pytest.mark.parametrize("name", sorted(EQUATIONS))
def test_coordinates_go_there_and_back(name):
    case = cases()[name]
    known = case.build()[1] if case.reference is None else case.reference(case.build()[1])[1:3]
    for side in (EQUATIONS[name](), *([TWINS[name]()] if name in TWINS else [])):
        for got, want in zip(side.back(*side.there(*(np.asarray(x) for x in known))), known, strict=True):
            np.testing.assert_allclose(got, want, atol=1e-13)


def test_andrews_of_bodies_for_pinocchio_and_mujoco():
    """Pinocchio's accelerations are the printed ones; MuJoCo's soft loops come within a thousandth of the largest."""
    import mujoco

    twin = TWINS["andrews"]()
    q, v = twin.there(*(np.asarray(x) for x in test_set.andrews.start()))
    want = twin.there(q, np.array(ANDREWS))[1]
    np.testing.assert_allclose(slope(twin)(0.0, np.concatenate([q, v]))[7:], want, rtol=1e-9, atol=1e-4)
    model = _timed(twin, 1e-5, mujoco.mjtIntegrator.mjINT_RK4)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.efc_pos, 0.0, atol=1e-15)
    # Impedance is 0.9999 at most.
    np.testing.assert_allclose(data.qacc, want, atol=2e-3 * 14222)


def test_peers_that_are_missing_are_named():
    lines = []
    peers = Peers(lines.append, ("no_such_peer",))
    assert peers.modules == []
    assert "without the peer no_such_peer" in lines[0]


def test_benchmarks_use_names_that_exist():
    """Scripts that are run by hand must not wait for a run to find a renamed function of ours."""
    missing = []
    for path in sorted(Path("benchmarks").glob("*.py")):
        nodes, names, ours = list(ast.walk(ast.parse(path.read_text()))), [], {"jd": "jaxdyn"}
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(("benchmarks", "jaxdyn")):
                ours |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        names = [*ours.values()]
        for node in nodes:
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ours:
                names.append(f"{ours[node.value.id]}.{node.attr}")
        for name in names:
            try:
                pkgutil.resolve_name(name)
            except (ImportError, AttributeError) as error:
                if "mujoco" not in str(error):  # a peer that is not installed
                    missing.append(f"{path}: {error}")
    assert not missing, "\n".join(missing)
