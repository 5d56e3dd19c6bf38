"""Design a sky: change the air by gradient until zenith and horizon have the colours that were asked for.

    python examples/tune_colour.py teal_and_rose.png
"""

import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import diffatmo
from diffatmo import color, imageio, render, sun

WANTED = {  # linear red, green, blue
    "zenith": (0.02, 0.08, 0.08),
    "horizon": (0.36, 0.28, 0.28),
}
RELUCTANCE = 0.02
"""How much a change of a coefficient by a factor e counts, next to a colour that is wrong by a factor e."""
DIRECTIONS = jnp.stack([sun.direction(zenith=np.radians(angle), azimuth=0.0) for angle in (0.0, 88.0)])
SUN = sun.direction(zenith=np.radians(70.0), azimuth=np.radians(40.0))
ALTITUDE, EXPOSURE = 0.1, 5.0
TUNED = ("rayleigh_scattering", "mie_absorption")


def atmosphere(logs: dict[str, jax.Array]) -> diffatmo.Atmosphere:
    """Earth's air with other coefficients; their logarithms are free, so that they stay positive."""
    return replace(diffatmo.earth(), **{name: jnp.exp(value) for name, value in logs.items()})


def colours(logs: dict[str, jax.Array]) -> jax.Array:
    sky = diffatmo.Moments().sky(atmosphere(logs))
    return EXPOSURE * sky.radiance(altitude=jnp.asarray(ALTITUDE), view=DIRECTIONS, sun=SUN).radiance


def mismatch(logs: dict[str, jax.Array], target: tuple[jax.Array, dict[str, jax.Array]]) -> tuple:
    wanted, start = target
    return jnp.log(colours(logs) / wanted), jax.tree.map(lambda a, b: RELUCTANCE * (a - b), logs, start)


def main(output: str = "teal_and_rose.png", size: str = "256") -> float:
    wanted = jnp.array(list(WANTED.values()))
    start = {name: jnp.log(getattr(diffatmo.earth(), name)) for name in TUNED}
    solver = optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3)
    import time; t0=time.time()
    solution = optx.least_squares(mismatch, solver, start, (wanted, start), max_steps=100, throw=False)
    print(time.time()-t0, solution.stats["num_steps"], solution.result)
    found = colours(solution.value)
    for name, got, asked in zip(WANTED, found, wanted, strict=True):
        print(f"{name:8} asked for {np.round(asked, 3)}, got {np.round(got, 3)}")
    air = atmosphere(solution.value)
    print(diffatmo.atmosphere.dumps(air))
    camera = diffatmo.Pinhole(int(size) * 2 // 3, int(size), fov_y=np.radians(95.0), pitch=np.radians(45.0))
    radiance = render.render(diffatmo.Scene(air, camera, ALTITUDE, SUN, EXPOSURE))
    imageio.write_png(output, np.asarray(color.display(radiance, wavelengths=air.wavelengths)), overwrite=True)
    print(f"wrote {output}")
    return float(jnp.max(jnp.abs(jnp.log(found / wanted))))


if __name__ == "__main__":
    main(*sys.argv[1:])
