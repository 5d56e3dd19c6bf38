"""Pictures in and out: exact round trips, and one clear line for every broken file."""

import os
import struct
import sys
import zlib
from datetime import UTC, datetime

import numpy as np
import OpenEXR
import photographs
import pytest
import tifffile
from PIL import Image as Pillow

from diffatmo import codecs, exif, imageio
from diffatmo.exif import Exif
from diffatmo.imageio import ImageError

RNG = np.random.default_rng(0)


@pytest.fixture
def pixels():
    return RNG.random((12, 20, 3), dtype=np.float32)


# --- EXR


def test_exr_round_trip(tmp_path, pixels):
    path = tmp_path / "a.exr"
    text = "line 1\nβ = 0.1\n" * 500
    imageio.write_exr(path, pixels, {"note": text, "gain": 0.5, "count": 3})
    image = imageio.read_image(path)
    np.testing.assert_array_equal(image.pixels, pixels)
    assert image.pixels.dtype == np.float32
    assert image.metadata == {"note": text, "gain": 0.5, "count": 3}
    assert image.wavelengths is None
    with OpenEXR.File(str(path), separate_channels=True) as file:
        np.testing.assert_array_equal(file.channels()["R"].pixels, pixels[..., 0])
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize("wavelengths", [(680.0, 550.0, 440.0), (440.0, 550.0, 680.0), (550.0, 680.0, 440.0)])
def test_three_bands_keep_their_order_and_red_is_the_longest(tmp_path, pixels, wavelengths):
    path = tmp_path / "a.exr"
    imageio.write_exr(path, pixels, wavelengths=wavelengths)
    image = imageio.read_image(path)
    assert image.wavelengths == wavelengths
    np.testing.assert_array_equal(image.pixels, pixels)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        np.testing.assert_array_equal(file.channels()["R"].pixels, pixels[..., wavelengths.index(680.0)])


def test_spectra_follow_the_spectral_layout(tmp_path):
    wavelengths = (700.0, 400.0, 555.5, 1064.25, 500.0)
    cube = RNG.random((4, 6, 5), dtype=np.float32)
    path = tmp_path / "a.exr"
    imageio.write_exr(path, cube, wavelengths=np.array(wavelengths, dtype=np.float32))
    image = imageio.read_image(path)
    assert image.wavelengths == wavelengths
    np.testing.assert_array_equal(image.pixels, cube)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert "S0.555,500000nm" in file.channels()


def test_spectra_of_others_are_sorted_by_wavelength(tmp_path):
    planes = {f"S0.{w},00nm": np.full((2, 3), w, "f") for w in (600, 400, 500, 1000)}
    OpenEXR.File({}, planes).write(str(tmp_path / "a.exr"))
    image = imageio.read_image(tmp_path / "a.exr")
    assert image.wavelengths == (400, 500, 600, 1000)
    np.testing.assert_array_equal(image.pixels[0, 0], [400, 500, 600, 1000])


def test_half_precision_alpha_and_grey(tmp_path):
    half = RNG.random((4, 5)).astype(np.float16)
    OpenEXR.File({}, dict.fromkeys("RGBA", half)).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(imageio.read_image(tmp_path / "a.exr").pixels, np.dstack([half] * 3))
    OpenEXR.File({}, {"Y": half}).write(str(tmp_path / "y.exr"))
    assert imageio.read_image(tmp_path / "y.exr").pixels.shape == (4, 5, 1)


def test_pixels_that_are_not_finite_are_kept(tmp_path, pixels):
    pixels[3, 4] = np.nan
    pixels[5, 6] = np.inf
    imageio.write_exr(tmp_path / "a.exr", pixels)
    np.testing.assert_array_equal(imageio.read_image(tmp_path / "a.exr").pixels, pixels)


# --- Radiance


def radiance_file(rgbe, header=b"FORMAT=32-bit_rle_rgbe\n", compress=True):
    height, width, _ = rgbe.shape
    body = b""
    for row in rgbe:
        if not compress:
            body += row.tobytes()
            continue
        body += b"\x02\x02" + struct.pack(">H", width)
        for channel in row.T:
            # The first half as literals, the rest as runs of one: both kinds of packet.
            half = width // 2
            body += bytes([half]) + channel[:half].tobytes() + b"".join(bytes([129, v]) for v in channel[half:])
    return b"#?RADIANCE\n" + header + b"\n" + f"-Y {height} +X {width}\n".encode() + body


