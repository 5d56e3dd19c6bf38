"""Tables for renderers: those of Bruneton and of Hillaire as textures, each with what one must know to sample it.

A texture has the axes (depth, height, width, channels), entry by entry as the model holds it; depth is 1 for a flat one.
Entries lie at the centres of texels: position p of n entries is the texture coordinate (p + ½) / n.
"""

import shutil
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffatmo import atmosphere as atmospheres
from diffatmo import imageio
from diffatmo._types import Direction
from diffatmo.atmosphere import Atmosphere
from diffatmo.camera import Camera, to_dict
from diffatmo.compiling import outermost
from diffatmo.models import Bruneton, Hillaire
from diffatmo.models.bruneton import BrunetonSky
from diffatmo.models.hillaire import AerialVolume, HillaireSky, HillaireView

PRECISIONS = ("float", "half")
RADIANCE = "W m^-2 sr^-1 nm^-1, or relative like the solar irradiance"
IRRADIANCE = "W m^-2 nm^-1, or relative like the solar irradiance"
HALF_FLOOR = 1e-3
"""Entries below this part of the largest are not judged when the error of half precision is stated."""
HALF_LOST = 0.1
"""Error of half precision from which on a texture is not written in it: its numbers are outside 6e-8 to 65504."""


class Texture(NamedTuple):
    """One table, and what it means."""

    name: str
    texels: Float[np.ndarray, "depth height width channels"]
    axes: str
    """Quantity along width, height and depth."""
    unit: str
    omits: str
    spectral: bool = True
    place: str = ""
    """Altitude, sun and camera that the table belongs to, if it does."""
    """Channels are the atmosphere's wavelengths; otherwise red, green, blue, alpha."""


def bruneton(atmosphere: Atmosphere, model: Bruneton) -> list[Texture]:
    """T, E and S of ``model``; with three wavelengths also S as the papers pack it."""
    sky: BrunetonSky = outermost(type(model).sky)(model, atmosphere)
    t, e, rayleigh, mie = (
        np.asarray(a) for a in (sky.tables.transmittance, sky.tables.irradiance, sky.tables.rayleigh, sky.tables.mie)
    )
    r, mu, nu, mu_s, bands = rayleigh.shape
    of_s = f"width nu * {mu_s} + mu_s (nu outer), height mu (first half: rays that meet the ground), depth r"
    phaseless = f"{RADIANCE}, times sr"
    orders = f"orders beyond {model.orders}; the sun's disc; light of the ground seen directly"

    def volume(table: np.ndarray) -> np.ndarray:
        return table.reshape(r, mu, nu * mu_s, -1)

    without_air = f"Rayleigh's phase function; aerosol scattered once; {orders}"
    without_aerosol = "the aerosol's phase function; all but its first order"
    textures = [
        Texture("transmittance", t[None], "width mu, height r", "1", "refraction"),
        Texture("irradiance", e[None], "width mu_s, height r", IRRADIANCE, "the sun's own; horizontal planes only"),
        Texture("scattering", volume(rayleigh), of_s, phaseless, without_air),
        Texture("single_mie_scattering", volume(mie), of_s, phaseless, without_aerosol),
    ]
    if bands == 3:
        rgb = np.argsort(-np.asarray(atmosphere.wavelengths))
        packed = np.concatenate([volume(rayleigh)[..., rgb], volume(mie)[..., rgb[:1]]], axis=-1)
        without_both = f"both phase functions; aerosol in green and blue; {orders}"
        textures.append(Texture("combined_scattering", packed, of_s, phaseless, without_both, False))
    return textures


