"""Controls of a simulation: functions of the state, controllers with a state of their own, and sampled ones.

A plain control is tau(q, v, t). A `Controller` also has a state z, integrated with the motion:

    tau = control(q, v, t, z),    dz/dt = rate(q, v, t, z, lam),

which makes the feedback of constraint forces through z free of algebraic loops: lam depends on tau, and tau on z alone. Where
tau depends on lam itself, the loop lam = lam(tau(lam)) is linear if the law is, and is solved exactly (`_solve_loop`). A
`Sampled` law is called once a period, and its torque is held in between.

The control's entries in the state of the equation (`Method`) are "control", z, and "held", the record of a sampled law.
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import layout
from jaxdyn.constraints.rank import pseudo_inverse, tolerance
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Function, Number, Numbers, as_array, state_dtype, warn
from jaxdyn.systems.scene import Scene, as_pytree, check_callback, check_force

STATE, HELD = "control", "held"


class Controller(eqx.Module):
    """A control law with a state z of its own: integral action, filters, observers.

    A subclass gives `start`, `__call__` and `rate`. The state is any pytree of arrays, or None for none. With
    `takes_multipliers = True` the law is called with the multipliers lam (nc,) too, and has to be affine in them: the loop
    lam -> tau -> lam is then solved exactly, for one evaluation of the dynamics per row more. A law that is not affine in
    lam takes a filtered one instead: a state with dz/dt = (lam - z)/T.

    ```python
    class Integral(jd.Controller):
        gain: jax.Array
        target: jax.Array

        def start(self, q, v, t):
            return jnp.zeros_like(q)

        def __call__(self, q, v, t, state):
            return -self.gain * state

        def rate(self, q, v, t, state, multipliers):
            return q - self.target
    ```
    """

    takes_multipliers: ClassVar[bool] = False

    def start(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Float[Array, ""]) -> PyTree:
        """The state at the start."""
        return None

    @abc.abstractmethod
    def __call__(
        self,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: PyTree = None,
        multipliers: Float[Array, " nc"] | None = None,
    ) -> Float[Array, " nv"]:
        """tau (nv,), N m or N."""

    def rate(
        self,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: PyTree,
        multipliers: Float[Array, " nc"] | None,
    ) -> PyTree:
        """Rate of the state, of its structure. `multipliers` (nc,), under the torque that the law gives."""
        return None

    def allowance(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, ""] | None:
        """Distance of the law from where it cannot follow its task; None if that is unknown or not to be monitored.

        Where this number falls to zero a simulation ends, with the code `control_singular`.
        """
        return None


class Sampled(eqx.Module):
    """A discrete controller: the law is called at the start and after every `period`, and its torque is held in between.

    It needs fixed steps (`stepsize`); a whole number of them fills a period. The outputs "torque" and "control_state" at a save
    point that is a sampling instant are those before or after it, as rounding of the times decides: save between samples to
    read them. The motion does not depend on that.

    **Arguments:**

    - `law`: law(q, v, t, state) -> (tau (nv,), state); with `state=None` law(q, v, t) -> tau, as all laws of `jd.control`
      without a state. An equinox Module carries leaves that can be differentiated and batched.
    - `state`: that the law starts with, a pytree of arrays; the law returns the same structure.
    - `period` (): s, positive.

    **Raises:** ValueError for a law that cannot be called, and for a period that is not positive.

    ```python
    law = jd.Sampled(jd.control.ComputedTorque(model, target, 25.0, 10.0), None, 1e-3)
    jd.simulate(model, q0, v0, ts, control=law, stepsize=1e-3)
    ```
    """

    law: Callable
    state: Any
    period: Array

    def __init__(self, law: Function, state: PyTree, period: Numbers):
        self.law = as_pytree(law, "Sampled: law")
        self.state = jax.tree.map(lambda x: jnp.asarray(as_array(x, "Sampled: state")), state)
        seconds = as_array(period, "Sampled: period")
        if seconds.shape != () or (is_concrete(seconds) and not 0 < float(seconds) < np.inf):
            raise ValueError(f"Sampled: period is {period!r}; give one positive number (s)")
        self.period = jnp.asarray(seconds, float)

    def update(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, state: PyTree) -> tuple[Array, Any]:
        """Torque and next state of the law."""
        return (self.law(q, v, t), None) if self.state is None else self.law(q, v, t, state)

    def called(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, state: PyTree) -> tuple[Array, Any]:
        """Deprecated name of `update`."""
        warn("Sampled.called is deprecated; call update", DeprecationWarning)
        return self.update(q, v, t, state)


def as_control(control: Any) -> Any:
    """A control as a pytree. **Raises:** ValueError for what cannot be called."""
    if control is None or isinstance(control, (Controller, Sampled)):
        return control
    return as_pytree(control, "control")


def check_steps(control: Any, stepsize: Any) -> None:
    """Refuse steps that do not fit a sampled law: adaptive ones, and those that do not fill a period."""
    if not isinstance(control, Sampled):
        return
    if not isinstance(stepsize, (int, float, np.ndarray, jax.Array)):
        raise ValueError(
            "control is sampled, which takes fixed steps; pass stepsize=control.period, or a whole part of it"
        )
    if is_concrete((control.period, stepsize)):
        ratio = float(control.period) / float(np.asarray(stepsize))
        # Steps may be written with six digits, such as 1e-3 / 3.
        if not (ratio > 0.5 and abs(ratio - round(ratio)) < 1e-6 * ratio):
            raise ValueError(
                f"stepsize is {float(np.asarray(stepsize)):.6g} s, and the period of the sampled control "
                f"{float(control.period):.6g} s, which is {ratio:.6g} steps; take a whole part of it"
            )


def can_end(control: Any, q, v, t) -> bool:
    """True if a control has an allowance, which may end the motion."""
    return isinstance(control, Controller) and eqx.filter_eval_shape(control.allowance, q, v, t) is not None


def check_control(scene: Scene, control: Any, q, v, t) -> None:
    """Call a control with traced numbers, in the same way as the integration.

    **Raises:** ValueError for other arguments, shapes that do not fit, and states that change their structure.
    """
    if isinstance(control, Sampled):
        named = ("control.law", "law(q, v, t)", q, v, t)
        check_callback(
            control.law,
            *(named if control.state is None else ("control.law", "law(q, v, t, state)", q, v, t, control.state)),
        )
        returned = eqx.filter_eval_shape(lambda *args: control.update(*args, _numbers(control.state, q)), q, v, t)  # pyright: ignore[reportCallIssue]
        if not (isinstance(returned, tuple) and len(returned) == 2):
            raise ValueError(f"control.law returned {returned!r}; return (tau, state)")
        check_force(jnp.zeros(jnp.shape(returned[0])), q, scene.nv, "control.law")
        _check_state(_numbers(control.state, q), returned[1], "control.law")
    elif isinstance(control, Controller):
        state = eqx.filter_eval_shape(control.start, q, v, t)
        state, count = jax.tree.map(lambda x: jnp.zeros(x.shape, q.dtype), state), _count(scene)
        lam = (jnp.zeros((count,), q.dtype),)
        check_callback(control, "control", "control(q, v, t, state)", q, v, t, state, *lam * control.takes_multipliers)
        if state is not None:
            check_callback(control.rate, "control.rate", "rate(q, v, t, state, multipliers)", q, v, t, state, *lam)
            _check_state(state, eqx.filter_eval_shape(control.rate, q, v, t, state, *lam), "control.rate")
    elif control is not None:
        check_callback(control, "control", "control(q, v, t)", q, v, t)


def initial_entries(control: Any, q, v, t) -> dict[str, Array]:
    """Initial values of the control's entries in the state of the equation."""
    if isinstance(control, Sampled):
        # With no sample so far the first one is due at the start.
        start = jnp.concatenate([jnp.stack([t, jnp.zeros_like(t)]), jnp.zeros_like(v), _flat(control.state, q)])
        return {HELD: sample(control, start, q, v, t)}
    if isinstance(control, Controller) and (state := control.start(q, v, t)) is not None:
        return {STATE: _flat(state, q)}
    return {}


