"""Scenes: one system with its constraints and forces, and drives with a state. Only listed items are compiled."""

import abc
import functools
import inspect
import types
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxdyn.compile.known import is_concrete, is_tracing
from jaxdyn.model.arguments import Checked, Number, Numbers, SystemLike, as_array, batch_hint, check_state, check_system
from jaxdyn.model.description import scene_lines

if TYPE_CHECKING:
    Force = Callable[[Any, Array, Array, Array], Array]  # f(system, q, v, t) -> (nv,)
else:
    Force = Any  # `as_pytree` checks it

_FUNCTIONS = types.FunctionType, types.BuiltinFunctionType, types.MethodType, types.ModuleType, type, np.ufunc


class _Static(eqx.Module):
    """Plain function as a pytree without leaves, so that modules holding it pass through `jax.jit` and `jax.vmap`."""

    function: Callable = eqx.field(static=True)

    def __call__(self, *args):
        return self.function(*args)


class _Closure(eqx.Module):
    """Plain function with the traced values that it captures as leaves, so that they are differentiated and batched."""

    function: types.FunctionType = eqx.field(static=True)
    # By the number of the variable in the function's closure; None for leaves that are not traced.
    captured: dict[int, Any]

    def __call__(self, *args):
        cells: list[Any] = list(self.function.__closure__ or ())
        for i, value in self.captured.items():
            whole = value if isinstance(value, _Closure) else eqx.combine(value, cells[i].cell_contents)
            cells[i] = types.CellType(whole)
        old: Any = self.function
        new = types.FunctionType(old.__code__, old.__globals__, old.__name__, old.__defaults__, tuple(cells))
        new.__kwdefaults__ = old.__kwdefaults__
        return new(*args)


def _bind_tracers(function: types.FunctionType, callers: tuple[types.FunctionType, ...] = ()) -> _Closure | None:
    """The function as a pytree of the traced values it captures, also in functions that it captures; None without any."""
    captured = {}
    for i, cell in enumerate(function.__closure__ or ()):
        try:
            content = cell.cell_contents
        except ValueError:  # a variable without a value yet
            continue
        if isinstance(content, types.FunctionType):
            # Functions may call each other: what they capture is found once.
            known = (*callers, function)
            value = None if any(content is x for x in known) else _bind_tracers(content, known)
        else:
            value = None if is_concrete(content) else eqx.filter(content, lambda leaf: not is_concrete(leaf))
        if value is not None:
            captured[i] = value
    return _Closure(function, captured) if captured else None


def as_pytree(function: Any, argument: str, takes: str = "") -> Callable:
    """Convert a callable to a pytree: itself if it is one (an equinox Module, a `Partial`), else a static wrapper.

    A method of a pytree becomes a `Partial` that holds the pytree.

    A plain function is compared by identity: the same one gives the same compiled program, with the values it captured when
    it was traced; a new lambda in every call compiles a new program. Traced values that it captures become leaves.

    `takes` names the arguments of its calls, as "q, t".

    **Raises:** ValueError when `function` cannot be called, or not with these arguments, and for an object with attributes that
    is no pytree: the compiled program would keep their first values; `argument` names its origin.
    """
    if not callable(function):
        raise ValueError(f"{argument} is {function!r}, which cannot be called; pass a function or a callable Module")
    if takes:
        _check_call(function, argument, f"({takes})", takes.split(", "))
    if not jax.tree_util.all_leaves([function]):
        return function
    # A bound method hides its object; a Partial keeps the object's leaves visible to transformations.
    owner = function.__self__ if isinstance(function, types.MethodType) else function
    if owner is not function and not (isinstance(owner, type) or jax.tree_util.all_leaves([owner])):
        return jax.tree_util.Partial(function.__func__, owner)
    # A partial of a plain function holds no attributes that could change; what it wraps is what counts.
    while isinstance(owner, functools.partial):
        owner = owner.func
    names = _attributes(owner)
    if names:
        kind = type(owner).__name__
        what = f"a method of a {kind}" if isinstance(function, types.MethodType) else f"a {kind}"
        raise ValueError(
            f"{argument} is {what}, whose attributes ({', '.join(names)}) would keep the values of the first run in the "
            f"compiled program; make it an equinox Module (class {kind}(eqx.Module): with a field for each of them), or pass a "
            "new function for new values"
        )
    bound = _bind_tracers(function) if isinstance(function, types.FunctionType) else None
    return _Static(function) if bound is None else bound


