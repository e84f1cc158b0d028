"""Transfer functions of methods whose channels join several shots."""

import numpy as np
import pytest
from studies import tiny

import thincam_jax as tc
from thincam_jax.studies import Method
from thincam_jax.studies.result import method_response


@pytest.mark.parametrize(
    ("betas", "phases"), [((25, 21), (0.0, 3 * np.pi / 2)), ((25, 23, 20), (0.0,))]
)
def test_contrasts_carry_all_but_the_common_part(betas, phases):
    """Σ|contrast|² = Σ|H|² − |ΣH|²/n, over all captures; also with one phase a shot."""
    exposures = tc.Exposures(betas, 3.0, **tiny.LIGHT).at_phases(phases)
    method = Method("one", exposures, tc.Wiener(), "contrasts", len(phases))
    study = tiny.study(methods=(method,))
    found = method_response(study, method)
    count = len(betas) * len(phases)
    each = [
        tc.otf(
            study.camera(exposure),
            wavelength=exposure.wavelength,
            object_distance=100.0,
            model="geometric",
            pixel_integration=False,
        )[24, 32:]
        for exposure in method.exposures
    ]
    assert len(each) == count
    profiles = np.stack(each)
    expected = (np.abs(profiles) ** 2).sum(0) - np.abs(profiles.sum(0)) ** 2 / count
    np.testing.assert_allclose(found.magnitude**2, expected, atol=1e-9 * expected.max())
    assert found.limits.first_zero_cycles_per_mm is None
