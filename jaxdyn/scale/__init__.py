"""Batch runs of any size, from one core to a cluster: chunk by chunk, on all devices, into a store from which they resume.

`run` simulates (`jd.simulate` for each rollout), `evaluate` does the same for any function of one sample. `program` has the
inputs of the rollouts, and compiles the function for all devices of a process; `study` names the arrays of a store, and computes
a chunk, here or on a Dask worker (`jaxdyn.tasks`); `store` keeps the chunks (Zarr), `reductions` summarise many rollouts. zarr,
xarray and filelock, of the extra `scale`, are imported when a store is opened.
"""

from types import ModuleType as _ModuleType

from jaxdyn.scale.program import member as member
from jaxdyn.scale.reductions import Histogram as Histogram
from jaxdyn.scale.reductions import Mean as Mean
from jaxdyn.scale.reductions import Quantiles as Quantiles
from jaxdyn.scale.reductions import Reduction as Reduction
from jaxdyn.scale.reductions import Worst as Worst
from jaxdyn.scale.run import Resources as Resources
from jaxdyn.scale.run import Run as Run
from jaxdyn.scale.run import evaluate as evaluate
from jaxdyn.scale.run import run as run


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return [x for x, value in globals().items() if x[0] != "_" and not isinstance(value, _ModuleType)]