def _attributes(owner: Any) -> list[str]:
    """Attribute names of an object that is no function, class or wrapper of a function."""
    # Wrappers such as `jax.jit` keep the wrapped function in `__wrapped__` and have attributes of their own.
    if isinstance(owner, _FUNCTIONS) or hasattr(owner, "__wrapped__"):
        return []
    # An object with __slots__ has no __dict__, and its attributes would be missed.
    slots = [name for kind in type(owner).__mro__ for name in np.atleast_1d(getattr(kind, "__slots__", ())).tolist()]
    names = [*getattr(owner, "__dict__", ()), *(name for name in slots if hasattr(owner, name))]
    return [name for name in names if not name.startswith("__")]


class Scene(eqx.Module):
    r"""System with the constraints and forces that act on it.

    $$M a + h = \tau + \tau_\mathrm{forces} + A^T \lambda$$

    **Arguments:**

    - `system`: a `Model`, or any other system with `nq` and `nv`.
    - `constraints`: sequence of constraints; empty by default.
    - `forces`: sequence of `f(system, q, v, t) -> (nv,)`, generalised forces (N m or N) that are added to tau. Those of
      the library (`JointDamping`, `JointSpring`, ...) and your own equinox Modules hold numbers as leaves, which
      `jax.grad` and `jax.vmap` reach. A plain function is static: define it once, outside of loops, and let it hold
      no arrays. An object with attributes that is no pytree is refused.
    - `cones`: friction cones of the contacts among the constraints: a `jd.contact.friction_cone(...)` or `surface_cone(...)`
      for all of them, a list with one for each, or a dictionary by the constraints' names, in which contacts
      without an entry stay two-sided. The rows do not change; `simulate` ends where a contact pulls or leaves its cone.

    **Raises:** ValueError when `system` is no system, or `constraints` or `forces` is not a sequence of callables; when
    used, for cones that do not fit the constraints.
    """

    system: Any
    constraints: tuple = ()
    forces: tuple = ()
    cones: Any = None
    # The rows of the constraints that count (`jaxdyn.constraints.redundancy.KeptRows`), None for all of them.
    kept_rows: Any = None

    def __init__(
        self,
        system: SystemLike,
        constraints: Checked[Sequence[Any]] = (),
        forces: Checked[Sequence[Force]] = (),
        cones: PyTree = None,
    ):
        check_system(system, "system")
        self.system = system
        self.constraints = _sequence(constraints, "constraints")
        # Static wrappers let plain functions pass through `jit` and `vmap` as part of the scene.
        self.forces = tuple(as_pytree(f, f"forces[{i}]") for i, f in enumerate(_sequence(forces, "forces")))
        self.cones = cones
        self.kept_rows = None

    def __str__(self) -> str:
        return scene_lines(self)

    @property
    def nq(self) -> int:
        """Number of configuration coordinates."""
        return self.system.nq

    @property
    def nv(self) -> int:
        """Number of velocity coordinates."""
        return self.system.nv

    @property
    def without_forces(self) -> "Scene":
        """The system with its constraints alone: what rows, projections and assembly depend on."""
        return Scene(self.system, self.constraints).with_kept_rows(self.kept_rows)

    def with_kept_rows(self, rows: Any) -> "Scene":
        """The scene with another choice of the rows that count, None for all of them."""
        if rows is self.kept_rows:
            return self
        return eqx.tree_at(lambda scene: scene.kept_rows, self, rows, is_leaf=lambda x: x is None)

    @property
    def rounding(self) -> float:
        """Size of the rounding of the system's poses (`Model.rounding`), 0 for exact ones."""
        # Of the system, so that a scene made of a file's system and other constraints or forces keeps it.
        return getattr(self.system, "rounding", 0.0)

    def applied_force(self, q: Numbers, v: Numbers, t: Number = 0.0) -> Float[Array, " nv"] | None:
        """Sum of the scene's forces (nv,) in N m or N, or None when it lists none.

        **Raises:** ValueError that names a force whose result is not (nv,), or an argument of another shape.
        """
        # None and not zeros: without forces nothing is added to tau, and nothing compiled for it.
        total = None
        # Forces cast their numbers to the dtype of q, which would round them to integers at a q of integers.
        state = at, _, _ = check_state(self.system, q=q, v=v, t=t)
        for i, force in enumerate(self.forces):
            value = check_force(force(self.system, *state), at, self.nv, f"forces[{i}]")
            total = value if total is None else total + value
        return total

    def clip_effort(self, tau: Numbers) -> Float[Array, " nv"]:
        """Torques tau (nv,) clipped by the scene's `EffortLimits`."""
        (clipped,) = check_state(self.system, tau=tau)
        for force in self.forces:
            cut = getattr(force, "clip_effort", None)
            # Limits act on the command in the order of the list, as in `drive_torque`.
            clipped = clipped if cut is None else cut(self.system, clipped)
        return clipped

    def drive_state(self, q: Numbers, v: Numbers, t: Number = 0.0) -> Float[Array, " n"] | None:
        """Start of the states of all `jd.forces.DriveDynamics` in the scene, one after the other (n,); None without any."""
        state = check_state(self.system, q=q, v=v, t=t)
        states = [force.start(self.system, *state) for force in self.forces if isinstance(force, DriveDynamics)]
        # None and not an empty array: scenes without drives integrate no state.
        return jnp.concatenate(states) if states else None

    def drive_torque(
        self,
        q: Numbers,
        v: Numbers,
        t: Number,
        command: Numbers,
        state: Float[Array, " n"] | None = None,
    ) -> tuple[Float[Array, " nv"], Float[Array, " n"] | None]:
        """Torques (nv,) at the joints for the commands of a control, and the rates of the drives' states (None without any).

        The scene's drives and effort limits act in the order of `forces`; `state` as of `drive_state`.
        """
        at, speed, time, torque = check_state(self.system, q=q, v=v, t=t, command=command)
        rates = []
        for force in self.forces:
            torque, rate, state = pass_command(force, self.system, at, speed, time, torque, state)
            rates += [] if rate is None else [rate]
        return torque, jnp.concatenate(rates) if rates else None


