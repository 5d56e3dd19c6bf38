"""Where the sun stands at a moment, from a place: to 0.005° from 1950 to 2100, in single precision too.

Three steps, each an equation of its own:

1. :func:`epoch`, on the host in double precision: the angles that grow with time, at one moment and less than a turn.
2. :func:`geocentric`: the sun's apparent direction from the centre of the Earth, some seconds from that moment. The main
   terms of VSOP87D (Bretagnon & Francou 1988, A&A 202, 309), nutation and aberration.
3. :func:`topocentric`: the same from a place, in its local frame; and :func:`refracted`, as the air shows it.

Nothing but sines and cosines of angles is involved up to there, so that every derivative exists, at the poles as well.
Chapters and equations are those of Meeus, Astronomical Algorithms, 2nd ed. (1998). UT1 is taken to be UTC, from which it
differs by less than 0.9 s, or 0.004° of the Earth's rotation.
"""

from datetime import UTC, datetime
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo._types import Direction, Scalar
from diffatmo.numerics import safe_norm


class TimeError(ValueError):
    """A time is not one moment; the message says why."""


J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
DAY = 86400.0
CENTURY = 36525 * DAY
ARCSECOND = np.pi / (180 * 3600)

EQUATORIAL_RADIUS_KM = 6378.14
PARALLAX = 8.794 * ARCSECOND
"""Of the sun at a distance of 1 au (chapter 40)."""
ABERRATION = 20.4898 * ARCSECOND
"""At a distance of 1 au (25.10)."""

# Of the Earth's heliocentric longitude (VSOP87D), all above 7e-6 rad within a century of 2000: amplitude in 1e-8 rad, to be
# multiplied by millennia to this power, phase in rad, frequency in rad per millennium.
_LONGITUDE = np.array(
    [
        (3341656, 0, 4.6692568, 6283.0758500),
        (34894, 0, 4.6261024, 12566.1517000),
        (3497, 0, 2.7441178, 5753.3848849),
        (3418, 0, 2.8288658, 3.5231183),
        (3136, 0, 3.6276704, 77713.7714681),
        (2676, 0, 4.4180835, 7860.4193924),
        (2343, 0, 6.1351621, 3930.2096962),
        (1324, 0, 0.7424634, 11506.7697698),
        (1273, 0, 2.0370966, 529.6909651),
        (1199, 0, 1.1096295, 1577.3435424),
        (990, 0, 5.2326811, 5884.9268466),
        (902, 0, 2.0450545, 26.2983198),
        (857, 0, 3.5084915, 398.1490034),
        (780, 0, 1.1788268, 5223.6939198),
        (753, 0, 2.5333905, 5507.5532387),
        (206059, 1, 2.6782346, 6283.0758500),
        (4303, 1, 2.6351268, 12566.1517000),
    ]
)
_MEAN_LONGITUDE = (1.75347046, 6283.31966747, 0.00052919)
"""Its secular part: a polynomial in millennia, rad."""

_DISTANCE = np.array([(0.01670700, 0, 3.0984635, 6283.0758500), (0.00013956, 0, 3.0552461, 12566.1517000)])
"""Likewise of the distance, in au, besides its mean of 1.00013989."""

# Nutation (chapter 22): the node of the Moon's orbit, the mean longitudes of sun and Moon, in degrees, per century.
_NODE, _SUN, _MOON = (125.04452, -1934.136261), (280.4665, 36000.7698), (218.3165, 481267.8813)
# How often each is in the argument, then arcseconds in longitude (sine) and in obliquity (cosine).
_NUTATION = np.array([(1, 0, 0, -17.20, 9.20), (0, 2, 0, -1.32, 0.57), (0, 0, 2, -0.23, 0.10), (2, 0, 0, 0.21, -0.09)])
_NUTATION_ANGLES = _NUTATION[:, :3] @ np.radians([_NODE, _SUN, _MOON])

_SIDEREAL = np.radians(360.98564736629) / DAY
"""The Earth's rotation against the equinox, rad/s (12.4)."""

