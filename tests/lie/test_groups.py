"""Matrix groups against 50-digit series, closed forms, jaxlie and group identities, at every awkward angle."""

import functools
import re
import types
from fractions import Fraction

import jax
import jax.numpy as jnp
import jaxlie
import mpmath as mp
import numpy as np
import pytest
from xla_options import QUICK

from jaxdyn import se2, se3, so3
from jaxdyn.compile.jax_adapter import select_options
from jaxdyn.lie import series as _series

GROUPS = {"so3": so3, "se3": se3, "se2": se2}
DIM = {"so3": 3, "se3": 6, "se2": 3}
PI = np.pi
# Both sides of every switch: theta^2 = 4 in the Stumpff functions (theta = 4 for the half angle of quaternions),
# tan(theta/2)^2 = 0.01 (float64) or 0.04 (float32) in the arc.
SWITCHES = [2.0, 4.0, 2 * np.arctan(0.1), 2 * np.arctan(0.2)]
SIDES = [side for x in SWITCHES for side in (x * (1 - 1e-9), x * (1 + 1e-9))]
ANGLES = [0.0, 1e-12, 1e-7, 1e-3, *SIDES, 1.0, 3.0, PI - 1e-7, PI]
LOG_ANGLES = [theta for theta in ANGLES if theta <= PI]
# One axis per case of matrix_to_quat, of both signs.
AXES = [(2, -3, 6), (6, 2, -3), (-2, 6, 3), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1)]

# These tests compile much and run little, so the compiler is told to hurry.
HURRY = QUICK | select_options({"xla_llvm_disable_expensive_passes": True})
jit = functools.partial(jax.jit, compiler_options=HURRY)


def largest(x):
    return np.abs(np.asarray(x)).max()


# --- the oracle: power series of matrices in exact 256-bit fixed point (object arrays of Python integers), which is
# ten times as fast as mpmath and is itself compared with mpmath's matrix exponential below ---

SHIFT = 256


def fixed(x):
    """Exact for float64 above 1e-60; takes mpmath numbers as well."""
    exact = [
        Fraction(y) if isinstance(y, float) else Fraction(*mp.libmp.to_rational(y._mpf_)) for y in np.ravel(x).tolist()
    ]
    return np.array([int(y * 2**SHIFT) for y in exact], dtype=object).reshape(np.shape(x))


def to_mp(x):
    return np.array([mp.ldexp(y, -SHIFT) for y in x.ravel()], dtype=object).reshape(x.shape)


def to_float(x):
    return np.array([float(Fraction(y, 2**SHIFT)) for y in x.ravel()]).reshape(x.shape)


def times(a, b):
    return (a @ b) >> SHIFT


def integers(x):
    return np.array(np.asarray(x, dtype=int).tolist(), dtype=object)


def basis(name):
    """hat of the unit vectors, from the definition."""
    n = 3 if name != "se2" else 2
    units = []
    for i in range(n if name != "so3" else 0):
        m = np.zeros((n + 1, n + 1), dtype=int)
        m[i, n] = 1
        units.append(m)
    for i, j in ((2, 1), (0, 2), (1, 0)) if name != "se2" else ((1, 0),):
        m = np.zeros((n, n) if name == "so3" else (n + 1, n + 1), dtype=int)
        m[i, j], m[j, i] = 1, -1
        units.append(m)
    return np.array(units)


HATS = {name: basis(name) for name in DIM}


