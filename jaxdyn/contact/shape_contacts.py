r"""Contacts of shapes with ground and with each other, as functions of the relative pose of their bodies.

On a plane with normal n, the feature of a shape with the extreme point s(-n) has the gap n . s(-n). On uneven ground
z = f(x, y) a feature faces the ground at a point u = (x, y), with the normal n(u), if its extreme point s(-n(u)) is above u.
The gap is then

    gap = n_z (s_z - f(s_x, s_y)),   s = s(-n(u)),   u = (s_x, s_y).

It is zero where the feature touches, has the rate of the distance there, and differs from the distance by the square of the
gap times the curvature. Of a corner s does not depend on n, and the gap is a closed form. Otherwise u is found by Newton's
method on Taylor polynomials of third order. The last two steps are differentiated: they have the derivatives of the solution up
to third order, of which a step through contacts and its derivatives take two, and events three.

Balls touch spheres, capsules and boxes in the direction of the closest point (`shapes.outward`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.constraints.rolling import Touching, TouchingPoint, tangents
from jaxdyn.contact.contact_equations import inverse_2x2
from jaxdyn.contact.height_field import HeightField
from jaxdyn.contact.shapes import Ball, Box, Capsule, ConvexHull, Feature, LowestCorner, features_of, outward
from jaxdyn.contact.surfaces import Plane, Sphere
from jaxdyn.contact.unilateral import UnilateralContact
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Numbers, check_body, pose_leaf
from jaxdyn.model.numbers import check_count

_EXPANSIONS = 3  # Taylor polynomials of uneven ground, each about the point of the one before


class ShapeContact(Touching):
    """Contact of a feature of a shape with ground or another shape; built by `jd.contact.shape_contacts`."""

    feature: Feature
    on: eqx.Module

    def structure_key(self) -> tuple:
        """Kinds of the feature and the ground, and the shapes of their numbers."""
        leaves, structure = jax.tree.flatten((self.feature, self.on))
        return structure, tuple(x.shape for x in leaves)

    def touching(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> TouchingPoint:
        """The contact for the pose of the shape seen from the ground."""
        up = jnp.asarray([0.0, 0.0, 1.0], p.dtype)
        if isinstance(self.on, Plane):
            point = self.feature.support(R, p, -up)
            # Constant directions, which saves their derivatives.
            return TouchingPoint(point, up, point[2], jnp.eye(2, 3, dtype=p.dtype))
        if isinstance(self.on, HeightField):
            point = self._extreme_point(R, p)
            # The polynomial is about a constant place: derivatives up to third order are those of the field.
            field = self.on.expand(jax.lax.stop_gradient(point[:2]))
            normal = field.normal(point[:2])
            return TouchingPoint(point, normal, normal[2] * (point[2] - field.height(point[:2])), tangents(normal))
        assert isinstance(self.feature, Ball)
        normal, distance = outward(self.on, self.feature.centre(R, p))
        point = self.feature.support(R, p, -normal)
        gap = distance if self.feature.radius is None else distance - self.feature.radius.astype(p.dtype)
        return TouchingPoint(point, normal, gap, tangents(normal))

    def _extreme_point(self, R, p) -> Array:
        """Point (3,) of the feature that faces the ground."""
        on, feature, centre = self.on, self.feature, self.feature.centre(R, p)
        assert isinstance(on, HeightField)
        if isinstance(feature, Ball) and feature.radius is None:
            return centre
        start = centre[:2]
        if not feature.is_smooth:
            # The extreme point of a rim jumps around it: the normal below its centre decides.
            return feature.support(R, p, -on.expand(jax.lax.stop_gradient(start)).normal(start))
        u = jax.lax.stop_gradient(start)
        for i in range(_EXPANSIONS):
            field = on.expand(u)

            def facing(u, field=field):
                return feature.support(R, p, -field.normal(u))

            # Two steps, whose error is that of the expansion: of fourth order in its distance.
            u = _newton_step(facing, _newton_step(facing, u))
            if i < _EXPANSIONS - 1:
                u = jax.lax.stop_gradient(u)
        return facing(u)


def _newton_step(facing, u):
    """Step of Newton's method towards u = (x, y) of facing(u)."""

    def residual(u):
        return u - facing(u)[:2]

    J, value = jax.jacfwd(residual)(u), residual(u)
    # In a valley narrower than the feature there are two such points, and in between the matrix is singular.
    is_regular = jnp.abs(J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]) > 1e-3
    return u - jnp.where(is_regular, matmul(inverse_2x2(J, is_regular), value), value)


