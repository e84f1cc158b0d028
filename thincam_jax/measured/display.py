"""A linear image as it is looked at; nothing is to be computed from the result."""

from typing import Literal

import numpy as np
from jaxtyping import ArrayLike, Float, UInt8

from thincam_jax.measured.raw import MeasurementError

WhiteBalance = tuple[float | int, float | int, float | int] | Literal["grey_world"] | None


def to_display(
    image: Float[ArrayLike, "channel y x"],
    *,
    white_balance: WhiteBalance = None,
    gamma: float | int = 2.2,
    percentile: float | int = 99.9,
) -> UInt8[np.ndarray, "y x *colour"]:
    r"""8-bit grey (y, x) or RGB (y, x, 3) of a linear image with 1 or 3 channels.

    .. math:: \mathrm{round}(255\,\mathrm{clip}(g_c I_c / w, 0, 1)^{1/\gamma})

    - `white_balance`: the gains g of red, green and blue; "grey_world" makes the channels' means
      (of what is not negative) equal; None leaves them 1.
    - `percentile`: w is this percentile of all g_c I_c, so that few bright pixels do not darken the
      rest; the maximum where that is 0. Negative values are black.

    **Errors**: MeasurementError for another number of channels, values that are not finite, gains
    with an image of one channel, and numbers out of range.
    """
    linear = np.asarray(image, dtype=np.float64)
    if linear.ndim != 3 or linear.shape[0] not in (1, 3) or linear.size == 0:
        raise MeasurementError(
            f"an image of shape {linear.shape} cannot be displayed; give (1, y, x) or (3, y, x)"
        )
    if not np.isfinite(linear).all():
        raise MeasurementError(
            f"{np.count_nonzero(~np.isfinite(linear))} of {linear.size} values are NaN or "
            "infinite; display a finite image"
        )
    if not (0 < gamma < np.inf and 0 < percentile <= 100):
        raise MeasurementError(
            f"gamma = {gamma!r}, percentile = {percentile!r}: give a gamma above 0 (2.2 is usual) "
            "and a percentile above 0, up to 100"
        )
    balanced = np.maximum(linear, 0.0)
    balanced = balanced * _gains(balanced, white_balance)[:, None, None]
    white = np.percentile(balanced, percentile) or balanced.max()
    shown = np.clip(balanced / white, 0.0, 1.0) if white > 0 else balanced
    pixels = np.round(255 * shown ** (1 / gamma)).astype(np.uint8)
    return pixels[0] if pixels.shape[0] == 1 else np.moveaxis(pixels, 0, -1)


def _gains(image: np.ndarray, white_balance: WhiteBalance) -> np.ndarray:
    channels = image.shape[0]
    if white_balance is None or (channels == 1 and white_balance == "grey_world"):
        return np.ones(channels)
    if isinstance(white_balance, str):
        if white_balance != "grey_world":
            raise MeasurementError(
                f"white_balance = {white_balance!r}: give three gains, 'grey_world' or None"
            )
        means = image.mean(axis=(1, 2))
        # A black channel stays black.
        return np.divide(means.mean(), means, out=np.ones(channels), where=means > 0)
    gains = np.asarray(white_balance, dtype=np.float64)
    if gains.shape != (channels,) or not (np.isfinite(gains) & (gains > 0)).all():
        raise MeasurementError(
            f"white_balance = {white_balance!r} for {channels} channel(s): give one finite gain "
            "above 0 for each of red, green and blue"
        )
    return gains
