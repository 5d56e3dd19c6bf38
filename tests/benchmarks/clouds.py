"""Clouds over a fifth of the shipped skies: what they do to a fit by least squares, and to one with a robust loss.

python tests/benchmarks/clouds.py [LOSS ...]

Each sky gets clouds of its own: smooth random patches, brighter than the sky behind them by a factor of up to three and greyer,
with soft edges. A fit is held against the one in which the clouds are masked, in units of the error bars of either, whichever
are wider.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import fitting
from diffatmo.cli.jobs import prepare
from diffatmo.cli.scenefile import read_scene

SKIES = Path(__file__).parents[2] / "data_synthetic"

COVER = 0.2


def cloudy(image: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The image with clouds over :data:`COVER` of it, and where there are none at all."""
    rng = np.random.default_rng(seed)
    height, width = image.shape[:2]
    waves = np.fft.rfft2(rng.standard_normal((height, width)))
    size = np.hypot(np.fft.fftfreq(height)[:, None] * height / 3, np.fft.rfftfreq(width)[None] * width / 6)
    field = np.fft.irfft2(waves * np.exp(-(size**2) / 2), s=(height, width))
    edge = np.quantile(field, 1 - COVER)
    thick = np.clip((field - edge) / (np.quantile(field, 1 - COVER / 3) - edge), 0, 1)[..., None]
    grey = image.max(axis=-1, keepdims=True) * rng.uniform(1.2, 3)
    return ((1 - thick) * image + thick * grey).astype(np.float32), thick[..., 0] == 0


def main(losses: list[str]) -> None:
    for name in ("clear", "hazy"):
        job = prepare(read_scene(SKIES / name / "scene.toml"))
        pictures = [cloudy(own.image, seed) for seed, own in enumerate(job.observations)]
        covered = [replace(own, image=image) for own, (image, _) in zip(job.observations, pictures, strict=True)]
        masked = [replace(own, used=own.used & blue) for own, (_, blue) in zip(job.observations, pictures, strict=True)]

        def found(images: list[fitting.Observation], loss: str | None, job=job) -> fitting.FitResult:
            return fitting.fit(images, init=job.init, free=job.free, tie=job.tie, loss=loss)

        without = found(masked, None)
        fits = {str(loss): found(covered, loss) for loss in (None, *losses)}
        cover = 1 - np.mean([blue.mean() for _, blue in pictures])
        table = Table("", *fits, title=f"{name}, {cover:.0%} under clouds: shift in error bars")
        rows = zip(without.parameters, *(fit.parameters for fit in fits.values()), strict=True)
        for mine, *others in rows:
            bars = [max(mine.standard_error or 0, other.standard_error or 0) or np.inf for other in others]
            shifts = [(other.value - mine.value) / bar for other, bar in zip(others, bars, strict=True)]
            table.add_row(mine.name, *(f"{shift:+.2f}" for shift in shifts))
        table.add_row("reduced χ²", *(f"{fit.reduced_chi2:.3g}" for fit in fits.values()))
        table.add_row("converged", *(str(fit.converged) for fit in fits.values()))
        table.add_row("steps", *(str(fit.iterations) for fit in fits.values()))
        Console(width=120).print(table)


if __name__ == "__main__":
    main(sys.argv[1:] or list(fitting.robust.LOSSES))
