"""Are photos of known skies recovered within their error bars? Thirty simulated ones, fitted as ``diffatmo fit PHOTO`` does.

python tests/benchmarks/cameras.py [--first 0] [--count 30] [--json FILE]

Skies are drawn from what ``fitting.priors.typical`` says of a clear day, made at 18 wavelengths by the default model, and
summed with the sensitivities of sRGB; the fit has six wavelengths and its coarse model. Cameras take turns: a linear one with
an unknown white balance (``raw``); one that stores eight bits through a random tone curve, with vignetting, and whose compass
is off (``jpeg``); a fisheye whose pose is 2° off (``fisheye``); a panorama with 20 % of clouds (``clouds``); and one whose sun
is clipped in a disc of 4° (``clipped``). All have noise of 1 %.
"""

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import fitting
from diffatmo import bands, color, sun
from diffatmo.atmosphere import Atmosphere
from diffatmo.camera import Camera, Equirectangular, Fisheye, Pinhole
from diffatmo.cli import images, photo
from diffatmo.cli.running import fitting_model
from diffatmo.cli.scenefile import ImageSpec
from diffatmo.compiling import outermost
from diffatmo.exif import Exif
from diffatmo.imageio import Image
from diffatmo.models import Moments
from diffatmo.render import Scene, render
from fitting import priors
from fitting.parameters import select

sys.path.insert(0, str(Path(__file__).parent))
from clouds import cloudy

KINDS = ("raw", "jpeg", "fisheye", "clouds", "clipped")
FINE = tuple(float(nm) for nm in np.linspace(390.0, 730.0, 18))
NOISE, BITS = 0.01, 255
WHERE = {"latitude_deg": 48.0, "longitude_deg": 11.0}
JUDGED = (
    "mie_optical_depth_550", "mie_angstrom_exponent", "mie_g", "mie_scale_height", "turbidity", "visibility",
    "rayleigh_optical_depth_520", "ground_albedo_520",
)  # fmt: skip


def drawn(rng: np.random.Generator) -> dict[str, float]:
    """The numbers of a clear sky."""
    albedo, asymmetry, exponent = (np.array(column) for column in zip(*priors.AEROSOLS.values(), strict=True))
    return {
        "depth": float(np.exp(rng.normal(np.log(0.12), 0.6))),
        "exponent": float(rng.choice(exponent)),
        "single": min(float(rng.choice(albedo)), 0.995),
        "g": float(np.clip(rng.normal(asymmetry.mean(), 0.05), 0.5, 0.85)),
        "height": float(1.5 * np.exp(0.4 * rng.standard_normal())),
        "albedo": float(np.clip(0.15 * np.exp(0.6 * rng.standard_normal()), 0.02, 0.6)),
        "air": float(np.exp(0.06 * rng.standard_normal())),
        "ozone": float(300 * np.exp(0.1 * rng.standard_normal())),
    }


def sky(numbers: dict[str, float], nodes: tuple[float, ...]) -> Atmosphere:
    """The atmosphere with these numbers, at the wavelengths ``nodes``."""
    from dataclasses import replace

    from diffatmo import spectrum

    start = photo.start(photo.pressure(None)[0], nodes)
    scattering, absorption = spectrum.angstrom_aerosol(
        jnp.asarray(nodes), optical_depth_550=numbers["depth"], exponent=numbers["exponent"],
        single_scattering_albedo=numbers["single"], scale_height=numbers["height"],
    )  # fmt: skip
    return replace(
        start,
        rayleigh_scattering=start.rayleigh_scattering * numbers["air"],
        mie_scattering=scattering,
        mie_absorption=absorption,
        mie_scale_height=jnp.asarray(numbers["height"]),
        mie_g=jnp.asarray(numbers["g"]),
        ozone_absorption=spectrum.ozone_absorption(jnp.asarray(nodes), column_du=numbers["ozone"]),
        ground_albedo=jnp.full(len(nodes), numbers["albedo"]),
    )


def colours(truth: dict[str, float], camera: Camera, towards: np.ndarray) -> np.ndarray:
    """Linear sRGB of the picture, by the sum over the fine wavelengths."""
    air = sky(truth, FINE)
    at, matching = color.observer()
    sensitivity = np.stack([np.interp(FINE, at, curve) for curve in (matching @ color.XYZ_TO_SRGB.T).T])
    from diffatmo import spectrum

    weights = sensitivity * np.asarray(spectrum.solar_irradiance(jnp.asarray(FINE)))
    weights /= weights.sum(axis=1, keepdims=True)
    spectra = np.asarray(outermost(render)(Scene(air, camera, photo.EYE_LEVEL_KM, towards), Moments()))
    return spectra @ weights.T


