"""Pictures of mechanisms: drawings and animations by matplotlib, pages for a browser by viser, plots of motions.

What is drawn is a list of solids on the frames of a model (`solids`): those of the file that the model came from,
or rods between joints and solids of the bodies' inertias (`inferred`). Where they stand, and the forces on them, is
`motion`; what is up and from where one looks is `stage`. `drawing` and `page` show that, each with its library, imported
when it is used.
"""

from types import ModuleType as _ModuleType

from jaxdyn.pictures import plot as plot
from jaxdyn.pictures.drawing import animate as animate
from jaxdyn.pictures.drawing import draw as draw
from jaxdyn.pictures.page import Viewer as Viewer
from jaxdyn.pictures.page import save_html as save_html
from jaxdyn.pictures.page import view as view
from jaxdyn.pictures.solids import Shape as Shape
from jaxdyn.pictures.solids import Shapes as Shapes
from jaxdyn.pictures.solids import shapes as shapes


def __dir__() -> list[str]:
    """Names of the namespace; of its modules `plot` alone is public."""
    return [x for x, value in globals().items() if x == "plot" or (x[0] != "_" and not isinstance(value, _ModuleType))]
