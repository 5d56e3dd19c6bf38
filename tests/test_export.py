"""Exported tables, sampled as their README says by a reader who knows nothing else, give back the model's sky."""

import math
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from few_programs import COMPILE_FAST, viewed

import diffatmo
from diffatmo import export, imageio, sun
from diffatmo.cli.main import main
from diffatmo.compiling import outermost
from diffatmo.models.bruneton import Bruneton, Sizes, Steps
from diffatmo.models.hillaire import Hillaire

SMALL = Sizes(16, 64, 8, 16, 12, 32, 16, 6)
FAST = Steps(40, 10, 10, 4, 8)
RG, RT = 6360.0, 6460.0
H = math.sqrt(RT**2 - RG**2)


def coord(x, n):
    return 0.5 / n + x * (1 - 1 / n)


def sample(texture, *at):
    """Linear interpolation of a texture (depth, height, width, channels) at texture coordinates, x first."""
    result = texture
    for axis, u in zip(range(texture.ndim - 1), reversed(at), strict=True):
        n = texture.shape[axis]
        p = min(max(u * n - 0.5, 0), n - 1)
        first = min(int(p), n - 2)
        result = result[first] * (1 - p + first) + result[first + 1] * (p - first)
    return result


def scattering_at(texture, sizes, maps, r, mu, mu_s, nu, ground):
    """The README's formulas, written down once more."""
    rho = math.sqrt(r * r - RG * RG)
    to_top = -r * mu + math.sqrt(r * r * (mu * mu - 1) + RT * RT)
    if maps == "2017":
        if ground:
            d, low, high = -r * mu - math.sqrt(r * r * (mu * mu - 1) + RG * RG), r - RG, rho
        else:
            d, low, high = to_top, RT - r, rho + H
        unit = (d - low) / (high - low)

        def ratio(x):
            return (-RG * x + math.sqrt(RG * RG * (x * x - 1) + RT * RT) - (RT - RG)) / (H - (RT - RG))

        lowest = ratio(-0.2)
        u_mu_s = max(1 - ratio(mu_s) / lowest, 0) / (1 + ratio(mu_s))
    else:
        d = -r * mu - math.sqrt(r * r * (mu * mu - 1) + RG * RG) if ground else to_top
        unit = d / rho if ground else d / (rho + H)
        u_mu_s = (1 - math.exp(-3 * mu_s - 0.6)) / (1 - math.exp(-3.6))
    half = sizes.mu // 2
    y = 0.5 - 0.5 * coord(unit, half) if ground else 0.5 + 0.5 * coord(unit, half)
    t = (nu + 1) / 2 * (sizes.nu - 1)
    i = min(int(t), sizes.nu - 2)
    z = coord(rho / H, sizes.r)
    low, high = (sample(texture, (k + coord(u_mu_s, sizes.mu_s)) / sizes.nu, y, z) for k in (i, i + 1))
    return low * (1 - t + i) + high * (t - i)


@partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
def path(sky, altitude, mu, mu_s, nu, distance=None):
    return sky.path(altitude=altitude, mu=mu, mu_s=mu_s, nu=nu, distance=distance)


@pytest.mark.parametrize("maps", ["2017", "2008"])
def test_bruneton_is_found_again(maps, s1):
    """Looking up, at the horizon and down, from 2 and 30 km; single precision of the model's own lookup."""
    model = Bruneton(parameterisation=maps, sizes=SMALL, steps=FAST, orders=2)
    textures = {t.name: t.texels for t in export.bruneton(s1, model)}
    assert textures["scattering"].shape == (12, 32, 6 * 16, 3)
    sky = outermost(type(model).sky)(model, s1)
    for altitude, mu, mu_s, nu in [
        (2.0, 0.6, 0.3, 0.5),
        (2.0, -0.4, 0.8, -0.6),
        (30.0, 0.02, -0.05, 0.9),
        (30.0, -0.9, 0.5, -0.4),
    ]:
        ground = mu < -math.sqrt(1 - (RG / (RG + altitude)) ** 2)
        at = (SMALL, maps, RG + altitude, mu, mu_s, nu, ground)
        air, aerosol, packed = (
            scattering_at(textures[name].astype(float), *at)
            for name in ("scattering", "single_mie_scattering", "combined_scattering")
        )
        light = 3 / (16 * math.pi) * (1 + nu * nu) * air
        light = light + (1 - 0.64) / (4 * math.pi * (1.64 - 1.6 * nu) ** 1.5) * aerosol
        wanted = path(sky, *(jnp.asarray(x) for x in (altitude, mu, mu_s, nu)))
        np.testing.assert_allclose(light, wanted.inscatter, rtol=2e-3)
        np.testing.assert_allclose(packed, [*air, aerosol[0]], rtol=1e-6)


