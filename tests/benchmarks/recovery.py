"""How well are atmospheres recovered that are nothing like the start? Twelve random ones, path-traced, each fitted blindly.

python tests/benchmarks/recovery.py [known] [unknown] [one] [--count 12] [--samples 2048] [--trace]

Eleven skies of Earth and one of another planet, each seen under the four suns of the shipped set, with 1 % noise and that of
the paths, which at 2048 is 1 to 2 %. All are fitted from the preset ``earth()``, on the other planet with its radii, and with
the ties that a user would choose who does not know the truth. ``known``: exposures are known. ``unknown``: every picture has an
exposure of its own and all share an unknown white balance. ``one``: only the picture with the sun at 65°, which cannot tell
everything; its error bars have to say so.

Of a spectral number the tables of single fits show the band that is farthest off; medians and shares are those of all
bands. The pictures take half an hour of two cores; they are kept in a folder of the system's temporary files, and ``--trace``
makes no more than them.
"""

import argparse
import math
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.ndimage import uniform_filter

import diffatmo
import fitting
from diffatmo import spectrum
from diffatmo.atmosphere import SPECTRAL
from diffatmo.camera import Equirectangular

sys.path.insert(0, str(Path(__file__).parents[2] / "data_synthetic"))
import generate

SEED, OTHER_PLANET = 12, 5
CAMERA = Equirectangular(height=24, width=48, upper=True)
NOISE = 0.01
NEIGHBOURS = (5, 9)
"""Pixels around one, along its column and its row, that tell the error of its Monte Carlo."""
TIE = {"mie": "angstrom", "ozone_absorption": "dobson"}
MODES, ONE = ("known", "unknown", "one"), (65.0,)
ASKED = {
    "rayleigh_optical_depth": 0.003,
    "mie_optical_depth": 0.01,
    "rayleigh_scale_height": 0.01,
    "mie_scale_height": 0.02,
    "mie_g": 0.005,
    "ozone_absorption": 0.03,
    "ground_albedo": 0.05,
}
"""The median error that is asked for: relative, but of g as it is."""
NAMES = dict(zip(ASKED, ("τ_R, %", "τ_M, %", "H_R, %", "H_M, %", "g", "ozone, %", "albedo, %"), strict=True))
SILENT = 5.0
"""A pull that no error bar explains."""


def atmospheres(count: int) -> list[diffatmo.Atmosphere]:
    """Random ones; the one at :data:`OTHER_PLANET` is smaller and higher."""
    rng, start, found = np.random.default_rng(SEED), diffatmo.earth(), []
    for number in range(count):
        bands = start.wavelengths
        aerosol_height = rng.uniform(0.6, 3.0)
        scattering, absorption = spectrum.angstrom_aerosol(
            bands,
            optical_depth_550=float(np.exp(rng.uniform(np.log(0.02), np.log(0.5)))),
            exponent=rng.uniform(0.0, 2.0),
            single_scattering_albedo=rng.uniform(0.85, 0.98),
            scale_height=aerosol_height,
        )
        values = {
            "rayleigh_scattering": start.rayleigh_scattering * rng.uniform(0.95, 1.05, 3),
            "rayleigh_scale_height": rng.uniform(7.2, 8.8),
            "mie_scattering": scattering,
            "mie_absorption": absorption,
            "mie_scale_height": aerosol_height,
            "mie_g": rng.uniform(0.55, 0.85),
            "ozone_absorption": spectrum.ozone_absorption(bands, column_du=rng.uniform(200.0, 450.0)),
            "ground_albedo": rng.uniform(0.05, 0.6, 3),
        }
        if number == OTHER_PLANET:
            # The same columns of air and aerosol, one and a half times as high.
            for height, coefficients in (
                ("rayleigh_scale_height", ["rayleigh_scattering"]),
                ("mie_scale_height", ["mie_scattering", "mie_absorption"]),
            ):
                values |= {height: 1.5 * values[height]} | {name: values[name] / 1.5 for name in coefficients}
            values |= {"bottom_radius": 3400.0, "top_radius": 3520.0}
        names = list(values)
        arrays = [np.asarray(values[name], np.float32) for name in names]
        found.append(eqx.tree_at(lambda a, names=names: [getattr(a, n) for n in names], start, arrays))
    return found


