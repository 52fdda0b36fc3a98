"""The table of extreme cases: what is right, what is refused and by which code; nothing wrong comes with success."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from benchmarks import extremes
from benchmarks.extreme_motions import SOLVERS, run_oscillator, stability_limits
from jaxdyn import robots, scenes
from jaxdyn.constraints.codes import code_of
from jaxdyn.reports import references

CASES = extremes.load()
BOTH, ONE = ("float64", "float32"), ("float64",)


def verdicts(rows):
    """The rows that are not right, by place and dtype, with their codes."""
    return {
        (row.at, row.dtype): row.verdict if row.verdict != "refused" else row.code
        for row in rows
        if row.verdict != "right"
    }


def refused(code, dtypes, *places):
    """Expected refusals."""
    return {(place, dtype): code for dtype in dtypes for place in places}


KNEES = [f"knee 1e-{n} rad from straight" for n in ("02", "04", "06", "08", "10", "12")]
QUICK = {
    "masses": (ONE, refused("singular_mass_matrix", ONE, "tip 0 kg, constrained_dynamics")),
    "rates": (BOTH, {}),
    "turns": (BOTH, refused("coarse_start", ["float32"], "1e+03 turns", "1e+06 turns")),
    "planes": (("float32",), {}),
}
FAST = ("rates", "turns")


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x not in FAST)) for x in QUICK])
def test_verdicts(name):
    dtypes, expected = QUICK[name]
    rows = CASES[name](dtypes, False)
    assert verdicts(rows) == expected
    assert len(rows) >= 5


@pytest.mark.long
def test_the_longest_stable_step():
    """2.785 and 2.828 for RK4 on the negative real and the imaginary axis, as in every book; the rest from the tableaux."""
    real, imaginary = stability_limits(None)
    assert abs(real - 2.78529) < 2e-5
    assert abs(imaginary - 2 * np.sqrt(2)) < 2e-5
    assert not verdicts(CASES["steps"](ONE, False, solvers={"RK4": SOLVERS["RK4"], "Tsit5": SOLVERS["Tsit5"]}))


@pytest.mark.long
def test_beyond_the_longest_stable_step():
    """Steps that are too long are refused before the state overflows, and then too."""
    computed = verdicts(CASES["beyond"](ONE, False))
    assert computed == {
        ("0.5 of the limit", "float64"): "coarse_steps",
        ("0.99 of the limit", "float64"): "coarse_steps",
        ("1.01 of the limit", "float64"): "coarse_steps",
        ("1.1 of the limit", "float64"): "nonfinite_state",
        ("2.0 of the limit", "float64"): "nonfinite_state",
    }
    # It overflows after about 1100 of 2000 steps; what was kept at 1000 is the last that is known.
    rate = 1.1 * stability_limits(None)[1]
    _, computed = extremes.quick(lambda rate: run_oscillator(rate, 0 * rate, None, 2000))(jnp.asarray(rate))
    assert float(computed.stats["time_reached"]) == 1000.0
    np.testing.assert_array_equal(np.isnan(computed.q[:, 0]), [False, False, True])


def test_too_many_turns_are_refused_by_name():
    model = robots.chain(2, dtype=jnp.float32)
    with pytest.raises(ValueError, match=r"6283\.19.*1000 whole"):
        jd.simulate(model, [0.0, 2000 * np.pi], [0.0, 0.0], [0.0, 1.0])


SLOW = {
    "mass_motion": (BOTH, True),
    "twins": (BOTH, False),
    "gravity": (BOTH, True),
    "planes": (ONE, True),
    "bases": (ONE, False),
    "starts": (ONE, False),
    "chaos": (BOTH, False),
    "million": (BOTH, False),
}


# Rounding decides whether these, whose rows are far closer to dependent than float64 tells apart, are right or refused.
BY_ROUNDING = {("planes", f"1e-12 rad, {way}, rank_tol 1e-14", "float64") for way in ("along", "across")}


def documented():
    """Verdicts in docs/extremes.md by case, place and dtype."""
    text = (Path(__file__).parents[2] / "docs" / "extremes.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    return {tuple(row[:3]): row[-1] for row in rows}


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_verdicts_of_long_runs(name):
    dtypes, gradient = SLOW[name]
    rows = CASES[name](dtypes, gradient)
    assert "SILENT" not in verdicts(rows).values()
    # Without gradients fewer rows can be wrong, and a refusal may give way to an answer; nothing that was right is lost.
    known = documented()
    lost = {
        (row.case, row.at, row.dtype) for row in rows if row.verdict != known[row.case, row.at, row.dtype] == "right"
    }
    assert lost <= BY_ROUNDING
    assert sum(row.verdict == "right" for row in rows) >= 2


@pytest.mark.slow
def test_grasps_near_loss_of_closure():
    assert verdicts(CASES["grasps"](ONE, True)) == refused("singular_basis", ONE, *KNEES[2:])


@pytest.mark.slow
def test_five_hundred_links_in_motion():
    rows = CASES["links"](ONE, True, counts=(500,))
    assert not verdicts(rows)
    # 9 digits: 500 velocities change by the step of the difference quotient at once.
    assert min(row.digits for row in rows) > 8


@pytest.mark.slow
def test_a_small_loop_that_is_open_is_refused():
    """In a four-bar of millimetres an angle wrong by 0.2 rad leaves 5e-4 m, which in metres and float32 is next to rounding."""
    lengths, gravity = (1e-3, 3e-3, 2.5e-3, 3.5e-3), (0.0, -9.81e-3, 0.0)
    scene = extremes.as_dtype(scenes.four_bar(lengths=lengths, gravity=gravity), jnp.float32)
    q, v = (x.astype(jnp.float32) for x in scenes.four_bar.start())
    ts = jnp.asarray([0.0, 0.1], jnp.float32)
    run = extremes.quick(jax.vmap(lambda off: code_of(jd.simulate(scene, q.at[1].add(off), v, ts).result)))
    codes = [extremes.name_of(code) for code in run(jnp.asarray([0.0, 0.2], jnp.float32))]
    assert codes == ["successful", "inconsistent_start"]


@pytest.mark.slow
def test_through_the_flat_position():
    computed = verdicts(CASES["flat"](BOTH, False, runs=((1, "projected", None, 1e-8), (1, "projected", 0.005, 1e-8))))
    # In float32 rounding decides whether a step ends in the flat position, which ends the run with a code.
    assert computed.pop(("1 window, projected, adaptive", "float32"), None) in (None, "dt_min_reached")
    assert computed == {}


@pytest.mark.slow
def test_motion_passes_singular_positions_at_any_tolerance():
    """Where two branches of the constraints meet rounding must not choose one unseen, and steps must not creep up to it."""
    ts, tolerances = jnp.asarray([0.0, 0.5, 1.0]), 10.0 ** -jnp.linspace(8.0, 12.5, 32)
    scene, (q, v) = scenes.windows(count=2), scenes.windows.start(count=2)

    @jax.vmap
    def run(tolerance):
        computed = jd.simulate(
            scene, q, v, ts, stepsize=jd.simulation.Steps(rtol=tolerance, atol=tolerance, max_steps=4096), throw=False
        )
        return computed.q, computed.success, computed.stats["num_steps"]

    computed, successful, steps = map(np.asarray, jax.jit(run)(tolerances))
    error = np.abs(computed - references.windows(np.asarray(ts), 2).q).max((1, 2))
    # The error of the tolerance is 40 of it at most, of rounding 1e-10. Steps chosen by an error estimate with its part normal
    # to the constraints end there: 11 of 64 were wrong by more than 1, and 14 refused if the projection counts as an error.
    assert (error[successful] < 100 * np.asarray(tolerances)[successful] + 1e-10).all()
    assert successful.sum() >= 31
    assert np.median(steps) < 30
    assert steps[successful].max() < 60


@pytest.mark.slow
def test_motions_through_many_singular_positions():
    """256 motions of two windows, some ten such positions each: one in a thousand may end in one, and is refused."""
    first, ts = np.linspace(0, 1, 256), np.linspace(0, 10, 6)
    scene, start = scenes.windows(count=2), references.windows(first, 2)
    times, place = np.unique(first[:, None] + ts, return_inverse=True)
    want = references.windows(times, 2).q[place.reshape(256, 6)]

    def run(q, v, tolerance):
        computed = jd.simulate(
            scene, q, v, ts, stepsize=jd.simulation.Steps(rtol=tolerance, atol=tolerance, max_steps=2048), throw=False
        )
        return computed.q, computed.success

    program = jax.jit(jax.vmap(run, (0, 0, None)))
    # A step that ends at a distance d from such a position carries the rounding over d^2 on: 4e-7 in one of them at 1e-10.
    for tolerance, worst in ((1e-6, 2e-3), (1e-8, 2e-5), (1e-10, 1e-6)):
        computed, successful = map(np.asarray, program(start.q, start.v, tolerance))
        assert successful.sum() >= 255
        assert np.abs(np.sin((computed - want) / 2))[successful].max() < worst
