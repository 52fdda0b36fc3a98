"""Functions of one sample as native kernels; a compiler for JAX that could be published alone (README.md).

`kernel` is the decorator that turns a function of one sample, written with arrays, into native code for one sample or a
batch of them. A function is traced once (`trace`), expanded to a program of single numbers (`expansion`, `graph`, `program`),
differentiated there (`derive`), written as LLVM IR (`code`, `llvm`), and called through XLA's foreign function interface
(`target`, `stored`). A primitive of JAX stands for the kernel, with rules for batches and derivatives; where there is no
native code, operations of JAX do the same (`primitive`).

Of jaxdyn the context of tracing alone is imported here. Other rooms import the names below, and those of the modules
`known` (known and traced values), `batch` (decisions for a batch, repetitions) and `kernels` (loops). Only `jaxdyn.scale`, which
compiles programs around kernels ahead of time, and `jaxdyn.exports`, which writes object files, import the compiler's own
modules.
"""

from jaxdyn.compile.batch import sweep as sweep
from jaxdyn.compile.executables import Evaluation as Evaluation
from jaxdyn.compile.executables import entry_point as entry_point
from jaxdyn.compile.executables import evaluate as evaluate
from jaxdyn.compile.executables import jit as jit
from jaxdyn.compile.executables import run_trial as _run_trial  # noqa: F401 (it registers itself)
from jaxdyn.compile.jacobi import gram_eigenvectors as gram_eigenvectors
from jaxdyn.compile.jacobi import inverse as inverse
from jaxdyn.compile.jacobi import pseudo_inverse_by_pivots as pseudo_inverse_by_pivots
from jaxdyn.compile.jacobi import pseudo_inverse_by_rotations as pseudo_inverse_by_rotations
from jaxdyn.compile.kernels import kernel as kernel
from jaxdyn.compile.mode import compilation as compilation
from jaxdyn.compile.mode import current as compilation_mode  # noqa: F401 (under a name that says of what)
from jaxdyn.compile.mode import is_standalone as is_standalone
from jaxdyn.compile.mode import values_of_rules as values_of_rules
from jaxdyn.compile.mode import wait_for_code as wait_for_code
from jaxdyn.compile.pivots import cholesky_factor as cholesky_factor
from jaxdyn.compile.pivots import eliminate as eliminate
from jaxdyn.compile.pivots import eliminate_rows as eliminate_rows
from jaxdyn.compile.pivots import solver_of as solver_of
from jaxdyn.compile.pivots import triangular_solution as triangular_solution
from jaxdyn.compile.rules import batch_alike as batch_alike
from jaxdyn.compile.rules import forward_only as forward_only
from jaxdyn.compile.rules import implicit as implicit
from jaxdyn.compile.rules import invalidate_derivatives as invalidate_derivatives
from jaxdyn.compile.rules import mark_invalid as mark_invalid
from jaxdyn.compile.rules import reverse_only as reverse_only
from jaxdyn.compile.rules import value_and_jvp as value_and_jvp
