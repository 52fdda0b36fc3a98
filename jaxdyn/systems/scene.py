"""A scene: one system, the constraints on it and the forces in it. What it lists is all that is compiled."""

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

from jaxdyn.model.arguments import Checked, Number, SystemLike, as_array, batch_hint, check_system
from jaxdyn.model.description import scene_lines

if TYPE_CHECKING:
    Force = Callable[[Any, Array, Array, Array], Array]  # f(system, q, v, t) -> (nv,)
else:
    Force = Any  # `as_pytree` looks at it

_FUNCTIONS = types.FunctionType, types.BuiltinFunctionType, types.MethodType, types.ModuleType, type, np.ufunc


class _Static(eqx.Module):
    """A plain function as a pytree without leaves, so that what holds it can pass through `jax.jit` and `jax.vmap`."""

    function: Callable = eqx.field(static=True)

    def __call__(self, *args):
        return self.function(*args)


def as_pytree(function: Any, argument: str, takes: str = "") -> Callable:
    """The callable itself if it is a pytree (an equinox Module, a `jax.tree_util.Partial`), else a static wrapper of
    it. A method of a pytree becomes a `Partial` that holds the pytree.

    A plain function is compared by identity: the same one gives the same compiled program, with the numbers it read when
    it was traced; a lambda written anew in every call gives a new one.

    `takes` names the arguments that it is called with, as "q, t".

    **Raises:** ValueError when `function` cannot be called, or not with these arguments, and for an object with attributes that
    is no pytree: the compiled program would keep their first values; `argument` says where it came from.
    """
    if not callable(function):
        raise ValueError(f"{argument} is {function!r}, which cannot be called; pass a function or a callable Module")
    if takes:
        _check_arguments(function, argument, takes)
    if not jax.tree_util.all_leaves([function]):
        return function
    owner = function.__self__ if isinstance(function, types.MethodType) else function
    if owner is not function and not (isinstance(owner, type) or jax.tree_util.all_leaves([owner])):
        return jax.tree_util.Partial(function.__func__, owner)
    while isinstance(owner, functools.partial):
        owner = owner.func
    names = _attributes(owner)
    if names:
        kind = type(owner).__name__
        what = f"a method of a {kind}" if isinstance(function, types.MethodType) else f"a {kind}"
        raise ValueError(
            f"{argument} is {what}, whose attributes ({', '.join(names)}) would keep the values of the first run in the "
            f"compiled program; make it an equinox Module (class {kind}(eqx.Module): with a field for each of them), or pass a "
            "function that is written anew for new values"
        )
    return _Static(function)


def _attributes(owner: Any) -> list[str]:
    """Names of the attributes of an object that is no function, class or wrapper of a function."""
    if isinstance(owner, _FUNCTIONS) or hasattr(owner, "__wrapped__"):
        return []
    slots = [name for kind in type(owner).__mro__ for name in np.atleast_1d(getattr(kind, "__slots__", ())).tolist()]
    names = [*getattr(owner, "__dict__", ()), *(name for name in slots if hasattr(owner, name))]
    return [name for name in names if not name.startswith("__")]


class Scene(eqx.Module):
    """A system with the constraints and the forces that act on it: M a + h = tau + forces + A^T lam.

    **Arguments:**

    - `system`: a `Model`, or any other system with `nq` and `nv`.
    - `constraints`: sequence of constraints; empty by default.
    - `forces`: sequence of `f(system, q, v, t) -> (nv,)`, generalised forces (N m or N) that are added to tau. Those of
      the library (`JointDamping`, `JointSpring`, ...) and your own equinox Modules hold numbers as leaves, which
      `jax.grad` and `jax.vmap` reach. A plain function is static: define it once, outside of loops, and let it hold
      no arrays. An object with attributes that is no pytree is refused.
    - `cones`: what the contacts among the constraints can exert: a `jd.contact.friction_cone(...)` or `surface_cone(...)`
      for all of them, a list with one for each, or a dictionary by the constraints' names, which leaves those that it does
      not name two-sided. The rows stay as they are; `simulate` ends where a contact pulls or leaves its cone.

    **Raises:** ValueError when `system` is no system, or `constraints` or `forces` is not a sequence of callables; when
    used, for cones that do not fit the constraints.
    """

    system: Any
    constraints: tuple = ()
    forces: tuple = ()
    cones: Any = None

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
        self.forces = tuple(as_pytree(f, f"forces[{i}]") for i, f in enumerate(_sequence(forces, "forces")))
        self.cones = cones

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

    def applied_force(
        self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0
    ) -> Float[Array, " nv"] | None:
        """Sum of the scene's forces (nv,) in N m or N, or None when it lists none.

        **Raises:** ValueError that names a force whose result is not (nv,).
        """
        total = None
        for i, force in enumerate(self.forces):
            value = checked_force(force(self.system, q, v, t), q, self.nv, f"forces[{i}]")
            total = value if total is None else total + value
        return total

    def limited(self, tau: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """tau (nv,) as the scene's `EffortLimits` let it through."""
        for force in self.forces:
            cut = getattr(force, "limited", None)
            tau = tau if cut is None else cut(self.system, tau)
        return tau


def as_scene(scene: Any) -> Scene:
    """A scene as it is, and a system as the scene without constraints and forces."""
    return scene if isinstance(scene, Scene) else Scene(scene)


def checked_force(value, q: Float[Array, " nq"], nv: int, argument: str) -> Float[Array, " nv"]:
    """What a force or control callback returned, checked to be (nv,), in the dtype of q."""
    if jnp.shape(value) != (nv,):
        hint = batch_hint(value, (nv,))
        raise ValueError(f"{argument} returned shape {jnp.shape(value)}, expected {(nv,)} = (nv,){hint}")
    return as_array(value, argument, q.dtype)


def _check_arguments(function: Any, argument: str, takes: str) -> None:
    try:
        signature = inspect.signature(function.function if isinstance(function, _Static) else function)
    except (TypeError, ValueError):  # of what is not written in Python
        return
    try:
        signature.bind(*takes.split(", "))
    except TypeError as error:
        raise ValueError(f"{argument} takes {signature}, but is called as ({takes}); {error}") from None


def check_callback(function: Callable, name: str, signature: str, *args, first: tuple = ()) -> None:
    """Call a function of the user with traced numbers, as the integration will; those of `first`, in front, as they are.

    **Raises:** ValueError for a function of other arguments, and for one that needs the values of its arguments.
    """
    try:
        taken = inspect.signature(function.function if isinstance(function, _Static) else function)
    except (TypeError, ValueError):  # of what is not written in Python
        taken = None
    try:
        if taken is not None:
            taken.bind(*first, *args)
    except TypeError as error:
        raise ValueError(f"{name} takes {taken}, but is called as {signature}; {error}") from None
    try:
        eqx.filter_eval_shape(lambda *args: function(*first, *args), *args)
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{name} needs the values of its arguments, which are traced; take jax.numpy in place of numpy and math, and "
            f"jnp.where or jax.lax.cond in place of if. {reason}"
        ) from error


def _sequence(items, argument: str) -> tuple:
    if not isinstance(items, (tuple, list)):
        raise ValueError(f"{argument} is a {type(items).__name__}; pass a tuple or a list, e.g. {argument}=(item,)")
    return tuple(items)
