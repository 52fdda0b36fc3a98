"""Cost of one mechanism from its fullest to its barest version: what a scene does not list should not be paid for.

    python -m benchmarks.scene_cost [--batch 1024] [--rounds 10] [--steps 50]

The ladder takes one thing away at a time: outputs, friction, rows of the loop that depend on others in a plane, the loop,
gravity, float64. Per rung: operations of the kernels of one evaluation of the accelerations, and the time of it, of one
projection onto the constraints and of a simulation with fixed steps, per trajectory, best and median of interleaved rounds.
Below it, pairs of scenes that differ in one thing which one of them lacks. What is done for samples alone whose rows depend on
each other is in the times and not in the operations.
"""

import argparse
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing
from benchmarks.operations import operations
from jaxdyn.constraints.projection import project_state

STEP = 0.005  # s
ALL = ("energy", "power", "work", "acceleration", "multipliers", "constraint_residual")


class Rung(NamedTuple):
    """A scene, its start, the outputs asked for, the dtype, and how multipliers are found."""

    name: str
    scene: Any
    start: tuple
    outputs: tuple[str, ...] = ()
    dtype: str = "float64"
    method: str = "rank_aware"


def _four_bar(*, loop: bool = True, in_plane: bool = True, friction: bool = False, **parameters):
    scene = jd.scenes.four_bar(in_plane=in_plane, **parameters)
    forces = (
        (jd.forces.JointDamping(jnp.full(3, 0.1)), jd.forces.CoulombFriction(jnp.full(3, 0.05))) if friction else ()
    )
    return jd.Scene(scene.system, scene.constraints if loop else (), forces)


def ladder() -> list[Rung]:
    """A four-bar linkage, from everything to a tree without gravity in float32."""
    start = jd.scenes.four_bar.start()
    tree = _four_bar(loop=False, gravity=None)
    return [
        Rung("3D loop (5 rows), friction, gravity, all outputs", _four_bar(in_plane=False, friction=True), start, ALL),
        Rung("- outputs", _four_bar(in_plane=False, friction=True), start),
        Rung("- friction", _four_bar(in_plane=False), start),
        Rung("- rows out of the plane (2 left)", _four_bar(), start),
        Rung("- gravity", _four_bar(gravity=None), start),
        Rung("- the loop: a tree", tree, start),
        Rung("- float64: float32", tree, start, dtype="float32"),
    ]


def _chain(*, axes, joints=("revolute",) * 3, gravity=None, moments=(0.02, 0.03, 0.04), center=(0.2, 0.0, 0.0)):
    builder = jd.ModelBuilder("chain", gravity=gravity)
    parent = None
    for i, (axis, joint) in enumerate(zip(axes, joints, strict=True)):
        options = {"axis": axis} if joint == "revolute" else {}
        builder.add_body(f"b{i}", parent, joint, (1.0, center, moments), pose=(0.4 if i else 0.0, 0.0, 0.0), **options)
        parent = f"b{i}"
    scene = jd.Scene(builder.build())
    q = np.asarray(jd.neutral(scene.system)) + (0.0 if "spherical" in joints else 0.3)
    return scene, (q, np.full(scene.nv, 0.5))


def pairs() -> list[tuple[str, Rung, Rung]]:
    """What is lacking, the scene with it, and the scene without it."""
    z, mixed = ((0.0, 0.0, 1.0),) * 3, ((0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.0, 0.8, -0.6))
    down = (0.0, -9.81, 0.0)

    def rung(name, computed):
        return Rung(name, *computed)

    single = {"joints": ("spherical",), "axes": (z[0],)}
    free = {"joints": ("free",), "axes": (z[0],)}
    parameters = {"masses": (1.0, 1.0), "length": 0.4, "reaches": (0.2, 0.2), "moments": (0.04, 0.04)}
    arm = jd.scenes.double_pendulum(formulation="model", **parameters)
    lagrangian = jd.scenes.double_pendulum(formulation="lagrangian", **parameters)
    state = jd.scenes.double_pendulum.start()
    linkage, closed = jd.scenes.four_bar(), jd.scenes.four_bar.start()
    return [
        ("motion out of a plane", rung("chain in space", _chain(axes=mixed)), rung("chain in a plane", _chain(axes=z))),
        ("gravity", rung("with", _chain(axes=mixed, gravity=down)), rung("None", _chain(axes=mixed))),
        (
            "rotational inertia",
            rung("bodies", _chain(axes=mixed, center=(0.2, 0.1, 0.3))),
            rung("point masses", _chain(axes=mixed, center=(0.2, 0.1, 0.3), moments=(0.0, 0.0, 0.0))),
        ),
        (
            "an offset of the centre",
            rung("ball joint off the centre", _chain(center=(0.2, 0.1, 0.0), **single)),
            rung("ball joint at the centre", _chain(center=(0.0, 0.0, 0.0), **single)),
        ),
        (
            "translation",
            rung("free joint", _chain(center=(0.0, 0.0, 0.0), **free)),
            rung("ball joint", _chain(center=(0.0, 0.0, 0.0), **single)),
        ),
        ("bodies", Rung("double pendulum of bodies", arm, state), Rung("its Lagrangian", lagrangian, state)),
        (
            "rows that may depend on each other",
            Rung("four-bar, rank_aware", linkage, closed),
            Rung("four-bar, schur", linkage, closed, method="schur"),
        ),
    ]


