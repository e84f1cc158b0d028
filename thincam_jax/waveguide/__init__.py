"""The see-through-screen camera: holograms on a glass plate, rays and ghosts (thesis chapter 5).

The names stand in `__init__.pyi`; each is imported at its first use.
"""

from thincam_jax._core.names import lazy_face

__getattr__, __dir__ = lazy_face(__name__)