def sample(control: Sampled, held: Float[Array, " n"], q, v, t) -> Float[Array, " n"]:
    """Call the law where a sample is due at t: start of the run, number of samples, torque, and the law's state, flat."""
    start, count, _, state = _unpack(control, held, v)
    # Times of steps are sums with rounding errors: a sample that is due by less than that is taken now.
    slack = control.period.astype(t.dtype) * float(jnp.finfo(t.dtype).eps) ** 0.4
    due = t >= start + count * control.period.astype(t.dtype) - slack
    tau, state = control.update(q, v, t, state)
    tau = check_force(tau, q, v.shape[0], "control.law")
    fresh = jnp.concatenate([jnp.stack([start, count + 1]), tau, _flat(state, q)])
    return jnp.where(due, fresh, held)


def torque(control: Any, scene: Scene, y, q, v, t, multipliers: Callable) -> Array | None:
    """Torque (nv,) of a control, or None without one; multipliers(tau) are those of the dynamics."""
    if control is None:
        return None
    if isinstance(control, Sampled):
        return _unpack(control, y[HELD], v)[2]
    if not isinstance(control, Controller):
        return check_force(control(q, v, t), q, scene.nv, "control")
    state = state_of(control, y, q, v, t)
    if not control.takes_multipliers:
        return check_force(control(q, v, t, state), q, scene.nv, "control")

    def at(lam):
        return check_force(control(q, v, t, state, lam), q, scene.nv, "control")

    return at(_solve_loop(lambda lam: multipliers(at(lam)), jnp.zeros((_count(scene),), q.dtype)))


