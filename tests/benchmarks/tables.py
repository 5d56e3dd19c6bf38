"""Time the models with tables on this machine, and the memory of their derivatives.

python tests/benchmarks/tables.py [--full-derivative]

The derivative of Bruneton's full tables in nine parameters takes minutes and gigabytes; without the flag it is left out.
"""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table
from speed import NINE, processor, timed

import diffatmo
from diffatmo import sun


def nine(model, air, towards, view):
    """The picture as a function of relative changes of nine numbers, each on its own."""
    sizes = [getattr(air, name).size for name in NINE]
    ends = [sum(sizes[: i + 1]) for i in range(len(sizes) - 1)]

    def image(x):
        parts = zip(NINE, jnp.split(x, ends), strict=True)
        fields = tuple(getattr(air, n) * (1 + part.reshape(getattr(air, n).shape)) for n, part in parts)
        changed = eqx.tree_at(lambda a: tuple(getattr(a, name) for name in NINE), air, fields)
        return model.sky(changed).view(altitude=0.1, sun=towards).radiance(view=view).radiance

    return image, jnp.zeros(sum(sizes))


def main(full_derivative: bool) -> None:
    air, towards = diffatmo.earth(), sun.direction(zenith=jnp.radians(60.0), azimuth=0.0)
    quickly = {"compiler_options": diffatmo.compiler_options()}
    picture = diffatmo.Equirectangular(128, 256).directions()
    small = diffatmo.Equirectangular(16, 32, upper=True).directions()
    bruneton, reduced, hillaire = diffatmo.Bruneton(), diffatmo.Bruneton.reduced(), diffatmo.Hillaire()

    @eqx.filter_jit(**quickly)
    def tables(model, air):
        return model.sky(air)

    @eqx.filter_jit(**quickly)
    def look(sky, view):
        return sky.view(altitude=0.1, sun=towards).radiance(view=view).radiance

    table = Table(
        "what", "first call, s", "median, ms", "least, ms", "memory, GB", title=f"{processor()}, jax {jax.__version__}"
    )
    solved = tables(hillaire, air)
    for what, function, arguments, repeats in (
        ("bruneton: tables, 32×128×32×8, 4 orders", tables, (bruneton, air), 3),
        ("bruneton: reduced tables", tables, (reduced, air), 5),
        ("hillaire: transmittance, multiple scattering", tables, (hillaire, air), 9),
        ("hillaire: sky-view table and 256×128 picture", look, (solved, picture), 9),
    ):  # fmt: skip
        first, median, least = timed(function, *arguments, repeats=repeats)
        table.add_row(what, f"{first:.1f}", f"{1e3 * median:.0f}", f"{1e3 * least:.0f}", "")
        print(what, first, median, flush=True)
    for model, what in ((reduced, "reduced"), *[(bruneton, "full")] * full_derivative):
        image, x = nine(model, air, towards, small)
        compiled = jax.jit(jax.jacfwd(image)).lower(x).compile(compiler_options=diffatmo.compiler_options())
        first, median, least = timed(compiled, x, repeats=1)
        gigabytes = compiled.memory_analysis().temp_size_in_bytes / 1e9
        row = f"bruneton, {what}: Jacobian in 9 parameters"
        table.add_row(row, f"{first:.1f}", f"{1e3 * median:.0f}", f"{1e3 * least:.0f}", f"{gigabytes:.2f}")
        print(row, first, median, gigabytes, flush=True)
    Console(width=120).print(table)


if __name__ == "__main__":
    main("--full-derivative" in sys.argv[1:])
