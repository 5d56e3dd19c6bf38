"""Camera RAW: known light comes back, in the camera's own colours."""

import sys
from types import SimpleNamespace

import numpy as np
import photographs
import pytest
import tifffile

from diffatmo import color, imageio, raw
from diffatmo.imageio import ImageError

RNG = np.random.default_rng(0)
BLACK, WHITE = np.array([[100, 110], [120, 130]]), 4000
SPAN = WHITE - BLACK


@pytest.fixture
def counts():
    return RNG.integers(60, WHITE, (24, 32)).astype(np.uint16)


def cells(counts, y, x):
    """Light in one corner of each cell, from the counts."""
    return (counts[y::2, x::2].astype(float) - BLACK[y, x]) / SPAN[y, x]


def test_known_light_comes_back(tmp_path, counts):
    image = imageio.read_image(photographs.dng(tmp_path / "a.dng", counts))
    green = (cells(counts, 0, 1) + cells(counts, 1, 0)) / 2
    expected = np.stack([cells(counts, 0, 0), green, cells(counts, 1, 1)], axis=-1)
    assert image.pixels.dtype == np.float32
    np.testing.assert_allclose(image.pixels, expected, atol=1e-6)  # one count is 3e-4
    assert expected.min() < 0  # noise about black stays noise
    assert (image.saturation, image.wavelengths) == (1.0, None)
    assert (image.exif.model, image.exif.size) == ("A camera", (12, 16))


def test_light_of_a_scene(tmp_path):
    """Light at 1/4 of saturation in green, 1/8 in red, 1/2 in blue, digitised: to half a count of the finer channels."""
    light = np.array([[1 / 8, 1 / 4], [1 / 4, 1 / 2]])
    cell = np.round(BLACK + light * SPAN).astype(np.uint16)
    image = imageio.read_image(photographs.dng(tmp_path / "a.dng", np.tile(cell, (15, 16))))
    np.testing.assert_allclose(image.pixels, np.broadcast_to([1 / 8, 1 / 4, 1 / 2], (15, 16, 3)), atol=0.5 / SPAN.min())


@pytest.mark.parametrize("pattern", [(1, 0, 2, 1), (2, 1, 1, 0), (1, 2, 0, 1)])
def test_bayer_patterns(tmp_path, counts, pattern):
    image = imageio.read_image(photographs.dng(tmp_path / "a.dng", counts, pattern=bytes(pattern), black=(100,) * 4))
    for channel in range(3):
        places = [divmod(i, 2) for i in range(4) if pattern[i] == channel]
        expected = np.mean([(counts[y::2, x::2] - 100.0) / (WHITE - 100) for y, x in places], axis=0)
        np.testing.assert_allclose(image.pixels[..., channel], expected, atol=1e-6)


def test_a_cell_is_saturated_where_one_of_its_greens_is(tmp_path):
    counts = np.full((24, 32), 1000, np.uint16)
    counts[0, 1] = WHITE
    image = imageio.read_image(photographs.dng(tmp_path / "a.dng", counts))
    assert image.pixels[0, 0, 1] == image.saturation
    assert image.pixels[..., 1].min() == pytest.approx(np.mean([(1000 - 110) / 3890, (1000 - 120) / 3880]), abs=1e-6)


def test_odd_sizes_lose_a_row_and_a_column(tmp_path, counts):
    assert imageio.read_image(photographs.dng(tmp_path / "a.dng", counts[:23, :31])).pixels.shape == (11, 15, 3)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation(tmp_path, counts, orientation):
    from diffatmo import exif

    stored = imageio.read_image(photographs.dng(tmp_path / "a.dng", counts)).pixels
    image = imageio.read_image(photographs.dng(tmp_path / "b.dng", counts, orientation=orientation))
    np.testing.assert_array_equal(image.pixels, exif.upright(stored, orientation))
    assert (image.exif.orientation, image.exif.size) == (1, image.pixels.shape[:2])


def test_colours(tmp_path, counts):
    image = imageio.read_image(photographs.dng(tmp_path / "a.dng", counts))
    assert image.white_balance == pytest.approx((2, 1, 1.6))
    # LibRaw's own matrix of sRGB has seven digits, as ours has.
    np.testing.assert_allclose(image.to_xyz, np.linalg.inv(photographs.XYZ_TO_CAMERA), rtol=1e-5)
    bare = imageio.read_image(photographs.dng(tmp_path / "b.dng", counts, without=(0xC628,)))
    assert bare.white_balance is None