def test_hillaire_is_found_again(s1):
    """The sky-view table by the README's rows, and the volume's slices at their distances."""
    camera = diffatmo.Pinhole(9, 16, pitch=0.2, fov_y=0.8)
    towards = sun.direction(zenith=1.0, azimuth=0.3)
    textures = {
        t.name: t.texels for t in export.hillaire(s1, Hillaire(), altitude=1.0, sun=towards, camera=camera, reach=32.0)
    }
    shapes = {name: texels.shape[:3] for name, texels in textures.items()}
    assert shapes == {
        "transmittance": (1, 64, 256),
        "multiple_scattering": (1, 32, 32),
        "sky_view": (1, 108, 192),
        "aerial_perspective": (32, 32, 32),
        "aerial_transmittance": (32, 32, 32),
    }
    sky = outermost(Hillaire.sky)(Hillaire(), s1)
    view = sun.direction(zenith=1.2, azimuth=1.0)
    horizon = math.pi / 2 + math.acos(RG / (RG + 1.0))
    row = 54 + 53 * math.sqrt((horizon - 1.2) / horizon)
    u = coord(math.sqrt((1 - math.cos(1.0 - 0.3)) / 2), 192)
    found = sample(textures["sky_view"][0].astype(float), u, (row + 0.5) / 108)
    wanted = viewed(sky, 1.0, view, towards).radiance
    np.testing.assert_allclose(found, wanted, rtol=1e-4)
    # The corner of the picture, after 16 of 32 slices.
    corner = camera.directions_at(jnp.asarray(-0.5), jnp.asarray(-0.5))
    wanted = path(sky, jnp.asarray(1.0), corner[2], towards[2], corner @ towards, jnp.asarray(16.0))
    np.testing.assert_allclose(textures["aerial_perspective"][15, 0, 0], wanted.inscatter, rtol=0.02)
    np.testing.assert_allclose(textures["aerial_transmittance"][15, 0, 0], wanted.transmittance, rtol=0.01)


def test_the_aerial_volume_is_found_again(s1):
    """By the README, in a picture that has another size than the volume, and nearer than its first slice."""
    camera = diffatmo.Pinhole(9, 16, pitch=0.2, fov_y=0.8)
    towards = sun.direction(zenith=1.0, azimuth=0.3)
    place = {"altitude": jnp.asarray(1.0), "sun": towards}
    textures = export.hillaire(s1, Hillaire(), altitude=1.0, sun=towards, camera=camera, reach=32.0)
    light, clear = (t.texels.astype(float) for t in textures[-2:])
    i, j = 3.2, 6.9
    u, v = coord((i + 0.5) / 16, 32), coord((j + 0.5) / 9, 32)
    ours = Hillaire().sky(s1).aerial_volume(camera, **place, reach=32.0)
    for distance in (0.0, 0.3, 1.0, 5.7, 32.0):
        if distance < 1:
            near, passes = sample(light[0], u, v), sample(clear[0], u, v)
            found = distance * near, 1 - distance + distance * passes
        else:
            found = tuple(sample(volume, u, v, distance / 32 - 0.5 / 32) for volume in (light, clear))
        wanted = ours.at(*(jnp.asarray(x) for x in (i, j, distance)))
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-9, err_msg=f"{distance} km")