@pytest.mark.parametrize("compress", [True, False])
def test_radiance(tmp_path, compress):
    rgbe = RNG.integers(0, 256, (5, 16, 4), dtype=np.uint8)
    rgbe[..., 3] = RNG.integers(100, 150, (5, 16))
    rgbe[0, 0] = 0
    (tmp_path / "a.hdr").write_bytes(radiance_file(rgbe, compress=compress))
    image = imageio.read_image(tmp_path / "a.hdr")
    expected = (rgbe[..., :3] + 0.5) * 2.0 ** (rgbe[..., 3:].astype(float) - 136)
    expected[0, 0] = 0
    np.testing.assert_array_equal(image.pixels, expected.astype(np.float32))
    assert image.pixels.dtype == np.float32


def test_radiance_exposure_is_undone(tmp_path):
    rgbe = np.full((2, 8, 4), 128, np.uint8)
    header = b"# a comment\nEXPOSURE=2\nEXPOSURE=4\nCOLORCORR=1 2 1\nFORMAT=32-bit_rle_rgbe\n"
    (tmp_path / "a.hdr").write_bytes(radiance_file(rgbe, header))
    value = 128.5 / 256
    np.testing.assert_allclose(
        imageio.read_image(tmp_path / "a.hdr").pixels[0, 0], [value / 8, value / 16, value / 8], rtol=1e-6
    )


def test_real_radiance_file(shared):
    image = imageio.read_image(shared / "real_sky" / "syferfontein_18d_clear_puresky_1k.hdr")
    assert image.pixels.shape == (512, 1024, 3)
    # The README gives the sun's place; it is the brightest pixel. A clear sky is blue at the zenith.
    y, x = np.unravel_index(image.pixels.sum(-1).argmax(), (512, 1024))
    assert 90 - 180 * (y + 0.5) / 512 == pytest.approx(18.46, abs=0.3)
    assert 360 * (x + 0.5) / 1024 == pytest.approx(215.9, abs=0.3)
    red, green, blue = image.pixels[:20].mean((0, 1))
    assert blue > green > red


# --- PNG


def png_chunk(name, body):
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def paeth(a, b, c):
    nearest = sorted([(abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c)])
    return nearest[0][2]


