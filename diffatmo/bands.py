"""What a channel sees of a spectrum: cameras and spectrometers have bands, a model has wavelengths.

The light of the sky over that of the sun, L(λ)/E(λ), is smooth: neither the sun's lines nor a filter's edges are in it. So the
model is asked at a few wavelengths, *nodes*, for a sun of irradiance 1; between them a cubic spline goes through its answers;
and what the channel c sees is

    ∫ S_c(λ) E(λ) L(λ)/E(λ) dλ = Σ_j R_cj L_j,   R_cj = ∫ S_c(λ) E(λ) B_j(λ) dλ,

with the sensitivity S_c and the spline B_j that is 1 at node j and 0 at the others. The matrix R is the *response*.
"""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
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


COLOURS = ("red", "green", "blue")

COLUMNS = ("wavelength_nm", *COLOURS)
"""Of a table of sensitivities."""

VISIBLE = (400.0, 700.0)
"""What a table of sensitivities has to cover, nm; most that are published end there."""

WIDEST_STEP = 20.0
"""Between two rows of such a table, nm, beyond which straight lines are no sensitivities."""

DEEPEST = 0.5
"""Of a channel's largest sensitivity: how negative it may be. Those of sRGB, which a matrix has drawn apart, go to 0.37."""


class Curves(NamedTuple):
    """Sensitivities of the channels red, green and blue."""

    values: Float[np.ndarray, "n 3"]
    """Per unit of radiance, in any unit."""
    wavelengths: Float[np.ndarray, " n"]
    """nm; they rise."""


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


def read(path: str | Path) -> Curves:
    """Sensitivities from a table (CSV) with the columns :data:`COLUMNS` in any order; others are ignored.

    Raises :class:`ValueError` naming the file, if it cannot be read, is no such table, does not cover :data:`VISIBLE` closely,
    or is negative beyond what a matrix makes of a camera's.
    """
    try:
        return _checked(Path(path).read_bytes())
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _checked(data: bytes) -> Curves:
    try:
        rows = list(csv.reader(io.StringIO(data.decode("utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"not a CSV file: {error}") from None
    rows = [row for row in rows if row and not row[0].startswith("#")]
    names = [name.strip() for name in rows[0]] if rows else []
    if any(names.count(name) != 1 for name in COLUMNS):
        raise ValueError(f"columns {', '.join(names)}, expected {', '.join(COLUMNS)}, each once")
    try:
        table = np.array([[float(row[names.index(name)]) for name in COLUMNS] for row in rows[1:]]).reshape(-1, 4)
    except (ValueError, IndexError):
        raise ValueError(f"expected a number for each of {', '.join(COLUMNS)} in every row") from None
    at, values = table[:, 0], table[:, 1:]
    if not np.all(np.isfinite(table)):
        raise ValueError("expected finite numbers")
    if np.any(np.diff(at) <= 0):
        raise ValueError("wavelength_nm: expected numbers that rise from row to row")
    lower, upper = VISIBLE
    if at.size < 2 or at[0] > lower or at[-1] < upper:
        covered = f"covers {at[0]:g} to {at[-1]:g} nm" if at.size else "has no rows"
        raise ValueError(f"{covered}, expected {lower:g} to {upper:g} nm at least")
    if np.diff(at).max() > WIDEST_STEP:
        raise ValueError(f"rows are up to {np.diff(at).max():g} nm apart, expected {WIDEST_STEP:g} nm at most")
    for name, curve in zip(COLOURS, values.T, strict=True):
        if curve.max() <= 0:
            raise ValueError(f"{name} sees nothing, expected numbers above 0")
        if curve.min() < -DEEPEST * curve.max():
            lowest = f"{curve.min():g} at {at[int(np.argmin(curve))]:g} nm"
            raise ValueError(
                f"{name} is {lowest}, expected numbers from 0, or from {-DEEPEST:g} times its largest after a matrix"
            )
    return Curves(values, at)


def node_error(curves: Curves, nodes: Sequence[float] = NODES) -> float:
    """Relative error (RMS) of the channels for being asked for at ``nodes`` instead of every :data:`STEP`.

    Of light that air has scattered once and ozone absorbed, along paths of 1 to 10 air masses of both: the structure of ozone's
    absorption is most of it.
    """
    lower, upper = spectrum.WAVELENGTH_RANGE
    fine = np.arange(lower, upper + STEP / 2, STEP)

    def seen(at: Sequence[float] | np.ndarray) -> np.ndarray:
        picture = integrated(curves.values, curves.wavelengths, names=COLOURS, nodes=tuple(at))
        air = 8.0 * np.asarray(spectrum.rayleigh_scattering(jnp.asarray(at)), dtype=float)
        ozone = 15.0 * np.asarray(spectrum.ozone_absorption(jnp.asarray(at)), dtype=float)
        return np.stack([picture.response @ (air * np.exp(-mass * (air + ozone))) for mass in (1.0, 2.0, 5.0, 10.0)])

    return float(np.sqrt(np.mean((seen(nodes) / seen(fine) - 1) ** 2)))


def srgb(nodes: Sequence[float] = NODES) -> Bands:
    """Linear sRGB by the CIE 1931 2° observer, each channel divided by what it is for the sun: red, green, blue."""
    at, matching = color.observer()
    return integrated(matching @ color.XYZ_TO_SRGB.T, at, names=COLOURS, nodes=nodes)


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
