"""Functions of the library outside of Python: object files with C headers, CasADi's interface, and calls from NumPy."""

from jaxdyn.exports.exported import Exported as Exported
from jaxdyn.exports.exported import export as export

__all__ = ["Exported", "export"]