def test_files_hold_what_was_computed(tmp_path, s1):
    """Slices, the stack of them and the table are the same numbers; half precision is off by 2^-11 and says so."""
    textures = export.bruneton(s1, Bruneton(sizes=SMALL, steps=FAST, orders=1))
    export.write(textures, tmp_path, s1, "2017")
    by_name = {t.name: t for t in textures}
    stack = imageio.read_image(tmp_path / "float" / "scattering.exr")
    texels = by_name["scattering"].texels
    np.testing.assert_array_equal(stack.pixels, texels.reshape(12 * 32, 96, 3))
    assert stack.metadata["texture_size"] == "96 32 12"
    assert "phase function" in stack.metadata["omits"]
    assert "rayleigh_scattering_per_km" in stack.metadata["atmosphere"]
    slice_ = imageio.read_image(tmp_path / "float" / "scattering" / "slice_007.exr")
    np.testing.assert_array_equal(slice_.pixels, texels[7])
    coarse = imageio.read_image(tmp_path / "half" / "transmittance.exr")
    assert 0 < coarse.metadata["half_relative_error"] < 2**-10
    np.testing.assert_allclose(coarse.pixels, by_name["transmittance"].texels[0], rtol=2**-10, atol=1e-7)
    with OpenEXR.File(str(tmp_path / "half" / "combined_scattering.exr"), separate_channels=True) as file:
        assert sorted(file.channels()) == ["A", "B", "G", "R"]
        assert file.channels()["A"].pixels.dtype == np.float16


@pytest.mark.parametrize("scale", [1e6, 1e-9])
def test_half_precision_holds_no_more_than_it_can(scale, tmp_path, s1):
    """Numbers beyond 65504 would be infinite in it, those below 6e-8 zero: such a texture is there in single precision only."""
    texels = np.full((1, 2, 2, 3), scale, np.float32)
    kept = export.Texture("kept", np.ones_like(texels), "none", "1", "nothing")
    lost = export.Texture("lost", texels, "none", "1", "nothing")
    export.write([lost._replace(texels=texels / scale)], tmp_path, s1, "none")
    written = export.write([lost, kept], tmp_path, s1, "none", overwrite=True)
    assert not (tmp_path / "half" / "lost.exr").exists()
    names = {str(path.relative_to(tmp_path)) for path in written}
    assert names == {"float/lost.exr", "float/kept.exr", "half/kept.exr"}
    np.testing.assert_array_equal(imageio.read_image(tmp_path / "float" / "lost.exr").pixels, texels[0])


def test_the_command(tmp_path, capsys):
    folder = tmp_path / "tables"
    sun = ["--sun-zenith-deg", "80", "--sun-azimuth-deg", "90"]
    assert main(["export", "earth", "--luts", "hillaire", "-o", str(folder), *sun]) == 0
    assert "sky_view" in capsys.readouterr().out
    text = (folder / "README.md").read_text()
    assert "zenith angle 80°, azimuth 90° clockwise" in text
    view = imageio.read_image(folder / "float" / "sky_view.exr").metadata["place"]
    assert view.startswith("altitude 0.1 km, sun in direction 0.98")
    assert "projection pinhole" in imageio.read_image(folder / "half" / "aerial_perspective.exr").metadata["place"]
    assert "place" not in imageio.read_image(folder / "float" / "multiple_scattering.exr").metadata
    assert "@" not in text
    assert len(list((folder / "half" / "aerial_perspective").iterdir())) == 32
    assert main(["export", "earth", "--luts", "hillaire", "-o", str(folder)]) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--luts", "preetham"], "--luts"),
        (["--luts", "bruneton", "--sun-zenith-deg", "40"], "--sun-zenith-deg contradicts"),
        (["--luts", "hillaire", "--orders", "3"], "--orders contradicts"),
        (["--luts", "hillaire", "--reach-km", "0"], "--reach-km"),
    ],
)
def test_bad_input(arguments, named, tmp_path, capsys):
    assert main(["export", "earth", "-o", str(tmp_path / "out"), *arguments]) == 2
    assert named in capsys.readouterr().err
