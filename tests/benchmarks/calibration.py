"""Are the error bars right? Fit the shipped skies with fresh sensor noise many times.

python tests/benchmarks/calibration.py [REALISATIONS] [NAME ...]

The Monte Carlo means are traced anew, ten minutes for a sky, and the realisations share them in turn: their own noise, some
tenths of the sensor's, does not average out further than that.
"""

import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import fitting

sys.path.insert(0, str(Path(__file__).parents[2] / "data_synthetic"))
import generate

TRACED = 2
"""Independent Monte Carlo means of every picture."""


def realisation(means: list[tuple[np.ndarray, np.ndarray]], truth, seed: int) -> fitting.FitResult:
    """Fit one exposure of every picture."""
    observations = []
    for number, ((mean, error), zenith_deg) in enumerate(zip(means, generate.SUN_ZENITH_DEG, strict=True)):
        image, gain = generate.expose(mean, 1000 * seed + number)
        observations.append(
            fitting.observe(
                image,
                camera=generate.camera(),
                altitude=generate.ALTITUDE_KM,
                sun=generate.towards(zenith_deg),
                noise=float(np.sqrt(np.mean((error / mean) ** 2))),
                noise_shot=1 / gain,
                noise_floor=generate.READ / gain,
                sun_exclusion=np.radians(2.0),
                name=f"{zenith_deg:g}°",
            )
        )
    # Where the search starts does not matter to where it ends, only to how long it takes.
    return fitting.fit(observations, init=truth, free=generate.FREE, tie=generate.TIE).with_truth(truth)


def main(count: int, names: list[str]) -> None:
    for name in names:
        truth = generate.ATMOSPHERES[name]
        suns = list(enumerate(generate.SUN_ZENITH_DEG))
        means = [[generate.trace(truth, sun, 5000 + 100 * k + n) for n, sun in suns] for k in range(TRACED)]
        results = [realisation(means[seed % TRACED], truth, seed) for seed in range(count)]
        table = Table("parameter", "mean pull", "its scatter", title=f"{name}: {count} realisations of the noise")
        for number, estimate in enumerate(results[0].parameters):
            pulls = np.array([result.parameters[number].pull for result in results])
            table.add_row(estimate.name, f"{pulls.mean():+.2f}", f"{pulls.std(ddof=1):.2f}")
        Console().print(table)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50, sys.argv[2:] or list(generate.ATMOSPHERES))
