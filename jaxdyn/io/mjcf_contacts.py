"""Contacts of the geoms of MJCF files with planes and height fields."""

from collections.abc import Iterable

import numpy as np

from jaxdyn.contact.height_field import HeightField
from jaxdyn.contact.unilateral import UnilateralContact
from jaxdyn.io.collisions import Collision, contacts_with_ground
from jaxdyn.io.loaded import summarize
from jaxdyn.io.mjcf_file import CompiledFile, pose_of
from jaxdyn.io.solids import geom_solid
from jaxdyn.model.tree import Model

_HEIGHT_FIELD = 1  # mjtGeom


def contacts_of(
    file: CompiledFile, model: Model, contacts: str | Iterable[str] | None, has_missing_meshes: bool
) -> tuple[list[UnilateralContact], list[str], set[str]]:
    """Contacts with the ground, descriptions of what is left out, and the bodies that have contacts."""
    if contacts is None:
        return [], [], set()
    if file.off("CONTACT"):
        return [], ["contacts, which the file disables"], set()
    m, collisions, spinning, soft = file.m, [], [], []
    in_pairs = {int(g) for pair in (m.pair_geom1, m.pair_geom2) for g in pair}
    for g in range(m.ngeom):
        # Geoms without contype and conaffinity are visual and touch nothing unless a pair names them.
        if not (m.geom_contype[g] or m.geom_conaffinity[g] or g in in_pairs):
            continue
        body = file.bodies[m.geom_bodyid[g]]
        solid = _height_field(m, g) if m.geom_type[g] == _HEIGHT_FIELD else geom_solid(m, g)
        # `compile_file` replaces missing meshes by points of this size.
        is_point = has_missing_meshes and not isinstance(solid, HeightField) and solid and solid.size == (1e-3,) * 3
        if solid is None or is_point:
            continue
        collisions.append(Collision(body, pose_of(m.geom_pos[g], m.geom_quat[g]), solid, _own_friction(m, g), g))
        if body is not None and m.geom_condim[g] > 3:
            spinning.append(body)
        if body is not None and m.geom_margin[g]:
            soft.append(body)
    made, left, taken = contacts_with_ground(model, collisions, contacts, lambda a, b: _friction(m, a.key, b.key))
    left += summarize("torsional and rolling friction of bodies", [x for x in dict.fromkeys(spinning) if x in taken])
    left += summarize("margin of contacts of bodies", [x for x in dict.fromkeys(soft) if x in taken])
    return made, left, taken


def _own_friction(m, g: int) -> float:
    return float(m.geom_friction[g, 0]) if m.geom_condim[g] > 1 else 0.0


def _friction(m, g: int, h: int) -> float | None:
    """Sliding friction of two geoms, None where they do not touch."""
    for i in range(m.npair):
        if {int(m.pair_geom1[i]), int(m.pair_geom2[i])} == {g, h}:
            return float(m.pair_friction[i, 0]) if m.pair_dim[i] > 1 else 0.0
    bodies = {int(m.geom_bodyid[g]), int(m.geom_bodyid[h])}
    # A signature holds the numbers of two bodies.
    if any({int(x) >> 16, int(x) & 0xFFFF} == bodies for x in m.exclude_signature):
        return None
    bits = (m.geom_contype[g] & m.geom_conaffinity[h]) | (m.geom_contype[h] & m.geom_conaffinity[g])
    if not bits:
        return None
    if m.geom_priority[g] != m.geom_priority[h]:
        return _own_friction(m, g if m.geom_priority[g] > m.geom_priority[h] else h)
    if max(m.geom_condim[g], m.geom_condim[h]) == 1:
        return 0.0
    return float(max(m.geom_friction[g, 0], m.geom_friction[h, 0]))


def _height_field(m, g: int) -> HeightField:
    """Height field of a geom. MuJoCo has rows along y, and heights from 0 to 1 in units of the elevation."""
    i = int(m.geom_dataid[g])
    rows, columns = int(m.hfield_nrow[i]), int(m.hfield_ncol[i])
    start = int(m.hfield_adr[i])
    heights = np.asarray(m.hfield_data[start : start + rows * columns], float).reshape(rows, columns).T
    half = np.asarray(m.hfield_size[i, :2], float)
    return HeightField(heights * float(m.hfield_size[i, 2]), 2 * half / (np.array([columns, rows]) - 1))
