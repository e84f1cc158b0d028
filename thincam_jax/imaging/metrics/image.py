"""Agreement of an image with a reference: PSNR and SSIM after a least-squares alignment.

A reconstruction is known up to a gain and an offset (exposure, background), which say nothing about
its quality; the alignment takes them out first. Eager NumPy, not differentiable.
"""

import numpy as np
import skimage
from jaxtyping import ArrayLike, Float64, Num

from thincam_jax._core.checks import numbers, positive

SSIM_WINDOW = 7  # pixels; scikit-image's uniform window
_ROUNDING = 1e-14  # relative to the data range: an error this small is rounding


def align(
    image: Num[ArrayLike, "..."], reference: Num[ArrayLike, "..."]
) -> Float64[np.ndarray, "y x *channel"]:
    """The image with the gain and offset that bring it closest to the reference (`fit_levels`)."""
    return fit_levels(image, reference)[0]


def fit_levels(
    image: Num[ArrayLike, "..."], reference: Num[ArrayLike, "..."]
) -> tuple[
    Float64[np.ndarray, "y x *channel"],
    Float64[np.ndarray, " *channel"],
    Float64[np.ndarray, " *channel"],
]:
    """(aligned, gain, offset): gain·image + offset is closest to the reference in least squares.

        gain = cov(image, reference)/var(image),   offset = mean(reference) − gain·mean(image)

    over all pixels; (y, x, c) images get one gain and offset for each channel, of shape (c,), and
    (y, x) images scalars of shape (). A constant image has gain 0 and offset mean(reference). The
    gain is negative if the image is a negative of the reference.

    Raises ValueError if the shapes differ, are not (y, x) or (y, x, c), or a value is not finite.
    """
    image, reference = _pair(image, reference)
    axes = (0, 1)
    mean, target = image.mean(axis=axes), reference.mean(axis=axes)
    centred = image - mean
    variance = np.mean(centred**2, axis=axes)
    constant = np.sqrt(variance) <= _ROUNDING * np.abs(image).max(axis=axes)
    covariance = np.mean(centred * (reference - target), axis=axes)
    gain = np.where(constant, 0.0, covariance / np.where(constant, 1.0, variance))
    return target + gain * centred, np.asarray(gain), np.asarray(target - gain * mean)


def psnr(
    image: Num[ArrayLike, "..."],
    reference: Num[ArrayLike, "..."],
    *,
    data_range: float | int = 1.0,
    aligned: bool = True,
) -> float:
    """Peak signal-to-noise ratio in dB: 10·log₁₀(data_range²/mean((image − reference)²)).

    The mean is over all pixels and channels. With `aligned`, the image goes through `align` first,
    which can only raise the result; the data range is the reference's. Images that are equal, up to
    rounding after an alignment, give infinity.

    Raises ValueError as `align` does, and for a data range that is not positive.
    """
    image, reference = _pair(image, reference)
    positive("data_range", data_range, "")
    if aligned:
        image = align(image, reference)
    error = np.mean((image - reference) ** 2)
    if np.sqrt(error) <= _ROUNDING * data_range:
        return float("inf")
    return float(10 * np.log10(data_range**2 / error))


def ssim(
    image: Num[ArrayLike, "..."],
    reference: Num[ArrayLike, "..."],
    *,
    data_range: float | int = 1.0,
    aligned: bool = True,
) -> float:
    """Mean structural similarity (Wang et al. 2004), at most 1, and 1 only for equal images.

    Over uniform windows of 7 by 7 pixels with K₁ = 0.01 and K₂ = 0.03, as scikit-image does by
    default; of a colour image, the mean over its channels. With `aligned`, the image goes through
    `align` first.

    Raises ValueError as `align` does, for a data range that is not positive, and for images smaller
    than the window.
    """
    image, reference = _pair(image, reference)
    positive("data_range", data_range, "")
    if min(image.shape[:2]) < SSIM_WINDOW:
        raise ValueError(
            f"images of shape {image.shape} are smaller than the SSIM window; give at least "
            f"{SSIM_WINDOW} by {SSIM_WINDOW} pixels"
        )
    if aligned:
        image = align(image, reference)
    similarity = skimage.metrics.structural_similarity(
        reference,
        image,
        win_size=SSIM_WINDOW,
        data_range=data_range,
        channel_axis=-1 if image.ndim == 3 else None,
    )
    return float(np.asarray(similarity))


def _pair(image, reference) -> tuple[np.ndarray, np.ndarray]:
    """Image and reference as float64 of one shape, finite."""
    image, reference = numbers("image", image), numbers("reference", reference)
    if image.shape != reference.shape:
        raise ValueError(
            f"image has shape {image.shape} and reference {reference.shape}; they must be the same"
        )
    if image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(
            f"images have shape {image.shape}; give (y, x) or (y, x, channel), not empty"
        )
    for name, array in (("image", image), ("reference", reference)):
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds NaN or infinity; give finite numbers")
    return image.astype(np.float64), reference.astype(np.float64)
