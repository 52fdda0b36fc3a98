"""The notebooks run, and print what they show."""

import contextlib
import io
import json
import re
import sys
from types import SimpleNamespace

import jax
import pytest
from pages import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def differs(shown: str, printed: str) -> str:
    """What differs between two texts apart from rounding, or an empty text: words exactly, numbers within a tenth."""
    # The head of exported code names the processor, and reports of fits the seconds that they took.
    shown, printed = (
        re.sub(r"made by jaxdyn for .*|, in [0-9.]+ s$", "", text, flags=re.M) for text in (shown, printed)
    )
    words = [" ".join(_NUMBER.sub("#", text).split()) for text in (shown, printed)]
    if words[0] != words[1]:
        return f"shown: {shown}\nprinted: {printed}"
    for one, other in zip(*(map(float, _NUMBER.findall(text)) for text in (shown, printed)), strict=True):
        # Errors of rounding size are other ones on every machine.
        if abs(one - other) > max(1e-6, 0.1 * max(abs(one), abs(other))):
            return f"{one} is shown and {other} printed in\n{printed}"
    return ""


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_prints_what_it_shows(path, tmp_path, monkeypatch):
    text = path.read_text()
    for name in ("matplotlib", "casadi", "zarr"):
        if re.search(rf"(import|from|%) ?{name}", text):
            pytest.importorskip(name)
    folder = tmp_path / "notebooks"
    folder.mkdir()
    monkeypatch.chdir(folder)
    # Outside of a notebook nothing is displayed, so that IPython need not be installed.
    shows_nothing = SimpleNamespace(display=lambda *shown: None, HTML=str)
    monkeypatch.setitem(sys.modules, "IPython.display", shows_nothing)
    names: dict = {"__name__": "__main__"}
    # A reader has jax's own settings, not the strict ones of the tests.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for cell in json.loads(text)["cells"]:
            if cell["cell_type"] != "code":
                continue
            source = re.sub(r"^%.*$", "", "".join(cell["source"]), flags=re.MULTILINE)
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(compile(source, path.name, "exec"), names)
            outputs = [output for output in cell["outputs"] if output.get("name") == "stdout"]
            shown = "".join(line for output in outputs for line in output["text"])
            # Seconds are those of the machine.
            if "perf_counter" not in source:
                assert not (fault := differs(shown, printed.getvalue())), fault
