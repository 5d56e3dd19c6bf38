"""Blender's sky texture, as a script for its Python console: three densities, each a multiple of Blender's own air.

Two models, whose air differs (``intern/sky`` of Blender's source). What the densities multiply is put here into the terms of
an :class:`Atmosphere`: profiles of other shapes keep their column, and the absorber its mean height and variance.
"""

import ast
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffatmo import spectrum
from diffatmo.atmosphere import Atmosphere
from diffatmo.presets.fields import PresetError, Wavelengths, number, plain

DENSITIES = ("air_density", "aerosol_density", "ozone_density")


class _Air(NamedTuple):
    """What a density of 1 is, and what no density changes."""

    sky_types: tuple[str, ...]
    largest: float
    bottom_radius: float
    height: float
    rayleigh_scale_height: float
    mie_scale_height: float
    mie_g: float
    mie_phase: str
    ozone_center_altitude: float
    ozone_half_width: float
    ground_albedo: float


_LN_MEDIAN, _LN_VARIANCE = 3.22261, 0.5 / 5.55555555
_MEAN = math.exp(_LN_MEDIAN + _LN_VARIANCE / 2)
"""Of the log-normal layer of ozone of 5.0: exp(-5.5556 (ln h - 3.22261)²) / h."""

MULTIPLE = _Air(
    sky_types=("MULTIPLE_SCATTERING",),
    largest=1000,
    bottom_radius=6371,
    height=100,
    # The column of exp(-0.07771971 h^1.16364243), km.
    rayleigh_scale_height=math.gamma(1 + 1 / 1.16364243) * 0.07771971 ** (-1 / 1.16364243),
    mie_scale_height=0.73,
    mie_g=0.8,
    mie_phase="henyey-greenstein",
    ozone_center_altitude=_MEAN,
    ozone_half_width=_MEAN * math.sqrt(6 * math.expm1(_LN_VARIANCE)),
    ground_albedo=0.3,
)
"""Multiple Scattering of Blender 5.0: urban air after García Liñán, 2024."""

SINGLE = _Air(
    sky_types=("NISHITA", "SINGLE_SCATTERING"),
    largest=10,
    bottom_radius=6360,
    height=60,
    rayleigh_scale_height=8.0,
    mie_scale_height=1.2,
    mie_g=0.76,
    mie_phase="cornette-shanks",
    ozone_center_altitude=25.0,
    ozone_half_width=15.0,
    ground_albedo=0.0,
)
"""Nishita of Blender 2.90 to 4.5, Single Scattering of 5.0."""

BANDS = (630.0, 560.0, 490.0, 430.0)
_DENSITY = 1.3681e20
"""The four wavelengths, nm, of 5.0, and the number density of its aerosol at the ground."""


def _log(wavelengths: Float[np.ndarray, " w"], values: tuple[float, ...]) -> Float[np.ndarray, " w"]:
    """Power laws between and beyond values at ``BANDS``."""
    nodes, logs = np.log(BANDS)[::-1], np.log(values)[::-1]
    x = np.log(wavelengths)
    segment = np.clip(np.searchsorted(nodes, x) - 1, 0, len(nodes) - 2)
    slope = np.diff(logs)[segment] / np.diff(nodes)[segment]
    return np.asarray(np.exp(logs[segment] + slope * (x - nodes[segment])))


def _coefficients(air: _Air, wavelengths: Wavelengths) -> Float[np.ndarray, "kind w"]:
    """Rayleigh scattering, Mie scattering and absorption, and ozone's absorption at its peak, all at density 1, 1/km.

    Ozone's is that of :mod:`diffatmo.spectrum` for Blender's column, within 5 % of Blender's own from 500 to 680 nm, where it
    counts (5.0 has 1.6 times as much at 490 nm).
    """
    bands = np.asarray(wavelengths, float)
    if air is SINGLE:
        # Rayleigh's law with n = 1.0002926; 300 DU of ozone; 2e-5 / m of aerosol, whose extinction is 1.11 times that.
        ozone = spectrum.ozone_absorption(jnp.asarray(bands), column_du=300.0, half_width=air.ozone_half_width)
        mie = np.full_like(bands, 2e-2)
        return np.stack([1.1312e-3 * (bands / 1e3) ** -4, mie, 0.11 * mie, np.asarray(ozone)])
    # 334.5 times the column of 3.78547397e20 exp(-5.5556 (ln h - 3.22261)²) / h, in Dobson units.
    column = 334.5 * 3.78547397e20 * math.sqrt(2 * math.pi * _LN_VARIANCE) / 2.6867e20
    ozone = spectrum.ozone_absorption(jnp.asarray(bands), column_du=column, half_width=air.ozone_half_width)
    return np.stack(
        [
            _log(bands, (6.605e-3, 1.067e-2, 1.842e-2, 3.156e-2)),
            _DENSITY * _log(bands, (1.5908e-22, 1.7711e-22, 2.0942e-22, 2.4033e-22)),
            _DENSITY * _log(bands, (2.8722e-24, 4.6168e-24, 7.9706e-24, 1.3578e-23)),
            np.asarray(ozone),
        ]
    )


