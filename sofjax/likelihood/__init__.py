"""The sensor model, and its two evaluations; section III.A."""

from sofjax.likelihood.batch import image_log_likelihood as image_log_likelihood
from sofjax.likelihood.batch import log_likelihood as log_likelihood
from sofjax.likelihood.batch import log_likelihood_pruned as log_likelihood_pruned
from sofjax.likelihood.measurements import Measurements as Measurements
from sofjax.likelihood.measurements import measure as measure
from sofjax.likelihood.sensor_model import LineNoise as LineNoise
from sofjax.likelihood.sensor_model import SensorModel as SensorModel
