"""A measured scan of the sky as an observation: ``diffatmo fit SCAN.npz`` with no further option."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diffatmo.cli import photo

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
    angle. 0 if there are too few directions to tell.
    """
    import numpy as np

    light = np.log(np.maximum(spectra.radiance.mean(axis=1), 1e-30))
    zenith, sun = spectra.view_zenith, spectra.sun_zenith
    around = spectra.view_azimuth - spectra.sun_azimuth
    turns = np.radians(np.arange(-SLIP_DEG, SLIP_DEG + 0.25, 0.5))
    left = []
    for turn in turns:
        cosine = np.cos(zenith) * np.cos(sun) + np.sin(zenith) * np.sin(sun) * np.cos(around + turn)
        angle = np.arccos(np.clip(cosine, -1, 1))
        path = 1 / (np.cos(zenith) + 0.1)
        columns = np.stack(
            [np.ones_like(angle), angle, angle**2, angle**3, np.exp(-4 * angle), path, path**2, path * angle], axis=1
        )
        if len(columns) < 3 * columns.shape[1]:
            return 0.0
        left.append(float(np.sum((light - columns @ np.linalg.lstsq(columns, light, rcond=None)[0]) ** 2)))
    return float(turns[int(np.argmin(left))])


def observe(spectra: "Spectra", options: Mapping[str, Any], chosen: Mapping[str, Any], name: str) -> "Observation":
    """The scan as an observation; ``chosen`` is what the user says of it."""
    import numpy as np

    import fitting
    from diffatmo import bands, sun
    from diffatmo.scan import Scan

    kept = spectra.wavelengths <= LONGEST_NM
    light = spectra.radiance[:, kept]
    shared = math.sqrt(max(kept.sum() / INDEPENDENT, 1.0))
    # The sun moves while a scan lasts; its azimuth is what the instrument's own is measured from.
    turned = spectra.view_azimuth - (spectra.sun_azimuth - spectra.sun_azimuth.mean())
    usual: dict[str, Any] = {
        "noise": shared * NOISE,
        "noise_floor": shared * FLOOR * float(np.mean(light)),
        "sun_exclusion": math.radians(SUN_DEG),
        "pose": "free",
        "pose_error": math.radians(POSE_ERROR_DEG),
        "heading_error": math.radians(HEADING_ERROR_DEG),
    }
    return fitting.observe(
        light[None],
        camera=Scan(spectra.view_zenith, turned, fov=spectra.fov, yaw=slip(spectra)),
        altitude=options.get("altitude_km", photo.EYE_LEVEL_KM),
        sun=np.asarray(sun.direction(zenith=spectra.sun_zenith.mean(), azimuth=spectra.sun_azimuth.mean())),
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
