"""Figures to look at. The only place that knows matplotlib, which is an extra."""

from sofjax.viewer.checkerboard import draw_corners as draw_corners
from sofjax.viewer.figures import MISSING as MISSING
from sofjax.viewer.figures import MapFigure as MapFigure
from sofjax.viewer.figures import available as available
from sofjax.viewer.figures import draw_images as draw_images
from sofjax.viewer.figures import draw_map as draw_map
from sofjax.viewer.mount import draw_mount as draw_mount
from sofjax.viewer.style import SIGNATURE as SIGNATURE
