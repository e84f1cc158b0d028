"""Data sets in the layouts in which they are published, written as their authors write them."""

import io
import threading

import numpy as np
import PIL.Image
import pytest
import scipy.io

from thincam_jax.measured import MeasurementError, Preparation, Raw, prepare
from thincam_jax.measured.layouts import open_pairs, with_psf
from thincam_jax.measured.pairs import TruthAlignment, as_light, relative_pitch

SHAPE = (12, 20)


def image(seed, shape=SHAPE, channels=3):
    return np.random.default_rng(seed).uniform(size=(*shape, channels)).astype(np.float32)


def png(pixels):
    buffer = io.BytesIO()
    PIL.Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def write_diffusercam(folder, names=("diffuser_images", "ground_truth_lensed"), count=4):
    """Float NPY, blue, green, red; an 8-bit PSF of four times the pixels; lists with a heading."""
    for kind, name in enumerate(names):
        (folder / name).mkdir(parents=True)
        for n in range(1, 1 + count):
            np.save(folder / name / f"im{n}.npy", image(10 * kind + n))
    psf = (255 * image(0, (48, 80))).astype(np.uint8)
    PIL.Image.fromarray(psf).save(folder / "psf.tiff")
    return folder


def write_lists(folder, train, test):
    for name, numbers in (("train", train), ("test", test)):
        lines = ["images.jpg.tiff, as its heading", *(f"im{n}.jpg.tiff" for n in numbers)]
        (folder / f"dataset_{name}.csv").write_text("\n".join(lines))


