"""The README of the compiler: its example runs as it is printed."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn.compile

pytestmark = pytest.mark.native
TEXT = (Path(jaxdyn.compile.__file__).parent / "README.md").read_text()


def test_example():
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    points, charges = (np.asarray(names[name]) for name in ("points", "charges"))
    gaps = points[:, None] - charges
    wanted = (gaps / np.linalg.norm(gaps, axis=2, keepdims=True) ** 3).sum(1)  # Coulomb's law
    np.testing.assert_allclose(names["field"](points), wanted, rtol=1e-13, atol=1e-15)
    laplacian = np.trace(names["hessian"](points), axis1=1, axis2=2)
    np.testing.assert_allclose(laplacian, 0, atol=1e-14)
    assert float(names["quotient"]((), jnp.asarray(0.0))) == 1
