"""Methods of our own in diffrax's interface.

`LieGroup` steps in the local coordinates of a manifold, by any method of an `ODETerm`. `Rodas5P` is linearly implicit, for stiff
equations: one Jacobian and one inverse a step, no iterations. `RK4` and `Stepper`, a map from one state to the next, are for
fixed steps.
"""

import functools
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from jaxdyn.compile import inverse
from jaxdyn.lie import se2, se3, so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, SystemLike
from jaxdyn.model.configuration import map_joints
from jaxdyn.model.topology import SCREW_KINDS, joint_integrate, joint_rate
from jaxdyn.model.tree import Model, Topology
from jaxdyn.simulation.solvers.base import DenseOutput, Flag, StageInterpolation, StepOutput, Wrapped
from jaxdyn.systems.system import has_dependent_coordinates


class LieGroup(Wrapped):
    r"""A method that steps in local coordinates about the start of each step.

    $$q = q_k \exp(e), \quad \dot e = J_r(e)^{-1} v$$

    The wrapped method integrates e (nv,) from zero, with $J_r$ the right Jacobian of each joint's group. So
    q stays on its manifold without projection, errors are those of rotations, and implicit methods solve for 2 nv unknowns
    instead of nq + nv. The order is that of the wrapped method, which is used directly for systems without quaternions or
    planar joints. A step may turn a body by less than a full turn.

    **Arguments:** `solver`, any diffrax method that `simulate` takes. `topology`: filled in by `simulate`.

    Source: Munthe-Kaas, Runge-Kutta methods on Lie groups (1998); Hairer, Lubich & Wanner 2006, section IV.8.2.

    ```python
    jd.simulate(model, q0, v0, ts, solver=jd.solvers.LieGroup(diffrax.Kvaerno5()))
    ```
    """

    topology: Topology | None = eqx.field(static=True, default=None)

    def for_system(self, system: SystemLike) -> diffrax.AbstractSolver:
        """The method for a system. **Raises:** ValueError for one whose q holds more than the coordinates of joints."""
        if has_dependent_coordinates(system):
            raise ValueError(
                f"solver is LieGroup and the system a {type(system).__name__}, whose contacts have no local coordinates; "
                "pass the wrapped method itself"
            )
        if isinstance(system, Model) and not all(kind in SCREW_KINDS for kind in system.topology.kinds):
            return LieGroup(self.solver, system.topology)
        return self.solver

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        """Dense output of the wrapped method in the coordinates of the step."""
        return functools.partial(_LocalInterpolation, self.solver.interpolation_cls, self.topology)

    def init(self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree) -> PyTree:
        """State of the wrapped method before the first step."""
        terms, z0 = self._local(terms, y0)
        return self.solver.init(terms, t0, t1, z0, args)

    def step(
        self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree, solver_state: PyTree, made_jump: Flag
    ) -> StepOutput:
        """Make one step of the wrapped method in the coordinates about its start."""
        topology: Any = self.topology
        local, z0 = self._local(terms, y0)
        # A first-same-as-last method carries the vector field in the coordinates of the step before. It is evaluated anew.
        z1, error, dense_info, solver_state, result = self.solver.step(
            local, t0, t1, z0, args, solver_state, made_jump=True
        )
        y1 = _to_manifold(topology, y0["q"], z1)
        if error is not None:
            error = error | {"q": map_joints(topology, joint_rate, y1["q"], (error["q"], False))}
        return y1, error, {"dense_info": dense_info, "q0": y0["q"]}, solver_state, result

    def _local(self, terms, y0):
        """Terms and state in the coordinates about y0."""
        assert self.topology is not None

        def term(term):
            return _LocalTerm(term, y0["q"], self.topology)

        several = isinstance(terms, diffrax.MultiTerm)
        local = diffrax.MultiTerm(*map(term, terms.terms)) if several else term(terms)
        return local, y0 | {"q": jnp.zeros((self.topology.nv,), y0["q"].dtype)}


class _LocalTerm(diffrax.AbstractTerm):
    """A term whose state has local coordinates in place of q."""

    term: Any
    q0: jax.Array
    topology: Any = eqx.field(static=True)

    def vf(self, t, y, args):
        state = _to_manifold(self.topology, self.q0, y)
        rates = self.term.vf(t, state, args)
        return rates | {"q": map_joints(self.topology, _local_rate, state["q"], (rates["q"], True), (y["q"], False))}

    def contr(self, t0, t1, **kwargs):
        return self.term.contr(t0, t1, **kwargs)

    def prod(self, vf, control):
        return jax.tree.map(lambda x: control * x, vf)


