"""Scans: files that say what they are, a camera of single directions, and files that are nothing."""

import io
import math
import pickle
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import scan, spectrum
from diffatmo.camera import CameraError
from diffatmo.scan import Scan, ScanError

DEG = math.pi / 180
SAMPLES, CHANNELS = 5, 4


def columns(**changes):
    """The arrays of a good scan, some of them changed, None for left out."""
    random = np.random.default_rng(0)
    good = {
        "wavelength_nm": np.array([400.0, 500.0, 600.0, 700.0]),
        "radiance": random.uniform(0.01, 0.1, (SAMPLES, CHANNELS)),
        "view_zenith_deg": np.array([0.0, 20.0, 40.0, 60.0, 80.0]),
        "view_azimuth_deg": np.array([0.0, 90.0, 180.0, 270.0, -45.0]),
        "sun_zenith_deg": np.linspace(30, 31, SAMPLES),
        "sun_azimuth_deg": np.linspace(200, 202, SAMPLES),
    }
    return {name: value for name, value in (good | changes).items() if value is not None}


def npz(path, **changes):
    np.savez(path, **columns(**changes))
    return path


def table(**changes):
    """The same as a CSV."""
    data = columns(**changes)
    if "radiance" in data and "wavelength_nm" in data:
        names = [f"radiance_{nm:g}" for nm in data.pop("wavelength_nm")]
        data |= dict(zip(names, data.pop("radiance").T, strict=True))
    rows = [",".join(data)] + [",".join(repr(float(x)) for x in row) for row in zip(*data.values(), strict=True)]
    return "\n".join(rows) + "\n"


# Files --------------------------------------------------------------------------------------------------------------


def same(ours, theirs):
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_was_written_is_read(tmp_path):
    """From an .npz and from a CSV, in degrees and in radians, with comments and a byte order mark."""
    found = scan.read(npz(tmp_path / "a.npz"))
    wanted = columns()
    np.testing.assert_array_equal(found.radiance, wanted["radiance"])
    np.testing.assert_array_equal(found.wavelengths, wanted["wavelength_nm"])
    for name in ("view_zenith", "view_azimuth", "sun_zenith", "sun_azimuth"):
        np.testing.assert_allclose(getattr(found, name), wanted[f"{name}_deg"] * DEG, rtol=1e-15)
    np.testing.assert_allclose(found.irradiance, spectrum.solar_irradiance(wanted["wavelength_nm"]), rtol=1e-6)
    assert found.albedo is None
    assert found.fov == pytest.approx(scan.FOV_DEG * DEG)
    text = tmp_path / "a.csv"
    text.write_text("\ufeff# a clear day\n" + table(), encoding="utf-8")
    same(scan.read(text), found)


def test_one_sun_for_all(tmp_path):
    found = scan.read(npz(tmp_path / "a.npz", sun_zenith_deg=30.0, sun_azimuth_deg=np.array([200.0])))
    np.testing.assert_allclose(found.sun_zenith, np.full(SAMPLES, 30 * DEG))
    np.testing.assert_allclose(found.sun_azimuth, np.full(SAMPLES, 200 * DEG))


def test_samples_that_are_not_valid_are_left_out(tmp_path):
    valid = np.array([True, False, True, True, False])
    whole = scan.read(npz(tmp_path / "a.npz"))
    part = scan.read(npz(tmp_path / "b.npz", valid=valid))
    np.testing.assert_array_equal(part.radiance, whole.radiance[valid])
    for name in ("view_zenith", "view_azimuth", "sun_zenith", "sun_azimuth"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[valid])
    (tmp_path / "b.csv").write_text(table(valid=valid))
    same(scan.read(tmp_path / "b.csv"), part)


def test_channels_beyond_the_known_spectrum_of_the_sun_are_left_out(tmp_path):
    found = scan.read(npz(tmp_path / "a.npz", wavelength_nm=np.array([350.0, 500.0, 600.0, 900.0])))
    np.testing.assert_array_equal(found.wavelengths, [500, 600])
    np.testing.assert_array_equal(found.radiance, columns()["radiance"][:, 1:3])
    assert found.irradiance.shape == (2,)


