"""Are the error bars right? Fit the shipped skies with fresh sensor noise many times.

python tests/benchmarks/calibration.py [REALISATIONS] [NAME ...]

The Monte Carlo means are traced anew, a quarter of an hour for a sky, and kept in a folder of the system's temporary files.
Their own noise is a few tenths of the sensor's where the sky is bright. Realisations have to share it, so each takes every
channel from another mean: the channels of one mean come from the same paths, and their errors are alike, which no fit expects.
And the errors of a mean's pixels are taken from the *other* means, as an estimate from a pixel's own paths is large where the
value is.
"""

import itertools
import sys
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import fitting

sys.path.insert(0, str(Path(__file__).parents[2] / "data_synthetic"))
import generate

TRACED = 3
"""Independent Monte Carlo means of every picture."""
SAMPLES = generate.SAMPLES // 2


def traced(name: str, number: int, zenith_deg: float, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean ``k`` of a picture and its standard error, traced or found."""
    file = Path(tempfile.gettempdir()) / "diffatmo-calibration" / f"{name}_{zenith_deg:g}_{k}_{SAMPLES}.npz"
    if not file.exists():
        file.parent.mkdir(exist_ok=True)
        mean, error = generate.trace(generate.ATMOSPHERES[name], zenith_deg, 5000 + 100 * k + number, SAMPLES)
        np.savez(file, mean=mean, error=error)
    with np.load(file) as found:
        return found["mean"], found["error"]


def realisation(means: list[list[tuple[np.ndarray, np.ndarray]]], truth, seed: int) -> fitting.FitResult:
    """Fit one exposure of every picture, each channel from another of its ``means``."""
    orders = list(itertools.permutations(range(TRACED), 3))
    order = orders[seed % len(orders)]
    observations = []
    for number, zenith_deg in enumerate(generate.SUN_ZENITH_DEG):
        ways = [means[k][number] for k in range(TRACED)]
        mean = np.stack([ways[k][0][..., channel] for channel, k in enumerate(order)], axis=-1)
        squares = [(error / value) ** 2 for value, error in ways]
        others = [
            np.mean([squares[other][..., channel] for other in range(TRACED) if other != k], axis=0)
            for channel, k in enumerate(order)
        ]
        image, gain = generate.expose(mean, 1000 * seed + number)
        observations.append(
            fitting.observe(
                image,
                camera=generate.camera(),
                altitude=generate.ALTITUDE_KM,
                sun=generate.towards(zenith_deg),
                noise=np.sqrt(np.stack(others, axis=-1)),
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
        means = [[traced(name, number, sun, k) for number, sun in suns] for k in range(TRACED)]
        results = [realisation(means, truth, seed) for seed in range(count)]
        table = Table("parameter", "mean pull", "its scatter", title=f"{name}: {count} realisations of the noise")
        for number, estimate in enumerate(results[0].parameters):
            pulls = np.array([result.parameters[number].pull for result in results])
            table.add_row(estimate.name, f"{pulls.mean():+.2f}", f"{pulls.std(ddof=1):.2f}")
        Console().print(table)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50, sys.argv[2:] or list(generate.ATMOSPHERES))
