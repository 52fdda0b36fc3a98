"""Reduction: minimal velocities, the gauge-invariant form, and the integrability of constraints.

Imports `constraints` and the layers below. Source: EQUATIONS sections 6, 7 and 9.
"""

from types import ModuleType as _ModuleType

from jaxdyn.reduction.bases import tangent_basis as tangent_basis
from jaxdyn.reduction.integrability import involutive as involutive
from jaxdyn.reduction.integrability import spurious_terms as spurious_terms
from jaxdyn.reduction.minimal import KaneEquation as KaneEquation
from jaxdyn.reduction.minimal import gauge_invariant as gauge_invariant
from jaxdyn.reduction.minimal import kane_equation as kane_equation
from jaxdyn.reduction.minimal import quasi_connection as quasi_connection


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
