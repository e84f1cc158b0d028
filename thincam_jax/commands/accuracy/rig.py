"""What captures and reconstructions are compared on: one target, one method, one size."""

import dataclasses
from typing import NamedTuple

from thincam_jax.commands.accuracy.sizes import binned
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.study.build import check_study
from thincam_jax.commands.study.study import Exposure, Method, Study, Target
from thincam_jax.imaging.operators import kernel_shape
from thincam_jax.lensless.exposure import projected_shape


class Rig(NamedTuple):
    """A target in front of a study's camera with binned pixels.

    - `study`: the binned study, with the exact model.
    - `method`: the method that reconstructs; its first exposure is the one captured.
    - `target`: what is seen.
    - `skipped`: why nothing is reconstructed; None where something is.
    """

    study: Study
    method: Method
    target: Target
    skipped: str | None

    @property
    def exposures(self) -> tuple[Exposure, ...]:
        """The method's exposures."""
        return self.method.exposures

    @property
    def kernel_shape(self) -> tuple[int, int]:
        """Pixels of the PSF that the first capture takes: more than the sensor's by the scene's."""
        camera = self.study.camera(self.exposures[0])
        return kernel_shape(camera.sensor.shape, projected_shape(camera, self.target.plane))


def make_rig(study: Study, size: int) -> Rig:
    """The first picture (else the first target) and the first Wiener method (else the first).

    **Errors**: ConfigError where the size is too small to reconstruct.
    """
    study = dataclasses.replace(binned(study, size), model="separable")
    try:
        check_study(study)
    except ConfigError as error:
        raise ConfigError(f"--capture-size {size}: {str(error).splitlines()[0]}") from None
    pictures = [target for target in study.targets if target.is_picture]
    wiener = [m for m in study.methods if m.kind == "wiener"]
    method = (wiener or study.methods)[0]
    skipped = None if wiener else f"{method.name}: fringe scanning assumes no PSF"
    return Rig(study, method, (pictures or list(study.targets))[0], skipped)