_LEADS = ((1950, 1960, 1970, 1980, 1990, 2000, 2010, 2020), (29.1, 33.1, 40.2, 50.5, 56.9, 63.8, 66.1, 69.4))
"""Seconds by which uniform time is ahead of the Earth's rotation (table 10.A, IERS); the sun moves by 0.0007° in a minute."""


class Epoch(NamedTuple):
    """The angles that grow with time at one moment, rad, less than a turn, and amplitudes that change over centuries."""

    longitude: Float[Any, ""]
    """The sun's mean longitude."""
    sidereal: Float[Any, ""]
    """Mean sidereal time at Greenwich."""
    obliquity: Float[Any, ""]
    """Mean, of the ecliptic."""
    longitude_amplitudes: Float[Any, " n"]
    longitude_phases: Float[Any, " n"]
    distance_phases: Float[Any, " m"]
    nutation_phases: Float[Any, " k"]


def epoch(time: datetime) -> Epoch:
    """The angles at ``time``, which needs a time zone. Raises :class:`TimeError` if it has none."""
    if not isinstance(time, datetime):
        raise TimeError(f"time: got {time!r}, expected a datetime with a time zone")
    if time.utcoffset() is None:
        raise TimeError(
            f"time: {time.isoformat()} has no time zone, expected one, like {time.isoformat()}+00:00 for UTC"
        )
    rotation = (time - J2000).total_seconds()
    uniform = rotation + float(np.interp(2000 + rotation / (365.25 * DAY), *_LEADS))
    days, centuries, millennia = rotation / DAY, uniform / CENTURY, uniform / (10 * CENTURY)
    # (12.4); the whole turns of the days are left out before they cost digits.
    sidereal = 280.46061837 + 0.98564736629 * days + 360 * (days % 1) + 0.000387933 * centuries**2
    # (22.2)
    obliquity = 84381.448 - 46.8150 * centuries - 0.00059 * centuries**2 + 0.001813 * centuries**3
    amplitude, power, phase, frequency = _LONGITUDE.T
    return Epoch(
        longitude=_reduced(np.polynomial.polynomial.polyval(millennia, _MEAN_LONGITUDE) + np.pi),
        sidereal=_reduced(np.radians(sidereal)),
        obliquity=np.asarray(obliquity * ARCSECOND),
        longitude_amplitudes=1e-8 * amplitude * millennia**power,
        longitude_phases=_reduced(phase + frequency * millennia),
        distance_phases=_reduced(_DISTANCE[:, 2] + _DISTANCE[:, 3] * millennia),
        nutation_phases=_reduced(_NUTATION_ANGLES[:, 0] + _NUTATION_ANGLES[:, 1] * centuries),
    )


def _reduced(angle: Any) -> Any:
    return np.remainder(angle, 2 * np.pi)


class Geocentric(NamedTuple):
    """The sun from the centre of the Earth."""

    direction: Float[Array, "... 3"]
    """Apparent: x to the true equinox of date, z to the north pole."""
    distance: Float[Array, "..."]
    """au."""
    sidereal: Float[Array, "..."]
    """Apparent sidereal time at Greenwich, rad, up to whole turns."""