def structure_constants(name):
    """ad of the unit vectors, from matrix commutators alone."""
    units = HATS[name]
    flat = units.reshape(len(units), -1)
    brackets = np.array([[x @ y - y @ x for y in units] for x in units]).reshape(len(units), len(units), -1)
    # the unit matrices are orthogonal, so coordinates are projections; [i, :, j] is the bracket of units i and j
    return np.swapaxes(brackets @ flat.T // (flat * flat).sum(axis=1), 1, 2)


ADS = {name: structure_constants(name) for name in DIM}


def oracle_hat(name, x):
    return np.tensordot(x, integers(HATS[name]), 1)


def oracle_ad(name, x):
    return np.tensordot(x, integers(ADS[name]), 1)


def power_series(m, first):
    """sum_k m^k / (k + first)!: the exponential (first = 0), or the left Jacobian of ad (first = 1)."""
    total = term = integers(np.eye(len(m))) << SHIFT
    k = 0
    while abs(term).max() > 1 or k < 8:
        k += 1
        term = times(term, m) // (k + first)
        total = total + term
    return total


def inverse(m):
    """Newton's iteration, which doubles the digits of a float64 inverse."""
    two = integers(2 * np.eye(len(m))) << SHIFT
    x = fixed(np.linalg.inv(to_float(m)))
    for _ in range(4):
        x = times(x, two - times(m, x))
    return x


def oracle_quat(phi):
    phi = to_mp(phi)
    theta = mp.sqrt(sum(phi * phi))
    half = mp.sin(theta / 2) / theta if theta else mp.mpf(1) / 2
    return fixed(np.array([mp.cos(theta / 2), *(half * phi)]))


def oracle_quat_log(q):
    q = to_mp(q)
    n = mp.sqrt(sum(q[1:] * q[1:]))
    return fixed(2 * mp.atan2(n, q[0]) / n * q[1:] if n else q[1:])


def oracle_quat_product(a, b):
    vector = a[0] * b[1:] + b[0] * a[1:] + oracle_hat("so3", a[1:]) @ b[1:]
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *vector], dtype=object) >> SHIFT


def oracle_log_of_product(name, x, d, other_branch):
    """Exponent of exp(x) exp(d), followed past the angle pi without a jump, or a full turn back from there."""
    if name == "se2":
        phi = x[2:] + d[2:]
    else:
        phi = oracle_quat_log(oracle_quat_product(oracle_quat(x[-3:]), oracle_quat(d[-3:])))
    if other_branch:
        exact = to_mp(phi)
        phi = fixed(exact - exact * 2 * mp.pi / mp.sqrt(sum(exact * exact)))
    if name == "so3":
        return phi
    turn = oracle_hat("so3", phi) if name == "se3" else phi[0] * integers([[0, -1], [1, 0]])
    t = times(power_series(oracle_hat(name, x), 0), power_series(oracle_hat(name, d), 0))
    return np.concatenate([times(inverse(power_series(turn, 1)), t[:-1, -1]), phi])


def oracle_derivatives(f, x, a, b):
    """f, Df[a], Df[b], D2f[a, b] by central differences with step 2^-60: 30 digits are right."""
    x, a, b = fixed(x), fixed(a) >> 60, fixed(b) >> 60
    fa, fb = (f(x + u) - f(x - u) << 59 for u in (a, b))
    corners = f(x + a + b) - f(x + a - b) - f(x - a + b) + f(x - a - b)
    return [to_float(y) for y in (f(x), fa, fb, corners << 118)]


def exp_and_jacobians(name, x):
    """The exponential, the left Jacobian and its inverse, stacked with zeros around the first."""
    jacobian = power_series(oracle_ad(name, x), 1)
    transform = power_series(oracle_hat(name, x), 0)
    stacked = np.zeros((3, *jacobian.shape), dtype=object)
    stacked[0, : len(transform), : len(transform)] = transform
    stacked[1:] = jacobian, inverse(jacobian)
    return stacked


# --- samples and derivatives of the library ---


def samples(name, angles, dtype):
    rng = np.random.default_rng(7)
    rows = []
    for i, theta in enumerate(angles):
        for axis in AXES if PI - 1e-3 < theta <= PI and name != "se2" else AXES[i % 3 : i % 3 + 1]:
            phi = theta * np.array(axis) / np.linalg.norm(axis)
            rho = rng.uniform(-1, 1, 3)
            rows.append(
                {"so3": phi, "se3": np.r_[rho, phi], "se2": np.r_[rho[:2], theta * np.sign(axis[0] + 0.5)]}[name]
            )
    return np.array(rows, dtype=dtype)


def directions(name):
    rng = np.random.default_rng(11)
    return rng.uniform(-1, 1, (2, DIM[name])).astype(np.float32).astype(np.float64)


def both_modes(f):
    """f, Df[a], Df[b], the second derivative along a and b, and the same with weights c by reverse mode.

    The second derivative is that of f(x + t a + u b + t u ab) in t and u, so that a path can stay on a group. In
    reverse: forward over reverse (jax.hessian) and reverse over forward.
    """

    def run(x, a, b, ab, c):
        def first(x):
            return jax.jvp(f, (x,), (a,))[1]

        y, fb = jax.jvp(f, (x,), (b,))
        fa, second = jax.jvp(first, (x,), (b,))
        gradient, bent = jax.jvp(jax.grad(lambda x: jnp.sum(c * f(x))), (x,), (b,))
        rest = 0.0
        if ab is not None:
            second += jax.jvp(f, (x,), (ab,))[1]
            rest = jnp.sum(gradient * ab)
        forward_over_reverse = jnp.sum(bent * a) + rest
        reverse_over_forward = jnp.sum(jax.grad(lambda x: jnp.sum(c * first(x)))(x) * b) + rest
        scalars = jnp.sum(gradient * a), jnp.sum(gradient * b), forward_over_reverse, reverse_over_forward
        return (y, fa, fb, second), jnp.stack(scalars)

    return run


