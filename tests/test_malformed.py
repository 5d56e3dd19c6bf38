"""Damaged, lying and hostile files: no crash, no hang, no memory, one clear line each.

Files are made from valid ones of every format, always the same, and read by one other process with a limit of 4 GB, so that
a decoder that brings its process down is seen.
"""

import json
import os
import struct
import subprocess
import sys
import warnings
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import photographs
import pytest
import tifffile
from photographs import CAMERA, FIRST, GPS, exif_block
from read_all import MEMORY
from test_imageio import png_chunk, png_file, radiance_file, resized

from diffatmo.cli.main import main

ROOT = Path(__file__).parent.parent
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
SECONDS = 10
"""A file may take so long."""

RNG = np.random.default_rng(7)
CODES = RNG.integers(0, 256, (24, 32, 3), dtype=np.uint8)
COUNTS = RNG.integers(130, 4000, (48, 64)).astype(np.uint16)
BLOCK = exif_block(FIRST, CAMERA, GPS)


def valid(folder: Path) -> dict[str, bytes]:
    """A file of each format. Of those whose name begins with "linear" the transfer function is not stated."""

    def made(name, write, *args, **options):
        write(folder / name, *args, **options)
        return (folder / name).read_bytes()

    floats = CODES.astype(np.float32) / 255
    exr = lambda path, **header: OpenEXR.File(
        header, dict(zip("RGB", np.moveaxis(floats, -1, 0).copy(), strict=True))
    ).write(str(path))
    rgbe = np.dstack([CODES, np.full((24, 32), 128, np.uint8)])
    return {
        "linear.exr": made("a.exr", exr),
        "linear_piz.exr": made("b.exr", exr, compression=OpenEXR.PIZ_COMPRESSION),
        "linear.hdr": radiance_file(rgbe),
        "8.png": png_file(CODES, extra=png_chunk(b"eXIf", BLOCK[6:])),
        "16.png": png_file(CODES.astype(np.uint16) * 257),
        "plain.tif": made("a.tif", tifffile.imwrite, CODES, photometric="rgb", rowsperstrip=8),
        "deflated.tif": made("b.tif", tifffile.imwrite, CODES, photometric="rgb", compression="zlib", rowsperstrip=8),
        "tiled.tif": made("c.tif", tifffile.imwrite, COUNTS, tile=(16, 16), compression="zlib"),
        "baseline.jpg": made("a.jpg", photographs.jpeg, CODES, BLOCK),
        "progressive.jpg": made("b.jpg", photographs.jpeg, CODES, BLOCK, progressive=True),
        "a.heic": made("a.heic", photographs.heif, CODES, BLOCK),
        "linear.dng": made("a.dng", photographs.dng, COUNTS),
    }


def fuzzed(name: str, data: bytes) -> dict[str, bytes]:
    """Truncations, random bytes in the header and anywhere, a hole, and what belongs to another format behind the signature."""
    generator = np.random.default_rng(zlib.crc32(name.encode()))
    cases = {}
    for part in (0.02, 0.1, 0.3, 0.6, 0.95):
        cases[f"cut_{part}"] = data[: int(len(data) * part)]
    cases["cut_1"] = data[:-1]
    for number in range(6):
        broken = bytearray(data)
        for at in generator.integers(4, min(len(data), 250), 3):
            broken[at] = generator.integers(256)
        cases[f"header_{number}"] = bytes(broken)
    for number in range(3):
        broken = bytearray(data)
        for at in generator.integers(4, len(data), 20):
            broken[at] ^= 1 << generator.integers(8)
        cases[f"bits_{number}"] = bytes(broken)
    cases["ones"] = data[:16] + b"\xff" * 200 + data[216:]
    cases["hole"] = data[: len(data) // 3] + bytes(len(data) // 3) + data[2 * len(data) // 3 :]
    cases["noise"] = data[:12] + generator.integers(0, 256, 5000, dtype=np.uint8).tobytes()
    stem, suffix = name.split(".")
    return {f"{stem}_{case}.{suffix}": broken for case, broken in cases.items()}


# --- Headers that lie


def png_with(width, height, bits=8, kind=2, rows=b"", extra=b"", method=0):
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, kind, method, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + extra + png_chunk(b"IDAT", rows) + png_chunk(b"IEND", b"")


def tiff_with(tags, order="<", behind=b"", following=0):
    """A TIFF of one directory: tag -> (type, values), or (type, count, what is in the place of the value)."""
    packed = b""
    for tag, (form, *values) in sorted(tags.items()):
        count, inline = values if len(values) == 2 else (len(values[0]), values[0])
        if not isinstance(inline, bytes):
            inline = struct.pack(order + {3: "H", 4: "I"}[form] * len(inline), *inline)
        packed += struct.pack(order + "HHI", tag, form, count) + inline.ljust(4, b"\0")[:4]
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "IH", 8, len(tags))
    return head + packed + struct.pack(order + "I", following) + behind


