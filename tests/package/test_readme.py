"""The examples of the README and of pages beside it run as they are printed."""

import jax.numpy as jnp
import numpy as np
import pytest
from pages import run


@pytest.mark.long
def test_example_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run("README.md", least=1)
    assert (tmp_path / "four_bar.png").stat().st_size > 10_000
    # Save points stand between steps: the energy (84 J) is that of the dense output.
    assert np.abs(names["motion"].constraint_residual).max() < 1e-10 and np.ptp(names["motion"].energy) < 1e-6 * 84
    assert names["weights"].shape == (100, 3) and names["jacobians"].shape == (100, 3, 3, 10)
    # The weight is linear in the ten numbers of each body.
    inertias = names["scene"].system.inertias
    np.testing.assert_allclose(jnp.einsum("ncbk,bk->nc", names["jacobians"], inertias), names["weights"], atol=1e-10)


@pytest.mark.long
def test_examples_of_the_first_steps_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run("docs/start.md")
    assert np.abs(names["turning"].constraint_residual).max() < 1e-14 and np.ptp(names["turning"].q[:, 2]) > 0.05
    assert (tmp_path / "engine.gif").stat().st_size > 50_000
    assert np.abs(names["a"]).max() < 1e-10, "gravity compensation holds the arm still"
    assert names["accelerations"].shape == (1000, 7)
    assert np.isfinite(names["gradient"]).all()
    assert 0 < names["drift"] < 1e-6


@pytest.mark.slow
def test_examples_of_the_page_on_systems_run():
    names = run("docs/systems.md")
    assert abs(names["lost"] + names["motion"].work[-1]) < 1e-7 < 0.1 < names["lost"]
    assert abs(names["curvature"] - 1) < 1e-12 and np.abs(names["force"]).max() < 1e-12
    # The rods pull along themselves.
    s, lower = names["angles"], names["lower"]
    assert abs(lower @ jnp.stack([jnp.cos(s[1]), jnp.sin(s[1])])) < 1e-12 < 1 < np.linalg.norm(lower)
    np.testing.assert_allclose(names["fit"].values, [0.5, 2.0, 0.8], rtol=1e-8)  # bob, cart, length


@pytest.mark.slow
def test_examples_of_the_section_on_events_run():
    names = run("docs/simulation.md", "Events", 2)
    events = names["motion"].events
    assert list(events.name[:2]) == ["lane: touch", ""]
    np.testing.assert_allclose(events.time[0], np.sqrt(0.8 / 9.81), rtol=1e-9)
    # Rolling keeps 5/7 of the velocity.
    np.testing.assert_allclose(names["motion"].q[-1, 0], 2 * (events.time[0] + 5 / 7 * (2 - events.time[0])), rtol=1e-7)
    assert np.isfinite(names["derivative"]) and names["derivative"] != 0


@pytest.mark.slow
def test_examples_of_the_page_on_hands_run():
    names = run("docs/hands.md")
    assert names["closure"].closed and names["closure"].margin > 0.1
    assert bool(names["held"].success) and abs(names["margin"] - 0.5) < 1e-6
    assert bool(names["measure"].is_manipulable)
