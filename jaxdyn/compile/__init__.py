"""How functions of one sample become machine code; the only place that knows.

Mechanics are written with arrays, as a textbook writes them. `run(function, model, *args)` traces a function once, expands
it to single numbers (`expand`, `graph`, `program`), writes these as LLVM IR over the lanes of a batch (`llvm`), and calls the
machine code through XLA's foreign function interface (`target`, `objects`); `kernel` is the primitive of JAX that stands
for it, with its batches, derivatives (`derive`) and the way without machine code. `compilation` (`mode`) turns all of it
off.

Imports nothing of jaxdyn. Others import the names below, and no module of this package. Only
`jaxdyn.export`, which writes code of its own, imports its modules.
"""

from jaxdyn.compile.calls import compiled as compiled
from jaxdyn.compile.calls import glue_options as glue_options
from jaxdyn.compile.flags import unless as unless
from jaxdyn.compile.jacobi import pseudo_inverse_by_rotations as pseudo_inverse_by_rotations
from jaxdyn.compile.jax_adapter import function_of as function_of
from jaxdyn.compile.kernel import compute as compute
from jaxdyn.compile.kernel import native as native
from jaxdyn.compile.kernel import run as run
from jaxdyn.compile.known import constant as constant
from jaxdyn.compile.known import is_concrete as is_concrete
from jaxdyn.compile.known import is_known as is_known
from jaxdyn.compile.known import is_staged as is_staged
from jaxdyn.compile.known import numpy_for as numpy_for
from jaxdyn.compile.known import partition_traced as partition_traced
from jaxdyn.compile.loops import Carry as Carry
from jaxdyn.compile.loops import Given as Given
from jaxdyn.compile.loops import Passed as Passed
from jaxdyn.compile.loops import Task as Task
from jaxdyn.compile.loops import Turn as Turn
from jaxdyn.compile.loops import run_loop as run_loop
from jaxdyn.compile.mode import compilation as compilation
from jaxdyn.compile.mode import current as compilation_mode  # noqa: F401 (under a name that says of what)
from jaxdyn.compile.mode import is_expanding as is_expanding
from jaxdyn.compile.mode import is_rank_safe as is_rank_safe
from jaxdyn.compile.mode import is_standalone as is_standalone
from jaxdyn.compile.repair import any_in_batch as any_in_batch
from jaxdyn.compile.repair import recompute_unless as recompute_unless
from jaxdyn.compile.repair import repair_flagged as repair_flagged
from jaxdyn.compile.repair import run_repaired as run_repaired
from jaxdyn.compile.rows import map_rows as map_rows
from jaxdyn.compile.rules import along as along
from jaxdyn.compile.rules import implicit as implicit
from jaxdyn.compile.trial import run_trial as _run_trial  # noqa: F401 (it registers itself)
