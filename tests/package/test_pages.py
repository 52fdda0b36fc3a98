"""The documents: links lead somewhere, exports are described, examples run as they are printed."""

import ast
import inspect
import re
from urllib.parse import unquote

import jax
import numpy as np
import pytest
from pages import ROOT, anchors, links, pages, run

import jaxdyn as jd
from benchmarks import browser, gallery
from benchmarks.gallery import SCENES


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


def test_every_page_is_in_the_menu_of_the_site():
    text = (ROOT / "mkdocs.yml").read_text()
    missing = [page.name for page in (ROOT / "docs").glob("*.md") if f": {page.name}" not in text]
    assert not missing, missing


def test_modules_that_the_page_on_design_lists_exist():
    """The tables of subpackages, and of the modules of the compiler."""
    text, wrong = (ROOT / "docs" / "design.md").read_text(), []
    for room, listed in re.findall(r"^\| \d+ \| `(\w+)/` \| \d+ \| (.*?) \|", text, re.M):
        modules = {path.stem for path in (ROOT / "jaxdyn" / room).rglob("*")}
        wrong += [f"{room}/{name}" for name in re.findall(r"`(\w+)/?`", listed) if name not in modules]
    modules = {path.name.removesuffix(".py") for path in (ROOT / "jaxdyn" / "compile").iterdir()}
    listed = re.findall(r"`([\w.]+)`", " ".join(re.findall(r"^\| (`.*?`) \| ", text, re.M)))
    wrong += [name for name in listed if name not in modules]
    assert listed and not wrong, wrong


def test_gallery_shows_what_its_command_makes():
    shown = re.findall(r"\(gallery/(\w+)\.gif\)", (ROOT / "docs" / "gallery.md").read_text())
    assert shown == list(SCENES) and set(shown) <= set(jd.scenes.names())


def test_pictures_are_made_again_for_code_alone():
    source = 'def f(x):\n    "a"\n    return x + 1  # one\n'
    assert gallery._code(source) == gallery._code("def f(x):\n    return (x + 1)\n")
    assert gallery._code(source) != gallery._code(source.replace("1", "2"))
    assert gallery.digest("four_bar") != gallery.digest("bicycle")


@pytest.mark.slow
@pytest.mark.skipif(browser.browser() is None, reason="no browser is installed")
def test_browser_reports_what_it_does_not_show(tmp_path):
    good = '<article>text<div class="arithmatex"><span class="katex">x</span></div></article>'
    wide = '<article><p style="width: 600px">wide</p></article>'
    bad = r'<article><div class="arithmatex">\[x\]</div>, $\dot x$<img src="none.png"></article>'
    for name, body in (("good", good), ("wide", wide), ("bad", bad)):
        (tmp_path / f"{name}.html").write_text(f"<!doctype html><body style='margin: 0'>{body}</body>")
    found = browser.faults(tmp_path)
    assert not any(fault.startswith("/good.html") for fault in found)
    assert [fault for fault in found if fault.startswith("/wide.html")] == [
        "/wide.html at 400 pixels: page is 600 pixels wide: P wide"
    ]
    for what in ("formula is not set", "source of a formula", "picture is not shown: none.png"):
        assert sum(fault.startswith("/bad.html") and what in fault for fault in found) == 2, found


@pytest.mark.slow
def test_example_of_the_gallery_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("docs/gallery.md", least=1)["motion"].success and (tmp_path / "four_bar.gif").stat().st_size > 50_000


def test_reference_has_every_export():
    """Each by its name, on one of the pages below docs/reference."""
    listed = re.findall(
        r"^::: jaxdyn\.(.*)$", "\n".join(p.read_text() for p in (ROOT / "docs/reference").glob("*.md")), re.M
    )
    named = {name.removeprefix("jd.") for name in exports()}
    recursions = {
        "dynamics.rnea",
        "dynamics.crba",
        "dynamics.aba",
        "dynamics.mass_matrix_sqrt",
    }  # listed where they are written
    missing = named - set(listed) - recursions
    assert not missing and all(any(x.endswith(n.partition(".")[2]) for x in listed) for n in recursions), sorted(
        missing
    )


DOCUMENT_FUNCTIONS = """dynamics.aba dynamics.articulated_bodies dynamics.base_twists dynamics.com_dynamics com_jacobian
    constrained_dynamics
    reduction.involutive dynamics.link_adjoints dynamics.mass_matrix_sqrt newton_euler_matrices constraints.projections
    contact.RollingModel reduction.spurious_terms control.underactuated_inverse_dynamics contact.contact_coordinates
    contact.montana control.ContactCoordinates control.GaugeInvariant control.GraspForce control.HybridForce
    control.WholeBody geometry.arnold_form geometry.covariant_derivative grasp.forces_for_wrench grasp.hand_dynamics
    grasp.hand_motions grasp.hold scenes.coordinated_lifting scenes.rough_disk_and_link scenes.sphere_arm
    so3.euler_body_jacobian so3.euler_spatial_jacobian""".split()


