"""What a model leaves out, in words and numbers."""

from thincam_jax._core.precision import Precision
from thincam_jax.lensless.accuracy.probe import ZoneProbe
from thincam_jax.lensless.propagation.separable import PIXEL_NODES


def optics_left_out(probe: ZoneProbe, model: str) -> list[str]:
    """Diffraction and edges that a closed form leaves out, in the steps of the ladder."""
    numbers = probe.numbers()
    zone = f"an edge zone of √(λd/M) = {numbers.edge_zone * 1e3:.3g} µm"
    if model == "geometric":
        size = probe.model_error("geometric")
        return [
            f"diffraction is left out (ε = {numbers.epsilon:.2g}, up to {numbers.first_order:.2g} "
            f"rad at the mask's edge; {zone}): {size:.1e}"
        ]
    if model == "separable":
        if not probe.pixel_integration:
            return []
        size = probe.model_error("separable")
        return [f"a pixel's average is taken at {PIXEL_NODES} points an axis: {size:.1e}"]
    edge = probe.model_error("closed_form")
    told = [f"the aperture's edge is left out ({zone}): {edge:.1e}"]
    if model == "paraxial":
        second = probe.difference("paraxial", "closed_form")
        told.insert(
            0,
            f"diffraction of second order in ε = {numbers.epsilon:.2g} is left out (up to "
            f"{numbers.second_order:.2g} rad at the mask's edge): {second:.1e}",
        )
    return told


def rounding(probe: ZoneProbe, model: str, precision: Precision) -> str:
    size, phase = probe.rounding(model, precision), probe.numbers().largest_phase
    return f"{precision} rounds phases of up to {phase:.1e} rad: {size:.1e}"


def sampling(oversampling: int, error: float) -> str:
    return (
        f"the mask is held by {oversampling}×{oversampling} samples a pixel, and the phases are "
        f"exact where 'separable' has Fresnel's: together {error:.1e}"
    )


def fresnel(paraxial_error: float) -> str:
    return (
        "errors are counted from the exact Fresnel field; exact scalar diffraction differs from "
        f"that by about {paraxial_error:.1e}"
    )
