"""The one map of segments: new or known, eq. (14), extend-only, R, L and rest, merging; III.B.

Each map line is kept as (rho, theta, apparent scale) in the nadir frame of its first measurement,
its anchor: far from the world's origin the polar form magnifies error (text of II.A), and about the
anchor the first measurement is the estimate itself. The apparent scale is h / (h - z): 1 on the
floor, more for the top of a baseboard, less for a reflection below.
"""

from sofjax.segment_map.classify import FinalMap as FinalMap
from sofjax.segment_map.classify import final_map as final_map
from sofjax.segment_map.classify import is_off_floor as is_off_floor
from sofjax.segment_map.classify import is_shown as is_shown
from sofjax.segment_map.classify import on_floor as on_floor
from sofjax.segment_map.classify import posterior_given_class as posterior_given_class
from sofjax.segment_map.classify import scale_is_off_floor as scale_is_off_floor
from sofjax.segment_map.data_association import candidate_associations as candidate_associations
from sofjax.segment_map.local_map import in_view as in_view
from sofjax.segment_map.local_map import middles_in_view as middles_in_view
from sofjax.segment_map.local_map import nearby as nearby
from sofjax.segment_map.local_map import predict_measurement as predict_measurement
from sofjax.segment_map.types import MapConfig as MapConfig
from sofjax.segment_map.types import SegmentMap as SegmentMap
from sofjax.segment_map.types import empty_map as empty_map
from sofjax.segment_map.update import Observed as Observed
from sofjax.segment_map.update import integrate as integrate
