"""Studies in memory: exposures, simulation, evaluation and responses of whole methods.

The names stand in `__init__.pyi`; each is imported at its first use.
"""

import lazy_loader

__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)
