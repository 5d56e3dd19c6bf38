"""Array aliases for the quantities of the project.

``...`` stands for any batch of rays or points, ``w`` for wavelengths (always the trailing axis).
"""

from typing import TypeAlias

from jaxtyping import Array, Float

Scalar: TypeAlias = Float[Array, ""]
Spectrum: TypeAlias = Float[Array, " w"]

Altitude: TypeAlias = Float[Array, "..."]
"""Height above the ground, km."""

Length: TypeAlias = Float[Array, "..."]
"""Distance along a ray, km."""

Cosine: TypeAlias = Float[Array, "..."]
"""Cosine of an angle: ``mu`` (view zenith), ``mu_s`` (sun zenith), ``nu`` (view to sun)."""

Direction: TypeAlias = Float[Array, "... 3"]
"""Unit vector in the local frame: x east, y north, z up."""

Radiance: TypeAlias = Float[Array, "... w"]
"""W m^-2 sr^-1 nm^-1, or relative to the solar irradiance given."""

Irradiance: TypeAlias = Float[Array, "... w"]
"""W m^-2 nm^-1, or relative to the solar irradiance given."""

Transmittance: TypeAlias = Float[Array, "... w"]
"""Fraction of the light that survives a path."""

OpticalDepth: TypeAlias = Float[Array, "... w"]
"""-ln(transmittance)."""
