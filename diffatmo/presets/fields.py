"""What the presets share: their error, numbers as text that lose no digit, and what becomes of an atmosphere's spectra."""

import dataclasses
import math
import re
from collections.abc import Sequence
from decimal import Decimal
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from diffatmo import phase
from diffatmo.atmosphere import SPECTRAL, Atmosphere

Wavelengths: TypeAlias = Float[np.ndarray, " w"]

RED_GREEN_BLUE = (680.0, 550.0, 440.0)
"""Wavelengths, nm, that stand for a renderer's channels where nothing else is said (Bruneton & Neyret 2008)."""


class PresetError(ValueError):
    """A preset cannot be read or written; the message names the key and what would be right."""


def decimals(value: Any) -> list[Decimal]:
    """The decimals with the fewest digits that read back as the same numbers, of an array or of one number."""
    return [Decimal(str(item)) for item in np.atleast_1d(np.asarray(value))]


def plain(value: Decimal | float) -> str:
    """A number as any language reads it, with a point or an exponent, so that none takes it for an integer."""
    text = repr(float(value))
    return text if re.search(r"[.e]", text) else f"{text}.0"


def number(key: str, text: str, *, lowest: float = -math.inf, highest: float = math.inf) -> float:
    """The number in ``text``; :class:`PresetError` for anything else, or one out of range."""
    expected = "a finite number"
    if not math.isinf(lowest):
        expected = (
            f"a number of at least {lowest:g}" if math.isinf(highest) else f"a number from {lowest:g} to {highest:g}"
        )
    try:
        value = float(text.strip())
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and lowest <= value <= highest):
        raise PresetError(f"{key}: got {text.strip() or 'nothing'}, expected {expected}")
    return value


def numbers(key: str, text: str, count: int | None = None) -> list[float]:
    """The numbers, none of them negative, with commas between them in ``text``."""
    items = [number(key, item, lowest=0) for item in text.strip().rstrip(",").split(",")]
    if count is not None and len(items) != count:
        raise PresetError(f"{key}: got {len(items)} numbers, expected {count}")
    return items


def scaled(values: Sequence[float], power: int) -> list[float]:
    """``values`` times ten to the ``power``, without the rounding of a product."""
    return [float(Decimal(repr(value)).scaleb(power)) for value in values]


def total(first: Any, second: Any) -> list[Decimal]:
    """The sums of two spectra, without their rounding."""
    return [a + b for a, b in zip(decimals(first), decimals(second), strict=True)]


def rest(key: str, whole: Sequence[float], part: Sequence[float]) -> list[float]:
    """``whole`` - ``part``, without their rounding; ``key`` is the name of the whole."""
    left = [float(Decimal(repr(a)) - Decimal(repr(b))) for a, b in zip(whole, part, strict=True)]
    if min(left) < 0:
        raise PresetError(f"{key}: got {list(whole)}, expected no less than the scattering, {list(part)}")
    return left


def arranged(atmosphere: Atmosphere, *, three: bool) -> Atmosphere:
    """``atmosphere`` with its wavelengths from red to blue; with ``three``, as the channels of a renderer.

    Three wavelengths are the channels as they are, the longest red. Any other number is interpolated linearly to
    :data:`RED_GREEN_BLUE`, constant beyond the outer two.
    """
    wavelengths = np.asarray(atmosphere.wavelengths)
    order = np.argsort(-wavelengths)
    spectra: dict[str, Any] = {name: np.asarray(getattr(atmosphere, name))[order] for name in SPECTRAL}
    if three and wavelengths.size != 3:
        spectra = {
            name: np.interp(RED_GREEN_BLUE, wavelengths[order][::-1], values[::-1]) for name, values in spectra.items()
        } | {"wavelengths": np.asarray(RED_GREEN_BLUE)}
    return dataclasses.replace(atmosphere, **spectra)


def asymmetry_as(atmosphere: Atmosphere, name: str) -> float:
    """The ``mie_g`` with which the phase function ``name`` has the mean cosine of the atmosphere's.

    That of Cornette-Shanks is a = 3 g (4 + g²) / (5 (2 + g²)), which rises with g from -1 to 1.
    """
    if atmosphere.mie_phase == name:
        return float(str(np.asarray(atmosphere.mie_g)))
    mean = float(phase.mie_moments(atmosphere.mie_g, 1, atmosphere.mie_phase)[1])
    roots = np.roots([3, -5 * mean, 12, -10 * mean])
    g = mean if name == "henyey-greenstein" else roots[np.argmin(np.abs(roots.imag))].real
    return float(str(np.asarray(g, atmosphere.mie_g.dtype)))
