"""Lists of independent tasks: one after another in this process, or on the workers of a Dask client.

`Local` and `Cluster` have the same interface, so that callers do not distinguish them. The object whose methods tasks call is
sent once to each worker (`worker`), with the settings of JAX that decide its results. Dask and cloudpickle are imported when a
client is given.
"""

from jaxdyn.tasks.cluster import Cluster as Cluster
from jaxdyn.tasks.cluster import DaskClient as DaskClient
from jaxdyn.tasks.cluster import Engine as Engine
from jaxdyn.tasks.cluster import count_workers as count_workers
from jaxdyn.tasks.cluster import map_tasks as map_tasks
from jaxdyn.tasks.cluster import open_engine as open_engine
from jaxdyn.tasks.cluster import results as results
from jaxdyn.tasks.local import Failure as Failure
from jaxdyn.tasks.local import Local as Local
from jaxdyn.tasks.local import attempt as attempt
from jaxdyn.tasks.local import package_versions as package_versions
