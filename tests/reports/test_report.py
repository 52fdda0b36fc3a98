"""The report of error against run time: references, counts, errors, the front, the page and the command."""

import dataclasses
import functools
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxdyn as jd
from benchmarks.fronts import beaten_by, cost_at
from benchmarks.report_cases import cases
from benchmarks.report_cases.references import car_axis, rolling_down, sliding_block
from jaxdyn.cli import main
from jaxdyn.contact.unilateral import has_modes
from jaxdyn.reports import Record, Report, html_page, pareto_front, references
from jaxdyn.reports import run as running
from jaxdyn.reports.plotting import SceneReference
from jaxdyn.reports.programs import FIXED, SOLVERS, Case, Programs, Reference, case_of_scene, prepare
from jaxdyn.reports.run import Contestant, Motion, evaluations, ladder, measure, time_alternately
from jaxdyn.simulation.checks import choose_method
from jaxdyn.simulation.solvers.choice import choose_solver

MOMENTS = np.array([1.0, 2.0, 3.0])


@functools.cache
def built(name):
    """Scene and start of a case."""
    return cases()[name].build()


# Their starts take seconds to assemble, and are held by `test_sphere_arm.py`, `test_join.py` and `test_allegro.py`.
DEAR = ("sphere_arm", "sphere_arm_rolling", "coordinated_lifting", "allegro_with_cube")


def scene_of(name):
    """Scene of a case."""
    if name in DEAR:
        contact = {"contact": "rolling"} if name == "sphere_arm_rolling" else {}
        return getattr(jd.scenes, name.removesuffix("_rolling"))(**contact)
    return built(name)[0]


