"""Look-up of bodies, joints and frames of a model by name, with suggestions for unknown names."""

import difflib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np


def body_index(model: Any, name: str | None) -> int:
    """Index of a body by name; None means the world, -1.

    **Raises:** ValueError for a name that is neither a body nor a frame merged into one; similar names are listed.
    """
    if name is None:
        return -1
    if name in model.body_names:
        return model.body_names.index(name)
    # A link merged into a body is still named by users and files.
    return model.topology.frame_bodies[frame_index(model, name)]


def frame_index(model: Any, name: str) -> int:
    """Index of a frame by name; the name of a joint means the frame of its child link unless a frame has that name.

    **Raises:** ValueError when there is no frame of that name; names that look alike are listed.
    """
    # Files often name the joint where they mean its link, fixed joints included.
    carried = dict(model.fixed_joints) | dict(zip(model.joint_names, model.body_names, strict=True))
    try:
        return model.frame_names.index(name if name in model.frame_names else carried.get(name, name))
    except ValueError:
        raise ValueError(f"frame {name!r} is not in model {model.name!r}; {_hint(name, model, carried)}") from None


def joint_index(model: Any, name: str) -> int:
    """Index of a moving joint by name.

    **Raises:** ValueError for a name of no joint, or of a fixed one; names that look alike are listed.
    """
    if name in model.joint_names:
        return model.joint_names.index(name)
    if name in dict(model.fixed_joints):
        raise ValueError(f"joint {name!r} of model {model.name!r} is fixed: it has no coordinates")
    near = difflib.get_close_matches(str(name), model.joint_names, n=5, cutoff=0.4)
    hint = f"did you mean {', '.join(near)}?" if near else f"joints are {', '.join(model.joint_names[:10])}"
    raise ValueError(f"joint {name!r} is not in model {model.name!r}; {hint}")


def coordinate_index(slices: Sequence[slice], model: Any, joint: str) -> int | slice:
    """Index of a joint's coordinate, or the slice of several."""
    place = slices[joint_index(model, joint)]
    # A number and not a slice of one, so that q[index] is a scalar.
    return place.start if place.stop == place.start + 1 else place


def velocity_indices(model: Any, joints: Iterable[str]) -> np.ndarray:
    """Indices in v of the coordinates of some joints, in their order.

    **Raises:** ValueError for one string instead of a list, unknown joints and joints named twice.
    """
    if isinstance(joints, str):
        raise ValueError(f"joints is {joints!r}; give a list of names, [{joints!r}]")
    joints = list(joints)
    # A repeated joint would give a selection matrix without full column rank.
    if len(set(joints)) < len(joints):
        raise ValueError(f"joints is {joints}; name each joint once")
    places = [model.topology.v_slices[joint_index(model, joint)] for joint in joints]
    # The empty array keeps the integer type when no joint is named.
    return np.concatenate([np.zeros(0, int), *(np.arange(place.start, place.stop) for place in places)])


def _hint(name: str, model: Any, carried: dict) -> str:
    near = difflib.get_close_matches(str(name), (*model.frame_names, *carried), n=5, cutoff=0.4)
    return f"did you mean {', '.join(near)}?" if near else f"frames are {', '.join(model.frame_names[:10])} ..."
