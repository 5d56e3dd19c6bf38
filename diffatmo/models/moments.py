"""Multiple scattering by angular moments: the default model, made for fitting.

The source of multiple scattering needs only low angular moments of the radiance: Rayleigh's phase function *is* of degree 2,
and the peak of the aerosol's is treated analytically. With the sun in direction (mu_s) and a field that is even about the
sun's plane, the moments of the radiance L at altitude h are

    M_lm(h, mu_s) = ∫ L(ω) N_lm Π_lm(mu) (sinθ / sinθ_s)^m cos(m φ) dω,

with Π_lm the derivative d^m P_l / dmu^m and N_lm the squared norm of the real spherical harmonic, and the source is

    J(ω) = Σ_lm (β_R χ^R_l + β_M χ^M_l) M_lm Π_lm(mu) C_m(w, q),    C_m = (sinθ sinθ_s)^m cos(m φ).

C_m is a polynomial in w = nu - mu mu_s and q = (1 - mu²)(1 - mu_s²), so nothing here has a singular direction: the sun at
the zenith is a point like any other, for value and derivative.

1. First order: exact phase functions along every ray (:mod:`diffatmo.scattering`); its moments seed the iteration.
2. Each further order is linear in the last, M ← M¹ + K M: for every (h, mu_s) node and direction, integrate T J to the ground
   or the top, add the Lambertian ground, project. Positions, weights and polynomials depend on the planet only (``Shell``);
   T and β are the parameters'. A geometric tail closes the series.
3. One last gather along the rays of the image, with the moments of the first order to a high degree.
4. Repeated forward scattering beyond that degree (the aureole): Σ_{n≥2} β_M T_sun τ^{n-1}/(n-1)! [P^(n) - its truncation].
"""

import math
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import geometry, phase, rays, scattering, table, transmittance
from diffatmo._types import Altitude, Cosine, Direction, Irradiance, Length, Scalar, Transmittance
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.base import Model, Path, Ray, Sky, View
from diffatmo.numerics import gauss_legendre, safe_divide, safe_sqrt

ALTITUDE_LINEAR = 0.04
"""Linear part of the map of altitude nodes (clusters them in the aerosol layer)."""

DIRECTION_LINEAR = 0.02
"""Linear part of the map of direction nodes on either side of the horizon."""

GRAZING = 0.05
"""sqrt(2 * 8 km / 6360 km): the sine of the sun's height over which the sky changes at dusk. Scales with the planet."""


@lru_cache
def _pairs(degree: int) -> tuple[tuple[int, int], ...]:
    """All (l, m) with 0 <= m <= l <= degree, by rising degree."""
    return tuple((order, m) for order in range(degree + 1) for m in range(order + 1))


@lru_cache
def _norms(degree: int) -> np.ndarray:
    """Squared norms N_lm of the real spherical harmonics."""
    return np.array(
        [
            (2 - (m == 0)) * (2 * order + 1) / (4 * math.pi) * math.factorial(order - m) / math.factorial(order + m)
            for order, m in _pairs(degree)
        ]
    )


def _polynomials(degree: int, mu: Cosine) -> list[list[Float[Array, "..."]]]:
    """Π_lm(mu) = d^m P_l / dmu^m as ``result[l][m]``, by the usual upward recurrence in l."""
    result: list[list[Float[Array, "..."]]] = [[] for _ in range(degree + 1)]
    for m in range(degree + 1):
        diagonal = jnp.full_like(mu, float(np.prod(np.arange(2 * m - 1, 0, -2))))
        result[m].append(diagonal)
        previous, current = jnp.zeros_like(mu), diagonal
        for order in range(m + 1, degree + 1):
            following = ((2 * order - 1) * mu * current - (order + m - 1) * previous) / (order - m)
            previous, current = current, following
            result[order].append(current)
    return result


def basis(degree: int, mu: Cosine, mu_s: Cosine, nu: Cosine) -> Float[Array, "... lm"]:
    """Π_lm(mu) C_m(w, q) for all (l, m): the angular functions of the source."""
    w = nu - mu * mu_s
    q = (1 - mu * mu) * (1 - mu_s * mu_s)
    multiple = [jnp.ones_like(w), w]
    for _ in range(2, degree + 1):
        multiple.append(2 * w * multiple[-1] - q * multiple[-2])
    polynomials = _polynomials(degree, mu)
    return jnp.stack([polynomials[order][m] * multiple[m] for order, m in _pairs(degree)], axis=-1)