def write_parquet(folder, per_group=2, **columns):
    """As `datasets` pushes it: images as structs of bytes and a path, a file for each part."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / "data").mkdir(parents=True)
    for split, first, count in (("test", 0, 3), ("train", 3, 2), ("train", 5, 1)):
        rows = [
            {
                "lensless": {"bytes": png(codes(n)), "path": f"{n}.png"},
                "lensed": {"bytes": png(codes(50 + n, (6, 10))), "path": f"{n}.jpg"},
                **{name: make(n) for name, make in columns.items()},
            }
            for n in range(first, first + count)
        ]
        part = f"{split}-0000{int(first > 3)}-of-00002.parquet"
        pq.write_table(pa.Table.from_pylist(rows), folder / "data" / part, row_group_size=per_group)
    PIL.Image.fromarray(codes(99)).save(folder / "psf.png")
    return folder


def codes(seed, shape=SHAPE):
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3)).astype(np.uint8)


class TestDiffuserCam:
    def test_colours_and_levels(self, tmp_path):
        pairs = open_pairs(write_diffusercam(tmp_path))
        pair = pairs[2]
        assert (pairs.layout, len(pairs), pair.name) == ("DiffuserCam", 4, "im3")
        np.testing.assert_array_equal(pair.capture.pixels, image(3)[..., ::-1])
        # Light as it is stored: no sRGB, no scale.
        np.testing.assert_array_equal(pair.truth, np.moveaxis(image(13)[..., ::-1], -1, 0))
        assert pair.psf is not None
        assert relative_pitch(pair.psf, pair.capture) == 0.25
        assert pairs.psf_channels == "mean" and pairs.alignment.upside_down

    def test_lists_of_the_splits(self, tmp_path):
        write_lists(write_diffusercam(tmp_path), train=(3, 4, 7), test=(1, 2))
        assert list(open_pairs(tmp_path).names) == ["im1", "im2"]
        train = open_pairs(tmp_path, "train")
        assert list(train.names) == ["im3", "im4"]
        assert train.splits == {"train": 2, "test": 2}
        assert train.notes == ("1 of the 3 pairs of dataset_train.csv are not there",)
        assert len(open_pairs(tmp_path, "all")) == 4

    def test_folders_of_the_test_set(self, tmp_path):
        pairs = open_pairs(write_diffusercam(tmp_path, ("diffuser", "lensed")))
        assert (pairs.split, pairs[0].name) == ("all", "im1")


class TestParquet:
    @pytest.fixture(autouse=True)
    def _library(self):
        pytest.importorskip("pyarrow")

    def test_splits_and_rows(self, tmp_path):
        root = write_parquet(tmp_path)
        pairs = open_pairs(root, "train")
        assert (len(pairs), pairs.splits) == (3, {"test": 3, "train": 3})
        for number, seed in enumerate((3, 4, 5)):  # across groups and files
            np.testing.assert_array_equal(pairs[number].capture.pixels, codes(seed))
        assert len(open_pairs(root, "all")) == 6
        single = open_pairs(root / "data" / "test-00000-of-00002.parquet")
        np.testing.assert_array_equal(single[2].capture.pixels, codes(2))
        assert single.psf_file() == root / "psf.png"

    def test_truths_are_decoded_from_srgb(self, tmp_path):
        truth = open_pairs(write_parquet(tmp_path))[0].truth
        expected = ((codes(50, (6, 10)) / 255 + 0.055) / 1.055) ** 2.4
        bright = codes(50, (6, 10)) > 20
        np.testing.assert_allclose(np.moveaxis(truth, 0, -1)[bright], expected[bright], rtol=1e-5)

    def test_masks_and_ambient_light(self, tmp_path):
        root = write_parquet(
            tmp_path / "set",
            mask_label=lambda n: n + 7,
            ambient=lambda n: {"bytes": png(codes(70 + n)), "path": "a.png"},
        )
        psfs = tmp_path / "psfs"
        psfs.mkdir()
        for label in (7, 8):
            np.save(psfs / f"psf_{label}.npy", image(label))
        pair = with_psf(open_pairs(root), psfs)[1]
        assert pair.mask_label == 8 and pair.psf is not None and pair.background is not None
        np.testing.assert_array_equal(pair.psf.pixels, image(8))
        np.testing.assert_array_equal(pair.background.pixels, codes(71))
        assert with_psf(open_pairs(root), psfs)[2].psf is None  # label 9
        assert open_pairs(root)[0].psf is None  # psf.png is of no mask by its label

    def test_other_columns(self, tmp_path):
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table({"lensless": [1], "text": ["a"]}), tmp_path / "test.parquet")
        with pytest.raises(MeasurementError, match="no column 'lensless' of images as bytes; it h"):
            open_pairs(tmp_path)
        (tmp_path / "test.parquet").write_bytes(b"PAR1 and no more")
        with pytest.raises(MeasurementError, match="test.parquet: cannot be read"):
            open_pairs(tmp_path)

    def test_published_alignments(self, tmp_path):
        """By the repository's name, also in the cache of huggingface_hub."""
        root = write_parquet(tmp_path / "datasets--bezzam--DigiCam-Mirflickr-SingleMask-25K" / "a")
        pairs = open_pairs(root)
        assert pairs.alignment.turned and pairs.alignment.rows == (80, 280)
        root = write_parquet(tmp_path / "DiffuserCam-Lensless-Mirflickr-Dataset-NORM")
        copy = open_pairs(root)
        assert copy.alignment.upside_down and copy.psf_channels == "mean"
        np.testing.assert_allclose(copy[0].truth[0], codes(50, (6, 10))[..., 0] / 255, rtol=1e-6)


