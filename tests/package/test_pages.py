"""The documents: links lead somewhere, exports are described, examples run as they are printed."""

import inspect
import re
from urllib.parse import unquote

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pages import ROOT, anchors, links, pages, run

import jaxdyn as jd


def test_links_of_all_pages_lead_somewhere():
    wrong = []
    for page in pages():
        for target in links(page.read_text()):
            if re.match(r"[a-z]+:", target) or target.startswith("gallery/"):  # the gallery's pictures are made
                continue
            path, _, anchor = unquote(target).partition("#")
            other = (page.parent / path).resolve() if path else page
            if not other.exists():
                wrong.append(f"{page.relative_to(ROOT)}: {target}")
            elif anchor and other.suffix == ".md" and anchor not in anchors(other.read_text()):
                wrong.append(f"{page.relative_to(ROOT)}: {target} (no such heading)")
    assert not wrong, "\n".join(wrong)


def exports() -> set[str]:
    """All that users call, by the name that they write after `jd.`; `scale` has a page of its own, docs/scale.md."""
    groups = [name for name in jd.__all__ if inspect.ismodule(getattr(jd, name)) and name != "scale"]
    found = {name: getattr(jd, name) for name in jd.__all__}
    # The names used most stand in `jd` and in their room.
    shown = {id(x) for x in found.values()}
    for group in groups:
        room = getattr(jd, group)
        found |= {f"{group}.{n}": getattr(room, n) for n in dir(room) if id(getattr(room, n)) not in shown}
    return {name for name, x in found.items() if callable(x) and not inspect.ismodule(x)}


def test_reference_has_every_export():
    """Each by its name, on one of the pages below docs/reference; recursions stand where they are written."""
    text = "\n".join(page.read_text() for page in (ROOT / "docs/reference").glob("*.md"))
    listed = {re.sub(r"recursions\.\w+\.", "", name) for name in re.findall(r"^::: jaxdyn\.(.*)$", text, re.M)}
    assert len(exports()) > 300 and not exports() - listed, exports() - listed


def test_names_in_the_documents_exist():
    wrong = []
    for page in pages():
        for name in re.findall(r"`jd\.([\w.]+)`", page.read_text()) if page.name != "CHANGELOG.md" else ():
            value = jd
            for part in name.split("."):
                value = getattr(value, part, None)
            wrong += [f"{page.relative_to(ROOT)}: jd.{name}"] if value is None else []
    assert not wrong, "\n".join(wrong)


# --- examples: what the names that a page leaves have to be ---


def readme(names):
    # Save points stand between steps: the energy (84 J) is that of the dense output.
    assert np.abs(names["motion"].constraint_residual).max() < 1e-10 and np.ptp(names["motion"].energy) < 1e-6 * 84
    assert names["weights"].shape == (100, 3) and names["jacobians"].shape == (100, 3, 3, 10)
    # The weight is linear in the ten numbers of each body.
    inertias = names["scene"].system.inertias
    np.testing.assert_allclose(jnp.einsum("ncbk,bk->nc", names["jacobians"], inertias), names["weights"], atol=1e-10)


def first_steps(names):
    assert np.abs(names["turning"].constraint_residual).max() < 1e-14 and np.ptp(names["turning"].q[:, 2]) > 0.05
    assert np.abs(names["a"]).max() < 1e-10, "gravity compensation holds the arm still"
    np.testing.assert_allclose(names["tip"][:3, 3], [0, 0, 1.261], atol=1e-12)
    assert names["accelerations"].shape == (1000, 7) and np.isfinite(names["gradient"]).all()
    assert 0 < names["drift"] < 1e-6


def systems(names):
    assert abs(names["lost"] + names["motion"].work[-1]) < 1e-7 < 0.1 < names["lost"]
    assert abs(names["curvature"] - 1) < 1e-12 and np.abs(names["force"]).max() < 1e-12
    # The rods pull along themselves.
    s, lower = names["angles"], names["lower"]
    assert abs(lower @ jnp.stack([jnp.cos(s[1]), jnp.sin(s[1])])) < 1e-12 < 1 < np.linalg.norm(lower)
    np.testing.assert_allclose(names["fit"].values, [0.5, 2.0, 0.8], rtol=1e-8)  # bob, cart, length


