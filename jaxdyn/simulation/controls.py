"""Controls of a simulation: functions of the state, controllers with a state of their own, and sampled controllers.

A plain control is tau(q, v, t). A `Controller` also has a state z, integrated with the motion:

    tau = control(q, v, t, z),    dz/dt = rate(q, v, t, z, lam),

The constraint forces lam depend on tau. If they are fed back through z there is no algebraic loop, because tau depends on z and
not on lam. If tau depends on lam directly, lam = lam(tau(lam)) has to be solved. The dynamics are affine in tau, so that this is
a linear equation if the law is affine in lam (see `torque`). A `Sampled` law is called once per period, and its torque is
held in between.

The state of the differential equation (`Method`) is a dictionary. A control adds "control", the state z as a vector, or "held",
the record of a sampled law: start of the run, number of samples, torque, and the law's state.
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

STATE, HELD = "control", "held"  # keys of the control's entries in the state of the equation


class Controller(eqx.Module):
    r"""A control law with a state z of its own: integral action, filters, observers.

    A subclass defines `start`, `__call__` and `rate`. The state is a pytree of arrays, or None for a law without state. With
    `takes_multipliers = True` the law also receives the multipliers lam (nc,) and has to be affine in them. The algebraic loop
    lam -> tau -> lam is then solved exactly, at the cost of one more evaluation of the dynamics per constraint row. A law that is
    not affine in lam can use filtered multipliers: a state with $\dot z = (\lambda - z)/T$.

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
        """State z at the start of the run, from the initial q (nq,), v (nv,) and t (s)."""
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
        """Generalised forces tau (nv,), N m or N."""

    def rate(
        self,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: PyTree,
        multipliers: Float[Array, " nc"] | None,
    ) -> PyTree:
        """Time derivative dz/dt, of the structure of z. `multipliers` (nc,) are those under the torque of this law."""
        return None

    def allowance(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, ""] | None:
        """Margin (), positive where the law can perform its task; None for a law without such a margin.

        A simulation ends where the margin falls to zero, with the code `control_singular`. The constrained laws of
        `jd.control` return their `regularity`, less a limit.
        """
        return None