def _solve_loop(answer: Callable, none: Float[Array, " nc"]) -> Float[Array, " nc"]:
    """Solution of lam = answer(lam) for an affine function."""
    # (1 - d answer/d lam) lam = answer(0). Redundant rows make the matrix singular; any of their multipliers will do.
    first, push = jax.linearize(answer, none)
    unit = jnp.eye(none.shape[0], dtype=none.dtype)
    left = unit - jax.vmap(push, out_axes=1)(unit)
    return matmul(pseudo_inverse(left, tolerance(None, left)), first)


def rates(control: Any, y, q, v, t, multipliers: Callable) -> dict[str, Array]:
    """Rates of the control's entries in the state; multipliers() are those of the motion."""
    if HELD in y:
        return {HELD: jnp.zeros_like(y[HELD])}
    if STATE not in y:
        return {}
    return {STATE: _flat(control.rate(q, v, t, state_of(control, y, q, v, t), multipliers()), q)}


def state_of(control: Any, y, q, v, t) -> Any:
    """State of the controller in its own structure, or None."""
    if HELD in y:
        return _unpack(control, y[HELD], v)[3]
    if STATE not in y:
        return None
    like = eqx.filter_eval_shape(control.start, q, v, t)
    return ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, q.dtype), like))[1](y[STATE])


def at_start(control: Any, q, v, t) -> Any:
    """Control near its start as a function of (q, v, t), for its derivatives; None if there is no such function."""
    if isinstance(control, Sampled):
        return None
    if not isinstance(control, Controller):
        return control
    if control.takes_multipliers:
        return None
    return _AtStart(control, control.start(jnp.asarray(q), jnp.asarray(v), jnp.asarray(t)))


class _AtStart(eqx.Module):
    """A controller with a constant state."""

    control: Controller
    state: Any

    def __call__(self, q, v, t):
        return self.control(q, v, t, self.state)


def _count(scene: Scene) -> int:
    return layout(scene)[-1].end if scene.constraints else 0


def _numbers(state, q):
    return jax.tree.map(lambda x: jnp.asarray(x, state_dtype(None, q)), state)


def _flat(state, q) -> Array:
    """A state as one vector, in the dtype of q."""
    if state is None:
        return jnp.zeros((0,), q.dtype)
    return ravel_pytree(jax.tree.map(lambda x: jnp.asarray(x, q.dtype), state))[0]


def _unpack(control: Sampled, held, v):
    """Start of the run, number of samples, torque, and the law's state."""
    n = v.shape[0]
    state = None if control.state is None else ravel_pytree(_numbers(control.state, v))[1](held[2 + n :])
    return held[0], held[1], held[2 : 2 + n], state


def _check_state(state, returned, name: str) -> None:
    shapes = [jax.tree.map(jnp.shape, x) for x in (state, returned)]
    if shapes[0] != shapes[1]:
        raise ValueError(f"{name} returned a state of shapes {shapes[1]}, expected {shapes[0]}; keep its structure")


if TYPE_CHECKING:
    Control = Callable[[Array, Array, Array], Array] | Controller | Sampled | None
else:
    Control = Any  # `as_control` checks it
