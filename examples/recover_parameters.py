"""Photograph a sky three times, then recover the parameters of its atmosphere from the pictures.

The pictures are made by Monte Carlo, so that the model that fits them has no part in them.

python examples/recover_parameters.py
"""

import sys
from dataclasses import replace

import numpy as np
from rich.console import Console

import diffatmo
import fitting
from diffatmo import render, sun
from fitting import report

NOISE = 0.02
MONTE_CARLO = 0.007
"""Standard error of the path tracer, relative to a pixel."""


def main(width: str = "64") -> fitting.FitResult:
    truth = diffatmo.earth()
    camera = diffatmo.Equirectangular(int(width) // 2, int(width), upper=True)
    rng = np.random.default_rng(0)
    observations = []
    for zenith in (30, 70, 88):
        towards = sun.direction(zenith=np.radians(zenith), azimuth=0.0)
        radiance = render.render(diffatmo.Scene(truth, camera, 0.1, towards), model=diffatmo.PathTrace(samples=1024))
        pixels = np.asarray(radiance) * (1 + NOISE * rng.standard_normal(radiance.shape))
        observations.append(
            fitting.observe(
                pixels,
                camera=camera,
                altitude=0.1,
                sun=towards,
                noise=np.hypot(NOISE, MONTE_CARLO),
                name=f"sun at {zenith}°",
            )
        )
    start = replace(
        truth,
        rayleigh_scattering=1.3 * truth.rayleigh_scattering,
        mie_scattering=0.7 * truth.mie_scattering,
        mie_g=0.65,
    )
    result = fitting.fit(
        observations,
        init=start,
        free=["rayleigh_scattering", "mie_scattering", "mie_g"],
        progress=lambda step: print(f"step {step.step}: reduced χ² = {step.reduced_chi2:.4g}"),
    ).with_truth(truth)
    Console().print(report.table(result))
    return result


if __name__ == "__main__":
    main(*sys.argv[1:])
