"""Many hypotheses at once: the paper's formulas for N particles, M segments and K map segments."""

from sofjax.batch.likelihood import image_log_likelihood as image_log_likelihood
from sofjax.batch.likelihood import log_likelihood as log_likelihood
from sofjax.batch.likelihood import log_likelihood_pruned as log_likelihood_pruned
from sofjax.batch.views import association_scores as association_scores
from sofjax.batch.views import homographies as homographies
from sofjax.batch.views import transferred_lines as transferred_lines
