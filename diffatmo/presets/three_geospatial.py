"""``AtmosphereParameters`` of @takram/three-atmosphere (three-geospatial), as a JavaScript module.

Names and units are those of its class: radii in metres, but coefficients in 1/km and density layers in km; the aerosol's
phase function is Cornette-Shanks'.
"""

import re
from typing import Any

import numpy as np

from diffatmo.atmosphere import Atmosphere
from diffatmo.presets import layers
from diffatmo.presets.fields import (
    PresetError,
    Wavelengths,
    asymmetry_as,
    decimals,
    number,
    numbers,
    plain,
    rest,
    scaled,
    total,
)


def dumps(atmosphere: Atmosphere, remarks: str) -> str:
    """A module that exports the parameters, for three wavelengths from red to blue."""
    center, half_width = (
        float(decimals(x)[0]) for x in (atmosphere.ozone_center_altitude, atmosphere.ozone_half_width)
    )

    def vector(values: object, kind: str = "Vector3") -> str:
        return f"new {kind}({', '.join(map(plain, values if isinstance(values, list) else decimals(values)))})"

    def profile(parts: list[layers.Layer]) -> str:
        rows = (f"    new DensityProfileLayer({', '.join(map(plain, part))})" for part in parts)
        return "[\n" + ",\n".join(rows) + "\n  ]"

    def falling(scale_height: object) -> str:
        return profile([layers.NOTHING, layers.exponential(float(decimals(scale_height)[0]))])

    parameters = {
        "solarIrradiance": vector(atmosphere.solar_irradiance),
        "bottomRadius": plain(decimals(atmosphere.bottom_radius)[0].scaleb(3)),
        "topRadius": plain(decimals(atmosphere.top_radius)[0].scaleb(3)),
        "rayleighDensity": falling(atmosphere.rayleigh_scale_height),
        "rayleighScattering": vector(atmosphere.rayleigh_scattering),
        "mieDensity": falling(atmosphere.mie_scale_height),
        "mieScattering": vector(atmosphere.mie_scattering),
        "mieExtinction": vector(total(atmosphere.mie_scattering, atmosphere.mie_absorption)),
        "miePhaseFunctionG": plain(asymmetry_as(atmosphere, "cornette-shanks")),
        "absorptionDensity": profile(layers.tent(center, half_width)),
        "absorptionExtinction": vector(atmosphere.ozone_absorption),
        "groundAlbedo": vector(atmosphere.ground_albedo, "Color"),
    }
    body = ",\n".join(f"  {key}: {value}" for key, value in parameters.items())
    return f"""{remarks}import {{ AtmosphereParameters, DensityProfileLayer }} from '@takram/three-atmosphere'
import {{ Color, Vector3 }} from 'three'

export const atmosphere = new AtmosphereParameters({{
{body}
}})
"""


def loads(text: str, wavelengths: Wavelengths) -> dict[str, Any]:
    """The parameters in a module; its channels are ``wavelengths``."""
    code = re.sub(r"//[^\n]*|/\*.*?\*/", "", text, flags=re.DOTALL)
    body = re.search(r"new\s+AtmosphereParameters\(\s*\{(.*)\}\s*\)", code, re.DOTALL)
    if body is None:
        raise PresetError("expected new AtmosphereParameters({ … }), whole")

    def value(key: str, pattern: str, expected: str) -> str:
        if not re.search(rf"\b{key}\s*:", body[1]):
            raise PresetError(f"{key}: missing, expected {expected}")
        found = re.search(rf"\b{key}\s*:\s*{pattern}", body[1], re.DOTALL)
        if found is None:
            raise PresetError(f"{key}: cannot be read, expected {expected}")
        return found[1]

    def scalar(key: str, lowest: float = 0.0) -> float:
        return number(key, value(key, r"([^,\n}]+)", "a number"), lowest=lowest)

    def vector(key: str) -> list[float]:
        return numbers(key, value(key, r"new\s+(?:Vector3|Color)\(([^()]*)\)", "new Vector3 of three numbers"), 3)

    def profile(key: str) -> list[layers.Layer]:
        inside = value(key, r"\[(.*?)\]", "two layers, new DensityProfileLayer of five numbers")
        rows = re.findall(r"DensityProfileLayer\(([^()]*)\)", inside)
        parsed = [tuple(number(key, item) for item in row.split(",")) for row in rows]
        if len(parsed) != 2 or any(len(row) != 5 for row in parsed):
            raise PresetError(f"{key}: got {len(parsed)} layers, expected two of five numbers")
        return parsed  # type: ignore[return-value]

    scattering, extinction = vector("mieScattering"), vector("mieExtinction")
    ozone = vector("absorptionExtinction")
    center, half_width = 25.0, 15.0
    if any(ozone):
        center, half_width = layers.center_and_half_width("absorptionDensity", profile("absorptionDensity"))
    bottom, top = scaled([scalar("bottomRadius"), scalar("topRadius")], -3)
    return {
        "wavelengths": wavelengths,
        "solar_irradiance": vector("solarIrradiance"),
        "bottom_radius": bottom,
        "top_radius": top,
        "rayleigh_scattering": vector("rayleighScattering"),
        "rayleigh_scale_height": layers.scale_height("rayleighDensity", profile("rayleighDensity")),
        "mie_scattering": scattering,
        "mie_absorption": rest("mieExtinction", extinction, scattering),
        "mie_scale_height": layers.scale_height("mieDensity", profile("mieDensity")),
        "mie_g": scalar("miePhaseFunctionG", -1.0),
        "ozone_absorption": ozone,
        "ground_albedo": np.array(vector("groundAlbedo")),
        "ozone_center_altitude": center,
        "ozone_half_width": half_width,
        "mie_phase": "cornette-shanks",
    }
