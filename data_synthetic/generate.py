"""Make the images that ship with diffatmo: skies of known atmospheres, rendered by the path tracer, with camera noise.

    python data_synthetic/generate.py [DIRECTORY]

Two atmospheres, each under four suns from high noon to twilight. The model that fits the images (``moments``) takes no part
in making them. Every picture is the Monte Carlo mean plus the noise of a linear sensor: photon noise of ``ELECTRONS``
electrons at the mean radiance, and ``READ`` electrons of read noise. The standard error of the Monte Carlo itself is written
beside it; scene.toml states the sum, as the fit needs it.
"""

import sys
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from diffatmo import atmosphere, scene, sun
from diffatmo._types import Direction
from diffatmo.camera import Equirectangular
from diffatmo.models import PathTrace
from diffatmo.render import Scene

HEIGHT, WIDTH = 48, 96
ALTITUDE_KM = 0.1
SUN_ZENITH_DEG = (35.0, 65.0, 82.0, 93.0)
SAMPLES = 4096
ELECTRONS = 400.0
"""At the mean of a picture: photon noise of 5 %."""
READ = 4.0
"""Electrons, standard deviation."""
FREE = (
    "rayleigh_scattering",
    "rayleigh_scale_height",
    "mie_scattering",
    "mie_absorption",
    "mie_scale_height",
    "mie_g",
    "ozone_absorption",
    "ground_albedo",
)
TIE = dict.fromkeys(("mie_scattering", "mie_absorption", "ozone_absorption"), "start")
OFF = 1.3
"""The start is off by this factor: optical depths, products of a coefficient and a height, by its square."""
TOO_HIGH = ("rayleigh_scattering", "rayleigh_scale_height", "mie_absorption", "ozone_absorption")

ATMOSPHERES = {
    "clear": atmosphere.Atmosphere(
        wavelengths=[680.0, 550.0, 440.0],
        solar_irradiance=[1.0, 1.0, 1.0],
        bottom_radius=6360.0,
        top_radius=6460.0,
        rayleigh_scattering=[5.2e-3, 12.4e-3, 31.0e-3],
        rayleigh_scale_height=8.3,
        mie_scattering=[0.072] * 3,
        mie_absorption=[0.006] * 3,
        mie_scale_height=1.5,
        mie_g=0.74,
        ozone_absorption=[0.65e-3, 1.881e-3, 0.085e-3],
        ground_albedo=[0.12, 0.18, 0.08],
    ),
    "hazy": atmosphere.Atmosphere(
        wavelengths=[680.0, 550.0, 440.0],
        solar_irradiance=[1.0, 1.0, 1.0],
        bottom_radius=6360.0,
        top_radius=6460.0,
        rayleigh_scattering=[5.802e-3, 13.558e-3, 33.1e-3],
        rayleigh_scale_height=7.8,
        mie_scattering=[0.13] * 3,
        mie_absorption=[0.013] * 3,
        mie_scale_height=2.2,
        mie_g=0.66,
        ozone_absorption=[0.85e-3, 2.45e-3, 0.11e-3],
        ground_albedo=[0.35, 0.30, 0.24],
    ),
}


def start(truth: atmosphere.Atmosphere) -> atmosphere.Atmosphere:
    """A start with every free parameter 30 % off; the asymmetry is moved towards 0.5, which is as wrong and below 1."""
    values = {name: getattr(truth, name) * (OFF if name in TOO_HIGH else 1 / OFF) for name in FREE}
    values["mie_g"] = 0.77 * truth.mie_g
    return eqx.tree_at(lambda a: [getattr(a, name) for name in FREE], truth, [values[name] for name in FREE])


def camera() -> Equirectangular:
    """That of all pictures: the upper half of the sky."""
    return Equirectangular(height=HEIGHT, width=WIDTH, upper=True)


def towards(zenith_deg: float) -> Direction:
    """The sun of a picture."""
    return sun.direction(zenith=jnp.radians(zenith_deg), azimuth=jnp.radians(30.0))


def trace(
    truth: atmosphere.Atmosphere,
    zenith_deg: float,
    seed: int,
    samples: int = SAMPLES,
    of: Equirectangular | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error of a picture, without the noise of a sensor; by the camera of all pictures, or another."""
    sky = PathTrace(samples=samples, seed=seed).sky(truth)
    mean, error, _ = sky.radiance_with_error(
        altitude=jnp.asarray(ALTITUDE_KM), view=(of or camera()).directions(), sun=towards(zenith_deg)
    )
    return np.asarray(mean, float), np.asarray(error, float)


def expose(mean: np.ndarray, seed: int) -> tuple[np.ndarray, float]:
    """A picture as a linear sensor sees it, and its electrons per unit of radiance."""
    gain = ELECTRONS / mean.mean()
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(gain * mean) + rng.normal(0, READ, mean.shape)
    return (electrons / gain).astype(np.float32), float(gain)


def main(directory: Path) -> None:
    """Write every picture, its scene file, its truth and its start."""
    for index, (name, truth) in enumerate(ATMOSPHERES.items()):
        folder = directory / name
        folder.mkdir(parents=True, exist_ok=True)
        atmosphere.save(truth, folder / "truth.toml")
        atmosphere.save(start(truth), folder / "start.toml")
        tables = []
        for number, zenith_deg in enumerate(SUN_ZENITH_DEG):
            seed = 100 * index + number
            mean, error = trace(truth, zenith_deg, seed)
            relative = float(np.sqrt(np.mean((error / mean) ** 2)))
            image, gain = expose(mean, seed)
            file = f"sky_{zenith_deg:.0f}.exr"
            scene.save(
                folder / file,
                image,
                Scene(truth, camera(), ALTITUDE_KM, towards(zenith_deg)),
                notes={
                    "model": "pathtrace",
                    "samples": SAMPLES,
                    "seed": seed,
                    "monte_carlo_relative_standard_error": relative,
                    "electrons_per_unit": gain,
                    "read_noise_electrons": READ,
                },
                overwrite=True,
            )
            tables.append(
                f'[[image]]\nfile = "{file}"\nprojection = "equirectangular"\nupper = true\naltitude_km = {ALTITUDE_KM}\n'
                f"sun_zenith_deg = {zenith_deg}\nsun_azimuth_deg = 30.0\n"
                f'exposure = "fixed"\nnoise = {relative:.3g}\nnoise_shot = {1 / gain:.4g}\nnoise_floor = {READ / gain:.4g}\n'
                "view_zenith_max_deg = 90.0\nsun_exclusion_deg = 2.0\n"
            )
            print(f"{folder / file}: Monte Carlo standard error {100 * relative:.2f} %", flush=True)
        quoted = lambda names: ", ".join(f'"{item}"' for item in names)
        ties = ", ".join(f'{field} = "{kind}"' for field, kind in TIE.items())
        head = f'init = "start.toml"\nfree = [{quoted(FREE)}]\ntie = {{ {ties} }}\n'
        (folder / "scene.toml").write_text("\n".join([head, *tables]))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
