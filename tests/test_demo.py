"""The demo at a small size: it runs without files, writes its figures, and its numbers improve."""

import jax
import pytest

from jaxdyn import demo


@pytest.mark.slow
def test_demo(tmp_path, capsys):
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        numbers = demo.main(
            ["--rollouts", "8", "--duration", "0.2", "--samples", "200", "--steps", "8", "--out", str(tmp_path)]
        )
    assert (tmp_path / "rollouts.png").stat().st_size > 10_000 and (tmp_path / "fit.png").stat().st_size > 10_000
    assert numbers["energy minus work"] < 1e-6
    assert numbers["fitted"] < numbers["nominal"]
    assert "70 numbers" in capsys.readouterr().out
