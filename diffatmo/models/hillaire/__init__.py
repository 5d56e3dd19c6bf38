"""The sky of Hillaire 2020, as in Unreal's SkyAtmosphere: small tables, made anew for every frame.

What it costs in accuracy is part of it: all orders from the second on are isotropic and form a geometric series with the ratio
of one place, light is marched in a few steps, and a table of the sky is interpolated linearly.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffatmo import geometry
from diffatmo._types import Altitude, Cosine, Direction, Irradiance, Length, Scalar
from diffatmo.atmosphere import Atmosphere
from diffatmo.camera import Camera
from diffatmo.models.base import Model, Path, Ray, Sky, View
from diffatmo.models.hillaire.luts import Luts, SkyView, Steps, cast, compute, march
from diffatmo.models.tables import Planet, Sizes, bilinear, taps
from diffatmo.models.transmittance_table import SUN_ANGULAR_RADIUS, to_ground, to_sun, to_top
from diffatmo.numerics import whole_products

__all__ = ["AerialVolume", "Hillaire", "HillaireSky", "HillaireView", "Luts", "SkyView", "Steps"]


IRRADIANCE_SIZE = 64
"""Suns for which the irradiance of the ground by the sky is tabulated; they crowd about the horizon."""

LOWEST_SUN = -0.3
"""mu_s of the lowest of them."""


class Hillaire(Model):
    """The model of Hillaire 2020.

    Sizes are (columns, rows) as in the paper: mu by radius, mu_s by altitude, longitude by latitude. Raises :class:`ValueError`
    for sizes that cannot be.
    """

    transmittance_size: tuple[int, int] = (256, 64)
    multiple_size: tuple[int, int] = (32, 32)
    sky_view_size: tuple[int, int] = (192, 108)
    steps: Steps = Steps()

    def __check_init__(self) -> None:
        for name in ("transmittance_size", "multiple_size", "sky_view_size"):
            if min(getattr(self, name)) < 2:
                raise ValueError(f"{name}: got {getattr(self, name)}, expected at least 2 by 2")
        if self.sky_view_size[1] < 4 or self.sky_view_size[1] % 2:
            raise ValueError(f"sky_view_size: got {self.sky_view_size[1]} rows, expected an even number of at least 4")
        for name, count in self.steps._asdict().items():
            # A single direction would be a horizontal one, along which next to no light leaves: f_ms is nearly 1.
            least = 2 if name == "directions" else 1
            if count < least:
                raise ValueError(f"steps.{name}: got {count}, expected at least {least}")

    def sky(self, atmosphere: Atmosphere) -> "HillaireSky":
        """Compute the tables that do not depend on the camera."""
        sizes = Sizes(
            transmittance_mu=self.transmittance_size[0],
            transmittance_r=self.transmittance_size[1],
            mu_s=IRRADIANCE_SIZE,
        )
        planet = Planet(atmosphere.bottom_radius, atmosphere.top_altitude, LOWEST_SUN, sizes, "2017")
        luts = compute(atmosphere, planet, self.multiple_size, self.steps)
        return HillaireSky(atmosphere, planet, luts, self.sky_view_size, self.steps)


class HillaireSky(Sky):
    """The tables of one atmosphere."""

    atmosphere: Atmosphere
    planet: Planet
    luts: Luts
    sky_view_size: tuple[int, int] = eqx.field(static=True)
    steps: Steps = eqx.field(static=True)

    def path(self, *, altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, distance: Length | None = None) -> Path:
        """Inscattered radiance and transmittance to the boundary, or to ``distance`` km if that is nearer: the ray march."""
        return cast(self.atmosphere, self.planet, self.luts, altitude, mu, mu_s, nu, None, distance, self.steps.march)

    def sun_irradiance(self, *, altitude: Altitude, mu_s: Cosine) -> Irradiance:
        """Direct irradiance of the sun on a horizontal plane."""
        falling = jnp.maximum(mu_s, 0)[..., None] * self.atmosphere.solar_irradiance
        altitude, mu_s = jnp.broadcast_arrays(altitude, mu_s)
        inside = jnp.minimum(altitude, self.planet.top_altitude)
        return falling * to_sun(self.planet, self.luts.transmittance, inside, mu_s, SUN_ANGULAR_RADIUS)

    def sky_irradiance(self, *, mu_s: Cosine) -> Irradiance:
        """Diffuse irradiance of the sky on the ground."""
        first, part = taps(self.planet.mu_s_position(mu_s), self.luts.irradiance.shape[0])
        weight = part[..., None]
        return self.luts.irradiance[first] * (1 - weight) + self.luts.irradiance[first + 1] * weight

    def view(self, *, altitude: Altitude, sun: Direction) -> "HillaireView":
        """The sky-view table for one place and sun."""
        sun = jnp.asarray(sun, jnp.result_type(sun, 1.0))
        place = jnp.asarray(altitude, sun.dtype)
        table = SkyView.compute(
            self.atmosphere, self.planet, self.luts, place, sun[2], self.sky_view_size, self.steps.sky_view
        )
        return HillaireView(self, place, sun, table)

    @whole_products
    def aerial_volume(
        self,
        camera: Camera,
        *,
        altitude: Altitude,
        sun: Direction,
        reach: float = 32.0,
        size: tuple[int, int, int] = (32, 32, 32),
    ) -> "AerialVolume":
        """Light and transmittance between the camera and the froxels of its frustum, up to ``reach`` km (section 5.4)."""
        width, height, slices = size
        x = jnp.linspace(-0.5, camera.width - 0.5, width)
        y = jnp.linspace(-0.5, camera.height - 0.5, height)
        view = camera.directions_at(x, y[:, None])
        mu, mu_s, nu = view[..., 2], sun[2], view @ sun
        radius, top = self.planet.bottom_radius, self.planet.top_altitude
        # From space, the slices in front of the atmosphere are empty.
        start, mu, mu_s, moved, _ = geometry.enter_atmosphere(
            jnp.full(mu.shape, altitude, mu.dtype), mu, jnp.broadcast_to(mu_s, mu.shape), nu, radius, top
        )
        ground = geometry.hits_ground(start, mu, radius)
        limit = geometry.distance_to_boundary(start, mu, ground, radius, top)
        ends = jnp.clip((jnp.arange(1, slices + 1) * (reach / slices))[:, None, None] - moved, 0, limit)
        sums = march(
            self.atmosphere,
            self.planet,
            self.luts.transmittance,
            self.luts.multiple,
            start,
            mu,
            mu_s,
            nu,
            ends,
            every=True,
        )
        # In front of the first froxel there is nothing yet.
        nothing = jnp.zeros_like(sums.light[:1])
        return AerialVolume(
            jnp.concatenate([nothing, sums.light]),
            jnp.concatenate([nothing + 1, sums.transmittance]),
            reach,
            (camera.height, camera.width),
        )


class HillaireView(View):
    """A sky seen from one place under one sun: the sky-view table, and the ground behind it."""

    sky: HillaireSky
    altitude: Scalar
    sun: Direction
    table: SkyView

    @whole_products
    def radiance(self, *, view: Direction) -> Ray:
        """Radiance (ground included, sun's disc not) and transmittance along unit vectors ``view``, shape (..., 3)."""
        sky, planet, transmittance = self.sky, self.sky.planet, self.sky.luts.transmittance
        radius, top = planet.bottom_radius, planet.top_altitude
        mu, mu_s, nu = view[..., 2], self.sun[2], view @ self.sun
        altitude = jnp.broadcast_to(self.altitude, mu.shape)
        ground = geometry.hits_ground(altitude, mu, radius)
        light = self.table.look_up(mu, nu, ground)
        start, mu_in, mu_s_in, _, misses = geometry.enter_atmosphere(
            altitude, mu, jnp.broadcast_to(mu_s, mu.shape), nu, radius, top
        )
        down = to_ground(planet, transmittance, start, mu_in, ground)
        survives = jnp.where(ground[..., None], down, to_top(planet, transmittance, start, mu_in))
        reach = geometry.distance_down(start, mu_in, jnp.zeros_like(start), radius)
        mu_s_ground = planet.cosine_after(start, mu_s_in, nu, reach, 0.0)
        light = light + jnp.where(ground[..., None], survives * sky.ground_radiance(mu_s=mu_s_ground), 0)
        return Ray(jnp.where(misses[..., None], 0, light), jnp.where(misses[..., None], 1, survives))


class AerialVolume(eqx.Module):
    """The aerial-perspective volume: slices at equal distances, the first of them at the camera."""

    light: Float[Array, "slice y x w"]
    transmittance: Float[Array, "slice y x w"]
    reach: float
    picture: tuple[int, int] = eqx.field(static=True)

    def at(self, x: Float[Array, "..."], y: Float[Array, "..."], depth: Length) -> Path:
        """Between the camera and ``depth`` km along the ray of pixel (x, y), by trilinear interpolation."""
        slices, rows, columns = self.light.shape[:3]
        height, width = self.picture
        # Slices are interpolated in between by hand: two bilinear lookups.
        first, part = taps(jnp.clip(depth / self.reach, 0, 1) * (slices - 1), slices)
        row = jnp.clip((y + 0.5) / height, 0, 1) * (rows - 1)
        column = jnp.clip((x + 0.5) / width, 0, 1) * (columns - 1)

        def look_up(volume: Float[Array, "slice y x w"]) -> Float[Array, "... w"]:
            flat = volume.reshape(slices * rows, columns, -1)
            near = bilinear(flat, first * rows + row, column)
            far = bilinear(flat, (first + 1) * rows + row, column)
            return near * (1 - part[..., None]) + far * part[..., None]

        return Path(look_up(self.light), look_up(self.transmittance))
