r"""A reconstruction trained for one camera: a physics step, then a small U-Net.

The physics step inverts the camera's model; the network removes what that leaves where the model is
wrong and the capture noisy (Khan et al., FlatNet, IEEE Trans. Pattern Anal. 44, 1934, 2022;
Monakhova et al., Opt. Express 27, 28075, 2019; Zeng and Lam, MWDN, IEEE Trans. Comput. Imaging 7,
1156, 2021). It is some iterations of `AdmmTV`, `PlugAndPlay`, or both, which know of the crop, the
background and the noise, and the Wiener filter of what their image f leaves of the capture g,

.. math:: f_W = f + F^{-1}\Big[\frac{\bar H}{|H|^2 + \lambda\,\overline{|H|^2}/S}\,
    F (g - A f - b)\Big]

for a scene of the power spectrum S, ∝ 1/(1 + u²), which gives back the detail that they took for
noise. Its relative noise λ is learned for each colour. The network sees all these images and
adds what is missing to f, that of plug and play where there are two.
"""

import dataclasses
import hashlib
import os
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thincam_jax._core.arguments import checked
from thincam_jax._core.grids import block_mean, central_blocks
from thincam_jax._core.precision import AccuracyWarning, as_complex, squared_modulus
from thincam_jax._core.quantity import FieldError, check_fields, choice, whole
from thincam_jax._core.random import Key, random_key
from thincam_jax._core.text import of_error
from thincam_jax.imaging.operators import CropConvolution
from thincam_jax.imaging.operators.crop_convolution import centred_crop, cut, place
from thincam_jax.learn.checkpoint import (
    CheckpointError,
    network_description,
    read_weights,
    write_arrays,
)
from thincam_jax.learn.plug_and_play import PlugAndPlay
from thincam_jax.learn.unet import UNet
from thincam_jax.reconstruction.imaging_model import Psfs
from thincam_jax.reconstruction.outside_light import pinned
from thincam_jax.reconstruction.problem import InverseProblem, convolutions, or_one, residuals
from thincam_jax.reconstruction.recording import Recording
from thincam_jax.reconstruction.regularised import AdmmTV
from thincam_jax.reconstruction.regularisers import Image
from thincam_jax.reconstruction.result import Reconstruction
from thincam_jax.reconstruction.solver import AbstractSolver
from thincam_jax.reconstruction.wiener import prior_spectrum

_KIND = "trained reconstruction"
SHIPPED = "diffusercam"  # camera whose network comes with the package
_SHIPPED_FILE = Path(__file__).with_name(f"{SHIPPED}.thincam")
_LARGE = 64  # pixels of the longer side of a camera's portrait
_SHIFTED = 8  # part of its sides by which another one may be shifted
# Correlation of the PSF with that of the training, below which it is another camera's, and below
# which it may be. One that is 2 % too large or blurred by a pixel keeps more.
_ANOTHER, _DOUBTED = 0.6, 0.9
_IMAGES = {"admm_tv": 2, "pnp": 2, "both": 3}  # that the network sees
_WHITE = 99.5  # percentile of an image that is 1 for the network


@checked
@dataclass(frozen=True)
class TrainedOptions:
    """Size of the physics step and of the network.

    - `method`: "admm_tv"; "pnp", `PlugAndPlay` as it is, which is six times as slow; or "both",
      which are wrong in different places.
    - `iterations`: iterations of `AdmmTV`, at most; 40 are twice as fast and 0.8 dB worse.
    - `widths`: channels of the levels of the `UNet`, from the finest.
    - `colours`: colours that the network sees together: 1 or as many as the captures have.

    **Errors**: ValueError for numbers out of range.
    """

    iterations: Annotated[int, whole(1, 1000)] = 100
    widths: Annotated[tuple[int, ...], whole(1, 512, many=True)] = (32, 48, 64, 96)
    colours: Annotated[int, whole(1, 16)] = 1
    method: Annotated[str, choice(tuple(_IMAGES))] = "admm_tv"

    def __post_init__(self):
        check_fields(self)
        if not 0 < len(self.widths) <= 8:
            raise FieldError(f"widths = {self.widths}: give 1 to 8 levels", "widths")


class PhysicsStep(eqx.Module):
    """`AdmmTV`, `PlugAndPlay` or both, and the Wiener filter of what the last one leaves.

    See the module's equation.

    - `noise`: ln λ of each colour, or one for all.
    """

    noise: Float[Array, " colour"]
    iterations: int = eqx.field(static=True)
    method: str = eqx.field(static=True, default="admm_tv")

    def __call__(self, recording: Recording) -> tuple[InverseProblem, tuple[Image, ...]]:
        """The problem of the whole field that sends light to the sensor, and its images."""
        whole_field = with_whole_field(recording)
        problem, solvers = whole_field.problem(), []
        if self.method != "pnp":
            solvers.append(AdmmTV(iterations=self.iterations))
        if self.method != "admm_tv":
            solvers.append(PlugAndPlay())
        found = (solver.solve(pinned(whole_field)).image for solver in solvers)
        return problem, tuple(jnp.asarray(one).reshape(problem.image_shape) for one in found)


