"""The Whipple bicycle from its bodies against the published benchmark, by differentiating the full constrained model.

About upright running at the speed v the motion of (roll, steer) is, to first order,

    M q'' + v C1 q' + (g K0 + v^2 K2) q = f.

M is the mass matrix of the bodies on the admissible velocities: N^T M_full N, the columns of N being the velocities of
a unit roll rate and of a unit steer rate. The matrix of the linearised motion is J = [[0, 1], [-S, -D]] with
v C1 = M D and g K0 + v^2 K2 = M S; K0 is what is left at rest, K2 what one metre per second adds. The other speeds are
then tests of the whole: J at each of them must be made of the same matrices.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linearisation import admissible, motion_jacobian
from pinocchio_bridge import assert_close, quick
from scipy.linalg import expm
from scipy.optimize import brentq

import jaxdyn as jd
from jaxdyn import scenes

ROLL, REAR, STEER = 3, 6, 7  # places in v
GRAVITY, RADIUS = 9.81, 0.3

# Meijaard, Papadopoulos, Ruina & Schwab (2007).
PRINTED = {
    "M": [[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]],
    "C1": [[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]],
    "K0": [[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]],
    "K2": [[0.0, 76.59734589573222], [0.0, 2.65431523794604]],
}
# Castering, capsize, and the weave pair (real and imaginary part; at rest two real ones) at 1 to 10 m/s.
AT_REST = [-5.53094371765393, -3.13164324790656, 3.13164324790656, 5.53094371765393]
MODES = [
    (-7.11008014637442, -3.13423125066578, 3.52696170990070, 0.80774027519930),
    (-8.67387984831735, -3.07158645641514, 2.68234517512745, 1.68066296590675),
    (-10.35101467245920, -2.63366137253667, 1.70675605663975, 2.31582447384325),
    (-12.15861426576447, -1.42944427361326, 0.41325331521125, 3.07910818603206),
    (-14.07838969279822, -0.32286642900409, -0.77534188219585, 4.46486771378823),
    (-16.08537123098030, -0.00406690076970, -1.52644486584142, 5.87673060598709),
    (-18.15788466125262, 0.10268170574766, -2.13875644258362, 7.19525913329805),
    (-20.27940894394569, 0.14327879765713, -2.69348683581097, 8.46037971396931),
    (-22.43788559040858, 0.15790184030917, -3.21675402252485, 9.69377351531791),
    (-24.62459635017404, 0.16105338653172, -3.72016840437287, 10.90681139476287),
]


def leaning(scene, x, speed):
    """State at (roll, steer, roll rate, steer rate), on the constraints to first order: pitch and height are of
    second order."""
    roll, steer, roll_rate, steer_rate = jnp.unstack(x)
    o, half = jnp.zeros_like(roll), 0.5 * roll
    place = [o, -RADIUS * jnp.sin(roll), RADIUS * jnp.cos(roll)]
    q = jnp.stack([*place, jnp.cos(half), jnp.sin(half), o, o, o, steer, o])
    values = jnp.stack([roll_rate, steer_rate, speed / RADIUS])
    return q, admissible(scene, q, np.array([ROLL, STEER, REAR]), values)


def coordinates(q, v):
    """(roll, steer, roll rate, steer rate) near the upright position."""
    return jnp.stack([2.0 * q[4], q[8], v[ROLL], v[STEER]])


@pytest.fixture(scope="module")
def linear():
    """J at 0 to 10 m/s, the matrices, and the slopes of the position residuals along x; one program."""
    scene = scenes.bicycle()

    @quick
    def compute(speeds):
        jacobian = motion_jacobian(scene, lambda x, speed: leaning(scene, x, speed), coordinates)
        x = jnp.zeros(4)
        J = jax.vmap(jacobian, (None, 0))(x, speeds)
        q, _ = leaning(scene, x, jnp.zeros(()))
        basis = jax.vmap(lambda rates: leaning(scene, rates, jnp.zeros(()))[1])(jnp.eye(4)[2:])
        starts = [scenes.bicycle.start(speed=0.0, **rate) for rate in ({"roll_rate": 1.0}, {"steer_rate": 1.0})]
        return J, basis.T, jd.mass_matrix(scene.system, q), jnp.stack([v for _, v in starts], 1)

    J, N, full, starts = (np.asarray(x) for x in compute(jnp.arange(11.0)))
    M = N.T @ full @ N
    stiff, damp = -M @ J[:, 2:, :2], -M @ J[:, 2:, 2:]
    return {
        "J": J,
        "N": N,
        "starts": starts,
        "M": M,
        "C1": damp[1],
        "K0": stiff[0] / GRAVITY,
        "K2": stiff[1] - stiff[0],
        "stiff": stiff,
        "damp": damp,
    }


@pytest.mark.long
def test_matrices(linear):
    """M, C1, K0, K2 as printed, and the same ones at all speeds."""
    for name, want in PRINTED.items():
        np.testing.assert_allclose(linear[name], want, rtol=1e-9, atol=1e-9)
    for v in range(11):
        assert_close(linear["damp"][v], v * linear["C1"], 1e-10)
        assert_close(linear["stiff"][v], GRAVITY * linear["K0"] + v**2 * linear["K2"], 1e-10)
    top = np.concatenate([np.zeros((2, 2)), np.eye(2)], 1)
    np.testing.assert_allclose(linear["J"][:, :2], np.broadcast_to(top, (11, 2, 4)), atol=1e-12)


def test_eigenvalues(linear):
    """All four modes at rest and at ten speeds, from J itself."""
    computed = np.sort_complex(np.linalg.eigvals(linear["J"]))
    np.testing.assert_allclose(computed[0], AT_REST, atol=1e-9)
    for values, (castering, capsize, real, imaginary) in zip(computed[1:], MODES, strict=True):
        weave = real + 1j * imaginary
        np.testing.assert_allclose(
            values, [castering, *np.sort_complex([capsize, weave, weave.conjugate()])], atol=1e-9
        )


def test_critical_speeds(linear):
    """Where the weave mode becomes oscillatory, where it becomes stable, and where capsize becomes unstable."""
    M, C1, K0, K2 = (linear[name] for name in ("M", "C1", "K0", "K2"))

    def polynomial(v):
        """Coefficients of det(M s^2 + v C1 s + g K0 + v^2 K2), highest power first."""
        terms = np.stack([M, v * C1, GRAVITY * K0 + v * v * K2])
        return np.polysub(np.polymul(terms[:, 0, 0], terms[:, 1, 1]), np.polymul(terms[:, 0, 1], terms[:, 1, 0]))

    def discriminant(v):
        roots = np.roots(polynomial(v))
        return np.prod([(a - b) ** 2 for i, a in enumerate(roots) for b in roots[:i]]).real

    def hurwitz(v):
        a, b, c, d, e = polynomial(v)
        return b * c * d - a * d * d - b * b * e

    double = brentq(discriminant, 0.5, 0.9, xtol=1e-14)
    weave = brentq(hurwitz, 4.0, 5.0, xtol=1e-14)
    capsize = brentq(lambda v: polynomial(v)[-1], 5.5, 6.5, xtol=1e-14)
    np.testing.assert_allclose(
        [double, weave, capsize], [0.68428307889246, 4.29238253634111, 6.02426201538837], rtol=1e-9
    )
    _, b, _, d, _ = polynomial(weave)
    np.testing.assert_allclose(np.sqrt(d / b), 3.43503384866144, rtol=1e-9)  # s = i sqrt(d/b) on the axis
    top = np.roots(polynomial(double))
    np.testing.assert_allclose(np.sort(top.real)[-2:].mean(), 3.78290405129320, rtol=1e-9)


def test_starts_are_admissible(linear):
    """The closed form of the start's velocities is the solution of the rows."""
    np.testing.assert_allclose(linear["starts"], linear["N"], atol=1e-14)


