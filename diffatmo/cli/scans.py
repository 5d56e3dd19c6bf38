"""A measured scan of the sky as an observation: ``diffatmo fit SCAN.npz`` with no further option."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffatmo.cli import photo
from diffatmo.cli.common import InputError
from diffatmo.cli.keys import flag_of
from diffatmo.cli.scenefile import LOWEST_SUN_DEG

if TYPE_CHECKING:
    from diffatmo.atmosphere import Atmosphere
    from diffatmo.scan import Spectra
    from fitting import Observation

FREE = (*photo.FREE, "ozone_absorption")
TIE = {**photo.TIE, "ground_albedo": "start", "ozone_absorption": "dobson"}

NODES = (360.0, 385.0, 410.0, 440.0, 475.0, 510.0, 545.0, 575.0, 605.0, 640.0, 680.0, 720.0)
LONGEST_NM = 712.5
"""Beyond, water vapour and oxygen absorb, which the model does not have."""

NOISE, FLOOR = 0.03, 0.02
"""Relative error of a measurement, and its least in units of the mean radiance."""
INDEPENDENT = 6
"""Numbers of a spectrum whose errors are independent: a calibration, or an aerosol that is unlike the model's, is smooth."""

SUN_DEG, POSE_ERROR_DEG, HEADING_ERROR_DEG = 13.0, 1.0, 3.0
KEYS = (
    *("altitude_km", "noise", "noise_shot", "noise_floor", "sun_exclusion_deg", "horizon_exclusion_deg"),
    *("view_zenith_max_deg", "exposure", "pedestal", "pose", "pose_error_deg", "heading_error_deg"),
    *("sun_offset", "sun_offset_error_deg", "saturation", "aerosol", "aerosol_error", "aerosol_memory_h", "time_h"),
)
"""What a user may say of a scan."""

SLIP_DEG = 45.0
"""Angle by which an instrument's azimuth may be off."""
BETTER = 2.0
"""How much better another turn has to explain the sky for the azimuths to be wrong."""

MOST_SAMPLES = 20_000
"""More would be averaged with whatever stands beside them in the file."""
LONGEST_DEG = 5.0
"""By how much the sun's zenith angle may change while a scan lasts: one sun stands for all of it."""
BRIGHTEST, DARKEST, DAY_DEG = 3.0, 5e-4, 80.0
"""π times the radiance of a sky over the sun's irradiance, its median: a white sheet in the sun has 1, a clear sky from 0.02 to
0.3. The least is for a day, down to this zenith angle of the sun."""


def is_scan(path: Path) -> bool:
    """Whether a file is named like a scan."""
    return path.suffix.lower() in (".npz", ".csv")


def start(spectra: "Spectra") -> "Atmosphere":
    """Where the fit begins: the clear day of photos, over the ground that the scan knows."""
    from dataclasses import replace

    import jax.numpy as jnp
    import numpy as np

    pressure, _ = photo.pressure(None)
    air = photo.start(pressure, NODES)
    if spectra.albedo is None:
        return air
    return replace(air, ground_albedo=jnp.asarray(np.maximum(np.interp(NODES, *spectra.albedo), 0.01), jnp.float32))


def slip(spectra: "Spectra") -> float:
    """By how much, rad, the instrument's azimuths are to be turned clockwise for the sky to be symmetric about the sun.

    Where it is, the logarithm of the radiance is best explained by smooth functions of the angle to the sun and of the zenith
    angle. 0 if there are too few directions to tell. Raises :class:`InputError` if a turn beyond :data:`SLIP_DEG` explains it
    far better.
    """
    import numpy as np

    light = spectra.radiance.mean(axis=1)
    good = np.isfinite(light) & (light > 0)
    light, zenith, sun = np.log(light[good]), spectra.view_zenith[good], spectra.sun_zenith[good]
    around = (spectra.view_azimuth - spectra.sun_azimuth)[good]

    def left(turn: float) -> float:
        cosine = np.cos(zenith) * np.cos(sun) + np.sin(zenith) * np.sin(sun) * np.cos(around + turn)
        angle = np.arccos(np.clip(cosine, -1, 1))
        path = 1 / (np.cos(zenith) + 0.1)
        columns = np.stack(
            [np.ones_like(angle), angle, angle**2, angle**3, np.exp(-4 * angle), path, path**2, path * angle], axis=1
        )
        return float(np.sum((light - columns @ np.linalg.lstsq(columns, light, rcond=None)[0]) ** 2))

    if light.size < 24:  # three for each of the functions
        return 0.0
    near = np.radians(np.arange(-SLIP_DEG, SLIP_DEG + 0.25, 0.5))
    far = np.radians(np.arange(SLIP_DEG + 1, 360 - SLIP_DEG, 2.0))
    rest, other = [left(turn) for turn in near], [left(turn) for turn in far]
    if BETTER * min(other) < min(rest):
        turn = math.degrees(far[int(np.argmin(other))])
        raise InputError(
            f"view_azimuth_deg: the sky is symmetric about the sun if turned by {turn:.0f} degrees, expected at most "
            f"{SLIP_DEG:g}; give azimuths clockwise from north, as sun_azimuth_deg"
        )
    return float(near[int(np.argmin(rest))])