def test_functions_of_the_documents_exist():
    """Every function that the page on equations names, and all that its table and "In jaxdyn" lines have to name."""
    text = (ROOT / "docs/equations.md").read_text()
    table = text.partition("## 14. ")[2]
    named, in_table = (set(re.findall(r"`jd\.([\w.]+)`", part)) for part in (text, table))
    missing = []
    for name in named:
        value = jd
        for part in name.split("."):
            value = getattr(value, part, None)
        missing += [name] if value is None else []
    assert not missing, missing
    lines = "".join(re.findall(r"\*\*In jaxdyn:\*\*.*?\n\n", text, re.S))
    in_lines = set(re.findall(r"`jd\.([\w.]+)`", lines))
    assert not set(DOCUMENT_FUNCTIONS) - in_lines, set(DOCUMENT_FUNCTIONS) - in_lines
    assert not set(DOCUMENT_FUNCTIONS) - in_table, set(DOCUMENT_FUNCTIONS) - in_table
    # Each erratum is met on the way, but those of notation alone.
    errata = set(re.findall(r'id="(e\d+)"', text))
    ranges = re.findall(r"\(#e(\d+)\)-\[E(\d+)\]", table)
    cited = set(re.findall(r"\(#(e\d+)\)", table)) | {f"e{n}" for a, b in ranges for n in range(int(a), int(b) + 1)}
    assert not errata - cited, sorted(errata - cited)


# `scale` has a page of its own, docs/scale.md.
GROUPS = [name for name in jd.__all__ if inspect.ismodule(getattr(jd, name)) and name != "scale"]


def exports() -> dict[str, object]:
    """All that users call, by the name that they write: the names of jaxdyn, and those of its groups."""
    computed = {f"jd.{name}": getattr(jd, name) for name in jd.__all__}
    shown = {id(x) for x in computed.values()}
    for group in GROUPS:
        room = getattr(jd, group)
        # The names used most stand in `jd` and in their room.
        computed |= {f"jd.{group}.{n}": getattr(room, n) for n in dir(room) if id(getattr(room, n)) not in shown}
    return {name: x for name, x in computed.items() if callable(x) and not inspect.ismodule(x)}


def test_every_export_is_described():
    """A docstring of its own, and the shape of what is an array among the arguments."""
    wrong = []
    for name, value in exports().items():
        text = inspect.getdoc(value) or ""
        if not text or (inspect.isclass(value) and not vars(value).get("__doc__")):
            wrong.append(f"{name}: no docstring")
        elif inspect.isfunction(value):
            arrays = [p for p in inspect.signature(value).parameters.values() if "Float" in str(p.annotation)]
            if arrays and not re.search(r"\((n\w*|\d)?,? ?[\w* ,]*\)", text):
                wrong.append(f"{name}: no shape of {arrays[0].name}")
    assert len(exports()) > 300 and not wrong, "\n".join(wrong)


SECTION = re.compile(
    r"\*\*(?:Arguments|Fields):\*\*(.*?)(?=\n\s*\*\*[A-Z]|\n\s*```|\n\s*Source:|\n\n(?!\s*- )|\Z)", re.S
)
HEAD = re.compile(r"((?:`\w+`(?: \([^)]*\)){0,3}(?:, | and )?)+)")
CALL = re.compile(r"(?<![\w.`])([a-z_]\w+)\((?:system, )?q(?:, v)?(?:, t)?\)")
# Options that are passed on, behind the one that takes them.
PASSED_ON = {"run": {"parameter_NAME", "result", "num_steps", "time_reached"}}


def arguments_in(text: str) -> list[str]:
    """Names that open a part of the section on arguments."""
    names = []
    for section in SECTION.findall(text):
        for part in re.split(r"\n\s*- |; (?=`)|(?<=\.) (?=`\w+`[:,] )", section):
            words = " ".join(part.split())
            head = HEAD.match(words)
            if head and (head[1].endswith(", ") or words[head.end() :][:1] in ("", ":", ".", ";")):
                names += re.findall(r"`(\w+)`", head[1])
    return names


