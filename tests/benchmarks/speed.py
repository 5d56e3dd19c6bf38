"""Time the default model and a joint fit on this machine.

python tests/benchmarks/speed.py
"""

import platform
import statistics
import time
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import diffatmo
import fitting
from diffatmo import render, sun

NINE = ("rayleigh_scattering", "rayleigh_scale_height", "mie_scattering", "mie_scale_height", "mie_g")
"""Fields with nine numbers in all; wavelengths share a tangent, so that there are five."""

ELEVEN = (*NINE, "ozone_absorption", "ground_albedo")
TIE = {"ozone_absorption": "start", "ground_albedo": "start"}
SUN_ZENITH_DEG = (35.0, 65.0, 82.0, 93.0)
NOISE = 0.01


def timed(function, *arguments, repeats=9):
    """Seconds of the first call and, median and least, of the next ones."""
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    first = time.perf_counter() - start
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return first, statistics.median(times), min(times)


def processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0]} × {len(names)}" if names else platform.processor()


def joint_fit(model, air):
    """Seconds of a joint fit of four 128×64 images in eleven numbers, the first and the second time, and its iterations."""
    camera = diffatmo.Equirectangular(64, 128, upper=True)
    rng = np.random.default_rng(1)
    observations = []
    for zenith in SUN_ZENITH_DEG:
        towards = sun.direction(zenith=np.radians(zenith), azimuth=0.0)
        radiance = np.asarray(render.render(diffatmo.Scene(air, camera, 0.1, towards), model.finer()))
        noisy = radiance * (1 + NOISE * rng.standard_normal(radiance.shape))
        observations.append(
            fitting.observe(noisy, camera=camera, altitude=0.1, sun=towards, noise=NOISE, name=f"{zenith:g}°")
        )
    off = {name: (0.77 if n % 3 else 1.3) * getattr(air, name) for n, name in enumerate(ELEVEN)}
    start = replace(air, **(off | {"mie_g": 0.6}))
    seconds = []
    for _ in range(2):
        before = time.perf_counter()
        result = fitting.fit(observations, init=start, free=ELEVEN, tie=TIE, model=model)
        seconds.append(time.perf_counter() - before)
    return *seconds, result


def main() -> None:
    model, air = diffatmo.Moments(), diffatmo.earth()
    towards = sun.direction(zenith=jnp.radians(60.0), azimuth=0.0)

    def image(x, view):
        fields = tuple(getattr(air, name) * (1 + x[i]) for i, name in enumerate(NINE))
        changed = eqx.tree_at(lambda a: tuple(getattr(a, name) for name in NINE), air, fields)
        return model.sky(changed).view(altitude=0.1, sun=towards).radiance(view=view).radiance

    def mean(x, view):
        return image(x, view).mean()

    quickly = {"compiler_options": diffatmo.compiler_options()}
    upper = diffatmo.Equirectangular(64, 128, upper=True).directions()
    full = diffatmo.Equirectangular(128, 256).directions()
    x = jnp.zeros(len(NINE))
    table = Table("what", "first call, s", "median, ms", "least, ms", title=f"{processor()}, jax {jax.__version__}")
    for what, function, arguments in (
        ("parameters → 128×64 upper sky", jax.jit(image), (x, upper)),
        ("the same, compiler_options()", jax.jit(image, **quickly), (x, upper)),
        ("parameters → 256×128 full sphere", jax.jit(image), (x, full)),
        ("the same, compiler_options()", jax.jit(image, **quickly), (x, full)),
        ("Jacobian of 128×64 in 9 parameters (5 tangents)", jax.jit(jax.jacfwd(image)), (x, upper)),
        ("the same, compiler_options()", jax.jit(jax.jacfwd(image), **quickly), (x, upper)),
        ("reverse mode: gradient of its mean, compiler_options()", jax.jit(jax.grad(mean), **quickly), (x, upper)),
    ):
        first, median, least = timed(function, *arguments)
        table.add_row(what, f"{first:.1f}", f"{1e3 * median:.0f}", f"{1e3 * least:.0f}")
    first, second, result = joint_fit(model, air)
    what = f"joint fit, four 128×64 images, 11 parameters, {result.iterations} steps"
    table.add_row(what, f"{first:.1f}", f"{1e3 * second:.0f}", "")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