class _LocalInterpolation(DenseOutput):
    """Dense output of the wrapped method, mapped onto the manifold."""

    topology: Any = eqx.field(static=True)
    inner: Any
    q0: jax.Array

    def __init__(self, interpolation, topology, *, t0, t1, dense_info, q0):
        self.t0, self.t1 = t0, t1
        self.topology = topology
        self.inner = interpolation(t0=t0, t1=t1, **dense_info)
        self.q0 = q0

    def at(self, t):
        return _to_manifold(self.topology, self.q0, self.inner.evaluate(t))


def _to_manifold(topology, q0, z):
    """State with q = q0 exp(e) in place of e."""
    return z | {"q": map_joints(topology, joint_integrate, q0, (z["q"], False))}


def _local_rate(kind: str, q, rate, e):
    """Rate de/dt of one joint's coordinates for dq/dt = rate at q = q0 exp(e)."""
    if kind in SCREW_KINDS:
        return rate
    # v is the velocity in the moving frame, and de/dt = J_r(e)^-1 v.
    if kind == "planar":
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        v = jnp.stack([c * rate[0] + s * rate[1], c * rate[1] - s * rate[0], rate[2]])
        return matmul(se2.left_jacobian_inverse(-e), v)
    # dq/dt = q (0, omega)/2, so that omega is the vector part of 2 q^-1 dq/dt. J_r(e) = J_l(-e).
    omega = 2 * so3.quat_multiply(so3.quat_conjugate(q[-4:]), rate[-4:])[1:]
    if kind == "spherical":
        return matmul(so3.left_jacobian_inverse(-e), omega)
    v = jnp.concatenate([matmul(so3.quat_to_matrix(q[3:]).T, rate[:3]), omega])
    return matmul(se3.left_jacobian_inverse(-e), v)


# --- a linearly implicit method for stiff equations: one Jacobian and one inverse a step, no iterations ---


_GAMMA = 0.21193756319429014
# The coefficients are those of Steinebach (2023), transformed as in Hairer & Wanner 1996, eq. IV.7.25, so that a step multiplies
# no vector by the Jacobian. Stage i starts from y0 + A[i] U, at t0 + _TIME[i] h; _C holds the C_ij of `Rodas5P`, _RATE its d_i.
_A = np.zeros((8, 8))
_A[1, :1] = 3.0
_A[2, :2] = 2.849394379747939, 0.45842242204463923
_A[3, :3] = -6.954028509809101, 2.489845061869568, -10.358996098473584
_A[4, :4] = 2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641
_A[5, :5] = -7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946
_A[6, :6] = *_A[5, :5], 1.0
_A[7, :7] = *_A[6, :6], 1.0
_C = np.zeros((8, 8))
_C[1, :1] = -14.155112264123755
_C[2, :2] = -17.97296035885952, -2.859693295451294
_C[3, :3] = 147.12150275711716, -1.41221402718213, 71.68940251302358
_C[4, :4] = 165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306
_C[5, :5] = 24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471
_C[6, :6] = (
    *(30.91273214028599, -3.1208243349937974, 77.79954646070892),
    *(34.28646028294783, -19.097331116725623, -28.087943162872662),
)
_C[7, :7] = (
    *(37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047),
    *(-40.06618937091002, -54.66780262877968, -9.48861652309627),
)
_TIME = np.array([0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1, 1, 1])
_RATE = np.zeros(8)
_RATE[:5] = _GAMMA, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734, 2.325825639765069
# Dense output: y0 (1 - x) + x (y1 + (1 - x) (K[0] + x (K[1] + x K[2]))), K = H U.
_H = np.array(
    [
        [
            *(25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204),
            *(0.524948541321073, 1.1241088310450404, 0.4272876194431874, -0.17202221070155493),
        ],
        [
            *(-9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796),
            *(20.176138334709044, 15.98066361424651, -6.789040303419874, -6.710236069923372),
        ],
        [
            *(11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643),
            *(-52.072871366152654, -59.78993625266729, -0.15582684282751913, 4.883087185713722),
        ],
    ]
)


