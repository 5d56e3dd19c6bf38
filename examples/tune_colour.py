"""Design a sky: change the air by gradient until zenith and horizon have the colours that were asked for.

python examples/tune_colour.py teal_and_rose.png
"""

import sys
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

import diffatmo
from diffatmo import color, imageio, render, sun
from diffatmo.models.moments import Shell

WANTED = {  # linear red, green, blue
    "zenith": (0.02, 0.08, 0.08),
    "horizon": (0.34, 0.28, 0.28),
}
VIEW_ZENITH_DEG = (0.0, 88.0)
TUNED = ("rayleigh_scattering", "mie_absorption")
RELUCTANCE = 0.02
"""How much a change of a coefficient by a factor e counts, next to a colour that is wrong by a factor e."""

ALTITUDE, EXPOSURE = 0.1, 5.0
SUN_ZENITH_DEG, SUN_AZIMUTH_DEG = 70.0, 40.0


class Task(NamedTuple):
    """What is given; an argument of what is compiled, because XLA would compute with constants for minutes."""

    air: diffatmo.Atmosphere
    shell: Shell
    view: jax.Array
    sun: jax.Array
    wanted: jax.Array


def tuned(logs: dict[str, jax.Array], task: Task) -> diffatmo.Atmosphere:
    """The air with other coefficients; their logarithms are free, so that they stay positive."""
    return replace(task.air, **{name: jnp.exp(value) for name, value in logs.items()})


def colours(logs: dict[str, jax.Array], task: Task) -> jax.Array:
    sky = diffatmo.Moments().sky(tuned(logs, task), task.shell)
    return EXPOSURE * sky.radiance(altitude=ALTITUDE, view=task.view, sun=task.sun).radiance


def mismatch(logs: dict[str, jax.Array], task: Task) -> tuple[jax.Array, dict[str, jax.Array]]:
    change = {name: value - jnp.log(getattr(task.air, name)) for name, value in logs.items()}
    return jnp.log(colours(logs, task) / task.wanted), jax.tree.map(lambda x: RELUCTANCE * x, change)


def main(output: str = "teal_and_rose.png", size: str = "256") -> float:
    haze = replace(diffatmo.earth(), mie_absorption=jnp.full(3, 4e-3))
    # The geometry of the planet stays what it is while the air changes.
    shell = diffatmo.Moments().shell(bottom_radius=haze.bottom_radius, top_altitude=haze.top_altitude)
    task = Task(
        air=haze,
        shell=shell,
        view=jnp.stack([sun.direction(zenith=np.radians(angle), azimuth=0.0) for angle in VIEW_ZENITH_DEG]),
        sun=sun.direction(zenith=np.radians(SUN_ZENITH_DEG), azimuth=np.radians(SUN_AZIMUTH_DEG)),
        wanted=jnp.array(list(WANTED.values())),
    )
    start = {name: jnp.log(getattr(haze, name)) for name in TUNED}
    solver = optx.LevenbergMarquardt(rtol=1e-2, atol=1e-2)
    solution = optx.least_squares(mismatch, solver, start, task, max_steps=50, throw=False)
    air = tuned(solution.value, task)
    found = mismatch(solution.value, task)[0]
    for name, asked, error in zip(WANTED, task.wanted, found, strict=True):
        print(f"{name:8} asked for {np.round(asked, 3)}, got {np.round(asked * np.exp(error), 3)}")
    print(diffatmo.atmosphere.dumps(air))
    camera = diffatmo.Pinhole(int(size) * 2 // 3, int(size), fov_y=np.radians(95.0), pitch=np.radians(45.0))
    radiance = render.render(diffatmo.Scene(air, camera, ALTITUDE, task.sun, EXPOSURE))
    imageio.write_png(output, np.asarray(color.display(radiance, wavelengths=air.wavelengths)), overwrite=True)
    print(f"wrote {output}")
    return float(jnp.max(jnp.abs(found)))


if __name__ == "__main__":
    main(*sys.argv[1:])