def rgb_tiff(width=8, height=8, *, stored=192, at=170, bits=8, samples=3, compression=1, **more):
    tags = {
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [bits]),
        259: (3, [compression]),
        262: (3, [2]),
        273: (4, [at]),
        277: (3, [samples]),
        278: (4, [height]),
        279: (4, [stored]),
    }
    return tiff_with({**tags, **more.pop("tags", {})}, behind=more.pop("behind", bytes(300)), **more)


def jpeg_with(data, *, width=None, height=None, components=None):
    start = data.index(b"\xff\xc0") if b"\xff\xc0" in data else data.index(b"\xff\xc2")
    old = struct.unpack_from(">HHB", data, start + 5)
    new = [value if value is not None else was for value, was in zip((height, width, components), old, strict=True)]
    return data[: start + 5] + struct.pack(">HHB", *new) + data[start + 10 :]


def replaced(data, old, new):
    assert old in data
    return data.replace(old, new, 1)


def dng_with(data, tag, *numbers, form=None):
    """A DNG with other numbers in a tag: inline, or where the tag points to."""
    data = bytearray(data)
    (at,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, at)
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        found, kind, length = struct.unpack_from("<HHI", data, entry)
        if found == tag:
            code = form or {1: "B", 3: "H", 4: "I", 5: "I", 10: "i"}[kind]
            stored = struct.pack(f"<{len(numbers)}{code}", *numbers)
            size = {1: 1, 3: 2, 4: 4, 5: 8, 10: 8}[kind] * length
            place = entry + 8 if size <= 4 else struct.unpack_from("<I", data, entry + 8)[0]
            data[place : place + len(stored)] = stored
            return bytes(data)
    raise AssertionError(tag)


