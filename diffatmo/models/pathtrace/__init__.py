"""Volumetric Monte Carlo: the truth that the other models are measured against.

Backward path tracing through the spherical shell with Rayleigh and aerosol scattering, absorption and a Lambertian ground,
any number of orders, no approximation but the geometry all models share. An answer comes with its standard error, and any
number of samples brings it down without a floor: optical depths are integrated from the densities with a systematic error
of some 1e-5 (:mod:`.columns`), and everything rough in here decides only where samples go.

- :mod:`.paths`: the random walk and its weights;
- :mod:`.guide`: a rough solution of the sky that tells paths where to go, from noon into deep twilight;
- :mod:`.lattice`: random numbers that fill space evenly;
- :mod:`.columns`: optical depths along a ray.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from diffatmo import geometry
from diffatmo._types import Altitude, Cosine, Direction, Irradiance, Length, Radiance, Transmittance
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.base import Model, Path, Ray, Sky
from diffatmo.models.pathtrace import columns, guide, vector
from diffatmo.models.pathtrace.guide import Guide
from diffatmo.models.pathtrace.paths import Rays, trace
from diffatmo.models.pathtrace.slab import slab
from diffatmo.models.pathtrace.vector import Vector
from diffatmo.numerics import safe_divide

__all__ = ["Estimate", "Orders", "PathTrace", "PathTraceSky", "slab"]

FINE = 64
"""Panels for what is integrated once and handed out: the transmittance of the ray, the sun's irradiance."""


@jax.custom_jvp
def _refuse_derivatives(atmosphere: Atmosphere) -> Atmosphere:
    return atmosphere


@_refuse_derivatives.defjvp
def _refuse(primals: Any, tangents: Any) -> Any:
    raise NotImplementedError(
        "pathtrace: the derivative of a Monte Carlo estimate is not an estimate of the derivative, because paths jump "
        "when parameters move; differentiate moments or raymarch instead"
    )


class Resolution(NamedTuple):
    """What is fixed when the walk is compiled; the seed is not."""

    samples: int
    replicates: int
    lanes: int
    panels: int

    @property
    def points(self) -> int:
        """Paths of each replicate: a power of two, for the lattice."""
        return 1 << max(0, math.ceil(math.log2(self.samples / self.replicates)))


class PathTrace(Model):
    """Monte Carlo with ``samples`` paths per ray, all wavelengths on the same paths.

    ``samples`` is rounded up to ``replicates`` times a power of two; the standard error comes from that many independent
    replicates. ``lanes`` paths are computed side by side, which bounds the memory; the default suits the cache of a
    processor, a large GPU is busy with 2²⁰. ``panels`` resolve the atmosphere along a ray; 10 suit exponentials and layers some
    kilometres thick.
    """

    samples: int = 4096
    seed: int = 0
    replicates: int = 32
    lanes: int = 8192
    panels: int = 10

    def sky(self, atmosphere: Atmosphere) -> "PathTraceSky":
        """Prepare the guide; the paths are traced when the sky is asked."""
        atmosphere = _refuse_derivatives(atmosphere)
        return PathTraceSky(atmosphere, guide.build(atmosphere), jax.random.key(self.seed), self._resolution)

    @property
    def _resolution(self) -> Resolution:
        return Resolution(self.samples, self.replicates, self.lanes, self.panels)

    @property
    def paths(self) -> int:
        """Paths per ray: ``samples``, rounded up."""
        return self.replicates * self._resolution.points


class Estimate(NamedTuple):
    """Light arriving along a ray, its standard error, and the transmittance to where the ray ends."""

    radiance: Radiance
    stderr: Radiance
    transmittance: Transmittance


class Orders(NamedTuple):
    """Light arriving along a ray by what happened to it. Parts of the same paths: their errors are correlated."""

    single: Estimate
    """Scattered once, by air or aerosol."""
    second: Estimate
    """Scattered or reflected twice."""
    higher: Estimate
    """Three times or more."""
    ground: Estimate
    """Reflected once by the ground at the end of the ray."""


