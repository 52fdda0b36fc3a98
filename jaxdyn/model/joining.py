"""Composition of several models into one: their trees in a common world."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Numbers, check_new_name, store_leaf
from jaxdyn.model.host_math import pose_leaf
from jaxdyn.model.topology import KINDS
from jaxdyn.model.tree import Model, Topology


def join(
    left: Checked[Model],
    right: Checked[Model],
    *,
    prefix: Checked[str | Sequence[str]] = ("", ""),
    pose: Numbers | None = None,
    name: str | None = None,
) -> Model:
    """Join two models into one: their trees in one world and with one gravity.

    Names of bodies, joints and frames keep their spelling behind the prefix. The coordinates of `left` come first in
    q and v, then those of `right`, each in its own order: M is block-diagonal.

    **Arguments:**

    - `left`, `right`: models without a name in common, or with different prefixes.
    - `prefix`: put before the names of `left` and of `right`; one string: before those of `right`.
    - `pose`: pose of the world of `right` in that of `left`: None (identity), (4, 4), (3,) or (xyz, rpy). It moves all
      bodies and frames that `right` fixes to its world; gravity keeps its direction in the common world.
    - `name`: name of the result; by default both names.

    **Raises:** ValueError for an object that is no Model, names in common, a bad pose or prefix, and, on concrete
    numbers, different gravities.

    ```python
    arms = jd.join(arm, arm, prefix=("left_", "right_"), pose=(0.0, 1.2, 0.0))
    scene = jd.join(arms, box)
    ```
    """
    for argument, model in (("left", left), ("right", right)):
        if not isinstance(model, Model):
            raise ValueError(f"{argument} is a {type(model).__name__}; pass a Model")
        _check_is_tree(model)
    prefixes = ("", prefix) if isinstance(prefix, str) else prefix
    if not isinstance(prefixes, (tuple, list)) or len(prefixes) != 2 or not all(isinstance(x, str) for x in prefixes):
        raise ValueError(f"prefix is {prefix!r}; give a string for the right model, or one for each")
    first, second = (add_prefix(model, before) for model, before in zip((left, right), prefixes, strict=True))
    whole = check_new_name(name, f"{left.name} and {right.name}")
    return _side_by_side(
        [first, second if pose is None else _move_world(second, pose)], whole, "pass prefix=", by_name=False
    )


def add_prefix(model: Model, prefix: Any) -> Model:
    """Model with a prefix before the names of all bodies, joints and frames."""
    top = model.topology
    names = {
        what: tuple(prefix + own for own in getattr(top, what)) for what in ("body_names", "joint_names", "frame_names")
    }
    fixed = tuple((prefix + joint, prefix + link) for joint, link in model.fixed_joints)
    # Frames merged into bodies and names of fixed joints take the prefix too: both are ways to name a frame.
    whole = dataclasses.replace(top, **names)
    # Without a prefix the same object is returned, whose topology compares by identity first.
    return dataclasses.replace(model, topology=whole, fixed_joints=fixed) if prefix else model


def _move_world(model: Model, pose) -> Model:
    """Model with its world at a pose: bodies and named frames attached to the world are moved."""
    pose, top = pose_leaf(pose, "pose"), model.topology

    def transform_poses(poses, carriers):
        xp = array_namespace(pose, poses)
        poses, by = xp.asarray(poses), xp.asarray(pose, poses.dtype)
        product = by @ poses if xp is np else matmul(by, poses)
        # Only rows carried by the world (-1) move; all others are relative to a body.
        return store_leaf(xp.where((np.array(carriers, int) < 0)[:, None, None], product, poses), poses.dtype)

    return model.replace(
        home=transform_poses(model.home, top.parents),
        frame_poses=transform_poses(model.frame_poses, top.frame_bodies),
    )


def join_all(models: Sequence[Model], name: str) -> Model:
    """Join the trees of all models, sorted by the names of their root joints as `ModelBuilder` sorts them.

    **Raises:** ValueError for names that two of them share, and, on concrete numbers, for different gravities.
    """
    for model in models:
        _check_is_tree(model)
    return _side_by_side(models, name, "join them by jd.join(..., prefix=)", by_name=True)


def _check_is_tree(model: Model) -> None:
    if model.nq > model.topology.nq:
        raise ValueError(f"model {model.name!r} is a {type(model).__name__}; join its component models first")


def _side_by_side(models: Sequence[Model], name: str, fix: str, by_name: bool) -> Model:
    tops = [model.topology for model in models]
    for what in ("joint_names", "frame_names"):
        names = [n for top in tops for n in getattr(top, what)]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"the names {twice} are in two models; {what} have to differ: {fix}")
    # Index of the first body of each model in the concatenated list.
    first = np.cumsum([0] + [top.nb for top in tops])
    trees = [
        (top.joint_names[root], first[k] + np.flatnonzero(top.roots == root))
        for k, top in enumerate(tops)
        for root in sorted(set(top.roots.tolist()))
    ]
    # The order of `ModelBuilder`, so that a joined model equals one that was built at once.
    trees = sorted(trees, key=lambda tree: tree[0]) if by_name else trees
    order = np.concatenate([bodies for _, bodies in trees]) if trees else np.zeros(0, int)
    place = np.append(np.argsort(order), -1)  # new index of each body of the concatenated list; -1, the world, stays

    def collect(attribute, shift=False):
        values = [
            # Parents are indices within their own model; they move by the number of bodies before it.
            [v + first[k] if shift and v >= 0 else v for v in getattr(top, attribute)]
            for k, top in enumerate(tops)
        ]
        return [v for part in values for v in part]

    kinds, parents = collect("kinds"), collect("parents", shift=True)
    bodies, joints = collect("body_names"), collect("joint_names")
    others, poses = [], []
    for k, (top, model) in enumerate(zip(tops, models, strict=True)):
        for i in range(top.nb, len(top.frame_names)):
            body = top.frame_bodies[i]
            others.append((int(place[first[k] + body]) if body >= 0 else -1, top.frame_names[i], len(poses)))
            poses.append(_as_known(model.frame_poses)[i])
    # By body and name, as `ModelBuilder` sorts them.
    others.sort(key=lambda frame: frame[:2])
    couplings = [
        ((int(place[first[k] + pair[0]]), int(place[first[k] + pair[1]])), k, row)
        for k, top in enumerate(tops)
        for row, pair in enumerate(top.couplings)
    ]
    # Static pairs and their values must have one order, that of `ModelBuilder`.
    couplings.sort(key=lambda coupling: coupling[0])
    topology = Topology(
        name=name,
        parents=tuple(int(place[parents[i]]) for i in order),
        kinds=tuple(kinds[i] for i in order),
        body_names=tuple(bodies[i] for i in order),
        joint_names=tuple(joints[i] for i in order),
        frame_names=tuple(bodies[i] for i in order) + tuple(frame for _, frame, _ in others),
        frame_bodies=tuple(range(len(order))) + tuple(body for body, *_ in others),
        couplings=tuple(pair for pair, *_ in couplings),
    )
    # Trees stay contiguous, but their order may differ from that of the models, so every array needs its permutation.
    along = {size: _coordinates(kinds, order, size) for size in ("nq", "nv")}
    index = dict.fromkeys(("home", "screws", "inertias"), order)
    index |= dict.fromkeys(("lower", "upper"), along["nq"])
    index |= dict.fromkeys(("velocity_limit", "effort_limit", "armature", "damping", "friction"), along["nv"])
    leaves: dict[str, Any] = {leaf: _join_leaf(models, leaf, rows) for leaf, rows in index.items()}
    # Frame i < nb is body i itself; the other frames keep their poses in their bodies.
    home = leaves["home"]
    unit = np.broadcast_to(np.eye(4), home.shape)
    leaves["frame_poses"] = _concatenate([unit, *(poses[i][None] for *_, i in others)], home.dtype)
    values = [_as_known(models[k].coupling_values)[row][None] for _, k, row in couplings]
    leaves["coupling_values"] = _concatenate(values, jnp.result_type(*values)) if values else None
    fixed = tuple(pair for model in models for pair in model.fixed_joints)
    rounding = max(model.rounding for model in models)
    return Model(**leaves, gravity=_common_gravity(models), topology=topology, fixed_joints=fixed, rounding=rounding)


def _coordinates(kinds, order, size: str) -> np.ndarray:
    """Indices of the reordered bodies' coordinates in the concatenated list."""
    counts = [getattr(KINDS[kind], size) for kind in kinds]
    ends = np.cumsum(counts)
    return np.concatenate([ends[i] - counts[i] + np.arange(counts[i]) for i in order]).astype(int)