def differentiate(f, xs, a, b, ab=None):
    """Runs `both_modes` on every sample; also returns the weights."""
    shape = jax.eval_shape(f, jax.ShapeDtypeStruct(xs.shape[1:], xs.dtype)).shape
    c = np.random.default_rng(5).uniform(-1, 1, shape).astype(xs.dtype)
    run = jit(jax.vmap(both_modes(f), (0, 0, 0, None if ab is None else 0, None)))
    paths = (None if z is None else np.broadcast_to(z, xs.shape).astype(xs.dtype) for z in (xs, a, b, ab))
    forward, reverse = run(*paths, c)
    assert all(y.dtype == xs.dtype for y in (*forward, reverse))
    return [np.asarray(y, np.float64) for y in forward], np.asarray(reverse, np.float64), c.astype(np.float64)


def check(derivatives, oracle, where):
    """Compares with oracle[i] = (f, Df[a], Df[b], D2f[a, b]) at sample i.

    Errors are relative to the largest entry, or to 1 where all entries are smaller: a second derivative that vanishes
    (log along a line through the identity) is still a sum of terms of size one.
    """
    forward, reverse, c = derivatives
    for i, (order, columns) in enumerate([(0, []), (1, [0]), (1, [1]), (2, [2, 3])]):
        bound = TOLERANCE[str(where.dtype)][order]
        for got, back, want, x in zip(forward[i], reverse, oracle, where, strict=True):
            want = want[i]
            error = abs(got - want).max() / max(abs(want).max(), 1.0)
            assert error < bound, f"forward mode, order {order}, at {x}: {error}"
            for column in columns:
                error = abs(back[column] - np.sum(c * want)) / max(np.sum(abs(c * want)), 1.0)
                assert error < bound, f"reverse mode, order {order}, at {x}: {error}"


# Bounds for value, first and second derivative. float64: measured errors stay below 5e-15, far inside the aim of
# 1e-10, and the bounds leave a factor for other compilers. float32 (eps = 1.2e-7): a value sums about ten terms of
# size one; each derivative brings a few times as many, with factors up to 4 (the largest angle, where the inverse
# Jacobian begins to grow) and, in the arc, 1/0.2 at the switch. np.float32(pi - 1e-7) is float32's pi itself, so
# float32 tests pi, not what lies between.
TOLERANCE = {"float64": (1e-14, 3e-14, 5e-14), "float32": (1e-6, 4e-6, 1e-5)}

# se3 contains every formula of so3 as a block: so3 itself is not compiled again in the fast tests, nor in float32 at all.
CASES = [
    pytest.param("so3", "float64", marks=pytest.mark.slow),
    ("se3", "float64"),
    ("se2", "float64"),
    *(pytest.param(x, "float32", marks=pytest.mark.slow) for x in ("se3", "se2")),
]


def third_derivatives(s):
    def third(k):
        return jax.grad(jax.grad(jax.grad(lambda x: _series.stumpff(x)[k])))(s)

    return jnp.stack([third(k) for k in range(4)])


@pytest.mark.parametrize(("dtype", "bound"), [("float64", 1e-12), ("float32", 3e-4)])
def test_stumpff_functions_and_their_third_derivatives(dtype, bound):
    """Against their series summed with 50 digits. A closed form loses about 1/c_k, so c7 (1/5040) sets the bound."""
    points = np.array([theta**2 for theta in ANGLES], dtype)
    values, thirds = jit(jax.vmap(lambda s: (jnp.stack(_series.stumpff(s, 7)), third_derivatives(s))))(points)
    assert values.dtype == thirds.dtype == dtype
    with mp.workdps(50):
        for x, c, c_third in zip(points.tolist(), values.tolist(), thirds.tolist(), strict=True):
            for k in range(8):
                want = mp.fsum((-mp.mpf(x)) ** j / mp.factorial(2 * j + k) for j in range(50))
                # relative to the value at zero: the first ones pass through zero
                assert abs(c[k] - want) < bound / mp.factorial(k), (k, x)
            for k in range(4):
                falling = ((j, (-1) ** j * j * (j - 1) * (j - 2)) for j in range(3, 50))
                want = mp.fsum(factor * mp.mpf(x) ** (j - 3) / mp.factorial(2 * j + k) for j, factor in falling)
                assert abs(c_third[k] - want) < 10 * bound * 6 / mp.factorial(6 + k), (k, x)


