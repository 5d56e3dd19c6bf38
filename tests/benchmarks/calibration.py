"""Are the error bars right? Fit the shipped skies many times, every time with fresh paths and fresh sensor noise.

python tests/benchmarks/calibration.py [REALISATIONS] [NAME ...]

Realisations that share a Monte Carlo mean share its noise, and their mean pull is then that of a few pictures, however many
they are. So every one is traced anew, with few paths, and the Monte Carlo's own noise is part of what the error bars have to
cover. A sky takes a quarter of an hour on two cores; what was traced is kept in a folder of the system's temporary files.

The channels of one trace come from the same paths, and their errors are alike, which no fit expects: every channel of a
realisation comes from another trace, and no channel of a trace is used twice. The noise of a pixel is the scatter of the
*other* traces there: an estimate from its own paths is large where the value is.

The scatter of 50 pulls is itself uncertain by 0.1, that of 100 by 0.07. What it should be is known much better, as the errors
are linear in the noise: the noise of every picture and channel, projected by the derivatives of the model at the truth onto the
parameters, gives its part of the variance, and the parts are independent. The third column is that expectation: a scatter of
one if every pixel's noise is what is stated and all of it is independent. It takes no fit.

With few paths the error bars are wider than those of the shipped pictures. The last column states the mean error in units of
those.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import diffatmo
import fitting
from fitting.parameters import select
from fitting.quantities import numbers

sys.path.insert(0, str(Path(__file__).parents[2] / "data_synthetic"))
import generate

SAMPLES = 128
"""Paths of a pixel."""
SUN_EXCLUSION = np.radians(2.0)


def traced(name: str, number: int, k: int) -> np.ndarray:
    """Trace ``k`` of a picture, made or found."""
    file = Path(tempfile.gettempdir()) / "diffatmo-calibration" / f"{name}_{number}_{k}_{SAMPLES}.npy"
    if not file.exists():
        file.parent.mkdir(exist_ok=True)
        sun, seed = generate.SUN_ZENITH_DEG[number], 5000 + 10 * k + number
        mean, _ = generate.trace(generate.ATMOSPHERES[name], sun, seed, SAMPLES)
        with file.with_suffix(".part").open("wb") as part:
            np.save(part, mean.astype(np.float32))
        file.with_suffix(".part").rename(file)
    return np.load(file).astype(float)


def realisation(traces: list[np.ndarray], truth, seed: int) -> fitting.FitResult:
    """Fit one exposure of every picture; ``traces`` of a picture have the shape (realisation, height, width, channel)."""
    observations = []
    for number, zenith_deg in enumerate(generate.SUN_ZENITH_DEG):
        every = traces[number]
        count = len(every)
        apart = [(seed + channel * count // every.shape[-1]) % count for channel in range(every.shape[-1])]
        mean = np.stack([every[k, ..., channel] for channel, k in enumerate(apart)], axis=-1)
        others = [np.delete(every[..., channel], k, axis=0) for channel, k in enumerate(apart)]
        relative = np.stack([other.std(axis=0, ddof=1) / other.mean(axis=0) for other in others], axis=-1)
        image, gain = generate.expose(mean, 1000 * seed + number)
        observations.append(
            fitting.observe(
                image,
                camera=generate.camera(),
                altitude=generate.ALTITUDE_KM,
                sun=generate.towards(zenith_deg),
                noise=relative,
                noise_shot=1 / gain,
                noise_floor=generate.READ / gain,
                sun_exclusion=SUN_EXCLUSION,
                name=f"{zenith_deg:g}°",
            )
        )
    # Where the search starts does not matter to where it ends, only to how long it takes.
    return fitting.fit(observations, init=truth, free=generate.FREE, tie=generate.TIE).with_truth(truth)


def expected_scatter(traces: list[np.ndarray], truth) -> tuple[np.ndarray, np.ndarray]:
    """Scatter of the linear errors over the error bar, and its own standard error, in the order of FitResult.parameters."""
    parameters = select(truth, generate.FREE, generate.TIE)
    y = jnp.asarray(parameters.start, jnp.float32)
    view = generate.camera().directions()

    @jax.jit
    def slopes(towards):
        def light(y):
            sky = diffatmo.Moments().sky(parameters.atmosphere(y))
            return sky.view(altitude=jnp.float32(generate.ALTITUDE_KM), sun=towards).radiance(view=view).radiance

        return jax.jacfwd(light)(y)

    information, pictures = 0.0, []
    for zenith_deg, every in zip(generate.SUN_ZENITH_DEG, traces, strict=True):
        towards = generate.towards(zenith_deg)
        mean, gain = every.mean(axis=0), generate.ELECTRONS / every[0].mean()
        sensor = mean / gain + (generate.READ / gain) ** 2
        weight = 1 / (every.var(axis=0, ddof=1) + sensor)
        weight[np.asarray(view @ towards) > np.cos(SUN_EXCLUSION)] = 0
        slope = np.asarray(slopes(towards), float)
        information += np.einsum("hwcp,hwc,hwcq->pq", slope, weight, slope)
        pictures.append((every - mean, sensor, slope * weight[..., None]))
    covariance = np.linalg.inv(information)
    fields = [*parameters.fields, *parameters.derived]
    gradient = np.asarray(jax.jacfwd(lambda y: numbers(parameters.atmosphere(y), fields))(y), float)
    found, uncertain = np.zeros(len(gradient)), np.zeros(len(gradient))
    for noise, sensor, push in pictures:
        way = push @ covariance @ gradient.T
        found += np.einsum("hwcq,hwc->q", way**2, sensor)
        for channel in range(noise.shape[-1]):
            part = np.einsum("khw,hwq->kq", noise[..., channel], way[..., channel, :]).var(axis=0, ddof=1)
            found += part
            uncertain += part**2 * 2 / (len(noise) - 1)
    bar = np.einsum("qn,nm,qm->q", gradient, covariance, gradient)
    scatter = np.sqrt(found / bar)
    return scatter, np.sqrt(uncertain) / found / 2 * scatter


def shipped_bars(name: str) -> list[float]:
    """Standard errors of the fit of the shipped pictures."""
    scene = Path(generate.__file__).parent / name / "scene.toml"
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / "fit"
        subprocess.run(
            [sys.executable, "-m", "diffatmo", "fit", "--config", scene, "-o", out], check=True, capture_output=True
        )
        found = json.loads((out / "fit.json").read_text())
    # In the order of FitResult.parameters: a spectral number after the other, then what is derived.
    every = [*found["parameters"].values(), *found["derived"].values()]
    return [error for estimate in every for error in np.ravel(estimate["standard_error"])]


def main(count: int, names: list[str]) -> None:
    for name in names:
        truth, bars = generate.ATMOSPHERES[name], shipped_bars(name)
        ways = [(number, k) for k in range(count) for number in range(len(generate.SUN_ZENITH_DEG))]
        found = {way: traced(name, *way) for way in track(ways, f"{name}: paths")}
        traces = [np.stack([found[number, k] for k in range(count)]) for number in range(len(generate.SUN_ZENITH_DEG))]
        results = [realisation(traces, truth, seed) for seed in track(range(count), f"{name}: fits")]
        expected = expected_scatter(traces, truth)
        table = Table(
            "parameter",
            "mean pull",
            "its scatter",
            "expected",
            "mean error / shipped error bar",
            title=f"{name}: {count} realisations, χ² {np.mean([r.reduced_chi2 for r in results]):.3f}",
        )
        for number, (estimate, bar, scatter, uncertain) in enumerate(
            zip(results[0].parameters, bars, *expected, strict=True)
        ):
            pulls = np.array([result.parameters[number].pull for result in results])
            errors = np.array([result.parameters[number].value - estimate.truth for result in results]) / bar
            table.add_row(
                estimate.name,
                f"{pulls.mean():+.2f}",
                f"{pulls.std(ddof=1):.2f}",
                f"{scatter:.2f} ± {uncertain:.2f}",
                f"{errors.mean():+.2f} ± {errors.std(ddof=1) / np.sqrt(count):.2f}",
            )
        Console(width=110).print(table)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 48, sys.argv[2:] or list(generate.ATMOSPHERES))
