"""thincam_jax: simulate, reconstruct and design thin computational cameras, in JAX.

The names stand in `__init__.pyi`. Each is imported at its first use: JAX takes a second to import,
which `thincam --help` need not wait for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
