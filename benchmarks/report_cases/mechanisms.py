"""Cases of the report: systems in coordinates, immersed systems, linkages and vehicles."""

import numpy as np

import jaxdyn as jd
from benchmarks.report_cases import references
from benchmarks.report_cases.builders import scene_builder
from benchmarks.report_cases.test_set import ANDREWS_ORDER, andrews_bodies
from jaxdyn.reports import references as closed_forms
from jaxdyn.reports.programs import Case, Reference


def _andrews_bodies(start) -> Reference:
    """Published final state of Andrews' mechanism in the order of the bodies."""
    known, order = references.andrews((start[0][np.argsort(ANDREWS_ORDER)], start[1])), np.array(ANDREWS_ORDER)
    return known._replace(q=known.q[:, order], v=known.v[:, order])


def _block() -> tuple[jd.Scene, tuple]:
    """The block with friction that does not stick, so that all methods integrate it up to where it stops."""
    scene, (q, v) = jd.scenes.sliding_block(), jd.scenes.sliding_block.start()
    friction = jd.forces.SlidingFriction(0.3, 9.81, 1)
    return jd.Scene(scene.system, forces=(friction,)), (np.asarray(q), np.asarray(v))


def _systems(ten: np.ndarray) -> tuple[Case, ...]:
    """Systems in coordinates, and systems joined by an immersion."""
    return (
        Case(
            "pendulum",
            "Pendulum by its angle, from rest at the level of its axis, 10 s",
            scene_builder("pendulum"),
            lambda start: closed_forms.swing(ten),
            ten,
            250,
        ),
        Case(
            "particle_in_plane",
            "Particle thrown in a plane, 1 s: every method of order two is exact",
            scene_builder("particle_in_plane"),
            lambda start: closed_forms.projectile(ten / 10),
            ten / 10,
            5,
        ),
        Case(
            "spherical_pendulum_in_angles",
            "Spherical pendulum by two angles, 5 s",
            scene_builder("spherical_pendulum_in_angles"),
            None,
            ten / 2,
            100,
        ),
        Case(
            "planar_arm",
            "Arm of two joints that falls, by its energies, 2 s",
            scene_builder("planar_arm"),
            None,
            ten / 5,
            100,
        ),
        Case(
            "spatial_arm",
            "Arm of three joints in space that falls, 2 s",
            scene_builder("spatial_arm"),
            None,
            ten / 5,
            100,
        ),
        Case(
            "rigid_body_in_euler_angles",
            "Rigid body by its Euler angles, 1 s: a chart that ends at two poles",
            scene_builder("rigid_body_in_euler_angles"),
            None,
            ten / 10,
            50,
        ),
        Case(
            "free_box",
            "Box that turns about its middle axis, 2 s",
            scene_builder("free_box"),
            None,
            ten / 5,
            50,
        ),
        Case(
            "sliding_block",
            "Block that slides to a stop by Coulomb friction, up to nine tenths of its way: exact for every method of order two",
            _block,
            lambda start: references.sliding_block(0.06 * ten),
            0.06 * ten,
            5,
            conserves=False,
        ),
        Case(
            "double_pendulum_immersed",
            "Double pendulum of two separate bodies joined by an immersion, 5 s",
            scene_builder("double_pendulum", formulation="immersion"),
            None,
            ten / 2,
            100,
        ),
        Case(
            "double_pendulum_with_loop",
            "Double pendulum of a pendulum and a separate body, closed by a revolute joint, 5 s",
            scene_builder("double_pendulum", formulation="loop"),
            None,
            ten / 2,
            100,
        ),
        Case(
            "disk_and_link",
            "Disk on the ground under a link that touches it, two bodies joined by an immersion, 0.5 s",
            scene_builder("disk_and_link"),
            None,
            ten / 20,
            25,
        ),
    )


def _linkages(ten: np.ndarray) -> tuple[Case, ...]:
    return (
        Case(
            "andrews_bodies",
            "Andrews' squeezing mechanism from its seven bodies, 0.03 s (test set for IVP solvers)",
            scene_builder(andrews_bodies),
            _andrews_bodies,
            np.array([0.0, 0.03]),
            250,
            # Its spring and its motor are forces, whose energy is not counted.
            conserves=False,
        ),
        Case("slider_crank", "Slider-crank, 3 s", scene_builder("slider_crank"), None, 0.3 * ten, 100),
        Case(
            "bennett",
            "Bennett's linkage, 4 s: two independent rows of five",
            scene_builder("bennett"),
            None,
            0.4 * ten,
            100,
            reduces=False,
        ),
        Case(
            "goldberg",
            "Goldberg's five-bar linkage, 2 s: five rows of which three are independent",
            scene_builder("goldberg"),
            None,
            ten / 5,
            50,
            reduces=False,
        ),
        Case(
            "bricard",
            "Bricard's linkage with threefold symmetry, 2 s: five rows of which four are independent",
            scene_builder("bricard"),
            None,
            ten / 5,
            50,
            reduces=False,
        ),
        Case(
            "sarrus",
            "Sarrus's linkage, 0.6 s: a platform that hinges guide along a line, five rows of which four are independent",
            scene_builder("sarrus"),
            None,
            0.06 * ten,
            50,
            reduces=False,
        ),
        Case(
            "hinge_platform",
            "Platform on three legs of hinges in an inclined plane, 0.5 s: ten rows of which four are independent",
            scene_builder("hinge_platform"),
            None,
            ten / 20,
            50,
            reduces=False,
        ),
        Case(
            "closed_ring",
            "Ring of six bars that turns, 2 s",
            scene_builder("closed_ring"),
            None,
            ten / 5,
            50,
        ),
        Case(
            "parallel_manipulator",
            "Redundant parallel manipulator, three legs of two links that carry one point, 2 s",
            scene_builder("parallel_manipulator"),
            None,
            ten / 5,
            50,
        ),
    )


def _vehicles(ten: np.ndarray) -> tuple[Case, ...]:
    return (
        Case("car", "Car with three wheels on a circle, 4 s", scene_builder("car"), None, 0.4 * ten, 50),
        Case(
            "differential_drive",
            "Robot on two wheels, 4 s",
            scene_builder("differential_drive"),
            None,
            0.4 * ten,
            50,
        ),
        Case("snakeboard", "Snakeboard, 4 s", scene_builder("snakeboard"), None, 0.4 * ten, 50),
        Case(
            "knife_edge_on_incline",
            "Skate on an inclined plane, 5 s: a cycloid that does not go downhill",
            scene_builder("knife_edge_on_incline"),
            lambda start: closed_forms.skate(ten / 2),
            ten / 2,
            50,
        ),
        Case("suslov", "Suslov's problem, 5 s", scene_builder("suslov"), None, ten / 2, 50),
        Case(
            "ball_on_incline",
            "Ball that rolls down an inclined plane, 2 s",
            scene_builder("ball_on_incline", velocity=(0.5, 0.0)),
            lambda start: references.rolling_down(ten / 5),
            ten / 5,
            100,
        ),
        Case(
            "ball_on_turntable",
            "Ball on a turntable that is driven, 5 s",
            scene_builder("ball_on_turntable"),
            lambda start: closed_forms.turntable(ten / 2),
            ten / 2,
            100,
            conserves=False,
        ),
    )


def mechanisms() -> tuple[Case, ...]:
    """Cases without hands."""
    ten = np.linspace(0.0, 10.0, 11)
    return (*_systems(ten), *_linkages(ten), *_vehicles(ten))