def _join_leaf(models, leaf: str, rows):
    """Join one leaf of all models and reorder its rows; zeros for models without it, None where all lack it."""
    values = [getattr(model, leaf) for model in models]
    if all(value is None for value in values):
        return None
    dtype = jnp.result_type(*(value for value in values if value is not None))
    # Only armature, damping and friction may be absent, and zero is their effect then.
    values = [np.zeros(model.nv) if value is None else value for model, value in zip(models, values, strict=True)]
    return _concatenate(values, dtype, rows)


def _as_known(leaf):
    """Convert a known leaf to numpy, so that joining compiles nothing."""
    return array_namespace(leaf).asarray(leaf)


def _concatenate(values: list, dtype, rows: Any = slice(None)) -> jax.Array:
    """Concatenate arrays of one dtype and select rows."""
    xp = array_namespace(values)
    return store_leaf(xp.concatenate([xp.asarray(value, dtype) for value in values])[rows], dtype)


def _common_gravity(models):
    gravities = [model.gravity for model in models]
    known = [g for g in gravities if is_concrete(g)]
    # A traced gravity cannot be compared; present and absent gravity differ in structure and can.
    if any((g is None) != (gravities[0] is None) for g in gravities) or any(
        g is not None and not np.array_equal(g, known[0]) for g in known
    ):
        shown = [None if g is None else np.asarray(g).tolist() for g in known]
        raise ValueError(f"the models have different gravity, {shown}; use model.replace(gravity=...)")
    return gravities[0]