@pytest.mark.long
def test_docstrings_name_arguments_that_exist():
    """Every function, method and class of the package: what is described is an argument, a field, or a name of the module."""
    wrong, count = [], 0
    trees = {path: ast.parse(path.read_text()) for path in sorted((ROOT / "jaxdyn").rglob("*.py"))}
    classes = {node.name: node for tree in trees.values() for node in tree.body if isinstance(node, ast.ClassDef)}
    for path, tree in trees.items():
        used = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)} | {
            n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)
        }
        used |= {n.arg for n in ast.walk(tree) if isinstance(n, ast.arg)}
        used |= {n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)}
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef | ast.ClassDef):
                continue
            text = ast.get_docstring(node) or ""
            known = PASSED_ON.get(node.name, set()) | parameters(node, classes)
            named = arguments_in(text)
            count += len(named)
            where = f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}"
            wrong += [f"{where} has no argument {name}" for name in named if name not in known]
            wrong += [f"{where}: there is no {name}(...)" for name in CALL.findall(text) if name not in used | BUILT_IN]
    assert count > 800 and not wrong, "\n".join(wrong)


# Of the mathematics in docstrings.
BUILT_IN = {"psi", "g_i", "g_j"}


def parameters(node: ast.FunctionDef | ast.ClassDef, classes: dict[str, ast.ClassDef]) -> set[str]:
    """Names of the arguments of a function, or of the constructor and fields of a class and those it is made of."""
    if isinstance(node, ast.FunctionDef):
        given = node.args
        every = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
        return {one.arg for one in every if one is not None}
    names = {x.target.id for x in node.body if isinstance(x, ast.AnnAssign) and isinstance(x.target, ast.Name)}
    for part in node.body:
        if isinstance(part, ast.FunctionDef) and part.name in ("__init__", "__new__", "create"):
            names |= parameters(part, classes)
    for base in node.bases:
        if isinstance(base, ast.Name) and base.id in classes:
            names |= parameters(classes[base.id], classes)
    return names


@pytest.mark.slow
def test_examples_of_the_page_on_pictures_run(tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="viser is not installed")
    monkeypatch.chdir(tmp_path)
    names = run("docs/pictures.md")
    assert {"four_bar.png", "four_bar.gif", "four_bar.html", "motion.csv"} <= {path.name for path in tmp_path.iterdir()}
    assert names["address"].startswith("http://127.0.0.1")
    np.testing.assert_array_equal(names["log"].q, names["recorded"].q)


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted(path.stem for path in (ROOT / "docs/control").glob("*.md")))
def test_pages_of_control_laws(page):
    """Each has its equation, an example that runs, a drawing and the command that makes it."""
    text = (ROOT / f"docs/control/{page}.md").read_text()
    assert "python -m benchmarks.control_figures" in text and "](../figures/control_" in text
    if "```python" in text:
        run(f"docs/control/{page}.md", least=1)


