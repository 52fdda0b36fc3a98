"""Chart: unconstrained coordinates of all feasible models around a nominal one, in which the fits search.

A body's pseudo-inertia is P = U0 (U U^T) U0^T with U0 the factor of the nominal body and U =
log_cholesky_factor(theta): the nominal body, stretched, sheared, shifted and made heavier. Every theta is a physical
body, theta = 0 the nominal one, and theta has no units. Viscous, Coulomb and rotor terms are scale s^2, so that they
cannot become negative; offsets scale s.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.identify.torque_terms import POSITIVE, TERMS, Friction, check_terms
from jaxdyn.model import float64 as _f64
from jaxdyn.model import inertia as _inertia
from jaxdyn.model.tree import Model

INERTIA = ("full", "mass", "fixed")


class Coordinates(eqx.Module):
    """Point in the chart, a pytree: `theta` (bodies, 10), (bodies, 1) or (0, 0); `s` (terms, nv)."""

    theta: Float[Array, "bodies coordinates"]
    s: Float[Array, "terms nv"]


class Chart(eqx.Module):
    """Map from unconstrained coordinates to feasible parameters, models and friction.

    - `factors` (bodies, 4, 4): upper-triangular U0 of the nominal pseudo-inertias of the bodies that have mass.
      Massless bodies stay massless.
    - `origin` (bodies, 4, 4): upper-triangular; U is origin @ log_cholesky_factor(theta), so the chart can be moved along with
      a fit. The identity at first.
    - `scale` (terms, nv): torque-sized units of the terms.
    - `nominal_inertias` (nb, 10) and `nominal_terms` (4, nv): the model's values, of everything that is not fitted.
    """

    factors: Float[Array, "bodies 4 4"]
    origin: Float[Array, "bodies 4 4"]
    scale: Float[Array, "terms nv"]
    nominal_inertias: Float[Array, "nb 10"]
    nominal_terms: Float[Array, "4 nv"]
    v_s: Float[Array, ""]
    bodies: tuple[int, ...] = eqx.field(static=True)
    terms: tuple[str, ...] = eqx.field(static=True)
    inertia: str = eqx.field(static=True)

    @eqx.filter_jit
    def relative_factors(self, theta: Float[Array, "bodies n"]) -> Float[Array, "bodies 4 4"]:
        """Factors U of every body, relative to the nominal one."""
        fill = jnp.zeros((theta.shape[0], 10 - theta.shape[1]), theta.dtype)  # "mass": alpha alone moves
        steps = jax.vmap(_inertia.log_cholesky_factor)(jnp.concatenate([theta, fill], axis=1))
        return jnp.einsum("bij,bjk->bik", self.origin, steps)

    @eqx.filter_jit
    def inertias(self, theta: Float[Array, "bodies n"]) -> Float[Array, "nb 10"]:
        """Ten inertial parameters of every body."""
        if not self.bodies:
            return self.nominal_inertias
        upper = jnp.einsum("bij,bjk->bik", self.factors, self.relative_factors(theta))
        fitted = jax.vmap(_inertia.parameters_from_pseudo)(jnp.einsum("bij,bkj->bik", upper, upper))
        return self.nominal_inertias.at[np.array(self.bodies)].set(fitted)

    @eqx.filter_jit
    def term_values(self, s: Float[Array, "terms nv"]) -> Float[Array, "4 nv"]:
        """Values of all `TERMS`: fitted ones at s, others at the model's value."""
        fitted = self.scale * jnp.where(positive_terms(self.terms), s * s, s)
        rows = [
            fitted[self.terms.index(term)] if term in self.terms else self.nominal_terms[i]
            for i, term in enumerate(TERMS)
        ]
        return jnp.stack(rows)

    @eqx.filter_jit
    def parameters(self, point: Coordinates) -> Float[Array, " p"]:
        """x (10 nb + 4 nv,), in the order of `parameter_names`."""
        return jnp.concatenate([self.inertias(point.theta).reshape(-1), self.term_values(point.s).reshape(-1)])

    @eqx.filter_jit
    def model_at(self, model: Model, point: Coordinates) -> tuple[Model, Friction]:
        """Model with the inertias, armature, damping and friction of a point, and the friction law with its offset."""
        viscous, coulomb, offset, armature = self.term_values(point.s)
        # A leaf that is absent and not fitted stays absent, so that no program compiles it.
        model = model.replace(
            inertias=self.inertias(point.theta),
            armature=None if model.armature is None and "armature" not in self.terms else armature,
            damping=None if model.damping is None and "viscous" not in self.terms else viscous,
            friction=None if model.friction is None and "coulomb" not in self.terms else coulomb,
        )
        return model, Friction(viscous, coulomb, offset, self.v_s)

    @eqx.filter_jit
    def divergence(self, theta: Float[Array, "bodies n"]) -> Float[Array, ""]:
        """Log-det divergence of all bodies from the nominal ones, sum of tr(P0^-1 P) - log det(P0^-1 P) - 4.

        With P = U0 U U^T U0^T it is |U|^2 - 2 sum log U_ii - 4: the same in every frame and unit.
        """
        upper = self.relative_factors(theta)
        # Factors are upper triangular: log det needs the diagonal alone, and has a simple derivative.
        diagonal = jnp.diagonal(upper, axis1=1, axis2=2)
        return jnp.sum(upper**2) - 2 * jnp.sum(jnp.log(diagonal)) - 4.0 * len(self.bodies)

    @eqx.filter_jit
    def clip_terms(self, point: Coordinates) -> Coordinates:
        """Point with terms below a millionth of their unit set to zero, which fits approach but never reach."""
        tiny = positive_terms(self.terms) & (point.s**2 < 1e-6)
        return Coordinates(point.theta, jnp.where(tiny, jnp.zeros_like(point.s), point.s))


