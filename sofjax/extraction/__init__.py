"""Which segments of an image lie on the floor; eq. (9), Fig. 5, section II."""

from sofjax.extraction.association import Association as Association
from sofjax.extraction.batch import association_scores as association_scores
from sofjax.extraction.batch import homographies as homographies
from sofjax.extraction.batch import transferred_lines as transferred_lines
from sofjax.extraction.observation import Observation as Observation
from sofjax.extraction.sof import SofExtraction as SofExtraction
from sofjax.extraction.sof import View as View
from sofjax.extraction.sof import extract as extract
