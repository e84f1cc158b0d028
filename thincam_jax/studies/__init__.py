"""Studies in memory: exposures, simulation, evaluation and responses of whole methods.

The names stand in `__init__.pyi`; each is imported at its first use.
"""

import lazy_loader

from thincam_jax._core.names import modules_of

_names, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = modules_of(__name__, _names)