def lying(whole: dict[str, bytes]) -> dict[str, bytes]:
    """Files whose headers claim what cannot be, or what nobody wants."""
    million = zlib.compress(bytes(10**6))
    bomb = zlib.compress(bytes(200 * 10**6), 9)
    exr, hdr, jpg, dng, heic = (whole[f] for f in ("linear.exr", "linear.hdr", "baseline.jpg", "linear.dng", "a.heic"))
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n"
    cases = {
        "png_absurd.png": png_with(2**31 - 1, 2**31 - 1),
        "png_large.png": png_with(12000, 12000, rows=million),
        "png_large_16.png": png_with(12000, 12000, 16, 6, rows=million),
        "png_no_size.png": png_with(0, 5),
        "png_rows_inflate.png": png_with(4, 3, rows=bomb),
        "png_profile_inflates.png": png_with(
            4, 3, extra=png_chunk(b"iCCP", b"x\0\0" + bomb), rows=zlib.compress(bytes(39))
        ),
        "png_text_inflates.png": png_with(
            4, 3, extra=png_chunk(b"zTXt", b"x\0\0" + bomb), rows=zlib.compress(bytes(39))
        ),
        "png_filter_9.png": png_with(1, 1, rows=zlib.compress(b"\x09abc")),
        "png_kind_7.png": png_with(1, 1, kind=7, rows=million),
        "png_1_bit.png": png_with(1, 1, bits=1, rows=million),
        "png_two_headers.png": png_with(1, 1, extra=png_chunk(b"IHDR", bytes(13)), rows=million),
        "png_chunk_2_gb.png": png_with(4, 3)[:33] + b"\x7f\xff\xff\xffIDAT" + bytes(99),
        "png_100000_parts.png": png_with(9, 9, extra=png_chunk(b"IDAT", b"") * 100_000, rows=million),
        "png_no_pixels.png": b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", bytes(13)) + png_chunk(b"IEND", b""),
        "png_exif_junk.png": png_file(CODES, extra=png_chunk(b"eXIf", b"II*\0\xff\xff\xff\xff" * 9)),
        "hdr_absurd.hdr": head + b"\n-Y 99999999999 +X 99999999999\n",
        "hdr_digits.hdr": head + b"\n-Y " + b"9" * 5000 + b" +X 4\n",
        "linear_large.hdr": head + b"\n-Y 12000 +X 12000\n\x02\x02" + struct.pack(">H", 12000) + bytes(90_000),
        "linear_short.hdr": head + b"\n-Y 8000 +X 8000\n\x02\x02" + struct.pack(">H", 8000) + bytes(90_000),
        "png_short.png": png_with(8000, 8000, rows=million),
        "linear_exposure_0.hdr": replaced(hdr, b"FORMAT", b"EXPOSURE=0\nFORMAT"),
        "linear_exposure_nan.hdr": replaced(hdr, b"FORMAT", b"EXPOSURE=nan\nFORMAT"),
        "linear_exposure_word.hdr": replaced(hdr, b"FORMAT", b"EXPOSURE=bright\nFORMAT"),
        "linear_corrections.hdr": replaced(hdr, b"FORMAT", b"COLORCORR=" + b"1 " * 50 + b"\nFORMAT"),
        "linear_gamma.hdr": replaced(hdr, b"FORMAT", b"GAMMA=\nFORMAT"),
        "linear_header_of_zeros.hdr": b"#?" + bytes(100_000),
        "linear_absurd.exr": resized(exr, 2**31 - 1, 2**31 - 1),
        "linear_large.exr": resized(exr, 12000, 12000),
        "linear_negative.exr": resized(exr, -5, 8),
        "linear_compression_99.exr": replaced(
            exr, b"compression\0compression\0\1\0\0\0\3", b"compression\0compression\0\1\0\0\0\x63"
        ),
        "linear_attribute.exr": replaced(exr, b"dataWindow\0box2i\0\x10\0\0\0", b"dataWindow\0box2i\0\xff\xff\xff\x7f"),
        "linear_channel.exr": replaced(exr, b"R\0\2\0\0\0", b"R\0\x77\0\0\0"),
        "linear_version.exr": exr[:4] + b"\xff\xff\xff\xff" + exr[8:],
        "tiff_absurd.tif": rgb_tiff(2**32 - 1, 2**32 - 1),
        "tiff_large.tif": rgb_tiff(12000, 12000, stored=588_000_000),
        "tiff_short.tif": rgb_tiff(8000, 8000, stored=192_000_000),
        "tiff_one_strip_for_all.tif": rgb_tiff(
            12000, 10000, tags={278: (4, [1]), 273: (4, 10000, [8]), 279: (4, 10000, [8])}
        ),
        "tiff_no_size.tif": rgb_tiff(0, 0),
        "tiff_strip_beyond.tif": rgb_tiff(at=2**32 - 10),
        "tiff_strip_too_long.tif": rgb_tiff(stored=2**32 - 1),
        "tiff_strip_empty.tif": rgb_tiff(stored=0),
        "tiff_samples.tif": rgb_tiff(samples=65535),
        "tiff_bits.tif": rgb_tiff(bits=65535),
        "tiff_64_bits.tif": rgb_tiff(9000, 9000, bits=64),
        "tiff_compression.tif": rgb_tiff(compression=65000),
        "tiff_lzw.tif": rgb_tiff(compression=5),
        "tiff_packbits.tif": rgb_tiff(compression=32773),
        "tiff_deflated_junk.tif": rgb_tiff(compression=8),
        "tiff_inflates.tif": rgb_tiff(compression=8, stored=len(bomb), behind=bytes(48) + bomb),
        "tiff_rows_0.tif": rgb_tiff(tags={278: (4, [0])}),
        "tiff_tile_0.tif": rgb_tiff(tags={322: (4, [0]), 323: (4, [0]), 324: (4, [8]), 325: (4, [8])}),
        "tiff_tile_1.tif": rgb_tiff(9000, 9000, tags={322: (4, [1]), 323: (4, [1]), 324: (4, [8]), 325: (4, [8])}),
        "tiff_next_is_itself.tif": rgb_tiff(following=8),
        "tiff_below_is_itself.tif": rgb_tiff(tags={330: (4, [8])}),
        "tiff_exif_is_itself.tif": rgb_tiff(tags={34665: (4, [8]), 34853: (4, [8])}),
        "tiff_offsets_of_2_32.tif": rgb_tiff(tags={273: (4, 2**32 - 1, [8])}),
        "tiff_text_of_4_gb.tif": rgb_tiff(tags={270: (2, 2**32 - 1, struct.pack("<I", 8))}),
        "tiff_type_999.tif": replaced(rgb_tiff(), struct.pack("<HH", 256, 4), struct.pack("<HH", 256, 999)),
        "tiff_entries_65535.tif": b"II*\0\x08\0\0\0\xff\xff" + bytes(range(256)) * 100,
        "tiff_directory_beyond.tif": b"II*\0\xff\xff\xff\xff" + bytes(50),
        "tiff_directory_in_header.tif": b"II*\0\x02\0\0\0" + bytes(50),
        "tiff_big.tif": b"II+\0\x08\0\0\0" + b"\xff" * 50,
        "tiff_complex.tif": rgb_tiff(tags={339: (3, [6])}),
        "jpeg_absurd.jpg": jpeg_with(jpg, width=65535, height=65535),
        "jpeg_large.jpg": jpeg_with(jpg, width=8000, height=8000),
        "jpeg_no_height.jpg": jpeg_with(jpg, height=0),
        "jpeg_255_components.jpg": jpeg_with(jpg, components=255),
        "jpeg_no_tables.jpg": replaced(jpg, b"\xff\xdb", b"\xff\xfe"),
        "jpeg_many_scans.jpg": many_scans(jpeg_with(whole["progressive.jpg"], width=8000, height=8000)),
        "jpeg_ends_in_marker.jpg": b"\xff\xd8\xff",
        "jpeg_length_0.jpg": b"\xff\xd8\xff\xe1\0\0" + jpg[2:],
        "jpeg_mpo_junk.jpg": jpg[:2] + b"\xff\xe2\0\x20MPF\0" + b"\xff" * 26 + jpg[2:],
        "jpeg_twice.jpg": jpg + jpg,
        "heic_absurd.heic": ispe(heic, 2**31 - 1, 2**31 - 1),
        "heic_large.heic": ispe(heic, 12000, 12000),
        "heic_no_size.heic": ispe(heic, 0, 0),
        "heic_other_size.heic": ispe(heic, 64, 48),
        "heic_box_0.heic": heic[:24] + bytes(4) + heic[28:],
        "heic_box_2_63.heic": heic[:24] + b"\0\0\0\1meta\x7f" + b"\xff" * 7 + heic[40:],
        "heic_brand.heic": heic[:8] + b"avif" + heic[12:],
        "heic_bare.heic": heic[:24],
        "linear_crx.cr3": heic[:8] + b"crx " + heic[12:],
        "linear_absurd.dng": dng_with(dng_with(dng, 256, 2**31 - 1), 257, 2**31 - 1),
        "linear_large.dng": dng_with(dng_with(dng, 256, 12000), 257, 12000),
        "linear_no_size.dng": dng_with(dng, 256, 0),
        "linear_white_0.dng": dng_with(dng, 0xC61D, 0),
        "linear_black_is_white.dng": dng_with(dng, 0xC61A, 4000, 4000, 4000, 4000),
        "linear_neutral_0.dng": dng_with(dng, 0xC628, *[0] * 6),
        "linear_matrix_0.dng": dng_with(dng, 0xC621, *[0] * 18),
        "linear_matrix_of_nothing.dng": dng_with(dng, 0xC621, *[1, 0] * 9),
        "linear_pattern.dng": dng_with(dng, 0x828E, 9, 9, 9, 9),
        "linear_pattern_size.dng": dng_with(dng, 0x828D, 65535, 65535),
        "linear_bits.dng": dng_with(dng, 258, 65535),
        "linear_compression.dng": dng_with(dng, 259, 7),
        "linear_strip.dng": dng_with(dng, 273, 2**32 - 1),
        "linear_orientation.dng": dng_with(dng, 0x112, 999),
        "linear_foveon.x3f": b"FOVb" + b"\xff" * 5000,
        "linear_fuji.raf": b"FUJIFILMCCD-RAW " + b"\xff" * 5000,
        "linear_olympus.orf": b"IIRO" + b"\x08\0\0\0" + b"\xff" * 5000,
        "linear_panasonic.rw2": b"IIU\0" + b"\x08\0\0\0" + b"\xff" * 5000,
        "linear_minolta.mrw": b"\0MRM" + b"\xff" * 5000,
        "nothing.jpg": b"",
        "text.jpg": b"hello, sky\n" * 100,
        "web.jpg": b"<!DOCTYPE html><html>404 Not Found</html>",
        "zeros.tif": bytes(10_000),
        "gif.jpg": b"GIF89a" + bytes(100),
        "webp.jpg": b"RIFF\x10\0\0\0WEBPVP8 " + bytes(100),
        "jpeg_called.png": jpg,
        "new\nline.jpg": jpg[:50],
    }
    zero = ("2I", [(0, 0)] * 3)
    for name, camera, gps in (
        ("latitude_400", CAMERA, {**GPS, 2: ("2I", [(400, 1), (0, 1), (0, 1)])}),
        ("nowhere", CAMERA, {**GPS, 2: zero, 4: zero, 6: zero, 7: zero, 17: zero}),
        ("no_exposure", {**CAMERA, 0x829A: ("2I", [(1, 0)]), 0x829D: zero, 0x920A: zero}, GPS),
        ("no_date", {**CAMERA, 0x9003: ("s", b"9999:99:99 99:99:99\0"), 0x9011: ("s", b"+99:99\0")}, GPS),
        ("binary_date", {**CAMERA, 0x9003: ("s", b"\xff\xfe\0\n\r\x80"), 0x9011: ("s", b"\n\n\n\n")}, GPS),
        ("wrong_types", dict.fromkeys(CAMERA, ("s", b"what\x00")), {tag: ("H", [7]) for tag in GPS}),
    ):
        block = exif_block({**FIRST, 0x112: ("H", [65535])}, camera, gps)
        cases[f"jpeg_exif_{name}.jpg"] = replaced(jpg, BLOCK, block.ljust(len(BLOCK), b"\0")[: len(BLOCK)])
        cases[f"png_exif_{name}.png"] = png_file(CODES, extra=png_chunk(b"eXIf", block[6:]))
    return cases