def test_references_start_where_the_scenes_do():
    for name, case in cases().items():
        if case.reference is None:
            continue
        _, (q, v) = built(name)
        reference = case.reference((q, v))
        assert reference.q.shape == (len(reference.ts), len(q)), name
        np.testing.assert_allclose(reference.q[0], q, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(reference.v[0], v, atol=1e-14, err_msg=name)


@pytest.mark.slow
def test_every_case_builds():
    for name in cases():
        scene, (q, v) = built(name)
        assert q.shape == (scene.nq,) and v.shape == (scene.nv,), name


def test_the_report_knows_every_scene():
    """All of `jd.scenes`, immersed systems and hands included, are cases of their names; not those whose events end steps."""
    with_events = {name for name in jd.scenes.names() if has_modes(getattr(jd.scenes, name)())}
    assert with_events == {"bowling_ball", "rough_disk_and_link", "sliding_block", "woodpecker"}
    assert set(jd.scenes.names()) - with_events <= set(cases())
    assert len(cases()) >= 48


# Of closed forms: times, and the rates of a state by the equations of motion as a textbook has them, from q[0] and v[0].
EQUATIONS = {
    "swing": (references.swing, lambda q, v: [*v, -9.81 * np.sin(q[0])]),
    "thrown": (references.projectile, lambda q, v: [*v, 0.0, -9.81]),
    "braked": (sliding_block, lambda q, v: [*v, -0.3 * 9.81]),
    # The pull of the slope along the blade; what is across it the blade takes.
    "skate": (
        references.skate,
        lambda q, v: [v[0] * np.cos(q[2]), v[0] * np.sin(q[2]), v[2], 9.81 / 2 * np.cos(q[2]), 0.0, 0.0],
    ),
}


def solved_by_scipy(rates, start, ts):
    """States (len(ts), n) by DOP853."""
    return solve_ivp(rates, (0, ts[-1]), start, "DOP853", ts, rtol=1e-12, atol=1e-14).y.T


@pytest.mark.parametrize("name", EQUATIONS)
def test_closed_forms_solve_the_equations(name):
    form, rates = EQUATIONS[name]
    ts = np.linspace(0.0, 0.6, 4)
    computed = form(ts)
    n, states = computed.q.shape[1], np.concatenate([computed.q, computed.v], 1)
    solved = solved_by_scipy(lambda t, y: rates(y[:n], y[n:]), states[0], ts)
    np.testing.assert_allclose(states, solved, atol=1e-10)


def test_turning_closed_forms_solve_the_equations():
    """The ball that rolls down and the box that falls: one scalar equation each, places and turns by trigonometry."""
    ts = np.linspace(0.0, 1.0, 6)
    computed, pull = rolling_down(ts), 5 / 14 * 9.81
    turned = Rotation.from_quat(np.roll(computed.q[:, 3:], -1, 1))
    angle = (0.5 * ts[1] + pull * ts[1] ** 2 / 2) / 0.1
    np.testing.assert_allclose(turned.as_rotvec()[1], [0.0, angle, 0.0], atol=1e-13)
    np.testing.assert_allclose(turned.apply(computed.v[:, :3]), np.outer(0.5 + pull * ts, [1, 0, 0]), atol=1e-13)
    np.testing.assert_allclose(computed.v[:, 4] * 0.1, 0.5 + pull * ts, atol=1e-14)
    computed, r = references.falling_table(ts), 0.145
    moment = 20 * (1 + 0.05**2) / 12 + (0.2**2 + 0.24**2) / 12 + r**2
    solved = solved_by_scipy(lambda t, y: [y[1], 9.81 * r * np.sin(y[0]) / moment], [computed.q[0, 7], 0.0], ts)
    np.testing.assert_allclose(computed.q[:, 7], solved[:, 0], atol=1e-11)
    np.testing.assert_allclose(computed.v[:, 6], solved[:, 1], atol=1e-11)
    turned = Rotation.from_quat(np.roll(computed.q[:, 3:7], -1, 1))
    np.testing.assert_allclose(turned.as_rotvec(), np.outer(computed.q[:, 7], [0, 1, 0]), atol=1e-13)
    np.testing.assert_allclose(computed.q[:, :3], turned.apply([0, 0, r]), atol=1e-13)
    velocity = np.cross(computed.v[:, 6:] * [0, 1, 0], computed.q[:, :3])
    np.testing.assert_allclose(turned.apply(computed.v[:, :3]), velocity, atol=1e-13)


def test_plane_pendulum_has_the_printed_digits():
    """Problem A01, 18 digits by mpmath."""
    ts = np.array([0.0, 1.0, 5.0, 9.99, 10.0])
    want = [
        (-1.0, 0.0),
        (0.986291751131875319, -0.165010853125541169),
        (-0.942305435043757335, -0.334754338414000581),
        (-0.316436469913032291, -0.948613704575776519),
        (-0.27508746257611686, -0.961419205099125064),
    ]
    computed = references.plane_pendulum(ts)
    np.testing.assert_allclose(computed.q, want, atol=1e-13)
    energy = 0.5 * np.sum(computed.v**2, 1) + 9.81 * computed.q[:, 1]
    np.testing.assert_allclose(energy, 0.0, atol=1e-13)


def test_free_top_has_the_printed_rates_and_turns_as_they_say():
    """Problem 4.1; and R' = R hat(w), integrated by scipy, with R I w constant."""
    printed = {
        (0.3, 0.8, -0.5): (-0.51657677863999, 0.6805500949746, -0.55583317887956),
        (1.0, 0.2, 0.1): (1.0190650695036, -0.038812164557891, 0.1510999844279),
        (0.2, 0.1, 1.0): (0.0019375747348129, 0.22359840295527, 0.99331159162938),
    }
    ts = np.linspace(0.0, 20.0, 6)

    def rate(t, y):
        turned, w = y[:9].reshape(3, 3), y[9:]
        return np.concatenate([(turned @ np.cross(np.eye(3), w)).ravel(), np.cross(MOMENTS * w, w) / MOMENTS])

    for start, end in printed.items():
        computed = references.free_top(ts, start=start)
        np.testing.assert_allclose(computed.v[-1], end, atol=1e-12)
        turned = Rotation.from_quat(np.roll(computed.q, -1, 1)).as_matrix()
        momentum = np.einsum("tij,tj->ti", turned, MOMENTS * computed.v)
        np.testing.assert_allclose(momentum, np.tile(MOMENTS * start, (6, 1)), atol=1e-12)
        solved = solved_by_scipy(rate, [*np.eye(3).ravel(), *start], ts)
        np.testing.assert_allclose(turned.reshape(6, 9), solved[:, :9], atol=1e-9)


def test_sphere_pendulum_against_angles():
    """theta'' = sin cos phi'^2 - g sin theta, phi' = h/sin^2, by scipy; energy and angular momentum are constant."""
    ts = np.linspace(0.0, 10.0, 5)
    h = np.sin(1.0) ** 2

    def rate(t, y):
        sine, cosine = np.sin(y[0]), np.cos(y[0])
        return [y[1], h**2 * cosine / sine**3 - 9.81 * sine, h / sine**2]

    for turn in (1.0, 4.5):  # the start is the highest, then the lowest point
        h = np.sin(1.0) ** 2 * turn
        computed = references.sphere_pendulum(ts, turn=turn)
        theta, _, phi = solved_by_scipy(rate, [1.0, 0.0, 0.0], ts).T
        want = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), -np.cos(theta)], 1)
        np.testing.assert_allclose(computed.q, want, atol=1e-9)
        np.testing.assert_allclose(np.cross(computed.q, computed.v)[:, 2], h, atol=1e-12)
        energy = 0.5 * np.sum(computed.v**2, 1) + 9.81 * computed.q[:, 2]
        np.testing.assert_allclose(energy, energy[0], atol=1e-12)


