"""Making a plan: the cheapest computation of a scene's capture within a tolerance."""

from dataclasses import replace

import jax

from thincam_jax._core import checks
from thincam_jax._core.arguments import checked
from thincam_jax._core.grids import fast_shape
from thincam_jax._core.precision import RESULT_ROUNDING, precision_of
from thincam_jax.imaging.operators.crop_convolution import kernel_shape
from thincam_jax.imaging.scene import Scene
from thincam_jax.lensless.accuracy.select import tolerance_of
from thincam_jax.lensless.camera import LenslessCamera
from thincam_jax.lensless.method import has_few_terms
from thincam_jax.lensless.plan.choose import choose_planes, choose_psf, choose_wavelengths
from thincam_jax.lensless.plan.effects import effects_of
from thincam_jax.lensless.plan.field import choose_field, knows_field
from thincam_jax.lensless.plan.run import CapturePlan
from thincam_jax.lensless.plan.seen import FULL, SeenScene

# Parts of the tolerance that the decisions may use, in the order in which they are taken. What one
# leaves over is the next one's.
_MODEL_SHARE, _FIELD_SHARE, _WAVELENGTH_SHARE = 0.3, 0.3, 0.6


@checked
def plan_capture(
    camera: LenslessCamera, scene: Scene, *, tolerance: float, over_field: bool = True
) -> CapturePlan:
    r"""Plan the capture of a scene to a relative error at the least cost.

    The error is ‖g − g₀‖₂/‖g₀‖₂ of the noise-free capture, against every plane and wavelength
    computed by `separable` in double precision, averaged over the pixels, at every point of the
    field, or by endlessly many
    samples of `angular_spectrum` for masks without few separable terms. What is decided, from the
    PSFs' transfer functions at a few hundred frequencies, weighted with the scene's own spectrum:

    - the model, the precision and whether pixels must be averaged, or the samples a pixel;
    - whether every point of the field needs its own PSF and light (`field_operator`; not of
      lenses), or the PSF and the light of the axis suffice;
    - how many wavelengths: some of the spectrum's, with weights that reproduce its sum;
    - how many PSFs for the planes: each plane's PSF is a weighted sum of a few planes'
      (interpolative decomposition), and planes are added up with these weights *before* they are
      convolved. Planes with nearly equal PSFs merge into one.

    With `over_field` False the capture is that of the axis' PSF and light, as solvers that are
    given cameras assume it, and the error is against that; so it is for rings. Then
    `CapturePlan.effects` lists what changes over the field, with its size, and always shot noise
    and what Fresnel's approximation leaves out.

    **Errors**: ValueError for a tolerance that is not positive; TypeError for traced numbers.

    ```python
    import thincam_jax as tc
    from thincam_jax.units import nm, um

    mask = tc.FresnelZoneAperture(25.0, width=1.6)
    camera = tc.LenslessCamera(mask, tc.Sensor((24, 32), 50 * um), distance=5.0)
    planes = [tc.ImagePlane([[0.0, 1.0]], d, width=0.2 * d) for d in (200.0, 210.0)]
    plan = tc.plan_capture(camera, tc.Scene(planes, 500 * nm), tolerance=0.05)
    print(plan.predicted_error < 0.05)  # True
    ```

    **See also**: `choose_model`, `capture`.
    """
    tolerance = tolerance_of(tolerance)
    if any(checks.is_traced(leaf) for leaf in jax.tree.leaves((camera, scene))):
        raise TypeError("plan_capture needs known numbers: call it outside of jit and grad")
    seen = SeenScene(camera, scene, tolerance)
    method, model_error = choose_psf(seen, tolerance * _MODEL_SHARE)
    model_error += RESULT_ROUNDING[precision_of(camera.sensor.pitch)]
    field_error, over_field = 0.0, over_field and knows_field(seen)
    if over_field:
        method, field_error = choose_field(seen, method, tolerance * _FIELD_SHARE)
    left = max(tolerance - model_error - field_error, 0.0)
    colours, weights, colour_error = choose_wavelengths(seen, method, left * _WAVELENGTH_SHARE)
    left = max(left - colour_error, 0.0)
    planes, mixing, plane_error = choose_planes(seen, method, colours, weights, left)
    in_full = replace(FULL, nodes=method.nodes, field_tolerance=method.field_tolerance)
    full = in_full if has_few_terms(camera.mask) else method
    shares = {"model": model_error, "field": field_error}
    shares |= {"wavelengths": colour_error, "planes": plane_error}
    window = fast_shape(kernel_shape(camera.sensor.shape, seen.field_shape), real=True)
    return CapturePlan(
        camera=camera,
        tolerance=tolerance,
        predicted_error=sum(shares.values()),
        method=method,
        distances=tuple(seen.distances[p] for p in planes),
        mixing=mixing,
        wavelengths=tuple(seen.wavelengths[c] for c in colours),
        weights=tuple(float(w) for w in weights),
        scene_distances=seen.distances,
        scene_wavelengths=seen.wavelengths,
        scene_weights=tuple(float(w) for w in seen.weights),
        field_shape=seen.field_shape,
        padded_shape=window,
        cost=seen.cost(method, len(planes), len(colours)),
        full_cost=seen.cost(full, len(seen.distances), len(seen.wavelengths)),
        shares=shares,
        effects=effects_of(camera, scene, tolerance, over_field),
    )
