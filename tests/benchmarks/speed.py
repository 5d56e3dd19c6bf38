"""Time the default model and a joint fit on this machine.

python tests/benchmarks/speed.py
"""

import platform
import statistics
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

import diffatmo
from diffatmo import sun

NAMES = ("rayleigh_scattering", "rayleigh_scale_height", "mie_scattering", "mie_scale_height", "mie_g", "ozone_absorption",
         "ground_albedo")  # fmt: skip


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


def main() -> None:
    model, air = diffatmo.Moments(), diffatmo.earth()
    shell = model.shell(bottom_radius=air.bottom_radius, top_altitude=air.top_altitude)
    towards = sun.direction(zenith=jnp.radians(60.0), azimuth=0.0)

    def image(x, shell, view):
        fields = tuple(getattr(air, name) * (1 + x[i]) for i, name in enumerate(NAMES))
        changed = eqx.tree_at(lambda a: tuple(getattr(a, name) for name in NAMES), air, fields)
        return model.sky(changed, shell).view(altitude=0.1, sun=towards).radiance(view=view).radiance

    upper = diffatmo.Equirectangular(64, 128, upper=True).directions()
    full = diffatmo.Equirectangular(128, 256).directions()
    x = jnp.zeros(len(NAMES))
    table = Table("what", "first call, s", "median, ms", "least, ms", title=f"{processor()}, jax {jax.__version__}")
    for what, function, arguments in (
        ("parameters → 128×64 upper sky", jax.jit(image), (x, shell, upper)),
        ("parameters → 256×128 full sphere", jax.jit(image), (x, shell, full)),
        ("Jacobian of 128×64 in 9 parameters (7 tangents)", jax.jit(jax.jacfwd(image)), (x, shell, upper)),
    ):
        first, median, least = timed(function, *arguments)
        table.add_row(what, f"{first:.1f}", f"{1e3 * median:.0f}", f"{1e3 * least:.0f}")
    Console().print(table)


if __name__ == "__main__":
    main()