class _RosenbrockInterpolation(StageInterpolation):
    """The method's own dense output, of order 4."""

    def at(self, t):
        x = self.fraction(t)
        z = 1 - x
        return jax.tree.map(
            lambda a, b, k: z * a + x * (b + z * (k[0] + x * (k[1] + x * k[2]))), self.y0, self.y1, self.k
        )


class Rodas5P(diffrax.AbstractAdaptiveSolver):
    r"""Rosenbrock method of order 5(4) for stiff equations: eight linear systems a step with one matrix.

    $$(1 - \gamma h J) U_i = \gamma \Big( h f\big(t_0 + c_i h, y_0 + \sum_j A_{ij} U_j\big) + \sum_j C_{ij} U_j
    + h^2 d_i \frac{\partial f}{\partial t} \Big), \quad y_1 = y_0 + \sum_j A_{8j} U_j + U_8$$

    with the error estimate $U_8$ and $J = \partial f / \partial y$ at the start. Both derivatives of f come from forward-mode
    differentiation. Stiffly accurate and L-stable; nothing is iterated, so nothing can fail to converge.

    The state is any pytree of floating arrays of one dtype. A step costs 9 evaluations, one derivative with respect to each
    entry of the state and to time, and one inverse.

    Source: Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the Julia
    Differential Equations package (2023), in the form of Hairer & Wanner 1996, eq. IV.7.25.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., _RosenbrockInterpolation]] = _RosenbrockInterpolation

    def order(self, terms: PyTree) -> int:
        """Order of convergence."""
        return 5

    def init(self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree) -> PyTree:
        """No state between steps."""
        return None

    def func(self, terms: PyTree, t0: Number, y0: PyTree, args: PyTree) -> PyTree:
        """Vector field at one point."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree, solver_state: PyTree, made_jump: Flag
    ) -> StepOutput:
        """Make one step from t0 to t1."""
        start, unravel = ravel_pytree(y0)
        control = terms.contr(t0, t1)

        def change(y, t):
            return ravel_pytree(terms.vf_prod(t, unravel(y), args, control))[0]

        end, error, k = self.advance(change, start, t0, t1)
        dense = {"y0": y0, "y1": unravel(end), "k": jax.vmap(unravel)(k)}
        return unravel(end), unravel(error), dense, None, diffrax.RESULTS.successful

    @staticmethod
    def advance(change: Callable, start: Array, t0: Number, t1: Number) -> tuple[Array, Array, Array]:
        """End (n,) of a step from a flat state, its error (n,), and the data (3, n) of its dense output.

        `change(y, t)` (n,) is h f.
        """
        h = t1 - t0

        def of_point(point):
            return change(point[:-1], point[-1])

        # One Jacobian with respect to (y, t): its last column is h df/dt.
        begin = jnp.append(start, jnp.asarray(t0, start.dtype))
        jacobian = jax.jacfwd(of_point)(begin)
        # `change` is h f, so that its Jacobian includes h.
        matrix = jnp.eye(start.size, dtype=start.dtype) - _GAMMA * jacobian[:, :-1]
        inverted = inverse(matrix)

        def stage(stages, row):
            i, a, c, time, rate = row
            point = jnp.append(start + matmul(a, stages), jnp.asarray(t0 + time * h, start.dtype))
            right = _GAMMA * (of_point(point) + matmul(c, stages) + rate * h * jacobian[:, -1])
            solution = matmul(inverted, right)
            # Products with an inverse lose the digits of the condition number; one refinement restores those of elimination.
            solution = solution + matmul(inverted, right - matmul(matrix, solution))
            return stages.at[i].set(solution), None

        # A scan rather than eight copies of the vector field: the program of a stage is compiled once.
        rows = [jnp.asarray(x, start.dtype) for x in (_A, _C, _TIME, _RATE)]
        stages, _ = jax.lax.scan(stage, jnp.zeros((8, start.size), start.dtype), (jnp.arange(8), *rows))
        end = start + matmul(rows[0][-1], stages) + stages[-1]
        return end, stages[-1], matmul(jnp.asarray(_H, start.dtype), stages)


# --- methods for fixed steps: the classical Runge-Kutta method, and maps from one state to the next ---


_B = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])