def case(number: int) -> dict:
    """One photo: what it is and what its fit says."""
    rng = np.random.default_rng([7, number])
    kind, truth = KINDS[number % len(KINDS)], drawn(rng)
    zenith = float(rng.uniform(25, 80))
    towards = np.asarray(sun.direction(zenith=np.radians(zenith), azimuth=np.radians(200.0)))
    said: dict = {"sun_zenith_deg": zenith, "sun_azimuth_deg": 200.0}
    exif, saturation, encoded = Exif(), None, False
    if kind == "jpeg":
        camera: Camera = Pinhole(
            144, 192, fov_y=np.radians(50.0), yaw=np.radians(rng.uniform(0, 360)), pitch=np.radians(30.0)
        )
    elif kind == "fisheye":
        camera = Fisheye(160, 160, fov=np.radians(180.0), pitch=np.radians(90.0))
    else:
        camera = Equirectangular(96, 192)
    light = colours(truth, camera, towards) * np.exp(rng.normal(0, 0.3, 3))
    if kind == "clouds":
        above = light[: light.shape[0] // 2]
        light[: light.shape[0] // 2], _ = cloudy(above.astype(np.float32), number)
    noisy = light * (1 + NOISE * rng.standard_normal(light.shape))
    if kind == "clipped":
        near = np.asarray(camera.directions()) @ towards > np.cos(np.radians(4.0))
        noisy[near] = noisy[~near].max()
    if kind == "jpeg":
        rows, columns = np.indices(light.shape[:2])
        radius = np.hypot(2 * rows + 1 - 144, 2 * columns + 1 - 192) / np.hypot(144, 192)
        noisy *= np.exp(rng.normal(-0.3, 0.15) * radius**2)[..., None]
        relative = np.clip(noisy / np.quantile(noisy, 0.995), 1e-4, 1)
        logarithm = np.log(relative)
        curved = relative * np.exp(rng.normal(0, 0.1) * logarithm + rng.normal(0, 0.05) * logarithm**2 / 3)
        codes = np.round(BITS * np.asarray(color.srgb_encode(jnp.asarray(np.clip(curved, 0, 1))))) / BITS
        noisy = np.asarray(color.srgb_decode(jnp.asarray(codes)))
        saturation, encoded = 1.0, True
        yaw = (np.degrees(float(camera.yaw)) + rng.normal(0, 8)) % 360
        exif = Exif(make="simulated", compass_deg=yaw, time=datetime(2024, 6, 1, 12, tzinfo=UTC), **WHERE)
        said |= {
            "projection": "pinhole",
            "fov_deg": 50.0 * float(np.exp(rng.normal(0, 0.03))),
            "pitch_deg": 30.0 + rng.normal(0, 2),
        }
        said |= {"focal": "free", "heading_error_deg": photo.HEADING_ERROR_DEG, "yaw_deg": yaw}
    if kind == "fisheye":
        said |= {"projection": "fisheye", "fov_deg": 180.0, "pitch_deg": 88.0, "pose": "free"}
    image = Image(noisy.astype(np.float32), {}, None, exif, saturation=saturation)
    opened = images.Opened(ImageSpec(Path(f"{kind}_{number}"), said), image, None, encoded)
    observation = images.observe_photo(opened, "photo").observation
    pressure, pressure_error = photo.pressure(None)
    init = photo.start(pressure)
    parameters = select(init, photo.FREE, photo.TIE)
    known = priors.typical(parameters, pressure_error=pressure_error)
    result = fitting.fit(
        [observation], init=init, free=photo.FREE, tie=photo.TIE, priors=known, loss=photo.LOSS,
        model=fitting_model("moments", photos=True), refine=False,
    ).with_truth(sky(truth, bands.NODES))  # fmt: skip
    pulls = {e.name: e.pull for e in result.parameters if e.name in JUDGED and e.pull is not None}
    shares = {e.name: e.data_share for e in result.parameters if e.name in JUDGED}
    return {
        "number": number, "kind": kind, "sun": zenith, "depth": truth["depth"], "converged": result.converged,
        "chi2": result.reduced_chi2, "steps": result.iterations, "seconds": result.timings["total_s"],
        "used": int(observation.used.sum()), "pulls": pulls, "shares": shares,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--json", type=Path, help="a file for the numbers")
    asked = parser.parse_args()
    found = []
    for number in range(asked.first, asked.first + asked.count):
        found.append(case(number))
        print({key: value for key, value in found[-1].items() if key != "shares"}, flush=True)
        if asked.json:
            asked.json.write_text(json.dumps(found))
    table = Table(
        "number", "within 1 s.e.", "within 2 s.e.", "largest pull", "by the photo, median", title=f"{len(found)} photos"
    )
    every = np.concatenate([[one["pulls"].get(name, np.nan) for one in found] for name in JUDGED])
    for name in JUDGED:
        pulls = np.abs([one["pulls"].get(name, np.nan) for one in found])
        share = np.median([one["shares"].get(name) or 0 for one in found])
        # A number without an error bar is not within any.
        row = [f"{np.mean(pulls < limit):.0%}" for limit in (1, 2)]
        table.add_row(name, *row, f"{np.nanmax(pulls):.1f}", f"{share:.0%}")
    table.add_row(
        "all", *(f"{np.mean(np.abs(every) < limit):.0%}" for limit in (1, 2)), f"{np.nanmax(np.abs(every)):.1f}", ""
    )
    Console(width=110).print(table)
    whole = np.mean([max(map(abs, one["pulls"].values())) < 2 for one in found])
    print(f"photos with every number within 2 s.e.: {whole:.0%}; converged: {sum(one['converged'] for one in found)}")


if __name__ == "__main__":
    main()
