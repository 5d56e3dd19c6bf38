"""The moments of all orders of scattering: the first by quadrature, the others by iterating a linear map."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffatmo import phase, table, transmittance
from diffatmo._types import Altitude
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.moments.angular import cosines, degrees, orders, pairs, relative_nu
from diffatmo.models.moments.shell import Links, Rays, Shell
from diffatmo.numerics import safe_divide


class Degrees(NamedTuple):
    """Degrees to which the moments are kept."""

    first: int
    """Of single scattering."""
    iterate: int
    """Of all orders in the iteration."""
    source: int
    """Of single scattering, as a source of the higher orders in the last gather."""
    last: int
    """Of the higher orders after it."""


class State(NamedTuple):
    """Moments M_lm of the radiance, and the irradiance of the ground by the sky, both divided by ``dusk``."""

    moments: Float[Array, "i lm w j"]
    irradiance: Float[Array, "w j"]


def _tail(last: Float[Array, "..."], previous: Float[Array, "..."]) -> Float[Array, "..."]:
    """Σ_{n>=1} (last / previous)^n, for the orders beyond the last one computed."""
    ratio = jnp.clip(safe_divide(last, previous), 0, 0.95)
    return ratio / (1 - ratio)


def _moments(r: Rays, by_order: Float[Array, "m i k w j"], degree: int) -> Float[Array, "i lm w j"]:
    """Moments M_lm to ``degree`` from the azimuthal integrals ∫ L cos(m φ) dφ at every direction node."""
    count = len(pairs(degree))
    moments = jnp.einsum("cikwj,ikc->icwj", by_order[orders(degree)], r.project[..., :count])
    return moments * r.sun_scale[:count, None]


def _irradiance(r: Rays, around: Float[Array, "i k w j"]) -> Float[Array, "w j"]:
    """Irradiance of the ground by the sky: ∫ L dφ at the lowest node from above its horizon, times mu."""
    return jnp.einsum("kwj,k->wj", around[0], jnp.where(r.ground, 0, r.solid_angle[0] * r.mu[0]))


def _harmonics(degree: int, cosine: Float[Array, " p"]) -> Float[Array, "p m"]:
    """Weights of ∫ … cos(m φ) dφ over the circle, at azimuths with the given cosines."""
    return table.chebyshev(degree + 1, cosine) * (2 * jnp.pi / cosine.size)


def _first_order(atmosphere: Atmosphere, shell: Shell, degree: int, peak_azimuths: int) -> State:
    """Moments and ground irradiance, over ``dusk``, of light scattered once or reflected by the ground once."""
    r = shell.first
    nodes = r.nodes
    i, k, n = nodes.altitude.shape
    p, j = r.azimuths, shell.mu_s.size
    start = jnp.broadcast_to(shell.altitude[:, None], r.mu.shape)
    along, end = transmittance.columns_along(atmosphere, start, r.mu, nodes, r.steps)
    view = jnp.exp(-transmittance.optical_depth(atmosphere, along)) * nodes.weight[..., None]
    # Few axes, long inside, wavelengths outside: short inner axes would cost the vector units. The optical depth is a
    # matrix product so that the columns are computed once, not once per wavelength.
    mu_s_here = r.mu_s_here.reshape(i * k * n, p * j)
    here = jnp.broadcast_to(nodes.altitude.reshape(-1, 1), mu_s_here.shape)
    towards_sun, free = transmittance.to_top(atmosphere, here, mu_s_here)
    columns = jnp.stack([jnp.where(free, column, 0) for column in towards_sun])
    depth = jnp.einsum("cw,crt->wrt", transmittance.extinction(atmosphere), columns)
    light = (jnp.exp(-depth) * free).reshape(-1, i, k, n, p * j)
    profiles = (atmosphere.rayleigh_density, atmosphere.mie_density)
    coefficients = (atmosphere.rayleigh_scattering, atmosphere.mie_scattering)
    weight = jnp.stack(
        [profile(nodes.altitude)[..., None] * view * c for profile, c in zip(profiles, coefficients, strict=True)]
    )
    smooth = jnp.einsum("wiknt,ciknw->wikct", light, weight).reshape(-1, i, k, 2, p, j)
    # In azimuth the integrals are polynomials of low degree; the peak of the phase function needs many more azimuths, but
    # only its own integrals against those polynomials and cos(m φ).
    dtype = shell.altitude.dtype
    fine = cosines(peak_azimuths, dtype)
    to_fine = table.chebyshev(p, fine) @ jnp.asarray(table.chebyshev_coefficients(p), dtype)
    harmonics = _harmonics(degree, fine)
    products = (to_fine[:, :, None] * harmonics[:, None, :]).reshape(peak_azimuths, -1)
    nu = relative_nu(r.mu[..., None, None], shell.mu_s[:, None], fine)
    aerosol = phase.mie(nu, atmosphere.mie_g, atmosphere.mie_phase)
    # Normalised over the very nodes it is summed on: a peak between nodes loses no light.
    norm = jnp.einsum("ikj,ik->ij", aerosol @ harmonics[:, 0], r.solid_angle)
    phases = jnp.stack([phase.rayleigh(nu), aerosol / norm[:, None, :, None]])
    turned = (phases @ products).reshape(2, i, k, j, p, degree + 1)
    by_order = jnp.einsum("cikjpm,wikcpj->mikwj", turned, smooth)
    ground_level = jnp.zeros_like(r.mu_s_ground)
    sunlit = jnp.maximum(r.mu_s_ground, 0)[..., None] * transmittance.to_sun(atmosphere, ground_level, r.mu_s_ground)
    sky_count = k - r.mu_s_ground.shape[1]
    survives = jnp.exp(-transmittance.optical_depth(atmosphere, end))[:, sky_count:, None, None, :]
    reflected = atmosphere.ground_albedo / jnp.pi * survives * sunlit
    reflected = jnp.einsum("igpjw,pm->migwj", reflected, to_fine.T @ harmonics)
    by_order = by_order.at[:, :, sky_count:].add(reflected)
    by_order = by_order * (atmosphere.solar_irradiance[:, None] / shell.dusk)
    return State(_moments(r, by_order, degree), _irradiance(r, by_order[0]))


class _Transport(eqx.Module):
    """K: from the moments of one order of scattering to those of the next, over one set of links."""

    shell: Shell
    links: Links
    albedo: Float[Array, " w"]
    weight: Float[Array, "i k n l w"]
    """T times (β_R χ^R_l + β_M χ^M_l) times the quadrature weight."""
    survives: Float[Array, "i g w"]
    degree: int = eqx.field(static=True)

    @classmethod
    def build(cls, atmosphere: Atmosphere, shell: Shell, links: Links, degree: int) -> "_Transport":
        """Prepare for moments of ``degree``."""
        r = links.rays
        start = jnp.broadcast_to(shell.altitude[:, None], r.mu.shape)
        along, end = transmittance.columns_along(atmosphere, start, r.mu, r.nodes, r.steps)
        view = jnp.exp(-transmittance.optical_depth(atmosphere, along)) * r.nodes.weight[..., None]
        source = source_moments(atmosphere, r.nodes.altitude, degree)
        survives = jnp.exp(-transmittance.optical_depth(atmosphere, end))[:, r.mu.shape[1] - r.mu_s_ground.shape[1] :]
        return cls(shell, links, atmosphere.ground_albedo, view[..., None, :] * source, survives, degree)

    def apply(self, state: State, degree: int) -> State:
        """The next order; its moments to ``degree``."""
        links, r = self.links, self.links.rays
        i, count, w, j = state.moments.shape
        k, n, p = *r.nodes.altitude.shape[1:], r.azimuths
        there = jnp.einsum("iknh,hc->iknc", links.altitude_rows, state.moments.reshape(i, -1))
        moments = jnp.einsum("ikncs,iknst->iknct", there.reshape(i, k, n, count * w, j), links.sun_rows)
        moments = moments.reshape(i, k, n, count, w, p * j)
        weight = self.weight[:, :, :, degrees(self.degree), :, None]
        radiance = jnp.sum(moments * links.angular[:, :, :, :, None] * weight, axis=(2, 3))
        falling = jnp.einsum("ws,igst->igwt", state.irradiance, links.ground_rows)
        reflected = (self.albedo / jnp.pi * self.survives)[..., None] * falling
        radiance = radiance.at[:, k - reflected.shape[1] :].add(reflected)
        radiance = radiance.reshape(i, k, w, p, j) / self.shell.dusk
        harmonics = _harmonics(degree, cosines(p, radiance.dtype))
        by_order = jnp.einsum("ikwpj,pm->mikwj", radiance, harmonics)
        return State(_moments(r, by_order, degree), _irradiance(r, by_order[0]))


def source_moments(atmosphere: Atmosphere, altitude: Altitude, degree: int) -> Float[Array, "... l w"]:
    """β_R(h) χ^R_l + β_M(h) χ^M_l, km^-1, for l = 0 … degree."""
    air = jnp.asarray(phase.rayleigh_moments(degree), altitude.dtype)[:, None] * atmosphere.rayleigh_scattering
    aerosol = phase.mie_moments(atmosphere.mie_g, degree, atmosphere.mie_phase)[:, None] * atmosphere.mie_scattering
    densities = atmosphere.rayleigh_density(altitude), atmosphere.mie_density(altitude)
    return densities[0][..., None, None] * air + densities[1][..., None, None] * aerosol


def solve(atmosphere: Atmosphere, shell: Shell, *, order: int, degrees_: Degrees, peak_azimuths: int) -> State:
    """Moments of all scattered light, and the irradiance of the ground by the sky, both divided by ``dusk``.

    Orders of scattering up to ``order`` are computed one by one, the rest is a geometric tail.
    """
    first = _first_order(atmosphere, shell, degrees_.first, peak_azimuths)
    seed = State(first.moments[:, : len(pairs(degrees_.iterate))], first.irradiance)
    transport = _Transport.build(atmosphere, shell, shell.iterate, degrees_.iterate)

    def next_order(carry: tuple[State, State, State], _: None) -> tuple[tuple[State, State, State], None]:
        total, term, _previous = carry
        following = transport.apply(term, degrees_.iterate)
        total = State(total.moments + following.moments, total.irradiance + following.irradiance)
        return (total, following, term), None

    (total, term, previous), _ = jax.lax.scan(next_order, (seed, seed, seed), None, length=order - 1)
    # Geometric tail: far along the series each order is the one before times a ratio, here that of the mean radiance.
    tail = _tail(term.moments[:, :1], previous.moments[:, :1])
    ground_tail = _tail(term.irradiance, previous.irradiance)
    total = State(total.moments + tail * term.moments, total.irradiance + ground_tail * term.irradiance)
    # What the iteration has of low degree, and what single scattering has of higher: the source of the last gather.
    moments = first.moments[:, : len(pairs(degrees_.source))].at[:, : total.moments.shape[1]].set(total.moments)
    gather = _Transport.build(atmosphere, shell, shell.last, degrees_.source)
    beyond = gather.apply(State(moments, total.irradiance), degrees_.last)
    kept = beyond.moments.shape[1]
    return State(first.moments.at[:, :kept].add(beyond.moments), first.irradiance + beyond.irradiance)
