"""Joint reconstruction of several planes from one set of captures."""

import numpy as np
import pytest
import scipy.ndimage as ndimage
from reconstruction.depth import rig

import thincam_jax as tc
from thincam_jax.reconstruction import TotalVariation, fringe_scanning

PLANES = (20.0, 45.0, 150.0)


@pytest.fixture(scope="module")
def seen():
    cams = rig.cameras()
    planes = [rig.plane(i, t) for i, t in zip(rig.shapes(), PLANES, strict=True)]
    return cams, rig.captures(cams, planes, snr_db=30.0)


def reconstruct(seen, planes=PLANES, **settings):
    cams, captures = seen
    recording = tc.Recording(captures, rig.imaging_model(cams, object_distance=list(planes)))
    return tc.reconstruct(recording, tc.AdmmTV(1.0, synthesis=fringe_scanning(1), **settings))


def shares(image, power):
    """Σ f^power of each object in its own plane, over that in all planes at its directions."""
    found = []
    for own, shape in enumerate(rig.shapes()):
        around = ndimage.binary_dilation(shape > 0, iterations=3)
        light = (np.maximum(image, 0) ** power)[:, around].sum(axis=1)
        found.append(light[own] / light.sum())
    return np.array(found)


@pytest.mark.thorough
def test_each_object_is_in_its_own_plane(seen):
    """Four phases, 30 dB, f ≥ 0 on black: over 90 % of the light, over 99 % of the energy."""
    result = reconstruct(seen, iterations=150)
    image = np.asarray(result.image)
    assert image.shape == (3, *rig.FIELD)
    assert shares(image, 1).min() > 0.9
    assert shares(image, 2).min() > 0.99
    # Nothing to speak of lies beside the objects, and the objects are the right ones.
    around = ndimage.binary_dilation(rig.shapes().max(axis=0) > 0, iterations=3)
    assert image[:, ~around].sum() < 0.05 * image.sum()
    errors = np.linalg.norm(image - rig.shapes(), axis=(1, 2))
    assert (errors < 0.4 * np.linalg.norm(rig.shapes(), axis=(1, 2))).all()
    np.testing.assert_allclose(
        result.pitch, np.array(PLANES) * rig.PITCH / rig.DISTANCE, rtol=1e-12
    )


@pytest.mark.thorough
def test_a_depth_weight_pulls_the_planes_together(seen):
    """Variation across planes suits what reaches through them, and not objects that do not."""
    weighted = reconstruct(seen, iterations=60, variation=TotalVariation(depth_weight=0.5))
    plain = reconstruct(seen, iterations=60)
    assert (shares(np.asarray(weighted.image), 1) < shares(np.asarray(plain.image), 1)).all()
