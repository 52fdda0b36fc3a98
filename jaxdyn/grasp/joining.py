"""One model of several: the trees of all stand side by side in one world."""

from collections.abc import Sequence
from typing import Any

import jax.core
import jax.numpy as jnp
import numpy as np

from jaxdyn.model.joints import KINDS
from jaxdyn.model.tree import Model, Topology


def joined(models: Sequence[Model], name: str) -> Model:
    """The trees of all models in one, in the order of their first joints' names, as a `ModelBuilder` would have it.

    **Raises:** ValueError for names that two of them share, and, on concrete numbers, for unlike gravities.
    """
    tops = [model.topology for model in models]
    for what in ("joint_names", "frame_names"):
        names = [n for top in tops for n in getattr(top, what)]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"the names {twice} are in two models; {what} have to differ")
    first = np.cumsum([0] + [top.nb for top in tops])
    trees = [
        (top.joint_names[root], first[k] + np.flatnonzero(top.roots == root))
        for k, top in enumerate(tops)
        for root in sorted(set(top.roots.tolist()))
    ]
    order = np.concatenate([bodies for _, bodies in sorted(trees, key=lambda tree: tree[0])])
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
            poses.append(model.frame_poses[i])
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
    unit = jnp.broadcast_to(jnp.eye(4, dtype=home.dtype), home.shape)
    leaves["frame_poses"] = jnp.concatenate([unit, *(poses[i][None] for *_, i in others)])
    values = [models[k].coupling_values[row] for _, k, row in couplings]  # pyright: ignore[reportOptionalSubscript]
    leaves["coupling_values"] = jnp.stack(values) if values else None
    return Model(**leaves, gravity=_common_gravity(models), topology=topology)


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
    values = [
        jnp.zeros((model.nv,), model.home.dtype) if value is None else value
        for model, value in zip(models, values, strict=True)
    ]
    return jnp.concatenate(values)[rows]


def _common_gravity(models):
    gravities = [model.gravity for model in models]
    known = [g for g in gravities if not isinstance(g, jax.core.Tracer)]
    if any((g is None) != (gravities[0] is None) for g in gravities) or any(
        g is not None and not np.array_equal(g, known[0]) for g in known
    ):
        shown = [None if g is None else np.asarray(g).tolist() for g in known]
        raise ValueError(f"the models have different gravity, {shown}; use model.replace(gravity=...)")
    return gravities[0]