def traced(truth: diffatmo.Atmosphere, number: int, zenith_deg: float, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """A picture of atmosphere ``number`` and the relative standard error of its pixels, made or found.

    The channels of one trace come from the same paths, and their errors are alike, which no fit expects: every channel is
    traced on its own. A pixel's error estimated from its own paths is large where the value is, so that weights would pull
    down: it is the root mean square of those around it.
    """
    means, errors = [], []
    for channel in range(truth.wavelengths.size):
        file = (
            Path(tempfile.gettempdir())
            / "diffatmo-recovery"
            / f"{SEED}_{number}_{zenith_deg:g}_{channel}_{CAMERA.height}_{samples}.npz"
        )
        if not file.exists():
            file.parent.mkdir(exist_ok=True)
            one = eqx.tree_at(
                lambda a: [getattr(a, name) for name in SPECTRAL],
                truth,
                [getattr(truth, name)[channel : channel + 1] for name in SPECTRAL],
            )
            seed = round(1000 * number + 10 * zenith_deg + channel)
            mean, error = generate.trace(one, zenith_deg, seed, samples, CAMERA)
            with file.with_suffix(".part").open("wb") as part:
                np.savez(part, mean=mean.astype(np.float32), error=error.astype(np.float32))
            file.with_suffix(".part").rename(file)
        with np.load(file) as kept:
            means.append(kept["mean"].astype(float))
            errors.append(kept["error"].astype(float))
    mean, error = (np.concatenate(part, axis=-1) for part in (means, errors))
    return mean, np.sqrt(uniform_filter((error / mean) ** 2, size=(*NEIGHBOURS, 1), mode="nearest"))


def blind_start(truth: diffatmo.Atmosphere) -> diffatmo.Atmosphere:
    """``earth()``, on a planet of the size of the true one."""
    radii = lambda a: (a.bottom_radius, a.top_radius)
    return eqx.tree_at(radii, diffatmo.earth(), radii(truth))


def exposed(mode: str, rng: np.random.Generator) -> tuple[np.ndarray, dict[str, str]]:
    """What a picture of ``mode`` is multiplied by, but for the white balance, and what the fit is told."""
    if mode == "unknown":
        return np.exp(rng.uniform(-0.7, 0.7)), {"exposure": "free", "white_balance": "camera"}
    return np.ones(()), {}


def recover(truth: diffatmo.Atmosphere, number: int, mode: str, samples: int) -> fitting.FitResult:
    """Photograph the atmosphere and fit it."""
    rng = np.random.default_rng([SEED, number])
    balance = np.exp(rng.uniform(-0.4, 0.4, 3)) if mode == "unknown" else np.ones(3)
    balance /= balance[1]
    observations = []
    for zenith_deg in ONE if mode == "one" else generate.SUN_ZENITH_DEG:
        mean, error = traced(truth, number, zenith_deg, samples)
        factor, settings = exposed(mode, rng)
        observations.append(
            fitting.observe(
                factor * balance * mean * (1 + NOISE * rng.standard_normal(mean.shape)),
                camera=CAMERA,
                altitude=generate.ALTITUDE_KM,
                sun=generate.towards(zenith_deg),
                noise=np.hypot(NOISE, error),
                name=f"{zenith_deg:g}°",
                **settings,
            )
        )
    return fitting.fit(observations, init=blind_start(truth), free=generate.FREE, tie=TIE).with_truth(truth)


class Error(NamedTuple):
    """How far one number is off, and its error bar: relative, or, of g, as it is. NaN without an error bar."""

    off: float
    bar: float

    @property
    def pull(self) -> float:
        return self.off / self.bar


def errors(result: fitting.FitResult) -> dict[str, list[Error]]:
    """Those of every band of each number that is asked for."""
    found: dict[str, list[Error]] = {name: [] for name in ASKED}
    for estimate in result.parameters:
        if estimate.field in found:
            unit = 1.0 if estimate.field == "mie_g" else estimate.truth
            bar = math.nan if estimate.standard_error is None else estimate.standard_error
            found[estimate.field].append(Error((estimate.value - estimate.truth) / unit, bar / unit))
    # One factor for all bands is one number.
    return found | {"ozone_absorption": found["ozone_absorption"][:1]}


def shown(name: str, value: float) -> str:
    return f"{value:.4f}" if name == "mie_g" else f"{100 * value:.2f}"


def run(console: Console, mode: str, truths: list[diffatmo.Atmosphere], samples: int) -> None:
    single = Table(
        "atmosphere",
        "τ_M 550",
        "noise, %",
        "converged",
        "χ²",
        "steps",
        "s",
        *NAMES.values(),
        title=f"{mode}: error (pull)",
    )
    every: list[dict[str, list[Error]]] = []
    silent = []
    for number, truth in enumerate(truths):
        result = recover(truth, number, mode, samples)
        off, noise = errors(result), [float(np.median(observation.noise)) for observation in result.observations]
        every.append(off)
        worst = {name: max(bands, key=lambda e: abs(e.off)) for name, bands in off.items()}
        pulls = [e.pull for bands in off.values() for e in bands]
        if result.converged and np.nanmax(np.abs(pulls)) > SILENT:
            silent.append(str(number))
        row = [
            f"{number}{' (other planet)' if number == OTHER_PLANET else ''}",
            f"{float(truth.mie_optical_depth[1]):.3f}",
            "–".join(f"{100 * limit:.1f}" for limit in (min(noise), max(noise))),
            "yes" if result.converged else "NO",
            f"{result.reduced_chi2:.3f}",
            str(result.iterations),
            f"{result.timings['solve_s']:.0f}",
            *(f"{shown(name, e.off)} ({e.pull:+.1f})" for name, e in worst.items()),
        ]
        single.add_row(*row)
        print(mode, *row, result.message, sep=" | ", flush=True)
    console.print(single)
    table = Table(
        "number", "median error", "asked", "median error bar", "within 1 s.e.", "within 2 s.e.", "largest pull", "no bar",
        title=f"{mode}: of {len(truths)} atmospheres",
    )  # fmt: skip
    pulls = {name: np.array([e.pull for off in every for e in off[name]]) for name in ASKED}
    for name, asked in ASKED.items():
        bands = [e for off in every for e in off[name]]
        table.add_row(
            NAMES[name],
            shown(name, float(np.median([abs(e.off) for e in bands]))),
            shown(name, asked),
            shown(name, float(np.nanmedian([e.bar for e in bands]))),
            *within(pulls[name]),
        )
    table.add_row("all", "", "", "", *within(np.concatenate(list(pulls.values()))))
    console.print(table)
    print(
        f"{mode}: failed silently (converged, and a pull beyond {SILENT:g}): {', '.join(silent) or 'none'}", flush=True
    )


def within(pulls: np.ndarray) -> list[str]:
    """Shares of the pulls within one and two standard errors, the largest, and how many there are not."""
    known = np.abs(pulls[np.isfinite(pulls)])
    shares = [f"{np.mean(known < limit):.0%}" for limit in (1, 2)]
    return [*shares, f"{known.max():.1f}", str(pulls.size - known.size)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modes", nargs="*", help=f"of {', '.join(MODES)}; all by default")
    parser.add_argument("--count", type=int, default=12, help="of atmospheres")
    parser.add_argument("--samples", type=int, default=2048, help="paths of a pixel")
    parser.add_argument("--trace", action="store_true", help="make the pictures and end")
    asked = parser.parse_args()
    if unknown := set(asked.modes) - set(MODES):
        parser.error(f"unknown mode: {', '.join(unknown)}")
    truths = atmospheres(asked.count)
    for number, zenith_deg in track([(n, z) for n in range(asked.count) for z in generate.SUN_ZENITH_DEG], "paths"):
        traced(truths[number], number, zenith_deg, asked.samples)
    if not asked.trace:
        for mode in asked.modes or MODES:
            run(Console(width=200), mode, truths, asked.samples)


if __name__ == "__main__":
    main()
