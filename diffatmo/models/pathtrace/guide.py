"""A rough solution of the sky that tells paths where to go. It decides the noise, never the result.

Successive orders on a grid of altitude and sun height with an isotropic diffuse source: good to some tens of percent by day
and a factor of two in deep twilight, which is plenty for choosing (a) where along a ray to scatter, (b) in which direction
to continue and (c) when to stop a path. Every choice is divided by its probability, and every probability is positive
wherever light can be, so an error of the guide costs samples and nothing else. The gain is largest in twilight, where nearly
all places that chance alone would pick lie in the planet's shadow.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from diffatmo import geometry, phase
from diffatmo._types import Altitude, Cosine, Length
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.pathtrace import columns
from diffatmo.models.pathtrace.columns import Panel, Segment, Triple
from diffatmo.numerics import safe_divide, safe_sqrt

ALTITUDES, SUNS = 24, 128
"""Nodes of the grid: altitudes spaced by their square root, suns closest at the horizon."""
LOWEST_SUN, SUN_CLUSTER = -0.8, 0.3
"""The sun's coordinate y runs from here to 1, mu_s = y (|y| + cluster) / (1 + cluster): 43° below the horizon to zenith."""
TIERS, AZIMUTHS = 6, 12
"""Directions: as many tiers above the horizon as below, azimuths from the sun's to the opposite one."""
BINS = 2 * TIERS * AZIMUTHS
ORDERS = 8
PANELS = 8
FLOOR = 0.02
"""Part of the brightest altitude's diffuse light that every altitude is granted at least."""
DARK = 1e-30
"""Radiance, per unit of the sun's, under which there is nothing to find."""


class Guide(NamedTuple):
    """Tables over (wavelength, altitude, sun), flattened: one-dimensional gathers are what processors do fast."""

    sun: Float[Array, " n"]
    """Transmittance to the sun, the greatest of the neighbourhood."""
    diffuse: Float[Array, " n"]
    """Mean radiance over the sphere, sr^-1."""
    ground: Float[Array, " m"]
    """Radiance of the ground over (wavelength, sun)."""
    directions: Float[Array, " k"]
    """Cumulative probability of the direction bins over (altitude, sun, bin)."""


def cell(altitude: Altitude, mu_s: Cosine, top_altitude: Altitude) -> Int[Array, "..."]:
    """Index of the nearest node in a table over (altitude, sun)."""
    row = jnp.sqrt(jnp.clip(altitude / top_altitude, 0, 1)) * (ALTITUDES - 1) + 0.5
    return row.astype(jnp.int32) * SUNS + sun_cell(mu_s)


def sun_cell(mu_s: Cosine) -> Int[Array, "..."]:
    """Index of the nearest node in a table over the sun."""
    y = 0.5 * (jnp.sqrt(SUN_CLUSTER**2 + 4 * (1 + SUN_CLUSTER) * jnp.abs(mu_s)) - SUN_CLUSTER)
    y = jnp.where(mu_s < 0, -y, y)
    column = (jnp.clip(y, LOWEST_SUN, 1) - LOWEST_SUN) * ((SUNS - 1) / (1 - LOWEST_SUN)) + 0.5
    return column.astype(jnp.int32)


def _grid(top_altitude: Altitude) -> tuple[Float[Array, " h"], Float[Array, " s"]]:
    """Altitudes and sun cosines of the nodes: the inverse of :func:`cell`."""
    row = jnp.linspace(0, 1, ALTITUDES, dtype=top_altitude.dtype)
    y = jnp.linspace(LOWEST_SUN, 1, SUNS, dtype=top_altitude.dtype)
    return row * row * top_altitude, y * (jnp.abs(y) + SUN_CLUSTER) / (1 + SUN_CLUSTER)


def _tier_edge(tier: Float[Array, "..."], horizon: Cosine) -> Cosine:
    """mu of the lower edge of a tier: equal steps below the horizon, quadratic ones above it."""
    q = tier / TIERS
    return jnp.where(tier < TIERS, -1 + (horizon + 1) * q, horizon + (1 - horizon) * (q - 1) * (q - 1))