def _degrees(degree: int) -> np.ndarray:
    return np.array([order for order, _ in _pairs(degree)])


class Rays(eqx.Module):
    """Rays from every altitude node into every direction node: geometry that depends on the planet alone.

    Axes: ``i`` altitude node, ``k`` direction (the sky's first, then the ground's), ``p`` azimuth, ``j`` sun node, ``n`` node
    along the ray.
    """

    mu: Float[Array, "i k"]
    solid_angle: Float[Array, "i k"]
    """Weight of the direction: d mu, so that a sum over k and a mean over azimuth times 2π integrates the sphere."""
    ground: Bool[Array, " k"]
    nodes: rays.Nodes
    mu_s_here: Float[Array, "i k n p j"]
    mu_s_ground: Float[Array, "i g p j"]
    azimuths: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        altitude: Float[Array, " i"],
        mu_s: Float[Array, " j"],
        radius: Scalar,
        top: Altitude,
        *,
        sky: int,
        below: int,
        azimuths: int,
        steps: int,
    ) -> "Rays":
        """Gauss-Legendre directions on either side of each node's horizon, and the ray into each of them."""
        horizon = geometry.horizon_mu(altitude, radius)[:, None]
        mus, weights = [], []
        for count, span in ((sky, 1 - horizon), (below, -1 - horizon)):
            unit, w = gauss_legendre(count)
            slope = DIRECTION_LINEAR + 2 * (1 - DIRECTION_LINEAR) * unit
            mus.append(horizon + span * table.stretch(jnp.asarray(unit, altitude.dtype), DIRECTION_LINEAR))
            weights.append(jnp.abs(span) * jnp.asarray(w * slope, altitude.dtype))
        mu, solid_angle = jnp.concatenate(mus, axis=1), jnp.concatenate(weights, axis=1)
        ground = jnp.arange(sky + below) >= sky
        start = jnp.broadcast_to(altitude[:, None], mu.shape)
        nodes = rays.trace(start, mu, jnp.broadcast_to(ground, mu.shape), radius, top, steps)
        nu = relative_nu(mu[..., None, None], mu_s, cosines(azimuths, altitude.dtype)[:, None])
        mu_s_here = geometry.mu_s_along(
            start[..., None, None, None], mu[..., None, None, None], mu_s, nu[:, :, None],
            nodes.distance[..., None, None], radius,
        )  # fmt: skip
        reach = jnp.sum(nodes.weight, axis=-1)[:, sky:, None, None]
        r_mu_s = (radius + altitude)[:, None, None, None] * mu_s
        mu_s_ground = (r_mu_s + reach * nu[:, sky:]) / radius
        return cls(mu, solid_angle, ground, nodes, mu_s_here, jnp.clip(mu_s_ground, -1, 1), azimuths, steps)


def cosines(azimuths: int, dtype: jnp.dtype) -> Float[Array, " p"]:
    """Cosines of the midpoints of ``azimuths`` equal parts of [0, π]."""
    return jnp.asarray(table.chebyshev_nodes(azimuths), dtype)


def relative_nu(mu: Cosine, mu_s: Cosine, cosine: Float[Array, "..."]) -> Cosine:
    """Cosine between view and sun from their zenith angles and the cosine of the azimuth between them."""
    return mu * mu_s + geometry.sine(mu) * geometry.sine(mu_s) * cosine


class Shell(eqx.Module):
    """All geometry of the iteration: a function of the planet's radii only, so a fit computes it once."""

    altitude: Float[Array, " i"]
    mu_s: Float[Array, " j"]
    dusk: Float[Array, " j"]
    first: Rays
    higher: Rays
    altitude_rows: Float[Array, "i k n h"]
    sun_rows: Float[Array, "i k n p j s"]
    angular: Float[Array, "i k n p j lm"]
    ground_rows: Float[Array, "i g p j s"]
    bottom_radius: Scalar
    top_altitude: Scalar

    def grazing(self) -> Scalar:
        """Sine of the sun's height over which the sky changes at dusk on this planet."""
        return grazing(self.bottom_radius, self.top_altitude)

    def altitude_unit(self, altitude: Altitude) -> Float[Array, "..."]:
        """Unit coordinate of an altitude, km."""
        return table.unstretch(jnp.clip(altitude / self.top_altitude, 0, 1), ALTITUDE_LINEAR)

    def sun_unit(self, mu_s: Cosine) -> Float[Array, "..."]:
        """Unit coordinate of a sun height; not below 0, where the sky is dark."""
        low, high = sun_range(self.bottom_radius, self.top_altitude)
        return jnp.maximum((jnp.arcsinh(mu_s / self.grazing()) - low) / (high - low), 0)


