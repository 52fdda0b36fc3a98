"""Extreme trees: masses, sizes, numbers of links."""

import functools

import jax.numpy as jnp
import mpmath
import numpy as np

import jaxdyn as jd
from benchmarks.extremes import Outcome, Study, as_dtype, case, outcome, study, table
from jaxdyn.constraints.codes import code_of
from jaxdyn.dynamics import recursions
from jaxdyn.dynamics import scans as looped
from jaxdyn.dynamics import world_frame as matrix_form

FORMS = (matrix_form.forward_dynamics, recursions.aba, looped.forward_dynamics)


def chain_acceleration(masses, q, v, length=1.0, gravity=9.81):
    """Accelerations of a hanging chain of rods in 60 digits, by Lagrange's equations in absolute angles."""
    n = len(masses)
    with mpmath.workdps(60):
        m = [mpmath.mpf(float(x)) for x in masses]
        angle = [mpmath.fsum(mpmath.mpf(float(x)) for x in q[: i + 1]) for i in range(n)]
        rate = [mpmath.fsum(mpmath.mpf(float(x)) for x in v[: i + 1]) for i in range(n)]
        length, gravity = mpmath.mpf(length), mpmath.mpf(gravity)
        arm = lambda k, i: length if i < k else length / 2 if i == k else mpmath.mpf(0)  # noqa: E731
        M, right = mpmath.matrix(n, n), mpmath.matrix(n, 1)
        for i in range(n):
            for j in range(n):
                shared = mpmath.fsum(m[k] * arm(k, i) * arm(k, j) for k in range(max(i, j), n))
                M[i, j] = shared * mpmath.cos(angle[i] - angle[j])
                right[i] -= shared * mpmath.sin(angle[i] - angle[j]) * rate[j] ** 2
            M[i, i] += m[i] * length**2 / 12
            right[i] -= gravity * mpmath.sin(angle[i]) * mpmath.fsum(m[k] * arm(k, i) for k in range(i, n))
        a = mpmath.lu_solve(M, right)
        return np.array([float(a[i] - (a[i - 1] if i else 0)) for i in range(n)])


@functools.cache
def graded(ratio: float, links: int = 6):
    """Masses of a chain in geometric series from 1 kg to `ratio` kg."""
    return ratio ** (np.arange(links) / (links - 1))


RATIOS = np.array([1e-8, 1e-4, 1.0, 1e4, 1e8])
SERIES = np.concatenate([np.stack([graded(r) for r in RATIOS]), [[1.0] * 5 + [0.0]]])
_Q = np.array([0.3, -0.2, 0.4, 0.1, -0.3, 0.2])
_V = np.array([0.5, -0.3, 0.2, 0.6, -0.4, 0.1])
MASSES = (
    "A light link that carries a heavy one loses eps times the mass ratio: a ratio of 1e8 leaves eight digits in "
    "float64; in float32 1e4 leaves three and 1e8 none. `forward_dynamics` returns an acceleration and no code. "
    "`simulate` and `constrained_dynamics` (of any scene) have codes. Use float64, give light links the armature of "
    "their motors, and leave out bodies of no consequence. A joint that moves no inertia is refused when the model is"
    " built. If it arises later, it gives NaN and the code `dt_min_reached`."
)
LINKS_ADVICE = (
    "Nothing. Energies are relative to the total weight times 1 m. The gradient is that of a sum over all positions "
    "and velocities with respect to a common rate of the joints."
)
TWINS = (
    "`atol` is in the units of the state: an error of 1e-8 m is coarse for a slide of 1e-6 m and below rounding for "
    "one of 1e6 m. Scale `atol` with the mechanism, or choose units in which it has size one. Angles and fixed steps "
    "need nothing."
)


