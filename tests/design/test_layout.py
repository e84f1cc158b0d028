"""Layouts as another program reads them, KLayout, against the masks' own samples."""

import klayout.db
import numpy as np
import pytest

import thincam_jax as tc
from helpers import quick
from thincam_jax.lensless.masks import random_cells
from thincam_jax.units import um

CENTRE = (0.05, -0.12)
MASKS = {
    "mura": tc.ModifiedUniformlyRedundantArray(7, cell=30 * um, centre=CENTRE),
    "random": random_cells(1, 14 * 20 * um, 20 * um, height=9 * 20 * um),
    "gaps": tc.SampledMask(
        [[1.0, 0, 1], [1, 1, 0]], pitch=50 * um, fill_factor=0.64, centre=CENTRE
    ),
    "pinhole": tc.Pinhole(0.3, height=0.2, centre=CENTRE),
    "rings": tc.RadialMask([0, 1, 1, 0, 1], ring=40 * um, centre=CENTRE),
    "disc": tc.RadialMask([1.0], ring=0.15, centre=CENTRE),
    "zones": tc.FresnelZoneAperture(
        400.0, 0.7, width=0.5, height=0.4, profile="binary", harmonics=99, centre=CENTRE
    ),
}


def read(path, layer=1):
    """All polygons, joined, in nm."""
    layout = klayout.db.Layout()
    layout.read(str(path))
    (top,) = layout.top_cells()
    region = klayout.db.Region(top.begin_shapes_rec(layout.layer(layer, 0)))
    region.merge()
    assert layout.dbu == pytest.approx(1e-3) and top.name == "MASK"
    return region


def open_area(region, x, y, side):
    """Of a square about a point of the mask, mm², rows downwards: the open part."""
    nm = [round(1e6 * n) for n in (x - side / 2, -y - side / 2, x + side / 2, -y + side / 2)]
    box = klayout.db.Region(klayout.db.Box(*nm))
    return (region & box).area() * 1e-12 / side**2


COVERED = quick([name for name in MASKS if name != "zones"], 1)


@pytest.mark.parametrize("name", COVERED)
def test_another_program_reads_the_mask(name, tmp_path):
    """Coverage of every sample's square, by polygons and by the mask."""
    mask, grid = MASKS[name], tc.Grid((21, 27), 25 * um)
    region = read(tc.design.write_gds(tmp_path / "mask.gds", mask))
    found = [[open_area(region, float(x), float(y), 25 * um) for x in grid.x] for y in grid.y]
    np.testing.assert_allclose(found, np.real(mask.sample(grid)), atol=1e-3)


def test_zones_are_those_of_the_cosine(tmp_path):
    """Open where cos(βr² + φ) > 0, at points."""
    mask, rng = MASKS["zones"], np.random.default_rng(0)
    region = read(tc.design.write_gds(tmp_path / "zones.gds", mask))
    x, y = rng.uniform(-0.5, 0.5, (2, 400)) * [[0.5], [0.4]]
    phase = 400.0 * (x**2 + y**2) + 0.7
    clear = np.abs(np.cos(phase)) > 0.05  # not on an edge
    seen = [open_area(region, *p, 1e-5) > 0.5 for p in zip(x - 0.12, y + 0.05, strict=True)]
    assert clear.sum() > 300
    np.testing.assert_array_equal(np.array(seen)[clear], (np.cos(phase) > 0)[clear])


def test_tone_layer_and_name(tmp_path):
    mask = MASKS["mura"]
    shown = read(tc.design.write_gds(tmp_path / "open.gds", mask))
    hidden = read(tc.design.write_gds(tmp_path / "dark.gds", mask, tone="opaque", layer=7), 7)
    assert (shown & hidden).area() == 0
    height, width = (float(side) for side in mask.extent)
    assert (shown + hidden).area() == pytest.approx(1e12 * height * width, rel=1e-9)


def test_what_is_too_fine_is_refused_and_the_advice_holds(tmp_path):
    path, mask = tmp_path / "mask.gds", MASKS["random"]
    with pytest.raises(ValueError, match="the mask's finest part is 20 µm wide; give a coarser"):
        tc.design.write_gds(path, mask, smallest_feature=21 * um)
    assert not path.exists()
    tc.design.write_gds(path, mask, smallest_feature=0.02)
    rings = tc.design.write_gds(path, MASKS["rings"], smallest_feature=40 * um)
    assert read(rings).width_check(39_980).is_empty()  # by KLayout's own rule
    zones = MASKS["zones"]
    with pytest.raises(ValueError, match=r"the mask's finest part is 1[23](\.\d)? µm wide"):
        tc.design.write_gds(path, zones, smallest_feature=14 * um)


@pytest.mark.parametrize(
    ("mask", "error", "message"),
    [
        (tc.SampledMask([[0.5, 1.0]], pitch=0.1), ValueError, "grey or complex parts"),
        (tc.FresnelZoneAperture(25.0, width=1.6), ValueError, "'cosine' is grey; give 'binary'"),
        (
            tc.FresnelZoneAperture(25.0, width=1.6, profile="binary", pixel_pitch=0.1),
            TypeError,
            "leave out pixel_pitch",
        ),
        (
            tc.PhaseMask(np.ones((3, 4)) * um, 0.1, 1.5),
            TypeError,
            "no layout of polygons; give a binary mask",
        ),
    ],
    ids=["grey", "cosine", "display", "relief"],
)
def test_other_masks_are_refused(mask, error, message, tmp_path):
    with pytest.raises(error, match=message):
        tc.design.write_gds(tmp_path / "mask.gds", mask)
    with pytest.raises(ValueError, match="layouts are written as .gds"):
        tc.design.write_gds(tmp_path / "mask.png", MASKS["disc"])
