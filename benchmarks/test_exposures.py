"""Merged exposures and single ones, of the PSF and of the capture: PSNR in dB, printed as a table.

One scene behind five cameras, 90×116 pixels, 12 bit, black level 64, photon noise and 3 counts;
exposures of 1, 4 and 16 ms, the shortest up to 900 counts. `AdmmTV` with 40 iterations.
"""

import numpy as np
from measured.test_examination import CAMERAS, SHAPE, counts, plain_image, quality, scene, seen
from measured.test_merging import exposures, raws

from thincam_jax.measured import Raw
from thincam_jax.measured.examination import examine
from thincam_jax.measured.merging import merge_images

NAMES = ("spots", "sharp spots", "coarse cells", "diffuser", "zones")


def score(psf, capture):
    found = examine([capture], psf)
    return float(quality(plain_image(found.psf, found.captures[0])[0], scene()))


def test_exposures():
    for name in NAMES:
        light = CAMERAS[name](SHAPE, 1)
        view = seen(scene(), light)
        psf, capture = (Raw(counts(one, n), 12) for one, n in ((light, 1), (view, 0)))
        psfs, captures = raws(exposures(light, 900.0)), raws(exposures(view, 900.0))
        merged, found = merge_images(psfs), merge_images(captures)
        full = psfs[2].pixels[light > 0.05 * light.max()] == 4095
        best, short, long, all_ = (score(one, capture) for one in (psf, psfs[0], psfs[2], merged))
        dim, bright, every = (score(psf, one) for one in (captures[0], captures[2], found))
        numbers = (best, short, long, all_, dim, bright, every)
        cells = " | ".join(f"{number:.1f}" for number in numbers)
        print(f"| {name} | {100 * np.mean(full):.0f} % | {cells} |")
        assert min(all_, every) > max(best, short, long) - 1
