"""Extreme constraints: singular positions, rows that nearly depend on each other, bases and grasps that degenerate, open starts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks.extremes import Outcome, as_dtype, case, name_of, outcome, study, table
from jaxdyn import constrained
from jaxdyn.report import references

LOOSE = {"float64": 1e-6, "float32": 2e-3}
METHODS = ("projected", "multipliers", "baumgarte", "reduced")


@case
def flat(dtypes, gradient, methods=METHODS, stepsizes=(None, 0.005)):
    """Loops through a singular position: one and two parallelogram windows that fall through the horizontal, by each method"""
    rows, ts = [], np.array([0.0, 0.5, 1.0])
    for count in (1, 2):
        base = jd.scenes.windows(count=count)
        q0, v0 = jd.scenes.windows.start(count=count)
        reference = references.windows(ts, count)
        # The uprights are horizontal at a quarter of a turn, which they have passed after 1 s.
        assert np.abs(reference.q[1:]).max() > np.pi / 2
        exact = np.concatenate([reference.q[-1], reference.v[-1]])[None]
        for method in methods:
            for stepsize in stepsizes:

                def run(point, x, base=base, q0=q0, v0=v0, method=method, stepsize=stepsize):
                    dtype = point.dtype
                    scene = as_dtype(base, dtype)
                    v = v0.astype(dtype) * (point + x)
                    found = jd.simulate(
                        scene, q0.astype(dtype), v, jnp.asarray(ts, dtype), method=method, stepsize=stepsize,
                        outputs=("constraint_residual",), max_steps=2048, throw=False,
                    )
                    return outcome(found, residual=jnp.max(found.constraint_residual[:, 0]))

                studied = study(run, jnp.ones(1), dtypes, gradient)
                label = f"{count} window{'s' * (count > 1)}, {method}, {'adaptive' if stepsize is None else 'fixed'}"
                rows += table("flat", [label], studied, exact, LOOSE, "Jacobi's functions", advice=FLAT)
    return rows


ANGLES = 10.0 ** -np.array([2, 3, 4, 5, 6, 8, 10, 12])


def _lines(p, q, t):
    return jnp.stack([q[2], jnp.cos(p) * q[2] + jnp.sin(p) * q[1]])


def _mass(q):
    return jnp.eye(3, dtype=q.dtype)


def _no_force(q, v):
    return jnp.zeros_like(v)


@case
def planes(dtypes, gradient, rank_tol=None):
    """Rows at an angle of 1e-2 to 1e-12: a particle held on the line in which two planes meet, pushed along and across, 1 s"""

    def run(point, x):
        angle, across = point
        dtype = angle.dtype
        held = jd.Holonomic(jax.tree_util.Partial(_lines, angle), name="planes")
        scene = jd.Scene(jd.ExplicitSystem(_mass, _no_force, 3), (held,))
        push = _Push(jnp.stack([1.0 + x, across, jnp.ones((), dtype)]))
        zero = jnp.zeros(3, dtype)
        found = jd.simulate(
            scene, zero, zero, jnp.asarray([0.0, 1.0], dtype), control=push, outputs=("constraint_residual",),
            method=jd.Projected(rank_tol=rank_tol), max_steps=256,
        )
        return outcome(found, end=found.q[-1], value=jnp.sum(found.q[-1] + found.v[-1]))

    rows = []
    for across, what in ((0.0, "along"), (1.0, "across")):
        studied = study(run, (jnp.asarray(ANGLES), jnp.full(len(ANGLES), across)), dtypes, gradient)
        exact = np.tile([0.5, 0.0, 0.0], (len(ANGLES), 1))
        rows += table(
            "planes", [f"{a:.0e} rad, {what}" for a in ANGLES], studied, exact, LOOSE, "closed form", advice=PLANES
        )
    return rows


class _Push(eqx.Module):
    force: jax.Array

    def __call__(self, q, v, t):
        return self.force


@case
def bases(dtypes, gradient):
    """Minimal velocities that stop to determine the others: a four-bar linkage by the rate of each joint, one turn of the crank"""
    rows, base = [], jd.scenes.four_bar(gravity=None)
    q0, v0 = jd.scenes.four_bar.start(rate=3.0)
    ts = np.array([0.0, 1.0, 2.5])
    tight = jd.simulate(base, q0, v0, ts, rtol=1e-12, atol=1e-12)
    exact = np.concatenate([tight.q[-1], tight.v[-1]])[None]
    choices = {"crank": jd.Reduced((0,)), "coupler": jd.Reduced((1,)), "rocker": jd.Reduced((2,)), "continued": jd.Reduced(dof=1)}
    for name, method in choices.items():
        for stepsize in (None, 0.01):

            def run(point, x, method=method, stepsize=stepsize):
                dtype = point.dtype
                found = jd.simulate(
                    as_dtype(base, dtype), q0.astype(dtype), v0.astype(dtype) * (point + x), jnp.asarray(ts, dtype),
                    method=method, stepsize=stepsize, outputs=("constraint_residual",), max_steps=2048, throw=False,
                )
                return outcome(found)

            studied = study(run, jnp.ones(1), dtypes, gradient)
            label = f"{name}, {'adaptive' if stepsize is None else 'fixed'}"
            rows += table("bases", [label], studied, exact, LOOSE, "projected, tolerance 1e-12", advice=BASES)
    return rows


@case
def grasps(dtypes, gradient):
    """A ball held at three points that approach a line, and fingers that approach their full reach: `object_dynamics`"""
    return []


OFF = 10.0 ** -np.array([12, 9, 6, 4, 3, 2, 1])


@case
def starts(dtypes, gradient):
    """A start that violates the constraints by 1e-12 to 1e-1: through `assemble`, and without it"""
    base = jd.scenes.four_bar()
    q0, v0 = jd.scenes.four_bar.start()
    rows, ts = [], np.array([0.0, 0.5])

    def run(off, x, assembled):
        dtype = off.dtype
        scene = as_dtype(base, dtype)
        side = jnp.asarray([0.0, 1.0, 1.0], dtype)
        q, v = q0.astype(dtype) + off * side, v0.astype(dtype) * (1 + x) + off * side
        code = None
        if assembled:
            state = jd.assemble(scene, q, v)
            q, v, code = state.q, state.v, state.result
        found = jd.simulate(scene, q, v, jnp.asarray(ts, dtype), outputs=("constraint_residual", "energy"), max_steps=512)
        result = outcome(found, end=(found.energy[1:] - found.energy[0]) / 50.0)
        if code is None:
            return result
        good = code == constrained.RESULTS.successful
        bad = jnp.asarray(jd.RESULTS.inconsistent_start._value)
        return result._replace(code=jnp.where(good, result.code, bad))

    for assembled in (True, False):
        studied = study(lambda p, x, a=assembled: run(p, x, a), jnp.asarray(OFF), dtypes, gradient)
        labels = [f"{o:.0e}, {'assembled' if assembled else 'as it is'}" for o in OFF]
        exact = np.zeros((len(OFF), 1))
        rows += table("starts", labels, studied, exact, LOOSE, "energy", size=1.0, advice=STARTS)
    return rows


FLAT = "x"
PLANES = "x"
BASES = "x"
STARTS = "x"
