"""Do intervals hold the truth as often as they say? Many fits of images that the default model itself has made.

python tests/benchmarks/coverage.py [FITS] [NAME ...]    (256 of clear by default; hazy is the other)

This is about the statistics, not the physics, so the model makes the images and fits them, without a finer one at the end.
Each fit sees three small skies with fresh noise of 1 %, the second with an unknown exposure, and starts somewhere else, every
number some 5 % off: where the search starts does not matter to where it ends, only to how long it takes. An interval of 68.3 %
is one standard error to either side of a number, one of 95 % is 1.96.
"""

import sys
import time
from pathlib import Path
from statistics import NormalDist

import equinox as eqx
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import fitting
from diffatmo.camera import Equirectangular
from diffatmo.compiling import outermost
from diffatmo.models import Moments
from diffatmo.render import Scene, render
from fitting.findings import NINETY_FIVE, ONE_SIGMA

sys.path.insert(0, str(Path(__file__).parents[2] / "data_synthetic"))
import generate

HEIGHT, WIDTH = 12, 24
SUNS = {40.0: "fixed", 75.0: "free", 92.0: "fixed"}
"""Zenith angle in degrees and what is known of the exposure."""
NOISE, OFF = 0.01, 0.05


def skies(truth) -> list[np.ndarray]:
    """The pictures without noise."""
    camera = Equirectangular(height=HEIGHT, width=WIDTH, upper=True)
    scenes = [Scene(truth, camera, generate.ALTITUDE_KM, generate.towards(zenith_deg)) for zenith_deg in SUNS]
    return [np.asarray(outermost(render)(scene, Moments()), dtype=float) for scene in scenes]


def realisation(clean: list[np.ndarray], truth, seed: int) -> fitting.FitResult:
    """Fit the pictures with fresh noise."""
    rng = np.random.default_rng(seed)
    observations = [
        fitting.observe(
            light * (1 + NOISE * rng.standard_normal(light.shape)),
            camera=Equirectangular(height=HEIGHT, width=WIDTH, upper=True),
            altitude=generate.ALTITUDE_KM,
            sun=generate.towards(zenith_deg),
            noise=NOISE,
            exposure=exposure,
            name=f"{zenith_deg:g}°",
        )
        for light, (zenith_deg, exposure) in zip(clean, SUNS.items(), strict=True)
    ]
    values = [getattr(truth, name) * np.float32(np.exp(OFF * rng.standard_normal())) for name in generate.FREE]
    start = eqx.tree_at(lambda a: [getattr(a, name) for name in generate.FREE], truth, values)
    return fitting.fit(observations, init=start, free=generate.FREE, tie=generate.TIE, refine=False).with_truth(truth)


def pulls(result: fitting.FitResult) -> dict[str, float]:
    """(value - truth) / standard error of every number; the true exposure is 1. Tied bands are one number."""
    found: dict[str, float] = {}
    once = set(generate.TIE) | {"mie_optical_depth", "mie_single_scattering_albedo"}
    seen: set[str] = set()
    for estimate in result.parameters:
        if not (estimate.field in once and estimate.field in seen):
            found[estimate.name] = np.nan if estimate.pull is None else estimate.pull
        seen.add(estimate.field)
    for estimate in result.nuisances:
        error = estimate.standard_error
        found[estimate.name] = np.nan if error is None else (estimate.value - 1) / error
    return found


def share(inside: np.ndarray, expected: float) -> str:
    """The share of ``inside``, and its binomial error."""
    return f"{100 * inside.mean():.1f} ± {100 * np.sqrt(expected * (1 - expected) / inside.size):.1f}"


def main(count: int, names: list[str]) -> None:
    limits = {level: NormalDist().inv_cdf((1 + level) / 2) for level in (ONE_SIGMA, NINETY_FIVE)}
    for name in names:
        truth, started = generate.ATMOSPHERES[name], time.perf_counter()
        clean = skies(truth)
        results = [realisation(clean, truth, seed) for seed in track(range(count), f"{name}: fits")]
        every = [pulls(result) for result in results]
        converged = sum(result.converged for result in results)
        table = Table(
            "number", "mean pull", "its scatter", *(f"within {z:.2f} s.e. ({100 * p:g} %)" for p, z in limits.items()),
            title=f"{name}: {count} fits, {converged} converged, χ² {np.mean([r.reduced_chi2 for r in results]):.3f}, "
            f"{time.perf_counter() - started:.0f} s",
        )  # fmt: skip
        columns = {number: np.array([one[number] for one in every]) for number in every[0]}
        for number, values in columns.items():
            table.add_row(
                number,
                f"{values.mean():+.2f} ± {1 / np.sqrt(count):.2f}",
                f"{values.std(ddof=1):.2f} ± {1 / np.sqrt(2 * count):.2f}",
                *(share(np.abs(values) < z, p) for p, z in limits.items()),
            )
        # Numbers of one fit are correlated: the binomial error of the total is the least that it can be.
        total = np.concatenate(list(columns.values()))
        table.add_row("all", "", "", *(share(np.abs(total) < z, p) for p, z in limits.items()))
        Console(width=120).print(table)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 256, sys.argv[2:] or ["clear"])