def shape_contacts(
    body: str,
    shape: Checked[eqx.Module],
    pose: Numbers | None = None,
    *,
    on: Checked[eqx.Module] | None = None,
    surface: Numbers | None = None,
    surface_body: str | None = None,
    friction: Numbers = 0.0,
    static: Numbers | None = None,
    restitution: Numbers = 0.0,
    lowest: int | None = None,
    name: str | None = None,
) -> tuple[UnilateralContact, ...]:
    r"""Unilateral contacts of a shape on a body with ground, or of a sphere with a shape.

    | shape                                  | contacts on a plane or uneven ground                                       |
    |----------------------------------------|----------------------------------------------------------------------------|
    | `Sphere(radius)`                       | 1                                                                          |
    | `Ellipsoid(semi_axes)`                 | 1                                                                          |
    | `Capsule(radius, length)`              | 2: the balls at its ends                                                   |
    | `Box(size)`                            | 8: its corners                                                             |
    | `ConvexHull(vertices)`                 | its vertices                                                               |
    | `Cylinder(radius, length)`             | 8: on each rim the lowest point, and three that are fixed at 0 and 120 degrees |

    On a plane the least gap is the exact distance. Of a cylinder it is exact where its axis is more than 1e-3 rad from the
    normal, and upright; between, the lowest point moves from the rim to the axis, by up to 2e-4 of the radius above the rim.
    On uneven ground (`HeightField`) gaps have the sign and the rates of the distance, and differ from it by their square times
    the curvature. Spheres, capsules and ellipsoids must be smaller there than the radius of curvature of valleys, and edges and
    faces between corners are not looked at. The lowest point of a rim is that of the plane below its centre.

    A sphere also touches a `Sphere`, a `Capsule` or a `Box` in its closest point. There the gap has kinks where that
    point is not unique (inside a box between faces; at the centre of a sphere and on the axis of a capsule, where the normal is
    x), with the derivatives of one side.

    **Arguments:**

    - `body`: name of the body or frame that carries the shape; `pose`: of the shape in it: None, (4, 4), (3,) or (xyz, rpy).
    - `shape`: see the table; `on`: `Plane()` (default), a `HeightField`, or for a sphere a `Sphere`, `Capsule` or `Box`.
    - `surface`: pose of `on` in `surface_body` (None: the world), with the z axis of a plane and of uneven ground as their
      normal; by default the identity.
    - `friction`, `static`, `restitution`: see `UnilateralContact`.
    - `lowest`: of a `Box` or a `ConvexHull` on a `Plane`, so many contacts at the most, in the corners that are lowest: others as
      the shape turns. For `jd.stepper`, whose cost grows with the number of contacts; `simulate` refuses them. Four are all
      that touch of a box, one is a pointed foot. Of more corners that are equally low four carry in a step, and others in the
      next one. None: a contact for each corner.
    - `name`: of the contact, or of several with a number behind it; by default "BODY SHAPE".

    **Returns:** the contacts, to be listed among the forces of a scene. Their forces are the normal force and the friction along
    two tangents: x and y of a plane; elsewhere those of Duff et al. (2017).

    **Raises:** ValueError for pairs that are not listed here, `lowest` of others than corners on a plane, a Cylinder
    without a length, a `HeightField` that is not smooth with anything but corners and rims, a bad pose or coefficient; when
    used, for unknown bodies.

    ```python
    ground = jd.contact.shape_contacts("body", jd.contact.Box((0.3, 0.2, 0.1)), friction=0.6, name="box")
    ```
    """
    on = Plane() if on is None else on
    kind = type(shape).__name__
    name = f"{body} {kind.lower()}" if name is None else name
    features = _check_pair(shape, on, name)
    if lowest is not None:
        features = _lowest_corners(shape, on, features, lowest, name)
    place, ground = pose_leaf(pose, f"{name!r}: pose"), pose_leaf(surface, f"{name!r}: surface")
    contacts = []
    for i, feature in enumerate(features):
        own = name if len(features) == 1 else f"{name} {i}"
        touching = ShapeContact(
            name=own,
            body=body,
            surface_body=check_body(surface_body, "shape_contacts: surface_body"),
            pose=place,
            surface=ground,
            feature=feature,
            on=on,
            contact=True,
        )
        contacts.append(UnilateralContact(touching, friction, static=static, restitution=restitution, name=own))
    return tuple(contacts)


def _check_pair(shape, on, name: str) -> tuple[Feature, ...]:
    """Features of a shape in contact. **Raises:** ValueError for a pair without contacts."""
    try:
        features = features_of(shape)
    except ValueError as error:
        raise ValueError(f"shape_contacts {name!r}: {error}") from None
    pair = f"shape_contacts {name!r}: a {type(shape).__name__} on a {type(on).__name__}"
    if isinstance(on, (Sphere, Capsule, Box)):
        if not isinstance(shape, Sphere):
            swap = "; exchange them" if isinstance(on, Sphere) and isinstance(shape, (Capsule, Box)) else ""
            raise ValueError(f"{pair} has no contacts here; only a Sphere touches a Sphere, Capsule or Box{swap}")
    elif isinstance(on, HeightField):
        is_round = any(f.is_smooth and not (isinstance(f, Ball) and f.radius is None) for f in features)
        if is_round and not on.smooth:
            raise ValueError(
                f"{pair} with smooth=False has edges, on which a round shape has two contacts; set smooth=True"
            )
    elif not isinstance(on, Plane):
        raise ValueError(f"{pair} has no contacts here; on is a Plane, HeightField, Sphere, Capsule or Box")
    return features


def _lowest_corners(shape, on, features: tuple[Feature, ...], lowest: int, name: str) -> tuple[Feature, ...]:
    """Features of the lowest corners, or all features where they are not more. **Raises:** ValueError."""
    check_count(lowest, f"shape_contacts {name!r}: lowest")
    if not (isinstance(shape, (Box, ConvexHull)) and isinstance(on, Plane)):
        raise ValueError(
            f"shape_contacts {name!r}: lowest is {lowest}, for a {type(shape).__name__} on a {type(on).__name__}; it is for a "
            "Box or a ConvexHull on a Plane"
        )
    corners = jnp.stack([feature.place for feature in features if isinstance(feature, Ball)])
    return tuple(LowestCorner(corners, k) for k in range(lowest)) if lowest < len(features) else features
