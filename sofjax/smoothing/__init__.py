"""All poses, all segments, the odometer's errors and, if asked, the mount at once.

Least squares by optimistix over the keyframes of a drive. The residuals are distances in pixels of
the end points of each observed segment from its map line, transferred into the image, and the
odometer's readings with their covariance. An observation ties one pose to one line, the odometer
one pose to the next: so the keyframes are divided by place, and what is known in one place only is
eliminated there (`dissection`, `elimination`), however often places are passed and in what order.

`solve` is one solution for associations that are given; `smooth` finds the associations as well.
"""

from sofjax.smoothing.association.lines import Lines as Lines
from sofjax.smoothing.association.lines import Seeing as Seeing
from sofjax.smoothing.final import final_map as final_map
from sofjax.smoothing.problem import Keyframes as Keyframes
from sofjax.smoothing.problem import Priors as Priors
from sofjax.smoothing.problem import Problem as Problem
from sofjax.smoothing.problem import Unknowns as Unknowns
from sofjax.smoothing.problem import residuals as residuals
from sofjax.smoothing.problem import robust as robust
from sofjax.smoothing.smoother import Path as Path
from sofjax.smoothing.smoother import Smoothed as Smoothed
from sofjax.smoothing.smoother import SmoothingConfig as SmoothingConfig
from sofjax.smoothing.smoother import smooth as smooth
from sofjax.smoothing.solution import Solution as Solution
from sofjax.smoothing.solution import solve as solve
