"""Whether captures fit the mirrored PSFs better: a PSF or a sensor that was upside down.

A wrong PSF explains a capture nearly as well as the right one, by an image full of artefacts; the
objective, which counts these too, is 2 to 10 times that of the right one. It is compared on pixels
four times as large.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex

from thincam_jax.reconstruction.coarse import coarser
from thincam_jax.reconstruction.problem import InverseProblem, convolutions
from thincam_jax.reconstruction.regularisers import Image

ADVICE = "turn the PSF or the captures"
_MIRRORED = {"upside down": (-2,), "mirrored left to right": (-1,), "turned by 180°": (-2, -1)}
_COARSER = 2  # times twice as large
_BETTER = 0.7  # of the objective: 0.09 to 0.41 of 14 wrong PSFs, 0.99 or more of 80 right ones
_LARGEST = 256  # pixels of the shorter side that are solved for this


def better_mirrored(
    problem: InverseProblem, image: Image, solve: Callable[[InverseProblem, Image], float]
) -> str:
    """A sentence where the captures agree far better with PSFs that are mirrored, else nothing.

    - `solve`: the lowest objective of a problem, from a start image.
    """
    if convolutions(problem) is None:
        return ""
    for _ in range(_COARSER):
        problem, image = coarser(problem, image) or (problem, image)
    if min(problem.field_shape) > _LARGEST:
        return ""
    found = {name: solve(_mirrored(problem, axes), image) for name, axes in _MIRRORED.items()}
    best = min(found, key=lambda name: found[name])
    is_better = found[best] < _BETTER * solve(problem, image)
    return f"the captures fit far better a PSF that is {best}; {ADVICE}" if is_better else ""


@eqx.filter_jit
def _mirrored(problem: InverseProblem, axes: tuple[int, ...]) -> InverseProblem:
    operators = convolutions(problem) or ()
    spectra = [_mirrored_spectrum(o.spectrum, axes) for o in operators]
    changed = [eqx.tree_at(lambda o: o.spectrum, *p) for p in zip(operators, spectra, strict=True)]
    return eqx.tree_at(lambda p: p.operators, problem, tuple(changed))


def _mirrored_spectrum(spectrum: Complex[Array, "..."], axes: tuple[int, ...]) -> jax.Array:
    """Spectrum of the mirrored kernel: for a real one mirrored along both axes the conjugate."""
    if len(axes) == 2:
        return jnp.conj(spectrum)
    turned = jnp.roll(jnp.flip(spectrum, -2), 1, -2)
    return turned if axes == (-2,) else jnp.conj(turned)