def with_whole_field(recording: Recording) -> Recording:
    """The recording whose image is not only the part in front of the sensor."""
    model, captures = recording.imaging_model, recording.captures
    if not isinstance(model, Psfs) or model.count > 1 or model.psfs.shape[2] > 1:
        raise ValueError(
            "a trained reconstruction takes one capture by a measured PSF; give a recording with "
            "tc.Psfs of one PSF"
        )
    sizes = zip(captures[0].shape[-2:], model.psfs.shape[-2:], strict=True)
    rows, columns = (n + k - 1 for n, k in sizes)
    model = Psfs(model.psfs, field_shape=(rows, columns))
    return eqx.tree_at(lambda one: one.imaging_model, recording, model)


def operator_of(problem: InverseProblem) -> CropConvolution:
    """The convolution of the only capture."""
    operators = convolutions(problem)
    assert operators is not None  # of measured PSFs
    return operators[0]


def refined(
    problem: InverseProblem, image: Image, noise: Float[Array, " colour"]
) -> Float[Array, "*batch channel y x"]:
    """The image with the Wiener filter of its residual."""
    operator = operator_of(problem)
    (missing,), (weight,) = residuals(problem, image), problem.weights
    spectrum = operator.spectrum[..., 0, :, :]
    power = squared_modulus(spectrum)
    scene = prior_spectrum("inverse_square", operator.window, operator.field_shape, power.dtype)
    mean = jnp.mean(power, axis=(-2, -1), keepdims=True)
    level = jnp.exp(noise.astype(power.dtype))[:, None, None] * mean / scene
    left = place(jnp.where(weight > 0, -missing, 0), operator.sensor_corner, operator.window)
    spectra = jnp.fft.rfft2(left) * spectrum.conj() / as_complex(power + level)
    found = jnp.fft.irfft2(spectra, s=operator.window)
    return image[..., 0, :, :] + cut(found, operator.field_corner, operator.field_shape)


@eqx.filter_jit
def prepared(
    physics: PhysicsStep, problem: InverseProblem, images: tuple[Image, ...]
) -> tuple[Float[Array, "input *batch channel v u"], Float[Array, "*batch 1 1 1"]]:
    """All images in front of the sensor, in their unit, the network's white; and that unit."""
    sensor, filtered = _seen(problem), refined(problem, images[-1], physics.noise)
    seen = filtered, *(image[..., 0, :, :] for image in images)
    inside = jnp.stack([centred_crop(one, sensor) for one in seen])
    flat = jax.lax.stop_gradient(inside[-1]).reshape(*inside.shape[1:-3], -1)
    unit = or_one(jnp.maximum(jnp.percentile(flat, _WHITE, axis=-1), 0))[..., None, None, None]
    return inside / unit, unit


def _seen(problem: InverseProblem) -> tuple[int, int]:
    """Rows and columns of the field in front of the sensor."""
    sides = zip(problem.captures[0].shape[-2:], problem.field_shape, strict=True)
    rows, columns = (min(n, f) for n, f in sides)
    return rows, columns


def cleaned(
    network: UNet, colours: int, images: Float[Array, "input *batch channel y x"]
) -> Float[Array, "*batch channel y x"]:
    """The last of the input images, with what the network adds; in their unit."""
    count, *batch, channel, rows, columns = images.shape
    flat = images.reshape(count, -1, colours, rows, columns)
    flat = jnp.moveaxis(flat, 0, 1).reshape(-1, count * colours, rows, columns)
    added = jax.vmap(network)(flat).reshape(*batch, channel, rows, columns)
    return images[-1] + added


