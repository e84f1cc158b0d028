"""Studies in memory: exposures, simulation, evaluation and responses of whole methods."""

from typing import TYPE_CHECKING

from thincam_jax.lensless.exposures import Exposure as Exposure
from thincam_jax.lensless.exposures import Exposures as Exposures
from thincam_jax.studies.evaluate import Evaluation as Evaluation
from thincam_jax.studies.evaluate import Resolved as Resolved
from thincam_jax.studies.evaluate import Scores as Scores
from thincam_jax.studies.evaluate import check_cameras as check_cameras
from thincam_jax.studies.evaluate import check_target as check_target
from thincam_jax.studies.evaluate import evaluate_method as evaluate_method
from thincam_jax.studies.evaluate import field_shape as field_shape
from thincam_jax.studies.evaluate import reconstructor as reconstructor
from thincam_jax.studies.mask_captures import ComparedMask as ComparedMask
from thincam_jax.studies.mask_captures import Setting as Setting
from thincam_jax.studies.mask_captures import Strength as Strength
from thincam_jax.studies.mask_comparison import ComparedScene as ComparedScene
from thincam_jax.studies.mask_comparison import MaskComparison as MaskComparison
from thincam_jax.studies.mask_comparison import MaskComparisonResult as MaskComparisonResult
from thincam_jax.studies.mask_comparison import Tuning as Tuning
from thincam_jax.studies.prepared import pixel_noise as pixel_noise
from thincam_jax.studies.prepared import reconstruct_prepared as reconstruct_prepared
from thincam_jax.studies.psf_error_cost import measure_accuracy as measure_accuracy
from thincam_jax.studies.response import Limits as Limits
from thincam_jax.studies.response import Response as Response
from thincam_jax.studies.response import method_response as method_response
from thincam_jax.studies.result import MethodScores as MethodScores
from thincam_jax.studies.result import StudyResult as StudyResult
from thincam_jax.studies.result import StudyScores as StudyScores
from thincam_jax.studies.result import evaluate_target as evaluate_target
from thincam_jax.studies.result import findings as findings
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

if TYPE_CHECKING:
    from thincam_jax.studies.design import DesignStudy as DesignStudy


def __getattr__(name: str):
    # Other studies need nothing of the room of designs.
    if name == "DesignStudy":
        from thincam_jax.studies.design import DesignStudy

        return DesignStudy
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted((*globals(), "DesignStudy"))
