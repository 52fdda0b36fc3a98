"""Loader of robots with massless moving links, for fits that are to identify their inertias."""

import argparse
import pathlib
import tempfile
import xml.etree.ElementTree as ET

from jaxdyn.cli.common import load_model
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model.arguments import parse_number
from jaxdyn.model.tree import Model

# Initial inertia of a massless link: this fraction of the heaviest link's mass, as a ball of this radius (m).
_SHARE, _RADIUS = 1e-2, 0.05


def load_for_repair(path: str, args: argparse.Namespace) -> tuple[Model, list[str]]:
    """Load a model; massless moving links get a small ball if it cannot be loaded without. Return it with their names.

    **Raises:** ValueError as `load_model`, where such a ball does not help.
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
        with tempfile.TemporaryDirectory() as folder:
            file = pathlib.Path(folder) / pathlib.Path(path).name
            tree.write(file, encoding="utf-8", xml_declaration=True)
            return load_model(str(file), args), names


def _add_balls(robot: ET.Element) -> list[str]:
    """Give massless moving links a ball; return their names."""
    moved = {
        child.get("link")
        for joint in robot.iterfind("joint")
        if joint.get("type") != "fixed"
        for child in joint.iterfind("child")
    }
    masses = [parse_number(mass.get("value", "0")) for mass in robot.iterfind("link/inertial/mass")]
    mass = _SHARE * (max(masses, default=0) or 1.0)
    names = []
    for link in robot.iterfind("link"):
        given = link.find("inertial/mass")
        if link.get("name") not in moved or (given is not None and parse_number(given.get("value", "0")) > 0):
            continue
        for old in link.findall("inertial"):
            link.remove(old)
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "mass", value=repr(mass))
        moment = repr(0.4 * mass * _RADIUS**2)
        zero = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
        ET.SubElement(inertial, "inertia", {"ixx": moment, "iyy": moment, "izz": moment, **zero})
        names.append(str(link.get("name")))
    return names
