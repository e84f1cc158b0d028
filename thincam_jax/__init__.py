"""thincam_jax: simulate, reconstruct and design thin computational cameras, in JAX.

The names stand in `__init__.pyi`. Each is imported at its first use: JAX takes a second to import,
which `thincam --help` need not wait for.
"""

import lazy_loader

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str):
    if name == "__version__":
        from importlib.metadata import version

        return version("thincam_jax")
    return _attribute(name)
