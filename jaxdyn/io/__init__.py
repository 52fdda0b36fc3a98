"""Reading and writing mechanisms. File libraries are imported here alone, and only when a file is read."""

from jaxdyn.io.urdf import load_urdf as load_urdf
from jaxdyn.io.urdf import urdf_inertia_report as urdf_inertia_report
from jaxdyn.io.urdf_write import save_urdf as save_urdf
