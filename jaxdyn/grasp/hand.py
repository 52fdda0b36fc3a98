"""Grasps: one model of the fingers and the object, with the contacts between them as constraints."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import Pfaffian, constraint_jacobian, layout
from jaxdyn.constraints.rank import pseudo_inverse, tolerance
from jaxdyn.contact.cones import Cones
from jaxdyn.contact.forces import contacts_with_cones
from jaxdyn.grasp.contacts import on_object
from jaxdyn.lie.so3 import matmul
from jaxdyn.model import host_math
from jaxdyn.model.arguments import Checked, Numbers, as_array, batch_hint
from jaxdyn.model.joining import join_all
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Force, Scene


class Grasp(Scene):
    r"""Grasp of an object by fingers: a scene whose multipliers are contact forces on the object.

    $$A = \begin{bmatrix} -J_h & G^T \end{bmatrix}, \quad J_h \dot\theta = G^T V$$

    It is a `Scene`, so `constrained_dynamics`, `assemble`, `projections` and `simulate` act on it as on any other one.
    For motion in the velocity of the object alone, with the joints of the fingers recovered from these rows:

        jd.simulate(grasp, q0, v0, ts, method=jd.Reduced(grasp.object_velocities))

    **Arguments:**

    - `fingers`: a `Model` of the hand, or a list of models that stand in the same world, one per finger.
    - `object`: a `Model` of one body, on a joint (free, planar, or whatever holds it) to the world; or the name of such
      a body that `fingers` has already. Models are joined into one, `grasp.system`; the order of its trees is that of
      the names of their first joints.
    - `contacts`: `contact(...)` for contacts fixed on the object; `jd.rolling_sphere` and `jd.rolling_wheel` between a
      finger and the object, either of which may be the one that rolls: compression is a positive normal force; other
      constraints of the library.
    - `forces`, `cones`: as of a `Scene`. Without cones contacts are bilateral.

    **Raises:** ValueError for incompatible models, an object that is no single body of its own, or whose inertia
    is not positive definite, an empty list of contacts, contacts with bodies or frames that the models do not have, contacts
    that prescribe a slip, and cones of other sizes than their contacts.

    Source: Murray, Li & Sastry (1994), sections 5.5 and 6.3; EQUATIONS section 10.
    """

    object: str = eqx.field(static=True, kw_only=True)

    def __init__(
        self,
        fingers: Model | Sequence[Model],
        object: Model | str,
        contacts: Sequence,
        forces: Checked[Sequence[Force]] = (),
        cones: Cones = None,
    ):
        # One model of all bodies: only then object and fingers have common rows A and one mass matrix.
        models = [fingers] if isinstance(fingers, Model) else list(fingers)
        if not models or not all(isinstance(model, Model) for model in models):
            raise ValueError("fingers is no Model and no list of Models; pass what carries the fingertips")
        if isinstance(object, Model):
            if object.nb != 1:
                raise ValueError(f"object has {object.nb} bodies, {list(object.body_names)}; pass a Model of one body")
            models, object = [*models, object], object.body_names[0]
        model = models[0] if len(models) == 1 else join_all(models, f"grasp of {object}")
        _check_object(model, object)
        if not isinstance(contacts, (tuple, list)) or not contacts:
            raise ValueError(f"contacts is {contacts!r}; pass a list with at least one contact")
        for one in contacts:
            # J_h thetadot = G^T V has no right-hand side: a prescribed slip would need one in all equations of the grasp.
            if isinstance(one, Pfaffian) and one.b is not None:
                raise ValueError(f"contact {one.name!r} prescribes a slip b; contacts of a grasp have none")
        super().__init__(model, tuple(on_object(one, object) for one in contacts), forces, cones)
        self.object = object
        layout(self)  # refuses unknown bodies
        if cones is not None:
            contacts_with_cones(self)  # refuses cones that do not fit

    @property
    def object_velocities(self) -> tuple[int, ...]:
        """Indices of the object's velocity in v; for a free body its body twist."""
        top = self.system.topology
        place = top.v_slices[top.body_names.index(self.object)]
        return tuple(range(place.start, place.stop))

    @property
    def hand_velocities(self) -> tuple[int, ...]:
        """Indices of the joint velocities thetadot of all fingers in v."""
        return tuple(i for i in range(self.nv) if i not in self.object_velocities)