@pytest.mark.slow
def test_nonlinear_motion_after_a_push(linear):
    """At 4.6 m/s, which is stable: the energy after a push of 0.5 rad/s, and the linear motion after a small one."""
    scene, ts = scenes.bicycle(), jnp.linspace(0.0, 2.0, 5)

    @quick
    def run(roll_rate):
        q, v = scenes.bicycle.start(speed=4.6, roll_rate=roll_rate)
        options = {"stepsize": 0.02, "solver": diffrax.Dopri8(), "outputs": ("energy", "constraint_residual")}
        return jd.simulate(scene, q, v, ts, **options)

    computed = run(jnp.asarray(0.5))
    assert bool(computed.success) and float(computed.constraint_residual.max()) <= 1e-12
    np.testing.assert_allclose(computed.energy, computed.energy[0], rtol=1e-11)
    assert np.abs(computed.q[:, 8]).max() > 0.05  # it steers
    push = 1e-5
    computed = run(jnp.asarray(push))
    M, damp = linear["M"], 4.6 * linear["C1"]
    stiff = GRAVITY * linear["K0"] + 4.6**2 * linear["K2"]
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, stiff), -np.linalg.solve(M, damp)]])
    want = np.stack([expm(t * J) @ [0.0, 0.0, push, 0.0] for t in ts])
    np.testing.assert_allclose(computed.v[:, [ROLL, STEER]], want[:, 2:], atol=1e-6 * push)  # what is left is cubic
    np.testing.assert_allclose(computed.q[:, 8], want[:, 1], atol=1e-6 * push)
