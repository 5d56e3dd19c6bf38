"""The sun from time and place: against pvlib's SPA, published examples, identities, and differences for its derivatives."""

import csv
from datetime import UTC, date, datetime, timedelta, timezone
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import ephemeris, sun
from diffatmo.ephemeris import TimeError

UTC = UTC
SOLSTICE = datetime(2024, 6, 20, 20, 51, tzinfo=UTC)
TABLE = Path(__file__).parent / "data" / "sun_positions.csv"
"""60 moments and places; the first line says where the angles are from."""


def table():
    with open(TABLE, newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def unit(elevation_deg, azimuth_deg):
    elevation, azimuth = np.radians(np.asarray(elevation_deg, float)), np.radians(np.asarray(azimuth_deg, float))
    level = np.cos(elevation)
    return np.stack([level * np.sin(azimuth), level * np.cos(azimuth), np.sin(elevation)], axis=-1)


def degrees_between(a, b):
    return np.degrees(np.linalg.norm(np.asarray(a, np.float64) - np.asarray(b, np.float64), axis=-1))


def subsolar(time):
    """Latitude and longitude, in degrees, above which the sun stands."""
    east, north, up = np.asarray(sun.position(time, latitude_deg=0, longitude_deg=0, refraction=False))
    return float(np.degrees(np.arcsin(north))), float(np.degrees(np.arctan2(east, up)))


def check_table():
    rows = table()
    assert len(rows) == 60
    errors = {"elevation_deg": [], "apparent_elevation_deg": []}
    for row in rows:
        place = {key: float(row[key]) for key in ("latitude_deg", "longitude_deg", "altitude_km")}
        air = {key: float(row[key]) for key in ("pressure_hpa", "temperature_k")}
        time = datetime.fromisoformat(row["time"])
        for key, found in errors.items():
            refraction = key != "elevation_deg"
            towards = sun.position(time, **place, **air, refraction=refraction)
            found.append(degrees_between(towards, unit(row[key], row["azimuth_deg"])))
    print({key: (np.max(found), np.sqrt(np.mean(np.square(found)))) for key, found in errors.items()})
    assert max(np.max(found) for found in errors.values()) < 0.005


def test_against_pvlib_from_1950_to_2100():
    check_table()


def test_against_pvlib_in_double_precision(x64):
    check_table()


def test_example_of_the_spa_report():
    # Reda & Andreas 2004 (revised 2008), NREL/TP-560-34302, appendix A.5.
    towards = sun.position(
        datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7))),
        latitude_deg=39.742476,
        longitude_deg=-105.1786,
        altitude_km=1.83014,
        pressure_hpa=820,
        temperature_k=273.15 + 11,
    )
    assert degrees_between(towards, unit(90 - 50.11162, 194.34024)) < 0.003


def test_example_of_meeus(x64):
    # Chapter 25, example 25.b: 1992 October 13, 0h TD; right ascension 13h 13m 30.749s, declination -7° 47' 01.74".
    time = datetime(1992, 10, 13, tzinfo=UTC) - timedelta(seconds=58.3)
    x, y, z = np.asarray(ephemeris.geocentric(ephemeris.epoch(time), jnp.zeros(())).direction)
    assert np.degrees(np.arcsin(z)) == pytest.approx(-(7 + 47 / 60 + 1.74 / 3600), abs=0.001)
    assert np.degrees(np.arctan2(y, x)) % 360 == pytest.approx(15 * (13 + 13 / 60 + 30.749 / 3600), abs=0.001)


def test_sidereal_time_of_meeus(x64):
    # Examples 12.a and 12.b: 1987 April 10, 0h UT and 19h 21m.
    for hour, minute, mean in ((0, 0, 15 * (13 + 10 / 60 + 46.3668 / 3600)), (19, 21, 128.7378734)):
        at = ephemeris.epoch(datetime(1987, 4, 10, hour, minute, tzinfo=UTC))
        assert np.degrees(at.sidereal) == pytest.approx(mean, abs=1e-6)


@pytest.mark.parametrize(
    ("time", "declination_deg"),
    [
        # Equinoxes and solstices of 2024, to the minute (US Naval Observatory).
        (datetime(2024, 3, 20, 3, 6, tzinfo=UTC), 0.0),
        (SOLSTICE, 23.4386),
        (datetime(2024, 9, 22, 12, 44, tzinfo=UTC), 0.0),
        (datetime(2024, 12, 21, 9, 20, tzinfo=UTC), -23.4386),
    ],
)
def test_seasons(time, declination_deg):
    # At the pole the sun's elevation is its declination, less 0.0024° of parallax, whatever the longitude.
    towards = sun.position(time, latitude_deg=90, longitude_deg=jnp.array([0.0, 50.0, -130.0]), refraction=False)
    np.testing.assert_allclose(np.degrees(np.arcsin(towards[:, 2])), declination_deg - 0.0024, atol=0.0015)


def test_equation_of_time():
    # Meeus, example 28.a: 1992 October 13, 0h TD: 3.427351° by which the sun is ahead of the clock.
    _, longitude = subsolar(datetime(1992, 10, 13, tzinfo=UTC) - timedelta(seconds=58.3))
    assert pytest.approx(longitude - 360 * (longitude > 0), abs=0.002) == -180 + 58.3 / 240 - 3.427351


