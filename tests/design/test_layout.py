"""Layouts and reliefs as other programs read them."""

import json

import jax
import klayout.db
import numpy as np
import PIL.Image
import pytest

import thincam_jax as tc
from helpers import quick
from thincam_jax._core.files import MeasurementError
from thincam_jax.design.grey_files import write_density_map
from thincam_jax.design.relief_files import read_height_map, write_height_map, write_stl
from thincam_jax.imaging.refractive_index import CauchyIndex, bk7
from thincam_jax.lensless.masks import random_cells
from thincam_jax.units import nm, um

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
    ids=["grey", "display", "relief"],
)
def test_other_masks_are_refused(mask, error, message, tmp_path):
    with pytest.raises(error, match=message):
        tc.design.write_gds(tmp_path / "mask.gds", mask)
    with pytest.raises(ValueError, match="layouts are written as .gds"):
        tc.design.write_gds(tmp_path / "mask.png", MASKS["disc"])


@pytest.mark.parametrize("double", quick([False, True], 0))
def test_a_grey_plate_is_written_in_cells(double, tmp_path):
    """As the refusal advises; every cell is read back, and is as wide as the shop's finest."""
    with jax.enable_x64(double):
        grey = tc.FresnelZoneAperture(150.0, 0.4, width=0.48, height=0.32, centre=CENTRE)
        with pytest.raises(
            ValueError, match=r"its tc\.lensless\.masks\.halftone\.halftone\(mask, "
        ):
            tc.design.write_gds(tmp_path / "mask.gds", grey)
        plate = tc.lensless.masks.halftone.halftone(grey, 8 * um)
        path = tc.design.write_gds(tmp_path / "mask.gds", plate, smallest_feature=8 * um)
    region = read(path)
    y, x = ((np.arange(n) - (n - 1) / 2) * 8 * um for n in (40, 60))
    found = [[open_area(region, b - 0.12, a + 0.05, 8 * um) for b in x] for a in y]
    np.testing.assert_allclose(found, plate.amplitude, atol=1e-3)


HEIGHT = np.random.default_rng(0).integers(0, 4, (5, 7)) * 0.4 * um


@pytest.mark.parametrize("material", [1.5, CauchyIndex(1.5, 4e-9), bk7()])
@pytest.mark.parametrize("interpolation", ["cells", "bilinear"])
def test_a_height_map_comes_back(tmp_path, material, interpolation):
    """Counts of 8 bit hold four levels exactly; the index at another wavelength is the same."""
    mask = tc.PhaseMask(HEIGHT, 3 * um, material, centre=(0.1, -0.2), interpolation=interpolation)
    path = write_height_map(tmp_path / "mask.png", mask, wavelength=532 * nm)
    with PIL.Image.open(path) as image:
        assert image.mode == "L" and image.size == (7, 5)
        np.testing.assert_array_equal(np.asarray(image), np.round(HEIGHT / um / 1.2 * 255))
    told = json.loads((tmp_path / "mask.json").read_text("utf-8"))
    assert told["wavelength_mm"] == 532e-6 and told["pitch_mm"] == 3e-3
    np.testing.assert_allclose(told["height_per_count_mm"] * 255, 1.2e-3)
    back = read_height_map(path)
    np.testing.assert_allclose(back.height, HEIGHT, rtol=0, atol=1e-12)
    np.testing.assert_allclose(back.centre, (0.1, -0.2))
    assert back.interpolation == interpolation
    np.testing.assert_allclose(back.turns(620 * nm), mask.turns(620 * nm), rtol=1e-9)


def test_what_is_no_height_map_is_told_in_one_line(tmp_path):
    mask = tc.PhaseMask(HEIGHT, 3 * um, 1.5)
    path = write_height_map(tmp_path / "mask.png", mask, wavelength=532 * nm)
    record = json.loads((tmp_path / "mask.json").read_text("utf-8"))

    def told(about):
        with pytest.raises(MeasurementError, match=about) as error:
            read_height_map(path)
        assert "\n" not in str(error.value)

    def changed(**given):
        (tmp_path / "mask.json").write_text(json.dumps(record | given), "utf-8")

    changed(height_per_count_mm=1.0)
    told(r"mask.json: is no mask's \(height reaches from 0 to 255")
    changed(material={"kind": "glass"})
    told("mask.json: is no mask's")
    changed(format="other")
    told("mask.json: is no height map's; give one of write_height_map")
    changed()
    PIL.Image.new("L", (4, 4)).save(path)
    told(r"has \(4, 4\) pixels and its JSON file says \(5, 7\)")
    PIL.Image.new("RGB", (7, 5)).save(path)
    told("give an 8-bit grey PNG")
    (tmp_path / "mask.json").unlink()
    told("mask.json: is missing")
    with pytest.raises(ValueError, match="height maps are written as .png"):
        write_height_map(tmp_path / "mask.tif", mask, wavelength=532 * nm)
    grey = tc.PhaseMask(HEIGHT, 3 * um, 1.5, amplitude=np.ones((5, 7)))
    with pytest.raises(ValueError, match="a height map holds no amplitude"):
        write_height_map(path, grey, wavelength=532 * nm)


def triangles_of(path):
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    assert len(data) == 84 + 50 * count
    facet = np.dtype([("numbers", "<f4", 12), ("attribute", "<u2")])
    numbers = np.frombuffer(data, facet, offset=84)["numbers"].reshape(count, 4, 3)
    return numbers[:, 0], numbers[:, 1:]


