"""What a call gives does not depend on what was called before, and nothing of the process is changed for others."""

import contextlib
import io
import threading

import jax
import numpy as np
import pytest

import jaxdyn as jd
from benchmarks import history
from jaxdyn.identify.descent import on_one_thread


@pytest.mark.slow
@pytest.mark.native
@pytest.mark.parametrize("case", list(history.CASES))
def test_a_call_gives_the_same_bits_after_another_one(case):
    """In two fresh processes."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), pytest.raises(SystemExit) as end:
        history.main([case])
    assert end.value.code == 0, text.getvalue()


@pytest.mark.long
def test_a_motion_has_the_same_bits_after_one_of_other_masses():
    """In this process, whose caches are cleared in between: the run of other masses left nothing behind."""
    model = jd.robots.chain(2)

    def run(factor):
        scaled = model.replace(inertias=model.inertias * factor)
        return jd.simulate(scaled, [0.3, -0.2], [0.1, 0.4], [0.0, 0.5, 1.0]).q

    run(1.3)
    after = run(1.1)
    jax.clear_caches()
    np.testing.assert_array_equal(run(1.1), after)


@pytest.mark.long
def test_jit_keeps_a_program_for_each_mode():
    """Also of functions that this package has under `jax.jit`: kernels stand in no program that is traced under "plain"."""
    scene, (q, v) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
    run = jax.jit(lambda q, v: jd.constrained_dynamics(scene, q, v).acceleration)
    assert "jaxdyn_kernel" in run.lower(q, v).as_text()
    with jd.compilation("plain"):
        assert "jaxdyn_kernel" not in run.lower(q, v).as_text()
        by_jax = run(q, v)
    assert "jaxdyn_kernel" in run.lower(q, v).as_text()
    np.testing.assert_allclose(run(q, v), by_jax, rtol=0, atol=1e-10)


def test_calls_that_overlap_give_the_threads_of_linear_algebra_back(monkeypatch):
    """Each for itself would take the limit that the other one has set for the user's."""
    from jaxdyn.identify import descent

    process = {"limit": 8}

    class Limits:
        def __init__(self, limits, user_api):
            assert user_api == "blas"
            self.before, process["limit"] = process["limit"], limits

        def restore_original_limits(self):
            process["limit"] = self.before

    monkeypatch.setattr(descent, "threadpool_limits", Limits)
    inside, go_on, seen = threading.Event(), threading.Event(), []

    @on_one_thread
    def wait():
        inside.set()
        go_on.wait(10.0)
        seen.append(process["limit"])

    other = threading.Thread(target=wait)
    other.start()
    assert inside.wait(10.0)
    with pytest.raises(ZeroDivisionError):
        on_one_thread(lambda: seen.append(process["limit"]) or 1 / 0)()
    assert process["limit"] == 1  # the other one still runs
    go_on.set()
    other.join(10.0)
    assert seen == [1, 1] and process["limit"] == 8
