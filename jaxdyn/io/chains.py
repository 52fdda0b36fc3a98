"""Bodies with several joints, or with joint axes off the body origin, as chains of bodies of a `Model`.

A joint of a `Model` rotates its body about an axis through the body's origin. Formats let the axis pass anywhere, and put
several joints between two bodies. Each joint k displaces all after it by D_k(x) = Trans(a_k) J_k(x) Trans(-a_k), with the
anchor a_k and the axis in the axes of the body, so that the pose of the body is

    pose D_1(q_1 - r_1) D_2(q_2 - r_2) ...

with the joints' reference positions r_k: where the body is at `pose`, q = r. D_k(x - r) = D_k(-r) D_k(x) puts the
reference into the home poses.
"""

import re
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.model import host_math
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.joints import SCREW_KINDS
from jaxdyn.model.tree import Model


class Link(NamedTuple):
    """Joint of a chain: axis (3,) and anchor (3,) in the body's axes and frame, reference in rad or m."""

    name: str
    kind: str
    axis: np.ndarray
    anchor: np.ndarray
    reference: float
    leaves: dict[str, Any]
    pitch: float = 0.0


class Names:
    """Names in use. Formats have separate namespaces of joints, bodies and sites; a model has one of frames."""

    def __init__(self):
        self._used: set[str] = set()

    def new(self, wanted: str) -> str:
        """Reserve a name, with underscores appended while it is taken."""
        # An appended underscore keeps the file's spelling recognisable, and the result does not depend on other names.
        while wanted in self._used:
            wanted += "_"
        self._used.add(wanted)
        return wanted


def build_model(builder: ModelBuilder, path) -> Model:
    """Build the model of a file. **Raises:** ValueError of `ModelBuilder.build`, with the file and without advice for URDF."""
    try:
        return builder.build()
    except ValueError as error:
        # The builder's advice `lock=` is for URDF files; the loaders of SDF and MJCF have no such option.
        raise ValueError(f"{path}: {re.sub(r' .of a URDF: lock=.*', '', str(error))}") from error


def add_chain(
    builder: ModelBuilder,
    frames: Names,
    joint_names: Names,
    body: str,
    parent: str | None,
    pose,
    joints: list[Link],
    inertia,
) -> None:
    """Add a body with its joints. The frame `body` is the body's own; intermediate bodies are named BODY_JOINT.

    `pose` (4, 4) is that of the body's frame in the parent's where all joints are at their references; without joints
    the body is fixed. New names are reserved in `frames` and `joint_names`, which hold those of the file.
    """
    here, carrier = np.asarray(pose, float), parent
    for k, joint in enumerate(joints):
        # Translations and free joints do not depend on the anchor.
        turns = joint.kind not in ("prismatic", "free")
        anchor = np.eye(4)
        if turns:
            # The anchor's component along the axis has no effect; dropping it avoids intermediate bodies.
            along = joint.axis * (joint.axis @ joint.anchor) if joint.kind in SCREW_KINDS else np.zeros(3)
            # The subtraction leaves rounding where the anchor lies on the axis, which would add a massless body per joint.
            shift = joint.anchor - along
            anchor[:3, 3] = np.where(np.abs(shift) > 1e-15 * np.abs(joint.anchor).max(initial=0.0), shift, 0.0)
        leaves: dict[str, Any] = dict(joint.leaves)
        home = here @ anchor
        if joint.kind in SCREW_KINDS:
            leaves |= {"axis": joint.axis, "pitch": joint.pitch}
            slide = np.zeros(3) if joint.kind != "prismatic" else joint.axis
            screw = np.concatenate([slide, joint.axis if turns else np.zeros(3)])
            if joint.reference:
                # D(x - r) = D(-r) D(x): the reference position moves into the home pose, and q keeps the file's zero.
                home = home @ host_math.joint_pose(joint.kind, screw, np.array([-joint.reference]))
        # Only the body itself carries the inertia; intermediate bodies are massless.
        last = k == len(joints) - 1 and not anchor[:3, 3].any()
        # Default joint names contain the body's name already; repeating it would give BODY_BODY_joint.
        between = joint.name if joint.name.startswith(body) else f"{body}_{joint.name}"
        name = body if last else frames.new(between)
        builder.add_body(
            name, carrier, joint.kind, inertia if last else None, joint_name=joint.name, pose=home, **leaves
        )
        if last:
            return
        # The next joint is given in the body's axes, and Trans(-a_k) of D_k comes after J_k.
        here, carrier = host_math.inverse(anchor), name
    # The last anchor is off the origin: a fixed body brings the frame back to the file's own.
    builder.add_body(body, carrier, "fixed", inertia, joint_name=joint_names.new(f"{body}_fixed"), pose=here)
