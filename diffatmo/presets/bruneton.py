"""Bruneton's precomputed_atmospheric_scattering, as a C++ header with the arguments of the constructor of its ``Model``.

Lengths are in metres, coefficients in 1/m, wavelengths in nm and rising; the aerosol's phase function is Cornette-Shanks'.
"""

import re
from typing import Any

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

TO_METRES = 3


def dumps(atmosphere: Atmosphere, remarks: str) -> str:
    """A header, for any number of wavelengths from red to blue."""
    center, half_width = (
        float(decimals(x)[0].scaleb(TO_METRES)) for x in (atmosphere.ozone_center_altitude, atmosphere.ozone_half_width)
    )

    def spectrum(name: str, values: object, power: int = 0) -> str:
        items = values if isinstance(values, list) else decimals(values)
        return f"const std::vector<double> {name} = {{{', '.join(plain(x.scaleb(power)) for x in reversed(items))}}};\n"

    def scalar(name: str, value: object, power: int = 0) -> str:
        return f"constexpr double {name} = {plain(decimals(value)[0].scaleb(power))};\n"

    def density(name: str, parts: list[layers.Layer]) -> str:
        rows = ",\n".join(f"    DensityProfileLayer({', '.join(map(plain, part))})" for part in parts)
        return f"const std::vector<DensityProfileLayer> {name} = {{\n{rows}\n}};\n"

    def falling(name: str, scale_height: object) -> str:
        return density(name, [layers.exponential(float(decimals(scale_height)[0].scaleb(TO_METRES)))])

    constants = (
        spectrum("kWavelengths", atmosphere.wavelengths),
        spectrum("kSolarIrradiance", atmosphere.solar_irradiance),
        scalar("kBottomRadius", atmosphere.bottom_radius, TO_METRES),
        scalar("kTopRadius", atmosphere.top_radius, TO_METRES),
        falling("kRayleighDensity", atmosphere.rayleigh_scale_height),
        spectrum("kRayleighScattering", atmosphere.rayleigh_scattering, -TO_METRES),
        falling("kMieDensity", atmosphere.mie_scale_height),
        spectrum("kMieScattering", atmosphere.mie_scattering, -TO_METRES),
        spectrum("kMieExtinction", total(atmosphere.mie_scattering, atmosphere.mie_absorption), -TO_METRES),
        scalar("kMiePhaseFunctionG", asymmetry_as(atmosphere, "cornette-shanks")),
        density("kAbsorptionDensity", layers.tent(center, half_width)),
        spectrum("kAbsorptionExtinction", atmosphere.ozone_absorption, -TO_METRES),
        spectrum("kGroundAlbedo", atmosphere.ground_albedo),
    )
    return f"""{remarks}#ifndef ATMOSPHERE_PRESET_H_
#define ATMOSPHERE_PRESET_H_

#include <vector>

#include "atmosphere/model.h"

namespace atmosphere {{
namespace preset {{

{"".join(constants)}
}}  // namespace preset
}}  // namespace atmosphere

#endif  // ATMOSPHERE_PRESET_H_
"""


def loads(text: str, wavelengths: Wavelengths) -> dict[str, Any]:
    """The parameters in a header, which says its wavelengths itself."""
    del wavelengths
    code = re.sub(r"//[^\n]*|/\*.*?\*/", "", text, flags=re.DOTALL)

    def value(key: str, pattern: str) -> str:
        found = re.search(rf"\b{key}\s*=\s*{pattern}\s*;", code, re.DOTALL)
        if found is None:
            raise PresetError(f"{key}: missing or cut off, expected a constant of that name")
        return found[1]

    def scalar(key: str, lowest: float = 0.0) -> float:
        return number(key, value(key, "([^;{]*?)"), lowest=lowest)

    rising = numbers("kWavelengths", value("kWavelengths", r"\{([^{}]*)\}"))

    def spectrum(key: str, power: int = 0) -> list[float]:
        return scaled(numbers(key, value(key, r"\{([^{}]*)\}"), len(rising)), power)[::-1]

    def density(key: str) -> list[layers.Layer]:
        rows = re.findall(r"DensityProfileLayer\(([^()]*)\)", value(key, r"\{([^{}]*)\}"))
        parsed = [tuple(number(key, item) for item in row.split(",")) for row in rows]
        if not parsed or any(len(row) != 5 for row in parsed):
            raise PresetError(f"{key}: expected one or two DensityProfileLayer of five numbers")
        return parsed  # type: ignore[return-value]

    scattering, extinction = (spectrum(key, TO_METRES) for key in ("kMieScattering", "kMieExtinction"))
    ozone, center, half_width = spectrum("kAbsorptionExtinction", TO_METRES), 25e3, 15e3
    if any(ozone):
        center, half_width = layers.center_and_half_width("kAbsorptionDensity", density("kAbsorptionDensity"))
    heights = [layers.scale_height(key, density(key)) for key in ("kRayleighDensity", "kMieDensity")]
    lengths = [scalar("kBottomRadius"), scalar("kTopRadius"), *heights, center, half_width]
    bottom, top, rayleigh_height, mie_height, center, half_width = scaled(lengths, -TO_METRES)
    return {
        "wavelengths": rising[::-1],
        "solar_irradiance": spectrum("kSolarIrradiance"),
        "bottom_radius": bottom,
        "top_radius": top,
        "rayleigh_scattering": spectrum("kRayleighScattering", TO_METRES),
        "rayleigh_scale_height": rayleigh_height,
        "mie_scattering": scattering,
        "mie_absorption": rest("kMieExtinction", extinction, scattering),
        "mie_scale_height": mie_height,
        "mie_g": scalar("kMiePhaseFunctionG", -1.0),
        "ozone_absorption": ozone,
        "ground_albedo": spectrum("kGroundAlbedo"),
        "ozone_center_altitude": center,
        "ozone_half_width": half_width,
        "mie_phase": "cornette-shanks",
    }
