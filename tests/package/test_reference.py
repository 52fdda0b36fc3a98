"""The reference: every export has an example, every example runs as it stands on its page."""

import contextlib
import inspect
import io
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pages import ROOT

import jaxdyn as jd
from benchmarks import argument_tables
from jaxdyn.systems.system import System

REFERENCE = ROOT / "docs" / "reference"
PAGES = sorted(path.stem for path in REFERENCE.glob("*.md") if path.stem != "index")
# Examples of docstrings that are not run here, for the same reasons.
NOT_RUN = {
    "contact.DryFriction": "test_friction_scenes",
    "control.ContactCoordinates": "test_contact_laws",
    "contact.RollingModel": "test_rolling_surfaces",
    "control.WholeBody": "test_whole_body",
    "contact.ground_contact": "test_events",
    "identify.fit_geometry": "test_geometry",
    "identify.fit_parameters": "test_identify_systems",
    "report": "test_report",
    "control.underactuated_inverse_dynamics": "test_legs",
}
ARM = """
builder = jd.ModelBuilder("arm")
for i in range(7):
    axis = [(0, 0, 1), (0, 1, 0)][i % 2]
    inertia = jd.inertia.box(1.0, (0.1, 0.1, 0.2))
    builder.add_body(f"b{i}", f"b{i - 1}" if i else None, axis=axis, pose=(0, 0, 0.2), inertia=inertia)
arm = model = builder.add_frame("hand", "b6", (0, 0, 0.1)).add_frame("tip", "b6", (0, 0, 0.2)).build()
wanted = jnp.zeros(6)
"""
TWO = """
import diffrax
scene = model = robot = jd.robots.chain(2)
q = q0 = jnp.array([0.3, 0.2])
v = v0 = tau = jnp.zeros(2)
q1, target = q0, lambda t: jnp.zeros(2)
ts = jnp.linspace(0.0, 0.02, 3)
"""
MOTIONS = """
motions = jd.grasp.hand_motions(grasp, q)
nu = jnp.zeros(motions.object.shape[1] + motions.internal.shape[1])
"""
# What readers of a docstring have in hand: the names that its example takes.
NAMES = (
    {
        "forces.JointStops": "robot = model",
        "forces.PiecewiseForce": "system = model",
        "ModelBuilder": "from jaxdyn import ModelBuilder",
        "compilation": TWO,
        "control.GraspForce": """
grasp = jd.scenes.hand_with_ball(mass=0.2)
q0, v0 = jd.scenes.hand_with_ball.start(twist=(0.0,) * 6)
q_object, ts = q0[grasp.system.topology.q_slices[-1]], jnp.linspace(0.0, 0.01, 2)
""",
        "dynamics.frame_acceleration": ARM,
        "forces.external_wrenches": "a = jnp.zeros_like(v)",
        "grasp.hand_dynamics": MOTIONS,
        "grasp.hand_motions": MOTIONS,
        "identify.Measured": """
scene = jd.Scene(model, forces=[jd.forces.JointDamping([0.3, 0.3])])
log = jd.identify.Log(log.t, log.q, log.v, log.a, log.tau / np.array([11.0, 8.5]))
""",
        "reduction.involutive": "q = q_disk",
        "join": "arm, box = model, free",
        "dynamics.joint_wrench": "zero = still",
        "constraints.model_couplings": "model = plain",
        "dynamics.workspace_dynamics": ARM,
    }
    | dict.fromkeys(
        (
            "events.Terminal",
            "solvers.LieGroup",
            "Sampled",
            "Variational",
            "control.ComputedTorque",
            "simulate",
            "stiffness",
        ),
        TWO,
    )
    | {"stepper": TWO + "gain = jnp.eye(2)"}
)


def entries(page: str) -> list[tuple[str, list[str]]]:
    """The names on a page in its order, each with the blocks under it; what stands above the first is named ""."""
    parts = re.split(r"^::: jaxdyn\.(\S+)$", (REFERENCE / f"{page}.md").read_text(), flags=re.M)
    # The recursions stand where they are written.
    names = ["", *(re.sub(r"recursions\.\w+\.", "", name) for name in parts[1::2])]
    return [(n, re.findall(r"```python\n(.*?)```", text, re.S)) for n, text in zip(names, parts[::2], strict=True)]


def documented(name: str) -> list[str]:
    """The examples of an export's docstring."""
    value = jd
    for part in name.split("."):
        value = getattr(value, part)
    return re.findall(r"```python\n(.*?)```", inspect.getdoc(value) or "", re.S)


