"""Records of a design study: fronts, and what is reported of shots."""

import dataclasses

import numpy as np
import pytest
from design import small

from thincam_jax.design import PhotonNoise, SignalNoise
from thincam_jax.design.fronts import FrontPoint
from thincam_jax.studies.design import Front, Fronts
from thincam_jax.studies.design_result import summarise_fronts
from thincam_jax.studies.design_scores import ShotNumbers, WithShots, reported_names


def hand_made():
    """Fronts with a point of each sort."""

    def point(cost, resolution, error=0.1, ends=""):
        return FrontPoint(cost, small.pairs((20.0, 20.0)), resolution, ends, error)

    lines = (point(2.0, 10.0), point(2.5, 12.0), point(3.0, 12.0), point(4.0, 18.75, ends="at it"))
    captures = (point(2.0, 9.0, 0.1), point(4.0, 9.0, 0.05), point(6.0, 9.0, 0.06))
    simulated = tuple({"picture": level} for level in (24.0, 23.0, None))
    reference = point(3.0, 11.0, 0.08)
    line = Front(lines, reference)
    front = Front(captures, dataclasses.replace(reference, cost=4.0))
    return Fronts({"thickness": line, "captures": front, "light": line}, 18.75, 0.04, simulated)


def fronts(noise=None):
    return summarise_fronts(hand_made(), noise or SignalNoise(30.0), 100.0)


def test_fronts():
    thickness, captures = fronts(PhotonNoise()).thickness, fronts(PhotonNoise()).captures
    assert [p.dominated for p in thickness.points] == [False, False, True, False]
    assert [p.resolution_ends for p in thickness.points] == [None] * 3 + ["at it"]
    assert thickness.points[0].resolution_line_pairs_per_mm == pytest.approx(10.0 / 100)
    points = captures.points
    assert points[0].predicted_psnr_db == pytest.approx(-10 * np.log10(0.1 * 0.04), rel=1e-6)
    assert [p.dominated for p in points] == [False, False, True]
    assert [p.simulated_dominated for p in points] == [False, True, True]
    assert points[2].simulated_mean_db is None
    assert "divided" in captures.exposure
    assert "SNR" in fronts().captures.exposure


def test_what_differs_is_reported():
    """β and distances always; the width and the wavelength where they are not all the same."""

    def design(*shots):
        return WithShots(tuple(ShotNumbers(*shot) for shot in shots))

    one = design((20.0, 3.0, 500.0, 2.0, 1.0), (20.0, 2.5, 500.0, 2.0, 1.0))
    other = design((25.0, 3.0, 620.0, 1.5, 1.0), (21.0, 3.0, 500.0, 1.5, 1.0))
    assert reported_names([one]) == ("beta", "distance")
    names = reported_names([one, other])
    assert names == ("beta", "distance", "wavelength", "width")
    assert one.cells(names) == ["20.00, 20.00", "3.00, 2.50", "500", "2.00"]
    assert other.cells(names) == ["25.00, 21.00", "3.00", "620, 500", "1.50"]
    assert other.words(names) == [
        "β 25.00 at 3.00 mm, wavelength 620 nm, mask width 1.50 mm",
        "β 21.00 at 3.00 mm, wavelength 500 nm, mask width 1.50 mm",
    ]