def check(spectra: "Spectra", options: Mapping[str, Any]) -> None:
    """Refuse a scan that cannot be one of a sky under one sun."""
    import numpy as np

    samples, zenith = len(spectra.radiance), np.degrees(spectra.sun_zenith)
    if samples > MOST_SAMPLES:
        raise InputError(f"{samples:,} samples, expected at most {MOST_SAMPLES:,}; average them, or leave some out")
    if zenith.max() > LOWEST_SUN_DEG:
        raise InputError(f"sun_zenith_deg: got {zenith.max():g}, expected at most {LOWEST_SUN_DEG}")
    if np.ptp(zenith) > LONGEST_DEG:
        raise InputError(
            f"sun_zenith_deg: from {zenith.min():.1f} to {zenith.max():.1f}, expected a scan that lasts while it changes by "
            f"{LONGEST_DEG:g} degrees at most; split it"
        )
    if not np.any(spectra.wavelengths <= LONGEST_NM):
        raise InputError(f"wavelength_nm: from {spectra.wavelengths[0]:g}, expected some up to {LONGEST_NM:g}")
    light = np.pi * spectra.radiance / spectra.irradiance
    positive = light[np.isfinite(light) & (light > 0)]
    typical = float(np.median(positive)) if positive.size else 1.0
    least = DARKEST if zenith.max() < DAY_DEG else 0.0
    if options.get("exposure", "fixed") == "fixed" and not least <= typical <= BRIGHTEST:
        raise InputError(
            f"radiance: π times its median is {typical:.2g} of the sun's irradiance, expected {DARKEST:g} to {BRIGHTEST:g}; "
            f"give W m^-2 sr^-1 nm^-1, or {flag_of('exposure')} free"
        )


def observe(spectra: "Spectra", options: Mapping[str, Any], chosen: Mapping[str, Any], name: str) -> "Observation":
    """The scan as an observation; ``chosen`` is what the user says of it. Raises as :func:`check` and :func:`slip` do."""
    import numpy as np

    import fitting
    from diffatmo import bands, sun
    from diffatmo.scan import Scan

    check(spectra, options)
    kept = spectra.wavelengths <= LONGEST_NM
    light = spectra.radiance[:, kept]
    good = light[np.isfinite(light) & (light > 0)]
    shared = math.sqrt(max(kept.sum() / INDEPENDENT, 1.0))
    # The sun moves while a scan lasts; its azimuth is what the instrument's own is measured from.
    azimuth = np.unwrap(spectra.sun_azimuth)
    turned = spectra.view_azimuth - (azimuth - azimuth.mean())
    usual: dict[str, Any] = {
        "noise": shared * NOISE,
        "noise_floor": shared * FLOOR * float(np.mean(good)) if good.size else 0.0,
        "sun_exclusion": math.radians(SUN_DEG),
        "pose": "free",
        "pose_error": math.radians(POSE_ERROR_DEG),
        "heading_error": math.radians(HEADING_ERROR_DEG),
    }
    return fitting.observe(
        light[None],
        camera=Scan(spectra.view_zenith, turned, fov=spectra.fov, yaw=slip(spectra)),
        altitude=options.get("altitude_km", photo.EYE_LEVEL_KM),
        sun=np.asarray(sun.direction(zenith=spectra.sun_zenith.mean(), azimuth=azimuth.mean())),
        bands=bands.narrow(spectra.wavelengths[kept], spectra.irradiance[kept], nodes=NODES),
        name=name,
        **(usual | dict(chosen)),
    )


def assumed(spectra: "Spectra") -> list[str]:
    """What is taken for granted, in words."""
    turn = f"to be turned by {math.degrees(slip(spectra)):+.1f}° ± {HEADING_ERROR_DEG:g}°"
    told = [
        f"azimuth of the instrument: {turn}, by the symmetry of the sky; fitted",
        f"errors: {100 * NOISE:g} %, at least {100 * FLOOR:g} % of the mean, common to much of a spectrum",
    ]
    if spectra.wavelengths[-1] > LONGEST_NM:
        told.append(f"channels beyond {LONGEST_NM:g} nm are left out: water vapour and oxygen absorb there")
    if not spectra.own_sun:
        told.append("irradiance of the sun: the standard spectrum")
    if spectra.albedo is None:
        told.append("albedo of the ground: grey")
    return told