def hillaire(
    atmosphere: Atmosphere, model: Hillaire, *, altitude: float, sun: Direction, camera: Camera, reach: float = 32.0
) -> list[Texture]:
    """The four tables of ``model`` for one place (km), sun and camera; the volume reaches ``reach`` km."""

    def solve(air: Atmosphere) -> tuple[HillaireSky, HillaireView, AerialVolume]:
        sky = model.sky(air)
        place = jnp.asarray(altitude)
        volume = sky.aerial_volume(camera, altitude=place, sun=sun, reach=reach)
        return sky, sky.view(altitude=place, sun=sun), volume

    sky, view, volume = outermost(solve)(atmosphere)
    place = f"altitude {altitude:g} km, sun in direction {' '.join(f'{float(x):.7g}' for x in sun)} (east, north, up)"
    framed = f"{place}, camera: {', '.join(f'{key} {value}' for key, value in to_dict(camera).items())}"
    slices = f"width x, height y, depth distance / {reach:g} km (first slice: the end of the first step)"
    return [
        Texture("transmittance", np.asarray(sky.luts.transmittance)[None], "width mu, height r", "1", "refraction"),
        Texture(
            "multiple_scattering",
            np.asarray(sky.luts.multiple)[None],
            "width mu_s, height altitude",
            f"{RADIANCE}: times the scattering coefficient it is what is scattered more than once, per km",
            "light scattered once; any dependence on direction",
        ),
        Texture(
            "sky_view",
            np.asarray(view.table.table)[None],
            "width longitude from the sun, height latitude about the horizon (first row: the nadir)",
            RADIANCE,
            "the sun's disc; light of the ground seen directly",
            place=place,
        ),
        Texture(
            "aerial_perspective",
            np.asarray(volume.light)[1:],
            slices,
            RADIANCE,
            "what lies behind; times the transmittance",
            place=framed,
        ),
        Texture("aerial_transmittance", np.asarray(volume.transmittance)[1:], slices, "1", "refraction", place=framed),
    ]


def half_error(texels: np.ndarray) -> float:
    """Largest relative error that half precision makes in entries that matter."""
    counts = np.abs(texels) > HALF_FLOOR * np.abs(texels).max()
    with np.errstate(over="ignore"):
        coarse = texels.astype(np.float16).astype(np.float32)
    return float(np.max(np.abs(coarse[counts] / texels[counts] - 1))) if counts.any() else 0.0


def write(
    textures: list[Texture], directory: Path, atmosphere: Atmosphere, parameterisation: str, *, overwrite: bool = False
) -> list[Path]:
    """Write every texture as EXR, in single and, unless :data:`HALF_LOST`, in half precision, and return the paths.

    A flat one is one picture. One with depth is one picture with its slices below each other, which in memory is the 3-d
    texture, and a folder with a picture for every slice. The header of each says what it holds.
    """
    written = []
    for precision in PRECISIONS:
        folder = directory / precision
        folder.mkdir(parents=True, exist_ok=True)
        for texture in textures:
            error = half_error(texture.texels)
            if precision == "half" and error > HALF_LOST:
                if overwrite:
                    # What an earlier run has left would pass for this one's.
                    (folder / f"{texture.name}.exr").unlink(missing_ok=True)
                    shutil.rmtree(folder / texture.name, ignore_errors=True)
                continue
            depth, height, width, channels = texture.texels.shape
            about: dict[str, imageio.Attribute] = {
                "table": texture.name,
                "axes": texture.axes,
                "texture_size": f"{width} {height} {depth}",
                "unit": texture.unit,
                "omits": texture.omits,
                "parameterisation": parameterisation,
                "half_relative_error": error,
                "atmosphere": atmospheres.dumps(atmosphere),
            }
            if texture.place:
                about["place"] = texture.place
            bands = np.asarray(atmosphere.wavelengths) if texture.spectral else None
            pictures = {f"{texture.name}.exr": texture.texels.reshape(depth * height, width, channels)}
            if depth > 1:
                (folder / texture.name).mkdir(exist_ok=True)
                pictures |= {f"{texture.name}/slice_{i:03}.exr": part for i, part in enumerate(texture.texels)}
            for name, pixels in pictures.items():
                imageio.write_exr(
                    folder / name, pixels, about, wavelengths=bands, half=precision == "half", overwrite=overwrite
                )
                written.append(folder / name)
    return written