def grazing(radius: Scalar, top: Altitude) -> Scalar:
    """:data:`GRAZING` on a planet of another shape, with a scale height of 8 % of the atmosphere's thickness."""
    return safe_sqrt(2 * 0.08 * top / radius)


def sun_range(radius: Scalar, top: Altitude) -> tuple[Scalar, Scalar]:
    """Ends of the sun nodes in arcsinh(mu_s / grazing): from 18° and the dip of the top's horizon below, to 10° off zenith."""
    scale = grazing(radius, top)
    dip = jnp.arctan(-geometry.horizon_mu(top, radius) / safe_divide(radius, radius + top))
    lowest = -jnp.sin(jnp.minimum(jnp.radians(18.0) + dip, jnp.radians(80.0)))
    return jnp.arcsinh(lowest / scale), jnp.arcsinh(0.985 / scale)


def dusk(mu_s: Cosine, scale: Scalar) -> Float[Array, "..."]:
    """How the light falls as the sun sinks, roughly: divided out of the moments before they are interpolated.

    exp(-s²/(1 + s/4)) with s the depth of the sun in units of ``scale``: the height of the shadow over a scale height, bent
    down to what light from the side adds. A scaling only: it cancels at the nodes.
    """
    depth = jnp.maximum(-mu_s, 0) / scale
    return jnp.exp(-depth * depth / (1 + depth / 4))


class _State(NamedTuple):
    """The unknowns, divided by ``dusk``: moments of degree <= iteration degree, and the sky's irradiance of the ground."""

    moments: Float[Array, "i j lm w"]
    irradiance: Float[Array, "j w"]


