"""From the file of a capture to what a study has: cameras, a method, and the object."""

import itertools
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp

from thincam_jax import waveguide as wg
from thincam_jax.commands.capture.config import CaptureConfig
from thincam_jax.commands.config_file import ConfigError
from thincam_jax.commands.screen.build import build_cameras, build_plane
from thincam_jax.commands.sections import PHASES, MaskConfig, SensorConfig
from thincam_jax.commands.study.build import FileStudy, build_optics, build_solver, read_targets
from thincam_jax.imaging.operators import Sparse
from thincam_jax.imaging.scene import ImagePlane
from thincam_jax.lensless.exposures import Exposures
from thincam_jax.studies.study import Method, Synthesis


def build_study(config: CaptureConfig, shape: tuple[int, int]) -> FileStudy:
    """The cameras of a lensless plan, for frames of a shape, with the one method of its file.

    **Errors**: ConfigError for a picture that cannot be read.
    """
    plan, optics, display = config.plan, config.optics, config.display
    assert optics is not None and plan.width is not None  # of lensless plans
    synthesis: Synthesis = "phase_pairs" if plan.kind == "method_b" else "fringe_scanning"
    if plan.kind == "psf_stack":
        synthesis = "separate"
    phases = PHASES.get(synthesis, (plan.phase,))
    distances = plan.distances if plan.kind == "method_a" else (optics.distance,)
    settings = list(itertools.product(distances, plan.betas))
    exposures = Exposures(
        [beta for _, beta in settings],
        [distance for distance, _ in settings],
        wavelength=optics.wavelength,
        width=plan.width,
    ).at_phases(phases)
    solver = build_solver(config.reconstruction.kind, config.reconstruction.variation)
    targets, unread = read_targets(config.targets, optics.object.distance, optics.object.width)
    if unread:
        raise ConfigError(f"{config.place_of('targets', 0)}targets[0]: {unread[0]}")
    # One light: colours are averaged.
    grey = [
        replace(t, plane=ImagePlane(t.plane.image.mean(axis=0), t.distance, t.width))
        for t in targets
    ]
    mask = MaskConfig(
        width=f"{plan.width!r} mm",  # pyright: ignore[reportArgumentType]
        profile=plan.profile,
        pixel_pitch=f"{display.pitch!r} mm",  # pyright: ignore[reportArgumentType]
        fill_factor=display.fill_factor,
    )
    pitch = f"{config.camera.pitch!r} mm"
    sensor = SensorConfig(shape=shape, pitch=pitch)  # pyright: ignore[reportArgumentType]
    return FileStudy(
        *build_optics(mask, sensor, exposures[0]),
        (Method(plan.kind, exposures, solver, synthesis, len(phases)),),
        tuple(grey),
        object_distance=optics.object.distance,
        model=optics.model,
        pixel_integration=optics.pixel_integration,
        config=optics,
    )


def field_shape(config: CaptureConfig, method: Method) -> tuple[int, int]:
    """Pixels of a reconstruction: the square that `optics.object` covers, on the sensor's scale."""
    assert config.optics is not None
    seen = config.optics.object
    side = max(1, round(seen.width * method.distance / seen.distance / config.camera.pitch))
    return side, side


def screen_system(config: CaptureConfig) -> Sparse:
    """From the cells of a virtual rig to its sensor: 1 where a white monitor is brightest."""
    assert config.virtual is not None and config.virtual.screen is not None
    seen = config.virtual.screen
    plane, (camera,) = build_plane(seen), build_cameras(seen)
    try:
        wg.check_screen(camera)
    except ValueError as error:
        raise ConfigError(
            f"{config.place_of('virtual', 'screen')}virtual.screen: {error}"
        ) from None
    system = wg.system_operator(camera, plane, seen.orders, seen.band_samples)
    assert isinstance(system, Sparse)
    brightest = float(jnp.max(system(jnp.ones(plane.shape, system.values.dtype))))
    if not brightest > 0:
        place = config.place_of("virtual", "screen")
        raise ConfigError(f"{place}virtual.screen: no light from the monitor reaches the sensor")
    return eqx.tree_at(lambda s: s.values, system, system.values / brightest)