def png_file(codes, filters=(0, 1, 2, 3, 4), extra=b"", cut=None, kind=None, interlace=0):
    """A PNG of 8- or 16-bit codes whose rows are filtered by ``filters`` in turn, byte by byte as the standard says."""
    height, width, channels = codes.shape
    pixel = channels * codes.itemsize
    raw = codes.astype(codes.dtype.newbyteorder(">")).tobytes()
    rows = np.frombuffer(raw, np.uint8).reshape(height, width * pixel).astype(int)
    body = b""
    for y, row in enumerate(rows):
        rule = filters[y % len(filters)]
        line = []
        for i, value in enumerate(row):
            a = row[i - pixel] if i >= pixel else 0
            b = rows[y - 1][i] if y else 0
            c = rows[y - 1][i - pixel] if y and i >= pixel else 0
            line.append((value - (0, a, b, (a + b) // 2, paeth(a, b, c))[rule]) % 256)
        body += bytes([rule, *line])
    kind = {1: 0, 3: 2, 2: 4, 4: 6}[channels] if kind is None else kind
    header = struct.pack(">IIBBBBB", width, height, 8 * codes.itemsize, kind, 0, 0, interlace)
    data = zlib.compress(body)[:cut]
    half = len(data) // 2
    return (
        b"\x89PNG\r\n\x1a\n"
        + png_chunk(b"IHDR", header)
        + extra
        + png_chunk(b"IDAT", data[:half])
        + png_chunk(b"IDAT", data[half:])
        + png_chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_png_with_16_bits(tmp_path, channels):
    codes = RNG.integers(0, 65536, (17, 9, channels), dtype=np.uint16)
    (tmp_path / "a.png").write_bytes(png_file(codes))
    colours = codes[..., : 3 if channels > 2 else 1]
    found = imageio.read_image(tmp_path / "a.png").pixels
    np.testing.assert_allclose(found, colours / 65535, atol=1e-7)
    # Another reader, which keeps the upper byte only.
    if channels == 3:
        with Pillow.open(tmp_path / "a.png") as file:
            np.testing.assert_array_equal(np.asarray(file), codes >> 8)


def test_png_filters_of_another_encoder(tmp_path):
    # A smooth picture makes the encoder choose its filters by row.
    y, x = np.mgrid[:60, :90]
    codes = np.stack([x + y, x * y % 256, 2 * y], -1).astype(np.uint8)
    Pillow.fromarray(codes).save(tmp_path / "a.png")
    np.testing.assert_allclose(imageio.read_image(tmp_path / "a.png", transfer="linear").pixels, codes / 255, atol=1e-7)


def test_eight_bits_need_a_transfer_function(tmp_path):
    codes = RNG.integers(0, 256, (4, 5, 3), dtype=np.uint8)
    Pillow.fromarray(codes).save(tmp_path / "a.png")
    Pillow.fromarray(codes).save(tmp_path / "a.jpg")
    tifffile.imwrite(tmp_path / "a.tif", codes, photometric="rgb")
    for name in ("a.png", "a.jpg", "a.tif"):
        with pytest.raises(ImageError, match=r"8 bits a channel.*state transfer = \"srgb\" or \"linear\""):
            imageio.read_image(tmp_path / name)
    encoded = codes / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(imageio.read_image(tmp_path / "a.png", transfer="srgb").pixels, linear, atol=1e-6)
    assert imageio.read_image(tmp_path / "a.jpg", transfer="srgb").pixels.shape == (4, 5, 3)


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (png_chunk(b"sRGB", b"\0"), "encoded with sRGB"),
        (png_chunk(b"gAMA", struct.pack(">I", 45455)), "encoded with gamma 0.45455"),
        (png_chunk(b"iCCP", b"x\0\0"), "encoded with a colour profile"),
        (png_chunk(b"cICP", bytes([1, 13, 0, 1])), "encoded with a non-linear transfer function"),
    ],
)
def test_16_bits_that_say_they_are_encoded_need_a_transfer_function(tmp_path, extra, said):
    codes = RNG.integers(0, 65536, (4, 5, 3), dtype=np.uint16)
    (tmp_path / "a.png").write_bytes(png_file(codes, extra=extra))
    with pytest.raises(ImageError, match=said):
        imageio.read_image(tmp_path / "a.png")
    np.testing.assert_allclose(
        imageio.read_image(tmp_path / "a.png", transfer="linear").pixels, codes / 65535, atol=1e-7
    )


def test_16_bits_that_say_they_are_linear(tmp_path):
    codes = RNG.integers(0, 65536, (4, 5, 3), dtype=np.uint16)
    for extra in (png_chunk(b"gAMA", struct.pack(">I", 100000)), png_chunk(b"cICP", bytes([1, 8, 0, 1]))):
        (tmp_path / "a.png").write_bytes(png_file(codes, extra=extra))
        found = imageio.read_image(tmp_path / "a.png")
        np.testing.assert_allclose(found.pixels, codes / 65535, atol=1e-7)
        assert not found.taken_as_linear


def test_16_bits_that_say_nothing_are_known_to_be_taken_as_linear(tmp_path):
    (tmp_path / "a.png").write_bytes(png_file(RNG.integers(0, 65536, (4, 5, 3), dtype=np.uint16)))
    assert imageio.read_image(tmp_path / "a.png").taken_as_linear
    assert not imageio.read_image(tmp_path / "a.png", transfer="linear").taken_as_linear


# --- TIFF


@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_tiff_with_16_bits(tmp_path, planar):
    codes = RNG.integers(0, 65536, (6, 7, 3), dtype=np.uint16)
    stored = codes if planar == "contig" else np.moveaxis(codes, -1, 0)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", planarconfig=planar)
    np.testing.assert_allclose(imageio.read_image(tmp_path / "a.tif").pixels, codes / 65535, atol=1e-7)


def test_tiff_with_floats(tmp_path, pixels):
    tifffile.imwrite(tmp_path / "a.tif", pixels * 100, photometric="rgb")
    np.testing.assert_array_equal(imageio.read_image(tmp_path / "a.tif").pixels, pixels * 100)
    tifffile.imwrite(tmp_path / "p.tif", pixels, photometric="rgb", iccprofile=b"x" * 128)
    with pytest.raises(ImageError, match="encoded with a colour profile"):
        imageio.read_image(tmp_path / "p.tif")


def test_tiff_of_unread_kinds(tmp_path):
    plain, encoded = (struct.pack("<HHII", 259, 3, 1, compression) for compression in (1, 7))
    assert plain in tiff_bytes(tmp_path)
    (tmp_path / "a.tif").write_bytes(tiff_bytes(tmp_path).replace(plain, encoded))
    with pytest.raises(ImageError, match="the compression 7, expected none, deflate, LZW or PackBits"):
        imageio.read_image(tmp_path / "a.tif")


# --- Photographs

TALL = RNG.integers(0, 65536, (9, 6, 3), dtype=np.uint16)
"""Each pixel differs, and so do height and width."""


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_the_right_way_up(tmp_path, orientation):
    first = {**photographs.FIRST, 0x112: ("H", [orientation])}
    block = photographs.exif_block(first, photographs.CAMERA, photographs.GPS)
    (tmp_path / "a.png").write_bytes(png_file(TALL, extra=png_chunk(b"eXIf", block[6:])))
    tifffile.imwrite(tmp_path / "a.tif", TALL, photometric="rgb", extratags=[(0x112, "H", 1, orientation, True)])
    expected = exif.upright(TALL, orientation) / 65535
    for name in ("a.png", "a.tif"):
        image = imageio.read_image(tmp_path / name)
        np.testing.assert_allclose(image.pixels, expected, atol=1e-7)
        assert image.pixels.flags.c_contiguous
        assert (image.exif.orientation, image.exif.size) == (1, expected.shape[:2])
    # A smooth ramp, which the lossy formats keep to three codes.
    ramp = np.broadcast_to(np.linspace(0, 255, 32 * 48).reshape(32, 48, 1), (32, 48, 3)).astype(np.uint8)
    photographs.jpeg(tmp_path / "a.jpg", ramp, block)
    photographs.heif(tmp_path / "a.heic", ramp, block)
    expected = exif.upright(ramp, orientation) / 255
    for name in ("a.jpg", "a.heic"):
        image = imageio.read_image(tmp_path / name, transfer="linear")
        np.testing.assert_allclose(image.pixels, expected, atol=3 / 255)
        assert (image.exif.orientation, image.exif.size) == (1, expected.shape[:2])
        assert (image.exif.model, image.exif.iso) == ("A camera", 200)


def test_what_is_read_besides_the_pixels(tmp_path, pixels):
    imageio.write_exr(tmp_path / "a.exr", pixels)
    image = imageio.read_image(tmp_path / "a.exr")
    assert (image.exif, image.to_xyz, image.white_balance, image.saturation) == (Exif(), None, None, None)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb")
    assert imageio.read_image(tmp_path / "a.tif").saturation is None
    image = imageio.read_image(photographs.jpeg(tmp_path / "a.jpg", np.zeros((4, 5, 3), np.uint8)), transfer="srgb")
    assert image.exif == Exif(size=(4, 5))
    assert image.saturation == 1


def test_real_photograph(shared):
    path = next((shared / "real_sky").glob("helsinki_*.jpg"))
    image = imageio.read_image(path, transfer="srgb")
    assert image.pixels.shape == (1976, 4608, 3)
    assert image.exif.size == (1976, 4608)
    assert image.exif.time == datetime(2022, 8, 14, 11, 12, 31, tzinfo=UTC)
    assert exif.fov_deg(image.exif) is None  # no equivalent of its focal length
    red, green, blue = image.pixels[:200].mean((0, 1))
    assert blue > green > red


def test_heif_needs_its_transfer_function_and_its_library(tmp_path, monkeypatch):
    path = photographs.heif(tmp_path / "a.heic", np.full((64, 64, 3), 128, np.uint8))
    with pytest.raises(ImageError, match='state transfer = "srgb"'):
        imageio.read_image(path)
    value = ((128 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(imageio.read_image(path, transfer="srgb").pixels, value, rtol=1e-5)
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(ImageError, match=r"a\.heic: HEIF needs pillow-heif: pip install 'diffatmo\[heif\]'$"):
        imageio.read_image(path, transfer="srgb")


# --- Writing


def test_png_is_written_with_rounded_codes(tmp_path):
    rgb = np.array([[[0.0, 0.5, 1.0], [-1.0, 2.0, np.nan]]])
    imageio.write_png(tmp_path / "a.png", rgb)
    with Pillow.open(tmp_path / "a.png") as file:
        np.testing.assert_array_equal(np.asarray(file), [[[0, 128, 255], [0, 255, 0]]])


def test_nothing_is_overwritten_unless_asked(tmp_path, pixels):
    for write, name in ((imageio.write_exr, "a.exr"), (imageio.write_png, "a.png")):
        write(tmp_path / name, pixels)
        before = (tmp_path / name).read_bytes()
        with pytest.raises(ImageError, match="exists already"):
            write(tmp_path / name, 1 - pixels)
        assert (tmp_path / name).read_bytes() == before
        write(tmp_path / name, 1 - pixels, overwrite=True)
        assert (tmp_path / name).read_bytes() != before


def test_a_failed_write_leaves_nothing_behind(tmp_path):
    (tmp_path / "a.txt").write_text("old")

    def fail():
        with imageio.atomic_write(tmp_path / "a.txt", overwrite=True) as temporary:
            temporary.write_text("half")
            raise KeyError("interrupted")

    with pytest.raises(KeyError):
        fail()
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


@pytest.mark.parametrize(
    ("shape", "wavelengths", "message"),
    [
        ((4, 5), None, "pixels of shape"),
        ((0, 5, 3), None, "pixels of shape"),
        ((4, 5, 7), None, "7 channels without wavelengths"),
        ((4, 5, 3), [400, 500], "2 wavelengths for 3 channels"),
        ((4, 5, 4), [400, 400, 500, 600], "two channels have the same wavelength"),
    ],
)
def test_bad_exr_requests(tmp_path, shape, wavelengths, message):
    with pytest.raises(ImageError, match=message):
        imageio.write_exr(tmp_path / "a.exr", np.zeros(shape), wavelengths=wavelengths)


def test_no_folder_to_write_to(tmp_path, pixels):
    with pytest.raises(ImageError, match="there is no folder"):
        imageio.write_exr(tmp_path / "nowhere" / "a.exr", pixels)
    (tmp_path / "folder").mkdir()
    with pytest.raises(ImageError, match="cannot be written"):
        imageio.write_exr(tmp_path / "folder", pixels, overwrite=True)


# --- Broken files


def exr_bytes(tmp_path, header=None, planes=None):
    path = tmp_path / "made.exr"
    OpenEXR.File(header or {}, planes or dict.fromkeys("RGB", RNG.random((40, 50), dtype=np.float32))).write(str(path))
    return path.read_bytes()


def tiff_bytes(tmp_path):
    tifffile.imwrite(tmp_path / "made.tif", np.zeros((9, 9, 3), np.uint16), photometric="rgb")
    return (tmp_path / "made.tif").read_bytes()


def resized(data, width, height):
    start = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    return data[:start] + window + data[start + 16 :]


RGBE = np.full((20, 20, 4), 128, np.uint8)
CODES = np.zeros((3, 4, 3), np.uint16)
BROKEN = {
    "empty": (lambda tmp: b"", "the file is empty"),
    "text": (lambda tmp: b"hello, sky", "not an image of a known format"),
    "exr, header cut": (lambda tmp: exr_bytes(tmp)[:100], "header is damaged or cut short"),
    "exr, signature only": (lambda tmp: exr_bytes(tmp)[:4], "header is damaged or cut short"),
    "exr, pixels cut": (lambda tmp: exr_bytes(tmp)[:2000], "cut short or damaged"),
    "exr, last byte cut": (lambda tmp: exr_bytes(tmp)[:-1], "cut short or damaged"),
    "exr, absurd size": (lambda tmp: resized(exr_bytes(tmp), 100_000, 100_000), "claims 100000 x 100000 pixels"),
    "exr, depth only": (
        lambda tmp: exr_bytes(tmp, planes={"Z": np.zeros((4, 5), "f")}),
        "channels Z, expected R, G, B or Y",
    ),
    "exr, all NaN": (
        lambda tmp: exr_bytes(tmp, planes={"Y": np.full((4, 5), np.nan, "f")}),
        "not one pixel is a finite number",
    ),
    "exr, crop": (
        lambda tmp: exr_bytes(tmp, {"displayWindow": (np.array([0, 0], "i"), np.array([99, 99], "i"))}),
        "holds a crop",
    ),
    "exr, wavelengths": (
        lambda tmp: exr_bytes(tmp, {"wavelengths_nm": "400 500"}),
        "2 wavelengths in the header for 3",
    ),
    "exr, not wavelengths": (
        lambda tmp: exr_bytes(tmp, {"wavelengths_nm": "red"}),
        "'red' in the header, expected num",
    ),
    "hdr, header cut": (lambda tmp: radiance_file(RGBE)[:20], "header does not end"),
    "hdr, no size": (lambda tmp: b"#?RADIANCE\n\nX 3 Y 4\n", "resolution line"),
    "hdr, turned": (lambda tmp: b"#?RADIANCE\n\n+X 3 -Y 4\n", "expected '-Y height"),
    "hdr, pixels cut": (lambda tmp: radiance_file(RGBE)[:-200], "ends before the last pixel"),
    "hdr, flat pixels cut": (lambda tmp: radiance_file(RGBE, compress=False)[:-1], "ends before the last pixel"),
    "hdr, run too long": (
        lambda tmp: radiance_file(RGBE).replace(b"\x02\x02\0\x14\x0a", b"\x02\x02\0\x14\x7f"),
        "goes past",
    ),
    "hdr, XYZ": (lambda tmp: radiance_file(RGBE, b"FORMAT=32-bit_rle_xyze\n"), "pixel format '32-bit_rle_xyze'"),
    "hdr, gamma": (lambda tmp: radiance_file(RGBE, b"GAMMA=2.2\n"), "GAMMA=2.2"),
    "hdr, absurd size": (lambda tmp: b"#?RADIANCE\n\n-Y 90000 +X 90000\n", "claims 90000 x 90000 pixels"),
    "hdr, zero size": (lambda tmp: b"#?RADIANCE\n\n-Y 0 +X 5\n", "has 5 x 0 pixels"),
    "png, cut": (lambda tmp: png_file(CODES)[:-20], "ends before the last pixel"),
    "png, damaged": (lambda tmp: png_file(CODES).replace(b"IDAT", b"IDAX", 1), "checksum of part 'IDAX'"),
    "png, pixels cut": (lambda tmp: png_file(CODES, cut=-12), "ends before the last pixel"),
    "png, not zlib": (lambda tmp: png_file(CODES).replace(b"x\x9c", b"xx"), "checksum"),
    "png, palette": (lambda tmp: png_file(CODES, kind=3), "indexed colours"),
    "png, interlaced": (lambda tmp: png_file(CODES, interlace=1), "interlaced"),
    "tiff, header cut": (lambda tmp: b"II*\0\x08\0\0\0", "TIFF header is damaged or cut short"),
    "tiff, pixels cut": (lambda tmp: tiff_bytes(tmp)[:-30], "TIFF cannot be decoded"),
    "jpeg, cut": (lambda tmp: b"\xff\xd8\xff\xe0\0\x10JFIF", "JPEG is damaged"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_files_give_one_clear_line(tmp_path, capfd, case):
    make, message = BROKEN[case]
    path = tmp_path / "picture"
    path.write_bytes(make(tmp_path))
    with pytest.raises(ImageError) as caught:
        imageio.read_image(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert message in text
    assert "\n" not in text
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""


def test_unreadable_paths(tmp_path):
    with pytest.raises(ImageError, match="No such file"):
        imageio.read_image(tmp_path / "nothing.exr")
    with pytest.raises(ImageError, match="is a folder"):
        imageio.read_image(tmp_path)
    with pytest.raises(ImageError, match="is not a file"):
        imageio.read_image(os.devnull)
    (tmp_path / "two\nlines.exr").write_bytes(b"x")
    with pytest.raises(ImageError, match=r"^'.*two\\nlines\.exr': not an image"):
        imageio.read_image(tmp_path / "two\nlines.exr")


def test_transfer_functions_that_cannot_be(tmp_path, pixels):
    imageio.write_exr(tmp_path / "a.exr", pixels)
    with pytest.raises(ImageError, match=r"transfer = 'srgb' contradicts"):
        imageio.read_image(tmp_path / "a.exr", transfer="srgb")
    with pytest.raises(ImageError, match=r"transfer = 'log', expected linear or srgb"):
        imageio.read_image(tmp_path / "a.exr", transfer="log")
    np.testing.assert_array_equal(imageio.read_image(tmp_path / "a.exr", transfer="linear").pixels, pixels)


def test_unknown_row_filter():
    parts = codecs.png_chunks(png_file(CODES))
    rows = bytearray(zlib.decompress(parts.rows))
    rows[0] = 9
    with pytest.raises(ValueError, match="unknown row filter"):
        codecs.png(parts._replace(rows=zlib.compress(bytes(rows))))