@pytest.mark.parametrize("name", GROUPS)
def test_oracle_is_the_matrix_exponential(name):
    with mp.workdps(60):
        for x in samples(name, ANGLES[::4], "float64"):
            m = to_mp(oracle_hat(name, fixed(x)))
            want = np.array(mp.expm(mp.matrix(m.tolist())).tolist(), dtype=object).reshape(m.shape)
            assert abs(to_mp(power_series(fixed(m), 0)) - want).max() < 1e-50


@pytest.mark.long
@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_exp_and_jacobians_to_second_order(name, dtype):
    xs, (a, b) = samples(name, ANGLES, dtype), directions(name)
    want = [oracle_derivatives(functools.partial(exp_and_jacobians, name), x, a, b) for x in xs]
    for i, f in enumerate(("exp", "left_jacobian", "left_jacobian_inverse")):
        n = len(oracle_hat(name, fixed(a))) if f == "exp" else len(a)
        check(differentiate(getattr(GROUPS[name], f), xs, a, b), [[y[i, :n, :n] for y in row] for row in want], xs)


@pytest.mark.long
@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_log_to_second_order(name, dtype):
    """log along exp(x) exp(t a + u b), given as the matrix and its derivatives, so that it stays on the group."""
    group, xs = GROUPS[name], samples(name, LOG_ANGLES, dtype)
    rotational = slice(2, 3) if name == "se2" else slice(-3, None)
    a, b = directions(name)
    ha, hb = oracle_hat(name, fixed(a)), oracle_hat(name, fixed(b))
    starts = [power_series(oracle_hat(name, fixed(x)), 0) for x in xs]
    one = integers(np.eye(len(ha))) << SHIFT
    steps = (one, ha, hb, (times(ha, hb) + times(hb, ha)) // 2)
    path = [np.array([to_float(times(m, step)) for m in starts]).astype(dtype) for step in steps]
    derivatives = differentiate(group.log, *path)
    want = []
    with mp.workdps(80):
        for x, got in zip(xs, derivatives[0][0], strict=True):
            # Next to pi rounding chooses the branch; elsewhere there is one.
            other = got[rotational] @ x[rotational] < 0
            assert not other or np.linalg.norm(x[rotational]) > PI - 4 * np.finfo(dtype).eps
            f = functools.partial(oracle_log_of_product, name, fixed(x), other_branch=other)
            want.append(oracle_derivatives(f, 0.0 * x, a, b))
    check(derivatives, want, path[0])


@pytest.mark.long
@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_quaternions_to_second_order(dtype):
    a, b = directions("so3")
    # The logarithm does not see the length of q, so every direction of R^4 is tested, from a length that is not 1,
    # and with the sign that the library must turn.
    c, d = np.random.default_rng(3).uniform(-1, 1, (2, 4)).astype(np.float32)
    with mp.workdps(80):
        xs = samples("so3", ANGLES, dtype)
        want = [oracle_derivatives(oracle_quat, x, a, b) for x in xs]
        qs = [to_float(oracle_quat(fixed(x))) for x in samples("so3", LOG_ANGLES, dtype)]
        qs = np.array([[1.25, -0.75][i % 2] * q for i, q in enumerate(qs)]).astype(dtype)
        sign = np.where(qs[:, :1] < 0, -1.0, 1.0)
        # log(q) = log(-q): turned, for the oracle is followed without a jump where w = 0
        want_log = [oracle_derivatives(oracle_quat_log, s * q, s * c, s * d) for s, q in zip(sign, qs, strict=True)]
    check(differentiate(so3.quat_exp, xs, a, b), want, xs)
    check(differentiate(so3.quat_log, qs, c, d), want_log, qs)


def test_quaternions_and_matrices_agree():
    xs = jnp.asarray(samples("so3", ANGLES, "float64"))
    y = jnp.asarray([0.3, -2.0, 0.7])

    @jit
    @jax.vmap
    def errors(x):
        q, p, r = so3.quat_exp(x), so3.quat_exp(y), so3.exp(x)
        drifted = 1.001 * q
        back = so3.matrix_to_quat(r)
        return (
            so3.quat_to_matrix(drifted) - r,
            so3.quat_to_matrix(so3.quat_multiply(q, p)) - r @ so3.exp(y),
            so3.quat_rotate(drifted, y) - r @ y,
            so3.quat_multiply(q, so3.quat_conjugate(q)) - jnp.eye(4)[0],
            so3.quat_normalize(drifted) - q,
            back * jnp.sign(jnp.sum(back * q)) - q,
            jax.jvp(so3.quat_to_matrix, (q,), (q,))[1],  # scaling q changes nothing
            jnp.minimum(back[0], 0.0),
        )

    for error in errors(xs):
        assert largest(error) < 4e-15


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_half_turns_and_the_branch_of_log(dtype):
    """Every row of q q^T is chosen somewhere; derivatives at half turns are tested with log above."""
    axes = np.concatenate([np.eye(3), [[3, 4, 0], [0, -3, 4], [-4, 0, 3], [1, 1, 1], [-1, -1, -1]]])
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    phi = np.concatenate([theta * axes for theta in (PI, PI - 1e-7, 3.0, 1.5, 0.0)]).astype(dtype)

    @jit
    @jax.vmap
    def full(x):
        rotation = so3.exp(x)
        back = so3.log(rotation)
        return so3.exp(back) - rotation, back

    error, back = full(phi)
    eps = np.finfo(dtype).eps
    assert error.dtype == dtype and largest(error) < 16 * eps
    assert np.all(np.linalg.norm(back, axis=1) < PI + 4 * eps)
    # At w = 0 exactly, the largest component of the axis is positive: the branch the docstring names.
    n = np.array([-0.6, -0.8, 0.0])
    half_turns = np.stack([np.diag([1.0, -1.0, -1.0]), 2 * np.outer(n, n) - np.eye(3)]).astype(dtype)
    exact, got = np.asarray(jit(jax.vmap(so3.log))(half_turns))
    assert np.array_equal(exact, np.array([PI, 0, 0], dtype))
    assert np.allclose(got, -PI * n, atol=8 * eps)


def random_elements(name, count):
    rng = np.random.default_rng(1)
    return rng.uniform(-1.2, 1.2, (count, DIM[name]))


@pytest.mark.long
@pytest.mark.parametrize("name", GROUPS)
def test_group_identities(name):
    g = GROUPS[name]
    xs, ys, zs = (random_elements(name, 90)[i::3] for i in range(3))

    @jit
    @jax.vmap
    def errors(x, y, z):
        s, t = g.exp(x), g.exp(y)
        hx, hz = g.hat(x), g.hat(z)
        adx, ady, adz = g.ad(x), g.ad(y), g.ad(z)
        moved = g.Ad(s) @ z
        j = g.left_jacobian(x)
        rate = jax.jvp(g.exp, (x,), (z,))[1]
        one = jnp.eye(len(x))
        return {
            "vee inverts hat": g.vee(hx) - x,
            "inverse": g.inverse(s) @ s - jnp.eye(len(s)),
            "exp(-x) inverts exp(x)": g.exp(-x) - g.inverse(s),
            "log inverts exp": g.log(s) - x,
            "exp inverts log": g.exp(g.log(s @ t)) - s @ t,
            "log of the inverse": g.log(g.inverse(s @ t)) + g.log(s @ t),
            "Ad is a homomorphism": g.Ad(s @ t) - g.Ad(s) @ g.Ad(t),
            "Ad of the inverse": g.Ad(g.inverse(s)) @ g.Ad(s) - one,
            "Ad is conjugation": g.hat(moved) - s @ hz @ g.inverse(s),
            "exp commutes with conjugation": g.exp(moved) - s @ g.exp(z) @ g.inverse(s),
            "Ad respects the bracket": g.Ad(s) @ adz - g.ad(moved) @ g.Ad(s),
            "ad is the commutator": g.hat(adx @ z) - (hx @ hz - hz @ hx),
            "ad is the derivative of Ad": jax.jvp(lambda h: g.Ad(g.exp(h * z)), (0.0,), (1.0,))[1] - adz,
            "Jacobi": adx @ ady @ z + ady @ adz @ x + adz @ adx @ y,
            "ad_x x = 0": adx @ x,
            "left Jacobian is the derivative of exp": rate @ g.inverse(s) - g.hat(j @ z),
            "right Jacobian": g.inverse(s) @ rate - g.hat(g.left_jacobian(-x) @ z),
            "Ad exp = 1 + ad J": g.Ad(s) - one - adx @ j,
            "inverse Jacobian": g.left_jacobian_inverse(x) @ j - one,
        }

    for identity, error in errors(xs, ys, zs).items():
        # products of up to four matrices with entries up to 5: about a hundred roundings
        assert largest(error) < 2e-13, identity


@pytest.mark.parametrize("name", ["se3", "se2"])
def test_adjoints_without_matrices(name):
    g = GROUPS[name]
    xs, vs, ws = (random_elements(name, 30)[i::3] for i in range(3))

    @jit
    @jax.vmap
    def errors(x, v, w):
        t = g.exp(x)
        n = len(t) - 1
        ad_t, ad_inverse = g.Ad(t), g.Ad(g.inverse(t))
        point = v[:n]
        return {
            "Ad_apply": g.Ad_apply(t, v) - ad_t @ v,
            "Ad_inv_apply": g.Ad_inv_apply(t, v) - ad_inverse @ v,
            "AdT_apply": g.AdT_apply(t, w) - ad_t.T @ w,
            "Ad_inv_T_apply": g.Ad_inv_T_apply(t, w) - ad_inverse.T @ w,
            "ad_apply": g.ad_apply(x, v) - g.ad(x) @ v,
            "adT_apply": g.adT_apply(x, w) - g.ad(x).T @ w,
            "power": jnp.sum(g.Ad_apply(t, v) * g.Ad_inv_T_apply(t, w)) - jnp.sum(v * w),
            "apply": g.apply(t, point) - (t @ jnp.append(point, 1.0))[:n],
            "from_parts": g.from_parts(t[:n, :n], t[:n, n]) - t,
        }

    for identity, error in errors(xs, vs, ws).items():
        assert largest(error) < 1e-14, identity
    if name == "se3":
        twist, transform = jnp.ones(6), jnp.eye(4)
        for f in (g.Ad_apply, g.Ad_inv_apply, g.AdT_apply, g.Ad_inv_T_apply):
            assert "[6,6]" not in str(jax.make_jaxpr(f)(transform, twist))
        for f in (g.ad_apply, g.adT_apply):
            assert "[6,6]" not in str(jax.make_jaxpr(f)(twist, twist))


def test_plane_is_a_part_of_space():
    planar = random_elements("se2", 20)
    spatial = np.zeros((20, 6))
    spatial[:, [0, 1, 5]] = planar

    def calls(g, x):
        return g.exp(x), g.left_jacobian(x), g.left_jacobian_inverse(x), g.ad(x), g.Ad(g.exp(x))

    flat = jit(jax.vmap(functools.partial(calls, se2)))(planar)
    deep = jit(jax.vmap(functools.partial(calls, se3)))(spatial)
    for i, (small, large) in enumerate(zip(flat, deep, strict=True)):
        keep = [0, 1, 5] if i else [0, 1, 3]
        assert largest(np.asarray(small) - np.asarray(large)[:, keep][:, :, keep]) < 4e-15


@pytest.mark.parametrize("name", GROUPS)
def test_against_jaxlie(name):
    """Values at ordinary angles only: near zero jaxlie's own series are too short."""
    g, other = GROUPS[name], getattr(jaxlie, name.upper())
    xs = random_elements(name, 16)

    def theirs(x):
        t = other.exp(x)
        return t.as_matrix(), t.log(), t.adjoint()

    def ours(x):
        t = g.exp(x)
        return t, g.log(t), g.Ad(t)

    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        expected = jit(jax.vmap(theirs))(xs)
    for got, want in zip(jit(jax.vmap(ours))(xs), expected, strict=True):
        assert largest(np.asarray(got) - want) < 1e-13


def public_calls(name, x, y):
    """Every public function of a group at one sample."""
    g = GROUPS[name]
    t = g.exp(x)
    out = {f: getattr(g, f)(x) for f in ("hat", "exp", "ad", "left_jacobian", "left_jacobian_inverse")}
    out |= {"vee": g.vee(g.hat(x)), "log": g.log(t), "Ad": g.Ad(t), "inverse": g.inverse(t)}
    if name == "so3":
        q, p = so3.quat_exp(x), so3.quat_exp(y)
        out |= {"quat_exp": q, "quat_log": so3.quat_log(q), "quat_multiply": so3.quat_multiply(q, p)}
        out |= {f: getattr(so3, f)(x) for f in ("euler_to_matrix", "euler_body_jacobian", "euler_spatial_jacobian")}
        out |= {f: getattr(so3, f)(q) for f in ("quat_conjugate", "quat_to_matrix", "quat_normalize")}
        out |= {"matrix_to_quat": so3.matrix_to_quat(t), "quat_rotate": so3.quat_rotate(q, y), "cross": so3.cross(x, y)}
    else:
        n = len(t) - 1
        out |= {f: getattr(g, f)(t, y) for f in ("Ad_apply", "Ad_inv_apply", "AdT_apply", "Ad_inv_T_apply")}
        out |= {"ad_apply": g.ad_apply(x, y), "adT_apply": g.adT_apply(x, y), "apply": g.apply(t, y[:n])}
        out |= {"from_parts": g.from_parts(t[:n, :n], t[:n, n])}
    return out


@pytest.mark.long
@pytest.mark.parametrize("name", GROUPS)
def test_every_function_batches_and_keeps_its_dtype(name):
    xs, ys = random_elements(name, 6)[::2], random_elements(name, 6)[1::2]
    f = functools.partial(public_calls, name)
    public = {
        key
        for key, value in vars(GROUPS[name]).items()
        if isinstance(value, types.FunctionType) and key in GROUPS[name].__all__
    }
    batched = jit(jax.vmap(f))(xs, ys)
    assert set(batched) == public
    single = jit(f)
    for i in range(3):
        for key, value in single(xs[i], ys[i]).items():
            # two compilations may contract products differently
            assert largest(np.asarray(value) - np.asarray(batched[key])[i]) < 8e-15, key
    program = jax.make_jaxpr(f)(xs[0].astype(jnp.float32), ys[0].astype(jnp.float32))
    assert all(out.dtype == jnp.float32 for out in program.out_avals)
    assert not re.search(r"f64\[\d", str(program))
    assert not any(word in str(program) for word in ("triangular_solve", "svd", "eigh", "cholesky", "callback"))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_large_angles(dtype):
    """Many turns: right to the rounding of the angle, and the series that is not selected must not overflow."""
    x = jnp.asarray([30.0, -60.0, 20.0], dtype=dtype)
    got = jit(so3.exp)(x)
    want = to_float(power_series(oracle_hat("so3", fixed(np.asarray(x))), 0))
    assert abs(np.asarray(got, np.float64) - want).max() < 70 * 4 * jnp.finfo(dtype).eps
    huge = jnp.asarray([3.0, 1.0, -2.0], dtype=dtype) * 1e15
    every = jit(jax.jacrev(lambda x: (so3.exp(x), so3.left_jacobian(x), so3.quat_exp(x))))
    assert all(jnp.all(jnp.isfinite(y)) for y in every(huge))


@pytest.mark.parametrize("name", GROUPS)
def test_lists_are_arrays(name, monkeypatch):
    x, y = map(jnp.asarray, random_elements(name, 2))
    wanted = public_calls(name, x, y)

    def by_lists(function):
        return lambda *args: function(*(arg if isinstance(arg, str) else np.asarray(arg).tolist() for arg in args))

    module = GROUPS[name]
    monkeypatch.setitem(
        GROUPS, name, types.SimpleNamespace(**{each: by_lists(getattr(module, each)) for each in module.__all__})
    )
    for key, value in public_calls(name, x.tolist(), y.tolist()).items():
        np.testing.assert_array_equal(value, wanted[key], err_msg=key)
    assert np.asarray(so3.hat(phi=[1, 2, 3])).dtype == float


@pytest.mark.parametrize("name", GROUPS)
def test_outside_of_traces_a_function_is_one_program(name):
    """And under `jax.vmap` alone; each operation by itself would be compiled and called."""
    group, events = GROUPS[name], []
    x = jnp.asarray(random_elements(name, 1)[0])
    calls = [(group.exp, x), (jax.vmap(group.exp), jnp.stack([x, x]))]

    def note(event, seconds, **_):
        events.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        for call, argument in calls:
            events.clear()
            call(argument)
            assert sum(event.endswith("backend_compile_duration") for event in events) <= 1
    finally:
        jax.monitoring.unregister_event_duration_listener(note)