class PathTraceSky(Sky):
    """A sky that answers by tracing paths. The same question gets the same answer; another ``key`` another sample."""

    atmosphere: Atmosphere
    guide: Guide
    key: PRNGKeyArray
    resolution: Resolution = eqx.field(static=True)

    def radiance_with_error(
        self, *, altitude: Altitude, view: Direction, sun: Direction, key: PRNGKeyArray | None = None
    ) -> Estimate:
        """Radiance with its standard error; arguments as for :meth:`radiance`, another ``key`` for another sample.

        Of few paths the standard error goes with the error itself: both are small where bright paths were missed. Weights for
        an average or a fit should come from its mean over many rays. Errors of the wavelengths are correlated.
        """
        return _ask(self, altitude, view, sun, jnp.inf, True, self.key if key is None else key)

    def orders(self, *, altitude: Altitude, view: Direction, sun: Direction, key: PRNGKeyArray | None = None) -> Orders:
        """The same light by orders of scattering: what each approximation of the other models is held against."""
        parts = _ask(self, altitude, view, sun, jnp.inf, True, self.key if key is None else key, apart=True)
        return Orders(
            *(Estimate(parts.radiance[i], parts.stderr[i], parts.transmittance) for i in range(len(Orders._fields)))
        )

    def radiance(self, *, altitude: Altitude, view: Direction, sun: Direction) -> Ray:
        """Radiance and transmittance along unit vectors ``view`` for a sun in direction ``sun``, shapes (..., 3)."""
        light, _, transmittance = self.radiance_with_error(altitude=altitude, view=view, sun=sun)
        return Ray(light, transmittance)

    def path(self, *, altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, distance: Length | None = None) -> Path:
        """Inscattered radiance and transmittance to the boundary, or to ``distance`` km if that is nearer."""
        altitude, mu, mu_s, nu = jnp.broadcast_arrays(altitude, mu, mu_s, nu)
        sine = geometry.sine(mu)
        view = jnp.stack([jnp.zeros_like(mu), sine, mu], axis=-1)
        # The sun's component along the view's horizontal direction, and what is left of its length.
        along = jnp.clip(safe_divide(nu - mu * mu_s, sine), -geometry.sine(mu_s), geometry.sine(mu_s))
        across = jnp.sqrt(jnp.maximum((1 - mu_s) * (1 + mu_s) - along * along, 0))
        sun = jnp.stack([across, along, mu_s], axis=-1)
        reach = jnp.inf if distance is None else distance
        light, _, transmittance = _ask(self, altitude, view, sun, reach, False, jax.random.fold_in(self.key, 1))
        return Path(light, transmittance)

    @eqx.filter_jit
    def sun_irradiance(self, *, altitude: Altitude, mu_s: Cosine) -> Irradiance:
        """Direct irradiance of the sun on a horizontal plane."""
        altitude, mu_s = jnp.broadcast_arrays(altitude, mu_s)
        radius, top = self.atmosphere.bottom_radius, self.atmosphere.top_altitude
        inside, mu, _, _, misses = geometry.enter_atmosphere(altitude, mu_s, mu_s, jnp.ones_like(mu_s), radius, top)
        to_sun = columns.to_top(self.atmosphere, inside, mu, jnp.full((), 0.5, mu.dtype), FINE)
        to_sun = jnp.where(misses[..., None], 1, jnp.moveaxis(to_sun, 0, -1))
        return jnp.maximum(mu_s, 0)[..., None] * self.atmosphere.solar_irradiance * to_sun

    def sky_irradiance(self, *, mu_s: Cosine) -> Irradiance:
        """Diffuse irradiance of the sky on the ground."""
        zero = jnp.zeros_like(mu_s)
        up = jnp.stack([zero, zero, zero + 1], axis=-1)
        sun = jnp.stack([zero, geometry.sine(mu_s), mu_s], axis=-1)
        return _ask(self, zero, up, sun, jnp.inf, True, jax.random.fold_in(self.key, 2), hemisphere=True).radiance


def _ask(
    sky: PathTraceSky,
    altitude: Altitude,
    view: Direction,
    sun: Direction,
    reach: Length,
    ground: bool,
    key: PRNGKeyArray,
    *,
    hemisphere: bool = False,
    apart: bool = False,
) -> Estimate:
    """Answer for rays of any shape, from anywhere; ``ground`` says whether light of the ground counts.

    Asked for ``apart``, radiance and its error have the parts as a leading axis.
    """
    components = (*jnp.moveaxis(view, -1, 0), *jnp.moveaxis(sun, -1, 0))
    rays = jnp.broadcast_arrays(altitude, reach, ground, *components)
    shape, dtype = rays[0].shape, sky.atmosphere.bottom_radius.dtype
    altitude, reach, sees_ground, x, y, z, *sun_flat = (ray.ravel().astype(dtype) for ray in rays)
    answers = _estimate(sky, altitude, (x, y, z), tuple(sun_flat), reach, sees_ground > 0, key, hemisphere, apart)
    return Estimate(*(answer.reshape(*answer.shape[:-2], *shape, answer.shape[-1]) for answer in answers))


