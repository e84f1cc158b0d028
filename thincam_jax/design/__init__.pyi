"""The names of `thincam_jax.design`; `__init__.py` reads them from here."""

from .cell_masks import CellMasks as CellMasks
from .cell_search import find_cells as find_cells
from .design import shots as shots
from .fronts import find_front as find_front
from .landscape import landscape_around as landscape_around
from .layout import write_gds as write_gds
from .least_error import limit as limit
from .objectives import BayesError as BayesError
from .own_sensor import for_sensor as for_sensor
from .problem import FrequencyCounts as FrequencyCounts
from .problem import design_problem as design_problem
from .recommendation import recommend as recommend
from .search import SearchSettings as SearchSettings
from .search import find_designs as find_designs
from .sensitivity import sensitivity_around as sensitivity_around
from .setup import PhotonNoise as PhotonNoise
from .setup import PowerLaw as PowerLaw
from .setup import Setup as Setup
from .setup import SignalNoise as SignalNoise
from .space import DesignSpace as DesignSpace
from .space import Variable as Variable