class Moments(Model):
    """The default model. Fields are resolutions; the defaults keep the sky within about 0.1 % of Monte Carlo."""

    altitudes: int = 14
    suns: int = 26
    first_sky: int = 14
    first_ground: int = 6
    first_azimuths: int = 6
    first_steps: int = 6
    peak_azimuths: int = 32
    higher_sky: int = 8
    higher_ground: int = 5
    higher_azimuths: int = 4
    higher_steps: int = 4
    orders: int = 5
    first_degree: int = 8
    higher_degree: int = 3
    iteration_degree: int = 2
    view_sky: int = 32
    view_ground: int = 20
    view_azimuths: int = 12
    view_steps: int = 8

    def shell(self, bottom_radius: Scalar, top_altitude: Scalar) -> Shell:
        """Geometry of the planet: nodes, rays and interpolation weights. Compute it once per planet."""
        altitude = top_altitude * table.stretch(jnp.linspace(0, 1, self.altitudes), ALTITUDE_LINEAR)
        low, high = sun_range(bottom_radius, top_altitude)
        scale = grazing(bottom_radius, top_altitude)
        mu_s = scale * jnp.sinh(jnp.linspace(0, 1, self.suns) * (high - low) + low)
        first, higher = (
            Rays.build(
                altitude, mu_s, bottom_radius, top_altitude, sky=sky, below=below, azimuths=azimuths, steps=steps
            )
            for sky, below, azimuths, steps in (
                (self.first_sky, self.first_ground, self.first_azimuths, self.first_steps),
                (self.higher_sky, self.higher_ground, self.higher_azimuths, self.higher_steps),
            )
        )
        empty = jnp.zeros(0)
        shell = Shell(
            altitude, mu_s, dusk(mu_s, scale), first, higher, empty, empty, empty, empty, bottom_radius, top_altitude
        )
        start = jnp.broadcast_to(altitude[:, None, None], higher.nodes.altitude.shape)
        mu_here = geometry.mu_along(start, higher.mu[..., None], higher.nodes.distance, bottom_radius)
        nu = relative_nu(higher.mu[..., None, None], mu_s, cosines(self.higher_azimuths, altitude.dtype)[:, None])
        angular = basis(
            self.iteration_degree,
            jnp.broadcast_to(mu_here[..., None, None], higher.mu_s_here.shape),
            higher.mu_s_here,
            jnp.broadcast_to(nu[:, :, None], higher.mu_s_here.shape),
        )

        def sun_rows(value: Cosine) -> Float[Array, "... s"]:
            rows = table.cubic_rows(shell.sun_unit(value), self.suns)
            return rows * dusk(value, scale)[..., None]

        return eqx.tree_at(
            lambda s: (s.altitude_rows, s.sun_rows, s.angular, s.ground_rows),
            shell,
            (
                table.cubic_rows(shell.altitude_unit(higher.nodes.altitude), self.altitudes),
                sun_rows(higher.mu_s_here),
                angular,
                sun_rows(higher.mu_s_ground),
            ),
        )

    def sky(self, atmosphere: Atmosphere, shell: Shell | None = None) -> "MomentsSky":
        """Solve for the moments. ``shell`` is ``self.shell(...)`` of the same planet, where it is known already."""
        if shell is None:
            shell = self.shell(atmosphere.bottom_radius, atmosphere.top_altitude)
        columns = transmittance.Columns.build(atmosphere)
        first_moments, first_irradiance = _first_order(self, atmosphere, columns, shell)
        count = len(_pairs(self.iteration_degree))
        seed = _State(first_moments[:, :, :count], first_irradiance)
        transport = _Transport.build(self, atmosphere, shell)
        total, term, previous = seed, seed, seed
        for _ in range(self.orders - 1):
            previous, term = term, transport.apply(term, self.iteration_degree)
            total = _State(total.moments + term.moments, total.irradiance + term.irradiance)
        # Geometric tail, with one ratio per wavelength: that of the mean radiance of the last two orders.
        ratio = jnp.clip(
            safe_divide(
                jnp.sum(jnp.abs(term.moments[:, :, 0]), axis=(0, 1)),
                jnp.sum(jnp.abs(previous.moments[:, :, 0]), axis=(0, 1)),
            ),
            0,
            0.95,
        )
        tail = ratio / (1 - ratio)
        total = _State(total.moments + tail * term.moments, total.irradiance + tail * term.irradiance)
        beyond = transport.apply(total, self.higher_degree)
        padded = jnp.pad(
            beyond.moments, ((0, 0), (0, 0), (0, first_moments.shape[2] - beyond.moments.shape[2]), (0, 0))
        )
        return MomentsSky(
            atmosphere, self, shell, columns, first_moments + padded, first_irradiance + beyond.irradiance
        )


def _project(
    rays_: Rays, mu_s: Float[Array, " j"], radiance: Float[Array, "i k p j w"], cosine: Float[Array, " p"], degree: int
) -> Float[Array, "i j lm w"]:
    """Moments M_lm of a radiance given at all direction nodes and at azimuths with the given cosines."""
    harmonics = table.chebyshev(degree + 1, cosine) * (2 * jnp.pi / cosine.size)
    by_order = jnp.einsum("ikpjw,pm->mijwk", radiance, harmonics)
    polynomials = _polynomials(degree, rays_.mu)
    sine, sine_s = geometry.sine(rays_.mu), geometry.sine(mu_s)
    power = [jnp.ones_like(sine)]
    power_s = [jnp.ones_like(sine_s)]
    for _ in range(degree):
        power.append(power[-1] * sine)
        power_s.append(power_s[-1] * sine_s)
    norms = _norms(degree)
    moments = [
        jnp.einsum("ijwk,ik->ijw", by_order[m], float(norms[index]) * rays_.solid_angle * polynomials[order][m] * power[m])
        / power_s[m][None, :, None]
        for index, (order, m) in enumerate(_pairs(degree))
    ]
    return jnp.stack(moments, axis=2)


def _irradiance(rays_: Rays, radiance: Float[Array, "i k p j w"]) -> Float[Array, "j w"]:
    """Irradiance of the ground by the sky: the radiance at the lowest node from above its horizon, times mu."""
    weight = jnp.where(rays_.ground, 0, rays_.solid_angle[0] * rays_.mu[0])
    return 2 * jnp.pi * jnp.einsum("kpjw,k->jw", radiance[0], weight) / radiance.shape[2]