def hand_jacobian(grasp: Grasp, q: Float[Array, " nq"], t: Numbers = 0.0) -> Float[Array, "nc nh"]:
    """Hand Jacobian (nc, nh), which maps joint velocities to fingertip velocities along the contacts' components.

    Source: Murray, Li & Sastry (1994), eq. 5.28; EQUATIONS section 10.
    """
    check_grasp(grasp)
    return -_columns(grasp, q, t, grasp.hand_velocities)


def grasp_map(grasp: Grasp, q: Float[Array, " nq"], t: Numbers = 0.0) -> Float[Array, "no nc"]:
    r"""Grasp map (no, nc), which maps contact forces to their generalised force on the object.

    $$G = \begin{bmatrix} \mathrm{Ad}_{g_{oc_1}}^{-T} B_1 & \mathrm{Ad}_{g_{oc_2}}^{-T} B_2 & \cdots \end{bmatrix}$$

    for a free body, where $G \lambda$ is the wrench (f, tau) at the origin and in the axes of the body frame. $G^T V$ are the
    velocities of the object at the contacts.

    Source: Murray, Li & Sastry (1994), eq. 5.11; EQUATIONS section 10.
    """
    check_grasp(grasp)
    return _columns(grasp, q, t, grasp.object_velocities).T


@entry_point
def _columns(grasp: Grasp, q, t, columns: tuple[int, ...]) -> Float[Array, "nc k"]:
    return constraint_jacobian(grasp, q, t)[:, np.array(columns, int)]


def internal_forces(
    grasp: Grasp, q: Float[Array, " nq"], lam: Float[Array, " nc"], t: Numbers = 0.0
) -> Float[Array, " nc"]:
    r"""Internal part of contact forces, which does not move the object.

    $$\lambda_N = (1 - G^+ G) \lambda, \quad G \lambda_N = 0$$

    The split depends on the units of forces and torques where contacts transmit both, as any orthogonal one.

    **Arguments:** `lam` (nc,), contact forces, N and N m.

    Source: Murray, Li & Sastry (1994), sections 5.3 and 6.3; EQUATIONS section 10.
    """
    G = grasp_map(grasp, q, t)
    lam = as_array(lam, "lam", G.dtype)
    if lam.shape != G.shape[1:]:
        raise ValueError(
            f"lam has shape {lam.shape}, expected {G.shape[1:]}, one per row of the grasp{batch_hint(lam, (1,))}"
        )
    # G lam first: the projection matrix (nc, nc) is never formed.
    return lam - matmul(pseudo_inverse(G, tolerance(None, G)), matmul(G, lam))


def check_grasp(grasp) -> None:
    """Refuse anything but a `Grasp`."""
    if not isinstance(grasp, Grasp):
        raise ValueError(f"grasp is a {type(grasp).__name__}; pass a jd.grasp.Grasp")


def _check_object(model: Model, name: str) -> None:
    top = model.topology
    if name not in top.body_names:
        raise ValueError(f"object {name!r} is no body of model {model.name!r}; bodies are {list(top.body_names)}")
    body = top.body_names.index(name)
    # G and J_h are columns of A: they separate object and fingers only if no joint carries both.
    if top.parents[body] >= 0 or body in top.parents:
        raise ValueError(f"object {name!r} is part of a tree of bodies; give it a joint to the world and no children")
    if top.nb == 1:
        raise ValueError(f"there are no fingers beside the object {name!r}; pass their models")
    if is_concrete(model.inertias):
        # Coordinates of the spatial inertia that the joint's velocities see; other joints get no inertia check.
        moved = {"free": range(6), "planar": (0, 1, 5)}.get(top.kinds[body], ())
        matrix = host_math.spatial_inertia(np.asarray(model.inertias, float)[body])[np.ix_(moved, moved)]
        if len(moved) and not (least := np.linalg.eigvalsh(matrix)[0]) > 0:
            raise ValueError(
                f"inertia of the object {name!r} is not positive definite: the least eigenvalue of its spatial inertia is "
                f"{least:.3g}; give it a mass and an inertia about every axis, as from jd.inertia.box(mass, size)"
            )
