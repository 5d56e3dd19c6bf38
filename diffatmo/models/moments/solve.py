"""The moments of all orders of scattering: the first by quadrature, the others by iterating a linear map.

Contractions over more than one axis, or of vectors in a batch, are written as sums of products: XLA makes loops of them that
keep the vector units busy. As ``einsum`` they are batches of tiny matrix products, ten times slower.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo import phase, table, transmittance
from diffatmo._types import Altitude, Scalar
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.moments.angular import azimuthal, cosines, degrees, orders, pairs, relative_nu
from diffatmo.models.moments.shell import Links, Rays, Shell, Ways
from diffatmo.numerics import per_parameter, tiny
from diffatmo.rays import PIECES, Nodes


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


def _tail(last: Float[Array, "..."], before: Float[Array, "..."]) -> Float[Array, "..."]:
    """Σ_{n>=1} r^n with r² = last / before, two orders apart, for the orders beyond the last one computed.

    Over a bright ground the ratio of one order to the next swings about its limit, as light goes down and up.
    """
    # Squared by the derivative, what is smaller would overflow; such light is of no account.
    counts = jnp.minimum(last, before) > tiny(before.dtype)
    square = jnp.where(counts, last, 1) / jnp.where(counts, before, 1)
    ratio = jnp.where(counts, jnp.minimum(jnp.sqrt(square), 0.95), 0)
    return ratio / (1 - ratio)


def _moments(r: Rays, by_order: Float[Array, "i m k w j"], degree: int) -> Float[Array, "i lm w j"]:
    """Moments M_lm to ``degree`` from the azimuthal integrals ∫ L cos(m φ) dφ at every direction node."""
    count = len(pairs(degree))
    project = jnp.swapaxes(r.project[..., :count], 1, 2)[..., None, None]
    return jnp.sum(by_order[:, orders(degree)] * project, axis=2) * r.sun_scale[:count, None]


def _below(values: Float[Array, "..."], sky: int, *, axis: int) -> Float[Array, "..."]:
    """``values`` in the directions below the horizon, after ``sky`` zeros for those above."""
    return jnp.pad(values, [(sky if a == axis else 0, 0) for a in range(values.ndim)])


def _irradiance(r: Rays, around: Float[Array, "i k w j"]) -> Float[Array, "w j"]:
    """Irradiance of the ground by the sky: ∫ L dφ at the lowest node from above its horizon, times mu."""
    weight = jnp.where(r.ground, 0, r.solid_angle[0] * r.mu[0])
    return jnp.sum(around[0] * weight[:, None, None], axis=0)


def _harmonics(degree: int, cosine: Float[Array, " p"]) -> Float[Array, "p m"]:
    """Weights of ∫ … cos(m φ) dφ over the circle, at azimuths with the given cosines."""
    return table.chebyshev(degree + 1, cosine) * (2 * jnp.pi / cosine.size)


def _first_order(atmosphere: Atmosphere, shell: Shell, degree: int, peak_azimuths: int) -> State:
    """Moments and ground irradiance, over ``dusk``, of light scattered once or reflected by the ground once."""
    r = shell.first
    parts = shell.altitude, r.mu, r.solid_angle, r.nodes, r.mu_s_here, r.mu_s_ground
    # One altitude node after another: the temporary arrays stay in the cache.
    by_order = jax.lax.map(lambda part: _first_order_at(atmosphere, shell.mu_s, degree, peak_azimuths, *part), parts)
    by_order = by_order * (atmosphere.solar_irradiance[:, None] / shell.dusk)
    return State(_moments(r, by_order, degree), _irradiance(r, by_order[:, 0]))


def _peak(mie_phase: phase.Shape) -> Callable[..., Float[Array, "1 ..."]]:
    """The aerosol's phase function with g, shape (1,), at every nu, normalised over the very nodes it is summed on.

    A peak between nodes loses no light.
    """

    @per_parameter
    def peak(
        g: Float[Array, " 1"], nu: Float[Array, "f k j"], solid_angle: Float[Array, " k"]
    ) -> Float[Array, "1 f k j"]:
        aerosol = phase.mie(nu, g[0], mie_phase)
        norm = 2 * jnp.pi * jnp.mean(jnp.sum(aerosol * solid_angle[:, None], axis=1), axis=0)
        if isinstance(mie_phase, phase.PhaseTable):
            # A formula is positive everywhere, a table may be zero at all nodes; its light is then spread, not lost.
            seen = norm > tiny(norm.dtype)
            aerosol, norm = jnp.where(seen, aerosol, 1), jnp.where(seen, norm, 4 * jnp.pi)
        return (aerosol / norm)[None]

    return peak


def _first_order_at(
    atmosphere: Atmosphere,
    mu_s: Float[Array, " j"],
    degree: int,
    peak_azimuths: int,
    altitude: Scalar,
    mu: Float[Array, " k"],
    solid_angle: Float[Array, " k"],
    nodes: Nodes,
    mu_s_here: Float[Array, "k n p j"],
    mu_s_ground: Float[Array, "g p j"],
) -> Float[Array, "m k w j"]:
    """∫ L cos(m φ) dφ at one altitude."""
    k, n, p, j = mu_s_here.shape
    start = jnp.broadcast_to(altitude, mu.shape)
    columns = transmittance.columns_to(atmosphere, start, mu, nodes, n // PIECES)
    survives = jnp.exp(-transmittance.optical_depth(atmosphere, columns))
    view = survives[:, :-1] * nodes.weight[..., None]
    # Few axes, long inside, wavelengths outside: short inner axes would cost the vector units.
    # The last rows are the points where rays meet the ground.
    mu_s_flat = jnp.concatenate([mu_s_here.reshape(k * n, p * j), mu_s_ground.reshape(-1, p * j)])
    altitudes = jnp.pad(nodes.altitude.reshape(-1), (0, mu_s_ground.shape[0]))
    here = jnp.broadcast_to(altitudes[:, None], mu_s_flat.shape)
    sunlight = transmittance.spectral_to_sun(atmosphere, here, mu_s_flat)
    light = sunlight[:, : k * n].reshape(-1, k, n, p * j)
    densities = transmittance.exponentials(transmittance.scale_heights(atmosphere), nodes.altitude)
    coefficients = jnp.stack([atmosphere.rayleigh_scattering, atmosphere.mie_scattering])
    weight = densities[..., None] * view * coefficients[:, None, None]
    smooth = jnp.einsum("cknw,wknt->kwct", weight, light).reshape(k, -1, 2, p, j)
    # In azimuth the integrals are polynomials of low degree; the peak of the phase function needs many more azimuths, but
    # only its own integrals against those polynomials and cos(m φ).
    fine = cosines(peak_azimuths, mu.dtype)
    to_fine = table.chebyshev(p, fine) @ jnp.asarray(table.chebyshev_coefficients(p), mu.dtype)
    harmonics = _harmonics(degree, fine)
    products = to_fine[:, :, None] * harmonics[:, None, :]
    nu = relative_nu(mu[:, None], mu_s, fine[:, None, None])
    phases = phase.rayleigh(nu), _peak(atmosphere.mie_phase)(atmosphere.mie_g[None], nu, solid_angle)[0]
    turned = [jnp.swapaxes(jnp.tensordot(products.T, phase_, axes=1), 1, 2)[:, :, None] for phase_ in phases]
    by_order = sum(jnp.sum(turned[c] * smooth[:, :, c], axis=3) for c in range(2))
    sunlit = jnp.maximum(mu_s_ground, 0) * sunlight[:, k * n :].reshape(-1, *mu_s_ground.shape)
    sky = k - mu_s_ground.shape[0]
    reflected = (atmosphere.ground_albedo / jnp.pi * survives[sky:, -1]).T[..., None, None] * sunlit
    reflected = jnp.tensordot(reflected, to_fine.T @ harmonics, axes=(2, 0)).transpose(3, 1, 0, 2)
    return by_order + _below(reflected, sky, axis=1)


def gather(
    moments: Float[Array, "h c w s"], ways: Ways, weight: Float[Array, "k n c w"], m_of: np.ndarray
) -> Float[Array, "k w *suns"]:
    """Light scattered towards the start of ``k`` rays: moments interpolated to their ``n`` nodes, weighted, summed.

    Sums over l come first, as what depends on azimuth depends on m only; ``m_of`` is the m of every moment.
    """
    degree = m_of.max()
    order = np.argsort(m_of, kind="stable")
    ends = np.cumsum(np.bincount(m_of))
    there = jnp.einsum("knh,hcws->kncws", ways.altitude_rows, moments[:, order]) * weight[:, :, order, :, None]
    by_m = jnp.stack([jnp.sum(part, axis=2) for part in jnp.split(there, ends[:-1], axis=2)], axis=2)
    sun_rows = ways.sun.rows(moments.shape[-1], axis=2)
    here = jnp.einsum("knmws,kns...->knmw...", by_m, sun_rows)
    around = azimuthal(degree, ways.w, ways.q)
    # One sum over m inside, one over n outside: a sum for each m would go through the arrays as often.
    return jnp.sum(sum(here[:, :, m] * around[m][:, :, None] for m in range(degree + 1)), axis=1)


class _Transport(eqx.Module):
    """From single scattering, and from all further light, to the next order of scattering, over one set of links.

    Further light is known to degree L only. Its scattering by aerosol is that of Wiscombe's delta-M method (1977, eqs. 4
    and 9): the fraction f = χ_{L+1} of the phase function is taken for a forward peak so narrow that light in it was not
    scattered at all, χ_l - f are the moments of the rest, and f β_M is missing from the extinction of *further* light.
    Single scattering keeps its own phase function and its own extinction, so that what it feeds into the rest is exact.
    """

    shell: Shell
    links: Links
    albedo: Float[Array, " w"]
    of_first: Float[Array, "i k n c w"]
    """T times (β_R χ^R_l + β_M χ^M_l) Π_lm times the quadrature weight, for single scattering."""
    of_further: Float[Array, "i k n c w"]
    """The same for further light."""
    survives: Float[Array, "i g w"]
    known: tuple[int, int] = eqx.field(static=True)
    """Degrees to which single scattering and further light are known."""

    @classmethod
    def build(cls, atmosphere: Atmosphere, shell: Shell, first: tuple[int, int], further: int) -> list["_Transport"]:
        """For the iteration and for the last gather: single scattering known to so many degrees, the rest to one."""
        sets = shell.iterate, shell.last
        # The rays of both as one: the compiler sees the formulas once.
        mu = jnp.concatenate([links.rays.mu for links in sets], axis=1)
        nodes = jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=1), *(links.rays.nodes for links in sets))
        start = jnp.broadcast_to(shell.altitude[:, None], mu.shape)
        # The moments of a forward peak are alike; of a backward one every second is negative, and there is nothing to take out.
        moments = phase.mie_moments(atmosphere.mie_g, further + 1, atmosphere.mie_phase)
        peak = jnp.maximum(jnp.minimum(moments[-2], moments[-1]), 0)
        thin = eqx.tree_at(lambda a: a.mie_scattering, atmosphere, (1 - peak) * atmosphere.mie_scattering)
        columns = transmittance.columns_to(atmosphere, start, mu, nodes, shell.last.rays.steps)
        survives = jnp.exp(-transmittance.optical_depth(thin, columns))
        view = (survives[:, :, :-1] * nodes.weight[..., None])[..., None, :]
        single = view * source_moments(atmosphere, nodes.altitude, max(first))
        rest = view * source_moments(atmosphere, nodes.altitude, further, peak)
        found, end = [], 0
        for links, degree in zip(sets, first, strict=True):
            r = links.rays
            here = slice(end, end + r.mu.shape[1])
            end = here.stop
            ground = survives[:, end - r.mu_s_ground.shape[1] : end, -1]
            of_first = _of_moments(links, single[:, here], degree)
            of_further = _of_moments(links, rest[:, here], further)
            found.append(cls(shell, links, atmosphere.ground_albedo, of_first, of_further, ground, (degree, further)))
        return found

    def apply(self, first: State | None, further: State | None, degree: int) -> State:
        """The next order; its moments to ``degree``."""
        parts = zip((first, further), (self.of_first, self.of_further), self.known, strict=True)
        given = [(state, weight, known) for state, weight, known in parts if state is not None]
        moments = jnp.concatenate([state.moments for state, _, _ in given], axis=1)
        weight = jnp.concatenate([weight for _, weight, _ in given], axis=3)
        m_of = np.concatenate([orders(known) for _, _, known in given])
        irradiance = sum(state.irradiance for state, _, _ in given)
        links, r = self.links, self.links.rays
        # One altitude node after another: the temporary arrays stay in the cache.
        radiance = jax.lax.map(lambda part: gather(moments, part[0], part[1], m_of), (links.ways, weight))
        falling = jnp.einsum("ws,igspj->igwpj", irradiance, links.ground_rows)
        reflected = (self.albedo / jnp.pi * self.survives)[..., None, None] * falling
        radiance = radiance + _below(reflected, r.mu.shape[1] - reflected.shape[1], axis=1)
        harmonics = _harmonics(degree, cosines(r.azimuths, radiance.dtype))
        by_order = jnp.sum(radiance[:, None] * harmonics.T[:, None, None, :, None], axis=4) / self.shell.dusk
        return State(_moments(r, by_order, degree), _irradiance(r, by_order[:, 0]))


def _of_moments(links: Links, of_degrees: Float[Array, "i k n l w"], degree: int) -> Float[Array, "i k n c w"]:
    """What moments to ``degree`` are multiplied by, from factors that depend on l only."""
    return of_degrees[..., degrees(degree), :] * links.polar[..., : len(pairs(degree)), None]


def source_moments(
    atmosphere: Atmosphere, altitude: Altitude, degree: int, peak: Scalar | float = 0.0
) -> Float[Array, "... l w"]:
    """β_R(h) χ^R_l + β_M(h) (χ^M_l - peak), km^-1, for l = 0 … degree."""
    air = jnp.asarray(phase.rayleigh_moments(degree), altitude.dtype)[:, None] * atmosphere.rayleigh_scattering
    moments = phase.mie_moments(atmosphere.mie_g, degree, atmosphere.mie_phase) - peak
    aerosol = moments[:, None] * atmosphere.mie_scattering
    densities = transmittance.exponentials(transmittance.scale_heights(atmosphere), altitude)[..., None, None]
    return densities[0] * air + densities[1] * aerosol


def _add(a: State, b: State) -> State:
    return State(a.moments + b.moments, a.irradiance + b.irradiance)


def solve(atmosphere: Atmosphere, shell: Shell, *, order: int, degrees_: Degrees, peak_azimuths: int) -> State:
    """Moments of all scattered light, and the irradiance of the ground by the sky, both divided by ``dusk``.

    Orders of scattering up to ``order`` are computed one by one, the rest is a geometric tail.
    """
    first = _first_order(atmosphere, shell, degrees_.first, peak_azimuths)
    low = degrees_.iterate

    def seed(degree: int) -> State:
        return State(first.moments[:, : len(pairs(degree))], first.irradiance)

    transport, last = _Transport.build(atmosphere, shell, (low, degrees_.source), low)
    second = transport.apply(seed(low), None, low)

    def next_order(carry: tuple[State, State, State, State], _: None) -> tuple[tuple[State, State, State, State], None]:
        total, term, previous, _before = carry
        following = transport.apply(None, term, low)
        return (_add(total, following), following, term, previous), None

    (total, term, _, before), _ = jax.lax.scan(next_order, (second, second, second, second), None, length=order - 2)
    # Geometric tail: far along the series each order is the one before times a ratio, here that of the mean radiance.
    tail = _tail(term.moments[:, :1], before.moments[:, :1])
    ground_tail = _tail(term.irradiance, before.irradiance)
    total = _add(total, State(tail * term.moments, ground_tail * term.irradiance))
    beyond = last.apply(seed(degrees_.source), total, degrees_.last)
    kept = beyond.moments.shape[1]
    return State(first.moments.at[:, :kept].add(beyond.moments), first.irradiance + beyond.irradiance)