class _CubicInterpolation(StageInterpolation):
    """Third-order continuous extension from the four stages, without a further evaluation."""

    def at(self, t):
        x = self.fraction(t)
        middle = x * x * (1 - 2 * x / 3)
        weights = jnp.stack([x * (1 - x * (1.5 - 2 * x / 3)), middle, middle, x * x * (2 * x / 3 - 0.5)])
        return jax.tree.map(lambda y, k: y + jnp.tensordot(weights.astype(y.dtype), k, 1), self.y0, self.k)


class RK4(diffrax.AbstractERK):
    """Classical Runge-Kutta method: order 4, four evaluations a step, for fixed steps.

    Dense output is of order 3 (local error $h^4$) and keeps the global order 4. The error estimate is the difference from the
    midpoint rule, of order $h^3$. It detects steps that are too long (`ErrorMonitoredSteps`) and is too coarse to control them.

    Source: Hairer, Norsett & Wanner 1993, tables II.1.2 and section II.6.
    """

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=_B,
        b_error=_B - np.array([0.0, 1.0, 0.0, 0.0]),
        c=np.array([0.5, 0.5, 1.0]),
    )
    interpolation_cls: ClassVar[Callable[..., _CubicInterpolation]] = _CubicInterpolation

    def order(self, terms: PyTree) -> int:
        """Order of convergence."""
        return 4

    def error_order(self, terms: PyTree) -> int:
        """Power of the step length in the error estimate."""
        return 3


class _MeanVelocityInterpolation(DenseOutput):
    """Dense output from a step's ends: v is the parabola through v0 and v1 with the mean velocity over the step.

    q is displaced by its integral, on the manifold. Other entries of the state change at a constant rate. Local errors of q
    and v are h^4 and h^3, those of cubic Hermite interpolation, plus the error of the step.
    """

    y0: dict
    y1: dict
    mean: jax.Array
    displace: Callable

    def at(self, t):
        s, h = (x.astype(self.mean.dtype) for x in (self.fraction(t), self.t1 - self.t0))
        first, last = self.y0["v"], self.y1["v"]
        y = jax.tree.map(lambda a, b: a + s * (b - a), self.y0, self.y1)
        # Integral of the parabola, as a fraction of the step; its derivative is v.
        path = s * (1 - s) ** 2 * first + s * s * (s - 1) * last + s * s * (3 - 2 * s) * self.mean
        v = (1 - s) * (1 - 3 * s) * first + s * (3 * s - 2) * last + 6 * s * (1 - s) * self.mean
        return y | {"q": self.displace(self.y0["q"], h * path), "v": v}


class Stepper(diffrax.AbstractSolver):
    """A one-step map of order 2 that does not call the vector field, for fixed steps.

    **Arguments:**

    - `begin(t0, y0, args)` -> what the first step needs in addition to y.
    - `advance(t0, t1, y, args, carried)` -> y1, the mean velocity of the step, what is carried on, and whether it succeeded.
      y is a dictionary with "q" and "v". What these two depend on comes through `args`, so that gradients reach it.
    - `displace(q, step)` -> configuration.
    """

    begin: Callable | None = None
    advance: Callable | None = None
    displace: Callable | None = None
    term_structure: ClassVar = diffrax.AbstractTerm

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        """Dense output from the ends of a step and its mean velocity."""

        def interpolation(**given):
            return _MeanVelocityInterpolation(displace=self.displace, **given)  # pyright: ignore[reportArgumentType]

        return interpolation

    def order(self, terms: PyTree) -> int:
        """Order of convergence."""
        return 2

    def init(self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree) -> PyTree:
        """Data that the first step needs."""
        return self.begin(t0, y0, args)  # pyright: ignore[reportOptionalCall]

    def func(self, terms: PyTree, t0: Number, y0: PyTree, args: PyTree) -> PyTree:
        """Vector field at one point."""
        return terms.vf(t0, y0, args)

    def step(
        self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree, solver_state: PyTree, made_jump: Flag
    ) -> StepOutput:
        """Make one step from t0 to t1; NaN where it failed."""
        y1, mean, carried, solved = self.advance(t0, t1, y0, args, solver_state)  # pyright: ignore[reportOptionalCall]
        # Other entries of the state are constant within a step.
        y1 = y0 | jax.tree.map(lambda y: jnp.where(solved, y, jnp.full_like(y, jnp.nan)), y1)
        codes: Any = diffrax.RESULTS
        result = codes.where(solved, codes.successful, codes.nonlinear_divergence)
        return y1, None, {"y0": y0, "y1": y1, "mean": mean}, carried, result
