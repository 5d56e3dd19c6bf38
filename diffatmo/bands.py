"""What a channel sees of a spectrum: cameras and spectrometers have bands, a model has wavelengths.

The light of the sky over that of the sun, L(λ)/E(λ), is smooth: neither the sun's lines nor a filter's edges are in it. So the
model is asked at a few wavelengths, *nodes*, for a sun of irradiance 1; between them a cubic spline goes through its answers;
and what the channel c sees is

    ∫ S_c(λ) E(λ) L(λ)/E(λ) dλ = Σ_j R_cj L_j,   R_cj = ∫ S_c(λ) E(λ) B_j(λ) dλ,

with the sensitivity S_c and the spline B_j that is 1 at node j and 0 at the others. The matrix R is the *response*.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from diffatmo import color, spectrum

NODES = (405.0, 455.0, 520.0, 570.0, 625.0, 720.0)
"""Wavelengths, nm, at which the model is asked for a colour picture: those six of a grid of 5 nm that serve sRGB best.

Against 81 wavelengths, 5 nm apart, the channels are off by 0.26, 0.26 and 0.21 % (RMS over the sky; 0.6 % at most), with the
sun from 30° to 93° from the zenith, clear or hazy; most of it is the structure of ozone's absorption at twilight.
"""

STEP = 5.0
"""Of integrals over the spectrum, nm."""


class Bands(NamedTuple):
    """The channels of a picture."""

    names: tuple[str, ...]
    centres: Float[np.ndarray, " channel"]
    """Mean wavelength of what a channel sees of a sky as white as the sun, nm."""
    response: Float[np.ndarray, "channel node"]
    nodes: tuple[float, ...]
    """Wavelengths of the model, nm."""


def interpolation(nodes: Sequence[float], wavelengths: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n node"]:
    """B_j at ``wavelengths`` (nm): cubic splines, not-a-knot; beyond the outer nodes they go on.

    Raises :class:`ValueError` for fewer than four nodes, or nodes that do not differ.
    """
    at = np.asarray(nodes, dtype=float)
    order = np.argsort(at)
    if at.size < 4 or not np.all(np.isfinite(at)) or np.any(np.diff(at[order]) <= 0):
        raise ValueError(f"nodes: got {at.tolist()} nm, expected at least four different wavelengths")
    splines = CubicSpline(at[order], np.eye(at.size)[order], axis=0)
    return np.asarray(splines(np.asarray(wavelengths, dtype=float)))


def integrated(
    sensitivity: Float[np.ndarray, "n channel"],
    wavelengths: Float[np.ndarray, " n"],
    *,
    names: Sequence[str],
    nodes: Sequence[float] = NODES,
) -> Bands:
    """Channels with these sensitivities (per unit of radiance), which may be negative, as those of a matrixed picture are.

    ``wavelengths`` (nm) rise; between them sensitivities are linear. A sky with the spectrum of the sun, L/E = 1, is 1 in every
    channel.

    Raises :class:`ValueError` for sensitivities that are not finite, see nothing, or go beyond the spectrum of the sun that is
    known.
    """
    at, curves = np.asarray(wavelengths, dtype=float), np.asarray(sensitivity, dtype=float)
    if at.ndim != 1 or at.size < 2 or np.any(np.diff(at) <= 0) or curves.shape != (at.size, len(names)):
        raise ValueError(
            f"sensitivity: got shape {curves.shape} at {at.size} wavelengths, expected ({at.size}, {len(names)}), and "
            "wavelengths that rise"
        )
    if not (np.all(np.isfinite(curves)) and np.all(np.isfinite(at))):
        raise ValueError("sensitivity: expected finite numbers")
    lower, upper = spectrum.WAVELENGTH_RANGE
    seen = np.abs(curves).max(axis=1) > 0
    if seen[(at < lower) | (at > upper)].any():
        raise ValueError(f"sensitivity: reaches beyond {lower:g} to {upper:g} nm, where the sun's spectrum is known")
    fine = np.arange(max(at[0], lower), min(at[-1], upper) + STEP / 2, STEP)
    sun = np.asarray(spectrum.solar_irradiance(jnp.asarray(fine)), dtype=float)
    weights = sun * np.stack([np.interp(fine, at, curve) for curve in curves.T])
    total = weights.sum(axis=1, keepdims=True)
    if np.any(total <= 0):
        raise ValueError(f"sensitivity: channel {names[int(np.argmin(total))]} sees no light")
    weights /= total
    positive = np.maximum(weights, 0)
    centres = positive @ fine / positive.sum(axis=1)
    return Bands(tuple(names), centres, weights @ interpolation(nodes, fine), tuple(map(float, nodes)))


def srgb(nodes: Sequence[float] = NODES) -> Bands:
    """Linear sRGB by the CIE 1931 2° observer, each channel divided by what it is for the sun: red, green, blue."""
    at, matching = color.observer()
    return integrated(matching @ color.XYZ_TO_SRGB.T, at, names=("red", "green", "blue"), nodes=nodes)


def narrow(
    centres: Float[np.ndarray, " channel"],
    irradiance: Float[np.ndarray, " channel"],
    *,
    nodes: Sequence[float],
) -> Bands:
    """Channels so narrow that L/E is constant in each: a spectrometer's. ``irradiance`` is the sun's in each of them."""
    at = np.asarray(centres, dtype=float)
    response = np.asarray(irradiance, dtype=float)[:, None] * interpolation(nodes, at)
    return Bands(tuple(f"{nm:g}" for nm in at), at, response, tuple(map(float, nodes)))
