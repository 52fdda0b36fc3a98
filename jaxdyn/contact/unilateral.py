"""Forces with modes: dry friction that sticks and slips, and unilateral contacts.

They are listed among the forces of a scene, but they are not functions of the state: at rest, friction balances the applied load,
whatever it is. `jd.simulate` therefore tracks the mode of each from event to event (`jaxdyn.simulation.hybrid`).
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import Constraint, Pfaffian
from jaxdyn.constraints.rolling import RollingSphere
from jaxdyn.model.arguments import (
    Checked,
    Function,
    Number,
    Numbers,
    SystemLike,
    as_array,
    as_number,
    check_body,
    check_name,
    check_new_name,
)
from jaxdyn.model.host_math import pose_leaf
from jaxdyn.systems.scene import Scene, as_pytree


class WithModes(eqx.Module):
    """Base class of forces with modes: sticking or slipping, closed or open."""

    name: eqx.AbstractVar[str]

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        """Refuse evaluation without a mode. **Raises:** ValueError."""
        raise ValueError(
            f"{type(self).__name__} {self.name!r} has modes, which jd.simulate tracks; for a force that is a function of the "
            "state use jd.forces.CoulombFriction, and for bilateral contacts constraints (jd.rolling_sphere)"
        )


class DryFriction(WithModes):
    r"""Coulomb friction that sticks and slips.

    $$|f| \le \mu_s N \text{ at rest}, \quad f = -\mu N w / |w| \text{ while it slides with velocity } w$$

    N is a number, a function, or the magnitude of a multiplier of the scene's constraints. In the last case friction changes the
    multiplier that causes it, and both are solved from the same equations.

    **Arguments:**

    - `coefficient`: mu while it slides; `static`: mu_s at rest, None for the same.
    - `normal`: N in newtons: a number; a function normal(system, q, v, t) -> (), which gives no friction where it is negative;
      or the name of a constraint with one row, or of a contact (its normal force).
    - `along`: the sliding velocity w: an index of v, a function A(q, t) -> (nv,) or (2, nv) with w = A v, or a constraint with
      one or two rows on velocities, such as `jd.Pfaffian(A, b)` for a moving belt.
    - `smoothing`: v_s, m/s. The force is then the function $-\mu N \tanh(|w|/v_s) w/|w|$ of the state, without modes. It
      never sticks: under a load F below $\mu N$ it creeps at $v_s \operatorname{artanh}(F/(\mu N))$. Above 2.65 v_s it is
      within 1 % of $\mu N$.
    - `name`: name of its events.

    **Raises:** ValueError for coefficients and normal forces that are negative, a static one below the other, an invalid
    index, a constraint on positions, and smoothing that is not positive.

    Source: EQUATIONS section 11 and erratum E42.

    ```python
    scene = jd.Scene(system, forces=[jd.contact.DryFriction(0.3, normal=9.81, along=0, static=0.4)])
    ```
    """

    coefficient: Float[Array, "..."]
    static: Float[Array, "..."]
    has_static: bool = eqx.field(static=True)
    normal: Any
    constraint: str | None = eqx.field(static=True)
    along: Constraint
    smoothing: Float[Array, "..."] | None
    name: str = eqx.field(static=True)

    def __init__(
        self,
        coefficient: Numbers,
        normal: Checked[Number | str | Function],
        along: Checked[int | Function | Constraint] = 0,
        *,
        static: Numbers | None = None,
        smoothing: Numbers | None = None,
        name: str = "friction",
    ):
        self.name = check_new_name(name, "friction", "DryFriction: name")
        self.coefficient, self.static = _coefficients(coefficient, static, f"DryFriction {name!r}")
        self.has_static = static is not None
        self.constraint = normal if isinstance(normal, str) else None
        if isinstance(normal, str):
            self.normal = None
        elif callable(normal):
            self.normal = as_pytree(normal, f"DryFriction {name!r}: normal")
        else:
            self.normal = jnp.asarray(as_array(normal, f"DryFriction {name!r}: normal"), float)
            if is_concrete(self.normal) and not (np.asarray(self.normal) >= 0).all():
                raise ValueError(
                    f"DryFriction {name!r}: normal is {normal}; give the size of the normal force (N), zero or more"
                )
        # True is an int in Python, and would select the second velocity.
        if isinstance(along, bool) or not (callable(along) or isinstance(along, (int, Constraint))):
            raise ValueError(
                f"DryFriction {name!r}: along is {along!r}; give an index of v, a function A(q, t) -> (nv,), or a constraint"
            )
        if isinstance(along, int):
            if along < 0:
                raise ValueError(f"DryFriction {name!r}: along is {along}; give an index of v, 0 or more")
            self.along = _Coordinate(index=along, name=name)
        else:
            self.along = along if isinstance(along, Constraint) else Pfaffian(along, name=name)
        what = f"DryFriction {name!r}: smoothing"
        self.smoothing = None if smoothing is None else jnp.asarray(as_array(smoothing, what), float)
        # A velocity, m/s.
        if is_concrete(self.smoothing) and self.smoothing is not None and not (np.asarray(self.smoothing) > 0).all():
            raise ValueError(f"{what} is {smoothing}; give a positive velocity (m/s), or None for friction that sticks")


class UnilateralContact(WithModes):
    r"""Unilateral contact with Coulomb friction: open, or closed and sticking or slipping.

    It closes by an impact. Without restitution the impulse is the least one, in the metric of the mass matrix, that prevents
    penetration and lies in the friction cone. With a coefficient of restitution e, the rate of the gap after the impact is at
    least -e times the rate before it (Newton's hypothesis, for each contact); restitution does not apply to friction. The
    contact opens where its normal force would become negative.

    **Arguments:**

    - `contact`: a constraint with one row for the gap (m, positive where the contact is open) and up to two rows for slip:
      `jd.rolling_sphere(...)` or `jd.rolling_wheel(...)`. `ground_contact` and `gap_contact` make such constraints.
    - `friction`: mu while it slides; `static`: mu at rest, None for the same.
    - `restitution`: e, from 0 to 1. Simultaneous impacts with friction could gain energy by Newton's hypothesis (Kane 1984): the
      coefficients of all contacts are then halved, until the impulses do no work. A body that bounces to rest has infinitely
      many impacts. A contact whose next flight would be lower than the tolerance (`atol`, or 4e-10 of a metre) is closed; the
      impulses of all impacts to come are those of the last one and of the forces at rest.
    - `name`: name of its events; by default that of the constraint.

    **Raises:** ValueError for an invalid contact or coefficients.
    """

    contact: Constraint
    coefficient: Float[Array, "..."]
    static: Float[Array, "..."]
    has_static: bool = eqx.field(static=True)
    restitution: Float[Array, "..."]
    name: str = eqx.field(static=True)

    def __init__(
        self,
        contact: Checked[Constraint],
        friction: Numbers = 0.0,
        *,
        static: Numbers | None = None,
        restitution: Numbers = 0.0,
        name: str | None = None,
    ):
        # `wrench_components` is None for a constraint that is no contact with a normal force.
        if not (isinstance(contact, Constraint) and contact.wrench_components() is not None):
            raise ValueError(
                f"UnilateralContact: contact is {contact!r}; give a constraint with a gap, as jd.rolling_sphere(...), or use "
                "jd.contact.ground_contact(body, point, friction=0.5)"
            )
        self.contact = contact
        self.name = check_new_name(name, contact.name, "UnilateralContact: name")
        owner = f"UnilateralContact {self.name!r}"
        self.coefficient, self.static = _coefficients(friction, static, owner)
        self.has_static = static is not None
        self.restitution = jnp.asarray(as_array(restitution, f"{owner}: restitution"), float)
        known = np.asarray(self.restitution) if is_concrete(self.restitution) else None
        if known is not None and not ((known >= 0) & (known <= 1)).all():
            raise ValueError(f"{owner}: restitution is {restitution}; give a number from 0 to 1")


def ground_contact(
    body: str,
    point: Numbers | None = None,
    friction: Numbers = 0.0,
    *,
    static: Numbers | None = None,
    restitution: Numbers = 0.0,
    radius: Numbers = 0.0,
    plane: Numbers | None = None,
    plane_body: str | None = None,
    name: str | None = None,
) -> UnilateralContact:
    """Unilateral contact of a point of a body, or a sphere on it, with the ground.

    **Arguments:**

    - `body`: name of a body or frame. `point` (3,): the contact point in its axes, m; None for its origin. `radius`: of a sphere
      about the point, m; 0 for the point itself.
    - `friction`, `static`, `restitution`: see `UnilateralContact`.
    - `plane`: pose of the ground in `plane_body` (None: the world), with its z axis as normal; by default the plane z = 0.

    **Raises:** ValueError for a bad pose, radius or coefficient; when used, for unknown bodies.

    ```python
    feet = [jd.contact.ground_contact(name, friction=0.7) for name in ("left_foot", "right_foot")]
    solution = jd.simulate(jd.Scene(robot, forces=feet), q0, v0, ts)
    ```
    """
    name = check_new_name(name, f"{body} on the ground")
    # A point is a sphere of radius zero, and a rolling sphere has the rows of gap and slip.
    contact = RollingSphere(
        name=name,
        body=check_name(body, f"ground_contact {name!r}: body"),
        surface_body=check_body(plane_body, f"ground_contact {name!r}: plane_body"),
        pose=pose_leaf(point, f"ground_contact {name!r}: point"),
        surface=pose_leaf(plane, f"ground_contact {name!r}: plane"),
        radius=as_number(radius, f"ground_contact {name!r}: radius", "m", zero=True, like=float),
        contact=True,
    )
    return UnilateralContact(contact, friction, static=static, restitution=restitution, name=name)


def gap_contact(
    gap: Function,
    along: Function | None = None,
    friction: Numbers = 0.0,
    *,
    static: Numbers | None = None,
    restitution: Numbers = 0.0,
    name: str = "contact",
) -> UnilateralContact:
    """Unilateral contact given by functions of the coordinates, also for systems without bodies.

    **Arguments:**

    - `gap`: gap(q, t) -> () in m, positive where the contact is open; differentiable twice.
    - `along`: A(q, t) -> (nv,) or (2, nv): the sliding velocity is A v, m/s; None without friction.
    - `friction`, `static`, `restitution`: see `UnilateralContact`. `name`: name of its events.

    **Raises:** ValueError for invalid functions and coefficients; when used, for shapes that do not fit.

    ```python
    stop = jd.contact.gap_contact(lambda q, t: 0.5 - q[0], restitution=0.3, name="stop")
    ```
    """
    name = check_new_name(name, "contact", "gap_contact: name")
    rows = None if along is None else as_pytree(along, f"gap_contact {name!r}: along")
    contact = _Gap(gap=as_pytree(gap, f"gap_contact {name!r}: gap"), along=rows, name=name)
    return UnilateralContact(contact, friction, static=static, restitution=restitution, name=name)


def has_modes(scene: Scene) -> bool:
    """Decide whether a scene has forces with modes."""
    return any(isinstance(force, WithModes) for force in scene.forces)


class _Coordinate(Constraint):
    """Constraint row that selects one velocity coordinate."""

    index: int = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def velocity(self, system, q, v, t):
        if self.index >= v.shape[0]:
            raise ValueError(f"DryFriction {self.name!r}: along is {self.index}, but the system has nv = {v.shape[0]}")
        return v[self.index : self.index + 1]


class _Gap(Constraint):
    """Contact given by its gap and sliding directions."""

    gap: Any
    along: Any
    name: str = eqx.field(static=True)

    def wrench_components(self):
        """No components: the contact has a normal force, but no frame in space in which a wrench could be given."""
        return ()

    def position(self, system, q, t):
        gap = as_array(self.gap(q, t), f"contact {self.name!r}: gap", q.dtype)
        if gap.shape != ():
            raise ValueError(f"contact {self.name!r}: gap returned shape {gap.shape}; return one number (m), ()")
        return gap[None]

    def velocity(self, system, q, v, t):
        return None if self.along is None else Pfaffian(self.along, name=self.name).velocity(system, q, v, t)


def _coefficients(sliding: Any, static: Any, owner: str):
    """Check sliding and static coefficients and convert them to leaves."""
    given = {"friction": sliding, "static": sliding if static is None else static}
    coefficients = [jnp.asarray(as_array(x, f"{owner}: {name}"), float) for name, x in given.items()]
    if is_concrete(coefficients):
        mu, mu_s = (np.asarray(x) for x in coefficients)
        if not (np.isfinite(mu).all() and (mu >= 0).all() and np.isfinite(mu_s).all() and (mu_s >= mu).all()):
            raise ValueError(f"{owner}: friction is {mu} and static {mu_s}; give 0 <= friction <= static")
    return coefficients