# Velocity coordinates from which on a scene with constraints is compiled with its numbers. The program of given numbers has six
# times the operations: between 16 and 40 windows, with 33 and 81 coordinates, it takes longer to compile than a user waits.
MIN_KNOWN_COORDINATES = 64


def is_given(scene: Scene) -> bool:
    """Decide whether a call outside of a trace takes the scene's numbers as arguments of its program, which serves others too."""
    is_large = bool(scene.constraints) and scene.nv >= MIN_KNOWN_COORDINATES
    return not is_tracing() and not (is_large and is_concrete(scene))


def has_drives(scene: Scene) -> bool:
    """Decide whether a scene has drives with a state."""
    return any(isinstance(force, DriveDynamics) for force in scene.forces)


def as_scene(scene: Any) -> Scene:
    """Convert a system to a scene without constraints and forces; a scene is returned unchanged."""
    return scene if isinstance(scene, Scene) else Scene(scene)


def check_force(value, q: Float[Array, " nq"], nv: int, argument: str) -> Float[Array, " nv"]:
    """Check that the result of a force or control callback is (nv,), and convert it to the dtype of q."""
    # A list of traced numbers is an array too.
    value = as_array(value, argument, q.dtype)
    if value.shape != (nv,):
        raise ValueError(f"{argument} returned shape {value.shape}, expected {(nv,)} = (nv,){batch_hint(value, (nv,))}")
    return value


