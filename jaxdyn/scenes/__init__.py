"""Named systems with known motions: `jd.scenes.<name>(**parameters)` is a `Scene`, `.start()` the reference's start."""

from jaxdyn.scenes._named import REGISTRY as _REGISTRY
from jaxdyn.scenes._named import NamedScene as NamedScene
from jaxdyn.scenes.linkages import four_bar as four_bar
from jaxdyn.scenes.linkages import slider_crank as slider_crank
from jaxdyn.scenes.linkages import windows as windows
from jaxdyn.scenes.particles import pendulum_in_plane as pendulum_in_plane
from jaxdyn.scenes.particles import spherical_pendulum as spherical_pendulum
from jaxdyn.scenes.reference import andrews as andrews
from jaxdyn.scenes.reference import car_axis as car_axis
from jaxdyn.scenes.rolling import ball_on_turntable as ball_on_turntable
from jaxdyn.scenes.rolling import chaplygin_sleigh as chaplygin_sleigh
from jaxdyn.scenes.rolling import knife_edge_on_incline as knife_edge_on_incline
from jaxdyn.scenes.rolling import rolling_coin as rolling_coin
from jaxdyn.scenes.rolling import rolling_disk as rolling_disk


def names() -> tuple[str, ...]:
    """Names of all scenes."""
    return tuple(sorted(_REGISTRY))