@pytest.mark.parametrize("interpolation", ["cells", "bilinear"])
@pytest.mark.parametrize("height", [HEIGHT, np.zeros((1, 1)), np.eye(2) * um])
def test_a_solid_is_closed_and_holds_the_sum_of_heights(tmp_path, height, interpolation):
    """Every edge belongs to two triangles, once in each direction; normals point out.

    The volume is Σh p² and the plate's: by the divergence theorem, Σ a·(b × c)/6.
    """
    mask = tc.PhaseMask(height, 3 * um, 1.5, interpolation=interpolation)
    normals, triangles = triangles_of(write_stl(tmp_path / "mask.stl", mask, base=5 * um))
    corners, index = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    index = index.reshape(-1, 3)
    edges = np.concatenate([index[:, [0, 1]], index[:, [1, 2]], index[:, [2, 0]]])
    there, times = np.unique(edges, axis=0, return_counts=True)
    assert (times == 1).all() and (there[:, 0] != there[:, 1]).all()
    back = set(map(tuple, there[:, ::-1].tolist()))
    assert back == set(map(tuple, there.tolist()))
    assert len(corners) - len(there) / 2 + len(index) == 2  # Euler: one body without holes
    a, b, c = np.moveaxis(triangles.astype(float), 1, 0)
    area = height.size * (3 * um) ** 2
    volume = height.sum() * (3 * um) ** 2 + 5 * um * area
    np.testing.assert_allclose(np.sum(a * np.cross(b, c)) / 6, volume, rtol=1e-5)
    assert np.isfinite(normals).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)
    top = triangles[..., 2].max()
    np.testing.assert_allclose(top, 5 * um + height.max(), rtol=1e-6)


def test_solids_have_their_suffix_and_a_plate(tmp_path):
    mask = tc.PhaseMask(HEIGHT, 3 * um, 1.5)
    with pytest.raises(ValueError, match="solids are written as .stl"):
        write_stl(tmp_path / "mask.obj", mask)
    with pytest.raises(ValueError, match="base = 0.0 mm is not positive"):
        write_stl(tmp_path / "mask.stl", mask, base=0.0)


def test_down_in_the_image_is_minus_y(tmp_path):
    """A high cell in the first row and last column stands at +x and +y."""
    height = np.zeros((3, 4))
    height[0, 3] = 1 * um
    _, triangles = triangles_of(write_stl(tmp_path / "m.stl", tc.PhaseMask(height, 1 * um, 1.5)))
    high = triangles[triangles[..., 2] > 0.1005]
    assert (high[:, 0] > 0.9 * um).all() and (high[:, 1] > 0.4 * um).all()


def test_a_mosaic_is_one_layout(tmp_path):
    """Each mask where the mosaic has it; both tones fill the rectangle about all."""
    masks = [[MASKS["zones"].replace(phase=phase, centre=(0.0, 0.0)) for phase in (0.0, 1.5)]]
    mosaic = tc.Mosaic(masks, tc.Sensor((40, 70), 20 * um), 2.0, pitch=0.6, wall=0.05)
    region = read(tc.design.write_gds(tmp_path / "two.gds", mosaic))
    for mask, x in zip(masks[0], (-0.3, 0.3), strict=True):
        alone = read(tc.design.write_gds(tmp_path / "one.gds", mask.replace(centre=(0.0, x))))
        box = klayout.db.Region(
            klayout.db.Box(*(round(1e6 * n) for n in (x - 0.26, -1, x + 0.26, 1)))
        )
        assert ((region & box) ^ alone).area() < 1e-4 * alone.area()
    dark = read(tc.design.write_gds(tmp_path / "dark.gds", mosaic, tone="opaque"))
    assert (region & dark).area() < 1e-4 * dark.area()
    assert (region + dark).area() * 1e-12 == pytest.approx(1.1 * 0.4, rel=1e-4)


def test_a_density_map_is_the_light_that_passes(tmp_path):
    mask = tc.FresnelZoneAperture(100.0, 0.4, width=0.6, height=0.48, centre=CENTRE)
    for name in ("plate.png", "plate.tif"):
        path = write_density_map(tmp_path / name, mask, 6 * um)
        with PIL.Image.open(path) as image:
            counts = np.asarray(image)
        record = json.loads(path.with_suffix(".json").read_text("utf-8"))
        assert counts.shape == tuple(record["shape"]) == (80, 100) and record["pixel_mm"] == 6 * um
        y, x = np.meshgrid(
            *((np.arange(n) - (n - 1) / 2) * 6 * um for n in (80, 100)), indexing="ij"
        )
        light = ((1 + np.cos(100.0 * (x**2 + y**2) + 0.4)) / 2) ** 2
        np.testing.assert_allclose(counts * record["transmittance_per_count"], light, atol=1e-5)
    densities = np.interp([0.1 * 65535], record["counts"], 10 ** -np.array(record["densities"]))
    np.testing.assert_allclose(densities, 0.1, atol=1e-4)
    for given, error, message in (
        (("plate.bmp", mask, 6 * um), ValueError, "written as .png or .tif"),
        (("plate.png", mask, 7 * um), ValueError, "not a whole number"),
        (("plate.png", phase_mask(), 6 * um), TypeError, "no density; write it by write_height"),
    ):
        with pytest.raises(error, match=message):
            write_density_map(tmp_path / given[0], *given[1:])


def phase_mask():
    return tc.lensless.masks.phase.PhaseMask(np.full((8, 9), 1e-3), 10 * um, bk7())
