"""Checks of concrete initial states: causes of NaN in all later results are refused by name."""

import numpy as np


def describe_state(q, t, v=None) -> str:
    """Text description of a state for messages."""
    moving = "" if v is None else f"v = {np.asarray(v).tolist()}, "
    return f"q = {np.asarray(q).tolist()}, {moving}t = {float(t):.6g}"


def check_mass_matrix(mass, name: str, q, t) -> None:
    """Refuse a mass matrix that is not finite or not positive definite, in a measure independent of units."""
    mass = np.asarray(mass, float)
    place = describe_state(q, t)
    if not np.isfinite(mass).all():
        raise ValueError(f"the mass matrix of this {name} is not finite at {place}: {mass.tolist()}; start elsewhere")
    # Scaling by the diagonal makes the eigenvalues dimensionless: kg and kg m^2 are not comparable.
    scale = np.sqrt(np.abs(np.diag(mass)))
    # A coordinate without inertia keeps its zero row, which then shows as a zero eigenvalue.
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(mass / np.outer(scale, scale))
    # Eigenvalues of a matrix with unit diagonal have rounding errors of about n eps.
    least = 10 * len(mass) * float(np.finfo(np.asarray(q).dtype).eps)
    if values[0] > least:
        return
    rank = int(np.sum(np.abs(values) > least))
    if rank == len(mass):
        raise ValueError(
            f"the mass matrix of this {name} is not positive definite at {place}: eigenvalues "
            f"{np.linalg.eigvalsh(mass).tolist()}; check the signs of the kinetic energy"
        )
    # The eigenvector of the smallest eigenvalue, scaled back, is the velocity without kinetic energy.
    idle = vectors[:, np.argmin(np.abs(values))] / scale
    raise ValueError(
        f"the mass matrix of this {name} has rank {rank} of {len(mass)} at {place}: the velocity "
        f"{(idle / np.abs(idle).max()).round(6).tolist()} moves no mass; start elsewhere, leave coordinates out, or give "
        "them inertia"
    )
