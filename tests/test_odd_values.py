"""Values that NumPy and Python have and JAX has not: converted, or one line that names them."""

import jax
import numpy as np
import pytest

import thincam_jax as tc
from helpers import point_psf
from thincam_jax import measured
from thincam_jax._core import checks
from thincam_jax.imaging import operators
from thincam_jax.measured.raw import CaptureFileError
from thincam_jax.units import nm, um

ZONES = tc.FresnelZoneAperture(beta=25.0, phase=0.0, width=2.0)
CAMERA = tc.LenslessCamera(ZONES, tc.Sensor((12, 16), 150 * um), distance=6.5)


def zones(beta):
    return tc.FresnelZoneAperture(beta=beta, phase=0.0, width=2.0)


def distant(object_distance):
    return point_psf(CAMERA, wavelength=500 * nm, object_distance=object_distance)


ITSELF: list = []
ITSELF.append(ITSELF)
RECORDS = np.zeros((3, 4), [("a", "f4"), ("b", "f4")]).view(np.recarray)
ODD = {
    "keys": jax.random.split(jax.random.key(0), 3),
    "key": jax.random.key(0),
    "itself": ITSELF,
    "records": RECORDS,
    "marks": "a\x1b[31m\u202eb",
    "huge": 10**400,
    "more": -(10**5000),  # of which Python makes no text
    "long complex": np.clongdouble(1 + 2j),
    "date": np.datetime64("2020-01-01"),
    "objects": np.array([1, None], object),
}
NUMBERS = {
    "mask": zones,
    "pitch": lambda value: tc.Sensor((3, 4), value),
    "distance": distant,
    "wavelength": lambda value: point_psf(CAMERA, wavelength=value, object_distance=250.0),
    "at": lambda value: point_psf(CAMERA, wavelength=500 * nm, object_distance=250.0, at=value),
    "shape": lambda value: tc.Sensor(value, 0.06),
    "tau": tc.AdmmTV,
    "snr": tc.GaussianNoise,
    "plane": lambda value: tc.ImagePlane(value, 250.0, 40.0),
    "psfs": tc.Psfs,
    "captures": lambda value: tc.Recording(value, tc.Psfs(np.ones((1, 1, 1, 7, 5)))),
    "matrix": lambda value: operators.Matrix(value, (3, 4), (2, 3)),
    "numbers": lambda value: checks.numbers("image", value),
}


@pytest.mark.parametrize("kind", ODD)
@pytest.mark.parametrize("name", NUMBERS)
def test_no_numbers_are_one_line(name, kind):
    if (name, kind) == ("matrix", "long complex"):
        pytest.skip("a matrix may be complex")
    with pytest.raises((TypeError, ValueError)) as caught:
        NUMBERS[name](ODD[kind])
    told = str(caught.value)
    assert told.isprintable() and len(told) < 400
    assert "thincam_jax" in str(caught.traceback[-1].path), told  # no other library's


WIDE = [np.dtype(">f8"), np.dtype(">f4"), np.dtype(np.longdouble), np.dtype(">i4")]


@pytest.mark.parametrize("dtype", WIDE, ids=str)
def test_numbers_of_other_orders_and_widths_are_converted(dtype):
    value = np.array(25, dtype)
    assert zones(value).beta == 25.0
    assert tc.AdmmTV(value).tau == 25.0
    if dtype.itemsize != 4:  # those promote no single precision here
        other = value.astype(dtype.newbyteorder("="))
        np.testing.assert_array_equal(distant(value), distant(other))
    image, same = np.arange(12).reshape(3, 4).astype(dtype), np.arange(12.0).reshape(3, 4)
    np.testing.assert_array_equal(tc.ImagePlane(image, 250.0, 40.0).image, same)
    np.testing.assert_array_equal(operators.Matrix(image, (2, 2), (3,)).matrix, same)
    np.testing.assert_array_equal(checks.numbers("image", image), same)


def test_marks_of_a_name_are_written_out(tmp_path):
    path = tmp_path / "a\x1b[31m\u202eb.png"
    for content in (None, b"no image"):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(CaptureFileError) as caught:
            measured.read_image(path)
        assert str(caught.value).isprintable() and "\\x1b[31m\\u202eb.png" in str(caught.value)
