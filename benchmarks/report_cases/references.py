"""Reference motions of cases that are no named scene's default motion: closed forms and published numbers."""

import numpy as np

from jaxdyn.reports.references import Reference, closed_form


def sliding_block(ts, velocity: float = 2.0, friction: float = 0.3, gravity: float = 9.81) -> Reference:
    """Block sliding with Coulomb friction, before it stops."""
    slower = friction * gravity
    return closed_form(ts, [velocity * ts - slower * ts**2 / 2], [velocity - slower * ts], "parabola")


def rolling_down(
    ts, velocity: float = 0.5, radius: float = 0.1, slope: float = np.pi / 6, gravity: float = 9.81
) -> Reference:
    """Solid ball that rolls straight down an inclined plane: acceleration (5/7) g sin(slope), rotation about y."""
    pull, zero = 5 / 7 * gravity * np.sin(slope), 0 * ts
    distance, speed = velocity * ts + pull * ts**2 / 2, velocity + pull * ts
    half = distance / radius / 2
    # v is in the axes of the ball, which turn about y.
    c, s = np.cos(2 * half), np.sin(2 * half)
    q = distance, zero, radius + zero, np.cos(half), zero, np.sin(half), zero
    return closed_form(ts, q, (speed * c, zero, speed * s, zero, speed / radius, zero), "parabola")


# Andrews' mechanism at 0.03 s, from DOP853 on the index-1 form, tolerances 1e-11 to 3e-14 agree to 7e-11; the printed state
# (PSIDE, test set for IVP solvers) agrees with it to 1.3e-10 in (q, beta', Theta') and to 5e-8 in the other rates.
_ANDREWS_END = (
    (
        15.8107711951536,
        -15.7563710584117,
        0.0408222401196349,
        -0.534730116342099,
        0.524409965879953,
        0.534730116342096,
        1.04808074104194,
    ),
    (
        1139.92030225910,
        -1424.37929517754,
        11.0329119105884,
        19.2933741049792,
        0.573569914828063,
        -19.2933741049794,
        0.323179149247880,
    ),
)
# Car axis at 3 s: GAMD in quadruple precision.
_CAR_END = (
    (0.0493455784275402809122, 0.496989460230171153861, 1.04174252488542151681, 0.373911027265361256927),
    (-0.0770583684040972357970, 0.00744686658723778553466, 0.0175568157537232222276, 0.770341043779251976443),
)


def published_state(end, time: float, start, source: str, error: float) -> Reference:
    """Build a reference from the start and one published final state."""
    q, v = (np.stack([np.asarray(a), np.asarray(b)]) for a, b in zip(start, end, strict=True))
    return Reference(np.array([0.0, time]), q, v, "printed", source, error)


def andrews(start) -> Reference:
    """Andrews' mechanism at 0.03 s."""
    source = "DOP853 on equations of its own, two tolerances; printed digits of the test set for IVP solvers agree"
    return published_state(_ANDREWS_END, 0.03, start, source, 7e-11)


def car_axis(start) -> Reference:
    """Car axis at 3 s."""
    return published_state(
        _CAR_END, 3.0, start, "test set for IVP solvers, 14 digits (GAMD in quadruple precision)", 1e-14
    )