def check_bodies(model) -> None:
    """Check that a system has bodies. **Raises:** ValueError for a system that is no `Model`."""
    if not isinstance(model, Model):
        raise ValueError(
            f"model is a {type(model).__name__}; this fit searches the inertias of a Model's bodies: fit numbers of other "
            "systems and of scenes with jd.identify.fit_parameters"
        )


def make_chart(
    model: Model, terms, v_s, inertia: str, tau_scale, v_scale, a_scale, *, bodies=None
) -> tuple[Chart, Coordinates]:
    """Chart around a model, and the start in it: the model's own numbers, a tenth of a unit where it has none.

    `bodies`: indices of those whose inertias can change, all that have mass by default.

    Units are a tenth of the torque, that torque over the velocity and over the acceleration (root mean squares, (nv,)).

    **Raises:** ValueError for unknown terms or `inertia`, and for bodies whose nominal parameters are not strictly
    feasible.
    """
    terms = check_terms(terms, v_s)
    if inertia not in INERTIA:
        raise ValueError(f"inertia is {inertia!r}; give one of {INERTIA}")
    dtype = np.dtype(model.home.dtype)
    numbers = np.asarray(model.inertias, np.float64)
    massive = tuple(int(i) for i in np.flatnonzero(numbers[:, 0] > 0)) if inertia != "fixed" else ()
    bodies = massive if bodies is None else tuple(i for i in massive if i in tuple(bodies))
    matrices = [_f64.pseudo_inertia(numbers[i]) for i in bodies]
    bad = [model.body_names[i] for i, P in zip(bodies, matrices, strict=True) if not _is_feasible(P, inertia)]
    if bad:
        raise ValueError(
            f"inertia of {', '.join(bad)} is not that of a solid body (pseudo-inertia not positive definite): "
            "a feasible fit cannot start there; repair it first with jd.model.repair_inertias(model), give rods and points "
            "some thickness, or fit inertia='mass' alone"
        )
    factors = np.array([_factor(P, inertia) for P in matrices]).reshape(-1, 4, 4)
    unit = 0.1 * np.asarray(tau_scale, np.float64)
    # A torque that is always zero borrows the largest unit: a term in units of zero could not be changed.
    unit = np.where(unit > 0, unit, unit.max(initial=0.0) or 1.0)
    per = {"viscous": v_scale, "coulomb": np.ones(model.nv), "offset": np.ones(model.nv), "armature": a_scale}
    scale = np.array([unit / np.where(np.asarray(per[t]) > 0, per[t], 1.0) for t in terms]).reshape(
        len(terms), model.nv
    )
    own = np.array([np.asarray(_own_terms(model)[term], np.float64) for term in terms]).reshape(len(terms), model.nv)
    if np.any(own < 0):
        row, column = np.argwhere(own < 0)[0]
        raise ValueError(
            f"{terms[row]} of coordinate {column} is {own[row, column]} in the model; it must not be negative"
        )
    # Zero is a stationary point of s^2, from which no gradient leads away: start near it.
    s = np.where(positive_terms(terms), np.sqrt(np.where(own > 0, own / scale, 0.1)), 0.0)
    size = {"full": 10, "mass": 1, "fixed": 0}[inertia]
    chart = Chart(
        jnp.asarray(factors, dtype),
        jnp.asarray(np.broadcast_to(np.eye(4), factors.shape), dtype),
        jnp.asarray(scale, dtype),
        model.inertias,
        jnp.stack([_own_terms(model)[term] for term in TERMS]),
        jnp.asarray(v_s, dtype),
        bodies,
        terms,
        inertia,
    )
    return chart, Coordinates(jnp.zeros((len(bodies), size), dtype), jnp.asarray(s, dtype))


def _own_terms(model: Model) -> dict[str, Array]:
    own = {"viscous": model.damping, "coulomb": model.friction, "offset": None, "armature": model.armature}
    zero = jnp.zeros((model.nv,), model.home.dtype)
    return {term: zero if value is None else value for term, value in own.items()}


def positive_terms(terms) -> np.ndarray:
    """Mask (terms, 1) of the terms that must not be negative."""
    return np.array([[term in POSITIVE] for term in terms], bool).reshape(len(terms), 1)


def _is_feasible(matrix: np.ndarray, inertia: str) -> bool:
    """Decide whether a pseudo-inertia is positive definite, or semidefinite (rods, points) where only the density is fitted."""
    values = np.linalg.eigvalsh(matrix)
    # Relative to the largest eigenvalue: the scale of a body's mass does not matter.
    return bool(values[0] > (1e-14 if inertia == "full" else -1e-9) * values[-1])


def _factor(matrix: np.ndarray, inertia: str) -> np.ndarray:
    """U0 with U0 U0^T = P0: upper triangular, or any root where the density alone is fitted."""
    if inertia == "full":
        # LAPACK's factor is lower triangular; of the reversed matrix, and reversed back, it is upper.
        return np.linalg.cholesky(matrix[::-1, ::-1])[::-1, ::-1]
    values, vectors = np.linalg.eigh(matrix)
    # A rod's or point's pseudo-inertia is singular and has no Cholesky factor.
    return vectors * np.sqrt(np.maximum(values, 0))
