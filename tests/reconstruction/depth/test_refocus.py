"""Sweeps: the images of `reconstruct`, one grid of directions, nothing compiled twice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reconstruction.depth import rig

import thincam_jax as tc
from thincam_jax.reconstruction import fringe_scanning
from thincam_jax.reconstruction.depth import RefocusSweep, refocus_sweep

DISTANCES = (18.0, 20.0, 24.0, 45.0)


@pytest.fixture(scope="module")
def scene():
    cams = rig.cameras()
    planes = [
        rig.plane(rig.checks((slice(10, 34), slice(4, 22))), 20.0),
        rig.plane(rig.checks((slice(10, 34), slice(34, 52))), 45.0),
    ]
    return cams, rig.captures(cams, planes)


WIENER = {
    "wavelength": rig.WAVELENGTH,
    "noise_variance": 1e-4,
    "synthesis": fringe_scanning(1),
    "pixel_integration": False,
}
SETTINGS = {
    "fringe_scanning": {},
    "wiener": WIENER,
    "admm_tv": WIENER | {"iterations": 10, "tau": 1.0},
}


@pytest.mark.parametrize("method", SETTINGS)
def test_images_are_those_of_reconstruct(scene, method):
    cams, seen = scene
    settings = SETTINGS[method] | {"field_shape": rig.FIELD}
    done = []
    sweep = refocus_sweep(
        seen, cams, DISTANCES[:3], method=method, callback=done.append, **settings
    )
    assert done == [1, 2, 3]
    assert sweep.method == method
    for image, t in zip(sweep.images, DISTANCES[:3], strict=True):
        alone = tc.reconstruct(seen, cams, method=method, object_distance=t, **settings)
        np.testing.assert_allclose(image, alone.image, rtol=1e-9, atol=1e-9)
    assert not np.allclose(sweep.images[0], sweep.images[2], atol=1e-3)
    assert float(sweep.slope) == pytest.approx(rig.PITCH / rig.DISTANCE)
    np.testing.assert_allclose(sweep.pitch, np.array(DISTANCES[:3]) * rig.PITCH / rig.DISTANCE)


def test_a_direction_stays_where_it_is(scene):
    """Both boxes, at 20 and 45 mm, cover the same pixels whatever the focus."""
    cams, seen = scene
    sweep = refocus_sweep(seen, cams, DISTANCES, method="fringe_scanning", field_shape=rig.FIELD)
    for image in np.asarray(sweep.images):
        for columns in (slice(0, 28), slice(28, 56)):
            light = np.maximum(image[:, columns] - 0.25 * image.max(), 0)
            rows, across = light.sum(1), light.sum(0)
            middle = rows @ np.arange(48) / rows.sum(), across @ np.arange(28) / across.sum()
            wanted = (21.5, 12.5 if columns.start == 0 else 14.5)
            np.testing.assert_allclose(middle, wanted, atol=0.8)


@pytest.mark.parametrize("method", SETTINGS)
def test_further_distances_compile_nothing(scene, method):
    cams, seen = scene
    settings = SETTINGS[method] | {"method": method, "field_shape": rig.FIELD}
    refocus_sweep(seen, cams, DISTANCES[:3], **settings)
    compiled = []

    def listen(event, seconds, **_):
        if "backend_compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    jax.jit(lambda x: jnp.sin(x) * 1.2345)(jnp.arange(3.0))  # the listener hears
    assert len(compiled) >= 1
    compiled.clear()
    refocus_sweep(seen, cams, (17.5, 31.0, 77.0), **settings)
    assert compiled == []


def test_auto_chooses_once(scene):
    cams, seen = scene
    sweep = refocus_sweep(seen, cams, DISTANCES[:3], method="auto", field_shape=rig.FIELD, **WIENER)
    assert sweep.method in ("wiener", "admm_tv", "fringe_scanning")
    assert isinstance(sweep, RefocusSweep)


@pytest.mark.parametrize(
    "distances", [(20.0, 30.0), (30.0, 20.0, 10.0), (0.0, 1.0, 2.0), (1.0, 2.0, np.inf), 20.0]
)
def test_bad_distances_are_refused(scene, distances):
    cams, seen = scene
    with pytest.raises(ValueError, match="distances"):
        refocus_sweep(seen, cams, distances, method="fringe_scanning")
