"""Transfer functions of methods whose channels join several shots."""

import numpy as np
import pytest
from commands.study import tiny

import thincam_jax as tc
from thincam_jax.commands.study.response import method_response


@pytest.mark.parametrize(
    ("betas", "phases"), [((25, 21), ["0 deg", "270 deg"]), ((25, 23, 20), ["0 deg"])]
)
def test_contrasts_carry_all_but_the_common_part(betas, phases, tmp_path):
    """Σ|contrast|² = Σ|H|² − |ΣH|²/n, over all captures; also with one phase a shot."""
    shots = [{"beta": f"{b} rad/mm^2", "distance": "3 mm"} for b in betas]
    study = tiny.built(
        tmp_path,
        "methods.1.synthesis=contrasts",
        f"methods.1.phases={phases}",
        f"methods.1.shots={shots}",
    )
    method = study.methods[1]
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
    assert found.metrics["first_zero_cycles_per_mm"] is None