@jax.jit
def build(atmosphere: Atmosphere) -> Guide:
    """Solve for the tables."""
    radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
    h, mu_s = _grid(top)
    dtype = h.dtype
    half = jnp.full((), 0.5, dtype)
    to_sun = columns.to_top(atmosphere, *jnp.broadcast_arrays(h[:, None], mu_s), half, 3 * PANELS)

    # One ray from every altitude into every tier. Axes from here: (panel,) altitude, tier, azimuth, sun.
    edges = _tier_edge(jnp.arange(2 * TIERS + 1, dtype=dtype), geometry.horizon_mu(h, radius)[:, None])
    width = edges[:, 1:] - edges[:, :-1]
    altitude, mu = jnp.broadcast_arrays(h[:, None], 0.5 * (edges[:, 1:] + edges[:, :-1]))
    ground = geometry.hits_ground(altitude, mu, radius)
    ray = columns.segment(atmosphere, altitude, mu, ground)

    def visit(_: None, panel: Panel) -> tuple[None, tuple]:
        middle = 0.5 * (panel.start + panel.end)
        inner = tuple(0.5 * (a + b) for a, b in zip(panel.before, panel.after, strict=True))
        air, aerosol = (b - a for a, b in zip(panel.before[:2], panel.after[:2], strict=True))
        there = geometry.altitude_along(altitude, mu, middle, radius)
        return None, (middle, there, air, aerosol, columns.transmittance(atmosphere, inner))

    whole, (middle, there, air, aerosol, fades) = columns.walk(atmosphere, ray, ray.length, half, PANELS, visit, None)
    azimuth = (jnp.arange(AZIMUTHS, dtype=dtype) + 0.5) * (jnp.pi / AZIMUTHS)
    nu = mu[..., None, None] * mu_s + (geometry.sine(mu)[..., None] * jnp.cos(azimuth))[..., None] * geometry.sine(mu_s)

    def sun_after(distance: Length, there: Altitude) -> Cosine:
        moved = (radius + altitude)[..., None, None] * mu_s + distance[..., None, None] * nu
        return jnp.clip(moved / (radius + there)[..., None, None], -1, 1)

    at = cell(there[..., None, None], sun_after(middle, there), top)
    at_ground = sun_cell(sun_after(ray.length, jnp.zeros_like(altitude)))
    seen = jnp.where(ground, columns.transmittance(atmosphere, whole), 0)
    beta = columns.scattering(atmosphere)

    def light(k: Int[Array, ""], source: Float[Array, " n"], below: Float[Array, " s"]) -> Float[Array, "h d a s"]:
        """Radiance at the nodes, from a diffuse source and a ground."""
        scatters = (beta[0, k] * air + beta[1, k] * aerosol) * fades[:, k]
        arriving = jnp.sum(scatters[..., None, None] * source.ravel()[at], axis=0)
        return arriving + seen[k][..., None, None] * below[at_ground]

    def order(_: int, state: tuple[Float[Array, "w h s"], Float[Array, "w s"]]) -> tuple:
        def one(arguments: tuple) -> tuple[Float[Array, "h s"], Float[Array, " s"]]:
            k, diffuse, below = arguments
            arriving = light(k, to_sun[k] / (4 * jnp.pi) + diffuse, below)
            mean = jnp.einsum("hd,hdas->hs", width, arriving) / (2 * AZIMUTHS)
            sky = 2 * jnp.pi / AZIMUTHS * jnp.einsum("d,das->s", width[0] * jnp.maximum(mu[0], 0), arriving[0])
            return mean, atmosphere.ground_albedo[k] / jnp.pi * (jnp.maximum(mu_s, 0) * to_sun[k, 0] + sky)

        return jax.lax.map(one, (wavelengths, *state))

    wavelengths = jnp.arange(atmosphere.wavelengths.size)
    nothing = jnp.zeros_like(to_sun)
    diffuse, below = jax.lax.fori_loop(0, ORDERS, order, (nothing, nothing[:, 0]))

    # Where light comes from, all wavelengths alike, and with the phase functions for what is scattered once.
    peaks = (phase.rayleigh(nu), phase.mie(nu, atmosphere.mie_g, atmosphere.mie_phase))

    def bright(k: Int[Array, ""]) -> Float[Array, "h d a s"]:
        once = [beta[i, k] * peak * jnp.sum((column * fades[:, k])[..., None, None] * to_sun[k].ravel()[at], axis=0)
                for i, (peak, column) in enumerate(zip(peaks, (air, aerosol), strict=True))]  # fmt: skip
        return (once[0] + once[1] + light(k, diffuse[k], below[k])) / jnp.maximum(diffuse[k][:, None, None], DARK)

    share = jnp.sum(jax.lax.map(bright, wavelengths), axis=0) * width[..., None, None]
    # On the ground it is irradiance that counts; the paths that start just above it have the phase functions as well.
    share = share.at[0].multiply(jnp.maximum(mu[0], 0)[:, None, None])
    share = jnp.moveaxis(share.reshape(ALTITUDES, BINS, SUNS), 1, 2) + 1e-6
    cumulative = jnp.cumsum(share, axis=-1)

    least = FLOOR * jnp.max(diffuse, axis=1)
    padded = jnp.pad(to_sun, [(0, 0), (0, 0), (1, 1)], mode="edge")
    return Guide(
        jnp.maximum(to_sun, jnp.maximum(padded[..., :-2], padded[..., 2:])).ravel(),
        (diffuse + least[:, None]).ravel(),
        (below + atmosphere.ground_albedo[:, None] * least).ravel(),
        (cumulative / cumulative[..., -1:]).ravel(),
    )


class Expected(NamedTuple):
    """The light expected along a segment, as a density over distance that is linear on every panel."""

    start: Float[Array, "panel lanes"]
    end: Float[Array, "panel lanes"]
    """Distances."""
    density_start: Float[Array, "panel lanes"]
    density_end: Float[Array, "panel lanes"]
    """Weighted radiance per km."""
    before: Triple
    """Columns up to the panel."""
    whole: Triple
    """Columns of the segment."""
    ground: Float[Array, " lanes"]
    """Weighted radiance of the ground, seen through the segment."""


