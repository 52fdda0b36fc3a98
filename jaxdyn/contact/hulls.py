"""Convex hulls of meshes by few vertices."""

import numpy as np

_DIRECTIONS = 400  # in which the error of a hull is measured


def hull_vertices(points: np.ndarray, most: int) -> tuple[np.ndarray, int, float]:
    """At most `most` vertices (n, 3) of the convex hull of points, the number of all, and the largest distance left out, m.

    Vertices are added where the hull so far falls most short, in directions that are spread over the sphere.
    """
    # Imported on use, because scipy's geometry takes long to import.
    from scipy.spatial import ConvexHull as Hull
    from scipy.spatial import QhullError

    points = np.unique(points, axis=0)
    try:
        points = points[np.sort(Hull(points).vertices)]
    except (QhullError, ValueError):
        pass  # flat, or less than four points: all of them
    if len(points) <= most:
        return points, len(points), 0.0
    k = np.arange(_DIRECTIONS) + 0.5
    polar, around = np.arccos(1 - 2 * k / _DIRECTIONS), np.pi * (1 + 5**0.5) * k
    directions = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], 1)
    reach = points @ directions.T
    wanted, chosen = reach.max(0), [int(np.argmax(reach[:, 0]))]
    while len(chosen) < most:
        short = wanted - reach[chosen].max(0)
        if short.max() <= 0:
            break
        chosen.append(int(np.argmax(reach[:, np.argmax(short)])))
    return points[np.sort(chosen)], len(points), float((wanted - reach[chosen].max(0)).max())
