"""A rigid body without forces."""

from jaxtyping import Array

from jaxdyn.model.arguments import Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_leaf, as_state, register_scene
from jaxdyn.systems.scene import Scene


def _free_start(rates: Row = (0.3, 0.8, -0.5)) -> tuple[Array, Array]:
    return as_state([1.0, 0.0, 0.0, 0.0]), as_leaf(rates)


@register_scene(_free_start)
def free_body(*, moments: Row = (1.0, 2.0, 3.0)) -> Scene:
    """Rigid body that turns freely about its centre of mass: I w' = (I w) x w, by Jacobi's elliptic functions.

    q = (w, x, y, z), a unit quaternion, v = angular velocity in the body's axes, principal ones; `moments`, kg m^2.
    Start: turned by nothing, with body `rates` (rad/s).

    Source: Celledoni, Fasso, Safstrom & Zanna (2008), The exact computation of the free rigid body motion.
    """
    builder = ModelBuilder("free body", gravity=None)
    # The mass at the fixed point has no effect without gravity.
    builder.add_body("body", None, "spherical", (1.0, (0.0, 0.0, 0.0), tuple(moments)))
    return Scene(builder.build())
