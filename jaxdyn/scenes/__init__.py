"""Named systems with known motions.

`jd.scenes.<name>(**parameters)` is a `Scene`, `.start()` the initial state of its reference.
"""

from types import ModuleType as _ModuleType

from jaxdyn.scenes._named import REGISTRY as _REGISTRY
from jaxdyn.scenes._named import NamedScene as NamedScene
from jaxdyn.scenes.arms import coordinated_lifting as coordinated_lifting
from jaxdyn.scenes.arms import sphere_arm as sphere_arm
from jaxdyn.scenes.friction import allegro_with_cube as allegro_with_cube
from jaxdyn.scenes.friction import box_on_table as box_on_table
from jaxdyn.scenes.friction import disk_and_link as disk_and_link
from jaxdyn.scenes.friction import rough_disk_and_link as rough_disk_and_link
from jaxdyn.scenes.friction import woodpecker as woodpecker
from jaxdyn.scenes.hands import hand_rolling_ball as hand_rolling_ball
from jaxdyn.scenes.hands import hand_with_ball as hand_with_ball
from jaxdyn.scenes.hands import hand_with_bar as hand_with_bar
from jaxdyn.scenes.hands import hand_with_disk as hand_with_disk
from jaxdyn.scenes.lagrangian import free_body as free_body
from jaxdyn.scenes.lagrangian import free_box as free_box
from jaxdyn.scenes.lagrangian import particle_in_plane as particle_in_plane
from jaxdyn.scenes.lagrangian import pendulum as pendulum
from jaxdyn.scenes.lagrangian import pendulum_in_plane as pendulum_in_plane
from jaxdyn.scenes.lagrangian import planar_arm as planar_arm
from jaxdyn.scenes.lagrangian import rigid_body_in_euler_angles as rigid_body_in_euler_angles
from jaxdyn.scenes.lagrangian import sliding_block as sliding_block
from jaxdyn.scenes.lagrangian import spatial_arm as spatial_arm
from jaxdyn.scenes.lagrangian import spherical_pendulum as spherical_pendulum
from jaxdyn.scenes.lagrangian import spherical_pendulum_in_angles as spherical_pendulum_in_angles
from jaxdyn.scenes.linkages import closed_ring as closed_ring
from jaxdyn.scenes.linkages import double_pendulum as double_pendulum
from jaxdyn.scenes.linkages import four_bar as four_bar
from jaxdyn.scenes.linkages import parallel_manipulator as parallel_manipulator
from jaxdyn.scenes.linkages import slider_crank as slider_crank
from jaxdyn.scenes.linkages import windows as windows
from jaxdyn.scenes.rolling import ball_on_incline as ball_on_incline
from jaxdyn.scenes.rolling import ball_on_turntable as ball_on_turntable
from jaxdyn.scenes.rolling import bowling_ball as bowling_ball
from jaxdyn.scenes.rolling import chaplygin_sleigh as chaplygin_sleigh
from jaxdyn.scenes.rolling import hand_rolling_egg as hand_rolling_egg
from jaxdyn.scenes.rolling import knife_edge_on_incline as knife_edge_on_incline
from jaxdyn.scenes.rolling import rolling_coin as rolling_coin
from jaxdyn.scenes.rolling import rolling_disk as rolling_disk
from jaxdyn.scenes.rolling import suslov as suslov
from jaxdyn.scenes.spatial_linkages import bennett as bennett
from jaxdyn.scenes.spatial_linkages import bricard as bricard
from jaxdyn.scenes.spatial_linkages import goldberg as goldberg
from jaxdyn.scenes.spatial_linkages import hinge_platform as hinge_platform
from jaxdyn.scenes.spatial_linkages import sarrus as sarrus
from jaxdyn.scenes.vehicles import bicycle as bicycle
from jaxdyn.scenes.vehicles import car as car
from jaxdyn.scenes.vehicles import differential_drive as differential_drive
from jaxdyn.scenes.vehicles import snakeboard as snakeboard


def names() -> tuple[str, ...]:
    """Names of all scenes."""
    return tuple(sorted(_REGISTRY))


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