@eqx.filter_jit
def _estimate(
    sky: PathTraceSky,
    altitude: Altitude,
    view: Vector,
    sun: Vector,
    reach: Length,
    ground: Bool[Array, " rays"],
    key: PRNGKeyArray,
    hemisphere: bool,
    apart: bool,
) -> Estimate:
    """The same for a list of rays: one compilation serves every question of its length."""
    rays = _enter(sky.atmosphere, altitude, view, sun, reach, ground)
    mean, error = (x if apart else x[0] for x in _average(sky, rays, key, hemisphere, apart))
    return Estimate(mean, error, jnp.moveaxis(_transmittance(sky.atmosphere, rays), 0, -1))


def _enter(
    atmosphere: Atmosphere, altitude: Altitude, view: Vector, sun: Vector, reach: Length, ground: Bool[Array, " rays"]
) -> Rays:
    """Rays that start inside the atmosphere; one that misses it starts at the top and leaves at once."""
    radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
    nu = vector.dot(view, sun)
    inside, _, _, moved, misses = geometry.enter_atmosphere(altitude, view[2], sun[2], nu, radius, top)
    pole = (jnp.zeros_like(nu), jnp.zeros_like(nu), jnp.ones_like(nu))
    up = vector.unit(vector.combine((radius + altitude, pole), (moved, view)))
    return Rays(inside, up, vector.where(misses, up, view), sun, jnp.maximum(reach - moved, 0), ground)


def _transmittance(atmosphere: Atmosphere, rays: Rays) -> Float[Array, "w rays"]:
    """To the end of each ray, or as far as it reaches."""
    mu = vector.cosine(rays.up, rays.view)
    ground = geometry.hits_ground(rays.altitude, mu, atmosphere.bottom_radius)
    ray = columns.segment(atmosphere, rays.altitude, mu, ground)
    end = jnp.minimum(rays.reach, ray.length)
    half = jnp.full((), 0.5, mu.dtype)
    whole, _ = columns.walk(atmosphere, ray, end, half, FINE, lambda carry, _: (carry, None), None)
    return columns.transmittance(atmosphere, whole)


def _average(
    sky: PathTraceSky, rays: Rays, key: PRNGKeyArray, hemisphere: bool, apart: bool
) -> tuple[Float[Array, "part rays w"], Float[Array, "part rays w"]]:
    """Mean over the paths of each ray and its standard error, a chunk of rays at a time."""
    _, replicates, lanes, panels = sky.resolution
    number, points = rays.altitude.size, sky.resolution.points
    # Lanes of one replicate share its lattice; each gets some tens of paths, long enough to keep it busy to the end.
    shares = min(max(1, lanes // (number * replicates)), max(1, points // 16))
    shares = 1 << (shares.bit_length() - 1)
    group = max(1, lanes // (replicates * shares))
    chunks = -(-number // group)
    group = -(-number // chunks)

    bits = jax.vmap(lambda ray: jax.random.bits(jax.random.fold_in(key, ray), (2, replicates, 1), jnp.uint32))(
        jnp.arange(number)
    )
    first = jnp.tile(jnp.arange(shares, dtype=jnp.uint32), group * replicates)

    def chunk(arguments: tuple[Rays, Array]) -> Float[Array, "part w group replicate"]:
        some, bits = arguments

        def spread(x: Array) -> Array:
            return jnp.broadcast_to(x, (group, replicates, shares)).reshape(-1)

        starts = jax.tree.map(lambda x: spread(x[:, None, None]), some)
        total = trace(
            sky.atmosphere,
            sky.guide,
            starts,
            (spread(bits[:, 0]), spread(bits[:, 1])),
            first,
            count=points,
            stride=shares,
            panels=panels,
            hemisphere=hemisphere,
            apart=apart,
        )
        return jnp.sum(total.reshape(*total.shape[:2], group, replicates, shares), axis=-1) / points

    def split(x: Array) -> Array:
        padded = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (chunks * group - number, *x.shape[1:]))])
        return padded.reshape(chunks, group, *x.shape[1:])

    means = jax.lax.map(chunk, jax.tree.map(split, (rays, bits)))
    # Axes: part, ray, wavelength, replicate.
    means = means.transpose(1, 0, 3, 2, 4).reshape(means.shape[1], chunks * group, -1, replicates)[:, :number]
    return jnp.mean(means, axis=-1), jnp.std(means, axis=-1, ddof=1) / math.sqrt(replicates)
