"""Finding the best camera by gradient: objectives, spaces, searches, fronts and sensitivity."""

from thincam_jax._core.names import modules_of
from thincam_jax.design.design import shots as shots
from thincam_jax.design.fronts import find_front as find_front
from thincam_jax.design.landscape import landscape_around as landscape_around
from thincam_jax.design.layout import write_gds as write_gds
from thincam_jax.design.match import ResponseModel as ResponseModel
from thincam_jax.design.match import match_response as match_response
from thincam_jax.design.objectives import BayesError as BayesError
from thincam_jax.design.own_sensor import for_sensor as for_sensor
from thincam_jax.design.problem import FrequencyCounts as FrequencyCounts
from thincam_jax.design.problem import design_problem as design_problem
from thincam_jax.design.search import SearchSettings as SearchSettings
from thincam_jax.design.search import find_designs as find_designs
from thincam_jax.design.sensitivity import sensitivity_around as sensitivity_around
from thincam_jax.design.setup import PhotonNoise as PhotonNoise
from thincam_jax.design.setup import Polar as Polar
from thincam_jax.design.setup import PowerLaw as PowerLaw
from thincam_jax.design.setup import Setup as Setup
from thincam_jax.design.setup import SignalNoise as SignalNoise
from thincam_jax.design.space import DesignSpace as DesignSpace
from thincam_jax.design.space import Variable as Variable

__getattr__ = modules_of(__name__)
