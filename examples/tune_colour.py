"""Design a sky: change the air by gradient until zenith and horizon have the colours that were asked for.

python examples/tune_colour.py teal_and_rose.png
"""

import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import diffatmo
from diffatmo import color, imageio, render, sun

WANTED = {  # linear red, green, blue
    "zenith": (0.02, 0.08, 0.08),
    "horizon": (0.34, 0.28, 0.28),
}
VIEW_ZENITH_DEG = (0.0, 88.0)
TUNED = ("rayleigh_scattering", "mie_absorption")
RELUCTANCE = 0.02
"""How much a change of a coefficient by a factor e counts, next to a colour that is wrong by a factor e."""

STEPS = 12

ALTITUDE, EXPOSURE = 0.1, 5.0
SUN_ZENITH_DEG, SUN_AZIMUTH_DEG = 70.0, 40.0


def tuned(air: diffatmo.Atmosphere, logs: jax.Array) -> diffatmo.Atmosphere:
    """The air with other coefficients, given by their logarithms, so that they stay positive."""
    return replace(air, **{name: jnp.exp(row) for name, row in zip(TUNED, logs, strict=True)})


@jax.jit
def colours(
    logs: jax.Array, air: diffatmo.Atmosphere, view: jax.Array, towards: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Logarithms of the colours seen, and their derivatives by those of the coefficients: one forward pass for both."""

    def seen(logs: jax.Array) -> tuple[jax.Array, jax.Array]:
        sky = diffatmo.Moments().sky(tuned(air, logs))
        value = jnp.log(EXPOSURE * sky.radiance(altitude=ALTITUDE, view=view, sun=towards).radiance)
        return value, value

    slope, value = jax.jacfwd(seen, has_aux=True)(logs)
    return value, slope


def main(output: str = "teal_and_rose.png", size: str = "256") -> float:
    haze = replace(diffatmo.earth(), mie_absorption=jnp.full(3, 4e-3))
    view = jnp.stack([sun.direction(zenith=np.radians(angle), azimuth=0.0) for angle in VIEW_ZENITH_DEG])
    towards = sun.direction(zenith=np.radians(SUN_ZENITH_DEG), azimuth=np.radians(SUN_AZIMUTH_DEG))
    wanted = np.log(np.array(list(WANTED.values())))
    start = np.log(np.stack([getattr(haze, name) for name in TUNED]))
    logs = start
    for _ in range(STEPS):
        # Gauss-Newton: the change that brings the colours where they should be, were they linear in the logarithms.
        value, slope = (np.asarray(x) for x in colours(jnp.asarray(logs, jnp.float32), haze, view, towards))
        lines = np.concatenate([slope.reshape(wanted.size, -1), RELUCTANCE * np.eye(logs.size)])
        error = np.concatenate([(value - wanted).ravel(), RELUCTANCE * (logs - start).ravel()])
        change = np.linalg.lstsq(lines, error, rcond=None)[0].reshape(logs.shape)
        logs = logs - change / max(1, np.abs(change).max())
    air = tuned(haze, jnp.asarray(logs, jnp.float32))
    found = value - wanted
    for name, asked, error in zip(WANTED, np.exp(wanted), found, strict=True):
        print(f"{name:8} asked for {np.round(asked, 3)}, got {np.round(asked * np.exp(error), 3)}")
    print(diffatmo.atmosphere.dumps(air))
    camera = diffatmo.Pinhole(int(size) * 2 // 3, int(size), fov_y=np.radians(95.0), pitch=np.radians(45.0))
    radiance = render.render(diffatmo.Scene(air, camera, ALTITUDE, towards, EXPOSURE))
    imageio.write_png(output, np.asarray(color.display(radiance, wavelengths=air.wavelengths)), overwrite=True)
    print(f"wrote {output}")
    return float(np.abs(found).max())


if __name__ == "__main__":
    main(*sys.argv[1:])
