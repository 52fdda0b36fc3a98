"""The README's examples run as they are printed."""

import re
from pathlib import Path

import jax
import numpy as np

README = Path(__file__).resolve().parent.parent / "README.md"


def test_examples_of_the_readme_run():
    """All blocks in one namespace, as a reader pastes them one after another."""
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert len(blocks) >= 3
    names: dict = {}
    # A reader has jax's own settings, not the strict ones of the tests.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for block in blocks:
            exec(compile(block, str(README), "exec"), names)
    assert np.abs(names["a"]).max() < 1e-10, "gravity compensation holds the arm still"
    assert names["accelerations"].shape == (1000, 7)
    assert np.isfinite(names["gradient"]).all()
    assert 0 < names["drift"] < 1e-6