def expected(
    atmosphere: Atmosphere,
    guide: Guide,
    ray: Segment,
    mu_s: Cosine,
    nu: Cosine,
    weights: Float[Array, "w lanes"],
    *,
    end: Length,
    sees_ground: Float[Array, " lanes"],
    jitter: Float[Array, " lanes"],
    panels: int,
) -> Expected:
    """Expected light, wavelengths weighted by ``weights``, along a segment up to ``end``."""
    radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
    r_mu_s = (radius + ray.altitude) * mu_s
    epsilon, beta = columns.extinction(atmosphere), columns.scattering(atmosphere)
    air_phase, aerosol_phase = phase.rayleigh(nu), phase.mie(nu, atmosphere.mie_g, atmosphere.mie_phase)
    count = atmosphere.wavelengths.size

    def density(node: Int[Array, " lanes"], at: Triple, behind: Triple) -> Float[Array, " lanes"]:
        # A sum over lanes one wavelength at a time: XLA fuses it into a single loop.
        total = jnp.zeros_like(nu)
        for k in range(count):
            air, aerosol = beta[0, k] * at[0], beta[1, k] * at[1]
            direct = (air * air_phase + aerosol * aerosol_phase) * guide.sun[node + k * ALTITUDES * SUNS]
            diffuse = (air + aerosol) * guide.diffuse[node + k * ALTITUDES * SUNS]
            depth = epsilon[0, k] * behind[0] + epsilon[1, k] * behind[1] + epsilon[2, k] * behind[2]
            total = total + weights[k] * (direct + diffuse) * jnp.exp(-depth)
        return total

    def visit(first: Float[Array, " lanes"], panel: Panel) -> tuple[Float[Array, " lanes"], tuple]:
        there = cell(panel.altitude, (r_mu_s + panel.end * nu) / (radius + panel.altitude), top)
        second = density(there, panel.density, panel.after)
        return second, (panel.start, panel.end, first, second, panel.before)

    zero = jnp.zeros_like(nu)
    here = density(cell(ray.altitude, mu_s, top), columns.densities(atmosphere, ray.altitude), (zero, zero, zero))
    whole, steps = columns.walk(atmosphere, ray, end, jitter, panels, visit, here)
    below = sun_cell(jnp.clip((r_mu_s + ray.length * nu) / radius, -1, 1))
    fades = columns.transmittance(atmosphere, whole)
    ground = sum(weights[k] * fades[k] * guide.ground[below + k * SUNS] for k in range(count))
    return Expected(*steps, whole, jnp.where(sees_ground, ground, 0))


def sample_direction(
    guide: Guide, node: Int[Array, " lanes"], horizon: Cosine, u: Float[Array, " lanes"], v: Float[Array, " lanes"]
) -> tuple[Cosine, Float[Array, " lanes"]]:
    """mu and azimuth from the sun of a direction drawn from the table at ``node``, from two uniform numbers."""
    base = node * BINS
    found = jnp.zeros_like(node)
    for step in (1 << bit for bit in reversed(range((BINS - 1).bit_length()))):
        further = found + step
        passed = (further < BINS) & (guide.directions[base + jnp.minimum(further, BINS) - 1] <= u)
        found = jnp.where(passed, further, found)
    low = jnp.where(found > 0, guide.directions[base + jnp.maximum(found - 1, 0)], 0)
    inside = jnp.clip(safe_divide(u - low, guide.directions[base + found] - low), 0, 1)
    tier = (found // AZIMUTHS).astype(u.dtype)
    mu_low, mu_high = _tier_edge(tier, horizon), _tier_edge(tier + 1, horizon)
    turn = 2 * v - 1
    azimuth = ((found % AZIMUTHS).astype(u.dtype) + jnp.abs(turn)) * (jnp.pi / AZIMUTHS)
    return jnp.clip(mu_low + (mu_high - mu_low) * inside, -1, 1), jnp.sign(turn) * azimuth


def direction_density(
    guide: Guide, node: Int[Array, " lanes"], horizon: Cosine, mu: Cosine, cos_azimuth: Cosine
) -> Float[Array, " lanes"]:
    """Probability per sr of the direction under :func:`sample_direction`."""
    above = safe_sqrt((mu - horizon) / jnp.maximum(1 - horizon, 1e-6))
    height = jnp.where(mu < horizon, jnp.clip((mu + 1) / (1 + horizon), 0, 0.9999), 1 + jnp.clip(above, 0, 0.9999))
    tier = jnp.floor(height * TIERS)
    azimuth = jnp.arccos(jnp.clip(cos_azimuth, -1, 1)) * (AZIMUTHS / jnp.pi)
    found = tier.astype(jnp.int32) * AZIMUTHS + jnp.clip(azimuth.astype(jnp.int32), 0, AZIMUTHS - 1)
    at = node * BINS + found
    share = guide.directions[at] - jnp.where(found > 0, guide.directions[jnp.maximum(at - 1, 0)], 0)
    solid_angle = (_tier_edge(tier + 1, horizon) - _tier_edge(tier, horizon)) * (2 * jnp.pi / AZIMUTHS)
    return share / solid_angle