def completed(
    physics: PhysicsStep, network: UNet, problem: InverseProblem, images: tuple[Image, ...]
) -> Float[Array, "*batch channel y x"]:
    """The last image of the whole field, cleaned in front of the sensor; differentiable."""
    inputs, unit = prepared(physics, problem, images)
    colours, image = network.leave.weight.shape[0] // 4, images[-1]
    inside = jnp.maximum(cleaned(network, colours, inputs), 0) * unit
    sizes = zip(image.shape[-2:], inside.shape[-2:], strict=True)
    corner = (*(0,) * (inside.ndim - 2), *((f - n) // 2 for f, n in sizes))
    return jax.lax.dynamic_update_slice(image[..., 0, :, :], inside, corner)


class CameraPortrait(eqx.Module):
    """Camera of a training, known again by its PSF.

    - `digest`: SHA-256 of the PSF's numbers; `psf_shape`: its rows and columns.
    - `image`: the PSF in coarse blocks, with a mean of 0 and a norm of 1.
    """

    digest: str = eqx.field(static=True)
    psf_shape: tuple[int, int] = eqx.field(static=True)
    image: Float[Array, "v u"]

    @classmethod
    def of(cls, psf: Float[np.ndarray, "*colour k l"]) -> "CameraPortrait":
        """Portrait of a measured or computed PSF; colours are added up."""
        numbers = np.asarray(psf, np.float32)
        total = numbers.reshape(-1, *numbers.shape[-2:]).sum(axis=0)
        size = max(1, -(-max(total.shape) // _LARGE))
        coarse = block_mean(total[central_blocks(total.shape, size)], size)
        coarse = coarse - coarse.mean()
        coarse = coarse / max(float(np.linalg.norm(coarse)), 1e-30)
        digest = hashlib.sha256(np.ascontiguousarray(total).tobytes()).hexdigest()
        rows, columns = total.shape
        return cls(digest, (rows, columns), jnp.asarray(coarse, jnp.float32))

    def fit(self, psf: Float[np.ndarray, "*colour k l"]) -> float:
        """Largest correlation with a PSF, at small shifts; 1 for the same one, 0 for other pixels.

        Shifts by more than an eighth of the PSF are other cameras, as far as is known.
        """
        other = CameraPortrait.of(psf)
        if other.digest == self.digest:
            return 1.0
        if other.psf_shape != self.psf_shape:
            return 0.0
        own, given = np.asarray(self.image), np.asarray(other.image)
        size = tuple(2 * n for n in own.shape)
        spectra = np.fft.rfft2(own, size).conj() * np.fft.rfft2(given, size)
        found = np.fft.fftshift(np.fft.irfft2(spectra, size))
        (y, x), (v, u) = own.shape, (max(1, n // _SHIFTED) for n in own.shape)
        return float(found[y - v : y + v + 1, x - u : x + u + 1].max())


class TrainedReconstruction(AbstractSolver):
    """A reconstruction that `thincam train` trained for one camera.

    What it has not learned may be lost, and what looks like a photograph's detail be made up: it
    has no measure of trust of its own. It takes one capture through one PSF, of any number of
    pixels; beyond the part in front of the sensor the image is that of the physics step.

    - `physics`, `network`: see `PhysicsStep` and `cleaned`.
    - `camera`: the camera that it was trained for; None: any.

    **Errors**: ValueError, one line, for the recording of another camera, of several captures or
    planes, and of a number of colours that the network does not take.

    ```python
    import numpy as np
    import thincam_jax as tc
    from thincam_jax.learn.trained import TrainedOptions, TrainedReconstruction

    psf = np.random.default_rng(0).random((1, 9, 9))
    recording = tc.Recording(np.ones((1, 24, 32)), tc.Psfs(psf), noise_variance=0.01)
    untrained = TrainedReconstruction.create(TrainedOptions(iterations=2), psf, key=0)
    result = tc.reconstruct(recording, untrained)
    ```

    **See also**: `reconstruct`, `AdmmTV`, `PlugAndPlay`.
    """

    name: ClassVar[str] = "trained"
    physics: PhysicsStep
    network: UNet
    camera: CameraPortrait | None = None

    @classmethod
    def create(
        cls, options: TrainedOptions, psf: Float[np.ndarray, "*colour k l"], *, key: Key
    ) -> "TrainedReconstruction":
        """An untrained one for the camera of a PSF, whose network adds nothing."""
        colours = psf.shape[0] if psf.ndim > 2 else 1
        noise, together = jnp.full(colours, np.log(0.1), jnp.float32), options.colours
        network = UNet(
            _IMAGES[options.method] * together, together, options.widths, key=random_key(key)
        )
        physics = PhysicsStep(noise, options.iterations, options.method)
        return cls(physics, network, CameraPortrait.of(psf))

    @property
    def options(self) -> TrainedOptions:
        """The sizes that it was made of."""
        network = self.network
        widths = tuple(one.first.weight.shape[0] for one in network.before)
        colours = network.leave.weight.shape[0] // 4
        return TrainedOptions(self.physics.iterations, widths, colours, self.physics.method)

    def solve(self, recording: Recording) -> Reconstruction:
        began, doubt = time.perf_counter(), self._checked(recording)
        problem, images = self.physics(recording)
        image = jax.block_until_ready(_completed(self.physics, self.network, problem, images))
        field = getattr(recording.imaging_model, "field_shape", None)
        if field is not None:
            sides = zip(field, image.shape[-2:], strict=True)
            image = centred_crop(image, [min(pair) for pair in sides])
        image, seconds = recording.shaped(image[..., None, :, :]), time.perf_counter() - began
        return Reconstruction(image, None, self.name, reason=doubt, seconds=seconds)

    def check_camera(self, psf: Float[np.ndarray, "*colour k l"]) -> str:
        """A sentence where a PSF may be another camera's than that of the training, else nothing.

        **Errors**: ValueError, one line, where it is.
        """
        camera = self.camera
        if camera is None:
            return ""
        if psf.shape[-2:] != camera.psf_shape:
            (k, n), (rows, columns) = psf.shape[-2:], camera.psf_shape
            raise ValueError(
                f"the PSF has {k}×{n} pixels, and that of the training {rows}×{columns}; give "
                "captures and PSF with the pixels of the training (downsample)"
            )
        fit = camera.fit(psf)
        words = f"the PSF correlates by {fit:.2f} with that of the training"
        if fit < _ANOTHER:
            raise ValueError(f"{words}: it is another camera; train for this one, or use AdmmTV")
        return f"{words}; train anew if the camera was changed" if fit < _DOUBTED else ""

    def _checked(self, recording: Recording) -> str:
        """A sentence where the PSF may be another's; ValueError for what cannot be used."""
        model = with_whole_field(recording).imaging_model
        assert isinstance(model, Psfs)
        shape, colours, noise = (
            recording.captures[0].shape,
            self.options.colours,
            self.physics.noise,
        )
        channels = shape[-3] if len(shape) > 2 else 1
        if channels % colours or len(noise) not in (1, channels):
            raise ValueError(
                f"the capture has {channels} colours, and the reconstruction was trained for "
                f"{len(noise)}; give as many"
            )
        doubt = self.check_camera(np.asarray(model.psfs[0, :, 0]))
        if doubt:
            warnings.warn(doubt, AccuracyWarning, stacklevel=4)
        return doubt

    def save(self, path: str | os.PathLike[str], training: dict[str, Any] | None = None) -> Path:
        """Write the numbers, their sizes, the camera, and a record of the training: JSON."""
        camera = None
        if self.camera is not None:
            shapes = {"psf_shape": self.camera.psf_shape, "portrait": self.camera.image.shape}
            camera = {"digest": self.camera.digest, **shapes}
        options = {**dataclasses.asdict(self.options), "noises": len(self.physics.noise)}
        known = {"options": options, "camera": camera or {}, "training": training or {}}
        return write_arrays(path, self, {"kind": _KIND, **known})

    @staticmethod
    @checked
    def load(path: str | os.PathLike[str]) -> "TrainedReconstruction":
        """Read what `thincam train` wrote.

        `path` may be "diffusercam", the one for the camera of DiffuserCam's tutorial, of captures
        and a PSF prepared with `downsample=8`.

        **Errors**: CheckpointError, one line, for a damaged file, one of another kind, and numbers
        that are not finite; OSError for what cannot be read.
        """
        path = _file_of(path)
        description = network_description(path, _KIND)
        try:
            like = _like(description["options"], description["camera"])
        except Exception as error:  # whatever another's options bring about
            cause = f"{path}: options of another version ({of_error(error)})"
            raise CheckpointError(cause) from None
        return read_weights(path, like)


_completed = eqx.filter_jit(completed)


def _like(options: dict[str, Any], camera: dict[str, Any]) -> TrainedReconstruction:
    """The shapes of a file's arrays."""
    count = int(options["noises"])
    names = ("iterations", "colours", "method")  # files of versions before have no method
    sizes = {name: options[name] for name in names if name in options}
    made = TrainedOptions(**sizes, widths=tuple(options["widths"]))
    network = eqx.filter_eval_shape(
        lambda key: UNet(_IMAGES[made.method] * made.colours, made.colours, made.widths, key=key),
        jax.random.key(0),
    )
    portrait = None
    if camera:
        (rows, columns), shape = camera["psf_shape"], tuple(camera["portrait"])
        portrait = CameraPortrait(camera["digest"], (rows, columns), jnp.zeros(shape))
    physics = PhysicsStep(jnp.zeros(count), made.iterations, made.method)
    like = TrainedReconstruction(physics, network, portrait)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, jnp.float32), like)


def training_record(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Record of a file's training: its data with their licences, its faults, its scores.

    `path` may be "diffusercam".

    **Errors**: as of `TrainedReconstruction.load`.
    """
    return network_description(_file_of(path), _KIND)["training"]


def _file_of(path: str | os.PathLike[str]) -> str | os.PathLike[str]:
    return _SHIPPED_FILE if str(path) == SHIPPED else path