def test_what_the_instrument_says_of_the_sun_the_ground_and_itself(tmp_path):
    one_au = np.array([1.5, 1.9, 1.8, 1.4])
    grass = {"grass_albedo": np.array([0.05, 0.3]), "grass_albedo_wavelength_nm": np.array([500.0, 800.0])}
    found = scan.read(
        npz(tmp_path / "a.npz", solar_irradiance_1au=one_au, earth_sun_au=1.0131, fov_deg=2.0, **grass)
    )  # fmt: skip
    # The inverse square of the distance.
    np.testing.assert_allclose(found.irradiance, one_au / 1.0131**2, rtol=1e-14)
    np.testing.assert_array_equal(found.albedo, [[500, 800], [0.05, 0.3]])
    assert found.fov == pytest.approx(2 * DEG)
    # So it falls off for the standard spectrum.
    standard = scan.read(npz(tmp_path / "c.npz", earth_sun_au=1.0131))
    np.testing.assert_allclose(
        standard.irradiance, spectrum.solar_irradiance(columns()["wavelength_nm"]) / 1.0131**2, rtol=1e-6
    )
    assert found.own_sun
    assert not standard.own_sun
    # The irradiance at the time is what counts, if both are given, and an albedo without wavelengths is at the channels'.
    both = scan.read(
        npz(tmp_path / "b.npz", solar_irradiance=2 * one_au, solar_irradiance_1au=one_au, ground_albedo=np.full(4, 0.2))
    )
    np.testing.assert_array_equal(both.irradiance, 2 * one_au)
    np.testing.assert_array_equal(both.albedo, [columns()["wavelength_nm"], np.full(4, 0.2)])


def test_a_measured_sky(shared):
    path = shared / "measured" / "ithaca_2013_05_27_1145.npz"
    if not path.is_file():
        pytest.skip(f"no {path.name} among the reference data")
    found = scan.read(path)
    assert found.radiance.shape == (80, 95)
    assert (found.wavelengths[0], found.wavelengths[-1]) == (360, 830)
    assert np.isfinite(found.radiance).all()
    # 59.3 mW on the average, of a slightly different choice of samples.
    assert 1e3 * found.radiance[:, found.wavelengths <= 712.5].mean() == pytest.approx(59.3, rel=0.03)


# The camera ---------------------------------------------------------------------------------------------------------

ZENITH, AZIMUTH = np.array([10.0, 50.0, 89.0, 30.0]) * DEG, np.array([0.0, 90.0, 200.0, 350.0]) * DEG


def test_directions_are_spherical_coordinates(x64):
    """x east, y north, z up; azimuth clockwise from north."""
    wanted = np.stack([np.sin(ZENITH) * np.sin(AZIMUTH), np.sin(ZENITH) * np.cos(AZIMUTH), np.cos(ZENITH)], axis=-1)
    np.testing.assert_allclose(Scan(ZENITH, AZIMUTH).directions()[0], wanted, atol=1e-14)


def test_yaw_turns_clockwise(x64):
    """By 90° what looked north looks east: the azimuths grow."""
    turned, later = Scan(ZENITH, AZIMUTH, yaw=math.pi / 2), Scan(ZENITH, AZIMUTH + math.pi / 2)
    np.testing.assert_allclose(turned.directions(), later.directions(), atol=1e-14)
    north = Scan(np.array([math.pi / 2]), np.array([0.0]), yaw=math.pi / 2)
    np.testing.assert_allclose(north.directions()[0, 0], [1, 0, 0], atol=1e-14)