def events(names):
    found = names["motion"].events
    assert list(found.name[:2]) == ["lane: touch", ""]
    np.testing.assert_allclose(found.time[0], np.sqrt(0.8 / 9.81), rtol=1e-9)
    # Rolling keeps 5/7 of the velocity.
    np.testing.assert_allclose(names["motion"].q[-1, 0], 2 * (found.time[0] + 5 / 7 * (2 - found.time[0])), rtol=1e-7)
    assert np.isfinite(names["derivative"]) and names["derivative"] != 0


def constraints(names):
    # Power of the motor that turns the crank at a constant rate: the rate of the energy.
    q, v, model = names["moving"].q, names["moving"].v, names["model"]
    dynamics = jd.constrained_dynamics(names["driven"], q, v)
    _, rate = jax.jvp(lambda q, v: jd.kinetic_energy(model, q, v), (q, v), (v, dynamics.acceleration))
    np.testing.assert_allclose(names["torque"] * v[0], rate + jd.gravity_force(model, q) @ v, rtol=1e-10)
    assert float(names["start"].residual.max()) < 1e-11 and names["eta"].shape == (1, 5)
    # Half of the weight and a newton of margin in each contact: mu f_z - |f_x| = 1.
    np.testing.assert_allclose(names["forces"].contact_forces, 2 * [0.1 * 9.81, (1 + 0.981) / 0.8], rtol=1e-5)
    assert all(margin > 1 for margin in names["least"].values())
    np.testing.assert_allclose(names["motion"].q[-1, 2:5], [0.0, 0.32, 0.0], atol=1e-3)
    assert names["motion"].success


def pictures(names):
    assert names["address"].startswith("http://127.0.0.1")
    np.testing.assert_array_equal(names["log"].q, names["recorded"].q)


def sweep(names):
    """A crank that turns once returns to its place; so do the other joints, but for whole turns."""
    sweep, turns = names["sweep"], (names["sweep"].q[-1] - names["sweep"].q[0]) / (2 * np.pi)
    assert sweep.success.all() and not names["jumps"].any()
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    assert np.abs(np.diff(names["path"], axis=0)).max() < 0.2 * np.ptp(names["path"])


def workspace(names):
    """The places within two lengths of all bases; the margin is zero where the first two arms are in one line."""
    bases = np.array([(0.0, 1.2), (-1.04, -0.6), (1.04, -0.6)])
    distance = np.linalg.norm(np.asarray(names["grid"])[:, None] - bases, axis=2)
    assert np.mean(np.asarray(names["inside"]) == (distance < 2).all(1)) > 0.9
    assert np.isfinite(names["margin"]).all()


def parallel_robot(names):
    assert names["mobility"] == 2
    assert np.abs(names["held"].acceleration).max() < 1e-10
    assert np.abs(names["fall"].constraint_residual).max() < 1e-10
    # The motor's bearing transmits the motor's torque about its axis.
    np.testing.assert_allclose(names["bearing"][5], names["torques"][0], rtol=1e-10)


def bicycle(names):
    """At 5 m/s, by Meijaard, Papadopoulos, Ruina & Schwab (2007), table 2; the other six are zero."""
    wanted = [-14.07838969279822, -0.77534188219585, -0.77534188219585, -0.32286642900409]
    parts = np.sort(np.asarray(names["eigenvalues"][50].real))
    np.testing.assert_allclose(parts[:4], wanted, rtol=1e-11)
    assert np.abs(parts[4:]).max() < 1e-7


def diffeqsolve(names):
    q, v, ts = (names[x] for x in ("q", "v", "ts"))
    steps = jd.simulation.Steps(rtol=1e-9, atol=1e-9)
    ours = jd.simulate(names["hand"], q, v, ts, control=names["law"], stepsize=steps)
    assert np.abs(ours.q - names["configurations"]).max() < 1e-6
    assert np.abs(names["torques"] - np.array([0.3, 0.8])).max() < 1e-3


def true(expression: str):
    """A check that an expression in the names of the page is true."""
    return lambda names: eval(expression, {"np": np, **names}) or pytest.fail(expression)