def many_scans(data):
    """A progressive JPEG with its last scan a thousand times, and long enough for its pixels."""
    last, end = data.rindex(b"\xff\xda"), data.rindex(b"\xff\xd9")
    return data[:end] + 1000 * data[last:end] + data[end:] + bytes(200_000)


def ispe(data, width, height):
    """A HEIF that states another size."""
    at = data.index(b"ispe") + 8
    return data[:at] + struct.pack(">II", width, height) + data[at + 8 :]


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder, scratch = tmp_path_factory.mktemp("malformed"), tmp_path_factory.mktemp("valid")
    with warnings.catch_warnings(action="ignore"):
        whole = valid(scratch)
    cases = {**whole, **lying(whole)}
    for name, data in whole.items():
        cases |= fuzzed(name, data)
    for name, data in cases.items():
        (folder / name).write_bytes(data)
    return folder


@pytest.fixture(scope="module")
def reports(files) -> dict[str, dict]:
    done = subprocess.run(
        [sys.executable, ROOT / "tests" / "read_all.py", files],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        timeout=100,
    )
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"exit status {done.returncode} after {found[-1:]}: {done.stderr}"
    assert done.stderr == ""
    return {report["name"]: report for report in found}


def test_every_file_ends_in_a_picture_or_in_one_line(files, reports):
    names = {path.name for path in files.iterdir()}
    assert len(names) > 200
    assert set(reports) == names
    for name, report in reports.items():
        assert report["kind"] in ("image", "error"), report
        if report["kind"] == "error":
            assert report["text"].isprintable(), report
            assert Path(name).suffix in report["text"].split(": ")[0], report


