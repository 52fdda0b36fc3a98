"""A linearly implicit method for stiff equations: one Jacobian and one inverse a step, no iterations."""

from collections.abc import Callable
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from jaxdyn.compile import inverse
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number
from jaxdyn.simulation.solvers.base import Flag, StageInterpolation, StepOutput

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
# What jumps where steps end is constant within them: the limits from after at the start, and from before at the end.
_SIDE = (_TIME == 0).astype(float) - (_TIME == 1)
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


class _Interpolation(StageInterpolation):
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
    interpolation_cls: ClassVar[Callable[..., _Interpolation]] = _Interpolation

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

        def change(y, t, _):
            return ravel_pytree(terms.vf_prod(t, unravel(y), args, control))[0]

        end, error, k = self.advance(change, start, t0, t1)
        dense = {"y0": y0, "y1": unravel(end), "k": jax.vmap(unravel)(k)}
        return unravel(end), unravel(error), dense, None, diffrax.RESULTS.successful

    @staticmethod
    def advance(change: Callable, start: Array, t0: Number, t1: Number) -> tuple[Array, Array, Array]:
        """End (n,) of a step from a flat state, its error (n,), and the data (3, n) of its dense output.

        `change(y, t, side)` (n,) is h f at a time t; `side` is 1 at the start of the step, -1 at its end, else 0.
        """
        h = t1 - t0

        def of_point(point, side):
            return change(point[:-1], point[-1], side)

        # One Jacobian with respect to (y, t): its last column is h df/dt.
        begin = jnp.append(start, jnp.asarray(t0, start.dtype))
        jacobian = jax.jacfwd(of_point)(begin, jnp.ones((), start.dtype))
        # `change` is h f, so that its Jacobian includes h.
        matrix = jnp.eye(start.size, dtype=start.dtype) - _GAMMA * jacobian[:, :-1]
        inverted = inverse(matrix)

        def stage(stages, row):
            i, a, c, time, side, rate = row
            point = jnp.append(start + matmul(a, stages), jnp.asarray(t0 + time * h, start.dtype))
            right = _GAMMA * (of_point(point, side) + matmul(c, stages) + rate * h * jacobian[:, -1])
            solution = matmul(inverted, right)
            # Products with an inverse lose the digits of the condition number; one refinement restores those of elimination.
            solution = solution + matmul(inverted, right - matmul(matrix, solution))
            return stages.at[i].set(solution), None

        # A scan rather than eight copies of the vector field: the program of a stage is compiled once.
        rows = [jnp.asarray(x, start.dtype) for x in (_A, _C, _TIME, _SIDE, _RATE)]
        stages, _ = jax.lax.scan(stage, jnp.zeros((8, start.size), start.dtype), (jnp.arange(8), *rows))
        end = start + matmul(rows[0][-1], stages) + stages[-1]
        return end, stages[-1], matmul(jnp.asarray(_H, start.dtype), stages)
