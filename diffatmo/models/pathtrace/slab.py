"""A plane-parallel slab, for which transfer has closed forms to test against."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffatmo.atmosphere import Atmosphere

FLATNESS = 1e6
"""Radius of the planet, and scale heights, of a slab of 1 km: it is flat and uniform to 1e-6.

Rays within 1e-3 of the horizontal see that it is not. 1e6 + 1 is a number that single precision holds exactly.
"""


def slab(
    *,
    rayleigh_optical_depth: Float[Array, " w"],
    mie_optical_depth: Float[Array, " w"],
    mie_albedo: float = 1.0,
    mie_g: float = 0.0,
    ground_albedo: float = 0.0,
) -> Atmosphere:
    """A uniform slab, 1 km thick and horizontally without end, under a solar irradiance of 1; for the path tracer.

    Vertical optical depths are those of scattering by air and of extinction by aerosol, of which the part ``mie_albedo`` is
    scattered; aerosol with ``mie_g`` = 0 scatters evenly in all directions. Other models integrate exponential layers in
    closed form, and lose their precision in one without end. Raises :class:`~diffatmo.atmosphere.AtmosphereError` for what no
    atmosphere can have.
    """
    air, aerosol = (jnp.atleast_1d(jnp.asarray(tau, float)) for tau in (rayleigh_optical_depth, mie_optical_depth))
    one: Float[Array, " w"] = jnp.ones_like(air + aerosol)
    far = jnp.asarray(FLATNESS)
    return Atmosphere(
        wavelengths=550 + jnp.arange(one.size),
        solar_irradiance=one,
        bottom_radius=far,
        top_radius=far + 1,
        rayleigh_scattering=one * air,
        rayleigh_scale_height=far,
        mie_scattering=one * mie_albedo * aerosol,
        mie_absorption=one * (1 - mie_albedo) * aerosol,
        mie_scale_height=far,
        mie_g=mie_g,
        ozone_absorption=0 * one,
        ground_albedo=ground_albedo * one,
    )