@pytest.mark.slow
@pytest.mark.parametrize("page", ["drives", "inverse", "optimal_control", "sensors"])
def test_pages_of_robots(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(f"docs/{page}.md", least=1)
    checks = {
        "drives": lambda n: (
            np.allclose(n["fit"].values, [0.06, 0.3], rtol=1e-3)
            and bool(n["motion"].success)
            and n["derivatives"].shape == (2,)
        ),
        "inverse": lambda n: n["batch"].success.mean() > 0.99 and not n["path"].changes_branch.any(),
        "optimal_control": lambda n: bool(n["plan"].success),
        "sensors": lambda n: n["log"]["wrist"].shape == (51, 6),
    }
    assert checks[page](names)


@pytest.mark.slow
def test_examples_of_the_page_on_constraints_run():
    names = run("docs/constraints.md", least=6)
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


def recipe(section: str, least: int = 2) -> dict:
    return run("docs/recipes.md", section, least, head=True)


@pytest.mark.long
def test_recipe_environment_step():
    names = recipe("Environment step")
    assert names["after"] > names["before"] + 5


@pytest.mark.slow
def test_recipe_geometry():
    np.testing.assert_allclose(recipe("Optimising a geometry")["lengths"], [0.32, 0.95, 0.75], rtol=1e-9)


def test_recipe_sweep():
    """A crank that turns once returns to its place; so do the other joints, but for whole turns."""
    names = recipe("Sweeping a linkage")
    sweep, turns = names["sweep"], (names["sweep"].q[-1] - names["sweep"].q[0]) / (2 * np.pi)
    assert sweep.success.all() and not names["jumps"].any()
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    assert np.abs(np.diff(names["path"], axis=0)).max() < 0.2 * np.ptp(names["path"])


@pytest.mark.slow
def test_recipe_workspace():
    """The places within two lengths of all bases; the margin is zero where the first two arms are in one line."""
    names = recipe("Workspace and singular configurations of a parallel robot")
    bases = np.array([(0.0, 1.2), (-1.04, -0.6), (1.04, -0.6)])
    distance = np.linalg.norm(np.asarray(names["grid"])[:, None] - bases, axis=2)
    assert np.mean(np.asarray(names["inside"]) == (distance < 2).all(1)) > 0.9
    assert np.isfinite(names["margin"]).all()


def has_published_eigenvalues(names):
    """At 5 m/s, by Meijaard, Papadopoulos, Ruina & Schwab (2007), table 2; the other six are zero."""
    wanted = [-14.07838969279822, -0.77534188219585, -0.77534188219585, -0.32286642900409]
    parts = np.sort(np.asarray(names["eigenvalues"][50].real))
    return np.allclose(parts[:4], wanted, rtol=1e-11) and np.abs(parts[4:]).max() < 1e-7


def agrees_with_simulate(names):
    q, v, ts = (names[x] for x in ("q", "v", "ts"))
    ours = jd.simulate(
        names["hand"], q, v, ts, control=names["law"], stepsize=jd.simulation.Steps(rtol=1e-9, atol=1e-9)
    )
    return np.abs(ours.q - names["configurations"]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", sorted(path.stem for path in (ROOT / "docs/examples").glob("*.md") if path.stem != "index")
)
def test_examples(page, tmp_path, monkeypatch):
    """A script of less than 60 lines of code, with its figure."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / f"docs/examples/{page}.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert sum(bool(line) for line in block.splitlines()) < 60 and (ROOT / f"docs/figures/example_{page}.png").exists()
    names = run(f"docs/examples/{page}.md", least=1)
    assert (tmp_path / f"{page}.png").stat().st_size > 10_000
    checks = {
        "bicycle": has_published_eigenvalues,
        "delta": lambda n: bool(n["path"].success.all()) and np.abs(n["tau"]).max() < 20,
        "diffeqsolve": lambda n: np.abs(n["torques"] - np.array([0.3, 0.8])).max() < 1e-3 and agrees_with_simulate(n),
        "hopper": lambda n: n["losses"][-1] < 0.05 * n["losses"][0] and n["mismatch"] < 1e-7,
        "payload": lambda n: np.abs(n["found"] - n["payload"]).max() < 0.02,
        "policy_gradient": lambda n: n["losses"][-1] < 0.7 * n["losses"][0],
        "predictive_control": lambda n: abs(np.cos(n["states"][-1][1]) + 1) < 0.02,
        "quadruped": lambda n: n["losses"][-1] < 0.05 * n["losses"][0],
        "synthesis": lambda n: n["openings"][0] > 0.1 and n["openings"][1] < 1e-9 and n["losses"][-1] < 0.05,
        "vehicles": lambda n: bool(n["success"].all()) and n["missed"].max() < 1.0,
    }
    assert checks[page](names)


@pytest.mark.long
def test_recipe_gradient_through_contact():
    names = recipe("Checking a gradient through contact")
    assert names["mismatch"] < 1e-9 and np.abs(names["gradient"](names["v"])).max() > 0.1


@pytest.mark.slow
def test_recipe_operational_space():
    names = recipe("Operational space")
    # The circle starts with 0.2 m/s, the arm at rest: the error rises and then decays as its gains say.
    assert names["missed"].max() < 5e-3 and names["missed"][-1] < 1e-6
    assert np.linalg.eigvalsh(names["mass_at_the_tip"]).min() > 0.1


@pytest.mark.slow
def test_recipe_parallel_robot():
    names = recipe("A parallel robot from code")
    assert names["mobility"] == 2
    assert np.abs(names["held"].acceleration).max() < 1e-10
    assert np.abs(names["fall"].constraint_residual).max() < 1e-10
    # The motor's bearing transmits the motor's torque about its axis.
    np.testing.assert_allclose(names["bearing"][5], names["torques"][0], rtol=1e-10)


def test_recipe_sampled_controller():
    names = recipe("A sampled controller")
    assert names["left"].max() < 1e-3 and np.isfinite(names["regulated"].torque).all()


@pytest.mark.long
def test_recipe_payloads():
    names = recipe("Monte Carlo of payloads")
    assert np.isfinite(names["sags"]).all() and 0.01 < names["quantiles"][1] < 0.1
    assert np.corrcoef(names["masses"], names["sags"])[0, 1] > 0.95  # what weighs more sags more