class Sampled(eqx.Module):
    """A discrete controller: the law is called at the start and after every `period`, and its torque is held in between.

    It needs fixed steps (`stepsize`), of which a whole number fills a period. The last step of a run may be shorter.
    If a save point is a sampling instant, the outputs "torque" and "control_state" there are the values before or after the
    sample, depending on the rounding of the times. To read them, save between samples. The motion does not depend on that.

    **Arguments:**

    - `law`: law(q, v, t, state) -> (tau (nv,), state); with `state=None` law(q, v, t) -> tau, the form of the laws of
      `jd.control` without a state. The leaves of an equinox Module can be differentiated and batched.
    - `state`: initial state of the law, a pytree of arrays. The law returns a state of the same structure.
    - `period` (): sampling period, s, positive; a constant to derivatives.

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


if TYPE_CHECKING:
    Control = Callable[[Array, Array, Array], Array] | Controller | Sampled | None
else:
    Control = Any  # `as_control` checks it


def as_control(control: Control) -> Any:
    """Control as a pytree, so that its arrays are inputs of the compiled run. **Raises:** ValueError if it is not callable."""
    if control is None or isinstance(control, (Controller, Sampled)):
        return control
    return as_pytree(control, "control")


def fit_steps(control: Control, stepsize: Any) -> Any:
    """Length of the steps of a run: for a sampled law that of a whole number of them in a period, else as given.

    NaN for traced numbers that do not fit, which ends the run with the code `bad_stepsize`.

    **Raises:** ValueError for adaptive steps, and for known numbers that do not fit.
    """
    if not isinstance(control, Sampled):
        return stepsize
    if not isinstance(stepsize, (int, float, np.ndarray, jax.Array)):
        raise ValueError(
            "control is sampled, which takes fixed steps; pass stepsize=control.period, or a whole part of it"
        )
    known = is_concrete((control.period, stepsize))
    # Numpy where it can: each operation of JAX is a program of its own outside of a trace, and traced inside of one.
    xp = np if known else jnp
    period, step = xp.asarray(control.period), xp.asarray(stepsize)
    ratio = period / step
    count = xp.round(ratio)
    # The relative tolerance admits steps that were written with six digits, such as 0.000333333 for a third of 1e-3.
    fits = (ratio > 0.5) & (xp.abs(ratio - count) < 2e-6 * ratio)
    if known and not fits:
        raise ValueError(
            f"stepsize is {float(step):.6g} s, and the period of the sampled control "
            f"{float(period):.6g} s, which is {float(ratio):.6g} steps; take a whole part of it"
        )
    length = period / xp.maximum(count, 1)
    return length if known else jax.lax.stop_gradient(jnp.where(fits, length, jnp.nan))


def can_end(control: Control, q, v, t) -> bool:
    """Decide whether a control has an allowance, which may end the motion."""
    return isinstance(control, Controller) and eqx.filter_eval_shape(control.allowance, q, v, t) is not None


def check_control(scene: Scene, control: Control, q, v, t) -> None:
    """Check the shapes of a control's results by tracing one call of it, with the arguments that the integration passes.

    **Raises:** ValueError for a control that takes other arguments, shapes that do not fit, and states that change structure.
    """
    if isinstance(control, Sampled):
        signature, extra = ("law(q, v, t)", ()) if control.state is None else ("law(q, v, t, state)", (control.state,))
        check_callback(control.law, "control.law", signature, q, v, t, *extra)
        returned = eqx.filter_eval_shape(lambda *args: control.update(*args, _as_arrays(control.state, q)), q, v, t)  # pyright: ignore[reportCallIssue]
        if not (isinstance(returned, tuple) and len(returned) == 2):
            raise ValueError(f"control.law returned {returned!r}; return (tau, state)")
        check_force(jnp.zeros(jnp.shape(returned[0])), q, scene.nv, "control.law")
        _check_state(_as_arrays(control.state, q), returned[1], "control.law")
    elif isinstance(control, Controller):
        state = eqx.filter_eval_shape(control.start, q, v, t)
        state, count = jax.tree.map(lambda x: jnp.zeros(x.shape, q.dtype), state), _row_count(scene)
        lam = (jnp.zeros((count,), q.dtype),)
        check_callback(control, "control", "control(q, v, t, state)", q, v, t, state, *lam * control.takes_multipliers)
        if state is not None:
            check_callback(control.rate, "control.rate", "rate(q, v, t, state, multipliers)", q, v, t, state, *lam)
            _check_state(state, eqx.filter_eval_shape(control.rate, q, v, t, state, *lam), "control.rate")
    elif control is not None:
        check_callback(control, "control", "control(q, v, t)", q, v, t)


def initial_entries(control: Control, q, v, t) -> dict[str, Array]:
    """Initial values of the control's entries in the state of the equation; empty for a plain function."""
    if isinstance(control, Sampled):
        # The record has no samples yet, so that the first one is due at the start.
        start = jnp.concatenate([jnp.stack([t, jnp.zeros_like(t)]), jnp.zeros_like(v), _flat(control.state, q)])
        return {HELD: sample(control, start, q, v, t)}
    if isinstance(control, Controller) and (state := control.start(q, v, t)) is not None:
        return {STATE: _flat(state, q)}
    return {}


def sample(control: Sampled, held: Float[Array, " n"], q, v, t) -> Float[Array, " n"]:
    """Record of a sampled law after the step that ends at t: a new one if a sample is due, else `held` itself.

    Its entries are the start of the run (s), the number of samples, the torque (nv,), and the law's state as a vector.
    """
    start, count, _, state = _unpack(control, held, v)
    # Times of steps are sums with rounding errors. A sample that is due within 5e-7 of a period (float64; 2e-3 in float32) is
    # taken now: far above these errors, far below a step.
    slack = control.period.astype(t.dtype) * float(jnp.finfo(t.dtype).eps) ** 0.4
    due = t >= start + count * control.period.astype(t.dtype) - slack
    tau, state = control.update(q, v, t, state)
    tau = check_force(tau, q, v.shape[0], "control.law")
    fresh = jnp.concatenate([jnp.stack([start, count + 1]), tau, _flat(state, q)])
    # Trajectories of a batch need not sample at the same step: all compute the law, and those that are due take it.
    return jnp.where(due, fresh, held)


