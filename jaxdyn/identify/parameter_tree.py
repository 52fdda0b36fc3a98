"""Tree of the parameters that a fit may change in a system or a scene, with their priors."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxdyn.identify.blocks import (
    Block,
    Directions,
    Inertias,
    Numbers,
    Poses,
    Rows,
    Tied,
    apply_blocks,
    entries_of_block,
    find_models,
    leaves_with_names,
    perpendicular_basis,
    prior_root,
    row_indices,
    select,
)
from jaxdyn.identify.chart import METRICS, make_chart
from jaxdyn.identify.mechanisms import FitSystem, Measured, build_scene
from jaxdyn.identify.regression import NUMBERS
from jaxdyn.model import host_math
from jaxdyn.model.arguments import Function, Number, deprecated, state_dtype
from jaxdyn.model.arguments import Numbers as Values
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene


class Parameters(eqx.Module):
    """Tree of the numbers that a fit may change: free, positive, bounded or tied; rotations; feasible inertias; and their priors.

    Nothing is free at first. Each method frees a leaf, or rows of it (bodies, joints), and returns a new tree.

    **Arguments:** `system`: a `Model`, another system, a `Scene`, a `jd.identify.Measured` scene with its sensors, or a
    `jd.identify.Construction`; `blocks`: what is free already, as the methods add it.

    **Raises:** ValueError in each method for a selection that is no floating-point leaf, is selected twice, or starts outside
    its bounds; the message names the leaf.

    ```python
    scene = jd.Scene(model, forces=[jd.forces.JointDamping([0.1, 0.1])])
    parameters = (
        jd.identify.Parameters(scene)
        .inertias(bodies=["a", "b"], metric="affine", weight=1.0)
        .positive(lambda scene: scene.forces[0])
        .poses(lambda scene: scene.system.home, rows=["b"], std=0.001)
        .directions(lambda scene: scene.system.gravity, std=0.01)
    )
    fit = jd.identify.fit_parameters(scene, log, parameters, jd.identify.Objective("torque"))
    ```
    """

    given: Any
    blocks: tuple[Block, ...]

    def __init__(self, system: FitSystem, blocks: tuple[Block, ...] = ()):
        self.given = system
        self.blocks = tuple(blocks)

    # Methods that free numbers.

    def free(
        self,
        where: Function,
        *,
        rows: Rows = None,
        mean: Values | None = None,
        std: Values | None = None,
        covariance: Values | None = None,
    ) -> "Parameters":
        """Free numbers of any sign. `where`: a function that selects leaves, `lambda scene: scene.system.parameters["mass"]`.

        `rows`: indices along the leaf's first axis, or names of bodies or joints where it has one row for each; all by
        default. A Gaussian prior: `std` (a number or one each) or `covariance` (m, m), about `mean` (where they are now).
        """
        return self._numbers("free", where, rows, mean, std, covariance)

    def positive(
        self,
        where: Function,
        *,
        rows: Rows = None,
        mean: Values | None = None,
        std: Values | None = None,
        covariance: Values | None = None,
    ) -> "Parameters":
        """Free numbers that stay above zero at every iterate, by their logarithm. Arguments as of `free`."""
        return self._numbers("positive", where, rows, mean, std, covariance)

    def bound(
        self,
        where: Function,
        lower: Values,
        upper: Values,
        *,
        rows: Rows = None,
        mean: Values | None = None,
        std: Values | None = None,
        covariance: Values | None = None,
    ) -> "Parameters":
        """Free numbers between `lower` and `upper` (numbers, or one each) at every iterate. Other arguments as of `free`."""
        return self._numbers("bound", where, rows, mean, std, covariance, lower, upper)

    def directions(self, where: Function, *, rows: Rows = None, std: Values | None = None) -> "Parameters":
        """Free the directions of vectors (..., 3), or screws (..., 6), of constant length: gravity, axes of joints.

        `std`: of a prior on the angle from the start, rad.
        """
        blocks = list(self.blocks)
        for leaf, value, name in select(self.given, where, "directions"):
            if value.shape[-1] not in (3, 6):
                raise ValueError(
                    f"directions picks {name} of shape {value.shape}; pick vectors (..., 3) or screws (..., 6)"
                )
            index, labels = self._entries(name, value, rows)
            vectors = value.reshape(-1)[index].reshape(-1, value.shape[-1] // 3, 3)
            # Of a screw (v, omega) the rotation axis; that of a prismatic joint is zero, and v is its direction.
            axes = vectors[:, -1]
            axes = np.where(np.linalg.norm(axes, axis=1, keepdims=True) > 0, axes, vectors[:, 0])
            if not np.linalg.norm(axes, axis=1).all():
                raise ValueError(
                    f"directions picks {name}, where a vector is zero: {vectors.tolist()}; name the others in rows="
                )
            bases = np.stack([perpendicular_basis(axis) for axis in axes])
            root = None if std is None else np.eye(2 * len(vectors)) / std
            blocks.append(Directions(labels, leaf, tuple(index), *self._arrays(vectors, bases, root)))
        return self._with(blocks)

    def poses(self, where: Function, *, rows: Rows = None, std: Values | None = None) -> "Parameters":
        """Free poses (..., 4, 4) as rigid motions: home poses, frames. `std`: of a prior on all six numbers, m and rad."""
        blocks = list(self.blocks)
        for leaf, value, name in select(self.given, where, "poses"):
            if value.shape[-2:] != (4, 4):
                raise ValueError(f"poses picks {name} of shape {value.shape}; pick poses (..., 4, 4)")
            poses = value.reshape(-1, 4, 4)
            chosen, labels = row_indices(self.given, name, len(poses), rows)
            names = tuple(f"{label} {c}" for label in labels for c in ("vx", "vy", "vz", "wx", "wy", "wz"))
            root = None if std is None else np.eye(6 * len(chosen)) / std
            blocks.append(Poses(names, leaf, tuple(chosen), *self._arrays(poses[np.array(chosen)], root)))
        return self._with(blocks)

    def inertias(
        self,
        bodies: Iterable[str] | None = None,
        *,
        shape: str = "full",
        metric: str | None = "entropic",
        weight: float = 1.0,
        ellipsoids: Mapping[str, tuple] | None = None,
        total: float | None = None,
    ) -> "Parameters":
        """Free inertias of bodies, so that every iterate is physically feasible.

        - `bodies`: names; all that have mass by default. All other bodies are frozen.
        - `shape`: "full", all ten numbers, or "mass", the density alone (which rods and points allow too).
        - `metric`: of the distance to the present bodies, which is added `weight` times: "entropic" (the log-det
          divergence), "affine" (the squared affine-invariant distance), or None for none.
        - `ellipsoids`: {body: (centre (3,), semi-axes (3,))} in the body's frame, m, that contain the body's mass.
        - `total`: mass of all bodies of the model (kg), kept exactly.

        **Raises:** ValueError for unknown bodies, bodies that are not feasible, ellipsoids that do not contain them.
        """
        model, leaf, name = self._model()
        if metric is not None and metric not in METRICS:
            raise ValueError(f"metric is {metric!r}; give one of {METRICS}, or None")
        chosen = None if bodies is None else row_indices(self.given, name, model.nb, list(bodies))[0]
        chart = make_chart(model, shape, chosen)
        if chosen is not None and set(chosen) != set(chart.bodies):
            empty = [model.body_names[i] for i in chosen if i not in chart.bodies]
            raise ValueError(f"inertias frees {empty}, which have no mass; give them some, or leave them out")
        names = [f"{name}[{model.body_names[i]}] {number}" for i in chart.bodies for number in NUMBERS]
        own = float(np.asarray(model.inertias)[:, 0].sum())
        frozen = own - float(np.asarray(model.inertias)[np.array(chart.bodies, int), 0].sum())
        if total is not None and not total > frozen:
            raise ValueError(f"total is {total} kg, and the frozen bodies weigh {frozen:.6g} kg; give more than that")
        quadrics = None if ellipsoids is None else self._quadrics(model, chart, ellipsoids)
        parts = self._arrays(np.asarray(float(weight)), quadrics, None if total is None else np.asarray(float(total)))
        if not weight > 0:
            raise ValueError(f"weight is {weight}; give a positive number, or metric=None")
        return self._with([*self.blocks, Inertias(tuple(names), leaf, metric, chart, *parts)])

    def tie(
        self,
        where: Function,
        to: Function,
        *,
        scale: Number = 1.0,
        offset: Number = 0.0,
        rows: Rows = None,
        to_rows: Rows = None,
    ) -> "Parameters":
        r"""Make numbers functions of others, entry by entry. Others may be free, or tied before.

        $$x = \mathrm{scale} \cdot x_\mathrm{other} + \mathrm{offset}$$
        """
        (leaf, value, name), *rest = select(self.given, where, "tie")
        (other, source, other_name), *more = select(self.given, to, "to", twice=True)
        if rest or more:
            raise ValueError("tie picks several leaves; tie one leaf, or rows of it, to one other")
        index, labels = self._entries(name, value, rows)
        other_index, _ = self._entries(other_name, source, to_rows)
        if len(other_index) == 1:
            other_index = other_index * len(index)
        if len(index) != len(other_index):
            raise ValueError(
                f"tie: {name} has {len(index)} numbers and {other_name} {len(other_index)}; name rows that match"
            )
        if leaf == other and set(index) & set(other_index):
            raise ValueError(f"tie: {name} would follow itself; name other rows")
        numbers = self._arrays(np.asarray(float(scale)), np.asarray(float(offset)))
        return self._with([*self.blocks, Tied(labels, leaf, tuple(index), other, tuple(other_index), *numbers)])

    bounded = deprecated("Parameters.bounded", bound)
    tied = deprecated("Parameters.tied", tie)

    # Quantities that a fit needs.

    @property
    def size(self) -> int:
        """Number of coordinates y."""
        return sum(block.size for block in self.blocks)

    @property
    def names(self) -> tuple[str, ...]:
        """Paths of the numbers within the system, as in "parameters['mass']"."""
        return tuple(name for block in self.blocks for name in block.names)

    @property
    def start(self) -> Float[Array, " p"]:
        """y (p,) of the system as given: zeros."""
        return jnp.zeros((self.size,), self.dtype)

    @property
    def dtype(self) -> np.dtype:
        """Floating-point type of the coordinates."""
        return state_dtype(build_scene(self.given).system)

    @property
    def keeps_regressor(self) -> bool:
        """True where inertias are free and the kinematics, gravity and encoders, on which their regressor depends, are not."""
        if not any(isinstance(block, Inertias) for block in self.blocks):
            return False
        # Inertias are free in the only model of a system (`inertias`).
        (model,), leaves = find_models(self.given), jax.tree.leaves(self.given)
        sensors = self.given.position_bias if isinstance(self.given, Measured) else None
        others = [model.inertias, model.armature, model.damping, model.friction]
        # By identity, as in `_model`.
        fixed = {id(x) for x in jax.tree.leaves((model, sensors))} - {id(x) for x in others}
        return not any(id(leaves[block.place]) in fixed for block in self.blocks)

    def system(self, y: Float[Array, " p"]) -> PyTree:
        """System as given, with the numbers of y."""
        return self.replace(apply_blocks(self, y, None)[0])

    def replace(self, changed: Mapping[int, Array]) -> PyTree:
        """System as given, with other leaves at some places."""
        leaves, structure = jax.tree.flatten(self.given)
        # Frozen leaves stay the same objects, by whose identity other code recognises them.
        for place, leaf in changed.items():
            leaves[place] = leaf
        return jax.tree.unflatten(structure, leaves)

    def scene(self, y: Float[Array, " p"]) -> Scene:
        """Scene with the numbers of y."""
        return build_scene(self.system(y))

    def values(self, y: Float[Array, " p"]) -> Float[Array, " m"]:
        """Numbers (m,) in the order of `names`."""
        return apply_blocks(self, y, "values")[1]

    def residual(self, y: Float[Array, " p"]) -> Float[Array, " k"]:
        """Residuals of the prior (k,), of unit standard deviation: half of their sum of squares is its negative logarithm."""
        return apply_blocks(self, y, "residual")[1]

    # Construction.

    def _with(self, blocks: list[Block]) -> "Parameters":
        return Parameters(self.given, tuple(blocks))

    def _arrays(self, *values) -> list[Any]:
        return [None if x is None else jnp.asarray(x, self.dtype) for x in values]

    def _model(self) -> tuple[Model, int, str]:
        """The model of the system, the place of its inertias among the leaves, and their name."""
        models = find_models(self.given)
        if len(models) != 1:
            raise ValueError(
                f"inertias: a {type(self.given).__name__} with {len(models)} models of bodies; free numbers of other systems "
                "with positive= and free="
            )
        leaves, names, _ = leaves_with_names(self.given)
        # By identity: equal values may occur in other leaves.
        place = next(i for i, leaf in enumerate(leaves) if leaf is models[0].inertias)
        self._refuse_twice(place, names[place], "inertias")
        return models[0], place, names[place]

    def _quadrics(self, model: Model, chart, ellipsoids: Mapping[str, tuple]) -> np.ndarray:
        quadrics = np.zeros((len(chart.bodies), 4, 4))
        for body, (centre, semi_axes) in ellipsoids.items():
            if body not in model.body_names or model.body_names.index(body) not in chart.bodies:
                raise ValueError(
                    f"ellipsoids names {body!r}, which is no free body; they are {[model.body_names[i] for i in chart.bodies]}"
                )
            k = chart.bodies.index(model.body_names.index(body))
            centre, inverse = np.asarray(centre, float), np.diag(1 / np.asarray(semi_axes, float) ** 2)
            # With x = (r, 1) and D the inverse squares of the semi-axes, x^T Q x = 1 - (r - c)^T D (r - c), positive inside.
            quadrics[k, :3, :3], quadrics[k, :3, 3] = -inverse, inverse @ centre
            quadrics[k, 3, :3], quadrics[k, 3, 3] = inverse @ centre, 1 - centre @ inverse @ centre
            P = host_math.pseudo_inertia(np.asarray(model.inertias, np.float64)[chart.bodies[k]])
            if not np.sum(P * quadrics[k]) > 0:
                raise ValueError(f"the ellipsoid of {body!r} does not contain the body; give larger semi-axes")
        return quadrics

    def _refuse_twice(self, place: int, name: str, argument: str, index: Sequence[int] | None = None) -> None:
        for block in self.blocks:
            if block.place != place:
                continue
            taken = entries_of_block(block)
            if index is None or taken is None or set(index) & set(taken):
                raise ValueError(f"{argument} picks {name} a second time; pick every number once")

    def _entries(self, name: str, value: np.ndarray, rows) -> tuple[list[int], tuple[str, ...]]:
        """Flat indices of the entries in some rows of a leaf, and their names."""
        indices = np.arange(value.size).reshape(value.shape)
        if rows is not None:
            indices = indices[np.array(row_indices(self.given, name, len(indices) if value.ndim else 0, rows)[0])]
        chosen = indices.reshape(-1).tolist()
        at = [np.unravel_index(i, value.shape) for i in chosen]
        return chosen, tuple(name + "".join(f"[{i}]" for i in index) for index in at)

    def _numbers(self, kind, where, rows, mean, std, covariance, lower=None, upper=None) -> "Parameters":
        tree = self
        for place, value, name in select(self.given, where, kind):
            index, labels = tree._entries(name, value, rows)
            tree._refuse_twice(place, name, kind, index)
            origin = value.reshape(-1)[index]
            if kind == "positive" and not (origin > 0).all():
                raise ValueError(
                    f"positive picks {name}, which is {value.tolist()}; start above zero, or pick it in free"
                )
            limits = (None, None)
            if kind == "bound":
                limits = tuple(np.broadcast_to(np.asarray(x, float), origin.shape) for x in (lower, upper))
                if not ((limits[0] < origin) & (origin < limits[1])).all():
                    raise ValueError(
                        f"bound picks {name}, which is {origin.tolist()} and not between {lower} and {upper}; give bounds "
                        "that hold where the fit starts"
                    )
            root = prior_root(std, covariance, origin.size, f"{kind} of {name}")
            if mean is not None and root is None:
                raise ValueError(f"{kind} of {name}: mean is given without std or covariance; give one of them")
            center = (
                None
                if root is None
                else np.broadcast_to(origin if mean is None else np.asarray(mean, float), origin.shape)
            )
            # A unit of y changes a number by its own size; zero has none.
            unit = np.where(origin == 0, 1, np.abs(origin))
            numbers = self._arrays(origin, unit, *limits, center, root)
            tree = tree._with([*tree.blocks, Numbers(labels, place, tuple(index), kind, *numbers)])
        return tree
