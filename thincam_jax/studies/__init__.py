"""Studies in memory: exposures, simulation, evaluation and responses of whole methods."""

from thincam_jax.lensless.exposures import Exposure as Exposure
from thincam_jax.lensless.exposures import Exposures as Exposures
from thincam_jax.studies.evaluate import Evaluation as Evaluation
from thincam_jax.studies.evaluate import Resolved as Resolved
from thincam_jax.studies.evaluate import Scores as Scores
from thincam_jax.studies.evaluate import evaluate_method as evaluate_method
from thincam_jax.studies.evaluate import field_shape as field_shape
from thincam_jax.studies.evaluate import reconstructor as reconstructor
from thincam_jax.studies.response import Limits as Limits
from thincam_jax.studies.response import Response as Response
from thincam_jax.studies.response import method_response as method_response
from thincam_jax.studies.result import MethodScores as MethodScores
from thincam_jax.studies.result import StudyResult as StudyResult
from thincam_jax.studies.result import StudyScores as StudyScores
from thincam_jax.studies.result import evaluate_target as evaluate_target
from thincam_jax.studies.simulate import Capture as Capture
from thincam_jax.studies.simulate import expose as expose
from thincam_jax.studies.simulate import noise_free as noise_free
from thincam_jax.studies.simulate import stacked as stacked
from thincam_jax.studies.simulate import take as take
from thincam_jax.studies.study import Method as Method
from thincam_jax.studies.study import Published as Published
from thincam_jax.studies.study import Study as Study
from thincam_jax.studies.study import Target as Target
from thincam_jax.studies.thesis import superresolution as superresolution