def _first_order(
    model: Moments, atmosphere: Atmosphere, columns: transmittance.Columns, shell: Shell
) -> tuple[Float[Array, "i j lm w"], Float[Array, "j w"]]:
    """Moments and ground irradiance, over ``dusk``, of light scattered once or reflected by the ground once."""
    r = shell.first
    nodes = r.nodes
    start = jnp.broadcast_to(shell.altitude[:, None], r.mu.shape)
    along, end = transmittance.columns_along(atmosphere, start, r.mu, nodes, r.steps)
    towards_sun, free = _sun_columns(columns, nodes.altitude, r.mu_s_here)
    coefficients = transmittance.extinction(atmosphere)
    view = jnp.exp(-transmittance.optical_depth(atmosphere, along))
    density = transmittance.densities(atmosphere, nodes.altitude) * nodes.weight[..., None]
    depth = sum(towards_sun[..., c, None] * coefficients[c] for c in range(3))
    light = jnp.where(free[..., None], jnp.exp(-jnp.where(free[..., None], depth, 0)), 0)
    # Phase-free integrals at few azimuths, in which they are polynomials of low degree ...
    weights = density[..., None] * view[..., None, :]
    smooth = jnp.einsum("iknpjw,ikncw->cikpjw", light, weights)
    # ... taken to the many azimuths that the peak of the phase function needs.
    dtype = shell.altitude.dtype
    fine = cosines(model.peak_azimuths, dtype)
    to_fine = table.chebyshev(r.azimuths, fine) @ jnp.asarray(table.chebyshev_coefficients(r.azimuths), dtype)
    nu = relative_nu(r.mu[..., None, None], shell.mu_s, fine[:, None])
    aerosol = phase.mie(nu, atmosphere.mie_g, atmosphere.mie_phase)
    # Normalised over the very nodes it is summed on: a peak between nodes loses no light.
    norm = 2 * jnp.pi / fine.size * jnp.einsum("ikpj,ik->ij", aerosol, r.solid_angle)
    aerosol = aerosol / norm[:, None, None, :]
    fine_smooth = jnp.einsum("cikpjw,fp->cikfjw", smooth, to_fine)
    radiance = (
        phase.rayleigh(nu)[..., None] * (atmosphere.rayleigh_scattering * fine_smooth[0])
        + aerosol[..., None] * (atmosphere.mie_scattering * fine_smooth[1])
    )  # fmt: skip
    ground_level = jnp.zeros_like(r.mu_s_ground)
    sunlit = jnp.maximum(r.mu_s_ground, 0)[..., None] * transmittance.sun_transmittance(
        atmosphere, columns, ground_level, r.mu_s_ground
    )
    sky_count = r.mu.shape[1] - r.mu_s_ground.shape[1]
    survives = jnp.exp(-transmittance.optical_depth(atmosphere, end))[:, sky_count:, None, None, :]
    reflected = jnp.einsum("igpjw,fp->igfjw", atmosphere.ground_albedo / jnp.pi * survives * sunlit, to_fine)
    radiance = radiance.at[:, sky_count:].add(reflected)
    radiance = radiance * atmosphere.solar_irradiance / shell.dusk[:, None]
    return _project(r, shell.mu_s, radiance, fine, model.first_degree), _irradiance(r, radiance)


def _sun_columns(
    columns: transmittance.Columns, altitude: Float[Array, "i k n"], mu_s: Float[Array, "i k n p j"]
) -> tuple[Float[Array, "i k n p j 3"], Bool[Array, "i k n p j"]]:
    """Columns towards the sun at fixed altitudes and many suns: one row of the table per altitude, then one axis left."""
    count, mus, _ = columns.table.shape
    first, weights = table.cubic_weights(columns.altitude_unit(altitude), count)
    rows = sum(weights[..., a, None, None] * columns.table[first + a] for a in range(4))
    index, w = table.cubic_weights(table.unstretch(jnp.minimum(jnp.abs(mu_s), 1), transmittance.MU_LINEAR), mus)
    flat = rows.reshape(-1, 3)
    offset = (jnp.arange(altitude.size, dtype=jnp.int32) * mus).reshape(*altitude.shape, 1, 1)
    entry = sum(w[..., a, None] * flat[offset + index + a] for a in range(4))
    here = jnp.broadcast_to(altitude[..., None, None], mu_s.shape)
    return columns.join(columns.decode(entry), here, mu_s)