@pytest.mark.parametrize("yaw", [0.0, 1.0])
def test_pixels_is_the_inverse(yaw):
    """Within half a field of view of a sample it is that sample, and beyond it nothing is seen."""
    camera = Scan(ZENITH, AZIMUTH, fov=4 * DEG, yaw=yaw)
    assert camera.valid().all()
    for lower, seen in ((0.0, True), (1.9, True), (2.1, False)):
        beside = Scan(ZENITH + lower * DEG, AZIMUTH, yaw=yaw).directions()[0]
        found = camera.pixels(beside)
        assert camera.sees(beside).tolist() == [seen] * 4
        np.testing.assert_array_equal(found[:, 0], [0, 1, 2, 3] if seen else [-2] * 4)


def test_a_pixel_is_a_cap_of_the_sphere(x64):
    """2π (1 - cos(fov/2)), which is π fov²/4 for a small one; a hemisphere is 2π."""
    angles = Scan(ZENITH, AZIMUTH, fov=0.02).solid_angles()
    assert angles.shape == (1, 4)
    np.testing.assert_allclose(angles, np.pi * 0.01**2, rtol=1e-4)
    np.testing.assert_allclose(Scan(ZENITH, AZIMUTH, fov=math.pi).solid_angles(), 2 * np.pi)
    assert Scan(ZENITH, AZIMUTH, fov=0.02).pixel_angle == pytest.approx(0.02)


def test_it_has_no_focal_length():
    with pytest.raises(CameraError, match="a scan has no focal length"):
        Scan(ZENITH, AZIMUTH).zoomed(jnp.asarray(2.0))


# What is none -------------------------------------------------------------------------------------------------------


