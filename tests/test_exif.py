"""What a camera notes: read where it is true, None where it cannot be."""

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import photographs
import pytest
from photographs import CAMERA, FIRST, GPS, exif_block
from PIL import Image as Pillow
from PIL import ImageOps

from diffatmo import exif
from diffatmo.exif import Exif

EVERYTHING = Exif(
    orientation=1,
    focal_length_mm=5.5,
    focal_length_35mm_mm=26,
    exposure_s=1 / 500,
    f_number=2.8,
    iso=200,
    time=datetime(2024, 6, 21, 12, 30, 15, tzinfo=timezone(timedelta(hours=2))),
    latitude_deg=-(33 + 51 / 60 + 30 / 3600),
    longitude_deg=-70.5,
    altitude_m=-12.5,
    compass_deg=350.5,
    compass_is_magnetic=False,
    make="A maker",
    model="A camera",
    lens="A lens",
)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("prefix", [True, False])
def test_everything(order, prefix):
    block = exif_block(FIRST, CAMERA, GPS, order)
    assert exif.parse(block if prefix else block[6:]) == EVERYTHING


def test_what_another_library_writes():
    picture = Pillow.new("RGB", (2, 2)).getexif()
    picture[0x10F] = "A maker"
    picture.get_ifd(0x8769).update({0x829A: 0.002, 0x8827: 200, 0x9003: "2024:06:21 12:30:15"})
    picture.get_ifd(0x8825).update({1: "N", 2: (48.0, 30.0, 36.0), 3: "E", 4: (11.0, 15.0, 0.0)})
    found = exif.parse(picture.tobytes())
    assert (found.make, found.iso, found.local_time) == ("A maker", 200, datetime(2024, 6, 21, 12, 30, 15))
    assert found.exposure_s == pytest.approx(0.002)
    assert (found.latitude_deg, found.longitude_deg) == (pytest.approx(48.51), pytest.approx(11.25))


def test_a_real_photograph(shared):
    with Pillow.open(shared / "real_sky" / "helsinki_20220814T111231Z_HMD_Nokia_8.3_5G.jpg") as file:
        found = exif.parse(file.info["exif"])
    assert found.time == datetime(2022, 8, 14, 11, 12, 31, tzinfo=UTC)
    assert found.time.utcoffset() == timedelta(hours=3)
    # Seconds of arc with two decimals: 3e-6 degrees.
    assert found.latitude_deg == pytest.approx(60.14671, abs=1e-5)
    assert found.longitude_deg == pytest.approx(24.90677, abs=1e-5)
    assert (found.compass_deg, found.compass_is_magnetic) == (56, True)
    assert (found.focal_length_mm, found.focal_length_35mm_mm, found.iso) == (2.75, None, 100)
    assert (found.exposure_s, found.f_number) == (0.000541, 2.2)
    assert (found.make, found.model, found.lens, found.altitude_m) == ("HMD Global", "Nokia 8.3 5G", None, None)


def without(*tags):
    return dict.fromkeys(tags)


def times(camera=None, gps=None):
    """(time, local time) with some fields of the camera's clock and of the satellites' replaced, or None: left out."""
    kept = [{k: v for k, v in {**all_, **(new or {})}.items() if v} for all_, new in ((CAMERA, camera), (GPS, gps))]
    found = exif.parse(exif_block(FIRST, *kept))
    return found.time, found.local_time


def test_time_is_from_the_offset_then_from_satellites_then_local():
    local = datetime(2024, 6, 21, 12, 30, 15)
    offset = local.replace(tzinfo=timezone(timedelta(hours=2)))
    satellites = datetime(2024, 6, 21, 10, 30, 12, tzinfo=UTC)
    assert times() == (offset, None)
    assert times(without(0x9011)) == (satellites, None)
    assert times(without(0x9011, 0x9003)) == (satellites, None)
    assert times(without(0x9011), without(29)) == (None, local)
    assert times({0x9011: ("s", b"+99:00\0")}, without(7)) == (None, local)
    assert times(without(0x9011, 0x9003), without(7)) == (None, None)
    digitised = {0x9004: ("s", b"2024:06:21 12:30:15\0"), 0x9012: ("s", b"+02:00\0")}
    assert times({**digitised, **without(0x9003, 0x9011)}) == (offset, None)
    # Satellites a day off, and those without a fix, which count from the beginning of their weeks.
    assert times(without(0x9011), {29: ("s", b"2024:06:20\0")}) == (None, local)
    assert times(without(0x9011, 0x9003), {29: ("s", b"1980:01:06\0")}) == (None, None)