SLOW, LONG = pytest.mark.slow, pytest.mark.long
# Page or section of a page, what its names have to be, files that its examples write, and the mark.
EXAMPLES = [
    ("README.md", readme, ["four_bar.png"], LONG),
    ("docs/start.md", first_steps, ["engine.gif"], LONG),
    ("docs/systems.md", systems, [], SLOW),
    ("docs/simulation.md#Events", events, [], SLOW),
    (
        "docs/hands.md",
        true(
            "closure.closed and closure.margin > 0.1 and held.success and abs(margin - 0.5) < 1e-6 and measure.is_manipulable"
        ),
        [],
        SLOW,
    ),
    ("docs/constraints.md", constraints, [], SLOW),
    ("docs/pictures.md", pictures, ["four_bar.png", "four_bar.gif", "four_bar.html", "motion.csv"], SLOW),
    ("docs/gallery.md", true("motion.success"), ["four_bar.gif"], SLOW),
    ("docs/drives.md", true("motion.success and np.allclose(fit.values, [0.06, 0.3], rtol=1e-3)"), [], SLOW),
    ("docs/inverse.md", true("batch.success.mean() > 0.99 and not path.changes_branch.any()"), [], SLOW),
    ("docs/optimal_control.md", true("plan.success"), [], SLOW),
    ("docs/sensors.md", true("log['wrist'].shape == (51, 6)"), [], SLOW),
    ("docs/recipes.md#Environment step", true("after > before + 5"), [], LONG),
    ("docs/recipes.md#Optimising a geometry", true("np.allclose(lengths, [0.32, 0.95, 0.75], 1e-9, 0)"), [], SLOW),
    ("docs/recipes.md#Sweeping a linkage", sweep, [], ()),
    ("docs/recipes.md#Workspace and singular configurations of a parallel robot", workspace, [], SLOW),
    (
        "docs/recipes.md#Checking a gradient through contact",
        true("mismatch < 1e-9 < 0.1 < abs(gradient(v)).max()"),
        [],
        LONG,
    ),
    # The circle starts with 0.2 m/s, the arm at rest: the error rises and then decays as its gains say.
    (
        "docs/recipes.md#Operational space",
        true("missed.max() < 5e-3 and missed[-1] < 1e-6 and np.linalg.eigvalsh(mass_at_the_tip).min() > 0.1"),
        [],
        SLOW,
    ),
    ("docs/recipes.md#A parallel robot from code", parallel_robot, [], SLOW),
    ("docs/recipes.md#A sampled controller", true("left.max() < 1e-3 and np.isfinite(regulated.torque).all()"), [], ()),
    # What weighs more sags more.
    (
        "docs/recipes.md#Monte Carlo of payloads",
        true("0.01 < quantiles[1] < 0.1 and np.corrcoef(masses, sags)[0, 1] > 0.95"),
        [],
        LONG,
    ),
    *(
        (f"docs/control/{path.stem}.md", None, [], SLOW)
        for path in sorted((ROOT / "docs/control").glob("*.md"))
        if "```python" in path.read_text()
    ),
]
# Scripts that draw a figure of the same name.
SCRIPTS = {
    "bicycle": bicycle,
    "delta": true("path.success.all() and np.abs(tau).max() < 20"),
    "diffeqsolve": diffeqsolve,
    "hopper": true("losses[-1] < 0.05 * losses[0] and mismatch < 1e-7"),
    "payload": true("np.abs(found - payload).max() < 0.02"),
    "policy_gradient": true("losses[-1] < 0.7 * losses[0]"),
    "predictive_control": true("abs(np.cos(states[-1][1]) + 1) < 0.02"),
    "quadruped": true("losses[-1] < 0.05 * losses[0]"),
    "synthesis": true("openings[0] > 0.1 and openings[1] < 1e-9 and losses[-1] < 0.05"),
    "vehicles": true("success.all() and missed.max() < 1.0"),
}
EXAMPLES += [(f"docs/examples/{name}.md", check, [f"{name}.png"], SLOW) for name, check in SCRIPTS.items()]
# A picture that shows something has more bytes than these.
LEAST = {".png": 10_000, ".gif": 50_000}


@pytest.mark.parametrize(
    ("place", "check", "files"),
    [pytest.param(*row[:3], marks=row[3], id=row[0].removeprefix("docs/")) for row in EXAMPLES],
)
def test_examples_run_as_printed(place, check, files, tmp_path, monkeypatch):
    page, _, section = place.partition("#")
    if page == "docs/pictures.md":
        pytest.importorskip("viser", reason="viser is not installed")
    monkeypatch.chdir(tmp_path)
    names = run(page, section, head=page == "docs/recipes.md")
    if check is not None:
        check(names)
    for name in files:
        assert (tmp_path / name).stat().st_size > LEAST.get((tmp_path / name).suffix, 0)


def test_every_script_of_the_pages_is_checked():
    assert {path.stem for path in (ROOT / "docs/examples").glob("*.md")} == {"index", *SCRIPTS}