@pytest.mark.parametrize(
    ("count", "t", "place", "velocity"),
    [
        (2, 1.0, (-0.1950203, -0.98079921), (-6.67667804, 1.32757833)),
        (2, 10.0, (0.32845811, 0.94451854), (1.42305147, -0.49486885)),
        (40, 1.0, (-0.11535688, -0.99332411), (-6.66998752, 0.7746001)),
        (40, 10.0, (0.18051223, 0.98357274), (1.14844128, -0.21077007)),
    ],
)
def test_windows_have_the_printed_digits(count, t, place, velocity):
    """Problem A02: place and velocity of the first top, 8 digits; and energy."""
    computed = references.windows(np.array([0.0, t]), count)
    angle, turn = -computed.q[-1, 0], -computed.v[-1, 0]
    top = np.array([np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose(top, place, atol=2e-8)
    np.testing.assert_allclose(turn * np.array([top[1], -top[0]]), velocity, atol=2e-8)
    inertia, weight = (count + 1) / 3 + count, 9.81 * ((count + 1) / 2 + count)
    np.testing.assert_allclose(0.5 * inertia * turn**2 + weight * np.cos(angle), 0.5 * inertia + weight, rtol=1e-13)


def test_sleigh_and_coin_have_the_printed_digits():
    """Problems 3.4 and 3.10, where integrals and one turn of the circle are printed."""
    computed = references.sleigh(np.array([0.0, 1.0, 10.0]))
    want = [(0.3134115046418, 0.3477380366348, 1.356093732499), (-8.600842105481, -0.4306517115655, 3.570508149338)]
    np.testing.assert_allclose(computed.q[1:], want, atol=2e-12)
    np.testing.assert_allclose(computed.v[1:, 0], (0.7547057324456, 1.169390226108), atol=1e-12)
    np.testing.assert_allclose(computed.v[1:, 2], (1.162929714574, 0.00670176830728), atol=1e-12)

    period = 5.852173782956319
    computed = references.coin(np.array([0.0, period / 4, period]))
    radius = 0.4956422128626671
    np.testing.assert_allclose(computed.q[[0, 2], :3], [[0.0, radius, computed.q[0, 2]]] * 2, atol=1e-12)
    np.testing.assert_allclose(np.hypot(*computed.q[:, :2].T), radius, atol=1e-14)


def test_integral_knows_its_error():
    ts = np.array([0.0, 1.0, 4.0])
    computed, error = references.integral(np.cos, ts, 1.0)
    np.testing.assert_allclose(computed, np.sin(ts), atol=1e-15)
    assert error < 1e-15
    computed, error = references.integral(lambda t: np.exp(-((6 * (t - 2)) ** 2)), ts, 4.0)  # too long for this one
    assert 0.1 * abs(computed[-1] - np.sqrt(np.pi) / 6) < error < 1e-2


def counting():
    """A force of zero, and a list that grows by one whenever it is asked for."""
    calls: list[None] = []

    def force(system, q, v, t):
        jax.debug.callback(lambda: calls.append(None))
        return jnp.zeros_like(v)

    return force, calls


@pytest.mark.long
@pytest.mark.parametrize(("name", "solver"), [("pendulum_in_plane", "Tsit5"), ("pendulum", "RK4")])
def test_evaluations_are_those_that_are_made(name, solver):
    scene, (force, calls) = getattr(jd.scenes, name), counting()
    counted = jd.Scene(scene().system, scene().constraints, (force,))
    method = {"Tsit5": diffrax.Tsit5, "RK4": jd.solvers.RK4}[solver]()
    steps = 0.05 if solver == "RK4" else jd.simulation.Steps(rtol=1e-6, atol=1e-6)
    solution = jd.simulate(counted, *scene.start(), jnp.asarray([0.0, 1.0]), solver=method, stepsize=steps)
    jax.effects_barrier()
    assert len(calls) == evaluations(solver, int(solution.stats["num_steps"]), scene(), choose_method(scene(), "auto"))


def test_evaluations_of_implicit_methods_are_not_known():
    scene = jd.scenes.pendulum_in_plane()
    assert evaluations("Kvaerno5", 10, scene, choose_method(scene, "auto")) is None


@pytest.mark.long
def test_every_way_can_be_simulated():
    """Solvers suit the steps they get, methods the scene, and ladders go from coarse to fine."""
    for case in cases().values():
        scene = scene_of(case.name)
        pairs = running.combinations(case, bool(scene.constraints))
        assert len(set(pairs)) == len(pairs) >= 3
        for method, solver in pairs:
            choose_method(scene, method)
            choose_solver(SOLVERS[solver](), 0.1 if solver in FIXED else None)
            for dtype in ("float64", "float32"):
                assert np.all(np.diff(running.settings(case, solver, dtype)) < 0)


@pytest.fixture(scope="module")
def body():
    return prepare(cases()["free_body"])


@pytest.fixture(scope="module")
def rungs(body):
    return ladder(body, "free", "Tsit5", [1e-4, 1e-7], "float64", body.programs.batch_starts(1))


def contestant(motion):
    """A peer with a motion that is known."""
    return Contestant("peer", "by hand", "exact", 1.0, True, lambda: None, lambda _: motion)


@pytest.fixture(scope="module")
def records(body, rungs):
    """Two rungs of a ladder, a peer that is exact and one that failed."""
    exact = Motion(body.reference.q, body.reference.v)
    failed = Motion(np.nan * exact.q, np.nan * exact.v, "max_steps_reached")
    return measure(body, [*rungs, contestant(exact), contestant(failed)], "float64", 1, rounds=2)


def test_records_hold_what_a_motion_says(body, rungs, records):
    """Errors, energy and counts of a rung, from its motion by numpy and scipy."""
    motion, record = rungs[0].motion(rungs[0].call()), records[0]
    known, computed = (
        np.concatenate([Rotation.from_quat(np.roll(q, -1, 1)).as_matrix().reshape(len(q), 9), v], 1)
        for q, v in ((body.reference.q, body.reference.v), (motion.q, motion.v))
    )
    error = np.max(np.abs(computed - known) / (1 + np.abs(known)), 1)
    np.testing.assert_allclose([record.error_path, record.error_end], [error.max(), error[-1]], rtol=1e-9)
    energy = 0.5 * np.sum(MOMENTS * motion.v**2, 1)
    np.testing.assert_allclose(record.energy_error, np.abs(energy - energy[0]).max(), rtol=1e-9)
    assert record.residual_position is None
    assert record.steps == motion.steps
    # Seven stages, of which the last is the next step's first, quaternions put back before it; two choose the first step.
    assert record.evaluations == 7 * motion.steps - (motion.steps - 1) + 2
    assert record.seconds_best <= record.seconds_median
    assert record.rounds == 2
    assert records[1].error_path < 1e-2 * record.error_path
    assert records[1].compile_seconds == record.compile_seconds  # one program


def test_a_slow_run_is_timed_once(body, rungs):
    (record,) = measure(body, rungs[:1], "float64", 1, rounds=2, maximum=0.0)
    assert record.rounds == 1
    assert record.seconds_best == record.seconds_median > 0


def test_peers_and_failures_are_recorded(records):
    exact, failed = records[2:]
    assert exact.error_path == 0.0
    assert exact.label == "peer, exact"
    assert (failed.result, failed.error_path, failed.energy_error) == ("max_steps_reached", None, None)


def test_batches_start_along_the_motion(body):
    """Lanes of a batch are later states of the reference's motion, with their times."""
    q, v, ts = body.programs.batch_starts(25)
    assert np.ptp(ts - body.reference.ts, axis=1).max() < 1e-14
    np.testing.assert_allclose(ts[:, 0], 2.0 * np.arange(25) / 25)
    want = references.free_top(ts[:, 0])
    turned = [Rotation.from_quat(np.roll(x, -1, 1)).as_matrix() for x in (q, want.q)]
    np.testing.assert_allclose(turned[0], turned[1], atol=1e-10)
    np.testing.assert_allclose(v, want.v, atol=1e-10)


def made(error, seconds, solver="A", scene="one", **changes):
    values = dict.fromkeys(field.name for field in dataclasses.fields(Record))
    values |= {"source": "jaxdyn", "method": "m", "dtype": "float64", "batch": 1, "setting": 1.0, "fixed": False}
    values |= {"result": "successful", "rounds": 1, "seconds_median": seconds, "seconds_best": seconds}
    values |= {"error_path": error, "solver": solver, "scene": scene}
    return Record(**values | changes)


def test_front_and_cost_at_an_error():
    a, b, c = made(1e-2, 1.0), made(1e-4, 10.0), made(1e-3, 20.0)
    assert pareto_front([c, b, a, made(None, 0.1)]) == [a, b]
    assert cost_at([a, b], 1e-3) == pytest.approx(10**0.5)  # half way in the log-log plot
    assert cost_at([a, b], 1e-1) == 1.0
    assert cost_at([a, b], 1e-4) == 10.0
    assert cost_at([a, b], 1e-5) == np.inf


def test_beaten_by_whom():
    """Points below the front by how far, the worst first; failed ones and those above it are left out."""
    ours = [made(1e-2, 1.0), made(1e-4, 10.0), made(1e-3, 20.0)]
    peers = {
        "cheaper": made(1e-3, 1.0, source="peer"),  # the front is at 10**0.5 there
        "dearer": made(1e-3, 5.0, source="peer"),
        "exact": made(1e-6, 100.0, source="peer"),
        "rough": made(1e-1, 0.5, source="peer"),
        "failed": made(None, 0.1, source="peer"),
    }
    computed = beaten_by([*ours, *peers.values()])
    assert [r for r, _ in computed] == [peers[name] for name in ("exact", "cheaper", "rough")]
    assert [factor for _, factor in computed] == pytest.approx([np.inf, 10**0.5, 2.0])
    assert beaten_by(ours) == []
    with pytest.raises(ValueError, match="2 plots"):
        beaten_by([*ours, made(1e-3, 1.0, batch=2)])


def test_interleaved_drops_who_is_slow():
    calls = {"slow": 0, "fast": 0}

    def call(name):
        calls[name] += 1

    times = time_alternately({name: lambda name=name: call(name) for name in calls}, 5, minimum=0.0, maximum=-1.0)
    assert times["slow"]["rounds"] == times["fast"]["rounds"] == 3
    assert calls == {"slow": 5, "fast": 5}  # two to see how long it takes
    assert times["slow"]["best"] <= times["slow"]["median"]


@pytest.fixture
def small(monkeypatch, body):
    """Reports of the free body by one solver, its program made already; counts how often a scene is prepared."""
    prepared = []
    monkeypatch.setattr(running, "combinations", lambda *args, **options: [("free", "Tsit5")])
    monkeypatch.setattr(running, "settings", lambda *args, **options: [1e-4, 1e-7])
    monkeypatch.setattr(running, "prepare", lambda case: prepared.append(case.name) or body)
    return prepared


@pytest.mark.long
def test_report_writes(small, body, rungs, tmp_path):
    lines = []
    measured = jd.report("free_body", rounds=1, out=tmp_path, echo=lines.append)
    assert small == ["free_body"]
    assert "about 0 s left" in lines[-1]
    assert Report.from_json((tmp_path / "report.json").read_text()) == measured
    text = (tmp_path / "report.txt").read_text()
    assert "Free rigid body" in text
    assert "free, Tsit5" in text

    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg") == 1
    assert "src=" not in page
    assert "<link" not in page
    assert 'href="http' not in page
    for words in ("Free rigid body", "time per trajectory", "energy error", "free, Tsit5"):
        assert words in page
    assert measured.head["machine"]["device"] in page
    peer = contestant(Motion(body.reference.q, body.reference.v))
    with_peers = jd.report("free_body", rounds=1, peers=lambda *_: [peer])
    assert {r.source for r in with_peers.records} == {"jaxdyn", "peer"}


def test_command(small, rungs, capsys):
    assert main(["report", "--list"]) == 0
    assert set(jd.scenes.names()) == {line.split()[0] for line in capsys.readouterr().out.splitlines()}
    assert main(["report", "free_body", "--rounds", "1"]) == 0
    text = capsys.readouterr().out
    assert "1.0e-07" in text
    assert "2 runs in" in text
    assert small == ["free_body"]


@pytest.mark.parametrize("name", ["scenes", "dtypes", "batches", "integrators"])
def test_empty_arguments_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} is empty"):
        jd.report(**({"scenes": "free_body"} | {name: []}))


def test_scenes_that_cannot_be_compared_are_refused():
    with pytest.raises(ValueError, match="'sliding_block', whose steps"):
        jd.report("sliding_block")
    with pytest.raises(ValueError, match="free_body, free_body"):
        jd.report([cases()["free_body"], "free_body"])


@pytest.mark.long
def test_a_scene_of_ones_own(rungs, monkeypatch):
    """A pendulum with its exact motion for a small angle, and without: then a converged solution is the reference."""
    monkeypatch.setattr(running, "settings", lambda *args, **options: [1e-4, 1e-9])
    model, ts = jd.robots.chain(1), np.linspace(0.0, 0.5, 3)
    case = Case("mine", "A pendulum of mine", lambda: (jd.Scene(model), (np.array([0.4]), np.zeros(1))), None, ts, 20)
    compare = functools.partial(jd.report, rounds=1, integrators=[("free", "Dopri8")])
    measured = compare(case)
    coarse, fine = (record.error_path for record in measured.records)
    fine_setting = measured.records[1].setting
    assert fine < 1e-8 < coarse < 1e-2
    several = compare(case, dtypes=("float32", "float64"), batches=(1, 3))
    found = {(record.dtype, record.batch, record.solver) for record in several.records}
    assert found == {(dtype, batch, "Dopri8") for dtype in ("float32", "float64") for batch in (1, 3)}
    # The fine rung in float64 is that of before; float32 has its rounding.
    errors = {(r.dtype, r.batch): r.error_path for r in several.records if r.setting == fine_setting}
    assert errors["float64", 3] == pytest.approx(fine, rel=0.5) and errors["float32", 1] > 1e-8
    wrong = Reference(ts, np.full((3, 1), 0.4), np.zeros((3, 1)), "wrong", "a guess")
    assert all(record.error_path > 0.1 for record in compare(case._replace(reference=lambda start: wrong)).records)


def test_a_page_without_matplotlib_is_refused_before_the_runs(small, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"jaxdyn\[plot\]"):
        jd.report("free_body", rounds=1, out=tmp_path)
    assert small == []


@pytest.mark.long
def test_a_batch_fails_with_any_of_its_trajectories(body):
    q, v, ts = body.programs.batch_starts(2)
    bad = np.stack([v[0], np.nan * v[1]])
    rung = ladder(body, "free", "Tsit5", [1e-4], "float64", (q, bad, ts))[0]
    assert rung.motion(rung.call()).result == "nonfinite_start"
    with pytest.raises(RuntimeError, match="no starts for a batch"):
        Programs(body.scene, (q[0], np.nan * v[0]), body.programs.ts).batch_starts(2)


def test_report_needs_float64():
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        jd.report("free_body")


def test_page_escapes():
    """Failures without a plot, names that are no HTML."""
    head = {"machine": {"processor": "<cpu>", "cores": 1, "device": "cpu", "load": 0.0, "versions": {}}}
    head |= {"date": "today"}
    known, bad = SceneReference("One & only", "printed", "x", 1e-9), made(None, 1.0, result="bad")
    report = Report(head, {"one": known}, (made(1e-3, 1.0), made(0.0, 2.0, evaluations=10), bad))
    page = html_page(report)
    assert "&lt;cpu&gt;" in page
    assert "One &amp; only" in page
    failed = dataclasses.replace(report, records=(bad,))
    assert "No run succeeded" in html_page(failed)


def test_printed_ends_are_as_printed():
    """Published digits of Andrews' mechanism agree with the reference as far as they go: q to 1e-9, rates to 6e-8."""
    case = cases()["andrews"]
    reference = case.reference(case.build()[1])
    q = (15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948, 0.5244099658805304)
    rates = (1139.920302151208, -1424.379294994111, 11.03291221937134, 19.29337464421385, 0.5735699284790808)
    np.testing.assert_allclose(reference.q[-1, :5], q, rtol=1e-9)
    np.testing.assert_allclose(reference.v[-1, :5], rates, rtol=6e-8)
    # The chassis of the car axis has its length, and its speed along it is zero.
    computed = car_axis(cases()["car_axis"].build()[1])
    (xl, yl, xr, yr), (vxl, vyl, vxr, vyr) = computed.q[-1], computed.v[-1]
    assert (xl - xr) ** 2 + (yl - yr) ** 2 == pytest.approx(1.0, abs=1e-14)
    assert (xl - xr) * (vxl - vxr) + (yl - yr) * (vyl - vyr) == pytest.approx(0.0, abs=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("name", references.CLOSED_FORMS)
def test_a_named_scene_is_compared_with_its_closed_form(name):
    """Which a run of the library follows from the scene's default start for a second."""
    prepared = prepare(case_of_scene(name))
    assert prepared.reference.kind == "closed form" and prepared.reference.error < 1e-11
    assert prepared.errors(*prepared.programs.solve("auto", "Dopri8", 1e-13)).max() < 1e-10


def test_ball_on_a_turntable_in_closed_form_rolls():
    """Its velocity at the contact is the table's; the rate of its quaternion is that of its angular velocity, by differences."""
    ts = np.linspace(0.0, 1.0, 2001)
    known = references.turntable(ts)
    turned = Rotation.from_quat(np.roll(known.q[:, 4:], -1, 1))
    spin, place = turned.apply(known.v[:, 4:]), known.q[:, 1:4] * [1, 1, 0]
    at_contact = turned.apply(known.v[:, 1:4]) + np.cross(spin, [0.0, 0.0, -0.2])
    np.testing.assert_allclose(at_contact, np.cross([0.0, 0.0, 3.0], place), rtol=0, atol=1e-13)
    # Of the second order in the step of 0.5 ms.
    steps = (turned[:-2].inv() * turned[2:]).as_rotvec() / (ts[2] - ts[0])
    np.testing.assert_allclose(steps, known.v[1:-1, 4:], rtol=0, atol=2e-4)
