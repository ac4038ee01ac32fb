"""The one map of segments: new or known, eq. (14), extend-only, R, L and rest, merging; III.B.

Each map line is kept as (rho, theta, kappa) in the foot frame from which it was first seen, its
anchor: far from the world's origin the polar form magnifies error (text of II.A), and about the
anchor the first sighting is the estimate itself. kappa = h / (h - z) is its apparent magnification:
1 on the floor, more for the top of a baseboard, less for a reflection below.
"""

from sofjax.segment_map.candidates import propose as propose
from sofjax.segment_map.final import FinalMap as FinalMap
from sofjax.segment_map.final import final_map as final_map
from sofjax.segment_map.growth import integrate as integrate
from sofjax.segment_map.lines import MapRules as MapRules
from sofjax.segment_map.lines import SegmentMap as SegmentMap
from sofjax.segment_map.lines import appear as appear
from sofjax.segment_map.lines import believed as believed
from sofjax.segment_map.lines import empty_map as empty_map
from sofjax.segment_map.lines import in_view as in_view
from sofjax.segment_map.lines import is_raised as is_raised
from sofjax.segment_map.lines import nearby as nearby
from sofjax.segment_map.lines import on_floor as on_floor
