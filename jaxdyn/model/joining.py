"""One model of several: the trees of all stand side by side in one world."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import is_concrete, numpy_for
from jaxdyn.lie.so3 import _product
from jaxdyn.model.arguments import Checked, Numbers, pose_leaf, stored
from jaxdyn.model.joints import KINDS
from jaxdyn.model.tree import Model, Topology


def join(
    left: Checked[Model],
    right: Checked[Model],
    *,
    prefix: Checked[str | Sequence[str]] = ("", ""),
    pose: Numbers | None = None,
    name: str | None = None,
) -> Model:
    """Two models in one: their trees side by side, in one world and with one gravity.

    All names of bodies, joints and frames stay, behind their prefix. The coordinates of `left` come first in q and v, then
    those of `right`, each in its own order: M is block-diagonal.

    **Arguments:**

    - `left`, `right`: models without a name in common, or with different prefixes.
    - `prefix`: put before the names of `left` and of `right`; one string: before those of `right`.
    - `pose`: where the world of `right` stands in that of `left`: None (identity), (4, 4), (3,) or (xyz, rpy). It moves all
      that `right` fixes to its world; gravity stays as it is in the common world.
    - `name`: of the whole; by default both names.

    **Raises:** ValueError for what is no Model, names that both have, a bad pose or prefix, and, on concrete numbers, unlike
    gravities.

    ```python
    arms = jd.join(arm, arm, prefix=("left_", "right_"), pose=(0.0, 1.2, 0.0))
    scene = jd.join(arms, box)
    ```
    """
    for argument, model in (("left", left), ("right", right)):
        if not isinstance(model, Model):
            raise ValueError(f"{argument} is a {type(model).__name__}; pass a Model")
        _check_plain(model)
    prefixes = ("", prefix) if isinstance(prefix, str) else prefix
    if not isinstance(prefixes, (tuple, list)) or len(prefixes) != 2 or not all(isinstance(x, str) for x in prefixes):
        raise ValueError(f"prefix is {prefix!r}; give a string for the right model, or one for each")
    first, second = (renamed(model, before) for model, before in zip((left, right), prefixes, strict=True))
    whole = f"{left.name} and {right.name}" if name is None else name
    return _side_by_side(
        [first, second if pose is None else _moved(second, pose)], whole, "pass prefix=", by_name=False
    )


def _check_plain(model: Model) -> None:
    """Refuse a model whose q holds more than the coordinates of its joints."""
    if model.nq > model.topology.nq:
        raise ValueError(f"model {model.name!r} is a {type(model).__name__}; join models before contacts are added")


def renamed(model: Model, prefix: Any) -> Model:
    """The model with a prefix before the names of all bodies, joints and frames."""
    top = model.topology
    names = {
        what: tuple(prefix + own for own in getattr(top, what)) for what in ("body_names", "joint_names", "frame_names")
    }
    fixed = tuple((prefix + joint, prefix + link) for joint, link in model.fixed_joints)
    whole = dataclasses.replace(top, **names)
    return dataclasses.replace(model, topology=whole, fixed_joints=fixed) if prefix else model


def _moved(model: Model, pose) -> Model:
    """The model in a world that stands at a pose: what hangs on the world, and its named frames, are moved."""
    pose, top = pose_leaf(pose, "pose"), model.topology

    def moved(poses, carriers):
        xp = numpy_for(pose, poses)
        poses, by = xp.asarray(poses), xp.asarray(pose, poses.dtype)
        product = by @ poses if xp is np else _product(by, poses)
        return stored(xp.where((np.array(carriers, int) < 0)[:, None, None], product, poses), poses.dtype)

    return model.replace(home=moved(model.home, top.parents), frame_poses=moved(model.frame_poses, top.frame_bodies))


def joined(models: Sequence[Model], name: str) -> Model:
    """The trees of all models in one, in the order of their first joints' names, as a `ModelBuilder` would have it.

    **Raises:** ValueError for names that two of them share, and, on concrete numbers, for unlike gravities.
    """
    return _side_by_side(models, name, "join them by jd.join(..., prefix=)", by_name=True)


def _side_by_side(models: Sequence[Model], name: str, fix: str, by_name: bool) -> Model:
    for model in models:
        if model.nq > model.topology.nq:
            raise ValueError(
                f"model {model.name!r} is a {type(model).__name__}; join the models that it is made of first"
            )
    tops = [model.topology for model in models]
    for what in ("joint_names", "frame_names"):
        names = [n for top in tops for n in getattr(top, what)]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"the names {twice} are in two models; {what} have to differ: {fix}")
    first = np.cumsum([0] + [top.nb for top in tops])
    trees = [
        (top.joint_names[root], first[k] + np.flatnonzero(top.roots == root))
        for k, top in enumerate(tops)
        for root in sorted(set(top.roots.tolist()))
    ]
    trees = sorted(trees, key=lambda tree: tree[0]) if by_name else trees
    order = np.concatenate([bodies for _, bodies in trees]) if trees else np.zeros(0, int)
    place = np.append(np.argsort(order), -1)  # of each body of the list of all; -1, the world, stays

    def listed(attribute, shift=False):
        values = [
            [v + first[k] if shift and v >= 0 else v for v in getattr(top, attribute)] for k, top in enumerate(tops)
        ]
        return [v for part in values for v in part]

    kinds, parents = listed("kinds"), listed("parents", shift=True)
    bodies, joints = listed("body_names"), listed("joint_names")
    others, poses = [], []
    for k, (top, model) in enumerate(zip(tops, models, strict=True)):
        for i in range(top.nb, len(top.frame_names)):
            body = top.frame_bodies[i]
            others.append((int(place[first[k] + body]) if body >= 0 else -1, top.frame_names[i], len(poses)))
            poses.append(_numbers(model.frame_poses)[i])
    others.sort(key=lambda frame: frame[:2])
    couplings = [
        ((int(place[first[k] + pair[0]]), int(place[first[k] + pair[1]])), k, row)
        for k, top in enumerate(tops)
        for row, pair in enumerate(top.couplings)
    ]
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
    along = {size: _coordinates(kinds, order, size) for size in ("nq", "nv")}
    index = dict.fromkeys(("home", "screws", "inertias"), order)
    index |= dict.fromkeys(("lower", "upper"), along["nq"])
    index |= dict.fromkeys(("velocity_limit", "effort_limit", "armature", "damping", "friction"), along["nv"])
    leaves: dict[str, Any] = {leaf: _stacked(models, leaf, rows) for leaf, rows in index.items()}
    home = leaves["home"]
    unit = np.broadcast_to(np.eye(4), home.shape)
    leaves["frame_poses"] = _concatenated([unit, *(poses[i][None] for *_, i in others)], home.dtype)
    values = [_numbers(models[k].coupling_values)[row][None] for _, k, row in couplings]
    leaves["coupling_values"] = _concatenated(values, jnp.result_type(*values)) if values else None
    fixed = tuple(pair for model in models for pair in model.fixed_joints)
    return Model(**leaves, gravity=_common_gravity(models), topology=topology, fixed_joints=fixed)


def _coordinates(kinds, order, size: str) -> np.ndarray:
    """Where the coordinates of the bodies in their order stand in those of the list of all."""
    counts = [getattr(KINDS[kind], size) for kind in kinds]
    ends = np.cumsum(counts)
    return np.concatenate([ends[i] - counts[i] + np.arange(counts[i]) for i in order]).astype(int)


def _stacked(models, leaf: str, rows):
    """One leaf of all models, its rows put in order; where some lack it, zeros, and None where all do."""
    values = [getattr(model, leaf) for model in models]
    if all(value is None for value in values):
        return None
    dtype = jnp.result_type(*(value for value in values if value is not None))
    values = [np.zeros(model.nv) if value is None else value for model, value in zip(models, values, strict=True)]
    return _concatenated(values, dtype, rows)


def _numbers(leaf):
    """A leaf, of numpy where it is known."""
    return numpy_for(leaf).asarray(leaf)


def _concatenated(values: list, dtype, rows: Any = slice(None)) -> jax.Array:
    """The arrays, one after the other, and rows of what they are."""
    xp = numpy_for(values)
    return stored(xp.concatenate([xp.asarray(value, dtype) for value in values])[rows], dtype)


def _common_gravity(models):
    gravities = [model.gravity for model in models]
    known = [g for g in gravities if is_concrete(g)]
    if any((g is None) != (gravities[0] is None) for g in gravities) or any(
        g is not None and not np.array_equal(g, known[0]) for g in known
    ):
        shown = [None if g is None else np.asarray(g).tolist() for g in known]
        raise ValueError(f"the models have different gravity, {shown}; use model.replace(gravity=...)")
    return gravities[0]