@case
def masses(dtypes, gradient):
    """Mass ratios along a chain of six rods, a geometric series from 1 kg: accelerations, plain and with a code"""
    exact = np.stack([chain_acceleration(graded(r), _Q, _V) for r in RATIOS])

    def run(mass, x):
        dtype = mass.dtype
        here = jd.robots.chain(6, dtype=dtype)
        here = here.replace(inertias=here.inertias * mass[:, None])
        q, v = jnp.asarray(_Q, dtype), jnp.asarray(_V, dtype)
        computed = jnp.stack([form(here, q, v, jnp.zeros_like(v)) for form in FORMS])
        coded = jd.constrained_dynamics(jd.Scene(here), q, v)
        return Outcome((computed, coded.acceleration), x, code_of(coded.result), x)

    outcomes = study(run, jnp.asarray(SERIES), dtypes, False).outcomes
    # What the ratio costs, but no more than leaves two digits.
    allowed = {d: np.minimum(1000 * np.finfo(d).eps * np.maximum(RATIOS, 1.0), 1e-2) for d in dtypes}
    labels = [f"tip {r:.0e} kg" for r in RATIOS]
    plain, coded = {}, {}
    for dtype, computed in outcomes.items():
        fine = jnp.full(len(labels), code_of(jd.RESULTS.successful))
        plain[dtype] = Outcome(computed.end[0][:-1], computed.residual[:-1], fine, computed.value[:-1])
        coded[dtype] = computed._replace(end=computed.end[1])
    none = dict.fromkeys(dtypes)
    options = {"residual": False, "advice": MASSES}
    rows = table(
        "masses", labels, Study(plain, none, None), exact[:, None], allowed, "60 digits", excused=np.inf, **options
    )
    labels = [f"{label}, constrained_dynamics" for label in (*labels, "tip 0 kg")]
    exact, allowed = np.vstack([exact, exact[:1]]), {d: np.append(x, x[-1]) for d, x in allowed.items()}
    return rows + table("masses", labels, Study(coded, none, None), exact, allowed, "60 digits", **options)


@case
def mass_motion(dtypes, gradient):
    """The same chains and one whose tip has no mass through `simulate`, over 0.2 s of their own time"""
    # A heavy tip stands still while the light links swing under its pull, faster by the root of the ratio: chaos in no time.
    spans = 0.2 / np.sqrt(np.maximum(SERIES[:, -1], 1.0))

    def run(point, x):
        mass, span = point
        dtype = mass.dtype
        here = jd.robots.chain(6, dtype=dtype)
        here = here.replace(inertias=here.inertias * mass[:, None])
        q, v = jnp.asarray(_Q, dtype).at[0].add(x), jnp.asarray(_V, dtype)
        ts = span * jnp.asarray([0.0, 0.5, 1.0], dtype)
        solution = jd.simulate(here, q, v, ts, outputs=("energy",), stepsize=jd.Steps(max_steps=1024))
        return outcome(solution, end=(solution.energy[1:] - solution.energy[0]) / (9.81 * jnp.sum(mass)))

    studied = study(run, (jnp.asarray(SERIES), jnp.asarray(spans)), dtypes, gradient)
    labels = [f"tip {r:.0e} kg" for r in RATIOS] + ["tip 0 kg"]
    allowed = {"float64": 1e-6, "float32": 1e-3}
    exact = np.zeros((len(labels), 2))
    return table("mass_motion", labels, studied, exact, allowed, "energy", size=1.0, residual=False, advice=MASSES)


LINKS = (1, 10, 100, 500)


def _tree(links: int, branching: int, dtype):
    if branching == 1:
        return jd.robots.chain(links, dtype=dtype)
    return jd.robots.random_tree(1, links, branching=2, skew=0.3, taper=1.0, kinds=("revolute",), dtype=dtype)


