"""The front end: images in, segments out. The only place that knows OpenCV."""

import os

# a small file may unfold into gigabytes: OpenCV reads this when it is loaded
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**26))

from sofjax.vision.detectors import DETECTORS as DETECTORS
from sofjax.vision.detectors import Detector as Detector
from sofjax.vision.detectors import detect_hough as detect_hough
from sofjax.vision.detectors import detect_lsd as detect_lsd
from sofjax.vision.frontend import Frontend as Frontend
from sofjax.vision.frontend import FrontendSettings as FrontendSettings
from sofjax.vision.frontend import ImageSegments as ImageSegments
from sofjax.vision.frontend import pack as pack
from sofjax.vision.images import read_image as read_image
from sofjax.vision.lens import Lens as Lens
from sofjax.vision.observe import observation as observation
from sofjax.vision.observe import observations as observations
from sofjax.vision.observe import observe_drive as observe_drive
from sofjax.vision.observe import without_repeats as without_repeats
from sofjax.vision.rectify import rectify as rectify