@contextlib.contextmanager
def as_a_reader(tmp_path, monkeypatch):
    """In a folder of one's own, with jax's usual settings, nothing printed."""
    monkeypatch.chdir(tmp_path)
    with (
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        yield
    matplotlib = pytest.importorskip("matplotlib.pyplot", reason="matplotlib is not installed")
    matplotlib.close("all")


def is_force(value) -> bool:
    return type(value).__module__.startswith("jaxdyn.forces")


def use(value, systems: list) -> None:
    """Evaluate what an example made, as a scene will, on a system of its page that it fits. **Raises:** where it fits none."""
    faults = []
    for system in systems:
        q, v = jd.neutral(system) if isinstance(system, jd.Model) else jnp.zeros(system.nq), jnp.zeros(system.nv)
        if isinstance(value, jd.contact.RollingContact) and type(system) is jd.Model:
            system = jd.contact.RollingModel(system, [value])
            value = jd.Scene(system, system.rows)
        if isinstance(system, jd.contact.RollingModel):
            # Unit vectors, the places of spheres; at the neutral configuration the surfaces are apart.
            q = jnp.concatenate([q, jnp.full(system.nq - len(q), 3**-0.5)])
        try:
            if isinstance(value, jd.Scene):
                if value.constraints:
                    jd.constraint_jacobian(value, q)
                if any(
                    isinstance(force, (jd.contact.UnilateralContact, jd.contact.DryFriction)) for force in value.forces
                ):
                    jd.simulate(value, q, v, [0.0, 1e-3], throw=False)  # its force has modes, which a motion tracks
                else:
                    value.applied_force(q, v)
            elif isinstance(value, jd.constraints.Constraint):
                jd.constraint_jacobian(jd.Scene(system, [value]), q)
            elif isinstance(value, jd.Controller):
                start = value.start(q, v, jnp.zeros(()))
                value(q, v, jnp.zeros(()), start)
            else:
                jd.Scene(system, forces=[value]).applied_force(q, v)
            return
        except ValueError as error:
            faults.append(f"{str(system).partition(':')[0]}: {error}"[:300])
    raise AssertionError(f"{value} was made, and cannot be used on any system of the page: {faults}")


def use_what_was_made(before: dict, names: dict) -> int:
    """Use each constraint, force, control law and scene that a block has bound to a name; how many these are."""
    scenes = [x for x in names.values() if isinstance(x, jd.Scene)]
    systems = [x for x in names.values() if isinstance(x, System | jd.Model)] + [scene.system for scene in scenes]
    made = [x for name, x in names.items() if before.get(name) is not x]
    wanted = [x for x in made if isinstance(x, jd.constraints.Constraint | jd.Controller | jd.Scene) or is_force(x)]
    for value in wanted:
        fixed = value if isinstance(value, jd.Scene) else getattr(value, "scene", None)
        use(value, systems if fixed is None else [fixed.system])
    return len(wanted)


QUICK = ("constraints", "files", "forces")


@pytest.mark.long
@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=() if page in QUICK else pytest.mark.slow) for page in PAGES]
)
def test_examples_of_a_page_run(page, tmp_path, monkeypatch):
    """And what they make is used: a constraint or a force that cannot be is found when its rows are asked for."""
    names: dict = {}
    with as_a_reader(tmp_path, monkeypatch):
        for name, blocks in entries(page):
            for block in blocks:
                before = dict(names)
                exec(compile(block, f"docs/reference/{page}.md: {name}", "exec"), names)
                use_what_was_made(before, names)
    arrays = [x for x in names.values() if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating)]
    assert all(np.isfinite(x).all() for x in arrays)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_examples_of_docstrings_run(page, tmp_path, monkeypatch):
    """Each with what stands at the top of its page and the names that it takes."""
    (_, head), *rest = entries(page)
    with as_a_reader(tmp_path, monkeypatch):
        start: dict = {}
        for block in head:
            exec(compile(block, f"docs/reference/{page}.md", "exec"), start)
        for name, _ in rest:
            for block in documented(name) if name not in NOT_RUN else ():
                names = dict(start)
                for text in (NAMES.get(name, ""), block):
                    before = dict(names)
                    exec(compile(text, f"{page}: {name}", "exec"), names)
                use_what_was_made(before, names)


def _arguments(function):
    return [
        argument_tables.Argument(name, "", None if p.default is p.empty else repr(p.default))
        for name, p in inspect.signature(function).parameters.items()
        if p.kind is not p.VAR_KEYWORD  # former names, and options that the text passes on
    ]


def test_tables_describe_all_arguments_and_no_others():
    """Of all exports and the methods of exported classes; what a docstring leaves to another one is found there."""
    things, unknown = {}, []
    for name in [name for page in PAGES for name, _ in entries(page)[1:]] + ["scale.run", "scale.evaluate"]:
        value = jd
        for part in name.split("."):
            value = getattr(value, part)
        methods = vars(value).items() if inspect.isclass(value) else ()
        shown = {name: value} | {
            f"{name}.{n}": f for n, f in methods if inspect.isfunction(f) and not n.startswith("_")
        }
        for full, one in shown.items():
            if callable(one) and argument_tables.MARK in (inspect.getdoc(one) or ""):
                given = [x for x in _arguments(one) if x.name not in ("self", "cls")]
                # Fields that a class sets itself are no arguments.
                if not inspect.isclass(one) or "__init__" in vars(one) or issubclass(one, tuple):
                    things[full] = (inspect.getdoc(one), given)
                every = inspect.signature(one).parameters
                if not any(p.kind is p.VAR_KEYWORD for p in every.values()):
                    heads = re.findall(r"(?:^|^- |; |\. )`(\w+)`[:,]", argument_tables.split(things[full][0])[1], re.M)
                    unknown += [f"{full} has no argument {head}" for head in heads if head not in every]
    known = argument_tables.descriptions(things)
    assert len(things) > 250
    empty = [
        f"{name}: {', '.join(argument.name for argument, _ in row.arguments)}"
        for name, (text, given) in things.items()
        for row in argument_tables.rows(argument_tables.split(text)[1], given, known)[1]
        if not row.text
    ]
    assert not empty and not unknown, "\n".join([*empty, *unknown])