@case
def links(dtypes, gradient, counts=LINKS):
    """Chains and binary trees of 1 to 500 links through `simulate`, 20 steps of RK4"""
    rows = []
    for branching in (1, 2):
        for count in counts:

            def run(point, x, count=count, branching=branching):
                dtype = point.dtype
                model = _tree(count, branching, dtype)
                q = 0.3 * jnp.cos(jnp.arange(count, dtype=dtype))
                v = 0.1 * jnp.sin(jnp.arange(count, dtype=dtype)) * point + x
                ts = jnp.asarray([0.0, 0.02], dtype)
                solution = jd.simulate(model, q, v, ts, stepsize=jd.Steps(0.001, max_steps=32), outputs=("energy",))
                mass = jnp.sum(model.inertias[:, 0])
                return outcome(solution, end=(solution.energy[1:] - solution.energy[0]) / (9.81 * mass))

            studied = study(run, jnp.ones(1), dtypes, gradient)
            name = f"{'chain' if branching == 1 else 'tree'} of {count}"
            allowed = {"float64": 1e-8, "float32": 1e-5 * count}
            rows += table(
                "links",
                [name],
                studied,
                np.zeros((1, 1)),
                allowed,
                "energy",
                size=1.0,
                residual=False,
                advice=LINKS_ADVICE,
            )
    return rows


LENGTHS = (1e-6, 1e-3, 1.0, 1e3, 1e6)
_SLIDES = np.array([0.0, 1.0, 0.0])


@case
def twins(dtypes, gradient):
    """Lengths 1e-6 to 1e6 m: an arm with a slide, and its twins in other units of length and mass, through `simulate`"""
    builder = jd.ModelBuilder("arm", gravity=(0.0, -9.81, 0.0))
    rod = (1.0, (0.5, 0.0, 0.0), (0.01, 1 / 12, 1 / 12))
    builder.add_body("a", None, "revolute", rod, axis=(0, 0, 1))
    builder.add_body("b", "a", "prismatic", rod, axis=(1, 0, 0), pose=(1.0, 0.0, 0.0))
    builder.add_body("c", "b", "revolute", rod, axis=(0, 1, 0), pose=(1.0, 0.0, 0.0))
    base = builder.build()
    twins = [(length, mass) for mass in (1.0, 1e-8, 1e8) for length in LENGTHS]

    def run(point, x, stepsize):
        length, mass = point
        dtype = length.dtype
        model = as_dtype(base, dtype)
        unit = jnp.where(jnp.asarray(_SLIDES) > 0, length, jnp.ones_like(length))
        size = mass * jnp.concatenate([jnp.ones(1, dtype), jnp.full(3, length), jnp.full(6, length * length)])
        model = model.replace(
            inertias=model.inertias * size[None],
            screws=model.screws.at[:, :3].multiply((length / unit)[:, None]),
            home=model.home.at[:, :3, 3].multiply(length),
            gravity=model.gravity * length,
        )
        q, v = jnp.asarray([0.3, 0.2, -0.4], dtype), jnp.asarray([0.5, -0.3, 0.8], dtype).at[0].add(x)
        ts = jnp.asarray([0.0, 0.5], dtype)
        solution = jd.simulate(model, q * unit, v * unit, ts, stepsize=jd.Steps(stepsize, max_steps=512))
        end = jnp.concatenate([solution.q[-1] / unit, solution.v[-1] / unit])
        return outcome(solution, end=end, value=jnp.sum(end))

    points = tuple(jnp.asarray(x) for x in np.array(twins).T)
    labels = [f"{length:.0e} m, {mass:.0e} kg" for length, mass in twins]
    rows = []
    for stepsize, allowed in ((0.01, {"float64": 1e-11, "float32": 1e-4}), (None, {"float64": 1e-6, "float32": 1e-3})):
        studied = study(lambda p, x, s=stepsize: run(p, x, s), points, dtypes, gradient)
        same = np.asarray(studied.outcomes["float64"].end)[2]
        how = "adaptive" if stepsize is None else "fixed"
        rows += table(
            "twins",
            [f"{label}, {how}" for label in labels],
            studied,
            np.tile(same, (len(twins), 1)),
            allowed,
            "the twin of 1 m and 1 kg",
            residual=False,
            advice=TWINS,
        )
    return rows
