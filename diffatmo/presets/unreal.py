"""Unreal's SkyAtmosphere, as the text that its editor copies and pastes.

Names, units, defaults and limits are those of ``USkyAtmosphereComponent`` (4.26 to 5.x): lengths in km, a coefficient is a
scale in 1/km times a linear colour, the ground is a colour of 8 bits in sRGB, the aerosol's phase function is
Henyey-Greenstein's, Mie and Rayleigh fall off exponentially, what else absorbs is a tent.
"""

import re
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffatmo import color
from diffatmo._types import Spectrum
from diffatmo.atmosphere import Atmosphere
from diffatmo.presets.fields import PresetError, Wavelengths, asymmetry_as, decimals, number, plain

LARGEST_G = 0.999
LEAST_SCALE_HEIGHT = 0.1
"""Limits of the editor for MieAnisotropy, which it does not let be negative, and for the distributions, km."""

SCALARS = {
    "BottomRadius": 6360.0,
    "AtmosphereHeight": 60.0,
    "MultiScatteringFactor": 1.0,
    "RayleighScatteringScale": 0.0331,
    "RayleighExponentialDistribution": 8.0,
    "MieScatteringScale": 0.003996,
    "MieAbsorptionScale": 0.000444,
    "MieAnisotropy": 0.8,
    "MieExponentialDistribution": 1.2,
    "OtherAbsorptionScale": 0.001881,
}
COLOURS = {
    "RayleighScattering": (0.005802 / 0.0331, 0.013558 / 0.0331, 1.0),
    "MieScattering": (1.0, 1.0, 1.0),
    "MieAbsorption": (1.0, 1.0, 1.0),
    "OtherAbsorption": (0.650 / 1.881, 1.0, 0.085 / 1.881),
}
ALBEDO = ("GroundAlbedo", (170, 170, 170))
TENT = ("OtherTentDistribution", {"TipAltitude": 25.0, "TipValue": 1.0, "Width": 15.0})
"""Unreal's defaults, which it leaves out where it writes a component."""

COMPONENT = "SkyAtmosphereComponent"


def dumps(atmosphere: Atmosphere, remarks: str) -> str:
    """The text to paste, for three wavelengths from red to blue."""
    height = decimals(atmosphere.top_radius)[0] - decimals(atmosphere.bottom_radius)[0]
    g = min(max(asymmetry_as(atmosphere, "henyey-greenstein"), 0.0), LARGEST_G)
    properties = {"BottomRadius": plain(decimals(atmosphere.bottom_radius)[0]), "AtmosphereHeight": plain(height)}
    codes = np.rint(255 * np.asarray(color.srgb_encode(atmosphere.ground_albedo))).astype(int)
    properties[ALBEDO[0]] = "(B={2},G={1},R={0},A=255)".format(*codes)
    properties["MultiScatteringFactor"] = "1.0"
    properties |= _coefficient("RayleighScattering", atmosphere.rayleigh_scattering)
    properties["RayleighExponentialDistribution"] = _distribution(atmosphere.rayleigh_scale_height)
    properties |= _coefficient("MieScattering", atmosphere.mie_scattering)
    properties |= _coefficient("MieAbsorption", atmosphere.mie_absorption)
    properties["MieAnisotropy"] = plain(g)
    properties["MieExponentialDistribution"] = _distribution(atmosphere.mie_scale_height)
    properties |= _coefficient("OtherAbsorption", atmosphere.ozone_absorption)
    tip, width = decimals(atmosphere.ozone_center_altitude)[0], decimals(atmosphere.ozone_half_width)[0]
    properties[TENT[0]] = f"(TipAltitude={plain(tip)},TipValue=1.0,Width={plain(width)})"
    lines = "\n".join(f"            {key}={value}" for key, value in properties.items())
    # The editor pastes only what begins with these words.
    return f"""Begin Map
{remarks}   Begin Level
      Begin Actor Class=/Script/Engine.SkyAtmosphere Name=SkyAtmosphere_0
         Begin Object Class=/Script/Engine.{COMPONENT} Name="{COMPONENT}"
         End Object
         Begin Object Name="{COMPONENT}"
{lines}
         End Object
         {COMPONENT}="{COMPONENT}"
         RootComponent="{COMPONENT}"
         ActorLabel="SkyAtmosphere"
      End Actor
   End Level
Begin Surface
End Surface
End Map
"""