class _Transport(eqx.Module):
    """K: from the moments of one order of scattering to those of the next."""

    shell: Shell
    albedo: Float[Array, " w"]
    weight: Float[Array, "i k n l w"]
    """T times (β_R χ^R_l + β_M χ^M_l) times the quadrature weight."""
    survives: Transmittance

    @classmethod
    def build(cls, model: Moments, atmosphere: Atmosphere, shell: Shell) -> "_Transport":
        r = shell.higher
        start = jnp.broadcast_to(shell.altitude[:, None], r.mu.shape)
        along, end = transmittance.columns_along(atmosphere, start, r.mu, r.nodes, r.steps)
        view = jnp.exp(-transmittance.optical_depth(atmosphere, along)) * r.nodes.weight[..., None]
        source = source_moments(atmosphere, r.nodes.altitude, model.iteration_degree)
        survives = jnp.exp(-transmittance.optical_depth(atmosphere, end))[:, r.mu.shape[1] - r.mu_s_ground.shape[1] :]
        return cls(shell, atmosphere.ground_albedo, view[..., None, :] * source, survives)

    def apply(self, state: _State, degree: int) -> _State:
        """The next order; its moments to ``degree``."""
        shell, r = self.shell, self.shell.higher
        i, j, count, w = state.moments.shape
        flat = state.moments.reshape(i, j * count * w)
        there = jnp.einsum("iknh,hc->iknc", shell.altitude_rows, flat).reshape(*r.nodes.altitude.shape, j, count * w)
        k, n, p = *r.nodes.altitude.shape[1:], r.azimuths
        rows = shell.sun_rows.reshape(i, k, n, p * j, j)
        moments = jnp.einsum("iknts,iknsc->ikntc", rows, there).reshape(i, k, n, p, j, count, w)
        coefficients = self.weight[:, :, :, _degrees_of(count)]
        source = jnp.sum(moments * shell.angular[..., None] * coefficients[:, :, :, None, None], axis=(2, 5))
        falling = jnp.einsum("igpjs,sw->igpjw", shell.ground_rows, state.irradiance)
        reflected = self.albedo / jnp.pi * self.survives[:, :, None, None, :] * falling
        radiance = source.at[:, k - reflected.shape[1] :].add(reflected) / shell.dusk[:, None]
        cosine = cosines(p, shell.altitude.dtype)
        return _State(_project(r, shell.mu_s, radiance, cosine, degree), _irradiance(r, radiance))


def _degrees_of(count: int) -> np.ndarray:
    """Degree l of each of the first ``count`` (l, m) pairs."""
    degree = next(d for d in range(count + 1) if len(_pairs(d)) == count)
    return _degrees(degree)


def source_moments(atmosphere: Atmosphere, altitude: Altitude, degree: int) -> Float[Array, "... l w"]:
    """β_R(h) χ^R_l + β_M(h) χ^M_l, km^-1, for l = 0 … degree."""
    density = transmittance.densities(atmosphere, altitude)
    air = jnp.asarray(phase.rayleigh_moments(degree), density.dtype)[:, None] * atmosphere.rayleigh_scattering
    aerosol = phase.mie_moments(atmosphere.mie_g, degree, atmosphere.mie_phase)[:, None] * atmosphere.mie_scattering
    return density[..., 0, None, None] * air + density[..., 1, None, None] * aerosol


def aureole_phase(atmosphere: Atmosphere, nu: Cosine, order: int, degree: int) -> Float[Array, "..."]:
    """Phase function of ``order`` aerosol scatterings in a row, less its moments up to ``degree``, sr^-1.

    Henyey-Greenstein convolved n times with itself has the moments (g^l)^n, and is Henyey-Greenstein with g^n. The peak of
    Cornette-Shanks is that of Henyey-Greenstein times 3 / (2 + g²).
    """
    g = atmosphere.mie_g**order
    height = 1.0 if atmosphere.mie_phase == "henyey-greenstein" else (3 / (2 + atmosphere.mie_g**2)) ** order
    kept = (2 * np.arange(degree + 1) + 1) / (4 * np.pi) * phase.mie_moments(g, degree, "henyey-greenstein")
    return height * (phase.henyey_greenstein(nu, g) - phase.legendre(degree, nu) @ kept.astype(nu.dtype))


