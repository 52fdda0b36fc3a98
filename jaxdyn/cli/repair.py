"""Loading of robots with massless moving links, whose inertias an identification is to find."""

import argparse
import pathlib
import tempfile
import xml.etree.ElementTree as ET

from jaxdyn.cli.common import load_model
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model.arguments import parse_number
from jaxdyn.model.tree import Model

# Initial inertia of a massless link: a solid ball with this fraction of the mass of the heaviest link, and this radius (m). The
# ball makes the mass matrix positive definite and changes the motion of the other links little; the fit replaces it.
_MASS_FRACTION, _RADIUS = 1e-2, 0.05


def load_for_repair(path: str, args: argparse.Namespace) -> tuple[Model, list[str]]:
    """Load a model, and the names of the massless moving links that were given a small ball.

    Links are changed only if the file cannot be loaded as it is. The changed copy is a temporary file.

    **Raises:** ValueError as `load_model`, where balls do not help.
    """
    try:
        return load_model(path, args), []
    except ValueError:
        try:
            tree = ET.ElementTree(XmlFile(path, "URDF").root)
            names = _add_balls(tree.getroot())  # pyright: ignore[reportArgumentType]
        except ValueError:
            tree, names = None, []
        if tree is None or not names:
            raise
        # The loader reads files alone, and the user's own file must not change.
        with tempfile.TemporaryDirectory() as folder:
            file = pathlib.Path(folder) / pathlib.Path(path).name
            tree.write(file, encoding="utf-8", xml_declaration=True)
            return load_model(str(file), args), names


def _add_balls(robot: ET.Element) -> list[str]:
    """Give each massless moving link a ball, in place; return their names."""
    moving = {
        child.get("link")
        for joint in robot.iterfind("joint")
        if joint.get("type") != "fixed"
        for child in joint.iterfind("child")
    }
    masses = [parse_number(mass.get("value", "0")) for mass in robot.iterfind("link/inertial/mass")]
    mass = _MASS_FRACTION * (max(masses, default=0) or 1.0)  # relative to 1 kg if no link has a mass
    names = []
    for link in robot.iterfind("link"):
        own = link.find("inertial/mass")
        if link.get("name") not in moving or (own is not None and parse_number(own.get("value", "0")) > 0):
            continue
        # An <inertial> of zero mass would be a second one next to the ball.
        for old in link.findall("inertial"):
            link.remove(old)
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "mass", value=repr(mass))
        moment = repr(0.4 * mass * _RADIUS**2)  # 2/5 m r^2, a solid ball
        zero = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
        ET.SubElement(inertial, "inertia", {"ixx": moment, "iyy": moment, "izz": moment, **zero})
        names.append(str(link.get("name")))
    return names
