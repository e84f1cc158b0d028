"""The names of `thincam_jax.studies`; `__init__.py` reads them from here."""

from .result import evaluate_target as evaluate_target
from .study import Method as Method
from .study import Study as Study
from .study import Target as Target
from .thesis import superresolution as superresolution
