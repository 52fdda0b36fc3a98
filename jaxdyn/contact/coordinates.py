"""Contact coordinates of two surfaces from the relative pose of their bodies, the inverse of `relative_pose`.

For spheres and planes the closest points are known in closed form. Those of other surfaces come from Newton's method
(`touching`), with its last two steps differentiated, which gives derivatives up to the third order.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.compile import invalidate_derivatives
from jaxdyn.constraints.rank import eps_of
from jaxdyn.contact.surfaces import Plane, Sphere, Surface, check_surface, geometry_at
from jaxdyn.contact.touching import newton_steps, patch_at
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers
from jaxdyn.model.numbers import as_float

# Newton steps without derivatives, and with them: two of these give exact derivatives up to the third order.
_ROUNDS, _DIFFERENTIATED = 12, 2


def contact_coordinates(surface_o: Surface, surface_f: Surface, pose: Numbers) -> Float[Array, "5"]:
    """Contact coordinates eta (5,) of the closest points of two surfaces.

    Touching surfaces are in contact there. For others these are the points with opposite normals on one line, and
    `relative_pose(surface_o, surface_f, eta)` is the given pose translated along that line. Both charts must have a
    frame there, and the surfaces one such pair of points (`ContactKinematics.strict`).

    **Arguments:**

    - `surface_o`, `surface_f`: of the object and of the finger, each in its body's frame, with outward normals.
    - `pose` (4, 4): of the finger's frame in the object's, m.

    **Returns:** eta = (u_o, v_o, u_f, v_f, psi) (5,), in the units of the charts and rad; differentiable three times. NaN where
    the search for the closest points did not converge, or found no such pair.

    **Raises:** ValueError for an invalid surface, a pose of another shape, two planes, and a `Parametrised` surface, whose
    closest points are not known.

    ```python
    ball, tip = jd.contact.Sphere(0.1), jd.contact.Sphere(0.02)
    pose = jd.contact.relative_pose(ball, tip, jnp.array([0.1, 0.2, 0.3, 0.4, 0.5]))
    eta = jd.contact.contact_coordinates(ball, tip, pose)
    ```

    Source: Murray, Li & Sastry (1994), section 5.6.2; EQUATIONS section 8.
    """
    pose = as_float(pose, "pose", (4, 4))
    for surface in (surface_o, surface_f):
        check_surface(surface)
    if isinstance(surface_o, Plane) and isinstance(surface_f, Plane):
        raise ValueError("surface_o and surface_f are both planes, which do not touch in one point")
    R, p = pose[:3, :3], pose[:3, 3]
    # Initial points: opposite to a plane's normal, for others along the line of the frames' origins.
    place_o = surface_o.toward(-R[:, 2] if isinstance(surface_f, Plane) else p)
    # R e_z is the normal of the finger's plane in the object's axes, R^T e_z that of the object's plane in the finger's.
    place_f = surface_f.toward(-R[2] if isinstance(surface_o, Plane) else -matmul(p, R))
    if place_o is None or place_f is None:
        which = surface_o if place_o is None else surface_f
        raise ValueError(
            f"surface {type(which).__name__} does not give its closest point to another point; use a Sphere, Ellipsoid, "
            "Plane or Cylinder"
        )
    is_found = jnp.asarray(True)
    if not all(isinstance(surface, Sphere | Plane) for surface in (surface_o, surface_f)):
        place_o, place_f, is_found = _by_newton(surface_o, surface_f, R, p, (place_o, place_f))
    elif isinstance(surface_o, Sphere) and isinstance(surface_f, Sphere):
        # Every point of concentric spheres is as close as any other.
        is_found = (p != 0).any()
    at_o, at_f = surface_o.coordinates_at(place_o), surface_f.coordinates_at(place_f)
    frame_o, frame_f = geometry_at(surface_o, at_o).frame, geometry_at(surface_f, at_f).frame
    # R_psi = [cos psi, -sin psi; -sin psi, -cos psi]: its first row gives psi.
    turn = matmul(frame_o.T, matmul(R, frame_f))
    eta = jnp.concatenate([at_o, at_f, jnp.arctan2(-turn[0, 1], turn[0, 0])[None]])
    eta = jnp.where(is_found, eta, jnp.full_like(eta, jnp.nan))
    return invalidate_derivatives(eta, ~is_found, (surface_o, surface_f, pose))


def _by_newton(surface_o: Surface, surface_f: Surface, R, p, places):
    """Places of the closest points, and whether they were found."""

    def step(R, p, places):
        steps = newton_steps(patch_at(surface_o, places[0]), patch_at(surface_f, places[1]), R, p)
        return surface_o.displace(places[0], steps.on_a), surface_f.displace(places[1], steps.on_b)

    # Converged points are constants for differentiation; the last steps restore their derivatives (implicit function
    # theorem).
    constants = lax.stop_gradient((R, p))
    places = lax.fori_loop(0, _ROUNDS, lambda _, places: step(*constants, places), lax.stop_gradient(places))
    for _ in range(_DIFFERENTIATED - 1):
        places = step(R, p, places)
    last = newton_steps(patch_at(surface_o, places[0]), patch_at(surface_f, places[1]), R, p)
    # The last step of a search that has converged is rounding. Steps are zero, too, where the normals do not face each other or
    # the relative curvature is not positive.
    size = jnp.max(jnp.abs(jnp.concatenate(lax.stop_gradient((last.on_a, last.on_b)))))
    is_found = last.is_strict & (size <= eps_of(p) ** 0.6 * (1 + jnp.max(jnp.abs(lax.stop_gradient(p)))))
    return surface_o.displace(places[0], last.on_a), surface_f.displace(places[1], last.on_b), is_found
