"""Single scattering along a ray, without phase functions: what every model of the sky starts from.

Bruneton & Neyret 2008, eq. 7 without the phase function: ΔS_R = ∫ T(view) T(sun) β_R ds, and the same for the aerosol.
They are smooth functions of (altitude, mu, mu_s, nu); multiplied by the exact phase functions they are exact.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffatmo import geometry, phase, rays, transmittance
from diffatmo._types import Altitude, Cosine, Radiance, Transmittance
from diffatmo.atmosphere import Atmosphere

AUREOLE_ORDERS = 2
"""Terms kept of repeated forward scattering (orders 2 and 3)."""


class Single(NamedTuple):
    """Phase-free single scattering along a ray that starts inside the atmosphere, per unit of phase function."""

    rayleigh: Float[Array, "... w"]
    mie: Float[Array, "... w"]
    aureole: tuple[Float[Array, "... w"], ...]
    """The aerosol integral weighted by τ^(n-1)/(n-1)!, τ the aerosol scattering optical depth towards the sun, n = 2, 3…"""
    transmittance: Transmittance
    """To the end of the ray."""


def integrate(
    atmosphere: Atmosphere,
    altitude: Altitude,
    mu: Cosine,
    mu_s: Cosine,
    nu: Cosine,
    ground: Float[Array, "..."],
    *,
    steps: int,
    aureole: int = 0,
    nodes: rays.Nodes | None = None,
) -> Single:
    """Integrate along each ray to its end, with four pieces of ``steps`` nodes cut where the planet's shadow begins.

    ``aureole`` more integrals serve repeated forward scattering. ``nodes`` (one piece) replaces the default quadrature.
    """
    radius = atmosphere.bottom_radius
    altitude, mu, mu_s, nu, ground = jnp.broadcast_arrays(altitude, mu, mu_s, nu, ground)
    if nodes is None:
        crossings = rays.shadow_crossings(altitude, mu, mu_s, nu, radius)
        nodes = rays.trace(altitude, mu, ground, radius, atmosphere.top_altitude, steps, crossings)
    along, end = transmittance.columns_along(atmosphere, altitude, mu, nodes, steps)
    mu_s_here = geometry.mu_s_along(
        altitude[..., None], mu_s[..., None], nu[..., None], nodes.distance, nodes.altitude, radius
    )
    towards_sun, free = transmittance.to_top(atmosphere, nodes.altitude, mu_s_here)
    depth = transmittance.spectral_depth(atmosphere, jax.tree.map(jnp.add, along, towards_sun))
    light = jnp.exp(-jnp.where(free, depth, 0)) * free
    air, aerosol = nodes.weight * transmittance.exponentials(transmittance.scale_heights(atmosphere), nodes.altitude)
    # τ^n / n! along the path to the sun, per power of the scattering coefficient.
    powers = [aerosol]
    for order in range(1, aureole + 1):
        powers.append(powers[-1] * jnp.where(free, towards_sun.exponential[1], 0) / order)
    sums = jnp.einsum("w...n,c...n->...cw", light, jnp.stack([air, *powers])) * atmosphere.solar_irradiance
    scattering = atmosphere.mie_scattering
    return Single(
        rayleigh=atmosphere.rayleigh_scattering * sums[..., 0, :],
        mie=scattering * sums[..., 1, :],
        aureole=tuple(scattering ** (order + 1) * sums[..., order + 1, :] for order in range(1, aureole + 1)),
        transmittance=jnp.exp(-transmittance.optical_depth(atmosphere, end)),
    )


def radiance(atmosphere: Atmosphere, single: Single, nu: Cosine) -> Radiance:
    """Single scattering with its phase functions (Bruneton & Neyret 2008, eq. 7)."""
    aerosol = phase.mie(nu, atmosphere.mie_g, atmosphere.mie_phase)
    return phase.rayleigh(nu)[..., None] * single.rayleigh + aerosol[..., None] * single.mie