class TestFolders:
    def write(self, folder, names=("captures", "truths"), count=2):
        for name in names:
            (folder / name).mkdir(parents=True)
            for n in range(count):
                PIL.Image.fromarray(codes(n)).save(folder / name / f"{name[0]}_{n}.png")

    def test_splits_are_folders(self, tmp_path):
        for split, seed in (("train", 1), ("test", 2)):
            for name in ("lensless", "lensed"):
                (tmp_path / split / name).mkdir(parents=True)
                np.save(tmp_path / split / name / "a.npy", image(seed))
        assert open_pairs(tmp_path).split == "test"
        np.testing.assert_array_equal(open_pairs(tmp_path, "train")[0].capture.pixels, image(1))
        with pytest.raises(MeasurementError, match="no split 'val'; there are all, test, train"):
            open_pairs(tmp_path, "val")

    def test_lists_of_flatnet(self, tmp_path):
        """Folders by class, x..png beside x.JPEG, lists with the paths of their authors."""
        for n in (1, 2, 11):
            for folder, name in (("caps_1cap", f"a/n_{n}..png"), ("orig", f"a/n_{n}.JPEG")):
                (tmp_path / folder / "a").mkdir(parents=True, exist_ok=True)
                PIL.Image.fromarray(codes(n)).save(tmp_path / folder / name)
        (tmp_path / "filenames").mkdir()
        for split, numbers in (("train", (1, 2)), ("val", (11,))):
            lines = [f"Amplitude Mask/dataset/caps_1cap/a/n_{n}..png" for n in numbers]
            (tmp_path / "filenames" / f"{split}_meas_ilsvrc_flatcam.txt").write_text(
                "\n".join(lines)
            )
        pairs = open_pairs(tmp_path, "train")
        assert (list(pairs.names), pairs.splits) == (["n_1", "n_2"], {"train": 2, "val": 1})
        assert len(open_pairs(tmp_path)) == 3
        assert pairs[1].truth.shape == (3, *SHAPE)

    def test_jpeg_truths_are_silent(self, tmp_path):
        (tmp_path / "captures").mkdir()
        (tmp_path / "truths").mkdir()
        np.save(tmp_path / "captures" / "x.npy", image(1))
        PIL.Image.fromarray(np.full((8, 8, 3), 188, np.uint8)).save(tmp_path / "truths" / "x.jpg")
        truth = open_pairs(tmp_path)[0].truth  # a warning would be an error
        np.testing.assert_allclose(truth, 0.503, atol=0.002)

    def test_arrays_of_matlab(self, tmp_path):
        for name in ("captures", "truths"):
            (tmp_path / name).mkdir()
            for n in (9, 10):
                arrays = {"image": 10.0 * n + image(n)}
                scipy.io.savemat(tmp_path / name / f"im{n}.mat", arrays)
        pairs = open_pairs(tmp_path)
        assert list(pairs.names) == ["im9", "im10"]
        np.testing.assert_array_equal(pairs[1].capture.pixels, 100 + image(10))

    def test_lone_captures(self, tmp_path):
        self.write(tmp_path)
        with pytest.raises(MeasurementError, match=r"of 2 files in captures/ 0 have a partner"):
            open_pairs(tmp_path)

    def test_licence(self, tmp_path):
        write_diffusercam(tmp_path)
        (tmp_path / "LICENSE").write_text("BSD 3-Clause License\n\nCopyright")
        assert open_pairs(tmp_path).licence == "BSD 3-Clause License (LICENSE)"
        (tmp_path / "README.md").write_text("---\nlicense: mit\n---\n# Title")
        assert open_pairs(tmp_path).licence == "mit (README.md)"


def test_unknown_layouts(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "a.txt").write_text("a")
    with pytest.raises(MeasurementError) as error:
        open_pairs(tmp_path)
    (line,) = str(error.value).splitlines()
    assert "holds 1 folders and 1 files (images/, a.txt); known layouts are: 'diffuser_im" in line
    with pytest.raises(MeasurementError, match="does not exist"):
        open_pairs(tmp_path / "no")


class TestReading:
    def test_batches_in_order_and_ahead(self, tmp_path):
        pairs = open_pairs(write_diffusercam(tmp_path, count=5))
        threads = set()
        read = pairs.storage.read
        object.__setattr__(
            pairs.storage, "read", lambda *a: (threads.add(threading.get_ident()), read(*a))[1]
        )
        batches = list(pairs.batches(2))
        names = [[pair.name for pair in batch] for batch in batches]
        assert names == [["im1", "im2"], ["im3", "im4"], ["im5"]]
        assert threading.get_ident() not in threads
        with pytest.raises(ValueError, match="size = 0"):
            next(pairs.batches(0))

    def test_lazy(self, tmp_path):
        pairs = open_pairs(write_diffusercam(tmp_path))
        (tmp_path / "diffuser_images" / "im2.npy").write_bytes(b"damaged")
        assert pairs[0].name == "im1"
        with pytest.raises(MeasurementError, match=r"im2\.npy"):
            pairs[1]
        with pytest.raises(IndexError):
            pairs[4]

    @pytest.mark.parametrize("folder", ["diffuser_images", "ground_truth_lensed"])
    def test_digest(self, tmp_path, folder):
        pairs = open_pairs(write_diffusercam(tmp_path))
        before = [pairs.digest(n) for n in range(4)]
        np.save(tmp_path / folder / "im2.npy", image(77))
        after = [pairs.digest(n) for n in range(4)]
        assert [a == b for a, b in zip(before, after, strict=True)] == [True, False, True, True]


