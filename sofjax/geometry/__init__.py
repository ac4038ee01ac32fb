"""Frames, cameras, the floor and its lines. Pure functions; only JAX and Equinox are imported."""

from sofjax.geometry.camera import Camera as Camera
from sofjax.geometry.camera import Mount as Mount
from sofjax.geometry.camera import projection_matrix as projection_matrix
from sofjax.geometry.camera import rotation_robot_camera as rotation_robot_camera
from sofjax.geometry.floor import floor_homography as floor_homography
from sofjax.geometry.floor import floor_to_image as floor_to_image
from sofjax.geometry.floor import image_to_floor as image_to_floor
from sofjax.geometry.floor import line_to_floor as line_to_floor
from sofjax.geometry.floor import line_to_image as line_to_image
from sofjax.geometry.floor import may_be_upright as may_be_upright
from sofjax.geometry.floor import segment_to_floor as segment_to_floor
from sofjax.geometry.lines import PolarLine as PolarLine
from sofjax.geometry.lines import line_through as line_through
from sofjax.geometry.lines import polar as polar
from sofjax.geometry.lines import polar_difference as polar_difference
from sofjax.geometry.lines import polar_through as polar_through
from sofjax.geometry.lines import transfer_line as transfer_line
from sofjax.geometry.se2 import SE2 as SE2
from sofjax.geometry.segments import Segments as Segments
from sofjax.geometry.segments import overlap as overlap
from sofjax.geometry.two_view import two_view_homography as two_view_homography
