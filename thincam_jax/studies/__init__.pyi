"""The names of `thincam_jax.studies`; `__init__.py` reads them from here."""

from .design import DesignStudy as DesignStudy
from .evaluate import field_shape as field_shape
from .mask_captures import ComparedMask as ComparedMask
from .mask_captures import Setting as Setting
from .mask_comparison import ComparedScene as ComparedScene
from .mask_comparison import MaskComparison as MaskComparison
from .mask_comparison import Tuning as Tuning
from .prepared import pixel_noise as pixel_noise
from .prepared import reconstruct_prepared as reconstruct_prepared
from .psf_error_cost import measure_accuracy as measure_accuracy
from .refocus import RefocusResult as RefocusResult
from .response import Limits as Limits
from .result import StudyResult as StudyResult
from .result import evaluate_target as evaluate_target
from .result import findings as findings
from .screen import ScreenResult as ScreenResult
from .screen import ScreenStudy as ScreenStudy
from .screen_calibration import calibrate as calibrate
from .screen_mask import ScreenMask as ScreenMask
from .simulate import take as take
from .study import Exposures as Exposures
from .study import Method as Method
from .study import Study as Study
from .study import Target as Target
from .thesis import superresolution as superresolution