class MomentsSky(Sky):
    """The solved moments, and the gathers that turn them into radiance."""

    atmosphere: Atmosphere
    model: Moments
    shell: Shell
    columns: transmittance.Columns
    moments: Float[Array, "i j lm w"]
    """All orders but the unscattered light, divided by ``dusk``."""
    irradiance: Float[Array, "j w"]
    """Of the ground by the sky, divided by ``dusk``."""

    def path(
        self, *, altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, distance: Length | None = None
    ) -> Path:
        """Inscattered radiance and transmittance to the boundary, or to ``distance`` km if that is nearer."""
        atmosphere, radius = self.atmosphere, self.atmosphere.bottom_radius
        altitude, mu, mu_s, nu = jnp.broadcast_arrays(altitude, mu, mu_s, nu)
        altitude, mu, mu_s, moved, misses = geometry.enter_atmosphere(
            altitude, mu, mu_s, nu, radius, atmosphere.top_altitude
        )
        ground = geometry.hits_ground(altitude, mu, radius)
        steps, nodes = self.model.view_steps, None
        gather_nodes = rays.trace(altitude, mu, ground, radius, atmosphere.top_altitude, steps)
        if distance is not None:
            end = geometry.distance_to_boundary(altitude, mu, ground, radius, atmosphere.top_altitude)
            steps = 6 * steps
            nodes = gather_nodes = rays.straight(altitude, mu, jnp.clip(distance - moved, 0, end), radius, steps)
        single = scattering.integrate(
            atmosphere, self.columns, altitude, mu, mu_s, nu, ground,
            steps=steps, aureole=scattering.AUREOLE_ORDERS, nodes=nodes,
        )  # fmt: skip
        light = scattering.radiance(atmosphere, single, nu) + self._aureole(single, nu)
        along, _ = transmittance.columns_along(atmosphere, altitude, mu, gather_nodes, steps)
        here = gather_nodes.altitude
        mu_here = geometry.mu_along(altitude[..., None], mu[..., None], gather_nodes.distance, radius)
        mu_s_here = geometry.mu_s_along(
            altitude[..., None], mu[..., None], mu_s[..., None], nu[..., None], gather_nodes.distance, radius
        )
        i, j, count, w = self.moments.shape
        moments = table.interpolate(
            self.moments.reshape(i, j, count * w), self.shell.altitude_unit(here), self.shell.sun_unit(mu_s_here)
        ).reshape(*here.shape, count, w) * dusk(mu_s_here, self.shell.grazing())[..., None, None]
        angular = basis(self.model.first_degree, mu_here, mu_s_here, jnp.broadcast_to(nu[..., None], here.shape))
        view = jnp.exp(-transmittance.optical_depth(atmosphere, along)) * gather_nodes.weight[..., None]
        source = source_moments(atmosphere, here, self.model.first_degree)[..., _degrees_of(count), :]
        light = light + jnp.sum(view * jnp.sum(moments * source * angular[..., None], axis=-2), axis=-2)
        return Path(jnp.where(misses[..., None], 0, light), jnp.where(misses[..., None], 1, single.transmittance))

    def _aureole(self, single: scattering.Single, nu: Cosine) -> Float[Array, "... w"]:
        """Repeated forward scattering beyond the kept moments."""
        degrees = (self.model.first_degree, *[self.model.higher_degree] * (scattering.AUREOLE_ORDERS - 1))
        return sum(
            aureole_phase(self.atmosphere, nu, order, degree)[..., None] * term
            for order, (degree, term) in enumerate(zip(degrees, single.aureole, strict=True), start=2)
        )

    def sun_irradiance(self, *, altitude: Altitude, mu_s: Cosine) -> Irradiance:
        """Direct irradiance of the sun on a horizontal plane."""
        falling = jnp.maximum(mu_s, 0)[..., None] * self.atmosphere.solar_irradiance
        return falling * transmittance.sun_transmittance(self.atmosphere, self.columns, altitude, mu_s)

    def sky_irradiance(self, *, mu_s: Cosine) -> Irradiance:
        """Diffuse irradiance of the sky on the ground."""
        first, weights = table.cubic_weights(self.shell.sun_unit(mu_s), self.model.suns)
        value = sum(weights[..., a, None] * self.irradiance[first + a] for a in range(4))
        return value * dusk(mu_s, self.shell.grazing())[..., None]