NOT_A_NUMBER, INFINITE = ("2I", [(0, 0)]), ("2I", [(1, 0)])
WRONG = {
    "orientation": [(FIRST, 0x112, ("H", [value])) for value in (0, 9, 65535)] + [(FIRST, 0x112, ("s", b"6\0"))],
    "exposure_s": [(CAMERA, 0x829A, value) for value in (NOT_A_NUMBER, INFINITE, ("2I", [(0, 1)]), ("s", b"1/500\0"))],
    "f_number": [(CAMERA, 0x829D, value) for value in (NOT_A_NUMBER, INFINITE, ("2I", [(0, 1)]))],
    "iso": [(CAMERA, 0x8827, ("H", [0])), (CAMERA, 0x8827, ("H", [65535]))],
    "focal_length_mm": [(CAMERA, 0x920A, value) for value in (NOT_A_NUMBER, INFINITE, ("2I", [(0, 1)]))],
    "focal_length_35mm_mm": [(CAMERA, 0xA405, ("H", [0])), (CAMERA, 0xA405, ("H", [65535]))],
    "lens": [(CAMERA, 0xA434, ("s", b" \0 x")), (CAMERA, 0xA434, ("H", [1, 2, 3]))],
    "latitude_deg": [
        (GPS, 2, ("2I", [(400, 1), (0, 1), (0, 1)])),
        (GPS, 2, ("2I", [(90, 1), (0, 1), (1, 1)])),
        (GPS, 2, ("2I", [(33, 1), (60, 1), (0, 1)])),
        (GPS, 2, ("2I", [(33, 1), (0, 0), (0, 1)])),
        (GPS, 2, ("2I", [(33, 1), (51, 1)])),
        (GPS, 1, ("s", b"\0")),
        (GPS, 1, ("s", b"E\0")),
        (GPS, 4, ("2I", [(181, 1), (0, 1), (0, 1)])),
        (GPS, 4, ("2I", [(70, 1), (0, 0), (0, 1)])),
    ],
    "altitude_m": [(GPS, 6, NOT_A_NUMBER), (GPS, 6, ("2I", [(4_000_000, 1)])), (GPS, 5, ("B", [7]))],
    "compass_deg": [(GPS, 17, NOT_A_NUMBER), (GPS, 17, ("2I", [(361, 1)]))],
    "time": [(CAMERA, 0x9003, ("s", text)) for text in (b"0000:00:00 00:00:00\0", b"    :  :     :  :  \0", b"now\0")],
    "make": [(FIRST, 0x10F, ("s", b"\0\0\0\0\0\0"))],
}
WRONG_CASES = [(name, *case) for name, cases in WRONG.items() for case in cases]


@pytest.mark.parametrize(("name", "where", "tag", "value"), WRONG_CASES)
def test_what_cannot_be_is_not_known(name, where, tag, value):
    parts = [{**part, tag: value} if part is where else part for part in (FIRST, CAMERA, GPS)]
    if name == "time":
        parts[2] = {key: entry for key, entry in GPS.items() if key != 7}
    found = exif.parse(exif_block(*parts))
    assert getattr(found, name) is None
    others = {"latitude_deg": ("longitude_deg",), "compass_deg": ("compass_is_magnetic",), "time": ("local_time",)}
    expected = EVERYTHING._replace(**dict.fromkeys((name, *others.get(name, ()))))
    assert found == expected


def test_no_fix_is_not_the_gulf_of_guinea():
    zero = ("2I", [(0, 1)] * 3)
    found = exif.parse(exif_block(FIRST, CAMERA, {**GPS, 2: zero, 4: zero}))
    assert found.latitude_deg is None
    assert found.longitude_deg is None