def torque(control: Control, scene: Scene, y, q, v, t, multipliers: Callable) -> Array | None:
    """Torque (nv,) of a control, None without a control. `multipliers`: tau (nv,) -> lam (nc,), of the constrained dynamics.

    `y` is the state of the equation, of which q and v are parts.
    """
    if control is None:
        return None
    if isinstance(control, Sampled):
        return _unpack(control, y[HELD], v)[2]
    if not isinstance(control, Controller):
        return check_force(control(q, v, t), q, scene.nv, "control")
    state = state_of(control, y, q, v, t)
    if not control.takes_multipliers:
        return check_force(control(q, v, t, state), q, scene.nv, "control")

    def torque_of(lam):
        return check_force(control(q, v, t, state, lam), q, scene.nv, "control")

    # lam = f(lam) for an affine f: f(lam) = f(0) + F lam, so (1 - F) lam = f(0). Redundant rows can make 1 - F singular. Any
    # solution will do, and the pseudo-inverse chooses the shortest.
    zero = jnp.zeros((_row_count(scene),), q.dtype)
    at_zero, apply_F = jax.linearize(lambda lam: multipliers(torque_of(lam)), zero)
    identity = jnp.eye(zero.shape[0], dtype=zero.dtype)
    matrix = identity - jax.vmap(apply_F, out_axes=1)(identity)
    return torque_of(matmul(pseudo_inverse(matrix, tolerance(None, matrix)), at_zero))


def rates(control: Any, y, q, v, t, multipliers: Callable) -> dict[str, Array]:
    """Time derivatives of the control's entries in the state. multipliers() returns lam (nc,) under the control's torque."""
    if HELD in y:
        return {HELD: jnp.zeros_like(y[HELD])}  # constant between samples
    if STATE not in y:
        return {}
    return {STATE: _flat(control.rate(q, v, t, state_of(control, y, q, v, t), multipliers()), q)}


def state_of(control: Any, y, q, v, t) -> Any:
    """State of the controller in its own structure, or None."""
    if HELD in y:
        return _unpack(control, y[HELD], v)[3]
    if STATE not in y:
        return None
    # Of the start only the structure is needed: by its shapes, the user's function is not computed again.
    like = eqx.filter_eval_shape(control.start, q, v, t)
    return ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, q.dtype), like))[1](y[STATE])


def at_start(control: Control, q, v, t) -> Any:
    """Control as a function (q, v, t) -> tau for a linearisation at this state (`stiff_rates`).

    The state of a controller is held at the value with which a run from here would start. None where tau is no function of
    (q, v, t): for a sampled law, and for a law that uses the multipliers.
    """
    if isinstance(control, Sampled):
        return None
    if not isinstance(control, Controller):
        return control
    if control.takes_multipliers:
        return None
    return _AtStart(control, control.start(jnp.asarray(q), jnp.asarray(v), jnp.asarray(t)))


class _AtStart(eqx.Module):
    """Controller whose state is held at its initial value."""

    control: Controller
    state: Any

    def __call__(self, q, v, t):
        return self.control(q, v, t, self.state)


def _row_count(scene: Scene) -> int:
    return layout(scene)[-1].end if scene.constraints else 0


def _as_arrays(state, q):
    return jax.tree.map(lambda x: jnp.asarray(x, state_dtype(None, q)), state)


def _flat(state, q) -> Array:
    """State of a law as one vector, in the dtype of q."""
    if state is None:
        return jnp.zeros((0,), q.dtype)
    return ravel_pytree(jax.tree.map(lambda x: jnp.asarray(x, q.dtype), state))[0]


def _unpack(control: Sampled, held, v):
    """Entries of the record `held`: start of the run, number of samples, torque, and the law's state in its own structure."""
    n = v.shape[0]
    state = None if control.state is None else ravel_pytree(_as_arrays(control.state, v))[1](held[2 + n :])
    return held[0], held[1], held[2 : 2 + n], state


def _check_state(state, returned, name: str) -> None:
    shapes = [jax.tree.map(jnp.shape, x) for x in (state, returned)]
    if shapes[0] != shapes[1]:
        raise ValueError(f"{name} returned a state of shapes {shapes[1]}, expected {shapes[0]}; keep its structure")
