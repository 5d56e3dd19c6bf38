"""Fit a measured scan of the sky as ``diffatmo fit SCAN`` does, and say how far off it is in absolute units.

python tests/benchmarks/measured.py SCAN.npz [OTHER.npz ...]

Others are predicted from the first: its atmosphere, under their suns, with nothing fitted but the instrument's azimuth.
"""

import sys
from pathlib import Path

import numpy as np

import fitting
from diffatmo.cli.jobs import prepare
from diffatmo.cli.running import fitting_model
from diffatmo.cli.scenefile import FitSpec, ImageSpec


def rmse(result: fitting.FitResult) -> tuple[float, float, float]:
    """RMS, mean difference, and mean radiance of the used samples, W m^-2 sr^-1 nm^-1."""
    (observation,), (fitted,) = result.observations, result.fitted
    measured = observation.image[observation.used]
    off = fitted[observation.used] - measured
    return float(np.sqrt(np.mean(off**2))), float(off.mean()), float(measured.mean())


def main(first: Path, others: list[Path]) -> None:
    job = prepare(FitSpec((ImageSpec(first),)))
    model = fitting_model(job.model, photos=job.photos)
    result = fitting.fit(
        job.observations, init=job.init, free=job.free, tie=job.tie, priors=job.priors, model=model, refine=False
    )
    report(first, result)
    for other in others:
        held = prepare(FitSpec((ImageSpec(other),)))
        # One number that the images do not tell stands for the atmosphere, which is held.
        prior = fitting.priors.Prior("mie_scale_height", float(result.atmosphere.mie_scale_height), 1e-4, True, "held")
        predicted = fitting.fit(
            held.observations,
            init=result.atmosphere,
            free=["mie_scale_height"],
            priors=[prior],
            model=model,
            refine=False,
        )
        report(other, predicted)


def report(file: Path, result: fitting.FitResult) -> None:
    rms, mean, level = (1000 * value for value in rmse(result))
    (observation,) = result.observations
    print(f"{file.name}: {result.message}, {result.iterations} steps, {result.timings['total_s']:.0f} s")
    print(f"  {observation.used.sum()} directions × {observation.image.shape[-1]} bands, mean {level:.1f} mW")
    print(f"  RMSE {rms:.2f} mW m^-2 sr^-1 nm^-1, mean difference {mean:+.2f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
