"""Hold the default model, and the finer one that ends a fit, against the path tracer.

python tests/benchmarks/accuracy.py [PATHS]

With the default 131072 paths a ray the path tracer's own standard error is about 0.05 %; on two cores that takes an hour.
"""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import diffatmo
from diffatmo import sun

S1 = diffatmo.Atmosphere(
    wavelengths=[680.0, 550.0, 440.0],
    solar_irradiance=[1.0, 1.0, 1.0],
    bottom_radius=6360.0,
    top_radius=6460.0,
    rayleigh_scattering=[5.802e-3, 13.558e-3, 33.1e-3],
    rayleigh_scale_height=8.0,
    mie_scattering=[3.996e-3] * 3,
    mie_absorption=[0.444e-3] * 3,
    mie_scale_height=1.2,
    mie_g=0.8,
    ozone_absorption=[0.0, 0.0, 0.0],
    ground_albedo=[0.3, 0.3, 0.3],
)


def change(atmosphere, **values):
    """``atmosphere`` with other values, spread over wavelengths."""
    names = list(values)
    new = [jnp.broadcast_to(jnp.asarray(values[n], jnp.float32), getattr(atmosphere, n).shape) for n in names]
    return eqx.tree_at(lambda a: [getattr(a, n) for n in names], atmosphere, new)


def hazier(factor, **values):
    return change(S1, mie_scattering=factor * S1.mie_scattering, mie_absorption=factor * S1.mie_absorption, **values)


HAZE = change(S1, mie_scattering=0.13, mie_absorption=0.013, mie_scale_height=2.2, mie_g=0.66,
              ozone_absorption=jnp.array([0.85e-3, 2.45e-3, 0.11e-3]))  # fmt: skip
SMALL = change(S1, bottom_radius=1000.0, top_radius=1060.0, rayleigh_scale_height=5.0)
CASES = [  # name, atmosphere, sun zenith in degrees, altitude in km
    *[("S1", S1, zenith, 0.5) for zenith in (20, 60, 85, 92, 95)],
    ("S1, aerosol × 0.1", hazier(0.1), 20, 0.5),
    *[("S1, aerosol × 5", hazier(5), zenith, 0.5) for zenith in (60, 85)],
    *[("S1, aerosol × 10", hazier(10), zenith, 0.5) for zenith in (40, 75, 92)],
    ("S1, aerosol × 10, g = 0.9", hazier(10, mie_g=0.9), 40, 0.5),
    ("S1, aerosol × 10, g = 0.6", hazier(10, mie_g=0.6), 75, 0.5),
    *[("optical depth 0.31, ozone", HAZE, zenith, 0.1) for zenith in (35, 65, 82, 93)],
    ("S1", S1, 60, 10.0),
    ("S1", S1, 60, 300.0),
    ("radius 1000 km", SMALL, 60, 0.5),
    ("Mars", diffatmo.mars(), 60, 0.5),
]


def directions() -> np.ndarray:
    """Sky, within 2° of the horizon, and down: 90 of them, the first 66 upwards; azimuth relative to the sun's."""
    zenith, azimuth = np.meshgrid([3, 15, 30, 45, 55, 65, 75, 82, 87, 88.5, 89.5], [5, 40, 75, 110, 145, 180])
    below, around = np.meshgrid([90.5, 91.5, 95, 110, 130, 165], [20, 90, 150, 240])
    at = np.radians(np.stack([np.append(zenith, below), np.append(azimuth, around)]))
    return np.asarray(sun.direction(zenith=at[0], azimuth=at[1]))


@eqx.filter_jit
def viewed(model, atmosphere, altitude, view, towards):
    return model.sky(atmosphere).view(altitude=altitude, sun=towards).radiance(view=view).radiance


def main(paths: int) -> None:
    view = jnp.asarray(directions(), jnp.float32)
    table = Table("sky", "sun", "altitude", "Monte Carlo", title="RMS (largest) relative difference to Monte Carlo, %")
    for model in ("moments", "finer"):
        for part in ("sky", "down"):
            table.add_column(f"{model}, {part}")
    for name, atmosphere, zenith, altitude in CASES:
        towards = jnp.asarray(sun.direction(zenith=np.radians(zenith), azimuth=0.0), jnp.float32)
        at = jnp.asarray(altitude, jnp.float32)
        truth, error, _ = (
            diffatmo.PathTrace(samples=paths)
            .sky(atmosphere)
            .radiance_with_error(altitude=at, view=view, sun=towards)
        )  # fmt: skip
        seen = np.asarray(truth).min(axis=-1) > 0
        away = np.asarray(view @ towards) < np.cos(np.radians(3.0))
        up = np.asarray(view[:, 2]) > 0
        noise = np.sqrt(np.mean((np.asarray(error) / np.where(seen[:, None], truth, 1))[seen] ** 2))
        row = [name, f"{zenith}°", f"{altitude:g} km", f"{100 * noise:.2f}"]
        for model in (diffatmo.Moments(), diffatmo.Moments().finer()):
            got = np.asarray(jax.block_until_ready(viewed(model, atmosphere, at, view, towards)))
            for part in (up, ~up):
                chosen = part & seen & away
                off = 100 * (got[chosen] / np.asarray(truth)[chosen] - 1)
                row.append(f"{np.sqrt(np.mean(off**2)):.2f} ({np.abs(off).max():.1f})" if chosen.any() else "-")
        table.add_row(*row)
        print(*row, sep=" | ", flush=True)
    Console(width=140).print(table)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 131072)