def _cast(scene, dtype):
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, scene)


def _acceleration(scene, method):
    def accelerate(q, v):
        force = scene.applied_force(q, v)
        force = jnp.zeros_like(v) if force is None else force
        if scene.constraints:
            bare = jd.Scene(scene.system, scene.constraints)
            return jd.constrained_dynamics(bare, q, v, force, method=method).acceleration
        return jd.forward_dynamics(scene.system, q, v, force)

    return accelerate


def programs(rung: Rung, batch: int, steps: int):
    """Operations of one acceleration; calls of a batch of accelerations, of projections and of simulations."""
    scene, dtype = _cast(rung.scene, rung.dtype), jnp.dtype(rung.dtype)
    q, v = (jnp.tile(jnp.asarray(x, dtype), (batch, 1)) for x in rung.start)
    v = v * jnp.linspace(0.8, 1.2, batch, dtype=dtype)[:, None]

    def built(function):
        return jax.jit(jax.vmap(function)).lower(q, v).compile()

    accelerate = _acceleration(scene, rung.method)
    made = {"acceleration": built(accelerate)}
    if steps:
        ts = jnp.asarray([0.0, STEP * steps], dtype)
        options = {"stepsize": jd.simulation.Steps(STEP, max_steps=2 * steps), "outputs": rung.outputs, "throw": False}
        made["simulation"] = built(lambda q, v: jd.simulate(scene, q, v, ts, **options))
        if scene.constraints:
            made["projection"] = built(lambda q, v: project_state(scene, q, v, jnp.zeros((), dtype)))
    calls = {kind: lambda run=run: jax.block_until_ready(run(q, v)) for kind, run in made.items()}
    return operations(accelerate, q[0], v[0]), calls


def measure(rungs: list[Rung], batch: int, steps: int, rounds: int) -> list[dict]:
    """A row per rung, all timed in turn; simulations where there are steps."""
    made = [programs(rung, batch, steps) for rung in rungs]
    calls = {(i, kind): call for i, (_, both) in enumerate(made) for kind, call in both.items()}
    times = timing.time_alternately(calls, rounds, maximum=20.0)
    rows = []
    for i, (rung, (counted, _)) in enumerate(zip(rungs, made, strict=True)):
        row: dict[str, Any] = {"scene": rung.name, "operations": None if counted is None else counted.all}
        for kind in ("acceleration", "projection", "simulation") if steps else ("acceleration",):
            computed = times.get((i, kind))
            row[f"{kind} us"] = (
                None if computed is None else [1e6 * computed[key] / batch for key in ("best", "median")]
            )
        rows.append(row)
    return rows


def _cell(value) -> str:
    if isinstance(value, list):
        return "{:.3g} ({:.3g})".format(*value)
    return "" if value is None else value if isinstance(value, str) else f"{value:.0f}"


def _print(rows) -> None:
    print(f"\n| {' | '.join(rows[0])} |\n|{'---|' * len(rows[0])}")
    for row in rows:
        print(f"| {' | '.join(map(_cell, row.values()))} |", flush=True)


def main(argv=None) -> None:
    """Print the tables and write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=50)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    print(f"float64 but for the last rung, batch {options.batch}, {options.steps} steps of RK4")
    rows = measure(ladder(), options.batch, options.steps, options.rounds)
    _print(rows)
    flat = [rung._replace(name=f"{what}: {rung.name}") for what, *both in pairs() for rung in both]
    flat = measure(flat, options.batch, 0, options.rounds)
    _print(flat)
    head = {"machine": timing.machine(), "batch": options.batch, "steps": options.steps}
    print("written to", timing.write("scene_cost", head | {"ladder": rows, "pairs": flat}))


if __name__ == "__main__":
    main()