class TestMatched:
    """Image and truth on the same pixels."""

    def prepared(self, shape, **options):
        psf = Raw(np.eye(*shape) + 0.01)
        capture = Raw(np.random.default_rng(0).uniform(size=shape))
        return prepare(psf, capture, background=0, options=Preparation(corner=(0, 2), **options))

    def test_part_of_the_image(self):
        log = self.prepared((24, 40), downsample=2).log
        truth = np.random.default_rng(1).uniform(size=(1, 16, 24)).astype(np.float32)
        picture = np.zeros((1, 12, 20), np.float32)
        halves = truth.reshape(1, 8, 2, 12, 2).mean(axis=(2, 4))
        picture[:, 2:10, 4:16] = halves
        image, seen = TruthAlignment((4, 20), (8, 32)).matched(picture, truth, log)
        np.testing.assert_allclose(image, seen, rtol=1e-6)
        # Turned: the same picture lies turned in the camera's image.
        turned = TruthAlignment((4, 20), (8, 32), turned=True)
        np.testing.assert_allclose(turned.matched(picture[:, ::-1, ::-1], truth, log)[0], halves)

    def test_remainders_of_blocks(self):
        """What no whole block covers is cut off the truth, too: 25×41 pixels by 3."""
        log = self.prepared((25, 41), downsample=3).log
        truth = np.arange(25 * 41, dtype=np.float32).reshape(1, 25, 41)
        top, left = log.first_pixel
        kept = truth[:, top : top + 24, left : left + 39]
        picture = kept.reshape(1, 8, 3, 13, 3).mean(axis=(2, 4))
        image, seen = TruthAlignment().matched(picture, truth, log)
        np.testing.assert_allclose(image, seen, rtol=1e-6)

    def test_upright_and_grey(self):
        log = self.prepared((12, 20)).log
        truth = np.random.default_rng(1).uniform(size=(3, 12, 20)).astype(np.float32)
        image, seen = TruthAlignment(upside_down=True).matched(truth[:1], truth, log)
        np.testing.assert_array_equal(image, truth[:1, ::-1])
        np.testing.assert_allclose(seen, truth.mean(0, keepdims=True)[:, ::-1])

    def test_outside(self):
        log = self.prepared((12, 20)).log
        with pytest.raises(MeasurementError, match="9×20 pixels do not cover the capture of 12×20"):
            TruthAlignment().matched(
                np.zeros((1, 12, 20), np.float32), np.zeros((1, 9, 20), np.float32), log
            )
        with pytest.raises(MeasurementError, match="30:40, of which the capture has none"):
            TruthAlignment((30, 40), (0, 9)).matched(
                np.zeros((1, 12, 20), np.float32), np.zeros((1, 5, 5), np.float32), log
            )


def test_encodings():
    raw = Raw(np.array([[0, 51], [128, 255]], np.uint8))
    np.testing.assert_allclose(as_light(raw, "linear")[0, 0, 1], 0.2)
    np.testing.assert_allclose(as_light(raw)[0, 0, 1], 0.0331, atol=1e-4)
    deep = Raw(np.array([[0, 13107]], np.uint16))
    np.testing.assert_allclose(as_light(deep)[0, 0, 1], 0.2)
    np.testing.assert_allclose(as_light(deep, "srgb")[0, 0, 1], 0.0331, atol=1e-4)


def two_folders(folder, alignment):
    for name in ("captures", "truths"):
        (folder / name).mkdir()
        np.save(folder / name / "a.npy", image(1, channels=1)[..., 0])
    (folder / "README.md").write_text(f"---\ntruth_alignment: {alignment}\n---\n", "utf-8")
    return folder


def test_a_card_states_what_truths_cover(tmp_path):
    stated = "{rows: [2, 10], columns: [3, 17], turned: true}"
    found = open_pairs(two_folders(tmp_path, stated)).alignment
    assert found == TruthAlignment((2, 10), (3, 17), turned=True, source="README.md")


@pytest.mark.parametrize("given", ["[1, 2]", "{rows: [1, 2]}", "{rows: all, columns: [1, 2]}"])
def test_a_card_that_states_no_place(tmp_path, given):
    with pytest.raises(MeasurementError, match="truth_alignment is .* give rows: .first, end."):
        open_pairs(two_folders(tmp_path, given))