def geocentric(at: Epoch, offset_s: Float[Array, "..."]) -> Geocentric:
    """The sun so many seconds after a moment; all angles grow in proportion to them, for years without an error."""

    def waves(phases: Any, per_second: np.ndarray) -> Float[Array, "... n"]:
        return jnp.asarray(phases) + offset_s[..., None] * per_second

    nutation = waves(at.nutation_phases, _NUTATION_ANGLES[:, 1] / CENTURY)
    in_longitude = ARCSECOND * jnp.sum(_NUTATION[:, 3] * jnp.sin(nutation), axis=-1)
    in_obliquity = ARCSECOND * jnp.sum(_NUTATION[:, 4] * jnp.cos(nutation), axis=-1)
    distances = waves(at.distance_phases, _DISTANCE[:, 3] / (10 * CENTURY))
    distance = 1.00013989 + jnp.sum(_DISTANCE[:, 0] * jnp.cos(distances), axis=-1)
    longitudes = waves(at.longitude_phases, _LONGITUDE[:, 3] / (10 * CENTURY))
    longitude = at.longitude + offset_s * (_MEAN_LONGITUDE[1] / (10 * CENTURY))
    longitude = longitude + jnp.sum(at.longitude_amplitudes * jnp.cos(longitudes), axis=-1)
    longitude = longitude + in_longitude - ABERRATION / distance
    obliquity = at.obliquity + in_obliquity
    along, across = jnp.cos(longitude), jnp.sin(longitude)
    # The sun's own latitude is below 0.0004°.
    direction = jnp.stack([along, across * jnp.cos(obliquity), across * jnp.sin(obliquity)], axis=-1)
    return Geocentric(direction, distance, at.sidereal + offset_s * _SIDEREAL + in_longitude * jnp.cos(obliquity))


def topocentric(
    sun: Geocentric, *, latitude: Float[Array, "..."], longitude: Float[Array, "..."], altitude: Float[Array, "..."]
) -> Direction:
    """Unit vector to the sun from a place (rad, east positive, km), without refraction (13.5, 13.6, chapter 40)."""
    x, y, z = jnp.moveaxis(sun.direction, -1, 0)
    turn = sun.sidereal + longitude
    meridian, west = x * jnp.cos(turn) + y * jnp.sin(turn), x * jnp.sin(turn) - y * jnp.cos(turn)
    north = z * jnp.cos(latitude) - meridian * jnp.sin(latitude)
    up = z * jnp.sin(latitude) + meridian * jnp.cos(latitude)
    # The place is one radius of the Earth above its centre, from where the sun is a little lower.
    lower = PARALLAX * (1 + altitude / EQUATORIAL_RADIUS_KM) / sun.distance
    seen = jnp.stack(jnp.broadcast_arrays(-west, north, up - lower), axis=-1)
    return seen / safe_norm(seen)[..., None]


FULL_DEG, NONE_DEG = -5 / 6, -1.5
"""True elevations between which refraction fades: the sun has set at the first, and what is below is not seen."""
_NEAR_ZENITH = 1e-3


def refraction(elevation: Float[Array, "..."], *, strength: float | Scalar = 1.0) -> Float[Array, "..."]:
    """By how much air lifts what is at a true elevation, all in rad (Saemundsson 1986; 16.4), nothing below the horizon.

    ``strength`` is that of the air: pressure / 1010 hPa × 283 K / temperature.
    """
    true = jnp.degrees(elevation)
    high = jnp.maximum(true, NONE_DEG)
    argument = jnp.radians(high + 10.3 / (high + 5.11))
    # Arcminutes; the last term makes it vanish in the zenith.
    lift = 1.02 * jnp.cos(argument) / jnp.sin(argument) + 0.0019279
    part = jnp.clip((true - NONE_DEG) / (FULL_DEG - NONE_DEG), 0, 1)
    return strength * jnp.radians(lift / 60) * part**2 * (3 - 2 * part)


def refracted(direction: Direction, *, strength: Float[Array, "..."]) -> Direction:
    """Unit vectors, local frame, lifted by :func:`refraction`."""
    # Lifting is adding something upright: nearly the same for all directions, so that it has a value and a derivative in
    # the zenith too, where no direction is that of lifting.
    across = jnp.maximum(safe_norm(direction[..., :2]), _NEAR_ZENITH)
    elevation = jnp.arctan2(direction[..., 2], across)
    lift = refraction(elevation, strength=strength)
    upright = jnp.sin(lift) * safe_norm(jnp.stack([across, direction[..., 2]], axis=-1)) / jnp.cos(elevation + lift)
    seen = jnp.concatenate([direction[..., :2], (direction[..., 2] + upright)[..., None]], axis=-1)
    return seen / safe_norm(seen)[..., None]