def _check_call(function: Any, name: str, call: str, args: Sequence[Any]) -> None:
    """Refuse a function that cannot be called with so many arguments, `call` in words."""
    try:
        taken = inspect.signature(function.function if isinstance(function, _Static) else function)
    except (TypeError, ValueError):  # functions not written in Python have no signature
        return
    try:
        taken.bind(*args)
    except TypeError as error:
        raise ValueError(f"{name} takes {taken}, but is called as {call}; {error}") from None


def check_callback(function: Callable, name: str, signature: str, *args, first: tuple = ()) -> None:
    """Trace a user's function as the integration will; the leading arguments `first` stay concrete.

    **Raises:** ValueError for a function with other arguments, and for one that needs the values of its arguments.
    """
    _check_call(function, name, signature, (*first, *args))
    try:
        # Abstract evaluation finds branches on traced values before a long compilation fails with a message about the
        # loop.
        eqx.filter_eval_shape(lambda *args: function(*first, *args), *args)
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{name} needs the values of its arguments, which are traced; use jax.numpy instead of numpy and math, and "
            f"jnp.where or jax.lax.cond instead of if. {reason}"
        ) from error


def _sequence(items, argument: str) -> tuple:
    # A generator would be empty after the first use, and a single item may be iterable itself.
    if not isinstance(items, (tuple, list)):
        raise ValueError(f"{argument} is a {type(items).__name__}; pass a tuple or a list, e.g. {argument}=(item,)")
    return tuple(items)


# Drives between a control and the joints: torque laws with a state, and the chain of a scene's drives and limits.


class DriveDynamics(eqx.Module):
    r"""Base class of drives with a state z, between the command of a control and the torque at the joints.

    $$\tau = \mathrm{torque}(q, v, t, z, u), \quad \dot z = \mathrm{rate}(q, v, t, z, u)$$

    List one among the forces of a `Scene`. Drives and `jd.forces.EffortLimits` act in the order of the list, each on what the one
    before gives. `jd.simulate` integrates z with the motion; `jd.stepper` takes and returns it as a third entry of the
    state. Functions of one instant (`jd.constrained_dynamics`, `jd.inverse_dynamics`, ...) know torques at the joints alone.

    ```python
    class VoltageDrive(jd.forces.DriveDynamics):  # L di/dt = u - R i - k v, tau = k i
        inductance: jax.Array
        resistance: jax.Array
        constant: jax.Array

        def start(self, system, q, v, t):
            return jnp.zeros_like(v)

        def torque(self, system, q, v, t, state, command):
            return self.constant * state

        def rate(self, system, q, v, t, state, command):
            return (command - self.resistance * state - self.constant * v) / self.inductance
    ```
    """

    @abc.abstractmethod
    def start(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " n"]:
        """The state (n,) at the start of a motion."""

    @abc.abstractmethod
    def torque(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " n"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " nv"]:
        """Torque (nv,) behind the drive, N m or N."""

    @abc.abstractmethod
    def rate(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " n"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " n"]:
        """Rate of the state, (n,)."""

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        """Zeros (nv,): a drive acts on the command, not beside it."""
        return jnp.zeros_like(v)


def pass_command(force: Any, system: Any, q, v, t, command, state):
    """Torque (nv,) behind one force of a scene's list, the rate of its state or None, and the states of the forces after it."""
    if isinstance(force, DriveDynamics):
        # Shapes alone: the size of a drive's state needs no computation of its start.
        count = eqx.filter_eval_shape(force.start, system, q, v, t).shape[0]
        # The states of all drives form one vector, in the order of the scene's forces.
        own = state[:count]
        return (
            force.torque(system, q, v, t, own, command),
            force.rate(system, q, v, t, own, command),
            state[count:],
        )
    if hasattr(force, "clip_effort"):
        command = force.clip_effort(system, command, v=v)
    return command, None, state