def test_matrix_of_cameras_that_libraw_knows():
    """Those have the matrix from XYZ; others that from the balanced camera to sRGB: both are the same in the end."""
    known = SimpleNamespace(rgb_xyz_matrix=np.vstack([photographs.XYZ_TO_CAMERA, np.zeros(3)]))
    to_xyz = np.linalg.inv(photographs.XYZ_TO_CAMERA)
    np.testing.assert_allclose(raw._to_xyz(known), to_xyz)
    from_srgb = photographs.XYZ_TO_CAMERA @ np.linalg.inv(color.XYZ_TO_SRGB)
    white = from_srgb.sum(axis=1)
    other = SimpleNamespace(
        rgb_xyz_matrix=np.zeros((4, 3)),
        color_matrix=np.hstack([np.linalg.inv(from_srgb / white[:, None]), np.zeros((3, 1))]),
        daylight_whitebalance=[*(1 / white), 0.0],
    )
    np.testing.assert_allclose(raw._to_xyz(other), to_xyz)
    assert raw._to_xyz(SimpleNamespace(**{**vars(other), "color_matrix": np.zeros((3, 4))})) is None


def test_linear_rgb_of_a_sensor_without_a_pattern(tmp_path):
    light = RNG.random((24, 32, 3))
    path = photographs.dng(tmp_path / "a.dng", np.round(light * WHITE).astype(np.uint16))
    pixels = imageio.read_image(path).pixels
    # There is nothing to average. LibRaw's integers have 16 bits, the counts 12.
    assert pixels.shape == (24, 32, 3)
    np.testing.assert_allclose(pixels, light, atol=1 / WHITE)


def test_tiff_based_raw_is_told_from_a_tiff(tmp_path, counts):
    assert raw.is_raw(photographs.dng(tmp_path / "a.dng", counts).read_bytes())
    # Without the version of a DNG it is the pattern that gives a RAW away, in the first directory or in one below it.
    assert raw.is_raw(photographs.dng(tmp_path / "b.dng", counts, without=(0xC612,)).read_bytes())
    with tifffile.TiffWriter(tmp_path / "c.nef") as file:
        file.write(np.zeros((8, 8, 3), np.uint8), photometric="rgb", subifds=1)
        file.write(
            counts, photometric=32803, extratags=[(0x828D, "H", 2, (2, 2), True), (0x828E, "B", 4, b"\0\1\1\2", True)]
        )
    assert raw.is_raw((tmp_path / "c.nef").read_bytes())
    tifffile.imwrite(tmp_path / "d.tif", counts)
    assert not raw.is_raw((tmp_path / "d.tif").read_bytes())
    assert raw.is_raw(b"\0\0\0\x18ftypcrx \0\0\0\1")
    assert not raw.is_raw(b"\0\0\0\x18ftypheic\0\0\0\0")
    assert raw.is_raw(b"FUJIFILMCCD-RAW 0201")


def test_notes_of_a_raw_that_is_no_tiff(tmp_path):
    """From the Exif block of its preview, or what LibRaw made of it."""
    block = photographs.exif_block(photographs.FIRST, photographs.CAMERA)
    (tmp_path / "a.raf").write_bytes(b"FUJIFILMCCD-RAW " + b"\0" * 100 + block)
    assert raw._exif(tmp_path / "a.raf", None).model == "A camera"
    (tmp_path / "a.cr3").write_bytes(b"\0\0\0\x18ftypcrx ")
    other = SimpleNamespace(focal_length=35.0, shutter_speed=0.01, aperture=0.0, iso_speed=400.0, timestamp=None)
    found = raw._exif(tmp_path / "a.cr3", SimpleNamespace(other=other))
    assert (found.focal_length_mm, found.exposure_s, found.f_number, found.iso) == (35, 0.01, None, 400)


def test_without_rawpy(tmp_path, counts, monkeypatch):
    path = photographs.dng(tmp_path / "a.dng", counts)
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(ImageError, match=r"a\.dng: camera RAW needs rawpy: pip install 'diffatmo\[raw\]'$"):
        imageio.read_image(path)


def test_a_raw_is_linear(tmp_path, counts):
    with pytest.raises(ImageError, match="contradicts the file format"):
        imageio.read_image(photographs.dng(tmp_path / "a.dng", counts), transfer="srgb")


def test_black_at_white_is_refused(tmp_path, counts):
    with pytest.raises(ImageError, match="a black level of 4000 and a white level of"):
        imageio.read_image(photographs.dng(tmp_path / "a.dng", counts, black=(4000,) * 4))