def _coefficient(name: str, values: Spectrum) -> dict[str, str]:
    """A spectrum as a scale and a colour whose largest component is 1."""
    exact = [float(value) for value in decimals(values)]
    scale = max(exact)
    red, green, blue = (plain(value / scale) if scale else "1.0" for value in exact)
    return {f"{name}Scale": plain(scale), name: f"(R={red},G={green},B={blue},A=1.0)"}


def _distribution(scale_height: object) -> str:
    return plain(max(float(decimals(scale_height)[0]), LEAST_SCALE_HEIGHT))


def loads(text: str, wavelengths: Wavelengths) -> dict[str, Any]:
    """What a component says, or leaves at its default; its channels are ``wavelengths``."""
    properties = _properties(text)
    scalar = {
        key: number(key, properties[key], lowest=0) if key in properties else default
        for key, default in SCALARS.items()
    }
    if scalar["MultiScatteringFactor"] != 1:
        raise PresetError(
            f"MultiScatteringFactor: got {scalar['MultiScatteringFactor']:g}, expected 1: "
            "an atmosphere has no factor on light that is scattered more than once"
        )

    def coefficient(name: str) -> list[float]:
        default = dict(zip("RGB", COLOURS[name], strict=True))
        return [scalar[f"{name}Scale"] * part for part in _struct(name, properties, default).values()]

    codes = _struct(ALBEDO[0], properties, dict(zip("RGB", ALBEDO[1], strict=True)), highest=255)
    tent = _struct(TENT[0], properties, TENT[1])
    return {
        "wavelengths": wavelengths,
        "solar_irradiance": np.ones(3),
        "bottom_radius": scalar["BottomRadius"],
        "top_radius": float(sum(decimals(scalar["BottomRadius"]) + decimals(scalar["AtmosphereHeight"]))),
        "rayleigh_scattering": coefficient("RayleighScattering"),
        "rayleigh_scale_height": scalar["RayleighExponentialDistribution"],
        "mie_scattering": coefficient("MieScattering"),
        "mie_absorption": coefficient("MieAbsorption"),
        "mie_scale_height": scalar["MieExponentialDistribution"],
        "mie_g": scalar["MieAnisotropy"],
        # The tent's tip is a factor on all of it.
        "ozone_absorption": [tent["TipValue"] * value for value in coefficient("OtherAbsorption")],
        "ground_albedo": color.srgb_decode(jnp.array(list(codes.values())) / 255),
        "ozone_center_altitude": tent["TipAltitude"],
        "ozone_half_width": tent["Width"],
        "mie_phase": "henyey-greenstein",
    }


def _properties(text: str) -> dict[str, str]:
    """The properties of the one sky atmosphere in ``text``."""
    stack: list[str] = []
    properties: dict[str, str] = {}
    for line in (part.split("//")[0].strip() for part in text.splitlines()):
        if re.match(r"Begin\s", line, re.IGNORECASE):
            stack.append(line)
        elif re.match(r"End\s", line, re.IGNORECASE):
            if not stack or stack.pop().split()[1].lower() != line.split()[1].lower():
                raise PresetError(f"{line!r} without its Begin: text is missing")
        elif "=" in line and stack and COMPONENT in stack[-1]:
            key, _, value = line.partition("=")
            if key in properties:
                raise PresetError(f"{key}: given twice, expected one {COMPONENT}")
            properties[key] = value
    if stack:
        raise PresetError(f"ends within {stack[-1]!r}: text is missing")
    return properties


def _struct(
    key: str, properties: dict[str, str], default: dict[str, float], highest: float = np.inf
) -> dict[str, float]:
    """The members of ``default`` in a value like (R=1.0,G=0.5,B=0.2), with what is not said."""
    if key not in properties:
        return default
    text = properties[key].strip()
    if not (text.startswith("(") and text.endswith(")")):
        raise PresetError(f"{key}: got {text}, expected a value like ({'=…,'.join(default)}=…)")
    parts = dict(part.split("=", 1) for part in text[1:-1].split(",") if "=" in part)
    return {
        name: number(f"{key}.{name}", parts[name], lowest=0, highest=highest) if name in parts else value
        for name, value in default.items()
    }
