import dataclasses
import math
import time

import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import thincam_jax as tc
from helpers import read_fiducial
from thincam_jax.hardware import CameraSettings, registry
from thincam_jax.hardware.base import NotFound, OutOfRange, Region
from thincam_jax.hardware.displays.levels import PhaseLevels
from thincam_jax.hardware.virtual.devices import VirtualDevices
from thincam_jax.hardware.virtual.optics import (
    ModulatorOptics,
    MonitorOptics,
    MonitorPose,
    MosaicOptics,
    cells_seen,
    cells_shown,
    pixelated_psf,
)
from thincam_jax.hardware.virtual.rig import Electronics, VirtualRig, pattern_number
from thincam_jax.imaging.operators import Matrix, Sparse
from thincam_jax.imaging.targets import usaf1951
from thincam_jax.lensless.resolve import SamplingWarning
from thincam_jax.units import nm, um

SIDE, PITCH, BETA = 40, 36 * um, 40.0  # of the mask on the modulator
SETTINGS = CameraSettings(exposure=0.01)


def shown_mask(phase, shape=(48, 60)):
    """Levels of a Fresnel zone aperture in the middle of a display."""
    place = (np.arange(SIDE) - (SIDE - 1) / 2) * PITCH
    amplitude = (1 + np.cos(BETA * (place[:, None] ** 2 + place**2) + phase)) / 2
    levels = 255 * amplitude**2
    rows, columns = ((n - SIDE) // 2 for n in shape)
    return np.pad(np.rint(levels), ((rows, rows), (columns, columns))).astype(np.uint8)


def modulator(fill_factor=1.0):
    picture = usaf1951((128, 128)).astype(np.float32)
    scene = tc.Scene(tc.ImagePlane(picture, 250.0, 60.0), 532 * nm)
    return ModulatorOptics(scene, tc.Sensor((64, 96), 22 * um), PITCH, 6.5, 1e5, fill_factor)


@pytest.mark.thorough
@pytest.mark.parametrize("fill_factor", [1.0, 0.58])
def test_the_pixels_shown_are_the_mask_of_a_direct_simulation(fill_factor):
    """Within what 8 bits round off; a pattern of another phase is another capture."""
    optics = modulator(fill_factor)
    mask = tc.FresnelZoneAperture(
        BETA, 0.7, width=SIDE * PITCH, pixel_pitch=PITCH, fill_factor=fill_factor
    )
    camera = tc.LenslessCamera(mask, optics.sensor, 6.75)
    direct = 1e5 * np.asarray(tc.capture(camera, optics.scene))
    modulation = np.linalg.norm(direct - direct.mean())
    taken = optics(shown_mask(0.7), 0.25)
    assert np.linalg.norm(taken - direct) < 3e-3 * modulation
    assert np.linalg.norm(optics(shown_mask(0.9), 0.25) - direct) > 0.05 * modulation
    assert np.linalg.norm(optics(shown_mask(0.7), 0.0) - direct) > 0.02 * modulation


def test_light_behind_phases_and_the_gaps_between_them_by_quadrature():
    """Pixel averages of |U|² from the Fresnel integral itself, to rounding."""
    turns, sides = np.random.default_rng(0).random((3, 5)), (3, 5)
    pitch, fill, gap, wavelength, near, far = 0.036, 0.6, 0.3, 532e-6, 3.0, 40.0
    grid = tc.Grid((4, 6), 0.05)
    camera = tc.LenslessCamera(tc.Pinhole(0.1), tc.Sensor((4, 6), 0.05), near)
    given = {"pixel_pitch": pitch, "fill_factor": fill, "gap": gap}
    amplitude = np.exp(2j * np.pi * turns)
    found = np.asarray(pixelated_psf(amplitude, grid, camera.path(wavelength, far), **given))

    def pieces(count):
        """Nodes, weights and pixels of the slits and of the gaps between them, -1."""
        x, w = np.polynomial.legendre.leggauss(40)
        middle, half = (np.arange(count) - (count - 1) / 2) * pitch, pitch * math.sqrt(fill) / 2
        ends = np.sort(np.concatenate([middle - half, middle + half]))
        lower, upper = ends[:-1, None], ends[1:, None]
        pixel = np.repeat([n // 2 if n % 2 == 0 else -1 for n in range(2 * count - 1)], 40)
        nodes = (upper + lower) / 2 + (upper - lower) / 2 * x
        return nodes.ravel(), ((upper - lower) / 2 * w).ravel(), pixel

    (y, wy, v), (x, wx, u) = (pieces(count) for count in sides)
    inside = (v[:, None] >= 0) & (u >= 0)
    field = np.where(inside, amplitude[v[:, None], u], gap)
    field *= np.exp(1j * np.pi / wavelength / far * (y[:, None] ** 2 + x**2)) * wy[:, None] * wx
    nodes, weights = np.polynomial.legendre.leggauss(40)

    def waves(count, points):
        at = (((np.arange(count) - (count - 1) / 2)[:, None] + nodes / 2) * 0.05).ravel()
        return np.exp(1j * np.pi / wavelength / near * (at[:, None] - points) ** 2)

    light = np.abs(waves(4, y) @ field @ waves(6, x).T / (wavelength * near)) ** 2
    average = np.einsum("aibj,i,j->ab", light.reshape(4, 40, 6, 40), weights, weights) / 4
    magnified = 1 + near / far
    np.testing.assert_allclose(found / magnified**2, average, rtol=1e-10)


@pytest.mark.thorough
def test_the_phases_shown_are_the_mask_of_a_direct_simulation():
    """Of the lit part of the modulator alone, with the light of its gaps."""
    table = PhaseLevels((0.0, 1.0, 4.0, 5.65), 532 * nm, gap=0.5)
    lens = tc.LensletArray(focal_length=6.75, pitch=16 * PITCH)
    levels = table.levels_of(lens, PITCH, 532 * nm)
    given = {"fill_factor": 0.8, "phases": table, "aperture": levels.shape}
    optics = dataclasses.replace(modulator(), **given)
    camera = tc.LenslessCamera(table.mask(levels, PITCH, 532 * nm, 0.8), optics.sensor, 6.75)
    direct = 1e5 * np.asarray(tc.capture(camera, optics.scene))
    shown = np.pad(levels, ((16, 16), (22, 22)), constant_values=7)
    taken = optics(shown, 0.25)
    modulation = np.linalg.norm(direct - direct.mean())
    assert np.linalg.norm(taken - direct) < 1e-3 * modulation
    other = dataclasses.replace(optics, phases=dataclasses.replace(table, gap=0.0))
    assert np.linalg.norm(other(shown, 0.25) - direct) > 0.02 * modulation
    assert not optics(np.zeros_like(shown), 0.25).any()  # covered


def system(sparse=True):
    entries = scipy.sparse.random_array((20 * 30, 32), density=0.2, rng=np.random.default_rng(1))
    if sparse:
        return Sparse(entries, (4, 8), (20, 30))
    return Matrix(jnp.asarray(entries.toarray()), (4, 8), (20, 30))


@pytest.mark.parametrize("sparse", [True, False])
def test_cells_of_a_monitor_are_seen_by_the_given_operator(sparse):
    cells = np.random.default_rng(2).integers(0, 2, (4, 8))
    shown = np.pad(np.kron(cells, np.full((5, 5), 255)), ((1, 2), (3, 4))).astype(np.uint8)
    operator = system(sparse)
    assert np.array_equal(cells_shown(shown, (4, 8)), cells)
    direct = 1e4 * np.asarray(operator(jnp.asarray(cells, float)))
    assert np.allclose(MonitorOptics(operator, 1e4)(shown, 0.0), direct, rtol=1e-5)


def test_each_pixel_of_a_colour_sensor_sees_its_own_colour():
    parts = [MonitorOptics(system(), electrons) for electrons in (1e4, 2e4, 3e4)]
    optics, shown = MosaicOptics(parts, "GBRG"), np.full((4, 8), 255, np.uint8)
    red, green, blue = (part(shown, 0.0) for part in parts)
    found = optics(shown, 0.0)
    assert found.shape == optics.sensor_shape == (20, 30)
    for row, column, light in ((0, 0, green), (0, 1, blue), (1, 0, red), (1, 1, green)):
        np.testing.assert_array_equal(found[row::2, column::2], light[row::2, column::2])


def rig(**options):
    return VirtualRig(MonitorOptics(system(), 1e6), display_shape=(4, 8), **options)


def test_noise_is_that_of_the_step():
    """Of a plan, whatever was exposed before, as in a resumed run; other steps have other noise."""
    whole, resumed = rig(), rig()
    probe = whole.expose(SETTINGS)
    frames = []
    for step in range(3):
        whole.on_step(step)
        frames.append(whole.expose(SETTINGS))
    assert all(not np.array_equal(frames[step], frames[step - 1]) for step in range(3))
    assert not any(np.array_equal(probe, frame) for frame in frames)
    resumed.on_step(2)
    np.testing.assert_array_equal(resumed.expose(SETTINGS), frames[2])


def test_counts_follow_the_exposure_with_their_noise_and_saturate():
    """Dark level, shot and read noise as the electronics say; full scale where the well is full."""
    electronics = Electronics(full_well=10_000.0, read_noise=20.0, offset=100.0)
    taken = rig(electronics=electronics)
    dark = np.stack([taken.expose(SETTINGS) for _ in range(20)]).astype(float)
    of_an_electron = (2**12 - 1 - 100) / 10_000
    assert abs(dark.mean() - 100) < 0.2
    assert abs(dark.std() / (20 * of_an_electron) - 1) < 0.03
    white = np.full((4, 8), 255, np.uint8)
    taken.on_show(white)
    short = CameraSettings(exposure=0.001)
    frames = np.stack([taken.expose(short) for _ in range(100)])
    scale, offset = taken.electronics.scale(short)
    clean = scale * short.exposure * taken.optics(white, 0.0) + offset
    spread = of_an_electron * np.sqrt((clean - 100) / of_an_electron + 20**2)
    unclipped = clean < 3500
    error = (frames.mean(axis=0) - clean)[unclipped] / spread[unclipped]
    assert abs(error.std() / math.sqrt(1 / 100) - 1) < 0.1
    assert taken.expose(CameraSettings(exposure=10.0)).max() == 4095
    eight = taken.expose(CameraSettings(exposure=0.001, pixel_format="Mono8"))
    assert np.abs(eight - clean / 16).mean() < 4


def test_before_the_display_has_answered_the_pattern_before_is_seen(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    taken = rig(fiducial=True, response=0.02)
    black, white = np.zeros((4, 8), np.uint8), np.full((4, 8), 255, np.uint8)
    taken.on_show(white)
    now[0] += 0.01
    assert read_fiducial(taken.expose(SETTINGS), 12).pattern == pattern_number(black)
    now[0] += 0.02
    assert read_fiducial(taken.expose(SETTINGS), 12).pattern == pattern_number(white)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (
            CameraSettings(0.01, Region(0, 0, 21, 30)),
            "outside of the sensor; give a part of 20 × 30",
        ),
        (CameraSettings(11.0), "ExposureTime of 11 s; give 1e-05 … 10 s"),
        (CameraSettings(0.01, pixel_format="RGB8"), "RGB8; give one of Mono8, Mono10"),
        (CameraSettings(0.01, None, "BayerRG8", binning=2), "binning mixes the colours"),
        (CameraSettings(0.01, black_level=3.0), "give the offset of the virtual rig"),
        (CameraSettings(0.01, trigger="Line1"), "no trigger source Line1; give one of Software, L"),
    ],
)
def test_what_the_virtual_camera_lacks_is_refused(settings, told):
    with VirtualDevices(rig()) as devices, devices.camera("aravis") as camera:
        with pytest.raises(OutOfRange, match=told):
            camera.configure(settings)
        assert camera.trigger_and_grab(1.0).pixels.shape == (20, 30)
        camera.configure(CameraSettings(10 * 1e-6))  # 10 us of a file, a rounding below 1e-5


def test_a_mask_in_micrometres_is_said():
    made = modulator()
    with pytest.warns(SamplingWarning, match="none of it is seen; give lengths in mm"):
        dataclasses.replace(made, distance=6.5e-3)


def test_drivers_that_have_no_virtual_camera():
    with VirtualDevices(rig()) as devices, pytest.raises(NotFound, match="use aravis or pylon"):
        devices.camera("picamera2")


def without_libraries(monkeypatch):
    def not_installed(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(registry, "import_module", not_installed)


def test_without_its_library_a_plain_device_gives_the_same_frames(monkeypatch, caplog):
    """A warning names the extra that brings the protocol."""
    frames = []
    for is_missing in (False, True):
        with VirtualDevices(rig()) as devices:
            if is_missing:
                without_libraries(monkeypatch)
            camera, stage = devices.camera("pylon"), devices.stage("zaber")
            stage.home()
            assert stage.move_to(12.5) == stage.position() == pytest.approx(12.5, abs=1e-3)
            settings = dataclasses.replace(SETTINGS, region=Region(0, 4, 16, 24))
            taken = camera.configure(settings)
            camera.flush()
            devices.rig.on_step(3)
            frames.append((taken.region, camera.trigger_and_grab(1.0)))
            camera.close()
    (region, real), (also, plain) = frames
    assert region == also == Region(0, 4, 16, 24)
    np.testing.assert_array_equal(real.pixels, plain.pixels)
    assert (real.exposure, real.bit_depth) == (plain.exposure, plain.bit_depth)
    assert "pip install 'thincam-jax[hardware]'; the virtual rig goes on" in caplog.text


def test_a_monitor_is_seen_where_its_pixels_are_in_space():
    """As a pinhole casts three of them on a plane at 250 mm; turned by 180° on the sensor."""
    pose = MonitorPose(x=3.0, y=-2.0, z=5.0, rotation=0.1, turn=0.2, tilt=-0.3)
    across = np.array([math.cos(0.2), 0.0, math.sin(0.2)])  # its x axis, without rotation
    down = np.array(
        [-math.sin(0.2) * math.sin(-0.3), math.cos(-0.3), math.cos(0.2) * math.sin(-0.3)]
    )
    for x, y in ((0.0, 0.0), (40.0, -30.0), (-25.0, 10.0)):
        u = x * math.cos(0.1) - y * math.sin(0.1)
        v = x * math.sin(0.1) + y * math.cos(0.1)
        point = np.array([3.0, -2.0, 255.0]) + u * across + v * down
        found = pose.homography(250.0, 0.5, -2.0) @ [x / 0.5, y / 0.5, 1.0]
        assert np.allclose(found[:2] / found[2], -point[:2] / point[2] * 250.0 / 2.0)


def test_cells_of_a_monitor_that_stands_right_are_those_shown():
    """Two pixels a cell; then a cell further to the right."""
    shown = np.kron(np.arange(32).reshape(4, 8), np.full((2, 2), 8)).astype(np.uint8)
    inner, place = (slice(1, -1), slice(1, -1)), np.diag([0.5, 0.5, 1.0])
    found = cells_seen(shown, (4, 8), place)
    assert np.abs(found - cells_shown(shown, (4, 8)))[inner].max() < 1e-6
    moved = cells_seen(shown, (4, 8), np.array([[0.5, 0, 1], [0, 0.5, 0], [0, 0, 1]]))
    assert np.allclose(moved[1:-1, 2:-1], found[1:-1, 1:-2])
