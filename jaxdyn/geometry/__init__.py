"""Metric geometry: covariant derivatives, and systems constrained by an immersion (EQUATIONS sections 7 and 12).

Imports `dynamics` and what is below it.
"""

from types import ModuleType as _ModuleType

from jaxdyn.geometry.immersion import constrain_by_immersion as constrain_by_immersion
from jaxdyn.geometry.immersion import pull_back as pull_back
from jaxdyn.geometry.immersion import reaction_force as reaction_force
from jaxdyn.geometry.metric import arnold_form as arnold_form
from jaxdyn.geometry.metric import christoffel_symbols as christoffel_symbols
from jaxdyn.geometry.metric import connection as connection
from jaxdyn.geometry.metric import covariant_derivative as covariant_derivative
from jaxdyn.geometry.metric import covariant_rate as covariant_rate
from jaxdyn.geometry.metric import flat as flat
from jaxdyn.geometry.metric import geodesic_acceleration as geodesic_acceleration
from jaxdyn.geometry.metric import riemann_tensor as riemann_tensor
from jaxdyn.geometry.metric import sectional_curvature as sectional_curvature
from jaxdyn.geometry.metric import sharp as sharp


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
