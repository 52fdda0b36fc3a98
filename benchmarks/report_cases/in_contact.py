"""Cases of the report with contacts: hands, arms, a box on a table. Contacts are two-sided, without regard to friction cones."""

import numpy as np

from benchmarks.report_cases.builders import scene_builder
from jaxdyn.reports import references
from jaxdyn.reports.programs import Case


def in_contact() -> tuple[Case, ...]:
    """Cases with contacts. Hands without torques release their object, so that their motions are short."""
    ten = np.linspace(0.0, 10.0, 11)
    short = ten / 50
    return (
        Case(
            "sphere_arm",
            "Arm of six joints whose tip slides on a sphere without friction, 0.5 s: five coordinates of contact",
            scene_builder("sphere_arm"),
            None,
            ten / 20,
            50,
        ),
        Case(
            "sphere_arm_rolling",
            "Arm of six joints whose tip rolls on a sphere, 0.5 s: two velocities, four rows",
            scene_builder("sphere_arm", contact="rolling"),
            None,
            ten / 20,
            50,
        ),
        Case(
            "hand_with_bar",
            "Two-finger hand in a plane that holds a bar, 0.2 s",
            scene_builder("hand_with_bar"),
            None,
            short,
            25,
        ),
        Case(
            "hand_with_disk",
            "Two-finger hand in a plane with a disk that rolls between its fingers, 0.2 s",
            scene_builder("hand_with_disk"),
            None,
            short,
            25,
        ),
        Case(
            "hand_with_ball",
            "Three-finger hand that holds a ball at three points, 0.2 s",
            scene_builder("hand_with_ball"),
            None,
            short,
            25,
        ),
        Case(
            "hand_rolling_ball",
            "Three-finger hand whose round fingertips roll on a ball, 0.2 s",
            scene_builder("hand_rolling_ball"),
            None,
            short,
            25,
        ),
        Case(
            "hand_rolling_egg",
            "Three-finger hand whose fingertips, ellipsoids, roll on an ellipsoid, 0.2 s",
            scene_builder("hand_rolling_egg"),
            None,
            short,
            25,
        ),
        Case(
            "allegro_with_cube",
            "Allegro hand with a cube, 0.05 s: 13 degrees of freedom, seven of them internal",
            scene_builder("allegro_with_cube"),
            None,
            ten / 200,
            25,
        ),
        Case(
            "coordinated_lifting",
            "Two KUKA iiwa that hold a plate together, 0.4 s",
            scene_builder("coordinated_lifting"),
            None,
            ten / 25,
            25,
        ),
        Case(
            "box_on_table",
            "Box on a table that tips over, held by six rows, 4 s: its base lets go soon after",
            scene_builder("box_on_table"),
            lambda start: references.falling_table(0.4 * ten),
            0.4 * ten,
            25,
        ),
    )
