"""Render a clear day from noon to twilight, seen by an all-sky camera, as one picture.

python examples/render_day.py day.png
"""

import sys

import jax.numpy as jnp
import numpy as np

import diffatmo
from diffatmo import color, imageio, render, sun

SUN_ZENITH_DEG = [10, 40, 65, 80, 87, 90, 93, 96]
COLUMNS = 4
WAVELENGTHS = np.linspace(420.0, 680.0, 7)  # enough for true colours, also those that ozone makes at twilight


def main(output: str = "day.png", size: str = "192") -> None:
    air = diffatmo.earth(WAVELENGTHS)
    pictures = []
    for zenith in SUN_ZENITH_DEG:
        scene = diffatmo.Scene(
            atmosphere=air,
            camera=diffatmo.Fisheye(int(size), int(size)),
            altitude=0.1,
            sun=sun.direction(zenith=np.radians(zenith), azimuth=np.radians(180.0)),
        )
        # Compiled at the first call; the others only differ in numbers.
        radiance = render.render(scene, sun_disc=True)
        exposure = color.auto_exposure(color.to_linear_srgb(radiance, wavelengths=air.wavelengths))
        pictures.append(color.display(radiance, wavelengths=air.wavelengths, exposure=exposure))
        print(f"sun at {zenith}° from the zenith: exposure {exposure:.3g}")
    rows = [jnp.concatenate(pictures[i : i + COLUMNS], axis=1) for i in range(0, len(pictures), COLUMNS)]
    imageio.write_png(output, np.asarray(jnp.concatenate(rows)), overwrite=True)
    print(f"wrote {output}")


if __name__ == "__main__":
    main(*sys.argv[1:])