def test_zenith_and_nadir():
    latitude, longitude = subsolar(SOLSTICE)
    above = sun.position(SOLSTICE, latitude_deg=latitude, longitude_deg=longitude)
    below = sun.position(SOLSTICE, latitude_deg=-latitude, longitude_deg=longitude + 180)
    assert degrees_between(above, [0, 0, 1]) < 0.003
    assert degrees_between(below, [0, 0, -1]) < 0.003


def test_morning_mirrors_evening():
    _, longitude = subsolar(SOLSTICE)
    offset = jnp.linspace(0, 43200, 25)
    place = {"latitude_deg": 48.0, "longitude_deg": longitude}
    evening = np.asarray(sun.position(SOLSTICE, **place, offset_s=offset))
    morning = np.asarray(sun.position(SOLSTICE, **place, offset_s=-offset))
    # Up to the equation of time, which changes by 13 s a day, or 0.027° in half a day.
    assert degrees_between(morning * [-1, 1, 1], evening).max() < 0.06
    assert degrees_between(evening[0], unit(90 - 48 + 23.44, 180)) < 0.02


def test_an_offset_is_a_later_time_and_the_zone_is_only_a_name():
    place = {"latitude_deg": -33.0, "longitude_deg": 151.0}
    later = sun.position(SOLSTICE + timedelta(hours=30), **place)
    assert degrees_between(sun.position(SOLSTICE, **place, offset_s=30 * 3600.0), later) < 2e-4
    local = SOLSTICE.astimezone(timezone(timedelta(hours=10)))
    np.testing.assert_array_equal(sun.position(local, **place), sun.position(SOLSTICE, **place))


def test_refraction_of_the_air():
    # Meeus, chapter 16: 28.98' at a true elevation of 0; a rising sun at -50' is lifted by its radius and half a degree.
    def lift(elevation_deg, strength=1.0):
        found = ephemeris.refraction(jnp.radians(jnp.asarray(elevation_deg, float)), strength=strength)
        return 60 * np.degrees(np.asarray(found))

    assert lift(0.0) == pytest.approx(28.98, abs=0.02)
    assert lift(0.0, 0.8) == pytest.approx(0.8 * 28.98, abs=0.02)
    # High up it is the refractivity over the tangent, 58.3" at that pressure and temperature; good to 0.1'.
    assert lift(33.0) == pytest.approx(58.3 / 60 / np.tan(np.radians(33)), abs=0.1)
    assert lift(90.0) == pytest.approx(0, abs=1e-4)
    np.testing.assert_array_equal(lift([-1.5, -2, -5.11, -30, -90]), 0)
    true = np.linspace(-3, 3, 2001)
    apparent = true + lift(true) / 60
    # No two suns in one place, and none that jumps.
    assert np.all(np.diff(apparent) > 0)
    assert np.diff(apparent).max() < 3 * 0.003


def test_pressure_falls_off_with_altitude():
    low, high = (
        sun.position(SOLSTICE, latitude_deg=69.0, longitude_deg=-130.0, altitude_km=h, offset_s=-43200.0)[2]
        for h in (0.0, 8.0)
    )
    bare = sun.position(SOLSTICE, latitude_deg=69.0, longitude_deg=-130.0, offset_s=-43200.0, refraction=False)[2]
    assert (high - bare) / (low - bare) == pytest.approx(np.exp(-1), rel=0.02)


def test_derivatives(x64, check_jacobian):
    latitude, longitude = subsolar(SOLSTICE)

    def towards(x):
        return sun.position(SOLSTICE, latitude_deg=x[0], longitude_deg=x[1], offset_s=x[2], altitude_km=x[3])

    # By day, near the horizon where refraction fades, in the zenith and nadir, and at the pole.
    points = [[40.0, -100.0, 50.0, 1.0], [latitude, longitude + 90.8, 0.0, 0.0], [latitude, longitude, 0.0, 0.0]]
    points += [[-latitude, longitude + 180, 0.0, 0.0], [90.0, 10.0, 0.0, 0.0], [-90.0, 0.0, 1e5, 0.0]]
    check_jacobian(towards, points)


def test_derivatives_are_finite_where_the_sun_is_upright():
    jacobian = jax.jacrev(lambda v: ephemeris.refracted(v, strength=jnp.ones(())))
    for towards in ([0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1e-20, 0.0, 1.0], [1.0, 0.0, 0.0]):
        assert np.isfinite(jacobian(jnp.array(towards))).all()


@pytest.mark.parametrize(
    ("time", "message"),
    [
        (
            datetime(2024, 6, 21, 12),
            "time: 2024-06-21T12:00:00 has no time zone, expected one, like 2024-06-21T12:00:00",
        ),
        (date(2024, 6, 21), "time: got datetime.date"),
        ("2024-06-21T12:00:00Z", "time: got '2024-06-21T12:00:00Z', expected a datetime with a time zone"),
    ],
)
def test_what_is_not_one_moment_is_refused(time, message):
    with pytest.raises(TimeError, match="^" + message):
        sun.position(time, latitude_deg=0, longitude_deg=0)
