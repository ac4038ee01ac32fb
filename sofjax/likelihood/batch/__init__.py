"""The sensor model of N particles, M segments and K map segments at once."""

from sofjax.likelihood.batch.evaluate import image_log_likelihood as image_log_likelihood
from sofjax.likelihood.batch.evaluate import log_likelihood as log_likelihood
from sofjax.likelihood.batch.evaluate import log_likelihood_pruned as log_likelihood_pruned
