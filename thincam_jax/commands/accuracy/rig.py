"""What captures and reconstructions are compared on: one target, one method, one size."""

from typing import NamedTuple

from thincam_jax.commands.accuracy.sizes import binned
from thincam_jax.commands.study import build
from thincam_jax.commands.study.check import check_study
from thincam_jax.commands.study.config import ConfigError, MethodConfig, StudyConfig, TargetConfig
from thincam_jax.imaging.operators import kernel_shape
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.lensless.exposure import projected_shape


class Rig(NamedTuple):
    """A target in front of a study's camera with binned pixels.

    - `config`: the binned study, with the exact model.
    - `method`: the method that reconstructs; its first exposure is the one captured.
    - `target`, `plane`: what is seen; `number` is the target's place in the study.
    - `skipped`: why nothing is reconstructed; None where something is.
    """

    config: StudyConfig
    method: MethodConfig
    target: TargetConfig
    plane: ImagePlane
    number: int
    skipped: str | None

    @property
    def settings(self) -> list[build.Setting]:
        """The method's exposures."""
        return build.settings(self.config, self.method)

    @property
    def kernel_shape(self) -> tuple[int, int]:
        """Pixels of the PSF that the first capture takes: more than the sensor's by the scene's."""
        camera = build.build_camera(self.config, self.settings[0])
        return kernel_shape(camera.sensor.shape, projected_shape(camera, self.plane))


def make_rig(config: StudyConfig, size: int) -> Rig:
    """The first picture (else the first target) and the first Wiener method (else the first).

    **Errors**: ConfigError where the size is too small to reconstruct.
    """
    config = binned(config, size).model_copy(update={"model": "separable"})
    try:
        check_study(config)
    except ConfigError as error:
        raise ConfigError(f"--capture-size {size}: {str(error).splitlines()[0]}") from None
    pictures = [t for t in config.targets if t.kind in ("photograph", "file")]
    target = (pictures or list(config.targets))[0]
    wiener = [m for m in config.methods if m.kind == "wiener"]
    method = (wiener or list(config.methods))[0]
    skipped = None if wiener else f"{method.name}: fringe scanning assumes no PSF"
    number = config.targets.index(target)
    return Rig(config, method, target, build.build_plane(config, target), number, skipped)
