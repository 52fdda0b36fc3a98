"""Checks and repairs of the inertias of a model."""

import numpy as np

from jaxdyn.model import host_math
from jaxdyn.model.arguments import store_leaf
from jaxdyn.model.inertia import nearest_feasible
from jaxdyn.model.tree import Model


def inertia_report(model: Model) -> list[tuple[str, str]]:
    """Unphysical inertias of a model, as (body, problem).

    Listed are bodies that are massless, whose rotational inertia about the centre of mass is not positive definite, or
    whose principal moments break the triangle inequality (one exceeds the sum of the other two).

    Such bodies are common in files made by hand and harmless where other bodies move with them; see `repair_inertias`.
    """
    return [
        (name, problem)
        for name, parameters in zip(model.body_names, np.asarray(model.inertias), strict=True)
        for problem in inertia_problems(parameters)
    ]


def inertia_problems(parameters) -> list[str]:
    """Faults of ten inertial parameters (10,), in words; an empty list for physical ones."""
    parameters = np.asarray(parameters)
    # The shift from the origin to the centre of mass leaves a few roundings of the precision the numbers came in.
    rounding = 64 * np.finfo(parameters.dtype).eps
    parameters = parameters.astype(np.float64)
    if not np.isfinite(parameters).all():
        return [f"not finite: {parameters.tolist()}"]
    if not parameters.any():
        return ["massless"]
    if parameters[0] <= 0:
        return [f"mass {parameters[0]} kg with first moments and inertia {parameters[1:].tolist()}"]
    moments = np.linalg.eigvalsh(host_math.about_com(parameters)[2])
    slack = rounding * np.abs(host_math.rotational_inertia(parameters)).max()
    text = ", ".join(f"{moment:.6g}" for moment in moments)
    if moments[0] <= slack:
        return [f"not positive definite: principal moments {text} kg m^2"]
    if moments[2] > moments[0] + moments[1] + slack:
        return [f"triangle inequality violated: principal moments {text} kg m^2"]
    return []


def repair_inertias(model: Model) -> Model:
    """Copy of a model in which every body with mass has physical inertial parameters (`inertia.nearest_feasible`).

    Bodies that `inertia_report` does not list and massless ones stay unchanged.

    **Raises:** ValueError that names the body for NaN or infinity.
    """
    inertias = np.array(model.inertias)
    for i, parameters in enumerate(inertias):
        # A massless body has no inertia to repair: only the file's author knows the mass.
        if parameters[0] > 0 and inertia_problems(parameters):
            try:
                inertias[i] = nearest_feasible(parameters)
            except ValueError as error:
                raise ValueError(f"body {model.body_names[i]!r}: {error}") from error
    return model.replace(inertias=store_leaf(inertias, inertias.dtype))
