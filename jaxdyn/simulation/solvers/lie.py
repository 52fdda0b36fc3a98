"""Steps in the local coordinates of a manifold: any method of an `ODETerm` as a Lie-group method."""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxdyn.lie import se2, se3, so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, SystemLike
from jaxdyn.model.configuration import map_joints
from jaxdyn.model.joints import SCREW_KINDS, joint_integrate, joint_rate
from jaxdyn.model.tree import Model, Topology
from jaxdyn.simulation.solvers.base import DenseOutput, Flag, StepOutput, Wrapped
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
        return functools.partial(_Interpolation, self.solver.interpolation_cls, self.topology)

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


class _Interpolation(DenseOutput):
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
