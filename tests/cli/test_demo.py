"""The demo at a small size: it runs without files, writes its figures, and its numbers improve."""

import importlib.util

import jax
import pytest

from jaxdyn import demo


def test_demo_without_matplotlib_says_so_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit) as stop:
        demo.main(["--out", str(tmp_path / "out")])
    assert stop.value.code == 2 and not (tmp_path / "out").exists()
    assert "pip install jaxdyn[plot]" in capsys.readouterr().err


@pytest.mark.slow
def test_demo(tmp_path, capsys):
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        numbers = demo.main(
            ["--rollouts", "8", "--duration", "0.2", "--samples", "200", "--steps", "8", "--out", str(tmp_path)]
        )
    assert (tmp_path / "arm.png").stat().st_size > 10_000
    assert (tmp_path / "rollouts.png").stat().st_size > 10_000 and (tmp_path / "fit.png").stat().st_size > 10_000
    assert numbers["energy minus work"] < 1e-6 and numbers["gap of the coins"] < 1e-10
    assert (tmp_path / "coins.png").stat().st_size > 10_000
    assert numbers["fitted"] < numbers["nominal"]
    assert "70 numbers" in capsys.readouterr().out
