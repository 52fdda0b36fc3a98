"""Scenes with known motions for reports: closed forms, printed results, and published run times of other programs.

`python -m benchmarks.work_precision` measures them.
"""

import jax.numpy as jnp
import numpy as np

from benchmarks.report_cases import references
from benchmarks.report_cases.builders import scene_builder
from benchmarks.report_cases.in_contact import in_contact
from benchmarks.report_cases.mechanisms import mechanisms
from benchmarks.report_cases.test_set import andrews, car_axis
from jaxdyn.forces.elements import Drive
from jaxdyn.model import robots
from jaxdyn.reports import references as closed_forms
from jaxdyn.reports.programs import Case
from jaxdyn.systems.scene import Scene

_I5 = "Intel i5-4570, date not stated"
# Published runs of the same motions: label, CPU seconds, and the largest error of the state or of the energy (J) where stated.
PUBLISHED = {
    "pendulum_in_plane": (
        (f"OpenSim 3.2 ({_I5})", 0.637, None, None),
        ("Exudyn, step 0.8 ms (Intel i7 laptop, date not stated)", 0.037, None, 5e-5),
    ),
    "windows": (
        (f"OpenSim 3.2 ({_I5})", 0.455, None, None),
        ("Exudyn, step 10 ms (date not stated)", 0.0776, None, 0.114),
    ),
    "andrews": (
        ("PSIDE at 1e-14 (Cray C90, 1990s)", 56.74, 3e-8, None),
        (f"OpenSim 3.2 on 0.05 s, problem A03 ({_I5})", 0.384, None, None),
    ),
}


def _stiff_elbow() -> tuple[Scene, tuple]:
    drive = Drive(kp=jnp.asarray([0.0, 1e5]), kd=jnp.asarray([0.1, 1e4]), target=jnp.asarray([0.0, 0.5]))
    return Scene(robots.chain(2), forces=(drive,)), (np.array([1.0, 0.8]), np.zeros(2))


def _cases() -> tuple[Case, ...]:
    ten = np.linspace(0.0, 10.0, 11)
    return (
        Case(
            "pendulum_in_plane",
            "Plane pendulum in x and y, 10 s (problem A01 of the IFToMM library)",
            scene_builder("pendulum_in_plane"),
            lambda start: closed_forms.plane_pendulum(ten),
            ten,
            500,
        ),
        Case(
            "spherical_pendulum",
            "Spherical pendulum in x, y and z, 10 s",
            scene_builder("spherical_pendulum"),
            lambda start: closed_forms.sphere_pendulum(ten),
            ten,
            250,
        ),
        Case(
            "free_body",
            "Free rigid body with three different moments of inertia, 20 s",
            scene_builder("free_body"),
            lambda start: closed_forms.free_top(2 * ten),
            2 * ten,
            100,
        ),
        Case(
            "double_pendulum",
            "Double pendulum of two bodies in a chain, 5 s",
            scene_builder("double_pendulum", formulation="model"),
            None,
            ten / 2,
            100,
        ),
        Case(
            "rolling_disk",
            "Upright disk that rolls on a circle, 10 s",
            scene_builder("rolling_disk"),
            lambda start: closed_forms.upright_disk(ten),
            ten,
            50,
        ),
        Case(
            "chaplygin_sleigh",
            "Chaplygin's sleigh, 10 s",
            scene_builder("chaplygin_sleigh"),
            lambda start: closed_forms.sleigh(ten),
            ten,
            50,
        ),
        Case(
            "rolling_coin",
            "Leaning disk that rolls steadily on a circle, 5 s: close to one turn",
            scene_builder("rolling_coin"),
            lambda start: closed_forms.coin(ten / 2),
            ten / 2,
            250,
        ),
        Case(
            "bicycle",
            "Whipple's bicycle at 4.6 m/s after a push to its side, 3 s",
            scene_builder("bicycle", roll_rate=0.5),
            None,
            np.linspace(0.0, 3.0, 7),
            150,
        ),
        Case(
            "four_bar",
            "Four-bar linkage, 5 s",
            scene_builder("four_bar"),
            None,
            ten / 2,
            100,
        ),
        Case(
            "windows",
            "Two four-bar windows, 10 s (problem A02 of the IFToMM library, N = 2), through positions where rows lose rank",
            scene_builder("windows", count=2),
            lambda start: closed_forms.windows(ten, 2),
            ten,
            500,
        ),
        Case(
            "windows_40",
            "Forty four-bar windows, 1 s of the 20 s of problem A02 of the IFToMM library, through one position where rows "
            "lose rank",
            scene_builder("windows", count=40),
            lambda start: closed_forms.windows(ten / 10, 40),
            ten / 10,
            10,
        ),
        Case(
            "andrews",
            "Andrews' squeezing mechanism, 0.03 s (test set for IVP solvers)",
            scene_builder(andrews),
            references.andrews,
            np.array([0.0, 0.03]),
            250,
        ),
        Case(
            "held_elbow",
            "Double pendulum whose elbow a stiff drive holds, 2 s: decays of 1e5 1/s",
            _stiff_elbow,
            None,
            ten / 5,
            1000,
            conserves=False,
            stiff=True,
        ),
        Case(
            "car_axis",
            "Car axis on a bumpy road, 3 s (test set for IVP solvers): constraints that move with time",
            scene_builder(car_axis),
            references.car_axis,
            np.array([0.0, 3.0]),
            250,
            conserves=False,
            stiff=True,
        ),
    )


def cases() -> dict[str, Case]:
    """All scenes of the report by name: those of `jd.scenes`, some in several forms, and one with a stiff drive."""
    return {case.name: case for case in (*_cases(), *mechanisms(), *in_contact())}