def test_neither_time_nor_memory_runs_out(reports):
    slow = [report for report in reports.values() if report["seconds"] > SECONDS]
    assert not slow
    assert max(report["peak"] for report in reports.values()) < MEMORY


def test_whole_files_are_read(reports):
    stems = ("linear", "linear_piz", "8", "16", "plain", "deflated", "tiled", "baseline", "progressive", "a")
    whole = [name for name in reports if name.split(".")[0] in stems]
    assert len(whole) == 12
    assert all(reports[name]["kind"] == "image" for name in whole)


def test_broken_notes_do_not_spoil_a_picture(reports):
    noted = [report for name, report in reports.items() if "_exif_" in name and name[0] in "jp"]
    assert len(noted) == 13
    assert {report["kind"] for report in noted} == {"image"}


LIES = {
    "png_absurd.png": "claims 2147483647 x 2147483647 pixels",
    "png_large.png": "pixels, and the file has 1,048 bytes: not a photograph",
    "linear_large.hdr": "not a photograph",
    "linear_short.hdr": "ends before the last pixel",
    "png_short.png": "ends before the last pixel",
    "linear_exposure_0.hdr": "EXPOSURE=0 in the header, expected a positive number",
    "linear_absurd.exr": "the EXR header is damaged",
    "linear_large.exr": "claims 12000 x 12000 pixels",
    "tiff_absurd.tif": "claims 4294967295 x 4294967295 pixels",
    "tiff_short.tif": "strips are not as long as its pixels, or go beyond the file",
    "tiff_inflates.tif": "a strip holds more than its pixels",
    "tiff_compression.tif": "the compression 65000, expected none, deflate, LZW or PackBits",
    "jpeg_absurd.jpg": "the header claims too many pixels",
    "jpeg_large.jpg": "ends before the last pixel",
    "jpeg_many_scans.jpg": "scans of 8000 x 8000 pixels, which takes too long",
    "heic_absurd.heic": "HEIF is damaged",
    "linear_absurd.dng": "RAW",
    "web.jpg": "not an image of a known format",
    "nothing.jpg": "the file is empty",
}


@pytest.mark.parametrize("name", LIES)
def test_lies_are_told(reports, name):
    assert reports[name]["kind"] == "error"
    assert LIES[name] in reports[name]["text"]


@pytest.mark.parametrize("name", ["baseline_cut_0.3.jpg", "png_absurd.png", "tiff_inflates.tif", "linear_absurd.dng"])
def test_the_command_says_it_in_one_line(files, tmp_path, capfd, name):
    assert main(["fit", str(files / name), "-o", str(tmp_path / "out")]) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert str(files / name) in err
    assert not (tmp_path / "out").exists()