def archive(**members):
    """A zip of members that are no arrays of NumPy's making."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return data.getvalue()


def saved(**arrays):
    data = io.BytesIO()
    np.savez(data, **arrays)
    return data.getvalue()


def header(shape):
    """The beginning of an array that claims to be large."""
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return data.getvalue()


def encrypted(data):
    """With the bit set that says so, in both of the headers of the first member."""
    marked = bytearray(data)
    marked[6] |= 1
    marked[data.index(b"PK\x01\x02") + 8] |= 1
    return bytes(marked)


def with_nan(name):
    value = columns()[name].copy()
    value[-1] = np.nan
    return {name: value}


MISSING = (
    "wavelength_nm",
    "radiance",
    "view_zenith_deg",
    "view_azimuth_deg",
    "sun_zenith_deg",
    "sun_azimuth_deg",
)
DAMAGED = "not an .npz of plain arrays, or one that is damaged"
BAD = {f"npz without {name}": (saved(**columns(**{name: None})), f"{name} is missing") for name in MISSING}
BAD |= {f"csv without {name}": (table(**{name: None}), f"{name} is missing") for name in MISSING[2:]}
BAD |= {f"NaN in {name}": (saved(**columns(**with_nan(name))), f"{name}: expected finite") for name in MISSING[2:]}
BAD |= {
    "empty": (b"", "expected a row of names and a row for every sample"),
    "names only": (table().splitlines()[0], "expected a row of names"),
    "no zip": (b"PK\x03\x04" + bytes(40), DAMAGED),
    "truncated": (saved(**columns())[:500], DAMAGED),
    "cut inside": (saved(**columns())[:200] + saved(**columns())[260:], DAMAGED),
    "encrypted": (encrypted(saved(**columns())), DAMAGED),
    "pickled": (saved(**columns(radiance=np.array([{"a": 1}], dtype=object))), DAMAGED),
    "a pickle": (archive(radiance=pickle.dumps([1.0])), "wavelength_nm is missing"),
    "larger than it is": (archive(radiance=header((10**13,))), DAMAGED),
    "half a header": (archive(radiance=header((5, 4)).replace(b"(5, 4)", b"(5, 4 ")), DAMAGED),
    "bomb": (archive(radiance=header((9 * scan.MOST,)) + bytes(8 * scan.MOST)), "holds 160,000,128 bytes, more than"),
    "not UTF-8": (b"view_zenith_deg\n\xff\xfe\n", "not a CSV file"),
    "text": (table().replace("20.0", "twenty"), "column view_zenith_deg: expected a number in every row"),
    "short row": (table().rstrip("\n") + "\n1.0,2.0\n", "expected a number in every row"),
    "same name": (table().replace("view_azimuth_deg", "view_zenith_deg"), "two columns have the same name"),
    "no band": (table().replace("radiance_400", "radiance_blue"), "expected radiance_<wavelength in nm>"),
    "text array": (saved(**columns(radiance=np.array([["a"] * 4] * 5))), "expected arrays of numbers"),
    "complex": (saved(**columns(radiance=1j * np.ones((5, 4)))), "expected arrays of numbers"),
    "flat radiance": (saved(**columns(radiance=np.ones(5))), r"radiance: got shape (5,) for 4 wavelengths, expected"),
    "radiance of others": (saved(**columns(radiance=np.ones((5, 3)))), "radiance: got shape (5, 3) for 4 wavelengths"),
    "falling wavelengths": (saved(**columns(wavelength_nm=np.arange(4.0)[::-1])), "wavelength_nm: expected finite numb"),
    "few angles": (saved(**columns(view_zenith_deg=np.zeros(3))), "view_zenith_deg: got shape (3,), expected one for"),
    "below": (saved(**columns(view_zenith_deg=np.full(5, -1.0))), "view_zenith_deg: expected finite angles from 0 to"),
    "radians?": (saved(**columns(view_azimuth_deg=np.full(5, 1e3))), "view_azimuth_deg: expected finite angles from"),
    "few valid": (saved(**columns(valid=np.ones(3, bool))), "valid: got shape (3,), expected one for each of 5"),
    "none valid": (saved(**columns(valid=np.zeros(5, bool))), "no valid sample, or no wavelength from 360 to 840 nm"),
    "text valid": (saved(**columns(valid=np.array(["yes"] * 5))), "expected arrays of numbers"),
    "NaN valid": (saved(**columns(valid=np.full(5, np.nan))), "valid: expected"),
    "infrared": (saved(**columns(wavelength_nm=np.arange(1000.0, 1004))), "no valid sample, or no wavelength from"),
    "no sun": (saved(**columns(solar_irradiance=np.zeros(4))), "solar_irradiance: expected a positive number for each"),
    "few suns": (saved(**columns(solar_irradiance=np.ones(2))), "solar_irradiance: expected a positive number for"),
    "far": (saved(**columns(solar_irradiance_1au=np.ones(4), earth_sun_au=150.0)), "earth_sun_au: got 150, expected ab"),
    "nowhere": (saved(**columns(solar_irradiance_1au=np.ones(4), earth_sun_au=np.ones(0))), "earth_sun_au: expected"),
    "wide": (saved(**columns(fov_deg=90.0)), "fov_deg: got 90, expected more than 0 and at most 30"),
    "no fov": (saved(**columns(fov_deg=np.ones(0))), "fov_deg: expected"),
    "bright ground": (saved(**columns(ground_albedo=np.full(4, 2.0))), "ground_albedo: expected numbers from 0 to 1"),
    "ground of others": (saved(**columns(ground_albedo=np.ones(3))), "ground_albedo: expected a number for each of its"),
    "ground nowhere": (
        saved(**columns(ground_albedo=np.ones(2), ground_albedo_wavelength_nm=np.array([400.0, np.nan]))),
        "ground_albedo: expected a number for each of its wavelengths, which rise",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_one_line_says_what_is_wrong(name, tmp_path):
    content, message = BAD[name]
    path = tmp_path / "bad.npz"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ScanError) as caught:
        scan.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ScanError, match=r"none\.csv: cannot be read: No such file"):
        scan.read(tmp_path / "none.csv")


def test_a_scan_is_kept_with_a_fit():
    """Saved and read back it looks the same ways."""
    from fitting import storage

    camera = Scan(np.array([0.1, 0.7]), np.array([2.0, 5.0]), fov=0.02, yaw=0.3)
    arrays: dict[str, np.ndarray] = {}
    back = storage._unpack(storage._pack(camera, "camera", arrays), arrays)
    np.testing.assert_array_equal(back.directions(), camera.directions())
    assert (back.height, back.width) == (1, 2)
