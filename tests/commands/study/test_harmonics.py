"""The shipped study of a binary plate's harmonics at a small size: the second fills the zeros."""

import pytest

from helpers import ROOT
from thincam_jax.commands.kinds import load_experiment
from thincam_jax.commands.study.build import build_study

# A quarter of the width and four times the β: the zeros and the cut-offs stay where they are.
SMALL = (
    "sensor.shape=[256, 256]",
    "sensor.electrons=64000",
    "mask.width=1.408 mm",
    "mask.harmonics=3",
    "pixel_integration=false",
    "object.width=45 mm",
    "targets=[{name: chart, kind: usaf1951, pixels: 425}]",
)


@pytest.mark.thorough
def test_even_harmonics_see_what_odd_ones_miss():
    config = load_experiment(ROOT / "configs" / "fza_harmonics.yaml", SMALL)
    chosen = []
    for method in config.methods[2:]:
        (shot,) = method.shots
        shots = (shot.model_copy(update={"beta": 100.0}),)
        chosen.append(method.model_copy(update={"shots": shots}))
    study = build_study(config.model_copy(update={"methods": tuple(chosen)}))
    found = study.run().scores.methods.values()
    quality = [of.targets["chart"].psnr_db for of in found]
    finest = [of.resolved_mm for of in found]
    assert len(study.exposures) == 8  # all methods share them
    assert quality[2] > quality[1] + 1
    assert finest[2] < 0.8 * min(finest[:2])
    zeros = [of.limits.first_zero_cycles_per_mm for of in found]
    assert abs(zeros[0] - 12.4) < 1  # 1/√(2λd), where the second harmonic is largest
    assert zeros[2] is None or zeros[2] > 2 * zeros[0]
