"""From spectra to something a screen can show.

The path is: radiance at ``w`` wavelengths → linear sRGB (:func:`to_linear_srgb`) → exposure and tone curve
(:func:`tone_map`) → the sRGB transfer function (:func:`srgb_encode`); :func:`display` is all of it. Every step is
continuous and differentiable. What takes many operations is compiled as a whole; one by one they would cost a second.
"""

from functools import cache
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo._types import Radiance, Spectrum

XYZ_TO_SRGB = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)
"""CIE XYZ → linear sRGB, white point D65 (IEC 61966-2-1)."""

LUMINANCE = np.linalg.inv(XYZ_TO_SRGB)[1]
"""Weights of linear R, G, B in the luminance Y."""


@cache
def observer() -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths, nm, and colour-matching functions (n, 3) of the CIE 1931 2° observer."""
    with resources.files("diffatmo").joinpath("data", "cie1931_2deg.csv").open(encoding="utf-8") as file:
        table = np.loadtxt((line for line in file if not line.startswith(("#", "wavelength"))), delimiter=",")
    return table[:, 0], table[:, 1:]


@jax.jit
def xyz_weights(wavelengths: Spectrum) -> Float[Array, "w 3"]:
    """Contribution of a unit of radiance at each wavelength to X, Y, Z.

    The spectrum is taken to be linear between its wavelengths, in whatever order they come, and constant beyond the
    outer two, and that is integrated against the observer by the trapezoidal rule in steps of 1 nm, so that its curves
    do not undersample a spectrum given at a handful of wavelengths. A radiance of 1 everywhere has X = Y = Z = 1.
    """
    nodes, curves = observer()
    fine = np.arange(nodes[0], nodes[-1] + 0.5)
    matching = np.stack([np.interp(fine, nodes, curve) for curve in curves.T], axis=-1)
    order = jnp.argsort(wavelengths)
    hats = jax.vmap(lambda hat: jnp.interp(fine, wavelengths[order], hat))(jnp.eye(wavelengths.size)[:, order])
    return hats @ jnp.asarray(matching / matching.sum(axis=0))


@jax.jit
def to_linear_srgb(radiance: Radiance, *, wavelengths: Spectrum) -> Float[Array, "... 3"]:
    """Linear sRGB of a spectrum; components are negative for colours outside the gamut.

    Three bands are shown as they are, the longest wavelength as red, the shortest as blue: they are the primaries of a
    renderer, not samples of a spectrum. A single one is shown as grey. Any other number goes through CIE XYZ, scaled so
    that a spectrum equal to 1 everywhere has luminance 1.
    """
    if radiance.shape[-1] == 1:
        return jnp.broadcast_to(radiance, (*radiance.shape[:-1], 3))
    wavelengths = jnp.asarray(wavelengths, dtype=radiance.dtype)
    if radiance.shape[-1] == 3:
        return radiance[..., jnp.argsort(-wavelengths)]
    return radiance @ (xyz_weights(wavelengths) @ jnp.asarray(XYZ_TO_SRGB.T, dtype=radiance.dtype))


@jax.jit
def to_linear_srgb_of_sunlight(
    radiance: Radiance, *, wavelengths: Spectrum, irradiance: Spectrum
) -> Float[Array, "... 3"]:
    """Linear sRGB of light from a sun of ``irradiance``, which is white where it is the same at all wavelengths.

    Such a sun is no spectrum but what the light is relative to: through CIE XYZ alone, it would be pink.
    """
    irradiance = jnp.asarray(irradiance, dtype=radiance.dtype)
    white = to_linear_srgb(jnp.ones_like(irradiance), wavelengths=wavelengths)
    relative = jnp.all(irradiance == irradiance[0])
    return to_linear_srgb(radiance, wavelengths=wavelengths) / jnp.where(relative, white, 1)


def luminance(rgb: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Luminance Y of linear sRGB."""
    return rgb @ jnp.asarray(LUMINANCE, dtype=rgb.dtype)


@jax.jit
def auto_exposure(rgb: Float[Array, "... 3"], *, percentile: float = 90.0, level: float = 1.0) -> Float[Array, ""]:
    """The factor that brings the given percentile of luminance to ``level``; 1 for a picture that is black there.

    ``level`` = 1 comes out of :func:`tone_map` as 63 % of white. A percentile keeps the sun from deciding. Pixels that are
    NaN do not count.
    """
    reference = jnp.nanpercentile(luminance(rgb).ravel(), percentile)
    lit = reference > 0
    return jnp.where(lit, level / jnp.where(lit, reference, 1), 1.0)


def tone_map(rgb: Float[Array, "... 3"], *, exposure: float | Float[Array, ""] = 1.0) -> Float[Array, "... 3"]:
    """1 - exp(-exposure · rgb): film's response (Bruneton & Neyret 2008, section 5), from 0 to 1 for 0 to infinity."""
    return -jnp.expm1(-exposure * jnp.maximum(rgb, 0))


def srgb_encode(linear: Float[Array, "..."]) -> Float[Array, "..."]:
    """Linear intensity in [0, 1] → sRGB code value (IEC 61966-2-1)."""
    low = linear <= 0.0031308
    return jnp.where(low, 12.92 * linear, 1.055 * jnp.where(low, 1, linear) ** (1 / 2.4) - 0.055)


def srgb_decode(encoded: Float[Array, "..."]) -> Float[Array, "..."]:
    """SRGB code value in [0, 1] → linear intensity: the inverse of :func:`srgb_encode`."""
    low = encoded <= 0.04045
    return jnp.where(low, encoded / 12.92, ((jnp.where(low, 1, encoded) + 0.055) / 1.055) ** 2.4)


@jax.jit
def display(
    radiance: Radiance, *, wavelengths: Spectrum, exposure: float | Float[Array, ""] = 1.0
) -> Float[Array, "... 3"]:
    """Code values in [0, 1] for a screen."""
    return encode(to_linear_srgb(radiance, wavelengths=wavelengths), exposure=exposure)


@jax.jit
def encode(rgb: Float[Array, "... 3"], *, exposure: float | Float[Array, ""] = 1.0) -> Float[Array, "... 3"]:
    """Code values in [0, 1] for a screen, of linear sRGB."""
    return srgb_encode(tone_map(rgb, exposure=exposure))
