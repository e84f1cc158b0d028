"""A lensless camera as a short sum of products of its rows and columns: FlatCam, exactly."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.checks import Number
from thincam_jax._core.grids import Grid
from thincam_jax._core.precision import product
from thincam_jax.imaging.operators import Separable
from thincam_jax.imaging.operators.crop_convolution import kernel_grid
from thincam_jax.imaging.operators.separable import Truncated, orthogonal_terms
from thincam_jax.imaging.scene import ImagePlane, Scene
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.forward import projected_shape
from thincam_jax.lensless.method import Model, PsfMethod, psf_method, with_nodes
from thincam_jax.lensless.psf import closed_terms

# Terms below this part of all are those of other terms again: rounding.
_REDUNDANT = {"float32": 1e-6, "float64": 1e-12}


@checked
def separable_operator(
    camera: LenslessCamera,
    scene: Scene,
    *,
    tolerance: Number = 1e-2,
    model: Model | PsfMethod = "separable",
    pixel_integration: bool = True,
) -> Truncated:
    r"""The operator from the image of a scene, upright, to its noise-free capture.

    A PSF that is a sum of products, :math:`h = \sum_f Y_f(y)\,X_f(x)`, as that of every mask of
    few products is with its diffraction, gives

    .. math:: G = \sum_k P_k F Q_k^T,\qquad P_k = \Delta\, T[Y_k]\, B_y,\quad
        Q_k = \Delta\, T[X_k]\, B_x

    with the Toeplitz matrices T of the factors, cropped to the sensor, and the averages B of the
    image's pixels, projected by d/t, over cells of the sensor's pitch Δ. It is what `capture` does
    for one plane. The terms of all wavelengths are brought to the fewest orthogonal ones.

    **Arguments**

    - `scene`: one plane, for the numbers of its image's pixels, its width and distance, and the
      light. The image itself plays no part.
    - `tolerance`: part of captures of white scenes that may be missed, relative Frobenius norm. The
      uniform light is part of them: `operator.centred().truncated(…)` counts what is left without.
      Inside jit and grad, where their number cannot follow from it, all terms are kept.
    - `model`, `pixel_integration`: settings of the PSF, see `thincam_jax.psf`: one with separable
      terms.

    **Returns** the operator, its error, and the errors of fewer terms.

    **Errors**: TypeError for a mask without separable terms; ValueError for several planes.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    code = tc.lensless.masks.maximum_length_sequence(15)
    mask = tc.SeparableMask(code, code, cell=60 * um)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=2.0)
    scene = tc.Scene(tc.ImagePlane([[0.0, 1.0, 0.5]], distance=250.0, width=40.0), 500 * nm)
    found = tc.separable_operator(camera, scene)
    print(found.operator.terms)  # 1
    ```

    **See also**: `measured.calibration.calibrate_separable`, `measured.calibration.fit_separable`.
    """
    if len(scene.planes) != 1:
        raise ValueError(
            f"the scene has {len(scene.planes)} planes; give one, an operator for each"
        )
    (plane,) = scene.planes
    field = projected_shape(camera, plane)
    grid = camera.sensor.grid
    kernel = kernel_grid(grid, field)
    method = psf_method(camera.mask, kernel, model, pixel_integration)
    rows, columns = _factors(camera, scene, kernel, method)
    down, across = _weights(camera, plane, field)
    left, right = (
        grid.pitch * product(_toeplitz(factors, size), weights.astype(factors.dtype))
        for factors, size, weights in ((rows, field[0], down), (columns, field[1], across))
    )
    operator = Separable(left, right)
    if checks.is_traced(left):
        none = jnp.zeros((), left.dtype)
        return Truncated(operator, none, none[None])
    return operator.truncated(tolerance)


def _factors(camera, scene: Scene, grid: Grid, method: PsfMethod):
    """Σ_f Y_f X_f = h, the weighted sum over the light."""
    (plane,), light = scene.planes, scene.spectrum
    rows, columns = [], []
    for wavelength, weight in light.colours:
        path = camera.path(wavelength, plane.distance)
        own = with_nodes(method, camera.mask, grid, path)
        terms = closed_terms(camera.mask, grid, path, own)
        y, x = terms.real_factors()
        rows.append(weight.astype(y.dtype) * y)
        columns.append(x)
    down, across = jnp.concatenate(rows), jnp.concatenate(columns)
    if checks.is_traced(down) or checks.is_traced(across):
        return down, across
    down, across, errors = orthogonal_terms(down, across)
    count = 1 + int(np.sum(np.asarray(errors) > _REDUNDANT[str(down.dtype)]))
    return down[:count], across[:count]


@jax.jit(static_argnames="shape")
def _weights(camera: LenslessCamera, plane: ImagePlane, shape: tuple[int, int]):
    """Contributions of the projected pixels of an image to `shape` samples, per axis."""
    grid = Grid(shape, camera.sensor.pitch)
    return plane.weights(grid, magnification=-camera.distance / plane.distance)


@jax.jit(static_argnames="size")
def _toeplitz(factors: Float[Array, "k l"], size: int) -> Float[Array, "k y m"]:
    """T_ym = factor(y − m) of `size` samples of the field."""
    pixels = jnp.arange(factors.shape[1] - size + 1)
    return factors[:, pixels[:, None] - jnp.arange(size) + size - 1]