def densities(air: _Air, atmosphere: Atmosphere) -> list[float]:
    """Of air, aerosol and ozone: by least squares of the vertical optical depths, aerosol's scattering and absorption apart."""
    rayleigh, scattering, absorption, ozone = _coefficients(air, np.asarray(atmosphere.wavelengths))
    heights = (
        (atmosphere.rayleigh_scale_height, air.rayleigh_scale_height),
        (atmosphere.mie_scale_height, air.mie_scale_height),
        (atmosphere.ozone_half_width, air.ozone_half_width),
    )
    spectra = (
        (atmosphere.rayleigh_scattering, rayleigh),
        (
            np.concatenate([atmosphere.mie_scattering, atmosphere.mie_absorption]),
            np.concatenate([scattering, absorption]),
        ),
        (atmosphere.ozone_absorption, ozone),
    )

    values = []
    for (height, own_height), (spectrum_, own) in zip(heights, spectra, strict=True):
        wanted, one = float(height) * np.asarray(spectrum_, float), own_height * own
        values.append(min(float(wanted @ one / (one @ one)), air.largest))
    return values


def _script(air: _Air, atmosphere: Atmosphere, remarks: str) -> str:
    aerosol = "aerosol_density"
    values = dict(zip(DENSITIES, map(_text, densities(air, atmosphere)), strict=True))
    if air is MULTIPLE:
        choice = f'sky.sky_type = "MULTIPLE_SCATTERING"\nsky.{aerosol} = {values[aerosol]}'
    else:
        choice = f"""if hasattr(sky, "dust_density"):  # 2.90 to 4.5
    sky.sky_type = "NISHITA"
    sky.dust_density = {values[aerosol]}
else:
    sky.sky_type = "SINGLE_SCATTERING"
    sky.aerosol_density = {values[aerosol]}"""
    # The densities before the links: whatever is left of a script that was cut off has them whole, or says that it was.
    return f"""{remarks}import bpy

world = bpy.context.scene.world or bpy.data.worlds.new("World")
bpy.context.scene.world = world
if world.node_tree is None:
    world.use_nodes = True
nodes, links = world.node_tree.nodes, world.node_tree.links


def node(name):
    return next((n for n in nodes if n.bl_idname == name), None) or nodes.new(name)


sky = node("ShaderNodeTexSky")
{choice}
sky.air_density = {values["air_density"]}
sky.ozone_density = {values["ozone_density"]}

background, output = node("ShaderNodeBackground"), node("ShaderNodeOutputWorld")
links.new(sky.outputs["Color"], background.inputs["Color"])
links.new(background.outputs["Background"], output.inputs["Surface"])
"""


def _text(value: float) -> str:
    """Six digits: of the single precision that Blender has, those that reading back and writing again keeps."""
    return plain(float(f"{value:.6g}"))


def _assigned(text: str) -> dict[str, str]:
    """The constants that a script assigns to attributes, as text."""
    last = text.rpartition("\n")[2]
    if "_density" in last:
        raise PresetError(f"ends within {last.strip()!r}: text is missing")
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError) as error:
        raise PresetError(f"not a Python script, or cut off: {error}") from error
    found: dict[str, str] = {}
    for statement in ast.walk(tree):
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Attribute):
            key = statement.targets[0].attr.replace("dust_density", "aerosol_density")
            value = ast.unparse(statement.value)
            if key in DENSITIES and found.get(key, value) != value:
                raise PresetError(f"{key}: given twice, {found[key]} and {value}")
            found[key] = value
    return found


def _read(air: _Air, text: str, wavelengths: Wavelengths) -> dict[str, Any]:
    found = _assigned(text)
    sky_type = found.get("sky_type", "nothing").strip("'\"")
    if sky_type not in air.sky_types:
        raise PresetError(f"sky_type: got {sky_type}, expected {' or '.join(air.sky_types)}")
    for key in DENSITIES:
        if key not in found:
            raise PresetError(f"{key}: missing, expected a number from 0 to {air.largest:g}")
    air_density, aerosol, ozone = (number(key, found[key], lowest=0, highest=air.largest) for key in DENSITIES)
    rayleigh, scattering, absorption, absorber = _coefficients(air, wavelengths)
    return {
        "wavelengths": wavelengths,
        "solar_irradiance": np.ones(len(wavelengths)),
        "bottom_radius": air.bottom_radius,
        "top_radius": air.bottom_radius + air.height,
        "rayleigh_scattering": air_density * rayleigh,
        "rayleigh_scale_height": air.rayleigh_scale_height,
        "mie_scattering": aerosol * scattering,
        "mie_absorption": aerosol * absorption,
        "mie_scale_height": air.mie_scale_height,
        "mie_g": air.mie_g,
        "ozone_absorption": ozone * absorber,
        "ground_albedo": np.full(len(wavelengths), air.ground_albedo),
        "ozone_center_altitude": air.ozone_center_altitude,
        "ozone_half_width": air.ozone_half_width,
        "mie_phase": air.mie_phase,
    }


def dumps(atmosphere: Atmosphere, remarks: str) -> str:
    """A script for Blender 5.0 and later."""
    return _script(MULTIPLE, atmosphere, remarks)


def loads(text: str, wavelengths: Wavelengths) -> dict[str, Any]:
    """What a script for Blender 5.0 and later says, at ``wavelengths``."""
    return _read(MULTIPLE, text, wavelengths)


def dumps_nishita(atmosphere: Atmosphere, remarks: str) -> str:
    """A script for the model of single scattering, from Blender 2.90 on."""
    return _script(SINGLE, atmosphere, remarks)


def loads_nishita(text: str, wavelengths: Wavelengths) -> dict[str, Any]:
    """What a script for the model of single scattering says, at ``wavelengths``."""
    return _read(SINGLE, text, wavelengths)