def test_sensitivity_of_more_than_16_bits():
    assert exif.parse(exif_block(FIRST, {**CAMERA, 0x8827: ("H", [65535]), 0x8832: ("I", [102400])})).iso == 102400


def test_texts_are_one_line():
    assert exif.parse(exif_block({0x110: ("s", b" A\ncamera\x1b[0m \0junk")})).model == "A camera [0m"


def test_damaged_blocks_never_raise_nor_lie():
    """Every truncation gives some of the fields; a flip of any bit gives what it gives, in bounds."""
    block = exif_block(FIRST, CAMERA, GPS)
    for end in range(len(block)):
        found = exif.parse(block[:end])
        assert all(
            value in (None, true) for value, true in zip(found, EVERYTHING, strict=True) if not_text(value, true)
        )
    for byte in range(len(block)):
        for bit in range(8):
            found = exif.parse(block[:byte] + bytes([block[byte] ^ 1 << bit]) + block[byte + 1 :])
            assert found.latitude_deg is None or abs(found.latitude_deg) <= 90
            assert found.orientation in (None, *range(1, 9))
            assert found.exposure_s is None or 0 < found.exposure_s < 1e6


def not_text(value, true):
    # Where the offset or the clock is cut off, the other gives the time.
    return not isinstance(value, datetime) and not isinstance(true, datetime)


def test_loops_end_and_lengths_that_lie_cost_nothing():
    itself = exif_block({**FIRST, 0x8769: ("I", [8]), 0x8825: ("I", [8])})
    assert exif.parse(itself).make == "A maker"
    block = bytearray(exif_block({0x10F: ("s", b"A maker\0")}))
    at = block.index(b"\x0f\x01\x02\0") + 4
    block[at : at + 4] = b"\xff\xff\xff\xff"
    assert exif.parse(bytes(block)).make is None
    assert exif.parse(b"") == exif.parse(b"II*\0") == exif.parse(b"junk" * 9) == Exif()


# --- Orientation and field of view


@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright(orientation):
    codes = np.arange(24, dtype=np.uint8).reshape(4, 6)
    picture = Pillow.fromarray(codes)
    picture.getexif()[0x112] = orientation
    np.testing.assert_array_equal(exif.upright(codes, orientation), np.asarray(ImageOps.exif_transpose(picture)))


def test_field_of_view():
    """A full frame camera's 24 mm lens: 2 atan(36 / 48) across, 2 atan(24 / 48) high; upright, the other way round."""
    notes = Exif(focal_length_35mm_mm=24.0, size=(2000, 3000))
    across, high = 2 * np.degrees(np.arctan(36 / 48)), 2 * np.degrees(np.arctan(0.5))
    assert exif.fov_deg(notes) == pytest.approx((high, across))
    assert exif.vertical_fov_deg(notes) == pytest.approx(high)
    assert exif.fov_deg(notes._replace(size=(3000, 2000))) == pytest.approx((across, high))


def test_field_of_view_of_other_shapes_is_by_the_diagonal():
    fov = exif.fov_deg(Exif(focal_length_35mm_mm=26.0, size=(3000, 4000)))
    diagonal = np.hypot(*np.tan(np.radians(fov) / 2))
    assert diagonal == pytest.approx(np.hypot(36, 24) / 2 / 26)
    assert exif.fov_deg(Exif(size=(3, 4))) is None
    assert exif.vertical_fov_deg(Exif(focal_length_35mm_mm=26.0)) is None


def test_photographs_are_what_they_seem(tmp_path):
    """The helpers of these tests, by another reader."""
    path = photographs.jpeg(tmp_path / "a.jpg", np.zeros((4, 6, 3), np.uint8), exif_block(FIRST, CAMERA, GPS))
    with Pillow.open(path) as file:
        read = file.getexif()
        assert read[0x10F] == "A maker"
        assert read.get_ifd(0x8769)[0x829A] == 1 / 500
        assert read.get_ifd(0x8825)[1] == "S"
